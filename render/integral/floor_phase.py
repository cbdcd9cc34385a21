"""Phase of the background within a pixel: a floor seen at a slant needs more points than a rule has.

At a single slow frequency behind an ideal lens the rules are left as they are.
"""

from __future__ import annotations

import math

from phasemark.render.background import background_hit
from phasemark.render.integral.arguments import towards_level
from phasemark.render.integral.image_rays import ray_of
from phasemark.render.kernel import inner

_DARK = 2e-6
"""Amplitude, 1 being albedo 1 facing at 1 m, below which the phase of a pixel does not matter."""


@inner
def parts_of_pixel(r, c, background, fastest, cos_b, sin_b, level, camera):  # type: ignore[no-untyped-def]
    """Return into how many parts along u and along v a pixel is to be cut for the sake of the background's phase.

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
        return 1, 1
    upper_left, a = _corner(float(c), float(r), background, cos_b, sin_b, level, camera)
    upper_right, b = _corner(c + 1.0, float(r), background, cos_b, sin_b, level, camera)
    lower_left, d = _corner(float(c), r + 1.0, background, cos_b, sin_b, level, camera)
    lower_right, e = _corner(c + 1.0, r + 1.0, background, cos_b, sin_b, level, camera)
    if max(a, b, d, e) < _DARK:
        return 1, 1
    along_u = max(_recedes(upper_left, upper_right), _recedes(lower_left, lower_right))
    along_v = max(_recedes(upper_left, lower_left), _recedes(upper_right, lower_right))
    return _parts(fastest * along_u), _parts(fastest * along_v)


@inner
def _corner(u, v, background, cos_b, sin_b, level, camera):  # type: ignore[no-untyped-def]
    """Return how far the background behind an image point is, inf where there is none, and its amplitude."""
    y, z = ray_of(camera, u, v)
    dx, dy, dz = towards_level(level, y, z)
    t, albedo, facing = background_hit(background, cos_b, sin_b, dx, dy, dz)
    if t == 0.0:
        return math.inf, 0.0
    length = math.sqrt(1.0 + y * y + z * z)
    distance = t * length
    return distance, albedo * facing / (length * distance * distance)


@inner
def _recedes(one, other):  # type: ignore[no-untyped-def]
    """Return how much the range changes between two points, as far as the light is worth it.

    Amplitudes fall with the third power of the range, so beyond twice the range little is left.
    """
    near = min(one, other)
    return min(abs(other - one), near) if near < math.inf else 0.0


@inner
def _parts(turn):  # type: ignore[no-untyped-def]
    """Return how many parts a turn of the phase takes."""
    per_part_rad = 1.0  # turn of the phase that two Gauss points a side integrate
    most_parts = 32.0
    return int(max(math.ceil(min(turn / per_part_rad, most_parts)), 1))
