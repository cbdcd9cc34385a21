"""The command line: the commands of the rooms under their words, the streams, and the exit codes.

Each command turns arguments into a plan, makes one library call, and prints a path or a table: results to stdout,
messages and progress to stderr. :func:`main` turns every error the user can mend into one line and its exit code.
"""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Annotated

import typer

from phasemark import PhasemarkError, StorageError, UsageError, __version__
from phasemark.data.commands import bank, frames, landmark, render, sensor
from phasemark.data.commands.command import Commands
from phasemark.data.commands.console import report_error, tell, warnings_as_notes
from phasemark.data.commands.interruption import Interruption
from phasemark.matcher.commands import (
    accuracy,
    bank_trials,
    calibrate,
    characterise,
    live,
    locate,
    match,
    plan,
    pose,
    sweep,
    warm,
)

__all__ = ["app", "main"]
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
  know the accuracy      phasemark accuracy --class cylinder --distance 1.5     in full: phasemark sweep run paper
  drive a robot          phasemark drive
  follow a board's pose  phasemark live /dev/ttyUSB0 --landmark part.stl --part-unit mm --sensor vl53l5cx-8x8

phasemark --help lists all commands, COMMAND --help explains one, --install-completion teaches them to your shell.
"""
app = Commands(
    name="phasemark",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


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


def _add_commands(group: str, purpose: str, *functions: Callable[..., None]) -> None:
    """Add functions as commands, in the order in which help lists them.

    A command of a group is called as its function, without the name of the group; ``sensor_fit_direct`` becomes
    ``sensor fit-direct``. Without a group it is called by the first word: ``match_frames`` becomes ``match``.
    """
    commands = Commands(help=purpose) if group else app
    for function in functions:
        word = function.__name__.removeprefix(f"{group}_") if group else function.__name__.partition("_")[0]
        commands.command(word.replace("_", "-"))(function)
    if group:
        app.add_typer(commands, name=group)


_add_commands(
    "", "",
    render.render_frame, match.match_frames, calibrate.calibrate_camera, locate.locate_rig, accuracy.accuracy_line,
    sweep.demo_report, plan.drive_robot, live.live_poses, warm.warm_kernels,
)  # fmt: skip
_add_commands(
    "landmark", "The landmarks: the catalogue and mesh files.",
    landmark.landmark_list, landmark.landmark_show, landmark.landmark_export, plan.landmark_design,
    landmark.landmark_check,
)  # fmt: skip
_add_commands(
    "sensor", "The cameras: shipped presets and sensor files.",
    sensor.sensor_list, sensor.sensor_show, sensor.sensor_import, characterise.sensor_characterise, sensor.sensor_fit,
    sensor.sensor_fit_direct,
)  # fmt: skip
_add_commands(
    "bank", "Banks of model images.",
    bank.bank_build, bank.bank_info, bank_trials.bank_verify, bank_trials.bank_strangers, bank.bank_merge,
)  # fmt: skip
_add_commands(
    "sweep", "Accuracy sweeps: errors of each method over conditions, with intervals.",
    sweep.sweep_run, sweep.sweep_report, sweep.sweep_frames, sweep.sweep_compare,
)  # fmt: skip
_add_commands("pose", "Measured poses against true ones.", pose.pose_report)
_add_commands(
    "frames", "Sets of noisy frames with their truth.",
    frames.frames_build, frames.frames_info, frames.frames_verify, frames.frames_merge, frames.frames_export,
    frames.frames_import, frames.frames_simulate, frames.frames_show,
)  # fmt: skip
_add_commands(
    "plan", "Plans: what banks and frame sets are built from, and sweeps and drives run from.",
    plan.plan_example, plan.plan_schema, plan.plan_check,
)  # fmt: skip


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
        message = (
            error.format_message().rstrip(".").replace("Value error, ", "", 1)
        )  # the words of a validator of typer's
        raise UsageError(f"{message}: see '{path} --help'") from None


def _set_up_libraries() -> None:
    """Set what libraries look at when they are imported."""
    os.environ.setdefault("HDF5_PLUGIN_PRELOAD", "::")  # before HDF5 is loaded: no file makes it load code
    # before NumPy is: its small products gain nothing from threads that fight our workers' for the processors
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ["MPLBACKEND"] = "agg"  # pictures become files: a window that is not there is no reason to fail


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
    _open_closed_streams()
    if arguments is None and _COMPLETION in os.environ:  # the shell asks what may follow
        app(prog_name="phasemark")
    _set_up_libraries()
    from phasemark.inputs import pipes_read_once

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a terminal without '×' or 'σ' is no reason to fail
    try:
        try:
            with Interruption() as interruption, warnings_as_notes(), pipes_read_once():
                _run(list(sys.argv[1:] if arguments is None else arguments))
                interruption.raise_waiting()
        finally:
            sys.stdout.flush()
    except PhasemarkError as error:
        for note in getattr(error, "__notes__", ()):  # the traceback of a user's own code
            tell(note)
        report_error(str(error))
        return error.exit_code
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python's own flush at exit fails again
        return 128 + signal.SIGPIPE
    except OSError as error:
        report_error(": ".join(str(part) for part in (error.filename, error.strerror or error) if part))
        return StorageError.exit_code
    except KeyboardInterrupt:
        report_error("interrupted")
        return 128 + signal.SIGINT
    return 0
