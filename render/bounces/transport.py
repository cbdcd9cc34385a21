"""Transport: how much light each two patches exchange, and how far it goes."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from phasemark import UsageError
from phasemark.render.bounces.form_factors import triangle_form_factor
from phasemark.render.bounces.patches import POINTS, Patches
from phasemark.render.kernel import inner, kernel

_CLOSE = 3.0
"""Patches nearer to one another than this many of their sizes take the closed form of their facets."""
_NEAR = 20.0
"""Those nearer than this take four points each; those beyond, one."""
_SLOPING = 2.0
"""Over patches nearer than this the light that they send is taken as sloping, and as even over those beyond."""
_FLAT = 1 - 1e-9
"""Product of the mean normals of two patches above which both are plane and face the same way."""
_BYTES, _MOST_GIB = 60, 16
"""Of a pair of patches that see each other, and of all."""
_PAIRS = 1 << 19
"""Pairs of patches that are looked at together."""
_NEIGHBOURS = 16
"""Patches among which neighbours are looked for."""
_PLANE, _SAME_PLANE_M = 1e-9, 1e6
"""Normals of a plane patch add up to one but for this; distance that neighbours of unlike planes seem to have."""
_ALIKE = 0.8
"""Least cosine between the normals of neighbours."""
_BESIDE = 0.3
"""Largest height of a neighbour over the plane of a patch, as a share of its distance."""


class Slopes(NamedTuple):
    """Linear maps from values at the centres of patches to their slopes along the surface, (n, n) each, 1/m."""

    x: sparse.csr_array
    y: sparse.csr_array
    z: sparse.csr_array


class Transport(NamedTuple):
    """Pairs of patches that see one another, each pair once; a hollow patch sees itself.

    Parameters
    ----------
    one, other : (m,) int64
        Patches.
    form_factor : (m, 2) float64
        Share of the light that the first, and that the second of a pair receives which the other can send:
        the mean over the receiver of ∫ cos θ cos θ' / (π d²) V dA over the sender.
    way : (m, 2) float64
        Mean, m, and variance, m², of the distances between points of both.
    near : (k,) int64
        Pairs that are near one another.
    moment : (k, 2, 3) float64
        Of these, for light that slopes over the sender: the integral of `form_factor` times the place from the
        sender's centre, m.
    slopes : Slopes
        Of the light along the patches.
    """

    one: NDArray[np.int64]
    other: NDArray[np.int64]
    form_factor: NDArray[np.float64]
    way: NDArray[np.float64]
    near: NDArray[np.int64]
    moment: NDArray[np.float64]
    slopes: Slopes

    def operator(self, wave_number: float, *, single: bool = False) -> Operator:
        """Return the map from the light that leaves patches to that which arrives at them.

        Parameters
        ----------
        wave_number : float
            κ = 2πf / c, rad/m; 0: of intensities, real.
        single : bool
            Whether its numbers are of single precision.
        """
        n, near = self.slopes.x.shape[0], self.near
        mean, variance = self.way.T
        real = np.float32 if single else np.float64
        dtype = np.result_type(real, np.complex64) if wave_number else real
        turned = np.ones(len(mean))
        if wave_number:
            turned = np.exp(1j * wave_number * mean - 0.5 * wave_number**2 * variance)
        even = (self.form_factor * turned[:, None]).astype(dtype)
        sloping = (self.moment * turned[near, None, None]).astype(dtype)
        receivers = np.concatenate([self.one[near], self.other[near]])
        senders = np.concatenate([self.other[near], self.one[near]])
        axes = np.arange(3)[:, None]
        places = np.tile(receivers, 3), (senders + n * axes).ravel()
        pairs = np.r_[self.one, self.other], np.r_[self.other, self.one]
        return Operator(
            sparse.csr_array((even.T.ravel(), pairs), shape=(n, n)),
            sparse.csr_array((sloping.transpose(2, 1, 0).ravel(), places), shape=(n, 3 * n)),
            sparse.vstack(self.slopes).tocsr().astype(real),
        )


class Operator(NamedTuple):
    """Map from light that leaves n patches to light that arrives at them, which `@` applies.

    Parameters
    ----------
    even : (n, n) sparse array
        Of the means over the senders.
    sloping : (n, 3n) sparse array
        Of the slopes over those that are near, axis by axis.
    slopes : (3n, n) sparse array
    """

    even: sparse.csr_array
    sloping: sparse.csr_array
    slopes: sparse.csr_array

    def __matmul__(self, leaving: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(self.even @ leaving + self.sloping @ (self.slopes @ leaving))


def transport_between(patches: Patches) -> Transport:
    """Return the transport between all patches that see one another.

    Raises
    ------
    UsageError
        It does not fit into memory.
    """
    n, found = len(patches), []
    gib = _BYTES * n * n / 2**30
    if gib > _MOST_GIB:
        raise UsageError(
            f"light that bounces between {n} patches takes up to {gib:.0f} GiB, and {_MOST_GIB} are allowed: raise"
            " 'bounce_tolerance', render from fewer places at a time, or leave out bodies far from the camera's light"
        )
    rows = max(_PAIRS // n, 1)
    one, other, near = np.empty((3, rows * n), np.int64)
    factor, way = np.empty((2, rows * n, 2))
    far = np.empty(rows * n, np.bool_)
    moment = np.empty((rows * n, 2, 3))
    geometry = (
        patches.points, patches.normals, patches.weights, patches.centre, patches.normal, patches.area, patches.size,
    )  # fmt: skip
    polygons = patches.first, patches.members, patches.side, patches.facets.corners
    pairs = 0
    for start in range(0, n, rows):
        m, m_near = _form_factors(
            start, min(start + rows, n), geometry, polygons, one, other, factor, way, far, near, moment
        )
        visible = _visible(patches, geometry, one[:m], other[:m], far[:m])
        kept = visible > 0
        sloping = near[:m_near][kept[near[:m_near]]]
        of_pairs = one[:m][kept], other[:m][kept], factor[:m][kept] * visible[kept, None], way[:m][kept]
        moments = moment[:m_near][kept[near[:m_near]]] * visible[sloping, None, None]
        found.append((*of_pairs, pairs + (np.cumsum(kept) - 1)[sloping], moments))
        pairs += int(kept.sum())
    i, j, factors, ways, sloping, moments = (np.concatenate(column) for column in zip(*found, strict=True))
    received = np.bincount(i, factors[:, 0], n) + np.bincount(j, factors[:, 1], n)
    most = np.maximum(np.column_stack([received[i], received[j]]), 1.0)  # no patch receives more than all
    return Transport(i, j, factors / most, ways, sloping, moments / most[sloping, :, None], slopes_of(patches))


def slopes_of(patches: Patches) -> Slopes:
    """Return slopes fitted through neighbours that continue the surface, those nearer with more weight."""
    n, count = len(patches), min(_NEIGHBOURS, len(patches))
    length = np.linalg.norm(patches.normal, axis=1, keepdims=True)
    unit = patches.normal / length
    planes = np.column_stack([unit, np.einsum("ij,ij->i", unit, patches.centre)])
    near = np.empty((n, count), np.int64)
    flat_ones = length[:, 0] > 1 - _PLANE
    for own, apart_m in ((flat_ones, _SAME_PLANE_M), (~flat_ones, 0.0)):
        places = np.column_stack([patches.centre, apart_m * planes])
        near[own] = cKDTree(places).query(places[own], k=count)[1].reshape(-1, count)
    offset = patches.centre[near] - patches.centre[:, None]
    height = np.einsum("nkj,nj->nk", offset, unit)
    distance = np.linalg.norm(offset, axis=2)
    least = np.where(flat_ones, 1 - _PLANE, _ALIKE)[:, None]
    beside = (patches.body[near] == patches.body[:, None]) & (patches.albedo[near] == patches.albedo[:, None])
    beside &= np.einsum("nkj,nj->nk", unit[near], unit) > least
    beside &= (np.abs(height) < _BESIDE * distance) & (distance > 0)
    flat = offset - height[:, :, None] * unit[:, None]
    weight = np.where(beside, 1 / (distance**2 + (0.5 * patches.size[:, None]) ** 2), 0.0)
    normal_equations = np.einsum("nk,nki,nkj->nij", weight, flat, flat)
    along_normal = unit[:, :, None] * unit[:, None]  # no slope out of the surface
    slightly = 0.1  # no slope in a direction in which no neighbour lies as far as the patch is large
    inverse = np.linalg.inv(normal_equations + along_normal + slightly * np.eye(3))
    shares = np.einsum("nij,nkj,nk->ink", inverse, flat, weight)
    rows = np.repeat(np.arange(n), count)
    maps = []
    for share in shares:
        own = sparse.coo_array((share.ravel(), (rows, near.ravel())), shape=(n, n))
        middle = sparse.coo_array((share.sum(axis=1), (np.arange(n), np.arange(n))), shape=(n, n))
        maps.append((own - middle).tocsr())
    return Slopes(*maps)


def _visible(
    patches: Patches, geometry: Any, one: NDArray[np.int64], other: NDArray[np.int64], far: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return which share of the light between pairs of patches nothing stands in the way of, (m,).

    Points in the middle say so of those that are far from one another, four pairs of points of the others.
    """
    m = len(one)
    middles = patches.outlook + patches.lift_m * patches.normal
    points = patches.points + patches.lift_m * patches.normals
    begin, along = np.empty((2, POINTS * m, 3), np.float32)
    pair, share = np.empty(POINTS * m, np.int64), np.empty(POINTS * m)
    n_rays = _fill_rays(one, other, far, geometry, middles, points, begin, along, pair, share)
    facet = patches.intersector.first_face(begin[:n_rays], along[:n_rays])
    visible = np.empty(m)
    _sum_seen(begin, along, pair, share, facet, patches.facets.normals, patches.facets.corners, visible)
    visible[one == other] = 1.0
    return visible


