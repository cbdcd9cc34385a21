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
from phasemark.matcher.calibrate import Calibration, calibrate, filter_poses
from phasemark.matcher.calibrate_model import Mounting
from phasemark.matcher.calibrate_poses import KnownPoses, PoseStd, frames_of_poses, read_poses
from phasemark.matcher.diagnosis import Change, Diagnosis, diagnose
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
from phasemark.matcher.stillness import MotionTest, motion_test
from phasemark.matcher.surroundings import Surroundings, estimate_surroundings
from phasemark.matcher.sweep import read_sweep, run_sweep
from phasemark.matcher.sweep_compare import Difference, compare_cells
from phasemark.matcher.sweep_examples import sweep_frames
from phasemark.matcher.sweep_plan import SHIPPED_SWEEPS, Condition, Method, SweepPlan, load_sweep
from phasemark.matcher.sweep_tables import Cell, SweepTrials
from phasemark.matcher.trials import Conditions, Trials, TrialSummary, run_trials

__all__ = [
    "PRIOR_STD",
    "SHIPPED_SWEEPS",
    "Bound",
    "Calibration",
    "Candidate",
    "Cell",
    "Change",
    "Condition",
    "Conditions",
    "Diagnosis",
    "Difference",
    "Estimate",
    "FilteredFrames",
    "GridLoss",
    "KnownPoses",
    "LandmarkMap",
    "MappedLandmark",
    "Match",
    "Matcher",
    "Matches",
    "Method",
    "MotionTest",
    "Mounting",
    "PixelKalman",
    "PixelState",
    "Placement",
    "PoseStd",
    "RobotPose",
    "SpacingLoss",
    "Surroundings",
    "SweepPlan",
    "SweepTrials",
    "TrialSummary",
    "Trials",
    "ViewEstimate",
    "background_image",
    "calibrate",
    "compare_cells",
    "confusion_probability",
    "covers",
    "cramer_rao",
    "diagnose",
    "efficiency",
    "estimate_surroundings",
    "filter_poses",
    "frames_of_poses",
    "grid_loss",
    "kalman",
    "kalman_filter",
    "kalman_step",
    "load_map",
    "load_sweep",
    "motion_test",
    "nees",
    "noise_free",
    "phasor_mean",
    "read_poses",
    "read_sweep",
    "robot_poses",
    "run_sweep",
    "run_trials",
    "share",
    "sweep_frames",
]
