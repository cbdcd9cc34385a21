"""Matchers as users write them, some of them bad, for the tests of sweeps."""

import sys
from dataclasses import replace

import numpy as np

from phasemark import UsageError
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


def returns_integers(frames):
    return [1] * len(frames)


def returns_one_too_few(frames):
    return nearest_to_mean(frames)[1:]


def returns_none(frames):
    return None


def returns_a_number(frames):
    return 5


def returns_text_for_a_distance(frames):
    return [replace(match, distance_m="1 m") for match in nearest_to_mean(frames)]


def returns_a_small_covariance(frames):
    return [replace(match, covariance=np.eye(1)) for match in nearest_to_mean(frames)]


def exits(frames):
    sys.exit("no licence")


def fails_late(frames):
    yield from nearest_to_mean(frames)[1:]
    no_luck(frames)


def raises_usage_error(frames):
    raise UsageError("of its own")


def off_by_3_mm(frames):
    return [replace(match, distance_m=match.distance_m + 0.003) for match in nearest_to_mean(frames)]
