"""The measuring bench: a camera before flat fields, with its noise, and what a measurement on it yields."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from phasemark import UsageError
from phasemark.render.bench.data_sheet.results import Comparison, Floats, SheetQuantity
from phasemark.render.bench.flat_field import expected_flat_field, flat_field
from phasemark.render.direct.histogram_frames import HistogramFrames, capture_histograms
from phasemark.render.exposure.capture import capture
from phasemark.render.frames import Frames
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.sensor.camera_unit import camera_unit
from phasemark.render.sensor.sensor import Sensor

ALBEDOS = (0.1, 0.4, 0.8)
"""Albedos of the flat fields, dark to bright."""
NEAREST_M, FURTHEST_M = 0.2, 100.0


@dataclass(frozen=True)
class Part:
    """Contribution of one measurement to the data sheet."""

    comparisons: tuple[Comparison, ...] = ()
    quantities: tuple[SheetQuantity, ...] = ()
    maps: dict[str, Floats] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


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

    def mean(self, values: Floats) -> float:
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
