"""Closed shells that run through one another, made one: the curve where they meet becomes an edge like any other."""

from __future__ import annotations

import manifold3d
import numpy as np
from numpy.typing import NDArray

from phasemark.render.integral.components import component_labels
from phasemark.render.integral.surface_mesh import SurfaceMesh

_Triangles = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]
_KEPT = ("albedo", "quadric")
"""Attributes of faces that a union keeps."""


def unite_shells(mesh: SurfaceMesh) -> SurfaceMesh:
    """Return the union of a mesh's shells if they may intersect, otherwise the mesh itself.

    Pixels are split along the edges of the mesh; where shells cross there would be none. Shells whose bounding boxes do
    not overlap are left alone, and so are meshes with a shell that is open or inside out.

    Parameters
    ----------
    mesh : SurfaceMesh
        Any mesh.

    Returns
    -------
    SurfaceMesh
        A union keeps albedo and quadric of each face, and numbers the shell that it was of. Part labels are lost; they
        follow from the height again.
    """
    shells = shells_of(mesh)
    if len(shells) < 2:
        return mesh
    if not _may_intersect(np.array([(points.min(axis=0), points.max(axis=0)) for points, _, _ in shells])):
        return mesh
    import trimesh  # takes a third of a second, and few meshes need it

    if not all(trimesh.Trimesh(points, faces, process=False).is_volume for points, faces, _ in shells):
        return mesh
    attributes = {name: np.asarray(mesh.face_attributes[name]) for name in _KEPT if name in mesh.face_attributes}
    solids = [
        manifold3d.Manifold(
            manifold3d.Mesh64(
                vert_properties=np.ascontiguousarray(points, dtype=np.float64),
                tri_verts=np.ascontiguousarray(faces, dtype=np.uint64),
                # faces in one plane are merged unless each has a number
                face_id=number.astype(np.uint64) if attributes else None,
            )
        )
        for points, faces, number in shells
    ]
    if any(solid.status() != manifold3d.Error.NoError for solid in solids):
        return mesh
    united = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).to_mesh64()
    return trimesh.Trimesh(
        np.asarray(united.vert_properties)[:, :3],
        np.asarray(united.tri_verts, dtype=np.int64),
        face_attributes={
            **{name: own[np.asarray(united.face_id, np.int64)] for name, own in attributes.items()},
            "shell": np.repeat(np.asarray(united.run_original_id), np.diff(united.run_index) // 3).astype(np.int64),
        },
        metadata=dict(mesh.metadata),
        process=False,
    )


def shells_of(mesh: SurfaceMesh) -> list[_Triangles]:
    """Split a mesh where no edge joins its faces: points, faces and their numbers; holes stay holes."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    label = component_labels(len(faces), _adjacent_faces(faces))
    if not label.any():
        return [(vertices, faces, np.arange(len(faces)))]
    order = np.argsort(label, kind="stable")
    shells = []
    for number in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        used, renumbered = np.unique(faces[number], return_inverse=True)
        shells.append((vertices[used], renumbered.reshape(-1, 3), number))
    return shells


def _adjacent_faces(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the pairs of faces, (m, 2), that meet at an edge where no third face does."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges = edges[order]
    starts = np.flatnonzero(np.concatenate([[True], (edges[1:] != edges[:-1]).any(axis=1)]))
    first = starts[np.diff(np.append(starts, len(edges))) == 2]
    owner = order % max(len(faces), 1)
    return np.column_stack([owner[first], owner[first + 1]])


def _may_intersect(bounds: NDArray[np.float64]) -> bool:
    """Return True if any two of (n, 2, 3) bounding boxes overlap by more than rounding."""
    margin = 1e-9 * np.ptp(bounds, axis=(0, 1)).max()
    overlap = (bounds[:, None, 0] < bounds[None, :, 1] - margin).all(axis=-1)
    both = overlap & overlap.T
    np.fill_diagonal(both, False)
    return bool(both.any())
