"""From a specification to one watertight mesh in the landmark frame (PHYSICS section 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import manifold3d
import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.landmarks.revolve import Triangles, revolve
from phasemark.landmarks.spec import LandmarkSpec

if TYPE_CHECKING:
    import trimesh

Part = Literal["both", "lower", "upper"]

LOWER = 0
"""Label of the lower part's faces in ``mesh.face_attributes["part"]``."""

UPPER = 1
"""Label of the upper part's faces in ``mesh.face_attributes["part"]``."""

DEFAULT_TOLERANCE_M = 1.2e-6
"""Permitted mean displacement of a silhouette along a pixel.

1e-4 of a pixel of ``pmd-16x16`` at 0.74 m, the near side of a landmark at 0.75 m, where the pixel is 18 mm wide and a
silhouette that crosses it on the diagonal is √2 times as long.
"""

MAX_FACES = 2_000_000
"""Most faces that the mesh of a landmark may have."""

_BOX_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-1.0, 0.0)])
_BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of a landmark: what a renderer needs of a mesh, with the names that trimesh gives them.

    Parameters
    ----------
    vertices : (v, 3) float64
        Metres, landmark frame.
    faces : (f, 3) int64
        Corners of each triangle, counter-clockwise from outside.
    face_attributes : dict
        ``part``: 0 for faces of the lower part, 1 for faces of the upper one, (f,) uint8.
    metadata : dict
        ``name``, ``symmetry`` and ``albedo``.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    face_attributes: dict[str, Any]
    metadata: dict[str, Any]


def build_mesh(spec: LandmarkSpec, part: Part = "both", tolerance_m: float = DEFAULT_TOLERANCE_M) -> trimesh.Trimesh:
    """Build a landmark's surface (PHYSICS sections 1, 3 and 5).

    Parameters
    ----------
    spec : LandmarkSpec
        What to build.
    part : {'both', 'lower', 'upper'}
        The whole landmark, its box, or its solid of revolution alone, closed.
    tolerance_m : float
        Mean displacement of the silhouette over a pixel that tessellation may cost, metres. The default keeps
        ``pmd-16x16`` within 1e-4 of coverage and 5e-5 of ε from 0.75 m on.

    Returns
    -------
    trimesh.Trimesh
        Closed, metres, landmark frame (origin on the axis in the plane between the parts, z' up), faces
        counter-clockwise from outside. ``metadata`` holds ``name``, ``symmetry`` and ``albedo``;
        ``face_attributes["part"]`` is 0 on faces of the lower part and 1 on faces of the upper one. A sphere and its
        box are two closed surfaces that touch in the origin.

    Raises
    ------
    UsageError
        The part does not exist, or the tolerance is not positive or asks for more than two million faces.

    Examples
    --------
    >>> from phasemark.landmarks import catalog
    >>> mesh = build_mesh(catalog()["cone"])
    >>> bool(mesh.is_watertight), mesh.extents.round(6).tolist()
    (True, [0.24, 0.16, 0.3])
    """
    import trimesh  # takes a third of a second: what is only rendered does without

    return trimesh.Trimesh(**vars(build_surface(spec, part, tolerance_m)), process=False)


def build_surface(spec: LandmarkSpec, part: Part = "both", tolerance_m: float = DEFAULT_TOLERANCE_M) -> Surface:
    """Build a landmark's surface as :func:`build_mesh` does, without a mesh library around its arrays.

    Parameters
    ----------
    spec : LandmarkSpec
    part : {'both', 'lower', 'upper'}
    tolerance_m : float

    Returns
    -------
    Surface

    Raises
    ------
    UsageError
        As :func:`build_mesh`.
    """
    if not isinstance(spec, LandmarkSpec):
        raise UsageError(f"'spec' must be a LandmarkSpec, got {type(spec).__name__}: catalog()['cone'] is one")
    if part not in ("both", "lower", "upper"):
        raise UsageError(f"'part' must be 'both', 'lower' or 'upper', got {part!r}")
    if not (math.isfinite(tolerance_m) and tolerance_m > 0):
        raise UsageError(f"'tolerance_m' must be a positive number of metres, got {tolerance_m!r}")
    if part == "upper" and spec.upper is None:
        raise UsageError(f"landmark '{spec.name}' has no upper part")

    solids: list[tuple[int, Triangles]] = []
    if part != "upper":
        box = _BOX_CORNERS * (spec.box.length_m, spec.box.width_m, spec.box.height_m), _BOX_FACES
        solids.append((LOWER, box))
    if part != "lower" and spec.upper is not None:
        solids.append((UPPER, revolve(spec.upper, tolerance_m, max_faces=MAX_FACES)))
    stands_on_a_point = len(solids) == 2 and np.sum(solids[1][1][0][:, 2] == 0) <= 1
    vertices, faces, parts = _side_by_side(solids) if len(solids) == 1 or stands_on_a_point else _union(solids)
    return Surface(
        vertices=np.asarray(vertices, np.float64),
        faces=np.asarray(faces, np.int64),
        face_attributes={"part": parts},
        metadata={"name": spec.name, "symmetry": spec.symmetry, "albedo": spec.albedo},
    )


_Labelled = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.uint8]]


def _side_by_side(solids: list[tuple[int, Triangles]]) -> _Labelled:
    """Put surfaces that share no area into one mesh."""
    starts = np.cumsum([0] + [len(vertices) for _, (vertices, _) in solids])
    return (
        np.vstack([vertices for _, (vertices, _) in solids]),
        np.vstack([faces + start for start, (_, (_, faces)) in zip(starts, solids, strict=False)]),
        np.concatenate([np.full(len(faces), label, np.uint8) for label, (_, faces) in solids]),
    )


def _union(solids: list[tuple[int, Triangles]]) -> _Labelled:
    """Unite solids exactly: the area where one stands on the other is gone, and no vertex sits inside an edge."""
    manifolds, label_of = [], {}
    for label, (vertices, faces) in solids:
        manifold = manifold3d.Manifold(
            manifold3d.Mesh64(vert_properties=vertices, tri_verts=faces.astype(np.uint64))
        ).as_original()
        label_of[manifold.original_id()] = label
        manifolds.append(manifold)
    united = manifold3d.Manifold.batch_boolean(manifolds, manifold3d.OpType.Add).to_mesh64()
    parts = np.empty(len(united.tri_verts), np.uint8)
    ends = np.asarray(united.run_index, dtype=np.int64) // 3
    for identity, start, end in zip(united.run_original_id, ends[:-1], ends[1:], strict=True):
        parts[start:end] = label_of[int(identity)]
    return np.asarray(united.vert_properties)[:, :3], np.asarray(united.tri_verts, np.int64), parts
