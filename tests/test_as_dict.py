"""Results as plain numbers are made by their classes: commands add the names of files, and nothing else."""

import ast
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

import phasemark
from phasemark.cli import main
from phasemark.landmarks import check_mesh
from phasemark.matcher import Match
from phasemark.matcher.position.robot_pose import RobotPose
from phasemark.matcher.sweep.compare import Difference
from phasemark.matcher.sweep.plan import Condition
from phasemark.render import Background, preset

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


def test_an_open_mesh_is_checked_and_has_no_volume(tmp_path, capsys):
    mesh = trimesh.creation.box((0.2, 0.2, 0.2))
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    assert check_mesh(mesh).as_dict()["volume_m3"] is None
    mesh.export(tmp_path / "open.stl")
    assert main(["landmark", "check", str(tmp_path / "open.stl"), "--unit", "m", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["volume_m3"] is None


def test_no_command_makes_plain_numbers_of_an_object_for_json():
    """What is given to echo_json comes from as_dict, a plan, or names of files."""
    for path in ROOT.glob("*/commands/*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "echo_json":
                called = {getattr(one.func, "attr", getattr(one.func, "id", "")) for one in ast.walk(node.args[0])
                          if isinstance(one, ast.Call)}  # fmt: skip
                assert called <= {"as_dict", "items", "get", "model_dump", "str", "plan_schema", "values"}, path
