"""The paper's generator against closed forms and against the exact integral."""

from __future__ import annotations

import math

import numpy as np
import pytest

from phasemark import UsageError
from phasemark.landmarks import LandmarkSpec, build_mesh, catalog
from phasemark.landmarks.spec import Cone, Cylinder, Sphere
from phasemark.render import Renderer, Sensor, Views, preset
from phasemark.render.planar import PlanarLandmark, planar_images

LENGTH, WIDTH = 0.24, 0.16
SENSOR = preset("pmd-16x16")
SLOPE = math.tan(math.radians(11)) * (1 - (2 * np.arange(16) + 1) / 16)  # of the columns; of the rows as well
AZIMUTH = np.arctan(SLOPE)
UPPER, LOWER = 7, 8  # the rows beside the optical axis
EXACT = 1e-12  # metres; rounding of a phase, times 2.4 m a radian, with a few digits to spare


def outline_of(spec: LandmarkSpec) -> PlanarLandmark:
    match spec.upper:
        case Cylinder(radius_m=r, height_m=h):
            return PlanarLandmark(spec.box.length_m, spec.box.width_m, [(r, 0.0), (r, h)])
        case Cone(radius_m=r, height_m=h):
            return PlanarLandmark(spec.box.length_m, spec.box.width_m, [(r, 0.0), (0.0, h)])
        case Sphere(radius_m=r):
            return PlanarLandmark(
                spec.box.length_m, spec.box.width_m, lambda z: np.sqrt(np.maximum(r**2 - (z - r) ** 2, 0))
            )
    raise AssertionError(spec)


CYLINDER = outline_of(catalog()["cylinder"])


def ranges(landmark=CYLINDER, sensor=SENSOR, **view):
    """(rows, cols) ranges of one view."""
    return planar_images(landmark, sensor, Views.broadcast(**view)).range_m[0]


def camera(cols: int, slope: float, rows: int = 2) -> Sensor:
    """Return a camera whose outermost columns have the slopes ± `slope`."""
    half_angle = math.degrees(math.atan(slope * cols / (cols - 1)))
    return Sensor(rows=rows, cols=cols, half_angle_h_deg=half_angle, half_angle_v_deg=1)


def through_slabs(views: Views, azimuth: np.ndarray) -> np.ndarray:
    """(n, cols) distances to a box by the slab method, in the landmark frame; NaN where it is missed."""
    heading = azimuth + (views.delta_rad - views.bearing_rad)[:, None]
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    lens = views.lens_in_landmark()[:, None, :2]
    half = np.array([LENGTH, WIDTH]) / 2
    with np.errstate(divide="ignore"):
        planes = np.stack([(-half - lens) / direction, (half - lens) / direction])
    enters, leaves = planes.min(axis=0).max(axis=-1), planes.max(axis=0).min(axis=-1)
    return np.where((enters <= leaves) & (enters > 0), enters, np.nan)


@pytest.mark.parametrize(("delta", "depth", "breadth"), [(0, LENGTH, WIDTH), (math.pi / 2, WIDTH, LENGTH)])
def test_a_face_square_to_the_line_of_sight_is_at_its_distance_over_the_cosine_of_the_azimuth(delta, depth, breadth):
    front = 1.0 - depth / 2
    expected = np.where(np.abs(SLOPE) * front < breadth / 2, front / np.cos(AZIMUTH), np.nan)
    assert 0 < np.isnan(expected).sum() < 16
    lower = ranges(distance_m=1.0, delta_rad=delta)[8:]
    np.testing.assert_allclose(lower, np.broadcast_to(expected, (8, 16)), rtol=0, atol=EXACT)


def test_a_square_box_seen_at_45_degrees_is_a_wedge():
    side = 0.2
    edge = 1.0 - side / math.sqrt(2)  # the line x = edge + |y|
    expected = edge / (np.cos(AZIMUTH) - np.abs(np.sin(AZIMUTH)))
    half_breadth = side / math.sqrt(2)
    expected[np.abs(SLOPE) > half_breadth / 1.0] = np.nan  # the outer corners are at x = 1
    assert 0 < np.isnan(expected).sum() < 16
    lower = ranges(PlanarLandmark(side, side), distance_m=1.0, delta_rad=math.pi / 4)[LOWER]
    np.testing.assert_allclose(lower, expected, rtol=0, atol=EXACT)


