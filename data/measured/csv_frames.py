"""Measured frames in text files: one frame a line, with or without a header that names the columns."""

from __future__ import annotations

import codecs
import csv
import io
import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError
from phasemark.data.measured.recording import (
    SECONDS_PER_TIME_UNIT,
    TILTS,
    Recording,
    in_seconds,
    note_disorder,
    one_time,
)
from phasemark.render.frames import MOST_TILT_DEG

_SEPARATORS = (";", "\t", ",")
_STATED = re.compile(r"\b(unit|quantity)=(\S+)")
_NUMBERED = re.compile(r"([a-z]+)_([0-9]{1,9})")
_PIXELS: dict[str, dict[str, str]] = {"mm": {"unit": "mm"}, "range": {"quantity": "range"}, "z": {"quantity": "z"}}
"""Prefixes of pixel columns, and what each states about the values."""
_OTHER_GROUPS = ("status", "amplitude", "intensity")
_NOT_A_NUMBER = ("", "nan")
_OUR_OWN = re.compile(r"truth_\w+")
_MOST_NAMED = 8


@dataclass(frozen=True)
class _Text:
    """The lines of a text file that count, with their numbers."""

    path: Path
    lines: Sequence[tuple[int, str]]
    separator: str | None  # None: blanks
    expected: int  # cells in a line
    meaning: str  # what the expected number of cells follows from
    names: Mapping[int, str] = field(default_factory=dict)  # by column


