"""Scene samples of a direct sensor: direction, range and amplitude, from the exact integral.

The integral of section 3 cuts every cell of a grid along the edges of the mesh and places a few points in each smooth
piece. Here these points keep their path lengths instead of being added to phasors. A wall and a floor fill what the
landmark leaves free, cell by cell.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark.render.background import Background, background_hit, nearer_plane, parameters_of_views
from phasemark.render.integral.area_integral import (
    NO_LEAST,
    camera_poses,
    cast_rays,
    find_faces,
    of_poses,
    poses_of_views,
    topology_of,
)
from phasemark.render.integral.arguments import Camera, Poses, Samples, towards_landmark, towards_level
from phasemark.render.integral.buffers import Buffers, Layout, lend_buffers
from phasemark.render.integral.gloss import count_highlight_boxes
from phasemark.render.integral.image_rays import ray_of
from phasemark.render.integral.intersect import Intersector, make_intersector
from phasemark.render.integral.light import landmark_hit, reflected_by
from phasemark.render.integral.mesh_topology import MeshTopology
from phasemark.render.integral.quadrature_rules import G2W, G2X, G4W, G4X, gauss_legendre
from phasemark.render.integral.ray_plan import SKIPPED, plan_rays
from phasemark.render.integral.surface_mesh import SurfaceMesh
from phasemark.render.kernel import inner, kernel
from phasemark.render.rigid import rigid_transforms
from phasemark.render.view import Views

LOWER, UPPER, WALL, FLOOR = 0, 1, 2, 3
"""Parts of a scene: the landmark's lower and upper part, and the planes behind it."""

_SAMPLES = 1 << 15
_MOST_BOXES = 32


class SceneSamples(NamedTuple):
    """Points of what is seen from n poses; those of pose i are ``start[i]`` to ``start[i + 1]``.

    Parameters
    ----------
    start : (n + 1,) int64
    tangents : (m, 2) float64
        y and z of the ray (1, y, z), frame of the tilted camera.
    range_m : (m,) float64
        Path length along the ray.
    amplitude : (m,) float64
        cos θ / r² times the area of tangents that the point stands for, times the albedo of faces that have one of
        their own and of the background.
    area : (m,) float64
        Area of tangents that the point stands for.
    part : (m,) int32
        `LOWER` or `UPPER` part of the mesh, or `WALL` or `FLOOR` behind it; in a scene the body, and the numbers after
        the last body for wall and floor.
    """

    start: NDArray[np.int64]
    tangents: NDArray[np.float64]
    range_m: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    area: NDArray[np.float64]
    part: NDArray[np.int32]

    @property
    def n_views(self) -> int:
        """Number of poses."""
        return len(self.start) - 1


