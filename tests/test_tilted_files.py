"""Pitch and roll in plans, frame sets, recordings, exports, commands and robot poses; level ones stay as they were."""

import json
import math

import h5py
import numpy as np
import pytest

from phasemark import UsageError
from phasemark.cli import main
from phasemark.data import FramePlan, build_frames, open_frames, read_frames
from phasemark.data.export import export_frames
from phasemark.data.measured.simulated import simulate_recording
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Match, robot_poses
from phasemark.render import Renderer, Views, preset

PMD = preset("pmd-16x16")
PLAN = FramePlan(
    classes=["cone", "post"],
    views=10,
    seed=3,
    distance_m={"uniform": [0.8, 1.2]},
    bearing_deg={"uniform": [-3, 3]},
    pitch_deg={"uniform": [-4, 4]},
    roll_deg={"normal": [0, 6], "within": [-12, 12]},
)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    with build_frames(PLAN, tmp_path_factory.mktemp("tilted") / "frames.h5") as opened:
        yield opened


def views_of(frames):
    truth = frames.truth
    names = ("distance_m", "delta_rad", "bearing_rad", "height_m", "pitch_rad", "roll_rad")
    return Views.broadcast(*(truth[name] for name in names))


def test_a_frame_set_holds_the_tilt_that_its_frames_were_rendered_with(frames):
    views = views_of(frames)
    assert np.ptp(np.degrees(views.pitch_rad)) > 3
    assert np.abs(np.degrees(views.roll_rad)).max() <= 12
    for k in range(len(views)):
        sample = frames[k]
        mesh = build_mesh(catalog()[sample["class_name"]])
        image = Renderer(mesh, frames.sensor).render_views(views[k : k + 1])
        np.testing.assert_allclose(sample["coverage"], image.coverage[0], atol=1e-6)
        assert sample["pitch_rad"] == views.pitch_rad[k]


def test_a_frame_set_of_a_level_camera_has_no_columns_of_tilt_and_reads_as_level(tmp_path):
    level = PLAN.model_copy(update={"pitch_deg": None, "roll_deg": None})
    assert not {"pitch_deg", "roll_deg"} & set(level.model_dump())
    with build_frames(level, tmp_path / "level.h5") as opened:
        assert not opened.truth["pitch_rad"].any()
        np.testing.assert_array_equal(opened[3]["roll_rad"], 0.0)
    with h5py.File(tmp_path / "level.h5") as file:
        assert not {"pitch", "roll"} & set(file)
    export_frames(open_frames(tmp_path / "level.h5"), tmp_path / "level.csv", "csv")
    assert "pitch" not in (tmp_path / "level.csv").read_text()


def test_other_quantities_are_drawn_as_without_tilt():
    level = PLAN.model_copy(update={"pitch_deg": None, "roll_deg": None}).resolve().draw_truth()
    tilted = PLAN.resolve().draw_truth()
    for name, values in level.items():
        if name not in ("pitch_deg", "roll_deg"):
            np.testing.assert_array_equal(values, tilted[name])


def test_poses_of_exports_have_the_tilt(frames, tmp_path):
    rotation, _ = views_of(frames).landmark2cam()
    folder = export_frames(frames, tmp_path / "bop", "bop")
    to_optical = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    poses = [
        np.array(entry[0]["cam_R_m2c"]).reshape(3, 3)
        for file in sorted(folder.glob("*/*/scene_gt.json"))
        for entry in json.loads(file.read_text()).values()
    ]
    expected = to_optical @ rotation
    assert len(poses) == len(expected)
    for pose in poses:  # by splits, not by number
        assert np.abs(expected - pose).max(axis=(1, 2)).min() < 1e-9
    text = export_frames(frames, tmp_path / "frames.csv", "csv").read_text()
    told = [line for line in text.splitlines() if line.startswith("# frame=")]
    degrees = [float(line.split("pitch_deg=")[1].split()[0]) for line in told]
    np.testing.assert_allclose(degrees, np.degrees(frames.truth["pitch_rad"]))


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("pitch_deg", {"uniform": [-100, 0]}, "'pitch_deg' must be within ± 90° throughout"),
        ("roll_deg", {"normal": [0, 5]}, "cut the normal's tails with 'within'"),
        ("roll_deg", "5", "'roll_deg' must be a number or a table"),
    ],
)
def test_tilts_that_no_plan_can_have_are_refused(key, value, words):
    with pytest.raises(UsageError, match=words):
        FramePlan(**{**PLAN.model_dump(), key: value})


