"""Errors of a located object beside noise: of the model, the arm, the hand-eye transform, and the mesh.

A joint estimate weights pose i by W_i = H⁻¹ I_i, I_i being its information and H their sum. Where pose i shows the
object displaced by u_i, the estimate errs by Σ_i W_i u_i, so that errors with covariances E[u_i u_jᵀ] = U_ij make

    C = Σ_ij W_i U_ij W_jᵀ .

Noise and what the model errs in each histogram for itself are scale² I_i and the sum over zones of I_iz D I_iz, the
position of each pose U_ii = D, what poses that look from one side share U_ij = D exp(−angle² / 2 reach²), the hand-eye
transform U_ij = L_i D L_jᵀ with the lever L_i of each pose; the mesh adds its D to C.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.histograms.pose_evidence import Evidence, gauss_newton
from phasemark.matcher.histograms.scene_prediction import POSE_PARAMETERS
from phasemark.render.sensor.histogram_fields import Histogram

_Float = NDArray[np.float64]


class PoseErrors(NamedTuple):
    """Standard deviations of errors, as displacements of the object that they seem to be, a component.

    Parameters
    ----------
    scale : float
        Scatter of histograms over what their weights expect; 1: noise alone.
    zone_m : float
        Of each histogram for itself.
    pose_m, pose_rad : float
        Of each pose: the position that the arm states.
    side_m, side_rad : float
        Of poses that look from one side.
    side_reach_rad : float
        Angle between two directions over which that error changes.
    hand_m, hand_rad : float
        Of the hand-eye transform, along and about the axes of the sensor.
    object_m, object_rad : float
        Of the mesh: dimensions and place.
    """

    scale: float = 1.0
    zone_m: float = 0.0
    pose_m: float = 0.0
    pose_rad: float = 0.0
    side_m: float = 0.0
    side_rad: float = 0.0
    side_reach_rad: float = math.radians(30)
    hand_m: float = 0.0
    hand_rad: float = 0.0
    object_m: float = 0.0
    object_rad: float = 0.0

    @classmethod
    def of(cls, histogram: Histogram) -> PoseErrors | None:
        """Return the errors that a sensor states; None if it states none."""
        if not histogram.error_scale:
            return None
        stated = {name: getattr(histogram, f"error_{name.replace('_rad', '_deg')}") for name in cls._fields}
        return cls(**{name: math.radians(x) if name.endswith("_rad") else x for name, x in stated.items()})

    def as_fields(self) -> dict[str, float]:
        """Return the fields of a sensor's table [histogram] that state these errors."""
        return {
            f"error_{name.replace('_rad', '_deg')}": float(
                f"{math.degrees(value) if name.endswith('_rad') else value:.4g}"
            )
            for name, value in self._asdict().items()
        }

    def covariance_of(self, name: str) -> _Float:
        """Return the covariance of the displacement by one of pose, side, hand, object, (6, 6)."""
        metres, radians = getattr(self, f"{name}_m"), getattr(self, f"{name}_rad")
        return np.diag([metres**2] * 3 + [radians**2] * 3)


NO_ERRORS = PoseErrors()
"""Noise alone."""

ASSUMED_ERRORS = PoseErrors(
    3.3, 0.9e-3, 0.0, 0.0, 0.7e-3, math.radians(0.9), math.radians(32), 1.5e-3, math.radians(0.4), 1e-3,
    math.radians(0.5),
)  # fmt: skip
"""Of a fitted TMF8820 before two objects on an arm; those of the object are assumed."""


@dataclass(frozen=True, eq=False)
class Contrast:
    """Linear combination of the gradients of poses: a joint estimate, or the difference of two of the same object.

    Parameters
    ----------
    information : (n, p, p) float64
        Of each pose.
    squares : (n, p, p) float64
        Sum of I_iz P I_iz over its zones, P taking the translation.
    direction : (n, 3) float64
    lever : (n, p, 6) float64
    places : (p, 6) float64
        Which parameter is which displacement.
    weight : (n, p, p) float64
        By which the gradient of each pose enters.
    """

    information: _Float
    squares: _Float
    direction: _Float
    lever: _Float
    places: _Float
    weight: _Float

    @classmethod
    def estimate(cls, evidence: Evidence) -> Contrast:
        """Return the joint estimate of all poses."""
        inverse = gauss_newton(evidence)[1]
        places = np.array([[float(name == one) for one in POSE_PARAMETERS] for name in evidence.free])
        moves = places[:, :3] @ places[:, :3].T
        squares = np.einsum("izab,bc,izcd->iad", evidence.information, moves, evidence.information, optimize=True)
        weight = np.broadcast_to(inverse, (len(squares), *inverse.shape))
        information, lever = evidence.information.sum(axis=1), places @ evidence.lever
        return cls(information, squares, evidence.direction, lever, places, weight)

    def less(self, other: Contrast) -> Contrast:
        """Return the difference from another estimate of the same object."""
        names = ("information", "squares", "direction", "lever")
        both = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in names}
        return replace(self, **both, weight=np.concatenate([self.weight, -other.weight]))

    def hand(self) -> _Float:
        """Return by how much it errs where the hand-eye transform does, (p, 6)."""
        return np.asarray(np.einsum("iab,ibc,icd->ad", self.weight, self.information, self.lever, optimize=True))

    def terms(self, errors: PoseErrors) -> dict[str, _Float]:
        """Return the covariances of model, pose and side, (p, p) each."""
        own = errors.scale**2 * self.information + errors.zone_m**2 * self.squares
        pull = self.weight @ self.information @ self.places
        near = np.exp(-0.5 * (angles(self.direction) / errors.side_reach_rad) ** 2)
        pose, side = errors.covariance_of("pose"), errors.covariance_of("side")
        return {
            "model": np.einsum("iab,ibc,idc->ad", self.weight, own, self.weight, optimize=True),
            "pose": np.einsum("iab,bc,idc->ad", pull, pose, pull, optimize=True),
            "side": np.einsum("iab,bc,jdc,ij->ad", pull, side, pull, near, optimize=True),
        }


def angles(direction: _Float) -> _Float:
    """Return the angles between unit vectors (n, 3), radians, (n, n)."""
    return np.asarray(np.arccos(np.clip(direction @ direction.T, -1, 1)))


def gradient_covariance(seen: Contrast, errors: PoseErrors) -> _Float:
    """Return the covariance of the gradients of all poses, hand-eye and mesh apart, (n p, n p)."""
    n, p = seen.information.shape[:2]
    near = np.exp(-0.5 * (angles(seen.direction) / errors.side_reach_rad) ** 2)
    pull = seen.information @ seen.places
    flat = pull.reshape(n * p, -1)
    out = (flat @ errors.covariance_of("side") @ flat.T).reshape(n, p, n, p) * near[:, None, :, None]
    every = np.arange(n)
    out[every, :, every, :] += (
        errors.scale**2 * seen.information
        + errors.zone_m**2 * seen.squares
        + pull @ errors.covariance_of("pose") @ pull.transpose(0, 2, 1)
    )
    return np.asarray(out.reshape(n * p, n * p))