class SceneMesh:
    """A mesh that samples are taken of, from any pose in space.

    Parameters
    ----------
    mesh : trimesh.Trimesh or None
        Metres. A face attribute "part" names faces 0 or 1 for two albedos; without it the sign of z does. None: there
        is nothing but what stands behind.
    intersector : {"auto", "embree", "float64"}
        As for :class:`~phasemark.render.Renderer`.
    """

    def __init__(self, mesh: SurfaceMesh | None, *, intersector: str = "auto") -> None:
        topology = MeshTopology.empty() if mesh is None else topology_of(mesh)
        self._use(topology, make_intersector(topology.vertices, topology.faces, intersector), WALL)

    @classmethod
    def of_surface(cls, topology: MeshTopology, intersector: Intersector, n_parts: int, rays: int = 0) -> SceneMesh:
        """Take samples of an analysed surface of `n_parts` parts, and resolve ranges of faces seen at a slant.

        `rays`, if not 0, is how many rays a side of each cell are cast in place of that.
        """
        surface = cls.__new__(cls)
        surface._use(topology, intersector, n_parts, resolves=True, rays=rays)
        return surface

    def _use(
        self, topology: MeshTopology, intersector: Intersector, n_parts: int, *, resolves: bool = False, rays: int = 0
    ) -> None:
        self.topology = topology
        self._rays = rays
        self._intersector = intersector
        self._n_parts = n_parts
        self._resolves = resolves

    def samples(self, landmark2cam: ArrayLike, grid: Camera) -> SceneSamples:
        """Sample what a grid of cells sees.

        Parameters
        ----------
        landmark2cam : (n, 4, 4) array_like
            Rigid transforms from the mesh's frame to the level camera frame (x along the axis, y left, z up).
        grid : Camera
            From :func:`~phasemark.render.direct.footprints.footprint_grid`.

        Returns
        -------
        SceneSamples

        Raises
        ------
        UsageError
            A transform is not finite or not rigid.
        """
        transforms = rigid_transforms(landmark2cam)
        poses = camera_poses(transforms, grid.level, parameters_of_views(None, len(transforms)))
        return self.samples_of_poses(poses, grid, 1.0, 1.0)

    def samples_of_views(
        self,
        views: Views,
        grid: Camera,
        *,
        background: Background | None = None,
        finest_m: float = 0.01,
        farthest_m: float = 20.0,
    ) -> SceneSamples:
        """Sample what a grid of cells sees of a landmark at views, and of what stands behind it.

        Parameters
        ----------
        views : Views
            As the camera itself has them, :meth:`~phasemark.render.Views.in_camera`.
        grid : Camera
            Cells that are sampled, from :func:`~phasemark.render.direct.footprint_grid`.
        background : Background, optional
            Wall and floor; nothing stands behind the landmark without it.
        finest_m : float
            Cells along which the background's range changes by more than this are cut finely enough to resolve it.
        farthest_m : float
            Beyond this the background's range need not be resolved.

        Returns
        -------
        SceneSamples
        """
        behind = parameters_of_views(background, len(views))
        return self.samples_of_poses(poses_of_views(views, behind, grid.level), grid, finest_m, farthest_m)

    def samples_of_poses(self, poses: Poses, grid: Camera, finest_m: float, farthest_m: float) -> SceneSamples:
        """Sample what a grid of cells sees from poses; see :meth:`samples_of_views`."""
        scale = finest_m, farthest_m
        found = [self._of_pose(of_poses(poses, slice(k, k + 1)), grid, scale) for k in range(len(poses.lens))]
        counts = [len(columns[0]) for columns in found]
        start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        columns = [np.concatenate(column) for column in zip(*found, strict=True)]
        return SceneSamples(start, *columns)

    def _of_pose(self, pose: Poses, grid: Camera, scale: tuple[float, float]) -> tuple[NDArray[np.float64], ...]:
        if self._rays:
            cells = np.arange((grid.stop_row - grid.first_row) * grid.cols)
            samples = cast_rays(cells, self._rays, pose, grid, self._intersector)
            return self._columns(len(samples.pixel), samples, None, pose, grid, scale)
        layout = Layout((grid.stop_row - grid.first_row, grid.cols), _SAMPLES, keeps_pieces=self._resolves)
        with lend_buffers(self.topology, layout) as buffers:
            state = np.zeros((1, *layout.shape), np.uint8)
            # what the rule for split cells takes as the turn of a phase, for each `finest_m` of range
            radians_per_scale = 1.5
            fastest = radians_per_scale / scale[0] if pose.background[0, :2].any() else 0.0
            n = self._planned(NO_LEAST, pose, grid, fastest, state, buffers)
            if len(self.topology.gloss):
                least = np.ones((*layout.shape, 2), np.int64)
                count_highlight_boxes(n, buffers.samples, self.topology, pose, grid, least)
                if (least > 1).any():
                    n = self._planned(least, pose, grid, fastest, state, buffers)
            return self._columns(n, buffers.samples, state[0], pose, grid, scale)

    def _columns(
        self, n: int, samples: Samples, state: NDArray[np.uint8] | None, pose: Poses, grid: Camera,
        scale: tuple[float, float],
    ) -> tuple[NDArray[np.float64], ...]:  # fmt: skip
        """Return the points that n samples see, and the background's in cells of `state` that have no samples."""
        mesh, background = self.topology, pose.background[0]
        counts, corners = np.zeros(samples.pieces.placed[0], np.int64), np.empty((4, 3))
        more = _count_points(samples, mesh, pose, grid, scale, corners, counts)
        fills = state is not None and bool(background[:2].any())
        room = n + more + (_count_free(state, pose, grid, background, scale) if fills else 0)
        numbers = (np.empty(room) for _ in range(3))
        columns: tuple[NDArray[Any], ...] = np.empty((room, 2)), *numbers, np.empty(room, np.int32)
        kept = _hits(n, samples, counts, mesh, pose, grid, background, self._n_parts, scale, corners, columns)
        if fills:
            kept = _fill_free(kept, state, pose, grid, background, scale, self._n_parts, columns)
        return tuple(column[:kept] for column in columns)

    def _planned(
        self, least: NDArray[np.int64], pose: Poses, grid: Camera, fastest: float, state: NDArray[np.uint8],
        buffers: Buffers,
    ) -> int:  # fmt: skip
        """Place the samples of a pose, find what they see, and return how many there are."""
        mesh = self.topology
        while True:
            reached, n = plan_rays(
                0, mesh, pose, grid, 1, fastest, least, buffers.edges, buffers.scratch, buffers.samples, state,
                buffers.borders,
            )  # fmt: skip
            if reached == 1:
                break
            buffers.make_room(reached)
        find_faces(n, buffers.samples, state, mesh, self._intersector, pose, grid)
        return int(n)


