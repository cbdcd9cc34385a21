"""Plan of a drive: map, path, odometry, camera and rules, as a TOML file or in code."""

from __future__ import annotations

import math
import os
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from phasemark import UsageError
from phasemark.data.plans.bank_plan import PlanModel, read_plan
from phasemark.matcher.position.landmark_map import LandmarkMap, Point, Std, read_landmark_map
from phasemark.matcher.sequence.odometry import OdometryPlan
from phasemark.render import Sensor, preset

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Share = Annotated[float, Field(gt=0, lt=1)]
LEAST_CLEARANCE_M = 0.6
"""A landmark nearer to a wall cannot be distinguished from it."""


class PathPlan(PlanModel):
    """Path of the robot.

    Parameters
    ----------
    waypoints_m : sequence of (x, y)
        Points of the path, metres, with straight lines between them. The robot starts at the first, facing the second.
    speed_m_s : float
        Speed that the wheels report, metres a second.
    lookahead_m : float
        Distance along the path to the point that the robot steers for (pure pursuit), metres.
    turn_limit_deg_s : float
        Largest turning rate, degrees a second.
    step_s : float
        Time between two readings of the odometry, seconds.
    start_std_m : float
        Standard deviation of each coordinate of the first pose, metres.
    start_std_deg : float
        Standard deviation of the first heading, degrees.
    """

    waypoints_m: Annotated[tuple[Point, ...], Field(min_length=2)]
    speed_m_s: _Positive = 0.4
    lookahead_m: _Positive = 0.5
    turn_limit_deg_s: _Positive = 60.0
    step_s: _Positive = 0.05
    start_std_m: Std = 0.005
    start_std_deg: Std = 0.2

    @model_validator(mode="after")
    def _goes_somewhere(self) -> Self:
        for k in range(1, len(self.waypoints_m)):
            if self.waypoints_m[k] == self.waypoints_m[k - 1]:
                raise UsageError(f"'waypoints_m.{k}' must differ from the one before, got {self.waypoints_m[k]}")
        return self

    @property
    def start_covariance(self) -> NDArray[np.float64]:
        """Of (x, y, heading), (3, 3)."""
        return np.diag(np.square([self.start_std_m, self.start_std_m, math.radians(self.start_std_deg)]))


class CameraPlan(PlanModel):
    """The camera on its pan unit.

    Parameters
    ----------
    sensor : str
        Name of a preset.
    n_frames : int
        Number of frames at each stop.
    pan_limit_deg : float
        Largest angle of the pan unit to either side, degrees.
    pan_std_deg : float
        Standard deviation of the pan angle about the one that was set, degrees.
    pan_offset_m : (x, y)
        Place of the pan axis on the robot, metres (PHYSICS section 8).
    lens_offset_m : (x, y)
        Place of the lens on the pan unit, metres.
    wall_albedo : float
        Share of light that the walls of the room return.
    pitch_std_deg, roll_std_deg : float
        Standard deviation of the tilt that an uneven floor gives the camera at a stop, degrees. Above 0, tilts are
        drawn with it, and the matcher estimates them with it as the prior.
    """

    sensor: str = "pmd-16x16"
    n_frames: Annotated[int, Field(ge=2, le=10_000)] = 50
    pan_limit_deg: Annotated[float, Field(gt=0, le=180)] = 150.0
    pan_std_deg: Std = 0.05
    pan_offset_m: Point = (0.10, 0.0)
    lens_offset_m: Point = (0.04, 0.0)
    wall_albedo: Annotated[float, Field(gt=0, le=1)] = 0.5
    pitch_std_deg: Std = 0.0
    roll_std_deg: Std = 0.0

    @property
    def tilt_std_rad(self) -> dict[str, float]:
        """Standard deviations of the tilts that a stop may have, by their names; empty on an even floor."""
        stated = {"pitch_rad": self.pitch_std_deg, "roll_rad": self.roll_std_deg}
        return {name: math.radians(std) for name, std in stated.items() if std > 0}


