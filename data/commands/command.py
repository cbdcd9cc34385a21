"""Commands whose options are made from their signatures and docstrings, and which note the files they are to read.

A parameter before ``*`` becomes an argument, one behind it an option. Its name makes the metavar or the flag, without a
suffix ``_file`` or ``_name``; its description in the docstring is the help. :class:`Shown` has further settings.

A group is a frozen dataclass whose fields become options in the same way. A command that has it as a parameter takes
each field as an option of its own, in the place of the group, and gets one object; its docstring may describe fields in
other words than the group does.
"""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from contextvars import ContextVar
from dataclasses import MISSING, fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature, getdoc, signature
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperCommand

from phasemark import UsageError

_DESCRIPTION = re.compile(r"^(\w+)\n((?: +.+\n?)+)", re.MULTILINE)
"""A parameter in a docstring, and its description."""
_SUFFIX = re.compile(r"(?<!_or)_(?:file|name)$|_$")
"""End of a parameter's name that its flag or metavar does not have."""
_Function = TypeVar("_Function", bound=Callable[..., Any])

OUTPUTS = ("out", "plot", "picture", "estimates", "to")
"""Parameters of commands that name what is written; all other files that a command is given are read."""

options_given: ContextVar[dict[str, str]] = ContextVar("options", default={})  # noqa: B039  it is replaced, not changed
"""The options that the running command was given, flags by names of parameters."""
inputs_given: ContextVar[tuple[Path, ...]] = ContextVar("inputs", default=())
"""The files that the running command was given to read."""


class _Command(TyperCommand):
    """A command that notes which files it was given to read, so that none of them becomes its output."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        from rich.markup import escape

        shown: list[Any] = [self, *self.params]
        for one in shown:
            one.help = escape(one.help or "")  # or words in square brackets would be taken for styles
        super().format_help(ctx, formatter)

    def invoke(self, ctx: Any) -> Any:
        from phasemark.data.files.same_file import named_files

        given = {name: value for name, value in ctx.params.items() if name not in OUTPUTS}
        inputs_given.set(tuple(named_files(given)))
        stated = [one for one in self.params if ctx.get_parameter_source(one.name).name == "COMMANDLINE"]
        options_given.set({str(one.name): one.opts[0] for one in stated if one.opts[0].startswith("-")})
        return super().invoke(ctx)


def refuse_options(because: str, names: Iterable[str] | None = None, *, but: Iterable[str] = ()) -> None:
    """Refuse options that were given to the running command and that nothing is done with.

    Parameters
    ----------
    because : str
        Why: "only with --start".
    names : iterable of str, optional
        Parameters to refuse; None: all.
    but : iterable of str
        Parameters that are not refused.

    Raises
    ------
    UsageError
    """
    flags = [flag for name, flag in options_given.get().items() if name not in but and (names is None or name in names)]
    if flags:
        raise UsageError(f"{', '.join(flags)}: {because}")


class Commands(typer.Typer):
    """Commands that note which files they read."""

    def command(self, name: str | None = None, **options: Any) -> Callable[[_Function], _Function]:
        """Return a decorator that adds a function as a command."""
        add = super().command(name, cls=_Command, **options)

        def added(function: _Function) -> _Function:
            add(_with_options_of_groups(function))
            return function

        return added


class Shown:
    """Settings of an option beyond its name, type, default and docstring: ``Annotated[float, Shown(metavar="M")]``.

    Parameters
    ----------
    *flags : str
        In place of the flag that the name makes.
    help : str
        For parameters that no docstring describes.
    **settings
        Further arguments of ``typer.Option`` or ``typer.Argument``.
    """

    def __init__(self, *flags: str, **settings: Any) -> None:
        self.settings = {**settings, "param_decls": flags} if flags else settings


class Without:
    """Options of a group that a command does not have: ``Annotated[Group, Without("field")]``."""

    def __init__(self, *names: str) -> None:
        self.names = names


def _with_options_of_groups(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function with a parameter for each field of those of its parameters that are groups."""
    hints = get_type_hints(function, include_extras=True)
    text, described = _described(function)
    parameters: list[Parameter] = []
    groups: dict[str, tuple[type, list[str]]] = {}
    for name, parameter in signature(function).parameters.items():
        group, left_out = _group_of(hints[name])
        if group is None:
            make = typer.Option if parameter.kind is Parameter.KEYWORD_ONLY else typer.Argument
            parameters.append(_parameter(name, hints[name], parameter.default, described, make))
            continue
        kinds, of_group = get_type_hints(group, include_extras=True), _described(group)[1] | described
        options = [field for field in fields(group) if field.name not in left_out]
        for field in options:
            default = Parameter.empty if field.default is MISSING else field.default
            parameters.append(_parameter(field.name, kinds[field.name], default, of_group))
        groups[name] = group, [field.name for field in options]

    @wraps(function)
    def command(**values: Any) -> Any:
        for name, (group, names) in groups.items():
            values[name] = group(**{option: values.pop(option) for option in names})
        return function(**values)

    del command.__wrapped__  # or its parameters would be those of the function
    command.__doc__ = text
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    command.__signature__ = Signature(parameters)  # type: ignore[attr-defined]  # what typer reads
    return command


def _described(documented: Any) -> tuple[str, dict[str, str]]:
    """Return the docstring of a function or group, and apart from it the descriptions of its parameters."""
    text, _, listed = (getdoc(documented) or "").partition("\n\nParameters\n----------\n")
    return text, {name: " ".join(lines.split()) for name, lines in _DESCRIPTION.findall(listed)}


def _settings(kind: Any) -> dict[str, Any]:
    """Return the settings in the annotations of a type; outer annotations replace inner ones."""
    found: dict[str, Any] = {}
    for part in get_args(kind):
        found |= part.settings if isinstance(part, Shown) else _settings(part)
    return found


def _parameter(name: str, kind: Any, default: Any, described: Mapping[str, str], make: Any = typer.Option) -> Parameter:
    """Return a parameter as typer reads it; `make` is typer.Option or typer.Argument."""
    if make is typer.Argument:
        metavar = _SUFFIX.sub("", name).upper().replace("_OR_", "|") + ("..." if get_origin(kind) is list else "")
        settings: dict[str, Any] = {"metavar": f"[{metavar}]" if default is None else metavar, "param_decls": ()}
    else:
        settings = {"param_decls": (_flag(name),)}
    settings |= _settings(kind)
    if name in described:
        settings["help"] = described[name]
    shown = make(... if default is Parameter.empty else default, *settings.pop("param_decls"), **settings)
    return Parameter(name, Parameter.KEYWORD_ONLY, annotation=kind, default=shown)


def _flag(name: str) -> str:
    """Return the flag that the name of a parameter makes."""
    return "--" + _SUFFIX.sub("", name).replace("_", "-")


def stated_flags(group: Any, *names: str) -> list[str]:
    """Return the flags of those fields of a group, or of the named ones, that are not at their defaults."""
    defaults = {field.name: field.default for field in fields(group)}
    return [_flag(name) for name in names or defaults if getattr(group, name) != defaults[name]]


def _group_of(kind: Any) -> tuple[Any, tuple[str, ...]]:
    """Return the group that a parameter is, or None, and which of its options the command does not have."""
    if is_dataclass(kind):
        return kind, ()
    if get_origin(kind) is Annotated and is_dataclass(get_args(kind)[0]):
        group, *notes = get_args(kind)
        return group, next((note.names for note in notes if isinstance(note, Without)), ())
    return None, ()
