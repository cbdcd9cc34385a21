"""Nothing that a frame shows is free: an accepted answer is right, on every preset and with every setting."""

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.stats import binom
from thin_landmarks import COARSE, FINE, GROSS_M, GROSS_RAD, PRESETS, SETTINGS, WALL, bank_of, box, count, meshes

from phasemark.cli import main
from phasemark.data import BankPlan, build_bank, open_bank
from phasemark.matcher import Matcher, kalman_filter
from phasemark.matcher.filters.filtered_frames import PixelState
from phasemark.matcher.likelihood.residuals import Evidence, gauss_newton_sums
from phasemark.matcher.one_frequency import OneFrequency
from phasemark.matcher.pixel_agreement import DISAGREEMENT, counts, disagrees
from phasemark.render import Background, Frames, Renderer, Views, capture, preset

DIRECT = preset("vl53l5cx-8x8")
PLATES = np.array([0.608, 0.569]), np.radians([8.4, 24.5])
NEAR = tuple(np.round(np.arange(0.6, 0.901, 0.01), 3).tolist())


@pytest.fixture(scope="module")
def thin_bank(tmp_path_factory):
    """Return a function from the name of a landmark and of a sensor to their bank, which is built once."""
    folder = tmp_path_factory.mktemp("thin")
    return functools.cache(lambda name, sensor, distance=COARSE: bank_of(name, sensor, folder, distance))


@pytest.fixture(scope="module")
def panel(thin_bank):
    return thin_bank("panel", "vl53l5cx-8x8")


def frames_of(bank, *view, seed, n_frames=1, background=None):
    """Return the filtered frames of some views of the landmark of a bank."""
    image = Renderer(bank.mesh(bank.classes[0]), bank.sensor, albedo=0.8).render(*view, background=background)
    return kalman_filter(capture(image, bank.sensor, rng=np.random.default_rng(seed), n_frames=n_frames))


@pytest.mark.parametrize("name", PRESETS)
def test_no_pixel_of_an_empty_image_counts(name):
    sensor = preset(name)
    nothing = np.zeros((sensor.rows, sensor.cols))
    assert not counts(nothing.astype(complex), nothing, sensor).any()


def test_a_direct_sensor_measures_nothing_beyond_its_range_or_below_its_intensity():
    image = Renderer(None, DIRECT).render(1.0, background=Background(wall_m=1.5))
    assert counts(image.phasor, image.intensity, DIRECT).all()
    assert not counts(image.phasor, image.intensity, DIRECT.with_(min_intensity=0.3)).any()  # 0.5 / 1.5² = 0.22
    far = Renderer(None, DIRECT).render(1.0, background=Background(wall_m=4.5))
    assert not counts(far.phasor, far.intensity, DIRECT).any()


@pytest.mark.parametrize("modulation_hz", [10e6, [20e6, 60e6]])
def test_a_pixel_counts_from_the_least_amplitude_on(modulation_hz):
    camera = preset("pmd-16x16").with_(min_amplitude_e=8000.0, modulation_hz=modulation_hz)
    sensor = OneFrequency(camera, "combined").sensor if len(camera.frequencies_hz) > 1 else camera
    least = 8000.0 / (camera.contrast * camera.signal_e)  # of |S|
    s = least * np.array([0.499, 0.501, 0.999, 1.001, 1.999, 2.001])
    for share, first in ((2.0, 1), (1.0, 3), (0.5, 5)):
        np.testing.assert_array_equal(counts(s + 0j, s, sensor, share), np.arange(6) >= first)


def test_without_a_limit_all_light_may_return_and_little_tells_nothing():
    sensor = preset("pmd-16x16").with_(max_phase_std_rad=None)
    s = np.array([0.0, 1e-6])
    assert counts(s + 0j, s, sensor, 2.0).tolist() == [False, True]
    assert not counts(s + 0j, s, sensor).any()


