"""The learned baseline: its rays are what they are said to be, its table is counted right, and it learns."""

from __future__ import annotations

import importlib
import math
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from phasemark.render import Background, Body, Scene, SceneRenderer, preset, zones_from_depth

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
ZONES = preset("vl53l8cx-8x8")


@pytest.fixture(scope="module")
def baseline() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        return importlib.import_module("train_baseline")


def test_rays_meet_a_turned_plate_where_its_plane_is(baseline: ModuleType) -> None:
    angle = 0.3
    cos, sin = math.cos(angle), math.sin(angle)
    pose = np.array([[cos, -sin, 0, 1.0], [sin, cos, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1.0]])
    plate = Scene([Body.box((0.02, 0.3, 0.4), albedo=0.7, name="plate")])
    camera = np.eye(4)
    camera[:3, 3] = 0.2, 0.0, 0.1  # the plate's middle is 0.8 m ahead
    scene = SimpleNamespace(
        scene=plate, camera2world=camera[None], bodies2world=pose[None, None], background=Background(wall_m=2.0)
    )
    side = 32
    depth_m, (focal_px, _, middle_px, _), albedo, normals = baseline.depth_image(scene, ZONES, side)
    left, up = np.meshgrid((middle_px - np.arange(side)) / focal_px, (middle_px - np.arange(side)) / focal_px)
    assert left[0, 0] == pytest.approx(math.tan(math.radians(22.5)) * (1 - 1 / side))
    # the front face: (cos, sin) · (x, y) = 0.8 cos − 0.01, and its corners 0.15 m aside and 0.2 m up
    x = (0.8 * cos - 0.01) / (cos + sin * left)
    aside, above = cos * x * left - sin * (x - 0.8), x * up
    front = (np.abs(aside) < 0.149) & (np.abs(above) < 0.199)
    assert front.sum() > 100
    np.testing.assert_allclose(depth_m[front], x[front], rtol=1e-6)  # Embree computes in single precision
    np.testing.assert_allclose(normals[front], np.tile([sin, 0.0, -cos], (front.sum(), 1)), atol=1e-9)
    assert (albedo[front] == 0.7).all()
    past = (np.abs(aside) > 0.18) | (np.abs(above) > 0.21)
    assert (depth_m[past] == 2.0).all()
    assert (albedo[past] == 0.5).all()


def test_the_judge_sees_what_the_exact_renderer_sees(baseline: ModuleType) -> None:
    plan = baseline.plan_of("dock", 5, 3)
    sensor = plan.build_sensor()
    for index in (0, 4):
        scene = plan.source().placed(index)
        exact = SceneRenderer(scene.scene, sensor).phasors(scene.camera2world, scene.bodies2world, scene.background)
        side = baseline.JUDGE * sensor.cols
        depth_m, intrinsics, albedo, normals = baseline.depth_image(scene, sensor, side)
        zones = zones_from_depth(depth_m, intrinsics, sensor, albedo, normals)
        error = np.sqrt((np.abs(zones.images.phasor - exact.phasor) ** 2).mean()) / np.abs(exact.phasor).max()
        assert error < 2 * zones.discretisation_error[0] < 5e-3  # as the adapter promises of its estimate


def test_a_centre_ray_gives_the_depth_at_the_middle_of_its_zone(baseline: ModuleType) -> None:
    plan = baseline.plan_of("count", 6, 3)
    seen = baseline.frames_of_rays(plan)
    assert seen.distance_m.shape == (6, 8, 8)
    for index, distance_m in enumerate(seen.distance_m):
        scene = plan.source().placed(index)
        depth_m = baseline.depth_image(scene, ZONES, 8)[0]
        assert seen.labels["count"][index] == scene.labels["count"][0]
        assert np.nanmax(np.abs(distance_m - depth_m)) < 0.06  # five standard deviations of a zone on the floor
        assert np.isfinite(distance_m).mean() > 0.9
    exact = baseline.exact_frames(plan)
    assert (exact.labels["count"] == seen.labels["count"]).all()
    both = np.isfinite(exact.distance_m) & np.isfinite(seen.distance_m)
    alike = np.abs(exact.distance_m - seen.distance_m)[both] < 0.1
    assert 0.6 < alike.mean() < 0.999  # the same scenes, but for zones that see two bodies


