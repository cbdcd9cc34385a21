"""Speed of edges in the image while a parameter of the view changes.

An edge is one of the mesh, held: at a limb, the fold that makes it does not change. Its speed is that of its place x
on a line of fixed s, not along its normal. Behind a lens with distortion the edge is followed in tangents, where it
is straight, and the lens's own derivatives tell what that is along the image.
"""

from __future__ import annotations

import math

from phasemark.render.background import background_edge, background_line
from phasemark.render.integral.bent_edges import TANGENTS
from phasemark.render.integral.edge_projection import project
from phasemark.render.integral.image_rays import rates_of, ray_of
from phasemark.render.kernel import inner, kernel


@kernel
def follow_borders(mesh, motion, poses, camera, borders):  # type: ignore[no-untyped-def]
    """Fill depth and rates of borders; behind a lens with distortion do it with :func:`follow_bent_borders`.

    Parameters
    ----------
    mesh : MeshTopology
    motion : Motion
    poses : Poses
        Those that the borders' pixels count.
    camera : Camera
    borders : Borders
    """
    moved, step, shifted = motion.poses, motion.step, motion.segments
    p, pixels = len(step), (camera.stop_row - camera.first_row) * camera.cols
    depth_a, depth_b, last_view, last_start, last_end = 0.0, 0.0, -1, -2, -2
    for b in range(min(borders.placed[0], len(borders.weights))):
        view, start, end = borders.pixel[b] // pixels, borders.ends[b, 0], borders.ends[b, 1]
        if view != last_view or start != last_start or end != last_end:
            last_view, last_start, last_end = view, start, end
            for k in range(p + 1):
                pose = view * (p + 1) + k
                if start < 0:
                    bearing, behind = moved.bearing[pose], poses.background[view]
                    background_edge(behind, math.cos(bearing), math.sin(bearing), moved.level[pose], camera, shifted[k])
                else:
                    project(mesh.vertices, start, end, moved.matrix[pose], moved.offset[pose], camera, shifted[k])
            if start >= 0:
                depth_a, depth_b = _depth(mesh, moved, view * (p + 1), start), _depth(mesh, moved, view * (p + 1), end)
        along_v = borders.along_v[b] == 1
        s = borders.points[b, 1 if along_v else 0]
        here = _crossing(shifted[0], s, along_v)
        for k in range(p):
            borders.rates[b, k] = (_crossing(shifted[k + 1], s, along_v) - here) / step[k]
        borders.depth[b] = 0.0
        if start >= 0 and depth_a > 0.0 and depth_b > 0.0:
            borders.depth[b] = _depth_on(shifted[0], borders.points[b, 0], borders.points[b, 1], depth_a, depth_b)


@kernel
def follow_bent_borders(mesh, motion, poses, camera, borders):  # type: ignore[no-untyped-def]
    """Do the same behind a lens with distortion.

    With φ the distance of a fixed ray from the edge, in tangents, the edge is where φ = 0. Along the normal m of a link
    it moves by −φ̇ / (∇φ · m), and the link along x by that over m_x: weights are lengths along the link, not the curve.
    """
    moved, step, shifted = motion.poses, motion.step, motion.segments
    p, pixels = len(step), (camera.stop_row - camera.first_row) * camera.cols
    depth_a, depth_b, last_view, last_start, last_end = 0.0, 0.0, -1, -2, -2
    for b in range(min(borders.placed[0], len(borders.weights))):
        view, start, end = borders.pixel[b] // pixels, borders.ends[b, 0], borders.ends[b, 1]
        if view != last_view or start != last_start or end != last_end:
            last_view, last_start, last_end = view, start, end
            for k in range(p + 1):
                pose = view * (p + 1) + k
                if start < 0:
                    bearing, behind = moved.bearing[pose], poses.background[view]
                    tx, ty, tz = background_line(behind, math.cos(bearing), math.sin(bearing), moved.level[pose])
                    size = math.sqrt(ty * ty + tz * tz)
                    shifted[k, 0], shifted[k, 1], shifted[k, 2] = tx / size, ty / size, tz / size
                else:
                    project(mesh.vertices, start, end, moved.matrix[pose], moved.offset[pose], TANGENTS, shifted[k])
            if start >= 0:
                depth_a, depth_b = _depth(mesh, moved, view * (p + 1), start), _depth(mesh, moved, view * (p + 1), end)
        y, z = ray_of(camera, borders.points[b, 0], borders.points[b, 1])
        y_u, z_u, y_v, z_v = rates_of(camera, y, z)
        here, along_u = _distance(shifted[0], start < 0, y, z, y_u, z_u)
        _, along_v = _distance(shifted[0], start < 0, y, z, y_v, z_v)
        du, dv = borders.along[b, 0], borders.along[b, 1]
        across = dv if borders.along_v[b] == 1 else -du
        along_x = (along_u * dv - along_v * du) * across / (du * du + dv * dv)
        for k in range(p):
            away, _ = _distance(shifted[k + 1], start < 0, y, z, y_u, z_u)
            borders.rates[b, k] = (here - away) / (step[k] * along_x) if along_x != 0.0 else 0.0
        borders.depth[b] = 0.0
        if start >= 0 and depth_a > 0.0 and depth_b > 0.0:
            borders.depth[b] = _depth_on(shifted[0], y, z, depth_a, depth_b)


@inner
def _depth_on(line, x, y, depth_a, depth_b):  # type: ignore[no-untyped-def]
    """Return the depth of an edge beside a point, from the depths of its ends."""
    dx, dy = line[2] - line[0], line[3] - line[1]
    share = ((x - line[0]) * dx + (y - line[1]) * dy) / (dx * dx + dy * dy)
    share = min(max(share, 0.0), 1.0)
    return 1.0 / ((1.0 - share) / depth_a + share / depth_b)


@inner
def _distance(line, by_normal, y, z, y_s, z_s):  # type: ignore[no-untyped-def]
    """Return how far a ray lies from a line, in tangents, and how fast that changes along a way through the image.

    The line is given by its ends, or by (d, n_y, n_z) with d + n_y · y + n_z · z = 0.
    """
    if by_normal:
        away, along = line[0] + line[1] * y + line[2] * z, line[1] * y_s + line[2] * z_s
    else:
        dy, dz = line[2] - line[0], line[3] - line[1]
        size = 1.0 / math.sqrt(dy * dy + dz * dz)
        away = (dy * (z - line[1]) - dz * (y - line[0])) * size
        along = (dy * z_s - dz * y_s) * size
    return away, along


@inner
def _depth(mesh, poses, pose, vertex):  # type: ignore[no-untyped-def]
    """Return how far a vertex lies along the camera's axis."""
    matrix, corner = poses.matrix[pose], mesh.vertices[vertex]
    return matrix[0, 0] * corner[0] + matrix[0, 1] * corner[1] + matrix[0, 2] * corner[2] + poses.offset[pose, 0]


@inner
def _crossing(segment, s, along_v):  # type: ignore[no-untyped-def]
    """Return where the line of a segment meets the line at s across the sweep."""
    i = 1 if along_v else 0
    begin, length = segment[i], segment[i + 2] - segment[i]
    x, rise = segment[1 - i], segment[3 - i] - segment[1 - i]
    return x + (s - begin) * rise / length if length != 0.0 else x
