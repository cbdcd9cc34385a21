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
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

MAX_SEGMENTS = 128
"""Edges in a box above which it is quartered rather than swept: crossings are searched pair by pair."""
_MAX_LIMBS = 256
_MAX_DEPTH = 5
_MAX_EVENTS = 4 * MAX_SEGMENTS + 64
_MAX_SLABS = 256
_MAX_LINKS = 4096
_EMPTY = 1e-10
"""Pieces narrower than this (pixels) are not sampled."""
_THIN = 0.15
"""Intervals narrower than this (pixels) get one Gauss point."""
_WIDE = 0.3
"""Intervals wider than this (pixels) get three Gauss points on a curved surface, the others two."""
_BESIDE_LIMB = (0.1, 0.6)
"""Intervals beside a limb get two Gauss points, or three, or four where they are wider than this (pixels)."""
_NARROW = 0.04
"""Strips narrower than this (pixels) get one line."""
_TRIFLE = 4e-5
"""Area times squared extent (pixels⁴) under which a piece gets one line."""
_STRIP, _LIMB_STRIP = 0.6, 0.25
"""Largest extent (pixels) of a piece that is given one Gauss rule: in general, and where a limb runs across it."""
_PARALLEL = 0.1
"""A limb runs along an interval if it keeps its distance (pixels) from both ends as well as this."""
_SHRINKS = 0.3
"""An interval shrinks to a point at an end of a strip where it is narrower than this share of its middle."""
_KINK = 0.005
"""Links at an angle are one smooth curve where the shorter one sticks out by less than this (pixels)."""
_TURN = 0.4
"""Sine of the angle by which the curves of one strip may turn."""
_FELT = 1.5
"""A limb shapes the surface up to this far (pixels)."""
_REACH = 0.5
"""How far along the sweep (pixels) the end of a limb is felt."""
_PINCH = 1e-6
"""Edges closer than this (pixels) at the end of a slab meet there."""


