"""A mesh as the renderer needs it: planes, smooth patches, and the edges where the integrand may not be smooth.

What is analysed here does not depend on the view, so it is done once per mesh: creases are edges whose faces meet at
more than 30°, or that have one face only; folds are the other edges, which matter where they are silhouettes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.integral.components import component_labels
from phasemark.render.integral.face_search import FaceGrid
from phasemark.render.integral.surface_mesh import SurfaceMesh

CREASE_RAD = math.radians(30.0)
NO_GLOSS = np.zeros((0, 3))
CLUSTER = 32
"""Faces that are looked at together for silhouettes."""
_HOLLOW = 1e-9
"""Share of the mesh's extent by which a face rises before its neighbour's plane in a hollow; rounding is less."""


class MeshTopology(NamedTuple):
    """Mesh in the form that the renderer needs, float64 and contiguous.

    Parameters
    ----------
    vertices : (v, 3) float64
        Distinct points, metres, landmark frame.
    faces : (f, 3) int32
        Those near one another in space stand near one another.
    planes : (f, 4) float64
        Unit normal and offset of each face: n · p = offset on it.
    corner_normals : (f, 16) float32
        Shading normal at each corner of each face (9), zero at an apex, where there is none; the rest is empty.
    flat : (f,) bool
        Whether the three corner normals are the face's own.
    plain : (f,) bool
        Whether all faces of the face's smooth patch are one surface: a plane, where they are flat, or a quadric.
    patch : (f,) int32
        Number of the smooth patch, faces joined without a crease between them.
    searched : (f,) bool
        Whether faces of the face's smooth patch are searched for from one another: a curved patch without a hollow, or
        one with an apex, from which slivers fan out.
    search : (f, 16) float32
        What the search of a face asks: plane (4); the barycentric coordinates of a point on the face that belong to its
        second and third corner, the products of four numbers each with (x, y, z, 1) (8); the face of the same patch
        beyond the edge from each corner to the next (3; −1: there is none); and the patch.
    grid : FaceGrid
        Where the faces of the searched patches are.
    part : (f,) int32
        Part of the surface that a face belongs to: 0 for a landmark's lower part, 1 for the upper one; in a scene the
        number of the body.
    albedo : (f,) float64
        Of each face, relative to that of the surface.
    gloss : (f, 3) float64
        What faces return beside Lambertian light, see :mod:`~phasemark.render.integral.gloss`; without rows: nothing.
    quadric : (f,) int32
        Which quadric is the true surface of the face, −1 for none.
    quadrics : (q, 10) float64
        A (xx, yy, zz, xy, xz, yz), b (3) and c of surfaces pᵀ A p + 2 b · p + c = 0, negative inside.
    closed : (f,) bool
        Whether the face belongs to a shell that is watertight and wound outward, so that its back is never seen.
    concave : (e,) bool
        Whether a crease is the bottom of a valley; then it is seen only from before both of its faces.
    creases : (e, 4) int32
        Edges (start, end, face, other face); −1 where there is no other face. An edge runs along the winding of its
        first face.
    folds : (e, 3) int32
        Edges of smooth regions, which matter where they are silhouettes: start, end, and the other face's place among
        the smooth faces. Those of a first face follow one another, in the order of the smooth faces.
    first_fold : (g + 1,) int32
        Where the folds begin whose first face is a smooth face.
    smooth_planes : (6, g) float64
        Columns: planes of the smooth faces, those with folds, their reach: how far the normal turns, |n − n'|, over
        the face's folds at most, and the number of the round solid that the face was made of, −1 where there is none.
        Each :data:`CLUSTER` are a cluster.
    clusters : (c, 13) float64
        Per cluster a point, a mean normal, its offset from the point's plane, how far the faces' normals and offsets
        differ from those at most, the largest reach, how far the faces' corners are from the point at most, and where
        among the smooth faces it begins and how many it has.
    curves : (c, 14) float64
        Edges of round faces, see :mod:`~phasemark.render.integral.round_edges`.
    parts : (k, 2) int64
        First face of each convex part of solids, and the one behind the last; see
        :mod:`~phasemark.render.integral.convex_parts`.
    balls : (k, 4) float64
        Centre and radius of a ball around each.
    low, high : (3,) float64
        Corners of the box around all vertices.
    split : bool
        Whether the face that is seen changes at creases and silhouettes only: surfaces pass through one another
        nowhere but along creases.
    around : bool
        Whether the surface may stand around the camera, so that it is seen beyond all of its edges.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    planes: NDArray[np.float64]
    corner_normals: NDArray[np.float32]
    flat: NDArray[np.bool_]
    plain: NDArray[np.bool_]
    patch: NDArray[np.int32]
    searched: NDArray[np.bool_]
    search: NDArray[np.float32]
    grid: FaceGrid
    part: NDArray[np.int32]
    albedo: NDArray[np.float64]
    gloss: NDArray[np.float64]
    quadric: NDArray[np.int32]
    quadrics: NDArray[np.float64]
    closed: NDArray[np.bool_]
    creases: NDArray[np.int32]
    concave: NDArray[np.bool_]
    folds: NDArray[np.int32]
    first_fold: NDArray[np.int32]
    smooth_planes: NDArray[np.float64]
    clusters: NDArray[np.float64]
    curves: NDArray[np.float64]
    parts: NDArray[np.int64]
    balls: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    split: bool
    around: bool

    @classmethod
    def from_mesh(cls, mesh: SurfaceMesh, crease_rad: float = CREASE_RAD) -> MeshTopology:
        """Analyse a mesh; faces without area are dropped, vertices at one point merged.

        Parameters
        ----------
        mesh : SurfaceMesh
        crease_rad : float
            Faces that meet at more than this are not joined smoothly.

        Raises
        ------
        UsageError
            The mesh has no face with an area, or a vertex that is not finite.
        """
        raw = np.asarray(mesh.vertices, dtype=np.float64)
        if not np.isfinite(raw).all():
            raise UsageError("the mesh has a vertex that is not finite")
        vertices, merged = _distinct(raw)
        faces = merged[np.asarray(mesh.faces, dtype=np.int64)]
        part = np.asarray(mesh.face_attributes.get("part", _part_by_height(raw, mesh.faces)), dtype=np.int32)
        albedo = np.asarray(mesh.face_attributes.get("albedo", np.ones(len(faces))), dtype=np.float64)
        quadric = np.asarray(mesh.face_attributes.get("quadric", np.full(len(faces), -1)), dtype=np.int32)
        united = np.asarray(mesh.face_attributes.get("shell", np.zeros(len(faces))), dtype=np.int64)
        a, b, c = (vertices[faces[:, k]] for k in range(3)) if len(faces) else (np.zeros((0, 3)),) * 3
        normals = np.cross(b - a, c - a)
        length = np.linalg.norm(normals, axis=1)
        extent = float(np.ptp(vertices, axis=0).max()) if len(vertices) else 0.0
        kept = length > 1e-14 * extent**2
        if not kept.any():
            raise UsageError("the mesh has no face with an area")
        kept = np.flatnonzero(kept)
        kept = kept[along_curve(vertices[faces[kept]].mean(axis=1))]
        faces, part, albedo, quadric, a = faces[kept], part[kept], albedo[kept], quadric[kept], a[kept]
        united = united[kept]
        normals = normals[kept] / length[kept, None]
        planes = np.column_stack([normals, np.einsum("ij,ij->i", normals, a)])
        edges, regular = _edges(faces)
        first, other = edges[:, 2], edges[:, 3]
        turn = np.where(other >= 0, _angle_between(normals[first], normals[other]), np.inf)
        crease = ~regular | (turn > crease_rad + 1e-9)
        crease |= (albedo[first] != albedo[other]) | (quadric[first] != quadric[other])
        crease |= united[first] != united[other]  # where shells run through one another nothing is smooth
        coplanar_rad = 1e-7
        fold = ~crease & (turn > coplanar_rad)
        patch = component_labels(len(faces), edges[~crease][:, 2:])
        corners = _corner_normals(vertices, faces, normals, patch, united, crease_rad)
        flat = (np.einsum("fij,fj->fi", corners, normals) > 1 - 1e-12).all(axis=1)
        # the corner of the other face off the edge lies before the first face's plane
        off_edge = vertices[faces[other]].sum(axis=1) - vertices[edges[:, 0]] - vertices[edges[:, 1]]
        rise = np.einsum("ij,ij->i", planes[first, :3], off_edge) - planes[first, 3]
        plain = (np.bincount(patch, ~flat)[patch] == 0) | (quadric >= 0)  # one surface for the whole patch
        shares = _corner_shares(vertices[faces])
        apex = (corners == 0).all(axis=2).any(axis=1)
        hollow = np.bincount(patch[first], ~crease & (rise > _HOLLOW * extent), minlength=patch.max() + 1)[patch] > 0
        searched = ~plain & ((np.bincount(patch, apex)[patch] > 0) | ~hollow)
        fold_reach = _fold_reach(edges[fold], normals)
        smooth_faces, clusters = _cluster_faces(vertices[faces], planes, fold_reach)
        folds, first_fold = _folds_in_order(edges[fold], smooth_faces)
        shell = component_labels(len(faces), edges[other >= 0][:, 2:])
        six_volumes = np.bincount(
            shell, np.einsum("ij,ij->i", a, np.cross(vertices[faces[:, 1]], vertices[faces[:, 2]]))
        )
        _, solid = np.unique(united * (shell.max() + 1) + shell, return_inverse=True)
        round_solid = np.where(quadric >= 0, solid, -1)
        closed = bool(regular.all() and (six_volumes > 0).all())
        return cls(
            vertices=np.ascontiguousarray(vertices),
            faces=np.ascontiguousarray(faces, dtype=np.int32),
            planes=np.ascontiguousarray(planes),
            corner_normals=in_lines(corners.reshape(-1, 9)),
            flat=np.ascontiguousarray(flat),
            plain=plain,
            patch=patch,
            searched=searched,
            search=in_lines(
                np.column_stack([planes, shares.reshape(-1, 8), _neighbours(faces, edges[~crease]), patch])
            ),
            grid=FaceGrid.of_faces(vertices[faces], searched),
            part=np.ascontiguousarray(part),
            albedo=np.ascontiguousarray(albedo),
            gloss=NO_GLOSS,
            quadric=np.ascontiguousarray(quadric),
            quadrics=np.asarray(mesh.metadata.get("quadrics", np.zeros((0, 10))), np.float64),
            closed=np.full(len(faces), closed),
            creases=np.ascontiguousarray(edges[crease], dtype=np.int32),
            concave=np.ascontiguousarray(rise[crease] > 0),
            folds=folds,
            first_fold=first_fold,
            smooth_planes=np.ascontiguousarray(np.column_stack([planes, fold_reach, round_solid])[smooth_faces].T),
            clusters=clusters,
            curves=np.zeros((0, 14)),
            parts=np.zeros((0, 2), np.int64),
            balls=np.zeros((0, 4)),
            low=vertices.min(axis=0),
            high=vertices.max(axis=0),
            split=closed,
            around=False,
        )

    @classmethod
    def empty(cls) -> MeshTopology:
        """Return a mesh of nothing."""
        return cls(
            vertices=np.zeros((0, 3)),
            faces=np.zeros((0, 3), np.int32),
            planes=np.zeros((0, 4)),
            corner_normals=np.zeros((0, 16), np.float32),
            flat=np.zeros(0, np.bool_),
            plain=np.zeros(0, np.bool_),
            patch=np.zeros(0, np.int32),
            searched=np.zeros(0, np.bool_),
            search=np.zeros((0, 16), np.float32),
            grid=FaceGrid.of_faces(np.zeros((0, 3, 3)), np.zeros(0, np.bool_)),
            part=np.zeros(0, np.int32),
            albedo=np.zeros(0),
            gloss=NO_GLOSS,
            quadric=np.zeros(0, np.int32),
            quadrics=np.zeros((0, 10)),
            closed=np.zeros(0, np.bool_),
            creases=np.zeros((0, 4), np.int32),
            concave=np.zeros(0, np.bool_),
            folds=np.zeros((0, 3), np.int32),
            first_fold=np.zeros(1, np.int32),
            smooth_planes=np.zeros((6, 0)),
            clusters=np.zeros((0, 13)),
            curves=np.zeros((0, 14)),
            parts=np.zeros((0, 2), np.int64),
            balls=np.zeros((0, 4)),
            low=np.zeros(3),
            high=np.zeros(3),
            split=True,
            around=False,
        )


