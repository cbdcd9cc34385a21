"""Projected edges in the grid of pixels: listed for each pixel, and clipped to a box."""

from __future__ import annotations

import math

from phasemark.render.integral.arguments import HIDDEN_LIMB
from phasemark.render.kernel import inner

MAX_SEGMENTS = 128
"""Edges in a box above which it is quartered rather than swept: crossings are searched pair by pair."""


@inner
def bin_segments(n_segments, camera, edges):  # type: ignore[no-untyped-def]
    """List the segments of every pixel, with a border of one pixel around the image.

    Parameters
    ----------
    n_segments : int
        How many of the segments there are.
    camera : Camera
    edges : Edges
        ``head``, ``link`` and ``owner`` are overwritten.

    Returns
    -------
    int
        Entries used, or −1 if ``link`` is too short.
    """
    segments, head, link, owner = edges.segments, edges.head, edges.link, edges.owner
    rows, cols = camera.rows, camera.cols
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


@inner
def clip(ua, va, ub, vb, u0, v0, u1, v1):  # type: ignore[no-untyped-def]
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


@inner
def clip_to_box(entry, edges, u0, v0, u1, v1, sweep_v, scratch):  # type: ignore[no-untyped-def]
    """Clip a pixel's segments to a box, into ``scratch.edges``.

    Its rows are s, x of both ends (s rising), the limb's side, the slope, the segment and the body whose limb it is,
    sorted by where they begin. Limbs that are hidden are left out.
    The side is +1 where the surface lies towards larger x, −1 towards smaller x, 0 for a crease. Returns their number,
    or −1 if there are too many.
    """
    segments, limb, link, owner = edges.segments, edges.limb, edges.link, edges.owner
    clipped, order = scratch.clipped, scratch.order
    m = 0
    while entry >= 0:
        k = owner[entry]
        entry = link[entry]
        if limb[k] == HIDDEN_LIMB:
            continue
        ua, va, ub, vb = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
        du, dv = ub - ua, vb - va
        lo, hi = clip(ua, va, ub, vb, u0, v0, u1, v1)
        if lo >= hi:
            continue
        if m == MAX_SEGMENTS:
            return -1
        if sweep_v:
            sa, xa, sb, xb = va + lo * dv, ua + lo * du, va + hi * dv, ua + hi * du
            side = 1.0 if dv >= 0 else -1.0
        else:
            sa, xa, sb, xb = ua + lo * du, va + lo * dv, ua + hi * du, va + hi * dv
            side = -1.0 if du >= 0 else 1.0
        if sa <= sb:
            clipped[m, 0], clipped[m, 1], clipped[m, 2], clipped[m, 3] = sa, xa, sb, xb
        else:
            clipped[m, 0], clipped[m, 1], clipped[m, 2], clipped[m, 3] = sb, xb, sa, xa
        clipped[m, 4] = side if limb[k] else 0.0
        length = clipped[m, 2] - clipped[m, 0]
        clipped[m, 5] = (clipped[m, 3] - clipped[m, 1]) / length if length > 0.0 else 0.0
        clipped[m, 6], clipped[m, 7] = k, edges.body[k]
        begin, place = clipped[m, 0], m
        while place > 0 and clipped[order[place - 1], 0] > begin:
            order[place] = order[place - 1]
            place -= 1
        order[place] = m
        m += 1
    for i in range(m):
        for j in range(8):
            scratch.edges[i, j] = clipped[order[i], j]
    return m


@inner
def edge_at(edges, i, s):  # type: ignore[no-untyped-def]
    """Return where an edge meets the line at `s`."""
    return edges[i, 1] + (s - edges[i, 0]) * edges[i, 5]
