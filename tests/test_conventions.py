"""Every sign and origin of PHYSICS sections 1 to 3, pinned in one place.

Each is read off a rendered image, where it matters, and off the formula that says it. Two instruments: plates, whose
edges show in the coverage where a point is seen, and pixels with a tiny active area, which see along one ray.
"""

import math

import numpy as np
import pytest
import trimesh
from builders import block, sheet

from phasemark.render import Background, Renderer, Sensor, Views, preset

TAN = math.tan(math.radians(11))
C_M_S = 299_792_458.0
PMD = preset("pmd-16x16")
POINT = PMD.with_(fill_factor=(1e-4, 1e-4))  # sees along the ray of the pixel's centre


BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.02)
FINER = 16


def seen_at(point, sensor=PMD, **view):
    """Return where the centre of a small ball at a point of the landmark frame is seen, (u, v).

    Rendered on pixels 16 times finer, so that the mean of the centres of covered pixels is that of the covered area.
    """
    u0, v0 = sensor.centre_px
    fine = sensor.with_(rows=16 * FINER, cols=16 * FINER, principal_point_px=(u0 * FINER, v0 * FINER))
    image = Renderer(BALL.copy().apply_translation(point), fine).render(**{"distance_m": 1.0, **view})
    v, u = (np.mgrid[: fine.rows, : fine.cols] + 0.5) / FINER
    return np.average(u, weights=image.coverage[0]), np.average(v, weights=image.coverage[0])


# --- pixels (section 2) ---


def test_the_centre_of_the_top_left_pixel_looks_left_and_up():
    d = PMD.pixel_directions()[0, 0]
    assert d[1] > 0
    assert d[2] > 0
    np.testing.assert_allclose(d[1:] / d[0], [TAN * 15 / 16, TAN * 15 / 16], rtol=1e-12)  # rounding


def test_the_half_angle_is_that_of_the_images_edge():
    left, right = PMD.ray_directions(0.0, 8.0), PMD.ray_directions(16.0, 8.0)
    top, bottom = PMD.ray_directions(8.0, 0.0), PMD.ray_directions(8.0, 16.0)
    for d, expected in [(left, (1, TAN, 0)), (right, (1, -TAN, 0)), (top, (1, 0, TAN)), (bottom, (1, 0, -TAN))]:
        np.testing.assert_allclose(d, np.array(expected) * math.cos(math.radians(11)), atol=1e-15)  # rounding


@pytest.mark.parametrize("at", [1.25, 4.0, 7.3, 15.999])
def test_a_rendered_point_is_seen_where_the_pixel_grid_says(at):
    far, edge = (-2, 2), (TAN * (1 - 2 * at / 16), 2)  # from the edge to far out on the left, or above
    for plate, across in ((sheet(edge, far), 1), (sheet(far, edge), 0)):
        covered = Renderer(plate, PMD).render(1.0).coverage[0]
        np.testing.assert_allclose(covered.sum(axis=across), at, atol=1e-6)  # the convention is asked for to 1e-6
        assert covered[0, 0] == pytest.approx(1, abs=1e-12)


def test_columns_and_rows_have_their_own_half_angle():
    sensor = Sensor(rows=6, cols=10, half_angle_h_deg=20, half_angle_v_deg=10)
    np.testing.assert_allclose(
        sensor.ray_directions(0.0, 3.0)[1] / sensor.ray_directions(0.0, 3.0)[0], math.tan(math.radians(20))
    )
    np.testing.assert_allclose(
        sensor.ray_directions(5.0, 0.0)[2] / sensor.ray_directions(5.0, 0.0)[0], math.tan(math.radians(10))
    )
    assert sensor.pixel_directions().shape == (6, 10, 3)


