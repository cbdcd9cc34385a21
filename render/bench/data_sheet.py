"""Characterise a sensor as EMVA 1288 and the literature on PMD cameras would: by flat fields, beside predictions.

Every figure stands beside what closed forms predict (:mod:`~phasemark.render.bench.flat_field`), with its number of
samples and its standard error; :attr:`Comparison.chi2` says whether the two agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark import UsageError
from phasemark.render.bench.flat_field import ExpectedFlatField, expected_flat_field, flat_field
from phasemark.render.exposure.capture import capture
from phasemark.render.frames import Flag, Frames
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.sensor.camera_unit import camera_unit
from phasemark.render.sensor.range_noise import direct_range_std, exact_phase_moments, predicted_range_std
from phasemark.render.sensor.sensor import Sensor

ALBEDOS = (0.1, 0.4, 0.8)
"""Albedos of the flat fields, dark to bright."""

Z95 = 1.959963984540054
AGREEMENT = 0.999
"""Simulation agrees with prediction while all χ² pass at this level, corrected for their number."""

_SAMPLES_PER_POINT = 51_200  # σ is known to 0.3 %
_FEWEST_FRAMES = 8
_NEAREST_M, _FURTHEST_M = 0.2, 100.0
_LARGEST_PHASE_STD_RAD = 0.15  # beyond, counts of electrons are so few that no Gaussian density is exact
_LINEARITY_SPAN = 1.5  # unambiguous ranges
_LINEARITY_POINTS = 53  # prime: every period of an error is met at other phases
_EMVA_LINEAR_SHARE = 0.7  # of saturation: EMVA 1288's range for the photon-transfer fit
_FLAGS_BEGIN = 0.01  # share of the frames

_Float = NDArray[np.float64]


def _plain(value: float) -> float | None:
    """Return None for a number that JSON does not have."""
    return value if math.isfinite(value) else None


@dataclass(frozen=True, eq=False)
class Comparison:
    """Simulated points beside predicted ones.

    Parameters
    ----------
    figure, label : str
        Which figure the points belong to, and which of its series they are.
    x_name, y_name : str
        What the numbers are, unit at the end.
    x, predicted, simulated, std_error : (n,) float64
        `std_error` is that of a simulated point about the prediction.
    samples : (n,) int64
        Readings that a point is made of.
    compared : (n,) bool
        Where the prediction claims to hold: nothing clips there, and there is noise.
    curve_x, curve_y : (m,) float64
        The prediction drawn as a line.
    law_y : (m,) float64, or None
        The nominal law, without patterns and without its corrections, where it differs from the prediction.
    """

    figure: str
    label: str
    x_name: str
    y_name: str
    x: _Float
    predicted: _Float
    simulated: _Float
    std_error: _Float
    samples: NDArray[np.int64]
    compared: NDArray[np.bool_]
    curve_x: _Float
    curve_y: _Float
    law_y: _Float | None = None

    @property
    def half95(self) -> _Float:
        """Half width of the 95 % interval of each point."""
        return Z95 * self.std_error

    @property
    def degrees_of_freedom(self) -> int:
        """Number of points compared."""
        return int(self.compared.sum())

    @property
    def chi2(self) -> float:
        """Σ ((simulated − predicted) / standard error)² over the points compared."""
        used = self.compared
        return float((((self.simulated - self.predicted)[used] / self.std_error[used]) ** 2).sum())

    @property
    def p_value(self) -> float:
        """Probability of a larger χ² if the prediction is right; 1 if nothing is compared."""
        return float(special.chdtrc(self.degrees_of_freedom, self.chi2)) if self.degrees_of_freedom else 1.0

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, for JSON."""
        return {
            "figure": self.figure,
            "label": self.label,
            "x_name": self.x_name,
            "y_name": self.y_name,
            "chi2": _plain(self.chi2),
            "degrees_of_freedom": self.degrees_of_freedom,
            "p_value": _plain(self.p_value),
            "points": [
                {
                    "x": float(x),
                    "predicted": float(predicted),
                    "simulated": _plain(float(simulated)),
                    "low95": _plain(float(simulated - half)),
                    "high95": _plain(float(simulated + half)),
                    "samples": int(samples),
                    "compared": bool(compared),
                }
                for x, predicted, simulated, half, samples, compared in zip(
                    self.x, self.predicted, self.simulated, self.half95, self.samples, self.compared, strict=True
                )
            ],
        }


