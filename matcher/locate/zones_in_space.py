"""Stops of a robot that is tilted, or higher or lower than the map says: zones of the map's scene, with their slopes.

The depth of a zone is the mean over its footprint, a triangle of directions along the rows and along the columns,
weighted with the light that returns: that of small cells, which the renderer integrates exactly. A zone's slopes are
those by the six motions of its camera, differences of two renderings, times the motions of the camera by the unknowns
of the stop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.locate.kernel_arguments import Prediction, Scan
from phasemark.matcher.locate.scan_fit import StopModel
from phasemark.matcher.locate.scan_rows import AGE, N_BODY, N_ROWS, N_TILT, SENSOR_YAW
from phasemark.matcher.locate.wall_map import WallMap
from phasemark.render import Scene, SceneRenderer
from phasemark.render.rigid import tilt2level
from phasemark.render.sensor import Sensor

_Float = NDArray[np.float64]

_CELLS = 4
"""Cells along the side of a zone."""
_LEAST_SEEN = 1e-6
"""Share of a footprint that must be on the map for a zone to have a depth."""
_STEP = 5e-4
"""Metres and radians of a camera's motions: images are exact to some 1e-7 m, and straight over a tenth of a cell."""


@dataclass(frozen=True, eq=False)
class _Camera:
    """One sensor as a camera of small cells, and the weight that each row and each column of cells has in zones."""

    renderer: SceneRenderer
    of_rows: _Float
    """(R, cell rows)."""
    of_columns: _Float
    """(C, cell columns)."""
    cosine: _Float
    """(cell rows, cell columns): of the angle to the boresight."""

    @classmethod
    def of(cls, scene: Scene, zones: tuple[int, int], steps_rad: tuple[float, float], footprint: float) -> Self:
        """Return the camera of a sensor, by its rows and columns and the angles between neighbours."""
        (up, of_rows), (across, of_columns) = (
            _triangles(n, step, footprint) for n, step in zip(zones, steps_rad, strict=True)
        )
        sensor = Sensor(kind="direct", rows=len(up) - 1, cols=len(across) - 1, modulation_hz=1e3,
                        half_angle_v_deg=math.degrees(math.atan(up[0])),
                        half_angle_h_deg=math.degrees(math.atan(across[0])))  # fmt: skip
        return cls(SceneRenderer(scene, sensor), of_rows, of_columns, sensor.axis_cosine())

    def zones(self, camera2world: _Float) -> tuple[_Float, _Float]:
        """Return the mean depth of each zone, NaN where it sees nothing, and its spread, (n, R, C) each."""
        image = self.renderer.phasors(camera2world)
        depth = np.where(image.coverage > 0, image.range_m, 0.0) * self.cosine
        light, first, second = (
            self.of_rows @ (image.intensity * depth**power) @ self.of_columns.T for power in (0, 1, 2)
        )
        seen = self.of_rows @ image.coverage @ self.of_columns.T > _LEAST_SEEN
        light = np.where(seen, light, np.nan)
        mean = first / light
        return mean, np.sqrt(np.fmax(second / light - mean**2, 0.0))


def _triangles(zones: int, step_rad: float, footprint: float) -> tuple[_Float, _Float]:
    """Return falling tangents of the edges of cells, and the share of each zone's triangle in each cell."""
    centre = np.tan((0.5 * (zones - 1) - np.arange(zones)) * step_rad)
    width = 0.5 * footprint * step_rad * (1 + centre**2)
    last = centre[0] + width[0]
    count = math.ceil(_CELLS * last / (centre[0] + 0.5 * step_rad) * zones)
    edges = np.linspace(last, -last, count + 1)
    at = np.clip((edges - centre[:, None]) / width[:, None], -1.0, 1.0)
    before = 0.5 + at - 0.5 * at * np.abs(at)  # integral of the triangle 1 − |t|
    return edges, before[:, :-1] - before[:, 1:]


