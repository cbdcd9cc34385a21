"""Model of a calibration: the frames that a camera with any mounting would see from known positions.

The mounting is nine numbers, :class:`Mounting`. Four of them turn or widen the camera itself (pitch, roll and both
half angles), two move the landmark in its image (height and bearing), one delays the light (range offset), one the time
stamps (delay, for a moving camera), and one is the brightness of the landmark (albedo), which is not the camera's.
Where the camera has a lens, its terms follow these nine, and both half angles follow from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.calibration.known_poses import KnownPoses
from phasemark.matcher.calibration.lens_terms import farthest_lens, lens_of, natural_units, numbers_of
from phasemark.matcher.calibration.pose_track import PoseTrack
from phasemark.matcher.likelihood.residuals import ResidualKind
from phasemark.matcher.one_frequency import OneFrequency, OneFrequencyRenderer
from phasemark.render import Background, PhasorImages, Renderer, Sensor, Views
from phasemark.render.sensor.lens_fields import LENS_FIELD, TERMS, Lens


@dataclass(frozen=True)
class Parameter:
    """One number of a mounting.

    Parameters
    ----------
    name : str
        As options have it, e.g. ``pitch``.
    attribute : str, optional
        Of :class:`Mounting`, with its unit inside the program; None: a term of its lens.
    scale : float
        Its natural unit: 1°, 1 cm, a tenth of albedo; what steps and conditions are told in. That of a term of a lens
        depends on the image, see :attr:`CalibrationModel.scale`.
    shown : float
        Multiplies it for people: degrees, millimetres.
    unit : str
        Of what is shown.
    field : str, optional
        Of :class:`~phasemark.render.Sensor`; None: the sensor file has no place for it.
    """

    name: str
    attribute: str | None
    scale: float
    shown: float
    unit: str
    field: str | None


_DEGREE, _CM = math.radians(1.0), 0.01
PARAMETERS = {
    parameter.name: parameter
    for parameter in (
        Parameter("pitch", "pitch_rad", _DEGREE, 1 / _DEGREE, "°", "pitch_deg"),
        Parameter("roll", "roll_rad", _DEGREE, 1 / _DEGREE, "°", "roll_deg"),
        Parameter("height", "height_m", _CM, 1e3, "mm", "height_offset_m"),
        Parameter("bearing", "bearing_rad", _DEGREE, 1 / _DEGREE, "°", "bearing_offset_deg"),
        Parameter("half_angle_h", "half_angle_h_rad", _DEGREE, 1 / _DEGREE, "°", "half_angle_h_deg"),
        Parameter("half_angle_v", "half_angle_v_rad", _DEGREE, 1 / _DEGREE, "°", "half_angle_v_deg"),
        Parameter("range_offset", "range_offset_m", _CM, 1e3, "mm", "range_offset_m"),
        Parameter("albedo", "albedo", 0.1, 1.0, "", None),
        Parameter("delay", "delay_s", 0.01, 1e3, "ms", "delay_s"),
        *(
            Parameter(name, None, 1.0, 1.0, "px" if name in ("fx", "fy", "cx", "cy") else "", LENS_FIELD + name)
            for name in TERMS
        ),
    )
}
"""What a calibration can estimate, by name."""
ALL_NAMES = tuple(PARAMETERS)
"""The order of the parameter vector."""
MOUNTING_NAMES = tuple(name for name in ALL_NAMES if name not in TERMS)
"""All but the terms of a lens, which follow in the vector."""
HALF_ANGLES = ("half_angle_h", "half_angle_v")
NAMES = MOUNTING_NAMES[:-1]
"""What frames from still poses can tell; the delay takes a moving camera."""
SCALE = np.array([parameter.scale for parameter in PARAMETERS.values()])
"""Natural units, in the order of :data:`ALL_NAMES`; 1 for the terms of a lens."""
LONGEST_STEP = 1.0
"""No descent steps farther at once, in natural units: slopes jump where edges pass corners of pixels."""
STEP = 2e-4
"""Half the width of a difference, radians or metres: 1/60 of a pixel, wide enough to average what jumps where an edge
passes a corner of a pixel, narrow enough to be the slope."""
_LENS = np.full(len(TERMS), np.inf)
_LEAST = np.array([-0.75, -0.75, -2.0, -1.2, 0.01, 0.01, -np.inf, 1e-3, -10.0, *-_LENS])
_MOST = np.array([0.75, 0.75, 2.0, 1.2, 1.4, 1.4, np.inf, np.inf, 10.0, *_LENS])
POSE = ("distance_m", "delta_rad", "bearing_rad")
"""What of a pose may be uncertain."""


@dataclass(frozen=True)
class Mounting:
    """Parameters of a mounting, and the few of the camera itself that frames from known positions determine.

    Parameters
    ----------
    pitch_rad, roll_rad : float
        Tilt, PHYSICS section 2.
    height_m : float
        Of the landmark's origin above the lens, where a pose's own height is zero.
    bearing_rad : float
        Azimuth of the landmark's axis in the camera frame, where a pose's own bearing is zero.
    half_angle_h_rad, half_angle_v_rad : float
        Half of the field of view, horizontally and vertically, radians.
    range_offset_m : float
        Constant error of all ranges, metres.
    albedo : float
        Of the landmark.
    delay_s : float
        Added to the stamp of a frame to get the time at which the camera was where the frame shows it.
    lens : Lens, optional
        Of the camera; then both half angles follow from it. None: the ideal lens.
    """

    pitch_rad: float
    roll_rad: float
    height_m: float
    bearing_rad: float
    half_angle_h_rad: float
    half_angle_v_rad: float
    range_offset_m: float
    albedo: float
    delay_s: float = 0.0
    lens: Lens | None = None

    @classmethod
    def of_sensor(cls, sensor: Sensor, albedo: float) -> Mounting:
        """Read the mounting that a sensor states."""
        return cls(
            math.radians(sensor.pitch_deg),
            math.radians(sensor.roll_deg),
            sensor.height_offset_m,
            math.radians(sensor.bearing_offset_deg),
            math.radians(sensor.half_angle_h_deg),
            math.radians(sensor.half_angle_v_deg),
            sensor.range_offset_m,
            albedo,
            sensor.delay_s,
            sensor.lens,
        )

    @classmethod
    def of_vector(cls, theta: NDArray[np.float64], sensor: Sensor) -> Mounting:
        """Take numbers in the order of :data:`ALL_NAMES`.

        Parameters
        ----------
        theta : (21,) float64
            The numbers in the order of the fields, metres and radians.
        sensor : Sensor
            Whose kind of lens the terms belong to, if it has one.

        Raises
        ------
        UsageError
            The terms make no lens.
        ValueError
            The lens folds inside the image.
        """
        mounting = cls(*theta[: len(MOUNTING_NAMES)].tolist())
        if sensor.lens is None:
            return mounting
        lens = lens_of(sensor.lens, theta[len(MOUNTING_NAMES) :])
        across, along = lens.before(sensor.rows, sensor.cols).tan_half_angles
        return replace(mounting, half_angle_h_rad=math.atan(across), half_angle_v_rad=math.atan(along), lens=lens)

    @property
    def vector(self) -> NDArray[np.float64]:
        """The numbers in the order of :data:`ALL_NAMES`, (21,); 0 for terms that no lens has."""
        own = [getattr(self, str(PARAMETERS[name].attribute)) for name in MOUNTING_NAMES]
        return np.concatenate([own, numbers_of(self.lens)])

    def number(self, name: str) -> float:
        """Return one of the numbers by its name."""
        return float(self.vector[ALL_NAMES.index(name)])

    def on(self, sensor: Sensor) -> Sensor:
        """Return a sensor mounted like this; one with a lens gets that of the mounting, if it has one.

        Raises
        ------
        UsageError
            The lens folds inside the image, or the sensor has none.
        """
        if self.lens is not None and sensor.lens is None:
            raise UsageError("a mounting with a lens belongs to a sensor with a lens, and this one has none")
        changes: dict[str, object] = {
            "pitch_deg": math.degrees(self.pitch_rad),
            "roll_deg": math.degrees(self.roll_rad),
            "bearing_offset_deg": math.degrees(self.bearing_rad),
            "height_offset_m": self.height_m,
            "range_offset_m": self.range_offset_m,
            "delay_s": self.delay_s,
        }
        if sensor.lens is None:
            changes["half_angle_h_deg"] = math.degrees(self.half_angle_h_rad)
            changes["half_angle_v_deg"] = math.degrees(self.half_angle_v_rad)
        elif self.lens is not None:
            changes["lens"] = self.lens
        return sensor.with_(**changes)


def clipped(theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Clip a mounting to the limits of its parameters."""
    return np.asarray(np.clip(theta, _LEAST, _MOST))


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
    intensity: NDArray[np.float64]
    coverage: NDArray[np.float64]
    alone: NDArray[np.complex128]


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
    """

    def __init__(
        self,
        mesh: trimesh.Trimesh,
        sensor: Sensor,
        poses: KnownPoses,
        *,
        albedo: float,
        background: Background | None = None,
        reports_z: bool = False,
        workers: int = 1,
        rendered: Callable[[], None] = lambda: None,
        track: PoseTrack | None = None,
        stamp_s: NDArray[np.float64] | None = None,
        one: OneFrequency | None = None,
    ) -> None:
        self._track, self._stamp_s = track, stamp_s
        self.scale = np.concatenate([SCALE[: len(MOUNTING_NAMES)], natural_units(sensor)])
        """Natural units, in the order of :data:`ALL_NAMES`; those of the lens of this sensor."""
        self.step = np.where(np.isin(ALL_NAMES, TERMS), self.scale / _DEGREE, 1.0) * STEP
        """Half the width of a difference in each: for terms of the lens, what moves the image by :data:`STEP`."""
        self.sensor, self.poses, self.workers, self._rendered = sensor, poses, workers, rendered
        self._axis_cosine = sensor.axis_cosine() if reports_z else None
        self._albedo = albedo
        self._renderer = Renderer(mesh, sensor if one is None else one.camera, albedo=albedo, harmonics=())
        if one is not None:
            self._renderer = OneFrequencyRenderer(self._renderer, one)
        self._background = background
        walls = poses.wall_m
        if walls is None:
            self._scenes = [(np.arange(len(poses)), background)]
        else:
            base = background or Background()
            self._scenes = [
                (np.flatnonzero(walls == wall), replace(base, wall_m=float(wall))) for wall in np.unique(walls)
            ]

    def mounting(self, theta: NDArray[np.float64]) -> Mounting:
        """Return the mounting that numbers in the order of :data:`ALL_NAMES` mean."""
        return Mounting.of_vector(theta, self.sensor)

    def moved(self, theta: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where a step leads within what a camera can have.

        Where the terms of the lens would fold it inside the image, or make none, their step is halved until they make
        one that does not.

        Parameters
        ----------
        theta, step : (21,) float64
            In the order of :data:`ALL_NAMES`; the first has a lens that does not fold.
        """
        there = clipped(theta + step)
        n = len(MOUNTING_NAMES)
        there[n:] = farthest_lens(self.sensor, theta[n:], there[n:])
        return there

    def beside(self, theta: NDArray[np.float64], column: int, away: float) -> NDArray[np.float64]:
        """Return numbers with one of them moved, as far as :meth:`moved` lets it."""
        step = np.zeros(len(theta))
        step[column] = away
        return self.moved(theta, step)

    def span(self, theta: NDArray[np.float64], column: int, half: float) -> float:
        """Return how far apart the ends of a difference are: less than twice its half width next to a fold."""
        ends = [float(self.beside(theta, column, side * half)[column]) for side in (1.0, -1.0)]
        return ends[0] - ends[1] or 2 * half

    @property
    def has_background(self) -> bool:
        """Whether anything is known to stand behind the landmark."""
        return any(background is not None for _, background in self._scenes)

    @property
    def reach_m(self) -> float:
        """Distance of the landmark's farthest point from its origin."""
        return self._renderer.topology.radius_m

    def check_behind(self, theta: NDArray[np.float64], slack_m: float) -> None:
        """Refuse walls and floors that cut the landmark by more than a mounting may be off.

        Parameters
        ----------
        theta : (21,) float64
            Initial guess of the mounting.
        slack_m : float

        Raises
        ------
        UsageError
        """
        views = self._views(theta, np.zeros((len(self.poses), 3))).in_camera(self.mounting(theta).on(self.sensor))
        views = replace(views, distance_m=views.distance_m - slack_m, height_m=views.height_m + slack_m)
        for which, background in self._scenes:
            if background is not None:
                background.check_behind(self._renderer.topology.vertices, views[which])

    def lens_within(self) -> NDArray[np.bool_]:
        """Return from which poses the lens would stand in the landmark's foot print, (K,)."""
        vertices = self._renderer.topology.vertices[:, :2]
        distance, delta = self.poses.distance_m[:, None], self.poses.delta_rad
        lens = -distance * np.column_stack([np.cos(delta), np.sin(delta)])
        return np.asarray(((lens > vertices.min(axis=0)) & (lens < vertices.max(axis=0))).all(axis=1))

    def images(self, theta: NDArray[np.float64], shift: NDArray[np.float64], *, need_alone: bool = False) -> Images:
        """Render all poses.

        Parameters
        ----------
        theta : (21,) float64
            The mounting.
        shift : (K, 3) or (K, 4) float64
            What is added to the poses, :data:`POSE` and the height.
        need_alone : bool
            Whether the landmark alone is wanted even where nothing else is made of it.
        """
        mounting = self.mounting(theta)
        views = self._views(theta, shift)
        image = self._render(mounting, views)
        alone = image
        brighter = mounting.albedo / self._albedo - 1
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
        theta: NDArray[np.float64],
        shift: NDArray[np.float64],
        free: Sequence[str],
        on: ResidualKind,
        *,
        of_poses: bool = False,
        width: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return how the images change, by central differences.

        On ranges the difference is one of phases, not of phasors: a pixel that an edge is just leaving has hardly any
        light at one end, and its range is as smooth as any other.

        Parameters
        ----------
        theta, shift
            As for :meth:`images`.
        free : sequence of str
            Parameters.
        on : {"ranges", "phasors"}
        of_poses : bool
            Whether the poses are uncertain too.
        width : (21,) float64, optional
            Half width of each difference; at least :attr:`step`.

        Returns
        -------
        (K, p, pixels) complex128
            Change of the phasor by each of `free`; on ranges that of its logarithm, i times the phase, 0 where nothing
            is seen at either end.
        (K, 3, pixels) complex128
            By :data:`POSE`; (K, 0, pixels) without `of_poses`.
        """
        half = self.step if width is None else np.maximum(width, self.step)

        def moved(name: str | None, column: int, side: float) -> NDArray[np.complex128]:
            there, shifted = theta.copy(), shift.copy()
            if name is None:
                shifted[:, column] += side * STEP
            elif name in TERMS:
                there = self.beside(theta, column, side * half[column])
            else:
                there[column] += side * half[column]
            return self.images(there, shifted).phasor

        def difference(job: tuple[str | None, int]) -> NDArray[np.complex128]:
            name, column = job
            span = 2 * (STEP if name is None else half[column])
            if name in TERMS:
                span = self.span(theta, column, half[column])
            high, low = moved(name, column, 1.0), moved(name, column, -1.0)
            if on == "phasors":
                return np.asarray((high - low) / span)
            return np.asarray(1j * np.angle(high * low.conj()) / span)

        rendered = [name for name in free if name != "range_offset" and (name != "albedo" or on == "ranges")]
        columns = [] if not of_poses else [0, 1] if "bearing" in rendered else [0, 1, 2]
        jobs: list[tuple[str | None, int]] = [(name, ALL_NAMES.index(name)) for name in rendered]
        jobs += [(None, column) for column in columns]
        with ThreadPoolExecutor(self.workers) as pool:
            found = list(pool.map(difference, jobs))
        by_name = dict(zip(rendered, found, strict=False))
        by_pose = found[len(rendered) :]
        if of_poses and "bearing" in rendered:
            by_pose.append(by_name["bearing"])
        if set(free) - set(rendered):
            image = self.images(theta, shift, need_alone=on == "phasors" and "albedo" in free)
            later = 1.0 if on == "ranges" else image.phasor
            by_name["range_offset"] = np.broadcast_to(1j * later / self.sensor.metres_per_radian, image.phasor.shape)
            by_name.setdefault("albedo", image.alone / theta[ALL_NAMES.index("albedo")])
        k, pixels = len(self.poses), self.sensor.rows * self.sensor.cols
        empty = np.zeros((k, 0, pixels), np.complex128)
        return (
            np.stack([by_name[name] for name in free], axis=1) if free else empty,
            np.stack(by_pose, axis=1) if of_poses else empty,
        )

    def coverage(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share of each pixel that sees the landmark, (K, pixels)."""
        mounting = self.mounting(theta)
        views = self._views(theta, np.zeros((len(self.poses), 3)))
        return self._render(mounting, views, alone=True).coverage.reshape(len(views), -1)

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

    def pose_rates(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rates of distance, δ, bearing and height at the frames' times, (K, 4) per second; 0 if still."""
        if self._track is None or self._stamp_s is None:
            return np.zeros((len(self.poses), 4))
        return self._track.at(self._stamp_s + theta[ALL_NAMES.index("delay")])[1]

    def _views(self, theta: NDArray[np.float64], shift: NDArray[np.float64]) -> Views:
        poses = self.poses
        seen = np.column_stack([poses.distance_m, poses.delta_rad, poses.bearing_rad, poses.height_m])
        if self._track is not None and self._stamp_s is not None:
            seen = self._track.at(self._stamp_s + theta[ALL_NAMES.index("delay")])[0]
        seen = seen.copy()
        seen[:, : shift.shape[1]] += shift
        return Views(*np.ascontiguousarray(seen.T))

    def _render(self, mounting: Mounting, views: Views, *, alone: bool = False) -> PhasorImages:
        renderer = self._renderer.seen_by(mounting.on(self.sensor))
        vertices = self._renderer.topology.vertices
        self._rendered()

        def seen(views: Views, background: Background | None) -> PhasorImages:
            if background is not None:
                background = background.giving_way(vertices, views.in_camera(renderer.sensor))
            return renderer.render_views(views, background=background)

        if alone or len(self._scenes) == 1:
            return seen(views, None if alone else self._scenes[0][1])
        parts = [seen(views[which], background) for which, background in self._scenes]
        back = np.argsort(np.concatenate([which for which, _ in self._scenes]))
        phasor, intensity, coverage = (
            np.concatenate([getattr(part, name) for part in parts])[back]
            for name in ("phasor", "intensity", "coverage")
        )
        return PhasorImages(phasor, intensity, coverage, renderer.sensor, views)
