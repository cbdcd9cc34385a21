"""A sensor as a TOML file, every number with a comment that says where it comes from."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel

from phasemark.inputs.toml_file import toml_value
from phasemark.render.sensor.histogram_fields import Histogram
from phasemark.render.sensor.lens_fields import DERIVED, Lens
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.sensor.sensor_fields import TABLES

_MODELS: dict[str, type[BaseModel]] = {"lens": Lens, "histogram": Histogram}
_DIGITS = 7  # of a number in a sensor file


def sensor_toml(sensor: Sensor, comments: Mapping[str, str], *, header: Sequence[str], otherwise: str) -> str:
    """Return a sensor as the text of a file that :meth:`Sensor.from_toml` reads.

    Parameters
    ----------
    sensor : Sensor
    comments : mapping of str to str
        What stands behind a field; such a field is written even where it has its default.
    header : sequence of str
        Lines of comment at the top.
    otherwise : str
        What stands behind the other fields.
    """
    fields = sensor.model_dump(mode="json")
    tables = {name: fields.pop(name) for name in TABLES if name in fields}
    derived = DERIVED if sensor.lens is not None else ()
    lines = [f"# {line}" for line in header]
    for title, names in Sensor.field_groups().items():
        own = [
            name
            for name in names
            if name in comments
            or (fields.get(name) is not None and fields[name] != _plain_default(name))
            or Sensor.model_fields[name].is_required()
        ]
        own = [name for name in own if name not in TABLES and (name in comments or name not in derived)]
        if own:
            lines += ["", f"# {title}"]
        lines += [f"{name} = {toml_value(fields[name])}  # {comments.get(name, otherwise)}" for name in own]
    for title, table in tables.items():
        lines += ["", f"[{title}]"]
        for name, value in table.items():
            comment = comments.get(f"{title}.{name}")
            if comment is not None or (value is not None and value != _default_of(_MODELS[title], name)):
                lines.append(f"{name} = {toml_value(value)}  # {comment or otherwise}")
    return "\n".join(lines) + "\n"


def rounded(value: Any) -> Any:
    """Round the floats of a field to the digits of a sensor file."""
    if isinstance(value, tuple):
        return tuple(rounded(one) for one in value)
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value


def _plain_default(name: str) -> object:
    return _default_of(Sensor, name)


def _default_of(model: type[BaseModel], name: str) -> object:
    default = model.model_fields[name].default
    return list(default) if isinstance(default, tuple) else default


def comments_of(text: str) -> dict[str, str]:
    """Return the comments behind the keys of a sensor file, by key; those of a table as ``table.key``.

    Examples
    --------
    >>> comments_of("rows = 8  # published")
    {'rows': 'published'}
    """
    found: dict[str, str] = {}
    table = ""
    for line in text.splitlines():
        heading = re.fullmatch(r"\s*\[(\w+)\]\s*(#.*)?", line)
        if heading:
            table = f"{heading[1]}."
        stated = re.fullmatch(r"\s*(\w+)\s*=[^#]*#\s*(.*\S)\s*", line)
        if stated:
            found[table + stated[1]] = stated[2]
    return found
