"""The Poisson likelihood of one histogram frame, and its information in a view (PHYSICS sections 7 and 11).

The expected count of bin j in zone z is λ = q(β s + α_z + x), with the signal s of the supposed view, the landmark's
brightness β, the ambient light α_z of the zone, the cover glass x and pile-up q. β and every α_z are unknown and are
estimated with the view. Of counts as low as these the misfit is measured by the deviance 2 Σ [n ln(n/λ) − n + λ].
Its mean and variance under the model are tabulated: it is no χ² where a bin has few counts.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.render.kernel import inner, kernel

LEAST_COUNT = 1e-3
"""No bin is expected to count less: what a model gets wrong must not become infinitely improbable."""
_LOWEST, _HIGHEST, _PER_DECADE = -3.0, 4.0, 40
_NO_BINS, _NO_RATES = np.empty((0, 0)), np.empty((0, 0, 0))


@lru_cache(maxsize=1)
def deviance_moments() -> NDArray[np.float64]:
    """Return mean and variance of one bin's deviance over log10 λ from −3 to 4, (2, m)."""
    exponent = np.linspace(_LOWEST, _HIGHEST, int(_PER_DECADE * (_HIGHEST - _LOWEST)) + 1)
    out = np.empty((2, len(exponent)))
    for i, mean in enumerate(10.0**exponent):
        spread = 12 * math.sqrt(mean) + 30
        n = np.arange(max(0, math.floor(mean - spread)), math.ceil(mean + spread) + 1.0)
        log_p = special.xlogy(n, mean) - mean - special.gammaln(n + 1)
        p = np.exp(log_p)
        deviance = 2 * (special.xlogy(n, n / mean) - n + mean)
        out[0, i] = p @ deviance
        out[1, i] = p @ deviance**2 - out[0, i] ** 2
    out.flags.writeable = False
    return out


def deviance_test(deviance: float, mean: float, variance: float, free: int) -> tuple[float, int, float]:
    """Return χ², its degrees of freedom and the probability of a larger one, for a sum of deviances.

    Parameters
    ----------
    deviance : float
        Summed over the bins, at the best fit.
    mean, variance : float
        Of the same sum at the true view.
    free : int
        Parameters that were estimated; each takes one off the mean and two off the variance.

    Returns
    -------
    chi2 : float
        The deviance scaled such that its mean is `dof`.
    dof : int
    p_value : float
        Of a scaled χ² that has the deviance's mean and variance.
    """
    mean, variance = mean - free, variance - 2 * free
    if mean <= 0 or variance <= 0:
        return deviance, 0, 0.0
    dof = 2 * mean**2 / variance
    chi2 = deviance * 2 * mean / variance
    return chi2, round(dof), float(special.chdtrc(dof, max(chi2, 0.0)))


def doubtful_deviance(mean: float, variance: float, free: int, false_alarm: float) -> float:
    """Return the deviance that a right fit exceeds with some probability; arguments as for :func:`deviance_test`."""
    mean, variance = mean - free, variance - 2 * free
    if mean <= 0 or variance <= 0:
        return math.inf
    return float(special.chdtri(2 * mean**2 / variance, false_alarm)) * variance / (2 * mean)


@inner
def log_term(n, mean):  # type: ignore[no-untyped-def]
    """Return the deviance of one count."""
    return 2.0 * (mean - n + (n * math.log(n / mean) if n > 0.0 else 0.0))


