"""Wheels that slip and a gyro that drifts: what really happens to the robot, and what its odometry reads."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.drive.follow import rotation
from phasemark.matcher.drive.plan import OdometryPlan

STATE = ("x_m", "y_m", "heading_rad", "slip", "gyro_bias_rad_s")
"""What the filter estimates: the pose, and the two errors that last."""


@dataclass(frozen=True)
class Reading:
    """Odometry of one step.

    Parameters
    ----------
    way_m : float
        From the wheel encoders.
    turn_rad : float
        From the gyro.
    time_s : float
    """

    way_m: float
    turn_rad: float
    time_s: float


@dataclass(frozen=True)
class OdometryModel:
    """The standard deviations of an :class:`OdometryPlan`, radians.

    Parameters
    ----------
    slip_std, slip_walk, along, across : float
        Walk and errors of the way per √m.
    bias_std_rad_s, bias_walk, turn : float
        Walk and angle random walk per √s.
    """

    slip_std: float
    slip_walk: float
    along: float
    across: float
    bias_std_rad_s: float
    bias_walk: float
    turn: float

    @classmethod
    def of(cls, plan: OdometryPlan) -> OdometryModel:
        """Take the figures of a plan."""
        return cls(
            slip_std=plan.slip_std,
            slip_walk=plan.slip_walk_per_sqrt_m,
            along=plan.along_m_per_sqrt_m,
            across=plan.across_m_per_sqrt_m,
            bias_std_rad_s=math.radians(plan.gyro_bias_std_deg_s),
            bias_walk=math.radians(plan.gyro_bias_walk_deg_s_per_sqrt_s),
            turn=math.radians(plan.gyro_noise_deg_per_sqrt_s),
        )

    def start(self, pose_covariance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the covariance of the whole state at the start, (5, 5)."""
        covariance = np.zeros((5, 5))
        covariance[:3, :3] = pose_covariance
        covariance[3, 3], covariance[4, 4] = self.slip_std**2, self.bias_std_rad_s**2
        return covariance


def moved(state: NDArray[np.float64], reading: Reading) -> NDArray[np.float64]:
    """Return the state after a step: way and turn less what slip and bias add to them, along an arc's chord.

    Parameters
    ----------
    state : (5,) float64
        In the order of :data:`STATE`.
    reading : Reading
    """
    turn = reading.turn_rad - state[4] * reading.time_s
    way = (1 - state[3]) * reading.way_m
    middle = state[2] + turn / 2
    after = state.copy()
    after[0] += way * math.cos(middle)
    after[1] += way * math.sin(middle)
    after[2] = math.remainder(state[2] + turn, math.tau)
    return after


def motion_jacobian(state: NDArray[np.float64], reading: Reading) -> NDArray[np.float64]:
    """Return ∂ moved / ∂ state, (5, 5)."""
    middle = state[2] + (reading.turn_rad - state[4] * reading.time_s) / 2
    cos, sin = math.cos(middle), math.sin(middle)
    way = (1 - state[3]) * reading.way_m
    jacobian = np.eye(5)
    jacobian[:2, 2] = -way * sin, way * cos
    jacobian[:2, 3] = -reading.way_m * cos, -reading.way_m * sin
    jacobian[:2, 4] = jacobian[:2, 2] * (-reading.time_s / 2)
    jacobian[2, 4] = -reading.time_s
    return jacobian


def motion_noise(state: NDArray[np.float64], reading: Reading, model: OdometryModel) -> NDArray[np.float64]:
    """Return the covariance that a step adds, (5, 5).

    Parameters
    ----------
    state : (5,) float64
    reading : Reading
    model : OdometryModel
    """
    way = abs(reading.way_m)
    axes = rotation(state[2])
    noise = np.zeros((5, 5))
    noise[:2, :2] = axes @ np.diag([model.along**2 * way, model.across**2 * way]) @ axes.T
    noise[2, 2] = model.turn**2 * reading.time_s
    noise[3, 3], noise[4, 4] = model.slip_walk**2 * way, model.bias_walk**2 * reading.time_s
    return noise


class World:
    """The robot as it really is: pose, slip and bias, which nobody on board knows.

    Parameters
    ----------
    pose : (x, y, heading)
        Where the robot believes it starts.
    pose_covariance : (3, 3) float64
        Of that belief.
    model : OdometryModel
    rng : numpy.random.Generator
    """

    def __init__(
        self,
        pose: NDArray[np.float64],
        pose_covariance: NDArray[np.float64],
        model: OdometryModel,
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
        along = (1 - slip) * wheels_m + model.along * math.sqrt(way) * noise[0]
        across = model.across * math.sqrt(way) * noise[1]
        self.state = np.array(
            [
                self.state[0] + along * math.cos(middle) - across * math.sin(middle),
                self.state[1] + along * math.sin(middle) + across * math.cos(middle),
                math.remainder(heading + turn_rad, math.tau),
                slip + model.slip_walk * math.sqrt(way) * noise[3],
                bias + model.bias_walk * math.sqrt(time_s) * noise[4],
            ]
        )
        read = turn_rad + bias * time_s + model.turn * math.sqrt(time_s) * noise[2]
        return Reading(wheels_m, read, time_s)

    def stand(self, time_s: float) -> None:
        """Advance time at rest: only the bias changes."""
        self.state[4] += self._model.bias_walk * math.sqrt(time_s) * self._rng.standard_normal()
