"""Conclusions of the robot: filtered frames, matches, and its own position."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.accuracy.cramer_rao import cramer_rao
    from phasemark.matcher.calibration.calibration import calibrate
    from phasemark.matcher.diagnosis.diagnose import diagnose
    from phasemark.matcher.filters.filtered_frames import FilteredFrames
    from phasemark.matcher.filters.kalman_filters import PixelKalman, kalman_filter
    from phasemark.matcher.filters.mean_phasor import phasor_mean
    from phasemark.matcher.likelihood.search_policy import SearchPolicy
    from phasemark.matcher.locate.locator import Locator
    from phasemark.matcher.match import Match, Matches
    from phasemark.matcher.matcher import Matcher
    from phasemark.matcher.position.robot_pose import RobotPose, robot_poses
    from phasemark.matcher.sweep.run import run_sweep
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "FilteredFrames",
    "Locator",
    "Match",
    "Matcher",
    "Matches",
    "PixelKalman",
    "RobotPose",
    "SearchPolicy",
    "calibrate",
    "cramer_rao",
    "diagnose",
    "kalman_filter",
    "phasor_mean",
    "robot_poses",
    "run_sweep",
]
