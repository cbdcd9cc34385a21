"""Input of all exports: frames a block at a time, and the requested quantity."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.data.frames.frame_set_file import FrameSet, Sample, SceneFrameSet
from phasemark.data.measured.reading import RangeOrZ
from phasemark.data.plans.arrays import TRUTH_KEYS
from phasemark.data.plans.frame_plan import TILT
from phasemark.render import Sensor, Views
from phasemark.render.view import VIEW_FIELDS

BLOCK = 1024
"""Frames read at a time."""


def blocks(frames: FrameSet) -> Iterator[tuple[int, Sample]]:
    """Yield the number of a block's first frame, and its samples."""
    for start in range(0, len(frames), BLOCK):
        yield start, frames[start : start + BLOCK]


def quantity_m(frames: FrameSet, sample: Sample, quantity: RangeOrZ) -> NDArray[np.float64]:
    """Return range or z of a block, metres, NaN where invalid."""
    range_m = np.asarray(sample["range_m"], np.float64)
    return range_m * frames.sensor.axis_cosine() if quantity == "z" else range_m


def truth_columns(frames: FrameSet, sample: Sample) -> dict[str, NDArray[Any]]:
    """Return the truth of a block in the units of plans, with class, split and view; of scenes with their labels."""
    split = np.array(frames.splits)[sample["split_index"]]
    if isinstance(frames, SceneFrameSet):
        labels = {name: sample[name] for name in frames.truth if name.startswith("label_")}
        return {name: sample[name] for name in ("view", "sequence", "step")} | {"split": split} | labels
    columns = {"view": sample["view"], "class": np.asarray(sample["class_name"], dtype=str), "split": split}
    for name in TRUTH_KEYS.values():
        if name not in TILT or getattr(frames.plan, name) is not None:
            values = np.asarray(sample[name.replace("_deg", "_rad")], float)  # a sample has angles in radians
            columns[name] = np.rad2deg(values) if name.endswith("_deg") else values
    return columns


def truth_rows(frames: FrameSet, sample: Sample) -> list[dict[str, Any]]:
    """Return the truth of each frame of a block as plain values, None where there is none."""
    columns = truth_columns(frames, sample)
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    return [{name: None if value != value else value for name, value in zip(columns, row, strict=True)} for row in rows]


def landmark2cam(frames: FrameSet, sample: Sample, k: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotation and translation of a frame of a block, from the landmark's to the camera frame."""
    view = Views.broadcast(*(sample[name][k] for name in VIEW_FIELDS))
    rotation, translation_m = view.in_camera(frames.sensor).landmark2cam()
    return rotation[0], translation_m[0]


def write_lines(
    frames: FrameSet, path: Path, about: str, names: Sequence[str], values_of: Callable[[Sample], NDArray[Any]]
) -> None:
    """Write one frame a line, its truth as a comment in the line before; a cell is empty where a value is NaN.

    Parameters
    ----------
    about : str
        First line, a comment.
    names : sequence of str
        Columns.
    values_of : callable
        Returns the values of a block, (frames, columns).
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write(f"# {about} rows={frames.sensor.rows} cols={frames.sensor.cols}\n")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        for start, sample in blocks(frames):
            truth = truth_columns(frames, sample)
            for k, line in enumerate(values_of(sample)):
                told = " ".join(f"{name}={_one_word(str(values[k]))}" for name, values in truth.items())
                file.write(f"# frame={start + k} {told}\n")
                # nine digits bring a float32 back as it was
                writer.writerow(["" if np.isnan(value) else f"{value:.9g}" for value in line])


def _one_word(text: str) -> str:
    """Return a value of a comment, in quotes as JSON has them if it holds what would end the word or the line."""
    return text if re.fullmatch(r"[^\s\"=\x00-\x1f]*", text) else json.dumps(text).replace(" ", "\\u0020")


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