class Scratch(NamedTuple):
    """Scratch of one thread for the pixel at hand.

    Parameters
    ----------
    boxes : (4 * _MAX_DEPTH + 4, 5) float64
        Parts of the pixel still to be split: u, v of two corners, level.
    clipped : (MAX_SEGMENTS, 6) float64
        The edges of a box as they come.
    order : (MAX_SEGMENTS,) int64
        Their order.
    edges : (MAX_SEGMENTS, 6) float64
        The same in order: s, x of both ends (s rising), side of the surface where the edge is a limb, slope dx/ds.
    events : (_MAX_EVENTS,) float64
        Where slabs begin and end.
    active : (MAX_SEGMENTS,) int64
        Edges across the slab at hand, in the order of x.
    slabs : (_MAX_SLABS, 2) float64
        Begin and end of the slabs of a strip.
    links : (_MAX_LINKS,) int64
        Edges of the slabs of a strip, slab by slab.
    limbs : (2, _MAX_LIMBS, 4) float64
        Limbs of the pixel and its neighbours, see :func:`_collect_limbs`.
    n_limbs : (2,) int64
    """

    boxes: NDArray[np.float64]
    clipped: NDArray[np.float64]
    order: NDArray[np.int64]
    edges: NDArray[np.float64]
    events: NDArray[np.float64]
    active: NDArray[np.int64]
    slabs: NDArray[np.float64]
    links: NDArray[np.int64]
    limbs: NDArray[np.float64]
    n_limbs: NDArray[np.int64]

    @classmethod
    def empty(cls) -> Scratch:
        """Return scratch for one thread."""
        return cls(
            boxes=np.empty((4 * _MAX_DEPTH + 4, 5)),
            clipped=np.empty((MAX_SEGMENTS, 6)),
            order=np.empty(MAX_SEGMENTS, np.int64),
            edges=np.empty((MAX_SEGMENTS, 6)),
            events=np.empty(_MAX_EVENTS),
            active=np.empty(MAX_SEGMENTS, np.int64),
            slabs=np.empty((_MAX_SLABS, 2)),
            links=np.empty(_MAX_LINKS, np.int64),
            limbs=np.empty((2, _MAX_LIMBS, 4)),
            n_limbs=np.zeros(2, np.int64),
        )


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
    r, c, bent, width, height, splits, segments, limb, head, link, owner, scratch, points, weights, regions, n, region
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
    splits : int
        Boxes a side that the active area is cut into before anything else.
    segments, limb, head, link, owner
        As :func:`project_edges` and :func:`bin_segments` left them.
    scratch : Scratch
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
        if n + (splits * count) ** 2 > len(weights):
            return -1, region, True
        for box in range(splits * splits):
            row, col = divmod(box, splits)
            for a in range(count):
                for b in range(count):
                    points[n, 0] = u0 + width / splits * (col + (_G3X[b] if bent else _G2X[b]))
                    points[n, 1] = v0 + height / splits * (row + (_G3X[a] if bent else _G2X[a]))
                    weights[n] = (_G3W[a] * _G3W[b] if bent else 0.25) / (splits * splits)
                    regions[n] = region
                    n += 1
            region += 1
        return n, region, True
    # sweep along the limb if there is one, else along where one is near, else along most of the edges
    crease_u, crease_v, limb_u, limb_v = 0.0, 0.0, 0.0, 0.0
    entry = head[i, j]
    while entry >= 0:
        k = owner[entry]
        ua, va, ub, vb = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
        lo, hi = _clip(ua, va, ub, vb, c, r, c + 1, r + 1)
        du, dv = max(hi - lo, 0.0) * abs(ub - ua), max(hi - lo, 0.0) * abs(vb - va)
        if limb[k]:
            limb_u, limb_v = limb_u + du, limb_v + dv
        else:
            crease_u, crease_v = crease_u + du, crease_v + dv
        entry = link[entry]
    has_limb = limb_u > 0.0 or limb_v > 0.0
    if has_limb:
        sweep_v = limb_v >= limb_u
    elif sideways != upright:
        sweep_v = sideways
    else:
        sweep_v = crease_v >= crease_u
    curved = sideways or upright or has_limb
    scratch.n_limbs[:] = 0
    if curved:
        # the pixel itself and its neighbours across the sweep may hold the limb this pixel's surface ends at
        before, after = (head[i, j - 1], head[i, j + 1]) if sweep_v else (head[i - 1, j], head[i + 1, j])
        for near in (head[i, j], before, after):
            _collect_limbs(near, link, owner, segments, limb, sweep_v, scratch.limbs, scratch.n_limbs)
    stack = scratch.boxes
    box, depth, trusted = 0, 0, True
    while depth > 0 or box < splits * splits:
        if depth == 0:
            row, col = divmod(box, splits)
            stack[0] = (
                u0 + width * col / splits,
                v0 + height * row / splits,
                u0 + width * (col + 1) / splits,
                v0 + height * (row + 1) / splits,
                0.0,
            )
            box, depth = box + 1, 1
        depth -= 1
        bu0, bv0, bu1, bv1, level = stack[depth]
        m = _clip_to_box(head[i, j], link, owner, segments, limb, bu0, bv0, bu1, bv1, sweep_v, scratch)
        s0, s1, x0, x1 = (bv0, bv1, bu0, bu1) if sweep_v else (bu0, bu1, bv0, bv1)
        n_events = _events(s0, s1, scratch.edges, m, scratch.events) if m >= 0 else -1
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
            n_events = _events(s0, s1, scratch.edges, m, scratch.events)
        n, region = _sweep_box(
            n_events, s0, s1, x0, x1, sweep_v, scratch, m, curved, bent, inverse_area, points, weights, regions,
            n, region,
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
def _clip_to_box(entry, link, owner, segments, limb, u0, v0, u1, v1, sweep_v, scratch):  # type: ignore[no-untyped-def]
    """Clip a pixel's segments to a box, into ``scratch.edges``.

    Its rows are s, x of both ends (s rising), the limb's side and the slope, sorted by where they begin. The
    side is +1 where the surface lies towards larger x, −1 towards smaller x, 0 for a crease. Returns their number, or
    −1 if there are too many.
    """
    edges, order = scratch.clipped, scratch.order
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
            edges[m, 0], edges[m, 1], edges[m, 2], edges[m, 3] = sa, xa, sb, xb
        else:
            edges[m, 0], edges[m, 1], edges[m, 2], edges[m, 3] = sb, xb, sa, xa
        edges[m, 4] = side if limb[k] else 0.0
        length = edges[m, 2] - edges[m, 0]
        edges[m, 5] = (edges[m, 3] - edges[m, 1]) / length if length > 0.0 else 0.0
        begin, place = edges[m, 0], m
        while place > 0 and edges[order[place - 1], 0] > begin:
            order[place] = order[place - 1]
            place -= 1
        order[place] = m
        m += 1
    for i in range(m):
        for j in range(6):
            scratch.edges[i, j] = edges[order[i], j]
    return m


@njit(cache=True, nogil=True)
def _events(s0, s1, edges, m, events):  # type: ignore[no-untyped-def]
    """Collect, sorted, where the order of the edges across the sweep may change.

    Returns their number, or −1 if there are too many.
    """
    events[0] = s0
    n = 1
    for i in range(m):
        events[n] = edges[i, 0]
        events[n + 1] = edges[i, 2]
        n += 2
    events[n] = s1
    n += 1
    for i in range(m):
        for j in range(i + 1, m):
            if edges[j, 0] >= edges[i, 2]:
                break
            lo, hi = edges[j, 0], min(edges[i, 2], edges[j, 2])
            if hi - lo <= _EMPTY:
                continue
            if max(edges[i, 1], edges[i, 3]) < min(edges[j, 1], edges[j, 3]):
                continue
            if max(edges[j, 1], edges[j, 3]) < min(edges[i, 1], edges[i, 3]):
                continue
            gap_lo = _edge_at(edges, i, lo) - _edge_at(edges, j, lo)
            gap_hi = _edge_at(edges, i, hi) - _edge_at(edges, j, hi)
            if gap_lo * gap_hi < 0.0:
                if n == len(events):
                    return -1
                events[n] = lo + (hi - lo) * gap_lo / (gap_lo - gap_hi)
                n += 1
    # a chain's links follow one another, so that little is out of order
    for i in range(1, n):
        event, place = events[i], i
        while place > 0 and events[place - 1] > event:
            events[place] = events[place - 1]
            place -= 1
        events[place] = event
    return n


@njit(cache=True, nogil=True)
def _collect_limbs(entry, link, owner, segments, limb, sweep_v, limbs, count):  # type: ignore[no-untyped-def]
    """Append a pixel's limbs: rows of s, x at the low end, s at the high end, slope dx/ds.

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
        limbs[which, n, 0], limbs[which, n, 1], limbs[which, n, 2] = sa, xa, sb
        limbs[which, n, 3] = (xb - xa) / (sb - sa)
        count[which] += 1


@njit(cache=True, nogil=True)
def _nearest_limb(limbs, n_limbs, s, side, bound):  # type: ignore[no-untyped-def]
    """Find, of limbs with their surface on our side, the one nearest to `bound` and beyond it, on or near a line.

    A limb that ends before it reaches the line (at a rim, say) still shapes the surface beside its end.
    """
    which = 0 if side > 0 else 1
    best = -np.inf if side > 0 else np.inf
    closest = _REACH
    for i in range(n_limbs[which]):
        gap = max(limbs[which, i, 0] - s, s - limbs[which, i, 2], 0.0)
        if gap > closest:
            continue
        x = (
            limbs[which, i, 1]
            + (min(max(s, limbs[which, i, 0]), limbs[which, i, 2]) - limbs[which, i, 0]) * limbs[which, i, 3]
        )
        if (side > 0 and x > bound) or (side < 0 and x < bound):
            continue
        if gap < closest or (side > 0 and x > best) or (side < 0 and x < best):
            best, closest = x, gap
    return best


@njit(cache=True, nogil=True)
def _activate(lo, hi, edges, m, started, active, n_active):  # type: ignore[no-untyped-def]
    """Update the list of edges that span the slab [lo, hi], ordered along its middle line.

    Returns how many edges have started, and how many are active.
    """
    middle = 0.5 * (lo + hi)
    kept = 0
    for i in range(n_active):
        if edges[active[i], 2] >= middle:
            active[kept] = active[i]
            kept += 1
    n_active = kept
    while started < m and edges[started, 0] <= middle:
        if edges[started, 2] >= middle and edges[started, 2] > edges[started, 0]:
            active[n_active] = started
            n_active += 1
        started += 1
    for i in range(1, n_active):
        edge = active[i]
        x = _edge_at(edges, edge, middle)
        j = i
        while j > 0 and _edge_at(edges, active[j - 1], middle) > x:
            active[j] = active[j - 1]
            j -= 1
        active[j] = edge
    return started, n_active


@njit(cache=True, nogil=True, inline="always")
def _edge_at(edges, i, s):  # type: ignore[no-untyped-def]
    """Return where an edge meets the line at `s`."""
    return edges[i, 1] + (s - edges[i, 0]) * edges[i, 5]


@njit(cache=True, nogil=True)
def _continues(edges, m, links, last, after, n, stop, lo):  # type: ignore[no-untyped-def]
    """Tell whether the edges of two neighbouring slabs are the same, or links of the same smooth curves.

    Not so where edges cross, begin or end alone, where one lies along the border between the slabs, where a link stands
    at a noticeable angle to the one before, or where the curve has turned far since the strip's first slab. The last
    slab's edges stand in `links` from `last` on.
    """
    for i in range(n):
        old, new = links[last + i], after[i]
        if old == new:
            continue
        if edges[old, 4] != edges[new, 4] or abs(edges[old, 2] - stop) > _EMPTY or abs(edges[new, 0] - lo) > _EMPTY:
            return False
        if abs(edges[old, 3] - edges[new, 1]) > _PINCH:
            return False
        ds, dx = edges[new, 2] - edges[new, 0], edges[new, 3] - edges[new, 1]
        length = ds * ds + dx * dx
        old_ds, old_dx = edges[old, 2] - edges[old, 0], edges[old, 3] - edges[old, 1]
        kink = old_ds * dx - old_dx * ds
        if kink * kink > _KINK * _KINK * max(length, old_ds * old_ds + old_dx * old_dx):
            return False
        first = links[i]
        first_ds, first_dx = edges[first, 2] - edges[first, 0], edges[first, 3] - edges[first, 1]
        turn = first_ds * dx - first_dx * ds
        if turn * turn > _TURN * _TURN * length * (first_ds * first_ds + first_dx * first_dx):
            return False
    for i in range(m):
        if edges[i, 0] > lo + _EMPTY:
            break
        if edges[i, 2] <= lo + _EMPTY and edges[i, 0] >= stop - _EMPTY and abs(edges[i, 3] - edges[i, 1]) > _EMPTY:
            return False
    return True


@njit(cache=True, nogil=True)
def _sweep_box(  # type: ignore[no-untyped-def]
    n_events, s0, s1, x0, x1, sweep_v, scratch, m, curved, bent, scale, points, weights, regions, n, region
):
    """Sample a box strip by strip; `scale` turns areas into weights.

    A rim or silhouette is a chain of many short edges, each of which begins and ends a slab. Neighbouring slabs in
    which the same chains run side by side make one strip, in which the chains are smooth curves.
    """
    edges, events, active, slabs, links = scratch.edges, scratch.events, scratch.active, scratch.slabs, scratch.links
    started, n_active, n_slabs, k = 0, 0, 0, 0
    for e in range(n_events - 1):
        lo, hi = max(events[e], s0), min(events[e + 1], s1)
        if hi - lo <= _EMPTY:
            continue
        started, n_active = _activate(lo, hi, edges, m, started, active, n_active)
        if n_slabs > 0:
            stop = slabs[n_slabs - 1, 1]
            full = n_slabs == len(slabs) or (n_slabs + 1) * k > len(links)
            joined = not full and n_active == k and lo - stop <= _EMPTY
            if not (joined and _continues(edges, m, links, (n_slabs - 1) * k, active, k, stop, lo)):
                n, region = _sample_strip(
                    n_slabs, k, x0, x1, sweep_v, scratch, curved, bent, scale, points, weights, regions, n, region
                )
                if n < 0:
                    return -1, region
                n_slabs = 0
        k = n_active
        slabs[n_slabs, 0], slabs[n_slabs, 1] = lo, hi
        for i in range(k):
            links[n_slabs * k + i] = active[i]
        n_slabs += 1
    if n_slabs > 0:
        n, region = _sample_strip(
            n_slabs, k, x0, x1, sweep_v, scratch, curved, bent, scale, points, weights, regions, n, region
        )
    return n, region


@njit(cache=True, nogil=True)
def _sample_strip(  # type: ignore[no-untyped-def]
    n_slabs, k, x0, x1, sweep_v, scratch, curved, bent, scale, points, weights, regions, n, region
):
    """Sample the k + 1 intervals between the k curves of a strip.

    An interval's light is ∫ width(s) · mean over x of f(s, x) ds. The width is known exactly; its moments give the
    two-point Gauss rule for it as a weight, exact wherever the mean is cubic in s, and the area always.
    """
    edges, slabs, links = scratch.edges, scratch.slabs, scratch.links
    limbs, n_limbs = scratch.limbs, scratch.n_limbs
    start, stop = slabs[0, 0], slabs[n_slabs - 1, 1]
    for i in range(k + 1):
        a, b, left, right = _interval(
            0.5 * (start + stop), n_slabs, i, k, x0, x1, edges, slabs, links, limbs, n_limbs, curved, curved
        )
        near_left, near_right = a - left < _FELT, right - b < _FELT
        limb, width = near_left or near_right, b - a
        a_low, b_low = _bounds(start, 0, i, k, x0, x1, edges, links)
        a_high, b_high = _bounds(stop, n_slabs - 1, i, k, x0, x1, edges, links)
        extent = max(stop - start, abs(a_high - a_low), abs(b_high - b_low))
        steep = False
        if limb:
            _, _, left_low, right_low = _interval(
                start, n_slabs, i, k, x0, x1, edges, slabs, links, limbs, n_limbs, near_left, near_right
            )
            _, _, left_high, right_high = _interval(
                stop, n_slabs, i, k, x0, x1, edges, slabs, links, limbs, n_limbs, near_left, near_right
            )
            for near, at_low, at_high in ((near_left, left_low, left_high), (near_right, right_low, right_high)):
                moved = max(abs(at_high - at_low - a_high + a_low), abs(at_high - at_low - b_high + b_low))
                steep = steep or (near and not moved < _PARALLEL)
        pieces = math.ceil(extent / (_LIMB_STRIP if steep else _STRIP) - 1e-9)
        low, high = (max(b_low - a_low, 0.0), max(b_high - a_high, 0.0)) if limb else (1.0, 1.0)
        pieces += min(low, high) < _SHRINKS * width
        before = n
        for piece in range(pieces):
            lo = start + (stop - start) * _cut(piece / pieces, low, width, high)
            hi = start + (stop - start) * _cut((piece + 1) / pieces, low, width, high)
            nodes, area, s_a, s_b, share = _gauss_rule(lo, hi, n_slabs, i, k, x0, x1, edges, slabs, links)
            for g in range(nodes):
                s = s_a if g == 0 else s_b
                weight = area * (share if g == 0 else 1.0 - share)
                a, b, left, right = _interval(
                    s, n_slabs, i, k, x0, x1, edges, slabs, links, limbs, n_limbs, near_left, near_right
                )
                if n + 5 > len(weights):
                    return -1, region
                placed = _place(a, b, left, right, bent, points[n:], weights[n:])
                for j in range(n, n + placed):
                    weights[j] *= weight * scale
                    regions[j] = region
                    x = points[j, 0]
                    points[j, 0] = x if sweep_v else s
                    points[j, 1] = s if sweep_v else x
                n += placed
        if n > before:
            region += 1
    return n, region


@njit(cache=True, nogil=True, inline="always")
def _cut(t, low, middle, high):  # type: ignore[no-untyped-def]
    """Return where, from 0 to 1, a strip of some widths at its ends and in its middle is cut, t of the pieces on.

    Beside a limb the mean over the width grows like the root of the width. Where the interval shrinks to a point the
    cuts gather there.
    """
    if low < _SHRINKS * middle and high < _SHRINKS * middle:
        return t * t * (3.0 - 2.0 * t)
    if low < _SHRINKS * middle:
        return t * t
    if high < _SHRINKS * middle:
        return t * (2.0 - t)
    return t


@njit(cache=True, nogil=True)
def _gauss_rule(lo, hi, n_slabs, i, k, x0, x1, edges, slabs, links):  # type: ignore[no-untyped-def]
    """Return the Gauss rule for the width of an interval from `lo` to `hi` as weight.

    Returns
    -------
    nodes : int
        0 (nothing there), 1 or 2.
    area : float
    s_a, s_b : float
        Nodes.
    share : float
        Of the first node in the area.
    """
    origin = 0.5 * (lo + hi)
    m0, m1, m2, m3 = 0.0, 0.0, 0.0, 0.0
    first_a, first_b, last_a, last_b, met = 0.0, 0.0, 0.0, 0.0, False
    for slab in range(n_slabs):
        begin, end = max(slabs[slab, 0], lo), min(slabs[slab, 1], hi)
        if end <= begin:
            continue
        a, b = _bounds(begin, slab, i, k, x0, x1, edges, links)
        last_a, last_b = _bounds(end, slab, i, k, x0, x1, edges, links)
        if not met:
            first_a, first_b, met = a, b, True
        low, high = max(b - a, 0.0), max(last_b - last_a, 0.0)
        h, d = end - begin, 0.5 * (begin + end) - origin
        # moments of a trapezoid about its middle, then about the origin
        c0, c1 = 0.5 * (low + high) * h, (high - low) * h * h / 12.0
        c2, c3 = c0 * h * h / 12.0, c1 * h * h * (12.0 / 80.0)
        m0 += c0
        m1 += c1 + d * c0
        m2 += c2 + d * (2.0 * c1 + d * c0)
        m3 += c3 + d * (3.0 * c2 + d * (3.0 * c1 + d * c0))
    if m0 <= _EMPTY * (hi - lo):
        return 0, 0.0, 0.0, 0.0, 0.0
    mean = m1 / m0
    variance = m2 / m0 - mean * mean
    extent = max(hi - lo, abs(last_a - first_a), abs(last_b - first_b))
    if extent < _NARROW or m0 * extent * extent < _TRIFLE or variance < 1e-12:
        return 1, m0, origin + mean, 0.0, 1.0
    skew = (m3 / m0 - mean * (3.0 * m2 / m0 - 2.0 * mean * mean)) / variance
    root = math.sqrt(skew * skew + 4.0 * variance)
    below, above = 0.5 * (skew - root), 0.5 * (skew + root)
    s_a, s_b = origin + mean + below, origin + mean + above
    return 2, m0, max(s_a, lo), min(s_b, hi), above / root


@njit(cache=True, nogil=True, inline="always")
def _bounds(s, slab, i, k, x0, x1, edges, links):  # type: ignore[no-untyped-def]
    """Return the ends of interval i on the line at s, which lies in a slab."""
    a = x0 if i == 0 else _edge_at(edges, links[slab * k + i - 1], s)
    b = x1 if i == k else _edge_at(edges, links[slab * k + i], s)
    return a, b


@njit(cache=True, nogil=True)
def _interval(  # type: ignore[no-untyped-def]
    s, n_slabs, i, k, x0, x1, edges, slabs, links, limbs, n_limbs, seek_left, seek_right
):
    """Return the ends of interval i on the line at s, and where its surface's limbs are, ∓inf where there is none.

    Limbs beyond the strip are looked for where `seek_left` and `seek_right` say so.
    """
    low, high = 0, n_slabs - 1
    while low < high:
        middle = (low + high) // 2
        if slabs[middle, 1] < s:
            low = middle + 1
        else:
            high = middle
    row = low * k
    a, b = _bounds(s, low, i, k, x0, x1, edges, links)
    left, right = -np.inf, np.inf
    behind_limb = False
    for j in range(i - 1, -1, -1):
        side = edges[links[row + j], 4]
        if side != 0.0:
            behind_limb = side < 0.0
            if side > 0.0:
                left = _edge_at(edges, links[row + j], s)
            break
    before_limb, alone = False, True
    for j in range(i, k):
        side = edges[links[row + j], 4]
        if side != 0.0:
            before_limb, alone = side > 0.0, False
            if side < 0.0:
                right = _edge_at(edges, links[row + j], s)
            break
    if not behind_limb:
        if seek_left and left == -np.inf and not before_limb:
            left = _nearest_limb(limbs, n_limbs, s, 1.0, a)
        if seek_right and alone:
            right = _nearest_limb(limbs, n_limbs, s, -1.0, b)
    return a, b, left, right


@njit(cache=True, nogil=True)
def _place(a, b, left, right, bent, points, weights):  # type: ignore[no-untyped-def]
    """Place Gauss points on one interval [a, b], with limbs at `left` and `right` (∓inf: none).

    Column 0 of `points` gets the places, `weights` weights that add up to one; returns their number.
    """
    near_left, near_right = a - left < _FELT, right - b < _FELT
    middle, half = 0.0, 0.0
    count = 2 + (b - a > _BESIDE_LIMB[0]) + (b - a > _BESIDE_LIMB[1])
    if near_left and near_right:
        middle, half = 0.5 * (left + right), 0.5 * (right - left)
        t0 = math.asin(min(max((a - middle) / half, -1.0), 1.0))
        t1 = math.asin(max(min((b - middle) / half, 1.0), -1.0))
        count = 5
    elif near_left:
        t0, t1 = math.sqrt(max(a - left, 0.0)), math.sqrt(max(b - left, 0.0))
    elif near_right:
        t0, t1 = math.sqrt(max(right - a, 0.0)), math.sqrt(max(right - b, 0.0))
    else:
        count = 1 if b - a < _THIN else (3 if bent and b - a > _WIDE else 2)
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
        points[g, 0] = x
        weights[g] = w
        total += w
    if total <= 0.0:  # a hair beside a limb
        points[0, 0], weights[0] = 0.5 * (a + b), 1.0
        return 1
    for g in range(count):  # the constant is integrated exactly, whatever the substitution
        weights[g] /= total
    return count
