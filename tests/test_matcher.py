"""The paper's matcher: what it must find, what it must not, and what it says when it cannot tell."""

import json
import math

import numpy as np
import pytest

from phasemark import UsageError
from phasemark.data import BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import FilteredFrames, Match, Matcher, Matches, kalman_filter
from phasemark.matcher.figures import match_figure, model_image
from phasemark.matcher.filters import PixelState, noise_free
from phasemark.matcher.nearest.nearest_matcher import NearestMatcher
from phasemark.matcher.nearest.templates import Observation, Templates
from phasemark.matcher.pixel_agreement import DISAGREEMENT
from phasemark.render import Background, Frames, PhasorImages, Renderer, capture, preset

SENSOR = preset("pmd-16x16")
WALL = Background(wall_m=3.0)
GRID = {"distance_m": "0.9:1.1:0.02", "delta_deg": "0:180:10"}


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    with build_bank(BankPlan(**GRID), tmp_path_factory.mktemp("bank") / "bank.h5") as opened:
        yield opened


@pytest.fixture(scope="module")
def full_bank(tmp_path_factory):
    plan = BankPlan(classes=("cone", "post"), layout="full", distance_m="0.9:1.1:0.05", delta_deg="0:180:30")
    with build_bank(plan, tmp_path_factory.mktemp("bank") / "full.h5") as opened:
        yield opened


def bank_images(bank, background):
    """Return every image of a bank as the camera would see it before a background, with class, i and j of each."""
    keys = [(n, i, j) for n in bank.classes for i in range(len(bank.distance_m)) for j in range(len(bank.delta_rad))]
    images = [bank.image(*key) for key in keys]
    phasor = np.concatenate([image.phasor for image in images])
    intensity = np.concatenate([image.intensity for image in images])
    coverage = np.concatenate([image.coverage for image in images])
    if background is not None:
        behind = Renderer(None, bank.sensor).render(1.0, background=background)
        phasor, intensity = phasor + (1 - coverage) * behind.phasor, intensity + (1 - coverage) * behind.intensity
    views = Renderer(None, bank.sensor).render(np.ones(len(keys))).views
    return keys, PhasorImages(phasor, intensity, coverage, bank.sensor, views)


@pytest.mark.parametrize("background", [None, WALL])
@pytest.mark.parametrize("which", ["bank", "full_bank"])
def test_every_noise_free_bank_entry_is_found_as_itself(which, background, request):
    bank = request.getfixturevalue(which)
    keys, images = bank_images(bank, background)
    matches = Matcher(bank, background=background).match(noise_free(images, 50))
    found = [
        (
            m.class_name,
            int(np.argmin(abs(bank.distance_m - m.distance_m))),
            int(np.argmin(abs(bank.delta_rad - m.delta_rad))),
        )
        for m in matches
    ]
    assert found == keys
    assert matches.accepted.all()
    assert matches.chi2.max() < 1.0  # float32 ranges in the bank leave rounding alone


def test_the_cost_is_the_whitened_squared_distance_with_the_no_return_rule():
    # four pixels: a return on the landmark, a lost return, a missing return, agreement on nothing
    phasor = np.array([[[0.8 * np.exp(1j * 1.0 / SENSOR.metres_per_radian), 0, 0.8, 0]]])
    coverage = np.array([[[1.0, 0.0, 0.31, 0.004]]])
    templates = Templates.of_parts([(phasor, coverage)], SENSOR, None, (0, 1))
    seen = Observation(
        range_m=np.array([[1.03, 2.0, 0.0, 0.0]]),
        weight=np.array([[1 / 0.01**2, 1e4, 0.0, 0.0]]),
        returned=np.array([[True, True, False, False]]),
        not_returned=np.array([[False, False, True, True]]),
    )
    expected = (0.03 / 0.01) ** 2 + 2 * DISAGREEMENT
    assert templates.exact_costs(seen, 0, np.array([0]))[0] == pytest.approx(expected, rel=1e-6)  # float32 ranges
    assert templates.costs(seen)[0, 0] == pytest.approx(expected, rel=1e-5)  # float32 product


def test_matrix_product_and_exact_sum_agree_on_random_frames(bank):
    rng = np.random.default_rng(3)
    templates = NearestMatcher(bank).pose
    state = rng.choice([0, 1, 2], size=(5, 128), p=[0.7, 0.2, 0.1])
    seen = Observation(
        range_m=np.where(state == 0, rng.uniform(0.8, 1.3, (5, 128)), 0.0),
        weight=np.where(state == 0, 1e5, 0.0),
        returned=state == 0,
        not_returned=state == 1,
    )
    some = rng.integers(0, len(templates), 200)
    exact = np.stack([templates.exact_costs(seen, k, some) for k in range(5)])
    # 1e-5 of Σ w (y − mean)², some 10⁷ here: the rounding that best() allows for
    scale = np.sum(seen.weight * np.where(seen.returned, seen.range_m - templates.mean_m, 0) ** 2, axis=1)
    assert np.abs(templates.costs(seen)[:, some] - exact).max() <= 1e-5 * scale.max()


