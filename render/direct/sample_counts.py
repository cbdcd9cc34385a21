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
from phasemark.render.kernel import inner, kernel
from phasemark.render.sensor.sensor import Sensor

_ALL_PARTS = FLOOR + 1


class _Response(NamedTuple):
    """Shares of light by bins, for each place where its response may begin in the earliest of them.

    Parameters
    ----------
    share : (zones or 1, phases + 1, taps) float64
        Of the earliest bin that light reaches and those after it, for begins of the response 0 … 1 bins into that bin.
    begin_m, width_m : (zones,) float64
        Range whose response begins at the lower edge of bin 0, delays of the zone taken off, and width of the bins.
    """

    share: NDArray[np.float64]
    begin_m: NDArray[np.float64]
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
    alike = len(response.share) == 1 and np.ptp(response.begin_m) == 0
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
    offset = np.broadcast_to(sensor.zone_offsets + sensor.range_offset_m, (sensor.rows, sensor.cols)).ravel()
    width_m = histogram.bin_width_m * sensor.zone_values("zone_bin_scale").ravel()
    begin_m = histogram.start_m - offset - histogram.irf_reach_m[0]
    low, high = histogram.irf_reach_m
    if histogram.irf_std_m is not None:
        steps_per_std = 64
        step = histogram.irf_std_m / steps_per_std
    else:
        steps_per_sample = 32
        step = (high - low) / ((len(histogram.irf[0]) - 1) * steps_per_sample)
    phase = np.linspace(0.0, 1.0, math.ceil(width_m.max() / step) + 1)[:, None]
    edges = np.arange(math.ceil((high - low) / width_m.min()) + 2) - phase  # of bins, from where the response begins
    alike = len(histogram.irf) <= 1 and np.ptp(width_m) == 0
    zones_apart = range(1 if alike else n_zones)
    share = np.stack([np.diff(response_share(low + edges * width_m[q], histogram, q), axis=1) for q in zones_apart])
    response = _Response(share, begin_m, width_m)
    scale = sensor.zone_values("zone_gain").ravel() / footprint_areas(zones)
    return _Optics(zones, scale, footprint_areas(zones._replace(light=np.zeros(3))), response)


@inner
def _add_to_bins(light, range_m, response, zone, out):  # type: ignore[no-untyped-def]
    """Share light from one range among the bins of a zone, linearly between two phases."""
    share = response.share[min(zone, len(response.share) - 1)]
    place = (range_m - response.begin_m[zone]) / response.width_m[zone]
    earliest = math.floor(place)
    x = (place - earliest) * (share.shape[0] - 1)
    i = min(int(x), share.shape[0] - 2)
    before, after, f = share[i], share[i + 1], x - i
    for k in range(max(-earliest, 0), min(len(out) - earliest, share.shape[1])):
        out[earliest + k] += light * (before[k] + f * (after[k] - before[k]))


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
