"""Frames as point clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from phasemark.data.export.samples import blocks
from phasemark.data.frames.frame_set_file import FrameSet
from phasemark.data.measured.reading import RangeOrZ


def write_ply(frames: FrameSet, folder: Path, quantity: RangeOrZ) -> None:
    """Write ``NNNNNNNN.ply`` for each frame: the valid pixels in the level camera frame (x forward, y left, z up)."""
    directions = frames.sensor.pixel_directions().reshape(-1, 3)
    rows, cols = np.indices((frames.sensor.rows, frames.sensor.cols)).reshape(2, -1)
    floats, counts = ("x", "y", "z", "range", "amplitude"), ("row", "col")
    fields = [*((name, "<f4") for name in floats), *((name, "<u2") for name in counts)]
    kinds = {"<f4": "float", "<u2": "ushort"}
    for start, sample in blocks(frames):
        amplitude = sample.get("amplitude_e", np.zeros_like(sample["range_m"]))
        for k, (range_m, amplitude_e) in enumerate(zip(sample["range_m"], amplitude, strict=True)):
            seen = np.isfinite(range_m).ravel()
            points = np.empty(int(seen.sum()), dtype=fields)
            xyz = directions[seen] * range_m.ravel()[seen, None].astype(float)
            for axis, name in enumerate("xyz"):
                points[name] = xyz[:, axis]
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
