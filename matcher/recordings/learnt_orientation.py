"""Orientation of a recording, learnt from frames that show the landmark.

The orientation is one for all frames. Each frame is matched in each orientation, and the costs of the best fits are
added. A frame that no orientation explains says nothing. One that some explain says at most `_MOST_ODDS`, so that no
frame decides alone, and a misfit of the best fits weakens all of it: errors of the model are alike in frames of one
view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data.measured.recording import ORIENTATIONS, Orientation
from phasemark.matcher.filters.kalman_filters import kalman_filter
from phasemark.matcher.match import Match
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.pixel_agreement import DISAGREEMENT
from phasemark.render import Frames

DECISIVE_ODDS = 1e4
"""Odds against an orientation from which it is excluded."""
_MOST_ODDS = 1e3
_UNEXPLAINED = ("no landmark", "poor fit", "outside the bank")


@dataclass(frozen=True, eq=False)
class LearntOrientation:
    """Orientations of a recording with their odds.

    Parameters
    ----------
    orientations : tuple of Orientation
        The most probable one first.
    log_odds : (orientations,) float64
        Natural logarithm of the odds of the first against each.
    n_frames : int
        Frames that were matched.
    n_explained : int
        Frames that some orientation explains.
    """

    orientations: tuple[Orientation, ...]
    log_odds: NDArray[np.float64]
    n_frames: int
    n_explained: int

    @property
    def left(self) -> tuple[Orientation, ...]:
        """Orientations that are not excluded; one if the recording decides."""
        return tuple(
            orientation
            for orientation, log_odds in zip(self.orientations, self.log_odds, strict=True)
            if log_odds < math.log(DECISIVE_ODDS)
        )


def learn_orientation(matcher: Matcher, frames: Frames, *, n_frames: int = 10) -> LearntOrientation:
    """Learn how a recording of the landmark has to be mirrored and turned.

    Parameters
    ----------
    matcher : Matcher
        Of the method "refine", on ranges or phasors.
    frames : Frames
        The recording, every frame of which is matched by itself.
    n_frames : int
        Largest number of frames to match, evenly spaced.

    Returns
    -------
    LearntOrientation

    Raises
    ------
    UsageError
        The matcher is of another kind.
    """
    if matcher.method != "refine" or matcher.options["on"] not in ("ranges", "reported", "phasors"):
        raise UsageError("an orientation is learnt by a Matcher of the method 'refine' on ranges or phasors")
    each = frames.each_a_position()
    chosen = np.unique(np.linspace(0, len(each) - 1, min(n_frames, len(each))).round().astype(np.int64))
    filtered = kalman_filter(each[chosen])
    square = frames.sensor.rows == frames.sensor.cols
    orientations = [one for one in ORIENTATIONS if square or one.rotate in (0, 180)]
    doubt = log_odds = np.zeros(len(orientations))
    left, n_explained = np.arange(len(orientations)), 0
    fits: list[list[Match]] = [[] for _ in orientations]
    at_once = 3  # frames that are matched before orientations are given up that no further frame would bring back
    rounds = math.ceil(len(chosen) / at_once)
    for start in range(rounds):
        some = filtered[start::rounds]
        matches = [list(matcher.match(some.with_pixels(orientations[k].apply))) for k in left]
        explained = np.array([[match.reason not in _UNEXPLAINED for match in row] for row in matches])
        cost = _costs(matches)
        of_use = explained.any(axis=0)
        n_explained += int(of_use.sum())
        cost = cost[:, of_use] - cost[:, of_use].min(axis=0)
        doubt[left] += np.minimum(cost / 2, math.log(_MOST_ODDS)).sum(axis=1)
        for k, row in zip(left, matches, strict=True):
            fits[k] += row
        doubt[left] -= doubt[left].min()
        log_odds = doubt / _misfit(fits[left[doubt[left].argmin()]])
        left = left[log_odds[left] < math.log(DECISIVE_ODDS * _MOST_ODDS)]
    order = np.argsort(log_odds, kind="stable")
    return LearntOrientation(tuple(orientations[k] for k in order), log_odds[order], len(chosen), n_explained)


def _costs(matches: Sequence[Sequence[Match]]) -> NDArray[np.float64]:
    """Return the cost of each fit, (orientations, frames); pixels that only other fits count disagree with it."""
    chi2 = np.array([[match.chi2 for match in row] for row in matches])
    dof = np.array([[match.dof for match in row] for row in matches], dtype=np.float64)
    none = ~np.isfinite(chi2)
    cost = np.where(none, 0.0, chi2) + DISAGREEMENT * (dof.max(axis=0) - np.where(none, 0.0, dof))
    return np.asarray(cost, dtype=np.float64)


def _misfit(matches: Sequence[Match]) -> float:
    """Return how much larger the squared residuals of some fits are than noise makes them, at least 1."""
    fits = [match for match in matches if match.reason not in _UNEXPLAINED and match.dof]
    return max(1.0, sum(match.chi2 for match in fits) / max(1, sum(match.dof for match in fits)))
