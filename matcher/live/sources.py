"""Sources of frames: what a board prints, a TMF8829 over ZeroMQ, recordings replayed in time, and logs in MCAP."""

from __future__ import annotations

import math
import re
import struct
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from phasemark import InputFileError
from phasemark.data.measured import board_prints as prints
from phasemark.data.measured.boards import BOARDS, Board, find_board, recording_of
from phasemark.data.measured.csv_frames import parse_csv
from phasemark.data.measured.reading import frames_of, read_frames, shape_before
from phasemark.data.measured.recording import Recording
from phasemark.inputs.extras import needed
from phasemark.matcher.live.streams import Lines, Stream, address_of
from phasemark.matcher.locate.recording import RigRecording
from phasemark.render import Frames, Sensor

STALLS_AFTER_S = 1.0
"""A source that sends nothing for longer is opened again."""
LONGEST_LINE = 1 << 16
_HEADER = re.compile(r"(^|[;,\t ])\"?(mm|range|z)_0\"?([;,\t ]|$)")
_OF_FILES = ("board", "topic")
"""Of the options of reading those that choose what of a file is read."""
_UNRECOGNISED_LINES = 256
"""Lines after which a source is said to be of no known format."""


class SourceFault(Exception):
    """Fault of a source that is opened again: it stalled, was unplugged, or is of another format."""


@dataclass(frozen=True, eq=False)
class Arrival:
    """One frame as it arrived.

    Parameters
    ----------
    frames : Frames or RigRecording
        One position with one frame, or one stop of a rig; its stamp is the source's, if it has any.
    received_s : float
        When its last byte arrived, on the monotonic clock.
    """

    frames: Frames | RigRecording
    received_s: float


class Source(ABC):
    """Source of frames, opened again after a fault.

    Parameters
    ----------
    name : str
        As the user gave it.

    Attributes
    ----------
    is_live : bool
        Whether frames come when they come: then the newest wins. Of a recording each is taken.
    n_damaged : int
        Frames that were incomplete or garbled, up to now.
    damage : str
        What was wrong with the last of them.
    """

    is_live = True

    def __init__(self, name: str) -> None:
        self.name = name
        self.n_damaged, self.damage, self._stopped = 0, "", False

    @abstractmethod
    def frames(self) -> Iterator[Arrival]:
        """Open the source and yield its frames; ends where a recording ends.

        Raises
        ------
        SourceFault
            It has to be opened again.
        """

    def stop(self) -> None:
        """Let :meth:`frames` end soon; called from another thread."""
        self._stopped = True

    def spoilt(self, damage: str, n: int = 1) -> None:
        """Count frames that are left out."""
        self.n_damaged, self.damage = self.n_damaged + n, damage


class StreamSource(Source):
    """Frames of the lines that arrive on a stream.

    Parameters
    ----------
    stream : Stream
    """

    def __init__(self, stream: Stream) -> None:
        super().__init__(stream.name)
        self._stream = stream
        self._lines: Lines | None = None

    def frames(self) -> Iterator[Arrival]:
        """Open the stream and yield its frames."""
        try:
            self._stream.open()
        except OSError as error:
            raise SourceFault(f"{self.name}: cannot be opened ({_reason(error)})") from None
        self._lines = lines = Lines(self._stream, STALLS_AFTER_S)
        try:
            yield from self._parsed(lines)
        except OSError as error:
            raise SourceFault(f"{self.name}: is gone ({_reason(error)})") from None
        finally:
            self._stream.close()
        if lines.fault and not (self._stream.ends and lines.fault == "has ended"):
            raise SourceFault(f"{self.name}: {lines.fault}")

    def stop(self) -> None:
        """Let the lines end."""
        if self._lines is not None:
            self._lines.is_stopped = True

    @abstractmethod
    def _parsed(self, lines: Lines) -> Iterator[Arrival]:
        """Yield the frames of lines until these end."""