def test_the_range_runs_along_the_ray():
    plate = block((0, 0.1), (-2, 2), (-2, 2))
    range_m = Renderer(plate, POINT).render(1.0).range_m[0]
    y = z = TAN * 15 / 16
    assert range_m[0, 0] == pytest.approx(math.sqrt(1 + y**2 + z**2), abs=1e-6)  # the active area's width
    assert range_m[0, 0] > 1.03


def test_the_active_area_is_a_centred_rectangle_of_width_by_height():
    sensor = PMD.with_(fill_factor=(0.5, 0.25))
    # an edge a quarter into the active area of column 3, which spans u = 3.25 … 3.75
    y = TAN * (1 - 2 * (3.25 + 0.125) / 16)
    covered = Renderer(sheet((y, 2), (-2, 2)), sensor).render(1.0).coverage[0]
    np.testing.assert_allclose(covered[:, 3], 0.25, atol=1e-6)
    z = TAN * (1 - 2 * (3.375 + 0.0625) / 16)  # rows: v = 3.375 … 3.625
    covered = Renderer(sheet((-2, 2), (z, 2)), sensor).render(1.0).coverage[0]
    np.testing.assert_allclose(covered[3], 0.25, atol=1e-6)


def test_vignetting_is_the_fourth_power_of_the_cosine_off_the_optical_axis():
    plate = block((0, 0.1), (-2, 2), (-2, 2))
    plain = Renderer(plate, POINT).render(1.0).amplitude[0]
    dimmed = Renderer(plate, POINT.with_(vignetting=True)).render(1.0).amplitude[0]
    np.testing.assert_allclose(dimmed / plain, POINT.pixel_directions()[..., 0] ** 4, rtol=1e-6)  # active area
    assert PMD.ray_directions(0.0, 0.0)[0] ** 4 == pytest.approx(1 - 0.14, abs=0.005)  # "14 % at the corners"


# --- mounting (section 2) ---


def test_a_positive_pitch_looks_down():
    assert PMD.with_(pitch_deg=5).ray_directions(8.0, 8.0)[2] == pytest.approx(-math.sin(math.radians(5)))
    u, v = seen_at((0, 0, 0), PMD.with_(pitch_deg=1))
    assert u == pytest.approx(8, abs=1e-3)  # the ball is a polyhedron
    assert v == pytest.approx(8 - 8 * math.tan(math.radians(1)) / TAN, abs=1e-3)  # 0.7 pixel higher


ROLL, BEARING = math.radians(10), math.radians(3)


@pytest.mark.parametrize(
    ("point", "mounting", "u", "v"),
    [  # Rx(roll) turns the camera; the world turns the other way
        ((0, 0.1, 0), {"roll_deg": 10}, 8 - 8 * 0.1 * math.cos(ROLL) / TAN, 8 + 8 * 0.1 * math.sin(ROLL) / TAN),
        ((0, 0, 0), {"bearing_offset_deg": 3}, 8 - 8 * math.tan(BEARING) / TAN, 8),
        ((0, 0, 0), {"height_offset_m": 0.05}, 8, 8 - 8 * 0.05 / TAN),
    ],
    ids=["a roll lowers what is on the left", "a bearing offset moves to the left", "a height offset raises"],
)
def test_a_positive_offset_of_the_mounting_moves_what_is_seen(point, mounting, u, v):
    found = seen_at(point, PMD.with_(**mounting))
    assert found == pytest.approx((u, v), abs=5e-3)  # a ball off the axis is an ellipse


