"""The kinds of plan there are, whichever part of the program they belong to: examples, JSON Schemas, checks."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import resources
from typing import Any

from pydantic import BaseModel

from phasemark import InputFileError, UsageError
from phasemark.data.bank.build_bank import BankJob
from phasemark.data.frames.build_frames import FrameJob
from phasemark.data.plans.bank_plan import BankPlan, factored_refusal, read_plan
from phasemark.data.plans.frame_plan import FramePlan
from phasemark.data.plans.scene_frames_plan import SceneFramesPlan
from phasemark.inputs.toml_file import read_toml
from phasemark.matcher.design import DesignPlan, example_design, read_design_plan
from phasemark.matcher.design.search import Search
from phasemark.matcher.drive import DrivePlan, example_drive, read_drive_plan
from phasemark.matcher.drive.simulate import specs_of
from phasemark.matcher.sweep.job import Round, SweepJob
from phasemark.matcher.sweep.plan import SweepPlan, read_sweep_plan


@dataclass(frozen=True)
class _Kind:
    """A kind of plan: its model, its example, and how a file of it is read."""

    model: type[BaseModel]
    example: Callable[[], str]
    load: Callable[[str | os.PathLike[str]], BaseModel]


def _shipped(package: str, name: str) -> Callable[[], str]:
    return partial(resources.files(package).joinpath(name).read_text, encoding="utf-8")


_CHECKED_VIEWS = 1 << 20
"""Most views of a frame set that are drawn and checked; it takes seconds."""


def _read_bank(path: str | os.PathLike[str]) -> BankPlan:
    """Read the plan of a bank, and refuse what its build would refuse; nearer views than the first are not built."""
    plan = read_plan(path, BankPlan)
    resolved = plan.resolve()
    changes: dict[str, Any] = {"distance_m": resolved.distance_m[:1]}
    if "layout" not in plan.model_fields_set and factored_refusal(resolved) is not None:
        changes["layout"] = "full"  # as the command builds it
    BankJob(resolved.model_copy(update=changes)).check_views()
    return resolved


def _read_frames(path: str | os.PathLike[str]) -> FramePlan:
    """Read the plan of a frame set, and refuse what its build would refuse."""
    plan = read_plan(path, FramePlan).resolve()
    FrameJob(plan.model_copy(update={"views": min(plan.views, _CHECKED_VIEWS)})).check_views()
    return plan


def _read_scenes(path: str | os.PathLike[str]) -> SceneFramesPlan:
    """Read the plan of a frame set of scenes, and refuse a camera that is unknown; the generator is not run."""
    plan = read_plan(path, SceneFramesPlan)
    plan.build_sensor()
    return plan


def _read_sweep(path: str | os.PathLike[str]) -> SweepPlan:
    """Read the plan of a sweep, and refuse what its banks, cameras and views would be refused for."""
    plan = read_sweep_plan(path).resolve()
    SweepJob(plan, Round.first_of(plan)).check_views()
    for method in plan.methods:
        bank = plan.bank_plan(method)
        BankJob(bank.model_copy(update={"distance_m": bank.distance_m[:1]})).check_views()
    return plan


def _read_drive(path: str | os.PathLike[str]) -> DrivePlan:
    """Read the plan of a drive, and refuse a camera or landmarks that are not shipped."""
    plan = read_drive_plan(path)
    plan.build_sensor()
    specs_of(plan)
    return plan


def _read_design(path: str | os.PathLike[str]) -> DesignPlan:
    """Read the plan of a design, and refuse a camera or a range that no landmark can serve."""
    plan = read_design_plan(path)
    Search(plan)
    return plan


_KINDS = {
    # first, for what might be any of them
    "bank": _Kind(BankPlan, _shipped("phasemark.data.plans", "examples/bank.toml"), _read_bank),
    "frames": _Kind(FramePlan, _shipped("phasemark.data.plans", "examples/frames.toml"), _read_frames),
    "scenes": _Kind(SceneFramesPlan, _shipped("phasemark.data.plans", "examples/scenes.toml"), _read_scenes),
    "sweep": _Kind(SweepPlan, _shipped("phasemark.matcher.sweep", "plans/paper.toml"), _read_sweep),
    "drive": _Kind(DrivePlan, example_drive, _read_drive),
    "design": _Kind(DesignPlan, example_design, _read_design),
}
KINDS = tuple(_KINDS)
"""Names of all kinds."""


def plan_example(kind: str) -> str:
    """Return a plan of a kind, with comments, as TOML.

    Parameters
    ----------
    kind : {"bank", "frames", "scenes", "sweep", "drive", "design"}

    Returns
    -------
    str

    Raises
    ------
    UsageError
        There is no such kind.
    """
    return _kind(kind).example()


def plan_schema(kind: str) -> dict[str, Any]:
    """Return the JSON Schema of a kind of plan.

    Parameters
    ----------
    kind : {"bank", "frames", "scenes", "sweep", "drive", "design"}

    Returns
    -------
    dict

    Raises
    ------
    UsageError
        There is no such kind.
    """
    schema = _kind(kind).model.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": f"phasemark {kind} plan"}


def check_plan(path: str | os.PathLike[str], kind: str | None = None) -> tuple[str, BaseModel]:
    """Read a plan, resolve it, and return its kind and the resolved plan; what a run refuses at once is refused.

    Files that the plan names are read and views are checked; nothing is rendered, and no program of a method is run.

    Parameters
    ----------
    path : path-like
    kind : str, optional
        What it should be; without it, the kind that knows most of the plan's keys.

    Returns
    -------
    kind : str
    plan : BankPlan, FramePlan, SceneFramesPlan, SweepPlan, DrivePlan or DesignPlan
        The resolved plan.

    Raises
    ------
    InputFileError, UsageError
        With one line that names the file, the key, the value and what would be right.
    """
    if kind is None:
        try:
            keys = set(read_toml(path))
        except InputFileError:
            keys = set()  # reading it below says what is wrong
        kind = max(KINDS, key=lambda name: len(keys & set(_KINDS[name].model.model_fields)))
    load = _kind(kind).load
    try:
        return kind, load(path)
    except UsageError as error:
        where = os.fspath(path)
        raise error if str(error).startswith(f"{where}: ") else UsageError(f"{where}: {error}") from None


def _kind(name: str) -> _Kind:
    if name not in _KINDS:
        raise UsageError(f"unknown kind of plan '{name}': there are {', '.join(KINDS)}")
    return _KINDS[name]
