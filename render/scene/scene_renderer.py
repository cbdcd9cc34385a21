"""Renders scenes from any camera pose, with the share of each pixel that each body fills."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.render.background import Background, Bounces, parameters_of_views
from phasemark.render.bounces.bounced_light import check_bounces, refined
from phasemark.render.bounces.patches import light_bounces
from phasemark.render.direct.bin_counts import detected_counts
from phasemark.render.direct.footprints import cells_of_width, footprint_grid, histogram_of, zones_tile
from phasemark.render.direct.histogram_images import HistogramImages
from phasemark.render.direct.sample_counts import signal_and_shares
from phasemark.render.integral.area_integral import AreaIntegral, camera_poses, images_of_sums, no_light, of_poses
from phasemark.render.integral.arguments import Poses, Sums
from phasemark.render.integral.mesh_topology import NO_GLOSS, MeshTopology
from phasemark.render.integral.ray_plan import UNTRUSTED
from phasemark.render.integral.scene_samples import SceneMesh
from phasemark.render.phasor_images import PhasorImages
from phasemark.render.rigid import composed, product, rigid_transforms
from phasemark.render.scene.assembly import Assembly
from phasemark.render.scene.scene import Scene
from phasemark.render.sensor.frequencies import phasor_frequencies_hz
from phasemark.render.sensor.sensor import Sensor, refuse_no_sensor
from phasemark.render.threads import check_workers, mapped

_TOUCH_M = 1e-9
_MOST_BYTES = 4 << 30
"""Of the shares of one call."""
_MOST_RAYS = 100


class SceneRenderer:
    """Renders a scene with one camera, from any pose.

    Parameters
    ----------
    scene : Scene
    sensor : Sensor
        The camera.
    harmonics : sequence of int, optional
        As for :class:`~phasemark.render.Renderer`.
    intersector : {"auto", "embree", "float64"}
        As for :class:`~phasemark.render.Renderer`.
    bounces : int or "all"
        How often light may bounce on its way from the first surface that it meets to the last (PHYSICS section 12).
    bounce_tolerance : float
        Patches are refined until the image changes by less than this share of its brightest pixel, root mean square.
    rays : int, optional
        Rays a side of each pixel or zone that sample direct light in place of the exact integral, for speed: with 10 a
        frame of 50 bodies is off by 1e-2 of its brightest pixel, root mean square, and by 7e-2 where an edge is worst
        (docs/scenes.md).

    Raises
    ------
    UsageError
        The sensor's lamp is not described, the sensor counts histograms, which have no bounces, `rays` is no whole
        number from 1 to 100, or the sensor has an offset of bearing or height, which a scene has in poses.

    Examples
    --------
    >>> import numpy as np
    >>> from phasemark.render import Body, Scene, SceneRenderer, preset
    >>> wall = np.eye(4)
    >>> wall[:3, 3] = 2.0, 0.0, 0.0
    >>> scene = Scene([Body.box((0.1, 4, 4), name="wall", pose=wall)])
    >>> images = SceneRenderer(scene, preset("pmd-16x16")).render(np.eye(4))
    >>> images.range_m[0, 8, 8].round(3), images.shares.shape, float(images.shares.min())
    (np.float64(1.95), (1, 16, 16, 1), 1.0)
    """

    def __init__(
        self,
        scene: Scene,
        sensor: Sensor,
        *,
        harmonics: Sequence[int] | None = None,
        intersector: str = "auto",
        bounces: Bounces = 0,
        bounce_tolerance: float = 3e-4,
        rays: int | None = None,
    ) -> None:
        if not isinstance(scene, Scene):
            raise UsageError(f"'scene' must be a Scene, got {type(scene).__name__}")
        refuse_no_sensor(sensor)
        for name in ("bearing_offset_deg", "height_offset_m"):
            if getattr(sensor, name):
                raise UsageError(
                    f"'{name}' of the sensor is that before a landmark, got {getattr(sensor, name):g}: a scene"
                    " has it in 'camera2world'"
                )
        self.scene = scene
        self.sensor = sensor
        self._harmonics = tuple(sensor.harmonic_orders if harmonics is None else harmonics)
        self._intersector = intersector
        check_bounces(bounces, bounce_tolerance, sensor)
        if rays is not None and (not isinstance(rays, int) or not 1 <= rays <= _MOST_RAYS):
            raise UsageError(f"'rays' must be a whole number from 1 to {_MOST_RAYS} a side of a pixel, got {rays!r}")
        self._rays = rays or 0
        pieces = [body.pieces() for body in scene]
        placed = [
            replace(piece, pose=composed(body.pose, piece.pose))
            for body, own in zip(scene, pieces, strict=True)
            for piece in own
        ]
        self._owner = np.repeat(np.arange(len(scene)), [len(own) for own in pieces])
        self._in_body = np.array([piece.pose for own in pieces for piece in own])
        self._assembly = Assembly(placed, intersector, crosses=not self._rays)
        self.bounces = bounces
        self.bounce_tolerance = bounce_tolerance
        self.untrusted_pixels = 0
        """How many pixels, of all rendered so far, had too many edges to be split exactly."""

    def __repr__(self) -> str:
        """Describe in one line the scene and the camera."""
        return f"SceneRenderer({self.scene!r}, {self.sensor!r})"

    def render(
        self,
        camera2world: ArrayLike,
        bodies2world: ArrayLike | dict[str, ArrayLike] | None = None,
        background: Background | None = None,
        *,
        workers: int = 1,
    ) -> PhasorImages | HistogramImages:
        """Render frames.

        Parameters
        ----------
        camera2world : (4, 4) or (n, 4, 4) array_like
            Poses of the camera's mount: x forward, y left, z up (PHYSICS section 9). The sensor's own pitch and roll
            come before them.
        bodies2world : (b, 4, 4) or (n, b, 4, 4) array_like, or a mapping from names to (4, 4) or (n, 4, 4), optional
            Where the bodies stand; None: where the scene has them. Only what moves from frame to frame is rebuilt.
        background : Background, optional
            A wall and a floor behind all bodies, level, the wall perpendicular to the way the camera looks.
        workers : int
            Threads; the result does not depend on their number.

        Returns
        -------
        PhasorImages or HistogramImages
            n images with ``shares``, (n, rows, cols, b): the part of each pixel's active area that each body fills.
            Histograms with a direct sensor, one with a [histogram] table.

        Raises
        ------
        UsageError
            A pose is not rigid, the lens is inside a closed body, or a body reaches through the background.
        """
        if self.sensor.histogram is None:
            return self.phasors(camera2world, bodies2world, background, workers=workers)
        return self.histograms(camera2world, bodies2world, background, workers=workers)

    def phasors(
        self,
        camera2world: ArrayLike,
        bodies2world: ArrayLike | dict[str, ArrayLike] | None = None,
        background: Background | None = None,
        *,
        workers: int = 1,
    ) -> PhasorImages:
        """Render the phasors of frames with any camera; see :meth:`render`."""
        return self._images(self._sums(camera2world, bodies2world, background, workers)[0])

    def albedo_powers(
        self,
        name: str,
        camera2world: ArrayLike,
        bodies2world: ArrayLike | dict[str, ArrayLike] | None = None,
        *,
        workers: int = 1,
    ) -> list[PhasorImages]:
        """Render frames as polynomials in the albedo of one body, S = S₀ + ρ S₁ + ρ² S₂ and so on.

        Parameters
        ----------
        name : str
            The body; its own albedo does not matter.
        camera2world, bodies2world, workers
            As for :meth:`render`.

        Returns
        -------
        list of PhasorImages
            Images of S₀, S₁, …, whose coverage and shares are the frame's. Without bounces there are two.

        Raises
        ------
        UsageError
            No body has that name, or as for :meth:`render`.
        """
        free = np.arange(len(self.scene)) == self.scene.index(name)
        return [self._images(sums) for sums in self._sums(camera2world, bodies2world, None, workers, free)]

    def _images(self, sums: Sums) -> PhasorImages:
        images = images_of_sums(sums, self.sensor, self._harmonics)
        return replace(images, shares=self._of_bodies(sums.shares, sums.state.shape), bodies=self.scene.names)

    def _of_bodies(self, shares: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Return the shares of pixels of bodies, (*shape, b), from those of their pieces."""
        first = np.searchsorted(self._owner, np.arange(len(self.scene)))
        return np.minimum(np.add.reduceat(shares.reshape(*shape, len(self._owner)), first, axis=-1), 1.0)

    def _sums(
        self,
        camera2world: ArrayLike,
        bodies2world: ArrayLike | dict[str, ArrayLike] | None,
        background: Background | None,
        workers: int,
        free: NDArray[np.bool_] | None = None,
    ) -> list[Sums]:
        """Return the sums of all pixels, or those of each power of the albedo of bodies that are free, (b,)."""
        cameras = rigid_transforms(camera2world, "camera2world")
        n, b = self._counts(cameras)
        if self.bounces and background is not None:
            raise UsageError(
                "light does not bounce off a 'background': put its wall and floor into the scene as bodies"
            )
        shape = n, self.sensor.rows, self.sensor.cols
        columns_hz = phasor_frequencies_hz(self.sensor.frequencies_hz, self._harmonics)
        powers = [no_light(shape, len(columns_hz), b) for _ in range(1 if free is None else 2)]
        bounced: list[tuple[NDArray[np.int64], NDArray[np.complex128]]] = []
        placings = self.scene.posed(bodies2world, n)
        free_pieces = None if free is None else free[self._owner]

        def integrate(assembly: Assembly, which: NDArray[np.int64], poses: Poses, threads: int) -> None:
            pixels = (which[:, None] * shape[1] * shape[2] + np.arange(shape[1] * shape[2])).ravel()
            for sums, topology in zip(powers, _by_power(assembly.topology, free_pieces), strict=True):
                integral = AreaIntegral(
                    topology, assembly.intersector, self.sensor, harmonics=self._harmonics, rays=self._rays
                )
                found = integral.sums(poses, n_parts=b, workers=threads)
                for own, new in zip(sums[:4], found[:4], strict=True):
                    own[pixels] = new
                sums.state[which] = found.state
            if self.bounces:
                mesh, owner = assembly.in_facets(self.scene.bodies, placings[which[0]])
                of_shells = None if free is None else free[owner]
                bounced.append((pixels, self._bounced(mesh, poses, [0.0, *columns_hz], of_shells)))

        self._for_each_placing(integrate, cameras, placings, background, workers)
        self.untrusted_pixels += int((powers[0].state == UNTRUSTED).sum())
        for pixels, light in bounced:
            for k in range(light.shape[2]):
                if k == len(powers):
                    dark = powers[0].phasor * 0, powers[0].intensity * 0
                    powers.append(powers[0]._replace(phasor=dark[0], intensity=dark[1]))
                powers[k].intensity[pixels] += light[:, 0, k].real
                powers[k].phasor[pixels] += light[:, 1:, k]
        return powers

    def _bounced(
        self, mesh: Assembly, poses: Poses, frequencies_hz: Sequence[float], free: NDArray[np.bool_] | None
    ) -> NDArray[np.complex128]:
        """Return the light that has bounced, (pixels of all poses, frequencies, powers)."""
        if not light_bounces(mesh.topology):
            return np.zeros(
                (len(poses.lens) * self.sensor.rows * self.sensor.cols, len(frequencies_hz), 1), np.complex128
            )
        light = refined(mesh.topology, mesh.intersector, self.sensor, poses, self.bounce_tolerance, self._intersector)
        found = light.phasors(frequencies_hz, self.bounces, self.bounce_tolerance, free)
        return found.reshape(-1, *found.shape[2:])

    def histograms(
        self,
        camera2world: ArrayLike,
        bodies2world: ArrayLike | dict[str, ArrayLike] | None = None,
        background: Background | None = None,
        *,
        workers: int = 1,
    ) -> HistogramImages:
        """Render the histograms of frames with a direct sensor; see :meth:`render`."""
        cameras = rigid_transforms(camera2world, "camera2world")
        n, b = self._counts(cameras)
        sensor, histogram = self.sensor, histogram_of(self.sensor)
        # cells a side of a zone: pieces of faces in them resolve ranges, so that 3e-4 of a peak needs no more
        few = max(2, cells_of_width(sensor))
        grid = footprint_grid(sensor, cells=1 if self._rays else few if zones_tile(sensor) else None)
        finest_m, farthest_m = 0.5 * histogram.bin_width_m, histogram.start_m + 1.1 * histogram.length_m
        zones = sensor.rows * sensor.cols
        signal = np.zeros((n, zones, histogram.bins))
        shares = np.zeros((n, zones, b))

        def count(assembly: Assembly, which: NDArray[np.int64], poses: Poses, threads: int) -> None:
            surface = SceneMesh.of_surface(assembly.topology, assembly.intersector, b, self._rays)

            def run(k: int) -> None:
                samples = surface.samples_of_poses(of_poses(poses, slice(k, k + 1)), grid, finest_m, farthest_m)
                (signal[which[k]],), (shares[which[k]],) = signal_and_shares(samples, sensor, b)

            mapped(run, range(len(which)), threads)

        self._for_each_placing(count, cameras, self.scene.posed(bodies2world, n), background, workers)
        shape = n, sensor.rows, sensor.cols
        return HistogramImages(
            detected_counts(signal, sensor).reshape(*shape, histogram.bins),
            signal.sum(axis=-1).reshape(shape),
            sensor,
            shares=self._of_bodies(shares, shape),
            bodies=self.scene.names,
        )

    def _counts(self, cameras: NDArray[np.float64]) -> tuple[int, int]:
        """Return how many frames and pieces of bodies there are; refuse more than fit into memory."""
        n, b = len(cameras), len(self._owner)
        pixels = self.sensor.rows * self.sensor.cols
        if 8 * n * b * pixels > _MOST_BYTES:
            raise UsageError(
                f"the shares of {b} bodies in {n} frames take {8 * n * b * pixels / 2**30:.0f} GiB: render at most"
                f" {max(_MOST_BYTES // (8 * b * pixels), 1)} frames at a time"
            )
        return n, b

    def _for_each_placing(
        self,
        use: Callable[[Assembly, NDArray[np.int64], Poses, int], None],
        cameras: NDArray[np.float64],
        placings: NDArray[np.float64],
        background: Background | None,
        workers: int,
    ) -> None:
        """Call `use` once for all frames in which the bodies stand alike, from several threads where they do not."""
        check_workers(workers)
        n = len(cameras)
        alike: dict[bytes, list[int]] = {}
        for k in range(n):
            alike.setdefault(placings[k].tobytes(), []).append(k)
        frames = [np.array(which) for which in alike.values()]
        if len(frames) > 1:
            self._assembly.let_move((placings != placings[0]).any(axis=(0, 2, 3))[self._owner])
        lanes = [lane for i in range(min(workers, len(frames))) if (lane := frames[i::workers])]
        threads = max(workers // max(len(lanes), 1), 1)

        def run(lane: list[NDArray[np.int64]]) -> None:
            assembly = self._assembly if len(lanes) == 1 else self._assembly.copy()
            for which in lane:
                assembly.place(composed(placings[which[0], self._owner], self._in_body))
                assembly.check_outside(cameras[which, :3, 3], which)
                use(assembly, which, self._poses(assembly, cameras[which], background), threads)

        mapped(run, lanes, len(lanes))

    def _poses(self, assembly: Assembly, cameras: NDArray[np.float64], background: Background | None) -> Poses:
        """Return the poses of the world before cameras."""
        rotation, lens = cameras[:, :3, :3], cameras[:, :3, 3]
        world2camera = np.zeros_like(cameras)
        world2camera[:, :3, :3] = rotation.transpose(0, 2, 1)
        world2camera[:, :3, 3] = -product(lens[:, None], rotation)[:, 0]
        behind = parameters_of_views(background, len(cameras))
        yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        level2world = np.zeros_like(rotation)
        level2world[:, 0, 0] = level2world[:, 1, 1] = np.cos(yaw)
        level2world[:, 1, 0], level2world[:, 2, 2] = np.sin(yaw), 1.0
        level2world[:, 0, 1] = -level2world[:, 1, 0]
        if background is not None:
            self._check_before(assembly, background, level2world, lens)
        poses = camera_poses(world2camera, self.sensor.cam2level, behind)
        level = product(product(level2world.transpose(0, 2, 1), rotation), self.sensor.cam2level)
        return poses._replace(lens=np.ascontiguousarray(lens), level=level)

    def _check_before(
        self, assembly: Assembly, background: Background, level2world: NDArray[np.float64], lens: NDArray[np.float64]
    ) -> None:
        """Refuse bodies that reach through the background."""
        wall, floor = background.wall_m, background.floor_m
        vertices = assembly.corners()
        for turn, origin in zip(level2world, lens, strict=True):
            ahead = product(vertices - origin, turn)
            if wall is not None and ahead[:, 0].max() > wall + _TOUCH_M:
                raise UsageError(f"a body reaches {ahead[:, 0].max():.4g} m ahead, through the wall at {wall:g} m")
            if floor is not None and ahead[:, 2].min() < -floor - _TOUCH_M:
                raise UsageError(f"a body reaches {-ahead[:, 2].min():.4g} m down, through the floor at {floor:g} m")


def _by_power(topology: MeshTopology, free: NDArray[np.bool_] | None) -> list[MeshTopology]:
    """Return the surface whose light is the frame's; of free bodies, that without theirs, and that of theirs alone."""
    if free is None:
        return [topology]
    own = free[topology.part]
    without = topology._replace(albedo=np.where(own, 0.0, topology.albedo))
    return [without, topology._replace(albedo=own.astype(float), gloss=NO_GLOSS)]
