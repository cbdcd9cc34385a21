"""Commands of ``phasemark frames``: frame sets, recordings and measured frames."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from phasemark import UsageError
from phasemark.data.commands.build import build_or_estimate, merge_shards
from phasemark.data.commands.command import Shown, Without
from phasemark.data.commands.console import LongWork, echo, echo_facts, readable
from phasemark.data.commands.inputs import ClassOrMesh, background_of, open_frame_set, read_sensor
from phasemark.data.commands.options import (
    BouncesOfLight,
    Building,
    Count,
    Degrees,
    Floor,
    Force,
    FrameReading,
    Index,
    Json,
    Metres,
    Out,
    QuantityWord,
    Resume,
    Sample,
    Seed,
    SensorName,
    Shards,
    View,
    Wall,
)
from phasemark.data.commands.outputs import (
    refuse_existing,
    refuse_input_files,
    refuse_other_files,
    refuse_unwritable_files,
    write_figure,
)

if TYPE_CHECKING:
    from phasemark.data.plans import SceneFramesPlan

ExportFormat = Literal["npz", "csv", "jsonl", "png16", "ply", "bop", "rosbag", "webdataset", "lerobot"]
Generator = Annotated[str | None, Shown(metavar="MODULE:NAME", help="The program that makes the scenes.")]


def frames_build(
    plan_file: Path,
    *,
    out: Out,
    seed: Seed | None = None,
    views: Count | None = None,
    generator: Generator = None,
    trust_plan: bool = False,
    building: Building,
) -> None:
    """Build a set of noisy frames with their truth, of landmarks or of scenes.

    Parameters
    ----------
    plan_file
        A plan (.toml) of kind frames or scenes; options override it.
    out
        The frame set to write; its checksum goes beside it.
    views
        Number of views, or of scenes that a generator makes.
    trust_plan
        Run the generator of scenes that the plan itself names.
    """
    from phasemark.data import build_frames
    from phasemark.data.plans.scene_frames_plan import SceneFramesPlan, read_frames_plan

    plan = read_frames_plan(plan_file)
    plan = plan if seed is None else plan.model_copy(update={"seed": seed})
    if isinstance(plan, SceneFramesPlan):
        plan = plan if views is None else plan.with_scenes(views)
        _allow_generator(plan, generator, trust_plan, plan_file)
    elif generator is not None:
        raise UsageError(f"--generator goes with a plan of scenes, and {plan_file} has no table [scenes]")
    else:
        plan = plan if views is None else plan.model_copy(update={"views": views})
    build_or_estimate(build_frames, plan, out, building)


def _allow_generator(plan: SceneFramesPlan, generator: str | None, trust_plan: bool, plan_file: Path) -> None:
    """Let the generator of a plan be imported, from this folder too, if it is the one that was named."""
    from phasemark.data.plans.scene_frames_plan import refuse_generator

    if not trust_plan:
        refuse_generator(plan, () if generator is None else (generator,), str(plan_file))
    sys.path.append(str(Path.cwd()))  # where one's own generator lies; an installed program does not look here itself


def frames_info(frames: Path, *, as_json: Json = False) -> None:
    """Print the content of a frame set.

    Parameters
    ----------
    frames
        A frame set.
    """
    with open_frame_set(frames) as opened:
        echo_facts(opened.info(), as_json=as_json)


def frames_verify(
    frames: Path, *, sample: Sample = 16, seed: Seed = 0, generator: Generator = None, as_json: Json = False
) -> None:
    """Check a frame set: checksum, schema, values, and random views rendered and captured again.

    Scenes are made again if you name the program that made them.

    Parameters
    ----------
    frames
        A frame set, its checksum beside it.
    """
    from phasemark.data.verify import verify_frames

    if generator is not None:
        sys.path.append(str(Path.cwd()))
    with LongWork("verifying"):
        report = verify_frames(frames, sample=sample, seed=seed, generator=generator)
    echo_facts(report, as_json=as_json)


def frames_merge(shards: Shards, *, out: Out, resume: Resume = False, force: Force = False) -> None:
    """Put the parts of a frame set together; the bytes are those of a single run.

    Parameters
    ----------
    out
        The frame set to write.
    """
    merge_shards(shards, out, resume, force)


def frames_export(
    frames: Path,
    *,
    to: Annotated[ExportFormat, Shown(metavar="FORMAT")],
    out: Out,
    quantity: QuantityWord | None = None,
    content: Literal["range", "targets", "histogram"] | None = None,
    force: Force = False,
) -> None:
    """Write a frame set for other programs.

    Parameters
    ----------
    frames
        A frame set.
    to
        npz, csv, jsonl, png16, ply, bop, rosbag, webdataset or lerobot.
    out
        The file (npz, csv, jsonl) or folder to write.
    quantity
        range or z, in npz, csv and png16; BOP and ROS have z.
    content
        Of histograms: range (of the nearest target), targets (npz, csv) or histogram (npz, jsonl).
    """
    refuse_input_files([out])
    with open_frame_set(frames) as opened:
        from phasemark.data.export import export_frames

        echo(export_frames(opened, out, to, quantity=quantity, content=content, force=force))


def frames_import(
    file: Path,
    *,
    out: Out,
    sensor: SensorName = "pmd-16x16",
    reading: Annotated[FrameReading, Without("invalid_means")],
    force: Force = False,
) -> None:
    """Convert measured frames to one form: range along the ray, in metres, upright.

    Parameters
    ----------
    file
        CSV, NPY, NPZ, HDF5, PNG; a folder of PNG, a bag.
    out
        The measured frames as .npz, range along the ray, metres.
    """
    from phasemark.data.measured.reading import write_measured

    refuse_other_files(out, ".npz", "the output")
    refuse_existing([out], force)
    echo(write_measured(reading.read(file, read_sensor(sensor)), out, force=force))


def frames_simulate(
    *,
    out: Out,
    landmark: ClassOrMesh,
    sensor: SensorName = "pmd-16x16",
    view: View,
    wall: Wall = None,
    floor: Floor = None,
    bounces: BouncesOfLight = "0",
    moving: Annotated[bool, Shown("--moving/--still")] = False,
    to_distance: Metres | None = None,
    to_delta: Degrees | None = None,
    n_frames: Annotated[Count, Shown("--frames")] = 20,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Simulate a recording in the form that sensors write, with time stamps and the truth, to try match with.

    The file states that it is simulated. Of a direct sensor it has z in millimetres and status codes (5: valid), with a
    [histogram] table the nearest surface of each zone as the chip reports it; of another sensor ranges in metres and
    amplitudes. Columns truth_... have the truth of each frame; other commands ignore them.

    Parameters
    ----------
    out
        The recording to write: .csv, .npz or .h5.
    distance
        Distance D to the landmark's axis, in the first frame.
    delta
        Side δ from which the landmark is seen in the first frame.
    moving
        Change D and δ evenly until the last frame.
    to_distance
        With --moving, D in the last frame; 0.8 of the first.
    to_delta
        With --moving, δ in the last frame; 40 more.
    n_frames
        Number of frames.
    """
    import numpy as np

    from phasemark.data.measured.simulated import recording_format, simulate_recording, write_recording

    landmark.check("record")
    for option, value in (("--to-distance", to_distance), ("--to-delta", to_delta)):
        if value is not None and not moving:
            raise UsageError(f"{option} goes with --moving: a camera at rest keeps its view")
    recording_format(out)
    camera = read_sensor(sensor)
    # most pixels of a simulated recording, all frames together: some hundred bytes of memory each
    pixels, recorded_pixels = camera.rows * camera.cols, 5_000_000
    if n_frames * pixels > recorded_pixels:
        raise UsageError(
            f"--frames must be at most {recorded_pixels // pixels} for {camera.rows} × {camera.cols} pixels: a"
            " recording is made in memory; phasemark frames build makes large sets"
        )
    refuse_unwritable_files([out], force)
    name, mesh = landmark.read()
    distance_m = 0.8 * view.distance if to_distance is None else to_distance
    delta_deg = view.delta + 40.0 if to_delta is None else to_delta
    way = np.linspace(0.0, 1.0, n_frames) * moving
    views = view.views(view.distance + way * (distance_m - view.distance), view.delta + way * (delta_deg - view.delta))
    albedo, background = mesh.metadata.get("albedo", 0.8), background_of(wall, floor, bounces)
    recording = simulate_recording(mesh, readable(name), camera, views, seed=seed, albedo=albedo, background=background)
    described = readable(f"landmark={name} sensor={Path(sensor).name}")
    description = f"{described} seed={seed} {'moving' if moving else 'still'}"
    echo(write_recording(recording, out, description=description, force=force))


