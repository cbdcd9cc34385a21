"""Curves along which faces pass through one another, of two bodies or of one mesh: edges like any other."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark.render.integral.mesh_topology import MeshTopology

_BLOCK = 32
"""Faces that are looked at together."""
_TOUCH = 1e-9
"""Share of the extent up to which a corner that lies beyond a plane only touches it; rounding is less."""


def crossings(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], others: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return where triangles of one body pass through those of another.

    Faces that only touch, and faces in one plane, do not cross. Faces that follow one another are looked at together:
    they are near one another in space.

    Parameters
    ----------
    vertices : (v, 3) float64
        Metres.
    faces : (f, 3) int32
    others : (g, 3) int32
        Of the other body; `faces` itself: pairs of one body are found at least once, the lower number first.

    Returns
    -------
    ends : (k, 2, 3) float64
        Of the segments.
    pairs : (k, 2) int64
        Numbers of both faces.
    """
    blocks, other_blocks = _block_bounds(vertices, faces), _block_bounds(vertices, others)
    touch = _TOUCH * float(np.abs(blocks).max())
    room = 64
    while True:
        ends, pairs = np.empty((room, 2, 3)), np.empty((room, 2), np.int64)
        n = _cross(vertices, faces, others, blocks, other_blocks, touch, others is faces, ends, pairs)
        if n <= room:
            return ends[:n], pairs[:n]
        room = n


def cut_where_it_crosses_itself(mesh: MeshTopology) -> MeshTopology:
    """Return a mesh whose creases include the curves along which its faces pass through one another.

    They may be seen from any side, and hide nothing for certain: the mesh counts as open.
    """
    ends, pairs = crossings(mesh.vertices, mesh.faces, mesh.faces)
    once = pairs[:, 0] < pairs[:, 1]
    if not once.any():
        return mesh
    return with_creases(mesh._replace(closed=np.zeros(len(mesh.faces), np.bool_)), ends[once], pairs[once], False)


def with_creases(
    mesh: MeshTopology, ends: NDArray[np.float64], pairs: NDArray[np.int64], concave: bool
) -> MeshTopology:
    """Return a mesh with segments (k, 2, 3) between pairs of faces (k, 2) among its creases."""
    number = len(mesh.vertices) + np.arange(2 * len(ends)).reshape(-1, 2)
    return mesh._replace(
        vertices=np.concatenate([mesh.vertices, ends.reshape(-1, 3)]),
        creases=np.concatenate([mesh.creases, np.column_stack([number, pairs]).astype(np.int32)]),
        concave=np.concatenate([mesh.concave, np.full(len(ends), concave)]),
    )


@njit(cache=True, nogil=True)
def move_onto(mesh, pairs, ends):  # type: ignore[no-untyped-def]
    """Move ends of segments, (k, 2, 3), onto the quadrics that the triangles of both bodies stand for.

    Gauss–Newton steps of least length, on the faces `pairs` (k, 2). Where surfaces only touch, and where an end would
    move by more than the longest segment, it stays.
    """
    gradient, value, steps, longest = np.empty((2, 3)), np.empty(2), 3, 0.0
    for k in range(len(ends)):
        square = 0.0
        for i in range(3):
            square += (ends[k, 1, i] - ends[k, 0, i]) ** 2
        longest = max(longest, square)
    for k in range(len(ends)):
        if mesh.quadric[pairs[k, 0]] < 0 and mesh.quadric[pairs[k, 1]] < 0:
            continue
        for end in range(2):
            x, start = ends[k, end], ends[k, end].copy()
            for _ in range(steps):
                for i in range(2):
                    value[i] = _height(mesh, pairs[k, i], x, gradient[i])
                a, b, c = 0.0, 0.0, 0.0
                for i in range(3):
                    a += gradient[0, i] * gradient[0, i]
                    b += gradient[0, i] * gradient[1, i]
                    c += gradient[1, i] * gradient[1, i]
                determinant = a * c - b * b
                if determinant <= 1e-4 * a * c:
                    break
                first = (c * value[0] - b * value[1]) / determinant
                second = (a * value[1] - b * value[0]) / determinant
                for i in range(3):
                    x[i] -= first * gradient[0, i] + second * gradient[1, i]
            moved = 0.0
            for i in range(3):
                moved += (x[i] - start[i]) ** 2
            if not moved < longest:
                x[:] = start


@njit(cache=True, nogil=True)
def _height(mesh, f, x, gradient):  # type: ignore[no-untyped-def]
    """Return how far a point is before the surface of a face, to first order a multiple of it; fill the gradient."""
    if mesh.quadric[f] < 0:
        gradient[:] = mesh.planes[f, :3]
        return gradient[0] * x[0] + gradient[1] * x[1] + gradient[2] * x[2] - mesh.planes[f, 3]
    q = mesh.quadrics[mesh.quadric[f]]
    hx = q[0] * x[0] + q[3] * x[1] + q[4] * x[2] + q[6]
    hy = q[3] * x[0] + q[1] * x[1] + q[5] * x[2] + q[7]
    hz = q[4] * x[0] + q[5] * x[1] + q[2] * x[2] + q[8]
    gradient[0], gradient[1], gradient[2] = 2.0 * hx, 2.0 * hy, 2.0 * hz
    return x[0] * (hx + q[6]) + x[1] * (hy + q[7]) + x[2] * (hz + q[8]) + q[9]


