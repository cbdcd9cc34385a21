"""Stops of a robot joined by its odometry: weighted least squares over all of them, outliers refused by χ²."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from phasemark import UsageError
from phasemark.matcher.locate.locator import LocatedPose, Locator
from phasemark.matcher.locate.plane import difference, relative_pose, stepped, turn_of
from phasemark.matcher.locate.recording import RigRecording
from phasemark.matcher.locate.rig import OdometryDrift

_Float = NDArray[np.float64]

_FALSE_ALARM = 1e-4
"""Probability with which an accepted pose that is right is left out for disagreeing with the others."""
_SLIP = 1e-6
"""The same of a step of the odometry, whose errors are less like those of a normal law."""
_AS_WELL = 0.99
"""Share of the largest disagreement of a measurement with which a step is left out before it."""
_OFTEN = 0.15
"""Share of steps that do not hold, between parts that are believed, from which the odometry is not."""
_FEW, _MANY = 2, 1 / 3
"""Measurements beyond a step that does not hold that may be wrong together, and their share from which it is rather the
odometry that is wrong."""
_LEAST_KNOWN = 1e-6
"""Inverse squares of metres and radians: no stop is farther off than a kilometre, though a corridor does not say."""
_MOST_STEPS = 10


def smoothed(recording: RigRecording, answers: Sequence[LocatedPose], locator: Locator) -> list[LocatedPose]:
    """Return answers joined by the odometry between the stops of each robot.

    What the frames of accepted stops speak for are measurements, and of undetermined ones that no other pose explains
    and that do tell each of x, y and yaw. What disagrees most with the rest by χ² is left out, a measurement or a step
    of the odometry: wheels slip. Of two parts of the way that it does not join, one of a stop or two is not believed
    beside a longer one. A stop that was ambiguous or explained poorly is located again with the poses around as its
    prior. An answer is accepted if its stop takes part and its pose is determined then. A robot whose odometry often
    does not hold keeps its answers.

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
    odometry = odometry_of(recording)
    found, part, drift = list(answers), locator.wall_map.part, locator.rig.odometry
    for robot in np.unique(recording.robot):
        own = np.flatnonzero(recording.robot == robot)
        steps = np.array([relative_pose(odometry[a], odometry[b]) for a, b in pairwise(own)]).reshape(-1, 3)
        used = np.array([_is_measurement(found[k]) for k in own])
        if not used.any():
            continue
        poses, covariance, used, _ = _Chain([found[k] for k in own], steps, drift).solved(used)
        for k, pose, around in zip(own[~used], poses[~used], covariance[~used], strict=True):
            if found[k].reason in ("ambiguous", "poor fit", "unexpected"):
                zones = locator.zones(recording, int(k))
                one = locator.locate_scan(recording.scan(int(k)), (pose, around + part), zones)
                if one.accepted:
                    found[k] = replace(one, key=found[k].key, note=found[k].note)
        alone = np.array([answers[k].accepted for k in own.tolist()])
        used |= np.array([found[k].accepted for k in own]) & ~alone
        poses, covariance, used, chain = _Chain([found[k] for k in own], steps, drift).solved(used)
        # of two parts that contradict each other, a few stops are not believed beside many
        count = np.bincount(chain, used)
        believed = (count > _FEW) | (count == count.max())
        if believed.sum() - 1 > max(1.0, _OFTEN * len(steps)) or count[~believed].sum() > _MANY * count.sum():
            for k in own.tolist():
                found[k] = answers[k]
            continue
        used &= believed[chain]
        for k, pose, around, agrees in zip(own, poses, covariance + part, used, strict=True):
            found[k] = _joined(found[k], pose, around, bool(agrees), locator)
    return found


def odometry_of(recording: RigRecording) -> _Float:
    """Return the odometry at the stops that smoothing needs, (n, 3); a UsageError if there is none."""
    if recording.odometry is None:
        raise UsageError("smoothing needs odometry at the stops: odometry_x_m, odometry_y_m, odometry_yaw_rad")
    return recording.odometry


