"""Motion models: odometry of wheels that slip and a gyro that drifts; motion of which only the change is limited."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data.plans.bank_plan import PlanModel
from phasemark.matcher.position.landmark_map import Std
from phasemark.matcher.sequence.planar import rotation

_Floats = NDArray[np.float64]


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


class OdometryPlan(PlanModel):
    """Errors of wheels and gyro; the filter is given these standard deviations, not the errors.

    Parameters
    ----------
    slip_std : float
        Standard deviation of the slip, the share of the way by which the wheels turn in vain; drawn once for a drive.
    slip_walk_per_sqrt_m : float
        Random walk of the slip, for each √m of way.
    along_m_per_sqrt_m : float
        Random error of the way driven, forward: metres for each √m.
    across_m_per_sqrt_m : float
        Random error of the way driven, sideways: metres for each √m.
    gyro_bias_std_deg_s : float
        Standard deviation of the gyro's bias at the start, degrees a second.
    gyro_bias_walk_deg_s_per_sqrt_s : float
        Random walk of the gyro's bias, degrees a second for each √s.
    gyro_noise_deg_per_sqrt_s : float
        Angle random walk of the gyro, degrees for each √s.
    """

    slip_std: Std = 0.03
    slip_walk_per_sqrt_m: Std = 0.003
    along_m_per_sqrt_m: Std = 0.004
    across_m_per_sqrt_m: Std = 0.004
    gyro_bias_std_deg_s: Std = 0.2
    gyro_bias_walk_deg_s_per_sqrt_s: Std = 0.005
    gyro_noise_deg_per_sqrt_s: Std = 0.1

    def start(self, pose_covariance: _Floats) -> _Floats:
        """Return the covariance of the whole state at the start, (5, 5).

        The state is the pose (x_m, y_m, heading_rad), and the two errors that last: slip, gyro_bias_rad_s.
        """
        covariance = np.zeros((5, 5))
        covariance[:3, :3] = pose_covariance
        covariance[3, 3], covariance[4, 4] = self.slip_std**2, math.radians(self.gyro_bias_std_deg_s) ** 2
        return covariance

    def step(self, state: _Floats, reading: Reading) -> tuple[_Floats, _Floats, _Floats]:
        """Return the state after a step, (5,), its Jacobian by the state before, and the covariance that is added."""
        return moved(state, reading), motion_jacobian(state, reading), motion_noise(state, reading, self)

    def stand(self, covariance: _Floats, time_s: float) -> None:
        """Advance time at rest, in place: the pose stays, the variance of the bias grows."""
        covariance[4, 4] += math.radians(self.gyro_bias_walk_deg_s_per_sqrt_s) ** 2 * time_s


def moved(state: _Floats, reading: Reading) -> _Floats:
    """Return the state after a step: way and turn less what slip and bias add to them, along an arc's chord.

    Parameters
    ----------
    state : (5,) float64
        In the order of :meth:`OdometryPlan.start`.
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


def motion_jacobian(state: _Floats, reading: Reading) -> _Floats:
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


def motion_noise(state: _Floats, reading: Reading, model: OdometryPlan) -> _Floats:
    """Return the covariance that a step adds, (5, 5).

    Parameters
    ----------
    state : (5,) float64
    reading : Reading
    model : OdometryPlan
    """
    way = abs(reading.way_m)
    axes = rotation(state[2])
    noise = np.zeros((5, 5))
    noise[:2, :2] = axes @ np.diag(np.square([model.along_m_per_sqrt_m, model.across_m_per_sqrt_m]) * way) @ axes.T
    noise[2, 2] = math.radians(model.gyro_noise_deg_per_sqrt_s) ** 2 * reading.time_s
    noise[3, 3] = model.slip_walk_per_sqrt_m**2 * way
    noise[4, 4] = math.radians(model.gyro_bias_walk_deg_s_per_sqrt_s) ** 2 * reading.time_s
    return noise


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

    Raises
    ------
    UsageError
        One of them is negative or no number.
    """

    speed_std: float = 0.5
    acceleration: float = 1.0
    turn_std: float = 1.0
    turn_walk: float = 2.0
    gyro_noise: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < math.inf:
                raise UsageError(f"'{name}' must not be negative, got {value!r}")

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
