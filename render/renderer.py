"""From a mesh and a sensor to noise-free images, many views at once."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.render.background import BOUNCES, Background, Backgrounds, check_behind, parameters_of_views
from phasemark.render.bounces.lamp import check_can_bounce
from phasemark.render.derivative import VIEW_PARAMETERS, check_parameters, differentiate
from phasemark.render.integral.area_integral import (
    Alone,
    AreaIntegral,
    Slopes,
    Variant,
    images_of_sums,
    poses_of_views,
    topology_of,
)
from phasemark.render.integral.arguments import Camera, Motion, Poses, Sums
from phasemark.render.integral.intersect import make_intersector
from phasemark.render.integral.mesh_topology import MeshTopology
from phasemark.render.integral.ray_plan import UNTRUSTED
from phasemark.render.integral.slopes import STEP
from phasemark.render.integral.surface_mesh import SurfaceMesh
from phasemark.render.phasor_images import PhasorImages
from phasemark.render.sensor.frequencies import phasor_frequencies_hz
from phasemark.render.sensor.sensor import Sensor, refuse_no_sensor
from phasemark.render.threads import check_workers
from phasemark.render.view import VIEW_FIELDS, Footprint, Views

if TYPE_CHECKING:
    from phasemark.render.bounces.standing import StandingLight

SplitImages = tuple[PhasorImages, NDArray[np.complex128], PhasorImages, NDArray[np.complex128]]
"""Images with their slopes, and the same of the landmark alone."""
_TURNING = ("bearing_rad", "pitch_rad", "roll_rad")
"""Parameters that turn what stands behind the landmark."""
_LARGE = 1 << 13
"""Faces above which a mesh is more than the processor's cache holds."""
_PARTS = 2
"""Parts of a landmark: lower and upper."""


