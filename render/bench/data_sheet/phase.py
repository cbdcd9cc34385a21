"""The data sheet of a camera with taps: photon transfer, noise, linearity, patterns, saturation and threshold."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from scipy import special

from phasemark.render.bench.data_sheet.bench import (
    ALBEDOS,
    FURTHEST_M,
    NEAREST_M,
    Bench,
    Row,
    crossing,
    crossing_of,
)
from phasemark.render.bench.data_sheet.results import Comparison, Floats, SheetQuantity
from phasemark.render.bench.flat_field import ExpectedFlatField, expected_flat_field
from phasemark.render.bench.least_squares import weighted_fit
from phasemark.render.frames import Flag, Frames
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.sensor.range_noise import exact_phase_moments, predicted_range_std


def phase_rows(bench: Bench) -> Iterator[Row]:
    """Measure everything that the data sheet of a camera with taps has."""
    yield from _photon_transfer(bench)
    for albedo in ALBEDOS:
        yield from _range_noise(bench, albedo)
    yield from _linearity(bench)
    yield from _patterns(bench)
    yield from _saturation(bench)
    for albedo in ALBEDOS:
        yield from _threshold(bench, albedo)


def _photon_transfer(bench: Bench) -> Iterator[Row]:
    """Measure the taps' variance against their mean, in codes (electrons without a converter), no ambient light."""
    sensor, n = bench.open.with_(ambient_e=0.0), bench.n_frames
    per_e, unit = (sensor.gain, "code") if sensor.adc_bits is not None else (1.0, "e")
    saturates = math.isfinite(sensor.saturation_e)
    full = sensor.saturation_e if saturates else 4 * sensor.signal_e
    shares = np.concatenate([[0.0], np.geomspace(1e-3, 1.0, 12), [1.03, 1.1] if saturates else []])

    def point(level: float) -> tuple[float, ...]:
        taps = bench.steady_taps(level, sensor) * per_e
        expected = expected_flat_field(sensor, bench.reference_range_m, level, modulated=False)
        variance = expected.tap_variance_e2[..., bench.alive]
        fourth = (expected.tap_e[..., bench.alive] if sensor.shot_noise else 0.0) - sensor.code_e**4 / 120
        error = math.sqrt((2 * variance**2 / (n - 1) + fourth / n).sum()) / variance.size * per_e**2
        found = taps.var(axis=0, ddof=1).mean()
        return taps.mean(), variance.mean() * per_e**2, found, error, expected.clear_of_limits

    columns = [np.array(one) for one in zip(*map(point, shares * 2 * full / sensor.signal_e), strict=True)]
    shot = per_e if sensor.shot_noise else 0.0
    floor = sensor.read_noise_e**2 + sensor.code_e**2 / 12
    line = np.concatenate([[0.0], np.geomspace(columns[0][columns[0] > 0].min(), full * per_e, 60)])
    points = bench.series(
        "photon_transfer", "steady light, ambient light off", (f"mean_{unit}", f"variance_{unit}2"), columns,
        (line, shot * line + floor * per_e**2), samples=8 * bench.samples,
    )  # fmt: skip
    yield points
    emva_linear_share = 0.7  # of saturation: EMVA 1288's range for the photon-transfer fit
    linear = points.compared & (points.x <= emva_linear_share * full * per_e)
    if linear.sum() < 3:
        yield "Without noise that a converter can see there is no photon transfer to fit."
        return
    mean, samples = points.x[linear], int(points.samples[linear].sum())
    (slope, offset), covariance = weighted_fit(
        np.column_stack([mean, np.ones_like(mean)]), points.simulated[linear], points.std_error[linear]
    )
    slope_error, offset_error = np.sqrt(np.diag(covariance)).tolist()
    yield SheetQuantity(f"photon_transfer_slope_{unit}", f"photon-transfer slope ({unit}²/{unit})", shot, float(slope),
                        slope_error, samples)  # fmt: skip
    noise = math.sqrt(max(offset, 0.0)) / per_e
    # the root of a variance that is compatible with 0 has the error of √(its error)
    noise_error = min(offset_error / (2 * noise * per_e**2) if noise > 0 else math.inf, math.sqrt(offset_error) / per_e)
    title = "noise floor of a tap, read noise and quantisation (e-)"
    yield SheetQuantity("dark_noise_e", title, math.sqrt(floor), noise, noise_error, samples)


