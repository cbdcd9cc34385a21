"""What several tests build or start: cameras of one pixel, images of given phasors, odd meshes, the programs."""

import os
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import ArrayLike, NDArray

from phasemark.render import PhasorImages, Sensor, Views

TESTS = Path(__file__).parent
HELPERS_IN_PATH = {**os.environ, "PYTHONPATH": str(TESTS)}
"""The environment of a process that imports the tests' helpers."""


PROGRESS_LINE = re.compile(r"[a-z ,]+:( \d+/\d+,)?( \d+ (h|min|s))+ elapsed")
"""What long work writes to a standard error that is no terminal."""


def error_lines(stderr: str) -> list[str]:
    """Return the lines of standard error that are neither notes nor progress."""
    return [line for line in stderr.splitlines() if not line.startswith("note: ") and not PROGRESS_LINE.fullmatch(line)]


def run_program(name: str, *arguments: object) -> str:
    """Run a program of tests/programs in a process of its own; return what it prints."""
    command = [sys.executable, "-m", f"programs.{name}", *map(str, arguments)]
    done = subprocess.run(command, env=HELPERS_IN_PATH, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{name} ended with {done.returncode}: {done.stderr[-3000:]}"
    return done.stdout


def one_pixel(**fields: Any) -> Sensor:
    return Sensor(**{"rows": 1, "cols": 1, "half_angle_h_deg": 1, "half_angle_v_deg": 1, **fields})


def measure_only(monkeypatch: pytest.MonkeyPatch, module: str, *names: str) -> None:
    """Leave out the other measurements of a data sheet, of "phase" or "direct" sensors."""
    measures = {
        "phase": ("_photon_transfer", "_range_noise", "_linearity", "_patterns", "_saturation", "_threshold"),
        "direct": ("_range", "_dropout", "_counts", "_merging", "_ambient"),
    }
    for name in measures[module]:
        if name not in names:
            monkeypatch.setattr(f"phasemark.render.bench.data_sheet.{module}.{name}", lambda *_: iter(()))


def images_of(
    phasor: ArrayLike, intensity: ArrayLike, sensor: Sensor, harmonics: dict[int, NDArray[Any]] | None = None
) -> PhasorImages:
    """PhasorImages of given pixels, (n, rows, cols)."""
    values = np.asarray(phasor, complex)
    views = Views.broadcast(np.ones(len(values)))
    return PhasorImages(
        values, np.asarray(intensity, float), np.ones(values.shape), sensor, views, harmonics=harmonics or {}
    )


def pure_image(
    range_m: ArrayLike, sensor: Sensor, amplitude: float = 1.0, intensity: float | None = None
) -> PhasorImages:
    """PhasorImages (n, rows, cols) of unmixed pixels at given ranges, every harmonic that the sensor needs included."""
    phase = np.asarray(range_m, float) / sensor.metres_per_radian
    phase = np.broadcast_to(phase.reshape(-1, 1, 1), (phase.size, sensor.rows, sensor.cols))
    light = np.full(phase.shape, amplitude if intensity is None else intensity, float)
    harmonics = {k: amplitude * np.exp(1j * k * phase) for k in sensor.harmonic_orders}
    return images_of(amplitude * np.exp(1j * phase), light, sensor, harmonics)


def wrapped(difference_m: NDArray[Any], sensor: Sensor) -> NDArray[Any]:
    period = sensor.unambiguous_range_m
    return (difference_m + period / 2) % period - period / 2


def joined(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return several meshes as one, which may run through one another."""
    together = trimesh.util.concatenate(meshes)
    assert isinstance(together, trimesh.Trimesh)
    return together


def strangers() -> dict[str, trimesh.Trimesh]:
    """Return meshes of upper parts that are in no catalogue, on the catalogue's box."""
    box = trimesh.creation.box((0.24, 0.16, 0.15))
    box.apply_translation((0, 0, -0.075))

    def part(x: float, y: float, bottom: float, top: float) -> trimesh.Trimesh:
        return block((-x / 2, x / 2), (-y / 2, y / 2), (bottom, top))

    corners = [[x * 0.075, y * 0.075, 0] for x in (-1, 1) for y in (-1, 1)]
    uppers = {
        "cube": part(0.13, 0.13, 0, 0.15),
        "slab": part(0.05, 0.14, 0, 0.15),
        "table": trimesh.boolean.union([part(0.06, 0.06, 0, 0.1), part(0.14, 0.14, 0.1, 0.15)], engine="manifold"),
        "pyramid": trimesh.convex.convex_hull(np.array([*corners, [0, 0, 0.15]])),
    }
    return {name: trimesh.boolean.union([box, upper], engine="manifold") for name, upper in uppers.items()}


Interval = tuple[float, float]


def block(x: Interval, y: Interval, z: Interval) -> trimesh.Trimesh:
    """Return a box that fills the given intervals of x', y', z'."""
    low, high = np.array([x, y, z], float).T
    mesh: trimesh.Trimesh = trimesh.creation.box(high - low)
    mesh.apply_translation((low + high) / 2)
    return mesh


def sheet(y: Interval, z: Interval, x: float = 0.0) -> trimesh.Trimesh:
    """Return a rectangle without thickness across the axis x', over the given intervals of y' and z'."""
    corners = [[x, y[0], z[0]], [x, y[1], z[0]], [x, y[1], z[1]], [x, y[0], z[1]]]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def bowl(rings: int = 128) -> trimesh.Trimesh:
    """Half a spherical shell without thickness, open at the top."""
    angle = np.linspace(-np.pi / 2, 0, rings)
    return trimesh.creation.revolve(0.12 * np.c_[np.cos(angle), np.sin(angle)].round(15), sections=4 * rings)


def coarse_bowl() -> trimesh.Trimesh:
    """A bowl with facets a quarter of a pixel wide."""
    return bowl(rings=32)


def star_prism() -> trimesh.Trimesh:
    """A seven-pointed star, extruded."""
    turn = np.linspace(0, 2 * np.pi, 15)[:-1]
    rim = np.where(np.arange(14) % 2, 0.06, 0.14)[:, None] * np.c_[np.cos(turn), np.sin(turn)]
    low, high = np.c_[rim, np.full(14, -0.1)], np.c_[rim, np.full(14, 0.1)]
    vertices = np.vstack([low, high, [[0, 0, -0.1], [0, 0, 0.1]]])
    i, j = np.arange(14), np.roll(np.arange(14), -1)
    faces = np.vstack(
        [np.c_[i, j, j + 14], np.c_[i, j + 14, i + 14], np.c_[j, i, i * 0 + 28], np.c_[i + 14, j + 14, i * 0 + 29]]
    )
    return trimesh.Trimesh(vertices, faces, process=False)


def l_bracket() -> trimesh.Trimesh:
    """Two legs at a right angle, as one concave solid."""
    outline = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, -0.05], [-0.05, -0.05], [-0.05, 0.1], [-0.1, 0.1]])
    low, high = np.c_[outline, np.full(6, -0.08)], np.c_[outline, np.full(6, 0.08)]
    cap = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 5], [3, 4, 5]])
    i, j = np.arange(6), np.roll(np.arange(6), -1)
    faces = np.vstack([np.c_[i, j, j + 6], np.c_[i, j + 6, i + 6], cap[:, ::-1], cap + 6])
    return trimesh.Trimesh(np.vstack([low, high]), faces, process=False)


