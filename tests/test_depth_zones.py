"""Depth images of other programs become what the zones of a sensor see (PHYSICS section 13)."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from phasemark import UsageError
from phasemark.render import Background, Body, Renderer, Scene, SceneRenderer, Sensor, capture, preset, zones_from_depth
from phasemark.render.direct import HistogramRenderer
from phasemark.render.integral.intersect import make_intersector

TAN = np.tan(np.radians(22.5))
ZONES = Sensor(rows=8, cols=8, half_angle_h_deg=22.5, half_angle_v_deg=22.5, modulation_hz=(10e6, 60e6))
BARS = {128: 2.5e-3, 256: 1e-3, 512: 3e-4}
"""R.m.s. error over zones that is allowed, as share of the brightest, by the size of the depth image."""


def intrinsics(n, tangent=TAN):
    return n / 2 / tangent, n / 2 / tangent, (n - 1) / 2, (n - 1) / 2


def tangents(n, tangent=TAN):
    """Tangents of the pixel centres to the right and downwards, (n, n) each."""
    at = tangent * ((2 * np.arange(n) + 1) / n - 1)
    return np.meshgrid(at, at)


def plane(x, y, normal, distance_m):
    """Return z where rays (x, y, 1) meet normal · p = −distance."""
    return -distance_m / (normal[0] * x + normal[1] * y + normal[2])


def ball_before_wall(x, y, centre, radius_m, wall):
    """Return z, unit normals and whether the ball is seen; `wall` is normal and distance of the plane behind it."""
    z = plane(x, y, *wall)
    length2 = 1 + x**2 + y**2
    along = centre[0] * x + centre[1] * y + centre[2]
    root = along**2 - length2 * (np.dot(centre, centre) - radius_m**2)
    hit = root > 0
    near = (along - np.sqrt(np.where(hit, root, 0))) / length2
    normals = np.stack([near * x - centre[0], near * y - centre[1], near - centre[2]], axis=-1) / radius_m
    return np.where(hit, near, z), np.where(hit[..., None], normals, wall[0]), hit


def amplitude_and_range(x, y, z, normals, albedo):
    length = np.sqrt(1 + x**2 + y**2)
    cosine = -(normals[..., 0] * x + normals[..., 1] * y + normals[..., 2]) / length
    return albedo * cosine / (z * length) ** 2, z * length


def mean_of_zones(values, n=8):
    m = len(values) // n
    return values.reshape(n, m, n, m).mean(axis=(1, 3))


def phasors_of(amplitude, range_m, sensor=ZONES):
    per_radian = [one.metres_per_radian for one in sensor.by_frequency]
    return np.stack([mean_of_zones(amplitude * np.exp(1j * range_m / scale)) for scale in per_radian])


def rms_share(phasors, truth):
    """Return the r.m.s. error over zones as share of the brightest, of the frequency where it is largest."""
    error = np.sqrt((np.abs(phasors - truth) ** 2).mean(axis=(-1, -2)))
    return float((error / np.abs(truth).max(axis=(-1, -2))).max())


TILTED = np.array([0.35, -0.2, -np.sqrt(1 - 0.35**2 - 0.2**2)])


def test_normals_of_a_plane_from_its_neighbours_are_those_of_the_plane():
    x, y = tangents(64)
    z = plane(x, y, TILTED, 1.2)
    given = zones_from_depth(z, intrinsics(64), ZONES, 0.6, np.broadcast_to(TILTED, (64, 64, 3)))
    found = zones_from_depth(z, intrinsics(64), ZONES, 0.6)
    np.testing.assert_allclose(found.images.phasors, given.images.phasors, rtol=1e-12)
    along_ray = zones_from_depth(z * np.sqrt(1 + x**2 + y**2), intrinsics(64), ZONES, 0.6, quantity="range")
    np.testing.assert_allclose(along_ray.images.phasors, given.images.phasors, rtol=1e-12)


def test_a_tilted_plane_converges_as_the_square_of_the_pixels():
    x, y = tangents(2048)
    amplitude, range_m = amplitude_and_range(x, y, plane(x, y, TILTED, 1.2), TILTED, 0.6)
    truth = phasors_of(amplitude, range_m)
    errors = []
    for n in (64, 128):
        zones = zones_from_depth(plane(*tangents(n), TILTED, 1.2), intrinsics(n), ZONES, 0.6)
        errors.append(rms_share(zones.images.phasors[0], truth))
    assert errors[1] < 2e-4
    assert 3.5 < errors[0] / errors[1] < 4.5  # 4, and the truth has pixels too
    np.testing.assert_allclose(zones.images.intensity[0], mean_of_zones(amplitude), rtol=1e-3)
    np.testing.assert_allclose(zones.images.coverage, 1.0, rtol=1e-12)


def test_a_ball_before_a_wall_meets_the_bars_with_normals_and_without():
    sensor = ZONES.with_(modulation_hz=60e6)
    wall = np.array([0.1, 0.05, -np.sqrt(1 - 0.1**2 - 0.05**2)]), 1.4
    found = {(n, known): [] for n in BARS for known in (True, False)}
    for centre, radius_m in (((0.03, -0.05, 0.7), 0.11), ((-0.12, 0.09, 0.9), 0.2), ((0.2, 0.17, 1.1), 0.13)):
        x, y = tangents(2048)
        z, normals, hit = ball_before_wall(x, y, centre, radius_m, wall)
        truth = phasors_of(*amplitude_and_range(x, y, z, normals, np.where(hit, 0.8, 0.4)), sensor)
        for n, known in found:
            z, normals, hit = ball_before_wall(*tangents(n), centre, radius_m, wall)
            zones = zones_from_depth(z, intrinsics(n), sensor, np.where(hit, 0.8, 0.4), normals if known else None)
            error = rms_share(zones.images.phasors[0], truth)
            found[n, known].append((error, zones.discretisation_error[0]))
    for (n, known), errors in found.items():
        true, stated = np.sqrt((np.array(errors) ** 2).mean(axis=0))
        print(n, "with" if known else "without", "normals", true, stated)
        assert true < BARS[n]
        assert 0.5 < stated / true < 2


def turned(angles_deg):
    """Return the rotation from a camera turned by yaw, pitch and roll to the unturned one, optical frame."""
    yaw, pitch, roll = np.radians(angles_deg)
    return trimesh.transformations.euler_matrix(pitch, yaw, roll, "sxyz")[:3, :3]


def test_a_furnished_room_seen_by_turned_depth_cameras_meets_the_bars():
    golden = np.load(Path(__file__).parent / "golden" / "room_depth.npz")
    vertices, faces, albedo = golden["vertices"], golden["faces"], golden["albedo"]
    sensor = ZONES.with_(modulation_hz=tuple(golden["frequencies_hz"].tolist()))
    intersector = make_intersector(vertices, faces, "float64")
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    wider = 0.55  # tangent that a camera turned by a few degrees has to see
    turns = [turned(angles) for angles in ((1.1, -0.7, 7.0), (-0.9, 1.0, -5.0), (0.4, 0.8, 11.0))]
    for n, allowed in BARS.items():
        found = []
        for turn in turns:
            rays = np.stack([*tangents(n, wider), np.ones((n, n))], axis=-1).reshape(-1, 3)
            right, down, ahead = (rays @ turn.T).T
            world = np.column_stack([ahead, -right, -down])
            face = intersector.first_face(np.zeros_like(world), world)
            normal = normals[face]
            z = np.where(face >= 0, (normal * corners[face, 0]).sum(axis=1) / (normal * world).sum(axis=1), 0.0)
            zones = zones_from_depth(
                z.reshape(n, n), intrinsics(n, wider), sensor, albedo[face].reshape(n, n), depth2camera=turn
            )
            error = rms_share(zones.images.phasors[0], golden["phasor"])
            found.append((error, zones.discretisation_error[0]))
        true, stated = np.sqrt((np.array(found) ** 2).mean(axis=0))
        print(n, true, stated)
        assert true < allowed
        assert 0.5 < stated / true < 2


def facing(*place):
    """Return the pose of a plane that faces the camera, x to the right and y down."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], place
    return pose


