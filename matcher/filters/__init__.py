"""Filters over the frames of one position."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.filters.filtered_frames import FilteredFrames, PixelState, noise_free
    from phasemark.matcher.filters.kalman_filters import PixelKalman, kalman, kalman_filter, kalman_step
    from phasemark.matcher.filters.mean_phasor import phasor_mean
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "FilteredFrames",
    "PixelKalman",
    "PixelState",
    "kalman",
    "kalman_filter",
    "kalman_step",
    "noise_free",
    "phasor_mean",
]