def test_frame_and_model_disagree_where_the_table_says():
    yes, no = np.array([True]), np.array([False])
    assert disagrees(yes, no, no, no).all()  # a return where nothing can
    assert disagrees(no, yes, yes, yes).all()  # none where something must
    for returned, absent, may, must in ((yes, no, yes, yes), (yes, no, yes, no), (no, yes, yes, no), (no, yes, no, no)):
        assert not disagrees(returned, absent, may, must).any()
    for may, must in ((no, no), (yes, no), (yes, yes)):
        assert not disagrees(no, no, may, must).any()  # a missing pixel says nothing


def test_a_return_costs_a_disagreement_where_the_model_has_no_light():
    frames = kalman_filter(Frames(np.full((1, 1, 8, 8), 0.7), sensor=DIRECT)).with_pooled_noise()
    evidence = Evidence.from_frames(frames, "ranges")
    dark = np.zeros((1, 64), complex)
    sums = gauss_newton_sums(
        dark, dark[:, None], evidence, np.zeros(1, np.int64), np.ones((1, 64), bool), None
    )  # fmt: skip
    assert sums.cost[0] == sums.capped[0] == 64 * DISAGREEMENT


@pytest.mark.parametrize("setting", SETTINGS)
def test_an_accepted_answer_on_a_thin_panel_is_right(panel, setting):
    found = count(panel, setting, 12, 1, np.random.default_rng(5))
    assert found.wrong_accepted == 0
    if setting in ("fixed", "wall", "robust"):
        assert found.right_accepted >= binom.ppf(0.002, 12, 0.99)  # of a false alarm of 0.01


@pytest.mark.parametrize(
    "setting", ["wall", *(pytest.param(name, marks=pytest.mark.soak) for name in ("fixed", "unknown", "bearing"))]
)
def test_a_plate_that_fills_the_view_may_be_its_front_or_its_back(thin_bank, setting):
    # at 0.6 m the 16 × 16 camera sees nothing of the bracket but its plate, from behind as from the front
    bank = thin_bank("bracket", "pmd-16x16")
    frames = frames_of(bank, *PLATES, seed=9, background=None if setting == "bearing" else WALL)
    matches = Matcher(bank, "refine", **SETTINGS[setting]).match(frames)
    assert not matches.accepted.any()
    assert set(matches.reason) <= {"ambiguous", "undetermined"}


def test_a_plate_is_not_taken_for_its_back_where_the_search_stopped_beside_its_front(tmp_path):
    # the back looks exactly like the front, 0.2 m nearer: from 0.65 m on it is in the bank's range
    bank = bank_of("bracket", "pmd-16x16", tmp_path, distance="0.45:1.25:0.01")
    matches = Matcher(bank, "refine", **SETTINGS["fixed"]).match(frames_of(bank, *PLATES, seed=9, background=WALL))
    assert set(matches.reason) <= {"", "ambiguous", "undetermined"}
    right = (np.abs(matches.distance_m - PLATES[0]) < GROSS_M) & (np.abs(matches.delta_rad - PLATES[1]) < GROSS_RAD)
    assert right[matches.accepted].all()


@pytest.mark.parametrize("n", [5, pytest.param(30, marks=pytest.mark.soak)])
def test_pixels_that_are_counted_anew_do_not_let_a_view_slide_away(tmp_path, n):
    # a column that the frame's front enters by little stopped counting, the view slid until the column was
    # contradicted, and the back remained alone
    bank = bank_of("frame", "pmd-16x16", tmp_path, distance="0.45:1.25:0.02")
    assert count(bank, "bearing", n, 1, np.random.default_rng([11, 5])).wrong_accepted == 0


@pytest.mark.soak
def test_only_the_final_covariance_excuses_pixels_that_a_view_contradicts(thin_bank):
    # another face ended two columns before the one that was seen, and its first covariance, far too wide, excused both
    found = count(thin_bank("bracket", "pmd-16x16", FINE), "bearing", 100, 10, np.random.default_rng([7, 10]))
    assert found.wrong_accepted == 0


@pytest.mark.parametrize("n", [16, pytest.param(100, marks=pytest.mark.soak)])
def test_a_lost_view_is_looked_for_at_its_best_distance(thin_bank, n):
    # around the scout's view, at its own distance, all angles led to one side minimum, and the back was accepted
    found = count(thin_bank("frame", "vl53l5cx-8x8"), "plain", n, 1, np.random.default_rng([5, 1]))
    assert found.wrong_accepted == 0
    assert found.right >= 0.94 * n
    # front and back of a thin frame with a window off its middle by 3 cm differ by less than a zone
    assert "ambiguous" in {match.reason for match in found.answers}


