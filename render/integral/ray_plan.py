"""Rays of a batch of views: the samples of as many views as fit into the buffers."""

from __future__ import annotations

import math

import numpy as np

from phasemark.render.background import background_edge, background_line
from phasemark.render.integral.bent_edges import add_bent_edge
from phasemark.render.integral.edge_projection import project_edges
from phasemark.render.integral.edges_in_pixels import bin_segments
from phasemark.render.integral.floor_phase import parts_of_pixel
from phasemark.render.integral.image_rays import trace
from phasemark.render.integral.limbs import lists_limb
from phasemark.render.integral.pixel_splitting import sample_pixel
from phasemark.render.kernel import inner, kernel

SKIPPED = 0
"""Pixel state: no sample can meet the landmark; only the background is seen."""
SPLIT = 1
"""Pixel state: sampled, split exactly."""
UNTRUSTED = 2
"""Pixel state: sampled, but too many edges for an exact split."""
_TURN_RAD = 0.15
"""Turn of the fastest phase over a pixel's width at the landmark above which every pixel is cut into 2 × 2 boxes: a
face seen at a slant is about as deep as the pixel is wide. Half of it is enough at edges and beside limbs."""
_TURN_OF_BOX_RAD = 1.0
"""Turn that the points of a box integrate: a pixel over which the phase turns farther is cut into more boxes."""
_BOXES_A_SIDE = 64
"""Boxes of an image along a side that a turn of the phase may cost: those of few pixels see surfaces in depth."""
_SMALL = 2.0
"""Pixels; behind a lens with distortion, pixels are cut into 2 × 2 boxes where all limbs together extend over less."""
SHORT_LINKS = -1
"""Next view that says that ``edges.link`` is too short."""
SHORT_SEGMENTS = -2
"""Next view that says that ``edges.segments`` is too short."""


@kernel
def plan_rays(  # type: ignore[no-untyped-def]
    first, mesh, poses, camera, splits, fastest, least, edges, scratch, samples, state, borders
):
    """Place the samples of as many views as fit into the buffers, from view `first` on.

    Parameters
    ----------
    first : int
    mesh : MeshTopology
    poses : Poses
    camera : Camera
    splits : int
        Boxes a side that every pixel is cut into, at least.
    fastest : float
        As :class:`~phasemark.render.integral.arguments.Light` has it.
    least : (rows, cols, 2) int64
        Boxes along u and v that each pixel is cut into, at least; without rows: `splits` alone counts.
    edges : Edges
    scratch : Scratch
    samples : Samples
        ``points``, ``rays``, ``weights``, ``regions``, ``pixel`` and ``pieces`` are overwritten.
    state : (n, rows, cols) uint8, overwritten
        Per pixel :data:`SKIPPED`, :data:`SPLIT` or :data:`UNTRUSTED`.
    borders : Borders
        Overwritten but for ``depth`` and ``rates``; without room for any, nothing is asked of the edges' motion.

    Returns
    -------
    next_view, n_samples : int, int
        `next_view` equals `first` when not even one view fits; :data:`SHORT_LINKS` or :data:`SHORT_SEGMENTS` in
        place of it: the edges have no room.
    """
    head, reach, bent_lens = edges.head, camera.distortion.reach, camera.distortion.model != 0
    rows, cols = camera.stop_row - camera.first_row, camera.cols
    n, region, n_borders, room = np.int64(0), np.int64(0), np.int64(0), len(borders.weights)
    borders.placed[0] = samples.pieces.placed[0] = 0
    for view in range(first, len(poses.lens)):
        n_edges = project_edges(mesh, poses, view, camera, edges)
        if n_edges < 0:
            return SHORT_SEGMENTS, n
        u_low, u_high, v_low, v_high = _extent(edges, n_edges, np.bool_(False), bent_lens)
        if mesh.around:
            u_low, u_high, v_low, v_high = -np.inf, np.inf, -np.inf, np.inf
        bent_low_u, bent_high_u, bent_low_v, bent_high_v = _extent(edges, n_edges, np.bool_(True), bent_lens)
        cos_b, sin_b = math.cos(poses.bearing[view]), math.sin(poses.bearing[view])
        background = poses.background[view]
        n_edges = _add_background(background, cos_b, sin_b, poses.level[view], camera, edges, n_edges)
        if n_edges < 0:
            return SHORT_SEGMENTS, n
        if bin_segments(n_edges, camera, edges) < 0:
            return SHORT_LINKS, n
        turn = fastest * camera.slope_u * _distance(mesh, poses.lens[view])
        small = bent_lens and (
            bent_high_u - bent_low_u < _SMALL * camera.slope_u and bent_high_v - bent_low_v < _SMALL * camera.slope_v
        )
        least_parts = max(splits, 2) if small or turn > _TURN_RAD else splits
        if turn > 2.0 * _TURN_OF_BOX_RAD:
            most_parts = _BOXES_A_SIDE // max(camera.rows, cols)
            least_parts = max(least_parts, min(math.ceil(turn / _TURN_OF_BOX_RAD), most_parts))
        start, first_border = n, n_borders
        for row in range(rows):
            r = camera.first_row + row
            row_outside = False
            if bent_lens:
                whole = reach[r, cols]
                row_outside = whole[0] >= u_high or whole[1] <= u_low or whole[2] >= v_high or whole[3] <= v_low
            for c in range(cols):
                if row_outside and head[r + 1, c + 1] < 0:
                    state[view, row, c] = SKIPPED
                    continue
                left, right, top, bottom = float(c), c + 1.0, float(r), r + 1.0
                if bent_lens:
                    left, right, top, bottom = reach[r, c, 0], reach[r, c, 1], reach[r, c, 2], reach[r, c, 3]
                outside = left >= u_high or right <= u_low or top >= v_high or bottom <= v_low
                if outside and head[r + 1, c + 1] < 0:
                    state[view, row, c] = SKIPPED
                    continue
                before = n
                bent = left < bent_high_u and right > bent_low_u and top < bent_high_v and bottom > bent_low_v
                parts_u, parts_v = parts_of_pixel(r, c, background, fastest, cos_b, sin_b, poses.level[view], camera)
                near_limb = _near_limb(r + 1, c + 1, edges)
                if near_limb and parts_u != parts_v:
                    parts_u = parts_v = max(parts_u, parts_v)
                if turn > 0.5 * _TURN_RAD and (near_limb or head[r + 1, c + 1] >= 0):
                    parts_u, parts_v = max(parts_u, 2), max(parts_v, 2)
                parts_u, parts_v = max(least_parts, parts_u), max(least_parts, parts_v)
                if len(least) > 0:
                    parts_u, parts_v = max(parts_u, least[row, c, 0]), max(parts_v, least[row, c, 1])
                n, region, trusted = sample_pixel(
                    r, c, bent, parts_u, parts_v, camera, edges, scratch, samples, borders, n, region
                )
                if n < 0 or borders.placed[0] > room:
                    borders.placed[0] = first_border
                    return view, start
                state[view, row, c] = SPLIT if trusted else UNTRUSTED
                index = (view * rows + row) * cols + c
                for k in range(before, n):
                    samples.pixel[k] = index
                trace(before, n, samples, camera)
                for b in range(n_borders, borders.placed[0]):
                    borders.pixel[b] = index
                    e = borders.segment[b]
                    borders.ends[b, 0], borders.ends[b, 1] = edges.ends[e, 0], edges.ends[e, 1]
                    borders.along[b, 0] = edges.segments[e, 2] - edges.segments[e, 0]
                    borders.along[b, 1] = edges.segments[e, 3] - edges.segments[e, 1]
                n_borders = borders.placed[0]
    return len(poses.lens), n


