"""The command line: arguments to a plan, one library call, a path or a table printed.

Results go to stdout, messages and progress to stderr. Heavy imports stand inside the commands, so that
``phasemark --help`` answers at once. :func:`main` turns every error the user can mend into one line and its exit code.
"""

from __future__ import annotations

import io
import json
import math
import os
import shlex
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from typer.core import TyperCommand

from phasemark import InputFileError, OutputExistsError, PhasemarkError, StorageError, UsageError, __version__

if TYPE_CHECKING:
    from types import FrameType

    from pydantic import BaseModel
    from rich.progress import Progress
    from trimesh import Trimesh

    from phasemark.data import Bank, BankPlan, FramePlan, MeshPlan
    from phasemark.data.plans.bank_plan import ScenePlan
    from phasemark.landmarks import LandmarkSpec
    from phasemark.matcher import (
        Calibration,
        Change,
        Diagnosis,
        FilteredFrames,
        LandmarkMap,
        Match,
        RobotPose,
    )
    from phasemark.matcher.drive import DrivePlan
    from phasemark.render import Background, Estimate, Frames, Sensor

__all__ = ["app", "main"]

_ORIGIN_HELP = "What becomes the origin: file (its own), base (centre of its foot) or center (of its bounding box)."

_DRAWN_ALL = 4
"""Most positions that are drawn unless the user says which; a picture takes two seconds."""
_RECORDED_PIXELS = 5_000_000
"""Most pixels of a simulated recording, all frames together: some hundred bytes of memory each."""
_NEAREST_AT_ONCE, _REFINED_AT_ONCE = 256, 64
"""Positions matched before their answers are printed; refinement takes up to 50 ms each."""

_NO_VERIFY = "--no-verify"
_COMPLETION = "_PHASEMARK_COMPLETE"
"""Set by the script that ``--install-completion`` gives to a shell."""

_FIRST_STEPS = """\
phasemark renders, banks and matches what a low-resolution time-of-flight camera sees of a 3D landmark.

First:
  phasemark demo                                     the paper's experiment, with a report, in about a minute

Then, by task:
  choose a landmark      phasemark landmark list     or design one: phasemark landmark design
  choose a camera        phasemark sensor list       or fit your own: phasemark sensor fit
  see what it sees       phasemark render --class cylinder --distance 1.0 --delta 30 --wall 4 -o frame.png
  build a bank           phasemark bank build -o bank.h5
  match your frames      phasemark match bank.h5 measured.csv --unit m --quantity range
  try it without camera  phasemark frames simulate --class cylinder --distance 1.0 -o recording.csv
  know the mounting      phasemark calibrate cylinder frames.npz --poses poses.csv -o mounted.toml
  make labelled frames   phasemark plan example frames > frames.toml; phasemark frames build frames.toml -o frames.h5
  know the accuracy      phasemark sweep run paper -o out/paper
  drive a robot          phasemark drive

phasemark --help lists all commands, COMMAND --help explains one, --install-completion teaches them to your shell.
"""


def _one_of(*words: str) -> Callable[[str], list[str]]:
    """Return what completes an argument to one of some words; a shell goes on with files where none fits."""
    return lambda incomplete: [word for word in words if word.startswith(incomplete)]


def _a_class(incomplete: str) -> list[str]:
    from phasemark.landmarks.catalog import catalog

    return _one_of(*catalog())(incomplete)


def _a_preset(incomplete: str) -> list[str]:
    from phasemark.render import preset_names

    return _one_of(*preset_names())(incomplete)


_a_plan_kind = _one_of("bank", "frames", "sweep", "drive", "design")

_Function = TypeVar("_Function", bound=Callable[..., Any])

_OUTPUTS = ("out", "plot", "estimates")
"""Parameters of commands that name what is written; all other files that a command is given are read."""

_inputs: ContextVar[tuple[Path, ...]] = ContextVar("inputs", default=())
"""The files that the running command was given to read."""


class _Command(TyperCommand):
    """A command that notes which files it was given to read, so that none of them becomes its output."""

    def invoke(self, ctx: Any) -> Any:
        from phasemark.data.files.same_file import named_files

        given = {name: value for name, value in ctx.params.items() if name not in _OUTPUTS}
        _inputs.set(tuple(named_files(given)))
        return super().invoke(ctx)


class _Commands(typer.Typer):
    """Commands that note which files they read."""

    def command(self, name: str | None = None, **options: Any) -> Callable[[_Function], _Function]:
        return super().command(name, cls=_Command, **options)


app = _Commands(
    name="phasemark",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_landmark_app = _Commands(help="The landmarks: the catalogue and mesh files.")
_sensor_app = _Commands(help="The cameras: shipped presets and sensor files.")
_bank_app = _Commands(help="Banks of model images.")
_frames_app = _Commands(help="Sets of noisy frames with their truth.")
_plan_app = _Commands(help="Plans: what banks and frame sets are built from, and sweeps and drives run from.")
app.add_typer(_landmark_app, name="landmark")
app.add_typer(_sensor_app, name="sensor")
app.add_typer(_bank_app, name="bank")
_sweep_app = _Commands(help="Accuracy sweeps: how accurate, where, and says who.")
app.add_typer(_sweep_app, name="sweep")
app.add_typer(_frames_app, name="frames")
app.add_typer(_plan_app, name="plan")

_Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
_Force = Annotated[bool, typer.Option("--force", help="Replace an output that exists.")]
_Unit = Annotated[
    str | None,
    typer.Option(
        "--unit", help="Unit of the mesh file: m, cm, mm or inch.", autocompletion=_one_of("m", "cm", "mm", "inch")
    ),
]
_Up = Annotated[
    str,
    typer.Option(
        "--up",
        help="Axis of the mesh file that points up: x, y, z, -x, -y or -z.",
        autocompletion=_one_of("x", "y", "z", "-x", "-y", "-z"),
    ),
]
_Origin = Annotated[str, typer.Option("--origin", help=_ORIGIN_HELP, autocompletion=_one_of("file", "base", "center"))]
_SensorOption = Annotated[
    str,
    typer.Option("--sensor", metavar="NAME|FILE", help="A preset, or a sensor file (.toml).", autocompletion=_a_preset),
]
_Wall = Annotated[float | None, typer.Option("--wall", metavar="M", help="Distance of a wall behind the landmark.")]
_Floor = Annotated[float | None, typer.Option("--floor", metavar="M", help="How far a floor lies below the lens.")]
_FramesUnit = Annotated[
    str | None,
    typer.Option(
        "--unit",
        help="Unit of measured frames: m, cm or mm; if the file does not say.",
        autocompletion=_one_of("m", "cm", "mm"),
    ),
]
_Quantity = Annotated[
    str | None,
    typer.Option(
        "--quantity",
        help="range (along the ray) or z (along the optical axis); likewise.",
        autocompletion=_one_of("range", "z"),
    ),
]
_InvalidMeans = Annotated[
    str,
    typer.Option(
        "--invalid-means",
        help="What an invalid pixel stands for: missing or no-return.",
        autocompletion=_one_of("missing", "no-return"),
    ),
]
_ValidStatus = Annotated[
    list[int] | None, typer.Option("--valid-status", help="Value of 'status' that marks a valid pixel; repeatable.")
]
_FlipH = Annotated[bool, typer.Option("--flip-h", help="Mirror left and right.")]
_FlipV = Annotated[bool, typer.Option("--flip-v", help="Mirror top and bottom.")]
_Rotate = Annotated[
    int,
    typer.Option(
        "--rotate",
        help="Turn the image clockwise by 0, 90, 180 or 270 degrees.",
        autocompletion=_one_of("0", "90", "180", "270"),
    ),
]
_Resume = Annotated[bool, typer.Option("--resume", help="Continue an unfinished run of the same plan.")]
_DryRun = Annotated[bool, typer.Option("--dry-run", help="Say how large it would be and how long it would take.")]
_Scheduler = Annotated[
    str, typer.Option("--scheduler", metavar="WHERE", help="threads, local:N processes, or a Dask scheduler's address.")
]
_Shard = Annotated[str | None, typer.Option("--shard", metavar="I/N", help="Build only part I of N, to be merged.")]
_ShardItems = Annotated[
    int | None, typer.Option("--shard-size", min=1, help="Images or views per shard; the result does not depend on it.")
]
_MaxSize = Annotated[
    str, typer.Option("--max-size", metavar="SIZE", help="Refuse to write a larger file, e.g. 500MB or 20GB.")
]
_Sample = Annotated[int, typer.Option("--sample", min=0, help="How many random items to render again.")]
_Seed = Annotated[int, typer.Option("--seed", min=0, max=2**64 - 1, help="Root of all random numbers.")]
_Workers = Annotated[int | None, typer.Option("--workers", min=1, help="Threads; the result does not depend on it.")]


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"phasemark {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _start(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    no_verify: Annotated[
        bool,
        typer.Option(
            _NO_VERIFY,
            help="Read files without comparing them with their FILE.sha256; may stand behind any command, too.",
        ),
    ] = False,
) -> None:
    """Render, bank and match what a low-resolution time-of-flight camera sees of a 3D landmark."""
    if no_verify:
        from phasemark.inputs import unverified

        context.with_resource(unverified())
    if context.invoked_subcommand is None:
        typer.echo(_FIRST_STEPS, nl=False)


@_sensor_app.command("list")
def _sensor_list(as_json: _Json = False) -> None:
    """List the shipped presets."""
    from phasemark.render import preset, preset_names

    sensors = {name: preset(name) for name in preset_names()}
    if as_json:
        _echo_json([{"name": name, **_sensor_facts(sensor)} for name, sensor in sensors.items()])
        return
    _echo_table(
        ("preset", "pixels", "field of view", "modulation", "unambiguous range"),
        (
            (
                name,
                f"{sensor.rows} × {sensor.cols}",
                f"{2 * sensor.half_angle_v_deg:g}° × {2 * sensor.half_angle_h_deg:g}°",
                "direct" if sensor.kind == "direct" else f"{sensor.modulation_hz / 1e6:g} MHz",
                "" if sensor.kind == "direct" else f"{sensor.unambiguous_range_m:.3f} m",
            )
            for name, sensor in sensors.items()
        ),
    )


@_sensor_app.command("show")
def _sensor_show(
    name_or_file: Annotated[
        str, typer.Argument(metavar="NAME|FILE", help="A preset, or a sensor file (.toml).", autocompletion=_a_preset)
    ],
    as_json: _Json = False,
) -> None:
    """Print every field of a sensor; the text is a sensor file again."""
    sensor = _load_sensor(name_or_file)
    if as_json:
        _echo_json({"name": name_or_file, **_sensor_facts(sensor)})
        return
    if sensor.kind == "direct":
        typer.echo("# direct time of flight: no taps, no phasors; its own quantity is z, along the optical axis")
    else:
        typer.echo(
            f"# unambiguous range {sensor.unambiguous_range_m:.4f} m, {sensor.metres_per_radian:.6f} m per radian"
        )
    fields = sensor.model_dump(mode="json")
    for title, names in sensor.field_groups().items():
        typer.echo(f"\n# {title}")
        for name in names:
            value = fields[name]
            typer.echo(f"# {name} is not set" if value is None else f"{name} = {json.dumps(value)}")


