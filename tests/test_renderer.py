"""The area integral against closed forms, against dense sampling, and against itself where it must not depend."""

import math
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import trimesh
from builders import ODD, block, joined, l_bracket, sheet, star_prism
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.images import (
    brute_force,
    image_points,
    integrate_pixels,
    mean_of_blocks,
    pixel_nodes,
    plane_light,
    sphere_light,
    sphere_pixels,
)

from phasemark import UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Renderer, Sensor, Views, preset
from phasemark.render.direct import SceneMesh
from phasemark.render.integral.intersect import make_intersector

PMD = preset("pmd-16x16")
POINT = PMD.with_(fill_factor=(1e-4, 1e-4))
TAN = math.tan(math.radians(11))
MESHES = {name: build_mesh(spec) for name, spec in catalog().items()}
CYLINDER = MESHES["cylinder"]


def epsilon(image, phasor):
    return np.abs(image - phasor).max() / np.abs(phasor).max()


# --- planes ---


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"fill_factor": (0.6, 0.8)},
        {"vignetting": True},
        {"pitch_deg": 5, "roll_deg": -20},
        {"rows": 6, "cols": 8, "half_angle_h_deg": 20, "half_angle_v_deg": 15, "principal_point_px": (5.0, 2.5)},
    ],
    ids=str,
)
@pytest.mark.parametrize("delta", [0.0, 0.6])
def test_a_plane_is_integrated_exactly(changes, delta):
    sensor = PMD.with_(**changes)
    image = Renderer(block((0, 0.01), (-9, 9), (-9, 9)), sensor, harmonics=(3, 5)).render(1.5, delta)
    # the plane x' = 0, whose normal is (cos δ, −sin δ, 0) in the camera's frame
    light = plane_light([math.cos(delta), -math.sin(delta), 0], 1.5 * math.cos(delta), 0.8)

    def seen(d):
        amplitude, range_m = light(d)
        return amplitude * ((d @ sensor.cam2level[:, 0]) ** 4 if sensor.vignetting else 1), range_m

    phasors, intensity = integrate_pixels(sensor, seen, orders=(1, 3, 5))
    assert (image.coverage == 1).all()
    # two Gauss points along each axis err in the fourth order; the pixels of the last camera are 5° wide, those of the
    # others 1.4°, and order k turns the phase k times as fast
    tolerance = 1e-6 if "rows" not in changes else 2e-4
    np.testing.assert_allclose(image.intensity[0], intensity, rtol=tolerance)
    for order, phasor in phasors.items():
        np.testing.assert_allclose(image.harmonic(order)[0], phasor, rtol=tolerance * order)


def test_harmonics_are_the_amplitude_times_powers_of_the_phase():
    image = Renderer(block((0, 0.01), (-9, 9), (-9, 9)), POINT, harmonics=(2, 3, 7)).render([1.0, 5.0])
    unit = image.phasor / image.amplitude
    for order in (2, 3, 7):
        # a pixel 1e-4 wide still has phases of its own, 1e-8 or so
        np.testing.assert_allclose(image.harmonic(order), image.amplitude * unit**order, rtol=1e-6)
    with pytest.raises(UsageError, match="harmonic 4 was not rendered"):
        image.harmonic(4)


# --- mixed pixels ---


@pytest.mark.parametrize(
    ("near_m", "far_m", "share", "range_m", "ratio"),
    [
        (3, 6, 0.50, 3.518, 0.882),
        (3, 6, 0.25, 4.253, 0.813),
        (2, 10, 0.25, 1.932, 0.788),
        (5, 12.4, 0.25, 5.090, 0.345),
        (1, 14, 0.25, 0.973, 0.995),
    ],
)
def test_two_surfaces_in_one_pixel_measure_what_the_physics_page_says(near_m, far_m, share, range_m, ratio):
    sensor = PMD.with_(rows=1, cols=1, half_angle_h_deg=0.01, half_angle_v_deg=0.01)
    edge = near_m * math.tan(math.radians(0.01)) * (1 - 2 * share)
    plates = joined([sheet((edge, 1), (-1, 1), near_m - 0.5), sheet((-9, 9), (-9, 9), far_m - 0.5)])
    image = Renderer(plates, sensor).render(0.5)
    assert image.range_m[0, 0, 0] == pytest.approx(range_m, abs=5.1e-4)  # the table's digits
    assert image.amplitude[0, 0, 0] / image.intensity[0, 0, 0] == pytest.approx(ratio, abs=5.1e-4)
    s1, s2 = share * 0.8 / near_m**2, (1 - share) * 0.8 / far_m**2
    wave = 1j / sensor.metres_per_radian
    exact = s1 * np.exp(wave * near_m) + s2 * np.exp(wave * far_m)
    assert image.phasor[0, 0, 0] == pytest.approx(exact, rel=1e-6)  # slant of 0.01°; float32 edges


