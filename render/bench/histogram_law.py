"""Predicted counts and targets of a direct sensor, by other arithmetic than the simulation (PHYSICS section 11).

A zone is integrated by midpoints, pile-up is the recursion over bins, and a target is found where a bin exceeds the
threshold about the median.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

from phasemark.render.direct.footprints import histogram_of
from phasemark.render.sensor.sensor import Sensor

_CELLS_PER_BIN = 256
_BORDERS = 2.5  # 1/e widths that a soft border is followed outwards
_FINER = 16  # nodes of the cumulative response for each sample
_REACH = 4.0
"""Standard deviations of response and bin about a target in which a bin above the threshold counts as found."""

Floats = NDArray[np.float64]


def cumulative_response(delay_m: Floats, sensor: Sensor, zone: int) -> Floats:
    """Return the share of the instrument response up to a delay as range, metres."""
    histogram = histogram_of(sensor)
    if histogram.irf_std_m is not None:
        return np.asarray(0.5 * (1 + special.erf(delay_m / (math.sqrt(2) * histogram.irf_std_m))))
    row = np.array(histogram.irf[zone if len(histogram.irf) > 1 else 0])
    step = histogram.irf_step_m or 1.0
    x = np.linspace(0.0, len(row) - 1.0, _FINER * (len(row) - 1) + 1)
    density = np.interp(x, np.arange(len(row)), row)
    whole = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    return np.asarray(np.interp(delay_m, histogram.irf_start_m + step * x, whole / whole[-1]), np.float64)


def response_std_m(sensor: Sensor) -> float:
    """Return the standard deviation of the response of zone 0 and a bin together, metres."""
    histogram = histogram_of(sensor)
    bin_variance = histogram.bin_width_m**2 / 12
    if histogram.irf_std_m is not None:
        return math.sqrt(histogram.irf_std_m**2 + bin_variance)
    row = np.array(histogram.irf[0])
    x = (histogram.irf_step_m or 1.0) * np.arange(len(row))
    mean = float(row @ x / row.sum())
    return math.sqrt(float(row @ (x - mean) ** 2 / row.sum()) + bin_variance)


def bin_edges_m(sensor: Sensor, zone: int) -> Floats:
    """Return the edges of a zone's bins as ranges of the world, (bins + 1,) metres."""
    histogram = histogram_of(sensor)
    row, col = divmod(zone, sensor.cols)
    scale = histogram.zone_bin_scale[row][col] if histogram.zone_bin_scale else 1.0
    offset_m = sensor.range_offset_m + float(sensor.zone_offsets.reshape(sensor.rows, -1)[row, col])
    edges = histogram.start_m + histogram.bin_width_m * scale * np.arange(histogram.bins + 1)
    return np.asarray(edges - offset_m, np.float64)


def plane_counts(sensor: Sensor, distance_m: float, albedo: float) -> Floats:
    """Return the expected counts before a plane across the optical axis, (zones, bins).

    Parameters
    ----------
    sensor : Sensor
        With a [histogram] table.
    distance_m : float
    albedo : float
    """
    histogram = histogram_of(sensor)
    n = sensor.rows * sensor.cols
    light = np.stack([_plane_light(sensor, distance_m, zone) for zone in range(n)])
    cell_m = histogram.bin_width_m / _CELLS_PER_BIN
    range_m = cell_m * (np.arange(light.shape[1]) + 0.5)
    if histogram.zone_gain:
        light *= np.array(histogram.zone_gain).ravel()[:, None]
    light += histogram.stray * light.mean(axis=0)
    counts = np.empty((n, histogram.bins))
    lit = light.any(axis=0)
    for zone in range(n):
        delay = bin_edges_m(sensor, zone)[:, None] - range_m[None, lit]
        shares = np.diff(cumulative_response(delay, sensor, zone), axis=0)
        counts[zone] = detected(histogram.cycles * histogram.photons * albedo * (shares @ light[zone, lit]), sensor)
    return counts


def target_counts(sensor: Sensor, range_m: float, intensity: float) -> Floats:
    """Return the expected counts of zone 0 if it sees one range alone, (bins,).

    Parameters
    ----------
    sensor : Sensor
    range_m : float
    intensity : float
        1 for albedo 1 facing the sensor at 1 m.
    """
    histogram = histogram_of(sensor)
    shares = np.diff(cumulative_response(bin_edges_m(sensor, 0) - range_m, sensor, 0))
    light = intensity * (1 + histogram.stray) * (histogram.zone_gain[0][0] if histogram.zone_gain else 1.0)
    return detected(histogram.cycles * histogram.photons * light * shares, sensor)


