"""Results as plain numbers and as one line are made by their classes: commands add the names of files alone."""

import ast
import json
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh

import phasemark
from phasemark.data import BankPlan, FramePlan, build_bank, build_frames
from phasemark.landmarks import build_mesh, catalog, check_mesh
from phasemark.matcher import Match, Matcher, robot_poses
from phasemark.matcher.position.robot_pose import RobotPose
from phasemark.matcher.sweep.compare import Difference
from phasemark.matcher.sweep.plan import Condition
from phasemark.render import Background, Renderer, Views, preset

ROOT = Path(phasemark.__file__).parent


def test_a_robot_pose_is_plain_numbers_in_degrees():
    pose = RobotPose(1.0, 2.0, np.pi / 2, (0.0, 0.0), 0.0, 0.0, 0.0)
    expected = {
        "x_m": 1.0, "y_m": 2.0, "heading_deg": 90.0, "std": None, "covariance": None, "mahalanobis": None
    }  # fmt: skip
    assert pose.as_dict() == expected
    known = RobotPose(1.0, 2.0, 0.0, (0.0, 0.0), 0.0, 0.0, 0.0, np.diag([4.0, 9.0, np.radians(3) ** 2]), 1.5)
    found = json.loads(json.dumps(known.as_dict(), allow_nan=False))
    np.testing.assert_allclose(list(found["std"].values()), [2, 3, 3])
    assert found["mahalanobis"] == 1.5


def test_all_angles_of_a_match_and_a_robot_pose_are_degrees():
    std = np.array([0.001, np.radians(2.0), np.radians(3.0)])
    match = Match(
        "cone", True, 1.0, np.radians(30.0), np.radians(-4.0), free=("distance_m", "delta_rad", "bearing_rad"),
        covariance=np.diag(std**2), systematic={"declared": np.diag(std**2)},
        weak_direction={"distance_m": 0.001, "delta_rad": np.radians(2.0)}, background=Background(floor_m=0.4),
    )  # fmt: skip
    found = json.loads(json.dumps(match.as_dict(), allow_nan=False))
    assert found["free"] == ["distance_m", "delta_deg", "bearing_deg"]
    assert [found[name] for name in found["free"]] == pytest.approx([1.0, 30.0, -4.0])
    for matrix in (found["covariance"], found["systematic"]["declared"]):
        np.testing.assert_allclose(np.sqrt(np.diag(matrix)), [0.001, 2.0, 3.0])
    assert found["weak_direction"] == pytest.approx({"distance_m": 0.001, "delta_deg": 2.0})
    assert (found["wall_m"], found["floor_m"]) == (None, 0.4)
    assert not [key for key in found if key.endswith("_rad")]
    pose = RobotPose(1.0, 2.0, 0.0, (0.0, 0.0), 0.0, 0.0, 0.0, np.diag([4.0, 9.0, np.radians(3) ** 2])).as_dict()
    np.testing.assert_allclose(np.sqrt(np.diag(pose["covariance"])), list(pose["std"].values()))


def test_a_difference_of_two_sweeps_has_no_nan():
    condition = Condition("cone", 1.0, 0.0)
    found = Difference(condition, "nearest", "nees", float("nan"), 1.0, float("inf"), False).as_dict()
    assert (found["first"], found["second"], found["p_value"], found["significant"]) == (None, 1.0, None, False)
    assert found["condition"]["class_name"] == "cone"
    json.dumps(found, allow_nan=False)


def test_a_sensor_has_its_unambiguous_range_besides_its_fields():
    sensor = preset("pmd-16x16")
    assert sensor.as_dict() == {**sensor.model_dump(mode="json"), "unambiguous_range_m": sensor.unambiguous_range_m}


def test_an_open_mesh_is_checked_and_has_no_volume(run, tmp_path):
    mesh = trimesh.creation.box((0.2, 0.2, 0.2))
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    assert check_mesh(mesh).as_dict()["volume_m3"] is None
    mesh.export(tmp_path / "open.stl")
    code, out, _ = run("landmark", "check", tmp_path / "open.stl", "--unit", "m", "--json")
    assert (code, json.loads(out)["volume_m3"]) == (0, None)