def hidden_box() -> trimesh.Trimesh:
    """A box half hidden by a smaller one before it."""
    near = trimesh.creation.box((0.05, 0.1, 0.1))
    near.apply_translation((-0.15, 0.03, -0.02))
    return joined([near, trimesh.creation.box((0.1, 0.25, 0.2))])


def blob() -> trimesh.Trimesh:
    """A ball whose surface waves gently, with a little noise."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    x, y, _ = ball.vertices.T
    noise = np.random.default_rng(3).normal(size=len(x))
    radius = 0.1 * (1 + 0.05 * np.sin(3 * x) * np.cos(2 * y + 1) + 2e-5 * noise)
    return trimesh.Trimesh(ball.vertices * radius[:, None], ball.faces, process=False)


def _bumpy(unit: trimesh.Trimesh, noise_m: float) -> NDArray[Any]:
    """Return a lump of 10 cm with bumps of a few centimetres, from the vertices and faces of a unit ball."""
    x, y, z = unit.vertices.T
    bumps = 0.08 * np.sin(3 * x + 1) * np.cos(2 * y) + 0.04 * np.sin(5 * z) * np.cos(4 * x)
    noise = noise_m * np.random.default_rng(4).normal(size=len(x))
    radius: NDArray[np.float64] = 0.1 * (1 + bumps) + noise
    return np.asarray(unit.vertices * radius[:, None])


def lump(subdivisions: int = 7) -> trimesh.Trimesh:
    """A bumpy ball of 330 000 faces, its bumps finer than a pixel from 2 m away."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return trimesh.Trimesh(_bumpy(ball, 0.0), ball.faces, process=False)


def scan() -> trimesh.Trimesh:
    """Return what a laser scanner makes of a lump: 200 000 faces, noise on every vertex, and no floor."""
    ball = trimesh.creation.uv_sphere(radius=1.0, count=(256, 256))
    vertices = _bumpy(ball, 2e-6)
    kept = vertices[ball.faces][..., 2].min(axis=1) > -0.085
    return trimesh.Trimesh(vertices, ball.faces[kept], process=False)


ODD: dict[str, Callable[[], trimesh.Trimesh]] = {
    "bowl": bowl,
    "coarse bowl": coarse_bowl,
    "star prism": star_prism,
    "L bracket": l_bracket,
    "hidden box": hidden_box,
    "blob": blob,
    "lump": lump,
    "scan": scan,
}


def cut_alike(monkeypatch: pytest.MonkeyPatch, sensor: Sensor) -> None:
    """Let every camera cut pixels as finely as the highest frequency of a camera makes it do."""
    fastest = max(1 / camera.metres_per_radian for camera in sensor.by_frequency)
    monkeypatch.setattr("phasemark.render.integral.area_integral._fastest", lambda _: fastest)
