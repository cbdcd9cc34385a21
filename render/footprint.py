"""Which rays a pixel needs: its active area split along the projected edges, with Gauss points in every smooth piece.

Edges cut a pixel into pieces inside which the integrand is smooth. Along one image axis (the *sweep*) the pixel is cut
into slabs wherever an edge begins, ends, crosses another, enters or leaves; within a slab the edges do not cross, so
every line across it meets them in the same order, and the pieces between them are trapezoids. A few Gauss lines in the
slab, and a few Gauss points between neighbouring edges on each line, integrate them.

Beside the limb of a curved surface cos θ falls like the square root of the distance x to the silhouette, where plain
Gauss points converge badly. There the points are placed in s with x = s², or, between two limbs, in τ with
x = c + w sin τ; both make the integrand smooth again. The limb may lie in the neighbouring pixel, so those are asked.
The sweep runs along the limb, so that lines cross it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

MAX_SEGMENTS = 128
"""Edges in a box above which it is quartered rather than swept: crossings are searched pair by pair."""
_MAX_LIMBS = 256
_MAX_DEPTH = 5
_MAX_EVENTS = 4 * MAX_SEGMENTS + 64
_EMPTY = 1e-10
"""Pieces narrower than this (pixels) are not sampled."""
_THIN = 0.15
"""Intervals narrower than this (pixels) get one Gauss point."""
_NARROW = 0.04
"""Slabs narrower than this (pixels) get one line."""
_SPREAD = 0.02
"""Merged nodes that scatter by more than this (pixels, standard deviation) become two samples instead of one."""
_MERGED = 0.3
"""Thin slabs are merged up to this width (pixels)."""
_REACH = 0.5
"""How far along the sweep (pixels) the end of a limb is felt."""
_PINCH = 1e-6
"""Edges closer than this (pixels) at the end of a slab meet there."""


def gauss_legendre(n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return nodes and weights of the n-point Gauss-Legendre rule on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    return 0.5 + 0.5 * nodes, 0.5 * weights


_G2X, _G2W = gauss_legendre(2)
_G3X, _G3W = gauss_legendre(3)
_G4X, _G4W = gauss_legendre(4)
_G5X, _G5W = gauss_legendre(5)


@njit(cache=True, nogil=True)
def bin_segments(segments, n_segments, rows, cols, head, link, owner):  # type: ignore[no-untyped-def]
    """List the segments of every pixel, with a border of one pixel around the image.

    Parameters
    ----------
    segments : (e, 4) float64
        u, v of both ends.
    head : (rows + 2, cols + 2) int32, overwritten
        First entry of each pixel's list, −1: none.
    link, owner : (m,) int32, overwritten
        Next entry, and the entry's segment.

    Returns
    -------
    int
        Entries used, or −1 if m was too small.
    """
    head[:] = -1
    n = 0
    for i in range(n_segments):
        ua, va, ub, vb = segments[i]
        if va > vb:
            ua, va, ub, vb = ub, vb, ua, va
        if vb < -1.0 or va > rows + 1.0 or max(ua, ub) < -1.0 or min(ua, ub) > cols + 1.0:
            continue
        first = math.floor(max(va, -1.0))
        last = min(math.floor(min(vb, rows + 0.5)), rows)
        slope = (ub - ua) / (vb - va) if vb > va else 0.0
        for r in range(first, last + 1):
            if vb > va and last > first:
                u0 = ua + slope * (max(va, r) - va)
                u1 = ua + slope * (min(vb, r + 1) - va)
            else:
                u0, u1 = ua, ub
            if u0 > u1:
                u0, u1 = u1, u0
            c0 = math.floor(max(u0 - 1e-9, -1.0))
            c1 = min(math.floor(min(u1 + 1e-9, cols + 0.5)), cols)
            for c in range(c0, c1 + 1):
                if n == len(link):
                    return -1
                link[n] = head[r + 1, c + 1]
                owner[n] = i
                head[r + 1, c + 1] = n
                n += 1
    return n


@njit(cache=True, nogil=True)
def _has_limb(entry, link, owner, limb):  # type: ignore[no-untyped-def]
    while entry >= 0:
        if limb[owner[entry]]:
            return True
        entry = link[entry]
    return False


@njit(cache=True, nogil=True)
def sample_pixel(  # type: ignore[no-untyped-def]
    r, c, bent, width, height, segments, limb, head, link, owner, work, points, weights, regions, n, region
):
    """Place the samples of one pixel.

    Parameters
    ----------
    r, c : int
        Row and column.
    bent : bool
        Whether the pixel may see the inside of a curved surface, which takes more points than a flat one.
    width, height : float
        Fill factor.
    segments, limb, head, link, owner
        As :func:`project_edges` and :func:`bin_segments` left them.
    work : (MAX_SEGMENTS, 5) float64
        Scratch.
    points : (m, 2) float64
        u, v of the samples, written from `n` on.
    weights : (m,) float64
        Shares of the active area; they add up to one.
    regions : (m,) int32
        Number of the interval a sample lies in, counted from `region`.

    Returns
    -------
    n, region, trusted : int, int, bool
        Where the next pixel starts (n = −1: the arrays are full), and whether every box could be split exactly.
    """
    u0 = c + 0.5 - 0.5 * width
    v0 = r + 0.5 - 0.5 * height
    inverse_area = 1.0 / (width * height)
    i, j = r + 1, c + 1
    sideways = _has_limb(head[i, j - 1], link, owner, limb) or _has_limb(head[i, j + 1], link, owner, limb)
    upright = _has_limb(head[i - 1, j], link, owner, limb) or _has_limb(head[i + 1, j], link, owner, limb)
    if head[i, j] < 0 and not sideways and not upright:
        count = 3 if bent else 2
        if n + count * count > len(weights):
            return -1, region, True
        for a in range(count):
            for b in range(count):
                points[n, 0] = u0 + width * (_G3X[b] if bent else _G2X[b])
                points[n, 1] = v0 + height * (_G3X[a] if bent else _G2X[a])
                weights[n] = _G3W[a] * _G3W[b] if bent else 0.25
                regions[n] = region
                n += 1
        return n, region + 1, True
    # sweep along the limb if there is one, else along where one is near, else along most of the edges
    along = np.zeros(4)
    entry = head[i, j]
    while entry >= 0:
        k = owner[entry]
        ua, va, ub, vb = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
        lo, hi = _clip(ua, va, ub, vb, c, r, c + 1, r + 1)
        along[2 * limb[k]] += max(hi - lo, 0.0) * abs(ub - ua)
        along[2 * limb[k] + 1] += max(hi - lo, 0.0) * abs(vb - va)
        entry = link[entry]
    has_limb = along[2] > 0.0 or along[3] > 0.0
    if has_limb:
        sweep_v = along[3] >= along[2]
    elif sideways != upright:
        sweep_v = sideways
    else:
        sweep_v = along[1] >= along[0]
    curved = sideways or upright or has_limb
    # the pixel itself and its neighbours across the sweep may hold the limb this pixel's surface ends at
    limbs = np.empty((2, _MAX_LIMBS if curved else 0, 4))
    n_limbs = np.zeros(2, np.int64)
    if curved:
        before, after = (head[i, j - 1], head[i, j + 1]) if sweep_v else (head[i - 1, j], head[i + 1, j])
        for near in (head[i, j], before, after):
            _collect_limbs(near, link, owner, segments, limb, sweep_v, limbs, n_limbs)
    events = np.empty(_MAX_EVENTS)
    stack = np.empty((4 * _MAX_DEPTH + 4, 5))
    stack[0] = (u0, v0, u0 + width, v0 + height, 0.0)
    depth = 1
    trusted = True
    while depth > 0:
        depth -= 1
        bu0, bv0, bu1, bv1, level = stack[depth]
        m = _clip_to_box(head[i, j], link, owner, segments, limb, bu0, bv0, bu1, bv1, sweep_v, work)
        s0, s1, x0, x1 = (bv0, bv1, bu0, bu1) if sweep_v else (bu0, bu1, bv0, bv1)
        n_events = _events(s0, s1, work, m, events) if m >= 0 else -1
        if n_events < 0 and level < _MAX_DEPTH:
            um, vm = 0.5 * (bu0 + bu1), 0.5 * (bv0 + bv1)
            stack[depth] = (bu0, bv0, um, vm, level + 1)
            stack[depth + 1] = (um, bv0, bu1, vm, level + 1)
            stack[depth + 2] = (bu0, vm, um, bv1, level + 1)
            stack[depth + 3] = (um, vm, bu1, bv1, level + 1)
            depth += 4
            continue
        if n_events < 0:
            m, trusted = 0, False
            n_events = _events(s0, s1, work, m, events)
        n, region = _sweep_box(
            events, n_events, s0, s1, x0, x1, sweep_v, work, m, limbs, n_limbs, curved, bent, inverse_area,
            points, weights, regions, n, region,
        )  # fmt: skip
        if n < 0:
            return -1, region, trusted
    return n, region, trusted


@njit(cache=True, nogil=True, inline="always")
def _clip(ua, va, ub, vb, u0, v0, u1, v1):  # type: ignore[no-untyped-def]
    """Return the shares (lo, hi) of a segment between which it lies in a box; lo ≥ hi where it does not."""
    du, dv = ub - ua, vb - va
    lo, hi = 0.0, 1.0
    for p, q in ((-du, ua - u0), (du, u1 - ua), (-dv, va - v0), (dv, v1 - va)):
        if p < 0.0:
            lo = max(lo, q / p)
        elif p > 0.0:
            hi = min(hi, q / p)
        elif q < 0.0:
            hi = -1.0
    return lo, hi


@njit(cache=True, nogil=True)
def _clip_to_box(entry, link, owner, segments, limb, u0, v0, u1, v1, sweep_v, work):  # type: ignore[no-untyped-def]
    """Clip a pixel's segments to a box.

    Rows of `work` are s, x of both ends (s rising) and the limb's side, sorted by where they begin. The side is +1
    where the surface lies towards larger x, −1 towards smaller x, 0 for a crease. Returns their number, or −1 if there
    are too many.
    """
    m = 0
    while entry >= 0:
        k = owner[entry]
        entry = link[entry]
        ua, va, ub, vb = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
        du, dv = ub - ua, vb - va
        lo, hi = _clip(ua, va, ub, vb, u0, v0, u1, v1)
        if lo >= hi:
            continue
        if m == MAX_SEGMENTS:
            return -1
        if sweep_v:
            sa, xa, sb, xb = va + lo * dv, ua + lo * du, va + hi * dv, ua + hi * du
            side = 1.0 if dv > 0 else -1.0
        else:
            sa, xa, sb, xb = ua + lo * du, va + lo * dv, ua + hi * du, va + hi * dv
            side = -1.0 if du > 0 else 1.0
        if sa <= sb:
            work[m, 0], work[m, 1], work[m, 2], work[m, 3] = sa, xa, sb, xb
        else:
            work[m, 0], work[m, 1], work[m, 2], work[m, 3] = sb, xb, sa, xa
        work[m, 4] = side if limb[k] else 0.0
        m += 1
    if m > 1:
        work[:m] = work[np.argsort(work[:m, 0])]
    return m


@njit(cache=True, nogil=True)
def _events(s0, s1, work, m, events):  # type: ignore[no-untyped-def]
    """Collect, sorted, where the order of the edges across the sweep may change.

    Returns their number, or −1 if there are too many.
    """
    n = 2
    events[0], events[1] = s0, s1
    for i in range(m):
        events[n] = work[i, 0]
        events[n + 1] = work[i, 2]
        n += 2
    for i in range(m):
        for j in range(i + 1, m):
            if work[j, 0] >= work[i, 2]:
                break
            lo, hi = work[j, 0], min(work[i, 2], work[j, 2])
            if hi - lo <= _EMPTY:
                continue
            if max(work[i, 1], work[i, 3]) < min(work[j, 1], work[j, 3]):
                continue
            if max(work[j, 1], work[j, 3]) < min(work[i, 1], work[i, 3]):
                continue
            ki = (work[i, 3] - work[i, 1]) / (work[i, 2] - work[i, 0])
            kj = (work[j, 3] - work[j, 1]) / (work[j, 2] - work[j, 0])
            gap_lo = work[i, 1] + ki * (lo - work[i, 0]) - work[j, 1] - kj * (lo - work[j, 0])
            gap_hi = work[i, 1] + ki * (hi - work[i, 0]) - work[j, 1] - kj * (hi - work[j, 0])
            if gap_lo * gap_hi < 0.0:
                if n == len(events):
                    return -1
                events[n] = lo + (hi - lo) * gap_lo / (gap_lo - gap_hi)
                n += 1
    events[:n].sort()
    return n


@njit(cache=True, nogil=True)
def _collect_limbs(entry, link, owner, segments, limb, sweep_v, limbs, count):  # type: ignore[no-untyped-def]
    """Append a pixel's limbs: rows of s, x at the low end, s, x at the high end.

    Those whose surface lies towards larger x go to ``limbs[0]``, the others to ``limbs[1]``; `count` has their numbers.
    What no longer fits is left out.
    """
    while entry >= 0:
        k = owner[entry]
        entry = link[entry]
        if not limb[k]:
            continue
        if sweep_v:
            xa, sa, xb, sb = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
            which = 0 if sb > sa else 1
        else:
            sa, xa, sb, xb = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
            which = 1 if sb > sa else 0
        n = count[which]
        if sa == sb or n == limbs.shape[1]:
            continue
        if sa > sb:
            sa, xa, sb, xb = sb, xb, sa, xa
        limbs[which, n, 0], limbs[which, n, 1], limbs[which, n, 2], limbs[which, n, 3] = sa, xa, sb, xb
        count[which] += 1


@njit(cache=True, nogil=True)
def _nearest_limb(limbs, n, s, side, bound):  # type: ignore[no-untyped-def]
    """Find, of limbs with their surface on our side, the one nearest to `bound` and beyond it, on or near a line.

    A limb that ends before it reaches the line (at a rim, say) still shapes the surface beside its end.
    """
    best = -np.inf if side > 0 else np.inf
    closest = _REACH
    for i in range(n):
        gap = max(limbs[i, 0] - s, s - limbs[i, 2], 0.0)
        if gap > closest:
            continue
        t = min(max((s - limbs[i, 0]) / (limbs[i, 2] - limbs[i, 0]), 0.0), 1.0)
        x = limbs[i, 1] + t * (limbs[i, 3] - limbs[i, 1])
        if (side > 0 and x > bound) or (side < 0 and x < bound):
            continue
        if gap < closest or (side > 0 and x > best) or (side < 0 and x < best):
            best, closest = x, gap
    return best


@njit(cache=True, nogil=True)
def _activate(lo, hi, work, m, started, active, n_active):  # type: ignore[no-untyped-def]
    """Update the list of edges that span the slab [lo, hi], ordered along its middle line.

    Returns how many edges have started, and how many are active.
    """
    middle = 0.5 * (lo + hi)
    kept = 0
    for i in range(n_active):
        if work[active[i], 2] >= middle:
            active[kept] = active[i]
            kept += 1
    n_active = kept
    while started < m and work[started, 0] <= middle:
        if work[started, 2] >= middle and work[started, 2] > work[started, 0]:
            active[n_active] = started
            n_active += 1
        started += 1
    for i in range(1, n_active):
        edge = active[i]
        x = _edge_at(work, edge, middle)
        j = i
        while j > 0 and _edge_at(work, active[j - 1], middle) > x:
            active[j] = active[j - 1]
            j -= 1
        active[j] = edge
    return started, n_active


@njit(cache=True, nogil=True, inline="always")
def _edge_at(work, i, s):  # type: ignore[no-untyped-def]
    """Return where an edge meets the line at `s`."""
    return work[i, 1] + (s - work[i, 0]) * (work[i, 3] - work[i, 1]) / (work[i, 2] - work[i, 0])


@njit(cache=True, nogil=True)
def _plan_lines(lo, hi, x0, x1, work, active, n_active, curved):  # type: ignore[no-untyped-def]
    """Decide how many lines a slab needs, and at which of its ends a piece beside a limb shrinks to a point.

    The light of such a corner grows like the 3/2 power of the distance from it; lines placed at its square make that
    smooth. One line misses how the integrand changes along slanted edges, two are exact to third order.

    Returns the number of lines, and whether the slab is pinched at its low and at its high end.
    """
    slab = hi - lo
    slant = 0.0
    pinched_low, pinched_high = False, False
    for i in range(n_active):
        edge = active[i]
        low, high = _edge_at(work, edge, lo), _edge_at(work, edge, hi)
        slant = max(slant, abs(high - low))
        if work[edge, 4] == 0.0:
            continue
        # what bounds the limb's own surface on its other side
        other = i + 1 if work[edge, 4] > 0 else i - 1
        other_low = other_high = x1 if work[edge, 4] > 0 else x0
        if 0 <= other < n_active:
            other_low, other_high = _edge_at(work, active[other], lo), _edge_at(work, active[other], hi)
        pinched_low = pinched_low or abs(low - other_low) < _PINCH
        pinched_high = pinched_high or abs(high - other_high) < _PINCH
    if pinched_low and pinched_high:
        return 4, True, True
    if pinched_low or pinched_high:
        return 3, pinched_low, pinched_high
    if slab < _NARROW and slant < _THIN:
        return 1, False, False
    if slab < _MERGED:
        return 2, False, False
    return (5 if curved else 3), False, False


@njit(cache=True, nogil=True)
def _continues(work, m, before, after, n, stop, lo):  # type: ignore[no-untyped-def]
    """Tell whether the edges of two neighbouring slabs are the same, or links of the same chains.

    Not so where edges cross, begin or end alone, or where one lies along the border between the slabs.
    """
    for i in range(n):
        old, new = before[i], after[i]
        if old == new:
            continue
        if work[old, 4] != work[new, 4] or abs(work[old, 2] - stop) > _EMPTY or abs(work[new, 0] - lo) > _EMPTY:
            return False
        if abs(work[old, 3] - work[new, 1]) > _PINCH:
            return False
    for i in range(m):
        if work[i, 0] > lo + _EMPTY:
            break
        if work[i, 2] <= lo + _EMPTY and work[i, 0] >= stop - _EMPTY and abs(work[i, 3] - work[i, 1]) > _EMPTY:
            return False
    return True


@njit(cache=True, nogil=True)
def _line_position(lines, g, pinched_low, pinched_high):  # type: ignore[no-untyped-def]
    """Return the place of a line in its slab (0 … 1) and its share of it."""
    if lines == 1:
        return 0.5, 1.0
    if lines == 2:
        t, weight = _G2X[g], _G2W[g]
    elif lines == 3:
        t, weight = _G3X[g], _G3W[g]
    elif lines == 4:
        t, weight = _G4X[g], _G4W[g]
    else:
        t, weight = _G5X[g], _G5W[g]
    if pinched_low and pinched_high:
        return t * t * (3.0 - 2.0 * t), weight * 6.0 * t * (1.0 - t)
    if pinched_low:
        return t * t, weight * 2.0 * t
    if pinched_high:
        return t * (2.0 - t), weight * 2.0 * (1.0 - t)
    return t, weight


@njit(cache=True, nogil=True)
def _write(nodes, count, sweep_v, scale, points, weights, regions, n, region):  # type: ignore[no-untyped-def]
    """Write the nodes of a line, or of merged lines, as samples.

    Merged nodes have a total weight, a mean (s, x), and a variance of s. Two samples of half the weight at one standard
    deviation before and behind the mean, along the regression line of x on s, have the same moments up to the second
    (the third too, if the lines lie evenly): the two-point Gauss rule of the merged lines.
    """
    if n + 2 * count > len(weights):
        return -1, region
    last, current = -1.0, region
    for g in range(count):
        total = nodes[g, 0]
        s, x = nodes[g, 1] / total, nodes[g, 2] / total
        if nodes[g, 3] != last:
            current, region = region, region + 1
            last = nodes[g, 3]
        copies, ds, dx = 1, 0.0, 0.0
        variance = nodes[g, 4] / total - s * s
        if variance > 1e-12:
            ds = math.sqrt(variance)
            dx = (nodes[g, 5] / total - s * x) / ds
            copies = 2 if ds > _SPREAD or abs(dx) > _SPREAD else 1
        if copies == 1:
            ds, dx = 0.0, 0.0
        for sign in range(copies):
            direction = 1.0 - 2.0 * sign
            points[n, 0] = x + direction * dx if sweep_v else s + direction * ds
            points[n, 1] = s + direction * ds if sweep_v else x + direction * dx
            weights[n] = total * scale / copies
            regions[n] = current
            n += 1
    return n, region


@njit(cache=True, nogil=True)
def _sweep_box(  # type: ignore[no-untyped-def]
    events, n_events, s0, s1, x0, x1, sweep_v, work, m, limbs, n_limbs, curved, bent, scale,
    points, weights, regions, n, region,
):  # fmt: skip
    """Sample a box slab by slab; `scale` turns areas into weights.

    A rim or silhouette is a chain of many short edges, each of which makes a slab. Thin slabs that follow one another
    without a change of structure are merged: their lines have corresponding nodes, and two samples with the mean and
    the variance of corresponding nodes take the place of all of them.
    """
    cross, side = np.empty(m + 2), np.empty(m + 2)
    nodes, merged = np.empty((5 * m + 5, 6)), np.empty((5 * m + 5, 6))
    active, previous = np.empty(m, np.int64), np.empty(m, np.int64)
    start_cross, start_slope = np.empty(m + 2), np.empty(m + 2)
    started, n_active, n_previous = 0, 0, 0
    n_merged, start, stop, start_line, n_lines = 0, 0.0, -np.inf, 0.0, 0
    for e in range(n_events - 1):
        lo, hi = max(events[e], s0), min(events[e + 1], s1)
        slab = hi - lo
        if slab <= _EMPTY:
            continue
        started, n_active = _activate(lo, hi, work, m, started, active, n_active)
        lines, pinched_low, pinched_high = _plan_lines(lo, hi, x0, x1, work, active, n_active, curved)
        mergeable = slab < _MERGED and not pinched_low and not pinched_high
        k = n_active + 1
        cross[0], side[0], cross[k], side[k] = x0, 0.0, x1, 0.0
        for g in range(lines):
            t, share = _line_position(lines, g, pinched_low, pinched_high)
            s = lo + t * slab
            for i in range(n_active):
                cross[i + 1] = min(max(_edge_at(work, active[i], s), cross[i]), x1)
                side[i + 1] = work[active[i], 4]
            count = _line_nodes(s, share * slab, cross, side, k, limbs, n_limbs, curved, bent, nodes)
            follows = mergeable and n_merged == count and n_previous == n_active and hi - start <= _MERGED
            if follows and g == 0:
                follows = lo - stop <= _EMPTY and _continues(work, m, previous, active, n_active, stop, lo)
            if follows:
                for i in range(1, k):
                    if n_lines == 1:
                        start_slope[i] = (cross[i] - start_cross[i]) / (s - start_line)
                    bent = abs(cross[i] - start_cross[i] - start_slope[i] * (s - start_line))
                    follows = follows and bent <= 0.02 * min(cross[i] - cross[i - 1], cross[i + 1] - cross[i])
                for j in range(count):
                    follows = follows and nodes[j, 3] == merged[j, 3]
            if follows:
                for j in range(count):
                    for i in (0, 1, 2, 4, 5):
                        merged[j, i] += nodes[j, i]
                n_lines += 1
            else:
                n, region = _write(merged, n_merged, sweep_v, scale, points, weights, regions, n, region)
                if n < 0:
                    return -1, region
                n_merged, start, start_line, n_lines = count, lo, s, 1
                start_cross[: k + 1] = cross[: k + 1]
                merged[:count] = nodes[:count]
            stop, n_previous = hi, n_active
            previous[:n_active] = active[:n_active]
            if not mergeable:
                n, region = _write(merged, n_merged, sweep_v, scale, points, weights, regions, n, region)
                if n < 0:
                    return -1, region
                n_merged, stop = 0, -np.inf
    return _write(merged, n_merged, sweep_v, scale, points, weights, regions, n, region)


@njit(cache=True, nogil=True)
def _line_nodes(s, line_weight, cross, side, k, limbs, n_limbs, curved, bent, nodes):  # type: ignore[no-untyped-def]
    """Place the nodes of one line.

    Rows are w, w·s, w·x, the interval, w·s², w·s·x with the weight w; returns their number.
    """
    count = 0
    left, behind_limb = -np.inf, False
    for i in range(k):
        if side[i] > 0:
            left, behind_limb = cross[i], False
        elif side[i] < 0:
            left, behind_limb = -np.inf, True
        a, b = cross[i], cross[i + 1]
        if b - a <= _EMPTY:
            continue
        j = i + 1
        while j < k and side[j] == 0:
            j += 1
        before_limb = j < k and side[j] > 0
        if curved and left == -np.inf and not behind_limb and not before_limb:
            left = _nearest_limb(limbs[0], n_limbs[0], s, 1.0, a)
        right = np.inf
        if j < k and side[j] < 0:
            right = cross[j]
        elif curved and j == k and not behind_limb:
            right = _nearest_limb(limbs[1], n_limbs[1], s, -1.0, b)
        placed = _place(a, b, left, right, bent, nodes[count:])
        for g in range(count, count + placed):
            weight, x = nodes[g, 0] * line_weight, nodes[g, 2]
            nodes[g, 0], nodes[g, 1], nodes[g, 2], nodes[g, 3] = weight, weight * s, weight * x, float(i)
            nodes[g, 4], nodes[g, 5] = weight * s * s, weight * s * x
        count += placed
    return count


@njit(cache=True, nogil=True)
def _place(a, b, left, right, bent, nodes):  # type: ignore[no-untyped-def]
    """Place Gauss points on one interval [a, b], with limbs at `left` and `right` (±inf: none).

    Column 0 of `nodes` gets the weight, which adds up to b − a, column 2 the place; returns their number.
    """
    near_left, near_right = a - left < 1.5, right - b < 1.5
    middle, half = 0.0, 0.0
    if near_left and near_right:
        middle, half = 0.5 * (left + right), 0.5 * (right - left)
        t0 = math.asin(max((a - middle) / half, -1.0))
        t1 = math.asin(min((b - middle) / half, 1.0))
        count = 5
    elif near_left:
        t0, t1, count = math.sqrt(max(a - left, 0.0)), math.sqrt(b - left), 4
    elif near_right:
        t0, t1, count = math.sqrt(right - a), math.sqrt(max(right - b, 0.0)), 4
    else:
        count = 1 if b - a < _THIN else (3 if bent and b - a > _MERGED else 2)
        t0, t1 = a, b
    total = 0.0
    for g in range(count):
        if count == 1:
            t, w = 0.5 * (t0 + t1), 1.0
        elif count == 2:
            t, w = t0 + _G2X[g] * (t1 - t0), _G2W[g]
        elif count == 3:
            t, w = t0 + _G3X[g] * (t1 - t0), _G3W[g]
        elif count == 4:
            t, w = t0 + _G4X[g] * (t1 - t0), _G4W[g]
        else:
            t, w = t0 + _G5X[g] * (t1 - t0), _G5W[g]
        if near_left and near_right:
            x, w = middle + half * math.sin(t), w * math.cos(t)
        elif near_left:
            x, w = left + t * t, w * t
        elif near_right:
            x, w = right - t * t, w * t
        else:
            x = t
        nodes[g, 0] = w
        nodes[g, 2] = x
        total += w
    for g in range(count):  # the constant is integrated exactly, whatever the substitution
        nodes[g, 0] *= (b - a) / total
    return count