@dataclass(frozen=True, eq=False)
class SpaceModel(StopModel):
    """A rig among the bodies of a map, whose height, pitch and roll are unknowns of a stop, too.

    Parameters
    ----------
    wall_map : WallMap
    """

    wall_map: WallMap
    cameras: tuple[_Camera, ...] = field(init=False)

    def __post_init__(self) -> None:
        scene, cameras, made = self.wall_map.scene(), [], dict[tuple[int, float, float, int, float], _Camera]()
        across, numbers = np.abs(self.numbers.step_rad) * self._level, self.numbers
        for (rows, up), *own in zip(self.rig.rows(), across, numbers.columns, numbers.footprint, strict=True):
            key = rows, up, float(own[0]), int(own[1]), float(own[2])
            if key not in made:
                made[key] = _Camera.of(scene, (rows, key[3]), (up, key[2]), key[4])
            cameras.append(made[key])
        object.__setattr__(self, "cameras", tuple(cameras))

    @cached_property
    def _level(self) -> _Float:
        """How far along the level the rows that are reduced see for a depth of one, (S,)."""
        return np.array([level.mean() for level in self.rig.levels()])

    @property
    def unknowns_std(self) -> _Float:
        """Standard deviations of the unknowns of a stop beyond its pose, (6 + 2 S,)."""
        stop = self.rig.stop
        tilt = math.radians(stop.tilt_deg)
        return np.concatenate([super().unknowns_std, np.maximum([stop.height_m, tilt, tilt], 1e-9)])

    def prediction(self, theta: _Float, scan: Scan, walls: bool = False) -> Prediction:
        """Return the depths that zones should show; a pose within a body shows none."""
        frames, sensors, zones = scan.depth_m.shape
        rows = max(rows for rows, _ in self.rig.rows())
        shape = frames, sensors, rows, zones // rows
        depth, spread = np.full(shape, np.nan), np.zeros(shape)
        slope = np.zeros((*shape, N_ROWS + N_TILT))
        poses, motion = self._poses(theta, scan)
        place = np.r_[0:N_BODY, N_ROWS : N_ROWS + N_TILT, SENSOR_YAW]
        common = [*range(N_BODY), *range(N_BODY + 2 * sensors, len(theta))]
        for s, camera in enumerate(self.cameras):
            views = np.concatenate([poses[:, s, None], poses[:, s, None] @ _NUDGES], axis=1)
            try:
                mean, width = camera.zones(views.reshape(-1, 4, 4))
            except UsageError:  # the lens is inside a body
                continue
            mean, width = (value.reshape(frames, len(_NUDGES) + 1, *value.shape[1:]) for value in (mean, width))
            scale = self.numbers.scale[s] * self._level[s]  # without what a level wall gains
            high, count = mean.shape[2:]
            depth[:, s, :high, :count] = scale * mean[:, 0] + self.numbers.offset_m[s] + theta[N_BODY + s]
            spread[:, s, :high, :count] = width[:, 0]
            by_motion = np.nan_to_num(scale / _STEP * (mean[:, 1:] - mean[:, :1]))
            by_unknown = motion[:, s][:, :, [*common, N_BODY + sensors + s]]
            slope[:, s][:, :high, :count, place] = np.einsum("fmrc,fmp->frcp", by_motion, by_unknown)
        flat, no_walls = scan.depth_m.shape, np.empty((0, sensors, zones, 0))
        return Prediction(depth.reshape(flat), slope.reshape(*flat, -1), spread.reshape(flat), no_walls)

    def _poses(self, theta: _Float, scan: Scan) -> tuple[_Float, _Float]:
        """Return camera2world, (F, S, 4, 4), and each camera's six motions by each unknown, (F, S, 6, p)."""
        step = 1e-6
        nudged = step * np.eye(len(theta))
        poses = _camera_poses(np.vstack([theta, theta + nudged, theta - nudged]), scan, self)
        here, plus, minus = poses[0], poses[1 : len(theta) + 1], poses[len(theta) + 1 :]
        back = np.swapaxes(here[..., :3, :3], -1, -2)
        moved = back @ (plus[..., :3, :] - minus[..., :3, :]) / (2 * step)
        turned = np.stack([moved[..., 2, 1], moved[..., 0, 2], moved[..., 1, 0]], axis=-1)
        return here, np.moveaxis(np.concatenate([moved[..., 3], turned], axis=-1), 0, -1)


