"""Targets that the chip computes from its histograms: range, sigma, signal and status (PHYSICS section 11)."""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from phasemark.render.direct.footprints import histogram_of
from phasemark.render.kernel import inner, kernel
from phasemark.render.sensor.sensor import Sensor


class Status(IntEnum):
    """Status of a target: valid, or the reason why it is missing."""

    VALID = 0
    """A target."""
    NO_TARGET = 1
    """No further peak rises above the threshold."""


class Targets(NamedTuple):
    """Targets of every zone, nearest first; arrays are (n, frames, rows, cols, targets).

    Parameters
    ----------
    distance_m : float64
        Range along the ray, or z where the sensor reports z; NaN where there is no target.
    sigma_m : float64
        Standard deviation that the counts of the peak leave.
    signal : float64
        Counts of the peak above ambient.
    status : uint8
        :class:`Status`.
    """

    distance_m: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    signal: NDArray[np.float64]
    status: NDArray[np.uint8]


class Counted(Protocol):
    """Interface of objects with histograms: :class:`~phasemark.render.direct.HistogramFrames`."""

    counts: NDArray[np.float64]
    sensor: Sensor


def find_targets(frames: Counted) -> Targets:
    """Run the chip's estimator on histograms.

    The ambient level is the median bin. Peaks are local maxima that rise above it by `threshold` standard deviations
    of a bin; the highest come first, others at least `min_separation_m` away follow, up to `max_targets`. A peak is
    placed between bins by the centroid of its counts above ambient or by the parabola through its three highest bins. A
    peak whose centroid lies outside of the bins that it is taken over is none.

    Parameters
    ----------
    frames : HistogramFrames
        Histograms.

    Returns
    -------
    Targets
    """
    sensor, histogram = frames.sensor, histogram_of(frames.sensor)
    shape = frames.counts.shape
    flat = np.ascontiguousarray(frames.counts.reshape(-1, shape[-1]))
    n, most = len(flat), histogram.max_targets
    place, sigma, signal = np.full((n, most), np.nan), np.full((n, most), np.nan), np.zeros((n, most))
    _find_peaks(
        flat, histogram.estimator == "centroid", histogram.estimator_bins, histogram.threshold,
        histogram.min_separation_m / histogram.bin_width_m, place, sigma, signal, np.empty(shape[-1]),
    )  # fmt: skip
    out = (*shape[:-1], most)
    range_m, slope = place_to_range(place.reshape(out), sensor)
    status = np.where(np.isfinite(range_m), int(Status.VALID), int(Status.NO_TARGET)).astype(np.uint8)
    return Targets(range_m, sigma.reshape(out) * slope, signal.reshape(out), status)


def place_to_range(place: NDArray[np.float64], sensor: Sensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Turn places in a histogram into what the sensor reports, and the metres per bin there.

    A chip does not know its offsets of range and zones: what it reports is late by them.

    Parameters
    ----------
    place : (..., rows, cols, targets) float64
        In bins; the middle of bin 0 is 0.5.
    sensor : Sensor
    """
    histogram = histogram_of(sensor)
    width = histogram.bin_width_m * sensor.zone_values("zone_bin_scale")[..., None]
    mean_delay = np.array(response_means(sensor)).reshape(sensor.rows, sensor.cols, 1)
    cosine = sensor.axis_cosine()[..., None] if histogram.reports == "z" else np.ones((1, 1, 1))
    return (histogram.start_m + place * width - mean_delay) * cosine, width * cosine


def response_means(sensor: Sensor) -> list[float]:
    """Return the mean delay of each zone's response, metres: what a centroid is late by."""
    histogram = histogram_of(sensor)
    n = sensor.rows * sensor.cols
    if histogram.irf_std_m is not None:
        return [0.0] * n
    x = histogram.irf_start_m + (histogram.irf_step_m or 0.0) * np.arange(len(histogram.irf[0]))
    means = [float(np.dot(row, x) / sum(row)) for row in histogram.irf]
    return means if len(means) == n else means * n


@inner
def _median(row, scratch):  # type: ignore[no-untyped-def]
    """Return the median of a histogram by Hoare's selection; `scratch` has its length and is overwritten."""
    n = len(row)
    for k in range(n):
        scratch[k] = row[k]
    middle, low, high = n // 2, 0, n - 1
    while low < high:
        pivot, i, j = scratch[(low + high) // 2], low, high
        while i <= j:
            while scratch[i] < pivot:
                i += 1
            while pivot < scratch[j]:
                j -= 1
            if i <= j:
                scratch[i], scratch[j] = scratch[j], scratch[i]
                i += 1
                j -= 1
        if j < middle:
            low = i
        if middle < i:
            high = j
    if n % 2 == 1:
        return scratch[middle]
    below = scratch[0]
    for k in range(1, middle):
        below = max(below, scratch[k])
    return 0.5 * (below + scratch[middle])


@kernel
def _find_peaks(counts, centroid, reach, threshold, separation, place, sigma, signal, scratch):  # type: ignore[no-untyped-def]
    """Fill the targets of each histogram, nearest first."""
    n_bins, most = counts.shape[1], place.shape[1]
    for i in range(counts.shape[0]):
        row = counts[i]
        level = _median(row, scratch)  # peaks take fewer than half of the bins
        least = level + threshold * math.sqrt(max(level, 1.0))
        found = 0
        for j in range(n_bins):
            scratch[j] = 0.0  # 1 where a peak was passed over
        while found < most:
            best, height = -1, least
            for j in range(1, n_bins - 1):
                if row[j] <= height or row[j] < row[j - 1] or row[j] < row[j + 1] or scratch[j] > 0:
                    continue
                apart = True
                for k in range(found):
                    apart = apart and abs(j + 0.5 - place[i, k]) >= max(separation, 1.0)
                if apart:
                    best, height = j, row[j]
            if best < 0:
                break
            x, variance, total = 0.0, 0.0, 0.0
            if centroid:
                low, high = max(best - reach, 0), min(best + reach + 1, n_bins)
                for j in range(low, high):
                    total += row[j] - level
                    x += (row[j] - level) * (j + 0.5)
                if not low * total < x < high * total:  # dark bins beside it leave no counts that could be placed
                    scratch[best] = 1.0
                    continue
                x /= total
                for j in range(low, high):
                    variance += row[j] * (j + 0.5 - x) ** 2
                variance /= total * total
            else:
                a, b, c = row[best - 1], row[best], row[best + 1]
                bend = a - 2 * b + c
                total = a + b + c - 3 * level
                x = best + 0.5
                if bend < 0:
                    x += 0.5 * (a - c) / bend
                    # of ½ (a − c) / (a − 2b + c), to first order
                    da, dc = (c - b) / (bend * bend), (b - a) / (bend * bend)
                    db = (a - c) / (bend * bend)
                    variance = da * da * a + db * db * b + dc * dc * c
            k = found
            while k > 0 and place[i, k - 1] > x:  # nearest first
                place[i, k], sigma[i, k], signal[i, k] = place[i, k - 1], sigma[i, k - 1], signal[i, k - 1]
                k -= 1
            place[i, k], sigma[i, k], signal[i, k] = x, math.sqrt(variance), total
            found += 1
