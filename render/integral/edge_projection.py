"""Projected edges: creases and silhouettes of a mesh, at which the integrand is not smooth.

Inside a pixel the light a surface returns is a smooth function of (u, v) except across the images of creases (faces
that meet at more than 30°, borders of open meshes) and of silhouettes (an edge between a face seen from its front and
one seen from its back). :class:`~phasemark.render.integral.mesh_topology.MeshTopology` finds what does not depend on
the view; :func:`project_edges` selects and projects what a view shows.

A lens with distortion bends the image of an edge: it becomes a chain of links, see
:mod:`~phasemark.render.integral.bent_edges`.
"""

from __future__ import annotations

import math

import numpy as np

from phasemark.render.integral.arguments import HIDDEN_LIMB, SLENDER
from phasemark.render.integral.bent_edges import FULL, TANGENTS, add_bent_edge, start_extents
from phasemark.render.integral.convex_parts import is_hidden, list_parts
from phasemark.render.integral.round_edges import BALL, RIM, TUBE, arc_of, before_rim, is_slender, segments_of
from phasemark.render.kernel import inner


@inner
def project_edges(mesh, poses, view, camera, edges):  # type: ignore[no-untyped-def]
    """Project the creases and silhouettes of one view.

    A fold is a silhouette where the lens lies before one of its faces and behind the other. Both faces' planes pass
    through the fold, so the lens is then no further from either than their normals' difference times its distance from
    the fold; that leaves few faces to look at, and few clusters of faces.

    Parameters
    ----------
    mesh : MeshTopology
    poses : Poses
    view : int
        Which of the poses.
    camera : Camera
    edges : Edges
        ``segments``, ``limb``, ``ends`` and ``extent`` are overwritten.

    Returns
    -------
    int
        How many segments were written, or :data:`~phasemark.render.integral.bent_edges.FULL`.
    """
    vertices, creases, concave, folds = mesh.vertices, mesh.creases, mesh.concave, mesh.folds
    smooth_planes, clusters = mesh.smooth_planes, mesh.clusters
    lens, matrix, offset = poses.lens[view], poses.matrix[view], poses.offset[view]
    n, crease, limb = np.int64(0), np.int64(0), np.int64(1)
    start_extents(edges)
    every = edges.near[: len(mesh.parts)]
    for part in range(len(every)):
        every[part] = part
    for e in range(len(creases)):
        start, end, face, other = np.int64(creases[e, 0]), np.int64(creases[e, 1]), creases[e, 2], creases[e, 3]
        # a closed shell hides what turns its back, and a valley from everywhere but between its slopes
        if mesh.closed[face]:
            before = _is_before(mesh, face, start, lens) or _is_before(mesh, face, end, lens)
            before_other = _is_before(mesh, other, start, lens) or _is_before(mesh, other, end, lens)
            if not (before or before_other) or (concave[e] and not (before and before_other)):
                continue
        body, beside = np.int64(mesh.part[face]), np.int64(mesh.part[other if other >= 0 else face])
        if is_hidden(mesh, lens, vertices[start], vertices[end], body, beside, every):
            continue
        n = _add_edge(vertices, start, end, crease, matrix, offset, camera, edges, n)
        if n < 0:
            return FULL
    heights = edges.heights
    for c in range(len(clusters)):
        px, py, pz, nx, ny, nz, d, turn, slack, reach, radius, begin, size = clusters[c]
        dx, dy, dz = lens[0] - px, lens[1] - py, lens[2] - pz
        away = math.sqrt(dx * dx + dy * dy + dz * dz)
        farthest = away + radius
        if abs(nx * dx + ny * dy + nz * dz - d) > turn * away + slack + reach * farthest:
            continue
        first, count = int(begin), int(size)
        for i in range(count):  # in vector instructions
            heights[i] = _smooth_height(smooth_planes, first + i, lens)
        for i in range(count):
            if abs(heights[i]) > smooth_planes[4, first + i] * farthest:
                continue
            before = heights[i] > 0.0
            for e in range(mesh.first_fold[first + i], mesh.first_fold[first + i + 1]):
                if before == (_smooth_height(smooth_planes, np.int64(folds[e, 2]), lens) > 0.0):
                    continue
                a, b = np.int64(folds[e, 0]), np.int64(folds[e, 1])
                if not before:
                    a, b = b, a
                begin_of_fold = n
                n = _add_edge(vertices, a, b, limb, matrix, offset, camera, edges, n)
                if n < 0:
                    return FULL
                if smooth_planes[5, first + i] >= 0.0:
                    for k in range(begin_of_fold, n):
                        edges.body[k] = 2 * SLENDER + np.int64(smooth_planes[5, first + i])
    for c in range(len(mesh.curves)):
        stop = _add_curve(mesh, mesh.curves[c], lens, matrix, offset, camera, edges, n)
        if stop < 0:
            return FULL
        n = _seen(n, stop, edges)
    return n