def detected(signal: Floats, sensor: Sensor) -> Floats:
    """Return expected counts of one histogram with ambient light, dark counts, crosstalk and pile-up, (bins,)."""
    histogram = histogram_of(sensor)
    counts = signal + histogram.cycles * (histogram.ambient + histogram.dark)
    if histogram.crosstalk > 0:
        edges = np.asarray(histogram.start_m + histogram.bin_width_m * np.arange(histogram.bins + 1), np.float64)
        share = np.diff(cumulative_response(edges - histogram.crosstalk_range_m, sensor, 0))
        counts = np.asarray(counts + histogram.crosstalk * share)
    if not histogram.pile_up:
        return np.asarray(counts)
    free, out = 1.0, np.empty(len(counts))
    for j, rate in enumerate(counts / histogram.cycles):
        out[j] = free * (1 - math.exp(-rate))
        free -= out[j]
    return np.asarray(histogram.cycles * out)


def found_probability(counts: Floats, sensor: Sensor, range_m: float) -> float:
    """Return the probability that a frame has a target about a range: some bin there exceeds the threshold.

    The ambient level is the median of the bins' Poisson medians.

    Parameters
    ----------
    counts : (bins,) float64
        Expected.
    sensor : Sensor
    range_m : float
    """
    level = float(np.median(stats.poisson.ppf(0.5, counts)))
    least = level + histogram_of(sensor).threshold * math.sqrt(max(level, 1.0))
    edges = bin_edges_m(sensor, 0)
    near = np.abs(0.5 * (edges[1:] + edges[:-1]) - range_m) < _REACH * response_std_m(sensor)
    return 1 - float(np.prod(stats.poisson.cdf(np.floor(least), counts[near])))


def merging_distance_m(sensor: Sensor) -> float:
    """Return the separation below which two equal targets are one.

    Two Gaussians have one maximum up to two standard deviations; the chip keeps targets `min_separation_m` apart.
    """
    return max(2 * response_std_m(sensor), histogram_of(sensor).min_separation_m)


def _plane_light(sensor: Sensor, distance_m: float, zone: int) -> Floats:
    """Return the mean amplitude that a zone sees of a plane of albedo 1, by cells of range."""
    histogram = histogram_of(sensor)
    row, col = divmod(zone, sensor.cols)
    tan_h, tan_v = sensor.tan_half_angles
    u0, v0 = sensor.centre_px
    centre = (2 * tan_h / sensor.cols * (u0 - col - 0.5), 2 * tan_v / sensor.rows * (v0 - row - 0.5))
    sides = zip((tan_h, tan_v), (sensor.cols, sensor.rows), histogram.zone_scale, sensor.fill_factor, strict=True)
    half = [tan / count * scale * fill for tan, count, scale, fill in sides]
    blur = histogram.zone_blur
    profiles, tangents = [], []
    midpoints = 160  # along the width and the height of a zone
    for middle, extent in zip(centre, half, strict=True):
        reach = extent + _BORDERS * blur
        offset = reach * ((np.arange(midpoints) + 0.5) / midpoints * 2 - 1)
        profile = np.ones(midpoints)
        if blur > 0:
            profile = 0.5 * (special.erf((offset + extent) / blur) - special.erf((offset - extent) / blur))
        profiles.append(profile)
        tangents.append(middle + offset)
    y, z = np.meshgrid(tangents[0], tangents[1])
    weight = np.outer(profiles[1], profiles[0])
    if histogram.light_width is not None:
        from_y, from_z = y - histogram.light_centre[0], z - histogram.light_centre[1]
        weight = weight * np.exp(-0.5 * (from_y**2 + from_z**2) / histogram.light_width**2)
    length = np.sqrt(1 + y**2 + z**2)
    amplitude = weight / weight.sum() / (distance_m**2 * length**3)  # cos θ = 1 / length, r = distance · length
    if sensor.vignetting:
        amplitude = amplitude / length**4
    cell_m = histogram.bin_width_m / _CELLS_PER_BIN
    furthest = distance_m * math.sqrt(1 + (tan_h * 4) ** 2 + (tan_v * 4) ** 2)
    cells = np.minimum((distance_m * length / cell_m).astype(np.int64), int(furthest / cell_m))
    light = np.bincount(cells.ravel(), amplitude.ravel(), minlength=int(furthest / cell_m) + 1)
    return np.asarray(light, np.float64)