def test_any_view_of_the_box_agrees_with_the_slab_method():
    rng = np.random.default_rng(20050704)
    n = 400
    views = Views.broadcast(rng.uniform(0.4, 3, n), rng.uniform(-7, 7, n), rng.uniform(-0.2, 0.2, n))
    lower = planar_images(CYLINDER, SENSOR, views, rows=(LOWER, LOWER + 1)).range_m[:, 0]
    expected = through_slabs(views, AZIMUTH)
    assert np.isnan(expected).mean() < 0.8
    # 1e-10: a face seen at a grazing angle, 1 in 10 000, magnifies rounding
    np.testing.assert_allclose(lower, expected, rtol=0, atol=1e-10)


def test_a_line_parallel_to_two_sides_meets_the_one_that_faces_it():
    # The middle column's line is y = 0 exactly, and at δ = 0 two sides are y = ± W/2: no slope, no division by zero.
    lower = ranges(sensor=camera(3, 0.5), distance_m=1.0)[1]
    np.testing.assert_allclose(lower, [np.nan, 1.0 - LENGTH / 2, np.nan], rtol=0, atol=EXACT)


@pytest.mark.parametrize("distance", [0.5, 0.7, 0.9, 1.1, 1.3, 1.7, 2.1])
def test_a_line_along_a_side_meets_its_near_corner(distance):
    # With D sin δ = W/2 the lens is in the plane of a side; at b = δ that side lies on the middle column's line.
    delta = math.asin(WIDTH / 2 / distance)
    lower = ranges(sensor=camera(3, 0.5), distance_m=distance, delta_rad=delta, bearing_rad=delta)[1, 1]
    assert lower == pytest.approx(distance * math.cos(delta) - LENGTH / 2, abs=EXACT)


@pytest.mark.parametrize("delta_deg", np.arange(0, 360, 15))
def test_no_line_slips_through_the_corner_it_aims_at(delta_deg):
    # Aim the middle column at the corner nearest to the lens: passing between the two sides would give the far ones.
    delta, distance = math.radians(delta_deg), 1.0
    corner = Views.broadcast(distance, delta).landmark2cam()[0][0, :2, :2] @ np.array(
        [[x, y] for x in (-LENGTH / 2, LENGTH / 2) for y in (-WIDTH / 2, WIDTH / 2)]
    ).T + np.array([[distance], [0]])
    nearest = corner[:, np.argmin(np.hypot(*corner))]
    bearing = -math.atan2(nearest[1], nearest[0])
    lower = ranges(sensor=camera(3, 0.5), distance_m=distance, delta_rad=delta, bearing_rad=bearing)[1, 1]
    assert lower == pytest.approx(np.hypot(*nearest), abs=EXACT)


def test_a_column_meets_a_circle_at_the_nearer_root_of_its_quadratic():
    distance, radius = 1.0, 0.06
    # |t d − (D, 0)|² = r²
    roots = [np.roots([1.0, -2 * distance * math.cos(a), distance**2 - radius**2]) for a in AZIMUTH]
    expected = np.array([root.real.min() if np.isrealobj(root) else np.nan for root in roots])
    assert 0 < np.isnan(expected).sum() < 16
    upper = ranges(distance_m=distance, delta_rad=0.7)[UPPER]
    # np.roots is good to 1e-8 or so where the roots nearly coincide
    np.testing.assert_allclose(upper, expected, rtol=0, atol=1e-9)


def test_a_line_through_the_axis_meets_the_circle_at_its_radius_and_squarely():
    image = planar_images(CYLINDER, camera(3, 0.5), Views.broadcast(1.0), albedo=0.6)
    assert image.range_m[0, 0, 1] == pytest.approx(1.0 - 0.06, abs=EXACT)
    assert image.amplitude[0, 0, 1] == pytest.approx(0.6 / 0.94**2, rel=1e-12)


def test_the_circle_has_the_radius_at_the_height_where_the_row_passes_the_axis():
    # Cone of base 0.075 and height 0.15: r = 0.075 − z/2. The bearing shortens the way along the optical axis.
    distance, bearing = 0.9, 0.1
    sensor = SENSOR.with_(cols=3, half_angle_h_deg=math.degrees(math.atan(1.5 * math.tan(bearing))))
    upper = ranges(outline_of(catalog()["cone"]), sensor, distance_m=distance, bearing_rad=bearing)[:8, 0]
    z = distance * math.cos(bearing) * SLOPE[:8]
    assert (z > 0.15).any()
    assert (z < 0.15).any()
    expected = np.where(z < 0.15, distance - (0.075 - z / 2), np.nan)
    np.testing.assert_allclose(upper, expected, rtol=0, atol=EXACT)


