"""Returned light: the hit of each sample in float64, its amplitude and phase, added to its pixel."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phasemark.render.background import background_hit
from phasemark.render.integral.arguments import towards_landmark, towards_level
from phasemark.render.integral.circular import turn
from phasemark.render.integral.face_search import plane_hit
from phasemark.render.integral.image_rays import ray_of
from phasemark.render.integral.quadrature_rules import G3W, G3X, G4W, G4X
from phasemark.render.integral.ray_plan import SKIPPED
from phasemark.render.kernel import inlined, inner, kernel

_MOST_BOXES = 64


@kernel
def sum_samples(n, samples, mesh, poses, camera, light, sums):  # type: ignore[no-untyped-def]
    """Add the light of each sample to its pixel.

    Parameters
    ----------
    n : int
        Number of samples.
    samples : Samples
    mesh : MeshTopology
    poses : Poses
    camera : Camera
    light : Light
    sums : Sums
        All but ``state`` is added to.
    """
    block = len(samples.returns.phase)
    for start in range(0, n, block):
        stop = min(start + block, n)
        _hit_samples(start, stop, samples, mesh, poses, camera, light, sums)
        for j in range(len(light.orders)):
            _add_order(j, start, stop, samples, light, sums)


@inlined
def _hit_samples(start, stop, samples, mesh, poses, camera, light, sums):  # type: ignore[no-untyped-def]
    """Write the returns of some samples, and add them to intensity and coverage."""
    rays, weights, returns = samples.rays, samples.weights, samples.returns
    pixels_per_view = (camera.stop_row - camera.first_row) * camera.cols
    index, view, intensity, coverage = samples.pixel[start], 0, 0.0, 0.0
    for k in range(start, stop):
        if k == start or samples.pixel[k] != index:
            if k > start:
                sums.intensity[index], sums.coverage[index] = intensity, coverage
            index = samples.pixel[k]
            view = index // pixels_per_view
            intensity, coverage = sums.intensity[index], sums.coverage[index]
        y, z = rays[k, 0], rays[k, 1]
        length = math.sqrt(1.0 + y * y + z * z)
        face = samples.face[k]
        if face >= 0:
            t, reflected = landmark_hit(mesh, face, poses.lens[view], poses.matrix[view], y, z)
            reflected = reflected_by(mesh, face, light.albedo, reflected, length)
            coverage += weights[k]
            sums.shares[index, mesh.part[face]] += weights[k]
        elif poses.background[view, 0] > 0.0 or poses.background[view, 1] > 0.0:
            dx, dy, dz = towards_level(poses.level[view], y, z)
            cos_b, sin_b = math.cos(poses.bearing[view]), math.sin(poses.bearing[view])
            t, rho, cos_theta = background_hit(poses.background[view], cos_b, sin_b, dx, dy, dz)
            reflected = rho * cos_theta
        else:
            t, reflected = 0.0, 0.0
        distance = t * length
        a = weights[k] * _amplitude(distance, reflected, length, light) if t != 0.0 else 0.0
        intensity += a
        returns.amplitude[k - start], returns.phase[k - start] = a, light.radians_per_metre * distance
    sums.intensity[index], sums.coverage[index] = intensity, coverage


@inner
def reflected_by(mesh, face, albedo, facing, length):  # type: ignore[no-untyped-def]
    """Return the response of a face times the length of the ray; `facing` is cos θ times that length.

    ρ cos θ, and on glossy faces s_r + s N cosᵐ⁺¹ θ beside it, see :mod:`~phasemark.render.integral.gloss`.
    """
    lambertian = facing * (albedo * mesh.albedo[face])
    if len(mesh.gloss) == 0:
        return lambertian
    gloss = mesh.gloss[face]
    return lambertian + albedo * length * (gloss[0] + gloss[1] * (facing / length) ** (gloss[2] + 1.0))


@inner
def _add_order(j, start, stop, samples, light, sums):  # type: ignore[no-untyped-def]
    """Add the returns of some samples to the phasor of the j-th order."""
    returns, pixel = samples.returns, samples.pixel
    turn(stop - start, light.orders[j], returns.phase, returns.amplitude, returns.real, returns.imaginary)
    index, total = pixel[start], sums.phasor[pixel[start], j]
    for k in range(start, stop):
        if pixel[k] != index:
            sums.phasor[index, j] = total
            index = pixel[k]
            total = sums.phasor[index, j]
        total += complex(returns.real[k - start], returns.imaginary[k - start])
    sums.phasor[index, j] = total


@inner
def _amplitude(distance, reflected, length, light):  # type: ignore[no-untyped-def]
    """Return the amplitude of a hit; `length` is that of the ray (1, y, z), `reflected` ρ cos θ times that length."""
    a = reflected / (length * distance * distance)
    if len(light.lamp) > 0:
        a *= _lamp_intensity(light.lamp, light.lamp_step, length)
    return a / (length * length * length * length) if light.vignetting else a


@inner
def _lamp_intensity(lamp, step, length):  # type: ignore[no-untyped-def]
    """Return the lamp's intensity along a ray (1, y, z), whose length is given, from its table over the tangent."""
    at = min(math.sqrt(max(length * length - 1.0, 0.0)) / step, len(lamp) - 1.0)
    k = min(int(at), len(lamp) - 2)
    return lamp[k] + (at - k) * (lamp[k + 1] - lamp[k])


