"""Images computed by other means than the renderer's: dense sampling, quadrature of closed forms, finer pixels."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark.render import Renderer, Sensor, Views
from phasemark.render.integral.intersect import make_intersector

Light = Callable[[NDArray[Any]], tuple[NDArray[Any], NDArray[Any]]]
"""From unit vectors (..., 3) to the amplitude and the range of what they meet."""


def image_points(sensor: Sensor, row: int, col: int, n: int) -> NDArray[Any]:
    """Return n evenly scattered points (n, 2) in a pixel's active area: a Kronecker sequence on 1/φ₂, 1/φ₂².

    φ₂ = 1.3247… is the real root of x³ = x + 1. No row or column of points lines up with an edge, so that the area
    beside a straight edge converges like n^(−3/4) rather than n^(−1/2).
    """
    k = np.arange(1, n + 1)
    unit = np.column_stack([k * 0.7548776662466927, k * 0.5698402909980532]) % 1.0
    points: NDArray[np.float64] = np.array([col + 0.5, row + 0.5]) + (unit - 0.5) * sensor.fill_factor
    return points


def brute_force(
    renderer: Renderer,
    pixels: Sequence[tuple[int, int]],
    *,
    n: int = 160_000,
    kind: str = "auto",
    wall_m: float | None = None,
    **view: Any,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return (phasor, intensity, coverage) of some pixels by shading n rays in each.

    Shares with the renderer the mesh with its corner normals, and the intersector; neither the placing of the rays,
    nor the frames of reference, nor the shading.

    Parameters
    ----------
    pixels : sequence of (row, col)
    wall_m : float, optional
        A wall of albedo ½.
    view
        As for Renderer.render; one view.
    """
    sensor, mesh = renderer.sensor, renderer.topology
    intersector = make_intersector(mesh.vertices, mesh.faces, kind)
    views = Views.broadcast(**view)
    lens = views.lens_in_landmark()[0]
    rotation = views.landmark2cam()[0][0]
    out = []
    for row, col in pixels:
        u, v = image_points(sensor, row, col, n).T
        cam = sensor.ray_directions(u, v)
        d = cam @ rotation  # camera to landmark: the rotation's transpose
        origins = np.tile(lens.astype(np.float32), (n, 1))
        face = intersector.first_face(origins, d.astype(np.float32))
        hit = face >= 0
        f, dh = face[hit], d[hit]
        normal, offset = mesh.planes[f, :3], mesh.planes[f, 3]
        t = (offset - normal @ lens) / np.einsum("ij,ij->i", normal, dh)
        shading = shading_normals(mesh, f, lens + t[:, None] * dh)
        away = np.sign(np.einsum("ij,ij->i", normal, dh))
        cos = np.maximum(away * np.einsum("ij,ij->i", shading, dh), 0)
        range_m, light = np.zeros(n), np.zeros(n)
        range_m[hit], light[hit] = t, renderer.albedo * cos / t**2
        if wall_m is not None:
            forward = cam @ [math.cos(views.bearing_rad[0]), math.sin(views.bearing_rad[0]), 0]
            range_m[~hit] = (wall_m / forward)[~hit]
            light[~hit] = (0.5 * forward**3 / wall_m**2)[~hit]
        if sensor.vignetting:
            light *= (cam @ sensor.cam2level[:, 0]) ** 4
        phase = range_m / sensor.metres_per_radian
        out.append(((light * np.exp(1j * phase)).mean(), light.mean(), hit.mean()))
    phasor, intensity, coverage = zip(*out, strict=True)
    return np.array(phasor), np.array(intensity), np.array(coverage)


