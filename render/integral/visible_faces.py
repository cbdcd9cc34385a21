"""Visible face of each sample: one ray an interval is cast, the others are found on its patch or cast too.

One ray an interval scouts what is seen there (:func:`pick_scouts`). On a plane patch that is all there is to know. On a
curved one each of the other samples has a face of its own (:func:`share_faces`). On a patch that bulges everywhere, or
has an apex, the face is looked for; elsewhere, and where it is not found, the ray of the sample is cast (:func:`aim`).
"""

from __future__ import annotations

import numpy as np

from phasemark.render.integral.arguments import towards_landmark
from phasemark.render.integral.face_search import find_face, look_about, plane_hit, turns_smoothly
from phasemark.render.integral.ray_plan import SPLIT
from phasemark.render.kernel import inlined, inner, kernel


@kernel
def pick_scouts(n, samples):  # type: ignore[no-untyped-def]
    """Choose one sample of every interval; return how many indices were written to ``samples.chosen``.

    Samples of an interval all see one smooth patch of the surface: one tells which.
    """
    regions, chosen = samples.regions, samples.chosen
    count, start = 0, np.int64(0)
    for k in range(1, n + 1):
        if k == n or regions[k] != regions[start]:
            chosen[count] = _scout(start, k, samples.weights)
            count += 1
            start = np.int64(k)
    return count


@inner
def _scout(start, stop, weights):  # type: ignore[no-untyped-def]
    """Return the sample with the largest weight, the middle one if it is among those.

    A sample beside an edge may see what lies beyond: a chain of links leaves its curve by a little, and an edge in
    float64 leaves a ray in float32. Where an interval is widest, and far from limbs, weights are largest.
    """
    best = (start + stop - 1) // 2
    for k in range(start, stop):
        if weights[k] > weights[best]:
            best = k
    return best


@kernel
def share_faces(n, mesh, scout_face, samples, poses, camera, state):  # type: ignore[no-untyped-def]
    """Assign the face of a scout ray to its interval where it sees no other, and list the samples left to cast.

    On a plain patch the plane is the same for all samples, and where the scout met nothing nothing is met. On a
    searched patch each sample's face is looked for from the scout's, and on any other curved patch it is cast.
    Pixels that could not be split are cast throughout, as is a surface without ``split``.

    Returns how many indices were written to ``samples.chosen``.
    """
    regions, pixel, face, chosen = samples.regions, samples.pixel, samples.face, samples.chosen
    count, start, region = np.int64(0), np.int64(0), 0
    states = state.reshape(-1)
    for k in range(1, n + 1):
        if k < n and regions[k] == regions[start]:
            continue
        scout, found = _scout(start, k, samples.weights), scout_face[region]
        known = mesh.split and states[pixel[start]] == SPLIT
        face[scout] = found
        if known and (found < 0 or mesh.plain[found]):
            for i in range(start, k):
                face[i] = found
        elif known and mesh.searched[found]:
            count = _search(start, k, scout, count, mesh, samples, poses, camera)
        else:
            for i in range(start, k):
                if i != scout:
                    chosen[count] = i
                    count += 1
        start = np.int64(k)
        region += 1
    return count


@inlined
def _search(start, stop, scout, count, mesh, samples, poses, camera):  # type: ignore[no-untyped-def]
    """Find the faces of the samples of a curved patch, beginning with the scout's; list what is not found.

    All samples take one step, then all the next: none waits for another, so that the processor works at several.
    """
    rays, face, search, grid = samples.rays, samples.face, mesh.search, mesh.grid
    view = samples.pixel[scout] // ((camera.stop_row - camera.first_row) * camera.cols)
    ox, oy, oz = poses.lens[view, 0], poses.lens[view, 1], poses.lens[view, 2]
    matrix, found = poses.matrix[view], face[scout]
    looks = 2  # into the grid, for each sample, before its face is searched for step by step
    for look in range(looks):
        for i in range(start, stop):
            y, z = rays[i, 0], rays[i, 1]
            dx, dy, dz = towards_landmark(matrix, y, z)
            face[i] = look_about(search, grid, face[i] if look else found, ox, oy, oz, dx, dy, dz)
    face[scout] = found
    y, z = rays[scout, 0], rays[scout, 1]
    dx, dy, dz = towards_landmark(matrix, y, z)
    t = plane_hit(search, found, ox, oy, oz, dx, dy, dz)
    hit_x, hit_y, hit_z = t * dx, t * dy, t * dz
    for i in range(start, stop):
        if i == scout:
            continue
        y, z = rays[i, 0], rays[i, 1]
        dx, dy, dz = towards_landmark(matrix, y, z)
        g, t = find_face(search, grid, face[i], ox, oy, oz, dx, dy, dz)
        if g >= 0 and turns_smoothly(search, found, g, t * dx - hit_x, t * dy - hit_y, t * dz - hit_z):
            face[i] = g
        else:
            samples.chosen[count] = i
            count += 1
    return count


@kernel
def aim(n, samples, poses, camera):  # type: ignore[no-untyped-def]
    """Write the float32 rays of the first n samples that were chosen, landmark frame."""
    rays, origins, directions = samples.rays, samples.origins, samples.directions
    pixels_per_view = (camera.stop_row - camera.first_row) * camera.cols
    for i in range(n):
        k = samples.chosen[i]
        view = samples.pixel[k] // pixels_per_view
        y, z = rays[k, 0], rays[k, 1]
        for a in range(3):
            origins[i, a] = poses.lens[view, a]
        directions[i, 0], directions[i, 1], directions[i, 2] = towards_landmark(poses.matrix[view], y, z)
