"""Primitives as solids: unions of convex parts, cut out of space by planes and quadrics, with their edges.

A ray asks each part's planes and quadrics; no triangles stand for a round surface. The outline of a round surface is
found for each view, and drawn as finely as the image asks for.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.render.integral.mesh_topology import MeshTopology
from phasemark.render.integral.round_edges import BALL, CAP, RIM, SEAM, TUBE


class Solid(NamedTuple):
    """A primitive in its own frame.

    Parameters
    ----------
    planes : (f, 4) float64
        Unit normal, outward, and offset of each face; zeros where it is a quadric.
    quadric : (f,) int32
        Which quadric the face is, −1 for a plane.
    quadrics : (q, 10) float64
        As :class:`~phasemark.render.integral.mesh_topology.MeshTopology` has them.
    first : (k + 1,) int64
        Where the faces of each convex part begin; it lies behind all of its planes and inside its quadric.
    balls : (k, 4) float64
        Centre and radius of a ball around each part.
    vertices : (v, 3) float64
    creases : (e, 4) int32
        Straight edges, as :class:`~phasemark.render.integral.mesh_topology.MeshTopology` has them.
    curves : (c, 14) float64
        Round edges, see :mod:`~phasemark.render.integral.round_edges`.
    """

    planes: NDArray[np.float64]
    quadric: NDArray[np.int32]
    quadrics: NDArray[np.float64]
    first: NDArray[np.int64]
    balls: NDArray[np.float64]
    vertices: NDArray[np.float64]
    creases: NDArray[np.int32]
    curves: NDArray[np.float64]

    @classmethod
    def box(cls, size_m: NDArray[np.float64]) -> Solid:
        """Return a box around the origin."""
        half = 0.5 * size_m
        normals = np.concatenate([np.eye(3), -np.eye(3)])
        vertices = half * (2.0 * np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1) - 1.0)
        creases = []
        for start in range(8):
            for axis in range(3):
                end = start | (4 >> axis)
                if end != start:
                    others = [a if vertices[start, a] > 0 else a + 3 for a in range(3) if a != axis]
                    creases.append([start, end, *others])
        return cls(
            planes=np.column_stack([normals, np.tile(half, 2)]),
            quadric=np.full(6, -1, np.int32),
            quadrics=np.zeros((0, 10)),
            first=np.array([0, 6]),
            balls=np.array([[0.0, 0.0, 0.0, float(np.linalg.norm(half))]]),
            vertices=vertices,
            creases=np.array(creases, np.int32),
            curves=np.zeros((0, 14)),
        )

    @classmethod
    def ellipsoid(cls, half_axes_m: NDArray[np.float64]) -> Solid:
        """Return an ellipsoid around the origin."""
        return cls._round(
            [0],
            [[*1 / half_axes_m**2, 0, 0, 0, 0, 0, 0, -1]],
            [(0, 1)],
            [[0, 0, 0, half_axes_m.max()]],
            [[BALL, 0, 0, 0, *np.diag(half_axes_m).ravel()]],
        )

    @classmethod
    def cylinder(cls, radius_m: float, height_m: float) -> Solid:
        """Return a cylinder along z around the origin."""
        r, h = radius_m, 0.5 * height_m
        return cls._round(
            [0, (0, 0, 1, h), (0, 0, -1, h)],
            [[1, 1, 0, 0, 0, 0, 0, 0, 0, -(r**2)]],
            [(0, 3)],
            [[0, 0, 0, math.hypot(r, h)]],
            [
                [TUBE, 0, 0, 0, r, 0, 0, 0, r, 0, 0, 0, h],
                [RIM, 0, 0, h, r, 0, 0, 0, r, 0, 0, 0, 1],
                [RIM, 0, 0, -h, r, 0, 0, 0, r, 0, 0, 0, -1],
            ],
        )

    @classmethod
    def capsule(cls, radius_m: float, height_m: float) -> Solid:
        """Return a cylinder along z around the origin with half a sphere at either end."""
        r, h = radius_m, 0.5 * height_m
        balls = [[1, 1, 1, 0, 0, 0, 0, 0, -z, z**2 - r**2] for z in (h, -h)]
        ends = [[0, 0, z, r, 0, 0, 0, r, 0, 0, 0, math.copysign(r, z)] for z in (h, -h)]
        return cls._round(
            [0, (0, 0, 1, h), (0, 0, -1, h), 1, 2],  # the planes lie inside the balls
            [[1, 1, 0, 0, 0, 0, 0, 0, 0, -(r**2)], *balls],
            [(0, 3), (3, 4), (4, 5)],
            [[0, 0, 0, math.hypot(r, h)], [0, 0, h, r], [0, 0, -h, r]],
            [
                [TUBE, 0, 0, 0, r, 0, 0, 0, r, 0, 0, 0, h],
                *([CAP, *end] for end in ends),
                *([SEAM, *end] for end in ends),
            ],
        )

    @classmethod
    def _round(cls, faces, quadrics, parts, balls, curves) -> Solid:  # type: ignore[no-untyped-def]
        """Return a solid from its faces (a plane, or the number of a quadric), and the faces of its parts."""
        planes = [face if isinstance(face, tuple) else (0, 0, 0, 0) for face in faces]
        return cls(
            planes=np.array(planes, np.float64),
            quadric=np.array([-1 if isinstance(face, tuple) else face for face in faces], np.int32),
            quadrics=np.array(quadrics, np.float64),
            first=np.array([0, *(stop for _, stop in parts)]),
            balls=np.array(balls, np.float64),
            vertices=np.zeros((0, 3)),
            creases=np.zeros((0, 4), np.int32),
            curves=np.array([[*curve, 0] for curve in curves], np.float64),
        )

    def topology(self) -> MeshTopology:
        """Return the surface as the area integral asks for it; its faces have no corners."""
        n = len(self.planes)
        return MeshTopology.empty()._replace(
            vertices=self.vertices,
            faces=np.zeros((n, 3), np.int32),
            planes=self.planes,
            corner_normals=np.zeros((n, 16), np.float32),
            flat=np.ones(n, np.bool_),
            plain=np.ones(n, np.bool_),
            patch=np.arange(n, dtype=np.int32),
            searched=np.zeros(n, np.bool_),
            search=np.zeros((n, 16), np.float32),
            part=np.zeros(n, np.int32),
            albedo=np.ones(n),
            quadric=self.quadric,
            quadrics=self.quadrics,
            closed=np.ones(n, np.bool_),
            creases=self.creases,
            concave=np.zeros(len(self.creases), np.bool_),
            curves=self.curves,
        )