def test_an_outline_that_overhangs_counts_with_its_outermost_radius():
    mushroom = PlanarLandmark(LENGTH, WIDTH, [(0.02, 0.0), (0.02, 0.06), (0.07, 0.06), (0.05, 0.03), (0.05, 0.1)])
    np.testing.assert_allclose(
        mushroom.radius_m(np.array([0.01, 0.03, 0.045, 0.08, 0.1, 0.11])), [0.02, 0.05, 0.06, 0.05, 0.05, 0.0]
    )


def test_amplitude_is_albedo_times_cosine_of_incidence_over_squared_distance():
    image = planar_images(CYLINDER, SENSOR, Views.broadcast(1.0), albedo=0.6)
    front = 1.0 - LENGTH / 2
    on_box = np.abs(SLOPE) * front < WIDTH / 2
    expected = np.where(on_box, 0.6 * np.cos(AZIMUTH) * (np.cos(AZIMUTH) / front) ** 2, 0.0)
    np.testing.assert_allclose(image.amplitude[0, LOWER], expected, rtol=1e-12)
    np.testing.assert_allclose(image.intensity, image.amplitude, rtol=1e-12)


def test_a_column_that_misses_returns_nothing():
    image = planar_images(CYLINDER, SENSOR, Views.broadcast(1.0))
    missed = np.isnan(image.range_m)
    assert missed[:, :, [0, 15]].all()
    assert (image.phasor[missed] == 0).all()
    assert (image.coverage[missed] == 0).all()
    assert (image.coverage[~missed] == 1).all()


def test_what_is_behind_the_camera_is_not_seen():
    endless = PlanarLandmark(LENGTH, WIDTH, lambda z: np.full(z.shape, 0.06))
    assert planar_images(endless, SENSOR, Views.broadcast(1.0, 0.3, 0.0)).coverage[0, :, 7].all()
    assert not planar_images(endless, SENSOR, Views.broadcast(1.0, 0.3, [math.pi, 2.9])).coverage.any()


def test_every_lower_row_and_every_cylinder_row_below_its_top_has_the_same_values():
    image = ranges(distance_m=1.0, delta_rad=0.4)
    np.testing.assert_array_equal(image[8:], np.broadcast_to(image[LOWER], (8, 16)))
    below_top = SLOPE[:8] * 1.0 < 0.15
    np.testing.assert_array_equal(image[:8][below_top], np.broadcast_to(image[UPPER], (below_top.sum(), 16)))
    assert np.isnan(image[:8][~below_top]).all()


def test_turning_the_other_way_mirrors_the_columns():
    there, back = (ranges(distance_m=1.0, delta_rad=d, bearing_rad=d / 9) for d in (0.6, -0.6))
    assert np.nanmax(np.abs(there - there[:, ::-1])) > 0.01
    np.testing.assert_allclose(back, there[:, ::-1], rtol=0, atol=EXACT)


def test_half_a_turn_changes_nothing():
    np.testing.assert_allclose(
        ranges(distance_m=1.0, delta_rad=0.6 + math.pi), ranges(distance_m=1.0, delta_rad=0.6), rtol=0, atol=EXACT
    )


def test_some_rows_are_those_of_the_whole_image():
    views = Views.broadcast([0.8, 1.1], 0.3, 0.02)
    whole = planar_images(CYLINDER, SENSOR.with_(vignetting=True), views, harmonics=(3,))
    for first, stop in ((0, 8), (8, 16), (5, 11), (2, 3), (12, 13)):
        part = planar_images(CYLINDER, SENSOR.with_(vignetting=True), views, harmonics=(3,), rows=(first, stop))
        np.testing.assert_array_equal(part.phasor, whole.phasor[:, first:stop])
        np.testing.assert_array_equal(part.harmonic(3), whole.harmonic(3)[:, first:stop])


def test_a_bearing_offset_moves_every_bearing():
    turned = ranges(sensor=SENSOR.with_(bearing_offset_deg=3.0), distance_m=1.0, delta_rad=0.4, bearing_rad=0.01)
    np.testing.assert_array_equal(turned, ranges(distance_m=1.0, delta_rad=0.4, bearing_rad=0.01 + math.radians(3)))