def frames_show(
    frames: Path,
    *,
    out: Out,
    index: Index = 0,
    sensor: SensorName = "pmd-16x16",
    reading: Annotated[FrameReading, Without("invalid_means", "flip_h", "flip_v", "rotate")],
    force: Force = False,
) -> None:
    """Draw one frame.

    Parameters
    ----------
    frames
        A frame set, measured frames, or a log of histograms.
    out
        The figure, .png.
    index
        Number of the frame.
    """
    from phasemark.data.frames.frame_set_file import is_frame_set
    from phasemark.data.measured.histogram_logs import is_histogram_log, read_histograms

    refuse_other_files(out, ".png")
    refuse_existing([out], force)
    if is_frame_set(frames):
        with open_frame_set(frames) as opened:
            _refuse_index(index, len(opened))
            if opened.holds_histograms:
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
    echo(write_figure(out, figure, force))


def _title(index: int, sample: Mapping[str, Any]) -> str:
    """Return class and view, or scene and labels, of a frame of a set."""
    from phasemark.render import Views
    from phasemark.render.figures import view_in_words
    from phasemark.render.view import VIEW_FIELDS

    if "sequence" in sample:
        labels = [f"{key[6:]} {value}" for key, value in sample.items() if key.startswith("label_")]
        return ", ".join([f"frame {index}: scene {sample['sequence']}, step {sample['step']}", *labels])
    views = Views.broadcast(*(sample[name] for name in VIEW_FIELDS))
    return f"frame {index}: {sample['class_name']}, {view_in_words(views, 0)}"


def _refuse_index(index: int, n: int) -> None:
    if index >= n:
        raise UsageError(f"--index must be below {n}, the number of frames, got {index}")
