"""Targets that a chip is expected to report of expected counts, and how they scatter beside their sigma.

The chip estimates a target about the highest bin. Where a zone sees a surface that is deep, or two surfaces, several
bins are about as high, noise decides between them, and the estimate jumps. The report is therefore taken as the mean
over the bins that may be the highest, and the variance between them is added to that of every estimate. Of two peaks
nearer to each other than the chip resolves it reports the higher one. Albedos are known no better than to a factor of
two: within it either may be reported.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.targets import _median, place_to_range
from phasemark.render.kernel import inner, kernel
from phasemark.render.sensor.sensor import Sensor

MARGIN = 2.0
"""Factor to which brightness is known."""


class ExpectedTargets(NamedTuple):
    """Targets that may be reported at n views; NaN where there are fewer.

    Parameters
    ----------
    distance_m : (n, zones, k) float64
        As range or z, as the chip reports it: the mean of what it reports.
    spread_m : (n, zones, k) float64
        Standard deviation of the report beside the sigma that comes with it.
    sure : (n, zones, k) bool
        Which of them must be reported.
    """

    distance_m: NDArray[np.float64]
    spread_m: NDArray[np.float64]
    sure: NDArray[np.bool_]


def most_peaks(sensor: Sensor) -> int:
    """Return how many targets of a zone are kept."""
    more_peaks = 2  # peaks that may be reported, beside those that a chip reports at the same time
    return histogram_of(sensor).max_targets + more_peaks


def expected_targets(counts: NDArray[np.float64], sensor: Sensor) -> ExpectedTargets:
    """Return the targets that may be reported of expected counts.

    Parameters
    ----------
    counts : (n, zones, bins) float64
        Expected counts of one frame, pile-up included.
    sensor : Sensor
        With a table ``[histogram]``.
    """
    histogram, k = histogram_of(sensor), most_peaks(sensor)
    n, zones, bins = counts.shape
    flat = np.ascontiguousarray(counts.reshape(-1, bins))
    place, spread = np.full((len(flat), k), np.nan), np.zeros((len(flat), k))
    sure = np.zeros((len(flat), k), np.bool_)
    _expect(
        flat, histogram.estimator == "centroid", histogram.estimator_bins, histogram.threshold,
        max(histogram.min_separation_m / histogram.bin_width_m, 1.0), histogram.max_targets, place, spread, sure,
        np.empty((4, bins)),
    )  # fmt: skip
    shape = (n, sensor.rows, sensor.cols, k)
    distance, slope = place_to_range(place.reshape(shape), sensor)
    out = (n, zones, k)
    return ExpectedTargets(distance.reshape(out), (spread.reshape(shape) * slope).reshape(out), sure.reshape(out))


@inner
def _estimate(row, level, top, centroid, reach):  # type: ignore[no-untyped-def]
    """Return where the chip sees a target whose highest bin is given, bins."""
    if centroid:
        total, x = 0.0, 0.0
        for j in range(max(top - reach, 0), min(top + reach + 1, len(row))):
            total += row[j] - level
            x += (row[j] - level) * (j + 0.5)
        return x / total if total > 0 else top + 0.5
    a, b, c = row[top - 1], row[top], row[top + 1]
    bend = a - 2 * b + c
    return top + 0.5 + (min(max(0.5 * (a - c) / bend, -0.5), 0.5) if bend < 0 else 0.0)


@kernel
def _expect(counts, centroid, reach, threshold, separation, reported, place, spread, sure, scratch):  # type: ignore[no-untyped-def]
    """Fill the targets of each histogram, the highest first."""
    n_bins, most = counts.shape[1], place.shape[1]
    tops, chance = scratch[1], scratch[2]
    unlikely = 4.0  # A bin lower than the highest by more standard deviations than this is not taken for the highest.
    doubtful_bins = 1.5  # peaks that are as far apart as the chip resolves, to within this, may be reported both
    for i in range(counts.shape[0]):
        row = counts[i]
        level = _median(row, scratch[0])
        room = threshold * math.sqrt(max(level, 1.0))
        found, above = 0, math.inf
        while found < most:  # the highest peak below the last one
            best, height = -1, level + room / MARGIN
            for j in range(1, n_bins - 1):
                if row[j] > height and row[j] < above and row[j] >= row[j - 1] and row[j] > row[j + 1]:
                    best, height = j, row[j]
            if best < 0:
                break
            above = height
            beaten = False
            for k in range(found):
                near = abs(tops[k] - best) < separation - doubtful_bins
                beaten = beaten or (near and row[int(tops[k])] - level > MARGIN * (height - level))
            if beaten:
                continue
            # bins about the peak, as far as they may be the highest
            low, high, least = best, best, height - unlikely * math.sqrt(2 * height)
            while low > 1 and least < row[low - 1] <= height and best - low < separation:
                low -= 1
            while high < n_bins - 2 and least < row[high + 1] <= height and high - best < separation:
                high += 1
            total, mean, square = 0.0, 0.0, 0.0
            for j in range(low, high + 1):
                chance[j] = 1.0
                for m in range(low, high + 1):
                    if m != j:
                        chance[j] *= 0.5 * math.erfc((row[m] - row[j]) / math.sqrt(2 * (row[m] + row[j])))
                x = _estimate(row, level, j, centroid, reach)
                total += chance[j]
                mean += chance[j] * x
                square += chance[j] * x * x
            tops[found] = best
            place[i, found] = mean / total
            spread[i, found] = math.sqrt(max(square / total - (mean / total) ** 2, 0.0))
            found += 1
        for k in range(found):
            height = row[int(tops[k])] - level
            must = k < reported and height > MARGIN * room
            for m in range(found):
                gap = abs(tops[k] - tops[m])
                rival = MARGIN * (row[int(tops[m])] - level) > height
                if m != k and rival and gap < separation + doubtful_bins:
                    must = False
            sure[i, k] = must
