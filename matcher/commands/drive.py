"""The command ``phasemark drive``: a robot from landmark to landmark."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from phasemark.data.commands.console import LongWork, echo, echo_json, echo_table
from phasemark.data.commands.inputs import note_plan_too_far
from phasemark.data.commands.options import Force, Json, Out, Seed, Workers
from phasemark.data.commands.outputs import output_folder


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
    from phasemark.matcher.drive import OUTPUTS, default_drive, example_drive, read_drive_plan, run_drive, write_drive

    if example:
        return echo(example_drive().removesuffix("\n"))
    plan = default_drive() if plan_file is None else read_drive_plan(plan_file)
    note_plan_too_far(plan)
    with output_folder(out, "drive", OUTPUTS, force, plan):
        with LongWork("driving, cm") as progress:
            drive = run_drive(plan, seed=seed, workers=workers, progress=progress)
        with LongWork("drawing"):
            files = write_drive(drive, out, force=force)
    facts = drive.as_dict()
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
