"""The data sheet of a direct time-of-flight sensor: its range, where it drops out, and its histograms."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from phasemark.render.bench.data_sheet.bench import ALBEDOS, NEAREST_M, Bench, Row, crossing_of
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
from phasemark.render.direct.targets import Status
from phasemark.render.direct.transients import range_axis, zone_transients
from phasemark.render.frames import Flag
from phasemark.render.integral.scene_samples import plane_samples
from phasemark.render.sensor.range_noise import direct_range_std
from phasemark.render.sensor.sensor import Sensor

_FRAMES_AT_ONCE = 64
_SHOWN = 2.0
"""Bins up to this multiple of the plane's distance are shown."""
_READINGS = 2000  # of a point of the curves of shares
_AMBIENT_FACTORS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
_AROUND = np.linspace(0.8, 1.2, 9)
"""Distances about the predicted one at which detection is measured."""


def direct_rows(bench: Bench) -> Iterator[Row]:
    """Measure everything that the data sheet of a direct sensor has."""
    counted = [] if bench.sensor.histogram is None else list(_histogram_rows(bench))
    yield from _range(bench)
    for albedo in ALBEDOS:
        yield from _dropout(bench, albedo)
    yield from counted
    yield (
        "It is a direct time-of-flight sensor: photon transfer, saturation, wiggling and amplitude thresholds belong "
        "to taps and phases, which it does not have."
    )


def _histogram_rows(bench: Bench) -> Iterator[Row]:
    yield from _counts(bench)
    yield from _merging(bench)
    for albedo in (ALBEDOS[0], ALBEDOS[-1]):
        yield from _ambient(bench, albedo)


def _range(bench: Bench) -> Iterator[Row]:
    """Measure noise and mean error of the range, up to where it drops out on the brightest surface."""
    sensor, n, albedo = bench.sensor, bench.samples, ALBEDOS[-1]
    furthest = min(_dropout_distance_m(sensor, albedo), 10.0)
    distances = np.linspace(NEAREST_M, 0.98 * furthest, 20)
    errors = [bench.range_errors(bench.frames(d, albedo / d**2), d) for d in distances]
    true_std, curve = direct_range_std(albedo / distances**2, sensor), np.linspace(0.0, furthest, 60)[1:]
    std = [math.sqrt(error_m.var(axis=0, ddof=1).mean()) for error_m in errors]
    offset_m = sensor.range_offset_m + float(sensor.zone_offsets[bench.alive].mean())
    label, degrees = f"albedo {albedo:g}", n - int(bench.alive.sum())
    yield bench.series(
        "range_noise", label, ("distance_m", "range_std_m"),
        (distances, true_std, std, true_std / math.sqrt(2 * degrees), True),
        (curve, direct_range_std(albedo / curve**2, sensor)),
    )  # fmt: skip
    yield bench.series(
        "linearity", label, ("range_m", "mean_range_error_m"),
        (distances, offset_m, [error_m.mean() for error_m in errors], true_std / math.sqrt(n), True),
        ([0.0, furthest], [offset_m, offset_m]),
    )  # fmt: skip


def _dropout_distance_m(sensor: Sensor, albedo: float) -> float:
    by_light = math.sqrt(albedo / sensor.min_intensity) if sensor.min_intensity > 0 else math.inf
    return min(by_light, math.inf if sensor.max_range_m is None else sensor.max_range_m)


def _dropout(bench: Bench, albedo: float) -> Iterator[Row]:
    """Measure where a direct sensor drops out, a step."""
    edge = _dropout_distance_m(bench.sensor, albedo)
    if not math.isfinite(edge):
        yield f"Albedo {albedo:g} never drops out."
        return
    points = _step(
        bench, ("threshold", f"albedo {albedo:g}", ("distance_m", "no_return_share")),
        edge * (1 + np.array([-0.02, -0.01, -1e-3, 1e-3, 0.01, 0.02])), edge,
        lambda d: bench.flagged(bench.frames(d, albedo / d**2), Flag.NO_RETURN),
    )  # fmt: skip
    yield points
    title = f"distance at which it drops out, albedo {albedo:g} (m)"
    yield crossing_of(points, 0.5, edge, f"threshold_distance_albedo_{albedo:g}_m", title)


