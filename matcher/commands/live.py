"""The command ``phasemark live``: poses from a board's stream."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
import signal
import sys
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from phasemark import UsageError
from phasemark.data.commands.command import Shown, Without
from phasemark.data.commands.console import LongWork, echo_json, tell
from phasemark.data.commands.inputs import open_any_bank, read_landmark, read_sensor
from phasemark.data.commands.options import Force, FrameReading, Json, MeshReading, SensorName
from phasemark.data.commands.outputs import refuse_existing, refuse_input_files
from phasemark.matcher.commands.match_options import Landmark, Search, check_delay

if TYPE_CHECKING:
    from collections.abc import Callable

    from phasemark.data import Bank
    from phasemark.matcher.live import Live, Source, Tracker
    from phasemark.matcher.live.map_tracker import MapTracker


@dataclass(frozen=True)
class Motion:
    """Options for how the camera moves.

    Parameters
    ----------
    speed
        Fastest the camera moves, m/s.
    turn_rate
        Fastest it turns, degrees a second.
    delay_ms
        Added to the stamp of a frame to get the time of its pose; unless stated, the sensor's.
    flat
        The landmark is a wide plane that does not show where along it the camera is: distance and heading alone count.
    """

    speed: Annotated[float, Shown(metavar="M/S")] = 0.5
    turn_rate: Annotated[float, Shown(metavar="DEG/S")] = 90.0
    delay_ms: Annotated[float | None, Shown(metavar="MS")] = None
    flat: bool = False

    def check(self) -> None:
        """Refuse speeds that are none, and delays that are no times."""
        if self.delay_ms is not None:
            check_delay(self.delay_ms)
        for flag, value in (("--speed", self.speed), ("--turn-rate", self.turn_rate)):
            if not 0 < value < math.inf:
                raise UsageError(f"{flag} must be positive, got {value:g}")


def live_poses(
    source: str,
    *,
    landmark_name: Annotated[Path | None, Shown("--landmark", metavar="BANK|MESH|CLASS")] = None,
    map_file: Annotated[Path | None, Shown("--map", metavar="TOML")] = None,
    rig_file: Annotated[Path | None, Shown("--rig", metavar="TOML")] = None,
    map_name: Annotated[str | None, Shown("--map-name", metavar="NAME")] = None,
    sensor: SensorName | None = None,
    distance: Annotated[str, Shown(metavar="FROM:TO")] = "0.3:1.5",
    to: Annotated[list[str] | None, Shown(metavar="SINK")] = None,
    reading: FrameReading,
    mesh: Annotated[Landmark, Without("sensor")],
    search: Annotated[Search, Without("method", "filter_name", "pixels", "robust")],
    motion: Motion,
    page: Annotated[int | None, Shown(metavar="PORT")] = None,
    view: bool = False,
    at_once: bool = False,
    as_json: Json = False,
    force: Force = False,
) -> None:
    """Follow the pose before a landmark, or of a robot among walls, from a board's stream, and publish it.

    SOURCE is a serial port (/dev/ttyUSB0, or serial:///dev/ttyUSB0?baud=921600), - for standard input,
    tcp://HOST:PORT, udp://:PORT, zmq://HOST:PORT of a TMF8829, or a recording, which is replayed in time. A pose that
    is not accepted is not published; the status says why. Ctrl-C ends it.

    Parameters
    ----------
    source
        Where frames come from.
    landmark_name
        A bank; or a landmark, of which a bank is built and kept.
    map_file
        In place of a landmark: walls, boxes and landmarks, among which a rig of several sensors is followed.
    rig_file
        The sensors of that rig, which frames name.
    map_name
        Which map of a file with several.
    sensor
        Without a bank: a preset or sensor file.
    distance
        Without a bank: distances from the landmark, metres.
    to
        Where poses go; repeatable: - or jsonl:FILE, ros:NAME, mavlink:udpout:HOST:PORT, mcap:FILE, foxglove://HOST:PORT.
    page
        Serve a page with zones, residuals and pose on this port of localhost.
    view
        Show zones, residuals and pose in the terminal.
    at_once
        Replay a recording as fast as it is matched, each search in line.
    """
    from phasemark.matcher.live import Live, open_sink, open_source
    from phasemark.matcher.live.openers import files_of_sinks

    motion.check()
    refuse_input_files(written := files_of_sinks(to or []))
    refuse_existing([file for file in written if not file.is_fifo()], force)
    with ExitStack() as stack:
        if landmark_name is not None and map_file is None and rig_file is None:
            shown: Bank | None = (bank := stack.enter_context(_bank(landmark_name, mesh, sensor, distance)))
            found = open_source(source, bank.camera, vars(reading), in_time=not at_once)
            make: Any = partial(_tracker, bank, search, motion, found)
        elif landmark_name is None and map_file is not None and rig_file is not None:
            if reading != FrameReading():
                raise UsageError("options of how frames are read go with --landmark: a rig's frames say it themselves")
            shown = None
            found, make = _among_walls(source, rig_file, map_file, map_name, motion, not at_once)
        else:
            raise UsageError("give --landmark BANK|MESH|CLASS, or --map TOML and --rig TOML")
        with LongWork("getting bank and kernels ready"):
            tracker = make()
            tracker.warm()
        # files last, for a file that is opened is emptied
        names = sorted(to or ["-"], key=lambda name: (bool(files_of_sinks([name])), name.startswith("jsonl:")))
        sinks = [open_sink(name, None if shown is None else shown.camera, force=force) for name in names]
        sinks += _views(shown, page, view)
        session = Live(found, tracker, sinks, delay_s=tracker.delay_s, say=lambda line: tell(f"note: {line}"))
        _until_interrupted(session, shows_status=not view and sys.stderr.isatty())
        if as_json:
            echo_json({"status": session.status.as_dict()})
        else:
            tell(f"note: {session.status.frames} frames, {session.status.accepted} poses published{_lost(session)}")


def _lost(session: Live) -> str:
    """Return how many frames were not located, and why those that were damaged are."""
    status, source, words = session.status, session.source, ""
    if status.dropped:
        words += f"; {status.dropped} dropped for newer ones"
    if source.n_damaged:
        words += f"; {source.n_damaged} damaged: {source.damage}"
    return words


def _among_walls(
    source: str, rig_file: Path, map_file: Path, map_name: str | None, motion: Motion, in_time: bool
) -> tuple[Source, Callable[[], MapTracker]]:
    """Return the frames of a rig, and a function that makes what follows it."""
    from phasemark.matcher.live.map_tracker import MapTracker
    from phasemark.matcher.live.rig_frames import RecordedRig, open_rig_source
    from phasemark.matcher.locate import Locator, read_rig, read_wall_map
    from phasemark.matcher.locate.wall_map import map_of_run

    rig = read_rig(rig_file)
    found = open_rig_source(source, rig, in_time=in_time)
    recorded_in = found.recording.map_name if isinstance(found, RecordedRig) else None
    run = found.recording.run if isinstance(found, RecordedRig) else None
    wall_map = read_wall_map(map_file, map_of_run(map_file, recorded_in, run, map_name))
    return found, lambda: MapTracker(Locator(wall_map, rig), motion.speed, math.radians(motion.turn_rate))


def _bank(name: Path, mesh: Landmark, sensor: str | None, distance: str) -> Bank:
    """Return the bank of a landmark: one that exists, a kept one, or a new one."""
    if not mesh.is_for(name):
        if sensor is not None:
            raise UsageError(f"--sensor goes with a mesh or a class in place of a bank: {name} has its own")
        return open_any_bank(name)
    if sensor is None:
        raise UsageError(f"--landmark {name} needs --sensor NAME, a preset (phasemark sensor list) or a file")
    read_sensor(sensor)  # what is wrong with the sensor is said before what is wrong with the mesh
    read_landmark(str(name), MeshReading(mesh.part_unit, mesh.up, mesh.origin))
    return mesh.built(name, sensor, mesh.part_unit, f"{distance}:0.02" if distance.count(":") == 1 else distance)


def _tracker(bank: Bank, search: Search, motion: Motion, source: Source) -> Tracker:
    """Return the tracker of a landmark; searches run beside it, but in line for a recording."""
    from phasemark.matcher.live.mcap_log import McapSource
    from phasemark.matcher.live.search_beside import SearchesBeside, SearchesInLine
    from phasemark.matcher.live.tracker import Tracker
    from phasemark.matcher.sequence import FreeMotion, PoseEstimator, Standing

    if search.is_direct:
        raise UsageError(f"--on {search.on}: phasemark live follows ranges, reported ranges or phasors")
    stated = search.on or search.auto_background or search.no_background or search.background
    if bank.sensor.histogram is not None and not stated:
        # ranges as a chip reports them take seconds to search: too long for a stream
        search = replace(search, on="ranges", unknown_background=True)
    matcher = search.for_bank(bank).matcher(bank)
    # a speed that changes within a second from rest to the fastest
    turn = math.radians(motion.turn_rate)
    free = FreeMotion(motion.speed / 2, motion.speed, turn / 2, turn)
    estimator = PoseEstimator(Standing(flat=motion.flat), free, jitter_s=bank.sensor.systematic_time_s)
    if source.is_live and not matcher.is_quick:
        searches: Any = SearchesBeside(matcher)
    else:
        searches = SearchesInLine(matcher, logged=source.searches() if isinstance(source, McapSource) else None)
    delay_s = None if motion.delay_ms is None else motion.delay_ms / 1e3
    return Tracker(matcher, estimator, searches, delay_s=delay_s)


def _views(bank: Bank | None, page: int | None, view: bool) -> list[Any]:
    """Return the views of a session."""
    shown: list[Any] = []
    if page is not None:
        from phasemark.matcher.live.page import PageView

        shown.append(PageView(page, bank))
        tell(f"note: http://127.0.0.1:{shown[-1].port}/")
    if view:
        from phasemark.matcher.live.terminal import TerminalView

        shown.append(TerminalView(bank))
    return shown


def _until_interrupted(session: Live, *, shows_status: bool) -> None:
    """Run a session until its source ends or the user ends it; files are then whole."""
    before = {number: signal.signal(number, lambda *_: session.stop()) for number in (signal.SIGINT, signal.SIGTERM)}
    if shows_status:
        from phasemark.matcher.live.terminal import StatusLine

        session.sinks += (StatusLine(),)
    try:
        session.run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
