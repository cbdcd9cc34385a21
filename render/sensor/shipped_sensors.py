"""The shipped sensors."""

from __future__ import annotations

import tomllib
from importlib import resources
from typing import Any

from phasemark import UsageError
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.sensor.sources import without_sources


def preset_names() -> list[str]:
    """Return the names of the shipped presets."""
    files = resources.files("phasemark.render.sensor").joinpath("presets").iterdir()
    return sorted(entry.name.removesuffix(".toml") for entry in files if entry.name.endswith(".toml"))


def preset(name: str) -> Sensor:
    """Return a shipped sensor.

    Parameters
    ----------
    name : str
        One of :func:`preset_names`.

    Raises
    ------
    UsageError
        The name is not known.

    Examples
    --------
    >>> preset("pmd-16x16").unambiguous_range_m.__round__(4)
    14.9896
    """
    return Sensor(**without_sources(_table(name))[0])


def preset_sources(name: str) -> dict[str, str]:
    """Return where the numbers of a shipped sensor come from, by field: measured, published or assumed.

    Parameters
    ----------
    name : str
        One of :func:`preset_names`.

    Raises
    ------
    UsageError
        The name is not known.

    Examples
    --------
    >>> preset_sources("pmd-16x16")["frame_rate_hz"]
    'published'
    """
    return without_sources(_table(name))[1]


def _table(name: str) -> dict[str, Any]:
    """Return the file of a preset as it is."""
    if name not in preset_names():
        raise UsageError(f"unknown sensor '{name}': the presets are {', '.join(preset_names())}")
    text = resources.files("phasemark.render.sensor").joinpath("presets", f"{name}.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)
