"""Thin and partly hidden landmarks: how many answers are accepted, and how many of these are grossly wrong."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from phasemark.cli import main
from phasemark.data import Bank, open_bank
from phasemark.matcher import Match, Matcher, kalman_filter
from phasemark.render import Background, Renderer, Views, capture

PRESETS = ("vl53l5cx-8x8", "pmd-16x16")
WALL = Background(wall_m=2.5)
FIXED = ("distance_m", "delta_rad")
SETTINGS: dict[str, dict[str, Any]] = {
    "fixed": {"free": FIXED},
    "plain": {},
    "wall": {"free": FIXED, "background": WALL},
    "auto": {"free": FIXED, "background": "auto"},
    "robust": {"free": FIXED, "robust": True},
    "unknown": {"free": FIXED, "background": "unknown"},
    "bearing": {"free": (*FIXED, "bearing_rad")},
    "nearest": {"method": "nearest"},
}
FINE, COARSE = "0.35:1.5:0.01", "0.35:1.31:0.02"
GROSS_M, GROSS_RAD = 0.03, math.radians(6.0)


def box(size: tuple[float, float, float], at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """Return a box somewhere."""
    mesh: trimesh.Trimesh = trimesh.creation.box(size)
    mesh.apply_translation(at)
    return mesh


def meshes() -> dict[str, tuple[trimesh.Trimesh, int]]:
    """Return landmarks by name, each with its rotational symmetry."""
    plate = box((0.01, 0.4, 0.3))
    return {
        "panel": (box((0.01, 0.61, 0.49)), 2),
        "bracket": (trimesh.boolean.union([plate, box((0.2, 0.01, 0.3), (0.1, 0.1, 0.0))]), 1),
        "sign": (
            trimesh.boolean.union([box((0.01, 0.3, 0.2), (0, 0.05, 0.1)), box((0.03, 0.03, 0.4), (0, 0, -0.1))]),
            1,
        ),
        "frame": (
            trimesh.boolean.difference([box((0.02, 0.5, 0.4)), box((0.1, 0.3, 0.2), (0, 0.03, 0.02))]),
            1,
        ),
    }


@dataclass
class Counts:
    """What became of the frames of one cell."""

    wrong_accepted: int = 0
    right: int = 0
    right_accepted: int = 0
    answers: tuple[Match, ...] = ()


def bank_of(name: str, sensor: str, folder: Path, distance: str = FINE) -> Bank:
    """Build the bank of a thin landmark from its file, as a user does."""
    mesh, symmetry = meshes()[name]
    mesh.export(folder / f"{name}.stl")
    path = folder / f"{name}-{sensor}-{distance.replace(':', '-')}.h5"
    arguments = ["bank", "build", "--mesh", f"{name}={folder / name}.stl", "--unit", "m", "--origin", "center"]
    grid = ["--distance", distance, "--delta", f"0:{360 // symmetry}:2", "--symmetry", str(symmetry)]
    assert main([*arguments, *grid, "--sensor", sensor, "--out", str(path)]) == 0
    return open_bank(path)


def count(bank: Bank, setting: str, n: int, n_frames: int, rng: np.random.Generator) -> Counts:
    """Match n frames of the bank's own landmark at 0.5 to 1.2 m and up to 30° aside, and count."""
    options = dict(SETTINGS[setting])
    name = bank.classes[0]
    mesh = bank.mesh(name)
    symmetry = int(mesh.metadata["symmetry"])
    distance, delta = rng.uniform(0.5, 1.2, n), rng.uniform(-math.pi / 6, math.pi / 6, n)
    bearing = rng.uniform(-0.1, 0.1, n) if setting == "bearing" else np.zeros(n)
    scene = WALL if setting in ("wall", "auto", "unknown") else None
    views = Views.broadcast(distance, delta, bearing, 0.0)
    image = Renderer(mesh, bank.sensor, albedo=0.8).render_views(views, background=scene)
    frames = capture(image, bank.sensor, rng=rng, n_frames=n_frames)
    matches = Matcher(bank, options.pop("method", "refine"), **options).match(kalman_filter(frames))
    off = np.abs(np.angle(np.exp(1j * symmetry * (matches.delta_rad - delta)))) / symmetry
    right = (np.abs(matches.distance_m - distance) <= GROSS_M) & (off <= GROSS_RAD)
    accepted = matches.accepted
    return Counts(int((accepted & ~right).sum()), int(right.sum()), int((accepted & right).sum()), tuple(matches))