def shading_normals(mesh: Any, face: NDArray[Any], point: NDArray[Any]) -> NDArray[Any]:
    """Interpolate the corner normals of faces at points on them, by ratios of areas."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[face]], 1, 0)

    def area(p: NDArray[Any], q: NDArray[Any], r: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(np.einsum("ij,ij->i", np.cross(q - p, r - p), mesh.planes[face, :3]))

    share = np.column_stack([area(point, b, c), area(point, c, a), area(point, a, b)])
    normal = np.einsum(
        "ik,ikx->ix", share / share.sum(axis=1, keepdims=True), mesh.corner_normals[face, :9].reshape(-1, 3, 3)
    )
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(np.where(size > 0, normal / np.where(size > 0, size, 1), mesh.planes[face, :3]))


def pixel_nodes(low: float, high: float, n: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return Gauss-Legendre nodes and weights between bounds."""
    x, w = np.polynomial.legendre.leggauss(n)
    return low + (high - low) * (x + 1) / 2, (high - low) * w / 2


def integrate_pixels(
    sensor: Sensor, light: Light, cuts_v: Sequence[float] = (), n: int = 16, orders: Sequence[int] = (1,)
) -> tuple[dict[int, NDArray[Any]], NDArray[Any]]:
    """Integrate a smooth scene over all pixels of a sensor.

    Parameters
    ----------
    light : callable
        From ray directions (..., 3) in the level camera frame to (amplitude, range_m).
    cuts_v : sequence of float
        Rows v where the scene changes at once; pixels are split there.

    Returns
    -------
    phasors, intensity : dict of order to (rows, cols) complex128, (rows, cols) float64
    """
    width, height = sensor.fill_factor
    phasors = {k: np.zeros((sensor.rows, sensor.cols), complex) for k in orders}
    intensity = np.zeros((sensor.rows, sensor.cols))
    for row in range(sensor.rows):
        low, high = row + 0.5 - height / 2, row + 0.5 + height / 2
        bounds = [low, *sorted(cut for cut in cuts_v if low < cut < high), high]
        pieces = [pixel_nodes(a, b, n) for a, b in itertools.pairwise(bounds)]
        v, wv = (np.concatenate(part) for part in zip(*pieces, strict=True))
        for col in range(sensor.cols):
            u, wu = pixel_nodes(col + 0.5 - width / 2, col + 0.5 + width / 2, n)
            amplitude, range_m = light(sensor.ray_directions(u[None, :], v[:, None]))
            weighted = amplitude * wv[:, None] * wu / (width * height)
            intensity[row, col] = weighted.sum()
            for k in orders:
                phasors[k][row, col] = (weighted * np.exp(1j * k * range_m / sensor.metres_per_radian)).sum()
    return phasors, intensity


