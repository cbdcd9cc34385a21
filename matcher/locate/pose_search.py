"""Search of a whole map: ranges around every node of a grid, and the poses whose ranges come near a stop's."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark.matcher.locate.kernel_arguments import Outline, RigNumbers, Scan

_Float = NDArray[np.float64]

_SPACING_M = 0.1
_DIRECTIONS = 144
_TURNS = 72
_TOLERANCE_M = 0.25
"""A column that is farther off than this counts as one that is not explained: half a cell at 3 m is 0.15 m off."""
_WORSE = 0.25
"""Part of the columns by which a pose may explain fewer than the best one, at nodes of the grid."""
_FEWEST = 8
"""Local minima that are kept however bad: few columns tell little at nodes of a grid."""
_MOST_NODES = 200_000


class PoseGrid(NamedTuple):
    """Ranges around the nodes of a map."""

    corner_m: tuple[float, float]
    spacing_m: float
    shape: tuple[int, int]
    """Nodes along x and along y."""
    bounds_m: tuple[float, float, float, float]
    """Least x and y, greatest x and y, where a robot may be."""
    range_m: NDArray[np.float32]
    """(nodes, directions): of equal angles, the first along x; infinite where no wall is."""


def pose_grid(outline: Outline, reach_m: float) -> PoseGrid:
    """Compute the ranges around the nodes of a grid of all places where a robot may be.

    These are the bounds of a map that walls close; others by `reach_m` beyond, from where a sensor sees them still.
    """
    grid = _grid_over(outline, outline.bounds_m)
    inside = grid.range_m.reshape(*grid.shape, -1)[1:-1, 1:-1]  # others may stand in the walls
    ahead = np.isinf(inside)
    if inside.size and not (ahead & np.roll(ahead, 1, axis=2)).any():  # one direction alone passes between two walls
        return grid
    low_x, low_y, high_x, high_y = outline.bounds_m
    return _grid_over(outline, (low_x - reach_m, low_y - reach_m, high_x + reach_m, high_y + reach_m))


def _grid_over(outline: Outline, bounds_m: tuple[float, float, float, float]) -> PoseGrid:
    low_x, low_y, high_x, high_y = bounds_m
    wide, deep = high_x - low_x, high_y - low_y  # of a long map one row of nodes may be all
    spacing = max(_SPACING_M, math.sqrt(wide * deep / _MOST_NODES), max(wide, deep) / _MOST_NODES)
    shape = (int(wide / spacing) + 1, int(deep / spacing) + 1)
    corner = (low_x + 0.5 * (wide - (shape[0] - 1) * spacing), low_y + 0.5 * (deep - (shape[1] - 1) * spacing))
    range_m = np.empty((shape[0] * shape[1], _DIRECTIONS), np.float32)
    _ranges(outline.pieces, corner, spacing, shape[1], range_m)
    return PoseGrid(corner, spacing, shape, bounds_m, range_m)


def promising_poses(
    grid: PoseGrid,
    rig: RigNumbers,
    scan: Scan,
    most: int,
    around: tuple[_Float, _Float] | None = None,
) -> _Float:
    """Return poses whose ranges come near those of a stop, best first, (k, 3).

    Parameters
    ----------
    grid : PoseGrid
    rig : RigNumbers
    scan : Scan
    most : int
        Largest number of poses.
    around : (centre, reach), optional
        (3,) each: x, y, yaw of the region that is searched, and how far it extends. None: everywhere.
    """
    x, y = (low + grid.spacing_m * np.arange(n) for low, n in zip(grid.corner_m, grid.shape, strict=True))
    yaw = 2 * math.pi / _TURNS * np.arange(_TURNS)
    if around is not None:
        centre, reach = around
        x_near = np.flatnonzero(np.abs(x - centre[0]) <= reach[0] + grid.spacing_m)
        y_near = np.flatnonzero(np.abs(y - centre[1]) <= reach[1] + grid.spacing_m)
        off = np.abs((yaw - centre[2] + math.pi) % (2 * math.pi) - math.pi)
        turns = np.flatnonzero(off <= reach[2] + 2 * math.pi / _TURNS)
    else:
        x_near, y_near, turns = np.arange(len(x)), np.arange(len(y)), np.arange(_TURNS)
    if not (len(x_near) and len(y_near) and len(turns)):
        return np.empty((0, 3))
    direction, depth, cosine, before = _columns(rig, scan)
    nodes = (x_near[:, None] * grid.shape[1] + y_near).ravel()
    score = np.empty((len(nodes), len(turns)))
    _score(grid.range_m, nodes, np.asarray(yaw[turns], np.float64), direction, depth, cosine, before, score)
    volume = score.reshape(len(x_near), len(y_near), len(turns))
    best = _local_minima(volume, closed=len(turns) == _TURNS)[:most]
    limit = volume.min() + _WORSE * len(depth)
    best = best[(volume.ravel()[best] <= limit) | (np.arange(len(best)) < _FEWEST)]
    i, j, k = np.unravel_index(best, volume.shape)
    return np.column_stack([x[x_near[i]], y[y_near[j]], yaw[turns[k]]])


def _columns(rig: RigNumbers, scan: Scan) -> tuple[_Float, _Float, _Float, _Float]:
    """Return the direction of columns in the body's frame at the first frame, their depth, cosine and lever."""
    columns = scan.depth_m.shape[2]
    at = scan.time_s[:, None] - rig.delay_s
    turned = np.interp(at, scan.odometry_time_s, scan.odometry[:, 2])
    azimuth = (0.5 * (rig.columns[:, None] - 1) - np.arange(columns)) * rig.step_rad[:, None]
    direction = (turned + rig.yaw_rad)[:, :, None] + azimuth
    depth = (scan.depth_m - rig.offset_m[:, None]) / rig.scale[:, None]
    lever = rig.x_m * np.cos(rig.yaw_rad) + rig.y_m * np.sin(rig.yaw_rad)
    seen = np.isfinite(depth)
    cosine = np.broadcast_to(np.cos(azimuth), depth.shape)
    before = np.broadcast_to(lever[:, None], depth.shape)
    return direction[seen], depth[seen], cosine[seen], before[seen]


