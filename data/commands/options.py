"""Options that several commands share, and what a shell completes them with."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from phasemark.render import Frames, Sensor

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


# These words are those of MeshPlan and read_frames; the types of the calls below hold them together.
MeshUnitWord = Literal["m", "cm", "mm", "inch"]
UpWord = Literal["x", "y", "z", "-x", "-y", "-z"]
OriginWord = Literal["file", "base", "center"]
FramesUnitWord = Literal["m", "cm", "mm"]
QuantityWord = Literal["range", "z"]
InvalidMeansWord = Literal["missing", "no-return"]
Turn = Literal[0, 90, 180, 270]
BoardWord = Literal[
    "sparkfun", "adafruit", "adafruit-webserial", "adafruit-nost", "st-zones", "st-boxes", "esphome", "json", "tmf8828"
]

Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Force = Annotated[bool, typer.Option("--force", help="Replace an output that exists.")]
MeshUnit = Annotated[MeshUnitWord | None, typer.Option("--unit", help="Unit of the mesh file: m, cm, mm or inch.")]
Up = Annotated[UpWord, typer.Option("--up", help="Axis of the mesh file that points up: x, y, z, -x, -y or -z.")]
Origin = Annotated[OriginWord, typer.Option("--origin", help=_ORIGIN_HELP)]
SensorName = Annotated[
    str,
    typer.Option("--sensor", metavar="NAME|FILE", help="A preset, or a sensor file (.toml).", autocompletion=a_preset),
]
Wall = Annotated[float | None, typer.Option("--wall", metavar="M", help="Distance of a wall behind the landmark.")]
Pitch = Annotated[float, typer.Option("--pitch", metavar="DEG", help="The camera's pitch, positive looking down.")]
Roll = Annotated[float, typer.Option("--roll", metavar="DEG", help="The camera's roll.")]
Floor = Annotated[float | None, typer.Option("--floor", metavar="M", help="How far a floor lies below the lens.")]
FramesUnit = Annotated[
    FramesUnitWord | None,
    typer.Option("--unit", help="Unit of measured frames: m, cm or mm; if the file does not say."),
]
Quantity = Annotated[
    QuantityWord | None,
    typer.Option(
        "--quantity", help="range (along the ray) or z (along the optical axis); needed where the file does not say it."
    ),
]
InvalidMeans = Annotated[
    InvalidMeansWord,
    typer.Option("--invalid-means", help="Meaning of an invalid pixel: missing (not measured) or no-return."),
]
ValidStatus = Annotated[
    list[int] | None, typer.Option("--valid-status", help="Value of 'status' that marks a valid pixel; repeatable.")
]
FlipH = Annotated[bool, typer.Option("--flip-h", help="Mirror left and right.")]
FlipV = Annotated[bool, typer.Option("--flip-v", help="Mirror top and bottom.")]
BoardName = Annotated[
    BoardWord | None,
    typer.Option("--board", help="Program of a board that printed the file, if several print the same."),
]
Rotate = Annotated[Turn, typer.Option("--rotate", help="Turn the image clockwise by 0, 90, 180 or 270 degrees.")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue an unfinished run of the same plan.")]
DryRun = Annotated[
    bool,
    typer.Option("--dry-run", help="Print how large the file would be and how long it would take, and build nothing."),
]
Scheduler = Annotated[
    str, typer.Option("--scheduler", metavar="WHERE", help="threads, local:N processes, or a Dask scheduler's address.")
]
Shard = Annotated[str | None, typer.Option("--shard", metavar="I/N", help="Build only part I of N, to be merged.")]
ShardItems = Annotated[
    int | None, typer.Option("--shard-size", min=1, help="Images or views per shard; the result does not depend on it.")
]
MaxSize = Annotated[
    str, typer.Option("--max-size", metavar="SIZE", help="Refuse to write a larger file, e.g. 500MB or 20GB.")
]
Sample = Annotated[int, typer.Option("--sample", min=0, help="Number of random items that are rendered again.")]
Seed = Annotated[int, typer.Option("--seed", min=0, max=2**64 - 1, help="Root of all random numbers.")]
Workers = Annotated[int | None, typer.Option("--workers", min=1, help="Threads; the result does not depend on it.")]


@dataclass(frozen=True)
class FrameReading:
    """Options for reading measured frames: the meaning of their numbers, and the orientation of the camera."""

    unit: FramesUnit = None
    quantity: Quantity = None
    invalid_means: InvalidMeans = "missing"
    valid_status: ValidStatus = None
    flip_h: FlipH = False
    flip_v: FlipV = False
    rotate: Rotate = 0
    board: BoardName = None

    def read(self, path: Path, sensor: Sensor, *, topic: str | None = None) -> Frames:
        """Read a file of measured frames, from anywhere."""
        from phasemark.data import read_frames

        return read_frames(
            path,
            sensor=sensor,
            unit=self.unit,
            quantity=self.quantity,
            invalid_means=self.invalid_means,
            valid_status=self.valid_status,
            flip_h=self.flip_h,
            flip_v=self.flip_v,
            rotate=self.rotate,
            untrusted=True,
            topic=topic,
            board=self.board,
        )


@dataclass(frozen=True)
class MeshReading:
    """Options for reading a mesh file."""

    unit: MeshUnit = None
    up: Up = "z"
    origin: Origin = "file"


@dataclass(frozen=True)
class Building:
    """Options for building a bank or a frame set: workers, shards and existing output."""

    workers: Workers = None
    resume: Resume = False
    dry_run: DryRun = False
    max_size: MaxSize = "2GB"
    shard: Shard = None
    shard_size: ShardItems = None
    scheduler: Scheduler = "threads"
    as_json: Json = False
    force: Force = False
