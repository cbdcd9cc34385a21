"""Text that boards with a multizone sensor print: which boards there are, and how a log of one is read."""

from __future__ import annotations

import re
import warnings
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from phasemark import InputFileError, UsageError
from phasemark.data.measured import board_prints as prints
from phasemark.data.measured.board_prints import BoardLog, Printed
from phasemark.data.measured.recording import Orientation, Recording, note_disorder
from phasemark.render import Sensor

MOST_LOG_BYTES = 1 << 27
"""Most of a log of a board that is read: two hours of 8 × 8 zones, 15 frames a second, of the longest print."""
HEAD_BYTES = 1 << 16
"""How much of a file is looked at to recognise a board."""

_UPRIGHT, _MIRRORED, _ANTITRANSPOSED = Orientation(), Orientation(flip_h=True), Orientation(flip_h=True, rotate=90)


@dataclass(frozen=True)
class Board:
    """A program that prints frames, and what its numbers are.

    Parameters
    ----------
    name : str
    line : re.Pattern
        Matches the lines that only this program and those of the same print write.
    parse : callable
        Yields the whole frames of a log.
    quantity : {"range", "z", ""}
        Quantity of the chip, in millimetres; "" is the quantity of the sensor that the caller states.
    valid_status : tuple of int
        Which status codes mark a reading, if the program prints any.
    orientation : Orientation
        Brings the print into the chip's own order of zones, which is that of the image from the top left.
    banner : str
        Text that tells this program from others of the same print; "" if there is none.
    """

    name: str
    line: re.Pattern[str]
    parse: Callable[[BoardLog], Iterator[Printed]]
    quantity: str = "z"
    valid_status: tuple[int, ...] = (5,)
    orientation: Orientation = _UPRIGHT
    banner: str = ""


BOARDS = {
    board.name: board
    for board in (
        Board("sparkfun", prints.TABS_BEFORE, prints.tabs_before, orientation=_MIRRORED, banner="SparkFun VL53L5CX"),
        Board("adafruit", prints.TABS_BEFORE, prints.tabs_before, orientation=_ANTITRANSPOSED),
        Board("adafruit-webserial", prints.WEBSERIAL, prints.webserial, orientation=_ANTITRANSPOSED),
        Board("adafruit-nost", prints.TABS_BEHIND, prints.tabs_behind),
        Board("st-zones", prints.ZONE, prints.zone_lines),
        Board("st-boxes", prints.BOX, prints.boxes, orientation=_MIRRORED),
        Board("esphome", prints.ESPHOME, prints.esphome),
        Board("json", prints.JSON, prints.json_lines, quantity=""),
        Board("tmf8828", prints.OBJ, prints.obj_lines, quantity="range"),
    )
}
"""Boards by name. Sources: docs/formats.md."""


def find_board(name: str | None, head: bytes, n_pixels: int, path: Path) -> Board | None:
    """Return the board that printed a text, None if it is of none.

    Parameters
    ----------
    name : str, optional
        The board, if the caller names it.
    head : bytes
        Beginning of the text.
    n_pixels : int
        Pixels of the sensor; a line of as many cells is a frame of a table.
    path : Path
        For messages.

    Raises
    ------
    UsageError
        There is no board of this name, or several print text of this form.
    InputFileError
        Another board printed it.
    """
    if name is not None and name not in BOARDS:
        raise UsageError(f"board=… must be one of {', '.join(BOARDS)}, got {name!r}")
    given = None if name is None else BOARDS[name]
    found: list[Board] = []
    for number, line in enumerate(head.split(b"\n"), 1):
        text = prints.plain(line)
        found = [board for board in BOARDS.values() if board.line.match(text)]
        if found and text.count("\t") + 1 == n_pixels:
            found = []
        if given is not None and found and given not in found:
            raise InputFileError(f"{path}: line {number} was printed by board={found[0].name}, not board={name}")
        if found:
            break
    if given is not None or not found:
        return given
    named = [board for board in found if board.banner and board.banner.encode() in head]
    if len(found) > 1 and len(named) != 1:
        names = " or ".join(board.name for board in found)
        raise UsageError(
            f"{path}: several boards print this, each in its orientation: say with board=… which ({names})"
        )
    return (named or found)[0]


def read_board_log(file: BinaryIO, board: Board, sensor: Sensor, shape: tuple[int, int], path: Path) -> Recording:
    """Read the frames of a log line by line.

    Parameters
    ----------
    file : binary file
    board : Board
    sensor : Sensor
        The camera; its quantity is that of a board without one of its own.
    shape : (rows, cols)
        Pixels of a frame in the file's own orientation.
    path : Path
        For messages.

    Raises
    ------
    InputFileError
        The log holds no whole frame, frames of another number of zones, or lines of another board.

    Warns
    -----
    UserWarning
        Frames are incomplete or garbled, and left out.
    """
    n_zones = shape[0] * shape[1]
    log = BoardLog(file, path, n_zones)
    log.others = {other.name: other.line for other in BOARDS.values() if other.line is not board.line}
    distance, status, times = array("f"), array("f"), array("d")
    for frame in board.parse(log):
        if len(frame.distance_mm) != n_zones:
            raise InputFileError(
                f"{path}: line {frame.number}: a frame of {len(frame.distance_mm)} zones, but the sensor has"
                f" {shape[0]} × {shape[1]}"
            )
        distance.extend(frame.distance_mm)
        status.extend(frame.status or ())
        times.extend(() if frame.time_s is None else (frame.time_s,))
    n_frames = len(distance) // n_zones
    if not n_frames:
        reason = "" if log.first_damage is None else f"; {log.first_damage}"
        raise InputFileError(f"{path}: holds no whole frame of board={board.name}{reason}")
    if log.n_damaged:
        warnings.warn(
            f"{path}: left out {log.n_damaged} of {log.n_damaged + n_frames} frames, which are incomplete or garbled,"
            f" the first at {log.first_damage}",
            stacklevel=2,
        )
    for name, values, expected in (("status", status, len(distance)), ("time", times, n_frames)):
        if len(values) not in (0, expected):
            raise InputFileError(f"{path}: some frames have a {name}, others have none")
    note_disorder(np.array(times), path, "frame {}".format)
    return recording_of(board, distance, status, times, sensor, shape)


def recording_of(
    board: Board,
    distance_mm: Sequence[float],
    status: Sequence[float],
    times_s: Sequence[float],
    sensor: Sensor,
    shape: tuple[int, int],
) -> Recording:
    """Return whole frames of a board as columns, brought into the chip's own order of zones.

    Parameters
    ----------
    board : Board
    distance_mm, status : sequence of float
        Of all zones of all frames; no status if none is printed.
    times_s : sequence of float
        Of all frames; empty if none is printed.
    sensor : Sensor
        Its quantity is that of a board without one of its own.
    shape : (rows, cols)
    """
    arrays = {"range": distance_mm, "status": status} if len(status) else {"range": distance_mm}
    return Recording(
        {
            name: board.orientation.apply(np.asarray(values, np.float32).reshape(-1, *shape)).reshape(
                -1, shape[0] * shape[1]
            )
            for name, values in arrays.items()
        },
        {"unit": "mm", "quantity": board.quantity or sensor.quantity},
        np.array(times_s, np.float64) if len(times_s) else None,
        flat=True,
        valid_status=board.valid_status,
    )
