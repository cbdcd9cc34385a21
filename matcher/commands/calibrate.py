"""The command ``phasemark calibrate``: how a camera is mounted."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from phasemark import InputFileError, UsageError
from phasemark.data.commands.command import Shown, refuse_options
from phasemark.data.commands.console import LongWork, echo, echo_json, echo_table, readable, tell
from phasemark.data.commands.flag_wording import in_flags
from phasemark.data.commands.inputs import background_to_estimate, class_mesh, note_too_far, open_any_bank, read_sensor
from phasemark.data.commands.options import (
    BouncesOfLight,
    ClassName,
    Degrees,
    Floor,
    Force,
    FrameReading,
    Json,
    Metres,
    Out,
    SensorName,
    Wall,
    Workers,
    a_class,
)
from phasemark.data.commands.outputs import refuse_existing, refuse_other_files, write_figure, write_file
from phasemark.matcher.commands.locate import calibrate_rig_file

if TYPE_CHECKING:
    from trimesh import Trimesh

    from phasemark.matcher import FilteredFrames
    from phasemark.matcher.calibration import Mounting
    from phasemark.matcher.calibration.known_poses import KnownPoses, PoseStd
    from phasemark.matcher.calibration.pose_frames import Explained
    from phasemark.matcher.calibration.result import Calibration
    from phasemark.render import Frames, Sensor

Names = Annotated[str, Shown(metavar="NAMES")]

_OF_RIG = "poses", "out", "free", "rig_file", "map_file", "as_json", "write_distrusted", "force"
"""Parameters that count with a rig."""


def calibrate_camera(
    bank_or_class: Annotated[str, Shown(autocompletion=a_class)],
    frames: list[Path] | None = None,
    *,
    poses: Annotated[list[Path], Shown(metavar="CSV")],
    out: Out,
    class_name: ClassName | None = None,
    sensor: SensorName | None = None,
    free: Names | None = None,
    fix: Names | None = None,
    height: Metres | None = None,
    bearing: Degrees | None = None,
    albedo: float | None = None,
    moving: bool = False,
    delay_ms: Annotated[float | None, Shown(metavar="MS")] = None,
    zones: Annotated[bool | None, Shown("--zones/--no-zones")] = None,
    position_std: Metres | None = None,
    heading_std: Degrees | None = None,
    delta_std: Degrees | None = None,
    landmark_xy: Annotated[tuple[float, float], Shown(metavar="X Y")] = (0.0, 0.0),
    landmark_yaw: Degrees = 0.0,
    on: Literal["auto", "ranges", "reported", "phasors"] = "auto",
    wall: Wall = None,
    floor: Floor = None,
    bounces: BouncesOfLight = "0",
    floor_albedo: float | None = None,
    reading: FrameReading,
    plot: Path | None = None,
    rig_file: Path | None = None,
    map_file: Path | None = None,
    workers: Workers = None,
    as_json: Json = False,
    write_distrusted: bool = False,
    force: Force = False,
) -> None:
    """Find how a camera is mounted from frames of a landmark taken at known positions.

    Estimated are, by the names that --free and --fix take: pitch, roll, height, bearing, half_angle_h, half_angle_v
    (both: fov), range_offset, from amplitudes the landmark's albedo, with --floor and --bounces that of the floor
    (floor_albedo), and with --moving the delay of the stamps. A sensor with a lens has its terms in place of half
    angles, estimated where --free names them: fx, fy, cx, cy, k1, k2 ... (all: lens). A result that cannot be trusted
    is not written (exit code 3) without --write-distrusted.

    With --rig and --map: what several range sensors on one robot share, from recordings whose stops have poses. All
    arguments are recordings; --free takes yaw, position, delay, offset, scale, fov and walls.

    Parameters
    ----------
    bank_or_class
        A bank, or a class of the catalogue; with --rig a recording.
    frames
        Measured frames: a file for each pose, or one of them all, in order; with --moving recordings.
    poses
        Columns distance_m,delta_deg[,bearing_deg] or x_m,y_m,heading_deg [,t_ms,pitch_deg,roll_deg]; once for each
        recording. With --rig: run,stop,robot,x_m,y_m,yaw_deg.
    out
        The sensor file to write, .toml.
    class_name
        Which class of a bank that has several.
    sensor
        The assumed camera; a bank has its own.
    free
        Estimate these alone, e.g. pitch,roll,height.
    fix
        Leave these as they are, e.g. fov.
    height
        Assumed height of the landmark's origin above the lens.
    bearing
        Initial guess for the bearing offset.
    albedo
        Initial guess for the landmark's albedo.
    moving
        A moving camera: each frame has a pose of its own, by time stamps.
    delay_ms
        Fixed delay: added to the stamp of a frame to get its time.
    zones
        Offsets of zones and noise law of a direct sensor; with --moving.
    position_std
        Standard deviation of the coordinates of the lens.
    heading_std
        Standard deviation of the camera's headings.
    delta_std
        Standard deviation of the side δ that the landmark was turned to.
    landmark_xy
        Place of the landmark, for x_m,y_m.
    landmark_yaw
        Heading of its x' axis.
    on
        What is explained: ranges, ranges as a chip reports them (reported), or phasors, which use amplitudes too; auto
        chooses.
    floor_albedo
        With --floor and --bounces: albedo of the floor; estimated between 0.05 and 0.6 unless stated.
    plot
        The figure of the residuals, .png; beside the sensor file otherwise.
    rig_file
        The assumed rig of several sensors, .toml.
    map_file
        The walls that it was among, .toml.
    write_distrusted
        Write a result that cannot be trusted, too; the file then names the doubts.
    """
    from phasemark.data.shards.build import processors
    from phasemark.matcher import calibrate
    from phasemark.matcher.calibration.known_poses import read_poses

    if rig_file is not None:
        refuse_options("not with --rig: nothing of the kind is asked of its sensors", but=_OF_RIG)
        files, chosen = [Path(bank_or_class), *(frames or ())], None if free is None else _names(free)
        return calibrate_rig_file(rig_file, map_file, files, poses, chosen, out, write_distrusted, force, as_json)
    if not frames:
        raise UsageError("missing argument FRAMES: measured frames of the landmark")
    figure = plot or out.with_suffix(".png")
    refuse_other_files(out, ".toml", "the sensor")
    refuse_other_files(figure, ".png")
    refuse_existing([out, figure], force)
    background = background_to_estimate(wall, floor, bounces, floor_albedo)
    mesh, base, base_name = _calibration_target(bank_or_class, class_name, sensor)
    yaw = math.radians(landmark_yaw)
    known = [read_poses(path, landmark_xy_m=landmark_xy, landmark_yaw_rad=yaw) for path in poses]
    note_too_far(base, {"--poses: the landmark": max(one.distance_m.max() for one in known), "--wall": wall})
    filtered = _filtered([reading.read(path, base) for path in frames], known, on, moving)
    fixed = _fixed_names(fix, delay_ms, moving)
    start = _start(base, mesh, albedo, height, bearing, delay_ms)
    with LongWork("rendering poses") as progress:
        found = calibrate(
            mesh,
            filtered,
            known,
            free=None if free is None else _names(free),
            fixed=fixed,
            start=start,
            on=on,
            background=background,
            pose_std=_pose_std(position_std, heading_std, delta_std),
            reports_z=None if reading.quantity is None else reading.quantity == "z",
            moving=moving,
            zones=zones,
            workers=workers or min(processors(), 4),
            progress=progress,
        )
    _write_calibration(found, out, figure, base_name, force, write_distrusted, as_json)


def _pose_std(position: float | None, heading_deg: float | None, delta_deg: float | None) -> PoseStd | None:
    """Return how well the poses are known; None if nothing is said of it."""
    from phasemark.matcher.calibration.known_poses import PoseStd

    if (position, heading_deg, delta_deg) == (None, None, None):
        return None
    return PoseStd(position or 0.0, math.radians(heading_deg or 0.0), math.radians(delta_deg or 0.0))


def _filtered(
    measured: Sequence[Frames], known: Sequence[KnownPoses], on: Explained, moving: bool
) -> list[FilteredFrames]:
    """Return the frames of each recording one by one, and those of a still camera averaged at each pose."""
    from phasemark.matcher import kalman_filter
    from phasemark.matcher.calibration import filter_poses, frames_of_poses
    from phasemark.matcher.recordings.stillness import motion_note

    if moving:
        if len(measured) != len(known):
            raise UsageError(
                f"--moving takes a file of poses for each recording, got {len(measured)} recordings and {len(known)}"
                " --poses"
            )
        return [kalman_filter(one.each_a_position()) for one in measured]
    if len(known) != 1:
        raise UsageError(f"still poses are one file of them all, got {len(known)} --poses (recordings take --moving)")
    of_poses = frames_of_poses(measured, known[0])
    if note := motion_note(of_poses):
        tell(f"note: {note}; a recording of a moving camera takes --moving")
    return [filter_poses(of_poses, on)]


def _fixed_names(fix: str | None, delay_ms: float | None, moving: bool) -> list[str]:
    """Return the names of what is not estimated; a delay that is given is one of them."""
    fixed = [] if fix is None else _names(fix)
    if delay_ms is None:
        return fixed
    if not moving:
        raise UsageError("--delay-ms takes --moving: still poses have no delay")
    return [*fixed, "delay"]


def _start(
    base: Sensor,
    mesh: Trimesh,
    stated: float | None,
    height: float | None,
    bearing_deg: float | None,
    delay_ms: float | None,
) -> Mounting:
    """Return the initial guess of the mounting, with the albedo that was stated or that of the mesh."""
    from phasemark.matcher.calibration import Mounting

    albedo = float(mesh.metadata.get("albedo", 0.8)) if stated is None else stated
    if not 0 < albedo <= 1:
        raise UsageError(f"--albedo must be in (0, 1], got {albedo:g}")
    start = Mounting.of_sensor(base, albedo)
    if height is not None:
        start = replace(start, height_m=height)
    if bearing_deg is not None:
        start = replace(start, bearing_rad=math.radians(bearing_deg))
    return start if delay_ms is None else replace(start, delay_s=delay_ms / 1e3)


def _write_calibration(
    found: Calibration, out: Path, figure: Path, base_name: str, force: bool, write_distrusted: bool, as_json: bool
) -> None:
    """Write the sensor file and the figure of the residuals, unless the calibration cannot be trusted; print it."""
    from phasemark.matcher.calibration.report import residual_figure

    found = replace(found, notes=tuple(map(in_flags, found.notes)), cause=in_flags(found.cause))
    if found.doubts and not write_distrusted:
        raise InputFileError(
            f"nothing was written, for the calibration cannot be trusted: {'; '.join(found.doubts)}. Likely cause:"
            f" {found.cause} (--write-distrusted writes it all the same)"
        )
    write_figure(figure, residual_figure(found), force, dpi=100)
    write_file(out, found.to_toml(base_name=readable(base_name)), force)
    if as_json:
        return echo_json({"file": str(out), "picture": str(figure), **found.as_dict()})
    _echo_calibration(found)
    echo(out, figure)


def _names(text: str) -> list[str]:
    """Split names at commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def _calibration_target(landmark: str, class_name: str | None, sensor: str | None) -> tuple[Trimesh, Sensor, str]:
    """Return the mesh of a landmark, the camera before the calibration, and the name of that camera."""
    from phasemark.landmarks import catalog

    path = Path(landmark)
    if landmark in catalog() or not (path.suffix or path.exists()):
        if class_name is not None:
            raise UsageError("--class belongs to a bank: give the class in its place")
        name = sensor or "pmd-16x16"
        return class_mesh(landmark), read_sensor(name), name
    with open_any_bank(path) as bank:
        if class_name is None and len(bank.classes) > 1:
            raise UsageError(f"{landmark} has {', '.join(bank.classes)}: say with --class which one was recorded")
        mesh = bank.mesh(class_name or bank.classes[0])
        return (mesh, bank.camera, landmark) if sensor is None else (mesh, read_sensor(sensor), sensor)