def plane_light(normal: ArrayLike, distance_m: float, albedo: float) -> Light:
    """Return the light of the plane normal · p = distance_m; normal away from the lens, distance positive."""

    def light(d: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        facing = d @ np.asarray(normal, float)
        range_m = distance_m / facing
        return albedo * facing / range_m**2, range_m

    return light


def sphere_pixels(
    sensor: Sensor, centre: Sequence[float], radius: float, albedo: float, n: int = 1500
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Integrate a sphere over the pixels of a level sensor in closed form along rows of constant z.

    Along z = const. the sphere is seen between the roots of a quadratic in y, and its light there is smooth in the
    angle τ with y = middle + half · sin τ; 12 Gauss points in τ and n midpoints in z per pixel.

    Returns
    -------
    phasor, intensity, coverage : (rows, cols)
    """
    tan_h, tan_v = sensor.tan_half_angles
    cx, cy, cz = centre
    k = cx**2 + cy**2 + cz**2 - radius**2
    shape = (sensor.rows, sensor.cols)
    phasor, intensity, coverage = np.zeros(shape, complex), np.zeros(shape), np.zeros(shape)
    x, w = np.polynomial.legendre.leggauss(12)
    v = (np.arange(sensor.rows * n) + 0.5) / n
    z = tan_v * (1 - 2 * v / sensor.rows)
    m = cx + z * cz
    a, b, c = cy**2 - k, cy * m, m**2 - k * (1 + z**2)
    root = np.sqrt(np.maximum(b**2 - a * c, 0))
    middle, half = -b / a, root / -a
    for col in range(sensor.cols):
        right, left = (tan_h * (1 - 2 * edge / sensor.cols) for edge in (col + 1, col))
        inside = half > 0
        safe = np.where(inside, half, 1)
        t0 = np.arcsin(np.clip((right - middle) / safe, -1, 1))
        t1 = np.arcsin(np.clip((left - middle) / safe, -1, 1))
        inside &= t1 > t0
        i = np.flatnonzero(inside)
        tau = t0[i, None] + (t1 - t0)[i, None] * (x + 1) / 2
        y = middle[i, None] + half[i, None] * np.sin(tau)
        weight = (t1 - t0)[i, None] * w / 2 * half[i, None] * np.cos(tau) * sensor.cols / (2 * tan_h)
        d = np.stack(np.broadcast_arrays(1.0, y, z[i, None]), axis=-1)
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        amplitude, range_m = sphere_light(d, np.array(centre), radius, albedo)
        light = weight * amplitude
        rows = i // n
        for target, value in (
            (intensity, light.sum(axis=1)),
            (coverage, weight.sum(axis=1)),
            (phasor, (light * np.exp(1j * range_m / sensor.metres_per_radian)).sum(axis=1)),
        ):
            np.add.at(target[:, col], rows, value / n)
    return phasor, intensity, coverage


def sphere_light(
    d: NDArray[Any], centre: NDArray[Any], radius: float, albedo: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return amplitude and range of a sphere along unit rays that meet it."""
    along = d @ centre
    range_m = along - np.sqrt(np.maximum(along**2 - centre @ centre + radius**2, 0))
    cos = -np.einsum("...i,...i", range_m[..., None] * d - centre, d) / radius
    return albedo * np.maximum(cos, 0) / range_m**2, range_m


def mean_of_blocks(image: NDArray[Any], factor: int) -> NDArray[Any]:
    """Average blocks of factor × factor pixels of (n, rows, cols)."""
    n, rows, cols = image.shape
    return np.asarray(image.reshape(n, rows // factor, factor, cols // factor, factor).mean(axis=(2, 4)))


class RayShader:
    """Light along single rays of one view; shares the mesh with its corner normals and the intersector, no more.

    Parameters
    ----------
    renderer : Renderer
    view : Views
        One view.
    """

    def __init__(self, renderer: Renderer, view: Views, kind: str = "auto") -> None:
        self.sensor, self.albedo, self.mesh = renderer.sensor, renderer.albedo, renderer.topology
        self.intersector = make_intersector(self.mesh.vertices, self.mesh.faces, kind)
        self.lens = view.lens_in_landmark()[0]
        self.rotation = view.landmark2cam()[0][0]

    def __call__(self, uv: NDArray[Any], light: bool = True) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Return S, intensity, coverage, range and smooth patch (−1: none) of points (n, 2) of the image."""
        d = self.sensor.ray_directions(*uv.T) @ self.rotation
        origins = np.broadcast_to(self.lens.astype(np.float32), d.shape).copy()
        face = self.intersector.first_face(origins, d.astype(np.float32))
        hit = face >= 0
        f, dh = face[hit], d[hit]
        normal = self.mesh.planes[f, :3]
        facing = np.einsum("ij,ij->i", normal, dh)
        t = (self.mesh.planes[f, 3] - normal @ self.lens) / facing
        range_m, patch, out = np.zeros(len(uv)), np.full(len(uv), -1), np.zeros((len(uv), 3), complex)
        range_m[hit], patch[hit] = t, self.mesh.patch[f]
        if light:
            shading = shading_normals(self.mesh, f, self.lens + t[:, None] * dh)
            amplitude = self.albedo * np.maximum(np.sign(facing) * np.einsum("ij,ij->i", shading, dh), 0) / t**2
            out[hit, 0] = amplitude * np.exp(1j * t / self.sensor.metres_per_radian)
            out[hit, 1], out[hit, 2] = amplitude, 1
        return out, range_m, patch


def adaptive_images(
    renderer: Renderer, view: Views, *, tolerance: float = 1e-5, first: int = 4, last: int = 10
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Integrate all pixels of one view on quadtrees.

    It knows nothing of projected edges: where the rays of a cell, its corners' among them, meet different smooth
    patches, or one patch at ranges that differ by more than eight times the cell's own width, the cell is quartered
    until it is 2^-last pixels wide; no straight edge passes between the corners of a cell unseen. Elsewhere a cell is
    done when its quarters add up to what it held, to `tolerance` · brightest · width, so that the errors of a pixel's
    cells, of either sign, add up to `tolerance`. The smallest cells get four jittered rays, so that along an edge of
    any slope their errors cancel: 2^(-1.5 last) / 3 of a pixel remains.

    Returns
    -------
    phasor, intensity, coverage : (rows, cols)
    """
    sensor = renderer.sensor
    shade = RayShader(renderer, view)
    rng = np.random.default_rng(1)
    pitch = 2 * sensor.tan_half_angles[0] / sensor.cols
    quarters = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) / 4
    gauss = quarters * 2 / math.sqrt(3)
    corners = quarters * 2 * (1 - 1e-9)

    def integrate(centre: NDArray[Any], width: float, jitter: bool = False) -> NDArray[Any]:
        values = np.empty((len(centre), 3), complex)
        for start in range(0, len(centre), 1 << 16):
            part = centre[start : start + (1 << 16), None]
            if jitter:
                places = quarters + rng.uniform(-0.25, 0.25, (len(part), 4, 2))
            else:
                places = gauss
            light, _, _ = shade((part + width * places).reshape(-1, 2))
            values[start : start + (1 << 16)] = width**2 * light.reshape(-1, 4, 3).mean(axis=1)
        return values

    def mixed(centre: NDArray[Any], width: float) -> NDArray[Any]:
        out = np.empty(len(centre), bool)
        places = np.vstack([corners, quarters, [[0, 0]]])
        for start in range(0, len(centre), 1 << 16):
            points = centre[start : start + (1 << 16), None] + width * places
            _, range_m, patch = (item.reshape(-1, len(places)) for item in shade(points.reshape(-1, 2), light=False))
            steep = np.ptp(range_m, axis=1) > 8 * width * pitch * range_m.max(axis=1)
            out[start : start + (1 << 16)] = steep | (patch.min(axis=1) != patch.max(axis=1))
        return out

    total = np.zeros((sensor.rows * sensor.cols, 3), complex)

    def add(centre: NDArray[Any], value: NDArray[Any]) -> None:
        index = np.floor(centre[:, 1]).astype(int) * sensor.cols + np.floor(centre[:, 0]).astype(int)
        for k in range(3):
            total[:, k] += np.bincount(index, value[:, k].real, len(total))
            total[:, k] += 1j * np.bincount(index, value[:, k].imag, len(total))

    width = 0.5**first
    v, u = np.mgrid[0 : sensor.rows : width, 0 : sensor.cols : width] + width / 2
    centre = np.column_stack([u.ravel(), v.ravel()])
    value = integrate(centre, width)
    brightest = np.abs(value[:, 1]).max() / width**2
    for _ in range(first, last):
        settled = ~mixed(centre, width)
        children = (centre[:, None] + width * quarters).reshape(-1, 2)
        finer = integrate(children, width / 2)
        change = np.abs(finer.reshape(-1, 4, 3).sum(axis=1) - value)[:, :2].max(axis=1) / brightest
        settled &= change <= tolerance * width
        add(children[np.repeat(settled, 4)], finer[np.repeat(settled, 4)])
        again = np.repeat(~settled, 4)
        centre, value, width = children[again], finer[again], width / 2
    add(centre, integrate(centre, width, jitter=True))
    images = total.reshape(sensor.rows, sensor.cols, 3)
    return images[..., 0], images[..., 1].real, images[..., 2].real
