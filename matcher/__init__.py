"""What the robot concludes: filters, matching, and its own position."""

from phasemark.matcher.bounds import (
    Bound,
    Estimate,
    confusion_probability,
    covers,
    cramer_rao,
    efficiency,
    nees,
    share,
)
from phasemark.matcher.filters import (
    FilteredFrames,
    PixelKalman,
    PixelState,
    kalman,
    kalman_filter,
    kalman_step,
    noise_free,
    phasor_mean,
)
from phasemark.matcher.landmark_map import LandmarkMap, MappedLandmark, Placement, load_map
from phasemark.matcher.match import Candidate, Match, Matches
from phasemark.matcher.matcher import Matcher, background_image
from phasemark.matcher.population import GridLoss, SpacingLoss, grid_loss
from phasemark.matcher.robot import PRIOR_STD, RobotPose, ViewEstimate, robot_poses
from phasemark.matcher.surroundings import Surroundings, estimate_surroundings
from phasemark.matcher.trials import Conditions, Trials, TrialSummary, run_trials

__all__ = [
    "PRIOR_STD",
    "Bound",
    "Candidate",
    "Conditions",
    "Estimate",
    "FilteredFrames",
    "GridLoss",
    "LandmarkMap",
    "MappedLandmark",
    "Match",
    "Matcher",
    "Matches",
    "PixelKalman",
    "PixelState",
    "Placement",
    "RobotPose",
    "SpacingLoss",
    "Surroundings",
    "TrialSummary",
    "Trials",
    "ViewEstimate",
    "background_image",
    "confusion_probability",
    "covers",
    "cramer_rao",
    "efficiency",
    "estimate_surroundings",
    "grid_loss",
    "kalman",
    "kalman_filter",
    "kalman_step",
    "load_map",
    "nees",
    "noise_free",
    "phasor_mean",
    "robot_poses",
    "run_trials",
    "share",
]
