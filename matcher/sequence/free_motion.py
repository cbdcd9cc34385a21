"""Motion of which nothing is known but how fast it may change, with or without a gyro."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.sequence.odometry import Reading

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class FreeMotion:
    """Velocity that drifts: the state is (x, y, heading, velocity along x and y, turn rate).

    With a gyro, whose turn a :class:`~phasemark.matcher.sequence.Reading` has, the last number is the true turn
    rate less that of the gyro: minus its bias. Then give `turn_std` and `turn_walk` those of the bias.

    Parameters
    ----------
    speed_std : float
        Standard deviation of each component of the velocity at the start, m/s.
    acceleration : float
        By how much it changes: m/s per √s.
    turn_std : float
        Standard deviation of the turn rate at the start, rad/s.
    turn_walk : float
        By how much it changes: rad/s per √s.
    gyro_noise : float
        Angle random walk of the gyro: rad per √s.
    """

    speed_std: float = 0.5
    acceleration: float = 1.0
    turn_std: float = 1.0
    turn_walk: float = 2.0
    gyro_noise: float = 0.0

    def start(self, pose_covariance: _Floats) -> _Floats:
        """Return the covariance of the whole state at the start, (6, 6)."""
        covariance = np.diag(np.square([0.0, 0.0, 0.0, self.speed_std, self.speed_std, self.turn_std]))
        covariance[:3, :3] = pose_covariance
        return covariance

    def step(self, state: _Floats, reading: Reading) -> tuple[_Floats, _Floats, _Floats]:
        """Return the state after a step, (6,), its Jacobian by the state before, and the covariance that is added."""
        time_s = reading.time_s
        jacobian = np.eye(6)
        jacobian[[0, 1, 2], [3, 4, 5]] = time_s
        after = jacobian @ state
        after[2] = math.remainder(after[2] + reading.turn_rad, math.tau)
        # a velocity that walks: ∫∫ of white noise over the step
        shares = np.array([[time_s**3 / 3, time_s**2 / 2], [time_s**2 / 2, time_s]])
        noise = np.zeros((6, 6))
        for k, walk in ((0, self.acceleration), (1, self.acceleration), (2, self.turn_walk)):
            noise[np.ix_([k, k + 3], [k, k + 3])] = walk**2 * shares
        noise[2, 2] += self.gyro_noise**2 * time_s
        return after, jacobian, noise

    def stand(self, covariance: _Floats, time_s: float) -> None:
        """Advance time at rest, in place: the velocity is 0 and stays so."""
        covariance[5, 5] += self.turn_walk**2 * time_s
