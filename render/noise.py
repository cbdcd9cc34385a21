"""The range noise law: how well one frame can measure a range (PHYSICS section 4)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark.render.sensor import Sensor


def predicted_range_std(amplitude: ArrayLike, intensity: ArrayLike, sensor: Sensor) -> NDArray[np.float64]:
    """Return the standard deviation of the range in one frame, from noise-free amplitude and intensity.

    σ = (c / 4πf) · √(N₀·intensity + N_amb + N_dark + 2σ_r² + q²/6) / (√2 · K · N₀ · |S_1|), PHYSICS section 4. It is
    the limit of high signal: 0.5 % low at a phase noise of 0.1 rad, 1 % at 0.14 rad. Patterns (PRNU, DSNU) and stray
    light are not in it. For a direct sensor, which has no law, it is the figure the sensor states, `range_std_m`.

    Parameters
    ----------
    amplitude : array_like
        ``abs(S_1)``; 1 for albedo 1 facing the camera at 1 m.
    intensity : array_like
        Mean amplitude over the pixel; broadcasts against `amplitude`.
    sensor : Sensor

    Returns
    -------
    ndarray
        Metres; infinite where the amplitude is zero.

    Examples
    --------
    >>> from phasemark.render import preset
    >>> round(float(predicted_range_std(0.8, 0.8, preset("pmd-16x16"))), 4)
    0.02
    """
    amplitude_e = sensor.contrast * sensor.signal_e * np.asarray(amplitude, dtype=np.float64)
    intensity_e = sensor.signal_e * np.asarray(intensity, dtype=np.float64) + sensor.ambient_e + sensor.dark_e
    return measured_range_std(amplitude_e, intensity_e, sensor)


def measured_range_std(amplitude_e: ArrayLike, intensity_e: ArrayLike, sensor: Sensor) -> NDArray[np.float64]:
    """Return the standard deviation of the range in one frame, from measured amplitude and intensity.

    The law of :func:`predicted_range_std` in the electrons a frame reports, whose means are amplitude_e = K·N₀·|S_1|
    and intensity_e = N₀·intensity + N_amb + N_dark: σ = (c / 4πf) · √(intensity_e + 2σ_r² + q²/6) / (√2 · amplitude_e).

    Parameters
    ----------
    amplitude_e, intensity_e : array_like
        Electrons per phase image, as in :class:`~phasemark.render.Frames`; they broadcast.
    sensor : Sensor

    Returns
    -------
    ndarray
        Metres; infinite where the amplitude is zero.
    """
    return sensor.metres_per_radian * measured_phase_std(amplitude_e, intensity_e, sensor)


def measured_phase_std(amplitude_e: ArrayLike, intensity_e: ArrayLike, sensor: Sensor) -> NDArray[np.float64]:
    """Return the standard deviation of the phase in one frame, radians; see :func:`measured_range_std`."""
    amplitude, variance = np.broadcast_arrays(
        np.asarray(amplitude_e, dtype=np.float64), phase_image_variance(intensity_e, sensor)
    )
    if sensor.kind == "direct":
        return np.full(amplitude.shape, sensor.range_std_m / sensor.metres_per_radian)
    std = np.full(amplitude.shape, np.inf)
    np.divide(np.sqrt(variance), math.sqrt(2) * amplitude, out=std, where=np.not_equal(amplitude, 0))
    return std


def phase_image_variance(intensity_e: ArrayLike, sensor: Sensor) -> NDArray[np.float64]:
    """Return the variance of one phase image's D = N_a − N_b, e-²: the sum under the root of the noise law.

    Parameters
    ----------
    intensity_e : array_like
        Electrons in both taps of a phase image, ambient light and dark current included. Read noise can take a
        measured value below zero; no electrons have no shot noise.
    sensor : Sensor
    """
    shot = np.maximum(np.asarray(intensity_e, dtype=np.float64), 0.0) if sensor.shot_noise else 0.0
    return np.asarray(shot + np.zeros(np.shape(intensity_e)) + sensor.read_variance_e2)
