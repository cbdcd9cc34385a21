"""Logs in MCAP: every frame, match and pose as JSON, and the replay of their frames, bit for bit."""

from __future__ import annotations

import json
import os
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np

from phasemark import InputFileError
from phasemark.inputs.extras import needed
from phasemark.matcher.live.sinks import Sink, open_output
from phasemark.matcher.live.sources import Replay
from phasemark.matcher.live.status import Status
from phasemark.matcher.live.updates import Update, plain_rows
from phasemark.render import Frames, Sensor

_TOPICS = ("frames", "matches", "poses", "status")
_LIBRARY = "phasemark"
_MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of a whole file."""


class McapSink(Sink):
    """Log of everything; the file is whole when the session ends, by Ctrl-C too.

    Parameters
    ----------
    name : str
    path : Path
    sensor : Sensor
        Kept in the log, as a sensor file has it.
    force : bool
        Whether an existing file may be replaced.
    """

    def __init__(self, name: str, path: Path, sensor: Sensor, *, force: bool = False) -> None:
        super().__init__(name)
        writer = needed("mcap.writer", "the sink 'mcap'", "mcap")
        self._file = open_output(path, force=force, mode="wb")
        self._writer = writer.Writer(self._file)
        self._writer.start(library=_LIBRARY)
        self._writer.add_metadata("sensor", {"json": sensor.model_dump_json(exclude_none=True)})
        self._channels = {}
        for topic in _TOPICS:
            schema = self._writer.register_schema(f"phasemark.{topic}", "jsonschema", b'{"type": "object"}')
            self._channels[topic] = self._writer.register_channel(f"/{topic}", "json", schema)

    def update(self, update: Update) -> None:
        """Write a frame with all that was concluded."""
        located = update.located
        self._write("frames", update.time_s, {"index": update.number, **_frame_dict(cast(Frames, update.frames))})
        match = {} if located.match is None else located.match.as_dict()
        self._write("matches", update.time_s, {"index": update.number, "searched": located.searched, **match})
        self._write("poses", update.time_s, update.as_dict())

    def status(self, status: Status) -> None:
        """Write the status."""
        self._write("status", time.time(), status.as_dict())

    def _write(self, topic: str, time_s: float, row: dict[str, Any]) -> None:
        now = max(int(time_s * 1e9), 0)
        data = json.dumps(row, ensure_ascii=False, allow_nan=False).encode()
        self._writer.add_message(self._channels[topic], log_time=now, publish_time=now, data=data)

    def close(self) -> None:
        """Finish the file."""
        self._writer.finish()
        self._file.close()


class McapSource(Replay):
    """Frames of a log that :class:`McapSink` wrote, with the stamps and the numbers that they had.

    Parameters
    ----------
    path : Path
    sensor : Sensor
        The camera, whose pixels the frames must have.
    in_time : bool
        Whether frames come in the rhythm of their stamps.
    """

    def __init__(self, path: Path, sensor: Sensor, *, in_time: bool) -> None:
        super().__init__(str(path), in_time)
        self._path, self._sensor = path, sensor
        self._rows = self._read("/frames")
        if not self._rows:
            raise InputFileError(f"{path}: holds no frames of a live session")

    def _read(self, topic: str) -> list[dict[str, Any]]:
        reader = needed("mcap.reader", f"{self._path}", "mcap")
        rows: list[dict[str, Any]] = []
        try:
            with open(self._path, "rb") as file:
                file.seek(-min(len(_MAGIC), self._path.stat().st_size), os.SEEK_END)
                is_whole = file.read() == _MAGIC
                file.seek(0)
                of_kind = reader.SeekingReader if is_whole else reader.NonSeekingReader
                messages = of_kind(file, validate_crcs=True).iter_messages(topics=[topic], log_time_order=False)
                rows.extend(json.loads(message.data) for _, _, message in messages)
        except OSError as error:
            raise InputFileError(f"{self._path}: cannot be read ({error.strerror})") from None
        except Exception as error:  # whatever a damaged file makes mcap and json say
            if (not rows and topic == "/frames") or is_whole or "crc" in str(error).lower():
                raise InputFileError(f"{self._path}: damaged, or no MCAP file ({str(error)[:120]})") from None
        if not is_whole:
            warnings.warn(f"{self._path}: cut off: the {len(rows)} messages of {topic} before are read", stacklevel=2)
        return rows

    def searches(self) -> dict[int, int]:
        """Return which earlier frame's full search was used with which frame."""
        rows = self._read("/matches")
        return {row["index"]: row["searched"] for row in rows if row.get("searched") is not None}

    def recorded(self) -> Iterator[tuple[Frames, float | None]]:
        """Yield the frames."""
        for row in self._rows:
            frames = _frames_of(row, self._sensor, self._path)
            yield frames, None if frames.time_s is None else float(frames.time_s.flat[0])


def _frame_dict(frames: Frames) -> dict[str, Any]:
    """Return one frame as plain numbers, each with all of its digits."""
    row: dict[str, Any] = {"stamp_s": None if frames.time_s is None else float(frames.time_s.flat[0])}
    row["range_m"] = plain_rows(frames.range_m.ravel())
    row["flags"] = frames.flags.ravel().tolist()
    for name in ("amplitude_e", "intensity_e", "tilt_rad"):
        if (values := getattr(frames, name)) is not None:
            row[name] = plain_rows(values.ravel())
    return row


def _frames_of(row: dict[str, Any], sensor: Sensor, path: Path) -> Frames:
    shape = (1, 1, sensor.rows, sensor.cols)
    try:
        arrays: dict[str, Any] = {
            name: np.array(row[name], np.float64).reshape((1, 1, 2) if name == "tilt_rad" else shape)
            for name in ("range_m", "amplitude_e", "intensity_e", "tilt_rad")
            if name in row
        }
        stamp = row["stamp_s"]
        return Frames(
            arrays.pop("range_m"),
            **arrays,
            flags=np.array(row["flags"], np.uint8).reshape(shape),
            sensor=sensor,
            time_s=None if stamp is None else np.array([[stamp]], np.float64),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputFileError(
            f"{path}: frame {row.get('index')} is none of {sensor.rows} × {sensor.cols} ({error})"
        ) from None
