"""Faces of a curved patch found without an intersector: by a step across edges, or by a look into a grid.

It is for patches that bulge everywhere, and for those with an apex. On a bulge a ray meets the front of one face at
most, so the face found is the one that is seen. Slivers that fan out from an apex lie in boxes that all meet there, so
that a hierarchy of boxes separates them badly: on a cone a cast ray takes three times as long as on a cylinder.

Neighbouring samples of an interval see the same smooth patch, so the face of one is near that of the other. From a face
the plane of which a ray meets outside it, the search goes on to the neighbour on that side. Where the plane is met far
outside, a grid over the patches says which face lies about there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.render.kernel import inlined, inner, kernel

_MOST_CELLS = 1 << 18
"""Of the grid."""
_FINER = 1.5
"""Cells of the grid per face that is crossed."""
_MOST_STEPS = 16
_GRAZING = 1e-3
"""Cosine between ray and normal below which the plane of a face says little of where the surface is met."""


class FaceGrid(NamedTuple):
    """A face for every cell of the box around all faces of the grid.

    Parameters
    ----------
    low : (3,) float64
        Lower corner of the box around all faces of the grid, metres.
    per_metre : (3,) float64
        Cells per metre along each axis: as fine as the faces are, so that slivers along z ask for few cells in z.
    faces : (nx, ny, nz) int32
        A face that runs through the cell or near it, −1: there is none at all.
    """

    low: NDArray[np.float64]
    per_metre: NDArray[np.float64]
    faces: NDArray[np.int32]

    @classmethod
    def of_faces(cls, corners: NDArray[np.float64], wanted: NDArray[np.bool_]) -> FaceGrid:
        """Build a grid over faces from their corners (f, 3, 3) and a mask of the faces that are searched.

        A cell gets the face that runs nearest to its middle, judged by points no further apart than half a cell; a cell
        without any gets that of the nearest cell, counted along the axes.
        """
        if not wanted.any():
            return cls(np.zeros(3), np.ones(3), np.full((1, 1, 1), -1, np.int32))
        own = corners[wanted]
        low, side = own.min(axis=(0, 1)), np.ptp(own, axis=(0, 1))
        cells = np.maximum(side * _finest(own), 1e-9)
        cells *= min(1.0, _MOST_CELLS / float(np.maximum(cells, 1.0).prod())) ** (1 / max(1, (cells > 1.0).sum()))
        shape = np.floor(cells).astype(np.int64) + 1
        per_metre = shape / np.maximum(side, 1e-9 * side.max())
        faces, distance = np.full(shape, -1, np.int32), np.full(shape, np.inf)
        _fill_grid(_shortest_edge_first((own - low) * per_metre), np.flatnonzero(wanted), faces, distance)
        distance[faces >= 0] = 0.0
        _spread(faces, distance)
        return cls(low, per_metre, faces)


def _finest(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how many cells per metre a grid needs along each axis; slivers along z need them in x and y only."""
    edges = np.roll(corners, -1, axis=1) - corners
    longest = np.take_along_axis(edges, np.linalg.norm(edges, axis=2).argmax(axis=1)[:, None, None], axis=1)[:, 0]
    normals = np.cross(edges[:, 0], edges[:, 1])
    across = np.cross(normals, longest)  # its length is twice the area times that of the longest edge
    width = np.linalg.norm(normals, axis=1) / np.linalg.norm(longest, axis=1)
    return _FINER * np.asarray((np.abs(across) / (np.linalg.norm(across, axis=1) * width)[:, None]).mean(axis=0))