@_sensor_app.command("characterise")
def _sensor_characterise(
    name_or_file: Annotated[
        str, typer.Argument(metavar="NAME|FILE", help="A preset, or a sensor file (.toml).", autocompletion=_a_preset)
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the report, its pictures and numbers.")],
    n_frames: Annotated[
        int | None, typer.Option("--frames", min=2, help="Frames at each point; by default 51200 readings a point.")
    ] = None,
    seed: _Seed = 2005,
    as_json: _Json = False,
    force: _Force = False,
) -> None:
    """Measure a sensor before flat fields, as EMVA 1288 would, and compare it with what its numbers predict."""
    from phasemark.data import summary_sentences, write_characterisation
    from phasemark.data.pages.characterisation import NAMES
    from phasemark.data.seeds import stream
    from phasemark.render import characterise

    sensor = _load_sensor(name_or_file)
    with _output_folder(out, "sensor characterise", NAMES, force), _Progress("measuring"):
        found = characterise(sensor, rng=stream(seed, "characterise", 0), n_frames=n_frames)
        report = write_characterisation(found, _readable(name_or_file), out, seed=seed, force=force)[0]
    if as_json:
        facts = found.as_dict()
        _echo_json({"report": str(report), "agreement": facts["agreement"], "quantities": facts["quantities"]})
        return
    for sentence in (*summary_sentences(found, name_or_file), *found.notes):
        typer.echo(sentence)
    typer.echo(report)


@_sensor_app.command("fit")
def _sensor_fit(
    frames: Annotated[
        list[Path], typer.Argument(metavar="FRAMES...", help="Frames of a flat board: CSV, NPY, NPZ or HDF5.")
    ],
    distance: Annotated[
        list[float],
        typer.Option("--distance", metavar="M", help="Distance of the board; once for each FRAMES, in order."),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="The sensor file to write, .toml.")],
    albedo: Annotated[
        list[float] | None,
        typer.Option("--albedo", help="Albedo of the board, one for all or one for each; 0.8 is assumed."),
    ] = None,
    distance_std: Annotated[
        list[float] | None,
        typer.Option(
            "--distance-std",
            metavar="M",
            help="Standard deviation of the distances, one for all or one for each; 0.001 is assumed.",
        ),
    ] = None,
    sensor: _SensorOption = "pmd-16x16",
    amplitude_unit: Annotated[
        str,
        typer.Option(
            "--amplitude-unit",
            help="Unit of amplitude and intensity: electrons or arbitrary.",
            autocompletion=_one_of("electrons", "arbitrary"),
        ),
    ] = "electrons",
    unit: _FramesUnit = None,
    quantity: _Quantity = None,
    valid_status: _ValidStatus = None,
    flip_h: _FlipH = False,
    flip_v: _FlipV = False,
    rotate: _Rotate = 0,
    as_json: _Json = False,
    force: _Force = False,
) -> None:
    """Fit a sensor to measured frames of a flat board that fills the image, square to the camera.

    Give the board's distance for each file, in order: FRAMES FRAMES --distance 1.0 --distance 2.0. Geometry and
    whatever the frames do not tell come from --sensor; the file says of each number whether it is measured or assumed.
    """
    from phasemark.data import read_frames, write_atomically
    from phasemark.render import fit_sensor

    if out.suffix.lower() != ".toml":
        raise UsageError(f"the sensor must be a .toml file, got '{out}'")
    _refuse_existing([out], force)
    base = _load_sensor(sensor)
    measured = [
        read_frames(
            path,
            sensor=base,
            unit=unit,  # type: ignore[arg-type]  # read_frames says what is right
            quantity=quantity,  # type: ignore[arg-type]
            valid_status=valid_status,
            flip_h=flip_h,
            flip_v=flip_v,
            rotate=rotate,
            untrusted=True,
        )
        for path in frames
    ]
    _note_too_far(base, {"--distance": max(distance)})
    fit = fit_sensor(
        [one[k : k + 1] for one in measured for k in range(len(one))],  # every position of a file has its distance
        distance,
        base=base,
        albedo=albedo or None,
        amplitude_unit=amplitude_unit,  # type: ignore[arg-type]  # fit_sensor says what is right
        distance_std_m=distance_std or None,
    )
    write_atomically(out, fit.to_toml(base_name=_readable(sensor)).encode(), force=force)
    if as_json:
        _echo_json({"file": str(out), **fit.as_dict()})
        return
    fields = fit.sensor.model_dump(mode="json")
    _echo_table(
        ("field", "value", "std error", "from"),
        ((name, *_value_and_error_of(fields[name], one), one.note) for name, one in fit.estimates.items()),
    )
    for note in fit.notes:
        typer.echo(note)
    typer.echo(out)


@_landmark_app.command("list")
def _landmark_list(as_json: _Json = False) -> None:
    """List the landmarks of the catalogue."""
    from phasemark.landmarks import catalog

    specs = catalog()
    if as_json:
        _echo_json([spec.model_dump(mode="json") for spec in specs.values()])
        return
    _echo_table(
        ("class", "box (m)", "upper part", "albedo", "repeats every"),
        (
            (
                name,
                f"{spec.box.length_m:g} × {spec.box.width_m:g} × {spec.box.height_m:g}",
                _describe_upper(spec),
                f"{spec.albedo:g}",
                f"{360 / spec.symmetry:g}°",
            )
            for name, spec in specs.items()
        ),
    )


@_landmark_app.command("show")
def _landmark_show(
    name_or_file: Annotated[
        str,
        typer.Argument(metavar="NAME|FILE", help="A class, or an STL, PLY, OBJ or OFF file.", autocompletion=_a_class),
    ],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for NAME.png and NAME.html.")] = None,
    unit: _Unit = None,
    up: _Up = "z",
    origin: _Origin = "file",
    force: _Force = False,
) -> None:
    """Draw a landmark: a shaded picture, and a page to turn it in 3D."""
    from phasemark.data import write_atomically
    from phasemark.landmarks import mesh_html, mesh_picture

    name, mesh = _load_landmark(name_or_file, unit, up, origin)
    folder = out or Path()
    picture, page = folder / f"{name}.png", folder / f"{name}.html"
    _refuse_existing([picture, page], force)
    _make_folder(folder)
    write_atomically(picture, mesh_picture(mesh), force=force)
    write_atomically(page, mesh_html(mesh, _readable(name)).encode(), force=force)
    typer.echo(picture)
    typer.echo(page)


@_landmark_app.command("export")
def _landmark_export(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A class of the catalogue.", autocompletion=_a_class)],
    out: Annotated[Path, typer.Option("-o", "--out", help="The file; .stl, .ply, .obj or .off.")],
    force: _Force = False,
) -> None:
    """Write a landmark of the catalogue as a mesh, in metres."""
    from phasemark.data import write_atomically
    from phasemark.landmarks import export_mesh

    _refuse_inputs([out])
    _, mesh = _load_landmark(name, None, "z", "file", from_catalog=True)
    typer.echo(write_atomically(out, export_mesh(mesh, out.suffix.removeprefix(".")), force=force))


@_landmark_app.command("design")
def _landmark_design(
    plan_file: Annotated[
        Path | None,
        typer.Argument(metavar="[PLAN]", help="A plan (.toml); without it four landmarks for the PMD camera."),
    ] = None,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder for landmarks, tables, pictures and drawings.")
    ] = Path("out/design"),
    confirm_frames: Annotated[
        int,
        typer.Option("--confirm", metavar="N", min=0, help="Simulated frame sets to match from every side; 0: none."),
    ] = 100,
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, max=2**64 - 1, help="Replaces the plan's root of all random numbers.")
    ] = None,
    example: Annotated[bool, typer.Option("--example", help="Print the default plan, and do nothing else.")] = False,
    workers: _Workers = None,
    as_json: _Json = False,
    force: _Force = False,
) -> None:
    """Design a set of landmarks for a camera and a working range, and confirm what it gains by simulated frames."""
    from phasemark.matcher.design import (
        confirm_design,
        default_design,
        example_design,
        load_design_plan,
        output_names,
        run_design,
        summary,
        write_design,
    )

    if example:
        typer.echo(example_design(), nl=False)
        return
    plan = default_design() if plan_file is None else load_design_plan(plan_file)
    if seed is not None:
        plan = plan.model_copy(update={"seed": seed})
    with _output_folder(out, "landmark design", output_names(plan), force, plan):
        with _Progress("searching") as progress:
            design = run_design(plan, workers=workers, progress=progress)
        confirmed = None
        if confirm_frames:
            with _Progress("matching simulated frames") as progress:
                confirmed = confirm_design(design, confirm_frames, workers=workers, progress=progress)
        with _Progress("writing the design"):
            files = write_design(design, confirmed, out, force=force)
    facts = summary(design, confirmed)
    if as_json:
        _echo_json({"files": [str(path) for path in files], **facts})
        return
    _echo_design(facts)
    for path in files:
        typer.echo(path)


def _echo_design(facts: Mapping[str, Any]) -> None:
    """Print a design beside the catalogue."""
    from phasemark.render.integral.rounding import with_interval

    def within(interval: Mapping[str, float | None], scale: float) -> str:
        value, low, high = (
            math.nan if number is None else scale * number for number in map(interval.get, ("value", "low", "high"))
        )
        return with_interval(value, low, high) if math.isfinite(value) else "nothing found"

    sets = [facts["result"], facts["catalogue"]]
    rows = [
        ("box (mm)", *(" × ".join(f"{1000 * side:g}" for side in one["landmarks"][0]["box"].values()) for one in sets)),
        ("looks the same every", *(f"{360 / one['symmetry']:g}°" for one in sets)),
        ("worst position bound (mm)", *(f"{1000 * one['worst_position_bound_m']:.1f}" for one in sets)),
        ("median position bound (mm)", *(f"{1000 * one['median_position_bound_m']:.1f}" for one in sets)),
        ("least d between classes", *(_number(one["least_class_distance"]) for one in sets)),
        ("least d from itself turned", *(_number(one["turn_distance"]) for one in sets)),
    ]
    confirmation = facts["confirmation"]
    if confirmation:
        tried = [confirmation["result"], confirmation["catalogue"]]
        for title, key in (("worst side", "worst"), ("anywhere", "anywhere")):
            found = (f"{within(one[key]['rmse_m'], 1000)}, N = {one[key]['n']}" for one in tried)
            rows.append((f"r.m.s. error, {title} (mm)", *found))
        rows.append(("r.m.s. error / bound, all sides", *(within(one["rmse_over_bound"], 1) for one in tried)))
        rows.append(("class errors, all sides (%)", *(within(one["class_errors"], 100) for one in tried)))
    _echo_table(("", "new set", "catalogue"), rows)
    typer.echo(f"worst position bound {facts['bound_factor']:.2f} times lower than the catalogue's")
    if confirmation:
        typer.echo(f"worst r.m.s. error {within(confirmation['worst_rmse_factor'], 1)} times lower, 95 % interval")


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.1f}"


@_landmark_app.command("check")
def _landmark_check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="An STL, PLY, OBJ or OFF file.")],
    unit: _Unit = None,
    up: _Up = "z",
    origin: _Origin = "file",
    as_json: _Json = False,
) -> None:
    """Check a mesh file and say what it holds."""
    import dataclasses

    from phasemark.landmarks import MAX_SYMMETRY, check_mesh

    _, mesh = _load_landmark(str(file), unit, up, origin)
    report = dataclasses.asdict(check_mesh(mesh))
    if as_json:
        _echo_json({"file": str(file), **report})
        return
    del report["warnings"]  # reading the file has put them on stderr
    n = report["symmetry"]
    report["symmetry"] = {1: "1 (none)", MAX_SYMMETRY: f"{n} (a body of revolution)"}.get(
        n, f"{n} (looks the same every {360 / n:g}° about z')"
    )
    _echo_facts({"file": file, **report})


