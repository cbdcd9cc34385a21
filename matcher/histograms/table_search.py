"""Initial guesses from a table of histograms: by moments and a descent, or by least squares before planes.

Pile-up is taken off the counts first, and ambient light is that of the bins without a peak; both are good enough for
where a likelihood has its hills. What is found is refined with exact scenes afterwards.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.histograms.histogram_table import STATISTICS, Table, signal_between
from phasemark.matcher.histograms.poisson_fit import LEAST_COUNT, log_term
from phasemark.render.kernel import inner, kernel

DESCENT_MARGIN = 100.0
"""A descent that cannot come within this of the best one is given up."""
DIMMEST, BRIGHTEST = 0.1, 10.0
"""Brightness of a landmark over that of its bank between which it is looked for."""
_STEPS = 8
_HALVINGS = 3
_DONE = 0.05  # of a standard deviation
_ROUNDS = 6
"""Of a descent that varies one brightness after another."""
_MOST = 3
"""Lowest minima of a table's nodes that are followed, of each class."""


class TableStart(NamedTuple):
    """A place in a table where a frame may come from.

    Parameters
    ----------
    class_index : int
    place : (2,) float64
        Distance and δ.
    bright : float
    ratios : (planes,) float64
        Brightness of each plane over that of the landmark.
    cost : float
        Deviance of the frame there; before planes, its weighted squared distance from the node.
    """

    class_index: int
    place: NDArray[np.float64]
    bright: float
    ratios: NDArray[np.float64]
    cost: float