def _step(
    bench: Bench,
    head: tuple[str, str, tuple[str, str]],
    x: Floats,
    edge: float,
    share: Callable[[float], float],
    samples: int | None = None,
) -> Comparison:
    """Return a share beside a predicted step from 0 to 1, which is drawn and not compared."""
    columns = (x, x > edge, [share(at) for at in x], 0.0, False)
    return bench.series(*head, columns, ([x[0], edge, edge, x[-1]], [0, 0, 1, 1]), samples=samples)


def _reference_m(sensor: Sensor) -> float:
    """Return a distance well inside the histogram, 1 m where that is."""
    histogram = histogram_of(sensor)
    return min(1.0, 0.5 * (histogram.start_m + histogram.length_m))


def _counts(bench: Bench) -> Iterator[Row]:
    """Measure the mean counts of the zones in the middle and in the corner before a plane."""
    sensor, distance_m, n = bench.sensor, _reference_m(bench.sensor), bench.n_frames
    axis = range_axis(sensor)
    light = zone_transients(plane_samples(distance_m, footprint_grid(sensor)), sensor, axis)
    expected = expected_counts(light, sensor, axis, ALBEDOS[-1])
    total = np.zeros(expected.shape[1:])
    for start in range(0, n, _FRAMES_AT_ONCE):
        total += bench.histograms(expected, min(_FRAMES_AT_ONCE, n - start)).zone_counts[0]
    predicted = plane_counts(sensor, distance_m, ALBEDOS[-1])
    integral = 3e-4  # error of the simulation's integral over soft zones, of the highest bin; 1e-3 is the bar
    error = np.hypot(np.sqrt(predicted / n), integral * predicted.max(axis=1, keepdims=True))
    histogram = histogram_of(sensor)
    edges = np.asarray(histogram.start_m + histogram.bin_width_m * np.arange(histogram.bins + 1), np.float64)
    shown = min(int(np.searchsorted(edges, _SHOWN * distance_m)), histogram.bins)
    alive = np.flatnonzero(bench.alive.ravel())
    middle = (sensor.rows // 2) * sensor.cols + sensor.cols // 2
    least_counts = 25.0  # all frames together, for the mean of a bin to be near to normal
    for zone in dict.fromkeys((int(alive[np.abs(alive - middle).argmin()]), int(alive[0]))):
        law, found = predicted[zone, :shown], total[zone, :shown] / n
        yield bench.series(
            "histogram", f"zone {divmod(zone, sensor.cols)}", ("range_m", "counts"),
            (0.5 * (edges[1:] + edges[:-1])[:shown], law, found, error[zone, :shown], law * n > least_counts),
            (np.repeat(edges[: shown + 1], 2)[1:-1], np.repeat(law, 2)), samples=n,
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


def _targets_near(
    bench: Bench, sensor: Sensor, expected: Floats, n: int, range_m: Floats, width_m: float
) -> NDArray[np.int64]:
    """Return how many valid targets the working zones report near a range of each view, (views, frames, zones)."""
    found = bench.histograms(expected, n, sensor).targets
    by_range = histogram_of(sensor).reports != "z"
    ranges_m = found.distance_m if by_range else found.distance_m / sensor.axis_cosine()[..., None]
    near = (np.abs(ranges_m - range_m[:, None, None, None, None]) < width_m) & (found.status == Status.VALID)
    return np.asarray(near.sum(axis=-1)[..., bench.alive])


def _merging(bench: Bench) -> Iterator[Row]:
    """Measure the share of frames in which two equal targets are two, against their separation."""
    sensor = bench.sensor
    histogram = histogram_of(sensor)
    if histogram.max_targets < 2:
        yield "Its chip reports one target a zone: there is no merging distance to measure."
        return
    limit_m = merging_distance_m(sensor)
    centre_m = max(_reference_m(sensor), 0.9 * limit_m)
    phases = 4  # places within a bin
    centres_m = centre_m + histogram.bin_width_m * np.arange(phases) / phases
    n = max(1, math.ceil(_READINGS / (phases * sensor.rows * sensor.cols)))

    def two_share(separation: float) -> float:
        ranges_m = centres_m[:, None] + separation * np.array([-0.5, 0.5])
        expected = _seen_ranges(sensor, ranges_m, np.full(ranges_m.shape, 0.5 * ALBEDOS[-1] / centre_m**2))
        return float((_targets_near(bench, sensor, expected, n, centres_m, limit_m) >= 2).mean())

    points = _step(
        bench, ("merging", "two equal targets", ("separation_m", "two_targets_share")),
        limit_m * np.linspace(0.4, 1.6, 29), limit_m, two_share, n * phases * int(bench.alive.sum()),
    )  # fmt: skip
    yield points
    title = "separation from which two equal targets are two (m)"
    # a place between bins decides
    yield crossing_of(points, 0.5, limit_m, "merging_distance_m", title, place_std=histogram.bin_width_m / 2)


def _ambient(bench: Bench, albedo: float) -> Iterator[Row]:
    """Measure the distance at which half of the frames find a surface, against ambient light."""
    sensor = bench.sensor
    histogram = histogram_of(sensor)
    least_ambient = 1e-7
    own = max(histogram.ambient, least_ambient)
    n = max(1, math.ceil(_READINGS / (sensor.rows * sensor.cols)))
    samples = n * int(bench.alive.sum())
    rows: list[tuple[float, float, float, float, bool]] = []
    # share of the cycles that ambient light may fire; with more, pile-up tilts the level that the chip takes for even
    most_ambient = 0.15
    for ambient in (own * factor for factor in _AMBIENT_FACTORS):
        if ambient * histogram.bins > most_ambient:
            break
        lit = sensor.with_(histogram={**histogram.model_dump(), "ambient": ambient})
        half_m = _half_found_m(lit, albedo)
        if half_m is None:
            continue
        distances = half_m * _AROUND
        expected = _seen_ranges(lit, distances[:, None], (albedo / distances**2)[:, None])
        near = _targets_near(bench, lit, expected, n, distances, 4 * response_std_m(sensor))
        law = np.array([_share_found(lit, d, albedo) for d in distances])
        predicted, simulated = _half_crossing(distances, law), _half_crossing(distances, (near > 0).mean(axis=(1, 2)))
        slope = abs(float(np.interp(predicted, distances, np.gradient(law, distances))))
        if math.isfinite(simulated) and math.isfinite(predicted):
            rows.append((ambient, predicted, simulated, 0.5 / math.sqrt(samples) / max(slope, 1e-9), False))
    if not rows:
        yield f"Albedo {albedo:g} is found up to the end of the histogram, or ambient light hides it."
        return
    yield bench.series(
        "ambient", f"albedo {albedo:g}", ("ambient_photons", "half_found_m"), zip(*rows, strict=True), samples=samples
    )
    title = f"distance at which half of the frames find albedo {albedo:g} (m)"
    for ambient, predicted, simulated, error, _ in rows:
        if np.isclose(ambient, own):
            yield SheetQuantity(f"half_found_albedo_{albedo:g}_m", title, predicted, simulated, error, samples)


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


def _half_crossing(distances: Floats, share: Floats) -> float:
    """Return where a falling share passes a half, between two points."""
    below = np.flatnonzero(share < 0.5)
    if not below.size or below[0] == 0:
        return math.nan
    k = int(below[0])
    return float(np.interp(0.5, share[[k, k - 1]], distances[[k, k - 1]]))
