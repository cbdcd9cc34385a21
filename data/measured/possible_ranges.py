"""Ranges that a sensor cannot measure: units and sensors that are wrong show in them."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError
from phasemark.render import Sensor

_NEAREST_M = 0.01
"""No sensor reads less in all pixels."""
METRES_PER_UNIT: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}


def _range_limit(sensor: Sensor) -> tuple[float, str]:
    """Return the range below which all readings of a sensor lie, metres, and where the limit comes from."""
    if sensor.kind == "direct" and sensor.max_range_m is not None:
        # how far beyond `max_range_m` a direct sensor may still report: real chips exceed their data sheet by a little
        beyond_max_range = 1.25
        return beyond_max_range * sensor.max_range_m, f"{beyond_max_range:g} times the sensor's 'max_range_m'"
    return sensor.unambiguous_range_m, "c / 2f"


def impossible_ranges(
    range_m: NDArray[np.float64], valid: NDArray[np.bool_], sensor: Sensor, unit: str, path: Path, *, is_stated: bool
) -> NDArray[np.bool_]:
    """Return which ranges are 0, or none that the sensor can measure.

    Parameters
    ----------
    range_m, valid : (n, frames, rows, cols) or (n, frames, rows, cols, targets)
    sensor : Sensor
    unit : str
        That they were written in.
    path : Path
        For messages.
    is_stated : bool
        Whether the file itself states the unit.

    Raises
    ------
    InputFileError
        Most of the ranges are impossible, or all of them 0.

    Warns
    -----
    UserWarning
        Says how many are impossible, and where the first is.
    """
    empty = valid & (range_m == 0)  # how most sensors write that they have no reading: it says nothing of the unit
    if valid.any() and empty.sum() == valid.sum():
        raise InputFileError(f"{path}: every range is 0, which stands for no reading")
    limit_m, reason = _range_limit(sensor)
    doubt = f"is its unit, {unit}, right?" if is_stated else "is unit=… right?"
    if valid.any() and (np.abs(range_m[valid]) < _NEAREST_M).all():
        if fitting := _fitting_units(range_m[valid & ~empty], limit_m, unit, is_stated):
            raise InputFileError(f"{path}: every range is below {_NEAREST_M:g} m; {doubt}{fitting}")
    wrong = valid & ~empty & ~((range_m > 0) & (range_m < limit_m))
    count, of = int(wrong.sum()), int((valid & ~empty).sum())
    if count:
        place = np.argwhere(wrong)[0]
        message = (
            f"{path}: {count} of {of} ranges are not in 0 … {limit_m:.4g} m ({reason}), the first in"
            f" frame {place[1]}, row {place[2]}, column {place[3]}: {range_m[tuple(place)]:.6g} m"
        )
        if 2 * count > of:
            readings_m = range_m[valid & ~empty]
            raise InputFileError(f"{message}; {doubt}{_fitting_units(readings_m, limit_m, unit, is_stated)}")
        warnings.warn(f"{message}; taken as invalid", UserWarning, stacklevel=3)
    return np.asarray(wrong | empty)


def _fitting_units(readings_m: NDArray[np.float64], limit_m: float, unit: str, is_stated: bool) -> str:
    """Return a sentence that names the other units in which all readings would be possible, if there are any."""
    factors = {name: metres / METRES_PER_UNIT[unit] for name, metres in METRES_PER_UNIT.items() if name != unit}
    usual_m, least_m, most_m = np.median(readings_m), readings_m.min(), readings_m.max()
    option = "" if is_stated else "unit="
    fitting = [
        f"{option}{name} ({f'dividing by {1 / factor:g}' if factor < 1 else f'multiplying by {factor:g}'})"
        for name, factor in factors.items()
        if least_m > 0 and most_m * factor < limit_m and usual_m * factor > _NEAREST_M
    ]
    return f" All would fit with {' or '.join(fitting)}" if fitting else ""