@inner
def _seen(first, stop, edges):  # type: ignore[no-untyped-def]
    """Return where the segments of a curve stop, or their first where all of them are hidden."""
    for k in range(first, stop):
        if edges.limb[k] != HIDDEN_LIMB:
            return stop
    return first


@inner
def _add_curve(mesh, curve, lens, matrix, offset, camera, edges, n):  # type: ignore[no-untyped-def]
    """Append what is seen of a round edge; return how many segments there are, or :data:`FULL`."""
    arc = edges.arc
    begin, end = arc_of(curve, lens, arc)
    if begin == end:
        return n
    near, body = edges.near[: _list_before(mesh, curve, lens, edges.near)], np.int64(curve[13])
    if curve[0] == TUBE:
        for angle in (begin, end):
            for k in range(3):
                across = math.cos(angle) * arc[1, k] + math.sin(angle) * arc[2, k]
                edges.points[0, k] = arc[0, k] + across - curve[10 + k]
                edges.points[1, k] = arc[0, k] + across + curve[10 + k]
            left = _turns_left(edges.points, arc, lens)
            n = _add_segment(mesh, lens, body, np.int64(1), left, near, matrix, offset, camera, edges, n)
            if n < 0:
                return FULL
        return n
    first = n
    n = _add_arc(mesh, begin, end, body, curve[0] >= BALL, lens, near, matrix, offset, camera, edges, n)
    if curve[0] == BALL and is_slender(curve):
        for k in range(first, n):
            edges.body[k] += SLENDER
    whole = 2.0 * math.pi
    if curve[0] == RIM and n >= 0 and end - begin < whole and before_rim(curve, lens):
        n = _add_arc(mesh, end, begin + whole, body, np.bool_(False), lens, near, matrix, offset, camera, edges, n)
    return n


@inner
def _list_before(mesh, curve, lens, near):  # type: ignore[no-untyped-def]
    """List the convex parts that may hide some of a round edge in `near`; return how many there are."""
    square_u, square_v, square_w, away = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        square_u, square_v = square_u + curve[4 + k] ** 2, square_v + curve[7 + k] ** 2
        square_w, away = square_w + curve[10 + k] ** 2, away + (curve[1 + k] - lens[k]) ** 2
    radius = math.sqrt(max(square_u, square_v) + (square_w if curve[0] == TUBE else 0.0))
    x, y, z = curve[1] - lens[0], curve[2] - lens[1], curve[3] - lens[2]
    return list_parts(mesh, lens[0], lens[1], lens[2], x, y, z, radius, math.sqrt(away) + radius, near)


@inner
def _add_arc(mesh, begin, end, body, is_limb, lens, near, matrix, offset, camera, edges, n):  # type: ignore[no-untyped-def]
    """Append an arc of the ellipse at hand as a chain that has its area and its ends."""
    arc, points = edges.arc, edges.points
    away, first, second = 0.0, 0.0, 0.0
    for k in range(3):
        away += (arc[0, k] - lens[k]) ** 2
        first, second = first + arc[1, k] ** 2, second + arc[2, k] ** 2
    size = math.sqrt(max(first, second))
    count = segments_of(end - begin, camera.scale_u * size / max(math.sqrt(away) - size, 1e-3 * size))
    step = (end - begin) / count
    whole = end - begin >= 2.0 * math.pi
    stretch = math.sqrt(step / math.sin(step)) if step < 1.0 else 1.0
    left = False
    for i in range(count + 1):
        angle = begin + i * step
        own = stretch if whole or 0 < i < count else 1.0
        for k in range(3):
            points[0, k] = points[1, k]
            points[1, k] = arc[0, k] + own * (math.cos(angle) * arc[1, k] + math.sin(angle) * arc[2, k])
        if i == 0:
            continue
        if i == 1:
            left = _turns_left(points, arc, lens)
        n = _add_segment(mesh, lens, body, np.int64(is_limb), left, near, matrix, offset, camera, edges, n)
        if n < 0:
            return FULL
    return n


@inner
def _turns_left(points, arc, lens):  # type: ignore[no-untyped-def]
    """Return whether the centre of an ellipse lies on the left of the way from one point to the other, as seen."""
    ax, ay, az = points[0, 0] - lens[0], points[0, 1] - lens[1], points[0, 2] - lens[2]
    bx, by, bz = points[1, 0] - lens[0], points[1, 1] - lens[1], points[1, 2] - lens[2]
    cx, cy, cz = arc[0, 0] - lens[0], arc[0, 1] - lens[1], arc[0, 2] - lens[2]
    return (ay * bz - az * by) * cx + (az * bx - ax * bz) * cy + (ax * by - ay * bx) * cz > 0.0