def test_the_nearest_image_is_ambiguous_where_another_one_explains_a_frame_as_well(thin_bank):
    # near the camera a face of the bracket's plate, its back and a face of its arm look alike
    found = count(thin_bank("bracket", "pmd-16x16"), "nearest", 60, 1, np.random.default_rng([3, 7]))
    assert found.wrong_accepted == 0
    assert found.right_accepted >= 40
    assert "ambiguous" in {match.reason for match in found.answers}


def test_a_bearing_that_nothing_tells_is_undetermined(thin_bank):
    # the panel fills the 16 × 16 camera's view: its heading is known, but not where along it the camera looks
    found = count(thin_bank("panel", "pmd-16x16"), "bearing", 4, 10, np.random.default_rng(6))
    assert found.wrong_accepted == 0
    assert sum(match.reason == "undetermined" for match in found.answers) >= 2  # a few views show an edge


def test_a_background_that_no_pixel_sees_alone_is_found_behind_the_panel(panel):
    sensor = panel.sensor
    views = Views.broadcast(0.647, np.radians(-16.3), 0.0, 0.0)
    image = Renderer(panel.mesh("panel"), sensor, albedo=0.8).render_views(views, background=Background(wall_m=2.5))
    assert (image.coverage > 0).all()
    frames = capture(image, sensor, rng=np.random.default_rng(1), n_frames=1)
    (match,) = Matcher(panel, "refine", free=("distance_m", "delta_rad"), background="auto").match(
        kalman_filter(frames)
    )
    assert match.accepted
    assert match.distance_m == pytest.approx(0.647, abs=4e-3)
    assert match.background.wall_m == pytest.approx(2.5, rel=0.1)


def test_what_stands_around_is_left_out_with_an_unknown_background(panel):
    # a post before the panel and a shelf at its side: two columns and a row of other returns
    sensor = panel.sensor
    image = Renderer(panel.mesh("panel"), sensor, albedo=0.8).render(0.6, 0.1)
    ranges = np.array(capture(image, sensor, rng=np.random.default_rng(2), n_frames=1).range_m)
    ranges[..., 0] = 0.3
    ranges[..., 7, :] = 0.45
    frames = kalman_filter(Frames(ranges, sensor=sensor))
    options: dict[str, Any] = {"free": ("distance_m", "delta_rad")}
    assert not Matcher(panel, "refine", **options).match(frames)[0].accepted
    (match,) = Matcher(panel, "refine", background="unknown", **options).match(frames)
    assert match.accepted
    assert (match.distance_m, match.delta_rad) == pytest.approx((0.6, 0.1), abs=0.01)


def test_a_square_post_is_no_bracket_whose_plate_is_as_wide(thin_bank):
    """Of 40 posts eight were: some fill the image, others go on above and below the bracket's outline."""
    bank = thin_bank("bracket", "pmd-16x16")
    matcher = Matcher(bank, "refine", background="unknown", free=("distance_m", "delta_rad"))
    rng, away = np.random.default_rng(4), 10.0  # the post's axis, far enough for the lens to stand outside
    for width_m, at_m in ((0.26, 0.67), (0.28, 0.64), (0.2, 0.92), (0.21, 0.56)):
        for turn_rad in (-0.2, 0.0, 0.1):
            post = box((width_m, width_m, 2.0))
            post.apply_transform(trimesh.transformations.rotation_matrix(turn_rad, (0, 0, 1)))
            post.apply_translation((at_m + width_m / 2 - away, 0, 0))
            image = Renderer(post, bank.sensor, albedo=0.8).render(away)
            (match,) = matcher.match(kalman_filter(capture(image, bank.sensor, rng=rng, n_frames=20)))
            assert not match.accepted
    (match,) = matcher.match(frames_of(bank, 0.8, 0.9, seed=3, n_frames=20))
    assert match.accepted