def plane_samples(distance_m: ArrayLike, grid: Camera, tilt: tuple[float, float] = (0.0, 0.0)) -> SceneSamples:
    """Sample a Lambertian plane that fills the field of view.

    Parameters
    ----------
    distance_m : (n,) array_like
        Where the plane meets the optical axis.
    grid : Camera
        Cells that are sampled, from :func:`~phasemark.render.direct.footprint_grid`.
    tilt : (float, float)
        The plane is x + tilt[0] · y + tilt[1] · z = distance, frame of the tilted camera.

    Returns
    -------
    SceneSamples
        All of part 0.
    """
    distances = np.atleast_1d(np.asarray(distance_m, dtype=np.float64))
    plane_points = 2  # gauss points a side of a cell: the integrand of a plane is smooth
    nodes, weights = gauss_legendre(plane_points)
    u = (np.arange(grid.cols)[:, None] + nodes).ravel()
    v = (np.arange(grid.rows)[:, None] + nodes).ravel()
    y, z = np.meshgrid((grid.centre_u - u) / grid.scale_u, (grid.centre_v - v) / grid.scale_v)
    area = np.outer(np.tile(weights, grid.rows), np.tile(weights, grid.cols)) / (grid.scale_u * grid.scale_v)
    points = np.column_stack([y.ravel(), z.ravel()])
    seen = 1 + points @ tilt > 0
    points, area = points[seen], area.ravel()[seen]
    length = np.sqrt(1 + (points**2).sum(axis=1))
    along = 1 + points @ tilt
    cosine = along / (length * math.sqrt(1 + tilt[0] ** 2 + tilt[1] ** 2))
    range_m = distances[:, None] * (length / along)
    n = len(distances)
    return SceneSamples(
        np.arange(n + 1, dtype=np.int64) * len(points),
        np.tile(points, (n, 1)),
        range_m.ravel(),
        (cosine * area / range_m**2).ravel(),
        np.tile(area, n),
        np.zeros(n * len(points), np.int32),
    )


