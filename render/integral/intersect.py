"""The first face a ray meets: Embree where it is installed, and a float64 intersector of our own.

Both answer the same question, *which face*, and nothing else; where the ray meets the face's plane is computed in
float64 by the caller.
"""

from __future__ import annotations

import importlib.util
import weakref
from typing import Any, ClassVar, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.kernel import inner, kernel

_DEEPEST = 128  # nodes that wait to be looked at
MOST_SCENES = 800
"""Embree ends the process when about a thousand scenes are open."""


class Intersector(Protocol):
    """Finds the first face a ray meets."""

    def first_face(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.int32]:
        """Return the index of the first face met by each ray, −1 where none is; origins, directions (n, 3)."""
        ...


class EmbreeIntersector:
    """Embree, called without a wrapper between. It releases the GIL, so threads scale.

    Raises
    ------
    UsageError
        As many scenes are open as Embree can hold.
    """

    _open: ClassVar[weakref.WeakSet[EmbreeIntersector]] = weakref.WeakSet()

    def __init__(self, vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> None:
        if len(self._open) >= MOST_SCENES:
            raise UsageError(
                f"at most {MOST_SCENES} landmarks can be rendered at the same time: let go of renderers, or use"
                " intersector='float64'"
            )
        self._open.add(self)
        self._mesh = vertices, faces
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene(robust=True)
        TriangleMesh(
            self._scene,
            np.ascontiguousarray(vertices, dtype=np.float32),
            np.ascontiguousarray(faces, dtype=np.int32),
        )
        # the first query builds the hierarchy, which is not safe from several threads at once
        self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle a scene as its mesh."""
        return EmbreeIntersector, self._mesh

    def first_face(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.int32]:
        """Return the index of the first face met by each ray, −1 where none is."""
        faces: NDArray[np.int32] = self._scene.run(origins, directions)
        return faces


class NoIntersector:
    """For a scene without a mesh."""

    def first_face(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.int32]:
        """Return −1 for every ray."""
        return np.full(len(origins), -1, np.int32)


class BvhIntersector:
    """A bounding-volume hierarchy walked in float64; for machines without Embree, and as its oracle.

    Edge tests are computed from the edge's ends in one fixed order, so that the two faces that share an edge agree to
    the last bit about the side a ray passes on: nothing slips through a closed mesh.
    """

    def __init__(self, vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> None:
        corners = vertices[faces]
        low, high = corners.min(axis=1), corners.max(axis=1)
        self._vertices = np.ascontiguousarray(vertices)
        self._bounds, self._children, self._order = _build_tree(low, high)
        self._faces = np.ascontiguousarray(faces)

    def first_face(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.int32]:
        """Return the index of the first face met by each ray, −1 where none is."""
        out = np.empty(len(origins), np.int32)
        _walk(
            self._vertices,
            self._faces,
            self._bounds,
            self._children,
            self._order,
            np.asarray(origins, np.float64),
            np.asarray(directions, np.float64),
            np.empty(_DEEPEST, np.int64),
            np.empty(_DEEPEST),
            np.empty(3),
            out,
        )
        return out


def make_intersector(vertices: NDArray[np.float64], faces: NDArray[np.int32], kind: str = "auto") -> Intersector:
    """Return an intersector for a mesh.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int32
    kind : {"auto", "embree", "float64"}
        "auto" takes Embree where the package embreex is installed.

    Raises
    ------
    UsageError
        The kind is unknown, or Embree is asked for and missing.
    """
    if kind not in ("auto", "embree", "float64"):
        raise UsageError(f"'intersector' must be auto, embree or float64, got {kind!r}")
    if not len(faces):
        return NoIntersector()
    has_embree = importlib.util.find_spec("embreex") is not None
    if kind == "embree" and not has_embree:
        raise UsageError("the package embreex is not installed here: use intersector='float64'")
    if kind == "float64" or not has_embree:
        return BvhIntersector(vertices, faces)
    return EmbreeIntersector(vertices, faces)


@njit(cache=True)
def _build_tree(low, high):  # type: ignore[no-untyped-def]
    """Split the faces at the median of their centres along the longest side until few are left.

    Returns
    -------
    bounds : (nodes, 6) float64
        Lower and upper corner.
    children : (nodes, 2) int64
        Children of an inner node; (−1 − first, count) of a leaf's faces in `order`.
    order : (f,) int64
    """
    n = len(low)
    centre = 0.5 * (low + high)
    order = np.arange(n)
    bounds = np.empty((2 * n + 1, 6))
    children = np.empty((2 * n + 1, 2), np.int64)
    stack = np.empty((_DEEPEST, 3), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, 0, n
    used, depth = 1, 1
    leaf = 4
    while depth > 0:
        depth -= 1
        node, start, stop = stack[depth]
        for k in range(3):
            bounds[node, k], bounds[node, 3 + k] = np.inf, -np.inf
        centre_low, centre_high = np.full(3, np.inf), np.full(3, -np.inf)
        for i in range(start, stop):
            f = order[i]
            for k in range(3):
                bounds[node, k] = min(bounds[node, k], low[f, k])
                bounds[node, 3 + k] = max(bounds[node, 3 + k], high[f, k])
                centre_low[k] = min(centre_low[k], centre[f, k])
                centre_high[k] = max(centre_high[k], centre[f, k])
        if stop - start <= leaf:
            children[node, 0], children[node, 1] = -1 - start, stop - start
            continue
        axis = np.argmax(centre_high - centre_low)
        part = order[start:stop].copy()
        for k, i in enumerate(np.argsort(centre[part, axis])):
            order[start + k] = part[i]
        middle = (start + stop) // 2
        children[node, 0], children[node, 1] = used, used + 1
        stack[depth, 0], stack[depth, 1], stack[depth, 2] = used, start, middle
        stack[depth + 1, 0], stack[depth + 1, 1], stack[depth + 1, 2] = used + 1, middle, stop
        depth += 2
        used += 2
    return bounds[:used].copy(), children[:used].copy(), order


@inner
def _enters(bounds, node, origin, inverse, nearest):  # type: ignore[no-untyped-def]
    """Return the distance at which a ray enters a node, inf if it does not before `nearest`."""
    lo, hi = 0.0, nearest
    for k in range(3):
        a = (bounds[node, k] - origin[k]) * inverse[k]
        b = (bounds[node, 3 + k] - origin[k]) * inverse[k]
        # written so that NaN (0 · inf: a ray in the plane of a face of the box) leaves lo and hi as they are
        if a > b:
            a, b = b, a
        lo = a if a > lo else lo
        hi = b if b < hi else hi
    return lo if lo <= hi * (1 + 1e-12) else np.inf


@inner
def _edge_side(vertices, i, j, origin, d):  # type: ignore[no-untyped-def]
    """Return on which side of the edge i → j a ray passes; exactly opposite for j → i."""
    a, b, sign = (i, j, 1.0) if i < j else (j, i, -1.0)
    ax, ay, az = vertices[a, 0] - origin[0], vertices[a, 1] - origin[1], vertices[a, 2] - origin[2]
    bx, by, bz = vertices[b, 0] - origin[0], vertices[b, 1] - origin[1], vertices[b, 2] - origin[2]
    return sign * (d[0] * (ay * bz - az * by) + d[1] * (az * bx - ax * bz) + d[2] * (ax * by - ay * bx))


@kernel
def _walk(  # type: ignore[no-untyped-def]
    vertices, faces, bounds, children, order, origins, directions, stack, entry, inverse, out
):
    for ray in range(len(origins)):
        origin, d = origins[ray], directions[ray]
        for k in range(3):
            inverse[k] = 1.0 / d[k] if d[k] != 0 else np.inf
        nearest, found = np.inf, -1
        stack[0], entry[0] = 0, _enters(bounds, np.int64(0), origin, inverse, np.inf)
        depth = 1
        while depth > 0:
            depth -= 1
            node = stack[depth]
            if not entry[depth] < nearest:
                continue
            first, second = children[node]
            if first >= 0:
                ta = _enters(bounds, first, origin, inverse, nearest)
                tb = _enters(bounds, second, origin, inverse, nearest)
                if ta > tb:
                    first, second, ta, tb = second, first, tb, ta
                stack[depth], entry[depth] = second, tb
                stack[depth + 1], entry[depth + 1] = first, ta
                depth += 2
                continue
            for i in range(-1 - first, -1 - first + second):
                f = order[i]
                a, b, c = faces[f]
                u = _edge_side(vertices, b, c, origin, d)
                v = _edge_side(vertices, c, a, origin, d)
                w = _edge_side(vertices, a, b, origin, d)
                if (u < 0 or v < 0 or w < 0) and (u > 0 or v > 0 or w > 0):
                    continue
                total = u + v + w
                if total == 0:
                    continue
                u, v, w = u / total, v / total, w / total
                t = 0.0
                for k in range(3):
                    t += d[k] * (u * vertices[a, k] + v * vertices[b, k] + w * vertices[c, k] - origin[k])
                if 0 < t / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) < nearest:
                    nearest = t / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
                    found = f
        out[ray] = found