@dataclass(frozen=True)
class SheetQuantity:
    """One number of a data sheet.

    Parameters
    ----------
    name : str
        With the unit at its end.
    title : str
        What it is, in words, with its unit.
    predicted, simulated : float
    std_error : float
        Of `simulated`.
    samples : int
        Readings it is made of.
    """

    name: str
    title: str
    predicted: float
    simulated: float
    std_error: float
    samples: int

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers, for JSON."""
        half = Z95 * self.std_error
        return {
            "title": self.title,
            "predicted": _plain(self.predicted),
            "simulated": _plain(self.simulated),
            "low95": _plain(self.simulated - half),
            "high95": _plain(self.simulated + half),
            "samples": self.samples,
        }


@dataclass(frozen=True, eq=False)
class Characterisation:
    """The data sheet of a sensor.

    Parameters
    ----------
    sensor : Sensor
    n_frames : int
        Frames at each point.
    reference_range_m : float
        Range of the flat fields whose range is of no account.
    comparisons : tuple of Comparison
    quantities : tuple of SheetQuantity
    maps : mapping of str to (rows, cols) float64
        Simulated patterns by name with unit; NaN where a pixel is dead or hot.
    defects : mapping of str to (rows, cols) bool
        ``dead`` and ``hot``.
    notes : tuple of str
        Sentences about what this sensor does not have.
    """

    sensor: Sensor
    n_frames: int
    reference_range_m: float
    comparisons: tuple[Comparison, ...]
    quantities: tuple[SheetQuantity, ...]
    maps: dict[str, _Float] = field(default_factory=dict)
    defects: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def of_figure(self, figure: str) -> tuple[Comparison, ...]:
        """Return the series of a figure; none if the sensor does not have it."""
        return tuple(one for one in self.comparisons if one.figure == figure)

    def quantity(self, name: str) -> SheetQuantity | None:
        """Return a number of the data sheet, or None if the sensor does not have it."""
        return next((one for one in self.quantities if one.name == name), None)

    @property
    def disagreements(self) -> tuple[Comparison, ...]:
        """Series whose χ² does not pass at `AGREEMENT`, corrected for the number of series."""
        limit = (1 - AGREEMENT) / max(len(self.comparisons), 1)
        return tuple(one for one in self.comparisons if not one.p_value >= limit)  # NaN is no agreement

    @property
    def chi2(self) -> float:
        """χ² over all points."""
        return sum(one.chi2 for one in self.comparisons)

    @property
    def degrees_of_freedom(self) -> int:
        """Number of all points compared."""
        return sum(one.degrees_of_freedom for one in self.comparisons)

    @property
    def p_value(self) -> float:
        """Probability of a larger χ² over all points if every prediction is right."""
        return float(special.chdtrc(self.degrees_of_freedom, self.chi2)) if self.degrees_of_freedom else 1.0

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, lists and strings, for JSON; None where there is no number."""
        return {
            "format": "phasemark-characterisation",
            "schema_version": 1,
            "sensor": self.sensor.model_dump(mode="json"),
            "frames_per_point": self.n_frames,
            "reference_range_m": self.reference_range_m,
            "agreement": {
                "agrees": not self.disagreements,
                "level": AGREEMENT,
                "chi2": _plain(self.chi2),
                "degrees_of_freedom": self.degrees_of_freedom,
                "p_value": _plain(self.p_value),
                "disagreeing": [f"{one.figure}: {one.label}" for one in self.disagreements],
            },
            "quantities": {one.name: one.as_dict() for one in self.quantities},
            "comparisons": [one.as_dict() for one in self.comparisons],
            "maps": {
                name: [[_plain(float(value)) for value in row] for row in values] for name, values in self.maps.items()
            },
            "defects": {name: np.argwhere(mask).tolist() for name, mask in self.defects.items()},
            "notes": list(self.notes),
        }


