"""Style of a sweep's figures: colours that differ for the colour-blind, marks that differ without colour."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from phasemark.matcher.sweep.plan import MODEL_ERRORS, Condition
from phasemark.matcher.sweep.result_tables import Cell

_STYLES = (
    ("#0072B2", "o", "-"), ("#D55E00", "s", "--"), ("#009E73", "^", ":"), ("#CC79A7", "D", "-."),
    ("#56B4E9", "v", "-"), ("#E69F00", "P", "--"),
)  # fmt: skip
SHOWN = {"distance_m": ("distance", "mm", 1e3), "delta_rad": ("angle δ", "°", 180 / math.pi)}
"""Parameters that are drawn: name, unit, and the factor to it."""
AXIS_LABEL = {
    "distance_m": "distance D (m)", "delta_deg": "angle δ (°)", "noise_factor": "noise, relative to the sensor's",
    "n_frames": "frames averaged", "bearing_deg": "bearing (°)", "height_m": "height (m)", "pitch_deg": "pitch (°)",
    "roll_deg": "roll (°)",
    "albedo": "albedo", "wall_m": "wall (m)", "wiggling": "wiggling, relative to square against square",
    "unit": "unit, with its fixed pattern", "dimension_error": "relative error of the dimensions",
}  # fmt: skip
COLUMN_NAME = {**AXIS_LABEL, "class_name": "class"}
"""What a table calls an axis of a design."""
LOGARITHMIC = ("distance_m", "noise_factor", "n_frames", "albedo")
NOMINAL = ("unit", "wall_m")
"""Axes whose values lie beside one another without anything between them; 0 stands for none."""
_MOST_TICKS = 9


@dataclass(frozen=True)
class SweepFigure:
    """A figure with what it shows in words.

    Parameters
    ----------
    name : str
        Of its files.
    title, text : str
    figure : Figure
    """

    name: str
    title: str
    text: str
    figure: Figure


def style(k: int) -> tuple[str, str, str]:
    """Return colour, mark and stroke of method k."""
    return _STYLES[k % len(_STYLES)]


def as_written(name: str) -> str:
    r"""Return a user's name as matplotlib has to be given it: between two ``$`` it would read a formula.

    Examples
    --------
    >>> print(as_written("5$ camera, 9$ lens"))
    5\$ camera, 9\$ lens
    """
    return name.replace("$", r"\$")


def methods_of(cells: Sequence[Cell]) -> list[str]:
    """Return the names of the methods in the plan's order."""
    return list(dict.fromkeys(cell.method for cell in cells))


def panels(columns: int, rows: int = 1, *, width: float = 5.0, height: float = 3.7) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure with rows of panels; width and height of one, inches."""
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return figure, [list(row) for row in figure.subplots(rows, columns, squeeze=False)]


def median(values: Sequence[float]) -> float:
    """Return the median of the finite values, NaN if there is none."""
    finite = [value for value in values if math.isfinite(value)]
    return float(np.median(finite)) if finite else math.nan


def logarithmic(axis: Axis, ticks: Sequence[float] | None = None) -> None:
    """Make an axis logarithmic, its numbers written out: 0.2, not 2 × 10⁻¹."""
    axis.axes.set(**{f"{axis.axis_name}scale": "log"})  # type: ignore[attr-defined]
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    if ticks is None:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(plain)
    else:
        axis.set_ticks(list(ticks))
        axis.set_major_formatter(plain)
    axis.set_minor_formatter(NullFormatter())


def value_ticks(axis: Axis, name: str, values: Sequence[float]) -> None:
    """Put a design's values on an axis: each of them, if they are few."""
    if name in NOMINAL:
        axis.set_ticks(range(len(values)), ["none" if value == 0 else f"{value:g}" for value in values])
    elif name in LOGARITHMIC:
        logarithmic(axis, values)
    elif len(values) <= _MOST_TICKS:
        axis.set_ticks(list(values), [f"{value:g}" for value in values])


def is_as_told(condition: Condition) -> bool:
    """Return whether a condition is as a method takes it to be."""
    return all(getattr(condition, name) == 0 for name in MODEL_ERRORS)
