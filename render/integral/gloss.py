"""Response of glossy faces to a lamp at the lens beside their Lambertian light, and the sampling of highlights.

Lamp and lens look along one direction, so that a face's response depends on the angle of incidence θ alone:

    a = [ ρ cos θ + s_r + s N(m) cosᵐ⁺¹ θ ] / r²,    N(m) = (m + 2)(m + 4) / (8 (m + 2^(−m/2)))

The first term is PHYSICS section 3. The second is ideal retroreflecting sheeting: the power that a face receives, which
falls as cos θ, leaves in a cone about the incident ray, where the face looks smaller by cos θ too. The third is
Blinn-Phong's lobe, whose half vector is the ray itself: f = s N / π · cosᵐ θ_h. N makes s the share of light from
straight ahead that the lobe reflects.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phasemark.render.integral.light import landmark_hit
from phasemark.render.kernel import inner, kernel

_PER_BOX, _PER_BOX_OF_LOBE = 0.7, 1.5
"""By how many of the lobe's widths, 1 / √m, the normal may turn over a box: in general, and where several boxes see a
whole lobe, whose integral converges faster."""
_FEW_BOXES, _MOST_BOXES = 3, 48
_DARK = 12.0
"""Exponent e⁻ˣ of the light beside a lobe that need not be resolved."""


def gloss_row(retroreflecting: float, specular: float, shininess: float) -> NDArray[np.float64]:
    """Return s_r, s N(m) and m of a body, (3,)."""
    m = shininess
    strength = (m + 2) * (m + 4) / (8 * (m + 2 ** (-m / 2)))
    return np.array([retroreflecting, specular * strength, m])


@kernel
def count_highlight_boxes(n, samples, mesh, poses, camera, least):  # type: ignore[no-untyped-def]
    """Raise the boxes of pixels in which a lobe is narrow: the normal turns by more than its width from side to side.

    Parameters
    ----------
    n : int
        Samples of one pose.
    samples : Samples
    mesh : MeshTopology
    poses : Poses
    camera : Camera
    least : (rows, cols, 2) int64
        Boxes along u and v of each pixel.
    """
    lens, matrix = poses.lens[0], poses.matrix[0]
    aside = 0.02  # of a pixel: a step of differences
    for k in range(n):
        f = samples.face[k]
        if f < 0 or mesh.gloss[f, 1] == 0.0:
            continue
        y, z, m = samples.rays[k, 0], samples.rays[k, 1], mesh.gloss[f, 2]
        here = _sine(mesh, f, lens, matrix, y, z)
        turn = 0.0
        for side in (-aside, aside):
            across = _sine(mesh, f, lens, matrix, y + side * camera.slope_u, z) - here
            down = _sine(mesh, f, lens, matrix, y, z + side * camera.slope_v) - here
            turn = max(turn, math.hypot(across, down) / aside)
        nearest = here - turn
        if nearest > 0.0 and -0.5 * m * math.log(1.0 - nearest * nearest) > _DARK:
            continue
        widths = turn * math.sqrt(m)
        few = min(math.ceil(widths / _PER_BOX), _FEW_BOXES)
        boxes = int(max(few, min(math.ceil(widths / _PER_BOX_OF_LOBE), _MOST_BOXES)))
        pixel = samples.pixel[k]
        own = least[pixel // camera.cols, pixel % camera.cols]
        own[0], own[1] = max(own[0], boxes), max(own[1], boxes)


@inner
def _sine(mesh, face, lens, matrix, y, z):  # type: ignore[no-untyped-def]
    """Return the sine of the angle of incidence of the ray (1, y, z) on a face."""
    _, facing = landmark_hit(mesh, face, lens, matrix, y, z)
    return math.sqrt(max(1.0 - facing * facing / (1.0 + y * y + z * z), 0.0))