class Renderer:
    """Renders one landmark with one camera, from any view.

    Parameters
    ----------
    mesh : trimesh.Trimesh or None
        The landmark, metres, landmark frame (PHYSICS section 1). Open or inverted meshes, and those that pass through
        themselves, are rendered two-sided, closed shells that run through one another as their union. None: no
        landmark, only what stands behind it.
    sensor : Sensor
        The camera.
    albedo : float
        Of the Lambertian landmark, in (0, 1].
    harmonics : sequence of int, optional
        Harmonic orders k > 1 wanted beside the signal, of every modulation frequency; None: those that the sensor's
        taps need.
    intersector : {"auto", "embree", "float64"}
        What finds the face a ray meets; "auto" is Embree where the package embreex is installed.
    splits : int
        Every pixel is first cut into splits × splits boxes, at most 4 × 4. 1 is enough where surfaces are smooth over
        a pixel, as those of landmarks are; bumps finer than a pixel take 3.

    Raises
    ------
    UsageError
        The mesh cannot be rendered, or a parameter is out of range.

    Examples
    --------
    >>> import trimesh
    >>> from phasemark.render import Renderer, preset
    >>> plate = trimesh.creation.box((0.002, 2.0, 2.0))  # its front is 1 m from the lens at D = 1.001
    >>> image = Renderer(plate, preset("pmd-16x16"), albedo=1.0).render(distance_m=1.001)
    >>> image.phasor.shape, float(image.coverage.min())
    ((1, 16, 16), 1.0)
    """

    def __repr__(self) -> str:
        """Describe in one line the landmark and the camera."""
        faces = self.topology.faces
        size = " × ".join(f"{100 * side:.3g}" for side in np.ptp(self.topology.vertices, axis=0)) if len(faces) else ""
        landmark = f"{size} cm, {len(faces)} faces, albedo {self.albedo:g}" if size else "no landmark"
        return f"Renderer({landmark}, {self.sensor!r})"

    def __init__(
        self,
        mesh: SurfaceMesh | None,
        sensor: Sensor,
        *,
        albedo: float = 0.8,
        harmonics: Sequence[int] | None = None,
        intersector: str = "auto",
        splits: int = 1,
    ) -> None:
        if not (mesh is None or hasattr(mesh, "vertices")):
            raise UsageError(
                f"'mesh' must be a mesh, got {type(mesh).__name__}: build_mesh makes one of a LandmarkSpec"
            )
        refuse_no_sensor(sensor)
        _check_albedo(albedo)
        max_splits = 4
        if splits != int(splits) or not 1 <= splits <= max_splits:
            raise UsageError(f"'splits' must be a whole number from 1 to {max_splits}, got {splits!r}")
        harmonics = sensor.harmonic_orders if harmonics is None else harmonics
        if any(order < 2 or order != int(order) for order in harmonics):
            raise UsageError(f"'harmonics' must be whole orders of 2 or more, got {tuple(harmonics)!r}")
        self.sensor = sensor
        self.albedo = float(albedo)
        self.topology = MeshTopology.empty() if mesh is None else topology_of(mesh)
        self.footprint = Footprint.of_vertices(self.topology.vertices)
        self._standing: StandingLight | None = None
        self._integral = AreaIntegral(
            self.topology,
            make_intersector(self.topology.vertices, self.topology.faces, intersector),
            sensor,
            albedo=self.albedo,
            harmonics=tuple(int(order) for order in harmonics),
            splits=int(splits),
        )
        self.untrusted_pixels = 0
        """How many pixels, of all rendered so far, had too many edges to be split exactly."""

    def seen_by(self, sensor: Sensor) -> Renderer:
        """Return a renderer of the same landmark for another camera, which shares all that belongs to the mesh.

        Parameters
        ----------
        sensor : Sensor
            The camera.
        """
        other = copy.copy(self)
        other.sensor, other.untrusted_pixels = sensor, 0
        other._integral = copy.copy(self._integral)
        other._integral.sensor = sensor
        return other

    def with_albedo(self, albedo: float) -> Renderer:
        """Return a renderer of the same landmark with another albedo, which shares all that belongs to the mesh.

        Parameters
        ----------
        albedo : float
            In (0, 1].

        Raises
        ------
        UsageError
            It is not.
        """
        _check_albedo(albedo)
        other = self.seen_by(self.sensor)
        other.albedo = other._integral.albedo = float(albedo)
        return other

    def render(
        self,
        distance_m: ArrayLike,
        delta_rad: ArrayLike = 0.0,
        bearing_rad: ArrayLike = 0.0,
        height_m: ArrayLike = 0.0,
        pitch_rad: ArrayLike = 0.0,
        roll_rad: ArrayLike = 0.0,
        *,
        background: Backgrounds = None,
        rows: tuple[int, int] | None = None,
        variant: Variant = "exact",
        workers: int = 1,
    ) -> PhasorImages:
        """Render views; the arguments broadcast against each other and are flattened in C order.

        Parameters
        ----------
        distance_m, delta_rad, bearing_rad, height_m, pitch_rad, roll_rad : array_like
            The views, PHYSICS sections 1 and 9.
        background : Background or sequence of Background, optional
            What stands behind the landmark, in all views or in each one; None: nothing.
        rows : (first, stop), optional
            Render only these image rows.
        variant : {"exact", "hard"}
            "hard" is for comparison: each pixel gets what its centre ray alone sees, its coverage is 0 or 1, and
            nothing is mixed.
        workers : int
            Threads; the result does not depend on their number.

        Returns
        -------
        PhasorImages
            n views; with `rows`, only those rows.

        Raises
        ------
        UsageError
            A view that is not finite, a lens inside the landmark, a wall before it or a floor above its foot, or a
            sequence of another length than the views.
        """
        views = Views.broadcast(distance_m, delta_rad, bearing_rad, height_m, pitch_rad, roll_rad)
        return self.render_views(views, background=background, rows=rows, variant=variant, workers=workers)

    def render_views(
        self,
        views: Views,
        *,
        background: Backgrounds = None,
        rows: tuple[int, int] | None = None,
        variant: Variant = "exact",
        workers: int = 1,
    ) -> PhasorImages:
        """Render a batch of views; see :meth:`render`."""
        first, stop = rows if rows is not None else (0, self.sensor.rows)
        if not 0 <= first < stop <= self.sensor.rows:
            raise UsageError(f"'rows' must lie in 0 … {self.sensor.rows}, got {(first, stop)!r}")
        if variant not in ("exact", "hard"):
            raise UsageError(f"'variant' must be exact or hard, got {variant!r}")
        seen = views.in_camera(self.sensor)
        behind = self._checked(seen, background, workers)
        return replace(self._render(seen, behind, (first, stop), workers, variant), views=views)

    def turned_out_of_view(self, views: Views) -> NDArray[np.intp]:
        """Return which views are tilted so far that none of the landmark's bounding box is in the image.

        Parameters
        ----------
        views : Views
            Views of the landmark.
        """
        tilted = np.flatnonzero((views.pitch_rad != 0) | (views.roll_rad != 0))
        if not tilted.size or not len(self.topology.faces):
            return tilted[:0]
        sensor = self.sensor
        rotation, translation = views[tilted].in_camera(sensor).landmark2cam()
        box = np.array(list(itertools.product(*zip(self.topology.low, self.topology.high, strict=True))))
        corners = (np.einsum("nij,kj->nki", rotation, box) + translation[:, None]) @ sensor.cam2level
        v, u = np.mgrid[: sensor.rows + 1, : sensor.cols + 1].astype(float)
        edge = (v % sensor.rows == 0) | (u % sensor.cols == 0)
        x, y, z = sensor.ray_directions(u[edge], v[edge]).T
        beyond = (corners[..., 0] <= 0).all(axis=1)
        ahead = sensor.cam2level.T @ [x, y, z]
        if (ahead[0] > 0).all():
            for axis in (1, 2):
                slope = ahead[axis] / ahead[0]
                beyond |= (corners[..., axis] > slope.max() * corners[..., 0]).all(axis=1)
                beyond |= (corners[..., axis] < slope.min() * corners[..., 0]).all(axis=1)
        return np.asarray(tilted[beyond], np.intp)

    def check_in_view(self, views: Views) -> None:
        """Refuse views that are tilted so far that the landmark is out of the image.

        Parameters
        ----------
        views : Views
            Views of the landmark.

        Raises
        ------
        UsageError
            Naming the view, its tilt, and the pitch that would have the landmark in the middle.
        """
        lost = self.turned_out_of_view(views)
        if not lost.size:
            return
        k = int(lost[0])
        seen = views[k : k + 1].in_camera(self.sensor)
        middle = float(seen.height_m[0]) + 0.5 * float(self.topology.low[2] + self.topology.high[2])
        elevation = math.degrees(math.atan2(middle, float(seen.distance_m[0])))
        pitch, roll = (math.degrees(float(values[k])) for values in (views.pitch_rad, views.roll_rad))
        right = round(-elevation - self.sensor.pitch_deg, 1) + 0.0
        raise UsageError(
            f"a pitch of {pitch:.4g}° and a roll of {roll:.4g}° turn the landmark out of the image in view {k}: at roll"
            f" 0 a pitch of about {right:g}° has it in the middle"
        )

    def jacobian(
        self,
        distance_m: ArrayLike,
        delta_rad: ArrayLike = 0.0,
        bearing_rad: ArrayLike = 0.0,
        height_m: ArrayLike = 0.0,
        pitch_rad: ArrayLike = 0.0,
        roll_rad: ArrayLike = 0.0,
        *,
        background: Backgrounds = None,
        parameters: Sequence[str] = VIEW_PARAMETERS,
        workers: int = 1,
    ) -> NDArray[np.complex128]:
        """Return how the phasors change with the view, ∂S/∂parameter.

        Differences of the exact integral, 1e-5 m or rad to either side. The slope jumps where an edge passes a corner
        of a pixel or lies along its border; there this is a mean of the slopes on both sides. Height at h = 0, where
        the top of the lower part appears (PHYSICS section 7), gets the slope towards h > 0, where the top stays hidden.

        Parameters
        ----------
        distance_m, delta_rad, bearing_rad, height_m, pitch_rad, roll_rad : array_like
            As for :meth:`render`.
        background : Background or sequence of Background, optional
            As for :meth:`render`.
        workers : int
            As for :meth:`render`.
        parameters : sequence of str
            Which derivatives, in this order; "pitch_rad" and "roll_rad" too may be asked for.

        Returns
        -------
        (n, len(parameters), rows, cols) complex128
            Per metre or per radian. Of a sensor with m > 1 frequencies (n, len(parameters), m, rows, cols).

        Raises
        ------
        UsageError
            As for :meth:`render`, or a parameter is unknown or named twice.

        Examples
        --------
        >>> import trimesh
        >>> from phasemark.render import Renderer, preset
        >>> plate = trimesh.creation.box((0.002, 2.0, 2.0))  # its front is 1 m from the lens at D = 1.001
        >>> renderer = Renderer(plate, preset("pmd-16x16"), albedo=1.0)
        >>> slope = renderer.jacobian(1.001, parameters=("distance_m",))
        >>> slope.shape, abs(slope[0, 0, 8, 8]).round(2)  # of exp(i r / 2.39 m) / r²
        ((1, 1, 16, 16), np.float64(2.04))
        """
        check_parameters(parameters)
        views = Views.broadcast(distance_m, delta_rad, bearing_rad, height_m, pitch_rad, roll_rad).in_camera(
            self.sensor
        )
        return self._differences(views, self._checked(views, background, workers), parameters, workers)

    def render_with_slopes(
        self,
        views: Views,
        parameters: Sequence[str] = VIEW_PARAMETERS,
        *,
        background: Backgrounds = None,
        workers: int = 1,
    ) -> tuple[PhasorImages, NDArray[np.complex128]]:
        """Render views, and how their phasors change with the view, from the same samples.

        It takes two to three times as long as the images alone. Slopes agree with those of :meth:`jacobian` to some
        1e-5 of the largest on plane faces. Beside the limb of a curved mesh, whose shading normals are interpolated
        between its corners, single pixels differ by one to three percent of it. An edge that lies exactly along a
        border between pixels counts for neither of them. Open meshes, and views with pixels too full of edges to be
        split, get differences of whole images.

        Parameters
        ----------
        views : Views
            n views.
        parameters : sequence of str
            Which derivatives, in this order; "pitch_rad" and "roll_rad" too may be asked for.
        background : Background or sequence of Background, optional
            As for :meth:`render`.
        workers : int
            As for :meth:`render`.

        Returns
        -------
        images : PhasorImages
        slope : (n, len(parameters), rows, cols) complex128
            ∂S/∂parameter, per metre or radian; of a sensor with m > 1 frequencies (n, len(parameters), m, rows, cols);
            see :mod:`phasemark.render.integral.slopes`.

        Raises
        ------
        UsageError
            As for :meth:`jacobian`.
        """
        check_parameters(parameters)
        seen = views.in_camera(self.sensor)
        behind = self._checked(seen, background, workers)
        by_pixel = self._no_slopes(len(views), parameters)
        images = self._render(seen, behind, (0, self.sensor.rows), workers, slope=by_pixel, parameters=parameters)
        return replace(images, views=views), self._slopes(by_pixel, seen, behind, parameters, workers)

    def render_split(
        self,
        views: Views,
        parameters: Sequence[str],
        *,
        background: Backgrounds,
        rows: tuple[int, int] | None = None,
    ) -> SplitImages:
        """Render views with their slopes, and what the landmark alone returns in them, from the same samples.

        Parameters are those of :meth:`render_with_slopes`; with none, `rows` may be some.

        Returns
        -------
        images, slope
            As :meth:`render_with_slopes` returns them.
        alone, alone_slope
            The same with nothing behind the landmark; intensities are those of the whole.
        """
        if parameters:
            check_parameters(parameters)
        seen = views.in_camera(self.sensor)
        behind = self._checked(seen, background, 1)
        by_pixel, alone = self._no_slopes(len(views), parameters), Alone(self._no_slopes(len(views), parameters))
        lit = (0, self.sensor.rows) if rows is None else rows
        images = self._render(seen, behind, lit, 1, slope=by_pixel, parameters=parameters, alone=alone)
        assert alone.sums is not None
        return (
            replace(images, views=views),
            self._slopes(by_pixel, seen, behind, parameters, 1),
            replace(images_of_sums(alone.sums, self.sensor, self._integral.harmonics), views=views),
            self._slopes(alone.slope_by_pixel, seen, np.zeros_like(behind), parameters, 1),
        )

    def _no_slopes(self, n: int, parameters: Sequence[str]) -> NDArray[np.complex128]:
        """Return slopes to be filled, (m, pixels of n views, p)."""
        sensor = self.sensor
        return np.zeros((len(sensor.frequencies_hz), n * sensor.rows * sensor.cols, len(parameters)), np.complex128)

    def _slopes(
        self,
        by_pixel: NDArray[np.complex128],
        seen: Views,
        behind: NDArray[np.float64],
        parameters: Sequence[str],
        workers: int,
    ) -> NDArray[np.complex128]:
        """Return slopes that were filled by view and parameter; by differences where edges are too many."""
        m, _, p = by_pixel.shape
        slope = by_pixel.reshape(m, len(seen), self.sensor.rows, self.sensor.cols, p).transpose(1, 4, 0, 2, 3)
        slope = slope[:, :, 0] if m == 1 else slope
        full = np.flatnonzero(np.isnan(slope).any(axis=tuple(range(1, slope.ndim))) | (not self.topology.split))
        if full.size and p:
            slope[full] = self._differences(seen[full], behind[full], parameters, workers)
        return slope

    def _differences(
        self, seen: Views, background: NDArray[np.float64], parameters: Sequence[str], workers: int
    ) -> NDArray[np.complex128]:
        """Return slopes as differences of images; `seen` as the camera itself has the views."""

        # not checked: a step may take a landmark that stands on the floor a hair into it
        def phasor_of(moved: Views, which: slice | NDArray[np.integer]) -> NDArray[np.complex128]:
            images = self._render(moved, background[which], (0, self.sensor.rows), workers)
            return images.phasor if len(self.sensor.frequencies_hz) == 1 else images.phasors

        return differentiate(phasor_of, seen, parameters)

    def _checked(self, views: Views, background: Backgrounds, workers: int) -> NDArray[np.float64]:
        """Refuse what cannot be rendered; return what stands behind each view, (n, 4)."""
        check_workers(workers)
        return self.check_can_be_seen(views, background)

    def check_can_be_seen(self, views: Views, background: Backgrounds) -> NDArray[np.float64]:
        """Refuse a lens inside the landmark, a wall before it and a floor above its foot.

        Parameters
        ----------
        views : Views
            As the camera itself has them, :meth:`~phasemark.render.Views.in_camera`.
        background : Background or sequence of Background, optional
            As for :meth:`render`.

        Returns
        -------
        (n, 5) float64
            What stands behind the landmark in each view, rows as
            :meth:`~phasemark.render.background.Background.parameters`.

        Raises
        ------
        UsageError
            Naming the view.
        """
        views.check_possible()
        self._check_lens_outside(views)
        behind = parameters_of_views(background, len(views))
        check_behind(behind, self.footprint, views)
        if behind[:, BOUNCES].any():
            check_can_bounce(self.sensor)
            if not len(self.topology.faces):
                raise UsageError("light that bounces needs a landmark: without one, put wall and floor into a Scene")
        return behind

    def _render(
        self,
        views: Views,
        background: NDArray[np.float64],
        rows: tuple[int, int],
        workers: int,
        variant: Variant = "exact",
        slope: NDArray[np.complex128] | None = None,
        parameters: Sequence[str] = (),
        alone: Alone | None = None,
    ) -> PhasorImages:
        """Render rows of views that have been checked, as the camera itself has them, before the rows of `background`.

        With `slope`, (m, pixels of all views, p), it is filled with how the phasors at each of the sensor's m
        frequencies change with `parameters`.
        """
        order: slice | NDArray[np.int64] = slice(None)
        if slope is None and len(self.topology.faces) >= _LARGE:  # side after side: the cache does not hold all of it
            order = np.argsort(views.delta_rad, kind="stable")
        ordered, behind = views[order], background[order]
        slopes = None
        if slope is not None:
            turns = np.array([name in _TURNING for name in parameters], np.bool_) & bool(background[:, :2].any())
            slopes = Slopes(slope, partial(_motion, ordered, parameters), turns)
        poses = poses_of_views(ordered, behind, self.sensor.cam2level)
        sums = self._integral.sums(
            poses, n_parts=_PARTS, rows=rows, workers=workers, variant=variant, slopes=slopes, alone=alone
        )
        untrusted = int((sums.state == UNTRUSTED).sum())
        with _COUNTING:
            self.untrusted_pixels += untrusted
        if behind[:, BOUNCES].any() and variant == "exact":
            self._add_bounces(sums, poses, ordered, rows, workers, slope)
        images = images_of_sums(sums, self.sensor, self._integral.harmonics)
        return replace(
            images,
            phasor=_restored(images.phasor, order),
            intensity=_restored(images.intensity, order),
            coverage=_restored(images.coverage, order),
            upper_coverage=_restored(np.minimum(sums.shares[:, 1].reshape(sums.state.shape), 1.0), order),
            views=views,
            harmonics={k: _restored(values, order) for k, values in images.harmonics.items()},
            by_hz={hz: _restored(values, order) for hz, values in images.by_hz.items()},
        )

    def _add_bounces(
        self,
        sums: Sums,
        poses: Poses,
        views: Views,
        rows: tuple[int, int],
        workers: int,
        slope: NDArray[np.complex128] | None,
    ) -> None:
        """Add light that has bounced to sums; slopes grow in proportion, as it changes with what the pixel sees."""
        columns_hz = phasor_frequencies_hz(self.sensor.frequencies_hz, self._integral.harmonics)
        found = self._bouncing(columns_hz).seen(poses, views, workers)
        light = found.reshape(len(views), self.sensor.rows, self.sensor.cols, -1)[:, rows[0] : rows[1]]
        light = light.reshape(len(sums.intensity), -1)
        if slope is not None:
            for k, hz in enumerate(self.sensor.frequencies_hz):
                column = columns_hz.index(hz)
                direct = sums.phasor[:, column]
                gain = np.divide(light[:, 1 + column], direct, out=np.zeros_like(direct), where=direct != 0)
                slope[k] *= 1 + gain[:, None]
        sums.phasor[:] += light[:, 1:]
        sums.intensity[:] += light[:, 0].real

    def _bouncing(self, columns_hz: Sequence[float]) -> StandingLight:
        """Return the source of light that bounces."""
        from phasemark.render.bounces.standing import standing_light

        if self._standing is None or not self._standing.is_of(self.albedo, self.sensor):
            self._standing = standing_light(self.topology, self.albedo, self.sensor, [0.0, *columns_hz])
        return self._standing

    def _check_lens_outside(self, views: Views) -> None:
        """Refuse views whose lens is inside the landmark's box and no farther from the axis than its vertices."""
        if not len(self.topology.faces):
            return
        low, high = self.topology.low, self.topology.high
        lens = views.lens_in_landmark()
        inside = ((lens > low - 1e-3) & (lens < high + 1e-3)).all(axis=1)
        inside &= np.hypot(lens[:, 0], lens[:, 1]) < self.footprint.radius_m + 1e-3
        near = np.flatnonzero(inside)
        if near.size:
            least_m = float(self.footprint.nearest_m(views.delta_rad[near[:1]], 1e-3)[0])
            raise UsageError(
                f"in view {near[0]} the lens is inside the landmark's bounding box (distance_m ="
                f" {views.distance_m[near[0]]:g}): 'distance_m' must be above {least_m:.3g} at this 'delta_rad'"
            )