@kernel
def _fill_rays(one, other, far, geometry, middles, points, begin, along, pair, share):  # type: ignore[no-untyped-def]
    """Write rays between pairs of patches with the light that each stands for; return how many."""
    at, normals = geometry[0], geometry[1]
    count = 0
    for p in range(len(one)):
        i, j = one[p], other[p]
        for k in range(1 if far[p] else POINTS):
            share[count] = 1.0 if far[p] else _kernel(at[i, k], normals[i, k], at[j, k], normals[j, k])
            if share[count] > 0.0:
                pair[count] = p
                for axis in range(3):
                    begins = middles[i, axis] if far[p] else points[i, k, axis]
                    begin[count, axis] = begins
                    along[count, axis] = (middles[j, axis] if far[p] else points[j, k, axis]) - begins
                count += 1
    return count


@kernel
def _sum_seen(begin, along, pair, share, facet, normals, corners, visible):  # type: ignore[no-untyped-def]
    """Write the share of each pair's light whose rays meet nothing before their end."""
    for p in range(len(visible)):
        visible[p] = 0.0
    ray = 0
    while ray < len(facet):
        p, seen, total = pair[ray], 0.0, 0.0
        while ray < len(facet) and pair[ray] == p:
            f = facet[ray]
            facing, height = 0.0, 0.0
            if f >= 0:
                for axis in range(3):
                    facing += normals[f, axis] * along[ray, axis]
                    height += normals[f, axis] * (corners[f, 0, axis] - begin[ray, axis])
            if f < 0 or (facing != 0.0 and height / facing >= 1.0):
                seen += share[ray]
            total += share[ray]
            ray += 1
        visible[p] = seen / total


