"""The command ``phasemark match``: measured frames against a bank."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from phasemark import InputFileError, UsageError
from phasemark.data.commands.command import Shown, stated_flags
from phasemark.data.commands.console import LongWork, Table, echo, echo_facts, echo_json, one_line, tell
from phasemark.data.commands.inputs import note_too_far, open_any_bank
from phasemark.data.commands.options import FrameReading
from phasemark.data.commands.outputs import refuse_unwritable_files, write_figure, write_file
from phasemark.matcher.commands.diagnosis_flags import diagnosis_text
from phasemark.matcher.commands.match_options import Landmark, Place, Results, Search, check_delay
from phasemark.matcher.commands.match_table import Columns, bank_ends, match_rows, summary

if TYPE_CHECKING:
    from phasemark.data.measured.recording import Orientation
    from phasemark.matcher import FilteredFrames, Match, Matcher
    from phasemark.matcher.position.landmark_map import LandmarkMap
    from phasemark.matcher.recordings.direct_positions import DirectPositions
    from phasemark.matcher.recordings.estimates_table import MatchedBatch
    from phasemark.render import Frames


NEAREST_AT_ONCE, REFINED_AT_ONCE = 256, 64
"""Positions matched before their answers are printed; refinement takes up to 50 ms each."""


def match_frames(
    bank: Annotated[Path, Shown(metavar="BANK|MESH|CLASS")],
    frames: Path,
    *,
    reading: FrameReading,
    landmark: Landmark,
    search: Search,
    place: Place,
    moving: bool = False,
    delay_ms: Annotated[float | None, Shown(metavar="MS")] = None,
    learn_orientation: bool = False,
    results: Results,
) -> None:
    """Match measured frames against a bank, and place the robot.

    All frames of a file are averaged: the camera stands still. A file of shape (n, frames, rows, cols) has n positions.
    With --moving every frame is a position of its own. A CSV file may have a header that names its columns: t_ms or
    t_s, mm_0 ... (or range_0 ..., z_0 ...), status_0 ..., pitch_deg, roll_deg (the tilt of each frame); for a VL53L5CX
    or VL53L8CX give --valid-status 5. With --on histograms or --on targets FRAMES is a log of a direct sensor
    (histograms in NPZ or lines of JSON, targets in CSV with columns mm_ZONE_TARGET) or a frame set with histograms,
    whose views are positions.

    Parameters
    ----------
    bank
        A bank; or a landmark, of which a bank is built and kept.
    frames
        Measured frames: CSV, NPY, NPZ or HDF5.
    moving
        The camera moves: match every frame by itself instead of their mean.
    delay_ms
        Delay of this recording: added to the stamp of a frame to get the time of its pose; unless stated, the sensor's.
    learn_orientation
        With refine: learn from up to 10 frames how the image is mirrored and turned, then match.
    """
    place.check()
    landmark.check(bank)
    landmarks = place.landmarks()
    results.check()
    search.check()
    if delay_ms is not None:
        check_delay(delay_ms)
    if learn_orientation:
        _refuse_to_learn(reading, search)
    if search.is_direct:
        _refuse_images(reading, search, results)
    with open_any_bank(bank) if search.is_direct else landmark.opened(bank, frames, reading) as opened:
        search = search.for_bank(opened)
        matcher = search.matcher(opened)
        if search.is_direct:
            positions: Frames | DirectPositions = _direct_positions(frames, matcher, reading, moving)
        else:
            positions, reading = _positions(frames, matcher, reading, moving, learn_orientation)
            note_too_far(opened.camera, {"--wall": search.wall})
        plots = results.plots(len(positions))
        refuse_unwritable_files(results.files(plots), results.force)
        printed = _Answers(search, place, results, landmarks, plots, moving, delay_ms)
        printed.match_all(matcher, positions)
        printed.note_what_is_open(matcher)
        if results.estimates is not None:
            write_file(results.estimates, printed.estimated.to_csv(), results.force)
        printed.diagnose(matcher, reading)
        if results.as_json:
            echo_json({"bank": str(bank), "frames": str(frames), "matches": printed.answers})
        for k, path in plots.items():
            from phasemark.matcher.figures import match_figure  # matplotlib takes half a second to load

            filtered, match = printed.drawn[k]
            figure = match_figure(filtered, match, opened, search.background, reported=search.on == "reported")
            write_figure(path, figure, results.force)
    if not (results.as_json or results.as_jsonl):
        echo(*results.files(plots))
        _note_plots(plots, results.plot_index, len(positions))


def _positions(
    file: Path, matcher: Matcher, reading: FrameReading, moving: bool, learn: bool
) -> tuple[Frames, FrameReading]:
    """Return the frames of a file, and how they are read: as stated, or with the orientation that they tell."""
    from phasemark.matcher.filters.stamps import with_tilts_when_taken
    from phasemark.matcher.recordings.stillness import motion_note

    measured = reading.read(file, matcher.bank.camera)
    if learn:
        reading = replace(reading, **_learnt(matcher, measured, file))
        measured = reading.read(file, matcher.bank.camera)
    if moving:
        return with_tilts_when_taken(measured.each_a_position(), matcher.bank.sensor.delay_s), reading
    if note := motion_note([measured]):
        tell(f"note: {file}: {note}: covariances hold how far; --moving matches every frame by itself")
    return measured, reading


def _direct_positions(file: Path, matcher: Matcher, reading: FrameReading, moving: bool) -> DirectPositions:
    """Return the histograms or targets of a log."""
    from phasemark.data.plans.arrays import format_size
    from phasemark.matcher.recordings.direct_positions import read_positions

    on, camera = matcher.options["on"], matcher.bank.camera
    positions = read_positions(file, camera, on, moving=moving, valid_status=reading.valid_status)
    tell(f"note: histograms are rendered first, a table of {format_size(matcher.table_bytes)}")
    return positions


def _refuse_images(reading: FrameReading, search: Search, results: Results) -> None:
    """Refuse what is said of images of ranges, where histograms or targets are matched."""
    for option in stated_flags(replace(reading, valid_status=None)):
        raise UsageError(
            f"{option} goes with images of ranges: zones of a direct sensor's log are turned by 'zone_order' in its"
            " [histogram] table, and its units are fixed"
        )
    if results.plot is not None:
        raise UsageError(f"--plot draws ranges: leave it out with --on {search.on}")


def _refuse_to_learn(reading: FrameReading, search: Search) -> None:
    """Refuse options that contradict the learning of an orientation."""
    if search.method == "nearest" or search.is_direct:
        raise UsageError("--learn-orientation goes with --method refine, on ranges or phasors")
    if reading.flip_h or reading.flip_v or reading.rotate:
        raise UsageError("--learn-orientation finds how the image is turned: leave --flip-h, --flip-v and --rotate out")


def _learnt(matcher: Matcher, measured: Frames, file: Path) -> dict[str, Any]:
    """Return the options of reading that a recording tells, and note them."""
    from phasemark.matcher.recordings.learnt_orientation import learn_orientation

    learnt = learn_orientation(matcher, measured)
    counted = f"{learnt.n_explained} of {learnt.n_frames} frames that show the landmark"
    if len(learnt.left) > 1:
        left = ", ".join(_flags_of(one) for one in learnt.left)
        raise InputFileError(
            f"{file}: {counted} leave {len(learnt.left)} orientations open: {left}; give the right one instead of"
            " --learn-orientation, or a recording of a side of the landmark without symmetry"
        )
    odds = f"1e{learnt.log_odds[1] / math.log(10):.0f}"
    tell(f"note: {file}: the orientation is {_flags_of(learnt.left[0])}, by {counted}, with odds of {odds} to 1")
    return {"flip_h": learnt.left[0].flip_h, "rotate": learnt.left[0].rotate}


def _flags_of(orientation: Orientation) -> str:
    """Return an orientation as options."""
    turn = f"--rotate {orientation.rotate}" if orientation.rotate or not orientation.flip_h else ""
    return f"{'--flip-h' if orientation.flip_h else ''} {turn}".strip()


_OUTSIDE = "outside the bank"


@dataclass
class _Answers:
    """Matches that are printed batch by batch, and what of them is needed at the end."""

    search: Search
    place: Place
    results: Results
    landmarks: LandmarkMap | None
    plots: Mapping[int, Path]
    moving: bool
    delay_ms: float | None
    answers: list[dict[str, Any]] = field(default_factory=list)
    """All of them only for --json, whose answers are one list."""
    drawn: dict[int, tuple[FilteredFrames, Match]] = field(default_factory=dict)
    reasons: list[str] = field(default_factory=list)
    distances_m: list[float] = field(default_factory=list)
    n_mirrored: int = 0
    pose_time_s: Sequence[float] | None = None
    refused: tuple[int, FilteredFrames, Match] | None = None
    placed: Match | None = None
    table: Table | None = None
    """Its columns are those of the first match."""

    @property
    def counted(self) -> str:
        """Name of a thing that has an answer."""
        return "frame" if self.moving else "position"

    def match_all(self, matcher: Matcher, positions: Frames | DirectPositions) -> None:
        """Match all positions, and print each batch as soon as it is known."""
        from phasemark.matcher.filters.stamps import pose_times_s
        from phasemark.matcher.recordings.direct_positions import DirectPositions
        from phasemark.matcher.recordings.estimates_table import EstimateTable, match_in_batches

        n = len(positions)
        counted = self.counted if self.moving or n > 1 else None
        columns = Columns(counted, matcher.free, matcher.options["background"], self.place.is_stated)
        frames = positions.frames if isinstance(positions, DirectPositions) else positions
        stamps_s = getattr(frames, "time_s", None)
        if stamps_s is not None:
            delay_s = matcher.bank.sensor.delay_s if self.delay_ms is None else self.delay_ms / 1e3
            self.pose_time_s = pose_times_s(stamps_s, delay_s).tolist()
        elif self.delay_ms is not None:
            raise UsageError("--delay-ms is added to time stamps, and these frames have none")
        self.estimated = EstimateTable(matcher.free, self.pose_time_s)
        at_once = NEAREST_AT_ONCE if matcher.method == "nearest" else REFINED_AT_ONCE
        with LongWork("matching") if n > at_once else nullcontext() as progress:
            for batch in match_in_batches(matcher, positions, self.search.filter(), at_once=at_once):
                answers = [self._answer(batch, k) for k in range(len(batch.matches))]
                self._print(answers, batch.start, columns)
                if self.results.estimates is not None:
                    self.estimated.add(batch)
                sys.stdout.flush()
                if progress is not None:
                    progress(batch.start + len(batch.matches), n)

    def _answer(self, batch: MatchedBatch, k: int) -> dict[str, Any]:
        """Return a match of a batch as plain numbers, and note what is needed of it later."""
        from phasemark.matcher import FilteredFrames

        match, index = batch.matches[k], batch.start + k
        answer = match.as_dict()
        if batch.filtered.time_s is not None:
            answer["time_s"] = float(batch.filtered.time_s[k])
        if self.pose_time_s is not None:
            answer["pose_time_s"] = self.pose_time_s[index]
        if self.place.is_stated:
            answer["poses"] = self.place.poses(match, self.landmarks)
        self.reasons.append("" if match.accepted else match.reason or "no landmark")
        self.distances_m.append(match.distance_m)
        self.n_mirrored += bool(match.accepted and match.may_be_mirrored)
        if isinstance(batch.filtered, FilteredFrames):
            if index in self.plots:
                self.drawn[index] = batch.filtered[k : k + 1], match
            if self.placed is None and (match.accepted or match.reason == "poor fit"):
                self.placed = match
            if self.refused is None and not match.accepted:
                self.refused = index, batch.filtered[k : k + 1], match
        return answer

    def _print(self, answers: Sequence[dict[str, Any]], start: int, columns: Columns) -> None:
        widest = 88  # A single answer that is wider than this is printed one number a line.
        if self.results.as_json:
            self.answers += answers
        elif self.results.as_jsonl:
            for k, answer in enumerate(answers, start):
                echo(json.dumps({"index": k, **answer}, ensure_ascii=False, allow_nan=False))
        else:
            rows = match_rows(answers, start, columns)
            width = sum(max(len(title), len(value)) + 2 for title, value in rows[0].items())
            if self.search.on == "reported" and columns.counted is None and width > widest:
                echo_facts(rows[0])
                return
            self.table = self.table or Table(list(rows[0]))
            self.table.echo([list(row.values()) for row in rows])

    def note_what_is_open(self, matcher: Matcher) -> None:
        """Count what was accepted; say where the bank ends too early, and where images may be mirrored."""
        if len(self.reasons) > 1:
            tell(f"note: {summary(self.reasons, self.counted)}")
        if n_outside := self.reasons.count(_OUTSIDE):
            tell(
                f"note: {n_outside} {self.counted}s show views outside the bank, where no other explanation was"
                " looked for: build it over a wider range (bank info shows the range)"
            )
        inside = [d for d, reason in zip(self.distances_m, self.reasons, strict=True) if reason != _OUTSIDE]
        self._note_multipath(matcher)
        for note in bank_ends(inside, matcher.bank.distance_m.tolist(), self.counted):
            tell(f"note: {note}")
        if self.n_mirrored:
            tell(
                f"note: {self.n_mirrored} of {self._n_accepted} accepted answers may be those of images mirrored left"
                " to right, which their landmarks do not show: check it once with something held to one side (--flip-h)"
            )

    def _note_multipath(self, matcher: Matcher) -> None:
        """Tell what light that bounces off a floor does to the first answer with a place, where it is not modelled."""
        sensor = matcher.bank.sensor
        if self.placed is None or sensor.lamp_half_angle_deg is None or len(sensor.frequencies_hz) > 1:
            return
        from phasemark.matcher.accuracy import multipath_shift
        from phasemark.render.view import VIEW_FIELDS, Views

        match, views = self.placed, Views.broadcast(*(getattr(self.placed, name) for name in VIEW_FIELDS))
        renderer = matcher.renderer(match.class_name or "")
        shift = multipath_shift(renderer, views, free=match.free, background=match.background)
        if shift is not None:
            tell(f"note: {shift} (--bounces all models it)")

    @property
    def _n_accepted(self) -> int:
        return self.reasons.count("")

    def diagnose(self, matcher: Matcher, reading: FrameReading) -> None:
        """Name the setting that would make the first refused position fit."""
        from phasemark.matcher import diagnose

        search = self.search
        # among the frames of a moving camera some do not show the landmark: that needs no diagnosis
        some_right = self.moving and self._n_accepted
        if self.refused is None or self.results.no_diagnosis or some_right:
            return
        index, filtered, refused = self.refused
        try:
            found = diagnose(matcher, filtered, 0, background=search.background, refused=refused)
            diagnosis = replace(found, index=index)
        except Exception as error:  # it only comments on answers, which must not be lost
            what = f"{type(error).__name__}: {one_line(str(error))}"
            tell(f"note: frame {index} is refused, and its diagnosis failed ({what}); --no-diagnosis leaves it out")
            return
        message = diagnosis_text(diagnosis, reading, matcher.method == "nearest", search.fix == "bearing")
        tell(f"note: {message}")
        if self.results.as_json:
            self.answers[index]["diagnosis"] = {**diagnosis.as_dict(), "message": message}


def _note_plots(plots: Mapping[int, Path], chosen: str | None, n: int) -> None:
    """Note how to draw more positions than the first."""
    if plots and chosen is None and len(plots) < n:
        tell(
            f"note: drew the first of {n} positions; --plot-index 0,{n // 2}:{min(n // 2 + 9, n - 1)} draws others"
            " (some seconds each)"
        )
