"""Amplitude that each pixel of a depth image returns: cos θ / r², with normals given or from neighbours.

On a plane the inverse depth w = 1 / z is linear in the tangents x, y of a ray, and its slopes give the normal exactly:
n ∝ (∂w/∂x, ∂w/∂y, w − x ∂w/∂x − y ∂w/∂y). Second differences of w vanish on planes and are large across a step, so the
side with the smallest one lies on the pixel's own surface.
"""

from __future__ import annotations

import math

from phasemark.render.kernel import inner, kernel


@kernel
def fill_amplitudes(inverse_m, x, y, step, out):  # type: ignore[no-untyped-def]
    """Fill cos θ / r² of each pixel, with normals from neighbours.

    Parameters
    ----------
    inverse_m : (H, W) float64
        1 / z; NaN where nothing returns.
    x, y : (W,), (H,) float64
        Tangents of the columns to the right and of the rows downwards.
    step : int
        Distance of neighbours, pixels: 1, or 2 for those of an image of half the resolution.
    out : (H, W) float64
        0 where nothing returns.
    """
    rows, cols = inverse_m.shape
    width, height = step * abs(x[1] - x[0]), step * abs(y[1] - y[0])
    for i in range(rows):
        for j in range(cols):
            w = inverse_m[i, j]
            if math.isnan(w):
                out[i, j] = 0.0
                continue
            a = inverse_m[i, j - 2 * step] if j >= 2 * step else math.nan
            b = inverse_m[i, j - step] if j >= step else math.nan
            d = inverse_m[i, j + step] if j + step < cols else math.nan
            e = inverse_m[i, j + 2 * step] if j + 2 * step < cols else math.nan
            along_x = _slope(a, b, w, d, e, width) / width
            a = inverse_m[i - 2 * step, j] if i >= 2 * step else math.nan
            b = inverse_m[i - step, j] if i >= step else math.nan
            d = inverse_m[i + step, j] if i + step < rows else math.nan
            e = inverse_m[i + 2 * step, j] if i + 2 * step < rows else math.nan
            along_y = _slope(a, b, w, d, e, height) / height
            along_z = w - x[j] * along_x - y[i] * along_y
            length2 = 1.0 + x[j] * x[j] + y[i] * y[i]
            normal2 = along_x * along_x + along_y * along_y + along_z * along_z
            out[i, j] = w * w * w / (length2 * math.sqrt(normal2 * length2))


@inner
def _slope(a, b, c, d, e, width):  # type: ignore[no-untyped-def]
    """Return by how much c changes to the next of five values, from those on its own side of a step.

    A value that is not there is NaN, which no comparison chooses.
    """
    steepest = 6.0  # slope of a surface seen at 80°: an object of one pixel is taken to face the camera
    centred = 0.5  # by how much central differences are preferred: their error is half of the others'
    left, right = c - b, d - c
    slope, least = 0.0, math.inf
    if left * right < 0.0:
        least = steepest * width * c
    cost = centred * abs(right - left)
    if cost < least:
        slope, least = 0.5 * (left + right), cost
    cost = abs(left - (b - a))
    if cost < least:
        slope, least = _one_sided(left, b - a), cost
    cost = abs(e - d - right)
    if cost < least:
        slope, least = _one_sided(right, e - d), cost
    if abs(left) < least:
        slope, least = left, abs(left)
    if abs(right) < least:
        slope = right
    return slope


@inner
def _one_sided(near, far):  # type: ignore[no-untyped-def]
    """Return the slope at the first of three values, from the differences to the second and of that to the third.

    near · (1 + t / 2 + …) with t = 1 − far / near; further terms are those of a square root, as beside a silhouette.
    """
    if near == 0.0:
        return -0.5 * far
    t = 1.0 - far / near
    curved, farthest = 0.7, 0.45  # what changes by more is no silhouette; within a few hundredths of a pixel of one
    if t > curved:
        return near
    t = min(t, farthest)
    return near * (1.0 + t / (2.0 - 3.6 * t))
