"""Match a recording batch by batch, and keep its estimates as a table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from phasemark.data.files.csv_cell import csv_text, nine_digits
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.match import Match, Matches, named_in_degrees, scale_of_degrees
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.recordings.direct_positions import DirectPositions
from phasemark.matcher.recordings.motion_spread import with_motion_spread
from phasemark.render import Frames

POSITIONS_AT_ONCE = 256
"""Largest batch: as many answers as a reader of the output waits for."""


@dataclass(frozen=True, eq=False)
class MatchedBatch:
    """The answers to some positions of a recording.

    Parameters
    ----------
    start : int
        Number of the first position.
    filtered : FilteredFrames, or DirectPositions of a log of a direct sensor
    matches : Matches
    """

    start: int
    filtered: FilteredFrames | DirectPositions
    matches: Matches


def match_in_batches(
    matcher: Matcher,
    positions: Frames | DirectPositions,
    filter_frames: Callable[[Frames], FilteredFrames],
    *,
    at_once: int = POSITIONS_AT_ONCE,
) -> Iterator[MatchedBatch]:
    """Filter and match the positions of a recording in batches; the answers do not depend on the size of a batch.

    Of a position during which something moved, covariances hold how far
    (:func:`~phasemark.matcher.recordings.motion_spread.with_motion_spread`).

    Parameters
    ----------
    matcher : Matcher
    positions : Frames or DirectPositions
        n positions; of a moving camera, ``frames.each_a_position()``.
    filter_frames : callable
        For instance :func:`~phasemark.matcher.kalman_filter`; histograms and targets are not filtered.
    at_once : int
        Positions in a batch.

    Yields
    ------
    MatchedBatch
    """
    for start in range(0, len(positions), at_once):
        some = positions[start : start + at_once]
        if isinstance(some, DirectPositions):
            yield MatchedBatch(start, some, matcher.match(some.frames))
        else:
            filtered = filter_frames(some)
            read = matcher.read_out(filtered)
            matches = with_motion_spread(matcher, some, filter_frames, filtered, matcher.match(read))
            yield MatchedBatch(start, read, matches)


class EstimateTable:
    """Estimates of the positions of a recording as comma-separated values.

    Columns: index, time_s (the stamp as it was read), pose_time_s (the time that the pose belongs to,
    :func:`~phasemark.matcher.filters.stamps.pose_times_s`), class, accepted; each parameter of the view that was
    estimated (`distance_m`, `delta_deg`, `bearing_deg`, `height_m`) with its standard deviation (`distance_std_m`,
    `delta_std_deg`, …); the correlation of each pair (`corr_distance_delta`, …); chi2, dof, p_value, reason. A cell is
    empty where there is nothing to say.

    Parameters
    ----------
    free : sequence of str
        The parameters that were estimated, in the order of the covariance.
    pose_time_s : sequence of float, optional
        Of each position.
    """

    def __init__(self, free: Sequence[str], pose_time_s: Sequence[float] | None = None) -> None:
        self._free, self._pose_time_s = tuple(free), pose_time_s
        names = [named_in_degrees(parameter).rsplit("_", 1) for parameter in free]
        header: list[object] = ["index", "time_s", "pose_time_s", "class", "accepted"]
        for name, unit in names:
            header += [f"{name}_{unit}", f"{name}_std_{unit}"]
        header += [f"corr_{a}_{b}" for (a, _), (b, _) in combinations(names, 2)]
        self._rows = [[*header, "chi2", "dof", "p_value", "reason"]]

    def add(self, batch: MatchedBatch) -> None:
        """Add the answers of a batch.

        Parameters
        ----------
        batch : MatchedBatch
        """
        times = batch.filtered.time_s
        for k, match in enumerate(batch.matches):
            index = batch.start + k
            time_s = None if times is None else float(times[k])
            pose_time_s = None if self._pose_time_s is None else self._pose_time_s[index]
            named = match.class_name or "", "true" if match.accepted else "false"
            test = match.chi2, match.dof, match.p_value, getattr(match, "reason", None)
            self._rows.append([index, time_s, pose_time_s, *named, *self._numbers(match), *test])

    def to_csv(self) -> str:
        """Return the table with its header."""
        return csv_text([nine_digits(value) for value in row] for row in self._rows)

    def _numbers(self, match: Match) -> list[float]:
        """Return each parameter of a match with its standard deviation, and their correlations."""
        size = len(self._free)
        values, std, correlation = np.full(size, np.nan), np.full(size, np.nan), np.full((size, size), np.nan)
        if match.class_name is not None:
            values = np.array([getattr(match, name) for name in self._free])
            if match.covariance is not None:
                std = np.sqrt(np.maximum(np.diag(match.covariance), 0.0))
                scale = np.outer(std, std)
                np.divide(match.covariance, scale, out=correlation, where=scale > 0)
        unit = np.array([scale_of_degrees(name) for name in self._free])
        pairs = np.stack([unit * values, unit * std], axis=1).ravel().tolist()
        return [*pairs, *correlation[np.triu_indices(size, 1)].tolist()]
