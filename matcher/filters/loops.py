"""The loops of the filters over frames and pixels, compiled: sums of frames, and one scalar Kalman filter a pixel.

Every pixel takes its frames one after the other, so that no rounding depends on how many positions there are.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from phasemark.render.frames import Flag

_NO_RETURN = np.uint8(Flag.NO_RETURN)


@njit(cache=True, nogil=True)
def count(flags, n_valid, n_usable):  # type: ignore[no-untyped-def]
    """Count the valid and the usable frames of each pixel: flags (n, frames, pixels), counts (n, pixels), from zero."""
    for i in range(flags.shape[0]):
        for k in range(flags.shape[1]):
            for p in range(flags.shape[2]):
                n_valid[i, p] += flags[i, k, p] == 0
                n_usable[i, p] += flags[i, k, p] == 0 or flags[i, k, p] == _NO_RETURN


@njit(cache=True, nogil=True)
def add_up(values, flags, valid, other, n_other):  # type: ignore[no-untyped-def]
    """Add up a quantity, (n, frames, pixels), over valid frames and over finite values of usable but invalid ones."""
    for i in range(values.shape[0]):
        for k in range(values.shape[1]):
            for p in range(values.shape[2]):
                value = values[i, k, p]
                if flags[i, k, p] == 0:
                    valid[i, p] += value
                elif flags[i, k, p] == _NO_RETURN and math.isfinite(value):
                    other[i, p] += value
                    n_other[i, p] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def follow(z_m, flags, period_m, process_var_m2, measurement_var_m2, range_m, scaled_var):  # type: ignore[no-untyped-def]
    """Run the scalar filters over frames z_m, (n, frames, pixels): state and P/R, (n, pixels), are taken on in place.

    In p = P/R and q = Q/R the filter reads K = (p + q) / (p + q + 1) and P = (1 − K) P⁻ = K R, that is p = K.
    """
    for i in range(z_m.shape[0]):
        for k in range(z_m.shape[1]):
            for j in range(z_m.shape[2]):
                prior = scaled_var[i, j]
                if process_var_m2 > 0.0:
                    prior += process_var_m2 / measurement_var_m2[i, j]
                if flags[i, k, j] != 0:
                    scaled_var[i, j] = prior
                elif math.isnan(range_m[i, j]):
                    range_m[i, j], scaled_var[i, j] = z_m[i, k, j], 1.0
                else:
                    gain = prior / (prior + 1.0)
                    difference = z_m[i, k, j] - range_m[i, j]
                    range_m[i, j] += gain * (difference - period_m * math.floor(difference / period_m + 0.5))
                    scaled_var[i, j] = gain
