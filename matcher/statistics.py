"""Intervals in closed form for what repeated trials give: shares, means, root mean squares."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from phasemark.matcher.accuracy.cramer_rao import Estimate


def wilson(successes: int, n: int, level: float = 0.95) -> Estimate:
    """Return a share with Wilson's score interval (Wilson 1927).

    Parameters
    ----------
    successes, n : int
    level : float
        Probability that the interval contains the true share.

    Returns
    -------
    Estimate
        NaN in [0, 1] where n is 0.

    Examples
    --------
    >>> print(wilson(0, 10))
    0.000 [0.000, 0.278]
    """
    if n == 0:
        return Estimate(math.nan, 0.0, 1.0)
    z = float(special.ndtri((1 + level) / 2))
    p = successes / n
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    # at the ends the interval touches 0 or 1 exactly, which rounding would miss
    low = 0.0 if successes == 0 else middle - half
    high = 1.0 if successes == n else middle + half
    return Estimate(p, low, high)


def mean_interval(values: ArrayLike, level: float = 0.95) -> Estimate:
    """Return a mean with Student's interval; NaN without bounds for fewer than two values."""
    array = np.asarray(values, np.float64)
    n = len(array)
    if n < 2:
        return Estimate(float(array.mean()) if n else math.nan, -math.inf, math.inf)
    mean = float(array.mean())
    half = float(special.stdtrit(n - 1, (1 + level) / 2)) * float(array.std(ddof=1)) / math.sqrt(n)
    return Estimate(mean, mean - half, mean + half)


def rms_interval(values: ArrayLike, level: float = 0.95) -> Estimate:
    """Return a root mean square with its interval, from the scatter of the squares.

    With q the mean of the squares and s their standard deviation, log rms has the standard error s / (2 q √n) (delta
    method); the logarithm makes the distribution more nearly symmetric. No distribution of the values is assumed.
    """
    squares = np.asarray(values, np.float64) ** 2
    n = len(squares)
    if n < 2:
        return Estimate(math.sqrt(float(squares.mean())) if n else math.nan, 0.0, math.inf)
    mean = float(squares.mean())
    if mean == 0:
        return Estimate(0.0, 0.0, 0.0)
    half = float(special.stdtrit(n - 1, (1 + level) / 2)) * float(squares.std(ddof=1)) / (2 * mean * math.sqrt(n))
    rms = math.sqrt(mean)
    return Estimate(rms, rms * math.exp(-half), rms * math.exp(half))
