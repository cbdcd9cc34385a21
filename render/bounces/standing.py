"""Light that bounces between a landmark and the wall and floor behind it, from any view, fast enough to be matched.

Landmark and floor exchange light in the landmark's frame, where nothing moves: patches and transport are made once.
The wall is far and its patches are few. Light at the patches changes slowly with the view, so that it is computed at
nodes of a grid of distances and angles, when it is first asked for, and interpolated between them. Pixels are sampled
exactly.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Generator, Sequence
from threading import Lock
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from phasemark.render.background import BOUNCES
from phasemark.render.bounces.bounced_light import pixels_of, summed
from phasemark.render.bounces.patches import Patches, SizeAt, make_patches
from phasemark.render.bounces.sheets import Sheets
from phasemark.render.bounces.transport import Operator, transport_between
from phasemark.render.integral.area_integral import camera_of, of_poses, topology_of
from phasemark.render.integral.arguments import Poses
from phasemark.render.integral.intersect import make_intersector
from phasemark.render.integral.mesh_topology import MeshTopology
from phasemark.render.integral.scene_samples import WALL, SceneMesh, SceneSamples
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.sensor.sensor_quantities import SPEED_OF_LIGHT_M_S
from phasemark.render.threads import mapped
from phasemark.render.view import Views

_LANDMARK, _FLOOR = 0, 1
_PATCH = 0.3
"""Size of patches as a share of the landmark's own, before surfaces come close."""
_NEAR_LINES, _FINEST_SHARE = 0.5, 0.05
"""Size of patches beside lines where surfaces meet, as a share of the distance from them; the least, of the extent."""
_HOLLOW_RAD = 0.1
"""Least angle between faces of a hollow edge."""
_GROWTH = 0.15
"""By how much patches of the floor grow with the distance from the landmark."""
_WIDEST_M, _REACH_M = 1.0, 5.0
"""Largest patch of the floor, and how far the floor reaches."""
_GROUP = 2.0
"""Size of groups of patches, which exchange light with the wall, in sizes of patches."""
_SNAP_M = 2e-3
"""Heights of the floor below the landmark that count as the same."""
_STEP_SHARE, _STEP_RAD = 0.09, math.radians(7.5)
"""Steps of the grid of nodes: of the logarithm of the distance, and of the angle δ."""
_ALBEDOS = 0.5 - 0.5 * np.cos(np.pi * (np.arange(3) + 0.5) / 3)
"""Albedos of the floor at which nodes are computed: light is a polynomial in it, of which the square suffices."""
_MOST_NODES = 2000
"""Nodes that are kept, of 0.2 to 0.5 MB each."""
_NEAR_LENS = 0.1
"""Size of patches, as a share of their distance from the lens, over which the lamp's light is not even."""
_LAMP_STEP_RAD = math.radians(1.0)
"""Directions of the lamp's axis that count as the same."""
_SMALL = 5e-3
"""Share of the first bounce below which later ones are taken as a geometric series."""
_NEARBY_M = 1e-2
_FINEST_M, _FARTHEST_M = 0.1, 20.0
"""Pixels along which the range of wall or floor changes by more than the first are cut, up to the second."""


class StandingView(NamedTuple):
    """One view, in the landmark's frame.

    Parameters
    ----------
    distance_m, delta_rad : float
    lens : (3,) float64
    matrix : (3, 3) float64
        Landmark frame to the frame of the tilted camera.
    wall_m, floor_m : float
        From the lens to the wall, and down to the floor; 0: none.
    wall_albedo, floor_albedo : float
    """

    distance_m: float
    delta_rad: float
    lens: NDArray[np.float64]
    matrix: NDArray[np.float64]
    wall_m: float
    floor_m: float
    wall_albedo: float
    floor_albedo: float


