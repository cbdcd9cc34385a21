"""Patches: small pieces of the surfaces of a scene, over each of which the light that leaves it is taken as even."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

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
_EVEN = 1 + 1e-9
"""Rounding of areas that are the same."""
_DEEP = 0.2
"""Largest extent of a patch across its first facet, in sizes of the patch: surfaces in two planes are not joined."""
_LIFT = 1e-5
"""Share of the scene's extent by which rays begin above their surface, as they are of single precision."""
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
) -> Patches:
    """Cut the surfaces of a scene into patches.

    Facets too long are cut in two across their longest edge. Facets that lie beside one another and face alike are
    joined, so that a curved mesh of many faces has few patches. A part of a surface inside a closed body, as the floor
    below a box, has none.

    Parameters
    ----------
    topology : MeshTopology
        The bodies, world frame.
    size_at : callable
        Largest extent of a patch.
    intersector : {"auto", "embree", "float64"}
        As for :class:`~phasemark.render.Renderer`.
    """
    lift = _LIFT * float((topology.high - topology.low).max())
    normals = topology.planes[:, :3]
    triangles, face, sizes = _cut(
        topology.vertices[topology.faces], np.arange(len(topology.faces)), lambda at, own: size_at(at, normals[own])
    )
    triangles, own = cut_where_bodies_stand(triangles, face, topology, lift)
    face, sizes = face[own], sizes[own]
    solid = _Solid(topology, intersector, lift)
    buried = solid.buries(triangles, face)
    edges = triangles[:, 1:] - triangles[:, :1]
    areas = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    facets = Facets(triangles, topology.planes[face, :3], areas, face)
    useful = ~buried & _has_something_before(facets, topology, lift)
    return _joined(facets, useful, topology, sizes, intersector, lift)


