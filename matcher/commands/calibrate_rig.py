"""The part of ``phasemark calibrate`` that calibrates a rig of several sensors in a map."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from phasemark import InputFileError, UsageError
from phasemark.data.commands.console import LongWork, echo, echo_json, echo_table
from phasemark.data.commands.outputs import refuse_existing, refuse_other_files, write_file

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from phasemark.matcher.locate.recording import RigRecording
    from phasemark.matcher.locate.rig_calibration import RigCalibration
    from phasemark.matcher.locate.wall_map import WallMap


def calibrate_rig_file(
    rig_file: Path,
    map_file: Path | None,
    recordings: Sequence[Path],
    poses: Sequence[Path],
    free: Sequence[str] | None,
    out: Path,
    write_distrusted: bool,
    force: bool,
    as_json: bool,
) -> None:
    """Calibrate a rig from recordings whose stops have measured poses, and write its file.

    Parameters
    ----------
    rig_file, map_file
        The assumed rig, and the map or maps.
    recordings, poses
        A table of poses for each recording, or one of them all.
    free
        What is estimated; None: all but walls.
    out
        The rig file to write, .toml; displaced walls go beside it.
    """
    from phasemark.matcher.locate.recording import read_rig_recording
    from phasemark.matcher.locate.rig import read_rig
    from phasemark.matcher.locate.rig_calibration import FREE, calibrate_rig

    if map_file is None:
        raise UsageError("--rig needs --map, the walls among which the recordings were made")
    refuse_other_files(out, ".toml", "the rig")
    refuse_existing([out], force)
    rig = read_rig(rig_file)
    read = [read_rig_recording(path, rig) for path in recordings]
    maps, names = _maps(map_file, read)
    beside = [out.with_name(f"{out.stem}-{name}.toml") for name in names] if "walls" in (free or ()) else []
    refuse_existing(beside, force)
    with LongWork("calibrating the rig") as progress:
        found = calibrate_rig(rig, read, maps, _poses(poses, read), tuple(free or FREE), progress)
    if found.doubts and not write_distrusted:
        raise InputFileError(
            f"nothing was written, for the calibration cannot be trusted: {'; '.join(found.doubts)}"
            " (--write-distrusted writes it all the same)"
        )
    files = [write_file(out, found.rig.to_toml(), force)]
    for path, one, moved in zip(beside, names.values(), found.wall_m, strict=False):  # none if walls are not free
        files.append(write_file(path, one.with_walls_moved(moved[: len(one.walls)]).to_toml(), force))
    if as_json:
        return echo_json({"files": [str(path) for path in files], **found.as_dict()})
    _echo(found)
    echo(*files)


def _maps(map_file: Path, recordings: Sequence[RigRecording]) -> tuple[list[WallMap], dict[str, WallMap]]:
    """Return the map of each recording, and each map by its name."""
    from phasemark.matcher.locate.wall_map import read_wall_map

    by_name: dict[str, WallMap] = {}
    for recording in recordings:
        name = recording.map_name or "map"
        by_name.setdefault(name, read_wall_map(map_file, recording.map_name))
    return [by_name[recording.map_name or "map"] for recording in recordings], by_name


def _poses(tables: Sequence[Path], recordings: Sequence[RigRecording]) -> list[NDArray]:  # type: ignore[type-arg]
    """Return the measured poses of each recording."""
    from phasemark.matcher.locate.recording import poses_of, read_stop_poses

    if len(tables) not in (1, len(recordings)):
        raise UsageError(
            f"--poses must be one table, or one for each recording, got {len(tables)} for {len(recordings)} recordings"
        )
    read = [read_stop_poses(path) for path in tables] * (len(recordings) if len(tables) == 1 else 1)
    return [poses_of(recording, table) for recording, table in zip(recordings, read, strict=True)]


def _echo(found: RigCalibration) -> None:
    """Print what changed, the marker frames and the residuals."""
    rows = [(name, sensor, f"{value:+.3f}", f"{std:.3f}", unit) for name, sensor, value, std, unit in found.numbers]
    echo_table(("", "sensor", "change", "±", ""), rows)
    echo("\nmarker frames, in the body")
    frames = [
        (run, str(robot), f"{1e3 * x:+.1f}", f"{1e3 * y:+.1f}", f"{math.degrees(yaw):+.2f}")
        for run, robot, (x, y, yaw) in found.markers
    ]
    echo_table(("recording", "robot", "x (mm)", "y (mm)", "yaw (°)"), frames)
    echo(
        f"\n{found.stops} stops; residuals, r.m.s. in standard deviations: {found.rms[0]:.2f} before,"
        f" {found.rms[1]:.2f} after",
        "the mean yaw of the sensors is that of the rig file: a turn of all of them is one of the marker frames",
    )
    echo(*(f"not to be trusted: {doubt}" for doubt in found.doubts))