def test_offsets_of_the_mounting_are_added_to_views_and_the_images_keep_the_views_asked_for():
    mounted = PMD.with_(bearing_offset_deg=2.0, height_offset_m=-0.02, pitch_deg=1.5)
    plain = mounted.with_(bearing_offset_deg=0.0, height_offset_m=0.0)
    body = block((-0.1, 0.1), (-0.07, 0.07), (-0.1, 0.05))
    where, there = (1.0, 0.3, 0.01, 0.02), (1.0, 0.3, 0.01 + math.radians(2.0), 0.0)
    behind = Background(wall_m=2.0, floor_m=0.2)
    for call in (
        lambda renderer, view: renderer.render(*view, background=behind).phasor,
        lambda renderer, view: renderer.render(*view, variant="hard").phasor,
        lambda renderer, view: renderer.jacobian(*view),
    ):
        np.testing.assert_array_equal(call(Renderer(body, mounted), where), call(Renderer(body, plain), there))
    views = Renderer(body, mounted).render(*where).views
    assert (views.bearing_rad[0], views.height_m[0]) == (0.01, 0.02)
    assert mounted.optics_difference(plain) is not None


def test_pitch_is_applied_after_roll():
    """Ry(pitch) · Rx(roll), by hand: the camera's left edge, rolled by 90°, looks up; then pitch lowers it."""
    sensor = PMD.with_(pitch_deg=4, roll_deg=45)
    pitch, s = math.radians(4), math.sqrt(0.5)
    y, z = TAN * s, TAN * s  # Rx(45°) · (1, TAN, 0)
    level = np.array([math.cos(pitch) + math.sin(pitch) * z, y, -math.sin(pitch) + math.cos(pitch) * z])
    np.testing.assert_allclose(sensor.ray_directions(0.0, 8.0), level / np.linalg.norm(level), atol=1e-14)


def test_the_optical_axis_meets_the_image_in_the_principal_point():
    sensor = PMD.with_(principal_point_px=(7.25, 9.5))
    np.testing.assert_allclose(sensor.ray_directions(7.25, 9.5), [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(seen_at((0, 0, 0), sensor), (7.25, 9.5), atol=1e-3)
    # a shift alone: the scale stays that of the half angle
    assert sensor.ray_directions(7.25 - 8, 9.5)[1] / sensor.ray_directions(7.25 - 8, 9.5)[0] == pytest.approx(TAN)


def test_intrinsics_count_the_principal_point_from_the_corner():
    sensor = Sensor.from_intrinsics(41.0, 43.0, 7.5, 8.25, rows=16, cols=16)
    d = sensor.ray_directions(7.5 + 4.1, 8.25 - 4.3)
    np.testing.assert_allclose(d / d[0], [1, -0.1, 0.1], atol=1e-14)


# --- views (section 1) ---


def rz(angle):
    return np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])


def test_the_view_is_equation_9_with_bearing_and_height():
    distance, delta, b, h = 1.3, 0.7, -0.2, 0.05
    r_delta = np.array([[math.cos(delta), math.sin(delta), 0], [-math.sin(delta), math.cos(delta), 0], [0, 0, 1]])
    point = np.array([0.3, -0.2, 0.1])
    expected = rz(b) @ (r_delta @ point + [distance, 0, 0]) + [0, 0, h]
    views = Views.broadcast(distance, delta, b, h)
    rotation, translation = views.landmark2cam()
    np.testing.assert_allclose(rotation[0] @ point + translation[0], expected, atol=1e-15)
    lens = [-distance * math.cos(delta), -distance * math.sin(delta), -h]
    np.testing.assert_allclose(views.lens_in_landmark()[0], lens, atol=1e-15)
    np.testing.assert_allclose(rotation[0] @ lens + translation[0], 0, atol=1e-15)
    axis = rotation[0].T @ [1, 0, 0]
    assert math.atan2(axis[1], axis[0]) == pytest.approx(delta - b)  # heading of the optical axis


def test_delta_zero_sees_the_side_towards_negative_x_and_delta_90_that_towards_negative_y():
    box = block((-0.1, 0.3), (-0.2, 0.4), (-1, 1))
    centre = (slice(None), 8, 8)
    renderer = Renderer(box, POINT)
    faces = renderer.render(2.0, np.radians([0, 90, 180, 270])).range_m[centre]
    d = POINT.pixel_directions()[8, 8]
    np.testing.assert_allclose(faces * d[0], [2 - 0.1, 2 - 0.2, 2 - 0.3, 2 - 0.4], atol=1e-6)


