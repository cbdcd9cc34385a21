"""A robot among walls: rigs of several sensors, maps, and the poses that explain a recording."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.locate.locator import LocatedPose, Locator, PoseCandidate
    from phasemark.matcher.locate.recording import RigRecording, read_rig_recording
    from phasemark.matcher.locate.rig import OdometryDrift, Rig, RigSensor, read_rig
    from phasemark.matcher.locate.rig_calibration import RigCalibration, calibrate_rig
    from phasemark.matcher.locate.simulated import recording_bytes, simulated_recording
    from phasemark.matcher.locate.smoothing import smoothed
    from phasemark.matcher.locate.wall_map import Wall, WallMap, read_wall_map
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "LocatedPose",
    "Locator",
    "OdometryDrift",
    "PoseCandidate",
    "Rig",
    "RigCalibration",
    "RigRecording",
    "RigSensor",
    "Wall",
    "WallMap",
    "calibrate_rig",
    "read_rig",
    "read_rig_recording",
    "read_wall_map",
    "recording_bytes",
    "simulated_recording",
    "smoothed",
]
