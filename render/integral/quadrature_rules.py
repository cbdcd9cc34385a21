"""Gauss points on an interval of an image line, also beside the limb of a curved surface.

Beside a limb cos θ falls like the square root of the distance x to it, where plain Gauss points converge badly. There
the points are placed in s with x = s², or, between two limbs, in τ with x = c + w sin τ; both make the integrand smooth
again.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phasemark.render.kernel import inner

_THIN = 0.07
"""Intervals narrower than this share of their box get one Gauss point."""
_BESIDE_LIMB = (0.1, 0.6)
"""Intervals beside a limb get two Gauss points, or three, or four where they are wider than this (pixels)."""
FELT = 1.5
"""A limb shapes the surface up to this far (pixels)."""


def gauss_legendre(n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return nodes and weights of the n-point Gauss-Legendre rule on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    return 0.5 + 0.5 * nodes, 0.5 * weights


G2X, G2W = gauss_legendre(2)
G3X, G3W = gauss_legendre(3)
G4X, G4W = gauss_legendre(4)
G5X, G5W = gauss_legendre(5)
MOST_POINTS = 16
GMX, GMW = gauss_legendre(MOST_POINTS)


@inner
def place_points(a, b, left, right, side, bent, slender, points, weights):  # type: ignore[no-untyped-def]
    """Place Gauss points on one interval [a, b], with limbs at `left` and `right` (∓inf: none).

    `side` is the width of the box in which the interval lies.
    Column 0 of `points` gets the places, `weights` weights that add up to one; returns their number.
    """
    near_left, near_right = a - left < FELT, right - b < FELT
    middle, half = 0.0, 0.0
    count = 2 + (b - a > _BESIDE_LIMB[0]) + (b - a > _BESIDE_LIMB[1])
    # intervals wider than this share of their box get three Gauss points on a curved surface, the others two
    wide = 0.3
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
        count = 1 if b - a < _THIN * side else (3 if bent and b - a > wide * side else 2)
        t0, t1 = a, b
    if slender and (near_left or near_right):
        count = MOST_POINTS
    total = 0.0
    for g in range(count):
        if count == 1:
            t, w = 0.5 * (t0 + t1), 1.0
        elif count == 2:
            t, w = t0 + G2X[g] * (t1 - t0), G2W[g]
        elif count == 3:
            t, w = t0 + G3X[g] * (t1 - t0), G3W[g]
        elif count == 4:
            t, w = t0 + G4X[g] * (t1 - t0), G4W[g]
        elif count == 5:
            t, w = t0 + G5X[g] * (t1 - t0), G5W[g]
        else:
            t, w = t0 + GMX[g] * (t1 - t0), GMW[g]
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
