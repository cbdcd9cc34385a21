"""The kinds of plan of files: an example of each, its JSON Schema, and which kind a file is."""

from __future__ import annotations

import os
import tomllib
from importlib import resources
from typing import Any

from pydantic import BaseModel

from phasemark import UsageError
from phasemark.data.frame_plan import FramePlan
from phasemark.data.plan import BankPlan, ScenePlan, read_plan

PLAN_KINDS: dict[str, type[ScenePlan]] = {"bank": BankPlan, "frames": FramePlan}


def plan_example(kind: str) -> str:
    """Return a plan of a kind, with comments, as TOML.

    Parameters
    ----------
    kind : {"bank", "frames"}

    Returns
    -------
    str

    Raises
    ------
    UsageError
        There is no such kind.
    """
    _model(kind)
    return resources.files("phasemark.data").joinpath("plans", f"{kind}.toml").read_text(encoding="utf-8")


def plan_schema(kind: str) -> dict[str, Any]:
    """Return the JSON Schema of a kind of plan.

    Parameters
    ----------
    kind : {"bank", "frames"}

    Returns
    -------
    dict

    Raises
    ------
    UsageError
        There is no such kind.
    """
    return schema_of(kind, _model(kind))


def schema_of(kind: str, model: type[BaseModel]) -> dict[str, Any]:
    """Return the JSON Schema of a model as that of a kind of plan."""
    schema = model.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": f"phasemark {kind} plan"}


def check_plan(path: str | os.PathLike[str], kind: str | None = None) -> tuple[str, ScenePlan]:
    """Read a plan, resolve it, and return its kind and the resolved plan.

    Parameters
    ----------
    path : path-like
    kind : str, optional
        What it should be; without it, a plan with ``views`` is one of a frame set, any other one of a bank.

    Returns
    -------
    kind : str
    plan : BankPlan or FramePlan
        The resolved plan.

    Raises
    ------
    InputFileError, UsageError
        With one line that names the file, the key, the value and what would be right.
    """
    if kind is None:
        try:
            with open(path, "rb") as file:
                kind = "frames" if "views" in tomllib.load(file) else "bank"
        except (OSError, ValueError, RecursionError):
            kind = "bank"  # reading it below says what is wrong
    plan = read_plan(path, _model(kind))
    try:
        return kind, plan.resolve()
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None


def _model(kind: str) -> type[ScenePlan]:
    if kind not in PLAN_KINDS:
        raise UsageError(f"unknown kind of plan '{kind}': there are {', '.join(PLAN_KINDS)}")
    return PLAN_KINDS[kind]