def test_an_edge_shares_a_pixel_where_it_cuts_it():
    u, v = 7.3, 4.6
    y, z = TAN * (1 - 2 * u / 16), TAN * (1 - 2 * v / 16)
    row = Renderer(sheet((y, 2), (-2, 2)), PMD).render(1.0).coverage[0, 8]
    np.testing.assert_allclose(row[6:9], [1, 0.3, 0], atol=1e-9)  # rounding
    other = Renderer(sheet((-2, y), (-2, 2)), PMD).render(1.0).coverage[0, 8]
    np.testing.assert_allclose(other[6:9], [0, 0.7, 1], atol=1e-9)
    corner = Renderer(sheet((y, 2), (z, 2)), PMD).render(1.0).coverage[0]
    np.testing.assert_allclose(corner[3:6, 6:9], np.array([[1, 0.3, 0], [0.6, 0.18, 0], [0, 0, 0]]), atol=1e-9)


def test_a_slanted_edge_cuts_off_the_polygons_area():
    # from (4, 2) to (6, 10) in the image; the sheet lies left of that line
    (ua, va), (ub, vb) = (4.0, 2.0), (6.0, 10.0)

    def at(u, v):
        return [0.0, TAN * (1 - 2 * u / 16), TAN * (1 - 2 * v / 16)]

    def on_line(v):
        return ua + (v - va) * (ub - ua) / (vb - va)

    corners = [at(on_line(-4), -4), at(on_line(20), 20), at(-9, 20), at(-9, -4)]
    plate = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    coverage = Renderer(plate, PMD).render(1.0).coverage[0]
    # the line's mean place in row r is at its middle
    np.testing.assert_allclose(coverage.sum(axis=1), on_line(np.arange(16) + 0.5), atol=1e-9)
    assert coverage[2, 4] == pytest.approx(0.125, abs=1e-9)
    assert coverage[6, 5] == pytest.approx(0.125, abs=1e-9)


# --- a sphere ---


def test_a_sphere_is_integrated_to_the_renderers_budget():
    mesh = build_mesh(catalog()["sphere"], part="upper")
    image = Renderer(mesh, PMD).render(1.1, 0.7, 0.02, -0.05)
    centre = (1.1 * math.cos(0.02), 1.1 * math.sin(0.02), 0.075 - 0.05)
    phasor, intensity, coverage = sphere_pixels(PMD, centre, 0.075, 0.8)
    # the budget: 1e-4 in ε and 2e-4 in coverage, tessellation included
    assert epsilon(image.phasor[0], phasor) < 1e-4
    assert epsilon(image.intensity[0], intensity) < 1e-4
    assert np.abs(image.coverage[0] - coverage).max() < 2e-4


def test_range_and_brightness_on_a_sphere_follow_the_closed_form():
    mesh = build_mesh(catalog()["sphere"], part="upper")
    image = Renderer(mesh, POINT).render(1.1)
    d = POINT.pixel_directions()
    amplitude, range_m = sphere_light(d, np.array([1.1, 0, 0.075]), 0.075, 0.8)
    inside = np.arccos(d @ [1.1, 0, 0.075] / math.hypot(1.1, 0.075)) < 0.9 * math.asin(0.075 / math.hypot(1.1, 0.075))
    assert inside.sum() > 15
    np.testing.assert_allclose(image.range_m[0][inside], range_m[inside], atol=2e-5)  # sagitta of the facets / cos θ
    np.testing.assert_allclose(image.amplitude[0][inside], amplitude[inside], rtol=1e-3)  # interpolated normals


# --- background ---


def background_light(wall_m, floor_m, bearing):
    """Return the light of wall and floor along rays, albedo 0.5 and 0.3."""

    def light(d):
        forward = d[..., 0] * math.cos(bearing) + d[..., 1] * math.sin(bearing)
        down = -d[..., 2]
        with np.errstate(divide="ignore"):
            wall = np.where(forward > 0, (wall_m or math.inf) / forward, math.inf)
            floor = np.where(down > 0, (floor_m or math.inf) / down, math.inf)
        range_m = np.minimum(wall, floor)
        amplitude = np.where(wall < floor, 0.5 * forward, 0.3 * down) / range_m**2
        return np.where(np.isfinite(range_m), amplitude, 0), np.where(np.isfinite(range_m), range_m, 0)

    return light


@pytest.mark.parametrize(("wall_m", "floor_m"), [(3.0, None), (3.0, 0.2), (None, 0.2)])
def test_wall_and_floor_are_integrated_up_to_where_they_meet(wall_m, floor_m):
    background = Background(wall_m=wall_m, floor_m=floor_m, floor_albedo=0.3)
    image = Renderer(None, PMD).render(1.0, background=background)
    slope = (floor_m / wall_m if wall_m else 0.0) if floor_m else -1.0  # of the line in which they meet; the horizon
    junction = 8 * (1 + slope / TAN)
    phasors, intensity = integrate_pixels(PMD, background_light(wall_m, floor_m, 0.0), cuts_v=[junction])
    assert wall_m is None or floor_m is None or 0.2 < junction % 1 < 0.8  # inside a pixel
    # in the row below the horizon the floor's range has no bound, and its phase turns on and on: 2e-4 of the brightest
    tolerance = 2e-6 if wall_m else 3e-4
    assert epsilon(image.phasor[0], phasors[1]) < tolerance
    assert epsilon(image.intensity[0], intensity) < tolerance
    assert image.coverage.max() == 0


