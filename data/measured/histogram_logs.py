"""Logs of direct sensors: histograms from NPZ and JSON lines, and several targets a zone from CSV."""

from __future__ import annotations

import json
import math
import os
import re
import zipfile
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError, PhasemarkError, UsageError
from phasemark.data.measured.board_prints import JSON
from phasemark.data.measured.boards import HEAD_BYTES
from phasemark.data.measured.csv_frames import stated_in
from phasemark.data.measured.recording import SECONDS_PER_TIME_UNIT, impossible_ranges, in_seconds, npz_arrays
from phasemark.inputs.reading import first_bytes, read_whole
from phasemark.render import Sensor
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.histogram_frames import HistogramFrames, reference_centroid
from phasemark.render.direct.recordings import PlaneRecording
from phasemark.render.direct.targets import Status, Targets

_MOST_BYTES = 1 << 28
_MOST_VALUES = 1 << 26
_NAMES = ("histogram", "reference_histogram", "distance_m", "sensor2world", "t_ms", "t_s")
_TARGET_COLUMN = re.compile(r"(mm|sigma_mm|signal|status)_([0-9]{1,9})_([0-9]{1,9})")
"""Column of a log of targets: quantity, zone and target."""


@dataclass(frozen=True, eq=False)
class HistogramLog:
    """Content of a log of histograms.

    Parameters
    ----------
    frames : HistogramFrames
        One position a frame, zones in image order.
    distance_m : (n,) float64, optional
        Distance of a plane, where the log states it.
    sensor2world : (n, 4, 4) float64, optional
        Pose of the sensor's optical frame, where the log states it. A last row of zeros becomes 0 0 0 1.
    """

    frames: HistogramFrames
    distance_m: NDArray[np.float64] | None
    sensor2world: NDArray[np.float64] | None


def is_histogram_log(path: str | os.PathLike[str]) -> bool:
    """Return True if a file holds histograms and no ranges: lines of JSON, or NPZ with ``histogram`` alone.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    bool
        False also if the file cannot be read.
    """
    start = first_bytes(path, HEAD_BYTES)
    if not start.startswith(b"PK\x03\x04"):
        start = start.lstrip()
        return start.startswith(b"{") and not JSON.match(start.decode(errors="replace"))
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
        return "histogram.npy" in names and "range.npy" not in names
    except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError):
        return False


def read_histograms(path: str | os.PathLike[str], *, sensor: Sensor) -> HistogramLog:
    """Read a log of histograms.

    *NPZ*: ``histogram`` (n, zones, bins) or (n, rows, cols, bins), counts; optionally ``reference_histogram``
    (n, bins), ``distance_m`` (n,), ``sensor2world`` (n, 4, 4), and ``t_ms`` or ``t_s`` (n,). Other arrays are ignored,
    and so is ``distance_m`` beside ``class``, where ``phasemark frames export`` has the distance of a landmark.
    *JSON lines*: one frame a line, an object with the same keys, each without the n. Zones stand in the order of the
    log, which `zone_order` of the sensor turns into that of the image.

    Parameters
    ----------
    path : path-like
    sensor : Sensor
        With a [histogram] table.

    Returns
    -------
    HistogramLog

    Raises
    ------
    InputFileError
        The file cannot be read, is of another number of zones or bins, or holds counts that cannot be.
    UsageError
        The sensor has no [histogram] table.
    """
    path = Path(path)
    content = read_whole(path, most_bytes=_MOST_BYTES)
    arrays = npz_arrays(content, path, _of_log) if content[:4] == b"PK\x03\x04" else _json_lines(content, path)
    if "histogram" not in arrays:
        raise InputFileError(f"{path}: must have 'histogram', got {', '.join(arrays) or 'nothing'}")
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise InputFileError(f"{path}: '{name}' must hold numbers, got {array.dtype}")
    counts = arrays["histogram"]
    n_zones = sensor.rows * sensor.cols
    if counts.ndim == 4 and counts.shape[1:3] == (sensor.rows, sensor.cols):
        counts = counts.reshape(len(counts), n_zones, -1)
    if counts.ndim != 3 or counts.shape[1] != n_zones:
        raise InputFileError(
            f"{path}: 'histogram' must have shape (n, {n_zones}, bins), got {arrays['histogram'].shape}"
        )
    n = len(counts)
    for name, shape in (("distance_m", (n,)), ("sensor2world", (n, 4, 4)), ("t_ms", (n,)), ("t_s", (n,))):
        if name in arrays and arrays[name].shape != shape:
            raise InputFileError(f"{path}: '{name}' must have shape {shape}, got {arrays[name].shape}")
    reference = arrays.get("reference_histogram")
    if reference is not None and (reference.ndim != 2 or len(reference) != n):
        raise InputFileError(f"{path}: 'reference_histogram' must have shape ({n}, bins), got {reference.shape}")
    times = [
        in_seconds(arrays[name], name, path, "frame {}".format) for name in SECONDS_PER_TIME_UNIT if name in arrays
    ]
    try:
        frames = HistogramFrames(
            _image(counts, sensor).reshape(n, 1, sensor.rows, sensor.cols, -1),
            sensor=sensor,
            reference=None if reference is None else reference[:, None],
            time_s=times[0][:, None] if times else None,
        )
    except PhasemarkError as error:
        if sensor.histogram is None:
            raise
        raise InputFileError(f"{path}: {error}") from None
    poses = arrays.get("sensor2world")
    if poses is not None:
        poses = poses.astype(np.float64)
        poses[(poses[:, 3] == 0).all(axis=1), 3, 3] = 1.0
    distance = arrays.get("distance_m")
    return HistogramLog(frames, None if distance is None else distance.astype(np.float64), poses)


