"""Feet: surfaces cut along the outlines of the bodies that stand on them or run through them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phasemark.render.integral.mesh_topology import MeshTopology

_ABOVE = 2.0
"""How far above a surface its bodies are cut for their outlines, in lifts of rays."""
_TOUCH = 1e-7
"""Share of its longest edge by which an outline must enter a triangle to cut it."""


def cut_where_bodies_stand(
    triangles: NDArray[np.float64], face: NDArray[np.int64], topology: MeshTopology, lift_m: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Cut triangles along the outlines of other bodies in their plane.

    Parameters
    ----------
    triangles : (f, 3, 3) float64
        World frame, metres.
    face : (f,) int64
        Face of the topology that each is a part of.
    topology : MeshTopology
    lift_m : float
        How far above a surface rays begin; bodies are cut a little above that.

    Returns
    -------
    triangles : (g, 3, 3) float64
        Each lies inside or outside of any body.
    own : (g,) int64
        Which of the triangles each is a part of.
    """
    done, own = [], []
    for f in np.unique(face):
        mine = np.flatnonzero(face == f)
        pieces, which = triangles[mine], mine
        normal, offset = topology.planes[f, :3], topology.planes[f, 3]
        margin_m = 2 * _ABOVE * lift_m
        low, high = pieces.min(axis=(0, 1)) - margin_m, pieces.max(axis=(0, 1)) + margin_m
        for side in (1, -1):
            for begin, end in _outlines(topology, f, normal, offset + side * _ABOVE * lift_m, low, high):
                pieces, which = _cut_along(pieces, which, begin, end, normal)
        done.append(pieces)
        own.append(which)
    return np.concatenate(done), np.concatenate(own)


def _outlines(
    topology: MeshTopology,
    face: int,
    normal: NDArray[np.float64],
    height: float,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return where the plane normal · x = height cuts bodies other than the face's own, segments (s, 2, 3).

    Those outside a box are left out.
    """
    others = np.flatnonzero(topology.part != topology.part[face])
    corners = topology.vertices[topology.faces[others]]
    above = corners @ normal - height
    cut = (above > 0).any(axis=1) & (above <= 0).any(axis=1)
    corners, above = corners[cut], above[cut]
    if not len(corners):
        return np.empty((0, 2, 3))
    alone = np.where((above > 0).sum(axis=1) == 1, (above > 0).argmax(axis=1), (above <= 0).argmax(axis=1))
    rows = np.arange(len(corners))
    ends = []
    for step in (1, 2):
        other = (alone + step) % 3
        share = above[rows, alone] / (above[rows, alone] - above[rows, other])
        ends.append(corners[rows, alone] + share[:, None] * (corners[rows, other] - corners[rows, alone]))
    segments = np.stack(ends, axis=1)
    near = (segments.max(axis=1) >= low).all(axis=1) & (segments.min(axis=1) <= high).all(axis=1)
    return np.asarray(segments[near])


def _cut_along(
    triangles: NDArray[np.float64],
    own: NDArray[np.int64],
    begin: NDArray[np.float64],
    end: NDArray[np.float64],
    normal: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Cut the triangles of one plane that a segment enters, each along the whole line of the segment."""
    length = np.linalg.norm(end - begin)
    if length == 0:
        return triangles, own
    along = (end - begin) / length
    across = np.cross(normal, along)
    place, side = (triangles - begin) @ along, (triangles - begin) @ across
    scale = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2).max(axis=1)
    side[np.abs(side) < _TOUCH * scale[:, None]] = 0.0
    split = np.flatnonzero((side.min(axis=1) < 0) & (side.max(axis=1) > 0))
    if not split.size:
        return triangles, own
    place, side = place[split], side[split]
    # where the line crosses each edge; the segment must cover a part of the way between
    after = np.roll(side, -1, axis=1)
    crosses = side * after < 0
    with np.errstate(invalid="ignore", divide="ignore"):
        at = place + side / (side - after) * (np.roll(place, -1, axis=1) - place)
    at = np.where(crosses, at, np.where(side == 0, place, np.nan))
    first, last = np.nanmin(at, axis=1), np.nanmax(at, axis=1)
    entered = np.minimum(last, length) - np.maximum(first, 0.0) > _TOUCH * scale[split]
    split, side = split[entered], side[entered]
    if not split.size:
        return triangles, own
    # begin with the corner that lies alone on its side
    alone = np.where((side > 0).sum(axis=1) == 1, (side > 0).argmax(axis=1), (side < 0).argmax(axis=1))
    turn = (alone[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(triangles[split], turn[:, :, None], axis=1).transpose(1, 0, 2)
    sa, sb, sc = np.take_along_axis(side, turn, axis=1).T
    ab = a + (sa / (sa - sb))[:, None] * (b - a)
    ac = a + (sa / (sa - sc))[:, None] * (c - a)
    pieces = np.concatenate([np.stack(corners, axis=1) for corners in ((a, ab, ac), (ab, b, c), (ab, c, ac))])
    parents = np.tile(own[split], 3)
    area = np.linalg.norm(np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]), axis=1)
    solid = area > _TOUCH * np.tile(scale[split], 3) ** 2
    kept = np.ones(len(triangles), np.bool_)
    kept[split] = False
    return np.concatenate([triangles[kept], pieces[solid]]), np.concatenate([own[kept], parents[solid]])
