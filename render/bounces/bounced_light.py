"""Light that bounces, as the pixels of a camera receive it (PHYSICS section 12)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from phasemark import UsageError
from phasemark.render.background import Bounces, check_number_of_bounces
from phasemark.render.bounces.lamp import check_can_bounce, lamp_rays
from phasemark.render.bounces.patches import Patches, SizeAt, make_patches
from phasemark.render.bounces.radiosity import arriving
from phasemark.render.bounces.transport import transport_between
from phasemark.render.integral.area_integral import camera_of, of_poses
from phasemark.render.integral.arguments import Poses
from phasemark.render.integral.intersect import Intersector
from phasemark.render.integral.mesh_topology import MeshTopology
from phasemark.render.integral.scene_samples import SceneMesh, SceneSamples
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.sensor.sensor_quantities import SPEED_OF_LIGHT_M_S

_PILOT = 0.5
"""Size of the first, coarse patches as a share of their distance from the lens."""
_COARSEST, _LAST = 0.28, 0.04
"""Sizes between which patches are refined."""
_FINEST, _OF_PIXEL = 0.14, 0.4
"""Smallest size where surfaces meet: share of the size elsewhere, and of a pixel, whichever is larger."""
_ENOUGH = 2
"""Bounces by which the patches are refined."""
_FINER = 2**-0.5
_FINE = 0.1
"""Quantile of the patches' sizes that the points of pixels resolve."""
_INWARD = 0.05
"""How far towards the middle of a facet the points lie that stand for its corners."""
_BRIGHT, _DIMMEST = 0.3, 0.004
"""Shares of the brightest patch's light from which on, and down to which, patches grow in darkness."""
_GAP = 0.5
"""Size where surfaces are close, as a share of the gap between them."""
_CONTINUES = 0.5
"""Least cosine between normals of a surface and of another that may be its continuation around a bend."""


class _Seen(NamedTuple):
    """Points of surfaces that the pixels of a view see.

    Parameters
    ----------
    pixel, patch : (m,) int64
    offset : (m, 3) float64
        From the centre of the patch, m.
    range_m : (m,) float64
    weight : (m,) float64
        Share of the pixel's active area, times the share of the light that the lens passes.
    """

    pixel: NDArray[np.int64]
    patch: NDArray[np.int64]
    offset: NDArray[np.float64]
    range_m: NDArray[np.float64]
    weight: NDArray[np.float64]


