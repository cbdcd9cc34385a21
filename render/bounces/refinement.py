"""Sizes of patches: fine where light is and where surfaces are close, coarse where it is dark (PHYSICS section 12)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from phasemark.render.bounces.patches import Patches, SizeAt

_BRIGHT, _DIMMEST = 0.3, 0.004
"""Shares of the brightest patch's light from which on, and down to which, patches grow in darkness."""
_GAP = 0.5
"""Size where surfaces are close, as a share of the gap between them."""
_CONTINUES = 0.5
"""Least cosine between normals of a surface and of another that may be its continuation around a bend."""


def even_sizes(share: float, lens_m: NDArray[np.float64]) -> SizeAt:
    """Return sizes that are a share of the distance from the nearest of some lenses, (n, 3)."""

    def size_at(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(share * np.linalg.norm(points[:, None] - lens_m, axis=2).min(axis=1))

    return size_at


def sizes_for_light(wanted_at: SizeAt, coarse: Patches, light: NDArray[np.float64], finest: float) -> SizeAt:
    """Return sizes that follow the light on coarse patches, (n,), and the gaps between surfaces.

    Light counts twice, for what a patch sends on and for what of it returns; sizes go with its fourth root inverted.
    Near another surface a patch is half as large as the gap, or `finest` as a share of its size elsewhere.
    """
    brightest = light.max(initial=0.0) or 1.0  # in darkness all are coarse
    darkness = np.clip(light / (_BRIGHT * brightest), _DIMMEST / _BRIGHT, 1.0) ** -0.25
    reach = float(np.ptp(coarse.centre, axis=0).max())  # normals count as much as places
    tree = cKDTree(np.concatenate([coarse.centre, reach * coarse.normal], axis=1))

    def size_at(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
        wanted = wanted_at(points, normals)
        sides = [tree.query(np.concatenate([points, side * reach * normals], axis=1)) for side in (1, -1)]
        (away, near), (away_behind, near_behind) = sides
        dark = np.where(away < away_behind, darkness[near], darkness[near_behind])
        return np.asarray(dark * np.clip(_GAP * _gaps(points, normals, coarse), finest * wanted, wanted))

    return size_at


def _gaps(points: NDArray[np.float64], normals: NDArray[np.float64], patches: Patches) -> NDArray[np.float64]:
    """Return how far points of surfaces are from the nearest patch of another that they lie before, taken as a disc."""
    out = np.empty(len(points))
    unit = patches.normal / np.linalg.norm(patches.normal, axis=1, keepdims=True)
    at_once = 1024
    for start in range(0, len(points), at_once):
        part = slice(start, start + at_once)
        to = points[part, None] - patches.centre
        distance = np.linalg.norm(to, axis=2)
        height = np.einsum("ijk,jk->ij", to, unit)
        aside = np.sqrt(np.maximum(distance**2 - height**2, 0.0))
        gap = np.hypot(height, np.maximum(aside - 0.5 * patches.size, 0.0))
        continues = (np.abs(normals[part] @ unit.T) > _CONTINUES) & (height < 0.5 * distance)
        gap[(height <= patches.lift_m) | continues] = np.inf
        out[part] = gap.min(axis=1)
    return out
