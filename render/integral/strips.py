"""A box of the image swept from one side to the other: slabs between events, joined to strips.

Slabs begin and end wherever an edge begins, ends or crosses another. Within a slab the edges do not cross, so every
line across it meets them in the same order.
"""

from __future__ import annotations

import numpy as np

from phasemark.render.integral.edges_in_pixels import MAX_SEGMENTS, edge_at
from phasemark.render.integral.intervals import EMPTY, Strip, sample_strip
from phasemark.render.kernel import inlined, inner

MAX_EVENTS = 4 * MAX_SEGMENTS + 64
MAX_SLABS = 256
MAX_LINKS = 4096
_KINK = 0.005
"""Links at an angle are one smooth curve where the shorter one sticks out by less than this (pixels)."""
_TURN = 0.4
"""Sine of the angle by which the curves of one strip may turn."""
PINCH = 1e-6
"""Edges closer than this (pixels) at the end of a slab meet there."""


@inner
def find_events(box, m, scratch):  # type: ignore[no-untyped-def]
    """Collect, sorted, where the order of the edges across the sweep may change.

    Returns their number, or −1 if there are too many.
    """
    edges, events = scratch.edges, scratch.events
    events[0] = box.s0
    n = 1
    for i in range(m):
        events[n] = edges[i, 0]
        events[n + 1] = edges[i, 2]
        n += 2
    events[n] = box.s1
    n += 1
    for i in range(m):
        for j in range(i + 1, m):
            if edges[j, 0] >= edges[i, 2]:
                break
            lo, hi = edges[j, 0], min(edges[i, 2], edges[j, 2])
            if hi - lo <= EMPTY:
                continue
            if max(edges[i, 1], edges[i, 3]) < min(edges[j, 1], edges[j, 3]):
                continue
            if max(edges[j, 1], edges[j, 3]) < min(edges[i, 1], edges[i, 3]):
                continue
            gap_lo = edge_at(edges, i, lo) - edge_at(edges, j, lo)
            gap_hi = edge_at(edges, i, hi) - edge_at(edges, j, hi)
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


@inner
def _activate(lo, hi, m, started, n_active, scratch):  # type: ignore[no-untyped-def]
    """Update the list of edges that span the slab [lo, hi], ordered along its middle line.

    Returns how many edges have started, and how many are active.
    """
    edges, active = scratch.edges, scratch.active
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
        x = edge_at(edges, edge, middle)
        j = i
        while j > 0 and edge_at(edges, active[j - 1], middle) > x:
            active[j] = active[j - 1]
            j -= 1
        active[j] = edge
    return started, n_active


@inner
def _continues(m, last, n, stop, lo, scratch):  # type: ignore[no-untyped-def]
    """Return True if the edges of two neighbouring slabs are the same, or links of the same smooth curves.

    Not so where edges cross, begin or end alone, where one lies along the border between the slabs, where a link stands
    at a noticeable angle to the one before, or where the curve has turned far since the strip's first slab. The last
    slab's edges stand in `links` from `last` on.
    """
    edges, links, after = scratch.edges, scratch.links, scratch.active
    for i in range(n):
        old, new = links[last + i], after[i]
        if old == new:
            continue
        if edges[old, 4] != edges[new, 4] or abs(edges[old, 2] - stop) > EMPTY or abs(edges[new, 0] - lo) > EMPTY:
            return False
        if abs(edges[old, 3] - edges[new, 1]) > PINCH:
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
        if edges[i, 0] > lo + EMPTY:
            break
        if edges[i, 2] <= lo + EMPTY and edges[i, 0] >= stop - EMPTY and abs(edges[i, 3] - edges[i, 1]) > EMPTY:
            return False
    return True


@inlined
def sweep_box(box, n_events, m, scratch, samples, borders, n, region):  # type: ignore[no-untyped-def]
    """Sample a box strip by strip.

    A rim or silhouette is a chain of many short edges, each of which begins and ends a slab. Neighbouring slabs in
    which the same chains run side by side make one strip, in which the chains are smooth curves.
    """
    events, active, slabs, links = scratch.events, scratch.active, scratch.slabs, scratch.links
    started, n_active, n_slabs, k = np.int64(0), np.int64(0), 0, np.int64(0)
    scratch.n_edges[0], scratch.last_strip[0] = m, -1.0
    for e in range(n_events - 1):
        lo, hi = max(events[e], box.s0), min(events[e + 1], box.s1)
        if hi - lo <= EMPTY:
            continue
        started, n_active = _activate(lo, hi, m, started, n_active, scratch)
        if n_slabs > 0:
            stop = slabs[n_slabs - 1, 1]
            full = n_slabs == len(slabs) or (n_slabs + 1) * k > len(links)
            joined = not full and n_active == k and lo - stop <= EMPTY
            if not (joined and _continues(m, (n_slabs - 1) * k, k, stop, lo, scratch)):
                n, region = sample_strip(Strip(n_slabs, int(k)), box, scratch, samples, borders, n, region)
                if n < 0:
                    return -1, region
                n_slabs = 0
        k = n_active
        slabs[n_slabs, 0], slabs[n_slabs, 1] = lo, hi
        for i in range(k):
            links[n_slabs * k + i] = active[i]
        n_slabs += 1
    if n_slabs > 0:
        n, region = sample_strip(Strip(n_slabs, int(k)), box, scratch, samples, borders, n, region)
    return n, region