def test_scenes_that_judge_are_no_scenes_that_were_learnt(baseline: ModuleType) -> None:
    learnt, judge = (baseline.plan_of("count", 20, seed).source() for seed in (7, 8))
    poses = [{learnt.placed(k).bodies2world.tobytes() for k in range(20)}]
    poses.append({judge.placed(k).bodies2world.tobytes() for k in range(20)})
    nobody = {learnt.placed(k).bodies2world.tobytes() for k in range(20) if learnt.placed(k).labels["count"][0] == 0}
    assert poses[0] & poses[1] <= nobody


def test_numbers_of_the_table_are_those_of_known_answers(baseline: ModuleType) -> None:
    seen = baseline.Seen(np.zeros((100, 8, 8)), {"count": np.zeros(100)})
    answers = np.eye(5)[(np.arange(100) >= 60).astype(int)]
    (accuracy,) = baseline.scores("count", answers, seen, None).values()
    assert str(accuracy) == "0.600 [0.502, 0.691]"  # Wilson, by the textbook
    distance_m, delta_rad = np.linspace(0.9, 1.6, 50), np.linspace(0.0, 6.2, 50)
    bound = np.column_stack([np.full(50, 0.002), np.full(50, 0.01)])
    dock = baseline.Seen(np.zeros((50, 16, 16)), {"distance_m": distance_m, "delta_rad": delta_rad})
    said = {"distance_m": distance_m + 0.004, "delta_rad": delta_rad + math.pi - 0.03}  # half a turn is no error
    found = baseline.scores("dock", baseline.targets_of("dock", baseline.Seen(dock.distance_m, said)), dock, bound)
    assert [found[name].value for name in ("D / bound", "δ / bound")] == pytest.approx([2.0, 3.0], rel=1e-3)
    assert [found[name].value for name in ("D, mm", "δ, °")] == pytest.approx([4.0, math.degrees(0.03)], rel=1e-3)


def test_the_bound_of_a_dock_is_that_of_its_own_view(baseline: ModuleType) -> None:
    labels = {"distance_m": np.array([1.0, 1.6]), "delta_rad": np.array([0.5, 0.5]), "bearing_rad": np.zeros(2)}
    near, far = baseline.bound_of_dock(baseline.Seen(np.zeros((2, 16, 16)), labels))
    assert 2e-4 < near[0] < far[0] < 5e-3
    assert 1e-3 < near[1] < far[1] < 0.1


def test_without_pytorch_the_example_says_what_to_install(
    baseline: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    assert baseline.main(["count"]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert "pip install -e '.[learn]'" in err


def test_people_are_counted_after_a_short_training(baseline: ModuleType) -> None:
    pytest.importorskip("torch")
    learnt, judge = (baseline.frames_of_rays(baseline.plan_of("count", n, seed)) for n, seed in ((200, 7), (60, 8)))
    answers = baseline.train("count", learnt, epochs=12, seed=1)
    assert answers.weights < 200_000
    found = baseline.scores("count", answers(judge.distance_m), judge, None)["accuracy"]
    assert found.low > 0.3  # one in five by chance
    again = baseline.train("count", learnt, epochs=12, seed=1)
    np.testing.assert_array_equal(again(judge.distance_m), answers(judge.distance_m))


@pytest.mark.parametrize("task", ["count", "dock"])
def test_the_table_has_a_line_for_each_training_and_judge(
    baseline: ModuleType, task: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch")
    assert baseline.main([task, "--train", "24", "--judged", "8", "--epochs", "1"]) == 0
    head, *table = capsys.readouterr().out.splitlines()
    assert head.endswith("weights")
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    assert cells[0][2:] == (["accuracy"] if task == "count" else ["D, mm", "D / bound", "δ, °", "δ / bound"])
    assert [row[:2] for row in cells[2:]] == [
        [learnt, judge] for learnt in ("exact frames", "centre rays") for judge in ("the same kind", "another renderer")
    ]
