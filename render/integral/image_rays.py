"""Rays of image points: those of the ideal lens in one step, those of a lens with distortion by Newton's method.

The starting point is interpolated between rays that are computed once for each pixel, so that one or two steps do.
"""

from __future__ import annotations

import math

from phasemark.render.kernel import inner, kernel
from phasemark.render.sensor import lens_map

_CLOSE = 1e-7
"""Step of Newton's method (tangent) after which no other is needed: it squares the error."""
_MOST_STEPS = 8

distort = kernel(lens_map.distort)
"""Return where a lens moves normalised coordinates; see :func:`phasemark.render.sensor.lens_map.distort`."""


@kernel
def ray_of(camera, u, v):  # type: ignore[no-untyped-def]
    """Return y and z of the ray (1, y, z) of an image point, frame of the tilted camera."""
    if camera.distortion.model == 0:
        return (camera.centre_u - u) * camera.slope_u, (camera.centre_v - v) * camera.slope_v
    return _bent_ray(camera, u, v)


@kernel
def trace(first, stop, samples, camera):  # type: ignore[no-untyped-def]
    """Write the rays of samples ``first`` to ``stop``.

    Parameters
    ----------
    first, stop : int
    samples : Samples
        ``points`` are read, ``rays`` are overwritten.
    camera : Camera
    """
    points, rays = samples.points, samples.rays
    if camera.distortion.model == 0:
        for k in range(first, stop):
            rays[k, 0] = (camera.centre_u - points[k, 0]) * camera.slope_u
            rays[k, 1] = (camera.centre_v - points[k, 1]) * camera.slope_v
        return
    for k in range(first, stop):
        rays[k, 0], rays[k, 1] = _bent_ray(camera, points[k, 0], points[k, 1])


@inner
def _bent_ray(camera, u, v):  # type: ignore[no-untyped-def]
    """Return the ray of an image point of a camera with distortion."""
    lens = camera.distortion
    c = min(max(math.floor(u), 0), camera.cols - 1)
    r = min(max(math.floor(v), 0), camera.rows - 1)
    a, b = 2.0 * (u - c) - 1.0, 2.0 * (v - r) - 1.0
    y, z = 0.0, 0.0
    for i in range(3):
        row = 0.5 * b * (b - 1.0) if i == 0 else (1.0 - b * b if i == 1 else 0.5 * b * (b + 1.0))
        for j in range(3):
            col = 0.5 * a * (a - 1.0) if j == 0 else (1.0 - a * a if j == 1 else 0.5 * a * (a + 1.0))
            y += row * col * lens.nodes[2 * r + i, 2 * c + j, 0]
            z += row * col * lens.nodes[2 * r + i, 2 * c + j, 1]
    x_d, y_d = (u - camera.centre_u) * camera.slope_u, (v - camera.centre_v) * camera.slope_v
    for _ in range(_MOST_STEPS):
        own_x, own_y, xx, xy, yy = distort(lens.model, lens.coefficients, -y, -z)
        scale = 1.0 / (xx * yy - xy * xy)
        dx = (yy * (x_d - own_x) - xy * (y_d - own_y)) * scale
        dy = (xx * (y_d - own_y) - xy * (x_d - own_x)) * scale
        y -= dx
        z -= dy
        if abs(dx) + abs(dy) < _CLOSE:
            break
    return y, z


@inner
def image_of(camera, y, z):  # type: ignore[no-untyped-def]
    """Return where the ray (1, y, z) of a camera with distortion meets the image: u, v."""
    x_d, y_d, _, _, _ = distort(camera.distortion.model, camera.distortion.coefficients, -y, -z)
    return camera.centre_u + camera.scale_u * x_d, camera.centre_v + camera.scale_v * y_d


@inner
def rates_of(camera, y, z):  # type: ignore[no-untyped-def]
    """Return how the ray of an image point changes along the image, with distortion: ∂y/∂u, ∂z/∂u, ∂y/∂v, ∂z/∂v."""
    _, _, xx, xy, yy = distort(camera.distortion.model, camera.distortion.coefficients, -y, -z)
    scale = 1.0 / (xx * yy - xy * xy)
    along_u, along_v = scale * camera.slope_u, scale * camera.slope_v
    return -yy * along_u, xy * along_u, xy * along_v, -xx * along_v