class PrintedSource(StreamSource):
    """Lines that a board prints, or lines of CSV, read from a stream.

    Parameters
    ----------
    stream : Stream
    sensor : Sensor
    how : mapping
        Keywords of :func:`~phasemark.data.read_frames` that tell what the numbers mean.
    """

    def __init__(self, stream: Stream, sensor: Sensor, how: Mapping[str, Any]) -> None:
        super().__init__(stream)
        self._sensor = sensor
        self._how = {key: value for key, value in how.items() if key not in _OF_FILES}
        self._named: str | None = how.get("board")
        self._shape = shape_before(sensor, int(how.get("rotate", 0)))
        self._path = Path(self.name)
        self._header = b""

    def _parsed(self, lines: Lines) -> Iterator[Arrival]:
        board = self._recognised(lines)
        if board is None:
            if not (lines.fault or lines.is_stopped):
                yield from self._of_csv(lines)
            return
        log = prints.BoardLog(cast(Any, lines), self._path, math.prod(self._shape), is_live=True)
        log.others = {other.name: other.line for other in BOARDS.values() if other.line is not board.line}
        while not lines.fault and not lines.is_stopped:
            n_damaged = log.n_damaged
            try:
                for printed in board.parse(log):
                    if log.n_damaged > n_damaged:
                        self.spoilt(log.first_damage or "", log.n_damaged - n_damaged)
                        n_damaged, log.first_damage = log.n_damaged, None
                    yield from self._taken(self._of_board(board, printed), lines)
            except InputFileError as error:  # the line of another board: what has begun is lost, and the next is read
                self.spoilt(str(error))
            log.frame = None

    def _recognised(self, lines: Lines) -> Board | None:
        """Return the board whose lines arrive, None of lines of CSV or where none arrive; the lines are read again."""
        if self._named is not None and self._named in BOARDS:
            return BOARDS[self._named]
        held: list[bytes] = []
        n_pixels = math.prod(self._shape) * len(self._sensor.frequencies_hz)
        while line := lines.readline(LONGEST_LINE):
            held.append(line)
            board = find_board(self._named, b"".join(held), math.prod(self._shape), self._path)
            text = prints.plain(line)
            if board is not None:
                lines.unread(b"".join(held))
                return board
            if _HEADER.search(text) or len(re.split(r"[;,\t]+", text.strip())) >= n_pixels:
                lines.unread(line)
                return None
            if len(held) == _UNRECOGNISED_LINES:
                break
        if lines.is_stopped or lines.fault:
            return None
        raise SourceFault(
            f"{self.name}: {len(held)} lines are of no known format, the last {prints.plain(held[-1])[:40]!r}: give"
            " board=…, or lines of JSON or CSV"
        )

    def _of_board(self, board: Board, printed: prints.Printed) -> Recording:
        n_zones = math.prod(self._shape)
        if len(printed.distance_mm) != n_zones:
            raise InputFileError(
                f"{self.name}: a frame of {len(printed.distance_mm)} zones, but the sensor has {self._shape[0]} ×"
                f" {self._shape[1]}"
            )
        times = [] if printed.time_s is None else [printed.time_s]
        return recording_of(board, printed.distance_mm, printed.status, times, self._sensor, self._shape)

    def _of_csv(self, lines: Lines) -> Iterator[Arrival]:
        """Yield the frames of lines of CSV, below a header or without one."""
        while line := lines.readline(LONGEST_LINE):
            text = prints.plain(line)
            if _HEADER.search(text):
                self._header = line
            elif text.strip() and not text.startswith("#"):
                try:
                    with warnings.catch_warnings():
                        warnings.simplefilter("ignore")  # of columns that are ignored, at every line
                        row = parse_csv(self._header + line, self._shape, self._path, len(self._sensor.frequencies_hz))
                except InputFileError as error:
                    self.spoilt(str(error))
                    continue
                yield from self._taken(row, lines)

    def _taken(self, row: Recording, lines: Lines) -> Iterator[Arrival]:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of single ranges that cannot be
                frames = frames_of(row, self._path, sensor=self._sensor, **self._how)
        except InputFileError as error:
            self.spoilt(str(error))
            return
        yield Arrival(frames, lines.received_s)


