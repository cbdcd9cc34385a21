"""Prints of boards' programs: a pattern of their lines, and a parser that finds whole frames among other lines."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from phasemark import InputFileError
from phasemark.data.measured.recording import LATEST_S

_LONGEST_LINE = 1 << 16
_ANSI = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")
_ZONES = (16, 64)
_NUMBER = r"-?[0-9]{1,9}"

TABS_BEFORE = re.compile(rf"(\t{_NUMBER}){{4}}((\t{_NUMBER}){{4}})?$")
TABS_BEHIND = re.compile(rf"(({_NUMBER}|----)\t){{4}}((({_NUMBER}|----)\t){{4}})?$")
WEBSERIAL = re.compile(r"FRAME_START$")
ZONE = re.compile(
    rf"Zone : *(?P<zone>[0-9]+), Status : *(?P<status>{_NUMBER}), Distance : *(?P<mm>{_NUMBER}) mm"
    r"|Zone *(?P<of_several>[0-9]+) : *(?P<found>[0-9]+), *[0-9]+, *[0-9]+, *"
    rf"Target\[0\] : *(?P<first_status>{_NUMBER}), *(?P<first_mm>{_NUMBER}),"
)
BOX = re.compile(r"( -{17}){4}(( -{17}){4})?$")
_BOX_CELL = re.compile(rf" *({_NUMBER}|X) *: *({_NUMBER}|X) *$")
_ESPHOME_STATE = r".*\[text_sensor:[0-9]+\][^']*'(?P<name>[^']*)'[^']*'(?P<row>{})$"
ESPHOME = re.compile(_ESPHOME_STATE.format("[ 0-9.nNaA,|]+"))
_ESPHOME_BEGINS = re.compile(_ESPHOME_STATE.format("[^']*"))
_ESPHOME_PREFIX = re.compile(r"(\[[^\]]*\])+: ?")
_ESPHOME_CELL = re.compile(r" *([0-9]{1,9}(?:\.[0-9]{3})?|[nN][aA][nN])$")
JSON = re.compile(r'\{.*"(distances|distance_mm)" *: *\[')
OBJ = re.compile(r"#Obj,")
_OBJ_LENGTH = 6 + 2 * 36
# Where the 16 zones of each of four captures stand in the image, and which of the 36 results each is.
_OBJ_ROWS = ((1, 3, 5, 7), (1, 3, 5, 7), (0, 2, 4, 6), (0, 2, 4, 6))
_OBJ_COLS = ((0, 1, 4, 5), (2, 3, 6, 7), (0, 1, 4, 5), (2, 3, 6, 7))
_OBJ_RESULTS = (6, 15, 7, 16, 4, 13, 5, 14, 2, 11, 3, 12, 0, 9, 1, 10)
_JSON_UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
_JSON_TIMES = {"t_s": 1.0, "t_ms": 1e-3, "timestamp_ms": 1e-3, "ms": 1e-3}


def plain(line: bytes) -> str:
    """Return a line without the codes of colours and cursors, and without its end."""
    text = line.decode("utf-8", errors="replace").rstrip("\r\n").removeprefix("\ufeff")
    return _ANSI.sub("", text) if "\x1b" in text else text


@dataclass
class Printed:
    """Frame as it was printed, row by row; perhaps a part of one.

    Parameters
    ----------
    number : int
        Its first line.
    distance_mm, status : list of float
        NaN where there is none; no status if none is printed.
    time_s : float, optional
    """

    number: int
    distance_mm: list[float] = field(default_factory=list)
    status: list[float] = field(default_factory=list)
    time_s: float | None = None
    damage: str = ""

    def spoil(self, damage: str) -> None:
        """Note what is wrong with the frame, unless something is noted already."""
        self.damage = self.damage or damage


@dataclass
class BoardLog:
    """Lines of a log, the frame that has begun, and what of the log is left out; `is_live`: read as it is printed."""

    file: BinaryIO
    path: Path
    n_zones: int
    others: Mapping[str, re.Pattern[str]] = field(default_factory=dict)
    is_live: bool = False
    frame: Printed | None = None
    n_damaged: int = 0
    first_damage: str | None = None
    last_is_cut: bool = False

    def lines(self) -> Iterator[tuple[int, str]]:
        """Yield the number and the plain text of each line."""
        for number, line in enumerate(iter(lambda: self.file.readline(_LONGEST_LINE), b""), 1):
            self.last_is_cut = not line.endswith(b"\n")
            yield number, plain(line)

    def other(self, number: int, text: str) -> None:
        """Take a line that belongs to no frame, and refuse one that another board printed."""
        for name, line in self.others.items():
            if line.match(text):
                raise InputFileError(
                    f"{self.path}: line {number} was printed by board={name}, unlike the lines before: give the log of"
                    " each board as a file of its own"
                )

    def begun(self, number: int) -> Printed:
        """Return the frame that has begun, or begin one."""
        self.frame = self.frame or Printed(number)
        return self.frame

    def ended(self, *, cut: bool = False, at_end: bool = False) -> Iterator[Printed]:
        """End the frame that has begun, if one has: yield it if it is whole, and count it otherwise.

        A frame that is cut by the end is not whole. At the end of a log fewer zones than the sensor has are a frame
        that was cut, whatever their number.
        """
        frame, self.frame = self.frame, None
        if frame is None:
            return
        n = len(frame.distance_mm)
        if cut:
            frame.spoil(f"line {frame.number}: a frame that is cut by the end")
        if n != self.n_zones and (at_end or n not in _ZONES):
            frame.spoil(f"line {frame.number}: a frame of {n} zones, must be of {self.n_zones}")
        if not frame.damage:
            yield frame
            return
        self.n_damaged += 1
        self.first_damage = self.first_damage or frame.damage


def _garbled(number: int, text: str, right: str) -> str:
    return f"line {number}: got {text[:40]!r}, must be {right}"


def tabs_before(log: BoardLog) -> Iterator[Printed]:
    """Yield frames of rows whose cells begin with a tab, an empty line between two frames."""
    return _grid(log, TABS_BEFORE, slice(1, None))


def tabs_behind(log: BoardLog) -> Iterator[Printed]:
    """Yield frames of rows whose cells end with a tab, an empty line between two frames."""
    return _grid(log, TABS_BEHIND, slice(None, -1))


def _grid(log: BoardLog, line: re.Pattern[str], cells: slice) -> Iterator[Printed]:
    """Yield frames of square blocks of rows, some of whose parts between tabs are cells."""
    width = 0
    for number, text in log.lines():
        if not text.strip("\t "):
            yield from _square(log, width)
        elif line.match(text):
            row = text.split("\t")[cells]
            width = len(row) if log.frame is None else width
            frame = log.begun(number)
            if len(row) != width:
                frame.spoil(_garbled(number, text, f"a row of {width} cells"))
            frame.distance_mm.extend(math.nan if cell == "----" else float(cell) for cell in row)
        else:
            log.other(number, text)
            if log.frame is not None or "\t" in text:
                log.begun(number).spoil(_garbled(number, text, "a row of 4 or 8 cells"))
    if log.frame is not None and log.last_is_cut:
        log.frame.spoil(f"line {log.frame.number}: a frame whose last line is cut")
    yield from _square(log, width, at_end=True)


def _square(log: BoardLog, width: int, at_end: bool = False) -> Iterator[Printed]:
    frame = log.frame
    if frame is not None and len(frame.distance_mm) != width**2:
        rows = len(frame.distance_mm) // max(width, 1)
        frame.spoil(f"line {frame.number}: a frame of {rows} rows, must be {width}")
    yield from log.ended(at_end=at_end)


def webserial(log: BoardLog) -> Iterator[Printed]:
    """Yield frames of a line D: of distances and a line S: of status codes, between FRAME_START and FRAME_END."""
    for number, text in log.lines():
        frame = log.frame
        if WEBSERIAL.match(text):
            yield from log.ended(cut=True)
            log.begun(number)
        elif frame is not None and text.startswith(("D:", "S:")):
            try:
                values = [float(int(cell)) for cell in text[2:].split(",")]
            except ValueError:
                frame.spoil(_garbled(number, text, "whole numbers between commas"))
                continue
            frame.distance_mm, frame.status = (values, frame.status) if text[0] == "D" else (frame.distance_mm, values)
        elif frame is not None and text == "FRAME_END":
            n, n_codes = len(frame.distance_mm), len(frame.status)
            if n_codes != n:
                frame.spoil(f"line {frame.number}: a frame of {n} distances and {n_codes} codes")
            yield from log.ended()
        else:
            log.other(number, text)
    yield from log.ended(cut=True)


def zone_lines(log: BoardLog) -> Iterator[Printed]:
    """Yield frames of a line a zone; of several targets in a zone the first counts."""
    for number, text in log.lines():
        match = ZONE.match(text)
        if match:
            zone = int(match["zone"] or match["of_several"])
            if zone == 0:
                yield from log.ended()
            frame = log.begun(number)
            if zone != len(frame.distance_mm):
                frame.spoil(f"line {number}: got zone {zone}, must be {len(frame.distance_mm)}")
            seen = match["found"] is None or int(match["found"]) > 0
            frame.distance_mm.append(float(match["mm"] or match["first_mm"]) if seen else math.nan)
            frame.status.append(float(match["status"] or match["first_status"]) if seen else math.nan)
            if log.is_live and zone + 1 == log.n_zones:  # whole: no need to wait for the next frame to begin
                yield from log.ended()
        elif not text.strip() or "Print data no" in text:
            yield from log.ended()
        else:
            log.other(number, text)
            if log.frame is not None:
                log.frame.spoil(_garbled(number, text, f"zone {len(log.frame.distance_mm)}"))
    yield from log.ended(at_end=True)


def boxes(log: BoardLog) -> Iterator[Printed]:
    """Yield frames of boxes of ``distance : status``; of several lines in a box the first counts."""
    width, row_begins = 0, False
    for number, text in log.lines():
        if BOX.match(text):
            row_begins = log.frame is None or len(log.frame.distance_mm) != width**2
            if row_begins:
                log.begun(number)
                width = text.count(" ")
            else:
                yield from log.ended()
        elif text.startswith("|") and log.frame is not None:
            if not row_begins or not text.strip("| "):
                continue
            cells = [_BOX_CELL.match(cell) for cell in text.split("|")[1:-1]]
            row_begins = False
            if len(cells) != width or not all(cells):
                log.frame.spoil(_garbled(number, text, f"{width} boxes of distance : status"))
            for cell in filter(None, cells):
                log.frame.distance_mm.append(math.nan if cell[1] == "X" else float(cell[1]))
                log.frame.status.append(math.nan if cell[2] == "X" else float(cell[2]))
        else:
            log.other(number, text)
            if log.frame is not None:
                log.frame.spoil(_garbled(number, text, "a box"))
                yield from log.ended()
    yield from log.ended(cut=True)


def esphome(log: BoardLog) -> Iterator[Printed]:
    """Yield frames of a text sensor's state in a log, as CSV or as a table, in millimetres or metres."""
    names: set[str] = set()
    for number, text in log.lines():
        begins = _ESPHOME_BEGINS.match(text)
        if begins:
            names |= {begins["name"]} if ESPHOME.match(text) else set()
            if len(names) > 1:
                several = " and ".join(f"'{name}'" for name in sorted(names))
                raise InputFileError(
                    f"{log.path}: line {number}: has states of the text sensors {several}: keep the lines of one, which"
                    " has distances"
                )
            yield from log.ended(cut=True)
            text = begins["row"]
        elif log.frame is None:
            log.other(number, text)
            continue
        frame, text = log.begun(number), _ESPHOME_PREFIX.sub("", text)
        if text and not text.strip("-"):
            continue
        cells = [_ESPHOME_CELL.match(cell) for cell in re.split(r"[,|]", text.rstrip("'").rstrip(","))]
        if not all(cells):
            frame.spoil(_garbled(number, text, "numbers between commas or bars"))
            log.other(number, text)
        # a state that is in metres has three decimals
        frame.distance_mm.extend(float(cell[1]) * (1000.0 if "." in cell[1] else 1.0) for cell in cells if cell)
        if text.endswith("'") or frame.damage:
            yield from log.ended()
    yield from log.ended(cut=True)