def test_a_range_beyond_the_wrap_is_compared_across_it():
    far = SENSOR.unambiguous_range_m - 0.01
    phasor = np.array([[[np.exp(1j * far / SENSOR.metres_per_radian)]]])
    templates = Templates.of_parts([(phasor, np.ones((1, 1, 1)))], SENSOR, None, (0, 1))
    seen = Observation(np.array([[0.01]]), np.array([[1e4]]), np.array([[True]]), np.array([[False]]))
    # 1 cm before the wrap and 1 cm after it are 2 cm apart
    assert templates.exact_costs(seen, 0, np.array([0]))[0] == pytest.approx(1e4 * 0.02**2, rel=1e-3)


@pytest.mark.parametrize("background", [None, WALL])
def test_noisy_frames_on_the_grid_give_class_distance_and_angle(bank, background):
    matcher = Matcher(bank, background=background)
    for k, (name, spec) in enumerate(catalog().items()):
        image = Renderer(build_mesh(spec), SENSOR, albedo=spec.albedo).render(
            [0.92, 1.0, 1.08], np.deg2rad([0, 40, 90]), background=background
        )
        frames = capture(image, SENSOR, rng=np.random.default_rng([11, k]), n_frames=50)
        matches = matcher.match(kalman_filter(frames))
        assert list(matches.class_name) == [name] * 3
        np.testing.assert_allclose(matches.distance_m, [0.92, 1.0, 1.08], atol=1e-9)
        np.testing.assert_allclose(np.rad2deg(matches.delta_rad), [0, 40, 90], atol=1e-9)


def test_the_narrow_face_near_is_told_from_the_wide_face_far_by_what_does_not_return(bank):
    # PHYSICS section 7: at δ = 90° the near face is half the difference of the sides, 4 cm, further away; ranges alone
    # tie wherever the narrow face is seen, the width decides
    image = Renderer(build_mesh(catalog()["post"]), SENSOR).render([1.0, 0.96], [0.0, math.pi / 2])
    matches = Matcher(bank).match(noise_free(image, 50))
    np.testing.assert_allclose(matches.distance_m, [1.0, 0.96], atol=1e-9)
    np.testing.assert_allclose(matches.delta_rad, [0.0, math.pi / 2], atol=1e-9)


@pytest.mark.parametrize(("background", "stated"), [(None, None), (WALL, WALL), (Background(wall_m=2.0), None)])
def test_a_scene_without_a_landmark_is_no_landmark(bank, background, stated):
    image = Renderer(None, SENSOR).render(1.0, background=background)
    frames = capture(image, SENSOR, rng=np.random.default_rng(5), n_frames=50)
    (match,) = Matcher(bank, background=stated).match(kalman_filter(frames))
    assert match.class_name is None
    assert not match.accepted
    if stated == background:
        assert match.class_probability["none"] > 0.99


@pytest.mark.parametrize("n_valid", [0, 1, 2])
def test_too_few_returns_are_an_answer(bank, n_valid):
    ranges = np.full((1, 10, 16, 16), np.nan)
    ranges[..., 12, 7 : 7 + n_valid] = 1.0
    (match,) = Matcher(bank).match(kalman_filter(Frames(ranges, sensor=SENSOR)))
    assert match.class_name is None
    assert math.isnan(match.distance_m)
    assert match.class_probability["none"] == 1.0
    json.dumps(match.as_dict(), allow_nan=False)


def test_missing_pixels_say_nothing(bank):
    image = Renderer(build_mesh(catalog()["cone"]), SENSOR).render(1.0, math.radians(20))
    full = noise_free(image, 50)
    state = full.state.copy()
    state[:, :, ::2] = PixelState.MISSING
    holes = FilteredFrames(full.range_m, full.std_m, None, None, state, full.n_effective, SENSOR)
    (match,) = Matcher(bank).match(holes)
    assert (match.class_name, round(match.distance_m, 6)) == ("cone", 1.0)
    assert math.degrees(match.delta_rad) == pytest.approx(20)


def test_a_single_frame_without_amplitudes_is_matched_with_the_noise_law(bank):
    image = Renderer(build_mesh(catalog()["cylinder"]), SENSOR).render(1.0, math.radians(60))
    ranges = np.where(image.coverage > 0.01, image.range_m, np.nan)
    frames = Frames(ranges[:, None], sensor=SENSOR, invalid_means="no-return")
    (match,) = Matcher(bank).match(kalman_filter(frames))
    assert match.class_name == "cylinder"
    assert math.degrees(match.delta_rad) == pytest.approx(60)


