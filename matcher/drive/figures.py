"""The drive seen from above: three paths, ellipses, landmarks; and errors over the way."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from phasemark.landmarks import catalog
from phasemark.matcher.drive.simulate import Drive, Stop, pose_error
from phasemark.matcher.sequence.planar import rotation
from phasemark.render.charts import ENLARGED, enlarged_ellipse, explain

_TRUE, _DEAD, _CORRECTED, _MARK = "#1a1a1a", "#c8553d", "#2a6fbb", "#5b8c5a"


def drive_figure(drive: Drive) -> Figure:
    """Draw the room with the three paths, and beside it the errors over the way.

    Parameters
    ----------
    drive : Drive
        The drive.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = Figure(figsize=(13.5, 6.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.75, 1))
    room = figure.add_subplot(grid[:, 0])
    _draw_room(room, drive)
    room.plot(*drive.true[:, :2].T, color=_TRUE, lw=2.6, label="true")
    room.plot(*drive.dead_reckoned[:, :2].T, color=_DEAD, lw=1.4, label="dead reckoning")
    room.plot(*drive.corrected[:, :2].T, color=_CORRECTED, lw=1.2, ls="--", label="corrected")
    for stop in drive.stops:
        _draw_stop(room, stop)
    final = pose_error(drive.dead_reckoned[-1], drive.true[-1])
    room.set_title(
        f"{drive.way_m[-1]:.1f} m, {len(drive.corrections)} corrections; dead reckoning ends"
        f" {np.hypot(*final[:2]):.2f} m and {abs(math.degrees(final[2])):.0f}° off",
        fontsize=10,
    )
    # the legend stands below the room: no corner of it is sure to be empty
    room.plot([], [], color=_CORRECTED, lw=0.8, label=f"95 % ellipses before and after a correction, × {ENLARGED:g}")
    room.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=4, fontsize=8, frameon=False)
    _draw_errors(figure.add_subplot(grid[0, 1]), drive, position=True)
    _draw_errors(figure.add_subplot(grid[1, 1]), drive, position=False)
    return figure


def _draw_room(axes: Axes, drive: Drive) -> None:
    """Draw walls, planned path and landmarks."""
    plan = drive.plan
    if plan.map.room_m:
        axes.add_patch(Polygon(plan.map.room_m, closed=True, fc="none", ec="#777777", lw=2.5))
    axes.plot(*np.array(plan.path.waypoints_m).T, color="#bbbbbb", lw=5, solid_joinstyle="round", zorder=0)
    specs = catalog()
    for landmark in plan.map.landmark:
        box = specs[landmark.class_name].box
        corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [box.length_m / 2, box.width_m / 2]
        corners = corners @ rotation(landmark.yaw_rad).T + landmark.xy_m
        axes.add_patch(Polygon(corners, closed=True, fc=_MARK, ec="none"))
        words = f"{landmark.name}: {landmark.class_name}"
        how: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "fontsize": 8, "color": _MARK}
        axes.annotate(words, landmark.xy_m, (0, -13), **how)
    everything = np.concatenate([drive.true, drive.dead_reckoned])[:, :2]
    corners = np.array([*plan.map.room_m, *(landmark.xy_m for landmark in plan.map.landmark)])
    low = np.minimum(everything.min(axis=0), corners.min(axis=0)) - 0.25
    high = np.maximum(everything.max(axis=0), corners.max(axis=0)) + 0.25
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x (m)", ylabel="y (m)")


def _draw_stop(axes: Axes, stop: Stop) -> None:
    """Draw the line of sight, and the ellipses before and after; a refused measurement is a cross."""
    axes.plot([stop.true[0], stop.landmark.x_m], [stop.true[1], stop.landmark.y_m], color=_MARK, lw=0.6, ls=":")
    if not stop.used:
        axes.plot(*stop.true[:2], "x", color=_DEAD, ms=7, zorder=5)
        return
    axes.add_patch(enlarged_ellipse(stop.before, stop.covariance_before, ec=_CORRECTED, lw=0.8, zorder=3))
    axes.add_patch(enlarged_ellipse(stop.after, stop.covariance_after, ec=_CORRECTED, lw=1.4, zorder=3))
    axes.add_patch(Circle((float(stop.true[0]), float(stop.true[1])), 0.035, fc=_TRUE, ec="none", zorder=4))


def _draw_errors(axes: Axes, drive: Drive, *, position: bool) -> None:
    """Draw the errors of dead reckoning and filter over the way, and what the filter thinks of its own."""
    paths = ((drive.dead_reckoned, _DEAD, "dead reckoning"), (drive.corrected, _CORRECTED, "corrected"))
    for pose, color, label in paths:
        error = pose_error(pose, drive.true)
        value = 100 * np.hypot(error[:, 0], error[:, 1]) if position else np.degrees(np.abs(error[:, 2]))
        axes.plot(drive.way_m, np.maximum(value, 1e-3), color=color, lw=1.2, label=label)
    x, y, heading = np.einsum("nii->in", drive.covariance)
    variance = 1e4 * (x + y) if position else np.degrees(1) ** 2 * heading
    axes.plot(drive.way_m, np.sqrt(variance), color=_CORRECTED, lw=0.9, ls=":", label="its own standard deviation")
    for stop in drive.corrections:
        axes.axvline(stop.way_m, color=_MARK, lw=0.7, zorder=0)
    limits = (0.1, 300.0) if position else (0.02, 60.0)
    axes.set(yscale="log", ylim=limits, xlim=(0, float(drive.way_m[-1])))
    if position:
        explain(axes, "", "position error (cm)", grid=None, legend="upper left")
    else:
        explain(axes, "way (m); a green line is a correction", "heading error (°)", grid=None)