def _range_noise(bench: Bench, albedo: float) -> Iterator[Row]:
    """Measure the range σ of one frame against distance, of a surface that faces the camera."""
    sensor, n = bench.open, bench.n_frames
    line = np.geomspace(NEAREST_M, min(FURTHEST_M, sensor.unambiguous_range_m), 80)
    law = predicted_range_std(albedo / line**2, albedo / line**2, sensor)
    expected = [expected_flat_field(sensor, d, albedo / d**2) for d in line]
    curve = [math.sqrt(bench.mean(one.range_variance_m2)) for one in expected]
    largest_phase_std_rad = 0.15  # beyond, counts of electrons are so few that no Gaussian density is exact
    clear = (law <= largest_phase_std_rad * sensor.metres_per_radian) & [one.clear_of_limits for one in expected]
    if not clear.any():
        yield f"Range noise on albedo {albedo:g} has no distance where nothing clips and the law holds."
        return

    def point(place: int) -> tuple[float, ...]:
        distance = line[place]
        error_m = bench.range_errors(bench.frames(distance, albedo / distance**2), expected[place].range_m)
        variance = expected[place].range_variance_m2[bench.alive]
        kurtosis = exact_phase_moments(expected[place].law_phase_std_rad[bench.alive])[1]
        of_variance = variance**2 * ((kurtosis - 3) / n + 2 / (n - 1))
        std = math.sqrt(variance.mean())
        error = math.sqrt(of_variance.sum()) / variance.size / (2 * std) if std > 0 else 0.0
        return distance, std, math.sqrt(error_m.var(axis=0, ddof=1).mean()), error, True

    places = np.flatnonzero(clear)[np.unique(np.linspace(0, clear.sum() - 1, 14).round().astype(int))]
    yield bench.series(
        "range_noise", f"albedo {albedo:g}", ("distance_m", "range_std_m"), zip(*map(point, places), strict=True),
        (line, curve), law=law,
    )  # fmt: skip


def _linearity(bench: Bench) -> Iterator[Row]:
    """Measure the error of the mean range along a delay line, light held constant, beyond the wrap as well."""
    sensor, amplitude = bench.open, bench.safe_amplitude
    linearity_span = 1.5  # unambiguous ranges
    span = linearity_span * sensor.unambiguous_range_m

    def mean_error(range_m: float, expected: ExpectedFlatField) -> float:
        return bench.mean(wrap_difference_m(expected.range_m - range_m, sensor))

    def point(range_m: float) -> tuple[float, ...]:
        expected = expected_flat_field(sensor, range_m, amplitude)
        mean = mean_error(range_m, expected)
        found = bench.range_errors(bench.frames(range_m, amplitude), expected.range_m).mean() + mean
        error = math.sqrt(bench.mean(expected.range_variance_m2) / bench.samples)
        return range_m, mean, found, error, expected.clear_of_limits

    line = np.linspace(0.0, span, 361)
    linearity_points = 53  # prime: every period of an error is met at other phases
    ranges = span * (np.arange(linearity_points) + 0.5) / linearity_points
    points = bench.series(
        "linearity", f"light of intensity {amplitude:.3g}", ("range_m", "mean_range_error_m"),
        zip(*map(point, ranges), strict=True),
        (line, [mean_error(d, expected_flat_field(sensor, d, amplitude)) for d in line]),
    )  # fmt: skip
    yield points
    # Between the points where the prediction is extreme: the noise's own extremes would always add to it.
    top, bottom = int(points.predicted.argmax()), int(points.predicted.argmin())
    yield SheetQuantity(
        "wiggling_peak_to_peak_m", "error of the mean range, largest less smallest predicted point (m)",
        float(points.predicted[top] - points.predicted[bottom]),
        float(points.simulated[top] - points.simulated[bottom]),
        math.hypot(points.std_error[top], points.std_error[bottom]), 2 * bench.samples,
    )  # fmt: skip


