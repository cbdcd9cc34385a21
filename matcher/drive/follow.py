"""Simulated robot: its true motion with the readings of its odometry, its path, and the aim of its camera."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark.matcher.sequence.odometry import OdometryPlan, Reading
from phasemark.matcher.sequence.planar import lens_pose


class Path:
    """A path of straight pieces, walked once from one end to the other.

    Parameters
    ----------
    waypoints_m : (n, 2) array_like
    """

    def __init__(self, waypoints_m: ArrayLike) -> None:
        self._points = np.asarray(waypoints_m, np.float64)
        self._at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self._points, axis=0), axis=1))])
        self.progress_m = 0.0
        """How much of the path lies behind; it only grows, so a path may cross itself."""

    @property
    def length_m(self) -> float:
        """From end to end."""
        return float(self._at[-1])

    @property
    def is_done(self) -> bool:
        """Whether the end is reached."""
        return self.progress_m >= self.length_m - 1e-9

    @property
    def start_heading_rad(self) -> float:
        """From the first waypoint to the second."""
        along = self._points[1] - self._points[0]
        return math.atan2(along[1], along[0])

    def point(self, progress_m: float) -> NDArray[np.float64]:
        """Return the point so far along the path; past the end the last piece goes on, so that the robot passes it."""
        if progress_m > self.length_m:
            along = (self._points[-1] - self._points[-2]) / (self._at[-1] - self._at[-2])
            return np.asarray(self._points[-1] + along * (progress_m - self.length_m))
        return self._on_path(progress_m)

    def _on_path(self, progress_m: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points of the path, (..., 2)."""
        return np.stack([np.interp(progress_m, self._at, self._points[:, k]) for k in range(2)], axis=-1)

    def advance(self, xy_m: ArrayLike, reach_m: float) -> None:
        """Move the progress to the point nearest to the robot, at most `reach_m` further on.

        Parameters
        ----------
        xy_m : (2,) array_like
        reach_m : float
        """
        ahead = np.linspace(self.progress_m, min(self.progress_m + reach_m, self.length_m), 21)
        distance = np.linalg.norm(self._on_path(ahead) - np.asarray(xy_m), axis=1)
        self.progress_m = float(ahead[distance.argmin()])

    def turn_rate(self, pose: Sequence[float] | NDArray[np.float64], speed_m_s: float, lookahead_m: float) -> float:
        """Return the turn rate of the arc that leads to the point ahead, rad/s: 2 v sin(α) / distance.

        Parameters
        ----------
        pose : (x, y, heading)
        speed_m_s, lookahead_m : float
        """
        goal = self.point(self.progress_m + lookahead_m) - np.asarray(pose[:2])
        angle = math.remainder(math.atan2(goal[1], goal[0]) - pose[2], math.tau)
        if abs(angle) > math.pi / 2:  # behind: turn towards it as fast as any arc would
            return math.copysign(2 * speed_m_s / lookahead_m, angle)
        return 2 * speed_m_s * math.sin(angle) / max(float(np.linalg.norm(goal)), 1e-6)


def pan_towards(
    pose: Sequence[float] | NDArray[np.float64], target_m: ArrayLike, pan_offset_m: ArrayLike, lens_offset_m: ArrayLike
) -> float:
    """Return the pan angle that points the optical axis at a point, radians in (−π, π].

    Parameters
    ----------
    pose : (x, y, heading)
    target_m : (2,) array_like
    pan_offset_m, lens_offset_m : (2,) array_like
    """
    pan = 0.0
    # the lens moves as the camera turns, by millimetres of a metre: each round leaves about a tenth of the error
    aim_rounds = 4
    for _ in range(aim_rounds):
        to = np.asarray(target_m) - lens_pose(pose, pan, pan_offset_m, lens_offset_m)[:2]
        pan = math.remainder(math.atan2(to[1], to[0]) - pose[2], math.tau)
    return pan


class World:
    """The robot as it really is: pose, slip and bias, which nobody on board knows.

    Parameters
    ----------
    pose : (x, y, heading)
        Where the robot believes it starts.
    pose_covariance : (3, 3) float64
        Of that belief.
    model : OdometryPlan
    rng : numpy.random.Generator
    """

    def __init__(
        self,
        pose: NDArray[np.float64],
        pose_covariance: NDArray[np.float64],
        model: OdometryPlan,
        rng: np.random.Generator,
    ) -> None:
        self._model, self._rng = model, rng
        root = np.sqrt(np.diag(model.start(pose_covariance)))
        self.state: NDArray[np.float64] = np.array([*pose, 0.0, 0.0]) + root * rng.standard_normal(5)

    def step(self, wheels_m: float, turn_rad: float, time_s: float) -> Reading:
        """Turn the wheels and the robot, and return what the odometry reads.

        Parameters
        ----------
        wheels_m : float
            Way that the wheels turn.
        turn_rad : float
            By how much the robot really turns.
        time_s : float
        """
        model, way = self._model, abs(wheels_m)
        noise = self._rng.standard_normal(5)
        _, _, heading, slip, bias = self.state
        middle = heading + turn_rad / 2
        along = (1 - slip) * wheels_m + model.along_m_per_sqrt_m * math.sqrt(way) * noise[0]
        across = model.across_m_per_sqrt_m * math.sqrt(way) * noise[1]
        self.state = np.array(
            [
                self.state[0] + along * math.cos(middle) - across * math.sin(middle),
                self.state[1] + along * math.sin(middle) + across * math.cos(middle),
                math.remainder(heading + turn_rad, math.tau),
                slip + model.slip_walk_per_sqrt_m * math.sqrt(way) * noise[3],
                bias + math.radians(model.gyro_bias_walk_deg_s_per_sqrt_s) * math.sqrt(time_s) * noise[4],
            ]
        )
        read = turn_rad + bias * time_s + math.radians(model.gyro_noise_deg_per_sqrt_s) * math.sqrt(time_s) * noise[2]
        return Reading(wheels_m, read, time_s)

    def stand(self, time_s: float) -> None:
        """Advance time at rest: only the bias changes."""
        walk = math.radians(self._model.gyro_bias_walk_deg_s_per_sqrt_s)
        self.state[4] += walk * math.sqrt(time_s) * self._rng.standard_normal()