def parse_csv(content: bytes, shape: tuple[int, int], path: Path, n_frequencies: int = 1) -> Recording:
    """Read the frames of a text file.

    Parameters
    ----------
    content : bytes
    shape : (rows, cols)
        Pixels of a frame in the file's own orientation.
    path : Path
        For messages.
    n_frequencies : int
        Modulation frequencies of the sensor. A line with a value for each pixel and frequency holds one frequency after
        the other, and its arrays are called ``frequency_range`` and so on.

    Raises
    ------
    InputFileError
        The content is not text, a value is not a number, or columns are missing; names file, line and column.

    Warns
    -----
    UserWarning
        Columns are ignored, or time stamps repeat or run backwards.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputFileError(f"{path}: is not CSV, NPY, NPZ, HDF5 or PNG, but text in UTF-16: write it as UTF-8")
    if "\0" in text:
        raise InputFileError(f"{path}: is not CSV, NPY, NPZ, HDF5 or PNG")
    stated = stated_in(text)
    lines = [
        (number, line)
        for number, line in enumerate(io.StringIO(text, newline=None), start=1)
        if line.strip() and not line.startswith("#")
    ]
    del text
    first_frame = lines[:2][-1][1] if lines else ""  # a header's names may have separators of their own, or none
    separator = next((mark for mark in _SEPARATORS if mark in first_frame), None)
    for mark in (*_SEPARATORS, None):  # a header that names columns has the separator of the values
        names = [name.lower() for name in _cells(lines[0][1], mark)] if lines else []
        if any(name in SECONDS_PER_TIME_UNIT or _group_of(name) for name in names):
            return _parse_named(names, lines, mark, stated, shape, path, n_frequencies)
        if "mm_0_0" in names:
            raise InputFileError(f"{path}: a log of targets, not of ranges: match it on targets")
    # quotation marks aside: one that is not closed would make a single cell, and so a header, of a frame
    first = _cells(lines[0][1].replace('"', ""), separator) if lines else []
    header = _is_header(first, separator) or (len(lines) > 1 and _are_pixel_numbers(first))
    pixels = f"{shape[0]} × {shape[1]} pixels"
    expected, name = math.prod(shape), "range"
    if n_frequencies > 1 and len(_cells(first_frame, separator)) != expected:
        expected, name = n_frequencies * expected, "frequency_range"
        pixels = f"{pixels} at each of {n_frequencies} frequencies"
    body = _Text(path, lines[1 if header else 0 :], separator, expected, pixels)
    return Recording({name: _numbers(body, range(body.expected))}, stated, flat=True)


def stated_in(text: str) -> dict[str, str]:
    """Return unit and quantity, as far as a first line of comment states them."""
    first = text.partition("\n")[0]
    return dict(_STATED.findall(first)) if first.startswith("#") else {}


def _parse_named(
    names: list[str],
    lines: Sequence[tuple[int, str]],
    separator: str | None,
    stated: dict[str, str],
    shape: tuple[int, int],
    path: Path,
    n_frequencies: int,
) -> Recording:
    """Read a file whose header names its columns."""
    place = f"{path}: line {lines[0][0]}"
    groups = _groups(names, shape, place, n_frequencies)
    pixels = next((prefix for prefix in _PIXELS if prefix in groups), None)
    if pixels is None:
        last = math.prod(shape) - 1
        raise InputFileError(
            f"{place}: names no columns of pixels, which must be mm_0 … mm_{last}, range_0 … range_{last} or"
            f" z_0 … z_{last}"
        )
    time = one_time(names, place)
    for key, value in _PIXELS[pixels].items():
        if stated.get(key, value) != value:
            raise InputFileError(f"{place}: has columns {pixels}_0 …, but the first line says {key}={stated[key]}")
        stated[key] = value

    tilts = [name for name in TILTS if name in names]
    columns = [names.index(name) for name in (*tilts, *([time] if time else []))]
    start = len(columns)
    columns += [column for group in groups.values() for column in group]
    body = _Text(path, lines[1:], separator, len(names), "the columns that the header names", dict(enumerate(names)))
    numbers = _numbers(body, columns)
    time_s = _times_s(numbers[:, len(tilts)], time, body) if time else None
    tilt_deg = {name: _tilt_deg(numbers[:, k], name, body) for k, name in enumerate(tilts)}
    arrays = {}
    for prefix, group in groups.items():
        name = "range" if prefix in _PIXELS else prefix
        name = f"frequency_{name}" if len(group) > math.prod(shape) else name
        arrays[name] = numbers[:, start : start + len(group)]
        start += len(group)
    _note_ignored(names, columns, path)
    return Recording(arrays, stated, time_s, tilt_deg, flat=True, named=True)


def _groups(names: list[str], shape: tuple[int, int], place: str, n_frequencies: int) -> dict[str, list[int]]:
    """Return the columns of each numbered group, in the order of their numbers.

    There must be one a pixel, or one for each frequency of a pixel.
    """
    found: dict[str, dict[int, int]] = {}
    for column, name in enumerate(names):
        match = _group_of(name)
        if match is None and name not in (*SECONDS_PER_TIME_UNIT, *TILTS):
            continue
        if name in names[:column]:
            raise InputFileError(f"{place}: names the column '{name}' twice")
        if match is not None:
            found.setdefault(match[1], {})[int(match[2])] = column
    pixels = [prefix for prefix in found if prefix in _PIXELS]
    if len(pixels) > 1:
        raise InputFileError(f"{place}: has columns {pixels[0]}_0 … and {pixels[1]}_0 …: leave one of them out")
    for prefix, columns in found.items():
        layers = n_frequencies if max(columns) >= math.prod(shape) and prefix not in ("status", "valid") else 1
        expected, each = layers * math.prod(shape), f" at each of {layers} frequencies" if layers > 1 else ""
        if sorted(columns) != list(range(expected)):
            missing = next((k for k in range(expected) if k not in columns), None)
            gap = "" if missing is None else f"; '{prefix}_{missing}' is missing"
            raise InputFileError(
                f"{place}: has {len(columns)} columns '{prefix}_*', must have {expected}, from '{prefix}_0' to"
                f" '{prefix}_{expected - 1}' ({shape[0]} × {shape[1]} pixels{each}){gap}"
            )
    return {prefix: [columns[k] for k in range(len(columns))] for prefix, columns in found.items()}


def _group_of(name: str) -> re.Match[str] | None:
    """Return prefix and number of a column that belongs to a group of one column a pixel."""
    match = _NUMBERED.fullmatch(name)
    return match if match is not None and match[1] in (*_PIXELS, *_OTHER_GROUPS) else None


def _times_s(values: NDArray[np.float64], name: str, body: _Text) -> NDArray[np.float64]:
    """Return time stamps in seconds; each line must have one."""
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise InputFileError(
            f"{body.path}: line {body.lines[bad[0]][0]}: has no time: '{name}' must be a finite number"
        )
    note_disorder(values, body.path, lambda k: f"line {body.lines[k][0]}")
    return in_seconds(values, name, body.path, lambda k: f"line {body.lines[k][0]}")


def _tilt_deg(values: NDArray[np.float64], name: str, body: _Text) -> NDArray[np.float64]:
    """Return the pitch or roll of each line; each must have one that is possible."""
    bad = np.flatnonzero(~(np.abs(values) <= MOST_TILT_DEG))
    if bad.size:
        raise InputFileError(
            f"{body.path}: line {body.lines[bad[0]][0]}: '{name}' must be within ± {MOST_TILT_DEG:g}° (a positive pitch"
            f" looks down), got {values[bad[0]]:g}"
        )
    return values


def _note_ignored(names: list[str], used: list[int], path: Path) -> None:
    ignored = [name for column, name in enumerate(names) if column not in set(used) and name]
    ignored = [name for name in ignored if not _OUR_OWN.fullmatch(name)]
    if ignored:
        more = f" and {len(ignored) - _MOST_NAMED} more" if len(ignored) > _MOST_NAMED else ""
        warnings.warn(f"{path}: ignores the columns {', '.join(ignored[:_MOST_NAMED])}{more}", stacklevel=2)


def _numbers(body: _Text, columns: Sequence[int]) -> NDArray[np.float64]:
    """Return some columns of every line, (lines, columns); NaN where a cell is empty.

    NumPy's reader is fast but says little of what is wrong. So what it refuses is read again cell by cell.
    """
    if not body.lines:
        raise InputFileError(f"{body.path}: holds no frames")
    fast = _fast_numbers([line for _, line in body.lines], body.separator, body.expected, columns)
    return _checked_numbers(body, columns) if fast is None else fast


def _fast_numbers(
    lines: list[str], separator: str | None, expected: int, columns: Sequence[int]
) -> NDArray[np.float64] | None:
    """Return the numbers of plain lines; None where one is not plain."""
    if any('"' in line for line in lines):
        return None
    counts = {len(line.split()) if separator is None else line.count(separator) + 1 for line in lines}
    if counts != {expected}:
        return None
    if separator == ";":
        lines = [line.replace(",", ".") for line in lines]  # decimal commas
    filled = lines if separator is None else _with_empty_cells_as_nan(lines, separator)
    try:
        return np.loadtxt(filled, np.float64, comments=None, delimiter=separator, usecols=list(columns), ndmin=2)
    except ValueError:
        return None


def _with_empty_cells_as_nan(lines: list[str], separator: str) -> Iterator[str]:
    pair, filled = 2 * separator, f"{separator}nan{separator}"
    for line in lines:
        line = line.rstrip("\n").replace(pair, filled).replace(pair, filled)  # twice: pairs overlap
        yield ("nan" if line.startswith(separator) else "") + line + ("nan" if line.endswith(separator) else "")


def _checked_numbers(body: _Text, columns: Sequence[int]) -> NDArray[np.float64]:
    """Return the numbers as :func:`_numbers`, or say which cell is not one."""
    frames = np.empty((len(body.lines), len(columns)))
    for k, (number, line) in enumerate(body.lines):
        cells = _cells(line, body.separator)
        if len(cells) != body.expected:
            raise InputFileError(
                f"{body.path}: line {number} has {len(cells)} values, must have {body.expected} ({body.meaning})"
            )
        for position, column in enumerate(columns):
            value = _to_float(cells[column], body.separator)
            if value is None:
                name = f" ({body.names[column]})" if column in body.names else ""
                raise InputFileError(
                    f"{body.path}: line {number}, column {column + 1}{name} must be a number, got"
                    f" {cells[column][:40]!r}"
                )
            frames[k, position] = value
    return frames


def _cells(line: str, separator: str | None) -> list[str]:
    cells = line.split() if separator is None else next(csv.reader([line], delimiter=separator))
    return [cell.strip() for cell in cells]


def _is_header(cells: list[str], separator: str | None) -> bool:
    filled = [cell for cell in cells if cell.lower() not in _NOT_A_NUMBER]
    return bool(filled) and all(_to_float(cell, separator) is None for cell in filled)


def _are_pixel_numbers(cells: list[str]) -> bool:
    """Return whether a line counts the pixels from 0 or 1, as a table's header of numbers does."""
    fewest_pixels = 9
    return len(cells) >= fewest_pixels and cells in ([str(k + first) for k in range(len(cells))] for first in (0, 1))


def _to_float(cell: str, separator: str | None) -> float | None:
    """Return a cell's number, NaN if it is empty, or None if it is neither."""
    if cell.lower() in _NOT_A_NUMBER:
        return math.nan
    try:
        number = float(cell.replace(",", ".", 1) if separator == ";" else cell)
    except ValueError:
        return None
    return None if "_" in cell else number  # Python reads 1_000 as a number; nobody else does
