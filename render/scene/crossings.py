"""Curves along which the faces of two bodies pass through one another: edges of a scene like any other."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

_TOUCH = 1e-9
"""Share of the extent up to which a corner that lies beyond a plane only touches it; rounding is less."""


def crossings(
    corners: NDArray[np.float64], others: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return where triangles of one body pass through those of another.

    Faces that only touch, and faces in one plane, do not cross.

    Parameters
    ----------
    corners : (f, 3, 3) float64
        Metres.
    others : (g, 3, 3) float64

    Returns
    -------
    ends : (k, 2, 3) float64
        Of the segments.
    pairs : (k, 2) int64
        Numbers of both faces.
    """
    nothing = np.empty((0, 2, 3)), np.empty((0, 2), np.int64)
    low, high = np.maximum(corners.min((0, 1)), others.min((0, 1))), np.minimum(corners.max((0, 1)), others.max((0, 1)))
    if not (low < high).all():
        return nothing
    own, beyond = _within(corners, low, high), _within(others, low, high)
    if not len(own) or not len(beyond):
        return nothing
    # swept along x: a face meets only those that begin before it ends
    own = own[np.argsort(corners[own, :, 0].min(axis=1), kind="stable")]
    beyond = beyond[np.argsort(others[beyond, :, 0].min(axis=1), kind="stable")]
    touch = _TOUCH * float(max(np.abs(corners).max(), np.abs(others).max()))
    room = 64
    while True:
        ends, pairs = np.empty((room, 2, 3)), np.empty((room, 2), np.int64)
        n = _cross(corners[own], others[beyond], touch, ends, pairs)
        if n <= room:
            return ends[:n], np.column_stack([own[pairs[:n, 0]], beyond[pairs[:n, 1]]])
        room = n


def _within(corners: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return which faces reach into a box."""
    return np.flatnonzero(((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=1))


@njit(cache=True)
def _cross(corners, others, touch, ends, pairs):  # type: ignore[no-untyped-def]
    """Write the segments along which triangles cross; return how many there are, also beyond the room for them.

    Both lists are sorted by their lowest x.
    """
    count, first = 0, 0
    widest = 0.0
    for g in range(len(others)):
        reach = max(others[g, 0, 0], others[g, 1, 0], others[g, 2, 0])
        widest = max(widest, reach - min(others[g, 0, 0], others[g, 1, 0], others[g, 2, 0]))
    inside, beyond = np.empty((2, 3)), np.empty((2, 3))
    for f in range(len(corners)):
        a = corners[f]
        low, high = min(a[0, 0], a[1, 0], a[2, 0]), max(a[0, 0], a[1, 0], a[2, 0])
        while first < len(others) and min(others[first, 0, 0], others[first, 1, 0], others[first, 2, 0]) < low - widest:
            first += 1
        for g in range(first, len(others)):
            b = others[g]
            if min(b[0, 0], b[1, 0], b[2, 0]) > high:
                break
            apart = False
            for k in range(3):
                apart = apart or max(a[0, k], a[1, k], a[2, k]) < min(b[0, k], b[1, k], b[2, k])
                apart = apart or max(b[0, k], b[1, k], b[2, k]) < min(a[0, k], a[1, k], a[2, k])
            if apart or not _through(a, b, touch, inside) or not _through(b, a, touch, beyond):
                continue
            # both segments lie on the line in which the planes meet
            dx, dy, dz = inside[1, 0] - inside[0, 0], inside[1, 1] - inside[0, 1], inside[1, 2] - inside[0, 2]
            square = dx * dx + dy * dy + dz * dz
            if square <= touch * touch:
                continue
            at = np.empty(2)
            for i in range(2):
                at[i] = (
                    dx * (beyond[i, 0] - inside[0, 0])
                    + dy * (beyond[i, 1] - inside[0, 1])
                    + dz * (beyond[i, 2] - inside[0, 2])
                ) / square
            begin, end = max(min(at[0], at[1]), 0.0), min(max(at[0], at[1]), 1.0)
            if (end - begin) * math.sqrt(square) <= touch:
                continue
            if count < len(ends):
                for k in range(3):
                    along = inside[1, k] - inside[0, k]
                    ends[count, 0, k], ends[count, 1, k] = inside[0, k] + begin * along, inside[0, k] + end * along
                pairs[count, 0], pairs[count, 1] = f, g
            count += 1
    return count


@njit(cache=True)
def _through(a, b, touch, ends):  # type: ignore[no-untyped-def]
    """Find where triangle `a` passes through the plane of `b`, into `ends` (2, 3); return whether it does."""
    ux, uy, uz = b[1, 0] - b[0, 0], b[1, 1] - b[0, 1], b[1, 2] - b[0, 2]
    vx, vy, vz = b[2, 0] - b[0, 0], b[2, 1] - b[0, 1], b[2, 2] - b[0, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    if length == 0.0:
        return False
    height = np.empty(3)
    above, below = False, False
    for i in range(3):
        height[i] = (nx * (a[i, 0] - b[0, 0]) + ny * (a[i, 1] - b[0, 1]) + nz * (a[i, 2] - b[0, 2])) / length
        if abs(height[i]) <= touch:
            height[i] = 0.0
        above, below = above or height[i] > 0.0, below or height[i] < 0.0
    if not (above and below):
        return False
    n = 0
    for i in range(3):
        j = (i + 1) % 3
        if height[i] == 0.0 and n < 2:
            for k in range(3):
                ends[n, k] = a[i, k]
            n += 1
        elif height[i] * height[j] < 0.0 and n < 2:
            share = height[i] / (height[i] - height[j])
            for k in range(3):
                ends[n, k] = a[i, k] + share * (a[j, k] - a[i, k])
            n += 1
    return n == 2
