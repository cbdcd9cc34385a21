"""Motion during the four phase images: the views' change, and frames against four analytic views."""

import math

import numpy as np
import pytest
import trimesh
from scipy.integrate import solve_ivp

from phasemark import UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Renderer, Views, capture, preset
from phasemark.render.exposure import Motion, capture_moving, render_moving
from phasemark.render.exposure.motion import phase_image_times_s

IDEAL = preset("ideal")


def test_phase_images_stand_about_mid_frame():
    np.testing.assert_allclose(phase_image_times_s(IDEAL), np.array([-1.5, -0.5, 0.5, 1.5]) / 12)
    np.testing.assert_allclose(phase_image_times_s(IDEAL.with_(phase_interval_s=0.01)), [-0.015, -0.005, 0.005, 0.015])


@pytest.mark.parametrize("motion", [Motion(0.5, 0, 0), Motion(0, 0.3, 0), Motion(0, 0, 1.2), Motion(0.5, -0.3, 0.8)])
@pytest.mark.parametrize("time_s", [-0.7, 0.4])
def test_views_after_motion_are_those_of_the_lens_driven_through_the_world(motion, time_s):
    views = Views.broadcast([1.0, 2.0], [0.4, -2.0], [0.1, -0.3], 0.05)
    moved = motion.views_after(views, time_s)

    def drive(_, pose):  # in the landmark frame: position and heading of the optical axis
        _, _, heading = pose
        c, s = math.cos(heading), math.sin(heading)
        return [
            motion.forward_m_s * c - motion.sideways_m_s * s,
            motion.forward_m_s * s + motion.sideways_m_s * c,
            motion.yaw_rate_rad_s,
        ]

    for i in range(2):
        lens = views.lens_in_landmark()[i]
        start = [lens[0], lens[1], views.delta_rad[i] - views.bearing_rad[i]]
        x, y, heading = solve_ivp(drive, (0, time_s), start, rtol=1e-11, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(moved.lens_in_landmark()[i], [x, y, lens[2]], rtol=0, atol=1e-9)  # the solver's
        turned = moved.delta_rad[i] - moved.bearing_rad[i] - heading
        assert math.remainder(turned, 2 * math.pi) == pytest.approx(0, abs=1e-9)


def plate():
    """A plate whose front stands 0.5 m before the axis, facing the camera at δ = 0."""
    return trimesh.creation.box((0.002, 6.0, 6.0), transform=trimesh.transformations.translation_matrix([-0.499, 0, 0]))


def test_driving_forward_at_half_a_metre_a_second_gives_the_frame_of_four_analytic_views():
    # pixels beside the axis see a plate at x_i = 1.5 − v t_i, facing: S = e^{iφ} / x²
    sensor = IDEAL.with_(rows=2, cols=2, half_angle_h_deg=0.01, half_angle_v_deg=0.01)
    motion, views = Motion(forward_m_s=0.5), Views.broadcast(2.0)
    renderer = Renderer(plate(), sensor, albedo=1.0)
    frames = capture_moving(renderer, views, sensor, motion, rng=np.random.default_rng(0), keep_taps=True)
    x = 1.5 - 0.5 * np.array([-1.5, -0.5, 0.5, 1.5]) / 12
    s = np.exp(1j * x / sensor.metres_per_radian) / x**2
    d = sensor.contrast * sensor.signal_e * (s * 1j ** np.arange(4)).real  # N_a − N_b
    phase = math.atan2(d[3] - d[1], d[0] - d[2]) % (2 * math.pi)
    expected = phase * sensor.metres_per_radian
    # half a pixel of 0.01° is off the axis by 1e-8 of the range; the renderer's float32 rays give no more than 1e-6
    np.testing.assert_allclose(frames.range_m, expected, rtol=0, atol=2e-6)
    taps = (
        0.5
        * sensor.signal_e
        * (1 / x[:, None] ** 2 + sensor.contrast * (s * 1j ** np.arange(4)).real[:, None] * [1, -1])
    )
    np.testing.assert_allclose(frames.taps_e[0, 0, :, :, 0, 0], taps, rtol=1e-6)
    assert abs(expected - 1.5) > 1e-3  # motion does shift the range


def test_a_camera_at_rest_has_four_equal_phase_images():
    renderer, views = Renderer(plate(), IDEAL), Views.broadcast(2.0, 0.1)
    moving = render_moving(renderer, views, Motion())
    still = renderer.render_views(views)
    frames = capture(moving, IDEAL, rng=np.random.default_rng(0))
    np.testing.assert_allclose(frames.range_m, capture(still, IDEAL, rng=np.random.default_rng(0)).range_m, rtol=1e-12)


def test_a_wall_comes_nearer_as_the_camera_drives_at_it():
    wall = Background(wall_m=4.0)
    moving = render_moving(Renderer(None, IDEAL), Views.broadcast(2.0), Motion(forward_m_s=0.5), background=wall)
    for image, time_s in zip(moving, phase_image_times_s(IDEAL), strict=True):
        expected = Renderer(None, IDEAL).render(1.0, background=Background(wall_m=4.0 - 0.5 * time_s))
        np.testing.assert_allclose(image.phasor, expected.phasor, rtol=1e-12)
    turning = render_moving(Renderer(None, IDEAL), Views.broadcast(2.0), Motion(yaw_rate_rad_s=0.5), background=wall)
    assert turning[0].views.bearing_rad[0] == pytest.approx(0.0625)


def test_a_wall_that_would_swing_is_refused():
    with pytest.raises(UsageError, match="'wall_m' cannot be rendered for this motion"):
        render_moving(
            Renderer(None, IDEAL), Views.broadcast(2.0), Motion(sideways_m_s=0.5), background=Background(wall_m=4.0)
        )


def test_a_velocity_must_be_finite_and_the_timing_the_same():
    with pytest.raises(UsageError, match="'forward_m_s' must be finite, got inf"):
        Motion(math.inf)
    with pytest.raises(UsageError, match=r"every 0\.01 s, but the renderer's every 0\.0833333 s"):
        capture_moving(
            Renderer(None, IDEAL), Views.broadcast(2.0), IDEAL.with_(phase_interval_s=0.01), Motion(),
            rng=np.random.default_rng(0),
        )  # fmt: skip
    with pytest.raises(UsageError, match="must be one set of images, or 4 of equal length"):
        capture([Renderer(None, IDEAL).render(1.0)] * 3, IDEAL, rng=np.random.default_rng(0))


def test_a_camera_that_pitches_and_rolls_is_rendered_at_the_tilt_of_each_phase_image():
    motion = Motion(forward_m_s=0.2, pitch_rate_rad_s=0.3, roll_rate_rad_s=-0.4)
    views = Views.broadcast(1.2, 0.4, 0.02, 0.01, 0.05, 0.1)
    renderer = Renderer(build_mesh(catalog()["cone"]), IDEAL)
    for time_s, image in zip(phase_image_times_s(IDEAL), render_moving(renderer, views, motion), strict=True):
        level = Motion(forward_m_s=0.2).views_after(Views.broadcast(1.2, 0.4, 0.02, 0.01), time_s)
        alone = renderer.render(
            level.distance_m, level.delta_rad, level.bearing_rad, level.height_m, 0.05 + 0.3 * time_s,
            0.1 - 0.4 * time_s,
        )  # fmt: skip
        np.testing.assert_allclose(image.phasor, alone.phasor, rtol=0, atol=1e-12)
