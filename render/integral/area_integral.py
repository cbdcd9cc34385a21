"""Area integral of a surface: what the pixels of a camera receive from it, many poses at once (PHYSICS section 3)."""

from __future__ import annotations

import hashlib
import math
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.integral.arguments import Camera, Light, Motion, Poses, Samples, Sums
from phasemark.render.integral.buffers import Buffers, Layout, lend_buffers, room_for_samples
from phasemark.render.integral.crossings import cut_where_it_crosses_itself
from phasemark.render.integral.gloss import count_highlight_boxes
from phasemark.render.integral.image_rays import trace
from phasemark.render.integral.intersect import Intersector
from phasemark.render.integral.lens_tables import distortion_of
from phasemark.render.integral.light import add_background, points_a_side, sum_samples
from phasemark.render.integral.mesh_topology import MeshTopology
from phasemark.render.integral.ray_plan import plan_rays
from phasemark.render.integral.shells import unite_shells
from phasemark.render.integral.slopes import SlopeSums
from phasemark.render.integral.surface_mesh import SurfaceMesh
from phasemark.render.integral.visible_faces import aim, pick_scouts, share_faces
from phasemark.render.phasor_images import PhasorImages
from phasemark.render.rigid import product
from phasemark.render.sensor.frequencies import phasor_frequencies_hz
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.threads import mapped
from phasemark.render.view import Views

Variant = Literal["exact", "hard"]
"""The area integral, or what the centre ray of each pixel sees."""

_RAYS_AT_ONCE = 1 << 20
"""A ray takes some hundred bytes."""
NO_LEAST = np.empty((0, 0, 2), np.int64)
"""No pixel asks for more boxes than all."""


@dataclass(frozen=True)
class Slopes:
    """Slopes of the phasors with the parameters of a view, filled beside the sums.

    Parameters
    ----------
    by_pixel : (m, pixels of all poses, p) complex128
        At each of the sensor's m frequencies, added to.
    motion : callable
        From a slice of the poses and the camera to their motion.
    turns : (p,) bool
        Parameters that turn what stands behind the surface.
    """

    by_pixel: NDArray[np.complex128]
    motion: Callable[[slice, Poses, Camera], Motion]
    turns: NDArray[np.bool_]


@dataclass
class Alone:
    """Light of the surface without what stands behind it, filled beside the sums.

    Parameters
    ----------
    slope_by_pixel : complex128
        As :class:`Slopes` has them.
    sums : Sums, optional
        Phasors; all else is that of the whole.
    """

    slope_by_pixel: NDArray[np.complex128]
    sums: Sums | None = None


_Layer = tuple[float, Sums, Slopes | None]
"""Albedo of the surface, and what its light is added to."""


