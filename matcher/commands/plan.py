"""Commands of ``phasemark plan``: examples, schemas and checks of plans."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from phasemark.data.commands.command import Shown
from phasemark.data.commands.console import echo, echo_json
from phasemark.data.commands.inputs import note_plan_too_far
from phasemark.data.commands.options import Json

PlanKind = Annotated[
    Literal["bank", "frames", "scenes", "sweep", "drive", "design"],
    Shown(help="bank, frames, scenes, sweep, drive or design."),
]


def plan_example(kind: PlanKind) -> None:
    """Print a plan with comments; it can be used as it is."""
    from phasemark.matcher.plan_kinds import plan_example

    echo(plan_example(kind).removesuffix("\n"))


def plan_schema(kind: PlanKind) -> None:
    """Print the JSON Schema of a kind of plan, for editors and other programs."""
    from phasemark.matcher.plan_kinds import plan_schema

    echo_json(plan_schema(kind))


def plan_check(file: Path, *, kind: PlanKind | None = None, as_json: Json = False) -> None:
    """Check a plan and say what it is; with --json print it with every default made explicit.

    Parameters
    ----------
    file
        A plan (.toml).
    kind
        Kind of the plan, if it leaves it open.
    """
    from phasemark.data.plans.bank_plan import ScenePlan
    from phasemark.matcher.drive import DrivePlan
    from phasemark.matcher.plan_kinds import check_plan

    found, plan = check_plan(file, kind)
    if isinstance(plan, ScenePlan | DrivePlan):
        note_plan_too_far(plan)
    if as_json:
        echo_json({"kind": found, "plan": plan.model_dump(mode="json")})
    else:
        echo(f"{file}: a plan of kind '{found}', complete and valid")
