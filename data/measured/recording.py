"""Columns of a recording, whatever file they come from, and what does not depend on its kind: checks, orientation."""

from __future__ import annotations

import io
import warnings
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError, PhasemarkError
from phasemark.data.files.guard import EXPANSION, FREE_BYTES
from phasemark.render import Sensor

MILLISECONDS, SECONDS = "t_ms", "t_s"
SECONDS_PER_TIME_UNIT: dict[str, float] = {MILLISECONDS: 1e-3, SECONDS: 1.0}
"""Names of time stamps, in CSV columns and in arrays, with the length of their unit."""
LATEST_S = 2.0**31
"""No clock of a recording is farther from its zero: what ROS can say, seconds."""
TILTS = ("pitch_deg", "roll_deg")
"""Names of the tilt of each frame, in CSV columns and in arrays."""
_NEAREST_M = 0.01
"""No sensor reads less in all pixels."""
METRES_PER_UNIT: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}


@dataclass(frozen=True)
class Recording:
    """Columns of a recording as the file has them, and what it says about them.

    Parameters
    ----------
    arrays : mapping of str to array
        "range" or "frequency_range", and others of :func:`phasemark.data.read_frames` if the file has them.
    stated : mapping of str to str
        "unit" and "quantity", where the file states them.
    time_s : array of float64, optional
        Time stamps, seconds.
    tilt_deg : mapping of str to array of float64
        Of :data:`TILTS` those that the file has; a number for each frame.
    flat : bool
        Whether frames are rows of rows · cols values.
    named : bool
        Whether names of columns, or encodings of images, state one of unit and quantity.
    valid_status : tuple of int, optional
        Of the board that printed it.
    """

    arrays: Mapping[str, NDArray[Any]]
    stated: Mapping[str, str] = field(default_factory=dict)
    time_s: NDArray[np.float64] | None = None
    tilt_deg: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    flat: bool = False
    named: bool = False
    valid_status: tuple[int, ...] | None = None


def one_time(names: Collection[str], where: object) -> str | None:
    """Return the name of the time stamps among the names of columns, None if there are none.

    Raises
    ------
    InputFileError
        There are stamps in two units; names the place.
    """
    times = [name for name in SECONDS_PER_TIME_UNIT if name in names]
    if len(times) > 1:
        raise InputFileError(f"{where}: has both '{MILLISECONDS}' and '{SECONDS}': leave one of them out")
    return times[0] if times else None


def in_seconds(times: NDArray[np.float64], name: str, path: Path, place: Callable[[int], str]) -> NDArray[np.float64]:
    """Return time stamps in seconds.

    Parameters
    ----------
    times : array of float64
        In the unit of their name.
    name : str
        One of :data:`SECONDS_PER_TIME_UNIT`.
    path, place
        As for :func:`note_disorder`.

    Raises
    ------
    InputFileError
        One is later than :data:`LATEST_S`.
    """
    seconds = times * SECONDS_PER_TIME_UNIT[name]
    late = np.flatnonzero(np.abs(seconds) > LATEST_S)
    if late.size:
        unit = "seconds" if name == SECONDS else "milliseconds"
        raise InputFileError(
            f"{path}: {place(int(late[0]))}: '{name}' must be {unit}, got {times.flat[late[0]]:.6g}, which are"
            f" {seconds.flat[late[0]] / 3.16e7:.2g} years: is it in a smaller unit?"
        )
    return seconds


def note_disorder(times: NDArray[np.float64], path: Path, place: Callable[[int], str]) -> None:
    """Warn of time stamps that repeat or run backwards; the frames keep their order.

    Parameters
    ----------
    times : (frames,) float64
    path : Path
        For the message.
    place : callable
        Turns the number of a frame into the place where it stands.

    Warns
    -----
    UserWarning
        Says how many stamps there are, and where the first is.
    """
    steps = np.diff(times)
    found = (int((steps == 0).sum()), "repeat"), (int((steps < 0).sum()), "run backwards")
    counts = " and ".join(f"{count} of {len(times)} time stamps {what}" for count, what in found if count)
    if counts:
        first = int(np.flatnonzero(steps <= 0)[0]) + 1
        warnings.warn(f"{path}: {counts}, the first in {place(first)}; the frames keep their order", stacklevel=2)


