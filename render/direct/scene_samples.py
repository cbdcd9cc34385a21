"""Scene samples of a direct sensor: direction, range and amplitude, from the exact integral.

The integral of section 3 cuts every cell of a grid along the edges of the mesh and places a few points in each smooth
piece. Here these points keep their path lengths instead of being added to phasors.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from phasemark.render.integral.arguments import Camera, Motion, Poses
from phasemark.render.integral.intersect import make_intersector
from phasemark.render.integral.light import landmark_hit
from phasemark.render.integral.mesh_topology import MeshTopology
from phasemark.render.integral.quadrature_rules import gauss_legendre
from phasemark.render.integral.ray_plan import plan_rays
from phasemark.render.integral.shells import unite_shells
from phasemark.render.integral.visible_faces import aim, pick_scouts, share_faces
from phasemark.render.kernel import kernel
from phasemark.render.renderer import _Buffers
from phasemark.render.rigid import rigid_transforms

_NO_BACKGROUND = np.zeros(4)
_SAMPLES = 1 << 15
_PLANE_POINTS = 2  # Gauss points a side of a cell: the integrand of a plane is smooth


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
        cos θ / r² for albedo 1, times the area of tangents that the point stands for.
    part : (m,) int8
        0 for the lower part of the mesh, 1 for the upper one.
    """

    start: NDArray[np.int64]
    tangents: NDArray[np.float64]
    range_m: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    part: NDArray[np.int8]

    @property
    def n_views(self) -> int:
        """Number of poses."""
        return len(self.start) - 1


class SceneMesh:
    """A mesh that samples are taken of, from any pose in space.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Metres. A face attribute "part" names faces 0 or 1 for two albedos; without it the sign of z does.
    intersector : {"auto", "embree", "float64"}
        As for :class:`~phasemark.render.Renderer`.
    """

    def __init__(self, mesh: trimesh.Trimesh, *, intersector: str = "auto") -> None:
        self.topology = MeshTopology.from_mesh(unite_shells(mesh))
        self._intersector = make_intersector(self.topology.vertices, self.topology.faces, intersector)
        self._room: tuple[tuple[int, int], _Buffers] | None = None

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
        rotation, translation = transforms[:, :3, :3], transforms[:, :3, 3]
        poses = Poses(
            np.ascontiguousarray(-np.einsum("nji,nj->ni", rotation, translation)),
            np.ascontiguousarray(grid.level.T @ rotation),
            np.ascontiguousarray(translation @ grid.level),
            np.zeros(len(transforms)),
            np.repeat(grid.level[None], len(transforms), axis=0),
        )
        found = [self._of_pose(poses._replace(**_only(poses, k)), grid) for k in range(len(transforms))]
        counts = [len(one[1]) for one in found]
        start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        columns = [np.concatenate([one[k] for one in found]) for k in range(4)]
        return SceneSamples(start, *columns)

    def _of_pose(self, pose: Poses, grid: Camera) -> tuple[NDArray[np.float64], ...]:
        mesh = self.topology
        rows, cols = grid.stop_row - grid.first_row, grid.cols
        state = np.zeros((1, rows, cols), np.uint8)
        buffers = self._buffers(rows, cols)
        still = Motion(pose, np.empty(0), np.empty((1, 4)))  # no slopes are asked for
        while True:
            reached, n = plan_rays(
                0, mesh, pose, grid, 1, _NO_BACKGROUND, 0.0, buffers.edges, buffers.scratch, buffers.samples, state,
                still, buffers.borders,
            )  # fmt: skip
            if reached == 1:
                break
            buffers.make_room(reached)
        samples = buffers.samples

        def cast(count: int) -> NDArray[np.int32]:
            aim(count, samples, pose, grid)
            return np.asarray(self._intersector.first_face(samples.origins[:count], samples.directions[:count]))

        scouts = cast(pick_scouts(n, samples))
        rest = share_faces(n, mesh, mesh.closed, scouts, samples, pose, grid, state)
        samples.face[samples.chosen[:rest]] = cast(rest)
        tangents, range_m, amplitude, part = np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n, np.int8)
        kept = _hits(n, samples, mesh, pose, grid, tangents, range_m, amplitude, part)
        return tangents[:kept], range_m[:kept], amplitude[:kept], part[:kept]

    def _buffers(self, rows: int, cols: int) -> _Buffers:
        """Return the scratch for a grid, made once for each size."""
        if self._room is None or self._room[0] != (rows, cols):
            n_edges = len(self.topology.creases) + len(self.topology.folds)
            self._room = (rows, cols), _Buffers(n_edges, (rows, cols), n_samples=_SAMPLES)
        return self._room[1]


def plane_samples(distance_m: ArrayLike, grid: Camera, tilt: tuple[float, float] = (0.0, 0.0)) -> SceneSamples:
    """Sample a Lambertian plane that fills the field of view.

    Parameters
    ----------
    distance_m : (n,) array_like
        Where the plane meets the optical axis.
    grid : Camera
    tilt : (float, float)
        The plane is x + tilt[0] · y + tilt[1] · z = distance, frame of the tilted camera.

    Returns
    -------
    SceneSamples
        All of part 0.
    """
    distances = np.atleast_1d(np.asarray(distance_m, dtype=np.float64))
    nodes, weights = gauss_legendre(_PLANE_POINTS)
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
        np.zeros(n * len(points), np.int8),
    )


def _only(poses: Poses, k: int) -> dict[str, NDArray[np.float64]]:
    return {name: np.ascontiguousarray(getattr(poses, name)[k : k + 1]) for name in poses._fields}


@kernel
def _hits(n, samples, mesh, poses, camera, tangents, range_m, amplitude, part):  # type: ignore[no-untyped-def]
    """Fill path length and amplitude of the samples that meet the mesh; returns how many there are."""
    kept = 0
    area = 1.0 / (camera.scale_u * camera.scale_v)
    for k in range(n):
        face = samples.face[k]
        if face < 0:
            continue
        y, z = samples.rays[k, 0], samples.rays[k, 1]
        length = math.sqrt(1.0 + y * y + z * z)
        t, cos_theta = landmark_hit(mesh, face, poses.lens[0], poses.matrix[0], y, z)
        if not t > 0.0:
            continue
        tangents[kept, 0], tangents[kept, 1] = y, z
        range_m[kept] = t * length
        amplitude[kept] = cos_theta / length / (t * length * t * length) * samples.weights[k] * area
        part[kept] = mesh.part[face]
        kept += 1
    return kept
