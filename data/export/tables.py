"""Frames as NumPy archives and as comma-separated values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from phasemark.data.export.histograms import histogram_arrays, target_arrays
from phasemark.data.export.samples import blocks, quantity_m, truth_columns, write_lines
from phasemark.data.frames.frame_set_file import FrameSet, Sample
from phasemark.data.measured.reading import RangeOrZ


def write_npz(frames: FrameSet, path: Path, quantity: RangeOrZ, content: str | None = None) -> None:
    """Write one NPZ file that :func:`phasemark.data.read_frames` reads without being told anything.

    What each of several modulation frequencies measured goes into it as ``frequency_*``, always as range along the ray.
    Of histograms it has what `content` names, or all: ``histogram`` and ``t_s``, which
    :func:`~phasemark.data.measured.histogram_logs.read_histograms` reads, and ``target_*``.
    """
    found: dict[str, list[Any]] = {}
    for start, sample in blocks(frames):
        columns: dict[str, Any] = _range_columns(frames, sample, quantity) if content in (None, "range") else {}
        if frames.holds_targets and content in (None, "targets"):
            columns |= target_arrays(sample)
        if frames.holds_histograms and content in (None, "histogram"):
            columns |= histogram_arrays(frames, sample, start)
        columns |= truth_columns(frames, sample)
        for name, values in columns.items():
            found.setdefault(name, []).append(values)
    with path.open("wb") as file:
        arrays: dict[str, Any] = {name: np.concatenate(values) for name, values in found.items()}
        if len(frames.sensor.frequencies_hz) > 1:
            arrays["frequency"] = np.array(frames.sensor.frequencies_hz)
        if "target_distance" in arrays:
            arrays["target_quantity"] = np.array(frames.reported_quantity())
        np.savez(file, **arrays, unit="m", quantity=quantity)


def _range_columns(frames: FrameSet, sample: Sample, quantity: RangeOrZ) -> dict[str, Any]:
    """Return ranges and what belongs to them of a block."""
    columns: dict[str, Any] = {"range": quantity_m(frames, sample, quantity).astype(np.float32)}
    for name in ("amplitude", "intensity"):
        if f"{name}_e" in sample:
            columns[name] = sample[f"{name}_e"]
    for name in (key for key in sample if key.startswith("frequency_")):
        columns[name.removesuffix("_m").removesuffix("_e")] = sample[name]
    columns["flags"] = sample["flags"]
    if len(frames.sensor.frequencies_hz) == 1:  # of several, each has NaN where it has no range
        columns["valid"] = sample["flags"] == 0
    return columns


def write_csv(frames: FrameSet, path: Path, quantity: RangeOrZ) -> None:
    """Write one frame a line, row by row from the top left pixel."""
    rows, cols = frames.sensor.rows, frames.sensor.cols
    names = [f"r{row}c{col}" for row in range(rows) for col in range(cols)]
    write_lines(
        frames, path, f"unit=m quantity={quantity}", names,
        lambda sample: quantity_m(frames, sample, quantity).reshape(-1, rows * cols),
    )  # fmt: skip
