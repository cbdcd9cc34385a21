"""Commands of ``phasemark frames``: frame sets, recordings and measured frames."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from phasemark import UsageError
from phasemark.data.commands.build import build_or_estimate, merge_shards
from phasemark.data.commands.command import Without
from phasemark.data.commands.console import LongWork, echo_facts, echo_json, readable
from phasemark.data.commands.inputs import (
    background_of,
    open_frame_set,
    read_class_or_mesh,
    read_sensor,
    refuse_unless_one,
)
from phasemark.data.commands.options import (
    Building,
    Floor,
    Force,
    FrameReading,
    Json,
    MeshReading,
    Pitch,
    QuantityWord,
    Resume,
    Roll,
    Sample,
    Seed,
    SensorName,
    Wall,
    a_class,
)
from phasemark.data.commands.outputs import refuse_existing, refuse_input_files, refuse_unwritable_files

if TYPE_CHECKING:
    from phasemark.render import Sensor, Views

ExportFormat = Literal["npz", "csv", "jsonl", "png16", "ply", "bop", "rosbag"]

_RECORDED_PIXELS = 5_000_000
"""Most pixels of a simulated recording, all frames together: some hundred bytes of memory each."""


def frames_build(
    *,
    plan_file: Annotated[Path, typer.Argument(metavar="PLAN", help="A plan (.toml); options override it.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The frame set to write; its checksum goes beside it.")],
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, max=2**64 - 1, help="Root of all random numbers.")
    ] = None,
    views: Annotated[int | None, typer.Option("--views", min=1, help="Number of views.")] = None,
    building: Building,
) -> None:
    """Build a set of noisy frames with their truth."""
    from phasemark.data import FramePlan, build_frames, read_plan

    plan = read_plan(plan_file, FramePlan)
    changes = {key: value for key, value in (("seed", seed), ("views", views)) if value is not None}
    plan = plan.model_copy(update=changes)
    build_or_estimate(build_frames, plan, out, building)


def frames_info(
    *,
    frames: Annotated[Path, typer.Argument(metavar="FRAMES", help="A frame set.")],
    as_json: Json = False,
) -> None:
    """Print the content of a frame set."""
    with open_frame_set(frames) as opened:
        info = opened.info()
    echo_json(info) if as_json else echo_facts(info)


def frames_verify(
    *,
    frames: Annotated[Path, typer.Argument(metavar="FRAMES", help="A frame set, its checksum beside it.")],
    sample: Sample = 16,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Check a frame set: checksum, schema, values, and random views rendered and captured again."""
    from phasemark.data.verify import verify_frames

    with LongWork("verifying"):
        report = verify_frames(frames, sample=sample, seed=seed)
    echo_json(report) if as_json else echo_facts(report)


def frames_merge(
    *,
    shards: Annotated[list[Path], typer.Argument(metavar="SHARD...", help="All parts that --shard has built.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The frame set to write.")],
    resume: Resume = False,
    force: Force = False,
) -> None:
    """Put the parts of a frame set together; the bytes are those of a single run."""
    merge_shards(shards, out, resume, force)


