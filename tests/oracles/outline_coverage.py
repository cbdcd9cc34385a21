"""Oracle: the share of every pixel of a 16 × 16, 2 × 11° camera that an outline covers, exact for polygons."""

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

SIZE = 16
TAN = np.tan(np.radians(11.0))


def project(points: NDArray[Any], lens: NDArray[Any], heading: float) -> NDArray[Any]:
    """Return image coordinates (n, 2) of points for a level lens that looks along ``heading`` (PHYSICS section 2)."""
    x, y, z = (points - lens).T
    c, s = np.cos(heading), np.sin(heading)
    forward, left = c * x + s * y, -s * x + c * y
    return np.column_stack([SIZE / 2 * (1 - left / forward / TAN), SIZE / 2 * (1 - z / forward / TAN)])


def coverage_of_segments(start: NDArray[Any], end: NDArray[Any]) -> NDArray[Any]:
    """Return the (16, 16) coverage inside closed curves given as segments (n, 2) → (n, 2), each run the same way.

    Green's theorem: the area of a pixel inside is ∮ clamp(u − c, 0, 1) dv over its rows. Every segment is cut where
    it crosses a pixel border, and on each piece the integrand is linear.
    """
    step = end - start
    lines = np.arange(SIZE + 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        cuts = np.concatenate([(lines - start[:, :1]) / step[:, :1], (lines - start[:, 1:]) / step[:, 1:]], axis=1)
    cuts = np.clip(np.nan_to_num(cuts, nan=0.0, posinf=1.0, neginf=0.0), 0, 1)
    cuts = np.sort(np.concatenate([np.zeros((len(step), 1)), cuts, np.ones((len(step), 1))], axis=1), axis=1)
    middle = (cuts[:, 1:] + cuts[:, :-1]) / 2
    u = (start[:, :1] + middle * step[:, :1]).ravel()
    v = (start[:, 1:] + middle * step[:, 1:]).ravel()
    dv = (np.diff(cuts, axis=1) * step[:, 1:]).ravel()
    inside = (v > 0) & (v < SIZE)
    row = np.floor(v[inside]).astype(int)
    share = np.clip(u[inside, None] - np.arange(SIZE), 0, 1)
    area = np.zeros((SIZE, SIZE))
    np.add.at(area, row, share * dv[inside, None])
    return area if area.sum() >= 0 else -area


def coverage_of_hull(points_uv: NDArray[Any]) -> NDArray[Any]:
    """Return the coverage of the convex hull of image points."""
    hull = points_uv[ConvexHull(points_uv).vertices]
    return coverage_of_segments(hull, np.roll(hull, -1, axis=0))


def coverage_of_mesh(mesh: trimesh.Trimesh, lens: NDArray[Any], heading: float) -> NDArray[Any]:
    """Return the coverage of a closed mesh: the curves between faces that look at the lens and faces that do not."""
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front = np.einsum("ij,ij->i", normal, lens - corners[:, 0]) > 0
    uv = project(mesh.vertices, lens, heading)
    edges = mesh.faces[front][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    pair = np.sort(edges, axis=1) @ [len(uv), 1]
    _, index, count = np.unique(pair, return_index=True, return_counts=True)
    border = edges[index[count == 1]]
    return coverage_of_segments(uv[border[:, 0]], uv[border[:, 1]])
