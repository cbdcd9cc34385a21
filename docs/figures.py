"""Draw the pictures of the documentation into docs/images: ``python docs/figures.py``."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imread

from phasemark.data import write_atomically
from phasemark.data.seeds import stream
from phasemark.landmarks import build_mesh, catalog, mesh_picture
from phasemark.matcher import kalman_filter
from phasemark.matcher.drive import default_drive, drive_picture, run_drive
from phasemark.render import Background, Renderer, capture, preset
from phasemark.render.plot import draw_range

IMAGES = Path(__file__).parent / "images"


def demo_figure() -> Figure:
    """Draw the four landmarks above what the camera sees of them: 1 m away, 30° turned, a wall at 3 m, 50 frames."""
    sensor = preset("pmd-16x16")
    figure = Figure(figsize=(12.6, 6.0), layout="constrained")
    above, below = figure.subplots(2, 4, height_ratios=(1.15, 1))
    for k, (name, spec) in enumerate(catalog().items()):
        mesh = build_mesh(spec)
        above[k].imshow(imread(io.BytesIO(mesh_picture(mesh))))
        above[k].set_axis_off()
        above[k].set_title(name)
        image = Renderer(mesh, sensor, albedo=spec.albedo).render(
            1.0, np.radians(30), background=Background(wall_m=3.0)
        )
        frames = capture(image, sensor, rng=stream(2005, "documentation", k), n_frames=50)
        draw_range(below[k], kalman_filter(frames).range_m[0], near_m=0.8, far_m=3.1, colour_bar=k == 3)
    return figure


def main() -> None:
    """Write every picture."""
    IMAGES.mkdir(exist_ok=True)
    figures = {"demo.png": demo_figure(), "drive.png": drive_picture(run_drive(default_drive()))}
    for name, figure in figures.items():
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=90)
        write_atomically(IMAGES / name, buffer.getvalue(), force=True)


if __name__ == "__main__":
    main()