def _is_measurement(answer: LocatedPose) -> bool:
    """Return True if an answer speaks for one pose."""
    if answer.accepted:
        return True
    alone = answer.reason == "undetermined" and len(answer.alternatives) <= 1
    return alone and answer.evidence is not None and bool(np.isfinite(answer.evidence[1]).all())


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

    def solved(self, used: NDArray[np.bool_]) -> tuple[_Float, _Float, NDArray[np.bool_], NDArray[np.int64]]:
        """Return poses, covariances, which measurements agree with the rest, and which stops whole steps join."""
        used, whole, n = used.copy(), np.ones(len(self.steps), np.bool_), len(used)
        limit, slip = float(chi2.isf(_FALSE_ALARM, 3)), float(chi2.isf(_SLIP, 3))
        while True:
            poses, covariance = self._fitted(used, whole)
            step_off, measured_off = np.zeros(len(whole)), np.zeros(n)
            for k in np.flatnonzero(used):
                off = difference(self.measured[k], poses[k])
                measured_off[k] = _surprise(off, self.weight[k], covariance[k, :, k])
            for k in np.flatnonzero(whole):
                off = difference(self.steps[k], relative_pose(poses[k], poses[k + 1]))
                slope = _step_slope(poses[k], poses[k + 1])
                of_both = covariance[k : k + 2, :, k : k + 2].reshape(6, 6)
                step_off[k] = _surprise(off, self.precision[k], slope @ of_both @ slope.T)
            slipped = step_off.max(initial=0.0) > slip
            if not slipped and measured_off.max() <= limit:
                return poses, covariance[np.arange(n), :, np.arange(n)], used, np.cumsum(np.r_[0, ~whole])
            # between two measurements neither is known to be wrong, and the step is
            if slipped and step_off.max() >= _AS_WELL * measured_off.max():
                whole[np.argmax(step_off)] = False
                rests = ~self.steps.any(axis=1)
                if (rests & ~whole).sum() > 1:  # wheels that count nothing while the robot moves are dead
                    whole &= ~rests
            else:
                used[np.argmax(measured_off)] = False

    def _fitted(self, used: NDArray[np.bool_], whole: NDArray[np.bool_]) -> tuple[_Float, _Float]:
        """Return the least-squares poses, (n, 3), and their covariance, (n, 3, n, 3), by what is used."""
        n = len(self.measured)
        poses = self._started(used, whole)
        for _ in range(_MOST_STEPS):
            normal, pull = _LEAST_KNOWN * np.eye(3 * n), np.zeros(3 * n)
            for k in range(n):
                own = slice(3 * k, 3 * k + 3)
                if used[k]:
                    normal[own, own] += self.weight[k]
                    pull[own] += self.weight[k] @ difference(self.measured[k], poses[k])
                if k + 1 < n and whole[k]:
                    both, slope = slice(3 * k, 3 * k + 6), _step_slope(poses[k], poses[k + 1])
                    weighted = slope.T @ self.precision[k]
                    normal[both, both] += weighted @ slope
                    pull[both] += weighted @ difference(self.steps[k], relative_pose(poses[k], poses[k + 1]))
            scale = 1 / np.sqrt(np.diag(normal))  # some stops tell millimetres, some next to nothing
            covariance: _Float = np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
            step = (covariance @ pull).reshape(n, 3)
            poses = poses + step
            if np.abs(step).max() < 1e-9:
                break
        return poses, covariance.reshape(n, 3, n, 3)

    def _started(self, used: NDArray[np.bool_], whole: NDArray[np.bool_]) -> _Float:
        """Return poses to begin with: those that were measured, and from the nearest of them along whole steps."""
        poses, known, n = self.measured.copy(), used.copy(), len(used)
        for k in [*range(1, n), *range(n - 2, -1, -1)]:
            if not known[k] and k and known[k - 1] and whole[k - 1]:
                poses[k], known[k] = stepped(poses[k - 1], self.steps[k - 1]), True
            elif not known[k] and k + 1 < n and known[k + 1] and whole[k]:
                back = relative_pose(self.steps[k], np.zeros(3))
                poses[k], known[k] = stepped(poses[k + 1], back), True
        return poses


def _surprise(off: _Float, weight: _Float, covariance: _Float) -> float:
    """Return the squared residual over its covariance, that of the measurement less that of the fit: Λ⁻¹ − C.

    Nothing is unexpected in what no other evidence speaks of.
    """
    known = np.diag(weight)
    scale = np.where(known > 0, 1 / np.sqrt(np.where(known > 0, known, 1.0)), 0.0)
    variance, axes = np.linalg.eigh((weight - weight @ covariance @ weight) * np.outer(scale, scale))
    pulled, shared = axes.T @ (scale * (weight @ off)), variance > 1e-6
    return float((pulled[shared] ** 2 / variance[shared]).sum())


def _step_slope(before: _Float, after: _Float) -> _Float:
    """Return the slopes of the step between two poses by both, (3, 6)."""
    turn = turn_of(before[2]).T
    x, y, _ = turn @ (after - before)
    slope = np.hstack([-turn, turn])
    slope[:2, 2] = y, -x
    return slope