def _echo_calibration(found: Calibration) -> None:
    """Print every number with its standard deviation and use, their correlations, the test of the fit and notes."""
    from phasemark.matcher.calibration.mounting import PARAMETERS
    from phasemark.matcher.calibration.result import USES, shown, shown_names

    rows = []
    for name in shown_names(found):
        parameter = PARAMETERS[name]
        use = USES.get(name) or f"{parameter.field} of the sensor"
        rows.append((name, *shown(found, name), parameter.unit, use))
    echo_table(("", "value", "±", "", "where it goes"), rows)
    if len(found.free) > 1:
        echo("\ncorrelation")
        echo_table(
            ("", *found.free),
            (
                (name, *(f"{value:.2f}" for value in row))
                for name, row in zip(found.free, found.correlation, strict=True)
            ),
        )
    _echo_recordings(found)
    test = f"χ² = {found.chi2:.6g}, {found.dof} degrees of freedom, p = {found.p_value:.3g}"
    echo("", test, f"standard deviations from {found.covariance_from}")
    before, after = found.held_out_m
    if math.isfinite(after):
        echo(f"residuals of held-out frames, r.m.s.: {1e3 * before:.3g} mm before, {1e3 * after:.3g} mm after")
    echo(*(f"note: {note}" for note in found.notes))
    echo(*(f"not to be trusted: {doubt}; likely cause: {found.cause}" for doubt in found.doubts))


def _echo_recordings(found: Calibration) -> None:
    """Print what each recording has of its own, if there are several."""
    from phasemark.matcher.calibration.recording_effects import own_title

    if len(found.own) < 2:
        return
    rows = []
    titles = [own_title(name) for name in found.own[0]]
    for k, own in enumerate(found.own, 1):
        numbers = zip(own.values(), titles, strict=True)
        rows.append((str(k), *(f"{by * value:+.2f} ± {by * std:.2f}" for (value, std), (_, by, _) in numbers)))
    echo("\nrecordings, less what they share")
    echo_table(("", *(f"{title} ({unit})" for title, _, unit in titles)), rows)
