"""A figure of filtered ranges."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from phasemark.render.figures import draw_map, draw_range, nearest_limits_m


def filtered_figure(range_m: NDArray[np.float64], std_m: NDArray[np.float64]) -> Figure:
    """Draw the range of one position beside its standard deviation; the colours span the nearest surface.

    Parameters
    ----------
    range_m, std_m : (rows, cols) float64

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = Figure(figsize=(8.4, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.set_title("range")
    near, far = nearest_limits_m(range_m)
    draw_range(left, range_m, near_m=near, far_m=far)
    std_mm = 1e3 * np.where(np.isfinite(std_m), std_m, np.nan)
    draw_map(right, std_mm, "standard deviation", "standard deviation (mm)", cmap="viridis", vmin=0)
    return figure