@inner
def _keep(columns, k, y, z, t, reflected, weight, area, part):  # type: ignore[no-untyped-def]
    """Write a point of the ray (1, y, z) in line k of the columns of :class:`SceneSamples`; returns the next line."""
    length = math.sqrt(1.0 + y * y + z * z)
    tangents, range_m, amplitude, areas, parts = columns
    tangents[k, 0], tangents[k, 1] = y, z
    range_m[k] = t * length
    amplitude[k] = reflected / length / (t * length * t * length) * weight * area
    areas[k] = weight * area
    parts[k] = part
    return k + 1


@inner
def _corners(samples, p, mesh, poses, camera, farthest_m, corners):  # type: ignore[no-untyped-def]
    """Fill the corners of a piece of a plane, one after the other around it: y, z, and g, what their ranges go with.

    Along the ray d = (1, y, z) the plane n · x = h lies at the range h |d| / (n · d): g = n · d / h is linear in y and
    z, so that points of one g lie on a line. Returns how long rays are.
    """
    piece, plane, lens = (
        samples.pieces.bounds[p],
        mesh.planes[samples.face[samples.pieces.samples[p, 0]]],
        poses.lens[0],
    )
    height = plane[3] - plane[0] * lens[0] - plane[1] * lens[1] - plane[2] * lens[2]
    length = 0.0
    for i in range(4):
        s, x = piece[0 if i < 2 else 1], piece[(2, 3, 5, 4)[i]]
        y, z = ray_of(camera, x, s) if samples.pieces.sweep_v[p] else ray_of(camera, s, x)
        dx, dy, dz = towards_landmark(poses.matrix[0], y, z)
        own = math.sqrt(1.0 + y * y + z * z)
        facing = plane[0] * dx + plane[1] * dy + plane[2] * dz
        corners[i, 0], corners[i, 1] = y, z
        corners[i, 2] = max(facing / height, own / farthest_m) if height != 0.0 else own / farthest_m
        length = max(length, own)
    return length


@kernel
def _count_points(samples, mesh, poses, camera, scale, corners, counts):  # type: ignore[no-untyped-def]
    """Fill how many points resolve the ranges of each piece at most, 0 where its own do; return how many in all.

    Only pieces of planes are asked: round surfaces are at a slant beside their outline alone.
    """
    total = 0
    for p in range(samples.pieces.placed[0]):
        first, stop = samples.pieces.samples[p]
        face = samples.face[first]
        counts[p] = 0
        plane = face >= 0 and mesh.flat[face] and mesh.quadric[face] < 0
        for k in range(first + 1, stop):
            plane = plane and samples.face[k] == face
        if not plane:
            continue
        far, near, step = _range_steps(samples, p, mesh, poses, camera, scale, corners)
        if far - near > step:
            counts[p] = 8 * (math.ceil(0.25 * (far - near) / step) + 3)  # each of three strips may have one part more
            total += counts[p]
    return total


@inner
def _range_steps(samples, p, mesh, poses, camera, scale, corners):  # type: ignore[no-untyped-def]
    """Fill the corners of a piece; return 1/g of its farthest and nearest, and the step that two points resolve.

    Two points resolve `finest_m` of range, four points four times as much: what they leave of the histogram of a plane
    is less than 1e-4 of its peak where bins and pulse are twice as long. The error of two points goes with the fourth
    power of the range, so that of a small piece more may be left.
    """
    finest_m, farthest_m = scale
    first, stop = samples.pieces.samples[p]
    share = 0.0
    for k in range(first, stop):
        share += samples.weights[k]
    length = _corners(samples, p, mesh, poses, camera, farthest_m, corners)
    least, most = np.inf, 0.0
    for i in range(4):
        least, most = min(least, corners[i, 2]), max(most, corners[i, 2])
    return 1.0 / least, 1.0 / most, finest_m / length / max(share, 1e-9) ** 0.25


