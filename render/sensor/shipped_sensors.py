"""The shipped sensors."""

from __future__ import annotations

import tomllib
from importlib import resources

from phasemark import UsageError
from phasemark.render.sensor.sensor import Sensor


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
    return Sensor(**tomllib.loads(preset_text(name)))


def preset_text(name: str) -> str:
    """Return the file of a shipped sensor, with its comments.

    Raises
    ------
    UsageError
        The name is not known.
    """
    if name not in preset_names():
        raise UsageError(f"unknown sensor '{name}': the presets are {', '.join(preset_names())}")
    return resources.files("phasemark.render.sensor").joinpath("presets", f"{name}.toml").read_text(encoding="utf-8")