@app.command("render")
def _render(
    out: Annotated[Path, typer.Option("-o", "--out", help="The picture, .png; the data go beside it as .npz.")],
    distance: Annotated[
        float, typer.Option("--distance", metavar="M", help="Distance D to the landmark's axis.")
    ] = 1.0,
    delta: Annotated[float, typer.Option("--delta", metavar="DEG", help="Side δ from which it is seen.")] = 0.0,
    bearing: Annotated[float, typer.Option("--bearing", metavar="DEG", help="Its azimuth in the camera.")] = 0.0,
    height: Annotated[float, typer.Option("--height", metavar="M", help="Its height above the optical axis.")] = 0.0,
    class_name: Annotated[
        str | None, typer.Option("--class", help="A class of the catalogue.", autocompletion=_a_class)
    ] = None,
    mesh_file: Annotated[str | None, typer.Option("--mesh", metavar="NAME=FILE", help="A mesh file.")] = None,
    unit: _Unit = None,
    up: _Up = "z",
    origin: _Origin = "file",
    sensor: _SensorOption = "pmd-16x16",
    wall: _Wall = None,
    floor: _Floor = None,
    variant: Annotated[
        str,
        typer.Option(
            "--variant",
            help="exact, or hard: what the centre ray of each pixel sees, nothing mixed.",
            autocompletion=_one_of("exact", "hard"),
        ),
    ] = "exact",
    force: _Force = False,
) -> None:
    """Render one noise-free frame: a picture, the phasors, and a sketch in the terminal."""
    import io as bytes_io

    import numpy as np

    from phasemark.data import write_atomically
    from phasemark.render import Renderer, terminal_picture

    if (class_name is None) == (mesh_file is None):
        raise UsageError("say what to render: either --class NAME or --mesh NAME=FILE")
    if out.suffix.lower() != ".png":
        raise UsageError(f"the picture must be a .png file, got '{out}'")
    if class_name is not None and unit is not None:
        raise UsageError("--unit belongs to --mesh: the catalogue is in metres")
    data = out.with_suffix(".npz")
    _refuse_existing([out, data], force)
    if class_name is not None:
        _, mesh = _load_landmark(class_name, None, "z", "file", from_catalog=True)
    else:
        assert mesh_file is not None
        _, path = _name_and_file(mesh_file)
        _, mesh = _load_landmark(path, unit, up, origin)
    if variant not in ("exact", "hard"):
        raise UsageError(f"--variant must be exact or hard, got '{variant}'")
    camera = _load_sensor(sensor)
    _note_too_far(camera, {"--distance": distance, "--wall": wall})
    image = Renderer(mesh, camera, albedo=mesh.metadata.get("albedo", 0.8)).render(
        distance,
        math.radians(delta),
        math.radians(bearing),
        height,
        background=_background(wall, floor),
        variant="hard" if variant == "hard" else "exact",
    )
    arrays = {
        "phasor": image.phasor[0],
        "intensity": image.intensity[0],
        "coverage": image.coverage[0],
        "range": image.range_m[0],
        "unit": "m",
        "quantity": "range",
    }
    buffer, picture = bytes_io.BytesIO(), bytes_io.BytesIO()
    np.savez(buffer, **arrays)
    image.plot().savefig(picture, format="png", dpi=120)
    write_atomically(data, buffer.getvalue(), force=force)
    write_atomically(out, picture.getvalue(), force=force)
    if sys.stdout.isatty():
        from rich.console import Console

        Console().print(terminal_picture(image.range_m[0], width=48))
    typer.echo(out)
    typer.echo(data)


@_bank_app.command("build")
def _bank_build(
    out: Annotated[Path, typer.Option("-o", "--out", help="The bank to write; its checksum goes beside it.")],
    plan_file: Annotated[
        Path | None, typer.Argument(metavar="[PLAN]", help="A plan (.toml); options override it.")
    ] = None,
    classes: Annotated[
        list[str] | None, typer.Option("--class", help="A class of the catalogue; repeatable.", autocompletion=_a_class)
    ] = None,
    meshes: Annotated[list[str] | None, typer.Option("--mesh", metavar="NAME=FILE", help="Repeatable.")] = None,
    unit: _Unit = None,
    up: _Up = "z",
    origin: _Origin = "file",
    symmetry: Annotated[
        int | None,
        typer.Option("--symmetry", help="Turns that leave the mesh as it is; found from the mesh if not given."),
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option("--sensor", metavar="NAME|FILE", help="A preset or sensor file.", autocompletion=_a_preset),
    ] = None,
    distance: Annotated[str | None, typer.Option("--distance", metavar="START:STOP:STEP", help="Metres.")] = None,
    delta: Annotated[str | None, typer.Option("--delta", metavar="START:STOP:STEP", help="Degrees.")] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            help="ray; hard: centre rays, nothing mixed; or planar: the paper's own generator.",
            autocompletion=_one_of("ray", "hard", "planar"),
        ),
    ] = None,
    albedo: Annotated[float | None, typer.Option("--albedo", help="Of the landmarks, in place of their own.")] = None,
    full: Annotated[
        bool, typer.Option("--full", help="Every class at every D and δ; taken where nothing less will do.")
    ] = False,
    workers: _Workers = None,
    resume: _Resume = False,
    dry_run: _DryRun = False,
    max_size: _MaxSize = "2GB",
    shard: _Shard = None,
    shard_size: _ShardItems = None,
    scheduler: _Scheduler = "threads",
    as_json: _Json = False,
    force: _Force = False,
) -> None:
    """Build a bank of noise-free model images."""
    from phasemark.data import BankPlan, MeshPlan, build_bank, load_plan
    from phasemark.data.plans.bank_plan import factored_refusal
    from phasemark.landmarks import catalog

    if plan_file is not None and str(plan_file) in catalog():
        raise UsageError(f"'{plan_file}' is a class of the catalogue, not a plan: give --class {plan_file}")
    plan = BankPlan() if plan_file is None else load_plan(plan_file)
    layout_stated = "layout" in plan.model_fields_set or full
    changes: dict[str, Any] = {}
    if classes or meshes:
        changes["classes"] = tuple(classes or ())
        changes["landmarks"] = ()
        changes["meshes"] = tuple(
            MeshPlan(
                name=name,
                path=path,
                unit=_stated_unit(path, unit),
                up=up,  # type: ignore[arg-type]  # MeshPlan says what is right
                origin=origin,  # type: ignore[arg-type]
                symmetry=symmetry,
            )
            for name, path in map(_name_and_file, meshes or ())
        )
    options = (
        ("sensor", sensor), ("distance_m", distance), ("delta_deg", delta), ("model", model), ("albedo", albedo)
    )  # fmt: skip
    changes |= {key: value for key, value in options if value is not None}
    if full:
        changes["layout"] = "full"
    plan = BankPlan(**{**plan.model_dump(), **changes})
    resolved = plan.resolve()
    plan = plan.model_copy(update={"meshes": _with_symmetry(plan.meshes, resolved.meshes)})
    if not layout_stated and (reason := factored_refusal(resolved)) is not None:
        plan = plan.model_copy(update={"layout": "full"})
        if not plan.meshes:
            _tell(f"note: a full bank, every class at every D and δ: {reason}")
    _build(build_bank, plan, out, shard, dry_run, max_size, as_json, workers, resume, force, shard_size, scheduler)


@_bank_app.command("info")
def _bank_info(
    bank: Annotated[Path, typer.Argument(metavar="BANK", help="A bank.")],
    as_json: _Json = False,
) -> None:
    """Say what a bank holds."""
    with _open_bank(bank) as opened:
        info = opened.info()
    if as_json:
        _echo_json(info)
    else:
        _echo_facts(info)


@_bank_app.command("verify")
def _bank_verify(
    bank: Annotated[Path, typer.Argument(metavar="BANK", help="A bank, its checksum beside it.")],
    population: Annotated[
        int | None, typer.Option("--population", min=1, help="Match so many random views against the bank.")
    ] = None,
    sample: _Sample = 16,
    seed: _Seed = 0,
    as_json: _Json = False,
) -> None:
    """Check a bank: checksum, schema, values, random images rendered again; and what its grid's spacing costs."""
    from phasemark.data import verify_bank

    with _Progress("verifying"):
        report = verify_bank(bank, sample=sample, seed=seed)
    if population is not None:
        from phasemark.matcher import grid_loss

        with _open_bank(bank) as opened, _Progress("matching random views"):
            loss = grid_loss(opened, population, seed=seed).as_dict()
        report |= {key: float(f"{value:.3g}") if isinstance(value, float) else value for key, value in loss.items()}
    _echo_json(report) if as_json else _echo_facts(report)


@_bank_app.command("merge")
def _bank_merge(
    shards: Annotated[list[Path], typer.Argument(metavar="SHARD...", help="All parts that --shard has built.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The bank to write.")],
    resume: _Resume = False,
    force: _Force = False,
) -> None:
    """Put the parts of a bank together."""
    _merge(shards, out, resume, force)


@_frames_app.command("build")
def _frames_build(
    plan_file: Annotated[Path, typer.Argument(metavar="PLAN", help="A plan (.toml); options override it.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The frame set to write; its checksum goes beside it.")],
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, max=2**64 - 1, help="Root of all random numbers.")
    ] = None,
    views: Annotated[int | None, typer.Option("--views", min=1, help="How many views.")] = None,
    workers: _Workers = None,
    resume: _Resume = False,
    dry_run: _DryRun = False,
    max_size: _MaxSize = "2GB",
    shard: _Shard = None,
    shard_size: _ShardItems = None,
    scheduler: _Scheduler = "threads",
    as_json: _Json = False,
    force: _Force = False,
) -> None:
    """Build a set of noisy frames with their truth."""
    from phasemark.data import FramePlan, build_frames, read_plan

    plan = read_plan(plan_file, FramePlan)
    changes = {key: value for key, value in (("seed", seed), ("views", views)) if value is not None}
    plan = plan.model_copy(update=changes)
    _build(build_frames, plan, out, shard, dry_run, max_size, as_json, workers, resume, force, shard_size, scheduler)


@_frames_app.command("info")
def _frames_info(
    frames: Annotated[Path, typer.Argument(metavar="FRAMES", help="A frame set.")],
    as_json: _Json = False,
) -> None:
    """Say what a frame set holds."""
    from phasemark.data import open_frames

    with open_frames(frames, untrusted=True) as opened:
        info = opened.info()
    _echo_json(info) if as_json else _echo_facts(info)


@_frames_app.command("verify")
def _frames_verify(
    frames: Annotated[Path, typer.Argument(metavar="FRAMES", help="A frame set, its checksum beside it.")],
    sample: _Sample = 16,
    seed: _Seed = 0,
    as_json: _Json = False,
) -> None:
    """Check a frame set: checksum, schema, values, and random views rendered and captured again."""
    from phasemark.data import verify_frames

    with _Progress("verifying"):
        report = verify_frames(frames, sample=sample, seed=seed)
    _echo_json(report) if as_json else _echo_facts(report)


@_frames_app.command("merge")
def _frames_merge(
    shards: Annotated[list[Path], typer.Argument(metavar="SHARD...", help="All parts that --shard has built.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The frame set to write.")],
    resume: _Resume = False,
    force: _Force = False,
) -> None:
    """Put the parts of a frame set together; the bytes are those of a single run."""
    _merge(shards, out, resume, force)


@_frames_app.command("export")
def _frames_export(
    frames: Annotated[Path, typer.Argument(metavar="FRAMES", help="A frame set.")],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="FORMAT",
            help="npz, csv, png16, ply, bop or rosbag.",
            autocompletion=_one_of("npz", "csv", "png16", "ply", "bop", "rosbag"),
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="The file (npz, csv) or folder to write.")],
    quantity: Annotated[
        str | None,
        typer.Option(
            "--quantity",
            help="range or z, in npz, csv and png16; BOP and ROS have z.",
            autocompletion=_one_of("range", "z"),
        ),
    ] = None,
    force: _Force = False,
) -> None:
    """Write a frame set for other programs."""
    from phasemark.data import export_frames, open_frames

    _refuse_inputs([out])
    with open_frames(frames, untrusted=True) as opened:
        typer.echo(export_frames(opened, out, to, quantity=quantity, force=force))  # type: ignore[arg-type]


@_frames_app.command("import")
def _frames_import(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="CSV, NPY, NPZ, HDF5, PNG; a folder of PNG, a bag.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The measured frames as .npz, range along the ray, metres.")],
    sensor: _SensorOption = "pmd-16x16",
    unit: _FramesUnit = None,
    quantity: _Quantity = None,
    invalid_means: _InvalidMeans = "missing",
    valid_status: _ValidStatus = None,
    flip_h: _FlipH = False,
    flip_v: _FlipV = False,
    rotate: _Rotate = 0,
    topic: Annotated[str | None, typer.Option("--topic", help="Which images of a ROS bag.")] = None,
    force: _Force = False,
) -> None:
    """Bring measured frames into one form: range along the ray, in metres, upright."""
    from phasemark.data import read_frames, write_measured

    if out.suffix.lower() != ".npz":
        raise UsageError(f"the output must be a .npz file, got '{out}'")
    _refuse_existing([out], force)
    frames = read_frames(
        file,
        sensor=_load_sensor(sensor),
        unit=unit,  # type: ignore[arg-type]  # read_frames says what is right
        quantity=quantity,  # type: ignore[arg-type]
        invalid_means=invalid_means,  # type: ignore[arg-type]
        valid_status=valid_status,
        flip_h=flip_h,
        flip_v=flip_v,
        rotate=rotate,
        untrusted=True,
        topic=topic,
    )
    typer.echo(write_measured(frames, out, force=force))


