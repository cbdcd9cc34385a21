"""Which face each sample sees: one ray an interval scouts, the other samples are found on its patch or cast.

One ray an interval scouts what is seen there (:func:`pick_scouts`). On a plane patch that is all there is to know. On a
curved one the faces of the other samples are looked for (:func:`share_faces`), and what is not found is cast too
(:func:`aim`).
"""

from __future__ import annotations

from phasemark.render.integral.arguments import ray_of, towards_landmark
from phasemark.render.integral.ray_plan import SPLIT
from phasemark.render.kernel import kernel


@kernel
def pick_scouts(n, samples):  # type: ignore[no-untyped-def]
    """Choose the middle sample of every interval.

    Samples of an interval lie one behind the other, and all see one smooth patch of the surface: the one in the middle
    tells which. Returns how many indices were written to ``samples.chosen``.
    """
    regions, chosen = samples.regions, samples.chosen
    count, start = 0, 0
    for k in range(1, n + 1):
        if k == n or regions[k] != regions[start]:
            chosen[count] = (start + k - 1) // 2
            count += 1
            start = k
    return count


@kernel
def share_faces(n, mesh, share, scout_face, samples, state):  # type: ignore[no-untyped-def]
    """Hand the face a scout met to its interval where that is all there is to know, and list the samples left to cast.

    On a plain patch the plane is the same for all samples, and where the scout met nothing nothing is met. A curved
    patch has a face for each sample. Pixels that could not be split are cast throughout, as is everything without
    `share`.

    Returns how many indices were written to ``samples.chosen``.
    """
    regions, pixel, face, chosen = samples.regions, samples.pixel, samples.face, samples.chosen
    count, start, region = 0, 0, 0
    states = state.reshape(-1)
    for k in range(1, n + 1):
        if k < n and regions[k] == regions[start]:
            continue
        scout, found = (start + k - 1) // 2, scout_face[region]
        known = share and states[pixel[start]] == SPLIT and (found < 0 or mesh.plain[found])
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
def aim(n, samples, poses, camera):  # type: ignore[no-untyped-def]
    """Write the float32 rays of the first n samples that were chosen, landmark frame."""
    points, origins, directions = samples.points, samples.origins, samples.directions
    pixels_per_view = (camera.stop_row - camera.first_row) * camera.cols
    for i in range(n):
        k = samples.chosen[i]
        view = samples.pixel[k] // pixels_per_view
        y, z = ray_of(camera, points[k, 0], points[k, 1])
        for a in range(3):
            origins[i, a] = poses.lens[view, a]
        directions[i, 0], directions[i, 1], directions[i, 2] = towards_landmark(poses.matrix[view], y, z)
