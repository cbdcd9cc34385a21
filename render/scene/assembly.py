"""Bodies put together: one surface for the area integral, of which only what moved is rebuilt.

Each body is analysed once, in its own frame. Where it stands, its arrays are turned and written into those of the
scene. Curves along which bodies pass through one another are edges too.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.integral.area_integral import mesh_digest
from phasemark.render.integral.convex_parts import enter_parts, part_around
from phasemark.render.integral.crossings import crossings, cut_where_it_crosses_itself, move_onto, with_creases
from phasemark.render.integral.face_search import FaceGrid
from phasemark.render.integral.gloss import gloss_row
from phasemark.render.integral.intersect import Intersector, make_intersector
from phasemark.render.integral.mesh_topology import CREASE_RAD, MeshTopology, along_curve, in_lines
from phasemark.render.integral.shells import unite_shells
from phasemark.render.rigid import product
from phasemark.render.scene.body import Body, Surface
from phasemark.render.scene.solids import Solid

_RIGID = 4e-6
"""Two bodies that moved by no more than this against one another (metres, radians) moved as one."""
_NO_GRID = FaceGrid.of_faces(np.zeros((0, 3, 3)), np.zeros(0, np.bool_))
_WATCHED = np.array([[1.0, 0.31, 0.17], [-0.23, 1.0, 0.41], [0.37, -0.19, 1.0]])
"""Directions, and their opposites, in which it is asked whether a lens is inside a body."""


class Assembly:
    """Bodies where they stand, as one surface.

    Parameters
    ----------
    bodies : sequence of Body
        In the order of the parts of the surface.
    intersector : {"auto", "embree", "float64"}
        As for :class:`~phasemark.render.Renderer`.
    solids : bool
        Whether primitives are the solids they are; False: the meshes that stand for them.
    crosses : bool
        Whether curves along which bodies pass through one another are found; rays need none.
    """

    topology: MeshTopology
    """All bodies, world frame."""
    intersector: Intersector
    """Of the topology's faces."""

    def __init__(self, bodies: Sequence[Body], intersector: str, *, solids: bool = True, crosses: bool = True) -> None:
        self._kind, self._bodies, self._crosses = intersector, bodies, crosses
        self._facets: tuple[Assembly, NDArray[np.int64]] | None = None
        self._solids = _solids(bodies) if solids else [None] * len(bodies)
        self._own = _analysed(bodies, self._solids)
        self._shells = [
            _shell(body, solid, mesh) for body, solid, mesh in zip(bodies, self._solids, self._own, strict=True)
        ]
        self._poses = np.array([body.pose for body in bodies])
        self._moving = np.zeros(len(bodies), np.bool_)
        self._still: tuple[NDArray[np.int64], Intersector] | None = None
        self._of_shapes: dict[int, Intersector] = {}
        self._first = _Firsts.of(self._own, self._solids)
        self._parts = _Parts.of(self._solids, self._first)
        self._frames = _Placed.joined(self._own, self._parts.balls)
        self._curves: dict[tuple[int, int], _Curve] = {}
        self._bounds = np.empty((len(bodies), 2, 3))
        self._base = self._joined()
        self._turn(np.arange(len(bodies)))

    def copy(self) -> Assembly:
        """Return one that can be placed otherwise; what stands still in both is shared."""
        other = copy.copy(self)
        other._facets = None
        other._moving, other._curves = self._moving.copy(), dict(self._curves)
        other._poses, other._bounds = self._poses.copy(), self._bounds.copy()
        placed = _Placed.of(self._base)
        lines = {name: in_lines(getattr(placed, name)) for name in ("corner_normals", "search")}
        other._base = self._base._replace(**{name: own.copy() for name, own in placed._asdict().items()} | lines)
        return other

    def place(self, body2world: NDArray[np.float64]) -> None:
        """Move the bodies to (b, 4, 4) poses; what stands already where it is to stand is left as it is."""
        moved = np.flatnonzero((body2world != self._poses).any(axis=(1, 2)))
        if not moved.size:
            return
        if not self._moving[moved].all():
            self._moving[moved] = True
            self._still = None
        self._poses = body2world.copy()
        self._turn(moved)

    def let_move(self, bodies: NDArray[np.bool_]) -> None:
        """Tell which bodies will move, (b,): what stands still is then built once, for copies too."""
        if (bodies & ~self._moving).any():
            self._moving = self._moving | bodies
            self._still = None
            self.intersector = self._intersectors()

    def in_facets(self, whole: Sequence[Body], body2world: NDArray[np.float64]) -> tuple[Assembly, NDArray[np.int64]]:
        """Return the shells of bodies, of which these may be parts, as meshes where they stand, and whose each is."""
        if self._facets is None:
            shells = [body.shells() for body in whole]
            owner = np.repeat(np.arange(len(whole)), [len(own) for own in shells])
            same = len(owner) == len(whole) == len(self._bodies) and all(solid is None for solid in self._solids)
            facets = self if same else Assembly([one for own in shells for one in own], self._kind, solids=False)
            self._facets = facets, owner
        facets, owner = self._facets
        facets.place(body2world[owner])
        return facets, owner

    def corners(self) -> NDArray[np.float64]:
        """Return the vertices of all bodies, where they stand, those of the meshes of solids too, (v, 3)."""
        return np.concatenate([self._placed_shell(b)[0] for b in range(len(self._own))])

    def check_outside(self, lens_m: NDArray[np.float64], frames: NDArray[np.int64]) -> None:
        """Refuse a lens inside a closed body.

        Parameters
        ----------
        lens_m : (n, 3) float64
            World frame.
        frames : (n,) int64
            Their numbers, for the message.

        Raises
        ------
        UsageError
        """
        mesh = self.topology
        for frame, lens in zip(frames, lens_m, strict=True):
            part = part_around(mesh, lens)
            if part >= 0:
                raise _inside(int(frame), self._bodies[mesh.part[mesh.parts[part, 0]]].name)
        if all(solid is not None for solid in self._solids):
            return
        directions = np.concatenate([_WATCHED, -_WATCHED])
        rays = np.tile(directions, (len(lens_m), 1))
        face = self.intersector.first_face(
            np.repeat(lens_m, len(directions), axis=0).astype(np.float32), rays.astype(np.float32)
        )
        from_behind = np.einsum("ij,ij->i", self.topology.planes[face, :3], rays) > 0
        inside = np.flatnonzero((face >= 0) & self.topology.closed[face] & from_behind)
        if inside.size:
            k = int(inside[0])
            raise _inside(int(frames[k // len(directions)]), self._bodies[self.topology.part[face[k]]].name)

    def _joined(self) -> MeshTopology:
        """Join the arrays that do not depend on poses, and make room for those that do."""
        own, first = self._own, self._first
        faces = [mesh.faces + first.vertex[b] for b, mesh in enumerate(own)]
        creases = [_shifted(mesh.creases, first.vertex[b], first.face[b]) for b, mesh in enumerate(own)]
        n_faces, n_smooth = first.face[-1], first.smooth[-1]
        folds = [mesh.folds + np.array([first.vertex[b]] * 2 + [first.smooth[b]]) for b, mesh in enumerate(own)]
        begins = [mesh.first_fold[:-1] + first.fold[b] for b, mesh in enumerate(own)]
        patches = np.cumsum([0, *(int(mesh.patch.max()) + 1 for mesh in own)])
        alone = len(own) == 1 and np.array_equal(self._poses[0], np.eye(4))
        return MeshTopology(
            **_end_to_end(own, ("flat", "plain", "albedo", "gloss", "closed", "concave")),
            vertices=np.empty((first.vertex[-1], 3)),
            faces=np.ascontiguousarray(np.concatenate(faces), np.int32),
            planes=np.empty((n_faces, 4)),
            corner_normals=in_lines(np.zeros((n_faces, 9))),
            patch=np.concatenate([mesh.patch + patches[b] for b, mesh in enumerate(own)]).astype(np.int32),
            # the grid of a search does not turn with its faces
            searched=own[0].searched if alone else np.zeros(n_faces, np.bool_),
            search=in_lines(np.concatenate([mesh.search for mesh in own])),
            grid=own[0].grid if alone else _NO_GRID,
            part=np.repeat(np.arange(len(own)), np.diff(first.face)).astype(np.int32),
            quadric=np.concatenate(
                [np.where(mesh.quadric >= 0, mesh.quadric + first.quadric[b], -1) for b, mesh in enumerate(own)]
            ).astype(np.int32),
            quadrics=np.empty((first.quadric[-1], 10)),
            creases=np.ascontiguousarray(np.concatenate(creases), np.int32),
            folds=np.ascontiguousarray(np.concatenate(folds), np.int32),
            first_fold=np.append(np.concatenate(begins), first.fold[-1]).astype(np.int32),
            smooth_planes=np.empty((6, n_smooth)),
            clusters=np.concatenate([_from_smooth(mesh.clusters, first.smooth[b]) for b, mesh in enumerate(own)]),
            curves=np.empty((first.curve[-1], 14)),
            parts=self._parts.faces,
            balls=np.empty_like(self._parts.balls),
            low=np.zeros(3),
            high=np.zeros(3),
            split=True,
            around=True,
        )

    def _turn(self, moved: NDArray[np.int64]) -> None:
        """Write the arrays of bodies that moved, and find where they cross others."""
        _turn_bodies(moved, self._poses, self._first, self._frames, _Placed.of(self._base), self._bounds)
        if self._crosses:
            self._cross(moved)
        self.topology = self._with_curves()
        self.intersector = self._intersectors()

    def _cross(self, moved: NDArray[np.int64]) -> None:
        """Find the curves along which bodies that moved pass through any other."""
        gone, before = set(moved.tolist()), self._curves
        self._curves = {pair: found for pair, found in before.items() if gone.isdisjoint(pair)}
        has_moved = np.zeros(len(self._own), np.bool_)
        has_moved[moved] = True
        for one, two in _close_pairs(self._base, has_moved, self._bounds, self._first.part):
            pair, pose = (int(one), int(two)), self._poses[one]
            other = np.column_stack([self._poses[two, :3, :3], self._poses[two, :3, 3] - pose[:3, 3]])
            relative = product(pose[:3, :3].T, other)
            found = before.get(pair)
            if found is None or np.abs(found.relative - relative).max() > _RIGID:
                ends, pairs = self._found_curve(*pair)
                found = _Curve(relative, product(ends - pose[:3, 3], pose[:3, :3]), pairs)
            self._curves[pair] = found

    def _found_curve(self, one: int, two: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the segments (k, 2, 3) along which two bodies pass through one another, and their faces (k, 2)."""
        (vertices, faces, own), (corners, others, theirs) = self._placed_shell(one), self._placed_shell(two)
        ends, pairs = crossings(np.concatenate([vertices, corners]), faces, others + np.int32(len(vertices)))
        pairs = np.column_stack([own[pairs[:, 0]], theirs[pairs[:, 1]]]) + self._first.face[[one, two]]
        move_onto(self._base, pairs, ends)
        return ends, pairs

    def _placed_shell(self, b: int) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int64]]:
        """Return the triangles of a body where it stands, and the face of the body that each of them stands for."""
        vertices, faces, face = self._shells[b]
        pose = self._poses[b]
        return product(vertices, pose[:3, :3].T) + pose[:3, 3], faces, face

    def _with_curves(self) -> MeshTopology:
        """Return the surface with the curves among its creases."""
        base = self._base._replace(low=self._bounds[:, 0].min(axis=0), high=self._bounds[:, 1].max(axis=0))
        placed = [(self._poses[pair[0]], self._curves[pair]) for pair in sorted(self._curves)]
        if not any(len(curve.pairs) for _, curve in placed):
            return base
        ends = np.concatenate([product(curve.ends, pose[:3, :3].T) + pose[:3, 3] for pose, curve in placed])
        pairs = np.concatenate([curve.pairs for _, curve in placed])
        # what a closed body hides is asked of the first face: an open one hides nothing
        open_last = base.closed[pairs[:, 0]] & ~base.closed[pairs[:, 1]]
        pairs[open_last] = pairs[open_last][:, ::-1]
        return with_creases(base, ends, pairs, True)

    def _intersectors(self) -> Intersector:
        """Return the intersector: of all that stands still, and of each body that moves in its own frame."""
        mesh = self._base
        solid = np.array([own is not None for own in self._solids])
        if self._still is None:
            numbers = np.flatnonzero(~(self._moving | solid)[mesh.part])
            self._still = numbers, make_intersector(mesh.vertices.copy(), mesh.faces[numbers], self._kind)
        moving = np.flatnonzero(self._moving & ~solid)
        if not moving.size and not solid.any():
            return self._still[1]
        for b in moving:
            shape = id(self._own[b].vertices)
            if shape not in self._of_shapes:
                self._of_shapes[shape] = make_intersector(self._own[b].vertices, self._own[b].faces, self._kind)
        movers = [
            _Mover(
                self._of_shapes[id(self._own[b].vertices)], self._poses[b], np.arange(*self._first.face[b : b + 2]),
                self._bounds[b].mean(axis=0), 0.5 * float(np.linalg.norm(self._bounds[b, 1] - self._bounds[b, 0])),
            )
            for b in moving
        ]  # fmt: skip
        return _NearestOf(mesh, *self._still, movers)


def _inside(frame: int, name: str) -> UsageError:
    return UsageError(
        f"in frame {frame} the lens is inside body '{name}': move one of them, leave the body out, or, if it is a room,"
        " take body.inside_out()"
    )


class _Curve(NamedTuple):
    """Curve along which two bodies pass through one another.

    Parameters
    ----------
    relative : (3, 4) float64
        Pose of the second in the frame of the first.
    ends : (k, 2, 3) float64
        Segments, in the frame of the first.
    pairs : (k, 2) int64
        Faces of both.
    """

    relative: NDArray[np.float64]
    ends: NDArray[np.float64]
    pairs: NDArray[np.int64]


class _Mover(NamedTuple):
    """A body that moves: its faces in its own frame, their numbers in the scene, and a ball around it."""

    intersector: Intersector
    pose: NDArray[np.float64]
    numbers: NDArray[np.int64]
    centre: NDArray[np.float64]
    radius_m: float


class _NearestOf(NamedTuple):
    """Finds the first face among triangles that stand still, those of bodies that move, and solids."""

    mesh: MeshTopology
    numbers: NDArray[np.int64]
    still: Intersector
    movers: Sequence[_Mover]

    def first_face(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.int32]:
        """Return the number of the first face met by each ray, −1 where none is."""
        n, mesh = len(origins), self.mesh
        found, distance = np.full(n, -1, np.int32), np.full(n, np.inf)
        if len(self.numbers):
            faces = self.still.first_face(origins, directions)
            _keep_nearer(mesh.planes, self.numbers, faces, np.arange(n), origins, directions, found, distance)
        if self.movers:
            rays, own_origins, own_directions = np.arange(n), np.empty_like(origins), np.empty_like(directions)
        for mover in self.movers:
            count = _aimed_at(
                mover.centre, mover.radius_m, mover.pose, origins, directions, rays, own_origins, own_directions
            )
            if count:
                faces = mover.intersector.first_face(own_origins[:count], own_directions[:count])
                _keep_nearer(mesh.planes, mover.numbers, faces, rays, origins, directions, found, distance)
        enter_parts(mesh, origins, directions, np.empty(len(mesh.parts), np.int32), found, distance)
        return found


@njit(cache=True, nogil=True)
def _aimed_at(centre, radius_m, pose, origins, directions, rays, own_origins, own_directions):  # type: ignore[no-untyped-def]
    """Write the rays that meet a ball, in the frame of its body; return how many there are."""
    count = 0
    for i in range(len(origins)):
        along, square, away = 0.0, 0.0, 0.0
        for k in range(3):
            to = centre[k] - origins[i, k]
            along += to * directions[i, k]
            square += directions[i, k] * directions[i, k]
            away += to * to
        beside = away - along * along / square
        slack = 1.0 + 1e-5  # rays are of single precision
        if beside > radius_m * radius_m * slack or (along < 0.0 and away > radius_m * radius_m * slack):
            continue
        for j in range(3):
            start, turned = 0.0, 0.0
            for k in range(3):
                start += pose[k, j] * (origins[i, k] - pose[k, 3])
                turned += pose[k, j] * directions[i, k]
            own_origins[count, j], own_directions[count, j] = start, turned
        rays[count] = i
        count += 1
    return count


@njit(cache=True, nogil=True)
def _keep_nearer(planes, numbers, faces, rays, origins, directions, found, distance):  # type: ignore[no-untyped-def]
    """Replace the faces that some rays met by those that are nearer along them."""
    for j in range(len(faces)):
        if faces[j] < 0:
            continue
        i, f = rays[j], numbers[faces[j]]
        facing, height = 0.0, planes[f, 3]
        for k in range(3):
            facing += planes[f, k] * directions[i, k]
            height -= planes[f, k] * origins[i, k]
        t = height / facing if facing != 0.0 else 0.0
        if t < distance[i]:
            found[i], distance[i] = f, t


class _Placed(NamedTuple):
    """Arrays that depend on where bodies stand, of all of them, as the surface has them; and balls around parts."""

    vertices: NDArray[np.float64]
    planes: NDArray[np.float64]
    corner_normals: NDArray[np.float32]
    search: NDArray[np.float32]
    smooth_planes: NDArray[np.float64]
    clusters: NDArray[np.float64]
    quadrics: NDArray[np.float64]
    curves: NDArray[np.float64]
    balls: NDArray[np.float64]

    @classmethod
    def joined(cls, own: Sequence[MeshTopology], balls: NDArray[np.float64]) -> _Placed:
        """Join the arrays of bodies, each in its own frame."""
        names = [name for name in cls._fields if name not in ("smooth_planes", "balls")]
        smooth_planes = _with_solids_numbered([mesh.smooth_planes for mesh in own])
        return cls(**_end_to_end(own, names), smooth_planes=smooth_planes, balls=balls)

    @classmethod
    def of(cls, mesh: MeshTopology) -> _Placed:
        """Return those arrays of a surface."""
        return cls(*(getattr(mesh, name) for name in cls._fields))


def _end_to_end(own: Sequence[MeshTopology], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return some arrays of bodies, by name, those of one body behind those of the one before."""
    return {name: np.concatenate([getattr(mesh, name) for mesh in own]) for name in names}


def _with_solids_numbered(planes: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Join smooth planes, (6, g), with other numbers for the round solids of other bodies."""
    joined = np.concatenate(planes, axis=1)
    counts = [int(own[5].max(initial=-1.0)) + 1 for own in planes]
    joined[5] += np.where(joined[5] >= 0, np.repeat(np.cumsum([0, *counts[:-1]]), [own.shape[1] for own in planes]), 0)
    return joined


class _Parts(NamedTuple):
    """Convex parts of solids: first face and the one behind the last, (k, 2), and balls in their own frames, (k, 4)."""

    faces: NDArray[np.int64]
    balls: NDArray[np.float64]

    @classmethod
    def of(cls, solids: Sequence[Solid | None], first: _Firsts) -> _Parts:
        """Join the parts of solids."""
        faces, balls = [np.zeros((0, 2), np.int64)], [np.zeros((0, 4))]
        for b, solid in enumerate(solids):
            if solid is not None:
                faces.append(first.face[b] + np.column_stack([solid.first[:-1], solid.first[1:]]))
                balls.append(solid.balls)
        return cls(np.concatenate(faces), np.concatenate(balls))


@njit(cache=True, nogil=True)
def _turn_bodies(moved, poses, first, own, placed, bounds):  # type: ignore[no-untyped-def]
    """Write the arrays of bodies that were turned and moved, and the boxes around these."""
    for b in moved:
        pose = poses[b]
        transposed, offset = pose[:3, :3].T, pose[:3, 3]
        bounds[b, 0], bounds[b, 1] = np.inf, -np.inf
        for i in range(first.vertex[b], first.vertex[b + 1]):
            _move(own.vertices[i], transposed, offset, placed.vertices[i])
            for k in range(3):
                bounds[b, 0, k] = min(bounds[b, 0, k], placed.vertices[i, k])
                bounds[b, 1, k] = max(bounds[b, 1, k], placed.vertices[i, k])
        for f in range(first.face[b], first.face[b + 1]):
            _turn_plane(own.planes[f], transposed, offset, 1.0, placed.planes[f])
            for k in range(0, 9, 3):
                _turn(own.corner_normals[f, k : k + 3], transposed, placed.corner_normals[f, k : k + 3])
            for k in range(4):
                placed.search[f, k] = placed.planes[f, k]
            _turn_plane(own.search[f, 4:8], transposed, offset, -1.0, placed.search[f, 4:8])
            _turn_plane(own.search[f, 8:12], transposed, offset, -1.0, placed.search[f, 8:12])
        for i in range(first.smooth[b], first.smooth[b + 1]):
            _turn_plane(own.smooth_planes[:4, i], transposed, offset, 1.0, placed.smooth_planes[:4, i])
            placed.smooth_planes[4:, i] = own.smooth_planes[4:, i]
        for c in range(first.cluster[b], first.cluster[b + 1]):
            _move(own.clusters[c, :3], transposed, offset, placed.clusters[c, :3])
            _turn(own.clusters[c, 3:6], transposed, placed.clusters[c, 3:6])
        for q in range(first.quadric[b], first.quadric[b + 1]):
            _turn_quadric(own.quadrics[q], transposed, offset, placed.quadrics[q])
        for c in range(first.curve[b], first.curve[b + 1]):
            placed.curves[c, 0], placed.curves[c, 13] = own.curves[c, 0], b
            _move(own.curves[c, 1:4], transposed, offset, placed.curves[c, 1:4])
            for k in range(4, 13, 3):
                _turn(own.curves[c, k : k + 3], transposed, placed.curves[c, k : k + 3])
        for p in range(first.part[b], first.part[b + 1]):
            _move(own.balls[p, :3], transposed, offset, placed.balls[p, :3])
            placed.balls[p, 3] = own.balls[p, 3]
            if first.vertex[b] == first.vertex[b + 1]:  # a solid without corners
                for k in range(3):
                    bounds[b, 0, k] = min(bounds[b, 0, k], placed.balls[p, k] - placed.balls[p, 3])
                    bounds[b, 1, k] = max(bounds[b, 1, k], placed.balls[p, k] + placed.balls[p, 3])


def _close_pairs(
    mesh: MeshTopology, moved: NDArray[np.bool_], bounds: NDArray[np.float64], first: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return pairs of bodies, (p, 2), lower first, one of which moved and that may pass through one another."""
    room = 256
    while True:
        pairs = np.empty((room, 2), np.int64)
        n = _fill_close_pairs(mesh, moved, bounds, first, pairs)
        if n <= room:
            return pairs[:n]
        room = n


@njit(cache=True, nogil=True)
def _fill_close_pairs(mesh, moved, bounds, first, pairs):  # type: ignore[no-untyped-def]
    """Write the pairs; return how many there are, also beyond the room for them."""
    count = 0
    for i in range(len(moved)):
        for j in range(i + 1, len(moved)):
            if not (moved[i] or moved[j]):
                continue
            apart = False
            for k in range(3):
                apart = apart or bounds[i, 0, k] >= bounds[j, 1, k] or bounds[j, 0, k] >= bounds[i, 1, k]
            if apart:
                continue
            meet = first[i] == first[i + 1] or first[j] == first[j + 1]  # a mesh has no parts to be asked
            for p in range(first[i], first[i + 1]):
                for q in range(first[j], first[j + 1]):
                    meet = meet or not (_beyond(mesh, p, mesh.balls[q]) or _beyond(mesh, q, mesh.balls[p]))
            if meet:
                if count < len(pairs):
                    pairs[count, 0], pairs[count, 1] = i, j
                count += 1
    return count


@njit(cache=True, nogil=True)
def _beyond(mesh, part, ball):  # type: ignore[no-untyped-def]
    """Return whether a ball is beyond a plane of a convex part, or apart from the ball around it."""
    own, square = mesh.balls[part], 0.0
    for k in range(3):
        square += (ball[k] - own[k]) ** 2
    if square > (ball[3] + own[3]) ** 2:
        return True
    for f in range(mesh.parts[part, 0], mesh.parts[part, 1]):
        plane = mesh.planes[f]
        if plane[0] * ball[0] + plane[1] * ball[1] + plane[2] * ball[2] - plane[3] > ball[3]:
            return True
    return False


@njit(cache=True, nogil=True)
def _move(point, transposed, offset, out):  # type: ignore[no-untyped-def]
    _turn(point, transposed, out)
    for k in range(3):
        out[k] += offset[k]


@njit(cache=True, nogil=True)
def _turn_quadric(own, transposed, offset, out):  # type: ignore[no-untyped-def]
    """Turn and move p · A p + 2 b · p + c = 0: A' = R A Rᵀ, b' = R b − A' t, c' = c − (b' + R b) · t."""
    places = ((0, 3, 4), (3, 1, 5), (4, 5, 2))
    for i in range(3):
        for j in range(i, 3):
            total = 0.0
            for k in range(3):
                for m in range(3):
                    total += transposed[k, i] * own[places[k][m]] * transposed[m, j]
            out[places[i][j]] = total
    _turn(own[6:9], transposed, out[6:9])
    constant = own[9]
    for i in range(3):
        turned = out[6 + i]
        for k in range(3):
            out[6 + i] -= out[places[i][k]] * offset[k]
        constant -= (turned + out[6 + i]) * offset[i]
    out[9] = constant


@njit(cache=True, nogil=True)
def _turn(vector, transposed, out):  # type: ignore[no-untyped-def]
    x, y, z = float(vector[0]), float(vector[1]), float(vector[2])
    for k in range(3):
        out[k] = (x * transposed[0, k] + y * transposed[1, k]) + z * transposed[2, k]


@njit(cache=True, nogil=True)
def _turn_plane(plane, transposed, offset, sign, out):  # type: ignore[no-untyped-def]
    """Turn a plane n · p = d, or with sign −1 a function n · p + d."""
    x, y, z = float(plane[0]), float(plane[1]), float(plane[2])
    shift = 0.0
    for k in range(3):
        normal = (x * transposed[0, k] + y * transposed[1, k]) + z * transposed[2, k]
        out[k] = normal
        shift += normal * offset[k]
    out[3] = plane[3] + sign * shift


class _Firsts(NamedTuple):
    """First places of the arrays of each body in those of the scene, (b + 1,) each."""

    vertex: NDArray[np.int64]
    face: NDArray[np.int64]
    smooth: NDArray[np.int64]
    fold: NDArray[np.int64]
    cluster: NDArray[np.int64]
    quadric: NDArray[np.int64]
    curve: NDArray[np.int64]
    part: NDArray[np.int64]

    @classmethod
    def of(cls, own: Sequence[MeshTopology], solids: Sequence[Solid | None]) -> _Firsts:
        """Count the arrays of bodies."""
        counts = [[0] * len(cls._fields)]
        for mesh, solid in zip(own, solids, strict=True):
            smooth, balls = mesh.smooth_planes.T, () if solid is None else solid.balls
            arrays = (mesh.vertices, mesh.faces, smooth, mesh.folds, mesh.clusters, mesh.quadrics, mesh.curves, balls)
            counts.append([len(array) for array in arrays])
        return cls(*np.ascontiguousarray(np.cumsum(counts, axis=0).T))


def _solids(bodies: Sequence[Body]) -> list[Solid | None]:
    """Return the solids that are rendered in place of meshes; boxes are triangles where there are very many."""
    many = 512  # every ray asks every solid
    found = [body.solid for body in bodies]
    if len(found) <= many:
        return found
    return [solid if solid is not None and len(solid.quadrics) else None for solid in found]


_Shell = tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int64]]
"""Vertices, triangles, and the face of the body that each triangle stands for."""


def _shell(body: Body, solid: Solid | None, own: MeshTopology) -> _Shell:
    """Return the triangles in which crossings with other bodies are looked for."""
    if solid is None or body.primitive is None:
        return own.vertices, own.faces, np.arange(len(own.faces))
    vertices, faces = body.primitive.vertices, body.primitive.faces
    order = along_curve(vertices[faces].mean(axis=1))
    return vertices, faces[order].astype(np.int32), body.primitive.face[order]


def _analysed(bodies: Sequence[Body], solids: Sequence[Solid | None]) -> list[MeshTopology]:
    """Analyse each body, equal meshes once."""
    known: dict[tuple[bytes, bool], MeshTopology] = {}
    glossy = any(body.is_glossy for body in bodies)
    found = []
    for body, solid in zip(bodies, solids, strict=True):
        topology = _analysed_mesh(body, known) if solid is None else solid.topology()
        if isinstance(body.albedo, float):
            topology = topology._replace(albedo=np.full(len(topology.faces), body.albedo))
        if glossy:
            row = gloss_row(body.retroreflecting, body.specular, body.shininess)
            topology = topology._replace(gloss=np.tile(row, (len(topology.faces), 1)))
        found.append(topology)
    return found


def _analysed_mesh(body: Body, known: dict[tuple[bytes, bool], MeshTopology]) -> MeshTopology:
    """Analyse the mesh of a body, or return what is known of it."""
    mesh: Surface = Surface.of(body)
    key = mesh_digest(mesh), body.smooth
    if key not in known:
        whole = MeshTopology.from_mesh(unite_shells(mesh), CREASE_RAD if body.smooth else 0.0)
        known[key] = cut_where_it_crosses_itself(whole)
    return known[key]


def _shifted(creases: NDArray[np.int32], vertex: int, face: int) -> NDArray[np.int64]:
    """Return creases with their vertices and faces renumbered; −1 stays."""
    ends, sides = creases[:, :2].astype(np.int64), creases[:, 2:].astype(np.int64)
    return np.concatenate([ends + vertex, np.where(sides >= 0, sides + face, -1)], axis=1)


def _from_smooth(clusters: NDArray[np.float64], smooth: int) -> NDArray[np.float64]:
    """Return clusters of faces that begin later among the smooth faces."""
    later = clusters.copy()
    later[:, 11] += smooth
    return later
