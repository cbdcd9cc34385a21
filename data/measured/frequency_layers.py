"""Frames of each modulation frequency in a file, and the check that they fit the sensor."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError
from phasemark.inputs.numbers import in_words
from phasemark.render import Sensor

LAYERED = ("frequency_range", "frequency_amplitude", "frequency_intensity", "frequency", "taps")
"""Arrays with axes between frames and rows, and the frequencies themselves."""

_TAPS = 2


def layers_of(
    arrays: Mapping[str, NDArray[Any]], sensor: Sensor, shape: tuple[int, int], flat: bool, path: Path
) -> dict[str, NDArray[Any]]:
    """Return arrays with a frequency axis as (n, frames, m, rows, cols), and taps as (n, frames, 4 m, 2, rows, cols).

    Parameters
    ----------
    arrays : mapping
        As the file has them.
    sensor : Sensor
    shape : (rows, cols)
        Pixels of a frame in the file's own orientation.
    flat : bool
        Whether frames are rows of numbers.
    path : Path
        For messages.

    Raises
    ------
    InputFileError
        Frequencies or phase images are not as many as the sensor's, or other ones.
    """
    m = len(sensor.frequencies_hz)
    _check_frequencies(arrays.get("frequency"), sensor, path)
    found = {}
    for name in LAYERED[:3]:
        if name in arrays:
            what = f"frequencies, but the sensor has {m}: {in_words(sensor.frequencies_hz)} Hz"
            found[name] = _with_layers(arrays[name], name, (m,), what, shape, flat, path)
    if "taps" in arrays:
        n = sensor.n_phase_images
        what = f"phase images a frame, but the sensor takes {n}: 4 at each of {m} modulation frequencies"
        found["taps"] = _with_layers(arrays["taps"], "taps", (n, _TAPS), what, shape, flat, path)
    if found and m > 1 and "frequency_range" not in found and any(name in found for name in LAYERED[:3]):
        raise InputFileError(f"{path}: has {' and '.join(found)} without 'frequency_range'")
    for name, values in found.items():
        other = found.get("frequency_range", values)
        if values.shape[:2] != other.shape[:2]:
            raise InputFileError(
                f"{path}: '{name}' must have the frames of 'frequency_range', {other.shape[:2]}, got {values.shape[:2]}"
            )
    return found


def _check_frequencies(stated: NDArray[Any] | None, sensor: Sensor, path: Path) -> None:
    """Refuse a file that says it has other frequencies than the sensor."""
    if stated is None:
        return
    own = sensor.frequencies_hz
    if stated.dtype.kind not in "fiu" or stated.ndim > 1:
        raise InputFileError(f"{path}: 'frequency' must be the modulation frequencies in hertz, got {stated.dtype}")
    told = np.atleast_1d(stated).astype(np.float64)
    if len(told) != len(own) or not np.allclose(told, own, rtol=1e-9, atol=0):
        raise InputFileError(
            f"{path}: has frames at {in_words(told) if len(told) else 'no'} Hz, but the sensor modulates at"
            f" {in_words(own)} Hz, in this order"
        )


def _with_layers(
    values: NDArray[Any], name: str, layers: tuple[int, ...], what: str, shape: tuple[int, int], flat: bool, path: Path
) -> NDArray[Any]:
    """Return an array as (n, frames, *layers, rows, cols)."""
    if values.dtype.kind not in "fiu":
        raise InputFileError(f"{path}: '{name}' must hold real numbers, got {values.dtype}")
    if not values.size:
        raise InputFileError(f"{path}: '{name}' holds no frames")
    if flat:
        return values.reshape(1, -1, *layers, *shape)
    n_axes = len(layers) + 2
    if not n_axes <= values.ndim <= n_axes + 2:
        axes = ", ".join(["frames", *("phase images, 2" if name == "taps" else "m",), "rows", "cols"])
        raise InputFileError(f"{path}: '{name}' must have shape ({axes}), got {values.shape}")
    if values.shape[-2:] != shape:
        raise InputFileError(
            f"{path}: the frames in '{name}' have {values.shape[-2]} × {values.shape[-1]} pixels, but the sensor's"
            f" have {shape[0]} × {shape[1]}"
        )
    if values.shape[-n_axes:-2] != layers:
        raise InputFileError(f"{path}: '{name}' has {values.shape[-n_axes]} {what}")
    return values.reshape((1,) * (n_axes + 2 - values.ndim) + values.shape)
