"""Time-of-flight sensor inside a MuJoCo simulation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.direct.capture import capture
from phasemark.render.direct.histogram_frames import HistogramFrames
from phasemark.render.direct.histogram_images import HistogramImages
from phasemark.render.frames import Frames
from phasemark.render.phasor_images import PhasorImages
from phasemark.render.scene import NEEDS_MUJOCO
from phasemark.render.scene.mujoco_scene import body_name, seen_model
from phasemark.render.scene.scene import Scene
from phasemark.render.scene.scene_renderer import SceneRenderer
from phasemark.render.sensor.range_noise import measured_range_std
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.sensor.shipped_sensors import preset

try:
    import mujoco
except ImportError:
    raise UsageError(NEEDS_MUJOCO) from None

__all__ = ["TofReading", "TofSensor", "TofTruth"]

_CAMERA_AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""Forward, left and up in the frame of a MuJoCo camera, as columns: it looks along −z, y is up."""
_SITE_AXES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""The same of a site: as a MuJoCo rangefinder it looks along z, and y is up."""
_GROUPS = 6
_NO_NORMALS = {"normal": None} if "normal:" in mujoco.mj_multiRay.__doc__ else {}
"""Argument of rays since they can return normals."""
_ON_TIME = 1e-6
"""Share of a period by which a sum of time steps may miss a multiple of it."""
_OTHER_MODEL = (
    "'data' must be a mujoco.MjData of the sensor's model, as it was when the sensor was made: with other geoms make"
    " another sensor; with other terrain, meshes or colours too"
)

_Reported = tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class TofTruth:
    """Truth behind a frame.

    Parameters
    ----------
    z_m : (rows, cols) float64
        Distance along the sensor's axis at the centre ray of each zone, as MuJoCo's own rays meet it: those pass
        planes from behind and what either a geom's own colour or its material makes invisible; NaN where there is
        nothing.
    shares : (rows, cols, b) float64
        Share of each zone that each MuJoCo body fills.
    bodies : tuple of str
        Names of these bodies.
    """

    z_m: NDArray[np.float64]
    shares: NDArray[np.float64]
    bodies: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class TofReading:
    """One frame as the sensor reports it.

    Parameters
    ----------
    time_s : float
        Simulated time of the scene that it shows.
    number : int
        Of the frame, counted from the start or reset.
    distance_m : (rows, cols) float64
        The nearest target: along the ray, or along the axis where ``sensor.quantity`` is "z"; NaN where there is none.
    status : (rows, cols) uint8
        0 where the distance is valid; otherwise :class:`~phasemark.render.direct.Status` of a direct sensor,
        :class:`~phasemark.render.Flag` of a phase camera.
    sigma_m : (rows, cols) float64
        Standard deviation of the distance as the sensor estimates it.
    signal : (rows, cols) float64
        Counts above ambient light, or electrons of amplitude. A direct sensor without a [histogram] table gives
        neither: NaN.
    frames : HistogramFrames or Frames
        All that was captured: histograms (``frames.counts``) and all targets of a zone (``frames.targets``), or
        ranges, amplitudes and flags.
    truth : TofTruth
    """

    time_s: float
    number: int
    distance_m: NDArray[np.float64]
    status: NDArray[np.uint8]
    sigma_m: NDArray[np.float64]
    signal: NDArray[np.float64]
    frames: HistogramFrames | Frames
    truth: TofTruth

    @property
    def histogram(self) -> NDArray[np.float64] | None:
        """Photon counts, (rows, cols, bins); None for a sensor without histograms."""
        return self.frames.counts[0, 0] if isinstance(self.frames, HistogramFrames) else None


class Cadence:
    """Schedule of frames that are exposed at a rate and reported some frames later, held until the next.

    The first frame is exposed when the time is first asked for, frame k of the following ones k periods later. Before
    that the sensor has looked at the same scene. What lies between two times that are asked for is not known: a frame
    shows the scene at the first of these that is not before its own.

    Parameters
    ----------
    rate_hz : float
    latency_frames : int
        Periods between a frame's exposure and its report.

    Raises
    ------
    UsageError
        The rate is not positive, or the latency negative.
    """

    def __init__(self, rate_hz: float, latency_frames: int) -> None:
        if not isinstance(rate_hz, int | float | np.number) or not (math.isfinite(rate_hz) and rate_hz > 0):
            raise UsageError(f"'rate_hz' must be positive, got {rate_hz!r}")
        if not isinstance(latency_frames, int | np.integer) or latency_frames < 0:
            raise UsageError(f"'latency_frames' must be 0, 1, 2, …, got {latency_frames!r}")
        self.rate_hz, self.latency_frames = float(rate_hz), int(latency_frames)
        self.restart()

    def restart(self) -> None:
        """Forget all frames: the next time that is asked for is the first."""
        self._start_s: float | None = None
        self._last_s, self._exposed = -math.inf, -1

    def restarts(self, time_s: float) -> bool:
        """Return True if a time is the first, or before the last."""
        return self._start_s is None or time_s < self._last_s

    def frames(self, time_s: float) -> tuple[range, int]:
        """Return the frames that are exposed at a time, and the one that is reported.

        Parameters
        ----------
        time_s : float
            Not before the last one.

        Returns
        -------
        exposed : range
            Numbers of frames, counted from the start.
        reported : int
            Number of the frame that was finished last.
        """
        if self._start_s is None:
            self._start_s = time_s
        self._last_s = time_s
        reported = math.floor((time_s - self._start_s) * self.rate_hz + _ON_TIME)
        newest = reported + self.latency_frames
        exposed = range(max(self._exposed + 1, reported), newest + 1)
        self._exposed = newest
        return exposed, reported


class TofSensor:
    """Time-of-flight sensor on a camera or site of a MuJoCo model.

    Shapes, sizes and colours are read here, poses with every :meth:`read`: after a change of the model's geoms make
    another. Planes are seen from both sides; an infinite one is a square of 2 km about the sensor. A geom with alpha 0
    is invisible, others are opaque. Textures, lights, flexes and skins are not modelled.

    Parameters
    ----------
    model : mujoco.MjModel
    camera, site : str or int
        Where the sensor is, one of the two, by name or number. It looks as MuJoCo's camera along −z with y up, or as a
        rangefinder along the z axis of the site, with y up and x to the left. The sensor has its own field of view:
        the camera's is not used.
    sensor : str or Sensor
        Name of a preset, or a sensor.
    albedo : "rgba", float, or mapping from names of geoms to float
        Luminance (Rec. 709) of each geom's or its material's colour, one albedo for all, or that of some geoms and the
        luminance for the others.
    exclude_body : str or int, optional
        Body whose own geoms are left out, as the housing of the sensor.
    groups : sequence of int
        Groups of geoms that the sensor sees: those that MuJoCo's viewer shows.
    smooth : bool
        Whether normals are interpolated between faces of meshes and height fields that meet at less than 30°, as on
        surfaces that are curved in truth; False: every facet is flat, as for MuJoCo's rays, which takes longer.
    rate_hz : float, optional
        Frames per second of simulated time; None: ``frame_rate_hz`` of the sensor.
    latency_frames : int
        Frames between exposure and report; 0: none.
    rays : int, optional
        As for :class:`~phasemark.render.SceneRenderer`; None: exact.
    seed : int
        Of the noise: the same readings for the same seed and states. Sensors on other cameras or sites have others.

    Raises
    ------
    UsageError
        There is no camera, site, body or preset of a name, both or neither of camera and site are given, a geom is of a
        type that cannot be rendered, or a number is out of range.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        camera: str | int | None = None,
        site: str | int | None = None,
        sensor: str | Sensor = "vl53l8cx-8x8",
        albedo: str | float | Mapping[str, float] = "rgba",
        exclude_body: str | int | None = None,
        groups: Sequence[int] = (0, 1, 2),
        smooth: bool = True,
        rate_hz: float | None = None,
        latency_frames: int = 1,
        rays: int | None = None,
        seed: int = 0,
    ) -> None:
        if not isinstance(model, mujoco.MjModel):
            raise UsageError(f"'model' must be a mujoco.MjModel, got {type(model).__name__}")
        if (camera is None) == (site is None):
            raise UsageError("a sensor is on a camera or on a site: give camera=… or site=…, and not both")
        if not isinstance(groups, Iterable) or not set(groups) <= set(range(_GROUPS)):
            raise UsageError(f"'groups' must be numbers from 0 to {_GROUPS - 1}, got {groups!r}")
        self.model = model
        self._has_colours = isinstance(albedo, str)
        self._layout, self._shapes = _layout(model), _shapes(model, self._has_colours)
        self.sensor = sensor if isinstance(sensor, Sensor) else preset(sensor)
        self._site = None if site is None else _number(model, "site", site)
        self._camera = None if camera is None else _number(model, "camera", camera)
        self._stream = (0, self._camera or 0) if self._site is None else (1, self._site)
        self._exclude = -1 if exclude_body is None else _number(model, "body", exclude_body)
        self._groups = np.isin(np.arange(_GROUPS), groups).astype(np.uint8)
        self.seen = seen_model(model, albedo, self._exclude, groups, smooth)
        self.renderer = SceneRenderer(Scene(self.seen.bodies), self.sensor, rays=rays)
        bodies = np.unique(self.seen.owner)
        self._of_body = (self.seen.owner[:, None] == bodies).astype(np.float64)
        self.bodies = tuple(body_name(model, int(b)) for b in bodies)
        self._rays, self._cosine = self.sensor.pixel_directions().reshape(-1, 3), self.sensor.axis_cosine()
        self._cadence = Cadence(self.sensor.frame_rate_hz if rate_hz is None else rate_hz, latency_frames)
        self._kept: dict[int, TofReading] = {}
        self.reset(seed)

    def __repr__(self) -> str:
        """Describe in one line the sensor, the scene and the rate."""
        return f"TofSensor({self.sensor!r}, {self.renderer.scene!r}, {self._cadence.rate_hz:g} Hz)"

    def reset(self, seed: int | None = None) -> None:
        """Start again with the next reading, with other noise, or with that of a seed.

        Parameters
        ----------
        seed : int, optional

        Raises
        ------
        UsageError
            The seed is negative or no whole number.
        """
        if seed is not None and (not isinstance(seed, int | np.integer) or seed < 0):
            raise UsageError(f"'seed' must be a whole number, at least 0, got {seed!r}")
        self._cadence.restart()
        if seed is not None:
            self._seed, self._run = seed, -1

    def read(self, data: mujoco.MjData) -> TofReading:
        """Return the frame that the sensor finished last.

        Between two frames that is the same one. With the first reading, and where the time went back, the sensor
        starts: it has looked at the present scene before. Poses are those in `data`; ``mj_step`` leaves those from
        before its last step there.

        Parameters
        ----------
        data : mujoco.MjData
            Of the sensor's model.

        Raises
        ------
        UsageError
            The data is of another model, or the model's geoms have changed since, a pose or the time is not finite, no
            pose has been computed yet, or the lens is inside a body.
        """
        if not isinstance(data, mujoco.MjData) or _layout(data.model) != self._layout:
            raise UsageError(_OTHER_MODEL)
        time_s = float(data.time)
        if not math.isfinite(time_s):
            raise UsageError(f"the time of the data is {time_s}")
        if self._cadence.restarts(time_s):
            self.reset()
            self._run += 1
            self._kept = {}
        exposed, reported = self._cadence.frames(time_s)
        if exposed:
            try:
                self._kept |= self._expose(data, exposed)
            except UsageError:
                self.reset()
                raise
            self._kept = {number: kept for number, kept in self._kept.items() if number >= reported}
        return self._kept[reported]

    def _expose(self, data: mujoco.MjData, numbers: range) -> dict[int, TofReading]:
        """Take frames of the present scene."""
        if _shapes(data.model, self._has_colours) != self._shapes:
            raise UsageError(_OTHER_MODEL)
        camera2world = self.camera2world(data)
        poses = self.seen.poses(data, camera2world[:3, 3])
        wrong = ~np.isfinite(poses).all(axis=(1, 2))
        if wrong.any():
            raise UsageError(f"the pose of body '{self.renderer.scene.names[int(wrong.argmax())]}' is not finite")
        try:
            images = self.renderer.render(camera2world, poses)
        except UsageError as error:
            raise UsageError(f"{str(error).removeprefix('in frame 0 ')}; exclude_body=… leaves one out") from None
        assert images.shares is not None
        truth = TofTruth(self._centre_z(data, camera2world), images.shares[0] @ self._of_body, self.bodies)
        return {number: self._reading(images, float(data.time), number, truth) for number in numbers}

    def _reading(
        self, images: PhasorImages | HistogramImages, time_s: float, number: int, truth: TofTruth
    ) -> TofReading:
        """Take one frame; its noise depends on the seed, the camera or site, and the numbers of run and frame alone."""
        frames: HistogramFrames | Frames = capture(
            images,
            self.sensor,
            rng=np.random.default_rng((self._seed, *self._stream)),
            first_view=self._run,
            first_frame=number,
        )
        of_frame = _targets(frames) if isinstance(frames, HistogramFrames) else _ranges(frames)
        return TofReading(time_s, number, *of_frame, frames, truth)

    def camera2world(self, data: mujoco.MjData) -> NDArray[np.float64]:
        """Return the pose of the camera's mount, x forward, y left, z up."""
        pose = np.eye(4)
        if self._site is not None:
            pose[:3, :3] = data.site_xmat[self._site].reshape(3, 3) @ _SITE_AXES
            pose[:3, 3] = data.site_xpos[self._site]
        else:
            pose[:3, :3] = data.cam_xmat[self._camera].reshape(3, 3) @ _CAMERA_AXES
            pose[:3, 3] = data.cam_xpos[self._camera]
        if not pose[:3, :3].any():
            raise UsageError("the data has no poses yet: call mujoco.mj_forward(model, data) before the first reading")
        if not np.isfinite(pose).all():
            raise UsageError("the pose of the sensor is not finite")
        return pose

    def _centre_z(self, data: mujoco.MjData, camera2world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance along the axis at the centre of each zone, (rows, cols)."""
        rays = self._rays @ (camera2world[:3, :3] @ self.sensor.cam2level).T
        n = len(rays)
        distance, geom = np.empty(n), np.empty(n, np.int32)
        mujoco.mj_multiRay(
            m=self.model, d=data, pnt=camera2world[:3, 3], vec=rays.ravel(), geomgroup=self._groups, flg_static=True,
            bodyexclude=self._exclude, geomid=geom, dist=distance, nray=n, cutoff=mujoco.mjMAXVAL, **_NO_NORMALS,
        )  # fmt: skip
        return np.asarray(np.where(geom >= 0, distance, np.nan).reshape(self._cosine.shape) * self._cosine)


def _layout(model: mujoco.MjModel) -> tuple[bytes, ...]:
    """Return names and geoms: equal for models whose data is that of the same scene, as of one file compiled twice."""
    geoms = ("bodyid", "type", "dataid", "size", "pos", "quat", "group")
    return model.names, *(getattr(model, f"geom_{name}").tobytes() for name in geoms)


def _shapes(model: mujoco.MjModel, with_colours: bool) -> tuple[bytes, ...]:
    """Return meshes and terrain, and the colours where albedos are made of them."""
    colours = ("geom_rgba", "geom_matid", "mat_rgba") if with_colours else ()
    names = ("mesh_vert", "mesh_face", "hfield_data", "hfield_size", *colours)
    return tuple(getattr(model, name).tobytes() for name in names)


def _targets(frames: HistogramFrames) -> _Reported:
    """Return distance, status, sigma and signal of the nearest target in one frame."""
    targets = frames.targets
    nearest = (0, 0, ..., 0)
    return targets.distance_m[nearest], targets.status[nearest], targets.sigma_m[nearest], targets.signal[nearest]


def _ranges(frames: Frames) -> _Reported:
    """Return the same of a camera without histograms."""
    distance_m = frames.z_m if frames.sensor.quantity == "z" else frames.range_m
    sigma = signal = np.full(distance_m.shape, np.nan)
    if frames.amplitude_e is not None and frames.intensity_e is not None:
        sigma, signal = measured_range_std(frames.amplitude_e, frames.intensity_e, frames.sensor), frames.amplitude_e
    return distance_m[0, 0], frames.flags[0, 0], sigma[0, 0], signal[0, 0]


def _number(model: mujoco.MjModel, kind: str, which: str | int) -> int:
    """Return the number of a camera, site or body."""
    count = {"camera": model.ncam, "site": model.nsite, "body": model.nbody}[kind]
    names = [getattr(model, kind)(k).name for k in range(count)]
    if isinstance(which, str) and which in names and which:
        return names.index(which)
    if not isinstance(which, str) and 0 <= which < count:
        return int(which)
    known = ", ".join(f"'{name}'" if name else str(k) for k, name in enumerate(names)) or "none"
    raise UsageError(f"the model has no {kind} {which!r}: there are {known}")
