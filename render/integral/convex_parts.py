"""Convex parts of solids: where rays enter them, and which edges they hide.

A part lies behind all of its planes and inside its quadric. The space that it hides from the lens is convex too, so
that an edge is hidden where both of its ends are.
"""

from __future__ import annotations

import math

import numpy as np

from phasemark.render.kernel import inner, kernel

_BEHIND = 0.01
"""Share of its way to the lens by which a point must lie behind a part to be hidden by it: edges that end at another
body reach a little into it, for its own edges are chains."""
_BUNDLE = 32
"""Neighbouring rays for which the parts that any of them may meet are listed once."""


@kernel
def enter_parts(mesh, origins, directions, near, found, distance):  # type: ignore[no-untyped-def]
    """Replace the faces that rays met by those of convex parts that are nearer along them.

    Parameters
    ----------
    mesh : MeshTopology
        Its ``parts`` are asked.
    origins, directions : (n, 3) float32
        Neighbours of one origin, with directions of about the same length, take the least time.
    near : (parts,) int32, scratch
    found : (n,) int32, overwritten
    distance : (n,) float64, overwritten
        In lengths of the directions.
    """
    start = 0
    while start < len(origins):
        ox, oy, oz = float(origins[start, 0]), float(origins[start, 1]), float(origins[start, 2])
        stop, x, y, z = start, 0.0, 0.0, 0.0
        while stop < min(start + _BUNDLE, len(origins)) and ox == origins[stop, 0] and oy == origins[stop, 1]:
            if oz != origins[stop, 2]:
                break
            x, y, z = x + directions[stop, 0], y + directions[stop, 1], z + directions[stop, 2]
            stop += 1
        x, y, z, square = x / (stop - start), y / (stop - start), z / (stop - start), 0.0
        for i in range(start, stop):
            dx, dy, dz = directions[i, 0] - x, directions[i, 1] - y, directions[i, 2] - z
            square = max(square, dx * dx + dy * dy + dz * dz)
        count = list_parts(mesh, ox, oy, oz, x, y, z, math.sqrt(square), np.inf, near)
        for i in range(start, stop):
            dx, dy, dz = float(directions[i, 0]), float(directions[i, 1]), float(directions[i, 2])
            for k in range(count):
                part = near[k]
                if _passes(mesh.balls[part], ox, oy, oz, dx, dy, dz):
                    continue
                enters, face = _enter(mesh, part, ox, oy, oz, dx, dy, dz)
                if enters < distance[i]:
                    found[i], distance[i] = face, enters
        start = stop


@inner
def list_parts(mesh, ox, oy, oz, x, y, z, radius, farthest, near):  # type: ignore[no-untyped-def]
    """List the parts that may lie on a ray from a point through a ball.

    Parameters
    ----------
    mesh : MeshTopology
    ox, oy, oz : float
        The point.
    x, y, z, radius : float
        From the point to the middle of the ball, and its radius.
    farthest : float
        Parts that begin farther from the point are left out.
    near : (parts,) int32, overwritten

    Returns
    -------
    int
        How many parts are listed, in the order of their numbers.
    """
    away = x * x + y * y + z * z
    outside = math.sqrt(max(away - radius * radius, 0.0))
    away, count = math.sqrt(away), 0
    for part in range(len(mesh.parts)):
        ball = mesh.balls[part]
        px, py, pz = ball[0] - ox, ball[1] - oy, ball[2] - oz
        square = px * px + py * py + pz * pz
        clear = square - ball[3] * ball[3]
        # cos β ≥ cos (α + γ) of the angle β between the middles, and α and γ that the radii are seen under
        slack = 1e-9 * away * math.sqrt(square)
        seen = x * px + y * py + z * pz + slack >= outside * math.sqrt(max(clear, 0.0)) - radius * ball[3]
        if (seen or radius >= away or clear <= 0.0) and square <= (farthest + ball[3]) * (farthest + ball[3]):
            near[count] = part
            count += 1
    return count