def _shortest_edge_first(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn triangles (f, 3, 3) so that their first edge is the shortest."""
    shortest = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).argmin(axis=1)
    order = (shortest[:, None] + np.arange(3)) % 3
    return np.ascontiguousarray(np.take_along_axis(corners, order[..., None], axis=1))


@kernel
def _fill_grid(corners, numbers, faces, distance):  # type: ignore[no-untyped-def]
    """Assign to each cell the face that runs nearest to its middle.

    `corners` (f, 3, 3) in cells, the shortest edge first, so that a sliver takes a row of points and no square of them.
    """
    for f in range(len(corners)):
        ax, ay, az = corners[f, 0, 0], corners[f, 0, 1], corners[f, 0, 2]
        bx, by, bz = corners[f, 1, 0] - ax, corners[f, 1, 1] - ay, corners[f, 1, 2] - az
        cx, cy, cz = corners[f, 2, 0] - ax, corners[f, 2, 1] - ay, corners[f, 2, 2] - az
        n_b = 1 + int(2 * math.sqrt(bx * bx + by * by + bz * bz))
        n_c = 1 + int(2 * math.sqrt(cx * cx + cy * cy + cz * cz))
        for i in range(n_b + 1):
            for j in range(n_c + 1):
                v, w = i / n_b, j / n_c
                if v + w > 1.0 + 1e-9:
                    continue
                gx, gy, gz = ax + v * bx + w * cx, ay + v * by + w * cy, az + v * bz + w * cz
                x = min(max(int(gx), 0), faces.shape[0] - 1)
                y = min(max(int(gy), 0), faces.shape[1] - 1)
                z = min(max(int(gz), 0), faces.shape[2] - 1)
                away = (gx - x - 0.5) ** 2 + (gy - y - 0.5) ** 2 + (gz - z - 0.5) ** 2
                if away < distance[x, y, z]:
                    distance[x, y, z], faces[x, y, z] = away, numbers[f]


@kernel
def _spread(faces, distance):  # type: ignore[no-untyped-def]
    """Assign to cells without a face that of the nearest cell with one, in one pass up and one down each axis."""
    nx, ny, nz = faces.shape
    for step in (1, -1):
        for a in range(nx):
            i = a if step > 0 else nx - 1 - a
            for b in range(ny):
                j = b if step > 0 else ny - 1 - b
                for c in range(nz):
                    k = c if step > 0 else nz - 1 - c
                    for x, y, z in ((i - step, j, k), (i, j - step, k), (i, j, k - step)):
                        inside = 0 <= x < nx and 0 <= y < ny and 0 <= z < nz
                        if inside and distance[x, y, z] + 1.0 < distance[i, j, k]:
                            distance[i, j, k], faces[i, j, k] = distance[x, y, z] + 1.0, faces[x, y, z]


@inner
def _face_about(grid, x, y, z):  # type: ignore[no-untyped-def]
    """Return a face near a point, −1 where there is none at all."""
    cells = grid.faces
    # clamped before the conversion: a ray along a plane meets it at any distance
    i = min(max((x - grid.low[0]) * grid.per_metre[0], 0.0), cells.shape[0] - 1.0)
    j = min(max((y - grid.low[1]) * grid.per_metre[1], 0.0), cells.shape[1] - 1.0)
    k = min(max((z - grid.low[2]) * grid.per_metre[2], 0.0), cells.shape[2] - 1.0)
    return cells[int(i), int(j), int(k)]


@inner
def plane_hit(search, f, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return the multiple of a ray at which it meets the plane of a face; 0 for a ray along it."""
    face = search[f]
    facing = face[0] * dx + face[1] * dy + face[2] * dz
    return (face[3] - face[0] * ox - face[1] * oy - face[2] * oz) / facing if facing != 0.0 else 0.0


@inlined
def look_about(search, grid, f, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return a face of the patch near where a ray meets the plane of its face f; f itself where the grid has none."""
    face = search[f]
    facing = face[0] * dx + face[1] * dy + face[2] * dz
    if facing > 0.0 or facing * facing < _GRAZING * _GRAZING * (dx * dx + dy * dy + dz * dz):
        return f
    t = (face[3] - face[0] * ox - face[1] * oy - face[2] * oz) / facing
    g = _face_about(grid, ox + t * dx, oy + t * dy, oz + t * dz)
    return g if g >= 0 and search[g, 15] == face[15] else f


@inner
def find_face(search, grid, start, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return the face of a smooth patch that a ray meets, and the multiple of the ray there; (−1, 0) if none is found.

    Parameters
    ----------
    search : (f, 16) float32
        ``MeshTopology.search``; all that is asked of a face stands in one row, which is a line of the cache.
    grid : FaceGrid
    start : int
        A face of the patch, from which the search starts.
    ox, oy, oz, dx, dy, dz : float
        The ray, landmark frame.
    """
    f, before, looks = start, -1, 0
    patch = search[start, 15]
    grazing = _GRAZING * _GRAZING * (dx * dx + dy * dy + dz * dz)
    most_looks = 6  # into the grid, for one ray
    far = 1.5  # barycentric coordinate below minus this: the face is far from the hit, and the grid is asked
    edge = 1e-3  # barycentric coordinate below minus this: the ray does not meet the edge between two faces
    for _ in range(_MOST_STEPS):
        face = search[f]
        # all that follows is multiplied by `facing`, so that no step waits for a division
        facing = -(face[0] * dx + face[1] * dy + face[2] * dz)
        if facing < 0.0 or facing * facing < grazing:
            return -1, 0.0
        height = face[0] * ox + face[1] * oy + face[2] * oz - face[3]
        along = face[4] * dx + face[5] * dy + face[6] * dz
        v = (face[4] * ox + face[5] * oy + face[6] * oz + face[7]) * facing + along * height
        along = face[8] * dx + face[9] * dy + face[10] * dz
        w = (face[8] * ox + face[9] * oy + face[10] * oz + face[11]) * facing + along * height
        u = facing - v - w
        least = min(u, v, w)
        if least >= 0.0:
            return f, height / facing
        if least < -far * facing and looks < most_looks:
            looks += 1
            t = height / facing
            g = _face_about(grid, ox + t * dx, oy + t * dy, oz + t * dz)
            if g >= 0 and g != f and search[g, 15] == patch:
                before, f = -1, g
                continue
        # across the edge that lies opposite the corner
        g = int(face[13 if least == u else (14 if least == v else 12)])
        if g < 0:
            return -1, 0.0
        if g == before:  # on the edge between the two
            return (f, height / facing) if least > -edge * facing else (-1, 0.0)
        before, f = f, g
    return -1, 0.0


@inlined
def turns_smoothly(search, f, g, x, y, z):  # type: ignore[no-untyped-def]
    """Return whether a smooth surface may run from a hit on face f to one on face g, (x, y, z) further on.

    On an arc the chord makes the same angle with both normals. Where a ray met another sheet of the patch, behind the
    one that is seen, it does not.
    """
    lean = (search[f, 0] + search[g, 0]) * x + (search[f, 1] + search[g, 1]) * y + (search[f, 2] + search[g, 2]) * z
    # sine by which a chord between two hits may lean on the mean of their normals; on an arc it does not at all
    smooth = 0.1
    return lean * lean <= smooth * smooth * (x * x + y * y + z * z)
