"""Which face each sample sees: one ray an interval scouts, the other samples are found on its patch or cast.

One ray an interval scouts what is seen there (:func:`pick_scouts`). On a plane patch that is all there is to know. On a
curved one each of the other samples has a face of its own (:func:`share_faces`). On a patch with an apex the face is
looked for; elsewhere, and where it is not found, the ray of the sample is cast too (:func:`aim`).
"""

from __future__ import annotations

from phasemark.render.integral.arguments import ray_of, towards_landmark
from phasemark.render.integral.face_search import find_face, plane_hit, turns_smoothly
from phasemark.render.integral.ray_plan import SPLIT
from phasemark.render.kernel import inlined, kernel


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
def share_faces(n, mesh, share, scout_face, samples, poses, camera, state):  # type: ignore[no-untyped-def]
    """Hand the face a scout met to its interval where that is all there is to know, and list the samples left to cast.

    On a plain patch the plane is the same for all samples, and where the scout met nothing nothing is met. On a patch
    with an apex each sample's face is looked for from that of its neighbour, and on any other curved patch it is cast.
    Pixels that could not be split are cast throughout, as is everything without `share`.

    Returns how many indices were written to ``samples.chosen``.
    """
    regions, pixel, face, chosen = samples.regions, samples.pixel, samples.face, samples.chosen
    count, start, region = 0, 0, 0
    states = state.reshape(-1)
    for k in range(1, n + 1):
        if k < n and regions[k] == regions[start]:
            continue
        scout, found = (start + k - 1) // 2, scout_face[region]
        known = share and states[pixel[start]] == SPLIT
        face[scout] = found
        if known and (found < 0 or mesh.plain[found]):
            for i in range(start, k):
                face[i] = found
        elif known and mesh.fanned[found]:
            count = _search(scout, -1, start - 1, count, mesh, samples, poses, camera)
            count = _search(scout, 1, k, count, mesh, samples, poses, camera)
        else:
            for i in range(start, k):
                if i != scout:
                    chosen[count] = i
                    count += 1
        start = k
        region += 1
    return count


@kernel
def _search(scout, step, stop, count, mesh, samples, poses, camera):  # type: ignore[no-untyped-def]
    """Find the faces of the samples of a curved patch, one after the other from the scout on; list what is not found.

    A search starts from the sample that was found last, or from the first one of its line if that is nearer in the
    image: where a line ends, the samples go on beside its beginning.
    """
    points, face = samples.points, samples.face
    view = samples.pixel[scout] // ((camera.stop_row - camera.first_row) * camera.cols)
    ox, oy, oz = poses.lens[view, 0], poses.lens[view, 1], poses.lens[view, 2]
    matrix = poses.matrix[view]
    y, z = ray_of(camera, points[scout, 0], points[scout, 1])
    dx, dy, dz = towards_landmark(matrix, y, z)
    t = plane_hit(mesh.search, face[scout], ox, oy, oz, dx, dy, dz)
    # sample and its hit, from the lens: the last one found, and the first one of its line
    last, x, y, z = scout, t * dx, t * dy, t * dz
    of_line, line_x, line_y, line_z = last, x, y, z
    for i in range(scout + step, stop, step):
        new_line = _apart(points, i, of_line) < _apart(points, i, last)
        if new_line:
            last, x, y, z = of_line, line_x, line_y, line_z
        across, up = ray_of(camera, points[i, 0], points[i, 1])
        dx, dy, dz = towards_landmark(matrix, across, up)
        g, t = find_face(mesh.search, mesh.grid, face[last], ox, oy, oz, dx, dy, dz)
        if g >= 0 and turns_smoothly(mesh.search, face[last], g, t * dx - x, t * dy - y, t * dz - z):
            face[i] = g
            last, x, y, z = i, t * dx, t * dy, t * dz
            if new_line:
                of_line, line_x, line_y, line_z = last, x, y, z
        else:
            samples.chosen[count] = i
            count += 1
    return count


@inlined
def _apart(points, i, j):  # type: ignore[no-untyped-def]
    """Return the square of the distance of two samples in the image."""
    u, v = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]
    return u * u + v * v


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