@inner
def _kernel(p, n, q, m):  # type: ignore[no-untyped-def]
    """Return cos θ cos θ' / (π d²) between a point p with normal n and q with normal m."""
    x, y, z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    receives, sends = x * n[0] + y * n[1] + z * n[2], -(x * m[0] + y * m[1] + z * m[2])
    if receives <= 0.0 or sends <= 0.0:
        return 0.0
    square = x * x + y * y + z * z
    return receives * sends / (math.pi * square * square)


@kernel
def _form_factors(start, stop, geometry, polygons, one, other, factor, way, far, near, moment):  # type: ignore[no-untyped-def]
    """Write pairs of patches, the first from `start` to `stop`, as if nothing stood between; return how many.

    `near` are those over which light slopes, with a `moment` each; their number is returned, too.
    """
    points, normals, weights, centre, normal, area, size = geometry
    count, count_near = 0, 0
    for i in range(start, stop):
        for j in range(i, len(area)):
            x, y, z = centre[j, 0] - centre[i, 0], centre[j, 1] - centre[i, 1], centre[j, 2] - centre[i, 2]
            reach = max(size[i], size[j])
            if x * normal[i, 0] + y * normal[i, 1] + z * normal[i, 2] < -reach:
                continue
            if x * normal[j, 0] + y * normal[j, 1] + z * normal[j, 2] > reach:
                continue
            if normal[i, 0] * normal[j, 0] + normal[i, 1] * normal[j, 1] + normal[i, 2] * normal[j, 2] > _FLAT:
                continue  # planes that face the same way
            distance = math.sqrt(x * x + y * y + z * z)
            total, first, second = 0.0, 0.0, 0.0
            if distance > _NEAR * reach:
                total = _kernel(centre[i], normal[i], centre[j], normal[j])
                first, second = total * distance, total * distance * distance
            else:
                for k in range(POINTS):
                    for m in range(POINTS):
                        pair = _kernel(points[i, k], normals[i, k], points[j, m], normals[j, m])
                        if pair > 0.0:
                            pair *= weights[i, k] * weights[j, m]
                            square = 0.0
                            for axis in range(3):
                                square += (points[i, k, axis] - points[j, m, axis]) ** 2
                            total += pair
                            first += pair * math.sqrt(square)
                            second += pair * square
            if total == 0.0:
                continue
            one[count], other[count], far[count] = i, j, distance > _NEAR * reach
            way[count, 0] = first / total
            way[count, 1] = max(second / total - way[count, 0] * way[count, 0], 0.0)
            if distance > _CLOSE * reach:
                factor[count, 0], factor[count, 1] = area[j] * total, area[i] * total
            else:
                factor[count, 0] = _closely(i, j, geometry, polygons)
                factor[count, 1] = 0.0 if i == j else _closely(j, i, geometry, polygons)
            if distance < _SLOPING * reach and i != j:
                near[count_near] = count
                _fill_moment(i, j, geometry, factor[count, 0] / total, factor[count, 1] / total, moment[count_near])
                count_near += 1
            count += 1
    return count, count_near


