"""Every kind of plan there is: those of banks and frame sets, and those of sweeps, drives and designs."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from typing import Any

from pydantic import BaseModel

from phasemark import InputFileError, UsageError
from phasemark import data as files
from phasemark.data.plan import read_toml
from phasemark.data.plan_kinds import schema_of
from phasemark.matcher.design import DesignPlan, example_design, load_design_plan
from phasemark.matcher.drive import DrivePlan, example_drive, load_drive_plan
from phasemark.matcher.sweep_plan import SweepPlan, load_sweep


@dataclass(frozen=True)
class _Kind:
    """A kind of plan: its model, its example, how a file of it is read, and keys that tell it from the others."""

    model: type[BaseModel]
    example: Callable[[], str]
    load: Callable[[str | os.PathLike[str]], BaseModel]
    keys: frozenset[str]


def _example_sweep() -> str:
    return resources.files("phasemark.matcher").joinpath("plans", "paper.toml").read_text(encoding="utf-8")


_KINDS = {
    "sweep": _Kind(SweepPlan, _example_sweep, lambda path: load_sweep(path).resolve(), frozenset({"axes", "methods"})),
    "drive": _Kind(DrivePlan, example_drive, load_drive_plan, frozenset({"map", "path", "odometry"})),
    "design": _Kind(
        DesignPlan, example_design, load_design_plan, frozenset({"n_classes", "limits", "sampling", "search"})
    ),
}
KINDS = (*files.PLAN_KINDS, *_KINDS)
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
    _refuse_unknown(kind)
    return _KINDS[kind].example() if kind in _KINDS else files.plan_example(kind)


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
    _refuse_unknown(kind)
    return schema_of(kind, _KINDS[kind].model) if kind in _KINDS else files.plan_schema(kind)


def check_plan(path: str | os.PathLike[str], kind: str | None = None) -> tuple[str, BaseModel]:
    """Read a plan, resolve it, and return its kind and the resolved plan.

    Parameters
    ----------
    path : path-like
    kind : str, optional
        What it should be; without it, the plan's keys tell.

    Returns
    -------
    kind : str
    plan : BankPlan, FramePlan, SweepPlan or DrivePlan
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
        kind = next((name for name, one in _KINDS.items() if keys & one.keys), None)
    if kind is None or kind in files.PLAN_KINDS:
        return files.check_plan(path, kind)
    _refuse_unknown(kind)
    return kind, _KINDS[kind].load(path)


def _refuse_unknown(kind: str) -> None:
    if kind not in KINDS:
        raise UsageError(f"unknown kind of plan '{kind}': there are {', '.join(KINDS)}")
