"""What objects print of themselves: one line that says what matters."""

import math

import numpy as np
import pytest

from phasemark.data import BankPlan, FramePlan, build_bank, build_frames
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Match, Matcher, robot_poses
from phasemark.render import Background, Renderer, Views, preset


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
