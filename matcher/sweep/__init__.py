"""Sweeps over conditions: plan, trials, tables, report."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.sweep.compare import Difference, compare_cells
    from phasemark.matcher.sweep.plan import SHIPPED_SWEEPS, Condition, Method, SweepPlan, read_sweep_plan
    from phasemark.matcher.sweep.result_tables import Cell, SweepTrials
    from phasemark.matcher.sweep.run import read_sweep, run_sweep, sweep_frames
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "SHIPPED_SWEEPS",
    "Cell",
    "Condition",
    "Difference",
    "Method",
    "SweepPlan",
    "SweepTrials",
    "compare_cells",
    "read_sweep",
    "read_sweep_plan",
    "run_sweep",
    "sweep_frames",
]
