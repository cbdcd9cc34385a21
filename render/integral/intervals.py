"""Samples of a strip: its curves cut every line across it into intervals, and each interval gets Gauss points.

An interval lies between two neighbouring curves of the strip, or between a curve and a side of the box. Samples that
lie in one interval see one smooth patch of the surface.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from phasemark.render.integral.arguments import SLENDER
from phasemark.render.integral.borders import place_borders
from phasemark.render.integral.edges_in_pixels import edge_at
from phasemark.render.integral.limbs import nearest_limb
from phasemark.render.integral.quadrature_rules import FELT, MOST_POINTS, place_points
from phasemark.render.kernel import inner

EMPTY = 1e-10
"""Pieces narrower than this (pixels) are not sampled."""
_TRIFLE = 4e-6
"""Area times squared extent, in those of the box, under which a piece gets one line."""
_STRIP, _LIMB_STRIP = 0.5, 0.25
"""Largest extent, in sides of the box, of a piece with one Gauss rule: in general, and where a limb runs across it."""
_SHRINKS = 0.3
"""An interval shrinks to a point at an end of a strip where it is narrower than this share of its middle."""


class Box(NamedTuple):
    """A part of a pixel that is swept.

    Parameters
    ----------
    s0, s1, x0, x1 : float
        Begin and end along the sweep, and across it.
    sweep_v : bool
        Whether the sweep runs along v; s is v then, and x is u.
    curved : bool
        Whether a limb is near.
    bent : bool
        Whether the inside of a curved surface may be seen, which takes more points than a flat one.
    scale : float
        Turns areas into weights.
    """

    s0: float
    s1: float
    x0: float
    x1: float
    sweep_v: bool
    curved: bool
    bent: bool
    scale: float


class Strip(NamedTuple):
    """Neighbouring slabs with the same curves: how many slabs, and how many curves."""

    n_slabs: int
    k: int


@inner
def sample_strip(strip, box, scratch, samples, borders, n, region):  # type: ignore[no-untyped-def]
    """Sample the k + 1 intervals between the k curves of a strip.

    An interval's light is ∫ width(s) · mean over x of f(s, x) ds. The width is known exactly; its moments give the
    two-point Gauss rule for it as a weight, exact wherever the mean is cubic in s, and the area always.
    """
    points, weights, regions = samples.points, samples.weights, samples.regions
    start, stop = scratch.slabs[0, 0], scratch.slabs[strip.n_slabs - 1, 1]
    size = max(box.s1 - box.s0, box.x1 - box.x0)
    # A limb runs along an interval if it keeps its distance from both ends as well as this, in lengths of the box.
    parallel = 0.1
    for i in range(strip.k + 1):
        a, b, left, right, body = _interval(0.5 * (start + stop), i, strip, box, scratch, box.curved, box.curved)
        near_left, near_right = a - left < FELT, right - b < FELT
        limb, width = near_left or near_right, b - a
        whole = near_left and near_right and body >= 0.0
        a_low, b_low = _bounds(start, np.int64(0), i, strip, box, scratch)
        a_high, b_high = _bounds(stop, strip.n_slabs - 1, i, strip, box, scratch)
        extent = max(stop - start, abs(a_high - a_low), abs(b_high - b_low))
        steep = False
        if limb:
            _, _, left_low, right_low, _ = _interval(start, i, strip, box, scratch, near_left, near_right)
            _, _, left_high, right_high, _ = _interval(stop, i, strip, box, scratch, near_left, near_right)
            for near, at_low, at_high in ((near_left, left_low, left_high), (near_right, right_low, right_high)):
                moved = max(abs(at_high - at_low - a_high + a_low), abs(at_high - at_low - b_high + b_low))
                steep = steep or (near and not moved < parallel * (box.s1 - box.s0))
        pieces = math.ceil(extent / (size * (_LIMB_STRIP if steep else _STRIP)) - 1e-9)
        low, high = (max(b_low - a_low, 0.0), max(b_high - a_high, 0.0)) if limb else (1.0, 1.0)
        pieces += min(low, high) < _SHRINKS * width
        before = n
        for piece in range(pieces):
            lo = start + (stop - start) * _cut(piece / pieces, low, width, high)
            hi = start + (stop - start) * _cut((piece + 1) / pieces, low, width, high)
            nodes, area, s_a, s_b, share = _gauss_rule(lo, hi, i, strip, box, scratch, whole)
            first, a_first, b_first = n, 0.0, 0.0
            for g in range(nodes):
                s = s_a if g == 0 else s_b
                weight = area * (share if g == 0 else 1.0 - share)
                a, b, left, right, body = _interval(s, i, strip, box, scratch, near_left, near_right)
                if n + MOST_POINTS > len(weights):
                    return -1, region
                side, slender = box.x1 - box.x0, body >= SLENDER
                placed = place_points(a, b, left, right, side, box.bent, slender, points[n:], weights[n:])
                for j in range(n, n + placed):
                    weights[j] *= weight * box.scale
                    regions[j] = region
                    x = points[j, 0]
                    points[j, 0] = x if box.sweep_v else s
                    points[j, 1] = s if box.sweep_v else x
                n += placed
                if g == 0:
                    a_first, b_first = a, b
            if n > first and len(samples.pieces.samples) > 0:
                rise = (
                    1.0 / (s_b - s_a) if nodes == 2 else 0.0
                )  # of the ends, from the lines of the nodes to the others
                rise_a, rise_b = (a - a_first) * rise, (b - b_first) * rise
                ends = a_first + (lo - s_a) * rise_a, b_first + (lo - s_a) * rise_b
                far_ends = a_first + (hi - s_a) * rise_a, b_first + (hi - s_a) * rise_b
                add_piece(samples.pieces, first, n, box.sweep_v, (lo, hi, *ends, *far_ends))
        scratch.found[i] = region if n > before else -1
        region += n > before
    if len(borders.weights) > 0:
        place_borders(strip, box, scratch, borders)
    return n, region


@inner
def add_piece(pieces, first, stop, sweep_v, bounds):  # type: ignore[no-untyped-def]
    """Append a piece; there are no more of them than samples."""
    p = pieces.placed[0]
    pieces.samples[p, 0], pieces.samples[p, 1], pieces.sweep_v[p] = first, stop, sweep_v
    for k in range(6):
        pieces.bounds[p, k] = bounds[k]
    pieces.placed[0] = p + 1


@inner
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


@inner
def _gauss_rule(lo, hi, i, strip, box, scratch, whole):  # type: ignore[no-untyped-def]
    """Return the Gauss rule for the width of an interval from `lo` to `hi` as weight.

    A `whole` interval, from limb to limb of a round body, may be all that is seen of it: its light is no trifle.

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
    slabs = scratch.slabs
    origin = 0.5 * (lo + hi)
    m0, m1, m2, m3 = 0.0, 0.0, 0.0, 0.0
    first_a, first_b, last_a, last_b, met = 0.0, 0.0, 0.0, 0.0, False
    for slab in range(strip.n_slabs):
        begin, end = max(slabs[slab, 0], lo), min(slabs[slab, 1], hi)
        if end <= begin:
            continue
        a, b = _bounds(begin, slab, i, strip, box, scratch)
        last_a, last_b = _bounds(end, slab, i, strip, box, scratch)
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
    if m0 <= EMPTY * (hi - lo):
        return 0, 0.0, 0.0, 0.0, 0.0
    mean = m1 / m0
    variance = m2 / m0 - mean * mean
    extent = max(hi - lo, abs(last_a - first_a), abs(last_b - first_b))
    length, side = box.s1 - box.s0, box.x1 - box.x0
    trifle = 0.0 if whole else _TRIFLE * length * length * side * side
    narrow = 0.0016 if whole else 0.04  # strips narrower than this share of their box get one line
    if extent < narrow * length or m0 * extent * extent < trifle or variance < 1e-12:
        return 1, m0, origin + mean, 0.0, 1.0
    skew = (m3 / m0 - mean * (3.0 * m2 / m0 - 2.0 * mean * mean)) / variance
    root = math.sqrt(skew * skew + 4.0 * variance)
    below, above = 0.5 * (skew - root), 0.5 * (skew + root)
    s_a, s_b = origin + mean + below, origin + mean + above
    return 2, m0, max(s_a, lo), min(s_b, hi), above / root