@inner
def _add_phasor(index, distance, reflected, length, weight, light, sums):  # type: ignore[no-untyped-def]
    """Add the light of one hit to a pixel; see :func:`_amplitude`."""
    a = weight * _amplitude(distance, reflected, length, light)
    sums.intensity[index] += a
    for j in range(len(light.orders)):
        phase = light.radians_per_metre * distance * light.orders[j]
        sums.phasor[index, j] += complex(a * math.cos(phase), a * math.sin(phase))


@inner
def phasor_of(distance, reflected, length, light):  # type: ignore[no-untyped-def]
    """Return the light of one hit at the modulation frequency; see :func:`_amplitude`."""
    a = _amplitude(distance, reflected, length, light)
    phase = light.radians_per_metre * distance
    return complex(a * math.cos(phase), a * math.sin(phase))


@inner
def landmark_hit(mesh, face, lens, matrix, y, z):  # type: ignore[no-untyped-def]
    """Return the multiple of the ray (1, y, z) at its hit, and |cos θ| there times the ray's length."""
    dx, dy, dz = towards_landmark(matrix, y, z)
    ox, oy, oz = lens[0], lens[1], lens[2]
    if mesh.quadric[face] >= 0:
        return _quadric_hit(mesh, face, ox, oy, oz, dx, dy, dz)
    if not mesh.flat[face]:
        return _curved_hit(mesh, face, ox, oy, oz, dx, dy, dz)
    nx, ny, nz, d = mesh.planes[face, 0], mesh.planes[face, 1], mesh.planes[face, 2], mesh.planes[face, 3]
    facing = nx * dx + ny * dy + nz * dz
    t = (d - nx * ox - ny * oy - nz * oz) / facing if facing != 0.0 else 0.0
    if t > 0.0:
        return t, abs(facing)
    return _curved_hit(mesh, face, ox, oy, oz, dx, dy, dz)


