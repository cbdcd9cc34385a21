"""Mean electrons of the taps, from light; and light again, from taps (PHYSICS section 4).

Arrays of taps are (..., 4, 2, rows, cols): phase images τ = 0, π/2, π, 3π/2, then taps a and b.
"""

from __future__ import annotations

from collections.abc import Mapping

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark.render.sensor.camera_unit import CameraUnit
from phasemark.render.sensor.sensor import Sensor

N_PHASES = 4
N_TAPS = 2

# i^q at q = 0, 1, 2, 3 quarter turns, exactly.
_TURN_REAL = np.array([1.0, 0.0, -1.0, 0.0])
_TURN_IMAG = np.array([0.0, 1.0, 0.0, -1.0])


def tap_means(
    phasors: Mapping[int, NDArray[np.complex128]],
    intensity: NDArray[np.float64],
    sensor: Sensor,
    delay_rad: ArrayLike = 0.0,
) -> NDArray[np.float64]:
    """Return the mean electrons that light brings to each tap, ambient light included.

    ½ (N₀·intensity + N_amb) ± ½ K N₀ Re[Σ_k a_k S_k e^{i(kτ + θ_k)}], a_1 = 1, θ_1 = 0, τ = 0, π/2, π, 3π/2. Through
    four samples k ≡ 1 mod 4 adds a_k S_k e^{iθ_k} to S_1, k ≡ 3 mod 4 its conjugate, and even orders cancel: wiggling.

    Parameters
    ----------
    phasors : mapping of int to (n, rows, cols) complex
        S_k for k = 1 and the sensor's `harmonic_orders`.
    intensity : (n, rows, cols)
        Mean amplitude.
    sensor : Sensor
    delay_rad : array_like, broadcasts to (2, rows, cols)
        Phase by which each tap sees the light late; order k turns by k times as much.

    Returns
    -------
    ndarray, shape (n, 4, 2, rows, cols)
        e- per tap and phase image.
    """
    n, rows, cols = intensity.shape
    orders = (1, *sensor.harmonic_orders)
    light = np.stack([np.asarray(phasors[k], np.complex128).reshape(n, rows * cols) for k in orders])
    delay = np.broadcast_to(np.asarray(delay_rad, float), (N_TAPS, rows, cols)).reshape(N_TAPS, rows * cols)
    weight = np.empty((len(orders), *delay.shape), np.complex128)
    weight[0] = np.exp(1j * delay)
    for j, (k, amplitude, phase) in enumerate(sensor.correlation_harmonics, start=1):
        weight[j] = amplitude * np.exp(1j * (phase + k * delay))
    means = np.empty((n, N_PHASES, N_TAPS, rows * cols))
    common = 0.5 * (sensor.signal_e * intensity.reshape(n, -1) + sensor.ambient_e)
    modulation = 0.5 * sensor.contrast * sensor.signal_e
    _correlate(light, weight, np.array(orders), common, modulation, means)
    return means.reshape(n, N_PHASES, N_TAPS, rows, cols)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _correlate(light, weight, orders, common, modulation, means):
    """Fill means (n, 4, 2, pixels) from S_k (orders, n, pixels) and a_k e^{i(θ_k + kδ)} (orders, 2, pixels).

    Pixel by pixel, so that the sum does not depend on how many views there are.
    """
    for view in range(light.shape[1]):
        for tap in range(2):
            half = modulation if tap == 0 else -modulation
            for pixel in range(light.shape[2]):
                for phase in range(4):
                    value = 0.0
                    for j in range(len(orders)):
                        s = light[j, view, pixel] * weight[j, tap, pixel]
                        turn = (orders[j] * phase) % 4  # e^{ikτ} is this many quarter turns
                        value += s.real * _TURN_REAL[turn] - s.imag * _TURN_IMAG[turn]
                    means[view, phase, tap, pixel] = common[view, pixel] + half * value


def collect(means: NDArray[np.float64], unit: CameraUnit) -> NDArray[np.float64]:
    """Return the mean electrons a physical camera collects, (1 + PRNU) · mean + dark + DSNU; (..., 2, rows, cols)."""
    return means * unit.response + unit.dark_e


def demodulate(taps: NDArray[np.float64]) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Turn four phase images into a phasor and an intensity.

    With D_i = N_a − N_b: phasor_e = ½ [(D₀ − D₂) + i (D₃ − D₁)], so that its argument is the measured phase, its
    modulus is amplitude_e with mean K·N₀·|S_1|; and intensity_e = ¼ Σ (N_a + N_b).

    Parameters
    ----------
    taps : (..., 4, 2, rows, cols)
        e- per tap and phase image.

    Returns
    -------
    phasor_e : (..., rows, cols) complex128
    intensity_e : (..., rows, cols) float64
    """
    rows, cols = taps.shape[-2:]
    flat = np.ascontiguousarray(taps).reshape(-1, N_PHASES, N_TAPS, rows * cols)
    phasor_e, intensity_e = np.empty((len(flat), rows * cols), np.complex128), np.empty((len(flat), rows * cols))
    _demodulate(flat, phasor_e, intensity_e)
    shape = (*taps.shape[:-4], rows, cols)
    return phasor_e.reshape(shape), intensity_e.reshape(shape)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _demodulate(taps, phasor_e, intensity_e):
    """Fill phasor and intensity, (n, pixels), from taps (n, 4, 2, pixels)."""
    for i in range(len(taps)):
        t = taps[i]
        for pixel in range(t.shape[2]):
            real = 0.5 * ((t[0, 0, pixel] - t[0, 1, pixel]) - (t[2, 0, pixel] - t[2, 1, pixel]))
            imag = 0.5 * ((t[3, 0, pixel] - t[3, 1, pixel]) - (t[1, 0, pixel] - t[1, 1, pixel]))
            phasor_e[i, pixel] = complex(real, imag)
            total = t[0, 0, pixel] + t[0, 1, pixel]
            for phase in range(1, 4):
                total += t[phase, 0, pixel] + t[phase, 1, pixel]
            intensity_e[i, pixel] = total / 4
