"""Every option of every command with odd values, run by `make soak`: an answer or one line, and nothing left behind.

Commands and options are taken from the program itself, so that a new one is covered without a change here.
"""

import math
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from builders import error_lines

from phasemark.cli import app
from phasemark.landmarks import build_mesh, catalog, export_mesh
from phasemark.render import Renderer, Views, capture, preset
from phasemark.render.direct import expected_counts, footprint_grid, plane_samples, range_axis, zone_transients

pytestmark = pytest.mark.soak
PHASEMARK = str(Path(sys.executable).with_name("phasemark"))
SECONDS = 10
BYTES = 2 << 30
CODES = (0, 2, 3, 4, 5)
ODD = (
    "", "0", "-1", "1e308", "1e-320", "nan", "inf", "9" * 400, "a\tb", "=1+1", "$x$", "x/../..", "caf\udce9",
    "/dev/null",
)  # fmt: skip
VALUES = 2
"""Odd values that each option is tried with, some 460 runs: all of them on every option would take an hour."""
SMALL = {
    "accuracy": ("--class", "cylinder", "--distance", "1"),
    "bank build": ("--class", "cone", "--distance", "1", "--delta", "0", "-o", "out.h5"),
    "bank info": ("bank.h5",),
    "bank merge": ("bank1.h5", "bank2.h5", "-o", "out.h5"),
    "bank strangers": ("bank.h5", "--population", "1"),
    "bank verify": ("bank.h5", "--sample", "1"),
    "calibrate": ("cone", "poses.npz", "--poses", "poses.csv", "-o", "out.toml"),
    "demo": ("-o", "out"),
    "drive": ("drive.toml", "-o", "out"),
    "frames build": ("plan.toml", "-o", "out.h5"),
    "frames export": ("frames.h5", "--to", "npz", "-o", "out.npz"),
    "frames import": ("board.csv", "-o", "out.npz", "--unit", "m", "--quantity", "range"),
    "frames info": ("frames.h5",),
    "frames merge": ("frames1.h5", "frames2.h5", "-o", "out.h5"),
    "frames show": ("frames.h5", "-o", "out.png"),
    "frames simulate": ("--class", "cone", "--frames", "1", "-o", "out.csv"),
    "frames verify": ("frames.h5", "--sample", "1"),
    "landmark check": ("mesh.stl", "--unit", "m"),
    "landmark design": ("design.toml", "-o", "out"),
    "landmark export": ("cone", "-o", "out.stl"),
    "landmark list": (),
    "landmark show": ("cone", "-o", "out"),
    "match": ("bank.h5", "frames.h5", "--no-diagnosis"),
    "plan check": ("plan.toml",),
    "pose report": ("estimates.csv", "simulated.csv"),
    "render": ("--class", "cone", "-o", "out.png"),
    "sensor characterise": ("ideal", "--frames", "2", "-o", "out"),
    "sensor fit": ("board.csv", "--distance", "1", "--unit", "m", "--quantity", "range", "-o", "out.toml"),
    "sensor fit-direct": ("plane.npz", "-o", "out.toml"),
    "sensor import": ("camera.yaml", "-o", "out.toml"),
    "sensor list": (),
    "sensor show": ("ideal",),
    "sweep compare": ("sweep", "sweep"),
    "sweep frames": ("sweep", "0", "0", "-o", "out.npz"),
    "sweep report": ("sweep",),
    "sweep run": ("sweep.toml", "-o", "out"),
    "warm": (),
}
"""Arguments with which a command does little."""
LONG = {
    "demo": 60, "landmark design": 40, "drive": 30, "sweep run": 30, "sweep report": 30, "calibrate": 120,
    "sensor fit-direct": 60, "warm": 120, "match": 60, "bank strangers": 120,
}  # fmt: skip
"""Seconds of commands that cannot do little, while another test runs beside them."""
CAMERA = """image_width: 16
image_height: 12
distortion_model: plumb_bob
camera_matrix: {rows: 3, cols: 3, data: [20, 0, 7.5, 0, 20, 5.5, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0, 0, 0, 0]}
"""
PLAN = 'views = 1\nclasses = ["cone"]\n'
DESIGN = "n_classes = 2\n[sampling]\ndistances = 2\ndelta_step_deg = 15\n[search]\nboxes = 4\nuppers = 8\nstep_mm = 3\n"
DRIVE = """[map]
room_m = [[0, 0], [4, 0], [4, 3], [0, 3]]
[[map.landmark]]
name = "a"
class = "cone"
x_m = 2
y_m = 2
yaw_deg = 30
[path]
waypoints_m = [[1, 1], [1.5, 1]]
"""
SWEEP = """name = "small"
trials = 2
classes = ["cone"]
[axes]
distance_m = [1.0]
delta_deg = [45.0]
[[methods]]
name = "nearest"
method = "nearest"
bank_step = [0.1, 15.0]
"""


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


