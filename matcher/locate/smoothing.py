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
from phasemark.matcher.locate.locator import LocatedPose, Locator, relative_pose
from phasemark.matcher.locate.recording import RigRecording
from phasemark.matcher.locate.rig import OdometryDrift

_Float = NDArray[np.float64]

_FALSE_ALARM = 1e-4
"""Probability with which an accepted pose that is right is left out for disagreeing with the others."""
_MOST_STEPS = 10
_BAND = 5
"""Beside the diagonal, of pairs of neighbouring poses with three numbers each."""


def smoothed(recording: RigRecording, answers: Sequence[LocatedPose], locator: Locator) -> list[LocatedPose]:
    """Return answers joined by the odometry between the stops of each robot.

    What the frames of accepted and of undetermined stops speak for are measurements. A measurement that disagrees with
    the rest by χ² is left out. A stop that was ambiguous or explained poorly is located again with the poses around as
    its prior. An answer is accepted if its stop takes part and its pose is determined then.

    Parameters
    ----------
    recording : RigRecording
        With odometry at its stops.
    answers : sequence of LocatedPose
        Of the stops, in order, by the locator.
    locator : Locator
        Its rig says how far steps of the odometry may be off.

    Returns
    -------
    list of LocatedPose

    Raises
    ------
    UsageError
        The recording has no odometry.
    """
    odometry = recording.odometry
    if odometry is None:
        raise UsageError("smoothing needs odometry at the stops: odometry_x_m, odometry_y_m, odometry_yaw_rad")
    found, part, drift = list(answers), locator.wall_map.part, locator.rig.odometry
    for robot in np.unique(recording.robot):
        own = np.flatnonzero(recording.robot == robot)
        steps = np.array([relative_pose(odometry[a], odometry[b]) for a, b in pairwise(own)]).reshape(-1, 3)
        used = np.array([found[k].accepted or found[k].reason == "undetermined" for k in own])
        if not used.any():
            continue
        poses, covariance, used = _Chain([found[k] for k in own], steps, drift).solved(used)
        for k, pose, around in zip(own[~used], poses[~used], covariance[~used], strict=True):
            if found[k].reason in ("ambiguous", "poor fit"):
                again = locator.locate_scan(recording.scan(int(k)), (pose, around + part))
                if again.accepted:
                    found[k] = replace(again, key=found[k].key, note=found[k].note)
        used |= [found[k].accepted and bool(u or answers[k].reason) for k, u in zip(own.tolist(), used, strict=True)]
        poses, covariance, used = _Chain([found[k] for k in own], steps, drift).solved(used)
        for k, pose, around, agrees in zip(own, poses, covariance + part, used, strict=True):
            found[k] = _joined(found[k], pose, around, bool(agrees), locator)
    return found


def _joined(was: LocatedPose, pose: _Float, covariance: _Float, agrees: bool, locator: Locator) -> LocatedPose:
    """Return the answer for a stop with its pose among the others."""
    reason = was.reason
    if agrees:
        reason = "" if locator.is_determined(np.sqrt(np.diag(covariance))) else "undetermined"
    elif not reason:
        reason = "poor fit"
    x, y, yaw = pose.tolist()
    return replace(
        was, x_m=x, y_m=y, yaw_rad=math.remainder(yaw, math.tau), covariance=covariance, accepted=not reason,
        reason=reason,
    )  # fmt: skip


class _Chain:
    """Poses of one robot's stops, and the steps between them."""

    def __init__(self, answers: Sequence[LocatedPose], steps: _Float, drift: OdometryDrift) -> None:
        nothing = (np.zeros(3), np.zeros((3, 3)))
        evidence = [one.evidence or nothing for one in answers]
        self.measured = np.array([pose for pose, _ in evidence])
        self.weight = np.array([information for _, information in evidence])
        self.steps = steps
        self.precision = np.array([np.linalg.inv(drift.covariance(step)) for step in steps]).reshape(-1, 3, 3)

    def solved(self, used: NDArray[np.bool_]) -> tuple[_Float, _Float, NDArray[np.bool_]]:
        """Return poses, covariances, and which measurements agree with the rest."""
        used = used.copy()
        limit = float(chi2.isf(_FALSE_ALARM, 3))
        while True:
            poses, covariance = self._fitted(used)
            distance = np.full(len(used), -np.inf)
            for k in np.flatnonzero(used):
                off = self.measured[k] - poses[k]
                off[2] = math.remainder(off[2], math.tau)
                # the covariance of a residual is that of the measurement less that of the fit: Λ⁻¹ − C
                pulled = self.weight[k] @ off
                spread = self.weight[k] - self.weight[k] @ covariance[k] @ self.weight[k]
                distance[k] = pulled @ np.linalg.pinv(spread, rcond=1e-6, hermitian=True) @ pulled
            worst = int(np.argmax(distance))
            if distance[worst] <= limit or used.sum() < 3:
                return poses, covariance, used
            used[worst] = False

    def _fitted(self, used: NDArray[np.bool_]) -> tuple[_Float, _Float]:
        """Return the least-squares poses, (n, 3), and their covariances, (n, 3, 3)."""
        n = len(self.measured)
        poses = self._started(used)
        for _ in range(_MOST_STEPS):
            normal, pull = np.zeros((3 * n, 3 * n)), np.zeros(3 * n)
            for k in range(n):
                own = slice(3 * k, 3 * k + 3)
                if used[k]:
                    off = self.measured[k] - poses[k]
                    off[2] = math.remainder(off[2], math.tau)
                    normal[own, own] += self.weight[k]
                    pull[own] += self.weight[k] @ off
                if k + 1 < n:
                    self._join(poses, k, normal, pull)
            banded = np.zeros((_BAND + 1, 3 * n))
            for below in range(min(_BAND + 1, 3 * n)):
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