class Stand:
    """A landmark on, or above, a floor: patches, groups of patches, and the transport between them."""

    def __init__(self, mesh: MeshTopology, floor_z_m: float | None, wave_numbers: Sequence[float]) -> None:
        topology = _with_floor(mesh, floor_z_m)
        size_at = _sizes(mesh, floor_z_m)
        self.patches = make_patches(topology, size_at, before_others=_LANDMARK)
        transport = transport_between(self.patches)
        self.slopes = transport.slopes
        self._gather_groups(size_at)
        n, g = len(self.patches), len(self.area)
        share = self.patches.area / self.area[self.group]
        self.mean = sparse.csr_array((share, (self.group, np.arange(n))), shape=(g, n))
        self.operators = [transport.operator(number, single=True) for number in wave_numbers]

    def _gather_groups(self, size_at: SizeAt) -> None:
        """Join patches of one body that face alike into groups, as `size_at` says how large patches are."""
        patches = self.patches
        level = np.floor(np.log2(size_at(patches.centre, patches.normal) * _GROUP)).astype(np.int64)
        cell = np.floor(patches.centre / (2.0**level)[:, None]).astype(np.int64)
        unit = patches.normal / np.linalg.norm(patches.normal, axis=1, keepdims=True)
        facing = np.round(2 * unit).astype(np.int64)
        keys = np.column_stack([patches.body, level, cell, facing, patches.side > 0])
        _, self.group = np.unique(keys, axis=0, return_inverse=True)
        self.group = self.group.ravel()
        weights = patches.area
        self.area = np.asarray(np.bincount(self.group, weights), np.float64)
        share = (weights / self.area[self.group])[:, None]
        self.centre, self.normal = np.zeros((2, len(self.area), 3))
        np.add.at(self.centre, self.group, share * patches.centre)
        np.add.at(self.normal, self.group, share * patches.normal)
        first = np.full(len(self.area), -1)
        far = np.linalg.norm(patches.centre - self.centre[self.group], axis=1)
        order = np.argsort(-far)
        first[self.group[order]] = order
        self.outlook = patches.outlook[first] + patches.lift_m * patches.normal[first]


_SHARING = Lock()
_STANDS: WeakValueDictionary[tuple[Any, ...], Stand] = WeakValueDictionary()
_LIGHTS: dict[tuple[Any, ...], StandingLight] = {}
_MOST_LIGHTS = 4
"""Lights that are kept for renderers to come, those used last; each has some 150 MB."""


def standing_light(mesh: MeshTopology, albedo: float, sensor: Sensor, frequencies_hz: Sequence[float]) -> StandingLight:
    """Return the light of a landmark, an albedo and a camera: one that was used before, if it is kept.

    Arguments are those of :class:`StandingLight`.
    """
    key = _mesh_digest(mesh), albedo, sensor.model_dump_json(), tuple(frequencies_hz)
    with _SHARING:
        found = _LIGHTS.pop(key, None) or StandingLight(mesh, albedo, sensor, frequencies_hz)
        _LIGHTS[key] = found
        if len(_LIGHTS) > _MOST_LIGHTS:
            del _LIGHTS[next(iter(_LIGHTS))]
    return found


def _mesh_digest(mesh: MeshTopology) -> bytes:
    digest = hashlib.blake2b(mesh.vertices.tobytes(), digest_size=16)
    digest.update(mesh.faces.tobytes())
    return digest.digest()


