"""The range noise law: how well one frame can measure a range (PHYSICS section 4)."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark.render.sensor.sensor import Sensor

_HOPELESS_STD_RAD = 100.0  # π²/3 of phase variance to one part in 1e2; no law describes a signal so low


def predicted_range_std(amplitude: ArrayLike, intensity: ArrayLike, sensor: Sensor) -> NDArray[np.float64]:
    """Return the standard deviation of the range in one frame, from noise-free amplitude and intensity.

    σ = (c / 4πf) · √(N₀·intensity + N_amb + N_dark + 2σ_r² + q²/6) / (√2 · K · N₀ · |S_1|), PHYSICS section 4. It is
    the limit of high signal: 0.5 % low at a phase noise of 0.1 rad, 1 % at 0.14 rad. Patterns (PRNU, DSNU) and stray
    light are not in it. A direct sensor has a law of its own, :func:`direct_range_std`. Of several modulation
    frequencies it is the combined (Σ σ_f⁻²)^−½ of an unwrapped range (PHYSICS section 10), with this amplitude at each
    of them: c / 4π√Σf² in place of c / 4πf. ``sensor.by_frequency`` has the law of each.

    Parameters
    ----------
    amplitude : array_like
        ``abs(S_1)``; 1 for albedo 1 facing the camera at 1 m.
    intensity : array_like
        Mean amplitude over the pixel; broadcasts against `amplitude`.
    sensor : Sensor
        The camera.

    Returns
    -------
    ndarray
        Metres; infinite where the amplitude is zero, for a direct sensor where amplitude or intensity is.

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
    For a direct sensor intensity_e over N₀ = `signal_e` is the relative intensity of :func:`direct_range_std`.

    Parameters
    ----------
    amplitude_e, intensity_e : array_like
        Electrons per phase image, as in :class:`~phasemark.render.Frames`; they broadcast.
    sensor : Sensor
        The camera.

    Returns
    -------
    ndarray
        Metres; infinite where the amplitude is zero, for a direct sensor where amplitude or intensity is.
    """
    return sensor.range_per_phase_noise_m * measured_phase_std(amplitude_e, intensity_e, sensor)


def direct_range_std(intensity: ArrayLike, sensor: Sensor) -> NDArray[np.float64]:
    """Return the standard deviation of a direct sensor's range in one frame (PHYSICS section 4).

    σ² = range_std_m² + range_shot_std_m² / I + range_ambient_std_m² / I² with the relative intensity I: a constant
    part, shot noise of the signal, and shot noise of ambient light, which makes σ grow with the square of the range.

    Parameters
    ----------
    intensity : array_like
        Relative intensity I; 1 for albedo 1 facing the camera at 1 m.
    sensor : Sensor
        Of kind "direct".

    Returns
    -------
    ndarray
        Metres; infinite where the intensity is not positive.
    """
    relative = np.asarray(intensity, dtype=np.float64)
    lit = relative > 0
    inverse = np.divide(1.0, relative, out=np.zeros(relative.shape), where=lit)
    variance = sensor.range_std_m**2 + inverse * (sensor.range_shot_std_m**2 + sensor.range_ambient_std_m**2 * inverse)
    return np.where(lit, np.sqrt(variance), np.inf)


def measured_phase_std(amplitude_e: ArrayLike, intensity_e: ArrayLike, sensor: Sensor) -> NDArray[np.float64]:
    """Return the standard deviation of the phase in one frame, radians; see :func:`measured_range_std`."""
    amplitude, variance = np.broadcast_arrays(
        np.asarray(amplitude_e, dtype=np.float64), phase_image_variance(intensity_e, sensor)
    )
    if sensor.kind == "direct":
        law = direct_range_std(np.asarray(intensity_e, dtype=np.float64) / sensor.signal_e, sensor)
        return np.where(amplitude > 0, law / sensor.metres_per_radian, np.inf)
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
        The camera.
    """
    shot = np.maximum(np.asarray(intensity_e, dtype=np.float64), 0.0) if sensor.shot_noise else 0.0
    return np.asarray(shot + np.zeros(np.shape(intensity_e)) + sensor.read_variance_e2)


def phase_density(phase_error_rad: ArrayLike, s: float) -> NDArray[np.float64]:
    """Return the exact density of the phase error of a phasor in Gaussian noise (PHYSICS section 4).

    p(ψ) = e^{−s}/2π · [1 + √(πs) cos ψ · e^{s cos²ψ} (1 + erf(√s cos ψ))]

    Parameters
    ----------
    phase_error_rad : array_like
        ψ, in −π … π.
    s : float
        amplitude_e² over the variance of one phase image, 1 / (2 · law's phase std²).
    """
    from scipy import special  # takes a fifth of a second

    root = math.sqrt(s) * np.cos(np.asarray(phase_error_rad, dtype=np.float64))
    hill = math.sqrt(math.pi) * root * np.exp(root**2 - s) * (1 + special.erf(root))
    return np.asarray((math.exp(-s) + hill) / (2 * math.pi))


def exact_phase_moments(law_std_rad: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return variance and kurtosis of the phase error where the noise law, its limit of high signal, is not exact.

    Parameters
    ----------
    law_std_rad : array_like
        Standard deviation of the phase by the law, radians.

    Returns
    -------
    variance_rad2, kurtosis : ndarray
        Second moment of :func:`phase_density`; fourth moment over its square, 3 for high signal.
    """
    std = np.asarray(law_std_rad, dtype=np.float64)
    log_std, ratio, kurtosis = _moment_table()
    std = np.minimum(std, _HOPELESS_STD_RAD)  # where every phase is equally probable
    at = np.log(np.maximum(std, np.exp(log_std[0])))
    return std**2 * np.interp(at, log_std, ratio), np.interp(at, log_std, kurtosis)


@lru_cache(maxsize=1)
def _moment_table() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return log of the law's std, exact variance over the law's, and kurtosis: steps of 2 % from 0.003 rad on."""
    stds = np.geomspace(0.003, _HOPELESS_STD_RAD, 530)
    ratio, kurtosis = np.empty_like(stds), np.empty_like(stds)
    for i, std in enumerate(stds):
        psi = np.linspace(-1, 1, 2001) * min(math.pi, 20 * std)
        weight = phase_density(psi, 1 / (2 * std**2))
        weight /= np.trapezoid(weight, psi)
        second, fourth = np.trapezoid(psi**2 * weight, psi), np.trapezoid(psi**4 * weight, psi)
        ratio[i], kurtosis[i] = second / std**2, fourth / second**2
    return np.log(stds), ratio, kurtosis
