"""Pose of a known object from histograms of a direct sensor at several poses (PHYSICS section 11)."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.histograms.object_pose import ObjectPose, match_jointly, pose_covariance
    from phasemark.matcher.histograms.pose_calibration import KnownObject, PoseCalibration, calibrate_poses
    from phasemark.matcher.histograms.pose_errors import PoseErrors
    from phasemark.matcher.histograms.pose_evidence import Evidence, ModelError, evidence_of, solve_jointly
    from phasemark.matcher.histograms.scene_prediction import ObjectScene
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "Evidence",
    "KnownObject",
    "ModelError",
    "ObjectPose",
    "ObjectScene",
    "PoseCalibration",
    "PoseErrors",
    "calibrate_poses",
    "evidence_of",
    "match_jointly",
    "pose_covariance",
    "solve_jointly",
]