def test_few_returns_among_unknown_things_determine_nothing(panel):
    ranges = np.full((1, 1, 8, 8), np.nan)
    ranges[..., 7, 1:7] = 1.0  # a row of something
    frames = kalman_filter(Frames(ranges, sensor=panel.sensor))
    (match,) = Matcher(panel, "refine", background="unknown", free=("distance_m", "delta_rad")).match(frames)
    assert not match.accepted


def test_few_returns_determine_nothing_where_outliers_are_left_out(panel):
    frames = frames_of(panel, 0.6, 0.1, seed=2, n_frames=50)
    few = frames.range_m.copy()
    seen = np.flatnonzero(np.isfinite(few))
    few.flat[seen[11:]] = np.nan  # six returns for each of D and δ are 12
    cut = dataclasses.replace(frames, range_m=few, state=np.where(np.isfinite(few), frames.state, PixelState.MISSING))
    robust = Matcher(panel, "refine", robust=True, free=("distance_m", "delta_rad"))
    assert robust.match(frames)[0].accepted
    assert robust.match(cut)[0].reason == "undetermined"


DIM = {"signal_e": 1500.0, "ambient_e": 0.0, "read_noise_e": 15.0, "min_amplitude_e": 0.0}


@pytest.mark.parametrize("dim", [DIM, {"min_amplitude_e": 8000.0}], ids=["noise", "threshold"])
def test_pixels_that_may_go_dark_refuse_no_right_answer(tmp_path, dim):
    mesh, _ = meshes()["bracket"]
    mesh.export(tmp_path / "bracket.stl")
    part = {"name": "bracket", "path": str(tmp_path / "bracket.stl"), "unit": "m", "origin": "center"}
    plan = BankPlan(meshes=[part], sensor="pmd-16x16", sensor_overrides=dim, distance_m="0.6:1.3:0.02",
                    delta_deg="0:358:2", layout="full")  # fmt: skip
    with build_bank(plan, tmp_path / "dim.h5") as bank:
        rng, n = np.random.default_rng(4), 48
        renderer = Renderer(bank.mesh("bracket"), bank.sensor, albedo=0.8)
        image = renderer.render(rng.uniform(0.7, 1.2, n), rng.uniform(0, 2 * np.pi, n))
        some = counts(image.phasor, image.intensity, bank.sensor) & ~counts(
            image.phasor, image.intensity, bank.sensor, 0.5
        )
        assert some.any(axis=(1, 2)).mean() > 0.5
        frames = kalman_filter(capture(image, bank.sensor, rng=rng, n_frames=50))
        matches = Matcher(bank, "refine", free=("distance_m", "delta_rad")).match(frames)
    assert (matches.reason == "poor fit").sum() <= binom.ppf(0.999, n, 0.01)
    assert matches.accepted.mean() > 0.75
    error = np.column_stack([matches.distance_m - image.views.distance_m, matches.delta_rad - image.views.delta_rad])
    assert (np.abs(error[matches.accepted, 0]) < GROSS_M).all()
    assert (np.abs(np.angle(np.exp(1j * error[matches.accepted, 1]))) < GROSS_RAD).all()


def test_a_landmark_beside_the_middle_is_matched_by_default_and_refused_where_the_bearing_is_fixed(thin_bank):
    bank = thin_bank("bracket", "pmd-16x16")
    frames = frames_of(bank, 1.1, 0.3, np.radians(2.5), seed=3, n_frames=20)
    assert Matcher(bank, "refine", free=("distance_m", "delta_rad")).match(frames)[0].reason == "poor fit"
    (match,) = Matcher(bank, "refine").match(frames)
    assert match.free == ("distance_m", "delta_rad", "bearing_rad")
    assert abs(match.bearing_rad - np.radians(2.5)) < 4 * np.sqrt(match.covariance[2, 2])
    assert abs(match.distance_m - 1.1) < 3 * np.sqrt(match.covariance[0, 0])