def read_plane(path: str | os.PathLike[str], *, sensor: Sensor, nearest_m: float) -> PlaneRecording:
    """Read the histograms of a plane from a distance on; a sensor without the peak of its reference gets the log's.

    Parameters
    ----------
    path : path-like
        Log with ``distance_m``.
    sensor : Sensor
        Camera with a [histogram] table.
    nearest_m : float
        Nearer frames are left out.

    Raises
    ------
    UsageError
        The log does not state the distance of the plane.
    InputFileError
        As :func:`read_histograms`.
    """
    log = read_histograms(path, sensor=sensor)
    frames, distance_m, histogram = log.frames, log.distance_m, sensor.histogram
    if distance_m is None:
        raise UsageError(f"{path} must state 'distance_m', the distance of the plane in each frame")
    if frames.reference is not None and histogram is not None and histogram.reference_peak is None:
        peak = float(reference_centroid(frames.reference.sum(axis=1))[-1])
        sensor = sensor.with_(histogram={**histogram.model_dump(), "reference_peak": peak})
        frames = read_histograms(path, sensor=sensor).frames
    far = np.flatnonzero(distance_m >= nearest_m)
    return PlaneRecording(frames[far], distance_m[far])


def read_targets(path: str | os.PathLike[str], *, sensor: Sensor, valid_status: Collection[int] = (5, 9)) -> Targets:
    """Read targets, several a zone, from CSV.

    The header names the columns ``mm_ZONE_TARGET`` and optionally ``sigma_mm_ZONE_TARGET``, ``signal_ZONE_TARGET`` and
    ``status_ZONE_TARGET``; zones count from 0 in the order of the log, targets from 0. An empty cell is no target.

    Parameters
    ----------
    path : path-like
    sensor : Sensor
    valid_status : collection of int
        Which status codes mark a target; 5 (valid) and 9 (valid, with a wrapped or broad signal) on ST's chips.

    Returns
    -------
    Targets
        (1, frames, rows, cols, targets). What the chip reports is not converted.

    Raises
    ------
    InputFileError
        A column or a cell is not what it should be.
    """
    path = Path(path)
    text = read_whole(path, most_bytes=_MOST_BYTES).decode("utf-8-sig", errors="replace")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    stated, reports = stated_in(text), histogram_of(sensor).reports
    for name, right in (("unit", "mm"), ("quantity", reports)):
        if stated.get(name, right) != right:
            raise InputFileError(f"{path}: must have {name}={right}, as the sensor reports it, got {stated[name]}")
    if len(lines) < 2:
        raise InputFileError(f"{path}: must have a header and at least one frame")
    header = [name.strip() for name in lines[0].split(",")]
    n_zones = sensor.rows * sensor.cols
    places: dict[tuple[str, int, int], int] = {}
    most_listed = 16
    for column, name in enumerate(header):
        if match := _TARGET_COLUMN.fullmatch(name):
            kind, zone, target = match[1], int(match[2]), int(match[3])
            if zone >= n_zones or target >= most_listed:
                raise InputFileError(
                    f"{path}: column '{name}' is beyond {n_zones} zones of at most {most_listed} targets"
                )
            if (kind, zone, target) in places:
                raise InputFileError(f"{path}: names the column '{name}' twice")
            places[kind, zone, target] = column
    if not any(kind == "mm" for kind, *_ in places):
        raise InputFileError(f"{path}: must have columns mm_0_0 … (zone, target), got {', '.join(header[:4])} …")
    most = 1 + max(k for _, _, k in places)
    out = {kind: np.full((len(lines) - 1, n_zones, most), np.nan) for kind in ("mm", "sigma_mm", "signal", "status")}
    for row, line in enumerate(lines[1:]):
        cells = line.split(",")
        if len(cells) != len(header):
            raise InputFileError(f"{path}: frame {row} has {len(cells)} cells, the header {len(header)}")
        for (kind, place, k), column in places.items():
            out[kind][row, place, k] = _cell(cells[column].strip(), path, row, header[column])
    zones = {zone for kind, zone, _ in places if kind == "mm"}
    if max(zones) < n_zones - 1:
        raise InputFileError(f"{path}: has columns of {max(zones) + 1} zones, but the sensor has {n_zones}")
    has_status = any(kind == "status" for kind, *_ in places)
    for kind, zone, target in places:
        if has_status and kind == "mm" and ("status", zone, target) not in places:
            raise InputFileError(f"{path}: has no 'status_{zone}_{target}', but others")
    placed = {kind: _image(each, sensor).reshape(1, -1, sensor.rows, sensor.cols, most) for kind, each in out.items()}
    distance_m = placed["mm"] / 1000
    listed = np.isin(placed["status"], list(valid_status)) if has_status else np.isfinite(distance_m)
    valid = listed & np.isfinite(distance_m) & (distance_m > 0)
    valid &= ~impossible_ranges(distance_m, valid, sensor, "mm", path, is_stated=True)
    return Targets(
        np.where(valid, distance_m, np.nan),
        np.where(valid, placed["sigma_mm"] / 1000, np.nan),
        np.where(valid, np.nan_to_num(placed["signal"]), 0.0),
        np.where(valid, int(Status.VALID), int(Status.NO_TARGET)).astype(np.uint8),
    )


