"""Slopes that come with an image: against complex steps through closed forms, and against differences of images."""

import math

import numpy as np
import pytest
import trimesh
from oracles.images import sphere_pixels
from test_derivative import PMD, by_complex_step, facing_plane, plane_over, sheet_limits

from phasemark import UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Renderer, Views

VIEW = ("distance_m", "delta_rad", "bearing_rad", "height_m")


def slopes_of(renderer, distance_m, delta_rad=0.0, bearing_rad=0.0, height_m=0.0, **options):
    views = Views.broadcast(distance_m, delta_rad, bearing_rad, height_m)
    images, slope = renderer.render_with_slopes(views, VIEW, **options)
    np.testing.assert_array_equal(images.phasor, renderer.render_views(views, **options).phasor)
    return slope


@pytest.mark.parametrize("view", [(1.0, 0.0, 0.0), (1.4, 0.5, 0.02), (0.9, -0.3, -0.04)])
def test_a_plane_without_edges_has_the_slopes_of_the_closed_form(view):
    plate = trimesh.creation.box((0.01, 9, 9)).apply_translation((0.005, 0, 0))
    slope = slopes_of(Renderer(plate, PMD), *view, 0.03)
    for k in range(3):

        def moved(value, k=k):
            limits, normal, offset = facing_plane(*(value if i == k else view[i] for i in range(3)))
            return plane_over(*limits, normal, offset)

        exact = by_complex_step(moved, view[k])
        # two Gauss points a pixel and axis leave 1e-6 of S; rounding of S (1e-16) over 3e-8 leaves 1e-8
        np.testing.assert_allclose(slope[0, k], exact, atol=3e-6 * np.abs(exact).max() + 1e-7)
    assert np.abs(slope[0, 3]).max() < 1e-6  # an upright plane looks the same from any height


@pytest.mark.parametrize("name", ["distance_m", "height_m"])
@pytest.mark.parametrize(
    ("bearing", "height"), [(0.02, 0.013), (0.0, 0.004)], ids=["slanted edges", "edges along the rows"]
)
def test_edges_move_as_the_closed_form_says(name, bearing, height):
    # so thin that its sides, which turn away from a lens before its middle, are behind its front
    sheet = trimesh.creation.box((1e-9, 0.12, 0.1))
    distance = 1.03
    slope = slopes_of(Renderer(sheet, PMD), distance, bearing, bearing, height)[0, VIEW.index(name)]

    def moved(value):
        d, h = (value, height) if name == "distance_m" else (distance, value)
        limits, normal, offset = sheet_limits(d + 0j, bearing, h + 0j)
        return plane_over(*limits, normal, offset)

    exact = by_complex_step(moved, distance if name == "distance_m" else height)
    assert np.abs(exact).max() > 2  # an edge that moves changes far more than a surface that recedes
    np.testing.assert_allclose(slope, exact, atol=1e-5 * np.abs(exact).max())


def test_the_slopes_of_a_sphere_are_those_of_its_closed_form():
    mesh = build_mesh(catalog()["sphere"], part="upper")
    distance, bearing, height, step = 1.1, 0.02, -0.05, 2e-4
    slope = slopes_of(Renderer(mesh, PMD), distance, 0.7, bearing, height)[0]

    def phasor(d, b, h):
        return sphere_pixels(PMD, (d * math.cos(b), d * math.sin(b), 0.075 + h), 0.075, 0.8, n=4000)[0]

    at = np.array([distance, bearing, height])
    for k, row in enumerate((0, 2, 3)):
        move = step * np.eye(3)[k]
        exact = (phasor(*(at + move)) - phasor(*(at - move))) / (2 * step)
        # shading normals are interpolated along facets: 1.5 % of the largest slope beside the limb
        assert np.abs(slope[row] - exact).max() < 0.02 * np.abs(exact).max()


@pytest.mark.parametrize("name", list(catalog()))
@pytest.mark.parametrize("background", [None, Background(wall_m=4.0), Background(wall_m=3.0, floor_m=0.5)], ids=str)
def test_slopes_are_those_of_differences_of_images(name, background):
    rng = np.random.default_rng(7)
    view = rng.uniform(0.8, 1.6, 12), rng.uniform(0, 6, 12), rng.normal(0, 0.04, 12), rng.normal(0, 0.03, 12)
    renderer = Renderer(build_mesh(catalog()[name]), PMD)
    slope = slopes_of(renderer, *view, background=background)
    differences = renderer.jacobian(*view, background=background)
    error = np.abs(slope - differences) / np.abs(differences).max(axis=(0, 2, 3))[:, None, None]
    # differences jump where an edge passes a corner of a pixel within their width; limbs as on the sphere
    assert np.quantile(error, 0.99) < 0.01
    assert error.max() < 0.08


def test_open_meshes_get_differences_of_images():
    corners = [[0, -0.06, -0.05], [0, 0.06, -0.05], [0, 0.06, 0.05], [0, -0.06, 0.05]]
    renderer = Renderer(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False), PMD)
    np.testing.assert_array_equal(slopes_of(renderer, 1.0, 0.3, 0.01, 0.02), renderer.jacobian(1.0, 0.3, 0.01, 0.02))


def test_parameters_come_in_the_order_asked_for_and_threads_change_nothing():
    renderer = Renderer(build_mesh(catalog()["post"]), PMD)
    views = Views.broadcast(np.linspace(0.9, 1.4, 150), 0.3, 0.02, 0.01)
    _, both = renderer.render_with_slopes(views, ("bearing_rad", "distance_m"), workers=2)
    np.testing.assert_array_equal(both, slopes_of(renderer, views.distance_m, 0.3, 0.02, 0.01)[:, [2, 0]])


@pytest.mark.parametrize("parameters", [(), ("distance",), ("height_m", "height_m")])
def test_parameters_that_are_none_are_refused(parameters):
    with pytest.raises(UsageError, match="'parameters' must"):
        Renderer(None, PMD).render_with_slopes(Views.broadcast(1.0), parameters)
