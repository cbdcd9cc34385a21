"""Noise of pixels of which a few frames tell little each: a law says how they compare, all together how large it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_Float = NDArray[np.float64]

_LEAST = 1e-4
"""Variance over that of the law below which it is none: frames without any scatter are simulated, or frozen."""
_FEWEST = 5.0
"""Degrees of freedom from which Student's t has tails that a larger variance stands for."""


def median_scaled(variance: _Float, freedom: _Float, law: _Float) -> tuple[_Float, _Float]:
    """Return variances of a law, scaled to the median of sample variances over it.

    Parameters
    ----------
    variance : (n, pixels) float64
        Sample variances of one frame.
    freedom : (n, pixels) float64
        Their degrees of freedom; below 0.5 they say nothing.
    law : (n, pixels) float64
        Variances of the law, positive.

    Returns
    -------
    variance : (n, pixels) float64
    overdispersion : (n,) float64
        By how much χ² scatters more than under known noise, for the median of χ² over ν leaves some of its size
        unknown: 1 / (8 m² f²) with the median m of χ² at the usual degrees of freedom ν and its density f there,
        however many pixels there are.
    """
    from scipy import special  # takes a fifth of a second

    scale, more = np.ones((len(law), 1)), np.zeros(len(law))
    for k, told in enumerate(freedom > 0.5):
        if told.any():
            nu = float(np.median(freedom[k, told]))
            median = float(special.chdtri(nu, 0.5))
            scale[k] = np.median(variance[k, told] / law[k, told]) * nu / median
            density = np.exp((nu / 2 - 1) * np.log(median / 2) - median / 2 - special.gammaln(nu / 2)) / 2
            more[k] = 1 / (8 * (median * density) ** 2)
    return np.maximum(scale, _LEAST) * law, more


def moderated(variance: _Float, freedom: _Float, law: _Float) -> tuple[_Float, _Float]:
    """Return what sample variances and a law together say of the variances: their mean, and how well it is known.

    The variance of a pixel is taken for that of the law times a factor whose inverse scatters among the pixels like
    χ²(d) / d (Smyth 2004, Linear models and empirical Bayes methods, equations 2 to 5): d and the common scale follow
    from mean and variance of the logarithms. Where the law compares the pixels rightly d is large, and the scatter of
    each says nothing; where it does not, d is small, and the scatter says it all.

    Parameters
    ----------
    variance, freedom, law : (n, pixels) float64
        As for :func:`median_scaled`.

    Returns
    -------
    variance : (n, pixels) float64
        Means of the squared errors: larger than the estimates where these are uncertain.
    overdispersion : (n,) float64
        By how much χ² scatters more than under known noise.
    """
    from scipy import special

    found, more = law.copy(), np.zeros(len(law))
    halves = np.geomspace(0.05, 1e6, 400)
    for k, scattered in enumerate(freedom > 0.5):
        told = scattered & (variance[k] > _LEAST * law[k])  # equal ranges are rounded or frozen, and tell no noise
        if 2 * told.sum() < scattered.sum():
            told = scattered
        if told.sum() < 2:
            continue
        half = freedom[k, told] / 2
        logs = np.log(np.maximum(variance[k, told] / law[k, told], _LEAST)) - special.digamma(half) + np.log(half)
        excess = max(logs.var(ddof=1) - float(special.polygamma(1, half).mean()), 0.0)
        prior = float(np.interp(-excess, -special.polygamma(1, halves), halves))
        scale = np.exp(logs.mean() + special.digamma(prior) - np.log(prior))
        own = np.where(told, freedom[k], 0.0)
        pooled = (2 * prior * scale * law[k] + own * np.where(told, variance[k], 0.0)) / (2 * prior + own)
        nu = max(2 * prior + 2 * float(np.median(half)), _FEWEST)
        found[k] = pooled * nu / (nu - 2)
        more[k] = 3 / (nu - 4) + logs.var(ddof=1) / 2
    return found, more
