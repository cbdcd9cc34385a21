"""Options that several commands share, and what a shell completes them with."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from phasemark.data.commands.command import Shown

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from phasemark.render import Frames, Sensor, Views

_ORIGIN_HELP = "What becomes the origin: file (its own), base (centre of its foot) or center (of its bounding box)."


def one_of(*words: str) -> Callable[[str], list[str]]:
    """Return a function that completes an argument to one of some words; a shell completes files where none fits."""
    return lambda incomplete: [word for word in words if word.startswith(incomplete)]


def a_class(incomplete: str) -> list[str]:
    """Complete the name of a class of the catalogue."""
    from phasemark.landmarks.catalog import catalog

    return one_of(*catalog())(incomplete)


def a_preset(incomplete: str) -> list[str]:
    """Complete the name of a preset."""
    from phasemark.render import preset_names

    return one_of(*preset_names())(incomplete)


# These words are those of MeshPlan and read_frames.
MeshUnitWord = Literal["m", "cm", "mm", "inch"]
UpWord = Literal["x", "y", "z", "-x", "-y", "-z"]
OriginWord = Literal["file", "base", "center"]
FramesUnitWord = Literal["m", "cm", "mm"]
QuantityWord = Literal["range", "z"]
BoardWord = Literal[
    "sparkfun", "adafruit", "adafruit-webserial", "adafruit-nost", "st-zones", "st-boxes", "esphome", "json", "tmf8828"
]

Metres = Annotated[float, Shown(metavar="M")]
Degrees = Annotated[float, Shown(metavar="DEG")]
Count = Annotated[int, Shown(min=1)]
Index = Annotated[int, Shown(min=0)]
Seed = Annotated[int, Shown(min=0, max=2**64 - 1, help="Root of all random numbers.")]
ClassName = Annotated[str, Shown(autocompletion=a_class, help="A class of the catalogue.")]
SensorName = Annotated[
    str, Shown(metavar="NAME|FILE", autocompletion=a_preset, help="A preset, or a sensor file (.toml).")
]
Out = Annotated[Path, Shown("-o", "--out")]
Shards = Annotated[list[Path], Shown(metavar="SHARD...", help="All parts that --shard has built.")]
Json = Annotated[bool, Shown("--json", help="Print JSON instead of text.")]
Force = Annotated[bool, Shown(help="Replace an output that exists.")]
Up = Annotated[UpWord, Shown(help="Axis of the mesh file that points up.")]
Origin = Annotated[OriginWord, Shown(help=_ORIGIN_HELP)]
MeshUnit = Annotated[MeshUnitWord | None, Shown(help="Unit of the mesh file.")]
Wall = Annotated[Metres | None, Shown(help="Distance of a wall behind the landmark.")]
Floor = Annotated[Metres | None, Shown(help="How far a floor lies below the lens.")]
BouncesOfLight = Annotated[
    Literal["0", "1", "2", "all"],
    Shown("--bounces", help="How often light may bounce between landmark, wall and floor on its way."),
]
Resume = Annotated[bool, Shown(help="Continue an unfinished run of the same plan.")]
Sample = Annotated[Index, Shown(help="Number of random items that are rendered again.")]
Workers = Annotated[Count | None, Shown(help="Threads; the result does not depend on it.")]


@dataclass(frozen=True)
class FrameReading:
    """Options for reading measured frames: the meaning of their numbers, and the orientation of the camera.

    Parameters
    ----------
    unit
        Unit of measured frames, if the file does not say.
    quantity
        range (along the ray) or z (along the optical axis), if the file does not say.
    invalid_means
        Meaning of an invalid pixel; missing: not measured.
    valid_status
        Value of 'status' that marks a valid pixel; repeatable.
    flip_h
        Mirror left and right.
    flip_v
        Mirror top and bottom.
    rotate
        Turn the image clockwise, degrees.
    board
        Program of a board that printed the file, if several print the same.
    topic
        Which images of a ROS bag.
    """

    unit: FramesUnitWord | None = None
    quantity: QuantityWord | None = None
    invalid_means: Literal["missing", "no-return"] = "missing"
    valid_status: list[int] | None = None
    flip_h: bool = False
    flip_v: bool = False
    rotate: Literal[0, 90, 180, 270] = 0
    board: BoardWord | None = None
    topic: str | None = None

    def read(self, path: Path, sensor: Sensor) -> Frames:
        """Read a file of measured frames, from anywhere."""
        from phasemark.data import read_frames

        return read_frames(path, sensor=sensor, untrusted=True, **vars(self))


@dataclass(frozen=True)
class MeshReading:
    """Options for reading a mesh file."""

    unit: MeshUnit = None
    up: Up = "z"
    origin: Origin = "file"


@dataclass(frozen=True)
class View:
    """Options for the place of the landmark before the camera.

    Parameters
    ----------
    distance
        Distance D to the landmark's axis.
    delta
        Side δ from which the landmark is seen.
    bearing
        Azimuth of the landmark in the camera frame.
    height
        Height of the landmark's origin above the lens.
    pitch
        The camera's pitch, positive looking down.
    roll
        The camera's roll.
    """

    distance: Metres = 1.0
    delta: Degrees = 0.0
    bearing: Degrees = 0.0
    height: Metres = 0.0
    pitch: Degrees = 0.0
    roll: Degrees = 0.0

    def views(self, distance_m: ArrayLike, delta_deg: ArrayLike) -> Views:
        """Return views at some distances and angles δ, otherwise as stated."""
        import numpy as np

        from phasemark.render import Views

        bearing, pitch, roll = (math.radians(angle) for angle in (self.bearing, self.pitch, self.roll))
        return Views.broadcast(distance_m, np.radians(delta_deg), bearing, self.height, pitch, roll)


@dataclass(frozen=True)
class Building:
    """Options for building a bank or a frame set: workers, shards and existing output.

    Parameters
    ----------
    dry_run
        Print how large the file would be and how long it would take, and build nothing.
    max_size
        Refuse to write larger images or frames, e.g. 500MB or 20GB; meshes and header are not counted.
    shard
        Build only part I of N, to be merged.
    shard_size
        Images or views per shard; the result does not depend on it.
    scheduler
        threads, or a Dask scheduler's address.
    """

    workers: Workers = None
    resume: Resume = False
    dry_run: bool = False
    max_size: Annotated[str, Shown(metavar="SIZE")] = "2GB"
    shard: Annotated[str | None, Shown(metavar="I/N")] = None
    shard_size: Count | None = None
    scheduler: Annotated[str, Shown(metavar="WHERE")] = "threads"
    as_json: Json = False
    force: Force = False
