"""Numbers in the cells of tables of text."""

from __future__ import annotations

import csv
import math

from phasemark import InputFileError

_SHOWN = 40
"""Characters of a cell that a message shows."""


def cells_of(line: str, where: str, separator: str = ",") -> list[str]:
    """Return the cells of one line of a table; a quotation mark that is not closed does not reach the next line.

    Parameters
    ----------
    line : str
    where : str
        File and line, for the message.
    separator : str

    Returns
    -------
    list of str

    Raises
    ------
    InputFileError
        A quotation mark is not closed, or a cell is longer than any number.

    Examples
    --------
    >>> cells_of('1.5,"2"', "poses.csv, line 2")
    ['1.5', '2']
    """
    try:
        return next(csv.reader([line], delimiter=separator, strict=True))
    except csv.Error as error:
        raise InputFileError(f"{where}: is no line of CSV ({error}); a quotation mark must be closed") from None


def finite_number(cell: str, where: str, column: str, *, empty_is_nan: bool = False) -> float:
    """Return the number in a cell of a table.

    Parameters
    ----------
    cell : str
    where : str
        File and line, for the message.
    column : str
        Name of the column, for the message.
    empty_is_nan : bool
        Whether an empty cell is NaN; otherwise it is refused.

    Returns
    -------
    float

    Raises
    ------
    InputFileError
        The cell is not a finite number.

    Examples
    --------
    >>> finite_number(" 1.5e-3 ", "poses.csv, line 2", "x_m")
    0.0015
    """
    text = cell.strip()
    if not text and empty_is_nan:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = None
    if value is None or "_" in text:  # Python reads 1_000 as a number; nobody else does
        raise InputFileError(f"{where}: '{column}' must be a number, got {text[:_SHOWN]!r}")
    if not math.isfinite(value):
        raise InputFileError(f"{where}: '{column}' must be a finite number, got {text[:_SHOWN]}")
    return value
