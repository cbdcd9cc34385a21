"""Signal counts straight from the samples of a scene: each is shared among its bins, without a transient between.

A scene of a thousand samples lights some ten bins a sample; a transient convolved with the response multiplies two
thousand nodes by all bins of every zone. Both give the same counts to 1e-5 of the peak (PHYSICS section 11).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark.render.direct.bin_counts import response_share
from phasemark.render.direct.footprints import (
    Footprints,
    border_weight,
    footprint_areas,
    footprints_of,
    histogram_of,
    light_weight,
    zones_along,
)
from phasemark.render.direct.transients import PARTS, through_lens
from phasemark.render.integral.scene_samples import FLOOR, WALL, SceneSamples
from phasemark.render.kernel import kernel
from phasemark.render.sensor.sensor import Sensor

_ALL_PARTS = FLOOR + 1


class _Response(NamedTuple):
    """The cumulative response of each zone on a fine axis of delays, and where bins begin.

    Parameters
    ----------
    share : (zones or 1, m) float64
        0 … 1 along the delays.
    first_m, steps_per_m : float
        First delay and density of the axis.
    start_m, width_m : (zones,) float64
        Range of the lower edge of bin 0, delays of the zone taken off, and width of the bins.
    """

    share: NDArray[np.float64]
    first_m: float
    steps_per_m: float
    start_m: NDArray[np.float64]
    width_m: NDArray[np.float64]


class _Optics(NamedTuple):
    zones: Footprints
    scale: NDArray[np.float64]
    areas: NDArray[np.float64]
    response: _Response


def signal_of_samples(samples: SceneSamples, sensor: Sensor, albedo: ArrayLike = 1.0) -> NDArray[np.float64]:
    """Return the expected signal counts without pile-up, stray light between zones included.

    Parameters
    ----------
    samples : SceneSamples
        n poses, of the landmark alone.
    sensor : Sensor
        With a [histogram] table.
    albedo : float or (parts,)
        Of each part.

    Returns
    -------
    (n, zones, bins) float64
        What :func:`~phasemark.render.direct.bin_counts.signal_counts` returns of the samples' transients.
    """
    albedos = np.zeros(_ALL_PARTS)
    albedos[:PARTS] = albedo
    return _signals(samples, sensor, albedos, np.zeros(_ALL_PARTS, np.int64), 1)[:, 0]


def signal_of_surfaces(samples: SceneSamples, sensor: Sensor, albedo: float = 1.0) -> NDArray[np.float64]:
    """Return the expected signal counts of landmark, wall and floor, each by itself, without pile-up.

    Parameters
    ----------
    samples : SceneSamples
        n poses.
    sensor : Sensor
        With a [histogram] table.
    albedo : float
        Of the landmark; samples of wall and floor have theirs in their amplitude.

    Returns
    -------
    (n, 3, zones, bins) float64
        Landmark, wall, floor; their sum is the signal of the scene.
    """
    return _signals(samples, sensor, np.array([albedo, albedo, 1.0, 1.0]), np.array([0, 0, 1, 2]), 3)


def signal_and_shares(
    samples: SceneSamples, sensor: Sensor, n_bodies: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the expected signal counts without pile-up, and the share of each zone that each body fills.

    Parameters
    ----------
    samples : SceneSamples
        n poses of a scene; amplitudes have albedos in them.
    sensor : Sensor
        With a [histogram] table.
    n_bodies : int
        What stands behind bodies has higher numbers, and no share.

    Returns
    -------
    signal : (n, zones, bins) float64
    shares : (n, zones, n_bodies) float64
        Light plays no part in them.
    """
    shares = np.zeros((samples.n_views, sensor.rows * sensor.cols, n_bodies))
    n_parts = n_bodies + FLOOR - WALL + 1
    signal = _signals(samples, sensor, np.ones(n_parts), np.zeros(n_parts, np.int64), 1, shares)
    return signal[:, 0], np.minimum(shares, 1.0)


_NO_SHARES = np.zeros((0, 0, 0))


