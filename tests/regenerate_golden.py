"""Write tests/golden/catalogue.npz anew: ``python tests/regenerate_golden.py`` from the root of the repository."""

from pathlib import Path

import numpy as np

from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Renderer, preset

CATALOGUE = Path(__file__).parent / "golden" / "catalogue.npz"
VIEW = {"distance_m": 0.9, "delta_rad": 0.5, "bearing_rad": 0.02, "height_m": -0.01}
BACKGROUND = Background(wall_m=3.0, floor_m=0.3)


def render_catalogue():
    """Return name → (phasor, coverage) of every class in one view, before a wall and above a floor."""
    images = {}
    for name, spec in catalog().items():
        image = Renderer(build_mesh(spec), preset("pmd-16x16")).render(**VIEW, background=BACKGROUND)
        images[name] = (image.phasor[0].astype(np.complex64), image.coverage[0].astype(np.float32))
    return images


if __name__ == "__main__":
    arrays = {}
    for name, (phasor, coverage) in render_catalogue().items():
        arrays[f"{name}_phasor"], arrays[f"{name}_coverage"] = phasor, coverage
    np.savez_compressed(CATALOGUE, **arrays)
