"""Commands of ``phasemark bank`` that build, describe and merge."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from phasemark import UsageError
from phasemark.data.commands.build import build_or_estimate, merge_shards
from phasemark.data.commands.command import Shown, refuse_options
from phasemark.data.commands.console import echo_facts, tell
from phasemark.data.commands.inputs import name_and_file, open_any_bank
from phasemark.data.commands.options import (
    Building,
    ClassName,
    Force,
    Json,
    MeshReading,
    Out,
    Resume,
    SensorName,
    Shards,
)

if TYPE_CHECKING:
    from phasemark.data import BankPlan
    from phasemark.data.plans.bank_plan import MeshPlan

Grid = Annotated[str, Shown(metavar="START:STOP:STEP")]


def bank_build(
    plan_file: Path | None = None,
    *,
    out: Out,
    classes: Annotated[list[ClassName] | None, Shown("--class")] = None,
    meshes: Annotated[list[str] | None, Shown("--mesh", metavar="NAME=FILE")] = None,
    mesh_reading: MeshReading,
    symmetry: int | None = None,
    sensor: SensorName | None = None,
    distance: Grid | None = None,
    delta: Grid | None = None,
    model: Literal["ray", "hard", "planar"] | None = None,
    albedo: float | None = None,
    full: bool = False,
    region: Annotated[str | None, Shown(metavar="whole|landmark|R0:R1,C0:C1")] = None,
    margin: float | None = None,
    binning: Annotated[int | None, Shown(metavar="N")] = None,
    building: Building,
) -> None:
    """Build a bank of noise-free model images.

    Parameters
    ----------
    plan_file
        A plan (.toml); options override it.
    out
        The bank to write; its checksum goes beside it.
    classes
        A class of the catalogue; repeatable.
    meshes
        Repeatable.
    symmetry
        Number of turns that leave the mesh as it is; found from the mesh unless stated.
    sensor
        A preset or sensor file.
    distance
        Metres.
    delta
        Degrees.
    model
        ray: the exact integral; hard: centre rays, nothing mixed; or planar: the paper's own generator.
    albedo
        Share of light that the landmarks return, in place of their own.
    full
        Store every class at every D and δ; without it only where a landmark needs it.
    region
        Pixels to keep: all, those that a landmark can reach, or rows R0 … R1 and columns C0 … C1.
    margin
        Degrees around the landmark that --region landmark keeps too.
    binning
        Blocks of N × N pixels become one pixel.
    """
    from phasemark.data import BankPlan, build_bank
    from phasemark.data.plans.bank_plan import read_bank_plan
    from phasemark.landmarks import catalog

    if plan_file is not None and str(plan_file) in catalog():
        raise UsageError(f"'{plan_file}' is a class of the catalogue, not a plan: give --class {plan_file}")
    if not meshes:
        refuse_options("only with --mesh", ("unit", "up", "origin", "symmetry"))
    plan = BankPlan() if plan_file is None else read_bank_plan(plan_file)
    layout_stated = full or "layout" in plan.model_fields_set
    options: dict[str, Any] = {
        "sensor": sensor, "distance_m": distance, "delta_deg": delta, "model": model, "albedo": albedo,
        "layout": "full" if full else None, "region": None if region is None else _parsed_region(region),
        "binning": binning, "margin_deg": margin,
    }  # fmt: skip
    changes = {key: value for key, value in options.items() if value is not None}
    if classes or meshes:
        stated = tuple(_mesh_plan(one, mesh_reading, symmetry) for one in meshes or ())
        changes |= {"classes": tuple(classes or ()), "landmarks": (), "meshes": stated}
    plan = _completed(BankPlan(**{**plan.model_dump(), **changes}), layout_stated)
    build_or_estimate(build_bank, plan, out, building)


def _parsed_region(text: str) -> str | tuple[int, ...]:
    """Return a region as a plan has it."""
    if text in ("whole", "landmark"):
        return text
    found = re.fullmatch(r"(\d{1,5}):(\d{1,5}),(\d{1,5}):(\d{1,5})", text)
    if found is None:
        raise UsageError(f"--region must be whole, landmark or R0:R1,C0:C1 such as 20:140,50:170, got '{text[:40]}'")
    return tuple(map(int, found.groups()))


def _mesh_plan(name_and_path: str, reading: MeshReading, symmetry: int | None) -> MeshPlan:
    """Return the plan of a mesh that an option names."""
    from phasemark.data.plans.bank_plan import MeshPlan
    from phasemark.landmarks import read_mesh

    name, path = name_and_file(name_and_path)
    if reading.unit is None:
        read_mesh(path, unit=None)  # which says what the extents would be in each
    return MeshPlan(name=name, path=path, symmetry=symmetry, **vars(reading))


def _completed(plan: BankPlan, layout_stated: bool) -> BankPlan:
    """Return a plan with the symmetry found for its meshes, and a full layout where nothing less will do."""
    from phasemark.data.plans.bank_plan import factored_refusal

    resolved = plan.resolve()
    plan = plan.model_copy(update={"meshes": _with_symmetry(plan.meshes, resolved.meshes)})
    if not layout_stated and (reason := factored_refusal(resolved)) is not None:
        plan = plan.model_copy(update={"layout": "full"})
        if not plan.meshes:
            tell(f"note: a full bank, every class at every D and δ: {reason}")
    return plan


def bank_info(bank: Path, *, as_json: Json = False) -> None:
    """Print the content of a bank.

    Parameters
    ----------
    bank
        A bank.
    """
    with open_any_bank(bank) as opened:
        echo_facts(opened.info(), as_json=as_json)


def bank_merge(shards: Shards, *, out: Out, resume: Resume = False, force: Force = False) -> None:
    """Put the parts of a bank together.

    Parameters
    ----------
    out
        The bank to write.
    """
    merge_shards(shards, out, resume, force)


def _with_symmetry(meshes: Sequence[MeshPlan], found: Sequence[MeshPlan]) -> tuple[MeshPlan, ...]:
    """Return the meshes of a plan with the symmetry found for each, and say it where none was stated."""
    from phasemark.landmarks.symmetry import MAX_SYMMETRY

    for before, after in zip(meshes, found, strict=True):
        if before.symmetry is not None or after.symmetry is None:
            continue
        if after.symmetry == MAX_SYMMETRY:
            what = "is a body of revolution: no side of it can be told from another, and one δ is enough"
        elif after.symmetry > 1:
            what = f"looks the same every {360 / after.symmetry:g}° (symmetry {after.symmetry}): δ is known modulo that"
        else:
            what = (
                "has no symmetry about its axis z' (if it has one about another, --origin base brings z' into the"
                " middle of its bounding box)"
            )
        tell(f"note: '{after.name}' {what}; --symmetry N, or 'symmetry' in a plan, overrides this")
    return tuple(one.model_copy(update={"symmetry": other.symmetry}) for one, other in zip(meshes, found, strict=True))
