"""A pose over time: against batch least squares, simulated drives with known truth, rivals, outliers and loss."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from phasemark import UsageError
from phasemark.matcher import Match
from phasemark.matcher.match import Candidate
from phasemark.matcher.sequence import (
    FreeMotion,
    OdometryPlan,
    PoseEstimator,
    PoseFilter,
    Reading,
    Sighting,
    Standing,
)
from phasemark.matcher.sequence.odometry import motion_noise, moved
from phasemark.matcher.statistics import nees

FREE = ("distance_m", "delta_rad", "bearing_rad")
NOISE = np.diag(np.square([0.004, math.radians(0.8), math.radians(0.3)]))
SHARED = np.diag(np.square([0.005, math.radians(0.8), math.radians(0.3)]))
STEP_S = 1 / 15


def match_of(view: Any, noise: Any = NOISE, *, reason: Any = "", shared: Any = SHARED, **fields: Any) -> Match:
    parts = {} if shared is None else {"recording": shared}
    whole = noise if shared is None else noise + shared
    return Match("a", not reason, *view, free=FREE, covariance=whole, systematic=parts, reason=reason, **fields)


def wander(rng: np.random.Generator, n: int, motion: FreeMotion) -> np.ndarray:
    """Poses that move as the model says, away from the landmark's axis."""
    state = np.array([-1.0, 0.1, 0.05, 0.0, 0.0, 0.0])
    found = np.empty((n, 3))
    for k in range(n):
        state, _, noise = motion.step(state, Reading(0.0, 0.0, STEP_S))
        state = state + rng.multivariate_normal(np.zeros(6), noise)
        found[k] = state[:3]
    return found


def test_filter_and_smoother_are_batch_least_squares():
    """Sightings along a line with a bias that all share: a linear problem, whose normal equations are the oracle."""
    rng, motion, n = np.random.default_rng(1), FreeMotion(0.3, 0.4, 0.5, 0.6), 8
    covariance, loading, start = np.diag([1e-4, 4e-4, 2e-4]), np.diag([0.02, 0.01, 0.015]), np.eye(3) * 0.04
    robot = PoseFilter(np.zeros(3), start, motion, 1 - 1e-12, n_shared=3)
    measured = rng.normal(0, 0.05, (n, 3))
    _, jacobian, noise = motion.step(np.zeros(6), Reading(0.0, 0.0, STEP_S))
    size = 6 * n + 3
    information, right = np.zeros((size, size)), np.zeros(size)
    first = motion.start(start)
    prior = jacobian @ first @ jacobian.T + noise
    for k in range(n):
        robot.predict(Reading(0.0, 0.0, STEP_S))
        robot.take(Sighting(measured[k], covariance, loading))
        robot.mark()
        rows = np.zeros((6, size))
        rows[:, 6 * k : 6 * k + 6] = np.eye(6)
        if k:
            rows[:, 6 * k - 6 : 6 * k] = -jacobian
        weight = np.linalg.inv(noise if k else prior)
        information += rows.T @ weight @ rows
        seen = np.zeros((3, size))
        seen[:, 6 * k : 6 * k + 3], seen[:, -3:] = np.eye(3), loading
        information += seen.T @ np.linalg.inv(covariance) @ seen
        right += seen.T @ np.linalg.inv(covariance) @ measured[k]
    information[-3:, -3:] += np.eye(3)
    best, whole = np.linalg.solve(information, right), np.linalg.inv(information)
    for k, (state, spread) in enumerate(robot.smoothed()):
        own = np.array([*range(6 * k, 6 * k + 6), *range(size - 3, size)])
        np.testing.assert_allclose(state, best[own], atol=1e-10)
        np.testing.assert_allclose(spread, whole[np.ix_(own, own)], atol=1e-10)
    np.testing.assert_allclose(robot.pose, best[size - 9 : size - 6], atol=1e-10)


