"""Sources and sinks by the names that a user gives them."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from phasemark import UsageError
from phasemark.data.measured.boards import BOARDS
from phasemark.matcher.live.foxglove_view import FoxgloveSink
from phasemark.matcher.live.mavlink import MavlinkSink
from phasemark.matcher.live.mcap_log import McapSink, McapSource
from phasemark.matcher.live.ros import RosSink
from phasemark.matcher.live.sinks import JsonLines, Sink, open_output
from phasemark.matcher.live.sources import PrintedSource, RecordedSource, Source, Tmf8829Source
from phasemark.matcher.live.streams import open_stream
from phasemark.render import Sensor

_FILES = "jsonl", "mcap"
_SINKS = "jsonl:FILE, ros:NAME, mavlink:ADDRESS, mcap:FILE or foxglove://HOST:PORT"


def open_source(name: str, sensor: Sensor, how: Mapping[str, Any] | None = None, *, in_time: bool = True) -> Source:
    """Return the source that a name stands for.

    Parameters
    ----------
    name : str
        ``/dev/ttyUSB0``, ``serial:///dev/ttyUSB0?baud=921600``, ``-`` (standard input), ``tcp://host:port``,
        ``udp://:port``, ``zmq://host:port`` (TMF8829), a recording, or a log in MCAP that a sink wrote.
    sensor : Sensor
        The camera.
    how : mapping, optional
        Keywords of :func:`~phasemark.data.read_frames` that tell what the numbers mean, `board` and `topic` among them.
    in_time : bool
        Whether frames of a recording come in the rhythm of their stamps.

    Raises
    ------
    UsageError
        There is no source of this name, or a package is missing.
    InputFileError
        A recording cannot be read.
    """
    how = how or {}
    if how.get("board") is not None and how["board"] not in BOARDS:
        raise UsageError(f"board=… must be one of {', '.join(BOARDS)}, got {how['board']!r}")
    stream = open_stream(name)
    if stream is not None:
        return PrintedSource(stream, sensor, how)
    if name.startswith("zmq://"):
        return Tmf8829Source(name, sensor, how)
    if "://" in name:
        raise UsageError(f"{name}: a source must begin with serial://, tcp://, udp:// or zmq://, or be a file")
    if Path(name).suffix == ".mcap":
        return McapSource(Path(name), sensor, in_time=in_time)
    return RecordedSource(Path(name), sensor, how, in_time=in_time)


def files_of_sinks(names: Sequence[str]) -> list[Path]:
    """Return the files that sinks of these names write.

    Raises
    ------
    UsageError
        Two of them write the same file.
    """
    files = [Path(rest) for kind, _, rest in (name.partition(":") for name in names) if kind in _FILES and rest]
    if len(twice := {file.resolve() for file in files}) < len(files):
        raise UsageError(f"each sink must have a file of its own, got {len(files)} for {', '.join(map(str, twice))}")
    return files


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
        return RosSink(name, rest or "phasemark", in_map=sensor is None)
    if kind == "mavlink" and rest:
        return MavlinkSink(name, rest)
    if kind == "mcap" and rest:
        if sensor is None:
            raise UsageError(f"{name}: logs frames before a landmark; a rig's poses go to jsonl:FILE")
        return McapSink(name, Path(rest), sensor, force=force)
    if kind == "foxglove":
        return FoxgloveSink(name, rest.removeprefix("//") or "127.0.0.1:8765")
    raise UsageError(f"{name}: a sink must be {_SINKS}, or - for standard output")