def test_delta_turns_the_landmark_clockwise_seen_from_above():
    assert seen_at((0, 0.1, 0))[0] < 7  # δ = 0: y' points left
    assert seen_at((0.1, 0, 0), delta_rad=math.pi / 2)[0] > 9  # δ = 90°: x' points right
    assert seen_at((0.1, 0, 0), delta_rad=0.3)[0] > 8.1
    # a pixel and a half by hand: y = −0.1 sin δ, x = 1 + 0.1 cos δ
    u = 8 * (1 + 0.1 * math.sin(0.3) / (1 + 0.1 * math.cos(0.3)) / TAN)
    assert seen_at((0.1, 0, 0), delta_rad=0.3)[0] == pytest.approx(u, abs=1e-3)


def test_a_positive_bearing_is_seen_left_and_a_positive_height_above():
    u, v = seen_at((0, 0, 0), bearing_rad=0.1)
    assert u == pytest.approx(8 * (1 - math.tan(0.1) / TAN), abs=2e-3)
    assert v == pytest.approx(8, abs=1e-3)
    u, v = seen_at((0, 0, 0), height_m=0.1)
    assert u == pytest.approx(8, abs=1e-3)
    assert v == pytest.approx(8 * (1 - 0.1 / TAN), abs=2e-3)


def test_the_interface_at_height_zero_falls_on_the_images_middle_line():
    lower, upper = block((-0.1, 0.1), (-0.1, 0.1), (-0.1, 0)), block((-0.1, 0.1), (-0.1, 0.1), (0, 0.1))
    assert Renderer(lower, PMD).render(1.0).coverage[0, :8].max() == 0
    assert Renderer(upper, PMD).render(1.0).coverage[0, 8:].max() == 0


# --- phasors (section 3) ---


def test_a_white_plane_at_one_metre_facing_the_camera_has_amplitude_one():
    sensor = PMD.with_(rows=1, cols=1, half_angle_h_deg=1e-3, half_angle_v_deg=1e-3)
    image = Renderer(block((0, 0.1), (-1, 1), (-1, 1)), sensor, albedo=1.0).render(1.0)
    assert image.amplitude[0, 0, 0] == pytest.approx(1, abs=1e-8)  # (10⁻³ °)² of slant
    assert image.intensity[0, 0, 0] == pytest.approx(1, abs=1e-8)


def test_light_falls_with_albedo_cosine_and_the_square_of_range():
    plate = block((0, 0.1), (-9, 9), (-9, 9))
    image = Renderer(plate, POINT, albedo=0.4).render(2.0, math.radians(30))
    # the plane x' = 0 seen 30° from its normal along the axis: 2 m · cos 30° from the lens
    d = POINT.pixel_directions() @ Views.broadcast(2.0, math.radians(30)).landmark2cam()[0][0]
    cos, distance = d[..., 0], 2 * math.cos(math.radians(30)) / d[..., 0]
    np.testing.assert_allclose(image.amplitude[0], 0.4 * cos / distance**2, rtol=1e-6)  # active area
    np.testing.assert_allclose(image.range_m[0], distance, rtol=1e-6)


def test_the_phase_grows_with_range_and_wraps_at_half_the_modulation_wavelength():
    period = C_M_S / 2 / 10e6
    assert pytest.approx(14.9896, abs=5e-5) == period
    plate = block((0, 0.1), (-9, 9), (-9, 9))
    d = POINT.pixel_directions()[8, 8]
    renderer = Renderer(plate, POINT, harmonics=(2,))
    image = renderer.render(np.array([1.0, 14.9, 16.0, 31.0]) * d[0])
    np.testing.assert_allclose(image.range_m[:, 8, 8], [1.0, 14.9, 16.0 - period, 31.0 - 2 * period], atol=1e-5)
    assert np.angle(image.phasor[0, 8, 8]) == pytest.approx(4 * math.pi * 10e6 / C_M_S, abs=1e-6)
    assert np.angle(image.harmonic(2)[0, 8, 8]) == pytest.approx(8 * math.pi * 10e6 / C_M_S, abs=1e-6)