class StopPlan(PlanModel):
    """Rules for stopping at a landmark and for accepting a match.

    Parameters
    ----------
    distance_m : (low, high)
        Nearest and farthest distance between lens and landmark at which the robot may stop, metres.
    across_std_m : float
        Largest standard deviation D·σ_δ at which the robot stops, metres: predicted by the Cramér–Rao bound at the
        view that it expects.
    every_m : float
        Way between two looks for a landmark, metres.
    again_m : float
        Way before the robot stops for the same landmark again after a correction, metres.
    retry_m : float
        Way before it stops for the same landmark again after a measurement that was refused, metres.
    gate : float
        Level of the test of a measurement: one that is less probable than 1 − gate is refused.
    """

    distance_m: tuple[_Positive, _Positive] = (0.8, 1.8)
    across_std_m: _Positive = 0.01
    every_m: _Positive = 0.1
    again_m: _Positive = 4.0
    retry_m: _Positive = 0.3
    gate: _Share = 0.9999

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.distance_m[0] >= self.distance_m[1]:
            raise UsageError(f"'distance_m' must be (low, high), got {self.distance_m}")
        return self


class DrivePlan(PlanModel):
    """A drive through a room with landmarks.

    Parameters
    ----------
    map : LandmarkMap
        Landmarks and walls; in a file a table, or the name of a map file relative to the plan's folder.
    path : PathPlan
        Path of the robot.
    odometry : OdometryPlan
        Errors of wheels and gyro.
    camera : CameraPlan
        Camera on its pan unit.
    stop : StopPlan
        Rules for stopping at a landmark and for accepting a match.

    Raises
    ------
    UsageError
        With one line that names the key, its value and what would be right.
    """

    map: LandmarkMap
    path: PathPlan
    odometry: OdometryPlan = OdometryPlan()
    camera: CameraPlan = CameraPlan()
    stop: StopPlan = StopPlan()

    @classmethod
    def with_named_tables(cls, table: dict[str, Any], folder: Path) -> dict[str, Any]:
        """Return the content of a plan's file with its map, which may be the name of a file of its folder."""
        named = table.get("map")
        return {**table, "map": read_landmark_map(folder / named)} if isinstance(named, str) else table

    @model_validator(mode="after")
    def _fits_the_room(self) -> Self:
        for k, point in enumerate(self.path.waypoints_m):
            if not self.map.is_inside(point):
                raise UsageError(f"'path.waypoints_m.{k}' must be inside 'map.room_m', got {point}")
        for k, landmark in enumerate(self.map.landmark):
            clearance = self.map.wall_clearance_m(landmark.xy_m)
            if clearance < LEAST_CLEARANCE_M:
                raise UsageError(
                    f"'map.landmark.{k}' must stand at least {LEAST_CLEARANCE_M} m from every wall,"
                    f" got {clearance:.3g} m"
                )
        return self

    def build_sensor(self) -> Sensor:
        """Return the sensor.

        Raises
        ------
        UsageError
            The preset is unknown.
        """
        return preset(self.camera.sensor)

    def greatest_distances_m(self) -> dict[str, float]:
        """Return the greatest distance at which a landmark is looked at, metres."""
        return {"stop.distance_m": self.stop.distance_m[1]}


def read_drive_plan(path: str | os.PathLike[str]) -> DrivePlan:
    """Read the plan of a drive from a TOML file.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    DrivePlan

    Raises
    ------
    InputFileError
        The file, or the map it names, cannot be read or is not TOML.
    UsageError
        With one line that names the file, the key, the value and what would be right.
    """
    return read_plan(path, DrivePlan)


def example_drive() -> str:
    """Return the text of the shipped plan: a tour of 20 m past four landmarks."""
    return (files("phasemark.matcher.drive") / "plan.toml").read_text(encoding="utf-8")


def default_drive() -> DrivePlan:
    """Return the shipped plan."""
    return DrivePlan(**tomllib.loads(example_drive()))
