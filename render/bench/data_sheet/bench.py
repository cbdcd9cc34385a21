"""The measuring bench: a camera before flat fields, with its noise, and the rows of its data sheet."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from phasemark import UsageError
from phasemark.render.bench.data_sheet.results import Comparison, Floats, SheetQuantity
from phasemark.render.bench.flat_field import expected_flat_field, flat_field
from phasemark.render.direct.histogram_frames import HistogramFrames, capture_histograms
from phasemark.render.exposure.capture import capture
from phasemark.render.frames import Flag, Frames
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.sensor.camera_unit import camera_unit
from phasemark.render.sensor.sensor import Sensor

ALBEDOS = (0.1, 0.4, 0.8)
"""Albedos of the flat fields, dark to bright."""
NEAREST_M, FURTHEST_M = 0.2, 100.0

Row = Comparison | SheetQuantity | dict[str, Floats] | str
"""One result of a measurement: a series, a number, maps of the pixels, or a sentence on what the sensor lacks."""


class Bench:
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

    def histograms(self, expected: Floats, n_frames: int, sensor: Sensor | None = None) -> HistogramFrames:
        """Take the histograms of a direct sensor from their expected counts, (views, zones, bins)."""
        return capture_histograms(expected, sensor or self.sensor, rng=self._rng, n_frames=n_frames)

    def steady_taps(self, amplitude: float, sensor: Sensor) -> Floats:
        """Take frames of steady light and return the taps' electrons, (frames, 4, 2, working pixels)."""
        image = flat_field(sensor, self.reference_range_m, amplitude, modulated=False)
        taps = capture(image, sensor, rng=self._rng, n_frames=self.n_frames, keep_taps=True).taps_e
        assert taps is not None
        return np.asarray(taps[0][..., self.alive])

    def range_errors(self, frames: Frames, truth_m: Floats | float) -> Floats:
        """Return wrapped errors of the ranges, (frames, working pixels)."""
        return np.asarray(wrap_difference_m(frames.range_m[0] - truth_m, self.sensor)[:, self.alive])

    def flagged(self, frames: Frames, flag: Flag) -> float:
        """Return the share of the readings of working pixels that have a flag."""
        return float((frames.flags[0] & int(flag) > 0)[:, self.alive].mean())

    def mean(self, values: Floats) -> float:
        """Return the mean over the working pixels of an image."""
        return float(values[self.alive].mean())

    def series(
        self,
        figure: str,
        label: str,
        names: tuple[str, str],
        columns: Iterable[ArrayLike],
        curve: tuple[ArrayLike, ArrayLike] | None = None,
        *,
        samples: int | None = None,
        law: Floats | None = None,
    ) -> Comparison:
        """Return a series of the data sheet, compared where the prediction holds and there is noise.

        Parameters
        ----------
        figure, label : str
        names : tuple of str
            Quantities along x and y.
        columns : five of (n,) or one number
            x, predicted, simulated, standard error, and whether the prediction holds.
        curve : tuple of (m,), optional
            The prediction as a line; by default through the points.
        samples : int, optional
            Readings of a point; by default those of all working pixels.
        law : (m,) float64, optional
            The nominal law along the curve.
        """
        x, predicted, simulated, std_error, holds = (np.array(one, np.float64) for one in np.broadcast_arrays(*columns))
        curve_x, curve_y = (np.array(one, np.float64) for one in curve or (x, predicted))
        readings = np.full(len(x), self.samples if samples is None else samples)
        compared = (holds > 0) & (std_error > 0)
        return Comparison(
            figure, label, *names, x, predicted, simulated, std_error, readings, compared, curve_x, curve_y, law
        )

    @property
    def safe_amplitude(self) -> float:
        """|S| of albedo 0.8 at 1 m, or as much of it as nothing clips for."""
        amplitude = 0.8
        while not expected_flat_field(self.open, self.reference_range_m, amplitude).clear_of_limits:
            amplitude *= 0.8
            if amplitude < 1e-6:  # the converter's steps show at any light
                return 0.8
        return amplitude


def crossing(function: Callable[[float], float], level: float, low: float, high: float) -> float:
    """Return where a function that rises from `low` to `high` reaches a level, by bisection: it may jump."""
    for _ in range(32):
        middle = 0.5 * (low + high)
        if function(middle) < level:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def crossing_of(
    points: Comparison, level: float, true_x: float, name: str, title: str, place_std: float = 0.0
) -> SheetQuantity:
    """Return where the simulated share crosses a level; `place_std` is an error that the samples do not show.

    The predicted points, interpolated alike, miss the true place by what the interpolation is wrong: subtracted.
    """
    found, error = _interpolated(points.x, points.simulated, points.std_error, level)
    found = found + true_x - _interpolated(points.x, points.predicted, points.std_error, level)[0]
    return SheetQuantity(name, title, true_x, found, math.hypot(error, place_std), int(points.samples.sum()))


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