def test_coverage_counts_the_landmark_and_not_the_background():
    plate = sheet((TAN * (1 - 2 * 7.3 / 16), 2), (-2, 2))
    bare = Renderer(plate, PMD).render(1.0)
    walled = Renderer(plate, PMD).render(1.0, background=Background(wall_m=2.0))
    np.testing.assert_array_equal(bare.coverage, walled.coverage)
    assert bare.coverage[0, 8, 7] == pytest.approx(0.3, abs=1e-6)
    assert (walled.intensity > bare.intensity)[0, :, 7:].all()
    # the pixel's mean, not the mean over the covered part
    assert bare.intensity[0, 8, 7] == pytest.approx(0.3 * 0.8, rel=5e-3)  # r² / cos θ is 1 within that


def test_no_return_is_a_phasor_of_zero_and_a_range_of_nan():
    image = Renderer(BALL, PMD).render(1.0)
    assert image.phasor[0, 0, 0] == 0
    assert image.intensity[0, 0, 0] == 0
    assert math.isnan(image.range_m[0, 0, 0])


# --- background (section 3) ---


def test_the_wall_stands_across_the_horizontal_line_of_sight_and_turns_with_the_bearing():
    b, wall_m = 0.15, 3.0
    image = Renderer(BALL, POINT).render(1.0, 0.4, b, 0.05, background=Background(wall_m=wall_m))
    d = POINT.pixel_directions()
    forward = d[..., 0] * math.cos(b) + d[..., 1] * math.sin(b)
    empty = image.coverage[0] == 0
    np.testing.assert_allclose(image.range_m[0][empty], (wall_m / forward)[empty], atol=1e-5)  # active area
    np.testing.assert_allclose(image.amplitude[0][empty], (0.5 * forward**3 / wall_m**2)[empty], rtol=1e-5)


def test_the_floor_lies_below_the_lens_and_is_seen_below_the_horizon_only():
    sensor = POINT.with_(pitch_deg=2)
    image = Renderer(BALL, sensor).render(1.0, bearing_rad=0.1, background=Background(floor_m=0.5))
    d = sensor.pixel_directions()
    floor = (image.coverage[0] == 0) & (d[..., 2] < 0)
    down = -d[floor][:, 2]
    np.testing.assert_allclose(image.amplitude[0][floor], 0.5 * down**3 / 0.5**2, rtol=1e-5)
    wrapped = (0.5 / down) % sensor.unambiguous_range_m
    np.testing.assert_allclose(image.range_m[0][floor], wrapped, rtol=1e-5)
    assert (image.intensity[0][(image.coverage[0] == 0) & (d[..., 2] > 0)] == 0).all()


def test_the_nearest_of_landmark_wall_and_floor_is_seen():
    image = Renderer(block((0, 0.1), (-0.05, 0.05), (-0.05, 0.05)), POINT).render(
        1.0, background=Background(wall_m=2.0, floor_m=0.2)
    )
    d = POINT.pixel_directions()
    expected = np.minimum(2.0 / d[..., 0], np.where(d[..., 2] < 0, 0.2 / np.maximum(-d[..., 2], 1e-9), np.inf))
    on_plate = (np.abs(d[..., 1] / d[..., 0]) < 0.05) & (np.abs(d[..., 2] / d[..., 0]) < 0.05)
    expected[on_plate] = 1 / d[..., 0][on_plate]
    np.testing.assert_allclose(image.range_m[0], expected, atol=1e-5)
    np.testing.assert_array_equal(image.coverage[0], on_plate)
