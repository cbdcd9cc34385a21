"""Patches: small pieces of the surfaces of a scene, over each of which the light that leaves it is taken as even."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from phasemark.render.bounces.feet import cut_where_bodies_stand
from phasemark.render.integral.intersect import Intersector, make_intersector
from phasemark.render.integral.mesh_topology import MeshTopology

POINTS = 4
"""Points of a patch at which light is received."""
_TURN = 0.35
"""Largest extent of the normals within a patch."""
_THIN, _SHORTER = 0.25, 0.4
"""Triangles lower than this share of their length are cut shorter, for their centroids to say where they are."""
_EVEN = 1 + 1e-6
"""Rounding of areas that are the same."""
_DEEP = 0.2
"""Largest extent of a patch across its first facet, in sizes of the patch: surfaces in two planes are not joined."""
_LIFT, _WIDEST_M = 1e-5, 20.0
"""Share of the scene's extent by which rays begin above their surface, as they are of single precision; and the extent
from which on that no longer grows: facets are small where light is, however far a floor reaches."""
_NEAREST = 0.1
"""Least distance from a lens that points resolve, in sizes of a patch."""
SizeAt = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""From points and normals of surfaces, (n, 3) each, to a length, (n,) m."""


@dataclass(frozen=True)
class Facets:
    """Triangles that the surfaces of a scene are cut into.

    Parameters
    ----------
    corners : (f, 3, 3) float64
        World frame, metres.
    normals : (f, 3) float64
    areas : (f,) float64
    face : (f,) int64
        Face of the topology that each is a part of.
    """

    corners: NDArray[np.float64]
    normals: NDArray[np.float64]
    areas: NDArray[np.float64]
    face: NDArray[np.int64]


