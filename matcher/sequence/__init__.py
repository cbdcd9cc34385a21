"""A pose over time: odometry and matches in one estimator, which says when it is lost."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.sequence.odometry import FreeMotion, OdometryPlan, Reading
    from phasemark.matcher.sequence.pose_estimator import Estimate, PoseEstimator
    from phasemark.matcher.sequence.pose_filter import Motion, PoseFilter, Sighting
    from phasemark.matcher.sequence.standing import Standing
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "Estimate",
    "FreeMotion",
    "Motion",
    "OdometryPlan",
    "PoseEstimator",
    "PoseFilter",
    "Reading",
    "Sighting",
    "Standing",
]