def json_lines(log: BoardLog) -> Iterator[Printed]:
    """Yield frames of an object a line: distances in millimetres, optionally status codes and a time."""
    for number, text in log.lines():
        if text.startswith("{"):
            log.frame = of_object(number, text)
            yield from log.ended()
        else:
            log.other(number, text)


def of_object(number: int, text: str) -> Printed:
    """Return the frame of a line of JSON."""
    frame = Printed(number)
    try:
        row = json.loads(text)
        distance = row["distances"] if "distances" in row else row["distance_mm"]
        unit = row.get("unit", "mm")
        status = row["status"] if "status" in row else row.get("target_status", [])
        frame.distance_mm = [math.nan if value is None else _JSON_UNITS[unit] * float(value) for value in distance]
        frame.status = [math.nan if value is None else float(value) for value in status]
        time = next((name for name in _JSON_TIMES if name in row), None)
        frame.time_s = None if time is None else float(row[time]) * _JSON_TIMES[time]
        if not abs(frame.time_s or 0.0) < LATEST_S:
            raise ValueError
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError):
        frame.spoil(_garbled(number, text, "an object with lists of numbers, 'distances' and 'status'"))
    n, n_codes = len(frame.distance_mm), len(frame.status)
    if n_codes not in (0, n):
        frame.spoil(f"line {number}: has {n} distances and {n_codes} status codes")
    return frame


