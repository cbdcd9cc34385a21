"""The error of a noise-free range: offset and wiggling, from four samples of the correlation curve."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from phasemark.render.bench.fit.fitted_sensor import Floats
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.sensor.correlation import Harmonic, correlation_curve
from phasemark.render.sensor.sensor import Sensor


def harmonics_of(base: Sensor, changes: dict[str, Any]) -> tuple[Harmonic, ...]:
    """Return the fitted orders of the correlation, or the assumed ones."""
    if "harmonics" in changes:
        return tuple(Harmonic(*entry) for entry in changes["harmonics"])
    return base.correlation_harmonics


def range_error_m(phase: Floats, delay: float, harmonics: tuple[Harmonic, ...], sensor: Sensor) -> Floats:
    """Return the error of the noise-free range, offset and wiggling, from four samples of the correlation curve."""
    samples = [correlation_curve(phase + delay + i * math.pi / 2, harmonics) for i in range(4)]
    measured = np.arctan2(samples[3] - samples[1], samples[0] - samples[2])
    return np.asarray(wrap_difference_m((measured - phase) * sensor.metres_per_radian, sensor))


def circular_mean(values_m: Floats, sensor: Sensor) -> float:
    """Return the mean of ranges that wrap."""
    turn = np.exp(1j * values_m / sensor.metres_per_radian).sum()
    return float(np.angle(turn) * sensor.metres_per_radian)
