"""Unwrapping by trying every way to count periods, written down as it is defined and without any shortcut."""

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

SPEED_OF_LIGHT_M_S = 299_792_458.0


def best_counts(
    range_m: NDArray[Any], std_m: NDArray[Any], frequencies_hz: tuple[float, ...], unambiguous_m: float
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return range, lowest and second lowest Σ (difference)² / σ² of wrapped ranges (m, n).

    Every combination of counts is tried, one more to both ends than fit the unambiguous range, and ranges that are the
    same modulo the unambiguous one are one answer.
    """
    periods = SPEED_OF_LIGHT_M_S / 2 / np.array(frequencies_hz)
    limits = [range(-1, round(unambiguous_m / period) + 1) for period in periods]
    weight = 1 / std_m**2
    found = []
    for counts in itertools.product(*limits):
        at = range_m + (np.array(counts) * periods)[:, None]
        mean = (weight * at).sum(axis=0) / weight.sum(axis=0)
        found.append((((at - mean) ** 2 * weight).sum(axis=0), mean % unambiguous_m))
    cost, mean = (np.array(part) for part in zip(*found, strict=True))
    best = cost.argmin(axis=0)
    at_best = np.take_along_axis(mean, best[None], 0)[0]
    apart = np.abs(mean - at_best)
    same = np.minimum(apart, unambiguous_m - apart) < 1e-6
    others = np.where(same, np.inf, cost).min(axis=0)
    return at_best, np.take_along_axis(cost, best[None], 0)[0], others