def along_curve(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Order points along a Z-curve through space: what is near in space is near in memory."""
    cell = np.ptp(points, axis=0).max() / 1023 or 1.0
    grid = ((points - points.min(axis=0)) / cell).astype(np.int64)
    key = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            key |= ((grid[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def in_lines(rows: NDArray[Any]) -> NDArray[np.float32]:
    """Return rows of up to 16 numbers as float32, each in one line of the cache."""
    room = np.empty(64 * len(rows) + 64, np.uint8)
    begin = -room.ctypes.data % 64
    lines = room[begin : begin + 64 * len(rows)].view(np.float32).reshape(-1, 16)
    lines[:, : rows.shape[1]], lines[:, rows.shape[1] :] = rows, 0.0
    return lines


def _distinct(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return points without repetition, in order, and the number of each among them; NumPy's `unique` is slow in 3D."""
    order = np.lexsort(points.T[::-1])
    is_new = np.ones(len(points), np.bool_)
    is_new[1:] = (np.diff(points[order], axis=0) != 0).any(axis=1)
    number = np.empty(len(points), np.int64)
    number[order] = np.cumsum(is_new) - 1
    return points[order[is_new]] + 0.0, number


def _part_by_height(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.int32]:
    """Label the parts of an unlabelled mesh by the side of the interface plane on which each face's centre lies."""
    return np.asarray(vertices[faces].mean(axis=1)[:, 2] > 0, dtype=np.int32)


def _angle_between(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles between unit vectors, accurate near 0 where arccos is not."""
    return np.asarray(2 * np.arctan2(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1)))


def _edges(faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Pair the half edges of a mesh.

    Returns
    -------
    edges : (e, 4) int64
        Start, end, face, other face (−1: none). An edge of more than two faces is listed with the first two.
    regular : (e,) bool
        Whether exactly two faces meet, wound alike.
    """
    half = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    owner = np.tile(np.arange(len(faces)), 3)
    undirected = np.sort(half, axis=1)
    order = np.lexsort((owner, undirected[:, 1], undirected[:, 0]))
    half, owner, undirected = half[order], owner[order], undirected[order]
    starts = np.flatnonzero(np.concatenate([[True], (undirected[1:] != undirected[:-1]).any(axis=1)]))
    count = np.diff(np.append(starts, len(half)))
    second = np.minimum(starts + 1, len(half) - 1)
    other = np.where(count > 1, owner[second], -1)
    opposed = half[starts, 0] == half[second, 1]
    edges = np.column_stack([half[starts], owner[starts], other])
    return edges, (count == 2) & opposed


def _neighbours(faces: NDArray[np.int64], edges: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the face beyond each edge of each face, (f, 3), where one of the given edges is; −1 elsewhere."""
    table = np.full(faces.shape, -1, np.int32)
    start, end, first, other = edges.T
    for corner, face, beyond in ((start, first, other), (end, other, first)):  # the other face has the edge reversed
        table[face, (faces[face] == corner[:, None]).argmax(axis=1)] = beyond
    return table


def _fold_reach(folds: NDArray[np.int64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far the normal turns over each face's folds at most, −1: the face has none."""
    reach = np.full(len(normals), -1.0)
    turn = np.linalg.norm(normals[folds[:, 2]] - normals[folds[:, 3]], axis=1)
    for side in (2, 3):
        np.maximum.at(reach, folds[:, side], turn)
    return reach


def _folds_in_order(
    folds: NDArray[np.int64], smooth_faces: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return ``folds`` and ``first_fold`` of :class:`MeshTopology`."""
    place = np.zeros(int(smooth_faces.max(initial=-1)) + 1, np.int64)
    place[smooth_faces] = np.arange(len(smooth_faces))
    first = place[folds[:, 2]]
    order = np.argsort(first, kind="stable")
    table = np.column_stack([folds[:, :2], place[folds[:, 3]]])[order]
    begins = np.searchsorted(first[order], np.arange(len(smooth_faces) + 1))
    return np.ascontiguousarray(table, np.int32), begins.astype(np.int32)


def _cluster_faces(
    corners: NDArray[np.float64], planes: NDArray[np.float64], fold_reach: NDArray[np.float64]
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Return the faces with folds, and bounds of each cluster's planes; see :class:`MeshTopology`."""
    smooth = np.flatnonzero(fold_reach >= 0)
    if not len(smooth):
        return np.zeros(0, np.int32), np.zeros((0, 13))
    starts = np.arange(0, len(smooth), CLUSTER)
    size = np.diff(np.append(starts, len(smooth)))
    point = np.add.reduceat(corners[smooth].mean(axis=1), starts) / size[:, None]
    normal = np.add.reduceat(planes[smooth, :3], starts) / size[:, None]
    # offset of each face from the cluster's point
    own = np.repeat(np.arange(len(starts)), size)
    offset = planes[smooth, 3] - np.einsum("ij,ij->i", planes[smooth, :3], point[own])
    mean_offset = np.add.reduceat(offset, starts) / size
    turn = np.linalg.norm(planes[smooth, :3] - normal[own], axis=1)
    radius = np.linalg.norm(corners[smooth] - point[own, None], axis=2).max(axis=1)
    bounds = [
        np.maximum.reduceat(values, starts)
        for values in (turn, np.abs(offset - mean_offset[own]), fold_reach[smooth], radius)
    ]
    return smooth.astype(np.int32), np.ascontiguousarray(
        np.column_stack([point, normal, mean_offset, *bounds, starts, size])
    )


def _corner_shares(corners: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the barycentric rows of ``search``, (f, 2, 4), of faces, given their corners (f, 3, 3)."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    d11, d12, d22 = (np.einsum("ij,ij->i", x, y) for x, y in ((first, first), (first, second), (second, second)))
    determinant = (d11 * d22 - d12 * d12)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):  # no ray meets a face without area
        gradient = np.stack(
            [
                (d22[:, None] * first - d12[:, None] * second) / determinant,
                (d11[:, None] * second - d12[:, None] * first) / determinant,
            ],
            axis=1,
        )
    constant = -np.einsum("fkx,fx->fk", gradient, corners[:, 0])
    return np.ascontiguousarray(np.concatenate([gradient, constant[..., None]], axis=2), dtype=np.float32)


def _corner_normals(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    normals: NDArray[np.float64],
    patch: NDArray[np.int32],
    shell: NDArray[np.int64],
    crease_rad: float,
) -> NDArray[np.float64]:
    """Average, at each corner, the normals of the vertex's faces that lie within `crease_rad` of the corner's own face.

    Weighted by sin α / (|a| |b|), a and b being the edges of the face at the vertex and α the angle between them
    (N. Max, Weights for computing vertex normals from facet normals, 1999): exact where the vertex and its neighbours
    lie on a sphere, and independent of how a quadrilateral is split whose corners lie on a circle. A vertex whose faces
    fan out further without a crease between them is an apex, as a cone has one: no normal serves there, and the corner
    gets none (zero), so that the other two are blended along its generatrices.
    """
    corner_of = np.argsort(faces.ravel(), kind="stable")
    start = np.searchsorted(faces.ravel()[corner_of], np.arange(len(vertices) + 1))
    limit = math.cos(crease_rad + 1e-9)
    return np.asarray(_average_corners(vertices, faces, normals, patch, shell, corner_of, start, limit))


@njit(cache=True)
def _average_corners(  # type: ignore[no-untyped-def]
    vertices, faces, normals, patch, shell, corner_of, start, cos_limit
):
    # numbers one by one: arrays of three would be allocated, and multiplied by a library, a million times a mesh
    n_faces = len(faces)
    weight = np.empty((n_faces, 3))
    for f in range(n_faces):
        for k in range(3):
            p, q, r = vertices[faces[f, k]], vertices[faces[f, (k + 1) % 3]], vertices[faces[f, (k + 2) % 3]]
            ax, ay, az = q[0] - p[0], q[1] - p[1], q[2] - p[2]
            bx, by, bz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
            cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            squares = (ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz)
            weight[f, k] = math.sqrt(cx * cx + cy * cy + cz * cz) / squares
    out = np.zeros((n_faces, 3, 3))
    for f in range(n_faces):
        nx, ny, nz = normals[f, 0], normals[f, 1], normals[f, 2]
        for k in range(3):
            vertex = faces[f, k]
            tx, ty, tz = 0.0, 0.0, 0.0
            apex = False
            for j in range(start[vertex], start[vertex + 1]):
                g, corner = corner_of[j] // 3, corner_of[j] % 3
                if shell[g] != shell[f]:
                    continue
                gx, gy, gz = normals[g, 0], normals[g, 1], normals[g, 2]
                if nx * gx + ny * gy + nz * gz >= cos_limit:
                    share = weight[g, corner]
                    tx, ty, tz = tx + share * gx, ty + share * gy, tz + share * gz
                else:
                    apex = apex or patch[g] == patch[f]
            if not apex:
                length = math.sqrt(tx * tx + ty * ty + tz * tz)
                out[f, k, 0], out[f, k, 1], out[f, k, 2] = tx / length, ty / length, tz / length
        smooth = False
        for k in range(3):
            smooth = smooth or out[f, k, 0] != 0.0 or out[f, k, 1] != 0.0 or out[f, k, 2] != 0.0
        if not smooth:
            for k in range(3):
                out[f, k, 0], out[f, k, 1], out[f, k, 2] = nx, ny, nz
    return out
