"""The grid of a bank: over which period its angles close, which views are in its range, and what lies between nodes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phasemark.render.kernel import kernel

CELL_M, CELL_RAD = 0.02, math.radians(2.0)
"""Cells of the search: as large as they may be for most of what a pixel shows to change little within them."""


def is_in_range(
    distance_m: NDArray[np.float64], delta_rad: NDArray[np.float64], view: NDArray[np.float64], period_rad: float
) -> bool:
    """Return whether a view is in the range of a grid, with half a cell to either side, which the search covers.

    Parameters
    ----------
    distance_m, delta_rad : float64
        Of the grid.
    view : (≥ 2,) float64
        Distance and angle.
    period_rad : float
        Over which views of the landmark repeat.
    """
    if not distance_m[0] - CELL_M / 2 <= view[0] <= distance_m[-1] + CELL_M / 2:
        return False
    if closing_period(delta_rad) is not None:
        return True
    beyond = (view[1] - delta_rad[0] + CELL_RAD / 2) % period_rad
    return bool(beyond <= delta_rad[-1] - delta_rad[0] + CELL_RAD)


def first_step(grid: NDArray[np.float64]) -> float:
    """Return the first step of an axis; infinite of one point."""
    return float(grid[1] - grid[0]) if len(grid) > 1 else math.inf


def closing_period(delta_rad: NDArray[np.float64]) -> float | None:
    """Return the period over which a regular grid of angles closes: 2π / n, one step beyond its end; None if none."""
    if len(delta_rad) < 2:
        return None
    step = float(delta_rad[1] - delta_rad[0])
    turns = 2 * np.pi / (delta_rad[-1] - delta_rad[0] + step)
    return float(2 * np.pi / round(turns)) if round(turns) >= 1 and abs(turns - round(turns)) < 1e-6 else None


@kernel
def cubic_weights(f, weight, slope):  # type: ignore[no-untyped-def]
    """Fill Lagrange weights and their slopes for a place between the second and the third of four nodes."""
    weight[0] = -f * (f - 1) * (f - 2) / 6
    weight[1] = (f + 1) * (f - 1) * (f - 2) / 2
    weight[2] = -(f + 1) * f * (f - 2) / 2
    weight[3] = (f + 1) * f * (f - 1) / 6
    slope[0] = -(3 * f * f - 6 * f + 2) / 6
    slope[1] = (3 * f * f - 4 * f - 1) / 2
    slope[2] = -(3 * f * f - 2 * f - 2) / 2
    slope[3] = (3 * f * f - 1) / 6
