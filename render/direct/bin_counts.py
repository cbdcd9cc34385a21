"""Expected counts of a histogram: response, ambient light, crosstalk and pile-up (PHYSICS section 11)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from phasemark import UsageError
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.transients import RangeAxis
from phasemark.render.kernel import kernel
from phasemark.render.sensor.histogram_fields import Histogram
from phasemark.render.sensor.sensor import Sensor


def response_share(delay_m: ArrayLike, histogram: Histogram, zone: int = 0) -> NDArray[np.float64]:
    """Return the share of the instrument response that arrives up to a delay: its cumulative distribution.

    Parameters
    ----------
    delay_m : array_like
        Delay as range, metres.
    histogram : Histogram
    zone : int
        Which zone's response, in image order.

    Returns
    -------
    ndarray
        0 … 1. Between samples the response is linear, so its integral is quadratic.
    """
    delay = np.asarray(delay_m, dtype=np.float64)
    if histogram.irf_std_m is not None:
        return np.asarray(ndtr(delay / histogram.irf_std_m))
    row = np.array(histogram.irf[zone if len(histogram.irf) > 1 else 0])
    whole = np.concatenate([[0.0], np.cumsum(0.5 * (row[1:] + row[:-1]))])
    x = np.clip((delay - histogram.irf_start_m) / (histogram.irf_step_m or 1.0), 0.0, len(row) - 1.0)
    k = np.minimum(x.astype(np.int64), len(row) - 2)
    f = x - k
    return np.asarray((whole[k] + f * (row[k] + 0.5 * f * (row[k + 1] - row[k]))) / whole[-1])


@lru_cache(maxsize=16)
def bin_response(sensor: Sensor, axis: RangeAxis) -> NDArray[np.float64]:
    """Return how light from each range is shared among the bins.

    Returns
    -------
    (zones or 1, nodes, bins) float64
        One for all zones where they do not differ. Not to be written to.
    """
    histogram = histogram_of(sensor)
    n = sensor.rows * sensor.cols
    offsets = (sensor.zone_offsets + sensor.range_offset_m).ravel()
    scales = sensor.zone_values("zone_bin_scale").ravel()
    alike = len(histogram.irf) <= 1 and np.ptp(offsets) == 0 and np.ptp(scales) == 0
    zones = 1 if alike else n
    out = np.empty((zones, axis.n, histogram.bins))
    for zone in range(zones):
        edges = histogram.start_m + histogram.bin_width_m * scales[zone] * np.arange(histogram.bins + 1)
        delay = edges[None] - (axis.nodes_m + offsets[zone])[:, None]
        out[zone] = np.diff(response_share(delay, histogram, zone), axis=1)
    out.flags.writeable = False
    return out


def signal_counts(
    transients: NDArray[np.float64], sensor: Sensor, axis: RangeAxis, albedo: ArrayLike = 1.0
) -> NDArray[np.float64]:
    """Return the expected signal counts without pile-up, stray light between zones included.

    Parameters
    ----------
    transients : (n, parts, zones, nodes) float64
        From :func:`~phasemark.render.direct.transients.zone_transients`.
    sensor : Sensor
    axis : RangeAxis
    albedo : float or (parts,)
        Of each part.

    Returns
    -------
    (n, zones, bins) float64
    """
    albedos = np.broadcast_to(np.asarray(albedo, dtype=np.float64), transients.shape[1:2])
    return counts_of_light(np.einsum("npzr,p->nzr", transients, albedos), sensor, axis)


def counts_of_light(light: NDArray[np.float64], sensor: Sensor, axis: RangeAxis) -> NDArray[np.float64]:
    """Return the expected signal counts of light that is spread over ranges, without pile-up.

    Parameters
    ----------
    light : (n, zones, nodes) float64
        Transients of all parts of a scene, times their albedos.
    sensor : Sensor
    axis : RangeAxis

    Returns
    -------
    (n, zones, bins) float64
    """
    histogram = histogram_of(sensor)
    response = bin_response(sensor, axis)
    light = light * sensor.zone_values("zone_gain").reshape(-1, 1)
    if histogram.stray > 0:
        light = light + histogram.stray * light.mean(axis=1, keepdims=True)
    counts = np.zeros((*light.shape[:2], histogram.bins))
    _respond(light, response, _reached_bins(sensor, axis), counts)
    counts *= histogram.cycles * histogram.photons
    return counts


@lru_cache(maxsize=16)
def _reached_bins(sensor: Sensor, axis: RangeAxis) -> NDArray[np.int64]:
    """Return the first bin that light from each node reaches, and the one behind the last: (zones or 1, nodes, 2)."""
    least_share = 1e-15  # of the light from one range: a bin that gets less is not reached by it
    reached = bin_response(sensor, axis) > least_share
    first, last = reached.argmax(axis=2), reached.shape[2] - reached[..., ::-1].argmax(axis=2)
    return np.stack([first, np.where(reached.any(axis=2), last, first)], axis=-1)


@kernel
def _respond(light, response, reached, counts):  # type: ignore[no-untyped-def]
    """Add to the bins what arrives in them; most nodes are dark, and light from a node reaches few bins."""
    for view in range(light.shape[0]):
        for zone in range(light.shape[1]):
            row, own = counts[view, zone], min(zone, len(response) - 1)
            for node in range(light.shape[2]):
                amount = light[view, zone, node]
                if amount == 0.0:
                    continue
                for k in range(reached[own, node, 0], reached[own, node, 1]):
                    row[k] += amount * response[own, node, k]


def expected_counts(
    transients: NDArray[np.float64], sensor: Sensor, axis: RangeAxis, albedo: ArrayLike = 1.0
) -> NDArray[np.float64]:
    """Return the expected counts λ of every bin, pile-up included (PHYSICS section 11).

    Parameters
    ----------
    transients : (n, parts, zones, nodes) float64
        From :func:`~phasemark.render.direct.transients.zone_transients`.
    sensor : Sensor
        The direct sensor.
    axis : RangeAxis
        Ranges of the nodes.
    albedo : float or (parts,)
        Of each part.

    Returns
    -------
    (n, zones, bins) float64
    """
    return detected_counts(signal_counts(transients, sensor, axis, albedo), sensor)


def detected_counts(signal: NDArray[np.float64], sensor: Sensor) -> NDArray[np.float64]:
    """Return expected counts λ, pile-up included, from expected signal counts.

    Ambient light, dark counts and the crosstalk of a cover glass are added, then pile-up takes what the first photon of
    a cycle leaves (PHYSICS section 11).

    Parameters
    ----------
    signal : (..., zones, bins) float64
        From :func:`signal_counts`, or their sum over parts of a scene.
    sensor : Sensor
        The camera.

    Returns
    -------
    (..., zones, bins) float64
    """
    histogram = histogram_of(sensor)
    counts = signal + histogram.cycles * (histogram.ambient + histogram.dark)
    if histogram.crosstalk > 0:
        counts += glass_counts(sensor)
    return piled_up(counts, histogram.cycles) if histogram.pile_up else counts


def glass_counts(sensor: Sensor) -> NDArray[np.float64]:
    """Return the expected counts of the cover glass in one frame, (bins,)."""
    histogram = histogram_of(sensor)
    edges = histogram.start_m + histogram.bin_width_m * np.arange(histogram.bins + 1)
    return np.asarray(histogram.crosstalk * np.diff(response_share(edges - histogram.crosstalk_range_m, histogram)))


def piled_up(counts: NDArray[np.float64], cycles: float) -> NDArray[np.float64]:
    """Return the counts of first photons, from counts without pile-up.

    pⱼ = (1 − Σ pᵢ)(1 − exp(−λⱼ / cycles)), the sum over all i < j, is the share of cycles whose first photon falls into
    bin j. With Λⱼ = Σ λᵢ / cycles over all i ≤ j it is exp(−Λⱼ₋₁) − exp(−Λⱼ).

    Parameters
    ----------
    counts : (..., bins) float64
        Expected counts λ if every photon were counted.
    cycles : float
        Laser pulses of a frame.
    """
    before = np.cumsum(counts, axis=-1) - counts
    return np.asarray(-cycles * np.exp(-before / cycles) * np.expm1(-counts / cycles))


def without_pile_up(counts: NDArray[np.float64], cycles: float) -> NDArray[np.float64]:
    """Return the counts that there would be without pile-up: the inverse of :func:`piled_up` (Coates 1968).

    Raises
    ------
    UsageError
        More first photons than cycles.
    """
    before = np.cumsum(counts, axis=-1) - counts
    left = cycles - before
    if not (counts < left).all():
        raise UsageError(f"a histogram has as many counts as there are first photons, {cycles:.4g}: it is saturated")
    return np.asarray(-cycles * np.log1p(-counts / left))