def _patterns(bench: Bench) -> Iterator[Row]:
    """Measure what stays from frame to frame: range offset, sensitivity and dark signal of every pixel."""
    sensor, amplitude, n = bench.open, bench.safe_amplitude, bench.n_frames
    where = bench.reference_range_m
    expected = expected_flat_field(sensor, where, amplitude)
    truth = wrap_difference_m(expected.range_m - where, sensor)[bench.alive]
    offset = bench.range_errors(bench.frames(where, amplitude), expected.range_m).mean(axis=0) + truth
    error = np.sqrt(expected.range_variance_m2[bench.alive] / n)
    yield bench.series(
        "fixed_pattern", f"pixels at {where:g} m", ("pixel", "range_offset_m"),
        (np.arange(len(offset)), truth, offset, error, expected.clear_of_limits), samples=n,
    )  # fmt: skip
    unlit = sensor.with_(ambient_e=0.0)

    def steady(level: float) -> tuple[Floats, Floats, float]:
        """Return the taps' mean, its prediction, and the variance of the mean."""
        expected = expected_flat_field(unlit, where, level, modulated=False)
        variance = expected.tap_variance_e2[..., bench.alive].mean() / (4 * n)
        return bench.steady_taps(level, unlit).mean(axis=(0, 1)), expected.tap_e[0][..., bench.alive], variance

    half = sensor.saturation_e if math.isfinite(sensor.saturation_e) else sensor.signal_e  # of a tap
    (dark, true_dark, dark_noise), (bright, true_bright, bright_noise) = map(steady, (0.0, half / sensor.signal_e))
    rise, true_rise = bright - dark, true_bright - true_dark
    step = float(rise.mean())
    for name, title, true, found, noise, scale, readings in (
        ("fixed_pattern_range_std_m", "range offset from pixel to pixel, standard deviation (m)", truth, offset,
         float((error**2).mean()), 1.0, 1),
        ("prnu_percent", "PRNU with the shading of stray light, standard deviation over taps (%)",
         true_rise / float(true_rise.mean()), rise / step, (bright_noise + dark_noise) / step**2, 100.0, 16),
        ("dsnu_e", "DSNU, standard deviation over taps (e-)", true_dark, dark, dark_noise, 1.0, 8),
    ):  # fmt: skip
        std, std_error = _spatial_std(found, noise)
        true_std = _spatial_std(true, 0.0)[0]
        yield SheetQuantity(name, title, scale * true_std, scale * std, scale * std_error, readings * bench.samples)
    images = {
        "range_offset_m": offset,
        "response_percent": 100 * (rise.mean(axis=0) / step - 1),
        "dark_e": dark.mean(axis=0),
    }
    maps = {name: np.full(bench.alive.shape, np.nan) for name in images}
    for name, values in images.items():
        maps[name][bench.alive] = values
    yield maps


def _spatial_std(values: Floats, noise_variance: float) -> tuple[float, float]:
    """Return the standard deviation of a pattern and its standard error, the noise of its values subtracted."""
    m = values.size
    variance = max(float(values.var(ddof=1)) - noise_variance, 0.0) if m > 1 else 0.0
    if variance <= noise_variance:  # near none, the root of a variance has the error of √(the variance's error)
        return math.sqrt(variance), math.sqrt(noise_variance) * (2 / max(m - 1, 1)) ** 0.25
    of_variance = (4 * variance * noise_variance + 2 * noise_variance**2) / m
    return math.sqrt(variance), math.sqrt(of_variance) / (2 * math.sqrt(variance))


