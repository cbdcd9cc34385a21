"""Comparison of a pixel of a frame with the model: the one table of PHYSICS section 7.

| frame, model | nothing returns | something may return | something must return |
|---|---|---|---|
| return | :data:`DISAGREEMENT` | squared residual | squared residual |
| no return | 0 | 0 | :data:`DISAGREEMENT` |
| missing | 0 | 0 | 0 |

Nothing that a frame shows is free: a return is either compared with the range of light that the model has there, or it
costs what a residual of five standard deviations does. The only exception are pixels that an edge enters or leaves
within the uncertainty of the view, all of them at one view nearby; a return there costs 1, the average cost of a
compared pixel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render import Sensor, phasor_to_range_m, predicted_range_std

DISAGREEMENT = 25.0
"""Cost of a pixel where frame and model disagree on whether anything returns: a residual of five σ."""
MUST_RETURN_COVERAGE = 0.3
"""A pixel that sees this much of the landmark must return something, if its light is above what noise hides."""
MAY_RETURN_COVERAGE = 0.005
"""A pixel that sees less of the landmark than this returns nothing, unless a background does."""
FILLED_COVERAGE = 0.995
"""A pixel that sees this much of the landmark shows nothing of what stands behind it."""
SURELY, PERHAPS = 0.5, 2.0
"""Shares of the largest one-frame σ that counts: of light that must return, whatever the noise, and that may."""
MIN_RETURNS = 3
"""A frame with fewer returns decides nothing: two numbers are sought."""
_USUAL_LIMIT_RAD = 0.1
_ROUNDING = 1e-9


def one_frame_limit_m(sensor: Sensor) -> float:
    """Return the largest one-frame σ of a pixel that counts, metres: 0.1 rad unless the sensor says otherwise."""
    return (sensor.max_phase_std_rad or _USUAL_LIMIT_RAD) * sensor.metres_per_radian


def counts(
    phasor: NDArray[np.complexfloating], intensity: NDArray[np.floating], sensor: Sensor, share: float = 1.0
) -> NDArray[np.bool_]:
    """Return which pixels of noise-free images one frame measures to within the limit (PHYSICS section 7).

    Parameters
    ----------
    phasor, intensity : (..., rows, cols)
    sensor : Sensor
    share : float
        Of the limit, in place of all of it: at half of it, twice the least amplitude must return.

    Returns
    -------
    (..., rows, cols) bool
        Whether light returns, at `min_amplitude_e` or more, and the noise law gives a range at most 0.1 rad (0.24 m at
        10 MHz) of noise. A direct sensor measures what returns at least `min_intensity` from within `max_range_m`.
    """
    amplitude = np.abs(phasor)
    lit = amplitude > 0
    if sensor.kind == "direct":
        lit &= np.asarray(intensity) >= sensor.min_intensity
        if sensor.max_range_m is not None:
            lit &= np.where(lit, phasor_to_range_m(np.where(lit, phasor, 1.0), sensor), 0.0) <= sensor.max_range_m
    elif sensor.min_amplitude_e > 0:
        lit &= sensor.contrast * sensor.signal_e * amplitude >= sensor.min_amplitude_e / share
    if share > 1 and sensor.max_phase_std_rad is None:  # whatever its noise, all that is lit may return
        return np.asarray(lit)
    std = predicted_range_std(amplitude, intensity, sensor)
    return np.asarray(lit & (std <= share * one_frame_limit_m(sensor) * (1 + _ROUNDING)))


def pixel_mask(pixels: str | NDArray[np.bool_], sensor: Sensor) -> NDArray[np.bool_]:
    """Return which pixels may count by their place, (..., rows, cols).

    Parameters
    ----------
    pixels : {"all", "lower"} or (..., rows, cols) bool
        "lower": those of the lower half of the rows; an array is taken as it is.
    sensor : Sensor

    Raises
    ------
    UsageError
        A name is unknown, or an array is no mask of the sensor's pixels.
    """
    if not isinstance(pixels, str):
        mask = np.asarray(pixels)
        if mask.dtype != np.bool_ or mask.shape[-2:] != (sensor.rows, sensor.cols):
            raise UsageError(
                f"'pixels' must be all, lower or booleans of {sensor.rows} × {sensor.cols} pixels, got"
                f" {mask.dtype} {mask.shape}"
            )
        return mask
    if pixels not in ("all", "lower"):
        raise UsageError(f"'pixels' must be all, lower or an array, got {pixels!r}")
    mask = np.ones((sensor.rows, sensor.cols), np.bool_)
    if pixels == "lower":
        mask[slice(*sensor.upper_rows)] = False
    return mask


def beside(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which pixels have a neighbour in a mask, left, right, above or below; (n, rows, cols)."""
    out = np.zeros_like(mask)
    out[:, 1:] |= mask[:, :-1]
    out[:, :-1] |= mask[:, 1:]
    out[:, :, 1:] |= mask[:, :, :-1]
    out[:, :, :-1] |= mask[:, :, 1:]
    return out


def disagrees(
    returned: NDArray[np.bool_],
    not_returned: NDArray[np.bool_],
    may_return: NDArray[np.bool_],
    must_return: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Return which pixels of frames contradict the model: a return out of nothing, or none where one must be."""
    return np.asarray((returned & ~may_return) | (not_returned & must_return))
