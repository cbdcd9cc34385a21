"""Commands of ``phasemark sweep``: how accurate, where, and says who; ``phasemark demo`` is the paper's experiment."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

from phasemark.data.commands.command import Shown
from phasemark.data.commands.console import LongWork, echo, echo_json, echo_table
from phasemark.data.commands.inputs import note_plan_too_far
from phasemark.data.commands.options import Force, Index, Json, Out, Seed, Workers, one_of
from phasemark.data.commands.outputs import refuse_existing, refuse_input_files
from phasemark.matcher import sweep  # it imports what is used

Folder = Annotated[Path, Shown(metavar="DIR", help="A sweep's folder.")]


def sweep_run(
    plan_or_name: Annotated[
        str, Shown(autocompletion=one_of("paper", "distance-angle-noise", "robustness", "multipath", "demo"))
    ],
    *,
    out: Out,
    trials: int | None = None,
    seed: Annotated[int | None, Shown(help="Root of all random numbers.")] = None,
    matcher: Annotated[str | None, Shown(metavar="MODULE:NAME")] = None,
    trust_plan: bool = False,
    workers: Workers = None,
    scheduler: str = "threads",
    resume: bool = False,
    force: bool = False,
) -> None:
    """Run a sweep and write its tables and report.

    Parameters
    ----------
    plan_or_name
        A plan (.toml), or paper, distance-angle-noise, robustness, multipath or demo.
    out
        Folder for trials, tables and the report.
    trials
        Trials of each condition, in place of the plan's.
    matcher
        Your own matcher, beside the plan's methods.
    trust_plan
        Run the programs (MODULE:NAME) that the plan itself names.
    scheduler
        threads, or a Dask scheduler's address.
    resume
        Go on with a sweep that was interrupted.
    force
        Start over where the folder holds a sweep.
    """
    from phasemark.matcher.sweep.plan import refuse_programs
    from phasemark.matcher.sweep.report import write_report
    from phasemark.matcher.sweep.run import sweep_outputs

    loaded = sweep.read_sweep_plan(plan_or_name)
    changes: dict[str, Any] = {key: value for key, value in (("trials", trials), ("seed", seed)) if value is not None}
    if not trust_plan:
        refuse_programs(loaded, () if matcher is None else (matcher,), plan_or_name)
    if matcher is not None and matcher not in [method.method for method in loaded.methods]:
        changes["methods"] = (*loaded.methods, sweep.Method(name=matcher, method=matcher))
    changed = sweep.SweepPlan(**{**loaded.model_dump(), **changes})
    if any(method.is_program for method in changed.methods):
        sys.path.append(str(Path.cwd()))  # where one's own matcher lies; an installed program does not look here itself
    note_plan_too_far(changed)
    refuse_input_files(sweep_outputs(out), changed)
    with LongWork("trials") as progress:
        sweep.run_sweep(
            changed, out, workers=workers, scheduler=scheduler, resume=resume, force=force, progress=progress
        )
    with LongWork("writing the report"):
        report = write_report(out)
    echo(report)


def sweep_report(folder: Folder, *, as_json: Json = False) -> None:
    """Write a sweep's tables, figures and report again."""
    from phasemark.matcher.sweep.report import summary, write_report

    with LongWork("writing the report"):
        report = write_report(folder)
    trials = sweep.read_sweep(folder)[1]
    cells = trials.cells()
    if as_json:
        return echo_json({"report": str(report), "cells": [cell.as_dict() for cell in cells]})
    echo(*summary(trials, cells), report)


def sweep_frames(folder: Folder, condition: Index, trial: Index, *, out: Out, force: Force = False) -> None:
    """Take the frames of one trial of a sweep again, bit for bit.

    Parameters
    ----------
    condition
        Number of the condition in trials.csv.
    trial
        Number of the trial in trials.csv.
    out
        The noisy frames as .npz, to be matched again.
    """
    from phasemark.data.files.folder_marker import read_marker
    from phasemark.data.files.same_file import refuse_inputs
    from phasemark.data.measured.reading import write_measured

    refuse_inputs([out], map(folder.joinpath, read_marker(folder)[1] or ()))
    refuse_existing([out], force)
    echo(write_measured(sweep.sweep_frames(folder, condition, trial), out, force=force))


def sweep_compare(
    first: Annotated[Path, Shown(metavar="DIR1")],
    second: Annotated[Path, Shown(metavar="DIR2")],
    *,
    all_: bool = False,
    as_json: Json = False,
) -> None:
    """Compare two sweeps cell by cell; significant differences are marked, corrected for their number.

    Parameters
    ----------
    first
        A sweep's folder.
    second
        Folder of the other sweep.
    all_
        Show differences that may be chance, too.
    """
    found = sweep.compare_cells(*(sweep.read_sweep(folder)[1].cells() for folder in (first, second)))
    if as_json:
        return echo_json([one.as_dict() for one in found])
    shown = [one for one in found if one.significant or all_]
    echo_table(
        ("class", "D (m)", "δ (°)", "noise", "frames", "method", "quantity", str(first), str(second), "p", ""),
        (
            (
                one.condition.class_name, f"{one.condition.distance_m:g}", f"{one.condition.delta_deg:g}",
                f"{one.condition.noise_factor:g}", str(one.condition.n_frames), one.method, one.quantity,
                f"{one.first:.4g}", f"{one.second:.4g}", f"{one.p_value:.2g}", "*" if one.significant else "",
            )
            for one in shown
        ),
    )  # fmt: skip
    echo(f"{sum(one.significant for one in found)} of {len(found)} differences are significant")


def demo_report(
    *,
    out: Out = Path("out/demo"),
    seed: Seed = 2005,
    workers: Workers = None,
    as_json: Json = False,
    force: Force = False,
) -> None:
    """Run the paper's experiment and write its report: four landmarks, 80 to 120 cm, 0 to 90°.

    Parameters
    ----------
    out
        Folder for trials, tables and the report.
    """
    from phasemark.matcher.sweep.report import VIEW_HEADER, answer, view_rows, write_report

    refuse_existing([out / "plan.json"], force)
    plan = sweep.read_sweep_plan("demo").model_copy(update={"seed": seed})
    with LongWork("matching") as progress:
        trials = sweep.run_sweep(plan, out, workers=workers, force=force, progress=progress)
    with LongWork("writing the report"):
        report = write_report(out)
    cells = trials.cells()
    if as_json:
        return echo_json({"report": str(report), "cells": [cell.as_dict() for cell in cells]})
    echo(answer(cells))
    for m, method in enumerate(trials.methods):
        echo(f"\n{method}: medians and worst over the classes")
        echo_table(VIEW_HEADER, view_rows(trials, m))
    echo(f"\n{report}")