def characterise(sensor: Sensor, *, rng: np.random.Generator, n_frames: int | None = None) -> Characterisation:
    """Run a sensor before flat fields and compare what it reports with closed forms.

    Photon transfer is measured with steady light and no ambient light; range noise on surfaces of three albedos that
    face the camera; linearity along a delay line that keeps the light constant; patterns over many frames of one flat
    field; saturation with rising light; the amplitude threshold with rising distance. The validity threshold and the
    wrap guard are off but where they are measured, so that they select no samples.

    Parameters
    ----------
    sensor : Sensor
    rng : numpy.random.Generator
        Source of all noise.
    n_frames : int, optional
        Frames at each point, at least 2; by default as many as make 51 200 readings, and at least 8.

    Returns
    -------
    Characterisation

    Raises
    ------
    UsageError
        `n_frames` is less than 2, or no pixel works.
    """
    if n_frames is None:
        n_frames = max(_FEWEST_FRAMES, math.ceil(_SAMPLES_PER_POINT / (sensor.rows * sensor.cols)))
    if n_frames < 2:
        raise UsageError(f"'n_frames' must be at least 2, for one frame has no noise, got {n_frames}")
    bench = _Bench(sensor, rng, n_frames)
    parts = _direct_parts(bench) if sensor.kind == "direct" else _phase_parts(bench)
    return Characterisation(
        sensor,
        n_frames,
        bench.reference_range_m,
        tuple(one for part in parts for one in part.comparisons),
        tuple(one for part in parts for one in part.quantities),
        {name: values for part in parts for name, values in part.maps.items()},
        {"dead": bench.unit.dead, "hot": bench.unit.hot},
        tuple(note for part in parts for note in part.notes),
    )


