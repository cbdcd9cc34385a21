"""The command line: arguments to a plan, one library call, a path or a table printed.

Results go to stdout, messages and progress to stderr. Heavy imports stand inside the commands, so that
``phasemark --help`` answers at once. :func:`main` turns every error the user can mend into one line and its exit code.
"""

from __future__ import annotations

import io
import json
import os
import signal
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from phasemark import PhasemarkError, StorageError, UsageError, __version__

if TYPE_CHECKING:
    from types import FrameType

    from phasemark.render import Sensor

__all__ = ["app", "main"]

_FIRST_STEPS = """\
phasemark renders, banks and matches what a low-resolution time-of-flight camera sees of a 3D landmark.

Start with
  phasemark sensor list             the cameras that are shipped
  phasemark sensor show pmd-16x16   one of them, as a sensor file to edit
  phasemark --help                  all commands; COMMAND --help explains one
"""

app = typer.Typer(
    name="phasemark",
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_sensor_app = typer.Typer(help="The cameras: shipped presets and sensor files.")
app.add_typer(_sensor_app, name="sensor")

_Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]


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
) -> None:
    """Render, bank and match what a low-resolution time-of-flight camera sees of a 3D landmark."""
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
                f"{sensor.modulation_hz / 1e6:g} MHz",
                f"{sensor.unambiguous_range_m:.3f} m",
            )
            for name, sensor in sensors.items()
        ),
    )


@_sensor_app.command("show")
def _sensor_show(
    name_or_file: Annotated[str, typer.Argument(metavar="NAME|FILE", help="A preset, or a sensor file (.toml).")],
    as_json: _Json = False,
) -> None:
    """Print every field of a sensor; the text is a sensor file again."""
    sensor = _load_sensor(name_or_file)
    if as_json:
        _echo_json({"name": name_or_file, **_sensor_facts(sensor)})
        return
    typer.echo(f"# unambiguous range {sensor.unambiguous_range_m:.4f} m, {sensor.metres_per_radian:.6f} m per radian")
    for key, value in sensor.model_dump(mode="json").items():
        typer.echo(f"# {key} is not set" if value is None else f"{key} = {json.dumps(value)}")


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


def _echo_json(value: object) -> None:
    """Print a result for machines; NaN and infinity are no JSON and must have become null before."""
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False))


def _echo_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print aligned columns."""
    table = [header, *rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for row in table:
        typer.echo("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def _report_error(message: str) -> None:
    """Write one line, ``error: …``, to stderr; red where stderr is a terminal."""
    from rich.console import Console
    from rich.text import Text

    line = "".join(char if char.isprintable() else " " for char in message)
    Console(stderr=True).print(Text.assemble(("error: ", "bold red"), line), soft_wrap=True)


def _terminate(signum: int, frame: FrameType | None) -> None:
    """Unwind the stack, so that temporary files are removed, and exit like a process that the signal ended."""
    raise SystemExit(128 + signum)


def _run(arguments: list[str]) -> None:
    """Parse and run one command; typer's own errors become ours."""
    command = typer.main.get_command(app)
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
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a terminal without '×' or 'σ' is no reason to fail
    try:
        try:
            _run(list(sys.argv[1:] if arguments is None else arguments))
        finally:
            sys.stdout.flush()
    except PhasemarkError as error:
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
