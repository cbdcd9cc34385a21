"""Rays of a pixel: its active area is split along the projected edges, with Gauss points in every smooth piece.

Edges cut a pixel into pieces inside which the integrand is smooth. Along one image axis (the *sweep*) the pixel is cut
into slabs wherever an edge begins, ends, crosses another, enters or leaves; within a slab the edges do not cross, so
every line across it meets them in the same order, and the pieces between them are trapezoids. A few Gauss lines in the
slab, and a few Gauss points between neighbouring edges on each line, integrate them.

Beside the limb of a curved surface the points are placed with a substitution (`quadrature_rules`). The limb may lie in
the neighbouring pixel, so those are asked. The sweep runs along the limb, so that lines cross it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.render.integral.edges_in_pixels import MAX_SEGMENTS, clip, clip_to_box
from phasemark.render.integral.intervals import Box, add_piece
from phasemark.render.integral.limbs import MAX_LIMBS, collect_limbs, lists_limb
from phasemark.render.integral.quadrature_rules import G2X, G3W, G3X
from phasemark.render.integral.strips import MAX_EVENTS, MAX_LINKS, MAX_SLABS, find_events, sweep_box
from phasemark.render.kernel import inlined, inner

_MAX_DEPTH = 5
_MOST_TURNS = 3
"""How often a box is cut for limbs that run along both of its sides."""
_LEAST_LIMB, _ALONG, _FELT = 0.1, 3.0, 0.5
"""These limbs are longer than this share of the side, in a proportion above this, and felt this many sides away."""


class Scratch(NamedTuple):
    """Scratch of one thread for the pixel at hand.

    Parameters
    ----------
    boxes : (4 * _MAX_DEPTH + 4, 5) float64
        Parts of the pixel still to be split: u, v of two corners, level.
    clipped : (MAX_SEGMENTS, 8) float64
        The edges of a box as they come.
    order : (MAX_SEGMENTS,) int64
        Their order.
    edges : (MAX_SEGMENTS, 8) float64
        The same in order: s, x of both ends (s rising), side of the surface where the edge is a limb, slope dx/ds,
        number of the segment, and the body whose limb it is (−1: not known).
    n_edges : (1,) int64
        How many there are.
    events : (MAX_EVENTS,) float64
        Where slabs begin and end.
    active : (MAX_SEGMENTS,) int64
        Edges across the slab at hand, in the order of x.
    slabs : (MAX_SLABS, 2) float64
        Begin and end of the slabs of a strip.
    links : (MAX_LINKS,) int64
        Edges of the slabs of a strip, slab by slab.
    limbs : (2, MAX_LIMBS, 6) float64
        Limbs of the pixel and its neighbours, see :func:`collect_limbs`.
    n_limbs : (2,) int64
    found : (MAX_SEGMENTS + 1,) int64
        Numbers of the intervals of the strip at hand as samples count them, −1: empty.
    last_x, last_found : (MAX_SEGMENTS + 1,) float64, int64
        The curves at the end of the strip before, and its intervals.
    last_strip : (2,) float64
        How many curves it has, −1: there is none; and where it ends.
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
    n_edges: NDArray[np.int64]
    found: NDArray[np.int64]
    last_x: NDArray[np.float64]
    last_found: NDArray[np.int64]
    last_strip: NDArray[np.float64]

    @classmethod
    def empty(cls) -> Scratch:
        """Return scratch for one thread."""
        return cls(
            boxes=np.empty((4 * _MAX_DEPTH + 4, 5)),
            clipped=np.empty((MAX_SEGMENTS, 8)),
            order=np.empty(MAX_SEGMENTS, np.int64),
            edges=np.empty((MAX_SEGMENTS, 8)),
            events=np.empty(MAX_EVENTS),
            active=np.empty(MAX_SEGMENTS, np.int64),
            slabs=np.empty((MAX_SLABS, 2)),
            links=np.empty(MAX_LINKS, np.int64),
            limbs=np.empty((2, MAX_LIMBS, 6)),
            n_limbs=np.zeros(2, np.int64),
            n_edges=np.zeros(1, np.int64),
            found=np.empty(MAX_SEGMENTS + 1, np.int64),
            last_x=np.empty(MAX_SEGMENTS + 1),
            last_found=np.empty(MAX_SEGMENTS + 1, np.int64),
            last_strip=np.empty(2),
        )


