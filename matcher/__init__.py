"""What the robot concludes: filters, matching, and its own position."""

from phasemark.matcher.filters import (
    FilteredFrames,
    PixelKalman,
    PixelState,
    kalman,
    kalman_filter,
    kalman_step,
    phasor_mean,
)

__all__ = [
    "FilteredFrames",
    "PixelKalman",
    "PixelState",
    "kalman",
    "kalman_filter",
    "kalman_step",
    "phasor_mean",
]
