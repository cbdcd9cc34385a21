"""Columns of a recording, whatever file they come from, and the checks that do not depend on its kind."""

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

MILLISECONDS, SECONDS = "t_ms", "t_s"
SECONDS_PER_TIME_UNIT: dict[str, float] = {MILLISECONDS: 1e-3, SECONDS: 1.0}
"""Names of time stamps, in CSV columns and in arrays, with the length of their unit."""
TILTS = ("pitch_deg", "roll_deg")
"""Names of the tilt of each frame, in CSV columns and in arrays."""


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
