"""From one frame to the next: a refinement from the expected view, and a full search where there is none."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.filters.kalman_filters import kalman_filter
from phasemark.matcher.live.search_beside import Searched, Searches
from phasemark.matcher.match import TOLERANCE_M, TOLERANCE_RAD, Match
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.sequence.odometry import Reading
from phasemark.matcher.sequence.pose_estimator import Estimate, PoseEstimator
from phasemark.render import Frames

_SHOWS_IT = ("", "undetermined", "ambiguous")
"""Reasons of answers that show the landmark where it was expected."""
_MOST_VIEWS = 4
"""Expected views that a frame is matched from: each costs a refinement."""
_CHECKED_S = 5.0
"""A step of the stamps that is longer is a jump of the clock."""


@dataclass(frozen=True, eq=False)
class Located:
    """Pose at the time of a frame, and how it came about.

    Parameters
    ----------
    estimate : Estimate
    match : Match or None
        Answer of the matcher for this frame.
    filtered : FilteredFrames or None
        The frame as it was matched.
    tracked : bool
        Whether it was matched from an expected view, not searched.
    searched : int or None
        Number of the earlier frame whose full search was used.
    note : str
        What was noticed: a jump of the clock.
    aged_s : float
        By how much the pose is older than the frame's stamp, beside the delay of the sensor.
    stuck : tuple of str
        Sensors of a rig that repeat what they measured before the robot moved: they were left out.
    """

    estimate: Estimate
    match: Match | None
    filtered: FilteredFrames | None
    tracked: bool = False
    searched: int | None = None
    note: str = ""
    aged_s: float = 0.0
    stuck: tuple[str, ...] = ()


class Locator(Protocol):
    """Interface of what finds a pose in a frame: a landmark's :class:`Tracker`, or a map's :class:`MapTracker`."""

    def locate(self, frames: Any, stamp_s: float) -> Located:
        """Return the pose at the time of one frame of the source; stamps run forward but for jumps."""

    def warm(self) -> None:
        """Compile and make what the first frame needs."""

    def close(self) -> None:
        """End what runs beside."""


def step_between(before_s: float | None, stamp_s: float) -> tuple[float, bool, str]:
    """Return the time between two stamps, whether it is a jump that makes the pose unknown, and what is wrong."""
    step_s = 0.0 if before_s is None else stamp_s - before_s
    if not -1.0 < step_s <= _CHECKED_S:
        return 0.0, True, f"the source's clock jumps by {step_s:.1f} s" if step_s < 0 else ""
    return max(step_s, 0.0), False, "" if step_s >= 0 else f"a stamp runs back by {-step_s:.3f} s"


class Tracker:
    """Follows the pose before a landmark from frame to frame.

    A frame is matched from the views that are expected of it: those of all poses that are followed. A full search runs
    in turn beside that, and at once while nothing is expected or that fails. A view that it finds elsewhere is one that
    the next frame is matched from, too, and wins if it explains that frame better. Where
    a search renders nothing, every frame is searched.

    Parameters
    ----------
    matcher : Matcher
        With the method "refine".
    estimator : PoseEstimator
    searches : Searches
        What searches in turn.
    delay_s : float, optional
        Added to stamps to get the time of a pose; unless given that of the bank's sensor.
    search_after_s : float
        A frame is searched where tracking has failed for longer.
    """

    def __init__(
        self,
        matcher: Matcher,
        estimator: PoseEstimator,
        searches: Searches,
        *,
        delay_s: float | None = None,
        search_after_s: float = 0.15,
    ) -> None:
        self.matcher, self.estimator = matcher, estimator
        self.delay_s = matcher.bank.sensor.delay_s if delay_s is None else delay_s
        self._searches, self._search_after_s = searches, search_after_s
        self._last: Match | None = None
        self._stamp_s: float | None = None
        self._tracked_s = -math.inf
        self._number = -1
        self._expected_at: dict[int, tuple[float, float, float]] = {}

    def locate(self, frames: Frames, stamp_s: float, reading: Reading | None = None) -> Located:
        """Return the pose at the time of a frame.

        Parameters
        ----------
        frames : Frames
            One position with one frame.
        stamp_s : float
            Its stamp.
        reading : Reading, optional
            Odometry since the frame before.
        """
        self._number += 1
        note = self._move(stamp_s, reading)
        filtered = kalman_filter(frames)
        expected = self._expected()
        if self.matcher.is_quick:
            answer = self.matcher.match(filtered)[0]
            return Located(self.estimator.see(answer), answer, filtered, note=note)
        match = self.matcher.track(filtered, expected) if expected else None
        tracked = match is not None and match.reason in _SHOWS_IT
        self._tracked_s = stamp_s if tracked else self._tracked_s
        is_overdue = stamp_s - self._tracked_s > self._search_after_s
        self._searches.offer(self._number, filtered, urgent=is_overdue)
        searched = self._searches.answer(self._number)
        if searched is not None and searched.frame == self._number:
            match = match if tracked else searched.match
        elif searched is not None and (beside := self._found_beside(searched, expected)):
            match = self.matcher.track(filtered, expected + beside)
            tracked = match.reason in _SHOWS_IT
        estimate = self.estimator.see(match)
        if match is not None and match.covariance is not None and estimate.used:
            self._last = match
        if expected:
            self._expected_at[self._number] = self._view_of(expected[0])
        for old in [number for number in self._expected_at if number < self._number - 256]:
            del self._expected_at[old]
        return Located(estimate, match, filtered, tracked, None if searched is None else searched.frame, note)

    def warm(self) -> None:
        """Match a rendered frame, and track it: kernels and tables are there before the first frame is."""
        bank = self.matcher.bank
        middle = float(np.median(bank.distance_m))
        frames = _example(self.matcher, middle)
        match = self.matcher.match(frames)[0]
        near = replace(match, class_name=bank.classes[0], distance_m=middle, delta_rad=0.0, symmetry=1)
        self.matcher.track(frames, [near])

    def close(self) -> None:
        """End the searches beside."""
        self._searches.close()

    def _move(self, stamp_s: float, reading: Reading | None) -> str:
        """Let time pass up to a stamp, and return what is wrong with it; a jump of the clock forgets the pose."""
        step_s, jumps, note = step_between(self._stamp_s, stamp_s)
        if jumps:
            self.estimator.forget()
            self._tracked_s = -math.inf
        elif self._stamp_s is not None:
            self.estimator.move(reading or Reading(0.0, 0.0, step_s))
            stamp_s = max(stamp_s, self._stamp_s)
        self._stamp_s = stamp_s
        return note

    def _expected(self) -> list[Match]:
        """Return the views that are expected, as answers like the last one."""
        if self._last is None:
            return []
        views = self.estimator.expected_views()[:_MOST_VIEWS]
        return [self._moved(self._last, view) for view in views if view[0] > 0]

    def _moved(self, match: Match, view: tuple[float, float, float]) -> Match:
        """Return an answer with another view; what is not estimated stays as it is."""
        own: dict[str, Any] = {name: value for name, value in zip(_VIEW, view, strict=True) if name in match.free}
        behind = match.background
        if behind is not None and behind.wall_m is not None:
            behind = replace(behind, wall_m=max(behind.wall_m + view[0] - match.distance_m, view[0] + 0.05))
        return replace(match, **own, background=behind)

    def _found_beside(self, searched: Searched, expected: list[Match]) -> list[Match]:
        """Return the view that a search of an earlier frame found, moved on, unless it is expected anyway."""
        found, then = searched.match, self._expected_at.get(searched.frame)
        if found.class_name is None or found.reason not in ("", "ambiguous"):
            return []
        if then is None or not expected:
            return [found]
        now, view = self._view_of(expected[0]), self._view_of(found)
        if self._last is not None and self._last.class_name == found.class_name and found.accepted:
            self._last = replace(self._last, systematic=found.systematic)
        turn = math.remainder(view[1] - then[1], math.tau / found.symmetry)
        if abs(view[0] - then[0]) < TOLERANCE_M and abs(turn) < TOLERANCE_RAD:
            return []
        return [
            self._moved(found, (view[0] + now[0] - then[0], view[1] + now[1] - then[1], view[2] + now[2] - then[2]))
        ]

    @staticmethod
    def _view_of(match: Match) -> tuple[float, float, float]:
        return match.distance_m, match.delta_rad, match.bearing_rad


_VIEW = ("distance_m", "delta_rad", "bearing_rad")


def _example(matcher: Matcher, distance_m: float) -> FilteredFrames:
    """Return a noise-free frame of the first landmark of a bank, a metre before a wall."""
    from phasemark.render import Background, Renderer

    bank = matcher.bank
    mesh = bank.mesh(bank.classes[0])
    image = Renderer(mesh, bank.sensor, albedo=float(mesh.metadata["albedo"])).render(
        distance_m, 0.0, background=Background(wall_m=distance_m + 1.0)
    )
    range_m = image.range_m.reshape(1, 1, bank.sensor.rows, bank.sensor.cols)
    light: dict[str, Any] = {}
    if bank.sensor.kind != "direct":
        light["amplitude_e"] = np.abs(image.phasor).reshape(range_m.shape)
        light["intensity_e"] = image.intensity.reshape(range_m.shape)
    return kalman_filter(Frames(range_m, **light, sensor=bank.sensor))