def test_the_line_between_wall_and_floor_follows_bearing_pitch_and_roll():
    sensor = PMD.with_(pitch_deg=3, roll_deg=15, principal_point_px=(7.0, 8.5))
    background = Background(wall_m=3.0, floor_m=0.25, floor_albedo=0.3)
    image = Renderer(None, sensor).render(1.0, 0.0, 0.12, background=background)
    light, exact = background_light(3.0, 0.25, 0.12), np.zeros((16, 16), complex)
    for row, col in np.ndindex(16, 16):
        u, v = image_points(sensor, row, col, 10_000).T
        amplitude, range_m = light(sensor.ray_directions(u, v))
        exact[row, col] = (amplitude * np.exp(1j * range_m / sensor.metres_per_radian)).mean()
    # 10 000 points leave an area beside an edge uncertain by 5e-4 of a pixel, across which the light changes by half
    assert epsilon(image.phasor[0], exact) < 5e-4


def test_what_stands_behind_does_not_change_the_landmark():
    view: dict[str, Any] = {"distance_m": 1.0, "delta_rad": 0.5}
    bare = Renderer(CYLINDER, PMD).render(**view)
    walled = Renderer(CYLINDER, PMD).render(**view, background=Background(wall_m=3.0))
    wall = Renderer(None, PMD).render(**view, background=Background(wall_m=3.0))
    full, empty = bare.coverage == 1, bare.coverage == 0
    np.testing.assert_array_equal(walled.coverage, bare.coverage)
    np.testing.assert_allclose(walled.phasor[full], bare.phasor[full], rtol=1e-12)  # rounding of the coverage
    np.testing.assert_allclose(walled.phasor[empty], wall.phasor[empty], rtol=1e-6)  # samples near an edge differ
    # a wall is nearly constant over a pixel: the composition of the physics page, section 3
    composed = bare.phasor + (1 - bare.coverage) * wall.phasor
    assert epsilon(composed, walled.phasor) < 4e-4


LENS = Sensor.from_opencv(
    [[41.0, 0.0, 7.5], [0.0, 41.0, 7.5], [0.0, 0.0, 1.0]], (-0.31, 0.12, 0.0012, -0.0008, -0.02), size=(16, 16)
)


@pytest.mark.parametrize("sensor", [PMD, LENS, PMD.with_(modulation_hz=[20e6, 100e6])], ids=["ideal", "lens", "two"])
def test_views_before_backgrounds_of_their_own_are_those_rendered_alone_bit_for_bit(sensor):
    """Walls take other points than floors do, and a batch has both."""
    behind = [None, Background(wall_m=3.0), Background(floor_m=0.4), Background(wall_m=2.5, floor_m=0.45), None]
    views = Views.broadcast([0.9, 1.1, 1.3, 1.2, 1.0], [0.3, 1.0, 2.0, 4.0, 5.0], [0.0, 0.05, -0.05, 0.02, 0.0])
    renderer = Renderer(MESHES["cone"], sensor, albedo=0.8)
    parameters = ("distance_m", "bearing_rad", "pitch_rad")
    together = renderer.render_views(views, background=behind, workers=2)
    image, slope = renderer.render_with_slopes(views, parameters, background=behind)
    numbers = (views.distance_m, views.delta_rad, views.bearing_rad)
    jacobian = renderer.jacobian(*numbers, background=behind, parameters=("height_m",))
    for k, own in enumerate(behind):
        one = views[k : k + 1]
        alone = renderer.render_views(one, background=own)
        np.testing.assert_array_equal(together.phasors[k], alone.phasors[0])
        np.testing.assert_array_equal(together.intensity[k], alone.intensity[0])
        alone, expected_slope = renderer.render_with_slopes(one, parameters, background=own)
        np.testing.assert_array_equal(image.phasors[k], alone.phasors[0])
        np.testing.assert_array_equal(slope[k], expected_slope[0])
        of_one = [values[k] for values in numbers]
        expected = renderer.jacobian(*of_one, background=own, parameters=("height_m",))
        np.testing.assert_array_equal(jacobian[k], expected[0])


def test_backgrounds_are_one_for_all_views_or_one_for_each():
    renderer = Renderer(CYLINDER, PMD)
    with pytest.raises(UsageError, match="'background' must be one for all 3 views or one for each, got 2"):
        renderer.render([1.0, 1.2, 1.4], background=[None, Background(wall_m=3.0)])
    with pytest.raises(UsageError, match=r"the wall at 1\.3 m is before the landmark's farthest point in view 1"):
        renderer.render([1.0, 1.25], background=[Background(wall_m=3.0), Background(wall_m=1.3)])


def test_a_background_before_the_landmark_is_refused():
    renderer = Renderer(CYLINDER, PMD)
    with pytest.raises(UsageError, match=r"the wall at 1\.1 m .* view 1: 'wall_m' must be at least 1\.12$"):
        renderer.render([0.9, 1.0], background=Background(wall_m=1.1))
    with pytest.raises(UsageError, match=r"the floor 0\.1 m .* view 0: 'floor_m' must be at least 0\.15$"):
        renderer.render(1.0, background=Background(floor_m=0.1))
    renderer.render(1.0, background=Background(wall_m=1.12, floor_m=0.15))


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_a_background_needs_sound_distances(value):
    with pytest.raises(UsageError, match="'wall_m' must be a positive number of metres"):
        Background(wall_m=value)
    with pytest.raises(UsageError, match="'floor_m' must be a positive number of metres"):
        Background(floor_m=value)


