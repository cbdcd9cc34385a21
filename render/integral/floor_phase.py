"""Phase of the background within a pixel: a floor seen at a slant needs more points than a rule has.

At a single frequency behind an ideal lens the rules are left as they are.
"""

from __future__ import annotations

import math

from phasemark.render.background import background_hit
from phasemark.render.integral.arguments import towards_level
from phasemark.render.integral.image_rays import ray_of
from phasemark.render.kernel import kernel

_PER_PART_RAD = 1.5
"""Turn of the phase that two Gauss points a side integrate."""
_MOST_PARTS = 8.0
_DARK = 2e-6
"""Amplitude, 1 being albedo 1 facing at 1 m, below which the phase of a pixel does not matter."""


@kernel
def parts_of_pixel(r, c, background, fastest, cos_b, sin_b, level, camera):  # type: ignore[no-untyped-def]
    """Return into how many parts a side a pixel is to be cut for the sake of the background's phase.

    Parameters
    ----------
    r, c : int
    background : (4,) float64
    fastest : float
        As :class:`~phasemark.render.integral.arguments.Light` has it.
    cos_b, sin_b : float
        Of the bearing.
    level : (3, 3) float64
        Tilted to level camera frame.
    camera : Camera
    """
    if fastest == 0.0 or background[1] == 0.0:
        return 1
    least, most, brightest, misses = math.inf, 0.0, 0.0, False
    for k in range(4):
        y, z = ray_of(camera, float(c + k % 2), float(r + k // 2))
        dx, dy, dz = towards_level(level, y, z)
        t, albedo, facing = background_hit(background, cos_b, sin_b, dx, dy, dz)
        if t == 0.0:
            misses = True
            continue
        length = math.sqrt(1.0 + y * y + z * z)
        distance = t * length
        least, most = min(least, distance), max(most, distance)
        brightest = max(brightest, albedo * facing / (length * distance * distance))
    if brightest < _DARK:
        return 1
    if misses:  # the horizon crosses the pixel: amplitudes fall with the third power of the distance
        most = 2.0 * least
    # clamped before the conversion: a ray along the floor meets it at any distance
    return max(math.ceil(min(fastest * (most - least) / _PER_PART_RAD, _MOST_PARTS)), 1)