def _local_minima(volume: _Float, closed: bool) -> NDArray[np.int64]:
    """Return the cells, best first, that no neighbour of theirs undercuts; `closed`: the last axis is a circle."""
    least = volume
    for axis in range(3):
        padded = np.concatenate([least.take([-1], axis), least, least.take([0], axis)], axis)
        if axis < 2 or not closed:
            padded = np.pad(least, [(1, 1) if k == axis else (0, 0) for k in range(3)], constant_values=np.inf)
        length = volume.shape[axis]
        least = np.minimum.reduce([padded.take(range(k, k + length), axis) for k in range(3)])
    found = np.flatnonzero(volume.ravel() <= least.ravel())
    return found[np.argsort(volume.ravel()[found], kind="stable")]


@njit(cache=True, nogil=True, error_model="numpy")
def _ranges(
    pieces: _Float, corner: tuple[float, float], spacing: float, along_y: int, out: NDArray[np.float32]
) -> None:
    """Compute the range from each node in each direction."""
    for node in range(len(out)):
        x = corner[0] + spacing * (node // along_y)
        y = corner[1] + spacing * (node % along_y)
        for k in range(out.shape[1]):
            angle = 2 * np.pi * k / out.shape[1]
            cos, sin = np.cos(angle), np.sin(angle)
            best = np.inf
            for j in range(len(pieces)):
                to_x, to_y = pieces[j, 0] - x, pieces[j, 1] - y
                along_x, along_piece = pieces[j, 2] - pieces[j, 0], pieces[j, 3] - pieces[j, 1]
                across = cos * along_piece - sin * along_x
                if across == 0.0:
                    continue
                distance = (to_x * along_piece - to_y * along_x) / across
                place = (to_x * sin - to_y * cos) / across
                if 0.0 < distance < best and 0.0 <= place <= 1.0:
                    best = distance
            out[node, k] = best


@njit(cache=True, nogil=True, error_model="numpy")
def _score(
    range_m: NDArray[np.float32],
    nodes: NDArray[np.int64],
    yaw: _Float,
    direction: _Float,
    depth: _Float,
    cosine: _Float,
    before: _Float,
    out: _Float,
) -> None:
    """Add up how far the columns are off at each node and yaw, in tolerances, none more than 1."""
    n = range_m.shape[1]
    for j in range(len(yaw)):
        place = np.empty(len(direction), np.int64)
        for c in range(len(direction)):
            place[c] = int(np.floor((yaw[j] + direction[c]) * n / (2 * np.pi) + 0.5)) % n
        for i in range(len(nodes)):
            total = 0.0
            for c in range(len(direction)):
                off = abs(range_m[nodes[i], place[c]] * cosine[c] - before[c] - depth[c])
                total += min(off / _TOLERANCE_M, 1.0)
            out[i, j] = total
