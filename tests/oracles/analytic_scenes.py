"""Scenes of boxes, spheres and capsules by dense rays: what each ray meets first follows from closed forms.

It shares no code with the program: no mesh, no edges, no intersector. A pixel is the mean over a regular grid of rays.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LIGHT_M_PER_S = 299_792_458.0


class Solid(NamedTuple):
    """A box (half sides), a sphere (radius) or a capsule (radius, half height), and where it stands.

    Its gloss is a retroreflecting share, a share of Blinn and Phong's lobe, and the lobe's exponent.
    """

    kind: str
    size: tuple[float, ...]
    rotation: Array
    place: Array
    albedo: float
    gloss: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def response(self, cosine: Array) -> Array:
        """Return π times the BRDF back to the lamp, times cos θ."""
        retroreflecting, specular, exponent = self.gloss
        away = np.linspace(0, np.pi / 2, 100_001)  # from the normal, for light that comes along it
        lobe = np.cos(away / 2) ** exponent * np.cos(away) * np.sin(away) * 2 * np.pi
        whole = float(((lobe[1:] + lobe[:-1]) / 2).sum() * away[1])
        return self.albedo * cosine + retroreflecting + specular * np.pi / whole * cosine ** (exponent + 1)


def first_hits(solids: list[Solid], lens: Array, rays: Array) -> tuple[Array, NDArray[np.int64], Array]:
    """Find distance, number of the solid (−1: none) and |cos θ| of what unit rays (n, 3) meet first."""
    nearest, which, facing = np.full(len(rays), np.inf), np.full(len(rays), -1), np.zeros(len(rays))
    for number, solid in enumerate(solids):
        along, cosine = HITS[solid.kind](solid.size, (lens - solid.place) @ solid.rotation, rays @ solid.rotation)
        nearer = along < nearest
        nearest[nearer], which[nearer], facing[nearer] = along[nearer], number, cosine[nearer]
    return nearest, which, facing


def pixels(
    solids: list[Solid], camera2world: Array, shape: tuple[int, int], half_angle_rad: float, hz: float, n: int
) -> tuple[NDArray[np.complex128], Array]:
    """Return phasors (rows, cols) and shares (rows, cols, solids), n × n rays a pixel."""
    rows, cols = shape
    phasor, shares = np.zeros(shape, np.complex128), np.zeros((*shape, len(solids)))
    at = (np.arange(n) + 0.5) / n
    for row in range(rows):
        for col in range(cols):
            u, v = np.meshgrid(col + at, row + at)
            y, z = (1 - 2 * u / cols).ravel(), (1 - 2 * v / rows).ravel()
            rays = np.column_stack([np.ones(n * n), math.tan(half_angle_rad) * y, math.tan(half_angle_rad) * z])
            rays = rays @ camera2world[:3, :3].T / np.linalg.norm(rays, axis=1, keepdims=True)
            along, which, cosine = first_hits(solids, camera2world[:3, 3], rays)
            met = which >= 0
            response = np.zeros(len(rays))
            for number, solid in enumerate(solids):
                response[which == number] = solid.response(cosine[which == number])
            phase = 4 * math.pi * hz / LIGHT_M_PER_S * along[met]
            phasor[row, col] = (response[met] / along[met] ** 2 * np.exp(1j * phase)).sum() / n**2
            shares[row, col] = np.bincount(which[met], minlength=len(solids)) / n**2
    return phasor, shares


def light_of_ellipsoid(half: tuple[float, ...], pose: Array, hz: float, n: int) -> complex:
    """Return ∫ phasor du dv over the image plane x = 1 of an ellipsoid of albedo 1 before a lens at the origin.

    It is summed over the surface, n × 2n patches: one of area dS that faces the lens by cos θ fills
    cos θ dS / (r² c³) of the plane, with c the cosine off the axis.
    """
    polar, around = np.meshgrid((np.arange(n) + 0.5) * np.pi / n, (np.arange(2 * n) + 0.5) * np.pi / n)
    unit = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1)
    normal = unit / half  # dS · (unit normal) is this times the product of the axes times the patch of the unit sphere
    patch = np.prod(half) * np.sin(polar) * (np.pi / n) ** 2
    points = (unit * half) @ pose[:3, :3].T + pose[:3, 3]
    range_m = np.linalg.norm(points, axis=-1)
    rays = points / range_m[..., None]
    facing = np.maximum(-((normal @ pose[:3, :3].T) * rays).sum(-1), 0.0)  # cos θ times |normal|
    cosine = facing / np.linalg.norm(normal, axis=-1)
    light = cosine / range_m**2 * np.exp(4j * np.pi * hz / LIGHT_M_PER_S * range_m)
    return complex((light * facing * patch / (range_m**2 * rays[..., 0] ** 3)).sum())


def _box(half: tuple[float, ...], lens: Array, rays: Array) -> tuple[Array, Array]:
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-np.array(half) - lens) / rays, (np.array(half) - lens) / rays
    enter, leave = np.minimum(first, second), np.maximum(first, second)
    axis, low, high = enter.argmax(axis=1), enter.max(axis=1), leave.min(axis=1)
    axis = np.where(low > 0, axis, leave.argmin(axis=1))
    along = np.where(low > 0, low, high)
    along[(low > high) | (high <= 0)] = np.inf
    return along, np.abs(rays[np.arange(len(rays)), axis])


def _ball(radius: float, lens: Array, rays: Array) -> tuple[Array, Array]:
    middle, distance = rays @ lens, float(lens @ lens) - radius**2
    inside = middle**2 - distance
    root = np.sqrt(np.maximum(inside, 0.0))
    along = np.where((inside > 0) & (-middle - root > 0), -middle - root, np.inf)
    return along, root / radius


def _sphere(size: tuple[float, ...], lens: Array, rays: Array) -> tuple[Array, Array]:
    return _ball(size[0], lens, rays)


def _capsule(size: tuple[float, ...], lens: Array, rays: Array) -> tuple[Array, Array]:
    radius, half = size
    a, b, c = (rays[:, :2] ** 2).sum(axis=1), rays[:, :2] @ lens[:2], float(lens[:2] @ lens[:2]) - radius**2
    inside = b**2 - a * c
    root = np.sqrt(np.maximum(inside, 0.0))
    along = (-b - root) / a
    cosine = root / radius
    along[(inside <= 0) | (along <= 0) | (np.abs(lens[2] + along * rays[:, 2]) > half)] = np.inf
    for end in (-half, half):
        there, facing = _ball(radius, lens - [0, 0, end], rays)
        there[~(np.sign(end) * (lens[2] + there * rays[:, 2] - end) >= 0)] = np.inf
        nearer = there < along
        along[nearer], cosine[nearer] = there[nearer], facing[nearer]
    return along, cosine


HITS = {"box": _box, "sphere": _sphere, "capsule": _capsule}
