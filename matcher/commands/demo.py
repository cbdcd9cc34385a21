"""The command ``phasemark demo``: the paper's experiment."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from pathlib import Path

from phasemark.data.commands.console import LongWork, echo, echo_json, echo_table
from phasemark.data.commands.options import Force, Json, Out, Seed, Workers
from phasemark.data.commands.outputs import refuse_existing


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
    from phasemark.matcher.sweep.answer import answer
    from phasemark.matcher.sweep.plan import read_sweep_plan
    from phasemark.matcher.sweep.report import VIEW_HEADER, view_rows, write_report
    from phasemark.matcher.sweep.run import run_sweep

    refuse_existing([out / "plan.json"], force)
    plan = read_sweep_plan("demo").model_copy(update={"seed": seed})
    with LongWork("matching") as progress:
        trials = run_sweep(plan, out, workers=workers, force=force, progress=progress)
    with LongWork("writing the report"):
        report = write_report(out)
    cells = trials.cells()
    if as_json:
        echo_json({"report": str(report), "cells": [cell.as_dict() for cell in cells]})
        return
    echo(answer(cells))
    for m, method in enumerate(trials.methods):
        echo(f"\n{method}: medians and worst over the classes")
        echo_table(VIEW_HEADER, view_rows(trials, m))
    echo(f"\n{report}")