@inner
def _add_segment(mesh, lens, body, limb, left, near, matrix, offset, camera, edges, n):  # type: ignore[no-untyped-def]
    """Append a segment of a round edge, whose surface is on its left or on its right."""
    if is_hidden(mesh, lens, edges.points[0], edges.points[1], body, body, near):
        if limb == 0:
            return n
        limb = np.int64(HIDDEN_LIMB)
    spare = 2  # for the background, and for one more
    if n + spare > len(edges.segments):
        return FULL
    a, b = (np.int64(1), np.int64(0)) if left else (np.int64(0), np.int64(1))
    before = n
    n = _add_edge(edges.points, a, b, limb, matrix, offset, camera, edges, n)
    for k in range(before, n):
        edges.ends[k, 0], edges.body[k] = -1, body
    return n


@inner
def _add_edge(vertices, a, b, limb, matrix, offset, camera, edges, n):  # type: ignore[no-untyped-def]
    """Append the image of the edge between two vertices; return how many segments there are."""
    if camera.distortion.model != 0:
        line = edges.line
        if project(vertices, a, b, matrix, offset, TANGENTS, line):
            n = add_bent_edge(line[0], line[1], line[2], line[3], a, b, limb, camera, edges, n)
    elif project(vertices, a, b, matrix, offset, camera, edges.segments[n]):
        edges.limb[n], edges.body[n] = limb, -1
        edges.ends[n, 0], edges.ends[n, 1] = a, b
        n += 1
    return n


@inner
def _is_before(mesh, f, vertex, lens):  # type: ignore[no-untyped-def]
    """Return whether the lens is before the front of a face, a round one at the vertex."""
    planes, x, y, z = mesh.planes, lens[0], lens[1], lens[2]
    if mesh.quadric[f] < 0:
        return planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z - planes[f, 3] > 0.0
    q, p = mesh.quadrics[mesh.quadric[f]], mesh.vertices[vertex]
    nx = q[0] * p[0] + q[3] * p[1] + q[4] * p[2] + q[6]
    ny = q[3] * p[0] + q[1] * p[1] + q[5] * p[2] + q[7]
    nz = q[4] * p[0] + q[5] * p[1] + q[2] * p[2] + q[8]
    return nx * (x - p[0]) + ny * (y - p[1]) + nz * (z - p[2]) > 0.0


@inner
def _smooth_height(planes, i, lens):  # type: ignore[no-untyped-def]
    """Return the same for a smooth face; `planes` has a row for each number, not for each face."""
    return planes[0, i] * lens[0] + planes[1, i] * lens[1] + planes[2, i] * lens[2] - planes[3, i]


@inner
def project(vertices, a, b, matrix, offset, camera, segment):  # type: ignore[no-untyped-def]
    """Project the edge between two vertices into `segment` (4,); return whether any of it lies before the camera.

    `camera` is one without distortion, or :data:`~phasemark.render.integral.bent_edges.TANGENTS`.
    """
    ax = matrix[0, 0] * vertices[a, 0] + matrix[0, 1] * vertices[a, 1] + matrix[0, 2] * vertices[a, 2] + offset[0]
    bx = matrix[0, 0] * vertices[b, 0] + matrix[0, 1] * vertices[b, 1] + matrix[0, 2] * vertices[b, 2] + offset[0]
    near_m = 1e-6
    if ax < near_m and bx < near_m:
        return 0
    ay = matrix[1, 0] * vertices[a, 0] + matrix[1, 1] * vertices[a, 1] + matrix[1, 2] * vertices[a, 2] + offset[1]
    by = matrix[1, 0] * vertices[b, 0] + matrix[1, 1] * vertices[b, 1] + matrix[1, 2] * vertices[b, 2] + offset[1]
    az = matrix[2, 0] * vertices[a, 0] + matrix[2, 1] * vertices[a, 1] + matrix[2, 2] * vertices[a, 2] + offset[2]
    bz = matrix[2, 0] * vertices[b, 0] + matrix[2, 1] * vertices[b, 1] + matrix[2, 2] * vertices[b, 2] + offset[2]
    if ax < near_m:
        w = (near_m - ax) / (bx - ax)
        ax, ay, az = near_m, ay + w * (by - ay), az + w * (bz - az)
    elif bx < near_m:
        w = (near_m - bx) / (ax - bx)
        bx, by, bz = near_m, by + w * (ay - by), bz + w * (az - bz)
    segment[0] = camera.centre_u - camera.scale_u * ay / ax
    segment[1] = camera.centre_v - camera.scale_v * az / ax
    segment[2] = camera.centre_u - camera.scale_u * by / bx
    segment[3] = camera.centre_v - camera.scale_v * bz / bx
    return 1
