"""Commands of ``phasemark sweep``: how accurate, where, and says who."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from phasemark.data.commands.console import LongWork, echo_json, echo_table
from phasemark.data.commands.inputs import note_plan_too_far
from phasemark.data.commands.options import Force, Json, Workers, one_of
from phasemark.data.commands.outputs import refuse_existing, refuse_input_files


def sweep_run(
    *,
    plan: Annotated[
        str,
        typer.Argument(
            metavar="PLAN|NAME",
            help="A plan (.toml), or paper, distance-angle-noise or robustness.",
            autocompletion=one_of("paper", "distance-angle-noise", "robustness"),
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for trials, tables and the report.")],
    trials: Annotated[
        int | None, typer.Option("--trials", help="Trials of each condition, in place of the plan's.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Root of all random numbers.")] = None,
    matcher: Annotated[
        str | None,
        typer.Option("--matcher", metavar="MODULE:NAME", help="Your own matcher, beside the plan's methods."),
    ] = None,
    trust_plan: Annotated[
        bool, typer.Option("--trust-plan", help="Run the programs (MODULE:NAME) that the plan itself names.")
    ] = False,
    workers: Workers = None,
    scheduler: Annotated[
        str, typer.Option("--scheduler", help="threads, local:N (processes), or a Dask scheduler's address.")
    ] = "threads",
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a sweep that was interrupted.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Start over where the folder holds a sweep.")] = False,
) -> None:
    """Run a sweep and write its tables and report."""
    from phasemark.matcher.sweep.plan import Method, SweepPlan, read_sweep_plan, refuse_programs
    from phasemark.matcher.sweep.report import write_report
    from phasemark.matcher.sweep.run import run_sweep, sweep_outputs

    loaded = read_sweep_plan(plan)
    changes: dict[str, Any] = {key: value for key, value in (("trials", trials), ("seed", seed)) if value is not None}
    if not trust_plan:
        refuse_programs(loaded, () if matcher is None else (matcher,), plan)
    if matcher is not None and matcher not in [method.method for method in loaded.methods]:
        changes["methods"] = (*loaded.methods, Method(name=matcher, method=matcher))
    changed = SweepPlan(**{**loaded.model_dump(), **changes})
    if any(method.is_program for method in changed.methods):
        sys.path.append(str(Path.cwd()))  # where one's own matcher lies; an installed program does not look here itself
    note_plan_too_far(changed)
    refuse_input_files(sweep_outputs(out), changed)
    with LongWork("trials") as progress:
        run_sweep(changed, out, workers=workers, scheduler=scheduler, resume=resume, force=force, progress=progress)
    with LongWork("writing the report"):
        report = write_report(out)
    typer.echo(report)


def sweep_report(
    *,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A sweep's folder.")],
    as_json: Json = False,
) -> None:
    """Write a sweep's tables, figures and report again."""
    from phasemark.matcher.sweep.report import summary, write_report
    from phasemark.matcher.sweep.run import read_sweep

    with LongWork("writing the report"):
        report = write_report(folder)
    trials = read_sweep(folder)[1]
    cells = trials.cells()
    if as_json:
        echo_json({"report": str(report), "cells": [cell.as_dict() for cell in cells]})
        return
    for sentence in summary(trials, cells):
        typer.echo(sentence)
    typer.echo(report)


def sweep_frames_again(
    *,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A sweep's folder.")],
    condition: Annotated[
        int, typer.Argument(metavar="CONDITION", help="Number of the condition in trials.csv.", min=0)
    ],
    trial: Annotated[int, typer.Argument(metavar="TRIAL", help="Number of the trial in trials.csv.", min=0)],
    out: Annotated[Path, typer.Option("-o", "--out", help="The noisy frames as .npz, to be matched again.")],
    force: Force = False,
) -> None:
    """Take the frames of one trial of a sweep again, bit for bit."""
    from phasemark.data.files.folder_marker import read_marker
    from phasemark.data.files.same_file import refuse_inputs
    from phasemark.data.measured.reading import write_measured
    from phasemark.matcher.sweep.examples import sweep_frames

    refuse_inputs([out], map(folder.joinpath, read_marker(folder)[1] or ()))
    refuse_existing([out], force)
    typer.echo(write_measured(sweep_frames(folder, condition, trial), out, force=force))


def sweep_compare(
    *,
    first: Annotated[Path, typer.Argument(metavar="DIR1", help="A sweep's folder.")],
    second: Annotated[Path, typer.Argument(metavar="DIR2", help="Folder of the other sweep.")],
    everything: Annotated[bool, typer.Option("--all", help="Show differences that may be chance, too.")] = False,
    as_json: Json = False,
) -> None:
    """Compare two sweeps cell by cell; significant differences are marked, corrected for their number."""
    from phasemark.matcher.sweep.compare import compare_cells
    from phasemark.matcher.sweep.run import read_sweep

    found = compare_cells(*(read_sweep(folder)[1].cells() for folder in (first, second)))
    if as_json:
        echo_json([one.as_dict() for one in found])
        return
    shown = [one for one in found if one.significant or everything]
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
    typer.echo(f"{sum(one.significant for one in found)} of {len(found)} differences are significant")