def test_rolling_the_depth_camera_spreads_the_error_of_edges_along_columns():
    n, wider, rng = 256, 0.45, np.random.default_rng(7)
    turn = turned((0.0, 0.0, 4.0))
    errors = {"level": [], "rolled": []}
    for _ in range(8):
        left, right, top, bottom = rng.uniform(0.1, 0.3, 4) * [-1, 1, -1, 1]
        plate = Body.plane(
            (0.8 * (right - left), 0.8 * (bottom - top)),
            pose=facing(0.8, -0.4 * (left + right), -0.4 * (top + bottom)),
        )
        wall = Body.plane((9, 9), pose=facing(2.0, 0.0, 0.0))
        exact = SceneRenderer(Scene([plate, wall]), ZONES).phasors(np.eye(4)).phasors[0]
        for name, turn_of, tangent in (("level", np.eye(3), TAN), ("rolled", turn, wider)):
            rays = np.stack([*tangents(n, tangent), np.ones((n, n))], axis=-1) @ turn_of.T
            x, y = rays[..., 0], rays[..., 1]
            depth = np.where((x > left) & (x < right) & (y > top) & (y < bottom), 0.8, 2.0)
            zones = zones_from_depth(depth, intrinsics(n, tangent), ZONES, depth2camera=turn_of)
            errors[name].append(rms_share(zones.images.phasors[0], exact))
    level, rolled = (np.sqrt(np.mean(np.square(errors[name]))) for name in ("level", "rolled"))
    print(level, rolled)
    assert level > BARS[n]  # a quarter of a pixel, the mean, along whole edges
    assert rolled < 0.5 * level


