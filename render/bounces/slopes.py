"""Slopes of the light that arrives along a surface, from patches beside one another."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from phasemark.render.bounces.patches import Patches

_NEAREST = 16
"""Patches among which neighbours are looked for."""
_FLAT, _SAME_PLANE_M = 1e-9, 1e6
"""Normals of a plane patch add up to one but for this; distance that neighbours of unlike planes seem to have."""
_ALIKE = 0.8
"""Least cosine between the normals of neighbours."""
_BESIDE = 0.3
"""Largest height of a neighbour over the plane of a patch, as a share of its distance."""


class Slopes(NamedTuple):
    """Linear maps from values at the centres of patches to their slopes along the surface, (n, n) each, 1/m."""

    x: sparse.csr_array
    y: sparse.csr_array
    z: sparse.csr_array


def slopes_of(patches: Patches) -> Slopes:
    """Return slopes fitted through neighbours that continue the surface, those nearer with more weight."""
    n, count = len(patches), min(_NEAREST, len(patches))
    length = np.linalg.norm(patches.normal, axis=1, keepdims=True)
    unit = patches.normal / length
    planes = np.column_stack([unit, np.einsum("ij,ij->i", unit, patches.centre)])
    near = np.empty((n, count), np.int64)
    flat_ones = length[:, 0] > 1 - _FLAT
    for own, apart_m in ((flat_ones, _SAME_PLANE_M), (~flat_ones, 0.0)):
        places = np.column_stack([patches.centre, apart_m * planes])
        near[own] = cKDTree(places).query(places[own], k=count)[1].reshape(-1, count)
    offset = patches.centre[near] - patches.centre[:, None]
    height = np.einsum("nkj,nj->nk", offset, unit)
    distance = np.linalg.norm(offset, axis=2)
    least = np.where(flat_ones, 1 - _FLAT, _ALIKE)[:, None]
    beside = (patches.body[near] == patches.body[:, None]) & (patches.albedo[near] == patches.albedo[:, None])
    beside &= np.einsum("nkj,nj->nk", unit[near], unit) > least
    beside &= (np.abs(height) < _BESIDE * distance) & (distance > 0)
    flat = offset - height[:, :, None] * unit[:, None]
    weight = np.where(beside, 1 / (distance**2 + (0.5 * patches.size[:, None]) ** 2), 0.0)
    normal_equations = np.einsum("nk,nki,nkj->nij", weight, flat, flat)
    along_normal = unit[:, :, None] * unit[:, None]  # no slope out of the surface
    slightly = 0.1  # no slope in a direction in which no neighbour lies as far as the patch is large
    inverse = np.linalg.inv(normal_equations + along_normal + slightly * np.eye(3))
    shares = np.einsum("nij,nkj,nk->ink", inverse, flat, weight)
    rows = np.repeat(np.arange(n), count)
    maps = []
    for share in shares:
        own = sparse.coo_array((share.ravel(), (rows, near.ravel())), shape=(n, n))
        middle = sparse.coo_array((share.sum(axis=1), (np.arange(n), np.arange(n))), shape=(n, n))
        maps.append((own - middle).tocsr())
    return Slopes(*maps)
