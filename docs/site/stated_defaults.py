"""Defaults of parameters and signatures of models on the site: those of the signature, or of the fields of a model.

The reader of docstrings takes the first of several choices for the default, gives parameters that share a line the
default of the first, and knows no fields of models whose ``__init__`` takes any keyword.
"""

from __future__ import annotations

import re
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
        if isinstance(member, griffe.Class):
            _state_fields(member)
        if isinstance(member, griffe.Module | griffe.Class):
            _mend(member)
        if isinstance(member, griffe.Function | griffe.Class) and member.docstring:
            for section in member.docstring.parsed:
                if section.kind is griffe.DocstringSectionKind.parameters:
                    for parameter in section.value:
                        _take_default(member, parameter)
                        _take_type(member, parameter)
                        if "path - like" in str(parameter.annotation):  # the reader takes the hyphen for a minus
                            parameter.annotation = str(parameter.annotation).replace("path - like", "path-like")


def _take_type(owner: griffe.Function | griffe.Class, parameter: griffe.DocstringParameter) -> None:
    """Give a parameter without a type of its own that of its signature; the reader gives it that of another one."""
    in_signature = {stated.name: stated.annotation for stated in owner.parameters}
    own = in_signature.pop(parameter.name, None)
    if own is None or isinstance(parameter.annotation, str):
        return
    if any(parameter.annotation is annotation for annotation in in_signature.values()):
        parameter.annotation = own


def _state_fields(model: griffe.Class) -> None:
    """Give a model whose ``__init__`` takes any keyword the signature of its fields."""
    takes = [tuple(parameter.name for parameter in init.parameters) for init in _inits(model)]
    if ("self", "data") not in takes or ("__init__" in model.members and takes[0] != ("self", "data")):
        return
    fields: dict[str, griffe.Attribute] = {}
    for owner in (*reversed(model.mro()), model):
        for name, member in owner.members.items():
            stated = member.is_attribute and "property" not in member.labels and member.annotation is not None
            stated = stated and set(member.labels) != {"class-attribute"}
            if stated and not name.startswith("_") and "ClassVar" not in str(member.annotation):
                fields[name] = member
    if not fields:  # a base whose models still say that they take any keyword
        return
    parameters = [griffe.Parameter("self", kind=griffe.ParameterKind.positional_or_keyword)]
    parameters += [
        griffe.Parameter(
            name,
            annotation=_plain_type(field.annotation),
            kind=griffe.ParameterKind.keyword_only,
            default=_of_field(field.value),
        )
        for name, field in fields.items()
    ]
    model.set_member("__init__", griffe.Function("__init__", parameters=griffe.Parameters(*parameters)))


def _inits(model: griffe.Class) -> list[griffe.Function]:
    """Return the ``__init__`` of a class and of all that it inherits from."""
    found = [owner.members.get("__init__") for owner in (model, *model.mro())]
    return [init for init in found if init is not None and init.is_function]


def _plain_type(annotation: Any) -> Any:
    """Return a type without its limits; None for an internal name."""
    if isinstance(annotation, griffe.ExprSubscript) and str(annotation.left) == "Annotated":
        inner = annotation.slice
        annotation = inner.elements[0] if isinstance(inner, griffe.ExprTuple) else inner
    if "Annotated[" in str(annotation):  # within a tuple, or beside None
        annotation = re.sub(r"Annotated\[(\w+), Field\([^()]*\)\]", r"\1", str(annotation))
    return None if any(word.startswith("_") for word in re.findall(r"\w+", str(annotation))) else annotation


def _take_default(owner: griffe.Function | griffe.Class, parameter: griffe.DocstringParameter) -> None:
    if parameter.name in owner.parameters:
        parameter.value = _constant(owner, owner.parameters[parameter.name].default)
    elif isinstance(owner, griffe.Class):
        field = owner.all_members.get(parameter.name)
        if field is not None and field.is_attribute:
            parameter.value = _constant(owner, _of_field(field.value))


def _constant(owner: griffe.Object, value: Any) -> Any:
    """Return the number or text that a constant of the module stands for; anything else as it is."""
    known = owner.module.members.get(str(value)) if isinstance(value, griffe.ExprName) else None
    while isinstance(known, griffe.Alias):
        folder, _, name = known.target_path.removeprefix(f"{owner.package.path}.").rpartition(".")
        known = owner.package[folder].members.get(name) if known.target_path.startswith(owner.package.path) else None
    if known is None or not known.is_attribute:
        return value
    return known.value if re.fullmatch(r"[-+\d._e]+|'[^']*'|\"[^\"]*\"", str(known.value)) else value


def _of_field(value: Any) -> Any:
    """Return what ``Field(...)`` of pydantic states for a default, or a default that stands by itself."""
    if not isinstance(value, griffe.ExprCall) or str(value.function) != "Field":
        return value
    stated = {argument.name: argument.value for argument in value.arguments if isinstance(argument, griffe.ExprKeyword)}
    if "default_factory" not in stated:
        return stated.get("default")
    factory = str(stated["default_factory"])
    return factory.removeprefix("lambda: ") if factory.startswith("lambda: ") else f"{factory}()"