def test_pixels_that_a_border_cuts_count_in_part():
    n, wider = 13, 0.5
    depth = np.full((n, n), 2.0)
    depth[:, 8:] = np.nan
    zones = zones_from_depth(depth, intrinsics(n, wider), ZONES)
    border = wider * (2 * 8 / n - 1)  # left edge of the first column that is empty
    share = np.clip((border + TAN) / (TAN / 4) - np.arange(8), 0, 1)
    np.testing.assert_allclose(zones.images.coverage[0], np.tile(share, (8, 1)), atol=1e-12)
    assert (zones.images.phasor[0, :, share == 0] == 0).all()
    narrow = zones_from_depth(depth, intrinsics(n, wider), ZONES.with_(fill_factor=(0.5, 1.0)))
    share = np.clip((border + TAN) / (TAN / 8) - 2 * np.arange(8) - 0.5, 0, 1)
    np.testing.assert_allclose(narrow.images.coverage[0], np.tile(share, (8, 1)), atol=1e-12)


def test_gaps_between_active_areas_that_are_narrower_than_parts_of_pixels_give_no_light():
    sensor = preset("pmd-16x16").with_(fill_factor=(0.99, 0.995))
    wall, at = np.ones((256, 256)), intrinsics(256, np.tan(np.radians(20)))
    level, rolled = (zones_from_depth(wall, at, sensor, depth2camera=turned((0, 0, a))).images for a in (0.0, 5.0))
    np.testing.assert_allclose(rolled.intensity, level.intensity, rtol=2e-4)


@pytest.mark.parametrize("lens", [(-0.25, 0.06, 0.001, -0.002), ()], ids=["distortion", "ideal"])
def test_zones_of_a_wall_are_those_of_the_renderer(lens):
    matrix = np.array([[9.0, 0.0, 3.4], [0.0, 9.2, 3.6], [0.0, 0.0, 1.0]])
    sensor = Sensor.from_opencv(
        matrix, lens, size=(8, 8), vignetting=True, modulation="square", max_harmonic=5, modulation_hz=(10e6, 30e6)
    )
    exact = Renderer(None, sensor).render(distance_m=1.0, background=Background(wall_m=1.5, wall_albedo=0.7))
    n = 300
    zones = zones_from_depth(np.full((n, n), 1.5), intrinsics(n, 0.8), sensor, 0.7)
    assert rms_share(zones.images.phasors[0], exact.phasors[0]) < 2e-4
    assert set(zones.images.harmonics) == set(exact.harmonics)
    assert set(zones.images.by_hz) == set(exact.by_hz)
    for order, phasor in exact.harmonics.items():
        assert rms_share(zones.images.harmonics[order][0], phasor[0]) < 5e-4  # turns five times as fast
    np.testing.assert_allclose(zones.images.coverage, 1.0, atol=2e-4)  # bent borders cut pixels in straight lines


