"""Plans of banks and frame sets, and the axes of their grids."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.data.plans.arrays import planned_size
    from phasemark.data.plans.bank_plan import BankPlan, MeshPlan, read_bank_plan, read_plan
    from phasemark.data.plans.frame_plan import Distribution, FramePlan
    from phasemark.data.plans.generated_scene import GeneratedScene
    from phasemark.data.plans.grid_axis import format_grid, parse_grid
    from phasemark.data.plans.scene_frames_plan import SceneFramesPlan
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "BankPlan",
    "Distribution",
    "FramePlan",
    "GeneratedScene",
    "MeshPlan",
    "SceneFramesPlan",
    "format_grid",
    "parse_grid",
    "planned_size",
    "read_bank_plan",
    "read_plan",
]