def npz_bytes(arrays: Mapping[str, Any]) -> bytes:
    """Return arrays as the content of an NPZ file."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


@contextmanager
def opened_npz(file: BinaryIO, size: int, path: Path) -> Iterator[Any]:
    """Open an NPZ file, unless it announces far more than a file of its size can hold."""
    with np.load(file, allow_pickle=False) as archive:
        declared = sum(member.file_size for member in archive.zip.infolist())
        if declared > FREE_BYTES + EXPANSION * size:
            raise InputFileError(f"{path}: refused: declares {declared} bytes, far more than its size can hold")
        yield archive


def npz_arrays(
    content: bytes, path: Path, chosen: Callable[[Collection[str]], Iterable[str]] = list
) -> dict[str, NDArray[Any]]:
    """Return arrays of the content of an NPZ file by their names: all of them, or those that `chosen` takes.

    Raises
    ------
    InputFileError
        It cannot be read, or announces far more than it can hold.
    """
    try:
        with opened_npz(io.BytesIO(content), len(content), path) as archive:
            return {name: np.asarray(archive[name]) for name in chosen(archive)}
    except PhasemarkError:
        raise
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, NotImplementedError) as error:
        raise InputFileError(f"{path}: not an NPZ file that can be read ({error})") from None


@dataclass(frozen=True)
class Orientation:
    """Orientation of images: the mirroring and the turn that bring them upright.

    Parameters
    ----------
    flip_h : bool
        Whether left and right are mirrored first.
    rotate : {0, 90, 180, 270}
        Degrees to turn clockwise.
    """

    flip_h: bool = False
    rotate: int = 0

    def apply(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return images, (..., rows, cols), brought upright."""
        values = values[..., ::-1] if self.flip_h else values
        return np.rot90(values, -self.rotate // 90, axes=(-2, -1))


ORIENTATIONS = tuple(Orientation(flip_h, rotate) for flip_h in (False, True) for rotate in (0, 90, 180, 270))
"""All of a square grid; one that is not square has those of 0° and 180°."""


def _range_limit(sensor: Sensor) -> tuple[float, str]:
    """Return the range below which all readings of a sensor lie, metres, and where the limit comes from."""
    if sensor.kind == "direct" and sensor.max_range_m is not None:
        # how far beyond `max_range_m` a direct sensor may still report: real chips exceed their data sheet by a little
        beyond_max_range = 1.25
        return beyond_max_range * sensor.max_range_m, f"{beyond_max_range:g} times the sensor's 'max_range_m'"
    return sensor.unambiguous_range_m, "c / 2f"


def impossible_ranges(
    range_m: NDArray[np.float64], valid: NDArray[np.bool_], sensor: Sensor, unit: str, path: Path, *, is_stated: bool
) -> NDArray[np.bool_]:
    """Return which ranges are 0, or none that the sensor can measure.

    Parameters
    ----------
    range_m, valid : (n, frames, rows, cols) or (n, frames, rows, cols, targets)
    sensor : Sensor
    unit : str
        That they were written in.
    path : Path
        For messages.
    is_stated : bool
        Whether the file itself states the unit.

    Raises
    ------
    InputFileError
        Most of the ranges are impossible, or all of them 0.

    Warns
    -----
    UserWarning
        Says how many are impossible, and where the first is.
    """
    empty = valid & (range_m == 0)  # how most sensors write that they have no reading: it says nothing of the unit
    if valid.any() and empty.sum() == valid.sum():
        raise InputFileError(f"{path}: every range is 0, which stands for no reading")
    limit_m, reason = _range_limit(sensor)
    doubt = f"is its unit, {unit}, right?" if is_stated else "is unit=… right?"
    if valid.any() and (np.abs(range_m[valid]) < _NEAREST_M).all():
        if fitting := _fitting_units(range_m[valid & ~empty], limit_m, unit, is_stated):
            raise InputFileError(f"{path}: every range is below {_NEAREST_M:g} m; {doubt}{fitting}")
    wrong = valid & ~empty & ~((range_m > 0) & (range_m < limit_m))
    count, of = int(wrong.sum()), int((valid & ~empty).sum())
    if count:
        place = np.argwhere(wrong)[0]
        message = (
            f"{path}: {count} of {of} ranges are not in 0 … {limit_m:.4g} m ({reason}), the first in"
            f" frame {place[1]}, row {place[2]}, column {place[3]}: {range_m[tuple(place)]:.6g} m"
        )
        if 2 * count > of:
            readings_m = range_m[valid & ~empty]
            raise InputFileError(f"{message}; {doubt}{_fitting_units(readings_m, limit_m, unit, is_stated)}")
        warnings.warn(f"{message}; taken as invalid", UserWarning, stacklevel=3)
    return np.asarray(wrong | empty)


def _fitting_units(readings_m: NDArray[np.float64], limit_m: float, unit: str, is_stated: bool) -> str:
    """Return a sentence that names the other units in which all readings would be possible, if there are any."""
    factors = {name: metres / METRES_PER_UNIT[unit] for name, metres in METRES_PER_UNIT.items() if name != unit}
    usual_m, least_m, most_m = np.median(readings_m), readings_m.min(), readings_m.max()
    option = "" if is_stated else "unit="
    fitting = [
        f"{option}{name} ({f'dividing by {1 / factor:g}' if factor < 1 else f'multiplying by {factor:g}'})"
        for name, factor in factors.items()
        if least_m > 0 and most_m * factor < limit_m and usual_m * factor > _NEAREST_M
    ]
    return f" All would fit with {' or '.join(fitting)}" if fitting else ""