def _check_albedo(albedo: float) -> None:
    if not 0 < albedo <= 1:
        raise UsageError(f"'albedo' must be in (0, 1], got {albedo!r}")


def _restored(values: NDArray[Any], order: slice | NDArray[np.int64]) -> NDArray[Any]:
    """Return rendered arrays in the order of the views."""
    if isinstance(order, slice):
        return values
    restored = np.empty_like(values)
    restored[order] = values
    return restored


def background_image(background: Background, sensor: Sensor) -> PhasorImages:
    """Return the image of a background alone, straight ahead.

    Parameters
    ----------
    background : Background
        Wall and floor.
    sensor : Sensor
        The camera.

    Returns
    -------
    PhasorImages
        One image.
    """
    return Renderer(None, sensor).render(distance_m=1.0, background=background)


_COUNTING = Lock()
"""Threads may share a renderer, and its count; the lock is no part of it, so that it can be copied and pickled."""


def _motion(views: Views, parameters: Sequence[str], which: slice, poses: Poses, camera: Camera) -> Motion:
    """Return the poses of some of the views, and of each with one parameter after the other moved."""
    p, own = len(parameters), views[which]
    many = Views(*(np.repeat(getattr(own, name), 1 + p) for name in VIEW_FIELDS))
    for k, name in enumerate(parameters):
        getattr(many, name)[k + 1 :: 1 + p] += STEP
    background = np.repeat(poses.background, 1 + p, axis=0)
    return Motion(poses_of_views(many, background, camera.level), np.full(p, STEP), np.empty((1 + p, 4)))
