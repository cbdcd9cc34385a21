"""Objects that arguments name: sensors, landmarks, banks and backgrounds."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Protocol

from phasemark import InputFileError, UsageError
from phasemark.data.commands.command import Shown, refuse_options
from phasemark.data.commands.console import tell
from phasemark.data.commands.options import ClassName, MeshReading, MeshUnit, Origin, Up
from phasemark.inputs.numbers import in_words

if TYPE_CHECKING:
    from trimesh import Trimesh

    from phasemark.data import Bank, FrameSet
    from phasemark.landmarks.mesh import Surface
    from phasemark.render import Background, Renderer, Sensor
    from phasemark.render.integral.surface_mesh import SurfaceMesh


_FRAMES = (".csv", ".npz", ".npy")
"""Endings of files that hold measured frames and never a bank."""


def open_any_bank(path: Path) -> Bank:
    """Open a bank from anywhere; say of a mesh how a bank is made of it, and of frames where they belong."""
    from phasemark.data import open_bank
    from phasemark.landmarks.mesh_files import FORMATS

    suffix = path.suffix.lower() if path.exists() else ""
    if suffix.removeprefix(".") in FORMATS:
        mesh, out = shlex.quote(f"part={path}"), shlex.quote(f"{path.stem}.h5")
        raise InputFileError(
            f"{path}: a mesh, not a bank; if it is in millimetres, one is made of it by: phasemark bank build"
            f" --mesh {mesh} --unit mm --out {out}"
        )
    if suffix in _FRAMES:
        raise InputFileError(f"{path}: measured frames, not a bank; the bank comes first: phasemark match BANK FRAMES")
    return open_bank(path, untrusted=True)


def open_frame_set(path: Path) -> FrameSet:
    """Open a frame set from anywhere."""
    from phasemark.data import open_frames

    return open_frames(path, untrusted=True)


def read_landmark(name_or_file: str, reading: MeshReading) -> tuple[str, Trimesh]:
    """Return the name and mesh of a class of the catalogue, or of a mesh file."""
    from phasemark.landmarks import catalog, read_mesh

    path = Path(name_or_file)
    if name_or_file in catalog() or not (path.suffix or path.exists()):
        return name_or_file, class_mesh(name_or_file)
    return path.stem, read_mesh(path, unit=reading.unit, up=reading.up, origin=reading.origin)


def class_mesh(name: str) -> Trimesh:
    """Return the mesh of a class of the catalogue."""
    from phasemark.landmarks import build_mesh
    from phasemark.landmarks.catalog import class_of_catalog

    return build_mesh(class_of_catalog(name))


def class_surface(name: str) -> Surface:
    """Return the triangles of a class of the catalogue, which is faster than its mesh."""
    from phasemark.landmarks.catalog import class_of_catalog
    from phasemark.landmarks.mesh import build_surface

    return build_surface(class_of_catalog(name))


def class_renderers(sensor: Sensor) -> dict[str, Renderer]:
    """Return a renderer of each class of the catalogue."""
    from phasemark.landmarks import catalog
    from phasemark.render import Renderer

    return {name: Renderer(class_surface(name), sensor, albedo=spec.albedo) for name, spec in catalog().items()}


@dataclass(frozen=True)
class ClassOrMesh:
    """Options that name one landmark: a class of the catalogue, or a mesh file.

    Parameters
    ----------
    mesh_file
        A mesh file.
    """

    class_name: ClassName | None = None
    mesh_file: Annotated[str | None, Shown(metavar="NAME=FILE")] = None
    unit: MeshUnit = None
    up: Up = "z"
    origin: Origin = "file"

    def check(self, doing: str) -> None:
        """Refuse both or none of --class and --mesh, and a unit without a mesh."""
        if (self.class_name is None) == (self.mesh_file is None):
            raise UsageError(f"say what to {doing}: either --class NAME or --mesh NAME=FILE")
        if self.class_name is not None and self.unit is not None:
            raise UsageError("--unit belongs to --mesh: the catalogue is in metres")
        if self.class_name is not None:
            refuse_options("only with --mesh: classes of the catalogue have their own axes", ("up", "origin"))

    def read(self) -> tuple[str, SurfaceMesh]:
        """Return name and mesh."""
        if self.class_name is not None:
            return self.class_name, class_surface(self.class_name)
        name, path = name_and_file(self.mesh_file or "")
        return name, read_landmark(path, MeshReading(self.unit, self.up, self.origin))[1]


def name_and_file(text: str) -> tuple[str, str]:
    """Split NAME=FILE."""
    name, separator, path = text.partition("=")
    if not (name and separator and path):
        raise UsageError(f"--mesh must be NAME=FILE, got '{text}'")
    return name, path


def background_of(wall: float | None, floor: float | None, bounces: str = "0") -> Background | None:
    """Return the background that the options state; None without wall and floor.

    Raises
    ------
    UsageError
        Light is to bounce off nothing.
    """
    from phasemark.render import Background

    if wall is None and floor is None:
        if bounces != "0":
            raise UsageError("--bounces needs something that light bounces off: give --wall, --floor or both")
        return None
    return Background(wall_m=wall, floor_m=floor, bounces="all" if bounces == "all" else int(bounces))


def of_any_albedo(behind: Background | None) -> Background | None:
    """Return a background whose albedos nobody states; one off which light bounces as it is."""
    from phasemark.render.background import UNSTATED_ALBEDO_STD

    return behind if behind is None or behind.bounces else replace(behind, albedo_ratio_std=UNSTATED_ALBEDO_STD)


def background_to_estimate(
    wall: float | None, floor: float | None, bounces: str, floor_albedo: float | None
) -> Background | None:
    """Return the background that the options state, of any albedo; with the floor's own, or any, where light bounces.

    Raises
    ------
    UsageError
        Light is to bounce off nothing, or the albedo is that of no floor off which it bounces.
    """
    if floor_albedo is not None and (floor is None or bounces == "0"):
        raise UsageError("--floor-albedo goes with --floor and --bounces: nothing else depends on it")
    behind = background_of(wall, floor, bounces)
    if behind is None or not behind.bounces:
        return of_any_albedo(behind)
    if floor_albedo is not None:
        return replace(behind, floor_albedo=floor_albedo)
    return replace(behind, floor_albedo=0.33, floor_albedo_std=0.16)  # of floors that return 0.05 to 0.6


def note_too_far(sensor: Sensor, distances_m: Mapping[str, float | None], *, in_histograms: bool = False) -> None:
    """Write a note for each distance that the sensor shows wrapped, or not at all, in its ranges or histograms.

    Raises
    ------
    UsageError
        The sensor has several modulation frequencies, and even together they are ambiguous at this distance.
    """
    from phasemark.render.sensor.sensor_quantities import SPEED_OF_LIGHT_M_S

    for name, distance_m in distances_m.items():
        if distance_m is None:
            continue
        described = sensor.describe_beyond_range(name, distance_m, in_histograms=in_histograms)
        if described is not None and len(sensor.frequencies_hz) > 1:
            divisor_hz = SPEED_OF_LIGHT_M_S / (2 * distance_m)
            raise UsageError(
                f"{described}; put it nearer, or give 'modulation_hz' = {in_words(sensor.frequencies_hz)} a common"
                f" divisor below {divisor_hz:.4g} Hz"
            )
        if described is not None:
            tell(f"note: {described}")


def note_plan_too_far(plan: PlanWithDistances) -> None:
    """Write a note for each key of a plan with distances that the sensor shows wrapped, or not at all."""
    from phasemark.data.plans.frame_plan import FramePlan

    distances_m = {f"'{name}'": distance_m for name, distance_m in plan.greatest_distances_m().items()}
    in_histograms = isinstance(plan, FramePlan) and plan.has_histograms
    note_too_far(plan.build_sensor(), distances_m, in_histograms=in_histograms)


class PlanWithDistances(Protocol):
    """A plan that knows its sensor and how far away it puts things."""

    def build_sensor(self) -> Sensor:
        """Return the sensor."""

    def greatest_distances_m(self) -> Mapping[str, float | None]:
        """Return the greatest distance of each key that has one."""


def read_sensor_sources(name_or_file: str) -> dict[str, str]:
    """Return where the numbers of a preset or of a sensor file come from, by field."""
    from phasemark.render import preset_names
    from phasemark.render.sensor.sensor_file import read_sources
    from phasemark.render.sensor.shipped_sensors import preset_sources

    return preset_sources(name_or_file) if name_or_file in preset_names() else read_sources(name_or_file)


def sensor_of_board(frames: Path, board: str | None) -> str:
    """Return the preset of the sensor on the board that printed some frames, stated or recognised.

    Raises
    ------
    UsageError
        No board is known to have printed them.
    """
    from phasemark.data.measured.boards import HEAD_BYTES, MOST_LOG_BYTES, find_board
    from phasemark.inputs.reading import opened

    with opened(frames, most_bytes=MOST_LOG_BYTES) as file:
        head = file.read(HEAD_BYTES)
    pixels_of_boards = 64  # zones of a frame that boards print unless they are set otherwise
    found = find_board(board, head, pixels_of_boards, frames)
    if found is None:
        raise UsageError(f"{frames} does not say which sensor took it: give --sensor NAME (phasemark sensor list)")
    return "tmf8828-8x8" if found.name == "tmf8828" else "vl53l5cx-8x8"


def read_sensor(name_or_file: str) -> Sensor:
    """Return a preset, or the sensor of a file; a preset's name wins over a file of that name."""
    from phasemark.render import Sensor, preset, preset_names

    if name_or_file in preset_names():
        return preset(name_or_file)
    path = Path(name_or_file)
    if path.suffix == ".toml" or path.exists():
        return Sensor.from_toml(path)
    raise UsageError(f"unknown sensor '{name_or_file}': give {', '.join(preset_names())}, or a .toml file")
