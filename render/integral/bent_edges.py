"""Edges seen through a lens with distortion: each becomes a chain of straight links along its curved image.

In tangents (y, z) of rays (1, y, z) the image of an edge is straight. It is clipped there to what can matter, for far
outside the image the polynomials of a lens fold back into it. The vertices of a chain lie outside the curve, two
thirds of a link's sagitta away from it, so that the area beside each link is that beside the curve. A chain begins and
ends on the curve, where it meets other edges; its first and last link are shorter by √2, which makes up for that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from phasemark.render.integral.edges_in_pixels import clip
from phasemark.render.integral.image_rays import image_of
from phasemark.render.kernel import inner

FULL = -1
"""Number of segments that says that there is no room for more."""
_FLAT_PX = 1.5e-5
"""Largest distance of a curve from its chord at which the chord alone is taken: its area is not corrected."""
_SHORT = math.sqrt(0.5)
"""First and last link of a chain, in lengths of the others."""


class Plane(NamedTuple):
    """Camera as :func:`~phasemark.render.integral.edge_projection.project` needs it."""

    centre_u: float
    centre_v: float
    scale_u: float
    scale_v: float


TANGENTS = Plane(0.0, 0.0, -1.0, -1.0)
"""The camera whose image points are tangents: u is y, v is z."""


@inner
def start_extents(edges):  # type: ignore[no-untyped-def]
    """Make the extents of the edges empty."""
    for k in range(2):
        edges.extent[k, 0] = edges.extent[k, 2] = math.inf
        edges.extent[k, 1] = edges.extent[k, 3] = -math.inf


@inner
def add_bent_edge(ya, za, yb, zb, start, end, limb, camera, edges, n):  # type: ignore[no-untyped-def]
    """Append the links of an edge.

    Parameters
    ----------
    ya, za, yb, zb : float
        Tangents of its ends.
    start, end : int
        Its vertices, as ``edges.ends`` has them.
    limb : int
        As :class:`~phasemark.render.integral.arguments.Edges` has it.
    camera : Camera
    edges : Edges
        ``segments``, ``limb`` and ``ends`` are written from `n` on; ``extent`` grows.
    n : int

    Returns
    -------
    int
        How many segments there are, or :data:`FULL`.
    """
    lens, segments = camera.distortion, edges.segments
    if start >= 0:  # the background belongs to every pixel, whether its edge is there or not
        for k in range(1 + (limb == 1)):
            extent = edges.extent[k]
            extent[0], extent[1] = min(extent[0], ya, yb), max(extent[1], ya, yb)
            extent[2], extent[3] = min(extent[2], za, zb), max(extent[3], za, zb)
    low, high = _clip_to_lens(ya, za, yb, zb, lens)
    if low >= high:
        return n
    dy, dz = yb - ya, zb - za
    if high < 1.0:
        yb, zb = ya + high * dy, za + high * dz
    if low > 0.0:
        ya, za = ya + low * dy, za + low * dz
    dy, dz = yb - ya, zb - za
    ua, va = image_of(camera, ya, za)
    ub, vb = image_of(camera, yb, zb)
    links = 1
    if lens.bend * (dy * dy + dz * dz) > _FLAT_PX:
        links = _count_links(ya, za, dy, dz, ua, va, ub, vb, camera)
    if n + links >= len(segments):
        return FULL
    for i in range(n, n + links):
        edges.limb[i], edges.body[i] = limb, -1
        edges.ends[i, 0], edges.ends[i, 1] = start, end
    if links == 1:
        segments[n, 0], segments[n, 1], segments[n, 2], segments[n, 3] = ua, va, ub, vb
        return n + 1
    step = 1.0 / (links - 2 + 2.0 * _SHORT)
    u0, v0, u1, v1 = ua, va, ua, va  # on the curve: the vertex before, and the one at hand
    from_u, from_v, before = ua, va, 0.0  # the chain's last vertex, and the length of the link on the curve before
    for i in range(links):
        u2, v2, after = ub, vb, _SHORT
        if i < links - 1:
            at = (_SHORT + i) * step
            u2, v2 = image_of(camera, ya + at * dy, za + at * dz)
            after = 1.0 if i > 0 else _SHORT
        if i > 0:
            # the curvature by divided differences over both links; a sagitta is an eighth of it, the length being 1
            share = 2.0 / (before + after) / 12.0
            to_u = u1 - share * ((u2 - u1) / after - (u1 - u0) / before)
            to_v = v1 - share * ((v2 - v1) / after - (v1 - v0) / before)
            segments[n + i - 1, 0], segments[n + i - 1, 1] = from_u, from_v
            segments[n + i - 1, 2], segments[n + i - 1, 3] = to_u, to_v
            from_u, from_v = to_u, to_v
        u0, v0, u1, v1, before = u1, v1, u2, v2, after
    last = n + links - 1
    segments[last, 0], segments[last, 1], segments[last, 2], segments[last, 3] = from_u, from_v, ub, vb
    return n + links


@inner
def _clip_to_lens(ya, za, yb, zb, lens):  # type: ignore[no-untyped-def]
    """Return the shares of a line, in tangents, between which it lies where the lens matters and does not fold."""
    low, high = clip(ya, za, yb, zb, lens.low_y, lens.low_z, lens.high_y, lens.high_z)
    dy, dz = yb - ya, zb - za
    a, b, c = dy * dy + dz * dz, ya * dy + za * dz, ya * ya + za * za - lens.radius * lens.radius
    inside = b * b - a * c
    if a == 0.0 or inside <= 0.0:
        return low, (high if c <= 0.0 else -1.0)
    root = math.sqrt(inside)
    return max(low, (-b - root) / a), min(high, (-b + root) / a)


@inner
def _count_links(ya, za, dy, dz, ua, va, ub, vb, camera):  # type: ignore[no-untyped-def]
    """Return how many links the image of a line needs, from its second differences across its chord."""
    du, dv = ub - ua, vb - va
    chord = math.sqrt(du * du + dv * dv)
    if chord == 0.0:
        return 1
    widest = 0.0
    u0, v0 = ua, va
    u1, v1 = image_of(camera, ya + 0.25 * dy, za + 0.25 * dz)
    for i in range(2, 5):
        u2, v2 = ub, vb
        if i < 4:
            u2, v2 = image_of(camera, ya + 0.25 * i * dy, za + 0.25 * i * dz)
        aside = abs((u0 - 2.0 * u1 + u2) * dv - (v0 - 2.0 * v1 + v2) * du) / chord
        widest = max(widest, aside)
        u0, v0, u1, v1 = u1, v1, u2, v2
    # the second difference over a quarter is eight times a quarter's sagitta; sagittas go with the square of lengths
    if 2.0 * widest <= _FLAT_PX:
        return 1
    sagitta_px = 1.5e-4  # largest distance of a curve from the chord of one link
    links = math.ceil(4.0 * math.sqrt(widest / (8.0 * sagitta_px)) + 2.0 * (1.0 - _SHORT))
    most_links = 4096
    return min(max(links, 2), most_links)
