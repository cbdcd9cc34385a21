"""TOML files that a user wrote: sensors here, plans and maps elsewhere."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Any

from phasemark import InputFileError


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
        The file cannot be read or is not TOML.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputFileError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:  # a NUL in the name
        raise InputFileError(f"{path}: cannot be read ({error})") from None
    try:
        return tomllib.loads(content.decode("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:  # the last: nested without end
        raise InputFileError(f"{path}: not a TOML file ({error})") from None
    except ValueError:  # Python converts no number of more than 4300 digits
        raise InputFileError(f"{path}: not a TOML file that can be used (a number has thousands of digits)") from None