@njit(cache=True, nogil=True)
def _block_bounds(vertices, faces):  # type: ignore[no-untyped-def]
    """Return lowest and highest coordinates of blocks of faces, (b, 2, 3)."""
    out = np.empty(((len(faces) + _BLOCK - 1) // _BLOCK, 2, 3))
    out[:, 0], out[:, 1] = np.inf, -np.inf
    for f in range(len(faces)):
        own = out[f // _BLOCK]
        for i in range(3):
            for k in range(3):
                x = vertices[faces[f, i], k]
                own[0, k], own[1, k] = min(own[0, k], x), max(own[1, k], x)
    return out


@njit(cache=True, nogil=True)
def _reaching(vertices, faces, block, bounds, found):  # type: ignore[no-untyped-def]
    """Write the faces of a block that reach into bounds (2, 3); return how many there are."""
    count = 0
    for f in range(block * _BLOCK, min((block + 1) * _BLOCK, len(faces))):
        apart = False
        for k in range(3):
            a, b, c = vertices[faces[f, 0], k], vertices[faces[f, 1], k], vertices[faces[f, 2], k]
            apart = apart or max(a, b, c) < bounds[0, k] or min(a, b, c) > bounds[1, k]
        if not apart:
            found[count] = f
            count += 1
    return count


@njit(cache=True, nogil=True)
def _cross(vertices, faces, others, blocks, other_blocks, touch, once, ends, pairs):  # type: ignore[no-untyped-def]
    """Write the segments along which triangles cross; return how many there are, also beyond the room for them."""
    count = 0
    inside, beyond, height, at = np.empty((2, 3)), np.empty((2, 3)), np.empty(3), np.empty(2)
    own, other = np.empty(_BLOCK, np.int64), np.empty(_BLOCK, np.int64)
    a, b = np.empty((3, 3)), np.empty((3, 3))
    for p in range(len(blocks)):
        for q in range(p if once else 0, len(other_blocks)):
            apart = False
            for k in range(3):
                apart = apart or blocks[p, 1, k] < other_blocks[q, 0, k] or blocks[p, 0, k] > other_blocks[q, 1, k]
            if apart:
                continue
            n, m = (
                _reaching(vertices, faces, p, other_blocks[q], own),
                _reaching(vertices, others, q, blocks[p], other),
            )
            for i in range(n):
                for k in range(3):
                    for axis in range(3):
                        a[k, axis] = vertices[faces[own[i], k], axis]
                for j in range(m):
                    for k in range(3):
                        for axis in range(3):
                            b[k, axis] = vertices[others[other[j], k], axis]
                    apart = False
                    for k in range(3):
                        apart = apart or max(a[0, k], a[1, k], a[2, k]) < min(b[0, k], b[1, k], b[2, k])
                        apart = apart or max(b[0, k], b[1, k], b[2, k]) < min(a[0, k], a[1, k], a[2, k])
                    if apart:
                        continue
                    if not _through(a, b, touch, inside, height) or not _through(b, a, touch, beyond, height):
                        continue
                    begin, end = _overlap(inside, beyond, touch, at)
                    if begin >= end:
                        continue
                    if count < len(ends):
                        for k in range(3):
                            along = inside[1, k] - inside[0, k]
                            ends[count, 0, k] = inside[0, k] + begin * along
                            ends[count, 1, k] = inside[0, k] + end * along
                        pairs[count, 0], pairs[count, 1] = own[i], other[j]
                    count += 1
    return count


@njit(cache=True, nogil=True)
def _overlap(inside, beyond, touch, at):  # type: ignore[no-untyped-def]
    """Return the shares of a segment between which another on the same line covers it; equal where it does not."""
    square = 0.0
    at[0] = at[1] = 0.0
    for k in range(3):
        along = inside[1, k] - inside[0, k]
        square += along * along
        for i in range(2):
            at[i] += along * (beyond[i, k] - inside[0, k])
    if square <= touch * touch:
        return 0.0, 0.0
    begin, end = max(min(at[0], at[1]) / square, 0.0), min(max(at[0], at[1]) / square, 1.0)
    return (begin, end) if (end - begin) * math.sqrt(square) > touch else (0.0, 0.0)


@njit(cache=True, nogil=True)
def _through(a, b, touch, ends, height):  # type: ignore[no-untyped-def]
    """Find where triangle `a` passes through the plane of `b`, into `ends` (2, 3); return whether it does."""
    ux, uy, uz = b[1, 0] - b[0, 0], b[1, 1] - b[0, 1], b[1, 2] - b[0, 2]
    vx, vy, vz = b[2, 0] - b[0, 0], b[2, 1] - b[0, 1], b[2, 2] - b[0, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    if length == 0.0:
        return False
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
