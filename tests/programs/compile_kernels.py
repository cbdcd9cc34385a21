"""Compile what many tests call, before the processes that share them start.

``python -m programs.compile_kernels PART``. Processes that start together would each compile all of it.
"""

import sys
from collections.abc import Callable

import numpy as np
from builders import pure_image
from oracles.exact_pixels import exact_pixels

from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import kalman_filter, phasor_mean
from phasemark.matcher.warm import warm
from phasemark.render import Background, Renderer, Sensor, Views, capture, preset

PMD = preset("pmd-16x16")
LENS = Sensor.from_opencv([[40.0, 0.0, 7.5], [0.0, 40.0, 7.5], [0.0, 0.0, 1.0]], [-0.3, 0.1, 0, 0], size=(16, 16))
BEHIND = Background(wall_m=3.0, floor_m=0.5)
MESH = build_mesh(catalog()["cylinder"])


def rendering() -> None:
    """Images and their slopes, through a plain camera and a lens."""
    for sensor in (PMD, LENS):
        renderer = Renderer(MESH, sensor)
        renderer.render(1.0, 0.3, background=BEHIND)
        renderer.jacobian(1.0, 0.3, background=BEHIND)
    Renderer(MESH, PMD, intersector="float64").render(1.0)


def the_rest() -> None:
    """Frames, their filters, and the oracle of exact pixels."""
    frames = capture(pure_image(np.full((2, 16, 16), 1.0), PMD), PMD, rng=np.random.default_rng(0), n_frames=3)
    kalman_filter(frames)
    phasor_mean(frames)
    exact_pixels("cylinder", PMD, Views.broadcast(1.0, 0.3), np.array([[8, 8]]), background=BEHIND)


PARTS: dict[str, Callable[[], None]] = {
    "rendering": rendering,
    "rest": the_rest,
    "matching": lambda: warm("match"),
    "histograms": lambda: warm("histograms"),
}

if __name__ == "__main__":
    PARTS[sys.argv[1]]()
