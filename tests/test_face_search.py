"""Faces found without an intersector are those that a ray meets first."""

from itertools import pairwise

import numba
import numpy as np
import pytest
import trimesh
from numba.core.cpu import CPUTargetOptions

from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Renderer, preset
from phasemark.render.integral.face_search import FaceGrid, find_face, plane_hit, turns_smoothly
from phasemark.render.integral.intersect import make_intersector
from phasemark.render.integral.mesh_topology import MeshTopology
from phasemark.render.kernel import kernel

PIXEL_RAD = 0.024  # of the 16 × 16 camera


@kernel
def found(search, grid, start, o, d):
    return find_face(search, grid, start, o[0], o[1], o[2], d[0], d[1], d[2])


@kernel
def smooth(search, f, g, o, d, e):
    t = plane_hit(search, f, o[0], o[1], o[2], d[0], d[1], d[2])
    u = plane_hit(search, g, o[0], o[1], o[2], e[0], e[1], e[2])
    return turns_smoothly(search, f, g, u * e[0] - t * d[0], u * e[1] - t * d[1], u * e[2] - t * d[2])


def searchable(mesh):
    """Return the topology of a mesh with all its curved faces in the grid."""
    topology = MeshTopology.from_mesh(mesh)
    grid = FaceGrid.of_faces(topology.vertices[topology.faces], ~topology.plain)
    return topology._replace(grid=grid)


def rays(topology, n, rng):
    """Return pairs of rays half a pixel apart at most, and the faces they meet first: origins, ray, ray, face, face."""
    azimuth, height = rng.uniform(0, 2 * np.pi, n), rng.uniform(-0.1, 0.3, n)
    origins = np.column_stack([np.cos(azimuth), np.sin(azimuth), height])
    targets = topology.vertices[rng.integers(len(topology.vertices), size=n)] * rng.uniform(0, 1, (n, 1))
    first = targets - origins
    second = first + np.linalg.norm(first, axis=1)[:, None] * rng.uniform(-PIXEL_RAD / 4, PIXEL_RAD / 4, (n, 3))
    intersector = make_intersector(topology.vertices, topology.faces, "float64")
    o = origins.astype(np.float32)
    faces = [intersector.first_face(o, d.astype(np.float32)) for d in (first, second)]
    return origins.astype(np.float64), first, second, *faces


@pytest.mark.parametrize("name", sorted(catalog()))
def test_the_search_from_a_neighbouring_sample_finds_the_face_that_an_intersector_finds(name):
    topology = searchable(build_mesh(catalog()[name]))
    origins, first, second, start, met = rays(topology, 3000, np.random.default_rng(3))
    tried, missed = 0, 0
    for o, d, e, f, g in zip(origins, first, second, start, met, strict=True):
        if f < 0 or g < 0 or topology.plain[f] or topology.patch[f] != topology.patch[g]:
            continue
        tried += 1
        h, t = found(topology.search, topology.grid, f, o, e)
        if h < 0:
            missed += 1  # a missed sample is cast
            continue
        # float32 may take the face on the other side of an edge, where the surface is the same
        plane = topology.planes[g]
        assert t == pytest.approx((plane[3] - plane[:3] @ o) / (plane[:3] @ e), abs=2e-6)
        assert smooth(topology.search, f, h, o, d, e)
    assert tried > 300
    assert missed < 0.05 * tried


def test_beyond_the_limb_nothing_is_found():
    topology = searchable(trimesh.creation.icosphere(subdivisions=4, radius=0.1))
    lens = np.array([1.0, 0.0, 0.0])
    intersector = make_intersector(topology.vertices, topology.faces, "float64")
    inside = np.array([-1.0, 0.05, 0.0])
    (start,) = intersector.first_face(lens[None].astype(np.float32), inside[None].astype(np.float32))
    for y in (0.102, 0.11, 0.3):
        assert found(topology.search, topology.grid, start, lens, np.array([-1.0, y, 0.0]))[0] == -1


