"""Match a recording batch by batch, and keep its estimates as a table."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from phasemark.data.files.csv_cell import as_cell
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.match import Match, Matches
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.recordings.direct_positions import DirectBatch
from phasemark.render import Frames

POSITIONS_AT_ONCE = 256
"""Largest batch: as many answers as a reader of the output waits for."""

_DEGREES = 180 / math.pi
_COLUMNS = {
    "distance_m": ("distance", "_m", 1.0),
    "delta_rad": ("delta", "_deg", _DEGREES),
    "bearing_rad": ("bearing", "_deg", _DEGREES),
    "height_m": ("height", "_m", 1.0),
    "pitch_rad": ("pitch", "_deg", _DEGREES),
    "roll_rad": ("roll", "_deg", _DEGREES),
}
"""Parameters of a view: name, unit and scale of their columns."""


@dataclass(frozen=True, eq=False)
class MatchedBatch:
    """The answers to some positions of a recording.

    Parameters
    ----------
    start : int
        Number of the first position.
    filtered : FilteredFrames
    matches : Matches
    """

    start: int
    filtered: FilteredFrames
    matches: Matches


def match_in_batches(
    matcher: Matcher,
    frames: Frames,
    filter_frames: Callable[[Frames], FilteredFrames],
    *,
    at_once: int = POSITIONS_AT_ONCE,
) -> Iterator[MatchedBatch]:
    """Filter and match the positions of a recording in batches; the answers do not depend on the size of a batch.

    Parameters
    ----------
    matcher : Matcher
    frames : Frames
        n positions; of a moving camera, ``frames.each_a_position()``.
    filter_frames : callable
        For instance :func:`~phasemark.matcher.kalman_filter`.
    at_once : int
        Positions in a batch.

    Yields
    ------
    MatchedBatch
    """
    for start in range(0, len(frames), at_once):
        filtered = matcher.read_out(filter_frames(frames[start : start + at_once]))
        yield MatchedBatch(start, filtered, matcher.match(filtered))


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
        self._text = io.StringIO()
        self._writer = csv.writer(self._text, lineterminator="\n")
        header = ["index", "time_s", "pose_time_s", "class", "accepted"]
        for name, unit, _ in (_COLUMNS[parameter] for parameter in self._free):
            header += [f"{name}{unit}", f"{name}_std{unit}"]
        header += [f"corr_{_COLUMNS[a][0]}_{_COLUMNS[b][0]}" for a, b in combinations(self._free, 2)]
        self._writer.writerow([*header, "chi2", "dof", "p_value", "reason"])

    def add(self, batch: MatchedBatch | DirectBatch) -> None:
        """Add the answers of a batch.

        Parameters
        ----------
        batch : MatchedBatch or DirectBatch
        """
        times = batch.filtered.time_s
        for k, match in enumerate(batch.matches):
            index = batch.start + k
            stamps = [
                math.nan if times is None else float(times[k]),
                math.nan if self._pose_time_s is None else self._pose_time_s[index],
            ]
            self._writer.writerow([index, *map(_cell, stamps), *self._cells(match)])

    def to_csv(self) -> str:
        """Return the table with its header."""
        return self._text.getvalue()

    def _cells(self, match: Match) -> list[str | int]:
        size = len(self._free)
        values, std, correlation = np.full(size, np.nan), np.full(size, np.nan), np.full((size, size), np.nan)
        if match.class_name is not None:
            values = np.array([getattr(match, name) for name in self._free])
            if match.covariance is not None:
                std = np.sqrt(np.maximum(np.diag(match.covariance), 0.0))
                scale = np.outer(std, std)
                np.divide(match.covariance, scale, out=correlation, where=scale > 0)
        cells: list[str | int] = [as_cell(match.class_name or ""), "true" if match.accepted else "false"]
        for k, parameter in enumerate(self._free):
            scale_to_unit = _COLUMNS[parameter][2]
            cells += [_cell(scale_to_unit * values[k]), _cell(scale_to_unit * std[k])]
        cells += [_cell(correlation[a, b]) for a, b in combinations(range(size), 2)]
        return [*cells, _cell(match.chi2), match.dof, _cell(match.p_value), getattr(match, "reason", None) or ""]


def _cell(value: float) -> str:
    return f"{value:.9g}" if math.isfinite(value) else ""
