"""Noise and light of boards: signal, contrast, ambient light and read noise in electrons (PHYSICS section 4).

Divided by the board's light S and averaged over its pixels, amplitude, intensity and noise are lines in 1/S:

- amplitude A/S = m and intensity I/S = n + b/S, in units of 1/p electrons;
- noise 2σ_φ²A²/S = p · I/S + q/S.

Then signal_e = n/p, contrast = m/n, ambient and dark electrons b/p, and q/p² is all noise beside that of the electrons.
Amplitudes in electrons have p = 1. Ranges alone are amplitudes KS and intensities S in units of signal_e.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from phasemark import UsageError
from phasemark.render.bench.fit.boards import BoardData, Moments
from phasemark.render.bench.fit.fitted_sensor import AmplitudeUnit, Findings, FittedField, Floats
from phasemark.render.bench.least_squares import weighted_fit
from phasemark.render.integral.rounding import with_error
from phasemark.render.sensor.correlation import Harmonic, correlation_peak
from phasemark.render.sensor.range_noise import exact_phase_moments

NOISE_LEVELS_RATIO = 1.5  # largest light over smallest that tells two terms of the noise law apart
_CLEAR_SIGMAS = 2.0  # a number within fewer standard errors of zero is not seen
_ROUNDS = 4  # weights of the noise follow from its fit: weights from the data would favour what chance made small


class _Lines:
    """Numbers fitted to the means of boards, and what one standard deviation of each source of error does to them.

    Sources are chance in the amplitude, intensity and noise of each board, and the boards' distances. What boards
    scatter beyond these is chance too.
    """

    def __init__(self, data: BoardData) -> None:
        self.data = data
        self.light = data.used(data.light)
        self.inverse = (1 / self.light).mean(axis=1)
        self.light_std = 2 * data.distance_std_m / data.distance_m  # relative
        variance, degrees = data.used(data.variance_m2) / data.sensor.metres_per_radian**2, data.used(data.n) - 1
        mean = variance.mean(axis=1, keepdims=True)
        # the law is a little low where noise is high: by what the exact density says
        above_law = np.ones_like(mean)
        np.divide(exact_phase_moments(np.sqrt(mean))[0], mean, out=above_law, where=mean > 0)
        self.variance = variance / above_law
        self.variance_std = np.sqrt((2 / degrees).mean(axis=1) / degrees.shape[1])  # relative, of a board's mean
        self.values: dict[str, float] = {}
        self.errors: dict[str, Floats] = {}  # (4 · boards,)

    @staticmethod
    def differ(levels: Floats) -> bool:
        """Return True if levels of boards distinguish a part that follows the light from one that does not."""
        return bool(levels.min() > 0 and levels.max() >= NOISE_LEVELS_RATIO * levels.min())

    def of_light(self, moments: tuple[Moments, ...], noise: Floats | float = 0.0) -> tuple[Floats, Floats, Floats]:
        """Return a quantity of every pixel, its mean over the light of each board, and the standard deviation of that.

        Its mean square is larger by `noise` than the square of its mean.
        """
        n = self.data.used(self.data.n)
        variance = self.data.used([one.variance for one in moments])
        pixels = self.data.used([one.mean for one in moments])
        if np.any(noise):
            pixels = np.sqrt((pixels**2 + variance * (n - 1) / n) / (1 + noise))
        chance = np.sqrt((variance / n / self.light**2).mean(axis=1) * self.data.widening / n.shape[1])
        return pixels, (pixels / self.light).mean(axis=1), chance

    def known(self, name: str, value: float) -> None:
        """Take a number as it is."""
        self.values[name], self.errors[name] = value, np.zeros(4 * len(self.light_std))

    def fit(
        self, source: int, columns: dict[str, tuple[Floats | float, float]], target: Floats, chance: Floats,
        weight_std: Floats,
    ) -> Floats:  # fmt: skip
        """Fit numbers by name to the boards; return the fitted target.

        Parameters
        ----------
        source : int
            0 for the amplitude, 1 for the intensity, 2 for the noise.
        columns : dict of str to (boards,) and float
            Column of the design, and how much of its part follows the light.
        target, chance, weight_std : (boards,) float64
            With the standard deviations of chance and for the weights.
        """
        design = np.column_stack([np.broadcast_to(column, target.shape) for column, _ in columns.values()])
        solution, covariance = weighted_fit(design, target, weight_std)
        influence = covariance @ (design / weight_std[:, None] ** 2).T
        moved = design @ (solution * [part for _, part in columns.values()]) * self.light_std
        residual, freedom = (target - design @ solution) / weight_std, len(target) - len(solution)
        explained = float(((chance**2 + moved**2) / weight_std**2).mean())
        excess = max(float(residual @ residual) / freedom - explained, 0.0) if freedom else 0.0
        own = influence * np.sqrt(chance**2 + excess * weight_std**2)
        for k, name in enumerate(columns):
            self.known(name, float(solution[k]))
            self.errors[name].reshape(4, -1)[[source, 3]] = own[k], -influence[k] * moved
        return np.asarray(design @ solution)

    def fit_noise(
        self, columns: dict[str, tuple[Floats | float, float]], amplitude: Floats, rest: Floats | float = 0.0
    ) -> None:
        """Fit numbers to the noise times amplitude², over the light, less a known part."""
        noise = expected = (2 * self.variance * amplitude**2 / self.light).mean(axis=1)
        for _ in range(_ROUNDS):
            std = np.abs(expected) * self.variance_std
            expected = self.fit(2, columns, noise - rest, std, std) + rest
            expected = np.where(expected > 0, expected, noise)

    def derived(self, function: Callable[..., float], names: str) -> tuple[float, float]:
        """Return a function of the numbers and its standard error."""
        values = np.array([self.values[name] for name in names])
        source_step = 1e-3  # standard deviations, for derivatives
        errors = source_step * np.array([self.errors[name] for name in names])
        parts = [(function(*(values + one)) - function(*(values - one))) / (2 * source_step) for one in errors.T]
        return float(function(*values)), float(np.linalg.norm(parts))

    def seen(self, name: str) -> bool:
        """Return True if a number exceeds zero by more than its chance."""
        chance = float(np.linalg.norm(self.errors[name].reshape(4, -1)[:3]))
        return self.values[name] > _CLEAR_SIGMAS * chance


def fit_light(data: BoardData, amplitude_unit: AmplitudeUnit, found: Findings) -> None:
    """Find the fields that the noise of single frames and the light of the boards show."""
    if data.sensor.kind == "direct":
        std = math.sqrt(float(data.used(data.variance_m2).mean()))
        degrees = float((data.used(data.n) - 1).sum())
        found.add("range_std_m", std, std / math.sqrt(2 * degrees), "noise of single frames")
        return
    lines = _Lines(data)
    if data.amplitude:
        amplitude, m, m_std = lines.of_light(data.amplitude, 2 * lines.variance.mean(axis=1, keepdims=True))
        lines.fit(0, {"m": (1.0, 1.0)}, m, m_std, np.ones_like(m))
        lines.known("p", 1.0)
        if amplitude_unit == "electrons" or _electrons_a_unit(lines, amplitude, found):
            _add_electrons(lines, amplitude, amplitude_unit, found)
            return
    _add_noise_of_ranges(lines, found)


def _electrons_a_unit(lines: _Lines, amplitude: Floats, found: Findings) -> bool:
    """Find the electrons of an arbitrary unit; return False if the light does not vary enough."""
    if lines.data.intensity:
        pixels, intensity, _ = lines.of_light(lines.data.intensity)
        if lines.differ(pixels.mean(axis=1)) and lines.differ(lines.light.mean(axis=1)):
            lines.fit_noise({"p": (intensity, 0.0), "q": (lines.inverse, 0.0)}, amplitude)
            if lines.seen("p"):
                unit = with_error(*lines.derived(lambda p: 1 / p, "p"))
                found.notes.append(f"Photon transfer gives {unit} electrons a unit of amplitude and intensity.")
                return True
    found.notes.append(
        "Amplitudes of arbitrary unit tell no electrons: that takes intensities too, at distances or albedos "
        f"whose light differs by {NOISE_LEVELS_RATIO:g} times and more. They were left aside."
    )
    return False


def _add_electrons(lines: _Lines, amplitude: Floats, amplitude_unit: AmplitudeUnit, found: Findings) -> None:
    """Turn amplitudes, and intensities if there are any, into signal, contrast and noise."""
    base, boards, intensities = lines.data.sensor, len(amplitude), lines.data.intensity
    what = "intensity" if intensities else "noise · amplitude²"
    assumed = base.dark_e + (0.0 if intensities else base.read_variance_e2)
    differ = lines.differ(lines.light.mean(axis=1))
    columns: dict[str, tuple[Floats | float, float]] = {"n": (1.0, 1.0), "b": (lines.inverse, 0.0)}
    constant = 0.0
    if not differ:
        del columns["b"]
        constant = base.ambient_e + assumed
        found.notes.append(
            "Signal and ambient light cannot be distinguished by one level of light: ambient light is the assumed one. "
            f"That takes distances or albedos whose light differs by {NOISE_LEVELS_RATIO:g} times and more."
        )
    rest = constant * lines.inverse
    if intensities:
        _, intensity, std = lines.of_light(intensities)
        lines.fit(1, columns, intensity - rest, std, intensity)
        if amplitude_unit == "electrons":
            lines.fit_noise({"q": (lines.inverse, 0.0)}, amplitude, intensity)
    else:
        lines.fit_noise(columns, amplitude, rest)
    signal, signal_error = lines.derived(lambda n, p: n / p, "np")
    if not lines.seen("n"):
        raise UsageError(
            f"the frames do not show the signal: {what} rises by {with_error(signal, signal_error)} electrons a "
            "unit of light; are amplitude and intensity in electrons (amplitude_unit=…)?"
        )
    text = f"{what} against light at {boards} distance{'s' if boards > 1 else ''}"
    found.add("signal_e", signal, signal_error, text)
    modulated, _ = lines.derived(lambda m, p: m / p, "mp")
    text = f"amplitude, {modulated:.5g} electrons at |S| = 1, over signal_e"
    found.add("contrast", *lines.derived(lambda m, n: m / n, "mn"), text)
    if differ:
        ambient, error = lines.derived(lambda b, p: b / p - assumed, "bp")
        text = f"{what} without light, less the assumed dark current{'' if intensities else ' and read noise'}"
        found.add("ambient_e", max(ambient, 0.0), error, text)  # less light than none is chance
    if not intensities:
        found.add("read_noise_e", base.read_noise_e, None, "without intensities it looks like ambient light")
        return
    extra, error = lines.derived(lambda q, p: q / p**2, "qp")
    per_tap = (extra - base.code_e**2 / 6) / 2
    read_noise = math.sqrt(max(per_tap, 0.0))
    error = min(error / (4 * read_noise) if read_noise > 0 else math.inf, math.sqrt(error / 2))
    text = "noise over that of the electrons counted" + ("" if per_tap > 0 else "; none was seen")
    found.add("read_noise_e", read_noise, error, text)


def _add_noise_of_ranges(lines: _Lines, found: Findings) -> None:
    """Turn the noise of ranges into signal and constant noise, the contrast assumed."""
    base = lines.data.sensor
    found.add("contrast", base.contrast, None, "ranges alone do not tell it from signal_e")
    amplitude, assumed = base.contrast * lines.light, base.dark_e + base.read_variance_e2
    if lines.differ(lines.light.mean(axis=1)):
        lines.fit_noise({"p": (1.0, -1.0), "q": (lines.inverse, -2.0)}, amplitude)
        if lines.seen("p"):
            found.notes.append(
                "Ranges alone tell signal_e · contrast² and the noise that does not follow the light; the latter is "
                "put down to ambient light, beside the assumed dark current and read noise."
            )
            text = "noise against light, for the assumed contrast"
            found.add("signal_e", *lines.derived(lambda p: 1 / p, "p"), text)
            ambient, error = lines.derived(lambda q, p: q / p**2 - assumed, "qp")
            text = "noise that does not follow the light: read noise may be in it"
            found.add("ambient_e", max(ambient, 0.0), error, text)  # less light than none is chance
            return
    # one number: v = 1/N₀ + B/SN₀² with B as assumed, solved for N₀
    constant = (base.ambient_e + assumed) * float(lines.inverse.mean())

    def signal_of(v: float) -> float:
        return (1 + math.sqrt(1 + 4 * v * constant)) / (2 * v)

    lines.fit_noise({"v": (1.0, -1.0)}, amplitude)
    lines.fit_noise({"v": (1.0, 1 / (lines.values["v"] * signal_of(lines.values["v"])) - 2)}, amplitude)
    found.notes.append(
        "The ranges show one number of noise: which part of it follows the light takes distances or albedos whose "
        f"light differs by {NOISE_LEVELS_RATIO:g} times and more, or amplitudes. signal_e is that for the assumed "
        "contrast, ambient light and read noise."
    )
    text = "range noise, for the assumed contrast and ambient light"
    found.add("signal_e", *lines.derived(signal_of, "v"), text)


def limit_contrast(fields: dict[str, Any], found: Findings) -> None:
    """Lower the contrast to the most that lets no tap count less than nothing."""
    harmonics = tuple(Harmonic(*entry) for entry in fields["harmonics"])
    peak = correlation_peak(harmonics) if fields["modulation"] == "harmonics" else 1.0
    limit, contrast = min(1.0, 1 / peak), float(fields["contrast"])
    if contrast <= limit:
        return
    found.notes.append(
        f"The contrast came out as {contrast:.4g}, more than taps can have: {limit:.4g} was taken. Are albedo and "
        "the unit of the amplitudes right?"
    )
    estimate = found.estimates["contrast"]
    note = f"{estimate.note}; lowered to the most there can be"
    found.estimates["contrast"] = FittedField(limit, estimate.std_error, note)
    fields["contrast"] = limit
