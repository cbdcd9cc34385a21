"""Input of all exports: frames a block at a time, and the requested quantity."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.data.frames.frame_set_file import FrameSet, Sample
from phasemark.data.measured.reading import RangeOrZ
from phasemark.data.plans.frame_plan import TILT
from phasemark.render import Sensor

BLOCK = 1024
"""Frames read at a time."""

TRUTH = {
    "distance_m": "distance_m",
    "delta_deg": "delta_rad",
    "bearing_deg": "bearing_rad",
    "height_m": "height_m",
    "pitch_deg": "pitch_rad",
    "roll_deg": "roll_rad",
    "albedo": "albedo",
    "wall_m": "wall_m",
    "floor_m": "floor_m",
}


def blocks(frames: FrameSet) -> Iterator[tuple[int, Sample]]:
    """Yield the number of a block's first frame, and its samples."""
    for start in range(0, len(frames), BLOCK):
        yield start, frames[start : start + BLOCK]


def quantity_m(frames: FrameSet, sample: Sample, quantity: RangeOrZ) -> NDArray[np.float64]:
    """Return range or z of a block, metres, NaN where invalid."""
    range_m = np.asarray(sample["range_m"], np.float64)
    return range_m * frames.sensor.axis_cosine() if quantity == "z" else range_m


def truth_columns(frames: FrameSet, sample: Sample) -> dict[str, NDArray[Any]]:
    """Return the truth of a block in the units of plans, with class, split and view."""
    columns: dict[str, NDArray[Any]] = {
        "view": sample["view"],
        "class": np.asarray(sample["class_name"], dtype=str),
        "split": np.array(frames.splits)[sample["split_index"]],
    }
    for name, key in TRUTH.items():
        if name in TILT and getattr(frames.plan, name) is None:
            continue
        values = np.asarray(sample[key], float)
        columns[name] = np.rad2deg(values) if name.endswith("_deg") else values
    return columns


def pinhole(frames: FrameSet) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy in pixels, counted as OpenCV, ROS and BOP do, from the centre of the first pixel."""
    sensor = frames.sensor
    if sensor.lens is not None:
        return sensor.lens.fx, sensor.lens.fy, sensor.lens.cx, sensor.lens.cy
    tan_h, tan_v = sensor.tan_half_angles
    u0, v0 = sensor.centre_px
    return sensor.cols / (2 * tan_h), sensor.rows / (2 * tan_v), u0 - 0.5, v0 - 0.5


def ros_distortion(sensor: Sensor) -> tuple[str, tuple[float, ...]]:
    """Return the name that ROS has for a sensor's distortion, and the coefficients in ROS's order."""
    lens = sensor.lens
    if lens is None:
        return "plumb_bob", (0.0,) * 5
    if lens.model == "fisheye":
        return "equidistant", lens.distortion or (0.0,) * 4
    if len(lens.distortion) == 8:
        return "rational_polynomial", lens.distortion
    return "plumb_bob", (*lens.distortion, *(0.0,) * (5 - len(lens.distortion)))


CAM2OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""From x forward, y left, z up to the optical frame: z forward, x right, y down."""


def quaternion(rotation: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Return x, y, z, w of a rotation matrix."""
    trace = float(np.trace(rotation))
    squares = [1 + 2 * float(rotation[k, k]) - trace for k in range(3)] + [1 + trace]
    largest = int(np.argmax(squares))
    out = np.empty(4)
    out[largest] = math.sqrt(squares[largest]) / 2
    scale = 1 / (4 * out[largest])
    skew = [rotation[(k + 2) % 3, (k + 1) % 3] - rotation[(k + 1) % 3, (k + 2) % 3] for k in range(3)]
    if largest == 3:
        out[:3] = [s * scale for s in skew]
    else:
        out[3] = skew[largest] * scale
        for k in range(3):
            if k != largest:
                out[k] = (rotation[largest, k] + rotation[k, largest]) * scale
    return float(out[0]), float(out[1]), float(out[2]), float(out[3])