@inner
def _keep_piece(columns, kept, p, samples, mesh, poses, camera, area, scale, corners):  # type: ignore[no-untyped-def]
    """Write the points that resolve the ranges of a piece; returns the next line.

    Lines of one g cut it into strips at its corners, whose width is linear in g. Gauss lines in a part of a strip
    resolve its ranges, and two points on each line what else changes.
    """
    first, stop = samples.pieces.samples[p]
    face, whole = np.int64(samples.face[first]), 0.0
    body = np.int64(mesh.part[face])
    for k in range(first, stop):
        whole += samples.weights[k]
    far, near, step = _range_steps(samples, p, mesh, poses, camera, scale, corners)
    start, total = kept, 0.0
    while far > near:
        nearer = near
        for i in range(4):
            if nearer < 1.0 / corners[i, 2] < far:
                nearer = 1.0 / corners[i, 2]
        depth = far - nearer
        few = depth <= step
        parts = 1 if few else math.ceil(0.25 * depth / step)
        for part in range(parts):
            begin, end = 1.0 / (far - part / parts * depth), 1.0 / (far - (part + 1) / parts * depth)
            for node in range(2 if few else 4):
                y, z, y_far, z_far = _chord(corners, begin + (G2X[node] if few else G4X[node]) * (end - begin))
                weight = (G2W[node] if few else G4W[node]) * (end - begin) * math.hypot(y_far - y, z_far - z)
                total += weight
                for k in range(2):
                    own_y, own_z = y + G2X[k] * (y_far - y), z + G2X[k] * (z_far - z)
                    t, reflected = landmark_hit(mesh, face, poses.lens[0], poses.matrix[0], own_y, own_z)
                    if t > 0.0:
                        length = math.sqrt(1.0 + own_y * own_y + own_z * own_z)
                        reflected = reflected_by(mesh, face, 1.0, reflected, length)
                        kept = _keep(columns, kept, own_y, own_z, t, reflected, G2W[k] * weight, area, body)
        far = nearer
    _, _, amplitude, areas, _ = columns
    for k in range(start, kept):
        amplitude[k] *= whole / total
        areas[k] *= whole / total
    return kept


@inner
def _chord(corners, g):  # type: ignore[no-untyped-def]
    """Return both ends, y and z each, of the line across a piece along which g has one value."""
    y, z, y_far, z_far, found = 0.0, 0.0, 0.0, 0.0, False
    for i in range(4):
        j = (i + 1) % 4
        if (corners[i, 2] <= g) != (corners[j, 2] <= g):
            along = (g - corners[i, 2]) / (corners[j, 2] - corners[i, 2])
            y_far = corners[i, 0] + along * (corners[j, 0] - corners[i, 0])
            z_far = corners[i, 1] + along * (corners[j, 1] - corners[i, 1])
            if not found:
                y, z, found = y_far, z_far, True
    return y, z, y_far, z_far


@kernel
def _hits(n, samples, counts, mesh, poses, camera, background, n_parts, scale, corners, columns):  # type: ignore[no-untyped-def]
    """Fill path length and amplitude of the samples that meet something; returns how many there are."""
    kept, k, p = np.int64(0), np.int64(0), np.int64(0)
    area = 1.0 / (camera.scale_u * camera.scale_v)
    behind = background[0] > 0.0 or background[1] > 0.0
    cos_b, sin_b = math.cos(poses.bearing[0]), math.sin(poses.bearing[0])
    while k < n:
        if p < len(counts) and samples.pieces.samples[p, 0] == k:
            p += 1
            if counts[p - 1] > 0:
                kept = _keep_piece(columns, kept, p - 1, samples, mesh, poses, camera, area, scale, corners)
                k = samples.pieces.samples[p - 1, 1]
                continue
        face = samples.face[k]
        y, z = samples.rays[k, 0], samples.rays[k, 1]
        t, reflected, seen = 0.0, 0.0, np.int64(0)
        if face >= 0:
            t, reflected = landmark_hit(mesh, face, poses.lens[0], poses.matrix[0], y, z)
            reflected = reflected_by(mesh, face, 1.0, reflected, math.sqrt(1.0 + y * y + z * z))
            seen = np.int64(mesh.part[face])
        elif behind:
            dx, dy, dz = towards_level(poses.level[0], y, z)
            t, rho, facing = background_hit(background, cos_b, sin_b, dx, dy, dz)
            reflected = rho * facing
            seen = n_parts - 1 + nearer_plane(background, cos_b, sin_b, dx, dy, dz)  # planes are numbered from 1
        if t > 0.0:
            kept = _keep(columns, kept, y, z, t, reflected, samples.weights[k], area, seen)
        k += 1
    return kept