@dataclass(frozen=True)
class Patches:
    """Patches of a scene; each is a side of some facets that lie beside one another.

    Parameters
    ----------
    facets : Facets
    members : (m,) int64
        Facets of all patches, patch by patch.
    first : (n + 1,) int64
        Where the facets of each patch begin among the members.
    side : (n,) float64
        1 for the front of its facets, −1 for their back.
    patch_of : (f, 2) int64
        Patch of the front and of the back of each facet; −1 for a side that nothing lies before.
    points : (n, 4, 3) float64
        Points at which light is received, world frame.
    normals : (n, 4, 3) float64
        Normals there, to the patch's side.
    weights : (n, 4) float64
        Shares of the patch's area that the points stand for.
    centre, normal : (n, 3) float64
        Centroid, and mean normal, which is shorter than 1 where the patch is curved.
    outlook : (n, 3) float64
        A point of the patch near the centroid, which does not lie on a curved one.
    area : (n,) float64
        m², without what stands inside of a closed body.
    size : (n,) float64
        Largest extent, m.
    albedo : (n,) float64
    body : (n,) int32
    intersector : Intersector
        Of the facets.
    lift_m : float
        How far above their surface rays begin and end.
    """

    facets: Facets
    members: NDArray[np.int64]
    first: NDArray[np.int64]
    side: NDArray[np.float64]
    patch_of: NDArray[np.int64]
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    weights: NDArray[np.float64]
    centre: NDArray[np.float64]
    normal: NDArray[np.float64]
    outlook: NDArray[np.float64]
    area: NDArray[np.float64]
    size: NDArray[np.float64]
    albedo: NDArray[np.float64]
    body: NDArray[np.int32]
    intersector: Intersector
    lift_m: float

    def __len__(self) -> int:
        return len(self.area)

    def seen(
        self, origins: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return which patch each ray meets first, (n,), −1 for none, and where, (n, 3)."""
        facet = self.intersector.first_face(origins.astype(np.float32), directions.astype(np.float32)).astype(np.int64)
        hit = np.flatnonzero(facet >= 0)
        facet = facet[hit]
        normal, corner = self.facets.normals[facet], self.facets.corners[facet, 0]
        facing = np.einsum("ij,ij->i", normal, directions[hit])
        along = np.einsum("ij,ij->i", normal, corner - origins[hit]) / np.where(facing == 0, 1.0, facing)
        patch, where = np.full(len(origins), -1), np.zeros(origins.shape)
        patch[hit] = self.patch_of[facet, (facing > 0).astype(np.int64)]
        where[hit] = origins[hit] + along[:, None] * directions[hit]
        return patch, where

    def sees(self, begin: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether nothing stands between points (n, 3) that lie a little above their surfaces."""
        way = end - begin
        facet = self.intersector.first_face(begin.astype(np.float32), way.astype(np.float32)).astype(np.int64)
        normal, corner = self.facets.normals[facet], self.facets.corners[facet, 0]
        facing = np.einsum("ij,ij->i", normal, way)
        along = np.einsum("ij,ij->i", normal, corner - begin) / np.where(facing == 0, 1.0, facing)
        return np.asarray((facet < 0) | (along >= 1.0))

    def points_before(
        self, lens: NDArray[np.float64], share: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Return points at which light from a place is received: four of a patch, more of one near the place.

        Parameters
        ----------
        lens : (3,) float64
        share : float
            Size of a patch, as a share of its distance from the lens, from which on it has more points, and of what
            they stand for.

        Returns
        -------
        points, normals : (m, 3) float64
            Points a little above the surface.
        weights : (m,) float64
            Shares of the patch's area.
        patch : (m,) int64
        """
        near = self.size > share * np.linalg.norm(self.centre - lens, axis=1)
        own = np.repeat(np.arange(len(self)), np.diff(self.first))
        cut = near[own]
        own, facet = own[cut], self.members[cut]
        pieces, part, _ = _cut(
            self.facets.corners[facet],
            np.arange(len(own)),
            lambda at, k: share * np.maximum(np.linalg.norm(at - lens, axis=1), _NEAREST * self.size[own[k]]),
        )
        edges = pieces[:, 1:] - pieces[:, :1]
        area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        normals = self.side[own, None] * self.facets.normals[facet]
        few = np.flatnonzero(~near)
        patch = np.concatenate([np.repeat(few, POINTS), own[part]])
        up = np.concatenate([self.normals[few].reshape(-1, 3), normals[part]])
        points = np.concatenate([self.points[few].reshape(-1, 3), pieces.mean(axis=1)])
        weights = np.concatenate([self.weights[few].ravel(), area / self.area[own[part]]])
        return points + self.lift_m * up, up, weights, patch


def make_patches(
    topology: MeshTopology,
    size_at: SizeAt,
    *,
    intersector: str = "auto",
    before_others: int | None = None,
) -> Patches:
    """Cut the surfaces of a scene into patches.

    Faces are cut along the outlines of bodies that stand on them, and then in two across their longest edge until none
    is too long: what lies beside a body is as small as `size_at` says of that place, and not of one below it. Facets
    that lie beside one another and face alike are joined, so that a curved mesh of many faces has few patches. A part
    of a surface inside a closed body, as the floor below a box, has none.

    Parameters
    ----------
    topology : MeshTopology
        The bodies, world frame.
    size_at : callable
        Largest extent of a patch.
    intersector : {"auto", "embree", "float64"}
        As for :class:`~phasemark.render.Renderer`.
    before_others : int, optional
        A body to whose outer sides surfaces that are not of the scene send light, as a wall somewhere behind it.
    """
    lift, normals = _lift_of(topology), topology.planes[:, :3]
    triangles, face = cut_where_bodies_stand(
        topology.vertices[topology.faces], np.arange(len(topology.faces)), topology, lift
    )
    triangles, face, sizes = _cut(triangles, face, lambda at, own: size_at(at, normals[own]))
    solid = _Solid(topology, intersector, _LIFT * _extent(topology))  # whose faces are large
    buried = solid.buries(triangles, face)
    edges = triangles[:, 1:] - triangles[:, :1]
    areas = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    facets = Facets(triangles, topology.planes[face, :3], areas, face)
    lit = _has_something_before(facets, topology, lift)
    if before_others is not None:
        own = topology.part[face] == before_others
        lit |= np.column_stack([own, own & ~topology.closed[face]])
    return _joined(facets, lit, ~buried, topology, sizes, intersector, lift)


def light_bounces(topology: MeshTopology) -> bool:
    """Return whether something of a scene lies before any side of its faces: otherwise light bounces nowhere."""
    corners = topology.vertices[topology.faces]
    faces = Facets(corners, topology.planes[:, :3], np.zeros(len(corners)), np.arange(len(corners)))
    return bool(_has_something_before(faces, topology, _lift_of(topology)).any())


def _lift_of(topology: MeshTopology) -> float:
    farthest = np.float32(max(-topology.low.min(), topology.high.max()))  # from the origin
    return max(_LIFT * min(_extent(topology), _WIDEST_M), 4 * float(np.spacing(farthest)))


def _extent(topology: MeshTopology) -> float:
    return float((topology.high - topology.low).max())


def _halved(triangles: NDArray[np.float64], face: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Cut each triangle in two across its longest edge."""
    edge = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2).argmax(axis=1)
    turn = (edge[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(triangles, turn[:, :, None], axis=1).transpose(1, 0, 2)
    middle = 0.5 * (a + b)
    halves = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return halves, np.concatenate([face, face])


def _cut(
    triangles: NDArray[np.float64],
    own: NDArray[np.int64],
    size_at: Callable[[NDArray[np.float64], NDArray[np.int64]], NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Cut triangles in two until none is longer than `size_at` says of its centroid and of what it is a part of.

    Return triangles, what they are a part of, and these sizes.
    """
    done: list[tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]] = []
    while len(triangles) or not done:
        sizes = size_at(triangles.mean(axis=1), own)
        longest = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2).max(axis=1)
        edges = triangles[:, 1:] - triangles[:, :1]
        thin = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) < _THIN * longest**2
        long = longest > np.where(thin, _SHORTER, 1.0) * sizes
        done.append((triangles[~long], own[~long], sizes[~long]))
        triangles, own = _halved(triangles[long], own[long])
    whole, parts, sizes = (np.concatenate(column) for column in zip(*done, strict=True))
    return whole, parts, sizes


class _Solid:
    """Tells which points above surfaces lie inside a closed body."""

    def __init__(self, topology: MeshTopology, intersector: str, lift: float) -> None:
        self._topology, self._lift = topology, lift
        self._blocker = make_intersector(topology.vertices, topology.faces, intersector)

    def holds(self, points: NDArray[np.float64], outward: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether points just above a surface with normal `outward` are inside a body, both (n, 3)."""
        mesh = self._topology
        met = self._blocker.first_face((points + self._lift * outward).astype(np.float32), outward.astype(np.float32))
        from_behind = np.einsum("ij,ij->i", mesh.planes[met, :3], outward) > 0
        return np.asarray((met >= 0) & mesh.closed[met] & from_behind)

    def buries(self, triangles: NDArray[np.float64], face: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether either side of triangles is inside a body, (f, 2)."""
        centres, normals, closed = triangles.mean(axis=1), self._topology.planes[face, :3], self._topology.closed[face]
        out = np.zeros((len(triangles), 2), np.bool_)
        for side in range(2):
            own = np.flatnonzero(~closed) if side else np.arange(len(face))
            out[own, side] = self.holds(centres[own], (1 - 2 * side) * normals[own])
        return out


def _has_something_before(facets: Facets, topology: MeshTopology, lift: float) -> NDArray[np.bool_]:
    """Return whether something of the scene lies before each side of each facet, (f, 2)."""
    boxes = []
    for body in np.unique(topology.part):
        corners = topology.vertices[topology.faces[topology.part == body]].reshape(-1, 3)
        low, high = corners.min(axis=0), corners.max(axis=0)
        boxes.append(np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 1, high, low))
    heights = facets.normals @ np.concatenate(boxes).T
    heights -= np.einsum("ij,ij->i", facets.normals, facets.corners[:, 0])[:, None]
    behind = ~topology.closed[facets.face] & (heights.min(axis=1) < -2 * lift)
    return np.column_stack([heights.max(axis=1) > 2 * lift, behind])


class _Runs:
    """Runs of rows of arrays, one for each group.

    Parameters
    ----------
    group : (m,) int64
        Groups of the rows, in ascending order.
    """

    def __init__(self, group: NDArray[np.int64]) -> None:
        begins = np.diff(group, prepend=-1) != 0
        self.first, self.of = np.flatnonzero(begins), np.cumsum(begins) - 1
        self.length = np.diff(self.first, append=len(group))

    def sum(self, values: NDArray[Any]) -> NDArray[np.float64]:
        """Return the sum of each run."""
        return np.asarray(np.add.reduceat(values.astype(np.float64), self.first))

    def low(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the least value of each run."""
        return np.asarray(np.minimum.reduceat(values, self.first))

    def extent(self, *values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the extent of each run, of one array of values or of several that lie in the same rows."""
        low, high = np.minimum.reduce(values), np.maximum.reduce(values)
        return np.asarray(np.maximum.reduceat(high, self.first) - self.low(low))

    def least(self, values: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the first row of each run that has its least value."""
        return np.lexsort((values, self.of))[self.first]


def _joined(
    facets: Facets,
    lit: NDArray[np.bool_],
    open_to_air: NDArray[np.bool_],
    topology: MeshTopology,
    sizes: NDArray[np.float64],
    intersector: str,
    lift: float,
) -> Patches:
    """Join facets into patches no larger than `sizes`, (f,).

    Sides that light may arrive at, `lit`, (f, 2), and that are not inside a body, `open_to_air`, are joined.
    """
    centres, albedo = facets.corners.mean(axis=1), topology.albedo[facets.face]
    body = topology.part[facets.face]
    side, members = np.nonzero((lit & open_to_air).T)
    _, kind = np.unique(np.column_stack([side, body[members], albedo[members]]), axis=0, return_inverse=True)
    own = _grouped(members, kind.ravel(), facets, centres, sizes)
    patch_of = np.full((len(facets.face), 2), -1)
    patch_of[members, side] = own
    order = np.argsort(own, kind="stable")
    members, side, runs = members[order], side[order], _Runs(own[order])
    sign = 1.0 - 2.0 * side[runs.first]
    areas, corners = facets.areas[members], facets.corners[members]
    area = runs.sum(areas)
    normal = runs.sum(areas[:, None] * facets.normals[members]) * (sign / area)[:, None]
    centre = runs.sum(areas[:, None] * centres[members]) / area[:, None]
    points, weights, normals = _points_of(members, runs, facets)
    flat = np.linalg.norm(normal, axis=1) >= 1 - 1e-9
    points = np.where(flat[:, None, None], _spread(facets, members, runs, centre, points, weights), points)
    nearest = members[runs.least(((centres[members] - centre[runs.of]) ** 2).sum(axis=1))]
    whole = facets.corners.reshape(-1, 3)
    return Patches(
        facets,
        members,
        np.append(runs.first, len(members)),
        np.asarray(sign),
        _nearest_patch(patch_of, lit, centres, body),
        points,
        normals * sign[:, None, None],
        weights,
        centre,
        normal,
        np.where(flat[:, None], centre, centres[nearest]),
        area,
        np.asarray(np.linalg.norm(runs.extent(*corners.transpose(1, 0, 2)), axis=1), np.float64),
        albedo[members[runs.first]],
        body[members[runs.first]],
        make_intersector(whole, np.arange(len(whole), dtype=np.int32).reshape(-1, 3), intersector),
        lift,
    )  # fmt: skip


def _grouped(
    own: NDArray[np.int64],
    group: NDArray[np.int64],
    facets: Facets,
    centres: NDArray[np.float64],
    sizes: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Halve groups of facets in space, or by their normals, until each is as small and as flat as a patch may be.

    Return the patch of each facet `own`, numbered from 0.
    """
    patch, n = np.empty_like(own), 0
    rows = np.argsort(group, kind="stable")
    while rows.size:
        runs, at = _Runs(group[rows]), own[rows]
        heights = np.einsum("ij,ij->i", centres[at], facets.normals[at[runs.first]][runs.of])
        size = runs.low(sizes[at])[:, None]
        extent = runs.extent(*facets.corners[at].transpose(1, 0, 2)) / size
        turn = runs.extent(facets.normals[at]) / _TURN
        depth = runs.extent(heights)[:, None] / (_DEEP * size)
        bounds = np.column_stack([np.linalg.norm(extent, axis=1), np.linalg.norm(turn, axis=1), depth])
        whole = (runs.length == 1) | (bounds.max(axis=1) <= 1)
        along = np.column_stack([extent, turn, depth]).argmax(axis=1)[runs.of]
        values = np.column_stack([centres[at], facets.normals[at], heights])[np.arange(len(at)), along]
        middle = runs.low(values) + 0.5 * runs.extent(values)
        upper = values >= middle[runs.of]
        alone = (runs.sum(upper) % runs.length == 0)[runs.of]  # all in one place: a large facet beside small ones
        part = np.where(alone, np.arange(len(at)) - runs.first[runs.of], upper)
        done = whole[runs.of]
        patch[rows[done]] = n + (np.cumsum(whole) - 1)[runs.of[done]]
        n += int(whole.sum())
        number = runs.of * len(at) + part
        group[rows] = number
        rows = rows[~done]
        rows = rows[np.argsort(group[rows], kind="stable")]
    return patch


def _points_of(
    members: NDArray[np.int64], patches: _Runs, facets: Facets
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return a point in each quarter of the patches, the quarters' shares of their areas, and the normals there."""
    pieces, own, areas, part = facets.corners[members], members, facets.areas[members], patches.of
    most = patches.sum(areas) / (2 * POINTS) * _EVEN
    while (large := areas > most[part]).any():
        halves, cut = _halved(pieces[large], np.flatnonzero(large))
        pieces, areas = np.concatenate([pieces[~large], halves]), np.concatenate([areas[~large], 0.5 * areas[cut]])
        own, part = (np.concatenate([of[~large], of[cut]]) for of in (own, part))
    centres = pieces.mean(axis=1)
    order = np.argsort(part, kind="stable")
    runs = _Runs(part[order])
    for _ in range(2):  # in half, and each half again, across their largest extents
        along = runs.extent(centres[order]).argmax(axis=1)[runs.of]
        order = order[np.lexsort((centres[order, along], runs.of))]
        upto = np.cumsum(areas[order] / runs.sum(areas[order])[runs.of]) - runs.of
        middle = np.clip(runs.sum(upto < 0.5 / _EVEN) + 1, 1, runs.length - 1)
        runs = _Runs(2 * runs.of + (np.arange(len(order)) >= (runs.first + middle)[runs.of]))
    own, areas, centres = own[order], areas[order], centres[order]
    weight = runs.sum(areas)
    middles = runs.sum(areas[:, None] * centres) / weight[:, None]
    nearest = runs.least(((centres - middles[runs.of]) ** 2).sum(axis=1))
    weights = weight.reshape(-1, POINTS)
    return (
        centres[nearest].reshape(-1, POINTS, 3),
        weights / weights.sum(axis=1, keepdims=True),
        facets.normals[own[nearest]].reshape(-1, POINTS, 3),
    )


def _spread(
    facets: Facets,
    members: NDArray[np.int64],
    patches: _Runs,
    centre: NDArray[np.float64],
    points: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Move points of plane patches so that their mean square distance from its centre is the patch's, as Gauss's are.

    Those of a patch stay where they are if one would leave it.
    """
    triangles, areas = facets.corners[members], facets.areas[members]
    corners = triangles - centre[patches.of, None]
    # mean square over a triangle: (sum of squares of the corners + square of their sum) / 12
    square = areas * ((corners**2).sum(axis=(1, 2)) + (corners.sum(axis=1) ** 2).sum(axis=1)) / 12
    square = patches.sum(square) / patches.sum(areas)
    offset = points - np.einsum("nk,nkj->nj", weights, points)[:, None]
    own = np.einsum("nk,nkj->n", weights, offset**2)
    moved = centre[:, None] + offset * np.sqrt(square / np.where(own > 0, own, np.inf))[:, None, None]
    along = np.roll(triangles, -1, axis=1) - triangles
    normal = facets.normals[members[patches.first]][patches.of]
    inward = np.cross(normal[:, None], along)
    to = moved[patches.of][:, :, None] - triangles[:, None]
    inside = np.all(np.einsum("mej,mkej->mke", inward, to) >= 0, axis=2)
    hold = np.all(np.logical_or.reduceat(inside, patches.first), axis=1)
    return np.where(hold[:, None, None], moved, points)


def _nearest_patch(
    patch_of: NDArray[np.int64], lit: NDArray[np.bool_], centres: NDArray[np.float64], body: NDArray[np.int32]
) -> NDArray[np.int64]:
    """Give facets mostly inside a closed body to the nearest patch of their side; others that are not lit have none."""
    out = patch_of.copy()
    for side in range(2):
        for b in np.unique(body):
            own = np.flatnonzero(body == b)
            kept, left = own[patch_of[own, side] >= 0], own[(patch_of[own, side] < 0) & lit[own, side]]
            if len(kept) and len(left):
                _, near = cKDTree(centres[kept]).query(centres[left])
                out[left, side] = patch_of[kept[near], side]
    return out