def test_poses_of_simulated_drives_are_as_uncertain_as_stated():
    """A bias of each recording, undetermined matches, outliers; the last pose of each drive is independent."""
    rng, motion, n = np.random.default_rng(7), FreeMotion(0.0, 0.1, 0.0, 0.2), 200
    errors, covariances, accepted = [], [], 0
    for _ in range(n):
        bias, estimator = rng.multivariate_normal(np.zeros(3), SHARED), PoseEstimator(Standing(), motion)
        for k, pose in enumerate(wander(rng, 20, motion)):
            estimator.move(Reading(0.0, 0.0, STEP_S))
            vague = k > 0 and rng.random() < 0.3
            noise = np.diag(np.square([0.004, math.radians(12), math.radians(0.3)])) if vague else NOISE
            view = estimator.standing.view(pose) + bias + rng.multivariate_normal(np.zeros(3), noise)
            if k > 0 and rng.random() < 0.05:
                view[1] += rng.uniform(0.5, 5.5)
            found = estimator.see(match_of(view, noise, reason="undetermined" if vague else ""))
        assert found.pose is not None
        apart = found.pose - pose
        errors.append([*apart[:2], math.remainder(apart[2], math.tau)])
        covariances.append(found.covariance)
        accepted += found.accepted
    # N = 200, three degrees of freedom each; a 99.9 % interval
    low, high = stats.chi2.ppf([0.0005, 0.9995], 3 * n)
    assert low < nees(np.array(errors), np.array(covariances)).sum() < high
    assert accepted > 0.9 * n


