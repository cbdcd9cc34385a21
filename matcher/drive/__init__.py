"""A robot that stays on its path: odometry corrected before landmarks, simulated from light to pose."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.drive.figures import drive_figure
    from phasemark.matcher.drive.output import OUTPUTS, path_csv, stops_csv, write_drive
    from phasemark.matcher.drive.plan import (
        CameraPlan,
        DrivePlan,
        PathPlan,
        StopPlan,
        default_drive,
        example_drive,
        read_drive_plan,
    )
    from phasemark.matcher.drive.simulate import Drive, RobotEquipment, Stop, pose_error, run_drive
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "OUTPUTS",
    "CameraPlan",
    "Drive",
    "DrivePlan",
    "PathPlan",
    "RobotEquipment",
    "Stop",
    "StopPlan",
    "default_drive",
    "drive_figure",
    "example_drive",
    "path_csv",
    "pose_error",
    "read_drive_plan",
    "run_drive",
    "stops_csv",
    "write_drive",
]