@_frames_app.command("simulate")
def _frames_simulate(
    out: Annotated[Path, typer.Option("-o", "--out", help="The recording to write: .csv, .npz or .h5.")],
    class_name: Annotated[
        str | None, typer.Option("--class", help="A class of the catalogue.", autocompletion=_a_class)
    ] = None,
    mesh_file: Annotated[str | None, typer.Option("--mesh", metavar="NAME=FILE", help="A mesh file.")] = None,
    unit: _Unit = None,
    up: _Up = "z",
    origin: _Origin = "file",
    sensor: _SensorOption = "pmd-16x16",
    distance: Annotated[
        float, typer.Option("--distance", metavar="M", help="Distance D to the landmark's axis, in the first frame.")
    ] = 1.0,
    delta: Annotated[
        float, typer.Option("--delta", metavar="DEG", help="Side δ from which it is seen, in the first frame.")
    ] = 0.0,
    bearing: Annotated[float, typer.Option("--bearing", metavar="DEG", help="Its azimuth in the camera.")] = 0.0,
    height: Annotated[float, typer.Option("--height", metavar="M", help="Its height above the optical axis.")] = 0.0,
    wall: _Wall = None,
    floor: _Floor = None,
    moving: Annotated[
        bool, typer.Option("--moving/--still", help="Whether D and δ change evenly until the last frame.")
    ] = False,
    to_distance: Annotated[
        float | None,
        typer.Option("--to-distance", metavar="M", help="With --moving, D in the last frame; 0.8 of the first."),
    ] = None,
    to_delta: Annotated[
        float | None, typer.Option("--to-delta", metavar="DEG", help="With --moving, δ in the last frame; 40 more.")
    ] = None,
    n_frames: Annotated[int, typer.Option("--frames", min=1, help="How many frames.")] = 20,
    seed: _Seed = 0,
    force: _Force = False,
) -> None:
    """Simulate a recording in the form that sensors write, with time stamps and the truth, to try match with.

    The file says that it is simulated. A direct sensor writes z in millimetres and status codes (5: valid), another one
    ranges in metres with amplitudes. The truth of each frame stands in columns truth_..., which other commands ignore.
    """
    import numpy as np

    from phasemark.data import simulate_recording, write_recording
    from phasemark.data.measured.simulated import recording_format
    from phasemark.render import Views

    if (class_name is None) == (mesh_file is None):
        raise UsageError("say what to record: either --class NAME or --mesh NAME=FILE")
    if class_name is not None and unit is not None:
        raise UsageError("--unit belongs to --mesh: the catalogue is in metres")
    for option, value in (("--to-distance", to_distance), ("--to-delta", to_delta)):
        if value is not None and not moving:
            raise UsageError(f"{option} goes with --moving: a camera at rest keeps its view")
    recording_format(out)
    camera = _load_sensor(sensor)
    if n_frames * camera.rows * camera.cols > _RECORDED_PIXELS:
        most = _RECORDED_PIXELS // (camera.rows * camera.cols)
        raise UsageError(
            f"--frames must be at most {most} for {camera.rows} × {camera.cols} pixels: a recording is"
            " made in memory; phasemark frames build makes large sets"
        )
    _refuse_unwritable([out], force)
    if class_name is not None:
        name, mesh = _load_landmark(class_name, None, "z", "file", from_catalog=True)
    else:
        assert mesh_file is not None
        name, path = _name_and_file(mesh_file)
        _, mesh = _load_landmark(path, unit, up, origin)
    way = np.linspace(0.0, 1.0, n_frames) if moving else np.zeros(n_frames)
    last_distance = 0.8 * distance if to_distance is None else to_distance
    last_delta = delta + 40.0 if to_delta is None else to_delta
    views = Views.broadcast(
        distance + way * (last_distance - distance),
        np.radians(delta + way * (last_delta - delta)),
        math.radians(bearing),
        height,
    )
    recording = simulate_recording(
        mesh,
        _readable(name),
        camera,
        views,
        seed=seed,
        albedo=mesh.metadata.get("albedo", 0.8),
        background=_background(wall, floor),
    )
    described = _readable(f"landmark={name} sensor={Path(sensor).name}")
    description = f"{described} seed={seed} {'moving' if moving else 'still'}"
    typer.echo(write_recording(recording, out, description=description, force=force))


@_frames_app.command("show")
def _frames_show(
    frames: Annotated[Path, typer.Argument(metavar="FRAMES", help="A frame set, or measured frames.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The picture, .png.")],
    index: Annotated[int, typer.Option("--index", min=0, help="Number of the frame.")] = 0,
    sensor: _SensorOption = "pmd-16x16",
    unit: _FramesUnit = None,
    quantity: _Quantity = None,
    valid_status: _ValidStatus = None,
    force: _Force = False,
) -> None:
    """Draw one frame."""
    import io as bytes_io

    from phasemark.data import is_frame_set, open_frames, read_frames, write_atomically

    if out.suffix.lower() != ".png":
        raise UsageError(f"the picture must be a .png file, got '{out}'")
    _refuse_existing([out], force)
    if is_frame_set(frames):
        with open_frames(frames, untrusted=True) as opened:
            _refuse_index(index, len(opened))
            figure = opened.frames([index]).plot()
    else:
        measured = read_frames(
            frames,
            sensor=_load_sensor(sensor),
            unit=unit,  # type: ignore[arg-type]  # read_frames says what is right
            quantity=quantity,  # type: ignore[arg-type]
            valid_status=valid_status,
            untrusted=True,
        )
        _refuse_index(index, len(measured) * measured.n_frames)
        figure = measured.plot(*divmod(index, measured.n_frames))
    picture = bytes_io.BytesIO()
    figure.savefig(picture, format="png", dpi=120)
    typer.echo(write_atomically(out, picture.getvalue(), force=force))


def _refuse_index(index: int, n: int) -> None:
    if index >= n:
        raise UsageError(f"--index must be below {n}, the number of frames, got {index}")


_NOTED_BYTES = 100_000_000
"""A file of at least this size is announced before it is built, with the time it takes."""
_TRIAL_SECONDS = 2.0
"""About how long that time is tried for."""


def _build(
    build: Callable[..., Any],
    plan: BankPlan | FramePlan,
    out: Path,
    shard: str | None,
    dry_run: bool,
    max_size: str,
    as_json: bool,
    workers: int | None,
    resume: bool,
    force: bool,
    shard_size: int | None,
    scheduler: str,
) -> None:
    """Build a bank or frame set, whole or in part; or say what that would take."""
    from phasemark.data import build_part, estimate, parse_part, planned_size
    from phasemark.data.shards.executor import processors
    from phasemark.data.shards.run import outputs_of, refuse_unwritable_output
    from phasemark.data.size import format_size, parse_size, refuse_too_many, too_many

    limit = parse_size(max_size, "--max-size")
    part, parts = (1, 1) if shard is None else parse_part(shard)
    _note_plan_too_far(plan)
    facts: dict[str, Any] = planned_size(plan)
    counts = {name: n // parts for name, n in facts.items()}
    size = counts.pop("bytes")
    if dry_run:
        many = too_many(facts)
        about = f"not tried: {many or 'the file would be larger than --max-size'}"
        if size <= limit and many is None:
            facts = estimate(plan, workers=workers or processors())
            about = f"about {facts['seconds']:.3g}"
        if as_json:
            _echo_json({**facts, "seconds": facts.get("seconds")})
        else:
            _echo_facts({**facts, "seconds": about})
        return
    _refuse_inputs(outputs_of(out), plan)
    described = f"{out}: {', '.join(f'{n} {name}' for name, n in counts.items())}, {format_size(size)}"
    if size > limit:
        smaller = (
            "thin 'distance_m' or 'delta_deg'" if "images" in counts else "take fewer 'views' or 'frames_per_view'"
        )
        raise UsageError(
            f"{described}, would be larger than --max-size {format_size(limit)}: {smaller}, or allow"
            f" --max-size {format_size(size * 11 // 10).replace(' ', '')}"
        )
    if size >= _NOTED_BYTES:
        refuse_too_many(plan)
        refuse_unwritable_output(out, force=force, resume=resume)
        threads = workers or processors()
        seconds = estimate(plan, workers=threads, trial_seconds=_TRIAL_SECONDS)["seconds"] / parts
        _tell(f"note: {described}; about {_duration(seconds)} on {threads} processors here")
    with _Progress("rendering") as progress:
        options: dict[str, Any] = {
            "workers": workers, "resume": resume, "force": force, "shard_items": shard_size, "scheduler": scheduler,
            "progress": progress,
        }  # fmt: skip
        if shard is not None:
            build_part(plan, (part, parts), out, **options)
        else:
            build(plan, out, **options).close()
    if as_json:
        _echo_json({"path": str(out)})
    else:
        typer.echo(out)


def _merge(shards: Sequence[Path], out: Path, resume: bool, force: bool) -> None:
    from phasemark.data import merge_parts
    from phasemark.data.shards.run import outputs_of

    _refuse_inputs(outputs_of(out))
    with _Progress("merging") as progress:
        merge_parts(shards, out, resume=resume, force=force, progress=progress)
    typer.echo(out)


@_plan_app.command("example")
def _plan_example(
    kind: Annotated[
        str, typer.Argument(metavar="KIND", help="bank, frames, sweep, drive or design.", autocompletion=_a_plan_kind)
    ],
) -> None:
    """Print a plan with comments; it can be used as it is."""
    from phasemark.matcher.plan_kinds import plan_example

    typer.echo(plan_example(kind), nl=False)


@_plan_app.command("schema")
def _plan_schema(
    kind: Annotated[
        str, typer.Argument(metavar="KIND", help="bank, frames, sweep, drive or design.", autocompletion=_a_plan_kind)
    ],
) -> None:
    """Print the JSON Schema of a kind of plan, for editors and other programs."""
    from phasemark.matcher.plan_kinds import plan_schema

    _echo_json(plan_schema(kind))


@_plan_app.command("check")
def _plan_check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A plan (.toml).")],
    kind: Annotated[
        str | None,
        typer.Option(
            "--kind",
            help="bank, frames, sweep, drive or design, if the plan leaves it open.",
            autocompletion=_a_plan_kind,
        ),
    ] = None,
    as_json: _Json = False,
) -> None:
    """Check a plan and say what it is; with --json print it with every default made explicit."""
    from phasemark.data.plans.bank_plan import ScenePlan
    from phasemark.matcher.drive import DrivePlan
    from phasemark.matcher.plan_kinds import check_plan

    found, plan = check_plan(file, kind)
    if isinstance(plan, ScenePlan | DrivePlan):
        _note_plan_too_far(plan)
    if as_json:
        _echo_json({"kind": found, "plan": plan.model_dump(mode="json")})
    else:
        typer.echo(f"{file}: a plan of kind '{found}', complete and valid")


