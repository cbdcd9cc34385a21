"""Closed shells that run through one another, made one: the curve where they meet becomes an edge like any other."""

from __future__ import annotations

import manifold3d
import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


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
    shells = _shells(mesh)
    if len(shells) < 2:
        return mesh
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


def _shells(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Split a mesh where no edge joins its faces; holes stay holes."""
    n, (first, second) = len(mesh.faces), np.asarray(mesh.face_adjacency).reshape(-1, 2).T
    label = connected_components(coo_array((np.ones(len(first), bool), (first, second)), shape=(n, n)))[1]
    order = np.argsort(label, kind="stable")
    shells = []
    for faces in np.split(mesh.faces[order], np.flatnonzero(np.diff(label[order])) + 1):
        used, renumbered = np.unique(faces, return_inverse=True)
        shells.append(trimesh.Trimesh(mesh.vertices[used], renumbered.reshape(-1, 3), process=False))
    return shells


def _may_intersect(bounds: np.ndarray) -> bool:
    """Return True if any two of (n, 2, 3) bounding boxes overlap by more than rounding."""
    margin = 1e-9 * np.ptp(bounds, axis=(0, 1)).max()
    overlap = (bounds[:, None, 0] < bounds[None, :, 1] - margin).all(axis=-1)
    both = overlap & overlap.T
    np.fill_diagonal(both, False)
    return bool(both.any())