def test_good_fits_pass_the_test_at_about_its_false_alarm_rate(tmp_path):
    # on the points of a fine grid the linearised χ² is exact up to the pixels at the threshold; N = 200, false-alarm
    # rate 5 %: the 99.9 % interval of a binomial is 1 to 22 refusals
    image = Renderer(build_mesh(catalog()["cone"]), SENSOR).render(np.full(200, 1.0), math.radians(30))
    frames = capture(image, SENSOR, rng=np.random.default_rng(8), n_frames=20)
    plan = BankPlan(classes=("cone", "cylinder"), distance_m="0.98:1.02:0.01", delta_deg="20:40:1")
    with build_bank(plan, tmp_path / "fine.h5") as fine:
        matches = Matcher(fine, false_alarm=0.05).match(kalman_filter(frames))
    assert 1 <= np.sum(~matches.accepted) <= 22


def test_a_strange_shape_is_not_accepted(bank):
    mesh = build_mesh(catalog()["cone"])
    mesh.apply_scale([1.0, 1.0, 0.6])  # a squat box with a squat cone
    frames = capture(Renderer(mesh, SENSOR).render(1.0), SENSOR, rng=np.random.default_rng(9), n_frames=50)
    (match,) = Matcher(bank).match(kalman_filter(frames))
    assert not match.accepted


def test_matches_are_a_sequence_with_the_fields_as_arrays(bank):
    _, images = bank_images(bank, None)
    matches = Matcher(bank).match(noise_free(images, 50)[:7])
    assert isinstance(matches, Matches)
    assert len(matches) == len(list(matches)) == 7
    assert matches[2:5].distance_m.tolist() == [match.distance_m for match in matches][2:5]
    for name in ("accepted", "bearing_rad", "height_m", "dof", "p_value", "delta_rad"):
        assert getattr(matches, name).tolist() == [getattr(match, name) for match in matches]


def test_frames_of_another_camera_are_refused(bank):
    other = SENSOR.with_(half_angle_h_deg=12.0)
    frames = kalman_filter(Frames(np.ones((1, 2, 16, 16)), sensor=other))
    with pytest.raises(UsageError, match="half_angle_h_deg"):
        Matcher(bank).match(frames)


def test_a_noisier_camera_of_the_same_optics_is_welcome(bank):
    frames = kalman_filter(Frames(np.ones((1, 2, 16, 16)), sensor=SENSOR.with_(read_noise_e=30.0)))
    assert len(Matcher(bank).match(frames)) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "guess"}, "'method' must be 'nearest' or 'refine', got 'guess'"),
        ({"false_alarm": 0.0}, "false_alarm"),
        ({"false_alarm": 1.5}, "false_alarm"),
    ],
)
def test_wrong_arguments_are_refused(bank, arguments, message):
    with pytest.raises(UsageError, match=message):
        Matcher(bank, **arguments)


def test_the_model_beside_a_match_is_the_bank_image_composed_with_the_background(bank):
    keys, images = bank_images(bank, WALL)
    k = keys.index(("cone", 5, 4))
    (match,) = Matcher(bank, background=WALL).match(noise_free(images, 50)[k])
    model = model_image(bank, match, WALL)[0]
    np.testing.assert_allclose(model, images.range_m[k], atol=1e-6)  # float32 phasors
    assert len(match_figure(noise_free(images, 50), match, bank, WALL, k).axes) == 6  # three panels, three colour bars


def test_the_model_beside_a_match_of_a_tilted_camera_is_tilted(bank):
    free = ("distance_m", "delta_rad", "pitch_rad", "roll_rad")
    image = Renderer(bank.mesh("cone"), bank.sensor, albedo=bank.mesh("cone").metadata["albedo"]).render(
        1.0, 0.7, 0.0, 0.0, math.radians(3), math.radians(-2)
    )
    frames = noise_free(image, 50)
    (match,) = Matcher(bank, "refine", free=free).match(frames)
    residual = (frames.range_m[0] - model_image(bank, match, None)[0]) / frames.std_m[0]
    assert np.nanmax(np.abs(residual)) < 1  # 5 and more without pitch and roll
    assert np.isfinite(residual).sum() > 60


def test_the_model_beside_a_match_is_found_in_a_bank_of_more_than_one_period(tmp_path):
    plan = BankPlan(classes=("cone",), distance_m="0.9:1.1:0.1", delta_deg="0:360:30")  # repeats after 180°
    with build_bank(plan, tmp_path / "bank.h5") as opened:
        match = Match("cone", True, distance_m=1.0, delta_rad=math.radians(30), symmetry=2)
        model, image = model_image(opened, match, None)[0], opened.image("cone", 1, 1)
        shown = np.isfinite(model)
        assert shown.sum() > 20
        np.testing.assert_allclose(model[shown], image.range_m[0][shown], atol=1e-6)
