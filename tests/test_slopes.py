"""Slopes of phasors by differences of images, and from the samples of an image, against closed forms and each other."""

import math
from typing import Any

import numpy as np
import pytest
import trimesh
from builders import sheet
from oracles.images import mean_of_blocks, sphere_pixels

from phasemark import UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Renderer, Views, preset

VIEW = ("distance_m", "delta_rad", "bearing_rad", "height_m")
PMD = preset("pmd-16x16")
TAN = math.tan(math.radians(11))
WAVE = 1 / PMD.metres_per_radian
X, W = np.polynomial.legendre.leggauss(8)


def by_complex_step(function, at):
    """Differentiate a function of real and imaginary part, both real analytic, to rounding."""
    re, im = function(at + 1e-30j)
    return (re.imag + 1j * im.imag) / 1e-30


def clip(value, low, high):
    """Clip by the real part, keeping the complex step of what is kept."""
    return low if value.real < low else high if value.real > high else value


def plane_over(low_u, high_u, low_v, high_v, normal, offset, albedo=0.8):
    """Return Re and Im of S over all pixels of a plane normal · p = offset seen in a rectangle of the image."""
    re, im = np.zeros((16, 16), complex), np.zeros((16, 16), complex)
    for row in range(16):
        v0, v1 = clip(low_v, row, row + 1), clip(high_v, row, row + 1)
        v, wv = v0 + (v1 - v0) * (X + 1) / 2, (v1 - v0) * W / 2
        z = TAN * (1 - v / 8)
        for col in range(16):
            u0, u1 = clip(low_u, col, col + 1), clip(high_u, col, col + 1)
            u, wu = u0 + (u1 - u0) * (X + 1) / 2, (u1 - u0) * W / 2
            y = TAN * (1 - u / 8)
            length = np.sqrt(1 + y[None] ** 2 + z[:, None] ** 2)
            facing = (normal[0] + normal[1] * y[None] + normal[2] * z[:, None]) / length
            r = offset / facing
            light = albedo * facing / r**2 * wv[:, None] * wu
            re[row, col], im[row, col] = (light * np.cos(WAVE * r)).sum(), (light * np.sin(WAVE * r)).sum()
    return re, im


def facing_plane(distance, delta, bearing):
    """Return the rectangle, normal and offset of the landmark's plane x' = 0 where it fills the image."""
    turn = bearing - delta
    return (0j, 16 + 0j, 0j, 16 + 0j), (np.cos(turn), np.sin(turn), 0), distance * np.cos(delta)


def by_differences(renderer, *view, **options):
    """Return slopes by differences of images, (n, parameters, rows, cols)."""
    return renderer.jacobian(*view, **options)


def with_images(renderer, *view, **options):
    """Return slopes that come with the images, and see that the images are those rendered alone."""
    views = Views.broadcast(*view)
    images, slope = renderer.render_with_slopes(views, VIEW, **options)
    np.testing.assert_array_equal(images.phasor, renderer.render_views(views, **options).phasor)
    return slope


@pytest.mark.parametrize(("slopes_of", "rounding"), [(by_differences, 1e-9), (with_images, 1e-7)])
@pytest.mark.parametrize("view", [(1.0, 0.0, 0.0), (1.4, 0.5, 0.02), (0.9, -0.3, -0.04)])
def test_a_plane_has_the_slopes_of_the_closed_form(view, slopes_of, rounding):
    plate = trimesh.creation.box((0.01, 9, 9)).apply_translation((0.005, 0, 0))
    slope = slopes_of(Renderer(plate, PMD), *view, 0.03)
    assert slope.shape == (1, 4, 16, 16)
    for k in range(3):

        def moved(value, k=k):
            limits, normal, offset = facing_plane(*(value if i == k else view[i] for i in range(3)))
            return plane_over(*limits, normal, offset)

        exact = by_complex_step(moved, view[k])
        # two Gauss points a pixel and axis leave 1e-6 of S; rounding of S (1e-16) 1e-11 over 2e-5, 1e-8 over 3e-8
        np.testing.assert_allclose(slope[0, k], exact, atol=3e-6 * np.abs(exact).max() + rounding)
    # an upright plane looks the same from any height
    assert np.abs(slope[0, 3]).max() < (1e-9 if slopes_of is by_differences else 1e-6)


def sheet_limits(distance, bearing, height):
    """Return what is seen of the sheet x' = 0, |y'| ≤ 0.06, |z'| ≤ 0.05 at δ = bearing, which faces the camera."""
    # δ = b keeps the sheet parallel to the image; its middle is at (D cos b, D sin b, h)
    x, y = distance * np.cos(bearing), distance * np.sin(bearing)
    u = [8 * (1 - (y + s * 0.06) / (x * TAN)) for s in (1, -1)]
    v = [8 * (1 - (height + s * 0.05) / (x * TAN)) for s in (1, -1)]
    return (*u, *v), (1, 0, 0), x