@inner
def _fill_moment(i, j, geometry, of_one, of_other, moment):  # type: ignore[no-untyped-def]
    """Write the moments of a pair: of the kernel between its points, in units of `of_one` and `of_other`."""
    points, normals, weights, centre, _, _, _ = geometry
    for axis in range(3):
        moment[0, axis], moment[1, axis] = 0.0, 0.0
    for k in range(POINTS):
        for m in range(POINTS):
            pair = _kernel(points[i, k], normals[i, k], points[j, m], normals[j, m]) * weights[i, k] * weights[j, m]
            for axis in range(3):
                moment[0, axis] += of_one * pair * (points[j, m, axis] - centre[j, axis])
                moment[1, axis] += of_other * pair * (points[i, k, axis] - centre[i, axis])


@inner
def _closely(i, j, geometry, polygons):  # type: ignore[no-untyped-def]
    """Return the mean form factor of patch j at the points of patch i, from the closed form of the facets of j.

    At each point, form factors of all senders add up to what they are together: where surfaces touch, the large
    errors of the mean over four points cancel between senders beside one another.
    """
    points, normals, weights, _, _, _, _ = geometry
    first, members, side, corners = polygons
    total = 0.0
    for k in range(POINTS):
        for m in range(first[j], first[j + 1]):
            form_factor = triangle_form_factor(points[i, k], normals[i, k], corners[members[m]], side[j])
            total += weights[i, k] * form_factor
    return total