def frames_export(
    *,
    frames: Annotated[Path, typer.Argument(metavar="FRAMES", help="A frame set.")],
    to: Annotated[
        ExportFormat,
        typer.Option("--to", metavar="FORMAT", help="npz, csv, jsonl, png16, ply, bop or rosbag."),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="The file (npz, csv, jsonl) or folder to write.")],
    quantity: Annotated[
        QuantityWord | None,
        typer.Option("--quantity", help="range or z, in npz, csv and png16; BOP and ROS have z."),
    ] = None,
    content: Annotated[
        Literal["range", "targets", "histogram"] | None,
        typer.Option(
            "--content",
            help="Of histograms: range (of the nearest target), targets (npz, csv) or histogram (npz, jsonl).",
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Write a frame set for other programs."""
    refuse_input_files([out])
    with open_frame_set(frames) as opened:
        from phasemark.data.export import export_frames

        typer.echo(export_frames(opened, out, to, quantity=quantity, content=content, force=force))


def frames_import(
    *,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="CSV, NPY, NPZ, HDF5, PNG; a folder of PNG, a bag.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The measured frames as .npz, range along the ray, metres.")],
    sensor: SensorName = "pmd-16x16",
    reading: FrameReading,
    topic: Annotated[str | None, typer.Option("--topic", help="Which images of a ROS bag.")] = None,
    force: Force = False,
) -> None:
    """Convert measured frames to one form: range along the ray, in metres, upright."""
    from phasemark.data.measured.reading import write_measured

    if out.suffix.lower() != ".npz":
        raise UsageError(f"the output must be a .npz file, got '{out}'")
    refuse_existing([out], force)
    frames = reading.read(file, read_sensor(sensor), topic=topic)
    typer.echo(write_measured(frames, out, force=force))


def frames_simulate(
    *,
    out: Annotated[Path, typer.Option("-o", "--out", help="The recording to write: .csv, .npz or .h5.")],
    class_name: Annotated[
        str | None, typer.Option("--class", help="A class of the catalogue.", autocompletion=a_class)
    ] = None,
    mesh_file: Annotated[str | None, typer.Option("--mesh", metavar="NAME=FILE", help="A mesh file.")] = None,
    mesh_reading: MeshReading,
    sensor: SensorName = "pmd-16x16",
    distance: Annotated[
        float, typer.Option("--distance", metavar="M", help="Distance D to the landmark's axis, in the first frame.")
    ] = 1.0,
    delta: Annotated[
        float, typer.Option("--delta", metavar="DEG", help="Side δ from which the landmark is seen in the first frame.")
    ] = 0.0,
    bearing: Annotated[
        float, typer.Option("--bearing", metavar="DEG", help="Azimuth of the landmark in the camera frame.")
    ] = 0.0,
    height: Annotated[
        float, typer.Option("--height", metavar="M", help="Height of the landmark's origin above the lens.")
    ] = 0.0,
    pitch: Pitch = 0.0,
    roll: Roll = 0.0,
    wall: Wall = None,
    floor: Floor = None,
    moving: Annotated[
        bool, typer.Option("--moving/--still", help="Change D and δ evenly until the last frame.")
    ] = False,
    to_distance: Annotated[
        float | None,
        typer.Option("--to-distance", metavar="M", help="With --moving, D in the last frame; 0.8 of the first."),
    ] = None,
    to_delta: Annotated[
        float | None, typer.Option("--to-delta", metavar="DEG", help="With --moving, δ in the last frame; 40 more.")
    ] = None,
    n_frames: Annotated[int, typer.Option("--frames", min=1, help="Number of frames.")] = 20,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Simulate a recording in the form that sensors write, with time stamps and the truth, to try match with.

    The file says that it is simulated. A direct sensor with a [histogram] table reports what its chip does, in each
    zone the nearest surface, and not a mean over the zone. It writes z in millimetres and status codes (5: valid),
    another sensor ranges in metres with amplitudes. The truth of each frame stands in columns truth_..., which other
    commands ignore.
    """
    from phasemark.data.measured.simulated import recording_format, simulate_recording, write_recording

    refuse_unless_one(class_name, mesh_file, mesh_reading, "record")
    for option, value in (("--to-distance", to_distance), ("--to-delta", to_delta)):
        if value is not None and not moving:
            raise UsageError(f"{option} goes with --moving: a camera at rest keeps its view")
    recording_format(out)
    camera = read_sensor(sensor)
    _refuse_many_frames(n_frames, camera)
    refuse_unwritable_files([out], force)
    name, mesh = read_class_or_mesh(class_name, mesh_file, mesh_reading)
    last = (
        (0.8 * distance if to_distance is None else to_distance, delta + 40.0 if to_delta is None else to_delta)
        if moving
        else (distance, delta)
    )
    views = _views_between((distance, delta), last, n_frames, bearing, height, pitch, roll)
    recording = simulate_recording(
        mesh,
        readable(name),
        camera,
        views,
        seed=seed,
        albedo=mesh.metadata.get("albedo", 0.8),
        background=background_of(wall, floor),
    )
    described = readable(f"landmark={name} sensor={Path(sensor).name}")
    description = f"{described} seed={seed} {'moving' if moving else 'still'}"
    typer.echo(write_recording(recording, out, description=description, force=force))


def _views_between(
    first: tuple[float, float],
    last: tuple[float, float],
    n: int,
    bearing_deg: float,
    height_m: float,
    pitch_deg: float,
    roll_deg: float,
) -> Views:
    """Return views whose distance (m) and δ (degrees) change evenly from the first to the last."""
    import numpy as np

    from phasemark.render import Views

    way = np.linspace(0.0, 1.0, n)
    distance_m, delta_deg = (start + way * (end - start) for start, end in zip(first, last, strict=True))
    bearing, pitch, roll = (math.radians(angle) for angle in (bearing_deg, pitch_deg, roll_deg))
    return Views.broadcast(distance_m, np.radians(delta_deg), bearing, height_m, pitch, roll)


def _refuse_many_frames(n_frames: int, camera: Sensor) -> None:
    """Refuse a recording that is too large to be made in memory."""
    if n_frames * camera.rows * camera.cols > _RECORDED_PIXELS:
        most = _RECORDED_PIXELS // (camera.rows * camera.cols)
        raise UsageError(
            f"--frames must be at most {most} for {camera.rows} × {camera.cols} pixels: a recording is"
            " made in memory; phasemark frames build makes large sets"
        )


def frames_show(
    *,
    frames: Annotated[
        Path, typer.Argument(metavar="FRAMES", help="A frame set, measured frames, or a log of histograms.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="The figure, .png.")],
    index: Annotated[int, typer.Option("--index", min=0, help="Number of the frame.")] = 0,
    sensor: SensorName = "pmd-16x16",
    reading: Annotated[FrameReading, Without("invalid_means", "flip_h", "flip_v", "rotate")],
    force: Force = False,
) -> None:
    """Draw one frame."""
    import io as bytes_io

    from phasemark.data.files.atomic_write import write_atomically
    from phasemark.data.frames.frame_set_file import is_frame_set
    from phasemark.data.measured.histogram_logs import is_histogram_log, read_histograms

    if out.suffix.lower() != ".png":
        raise UsageError(f"the figure must be a .png file, got '{out}'")
    refuse_existing([out], force)
    if is_frame_set(frames):
        with open_frame_set(frames) as opened:
            _refuse_index(index, len(opened))
            if opened.plan.histograms:
                figure = opened.histograms([index]).plot()
            else:
                figure = opened.frames([index]).plot(coverage=opened[index]["coverage"])
            figure.suptitle(_title(index, opened[index]))
    elif is_histogram_log(frames):
        log = read_histograms(frames, sensor=read_sensor(sensor)).frames
        _refuse_index(index, len(log))
        figure = log.plot(index)
    else:
        measured = reading.read(frames, read_sensor(sensor))
        _refuse_index(index, len(measured) * measured.n_frames)
        figure = measured.plot(*divmod(index, measured.n_frames))
    buffer = bytes_io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    typer.echo(write_atomically(out, buffer.getvalue(), force=force))


def _title(index: int, sample: Mapping[str, Any]) -> str:
    """Return class and view of a frame of a set."""
    from phasemark.render import Views
    from phasemark.render.figures import view_in_words
    from phasemark.render.view import VIEW_FIELDS

    views = Views.broadcast(*(sample[name] for name in VIEW_FIELDS))
    return f"frame {index}: {sample['class_name']}, {view_in_words(views, 0)}"


def _refuse_index(index: int, n: int) -> None:
    if index >= n:
        raise UsageError(f"--index must be below {n}, the number of frames, got {index}")