def moving_edges(name, distance, bearing, height):
    """Return the closed form's slope of what is seen of the sheet."""

    def moved(value):
        d, h = (value, height) if name == "distance_m" else (distance, value)
        limits, normal, offset = sheet_limits(d + 0j, bearing, h + 0j)
        return plane_over(*limits, normal, offset)

    exact = by_complex_step(moved, distance if name == "distance_m" else height)
    assert np.abs(exact).max() > 2  # an edge that moves changes far more than a surface that recedes
    return exact


SHEET = sheet((-0.06, 0.06), (-0.05, 0.05))
# so thin that its sides, which turn away from a lens before its middle, are behind its front
THIN = trimesh.creation.box((1e-9, 0.12, 0.1))


@pytest.mark.parametrize("name", ["distance_m", "height_m"])
@pytest.mark.parametrize(
    ("slopes_of", "mesh", "bearing", "height"),
    [(by_differences, SHEET, 0.02, 0.013), (with_images, THIN, 0.02, 0.013), (with_images, THIN, 0.0, 0.004)],
    ids=["differences", "slanted edges", "edges along the rows"],
)
def test_edges_move_as_the_closed_form_says(name, slopes_of, mesh, bearing, height):
    slope = slopes_of(Renderer(mesh, PMD), 1.03, bearing, bearing, height)[0, VIEW.index(name)]
    exact = moving_edges(name, 1.03, bearing, height)
    # the integral's own error, 1e-6, and s²
    np.testing.assert_allclose(slope, exact, atol=1e-5 * np.abs(exact).max())


def test_the_slopes_of_a_sphere_are_those_of_its_closed_form():
    renderer = Renderer(build_mesh(catalog()["sphere"], part="upper"), PMD)
    distance, bearing, height, step = 1.1, 0.02, -0.05, 2e-4
    differences, slope = (how(renderer, distance, 0.7, bearing, height)[0] for how in (by_differences, with_images))

    def phasor(d, b, h):
        return sphere_pixels(PMD, (d * math.cos(b), d * math.sin(b), 0.075 + h), 0.075, 0.8, n=4000)[0]

    at = np.array([distance, bearing, height])
    for k, row in enumerate((0, 2, 3)):
        move = step * np.eye(3)[k]
        exact = (phasor(*(at + move)) - phasor(*(at - move))) / (2 * step)
        # the limb's facets stand still while the limb of a true sphere glides: 1 %; the oracle's lines in z leave 1e-3
        assert np.abs(differences[row] - exact).max() < 0.015 * np.abs(exact).max()
        # shading normals are interpolated along facets: 1.5 % of the largest slope beside the limb
        assert np.abs(slope[row] - exact).max() < 0.02 * np.abs(exact).max()
    # turning a sphere changes nothing but its facets
    assert np.abs(differences[1]).max() < 1e-3 * np.abs(differences).max()


@pytest.mark.parametrize("name", list(catalog()))
def test_derivatives_agree_with_those_of_finer_pixels(name):
    mesh = build_mesh(catalog()[name])
    view: dict[str, Any] = {
        "distance_m": [0.87, 1.31, 1.9],
        "delta_rad": [0.3, 1.2, 2.4],
        "bearing_rad": 0.013,
        "height_m": 0.021,
    }
    background = Background(wall_m=4.0, floor_m=0.2)
    coarse = Renderer(mesh, PMD).jacobian(**view, background=background)
    fine = Renderer(mesh, PMD.with_(rows=64, cols=64)).jacobian(**view, background=background)
    mean = mean_of_blocks(fine.reshape(-1, 64, 64), 4).reshape(coarse.shape)
    error = np.abs(coarse - mean).max(axis=(2, 3)) / np.abs(mean).max(axis=(2, 3))
    # the integral's own error of up to 1e-4 changes along with the edges' places in their pixels. It shows most where
    # the slope is least: a sphere's facets that turn with δ
    assert error.max() < 0.06
    assert np.median(error) < 0.005


def test_height_has_the_slope_towards_the_hidden_top_at_the_interface():
    mesh = build_mesh(catalog()["cylinder"])
    renderer = Renderer(mesh, PMD)
    view: dict[str, Any] = {"distance_m": 1.0, "delta_rad": 0.4, "bearing_rad": 0.003}
    at_zero = renderer.jacobian(**view, height_m=[0.0, 3e-6, -3e-6], parameters=("height_m",))[:, 0]
    above = renderer.jacobian(**view, height_m=5e-5, parameters=("height_m",))[0, 0]
    below = renderer.jacobian(**view, height_m=-5e-5, parameters=("height_m",))[0, 0]
    largest = np.abs(above).max()
    assert np.abs(above - below).max() > 0.1 * largest  # the kink is there
    # in 5e-5 m the image moves by 2e-3 pixels; the box's slanted foot makes slopes change by some ten times that
    for slope, expected in zip(at_zero, (above, above, below), strict=True):
        assert np.abs(slope - expected).max() < 0.04 * largest