def _nudges() -> _Float:
    """Return the six motions of a camera in its own frame, forward, left, up, and turns about these, (6, 4, 4)."""
    out = np.tile(np.eye(4), (6, 1, 1))
    cos, sin = math.cos(_STEP), math.sin(_STEP)
    for k in range(3):
        out[k, k, 3] = _STEP
        i, j = (k + 1) % 3, (k + 2) % 3
        out[3 + k, i, i] = out[3 + k, j, j] = cos
        out[3 + k, j, i], out[3 + k, i, j] = sin, -sin
    return out


_NUDGES = _nudges()


def _turns(yaw_rad: _Float, pitch_rad: _Float, roll_rad: _Float) -> _Float:
    """Return Rz(yaw) · Ry(pitch) · Rx(roll), (n, 3, 3); a positive pitch looks down."""
    about = np.zeros((len(yaw_rad), 3, 3))
    about[:, 0, 0] = about[:, 1, 1] = np.cos(yaw_rad)
    about[:, 1, 0], about[:, 2, 2] = np.sin(yaw_rad), 1.0
    about[:, 0, 1] = -about[:, 1, 0]
    return np.asarray(about @ tilt2level(pitch_rad, roll_rad))


def _camera_poses(theta: _Float, scan: Scan, model: SpaceModel) -> _Float:
    """Return camera2world for each of (m, p) unknowns, (m, F, S, 4, 4)."""
    rig, numbers, sensors = model.rig, model.numbers, len(model.rig.sensor)
    drift, age = theta[:, None, None, 3:5], theta[:, None, None, AGE]
    when = scan.time_s[:, None] - numbers.delay_s - age
    moved = np.stack(
        [np.interp(when, scan.odometry_time_s, scan.odometry[:, k]) for k in range(3)], axis=-1
    )  # (m, F, S, 3)
    step = moved[..., :2] + drift * scan.time_s[:, None, None]
    cos, sin = np.cos(theta[:, None, None, 2]), np.sin(theta[:, None, None, 2])
    height, pitch, roll = theta[:, N_BODY + 2 * sensors :].T
    shape = step.shape[:3]
    place = np.stack([theta[:, None, None, 0] + cos * step[..., 0] - sin * step[..., 1],
                      theta[:, None, None, 1] + sin * step[..., 0] + cos * step[..., 1],
                      np.broadcast_to(model.wall_map.height_m + height[:, None, None], shape)], axis=-1)  # fmt: skip
    yaw = theta[:, None, None, 2] + moved[..., 2]
    tilts = (np.broadcast_to(value[:, None, None], shape).ravel() for value in (pitch, roll))
    body = _turns(yaw.ravel(), *tilts).reshape(*shape, 3, 3)
    own_yaw = numbers.yaw_rad + theta[:, N_BODY + sensors : N_BODY + 2 * sensors]  # (m, S)
    own = [np.broadcast_to(np.radians([getattr(one, name) for one in rig.sensor]), own_yaw.shape).ravel()
           for name in ("pitch_deg", "roll_deg")]  # fmt: skip
    mounted = _turns(own_yaw.ravel(), *own).reshape(-1, 1, sensors, 3, 3)
    lever = np.column_stack([numbers.x_m, numbers.y_m, [one.z_m for one in rig.sensor]])
    out = np.zeros((*shape, 4, 4))
    out[..., 3, 3] = 1.0
    out[..., :3, :3] = body @ mounted
    out[..., :3, 3] = place + (body @ lever[..., None])[..., 0]
    return out