@app.command("match")
def _match(
    bank: Annotated[Path, typer.Argument(metavar="BANK", help="A bank.")],
    frames: Annotated[Path, typer.Argument(metavar="FRAMES", help="Measured frames: CSV, NPY, NPZ or HDF5.")],
    unit: _FramesUnit = None,
    quantity: _Quantity = None,
    invalid_means: _InvalidMeans = "missing",
    valid_status: _ValidStatus = None,
    flip_h: _FlipH = False,
    flip_v: _FlipV = False,
    rotate: _Rotate = 0,
    filter_name: Annotated[
        str, typer.Option("--filter", help="kalman or phasor-mean.", autocompletion=_one_of("kalman", "phasor-mean"))
    ] = "kalman",
    method: Annotated[
        str,
        typer.Option(
            "--method",
            autocompletion=_one_of("nearest", "refine"),
            help="nearest: the paper's minimum-distance classifier. refine: maximum likelihood, with covariance.",
        ),
    ] = "nearest",
    free: Annotated[
        list[str] | None,
        typer.Option(
            "--free",
            help="With refine, estimate this with nothing known of it: bearing or height; repeatable.",
            autocompletion=_one_of("bearing", "height"),
        ),
    ] = None,
    fix: Annotated[
        str | None,
        typer.Option(
            "--fix", help="With refine, leave this at 0: bearing.", autocompletion=_one_of("bearing"), metavar="NAME"
        ),
    ] = None,
    bearing_std: Annotated[
        float | None,
        typer.Option(
            "--bearing-std",
            metavar="DEG",
            help="With refine, how well the camera points at the landmark (1.5 unless --free or --fix is given).",
        ),
    ] = None,
    on: Annotated[
        str,
        typer.Option(
            "--on",
            help="With refine: ranges, or phasors with the albedo free.",
            autocompletion=_one_of("ranges", "phasors"),
        ),
    ] = "ranges",
    pixels: Annotated[
        str,
        typer.Option(
            "--pixels", help="With refine, what gives the view: all or lower.", autocompletion=_one_of("all", "lower")
        ),
    ] = "all",
    robust: Annotated[bool, typer.Option("--robust", help="With refine, count residuals beyond 3 σ less.")] = False,
    false_alarm: Annotated[
        float, typer.Option("--false-alarm", help="Share of good frames that the test of the fit may refuse.")
    ] = 0.01,
    auto_background: Annotated[
        bool, typer.Option("--auto-background", help="With refine, estimate wall and floor from each frame.")
    ] = False,
    unknown_background: Annotated[
        bool,
        typer.Option("--unknown-background", help="With refine: other things may stand before, beside and behind it."),
    ] = False,
    wall: _Wall = None,
    floor: _Floor = None,
    landmark_xy: Annotated[
        tuple[float, float] | None,
        typer.Option("--landmark-xy", metavar="X Y", help="Where the landmark stands, metres."),
    ] = None,
    landmark_yaw: Annotated[float, typer.Option("--landmark-yaw", metavar="DEG", help="Heading of its x' axis.")] = 0.0,
    pan: Annotated[float, typer.Option("--pan", metavar="DEG", help="Pan angle of the camera on the robot.")] = 0.0,
    prior: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--prior", metavar="X Y DEG", help="Where the robot is thought to be; orders the solutions."),
    ] = None,
    prior_std: Annotated[
        tuple[float, float] | None,
        typer.Option("--prior-std", metavar="M DEG", help="How well: standard deviations of x and y, and of heading."),
    ] = None,
    map_file: Annotated[
        Path | None,
        typer.Option("--map", metavar="MAP", help="Where the landmarks stand (.toml), instead of --landmark-xy."),
    ] = None,
    moving: Annotated[
        bool, typer.Option("--moving", help="The camera moves: match every frame by itself instead of their mean.")
    ] = False,
    estimates: Annotated[
        Path | None,
        typer.Option("--estimates", metavar="FILE", help="Write a line for each position into this .csv."),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            "--plot", help="Draw measured, model and residual into this .png; of several positions, number K into -K."
        ),
    ] = None,
    plot_index: Annotated[
        str | None,
        typer.Option(
            "--plot-index",
            metavar="LIST",
            help=f"Positions to draw, such as 0,17,200:210. By default all, or the first of more than {_DRAWN_ALL}.",
        ),
    ] = None,
    no_diagnosis: Annotated[
        bool, typer.Option("--no-diagnosis", help="Do not look for the setting that makes a refused frame fit.")
    ] = False,
    as_json: _Json = False,
    as_jsonl: Annotated[
        bool, typer.Option("--jsonl", help="Print each match as a line of JSON as soon as it is known.")
    ] = False,
    force: _Force = False,
) -> None:
    """Match measured frames against a bank, and place the robot.

    All frames of a file are averaged: the camera stands still. A file of shape (n, frames, rows, cols) has n positions.
    With --moving every frame is a position of its own. A CSV file may have a header that names its columns: t_ms or
    t_s, mm_0 ... (or range_0 ..., z_0 ...), status_0 ...; for a VL53L5CX or VL53L8CX give --valid-status 5.
    """
    from phasemark.data import read_frames, write_atomically
    from phasemark.matcher import Matcher, diagnose, kalman_filter, load_map, phasor_mean
    from phasemark.matcher.likelihood.estimator import BEARING_STD_RAD
    from phasemark.matcher.recordings.estimates_table import EstimateTable, match_in_batches

    filters = {"kalman": kalman_filter, "phasor-mean": phasor_mean}
    if filter_name not in filters:
        raise UsageError(f"unknown filter '{filter_name}': give {' or '.join(filters)}")
    if map_file is not None and landmark_xy is not None:
        raise UsageError("--map and --landmark-xy both say where the landmark stands: give one of them")
    if prior is not None and landmark_xy is None and map_file is None:
        raise UsageError("--prior needs --landmark-xy or --map: without it there is no robot position")
    if prior_std is not None and prior is None:
        raise UsageError("--prior-std needs --prior, which it belongs to")
    if prior_std is not None and not min(prior_std) > 0:
        raise UsageError(f"--prior-std must be two positive numbers, got {prior_std[0]:g} {prior_std[1]:g}")
    landmarks = None if landmark_xy is None else _one_landmark(landmark_xy, landmark_yaw)
    if map_file is not None:
        landmarks = load_map(map_file)
    if plot is not None and plot.suffix.lower() != ".png":
        raise UsageError(f"the picture must be a .png file, got '{plot}'")
    if plot is None and plot_index is not None:
        raise UsageError("--plot-index needs --plot, the file to draw into")
    if estimates is not None and estimates.suffix.lower() != ".csv":
        raise UsageError(f"the estimates must be a .csv file, got '{estimates}'")
    if as_json and as_jsonl:
        raise UsageError("--json and --jsonl are two forms of the same output: give one of them")
    background = _background(wall, floor)
    if auto_background and background is not None:
        raise UsageError("--auto-background estimates wall and floor: leave --wall and --floor out")
    if unknown_background and (auto_background or background is not None):
        raise UsageError(
            "--unknown-background takes nothing for known: leave --auto-background, --wall and --floor out"
        )
    if fix not in (None, "bearing"):
        raise UsageError(f"--fix must be bearing, got '{fix}'")
    if bearing_std is not None and (free or fix):
        raise UsageError("--bearing-std says how well the bearing is known: leave --free and --fix out")
    if fix and "bearing" in (free or ()):
        raise UsageError("--free and --fix both name bearing: give one of them")
    parameters = ["distance_m", "delta_rad"]
    for name in free or ():
        if name not in _FREE:
            raise UsageError(f"--free must be {' or '.join(_FREE)}, got '{name}'")
        parameters.append(_FREE[name])
    near_the_axis = method == "refine" and not free and not fix
    if near_the_axis:
        parameters.append(_FREE["bearing"])
    refined = (
        ("--free", bool(free)), ("--on", on != "ranges"), ("--pixels", pixels != "all"), ("--robust", robust),
        ("--auto-background", auto_background), ("--unknown-background", unknown_background),
        ("--fix", fix is not None), ("--bearing-std", bearing_std is not None),
    )  # fmt: skip
    for option, used in refined:
        if used and method == "nearest":
            raise UsageError(f"{option} goes with --method refine: the nearest image has nothing of the kind")
    with _open_bank(bank) as opened:
        measured = read_frames(
            frames,
            sensor=opened.sensor,
            unit=unit,  # type: ignore[arg-type]  # read_frames says what is right
            quantity=quantity,  # type: ignore[arg-type]
            invalid_means=invalid_means,  # type: ignore[arg-type]
            valid_status=valid_status,
            flip_h=flip_h,
            flip_v=flip_v,
            rotate=rotate,
            untrusted=True,
        )
        _note_too_far(opened.sensor, {"--wall": wall})
        positions = measured.each_a_position() if moving else measured
        plots = {} if plot is None else _plots_by_position(plot, plot_index, len(positions))
        _refuse_unwritable([*plots.values(), *([] if estimates is None else [estimates])], force)
        matcher = Matcher(
            opened,
            method,
            free=None if near_the_axis else parameters,
            background="auto" if auto_background else "unknown" if unknown_background else background,
            bearing_std_rad=BEARING_STD_RAD if bearing_std is None else math.radians(bearing_std),
            false_alarm=false_alarm,
            on=on,  # type: ignore[arg-type]  # Matcher says what is right
            pixels=pixels,  # type: ignore[arg-type]
            robust=robust,
        )
        if not moving:
            _note_motion(measured, frames)
        answers: list[dict[str, Any]] = []  # all of them only for --json, whose answers are one list
        table, estimated = _Table(), EstimateTable(parameters)
        drawn: dict[int, tuple[FilteredFrames, Match]] = {}
        refused: tuple[int, FilteredFrames] | None = None
        n_accepted = 0
        at_once = _NEAREST_AT_ONCE if method == "nearest" else _REFINED_AT_ONCE
        with _Progress("matching") if len(positions) > at_once else nullcontext() as progress:
            for batch in match_in_batches(matcher, positions, filters[filter_name], at_once=at_once):
                some = []
                for k, match in enumerate(batch.matches):
                    answer = match.as_dict()
                    if batch.filtered.time_s is not None:
                        answer["time_s"] = float(batch.filtered.time_s[k])
                    if landmarks is not None:
                        answer["poses"] = _poses(
                            match, landmarks, map_file is None, math.radians(pan), prior, prior_std
                        )
                    some.append(answer)
                    if batch.start + k in plots:
                        drawn[batch.start + k] = batch.filtered[k : k + 1], match
                    n_accepted += match.accepted
                    if refused is None and not match.accepted:
                        refused = batch.start + k, batch.filtered[k : k + 1]
                if estimates is not None:
                    estimated.add(batch)
                if as_json:
                    answers += some
                elif as_jsonl:
                    for k, answer in enumerate(some):
                        typer.echo(
                            json.dumps({"index": batch.start + k, **answer}, ensure_ascii=False, allow_nan=False)
                        )
                else:
                    table.echo(_match_rows(some, batch.start, moving))
                sys.stdout.flush()
                if progress is not None:
                    progress(batch.start + len(some), len(positions))
        # among the frames of a moving camera some do not show the landmark: that needs no diagnosis
        if refused is not None and not (no_diagnosis or unknown_background or (moving and n_accepted)):
            diagnosis = replace(diagnose(matcher, refused[1], 0, background=background), index=refused[0])
            given = _ReadOptions(unit, flip_h, flip_v, rotate, method == "nearest", fix == "bearing")
            message = _diagnosis_text(diagnosis, given)
            _tell(f"note: {message}")
            if as_json:
                answers[diagnosis.index]["diagnosis"] = {**diagnosis.as_dict(), "message": message}
        if as_json:
            _echo_json({"bank": str(bank), "frames": str(frames), "matches": answers})
        if estimates is not None:
            write_atomically(estimates, estimated.to_csv().encode(), force=force)
        for k, path in plots.items():
            _save_match_picture(path, *drawn[k], opened, background, force)
    if not (as_json or as_jsonl):
        for path in [*([] if estimates is None else [estimates]), *plots.values()]:
            typer.echo(path)
        _note_plots(plots, plot_index, len(positions))


