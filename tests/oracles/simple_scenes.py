"""A block on a table and poses around it, as an arm would take them."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

TOP_M = (0.0, 0.0, 0.1)
"""Middle of the block's top face; the table is the plane z = 0."""


def block_on_table() -> trimesh.Trimesh:
    """Return a block of 6 × 9 × 10 cm on a table, faces labelled 1 and 0."""
    block = trimesh.creation.box(extents=(0.06, 0.09, 0.1), transform=_shift(0, 0, 0.05 + 1e-5))
    table = trimesh.creation.box(extents=(2.0, 2.0, 0.1), transform=_shift(0, 0, -0.05))
    scene = trimesh.util.concatenate([table, block])
    assert isinstance(scene, trimesh.Trimesh)
    scene.face_attributes["part"] = np.repeat(np.array([0, 1], np.int8), 12)
    return scene


def poses_around(n: int, distance_m: float = 0.22, seed: int = 0) -> NDArray[np.float64]:
    """Return n poses of an optical frame (z forward) that look at the block from above, (n, 4, 4)."""
    rng = np.random.default_rng(seed)
    out = np.zeros((n, 4, 4))
    for k in range(n):
        azimuth, polar = 2 * np.pi * (k + 0.3 * rng.random()) / n, np.radians(rng.uniform(10, 50))
        away = np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
        target = np.array([0, 0, 0.07]) + rng.uniform(-0.02, 0.02, 3)
        x = np.cross([0.3, 1.0, 0.2], -away)
        x /= np.linalg.norm(x)
        out[k, :3, :3] = np.column_stack([x, np.cross(-away, x), -away])
        out[k, :3, 3] = target + distance_m * away
        out[k, 3, 3] = 1
    return out


def _shift(x: float, y: float, z: float) -> NDArray[np.float64]:
    out = np.eye(4)
    out[:3, 3] = x, y, z
    return out
