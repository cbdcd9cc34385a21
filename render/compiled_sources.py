"""The source files that compiled code is made from: numba's own stamp of a kept function is that of its file alone.

A kernel holds copies of functions and numbers of other files. Code that was kept before one of them changed would
answer as the old one did.
"""

from __future__ import annotations

import hashlib
import os
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
"""The folder of the package."""

_FOLDERS = {
    "matcher": "pixel_agreement",
    "matcher/filters": "loops",
    "matcher/histograms": "histogram_table poisson_fit table_search target_costs",
    "matcher/likelihood": "bank_images residuals strip_images",
    "matcher/locate": "kernel_arguments pose_search scan_rows wall_depths",
    "matcher/nearest": "bank_minima cell_fits cells grid search templates",
    "render": "background compile_cache kernel unwrapping",
    "render/bounces": "form_factors patches transport",
    "render/direct": (
        "bin_counts expected_targets fit_model footprints photon_counts sample_counts targets transients"
    ),
    "render/exposure": "capture photoelectrons random_streams taps",
    "render/scene": "assembly depth_slopes",
    "render/integral": (
        "arguments bent_edges borders circular components convex_parts crossings edge_motion edge_projection"
        " edges_in_pixels face_search floor_phase gloss image_rays intersect intervals light limbs mesh_topology"
        " pixel_splitting quadrature_rules ray_plan round_edges scene_samples strips swept_light visible_faces"
    ),
}
COMPILED_SOURCES = tuple(f"{folder}/{name}.py" for folder, names in _FOLDERS.items() for name in names.split())
"""Files with compiled functions, or with numbers that these use, below the folder of the package."""


@cache
def compiled_sources_hash(root: Path = ROOT, names: tuple[str, ...] = COMPILED_SOURCES) -> bytes:
    """Return a hash of the source files of compiled functions; a file that cannot be read counts as empty.

    Parameters
    ----------
    root : Path
    names : tuple of str
        Files below `root`.

    Returns
    -------
    bytes
    """
    found = hashlib.blake2b(digest_size=16)
    for name in names:
        try:
            with open(os.path.join(root, name), "rb") as file:
                content = file.read()
        except OSError:
            content = b""
        found.update(f"{name} {len(content)} ".encode())
        found.update(content)
    return found.digest()
