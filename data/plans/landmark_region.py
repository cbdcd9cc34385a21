"""Region of a camera's pixels that the landmarks of a bank can reach; only these are stored and matched."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render import Sensor, Views
from phasemark.render.sensor.region import Region

_AROUND = 96
"""Points on each rim of the cylinder that encloses a landmark."""


def landmark_region(
    sensor: Sensor, meshes: Sequence[trimesh.Trimesh], distance_m: Sequence[float], binning: int, margin_rad: float
) -> Region:
    """Return the smallest region of whole blocks that holds every landmark, from every side, with a margin.

    A landmark is taken for the upright cylinder about its axis that encloses it. Where the optical axis meets the
    middle of the image, the region stays centred, so that a bank can still be factored.

    Parameters
    ----------
    sensor : Sensor
    meshes : sequence of trimesh.Trimesh
    distance_m : sequence of float
        The grid of distances.
    binning : int
        Pixels along each side of a block.
    margin_rad : float
        How far the landmark may be off its place in the image, to every side.

    Returns
    -------
    Region

    Raises
    ------
    UsageError
        No landmark is in view at any distance.
    """
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for mesh in meshes:
        for nearest in (min(distance_m), max(distance_m)):
            rims = _rims_in_tangents(sensor, mesh, nearest)
            low, high = np.minimum(low, rims.min(axis=0)), np.maximum(high, rims.max(axis=0))
    if not _pixels_within(sensor, low, high).any():
        raise UsageError("'region' must be 'whole' or four numbers here: no landmark is in view at any distance")
    seen = _pixels_within(sensor, np.tan(np.arctan(low) - margin_rad), np.tan(np.arctan(high) + margin_rad))
    rows = _whole_blocks(*_extent(seen, 1), sensor.rows, sensor.centre_px[1], binning)
    cols = _whole_blocks(*_extent(seen, 0), sensor.cols, sensor.centre_px[0], binning)
    return Region(*rows, *cols, binning)


def whole_region(sensor: Sensor, binning: int) -> Region:
    """Return the largest region of whole blocks, as near the middle of the image as can be.

    Parameters
    ----------
    sensor : Sensor
    binning : int

    Returns
    -------
    Region
    """
    rows = _whole_blocks(0, sensor.rows, sensor.rows, sensor.centre_px[1], binning)
    return Region(*rows, *_whole_blocks(0, sensor.cols, sensor.cols, sensor.centre_px[0], binning), binning)


def _rims_in_tangents(sensor: Sensor, mesh: trimesh.Trimesh, distance_m: float) -> NDArray[np.float64]:
    """Return the rims of the cylinder that encloses a landmark straight ahead, tangents (y, z) of the camera."""
    points = np.asarray(mesh.vertices)
    radius = float(np.hypot(points[:, 0], points[:, 1]).max())
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    rim = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    heights = points[:, 2].min(), points[:, 2].max()
    corners = np.concatenate([np.column_stack([rim, np.full(_AROUND, z)]) for z in heights])
    rotation, translation = Views.broadcast(distance_m).in_camera(sensor).landmark2cam()
    seen = (corners @ rotation[0].T + translation[0]) @ sensor.cam2level
    ahead = np.maximum(seen[:, :1], 1e-3)  # a rim that reaches behind the lens fills the image
    return np.asarray(seen[:, 1:] / ahead)


def _pixels_within(sensor: Sensor, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which pixels reach into a rectangle of tangents (y, z), (rows, cols)."""
    v, u = np.mgrid[: sensor.rows + 1, : sensor.cols + 1].astype(np.float64)
    tangents = np.stack(sensor.tangents(u, v), axis=-1)
    corners = np.stack([tangents[:-1, :-1], tangents[:-1, 1:], tangents[1:, :-1], tangents[1:, 1:]])
    return np.asarray(((corners.max(axis=0) > low) & (corners.min(axis=0) < high)).all(axis=-1))


def _extent(seen: NDArray[np.bool_], axis: int) -> tuple[int, int]:
    """Return first and stop of what is true anywhere along an axis."""
    where = np.flatnonzero(seen.any(axis=axis))
    return int(where[0]), int(where[-1]) + 1


def _whole_blocks(low: float, high: float, size: int, centre: float, n: int) -> tuple[int, int]:
    """Return first and stop of whole blocks that hold [low, high], as far as the image of some size reaches."""
    if size < n:
        raise UsageError(f"'binning' must be at most {size}, the image's size, got {n}")
    low, high = max(low, 0.0), min(high, float(size))
    if centre == size / 2 and size % 2 == 0:  # the region stays centred
        half = min(math.ceil(max(centre - low, high - centre) / n), size // 2 // n) * n
        if half > 0:
            return size // 2 - half, size // 2 + half
    first = math.floor(low)
    count = min(math.ceil((high - first) / n), size // n)
    first = min(first, size - count * n)
    return first, first + count * n
