"""Fits of frames to the views between the points of a bank's grid.

About a grid point the range of a pixel changes linearly with distance and angle, by half of what it changes from one
neighbour to the other. The position in the cell is fitted, at most 0.6 of a step to either side, and what a linear
change leaves over half a step counts as an error of its own. A pixel whose return the grid point and all its neighbours
contradict costs :data:`DISAGREEMENT`; one of which some may return and others not says nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark.matcher.nearest.templates import Observation, Templates
from phasemark.matcher.pixel_agreement import DISAGREEMENT, MIN_RETURNS

__all__ = ["CellFits", "fit_cells", "moved_costs"]

_REACH = 0.6
"""Steps of the grid to either side that a fit may move."""
_SUMS = 8


class CellFits(NamedTuple):
    """χ² of the best position in some cells, and its degrees of freedom; arrays of one shape."""

    chi2: NDArray[np.float64]
    dof: NDArray[np.int64]


def fit_cells(groups: Sequence[tuple[Templates, Observation, NDArray[np.int64]]]) -> CellFits:
    """Fit the positions in k cells to each of n frames.

    Parameters
    ----------
    groups : sequence of (templates, frames, cells)
        Groups of pixels that see one view. Cells, (n, k, 5), are indices of templates: of the grid point, of its
        neighbours in distance and of those in angle: itself beyond an end of the grid. Where the first is negative,
        nothing is fitted.

    Returns
    -------
    CellFits
        (n, k), χ² infinite where nothing was fitted.
    """
    sums = np.zeros((*groups[0][2].shape[:2], _SUMS))
    for templates, seen, cells in groups:
        images = templates.range_m, templates.may_return, templates.must_return
        frames = templates.about(seen), seen.weight, seen.returned, seen.not_returned
        _add(sums, *images, *frames, cells, templates.sensor.unambiguous_range_m)
    dd, da, aa, d, a, left, n_compared, n_disagree = np.moveaxis(sums, -1, 0)
    determinant, trace = dd * aa - da**2, dd + aa
    # what the pixels do not tell stays 0: the least solution of the normal equations
    is_full = determinant > 1e-12 * trace**2
    over = np.where(is_full, determinant, np.maximum(trace**2, math.ulp(0.0)))
    by_distance = np.where(is_full, aa * d - da * a, dd * d + da * a) / over
    by_angle = np.where(is_full, dd * a - da * d, da * d + aa * a) / over
    may_move = n_compared >= MIN_RETURNS
    x, y = (np.clip(offset, -_REACH, _REACH) * may_move for offset in (by_distance, by_angle))
    chi2 = left - 2 * (x * d + y * a) + dd * x**2 + 2 * da * x * y + aa * y**2 + DISAGREEMENT * n_disagree
    is_fitted = groups[0][2][..., 0] >= 0
    dof = np.maximum(n_compared + n_disagree - 2, 0).astype(np.int64)
    return CellFits(np.where(is_fitted, np.maximum(chi2, 0.0), np.inf), dof)


def moved_costs(
    templates: Templates, seen: Observation, index: NDArray[np.int64], reach_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what n frames cost at templates of their own, (n, k), whose ranges all move by what fits best, and that.

    They move by `reach_m` at most.
    """
    cost, moved_m = np.empty(index.shape), np.empty(index.shape)
    images = templates.range_m, templates.may_return, templates.must_return
    frames = templates.about(seen), seen.weight, DISAGREEMENT * seen.returned, DISAGREEMENT * seen.not_returned
    _move(cost, moved_m, *images, *frames, index, reach_m, templates.sensor.unambiguous_range_m)
    return cost, moved_m


@njit(cache=True, nogil=True)
def _wrapped(difference, period):  # type: ignore[no-untyped-def]
    """Return the least difference on a circle of two values within half a period of its origin."""
    if difference > period / 2:
        return difference - period
    return difference + period if difference < -period / 2 else difference


@njit(cache=True, nogil=True)
def _beside(before, behind, is_first, is_last, period):  # type: ignore[no-untyped-def]
    """Return the differences to both neighbours; beyond an end of the grid the change goes on as on the other side."""
    before, behind = _wrapped(before, period), _wrapped(behind, period)
    return -behind if is_first else before, -before if is_last else behind


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _move(cost, moved_m, range_m, may, must, about, weight, lost, absent, at, reach_m, period):  # type: ignore[no-untyped-def]
    """Fill the costs of frames at templates whose ranges move by what fits best, and by how much they move."""
    for f in range(at.shape[0]):
        for k in range(at.shape[1]):
            c = at[f, k]
            total, along, weights = 0.0, 0.0, 0.0
            for p in range(about.shape[1]):
                residual = about[f, p] - range_m[c, p]
                residual = residual - period if residual > period / 2 else residual
                residual = residual + period if residual < -period / 2 else residual
                w = weight[f, p] if may[c, p] else 0.0
                weights += w
                along += w * residual
                total += w * residual * residual
                total += 0.0 if may[c, p] else lost[f, p]
                total += absent[f, p] if must[c, p] else 0.0
            moved = min(max(along / max(weights, 1e-300), -reach_m), reach_m)
            cost[f, k], moved_m[f, k] = total + moved * (moved * weights - 2 * along), moved


@njit(cache=True, nogil=True)
def _add(sums, range_m, may, must, about, weight, returned, absent, cells, period):  # type: ignore[no-untyped-def]
    """Add the normal equations of the pixels of a group to those of every cell."""
    for f in range(cells.shape[0]):
        for k in range(cells.shape[1]):
            at, near, far, left, right = cells[f, k]
            if at < 0:
                continue
            for p in range(about.shape[1]):
                if not (returned[f, p] or absent[f, p]):
                    continue
                if absent[f, p]:
                    every = must[at, p] and must[near, p] and must[far, p] and must[left, p] and must[right, p]
                    sums[f, k, 7] += every
                    continue
                every = may[at, p] and may[near, p] and may[far, p] and may[left, p] and may[right, p]
                if not every:
                    some = may[at, p] or may[near, p] or may[far, p] or may[left, p] or may[right, p]
                    sums[f, k, 7] += not some
                    continue
                here = np.float64(range_m[at, p])
                to_near, to_far = _beside(
                    range_m[near, p] - here, range_m[far, p] - here, at == near, at == far, period
                )
                to_left, to_right = _beside(
                    range_m[left, p] - here, range_m[right, p] - here, at == left, at == right, period
                )
                residual = _wrapped(about[f, p] - here, period)
                along, around = (to_far - to_near) / 2, (to_right - to_left) / 2
                bend = (abs(to_far + to_near) + abs(to_right + to_left)) / 2
                w = 1 / (1 / weight[f, p] + bend * bend)
                sums[f, k, 0] += w * along * along
                sums[f, k, 1] += w * along * around
                sums[f, k, 2] += w * around * around
                sums[f, k, 3] += w * along * residual
                sums[f, k, 4] += w * around * residual
                sums[f, k, 5] += w * residual * residual
                sums[f, k, 6] += 1
