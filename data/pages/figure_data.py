"""The numbers that a figure shows, read back from the figure itself, as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HEADER = ("panel", "x_axis", "y_axis", "series", "x", "y", "low", "high", "value")
"""`low` and `high` are the ends of a bar about y; `value` is the number that a colour stands for."""


def figure_csv(*figures: Figure) -> bytes:
    """Return the points, bars, arrows and colours of figures as CSV, one row each; what has no number is left empty.

    Parameters
    ----------
    *figures : matplotlib.figure.Figure

    Returns
    -------
    bytes
        UTF-8, with the columns :data:`HEADER`.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(HEADER)
    for figure in figures:
        for number, axes in enumerate(figure.axes):
            if axes.get_label() == "<colorbar>" or not axes.axison:
                continue
            name = next(filter(None, (axes.get_title(where) for where in ("center", "left"))), str(number + 1))
            labels = (name, axes.get_xlabel(), axes.get_ylabel())
            for series, *numbers in _series(axes):
                writer.writerow([*labels, series, *(_cell(each) for each in numbers)])
    return text.getvalue().encode()


def _series(axes: Axes) -> Iterator[tuple[str, float, float, float, float, float]]:
    """Yield series, x, y, low, high and value."""
    from matplotlib.collections import LineCollection
    from matplotlib.container import ErrorbarContainer
    from matplotlib.quiver import Quiver

    nothing = math.nan
    drawn = set()
    for container in (each for each in axes.containers if isinstance(each, ErrorbarContainer)):
        line, caps, bars = container
        drawn |= {line, *caps}
        series = str(container.get_label())
        drawn |= set(bars)
        segments = [np.asarray(one) for one in bars[-1].get_segments()] if bars else []
        for k, (x, y) in enumerate(np.asarray(line.get_xydata())):
            known = k < len(segments) and len(segments[k]) > 1  # a bar of a point that is not finite is empty
            low, high = (segments[k][:, 1].min(), segments[k][:, 1].max()) if known else (nothing, nothing)
            yield _named(series), x, y, low, high, nothing
    for line in axes.lines:
        if line not in drawn and line.get_transform() == axes.transData:
            for x, y in np.asarray(line.get_xydata()):
                yield _named(str(line.get_label())), x, y, nothing, nothing, nothing
    for one in axes.collections:
        if isinstance(one, Quiver):
            along = np.stack([np.asarray(one.U, np.float64), np.asarray(one.V, np.float64)], axis=1)
            ends = np.concatenate([np.asarray(one.get_offsets(), np.float64), along], axis=1)
            for x, y, u, v in ends:
                yield "arrow, to the right", x, y, nothing, nothing, float(u)
                yield "arrow, upwards", x, y, nothing, nothing, float(v)
        elif isinstance(one, LineCollection) and one not in drawn:
            for segment in one.get_segments():
                (x, y), (to_x, to_y) = np.asarray(segment)[[0, -1]]
                if x == to_x:
                    yield _named(str(one.get_label())), x, (y + to_y) / 2, y, to_y, nothing
                else:
                    yield _named(str(one.get_label())), x, y, nothing, nothing, nothing
                    yield _named(str(one.get_label())), to_x, to_y, nothing, nothing, nothing
    for image in axes.images:
        table = np.ma.filled(np.ma.asarray(image.get_array(), np.float64), np.nan)
        if table.ndim != 2:
            continue
        left, right, below, above = image.get_extent()
        for row, column in np.ndindex(table.shape):
            x = left + (column + 0.5) * (right - left) / table.shape[1]
            level = row + 0.5 if image.origin == "lower" else table.shape[0] - row - 0.5
            y = below + level * (above - below) / table.shape[0]
            yield "colour", x, y, nothing, nothing, float(table[row, column])


def _named(label: str) -> str:
    """Return the label of a series; matplotlib's own names, which begin with an underscore, say nothing."""
    return "" if label.startswith("_") else label


def _cell(value: float | NDArray[np.float64]) -> str:
    number = float(value)
    return f"{number:.10g}" if math.isfinite(number) else ""
