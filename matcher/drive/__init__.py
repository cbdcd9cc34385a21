"""A robot that stays on its path: odometry corrected before landmarks, simulated from light to pose."""

from phasemark.matcher.drive.plan import (
    CameraPlan,
    DrivePlan,
    OdometryPlan,
    PathPlan,
    StopPlan,
    example_drive,
    load_drive_plan,
)
from phasemark.matcher.drive.pose_filter import PoseFilter
from phasemark.matcher.drive.simulate import Drive, Equipment, Stop, pose_error, run_drive

__all__ = [
    "CameraPlan",
    "Drive",
    "DrivePlan",
    "Equipment",
    "OdometryPlan",
    "PathPlan",
    "PoseFilter",
    "Stop",
    "StopPlan",
    "example_drive",
    "load_drive_plan",
    "pose_error",
    "run_drive",
]
