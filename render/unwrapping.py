"""One range from the wrapped ranges of several modulation frequencies: maximum likelihood (PHYSICS section 10).

Each frequency f_j tells the range up to a multiple of its period P_j = c / 2f_j. With U = c / (2 · gcd), k_j = U / P_j,
there are Σ k_j ways in which the periods can be counted as the range goes from 0 to U: each time it passes the middle
between two multiples of one frequency, that frequency's count grows by one. Every other count is farther from all
measurements at every range. For each of the ways the best range is the mean weighted with 1/σ², and
Q = Σ (difference)² / σ² says how well it explains what was measured; the smallest Q is the answer.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.render.sensor.sensor import Sensor

INCONSISTENT_SHARE = 1e-4
"""Share of pixels that see one range and count as inconsistent all the same: by noise their frequencies disagree."""


class Unwrapped(NamedTuple):
    """Unwrapped range of several frequencies, with its quality; arrays (...).

    Parameters
    ----------
    range_m : float64
        Range in [0, c / (2 · gcd)); NaN where a frequency has none.
    std_m : float64
        Its standard deviation, (Σ σ_f⁻²)^−½, if the periods were counted right.
    second_probability : float64
        Probability that the second best count of the periods is the right one rather than the best:
        1 / (1 + exp((Q₂ − Q₁) / 2)), all ranges being equally probable beforehand.
    chi2 : float64
        Q₁, how far the frequencies disagree on the range: χ² of m − 1 degrees of freedom for a pixel that sees one
        range.
    consistent : bool
        Whether noise alone explains `chi2`, except for a share of :data:`INCONSISTENT_SHARE`. A mixed pixel's range
        differs from frequency to frequency.
    """

    range_m: NDArray[np.float64]
    std_m: NDArray[np.float64]
    second_probability: NDArray[np.float64]
    chi2: NDArray[np.float64]
    consistent: NDArray[np.bool_]


def unwrap_ranges(range_m: ArrayLike, std_m: ArrayLike, sensor: Sensor) -> Unwrapped:
    """Return the ranges that explain the wrapped ranges of all frequencies best.

    Parameters
    ----------
    range_m : (m, ...) array_like
        Range that each of the sensor's m modulation frequencies measures, in [0, c/2f) of its own f, metres; NaN where
        there is none.
    std_m : array_like
        Standard deviation of each, metres; broadcasts to the shape of `range_m`. Zero counts as 1e-6 rad.
    sensor : Sensor
        Its `modulation_hz` are the frequencies, in the order of `range_m`. One frequency needs no unwrapping: its range
        comes back as it is.

    Returns
    -------
    Unwrapped
        Arrays in the shape of `range_m` without its first axis.

    Raises
    ------
    UsageError
        The first axis of `range_m` is not one of frequencies, or a standard deviation is negative.

    Examples
    --------
    Two frequencies whose ranges wrap at 7.49 m and at 2.50 m:

    >>> from phasemark.render import preset
    >>> sensor = preset("pmd-16x16").with_(modulation_hz=[20e6, 60e6])
    >>> found = unwrap_ranges([[6.10], [1.09]], [[0.06], [0.02]], sensor)
    >>> found.range_m.round(3), found.std_m.round(3), found.consistent
    (array([6.088]), array([0.019]), array([ True]))
    """
    measured = np.asarray(range_m, dtype=np.float64)
    m = len(sensor.frequencies_hz)
    if not measured.ndim or len(measured) != m:
        raise UsageError(
            f"'range_m' must have one row for each of {m} modulation frequencies, got shape {measured.shape}"
        )
    std = np.broadcast_to(np.asarray(std_m, dtype=np.float64), measured.shape)
    if (std < 0).any():
        raise UsageError(f"'std_m' must not be negative, got {std[std < 0][0]:g}")
    scale = np.array([camera.metres_per_radian for camera in sensor.by_frequency])
    least_std_rad = 1e-6  # no phase counts as better known than this: a simulated one without noise has rounding
    floored = np.maximum(std.reshape(m, -1), least_std_rad * scale[:, None])
    n = floored.shape[1]
    best, first, second = np.full(n, np.nan), np.full(n, np.nan), np.full(n, np.nan)
    periods, multiples = _periods(sensor)
    _unwrap(
        np.ascontiguousarray(measured.reshape(m, n)), 1 / floored**2, periods, int(multiples.sum()),
        sensor.unambiguous_range_m, best, first, second,
    )  # fmt: skip
    shape = measured.shape[1:]
    known = np.isfinite(best)
    total = np.sqrt(np.sum(np.where(std > 0, std, np.inf) ** -2.0, axis=0))
    exact = (std == 0).any(axis=0)
    combined = np.where(exact, 0.0, np.divide(1.0, total, out=np.full(shape, np.inf), where=total > 0))
    from scipy import special  # takes a fifth of a second

    limit = special.chdtri(m - 1, INCONSISTENT_SHARE) if m > 1 else math.inf
    return Unwrapped(
        best.reshape(shape),
        np.where(known.reshape(shape), combined, np.nan),
        special.expit((first - second) / 2).reshape(shape),
        first.reshape(shape),
        (known & (first <= limit)).reshape(shape),
    )


def unwrapping_error_probability(std_m: ArrayLike, sensor: Sensor) -> NDArray[np.float64]:
    """Return the probability that :func:`unwrap_ranges` counts the periods wrong, from the noise alone.

    Of two frequencies the difference of the wrapped ranges is a multiple of Δ = c / (2 · gcd · k₁ k₂) plus noise, and
    the count is wrong when the noise exceeds half of that: erfc(Δ / √(8 (σ₁² + σ₂²))), exactly. Of more frequencies it
    is a bound, Σ Q(d/2) over the ways to count wrongly, with d² what each adds to Q.

    Parameters
    ----------
    std_m : (m, ...) array_like
        Standard deviation of the range at each of the sensor's m frequencies, metres.
    sensor : Sensor
        The camera.

    Returns
    -------
    ndarray
        In the shape of `std_m` without its first axis; 0 for one frequency.

    Raises
    ------
    UsageError
        The first axis of `std_m` is not one of frequencies.

    Examples
    --------
    At 20 and 60 MHz with a phase noise of 0.5 rad each:

    >>> from phasemark.render import preset
    >>> sensor = preset("pmd-16x16").with_(modulation_hz=[20e6, 60e6])
    >>> float(unwrapping_error_probability([0.5 * s.metres_per_radian for s in sensor.by_frequency], sensor).round(4))
    0.0469
    """
    std = np.asarray(std_m, dtype=np.float64)
    m = len(sensor.frequencies_hz)
    if not std.ndim or len(std) != m:
        raise UsageError(f"'std_m' must have one row for each of {m} modulation frequencies, got shape {std.shape}")
    periods, multiples = _periods(sensor)
    if m == 1:
        return np.zeros(std.shape[1:])
    from scipy import special

    if m == 2:
        step = sensor.unambiguous_range_m / float(multiples.prod())
        return np.asarray(special.erfc(step / np.sqrt(8 * np.sum(std**2, axis=0))))
    counts = np.array(_counts(multiples))[1:]
    weight = std**-2.0
    away = counts * periods
    mean = np.tensordot(away, weight, 1) / weight.sum(axis=0)
    squared = np.tensordot(away**2, weight, 1) - mean**2 * weight.sum(axis=0)
    return np.asarray(np.minimum(special.ndtr(-np.sqrt(squared) / 2).sum(axis=0), 1.0))


def _periods(sensor: Sensor) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the range at which each frequency wraps, and how many of these make the unambiguous range."""
    periods = np.array([camera.unambiguous_range_m for camera in sensor.by_frequency])
    return periods, np.rint(sensor.unambiguous_range_m / periods).astype(np.int64)


