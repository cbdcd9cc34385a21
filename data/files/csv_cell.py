"""Tables that a spreadsheet program may open."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from typing import Any


def csv_text(rows: Iterable[Sequence[Any]]) -> str:
    """Return rows as CSV, text as :func:`as_cell` has it."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([as_cell(value) for value in row] for row in rows)
    return text.getvalue()


def nine_digits(value: Any) -> Any:
    """Return a number with nine digits, nothing where it is not finite; a truth as 0 or 1; anything else as it is.

    Examples
    --------
    >>> nine_digits(0.1 + 0.2), nine_digits(math.inf), nine_digits(True), nine_digits("cone")
    ('0.3', '', 1, 'cone')
    """
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        return f"{value:.9g}" if math.isfinite(value) else ""
    return value


def as_cell(value: Any) -> Any:
    """Return a value as a cell: text that a spreadsheet would run as a formula has an apostrophe before it.

    Examples
    --------
    >>> as_cell("=1+2"), as_cell("cone"), as_cell("-1.5")
    ("'=1+2", 'cone', '-1.5')
    """
    if not isinstance(value, str) or value[:1] not in ("=", "+", "-", "@", "\t", "\r"):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value