@app.command("calibrate")
def _calibrate(
    landmark: Annotated[
        str, typer.Argument(metavar="BANK|CLASS", help="A bank, or a class of the catalogue.", autocompletion=_a_class)
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
        str | None, typer.Option("--class", help="Which class of a bank that has several.", autocompletion=_a_class)
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            "--sensor",
            metavar="NAME|FILE",
            help="The camera as it is thought to be; a bank has its own.",
            autocompletion=_a_preset,
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
            autocompletion=_one_of("auto", "ranges", "phasors"),
        ),
    ] = "auto",
    wall: _Wall = None,
    floor: _Floor = None,
    unit: _FramesUnit = None,
    quantity: _Quantity = None,
    invalid_means: _InvalidMeans = "missing",
    valid_status: _ValidStatus = None,
    flip_h: _FlipH = False,
    flip_v: _FlipV = False,
    rotate: _Rotate = 0,
    plot: Annotated[
        Path | None,
        typer.Option("--plot", help="The picture of the residuals, .png; beside the sensor file otherwise."),
    ] = None,
    workers: _Workers = None,
    as_json: _Json = False,
    force: _Force = False,
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
    _refuse_existing([out, picture], force)
    background = _background(wall, floor)
    mesh, base, base_name = _calibration_target(landmark, class_name, sensor)
    stds = None
    if (position_std, heading_std, delta_std) != (None, None, None):
        stds = PoseStd(position_std or 0.0, math.radians(heading_std or 0.0), math.radians(delta_std or 0.0))
    known = read_poses(poses, landmark_xy_m=landmark_xy, landmark_yaw_rad=math.radians(landmark_yaw))
    furthest_m = float(known.distance_m.max()) if len(known.distance_m) else None
    _note_too_far(base, {f"{poses}: the landmark": furthest_m, "--wall": wall})
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
    with _Progress("rendering poses") as progress:
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
    write_atomically(out, calibration_toml(found, base_name=_readable(base_name)).encode(), force=force)
    if as_json:
        _echo_json({"file": str(out), "picture": str(picture), **calibration_dict(found)})
        return
    _echo_calibration(found)
    typer.echo(out)
    typer.echo(picture)


def _names(text: str) -> list[str]:
    """Split names at commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def _open_bank(path: Path) -> Bank:
    """Open a bank from anywhere; say of a mesh how a bank is made of it."""
    from phasemark.data import open_bank
    from phasemark.landmarks.mesh_files import FORMATS

    if path.exists() and path.suffix.lower().removeprefix(".") in FORMATS:
        mesh, out = shlex.quote(f"part={path}"), shlex.quote(f"{path.stem}.h5")
        raise InputFileError(
            f"{path}: a mesh, not a bank; if it is in millimetres, one is made of it by: phasemark bank build"
            f" --mesh {mesh} --unit mm --out {out}"
        )
    return open_bank(path, untrusted=True)


def _calibration_target(landmark: str, class_name: str | None, sensor: str | None) -> tuple[Trimesh, Sensor, str]:
    """Return the mesh of a landmark, and the camera as it is thought to be with its name."""
    from phasemark.landmarks import catalog

    path = Path(landmark)
    if landmark in catalog() or not (path.suffix or path.exists()):
        if class_name is not None:
            raise UsageError("--class belongs to a bank: give the class in its place")
        name = sensor or "pmd-16x16"
        return _load_landmark(landmark, None, "z", "file", from_catalog=True)[1], _load_sensor(name), name
    with _open_bank(path) as bank:
        if class_name is None and len(bank.classes) > 1:
            raise UsageError(f"{landmark} has {', '.join(bank.classes)}: say with --class which one was recorded")
        mesh = bank.mesh(class_name or bank.classes[0])
        return (mesh, bank.sensor, landmark) if sensor is None else (mesh, _load_sensor(sensor), sensor)


def _echo_calibration(found: Calibration) -> None:
    """Print every number with its standard deviation and use, their correlations, the test of the fit and notes."""
    from phasemark.matcher.calibration.mounting_model import PARAMETERS
    from phasemark.matcher.calibration.report import USES, shown, shown_names, shown_std

    rows = []
    for name in shown_names(found):
        parameter = PARAMETERS[name]
        use = USES.get(name) or f"{parameter.field} of the sensor"
        rows.append((name, shown(found, name), shown_std(found, name), parameter.unit, use))
    _echo_table(("", "value", "±", "", "where it goes"), rows)
    if len(found.free) > 1:
        typer.echo("\ncorrelation")
        _echo_table(
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


@app.command("demo")
def _demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the report, the tables and the bank.")] = Path(
        "out/demo"
    ),
    seed: _Seed = 2005,
    workers: _Workers = None,
    as_json: _Json = False,
    force: _Force = False,
) -> None:
    """Run the paper's experiment and write its report: four landmarks, 80 to 120 cm, 0 to 90°."""
    from phasemark.data.shards.run import outputs_of
    from phasemark.matcher.demo.report import summary_rows
    from phasemark.matcher.demo.run import cell_rows, run_demo, write_demo

    bank = out / "bank.h5"
    _refuse_existing([bank], force)
    names = ("report.html", "cells.csv", "trials.csv")
    with _output_folder(out, "demo", names, force, also=[path.name for path in outputs_of(bank)]):
        with _Progress("matching") as progress:
            result = run_demo(bank, seed=seed, workers=workers, force=force, progress=progress)
        with _Progress("writing the report"):
            report = write_demo(result, out, force=force)
    if as_json:
        cells = [{key: _plain(value) for key, value in row.items()} for row in cell_rows(result.cells)]
        _echo_json({"report": str(report), "seconds": result.seconds, "cells": cells})
        return
    header = ("D (cm)", "δ (°)", "class right", "|ΔD| mm", "worst", "|Δδ| °", "worst", "position mm", "worst")
    for title, shifted in (("on the bank's grid", False), ("between grid points", True)):
        typer.echo(f"{title}: medians and worst over the classes")
        _echo_table(header, summary_rows(result.select(shifted=shifted)))
        typer.echo("")
    typer.echo(report)


@_sweep_app.command("run")
def _sweep_run(
    plan: Annotated[
        str,
        typer.Argument(
            metavar="PLAN|NAME",
            help="A plan (.toml), or paper, distance-angle-noise or robustness.",
            autocompletion=_one_of("paper", "distance-angle-noise", "robustness"),
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for trials, tables and the report.")],
    trials: Annotated[
        int | None, typer.Option("--trials", help="Trials of each condition, in place of the plan's.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Root of all random numbers.")] = None,
    matcher: Annotated[
        str | None,
        typer.Option("--matcher", metavar="MODULE:NAME", help="Your own matcher, beside the plan's methods."),
    ] = None,
    trust_plan: Annotated[
        bool, typer.Option("--trust-plan", help="Run the programs (MODULE:NAME) that the plan itself names.")
    ] = False,
    workers: _Workers = None,
    scheduler: Annotated[
        str, typer.Option("--scheduler", help="threads, local:N (processes), or a Dask scheduler's address.")
    ] = "threads",
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a sweep that was interrupted.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Start over where the folder holds a sweep.")] = False,
) -> None:
    """Run a sweep and write its tables and report."""
    from phasemark.matcher.sweep.plan import Method, SweepPlan, load_sweep, refuse_programs
    from phasemark.matcher.sweep.report import write_report
    from phasemark.matcher.sweep.run import run_sweep, sweep_outputs

    loaded = load_sweep(plan)
    changes: dict[str, Any] = {key: value for key, value in (("trials", trials), ("seed", seed)) if value is not None}
    if not trust_plan:
        refuse_programs(loaded, () if matcher is None else (matcher,), plan)
    if matcher is not None and matcher not in [method.method for method in loaded.methods]:
        changes["methods"] = (*loaded.methods, Method(name=matcher, method=matcher))
    changed = SweepPlan(**{**loaded.model_dump(), **changes})
    if any(method.is_program for method in changed.methods):
        sys.path.append(str(Path.cwd()))  # where one's own matcher lies; an installed program does not look here itself
    _note_plan_too_far(changed)
    _refuse_inputs(sweep_outputs(out), changed)
    with _Progress("trials") as progress:
        run_sweep(changed, out, workers=workers, scheduler=scheduler, resume=resume, force=force, progress=progress)
    with _Progress("writing the report"):
        report = write_report(out)
    typer.echo(report)


@_sweep_app.command("report")
def _sweep_report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A sweep's folder.")],
    as_json: _Json = False,
) -> None:
    """Write a sweep's tables, figures and report again."""
    from phasemark.matcher.sweep.report import summary, write_report
    from phasemark.matcher.sweep.result_tables import json_rows
    from phasemark.matcher.sweep.run import read_sweep

    with _Progress("writing the report"):
        report = write_report(folder)
    trials = read_sweep(folder)[1]
    cells = trials.cells()
    if as_json:
        _echo_json({"report": str(report), "cells": json_rows([cell.row() for cell in cells])})
        return
    for sentence in summary(trials, cells):
        typer.echo(sentence)
    typer.echo(report)


@_sweep_app.command("frames")
def _sweep_frames(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A sweep's folder.")],
    condition: Annotated[int, typer.Argument(metavar="CONDITION", help="As in its trials.csv.", min=0)],
    trial: Annotated[int, typer.Argument(metavar="TRIAL", help="As in its trials.csv.", min=0)],
    out: Annotated[Path, typer.Option("-o", "--out", help="The noisy frames as .npz, to be matched again.")],
    force: _Force = False,
) -> None:
    """Take the frames of one trial of a sweep again, bit for bit."""
    from phasemark.data import write_measured
    from phasemark.data.files.folder_marker import read_marker
    from phasemark.data.files.same_file import refuse_inputs
    from phasemark.matcher.sweep.examples import sweep_frames

    refuse_inputs([out], map(folder.joinpath, read_marker(folder)[1] or ()))
    _refuse_existing([out], force)
    typer.echo(write_measured(sweep_frames(folder, condition, trial), out, force=force))


@_sweep_app.command("compare")
def _sweep_compare(
    first: Annotated[Path, typer.Argument(metavar="DIR1", help="A sweep's folder.")],
    second: Annotated[Path, typer.Argument(metavar="DIR2", help="Another one's.")],
    everything: Annotated[bool, typer.Option("--all", help="Show the differences that may be chance too.")] = False,
    as_json: _Json = False,
) -> None:
    """Compare two sweeps cell by cell; significant differences are marked, corrected for their number."""
    import dataclasses

    from phasemark.matcher.sweep.compare import compare_cells
    from phasemark.matcher.sweep.run import read_sweep

    found = compare_cells(*(read_sweep(folder)[1].cells() for folder in (first, second)))
    if as_json:
        rows = [dataclasses.asdict(one) for one in found]
        _echo_json([{key: _plain(value) for key, value in row.items()} for row in rows])
        return
    shown = [one for one in found if one.significant or everything]
    _echo_table(
        ("class", "D (m)", "δ (°)", "noise", "frames", "method", "quantity", str(first), str(second), "p", ""),
        (
            (
                one.condition.class_name, f"{one.condition.distance_m:g}", f"{one.condition.delta_deg:g}",
                f"{one.condition.noise_factor:g}", str(one.condition.n_frames), one.method, one.quantity,
                f"{one.first:.4g}", f"{one.second:.4g}", f"{one.p_value:.2g}", "*" if one.significant else "",
            )
            for one in shown
        ),
    )  # fmt: skip
    typer.echo(f"{sum(one.significant for one in found)} of {len(found)} differences are significant")


@app.command("drive")
def _drive(
    plan_file: Annotated[
        Path | None, typer.Argument(metavar="[PLAN]", help="A plan (.toml); without it a tour of 20 m.")
    ] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for tables, summary, picture and animation.")] = Path(
        "out/drive"
    ),
    seed: Annotated[int, typer.Option("--seed", min=0, max=2**64 - 1, help="Root of all random numbers.")] = 2005,
    example: Annotated[
        bool, typer.Option("--example", help="Print the plan of that tour, and do nothing else.")
    ] = False,
    workers: _Workers = None,
    as_json: _Json = False,
    force: _Force = False,
) -> None:
    """Drive a robot from landmark to landmark, its odometry corrected on the way."""
    from phasemark.matcher.drive import (
        OUTPUTS,
        default_drive,
        example_drive,
        load_drive_plan,
        run_drive,
        summary,
        write_drive,
    )

    if example:
        typer.echo(example_drive(), nl=False)
        return
    plan = default_drive() if plan_file is None else load_drive_plan(plan_file)
    _note_plan_too_far(plan)
    with _output_folder(out, "drive", OUTPUTS, force, plan):
        with _Progress("driving, cm") as progress:
            drive = run_drive(plan, seed=seed, workers=workers, progress=progress)
        with _Progress("drawing"):
            files = write_drive(drive, out, force=force)
    facts = summary(drive)
    if as_json:
        _echo_json({"files": [str(path) for path in files], **facts})
        return
    _echo_table(
        ("error", "at the end", "largest", "heading at the end", "largest"),
        (
            (
                title,
                f"{facts[f'{key}_final_position_error_m']:.3f} m",
                f"{facts[f'{key}_largest_position_error_m']:.3f} m",
                f"{facts[f'{key}_final_heading_error_deg']:.2f}°",
                f"{facts[f'{key}_largest_heading_error_deg']:.2f}°",
            )
            for title, key in (("dead reckoning", "dead_reckoned"), ("corrected", "corrected"))
        ),
    )
    typer.echo(f"{facts['way_m']:.1f} m, {facts['corrections']} corrections at {facts['stops']} stops")
    for path in files:
        typer.echo(path)


