"""Words and axes of a sweep's figures."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.axis import Axis

from phasemark.matcher.sweep.result_tables import Cell
from phasemark.render.charts import logarithmic

SHOWN = {"distance_m": ("distance", "mm", 1e3), "delta_rad": ("angle δ", "°", 180 / math.pi)}
"""Parameters that are drawn: name, unit, and the factor to it."""
AXIS_LABEL = {
    "class_name": "class",
    "distance_m": "distance D (m)", "delta_deg": "angle δ (°)", "noise_factor": "noise, relative to the sensor's",
    "n_frames": "frames averaged", "bearing_deg": "bearing (°)", "height_m": "height (m)", "pitch_deg": "pitch (°)",
    "roll_deg": "roll (°)",
    "albedo": "albedo", "wall_m": "wall (m)", "wiggling": "wiggling, relative to square against square",
    "unit": "unit, with its fixed pattern", "dimension_error": "relative error of the dimensions",
    "floor_m": "floor below the lens (m)", "bounces": "bounces of the light",
}  # fmt: skip
LOGARITHMIC = ("distance_m", "noise_factor", "n_frames", "albedo")
NOMINAL = ("unit", "wall_m", "floor_m", "bounces")
"""Axes whose values lie beside one another without anything between them; 0 stands for none."""


def methods_of(cells: Sequence[Cell]) -> list[str]:
    """Return the names of the methods in the plan's order."""
    return list(dict.fromkeys(cell.method for cell in cells))


def value_ticks(axis: Axis, name: str, values: Sequence[float]) -> None:
    """Put a design's values on an axis: each of them, if they are few."""
    most_ticks = 9
    if name in NOMINAL:
        axis.set_ticks(range(len(values)), ["none" if value == 0 else f"{value:g}" for value in values])
    elif name in LOGARITHMIC:
        logarithmic(axis, values)
    elif len(values) <= most_ticks:
        axis.set_ticks(list(values), [f"{value:g}" for value in values])
