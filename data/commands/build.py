"""Building a bank or a frame set, whole or in part, from any of its commands."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from phasemark import UsageError
from phasemark.data.commands.console import LongWork, duration, echo_facts, echo_json, tell
from phasemark.data.commands.inputs import note_plan_too_far
from phasemark.data.commands.outputs import refuse_input_files

if TYPE_CHECKING:
    from phasemark.data import BankPlan, FramePlan


NOTED_BYTES = 100_000_000
"""A file of at least this size is announced before it is built, with the time it takes."""

_TRIAL_SECONDS = 2.0
"""About how long that time is tried for."""


def build_or_estimate(
    build: Callable[..., Any],
    plan: BankPlan | FramePlan,
    out: Path,
    shard: str | None,
    dry_run: bool,
    max_size: str,
    as_json: bool,
    workers: int | None,
    resume: bool,
    force: bool,
    shard_size: int | None,
    scheduler: str,
) -> None:
    """Build a bank or frame set, whole or in part; or say what that would take."""
    from phasemark.data import build_part, estimate, parse_part, planned_size
    from phasemark.data.shards.executor import processors
    from phasemark.data.shards.run import outputs_of, refuse_unwritable_output
    from phasemark.data.size import format_size, parse_size, refuse_too_many, too_many

    limit = parse_size(max_size, "--max-size")
    part, parts = (1, 1) if shard is None else parse_part(shard)
    note_plan_too_far(plan)
    facts: dict[str, Any] = planned_size(plan)
    counts = {name: n // parts for name, n in facts.items()}
    size = counts.pop("bytes")
    if dry_run:
        many = too_many(facts)
        about = f"not tried: {many or 'the file would be larger than --max-size'}"
        if size <= limit and many is None:
            facts = estimate(plan, workers=workers or processors())
            about = f"about {facts['seconds']:.3g}"
        if as_json:
            echo_json({**facts, "seconds": facts.get("seconds")})
        else:
            echo_facts({**facts, "seconds": about})
        return
    refuse_input_files(outputs_of(out), plan)
    described = f"{out}: {', '.join(f'{n} {name}' for name, n in counts.items())}, {format_size(size)}"
    if size > limit:
        smaller = (
            "thin 'distance_m' or 'delta_deg'" if "images" in counts else "take fewer 'views' or 'frames_per_view'"
        )
        raise UsageError(
            f"{described}, would be larger than --max-size {format_size(limit)}: {smaller}, or allow"
            f" --max-size {format_size(size * 11 // 10).replace(' ', '')}"
        )
    if size >= NOTED_BYTES:
        refuse_too_many(plan)
        refuse_unwritable_output(out, force=force, resume=resume)
        threads = workers or processors()
        seconds = estimate(plan, workers=threads, trial_seconds=_TRIAL_SECONDS)["seconds"] / parts
        tell(f"note: {described}; about {duration(seconds)} on {threads} processors here")
    with LongWork("rendering") as progress:
        options: dict[str, Any] = {
            "workers": workers, "resume": resume, "force": force, "shard_items": shard_size, "scheduler": scheduler,
            "progress": progress,
        }  # fmt: skip
        if shard is not None:
            build_part(plan, (part, parts), out, **options)
        else:
            build(plan, out, **options).close()
    if as_json:
        echo_json({"path": str(out)})
    else:
        typer.echo(out)


def merge_shards(shards: Sequence[Path], out: Path, resume: bool, force: bool) -> None:
    """Put parts of a bank or a frame set together."""
    from phasemark.data import merge_parts
    from phasemark.data.shards.run import outputs_of

    refuse_input_files(outputs_of(out))
    with LongWork("merging") as progress:
        merge_parts(shards, out, resume=resume, force=force, progress=progress)
    typer.echo(out)
