"""The correlation of light and reference: harmonics a_k, θ_k of square waves and sampled pulses (PHYSICS section 4).

A tap measures ½ K N₀ · Re[Σ_k a_k S_k e^{i(kτ + θ_k)}] about its mean, a_1 = 1 and θ_1 = 0. A sine has no other order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

SQUARE_PEAK = math.pi**2 / 8
"""Largest value of Σ cos(kx)/k² over odd k: the triangle that correlates a square wave with a square wave."""


class Harmonic(NamedTuple):
    """One order k > 1 of the correlation, relative to the first.

    Parameters
    ----------
    order : int
        k.
    amplitude : float
        a_k; the first order has 1.
    phase_rad : float
        θ_k; the first order has 0.
    """

    order: int
    amplitude: float
    phase_rad: float


def square_harmonics(max_order: int) -> tuple[Harmonic, ...]:
    """Return the orders of a square wave correlated with a square wave: a_k = 1/k², odd k.

    Parameters
    ----------
    max_order : int
        Highest order.
    """
    return tuple(Harmonic(k, 1 / k**2, 0.0) for k in range(3, max_order + 1, 2))


def pulse_harmonics(emitted: ArrayLike, reference: ArrayLike, max_order: int) -> tuple[Harmonic, ...]:
    """Turn an emitted pulse and a reference into harmonics of their correlation.

    With E_k and R_k the Fourier coefficients of light and reference over one period, the correlation
    c(x) = mean over t of e(t − x) · r(t) has the coefficients C_k = conj(E_k) · R_k of e^{ikx}. Its delay is of no
    account (it is the camera's zero of range), so the axis is shifted until θ_1 = 0, and scaled until a_1 = 1:
    a_k = |C_k / C_1| and θ_k = arg C_k − k · arg C_1.

    Parameters
    ----------
    emitted, reference : array_like, (n,)
        Samples, evenly spaced over one period, in any unit.
    max_order : int
        Highest order kept; orders of n/2 and more are not in the samples.

    Returns
    -------
    tuple of Harmonic
        The orders k > 1 that are there.

    Raises
    ------
    ValueError
        The two have no first harmonic in common.
    """
    light, gate = np.asarray(emitted, dtype=float), np.asarray(reference, dtype=float)
    spectrum = np.conj(np.fft.rfft(light)) * np.fft.rfft(gate)
    negligible = 1e-12  # of the fundamental: what rounding leaves of an order that is not there
    if not abs(spectrum[1]) > negligible * np.linalg.norm(light) * np.linalg.norm(gate) * len(light):
        raise ValueError("must have a first harmonic in both pulses: their correlation shows no range")
    found = []
    for k in range(2, min(max_order, (len(light) - 1) // 2) + 1):
        amplitude = abs(spectrum[k] / spectrum[1])
        if amplitude > negligible:
            phase = math.remainder(float(np.angle(spectrum[k]) - k * np.angle(spectrum[1])), 2 * math.pi)
            found.append(Harmonic(k, float(amplitude), phase))
    return tuple(found)


def correlation_curve(phase_rad: ArrayLike, harmonics: Sequence[Harmonic]) -> NDArray[np.float64]:
    """Return cos x + Σ a_k cos(kx + θ_k) of the phases x."""
    x = np.asarray(phase_rad, dtype=float)
    curve = np.cos(x)
    for k, amplitude, phase in harmonics:
        curve = curve + amplitude * np.cos(k * x + phase)
    return np.asarray(curve)


def correlation_peak(harmonics: Sequence[Harmonic]) -> float:
    """Return max |cos x + Σ a_k cos(kx + θ_k)|; a tap's mean stays ≥ 0 while K times this is at most 1.

    Sampled at 64 points in the shortest period and refined by a parabola through the largest, good to 1e-6.
    """
    highest = max((k for k, _, _ in harmonics), default=1)
    n = 64 * highest
    curve = np.abs(correlation_curve(np.arange(n) * (2 * math.pi / n), harmonics))
    top = int(np.argmax(curve))
    left, middle, right = curve[top - 1], curve[top], curve[(top + 1) % n]
    bend = left - 2 * middle + right
    return float(middle - (left - right) ** 2 / (8 * bend) if bend < 0 else middle)
