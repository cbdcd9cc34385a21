"""Shares of flagged frames: saturation against signal, and the amplitude threshold against distance."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy import special

from phasemark.render.bench.data_sheet.bench import ALBEDOS, FURTHEST_M, NEAREST_M, Bench, Part
from phasemark.render.bench.data_sheet.results import Comparison, Floats, SheetQuantity
from phasemark.render.bench.flat_field import ExpectedFlatField, expected_flat_field
from phasemark.render.frames import Flag

_FLAGS_BEGIN = 0.01  # share of the frames


def saturation(bench: Bench) -> Part:
    """Measure the share of saturated frames against signal."""
    sensor = bench.open
    if not math.isfinite(sensor.saturation_e):
        return Part(notes=("It has neither full well nor converter, so no signal saturates it.",))

    def predicted_share(signal_e: float) -> float:
        expected = expected_flat_field(sensor, bench.reference_range_m, signal_e / sensor.signal_e)
        return bench.mean(expected.saturation_probability)

    top = 8 * sensor.saturation_e
    low, high = (crossing(predicted_share, share, 0.0, top) for share in (1e-3, 1 - 1e-3))
    margin = 0.05 * (high - low) + 1e-3 * high
    signals = np.linspace(low - margin, high + margin, 17)
    line = np.linspace(low - 3 * margin, high + 3 * margin, 60)
    shares, errors, predicted = [], [], []
    for signal_e in signals:
        frames = bench.frames(bench.reference_range_m, signal_e / sensor.signal_e)
        flagged = (frames.flags[0] & int(Flag.SATURATED) > 0)[:, bench.alive]
        expected = expected_flat_field(sensor, bench.reference_range_m, signal_e / sensor.signal_e)
        probability = expected.saturation_probability[bench.alive]
        shares.append(flagged.mean())
        predicted.append(probability.mean())
        errors.append(math.sqrt((probability * (1 - probability)).mean() / bench.samples))
    error = np.array(errors)
    share, expectation = np.array(shares), np.array(predicted)
    # a share is near enough to normal for χ² where ten frames and more are on either side
    compared = (error > 0) & (np.minimum(expectation, 1 - expectation) * bench.samples >= 10)
    points = Comparison(
        "saturation", f"range {bench.reference_range_m:g} m", "signal_e", "flagged_share",
        signals, expectation, share, error, np.full(len(signals), bench.samples), compared,
        line, np.array([predicted_share(s) for s in line]),
    )  # fmt: skip
    quantities = []
    for name, words, at in (("begin", "1 % of frames are", _FLAGS_BEGIN), ("half", "half of the frames are", 0.5)):
        true_signal = crossing(predicted_share, at, 0.0, top)
        signal, signal_error = found_beside(points, at, true_signal)
        quantities.append(
            SheetQuantity(f"saturation_flags_{name}_e", f"signal at which {words} flagged as saturated (e-)",
                          true_signal, signal, signal_error, bench.samples * len(signals))
        )  # fmt: skip
    return Part((points,), tuple(quantities))


def threshold(bench: Bench, albedo: float) -> Part:
    """Measure the share of frames without return, about the distance at which it is one half."""
    sensor = bench.sensor
    name = f"threshold_distance_albedo_{albedo:g}_m"
    title = f"distance at which half of the frames show no return, albedo {albedo:g} (m)"
    if sensor.max_phase_std_rad is None and sensor.min_amplitude_e == 0:
        note = "It has no amplitude threshold: whatever returns any light is valid."
        return Part(notes=(note,) if albedo == ALBEDOS[0] else ())

    def lost_share(distance_m: float) -> float:
        expected = expected_flat_field(sensor, distance_m, albedo / distance_m**2)
        return bench.mean(1 - _return_probability(expected))

    middle = crossing(lost_share, 0.5, NEAREST_M, FURTHEST_M)
    if not NEAREST_M * 1.1 < middle < FURTHEST_M / 1.1:
        return Part(notes=(f"The amplitude threshold does not end the range of albedo {albedo:g} within 100 m.",))
    low, high = (crossing(lost_share, share, NEAREST_M, FURTHEST_M) for share in (0.05, 0.95))
    margin = 0.1 * (high - low) + 1e-3 * middle
    distances = np.linspace(low - margin, high + margin, 11)
    watched = sensor.with_(wrap_guard_m=0.0)
    shares, predicted, errors = [], [], []
    for distance in distances:
        frames = bench.frames(distance, albedo / distance**2, watched)
        lost = (frames.flags[0] & int(Flag.NO_RETURN) > 0)[:, bench.alive]
        probability = lost_share(distance)
        shares.append(lost.mean())
        predicted.append(probability)
        errors.append(math.sqrt(max(probability * (1 - probability), 0.0) / bench.samples))
    points = Comparison(
        "threshold", f"albedo {albedo:g}", "distance_m", "no_return_share",
        distances, np.array(predicted), np.array(shares), np.array(errors), np.full(len(distances), bench.samples),
        np.zeros(len(distances), np.bool_), distances, np.array(predicted),
    )  # fmt: skip
    found, found_error = found_beside(points, 0.5, middle)
    return Part((points,), (SheetQuantity(name, title, middle, found, found_error, bench.samples * len(distances)),))


def _return_probability(expected: ExpectedFlatField) -> Floats:
    """Return the probability that a pixel passes the amplitude threshold: Rice's distribution of its amplitude.

    The threshold itself, which follows the measured intensity, is taken at its mean. That moves the distance of one
    half by less than 1e-3 and flattens or steepens the step, so the step's shape is drawn and not compared.
    """
    sensor, variance = expected.sensor, expected.component_variance_e2
    limit = np.full(variance.shape, sensor.min_amplitude_e)
    if sensor.max_phase_std_rad is not None:
        limit = np.maximum(limit, np.sqrt(variance) / sensor.max_phase_std_rad)
    amplitude = np.abs(expected.phasor_e)
    noisy = variance > 0
    scale = np.where(noisy, variance, 1.0)
    passed = 1 - special.chndtr(limit**2 / scale, 2, amplitude**2 / scale)
    return np.where(noisy, passed, amplitude >= limit)


def crossing(function: Callable[[float], float], level: float, low: float, high: float) -> float:
    """Return where a function that rises from `low` to `high` reaches a level, by bisection: it may jump."""
    for _ in range(32):
        middle = 0.5 * (low + high)
        if function(middle) < level:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def found_beside(points: Comparison, level: float, true_x: float) -> tuple[float, float]:
    """Return where the simulated share crosses a level, and its standard error.

    The predicted points, interpolated alike, miss the true place by what the interpolation is wrong: subtracted.
    """
    found, error = _interpolated(points.x, points.simulated, points.std_error, level)
    return found + true_x - _interpolated(points.x, points.predicted, points.std_error, level)[0], error


def _interpolated(x: Floats, share: Floats, error: Floats, level: float) -> tuple[float, float]:
    """Return where a rising share first crosses a level, between two points, and its standard error.

    Between the points the share rises like the normal distribution; where one of them is 0 or 1, it is a step.
    """
    above = np.flatnonzero(share >= level)
    if not above.size or above[0] == 0:
        return math.nan, math.nan
    j = int(above[0])
    step = float(x[j] - x[j - 1])
    if share[j - 1] == 0 or share[j] == 1:
        return float(x[j] + x[j - 1]) / 2, step / 2
    left, right, at = (float(special.ndtri(value)) for value in (share[j - 1], share[j], level))
    slope = (right - left) / step * math.exp(-(at**2) / 2) / math.sqrt(2 * math.pi)
    return float(x[j - 1]) + (at - left) / (right - left) * step, max(float(error[j - 1]), float(error[j])) / slope
