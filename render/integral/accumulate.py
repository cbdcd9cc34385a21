"""The area integral: which rays a batch of views needs, and the sum of the phasors they bring back.

Compiled steps with calls of the intersector between them. :func:`plan_rays` fills a buffer with samples of as many
views as fit. One ray an interval scouts what is seen there (:func:`pick_scouts`); where that is a curved surface the
other samples are cast too (:func:`share_faces`). :func:`sum_samples` computes each hit in float64, its amplitude and
phase, and adds it to its pixel.
"""

from __future__ import annotations

import math

import numpy as np

from phasemark.render.background import background_edge, background_hit
from phasemark.render.integral.edge_projection import project_edges
from phasemark.render.integral.footprint import sample_pixel
from phasemark.render.integral.pixel_clipping import bin_segments
from phasemark.render.integral.quadrature_rules import gauss_legendre
from phasemark.render.kernel import inlined, kernel

_NODES, _WEIGHTS = gauss_legendre(4)

SKIPPED = 0
"""Pixel state: no sample can meet the landmark; only the background is seen."""
SPLIT = 1
"""Pixel state: sampled, split exactly."""
UNTRUSTED = 2
"""Pixel state: sampled, but too many edges for an exact split."""


@kernel
def plan_rays(  # type: ignore[no-untyped-def]
    first, mesh, lens, matrix, offset, bearing, camera, level, row_range, splits, background,
    segments, limb, head, link, owner, scratch, points, weights, regions, pixel, state,
):  # fmt: skip
    """Place the samples of as many views as fit into the buffers, from view `first` on.

    Parameters
    ----------
    mesh : MeshTopology
    lens, matrix, offset : (n, 3), (n, 3, 3), (n, 3) float64
        The lens in the landmark frame, and the landmark frame to the tilted camera's.
    bearing : (n,) float64
    camera : (8,) float64
        Scale (2), principal point (2), rows, cols, fill factor (2).
    level : (3, 3) float64
        Tilted to level camera frame.
    row_range : (2,) int64
        First and last-but-one image row to render.
    splits : int
        Boxes a side that every pixel is cut into.
    background : (4,) float64
    segments, limb, head, link, owner, scratch
        Scratch, see :func:`project_edges`, :func:`bin_segments` and :func:`sample_pixel`.
    points, weights, regions, pixel
        The samples: u, v; share of the pixel; interval; view · pixels + pixel.
    state : (n, rows, cols) uint8, overwritten
        Per pixel :data:`SKIPPED`, :data:`SPLIT` or :data:`UNTRUSTED`.

    Returns
    -------
    next_view, n_samples : int, int
        `next_view` equals `first` when not even one view fits; −1 in place of it: `link` is too small.
    """
    scale, centre = camera[:2], camera[2:4]
    rows, cols = int(camera[4]), int(camera[5])
    out_rows = row_range[1] - row_range[0]
    n, region = 0, 0
    for view in range(first, len(lens)):
        n_edges = project_edges(mesh, lens[view], matrix[view], offset[view], scale, centre, segments, limb)
        u_low, u_high, v_low, v_high = np.inf, -np.inf, np.inf, -np.inf
        for i in range(n_edges):
            u_low = min(u_low, segments[i, 0], segments[i, 2])
            u_high = max(u_high, segments[i, 0], segments[i, 2])
            v_low = min(v_low, segments[i, 1], segments[i, 3])
            v_high = max(v_high, segments[i, 1], segments[i, 3])
        bent_low_u, bent_high_u, bent_low_v, bent_high_v = np.inf, -np.inf, np.inf, -np.inf
        for i in range(n_edges):
            if limb[i]:
                bent_low_u = min(bent_low_u, segments[i, 0], segments[i, 2])
                bent_high_u = max(bent_high_u, segments[i, 0], segments[i, 2])
                bent_low_v = min(bent_low_v, segments[i, 1], segments[i, 3])
                bent_high_v = max(bent_high_v, segments[i, 1], segments[i, 3])
        cos_b, sin_b = math.cos(bearing[view]), math.sin(bearing[view])
        if background_edge(background, cos_b, sin_b, level, scale, centre, rows, cols, segments[n_edges]):
            limb[n_edges] = 0
            n_edges += 1
        if bin_segments(segments, n_edges, rows, cols, head, link, owner) < 0:
            return -1, n
        start = n
        for r in range(row_range[0], row_range[1]):
            for c in range(cols):
                outside = c >= u_high or c + 1 <= u_low or r >= v_high or r + 1 <= v_low
                if outside and head[r + 1, c + 1] < 0:
                    state[view, r - row_range[0], c] = SKIPPED
                    continue
                before = n
                bent = c < bent_high_u and c + 1 > bent_low_u and r < bent_high_v and r + 1 > bent_low_v
                n, region, trusted = sample_pixel(
                    r, c, bent, camera[6], camera[7], splits, segments, limb, head, link, owner, scratch,
                    points, weights, regions, n, region,
                )  # fmt: skip
                if n < 0:
                    return view, start
                state[view, r - row_range[0], c] = SPLIT if trusted else UNTRUSTED
                index = (view * out_rows + r - row_range[0]) * cols + c
                for k in range(before, n):
                    pixel[k] = index
    return len(lens), n


