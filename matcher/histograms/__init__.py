"""Pose of a known object from histograms of a direct sensor at several poses (PHYSICS section 11)."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.histograms.object_pose import (
        Evidence,
        ModelError,
        ObjectPose,
        evidence_of,
        match_jointly,
        solve_jointly,
    )
    from phasemark.matcher.histograms.scene_prediction import ObjectScene
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = ["Evidence", "ModelError", "ObjectPose", "ObjectScene", "evidence_of", "match_jointly", "solve_jointly"]