@inner
def _bounds(s, slab, i, strip, box, scratch):  # type: ignore[no-untyped-def]
    """Return the ends of interval i on the line at s, which lies in a slab."""
    row, edges, links = slab * strip.k, scratch.edges, scratch.links
    a = box.x0 if i == 0 else edge_at(edges, links[row + i - 1], s)
    b = box.x1 if i == strip.k else edge_at(edges, links[row + i], s)
    return a, b


@inner
def _interval(  # type: ignore[no-untyped-def]
    s, i, strip, box, scratch, seek_left, seek_right
):
    """Return the ends of interval i on the line at s, where its limbs are, ∓inf where there is none, and their body.

    Limbs beyond the strip are looked for where `seek_left` and `seek_right` say so.
    """
    edges, slabs, links = scratch.edges, scratch.slabs, scratch.links
    low, high = 0, strip.n_slabs - 1
    while low < high:
        middle = (low + high) // 2
        if slabs[middle, 1] < s:
            low = middle + 1
        else:
            high = middle
    row = low * strip.k
    a, b = _bounds(s, low, i, strip, box, scratch)
    # a limb whose surface is on its other side hides where ours ends, unless our body is known
    left, right, body, open_left, open_right = -np.inf, np.inf, -1.0, True, True
    for j in range(i - 1, -1, -1):
        e = links[row + j]
        if edges[e, 4] != 0.0:
            if edges[e, 4] > 0.0:
                left, body = edge_at(edges, e, s), edges[e, 7]
            open_left = False
            break
    for j in range(i, strip.k):
        e = links[row + j]
        if edges[e, 4] != 0.0:
            if edges[e, 4] < 0.0:
                right, body = edge_at(edges, e, s), edges[e, 7]
            open_right = False
            break
    if seek_left and open_left:
        left, body = nearest_limb(scratch, s, 1.0, a, body)
    if seek_right and right == np.inf and (open_right or body >= 0.0):
        right, body = nearest_limb(scratch, s, -1.0, b, body)
    if seek_left and left == -np.inf and body >= 0.0:
        left, _ = nearest_limb(scratch, s, 1.0, a, body)
    return a, b, left, right, body