def test_refused_answers_say_why_and_claim_no_precision(panel):
    ranges = np.full((1, 1, 8, 8), 0.5)
    ranges[..., ::2] = 0.9
    matches = Matcher(panel, "refine").match(kalman_filter(Frames(ranges, sensor=panel.sensor)))
    assert not matches.accepted.any()
    assert matches.reason[0] in ("no landmark", "poor fit")
    assert matches[0].as_dict()["reason"] == matches.reason[0]
    shown = matches._repr_html_()
    assert "refused" in shown
    assert "±" not in shown
    accepted = dataclasses.replace(matches[0], accepted=True, reason="")
    assert "refused" not in accepted._repr_html_()


def test_sides_that_are_the_same_have_the_same_weight(tmp_path):
    # a table with four equal legs, and a bank that states no symmetry
    parts = [((0.3, 0.3, 0.02), (0, 0, 0.1))]
    parts += [((0.03, 0.03, 0.22), (x, y, 0)) for x in (-0.12, 0.12) for y in (-0.12, 0.12)]
    trimesh.boolean.union([box(*part) for part in parts]).export(tmp_path / "table.stl")
    arguments = ["bank", "build", "--mesh", f"table={tmp_path}/table.stl", "--unit", "m", "--origin", "center"]
    grid = ["--distance", "0.75:0.85:0.01", "--delta", "0:360:3", "--symmetry", "1", "--sensor", "vl53l5cx-8x8"]
    assert main([*arguments, *grid, "--out", str(tmp_path / "table.h5")]) == 0
    bank = open_bank(tmp_path / "table.h5")
    frames = frames_of(bank, 0.8, 0.3, seed=4, n_frames=20)
    (match,) = Matcher(bank, "refine", free=("distance_m", "delta_rad")).match(frames)
    assert match.reason == "ambiguous"
    angles = sorted([match.delta_rad, *(other.delta_rad for other in match.alternatives[:3])])
    np.testing.assert_allclose(np.diff(angles), np.pi / 2, atol=0.01)
    np.testing.assert_allclose([other.weight for other in match.alternatives[:3]], 0.25, atol=0.01)


def test_a_wall_is_estimated_behind_a_landmark_beside_the_middle():
    bank = build_bank(BankPlan(classes=("cylinder",), sensor="vl53l5cx-8x8", distance_m=NEAR), workers=1)
    view, wall = (0.713, np.radians(33.3), np.radians(3.0)), Background(wall_m=1.5)
    frames = frames_of(bank, *view, seed=4, n_frames=12, background=wall)
    (match,) = Matcher(bank, "refine", background="auto").match(frames)
    assert match.free == ("distance_m", "delta_rad", "bearing_rad")
    assert match.accepted
    assert match.distance_m == pytest.approx(0.713, abs=2e-3)
    assert np.degrees(match.delta_rad) == pytest.approx(33.3, abs=1.0)
    assert np.degrees(match.bearing_rad) == pytest.approx(3.0, abs=0.3)


def test_frames_that_all_their_pixels_explain_are_left_to_no_further_search(panel):
    """Two doubtful frames of one batch, both explained before the cells of the bank are descended in."""
    rng = np.random.default_rng(5)
    distance, delta = rng.uniform(0.8, 1.2, 40), np.radians(rng.uniform(15, 25, 40))
    frames = frames_of(panel, distance, delta, seed=5, background=Background(wall_m=2.5))[[3, 37]]
    fixed = ("distance_m", "delta_rad")
    together = Matcher(panel, "refine", free=fixed, background="auto", workers=1).match(frames)
    assert together.accepted.all()
    assert np.abs(together.distance_m - distance[[3, 37]]).max() < 0.03


@pytest.mark.soak
@pytest.mark.parametrize("n_frames", [1, 10])
@pytest.mark.parametrize("setting", SETTINGS)
@pytest.mark.parametrize("sensor", PRESETS)
@pytest.mark.parametrize("name", meshes())
def test_no_accepted_answer_on_thin_landmarks_is_grossly_wrong(thin_bank, name, sensor, setting, n_frames):
    found = count(thin_bank(name, sensor, FINE), setting, 100, n_frames, np.random.default_rng([len(name), n_frames]))
    print(f"{name} {sensor} {setting} {n_frames}: {found.right_accepted} of {found.right} right answers accepted")
    assert found.wrong_accepted == 0