def _plots_by_position(plot: Path, chosen: str | None, n: int) -> dict[int, Path]:
    """Return which of n positions to draw, and into which files; those of several have a number before the suffix."""
    from phasemark.data.plans.grid_axis import parse_indices

    if chosen is not None:
        indices = parse_indices(chosen, n, "--plot-index")
    else:
        indices = list(range(n if n <= _DRAWN_ALL else 1))
    return {k: plot if n == 1 else plot.with_stem(f"{plot.stem}-{k}") for k in indices}


def _note_plots(plots: Mapping[int, Path], chosen: str | None, n: int) -> None:
    """Say how to have more positions drawn than the first."""
    if plots and chosen is None and len(plots) < n:
        _tell(
            f"note: drew the first of {n} positions; --plot-index 0,{n // 2}:{min(n // 2 + 9, n - 1)} draws others"
            " (some seconds each)"
        )


def _note_motion(measured: Frames, file: Path) -> None:
    """Say that frames which are about to be averaged were not taken at rest."""
    import numpy as np

    from phasemark.matcher import motion_test

    moved = np.flatnonzero(motion_test(measured).moved())
    if moved.size:
        n = len(measured)
        where = "the file" if n == 1 else f"{len(moved)} of {n} positions, the first being {moved[0]}"
        _tell(
            f"note: {file}: the camera or the scene moved during {where}, so that the mean of the frames is no single"
            " view; --moving matches every frame by itself"
        )


def _save_match_picture(
    path: Path, filtered: FilteredFrames, match: Match, bank: Bank, background: Background | None, force: bool
) -> None:
    """Draw one position."""
    import io as bytes_io

    from phasemark.data import write_atomically
    from phasemark.matcher.figures import match_picture

    buffer = bytes_io.BytesIO()
    match_picture(filtered, match, bank, background).savefig(buffer, format="png", dpi=120)
    write_atomically(path, buffer.getvalue(), force=force)


@dataclass(frozen=True)
class _ReadOptions:
    """How a command was told to read frames and match them, as far as a diagnosis depends on it."""

    unit: str | None
    flip_h: bool
    flip_v: bool
    rotate: int
    nearest: bool
    bearing_fixed: bool


def _diagnosis_text(diagnosis: Diagnosis, given: _ReadOptions) -> str:
    """Return a diagnosis in one line that names options."""
    return diagnosis.message(lambda change: _flags(change, given))


def _flags(change: Change, given: _ReadOptions) -> str:
    """Return the options that make one change."""
    from phasemark.data.measured.reading import METRES_PER_UNIT

    value = change.value
    refine = "--method refine " if given.nearest else ""
    turned = given.rotate in (90, 270)  # mirrored before it is turned: left and right become top and bottom
    if change.parameter == "method":
        return refine.strip()
    if change.parameter == "free":
        return f"{refine}--free bearing" + (" instead of --fix bearing" if given.bearing_fixed else "")
    if change.parameter == "background":
        if value == "auto":
            return f"{refine}--auto-background"
        if value is None:
            return f"{refine}without --wall and --floor".strip()
        planes = ((f"--{name}", getattr(value, f"{name}_m")) for name in ("wall", "floor"))
        return refine + " ".join(f"{option} {metres:.4f}" for option, metres in planes if metres is not None)
    if change.parameter in ("flip_h", "flip_v"):
        horizontal = (change.parameter == "flip_h") != turned
        option = "--flip-h" if horizontal else "--flip-v"
        return f"without {option}" if (given.flip_h if horizontal else given.flip_v) else option
    if change.parameter == "rotate":
        angle = (given.rotate + value) % 360
        return f"--rotate {angle}" if angle else "without --rotate"
    if change.parameter == "quantity":
        return f"--quantity {value}"
    if change.parameter == "unit_factor":
        scale = None if given.unit is None else METRES_PER_UNIT[given.unit] * value
        right = next((name for name, metres in METRES_PER_UNIT.items() if scale and math.isclose(metres, scale)), None)
        return f"a unit {value:g} times as large as the file states" if right is None else f"--unit {right}"
    if change.parameter == "half_angle_deg":
        return (
            "a bank of a sensor file with"
            f" half_angle_h_deg = {value[0]:.4g}, half_angle_v_deg = {value[1]:.4g} (phasemark calibrate makes one)"
        )
    if change.parameter == "bearing_offset_deg":
        return f"a bank of a sensor file with bearing_offset_deg = {value:.3g}, or the camera turned"
    return f"phasemark bank build --distance with a grid that has {value:.2f} m"


def _one_landmark(xy: tuple[float, float], yaw_deg: float) -> LandmarkMap:
    """Return the map of a landmark of any class."""
    from phasemark.matcher import LandmarkMap, MappedLandmark

    if not all(map(math.isfinite, (*xy, yaw_deg))):
        raise UsageError(
            f"--landmark-xy and --landmark-yaw must be finite numbers, got {xy[0]:g} {xy[1]:g} and {yaw_deg:g}"
        )
    only = MappedLandmark(name="landmark", class_name="any", x_m=xy[0], y_m=xy[1], yaw_deg=yaw_deg)
    return LandmarkMap(landmark=(only,))


def _poses(
    match: Match,
    landmarks: LandmarkMap,
    any_class: bool,
    pan_rad: float,
    prior: tuple[float, float, float] | None,
    prior_std: tuple[float, float] | None,
) -> list[dict[str, Any]]:
    """Return the robot poses of a match as plain numbers, best first; none if there is no landmark."""
    from phasemark.matcher import robot_poses

    believed, covariance = None, None
    if prior is not None:
        believed = (prior[0], prior[1], math.radians(prior[2]))
    if prior_std is not None:
        xy, heading = prior_std[0] ** 2, math.radians(prior_std[1]) ** 2
        covariance = [[xy, 0.0, 0.0], [0.0, xy, 0.0], [0.0, 0.0, heading]]
    if any_class:
        only = landmarks.landmark[0]
        poses = robot_poses(match, only.xy_m, only.yaw_rad, pan_rad, prior=believed, prior_covariance=covariance)
        return [_plain_pose(pose) for pose in poses]
    placements = landmarks.poses(match, pan_rad, prior=believed, prior_covariance=covariance)
    return [{"landmark": placement.landmark.name, **_plain_pose(placement.pose)} for placement in placements]


def _plain_pose(pose: RobotPose) -> dict[str, Any]:
    covariance = pose.covariance
    std = None if covariance is None else [math.sqrt(max(float(covariance[k, k]), 0.0)) for k in range(3)]
    return {
        "x_m": pose.x_m,
        "y_m": pose.y_m,
        "heading_deg": math.degrees(pose.heading_rad),
        "std": None if std is None else {"x_m": std[0], "y_m": std[1], "heading_deg": math.degrees(std[2])},
        "covariance": None if covariance is None else covariance.tolist(),
        "mahalanobis": _plain(pose.mahalanobis),
    }


def _pose_text(pose: Mapping[str, Any]) -> str:
    """Return a pose as text, each number ± its standard deviation where there is one."""
    name = f"{pose['landmark']}: " if "landmark" in pose else ""
    std = pose["std"]
    if std is None:
        return f"{name}({pose['x_m']:.3f}, {pose['y_m']:.3f}) m heading {pose['heading_deg']:.2f}°"
    return (
        f"{name}({pose['x_m']:.4f} ± {std['x_m']:.4f}, {pose['y_m']:.4f} ± {std['y_m']:.4f}) m"
        f" heading {pose['heading_deg']:.2f} ± {std['heading_deg']:.2f}°"
    )


_FREE = {"bearing": "bearing_rad", "height": "height_m"}


def _estimated(answer: dict[str, Any], value: float, name: str, scale: float, form: str) -> str:
    """Return one parameter of a match as text: with its standard deviation if the match is accepted and has one."""
    from phasemark.render.integral.rounding import with_error

    if not answer["accepted"] or answer["covariance"] is None:
        return f"{value:{form}}"
    k = answer["free"].index(name)
    return with_error(value, scale * math.sqrt(answer["covariance"][k][k]))


def _refusal(answer: dict[str, Any]) -> str:
    """Return the word for a refused match, and why it is refused."""
    return "refused" + (f": {answer['reason']}" if answer["reason"] and answer["class"] is not None else "")


def _match_rows(answers: Sequence[dict[str, Any]], start: int, moving: bool) -> list[dict[str, str]]:
    """Return one row of the table a match, by column."""
    rows = []
    for k, answer in enumerate(answers, start):
        found = answer["class"] is not None
        row = {"frame" if moving else "position": str(k)}
        if "time_s" in answer:
            row["time (s)"] = f"{answer['time_s']:.3f}"
        row |= {
            "class": answer["class"] or "no landmark",
            "D (m)": _estimated(answer, answer["distance_m"], "distance_m", 1.0, ".3f") if found else "",
            "δ (°)": _estimated(answer, answer["delta_deg"], "delta_rad", 180 / math.pi, ".2f") if found else "",
            "accepted": "yes" if answer["accepted"] else _refusal(answer),
            "p": "" if answer["p_value"] is None else f"{answer['p_value']:.3g}",
            "robot": "  or  ".join(_pose_text(pose) for pose in answer.get("poses", ())),
        }
        rows.append(row)
    return rows


def _load_landmark(
    name_or_file: str, unit: str | None, up: str, origin: str, *, from_catalog: bool = False
) -> tuple[str, Trimesh]:
    """Return the name and mesh of a class of the catalogue, or of a mesh file."""
    from phasemark.landmarks import build_mesh, catalog, read_mesh

    specs = catalog()
    if name_or_file in specs:
        return name_or_file, build_mesh(specs[name_or_file])
    path = Path(name_or_file)
    if from_catalog or not (path.suffix or path.exists()):
        raise UsageError(f"unknown class '{name_or_file}': the catalogue has {', '.join(specs)}")
    return path.stem, read_mesh(path, unit=unit, up=up, origin=origin)


def _name_and_file(text: str) -> tuple[str, str]:
    """Split NAME=FILE."""
    name, separator, path = text.partition("=")
    if not (name and separator and path):
        raise UsageError(f"--mesh must be NAME=FILE, got '{text}'")
    return name, path


def _with_symmetry(meshes: Sequence[MeshPlan], found: Sequence[MeshPlan]) -> tuple[MeshPlan, ...]:
    """Return the meshes of a plan with the symmetry found for each, and say it where none was stated."""
    from phasemark.landmarks import MAX_SYMMETRY

    for before, after in zip(meshes, found, strict=True):
        if before.symmetry is not None or after.symmetry is None:
            continue
        if after.symmetry == MAX_SYMMETRY:
            what = "is a body of revolution: no side of it can be told from another, and one δ is enough"
        elif after.symmetry > 1:
            what = f"looks the same every {360 / after.symmetry:g}° (symmetry {after.symmetry}): δ is known modulo that"
        else:
            what = (
                "has no symmetry about its axis z' (if it has one about another, --origin base brings z' into the"
                " middle of its bounding box)"
            )
        _tell(f"note: '{after.name}' {what}; --symmetry N, or 'symmetry' in a plan, overrides this")
    return tuple(one.model_copy(update={"symmetry": other.symmetry}) for one, other in zip(meshes, found, strict=True))


