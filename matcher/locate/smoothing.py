"""Stops of a robot joined by its odometry: weighted least squares over all of them, outliers refused by χ²."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.stats import chi2

from phasemark import UsageError
from phasemark.matcher.locate.locator import LocatedPose, OdometryDrift, relative_pose
from phasemark.matcher.locate.recording import RigRecording

_Float = NDArray[np.float64]

_FALSE_ALARM = 1e-4
"""Probability with which an accepted pose that is right is left out for disagreeing with the others."""
_MOST_STEPS = 10
_BAND = 5
"""Beside the diagonal, of pairs of neighbouring poses with three numbers each."""
GYRO = OdometryDrift(per_m=0.1, position_m=0.05, yaw_rad=math.radians(0.3))
"""Odometry between stops: position by optical flow, heading by a gyro."""


def smoothed(
    recording: RigRecording,
    answers: Sequence[LocatedPose],
    part: NDArray[np.float64] | None = None,
    drift: OdometryDrift = GYRO,
) -> list[LocatedPose]:
    """Return answers joined by the odometry between the stops of each robot.

    Accepted poses are measurements with their covariance; so are poses that are undetermined. A pose that disagrees
    with the rest by χ² is left out. Stops between accepted ones get a pose too: it is accepted where the odometry
    places it to within the tolerance of an accepted pose, or the pose itself agrees.

    Parameters
    ----------
    recording : RigRecording
        With odometry at its stops.
    answers : sequence of LocatedPose
        Of the stops, in order.
    part : (3, 3) float64, optional
        Part of their covariances that all stops share, that of the map: no number of stops makes it less.
    drift : OdometryDrift
        Between neighbouring stops of a robot.

    Returns
    -------
    list of LocatedPose

    Raises
    ------
    UsageError
        The recording has no odometry.
    """
    if recording.odometry is None:
        raise UsageError("smoothing needs odometry at the stops: odometry_x_m, odometry_y_m, odometry_yaw_rad")
    found, shared = list(answers), np.zeros((3, 3)) if part is None else part
    for robot in np.unique(recording.robot):
        own = np.flatnonzero(recording.robot == robot)
        used = np.array([found[k].accepted or found[k].reason == "undetermined" for k in own])
        if not used.any():
            continue
        steps = [relative_pose(recording.odometry[a], recording.odometry[b]) for a, b in pairwise(own)]
        chain = _Chain([found[k] for k in own], shared, np.array(steps).reshape(-1, 3), drift)
        for k, pose, covariance, agrees in zip(own, *chain.solved(used), strict=True):
            was = found[k]
            accepted = was.accepted and bool(agrees)
            reason = was.reason if accepted or not was.accepted else "poor fit"
            found[k] = replace(
                was, x_m=float(pose[0]), y_m=float(pose[1]), yaw_rad=math.remainder(float(pose[2]), math.tau),
                covariance=covariance + shared, accepted=accepted, reason=reason,
            )  # fmt: skip
    return found


class _Chain:
    """Poses of one robot's stops, and the steps between them."""

    def __init__(self, answers: Sequence[LocatedPose], shared: _Float, steps: _Float, drift: OdometryDrift) -> None:
        self.measured = np.array([one.pose for one in answers])
        self.covariance = np.array([one.covariance for one in answers]) - shared
        self.steps = steps
        self.precision = np.array([np.linalg.inv(drift.covariance(step)) for step in steps]).reshape(-1, 3, 3)

    def solved(self, used: NDArray[np.bool_]) -> tuple[_Float, _Float, NDArray[np.bool_]]:
        """Return poses, covariances, and which measurements agree with the rest."""
        used = used.copy()
        limit = float(chi2.isf(_FALSE_ALARM, 3))
        while True:
            poses, covariance = self._fitted(used)
            off = self.measured - poses
            off[:, 2] = (off[:, 2] + math.pi) % math.tau - math.pi
            # of a measurement that takes part, the covariance of its residual is its own less that of the fit
            spread = np.where(used[:, None, None], self.covariance - covariance, 1.0)
            spread = np.where(np.isfinite(spread), spread, 0.0) + 1e-12 * np.eye(3)
            distance = np.einsum("ki,ki->k", off, np.linalg.solve(spread, off[..., None])[..., 0])
            distance[~used] = -np.inf
            worst = int(np.argmax(distance))
            if distance[worst] <= limit or used.sum() < 3:
                return poses, covariance, used
            used[worst] = False

    def _fitted(self, used: NDArray[np.bool_]) -> tuple[_Float, _Float]:
        """Return the least-squares poses, (n, 3), and their covariances, (n, 3, 3)."""
        n = len(self.measured)
        poses = self._started(used)
        weight = [np.linalg.inv(c) if u else np.zeros((3, 3)) for c, u in zip(self.covariance, used, strict=True)]
        for _ in range(_MOST_STEPS):
            normal, pull = np.zeros((3 * n, 3 * n)), np.zeros(3 * n)
            for k in range(n):
                own = slice(3 * k, 3 * k + 3)
                if used[k]:
                    off = self.measured[k] - poses[k]
                    off[2] = math.remainder(off[2], math.tau)
                    normal[own, own] += weight[k]
                    pull[own] += weight[k] @ off
                if k + 1 < n:
                    self._join(poses, k, normal, pull)
            banded = np.zeros((_BAND + 1, 3 * n))
            for below in range(_BAND + 1):
                banded[below, : 3 * n - below] = np.diagonal(normal, -below)
            step = solveh_banded(banded, np.column_stack([pull, np.eye(3 * n)]), lower=True)
            poses = poses + step[:, 0].reshape(n, 3)
            if np.abs(step[:, 0]).max() < 1e-9:
                break
        covariance = step[:, 1:].reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
        return poses, covariance

    def _join(self, poses: _Float, k: int, normal: _Float, pull: _Float) -> None:
        """Add the step between two stops to the normal equations."""
        cos, sin = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        by = poses[k + 1, :2] - poses[k, :2]
        seen = relative_pose(poses[k], poses[k + 1])
        slope = np.zeros((3, 6))
        slope[:, 3:] = [[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]
        slope[:, :3] = -slope[:, 3:]
        slope[:2, 2] = [cos * by[1] - sin * by[0], -cos * by[0] - sin * by[1]]
        off = self.steps[k] - seen
        off[2] = math.remainder(off[2], math.tau)
        both = slice(3 * k, 3 * k + 6)
        normal[both, both] += slope.T @ self.precision[k] @ slope
        pull[both] += slope.T @ self.precision[k] @ off

    def _started(self, used: NDArray[np.bool_]) -> _Float:
        """Return poses to begin with: those that were measured, and from the nearest of them along the odometry."""
        n = len(used)
        poses = self.measured.copy()
        known = used.copy()
        for k in [*range(1, n), *range(n - 2, -1, -1)]:
            for other in (k - 1, k + 1):
                if known[k] or not (0 <= other < n and known[other]):
                    continue
                cos, sin = math.cos(poses[other, 2]), math.sin(poses[other, 2])
                if other < k:
                    step = self.steps[other]
                    turned = np.array([cos * step[0] - sin * step[1], sin * step[0] + cos * step[1], step[2]])
                    poses[k] = poses[other] + turned
                else:
                    heading = poses[other, 2] - self.steps[k, 2]
                    cos, sin = math.cos(heading), math.sin(heading)
                    x, y = self.steps[k, :2]
                    poses[k] = [poses[other, 0] - cos * x + sin * y, poses[other, 1] - sin * x - cos * y, heading]
                known[k] = True
        return poses
