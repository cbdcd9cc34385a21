"""The data sheet of a direct time-of-flight sensor: its range, where it drops out, and its histograms."""

from __future__ import annotations

import math

import numpy as np

from phasemark.render.bench.data_sheet.bench import ALBEDOS, NEAREST_M, Bench, Part
from phasemark.render.bench.data_sheet.flagged_shares import found_beside
from phasemark.render.bench.data_sheet.histograms import histogram_parts
from phasemark.render.bench.data_sheet.results import Comparison, SheetQuantity
from phasemark.render.frames import Flag
from phasemark.render.sensor.range_noise import direct_range_std
from phasemark.render.sensor.sensor import Sensor


def direct_parts(bench: Bench) -> list[Part]:
    """Measure all that the data sheet of a direct sensor has."""
    note = (
        "It is a direct time-of-flight sensor: photon transfer, saturation, wiggling and amplitude thresholds belong "
        "to taps and phases, which it does not have."
    )
    counted = histogram_parts(bench) if bench.sensor.histogram is not None else []
    return [_direct_range(bench), *(_dropout(bench, albedo) for albedo in ALBEDOS), *counted, Part(notes=(note,))]


def _direct_range(bench: Bench) -> Part:
    """Measure noise and mean error of the range, up to where it drops out on the brightest surface."""
    sensor = bench.sensor
    albedo = ALBEDOS[-1]
    furthest = min(_dropout_distance_m(sensor, albedo), 10.0)
    distances = np.linspace(NEAREST_M, 0.98 * furthest, 20)
    n, ends = bench.samples, np.array([0.0, furthest])
    mean, std = [], []
    for distance in distances:
        error_m = bench.range_errors(bench.frames(distance, albedo / distance**2), distance)
        mean.append(error_m.mean())
        std.append(math.sqrt(error_m.var(axis=0, ddof=1).mean()))
    true_std, samples = direct_range_std(albedo / distances**2, sensor), np.full(20, n)
    curve = np.linspace(0.0, furthest, 60)[1:]
    offset_m = sensor.range_offset_m + float(sensor.zone_offsets[bench.alive].mean())
    noisy = true_std > 0
    degrees = n - int(bench.alive.sum())
    label = f"albedo {albedo:g}"
    return Part(
        (
            Comparison("range_noise", label, "distance_m", "range_std_m", distances, true_std, np.array(std),
                       true_std / math.sqrt(2 * degrees), samples, noisy, curve,
                       direct_range_std(albedo / curve**2, sensor)),
            Comparison("linearity", label, "range_m", "mean_range_error_m", distances, np.full(20, offset_m),
                       np.array(mean), true_std / math.sqrt(n), samples, noisy, ends, np.full(2, offset_m)),
        )
    )  # fmt: skip


def _dropout_distance_m(sensor: Sensor, albedo: float) -> float:
    by_light = math.sqrt(albedo / sensor.min_intensity) if sensor.min_intensity > 0 else math.inf
    return min(by_light, math.inf if sensor.max_range_m is None else sensor.max_range_m)


def _dropout(bench: Bench, albedo: float) -> Part:
    """Measure where a direct sensor drops out, a step."""
    edge = _dropout_distance_m(bench.sensor, albedo)
    if not math.isfinite(edge):
        return Part(notes=(f"Albedo {albedo:g} never drops out.",))
    distances = edge * (1 + np.array([-0.02, -0.01, -1e-3, 1e-3, 0.01, 0.02]))
    share = np.array(
        [(bench.frames(d, albedo / d**2).flags[0] & int(Flag.NO_RETURN) > 0)[:, bench.alive].mean() for d in distances]
    )
    expected = (distances > edge).astype(np.float64)
    points = Comparison(
        "threshold", f"albedo {albedo:g}", "distance_m", "no_return_share",
        distances, expected, share, np.zeros(len(distances)), np.full(len(distances), bench.samples),
        np.zeros(len(distances), np.bool_), np.array([distances[0], edge, edge, distances[-1]]),
        np.array([0.0, 0.0, 1.0, 1.0]),
    )  # fmt: skip
    found, found_error = found_beside(points, 0.5, edge)
    name = f"threshold_distance_albedo_{albedo:g}_m"
    title = f"distance at which it drops out, albedo {albedo:g} (m)"
    return Part((points,), (SheetQuantity(name, title, edge, found, found_error, bench.samples * len(distances)),))
