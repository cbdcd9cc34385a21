"""The command ``phasemark calibrate``: how a camera is mounted."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from phasemark import InputFileError, UsageError
from phasemark.data.commands.console import LongWork, echo_json, echo_table, readable
from phasemark.data.commands.inputs import background_of, load_landmark, load_sensor, note_too_far, open_any_bank
from phasemark.data.commands.options import (
    FlipH,
    FlipV,
    Floor,
    Force,
    FramesUnit,
    InvalidMeans,
    Json,
    Quantity,
    Rotate,
    ValidStatus,
    Wall,
    Workers,
    a_class,
    a_preset,
    one_of,
)
from phasemark.data.commands.outputs import refuse_existing

if TYPE_CHECKING:
    from trimesh import Trimesh

    from phasemark.matcher import (
        Calibration,
    )
    from phasemark.render import Sensor


def calibrate_camera(
    landmark: Annotated[
        str, typer.Argument(metavar="BANK|CLASS", help="A bank, or a class of the catalogue.", autocompletion=a_class)
    ],
    frames: Annotated[
        list[Path],
        typer.Argument(
            metavar="FRAMES...", help="Measured frames: a file for each pose, or one of them all, in order."
        ),
    ],
    poses: Annotated[
        Path,
        typer.Option(
            "--poses", metavar="CSV", help="Columns distance_m,delta_deg[,bearing_deg] or x_m,y_m,heading_deg [,t_ms]."
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="The sensor file to write, .toml.")],
    class_name: Annotated[
        str | None, typer.Option("--class", help="Which class of a bank that has several.", autocompletion=a_class)
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            "--sensor",
            metavar="NAME|FILE",
            help="The camera as it is thought to be; a bank has its own.",
            autocompletion=a_preset,
        ),
    ] = None,
    free: Annotated[
        str | None, typer.Option("--free", metavar="NAMES", help="Estimate these alone, e.g. pitch,roll,height.")
    ] = None,
    fix: Annotated[
        str | None, typer.Option("--fix", metavar="NAMES", help="Leave these as they are, e.g. fov.")
    ] = None,
    height: Annotated[
        float | None,
        typer.Option("--height", metavar="M", help="Landmark's origin above the lens, as it is thought to be."),
    ] = None,
    bearing: Annotated[
        float | None,
        typer.Option("--bearing", metavar="DEG", help="Where the camera sees it if 0 is stated, likewise."),
    ] = None,
    albedo: Annotated[float | None, typer.Option("--albedo", help="Of the landmark, likewise.")] = None,
    moving: Annotated[
        bool, typer.Option("--moving", help="A moving camera: each frame has a pose of its own, by time stamps.")
    ] = False,
    delay_ms: Annotated[
        float | None,
        typer.Option("--delay-ms", metavar="MS", help="Fixed delay: added to the stamp of a frame to get its time."),
    ] = None,
    zones: Annotated[
        bool | None,
        typer.Option("--zones/--no-zones", help="Offsets of zones and noise law of a direct sensor; with --moving."),
    ] = None,
    position_std: Annotated[
        float | None, typer.Option("--position-std", metavar="M", help="How well the places of the lens are known.")
    ] = None,
    heading_std: Annotated[
        float | None, typer.Option("--heading-std", metavar="DEG", help="How well the camera's headings are known.")
    ] = None,
    delta_std: Annotated[
        float | None, typer.Option("--delta-std", metavar="DEG", help="How well the landmark is turned to its side.")
    ] = None,
    landmark_xy: Annotated[
        tuple[float, float], typer.Option("--landmark-xy", metavar="X Y", help="Where it stands, for x_m,y_m.")
    ] = (0.0, 0.0),
    landmark_yaw: Annotated[float, typer.Option("--landmark-yaw", metavar="DEG", help="Heading of its x' axis.")] = 0.0,
    on: Annotated[
        str,
        typer.Option(
            "--on",
            help="auto, ranges, or phasors: amplitudes too.",
            autocompletion=one_of("auto", "ranges", "phasors"),
        ),
    ] = "auto",
    wall: Wall = None,
    floor: Floor = None,
    unit: FramesUnit = None,
    quantity: Quantity = None,
    invalid_means: InvalidMeans = "missing",
    valid_status: ValidStatus = None,
    flip_h: FlipH = False,
    flip_v: FlipV = False,
    rotate: Rotate = 0,
    plot: Annotated[
        Path | None,
        typer.Option("--plot", help="The picture of the residuals, .png; beside the sensor file otherwise."),
    ] = None,
    workers: Workers = None,
    as_json: Json = False,
    force: Force = False,
) -> None:
    """Find how a camera is mounted from frames of a landmark taken at known positions.

    Pitch, roll, height, bearing, field of view, range offset, from amplitudes the landmark's albedo, and with --moving
    the delay of the stamps: --free and --fix take pitch, roll, height, bearing, half_angle_h, half_angle_v (both: fov),
    range_offset, albedo and delay. A result that cannot be trusted is not written without --force (exit code 3).
    """
    import io as bytes_io

    from phasemark.data import read_frames, write_atomically
    from phasemark.data.shards.executor import processors
    from phasemark.matcher import PoseStd, calibrate, filter_poses, frames_of_poses, kalman_filter, read_poses
    from phasemark.matcher.calibration.mounting_model import Mounting
    from phasemark.matcher.calibration.report import calibration_dict, calibration_toml, residual_picture

    if out.suffix.lower() != ".toml":
        raise UsageError(f"the sensor must be a .toml file, got '{out}'")
    picture = plot or out.with_suffix(".png")
    if picture.suffix.lower() != ".png":
        raise UsageError(f"the picture must be a .png file, got '{picture}'")
    refuse_existing([out, picture], force)
    background = background_of(wall, floor)
    mesh, base, base_name = _calibration_target(landmark, class_name, sensor)
    stds = None
    if (position_std, heading_std, delta_std) != (None, None, None):
        stds = PoseStd(position_std or 0.0, math.radians(heading_std or 0.0), math.radians(delta_std or 0.0))
    known = read_poses(poses, landmark_xy_m=landmark_xy, landmark_yaw_rad=math.radians(landmark_yaw))
    furthest_m = float(known.distance_m.max()) if len(known.distance_m) else None
    note_too_far(base, {f"{poses}: the landmark": furthest_m, "--wall": wall})
    measured = [
        read_frames(
            path,
            sensor=base,
            unit=unit,  # type: ignore[arg-type]  # read_frames says what is right
            quantity=quantity,  # type: ignore[arg-type]
            invalid_means=invalid_means,  # type: ignore[arg-type]
            valid_status=valid_status,
            flip_h=flip_h,
            flip_v=flip_v,
            rotate=rotate,
            untrusted=True,
        )
        for path in frames
    ]
    if moving:
        if len(measured) != 1:
            raise UsageError(f"--moving takes one recording, got {len(measured)} files")
        filtered = kalman_filter(measured[0].each_a_position())
    else:
        filtered = filter_poses(
            frames_of_poses(measured, known),
            on,  # type: ignore[arg-type]  # calibrate says what is right
        )
    fixed = [] if fix is None else _names(fix)
    if delay_ms is not None:
        if not moving:
            raise UsageError("--delay-ms takes --moving: still poses have no delay")
        fixed.append("delay")
    bright = float(mesh.metadata.get("albedo", 0.8)) if albedo is None else albedo
    if not 0 < bright <= 1:
        raise UsageError(f"--albedo must be in (0, 1], got {bright:g}")
    start = Mounting.of_sensor(base, bright)
    if height is not None:
        start = replace(start, height_m=height)
    if bearing is not None:
        start = replace(start, bearing_rad=math.radians(bearing))
    if delay_ms is not None:
        start = replace(start, delay_s=delay_ms / 1e3)
    with LongWork("rendering poses") as progress:
        found = calibrate(
            mesh,
            filtered,
            known,
            free=None if free is None else _names(free),
            fixed=fixed,
            start=start,
            on=on,  # type: ignore[arg-type]  # calibrate says what is right
            background=background,
            pose_std=stds,
            reports_z=quantity == "z" or None,
            moving=moving,
            zones=zones,
            workers=workers or min(processors(), 4),
            progress=progress,
        )
    if found.doubts and not force:
        raise InputFileError(
            f"nothing was written, for the calibration cannot be trusted: {'; '.join(found.doubts)}. Likely cause:"
            f" {found.cause} (--force writes it all the same)"
        )
    buffer = bytes_io.BytesIO()
    residual_picture(found).savefig(buffer, format="png", dpi=100)
    write_atomically(picture, buffer.getvalue(), force=force)
    write_atomically(out, calibration_toml(found, base_name=readable(base_name)).encode(), force=force)
    if as_json:
        echo_json({"file": str(out), "picture": str(picture), **calibration_dict(found)})
        return
    _echo_calibration(found)
    typer.echo(out)
    typer.echo(picture)


def _names(text: str) -> list[str]:
    """Split names at commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def _calibration_target(landmark: str, class_name: str | None, sensor: str | None) -> tuple[Trimesh, Sensor, str]:
    """Return the mesh of a landmark, and the camera as it is thought to be with its name."""
    from phasemark.landmarks import catalog

    path = Path(landmark)
    if landmark in catalog() or not (path.suffix or path.exists()):
        if class_name is not None:
            raise UsageError("--class belongs to a bank: give the class in its place")
        name = sensor or "pmd-16x16"
        return load_landmark(landmark, None, "z", "file", from_catalog=True)[1], load_sensor(name), name
    with open_any_bank(path) as bank:
        if class_name is None and len(bank.classes) > 1:
            raise UsageError(f"{landmark} has {', '.join(bank.classes)}: say with --class which one was recorded")
        mesh = bank.mesh(class_name or bank.classes[0])
        return (mesh, bank.sensor, landmark) if sensor is None else (mesh, load_sensor(sensor), sensor)