def test_harmonics_and_vignetting_follow_their_definitions():
    plain, dimmed = (
        planar_images(CYLINDER, SENSOR.with_(vignetting=v), Views.broadcast(1.0), harmonics=(3,)) for v in (False, True)
    )
    # S_k = a exp(i k φ)
    np.testing.assert_allclose(plain.harmonic(3) * plain.intensity**2, plain.phasor**3, rtol=0, atol=EXACT)
    cos4 = (1 + SLOPE[:, None] ** 2 + SLOPE**2) ** -2
    np.testing.assert_allclose(dimmed.phasor, plain.phasor * cos4, rtol=0, atol=EXACT)


def test_a_wrapped_distance_wraps():
    sensor = SENSOR.with_(modulation_hz=250e6)  # c/2f = 0.5996 m
    lower = ranges(sensor=sensor, distance_m=1.0)[LOWER, 7]
    front = (1.0 - LENGTH / 2) / math.cos(AZIMUTH[7])
    assert lower == pytest.approx(front - sensor.unambiguous_range_m, abs=EXACT)


VIEWS = Views.broadcast(
    [0.8, 1.0, 1.2, 0.93, 1.57, 2.1],
    np.radians(np.arange(0, 180, 15))[:, None],
    np.radians([0, 0, 0, 2, -3, 1]),
)
ELEVATION_FACTOR = np.sqrt(1 + SLOPE[UPPER] ** 2 / (1 + SLOPE**2))  # √(x² + y² + z²) / √(x² + y²) with z = t_v x
TINY = 1e-3  # pixels that are all but rays: what a pixel averages over is 1e-6 of what a whole one does


@pytest.mark.parametrize("name", ["cylinder", "post"])
def test_central_rows_are_the_ray_casters_but_for_the_elevation(name):
    spec = catalog()[name]
    sensor = SENSOR.with_(fill_factor=(TINY, TINY))
    cast = Renderer(build_mesh(spec), sensor).render_views(VIEWS)
    planar = planar_images(outline_of(spec), sensor, VIEWS)
    for row in (UPPER, LOWER):
        pure = (cast.coverage[:, row] > 1 - 1e-9) & (planar.coverage[:, row] == 1)
        assert pure.sum() > len(VIEWS)
        difference = cast.range_m[:, row] - planar.range_m[:, row] * ELEVATION_FACTOR
        # Box: what a ray-like pixel averages over, 1e-6 of the whole pixel's. Above: facets off by a few times the
        # 1.2 µm that a mesh may be in the mean.
        assert np.abs(difference[pure]).max() < {UPPER: 5e-6, LOWER: 1e-8}[row]
        assert np.mean((cast.coverage[:, row] > 0.5) == (planar.coverage[:, row] > 0.5)) > 0.99


@pytest.mark.parametrize("name", ["cone", "sphere"])
def test_where_the_radius_changes_the_central_row_is_off_by_the_height_between_axis_and_surface(name):
    spec = catalog()[name]
    sensor = SENSOR.with_(fill_factor=(TINY, TINY))
    views = Views.broadcast(np.linspace(0.8, 1.6, 20))
    cast = Renderer(build_mesh(spec), sensor).render_views(views, rows=(UPPER, UPPER + 1))
    landmark = outline_of(spec)
    planar = planar_images(landmark, sensor, views, rows=(UPPER, UPPER + 1))
    t_v = SLOPE[UPPER]
    # The row meets the surface at z = t_v x, with x between D − r and D, the model has it at z = t_v D.
    at_axis = landmark.radius_m(views.distance_m * t_v)
    nearer = landmark.radius_m((views.distance_m - at_axis.max()) * t_v)
    # Off the middle a change of radius moves the point on the line by dr / cos θ.
    aside = np.abs(views.distance_m[:, None] * np.sin(AZIMUTH)) / np.minimum(at_axis, nearer)[:, None]
    inner = aside < 0.8
    bound = np.abs(at_axis - nearer)[:, None] / np.sqrt(1 - np.minimum(aside, 0.8) ** 2)
    difference = np.abs(cast.range_m - planar.range_m * ELEVATION_FACTOR)[:, 0]
    assert inner.sum() > len(views)
    assert np.all(difference[inner] <= bound[inner] + 5e-6)  # facets, as above
    assert bound[inner].max() < 3e-3


