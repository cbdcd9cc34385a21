"""Fixed patterns of a camera: range offset, sensitivity and dark signal of every pixel."""

from __future__ import annotations

import math

import numpy as np

from phasemark.render.bench.data_sheet.bench import Bench, Part
from phasemark.render.bench.data_sheet.results import Comparison, Floats, SheetQuantity
from phasemark.render.bench.flat_field import expected_flat_field
from phasemark.render.phasor_images import wrap_difference_m


def patterns(bench: Bench) -> Part:
    """Measure what stays from frame to frame: range offset, sensitivity and dark signal of every pixel."""
    sensor, amplitude, n = bench.open, bench.safe_amplitude, bench.n_frames
    where = bench.reference_range_m
    expected = expected_flat_field(sensor, where, amplitude)
    truth = wrap_difference_m(expected.range_m - where, sensor)[bench.alive]
    offset = bench.range_errors(bench.frames(where, amplitude), expected.range_m).mean(axis=0) + truth
    error = np.sqrt(expected.range_variance_m2[bench.alive] / n)
    index = np.arange(len(offset), dtype=np.float64)
    points = Comparison(
        "fixed_pattern", f"pixels at {where:g} m", "pixel", "range_offset_m",
        index, truth, offset, error, np.full(len(index), n), (error > 0) & expected.clear_of_limits, index, truth,
    )  # fmt: skip
    dark_sensor = sensor.with_(ambient_e=0.0)
    half = sensor.saturation_e if math.isfinite(sensor.saturation_e) else sensor.signal_e
    level = half / sensor.signal_e  # so that a tap is half full
    dark, bright = bench.steady_taps(0.0, dark_sensor), bench.steady_taps(level, dark_sensor)
    of_dark = expected_flat_field(dark_sensor, where, 0.0, modulated=False)
    of_bright = expected_flat_field(dark_sensor, where, level, modulated=False)
    dark_image, bright_image = dark.mean(axis=(0, 1)), bright.mean(axis=(0, 1))
    true_dark = of_dark.tap_e[0][..., bench.alive]
    true_bright = of_bright.tap_e[0][..., bench.alive]
    dark_noise = of_dark.tap_variance_e2[..., bench.alive].mean() / (4 * n)
    bright_noise = of_bright.tap_variance_e2[..., bench.alive].mean() / (4 * n)
    step, true_step = float((bright_image - dark_image).mean()), float((true_bright - true_dark).mean())
    dsnu, dsnu_error = _spatial_std(dark_image, dark_noise)
    prnu, prnu_error = _spatial_std((bright_image - dark_image) / step, (bright_noise + dark_noise) / step**2)
    range_std, range_std_error = _spatial_std(offset, float((error**2).mean()))
    quantities = (
        SheetQuantity("fixed_pattern_range_std_m", "range offset from pixel to pixel, standard deviation (m)",
                      _spatial_std(truth, 0.0)[0], range_std, range_std_error, bench.samples),
        SheetQuantity("prnu_percent", "PRNU with the shading of stray light, standard deviation over taps (%)",
                      100 * _spatial_std((true_bright - true_dark) / true_step, 0.0)[0], 100 * prnu, 100 * prnu_error,
                      16 * bench.samples),
        SheetQuantity("dsnu_e", "DSNU, standard deviation over taps (e-)",
                      _spatial_std(true_dark, 0.0)[0], dsnu, dsnu_error, 8 * bench.samples),
    )  # fmt: skip
    maps = {
        "range_offset_m": _image(offset, bench),
        "response_percent": _image(100 * ((bright_image - dark_image).mean(axis=0) / step - 1), bench),
        "dark_e": _image(dark_image.mean(axis=0), bench),
    }
    return Part((points,), quantities, maps)


def _spatial_std(values: Floats, noise_variance: float) -> tuple[float, float]:
    """Return the standard deviation of a pattern and its standard error, the noise of its values subtracted."""
    m = values.size
    variance = max(float(values.var(ddof=1)) - noise_variance, 0.0) if m > 1 else 0.0
    if variance <= noise_variance:  # near none, the root of a variance has the error of √(the variance's error)
        return math.sqrt(variance), math.sqrt(noise_variance) * (2 / max(m - 1, 1)) ** 0.25
    of_variance = (4 * variance * noise_variance + 2 * noise_variance**2) / m
    return math.sqrt(variance), math.sqrt(of_variance) / (2 * math.sqrt(variance))


def _image(values: Floats, bench: Bench) -> Floats:
    image = np.full(bench.alive.shape, np.nan)
    image[bench.alive] = values
    return image
