"""Histograms and targets of direct sensors: zones in the order in which the sensor logs them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.data.export.samples import blocks, truth_rows, write_lines
from phasemark.data.frames.frame_set_file import FrameSet, Sample
from phasemark.data.measured.reading import RangeOrZ
from phasemark.data.measured.simulated import STATUS_NO_TARGET, STATUS_VALID
from phasemark.data.plans.arrays import TARGET_FIELDS
from phasemark.render import Sensor
from phasemark.render.direct.targets import Status


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
