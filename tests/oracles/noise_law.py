"""The noise of a range written out a second time: the law, and the exact density of which it is the limit."""

import math
from typing import Any

import numpy as np
from builders import one_pixel
from numpy.typing import NDArray
from scipy import special

from phasemark.render import Sensor

FALSE_ALARM = 1e-3  # of a whole test, whatever the number of cells


def noise_law_m(sensor: Sensor, amplitude: float, intensity: float) -> float:
    """The range noise law, written out a second time from PHYSICS section 4."""
    code_e = 0 if sensor.adc_bits is None else 1 / sensor.gain
    shot = sensor.shot_noise * (sensor.signal_e * intensity + sensor.ambient_e + sensor.dark_e)
    root = math.sqrt(shot + 2 * sensor.read_noise_e**2 + code_e**2 / 6)
    return 299_792_458 / (4 * math.pi * 10e6) * root / (math.sqrt(2) * sensor.contrast * sensor.signal_e * amplitude)


def phase_density(psi: NDArray[np.float64], s: float) -> NDArray[np.float64]:
    """Exact density of the phase error of a phasor in Gaussian noise, PHYSICS section 4."""
    root = math.sqrt(s) * np.cos(psi)
    density: NDArray[np.float64] = (
        np.exp(-s) + math.sqrt(math.pi) * root * np.exp(root**2 - s) * (1 + special.erf(root))
    ) / (2 * np.pi)
    return density


def exact_over_law(phase_std_rad: float) -> float:
    """Standard deviation of the exact phase density over that of the law, which is its limit of high signal."""
    s = 1 / (2 * phase_std_rad**2)
    psi = np.linspace(-1, 1, 20_001) * min(math.pi, 12 * phase_std_rad)
    weight = phase_density(psi, s)
    return math.sqrt((psi**2 * weight).sum() / weight.sum()) / phase_std_rad


def noise_table() -> list[tuple[Sensor, float, float, float]]:
    """Return the cells of distance, albedo, ambient light, contrast, read noise and converter with a law of ≤ 0.3 m.

    A code is 20 electrons, at most as much as the noise of a tap: quantisation is uniform.
    """
    converters: tuple[dict[str, Any], ...] = ({}, {"adc_bits": 12, "gain": 0.05, "black_level": 100.0})
    cells = []
    for distance_m in (0.8, 1.5, 3.0):
        for albedo in (0.2, 0.8):
            for ambient_e in (0.0, 20_000.0):
                for contrast in (0.3, 0.5):
                    for read_noise_e in (0.0, 60.0):
                        for converter in converters:
                            sensor = one_pixel(
                                ambient_e=ambient_e, contrast=contrast, read_noise_e=read_noise_e, **converter
                            )
                            amplitude = albedo / distance_m**2
                            law = noise_law_m(sensor, amplitude, amplitude)
                            if law <= 0.3:
                                cells.append((sensor, distance_m, amplitude, law))
    return cells
