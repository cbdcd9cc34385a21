"""Errors of located objects, estimated from the poses that calibrated the sensor.

The gradients of the log-likelihood at the objects' places are normal, with the covariance of
:mod:`~phasemark.matcher.histograms.pose_errors`; the sizes in it are those of the greatest restricted likelihood
(Patterson & Thompson 1971). Then the poses of each side are left out in turn: where their own estimates lie farther
from those of the other poses than the sizes say, all sizes grow. What no pose can tell is stated: an error of the
hand-eye transform before the calibration, and of a mesh; the latter counts as much as three further objects do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize

from phasemark import UsageError
from phasemark.matcher.histograms.pose_errors import Contrast, PoseErrors, angles, gradient_covariance
from phasemark.matcher.histograms.pose_evidence import FITTED, Evidence, evidence_of, gauss_newton
from phasemark.matcher.histograms.scene_prediction import POSE_PARAMETERS, ObjectScene
from phasemark.render.direct.fit_sensor import DirectFit
from phasemark.render.direct.histogram_frames import HistogramFrames
from phasemark.render.direct.recordings import ObjectRecording
from phasemark.render.sensor.sensor import Sensor

_Float = NDArray[np.float64]

_FREE = (*POSE_PARAMETERS, "support")
_UNIT = np.array([1e-3] * 3 + [math.radians(1)] * 3 + [0.1])
_OBJECT, _OBJECTS_WORTH = (1e-3, math.radians(0.5)), 3
"""Dimensions and place of a mesh, stated: a printed object measured in place by hand."""
_HAND = (5e-3, math.radians(2))
"""Hand-eye transform before a calibration, stated."""
_SIZES = ("scale", "zone_m", "pose_m", "pose_rad", "side_m", "side_rad", "side_reach_rad")
_START = (2.0, 0.4e-3, 0.1e-3, math.radians(0.1), 0.4e-3, math.radians(0.4), math.radians(40))


@dataclass(frozen=True, eq=False)
class KnownObject:
    """Object that calibrated, and where its poses found it.

    Parameters
    ----------
    name : str
    displacement : (6,) float64
        From where its mesh's file has it, in the order of `POSE_PARAMETERS`.
    evidence : Evidence
        Of the calibrating poses.
    """

    name: str
    displacement: _Float
    evidence: Evidence


@dataclass(frozen=True, eq=False)
class PoseCalibration:
    """Errors of objects located later, as calibrating poses tell them.

    Parameters
    ----------
    sensor : Sensor
        The fitted one, which states the errors.
    errors : PoseErrors
    hand : (6, 6) float64
        Covariance of the hand-eye transform, along and about the axes of the sensor.
    objects : tuple of KnownObject
    left_out : float
        Mean squared error of sides that were left out, over what the likeliest sizes say; where it is above 1, the
        sizes were enlarged by its root.
    """

    sensor: Sensor
    errors: PoseErrors
    hand: _Float
    objects: tuple[KnownObject, ...]
    left_out: float

    def place(self, name: str | None = None) -> _Float:
        """Return where an object that calibrated stands, or where others are to be expected: (6,) displacement."""
        return np.asarray(np.mean([one.displacement for one in self._named(name)], axis=0))

    def error_terms(self, evidence: Evidence, name: str | None = None) -> dict[str, _Float]:
        """Return the covariances by which an estimate may differ from :meth:`place`, by term.

        Parameters
        ----------
        evidence : Evidence
            Of the poses that locate.
        name : str, optional
            Object that calibrated and has not been moved; None: another, whose mesh has errors of its own.

        Returns
        -------
        dict of str to (p, p) float64
            "model", "pose", "side", "hand" and "object".
        """
        estimate = Contrast.estimate(evidence)
        known = [Contrast.estimate(one.evidence.of_parameters(evidence.free)) for one in self._named(name)]
        if name is not None:
            difference = estimate.less(known[0])
            terms, lever = difference.terms(self.errors), difference.hand()
            mesh = 0.0
        else:
            shares = [one.terms(self.errors) for one in known]
            terms = {
                key: value + sum(one[key] for one in shares) / len(known) ** 2
                for key, value in estimate.terms(self.errors).items()
            }
            lever = estimate.hand() - sum(one.hand() for one in known) / len(known)
            mesh = 1 + 1 / len(known)
        places = estimate.places
        terms["hand"] = lever @ self.hand @ lever.T
        terms["object"] = mesh * places @ self.errors.covariance_of("object") @ places.T
        return terms

    def _named(self, name: str | None) -> tuple[KnownObject, ...]:
        found = tuple(one for one in self.objects if name is None or one.name == name)
        if not found:
            raise UsageError(f"'name' must be one of {', '.join(one.name for one in self.objects)}, got {name!r}")
        return found


def calibrate_poses(fit: DirectFit, objects: Sequence[ObjectRecording]) -> PoseCalibration:
    """Estimate by how much objects located with a fitted sensor will be off, from the poses that calibrated it.

    Parameters
    ----------
    fit : DirectFit
        Fit of the sensor.
    objects : sequence of ObjectRecording
        The recordings of objects that it was fitted to.

    Raises
    ------
    UsageError
        No object is given, or one has fewer than 8 poses.
    """
    least = 8
    if not objects:
        raise UsageError("the errors of poses need a known object, got none")
    for one in objects:
        if len(one.frames) < least:
            raise UsageError(f"the errors of poses need {least} poses of each object, {one.name} has {len(one.frames)}")
    known = tuple(_known(fit, one) for one in objects)
    every = [one.evidence for one in known]
    errors = _likeliest([_thinned(one) for one in every])
    hand = _hand_covariance(every, errors)
    left_out = float(np.mean([x for one in every for x in _left_out(one, errors, hand)]))
    wider = max(left_out, 1.0)
    grown = {name: getattr(errors, name) * math.sqrt(wider) for name in _SIZES[:-1]}
    hand_m, hand_rad = (math.sqrt(wider * np.diag(hand)[k].mean()) for k in (slice(3), slice(3, 6)))
    object_m, object_rad = _object_errors(np.array([one.displacement for one in known]))
    errors = errors._replace(**grown, hand_m=hand_m, hand_rad=hand_rad, object_m=object_m, object_rad=object_rad)
    table = fit.sensor.histogram
    assert table is not None
    sensor = fit.sensor.with_(histogram={**table.model_dump(), **errors.as_fields()})
    return PoseCalibration(sensor, errors, hand * wider, known, left_out)


def _known(fit: DirectFit, one: ObjectRecording) -> KnownObject:
    """Return where the poses of an object find it."""
    p = fit.parameters
    scene = ObjectScene(one.mesh, fit.sensor)
    frames = HistogramFrames(one.frames.counts, sensor=fit.sensor, reference=one.frames.reference)
    place, support = np.zeros(6), p[f"{one.name}_support"]
    place[[0, 1, 2, 5]] = [p[f"{one.name}_{axis}"] for axis in ("x", "y", "z", "yaw")]
    poses = fit.optical_poses(one.sensor2world)
    evidence = evidence_of(scene.linearise(frames, poses, place, support, _FREE), frames.zone_counts, FITTED)
    step = gauss_newton(evidence)[0]
    evidence = replace(evidence, gradient=evidence.gradient - evidence.information @ step)
    return KnownObject(one.name, place + step[:6], evidence)


def _thinned(evidence: Evidence) -> Evidence:
    """Return evidence of at most 32 poses, spread over all."""
    n, most = len(evidence.dof), 32
    return evidence.of_poses(np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int)))


def _whitened(evidence: Evidence, seen: Contrast, errors: PoseErrors) -> tuple[_Float, _Float, _Float, float]:
    """Return slopes by place and by hand-eye transform and gradients, whitened, and the log determinant."""
    n, p = seen.information.shape[:2]
    slope = (seen.information * _UNIT[None, None, :]).reshape(n * p, p)
    lever = (seen.information @ seen.lever * _UNIT[:6]).reshape(n * p, 6)
    size = np.sqrt(np.einsum("iaa->ia", seen.information)).ravel() + 1e-9
    nearly = 1e-6 * np.eye(n * p)  # of a variance: a direction that one pose does not tell
    covariance = gradient_covariance(seen, errors) / np.outer(size, size) + nearly
    lower = cholesky(covariance, lower=True)
    columns = np.column_stack([slope, lever, evidence.gradient.sum(axis=1).ravel()]) / size[:, None]
    white = solve_triangular(lower, columns, lower=True)
    return white[:, :p], white[:, p:-1], white[:, -1], float(2 * np.log(np.diag(lower)).sum())


def _likeliest(every: Sequence[Evidence]) -> PoseErrors:
    """Return the sizes of the greatest restricted likelihood."""
    start = np.array(_START)
    reach_spread = 0.5  # of the logarithm of the reach, about its start
    parts = [(one, Contrast.estimate(one)) for one in every]

    def sizes(x: _Float) -> PoseErrors:
        return PoseErrors(**dict(zip(_SIZES, (start * np.exp(x)).tolist(), strict=True)))

    def cost(x: _Float) -> float:
        total = (x[-1] / reach_spread) ** 2 / 2 + 1e-3 * float(x @ x)
        for one, seen in parts:
            slope, _, pull, log_det = _whitened(one, seen, sizes(x))
            matrix, gradient = slope.T @ slope, slope.T @ pull
            total += log_det + np.linalg.slogdet(matrix)[1] + pull @ pull - gradient @ np.linalg.solve(matrix, gradient)
        return float(total)

    limits = [(-5.0, 3.0)] * (len(start) - 1) + [(-1.4, 0.8)]
    found = minimize(cost, np.zeros(len(start)), method="L-BFGS-B", bounds=limits, options={"maxiter": 25})
    return sizes(found.x)


def _hand_covariance(every: Sequence[Evidence], errors: PoseErrors) -> _Float:
    """Return what the poses leave of the hand-eye transform, (6, 6)."""
    information = np.diag((_UNIT[:6] / np.repeat(_HAND, 3)) ** 2)
    for one in every:
        slope, lever, *_ = _whitened(one, Contrast.estimate(one), errors)
        q, _ = np.linalg.qr(slope)
        lever = lever - q @ (q.T @ lever)
        information = information + lever.T @ lever
    return np.asarray(np.linalg.inv(information) * np.outer(_UNIT[:6], _UNIT[:6]))


def _left_out(evidence: Evidence, errors: PoseErrors, hand: _Float) -> list[float]:
    """Return squared errors of each side against the other poses, over their expected value."""
    apart, sides = angles(evidence.direction), 4
    middles = [int(apart.sum(axis=1).argmax())]
    while len(middles) < sides:
        middles.append(int(apart[middles].min(axis=0).argmax()))
    side = apart[middles].argmin(axis=0)
    found = []
    least = 2  # poses that tell all numbers
    for k in range(sides):
        out = side == k
        if out.sum() < least or (~out).sum() < least:
            continue
        one, rest = (evidence.of_poses(np.flatnonzero(which)) for which in (out, ~out))
        difference = Contrast.estimate(one).less(Contrast.estimate(rest))
        lever = difference.hand()
        covariance = sum(difference.terms(errors).values()) + lever @ hand @ lever.T
        away = (gauss_newton(one)[0] - gauss_newton(rest)[0])[:6]
        found.append(float(away @ np.linalg.solve(covariance[:6, :6], away)) / 6)
    return found


def _object_errors(places: _Float) -> tuple[float, float]:
    """Return how far objects stand from their common place, metres and radians a component."""
    squares = ((places - places.mean(axis=0)) ** 2).reshape(-1, 2, 3).sum(axis=(0, 2))
    worth = 3 * _OBJECTS_WORTH
    variance = (worth * np.square(_OBJECT) + squares) / (worth + 3 * (len(places) - 1))
    return float(math.sqrt(variance[0])), float(math.sqrt(variance[1]))
