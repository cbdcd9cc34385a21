"""Initial guesses before planes: the nodes of a table by least squares, the brightness of every surface at its best."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.histograms.background_table import TableBefore
from phasemark.matcher.histograms.table_search import BRIGHTEST, DIMMEST, grid_minima
from phasemark.render.kernel import kernel

_ROUNDS = 6
"""Of a descent that varies one brightness after another."""


def grid_starts(
    before: TableBefore, counts: NDArray[np.float64], ambient: NDArray[np.float64], extra: NDArray[np.float64],
    n_frames: float, light: NDArray[np.float64], most: int = 3,
) -> list[tuple[int, float, float, float, NDArray[np.float64], float]]:  # fmt: skip
    """Return class, distance, δ, brightness, that of the planes, and cost of a table's lowest minima.

    Parameters
    ----------
    before : TableBefore
    counts : (zones, bins) float64
        Pile-up taken off.
    ambient : (zones,) float64
    extra : (bins,) float64
        Counts of the cover glass.
    n_frames : float
        Frames that were added up.
    light : (planes, zones, bins) float64
        Counts of the planes in one frame, with nothing before them.
    most : int
        Minima of each class.
    """
    table = before.table
    net = counts - ambient[:, None] - extra
    weight = 1 / np.maximum(np.maximum(ambient[:, None] + extra, counts), 1.0)
    light = n_frames * light
    power = np.einsum("pzj,qzj,zj->zpq", light, light, weight)
    along = np.einsum("pzj,zj,zj->zp", light, net, weight)
    shape = table.signal.shape[:3]
    cost, scales = np.empty(shape), np.empty((*shape, 1 + len(light)))
    q = 1 + len(light)
    _grid_costs(table, before.visible, n_frames, net, weight, light, power, along, float((weight * net**2).sum()),
                np.empty((q, q + 1)), np.empty(q), cost, scales)  # fmt: skip
    starts = []
    for c in range(shape[0]):
        for i, j in grid_minima(cost[c], table.cyclic, most).tolist():
            bright = float(scales[c, i, j, 0])
            place = (float(table.grid[0] + table.grid[1] * i), float(table.grid[2] + table.grid[3] * j))
            starts.append((c, *place, bright, scales[c, i, j, 1:] / bright, float(cost[c, i, j])))
    return sorted(starts, key=lambda start: start[-1])


@kernel
def _grid_costs(  # type: ignore[no-untyped-def]
    table, visible, n_frames, net, weight, light, power, along, whole, normal, best, cost, scales,
):  # fmt: skip
    """Fill the least weighted squared distance of the frame from every node, and the brightness of each surface."""
    n_classes, n_distance, n_delta, n_zones, width = table.signal.shape
    n_planes, _, n_bins = light.shape
    q = 1 + n_planes
    for c in range(n_classes):
        for i in range(n_distance):
            first = table.first_bin[i]
            low, high = max(first, 0), min(first + width, n_bins)
            for j in range(n_delta):
                for a in range(q):
                    for b in range(q + 1):
                        normal[a, b] = 0.0
                for z in range(n_zones):
                    share = visible[c, i, j]
                    if table.lit[i, z]:
                        row = table.signal[c, i, j, z]
                        for m in range(low, high):
                            s = row[m - first] * n_frames
                            w = s * weight[z, m]
                            normal[0, 0] += w * s
                            normal[0, q] += w * net[z, m]
                            for p in range(n_planes):
                                normal[0, 1 + p] += w * share[p, z] * light[p, z, m]
                    for p in range(n_planes):
                        normal[1 + p, q] += share[p, z] * along[z, p]
                        for r in range(p, n_planes):
                            normal[1 + p, 1 + r] += share[p, z] * share[r, z] * power[z, p, r]
                cost[c, i, j] = whole + _least(normal, best)
                for a in range(q):
                    scales[c, i, j, a] = best[a]


@kernel
def _least(normal, best):  # type: ignore[no-untyped-def]
    """Fill the brightness of each surface that explains a frame best; returns by how much that lowers the cost.

    `normal` has the upper triangle of the normal equations and their right side as its last column.
    """
    q = len(best)
    for a in range(q):
        best[a] = 0.0
    for _ in range(_ROUNDS):  # coordinate descent, for each stays within its bounds
        for a in range(q):
            rest = normal[a, q]
            for b in range(q):
                if b != a:
                    rest -= normal[min(a, b), max(a, b)] * best[b]
            best[a] = rest / max(normal[a, a], 1e-30)
            best[a] = min(max(best[a], DIMMEST), BRIGHTEST) if a == 0 else max(best[a], 0.0)
    total = 0.0
    for a in range(q):
        total -= 2 * best[a] * normal[a, q]
        for b in range(q):
            total += best[a] * best[b] * normal[min(a, b), max(a, b)]
    return total
