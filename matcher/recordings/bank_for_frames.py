"""The bank that frames ask for: over the distances at which a landmark in them can be told."""

from __future__ import annotations

import math

import numpy as np

from phasemark import UsageError
from phasemark.render import Frames
from phasemark.render.integral.surface_mesh import SurfaceMesh

__all__ = ["distances_of_frames"]

_ROUNDED_M, _STEP_M = 0.1, 0.01
"""Distances end at multiples of this, so that other frames find the same bank; and the step between them."""


def distances_of_frames(frames: Frames, mesh: SurfaceMesh) -> tuple[float, ...]:
    """Return the distances of a bank for some frames, metres.

    Parameters
    ----------
    frames : Frames
    mesh : trimesh.Trimesh
        The landmark.

    Raises
    ------
    UsageError
        The landmark cannot be in the frames: nothing returns, or all returns are nearer than it reaches, or farther
        away than it can be told.
    """
    vertices = np.asarray(mesh.vertices, np.float64)
    radius_m = float(np.hypot(vertices[:, 0], vertices[:, 1]).max())
    ranges = frames.range_m[frames.valid]
    if not ranges.size:
        raise UsageError("no pixel of the frames has a valid range: there is nothing to build a bank for")
    across_m = max(2 * radius_m, float(np.ptp(vertices[:, 2])))
    # A landmark that spans fewer pixels than this is not told: farther away the bank has no views.
    pixels_across = 1.5
    told_m = across_m / (pixels_across * frames.sensor.pixel_rad)
    nearest_m, farthest_m = float(np.min(ranges)), float(np.max(ranges))
    gap_m = 0.02  # smallest gap between the lens and the circle around a landmark
    start = max(radius_m + gap_m, nearest_m)
    stop = min(farthest_m + radius_m, told_m)
    if radius_m > farthest_m or not start < stop:
        raise UsageError(
            f"a landmark of {across_m:.3g} m cannot be in these frames: their ranges are {nearest_m:.3g} …"
            f" {farthest_m:.3g} m, and this camera tells it from {radius_m + gap_m:.3g} m to {told_m:.3g} m; check the"
            " mesh's unit"
        )
    first = max(math.floor(start / _ROUNDED_M) * _ROUNDED_M, math.ceil((radius_m + gap_m) / _STEP_M) * _STEP_M)
    last = max(math.ceil(stop / _ROUNDED_M) * _ROUNDED_M, first + 2 * _ROUNDED_M)
    n = round((last - first) / _STEP_M) + 1
    return tuple(np.round(first + _STEP_M * np.arange(n), 4).tolist())
