"""The command ``phasemark render``: one noise-free frame."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from phasemark import UsageError
from phasemark.data.commands.inputs import (
    background_of,
    note_too_far,
    read_class_or_mesh,
    read_sensor,
    refuse_unless_one,
)
from phasemark.data.commands.options import Floor, Force, MeshReading, Pitch, Roll, SensorName, Wall, a_class
from phasemark.data.commands.outputs import refuse_existing

if TYPE_CHECKING:
    from phasemark.render import PhasorImages
    from phasemark.render.direct import HistogramImages


def render_frame(
    *,
    out: Annotated[Path, typer.Option("-o", "--out", help="The figure, .png; the data go beside it as .npz.")],
    distance: Annotated[
        float, typer.Option("--distance", metavar="M", help="Distance D to the landmark's axis.")
    ] = 1.0,
    delta: Annotated[
        float, typer.Option("--delta", metavar="DEG", help="Side δ from which the landmark is seen.")
    ] = 0.0,
    bearing: Annotated[
        float, typer.Option("--bearing", metavar="DEG", help="Azimuth of the landmark in the camera frame.")
    ] = 0.0,
    height: Annotated[
        float, typer.Option("--height", metavar="M", help="Height of the landmark's origin above the lens.")
    ] = 0.0,
    pitch: Pitch = 0.0,
    roll: Roll = 0.0,
    class_name: Annotated[
        str | None, typer.Option("--class", help="A class of the catalogue.", autocompletion=a_class)
    ] = None,
    mesh_file: Annotated[str | None, typer.Option("--mesh", metavar="NAME=FILE", help="A mesh file.")] = None,
    mesh_reading: MeshReading,
    sensor: SensorName = "pmd-16x16",
    wall: Wall = None,
    floor: Floor = None,
    variant: Annotated[
        Literal["exact", "hard"],
        typer.Option(
            "--variant",
            help="exact: the exact integral; hard: the centre ray of each pixel alone.",
        ),
    ] = "exact",
    force: Force = False,
) -> None:
    """Render one noise-free frame: a figure, the phasors, and a sketch in the terminal.

    Of a direct sensor with a [histogram] table the figure and the data have the expected counts of every zone's bins.
    """
    from phasemark.render import Renderer, Views
    from phasemark.render.figures import landmark_limits_m, terminal_figure

    refuse_unless_one(class_name, mesh_file, mesh_reading, "render")
    if out.suffix.lower() != ".png":
        raise UsageError(f"the figure must be a .png file, got '{out}'")
    data = out.with_suffix(".npz")
    refuse_existing([out, data], force)
    _, mesh = read_class_or_mesh(class_name, mesh_file, mesh_reading)
    camera = read_sensor(sensor)
    note_too_far(camera, {"--distance": distance, "--wall": wall})
    renderer = Renderer(mesh, camera, albedo=mesh.metadata.get("albedo", 0.8))
    angles = {name: math.radians(value) for name, value in (("pitch_rad", pitch), ("roll_rad", roll))}
    views = Views.broadcast(distance, math.radians(delta), math.radians(bearing), height, **angles)
    renderer.check_in_view(views)
    background = background_of(wall, floor)
    image = renderer.render_views(views, background=background, variant=variant)
    histograms = None
    if camera.histogram is not None and variant == "exact":
        from phasemark.render.direct import HistogramRenderer

        histograms = HistogramRenderer(mesh, camera, albedo=renderer.albedo).render_views(views, background=background)
    _write_image(image, histograms, out, data, force)
    if sys.stdout.isatty():
        from rich.console import Console

        near, far = landmark_limits_m(image.range_m[0], image.coverage[0])
        Console().print(terminal_figure(image.range_m[0], width=48, near_m=near, far_m=far))
    typer.echo(out)
    typer.echo(data)


def _write_image(image: PhasorImages, histograms: HistogramImages | None, out: Path, data: Path, force: bool) -> None:
    """Write the figure of an image, or of its histograms where there are any, and the arrays."""
    import io as bytes_io

    import numpy as np

    from phasemark.data.files.atomic_write import write_atomically

    arrays = {
        "phasor": image.phasor[0],
        "intensity": image.intensity[0],
        "coverage": image.coverage[0],
        "range": image.range_m[0],
        "unit": "m",
        "quantity": "range",
    }
    if len(image.sensor.frequencies_hz) > 1:
        arrays |= {"frequency": np.array(image.sensor.frequencies_hz), "frequency_phasor": image.phasors[0]}
    if histograms is not None:
        arrays |= {"expected_counts": histograms.expected[0], "signal_counts": histograms.signal[0]}
    buffer, figure = bytes_io.BytesIO(), bytes_io.BytesIO()
    np.savez(buffer, **arrays)
    (image if histograms is None else histograms).plot().savefig(figure, format="png", dpi=120)
    write_atomically(data, buffer.getvalue(), force=force)
    write_atomically(out, figure.getvalue(), force=force)
