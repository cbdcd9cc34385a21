"""Options that several commands share, and what a shell completes them with."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import typer

_ORIGIN_HELP = "What becomes the origin: file (its own), base (centre of its foot) or center (of its bounding box)."


def one_of(*words: str) -> Callable[[str], list[str]]:
    """Return what completes an argument to one of some words; a shell goes on with files where none fits."""
    return lambda incomplete: [word for word in words if word.startswith(incomplete)]


def a_class(incomplete: str) -> list[str]:
    """Complete the name of a class of the catalogue."""
    from phasemark.landmarks.catalog import catalog

    return one_of(*catalog())(incomplete)


def a_preset(incomplete: str) -> list[str]:
    """Complete the name of a preset."""
    from phasemark.render import preset_names

    return one_of(*preset_names())(incomplete)


Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Force = Annotated[bool, typer.Option("--force", help="Replace an output that exists.")]
MeshUnit = Annotated[
    str | None,
    typer.Option(
        "--unit", help="Unit of the mesh file: m, cm, mm or inch.", autocompletion=one_of("m", "cm", "mm", "inch")
    ),
]
Up = Annotated[
    str,
    typer.Option(
        "--up",
        help="Axis of the mesh file that points up: x, y, z, -x, -y or -z.",
        autocompletion=one_of("x", "y", "z", "-x", "-y", "-z"),
    ),
]
Origin = Annotated[str, typer.Option("--origin", help=_ORIGIN_HELP, autocompletion=one_of("file", "base", "center"))]
SensorName = Annotated[
    str,
    typer.Option("--sensor", metavar="NAME|FILE", help="A preset, or a sensor file (.toml).", autocompletion=a_preset),
]
Wall = Annotated[float | None, typer.Option("--wall", metavar="M", help="Distance of a wall behind the landmark.")]
Floor = Annotated[float | None, typer.Option("--floor", metavar="M", help="How far a floor lies below the lens.")]
FramesUnit = Annotated[
    str | None,
    typer.Option(
        "--unit",
        help="Unit of measured frames: m, cm or mm; if the file does not say.",
        autocompletion=one_of("m", "cm", "mm"),
    ),
]
Quantity = Annotated[
    str | None,
    typer.Option(
        "--quantity",
        help="range (along the ray) or z (along the optical axis); likewise.",
        autocompletion=one_of("range", "z"),
    ),
]
InvalidMeans = Annotated[
    str,
    typer.Option(
        "--invalid-means",
        help="What an invalid pixel stands for: missing or no-return.",
        autocompletion=one_of("missing", "no-return"),
    ),
]
ValidStatus = Annotated[
    list[int] | None, typer.Option("--valid-status", help="Value of 'status' that marks a valid pixel; repeatable.")
]
FlipH = Annotated[bool, typer.Option("--flip-h", help="Mirror left and right.")]
FlipV = Annotated[bool, typer.Option("--flip-v", help="Mirror top and bottom.")]
Rotate = Annotated[
    int,
    typer.Option(
        "--rotate",
        help="Turn the image clockwise by 0, 90, 180 or 270 degrees.",
        autocompletion=one_of("0", "90", "180", "270"),
    ),
]
Resume = Annotated[bool, typer.Option("--resume", help="Continue an unfinished run of the same plan.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Say how large it would be and how long it would take.")]
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
Sample = Annotated[int, typer.Option("--sample", min=0, help="How many random items to render again.")]
Seed = Annotated[int, typer.Option("--seed", min=0, max=2**64 - 1, help="Root of all random numbers.")]
Workers = Annotated[int | None, typer.Option("--workers", min=1, help="Threads; the result does not depend on it.")]
