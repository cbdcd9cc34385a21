"""A sensor as a TOML file, every number with a comment that says where it comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel

from phasemark.inputs.toml_file import toml_value
from phasemark.render.sensor.histogram_fields import Histogram
from phasemark.render.sensor.lens_fields import DERIVED, Lens
from phasemark.render.sensor.sensor import Sensor

_TABLES: dict[str, type[BaseModel]] = {"lens": Lens, "histogram": Histogram}

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
    tables = {name: fields.pop(name, None) for name in _TABLES}
    follows = DERIVED if sensor.lens is not None else ()
    lines = [f"# {line}" for line in header]
    for title, names in Sensor.field_groups().items():
        own = [
            name
            for name in names
            if name not in follows
            and (
                name in comments
                or (fields.get(name) is not None and fields[name] != _plain_default(name))
                or Sensor.model_fields[name].is_required()
            )
        ]
        if own:
            lines += ["", f"# {title}"]
        lines += [f"{name} = {toml_value(fields[name])}  # {comments.get(name, otherwise)}" for name in own]
    for table, model in _TABLES.items():
        values = tables[table]
        if values is None:
            continue
        lines += ["", f"[{table}]"]
        for name, value in values.items():
            comment = comments.get(f"{table}.{name}")
            if comment is not None or (value is not None and value != _default_of(model, name)):
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
