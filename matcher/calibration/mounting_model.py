"""Model of a calibration: the frames that a camera with any mounting would see from known positions.

A lens has as many of :data:`~phasemark.render.sensor.lens_fields.TERMS` as it states. What one of them is worth depends
on the image: the natural unit of a term moves the image point that it moves most by 1°, so that a unit of k1 means the
same before 16 and before 640 columns, and a standard deviation in units is one of the image at its farthest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage

from phasemark import UsageError
from phasemark.matcher.calibration.known_poses import KnownPoses
from phasemark.matcher.calibration.mounting import ALL_NAMES, PARAMETERS, Mounting, clipped, lens_of
from phasemark.matcher.calibration.pose_track import PoseTrack
from phasemark.matcher.likelihood.residuals import Evidence, ResidualKind
from phasemark.matcher.one_frequency import OneFrequency, OneFrequencyRenderer
from phasemark.render import Background, PhasorImages, Renderer, Sensor, Views
from phasemark.render.direct.chip_renderer import ChipRenderer
from phasemark.render.sensor.lens_fields import TERMS, lens_rates
from phasemark.render.sensor.lens_map import distort
from phasemark.render.threads import mapped
from phasemark.render.view import VIEW_FIELDS

_Float = NDArray[np.float64]
_Bool = NDArray[np.bool_]

LONGEST_STEP = 1.0
"""No descent steps farther at once, in natural units: slopes jump where edges pass corners of pixels."""
STEP = 2e-4
"""Half the width of a difference, radians or metres: 1/60 of a pixel, wide enough to average what jumps where an edge
passes a corner of a pixel, narrow enough to be the slope."""
POSE = ("distance_m", "delta_rad", "bearing_rad", "height_m")
"""What of a pose may be uncertain."""
EFFECTS = (*POSE, "time_s", "pitch_rad", "roll_rad")
"""Errors of a pose, its stamp and its tilt, by which slopes can be taken beside the parameters of the mounting."""
LEVEL_EFFECTS = EFFECTS[:5]
"""Those of poses that state no tilt."""
_ALIKE = {"bearing_rad": "bearing", "height_m": "height"}
"""Errors of a pose that move an image as a parameter does: one slope serves both, and they cancel where they should."""
_TERM_UNIT = math.tan(math.radians(1.0))
"""By how much, as a tangent, a natural unit of a term of the lens moves the image where it moves it most."""
_POINTS = 9
"""Along each side of the image."""
_HALVINGS = 12
"""How often a step that leads to no lens is halved before it is not taken."""
_FULL = 1 - 1e-6
"""Coverage of a pixel that sees nothing but the landmark."""
_FLOORS = 0.5 + 0.48 * np.cos(np.pi * (np.arange(5) + 0.5) / 5)
"""Albedos of the floor at which light that bounces is computed: Chebyshev's nodes, between which a polynomial goes."""


@dataclass(frozen=True, eq=False)
class Images:
    """Model images from K poses; (K, pixels) arrays.

    Parameters
    ----------
    phasor : complex128
        Range offset and albedo in it.
    intensity, coverage : float64
    alone : complex128
        Phasor of the landmark without what stands behind it, if it was needed; else all of it.
    """

    phasor: NDArray[np.complex128]
    intensity: _Float
    coverage: _Float
    alone: NDArray[np.complex128]


def range_residual(evidence: Evidence, images: Images) -> _Float:
    """Return measured less modelled ranges, metres, (K, pixels); NaN where the model sees nothing."""
    late = np.angle(evidence.value * images.phasor.conj())
    return np.where(images.phasor != 0, evidence.sensor.metres_per_radian * late, np.nan)


def natural_units(sensor: Sensor) -> _Float:
    """Return the natural units of all parameters, with those of the terms of a sensor's lens, (22,)."""
    rates = {} if sensor.lens is None else lens_rates(sensor.lens, sensor.rows, sensor.cols)
    own = {name: _TERM_UNIT / rate for name, rate in rates.items()}
    return np.array([own.get(name, one.scale) for name, one in PARAMETERS.items()])


