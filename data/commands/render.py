"""The command ``phasemark render``: one noise-free frame."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from phasemark.data.commands.console import echo
from phasemark.data.commands.inputs import ClassOrMesh, background_of, note_too_far, read_sensor
from phasemark.data.commands.options import BouncesOfLight, Floor, Force, Out, SensorName, View, Wall
from phasemark.data.commands.outputs import refuse_existing, refuse_other_files, write_file

if TYPE_CHECKING:
    from phasemark.render import PhasorImages
    from phasemark.render.direct import HistogramImages


def render_frame(
    *,
    out: Out,
    view: View,
    landmark: ClassOrMesh,
    sensor: SensorName = "pmd-16x16",
    wall: Wall = None,
    floor: Floor = None,
    bounces: BouncesOfLight = "0",
    variant: Literal["exact", "hard"] = "exact",
    force: Force = False,
) -> None:
    """Render one noise-free frame: a figure, the phasors, and a sketch in the terminal.

    Of a direct sensor with a [histogram] table the figure and the data have the expected counts of every zone's bins.

    Parameters
    ----------
    out
        The figure, .png; the data go beside it as .npz.
    variant
        exact: the exact integral; hard: the centre ray of each pixel alone.
    """
    from phasemark.render import Renderer
    from phasemark.render.figures import landmark_limits_m, terminal_figure

    landmark.check("render")
    refuse_other_files(out, ".png")
    data = out.with_suffix(".npz")
    refuse_existing([out, data], force)
    _, mesh = landmark.read()
    camera = read_sensor(sensor)
    note_too_far(camera, {"--distance": view.distance, "--wall": wall})
    renderer = Renderer(mesh, camera, albedo=mesh.metadata.get("albedo", 0.8))
    views = view.views(view.distance, view.delta)
    renderer.check_in_view(views)
    background = background_of(wall, floor, bounces)
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
    echo(out, data)


def _write_image(image: PhasorImages, histograms: HistogramImages | None, out: Path, data: Path, force: bool) -> None:
    """Write the figure of an image, or of its histograms where there are any, and the arrays."""
    import numpy as np

    from phasemark.data.measured.recording import npz_bytes
    from phasemark.render.png import figure_png

    arrays = {name: getattr(image, name)[0] for name in ("phasor", "intensity", "coverage")}
    arrays |= {"range": image.range_m[0], "unit": "m", "quantity": "range"}
    if len(image.sensor.frequencies_hz) > 1:
        arrays |= {"frequency": np.array(image.sensor.frequencies_hz), "frequency_phasor": image.phasors[0]}
    if histograms is not None:
        arrays |= {"expected_counts": histograms.expected[0], "signal_counts": histograms.signal[0]}
    figure = figure_png((image if histograms is None else histograms).plot(), dpi=120)
    write_file(data, npz_bytes(arrays), force)
    write_file(out, figure, force)
