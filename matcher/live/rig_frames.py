"""Frames of a rig of several sensors: lines that name their sensor, and recordings replayed stop by stop."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from phasemark import InputFileError, UsageError
from phasemark.data.measured.board_prints import of_object, plain
from phasemark.matcher.live.sources import LONGEST_LINE, Arrival, Replay, StreamSource
from phasemark.matcher.live.streams import Lines, Stream, open_stream
from phasemark.matcher.locate import Rig, RigRecording, read_rig_recording
from phasemark.matcher.locate.recording import rig_recording

_SILENT_FRAMES = 20
"""Frames after which a sensor that none has named is missed."""
_MOST_OTHER_LINES = 256
"""Lines that are not a sensor's before the first one that is."""
_OFTEN, _LINES = 3, 100
"""How often among some lines a sensor is named that the rig lacks and that is no garbled name."""
_BETWEEN_STOPS_S = 1.0
"""Time between stops whose recording has none."""


class RigLines(StreamSource):
    """Lines of JSON, each the zones of one sensor: ``sensor``, ``distances`` in mm; ``status``, ``t_ms`` if known.

    Lines with the same time are a frame, without times those up to a sensor that comes again. ``odometry``, [x_m, y_m,
    yaw_deg], may be on any of them.

    Parameters
    ----------
    stream : Stream
    rig : Rig
    """

    def __init__(self, stream: Stream, rig: Rig) -> None:
        super().__init__(stream)
        self._rig, self._heard, self._n_frames = rig, set[str](), 0
        self._unknown, self._n_lines = Counter[str](), 0
        rows = [rows for rows, _ in rig.rows()]
        self._zones = dict(zip(rig.names, zip(rows, rig.numbers().columns.tolist(), strict=True), strict=True))

    def _parsed(self, lines: Lines) -> Iterator[Arrival]:
        held: dict[str, dict[str, Any]] = {}
        n_other = 0
        while line := lines.readline(LONGEST_LINE):
            text = plain(line)
            if not text.startswith("{"):
                n_other += 1
                if n_other == _MOST_OTHER_LINES and not self._heard:
                    raise UsageError(
                        f"{self.name}: none of {n_other} lines is JSON with 'sensor' and 'distances', as of a rig"
                    )
                continue
            try:
                row = self._row(text)
                if row["sensor"] in held or any(one["time_s"] != row["time_s"] for one in held.values()):
                    yield self._frame(held)
                    held = {}
                held[row["sensor"]] = {**row, "received_s": lines.received_s}
                if len(held) == len(self._rig.names):
                    yield self._frame(held)
                    held = {}
            except InputFileError as error:
                held = {}
                self.spoilt(str(error))
        if held and not lines.is_stopped:  # the last frame lacks a sensor
            try:
                yield self._frame(held)
            except InputFileError as error:
                self.spoilt(str(error))

    def _row(self, text: str) -> dict[str, Any]:
        """Return what a line holds: the sensor, zones in metres, their status, a time and the odometry, if any."""
        printed = of_object(0, text)
        if printed.damage:
            raise InputFileError(f"{self.name}: {printed.damage}")
        self._n_lines += 1
        if self._n_lines % _LINES == 0:
            self._unknown.clear()
        given = json.loads(text)
        name, odometry = given.get("sensor"), given.get("odometry")
        if not isinstance(name, str) or name not in self._zones:
            wrong = f"{self.name}: frames name the sensor {name!r}, the rig has {', '.join(self._rig.names)}"
            self._unknown[repr(name)] += 1
            raise UsageError(wrong) if self._unknown[repr(name)] == _OFTEN else InputFileError(wrong)  # garbled
        n, (rows, columns) = len(printed.distance_mm), self._zones[name]
        if n not in (columns, rows * columns):
            raise InputFileError(f"{self.name}: {n} zones, the sensor has {rows} × {columns}")
        if odometry is not None:
            try:
                odometry = np.array(odometry, np.float64).reshape(3) * [1, 1, np.radians(1)]
            except (TypeError, ValueError, OverflowError):
                raise InputFileError(f"{self.name}: 'odometry' must be [x_m, y_m, yaw_deg]") from None
        shape = (n,) if n == columns else (rows, columns)
        most = np.max(list(self._zones.values()), axis=0)[-len(shape) :]
        own = tuple(slice(size) for size in shape)
        zones, status = np.full(most, np.nan), np.full(most, self._rig.reduction.valid_status[0])
        zones[own] = 1e-3 * np.reshape(printed.distance_mm, shape)
        if printed.status:
            status[own] = np.reshape(printed.status, shape)
        return {"sensor": name, "z_m": zones, "status": status, "time_s": printed.time_s, "odometry": odometry}

    def _frame(self, held: dict[str, dict[str, Any]]) -> Arrival:
        """Return lines of several sensors as one frame, invalid where a sensor sent nothing."""
        names, last = self._rig.names, list(held.values())[-1]
        self._heard |= held.keys()
        self._n_frames += 1
        if self._n_frames >= _SILENT_FRAMES and (silent := [name for name in names if name not in self._heard]):
            raise UsageError(
                f"{self.name}: none of {self._n_frames} frames names the rig's sensor {', '.join(silent)}, they name"
                f" {', '.join(self._heard)}"
            )
        with_rows = next((row["z_m"].shape for row in held.values() if row["z_m"].ndim == 2), None)
        for name, row in held.items():
            if with_rows is not None and row["z_m"].ndim == 1 and self._zones[name][0] == 1:
                row["z_m"] = np.pad(row["z_m"][None], ((0, with_rows[0] - 1), (0, 0)), constant_values=np.nan)
                row["status"] = np.broadcast_to(row["status"], with_rows)
        if len({row["z_m"].shape for row in held.values()}) > 1:
            raise InputFileError(f"{self.name}: sensors of a frame have different numbers of zones")
        missing = {"z_m": np.full(last["z_m"].shape, np.nan), "status": last["status"]}
        arrays = {key: np.array([[[held.get(name, missing)[key] for name in names]]]) for key in missing}
        stamp = time.time() if last["time_s"] is None else last["time_s"]
        arrays |= {"sensor": np.array(names), "frame_time_s": np.array([stamp])}
        odometry = next((row["odometry"] for row in reversed(held.values()) if row["odometry"] is not None), None)
        if odometry is not None:
            axes = ("odometry_x_m", "odometry_y_m", "odometry_yaw_rad")
            arrays |= {key: np.array([value]) for key, value in zip(axes, odometry, strict=True)}
        return Arrival(rig_recording(arrays, Path(self.name), self._rig), last["received_s"])


