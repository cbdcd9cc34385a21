"""The pose of an object from simulated histograms: error over bound, honest covariance, refusal."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from oracles.simple_scenes import block_on_table, poses_around
from scipy.stats import chi2, norm

from phasemark import UsageError
from phasemark.matcher.histograms.object_pose import match_jointly
from phasemark.matcher.histograms.pose_errors import NO_ERRORS
from phasemark.matcher.histograms.pose_evidence import Evidence, evidence_of, solve_jointly
from phasemark.matcher.histograms.scene_prediction import POSE_PARAMETERS, ObjectScene
from phasemark.matcher.statistics import nees
from phasemark.render import preset
from phasemark.render.direct.bin_counts import piled_up
from phasemark.render.direct.histogram_frames import HistogramFrames, capture_histograms

FREE = ("x_m", "z_m", "yaw_rad")
TRUTH = np.array([0.002, 0.0, -0.001, 0.0, 0.0, 0.03])
SUPPORT = 0.6


SENSOR = preset("tmf8820-3x3")
DIM = SENSOR.with_(histogram={**SENSOR.histogram.model_dump(), "cycles": 3e5})
"""A tenth of its pulses; with a hundredth the turn is so uncertain that slopes change."""
SCENE, DIM_SCENE = (ObjectScene(block_on_table(), sensor) for sensor in (SENSOR, DIM))
WHERE = [POSE_PARAMETERS.index(name) for name in FREE]


def expected_at(scene: ObjectScene, poses: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    h = scene.histogram
    counts = scene.signal(poses, displacement, SUPPORT) * 0.5 + h.cycles * (h.ambient + h.dark)
    return piled_up(counts, h.cycles)


def exact(scene: ObjectScene, poses: np.ndarray, displacement: np.ndarray) -> HistogramFrames:
    mean = expected_at(scene, poses, displacement)
    return HistogramFrames(mean.reshape(-1, 1, 3, 3, 128), sensor=scene.sensor)


def evidence_at(
    scene: ObjectScene, poses: np.ndarray, displacement: np.ndarray, frames: HistogramFrames | None = None
) -> Evidence:
    frames = exact(scene, poses, displacement) if frames is None else frames
    return evidence_of(scene.linearise(frames, poses, displacement, SUPPORT, FREE), frames.zone_counts)


def judge(n: int, seed: int) -> tuple[np.ndarray, float]:
    """Return RMSE over bound for each parameter, and the mean NEES over its dimension, of n simulated matches."""
    poses, rng = poses_around(2), np.random.default_rng(seed)
    drawn = capture_histograms(expected_at(DIM_SCENE, poses, TRUTH), DIM, rng=rng, n_frames=n)
    start = TRUTH + np.array([0.001, 0, 0.001, 0, 0, 0.01])
    found = [
        match_jointly(
            HistogramFrames(drawn.counts[:, k : k + 1], sensor=DIM), poses, DIM_SCENE, start=start, free=FREE,
            support=SUPPORT, errors=NO_ERRORS,
        )
        for k in range(n)
    ]  # fmt: skip
    errors = np.array([one.displacement[WHERE] - TRUTH[WHERE] for one in found])
    _, bound = solve_jointly(evidence_at(DIM_SCENE, poses, TRUTH))
    ratio = np.sqrt((errors**2).mean(axis=0) / np.diag(bound))
    return ratio, float(nees(errors, np.array([one.covariance for one in found])).mean() / len(FREE))


def test_error_is_at_the_bound_and_the_covariance_is_honest() -> None:
    n, sides = 30, norm.isf(0.0005 / 4)
    ratio, mean_nees = judge(n, seed=41)
    assert (np.abs(ratio - 1) < sides / np.sqrt(2 * n) + 0.02).all()  # 0.02: second order in the noise
    assert abs(mean_nees - 1) < sides * np.sqrt(2 / (n * len(FREE))) + 0.03


@pytest.mark.soak
def test_error_over_bound_and_nees_hold_their_bars_in_5000_trials() -> None:
    ratio, mean_nees = judge(5000, seed=42)
    assert ((ratio > 0.97) & (ratio < 1.05)).all()
    assert 0.97 < mean_nees < 1.05


def test_one_estimate_from_all_six_numbers_is_near_the_truth_and_accepted() -> None:
    poses, truth = poses_around(6), np.array([0.003, -0.002, 0.004, 0.02, -0.015, 0.04])
    frames = capture_histograms(expected_at(SCENE, poses, truth), SENSOR, rng=np.random.default_rng(8))
    found = match_jointly(frames, poses, SCENE, errors=NO_ERRORS)
    std = np.sqrt(np.diag(found.covariance))
    error = np.append(found.displacement - truth, found.support - SUPPORT)
    assert (np.abs(error) < 5 * std + 1e-6).all()
    assert found.accepted
    assert np.abs(error[:3]).max() < 1e-4
    assert found.as_dict()["accepted"] is True


def test_an_empty_table_is_not_the_object() -> None:
    poses, table = poses_around(4), block_on_table()
    table.update_faces(np.arange(24) < 12)
    table.face_attributes["part"] = np.zeros(12, np.int8)
    mean = expected_at(ObjectScene(table, SENSOR), poses, np.zeros(6))
    assert not match_jointly(capture_histograms(mean, SENSOR, rng=np.random.default_rng(8)), poses, SCENE).accepted


def test_a_turn_of_a_round_post_is_not_observable() -> None:
    poses, post = poses_around(3), trimesh.creation.cylinder(radius=0.03, height=0.1, sections=256)
    post.apply_translation([0, 0, 0.05])
    scene = ObjectScene(post, SENSOR)
    frames = exact(scene, poses, np.zeros(6))
    evidence = evidence_of(scene.linearise(frames, poses, np.zeros(6), 1.0, POSE_PARAMETERS), frames.zone_counts)
    _, covariance = solve_jointly(evidence, np.array([0.02] * 3 + [0.15] * 3))
    std = np.sqrt(np.diag(covariance))
    assert std[5] > 30 * std[3]  # 256 sections are almost round


def test_information_of_poses_adds_up() -> None:
    poses, still = poses_around(4), np.zeros(6)
    frames = exact(SCENE, poses, still)
    together = evidence_at(SCENE, poses, still, frames)
    alone = evidence_at(SCENE, poses[1:2], still, frames[1:2])
    np.testing.assert_allclose(together.information[1], alone.information[0], rtol=1e-9)
    assert together.chi2.sum() < 1e-6 * chi2.mean(together.dof.sum())  # noise-free histograms fit exactly


def test_what_does_not_belong_together_is_refused_in_one_line() -> None:
    poses = poses_around(2)
    frames = HistogramFrames(np.ones((2, 1, 3, 3, 128)), sensor=SENSOR)
    elsewhere = ObjectScene(block_on_table(), SENSOR, centre_m=(0.1, 0, 0))
    shrunk = poses * np.array([1.0, 1.1])[:, None, None]
    for arguments, options, message in (
        ((frames, poses[:1], SCENE), {}, "'sensor2world' must name 2 poses, got 1"),
        ((frames, poses, SCENE), {"free": ("bearing",)}, "'free' must name of x_m, .*, got 'bearing'"),
        ((frames, poses, SCENE), {"start": (0.0,)}, "'start' must have 6 numbers"),
        ((frames, shrunk, SCENE), {}, "must be a rotation and a translation, matrix 1 is not"),
        (([frames] * 2, [poses], [SCENE] * 2), {}, "must name the same sensors, got 2, 1 and 2"),
        ((frames, [poses], [SCENE]), {}, "must both be of one sensor"),
        (([frames] * 2, [poses] * 2, [SCENE, elsewhere]), {}, "that of sensor 1 is turned about another point"),
    ):
        with pytest.raises(UsageError, match=message):
            match_jointly(*arguments, **options)


def test_two_sensors_on_one_mount_know_the_object_as_their_information_together() -> None:
    poses, mount = poses_around(2), np.eye(4)
    mount[:3, 3] = 0.03, 0.0, 0.0  # the second sensor is 3 cm to the right of the first
    wide = DIM.with_(half_angle_h_deg=22.0, half_angle_v_deg=22.0)
    scenes, both = [DIM_SCENE, ObjectScene(block_on_table(), wide)], [poses, poses @ mount]
    rng = np.random.default_rng(3)
    seen = list(zip(scenes, both, strict=True))
    frames = [capture_histograms(expected_at(scene, at, TRUTH), scene.sensor, rng=rng) for scene, at in seen]
    evidence = [evidence_at(scene, at, TRUTH) for scene, at in seen]
    found = match_jointly(frames, both, scenes, start=TRUTH, free=FREE, support=SUPPORT, errors=NO_ERRORS)
    summed = sum(one.information.sum(axis=(0, 1)) for one in evidence)
    _, bound = solve_jointly(Evidence.joined(evidence))
    np.testing.assert_allclose(bound, np.linalg.inv(summed), rtol=1e-9)
    np.testing.assert_allclose(found.covariance, bound, rtol=0.1)  # taken at the estimate, not at the truth
    assert (np.abs(found.displacement - TRUTH)[WHERE] < 5 * np.sqrt(np.diag(bound))).all()
    assert found.accepted
    alone = match_jointly(frames[0], poses, scenes[0], start=TRUTH, free=FREE, support=SUPPORT, errors=NO_ERRORS)
    assert (np.diag(found.covariance) < np.diag(alone.covariance)).all()