@inner
def _distance(mesh, lens):  # type: ignore[no-untyped-def]
    """Return how far a landmark is, or the middle of a scene, and at least half of what that extends over."""
    if not mesh.around:
        return math.sqrt(lens[0] * lens[0] + lens[1] * lens[1] + lens[2] * lens[2])
    away, extent = 0.0, 0.0
    for k in range(3):
        away += (lens[k] - 0.5 * (mesh.low[k] + mesh.high[k])) ** 2
        extent += (mesh.high[k] - mesh.low[k]) ** 2
    return math.sqrt(max(away, 0.25 * extent))


@inner
def _add_background(background, cos_b, sin_b, level, camera, edges, n):  # type: ignore[no-untyped-def]
    """Append the line where wall and floor meet, or the horizon; return the number of segments, −1 without room."""
    lens = camera.distortion
    if lens.model == 0:
        if background_edge(background, cos_b, sin_b, level, camera, edges.segments[n]):
            edges.limb[n], edges.ends[n, 0] = 0, -1
            n += 1
        return n
    if background[1] == 0.0:
        return n
    tx, ty, tz = background_line(background, cos_b, sin_b, level)
    if abs(tz) >= abs(ty) and tz != 0.0:
        ya, yb = lens.low_y, lens.high_y
        za, zb = -(tx + ty * ya) / tz, -(tx + ty * yb) / tz
    elif ty != 0.0:
        za, zb = lens.low_z, lens.high_z
        ya, yb = -(tx + tz * za) / ty, -(tx + tz * zb) / ty
    else:
        return n
    nowhere, crease = np.int64(-1), np.int64(0)
    return add_bent_edge(ya, za, yb, zb, nowhere, nowhere, crease, camera, edges, n)


@inner
def _near_limb(i, j, edges):  # type: ignore[no-untyped-def]
    """Return whether a limb runs through a pixel or one beside it: the rules beside a limb want square boxes."""
    head = edges.head
    for entry in (head[i, j], head[i, j - 1], head[i, j + 1], head[i - 1, j], head[i + 1, j]):
        if lists_limb(entry, edges):
            return True
    return False


@inner
def _extent(edges, n_edges, of_limbs, bent_lens):  # type: ignore[no-untyped-def]
    """Return the extent of the edges, or of the limbs among them: lower and upper u, lower and upper v.

    Behind a lens with distortion it is that of all edges before they are clipped: lower and upper y and z.
    """
    segments = edges.segments
    u_low, u_high, v_low, v_high = np.inf, -np.inf, np.inf, -np.inf
    if bent_lens:
        own = edges.extent[1 if of_limbs else 0]
        return own[0], own[1], own[2], own[3]
    for i in range(n_edges):
        if of_limbs and not edges.limb[i]:
            continue
        u_low = min(u_low, segments[i, 0], segments[i, 2])
        u_high = max(u_high, segments[i, 0], segments[i, 2])
        v_low = min(v_low, segments[i, 1], segments[i, 3])
        v_high = max(v_high, segments[i, 1], segments[i, 3])
    return u_low, u_high, v_low, v_high
