"""Photon transfer: the variance of the taps against their mean, as EMVA 1288 measures it."""

from __future__ import annotations

import math

import numpy as np

from phasemark.render.bench.data_sheet.bench import Bench, Part
from phasemark.render.bench.data_sheet.results import Comparison, Floats, SheetQuantity
from phasemark.render.bench.flat_field import expected_flat_field

_EMVA_LINEAR_SHARE = 0.7  # of saturation: EMVA 1288's range for the photon-transfer fit


def photon_transfer(bench: Bench) -> Part:
    """Measure the taps' variance against their mean, in codes (electrons without a converter), no ambient light."""
    sensor = bench.open.with_(ambient_e=0.0)
    per_e = sensor.gain if sensor.adc_bits is not None else 1.0
    unit = "code" if sensor.adc_bits is not None else "e"
    full = sensor.saturation_e if math.isfinite(sensor.saturation_e) else 4 * sensor.signal_e
    levels = np.concatenate([[0.0], np.geomspace(1e-3, 1.0, 12), [1.03, 1.1]]) * 2 * full / sensor.signal_e
    if not math.isfinite(sensor.saturation_e):
        levels = levels[:-2]
    x, found, predicted, errors, clear = [], [], [], [], []
    for level in levels:
        taps = bench.steady_taps(level, sensor) * per_e
        expected = expected_flat_field(sensor, bench.reference_range_m, level, modulated=False)
        variance = expected.tap_variance_e2[..., bench.alive]
        fourth = (expected.tap_e[..., bench.alive] if sensor.shot_noise else 0.0) - sensor.code_e**4 / 120
        n = bench.n_frames
        x.append(taps.mean())
        found.append(taps.var(axis=0, ddof=1).mean())
        predicted.append(variance.mean() * per_e**2)
        errors.append(math.sqrt((2 * variance**2 / (n - 1) + fourth / n).sum()) / variance.size * per_e**2)
        clear.append(expected.clear_of_limits)
    mean, variance, error, used = np.array(x), np.array(found), np.array(errors), np.array(clear)
    compared = used & (error > 0)
    shot = per_e if sensor.shot_noise else 0.0
    floor = sensor.read_noise_e**2 + sensor.code_e**2 / 12
    line = np.concatenate([[0.0], np.geomspace(mean[mean > 0].min(), full * per_e, 60)])
    points = Comparison(
        "photon_transfer", "steady light, ambient light off", f"mean_{unit}", f"variance_{unit}2",
        mean, np.array(predicted), variance, error, np.full(len(mean), 8 * bench.samples),
        compared, line, shot * line + floor * per_e**2,
    )  # fmt: skip
    quantities: list[SheetQuantity] = []
    linear = compared & (mean <= _EMVA_LINEAR_SHARE * full * per_e)
    if linear.sum() >= 3:
        slope, offset, slope_error, offset_error = fit_line(mean[linear], variance[linear], error[linear])
        used_samples = int(points.samples[linear].sum())
        quantities.append(
            SheetQuantity(f"photon_transfer_slope_{unit}", f"photon-transfer slope ({unit}²/{unit})", shot, slope,
                          slope_error, used_samples)
        )  # fmt: skip
        # the root of a variance that is compatible with 0 has the error of √(its error)
        noise = math.sqrt(max(offset, 0.0)) / per_e
        noise_error = min(
            offset_error / (2 * noise * per_e**2) if noise > 0 else math.inf, math.sqrt(offset_error) / per_e
        )
        quantities.append(
            SheetQuantity("dark_noise_e", "noise floor of a tap, read noise and quantisation (e-)", math.sqrt(floor),
                          noise, noise_error, used_samples)
        )  # fmt: skip
    notes = () if linear.sum() >= 3 else ("Without noise that a converter can see there is no photon transfer to fit.",)
    return Part((points,), tuple(quantities), notes=notes)


def fit_line(x: Floats, y: Floats, std_error: Floats) -> tuple[float, float, float, float]:
    """Fit y = slope · x + offset by weighted least squares; return slope, offset and their standard errors."""
    design = np.column_stack([x, np.ones_like(x)]) / std_error[:, None]
    scale = np.linalg.norm(design, axis=0)
    covariance = np.linalg.inv((design / scale).T @ (design / scale))
    solution = covariance @ ((design / scale).T @ (y / std_error)) / scale
    errors = np.sqrt(np.diag(covariance)) / scale
    return float(solution[0]), float(solution[1]), float(errors[0]), float(errors[1])
