"""Defaults of parameters on the site: those of the signature, or of the field of a model.

The reader of docstrings takes the first of several choices for the default, gives parameters that share a line the
default of the first, and knows no fields of models whose ``__init__`` takes any keyword.
"""

from __future__ import annotations

from typing import Any

import griffe


class StatedDefaults(griffe.Extension):
    """Replace the defaults that the reader of docstrings guesses."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Go through every function and class of a package."""
        _mend(pkg)


def _mend(thing: griffe.Object) -> None:
    for member in thing.members.values():
        if isinstance(member, griffe.Alias):
            continue
        if isinstance(member, griffe.Module | griffe.Class):
            _mend(member)
        if isinstance(member, griffe.Function | griffe.Class) and member.docstring:
            for section in member.docstring.parsed:
                if section.kind is griffe.DocstringSectionKind.parameters:
                    for parameter in section.value:
                        _take_default(member, parameter)


def _take_default(owner: griffe.Function | griffe.Class, parameter: griffe.DocstringParameter) -> None:
    if parameter.name in owner.parameters:
        parameter.value = owner.parameters[parameter.name].default
    elif isinstance(owner, griffe.Class):
        field = owner.all_members.get(parameter.name)
        if field is not None and field.is_attribute:
            parameter.value = _of_field(field.value)


def _of_field(value: Any) -> Any:
    """Return what ``Field(...)`` of pydantic states for a default, or a default that stands by itself."""
    if not isinstance(value, griffe.ExprCall) or str(value.function) != "Field":
        return value
    stated = {argument.name: argument.value for argument in value.arguments if isinstance(argument, griffe.ExprKeyword)}
    if "default_factory" not in stated:
        return stated.get("default")
    factory = str(stated["default_factory"])
    return factory.removeprefix("lambda: ") if factory.startswith("lambda: ") else f"{factory}()"
