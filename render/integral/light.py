"""What comes back: the hit of each sample in float64, its amplitude and phase, added to its pixel."""

from __future__ import annotations

import math

from phasemark.render.background import background_hit
from phasemark.render.integral.arguments import ray_of, towards_landmark, towards_level
from phasemark.render.integral.quadrature_rules import G4W, G4X
from phasemark.render.integral.ray_plan import SKIPPED
from phasemark.render.kernel import inlined, kernel


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
    points, weights = samples.points, samples.weights
    pixels_per_view = (camera.stop_row - camera.first_row) * camera.cols
    for k in range(n):
        index = samples.pixel[k]
        view = index // pixels_per_view
        y, z = ray_of(camera, points[k, 0], points[k, 1])
        length = math.sqrt(1.0 + y * y + z * z)
        face = samples.face[k]
        if face >= 0:
            t, cos_theta = landmark_hit(mesh, face, poses.lens[view], poses.matrix[view], y, z)
            reflected = light.albedo * (cos_theta / length)
            sums.coverage[index] += weights[k]
            if mesh.part[face]:
                sums.upper[index] += weights[k]
        else:
            dx, dy, dz = towards_level(camera.level, y, z)
            bearing = poses.bearing[view]
            t, rho, cos_theta = background_hit(light.background, math.cos(bearing), math.sin(bearing), dx, dy, dz)
            if t == 0.0:
                continue
            reflected = rho * cos_theta / length
        _add_phasor(index, t * length, reflected, length, weights[k], light, sums)


@inlined
def _add_phasor(index, distance, reflected, length, weight, light, sums):  # type: ignore[no-untyped-def]
    """Add the light of one hit to a pixel; `reflected` is ρ cos θ, `length` that of the ray (1, y, z)."""
    a = reflected / (distance * distance)
    if light.vignetting:
        a /= length * length * length * length
    a *= weight
    sums.intensity[index] += a
    for j in range(len(light.orders)):
        phase = light.radians_per_metre * distance * light.orders[j]
        sums.phasor[index, j] += complex(a * math.cos(phase), a * math.sin(phase))


@inlined
def phasor_of(distance, reflected, length, light):  # type: ignore[no-untyped-def]
    """Return the light of one hit at the modulation frequency; arguments as :func:`_add_phasor` takes them."""
    a = reflected / (distance * distance)
    if light.vignetting:
        a /= length * length * length * length
    phase = light.radians_per_metre * distance
    return complex(a * math.cos(phase), a * math.sin(phase))


@inlined
def landmark_hit(mesh, face, lens, matrix, y, z):  # type: ignore[no-untyped-def]
    """Return the multiple of the ray (1, y, z) at its hit, and |cos θ| there times the ray's length."""
    dx, dy, dz = towards_landmark(matrix, y, z)
    ox, oy, oz = lens[0], lens[1], lens[2]
    nx, ny, nz, d = mesh.planes[face, 0], mesh.planes[face, 1], mesh.planes[face, 2], mesh.planes[face, 3]
    facing = nx * dx + ny * dy + nz * dz
    t = (d - nx * ox - ny * oy - nz * oz) / facing if facing != 0.0 else 0.0
    cos_theta = abs(facing)
    if not (mesh.flat[face] and t > 0.0):
        t, cos_theta = _curved_hit(mesh, face, ox, oy, oz, dx, dy, dz, t, facing)
    return t, cos_theta


@inlined
def _curved_hit(mesh, f, ox, oy, oz, dx, dy, dz, t, facing):  # type: ignore[no-untyped-def]
    """Return the multiple of the ray at its hit, and |cos θ| of the shading normal times the ray's length.

    `t` is the multiple at the face's plane, `facing` the product of the face's normal with the ray.
    """
    vertices, faces = mesh.vertices, mesh.faces
    shares, normals = mesh.corner_shares[f], mesh.corner_normals[f]
    px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
    # barycentric coordinates in the plane of the face
    v = min(max(shares[0, 0] * px + shares[0, 1] * py + shares[0, 2] * pz + shares[0, 3], 0.0), 1.0)
    w = min(max(shares[1, 0] * px + shares[1, 1] * py + shares[1, 2] * pz + shares[1, 3], 0.0), 1.0 - v)
    u = 1.0 - v - w
    # a face seen edge-on leaves the plane's intersection ill-conditioned: take the nearest point of the face instead
    if abs(facing) < 1e-6 * math.sqrt(dx * dx + dy * dy + dz * dz):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        px = u * vertices[a, 0] + v * vertices[b, 0] + w * vertices[c, 0]
        py = u * vertices[a, 1] + v * vertices[b, 1] + w * vertices[c, 1]
        pz = u * vertices[a, 2] + v * vertices[b, 2] + w * vertices[c, 2]
        along = (px - ox) * dx + (py - oy) * dy + (pz - oz) * dz
        t = along / (dx * dx + dy * dy + dz * dz)
    nx = u * normals[0, 0] + v * normals[1, 0] + w * normals[2, 0]
    ny = u * normals[0, 1] + v * normals[1, 1] + w * normals[2, 1]
    nz = u * normals[0, 2] + v * normals[1, 2] + w * normals[2, 2]
    towards = nx * dx + ny * dy + nz * dz
    size = math.sqrt(nx * nx + ny * ny + nz * nz)
    if size == 0.0:  # at the very apex
        return t, abs(facing)
    # the interpolated normal may lean past the ray at the very limb, where nothing comes back
    cos_theta = towards / size if facing > 0.0 else -towards / size
    return t, max(cos_theta, 0.0)


@kernel
def add_background(start, stop, poses, camera, light, sums):  # type: ignore[no-untyped-def]
    """Integrate the background over the skipped pixels of views `start` to `stop`, 4 × 4 Gauss points each."""
    rows, cols = camera.stop_row - camera.first_row, camera.cols
    for view in range(start, stop):
        cos_b, sin_b = math.cos(poses.bearing[view]), math.sin(poses.bearing[view])
        for r in range(rows):
            for c in range(cols):
                if sums.state[view, r, c] != SKIPPED:
                    continue
                index = (view * rows + r) * cols + c
                for i in range(4):
                    v = r + camera.first_row + 0.5 + camera.fill_v * (G4X[i] - 0.5)
                    for j in range(4):
                        u = c + 0.5 + camera.fill_u * (G4X[j] - 0.5)
                        y, z = ray_of(camera, u, v)
                        length = math.sqrt(1.0 + y * y + z * z)
                        dx, dy, dz = towards_level(camera.level, y, z)
                        t, rho, cos_theta = background_hit(light.background, cos_b, sin_b, dx, dy, dz)
                        if t == 0.0:
                            continue
                        weight = G4W[i] * G4W[j]
                        _add_phasor(index, t * length, rho * cos_theta / length, length, weight, light, sums)
