"""Rig files: several sensors on one robot, how well each is known, and the unknowns that every stop has of its own."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from phasemark import UsageError
from phasemark.data.plans.bank_plan import PlanModel, read_plan, sensor_in_folder, sensor_of
from phasemark.inputs.toml_file import toml_text
from phasemark.matcher.locate.kernel_arguments import Outline, RigNumbers
from phasemark.matcher.locate.plane import turn_of
from phasemark.matcher.locate.wall_map import WallMap

_Float = NDArray[np.float64]
_Number = Annotated[float, Field(allow_inf_nan=False)]
_Positive = Annotated[float, Field(ge=1e-6, le=1e6)]
_Size = Annotated[float, Field(ge=0, le=1e6)]


_LEVEL_ROUNDS = 20
_LEAST_LEVEL = 0.3
"""How far along the level a row must see, at least, for a depth of one."""


class SensorStd(PlanModel):
    """Standard deviations of what a rig file states of a sensor, before a calibration."""

    yaw_deg: _Size = 2.0
    position_m: _Size = 0.001
    delay_s: _Size = 0.03
    range_offset_m: _Size = 0.01
    range_scale: _Size = 0.01
    fov_deg: _Size = 2.4


class RigSensor(PlanModel):
    """One sensor of a rig.

    Parameters
    ----------
    name : str
        Name that the recording has for it.
    preset : str
        A preset or a sensor file: columns and field of view, unless stated here.
    x_m, y_m, z_m : float
        Place in the robot's frame: x forward, y left.
    yaw_deg, pitch_deg : float
        Direction of the boresight; a positive pitch looks down, and lengthens depths of a vertical wall.
    roll_deg : 0 or 180
        A sensor upside down has its columns the other way round.
    delay_s : float
        Age of its data when the odometry of a frame is read.
    range_offset_m, range_scale : float
        A depth d is reported as scale · d + offset.
    columns, rows : int, optional
    fov_deg : float, optional
        Full horizontal field of view.
    footprint_columns : float
        Base of the triangle that a column sees, in columns.
    std : SensorStd
    """

    name: Annotated[str, Field(min_length=1, max_length=100)]
    preset: str = "vl53l5cx-8x8"
    x_m: _Number = 0.0
    y_m: _Number = 0.0
    z_m: _Number = 0.0
    yaw_deg: _Number = 0.0
    pitch_deg: Annotated[float, Field(gt=-60, lt=60)] = 0.0
    roll_deg: Literal[0, 180] = 0
    delay_s: _Number = 0.0
    range_offset_m: _Number = 0.0
    range_scale: _Positive = 1.0
    columns: Annotated[int, Field(ge=1, le=4096)] | None = None
    rows: Annotated[int, Field(ge=1, le=4096)] | None = None
    fov_deg: Annotated[float, Field(gt=0, lt=120)] | None = None
    footprint_columns: Annotated[float, Field(gt=0, le=10)] = 2.5
    std: SensorStd = SensorStd()


class Reduction(PlanModel):
    """Rows of zones that one number of a column is made from: the first and the last, counted from 0 at the top."""

    rows: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] | None = None
    how: Literal["median", "mean"] = "median"
    valid_status: tuple[int, ...] = (5, 9)


class RangeNoise(PlanModel):
    """Noise of a column: σ² = (floor_m + share · depth)² + (edge_share · spread of depth in its footprint)².

    A share `outliers` of the columns sees something else, anywhere up to `max_range_m`.
    """

    floor_m: _Positive = 0.0045
    share: _Size = 0.008
    edge_share: _Size = 1.0
    outliers: Annotated[float, Field(gt=0, lt=1)] = 0.05
    max_range_m: _Positive = 4.0


class StopUnknowns(PlanModel):
    """Standard deviations of what differs from stop to stop and is eliminated.

    Drift of the odometry while a stop is scanned, age of the data, and of each sensor an offset of its range and of its
    yaw; where they are asked for, the robot's height about that of the map, and its pitch and roll about 0. A value of
    0 leaves one out.
    """

    drift_m_s: _Size = 0.015
    age_s: _Size = 0.004
    offset_m: _Size = 0.005
    yaw_deg: _Size = 0.3
    height_m: _Size = 0.05
    tilt_deg: _Size = 3.0


class OdometryDrift(PlanModel):
    """Standard deviations of a step of the odometry from one stop to the next.

    Of each coordinate the root of the squares of `position_m` and of `per_m` times the way; of the heading `yaw_deg`.
    """

    per_m: _Size = 0.1
    position_m: _Positive = 0.05
    yaw_deg: _Positive = 1.0

    def covariance(self, step: _Float) -> _Float:
        """Return the covariance of a step x, y (m), yaw (rad) in the body's frame, (3, 3)."""
        position = math.hypot(self.position_m, self.per_m * math.hypot(step[0], step[1]))
        return np.diag(np.square([position, position, math.radians(self.yaw_deg)]))

    def moved(self, mean: _Float, covariance: _Float, step: _Float) -> tuple[_Float, _Float]:
        """Return mean and covariance of a pose after a step in the body's frame."""
        turn = turn_of(mean[2])
        by = turn @ step
        slope = np.array([[1.0, 0.0, -by[1]], [0.0, 1.0, by[0]], [0.0, 0.0, 1.0]])
        return mean + by, slope @ covariance @ slope.T + turn @ self.covariance(step) @ turn.T