def _longest(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the longest edge of each triangle."""
    return np.asarray(np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2).max(axis=1))


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
        longest = _longest(triangles)
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


def _joined(
    facets: Facets,
    useful: NDArray[np.bool_],
    topology: MeshTopology,
    sizes: NDArray[np.float64],
    intersector: str,
    lift: float,
) -> Patches:
    """Join facets into patches no larger than `sizes`, (f,); `useful`, (f, 2), says which sides are wanted."""
    centres, albedo = facets.corners.mean(axis=1), topology.albedo[facets.face]
    body = topology.part[facets.face]
    leaves, sides = [], []
    for side in range(2):
        for b in np.unique(body[useful[:, side]]):
            own = np.flatnonzero(useful[:, side] & (body == b))
            for value in np.unique(albedo[own]):
                found = _grouped(own[albedo[own] == value], facets, centres, sizes)
                leaves += found
                sides += [side] * len(found)
    patch_of = np.full((len(facets.face), 2), -1)
    for k, (leaf, side) in enumerate(zip(leaves, sides, strict=True)):
        patch_of[leaf, side] = k
    sign = 1.0 - 2.0 * np.array(sides)
    first = np.cumsum([0, *(len(leaf) for leaf in leaves)])
    members = np.concatenate(leaves)
    area = np.add.reduceat(facets.areas[members], first[:-1])
    normal = np.add.reduceat(facets.areas[members, None] * facets.normals[members], first[:-1])
    normal *= (sign / area)[:, None]
    centre = np.add.reduceat(facets.areas[members, None] * centres[members], first[:-1]) / area[:, None]
    outlook = centre.copy()
    points, normals = np.empty((2, len(leaves), POINTS, 3))
    weights, size = np.empty((len(leaves), POINTS)), np.empty(len(leaves))
    for k, leaf in enumerate(leaves):
        points[k], weights[k], normals[k] = _points_of(leaf, facets)
        size[k] = np.linalg.norm(np.ptp(facets.corners[leaf].reshape(-1, 3), axis=0))
        if np.linalg.norm(normal[k]) < 1 - 1e-9:
            outlook[k] = centres[leaf[np.argmin(((centres[leaf] - centre[k]) ** 2).sum(axis=1))]]
        else:
            points[k] = _spread_as(facets, leaf, centre[k], points[k], weights[k])
    corners = facets.corners.reshape(-1, 3)
    return Patches(
        facets,
        members,
        first,
        sign,
        _nearest_patch(patch_of, facets, centres, centre, body),
        points,
        normals * sign[:, None, None],
        weights,
        centre,
        normal,
        outlook,
        area,
        size,
        albedo[members[first[:-1]]],
        body[members[first[:-1]]],
        make_intersector(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3), intersector),
        lift,
    )  # fmt: skip


def _grouped(
    facets_of: NDArray[np.int64],
    facets: Facets,
    centres: NDArray[np.float64],
    sizes: NDArray[np.float64],
) -> list[NDArray[np.int64]]:
    """Halve a set of facets in space, or by their normals, until each is as small and as flat as a patch may be."""
    leaves, waiting = [], [facets_of]
    while waiting:
        own = waiting.pop()
        extent = np.ptp(facets.corners[own].reshape(-1, 3), axis=0)
        turn = np.ptp(facets.normals[own], axis=0)
        size = sizes[own].min()
        heights = centres[own] @ facets.normals[own[0]]
        depth = np.ptp(heights)
        bounds = [np.linalg.norm(extent) / size, np.linalg.norm(turn) / _TURN, depth / (_DEEP * size)]
        if len(own) == 1 or max(bounds) <= 1:
            leaves.append(own)
            continue
        along = np.concatenate([extent / size, turn / _TURN, [depth / (_DEEP * size)]])
        values = np.column_stack([centres[own], facets.normals[own], heights])[:, np.argmax(along)]
        low = values < 0.5 * (values.min() + values.max())
        if not low.any() or low.all():  # all in one place: a large facet beside small ones
            leaves += [own[[k]] for k in range(len(own))]
            continue
        waiting += [own[low], own[~low]]
    return leaves


def _points_of(
    leaf: NDArray[np.int64], facets: Facets
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return a point in each quarter of a patch, the quarters' shares of its area, and the normals there."""
    pieces, own, areas = facets.corners[leaf], leaf, facets.areas[leaf]
    while (large := areas > areas.sum() / (2 * POINTS) * _EVEN).any():
        halves, parents = _halved(pieces[large], own[large])
        pieces, own = np.concatenate([pieces[~large], halves]), np.concatenate([own[~large], parents])
        areas = np.concatenate([areas[~large], np.tile(0.5 * areas[large], 2)])
    centres = pieces.mean(axis=1)
    groups = [np.arange(len(own))]
    for _ in range(2):
        parts: list[NDArray[np.int64]] = []
        for group in groups:
            along = np.argmax(np.ptp(centres[group], axis=0))
            order = group[np.argsort(centres[group, along], kind="stable")]
            upto = np.cumsum(areas[order])
            middle = int(np.clip(np.searchsorted(upto, 0.5 * upto[-1] / _EVEN) + 1, 1, len(order) - 1))
            parts += [order[:middle], order[middle:]]
        groups = parts
    points, normals, weights = np.empty((POINTS, 3)), np.empty((POINTS, 3)), np.empty(POINTS)
    for k, group in enumerate(groups):
        middle = areas[group] @ centres[group] / areas[group].sum()
        nearest = group[np.argmin(((centres[group] - middle) ** 2).sum(axis=1))]
        points[k], normals[k], weights[k] = centres[nearest], facets.normals[own[nearest]], areas[group].sum()
    return points, weights / weights.sum(), normals


def _spread_as(
    facets: Facets,
    leaf: NDArray[np.int64],
    centre: NDArray[np.float64],
    points: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Move points of a plane patch so that their mean square distance from its centre is the patch's, as Gauss's are.

    They stay where they are if one would leave the patch.
    """
    corners, share = facets.corners[leaf] - centre, facets.areas[leaf] / facets.areas[leaf].sum()
    # mean square over a triangle: (sum of squares of the corners + square of their sum) / 12
    square = share @ ((corners**2).sum(axis=(1, 2)) + (corners.sum(axis=1) ** 2).sum(axis=1)) / 12
    offset = points - weights @ points
    own = weights @ (offset**2).sum(axis=1)
    moved = centre + offset * np.sqrt(square / own if own > 0 else 0.0)
    return moved if _hold(facets.corners[leaf], facets.normals[leaf[0]], moved).all() else points


def _hold(
    triangles: NDArray[np.float64], normal: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return whether points lie in any of some triangles of one plane."""
    along = np.roll(triangles, -1, axis=1) - triangles
    to = points[:, None, None] - triangles
    inward = np.cross(np.broadcast_to(along, to.shape), to) @ normal
    return np.asarray(np.any((inward >= 0).all(axis=2), axis=1))


def _nearest_patch(
    patch_of: NDArray[np.int64],
    facets: Facets,
    centres: NDArray[np.float64],
    centre: NDArray[np.float64],
    body: NDArray[np.int32],
) -> NDArray[np.int64]:
    """Give facets that are in no patch, those mostly inside a closed body, to the nearest patch of their side."""
    out = patch_of.copy()
    for side in range(2):
        for b in np.unique(body):
            own = np.flatnonzero(body == b)
            kept, left = own[patch_of[own, side] >= 0], own[patch_of[own, side] < 0]
            if len(kept) and len(left):
                _, near = cKDTree(centres[kept]).query(centres[left])
                out[left, side] = patch_of[kept[near], side]
    return out
