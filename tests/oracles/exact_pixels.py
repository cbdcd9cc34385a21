"""Pixels of the catalogue's solids to 1e-6, without a mesh and without projected edges.

Each line across a pixel is cut where its rays begin to meet another surface, found by bisection, and each piece is
integrated adaptively with points that crowd at both of its ends. The lines in turn are integrated adaptively. Only the
rays of the camera are the program's.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark.landmarks import catalog
from phasemark.landmarks.spec import Cone, Cylinder, Sphere
from phasemark.render import Background, Sensor, Views

_GX, _GW = np.polynomial.legendre.leggauss(12)
_GX, _GW = 0.5 + 0.5 * _GX, 0.5 * _GW
_LX, _LW = np.polynomial.legendre.leggauss(6)
_LX, _LW = 0.5 + 0.5 * _LX, 0.5 * _LW
_DEGREE = 6
"""Of the polynomials that a ray is across a pixel: a lens is smooth to 1e-11 within one."""
_BOX = (0.12, 0.08, 0.15)


@njit(cache=True)
def _meet(scene, d, e):  # type: ignore[no-untyped-def]
    """Return label, range and amplitude of what a unit ray meets: d in the landmark frame, e in the level one.

    Labels: 0 nothing, 1 … 6 the box's sides, 7 side, 8 lid of the upper part, 9 wall, 10 floor.
    """
    kind, radius, height = scene[0], scene[1], scene[2]
    o0, o1, o2 = scene[3], scene[4], scene[5]
    label, best, facing, rho = 0, np.inf, 0.0, scene[8]
    # box
    near, far, side = -np.inf, np.inf, 0
    for axis in range(3):
        o = scene[3 + axis]
        low, high = (-_BOX[axis], _BOX[axis]) if axis < 2 else (-_BOX[2], 0.0)
        if d[axis] == 0.0:
            if o < low or o > high:
                far = -np.inf
            continue
        a, b = (low - o) / d[axis], (high - o) / d[axis]
        if a > b:
            a, b = b, a
        if a > near:
            near, side = a, axis
        far = min(far, b)
    if near <= far and near > 0.0:
        label, best, facing = 1 + 2 * side + (1 if d[side] > 0.0 else 0), near, abs(d[side])
    if kind == 2:  # sphere
        oz = o2 - radius
        b = d[0] * o0 + d[1] * o1 + d[2] * oz
        root = b * b - (o0 * o0 + o1 * o1 + oz * oz - radius * radius)
        if root > 0.0:
            t = -b - math.sqrt(root)
            if 0.0 < t < best:
                label, best, facing = 7, t, math.sqrt(root) / radius
    else:
        k = (radius / height) ** 2 if kind == 1 else 0.0
        w = o2 - height
        a = d[0] * d[0] + d[1] * d[1] - k * d[2] * d[2]
        b = d[0] * o0 + d[1] * o1 - k * w * d[2]
        c = o0 * o0 + o1 * o1 - k * w * w - (radius * radius if kind == 0 else 0.0)
        root = b * b - a * c
        if root > 0.0 and a != 0.0:
            for sign in (-1.0, 1.0):
                t = (-b + sign * math.sqrt(root)) / a
                z = o2 + t * d[2]
                if 0.0 < t < best and 0.0 <= z <= height:
                    nx, ny, nz = o0 + t * d[0], o1 + t * d[1], k * (height - z)
                    cos = -(nx * d[0] + ny * d[1] + nz * d[2]) / math.sqrt(nx * nx + ny * ny + nz * nz)
                    if cos > 0.0:
                        label, best, facing = 7, t, cos
        if kind == 0 and d[2] < 0.0:
            t = (height - o2) / d[2]
            x, y = o0 + t * d[0], o1 + t * d[1]
            if 0.0 < t < best and x * x + y * y <= radius * radius:
                label, best, facing = 8, t, -d[2]
    ahead = e[0] * scene[9] + e[1] * scene[10]
    if scene[6] > 0.0 and ahead > 0.0 and scene[6] / ahead < best:
        label, best, facing, rho = 9, scene[6] / ahead, ahead, 0.5
    if scene[7] > 0.0 and e[2] < 0.0 and -scene[7] / e[2] < best:
        label, best, facing, rho = 10, -scene[7] / e[2], -e[2], 0.5
    if label == 0:
        return 0, 0.0, 0.0
    return label, best, rho * facing / (best * best)


@njit(cache=True)
def _look(world, s, x, along_v, d, e):  # type: ignore[no-untyped-def]
    """Return :func:`_meet` at a point x of the line s."""
    scene, image, rotation, level, _ = world
    a, b = (x, s) if along_v else (s, x)
    a, b = 2.0 * (a - image[0, 0, 0]) - 1.0, 2.0 * (b - image[0, 0, 1]) - 1.0
    size = 0.0
    for i in range(3):
        e[i] = 0.0
        for j in range(_DEGREE, -1, -1):
            row = 0.0
            for k in range(_DEGREE, -1, -1):
                row = row * a + image[1 + i, j, k]
            e[i] = e[i] * b + row
        size += e[i] * e[i]
    x, y, z = e[0] / math.sqrt(size), e[1] / math.sqrt(size), e[2] / math.sqrt(size)
    for i in range(3):
        d[i] = rotation[0, i] * x + rotation[1, i] * y + rotation[2, i] * z
        e[i] = level[i, 0] * x + level[i, 1] * y + level[i, 2] * z
    return _meet(scene, d, e)


@njit(cache=True)
def _piece(world, s, a, b, t0, t1, label, along_v, d, e, out):  # type: ignore[no-untyped-def]
    """Write the integral over t0 … t1 of the piece a … b, where x = a + (b − a) sin²(πt/2)."""
    out[:] = 0.0
    wave = world[4]
    for g in range(len(_GX)):
        t = t0 + (t1 - t0) * _GX[g]
        root = math.sin(0.5 * math.pi * t)
        x = a + (b - a) * root * root
        w = (t1 - t0) * _GW[g] * (b - a) * 0.5 * math.pi * math.sin(math.pi * t)
        _, r, amplitude = _look(world, s, x, along_v, d, e)
        for k in range(len(wave)):
            out[2 * k] += w * amplitude * math.cos(wave[k] * r)
            out[2 * k + 1] += w * amplitude * math.sin(wave[k] * r)
        out[2 * len(wave)] += w * amplitude
    if 1 <= label <= 8:
        out[2 * len(wave) + 1] = (b - a) * (math.sin(0.5 * math.pi * t1) ** 2 - math.sin(0.5 * math.pi * t0) ** 2)


@njit(cache=True)
def _line(world, s, x0, x1, along_v, tolerance, looks, work, total):  # type: ignore[no-untyped-def]
    """Write the integral along one line; return a number that tells in which order surfaces are met."""
    d, e = np.empty(3), np.empty(3)
    total[:] = 0.0
    begin, at, order = x0, x0, 0
    label, _, _ = _look(world, s, at, along_v, d, e)
    step = (x1 - x0) / looks
    k = 1
    while begin < x1:
        ahead = x1 if k >= looks else x0 + k * step
        if ahead <= at:
            k += 1
            if k > looks + 1:
                break
            continue
        met, _, _ = _look(world, s, ahead, along_v, d, e)
        end = ahead
        if met != label:
            low, high, beyond = at, ahead, met
            for _ in range(60):
                middle = 0.5 * (low + high)
                if middle == low or middle == high or high - low < 1e-14:
                    break
                own, _, _ = _look(world, s, middle, along_v, d, e)
                if own == label:
                    low = middle
                else:
                    high, beyond = middle, own
            end = high
        elif ahead < x1:
            at = ahead
            continue
        order = order * 11 + label
        # adaptive over t: a stack of intervals with their estimate
        n = len(total)
        depth = 1
        work[0, 0], work[0, 1] = 0.0, 1.0
        _piece(world, s, begin, end, 0.0, 1.0, label, along_v, d, e, work[0, 2:])
        while depth > 0:
            depth -= 1
            t0, t1 = work[depth, 0], work[depth, 1]
            whole = work[depth, 2:].copy()
            tm = 0.5 * (t0 + t1)
            left, right = work[depth, 2:], work[depth + 1, 2:]
            _piece(world, s, begin, end, t0, tm, label, along_v, d, e, left)
            _piece(world, s, begin, end, tm, t1, label, along_v, d, e, right)
            error = 0.0
            for j in range(n - 1):
                error = max(error, abs(left[j] + right[j] - whole[j]))
            if error < tolerance * (x1 - x0) or t1 - t0 < 1e-4:
                for j in range(n):
                    total[j] += left[j] + right[j]
            else:
                work[depth, 0], work[depth, 1] = t0, tm
                work[depth + 1, 0], work[depth + 1, 1] = tm, t1
                depth += 2
        if met == label or end >= x1:
            break
        begin = at = end
        label = beyond
    for j in range(len(total)):
        total[j] /= x1 - x0
    return order


@njit(cache=True)
def _panel(world, s0, s1, x0, x1, along_v, tolerance, looks, work, line, out):  # type: ignore[no-untyped-def]
    """Write the integral over a panel; return whether all of its lines meet surfaces in one order."""
    order = _line(world, s0, x0, x1, along_v, tolerance, looks, work, line)
    same = _line(world, s1, x0, x1, along_v, tolerance, looks, work, line) == order
    out[:] = 0.0
    for g in range(len(_LX)):
        s = s0 + (s1 - s0) * _LX[g]
        met = _line(world, s, x0, x1, along_v, tolerance, looks, work, line)
        same = same and met == order
        for j in range(len(out)):
            out[j] += (s1 - s0) * _LW[g] * line[j]
    return same


@njit(cache=True)
def _pixel(world, fill, along_v, tolerance, finest, parts, looks, work, panels, line, total):  # type: ignore[no-untyped-def]
    """Write the integral over a pixel; lines run across v if `along_v`."""
    total[:] = 0.0
    n = len(total)
    image = world[1]
    u0, v0 = image[0, 0, 0] + 0.5 - 0.5 * fill[0], image[0, 0, 1] + 0.5 - 0.5 * fill[1]
    s0, x0, ws, wx = (v0, u0, fill[1], fill[0]) if along_v else (u0, v0, fill[0], fill[1])
    x1 = x0 + wx
    depth = 0
    for k in range(parts):
        lo, hi = s0 + ws * k / parts, s0 + ws * (k + 1) / parts
        panels[depth, 0], panels[depth, 1] = lo, hi
        _panel(world, lo, hi, x0, x1, along_v, 0.1 * tolerance, looks, work, line, panels[depth, 2:])
        depth += 1
    count = 0
    while depth > 0:
        depth -= 1
        lo, hi = panels[depth, 0], panels[depth, 1]
        whole = panels[depth, 2:].copy()
        middle = 0.5 * (lo + hi)
        left, right = panels[depth, 2:], panels[depth + 1, 2:]
        same = _panel(world, lo, middle, x0, x1, along_v, 0.1 * tolerance, looks, work, line, left)
        if not _panel(world, middle, hi, x0, x1, along_v, 0.1 * tolerance, looks, work, line, right):
            same = False
        error = 0.0
        for j in range(n - 1):
            error = max(error, abs(left[j] + right[j] - whole[j]))
        error = max(error, 0.1 * tolerance * abs(left[n - 1] + right[n - 1] - whole[n - 1]) / 1e-6)
        count += 1
        if (same and error < tolerance * ws * math.sqrt((hi - lo) / ws)) or hi - lo < finest:
            for j in range(n):
                total[j] += left[j] + right[j]
        else:
            panels[depth, 0], panels[depth, 1] = lo, middle
            panels[depth + 1, 0], panels[depth + 1, 1] = middle, hi
            depth += 2
    for j in range(n):
        total[j] /= ws
    return count


@njit(cache=True, nogil=True)
def _pixels(scene, images, rotation, level, wave, fill, along_v, tolerance, finest, parts, looks, out):  # type: ignore[no-untyped-def]
    n = out.shape[1]
    work, panels, line = np.empty((64, n + 2)), np.empty((64, n + 2)), np.empty(n)
    for i in range(len(images)):
        _pixel(
            (scene, images[i], rotation, level, wave), fill, along_v, tolerance, finest, parts, looks, work,
            panels, line, out[i],
        )  # fmt: skip


def _rays(sensor: Sensor, row: int, col: int) -> NDArray[np.float64]:
    """Return polynomials of the ray across a pixel, (4, 7, 7): the pixel's corner, then powers of v and of u."""
    nodes = np.cos(math.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
    inverse = np.linalg.inv(np.vander(nodes, increasing=True))
    v, u = np.meshgrid(row + 0.5 + 0.5 * nodes, col + 0.5 + 0.5 * nodes, indexing="ij")
    out = np.zeros((4, _DEGREE + 1, _DEGREE + 1))
    out[0, 0, :2] = col, row
    directions = sensor.ray_directions(u.ravel(), v.ravel()).reshape(*u.shape, 3)
    out[1:] = np.einsum("ja,kb,abi->ijk", inverse, inverse, directions)
    return out


def exact_pixels(
    name: str,
    sensor: Sensor,
    view: Views,
    pixels: NDArray[Any],
    *,
    background: Background | None = None,
    frequencies_hz: tuple[float, ...] | None = None,
    along_v: bool = True,
    tolerance: float = 3e-8,
    finest: float = 2e-6,
    parts: int = 4,
    looks: int = 48,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Integrate some pixels of one view of a catalogue landmark, albedo 0.8.

    Parameters
    ----------
    name : str
        Class of the catalogue.
    view : Views
        One view.
    pixels : (n, 2) int
        Row and column.
    frequencies_hz : tuple of float, optional
        None: the sensor's first.
    along_v : bool
        Whether lines run along u and are swept along v; the other way is a second integration of the same pixel.
    tolerance : float
        Absolute, of a pixel's phasor.
    finest : float
        Width of a sweep's step (pixels) that is not halved any more.
    parts : int
        Steps a sweep begins with: a corner that reaches into the pixel between two lines is missed.
    looks : int
        Rays along a line at which the surface is asked for. Slivers beside another surface are found all the same; an
        apex that is narrower is missed.

    Returns
    -------
    phasors, intensity, coverage : (n, frequencies) complex128, (n,), (n,)
    """
    upper = catalog()[name].upper
    if isinstance(upper, Sphere):
        kind, radius, height = 2.0, upper.radius_m, 2 * upper.radius_m
    else:
        assert isinstance(upper, Cone | Cylinder)
        kind, radius, height = float(isinstance(upper, Cone)), upper.radius_m, upper.height_m
    seen = view.in_camera(sensor)
    rotation = np.ascontiguousarray(seen.landmark2cam()[0][0] @ np.eye(3))
    level = np.ascontiguousarray(seen.tilt2level()[0])
    behind = background or Background()
    bearing = float(seen.bearing_rad[0])
    scene = np.array(
        [kind, radius, height, *seen.lens_in_landmark()[0], behind.wall_m or 0.0, behind.floor_m or 0.0, 0.8,
         math.cos(bearing), math.sin(bearing)]
    )  # fmt: skip
    hz = frequencies_hz or (sensor.frequencies_hz[0],)
    wave = 4 * math.pi * np.array(hz) / 299_792_458.0
    images = np.stack([_rays(sensor, int(row), int(col)) for row, col in pixels])
    out = np.empty((len(pixels), 2 * len(hz) + 2))
    fill = np.array(sensor.fill_factor)
    _pixels(scene, images, rotation, level, wave, fill, along_v, tolerance, finest, parts, looks, out)
    phasors = out[:, 0 : 2 * len(hz) : 2] + 1j * out[:, 1 : 2 * len(hz) : 2]
    return phasors, out[:, -2], out[:, -1]
