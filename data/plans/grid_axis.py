"""Grids of distances and angles, written START:STOP:STEP, V1,V2,… or V."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError

MAX_POINTS = 100_000
_DECIMALS = 12  # values are rounded to this, so that 0.7 + 1 · 0.01 is the number 0.71


def parse_grid(grid: str | float | Sequence[float], name: str = "grid") -> NDArray[np.float64]:
    """Return the values of a grid, increasing.

    Parameters
    ----------
    grid : str, number or sequence of numbers
        ``"0.7:2.1:0.01"`` (STOP is included if it lies on the grid), ``"0.8,1,1.2"``, ``"1"``, or the numbers.
    name : str
        The option or key that holds the grid, for error messages.

    Returns
    -------
    ndarray, (n,) float64
        Rounded to 12 decimals, so that no step accumulates rounding errors.

    Raises
    ------
    UsageError
        A part is not a finite number, STEP is not positive, STOP lies below START, the values do not increase, or
        there are more than 100 000.

    Examples
    --------
    >>> parse_grid("0.7:0.72:0.01").tolist()
    [0.7, 0.71, 0.72]
    """
    if isinstance(grid, str):
        if ":" in grid:
            return _span(grid, name)
        parts: Sequence[str | float] = grid.split(",")
    elif isinstance(grid, bool) or not isinstance(grid, int | float | Sequence):
        raise UsageError(f"'{name}' must be START:STOP:STEP, a list of numbers or a number, got {grid!r}")
    else:
        parts = [grid] if isinstance(grid, int | float) else grid
    if len(parts) > MAX_POINTS:
        raise UsageError(f"'{name}' must have at most {MAX_POINTS} values, got {len(parts)}")
    if not parts:
        raise UsageError(f"'{name}' must have at least one value, got none")
    values = np.round([_number(part, grid, name) for part in parts], _DECIMALS)
    if np.any(np.diff(values) <= 0):
        raise UsageError(f"'{name}' must increase from value to value, got {_shown(grid)}")
    return values


def format_grid(values: NDArray[np.float64] | Sequence[float]) -> str:
    """Return the shortest text from which :func:`parse_grid` makes these values again.

    Parameters
    ----------
    values : sequence of float
        Values of the grid, increasing.

    Returns
    -------
    str

    Examples
    --------
    >>> format_grid([0.7, 0.71, 0.72])
    '0.7:0.72:0.01'
    """
    array = np.asarray(values, dtype=float)
    if len(array) > 2:
        step = float(np.round((array[-1] - array[0]) / (len(array) - 1), _DECIMALS))
        text = f"{_decimal(array[0])}:{_decimal(array[-1])}:{_decimal(step)}"
        if step > 0 and np.array_equal(parse_grid(text), array):
            return text
    return ",".join(_decimal(value) for value in array)


def parse_indices(text: str, n: int, name: str = "index") -> list[int]:
    """Return the numbers that a list of numbers and ranges names, increasing, each once.

    Parameters
    ----------
    text : str
        ``"0,17,200:210"``; a range has both its ends, as in a grid.
    n : int
        The numbers are 0 … n − 1.
    name : str
        The option that holds the text, for error messages.

    Raises
    ------
    UsageError
        A part is neither a number nor a range, or a number is n or above.

    Examples
    --------
    >>> parse_indices("17,0,4:6", 20)
    [0, 4, 5, 6, 17]
    """
    found: set[int] = set()
    for part in text.split(","):
        ends = part.strip().split(":")
        bounds = [count for end in ends if (count := as_count(end)) is not None]
        if len(bounds) != len(ends) or len(bounds) > 2 or bounds[0] > bounds[-1]:
            raise UsageError(f"{name} must be numbers and ranges such as 0,17,200:210, got {_shown(text)}")
        if bounds[-1] >= n:
            raise UsageError(f"{name} must be below {n}, the number of positions, got {bounds[-1]}")
        found.update(range(bounds[0], bounds[-1] + 1))
    return sorted(found)


def as_count(text: str) -> int | None:
    """Return the number that decimal digits write, or None for other text; one beyond 10¹⁸ counts as 10¹⁸."""
    if not (text.isascii() and text.isdigit()):
        return None
    most_digits = 18
    return int(text) if len(text.lstrip("0")) <= most_digits else 10**most_digits


def drop_repeated_stop(delta_deg: NDArray[np.float64], period_deg: float) -> NDArray[np.float64]:
    """Return a grid of angles without its last value if that is a full number of periods above the first."""
    turns = (delta_deg[-1] - delta_deg[0]) / period_deg
    repeats = len(delta_deg) > 1 and abs(turns - round(turns)) < 1e-9  # rounding of degrees to 12 decimals
    return delta_deg[:-1] if repeats else delta_deg


def _span(text: str, name: str) -> NDArray[np.float64]:
    parts = text.split(":")
    if len(parts) != 3:
        raise UsageError(f"'{name}' must be START:STOP:STEP, got {text!r}")
    start, stop, step = (_number(part, text, name) for part in parts)
    if step <= 0:
        raise UsageError(f"'{name}' must have a positive STEP, got {text!r}")
    if stop < start:
        raise UsageError(f"'{name}' must have a STOP that is not below START, got {text!r}")
    on_grid = 1e-6  # STOP lies on the grid when it is this close, in steps
    steps = (stop - start) / step + on_grid
    if steps >= MAX_POINTS:
        raise UsageError(f"'{name}' must have at most {MAX_POINTS} values, got {text!r}")
    return np.round(start + np.arange(math.floor(steps) + 1) * step, _DECIMALS)


def _number(part: str | float, grid: object, name: str) -> float:
    try:
        value = math.nan if isinstance(part, bool) else float(part)
    except (TypeError, ValueError, OverflowError):
        value = math.nan
    if not math.isfinite(value):
        raise UsageError(f"'{name}' must hold finite numbers, got {_shown(grid)}")
    return value


def _shown(grid: object) -> str:
    text = repr(grid)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _decimal(value: float) -> str:
    text = np.format_float_positional(value, trim="-")
    return text if text not in ("-0",) else "0"
