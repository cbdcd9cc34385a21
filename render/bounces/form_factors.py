"""Form factors: which share of the light that a small surface receives comes from a triangle, in closed form."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phasemark.render.kernel import inner, kernel


def triangle_form_factors(
    points: NDArray[np.float64], normals: NDArray[np.float64], triangles: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the form factors of triangles from points, with nothing between them.

    Parameters
    ----------
    points, normals : (n, 3) float64
    triangles : (n, 3, 3) float64
        Corners, counter-clockwise where the light leaves; a triangle seen from behind gives 0.

    Returns
    -------
    (n,) float64
        cos θ cos θ' / (π d²) integrated over each triangle.
    """
    out = np.empty(len(points))
    _fill(points, normals, np.ascontiguousarray(triangles), out)
    return out


@kernel
def _fill(points, normals, triangles, out):  # type: ignore[no-untyped-def]
    for k in range(len(out)):
        out[k] = triangle_form_factor(points[k], normals[k], triangles[k], 1.0)


@inner
def triangle_form_factor(point, normal, triangle, side):  # type: ignore[no-untyped-def]
    """Return the form factor of one triangle by Lambert's formula; `side` −1: light leaves its back.

    With β the angle that an edge a → b subtends at the point, and n the normal there, it is
    1/2π · Σ β n · (a × b) / |a × b|. What lies below the horizon of the point is cut off.
    """
    px, py, pz = point[0], point[1], point[2]
    nx, ny, nz = normal[0], normal[1], normal[2]
    total, enters, leaves = 0.0, False, False
    ex = ey = ez = lx = ly = lz = 0.0
    for k in range(3):
        other = k + 1 if k < 2 else 0
        ax, ay, az = triangle[k, 0] - px, triangle[k, 1] - py, triangle[k, 2] - pz
        bx, by, bz = triangle[other, 0] - px, triangle[other, 1] - py, triangle[other, 2] - pz
        high_a, high_b = ax * nx + ay * ny + az * nz, bx * nx + by * ny + bz * nz
        if high_a <= 0.0 and high_b <= 0.0:
            continue
        if high_a <= 0.0 or high_b <= 0.0:
            share = high_a / (high_a - high_b)
            hx, hy, hz = ax + share * (bx - ax), ay + share * (by - ay), az + share * (bz - az)
            if high_a <= 0.0:
                ax, ay, az, ex, ey, ez, enters = hx, hy, hz, hx, hy, hz, True
            else:
                bx, by, bz, lx, ly, lz, leaves = hx, hy, hz, hx, hy, hz, True
        total += _edge_term(ax, ay, az, bx, by, bz, nx, ny, nz)
    if enters and leaves:
        total += _edge_term(lx, ly, lz, ex, ey, ez, nx, ny, nz)
    # corners that are counter-clockwise where the light leaves are clockwise about the way to them
    return max(-side * total, 0.0) / (2.0 * math.pi)


@inner
def _edge_term(ax, ay, az, bx, by, bz, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Return the angle that an edge subtends times the cosine between the normal of its plane and n."""
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = math.sqrt(cx * cx + cy * cy + cz * cz)
    if length == 0.0:
        return 0.0
    return math.atan2(length, ax * bx + ay * by + az * bz) * (cx * nx + cy * ny + cz * nz) / length
