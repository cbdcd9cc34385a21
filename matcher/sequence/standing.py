"""A landmark in its place, and the poses that a match of it allows."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.match import TOLERANCE_M, TOLERANCE_RAD, Candidate, Match
from phasemark.matcher.position.robot_pose import RobotPose, pose_jacobian, robot_poses
from phasemark.matcher.sequence.planar import lens_pose, rotation, view_of
from phasemark.matcher.sequence.pose_filter import Sighting

_VIEW = ("distance_m", "delta_rad", "bearing_rad")
_SHARED = ("calibration", "recording", "declared")
"""Parts of a match's covariance that are the same error in all frames of a recording."""
_LEAST_VARIANCE = 1e-10
"""Variance that is added to each number of a pose, m² or rad²: where the bearing is fixed, they are not independent."""
_LEAST_SHARE, _MOST_RIVALS = 1e-3, 4
"""Least probability of a rival of an ambiguous match, which one frame cannot exclude, and how many rivals are kept."""


@dataclass(frozen=True, eq=False)
class Standing:
    """Place of a landmark, and of the camera on the robot (PHYSICS section 8).

    Parameters
    ----------
    landmark_xy_m : (x, y)
    landmark_yaw_rad : float
    pan_rad : float
    pan_offset_xy_m, lens_offset_xy_m : (x, y)
        As :func:`~phasemark.matcher.robot_poses` has them.
    flat : bool
        Whether the landmark is a wide plane across the x axis, of yaw 0, which does not show where along it the camera
        stands: x and the heading are then all that is measured.
    one_side : bool
        Whether a symmetric landmark is taken to be seen first from the side that δ = 0 faces, within half a period, and
        then from the side that is nearest to what is expected, as is right where its own frame is all that matters.
        Otherwise every side is a pose of its own.
    """

    landmark_xy_m: tuple[float, float] = (0.0, 0.0)
    landmark_yaw_rad: float = 0.0
    pan_rad: float = 0.0
    pan_offset_xy_m: tuple[float, float] = (0.0, 0.0)
    lens_offset_xy_m: tuple[float, float] = (0.0, 0.0)
    flat: bool = False
    one_side: bool = True

    @property
    def rows(self) -> tuple[int, ...]:
        """Which of x, y and heading are measured."""
        return (0, 2) if self.flat else (0, 1, 2)

    def view(self, pose: NDArray[np.float64]) -> tuple[float, float, float]:
        """Return (D, δ, b) of the landmark seen from a pose of the robot, (x, y, heading).

        Of a wide plane that is the view of the point that the optical axis meets.
        """
        lens = lens_pose(pose, self.pan_rad, self.pan_offset_xy_m, self.lens_offset_xy_m)
        if self.flat:
            axis = float(lens[2])
            return float(self.landmark_xy_m[0] - lens[0]) / max(math.cos(axis), 0.1), axis, 0.0
        return view_of(lens, self.landmark_xy_m, self.landmark_yaw_rad)

    def sightings(self, match: Match, about: NDArray[np.float64] | None = None) -> list[Sighting]:
        """Return the poses that a match allows: of each symmetric side, and of the rivals of an ambiguous one.

        Parameters
        ----------
        match : Match
            With a covariance.
        about : (3,) float64, optional
            Expected pose, at which an undetermined match is linear: its covariance is too wide for the curve that it
            lies along. None: nothing is expected.
        """
        if about is not None and match.reason == "undetermined":
            return [self._about(match, about)]
        found, expected_rad = [], 0.0 if about is None else self.view(about)[1]
        for one, share in _explanations(match):
            if self.one_side:
                turn = math.remainder(one.delta_rad - expected_rad, math.tau / one.symmetry)
                one = replace(one, delta_rad=expected_rad + turn, symmetry=1)
            for pose in self._poses(one):
                at = np.array([pose.x_m, pose.y_m, pose.heading_rad])
                found.append(self._sighting(one, pose, at, at, math.log(share / one.symmetry)))
        return found

    def _about(self, match: Match, about: NDArray[np.float64]) -> Sighting:
        """Return what a match measures, to first order about a pose; of its symmetric sides the nearest."""
        view = self.view(about)
        change = np.array([getattr(match, name) for name in _VIEW]) - view
        change[1] = math.remainder(change[1], math.tau / match.symmetry)
        change[2] = math.remainder(change[2], math.tau)
        there = replace(match, distance_m=view[0], delta_rad=view[1], bearing_rad=view[2], symmetry=1)
        (pose,) = self._poses(there)
        return self._sighting(there, pose, about + self._jacobian(about) @ change, about, 0.0)

    def _poses(self, match: Match) -> list[RobotPose]:
        """Return the poses of the robot with the covariance of the noise alone."""
        assert match.covariance is not None
        own = match.covariance - sum(match.systematic.get(name, 0.0) for name in _SHARED)
        return robot_poses(
            replace(match, covariance=(own + own.T) / 2),
            self.landmark_xy_m,
            self.landmark_yaw_rad,
            self.pan_rad,
            pan_offset_xy_m=self.pan_offset_xy_m,
            lens_offset_xy_m=self.lens_offset_xy_m,
        )

    def _jacobian(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ∂ pose / ∂ (D, δ, b) at a pose, (3, 3)."""
        distance_m, _, bearing_rad = self.view(pose)
        camera_rad = float(pose[2]) + self.pan_rad
        towards = rotation(camera_rad + bearing_rad)[:, 0]
        to_pan, to_lens = rotation(pose[2]) @ self.pan_offset_xy_m, rotation(camera_rad) @ self.lens_offset_xy_m
        return pose_jacobian(distance_m, towards, float(pose[2]), camera_rad, to_pan, to_lens)[:, :3]

    def _sighting(
        self, match: Match, pose: RobotPose, at: NDArray[np.float64], linear_at: NDArray[np.float64], log_share: float
    ) -> Sighting:
        assert pose.covariance is not None
        noise = pose.covariance + _LEAST_VARIANCE * np.eye(3)
        return Sighting(at, noise, self.loading(match, linear_at), self.rows, log_share)

    def loading(self, match: Match, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return by what errors that all frames share move a pose, per standard deviation of each, (3, 3).

        Parameters
        ----------
        match : Match
            With a covariance.
        pose : (3,) float64
            Where they are linear.
        """
        shared = np.zeros((3, 3))
        places = [(k, _VIEW.index(name)) for k, name in enumerate(match.free) if name in _VIEW]
        own, into = np.array(places).T
        for name in _SHARED:
            if name in match.systematic:
                shared[np.ix_(into, into)] += match.systematic[name][np.ix_(own, own)]
        values, vectors = np.linalg.eigh(shared)
        # the symmetric root changes with the view as little as the covariance does
        return np.asarray(self._jacobian(pose) @ ((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T))


def is_open(match: Match) -> bool:
    """Return whether a refused match may show what its sightings do not: another class, or, undetermined, a far view.

    Parameters
    ----------
    match : Match
    """
    if match.accepted:
        return False
    others = sum(one.weight for one in match.alternatives if one.class_name != match.class_name)
    rivals = sum(one.weight for one in match.alternatives if one.class_name == match.class_name and _is_far(one, match))
    return others > _LEAST_SHARE or (match.reason == "undetermined" and rivals > _LEAST_SHARE)


def _is_far(one: Candidate, match: Match) -> bool:
    """Return whether a candidate is beyond the tolerance from the view of a match."""
    turn = math.remainder(one.delta_rad - match.delta_rad, math.tau / match.symmetry)
    return abs(one.distance_m - match.distance_m) > TOLERANCE_M or abs(turn) > TOLERANCE_RAD


def _explanations(match: Match) -> Iterator[tuple[Match, float]]:
    """Yield a match with its probability, and if it is ambiguous the other views of its class with theirs."""
    rivals = [other for other in match.alternatives if other.class_name == match.class_name][:_MOST_RIVALS]
    if match.reason != "ambiguous" or not rivals:
        yield match, 1.0
        return
    shares = [max(1 - sum(other.weight for other in match.alternatives), _LEAST_SHARE)]
    shares += [max(other.weight, _LEAST_SHARE) for other in rivals]
    total = sum(shares)
    yield match, shares[0] / total
    for other, share in zip(rivals, shares[1:], strict=True):
        names = (*_VIEW, "height_m", "pitch_rad", "roll_rad")
        yield replace(match, **{name: getattr(other, name) for name in names}), share / total