def stretch_of(sensor: Sensor, theta: _Float) -> float:
    """Return the least share of its area at the axis that a lens leaves to any part of an image; 0 if it is no lens.

    A lens that folds inside the image, or is out of range, is none. Where the share is 0 it is about to fold.

    Parameters
    ----------
    sensor : Sensor
        With a lens, whose model and number of coefficients are kept.
    theta : (22,) float64
        In the order of :data:`~phasemark.matcher.calibration.mounting.ALL_NAMES`.
    """
    assert sensor.lens is not None
    try:
        lens = lens_of(sensor.lens, theta)
        sensor.with_(lens=lens)
    except UsageError:
        return 0.0
    before = lens.before(sensor.rows, sensor.cols)
    u, v = np.meshgrid(np.linspace(0, sensor.cols, _POINTS), np.linspace(0, sensor.rows, _POINTS))
    y, z = before.rays(u, v)
    _, _, xx, xy, yy = distort(before.model, before.k, -y, -z)
    return float(np.nan_to_num(xx * yy - xy * xy).min())


@dataclass(eq=False)
class CalibrationModel:
    """Renders a landmark from known poses for any mounting.

    Parameters
    ----------
    mesh : trimesh.Trimesh
    sensor : Sensor
        All that the mounting does not say.
    poses : KnownPoses
    albedo : float
        At which is rendered; the mounting's own scales it.
    background : Background, optional
        What stands behind; a pose's own wall replaces its wall.
    reports_z : bool
        Whether the camera measures z, and its ranges were made of that with the half angles of `sensor`.
    workers : int
        Threads.
    rendered : callable
        Called with each rendering of all poses; threads may do so at the same time.
    track : PoseTrack, optional
        Poses by time, for a moving camera; the poses of the frames then follow from the delay of the mounting.
    stamp_s : (K,) float64, optional
        Time stamps of the frames, with `track`.
    one : OneFrequency, optional
        How a camera of several modulation frequencies becomes `sensor`; None: it has one frequency.
    chip : bool
        Whether ranges are those of the nearest target that the chip of a direct sensor reports, not means over a zone.
    """

    mesh: trimesh.Trimesh
    sensor: Sensor
    poses: KnownPoses
    albedo: float
    background: Background | None = None
    reports_z: bool = False
    workers: int = 1
    rendered: Callable[[], None] = lambda: None
    track: PoseTrack | None = None
    stamp_s: _Float | None = None
    one: OneFrequency | None = None
    chip: bool = False

    def __post_init__(self) -> None:
        """Make what renders, and group the poses by what stands behind the landmark."""
        self.scale = natural_units(self.sensor)
        """Natural units, in the order of :data:`ALL_NAMES`; those of the lens of this sensor."""
        self.step = np.where(np.isin(ALL_NAMES, TERMS), self.scale / math.radians(1.0), 1.0) * STEP
        """Half the width of a difference in each: for terms of the lens, what moves the image by :data:`STEP`."""
        self._axis_cosine = self.sensor.axis_cosine() if self.reports_z else None
        self._bounced: list[PhasorImages] = []
        self._renderer = self._rendering()
        # of the images that a step needs, many have one mounting, and to check a sensor takes as long as to render one
        self._camera = lru_cache(maxsize=32)(lambda mounting: mounting.on(self.sensor))
        self._scenes = [(np.arange(len(self.poses)), self.background)]
        if self.poses.wall_m is not None:
            base = self.background or Background()
            self._scenes = [
                (np.flatnonzero(self.poses.wall_m == wall), replace(base, wall_m=float(wall)))
                for wall in np.unique(self.poses.wall_m)
            ]

    def _rendering(self) -> Renderer:
        """Return the renderer of the landmark, in the frequency and by the chip of the frames."""
        if self.chip:
            return ChipRenderer(self.mesh, self.sensor, albedo=self.albedo)
        camera = self.sensor if self.one is None else self.one.camera
        plain = Renderer(self.mesh, camera, albedo=self.albedo, harmonics=())
        return plain if self.one is None else OneFrequencyRenderer(plain, self.one)

    def mounting(self, theta: _Float) -> Mounting:
        """Return the mounting that numbers in the order of :data:`ALL_NAMES` mean."""
        return Mounting.of_vector(theta, self.sensor)

    def moved(self, theta: _Float, step: _Float) -> _Float:
        """Return where a step leads within what a camera can have.

        Where the terms of the lens would fold it inside the image, or make none, their step is halved until they make
        one that does not.

        Parameters
        ----------
        theta, step : (22,) float64
            In the order of :data:`ALL_NAMES`; the first has a lens that does not fold.
        """
        there = clipped(theta + step)
        lens = np.isin(ALL_NAMES, TERMS)
        whole = there[lens] - theta[lens]
        if self.sensor.lens is None or not whole.any():
            return there
        # A lens that leaves a smaller share of its area to a part of the image is about to fold there: no step leads to
        # it.
        least_stretch = 0.01
        least = min(least_stretch, stretch_of(self.sensor, theta))
        for halvings in range(_HALVINGS):
            if halvings:
                there[lens] = theta[lens] + 0.5**halvings * whole
            if stretch_of(self.sensor, there) > least:
                return there
        there[lens] = theta[lens]
        return there

    def stepped(self, theta: _Float, columns: NDArray[np.int64], step: _Float) -> _Float:
        """Return where a step of some parameters leads; see :meth:`moved`."""
        whole = np.zeros(len(theta))
        whole[columns] = step
        return self.moved(theta, whole)

    def beside(self, theta: _Float, column: int, half: float) -> tuple[_Float, _Float, float]:
        """Return both ends of a difference by one number and how far they are apart: less where a step is cut."""
        step = half * np.eye(len(theta))[column]
        high, low = self.moved(theta, step), self.moved(theta, -step)
        return high, low, float(high[column] - low[column]) or 2 * half

    @property
    def light_bounces(self) -> bool:
        """Whether light bounces off what stands behind the landmark."""
        return any(background is not None and background.bounces for _, background in self._scenes)

    def let_bounce(self, theta: _Float) -> None:
        """Compute the light that bounces at a mounting; until the next call it stays as it is beside direct light."""
        views, self._bounced = self._views(theta, None), []
        floor = ALL_NAMES.index("floor_albedo")
        for albedo in _FLOORS:
            there = theta.copy()
            there[floor] = albedo
            direct, whole = (self._render(self.mounting(there), views, direct=direct) for direct in (True, False))
            self._bounced.append(replace(whole, phasor=whole.phasor - direct.phasor,
                                         intensity=whole.intensity - direct.intensity))  # fmt: skip

    @property
    def has_background(self) -> bool:
        """Whether anything is known to stand behind the landmark."""
        return any(background is not None for _, background in self._scenes)

    @property
    def reach_m(self) -> float:
        """Distance of the landmark's farthest point from its origin."""
        return float(np.linalg.norm(self._renderer.topology.vertices, axis=1).max())

    def check_behind(self, theta: _Float, slack_m: float) -> None:
        """Refuse walls and floors that cut the landmark by more than a mounting may be off.

        Parameters
        ----------
        theta : (22,) float64
            Initial guess of the mounting.
        slack_m : float

        Raises
        ------
        UsageError
        """
        views = self._views(theta, None).in_camera(self.mounting(theta).on(self.sensor))
        views = replace(views, distance_m=views.distance_m - slack_m, height_m=views.height_m + slack_m)
        for which, background in self._scenes:
            if background is not None:
                background.check_behind(self._renderer.footprint, views[which])

    def lens_within(self) -> _Bool:
        """Return from which poses the lens would stand in the landmark's foot print, (K,)."""
        vertices = self._renderer.topology.vertices[:, :2]
        distance, delta = self.poses.distance_m[:, None], self.poses.delta_rad
        lens = -distance * np.column_stack([np.cos(delta), np.sin(delta)])
        return np.asarray(((lens > vertices.min(axis=0)) & (lens < vertices.max(axis=0))).all(axis=1))

    def images(self, theta: _Float, shift: _Float | None = None, *, need_alone: bool = False) -> Images:
        """Render all poses.

        Parameters
        ----------
        theta : (22,) float64
            The mounting.
        shift : (K, s) float64, optional
            What is added to the first s numbers of the views of the poses.
        need_alone : bool
            Whether the landmark alone is wanted even where nothing else is made of it.
        """
        mounting = self.mounting(theta)
        views = self._views(theta, shift)
        image = self._render(mounting, views)
        alone = image
        brighter = mounting.albedo / self.albedo - 1
        if self.has_background and (brighter or need_alone):
            alone = self._render(mounting, views, alone=True)
        turn = self._turn(mounting, image)
        k = len(self.poses)
        turn = turn.reshape(-1, *turn.shape[-2:])
        return Images(
            (turn * (image.phasor + brighter * alone.phasor)).reshape(k, -1),
            (image.intensity + brighter * alone.intensity).reshape(k, -1),
            image.coverage.reshape(k, -1),
            (turn * (1 + brighter) * alone.phasor).reshape(k, -1),
        )

    def slopes(
        self,
        theta: _Float,
        names: Sequence[str],
        on: ResidualKind,
        *,
        shift: _Float | None = None,
        width: _Float | None = None,
        central: bool = True,
    ) -> NDArray[np.complex128]:
        """Return how the images change, by differences.

        On ranges the difference is one of phases, not of phasors: a pixel that an edge is just leaving has hardly any
        light at one end, and its range is as smooth as any other.

        Parameters
        ----------
        theta, shift
            As for :meth:`images`.
        names : sequence of str
            Parameters of the mounting, and of :data:`EFFECTS` errors of the poses.
        on : {"ranges", "phasors"}
        width : (22,) float64, optional
            Half width of each difference; at least :attr:`step`.
        central : bool
            Whether differences are central: exact to the second order, and with twice as many images.

        Returns
        -------
        (K, n, pixels) complex128
            Change of the phasor by each of `names`; on ranges that of its logarithm, i times the phase, 0 where nothing
            is seen at either end.
        """
        half = self.step if width is None else np.maximum(width, self.step)
        own = {name: _ALIKE[name] if _ALIKE.get(name) in names else name for name in POSE}
        moving = VIEW_FIELDS if self.poses.are_tilted else POSE

        here = None if central else self.images(theta, shift).phasor

        def difference(name: str) -> NDArray[np.complex128]:
            if name in VIEW_FIELDS:
                step = STEP * np.eye(len(VIEW_FIELDS))[VIEW_FIELDS.index(name)]
                base = np.zeros((len(self.poses), len(VIEW_FIELDS)))
                if shift is not None:
                    base[:, : shift.shape[1]] = shift
                high, span = self.images(theta, base + step).phasor, STEP if here is not None else 2 * STEP
                low = self.images(theta, base - step).phasor if here is None else here
            else:
                column = ALL_NAMES.index(name)
                there, back, span = self.beside(theta, column, half[column])
                high = self.images(there, shift).phasor
                if here is not None and there[column] != theta[column]:
                    low, span = here, float(there[column] - theta[column])
                else:
                    low = self.images(back, shift).phasor
            if on == "phasors":
                return np.asarray((high - low) / span)
            return np.asarray(1j * np.angle(high * low.conj()) / span)

        by_time = {"delay", "time_s"} & set(names)
        exact = {"range_offset", *by_time, *(("albedo",) if on == "phasors" else ())}
        wanted = dict.fromkeys(own.get(name, name) for name in (*names, *(moving if by_time else ())))
        rendered = [name for name in wanted if name not in exact]
        found = dict(zip(rendered, mapped(difference, rendered, self.workers), strict=True))
        found |= {name: found[same] for name, same in own.items() if same in found}
        if by_time:
            rate = self.poses_at(theta)[1][:, : len(moving)]
            by_rate = np.einsum("ks,skr->kr", rate, np.stack([found[name] for name in moving]))
            found |= dict.fromkeys(by_time, by_rate)
        if on == "ranges":
            found["range_offset"] = np.full(
                (len(self.poses), self.sensor.rows * self.sensor.cols), 1j / self.sensor.metres_per_radian
            )
        elif exact & set(names):
            image = self.images(theta, shift, need_alone="albedo" in names)
            found["range_offset"] = 1j * image.phasor / self.sensor.metres_per_radian
            found["albedo"] = image.alone / theta[ALL_NAMES.index("albedo")]
        return np.stack([found[name] for name in names], axis=1)

    def coverage(self, theta: _Float) -> _Float:
        """Return the share of each pixel that sees the landmark, (K, pixels)."""
        views = self._views(theta, None)
        return self._render(self.mounting(theta), views, alone=True).coverage.reshape(len(views), -1)

    def alone(self, images: Images, *, from_edges: bool = False) -> _Bool:
        """Return which pixels see nothing but the landmark, (K, pixels), or also a pixel away from its edges."""
        full = images.coverage > _FULL
        if not from_edges:
            return np.asarray(full)
        shaped = full.reshape(-1, self.sensor.rows, self.sensor.cols)
        return np.asarray(ndimage.minimum_filter(shaped, size=(1, 3, 3), mode="nearest").reshape(full.shape))

    def _turn(self, mounting: Mounting, image: PhasorImages) -> NDArray[np.complex128]:
        """Return the factor from rendered phasors to those measured by the camera, (1 or K, rows, cols).

        The range offset; and where the camera reports z, that its ranges were made with half angles that may be wrong.
        """
        scale = self.sensor.metres_per_radian
        turn = np.full((1, self.sensor.rows, self.sensor.cols), np.exp(1j * mounting.range_offset_m / scale))
        if self._axis_cosine is None:
            return turn
        longer = image.sensor.axis_cosine() / self._axis_cosine - 1
        return np.asarray(turn * np.exp(1j * np.nan_to_num(image.range_m) * longer / scale))

    def poses_at(self, theta: _Float) -> tuple[_Float, _Float]:
        """Return the view of each frame and its rates per second, (K, 6) each; the rates are 0 at rest."""
        if self.track is not None and self.stamp_s is not None:
            return self.track.at(self.stamp_s + theta[ALL_NAMES.index("delay")])
        still = np.column_stack([getattr(self.poses, name) for name in VIEW_FIELDS])
        return still, np.zeros_like(still)

    def _views(self, theta: _Float, shift: _Float | None) -> Views:
        seen = self.poses_at(theta)[0]
        if shift is not None:
            seen[:, : shift.shape[1]] += shift
        return Views(*np.ascontiguousarray(seen.T))

    def _render(self, mounting: Mounting, views: Views, *, alone: bool = False, direct: bool = True) -> PhasorImages:
        """Render views: the landmark `alone`, or with what stands behind, of bouncing light what was computed before.

        Not `direct`: with the light that bounces at this mounting.
        """
        renderer = self._renderer.seen_by(self._camera(mounting))
        self.rendered()

        def seen(views: Views, background: Background | None) -> PhasorImages:
            if background is not None:
                bounces = 0 if direct else background.bounces
                background = replace(background, floor_albedo=mounting.floor_albedo, bounces=bounces)
                background = background.giving_way(renderer.footprint, views.in_camera(renderer.sensor))
            return renderer.render_views(views, background=background)

        if alone:
            return seen(views, None)
        if len(self._scenes) == 1:
            return self._with_bounced(seen(views, self._scenes[0][1]), mounting.floor_albedo)
        parts = [seen(views[which], background) for which, background in self._scenes]
        back = np.argsort(np.concatenate([which for which, _ in self._scenes]))
        phasor, intensity, coverage = (
            np.concatenate([getattr(part, name) for part in parts])[back]
            for name in ("phasor", "intensity", "coverage")
        )
        image = PhasorImages(phasor, intensity, coverage, renderer.sensor, views)
        return self._with_bounced(image, mounting.floor_albedo)

    def _with_bounced(self, image: PhasorImages, floor_albedo: float) -> PhasorImages:
        """Return an image with the light that bounces, by Lagrange's polynomial in the albedo of the floor."""
        phasor, intensity = image.phasor, image.intensity
        for k, one in enumerate(self._bounced):
            others = np.delete(_FLOORS, k)
            share = np.prod((floor_albedo - others) / (_FLOORS[k] - others))
            phasor, intensity = phasor + share * one.phasor, intensity + share * one.intensity
        return replace(image, phasor=phasor, intensity=intensity)
