"""Simulated robot: its true motion, and the readings of its odometry."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.sequence.odometry import OdometryPlan, Reading


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
