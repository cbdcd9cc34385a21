"""What the robot concludes: filters, matching, and its own position."""

from phasemark.matcher.filters import (
    FilteredFrames,
    PixelKalman,
    PixelState,
    kalman,
    kalman_filter,
    kalman_step,
    phasor_mean,
)
from phasemark.matcher.landmark_map import LandmarkMap, MappedLandmark, Placement, load_map
from phasemark.matcher.match import Candidate, Match, Matches
from phasemark.matcher.matcher import Matcher, background_image
from phasemark.matcher.robot import PRIOR_STD, RobotPose, ViewEstimate, robot_poses

__all__ = [
    "PRIOR_STD",
    "Candidate",
    "FilteredFrames",
    "LandmarkMap",
    "MappedLandmark",
    "Match",
    "Matcher",
    "Matches",
    "PixelKalman",
    "PixelState",
    "Placement",
    "RobotPose",
    "ViewEstimate",
    "background_image",
    "kalman",
    "kalman_filter",
    "kalman_step",
    "load_map",
    "phasor_mean",
    "robot_poses",
]