def odd_values(case):
    """Return those values of a case that its option is tried with; over all cases each value has its turn."""
    return [ODD[(case * VALUES + k) % len(ODD)] for k in range(VALUES)]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder of small inputs of every command, made by commands, which fill Numba's cache as well."""
    folder = tmp_path_factory.mktemp("inputs")
    rng = np.random.default_rng(0)
    for name, text in (("plan", PLAN), ("design", DESIGN), ("drive", DRIVE), ("sweep", SWEEP)):
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    (folder / "camera.yaml").write_text(CAMERA, encoding="utf-8")
    direct, distance_m = preset("tmf8820-3x3"), np.linspace(0.1, 0.4, 12)
    axis = range_axis(direct, longest_m=1.0)
    seen = zone_transients(plane_samples(distance_m, footprint_grid(direct)), direct, axis)
    counts = rng.poisson(expected_counts(seen, direct, axis, 0.8))
    np.savez(folder / "plane.npz", histogram=counts.astype(np.uint32), distance_m=distance_m)
    (folder / "mesh.stl").write_bytes(export_mesh(build_mesh(catalog()["cone"]), "stl"))
    np.savetxt(folder / "board.csv", 1 + 0.01 * rng.standard_normal((10, 256)), delimiter=",", fmt="%.4f")
    poses = [(0.8 + 0.1 * k, 45.0 * k) for k in range(8)]
    rows = [f"{distance_m:.1f},{delta_deg:g},5" for distance_m, delta_deg in poses]
    (folder / "poses.csv").write_text("\n".join(["distance_m,delta_deg,frames", *rows]), encoding="utf-8")
    sensor = preset("pmd-16x16")
    views = Views.broadcast([d for d, _ in poses], [math.radians(delta) for _, delta in poses])
    image = Renderer(build_mesh(catalog()["cone"]), sensor).render_views(views)
    taken = capture(image, sensor, rng=rng, n_frames=5)
    shape = (-1, sensor.rows, sensor.cols)
    arrays: dict[str, Any] = {"range": taken.range_m, "amplitude": taken.amplitude_e, "intensity": taken.intensity_e}
    arrays = {name: values.reshape(shape) for name, values in arrays.items()}
    np.savez(folder / "poses.npz", unit="m", quantity="range", **arrays)
    grid = "--class cone --distance 1 --delta 0:80:10"
    for command in (
        f"bank build {grid} -o bank.h5",
        f"bank build {grid} --shard 1/2 -o bank1.h5",
        f"bank build {grid} --shard 2/2 -o bank2.h5",
        "frames build plan.toml -o frames.h5",
        "frames build plan.toml --views 2 --shard 1/2 -o frames1.h5",
        "frames build plan.toml --views 2 --shard 2/2 -o frames2.h5",
        "sweep run sweep.toml -o sweep",
        "frames simulate --class cone --frames 3 --distance 1 -o simulated.csv",
        "match bank.h5 simulated.csv --moving --no-diagnosis --estimates estimates.csv",
    ):
        subprocess.run([PHASEMARK, *command.split()], cwd=folder, check=True, capture_output=True)
    return folder


def limited():
    resource.setrlimit(resource.RLIMIT_DATA, (BYTES, BYTES))


def files(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def outcome(arguments, place, seconds):
    """Run one command in the inmost folder of a place; return what is wrong with how it ended, or None."""
    before = files(place)
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            [PHASEMARK, *arguments], cwd=place / "in" / "here", env=environment, preexec_fn=limited, timeout=seconds,
            stdin=subprocess.DEVNULL, capture_output=True,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"took more than {seconds} s"
    lines = error_lines(done.stderr.decode("utf-8", "replace"))
    if done.returncode not in CODES:
        return f"exit code {done.returncode}: {lines[-1:]}"
    if done.returncode and (len(lines) != 1 or not lines[0].startswith("error: ")):
        return f"{len(lines)} lines of error: {lines[-1:]}"
    left = files(place) - before
    if done.returncode and left:
        return f"left {sorted(left)} behind"
    return None


def test_every_command_with_an_option_is_given_its_arguments(inputs):
    assert {" ".join(path) for path, _, _ in CASES} <= set(SMALL)
    for words in ("bank info", "frames info", "match", "sweep compare", "sweep frames", "sensor fit", "calibrate"):
        place = inputs / "place" / words
        shutil.copytree(inputs, place / "in" / "here", ignore=shutil.ignore_patterns("place"))
        command = [PHASEMARK, *words.split(), *SMALL[words]]
        done = subprocess.run(command, cwd=place / "in" / "here", capture_output=True, text=True, check=False)
        assert done.returncode == 0 or words in ("sensor fit", "calibrate"), (words, done.stderr)
        print(words, done.returncode, done.stderr[-300:])
    assert {value for case in range(len(CASES)) for value in odd_values(case)} == set(ODD)


@pytest.mark.parametrize("case", range(len(CASES)), ids=[f"{' '.join(path)} {name}" for path, name, _ in CASES])
def test_an_odd_value_is_answered_or_refused_in_one_line(case, inputs, tmp_path):
    path, option, count = CASES[case]
    words, wrong = " ".join(path), {}
    for k, value in enumerate(odd_values(case) if count else ("",)):
        place = tmp_path / str(k)  # two folders deeper the command runs, for values that lead out of its folder
        shutil.copytree(inputs, place / "in" / "here", ignore=shutil.ignore_patterns("place"))
        given = [f"{option}={value}"] if count == 1 else [option, *[value] * count]
        found = outcome([*path, *SMALL[words], *given], place, LONG.get(words, SECONDS))
        shutil.rmtree(place)
        if found is not None:
            wrong[value[:20]] = found
    assert not wrong
