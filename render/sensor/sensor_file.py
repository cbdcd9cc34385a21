"""A sensor as a TOML file, every number with a comment that says where it comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from phasemark import UsageError
from phasemark.inputs.toml_file import read_toml, toml_value
from phasemark.render.sensor.histogram_fields import Histogram
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.sensor.sources import SOURCE_TABLE, kind_of_source, without_sources

_DIGITS = 7  # of a number in a sensor file


def sensor_toml(sensor: Sensor, comments: Mapping[str, str], *, header: Sequence[str], otherwise: str) -> str:
    """Return a sensor as the text of a file that :meth:`Sensor.from_toml` reads, with its table ``[source]``.

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
    table = fields.pop("histogram", None)
    lines = [f"# {line}" for line in header]
    sources: dict[str, str] = {}
    for title, names in Sensor.field_groups().items():
        own = [
            name
            for name in names
            if name in comments
            or (fields.get(name) is not None and fields[name] != _plain_default(name))
            or Sensor.model_fields[name].is_required()
        ]
        if own:
            lines += ["", f"# {title}"]
        lines += [f"{name} = {toml_value(fields[name])}  # {comments.get(name, otherwise)}" for name in own]
        sources |= {name: comments.get(name, otherwise) for name in own}
    if table is not None:
        lines += ["", "[histogram]"]
        for name, value in table.items():
            comment = comments.get(f"histogram.{name}")
            if comment is not None or (value is not None and value != _default_of(Histogram, name)):
                lines.append(f"{name} = {toml_value(value)}  # {comment or otherwise}")
                sources[f"histogram.{name}"] = comment or otherwise
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

    Raises
    ------
    InputFileError
        The file cannot be read or is not TOML.
    UsageError
        A source is of no field, or does not begin with measured, published or assumed.
    """
    try:
        return without_sources(read_toml(path))[1]
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
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value


def _plain_default(name: str) -> object:
    return _default_of(Sensor, name)


def _default_of(model: type[BaseModel], name: str) -> object:
    default = model.model_fields[name].default
    return list(default) if isinstance(default, tuple) else default
