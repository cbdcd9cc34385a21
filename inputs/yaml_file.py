"""YAML files: what ROS writes of a camera."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from phasemark import InputFileError
from phasemark.inputs.reading import MOST_TOML_BYTES, read_text


def read_yaml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the first document of a YAML file, which holds nothing but data.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    dict

    Raises
    ------
    InputFileError
        The file cannot be read, is too large, is not what its checksum says, is not YAML, or holds no table.
    """
    import yaml

    path = Path(path)
    text = read_text(path, most_bytes=MOST_TOML_BYTES)
    try:
        found = next(yaml.safe_load_all(text), None)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f", line {mark.line + 1}"
        problem = getattr(error, "problem", None) or "it does not follow the rules of YAML"
        raise InputFileError(f"{path}: not a YAML file ({' '.join(str(problem).split())}{where})") from None
    except RecursionError:
        raise InputFileError(f"{path}: not a YAML file that can be used (nested without end)") from None
    except (ValueError, TypeError, OverflowError, AttributeError) as error:  # what is no number or date of Python's
        raise InputFileError(
            f"{path}: not a YAML file that can be used ({' '.join(str(error).split())[:80]})"
        ) from None
    if not isinstance(found, dict):
        raise InputFileError(f"{path}: must hold a table of keys and values, as ROS writes a camera_info")
    return found
