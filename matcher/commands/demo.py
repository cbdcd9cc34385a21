"""The command ``phasemark demo``: the paper's experiment."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from pathlib import Path

import typer

from phasemark.data.commands.console import LongWork, echo_json, echo_table
from phasemark.data.commands.options import Force, Json, Out, Seed, Workers
from phasemark.data.commands.outputs import output_folder, refuse_existing


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
        Folder for the report, the tables and the bank.
    """
    from phasemark.data.shards.run import outputs_of
    from phasemark.matcher.demo.report import DEMO_FILES, HALVES, answer, on_grid, summary_rows, write_demo
    from phasemark.matcher.demo.run import run_demo

    bank = out / "bank.h5"
    refuse_existing([bank], force)
    with output_folder(out, "demo", DEMO_FILES, force, also=[path.name for path in outputs_of(bank)]):
        with LongWork("matching") as progress:
            result = run_demo(bank, seed=seed, workers=workers, force=force, progress=progress)
        with LongWork("writing the report"):
            report = write_demo(result, out, force=force)
    if as_json:
        echo_json({"report": str(report), **result.as_dict()})
        return
    header = ("D (cm)", "δ (°)", "class right", "|ΔD| mm", "worst", "|Δδ| °", "worst", "position mm", "worst")
    typer.echo(answer(result))
    typer.echo("")
    for shifted, method, title in HALVES:
        if not shifted:
            typer.echo(f"{title}: {on_grid(result)}")
            continue
        typer.echo(f"{title}: medians and worst over the classes")
        echo_table(header, summary_rows(result.select(shifted=shifted, method=method)))
        typer.echo("")
    typer.echo(report)
