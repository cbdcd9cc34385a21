"""One physical camera: the patterns and defects that stay as they are from frame to frame (PHYSICS section 4)."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from phasemark.render.sensor.sensor import Sensor
from phasemark.render.sensor.sensor_checks import PATTERN_BOUND

# A normal cut at ± _CUT has the standard deviation _CUT / 3, so that scaled to 1 it ends at PATTERN_BOUND = 3.
_CUT = 2.9545385593493396
_CUT_STD = _CUT / PATTERN_BOUND


@dataclass(frozen=True, eq=False)
class CameraUnit:
    """The patterns of one camera; arrays of taps are (2, rows, cols).

    Parameters
    ----------
    response : (2, rows, cols) float64
        Sensitivity of each tap over the nominal one, 1 + PRNU; 0 where the pixel is dead.
    dark_e : (2, rows, cols) float64
        Mean dark electrons of each tap per phase image, DSNU and hot pixels included.
    delay_rad : (2, rows, cols) float64
        Phase by which each tap sees the light late: pixel's and tap's offset, and the camera's range offset.
    dead : (rows, cols) bool
        Pixels that measure nothing.
    hot : (rows, cols) bool
        Pixels with a large dark current.
    """

    response: NDArray[np.float64]
    dark_e: NDArray[np.float64]
    delay_rad: NDArray[np.float64]
    dead: NDArray[np.bool_]
    hot: NDArray[np.bool_]


@lru_cache(maxsize=8)
def camera_unit(sensor: Sensor, frequency: int = 0) -> CameraUnit:
    """Draw the camera that `sensor.unit_seed` names.

    Each pattern has a Philox stream of its own, keyed by seed and name, and is drawn in units of its standard
    deviation: another strength, or another pattern switched off, leaves its shape as it is. Sensitivity, dark signal
    and defects are the same at every modulation frequency; phase offsets are drawn for each.

    Parameters
    ----------
    sensor : Sensor
        The camera.
    frequency : int
        Which of the sensor's modulation frequencies `delay_rad` is for, counted from 0.

    Returns
    -------
    CameraUnit
        Not to be written to: it is shared by all who ask for the same sensor.
    """
    shape = (sensor.rows, sensor.cols)
    dead = _defects(sensor, "dead", sensor.dead_share, sensor.dead_pixels)
    hot = _defects(sensor, "hot", sensor.hot_share, sensor.hot_pixels) & ~dead
    response = 1 + sensor.prnu * _pattern(sensor, "prnu", (2, *shape))
    dark_e = sensor.dark_e / 2 + sensor.dsnu_e * _pattern(sensor, "dsnu", (2, *shape)) + hot * sensor.hot_e / 2
    which = f" of frequency {frequency}" if frequency else ""
    delay_rad = (
        sensor.range_offset_m / sensor.by_frequency[frequency].metres_per_radian
        + sensor.phase_offset_std_rad * _pattern(sensor, f"phase offset{which}", shape)
        + sensor.tap_phase_offset_std_rad * _pattern(sensor, f"tap phase offset{which}", (2, *shape))
    )
    unit = CameraUnit(response * ~dead, np.maximum(dark_e, 0) * ~dead, delay_rad, dead, hot)
    for array in (unit.response, unit.dark_e, unit.delay_rad, unit.dead, unit.hot):
        array.flags.writeable = False
    return unit


def _stream(sensor: Sensor, purpose: str) -> np.random.Generator:
    label = int.from_bytes(hashlib.sha256(f"camera unit: {purpose}".encode()).digest()[:8], "little")
    return np.random.Generator(np.random.Philox(key=np.array([sensor.unit_seed, label], np.uint64)))


def _pattern(sensor: Sensor, purpose: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Draw standard normal values that end at ± `PATTERN_BOUND`, mean 0 and standard deviation 1."""
    low = ndtr(-_CUT)
    share = low + _stream(sensor, purpose).random(shape) * (1 - 2 * low)
    return np.asarray(ndtri(share) / _CUT_STD)


def _defects(sensor: Sensor, purpose: str, share: float, certain: tuple[tuple[int, int], ...]) -> NDArray[np.bool_]:
    mask = np.asarray(_stream(sensor, purpose).random((sensor.rows, sensor.cols)) < share)
    for row, col in certain:
        mask[row, col] = True
    return mask