def test_whole_pixels_on_one_face_agree_to_what_a_pixel_averages():
    cast = Renderer(build_mesh(catalog()["cylinder"]), SENSOR).render_views(VIEWS, rows=(LOWER, LOWER + 1))
    planar = planar_images(CYLINDER, SENSOR, VIEWS, rows=(LOWER, LOWER + 1))
    rotation, translation = VIEWS.landmark2cam()
    corners = np.array([[x, y, 0] for x in (-LENGTH / 2, LENGTH / 2) for y in (-WIDTH / 2, WIDTH / 2)])
    corners = corners @ rotation.swapaxes(1, 2) + translation[:, None]
    pitch = SLOPE[0] - SLOPE[1]
    holds_corner = (np.abs((corners[..., 1] / corners[..., 0])[..., None] - SLOPE) <= pitch / 2).any(axis=1)
    pure = (cast.coverage[:, 0] > 1 - 1e-9) & ~holds_corner
    assert pure.sum() >= 30
    # On a face whose distance is t(y) ∝ 1 / (1 − κ tan az), |κ| the tangent of its slant, a pixel's range is spread by
    # s = κ r · pitch / √12 about its centre; weighting with cos θ / r² ∝ 1/t³ and curvature shift the mean by up to
    # about (3 + 1) s² / r. With the grazing faces left out, |κ| ≤ 2: s ≤ 2 · 1.5 m · 0.0243 / √12 = 21 mm.
    incidence = planar.amplitude[:, 0] / 0.8 * planar.range_m[:, 0] ** 2
    pure &= incidence > 1 / math.sqrt(5)
    spread = 2 * pitch / math.sqrt(12) * planar.range_m[:, 0]
    difference = np.abs(cast.range_m[:, 0] - planar.range_m[:, 0] * ELEVATION_FACTOR)
    assert np.all(difference[pure] <= (4 * spread**2 / planar.range_m[:, 0])[pure])
    assert np.median(difference[pure]) < 2e-4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rows": 15}, "even number of rows, got 15"),
        ({"principal_point_px": (8, 9)}, "centred principal point, got"),
        ({"principal_point_px": (7, 8)}, "centred principal point, got"),
        ({"pitch_deg": 1}, "'pitch_deg' = 0, got 1"),
        ({"roll_deg": -2}, "'roll_deg' = 0, got -2"),
        ({"height_offset_m": 0.02}, "'height_m' = 0, got 0.02"),
    ],
)
def test_a_camera_out_of_the_plane_is_refused(changes, message):
    with pytest.raises(UsageError, match=message):
        ranges(sensor=SENSOR.with_(**changes), distance_m=1.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"views": Views.broadcast([1.0, 1.0], height_m=[0.0, 0.02])}, r"'height_m' = 0, got 0.02 in view 1"),
        ({"views": Views.broadcast([1.0, 0.1])}, "in view 1 the lens is inside the landmark"),
        ({"views": Views.broadcast(0.05, math.pi / 2), "rows": (0, 8)}, "the lens is inside the landmark"),
        ({"albedo": 0.0}, "'albedo' must be in"),
        ({"harmonics": (1,)}, "'harmonics' must be"),
        ({"rows": (8, 17)}, "'rows' must lie in 0 … 16"),
    ],
)
def test_arguments_out_of_range_are_refused(arguments, message):
    with pytest.raises(UsageError, match=message):
        planar_images(**{"landmark": CYLINDER, "sensor": SENSOR, "views": Views.broadcast(1.0), **arguments})


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"box_length_m": 0.0}, "'box_length_m' must be a positive number"),
        ({"box_width_m": math.nan}, "'box_width_m' must be a positive number"),
        ({"profile_m": [(0.1, 0.0)]}, "'profile_m' must be two points"),
        ({"profile_m": [(0.1, 0.0), (-0.1, 0.1)]}, "'profile_m' must be two points"),
        ({"profile_m": [(0.1, 0.0), (math.inf, 0.1)]}, "'profile_m' must be two points"),
        ({"profile_m": [(0.1, 0.0), (0.1,)]}, "'profile_m' must be two points"),
        ({"profile_m": np.full((2, 3), 0.1)}, "'profile_m' must be two points"),
        ({"profile_m": ["ab", "cd"]}, "'profile_m' must be two points"),
    ],
)
def test_a_landmark_that_is_none_is_refused(fields, message):
    with pytest.raises(UsageError, match=message) as caught:
        PlanarLandmark(**{"box_length_m": LENGTH, "box_width_m": WIDTH, **fields})
    assert "\n" not in str(caught.value)


def test_without_an_upper_part_the_upper_rows_are_empty():
    image = planar_images(PlanarLandmark(LENGTH, WIDTH), SENSOR, Views.broadcast(1.0))
    assert not image.coverage[:, :8].any()
    assert image.coverage[:, 8:].any()
