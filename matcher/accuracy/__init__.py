"""Bounds, Monte-Carlo trials and the cost of a bank's grid."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.accuracy.cramer_rao import Bound, confusion_probability
    from phasemark.matcher.accuracy.expected_accuracy import (
        AccuracyCard,
        MultipathShift,
        accuracy_card,
        multipath_shift,
        sides_of,
    )
    from phasemark.matcher.accuracy.grid_spacing import GridLoss, SpacingLoss, grid_loss
    from phasemark.matcher.accuracy.pose_errors import PoseReport, pose_report
    from phasemark.matcher.accuracy.strangers import StrangerRate, stranger_rates
    from phasemark.matcher.accuracy.trials import Trials, TrialSetup, TrialSummary, run_trials
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "AccuracyCard",
    "Bound",
    "GridLoss",
    "MultipathShift",
    "PoseReport",
    "SpacingLoss",
    "StrangerRate",
    "TrialSetup",
    "TrialSummary",
    "Trials",
    "accuracy_card",
    "confusion_probability",
    "grid_loss",
    "multipath_shift",
    "pose_report",
    "run_trials",
    "sides_of",
    "stranger_rates",
]
