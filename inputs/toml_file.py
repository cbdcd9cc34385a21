"""TOML files: sensors, plans and maps that are read, and values that are written."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit

from phasemark import InputFileError
from phasemark.inputs.reading import MOST_TOML_BYTES, read_text

_MOST_KEYS = 32
"""Tables within each other that a key may name: reading takes the square of that."""
_KEY = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')"""
_DEEP_KEY = re.compile(rf"(?<![\w-])(?:{_KEY}[ \t]*+\.[ \t]*+){{{_MOST_KEYS}}}")


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
        The file cannot be read, is too large, is not what its checksum says, or is not TOML, or a key has too many
        dots.
    """
    path = Path(path)
    text = read_text(path, most_bytes=MOST_TOML_BYTES)
    deep = _DEEP_KEY.search(text)
    if deep is not None:
        line = text.count("\n", 0, deep.start()) + 1
        raise InputFileError(f"{path}: line {line}: a key has {_MOST_KEYS} dots or more, and no plan or sensor has any")
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


def toml_text(content: Mapping[str, object]) -> str:
    """Return a document as TOML, its lists after everything else: what follows a list of tables would belong to it.

    Parameters
    ----------
    content : mapping of str to object
        Keys with their values: plain values, tables as mappings, lists.

    Returns
    -------
    str

    Examples
    --------
    >>> print(toml_text({"wall": [{"height_m": 2.0}], "frame": "map"}).strip())
    frame = "map"
    <BLANKLINE>
    [[wall]]
    height_m = 2.0
    """
    document = tomlkit.document()
    for key in sorted(content, key=lambda name: isinstance(content[name], list)):
        document.add(key, tomlkit.item(content[key]))
    return tomlkit.dumps(document)
