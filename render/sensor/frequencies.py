"""Several modulation frequencies: their greatest common divisor, and which sets of them can tell a range (section 10).

Ranges repeat when the phases of all frequencies repeat together. With whole hertz that is after c / (2 · gcd). The
frequencies as multiples of the divisor, k_j = f_j / gcd, say how many ranges fit each wrapped phase.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from phasemark.inputs.numbers import in_words

MOST_MULTIPLE = 512
"""Largest multiple of the common divisor that a frequency may be. Beyond it the ranges that fit one phase lie closer
together than the noise of any camera, and the frequencies are as good as incommensurable."""

WHOLE_HZ = 1e-3
"""How far a frequency may be from a whole number of hertz, hertz: what rounding in a file leaves."""


def common_divisor_hz(frequencies_hz: Sequence[float]) -> float:
    """Return the greatest common divisor of frequencies, each rounded to whole hertz; of one frequency itself."""
    if len(frequencies_hz) == 1:
        return frequencies_hz[0]
    return float(math.gcd(*(round(hz) for hz in frequencies_hz)))


def phasor_frequencies_hz(frequencies_hz: Sequence[float], harmonics: Sequence[int]) -> list[float]:
    """Return at which frequencies phasors are wanted: the first with its harmonics, then the others with theirs."""
    first_hz, *others = frequencies_hz
    found = [k * first_hz for k in (1, *harmonics)]
    for hz in (k * other for other in others for k in (1, *harmonics)):
        if hz not in found:
            found.append(hz)
    return found


def check_frequencies(frequencies_hz: Sequence[float]) -> None:
    """Refuse frequencies that no range can be unwrapped from.

    Raises
    ------
    ValueError
        A frequency is named twice or is no whole number of hertz, or the common divisor is too small.
    """
    if len(frequencies_hz) == 1:
        return
    shown = in_words(frequencies_hz)
    for hz in frequencies_hz:
        if abs(hz - round(hz)) > WHOLE_HZ or round(hz) < 1:
            raise ValueError(f"'modulation_hz' must be whole hertz where there are several, got {hz!r} among {shown}")
    whole = [round(hz) for hz in frequencies_hz]
    if len(set(whole)) < len(whole):
        raise ValueError(f"'modulation_hz' must name each frequency once, got {shown}")
    divisor = math.gcd(*whole)
    if max(whole) > MOST_MULTIPLE * divisor:
        raise ValueError(
            f"'modulation_hz' must be multiples, up to {MOST_MULTIPLE}, of a common divisor, got {shown}, whose"
            f" greatest common divisor is {divisor:g} Hz: {in_words(_nearby(whole))} would do"
        )


def _nearby(whole: Sequence[int]) -> list[float]:
    """Return frequencies close by that share a large divisor: rounded to a tenth of the lowest, or finer."""
    for part in (1, 2, 5, 10, 20, 50, 100):
        step = round(min(whole) / part)
        if not step:
            break
        near = [round(hz / step) * step for hz in whole]
        close = all(abs(a - b) <= 0.02 * b for a, b in zip(near, whole, strict=True))
        if close and len(set(near)) == len(near) and max(near) <= MOST_MULTIPLE * math.gcd(*near):
            return [float(hz) for hz in near]
    step = max(math.ceil(max(whole) / MOST_MULTIPLE), 1)
    return [float(max(round(hz / step), 1) * step) for hz in whole]