@pytest.mark.parametrize(("shared_std", "delay_std_s"), [(np.sqrt(np.diag(SHARED)), 0.0), (np.zeros(3), 0.02)])
def test_errors_that_last_are_not_learnt_from_noise_nor_a_moving_robot_s_delay_forgotten(shared_std, delay_std_s):
    """The first pose and the last, 60 frames on, of drives past a landmark with odometry, to and fro."""
    rng, plan, n, time_s = np.random.default_rng(3), OdometryPlan(), 100, 0.1
    noise = np.diag(np.square([0.003, math.radians(1.0), math.radians(0.2)]))
    errors, covariances = np.zeros((2, n, 3)), np.zeros((2, n, 3, 3))
    for drive in range(n):
        lasting, late_s = shared_std * rng.standard_normal(3), delay_std_s * rng.standard_normal()
        state = np.array(
            [-1.8, -0.6, 0.3, *np.sqrt(np.diag(plan.start(np.zeros((3, 3))))[3:]) * rng.standard_normal(2)]
        )
        estimator = PoseEstimator(Standing(), plan, delay_std_s=delay_std_s)
        for k in range(60):
            reading = Reading(0.03, 0.15 * math.cos(k / 6), time_s)
            before = state
            state = rng.multivariate_normal(moved(state, reading), motion_noise(state, reading, plan))
            pose = state[:3] + (state - before)[:3] / time_s * late_s
            view = estimator.standing.view(pose) + lasting + rng.multivariate_normal(np.zeros(3), noise)
            estimator.move(reading)
            found = estimator.see(match_of(view, noise, shared=np.diag(shared_std**2)))
            if k in (0, 59):
                assert found.pose is not None
                apart = found.pose - state[:3]
                errors[k // 59, drive] = *apart[:2], math.remainder(apart[2], math.tau)
                covariances[k // 59, drive] = found.covariance
    low, high = stats.chi2.ppf([0.0005, 0.9995], 3 * n)
    for own, stated in zip(errors, covariances, strict=True):
        assert low < nees(own, stated).sum() < high


def test_smoothed_poses_of_a_drive_are_nearer_to_the_truth_than_filtered_ones():
    rng, motion = np.random.default_rng(11), FreeMotion(0.0, 0.05, 0.0, 0.1)
    estimator = PoseEstimator(Standing(), motion, smooths=True)
    poses, causal = wander(rng, 80, motion), []
    for pose in poses:
        estimator.move(Reading(0.0, 0.0, STEP_S))
        view = estimator.standing.view(pose) + rng.multivariate_normal(np.zeros(3), NOISE)
        causal.append(estimator.see(match_of(view, shared=None)).pose)
    smooth = np.array([state[:3] for state, _ in estimator.filter.smoothed()])
    off, kept = (np.sqrt(np.mean((own[10:-10] - poses[10:-10]) ** 2, axis=0)) for own in (np.array(causal), smooth))
    assert (kept < 0.8 * off).all()


def test_a_recording_s_bias_does_not_average_out():
    estimator = PoseEstimator(Standing(), FreeMotion(0.0, 1e-4, 0.0, 1e-4))
    for _ in range(200):
        estimator.move(Reading(0.0, 0.0, STEP_S))
        found = estimator.see(match_of((1.0, 0.0, 0.0)))
    assert found.covariance is not None
    # at rest before the landmark x shows D: its noise averages out, the bias of 5 mm stays
    assert math.sqrt(found.covariance[0, 0]) == pytest.approx(0.005, rel=0.01)


def test_mirror_rivals_are_kept_apart_until_motion_decides():
    """Two views of one frame, δ and −δ: as the robot circles to the left only one of them moves as it drives."""
    motion = FreeMotion(0.5, 0.5, 0.02, 0.02, 0.01)
    estimator, said = PoseEstimator(Standing(), motion), []
    for k in range(25):
        delta = 0.3 + 0.02 * k
        rival = Candidate("a", 1.0, -delta, 10.0, 0.5)
        if k:
            estimator.move(Reading(0.0, 0.02, STEP_S))  # the gyro turns with the true one
        view = (1.0, delta, 0.0)
        said.append(estimator.see(match_of(view, reason="ambiguous", shared=None, alternatives=(rival,))))
    assert said[0].reason == "ambiguous"
    assert len(said[0].poses) == 2
    assert said[-1].accepted
    assert said[-1].pose is not None
    assert said[-1].pose[2] == pytest.approx(delta, abs=0.03)
    assert not any(one.accepted and abs(one.pose[2] - 0.3 - 0.02 * k) > 0.1 for k, one in enumerate(said))


@pytest.mark.parametrize(
    ("reason", "other", "used"),
    [
        ("ambiguous", Candidate("b", 1.05, 0.0, 1.0, 0.3), False),
        ("ambiguous", Candidate("a", 1.0, 1.2, 1.0, 0.3), True),
        ("undetermined", Candidate("a", 1.0, 1.2, 1.0, 0.3), False),
        ("undetermined", Candidate("a", 1.01, 0.03, 1.0, 0.3), True),
        ("undetermined", Candidate("b", 1.05, 0.0, 20.0, 1e-5), True),
    ],
)
def test_a_refused_match_that_may_be_something_else_is_no_sighting(reason, other, used):
    estimator = PoseEstimator(Standing(), FreeMotion(0.2, 0.2, 0.4, 0.4))
    for _ in range(20):
        estimator.move(Reading(0.0, 0.0, STEP_S))
        assert estimator.see(match_of((1.0, 0.0, 0.0))).used
    estimator.move(Reading(0.0, 0.0, STEP_S))
    assert estimator.see(match_of((1.0, 0.0, 0.0), reason=reason, alternatives=(other,))).used == used


def test_an_outlier_is_refused_and_a_robot_that_was_put_elsewhere_is_found_again():
    estimator = PoseEstimator(Standing(), FreeMotion(0.1, 0.1, 0.1, 0.1))
    for view in [(1.0, 0.2, 0.0)] * 5:
        estimator.move(Reading(0.0, 0.0, STEP_S))
        before = estimator.see(match_of(view))
    outlier = estimator.see(match_of((1.0, 1.4, 0.0)))
    assert not outlier.used
    np.testing.assert_array_equal(outlier.pose, before.pose)
    assert not outlier.accepted  # two poses are probable now
    again = estimator.see(match_of((1.0, 0.2, 0.0)))
    assert again.accepted
    assert again.used
    for _ in range(3):
        moved = estimator.see(match_of((1.0, 1.4, 0.0)))
    assert moved.accepted
    assert moved.pose[2] == pytest.approx(1.4, abs=0.02)


def test_it_states_that_it_searches_is_lost_and_has_found_itself_again():
    estimator = PoseEstimator(Standing(), FreeMotion(), lost_after_s=0.4)
    assert estimator.see(None).reason == "searching"
    assert estimator.see(match_of((1.0, 0.2, 0.0))).accepted
    reasons = []
    for _ in range(10):
        estimator.move(Reading(0.0, 0.0, 0.1))
        reasons.append(estimator.see(None).reason)
    assert reasons[-1] == "lost"
    assert estimator.see(match_of((1.3, 2.0, 0.0))).accepted


def test_matches_whose_bearing_is_fixed_may_go_on_for_long():
    """Their poses have covariances of rank two."""
    estimator = PoseEstimator(Standing(), FreeMotion(0.2, 0.5, 0.3, 0.5))
    for k in range(400):
        estimator.move(Reading(0.0, 0.0, STEP_S))
        view = (1.0 + 0.05 * math.sin(k / 9), 0.3 + 0.1 * math.sin(k / 7), 0.0)
        seen = replace(match_of(view), free=FREE[:2], covariance=NOISE[:2, :2], systematic={})
        found = estimator.see(seen)
    assert found.accepted


def test_of_a_wide_plane_only_distance_and_heading_are_measured():
    estimator = PoseEstimator(Standing(flat=True), FreeMotion())
    seen = replace(match_of((1.0, 0.3, 0.0)), free=FREE[:2], covariance=NOISE[:2, :2], systematic={})
    found = estimator.see(seen)
    assert found.accepted
    assert found.pose is not None
    assert found.pose[0] == pytest.approx(-math.cos(0.3))
    assert found.covariance[1, 1] > 1


def test_of_a_symmetric_landmark_the_side_that_is_expected_is_followed():
    estimator, period = PoseEstimator(Standing(), FreeMotion(0.1, 0.5, 0.3, 3.0), lost_after_s=5.0), math.pi
    for k in range(12):
        estimator.move(Reading(0.0, 0.0, 0.5 if k == 6 else STEP_S))  # a gap after which either side is probable
        delta = 1.47 + 0.012 * k  # beyond half a period in the end
        found = estimator.see(match_of((1.0, delta % period, 0.0), symmetry=2))
        assert found.accepted
        assert found.pose is not None
        assert found.pose[2] == pytest.approx(delta, abs=0.03)


def test_a_delay_against_the_gyro_is_learnt_while_the_robot_turns_to_and_fro():
    """Frames show the heading 30 ms before their stamps: of a turn at 1 rad/s they lag by 1.7°."""
    late_s, motion = 0.03, FreeMotion(0.01, 0.01, 1e-3, 1e-3, 1e-3)
    rng, off = np.random.default_rng(5), {}
    for std_s in (0.0, 0.03):
        estimator, errors = PoseEstimator(Standing(), motion, delay_std_s=std_s), []

        def heading(at_s):
            return 0.6 * math.sin(1.5 * at_s)

        for k in range(150):
            now = k * STEP_S
            if k:
                estimator.move(Reading(0.0, heading(now) - heading(now - STEP_S), STEP_S))
            pose = np.array([-1.0, 0.0, heading(now - late_s)])
            view = estimator.standing.view(pose) + rng.multivariate_normal(np.zeros(3), NOISE)
            found = estimator.see(match_of(view, shared=None))
            errors.append(0.0 if found.pose is None else found.pose[2] - heading(now))
        off[std_s] = math.sqrt(np.mean(np.square(errors[75:])))
    assert off[0.03] < 0.4 * off[0.0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: FreeMotion(speed_std=-1.0), "'speed_std' must not be negative, got -1"),
        (lambda: FreeMotion(turn_walk=math.nan), "'turn_walk' must not be negative, got nan"),
        (lambda: PoseEstimator(Standing(), FreeMotion(), gate=99.99), r"'gate' must be in \(0, 1\), got 99.99"),
        (lambda: PoseEstimator(Standing(), FreeMotion(), tolerance_rad=math.nan), "'tolerance_rad' must be positive"),
        (lambda: PoseEstimator(Standing(), FreeMotion(), jitter_s=-0.1), "'jitter_s' must not be negative, got -0.1"),
    ],
)
def test_an_estimator_that_could_not_judge_is_refused(call: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        call()
