"""The extended Kalman filter that carries the pose from landmark to landmark, and learns slip and bias on the way."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.matcher.drive.odometry import OdometryModel, Reading, motion_jacobian, motion_noise, moved
from phasemark.matcher.position.landmark_map import Placement

POSE = 3
"""How many numbers of the state a landmark measures: x, y and heading."""


class PoseFilter:
    """Extended Kalman filter of pose, slip and gyro bias.

    The odometry drives the prediction; a measured pose with its covariance corrects it, unless the gate finds it too
    improbable. Slip and bias are corrected too, through what the prediction has tied them to.

    Parameters
    ----------
    pose : (x, y, heading)
        Pose at the start, metres and radians.
    pose_covariance : (3, 3) float64
        Covariance of that pose.
    model : OdometryModel
        Errors of wheels and gyro.
    gate : float
        Measurements as improbable as 1 − gate are refused.

    Attributes
    ----------
    state : (5,) float64
        In the order of :data:`~phasemark.matcher.drive.odometry.STATE`.
    covariance : (5, 5) float64
        Covariance of pose, slip and gyro bias.
    """

    def __init__(
        self, pose: Sequence[float], pose_covariance: NDArray[np.float64], model: OdometryModel, gate: float
    ) -> None:
        self.state: NDArray[np.float64] = np.array([*pose, 0.0, 0.0])
        self.covariance = model.start(pose_covariance)
        self._model = model
        self._limit = float(special.chdtri(POSE, 1 - gate))

    @property
    def pose(self) -> NDArray[np.float64]:
        """(x, y, heading), metres and radians."""
        return self.state[:POSE]

    @property
    def pose_covariance(self) -> NDArray[np.float64]:
        """Of the pose, (3, 3)."""
        return self.covariance[:POSE, :POSE]

    def predict(self, reading: Reading) -> None:
        """Take one step of the odometry."""
        jacobian = motion_jacobian(self.state, reading)
        noise = motion_noise(self.state, reading, self._model)
        self.covariance = jacobian @ self.covariance @ jacobian.T + noise
        self.state = moved(self.state, reading)

    def stand(self, time_s: float) -> None:
        """Advance time at rest: the pose stays, the variance of the bias grows."""
        self.covariance[4, 4] += self._model.bias_walk**2 * time_s

    def correct(self, placements: Sequence[Placement]) -> tuple[Placement | None, float]:
        """Correct the state by the most probable of several placements, if the gate lets it pass.

        Parameters
        ----------
        placements : sequence of Placement
            Of one match, each with its covariance; those without are no measurement.

        Returns
        -------
        used : Placement or None
            The one of the placements that was used; None: all are too far away.
        distance_squared : float
            Squared Mahalanobis distance of the nearest one, ~ χ²(3); infinite without any.
        """
        best, nearest = None, math.inf
        for placement in placements:
            if placement.pose.covariance is not None:
                innovation = self._innovation(placement)
                total = self.pose_covariance + placement.pose.covariance
                squared = float(innovation @ np.linalg.solve(total, innovation))
                if squared < nearest:
                    best, nearest = placement, squared
        if best is None or nearest > self._limit:
            return None, nearest
        measured = best.pose.covariance
        assert measured is not None
        gain = np.linalg.solve(self.pose_covariance + measured, self.covariance[:POSE]).T
        self.state = self.state + gain @ self._innovation(best)
        self.state[2] = math.remainder(self.state[2], math.tau)
        left = np.eye(len(self.state))
        left[:, :POSE] -= gain
        # Joseph's form: symmetric and positive whatever the rounding
        self.covariance = left @ self.covariance @ left.T + gain @ measured @ gain.T
        return best, nearest

    def _innovation(self, placement: Placement) -> NDArray[np.float64]:
        pose = placement.pose
        difference = np.array([pose.x_m, pose.y_m, pose.heading_rad]) - self.pose
        difference[2] = math.remainder(difference[2], math.tau)
        return difference
