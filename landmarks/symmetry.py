"""The rotational symmetry of a mesh about the landmark's axis z' (PHYSICS section 8), found from its surface."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from phasemark import UsageError

MAX_SYMMETRY = 360
"""Largest symmetry of a plan; a body of revolution has it too: no side of it can be told from another."""

_MOST_POINTS = 20_000
_FIRST_POINTS = 64  # most turns are refused by these
_FACES_OF_LEAF = 4
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))

_Float = NDArray[np.float64]


def symmetry_tolerance_m(mesh: trimesh.Trimesh) -> float:
    """Return how far a turned mesh may lie from itself and still count as the same, metres.

    0.5 mm, which matching does not see at the distances of landmarks, or 1 % of the largest extent where that is less.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Metres.
    """
    tolerance_m = 0.5e-3  # a match tells positions to some 0.2 to 0.5 mm at 1 m: what differs by less looks the same
    tolerance_share = 0.01  # of the largest extent: 0.5 mm is no small part of a mesh below 5 cm
    return min(tolerance_m, tolerance_share * float(max(mesh.extents)))


def mesh_symmetry(mesh: trimesh.Trimesh) -> int:
    """Return the largest n such that every turn about z' by a multiple of 360°/n leaves the mesh as it is.

    Vertices, centroids of faces and points spread evenly over the area are turned; all of them have to lie within
    :func:`symmetry_tolerance_m` of the surface. The same mesh gives the same answer.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Metres, landmark frame.

    Returns
    -------
    int
        1 where there is no symmetry, at most `MAX_SYMMETRY`, which a body of revolution has.

    Examples
    --------
    >>> mesh_symmetry(trimesh.creation.box((0.2, 0.2, 0.1)))
    4
    """
    surface = _Surface(mesh)
    # a body of revolution may be turned by any angle: each point by one of its own, spread over the circle
    if surface.lies_on_itself(_GOLDEN_ANGLE * np.arange(len(surface.points))):
        return MAX_SYMMETRY
    found = 1
    for prime in _primes(MAX_SYMMETRY):
        while found * prime <= MAX_SYMMETRY and surface.repeats(found * prime):
            found *= prime
    return found


def has_symmetry(mesh: trimesh.Trimesh, n: int) -> bool:
    """Return True if every turn about z' by a multiple of 360°/n leaves the mesh as it is.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Metres, landmark frame.
    n : int
        At least 1.

    Raises
    ------
    UsageError
        `n` is less than 1.
    """
    if n < 1:
        raise UsageError(f"'n' must be a whole number of at least 1, got {n!r}")
    return n == 1 or _Surface(mesh).repeats(n)


def is_same_shape(first: trimesh.Trimesh, second: trimesh.Trimesh) -> bool:
    """Return True if two meshes are one within :func:`symmetry_tolerance_m`, as they lie.

    Parameters
    ----------
    first, second : trimesh.Trimesh
        Metres, landmark frame.
    """
    if np.abs(first.bounds - second.bounds).max() > symmetry_tolerance_m(first):
        return False
    one, other = _Surface(first), _Surface(second)
    return one.holds(other.points) and other.holds(one.points)


class _Surface:
    """A mesh with points on it, and a tree of boxes about its faces that tells what lies within the tolerance."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.tolerance_m = symmetry_tolerance_m(mesh)
        self.triangles = np.asarray(mesh.triangles, np.float64)
        points = np.vstack([np.asarray(mesh.vertices), self.triangles.mean(axis=1), self._over_the_area()])
        # in an order of no meaning, so that the first few lie anywhere; the same one each time
        self.points = np.random.default_rng(0).permutation(points)[:_MOST_POINTS]
        self.nearest = cKDTree(points)

    def repeats(self, n: int) -> bool:
        """Return True if turns by 360°/n, and by its multiples, leave the mesh as it is."""
        number, step = np.arange(len(self.points)), 2 * math.pi / n
        # many small differences add up: of the multiples each point takes one
        once = self.lies_on_itself(np.full(len(number), step))
        return once and (n == 2 or self.lies_on_itself(step * (1 + number % (n - 1))))

    def holds(self, points: _Float) -> bool:
        """Return True if all points lie on the surface; stop at the first that does not."""
        return self._near(points[:_FIRST_POINTS]) and self._near(points[_FIRST_POINTS:])

    def _over_the_area(self) -> _Float:
        """Return points spread evenly over the area, (n, 3)."""
        a, b, c = (self.triangles[:, k] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        area_samples = 4096
        number = np.arange(area_samples)
        face = np.searchsorted(np.cumsum(area), (number + 0.5) / area_samples * area.sum()).clip(max=len(area) - 1)
        plastic = 1.32471795724474602596  # of the R2 sequence (Roberts 2018), which fills a square evenly
        u, v = (number / plastic) % 1, (number / plastic**2) % 1
        u, v = np.where(u + v > 1, 1 - u, u)[:, None], np.where(u + v > 1, 1 - v, v)[:, None]
        return np.asarray(a[face] + u * (b - a)[face] + v * (c - a)[face])

    def lies_on_itself(self, angle_rad: NDArray[np.floating[Any]]) -> bool:
        """Return True if every point, turned by its angle, lies on the surface; stop at the first that does not."""
        start, size = 0, _FIRST_POINTS
        points_at_once = 8192
        while start < len(self.points):
            some = slice(start, start + size)
            cos, sin = np.cos(angle_rad[some]), np.sin(angle_rad[some])
            x, y, z = self.points[some].T
            turned = np.column_stack([cos * x - sin * y, sin * x + cos * y, z])
            if not self._near(turned):
                return False
            start, size = start + size, min(8 * size, points_at_once)
        return True

    def _near(self, points: _Float) -> bool:
        """Return True if all points lie within the tolerance of the surface."""
        # where another point of the surface is as near, no face has to be asked
        distance, _ = self.nearest.query(points, distance_upper_bound=self.tolerance_m)
        points = points[~np.isfinite(distance)]
        if not len(points):
            return True
        of_point, node = np.arange(len(points)), np.zeros(len(points), np.int64)
        for low, high in self._boxes:
            beyond = np.maximum(low[node] - points[of_point], points[of_point] - high[node])
            kept = (np.maximum(beyond, 0) ** 2).sum(axis=1) <= self.tolerance_m**2
            of_point, node = of_point[kept], node[kept]
            of_point, node = np.repeat(of_point, 2), (2 * node[:, None] + (0, 1)).ravel()
        # below the last boxes there are no nodes, but faces; a leaf of each point at a time, for one will mostly do
        of_point, leaf = of_point[::2], node[::2] // 2
        missing = np.ones(len(points), np.bool_)
        while len(of_point):
            asked, first = np.unique(of_point, return_index=True)
            face = self._order[_FACES_OF_LEAF * leaf[first][:, None] + np.arange(_FACES_OF_LEAF)]
            distance = _squared_distance(np.repeat(points[asked], _FACES_OF_LEAF, axis=0), self.triangles[face.ravel()])
            missing[asked] = ~(distance.reshape(face.shape) <= self.tolerance_m**2).any(axis=1)
            left = missing[of_point]
            left[first] = False
            of_point, leaf = of_point[left], leaf[left]
        return not missing.any()

    @cached_property
    def _order(self) -> NDArray[np.int64]:
        """Faces along a Z-order curve through their centroids, the last repeated to fill the leaves of a full tree."""
        centroid = self.triangles.mean(axis=1)
        low = centroid.min(axis=0)
        cell = ((centroid - low) / max(float(np.ptp(centroid, axis=0).max()), 1e-300) * 1023).astype(np.int64)
        code = sum(((cell[:, k] >> bit) & 1) << (3 * bit + k) for k in range(3) for bit in range(10))
        order = np.argsort(code, kind="stable")
        leaves = 1 << max(math.ceil(math.log2(len(order) / _FACES_OF_LEAF)), 0)
        return np.concatenate([order, np.full(leaves * _FACES_OF_LEAF - len(order), order[-1])])

    @cached_property
    def _boxes(self) -> list[tuple[_Float, _Float]]:
        """Corners of the boxes of each level of the tree, root first; (nodes, 3) each."""
        corners = self.triangles[self._order].reshape(-1, 3 * _FACES_OF_LEAF, 3)
        levels = [(corners.min(axis=1), corners.max(axis=1))]
        while len(levels[-1][0]) > 1:
            low, high = levels[-1]
            levels.append((np.minimum(low[::2], low[1::2]), np.maximum(high[::2], high[1::2])))
        return levels[::-1]


def _squared_distance(points: _Float, triangles: _Float) -> _Float:
    """Return the squared distance of each point from its triangle, (n, 3) and (n, 3, 3); NaN without any area."""
    with np.errstate(invalid="ignore", divide="ignore"):
        nearest: Any = trimesh.triangles.closest_point(triangles, points)  # type: ignore[no-untyped-call]
    return np.asarray(((nearest - points) ** 2).sum(axis=1))


def _primes(most: int) -> list[int]:
    """Return the primes up to a number."""
    return [n for n in range(2, most + 1) if all(n % p for p in range(2, math.isqrt(n) + 1))]
