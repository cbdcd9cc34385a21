"""Commands that note which files they were given to read, and whose options may come in groups.

A group is a frozen dataclass whose fields are annotated as options. A command that has it as a parameter takes each
field as an option of its own, in the place of the group, and gets one object.
"""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

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
        """Return a decorator that adds a function as a command."""
        add = super().command(name, cls=_Command, **options)

        def added(function: _Function) -> _Function:
            add(_with_options_of_groups(function))
            return function

        return added


@dataclass(frozen=True)
class Without:
    """Options of a group that a command does not have: ``Annotated[Group, Without("field")]``."""

    names: tuple[str, ...]

    def __init__(self, *names: str) -> None:
        object.__setattr__(self, "names", names)


def _with_options_of_groups(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function with a parameter for each field of those of its parameters that are groups."""
    hints = get_type_hints(function, include_extras=True)
    parameters: list[Parameter] = []
    groups: dict[str, tuple[type, list[str]]] = {}
    for name, parameter in signature(function).parameters.items():
        group, left_out = _group_of(hints[name])
        if group is None:
            parameters.append(_option(name, hints[name], parameter.default))
            continue
        options = [field for field in fields(group) if field.name not in left_out]
        kinds = get_type_hints(group, include_extras=True)
        default = {field.name: Parameter.empty if field.default is MISSING else field.default for field in options}
        parameters += [_option(field.name, kinds[field.name], default[field.name]) for field in options]
        groups[name] = group, [field.name for field in options]

    @wraps(function)
    def command(**values: Any) -> Any:
        for name, (group, names) in groups.items():
            values[name] = group(**{option: values.pop(option) for option in names})
        return function(**values)

    del command.__wrapped__  # or its parameters would be those of the function
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    command.__signature__ = Signature(parameters)  # type: ignore[attr-defined]  # what typer reads
    return command


def _option(name: str, kind: Any, default: Any) -> Parameter:
    return Parameter(name, Parameter.KEYWORD_ONLY, annotation=kind, default=default)


def _group_of(kind: Any) -> tuple[Any, tuple[str, ...]]:
    """Return the group that a parameter is, or None, and which of its options the command does not have."""
    if is_dataclass(kind):
        return kind, ()
    if get_origin(kind) is Annotated and is_dataclass(get_args(kind)[0]):
        group, *notes = get_args(kind)
        return group, next((note.names for note in notes if isinstance(note, Without)), ())
    return None, ()
