"""Closed shells that run through one another, made one: the curve where they meet becomes an edge like any other."""

from __future__ import annotations

import manifold3d
import numpy as np
import trimesh


def unite_shells(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the union of a mesh's shells if they may intersect, otherwise the mesh itself.

    Pixels are split along the edges of the mesh; where shells cross there would be none. Shells whose bounding boxes do
    not overlap are left alone, and so are meshes with a shell that is open or inside out.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Any mesh.

    Returns
    -------
    trimesh.Trimesh
        Part labels are lost in a union; they follow from the height again.
    """
    if mesh.body_count < 2:
        return mesh
    shells = mesh.split(only_watertight=False)
    if not _may_intersect(np.array([shell.bounds for shell in shells])):
        return mesh
    if not all(shell.is_volume for shell in shells):
        return mesh
    solids = [
        manifold3d.Manifold(
            manifold3d.Mesh64(
                vert_properties=np.ascontiguousarray(shell.vertices, dtype=np.float64),
                tri_verts=np.ascontiguousarray(shell.faces, dtype=np.uint64),
            )
        )
        for shell in shells
    ]
    if any(solid.status() != manifold3d.Error.NoError for solid in solids):
        return mesh
    united = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).to_mesh64()
    return trimesh.Trimesh(
        np.asarray(united.vert_properties)[:, :3],
        np.asarray(united.tri_verts, dtype=np.int64),
        metadata=dict(mesh.metadata),
        process=False,
    )


def _may_intersect(bounds: np.ndarray) -> bool:
    """Tell whether any two of (n, 2, 3) bounding boxes overlap by more than rounding."""
    margin = 1e-9 * np.ptp(bounds, axis=(0, 1)).max()
    overlap = (bounds[:, None, 0] < bounds[None, :, 1] - margin).all(axis=-1)
    both = overlap & overlap.T
    np.fill_diagonal(both, False)
    return bool(both.any())
