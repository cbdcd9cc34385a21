"""Frames as 16-bit grey PNG images, with their scale inside and beside them, and as point clouds."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, PngImagePlugin

from phasemark.data.export.samples import blocks, quantity_m, truth_rows
from phasemark.data.frames.frame_set_file import FrameSet
from phasemark.data.measured.reading import RangeOrZ
from phasemark.render.rigid import tilt2level
from phasemark.render.view import VIEW_FIELDS

FULL_SCALE = 65535


def encode_png16(values_m: NDArray[np.float64], metres_per_unit: float, quantity: RangeOrZ) -> bytes:
    """Return a 16-bit PNG image of values in metres; 0 where invalid, quantity and scale as text chunks."""
    told = PngImagePlugin.PngInfo()
    told.add_text("quantity", quantity)
    told.add_text("metres_per_unit", repr(metres_per_unit))
    buffer = io.BytesIO()
    Image.fromarray(to_codes(values_m, metres_per_unit)).save(buffer, format="PNG", pnginfo=told)
    return buffer.getvalue()


def to_codes(values_m: NDArray[np.float64], metres_per_unit: float) -> NDArray[np.uint16]:
    """Return values as whole numbers of `metres_per_unit`; 0 is kept for invalid ones."""
    codes = np.clip(np.rint(np.nan_to_num(values_m) / metres_per_unit), 1, FULL_SCALE)
    return np.where(np.isfinite(values_m), codes, 0).astype(np.uint16)


def scale_of(frames: FrameSet, quantity: RangeOrZ) -> float:
    """Return the metres per unit at which the largest value of all frames is full scale."""
    values = (quantity_m(frames, sample, quantity) for _, sample in blocks(frames))
    return (max(float(np.nanmax(block, initial=0.0)) for block in values) or 1.0) / FULL_SCALE


def write_png16(frames: FrameSet, folder: Path, quantity: RangeOrZ) -> None:
    """Write ``NNNNNNNN.png`` for each frame, and ``frames.json`` with the scale and the truth."""
    metres_per_unit = scale_of(frames, quantity)
    listed = []
    for start, sample in blocks(frames):
        values_m = quantity_m(frames, sample, quantity)
        for k, (image, truth) in enumerate(zip(values_m, truth_rows(frames, sample), strict=True), start):
            name = f"{k:08d}.png"
            (folder / name).write_bytes(encode_png16(image, metres_per_unit, quantity))
            listed.append({"file": name, **truth})
    facts = {"quantity": quantity, "unit": "m", "metres_per_unit": metres_per_unit, "invalid": 0, "frames": listed}
    (folder / "frames.json").write_text(json.dumps(facts, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def write_ply(frames: FrameSet, folder: Path, quantity: RangeOrZ) -> None:
    """Write ``NNNNNNNN.ply`` for each frame: the valid pixels in the level camera frame (x forward, y left, z up)."""
    mounted = frames.sensor.pixel_directions().reshape(-1, 3)
    rows, cols = np.indices((frames.sensor.rows, frames.sensor.cols)).reshape(2, -1)
    floats, counts = ("x", "y", "z", "range", "amplitude"), ("row", "col")
    fields = [*((name, "<f4") for name in floats), *((name, "<u2") for name in counts)]
    kinds = {"<f4": "float", "<u2": "ushort"}
    for start, sample in blocks(frames):
        amplitude = sample.get("amplitude_e", np.zeros_like(sample["range_m"]))
        turns = tilt2level(*(sample.get(name, np.zeros(len(amplitude))) for name in VIEW_FIELDS[4:]))
        for k, (range_m, amplitude_e) in enumerate(zip(sample["range_m"], amplitude, strict=True)):
            directions = mounted @ turns[k].T
            seen = np.isfinite(range_m).ravel()
            points = np.empty(int(seen.sum()), dtype=fields)
            xyz = directions[seen] * range_m.ravel()[seen, None].astype(float)
            points["x"], points["y"], points["z"] = xyz.T
            points["range"], points["amplitude"] = range_m.ravel()[seen], amplitude_e.ravel()[seen]
            points["row"], points["col"] = rows[seen], cols[seen]
            header = [
                "ply",
                "format binary_little_endian 1.0",
                "comment metres; level camera frame: x forward, y left, z up; range is radial",
                f"element vertex {len(points)}",
                *(f"property {kinds[kind]} {name}" for name, kind in fields),
                "end_header",
            ]
            (folder / f"{start + k:08d}.ply").write_bytes("\n".join(header).encode() + b"\n" + points.tobytes())