# --- views ---


@pytest.mark.parametrize("distance_m", [0.01, 0.1, 0.12])
def test_a_lens_inside_the_landmark_is_refused(distance_m):
    with pytest.raises(UsageError, match=r"in view 0 the lens is inside .*'distance_m' must be above 0\.121"):
        Renderer(CYLINDER, PMD).render(distance_m)


@pytest.mark.parametrize("name", ["distance_m", "delta_rad", "bearing_rad", "height_m"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_view_that_is_not_finite_is_refused_by_name(name, value):
    with pytest.raises(UsageError, match=f"'{name}' must be finite"):
        Renderer(CYLINDER, PMD).render(**{"distance_m": 1.0, name: value})


def test_no_views_give_no_images():
    image = Renderer(CYLINDER, PMD, harmonics=(2,)).render([])
    assert image.phasor.shape == image.coverage.shape == image.harmonic(2).shape == (0, 16, 16)


def test_views_broadcast_in_c_order():
    renderer = Renderer(CYLINDER, PMD)
    image = renderer.render(np.array([0.9, 1.2])[:, None], np.array([0.0, 0.3, 0.7]))
    assert len(image) == 6
    np.testing.assert_array_equal(image.phasor[4], renderer.render(1.2, 0.3).phasor[0])


def test_a_landmark_behind_or_beside_the_camera_is_not_seen():
    image = Renderer(CYLINDER, PMD).render(1.0, 0.3, [math.pi, math.pi / 2, -2.0])
    assert (image.phasor == 0).all()
    assert (image.coverage == 0).all()


def test_far_away_the_covered_area_falls_with_the_square_of_the_distance():
    distance = np.array([300.0, 1000.0, 10_000.0])
    covered = Renderer(CYLINDER, PMD).render(distance, 0.3).coverage.sum(axis=(1, 2)) * distance**2
    # perspective still changes it by depth / distance = 1e-3; float32 rays are 1 mm coarse at 10 km
    np.testing.assert_allclose(covered, covered[0], rtol=2e-3)


def test_close_to_the_box_its_face_fills_the_image():
    # 1 cm before the face x' = −0.12, in line with the box's middle
    image = Renderer(CYLINDER, PMD).render(0.13, 0.0, 0.0, 0.075)
    phasors, _ = integrate_pixels(PMD, plane_light([1, 0, 0], 0.01, 0.8))
    np.testing.assert_allclose(image.coverage[0], 1, atol=1e-12)
    np.testing.assert_allclose(image.phasor[0], phasors[1], rtol=1e-6)


# --- what must not change an image ---


def test_rendering_some_rows_gives_those_rows_bit_for_bit():
    renderer = Renderer(CYLINDER, PMD, harmonics=(3,))
    view: dict[str, Any] = {
        "distance_m": [0.9, 1.4],
        "delta_rad": 0.4,
        "background": Background(wall_m=3.0, floor_m=0.2),
    }
    whole, part = renderer.render(**view), renderer.render(**view, rows=(8, 16))
    for name in ("phasor", "intensity", "coverage"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[:, 8:])
    np.testing.assert_array_equal(part.harmonic(3), whole.harmonic(3)[:, 8:])


@pytest.mark.parametrize("rows", [(8, 8), (-1, 4), (0, 17), (9, 8)])
def test_rows_outside_the_image_are_refused(rows):
    with pytest.raises(UsageError, match=r"'rows' must lie in 0 … 16"):
        Renderer(CYLINDER, PMD).render(1.0, rows=rows)


def test_workers_and_batches_do_not_change_a_bit():
    renderer = Renderer(MESHES["sphere"], PMD)
    distance, delta = np.linspace(0.7, 2, 200), np.linspace(0, 3, 200)
    background = Background(wall_m=4.0)
    alone = renderer.render(distance, delta, background=background)
    together = renderer.render(distance, delta, background=background, workers=2)
    split = [renderer.render(distance[k], delta[k], background=background) for k in (slice(0, 70), slice(70, 200))]
    for name in ("phasor", "intensity", "coverage"):
        np.testing.assert_array_equal(getattr(together, name), getattr(alone, name))
        np.testing.assert_array_equal(np.concatenate([getattr(part, name) for part in split]), getattr(alone, name))


@pytest.mark.parametrize("mesh", [CYLINDER, star_prism(), l_bracket()], ids=["cylinder", "star", "bracket"])
def test_an_inverted_mesh_gives_the_same_image(mesh):
    inverted = mesh.copy()
    inverted.invert()
    view: dict[str, Any] = {"distance_m": [1.0, 0.8], "delta_rad": [0.3, 2.0], "height_m": -0.05}
    right, wrong = Renderer(mesh, PMD).render(**view), Renderer(inverted, PMD).render(**view)
    # a closed mesh drops the edges it cannot show, so that its pixels are split less finely: the budget of the integral
    assert epsilon(wrong.phasor, right.phasor) < 1e-4
    np.testing.assert_allclose(wrong.coverage, right.coverage, atol=1e-7)


def test_one_inverted_shell_among_two_gives_the_same_image():
    shells = [CYLINDER, trimesh.creation.box((0.05, 0.05, 0.05)).apply_translation((-0.2, 0, 0))]
    right = Renderer(joined(shells), PMD).render(1.0, 0.3)
    shells[1].invert()
    wrong = Renderer(joined(shells), PMD).render(1.0, 0.3)
    assert epsilon(wrong.phasor, right.phasor) < 1e-4  # as above


def test_a_sheet_is_seen_alike_from_both_sides():
    renderer = Renderer(sheet((-0.1, 0.1), (-0.1, 0.1)), PMD)
    image = renderer.render(1.0, [0.0, math.pi])
    assert image.coverage[0].sum() == pytest.approx((0.2 * 8 / TAN) ** 2, abs=1e-9)
    np.testing.assert_allclose(image.phasor[1], image.phasor[0], rtol=1e-7, atol=1e-9)  # where the pieces are cut


def test_a_sheet_seen_from_its_edge_is_not_seen():
    image = Renderer(sheet((-0.1, 0.1), (-0.1, 0.1)), PMD).render(1.0, math.pi / 2)
    assert image.coverage.max() == 0
    assert np.isfinite(image.phasor).all()


def test_a_lone_triangle_covers_its_area():
    triangle = trimesh.Trimesh([[0, -0.1, -0.1], [0, 0.1, -0.1], [0, 0, 0.1]], [[0, 1, 2]], process=False)
    covered = Renderer(triangle, PMD).render(1.0, [0.0, math.pi]).coverage.sum(axis=(1, 2))
    np.testing.assert_allclose(covered, 0.02 * (8 / TAN) ** 2, rtol=1e-9)


def test_shells_that_coincide_look_like_one():
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    twice = trimesh.Trimesh(np.vstack([box.vertices] * 2), np.vstack([box.faces, box.faces + 8]), process=False)
    one, two = Renderer(box, PMD).render(1.0, 0.3), Renderer(twice, PMD).render(1.0, 0.3)
    assert epsilon(two.phasor, one.phasor) < 1e-5  # pixels are split differently


@pytest.mark.parametrize("name", ["cylinder", "cone", "sphere", "post"])
def test_both_intersectors_give_the_same_image(name):
    view: dict[str, Any] = {"distance_m": [0.9, 1.7], "delta_rad": 0.4, "bearing_rad": 0.01, "height_m": -0.02}
    embree, own = (Renderer(MESHES[name], PMD, intersector=kind).render(**view) for kind in ("auto", "float64"))
    assert epsilon(own.phasor, embree.phasor) < 1e-6  # float32 edges inside Embree
    np.testing.assert_allclose(own.coverage, embree.coverage, atol=1e-6)


def test_a_shift_of_the_principal_point_by_whole_pixels_shifts_the_image():
    image = Renderer(CYLINDER, PMD).render(0.8, 0.3, background=Background(wall_m=3.0))
    shifted = Renderer(CYLINDER, PMD.with_(principal_point_px=(3.0, 10.0))).render(
        0.8, 0.3, background=Background(wall_m=3.0)
    )
    assert image.coverage[0, :, 15].max() == 0  # the landmark is whole in one and cut off in the other
    assert shifted.coverage[0, :, 0].max() > 0
    for name in ("phasor", "intensity", "coverage"):
        np.testing.assert_allclose(
            getattr(shifted, name)[:, 2:, :11], getattr(image, name)[:, :14, 5:], rtol=1e-5, atol=1e-9
        )  # rays are float32; samples near the image's border ask fewer neighbours for limbs


@pytest.mark.parametrize("name", ["cylinder", "cone", "sphere", "post"])
def test_finer_pixels_average_to_the_same_image(name):
    view: dict[str, Any] = {
        "distance_m": [0.75, 1.3, 2.0],
        "delta_rad": [0.1, 0.9, 2.2],
        "bearing_rad": 0.01,
        "height_m": -0.02,
    }
    image = Renderer(MESHES[name], PMD).render(**view)
    fine = Renderer(MESHES[name], PMD.with_(rows=64, cols=64)).render(**view)
    np.testing.assert_allclose(mean_of_blocks(fine.coverage, 4), image.coverage, atol=1e-6)  # float32 rays at edges
    phasor = mean_of_blocks(fine.phasor, 4)
    error = np.abs(image.phasor - phasor).max(axis=(1, 2)) / np.abs(phasor).max(axis=(1, 2))
    assert error.max() < 5e-4  # 1e-4 is the aim, which the limb of small or tilted surfaces can miss


@pytest.mark.parametrize(
    ("distance_m", "bearing_rad", "height_m"),
    [(1.5, 0.0, -0.03), (2.5, 0.0, -0.03), (3.0, 0.0, -0.03), (3.0, 0.02, 0.03)],
)
def test_the_slanted_limb_of_a_cone_keeps_to_the_budget(distance_m, bearing_rad, height_m):
    view: dict[str, Any] = {
        "distance_m": distance_m,
        "delta_rad": 0.3,
        "bearing_rad": bearing_rad,
        "height_m": height_m,
    }
    image = Renderer(MESHES["cone"], PMD).render(**view)
    fine = Renderer(MESHES["cone"], PMD.with_(rows=192, cols=192)).render(**view)
    assert epsilon(image.phasor, mean_of_blocks(fine.phasor, 12)) < 1e-4  # the budget


@pytest.mark.parametrize("n", [20, 40, 90])
def test_a_pixel_crowded_with_crossing_needles_is_still_split_exactly(n):
    """90 needles have 360 edges and 16 000 crossings, all in pixel (7, 7)."""
    faces, vertices = [], []
    for k in range(n):
        turn = math.pi * k / n
        along = 0.011 * np.array([0, math.cos(turn), math.sin(turn)])
        across = 2e-5 * np.array([0, -math.sin(turn), math.cos(turn)])
        middle = np.array([1e-4 * k, 0.0122 + 0.002 * math.sin(7 * k), 0.0122 + 0.002 * math.cos(5 * k)])
        vertices += [middle - along - across, middle + along - across, middle + along + across, middle - along + across]
        faces += [[4 * k, 4 * k + 1, 4 * k + 2], [4 * k, 4 * k + 2, 4 * k + 3]]
    needles = trimesh.Trimesh(vertices, faces, process=False)
    renderer = Renderer(needles, PMD)
    image = renderer.render(1.0)
    fine = Renderer(needles, PMD.with_(rows=512, cols=512)).render(1.0)
    assert renderer.untrusted_pixels == 0
    assert image.coverage[0, 7, 7] == pytest.approx(
        mean_of_blocks(fine.coverage, 32)[0, 7, 7], rel=1e-6
    )  # float32 rays
    assert image.phasor[0, 7, 7] == pytest.approx(mean_of_blocks(fine.phasor, 32)[0, 7, 7], rel=1e-6)


def test_threads_that_share_a_renderer_count_all_of_its_untrusted_pixels(monkeypatch):
    class Slow(Renderer):
        """A renderer whose count is read long before it is written again."""

        @property
        def untrusted_pixels(self):
            count = self.count
            time.sleep(0.2)
            return count

        @untrusted_pixels.setter
        def untrusted_pixels(self, count):
            self.count = count

    renderer = Slow(MESHES["cone"], PMD)
    monkeypatch.setattr("phasemark.render.renderer.UNTRUSTED", 0)  # the state of most pixels
    renderer.render(1.0)
    one = renderer.count
    assert one > 0
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(renderer.render, (1.0, 1.0)))
    assert renderer.count == 3 * one


@pytest.mark.parametrize("wrong", [4, -1])
def test_a_face_that_names_no_vertex_is_named(wrong):
    mesh = trimesh.Trimesh(np.eye(4, 3), [[0, 1, 2], [0, 1, wrong]], process=False, validate=False)
    for make in (lambda: Renderer(mesh, PMD), lambda: SceneMesh(mesh)):
        with pytest.raises(UsageError, match=f"a face of the mesh names vertex {wrong}, but there are 4"):
            make()


# --- shapes of every kind, against dense sampling ---


def mixed_and_brightest(image, n=6):
    """Return some pixels across which an edge runs, and the brightest."""
    mixed = np.argwhere((image.coverage[0] > 0.02) & (image.coverage[0] < 0.98))
    brightest = np.unravel_index(image.intensity[0].argmax(), image.intensity[0].shape)
    return [tuple(pixel) for pixel in mixed[:: max(1, len(mixed) // n)]] + [brightest]


@pytest.mark.parametrize("name", ["bowl", "coarse bowl", "star prism", "L bracket", "hidden box", "blob"])
@pytest.mark.parametrize("wall_m", [None, 2.0])
def test_odd_meshes_agree_with_dense_sampling(name, wall_m):
    view: dict[str, Any] = {"distance_m": 1.0, "delta_rad": 0.4, "bearing_rad": 0.01, "height_m": -0.1}
    renderer = Renderer(ODD[name](), PMD)
    image = renderer.render(**view, background=Background(wall_m=wall_m) if wall_m else None)
    pixels = mixed_and_brightest(image)
    phasor, intensity, coverage = brute_force(renderer, pixels, n=20_000, wall_m=wall_m, **view)
    rows, cols = np.array(pixels).T
    brightest = image.amplitude.max()
    # 20 000 points leave an area beside an edge uncertain by 2e-4 to 6e-4
    assert np.abs(image.coverage[0, rows, cols] - coverage).max() < 1e-3
    assert np.abs(image.phasor[0, rows, cols] - phasor).max() / brightest < 1e-3
    assert np.abs(image.intensity[0, rows, cols] - intensity).max() / brightest < 1e-3
    assert renderer.untrusted_pixels == 0


@pytest.mark.parametrize(
    "sensor",
    [
        Sensor(rows=24, cols=32, half_angle_h_deg=20, half_angle_v_deg=12),
        Sensor(rows=1, cols=1, half_angle_h_deg=20, half_angle_v_deg=20),
        PMD.with_(fill_factor=(0.4, 0.7), vignetting=True, pitch_deg=4, roll_deg=10),
    ],
    ids=["24x32", "one pixel", "mounted"],
)
def test_other_cameras_agree_with_dense_sampling(sensor):
    view: dict[str, Any] = {"distance_m": 0.9, "delta_rad": 0.4, "bearing_rad": -0.03, "height_m": 0.02}
    renderer = Renderer(CYLINDER, sensor)
    image = renderer.render(**view)
    pixels = mixed_and_brightest(image)
    phasor, _, coverage = brute_force(renderer, pixels, n=20_000, **view)
    rows, cols = np.array(pixels).T
    assert np.abs(image.coverage[0, rows, cols] - coverage).max() < 1e-3  # as above
    assert np.abs(image.phasor[0, rows, cols] - phasor).max() / image.amplitude.max() < 1e-3


def test_hidden_parts_do_not_shine_through():
    near = block((-0.5, -0.4), (-0.2, 0.2), (-0.2, 0.2))
    alone = Renderer(near, PMD).render(1.2)
    both = Renderer(joined([near, block((0, 0.1), (-0.1, 0.1), (-0.1, 0.1))]), PMD).render(1.2)
    np.testing.assert_array_equal(both.coverage > 0, alone.coverage > 0)
    assert epsilon(both.phasor, alone.phasor) < 1e-6  # pixels are split along edges that turn out to be hidden


# --- where rays and edges coincide ---


@pytest.mark.parametrize("kind", ["auto", "float64"])
@pytest.mark.parametrize("name", ["cylinder", "sphere", "star"])
def test_rays_aimed_at_vertices_and_edges_do_not_slip_through(kind, name):
    mesh = star_prism() if name == "star" else MESHES[name]
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int32)
    rng = np.random.default_rng(11)
    lens = np.array([-1.0, 0.37, 0.21])
    pick, share = rng.integers(0, len(faces), 17_000), rng.random((17_000, 1))
    corner = vertices[faces[pick]]
    on_edge = corner[:, 0] * share + corner[:, 1] * (1 - share)
    targets = np.vstack([corner[:, 0], corner[:, 1], on_edge])
    # outlines may be missed: keep what has lit surface all round, a hair's breadth inside the outline
    inside = np.ones(len(targets), bool)
    reach = make_intersector(vertices, faces, "float64")
    for shift in 2e-4 * np.array(
        [[0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0, 1, 1], [0, -1, -1], [0, 1, -1], [0, -1, 1]]
    ):
        directions = (targets + shift - lens).astype(np.float32)
        inside &= reach.first_face(np.tile(lens.astype(np.float32), (len(targets), 1)), directions) >= 0
    targets = targets[inside]
    assert len(targets) > 30_000  # of 51 000
    origins = np.tile(lens.astype(np.float32), (len(targets), 1))
    hit = make_intersector(vertices, faces, kind).first_face(origins, (targets - lens).astype(np.float32))
    assert (hit >= 0).all()


def test_an_edge_on_a_pixels_border_leaves_nothing_in_the_next_pixel():
    # at h = 0 the top of the box lies on v = 8, and its upper face is seen from its edge
    image = Renderer(build_mesh(catalog()["cylinder"], part="lower"), PMD).render(1.0, [0.0, 0.3, math.pi / 2])
    assert image.coverage[:, :8].max() < 1e-12
    np.testing.assert_allclose(image.coverage[:, 8, 7:9], 1, atol=1e-9)
    # and in columns: a sheet from column 4 to column 12
    y = TAN / 2
    covered = Renderer(sheet((-y, y), (-2, 2)), PMD).render(1.0).coverage[0]
    np.testing.assert_allclose(covered[:, 4:12], 1, atol=1e-9)
    assert max(covered[:, :4].max(), covered[:, 12:].max()) < 1e-9


RENDERERS = {name: Renderer(mesh, PMD) for name, mesh in MESHES.items()}


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    name=st.sampled_from(list(MESHES)),
    distance_m=st.floats(0.5, 8),
    delta_rad=st.floats(-7, 7),
    bearing_rad=st.floats(-0.3, 0.3),
    height_m=st.floats(-0.3, 0.3),
)
def test_any_view_has_sound_values_that_move_continuously(name, distance_m, delta_rad, bearing_rad, height_m):
    view = np.array([distance_m, delta_rad, bearing_rad, height_m])
    step = 1e-7
    moved = view + step * np.vstack([np.zeros(4), np.eye(4)])
    image = RENDERERS[name].render(*moved.T)
    assert np.isfinite(image.phasor).all()
    assert (image.intensity >= image.amplitude - 1e-15).all()  # rounding
    assert (image.coverage >= 0).all()
    assert (image.coverage <= 1).all()
    # an outline moves by at most 41 px/rad · 1 / cos² or 41 px/m / 0.35 m; at most 3 outlines of √2 px cross a pixel
    largest = step * 120 * 3 * math.sqrt(2)
    assert np.abs(image.coverage[1:] - image.coverage[0]).max() < largest
    assert np.abs(image.coverage[1:].sum(axis=(1, 2)) - image.coverage[0].sum()).max() < 16 * largest


def test_the_quadrature_helper_is_right():
    x, w = pixel_nodes(2.0, 3.0, 8)
    assert (w * x**5).sum() == pytest.approx((3**6 - 2**6) / 6, rel=1e-14)


def test_shells_that_run_through_one_another_look_like_their_union():
    left, right = trimesh.creation.box((0.15, 0.1, 0.1)), trimesh.creation.box((0.15, 0.1, 0.1))
    left.apply_translation((-0.025, 0, 0))
    right.apply_translation((0.025, 0, 0))
    both = joined([left, right])
    whole = trimesh.creation.box((0.2, 0.1, 0.1))
    views: dict[str, Any] = {"distance_m": [0.8, 1.1], "delta_rad": [0.4, 1.9], "height_m": [0.03, -0.02]}
    crossed, single = (Renderer(mesh, preset("pmd-16x16")).render(**views) for mesh in (both, whole))
    # the seams of the union cut some pixels in more pieces: another quadrature of the same light
    np.testing.assert_allclose(crossed.phasor, single.phasor, atol=1e-7)
    np.testing.assert_allclose(crossed.coverage, single.coverage, atol=1e-12)


def test_a_hole_in_one_of_two_shells_stays_a_hole():
    cut = trimesh.creation.box((0.2, 0.2, 0.2))
    front = cut.face_normals[:, 0] < -0.5
    cut.update_faces(~front)
    inside = trimesh.creation.box((0.25, 0.02, 0.02)).apply_translation((0.02, 0, 0))  # pierces the back
    both = joined([cut, inside])
    image = Renderer(both, PMD).render(1.0)
    # through the open front the inner face of the back is seen, 1.1 m away, and not the front, 0.9 m away
    assert image.range_m[0, 6, 6] == pytest.approx(1.1, abs=0.01)


def test_crossed_boxes_agree_with_finer_pixels():
    beam, post = trimesh.creation.box((0.3, 0.05, 0.05)), trimesh.creation.box((0.06, 0.06, 0.25))
    post.apply_transform(trimesh.transformations.rotation_matrix(0.8, (1, 0.3, 0.2)))
    mesh, fine = joined([beam, post]), 8
    sensor = preset("pmd-16x16")
    image = Renderer(mesh, sensor).render(0.9, 0.7).phasor[0]
    finer = Renderer(mesh, sensor.with_(rows=16 * fine, cols=16 * fine)).render(0.9, 0.7).phasor[0]
    averaged = finer.reshape(16, fine, 16, fine).mean(axis=(1, 3))
    # without the curve where they cross as an edge the difference is 1e-2
    assert np.abs(image - averaged).max() < 1e-5 * np.abs(averaged).max()


def crossed_sheets():
    one = [[-0.1, -0.15, -0.1], [-0.1, -0.15, 0.1], [0.1, 0.15, 0.1], [0.1, 0.15, -0.1]]
    two = [[0.1, -0.15, -0.1], [0.1, -0.15, 0.1], [-0.1, 0.15, 0.1], [-0.1, 0.15, -0.1]]
    return trimesh.Trimesh([*one, *two], [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], process=False)


def dented_through():
    block = trimesh.creation.box((0.1, 0.3, 0.3)).subdivide().subdivide().subdivide()
    points = block.vertices.copy()
    points[(points[:, 0] > 0.049) & (np.hypot(points[:, 1], points[:, 2]) < 0.09), 0] = -0.15  # the back, out in front
    return trimesh.Trimesh(points, block.faces, process=False)


@pytest.mark.parametrize("mesh", [crossed_sheets(), dented_through()], ids=["open", "closed"])
def test_a_mesh_that_passes_through_itself_agrees_with_finer_pixels(mesh):
    fine, view = 64, (1.0, 0.35, 0.01, 0.02)
    image = Renderer(mesh, PMD).render(*view)
    rays = Renderer(mesh, PMD.with_(rows=16 * fine, cols=16 * fine)).render(*view, variant="hard")
    averaged, covered = (
        values[0].reshape(16, fine, 16, fine).mean(axis=(1, 3)) for values in (rays.phasor, rays.coverage)
    )
    # without the curve where it crosses itself as an edge the difference is 0.03 and 0.6
    assert np.abs(image.phasor[0] - averaged).max() < 1e-2 * np.abs(averaged).max()
    assert np.abs(image.coverage[0] - covered).max() < 3e-2
    slopes = Renderer(mesh, PMD).render_with_slopes(image.views, ("distance_m", "delta_rad"))[1]
    steps = Renderer(mesh, PMD).jacobian(*view, parameters=("distance_m", "delta_rad"))
    assert np.abs(slopes - steps).max() < 1e-3 * np.abs(steps).max()


def test_coverage_is_told_apart_by_part():
    image = Renderer(MESHES["sphere"], PMD).render(1.0, 0.3)
    # at the interface's height the upper rows see the upper part, the lower rows the lower one
    np.testing.assert_allclose(image.upper_coverage[:, :8], image.coverage[:, :8], atol=1e-12)
    assert image.upper_coverage[:, 8:].max() == 0
    assert image.coverage[:, 8:].max() == 1


@pytest.mark.parametrize("wrong", ["near", [1 + 2j], [None, "x"]])
def test_a_view_that_is_no_number_is_refused(wrong):
    with pytest.raises(UsageError, match="distance_m"):
        Renderer(None, preset("pmd-16x16")).render(wrong)