@pytest.mark.parametrize("name", ["vl53l5cx-8x8", "tmf8820-3x3"])
def test_histograms_of_a_plate_are_those_of_the_renderer(name):
    sensor = preset(name)
    plate = trimesh.creation.box((0.002, 0.31, 0.23))
    exact = HistogramRenderer(plate, sensor).render(distance_m=0.701)
    n, tangent = 512, 0.7
    x, y = tangents(n, tangent)
    depth = np.where((np.abs(x) < 0.155 / 0.7) & (np.abs(y) < 0.115 / 0.7), 0.7, 0.0)
    zones = zones_from_depth(depth, intrinsics(n, tangent), sensor)
    peak = exact.expected.max()
    assert np.abs(zones.histograms.expected - exact.expected).max() < 0.02 * peak  # half a pixel at edges of the plate
    assert np.sqrt(((zones.histograms.signal - exact.signal) ** 2).mean()) < 0.01 * exact.signal.max()
    middle = (0, sensor.rows // 2, sensor.cols // 2)
    np.testing.assert_allclose(zones.histograms.expected[middle], exact.expected[middle], atol=2e-3 * peak)
    frames = capture(zones.histograms, sensor, rng=np.random.default_rng(1))
    assert np.isfinite(frames.targets.distance_m[0, 0, middle[1], middle[2], 0])


def test_a_batch_is_its_images_and_can_be_captured():
    x, y = tangents(32)
    depth = np.stack([plane(x, y, TILTED, 1.0), plane(x, y, np.array([0, 0, -1.0]), 2.0)]).astype(np.float32)
    albedo = np.random.default_rng(3).uniform(0.1, 0.9, depth.shape)
    both = zones_from_depth(depth, intrinsics(32), ZONES, albedo)
    matrix = [[intrinsics(32)[0], 0, 15.5], [0, intrinsics(32)[1], 15.5], [0, 0, 1]]
    for k in range(2):
        one = zones_from_depth(depth[k], matrix, ZONES, albedo[k])
        np.testing.assert_array_equal(both.images.phasors[k], one.images.phasors[0])
        assert both.discretisation_error[k] == one.discretisation_error[0]
    frames = capture(both.images, ZONES, rng=np.random.default_rng(0), n_frames=3)
    assert frames.range_m.shape == (2, 3, 8, 8)
    assert np.isfinite(frames.range_m).all()


def test_nothing_returns_from_pixels_without_depth_and_from_beyond_the_image():
    depth = np.full((16, 16), np.inf)
    depth[:8], depth[12:], depth[8, :3] = np.nan, -1.0, [1e-300, 1e-200, 1e300]
    zones = zones_from_depth(depth, intrinsics(16), ZONES)
    assert not zones.images.intensity.any()
    assert zones.discretisation_error[0] == 0
    narrow = zones_from_depth(np.ones((16, 16)), intrinsics(16, TAN / 2), ZONES, allow_uncovered=True)
    np.testing.assert_allclose(narrow.images.coverage[0, 3:5, 3:5], 1.0, rtol=1e-12)
    assert not narrow.images.coverage[0, [0, -1]].any()


FACING = np.broadcast_to([0.0, 0.0, -1.0], (16, 16, 3))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"depth_m": np.ones((16, 16), np.uint16)}, "got uint16: multiply it by the scale of its camera, 0.001"),
        ({"depth_m": np.full((16, 16), 1500.0)}, "must be metres, and its median is 1500: divide millimetres by 1000"),
        ({"depth_m": np.ones(16)}, r"shape \(H, W\) or \(n, H, W\), at least 8 pixels a side, got \(16,\)"),
        ({"depth_m": np.ones((16, 2))}, r"at least 8 pixels a side, got \(16, 2\)"),
        ({"depth_m": "far"}, "'depth_m' must be an array of floating-point numbers"),
        ({"depth_m": np.full((16, 16), 900.0)}, "must be metres, and its median is 900: divide millimetres by 1000"),
        ({"intrinsics": (0.8, 0.8, 0.5, 0.5)}, "must be in pixels, got fx = 0.8 and fy = 0.8: multiply by the image's"),
        ({"intrinsics": (-20.0, 20.0, 7.5, 7.5)}, "focal lengths above 0 pixels, got fx = -20 and fy = 20"),
        ({"intrinsics": (20.0, 20.0, 7.5)}, r"'intrinsics' must be \(fx, fy, cx, cy\) or"),
        ({"intrinsics": [[20, 1, 7.5], [0, 20, 7.5], [0, 0, 1]]}, r"'intrinsics' must be \(fx, fy, cx, cy\) or"),
        ({"intrinsics": (20.0, np.nan, 7.5, 7.5)}, "'intrinsics' must be finite"),
        ({"intrinsics": intrinsics(16, np.tan(np.radians(20)))}, "2.5° are missing at its .*allow_uncovered=True"),
        ({"sensor": "vl53l5cx-8x8"}, "'sensor' must be a Sensor, got str"),
        ({"quantity": "Z"}, "'quantity' must be z or range, got 'Z'"),
        ({"albedo": 1.2}, r"'albedo' must be in \[0, 1\], got 1.2"),
        ({"albedo": np.ones((8, 8))}, r"'albedo' must be a number or have shape \(16, 16\)"),
        ({"normals": -FACING}, "256 of 256 point away from it, the first in row 0, column 0"),
        ({"normals": 2 * FACING}, "'normals' must be unit vectors .* in row 0, column 0"),
        ({"normals": FACING[0]}, r"'normals' must have shape \(16, 16, 3\)"),
        ({"depth2camera": 2 * np.eye(3)}, r"'depth2camera' must be a rotation matrix, \(3, 3\)"),
        ({"depth2camera": turned((100.0, 0, 0))}, "looks away from some of them"),
    ],
)
def test_bad_input_is_refused_in_one_line(changed, message):
    arguments = {"depth_m": np.ones((16, 16)), "intrinsics": intrinsics(16), "sensor": ZONES, **changed}
    with pytest.raises(UsageError, match=message) as caught:
        zones_from_depth(**arguments)
    assert "\n" not in str(caught.value)
