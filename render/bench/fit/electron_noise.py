"""From the noise of single frames to signal, contrast, ambient light and read noise in electrons."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from phasemark import UsageError
from phasemark.render.bench.fit.boards import BoardData
from phasemark.render.bench.fit.fitted_sensor import AmplitudeUnit, FittedField, Floats
from phasemark.render.bench.fit.photon_transfer import NOISE_LEVELS_RATIO, NoiseData, solve_scaled
from phasemark.render.integral.rounding import with_error
from phasemark.render.sensor.correlation import Harmonic, correlation_peak
from phasemark.render.sensor.sensor import Sensor

_DISTANCE_STEP = 1e-4  # of the distance, for derivatives of the noise's numbers


def fit_noise(
    data: BoardData, base: Sensor, amplitude_unit: AmplitudeUnit, estimates: dict[str, FittedField], notes: list[str]
) -> dict[str, Any]:
    """Return the fields that the noise of single frames tells, the errors of the distances in their standard errors."""
    good = data.good
    if base.kind == "direct":
        variance = data.variance_m2[:, good]
        degrees = float((data.n[:, good] - 1).sum())
        std = math.sqrt(float(variance.mean()))
        estimates["range_std_m"] = FittedField(std, std / math.sqrt(2 * degrees), "noise of single frames")
        return {"range_std_m": std}
    found: dict[str, FittedField] = {}
    changes = _fit_light(data, base, amplitude_unit, found, notes)
    variance_of = dict.fromkeys(found, 0.0)
    for board, (distance, std) in enumerate(zip(data.distance_m, data.distance_std_m, strict=True)):
        step = _DISTANCE_STEP * float(distance)
        sides = [_refitted(data.shifted(board, side), base, amplitude_unit) for side in (step, -step)] if std else []
        for name, one in found.items():
            # a side on which other numbers can be distinguished tells nothing about the slope
            slopes = [
                (side[name].value - one.value) / (sign * step)
                for sign, side in zip((1, -1), sides, strict=False)
                if side.keys() == found.keys()
            ]
            variance_of[name] += (float(np.mean(slopes)) * float(std)) ** 2 if slopes else 0.0
    for name, one in found.items():
        if one.std_error is not None:
            one = replace(one, std_error=math.hypot(one.std_error, math.sqrt(variance_of[name])))
        # less light than none is chance
        estimates[name] = replace(one, value=max(one.value, 0.0)) if name == "ambient_e" else one
    if "ambient_e" in changes:
        changes["ambient_e"] = max(changes["ambient_e"], 0.0)
    return changes


def _refitted(data: BoardData, base: Sensor, amplitude_unit: AmplitudeUnit) -> dict[str, FittedField]:
    """Return the estimates of other data; none if these do not show the signal."""
    found: dict[str, FittedField] = {}
    try:
        _fit_light(data, base, amplitude_unit, found, [])
    except UsageError:
        return {}
    return found


def _fit_light(
    data: BoardData, base: Sensor, amplitude_unit: AmplitudeUnit, estimates: dict[str, FittedField], notes: list[str]
) -> dict[str, Any]:
    """Fit signal, contrast, ambient light and read noise to given distances; ambient light may come out negative."""
    good = data.good
    law, scale_error = NoiseData.of(data), 0.0
    amplitude = None if data.amplitude is None else data.amplitude[:, good]
    intensity = None if data.intensity is None else data.intensity[:, good]
    if amplitude is not None:  # the mean square of a noisy amplitude is A² + 2σ²
        amplitude = amplitude / np.sqrt(1 + 2 * law.phase_variance.mean(axis=1, keepdims=True))
    if amplitude is not None and amplitude_unit == "arbitrary":
        electrons = None if intensity is None else law.electrons_per_unit(amplitude, intensity)
        if electrons is None:
            notes.append(
                "Amplitudes of arbitrary unit tell no electrons: that takes intensities too, at distances or albedos "
                f"whose light differs by {NOISE_LEVELS_RATIO:g} times and more. They were left aside."
            )
            amplitude = intensity = None
        else:
            scale, error = electrons
            notes.append(
                f"Photon transfer gives {with_error(scale, error)} electrons a unit of amplitude and intensity."
            )
            amplitude, scale_error = amplitude * scale, error / scale
            intensity = None if intensity is None else intensity * scale
    if amplitude is None:
        return _noise_of_ranges(law, base, estimates, notes)
    return _noise_of_electrons(law, base, amplitude, intensity, scale_error, estimates, notes)


def _noise_of_ranges(
    law: NoiseData, base: Sensor, estimates: dict[str, FittedField], notes: list[str]
) -> dict[str, Any]:
    """Turn σ_φ² = a/S + b/S² into signal and constant noise, the contrast assumed."""
    contrast = base.contrast
    estimates["contrast"] = FittedField(contrast, None, "ranges alone do not tell it from signal_e")
    constant_e2 = base.ambient_e + base.dark_e + base.read_variance_e2
    if law.levels_differ:
        (a, b), covariance = law.two_terms(law.phase_variance, 1 / law.light, 1 / law.light**2)
        if a > 2 * math.sqrt(covariance[0, 0]):
            signal = 1 / (2 * contrast**2 * a)
            signal_error = signal * math.sqrt(covariance[0, 0]) / a
            to_electrons = 2 * contrast**2 * signal**2
            noise = to_electrons * b
            gradient = np.array([-2 * noise / a, to_electrons])
            noise_error = math.sqrt(float(gradient @ covariance @ gradient))
            ambient = noise - base.dark_e - base.read_variance_e2
            notes.append(
                "Ranges alone tell signal_e · contrast² and the noise that does not follow the light; the latter is "
                "put down to ambient light, beside the assumed dark current and read noise."
            )
            estimates["signal_e"] = FittedField(signal, signal_error, "noise against light, for the assumed contrast")
            estimates["ambient_e"] = FittedField(
                ambient, noise_error, "noise that does not follow the light: read noise may be in it"
            )
            return {"signal_e": signal, "ambient_e": ambient}
    # one number: σ_φ² = (N₀S + B) / 2K²N₀²S² with B as assumed, solved for N₀
    y, y_error = law.one_term(2 * contrast**2 * law.phase_variance * law.light**2)
    s = float(law.light.mean())
    signal = (s + math.sqrt(s**2 + 4 * y * constant_e2)) / (2 * y)
    slope = s / signal**2 + 2 * constant_e2 / signal**3  # −dy/dN₀
    notes.append(
        "The ranges show one number of noise: which part of it follows the light takes distances or albedos whose "
        f"light differs by {NOISE_LEVELS_RATIO:g} times and more, or amplitudes. signal_e is that for the assumed "
        "contrast, ambient light and read noise."
    )
    estimates["signal_e"] = FittedField(
        signal, y_error / slope, "range noise, for the assumed contrast and ambient light"
    )
    return {"signal_e": signal}


def _noise_of_electrons(
    law: NoiseData,
    base: Sensor,
    amplitude_e: Floats,
    intensity_e: Floats | None,
    scale_error: float,
    estimates: dict[str, FittedField],
    notes: list[str],
) -> dict[str, Any]:
    """Turn amplitudes, and intensities if there are any, in electrons into signal, contrast and noise.

    `scale_error` is the relative error of the electron itself; the contrast, a ratio, does not know it.
    """
    boards = len(amplitude_e)
    # wiggling and stray light scale A/S from board to board, patterns from pixel to pixel
    modulated, modulated_error = _mean_of_boards(amplitude_e / law.light, law.light_std)
    variance_e2 = 2 * law.phase_variance * amplitude_e**2  # N₀S + N_amb + N_dark + V
    light = intensity_e if intensity_e is not None else variance_e2
    what = "intensity" if intensity_e is not None else "noise · amplitude²"
    constant = base.ambient_e + base.dark_e + (0.0 if intensity_e is not None else base.read_variance_e2)
    changes: dict[str, Any] = {}
    if law.levels_differ:
        if intensity_e is not None:
            (signal, offset), covariance = _line_over_boards(law, intensity_e)
        else:
            (signal, offset), covariance = law.two_terms(variance_e2, law.light, np.ones_like(law.light))
        signal_error, offset_error = np.sqrt(np.diag(covariance))
        ambient = offset - (constant - base.ambient_e)
        note = f"{what} without light, less the assumed dark current"
        estimates["ambient_e"] = FittedField(
            float(ambient),
            math.hypot(offset_error, scale_error * offset),
            note if intensity_e is not None else f"{note} and read noise",
        )
        changes["ambient_e"] = float(ambient)
    else:
        mean, mean_error = _mean_of_boards(light / law.light, law.light_std) if intensity_e is not None else (
            (float(((variance_e2 - constant) / law.light).mean()), law.one_term(variance_e2 / law.light)[1])
        )  # fmt: skip
        signal = mean - (constant / float(law.light.mean()) if intensity_e is not None else 0.0)
        signal_error = mean_error
        notes.append(
            "Signal and ambient light cannot be distinguished by one level of light: ambient light is the assumed one. "
            f"That takes distances or albedos whose light differs by {NOISE_LEVELS_RATIO:g} times and more."
        )
    if signal <= 2 * signal_error:
        raise UsageError(
            f"the frames do not show the signal: {what} rises by {with_error(signal, signal_error)} electrons a "
            "unit of light; are amplitude and intensity in electrons (amplitude_unit=…)?"
        )
    contrast = modulated / signal
    contrast_error = contrast * math.hypot(modulated_error / modulated, signal_error / signal)
    estimates["signal_e"] = FittedField(
        float(signal),
        math.hypot(signal_error, scale_error * signal),
        f"{what} against light at {boards} distance{'s' if boards > 1 else ''}",
    )
    estimates["contrast"] = FittedField(
        float(contrast), float(contrast_error), f"amplitude, {modulated:.5g} electrons at |S| = 1, over signal_e"
    )
    changes |= {"signal_e": float(signal), "contrast": float(contrast)}
    if intensity_e is not None:
        extra, extra_error = _excess(variance_e2, intensity_e, law, scale_error)
        per_tap = (extra - base.code_e**2 / 6) / 2
        read_noise = math.sqrt(max(per_tap, 0.0))
        error = min(extra_error / (4 * read_noise) if read_noise > 0 else math.inf, math.sqrt(extra_error / 2))
        estimates["read_noise_e"] = FittedField(
            read_noise, error, "noise over that of the electrons counted" + ("" if per_tap > 0 else "; none was seen")
        )
        changes["read_noise_e"] = read_noise
    else:
        estimates["read_noise_e"] = FittedField(
            base.read_noise_e, None, "without intensities it looks like ambient light"
        )
    return changes


def _mean_of_boards(values: Floats, light_std: Floats) -> tuple[float, float]:
    """Return the mean over boards and pixels, and its standard error from their spread, boards as a whole included.

    What the distances let boards spread, `light_std` of the mean, is left out: it is added to every number later.
    """
    own = values.std(ddof=1) / math.sqrt(values.size) if values.size > 1 else 0.0
    boards = values.mean(axis=1)
    between = 0.0
    if len(boards) > 1:
        excess = float(boards.var(ddof=1)) - float(((light_std * boards.mean()) ** 2).mean())
        between = math.sqrt(max(excess, 0.0) / len(boards))
    return float(values.mean()), float(max(own, between))


def _line_over_boards(law: NoiseData, intensity_e: Floats) -> tuple[Floats, Floats]:
    """Fit I = N₀S + B to every pixel by least squares of relative errors; return the means and their covariance.

    It follows from the scatter of the pixels, whose sensitivities and dark signals differ, and of whole boards, less
    what the distances let boards scatter: that is added to every number later.
    """
    light = law.light
    y = intensity_e.mean(axis=1)
    lines = []
    for x, values in zip(light.T, intensity_e.T, strict=True):
        design = np.column_stack([x, np.ones_like(x)]) / y[:, None]
        solution, covariance = solve_scaled(design, values / y)
        lines.append(solution)
    solutions = np.array(lines)
    mean = solutions.mean(axis=0)
    own = np.atleast_2d(np.cov(solutions.T)) / len(solutions) if len(solutions) > 1 else np.zeros((2, 2))
    if len(y) > 2:
        residual = (light.mean(axis=1) * mean[0] + mean[1]) / y - 1
        expected = law.light_std * light.mean(axis=1) * mean[0] / y
        excess = float((residual**2).sum()) / (len(y) - 2) - float((expected**2).mean())
        own = own + covariance * max(excess, 0.0)
    return mean, own


def _excess(variance_e2: Floats, intensity_e: Floats, law: NoiseData, scale_error: float) -> tuple[float, float]:
    """Return the mean of 2σ_φ²A² − I, each value weighted by what chance leaves of it, and its standard error."""
    weight = law.degrees / (2 * np.maximum(intensity_e, 1.0) ** 2)
    total = float(weight.sum())
    mean = float((weight * (variance_e2 - intensity_e)).sum()) / total
    # the noise itself has more variance than its electrons alone
    expected = np.maximum(intensity_e + max(mean, 0.0), 1.0)
    chance = math.sqrt(float((weight**2 * 2 * expected**2 / law.degrees).sum())) / total
    # a wrong electron scales the noise by its square and the intensity by itself
    lever = float((weight * (2 * variance_e2 - intensity_e)).sum()) / total
    return mean, math.hypot(chance, scale_error * lever)


def possible_contrast(fields: dict[str, Any], estimates: dict[str, FittedField], notes: list[str]) -> float:
    """Return the contrast, at most what lets no tap count less than nothing."""
    harmonics = tuple(Harmonic(*entry) for entry in fields["harmonics"])
    peak = correlation_peak(harmonics) if fields["modulation"] == "harmonics" else 1.0
    limit = min(1.0, 1 / peak)
    contrast = float(fields["contrast"])
    if contrast > limit:
        notes.append(
            f"The contrast came out as {contrast:.4g}, more than taps can have: {limit:.4g} was taken. Are albedo and "
            "the unit of the amplitudes right?"
        )
        estimate = estimates["contrast"]
        estimates["contrast"] = FittedField(
            limit, estimate.std_error, f"{estimate.note}; lowered to the most there can be"
        )
        return limit
    return contrast
