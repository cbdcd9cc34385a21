"""The pose of a known object from several histograms, by maximum likelihood, with covariance and χ² (PHYSICS 7, 11).

The evidence is that of :mod:`~phasemark.matcher.histograms.pose_evidence`, the covariance holds what
:mod:`~phasemark.matcher.histograms.pose_errors` describes beside noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from phasemark import UsageError
from phasemark.matcher.estimate.solver import descend
from phasemark.matcher.histograms.pose_calibration import PoseCalibration
from phasemark.matcher.histograms.pose_errors import ASSUMED_ERRORS, NO_ERRORS, Contrast, PoseErrors
from phasemark.matcher.histograms.pose_evidence import (
    FITTED,
    POISSON,
    Evidence,
    evidence_of,
    gauss_newton,
    largest_steps,
)
from phasemark.matcher.histograms.scene_prediction import POSE_PARAMETERS, ObjectScene, displaced
from phasemark.render.direct.histogram_frames import HistogramFrames

_MOST_STEPS = 12
_DONE = 1e-4  # squared standard deviations: what is left of a search that converges quadratically is far less
_SHARES = (1.0, 1 / 3, 1 / 9)


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
    terms : dict of str to (p, p) float64
        Parts of the covariance: "model" (noise and what histograms err each for itself), "pose" (the arm), "side" (what
        poses from one side share), "hand" (hand-eye transform) and "object" (mesh).
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
    terms: dict[str, NDArray[np.float64]]

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
            "terms": {name: term.tolist() for name, term in self.terms.items()},
            **{name: getattr(self, name) for name in ("support", "chi2", "dof", "p_value", "accepted")},
        }


def match_jointly(
    frames: HistogramFrames | Sequence[HistogramFrames],
    sensor2world: ArrayLike | Sequence[ArrayLike],
    scene: ObjectScene | Sequence[ObjectScene],
    *,
    start: ArrayLike | None = None,
    free: Sequence[str] = (*POSE_PARAMETERS, "support"),
    support: float = 1.0,
    errors: PoseErrors | None = None,
    calibration: PoseCalibration | None = None,
    name: str | None = None,
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
    start : (6,) array_like, optional
        Initial guess of the displacement; within about a bin and ten degrees. None: the place of the calibration, or 0.
    free : sequence of str
        What is estimated.
    support : float
        Initial guess of the support's albedo over the object's.
    errors : PoseErrors, optional
        Errors beside noise; `NO_ERRORS`: none. None: those of the calibration, or those that the sensor states, or
        `ASSUMED_ERRORS`.
    calibration : PoseCalibration, optional
        Of the sensor: the covariance is then that of the difference from its :meth:`~PoseCalibration.place`.
    name : str, optional
        Object of the calibration, which has not been moved.
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
    if calibration is None and name is not None:
        raise UsageError(f"'name' must be left out without a calibration, got {name!r}")
    if calibration is not None and errors is not None:
        raise UsageError("'errors' must be left out with a calibration, which has its own")
    if start is None:
        start = np.zeros(6) if calibration is None else calibration.place(name)
    if calibration is None and errors is None:
        errors = PoseErrors.of(sensors[0][2].histogram) or ASSUMED_ERRORS
    move = np.array(start, dtype=np.float64)
    if move.shape != (6,):
        raise UsageError(f"'start' must have 6 numbers, got {move.shape}")
    weights = POISSON if errors == NO_ERRORS else FITTED

    def at(values: NDArray[np.float64], ratio: float) -> _Supposed:
        parts = [
            evidence_of(one.linearise(seen, poses, values, ratio, free), seen.zone_counts, weights)
            for seen, poses, one in sensors
        ]
        return _Supposed(at, tuple(free), values, ratio, parts[0] if len(parts) == 1 else Evidence.joined(parts))

    limits = largest_steps(free)
    here, _, steps = descend(at(move, support), limits, most=_MOST_STEPS, done=_DONE, shares=_SHARES)
    covariance, terms = pose_covariance(here.evidence, errors, calibration, name)
    dof = int(here.evidence.dof.sum()) - len(free)
    return ObjectPose(
        here.displacement, sensors[0][2].moved(here.displacement), here.free, covariance, here.support, here.cost, dof,
        bool(chi2.sf(here.cost, dof) > false_alarm), steps, terms,
    )  # fmt: skip


def pose_covariance(
    evidence: Evidence,
    errors: PoseErrors | None = None,
    calibration: PoseCalibration | None = None,
    name: str | None = None,
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Return the covariance of a joint estimate, infinite for what nothing tells, and its terms.

    Parameters
    ----------
    evidence : Evidence
    errors, calibration, name
        As for :func:`match_jointly`, one of the first two given.
    """
    if calibration is not None:
        terms = calibration.error_terms(evidence, name)
    else:
        assert errors is not None
        estimate = Contrast.estimate(evidence)
        lever, places = estimate.hand(), estimate.places
        terms = estimate.terms(errors) | {
            "hand": lever @ errors.covariance_of("hand") @ lever.T,
            "object": places @ errors.covariance_of("object") @ places.T,
        }
    covariance = np.asarray(sum(terms.values()))
    blind = gauss_newton(evidence)[2]
    covariance[blind, blind] = np.inf
    return covariance, terms


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