def _image(values: NDArray[Any], sensor: Sensor) -> NDArray[Any]:
    """Return values in the order of a log, (frames, zones, …), in that of the image."""
    order = sensor.histogram.zone_order if sensor.histogram is not None else ()
    placed = np.empty_like(values)
    placed[:, list(order or range(values.shape[1]))] = values
    return placed


def _cell(text: str, path: Path, row: int, column: str) -> float:
    """Return the number of a cell, NaN of an empty one."""
    if not text:
        return math.nan
    try:
        return float(text)
    except ValueError:
        raise InputFileError(f"{path}: frame {row}, column '{column}': '{text[:20]}' is no number") from None


def _of_log(names: Collection[str]) -> list[str]:
    """Return those names of arrays that a log has."""
    of_landmark = "class" in names  # then distance_m is that of a landmark's axis, and no plane's
    return [name for name in _NAMES if name in names and not (of_landmark and name == "distance_m")]


def _json_lines(content: bytes, path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of JSON lines, the frames stacked."""
    rows: list[Mapping[str, Any]] = []
    for number, line in enumerate(content.decode("utf-8", errors="replace").splitlines(), 1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            row = None
        if not isinstance(row, dict):
            raise InputFileError(f"{path}: line {number} is no JSON object")
        rows.append(row)
    if not rows:
        raise InputFileError(f"{path}: holds no frame: neither NPZ nor lines of JSON")
    names = [name for name in _NAMES if name in rows[0]]
    out = {}
    for name in names:
        values = []
        for k, row in enumerate(rows):
            if name not in row:
                raise InputFileError(f"{path}: frame {k} has no '{name}', the first one has")
            try:
                values.append(np.asarray(row[name], dtype=np.float64))
            except (TypeError, ValueError):
                raise InputFileError(f"{path}: frame {k}: '{name}' must be numbers in rows of one length") from None
            if values[-1].shape != values[0].shape:
                raise InputFileError(
                    f"{path}: frame {k}: '{name}' has shape {values[-1].shape}, the first frame {values[0].shape}"
                )
        if sum(v.size for v in values) > _MOST_VALUES:
            raise InputFileError(f"{path}: '{name}' has more than {_MOST_VALUES} values: give it in parts")
        out[name] = np.stack(values)
    return out