def _signals(
    samples: SceneSamples, sensor: Sensor, albedos: NDArray[np.float64], place: NDArray[np.int64], n_places: int,
    shares: NDArray[np.float64] = _NO_SHARES,
) -> NDArray[np.float64]:  # fmt: skip
    """Return signal counts, the light of each part of the scene times its albedo added to the place of the part.

    What each body fills of each zone is added to `shares`, (n, zones, bodies), if they are asked for.
    """
    histogram, optics = histogram_of(sensor), _optics_of(sensor)
    n_zones = sensor.rows * sensor.cols
    out = np.zeros((samples.n_views, n_places, n_zones, histogram.bins))
    response = optics.response
    # zones of one response are lit alike by stray light, which is then added to their counts in the end
    alike = len(response.share) == 1 and np.ptp(response.start_m) == 0 and np.ptp(response.width_m) == 0
    stray = 0.0 if alike else histogram.stray
    _add_samples(through_lens(samples, sensor), albedos, place, optics, sensor.cols, stray, out, shares)
    if alike and histogram.stray > 0:
        out += histogram.stray * out.mean(axis=2, keepdims=True)
    out *= histogram.cycles * histogram.photons
    return out


@lru_cache(maxsize=16)
def _optics_of(sensor: Sensor) -> _Optics:
    """Return footprints and responses of a sensor as the kernel takes them."""
    histogram, zones = histogram_of(sensor), footprints_of(sensor)
    n_zones = sensor.rows * sensor.cols
    low, high = histogram.irf_reach_m
    if histogram.irf_std_m is not None:
        steps_per_std = 64
        step = histogram.irf_std_m / steps_per_std
    else:
        steps_per_sample = 32
        step = (high - low) / ((len(histogram.irf[0]) - 1) * steps_per_sample)
    delay = low + step * np.arange(int(np.ceil((high - low) / step)) + 1)
    alike = len(histogram.irf) <= 1
    share = np.stack([response_share(delay, histogram, zone) for zone in range(1 if alike else n_zones)])
    offset = np.broadcast_to(sensor.zone_offsets + sensor.range_offset_m, (sensor.rows, sensor.cols)).ravel()
    width_m = histogram.bin_width_m * sensor.zone_values("zone_bin_scale").ravel()
    response = _Response(share, float(low), 1 / step, histogram.start_m - offset, width_m)
    scale = sensor.zone_values("zone_gain").ravel() / footprint_areas(zones)
    return _Optics(zones, scale, footprint_areas(zones._replace(light=np.zeros(3))), response)


@kernel
def _share(table, x):  # type: ignore[no-untyped-def]
    """Return the cumulative response at a place along its axis, linear between two steps."""
    if x <= 0.0:
        return 0.0
    i = int(x)
    if i >= len(table) - 1:
        return 1.0
    return table[i] + (x - i) * (table[i + 1] - table[i])


@kernel
def _add_to_bins(light, range_m, response, zone, out):  # type: ignore[no-untyped-def]
    """Share light from one range among the bins of a zone."""
    table = response.share[min(zone, len(response.share) - 1)]
    first, density, width_m = response.first_m, response.steps_per_m, response.width_m[zone]
    nearest = range_m - response.start_m[zone]
    j = max(math.floor((nearest + first) / width_m), 0)
    stop = min(math.ceil((nearest + first + (len(table) - 1) / density) / width_m), len(out))
    x = (j * width_m - nearest - first) * density
    step = width_m * density
    below = _share(table, x)
    while j < stop:
        x += step
        above = _share(table, x)
        out[j] += light * (above - below)
        below = above
        j += 1


@kernel
def _add_samples(samples, albedo, place, optics, cols, stray, out, shares):  # type: ignore[no-untyped-def]
    """Add every sample to the bins of the zones that count its light, and its area to the shares of its body."""
    n_zones = out.shape[2]
    zones, scale, response = optics.zones, optics.scale, optics.response
    for view in range(len(samples.start) - 1):
        for k in range(samples.start[view], samples.start[view + 1]):
            y, z, part = samples.tangents[k, 0], samples.tangents[k, 1], samples.part[k]
            light, lit = samples.amplitude[k] * albedo[part], light_weight(zones, y, z)
            counts = out[view, place[part]]
            total = 0.0
            first_col, stop_col = zones_along(zones, 0, cols, y)
            first_row, stop_row = zones_along(zones, 1, cols, z)
            for row in range(first_row, stop_row):
                for q in range(row * cols + first_col, row * cols + stop_col):
                    w = border_weight(zones, q, y, z)
                    if w == 0.0:
                        continue
                    if part < shares.shape[2]:
                        shares[view, q, part] += w * samples.area[k] / optics.areas[q]
                    w *= lit
                    w *= scale[q] * light
                    total += w
                    _add_to_bins(w, samples.range_m[k], response, q, counts[q])
            if stray > 0.0 and total > 0.0:
                total *= stray / n_zones
                for q in range(n_zones):
                    _add_to_bins(total, samples.range_m[k], response, q, counts[q])
