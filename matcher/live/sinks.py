"""Sinks of poses: lines of JSON, and those of other modules by their names."""

from __future__ import annotations

import json
import math
import os
import sys
from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from numpy.typing import NDArray

from phasemark import OutputExistsError, StorageError, UsageError
from phasemark.render import Sensor

if TYPE_CHECKING:
    from phasemark.matcher.live.session import Update
    from phasemark.matcher.live.status import Status

UNKNOWN_VARIANCE = 1e6
"""Variance of what is not estimated, m² or rad², as consumers of covariances have it."""
_KINDS = "jsonl:FILE, ros:NAME, mavlink:ADDRESS, mcap:FILE or foxglove://HOST:PORT"


class Sink(ABC):
    """Sink of poses.

    Parameters
    ----------
    name : str
        As the user gave it.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    @abstractmethod
    def update(self, update: Update) -> None:
        """Take the outcome of a frame; a pose is published only if its `reason` is empty."""

    def status(self, status: Status) -> None:  # noqa: B027  a sink may do without
        """Take the status, some times a second."""

    def close(self) -> None:  # noqa: B027
        """Finish files, and leave what was joined."""


class JsonLines(Sink):
    """A line of JSON for each frame, into a file or standard output; degrees, as all of the program's JSON."""

    def __init__(self, name: str, file: TextIO, *, with_status: bool = False) -> None:
        super().__init__(name)
        self._file, self._with_status = file, with_status

    def update(self, update: Update) -> None:
        """Write what is known."""
        self._write(as_dict(update))

    def status(self, status: Status) -> None:
        """Write the status, if that was asked for."""
        if self._with_status:
            self._write({"status": status.as_dict()})

    def _write(self, row: dict[str, Any]) -> None:
        self._file.write(json.dumps(row, ensure_ascii=False, allow_nan=False) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        if self._file is not sys.stdout:
            self._file.close()


def as_dict(update: Update) -> dict[str, Any]:
    """Return an update as plain numbers for JSON: metres and degrees, in the covariance too."""
    found = update.located.estimate
    row: dict[str, Any] = {
        "index": update.number,
        "stamp_s": update.stamp_s,
        "pose_stamp_s": update.pose_stamp_s,
        "time_s": update.time_s,
        "accepted": not update.reason,
        "reason": update.reason,
        "latency_ms": 1e3 * update.latency_s,
        "tracked": update.located.tracked,
        "match": None if update.located.match is None else update.located.match.reason,
    }
    if not update.reason and found.pose is not None and found.covariance is not None:
        unit = np.array([1.0, 1.0, math.degrees(1.0)])
        x_m, y_m, heading = (unit * found.pose).tolist()
        row |= {"x_m": x_m, "y_m": y_m, "heading_deg": heading}
        row["covariance"] = (np.outer(unit, unit) * found.covariance).tolist()
    return row


def plain_rows(values: NDArray[np.float64]) -> Any:
    """Return numbers as lists for JSON, None where there is none."""
    if values.ndim > 1:
        return [plain_rows(row) for row in values]
    return [value if math.isfinite(value) else None for value in values.tolist()]


def planar_covariance(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance of (x, y, z, roll, pitch, yaw), (6, 6), of a pose in the plane."""
    whole = np.eye(6) * UNKNOWN_VARIANCE
    own = [0, 1, 5]
    whole[np.ix_(own, own)] = covariance
    return whole


def open_sink(name: str, sensor: Sensor | None, *, force: bool = False) -> Sink:
    """Return the sink that a name stands for.

    Parameters
    ----------
    name : str
        ``jsonl:FILE``, or ``-`` for standard output: lines of JSON. ``ros``, ``ros:NAME``: topics of ROS 2 below NAME.
        ``mavlink:udpout:HOST:PORT`` or another address of pymavlink. ``mcap:FILE``: a log of everything.
        ``foxglove`` or ``foxglove://HOST:PORT``: a server that Foxglove shows.
    sensor : Sensor or None
        The camera; None of a rig among walls.
    force : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        There is no sink of this name, a package is missing, or a port is taken.
    OutputExistsError
        The file exists.
    StorageError
        It cannot be written.
    """
    kind, _, rest = name.partition(":")
    if name == "-":
        return JsonLines(name, sys.stdout)
    if kind == "jsonl" and rest:
        return JsonLines(name, open_output(Path(rest), force=force))
    if kind == "ros":
        from phasemark.matcher.live.ros import RosSink

        return RosSink(name, rest or "phasemark", in_map=sensor is None)
    if kind == "mavlink" and rest:
        from phasemark.matcher.live.mavlink import MavlinkSink

        return MavlinkSink(name, rest)
    if kind == "mcap" and rest:
        if sensor is None:
            raise UsageError(f"{name}: logs frames before a landmark; a rig's poses go to jsonl:FILE")
        from phasemark.matcher.live.mcap_log import McapSink

        return McapSink(name, Path(rest), sensor, force=force)
    if kind == "foxglove":
        from phasemark.matcher.live.foxglove_view import FoxgloveSink

        return FoxgloveSink(name, rest.removeprefix("//") or "127.0.0.1:8765")
    raise UsageError(f"{name}: a sink must be {_KINDS}, or - for standard output")


def open_output(path: Path, *, force: bool, mode: str = "w") -> Any:
    """Open a file for writing that grows while a session runs.

    Raises
    ------
    OutputExistsError, StorageError
        It exists without `force`, or cannot be opened.
    """
    if path.exists() and not force and not path.is_fifo():
        raise OutputExistsError(f"{path} exists: give force=True to replace it, or another name")
    try:
        return open(path, mode, encoding=None if "b" in mode else "utf-8")
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror or os.strerror(error.errno or 0)})") from None