def test_no_command_makes_plain_numbers_of_an_object_for_json():
    """What is given to echo_json comes from as_dict, a plan, or names of files."""
    for path in ROOT.glob("*/commands/*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "echo_json":
                called = {getattr(one.func, "attr", getattr(one.func, "id", "")) for one in ast.walk(node.args[0])
                          if isinstance(one, ast.Call)}  # fmt: skip
                assert called <= {"as_dict", "items", "get", "model_dump", "str", "plan_schema", "values"}, path


@pytest.fixture(scope="module")
def bank():
    return build_bank(BankPlan(classes=("cone",), distance_m="0.9:1.1:0.1", delta_deg="0:180:60"))


def test_a_sensor_says_pixels_view_and_modulation():
    assert repr(preset("pmd-16x16")) == str(preset("pmd-16x16")) == "Sensor(16 × 16 pixels, 22° × 22°, 10 MHz)"
    assert repr(preset("vl53l5cx-8x8")) == "Sensor(8 × 8 pixels, 45° × 45°, direct, up to 4 m)"
    two = preset("pmd-16x16").with_(modulation_hz=(10e6, 15e6))
    assert repr(two) == "Sensor(16 × 16 pixels, 22° × 22°, 10 + 15 MHz)"


def test_views_say_how_many_and_over_what():
    assert repr(Views.broadcast([1.0, 1.5], 0.0)) == "Views(2: D 1 … 1.5 m, δ 0°)"
    tilted = Views.broadcast(1.0, math.pi / 2, 0.1, pitch_rad=0.2)
    assert repr(tilted) == "Views(1: D 1 m, δ 90°, bearing 5.73°, pitch 11.46°)"
    assert repr(Views.broadcast([], [])) == "Views(0)"


def test_a_renderer_says_landmark_and_camera():
    renderer = Renderer(build_mesh(catalog()["post"]), preset("pmd-16x16"), albedo=0.5)
    assert repr(renderer).startswith("Renderer(24 × 16 × 30 cm, ")
    assert repr(renderer).endswith(" faces, albedo 0.5, Sensor(16 × 16 pixels, 22° × 22°, 10 MHz))")
    assert repr(Renderer(None, preset("ideal"))).startswith("Renderer(no landmark, Sensor(")


def test_a_robot_pose_says_where_and_how_surely():
    match = Match(
        "cone", True, distance_m=1.0, delta_rad=0.5, free=("distance_m", "delta_rad"),
        covariance=np.diag([1e-6, 1e-6]), symmetry=1,
    )  # fmt: skip
    (pose,) = robot_poses(match, (2.0, 1.0))
    assert repr(pose) == "RobotPose(x 1.1224 ± 0.001 m, y 0.5206 ± 0.001 m, heading 28.65 ± 0.057°)"
    (bare,) = robot_poses(Match("cone", True, distance_m=1.0, delta_rad=0.5, symmetry=1), (2.0, 1.0))
    assert repr(bare) == "RobotPose(x 1.1224 m, y 0.5206 m, heading 28.65°)"


def test_a_bank_and_its_matcher_say_classes_grid_and_options(bank):
    held = "cone; D 0.9 … 1.1 m × 3, δ 0 … 120° × 3, factored, pmd-16x16)"
    assert repr(bank).startswith("Bank(")
    assert repr(bank).endswith(held)
    matcher = Matcher(bank, "refine", background=Background(wall_m=3.0))
    assert repr(matcher).startswith("Matcher(refine, background=Background(wall_m=3.0")
    assert repr(matcher).endswith(held + ")")
    assert repr(Matcher(bank)) == f"Matcher(nearest, {bank!r})"
    some = Matcher(bank, "refine", free=("distance_m", "delta_rad"), pixels="lower")
    assert repr(some) == f"Matcher(refine, free=('distance_m', 'delta_rad'), pixels='lower', {bank!r})"
    bank.close()
    assert repr(bank).endswith(held)  # a closed bank has a name too


def test_a_frame_set_says_frames_views_and_classes(tmp_path):
    plan = FramePlan(classes=("cone",), views=3, frames_per_view=2, seed=1)
    frames = build_frames(plan, tmp_path / "set.h5")
    text = repr(frames)
    assert text.startswith("FrameSet(set.h5: 6 frames of 3 views; cone; D ")
    assert text.endswith(" m, pmd-16x16)")
    assert "\n" not in text