class AreaIntegral:
    """Integrates what a camera sees of a surface over the active area of each pixel.

    Parameters
    ----------
    topology : MeshTopology
        The surface.
    intersector : Intersector
        Of the same vertices and faces.
    sensor : Sensor
        The camera.
    albedo : float
        Multiplied with that of each face.
    harmonics : tuple of int
        Harmonic orders k > 1 wanted beside the signal.
    splits : int
        Boxes a side that every pixel is cut into before anything else, at least: wide pixels are cut into more.
    rays : int
        Not 0: rays a side of each pixel in place of the exact integral, see :func:`cast_rays`.
    """

    def __init__(
        self,
        topology: MeshTopology,
        intersector: Intersector,
        sensor: Sensor,
        *,
        albedo: float = 1.0,
        harmonics: tuple[int, ...] = (),
        splits: int = 1,
        rays: int = 0,
    ) -> None:
        self.topology = topology
        self.intersector = intersector
        self.sensor = sensor
        self.albedo = albedo
        self.harmonics = harmonics
        self.splits = max(splits, _boxes_of_pixel(sensor))
        self.rays = rays

    @property
    def columns_hz(self) -> list[float]:
        """Frequencies of the phasors in the order of the sums: each modulation frequency and its harmonics."""
        return phasor_frequencies_hz(self.sensor.frequencies_hz, self.harmonics)

    def sums(
        self,
        poses: Poses,
        *,
        n_parts: int,
        rows: tuple[int, int] | None = None,
        workers: int = 1,
        variant: Variant = "exact",
        slopes: Slopes | None = None,
        alone: Alone | None = None,
    ) -> Sums:
        """Return the sums of all pixels.

        Parameters
        ----------
        poses : Poses
            n poses.
        n_parts : int
            Number of parts of the surface.
        rows : (first, stop), optional
            Image rows; None: all.
        workers : int
            Threads; the result does not depend on their number.
        variant : {"exact", "hard"}
        slopes : Slopes, optional
            Filled too.
        alone : Alone, optional
            Filled too, with slopes if these are asked for; of the exact variant.

        Returns
        -------
        Sums
            Pixels in the order (pose, row, column).
        """
        rows = (0, self.sensor.rows) if rows is None else rows
        n, columns_hz = len(poses.lens), self.columns_hz
        sums = no_light((n, rows[1] - rows[0], self.sensor.cols), len(columns_hz), n_parts)
        layers = [(self.albedo, sums, slopes)]
        if alone is not None:  # a surface that returns nothing leaves what stands behind it
            dark = no_light((n, rows[1] - rows[0], self.sensor.cols), len(columns_hz), n_parts)
            of_dark = None if slopes is None else replace(slopes, by_pixel=alone.slope_by_pixel)
            layers.append((0.0, dark._replace(state=sums.state), of_dark))
        camera = camera_of(self.sensor, rows, points_a_side(poses.background))
        light = Light(
            self.albedo,
            1 / self.sensor.metres_per_radian,
            np.array(columns_hz) / columns_hz[0],
            self.sensor.vignetting,
            _fastest(self.sensor),
            *_lamp_table(self.sensor),
        )
        poses_per_task = 1 if len(self.topology.gloss) else min(64, -(-n // workers)) or 1
        tasks = [slice(i, min(i + poses_per_task, n)) for i in range(0, n, poses_per_task)]
        lanes = [lane for i in range(workers) if (lane := tasks[i::workers])]

        def run(lane: Iterable[slice]) -> None:
            if variant == "exact" and not self.rays:
                self._integrate(lane, poses, camera, light, layers)
            else:
                self._cast(lane, poses, camera, light, sums)

        mapped(run, lanes, workers)
        if alone is not None:
            alone.sums = sums._replace(phasor=sums.phasor - dark.phasor)
            if slopes is not None:
                alone.slope_by_pixel[:] = slopes.by_pixel - alone.slope_by_pixel
        return sums

    def _integrate(
        self, tasks: Iterable[slice], every: Poses, camera: Camera, light: Light, layers: Sequence[_Layer]
    ) -> None:
        """Integrate slices of the poses into sums, and slopes if they are asked for, in one thread."""
        slopes = layers[0][2]
        layout = Layout((camera.rows, camera.cols), n_parameters=0 if slopes is None else len(slopes.turns))
        with lend_buffers(self.topology, layout) as buffers:
            self._integrate_with(buffers, tasks, every, camera, light, layers)

    def _integrate_with(
        self, buffers: Buffers, tasks: Iterable[slice], every: Poses, camera: Camera, light: Light,
        layers: Sequence[_Layer],
    ) -> None:  # fmt: skip
        mesh, columns_hz = self.topology, self.columns_hz
        columns = np.array([columns_hz.index(hz) for hz in self.sensor.frequencies_hz])
        for task in tasks:
            poses = of_poses(every, task)
            behind = poses.background[:, :2].any()
            parts = []
            for albedo, sums, slopes in layers:
                own, slope_sums = _of_views(sums, task), None
                if slopes is not None:
                    by_pixel = slopes.by_pixel[:, _pixels_of(task, sums)]
                    slope_sums = SlopeSums(by_pixel, columns, slopes.motion(task, poses, camera), own, slopes.turns)
                parts.append((light._replace(albedo=albedo), own, slope_sums))
            own = parts[0][1]
            view, least = 0, NO_LEAST
            while view < len(poses.lens):
                reached, n = plan_rays(
                    view, mesh, poses, camera, self.splits, light.fastest, least, buffers.edges,
                    buffers.scratch, buffers.samples, own.state, buffers.borders,
                )  # fmt: skip
                if reached <= view:
                    buffers.make_room(reached)
                    continue
                find_faces(n, buffers.samples, own.state, mesh, self.intersector, poses, camera)
                if len(mesh.gloss) and not len(least):  # one view, which is planned again where highlights are narrow
                    least = np.ones((*own.state.shape[1:], 2), np.int64)
                    count_highlight_boxes(n, buffers.samples, mesh, poses, camera, least)
                    if (least > 1).any():
                        continue
                for lit, part, slope_sums in parts:
                    sum_samples(n, buffers.samples, mesh, poses, camera, lit, part)
                    if behind:
                        add_background(view, reached, poses, camera, lit, part)
                    if slope_sums is not None:
                        slope_sums.add((view, reached), n, buffers.samples, buffers.borders, mesh, poses, camera, lit)
                view = reached
            for _, _, slope_sums in parts:
                if slope_sums is not None:
                    slope_sums.conclude()

    def _cast(self, tasks: Iterable[slice], every: Poses, camera: Camera, light: Light, sums: Sums) -> None:
        """Sum slices of the poses with evenly spread rays into `sums`, in one thread."""
        rays = self.rays or 1
        for task in tasks:
            poses, own = of_poses(every, task), _of_views(sums, task)
            pixels = np.arange(len(poses.lens) * (camera.stop_row - camera.first_row) * camera.cols)
            at_once = max(_RAYS_AT_ONCE // rays**2, 1)
            for start in range(0, len(pixels), at_once):
                samples = cast_rays(pixels[start : start + at_once], rays, poses, camera, self.intersector)
                sum_samples(len(samples.pixel), samples, self.topology, poses, camera, light, own)


def cast_rays(pixels: NDArray[np.int64], rays: int, poses: Poses, camera: Camera, intersector: Intersector) -> Samples:
    """Spread rays over the active areas of pixels and find what they meet.

    Parameters
    ----------
    pixels : (m,) int64
        Numbered in the order (pose, row, column).
    rays : int
        A side: the square of it is the number of rays of a pixel, which are a lattice of the golden section, in which
        no two lie in one row or column. A single ray is that of the centre.
    poses : Poses
    camera : Camera
    intersector : Intersector

    Returns
    -------
    Samples
    """
    count = rays * rays
    k, golden = np.arange(count), (math.sqrt(5) - 1) / 2
    u, v = camera.fill_u * ((k + 0.5) / count - 0.5), camera.fill_v * ((k * golden + 0.5) % 1 - 0.5)
    row, col = np.divmod(pixels % ((camera.stop_row - camera.first_row) * camera.cols), camera.cols)
    n = len(pixels) * count
    samples = room_for_samples(n)
    samples.points[:, 0] = (col[:, None] + (0.5 + u)).ravel()
    samples.points[:, 1] = (row[:, None] + (camera.first_row + 0.5 + v)).ravel()
    samples.weights[:] = 1.0 / count
    samples.pixel[:] = np.repeat(pixels, count)
    samples.chosen[:] = np.arange(n)
    samples.pieces.placed[0] = 0
    trace(0, n, samples, camera)
    aim(n, samples, poses, camera)
    samples.face[:] = intersector.first_face(samples.origins, samples.directions)
    return samples


def find_faces(
    n: int,
    samples: Samples,
    state: NDArray[np.uint8],
    mesh: MeshTopology,
    intersector: Intersector,
    poses: Poses,
    camera: Camera,
) -> None:
    """Find the face that each of n samples sees, −1 for none, into ``samples.face``."""

    def cast(count: int) -> NDArray[np.int32]:
        aim(count, samples, poses, camera)
        return intersector.first_face(samples.origins[:count], samples.directions[:count])

    scouts = cast(pick_scouts(n, samples))
    rest = share_faces(n, mesh, scouts, samples, poses, camera, state)
    samples.face[samples.chosen[:rest]] = cast(rest)


def _fastest(sensor: Sensor) -> float:
    """Return the radians per metre of the highest modulation frequency, 0 of a single slow one behind an ideal lens."""
    highest = max(sensor.frequencies_hz)
    slow_hz = 10e6  # frequency up to which the phase of a floor turns so little within a pixel that none is cut
    slow = len(sensor.frequencies_hz) == 1 and not sensor.bends_rays and highest <= slow_hz
    if slow and _boxes_of_pixel(sensor) == 1:
        return 0.0
    return max(1 / camera.metres_per_radian for camera in sensor.by_frequency)


def _boxes_of_pixel(sensor: Sensor) -> int:
    """Return into how many boxes a side pixels are cut for the sake of their width alone.

    The light of a plane that faces the camera falls like (1 + t²)^-5/2 with the tangent t off the axis: two Gauss
    points over a width h leave h⁴ / 50 of it.
    """
    widest = 0.26
    pixels, tangents = (sensor.cols, sensor.rows), sensor.tan_half_angles
    across = max(2 * t * fill / n for t, fill, n in zip(tangents, sensor.fill_factor, pixels, strict=True))
    return max(math.ceil(across / widest), 1)


def _lamp_table(sensor: Sensor) -> tuple[NDArray[np.float64], float]:
    """Return the lamp's intensity over the tangent off the axis as far as the image sees, and the step of that."""
    if not sensor.lamp_shapes_light:
        return np.empty(0), 1.0
    steps = 4096  # linear between them: some 1e-7 of the light
    tangent = np.linspace(0.0, math.tan(math.radians(sensor.farthest_corner_deg)), steps + 1)
    return sensor.lamp_intensity(1 / np.hypot(1.0, tangent)), float(tangent[1])


_TOPOLOGIES: OrderedDict[bytes, MeshTopology] = OrderedDict()


def mesh_digest(mesh: SurfaceMesh) -> bytes:
    """Return a digest of all that a renderer asks of a mesh."""
    attributes = [mesh.face_attributes.get(name, ()) for name in ("part", "albedo", "quadric")]
    digest = hashlib.blake2b()
    for array in (mesh.vertices, mesh.faces, *attributes, mesh.metadata.get("quadrics", ())):
        values = np.ascontiguousarray(array)
        digest.update(f"{values.dtype}{values.shape}".encode())
        digest.update(values.tobytes())
    return digest.digest()


def topology_of(mesh: SurfaceMesh) -> MeshTopology:
    """Analyse a mesh, or return the analysis of the same mesh from a few calls ago."""
    key = mesh_digest(mesh)
    found = _TOPOLOGIES.get(key)
    if found is None:
        faces, n = np.asarray(mesh.faces), len(mesh.vertices)
        wrong = faces[(faces < 0) | (faces >= n)]
        if wrong.size:
            raise UsageError(f"a face of the mesh names vertex {wrong[0]}, but there are {n}, counted from 0")
        found = cut_where_it_crosses_itself(MeshTopology.from_mesh(unite_shells(mesh)))
        _TOPOLOGIES[key] = found
        most_topologies = 16
        if len(_TOPOLOGIES) > most_topologies:
            _TOPOLOGIES.popitem(last=False)
    return found


def camera_of(sensor: Sensor, rows: tuple[int, int], rules: tuple[int, ...]) -> Camera:
    """Return a camera as the kernels take it, which rows to render, and how backgrounds are integrated over a pixel."""
    tan_h, tan_v = sensor.tan_half_angles
    scale = sensor.cols / (2 * tan_h), sensor.rows / (2 * tan_v)
    slope = 2 * tan_h / sensor.cols, 2 * tan_v / sensor.rows
    if sensor.lens is not None and sensor.bends_rays:
        scale, slope = (sensor.lens.fx, sensor.lens.fy), (1 / sensor.lens.fx, 1 / sensor.lens.fy)
    return Camera(
        scale_u=scale[0],
        scale_v=scale[1],
        centre_u=float(sensor.centre_px[0]),
        centre_v=float(sensor.centre_px[1]),
        slope_u=slope[0],
        slope_v=slope[1],
        rows=sensor.rows,
        cols=sensor.cols,
        first_row=rows[0],
        stop_row=rows[1],
        fill_u=float(sensor.fill_factor[0]),
        fill_v=float(sensor.fill_factor[1]),
        level=np.ascontiguousarray(sensor.cam2level),
        distortion=distortion_of(sensor, rules),
    )


def no_light(shape: tuple[int, int, int], n_orders: int, n_parts: int) -> Sums:
    """Return the sums that a batch of n views starts from; `shape` is (n, rows, cols)."""
    n = math.prod(shape)
    return Sums(
        phasor=np.zeros((n, n_orders), np.complex128),
        intensity=np.zeros(n),
        coverage=np.zeros(n),
        shares=np.zeros((n, n_parts)),
        state=np.zeros(shape, np.uint8),
    )


def of_poses(poses: Poses, which: slice) -> Poses:
    """Return some of the poses."""
    return Poses(*(np.ascontiguousarray(column[which]) for column in poses))


def _pixels_of(views: slice, sums: Sums) -> slice:
    """Return which pixels belong to some views."""
    per_view = math.prod(sums.state.shape[1:])
    return slice(views.start * per_view, views.stop * per_view)


def _of_views(sums: Sums, views: slice) -> Sums:
    """Return the part of the sums that belongs to some views."""
    pixels = _pixels_of(views, sums)
    return Sums(
        phasor=sums.phasor[pixels],
        intensity=sums.intensity[pixels],
        coverage=sums.coverage[pixels],
        shares=sums.shares[pixels],
        state=sums.state[views],
    )


def poses_of_views(views: Views, background: NDArray[np.float64], level: NDArray[np.float64]) -> Poses:
    """Return the poses of a landmark in n views.

    Parameters
    ----------
    views : Views
        As the camera itself has them, :meth:`~phasemark.render.Views.in_camera`.
    background : (n, 5) float64
        What stands behind the landmark, rows as :meth:`~phasemark.render.background.Background.parameters`.
    level : (3, 3) float64
        Camera frame to that of its mount.
    """
    rotation, translation = views.landmark2cam()
    return Poses(
        views.lens_in_landmark(),
        product(level.T, rotation),
        product(translation[:, None], level)[:, 0],
        views.bearing_rad,
        product(views.tilt2level(), level),
        np.ascontiguousarray(background),
    )


def camera_poses(
    surface2cam: NDArray[np.float64], level: NDArray[np.float64], background: NDArray[np.float64]
) -> Poses:
    """Return the poses of a surface from rigid transforms.

    Parameters
    ----------
    surface2cam : (n, 4, 4) float64
        From the surface's frame to that of the camera's mount (x along the axis, y left, z up).
    level : (3, 3) float64
        Camera frame to that of its mount.
    background : (n, 5) float64
        What stands behind, in the mount's frame.
    """
    rotation, translation = surface2cam[:, :3, :3], surface2cam[:, :3, 3]
    n = len(surface2cam)
    return Poses(
        -product(translation[:, None], rotation)[:, 0],
        product(level.T, rotation),
        product(translation[:, None], level)[:, 0],
        np.zeros(n),
        np.repeat(level[None], n, axis=0),
        background,
    )


def images_of_sums(sums: Sums, sensor: Sensor, harmonics: tuple[int, ...]) -> PhasorImages:
    """Return the sums of all pixels as images, (n, rows, cols)."""
    shape, first = sums.state.shape, 1 + len(harmonics)
    columns_hz = phasor_frequencies_hz(sensor.frequencies_hz, harmonics)
    columns = [np.ascontiguousarray(sums.phasor[:, k]).reshape(shape) for k in range(sums.phasor.shape[1])]
    return PhasorImages(
        phasor=columns[0],
        intensity=sums.intensity.reshape(shape),
        coverage=np.minimum(sums.coverage, 1.0).reshape(shape),
        sensor=sensor,
        harmonics=dict(zip(harmonics, columns[1:first], strict=True)),
        by_hz=dict(zip(columns_hz[first:], columns[first:], strict=True)),
    )