@dataclass(frozen=True)
class _Part:
    """What one measurement adds to the whole."""

    comparisons: tuple[Comparison, ...] = ()
    quantities: tuple[SheetQuantity, ...] = ()
    maps: dict[str, _Float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


class _Bench:
    """The measuring bench: one camera, its noise, and the light that it can bear."""

    def __init__(self, sensor: Sensor, rng: np.random.Generator, n_frames: int) -> None:
        self.sensor = sensor
        self.unit = camera_unit(sensor)
        self.alive = ~(self.unit.dead | self.unit.hot)
        if not self.alive.any():
            raise UsageError("the sensor cannot be characterised: every pixel is dead or hot")
        self.n_frames = n_frames
        self.samples = n_frames * int(self.alive.sum())
        self.reference_range_m = min(1.0, sensor.unambiguous_range_m / 4)
        self.open = sensor  # without thresholds
        if sensor.kind == "phase":
            self.open = sensor.with_(max_phase_std_rad=None, min_amplitude_e=0.0, wrap_guard_m=0.0)
        self._rng = rng

    def frames(self, range_m: float, amplitude: float, sensor: Sensor | None = None) -> Frames:
        """Take the frames of one flat field, thresholds off unless a sensor is given."""
        sensor = sensor or self.open
        return capture(flat_field(sensor, range_m, amplitude), sensor, rng=self._rng, n_frames=self.n_frames)

    def steady_taps(self, amplitude: float, sensor: Sensor) -> _Float:
        """Take frames of steady light and return the taps' electrons, (frames, 4, 2, working pixels)."""
        image = flat_field(sensor, self.reference_range_m, amplitude, modulated=False)
        taps = capture(image, sensor, rng=self._rng, n_frames=self.n_frames, keep_taps=True).taps_e
        assert taps is not None
        return np.asarray(taps[0][..., self.alive])

    def range_errors(self, frames: Frames, truth_m: _Float | float) -> _Float:
        """Return wrapped errors of the ranges, (frames, working pixels)."""
        return np.asarray(wrap_difference_m(frames.range_m[0] - truth_m, self.sensor)[:, self.alive])

    def mean(self, values: _Float) -> float:
        """Return the mean over the working pixels of an image."""
        return float(values[self.alive].mean())

    @property
    def safe_amplitude(self) -> float:
        """|S| of albedo 0.8 at 1 m, or as much of it as nothing clips for."""
        amplitude = 0.8
        while not expected_flat_field(self.open, self.reference_range_m, amplitude).clear_of_limits:
            amplitude *= 0.8
            if amplitude < 1e-6:  # the converter's steps show at any light
                return 0.8
        return amplitude


def _phase_parts(bench: _Bench) -> list[_Part]:
    return [
        _photon_transfer(bench),
        *(_range_noise(bench, albedo) for albedo in ALBEDOS),
        _linearity(bench),
        _patterns(bench),
        _saturation(bench),
        *(_threshold(bench, albedo) for albedo in ALBEDOS),
    ]


def _photon_transfer(bench: _Bench) -> _Part:
    """Variance of the taps against their mean, in codes (electrons without a converter), ambient light off."""
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
    return _Part((points,), tuple(quantities), notes=notes)


def fit_line(x: _Float, y: _Float, std_error: _Float) -> tuple[float, float, float, float]:
    """Fit y = slope · x + offset by weighted least squares; return slope, offset and their standard errors."""
    design = np.column_stack([x, np.ones_like(x)]) / std_error[:, None]
    scale = np.linalg.norm(design, axis=0)
    covariance = np.linalg.inv((design / scale).T @ (design / scale))
    solution = covariance @ ((design / scale).T @ (y / std_error)) / scale
    errors = np.sqrt(np.diag(covariance)) / scale
    return float(solution[0]), float(solution[1]), float(errors[0]), float(errors[1])


def _range_noise(bench: _Bench, albedo: float) -> _Part:
    """Range σ of one frame against distance, of a surface that faces the camera."""
    sensor = bench.open
    line = np.geomspace(_NEAREST_M, min(_FURTHEST_M, sensor.unambiguous_range_m), 80)
    law = predicted_range_std(albedo / line**2, albedo / line**2, sensor)
    curve = [expected_flat_field(sensor, d, albedo / d**2) for d in line]
    predicted_curve = np.array([math.sqrt(bench.mean(one.range_variance_m2)) for one in curve])
    good = law <= _LARGEST_PHASE_STD_RAD * sensor.metres_per_radian
    clear = good & [one.clear_of_limits for one in curve]
    if not clear.any():
        return _Part(
            notes=(f"Range noise on albedo {albedo:g} has no distance where nothing clips and the law holds.",)
        )
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
    return _Part((points,))


def _linearity(bench: _Bench) -> _Part:
    """Error of the mean range along a delay line, the light held constant, beyond the wrap as well."""
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
    return _Part((points,), (wiggling,))


def _patterns(bench: _Bench) -> _Part:
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
    return _Part((points,), quantities, maps)


def _spatial_std(values: _Float, noise_variance: float) -> tuple[float, float]:
    """Return the standard deviation of a pattern and its standard error, the noise of its values subtracted."""
    m = values.size
    variance = max(float(values.var(ddof=1)) - noise_variance, 0.0) if m > 1 else 0.0
    if variance <= noise_variance:  # near none, the root of a variance has the error of √(the variance's error)
        return math.sqrt(variance), math.sqrt(noise_variance) * (2 / max(m - 1, 1)) ** 0.25
    of_variance = (4 * variance * noise_variance + 2 * noise_variance**2) / m
    return math.sqrt(variance), math.sqrt(of_variance) / (2 * math.sqrt(variance))


def _image(values: _Float, bench: _Bench) -> _Float:
    image = np.full(bench.alive.shape, np.nan)
    image[bench.alive] = values
    return image


def _saturation(bench: _Bench) -> _Part:
    """Share of flagged frames against signal."""
    sensor = bench.open
    if not math.isfinite(sensor.saturation_e):
        return _Part(notes=("It has neither full well nor converter, so no signal saturates it.",))

    def predicted_share(signal_e: float) -> float:
        expected = expected_flat_field(sensor, bench.reference_range_m, signal_e / sensor.signal_e)
        return bench.mean(expected.saturation_probability)

    top = 8 * sensor.saturation_e
    low, high = (_crossing(predicted_share, share, 0.0, top) for share in (1e-3, 1 - 1e-3))
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
        true_signal = _crossing(predicted_share, at, 0.0, top)
        signal, signal_error = _found_beside(points, at, true_signal)
        quantities.append(
            SheetQuantity(f"saturation_flags_{name}_e", f"signal at which {words} flagged as saturated (e-)",
                          true_signal, signal, signal_error, bench.samples * len(signals))
        )  # fmt: skip
    return _Part((points,), tuple(quantities))


def _crossing(function: Callable[[float], float], level: float, low: float, high: float) -> float:
    """Return where a function that rises from `low` to `high` reaches a level, by bisection: it may jump."""
    for _ in range(32):
        middle = 0.5 * (low + high)
        if function(middle) < level:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _found_beside(points: Comparison, level: float, true_x: float) -> tuple[float, float]:
    """Return where the simulated share crosses a level, and its standard error.

    The predicted points, interpolated alike, miss the true place by what the interpolation is wrong: subtracted.
    """
    found, error = _interpolated(points.x, points.simulated, points.std_error, level)
    return found + true_x - _interpolated(points.x, points.predicted, points.std_error, level)[0], error


def _interpolated(x: _Float, share: _Float, error: _Float, level: float) -> tuple[float, float]:
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


def _threshold(bench: _Bench, albedo: float) -> _Part:
    """Share of frames without return against distance, about the distance at which it is one half."""
    sensor = bench.sensor
    name = f"threshold_distance_albedo_{albedo:g}_m"
    title = f"distance at which half of the frames show no return, albedo {albedo:g} (m)"
    if sensor.max_phase_std_rad is None and sensor.min_amplitude_e == 0:
        note = "It has no amplitude threshold: whatever returns any light is valid."
        return _Part(notes=(note,) if albedo == ALBEDOS[0] else ())

    def lost_share(distance_m: float) -> float:
        expected = expected_flat_field(sensor, distance_m, albedo / distance_m**2)
        return bench.mean(1 - _return_probability(expected))

    middle = _crossing(lost_share, 0.5, _NEAREST_M, _FURTHEST_M)
    if not _NEAREST_M * 1.1 < middle < _FURTHEST_M / 1.1:
        return _Part(notes=(f"The amplitude threshold does not end the range of albedo {albedo:g} within 100 m.",))
    low, high = (_crossing(lost_share, share, _NEAREST_M, _FURTHEST_M) for share in (0.05, 0.95))
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
    found, found_error = _found_beside(points, 0.5, middle)
    return _Part((points,), (SheetQuantity(name, title, middle, found, found_error, bench.samples * len(distances)),))


def _return_probability(expected: ExpectedFlatField) -> _Float:
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


def _direct_parts(bench: _Bench) -> list[_Part]:
    note = (
        "It is a direct time-of-flight sensor: photon transfer, saturation, wiggling and amplitude thresholds belong "
        "to taps and phases, which it does not have."
    )
    return [_direct_range(bench), *(_dropout(bench, albedo) for albedo in ALBEDOS), _Part(notes=(note,))]


def _direct_range(bench: _Bench) -> _Part:
    """Noise and mean error of a direct sensor's range, up to where it drops out on the brightest surface."""
    sensor = bench.sensor
    albedo = ALBEDOS[-1]
    furthest = min(_dropout_distance_m(sensor, albedo), 10.0)
    distances = np.linspace(_NEAREST_M, 0.98 * furthest, 20)
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
    return _Part(
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


def _dropout(bench: _Bench, albedo: float) -> _Part:
    """Where a direct sensor drops out: a step."""
    edge = _dropout_distance_m(bench.sensor, albedo)
    if not math.isfinite(edge):
        return _Part(notes=(f"Albedo {albedo:g} never drops out.",))
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
    found, found_error = _found_beside(points, 0.5, edge)
    name = f"threshold_distance_albedo_{albedo:g}_m"
    title = f"distance at which it drops out, albedo {albedo:g} (m)"
    return _Part((points,), (SheetQuantity(name, title, edge, found, found_error, bench.samples * len(distances)),))