def obj_lines(log: BoardLog) -> Iterator[Printed]:
    """Yield frames of four captures, each a line of 36 results, of which the first objects of 16 zones count."""
    n_captures, last = 0, 0
    for number, text in log.lines():
        if not OBJ.match(text):
            log.other(number, text)
            continue
        _, *cells = text.split(",")
        try:
            numbers = [int(cell) for cell in cells]
        except ValueError:
            numbers = []
        if len(numbers) != _OBJ_LENGTH - 1:
            log.begun(number).spoil(_garbled(number, text, f"#Obj and {_OBJ_LENGTH - 1} whole numbers"))
            continue
        capture = numbers[1] % 4
        if capture == 0:
            yield from log.ended(cut=True)
            n_captures = 0
        frame = log.begun(number)
        frame.distance_mm = frame.distance_mm or [math.nan] * 64
        if capture != n_captures:
            frame.spoil(f"line {number}: got capture {capture} of a frame, must be {n_captures}")
        if n_captures and (numbers[1] - last) % 256 != 1:
            frame.spoil(f"line {number}: got result {numbers[1]} behind result {last}: captures of two frames")
        last = numbers[1]
        for k, result in enumerate(_OBJ_RESULTS):
            place = 8 * _OBJ_ROWS[capture][k // 4] + _OBJ_COLS[capture][k % 4]
            frame.distance_mm[place] = float(numbers[5 + 2 * result])
        n_captures += 1
        if capture == 3:
            yield from log.ended()
            n_captures = 0
    yield from log.ended(cut=True)