class RecordedRig(Replay):
    """Recording of a rig, stop by stop.

    Parameters
    ----------
    path : Path
    rig : Rig
    in_time : bool

    Raises
    ------
    InputFileError
        It cannot be read, lacks a sensor of the rig, or has several robots.
    """

    def __init__(self, path: Path, rig: Rig, *, in_time: bool) -> None:
        super().__init__(str(path), in_time)
        found = read_rig_recording(path, rig)
        robots = np.unique(found.robot)
        if len(robots) > 1:
            raise InputFileError(f"{path}: has robots {', '.join(map(str, robots))}, must be of one that is followed")
        if (np.diff(found.time_s[:, 0]) <= 0).any():
            step_s = float(np.ptp(found.time_s, axis=1).max()) + _BETWEEN_STOPS_S
            found = replace(found, time_s=found.time_s + step_s * np.arange(len(found))[:, None])
        self.recording: RigRecording = found

    def recorded(self) -> Iterator[tuple[RigRecording, float | None]]:
        """Yield the stops."""
        for k in range(len(self.recording)):
            yield self.recording.one(k), float(self.recording.time_s[k, 0])


def open_rig_source(name: str, rig: Rig, *, in_time: bool = True) -> RigLines | RecordedRig:
    """Return the source of a rig's frames that a name stands for: a stream of lines, or a recording (.npz).

    Raises
    ------
    UsageError, InputFileError
        There is no source of this name, or the recording cannot be read.
    """
    stream = open_stream(name)
    if stream is not None:
        return RigLines(stream, rig)
    if "://" in name:
        raise UsageError(f"{name}: a rig's source must begin with serial://, tcp:// or udp://, or be a file")
    return RecordedRig(Path(name), rig, in_time=in_time)
