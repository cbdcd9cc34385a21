"""TOML files: sensors, plans and maps that are read, and values that are written."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Any

import tomlkit

from phasemark import InputFileError
from phasemark.inputs.reading import MOST_TOML_BYTES, read_text


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a TOML file.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    dict

    Raises
    ------
    InputFileError
        The file cannot be read, is too large, is not what its checksum says, or is not TOML.
    """
    path = Path(path)
    text = read_text(path, most_bytes=MOST_TOML_BYTES)
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:  # the last: nested without end
        raise InputFileError(f"{path}: not a TOML file ({error})") from None
    except ValueError:  # Python converts no number of more than 4300 digits
        raise InputFileError(f"{path}: not a TOML file that can be used (a number has thousands of digits)") from None


def toml_value(value: Any) -> str:
    """Return a value as it stands behind the equals sign of a TOML file.

    Parameters
    ----------
    value : str, bool, int, float, or list of them

    Returns
    -------
    str

    Examples
    --------
    >>> print(toml_value("😀"), toml_value([0.5, 2]))
    "😀" [0.5, 2]
    """
    return str(tomlkit.item(value).as_string())
