"""The pose of an object from simulated histograms: error over bound, honest covariance, refusal."""

from __future__ import annotations

import numpy as np
import pytest
from oracles.simple_scenes import block_on_table, poses_around
from scipy.stats import chi2, norm

from phasemark import UsageError
from phasemark.matcher.histograms.object_pose import POISSON, Evidence, evidence_of, match_jointly, solve_jointly
from phasemark.matcher.histograms.scene_prediction import POSE_PARAMETERS, ObjectScene
from phasemark.matcher.statistics import nees
from phasemark.render import Sensor, preset
from phasemark.render.direct.bin_counts import expected_counts, piled_up
from phasemark.render.direct.histogram_frames import HistogramFrames, capture_histograms

FREE = ("x_m", "z_m", "yaw_rad")
TRUTH = np.array([0.002, 0.0, -0.001, 0.0, 0.0, 0.03])
SUPPORT = 0.6


def dim_sensor() -> Sensor:
    """Return a TMF8820 with a tenth of its pulses; with a hundredth the turn is so uncertain that slopes change."""
    base = preset("tmf8820-3x3")
    return base.with_(histogram={**base.histogram.model_dump(), "cycles": 3e5})


def expected_at(scene: ObjectScene, poses: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    h = scene.histogram
    counts = scene.signal(poses, displacement, SUPPORT) * 0.5 + h.cycles * (h.ambient + h.dark)
    return piled_up(counts, h.cycles)


def errors_of(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Return errors, covariances and χ² of n simulated matches, and the degrees of freedom."""
    sensor, poses = dim_sensor(), poses_around(2)
    scene = ObjectScene(block_on_table(), sensor)
    mean = expected_at(scene, poses, TRUTH)
    drawn = capture_histograms(mean, sensor, rng=np.random.default_rng(seed), n_frames=n)
    where = [POSE_PARAMETERS.index(name) for name in FREE]
    start = TRUTH + np.array([0.001, 0, 0.001, 0, 0, 0.01])
    errors, covariances, chi2s = [], [], []
    for k in range(n):
        frames = HistogramFrames(drawn.counts[:, k : k + 1], sensor=sensor)
        found = match_jointly(frames, poses, scene, start=start, free=FREE, support=SUPPORT, model_error=POISSON)
        errors.append(found.displacement[where] - TRUTH[where])
        covariances.append(found.covariance)
        chi2s.append(found.chi2)
    return np.array(errors), np.array(covariances), np.array(chi2s), found.dof


def judge(n: int, seed: int) -> tuple[np.ndarray, float, float]:
    """Return RMSE over bound for each parameter, the mean NEES over its dimension, and half the interval of both."""
    errors, covariances, _, _ = errors_of(n, seed)
    sensor, poses = dim_sensor(), poses_around(2)
    scene = ObjectScene(block_on_table(), sensor)
    mean = expected_at(scene, poses, TRUTH)
    frames = HistogramFrames(mean.reshape(2, 1, 3, 3, 128), sensor=sensor)
    _, bound = solve_jointly(evidence_of(scene.linearise(frames, poses, TRUTH, SUPPORT, FREE), frames.zone_counts))
    ratio = np.sqrt((errors**2).mean(axis=0) / np.diag(bound))
    return ratio, float(nees(errors, covariances).mean() / len(FREE)), float(norm.isf(0.0005 / 4) / np.sqrt(2 * n))


def test_error_is_at_the_bound_and_the_covariance_is_honest() -> None:
    n = 100
    ratio, mean_nees, half = judge(n, seed=41)
    assert (np.abs(ratio - 1) < half + 0.02).all()  # 0.02: second order in the noise
    assert abs(mean_nees - 1) < norm.isf(0.0005 / 4) * np.sqrt(2 / (n * len(FREE))) + 0.03


@pytest.mark.soak
def test_error_over_bound_and_nees_hold_their_bars_in_5000_trials() -> None:
    ratio, mean_nees, _ = judge(5000, seed=42)
    assert ((ratio > 0.97) & (ratio < 1.05)).all()
    assert 0.97 < mean_nees < 1.05


def test_one_estimate_from_all_six_numbers_is_near_the_truth_and_accepted() -> None:
    sensor, poses = preset("tmf8820-3x3"), poses_around(6)
    scene = ObjectScene(block_on_table(), sensor)
    truth = np.array([0.003, -0.002, 0.004, 0.02, -0.015, 0.04])
    frames = capture_histograms(expected_at(scene, poses, truth), sensor, rng=np.random.default_rng(8))
    found = match_jointly(frames, poses, scene, model_error=POISSON)
    std = np.sqrt(np.diag(found.covariance))
    error = np.append(found.displacement - truth, found.support - SUPPORT)
    assert (np.abs(error) < 5 * std + 1e-6).all()
    assert found.accepted
    assert np.abs(error[:3]).max() < 1e-4
    assert found.as_dict()["accepted"] is True


def test_an_empty_table_is_not_the_object() -> None:
    sensor, poses = preset("tmf8820-3x3"), poses_around(4)
    scene = ObjectScene(block_on_table(), sensor)
    table = block_on_table()
    table.update_faces(np.arange(24) < 12)
    table.face_attributes["part"] = np.zeros(12, np.int8)
    empty = ObjectScene(table, sensor)
    h = sensor.histogram
    mean = piled_up(empty.signal(poses, np.zeros(6), 0.5) + h.cycles * h.ambient, h.cycles)
    frames = capture_histograms(mean, sensor, rng=np.random.default_rng(8))
    assert not match_jointly(frames, poses, scene).accepted


def test_a_turn_of_a_round_post_is_not_observable() -> None:
    import trimesh

    sensor, poses = preset("tmf8820-3x3"), poses_around(3)
    post = trimesh.creation.cylinder(radius=0.03, height=0.1, sections=256)
    post.apply_translation([0, 0, 0.05])
    scene = ObjectScene(post, sensor)
    h = sensor.histogram
    mean = piled_up(scene.signal(poses, np.zeros(6), 1.0) + h.cycles * h.ambient, h.cycles)
    frames = HistogramFrames(mean.reshape(3, 1, 3, 3, 128), sensor=sensor)
    evidence = evidence_of(scene.linearise(frames, poses, np.zeros(6), 1.0, POSE_PARAMETERS), mean)
    _, covariance = solve_jointly(evidence, np.array([0.02] * 3 + [0.15] * 3))
    std = np.sqrt(np.diag(covariance))
    assert std[5] > 30 * std[3]  # 256 sections are almost round


def test_information_of_poses_adds_up() -> None:
    sensor, poses = preset("tmf8820-3x3"), poses_around(4)
    scene = ObjectScene(block_on_table(), sensor)
    frames = HistogramFrames(expected_at(scene, poses, np.zeros(6)).reshape(4, 1, 3, 3, 128), sensor=sensor)
    together = evidence_of(scene.linearise(frames, poses, np.zeros(6), SUPPORT, FREE), frames.zone_counts)
    alone = evidence_of(scene.linearise(frames[1:2], poses[1:2], np.zeros(6), SUPPORT, FREE), frames[1:2].zone_counts)
    np.testing.assert_allclose(together.information[1], alone.information[0], rtol=1e-9)
    assert together.chi2.sum() < 1e-6 * chi2.mean(together.dof.sum())  # noise-free histograms fit exactly


def test_wrong_numbers_of_poses_and_unknown_parameters_are_refused() -> None:
    sensor, poses = preset("tmf8820-3x3"), poses_around(2)
    scene = ObjectScene(block_on_table(), sensor)
    frames = HistogramFrames(np.ones((2, 1, 3, 3, 128)), sensor=sensor)
    with pytest.raises(UsageError, match="'sensor2world' must name 2 poses, got 1"):
        match_jointly(frames, poses[:1], scene)
    with pytest.raises(UsageError, match=r"'free' must name of x_m, .*, got 'bearing'"):
        match_jointly(frames, poses, scene, free=("bearing",))
    with pytest.raises(UsageError, match="'start' must have 6 numbers"):
        match_jointly(frames, poses, scene, start=(0.0,))
    with pytest.raises(UsageError, match="must be a rotation and a translation, matrix 1 is not"):
        match_jointly(frames, poses * np.array([1.0, 1.1])[:, None, None], scene)


def test_prediction_of_the_matcher_is_the_expected_counts_of_the_sensor() -> None:
    from phasemark.render.direct.footprints import footprint_grid
    from phasemark.render.direct.recordings import world2cam
    from phasemark.render.direct.scene_samples import SceneMesh
    from phasemark.render.direct.transients import range_axis, zone_transients

    sensor, poses = preset("tmf8820-3x3"), poses_around(2)
    axis = range_axis(sensor, longest_m=2.0)
    samples = SceneMesh(block_on_table()).samples(world2cam(poses), footprint_grid(sensor))
    want = expected_counts(zone_transients(samples, sensor, axis), sensor, axis, (SUPPORT * 0.5, 0.5))
    got = expected_at(ObjectScene(block_on_table(), sensor), poses, np.zeros(6))
    assert np.abs(got - want).max() < 5e-5 * want.max()  # linear steps of the response, 1/64 of its width


def test_two_sensors_on_one_mount_know_the_object_as_their_information_together() -> None:
    poses, mount = poses_around(2), np.eye(4)
    mount[:3, 3] = 0.03, 0.0, 0.0  # the second sensor is 3 cm to the right of the first
    wide = dim_sensor().with_(half_angle_h_deg=22.0, half_angle_v_deg=22.0)
    scenes = [ObjectScene(block_on_table(), sensor) for sensor in (dim_sensor(), wide)]
    both = [poses, poses @ mount]
    rng = np.random.default_rng(3)
    frames, evidence = [], []
    for scene, at in zip(scenes, both, strict=True):
        mean = expected_at(scene, at, TRUTH)
        frames.append(capture_histograms(mean, scene.sensor, rng=rng))
        exact = HistogramFrames(mean.reshape(2, 1, 3, 3, 128), sensor=scene.sensor)
        evidence.append(evidence_of(scene.linearise(exact, at, TRUTH, SUPPORT, FREE), exact.zone_counts))
    found = match_jointly(frames, both, scenes, start=TRUTH, free=FREE, support=SUPPORT, model_error=POISSON)
    summed = sum(one.information.sum(axis=(0, 1)) for one in evidence)
    _, bound = solve_jointly(Evidence.joined(evidence))
    np.testing.assert_allclose(bound, np.linalg.inv(summed), rtol=1e-9)
    np.testing.assert_allclose(found.covariance, bound, rtol=0.1)  # taken at the estimate, not at the truth
    where = [POSE_PARAMETERS.index(name) for name in FREE]
    assert (np.abs(found.displacement - TRUTH)[where] < 5 * np.sqrt(np.diag(bound))).all()
    assert found.accepted
    alone = match_jointly(frames[0], poses, scenes[0], start=TRUTH, free=FREE, support=SUPPORT, model_error=POISSON)
    assert (np.diag(found.covariance) < np.diag(alone.covariance)).all()


def test_sensors_that_do_not_belong_together_are_refused() -> None:
    sensor, poses = preset("tmf8820-3x3"), poses_around(1)
    frames = HistogramFrames(np.ones((1, 1, 3, 3, 128)), sensor=sensor)
    scene = ObjectScene(block_on_table(), sensor)
    with pytest.raises(UsageError, match="must name the same sensors, got 2, 1 and 2"):
        match_jointly([frames, frames], [poses], [scene, scene])
    with pytest.raises(UsageError, match="must both be of one sensor"):
        match_jointly(frames, [poses], [scene])
    elsewhere = ObjectScene(block_on_table(), sensor, centre_m=(0.1, 0, 0))
    with pytest.raises(UsageError, match="that of sensor 1 is turned about another point"):
        match_jointly([frames, frames], [poses, poses], [scene, elsewhere])
