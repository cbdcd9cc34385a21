"""Fits of frames to the views between the points of a bank's grid.

About a grid point the range of a pixel changes linearly with distance and angle, by half of what it changes from one
neighbour to the other. The position is fitted, at most one step to either side, and what a linear change leaves over
half a step counts as an error of its own. A pixel whose return the grid point and all its neighbours contradict costs
:data:`DISAGREEMENT`; a return that some of them may show and others not says nothing, but among fits costs one, as a
pixel does on average.
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
from phasemark.render.phasor_images import wrap_difference_m

__all__ = ["CellFits", "Group", "best_moves", "fit_cells", "follow_distance", "moved_costs"]

_REACH = 1.0
"""Steps of the grid to either side that a fit may move."""
_RISES_BY = 0.8
"""By how much of it the range of a pixel that follows the distance changes more or less than that."""
_SUMS = 9


Group = tuple[Templates, Observation, NDArray[np.int64]]
"""Pixels of images and frames, and which images a fit takes."""


class CellFits(NamedTuple):
    """χ² of the best position in each of m cells, its degrees of freedom, and what to compare fits by; (m,) each.

    `offset`, (m, 2), is where the position would be if it could leave the cell: steps in distance and angle.
    """

    chi2: NDArray[np.float64]
    dof: NDArray[np.int64]
    cost: NDArray[np.float64]
    offset: NDArray[np.float64]


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
    dd, da, aa, d, a, left, n_compared, n_disagree, n_undecided = np.moveaxis(sums, -1, 0)
    determinant, trace = dd * aa - da**2, dd + aa
    # what the pixels do not tell stays 0: the least solution of the normal equations
    is_full = determinant > 1e-12 * trace**2
    over = np.where(is_full, determinant, np.maximum(trace**2, math.ulp(0.0)))
    by_distance = np.where(is_full, aa * d - da * a, dd * d + da * a) / over
    by_angle = np.where(is_full, dd * a - da * d, da * d + aa * a) / over
    places = n_compared >= MIN_RETURNS
    x, y = (np.clip(offset, -_REACH, _REACH) for offset in (by_distance, by_angle))
    residual = np.maximum(left - 2 * (x * d + y * a) + dd * x**2 + 2 * da * x * y + aa * y**2, 0.0)
    n = n_compared + n_disagree
    chi2 = np.where(places, residual, DISAGREEMENT * n_compared) + DISAGREEMENT * n_disagree
    cost = chi2 + np.where(places, 1.0, DISAGREEMENT) * n_undecided
    offset = np.stack([by_distance, by_angle], axis=-1)
    return CellFits(chi2, np.maximum(n - 2, 0).astype(np.int64), cost, offset)


def follow_distance(templates: Templates, distance_m: NDArray[np.float64], angles: int) -> NDArray[np.bool_]:
    """Return which pixels of templates have a range that grows as the distance does, (t, pixels).

    A wall behind the landmark does not, nor do pixels at the landmark's edges that see both.

    Parameters
    ----------
    templates : Templates
        Of classes at distances at angles, in this order.
    distance_m : (n,) float64
        Of the grid.
    angles : int
        How many.
    """
    n = len(distance_m)
    shape = -1, n, angles, templates.range_m.shape[1]
    range_m, may_return = templates.range_m.reshape(shape), templates.may_return.reshape(shape)
    follows = np.empty_like(may_return)
    for i in range(n):
        near, far = max(i - 1, 0), min(i + 1, n - 1)
        rise_m = wrap_difference_m(range_m[:, far] - range_m[:, near], templates.sensor)
        apart_m = distance_m[far] - distance_m[near]
        follows[:, i] = may_return[:, i] & (np.abs(rise_m - apart_m) <= _RISES_BY * apart_m)
    return follows.reshape(templates.may_return.shape)


def best_moves(group: Group, follows: NDArray[np.bool_], frame: NDArray[np.int64], off_m: float) -> NDArray[np.float64]:
    """Return by how much the ranges of templates have to move to fit frames best; (m,).

    Parameters
    ----------
    group : (templates, frames, index)
        Index of templates, (m,).
    follows : (t, pixels) bool
        Pixels of templates that move, see :func:`follow_distance`.
    frame : (m,) int64
        Which of the frames.
    off_m : float
        Pixels that are farther off say nothing.
    """
    templates, seen, index = group
    moved_m = np.empty(len(index))
    period = templates.sensor.unambiguous_range_m
    _move(moved_m, templates.range_m, follows, templates.about(seen), seen.weight, frame, index, off_m, period)
    return moved_m


def moved_costs(
    group: Group, follows: NDArray[np.bool_], frame: NDArray[np.int64], moved_m: NDArray[np.float64], off_m: float
) -> NDArray[np.float64]:
    """Return what frames cost at templates whose ranges move, a pixel :data:`DISAGREEMENT` at most; (m,).

    Parameters
    ----------
    group, follows, frame
        As in :func:`best_moves`.
    moved_m : (m,) float64
    off_m : float
        Standard deviation of an error of ranges besides that of the frames.
    """
    templates, seen, index = group
    cost = np.empty(len(index))
    images = templates.range_m, templates.may_return, templates.must_return, follows
    weight = seen.weight / (1 + seen.weight * off_m**2)
    frames = templates.about(seen), weight, DISAGREEMENT * seen.returned, DISAGREEMENT * seen.not_returned
    _add_moved(cost, *images, *frames, frame, index, moved_m, templates.sensor.unambiguous_range_m)
    return cost


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
def _move(moved_m, range_m, follows, about, weight, frame, index, off_m, period):  # type: ignore[no-untyped-def]
    """Fill by how much templates move; without branches, so that several pixels are done at once."""
    for k in range(len(frame)):
        f, at = frame[k], index[k]
        along, weights = 0.0, 0.0
        for p in range(about.shape[1]):
            off = about[f, p] - range_m[at, p]
            off = off - period if off > period / 2 else off
            off = off + period if off < -period / 2 else off
            w = weight[f, p] if follows[at, p] & (abs(off) <= off_m) else 0.0
            weights += w
            along += w * off
        moved_m[k] = along / max(weights, 1e-300)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _add_moved(cost, range_m, may, must, follows, about, weight, lost, absent, frame, index, moved_m, period):  # type: ignore[no-untyped-def]
    """Fill the costs at templates that have moved."""
    for k in range(len(frame)):
        f, at, moved = frame[k], index[k], moved_m[k]
        total = 0.0
        for p in range(about.shape[1]):
            off = about[f, p] - range_m[at, p] - (moved if follows[at, p] else 0.0)
            off = off - period if off > period / 2 else off
            off = off + period if off < -period / 2 else off
            total += min(weight[f, p] * off * off, DISAGREEMENT) if may[at, p] else lost[f, p]
            total += absent[f, p] if must[at, p] else 0.0
        cost[k] = total


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
                sums[k, 8 if some else 7] += 1
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
