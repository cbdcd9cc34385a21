"""Commands for a robot with several sensors: where it stands in a map, and how its sensors are mounted."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from phasemark import InputFileError, UsageError
from phasemark.data.commands.command import Shown, refuse_options
from phasemark.data.commands.console import LongWork, echo, echo_json, echo_table
from phasemark.data.commands.options import Count, Degrees, Force, Json, Metres, Out
from phasemark.data.commands.outputs import refuse_existing, refuse_other_files, write_figure, write_file
from phasemark.matcher import locate  # it imports what is used

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from phasemark.matcher.locate.locator import LocatedPose, Locator
    from phasemark.matcher.locate.recording import RigRecording
    from phasemark.matcher.locate.rig import Rig
    from phasemark.matcher.locate.rig_calibration import RigCalibration
    from phasemark.matcher.locate.wall_map import WallMap


def locate_rig(
    map_file: Path,
    rig_file: Path,
    recordings: Annotated[list[Path], Shown(metavar="RECORDING...")],
    *,
    start: Annotated[Path | None, Shown(metavar="CSV")] = None,
    odometry: bool = False,
    start_std: Metres = 0.5,
    start_yaw_std: Degrees = 15.0,
    frames: Count | None = None,
    smooth: bool = False,
    tilt: bool = False,
    map_name: Annotated[str | None, Shown("--map-name", metavar="NAME")] = None,
    tolerance: Metres = 0.1,
    tolerance_yaw: Degrees = 5.0,
    out: Out,
    plot: Path | None = None,
    as_json: Json = False,
    force: Force = False,
) -> None:
    """Find where a robot with several range sensors stands among the walls of a map.

    Without --start or --odometry the whole map is searched. Where several poses explain a stop it is refused as
    ambiguous, and all of them are listed. The table has a line a stop: pose, covariance, accepted, reason, explained
    share of the columns, alternatives.

    Parameters
    ----------
    map_file
        Walls, boxes, meshes and landmarks, .toml.
    rig_file
        The sensors and what is unknown of them, .toml.
    recordings
        Depths of columns or zones at the frames of stops, .npz.
    start
        Where the robot is believed to be: columns stop,x_m,y_m,yaw_deg[,robot,run].
    odometry
        Follow each robot from the first pose of its odometry, or its first in --start.
    start_std
        Standard deviation of the coordinates of starts.
    start_yaw_std
        Standard deviation of the headings of starts.
    frames
        Use that many frames of each stop.
    smooth
        Join the stops of each robot by its odometry.
    tilt
        Estimate z, pitch and roll, too, from recordings with rows of zones.
    map_name
        Which map of a file with several; the recording names it otherwise.
    tolerance
        Three standard deviations of an accepted position, and how far another explanation may be off.
    tolerance_yaw
        The same of the heading.
    out
        The table, .csv.
    plot
        A figure of the poses in their maps, .png.
    """
    from phasemark.matcher.locate.figures import locate_figure
    from phasemark.matcher.locate.pose_table import pose_csv
    from phasemark.matcher.locate.smoothing import odometry_of
    from phasemark.matcher.locate.wall_map import map_of_run

    if start is None and not odometry:
        refuse_options("only with --start or --odometry", ("start_std", "start_yaw_std"))
    refuse_other_files(out, ".csv", "the table")
    if plot is not None:
        refuse_other_files(plot, ".png")
    refuse_existing([out] if plot is None else [out, plot], force)
    rig, answers, drawn, robot_key = locate.read_rig(rig_file), [], [], "robot"
    std = (start_std, start_std, math.radians(start_yaw_std))
    with LongWork("locating"):
        for recording in _recordings(recordings, rig):
            recording = recording if frames is None else recording.first_frames(frames)
            name = map_of_run(map_file, recording.map_name, recording.run, map_name)
            wall_map = locate.read_wall_map(map_file, name)
            limits = {"tolerance_m": tolerance, "tolerance_rad": math.radians(tolerance_yaw)}
            locator = locate.Locator(wall_map, rig, with_tilt=tilt, **limits)
            if smooth:
                odometry_of(recording)  # before the stops are located
            found = _located(locator, recording, start, odometry, std)
            found = locate.smoothed(recording, found, locator) if smooth else found
            drawn.append((recording.run, locator.model.outline, found, None))
            answers += found
            robot_key = recording.robot_key
    write_file(out, pose_csv(answers, robot_key), force)
    if plot is not None:
        write_figure(plot, locate_figure(drawn), force)
    if as_json:
        return echo_json({"file": str(out), "poses": [one.as_dict() for one in answers]})
    _echo_summary(answers)
    echo(out)


def _located(
    locator: Locator, recording: RigRecording, start: Path | None, odometry: bool, std: tuple[float, float, float]
) -> list[LocatedPose]:
    """Locate the stops of a recording from what is known beforehand."""
    from phasemark.matcher.locate.recording import poses_of, read_stop_poses

    starts = None if start is None else poses_of(recording, read_stop_poses(start))
    if starts is not None and all(math.isnan(pose[0]) for pose in starts):
        raise InputFileError(f"{start}: has no pose of '{recording.run}', whose first stop is {recording.key(0)[1]}")
    if odometry:
        first = {}
        if starts is not None:
            first = {int(robot): pose for robot, pose in zip(recording.robot[::-1], starts[::-1], strict=True)}
            if any(math.isnan(pose[0]) for pose in first.values()):
                raise UsageError(f"{start}: must have the first pose of each robot of '{recording.run}'")
        return locator.follow(recording, first, std)
    return locator.locate(recording, starts, std)


def _echo_summary(answers: Sequence[LocatedPose]) -> None:
    """Print how many stops of each recording were accepted, and why others were not."""
    rows = []
    for run in dict.fromkeys(one.key[0] for one in answers):
        own = [one for one in answers if one.key[0] == run]
        refused = Counter(one.reason for one in own if not one.accepted)
        reasons = ", ".join(f"{count} {reason}" for reason, count in refused.most_common())
        rows.append((run, str(len(own)), str(sum(one.accepted for one in own)), reasons))
    echo_table(("recording", "stops", "accepted", "refused"), rows)
    echo(*(f"note: {one.key[0]} stop {one.key[1]}: {one.note}" for one in answers if one.note))


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
    from phasemark.matcher.locate.rig_calibration import FREE, calibrate_rig

    if map_file is None:
        raise UsageError("--rig needs --map, the walls among which the recordings were made")
    refuse_other_files(out, ".toml", "the rig")
    refuse_existing([out], force)
    rig = locate.read_rig(rig_file)
    read = _recordings(recordings, rig)
    maps, names = _maps(map_file, read)
    moved_maps = names if "walls" in (free or ()) else {}
    plain = [re.sub(r"[^\w.-]", "_", name) for name in moved_maps]
    beside = [out.with_name(f"{out.stem}-{name}.toml") for name in plain]
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
    _echo_rig(found)
    echo(*files)


def _recordings(paths: Sequence[Path], rig: Rig) -> list[RigRecording]:
    """Read recordings of a rig, each stop of which must be in one of them."""
    from phasemark.matcher.locate.recording import refuse_stops_twice

    read = [locate.read_rig_recording(path, rig) for path in paths]
    refuse_stops_twice(read)
    return read


def _maps(map_file: Path, recordings: Sequence[RigRecording]) -> tuple[list[WallMap], dict[str, WallMap]]:
    """Return the map of each recording, and each map by its name."""
    from phasemark.matcher.locate.wall_map import map_of_run

    names = [map_of_run(map_file, recording.map_name, recording.run) for recording in recordings]
    by_name = {name or "map": locate.read_wall_map(map_file, name) for name in dict.fromkeys(names)}
    return [by_name[name or "map"] for name in names], by_name


def _poses(tables: Sequence[Path], recordings: Sequence[RigRecording]) -> list[NDArray]:  # type: ignore[type-arg]
    """Return the measured poses of each recording."""
    from phasemark.matcher.locate.recording import poses_of, read_stop_poses

    if len(tables) not in (1, len(recordings)):
        raise UsageError(
            f"--poses must be one table, or one for each recording, got {len(tables)} for {len(recordings)} recordings"
        )
    read = [read_stop_poses(path) for path in tables] * (len(recordings) if len(tables) == 1 else 1)
    return [poses_of(recording, table) for recording, table in zip(recordings, read, strict=True)]


def _echo_rig(found: RigCalibration) -> None:
    """Print what changed, the marker frames and the residuals."""
    rows = [(name, sensor, f"{value:+.3f}", f"{std:.3f}", unit) for name, sensor, value, std, unit in found.numbers]
    echo_table(("", "sensor", "change", "±", ""), rows)
    echo("\nthe body in the frame of each recording's poses")
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
