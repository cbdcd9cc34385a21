"""The nearest template of a regular grid without comparing all of them: a thinned grid, then descent on the full one.

The whitened distance of a frame has few wide valleys, with ripples along δ on their floor where edges cross borders of
pixels. A descent starts at each of the lowest minima of a thinned grid, and goes to the lowest point within reach until
that is where it stands; its reach is longer than the ripples. Every cost on the way is that of
:meth:`~phasemark.matcher.nearest.templates.Templates.exact_costs`, in float64.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark.matcher.nearest.bank_minima import modes
from phasemark.matcher.nearest.grid import closing_period
from phasemark.matcher.nearest.templates import Observation, Templates
from phasemark.matcher.pixel_agreement import DISAGREEMENT

_THIN_M, _THIN_RAD = 0.06, math.radians(6)
"""Spacing of the thinned grid: finer than the valleys are wide."""
_REACH_M, _REACH_RAD = 0.01, math.radians(5)
"""How far a descent looks to either side: further than the ripples are wide."""
_WIDE_REACH_M, _WIDE_REACH_RAD = 0.03, math.radians(12)
"""The same before a background, where mixed pixels count and the ripples are wider."""
_N_STARTS = 6
"""Minima of the thinned grid from which descents start."""


class ExactSearch:
    """Compares a frame with every template of a block.

    Parameters
    ----------
    templates : Templates
        Blocks, one behind the other.
    size : int
        Templates in a block.
    """

    def __init__(self, templates: Templates, size: int) -> None:
        self._templates = templates
        self._size = size

    def nearest(self, seen: Observation, block: int = 0) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the nearest template of one block for each of n frames, (n,), and its distance."""
        first = block * self._size
        costs = self._templates.costs(seen, slice(first, first + self._size))
        best, least = np.zeros(len(costs), np.int64), np.zeros(len(costs))
        for k, row in enumerate(costs):
            best[k], least[k] = self._templates.best(seen, k, row, offset=first)
        return best, least


class PrunedSearch:
    """Looks for the nearest template of a block that is a regular grid.

    Parameters
    ----------
    templates : Templates
        Blocks of the grid, one behind the other; each (distance, δ), δ running fastest.
    distance_m, delta_rad : (d,), (a,) float64
    stride : (distance, δ)
        Every how many steps the thinned grid has a point.
    reach : (distance, δ)
        How many steps a descent looks to either side.
    """

    def __init__(
        self,
        templates: Templates,
        distance_m: NDArray[np.float64],
        delta_rad: NDArray[np.float64],
        stride: tuple[int, int],
        reach: tuple[int, int],
    ) -> None:
        self._templates = templates
        self._shape = len(distance_m), len(delta_rad)
        self._closes = closing_period(delta_rad) is not None
        self._reach = reach
        self._i, self._j = (np.arange(0, n, k) for n, k in zip(self._shape, stride, strict=True))
        block = np.arange(math.prod(self._shape)).reshape(self._shape)[:: stride[0], :: stride[1]].ravel()
        self._thin = [templates[first + block] for first in range(0, len(templates), math.prod(self._shape))]

    def nearest(self, seen: Observation, block: int = 0) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the lowest end of the descents that start at the lowest minima of the thinned grid, and its cost."""
        t = self._templates
        size = math.prod(self._shape)
        picked = slice(block * size, (block + 1) * size)
        thin = self._thin[block].costs(seen).reshape(-1, 1, len(self._i), len(self._j))
        frames = t.about(seen), seen.weight, DISAGREEMENT * seen.returned, DISAGREEMENT * seen.not_returned
        model = t.range_m[picked], t.may_return[picked], t.must_return[picked]
        found, cost = _descend(
            thin, _N_STARTS, self._i, self._j, self._shape[1], self._closes, self._reach, frames, model,
            t.sensor.unambiguous_range_m,
        )  # fmt: skip
        return found + picked.start, cost


def nearest_search(
    templates: Templates,
    distance_m: NDArray[np.float64],
    delta_rad: NDArray[np.float64],
    *,
    before_background: bool = False,
) -> ExactSearch | PrunedSearch:
    """Return the pruned search where the grid of each block is regular and fine, the exact one elsewhere."""
    steps = _regular_step(distance_m), _regular_step(delta_rad)
    if steps[0] is not None and steps[1] is not None:
        stride = _at_least_one(_THIN_M / steps[0]), _at_least_one(_THIN_RAD / steps[1])
        far = (_WIDE_REACH_M, _WIDE_REACH_RAD) if before_background else (_REACH_M, _REACH_RAD)
        reach = _at_least_one(far[0] / steps[0]), _at_least_one(far[1] / steps[1])
        least_thinning = 4  # A grid that is thinned by less than this is searched whole.
        if math.prod(stride) >= least_thinning:
            return PrunedSearch(templates, distance_m, delta_rad, stride, reach)
    return ExactSearch(templates, len(distance_m) * len(delta_rad))


def _regular_step(values: NDArray[np.float64]) -> float | None:
    step = np.diff(values)
    return float(step[0]) if len(step) and np.allclose(step, step[0], rtol=1e-6, atol=0) else None


def _at_least_one(steps: float) -> int:
    return max(round(steps), 1)


@njit(cache=True, nogil=True)
def _descend(thin, n_starts, thin_i, thin_j, n_a, closes, reach, seen, model, period):  # type: ignore[no-untyped-def]
    """Return the lowest point of the grid that descents reach, and its cost, for every frame."""
    about, weight, lost, absent = seen
    range_m, may, must = model
    reach_i, reach_j = reach
    n, n_points = len(about), len(range_m)
    n_d = n_points // n_a
    found, lowest = np.zeros(n, np.int64), np.full(n, np.inf)
    cost = np.empty(n_points)
    known_to = np.full(n_points, -1, np.int32)
    for k in range(n):
        starts = modes(thin[k : k + 1], 0, n_starts, closes, 1)
        for s in range(n_starts):
            _, i0, j0 = starts[s]
            if i0 < 0:
                break
            at = thin_i[i0] * n_a + thin_j[j0]
            best = np.inf
            while True:
                i, j = divmod(at, n_a)
                centre = at
                for ii in range(max(i - reach_i, 0), min(i + reach_i + 1, n_d)):
                    for dj in range(-reach_j, reach_j + 1):
                        jj = j + dj
                        if closes:
                            jj %= n_a
                        elif jj < 0 or jj >= n_a:
                            continue
                        c = ii * n_a + jj
                        if known_to[c] != k:
                            cost[c] = _cost(
                                about[k], weight[k], lost[k], absent[k], range_m[c], may[c], must[c], period
                            )
                            known_to[c] = k
                        if cost[c] < best:
                            best, at = cost[c], c
                if at == centre:
                    break
            if best < lowest[k]:
                lowest[k], found[k] = best, at
    return found, lowest


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _cost(about, weight, lost, absent, range_m, may, must, period):  # type: ignore[no-untyped-def]
    """Return the whitened distance of one frame from one template."""
    total = 0.0
    for p in range(len(about)):
        # both lie within half a period of the mean, so that one turn at most is to be taken off
        residual = abs(about[p] - range_m[p])
        residual = min(residual, period - residual)
        total += weight[p] * residual * residual if may[p] else lost[p]
        total += absent[p] if must[p] else 0.0
    return total
