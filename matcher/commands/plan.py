"""Commands of plans: their examples, schemas and checks, and the runs of a drive and of a design of landmarks."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from phasemark.data.commands.command import Shown
from phasemark.data.commands.console import LongWork, echo, echo_json, echo_table
from phasemark.data.commands.inputs import note_plan_too_far
from phasemark.data.commands.options import Force, Index, Json, Out, Seed, Workers
from phasemark.data.commands.outputs import output_folder
from phasemark.matcher import design, drive  # they import what is used

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
    from phasemark.matcher.plan_kinds import check_plan

    found, plan = check_plan(file, kind)
    if isinstance(plan, ScenePlan | drive.DrivePlan):
        note_plan_too_far(plan)
    if as_json:
        echo_json({"kind": found, "plan": plan.model_dump(mode="json")})
    else:
        echo(f"{file}: a plan of kind '{found}', complete and valid")


def drive_robot(
    plan_file: Path | None = None,
    *,
    out: Out = Path("out/drive"),
    seed: Seed = 2005,
    example: bool = False,
    workers: Workers = None,
    as_json: Json = False,
    force: Force = False,
) -> None:
    """Drive a robot from landmark to landmark, its odometry corrected on the way.

    Parameters
    ----------
    plan_file
        A plan (.toml); without it a tour of 20 m.
    out
        Folder for tables, summary and figure.
    example
        Print the plan of that tour, and do nothing else.
    """
    if example:
        return echo(drive.example_drive().removesuffix("\n"))
    plan = drive.default_drive() if plan_file is None else drive.read_drive_plan(plan_file)
    note_plan_too_far(plan)
    with output_folder(out, "drive", drive.OUTPUTS, force, plan):
        with LongWork("driving, cm") as progress:
            found = drive.run_drive(plan, seed=seed, workers=workers, progress=progress)
        with LongWork("drawing"):
            files = drive.write_drive(found, out, force=force)
    facts = found.as_dict()
    if as_json:
        return echo_json({"files": [str(path) for path in files], **facts})
    _echo_drive(facts)
    echo(*files)


def _echo_drive(facts: Mapping[str, Any]) -> None:
    """Print the errors of a drive with its odometry alone and with corrections."""
    echo_table(
        ("error", "at the end", "largest", "heading at the end", "largest"),
        (
            (
                title,
                f"{facts[f'{key}_final_position_error_m']:.3f} m",
                f"{facts[f'{key}_largest_position_error_m']:.3f} m",
                f"{facts[f'{key}_final_heading_error_deg']:.2f}°",
                f"{facts[f'{key}_largest_heading_error_deg']:.2f}°",
            )
            for title, key in (("dead reckoning", "dead_reckoned"), ("corrected", "corrected"))
        ),
    )
    echo(f"{facts['way_m']:.1f} m, {facts['corrections']} corrections at {facts['stops']} stops")


def landmark_design(
    plan_file: Path | None = None,
    *,
    out: Out = Path("out/design"),
    confirm: Annotated[Index, Shown(metavar="N")] = 100,
    seed: Seed | None = None,
    example: bool = False,
    workers: Workers = None,
    as_json: Json = False,
    force: Force = False,
) -> None:
    """Design a set of landmarks for a camera and a working range, and confirm what it gains by simulated frames.

    Parameters
    ----------
    plan_file
        A plan (.toml); without it four landmarks for the PMD camera.
    out
        Folder for landmarks, tables, pictures and meshes.
    confirm
        Simulated frame sets to match from every side; 0: none.
    seed
        Replaces the plan's root of all random numbers.
    example
        Print the default plan, and do nothing else.
    """
    if example:
        return echo(design.example_design().removesuffix("\n"))
    plan = design.default_design() if plan_file is None else design.read_design_plan(plan_file)
    if seed is not None:
        plan = plan.model_copy(update={"seed": seed})
    with output_folder(out, "landmark design", design.output_names(plan), force, plan):
        with LongWork("searching") as progress:
            found = design.run_design(plan, workers=workers, progress=progress)
        confirmed = None
        if confirm:
            with LongWork("matching simulated frames") as progress:
                confirmed = design.confirm_design(found, confirm, workers=workers, progress=progress)
        with LongWork("writing the design"):
            files = design.write_design(found, confirmed, out, force=force)
    facts = design.summary(found, confirmed)
    if as_json:
        return echo_json({"files": [str(path) for path in files], **facts})
    _echo_design(facts)
    echo(*files)


def _echo_design(facts: Mapping[str, Any]) -> None:
    """Print a design beside the catalogue."""
    from phasemark.render.integral.rounding import with_interval

    def within(interval: Mapping[str, float | None], scale: float) -> str:
        value, low, high = (
            math.nan if number is None else scale * number for number in map(interval.get, ("value", "low", "high"))
        )
        return with_interval(value, low, high) if math.isfinite(value) else "nothing found"

    sets = [facts["result"], facts["catalogue"]]
    rows = [
        ("box (mm)", *(" × ".join(f"{1000 * side:g}" for side in one["landmarks"][0]["box"].values()) for one in sets)),
        ("looks the same every", *(f"{360 / one['symmetry']:g}°" for one in sets)),
        ("worst position bound (mm)", *(f"{1000 * one['worst_position_bound_m']:.1f}" for one in sets)),
        ("median position bound (mm)", *(f"{1000 * one['median_position_bound_m']:.1f}" for one in sets)),
        ("least d between classes", *(_number(one["least_class_distance"]) for one in sets)),
        ("least d from itself turned", *(_number(one["turn_distance"]) for one in sets)),
    ]
    confirmation = facts["confirmation"]
    if confirmation:
        tried = [confirmation["result"], confirmation["catalogue"]]
        for title, key in (("worst side", "worst"), ("anywhere", "anywhere")):
            found = (f"{within(one[key]['rmse_m'], 1000)}, N = {one[key]['n']}" for one in tried)
            rows.append((f"r.m.s. error, {title} (mm)", *found))
        rows.append(("r.m.s. error / bound, all sides", *(within(one["rmse_over_bound"], 1) for one in tried)))
        rows.append(("class errors, all sides (%)", *(within(one["class_errors"], 100) for one in tried)))
    echo_table(("", "new set", "catalogue"), rows)
    echo(f"worst position bound {facts['bound_factor']:.2f} times lower than the catalogue's")
    if confirmation:
        echo(f"worst r.m.s. error {within(confirmation['worst_rmse_factor'], 1)} times lower, 95 % interval")


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.1f}"