@kernel
def frame_sums(  # type: ignore[no-untyped-def]
    counts, signal, slope, bright, ambient, extra, cycles, least, level, information, gradient, own, rates, scratch,
):  # fmt: skip
    """Fill the information and the gradient of one frame; returns its deviance.

    Parameters
    ----------
    counts : (zones, bins)
    signal : (zones, bins)
        For brightness 1, all frames together.
    slope : (p, zones, bins)
        Of the signal, by the free parameters.
    bright : float
    ambient : (zones,)
    extra : (bins,)
        Counts of the cover glass.
    cycles : float
        Infinite without pile-up.
    least : (zones, bins)
        What the information takes the expected counts for at least; empty: they count as they are.
    level : (zones, bins)
        Filled with the expected counts.
    information : (p + 1, p + 1)
        Filled; the last parameter is ln β, ambient light of every zone eliminated.
    gradient : (p + 1,)
    own : (zones, p + 3)
        Filled with each zone's information across α and the parameters, that of α alone, and its gradient.
    rates : (zones, bins, p + 2)
        Filled with the slopes of the expected counts by the parameters, ln β and α; empty: they are not asked for.
    scratch : (2, p + 2)
    """
    p = slope.shape[0]
    q = p + 1
    deviance = 0.0
    share = 0.0 if math.isinf(cycles) else 1.0 / cycles
    for a in range(q):
        gradient[a] = 0.0
        for b in range(q):
            information[a, b] = 0.0
    for z in range(counts.shape[0]):
        for a in range(q + 2):
            own[z, a] = 0.0
        for a in range(q + 1):
            scratch[1, a] = 0.0  # the slopes of all light before a bin
        through = 1.0  # share of the cycles that no photon has ended before a bin, and before the next one
        for j in range(counts.shape[1]):
            count = bright * signal[z, j] + ambient[z] + extra[j]
            after = 1.0
            if share > 0.0:
                after = through * math.exp(-count * share)
                count = cycles * (through - after)
            count = max(count, LEAST_COUNT)
            level[z, j] = count
            n = counts[z, j]
            deviance += log_term(n, count)
            lost = count * share
            for a in range(q + 1):
                d = bright * slope[a, z, j] if a < p else (bright * signal[z, j] if a == p else 1.0)
                scratch[0, a] = after * d - lost * scratch[1, a]
                scratch[1, a] += d
            through = after
            excess = n / count - 1.0
            for a in range(rates.shape[2]):
                rates[z, j, a] = scratch[0, a]
            if len(least) > 0:
                count = max(count, least[z, j])
            for a in range(q):
                weighted = scratch[0, a] / count
                for b in range(a + 1):
                    information[a, b] += weighted * scratch[0, b]
                own[z, a] += weighted * scratch[0, q]
                gradient[a] += scratch[0, a] * excess
            own[z, q] += scratch[0, q] * scratch[0, q] / count
            own[z, q + 1] += scratch[0, q] * excess
        for a in range(q):
            tied = own[z, a] / own[z, q]
            gradient[a] -= tied * own[z, q + 1]
            for b in range(a + 1):
                information[a, b] -= tied * own[z, b]
    for a in range(q):
        for b in range(a):
            information[b, a] = information[a, b]
    return deviance


@kernel
def ambient_step(own, step, ambient):  # type: ignore[no-untyped-def]
    """Move the ambient light of every zone to where it is best after a step of the other parameters."""
    q = own.shape[1] - 2
    for z in range(len(ambient)):
        change = own[z, q + 1]
        for a in range(q):
            change -= own[z, a] * step[a]
        ambient[z] = max(ambient[z] + change / own[z, q], LEAST_COUNT)


class FrameSums(NamedTuple):
    """Likelihood of one frame; see :func:`frame_sums`."""

    deviance: float
    level: NDArray[np.float64]
    information: NDArray[np.float64]
    gradient: NDArray[np.float64]
    own: NDArray[np.float64]


def sums_of_frame(
    counts: NDArray[np.float64], signal: NDArray[np.float64], slope: NDArray[np.float64], bright: float,
    ambient: NDArray[np.float64], extra: NDArray[np.float64], cycles: float,
    least: NDArray[np.float64] = _NO_BINS, rates: NDArray[np.float64] = _NO_RATES,
) -> FrameSums:  # fmt: skip
    """Return the likelihood of one frame with its information and gradient; arguments as for :func:`frame_sums`."""
    q, shape = len(slope) + 1, signal.shape
    level, information, gradient, own = np.empty(shape), np.empty((q, q)), np.empty(q), np.empty((len(signal), q + 2))
    scratch = np.empty((2, q + 1))
    deviance = frame_sums(
        counts, signal, slope, bright, ambient, extra, cycles, least, level, information, gradient, own, rates, scratch
    )
    return FrameSums(deviance, level, information, gradient, own)


def bare_deviance(counts: NDArray[np.float64], extra: NDArray[np.float64], cycles: float) -> float:
    """Return the deviance of a scene without a landmark, the ambient light of every zone at its best."""
    total = counts.sum(axis=1)
    if not math.isinf(cycles):
        total = -cycles * np.log1p(-np.minimum(total / cycles, 0.999999))
    ambient = np.maximum((total - extra.sum()) / counts.shape[1], LEAST_COUNT)
    bare_steps = 4
    for _ in range(bare_steps):
        sums = sums_of_frame(counts, np.zeros(counts.shape), np.empty((0, *counts.shape)), 1.0, ambient, extra, cycles)
        ambient_step(sums.own, np.zeros(1), ambient)
    return sums.deviance


def deviance_of(counts: NDArray[np.float64], level: NDArray[np.float64]) -> float:
    """Return the summed deviance of counts with these expectations."""
    return float(2 * (level - counts + special.xlogy(counts, counts / level)).sum())


def moments_of(level: NDArray[np.float64]) -> tuple[float, float]:
    """Return mean and variance of the summed deviance of counts with these expectations."""
    table = deviance_moments()
    x = (np.log10(np.clip(level, 10.0**_LOWEST, 10.0**_HIGHEST)).ravel() - _LOWEST) * _PER_DECADE
    i = np.minimum(x.astype(np.int64), table.shape[1] - 2)
    f = x - i
    return tuple(float((row[i] + f * (row[i + 1] - row[i])).sum()) for row in table)  # type: ignore[return-value]
