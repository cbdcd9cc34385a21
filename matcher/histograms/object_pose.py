"""The pose of a known object from several histograms, by maximum likelihood, with covariance and χ² (PHYSICS 7, 11).

Counts are Poisson, so a residual is weighted with 1/λ and the information is Σ_j ∂λ_j ∂λ_jᵀ / λ_j. Brightness and
ambient light of every histogram are free and are projected out. What the model itself may be off (:class:`ModelError`)
adds to the variance, and the covariance is then taken from the scatter of the histograms.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special
from scipy.stats import chi2

from phasemark import UsageError
from phasemark.matcher.estimate.solver import descend
from phasemark.matcher.histograms.scene_prediction import POSE_PARAMETERS, Linearised, ObjectScene, displaced
from phasemark.render.direct.histogram_frames import HistogramFrames

_MOST_STEPS = 12
_DONE = 1e-4  # squared standard deviations: what is left of a search that converges quadratically is far less
_SHARES = (1.0, 1 / 3, 1 / 9)
_LARGEST_STEP = {"m": 0.02, "rad": 0.15}
_WEAK = 1e-10  # eigenvalue of the scaled information below which a direction is not observable


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


MEASURED_ERROR = ModelError(0.05, 0.01)
"""What a fitted TMF8820 was off before two objects at poses that were not fitted."""

POISSON = ModelError()
"""Poisson noise alone."""


@dataclass(frozen=True, eq=False)
class ObjectPose:
    """Pose of an object with its covariance.

    Parameters
    ----------
    displacement : (6,) float64
        From where the mesh's file has it: metres along the world's axes, and a rotation vector, radians, about the
        object's centre. In the order of `POSE_PARAMETERS`.
    transform : (4, 4) float64
        The same as a transform of the mesh.
    free : tuple of str
        What was estimated, "support" included if it was.
    covariance : (p, p) float64
        Of the free parameters, in their order; infinite variance along directions that nothing tells.
    support : float
        Albedo of the support over that of the object.
    chi2 : float
        Whitened squared residual.
    dof : int
        Its degrees of freedom.
    accepted : bool
        Whether χ² is one that the object at this pose makes, at the given false-alarm rate.
    steps : int
        Steps of the search.
    """

    displacement: NDArray[np.float64]
    transform: NDArray[np.float64]
    free: tuple[str, ...]
    covariance: NDArray[np.float64]
    support: float
    chi2: float
    dof: int
    accepted: bool
    steps: int

    @property
    def p_value(self) -> float:
        """Probability of a larger χ² if the model is right."""
        return float(chi2.sf(self.chi2, self.dof))

    def std(self, name: str) -> float:
        """Return the standard deviation of a free parameter."""
        return float(np.sqrt(self.covariance[self.free.index(name), self.free.index(name)]))

    def as_dict(self) -> dict[str, object]:
        """Return the pose as plain numbers, for JSON."""
        return {
            "displacement": dict(zip(POSE_PARAMETERS, self.displacement.tolist(), strict=True)),
            "free": list(self.free),
            "covariance": self.covariance.tolist(),
            **{name: getattr(self, name) for name in ("support", "chi2", "dof", "p_value", "accepted")},
        }


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
    """

    information: NDArray[np.float64]
    gradient: NDArray[np.float64]
    chi2: NDArray[np.float64]
    dof: NDArray[np.int64]

    def of_poses(self, poses: NDArray[np.integer]) -> Evidence:
        """Return the evidence of some sensor poses."""
        return Evidence(self.information[poses], self.gradient[poses], self.chi2[poses], self.dof[poses])

    @classmethod
    def joined(cls, parts: Sequence[Evidence]) -> Evidence:
        """Return the evidence of several sensors, each histogram as a pose of one zone; (n · zones, 1, …)."""
        flat = [
            [values.reshape(-1, 1, *values.shape[2:]) for values in (one.information, one.gradient, one.chi2, one.dof)]
            for one in parts
        ]
        return cls(*(np.concatenate(columns) for columns in zip(*flat, strict=True)))


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
    return Evidence(information, gradient, chi2_of, np.full(residual.shape[:2], residual.shape[2] - 2))