def _stated_unit(path: str, unit: str | None) -> Any:
    """Return the unit, or let the mesh reader say what the extents would be in each."""
    if unit is None:
        from phasemark.landmarks import read_mesh

        read_mesh(path, unit=None)
    return unit


def _background(wall: float | None, floor: float | None) -> Background | None:
    from phasemark.render import Background

    return None if wall is None and floor is None else Background(wall_m=wall, floor_m=floor)


def _note_too_far(sensor: Sensor, distances_m: Mapping[str, float | None]) -> None:
    """Write a note for each distance that the sensor shows wrapped, or not at all."""
    for name, distance_m in distances_m.items():
        described = None if distance_m is None else sensor.describe_beyond_range(name, distance_m)
        if described is not None:
            _tell(f"note: {described}")


def _note_plan_too_far(plan: ScenePlan | DrivePlan) -> None:
    """Write a note for each key of a plan with distances that the sensor shows wrapped, or not at all."""
    distances_m = {f"'{name}'": distance_m for name, distance_m in plan.greatest_distances_m().items()}
    _note_too_far(plan.build_sensor(), distances_m)


def _make_folder(path: Path) -> None:
    """Make a folder for outputs, and those above it; one that is there already will do."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise UsageError(f"{path}: is no folder, or lies in something that is none") from None


def _refuse_inputs(outputs: Iterable[Path], plan: BaseModel | None = None) -> None:
    """Refuse outputs that are the same file as an argument of the running command, or as one that a plan names."""
    from phasemark.data.files.same_file import named_files, refuse_inputs

    of_plan = () if plan is None else named_files(plan.model_dump())
    refuse_inputs(outputs, [*_inputs.get(), *of_plan])


@contextmanager
def _output_folder(
    folder: Path,
    command: str,
    names: Sequence[str],
    force: bool,
    plan: BaseModel | None = None,
    *,
    also: Sequence[str] = (),
) -> Iterator[None]:
    """Hold a folder while a command writes files into it; a file that another program wrote is not replaced.

    `names` must not exist unless they are ours and `force` is set; `also` are ours too, and looked at by their writer.
    """
    from phasemark.data.files.folder_marker import adding_to_folder

    _refuse_existing([folder / name for name in names], force, plan)
    with adding_to_folder(folder, command) as ours:
        ours.claim(*names, *also)
        yield


def _refuse_existing(paths: Sequence[Path], force: bool, plan: BaseModel | None = None) -> None:
    """Refuse outputs that are inputs, or exist, before any work is done."""
    _refuse_inputs(paths, plan)
    for path in paths:
        if path.is_dir():
            raise UsageError(f"{path}: is a folder, give the name of a file")
        if path.exists() and not force:
            raise OutputExistsError(f"{path}: exists already; --force replaces it")


_PROGRESS_SECONDS = 10.0
"""Time between two lines of progress where stderr is no terminal; work that takes less writes none."""


def _refuse_unwritable(paths: Iterable[Path], force: bool) -> None:
    """Refuse outputs that exist or cannot be written, before any work is done."""
    from phasemark.data.files.atomic_write import refuse_unwritable

    _refuse_existing(paths := list(paths), force)
    for path in paths:
        refuse_unwritable(path, force=force)


class _Progress:
    """Progress on stderr, reported by a call with (done, total): a bar on a terminal, a line now and then elsewhere.

    The lines come from a thread of their own, so that work which reports nothing for long is heard of all the same.
    """

    def __init__(self, what: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._what, self._clock = what, clock
        self._bar: Progress | None = None
        self._reported: tuple[int, int] | None = None
        self._ended = threading.Event()
        self._lines: threading.Thread | None = None

    def __enter__(self) -> Callable[[int, int], None]:
        if not sys.stderr.isatty():
            self._begun = self._clock()
            self._lines = threading.Thread(target=self._write_lines, daemon=True)
            self._lines.start()
            return self._note
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        # results printed meanwhile go above the bar, but not where standard output is no terminal
        redirect = sys.stdout.isatty()
        self._bar = Progress(*columns, console=Console(stderr=True), transient=True, redirect_stdout=redirect)
        self._bar.start()
        task = self._bar.add_task(self._what, total=None)
        bar = self._bar
        return lambda done, total: bar.update(task, completed=done, total=total)

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()
        self._ended.set()
        if self._lines is not None:
            self._lines.join()

    def _note(self, done: int, total: int) -> None:
        self._reported = done, total

    def _write_lines(self) -> None:
        while not self._ended.wait(_PROGRESS_SECONDS):
            _tell(self._line())

    def _line(self) -> str:
        done = "" if self._reported is None else f" {self._reported[0]}/{self._reported[1]},"
        return f"{self._what}:{done} {_duration(self._clock() - self._begun)} elapsed"


def _duration(seconds: float) -> str:
    """Write a time in whole seconds, minutes and hours."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _describe_upper(spec: LandmarkSpec) -> str:
    if spec.upper is None:
        return "none"
    fields = spec.upper.model_dump(exclude={"kind", "profile_m"})
    return " ".join([spec.upper.kind, *(f"{key.removesuffix('_m')} {value:g}" for key, value in fields.items())])


def _echo_facts(facts: Mapping[str, Any]) -> None:
    """Print one fact a line, names aligned."""
    width = max(map(len, facts))
    for key, value in facts.items():
        if isinstance(value, Mapping):
            value = ", ".join(f"{k} {v}" for k, v in value.items())
        elif isinstance(value, list | tuple):
            value = ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in value)
        elif isinstance(value, float):
            value = f"{value:.6g}"
        typer.echo(f"{key.replace('_', ' ').ljust(width)}  {value}")


@contextmanager
def _warnings_as_notes() -> Iterator[None]:
    """Write each thing the library warns of as one line, ``note: …``, to stderr."""

    def show(message: Warning | str, *where: object, **more: object) -> None:
        _tell(f"note: {_one_line(str(message))}")

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show
        yield


def _load_sensor(name_or_file: str) -> Sensor:
    """Return a preset, or the sensor of a file; a preset's name wins over a file of that name."""
    from phasemark.render import Sensor, preset, preset_names

    if name_or_file in preset_names():
        return preset(name_or_file)
    path = Path(name_or_file)
    if path.suffix == ".toml" or path.exists():
        return Sensor.from_toml(path)
    raise UsageError(f"unknown sensor '{name_or_file}': give {', '.join(preset_names())}, or a .toml file")


def _sensor_facts(sensor: Sensor) -> dict[str, Any]:
    return {**sensor.model_dump(mode="json"), "unambiguous_range_m": sensor.unambiguous_range_m}


def _value_and_error_of(value: object, estimate: Estimate) -> tuple[str, str]:
    """Write a fitted field and its standard error, rounded alike; pixels are counted and have no error."""
    from phasemark.render.integral.rounding import value_and_error

    if estimate.std_error is None:
        return _short(value), "assumed"
    text, error = value_and_error(value if isinstance(value, float) else estimate.value, estimate.std_error)
    return (text if isinstance(value, float) and error else _short(value)), error


def _short(value: object) -> str:
    """Write a field's value for a table; a list of pixels as their number."""
    if isinstance(value, float):
        return f"{value:.5g}"
    return f"{len(value)} in all" if isinstance(value, list) else str(value)


def _plain(value: str | int | float) -> str | int | float | None:
    """Return None for a number that JSON does not have."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _echo_json(value: object) -> None:
    """Print a result for machines; NaN and infinity are no JSON and must have become null before."""
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False))


def _echo_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print aligned columns."""
    table = [header, *rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for row in table:
        typer.echo("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


class _Table:
    """Aligned columns that are printed in pieces: the header with the first, and later ones as wide at least."""

    def __init__(self) -> None:
        self._widths: list[int] = []

    def echo(self, rows: Sequence[Mapping[str, str]]) -> None:
        """Print some rows."""
        table = [list(row.values()) for row in rows]
        if not self._widths:
            table.insert(0, list(rows[0]))
            self._widths = [0] * len(table[0])
        self._widths = [
            max(width, *map(len, column)) for width, column in zip(self._widths, zip(*table, strict=True), strict=True)
        ]
        for row in table:
            typer.echo("  ".join(cell.ljust(width) for cell, width in zip(row, self._widths, strict=True)).rstrip())


def _report_error(message: str) -> None:
    """Write one line, ``error: …``, to stderr; red where stderr is a terminal."""
    from rich.console import Console
    from rich.text import Text

    with _messages_may_be_lost():
        Console(stderr=True).print(Text.assemble(("error: ", "bold red"), _one_line(message)), soft_wrap=True)


def _tell(message: str) -> None:
    """Write a line to stderr."""
    with _messages_may_be_lost():
        typer.echo(message, err=True)


@contextmanager
def _messages_may_be_lost() -> Iterator[None]:
    """Let messages to a stderr that takes none be lost: they change neither the work nor its exit code."""
    try:
        yield
    except (OSError, ValueError):
        with suppress(OSError, ValueError):  # what is left in the buffer must not fail at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


def _one_line(message: str) -> str:
    r"""Return a message without line breaks and control characters; bytes of a name that are not UTF-8 as ``\xNN``."""
    return "".join(char if char.isprintable() else " " for char in _readable(message))


def _readable(name: str) -> str:
    r"""Return text that can be written as UTF-8: bytes of a file's name that are not become ``\xNN``."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def _open_closed_streams() -> None:
    """Open the null device for standard streams that are closed, or the next file would take their numbers."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))


def _terminate(signum: int, frame: FrameType | None) -> None:
    """Unwind the stack, so that temporary files are removed, and exit like a process that the signal ended."""
    raise SystemExit(128 + signum)


def _run(arguments: list[str]) -> None:
    """Parse and run one command; typer's own errors become ours."""
    command = typer.main.get_command(app)
    if _NO_VERIFY in arguments:  # an option of the program, which users put behind the command as well
        arguments = [_NO_VERIFY, *(word for word in arguments if word != _NO_VERIFY)]
    try:
        with command.make_context("phasemark", arguments) as context:
            command.invoke(context)
    except typer.Exit:  # --help and --version: no command of ours ends with a code of its own
        pass
    except typer.TyperException as error:
        failed_in: typer.Context | None = getattr(error, "ctx", None)
        path = "phasemark" if failed_in is None else failed_in.command_path
        raise UsageError(f"{error.format_message().rstrip('.')}: see '{path} --help'") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Parameters
    ----------
    arguments : sequence of str, optional
        What follows the program's name; ``sys.argv[1:]`` if not given.

    Returns
    -------
    int
        0 done, 2 wrong usage, 3 bad input file, 4 the output exists, 5 disk or I/O, 130 interrupted, 141 the reader
        of a pipe went away. SIGTERM ends the process with 143. Any other exception is a bug of ours: it passes, and
        Python prints its traceback and exits with 1.
    """
    signal.signal(signal.SIGTERM, _terminate)
    _open_closed_streams()
    if arguments is None and _COMPLETION in os.environ:  # the shell asks what may follow
        app(prog_name="phasemark")
    os.environ.setdefault("HDF5_PLUGIN_PRELOAD", "::")  # before HDF5 is loaded: no file makes it load code
    # before NumPy is: its small products gain nothing from threads that fight our workers' for the processors
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ["MPLBACKEND"] = "agg"  # pictures become files: a window that is not there is no reason to fail
    from phasemark.inputs import pipes_read_once

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a terminal without '×' or 'σ' is no reason to fail
    try:
        try:
            with _warnings_as_notes(), pipes_read_once():
                _run(list(sys.argv[1:] if arguments is None else arguments))
        finally:
            sys.stdout.flush()
    except PhasemarkError as error:
        for note in getattr(error, "__notes__", ()):  # the traceback of a user's own code
            _tell(note)
        _report_error(str(error))
        return error.exit_code
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python's own flush at exit fails again
        return 128 + signal.SIGPIPE
    except OSError as error:
        _report_error(": ".join(str(part) for part in (error.filename, error.strerror or error) if part))
        return StorageError.exit_code
    except KeyboardInterrupt:
        _report_error("interrupted")
        return 128 + signal.SIGINT
    return 0
