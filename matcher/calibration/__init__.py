"""The mounting of a camera from frames at known poses."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.calibration.calibration import calibrate
    from phasemark.matcher.calibration.known_poses import KnownPoses, PoseStd, read_poses
    from phasemark.matcher.calibration.mounting import Mounting
    from phasemark.matcher.calibration.pose_frames import filter_poses, frames_of_poses
    from phasemark.matcher.calibration.result import Calibration
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "Calibration",
    "KnownPoses",
    "Mounting",
    "PoseStd",
    "calibrate",
    "filter_poses",
    "frames_of_poses",
    "read_poses",
]
