"""Charts of numbers: one style for all figures, and the parts that they are made of.

Colours differ for the colour-blind, and marks and strokes differ without colour. Figures are built without pyplot, as
those of :mod:`phasemark.render.figures` are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Ellipse
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import ArrayLike, NDArray
from scipy import special

STYLES = (
    ("#0072B2", "o", "-"), ("#D55E00", "s", "--"), ("#009E73", "^", ":"), ("#CC79A7", "D", "-."),
    ("#56B4E9", "v", "-"), ("#E69F00", "P", "--"),
)  # fmt: skip
"""Colour, mark and stroke of what a figure compares."""
ENLARGED = 10.0
"""Ellipses of centimetres would be lost in a room of metres."""


def style(k: int) -> tuple[str, str, str]:
    """Return colour, mark and stroke of the k-th of the things compared."""
    return STYLES[k % len(STYLES)]


def marked(k: int, **changes: Any) -> dict[str, Any]:
    """Return the look of the k-th of the things compared, as keywords of matplotlib, with changes."""
    colour, mark, stroke = style(k)
    return {"color": colour, "marker": mark, "linestyle": stroke, "markersize": 4, "linewidth": 1, **changes}


def panels(columns: int, rows: int = 1, *, width: float = 5.0, height: float = 3.7) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure with rows of panels; width and height of one, inches."""
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return figure, [list(row) for row in figure.subplots(rows, columns, squeeze=False)]


def panels_of(n: int, *, height: float) -> tuple[Figure, Iterator[Axes]]:
    """Return a figure with n panels, two a row."""
    figure, rows = panels(min(2, n), -(-n // 2), height=height)
    every = [panel for row in rows for panel in row]
    for panel in every[n:]:
        panel.set_axis_off()
    return figure, iter(every[:n])


def explain(
    panel: Axes,
    x: str,
    y: str,
    title: str | None = None,
    *,
    grid: Literal["major", "both"] | None = "major",
    legend: Literal["best", "upper left", "lower right"] | None = None,
) -> None:
    """Give a panel its labels, title, grid, and a legend at a place that matplotlib knows."""
    panel.set_xlabel(x)
    panel.set_ylabel(y)
    if title is not None:
        panel.set_title(title, fontsize=9)
    if grid is not None:
        panel.grid(which=grid, linewidth=0.3)
    if legend is not None:
        panel.legend(fontsize=7, loc=legend)


def legend_above(figure: Figure, panel: Axes) -> None:
    """Put the legend of a panel above all: with many entries it would cover what it explains."""
    figure.legend(*panel.get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=7)


def enlarged_ellipse(pose: ArrayLike, covariance: NDArray[np.float64], **look: Any) -> Ellipse:
    """Return the 95 % ellipse of the position of a pose (x, y, …), `ENLARGED` times."""
    x, y = np.asarray(pose, np.float64)[:2].tolist()
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    axes = 2 * ENLARGED * np.sqrt(np.maximum(values, 0) * special.chdtri(2, 0.05))
    angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    return Ellipse((x, y), float(axes[1]), float(axes[0]), angle=angle, fc="none", **look)


def with_intervals(panel: Axes, x: ArrayLike, estimates: Sequence[Any], **look: Any) -> None:
    """Draw estimates, which have a value, low and high, with their intervals; an unknown end is left out."""
    low, y, high = (np.array([getattr(one, end) for one in estimates]) for end in ("low", "value", "high"))
    bars = np.abs([y - low, high - y])
    panel.errorbar(x, y, np.where(np.isfinite(bars), bars, 0.0), capsize=2, **look)


def written_table(
    panel: Axes,
    table: NDArray[np.float64],
    columns: tuple[str, Sequence[str]],
    rows: tuple[str, Sequence[str]],
    texts: NDArray[np.object_],
    dark: NDArray[np.bool_],
    **how: Any,
) -> AxesImage:
    """Draw a table of numbers as colours with a text in each cell, white where the colour is dark.

    Parameters
    ----------
    panel : Axes
    table : (m, n) float64
    columns, rows : (str, sequence of str)
        The label of the axis, and those of its cells.
    texts : (m, n) object
    dark : (m, n) bool
    how
        Arguments of ``imshow``.
    """
    image = panel.imshow(table, aspect="auto", **how)
    for (i, j), text in np.ndenumerate(texts):
        panel.text(j, i, text, ha="center", va="center", color="white" if dark[i, j] else "black", fontsize=7)
    for axis, (label, names) in ((panel.xaxis, columns), (panel.yaxis, rows)):
        axis.set_ticks(range(len(names)), names)
        axis.set_label_text(label)
    return image


def as_written(name: str) -> str:
    r"""Return a user's name as matplotlib has to be given it: between two ``$`` it would read a formula.

    Examples
    --------
    >>> print(as_written("5$ camera, 9$ lens"))
    5\$ camera, 9\$ lens
    """
    return name.replace("$", r"\$")


def median(values: Sequence[float]) -> float:
    """Return the median of the finite values, NaN if there is none."""
    finite = [value for value in values if math.isfinite(value)]
    return float(np.median(finite)) if finite else math.nan


def logarithmic(axis: Axis, ticks: Sequence[float] | None = None) -> None:
    """Make an axis logarithmic, its numbers written out: 0.2, not 2 × 10⁻¹."""
    axis.axes.set(**{f"{axis.axis_name}scale": "log"})  # type: ignore[attr-defined]
    if ticks is None:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    else:
        axis.set_ticks(list(ticks))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
