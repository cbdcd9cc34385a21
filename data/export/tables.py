"""Frames as NumPy archives, comma-separated values and JSON lines; zones in the order in which a sensor logs them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.data.export.samples import blocks, quantity_m, truth_columns, truth_rows, write_lines
from phasemark.data.frames.frame_set_file import FrameSet, Sample
from phasemark.data.measured.reading import RangeOrZ
from phasemark.data.measured.simulated import STATUS_NO_TARGET, STATUS_VALID
from phasemark.data.plans.arrays import TARGET_FIELDS
from phasemark.render import Sensor
from phasemark.render.direct.targets import Status


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
    columns |= {name: sample[f"{name}_e"] for name in ("amplitude", "intensity") if f"{name}_e" in sample}
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


def logged(values: NDArray[Any], sensor: Sensor) -> NDArray[Any]:
    """Return (n, rows, cols, …) values as (n, zones, …), in the order of the sensor's log (`zone_order`)."""
    flat = values.reshape(len(values), sensor.rows * sensor.cols, *values.shape[3:])
    order = sensor.histogram.zone_order if sensor.histogram is not None else ()
    return flat[:, list(order)] if order else flat


def histogram_arrays(frames: FrameSet, sample: Sample, start: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of histograms in an NPZ file."""
    number = start + np.arange(len(sample["view"]))  # at the sensor's frame rate from frame 0 on
    return {"histogram": logged(sample["histogram"], frames.sensor), "t_s": number / frames.sensor.frame_rate_hz}


def target_arrays(sample: Sample) -> dict[str, NDArray[Any]]:
    """Return the arrays of targets in an NPZ file, (n, rows, cols, targets)."""
    return {name: sample[name if name in sample else f"{name}_m"] for name in TARGET_FIELDS}


def write_jsonl(frames: FrameSet, path: Path, quantity: RangeOrZ) -> None:
    """Write a frame's histograms a line, as :func:`phasemark.data.measured.histogram_logs.read_histograms` reads them.

    The truth of a frame stands under "truth".
    """
    with path.open("w", encoding="utf-8") as file:
        for start, sample in blocks(frames):
            arrays = histogram_arrays(frames, sample, start)
            for k, truth in enumerate(truth_rows(frames, sample)):
                row = {"t_s": arrays["t_s"][k], "histogram": arrays["histogram"][k].tolist(), "truth": truth}
                file.write(json.dumps(row, allow_nan=False) + "\n")


def write_targets_csv(frames: FrameSet, path: Path, quantity: RangeOrZ) -> None:
    """Write a frame's targets a line, as :func:`phasemark.data.measured.histogram_logs.read_targets` reads them.

    Status codes are those of ST's chips: 5 a target, 255 none.
    """
    sensor = frames.sensor
    names = [
        f"{kind}_{zone}_{target}"
        for zone in range(sensor.rows * sensor.cols)
        for target in range(frames[:1]["target_status"].shape[-1])
        for kind in ("mm", "sigma_mm", "signal", "status")
    ]

    def values_of(sample: Sample) -> NDArray[np.float64]:
        found = target_arrays(sample)
        valid = found["target_status"] == Status.VALID
        columns = (
            1000.0 * found["target_distance"].astype(float),
            1000.0 * found["target_sigma"].astype(float),
            np.where(valid, found["target_signal"], np.nan),
            np.where(valid, STATUS_VALID, STATUS_NO_TARGET),
        )
        return logged(np.stack(columns, axis=-1), sensor).reshape(len(valid), -1)

    write_lines(frames, path, f"targets unit=mm quantity={quantity}", names, values_of)
