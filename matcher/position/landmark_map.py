"""Map of landmarks in TOML, and the robot poses that a match allows on it (PHYSICS section 8)."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator

from phasemark import UsageError
from phasemark.data.plans.bank_plan import PlanModel, read_plan
from phasemark.matcher.position.robot_pose import RobotPose, ViewEstimate, robot_poses

Coordinate = Annotated[float, Field(allow_inf_nan=False)]
Std = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Point = tuple[Coordinate, Coordinate]


class MappedLandmark(PlanModel):
    """One landmark of a map.

    Parameters
    ----------
    name : str
        Name of this one landmark.
    class_name : str
        Its class, by the name that the matcher's bank has. The key of a file is ``class``.
    x_m, y_m : float
        Place of its axis in the room, metres.
    yaw_deg : float
        Heading of its x' axis, which runs along the box's length, degrees.
    xy_std_m : float
        Standard deviation of each surveyed coordinate, metres.
    yaw_std_deg : float
        Standard deviation of the surveyed heading, degrees.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_by_name=True, validate_by_alias=True)

    name: Annotated[str, Field(min_length=1, max_length=100)]
    class_name: Annotated[str, Field(alias="class", min_length=1)]
    x_m: Coordinate
    y_m: Coordinate
    yaw_deg: Coordinate = 0.0
    xy_std_m: Std = 0.0
    yaw_std_deg: Std = 0.0

    @property
    def xy_m(self) -> tuple[float, float]:
        """(X_o, Y_o)."""
        return self.x_m, self.y_m

    @property
    def yaw_rad(self) -> float:
        """ψ."""
        return math.radians(self.yaw_deg)

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Of (X_o, Y_o, ψ), (3, 3)."""
        return np.diag(np.square([self.xy_std_m, self.xy_std_m, math.radians(self.yaw_std_deg)]))


class LandmarkMap(PlanModel):
    """Landmarks, and the walls of the room around them.

    Parameters
    ----------
    landmark : sequence of MappedLandmark
        Landmarks of the room, at least one.
    room_m : sequence of (x, y)
        Corners of the room in order, metres: a polygon that does not cross itself. Empty: no walls.

    Examples
    --------
    >>> LandmarkMap(landmark=[{"name": "door", "class": "cone", "x_m": 2, "y_m": 1}]).landmark[0].xy_m
    (2.0, 1.0)
    """

    landmark: Annotated[tuple[MappedLandmark, ...], Field(min_length=1)]
    room_m: tuple[Point, ...] = ()

    @model_validator(mode="after")
    def _is_a_map(self) -> Self:
        names = [landmark.name for landmark in self.landmark]
        for k, name in enumerate(names):
            if name in names[:k]:
                raise UsageError(f"'landmark.{k}.name' must be a name of its own, got {name!r} twice")
        if 0 < len(self.room_m) < 3:
            raise UsageError(f"'room_m' must have at least 3 corners, got {len(self.room_m)}")
        for k, landmark in enumerate(self.landmark):
            if self.room_m and not self.is_inside(landmark.xy_m):
                raise UsageError(f"'landmark.{k}' must stand inside 'room_m', got x_m, y_m = {landmark.xy_m}")
        return self

    def is_inside(self, xy_m: Sequence[float]) -> bool:
        """Return whether a point is inside the room; true everywhere if it has no walls."""
        if not self.room_m:
            return True
        start, along = self._walls()
        end = start + along
        crosses = (start[:, 1] > xy_m[1]) != (end[:, 1] > xy_m[1])
        slope = np.divide(along[:, 0], along[:, 1], out=np.zeros(len(along)), where=crosses)
        return bool(np.count_nonzero(crosses & (start[:, 0] + slope * (xy_m[1] - start[:, 1]) > xy_m[0])) % 2)

    def wall_clearance_m(self, xy_m: Sequence[float]) -> float:
        """Return how far the nearest wall is from a point; infinite without walls."""
        if not self.room_m:
            return math.inf
        start, along = self._walls()
        to = np.asarray(xy_m, np.float64) - start
        share = np.clip(np.sum(to * along, axis=1) / np.sum(along**2, axis=1), 0, 1)
        return float(np.linalg.norm(to - share[:, None] * along, axis=1).min())

    def wall_distance_m(self, xy_m: Sequence[float] | NDArray[np.float64], heading_rad: float) -> float | None:
        """Return how far the room's wall is from a point in a direction; None where there is none.

        Parameters
        ----------
        xy_m : (x, y)
            Where the ray starts, metres.
        heading_rad : float
            Direction of the ray, radians.
        """
        if not self.room_m:
            return None
        start, along = self._walls()
        ray = np.array([math.cos(heading_rad), math.sin(heading_rad)])
        to = start - np.asarray(xy_m, np.float64)
        across = ray[0] * along[:, 1] - ray[1] * along[:, 0]
        parallel = across == 0
        across = np.where(parallel, 1.0, across)
        distance = (to[:, 0] * along[:, 1] - to[:, 1] * along[:, 0]) / across
        place = (to[:, 0] * ray[1] - to[:, 1] * ray[0]) / across
        met = ~parallel & (distance > 0) & (place >= 0) & (place <= 1)
        return float(distance[met].min()) if met.any() else None

    def poses(
        self,
        match: ViewEstimate,
        pan_rad: float = 0.0,
        *,
        prior: Sequence[float] | None = None,
        **known: Any,
    ) -> list[Placement]:
        """Return every pose that a match allows at every landmark of its class, nearest to the prior first.

        Parameters
        ----------
        match : Match
            Of one frame.
        pan_rad : float
            β.
        prior
            As :func:`~phasemark.matcher.robot_poses` has it; without a prior in the order of the map.
        **known
            Its further keywords: ``prior_covariance``, offsets, ``pan_std_rad``, ``mounting_covariance``.

        Returns
        -------
        list of Placement
            Empty if no landmark of the map is of that class, or there is none.
        """
        placements = [
            Placement(landmark, pose)
            for landmark in self.landmark
            if landmark.class_name == match.class_name
            for pose in robot_poses(
                match,
                landmark.xy_m,
                landmark.yaw_rad,
                pan_rad,
                prior=prior,
                landmark_covariance=landmark.covariance,
                **known,
            )
        ]
        return placements if prior is None else sorted(placements, key=lambda placement: placement.pose.mahalanobis)

    def _walls(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return where each wall begins, and the vector to its end; (walls, 2) both."""
        corners = np.array(self.room_m)
        return corners, np.roll(corners, -1, axis=0) - corners


@dataclass(frozen=True, eq=False)
class Placement:
    """A pose of the robot, and the landmark that it rests on.

    Parameters
    ----------
    landmark : MappedLandmark
        The landmark of the map.
    pose : RobotPose
        Pose of the robot that follows.
    """

    landmark: MappedLandmark
    pose: RobotPose


def read_landmark_map(path: str | os.PathLike[str]) -> LandmarkMap:
    """Read a map of landmarks from a TOML file.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    LandmarkMap

    Raises
    ------
    InputFileError
        The file cannot be read or is not TOML.
    UsageError
        With one line that names the file, the key, the value and what would be right.
    """
    return read_plan(path, LandmarkMap)