def solve_jointly(
    evidence: Evidence, scales: NDArray[np.float64] | None = None, *, robust: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the Gauss-Newton step of all poses together, and its covariance.

    Parameters
    ----------
    evidence : Evidence
        The recorded histograms.
    scales : (p,) float64, optional
        Size of a step of each parameter; None: 1.
    robust : bool
        Whether the covariance is taken from how far the histograms' gradients scatter (H⁻¹ Σ g gᵀ H⁻¹, each histogram
        for itself) rather than from the information alone: for models that are off by more than noise. For few
        histograms it is so much larger that its 95 % ellipsoid is that of Hotelling's T².

    Returns
    -------
    step : (p,) float64
        0 along directions that nothing tells.
    covariance : (p, p) float64
        Infinite for parameters that an undetermined direction involves.
    """
    p = evidence.gradient.shape[-1]
    parts, gradients = evidence.information.reshape(-1, p, p), evidence.gradient.reshape(-1, p)
    information, gradient = parts.sum(axis=0), gradients.sum(axis=0)
    unit = np.ones(p) if scales is None else scales
    values, vectors = np.linalg.eigh(information * np.outer(unit, unit))
    weak = values <= _WEAK * max(values.max(initial=0.0), 1e-300)
    inverse = np.where(weak, 0.0, 1 / np.where(weak, 1.0, values))
    covariance = (vectors * inverse) @ vectors.T * np.outer(unit, unit)
    step = covariance @ gradient
    if robust:
        left = gradients - parts @ step
        n = int((evidence.chi2 > 0).sum())
        scatter = left.T @ left * (n / max(n - p, 1))
        covariance = covariance @ scatter @ covariance * _small_sample(n, p)
    if weak.any():
        blind = (vectors[:, weak] ** 2).sum(axis=1) > 1e-6
        covariance[blind, blind] = np.inf
    return step, covariance


def match_jointly(
    frames: HistogramFrames | Sequence[HistogramFrames],
    sensor2world: ArrayLike | Sequence[ArrayLike],
    scene: ObjectScene | Sequence[ObjectScene],
    *,
    start: ArrayLike = (0.0,) * 6,
    free: Sequence[str] = (*POSE_PARAMETERS, "support"),
    support: float = 1.0,
    model_error: ModelError = MEASURED_ERROR,
    systematic: tuple[float, float] = (0.0, 0.0),
    false_alarm: float = 0.01,
) -> ObjectPose:
    """Estimate the pose of an object from histograms of several sensor poses together, of one sensor or of several.

    Parameters
    ----------
    frames : HistogramFrames, or a sequence of them
        n positions of one sensor; or of each sensor.
    sensor2world : (n, 4, 4) array_like, or a sequence of them
        Pose of the optical frame at each position. Sensors on one mount have its pose times that of the sensor on it.
    scene : ObjectScene, or a sequence of them
        The same object, for each sensor.
    start : (6,) array_like
        Initial guess of the displacement; within about a bin and ten degrees.
    free : sequence of str
        What is estimated.
    support : float
        Initial guess of the support's albedo over the object's.
    model_error : ModelError
        What the model may be off; `POISSON`: nothing.
    systematic : (float, float)
        Standard deviations, metres and radians, of what is common to all poses and noise does not explain: the frame
        of the arm, the calibration. Added to the covariance.
    false_alarm : float
        Probability that the object itself is refused.

    Returns
    -------
    ObjectPose
        ``accepted`` is False where the histograms do not look like the object anywhere near the start.

    Raises
    ------
    UsageError
        Numbers of poses or of sensors differ, the objects are turned about different points, or an unknown parameter
        is named.
    """
    sensors = _by_sensor(frames, sensor2world, scene)
    if not 0 < false_alarm < 1:
        raise UsageError(f"'false_alarm' must lie between 0 and 1, got {false_alarm!r}")
    move = np.array(start, dtype=np.float64)
    if move.shape != (6,):
        raise UsageError(f"'start' must have 6 numbers, got {move.shape}")
    limits = np.array([_LARGEST_STEP.get(name.rpartition("_")[2], 1.0) for name in free])

    def at(values: NDArray[np.float64], ratio: float) -> _Supposed:
        parts = [
            evidence_of(one.linearise(seen, poses, values, ratio, free), seen.zone_counts, model_error)
            for seen, poses, one in sensors
        ]
        return _Supposed(at, tuple(free), values, ratio, parts[0] if len(parts) == 1 else Evidence.joined(parts))

    here, _, steps = descend(at(move, support), limits, most=_MOST_STEPS, done=_DONE, shares=_SHARES)
    _, covariance = solve_jointly(here.evidence, limits, robust=model_error != POISSON)
    common = {"m": systematic[0], "rad": systematic[1]}
    covariance = covariance + np.diag([common.get(name.rpartition("_")[2], 0.0) ** 2 for name in free])
    dof = int(here.evidence.dof.sum()) - len(free)
    return ObjectPose(
        here.displacement, sensors[0][2].moved(here.displacement), here.free, covariance, here.support, here.cost, dof,
        bool(chi2.sf(here.cost, dof) > false_alarm), steps,
    )  # fmt: skip


class _Supposed(NamedTuple):
    """Supposed pose of an object, with the evidence of all histograms there: a point of a descent."""

    at: Callable[[NDArray[np.float64], float], _Supposed]
    free: tuple[str, ...]
    displacement: NDArray[np.float64]
    support: float
    evidence: Evidence

    @property
    def cost(self) -> float:
        return float(self.evidence.chi2.sum())

    @property
    def information(self) -> NDArray[np.float64]:
        return np.asarray(self.evidence.information.sum(axis=(0, 1)))

    @property
    def gradient(self) -> NDArray[np.float64]:
        return np.asarray(self.evidence.gradient.sum(axis=(0, 1)))

    def moved(self, step: NDArray[np.float64]) -> _Supposed:
        step_of = dict(zip(self.free, step.tolist(), strict=True))
        values, ratio = displaced(self.displacement, self.support, step_of)
        most_support = 20.0
        return self.at(values, min(max(ratio, self.support / 3), 3 * self.support, most_support))


def _by_sensor(
    frames: HistogramFrames | Sequence[HistogramFrames],
    sensor2world: ArrayLike | Sequence[ArrayLike],
    scene: ObjectScene | Sequence[ObjectScene],
) -> list[tuple[HistogramFrames, NDArray[np.float64], ObjectScene]]:
    """Return frames, poses and scene of each sensor."""
    if isinstance(frames, HistogramFrames) and isinstance(scene, ObjectScene):
        return [(frames, np.asarray(sensor2world, dtype=np.float64), scene)]
    if isinstance(frames, HistogramFrames) or isinstance(scene, ObjectScene):
        raise UsageError("'frames' and 'scene' must both be of one sensor, or both be lists of the same sensors")
    poses = [np.asarray(one, dtype=np.float64) for one in sensor2world]  # type: ignore[union-attr]
    if not (len(frames) == len(poses) == len(scene) > 0):
        raise UsageError(
            "'frames', 'sensor2world' and 'scene' must name the same sensors, got"
            f" {len(frames)}, {len(poses)} and {len(scene)}"
        )
    for k, one in enumerate(scene):
        if not np.allclose(one.centre_m, scene[0].centre_m, rtol=0, atol=1e-9):
            raise UsageError(f"'scene' must hold one object: that of sensor {k} is turned about another point")
    return list(zip(frames, poses, scene, strict=True))


def _small_sample(n: int, p: int) -> float:
    """Return by what a covariance grows that n values tell, so that its 95 % ellipsoid is that of Hotelling's T²."""
    nu = max(n - p, 1)
    left = max(nu - p + 1, 1)
    limit = p * nu / left * special.fdtri(p, left, 0.95)
    return float(limit / special.chdtri(p, 0.05))
