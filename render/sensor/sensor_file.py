"""A sensor as a TOML file, every number with a comment that says where it comes from."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from phasemark import UsageError
from phasemark.inputs.reading import MOST_TOML_BYTES, read_text
from phasemark.inputs.toml_file import read_toml, toml_value
from phasemark.render.sensor.lens_fields import DERIVED
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.sensor.sensor_fields import TABLES
from phasemark.render.sensor.sources import SOURCE_TABLE, kind_of_source, without_sources


def sensor_toml(sensor: Sensor, comments: Mapping[str, str], *, header: Sequence[str], otherwise: str) -> str:
    """Return a sensor as the text of a file that :meth:`Sensor.from_toml` reads, with its table ``[source]``.

    Parameters
    ----------
    sensor : Sensor
    comments : mapping of str to str
        Comment behind a field; a field with a comment is written even where it has its default.
    header : sequence of str
        Lines of comment at the top.
    otherwise : str
        What stands behind the other fields.
    """
    fields = sensor.model_dump(mode="json")
    tables = {name: fields.pop(name) for name in TABLES if name in fields}
    derived = DERIVED if sensor.lens is not None else ()
    lines = [f"# {line}" for line in header]
    sources: dict[str, str] = {}
    for title, names in Sensor.field_groups().items():
        own = [
            name
            for name in names
            if name in comments
            or (fields.get(name) is not None and fields[name] != _default_of(Sensor, name))
            or Sensor.model_fields[name].is_required()
        ]
        own = [name for name in own if name not in TABLES and (name in comments or name not in derived)]
        if own:
            lines += ["", f"# {title}"]
        lines += [f"{name} = {toml_value(fields[name])}  # {comments.get(name, otherwise)}" for name in own]
        sources |= {name: comments.get(name, otherwise) for name in own}
    for title, table in tables.items():
        lines += ["", f"[{title}]"]
        for name, value in table.items():
            comment = comments.get(f"{title}.{name}")
            if comment is not None or (value is not None and value != _default_of(TABLES[title], name)):
                lines.append(f"{name} = {toml_value(value)}  # {comment or otherwise}")
                sources[f"{title}.{name}"] = comment or otherwise
    lines += source_lines({name: _as_source(text) for name, text in sources.items()})
    return "\n".join(lines) + "\n"


def source_lines(sources: Mapping[str, str]) -> list[str]:
    """Return the table ``[source]`` of a sensor file, an empty line before it; nothing if there is none."""
    if not sources:
        return []
    keys = {name: f'"{name}"' if "." in name else name for name in sources}
    return ["", f"[{SOURCE_TABLE}]", *(f"{keys[name]} = {toml_value(text)}" for name, text in sources.items())]


def read_sources(path: str | Path) -> dict[str, str]:
    """Return where the numbers of a sensor file come from, by field; empty if it does not say.

    A file without the table ``[source]`` may say it in comments behind its numbers.

    Raises
    ------
    InputFileError
        The file cannot be read or is not TOML.
    UsageError
        A source is of no field, or does not begin with measured, published or assumed.
    """
    path = Path(path)
    table = read_toml(path)
    if SOURCE_TABLE not in table:
        stated = comments_of(read_text(path, most_bytes=MOST_TOML_BYTES))
        return {name: text for name, text in stated.items() if kind_of_source(text) is not None}
    try:
        return without_sources(table)[1]
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None


def _as_source(comment: str) -> str:
    """Return a comment as a source, which begins with one of three words."""
    if kind_of_source(comment) is not None:
        return comment
    return f"{'measured' if 'measured' in comment or 'calibrated' in comment else 'assumed'}: {comment}"


def rounded(value: Any) -> Any:
    """Round the floats of a field to the digits of a sensor file."""
    if isinstance(value, tuple):
        return tuple(rounded(one) for one in value)
    digits = 7  # of a number in a sensor file
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value


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