def test_a_plan_whose_tilt_turns_the_landmark_out_of_the_image_is_refused(tmp_path):
    plan = FramePlan(**{**PLAN.model_dump(), "pitch_deg": 30.0})
    with pytest.raises(
        UsageError, match=r"view 0 of the plan cannot be rendered: a pitch of 30° and a roll of .* out of"
    ):
        build_frames(plan, tmp_path / "frames.h5")
    assert not list(tmp_path.iterdir())


def test_a_recording_renders_a_view_anew_when_its_tilt_alone_changes():
    mesh = build_mesh(catalog()["cone"])
    views = Views.broadcast(1.0, pitch_rad=[0.0, 0.06, 0.06], roll_rad=[0.0, 0.0, 0.2])
    taken = simulate_recording(mesh, "cone", preset("ideal"), views, seed=1).frames
    rendered = Renderer(mesh, preset("ideal")).render_views(views)
    seen = np.isfinite(taken.range_m[0]) & (rendered.coverage > 0.2)
    np.testing.assert_allclose(taken.range_m[0][seen], rendered.range_m[seen], atol=0.05)
    assert np.abs(rendered.coverage[1] - rendered.coverage[2]).max() > 0.1


def test_simulate_and_render_take_a_tilt_and_say_what_is_true(tmp_path, capsys):
    out = tmp_path / "r.npz"
    assert (
        main(["frames", "simulate", "-o", str(out), "--class", "cone", "--pitch", "3", "--roll", "-5", "--frames", "2"])
        == 0
    )
    with np.load(out) as file:
        np.testing.assert_allclose(file["truth_pitch_deg"], 3.0)
        np.testing.assert_allclose(file["truth_roll_deg"], -5.0)
    assert read_frames(out, sensor=PMD).n_frames == 2
    level = tmp_path / "level.npz"
    assert main(["frames", "simulate", "-o", str(level), "--class", "cone", "--frames", "2"]) == 0
    with np.load(level) as file:
        assert "truth_pitch_deg" not in file
    assert main(["render", "--class", "cone", "-o", str(tmp_path / "i.png"), "--pitch", "3", "--roll", "20"]) == 0
    with np.load(tmp_path / "i.npz") as file:
        image = Renderer(build_mesh(catalog()["cone"]), PMD).render(
            1.0, pitch_rad=math.radians(3), roll_rad=math.radians(20)
        )
        np.testing.assert_array_equal(file["phasor"], image.phasor[0])


@pytest.mark.parametrize(
    "command", [["render", "-o", "i.png"], ["frames", "simulate", "-o", "r.csv", "--frames", "2"]], ids=" ".join
)
@pytest.mark.parametrize(
    ("tilt", "words"),
    [
        (
            ["--pitch", "25"],
            "a pitch of 25° and a roll of 0° turn the landmark out of the image in view 0: at roll 0",
        ),
        (["--pitch", "-100"], "'pitch_rad' must be within"),
        (["--roll", "inf"], "'roll_rad' must be finite"),
    ],
)
def test_a_tilt_that_cannot_be_is_one_line(tmp_path, monkeypatch, capsys, command, tilt, words):
    monkeypatch.chdir(tmp_path)
    assert main([*command, "--class", "cone", *tilt]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert len(error.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_a_landmark_that_a_height_puts_out_of_the_level_view_may_be_pitched_into_it():
    renderer = Renderer(build_mesh(catalog()["cone"]), PMD)
    raised = Views.broadcast(1.0, height_m=0.5, pitch_rad=-math.atan(0.5))
    renderer.check_in_view(raised)
    assert renderer.render_views(raised).coverage.sum() > 50


def test_a_robot_stands_where_a_tilted_camera_sees_it_stand():
    free = ("distance_m", "delta_rad", "pitch_rad", "roll_rad")
    covariance = np.diag([1e-6, 1e-4, 1e-2, 1e-2])
    tilted = Match("cone", True, 1.0, 0.5, free=free, covariance=covariance, symmetry=2, pitch_rad=0.1, roll_rad=0.2)
    level = Match("cone", True, 1.0, 0.5, covariance=covariance[:2, :2], symmetry=2)
    for one, other in zip(robot_poses(tilted, (2.0, 1.0)), robot_poses(level, (2.0, 1.0)), strict=True):
        assert (one.x_m, one.y_m, one.heading_rad) == (other.x_m, other.y_m, other.heading_rad)
        np.testing.assert_array_equal(one.covariance, other.covariance)