class StandingLight:
    """Light that bounces between a landmark and what stands behind it.

    Parameters
    ----------
    mesh : MeshTopology
        The landmark, landmark frame.
    albedo : float
        Of the landmark.
    sensor : Sensor
        The camera, with its lamp.
    frequencies_hz : sequence of float
        Of the phasors; 0: of intensities.
    """

    def __init__(self, mesh: MeshTopology, albedo: float, sensor: Sensor, frequencies_hz: Sequence[float]) -> None:
        self._mesh, self._albedo, self._sensor = mesh, albedo, sensor
        self._wave_numbers = [2 * math.pi * hz / SPEED_OF_LIGHT_M_S for hz in frequencies_hz]
        self._stands: dict[int | None, Stand] = {}
        self._stand_key = _mesh_digest(mesh), tuple(self._wave_numbers)
        self._nodes: dict[tuple[object, ...], tuple[NDArray[np.complex64], NDArray[np.complex64]]] = {}
        self._among: dict[tuple[float, float, float], NDArray[np.float64]] = {}
        self._radius_m = float(np.hypot(*mesh.vertices[:, :2].T).max(initial=0.0))
        self._lock = Lock()
        self._sampler = SceneMesh.of_surface(mesh, make_intersector(mesh.vertices, mesh.faces), WALL)
        self._grid = camera_of(sensor, (0, sensor.rows), ())
        self._least_cosine = math.cos(math.radians(sensor.lamp_half_angle_deg or 0.0))

    def stand(self, view: StandingView) -> tuple[int | None, Stand]:
        """Return the landmark on the floor that stands below it in a view, and a key of its height."""
        key, floor_z = None, None
        if view.floor_m:
            floor_z = view.lens[2] - view.floor_m
            foot = float(self._mesh.low[2])
            key = round((foot - floor_z) / _SNAP_M)
            floor_z = foot - key * _SNAP_M
        with _SHARING:
            if key not in self._stands:
                found = _STANDS.get((key, *self._stand_key))
                if found is None:
                    found = Stand(self._mesh, floor_z, self._wave_numbers)
                self._stands[key] = _STANDS[key, *self._stand_key] = found
        return key, self._stands[key]

    def is_of(self, albedo: float, sensor: Sensor) -> bool:
        """Return True if it is that of an albedo and a camera."""
        return self._albedo == albedo and self._sensor == sensor

    def arriving(
        self, view: StandingView, bounces: float
    ) -> tuple[Stand, NDArray[np.complex64], Sheets | None, NDArray[np.complex64]]:
        """Return the light that arrives at the patches in a view, interpolated between nodes.

        Returns
        -------
        stand : Stand
        at_patches : (frequencies, n) complex64
        sheets : Sheets, optional
        at_sheets : (frequencies, w) complex64
        """
        key, stand = self.stand(view)
        axis = self._lamp_axis(view)
        place = math.log(view.distance_m) / _STEP_SHARE, view.delta_rad / _STEP_RAD
        first = [math.floor(p) - 1 for p in place]
        weights = [_cubic(p - f - 1) for p, f in zip(place, first, strict=True)]
        around = round(2 * math.pi / _STEP_RAD)
        shares = _lagrange(_ALBEDOS, view.floor_albedo)
        views: dict[tuple[object, ...], StandingView] = {}
        nodes: dict[tuple[object, ...], tuple[NDArray[np.complex64], NDArray[np.complex64]]] = {}
        weight_of = {}
        for a, weight_a in enumerate(weights[0]):
            distance_m = math.exp(_STEP_SHARE * (first[0] + a))
            for b, weight_b in enumerate(weights[1]):
                weight = weight_a * weight_b
                if weight == 0:
                    continue
                turn = (first[1] + b) % around
                name = (
                    key, bounces, first[0] + a, turn, axis,
                    view.wall_m, view.floor_m, round(view.lens[2] / _SNAP_M), view.wall_albedo,
                )  # fmt: skip
                weight_of[name] = weight * shares
                with self._lock:
                    node = self._nodes.get(name)
                if node is None:
                    views[name] = self._node_view(view, distance_m, turn * _STEP_RAD, axis)
                else:
                    nodes[name] = node
        solved = dict(zip(views, self._solved(stand, list(views.values()), bounces), strict=True))
        with self._lock:
            self._nodes.update(solved)
            while len(self._nodes) > _MOST_NODES:
                del self._nodes[next(iter(self._nodes))]
        nodes |= solved
        found, at_sheets = None, None
        for name, weight in weight_of.items():
            own = [values @ weight for values in nodes[name]]
            found = own[0] if found is None else found + own[0]
            at_sheets = own[1] if at_sheets is None else at_sheets + own[1]
        assert found is not None
        assert at_sheets is not None
        scale = self._scale(view.distance_m)
        return stand, found * scale, self._sheets(view), at_sheets * scale

    def seen(self, poses: Poses, views: Views, workers: int = 1) -> NDArray[np.complex128]:
        """Return the light that has bounced, as the pixels receive it.

        Parameters
        ----------
        poses : Poses
            n poses of the landmark before the camera, with what stands behind it and how often light bounces.
        views : Views
            The same, as the camera itself has them.
        workers : int
            Threads.

        Returns
        -------
        (n, pixels, frequencies) complex128
        """
        pixels = self._sensor.rows * self._sensor.cols
        out = np.zeros((len(poses.lens), pixels, len(self._wave_numbers)), np.complex128)

        def run(k: int) -> None:
            wall_m, floor_m, wall_albedo, floor_albedo, bounces = poses.background[k]
            view = StandingView(
                float(views.distance_m[k]), float(views.delta_rad[k]), poses.lens[k], poses.matrix[k],
                float(wall_m), float(floor_m), float(wall_albedo), float(floor_albedo),
            )  # fmt: skip
            stand, at_patches, sheets, at_sheets = self.arriving(view, float(bounces))
            pose = of_poses(poses, slice(k, k + 1))
            samples = self._sampler.samples_of_poses(pose, self._grid, _FINEST_M, _FARTHEST_M)
            self._gather(samples, view, stand, at_patches, sheets, at_sheets, out[k])

        mapped(run, np.flatnonzero(poses.background[:, BOUNCES]).tolist(), workers)
        return out

    def _gather(
        self,
        samples: SceneSamples,
        view: StandingView,
        stand: Stand,
        at_patches: NDArray[np.complex64],
        sheets: Sheets | None,
        at_sheets: NDArray[np.complex64],
        out: NDArray[np.complex128],
    ) -> None:
        """Add what pixels receive, (pixels, frequencies), to `out`."""
        y, z = samples.tangents.T
        rays = np.column_stack([np.ones(len(y)), y, z]) @ view.matrix
        weight = samples.area * (self._grid.scale_u * self._grid.scale_v)
        if self._sensor.vignetting:
            weight = weight / (1 + y * y + z * z) ** 2
        pixel = pixels_of(samples, self._sensor)
        length = np.sqrt(1 + y * y + z * z)
        to = rays * (samples.range_m / length)[:, None]
        ahead = np.array([math.cos(view.delta_rad), math.sin(view.delta_rad), 0.0])
        across, before = to @ [-ahead[1], ahead[0], 0.0], view.wall_m - to @ ahead
        on_wall = samples.part == WALL
        on_strip = (samples.part == WALL + 1) & (sheets is not None and before < sheets.depth_m)
        near = np.flatnonzero(~on_wall & ~on_strip)
        patch, where = stand.patches.seen(np.repeat(view.lens[None], len(near), axis=0), rays[near])
        near, where, patch = near[patch >= 0], where[patch >= 0], patch[patch >= 0]
        offset = where - stand.patches.centre[patch]
        returned = np.full(len(y), view.floor_albedo)
        returned[on_wall] = view.wall_albedo
        own = stand.patches.body[patch] == _LANDMARK
        returned[near[own]] = self._albedo * stand.patches.albedo[patch[own]]
        for order, wave_number in enumerate(self._wave_numbers):
            arrives = np.zeros(len(y), np.complex128)
            values = at_patches[order]
            arrives[near] = values[patch]
            for axis, slope in enumerate(stand.slopes):
                arrives[near] += offset[:, axis] * (slope @ values)[patch]
            if sheets is not None:
                wall, strip = np.flatnonzero(on_wall), np.flatnonzero(on_strip)
                arrives[wall] = sheets.interpolated(at_sheets[order], across[wall], to[wall, 2], strip=False)
                if strip.size:
                    arrives[strip] = sheets.interpolated(at_sheets[order], across[strip], before[strip], strip=True)
            light = returned * weight * np.exp(1j * wave_number * samples.range_m) * arrives
            out[:, order] += summed(pixel, light, len(out))

    def _scale(self, distance_m: float) -> NDArray[np.complex64]:
        """Return how light falls off and turns with the distance, which leaves nodes that change slowly."""
        turn = np.exp(1j * np.array(self._wave_numbers) * distance_m)
        return np.asarray(turn[:, None] / distance_m**2, np.complex64)

    def _lamp_axis(self, view: StandingView) -> tuple[int, int]:
        """Return azimuth and elevation of the lamp's axis, from the line to the landmark's axis, in whole steps."""
        x, y, z = view.matrix[0]
        azimuth = (math.atan2(y, x) - view.delta_rad + math.pi) % (2 * math.pi) - math.pi
        return round(azimuth / _LAMP_STEP_RAD), round(math.asin(max(-1.0, min(1.0, z))) / _LAMP_STEP_RAD)

    def _node_view(
        self, view: StandingView, distance_m: float, delta_rad: float, axis: tuple[int, int]
    ) -> StandingView:
        azimuth, elevation = delta_rad + axis[0] * _LAMP_STEP_RAD, axis[1] * _LAMP_STEP_RAD
        flat = math.cos(elevation)
        ahead = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
        lens = np.array([-distance_m * math.cos(delta_rad), -distance_m * math.sin(delta_rad), view.lens[2]])
        matrix = np.array([ahead, ahead, ahead])
        wall_m = max(view.wall_m, distance_m + self._radius_m + _NEARBY_M) if view.wall_m else 0.0
        return view._replace(distance_m=distance_m, delta_rad=delta_rad, lens=lens, matrix=matrix, wall_m=wall_m)

    def _sheets(self, view: StandingView) -> Sheets | None:
        """Return wall and strip of a view."""
        if not view.wall_m:
            return None
        gap = view.wall_m - view.distance_m - self._radius_m
        half = math.radians(self._sensor.lamp_half_angle_deg or 0.0)
        return Sheets.behind(view.lens, view.delta_rad, view.wall_m, view.floor_m, gap, half)

    def _lamp(
        self, points: NDArray[np.float64], normals: NDArray[np.float64], view: StandingView, patches: Patches
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the light of the lamp at points (m, 3), cos θ / r², and their distance from it."""
        to = points - view.lens
        distance = np.linalg.norm(to, axis=1)
        facing = -np.einsum("ij,ij->i", to, normals) / distance
        cosine = to @ view.matrix[0] / distance
        lit = np.flatnonzero((facing > 0) & (cosine >= self._least_cosine))
        light = np.zeros(len(points))
        seen = patches.sees(np.repeat(view.lens[None], len(lit), axis=0), points[lit])
        lit = lit[seen]
        light[lit] = self._sensor.lamp_intensity(cosine[lit]) * facing[lit] / distance[lit] ** 2
        return light, distance

    def _solved(
        self, stand: Stand, views: Sequence[StandingView], bounces: float
    ) -> list[tuple[NDArray[np.complex64], NDArray[np.complex64]]]:
        """Return the light that arrives at patches and sheets at each of some nodes, without :meth:`_scale`.

        (frequencies, n, albedos of the floor) and (frequencies, w, albedos). What patches send each other at all nodes
        is one product with a sparse matrix, which is read once.
        """
        lit = [self._lit(stand, view) for view in views]
        found = [
            _together(operator, [_bounced(stand, one, wave_number, bounces) for one in lit])
            for operator, wave_number in zip(stand.operators, self._wave_numbers, strict=True)
        ]
        solved = []
        for view, own in zip(views, zip(*found, strict=True), strict=True):
            scale = 1 / self._scale(view.distance_m)[:, :, None]
            at_patches, at_sheets = (np.array(each) * scale for each in zip(*own, strict=True))
            solved.append((at_patches.astype(np.complex64), at_sheets.astype(np.complex64)))
        return solved

    def _lit(self, stand: Stand, view: StandingView) -> _Lit:
        """Return the light of the lamp at a node, and the shares of light that the patches return."""
        patches, sheets = stand.patches, self._sheets(view)
        whole = np.ones(len(patches))
        if sheets is not None:  # the floor of patches ends at the strip
            ahead = np.array([math.cos(view.delta_rad), math.sin(view.delta_rad), 0.0])
            beyond = (patches.centre - view.lens) @ ahead - (view.wall_m - sheets.depth_m)
            whole = np.where(patches.body == _FLOOR, np.clip(0.5 - beyond / patches.size, 0.0, 1.0), 1.0)
        own = patches.body == _LANDMARK
        returned = whole[:, None] * np.where(own[:, None], (self._albedo * patches.albedo)[:, None], _ALBEDOS)
        points, normals, weights, owner = patches.points_before(view.lens, _NEAR_LENS)
        light, way = self._lamp(points, normals, view, patches)
        coupled = None if sheets is None else self._coupled(stand, sheets, view)
        return _Lit(returned, light * weights, way, owner, coupled)

    def _coupled(self, stand: Stand, sheets: Sheets, view: StandingView) -> _Coupled:
        """Return the exchange of light between sheets and groups and among sheets, and the lamp's light on them."""
        lift = stand.patches.lift_m
        to = sheets.centre - stand.outlook[:, None]
        distance = np.linalg.norm(to, axis=2)
        receives = np.maximum(np.einsum("gwj,gj->gw", to, stand.normal), 0.0)
        sends = np.maximum(-np.einsum("gwj,wj->gw", to, sheets.normal), 0.0)
        least = np.minimum(stand.area[:, None], sheets.area)  # of a disc that is near, half a hemisphere
        exchange = receives * sends / (distance**2 * (math.pi * distance**2 + least))
        group, sheet = np.nonzero(exchange)
        seen = stand.patches.sees(stand.outlook[group], (sheets.centre + lift * sheets.normal)[sheet])
        exchange[group[~seen], sheet[~seen]] = 0.0
        points = sheets.points()
        normals = np.repeat(sheets.normal, points.shape[1], axis=0)
        light, way = self._lamp(points.reshape(-1, 3) + lift * normals, normals, view, stand.patches)
        n = sheets.n_wall
        albedo = np.where((np.arange(len(sheets.area)) < n)[:, None], view.wall_albedo, _ALBEDOS)
        key = view.wall_m, view.floor_m, sheets.depth_m
        among = self._among.get(key)
        if among is None:
            among = sheets.between()
            with self._lock:
                self._among = {**self._among, key: among}
        apart = np.linalg.norm(sheets.centre[:, None] - sheets.centre, axis=2)
        return _Coupled(
            exchange, distance, among, apart, sheets.area, albedo,
            light.reshape(points.shape[:2]), way.reshape(points.shape[:2]),
        )  # fmt: skip


class _Lit(NamedTuple):
    """A node before light bounces.

    Parameters
    ----------
    returned : (n, albedos) float64
        Share of the light that each patch returns.
    light, way : (m,) float64
        Light of the lamp at points of patches, and their distance from it.
    owner : (m,) int64
        Their patches.
    coupled : _Coupled, optional
        Exchange with wall and strip.
    """

    returned: NDArray[np.float64]
    light: NDArray[np.float64]
    way: NDArray[np.float64]
    owner: NDArray[np.int64]
    coupled: _Coupled | None


_Bounces = Generator[NDArray[Any], NDArray[Any], tuple[NDArray[Any], NDArray[Any]]]


def _bounced(stand: Stand, lit: _Lit, wave_number: float, bounces: float) -> _Bounces:
    """Yield the light that leaves the patches, bounce by bounce, for that which arrives; return the sum of the latter.

    At patches, (n, albedos), and at sheets, (w, albedos).
    """
    returned, coupled = lit.returned, lit.coupled
    lamp = summed(lit.owner, lit.light * np.exp(1j * wave_number * lit.way), len(returned))
    term: NDArray[Any] = np.repeat(lamp[:, None], len(_ALBEDOS), axis=1)
    of_sheets = np.zeros((0, len(_ALBEDOS)), np.complex128)
    if coupled is not None:
        to_groups, from_groups, among, of_sheets = coupled.operators(wave_number, stand.area)
    total, total_sheets = np.zeros_like(term), np.zeros_like(of_sheets)
    size, before, last, done = 0.0, np.zeros(0), np.abs(term).sum(axis=0), 0
    while done < bounces and last.max() > _SMALL * size:
        sent = returned * term
        term = yield sent.astype(np.complex64)
        if coupled is not None:
            from_sheets = coupled.albedo * of_sheets
            term = term + (to_groups @ from_sheets)[stand.group]
            of_sheets = from_groups @ (stand.mean @ sent) + among @ from_sheets
        total, total_sheets, done = total + term, total_sheets + of_sheets, done + 1
        before, last = last, np.abs(term).sum(axis=0)
        size = float(last.max()) if done == 1 else size
    if done < bounces and (last < before).all():  # what is left falls off as a geometric series
        rest = last / (before - last)
        total, total_sheets = total + rest * term, total_sheets + rest * of_sheets
    return total, total_sheets


def _together(operator: Operator, nodes: Sequence[_Bounces]) -> list[tuple[NDArray[Any], NDArray[Any]]]:
    """Let light bounce at all nodes at once; return what each returns."""
    found: dict[int, tuple[NDArray[Any], NDArray[Any]]] = {}
    arriving: dict[int, Any] = dict.fromkeys(range(len(nodes)))
    while arriving:
        leaving = {}
        for k, arrived in arriving.items():
            try:
                leaving[k] = nodes[k].send(arrived)
            except StopIteration as done:
                found[k] = done.value
        if not leaving:
            break
        arrived = operator @ np.concatenate(list(leaving.values()), axis=1)
        arriving = dict(zip(leaving, np.split(arrived, len(leaving), axis=1), strict=True))
    return [found[k] for k in range(len(nodes))]


class _Coupled(NamedTuple):
    """Exchange of light with wall and strip.

    Parameters
    ----------
    exchange, distance : (g, w) float64
        Between groups and sheets: cos θ cos θ' / (π d²), and d.
    among, apart : (w, w) float64
        Form factors between sheets, and their distances.
    area : (w,) float64
        Of the sheets.
    albedo : (w, albedos) float64
        Of the sheets, by that of the floor.
    light, way : (w, 16) float64
        Of the lamp, at points of the sheets, and their distance from it.
    """

    exchange: NDArray[np.float64]
    distance: NDArray[np.float64]
    among: NDArray[np.float64]
    apart: NDArray[np.float64]
    area: NDArray[np.float64]
    albedo: NDArray[np.float64]
    light: NDArray[np.float64]
    way: NDArray[np.float64]

    def operators(self, wave_number: float, group_area: NDArray[np.float64]) -> tuple[NDArray[np.complex128], ...]:
        """Return operators from sheets to groups, back, and among sheets; and the lamp's light at the sheets.

        Parameters
        ----------
        wave_number : float
        group_area : (g,) float64
        """
        turned = self.exchange * np.exp(1j * wave_number * self.distance)
        among = self.among * np.exp(1j * wave_number * self.apart)
        lamp = (self.light * np.exp(1j * wave_number * self.way)).mean(axis=1)
        at_lamp = np.repeat(lamp[:, None], self.albedo.shape[1], axis=1)
        return turned * self.area, (turned * group_area[:, None]).T, among, at_lamp


def _sizes(mesh: MeshTopology, floor_z_m: float | None) -> SizeAt:
    """Return sizes of patches: small beside lines where two surfaces meet and see each other, larger away from them."""
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    surface, corners = cKDTree(mesh.vertices[mesh.faces].mean(axis=1)), _meeting_points(mesh, floor_z_m)
    lines = cKDTree(corners) if len(corners) else None

    def size_at(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
        away = np.maximum(surface.query(points)[0] - _PATCH * extent, 0.0)
        size = np.minimum(_PATCH * extent + _GROWTH * away, _WIDEST_M)
        if lines is not None:
            size = np.minimum(size, np.maximum(_NEAR_LINES * lines.query(points)[0], _FINEST_SHARE * extent))
        return np.asarray(size)

    return size_at


def _meeting_points(mesh: MeshTopology, floor_z_m: float | None) -> NDArray[np.float64]:
    """Return points along the hollow edges of a landmark and along its foot on the floor, (m, 3)."""
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces)
    hollow = ~whole.face_adjacency_convex & (whole.face_adjacency_angles > _HOLLOW_RAD)
    segments = [whole.vertices[whole.face_adjacency_edges[hollow]]]
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    if floor_z_m is not None and mesh.low[2] - floor_z_m < _NEARBY_M:
        height = max(float(mesh.low[2]), floor_z_m) + 1e-4 * extent
        cut = trimesh.intersections.mesh_plane(whole, [0, 0, 1], [0, 0, height])  # type: ignore[no-untyped-call]
        segments.append(np.asarray(cut, np.float64).reshape(-1, 2, 3))
    ends = np.concatenate(segments)
    count = np.ceil(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / (_FINEST_SHARE * extent)).astype(np.int64) + 1
    return np.concatenate([np.linspace(a, b, n) for (a, b), n in zip(ends, count, strict=True)] or [np.empty((0, 3))])


def _with_floor(mesh: MeshTopology, floor_z_m: float | None) -> MeshTopology:
    """Return a landmark with a floor below it, parts 0 and 1."""
    vertices, faces = mesh.vertices, np.asarray(mesh.faces, np.int64)
    part = np.full(len(faces), _LANDMARK, np.int32)
    albedo = np.asarray(mesh.albedo)
    if floor_z_m is not None:
        r = _REACH_M
        corners = np.array([[-r, -r, floor_z_m], [r, -r, floor_z_m], [r, r, floor_z_m], [-r, r, floor_z_m]])
        sheet = np.array([[0, 1, 2], [0, 2, 3]]) + len(vertices)
        vertices, faces = np.concatenate([vertices, corners]), np.concatenate([faces, sheet])
        part, albedo = np.concatenate([part, [_FLOOR, _FLOOR]]), np.concatenate([albedo, [1.0, 1.0]])
    attributes: dict[str, Any] = {"part": part.astype(np.int32), "albedo": albedo}
    found = topology_of(trimesh.Trimesh(vertices, faces, process=False, face_attributes=attributes))
    return found._replace(closed=(found.part == _LANDMARK) & bool(mesh.closed.all()))


def _lagrange(places: NDArray[np.float64], at: float) -> NDArray[np.float32]:
    """Return the weights of values at some places in the polynomial through them."""
    apart = places[:, None] - places
    np.fill_diagonal(apart, 1.0)
    ways = np.where(np.eye(len(places), dtype=np.bool_), 1.0, at - places)
    return np.asarray((ways / apart).prod(axis=1), np.float32)


def _cubic(share: float) -> NDArray[np.float64]:
    """Return weights of four neighbours −1, 0, 1, 2 for a place between the middle two (Catmull and Rom)."""
    t = share
    return 0.5 * np.array([-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, -(t**2) + t**3])
