"""Write the golden files of our own: ``python tests/programs/regenerate_golden.py`` from the root of the repository."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.data import BankPlan, FramePlan, build_bank, build_frames
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Renderer, preset

GOLDEN = Path(__file__).resolve().parent.parent / "golden"
CATALOGUE = GOLDEN / "catalogue.npz"
VIEW: dict[str, Any] = {"distance_m": 0.9, "delta_rad": 0.5, "bearing_rad": 0.02, "height_m": -0.01}
BACKGROUND = Background(wall_m=3.0, floor_m=0.3)

TINY_CAMERA = {"rows": 4, "cols": 4}
BANK = GOLDEN / "bank-v1.h5"
BANK_PLAN = BankPlan(
    classes=["cone"], sensor_overrides=TINY_CAMERA, distance_m="0.9,1", delta_deg="0,45", model="planar"
)
FRAMES = GOLDEN / "frames-v1.h5"
FRAMES_PLAN = FramePlan(
    landmarks=[{"name": "block", "box": {"length_m": 0.2, "width_m": 0.1, "height_m": 0.1}, "upper": None}],
    sensor_overrides=TINY_CAMERA,
    views=3,
    frames_per_view=2,
    seed=7,
    wall_m=3.0,
)


def render_catalogue() -> dict[str, tuple[NDArray[Any], NDArray[Any]]]:
    """Return name → (phasor, coverage) of every class in one view, before a wall and above a floor."""
    images = {}
    for name, spec in catalog().items():
        image = Renderer(build_mesh(spec), preset("pmd-16x16")).render(**VIEW, background=BACKGROUND)
        images[name] = (image.phasor[0].astype(np.complex64), image.coverage[0].astype(np.float32))
    return images


if __name__ == "__main__":
    arrays: dict[str, Any] = {}
    for name, (phasor, coverage) in render_catalogue().items():
        arrays[f"{name}_phasor"], arrays[f"{name}_coverage"] = phasor, coverage
    np.savez_compressed(CATALOGUE, **arrays)
    if not BANK.exists():  # files of a released version are never written again
        build_bank(BANK_PLAN, BANK).close()
    if not FRAMES.exists():
        build_frames(FRAMES_PLAN, FRAMES).close()