def test_a_sheet_behind_the_one_that_is_seen_is_not_taken_for_its_neighbour():
    # a vase: one smooth patch whose upper bulge hides a part of the lower one
    z = np.linspace(-0.1, 0.1, 61)
    radius = 0.05 + 0.02 * np.cos(2 * np.pi * z / 0.1)
    profile = np.column_stack([np.r_[0, radius, 0], np.r_[z[0], z, z[-1]]])
    topology = searchable(trimesh.creation.revolve(profile, sections=128))
    lens = np.array([0.15, 0.0, 0.2])
    target = np.array([0.07, 0.0, 0.0])
    intersector = make_intersector(topology.vertices, topology.faces, "float64")

    def face(d):
        return int(intersector.first_face(lens[None].astype(np.float32), d[None].astype(np.float32))[0])

    up = np.array([1.0, 0.0, 0.4])
    # the samples on either side of the bulge's limb
    heights = np.linspace(-0.02, 0.06, 400)
    hits = [(h, face(target + h * up - lens)) for h in heights]
    jumps = 0
    for (h, f), (k, g) in pairwise(hits):
        if f < 0 or g < 0 or topology.plain[f] or topology.plain[g]:
            continue
        d, e = target + h * up - lens, target + k * up - lens
        far = np.linalg.norm(
            topology.vertices[topology.faces[f]].mean(0) - topology.vertices[topology.faces[g]].mean(0)
        )
        if far > 0.02:
            jumps += 1
            assert not smooth(topology.search, f, g, lens, d, e)
    assert jumps >= 1


def test_the_faces_beyond_an_edge_have_each_other_for_neighbours():
    topology = MeshTopology.from_mesh(build_mesh(catalog()["cone"]))
    neighbours = topology.search[:, 12:15].astype(int)
    f, side = np.nonzero(neighbours >= 0)
    back = neighbours[neighbours[f, side]]
    assert (back == f[:, None]).any(axis=1).all()
    assert (topology.patch[f] == topology.patch[neighbours[f, side]]).all()


@pytest.mark.skipif(not hasattr(CPUTargetOptions, "_nrt"), reason="this numba always counts references")
def test_a_kernel_that_makes_an_array_is_refused():
    with pytest.raises(numba.core.errors.NumbaError):
        kernel(lambda n: np.zeros(n))(3)


def test_the_same_image_comes_from_the_search_and_from_rays_alone():
    mesh = build_mesh(catalog()["cone"])
    searched = Renderer(mesh, preset("pmd-16x16"))
    cast = Renderer(mesh, preset("pmd-16x16"))
    cast._integral.topology = cast.topology._replace(split=False)
    distance_m, delta_rad = np.linspace(0.8, 2.0, 20), np.linspace(0.0, 3.0, 20)
    one, other = searched.render(distance_m, delta_rad), cast.render(distance_m, delta_rad)
    assert np.abs(one.phasor - other.phasor).max() <= 1e-4 * np.abs(other.phasor).max()


def test_bulges_and_patches_with_an_apex_are_searched_and_hollows_are_not():
    z = np.linspace(-0.1, 0.1, 61)
    waisted = np.column_stack([np.r_[0, 0.05 + 0.02 * np.cos(20 * np.pi * z), 0], np.r_[z[0], z, z[-1]]])
    vase = MeshTopology.from_mesh(trimesh.creation.revolve(waisted, sections=64))
    assert not vase.searched.any()
    for spec in catalog().values():
        topology = MeshTopology.from_mesh(build_mesh(spec))
        np.testing.assert_array_equal(topology.searched, ~topology.plain)


@pytest.mark.parametrize("name", sorted(catalog()))
def test_hardly_any_ray_but_the_scouts_is_cast_on_a_bulge(name, monkeypatch):
    renderer = Renderer(build_mesh(catalog()[name]), preset("pmd-16x16"))
    cast, counts = renderer._integral.intersector.first_face, []

    def counted(origins, directions):
        counts.append(len(origins))
        return cast(origins, directions)

    monkeypatch.setattr(renderer._integral.intersector, "first_face", counted)
    renderer.render(np.linspace(0.75, 2.0, 40), np.linspace(0, 3, 40), 0.02, 0.03)
    scouts, others = sum(counts[::2]), sum(counts[1::2])
    # on the cone one in seven near the apex, where slivers are thinner than the search can step over
    assert others < (0.2 if name == "cone" else 0.01) * scouts


def test_views_of_a_large_mesh_are_returned_in_the_order_they_came():
    renderer = Renderer(build_mesh(catalog()["sphere"]), preset("pmd-16x16"))
    distance, delta = np.array([1.0, 0.8, 1.5]), np.array([2.0, 0.1, 1.0])
    together = renderer.render(distance, delta)
    for k in range(3):
        alone = renderer.render(distance[k], delta[k])
        np.testing.assert_array_equal(together.phasor[k], alone.phasor[0])
        np.testing.assert_array_equal(together.coverage[k], alone.coverage[0])
