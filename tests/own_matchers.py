"""Matchers as users write them, some of them bad, for the tests of sweeps."""

from dataclasses import replace

import numpy as np

from phasemark.matcher.match import Match

NOT_CALLABLE = 1


def nearest_to_mean(frames):
    """A matcher that looks at the mean range only; good enough to be judged."""
    return [
        Match(class_name="cone", accepted=True, distance_m=float(np.nanmean(frames.range_m[k])) + 0.1, delta_rad=0.5)
        for k in range(len(frames))
    ]


class Fails:
    """Works for some batches, then raises or answers NaN; the number of calls is the test's."""

    left = 0

    def __init__(self, badly):
        self.badly = badly

    def __call__(self, frames):
        if Fails.left == 0:
            return self.badly(frames)
        Fails.left -= 1
        return nearest_to_mean(frames)


def no_luck(frames):
    raise ZeroDivisionError("no luck")


def nan_view(frames):
    return [Match(class_name="cone", accepted=True) for _ in range(len(frames))]


fails = Fails(no_luck)
turns_nan = Fails(nan_view)


def off_by_3_mm(frames):
    return [replace(match, distance_m=match.distance_m + 0.003) for match in nearest_to_mean(frames)]