class Tmf8829Source(Source):
    """Results of a TMF8829 as the ZeroMQ server of ams OSRAM's driver publishes them (protocol version 2).

    A message has a header of 84 bytes, and frames behind one another: five bytes of the host, a header of 16, the zones
    row by row and a footer of 12. Distances are in quarters of a millimetre, of one peak or several, the first of which
    counts. Its clock has no documented unit, so frames are stamped when they arrive.
    """

    _CONTAINER, _MAGIC = 84, 0xFE5E1234
    _HOST, _HEADER_BYTES, _FOOTER = 5, 16, 12
    _RESULTS, _END, _IS_VALID = 0x10, 0xE0F7, 0x01

    def __init__(self, name: str, sensor: Sensor, how: Mapping[str, Any]) -> None:
        super().__init__(name)
        self._zmq = needed("zmq", "ZeroMQ", "live")
        host, port = address_of(name)
        self._address = f"tcp://{host or '127.0.0.1'}:{port}"
        self._sensor = sensor
        self._how = {key: value for key, value in how.items() if key not in _OF_FILES}
        self._shape = shape_before(sensor, int(how.get("rotate", 0)))

    def frames(self) -> Iterator[Arrival]:
        """Subscribe, and yield frames."""
        socket = self._zmq.Context.instance().socket(self._zmq.SUB)
        socket.setsockopt(self._zmq.LINGER, 0)
        socket.setsockopt(self._zmq.SUBSCRIBE, b"")
        try:
            socket.connect(self._address)
            since = time.monotonic()
            while not self._stopped:
                if not socket.poll(50):
                    if time.monotonic() - since > STALLS_AFTER_S:
                        raise SourceFault(f"{self.name}: has sent nothing for {STALLS_AFTER_S:g} s")
                    continue
                message, since = socket.recv(), time.monotonic()
                try:
                    yield Arrival(
                        frames_of(self._row(message), Path(self.name), sensor=self._sensor, **self._how), since
                    )
                except InputFileError as error:
                    self.spoilt(str(error))
        finally:
            socket.close()

    def _row(self, message: bytes) -> Recording:
        """Return the ranges of a message."""
        if len(message) < self._CONTAINER or struct.unpack_from("<I", message)[0] != self._MAGIC:
            raise InputFileError(f"{self.name}: a message of {len(message)} bytes is none of a TMF8829")
        at, n = self._CONTAINER, math.prod(self._shape)
        while at + self._HOST + self._HEADER_BYTES <= len(message):
            kind, layout, payload = struct.unpack_from("<BBH", message, at + self._HOST)
            end = at + self._HOST + 4 + payload
            if kind & 0xF0 == self._RESULTS:
                first = at + self._HOST + self._HEADER_BYTES
                skip = (2 if layout & 16 else 0) + (2 if layout & 32 else 0)
                size = skip + (layout & 7) * (5 if layout & 8 else 3)
                if end > len(message) or first + n * size + self._FOOTER != end or not layout & 7:
                    raise InputFileError(f"{self.name}: a frame of {end - first} bytes is none of {n} zones")
                status, _, mark = struct.unpack_from("<BBH", message, end - 4)
                if mark != self._END or not status & self._IS_VALID:
                    raise InputFileError(f"{self.name}: a frame that its sensor takes for invalid")
                zones = np.frombuffer(message, np.uint8, n * size, first).reshape(n, size)
                quarters = zones[:, skip].astype(np.float64) + 256.0 * zones[:, skip + 1]
                return Recording({"range": quarters[None] / 4}, {"unit": "mm", "quantity": "range"}, flat=True)
            at = end
        raise InputFileError(f"{self.name}: a message without results")


class Replay(Source):
    """Recorded frames in the rhythm of their stamps, or as fast as they are taken.

    Parameters
    ----------
    name : str
    in_time : bool
    """

    is_live = False

    def __init__(self, name: str, in_time: bool) -> None:
        super().__init__(name)
        self._in_time = in_time

    @abstractmethod
    def recorded(self) -> Iterator[tuple[Any, float | None]]:
        """Yield frames with their times, if they have any."""

    def frames(self) -> Iterator[Arrival]:
        """Yield the frames."""
        began, first = time.monotonic(), None
        for frames, stamp in self.recorded():
            if self._in_time and stamp is not None:
                first = stamp if first is None else first
                while not self._stopped and (ahead := began + stamp - first - time.monotonic()) > 0:
                    time.sleep(min(ahead, 0.05))
            if self._stopped:
                return
            yield Arrival(frames, time.monotonic())


class RecordedSource(Replay):
    """Recording of a camera.

    Parameters
    ----------
    path : Path
    sensor : Sensor
    how : mapping
        Keywords of :func:`~phasemark.data.read_frames`.
    in_time : bool
    """

    def __init__(self, path: Path, sensor: Sensor, how: Mapping[str, Any], *, in_time: bool) -> None:
        super().__init__(str(path), in_time)
        self._recorded = read_frames(path, sensor=sensor, untrusted=True, **how).each_a_position()

    def recorded(self) -> Iterator[tuple[Frames, float]]:
        """Yield the frames, with times at the frame rate where they have none."""
        stamps, period_s = self._recorded.time_s, 1 / (self._recorded.sensor.frame_rate_hz or 15.0)
        for k in range(len(self._recorded)):
            yield self._recorded[k : k + 1], k * period_s if stamps is None else float(stamps[k, 0])


def _reason(error: OSError) -> str:
    return getattr(error, "strerror", None) or " ".join(str(error).split())[:120] or type(error).__name__
