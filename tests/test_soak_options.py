"""Every option of every command with odd values, run by `make soak`: an answer or one line, and nothing left behind.

Commands and options are taken from the program itself, so that a new one is covered without a change here.
"""

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from phasemark.cli import app
from phasemark.landmarks import build_mesh, catalog, export_mesh

pytestmark = pytest.mark.soak
PHASEMARK = str(Path(sys.executable).with_name("phasemark"))
SECONDS = 10
BYTES = 2 << 30
CODES = (0, 2, 3, 4, 5)
ODD = (
    "",
    "0",
    "-1",
    "1e308",
    "1e-320",
    "nan",
    "inf",
    "9" * 400,
    "a\tb",
    "=1+1",
    "$x$",
    "x/../..",
    "caf\udce9",
    "/dev/null",
)
SMALL = {
    "bank build": ("--class", "cone", "--distance", "1", "--delta", "0", "-o", "out.h5"),
    "frames build": ("plan.toml", "-o", "out.h5"),
    "frames simulate": ("--class", "cone", "--frames", "1", "-o", "out.csv"),
    "landmark check": ("mesh.stl", "--unit", "m"),
    "landmark export": ("cone", "-o", "out.stl"),
    "landmark list": (),
    "landmark show": ("cone", "-o", "out"),
    "plan check": ("plan.toml",),
    "plan example": ("bank",),
    "plan schema": ("bank",),
    "render": ("--class", "cone", "-o", "out.png"),
    "sensor list": (),
    "sensor show": ("ideal",),
}
"""Arguments with which a command does little; others get the option alone, and mostly say what is missing."""


def commands(group, path=()):
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*path, name))
        else:
            yield (*path, name), command


CASES = [
    (path, option.opts[-1], option.nargs if not getattr(option, "is_flag", False) else 0)
    for path, command in commands(typer.main.get_command(app))
    for option in command.params
    if option.opts[-1].startswith("--") and option.opts[-1] != "--help"
]


def limited():
    resource.setrlimit(resource.RLIMIT_DATA, (BYTES, BYTES))


def outcome(arguments, folder):
    """Run one command; return what is wrong with how it ended, or None."""
    before = set(os.listdir(folder))
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            [PHASEMARK, *arguments], cwd=folder, env=environment, preexec_fn=limited, timeout=SECONDS,
            stdin=subprocess.DEVNULL, capture_output=True,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"took more than {SECONDS} s"
    lines = [line for line in done.stderr.decode("utf-8", "replace").splitlines() if not line.startswith("note: ")]
    if done.returncode not in CODES:
        return f"exit code {done.returncode}: {lines[-1:]}"
    if done.returncode and (len(lines) != 1 or not lines[0].startswith("error: ")):
        return f"{len(lines)} lines of error: {lines[-1:]}"
    left = set(os.listdir(folder)) - before
    if done.returncode and left:
        return f"left {sorted(left)} behind"
    return None


@pytest.mark.parametrize(
    ("path", "option", "count"), CASES, ids=[f"{' '.join(path)} {name}" for path, name, _ in CASES]
)
def test_an_odd_value_is_answered_or_refused_in_one_line(path, option, count, tmp_path):
    wrong = {}
    for k, value in enumerate(ODD if count else ("",)):
        folder = tmp_path / str(k)
        folder.mkdir()
        (folder / "plan.toml").write_text('views = 1\nclasses = ["cone"]\n', encoding="utf-8")
        (folder / "mesh.stl").write_bytes(export_mesh(build_mesh(catalog()["cone"]), "stl"))
        given = [f"{option}={value}"] if count == 1 else [option, *[value] * count]
        found = outcome([*path, *SMALL.get(" ".join(path), ()), *given], folder)
        if found is not None:
            wrong[value[:20]] = found
    assert not wrong
