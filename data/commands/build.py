"""Building a bank or a frame set, whole or in part, from any of its commands."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from phasemark import UsageError
from phasemark.data.commands.console import LongWork, duration, echo, echo_facts, echo_json, tell
from phasemark.data.commands.inputs import note_plan_too_far
from phasemark.data.commands.options import Building
from phasemark.data.commands.outputs import refuse_input_files

if TYPE_CHECKING:
    from phasemark.data.plans.arrays import AnyPlan


NOTED_BYTES = 100_000_000
"""A file of at least this size is announced before it is built, with the time it takes."""


def build_or_estimate(build: Callable[..., Any], plan: AnyPlan, out: Path, building: Building) -> None:
    """Build a bank or frame set, whole or in part; or say what that would take."""
    from phasemark.data.partial_outputs import build_part, parse_part
    from phasemark.data.plans.arrays import parse_size, planned_size
    from phasemark.data.shards.run import outputs_of

    limit = parse_size(building.max_size, "--max-size")
    part, parts = (1, 1) if building.shard is None else parse_part(building.shard)
    note_plan_too_far(plan)
    size = planned_size(plan)
    if building.dry_run:
        _echo_estimate(plan, size, size["bytes"] // parts <= limit, building)
        return
    refuse_input_files(outputs_of(out), plan)
    _note_large(plan, out, {name: n // parts for name, n in size.items()}, parts, limit, building)
    with LongWork("rendering") as progress:
        options: dict[str, Any] = {
            "workers": building.workers, "resume": building.resume, "force": building.force,
            "shard_items": building.shard_size, "scheduler": building.scheduler, "progress": progress,
        }  # fmt: skip
        if building.shard is not None:
            build_part(plan, (part, parts), out, **options)
        else:
            build(plan, out, **options).close()
    if building.as_json:
        echo_json({"path": str(out)})
    else:
        echo(out)


def _echo_estimate(plan: AnyPlan, size: Mapping[str, int], fits: bool, building: Building) -> None:
    """Print how large a build would be, and about how long it would take if it is not too large to be tried."""
    from phasemark.data.partial_outputs import estimate_build
    from phasemark.data.plans.arrays import too_many
    from phasemark.data.shards.build import processors

    facts: dict[str, Any] = dict(size)
    many = too_many(size)
    about = f"not tried: {many or 'the file would be larger than --max-size'}"
    if fits and many is None:
        facts = estimate_build(plan, workers=building.workers or processors())
        about = f"about {facts['seconds']:.3g}"
    seconds = facts.get("seconds") if building.as_json else about
    echo_facts({**facts, "seconds": seconds}, as_json=building.as_json)


def _note_large(plan: AnyPlan, out: Path, size: Mapping[str, int], parts: int, limit: int, building: Building) -> None:
    """Refuse a file above the limit; say of a large one how large it is and about how long it takes."""
    from phasemark.data.partial_outputs import estimate_build
    from phasemark.data.plans.arrays import format_size, refuse_too_many
    from phasemark.data.shards.build import processors
    from phasemark.data.shards.run import refuse_unwritable_output

    n_bytes = size["bytes"]
    counts = ", ".join(f"{n} {name}" for name, n in size.items() if name != "bytes")
    described = f"{out}: {counts}, {format_size(n_bytes)}"
    if n_bytes > limit:
        smaller = "take fewer 'views' or 'frames_per_view', or 'keep' less of scenes"
        if "images" in size:
            smaller = "thin 'distance_m' or 'delta_deg', keep fewer pixels (--region landmark, --binning N)"
        raise UsageError(
            f"{described}, would be larger than --max-size {format_size(limit)}: {smaller}, or allow"
            f" --max-size {format_size(n_bytes * 11 // 10).replace(' ', '')}"
        )
    if n_bytes >= NOTED_BYTES:
        refuse_too_many(plan)
        refuse_unwritable_output(out, force=building.force, resume=building.resume)
        threads = building.workers or processors()
        trial_seconds = 2.0  # about how long that time is tried for
        seconds = estimate_build(plan, workers=threads, trial_seconds=trial_seconds)["seconds"] / parts
        tell(f"note: {described}; about {duration(seconds)} on {threads} processors here")


def merge_shards(shards: Sequence[Path], out: Path, resume: bool, force: bool) -> None:
    """Put parts of a bank or a frame set together."""
    from phasemark.data.partial_outputs import merge_parts
    from phasemark.data.shards.run import outputs_of

    refuse_input_files(outputs_of(out))
    with LongWork("merging") as progress:
        merge_parts(shards, out, resume=resume, force=force, progress=progress)
    echo(out)