def _echo_calibration(found: Calibration) -> None:
    """Print every number with its standard deviation and use, their correlations, the test of the fit and notes."""
    from phasemark.matcher.calibration.mounting_model import PARAMETERS
    from phasemark.matcher.calibration.report import USES, shown, shown_names, shown_std

    rows = []
    for name in shown_names(found):
        parameter = PARAMETERS[name]
        use = USES.get(name) or f"{parameter.field} of the sensor"
        rows.append((name, shown(found, name), shown_std(found, name), parameter.unit, use))
    echo_table(("", "value", "±", "", "where it goes"), rows)
    if len(found.free) > 1:
        typer.echo("\ncorrelation")
        echo_table(
            ("", *found.free),
            (
                (name, *(f"{value:.2f}" for value in row))
                for name, row in zip(found.free, found.correlation, strict=True)
            ),
        )
    typer.echo(f"\nχ² = {found.chi2:.6g}, {found.dof} degrees of freedom, p = {found.p_value:.3g}")
    typer.echo(f"standard deviations from {found.covariance_from}")
    before, after = found.held_out_m
    if math.isfinite(after):
        typer.echo(f"residuals of held-out frames, r.m.s.: {1e3 * before:.3g} mm before, {1e3 * after:.3g} mm after")
    for note in found.notes:
        typer.echo(f"note: {note}")
    for doubt in found.doubts:
        typer.echo(f"not to be trusted: {doubt}; likely cause: {found.cause}")