@inlined
def sample_pixel(r, c, bent, splits_u, splits_v, camera, edges, scratch, samples, borders, n, region):  # type: ignore[no-untyped-def]
    """Place the samples of one pixel.

    Parameters
    ----------
    r, c : int
        Row and column.
    bent : bool
        Whether the pixel may see the inside of a curved surface, which takes more points than a flat one.
    splits_u, splits_v : int
        Boxes along u and along v that the active area is cut into before anything else.
    camera : Camera
    edges : Edges
        As :func:`project_edges` and :func:`bin_segments` left them.
    scratch : Scratch
    samples : Samples
        ``points``, ``weights``, which add up to one, and ``regions``, counted from `region`, are written from `n` on.
    borders : Borders
        Appended to if there is room for any.
    n, region : int

    Returns
    -------
    n, region, trusted : int, int, bool
        Where the next pixel starts (n = −1: the arrays are full), and whether every box could be split exactly.
    """
    head, segments, limb, link, owner = edges.head, edges.segments, edges.limb, edges.link, edges.owner
    points, weights, regions = samples.points, samples.weights, samples.regions
    width, height = camera.fill_u, camera.fill_v
    u0 = c + 0.5 - 0.5 * width
    v0 = r + 0.5 - 0.5 * height
    inverse_area = 1.0 / (width * height)
    i, j = r + 1, c + 1
    sideways = lists_limb(head[i, j - 1], edges) or lists_limb(head[i, j + 1], edges)
    upright = lists_limb(head[i - 1, j], edges) or lists_limb(head[i + 1, j], edges)
    if head[i, j] < 0 and not sideways and not upright:
        count = 3 if bent else 2
        if n + splits_u * splits_v * count * count > len(weights):
            return -1, region, True
        for part in range(splits_u * splits_v):
            row, col = divmod(part, splits_u)
            for a in range(count):
                for b in range(count):
                    points[n, 0] = u0 + width / splits_u * (col + (G3X[b] if bent else G2X[b]))
                    points[n, 1] = v0 + height / splits_v * (row + (G3X[a] if bent else G2X[a]))
                    weights[n] = (G3W[a] * G3W[b] if bent else 0.25) / (splits_u * splits_v)
                    regions[n] = region
                    n += 1
            region += 1
            if len(samples.pieces.samples) > 0:
                left, top = u0 + width / splits_u * col, v0 + height / splits_v * row
                right, bottom = left + width / splits_u, top + height / splits_v
                add_piece(samples.pieces, n - count * count, n, np.bool_(True), (top, bottom, left, right, left, right))
        return n, region, True
    # sweep along the limb if there is one, else along where one is near, else along most of the edges
    crease_u, crease_v, limb_u, limb_v = 0.0, 0.0, 0.0, 0.0
    entry = head[i, j]
    while entry >= 0:
        k = owner[entry]
        ua, va, ub, vb = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
        lo, hi = clip(ua, va, ub, vb, float(c), float(r), c + 1.0, r + 1.0)
        du, dv = max(hi - lo, 0.0) * abs(ub - ua), max(hi - lo, 0.0) * abs(vb - va)
        if limb[k] == 1:
            limb_u, limb_v = limb_u + du, limb_v + dv
        elif limb[k] == 0:
            crease_u, crease_v = crease_u + du, crease_v + dv
        entry = link[entry]
    has_limb = limb_u > 0.0 or limb_v > 0.0
    if has_limb:
        sweep_v = limb_v >= limb_u
    elif sideways != upright:
        sweep_v = sideways
    elif sideways:
        for near in (head[i, j - 1], head[i, j + 1], head[i - 1, j], head[i + 1, j]):
            du, dv = _extent_of_limbs(near, edges, c - 1.0, r - 1.0, c + 2.0, r + 2.0)
            limb_u, limb_v = limb_u + du, limb_v + dv
        sweep_v = limb_v >= limb_u
    else:
        sweep_v = crease_v >= crease_u
    curved = sideways or upright or has_limb
    _collect_about(i, j, curved, sweep_v, edges, scratch)
    whole_v, collected_v = sweep_v, sweep_v
    turned = curved and _directions(i, j, edges, c + 0.0, r + 0.0, c + 1.0, r + 1.0)[0]
    stack = scratch.boxes
    part, depth, trusted = 0, 0, True
    while depth > 0 or part < splits_u * splits_v:
        if depth == 0:
            row, col = divmod(part, splits_u)
            left, right = u0 + width * col / splits_u, u0 + width * (col + 1) / splits_u
            top, bottom = v0 + height * row / splits_v, v0 + height * (row + 1) / splits_v
            _put_box(stack, np.int64(0), left, top, right, bottom, 0.0)
            part, depth = part + 1, 1
        depth -= 1
        bu0, bv0, bu1, bv1, level = stack[depth]
        crossed = False
        if turned:  # limbs of several bodies run along u and along v: boxes with one direction each
            crossed, along_u, along_v = _directions(i, j, edges, bu0, bv0, bu1, bv1)
            crossed = crossed and level < _MOST_TURNS
            sweep_v = whole_v if along_u == along_v else along_v > along_u
            if not crossed and sweep_v != collected_v:
                _collect_about(i, j, curved, sweep_v, edges, scratch)
                collected_v = sweep_v
        m = -1 if crossed else clip_to_box(head[i, j], edges, bu0, bv0, bu1, bv1, sweep_v, scratch)
        if sweep_v:
            box = Box(bv0, bv1, bu0, bu1, sweep_v, curved, bent, inverse_area)
        else:
            box = Box(bu0, bu1, bv0, bv1, sweep_v, curved, bent, inverse_area)
        n_events = find_events(box, m, scratch) if m >= 0 else -1
        if n_events < 0 and level < _MAX_DEPTH:
            um, vm = 0.5 * (bu0 + bu1), 0.5 * (bv0 + bv1)
            _put_box(stack, depth, bu0, bv0, um, vm, level + 1)
            _put_box(stack, depth + 1, um, bv0, bu1, vm, level + 1)
            _put_box(stack, depth + 2, bu0, vm, um, bv1, level + 1)
            _put_box(stack, depth + 3, um, vm, bu1, bv1, level + 1)
            depth += 4
            continue
        if n_events < 0:
            m, trusted = np.int64(0), False
            n_events = find_events(box, m, scratch)
        n, region = sweep_box(box, n_events, m, scratch, samples, borders, n, region)
        if n < 0:
            return -1, region, trusted
    return n, region, trusted


