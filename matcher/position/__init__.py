"""Pose of the robot from matches and a map."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.position.landmark_map import LandmarkMap, MappedLandmark, Placement, read_landmark_map
    from phasemark.matcher.position.robot_pose import PRIOR_STD, RobotPose, ViewEstimate, robot_poses
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "PRIOR_STD",
    "LandmarkMap",
    "MappedLandmark",
    "Placement",
    "RobotPose",
    "ViewEstimate",
    "read_landmark_map",
    "robot_poses",
]
