"""Poses among walls, seen from above: a panel a recording, with ellipses, and truth where it is known."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from phasemark.matcher.locate.kernel_arguments import Outline
from phasemark.matcher.locate.locator import LocatedPose
from phasemark.render.charts import ENLARGED, enlarged_ellipse, explain, legend_above, panels_of, style

_ARROW_M = 0.15


def locate_figure(
    drives: Sequence[tuple[str, Outline, Sequence[LocatedPose], NDArray[np.float64] | None]],
) -> Figure:
    """Draw the poses of recordings in their maps.

    Parameters
    ----------
    drives : sequence of (name, outline, answers, truth)
        Truth is (n, 3), NaN where it is not known, or None.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure, axes = panels_of(len(drives), height=5.2)
    for panel, (name, outline, answers, truth) in zip(axes, drives, strict=True):
        panel.add_collection(LineCollection(list(outline.pieces.reshape(-1, 2, 2)), colors="#777777", linewidths=1.5))
        if truth is not None:
            panel.plot(*truth[:, :2].T, "x", color="#1a1a1a", ms=5, label="truth")
        _draw(panel, [one for one in answers if one.accepted], 0, f"accepted, 95 % ellipses × {ENLARGED:g}")
        _draw(panel, [one for one in answers if not one.accepted and math.isfinite(one.x_m)], 1, "refused")
        panel.set_aspect("equal")
        explain(panel, "x (m)", "y (m)", name)
        legend_above(figure, panel) if panel is figure.axes[0] else None
    return figure


def _draw(panel: Axes, answers: Sequence[LocatedPose], k: int, label: str) -> None:
    """Draw poses with their headings and ellipses."""
    colour, mark, _ = style(k)
    if not answers:
        return
    x, y, yaw = np.array([one.pose for one in answers]).T
    panel.plot(x, y, mark, color=colour, ms=3, label=label)
    ends = np.column_stack([x, y, x + _ARROW_M * np.cos(yaw), y + _ARROW_M * np.sin(yaw)])
    panel.add_collection(LineCollection(list(ends.reshape(-1, 2, 2)), colors=colour, linewidths=1))
    for one in answers if k == 0 else ():
        panel.add_patch(enlarged_ellipse(one.pose, one.covariance, ec=colour, lw=0.8))