@inner
def _quadric_hit(mesh, f, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return the multiple of the ray at its hit with the face's quadric, and |cos θ| there times the ray's length.

    An outline is a chain that reaches a little beyond that of the quadric; a ray that misses it there grazes it. The
    hit of a facet is whichever is nearer to it; the face of a solid has no plane, and is hit where the ray enters.
    """
    q, own = mesh.quadrics[mesh.quadric[f]], mesh.planes[f]
    gx = q[0] * dx + q[3] * dy + q[4] * dz
    gy = q[3] * dx + q[1] * dy + q[5] * dz
    gz = q[4] * dx + q[5] * dy + q[2] * dz
    hx = q[0] * ox + q[3] * oy + q[4] * oz + q[6]
    hy = q[3] * ox + q[1] * oy + q[5] * oz + q[7]
    hz = q[4] * ox + q[5] * oy + q[2] * oz + q[8]
    a, b = dx * gx + dy * gy + dz * gz, dx * hx + dy * hy + dz * hz
    c = ox * (hx + q[6]) + oy * (hy + q[7]) + oz * (hz + q[8]) + q[9]
    facing = own[0] * dx + own[1] * dy + own[2] * dz
    if a <= 0.0:  # along the axis of a cylinder
        return _curved_hit(mesh, f, ox, oy, oz, dx, dy, dz) if facing != 0.0 else (0.0, 0.0)
    root = math.sqrt(max(b * b - a * c, 0.0))
    on_face = (own[3] - own[0] * ox - own[1] * oy - own[2] * oz) / facing if facing != 0.0 else 0.0
    t = (-b - root) / a if a * on_face < -b else (-b + root) / a
    nx, ny, nz = hx + t * gx, hy + t * gy, hz + t * gz
    size = math.sqrt(nx * nx + ny * ny + nz * nz)
    return t, root / size


@inner
def _curved_hit(mesh, f, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return the multiple of the ray at its hit, and |cos θ| of the shading normal times the ray's length.

    What is asked of a face stands in two lines of the cache; in float32 its plane is good to 1e-7 m.
    """
    vertices, faces = mesh.vertices, mesh.faces
    own, normals = mesh.search[f], mesh.corner_normals[f]
    facing = own[0] * dx + own[1] * dy + own[2] * dz
    t = plane_hit(mesh.search, f, ox, oy, oz, dx, dy, dz)
    px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
    # barycentric coordinates in the plane of the face
    v = min(max(own[4] * px + own[5] * py + own[6] * pz + own[7], 0.0), 1.0)
    w = min(max(own[8] * px + own[9] * py + own[10] * pz + own[11], 0.0), 1.0 - v)
    u = 1.0 - v - w
    # a face seen edge-on leaves the plane's intersection ill-conditioned: take the nearest point of the face instead
    if abs(facing) < 1e-6 * math.sqrt(dx * dx + dy * dy + dz * dz):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        px = u * vertices[a, 0] + v * vertices[b, 0] + w * vertices[c, 0]
        py = u * vertices[a, 1] + v * vertices[b, 1] + w * vertices[c, 1]
        pz = u * vertices[a, 2] + v * vertices[b, 2] + w * vertices[c, 2]
        along = (px - ox) * dx + (py - oy) * dy + (pz - oz) * dz
        t = along / (dx * dx + dy * dy + dz * dz)
    nx = u * normals[0] + v * normals[3] + w * normals[6]
    ny = u * normals[1] + v * normals[4] + w * normals[7]
    nz = u * normals[2] + v * normals[5] + w * normals[8]
    towards = nx * dx + ny * dy + nz * dz
    size = math.sqrt(nx * nx + ny * ny + nz * nz)
    if size == 0.0:  # at the very apex
        return t, abs(facing)
    # the interpolated normal may lean past the ray at the very limb, where nothing comes back
    cos_theta = towards / size if facing > 0.0 else -towards / size
    return t, max(cos_theta, 0.0)


@inner
def _range_of_background(u, v, background, cos_b, sin_b, level, camera):  # type: ignore[no-untyped-def]
    """Return the range of what stands behind an image point, 0 for nothing."""
    y, z = ray_of(camera, u, v)
    dx, dy, dz = towards_level(level, y, z)
    t, _, _ = background_hit(background, cos_b, sin_b, dx, dy, dz)
    return t * math.sqrt(1.0 + y * y + z * z)


@inner
def _boxes(c, r, width, height, background, cos_b, sin_b, level, camera, fastest):  # type: ignore[no-untyped-def]
    """Return into how many boxes a pixel is cut along its width or height, for its fastest phase to turn little."""
    u, v, half_u, half_v = c + 0.5, r + 0.5, 0.5 * width, 0.5 * height
    near = _range_of_background(u - half_u, v - half_v, background, cos_b, sin_b, level, camera)
    far = _range_of_background(u + half_u, v + half_v, background, cos_b, sin_b, level, camera)
    if near == 0.0 and far == 0.0:
        return 1
    if near == 0.0 or far == 0.0:
        return _MOST_BOXES
    # how far the fastest phase turns along a box of 4 × 4 Gauss points: the error is some 1e-6 of its light
    radians_per_box = 2.0
    return int(min(max(math.ceil(abs(far - near) * fastest / radians_per_box), 1.0), _MOST_BOXES))


@inner
def _boxes_of_width(tangent):  # type: ignore[no-untyped-def]
    """Return into how many boxes of 4 × 4 Gauss points a pixel is cut for the sake of its width."""
    widest = 0.5  # three points a side would leave 1e-5 of the light
    return max(math.ceil(tangent / widest), 1)


@inner
def _add_boxes(index, c, r, n_u, n_v, background, cos_b, sin_b, level, camera, light, sums):  # type: ignore[no-untyped-def]
    """Integrate the background over one pixel, cut into boxes."""
    for i in range(4 * n_v):
        v = r + 0.5 + camera.fill_v * ((i // 4 + G4X[i % 4]) / n_v - 0.5)
        for j in range(4 * n_u):
            u = c + 0.5 + camera.fill_u * ((j // 4 + G4X[j % 4]) / n_u - 0.5)
            y, z = ray_of(camera, u, v)
            length = math.sqrt(1.0 + y * y + z * z)
            dx, dy, dz = towards_level(level, y, z)
            t, rho, cos_theta = background_hit(background, cos_b, sin_b, dx, dy, dz)
            if t != 0.0:
                weight = G4W[i % 4] * G4W[j % 4] / (n_u * n_v)
                _add_phasor(index, t * length, rho * cos_theta, length, weight, light, sums)


def points_a_side(background: NDArray[np.float64]) -> tuple[int, ...]:
    """Return how many Gauss points a side :func:`add_background` takes of some backgrounds, (n, 4); fewest first."""
    floor = background[:, 1] > 0.0
    return (3,) * bool((~floor & (background[:, 0] > 0.0)).any()) + (4,) * bool(floor.any())


@kernel
def add_background(start, stop, poses, camera, light, sums):  # type: ignore[no-untyped-def]
    """Integrate the background over the skipped pixels of views `start` to `stop`.

    A wall takes 3 × 3 Gauss points a pixel. A floor, whose range changes fast towards the horizon, takes 4 × 4. Where
    the highest of several modulation frequencies turns fast along a pixel, or pixels are wide, the pixel is cut into
    boxes of 4 × 4.
    """
    rows, cols = camera.stop_row - camera.first_row, camera.cols
    least_u, least_v = _boxes_of_width(camera.fill_u * camera.slope_u), _boxes_of_width(camera.fill_v * camera.slope_v)
    rule, bent_lens = camera.distortion.rule, camera.distortion.model != 0
    for view in range(start, stop):
        cos_b, sin_b = math.cos(poses.bearing[view]), math.sin(poses.bearing[view])
        level, background = poses.level[view], poses.background[view]
        if background[0] == 0.0 and background[1] == 0.0:
            continue
        order = 4 if background[1] > 0.0 else 3
        first = rule.shape[2] - 16 if order == 4 else 0
        for r in range(rows):
            for c in range(cols):
                if sums.state[view, r, c] != SKIPPED:
                    continue
                index = (view * rows + r) * cols + c
                if light.fastest > 0.0:
                    row, fastest = r + camera.first_row, light.fastest
                    n_v = _boxes(c, row, 0.0, camera.fill_v, background, cos_b, sin_b, level, camera, fastest)
                    n_u = _boxes(c, row, camera.fill_u, 0.0, background, cos_b, sin_b, level, camera, fastest)
                    n_u, n_v = max(n_u, least_u), max(n_v, least_v)
                    if n_u * n_v > 1:
                        _add_boxes(index, c, row, n_u, n_v, background, cos_b, sin_b, level, camera, light, sums)
                        continue
                for i in range(order):
                    at = G4X[i] if order == 4 else G3X[i]
                    v = r + camera.first_row + 0.5 + camera.fill_v * (at - 0.5)
                    for j in range(order):
                        at = G4X[j] if order == 4 else G3X[j]
                        u = c + 0.5 + camera.fill_u * (at - 0.5)
                        if bent_lens:
                            ray = rule[r + camera.first_row, c, first + i * order + j]
                            y, z = ray[0], ray[1]
                        else:
                            y, z = ray_of(camera, u, v)
                        length = math.sqrt(1.0 + y * y + z * z)
                        dx, dy, dz = towards_level(level, y, z)
                        t, rho, cos_theta = background_hit(background, cos_b, sin_b, dx, dy, dz)
                        if t == 0.0:
                            continue
                        weight = G4W[i] * G4W[j] if order == 4 else G3W[i] * G3W[j]
                        _add_phasor(index, t * length, rho * cos_theta, length, weight, light, sums)