def _saturation(bench: Bench) -> Iterator[Row]:
    """Measure the share of saturated frames against signal."""
    sensor, where = bench.open, bench.reference_range_m
    if not math.isfinite(sensor.saturation_e):
        yield "It has neither full well nor converter, so no signal saturates it."
        return

    def probability(signal_e: float) -> Floats:
        return expected_flat_field(sensor, where, signal_e / sensor.signal_e).saturation_probability[bench.alive]

    def signal_of(share: float) -> float:
        return crossing(lambda signal_e: float(probability(signal_e).mean()), share, 0.0, 8 * sensor.saturation_e)

    low, high = signal_of(1e-3), signal_of(1 - 1e-3)
    margin = 0.05 * (high - low) + 1e-3 * high
    line = np.linspace(low - 3 * margin, high + 3 * margin, 60)
    points = _flagged_share(
        bench, ("saturation", f"range {where:g} m", ("signal_e", "flagged_share")),
        np.linspace(low - margin, high + margin, 17), Flag.SATURATED,
        lambda signal_e: bench.frames(where, signal_e / sensor.signal_e), probability,
        (line, np.array([probability(signal_e).mean() for signal_e in line])),
    )  # fmt: skip
    yield points
    flags_begin = 0.01  # share of the frames
    for name, words, at in (("begin", "1 % of frames are", flags_begin), ("half", "half of the frames are", 0.5)):
        title = f"signal at which {words} flagged as saturated (e-)"
        yield crossing_of(points, at, signal_of(at), f"saturation_flags_{name}_e", title)


def _threshold(bench: Bench, albedo: float) -> Iterator[Row]:
    """Measure the share of frames without return, about the distance at which it is one half."""
    sensor = bench.sensor
    if sensor.max_phase_std_rad is None and sensor.min_amplitude_e == 0:
        if albedo == ALBEDOS[0]:
            yield "It has no amplitude threshold: whatever returns any light is valid."
        return

    def lost_share(distance_m: float) -> float:
        return bench.mean(1 - _return_probability(expected_flat_field(sensor, distance_m, albedo / distance_m**2)))

    low, middle, high = (crossing(lost_share, share, NEAREST_M, FURTHEST_M) for share in (0.05, 0.5, 0.95))
    if not NEAREST_M * 1.1 < middle < FURTHEST_M / 1.1:
        yield f"The amplitude threshold does not end the range of albedo {albedo:g} within 100 m."
        return
    margin = 0.1 * (high - low) + 1e-3 * middle
    watched = sensor.with_(wrap_guard_m=0.0)
    points = _flagged_share(
        bench, ("threshold", f"albedo {albedo:g}", ("distance_m", "no_return_share")),
        np.linspace(low - margin, high + margin, 11), Flag.NO_RETURN,
        lambda distance: bench.frames(distance, albedo / distance**2, watched), lost_share,
    )  # fmt: skip
    yield points
    title = f"distance at which half of the frames show no return, albedo {albedo:g} (m)"
    yield crossing_of(points, 0.5, middle, f"threshold_distance_albedo_{albedo:g}_m", title)


def _flagged_share(
    bench: Bench,
    head: tuple[str, str, tuple[str, str]],
    x: Floats,
    flag: Flag,
    take: Callable[[float], Frames],
    probability: Callable[[float], Floats | float],
    curve: tuple[Floats, Floats] | None = None,
) -> Comparison:
    """Return the share of flagged frames beside its probability, compared if there is a curve of the prediction."""
    fewest_flagged = 10  # frames on either side of a share: more are near enough to normal for χ²

    def point(at: float) -> tuple[float, ...]:
        expected = np.asarray(probability(at))
        share, spread = float(expected.mean()), float((expected * (1 - expected)).mean())
        enough = curve is not None and min(share, 1 - share) * bench.samples >= fewest_flagged
        return at, share, bench.flagged(take(at), flag), math.sqrt(max(spread, 0.0) / bench.samples), enough

    return bench.series(*head, zip(*map(point, x), strict=True), curve)


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