class Rig(PlanModel):
    """Sensors of a robot.

    Parameters
    ----------
    sensor : sequence of RigSensor
    quantity : 'z' or 'range'
        Whether the recording holds distances along the boresight or along the ray.
    reduction : Reduction
        For recordings with rows.
    noise : RangeNoise
    stop : StopUnknowns
    odometry : OdometryDrift

    Examples
    --------
    >>> Rig(sensor=[{"name": "front", "x_m": 0.02}]).numbers().columns
    array([8])
    """

    sensor: Annotated[tuple[RigSensor, ...], Field(min_length=1, max_length=64)]
    quantity: Literal["z", "range"] = "z"
    reduction: Reduction = Reduction()
    noise: RangeNoise = RangeNoise()
    stop: StopUnknowns = StopUnknowns()
    odometry: OdometryDrift = OdometryDrift()

    @model_validator(mode="after")
    def _is_a_rig(self) -> Self:
        names = self.names
        for k, name in enumerate(names):
            if name in names[:k]:
                raise UsageError(f"'sensor.{k}.name' must be a name of its own, got {name!r} twice")
        return self

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return tuple(one.name for one in self.sensor)

    def in_folder(self, folder: Path) -> Self:
        """Return the rig of a file in a folder: names of sensor files are relative to it."""
        sensors = (one.model_copy(update={"preset": sensor_in_folder(one.preset, folder)}) for one in self.sensor)
        return self.model_copy(update={"sensor": tuple(sensors)})

    def numbers(self) -> RigNumbers:
        """Return the numbers of the sensors, presets applied.

        Raises
        ------
        UsageError, InputFileError
            A preset that is unknown, a sensor file that cannot be read.
        """
        rows = []
        for one in self.sensor:
            columns, step = _columns_of(one)
            level = float(self._level(one).mean())
            rows.append((math.radians(one.yaw_deg), one.x_m, one.y_m, one.delay_s, one.range_offset_m,
                         one.range_scale / level, step / level, columns, one.footprint_columns))  # fmt: skip
        yaw, x, y, delay, offset, gain, steps, n, footprint = np.array(rows, dtype=np.float64).T.copy()
        return RigNumbers(yaw, x, y, delay, offset, gain, steps, n.astype(np.int64), footprint)

    def outline_of(self, wall_map: WallMap, *, in_space: bool = False) -> Outline:
        """Return the faces of a map that the sensors see, those of all but for the noise of a column.

        Parameters
        ----------
        wall_map : WallMap
        in_space : bool
            Whether it is that of starts alone, and what sensors of several heights see comes after.

        Raises
        ------
        UsageError
            Nothing of the map is as high as the sensors, or sensors of different heights see different faces.
        """
        heights = sorted({one.z_m for one in self.sensor})
        outlines = [wall_map.outline(height) for height in heights]
        first = outlines[0].pieces
        for height, outline in zip(heights, outlines, strict=True):
            alike = outline.pieces.shape == first.shape and np.allclose(outline.pieces, first, 0.0, self.noise.floor_m)
            if not (in_space or alike):
                raise UsageError(
                    f"'z_m' of the sensors must be heights at which the map has the same faces unless height and tilt"
                    f" are estimated, got {heights[0]:g} and {height:g}"
                )
        return outlines[len(outlines) // 2]

    def column_steps_rad(self) -> _Float:
        """Return the angle between neighbouring columns of each sensor, (S,), less than 0 of one that is upside down.

        That of :class:`~phasemark.matcher.locate.kernel_arguments.RigNumbers` is the angle in the level.
        """
        return np.array([_columns_of(one)[1] for one in self.sensor])

    def rows(self) -> list[tuple[int, float]]:
        """Return the number of rows of each sensor, and the angle between neighbours."""
        return [_rows_of(one) for one in self.sensor]

    def levels(self) -> list[_Float]:
        """Return how far along the level the rows that are reduced see for a depth of one, one array a sensor."""
        return [self._level(one) for one in self.sensor]

    def _level(self, one: RigSensor) -> _Float:
        """Return that of one sensor."""
        pitch = math.radians(one.pitch_deg)
        if pitch == 0 or self.reduction.rows is None:  # what is above the boresight makes up for what is below
            return np.full(1, math.cos(pitch))
        (first, last), (rows, step) = self.reduction.rows, _rows_of(one)
        if not first <= last < rows:
            raise UsageError(f"'reduction.rows' of the rig must be within its {rows} rows, got {first, last}")
        above = elevations_rad(rows, step)[first : last + 1] * (1 if one.roll_deg == 0 else -1)
        level: _Float = math.cos(pitch) + np.tan(above) * math.sin(pitch)
        if level.min() < _LEAST_LEVEL:
            raise UsageError(f"'pitch_deg' of {one.name} must let rows {first, last} see ahead, got {one.pitch_deg:g}")
        return level

    def with_numbers(self, numbers: RigNumbers, std: Mapping[str, _Float]) -> Self:
        """Return the rig with calibrated numbers and their standard deviations.

        Parameters
        ----------
        numbers : RigNumbers
        std : mapping of str to (S,) float64
            By the names of :class:`SensorStd`, in its units.
        """
        sensors = []
        for k, one in enumerate(self.sensor):
            columns, fov, level = int(numbers.columns[k]), one.fov_deg, 1.0
            for _ in range(_LEVEL_ROUNDS):  # the elevations of rows grow with the field of view
                level = float(self._level(one.model_copy(update={"fov_deg": fov, "columns": columns})).mean())
                fov = math.degrees(abs(numbers.step_rad[k]) * level) * columns
            update: dict[str, Any] = {
                "yaw_deg": math.degrees(numbers.yaw_rad[k]),
                "x_m": float(numbers.x_m[k]),
                "y_m": float(numbers.y_m[k]),
                "delay_s": float(numbers.delay_s[k]),
                "range_offset_m": float(numbers.offset_m[k]),
                "range_scale": float(numbers.scale[k]) * level,
                "fov_deg": fov,
                "columns": columns,
                "std": one.std.model_copy(update={name: float(value[k]) for name, value in std.items()}),
            }
            sensors.append(one.model_copy(update=update))
        return self.model_copy(update={"sensor": tuple(sensors)})

    def to_toml(self) -> str:
        """Return the rig as the text of a file."""
        content = self.model_dump(mode="json", exclude_none=True)
        content["sensor"] = [
            {key: round(value, 7) if isinstance(value, float) else value for key, value in sensor.items()}
            for sensor in content["sensor"]
        ]
        return toml_text(content)


def read_rig(path: str | os.PathLike[str]) -> Rig:
    """Read a rig from a TOML file.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    Rig

    Raises
    ------
    InputFileError
        The file cannot be read or is not TOML.
    UsageError
        With one line that names the file, the key, the value and what would be right.
    """
    return read_plan(path, Rig)


def _columns_of(one: RigSensor) -> tuple[int, float]:
    """Return the number of columns of a sensor, and the angle between neighbours, less than 0 if it is upside down."""
    columns, fov = one.columns, one.fov_deg
    if columns is None or fov is None:
        base = sensor_of(one.preset, {})
        columns = columns or base.cols
        fov = fov or 2 * float(base.half_angle_h_deg)
    return columns, math.radians(fov) / columns * (1 if one.roll_deg == 0 else -1)


def _rows_of(one: RigSensor) -> tuple[int, float]:
    """Return the number of rows of a sensor, and the angle between neighbours, in the proportion of its preset."""
    base, (columns, step) = sensor_of(one.preset, {}), _columns_of(one)
    rows = one.rows or base.rows
    return rows, abs(step) * columns / rows * float(base.half_angle_v_deg) / float(base.half_angle_h_deg)


def elevations_rad(rows: int, step_rad: float) -> _Float:
    """Return the elevation of each row above the boresight, (rows,), row 0 the highest."""
    return np.asarray((0.5 * (rows - 1) - np.arange(rows)) * step_rad, np.float64)