@kernel
def pick_scouts(n, regions, chosen):  # type: ignore[no-untyped-def]
    """Choose the middle sample of every interval.

    Samples of an interval lie one behind the other, and all see one smooth patch of the surface: the one in the middle
    tells which. Returns how many indices were written to `chosen`.
    """
    count, start = 0, 0
    for k in range(1, n + 1):
        if k == n or regions[k] != regions[start]:
            chosen[count] = (start + k - 1) // 2
            count += 1
            start = k
    return count


@kernel
def share_faces(n, regions, pixel, state, plain, scout_face, share, face, chosen):  # type: ignore[no-untyped-def]
    """Hand the face a scout met to its interval where that is all there is to know, and list the samples left to cast.

    On a plain patch the plane is the same for all samples, and where the scout met nothing nothing is met. A curved
    patch has a face for each sample. Pixels that could not be split are cast throughout, as is everything without
    `share`.

    Returns how many indices were written to `chosen`.
    """
    count, start, region = 0, 0, 0
    states = state.reshape(-1)
    for k in range(1, n + 1):
        if k < n and regions[k] == regions[start]:
            continue
        scout, found = (start + k - 1) // 2, scout_face[region]
        known = share and states[pixel[start]] == SPLIT and (found < 0 or plain[found])
        for i in range(start, k):
            if known or i == scout:
                face[i] = found
            else:
                chosen[count] = i
                count += 1
        start = k
        region += 1
    return count


@kernel
def aim(n, chosen, points, pixel, lens, matrix, camera, pixels_per_view, origins, directions):  # type: ignore[no-untyped-def]
    """Write the float32 rays of some samples, landmark frame."""
    for i in range(n):
        k = chosen[i]
        view = pixel[k] // pixels_per_view
        y = (camera[2] - points[k, 0]) / camera[0]
        z = (camera[3] - points[k, 1]) / camera[1]
        for a in range(3):
            origins[i, a] = lens[view, a]
            directions[i, a] = matrix[view, 0, a] + matrix[view, 1, a] * y + matrix[view, 2, a] * z


