"""Fits of one stop: descents of the engine from starts to the poses that explain it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.estimate.solver import descend
from phasemark.matcher.locate.kernel_arguments import Outline, Prediction, RigNumbers, Scan
from phasemark.matcher.locate.plane import difference
from phasemark.matcher.locate.rig import Rig
from phasemark.matcher.locate.scan_rows import N_BODY, N_ROWS, SENSOR_YAW, empty_prediction, predict, sums

_Float = NDArray[np.float64]

WIDTHS = (8.0, 3.0, 1.0)
"""Noise of the rounds of a descent, in that of the rig: a start may be off by more than a wall's noise."""
_MOST_STEPS, _MOST_ROUNDS = 12, 8
_DONE = 1e-3
"""A step that lowers the cost by less than this ends a round, and a round that moves by less ends the descent."""
_EVEN_LESS = 1e-9
"""Standard deviation that stands for an unknown that is left out, in its unit."""


@dataclass(frozen=True, eq=False)
class StopModel:
    """A rig in a map, ready to explain stops.

    Parameters
    ----------
    rig : Rig
    outline : Outline
    numbers : RigNumbers
    """

    rig: Rig
    outline: Outline
    numbers: RigNumbers
    rows = 1
    """Rows of each sensor in the scans that it explains."""

    @property
    def longest(self) -> _Float:
        """Longest steps of the unknowns of a stop, (p,): of the pose, and some standard deviations of others."""
        return np.concatenate([[0.15, 0.15, 0.15], 5 * self.unknowns_std])

    @property
    def unknowns_std(self) -> _Float:
        """Standard deviations of the unknowns of a stop beyond its pose, (p − 3,)."""
        stop, sensors = self.rig.stop, len(self.rig.sensor)
        std = [stop.drift_m_s, stop.drift_m_s, stop.age_s]
        std += [stop.offset_m] * sensors + [math.radians(stop.yaw_deg)] * sensors
        return np.maximum(std, _EVEN_LESS)

    @property
    def outlier_density(self) -> float:
        """ε / ((1 − ε) R), per metre."""
        noise = self.rig.noise
        return noise.outliers / ((1 - noise.outliers) * noise.max_range_m)

    def prediction(self, theta: _Float, scan: Scan, walls: bool = False) -> Prediction:
        """Return the depths that a stop should show; `walls`: with slopes by the displacements of walls."""
        seen = empty_prediction(scan, len(self.outline.normal) if walls else 0)
        predict(theta, scan, self.numbers, self.outline, seen)
        return seen

    def sigma_m(self, seen: Prediction) -> _Float:
        """Return the noise of each column, (F, S, C); where no wall is seen, that of the farthest one."""
        noise = self.rig.noise
        depth = np.where(np.isnan(seen.depth_m), noise.max_range_m, seen.depth_m)
        return np.hypot(noise.floor_m + noise.share * depth, noise.edge_share * seen.spread_m)

    def explained(self, residual: _Float, sigma_m: _Float) -> _Float:
        """Return the probability that columns are explained, by their residuals in standard deviations."""
        likely = np.exp(-0.5 * np.minimum(residual**2, 1400.0))
        return np.asarray(likely / (likely + self.outlier_density * sigma_m * math.sqrt(2 * math.pi)))


@dataclass(frozen=True, eq=False)
class StopFit:
    """A pose that may explain a stop.

    Parameters
    ----------
    theta : (p,) float64
    covariance : (p, p) float64
        Of all unknowns of the stop, from evidence and priors.
    cost : float
        Twice the negative logarithm of the likelihood, priors included, but for a constant of the stop.
    explained, observed : int
        Columns.
    """

    theta: _Float
    covariance: _Float
    cost: float
    explained: int
    observed: int

    @property
    def pose(self) -> _Float:
        """x, y, yaw."""
        return self.theta[:3]

    @property
    def share(self) -> float:
        """Explained share of the columns that were observed."""
        return self.explained / max(self.observed, 1)


@dataclass(eq=False)
class _Point:
    """A place of a descent, with the noise of the round: that of the place itself times `width` where none is given."""

    model: StopModel
    scan: Scan
    theta: _Float
    prior: tuple[_Float, _Float]
    sigma_m: _Float | None = None
    width: float = 1.0

    def __post_init__(self) -> None:
        seen = self.model.prediction(self.theta, self.scan)
        if self.sigma_m is None:
            self.sigma_m = self.width * self.model.sigma_m(seen)
        n, (mean, precision) = len(self.theta), self.prior
        self.information, self.gradient = np.empty((n, n)), np.empty(n)
        cost, self.explained = sums(
            self.scan, seen, self.sigma_m, self.model.outlier_density, self.information, self.gradient
        )
        off = difference(self.theta, mean)
        pull = precision @ off
        self.cost = cost + float(off @ pull)
        self.information += precision
        self.gradient -= pull

    def moved(self, step: _Float) -> Self:
        """Return the place a step away, with the same noise."""
        return replace(self, theta=self.theta + step)


