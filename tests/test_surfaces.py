"""Surfaces without a mesh library: the same triangles as meshes, and the same components as SciPy finds."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from phasemark.landmarks import build_mesh, catalog
from phasemark.landmarks.mesh import build_surface
from phasemark.render import Renderer, preset
from phasemark.render.integral.components import component_labels
from phasemark.render.integral.shells import _adjacent_faces, unite_shells


@pytest.mark.parametrize("name", list(catalog()))
@pytest.mark.parametrize("part", ["both", "lower"])
def test_a_surface_has_the_arrays_of_the_mesh(name, part):
    surface, mesh = build_surface(catalog()[name], part), build_mesh(catalog()[name], part)
    assert surface.vertices.dtype == mesh.vertices.dtype
    assert surface.faces.dtype == mesh.faces.dtype
    np.testing.assert_array_equal(surface.vertices, mesh.vertices)
    np.testing.assert_array_equal(surface.faces, mesh.faces)
    np.testing.assert_array_equal(surface.face_attributes["part"], mesh.face_attributes["part"])
    assert surface.metadata == mesh.metadata


def test_a_surface_is_rendered_as_its_mesh():
    sensor, spec = preset("pmd-16x16"), catalog()["cone"]
    of_surface, of_mesh = (Renderer(built(spec), sensor).render(1.0, 0.4) for built in (build_surface, build_mesh))
    np.testing.assert_array_equal(of_surface.phasor, of_mesh.phasor)
    assert Renderer(build_surface(spec), sensor).topology is Renderer(build_mesh(spec), sensor).topology


@pytest.mark.parametrize("n_pairs", [0, 10, 60, 300])
def test_components_are_numbered_as_scipy_numbers_them(n_pairs):
    rng = np.random.default_rng(n_pairs)
    pairs = rng.integers(0, 120, (n_pairs, 2))
    graph = coo_array((np.ones(n_pairs, bool), (pairs[:, 0], pairs[:, 1])), shape=(120, 120))
    np.testing.assert_array_equal(component_labels(120, pairs), connected_components(graph, directed=False)[1])


@pytest.mark.parametrize("seed", range(5))
def test_faces_are_adjacent_where_trimesh_says_so(seed):
    faces = np.random.default_rng(seed).integers(0, 12, (30, 3))
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])]
    found = {frozenset(pair) for pair in _adjacent_faces(faces).tolist()}
    assert found == {frozenset(pair) for pair in trimesh.graph.face_adjacency(faces).tolist()}


def test_shells_that_cross_are_united_and_others_are_left_alone():
    box = trimesh.creation.box((1, 1, 1))
    crossing, apart = (
        trimesh.Trimesh(
            np.vstack([box.vertices, box.vertices + shift]), np.vstack([box.faces, box.faces + 8]), process=False
        )
        for shift in (0.5, 2.0)
    )
    united = unite_shells(crossing)
    assert isinstance(united, trimesh.Trimesh)
    assert united.volume == pytest.approx(2 - 0.125)  # the overlap counts once
    assert unite_shells(apart) is apart
    assert unite_shells(box) is box
