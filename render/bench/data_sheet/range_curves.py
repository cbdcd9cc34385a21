"""Ranges against distance: the noise of one frame, and the error of the mean."""

from __future__ import annotations

import math

import numpy as np

from phasemark.render.bench.data_sheet.bench import FURTHEST_M, NEAREST_M, Bench, Part
from phasemark.render.bench.data_sheet.results import Comparison, SheetQuantity
from phasemark.render.bench.flat_field import ExpectedFlatField, expected_flat_field
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.sensor.range_noise import exact_phase_moments, predicted_range_std

_LARGEST_PHASE_STD_RAD = 0.15  # beyond, counts of electrons are so few that no Gaussian density is exact
_LINEARITY_SPAN = 1.5  # unambiguous ranges
_LINEARITY_POINTS = 53  # prime: every period of an error is met at other phases


def range_noise(bench: Bench, albedo: float) -> Part:
    """Measure the range σ of one frame against distance, of a surface that faces the camera."""
    sensor = bench.open
    line = np.geomspace(NEAREST_M, min(FURTHEST_M, sensor.unambiguous_range_m), 80)
    law = predicted_range_std(albedo / line**2, albedo / line**2, sensor)
    curve = [expected_flat_field(sensor, d, albedo / d**2) for d in line]
    predicted_curve = np.array([math.sqrt(bench.mean(one.range_variance_m2)) for one in curve])
    good = law <= _LARGEST_PHASE_STD_RAD * sensor.metres_per_radian
    clear = good & [one.clear_of_limits for one in curve]
    if not clear.any():
        return Part(notes=(f"Range noise on albedo {albedo:g} has no distance where nothing clips and the law holds.",))
    places = np.unique(np.linspace(0, clear.sum() - 1, 14).round().astype(int))
    distances = line[clear][places]
    predicted, found, errors = [], [], []
    for distance in distances:
        expected = expected_flat_field(sensor, distance, albedo / distance**2)
        error_m = bench.range_errors(bench.frames(distance, albedo / distance**2), expected.range_m)
        variance = expected.range_variance_m2[bench.alive]
        kurtosis = exact_phase_moments(expected.law_phase_std_rad[bench.alive])[1]
        n = bench.n_frames
        of_variance = variance**2 * ((kurtosis - 3) / n + 2 / (n - 1))
        std = math.sqrt(variance.mean())
        predicted.append(std)
        found.append(math.sqrt(error_m.var(axis=0, ddof=1).mean()))
        errors.append(math.sqrt(of_variance.sum()) / variance.size / (2 * std) if std > 0 else 0.0)
    points = Comparison(
        "range_noise", f"albedo {albedo:g}", "distance_m", "range_std_m",
        distances, np.array(predicted), np.array(found), np.array(errors),
        np.full(len(distances), bench.samples), np.array(errors) > 0, line, predicted_curve, law,
    )  # fmt: skip
    return Part((points,))


def linearity(bench: Bench) -> Part:
    """Measure the error of the mean range along a delay line, light held constant, beyond the wrap as well."""
    sensor, amplitude = bench.open, bench.safe_amplitude
    span = _LINEARITY_SPAN * sensor.unambiguous_range_m

    def error_curve(range_m: float) -> tuple[float, ExpectedFlatField]:
        expected = expected_flat_field(sensor, range_m, amplitude)
        return bench.mean(wrap_difference_m(expected.range_m - range_m, sensor)), expected

    line = np.linspace(0.0, span, 361)
    curve = np.array([error_curve(d)[0] for d in line])
    ranges = span * (np.arange(_LINEARITY_POINTS) + 0.5) / _LINEARITY_POINTS
    predicted, found, errors, clear = [], [], [], []
    for range_m in ranges:
        mean, expected = error_curve(range_m)
        frames = bench.frames(range_m, amplitude)
        measured = bench.range_errors(frames, expected.range_m).mean() + bench.mean(
            wrap_difference_m(expected.range_m - range_m, sensor)
        )
        predicted.append(mean)
        found.append(float(measured))
        errors.append(math.sqrt(bench.mean(expected.range_variance_m2) / bench.samples))
        clear.append(expected.clear_of_limits)
    error = np.array(errors)
    points = Comparison(
        "linearity", f"light of intensity {amplitude:.3g}", "range_m", "mean_range_error_m",
        ranges, np.array(predicted), np.array(found), error, np.full(len(ranges), bench.samples),
        (error > 0) & clear, line, curve,
    )  # fmt: skip
    # Between the points where the prediction is extreme: the noise's own extremes would always add to it.
    top, bottom = int(points.predicted.argmax()), int(points.predicted.argmin())
    wiggling = SheetQuantity(
        "wiggling_peak_to_peak_m", "error of the mean range, largest less smallest predicted point (m)",
        float(points.predicted[top] - points.predicted[bottom]),
        float(points.simulated[top] - points.simulated[bottom]),
        math.hypot(error[top], error[bottom]), 2 * bench.samples,
    )  # fmt: skip
    return Part((points,), (wiggling,))
