"""Diagnosis of a refused match: the change that undoes what was done to a frame, and none without a landmark."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from builders import strangers

from phasemark import UsageError
from phasemark.cli import main
from phasemark.data import BankPlan, build_bank
from phasemark.data.commands.options import FrameReading
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher, diagnose, kalman_filter
from phasemark.matcher.commands.diagnosis_flags import diagnosis_text
from phasemark.matcher.diagnosis import Change, Diagnosis
from phasemark.matcher.diagnosis.search import pooled_evidence
from phasemark.matcher.filters.filtered_frames import PixelState
from phasemark.matcher.likelihood.background_estimate import estimate_surroundings
from phasemark.matcher.match import Candidate, Match
from phasemark.render import Background, Frames, Renderer, capture, preset

PRESETS = ("vl53l5cx-8x8", "pmd-16x16")
WALL = Background(wall_m=3.0)
CONE_VIEW = (1.013, 0.7)
ARRAYS = ("range_m", "std_m", "amplitude_e", "intensity_e", "state", "n_effective")


@pytest.fixture(scope="module")
def banks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("diagnosis")
    plans = {name: BankPlan(sensor=name, classes=("cone",), distance_m="0.9:1.1:0.01") for name in PRESETS}
    opened = {name: build_bank(plan, folder / f"{name}.h5") for name, plan in plans.items()}
    yield opened
    for bank in opened.values():
        bank.close()


def frames_of(name, *view, sensor=None, background=None, mesh=None):
    """Return the filtered frame of 50 exposures of the cone, or of another landmark."""
    renderer = Renderer(mesh or build_mesh(catalog()["cone"]), sensor or preset(name), albedo=0.8)
    image = renderer.render(*view, background=background)
    return kalman_filter(capture(image, renderer.sensor, rng=np.random.default_rng(1), n_frames=50))


def frames_of_another_field(size, *view):
    """Return the frame of a camera with a field of view `size` times as wide, read as that of the usual one, and it."""
    sensor = preset("pmd-16x16")
    angles = {name: size * getattr(sensor, name) for name in ("half_angle_h_deg", "half_angle_v_deg")}
    other = sensor.with_(**angles)
    return replace(frames_of("pmd-16x16", *view, sensor=other), sensor=sensor), other


def diagnosis_of(bank, frames, background=None):
    return diagnose(
        Matcher(bank, "refine", free=("distance_m", "delta_rad"), background=background), frames, seconds=math.inf
    )


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("bearing_deg", [-3.1, 1.2])
def test_a_landmark_off_to_a_side_is_diagnosed_with_its_bearing(banks, name, bearing_deg):
    found = diagnosis_of(banks[name], frames_of(name, *CONE_VIEW, math.radians(bearing_deg)))
    assert found.enough_alone
    assert found.changes[0].parameter in ("free", "bearing_offset_deg")
    assert found.match.accepted
    assert math.degrees(found.match.bearing_rad) == pytest.approx(bearing_deg, abs=0.3)  # five standard deviations
    assert f"bearing {'' if found.changes[0].parameter == 'free' else 'of '}" in str(found)


def test_a_single_frame_of_a_direct_sensor_is_searched_with_the_noise_of_its_law():
    sensor = preset("vl53l5cx-8x8")
    image = Renderer(build_mesh(catalog()["cone"]), sensor, albedo=0.8).render(*CONE_VIEW)
    frame = kalman_filter(capture(image, sensor, rng=np.random.default_rng(1), n_frames=1))
    weight = pooled_evidence(frame).weight[0]
    assert (weight > 0).any()
    assert np.median(weight[weight > 0] ** -0.5) == pytest.approx(sensor.range_std_m)


@pytest.mark.parametrize("name", PRESETS)
def test_a_wall_that_was_not_announced_is_found(banks, name):
    found = diagnosis_of(banks[name], frames_of(name, *CONE_VIEW, background=WALL))
    assert [change.parameter for change in found.changes] == ["background"]
    assert found.match.background.wall_m == pytest.approx(3.0, abs=5e-3)


@pytest.mark.parametrize("name", PRESETS)
def test_a_wall_that_is_not_there_is_found(banks, name):
    found = diagnosis_of(banks[name], frames_of(name, *CONE_VIEW), WALL)
    assert [(change.parameter, change.value) for change in found.changes] == [("background", None)]


@pytest.mark.parametrize("name", PRESETS)
def test_an_image_upside_down_is_found_and_that_a_half_turn_would_do_as_well(banks, name):
    # the landmark has a plane of symmetry: mirrored left to right it is the same seen from the other side
    found = diagnosis_of(banks[name], frames_of(name, *CONE_VIEW).with_pixels(lambda a: a[..., ::-1, :]))
    assert [change.parameter for change in found.changes] == ["flip_v"]
    assert [(change.parameter, change.value) for change in found.alternatives] == [("rotate", 180)]


@pytest.mark.parametrize("name", PRESETS)
def test_a_wrong_unit_and_a_wrong_quantity_are_found(banks, name):
    frames = frames_of(name, *CONE_VIEW)
    small = replace(frames, range_m=frames.range_m / 1000)
    if frames.std_from_scatter:
        small = replace(small, std_m=frames.std_m / 1000)
    for changed, expected in (
        (small, ("unit_factor", 1000.0)),
        (replace(frames, range_m=frames.range_m * frames.sensor.axis_cosine()), ("quantity", "z")),
        (replace(frames, range_m=frames.range_m / frames.sensor.axis_cosine()), ("quantity", "range")),
    ):
        found = diagnosis_of(banks[name], changed)
        assert [(change.parameter, change.value) for change in found.changes] == [expected]


def test_another_field_of_view_is_found_with_its_angle(banks):
    frames, wide = frames_of_another_field(1.12, *CONE_VIEW)
    found = diagnosis_of(banks["pmd-16x16"], frames)
    assert [change.parameter for change in found.changes] == ["half_angle_deg"]
    # a field of view 0.5 % wider does not show in chi2; 1.5 % allows for the noise
    assert found.changes[0].value[0] == pytest.approx(wide.half_angle_h_deg, rel=0.015)


@pytest.mark.soak
def test_another_field_of_view_is_found_where_the_pan_is_not_exact(banks):
    frames, _ = frames_of_another_field(0.88, *CONE_VIEW, math.radians(0.5))
    found = diagnose(Matcher(banks["pmd-16x16"], "refine"), frames, seconds=math.inf)
    assert "half_angle_deg" in [change.parameter for change in (*found.changes, *found.alternatives)]


@pytest.mark.parametrize("distance_m", [0.7, 1.4])
def test_a_landmark_outside_the_bank_is_found_at_its_distance(banks, distance_m):
    found = diagnosis_of(banks["pmd-16x16"], frames_of("pmd-16x16", distance_m, 0.7))
    assert [change.parameter for change in found.changes] == ["distance_m"]
    assert found.changes[0].value == pytest.approx(distance_m, abs=3e-3)  # five standard deviations


@pytest.mark.parametrize(
    ("parameter", "value"),
    [("pitch_rad", -0.052), ("height_m", 0.03), pytest.param("roll_rad", 0.07, marks=pytest.mark.soak)],
)
def test_a_tilted_or_lifted_camera_is_diagnosed_with_what_was_not_free(banks, parameter, value):
    view = {"height_m": 0.0, "pitch_rad": 0.0, "roll_rad": 0.0, parameter: value}
    found = diagnosis_of(banks["pmd-16x16"], frames_of("pmd-16x16", *CONE_VIEW, 0.0, *view.values()))
    (change,) = [one for one in (*found.changes, *found.alternatives) if parameter in one.value]
    assert change.parameter == "free"
    assert change.words.startswith(f"the {parameter.split('_')[0]} free (")
    if change == found.changes[0]:
        assert getattr(found.match, parameter) == pytest.approx(value, abs=5e-3)


def test_a_thing_beside_the_landmark_is_diagnosed_as_unknown(banks):
    frames = frames_of("pmd-16x16", *CONE_VIEW)
    for name in ARRAYS:
        if (values := getattr(frames, name)) is not None:
            values[..., :3] = values[0, 12, 8]
    frames.range_m[..., :3] = 0.8
    found = diagnosis_of(banks["pmd-16x16"], frames)
    assert [(change.parameter, change.value) for change in found.changes] == [("background", "unknown")]
    assert found.match.distance_m == pytest.approx(CONE_VIEW[0], abs=5e-3)


def test_a_landmark_that_fits_among_missing_pixels_is_diagnosed_with_what_they_mean(banks):
    frames = frames_of("pmd-16x16", *CONE_VIEW)
    dark = frames.state == PixelState.NO_RETURN
    missing = replace(frames, state=np.where(dark, PixelState.MISSING, frames.state).astype(np.uint8))
    matcher = Matcher(banks["pmd-16x16"], "refine", background="unknown")
    found = diagnose(matcher, missing, seconds=math.inf)
    assert [(change.parameter, change.value) for change in found.changes] == [("invalid_means", "no-return")]
    assert found.match.distance_m == pytest.approx(CONE_VIEW[0], abs=5e-3)
    assert str(found).endswith("it fits with invalid pixels taken for no returns: invalid_means='no-return'")


def test_a_landmark_whose_surface_goes_on_beside_it_is_said_to_fit_and_not_to_end(banks):
    frames = frames_of("vl53l5cx-8x8", *CONE_VIEW)
    for row in range(frames.sensor.rows):
        seen = np.flatnonzero(frames.state[0, row] == PixelState.RETURN)
        for values in (getattr(frames, name) for name in ARRAYS if seen.size):
            if values is not None:
                row_of = values[0, row]
                row_of[: seen[0]], row_of[seen[-1] + 1 :] = row_of[seen[0]], row_of[seen[-1]]
    matcher = Matcher(banks["vl53l5cx-8x8"], "refine", background="unknown")
    found = diagnose(matcher, frames, seconds=math.inf)
    assert found.changes == ()
    assert "cone fits, but the pixels beside it do not show where it ends" in str(found)


@pytest.mark.parametrize(
    ("name", "shape"), [(PRESETS[0], "cube"), pytest.param(PRESETS[1], "slab", marks=pytest.mark.soak)]
)
def test_nothing_is_recommended_for_a_landmark_that_is_not_in_the_bank(banks, name, shape):
    found = diagnosis_of(banks[name], frames_of(name, 1.0, 0.5, 0.02, mesh=strangers()[shape]))
    assert found.changes == ()
    assert found.match is None
    assert "another landmark" in str(found)


@pytest.mark.parametrize("background", [None, Background(wall_m=1.5)])
def test_nothing_is_recommended_for_a_scene_without_a_landmark(banks, background):
    sensor = preset("vl53l5cx-8x8")
    image = Renderer(None, sensor).render(1.0, background=background)
    frames = kalman_filter(capture(image, sensor, rng=np.random.default_rng(1), n_frames=50))
    assert diagnosis_of(banks["vl53l5cx-8x8"], frames).changes == ()


def test_a_diagnosis_stops_when_time_is_up_and_its_message_tells(banks):
    bank = banks["vl53l5cx-8x8"]
    ranges = np.full((1, 1, 8, 8), 0.6)
    ranges[..., ::2] = 1.3
    found = diagnose(Matcher(bank, "refine"), kalman_filter(Frames(ranges, sensor=bank.sensor)), seconds=0.0)
    assert found.stopped
    assert "time was up" in str(found)
    assert found.as_dict()["stopped"]


def test_a_frame_whose_answer_is_known_is_not_matched_again(banks, monkeypatch):
    matcher = Matcher(banks["vl53l5cx-8x8"], "refine")
    ranges = np.full((1, 1, 8, 8), 0.6)
    ranges[..., ::2] = 1.3
    frames = kalman_filter(Frames(ranges, sensor=matcher.bank.sensor))
    (answer,) = matcher.match(frames)
    monkeypatch.setattr(matcher, "match", lambda frames: pytest.fail("it was matched again"))
    assert diagnose(matcher, frames, seconds=0.0, refused=answer).refused is answer


def test_an_accepted_frame_has_nothing_to_diagnose(banks):
    with pytest.raises(UsageError, match="is accepted"):
        diagnosis_of(banks["pmd-16x16"], frames_of("pmd-16x16", *CONE_VIEW))


@pytest.mark.parametrize(
    ("options", "flag"),
    [
        (["--method", "refine", "--fix", "bearing"], ": --free bearing instead of --fix bearing"),
        (["--method", "nearest"], "--method refine --free"),
    ],
)
def test_the_command_names_the_option_that_makes_a_refused_frame_fit(banks, tmp_path, capsys, options, flag):
    image = Renderer(build_mesh(catalog()["cone"]), preset("pmd-16x16"), albedo=0.8).render(
        *CONE_VIEW, math.radians(2.1)
    )
    frames = capture(image, image.sensor, rng=np.random.default_rng(1), n_frames=50)
    np.savez(tmp_path / "frames.npz", range=frames.range_m, unit="m", quantity="range",
             amplitude=np.nan_to_num(frames.amplitude_e), intensity=frames.intensity_e, valid=frames.valid)  # fmt: skip
    arguments = ["match", str(banks["pmd-16x16"].path), str(tmp_path / "frames.npz"), "--invalid-means", "no-return"]
    assert main([*arguments, *options, "--json"]) == 0
    done = capsys.readouterr()
    (note,) = done.err.splitlines()
    assert note.startswith("note: frame 0 is refused (")
    assert "bearing 2" in note
    assert flag in note
    (answer,) = json.loads(done.out)["matches"]
    assert answer["diagnosis"]["changes"][0]["parameter"] == "free"
    if "nearest" in options:  # the same of every method, and this one is fast
        assert main([*arguments, *options, "--json", "--no-diagnosis"]) == 0
        done = capsys.readouterr()
        assert done.err == ""
        assert "diagnosis" not in json.loads(done.out)["matches"][0]


@pytest.mark.parametrize(
    ("option", "told"), [("missing", "--invalid-means no-return"), ("no-return", "frames that flag them so")]
)
def test_the_command_names_what_invalid_pixels_mean(option, told):
    change = Change("invalid_means", "no-return", "invalid pixels taken for no returns")
    refused = Match("cone", False, 1.0, 0.5, chi2=3.0, dof=20, reason="poor fit")
    found = Diagnosis(0, refused, (change,), n_returned=9)
    assert diagnosis_text(found, FrameReading(invalid_means=option), False, False).endswith(f"no returns: {told}")


def test_a_diagnosis_that_fails_loses_no_answer(tmp_path, capsys, monkeypatch):
    def fails(*_, **__):
        raise UsageError("no images")

    monkeypatch.setattr("phasemark.matcher.diagnose", fails)
    trimesh.creation.box((0.01, 4.0, 4.0)).export(tmp_path / "panel.stl")
    panel = MeshPlan(name="panel", path=str(tmp_path / "panel.stl"), unit="m")
    grid = {"distance_m": "0.4:1.0:0.2", "delta_deg": "-60:60:20", "layout": "full"}
    build_bank(BankPlan(sensor="vl53l5cx-8x8", meshes=(panel,), **grid), tmp_path / "bank.h5").close()
    ranges = np.random.default_rng(1).uniform(0.2, 2.0, (8, 8))
    np.savez(tmp_path / "frames.npz", range=ranges, unit="m", quantity="range")
    estimates = tmp_path / "estimates.csv"
    arguments = ["match", str(tmp_path / "bank.h5"), str(tmp_path / "frames.npz"), "--wall", "1.2"]
    arguments += ["--method", "nearest"]
    assert main([*arguments, "--json", "--estimates", str(estimates)]) == 0
    done = capsys.readouterr()
    (answer,) = json.loads(done.out)["matches"]
    assert not answer["accepted"]
    assert len(estimates.read_text().splitlines()) == 2
    *_, note = done.err.splitlines()
    assert note.startswith("note: frame 0 is refused, and its diagnosis failed (UsageError: no images)")


def test_pixels_without_a_known_noise_are_no_floor():
    """Pixels that returned nothing have an infinite standard deviation."""
    ranges = np.where(np.arange(64).reshape(8, 8) % 3, np.random.default_rng(1).uniform(0.2, 2.0, (8, 8)), np.nan)
    frames = kalman_filter(Frames(ranges[None, None], sensor=preset("vl53l5cx-8x8")))
    assert estimate_surroundings(frames).background.floor_m is None


def test_what_a_landmark_in_few_pixels_leaves_open_is_said():
    # 3 σ are three times the roots of the diagonal
    wide = np.diag([0.02, math.radians(4.0)]) ** 2
    open_view = Match("cone", False, 1.0, 0.5, covariance=wide, chi2=3.0, dof=2, reason="undetermined")
    assert Diagnosis(3, open_view, n_returned=9).message() == (
        "frame 3 is refused (undetermined, chi2/dof 1.5): it shows cone, in too few pixels to place it"
        " (3 σ of D 0.06 m, of δ 12°): go nearer, or take more exposures"
    )
    # an explanation a degree away is the same, a quarter turn is another, and half a turn of a box is none
    turns = [math.radians(angle) for angle in (1.0, 180.0, 90.0)]
    others = tuple(Candidate("cone", 1.0, 0.5 + turn, 3.0, 0.1) for turn in turns)
    twofold = Match("cone", False, 1.0, 0.5, alternatives=others, symmetry=2, reason="ambiguous")
    assert Diagnosis(0, twofold, n_returned=9).message() == (
        "frame 0 is refused (ambiguous): it may show cone at 1.000 m and 28.6° or cone at 1.000 m and 118.6°;"
        " nearer, or with more exposures, it may tell"
    )