def fit_stop(
    model: StopModel,
    scan: Scan,
    start: _Float,
    prior: tuple[_Float, _Float] | None = None,
    widths: tuple[float, ...] = WIDTHS,
) -> StopFit:
    """Descend from a start to a pose that explains a stop.

    Parameters
    ----------
    model : StopModel
    scan : Scan
    start : (k,) float64
        The first unknowns, at least the pose; the others are 0.
    prior : (mean, precision), optional
        (3,) and (3, 3): of the pose.
    widths : tuple of float
        Noise of the rounds, in that of the rig.

    Returns
    -------
    StopFit
    """
    mean, precision = _priors(model, prior)
    theta = np.zeros(len(mean))
    theta[: len(start)] = start
    longest = model.longest
    for k in range(_MOST_ROUNDS):
        width = widths[min(k, len(widths) - 1)]
        point = _Point(model, scan, theta, (mean, precision), width=width)
        point, _, _ = descend(point, longest, most=_MOST_STEPS, done=_DONE, shares=(1.0, 0.5, 0.2))
        moved = point.theta - theta
        theta = point.theta
        if k + 1 >= len(widths) and float(moved @ point.information @ moved) < 10 * _DONE:
            break
    return _as_fit(_Point(model, scan, theta, (mean, precision), width=widths[-1]), bool(prior))


def std_without_one(model: StopModel, scan: Scan, fit: StopFit) -> _Float:
    """Return the largest standard deviations of the pose after the frames of any one column are left out, (3,).

    A column at the end of a wall may claim more than it knows, so an answer is judged by these.
    """
    seen, sensors = model.prediction(fit.theta, scan), scan.depth_m.shape[1]
    first = N_BODY + 2 * sensors  # of what follows the sensors' own unknowns
    sigma = model.sigma_m(seen)
    scale = np.sqrt(model.explained((scan.depth_m - seen.depth_m) / sigma, sigma)) / sigma
    information = np.linalg.inv(fit.covariance)
    reduced = []
    for s, c in np.ndindex(scan.depth_m.shape[1:]):
        used = np.isfinite(scale[:, s, c])
        rows = np.zeros((np.count_nonzero(used), len(fit.theta)))
        rows[:, :N_BODY] = seen.slope[used, s, c, :N_BODY]
        rows[:, N_BODY + s], rows[:, N_BODY + sensors + s] = 1.0, seen.slope[used, s, c, SENSOR_YAW]
        rows[:, first:] = seen.slope[used, s, c, N_ROWS:]
        rows *= scale[used, s, c, None]
        reduced.append(information - rows.T @ rows)
    root = np.sqrt(np.diag(information))
    ridge = 1e-9 * np.eye(len(root))  # what one column alone tells has no standard deviation without it
    covariance = np.linalg.inv(np.array(reduced) / np.outer(root, root) + ridge)
    return np.asarray(np.sqrt(np.abs(np.einsum("kpp->kp", covariance)[:, :3]).max(axis=0)) / root[:3])


def along_profiles(model: StopModel, scan: Scan, fit: StopFit, prior: tuple[_Float, _Float] | None) -> StopFit:
    """Return a fit whose pose is as uncertain as the likelihood is: where walls end in columns, slopes do not hold.

    Where the likelihood's profile along a principal axis of the pose's covariance is wider than that, the pose there is
    the mean of the profile, with its variance; the other unknowns follow linearly. Parameters as for :func:`fit_stop`.
    """
    own = fit.covariance[:3, :3]
    if not np.isfinite(own).all():
        return fit
    at = np.linspace(-3.0, 3.0, 13)  # standard deviations
    root = np.sqrt(np.diag(own))
    values, axes = np.linalg.eigh(own / np.outer(root, root))
    axes = root[:, None] * axes * np.sqrt(values)
    ways = fit.covariance[:, :3] @ np.linalg.solve(own, axes)
    around, variance, theta = _priors(model, prior), np.ones(3), fit.theta.copy()
    for k, way in enumerate(ways.T):
        cost = np.array([_cost(_Point(model, scan, fit.theta + by * way, around)) for by in at])
        weight = np.exp(-0.5 * (cost - cost.min()))
        mean = np.average(at, weights=weight)
        spread = np.average((at - mean) ** 2, weights=weight)
        if spread > 1.0:
            variance[k] = spread
            theta += mean * way
    theta[2] = math.remainder(theta[2], math.tau)
    covariance = fit.covariance.copy()
    covariance[:3, :3] = axes * variance @ axes.T
    return replace(fit, theta=theta, covariance=covariance)


def _cost(point: _Point) -> float:
    """Return the cost at a place with the width of the noise there, which differs from place to place."""
    assert point.sigma_m is not None
    width = point.sigma_m[np.isfinite(point.scan.depth_m)]
    kappa = point.model.outlier_density * width * math.sqrt(2 * math.pi)
    return point.cost + 2 * float(np.log(width / (1 + kappa)).sum())


def _priors(model: StopModel, prior: tuple[_Float, _Float] | None) -> tuple[_Float, _Float]:
    """Return the mean and the precision that all unknowns of a stop have beforehand."""
    n = 3 + len(model.unknowns_std)
    mean, precision = np.zeros(n), np.zeros((n, n))
    precision[range(3, n), range(3, n)] = model.unknowns_std**-2.0
    if prior is not None:
        mean[:3], precision[:3, :3] = prior
    return mean, precision


def _as_fit(point: _Point, with_prior: bool) -> StopFit:
    """Return the fit at a place."""
    information = point.information
    root = np.sqrt(np.maximum(np.diag(information), 1e-300))
    covariance = np.linalg.pinv(information / np.outer(root, root), hermitian=True) / np.outer(root, root)
    if not with_prior and not np.all(np.diag(information)[:3] > 1e-6):
        covariance[:3, :3] = np.inf
    theta = point.theta.copy()
    theta[2] = math.remainder(theta[2], math.tau)
    observed = int(np.isfinite(point.scan.depth_m).sum())
    return StopFit(theta, covariance, _cost(point), point.explained, observed)
