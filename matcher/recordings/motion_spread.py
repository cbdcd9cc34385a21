"""Covariances of answers for frames during which the camera or the scene moved: they hold how far the view went."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from phasemark.matcher.estimate.acceptance import Rules, with_parts
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.match import Match, Matches
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.recordings.stillness import motion_test
from phasemark.render import Frames

_PARTS, _FALSE_ALARM = 5, 1e-3
"""Parts that the frames of a position are matched in, and the probability of that where nothing moved."""


def with_motion_spread(
    matcher: Matcher, frames: Frames, filter_frames: Callable[[Frames], FilteredFrames], matches: Matches
) -> Matches:
    """Return answers whose covariances hold how far the view moved while their frames were taken.

    Where a test finds motion, parts of the frames in a row are matched, too, and the covariance grows by the scatter
    of their views about the answer, less their own noise. An answer is refused as "undetermined" if it no longer is
    within the tolerance, and as a "poor fit" if fewer than two parts show its class.

    Parameters
    ----------
    matcher : Matcher
        On frames, not on what a direct sensor counts.
    frames : Frames
        n positions.
    filter_frames : callable
    matches : Matches
        Of these positions.
    """
    moved = motion_test(frames).p_value < _FALSE_ALARM
    return Matches(
        [
            _with_spread(matcher, frames[k : k + 1], filter_frames, match) if moved[k] and match.accepted else match
            for k, match in enumerate(matches)
        ]
    )


def _with_spread(
    matcher: Matcher, frames: Frames, filter_frames: Callable[[Frames], FilteredFrames], match: Match
) -> Match:
    ends = np.linspace(0, frames.n_frames, min(_PARTS, frames.n_frames) + 1).astype(int).tolist()
    off, noise = [], []
    for start, stop in pairwise(ends):
        one = matcher.match(filter_frames(frames.some_frames(start, stop)))[0]
        if one.class_name == match.class_name and one.reason in ("", "undetermined"):
            turn = math.remainder(one.delta_rad - match.delta_rad, math.tau / match.symmetry)
            one = replace(one, delta_rad=match.delta_rad + turn)
            off.append([getattr(one, name) - getattr(match, name) for name in matcher.free])
            if one.covariance is not None:
                noise.append(one.covariance - sum(one.systematic.values()))
    fewest = 2
    if len(off) < fewest:
        return replace(match, accepted=False, reason="poor fit")
    known, spread = match.covariance is not None, np.transpose(off) @ off / len(off)
    if noise:
        size = np.sqrt(np.mean(noise, axis=0).diagonal())
        excess, axes = np.linalg.eigh((spread - np.mean(noise, axis=0)) / np.outer(size, size))
        spread = np.outer(size, size) * ((axes * np.maximum(excess, 0.0)) @ axes.T)
    rules = Rules.of_bank(matcher.bank, matcher.free, matcher.false_alarm, matcher.tolerance_m, matcher.tolerance_rad)
    found = with_parts(rules, replace(match, covariance=match.covariance + spread if known else spread), {})
    return found if known else replace(found, covariance=None)