@inner
def is_hidden(mesh, lens, a, b, body, other, near):  # type: ignore[no-untyped-def]
    """Return whether one convex part, not of the two bodies that an edge belongs to, hides both of its ends.

    `near` are the numbers of the parts that may, see :func:`list_parts`.
    """
    ox, oy, oz = lens[0], lens[1], lens[2]
    ax, ay, az = a[0] - ox, a[1] - oy, a[2] - oz
    bx, by, bz = b[0] - ox, b[1] - oy, b[2] - oz
    for part in near:
        owner = mesh.part[mesh.parts[part, 0]]
        if owner == body or owner == other:
            continue
        if _passes(mesh.balls[part], ox, oy, oz, ax, ay, az) or _passes(mesh.balls[part], ox, oy, oz, bx, by, bz):
            continue
        enters, _ = _enter(mesh, part, ox, oy, oz, ax, ay, az)
        if enters < 1.0 - _BEHIND:
            enters, _ = _enter(mesh, part, ox, oy, oz, bx, by, bz)
            if enters < 1.0 - _BEHIND:
                return True
    return False


@kernel
def part_around(mesh, point):  # type: ignore[no-untyped-def]
    """Return the first convex part that a point lies in, −1 where there is none."""
    x, y, z = point[0], point[1], point[2]
    for part in range(len(mesh.parts)):
        inside = True
        for f in range(mesh.parts[part, 0], mesh.parts[part, 1]):
            if mesh.quadric[f] >= 0:
                q = mesh.quadrics[mesh.quadric[f]]
                height = (
                    (q[0] * x + 2.0 * (q[3] * y + q[4] * z + q[6])) * x
                    + (q[1] * y + 2.0 * (q[5] * z + q[7])) * y
                    + (q[2] * z + 2.0 * q[8]) * z
                    + q[9]
                )
            else:
                plane = mesh.planes[f]
                height = plane[0] * x + plane[1] * y + plane[2] * z - plane[3]
            inside = inside and height < 0.0
        if inside:
            return part
    return -1


@inner
def _passes(ball, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return whether a ray passes beside a ball, or has it behind its origin."""
    x, y, z = ball[0] - ox, ball[1] - oy, ball[2] - oz
    along = x * dx + y * dy + z * dz
    outside = x * x + y * y + z * z - ball[3] * ball[3]
    return outside * (dx * dx + dy * dy + dz * dz) > along * abs(along)


@inner
def _enter(mesh, part, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return the multiple of a ray at which it enters a part, inf where it does not, and through which face."""
    enters, leaves, face = -np.inf, np.inf, -1
    for f in range(mesh.parts[part, 0], mesh.parts[part, 1]):
        begin, end = -np.inf, np.inf
        if mesh.quadric[f] >= 0:
            begin, end = _roots(mesh.quadrics[mesh.quadric[f]], ox, oy, oz, dx, dy, dz)
        else:
            plane = mesh.planes[f]
            facing = plane[0] * dx + plane[1] * dy + plane[2] * dz
            height = plane[0] * ox + plane[1] * oy + plane[2] * oz - plane[3]
            if facing < 0.0:
                begin = -height / facing
            elif facing > 0.0:
                end = -height / facing
            elif height > 0.0:
                end = -np.inf
        if begin > enters:
            enters, face = begin, f
        leaves = min(leaves, end)
        if not enters < leaves:
            return np.inf, -1
    return (enters, face) if enters > 0.0 else (np.inf, -1)


@inner
def _roots(q, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return between which multiples a ray is inside a quadric; the first is larger where it is nowhere."""
    gx = q[0] * dx + q[3] * dy + q[4] * dz
    gy = q[3] * dx + q[1] * dy + q[5] * dz
    gz = q[4] * dx + q[5] * dy + q[2] * dz
    hx = q[0] * ox + q[3] * oy + q[4] * oz + q[6]
    hy = q[3] * ox + q[1] * oy + q[5] * oz + q[7]
    hz = q[4] * ox + q[5] * oy + q[2] * oz + q[8]
    a, b = dx * gx + dy * gy + dz * gz, dx * hx + dy * hy + dz * hz
    c = ox * (hx + q[6]) + oy * (hy + q[7]) + oz * (hz + q[8]) + q[9]
    parallel = 1e-14 * (abs(q[0]) + abs(q[1]) + abs(q[2])) * (dx * dx + dy * dy + dz * dz)
    if a <= parallel:  # along a cylinder
        return (-np.inf, np.inf) if c < 0.0 else (np.inf, -np.inf)
    square = b * b - a * c
    if square <= 0.0:
        return np.inf, -np.inf
    root = math.sqrt(square)
    return (-b - root) / a, (-b + root) / a
