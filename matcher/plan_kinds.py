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
from phasemark.data.plans.bank_plan import BankPlan, ScenePlan, read_plan
from phasemark.data.plans.frame_plan import FramePlan
from phasemark.inputs.toml_file import read_toml
from phasemark.matcher.design import DesignPlan, example_design, read_design_plan
from phasemark.matcher.drive import DrivePlan, example_drive, read_drive_plan
from phasemark.matcher.sweep.plan import SweepPlan, read_sweep_plan


@dataclass(frozen=True)
class _Kind:
    """A kind of plan: its model, its example, and how a file of it is read."""

    model: type[BaseModel]
    example: Callable[[], str]
    load: Callable[[str | os.PathLike[str]], BaseModel]


def _shipped(package: str, name: str) -> Callable[[], str]:
    return partial(resources.files(package).joinpath(name).read_text, encoding="utf-8")


def _read_scene(model: type[ScenePlan], path: str | os.PathLike[str]) -> BaseModel:
    plan = read_plan(path, model)
    try:
        return plan.resolve()
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None


_KINDS = {
    # first, for what might be any of them
    "bank": _Kind(BankPlan, _shipped("phasemark.data.plans", "examples/bank.toml"), partial(_read_scene, BankPlan)),
    "frames": _Kind(
        FramePlan, _shipped("phasemark.data.plans", "examples/frames.toml"), partial(_read_scene, FramePlan)
    ),
    "sweep": _Kind(
        SweepPlan, _shipped("phasemark.matcher.sweep", "plans/paper.toml"), lambda path: read_sweep_plan(path).resolve()
    ),
    "drive": _Kind(DrivePlan, example_drive, read_drive_plan),
    "design": _Kind(DesignPlan, example_design, read_design_plan),
}
KINDS = tuple(_KINDS)
"""Names of all kinds."""


def plan_example(kind: str) -> str:
    """Return a plan of a kind, with comments, as TOML.

    Parameters
    ----------
    kind : {"bank", "frames", "sweep", "drive", "design"}

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
    kind : {"bank", "frames", "sweep", "drive", "design"}

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
    """Read a plan, resolve it, and return its kind and the resolved plan.

    Parameters
    ----------
    path : path-like
    kind : str, optional
        What it should be; without it, the kind that knows most of the plan's keys.

    Returns
    -------
    kind : str
    plan : BankPlan, FramePlan, SweepPlan, DrivePlan or DesignPlan
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
    return kind, _kind(kind).load(path)


def _kind(name: str) -> _Kind:
    if name not in _KINDS:
        raise UsageError(f"unknown kind of plan '{name}': there are {', '.join(KINDS)}")
    return _KINDS[name]
