"""The data sheet of a direct sensor's histograms: counts, when two targets merge, and range against ambient light."""

from __future__ import annotations

import math

import numpy as np

from phasemark.render.bench.data_sheet.bench import ALBEDOS, Bench, Part
from phasemark.render.bench.data_sheet.flagged_shares import found_beside
from phasemark.render.bench.data_sheet.results import Comparison, Floats, SheetQuantity
from phasemark.render.bench.histogram_law import (
    found_probability,
    merging_distance_m,
    plane_counts,
    response_std_m,
    target_counts,
)
from phasemark.render.direct.bin_counts import counts_of_light, detected_counts, expected_counts
from phasemark.render.direct.footprints import footprint_grid, histogram_of
from phasemark.render.direct.scene_samples import plane_samples
from phasemark.render.direct.targets import Status
from phasemark.render.direct.transients import range_axis, zone_transients
from phasemark.render.sensor.sensor import Sensor

_FRAMES_AT_ONCE = 64
_LEAST_COUNTS = 25.0  # all frames together, for the mean of a bin to be near to normal
_INTEGRAL = 3e-4
"""Error of the simulation's integral over soft zones, of the highest bin; 1e-3 is the bar."""
_SHOWN = 2.0
"""Bins up to this multiple of the plane's distance are shown."""
_SEPARATIONS = 29
_PHASES = 4  # places within a bin
_READINGS = 2000  # of a point of the curves of shares
_AMBIENT_FACTORS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
_LEAST_AMBIENT = 1e-7
_MOST_AMBIENT = 0.15
"""Share of the cycles that ambient light may fire; with more, pile-up tilts the level that the chip takes for even."""
_AROUND = np.linspace(0.8, 1.2, 9)
"""Distances about the predicted one at which detection is measured."""


def histogram_parts(bench: Bench) -> list[Part]:
    """Measure all that the data sheet has of histograms."""
    return [_counts(bench), _merging(bench), *(_ambient(bench, albedo) for albedo in (ALBEDOS[0], ALBEDOS[-1]))]


def _reference_m(sensor: Sensor) -> float:
    """Return a distance well inside the histogram, 1 m where that is."""
    histogram = histogram_of(sensor)
    return min(1.0, 0.5 * (histogram.start_m + histogram.length_m))


