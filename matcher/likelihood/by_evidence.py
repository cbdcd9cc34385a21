"""Maximum likelihood before whatever stands behind the landmark: nothing, wall and floor, or unknown things."""

from __future__ import annotations

from functools import cached_property
from typing import Any, Literal

import numpy as np

from phasemark.data import Bank
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.frequencies import layers_of
from phasemark.matcher.likelihood.likelihood_matcher import LikelihoodMatcher
from phasemark.matcher.match import Match

__all__ = ["MatcherByEvidence"]

_MISFITS = ("poor fit", "no landmark")
"""Reasons of a refusal that another background may mend."""
_Behind = Literal["auto", "unknown"]


class MatcherByEvidence:
    """Matches each frame before nothing, and where that does not explain it, before more.

    A wall and a floor are tried before unknown things, which explain almost any frame and hide what a landmark is not.
    The ranges that a chip reports are those of single surfaces: what stands behind the landmark changes none of them,
    and is left to unknown things at once.

    Parameters
    ----------
    bank : Bank
    **arguments
        As for :class:`~phasemark.matcher.likelihood.likelihood_matcher.LikelihoodMatcher`, but the background.
    """

    def __init__(self, bank: Bank, **arguments: Any) -> None:
        self._bank, self._arguments = bank, arguments
        on_ranges = arguments["on"] == "ranges"
        chip = on_ranges and bank.sensor.histogram is not None
        self._first = self._matcher("unknown" if chip else None)
        self.free = self._first.free
        self._others: tuple[_Behind, ...] = ()
        if not chip and layers_of(bank) is None:
            self._others = ("auto", "unknown") if on_ranges else ("auto",)

    def _matcher(self, background: _Behind | None) -> LikelihoodMatcher:
        return LikelihoodMatcher(self._bank, **{**self._arguments, "background": background})

    @cached_property
    def _further(self) -> list[LikelihoodMatcher]:
        """The matchers before more, made when a frame first asks for them."""
        return [self._matcher(background) for background in self._others]

    def match(self, frames: FilteredFrames) -> list[Match]:
        """Return one answer for each of n frames: the first that is accepted, or else the best fit."""
        answers = self._first.match(frames)
        for k in range(len(self._others)):
            left = np.array([i for i, answer in enumerate(answers) if answer.reason in _MISFITS], np.int64)
            if not left.size:
                break
            for i, other in zip(left.tolist(), self._further[k].match(frames[left]), strict=True):
                if other.accepted or (other.class_name is not None and not answers[i].p_value >= other.p_value):
                    answers[i] = other
        return answers
