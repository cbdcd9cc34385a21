"""Evidence of histograms about the pose of an object: information and gradient of each, about a supposed pose.

Counts are Poisson, so a residual is weighted with 1/λ and the information is Σ_j ∂λ_j ∂λ_jᵀ / λ_j. Brightness and
ambient light of every histogram are free and are projected out. What the model itself may be off (:class:`ModelError`)
adds to the variance with which a bin is weighted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.histograms.scene_prediction import Linearised
from phasemark.render.direct.fit_model import FLOOR, PEAK_FLOOR

_LARGEST_STEP = {"m": 0.02, "rad": 0.15}


class ModelError(NamedTuple):
    """Errors of a sensor's model, as standard deviations of expected counts.

    Parameters
    ----------
    count_share : float
        Standard deviation of an expected count, as a share of it.
    peak_share : float
        The same as a share of the histogram's highest count, in every bin.
    """

    count_share: float = 0.0
    peak_share: float = 0.0


POISSON = ModelError()
"""Poisson noise alone."""

FITTED = ModelError(FLOOR, PEAK_FLOOR)
"""As the fit of a sensor weights bins."""


@dataclass(frozen=True)
class Evidence:
    """Information and gradient of every histogram about one object pose.

    Parameters
    ----------
    information : (n, zones, p, p) float64
        Fisher information in the free parameters.
    gradient : (n, zones, p) float64
        Gradient of the log-likelihood by them.
    chi2 : (n, zones) float64
        Whitened squared residuals of each histogram.
    dof : (n, zones) int
        Degrees of freedom of each.
    free : tuple of str
        The parameters.
    direction, lever : (n, 3), (n, 6, 6) float64
        As :class:`~phasemark.matcher.histograms.scene_prediction.Linearised` has them.
    """

    information: NDArray[np.float64]
    gradient: NDArray[np.float64]
    chi2: NDArray[np.float64]
    dof: NDArray[np.int64]
    free: tuple[str, ...]
    direction: NDArray[np.float64]
    lever: NDArray[np.float64]

    def of_poses(self, poses: NDArray[np.integer]) -> Evidence:
        """Return the evidence of some sensor poses."""
        own = {name: values[poses] for name, values in vars(self).items() if name != "free"}
        return replace(self, **own)

    def of_parameters(self, free: Sequence[str]) -> Evidence:
        """Return the evidence about some of the parameters, the others being known."""
        k = [self.free.index(name) for name in free]
        return replace(
            self, information=self.information[..., k, :][..., k], gradient=self.gradient[..., k], free=tuple(free)
        )

    @classmethod
    def joined(cls, parts: Sequence[Evidence]) -> Evidence:
        """Return the evidence of several sensors; a sensor of fewer zones has empty ones."""
        zones = max(one.dof.shape[1] for one in parts)

        def padded(values: NDArray[np.float64] | NDArray[np.int64]) -> NDArray[np.float64]:
            return np.pad(values, [(0, 0), (0, zones - values.shape[1])] + [(0, 0)] * (values.ndim - 2))

        def of(name: str) -> NDArray[np.float64]:
            return np.concatenate([padded(getattr(one, name)) for one in parts])

        geometry = (np.concatenate([getattr(one, name) for one in parts]) for name in ("direction", "lever"))
        return cls(of("information"), of("gradient"), of("chi2"), of("dof").astype(np.int64), parts[0].free, *geometry)


def evidence_of(linear: Linearised, measured: NDArray[np.float64], model_error: ModelError = POISSON) -> Evidence:
    """Return what histograms tell about an object pose, brightness and ambient light of each projected out.

    Parameters
    ----------
    linear : Linearised
        Expected counts at the pose, and their slopes.
    measured : (n, zones, bins) float64
        Counts.
    model_error : ModelError
        Errors of the model beside the noise.
    """
    expected = linear.expected
    peak = expected.max(axis=-1, keepdims=True)
    variance = expected + (model_error.count_share * expected) ** 2 + (model_error.peak_share * peak) ** 2
    root = 1 / np.sqrt(variance)
    residual = (measured - expected) * root
    slope = linear.slope * root[..., None]
    nuisance = np.stack([linear.brightness * root, root], axis=-1)
    q, _ = np.linalg.qr(nuisance)
    residual = residual - np.einsum("nzbk,nzk->nzb", q, np.einsum("nzbk,nzb->nzk", q, residual))
    slope = slope - np.einsum("nzbk,nzkp->nzbp", q, np.einsum("nzbk,nzbp->nzkp", q, slope))
    information = np.einsum("nzbp,nzbq->nzpq", slope, slope, optimize=True)
    gradient = np.einsum("nzbp,nzb->nzp", slope, residual)
    chi2_of = (residual**2).sum(axis=2)
    dof = np.full(residual.shape[:2], residual.shape[2] - 2)
    return Evidence(information, gradient, chi2_of, dof, linear.free, linear.direction, linear.lever)


def solve_jointly(
    evidence: Evidence, scales: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the Gauss-Newton step of all poses together, and the inverse of their information.

    Parameters
    ----------
    evidence : Evidence
        The recorded histograms.
    scales : (p,) float64, optional
        Size of a step of each parameter; None: 2 cm, 0.15 rad, and 1 of the albedo.

    Returns
    -------
    step : (p,) float64
        0 along directions that nothing tells.
    covariance : (p, p) float64
        Infinite for parameters that an undetermined direction involves.
    """
    step, covariance, blind = gauss_newton(evidence, scales)
    covariance[blind, blind] = np.inf
    return step, covariance


def gauss_newton(
    evidence: Evidence, scales: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return the step, the pseudo-inverse of the information, and which parameters an undetermined direction involves.

    Parameters
    ----------
    evidence, scales
        As for :func:`solve_jointly`.
    """
    information, gradient = evidence.information.sum(axis=(0, 1)), evidence.gradient.sum(axis=(0, 1))
    unit = largest_steps(evidence.free) if scales is None else scales
    values, vectors = np.linalg.eigh(information * np.outer(unit, unit))
    least = 1e-10  # eigenvalue of the scaled information below which a direction is not observable
    weak = values <= least * max(values.max(initial=0.0), 1e-300)
    inverse = np.where(weak, 0.0, 1 / np.where(weak, 1.0, values))
    covariance = (vectors * inverse) @ vectors.T * np.outer(unit, unit)
    return covariance @ gradient, covariance, (vectors[:, weak] ** 2).sum(axis=1) > 1e-6


def largest_steps(free: Sequence[str]) -> NDArray[np.float64]:
    """Return the largest step of each parameter, which is its scale, (p,)."""
    return np.array([_LARGEST_STEP.get(name.rpartition("_")[2], 1.0) for name in free])
