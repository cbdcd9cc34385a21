"""Origin of each number of a sensor: the table ``[source]`` of a sensor file.

The table says of a field whether it was measured, is published or is assumed, and in words from what. It changes
nothing that the sensor does, and is no part of it: two files that differ in it alone give the same sensor.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from phasemark import UsageError
from phasemark.render.sensor.sensor_fields import TABLES, SensorFields

SOURCE_TABLE = "source"
SOURCE_KINDS = ("measured", "published", "assumed")
"""The words that a source begins with."""


def kind_of_source(text: str) -> str | None:
    """Return the word of :data:`SOURCE_KINDS` that a source begins with, or None.

    Examples
    --------
    >>> kind_of_source("published: 45 degrees full angle")
    'published'
    """
    word = (text.split() or [""])[0].rstrip(":,;")
    return word if word in SOURCE_KINDS else None


def without_sources(table: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Split what a sensor file holds into the fields and where they come from.

    Parameters
    ----------
    table : mapping
        As TOML has it.

    Returns
    -------
    fields : dict
    sources : dict of str to str
        By the name of the field; of a table of its own with its name before it, ``"histogram.bins"``.

    Raises
    ------
    UsageError
        A source is of no field, or does not begin with measured, published or assumed.
    """
    fields = dict(table)
    sources = fields.pop(SOURCE_TABLE, {})
    if not isinstance(sources, Mapping):
        raise UsageError(f"'{SOURCE_TABLE}' must be a table of texts by field, got {sources!r}")
    for name, text in sources.items():
        if name.split(".")[0] not in SensorFields.model_fields or ("." in name and name.split(".")[0] not in TABLES):
            raise UsageError(f"'{SOURCE_TABLE}.{name}' is of no field of a sensor")
        if not isinstance(text, str) or kind_of_source(text) is None:
            raise UsageError(
                f"'{SOURCE_TABLE}.{name}' must be a text that begins with {', '.join(SOURCE_KINDS)}, got {text!r}"
            )
    return fields, dict(sources)
