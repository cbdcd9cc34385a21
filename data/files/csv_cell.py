"""Cells of tables that a spreadsheet program may open."""

from __future__ import annotations

from typing import Any


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
