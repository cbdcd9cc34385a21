"""Change of pixels' light by moving edges: ∫ (f_left − f_right) ẋ ds along each edge (Leibniz's rule)."""

from __future__ import annotations

import math

import numpy as np

from phasemark.render.background import hit_of_plane, nearer_plane
from phasemark.render.integral.arguments import towards_landmark, towards_level
from phasemark.render.integral.face_search import find_face
from phasemark.render.integral.image_rays import ray_of
from phasemark.render.integral.light import landmark_hit, phasor_of
from phasemark.render.kernel import inner, kernel


@kernel
def sum_borders(n, samples, first_of, mesh, poses, camera, light, borders, slope):  # type: ignore[no-untyped-def]
    """Add what the edges sweep to the slopes of the pixels.

    Parameters
    ----------
    n : int
        Number of samples.
    samples : Samples
        With their faces.
    first_of : (m,) int64
        Scratch: the first sample of each interval.
    mesh : MeshTopology
    poses : Poses
    camera : Camera
    light : Light
    borders : Borders
    slope : (pixels, p) complex128, added to
    """
    count, region = 0, -1
    for k in range(n):
        if samples.regions[k] != region:
            region = samples.regions[k]
            first_of[region] = k
            count = region + 1
    first_of[count] = n
    pixels_per_view = (camera.stop_row - camera.first_row) * camera.cols
    on_left, on_right = np.int64(0), np.int64(1)
    same_depth = 1e-4  # relative difference of two depths up to which they are one
    for b in range(borders.placed[0]):
        index = borders.pixel[b]
        view = index // pixels_per_view
        y, z = ray_of(camera, borders.points[b, 0], borders.points[b, 1])
        depth_left, left = _light_beside(b, on_left, y, z, view, samples, first_of, mesh, poses, camera, light, borders)
        depth_right, right = _light_beside(
            b, on_right, y, z, view, samples, first_of, mesh, poses, camera, light, borders
        )
        limit, side = borders.depth[b] * (1.0 - same_depth), borders.side[b]
        if side > 0.0:  # at a limb cos θ of its own surface is 0, and so is its light; hidden, it changes nothing
            jump = left if depth_left > limit else 0j
        elif side < 0.0:
            jump = -right if depth_right > limit else 0j
        else:
            jump = left - right if depth_left > limit or depth_right > limit else 0j
        for k in range(slope.shape[1]):
            slope[index, k] += borders.weights[b] * borders.rates[b, k] * jump


@inner
def _light_beside(b, which, y, z, view, samples, first_of, mesh, poses, camera, light, borders):  # type: ignore[no-untyped-def]
    """Return depth and light of what is seen on one side of an edge; depth is infinite where there is nothing."""
    points, region = samples.points, borders.regions[b, which]
    nearest, least = first_of[region], math.inf
    for k in range(first_of[region], first_of[region + 1]):
        du, dv = points[k, 0] - borders.points[b, 0], points[k, 1] - borders.points[b, 1]
        if du * du + dv * dv < least:
            nearest, least = k, du * du + dv * dv
    face = np.int64(samples.face[nearest])
    length = math.sqrt(1.0 + y * y + z * z)
    lens, matrix = poses.lens[view], poses.matrix[view]
    if face >= 0:
        if not mesh.plain[face]:
            dx, dy, dz = towards_landmark(matrix, y, z)
            g, t = find_face(mesh.search, mesh.grid, face, lens[0], lens[1], lens[2], dx, dy, dz)
            face = g if g >= 0 else face
        t, cos_theta = landmark_hit(mesh, face, lens, matrix, y, z)
        return t, phasor_of(t * length, light.albedo * mesh.albedo[face] * cos_theta, length, light)
    # where wall and floor meet, the point itself is on both: which of them this side sees, its sample tells
    cos_b, sin_b = math.cos(poses.bearing[view]), math.sin(poses.bearing[view])
    own_y, own_z = samples.rays[nearest, 0], samples.rays[nearest, 1]
    dx, dy, dz = towards_level(poses.level[view], own_y, own_z)
    plane = nearer_plane(poses.background[view], cos_b, sin_b, dx, dy, dz)
    dx, dy, dz = towards_level(poses.level[view], y, z)
    t, rho, cos_theta = hit_of_plane(poses.background[view], plane, cos_b, sin_b, dx, dy, dz)
    if t == 0.0:
        return math.inf, 0j
    return t, phasor_of(t * length, rho * cos_theta, length, light)