def _counts(multiples: NDArray[np.int64]) -> list[list[int]]:
    """Return the ways in which periods are counted as a range goes from 0 to the unambiguous one; the first is 0s."""
    switches = sorted(((2 * i + 1) / (2 * k), j) for j, k in enumerate(multiples) for i in range(k))
    count, ways = [0] * len(multiples), [[0] * len(multiples)]
    for _, j in switches[:-1]:
        count[j] += 1
        ways.append(list(count))
    return ways


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _unwrap(range_m, weight, periods, n_ways, unambiguous_m, best, first, second):  # type: ignore[no-untyped-def]
    """Fill range, lowest and second lowest Q of n pixels from ranges and weights (m, n); NaN where one is missing."""
    m, n = range_m.shape
    at, switch = np.empty(m), np.empty(m)
    for pixel in range(n):
        total = 0.0
        for j in range(m):
            at[j] = range_m[j, pixel] - periods[j] * math.floor(range_m[j, pixel] / periods[j] + 0.5)
            switch[j] = at[j] + 0.5 * periods[j]
            total += weight[j, pixel]
        if not (total > 0.0 and math.isfinite(np.sum(at))):
            continue
        lowest, next_lowest, found = math.inf, math.inf, 0.0
        for _ in range(n_ways):
            mean, q = 0.0, 0.0
            for j in range(m):
                mean += weight[j, pixel] * at[j]
            mean /= total
            for j in range(m):
                q += weight[j, pixel] * (at[j] - mean) ** 2
            if q < lowest:
                lowest, next_lowest, found = q, lowest, mean
            elif q < next_lowest:
                next_lowest = q
            earliest = np.argmin(switch)
            at[earliest] += periods[earliest]
            switch[earliest] += periods[earliest]
        found -= unambiguous_m * math.floor(found / unambiguous_m)
        best[pixel] = 0.0 if found >= unambiguous_m else found
        first[pixel], second[pixel] = lowest, next_lowest