def test_a_landmark_that_stands_on_the_floor_has_derivatives():
    renderer = Renderer(build_mesh(catalog()["post"]), PMD)
    jacobian = renderer.jacobian(1.0, 0.3, 0.0, 0.03, background=Background(floor_m=0.12))
    assert np.isfinite(jacobian).all()


@pytest.mark.parametrize("name", list(catalog()))
@pytest.mark.parametrize("background", [None, Background(wall_m=4.0), Background(wall_m=3.0, floor_m=0.5)], ids=str)
def test_slopes_are_those_of_differences_of_images(name, background):
    rng = np.random.default_rng(7)
    view = rng.uniform(0.8, 1.6, 12), rng.uniform(0, 6, 12), rng.normal(0, 0.04, 12), rng.normal(0, 0.03, 12)
    renderer = Renderer(build_mesh(catalog()[name]), PMD)
    slope = with_images(renderer, *view, background=background)
    differences = renderer.jacobian(*view, background=background)
    error = np.abs(slope - differences) / np.abs(differences).max(axis=(0, 2, 3))[:, None, None]
    # differences jump where an edge passes a corner of a pixel within their width; limbs as on the sphere
    assert np.quantile(error, 0.99) < 0.01
    assert error.max() < 0.08


@pytest.mark.parametrize("name", ["cone", "sphere"])
def test_what_a_landmark_returns_alone_is_split_from_what_stands_behind_it(name):
    views = Views.broadcast([1.0, 1.2, 1.4], [0.1, 2.0, 4.0], [0.05, -0.1, 0.0], [0.0, 0.01, -0.02], [0.0, 0.03, 0.1])
    behind = [Background(wall_m=2.5), Background(wall_m=3.0, floor_m=0.4), None]
    renderer, names = (
        Renderer(build_mesh(catalog()[name]), PMD),
        ("distance_m", "delta_rad", "bearing_rad", "pitch_rad"),
    )
    images, slope, alone, alone_slope = renderer.render_split(views, names, background=behind)
    whole, whole_slope = renderer.render_with_slopes(views, names, background=behind)
    expected, expected_slope = renderer.render_with_slopes(views, names)
    np.testing.assert_array_equal(images.phasor, whole.phasor)
    np.testing.assert_array_equal(slope, whole_slope)
    np.testing.assert_allclose(alone.phasor, expected.phasor, atol=1e-12 * np.abs(expected.phasor).max())
    np.testing.assert_allclose(alone_slope, expected_slope, atol=1e-6 * np.abs(expected_slope).max())


def test_open_meshes_get_differences_of_images():
    renderer, view = Renderer(SHEET, PMD), (1.0, 0.3, 0.01, 0.02)
    np.testing.assert_array_equal(with_images(renderer, *view), by_differences(renderer, *view))


def test_parameters_come_in_the_order_asked_for_and_views_broadcast():
    renderer = Renderer(build_mesh(catalog()["cone"]), PMD)
    view: dict[str, Any] = {"distance_m": np.array([[0.9], [1.3]]), "delta_rad": np.array([0.2, 0.8, 1.4])}
    all_four = renderer.jacobian(**view, workers=2)
    some = renderer.jacobian(**view, parameters=("height_m", "distance_m"))
    assert all_four.shape == (6, 4, 16, 16)
    np.testing.assert_array_equal(some, all_four[:, [3, 0]])
    assert renderer.jacobian([]).shape == (0, 4, 16, 16)


def test_parameters_come_in_the_order_asked_for_and_threads_change_nothing():
    renderer = Renderer(build_mesh(catalog()["post"]), PMD)
    views = Views.broadcast(np.linspace(0.9, 1.4, 150), 0.3, 0.02, 0.01)
    _, both = renderer.render_with_slopes(views, ("bearing_rad", "distance_m"), workers=2)
    np.testing.assert_array_equal(both, with_images(renderer, views.distance_m, 0.3, 0.02, 0.01)[:, [2, 0]])


@pytest.mark.parametrize("parameters", [(), ("distance",), ("height_m", "height_m")])
def test_parameters_that_are_none_are_refused(parameters):
    with pytest.raises(UsageError, match="'parameters' must"):
        Renderer(None, PMD).jacobian(1.0, parameters=parameters)
    with pytest.raises(UsageError, match="'parameters' must"):
        Renderer(None, PMD).render_with_slopes(Views.broadcast(1.0), parameters)


def test_views_are_checked_as_for_rendering():
    renderer = Renderer(build_mesh(catalog()["cone"]), PMD)
    with pytest.raises(UsageError, match="the lens is inside"):
        renderer.jacobian(0.1)
    with pytest.raises(UsageError, match="the wall at"):
        renderer.jacobian(1.0, background=Background(wall_m=1.0))
