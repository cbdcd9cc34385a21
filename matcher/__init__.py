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
from phasemark.matcher.match import Candidate, Match, Matches
from phasemark.matcher.matcher import Matcher, background_image

__all__ = [
    "Candidate",
    "FilteredFrames",
    "Match",
    "Matcher",
    "Matches",
    "PixelKalman",
    "PixelState",
    "background_image",
    "kalman",
    "kalman_filter",
    "kalman_step",
    "phasor_mean",
]
