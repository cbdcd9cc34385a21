"""The extended Kalman filter that carries a pose from measurement to measurement, and learns what lasts on the way."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.matcher.position.landmark_map import Placement
from phasemark.matcher.sequence.odometry import Reading

POSE = 3
"""How many numbers of the state a landmark measures: x, y and heading."""
_Floats = NDArray[np.float64]


class Motion(Protocol):
    """Interface of a model of motion; the first three numbers of its state are the pose (x, y, heading)."""

    def start(self, pose_covariance: _Floats) -> _Floats:
        """Return the covariance of the whole state at the start, (n, n)."""

    def step(self, state: _Floats, reading: Reading) -> tuple[_Floats, _Floats, _Floats]:
        """Return the state after a step, (n,), its Jacobian by the state before, and the covariance that is added."""

    def stand(self, covariance: _Floats, time_s: float) -> None:
        """Advance time at rest, in place."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """Pose that a frame measures.

    Parameters
    ----------
    pose : (3,) float64
        x, y and heading, metres and radians.
    covariance : (3, 3) float64
        Of its own noise.
    loading : (3, k) float64
        What errors that all frames of a recording share move it by, per standard deviation of each: L Lᵀ is their
        covariance.
    rows : tuple of int
        Which numbers of the pose are measured.
    log_weight : float
        Logarithm of the probability of this pose among those that the frame allows.
    """

    pose: _Floats
    covariance: _Floats
    loading: _Floats
    rows: tuple[int, ...] = (0, 1, 2)
    log_weight: float = 0.0


@dataclass(frozen=True, eq=False)
class _Step:
    """One step of a filter, with the steps before it: state and covariance as predicted, and as corrected then."""

    jacobian: _Floats
    predicted: tuple[_Floats, _Floats]
    corrected: tuple[_Floats, _Floats]
    before: _Step | None


class PoseFilter:
    """Extended Kalman filter of a pose and of the errors that last.

    Odometry drives the prediction; a measured pose with its covariance corrects it, unless the gate finds it too
    improbable. Slip and bias are corrected too, through what the prediction has tied them to. So is the bias of the
    recording: errors that all frames share are further numbers of the state, which stay as they are.

    Parameters
    ----------
    pose : (x, y, heading)
        Pose at the start, metres and radians.
    pose_covariance : (3, 3) float64
        Covariance of that pose.
    model : Motion
        How the pose moves, such as the errors of wheels and gyro.
    gate : float
        Measurements as improbable as 1 − gate are refused.
    n_shared : int
        How many numbers of the state are the bias of the recording.

    Attributes
    ----------
    state : (n,) float64
        The pose, the further numbers of the model, and the bias in its standard deviations.
    covariance : (n, n) float64
        Of the state.
    """

    def __init__(
        self,
        pose: Sequence[float] | _Floats,
        pose_covariance: _Floats,
        model: Motion,
        gate: float,
        *,
        n_shared: int = 0,
    ) -> None:
        moving = model.start(pose_covariance)
        self._moving, n = len(moving), len(moving) + n_shared
        self.state: _Floats = np.zeros(n)
        self.state[:POSE] = pose
        self.covariance: _Floats = np.eye(n)
        self.covariance[: self._moving, : self._moving] = moving
        self._model = model
        self._gate = gate
        self._steps: _Step | None = None
        self._jacobian, self._predicted = np.eye(n), (self.state, self.covariance)
        self.rate: _Floats = np.zeros(POSE)
        self.rate_covariance: _Floats = np.zeros((POSE, POSE))
        """How fast the pose changed in the last prediction, per second, and how well that is known."""

    @property
    def pose(self) -> _Floats:
        """(x, y, heading), metres and radians."""
        return self.state[:POSE]

    @property
    def pose_covariance(self) -> _Floats:
        """Of the pose, (3, 3)."""
        return self.covariance[:POSE, :POSE]

    def copy(self) -> PoseFilter:
        """Return a filter that goes its own way from here."""
        other = copy.copy(self)
        other.state, other.covariance = self.state.copy(), self.covariance.copy()
        return other

    def predict(self, reading: Reading) -> None:
        """Take one step of the odometry."""
        m = self._moving
        jacobian, noise = np.eye(len(self.state)), np.zeros_like(self.covariance)
        after, jacobian[:m, :m], noise[:m, :m] = self._model.step(self.state[:m], reading)
        change = after[:POSE] - self.pose
        change[2] = math.remainder(change[2], math.tau)
        if reading.time_s > 0:
            by_state = (jacobian - np.eye(len(jacobian)))[:POSE] / reading.time_s
            self.rate, self.rate_covariance = change / reading.time_s, by_state @ self.covariance @ by_state.T
        self.covariance = jacobian @ self.covariance @ jacobian.T + noise
        self.state = np.concatenate([after, self.state[m:]])
        self._jacobian, self._predicted = jacobian @ self._jacobian, (self.state, self.covariance)

    def stand(self, time_s: float) -> None:
        """Advance time at rest."""
        self._model.stand(self.covariance, time_s)

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
        best, nearest, chosen = None, math.inf, None
        for placement in placements:
            own = placement.pose
            if own.covariance is not None:
                pose = np.array([own.x_m, own.y_m, own.heading_rad])
                sighting = Sighting(pose, own.covariance, np.zeros((POSE, POSE)))
                squared, _ = self.distance(sighting)
                if squared < nearest:
                    best, nearest, chosen = placement, squared, sighting
        if chosen is None or not self.passes(chosen, nearest):
            return None, nearest
        self.take(chosen)
        return best, nearest

    def distance(self, sighting: Sighting) -> tuple[float, float]:
        """Return the squared Mahalanobis distance of a measured pose, and the logarithm of its probability density."""
        innovation, design, noise = self._compared(sighting)
        total = design @ self.covariance @ design.T + noise
        squared = float(innovation @ np.linalg.solve(total, innovation))
        return squared, -0.5 * (squared + float(np.linalg.slogdet(2 * math.pi * total)[1]))

    def passes(self, sighting: Sighting, squared: float) -> bool:
        """Return whether the gate lets a measured pose pass whose squared Mahalanobis distance is known."""
        return squared <= float(special.chdtri(len(sighting.rows), 1 - self._gate))

    def take(self, sighting: Sighting) -> None:
        """Correct the state by a measured pose."""
        innovation, design, noise = self._compared(sighting)
        gain = np.linalg.solve(design @ self.covariance @ design.T + noise, design @ self.covariance).T
        self.state = self.state + gain @ innovation
        self.state[2] = math.remainder(self.state[2], math.tau)
        left = np.eye(len(self.state)) - gain @ design
        # Joseph's form: symmetric and positive whatever the rounding
        self.covariance = left @ self.covariance @ left.T + gain @ noise @ gain.T

    def _compared(self, sighting: Sighting) -> tuple[_Floats, _Floats, _Floats]:
        """Return the innovation of a measured pose, its Jacobian by the state, and the covariance of its noise."""
        rows = list(sighting.rows)
        design = np.zeros((POSE, len(self.state)))
        design[:, :POSE] = np.eye(POSE)
        difference = sighting.pose - self.pose
        noise = sighting.covariance
        if len(self.state) > self._moving:
            design[:, self._moving :] = sighting.loading
            difference = difference - sighting.loading @ self.state[self._moving :]
        else:
            noise = noise + sighting.loading @ sighting.loading.T
        difference[2] = math.remainder(difference[2], math.tau)
        return difference[rows], design[rows], noise[np.ix_(rows, rows)]

    def mark(self) -> None:
        """Keep what happened since the last mark as one step for the smoother."""
        self._steps = _Step(self._jacobian, self._predicted, (self.state, self.covariance), self._steps)
        self._jacobian, self._predicted = np.eye(len(self.state)), (self.state, self.covariance)

    def smoothed(self) -> list[tuple[_Floats, _Floats]]:
        """Return state and covariance at every mark, by all measurements before and after (Rauch, Tung, Striebel 1965).

        Returns
        -------
        list of (state, covariance)
            In the order of time; the last is that of the filter at its last mark.
        """
        later = self._steps
        found = [later.corrected] if later is not None else []
        while later is not None and later.before is not None:
            step, (state, covariance) = later.before, found[-1]
            gain = np.linalg.solve(later.predicted[1], later.jacobian @ step.corrected[1]).T
            change = state - later.predicted[0]
            change[2] = math.remainder(change[2], math.tau)
            wider = covariance - later.predicted[1]
            found.append((step.corrected[0] + gain @ change, step.corrected[1] + gain @ wider @ gain.T))
            later = step
        return found[::-1]
