"""Which rays a batch of views needs: the samples of as many views as fit into the buffers."""

from __future__ import annotations

import math

import numpy as np

from phasemark.render.background import background_edge
from phasemark.render.integral.edge_motion import follow_borders
from phasemark.render.integral.edge_projection import project_edges
from phasemark.render.integral.edges_in_pixels import bin_segments
from phasemark.render.integral.pixel_splitting import sample_pixel
from phasemark.render.kernel import kernel

SKIPPED = 0
"""Pixel state: no sample can meet the landmark; only the background is seen."""
SPLIT = 1
"""Pixel state: sampled, split exactly."""
UNTRUSTED = 2
"""Pixel state: sampled, but too many edges for an exact split."""


@kernel
def plan_rays(first, mesh, poses, camera, splits, background, edges, scratch, samples, state, motion, borders):  # type: ignore[no-untyped-def]
    """Place the samples of as many views as fit into the buffers, from view `first` on.

    Parameters
    ----------
    first : int
    mesh : MeshTopology
    poses : Poses
    camera : Camera
    splits : int
        Boxes a side that every pixel is cut into.
    background : (4,) float64
    edges : Edges
    scratch : Scratch
    samples : Samples
        ``points``, ``weights``, ``regions`` and ``pixel`` are overwritten.
    state : (n, rows, cols) uint8, overwritten
        Per pixel :data:`SKIPPED`, :data:`SPLIT` or :data:`UNTRUSTED`.
    motion : Motion
    borders : Borders
        Overwritten; without room for any, nothing is asked of the edges' motion.

    Returns
    -------
    next_view, n_samples : int, int
        `next_view` equals `first` when not even one view fits; −1 in place of it: ``edges.link`` is too short.
    """
    segments, limb, head = edges.segments, edges.limb, edges.head
    rows, cols = camera.stop_row - camera.first_row, camera.cols
    n, region, n_borders, room = 0, 0, 0, len(borders.weights)
    borders.placed[0] = 0
    for view in range(first, len(poses.lens)):
        n_edges = project_edges(mesh, poses, view, camera, edges)
        u_low, u_high, v_low, v_high = _extent(edges, n_edges, False)
        bent_low_u, bent_high_u, bent_low_v, bent_high_v = _extent(edges, n_edges, True)
        cos_b, sin_b = math.cos(poses.bearing[view]), math.sin(poses.bearing[view])
        if background_edge(background, cos_b, sin_b, poses.level[view], camera, segments[n_edges]):
            limb[n_edges] = 0
            edges.ends[n_edges, 0] = -1
            n_edges += 1
        if bin_segments(n_edges, camera, edges) < 0:
            return -1, n
        start, first_border = n, n_borders
        for row in range(rows):
            r = camera.first_row + row
            for c in range(cols):
                outside = c >= u_high or c + 1 <= u_low or r >= v_high or r + 1 <= v_low
                if outside and head[r + 1, c + 1] < 0:
                    state[view, row, c] = SKIPPED
                    continue
                before = n
                bent = c < bent_high_u and c + 1 > bent_low_u and r < bent_high_v and r + 1 > bent_low_v
                n, region, trusted = sample_pixel(
                    r, c, bent, splits, camera, edges, scratch, samples, borders, n, region
                )
                if n < 0 or borders.placed[0] > room:
                    borders.placed[0] = first_border
                    return view, start
                state[view, row, c] = SPLIT if trusted else UNTRUSTED
                index = (view * rows + row) * cols + c
                for k in range(before, n):
                    samples.pixel[k] = index
                for b in range(n_borders, borders.placed[0]):
                    borders.pixel[b] = index
                n_borders = borders.placed[0]
        if room > 0:
            follow_borders(view, first_border, mesh, motion, background, camera, edges, borders)
    return len(poses.lens), n


@kernel
def _extent(edges, n_edges, of_limbs):  # type: ignore[no-untyped-def]
    """Return the extent of the edges, or of the limbs among them: lower and upper u, lower and upper v."""
    segments = edges.segments
    u_low, u_high, v_low, v_high = np.inf, -np.inf, np.inf, -np.inf
    for i in range(n_edges):
        if of_limbs and not edges.limb[i]:
            continue
        u_low = min(u_low, segments[i, 0], segments[i, 2])
        u_high = max(u_high, segments[i, 0], segments[i, 2])
        v_low = min(v_low, segments[i, 1], segments[i, 3])
        v_high = max(v_high, segments[i, 1], segments[i, 3])
    return u_low, u_high, v_low, v_high
