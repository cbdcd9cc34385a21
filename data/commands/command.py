"""Commands that note which files they were given to read."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TypeVar

import typer
from typer.core import TyperCommand

_Function = TypeVar("_Function", bound=Callable[..., Any])
OUTPUTS = ("out", "plot", "estimates")
"""Parameters of commands that name what is written; all other files that a command is given are read."""

inputs_given: ContextVar[tuple[Path, ...]] = ContextVar("inputs", default=())
"""The files that the running command was given to read."""


class _Command(TyperCommand):
    """A command that notes which files it was given to read, so that none of them becomes its output."""

    def invoke(self, ctx: Any) -> Any:
        from phasemark.data.files.same_file import named_files

        given = {name: value for name, value in ctx.params.items() if name not in OUTPUTS}
        inputs_given.set(tuple(named_files(given)))
        return super().invoke(ctx)


class Commands(typer.Typer):
    """Commands that note which files they read."""

    def command(self, name: str | None = None, **options: Any) -> Callable[[_Function], _Function]:
        """Return what adds a function as a command."""
        return super().command(name, cls=_Command, **options)
