"""Edges of round surfaces: rims, seams and outlines, found for each view and drawn as chains of segments.

A curve is a row of 14 numbers: what it is, a centre C, three axes U, V, W at right angles, and the part of the surface
it belongs to. In the frame of the axes a ball is the unit sphere, and a tube the unit circle along W from −1 to 1; seen
from c in that frame,

- the outline of a ball is the circle around c / |c|² perpendicular to c, of radius √(1 − 1 / |c|²) (the polar plane);
- the outline of a tube is its lines at the angles ± arccos(1 / ρ) from c, ρ = |c| across the axis;
- a rim, where a plane ends a tube, is seen all around from before the plane, and else between these angles;
- a seam, where a ball continues a tube, is seen between these angles.
"""

from __future__ import annotations

import math

from phasemark.render.kernel import inner

RIM, SEAM, BALL, CAP, TUBE = 0, 1, 2, 3, 4
"""Edge of the plane face W · (p − C) = 0; that of a cap; outline of a ball; of its half W · (p − C) > 0; of a tube."""
_SAGITTA = 2e-3
"""How far the arc of a segment rises above it (pixels); chains have the area of their curves."""
_FEWEST, _MOST = 64, 512
"""Segments of a whole turn."""


@inner
def arc_of(curve, lens, arc):  # type: ignore[no-untyped-def]
    """Fill the ellipse of a curve, `arc` (3, 3): centre and two axes, world frame.

    Returns the angles from which to which it is seen, equal ones where nothing is. From before its plane the rest of a
    rim is seen too.
    """
    x, y, z = 0.0, 0.0, 0.0  # of the lens in the frame of the axes
    square_u, square_v, square_w = 0.0, 0.0, 0.0
    for k in range(3):
        to = lens[k] - curve[1 + k]
        x, y, z = x + to * curve[4 + k], y + to * curve[7 + k], z + to * curve[10 + k]
        square_u, square_v = square_u + curve[4 + k] ** 2, square_v + curve[7 + k] ** 2
        square_w += curve[10 + k] ** 2
    x, y, z = x / square_u, y / square_v, z / square_w
    if curve[0] == BALL or curve[0] == CAP:
        return _outline_of_ball(curve, x, y, z, arc)
    for k in range(3):
        arc[0, k], arc[1, k], arc[2, k] = curve[1 + k], curve[4 + k], curve[7 + k]
    rho = math.hypot(x, y)
    if rho <= 1.0:
        return 0.0, (2.0 * math.pi if curve[0] == RIM and z > 0.0 else 0.0)
    middle, half = math.atan2(y, x), math.acos(1.0 / rho)
    return middle - half, middle + half


@inner
def is_slender(curve):  # type: ignore[no-untyped-def]
    """Return whether the axes of a ball differ by more than a tenth."""
    least, most = math.inf, 0.0
    for k in range(4, 13, 3):
        square = curve[k] ** 2 + curve[k + 1] ** 2 + curve[k + 2] ** 2
        least, most = min(least, square), max(most, square)
    return most > 1.2 * least


@inner
def before_rim(curve, lens):  # type: ignore[no-untyped-def]
    """Return whether the lens is before the plane that a rim is the edge of."""
    height = 0.0
    for k in range(3):
        height += (lens[k] - curve[1 + k]) * curve[10 + k]
    return height > 0.0


@inner
def _outline_of_ball(curve, x, y, z, arc):  # type: ignore[no-untyped-def]
    """Fill the circle of a ball's outline as :func:`arc_of` does, with its first axis towards W as far as it can be."""
    square = x * x + y * y + z * z
    if square <= 1.0:
        return 0.0, 0.0
    away, across = math.sqrt(square), math.hypot(x, y)
    radius = math.sqrt(1.0 - 1.0 / square)
    # unit vectors perpendicular to the way to the lens: one in the plane of W and the lens, one beside both
    cos_x, cos_y = (x / across, y / across) if across > 0.0 else (1.0, 0.0)
    up_x, up_y, up_z = -z / away * cos_x, -z / away * cos_y, across / away
    for k in range(3):
        u, v, w = curve[4 + k], curve[7 + k], curve[10 + k]
        arc[0, k] = curve[1 + k] + (x * u + y * v + z * w) / square
        arc[1, k] = radius * (up_x * u + up_y * v + up_z * w)
        arc[2, k] = radius * (-cos_y * u + cos_x * v)
    if curve[0] == BALL:
        return 0.0, 2.0 * math.pi
    # W of the circle's points: z / |c|² + radius · up_z · cos φ
    low, rise = z / square, radius * up_z
    if low >= rise:
        return 0.0, 2.0 * math.pi
    if low <= -rise:
        return 0.0, 0.0
    half = math.acos(-low / rise)
    return -half, half


@inner
def segments_of(span, size_px):  # type: ignore[no-untyped-def]
    """Return how many segments stand for an arc of `span` radians of a curve that is `size_px` in radius."""
    step = math.sqrt(8.0 * _SAGITTA / max(size_px, 1e-9))
    turn = 2.0 * math.pi
    whole = min(max(math.ceil(turn / step), _FEWEST), _MOST)
    return max(math.ceil(whole * span / turn), 1)
