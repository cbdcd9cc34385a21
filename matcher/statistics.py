"""Errors of repeated trials and what they say: intervals of shares, means and root mean squares, tests of a covariance.

Every interval is of 95 %. Two laws are at hand, because a cell of a sweep may have a dozen trials and a run against the
bound thousands:

| law | share | mean | root mean square |
|---|---|---|---|
| ``student`` | Wilson's score interval | Student's t | on a logarithmic scale, delta method, Student's t |
| ``normal`` | exact (Clopper–Pearson) | 1.96 standard errors | of the mean square, 1.96 standard errors |
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from phasemark import UsageError
from phasemark.render.view import wrap_delta_difference_rad

Law = Literal["student", "normal"]
"""How an interval is made; see the table above."""

_LEVEL = 0.95


@dataclass(frozen=True)
class Interval:
    """A number from repeated trials with its 95 % interval.

    Parameters
    ----------
    value, low, high : float
        Estimate, and the ends of its interval.
    """

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"

    def scaled(self, factor: float) -> Interval:
        """Return it in another unit."""
        return Interval(self.value * factor, self.low * factor, self.high * factor)


def binomial_interval(successes: int, n: int, *, law: Law = "normal") -> Interval:
    """Return a share of n trials with its 95 % interval.

    Parameters
    ----------
    successes, n : int
        Number of successes, and of all trials.
    law : {"normal", "student"}
        The exact interval (Clopper and Pearson 1934), which is never too narrow; or Wilson's score interval (1927),
        which holds the truth in 95 % of the cases on average.

    Returns
    -------
    Interval
        NaN in [0, 1] where n is 0.

    Raises
    ------
    UsageError
        There are more successes than trials, or less than none; or the law is unknown.

    Examples
    --------
    >>> print(binomial_interval(0, 10))
    0.000 [0.000, 0.308]
    >>> print(binomial_interval(0, 10, law="student"))
    0.000 [0.000, 0.278]
    """
    _check_law(law)
    if not 0 <= successes <= n:
        raise UsageError(f"'successes' must be between 0 and 'n' = {n}, got {successes}")
    if n == 0:
        return Interval(math.nan, 0.0, 1.0)
    k = int(successes)
    if law == "normal":
        tail = 0.025
        low = float(special.betaincinv(k, n - k + 1, tail)) if k else 0.0
        high = float(special.betaincinv(k + 1, n - k, 1 - tail)) if k < n else 1.0
        return Interval(k / n, low, high)
    z = float(special.ndtri((1 + _LEVEL) / 2))
    p = k / n
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    # at the ends the interval touches 0 or 1 exactly, which rounding would miss
    return Interval(p, 0.0 if k == 0 else middle - half, 1.0 if k == n else middle + half)


def mean_interval(values: ArrayLike, *, law: Law = "student") -> Interval:
    """Return a mean with its 95 % interval; without bounds for fewer than two values, NaN for none.

    Parameters
    ----------
    values : (n,) array_like
        The sample.
    law : {"student", "normal"}
        Distribution of the mean that the interval's width is taken from.
    """
    array = np.asarray(values, np.float64)
    n = len(array)
    if n < 2:
        return Interval(float(array.mean()) if n else math.nan, -math.inf, math.inf)
    mean = float(array.mean())
    half = _quantile(n, law) * float(array.std(ddof=1)) / math.sqrt(n)
    return Interval(mean, mean - half, mean + half)


def rms_interval(values: ArrayLike, *, law: Law = "student") -> Interval:
    """Return a root mean square with its 95 % interval, from the scatter of the squares.

    With q the mean of the squares and s their standard deviation, log rms has the standard error s / (2 q √n) (delta
    method); the logarithm makes the distribution more nearly symmetric. The normal law takes q ± 1.96 s / √n and its
    root. No distribution of the values is assumed. Fewer than two values have no upper end, and none are NaN.

    Parameters
    ----------
    values : (n,) array_like
        Of errors over their bounds this is the ratio to the bound, √mean(e² / CRLB²): 1 at the bound.
    law : {"student", "normal"}
        Distribution of the mean that the interval's width is taken from.
    """
    squares = np.asarray(values, np.float64) ** 2
    n = len(squares)
    if n < 2:
        return Interval(math.sqrt(float(squares.mean())) if n else math.nan, 0.0, math.inf)
    mean = float(squares.mean())
    if law == "normal":
        half = _quantile(n, law) * float(squares.std(ddof=1)) / math.sqrt(n)
        return Interval(math.sqrt(mean), math.sqrt(max(mean - half, 0.0)), math.sqrt(mean + half))
    if mean == 0:
        return Interval(0.0, 0.0, 0.0)
    half = _quantile(n, law) * float(squares.std(ddof=1)) / (2 * mean * math.sqrt(n))
    rms = math.sqrt(mean)
    return Interval(rms, rms * math.exp(-half), rms * math.exp(half))


def _check_law(law: Law) -> None:
    if law not in get_args(Law):
        raise UsageError(f"'law' must be one of {', '.join(get_args(Law))}, got {law!r}")


def _quantile(n: int, law: Law) -> float:
    _check_law(law)
    z95 = 1.96
    return z95 if law == "normal" else float(special.stdtrit(n - 1, (1 + _LEVEL) / 2))


def ratio_interval(above: Interval, below: Interval) -> Interval:
    """Return a quotient of independent positive numbers with its 95 % interval, from their relative errors.

    Parameters
    ----------
    above, below : Interval
    """

    def relative(one: Interval) -> float:
        return (one.high - one.low) / (2 * one.value)

    value, spread = above.value / below.value, math.hypot(relative(above), relative(below))
    return Interval(value, value * math.exp(-spread), value * math.exp(spread))


def nees(error: ArrayLike, covariance: ArrayLike) -> NDArray[np.float64]:
    """Return the normalised estimation error squared, eᵀ P⁻¹ e ~ χ²(p), (n,).

    Parameters
    ----------
    error : (n, p) array_like
        Estimate less truth, angles wrapped.
    covariance : (n, p, p) array_like
        Covariance matrices of the errors.
    """
    e, matrix = np.asarray(error, np.float64), np.asarray(covariance, np.float64)
    return np.asarray(np.einsum("ni,ni->n", e, np.linalg.solve(matrix, e[:, :, None])[:, :, 0]))


def within_ellipsoid(error: ArrayLike, covariance: ArrayLike, level: float = 0.95) -> NDArray[np.bool_]:
    """Return whether each error lies within the ellipsoid of its covariance that has a given probability.

    Parameters
    ----------
    error : (n, p) array_like
        Estimate less truth, angles wrapped.
    covariance : (n, p, p) array_like
        Covariance matrices of the errors.
    level : float
        The ellipsoid's probability.

    Returns
    -------
    (n,) bool

    Raises
    ------
    UsageError
        The level is no probability.
    """
    e = np.asarray(error, np.float64)
    return np.asarray(nees(e, covariance) <= _size_of_ellipsoid(e.shape[1], level))


def _size_of_ellipsoid(p: int, level: float) -> float:
    """Return the χ² of p numbers that the ellipsoid of a probability reaches."""
    if not 0 < level < 1:
        raise UsageError(f"'level' must be in (0, 1), got {level!r}")
    return float(special.chdtri(p, 1 - level))


def view_errors(
    estimate: object, truth: object, parameters: Sequence[str], period_rad: ArrayLike
) -> NDArray[np.float64]:
    """Return estimate less truth in some parameters of the view, δ the shorter way round; (n, p).

    Parameters
    ----------
    estimate, truth : Matches, Views, or anything with attributes of these names
    parameters : sequence of str
        Names, in the order of the columns.
    period_rad : float or (n,) array_like
        After which δ repeats.
    """
    columns = [np.asarray(getattr(estimate, name)) - getattr(truth, name) for name in parameters]
    return wrapped_errors(np.stack(columns, axis=-1), parameters, period_rad)


def wrapped_errors(error: NDArray[np.float64], parameters: Sequence[str], period_rad: ArrayLike) -> NDArray[np.float64]:
    """Return errors (…, p) of a view with those of δ taken the shorter way round.

    Parameters
    ----------
    error : (…, p) float64
    parameters : sequence of str
        Names of the columns.
    period_rad : array_like
        After which δ repeats; broadcasts against one column.
    """
    error = np.array(error)
    if "delta_rad" in parameters:
        k = list(parameters).index("delta_rad")
        error[..., k] = wrap_delta_difference_rad(error[..., k], period_rad)
    return error


def position_error_m(
    found_m: NDArray[np.float64], true_m: NDArray[np.float64], turn_rad: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the distance of the lens from its true place in the plane, metres: two distances at an angle.

    Parameters
    ----------
    found_m, true_m : float64
        Distances from the landmark.
    turn_rad : float64
        Error of δ.
    """
    across = 2 * np.sin(turn_rad / 2)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt((found_m - true_m) ** 2 + found_m * true_m * across**2))


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of an estimator's errors; intervals are of 95 %.

    Parameters
    ----------
    n : int
        Errors that counted.
    bias, rmse : mapping of str to Interval
        Mean and root mean square of the errors, by parameter.
    bias_over_bound, ratio : mapping of str to Interval
        Mean and root mean square of the errors over the bound at each truth: √mean(e² / bound²) is 1 for the best an
        unbiased estimator can do.
    nees : Interval
        Mean of eᵀP⁻¹e over the number of parameters: 1 for an honest covariance.
    coverage : mapping of float to Interval
        Share of errors within the ellipsoids of these probabilities.
    """

    n: int
    bias: Mapping[str, Interval]
    rmse: Mapping[str, Interval]
    bias_over_bound: Mapping[str, Interval]
    ratio: Mapping[str, Interval]
    nees: Interval
    coverage: Mapping[float, Interval]


def error_statistics(
    error: ArrayLike,
    parameters: Sequence[str],
    *,
    bound_std: ArrayLike | None = None,
    covariance: ArrayLike | None = None,
    levels: Sequence[float] = (0.95,),
    law: Law = "student",
) -> ErrorStatistics:
    """Judge errors by themselves, by their bound and by the covariance that came with them.

    Parameters
    ----------
    error : (n, p) array_like
        Estimate less truth, angles wrapped (:func:`view_errors`); rows with NaN do not count. Outliers are left out
        before, by a rule of the experiment's own.
    parameters : sequence of str
        Names of the columns.
    bound_std : (n, p) array_like, optional
        Bound on the standard deviations at each truth; rows with NaN do not count in what is over the bound.
    covariance : (n, p, p) array_like, optional
        As the estimator has it; rows with NaN do not count in NEES and coverage.
    levels : sequence of float
        Probabilities of the ellipsoids.
    law : {"student", "normal"}
        How intervals are made.

    Returns
    -------
    ErrorStatistics
        What nothing is known of is NaN, with an interval that has no bounds.

    Raises
    ------
    UsageError
        A level is no probability, or the law is unknown.

    Examples
    --------
    >>> found = error_statistics([[0.1], [-0.1], [0.1]], ["distance_m"], bound_std=[[0.1]] * 3)
    >>> print(found.ratio["distance_m"])
    1.000 [1.000, 1.000]
    """
    e = np.asarray(error, np.float64)
    unknown = np.full(e.shape, np.nan)
    std = unknown if bound_std is None else np.asarray(bound_std, np.float64)
    matrix = unknown[:, :, None] * unknown[:, None] if covariance is None else np.asarray(covariance, np.float64)
    known = np.isfinite(e).all(axis=1)
    bounded = known & np.isfinite(std).all(axis=1)
    honest = known & np.isfinite(matrix).all(axis=(1, 2))
    scaled = e[bounded] / std[bounded]
    squared = nees(e[honest], matrix[honest])
    within = {level: int((squared <= _size_of_ellipsoid(e.shape[1], level)).sum()) for level in levels}
    return ErrorStatistics(
        n=int(known.sum()),
        bias={name: mean_interval(e[known, k], law=law) for k, name in enumerate(parameters)},
        rmse={name: rms_interval(e[known, k], law=law) for k, name in enumerate(parameters)},
        bias_over_bound={name: mean_interval(scaled[:, k], law=law) for k, name in enumerate(parameters)},
        ratio={name: rms_interval(scaled[:, k], law=law) for k, name in enumerate(parameters)},
        nees=mean_interval(squared / e.shape[1], law=law),
        coverage={level: binomial_interval(count, len(squared), law=law) for level, count in within.items()},
    )