@inner
def _put_box(stack, k, u0, v0, u1, v1, level):  # type: ignore[no-untyped-def]
    """Write the k-th box still to be split, number by number: numba compiles a row that is set to a tuple at length."""
    stack[k, 0], stack[k, 1], stack[k, 2], stack[k, 3], stack[k, 4] = u0, v0, u1, v1, level


@inner
def _collect_about(i, j, curved, sweep_v, edges, scratch):  # type: ignore[no-untyped-def]
    """Collect the limbs of a pixel and of its neighbours across the sweep, at which its surface may end."""
    head = edges.head
    scratch.n_limbs[:] = 0
    if curved:
        before, after = (head[i, j - 1], head[i, j + 1]) if sweep_v else (head[i - 1, j], head[i + 1, j])
        for near in (head[i, j], before, after):
            collect_limbs(near, edges, sweep_v, scratch)


@inner
def _directions(i, j, edges, u0, v0, u1, v1):  # type: ignore[no-untyped-def]
    """Return whether limbs of different bodies run along u and along v in and about a box, and their longest extents.

    The limb of one round body turns by itself, and its strips allow for that.
    """
    segments, head = edges.segments, edges.head
    along_u, along_v, body_u, body_v = 0.0, 0.0, -1.0, -1.0
    side_u, side_v = u1 - u0, v1 - v0
    for near in (head[i, j], head[i, j - 1], head[i, j + 1], head[i - 1, j], head[i + 1, j]):
        entry = near
        while entry >= 0:
            k = edges.owner[entry]
            entry = edges.link[entry]
            if edges.limb[k] != 1:
                continue
            ua, va, ub, vb = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
            more_u, more_v = _FELT * side_u, _FELT * side_v
            lo, hi = clip(ua, va, ub, vb, u0 - more_u, v0 - more_v, u1 + more_u, v1 + more_v)
            du, dv = max(hi - lo, 0.0) * abs(ub - ua), max(hi - lo, 0.0) * abs(vb - va)
            if du > _ALONG * dv and du > max(along_u, _LEAST_LIMB * side_u):
                along_u, body_u = du, edges.body[k]
            elif dv > _ALONG * du and dv > max(along_v, _LEAST_LIMB * side_v):
                along_v, body_v = dv, edges.body[k]
    return along_u > 0.0 and along_v > 0.0 and body_u != body_v, along_u, along_v


@inner
def _extent_of_limbs(entry, edges, u0, v0, u1, v1):  # type: ignore[no-untyped-def]
    """Return how far the limbs listed from `entry` on run along u and along v inside a box."""
    segments, along_u, along_v = edges.segments, 0.0, 0.0
    while entry >= 0:
        k = edges.owner[entry]
        entry = edges.link[entry]
        if edges.limb[k] == 1:
            ua, va, ub, vb = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
            lo, hi = clip(ua, va, ub, vb, u0, v0, u1, v1)
            along_u += max(hi - lo, 0.0) * abs(ub - ua)
            along_v += max(hi - lo, 0.0) * abs(vb - va)
    return along_u, along_v