@kernel
def sum_samples(  # type: ignore[no-untyped-def]
    n, points, weights, pixel, face, mesh, lens, matrix, bearing, camera, level, background, albedo,
    radians_per_metre, orders, vignetting, pixels_per_view, phasor, intensity, coverage, upper,
):  # fmt: skip
    """Add the light of each sample to its pixel.

    Parameters
    ----------
    n : int
        Number of samples.
    points, weights, pixel, lens, matrix, bearing, camera, level, background
        As in :func:`plan_rays`.
    face : (n,) int32
        Face met, −1: none.
    mesh : MeshTopology
    albedo : float
    radians_per_metre : float
        4πf / c.
    orders : (k,) int64
        Harmonic orders; the first is 1.
    vignetting : bool
    pixels_per_view : int
    phasor : (pixels, k) complex128, added to
    intensity, coverage, upper : (pixels,) float64, added to
        `upper` is the coverage by the landmark's upper part.
    """
    # arrays taken out of the tuple once: inside the loop each use of it would count references
    vertices, faces, planes = mesh.vertices, mesh.faces, mesh.planes
    corner_shares, corner_normals = mesh.corner_shares, mesh.corner_normals
    flat, part = mesh.flat, mesh.part
    for k in range(n):
        index = pixel[k]
        view = index // pixels_per_view
        m = matrix[view]
        y = (camera[2] - points[k, 0]) / camera[0]
        z = (camera[3] - points[k, 1]) / camera[1]
        length = math.sqrt(1.0 + y * y + z * z)
        f = face[k]
        if f >= 0:
            dx = m[0, 0] + m[1, 0] * y + m[2, 0] * z
            dy = m[0, 1] + m[1, 1] * y + m[2, 1] * z
            dz = m[0, 2] + m[1, 2] * y + m[2, 2] * z
            ox, oy, oz = lens[view, 0], lens[view, 1], lens[view, 2]
            nx, ny, nz, d = planes[f, 0], planes[f, 1], planes[f, 2], planes[f, 3]
            facing = nx * dx + ny * dy + nz * dz
            t = (d - nx * ox - ny * oy - nz * oz) / facing if facing != 0.0 else 0.0
            cos_theta = abs(facing)
            if not (flat[f] and t > 0.0):
                t, cos_theta = _hit_curved(
                    ox, oy, oz, dx, dy, dz, t, facing, f, vertices, faces, corner_shares[f], corner_normals[f]
                )
            cos_theta /= length
            distance = t * length
            a = albedo * cos_theta / (distance * distance)
            coverage[index] += weights[k]
            if part[f]:
                upper[index] += weights[k]
        else:
            dx = level[0, 0] + level[0, 1] * y + level[0, 2] * z
            dy = level[1, 0] + level[1, 1] * y + level[1, 2] * z
            dz = level[2, 0] + level[2, 1] * y + level[2, 2] * z
            t, rho, cos_theta = background_hit(background, math.cos(bearing[view]), math.sin(bearing[view]), dx, dy, dz)
            if t == 0.0:
                continue
            distance = t * length
            a = rho * cos_theta / length / (distance * distance)
        if vignetting:
            a /= length * length * length * length
        a *= weights[k]
        intensity[index] += a
        for j in range(len(orders)):
            phase = radians_per_metre * distance * orders[j]
            phasor[index, j] += complex(a * math.cos(phase), a * math.sin(phase))


@inlined
def _hit_curved(ox, oy, oz, dx, dy, dz, t, facing, f, vertices, faces, shares, normals):  # type: ignore[no-untyped-def]
    """Return the multiple of the ray at its hit, and |cos θ| of the shading normal times the ray's length.

    `t` is the multiple at the face's plane, `facing` the product of the face's normal with the ray; `shares` and
    `normals` are the face's rows of ``corner_shares`` and ``corner_normals``.
    """
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
def add_background(  # type: ignore[no-untyped-def]
    start, stop, state, bearing, camera, level, row_range, background, radians_per_metre, orders, vignetting,
    phasor, intensity,
):  # fmt: skip
    """Integrate the background over the skipped pixels of views `start` to `stop`, 4 × 4 Gauss points each."""
    cols = state.shape[2]
    for view in range(start, stop):
        cos_b, sin_b = math.cos(bearing[view]), math.sin(bearing[view])
        for r in range(state.shape[1]):
            for c in range(cols):
                if state[view, r, c] != SKIPPED:
                    continue
                index = (view * state.shape[1] + r) * cols + c
                for i in range(4):
                    v = r + row_range[0] + 0.5 + camera[7] * (_NODES[i] - 0.5)
                    z = (camera[3] - v) / camera[1]
                    for j in range(4):
                        u = c + 0.5 + camera[6] * (_NODES[j] - 0.5)
                        y = (camera[2] - u) / camera[0]
                        length = math.sqrt(1.0 + y * y + z * z)
                        dx = level[0, 0] + level[0, 1] * y + level[0, 2] * z
                        dy = level[1, 0] + level[1, 1] * y + level[1, 2] * z
                        dz = level[2, 0] + level[2, 1] * y + level[2, 2] * z
                        t, rho, cos_theta = background_hit(background, cos_b, sin_b, dx, dy, dz)
                        if t == 0.0:
                            continue
                        distance = t * length
                        a = _WEIGHTS[i] * _WEIGHTS[j]
                        a *= rho * cos_theta / length / (distance * distance)
                        if vignetting:
                            a /= length * length * length * length
                        intensity[index] += a
                        for k in range(len(orders)):
                            phase = radians_per_metre * distance * orders[k]
                            phasor[index, k] += complex(a * math.cos(phase), a * math.sin(phase))