def ambient_light(counts: NDArray[np.float64], extra: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ambient light of each zone: the mean of the bins that do not rise above it, (zones,)."""
    net = counts - extra
    use = np.ones(net.shape, bool)
    level = net.mean(axis=1)
    trims = 5
    trim_sigma = 3.0
    for _ in range(trims):
        use = net <= (level + trim_sigma * np.sqrt(np.maximum(level, 1.0)))[:, None]
        level = np.where(use, net, 0.0).sum(axis=1) / np.maximum(use.sum(axis=1), 1)
    return np.asarray(np.maximum(level, LEAST_COUNT), dtype=np.float64)


def find_hills(
    table: Table, counts: NDArray[np.float64], ambient: NDArray[np.float64], extra: NDArray[np.float64],
    n_frames: float, limit: float = math.inf,
) -> list[TableStart]:  # fmt: skip
    """Return where the likelihood of one frame has hills, and its deviance there.

    Parameters
    ----------
    table : Table
    counts : (zones, bins) float64
        Pile-up taken off.
    ambient : (zones,) float64
    extra : (bins,) float64
        Counts of the cover glass.
    n_frames : float
        Frames that were added up.
    limit : float
        A descent that cannot come below this is given up; so is one that cannot come near the best before it.
    """
    n_classes, n_distance, n_delta, n_zones, _ = table.signal.shape
    white = np.zeros((n_distance, n_zones, STATISTICS, STATISTICS))
    seen, unexplained = np.empty((n_distance, n_zones, STATISTICS)), np.empty(n_distance)
    _whiten(table, counts, ambient, extra, white, seen, np.empty((STATISTICS, STATISTICS)), unexplained)
    cost, bright = np.empty((n_classes, n_distance, n_delta)), np.empty((n_classes, n_distance, n_delta))
    _grid_costs(table, n_frames, white, seen, unexplained, cost, bright)
    starts = [(c, *node) for c in range(n_classes) for node in grid_minima(cost[c], table.cyclic)]
    starts.sort(key=lambda node: float(cost[node]))
    dark_cost = np.empty(counts.shape)
    total = _dark_deviance(counts, ambient, extra, dark_cost)
    signal, nodes, information, gradient = np.empty((3, *counts.shape)), np.empty((4, 4)), np.empty((3, 3)), np.empty(3)
    hills = []
    for c, i, j in starts:
        place = _place_of(table, i, j)
        scale, found = _descend(
            table, c, counts, ambient, extra, n_frames, dark_cost, total, limit, place, bright[c, i, j], signal,
            nodes, information, gradient,
        )  # fmt: skip
        limit = min(limit, found + DESCENT_MARGIN)
        hills.append(TableStart(c, place, scale, np.empty(0), found))
    return hills


def find_hills_before(
    table: Table, counts: NDArray[np.float64], ambient: NDArray[np.float64], extra: NDArray[np.float64],
    n_frames: float, light: NDArray[np.float64],
) -> list[TableStart]:  # fmt: skip
    """Return the lowest minima of a table before planes, the brightness of every surface at its best; best first.

    Parameters
    ----------
    table, counts, ambient, extra, n_frames
        As for :func:`find_hills`.
    light : (planes, zones, bins) float64
        Counts of the planes in one frame, with nothing before them.
    """
    net = counts - ambient[:, None] - extra
    weight = 1 / np.maximum(np.maximum(ambient[:, None] + extra, counts), 1.0)
    light = n_frames * light
    power = np.einsum("pzj,qzj,zj->zpq", light, light, weight)
    along = np.einsum("pzj,zj,zj->zp", light, net, weight)
    shape = table.signal.shape[:3]
    cost, scales = np.empty(shape), np.empty((*shape, 1 + len(light)))
    q = 1 + len(light)
    _costs_before(table, n_frames, net, weight, light, power, along, float((weight * net**2).sum()),
                  np.empty((q, q + 1)), np.empty(q), cost, scales)  # fmt: skip
    starts = []
    for c in range(len(cost)):
        for node in grid_minima(cost[c], table.cyclic):
            bright, *of_planes = scales[c][node]
            ratios = np.array(of_planes) / bright
            starts.append(TableStart(c, _place_of(table, *node), float(bright), ratios, float(cost[c][node])))
    return sorted(starts, key=lambda start: start.cost)


def _place_of(table: Table, i: int, j: int) -> NDArray[np.float64]:
    """Return distance and δ of a node."""
    return np.array([table.grid[0] + table.grid[1] * i, table.grid[2] + table.grid[3] * j])


def grid_minima(cost: NDArray[np.float64], cyclic: bool) -> list[tuple[int, int]]:
    """Return the lowest nodes that lie below their neighbours; the last angle may be followed by the first."""
    n, m = cost.shape
    padded = np.pad(cost, 1, constant_values=np.inf)
    if cyclic:
        padded[1:-1, 0], padded[1:-1, -1] = cost[:, -1], cost[:, 0]
    around = [padded[a : a + n, b : b + m] for a in range(3) for b in range(3)]
    low = cost <= np.minimum.reduce(around)
    order = np.argsort(cost[low], kind="stable")[:_MOST]
    return [(int(i), int(j)) for i, j in np.argwhere(low)[order]]


@kernel
def _dark_deviance(counts, ambient, extra, out):  # type: ignore[no-untyped-def]
    """Fill the deviance of every bin from ambient light alone; returns their sum."""
    total = 0.0
    for z in range(counts.shape[0]):
        for j in range(counts.shape[1]):
            out[z, j] = log_term(counts[z, j], ambient[z] + extra[j])
            total += out[z, j]
    return total


@kernel
def _whiten(table, counts, ambient, extra, white, seen, sums, unexplained):  # type: ignore[no-untyped-def]
    """Fill what whitens the moments of every zone about every distance, the frame's own ones, and their square sum."""
    _, n_distance, _, n_zones, width = table.signal.shape
    n_bins = counts.shape[1]
    for i in range(n_distance):
        unexplained[i] = 0.0
    for z in range(n_zones):
        net_all, variance_all = 0.0, 1.0
        for j in range(n_bins):
            net_all += counts[z, j] - ambient[z] - extra[j]
            variance_all += max(ambient[z] + extra[j], counts[z, j])
        for i in range(n_distance):
            first = table.first_bin[i]
            low, high = max(first, 0), min(first + width, n_bins)
            net, variance = 0.0, 1e-9
            for j in range(low, high):
                net += counts[z, j] - ambient[z] - extra[j]
                variance += max(ambient[z] + extra[j], counts[z, j])
            unexplained[i] += (net_all - net) ** 2 / (variance_all - variance)
            if not table.lit[i, z]:
                unexplained[i] += net * net / variance
                continue
            for a in range(STATISTICS):
                seen[i, z, a] = 0.0
                for b in range(STATISTICS):
                    sums[a, b] = 1e-9 if a == b else 0.0
            for j in range(low, high):
                net = counts[z, j] - ambient[z] - extra[j]
                variance = max(ambient[z] + extra[j], counts[z, j])
                for a in range(STATISTICS):
                    w = table.basis[j - first, a]
                    seen[i, z, a] += w * net
                    for b in range(a + 1):
                        sums[a, b] += w * table.basis[j - first, b] * variance
            # the inverse of the Cholesky factor, row by row, whitens
            l00 = math.sqrt(sums[0, 0])
            l10, l20 = sums[1, 0] / l00, sums[2, 0] / l00
            l11 = math.sqrt(max(sums[1, 1] - l10 * l10, 1e-9))
            l21 = (sums[2, 1] - l20 * l10) / l11
            l22 = math.sqrt(max(sums[2, 2] - l20 * l20 - l21 * l21, 1e-9))
            white[i, z, 0, 0], white[i, z, 1, 1], white[i, z, 2, 2] = 1 / l00, 1 / l11, 1 / l22
            white[i, z, 1, 0] = -l10 / (l00 * l11)
            white[i, z, 2, 0] = (l10 * l21 - l20 * l11) / (l00 * l11 * l22)
            white[i, z, 2, 1] = -l21 / (l11 * l22)
            for a in range(STATISTICS - 1, -1, -1):
                total = 0.0
                for b in range(a + 1):
                    total += white[i, z, a, b] * seen[i, z, b]
                seen[i, z, a] = total
                unexplained[i] += total * total


@kernel
def _grid_costs(table, n_frames, white, seen, unexplained, cost, bright):  # type: ignore[no-untyped-def]
    """Fill the whitened squared distance of the frame's moments from those of every node, brightness at its best."""
    n_classes, n_distance, n_delta, n_zones, _ = table.signal.shape
    for c in range(n_classes):
        for i in range(n_distance):
            for j in range(n_delta):
                along, power = 0.0, 1e-30
                for z in range(n_zones):
                    if not table.lit[i, z]:
                        continue
                    w = white[i, z]
                    m0 = table.moments[c, i, j, z, 0] * n_frames
                    m1 = table.moments[c, i, j, z, 1] * n_frames
                    m2 = table.moments[c, i, j, z, 2] * n_frames
                    s0 = w[0, 0] * m0
                    s1 = w[1, 0] * m0 + w[1, 1] * m1
                    s2 = w[2, 0] * m0 + w[2, 1] * m1 + w[2, 2] * m2
                    along += s0 * seen[i, z, 0] + s1 * seen[i, z, 1] + s2 * seen[i, z, 2]
                    power += s0 * s0 + s1 * s1 + s2 * s2
                best = min(max(along / power, DIMMEST), BRIGHTEST)
                bright[c, i, j] = best
                cost[c, i, j] = unexplained[i] - 2 * best * along + best * best * power


@kernel
def _descend(  # type: ignore[no-untyped-def]
    table, c, counts, ambient, extra, n_frames, dark_cost, total, limit, place, bright, signal, nodes, information,
    gradient,
):  # fmt: skip
    """Go downhill from a node by Fisher scoring; `place` is moved. Returns brightness and deviance."""
    _, n_distance, n_delta, n_zones, _ = table.signal.shape
    low_m, high_m = table.grid[0], table.grid[0] + table.grid[1] * (n_distance - 1)
    low_rad, high_rad = table.grid[2], table.grid[2] + table.grid[3] * (n_delta - 1)
    best_cost = math.inf
    at_m, at_rad, at_bright = place[0], place[1], bright
    d_m, d_rad, d_bright, shrink = 0.0, 0.0, 0.0, 1.0
    steps, halvings = 0, 0
    hope = 4.0  # the most that can still be gained, over the gain that a step promises
    while steps < _STEPS:
        try_m = min(max(at_m + shrink * d_m, low_m), high_m)
        try_rad = at_rad + shrink * d_rad
        if not table.cyclic:
            try_rad = min(max(try_rad, low_rad), high_rad)
        try_bright = min(max(at_bright * math.exp(shrink * d_bright), DIMMEST), BRIGHTEST)
        start, stop = signal_between(table, c, try_m, try_rad, nodes, signal)
        cost = total
        for a in range(3):
            gradient[a] = 0.0
            for b in range(3):
                information[a, b] = 0.0
        scale = try_bright * n_frames
        for z in range(n_zones):
            for j in range(start, stop):
                s = scale * signal[0, z, j]
                if s == 0.0:
                    continue
                mean = s + ambient[z] + extra[j]
                cost += log_term(counts[z, j], mean) - dark_cost[z, j]
                by_m, by_rad = scale * signal[1, z, j], scale * signal[2, z, j]
                excess, weight = counts[z, j] / mean - 1.0, 1.0 / mean
                gradient[0] += by_m * excess
                gradient[1] += by_rad * excess
                gradient[2] += s * excess
                information[0, 0] += by_m * by_m * weight
                information[0, 1] += by_m * by_rad * weight
                information[0, 2] += by_m * s * weight
                information[1, 1] += by_rad * by_rad * weight
                information[1, 2] += by_rad * s * weight
                information[2, 2] += s * s * weight
        if not cost <= best_cost:
            halvings += 1
            if halvings > _HALVINGS:
                break
            shrink *= 0.3
            continue
        at_m, at_rad, at_bright, best_cost = try_m, try_rad, try_bright, cost
        shrink, halvings = 1.0, 0
        steps += 1
        # Cholesky of the information, its diagonal raised a little
        l00 = math.sqrt(information[0, 0] * 1.001 + 1e-12)
        l10, l20 = information[0, 1] / l00, information[0, 2] / l00
        l11 = math.sqrt(max(information[1, 1] * 1.001 - l10 * l10, 1e-12))
        l21 = (information[1, 2] - l20 * l10) / l11
        l22 = math.sqrt(max(information[2, 2] * 1.001 - l20 * l20 - l21 * l21, 1e-12))
        y0 = gradient[0] / l00
        y1 = (gradient[1] - l10 * y0) / l11
        y2 = (gradient[2] - l20 * y0 - l21 * y1) / l22
        d_bright = y2 / l22
        d_rad = (y1 - l21 * d_bright) / l11
        d_m = (y0 - l10 * d_rad - l20 * d_bright) / l00
        gain = y0 * y0 + y1 * y1 + y2 * y2
        if gain < _DONE * _DONE or (steps > 1 and cost - hope * gain > limit):
            break
        longest = max(abs(d_m) / table.grid[1], abs(d_rad) / table.grid[3], 2 * abs(d_bright), 1.0)
        d_m, d_rad, d_bright = d_m / longest, d_rad / longest, d_bright / longest
    place[0], place[1] = at_m, at_rad
    return at_bright, best_cost


@kernel
def _costs_before(  # type: ignore[no-untyped-def]
    table, n_frames, net, weight, light, power, along, whole, normal, best, cost, scales,
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
                    share = table.visible[c, i, j]
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


@inner
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
