"""The intrinsics of a camera as ROS 1 and ROS 2 write them: camera_info YAML in both spellings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from phasemark import InputFileError, UsageError
from phasemark.inputs.reading import MOST_TOML_BYTES, read_text
from phasemark.render.sensor.lens_fields import Lens, check_image_size

_MODELS: dict[str, tuple[Literal["opencv", "fisheye"], tuple[int, ...]]] = {
    "plumb_bob": ("opencv", (4, 5)),
    "rational_polynomial": ("opencv", (8,)),
    "equidistant": ("fisheye", (4,)),
    "fisheye": ("fisheye", (4,)),
}
_SPELLINGS = {
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
    "camera_matrix": ("camera_matrix", "K", "k"),
    "distortion": ("distortion_coefficients", "D", "d"),
}


class CameraInfo(NamedTuple):
    """Camera as a camera_info file states it.

    Parameters
    ----------
    rows, cols : int
    lens : Lens
    distortion_model : str
        As ROS names it.
    """

    rows: int
    cols: int
    lens: Lens
    distortion_model: str


def read_camera_info(path: str | Path) -> CameraInfo:
    """Read a camera_info: what ROS's calibration writes, or what ``rostopic echo`` or ``ros2 topic echo`` prints.

    Parameters
    ----------
    path : path-like

    Raises
    ------
    InputFileError
        The file is not YAML, lacks a key, or describes a camera that cannot be used; with one line.
    """
    path = Path(path)
    table = _read_yaml(path)
    try:
        return _camera_info(table)
    except (UsageError, ValueError) as error:
        raise InputFileError(f"{path}: {error}") from None


def _camera_info(table: Mapping[str, Any]) -> CameraInfo:
    cols, rows = (_whole(table, name) for name in ("width", "height"))
    for name in ("binning_x", "binning_y"):
        if table.get(name) not in (None, 0, 1):
            raise ValueError(
                f"'{name}' must be 0 or 1, got {table[name]!r}: the intrinsics are those of the whole image"
            )
    region = table.get("roi")
    if isinstance(region, Mapping) and (region.get("width") or region.get("height")):
        if (region.get("width"), region.get("height")) != (cols, rows):
            raise ValueError("'roi' must be the whole image: the intrinsics belong to it")
    matrix = _numbers(table, "camera_matrix")
    if len(matrix) != 9 or any(matrix[k] for k in (1, 3, 6, 7)) or matrix[8] != 1:
        key = _key(table, "camera_matrix")
        raise ValueError(f"'{key}' must be fx, 0, cx, 0, fy, cy, 0, 0, 1 of a calibrated camera, got {matrix}")
    distortion = _numbers(table, "distortion")
    model = table.get("distortion_model")
    if model in (None, "") and not any(distortion):
        model, distortion = "plumb_bob", (0.0,) * 5
    if not isinstance(model, str) or model not in _MODELS:
        raise ValueError(f"unknown 'distortion_model' {model!r}: known are {', '.join(_MODELS)}")
    own, counts = _MODELS[model]
    if len(distortion) not in counts:
        wanted = " or ".join(map(str, counts))
        raise ValueError(f"'{_key(table, 'distortion')}' must have {wanted} numbers for {model}, got {len(distortion)}")
    lens = Lens(model=own, fx=matrix[0], fy=matrix[4], cx=matrix[2], cy=matrix[5], distortion=distortion)
    check_image_size(lens, rows, cols)
    lens.before(rows, cols)
    return CameraInfo(rows, cols, lens, model)


def _key(table: Mapping[str, Any], name: str) -> str:
    """Return the spelling in which a table states something.

    Raises
    ------
    ValueError
        It is stated in none.
    """
    for key in _SPELLINGS[name]:
        if key in table:
            return key
    raise ValueError(f"'{_SPELLINGS[name][0]}' (or {' or '.join(map(repr, _SPELLINGS[name][1:]))}) is missing")


def _whole(table: Mapping[str, Any], name: str) -> int:
    key = _key(table, name)
    value = table[key]
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= 4096:
        raise ValueError(f"'{key}' must be a whole number of pixels from 1 to 4096, got {value!r:.40}")
    return value


def _numbers(table: Mapping[str, Any], name: str) -> tuple[float, ...]:
    """Return a list of numbers, which the files of ROS 1's calibration hold under `data`."""
    key = _key(table, name)
    value = table[key]
    if isinstance(value, Mapping):
        value = value.get("data")
    try:
        if not isinstance(value, list):
            raise TypeError
        numbers = tuple(_number(one) for one in value)
    except (TypeError, ValueError):
        raise ValueError(f"'{key}' must be a list of finite numbers, got {value!r:.60}") from None
    return numbers


def _number(value: Any) -> float:
    """Return a number; YAML takes 1e-3 for a text."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise TypeError
    number = float(value)
    if not math.isfinite(number):
        raise ValueError
    return number


def _read_yaml(path: Path) -> dict[str, Any]:
    """Read the first document of a YAML file, which holds nothing but data."""
    import yaml

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