def _counts(bench: Bench) -> Part:
    """Measure the mean counts of the zones in the middle and in the corner before a plane."""
    sensor, distance_m = bench.sensor, _reference_m(bench.sensor)
    axis = range_axis(sensor)
    light = zone_transients(plane_samples(distance_m, footprint_grid(sensor)), sensor, axis)
    expected = expected_counts(light, sensor, axis, ALBEDOS[-1])
    total = np.zeros(expected.shape[1:])
    for start in range(0, bench.n_frames, _FRAMES_AT_ONCE):
        n = min(_FRAMES_AT_ONCE, bench.n_frames - start)
        total += bench.histograms(expected, n).zone_counts[0]
    simulated = total / bench.n_frames
    predicted = plane_counts(sensor, distance_m, ALBEDOS[-1])
    histogram = histogram_of(sensor)
    edges = np.asarray(histogram.start_m + histogram.bin_width_m * np.arange(histogram.bins + 1), np.float64)
    shown = int(np.searchsorted(edges, _SHOWN * distance_m))
    alive = np.flatnonzero(bench.alive.ravel())
    middle = (sensor.rows // 2) * sensor.cols + sensor.cols // 2
    zones = dict.fromkeys((int(alive[np.abs(alive - middle).argmin()]), int(alive[0])))
    return Part(tuple(_of_zone(bench, zone, edges[: shown + 1], predicted[zone], simulated[zone]) for zone in zones))


def _of_zone(bench: Bench, zone: int, edges_m: Floats, predicted: Floats, simulated: Floats) -> Comparison:
    """Return the mean counts of one zone's bins beside the prediction; `edges_m` are those of the bins shown."""
    n = bench.n_frames
    error = np.hypot(np.sqrt(predicted / n), _INTEGRAL * predicted.max())
    shown = slice(0, len(edges_m) - 1)
    compared = predicted * n > _LEAST_COUNTS
    row, col = divmod(zone, bench.sensor.cols)
    return Comparison(
        "histogram", f"zone ({row}, {col})", "range_m", "counts", 0.5 * (edges_m[1:] + edges_m[:-1]), predicted[shown],
        simulated[shown], error[shown], np.full(len(edges_m) - 1, n), compared[shown], np.repeat(edges_m, 2)[1:-1],
        np.repeat(predicted[shown], 2),
    )  # fmt: skip


def _seen_ranges(sensor: Sensor, ranges_m: Floats, intensities: Floats) -> Floats:
    """Return the expected counts of zones that see surfaces at some ranges and nothing else.

    Parameters
    ----------
    sensor : Sensor
    ranges_m, intensities : (views, surfaces) float64

    Returns
    -------
    (views, zones, bins) float64
    """
    axis, grid = range_axis(sensor), footprint_grid(sensor)
    light = np.zeros((len(ranges_m), sensor.rows * sensor.cols, axis.n))
    for surface in range(ranges_m.shape[1]):
        flat = plane_samples(ranges_m[:, surface], grid)
        own = np.repeat(np.arange(flat.n_views), np.diff(flat.start))
        area = 1 / (grid.scale_u * grid.scale_v)
        even = flat.amplitude / flat.amplitude * area / 4  # two Gauss points a side of a cell weigh alike
        spread = flat._replace(range_m=ranges_m[own, surface], amplitude=even)
        plain = zone_transients(spread, sensor.with_(vignetting=False), axis)[:, 0]
        plain /= plain.sum(axis=-1, keepdims=True)
        light += plain * intensities[:, surface, None, None]
    return detected_counts(counts_of_light(light, sensor, axis), sensor)


def _merging(bench: Bench) -> Part:
    """Measure the share of frames in which two equal targets are two, against their separation."""
    sensor = bench.sensor
    histogram = histogram_of(sensor)
    if histogram.max_targets < 2:
        return Part(notes=("Its chip reports one target a zone: there is no merging distance to measure.",))
    limit_m = merging_distance_m(sensor)
    separations = limit_m * np.linspace(0.4, 1.6, _SEPARATIONS)
    centre_m = max(_reference_m(sensor), 0.9 * limit_m)
    phases = histogram.bin_width_m * np.arange(_PHASES) / _PHASES
    n = max(1, math.ceil(_READINGS / (_PHASES * sensor.rows * sensor.cols)))
    share = []
    for separation in separations:
        ranges_m = centre_m + phases[:, None] + separation * np.array([-0.5, 0.5])
        bright = np.full(ranges_m.shape, 0.5 * ALBEDOS[-1] / centre_m**2)
        found = bench.histograms(_seen_ranges(sensor, ranges_m, bright), n).targets
        near = np.abs(_as_range(found.distance_m, sensor) - centre_m - phases[:, None, None, None, None]) < limit_m
        two = ((found.status == Status.VALID) & near).sum(axis=-1) >= 2
        share.append(two[..., bench.alive].mean())
    expected = (separations > limit_m).astype(np.float64)
    readings = n * _PHASES * int(bench.alive.sum())
    points = Comparison(
        "merging", "two equal targets", "separation_m", "two_targets_share", separations, expected, np.array(share),
        np.zeros(_SEPARATIONS), np.full(_SEPARATIONS, readings), np.zeros(_SEPARATIONS, np.bool_),
        np.array([separations[0], limit_m, limit_m, separations[-1]]), np.array([0.0, 0.0, 1.0, 1.0]),
    )  # fmt: skip
    found_m, found_error = found_beside(points, 0.5, limit_m)
    error = math.hypot(found_error, histogram.bin_width_m / 2)  # a place between bins decides
    title = "separation from which two equal targets are two (m)"
    return Part(
        (points,), (SheetQuantity("merging_distance_m", title, limit_m, found_m, error, readings * _SEPARATIONS),)
    )


def _as_range(distance_m: Floats, sensor: Sensor) -> Floats:
    """Return reported distances as ranges along the ray."""
    return distance_m / sensor.axis_cosine()[..., None] if histogram_of(sensor).reports == "z" else distance_m


def _ambient(bench: Bench, albedo: float) -> Part:
    """Measure the distance at which half of the frames find a surface, against ambient light."""
    sensor = bench.sensor
    histogram = histogram_of(sensor)
    own = max(histogram.ambient, _LEAST_AMBIENT)
    n = max(1, math.ceil(_READINGS / (sensor.rows * sensor.cols)))
    rows: list[tuple[float, float, float, float]] = []
    for factor in _AMBIENT_FACTORS:
        if own * factor * histogram.bins > _MOST_AMBIENT:
            break
        lit = sensor.with_(histogram={**histogram.model_dump(), "ambient": own * factor})
        half_m = _half_found_m(lit, albedo)
        if half_m is None:
            continue
        distances = half_m * _AROUND
        expected = _seen_ranges(lit, distances[:, None], (albedo / distances**2)[:, None])
        found = bench.histograms(expected, n, lit).targets
        width = 4 * response_std_m(sensor)
        near = np.abs(_as_range(found.distance_m, sensor) - distances[:, None, None, None, None]) < width
        share = (near & (found.status == Status.VALID)).any(axis=-1)[..., bench.alive].mean(axis=(1, 2))
        law = np.array([_share_found(lit, d, albedo) for d in distances])
        simulated, predicted = _crossing(distances, share), _crossing(distances, law)
        slope = abs(float(np.interp(predicted, distances, np.gradient(law, distances))))
        error = 0.5 / math.sqrt(n * int(bench.alive.sum())) / max(slope, 1e-9)
        if math.isfinite(simulated) and math.isfinite(predicted):
            rows.append((own * factor, predicted, simulated, error))
    label = f"albedo {albedo:g}"
    if not rows:
        return Part(notes=(f"Albedo {albedo:g} is found up to the end of the histogram, or ambient light hides it.",))
    x, predicted_m, simulated_m, error_m = np.array(rows).T
    readings = np.full(len(x), n * int(bench.alive.sum()))
    points = Comparison(
        "ambient", label, "ambient_photons", "half_found_m", x, predicted_m, simulated_m, error_m, readings,
        np.zeros(len(x), np.bool_), x, predicted_m,
    )  # fmt: skip
    name, title = f"half_found_albedo_{albedo:g}_m", f"distance at which half of the frames find albedo {albedo:g} (m)"
    stated = np.flatnonzero(np.isclose(x, own))
    quantities = tuple(
        SheetQuantity(name, title, predicted_m[k], simulated_m[k], error_m[k], int(readings[k])) for k in stated
    )
    return Part((points,), quantities)


def _share_found(sensor: Sensor, distance_m: float, albedo: float) -> float:
    """Return the predicted share of frames that find a surface."""
    return found_probability(target_counts(sensor, distance_m, albedo / distance_m**2), sensor, distance_m)


def _half_found_m(sensor: Sensor, albedo: float) -> float | None:
    """Return the predicted distance at which half of the frames find a surface; None where the histogram ends first."""
    histogram = histogram_of(sensor)
    near, far = 0.05, (histogram.start_m + histogram.length_m) / _AROUND[-1] - 4 * response_std_m(sensor)
    if _share_found(sensor, far, albedo) > 0.5 or _share_found(sensor, near, albedo) < 0.5:
        return None
    while far - near > 1e-3:
        middle = 0.5 * (near + far)
        near, far = (middle, far) if _share_found(sensor, middle, albedo) > 0.5 else (near, middle)
    return near


def _crossing(distances: Floats, share: Floats) -> float:
    """Return where a falling share passes a half, between two points."""
    below = np.flatnonzero(share < 0.5)
    if not below.size or below[0] == 0:
        return math.nan
    k = int(below[0])
    return float(np.interp(0.5, share[[k, k - 1]], distances[[k, k - 1]]))
