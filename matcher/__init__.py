"""What the robot concludes: filters, matching, and its own position."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.accuracy.cramer_rao import Bound, confusion_probability, cramer_rao
    from phasemark.matcher.accuracy.grid_spacing import GridLoss, SpacingLoss, grid_loss
    from phasemark.matcher.accuracy.trials import Trials, TrialSetup, TrialSummary, run_trials
    from phasemark.matcher.calibration.calibration import calibrate, filter_poses
    from phasemark.matcher.calibration.known_poses import KnownPoses, PoseStd, frames_of_poses, read_poses
    from phasemark.matcher.calibration.mounting_model import Mounting
    from phasemark.matcher.calibration.result import Calibration
    from phasemark.matcher.diagnosis.diagnose import Change, Diagnosis, diagnose
    from phasemark.matcher.filters.filtered_frames import (
        FilteredFrames,
        PixelKalman,
        PixelState,
        kalman,
        kalman_filter,
        kalman_step,
        noise_free,
        phasor_mean,
    )
    from phasemark.matcher.likelihood.background_estimate import Surroundings, estimate_surroundings
    from phasemark.matcher.likelihood.search_policy import SearchPolicy
    from phasemark.matcher.match import Candidate, Match, Matches
    from phasemark.matcher.matcher import Matcher
    from phasemark.matcher.position.landmark_map import LandmarkMap, MappedLandmark, Placement, read_landmark_map
    from phasemark.matcher.position.robot_pose import PRIOR_STD, RobotPose, ViewEstimate, robot_poses
    from phasemark.matcher.recordings.stillness import MotionTest, motion_test
    from phasemark.matcher.statistics import (
        ErrorStatistics,
        Interval,
        binomial_interval,
        error_statistics,
        mean_interval,
        nees,
        rms_interval,
        within_ellipsoid,
    )
    from phasemark.matcher.sweep.compare import Difference, compare_cells
    from phasemark.matcher.sweep.examples import sweep_frames
    from phasemark.matcher.sweep.plan import SHIPPED_SWEEPS, Condition, Method, SweepPlan, read_sweep_plan
    from phasemark.matcher.sweep.result_tables import Cell, SweepTrials
    from phasemark.matcher.sweep.run import read_sweep, run_sweep
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "PRIOR_STD",
    "SHIPPED_SWEEPS",
    "Bound",
    "Calibration",
    "Candidate",
    "Cell",
    "Change",
    "Condition",
    "Diagnosis",
    "Difference",
    "ErrorStatistics",
    "FilteredFrames",
    "GridLoss",
    "Interval",
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
    "SearchPolicy",
    "SpacingLoss",
    "Surroundings",
    "SweepPlan",
    "SweepTrials",
    "TrialSetup",
    "TrialSummary",
    "Trials",
    "ViewEstimate",
    "binomial_interval",
    "calibrate",
    "compare_cells",
    "confusion_probability",
    "cramer_rao",
    "diagnose",
    "error_statistics",
    "estimate_surroundings",
    "filter_poses",
    "frames_of_poses",
    "grid_loss",
    "kalman",
    "kalman_filter",
    "kalman_step",
    "mean_interval",
    "motion_test",
    "nees",
    "noise_free",
    "phasor_mean",
    "read_landmark_map",
    "read_poses",
    "read_sweep",
    "read_sweep_plan",
    "rms_interval",
    "robot_poses",
    "run_sweep",
    "run_trials",
    "sweep_frames",
    "within_ellipsoid",
]