@inner
def _clipped_range(u, v, cos_b, sin_b, level, camera, background, farthest_m):  # type: ignore[no-untyped-def]
    """Return the range of what stands behind a point of the grid, `farthest_m` where nothing nearer does."""
    y, z = ray_of(camera, u, v)
    dx, dy, dz = towards_level(level, y, z)
    t, _, _ = background_hit(background, cos_b, sin_b, dx, dy, dz)
    return min(t * math.sqrt(1.0 + y * y + z * z), farthest_m) if t > 0.0 else farthest_m


@inner
def _boxes(c, r, cos_b, sin_b, level, camera, background, scale):  # type: ignore[no-untyped-def]
    """Return into how many boxes along u and v a cell is cut so that its points resolve the background's ranges."""
    finest_m, farthest_m = scale
    left = _clipped_range(c, r + 0.5, cos_b, sin_b, level, camera, background, farthest_m)
    right = _clipped_range(c + 1.0, r + 0.5, cos_b, sin_b, level, camera, background, farthest_m)
    top = _clipped_range(c + 0.5, r, cos_b, sin_b, level, camera, background, farthest_m)
    bottom = _clipped_range(c + 0.5, r + 1.0, cos_b, sin_b, level, camera, background, farthest_m)
    n_u = int(min(math.ceil(abs(right - left) / finest_m), _MOST_BOXES))
    n_v = int(min(math.ceil(abs(bottom - top) / finest_m), _MOST_BOXES))
    return max(n_u, 1), max(n_v, 1)


@kernel
def _count_free(state, poses, camera, background, scale):  # type: ignore[no-untyped-def]
    """Return how many points :func:`_fill_free` places at most."""
    cos_b, sin_b = math.cos(poses.bearing[0]), math.sin(poses.bearing[0])
    n = 0
    for r in range(state.shape[0]):
        for c in range(state.shape[1]):
            if state[r, c] == SKIPPED:
                n_u, n_v = _boxes(c, r, cos_b, sin_b, poses.level[0], camera, background, scale)
                n += 4 * n_u * n_v
    return n


@kernel
def _fill_free(kept, state, poses, camera, background, scale, n_parts, columns):  # type: ignore[no-untyped-def]
    """Append the background's points in cells that the landmark does not touch; returns how many points there are.

    Two Gauss points a side of a box.
    """
    cos_b, sin_b, level = math.cos(poses.bearing[0]), math.sin(poses.bearing[0]), poses.level[0]
    area = 1.0 / (camera.scale_u * camera.scale_v)
    for r in range(state.shape[0]):
        for c in range(state.shape[1]):
            if state[r, c] != SKIPPED:
                continue
            n_u, n_v = _boxes(c, r, cos_b, sin_b, level, camera, background, scale)
            for i in range(2 * n_v):
                v = r + (i // 2 + G2X[i % 2]) / n_v
                for j in range(2 * n_u):
                    y, z = ray_of(camera, c + (j // 2 + G2X[j % 2]) / n_u, v)
                    dx, dy, dz = towards_level(level, y, z)
                    t, rho, facing = background_hit(background, cos_b, sin_b, dx, dy, dz)
                    if t > 0.0:
                        weight = G2W[i % 2] * G2W[j % 2] / (n_u * n_v) * area
                        part = n_parts - 1 + nearer_plane(background, cos_b, sin_b, dx, dy, dz)
                        kept = _keep(columns, kept, y, z, t, rho * facing, weight, 1.0, part)
    return kept
