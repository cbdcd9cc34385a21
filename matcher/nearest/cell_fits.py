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

__all__ = ["CellFits", "Group", "fit_cells", "moved_costs"]

_REACH = 0.6
"""Steps of the grid to either side that a fit may move."""
_SUMS = 8


Group = tuple[Templates, Observation, NDArray[np.int64]]
"""Pixels of images and frames, and which images a fit takes."""


class CellFits(NamedTuple):
    """χ² of the best position in each of m cells, and its degrees of freedom; (m,) each."""

    chi2: NDArray[np.float64]
    dof: NDArray[np.int64]


def fit_cells(groups: Sequence[Group], frame: NDArray[np.int64]) -> CellFits:
    """Fit the position in each of m cells to a frame.

    Parameters
    ----------
    groups : sequence of (templates, frames, cells)
        Groups of pixels that see one view. Cells, (m, 5), are indices of templates: of the grid point, of its
        neighbours in distance and of those in angle: itself beyond an end of the grid.
    frame : (m,) int64
        Which of the frames.
    """
    sums = np.zeros((len(frame), _SUMS))
    for templates, seen, cells in groups:
        images = templates.range_m, templates.may_return, templates.must_return
        frames = templates.about(seen), seen.weight, seen.returned, seen.not_returned
        _add(sums, *images, *frames, frame, cells, templates.sensor.unambiguous_range_m)
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
    return CellFits(np.maximum(chi2, 0.0), np.maximum(n_compared + n_disagree - 2, 0).astype(np.int64))


def moved_costs(group: Group, frame: NDArray[np.int64], reach_m: float) -> tuple[NDArray[np.float64], ...]:
    """Return what frames cost at templates whose ranges move by what fits best, `reach_m` at most, and that; (m,) each.

    Parameters
    ----------
    group : (templates, frames, index)
        Index of templates, (m,).
    frame : (m,) int64
        Which of the frames.
    reach_m : float
    """
    templates, seen, index = group
    cost, moved_m = np.empty(len(index)), np.empty(len(index))
    images = templates.range_m, templates.may_return, templates.must_return
    frames = templates.about(seen), seen.weight, DISAGREEMENT * seen.returned, DISAGREEMENT * seen.not_returned
    _move(cost, moved_m, *images, *frames, frame, index, reach_m, templates.sensor.unambiguous_range_m)
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
def _move(cost, moved_m, range_m, may, must, about, weight, lost, absent, frame, index, reach_m, period):  # type: ignore[no-untyped-def]
    """Fill the costs of frames at templates whose ranges move by what fits best, and by how much they move."""
    for k in range(len(frame)):
        f, at = frame[k], index[k]
        total, along, weights = 0.0, 0.0, 0.0
        for p in range(about.shape[1]):
            residual = about[f, p] - range_m[at, p]
            residual = residual - period if residual > period / 2 else residual
            residual = residual + period if residual < -period / 2 else residual
            w = weight[f, p] if may[at, p] else 0.0
            weights += w
            along += w * residual
            total += w * residual * residual
            total += 0.0 if may[at, p] else lost[f, p]
            total += absent[f, p] if must[at, p] else 0.0
        moved = min(max(along / max(weights, 1e-300), -reach_m), reach_m)
        cost[k], moved_m[k] = total + moved * (moved * weights - 2 * along), moved


@njit(cache=True, nogil=True)
def _add(sums, range_m, may, must, about, weight, returned, absent, frame, cells, period):  # type: ignore[no-untyped-def]
    """Add the normal equations of the pixels of a group to those of every cell."""
    for k in range(len(frame)):
        f = frame[k]
        at, near, far, left, right = cells[k]
        for p in range(about.shape[1]):
            if absent[f, p]:
                every = must[at, p] and must[near, p] and must[far, p] and must[left, p] and must[right, p]
                sums[k, 7] += every
            if not returned[f, p]:
                continue
            every = may[at, p] and may[near, p] and may[far, p] and may[left, p] and may[right, p]
            if not every:
                some = may[at, p] or may[near, p] or may[far, p] or may[left, p] or may[right, p]
                sums[k, 7] += not some
                continue
            here = np.float64(range_m[at, p])
            to_near, to_far = _beside(range_m[near, p] - here, range_m[far, p] - here, at == near, at == far, period)
            to_left, to_right = _beside(
                range_m[left, p] - here, range_m[right, p] - here, at == left, at == right, period
            )
            residual = _wrapped(about[f, p] - here, period)
            along, around = (to_far - to_near) / 2, (to_right - to_left) / 2
            bend = (abs(to_far + to_near) + abs(to_right + to_left)) / 2
            w = 1 / (1 / weight[f, p] + bend * bend)
            sums[k, 0] += w * along * along
            sums[k, 1] += w * along * around
            sums[k, 2] += w * around * around
            sums[k, 3] += w * along * residual
            sums[k, 4] += w * around * residual
            sums[k, 5] += w * residual * residual
            sums[k, 6] += 1
