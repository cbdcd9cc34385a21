"""Points on the edges inside pixels, where the light of a pixel changes as the edges move.

Left of an edge is the side of smaller x, right that of larger x, x being the coordinate across the sweep.

The sweep knows which intervals lie on both sides of an edge; their samples tell later which faces are seen there. What
becomes of the points stands in :mod:`~phasemark.render.integral.edge_motion` and
:mod:`~phasemark.render.integral.swept_light`.
"""

from __future__ import annotations

from phasemark.render.integral.edges_in_pixels import edge_at
from phasemark.render.integral.quadrature_rules import G2W, G2X, G3W, G3X
from phasemark.render.kernel import inner

_THIN = 1e-4
"""An edge that crosses a strip thinner than this (pixels) runs nearly along x: :func:`_place_level` handles it."""
_SHORT, _LONG = 0.1, 0.5
"""Pieces of an edge up to the first (pixels) get one point, up to the second two, longer ones three."""


@inner
def place_borders(strip, box, scratch, borders):  # type: ignore[no-untyped-def]
    """Place points on the curves of a strip whose intervals have been sampled; see :class:`Borders`.

    An interval without samples is empty: its two curves are one. What lies on an edge along the border between this
    strip and the one before is placed too.
    """
    k, slabs, links, edges, found = strip.k, scratch.slabs, scratch.links, scratch.edges, scratch.found
    if slabs[strip.n_slabs - 1, 1] - slabs[0, 0] < _THIN:
        return
    _place_level(strip, box, scratch, borders)
    left = -1
    for i in range(k):
        left = found[i] if found[i] >= 0 else left
        right = found[i + 1]
        if left < 0 or right < 0:
            continue
        for slab in range(strip.n_slabs):
            link, lo, hi = links[slab * k + i], slabs[slab, 0], slabs[slab, 1]
            extent = max(hi - lo, abs(hi - lo) * abs(edges[link, 5]))
            nodes = 1 if extent < _SHORT else (2 if extent < _LONG else 3)
            for g in range(nodes):
                at, weight = _node(nodes, g)
                s = lo + at * (hi - lo)
                x = edge_at(edges, link, s)
                _append(x, s, weight * (hi - lo), left, right, link, box.sweep_v, box.scale, scratch, borders)
    last = strip.n_slabs - 1
    for i in range(k):
        scratch.last_x[i] = edge_at(edges, links[last * k + i], slabs[last, 1])
    for i in range(k + 1):
        scratch.last_found[i] = found[i]
    scratch.last_strip[0], scratch.last_strip[1] = k, slabs[last, 1]


@inner
def _node(nodes, g):  # type: ignore[no-untyped-def]
    """Return place and weight of a Gauss point on [0, 1]."""
    if nodes == 1:
        return 0.5, 1.0
    if nodes == 2:
        return G2X[g], G2W[g]
    return G3X[g], G3W[g]


@inner
def _append(x, s, weight, left, right, link, sweep_v, scale, scratch, borders):  # type: ignore[no-untyped-def]
    """Append one point; `sweep_v` says that s is v, the coordinate along which the weight is a length."""
    n = borders.placed[0]
    borders.placed[0] = n + 1
    if n >= len(borders.weights):
        return
    borders.points[n, 0] = x if sweep_v else s
    borders.points[n, 1] = s if sweep_v else x
    borders.weights[n] = weight * scale
    borders.regions[n, 0], borders.regions[n, 1] = left, right
    borders.segment[n] = int(scratch.edges[link, 6])
    borders.side[n] = scratch.edges[link, 4]
    borders.along_v[n] = 1 if sweep_v else 0


@inner
def _place_level(strip, box, scratch, borders):  # type: ignore[no-untyped-def]
    """Place points on edges that lie along the border between the last strip and this one."""
    edges, found, slabs = scratch.edges, scratch.found, scratch.slabs
    k_last, stop, start = int(scratch.last_strip[0]), scratch.last_strip[1], slabs[0, 0]
    if k_last < 0 or start - stop > 2 * _THIN:
        return
    for e in range(scratch.n_edges[0]):
        if edges[e, 0] > start + _THIN:
            break
        if edges[e, 2] - edges[e, 0] >= _THIN or edges[e, 2] < stop - _THIN or edges[e, 0] < stop - _THIN:
            continue
        begin, end = min(edges[e, 1], edges[e, 3]), max(edges[e, 1], edges[e, 3])
        # the limb's side is stated for edges that are crossed along x; the normal of this one points along s
        side = edges[e, 4] * (-1.0 if edges[e, 3] > edges[e, 1] else 1.0)
        while end - begin > _THIN:
            before, after = 0, 0
            until = end
            while before < k_last and scratch.last_x[before] <= begin + 1e-9:
                before += 1
            if before < k_last:
                until = min(until, scratch.last_x[before])
            while after < strip.k and edge_at(edges, scratch.links[after], start) <= begin + 1e-9:
                after += 1
            if after < strip.k:
                until = min(until, edge_at(edges, scratch.links[after], start))
            left, right = scratch.last_found[before], found[after]
            if left >= 0 and right >= 0:
                for g in range(3):
                    x = begin + G3X[g] * (until - begin)
                    n = borders.placed[0]
                    _append(
                        0.5 * (edges[e, 0] + edges[e, 2]), x, G3W[g] * (until - begin), left, right, e,
                        not box.sweep_v, box.scale, scratch, borders,
                    )  # fmt: skip
                    if n < len(borders.weights):
                        borders.side[n] = side
            begin = until