class BouncedLight:
    """Light that bounces between bodies that stand still, before a camera at one or more places.

    Parameters
    ----------
    topology : MeshTopology
        All bodies, world frame.
    intersector : Intersector
        Of its faces.
    sensor : Sensor
        The camera, with its lamp.
    poses : Poses
        The world before the camera, n poses.
    size : float
        Largest extent of patches as a share of their distance from the nearest lens.
    kind : {"auto", "embree", "float64"}
        Intersector of the patches.

    Raises
    ------
    UsageError
        The sensor's lamp is not described, or the patches do not fit into memory.
    """

    def __init__(
        self,
        topology: MeshTopology,
        intersector: Intersector,
        sensor: Sensor,
        poses: Poses,
        size: float,
        kind: str = "auto",
    ) -> None:
        self.sensor, self.poses = sensor, poses
        self._mesh = SceneMesh.of_surface(topology, intersector, int(topology.part.max()) + 1)
        self._grid = camera_of(sensor, (0, sensor.rows), ())
        self._rays, self._light = lamp_rays(sensor)
        self._least_cosine = float(self._rays[:, 0].min())
        self.patches = make_patches(topology, even_sizes(_PILOT, poses.lens), intersector=kind)
        self.transport = transport_between(self.patches)
        pixel = math.sqrt(self._grid.scale_u * self._grid.scale_v)
        finest = max(_FINEST, _OF_PIXEL / pixel / size)
        sizes = sizes_for_light(even_sizes(size, poses.lens), self.patches, self._brightness(), finest)
        self.patches = make_patches(topology, sizes, intersector=kind)
        self.transport = transport_between(self.patches)

    def _brightness(self) -> NDArray[np.float64]:
        """Return the most light that arrives at each patch in any pose, directly and in two bounces."""
        still = np.zeros(1)
        lamp = np.stack([self._lamp(pose, still)[:, 0] for pose in self._each()], axis=1)
        arrives = lamp + arriving(lamp, self.transport.operator(0.0), self.patches.albedo, 2, 0.0)[:, :, 0]
        return np.asarray(arrives.real.max(axis=1))

    def _each(self) -> list[Poses]:
        return [of_poses(self.poses, slice(k, k + 1)) for k in range(len(self.poses.lens))]

    def phasors(
        self,
        frequencies_hz: Sequence[float],
        bounces: Bounces,
        tolerance: float,
        free: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.complex128]:
        """Return the light that has bounced.

        Parameters
        ----------
        frequencies_hz : sequence of float
            Of the modulation; 0: intensities.
        bounces : int or "all"
        tolerance : float
            Share of the light of the first bounce that later bounces may still bring where "all" ends.
        free : (bodies,) bool, optional
            Bodies of one unknown albedo.

        Returns
        -------
        (poses, pixels, frequencies, powers) complex128
            Coefficients of the powers of the free albedo; one power where none is free.

        Raises
        ------
        UsageError
            The light does not die out.
        """
        wave_numbers = 2 * np.pi * np.asarray(frequencies_hz) / SPEED_OF_LIGHT_M_S
        lamp = np.stack([self._lamp(pose, wave_numbers) for pose in self._each()], axis=1)
        seen = [self._seen(pose) for pose in self._each()]
        of_free = None if free is None else free[self.patches.body]
        found = []
        for k, wave_number in enumerate(wave_numbers):
            operator = self.transport.operator(float(wave_number))
            light = arriving(lamp[:, :, k], operator, self.patches.albedo, bounces, tolerance, of_free)
            found.append(self._gathered(seen, light, wave_number, of_free))
        powers = max(column.shape[2] for column in found)
        return np.stack([np.pad(c, ((0, 0), (0, 0), (0, powers - c.shape[2]))) for c in found], axis=2)

    def _lamp(self, pose: Poses, wave_numbers: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the light that arrives at each patch from the lamp, a mean over its area, (patches, k); `pose` is one.

        Patches that are lit throughout take the light at their points, the others that of rays which meet them.
        """
        patches, lens = self.patches, pose.lens[0]
        n = len(patches)
        directions = self._rays @ pose.matrix[0]
        patch, where = patches.seen(np.repeat(pose.lens, len(directions), axis=0), directions)
        met = patch >= 0
        patch, range_m = patch[met], np.linalg.norm(where[met] - lens, axis=1)
        to = patches.points - lens
        distance = np.linalg.norm(to, axis=2)
        facing = np.maximum(-np.einsum("nkj,nkj->nk", to, patches.normals), 0.0) / distance
        intensity = self.sensor.lamp_intensity(to @ pose.matrix[0, 0] / distance)
        light_at = patches.weights * intensity * facing / distance**2
        whole = self._lit_throughout(pose)
        out = np.empty((n, len(wave_numbers)), np.complex128)
        for k, wave_number in enumerate(wave_numbers):
            light = self._light[met] * np.exp(1j * wave_number * range_m)
            out[:, k] = summed(patch, light, n) / patches.area
            out[whole, k] = (light_at * np.exp(1j * wave_number * distance)).sum(axis=1)[whole]
        return out

    def _lit_throughout(self, pose: Poses) -> NDArray[np.bool_]:
        """Return whether the corners of all facets of each patch are in the lamp's light."""
        patches = self.patches
        owner = np.repeat(np.arange(len(patches)), np.diff(patches.first))
        normals = patches.side[owner, None] * patches.facets.normals[patches.members]
        corners = patches.facets.corners[patches.members]
        inner = corners + _INWARD * (corners.mean(axis=1, keepdims=True) - corners)
        inner += patches.lift_m * normals[:, None]
        to = inner.reshape(-1, 3) - pose.lens[0]
        lit = to @ pose.matrix[0, 0] >= self._least_cosine * np.linalg.norm(to, axis=1)
        lit &= patches.sees(np.repeat(pose.lens, len(to), axis=0), inner.reshape(-1, 3))
        lit &= np.einsum("fkj,fj->fk", to.reshape(-1, 3, 3), normals).ravel() < 0
        dark = ~lit.reshape(-1, 3).all(axis=1)
        return np.asarray(np.bincount(owner, dark, len(patches)) == 0)

    def _seen(self, pose: Poses) -> _Seen:
        """Return the points that the pixels see in one pose."""
        # pixels that see a surface at a slant are cut until their points resolve the patches
        samples = self._mesh.samples_of_poses(pose, self._grid, float(np.quantile(self.patches.size, _FINE)), np.inf)
        y, z = samples.tangents.T
        rays = np.column_stack([np.ones(len(y)), y, z])
        patch, where = self.patches.seen(np.repeat(pose.lens, len(y), axis=0), rays @ pose.matrix[0])
        weight = samples.area * (self._grid.scale_u * self._grid.scale_v)
        if self.sensor.vignetting:
            weight = weight / (1 + y * y + z * z) ** 2
        kept = patch >= 0
        offset = where[kept] - self.patches.centre[patch[kept]]
        return _Seen(pixels_of(samples, self.sensor)[kept], patch[kept], offset, samples.range_m[kept], weight[kept])

    def _gathered(
        self, seen: list[_Seen], light: NDArray[np.complex128], wave_number: float, free: NDArray[np.bool_] | None
    ) -> NDArray[np.complex128]:
        """Return the share of the light at patches that pixels receive, (poses, pixels, powers)."""
        n, views, powers = light.shape
        pixels = self.sensor.rows * self.sensor.cols
        slopes = [np.asarray(axis @ light.reshape(n, -1)).reshape(light.shape) for axis in self.transport.slopes]
        out = np.zeros((views, pixels, powers + (free is not None)), np.complex128)
        for view, points in enumerate(seen):
            patch = points.patch
            at = light[patch, view]
            for axis in range(3):
                at = at + points.offset[:, axis, None] * slopes[axis][patch, view]
            at *= (points.weight * np.exp(1j * wave_number * points.range_m))[:, None]
            of_free = np.zeros(len(patch), np.bool_) if free is None else free[patch]
            fixed = np.where(of_free, 0.0, self.patches.albedo[patch])
            for power in range(powers):
                out[view, :, power] += summed(points.pixel, at[:, power] * fixed, pixels)
                if free is not None:
                    out[view, :, power + 1] += summed(points.pixel, at[:, power] * of_free, pixels)
        return out


def refined(
    topology: MeshTopology,
    intersector: Intersector,
    sensor: Sensor,
    poses: Poses,
    tolerance: float,
    kind: str = "auto",
) -> BouncedLight:
    """Return bounced light on patches that were made smaller until the light changed by no more than a tolerance.

    Parameters
    ----------
    topology, intersector, sensor, poses, kind
        As :class:`BouncedLight` has them.
    tolerance : float
        Root mean square over the pixels of the first pose that sees light of the change at the highest frequency when
        the patches shrink by √2, as a share of the brightest pixel's direct light.

    Raises
    ------
    UsageError
        As for :class:`BouncedLight`, or the finest patches do not meet the tolerance.
    """
    before, size, change = None, _COARSEST, np.inf
    mesh, brightest = SceneMesh.of_surface(topology, intersector, int(topology.part.max()) + 1), 0.0
    for k in range(len(poses.lens)):
        judged = of_poses(poses, slice(k, k + 1))
        if (brightest := _brightest(mesh, sensor, judged)) > 0:
            break
    while size > _LAST:
        found = BouncedLight(topology, intersector, sensor, judged, size, kind)
        light = found.phasors([max(sensor.frequencies_hz)], _ENOUGH, tolerance)[0, :, 0, 0]
        if before is not None:
            change = float(np.sqrt(np.mean(np.abs(light - before) ** 2))) / (brightest or 1.0)
        if change <= tolerance:
            return found if len(poses.lens) == 1 else BouncedLight(topology, intersector, sensor, poses, size, kind)
        before, size = light, _FINER * size
    raise UsageError(
        f"light that bounces changes by {change:.1g} of the brightest pixel between {len(found.patches)} patches and"
        f" half as many: 'bounce_tolerance' must be at least that, got {tolerance:g}"
    )


def _brightest(mesh: SceneMesh, sensor: Sensor, pose: Poses) -> float:
    """Return the intensity of the brightest pixel in direct light."""
    grid = camera_of(sensor, (0, sensor.rows), ())
    samples = mesh.samples_of_poses(pose, grid, 1.0, 1.0)
    light = samples.amplitude * (grid.scale_u * grid.scale_v)
    return float(np.bincount(pixels_of(samples, sensor), light, 1).max())


def check_bounces(bounces: Bounces, tolerance: float, sensor: Sensor) -> None:
    """Refuse a number of bounces that is none, and a sensor for which they are not computed.

    Raises
    ------
    UsageError
    """
    check_number_of_bounces(bounces)
    if not (isinstance(tolerance, int | float) and tolerance > 0):
        raise UsageError(f"'bounce_tolerance' must be positive, got {tolerance!r}")
    if bounces:
        check_can_bounce(sensor)


def pixels_of(samples: SceneSamples, sensor: Sensor) -> NDArray[np.int64]:
    """Return the pixels that samples lie in."""
    u, v = sensor.image_points(*samples.tangents.T)
    col = np.clip(u, 0, sensor.cols - 1).astype(np.int64)
    return np.clip(v, 0, sensor.rows - 1).astype(np.int64) * sensor.cols + col


def summed(number: NDArray[np.int64], value: NDArray[np.complex128], n: int) -> NDArray[np.complex128]:
    """Return sums of values by number, (n,)."""
    return np.asarray(np.bincount(number, value.real, n) + 1j * np.bincount(number, value.imag, n))


def even_sizes(share: float, lens_m: NDArray[np.float64]) -> SizeAt:
    """Return sizes that are a share of the distance from the nearest of some lenses, (n, 3)."""

    def size_at(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(share * np.linalg.norm(points[:, None] - lens_m, axis=2).min(axis=1))

    return size_at


def sizes_for_light(wanted_at: SizeAt, coarse: Patches, light: NDArray[np.float64], finest: float) -> SizeAt:
    """Return sizes that follow the light on coarse patches, (n,), and the gaps between surfaces.

    Light counts twice, for what a patch sends on and for what of it returns; sizes go with its fourth root inverted.
    Near another surface a patch is half as large as the gap, or `finest` as a share of its size elsewhere.
    """
    brightest = light.max(initial=0.0) or 1.0  # in darkness all are coarse
    darkness = np.clip(light / (_BRIGHT * brightest), _DIMMEST / _BRIGHT, 1.0) ** -0.25
    reach = float(np.ptp(coarse.centre, axis=0).max())  # normals count as much as places
    tree = cKDTree(np.concatenate([coarse.centre, reach * coarse.normal], axis=1))

    def size_at(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
        wanted = wanted_at(points, normals)
        sides = [tree.query(np.concatenate([points, side * reach * normals], axis=1)) for side in (1, -1)]
        (away, near), (away_behind, near_behind) = sides
        dark = np.where(away < away_behind, darkness[near], darkness[near_behind])
        return np.asarray(dark * np.clip(_GAP * _gaps(points, normals, coarse), finest * wanted, wanted))

    return size_at


def _gaps(points: NDArray[np.float64], normals: NDArray[np.float64], patches: Patches) -> NDArray[np.float64]:
    """Return how far points of surfaces are from the nearest patch of another that they lie before, taken as a disc."""
    out = np.empty(len(points))
    unit = patches.normal / np.linalg.norm(patches.normal, axis=1, keepdims=True)
    at_once = 1024
    for start in range(0, len(points), at_once):
        part = slice(start, start + at_once)
        to = points[part, None] - patches.centre
        distance = np.linalg.norm(to, axis=2)
        height = np.einsum("ijk,jk->ij", to, unit)
        aside = np.sqrt(np.maximum(distance**2 - height**2, 0.0))
        gap = np.hypot(height, np.maximum(aside - 0.5 * patches.size, 0.0))
        continues = (np.abs(normals[part] @ unit.T) > _CONTINUES) & (height < 0.5 * distance)
        gap[(height <= patches.lift_m) | continues] = np.inf
        out[part] = gap.min(axis=1)
    return out
