"""Where the robot stands, against transforms chained through a world that was built beforehand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import norm

from phasemark import UsageError
from phasemark.matcher import Match, robot_poses
from phasemark.render import Views

EXACT = 1e-12  # metres and radians; a few roundings of numbers of order one

WORLD = {  # nothing is zero, and no two are equal
    "distance_m": 1.3,
    "delta_rad": 0.7,
    "bearing_rad": 0.12,
    "x_m": 2.0,
    "y_m": -1.5,
    "yaw_rad": 0.4,
    "pan_rad": -0.9,
    "pan_x": 0.10,
    "pan_y": -0.03,
    "lens_x": 0.05,
    "lens_y": 0.02,
}
NAMES = tuple(WORLD)


def turn(angle_rad):
    """(..., 3, 3) rigid motion of the plane: a rotation."""
    angle = np.asarray(angle_rad, dtype=float)
    motion = np.zeros((*angle.shape, 3, 3))
    motion[..., 0, 0] = motion[..., 1, 1] = np.cos(angle)
    motion[..., 1, 0] = np.sin(angle)
    motion[..., 0, 1] = -np.sin(angle)
    motion[..., 2, 2] = 1
    return motion


def shift(x, y):
    """(..., 3, 3) rigid motion of the plane: a translation."""
    motion = turn(np.zeros_like(np.asarray(x, dtype=float)))
    motion[..., 0, 2], motion[..., 1, 2] = x, y
    return motion


def landmark2cam(distance_m, delta_rad, bearing_rad):
    """Equation (9) as the renderer has it, without z."""
    views = Views.broadcast(distance_m, delta_rad, bearing_rad)
    rotation, translation = views.landmark2cam()
    motion = np.zeros((len(views), 3, 3))
    motion[:, :2, :2], motion[:, :2, 2], motion[:, 2, 2] = rotation[:, :2, :2], translation[:, :2], 1
    return motion


def robot2world(distance_m, delta_rad, bearing_rad, x_m, y_m, yaw_rad, pan_rad, pan_x, pan_y, lens_x, lens_y):
    """(n, 3, 3): world <- landmark <- camera <- pan <- robot, nothing but equation (9) and the mounting."""
    landmark2world = shift(x_m, y_m) @ turn(yaw_rad)
    cam2robot = shift(pan_x, pan_y) @ turn(pan_rad) @ shift(lens_x, lens_y)
    cam2world = landmark2world @ np.linalg.inv(landmark2cam(distance_m, delta_rad, bearing_rad))
    return cam2world @ np.linalg.inv(cam2robot)


def match_of(world=WORLD, **fields):
    view = {name: world[name] for name in ("distance_m", "delta_rad", "bearing_rad")}
    return Match("cone", True, **{**view, "symmetry": 2, **fields})


def poses_of(world=WORLD, match=None, **arguments):
    return robot_poses(
        match or match_of(world),
        (world["x_m"], world["y_m"]),
        world["yaw_rad"],
        world["pan_rad"],
        pan_offset_xy_m=(world["pan_x"], world["pan_y"]),
        lens_offset_xy_m=(world["lens_x"], world["lens_y"]),
        **arguments,
    )


def xyh(pose):
    return np.array([pose.x_m, pose.y_m, pose.heading_rad])


def apart(one, other):
    """Differences of (x, y, heading), the heading's wrapped."""
    difference = np.asarray(one) - np.asarray(other)
    difference[..., 2] = np.angle(np.exp(1j * difference[..., 2]))
    return difference


def test_the_first_pose_is_where_the_chain_of_transforms_puts_the_robot():
    rng = np.random.default_rng(11)
    for _ in range(50):
        world = dict(zip(NAMES, [rng.uniform(0.5, 2.5), *rng.uniform(-3, 3, 10)], strict=True))
        motion = robot2world(**world)[0]
        expected = [motion[0, 2], motion[1, 2], math.atan2(motion[1, 0], motion[0, 0])]
        np.testing.assert_allclose(apart(xyh(poses_of(world)[0]), expected), 0, atol=EXACT)


def test_equation_9_and_equation_11_put_a_point_of_the_landmark_in_the_same_place():
    point = np.array([0.12, 0.08, 1.0])
    pose = poses_of()[0]
    seen = landmark2cam(WORLD["distance_m"], WORLD["delta_rad"], WORLD["bearing_rad"])[0] @ point
    by_camera = shift(*pose.lens_xy_m) @ turn(pose.camera_heading_rad) @ seen
    by_map = shift(WORLD["x_m"], WORLD["y_m"]) @ turn(WORLD["yaw_rad"]) @ point
    np.testing.assert_allclose(by_camera, by_map, rtol=0, atol=EXACT)


def test_without_offsets_and_bearing_the_paper_s_equations_hold_to_the_letter():
    delta, beta, distance, xo, yo = math.radians(30), math.radians(10), 1.2, 3.0, 2.0
    pose = robot_poses(match_of(distance_m=distance, delta_rad=delta, bearing_rad=0.0), (xo, yo), pan_rad=beta)[0]
    xr, yr = xo + distance * math.cos(math.pi + delta), yo + distance * math.sin(math.pi + delta)  # (11)
    np.testing.assert_allclose(xyh(pose), [xr, yr, delta - beta], rtol=0, atol=EXACT)  # (12)
    assert pose.lens_xy_m == pytest.approx((xr, yr), abs=EXACT)
    assert pose.camera_heading_rad == pytest.approx(delta, abs=EXACT)
    assert pose.gamma_rad == pytest.approx(math.atan2(yo, xo), abs=EXACT)  # (13)
    assert pose.theta_rad == pytest.approx(math.atan2(yr, xr), abs=EXACT)  # (14)


def test_theta_is_the_azimuth_of_the_lens_and_not_of_the_robot_s_centre():
    pose = poses_of()[0]
    assert pose.theta_rad == pytest.approx(math.atan2(pose.lens_xy_m[1], pose.lens_xy_m[0]), abs=EXACT)
    assert abs(pose.theta_rad - math.atan2(pose.y_m, pose.x_m)) > 1e-3


def test_the_other_pose_of_a_box_is_the_first_mirrored_in_the_landmark_and_turned_round():
    covariance = np.array([[4e-6, 1e-6], [1e-6, 9e-6]])
    first, other = poses_of(match=match_of(covariance=covariance), landmark_covariance=np.diag([1e-4, 4e-4, 1e-4]))
    mirrored = [2 * WORLD["x_m"] - first.x_m, 2 * WORLD["y_m"] - first.y_m, first.heading_rad + math.pi]
    np.testing.assert_allclose(apart(xyh(other), mirrored), 0, atol=EXACT)
    # From the other side the view moves the robot the other way, the landmark's x and y do not.
    assert other.covariance[0, 2] != pytest.approx(first.covariance[0, 2], rel=0.1)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_every_symmetric_pose_sees_the_landmark_turned_by_a_whole_share_of_a_turn(n):
    poses = poses_of(match=match_of(symmetry=n))
    assert len(poses) == n
    for k, pose in enumerate(poses):
        turned = robot2world(**{**WORLD, "delta_rad": WORLD["delta_rad"] + 2 * math.pi * k / n})[0]
        np.testing.assert_allclose([pose.x_m, pose.y_m], turned[:2, 2], rtol=0, atol=EXACT)


def test_symmetry_can_be_given_in_place_of_the_match_s():
    assert len(poses_of(symmetry=1)) == 1
    assert len(poses_of(symmetry=4)) == 4


@pytest.mark.parametrize("free", [("distance_m", "delta_rad"), ("bearing_rad", "height_m", "delta_rad", "distance_m")])
def test_covariance_is_that_of_a_monte_carlo_run_through_the_chain_of_transforms(free):
    rng = np.random.default_rng(20250101)
    n = 200_000
    spread = {"distance_m": 2e-3, "delta_rad": 3e-3, "bearing_rad": 1.5e-3, "height_m": 1e-3}
    root = rng.normal(size=(4, 4))[: len(free)]
    correlation = root @ root.T
    correlation /= np.sqrt(np.outer(np.diag(correlation), np.diag(correlation)))
    std = np.array([spread[name] for name in free])
    of_view = correlation * np.outer(std, std)
    of_map = np.array([[4e-6, 1e-6, 2e-6], [1e-6, 6e-6, -1e-6], [2e-6, -1e-6, 5e-6]])
    of_mounting = np.diag([1e-6, 4e-6, 2e-6, 3e-6])
    of_mounting[0, 3] = of_mounting[3, 0] = 1e-6
    pan_std = 2e-3

    drawn = {name: np.full(n, value) for name, value in WORLD.items()}
    for name, noise in zip(free, rng.multivariate_normal(np.zeros(len(free)), of_view, n).T, strict=True):
        if name != "height_m":
            drawn[name] += noise
    for names, covariance in ((NAMES[3:6], of_map), (NAMES[7:], of_mounting), (NAMES[6:7], [[pan_std**2]])):
        for name, noise in zip(names, rng.multivariate_normal(np.zeros(len(names)), covariance, n).T, strict=True):
            drawn[name] += noise
    poses = poses_of(
        match=match_of(free=free, covariance=of_view),
        landmark_covariance=of_map,
        pan_std_rad=pan_std,
        mounting_covariance=of_mounting,
    )
    assert len(poses) == 2
    for k, pose in enumerate(poses):
        motion = robot2world(**{**drawn, "delta_rad": drawn["delta_rad"] + k * math.pi})
        heading = np.arctan2(motion[:, 1, 0], motion[:, 0, 0])
        errors = apart(np.stack([motion[:, 0, 2], motion[:, 1, 2], heading], axis=-1), xyh(pose))
        measured, predicted = np.cov(errors.T), pose.covariance
        # N = 200 000; 99.9 % over 2 cases × 2 poses × 6 cells. Second order adds 1e-5 of a variance, a hundredth of it.
        diagonal = np.diag(predicted)
        deviation = np.sqrt((np.outer(diagonal, diagonal) + predicted**2) / n)
        assert np.all(np.abs(measured - predicted) <= norm.isf(0.001 / 2 / 24) * deviation)


def test_what_the_match_did_not_estimate_counts_as_exact():
    covariance = np.diag([4e-6, 9e-6])
    pose = robot_poses(match_of(delta_rad=0.0, bearing_rad=0.0, covariance=covariance), (2.0, 1.0))[0]
    # Seen along x: D moves the robot along x, δ along y by D · δ and turns it.
    d = WORLD["distance_m"]
    expected = [[4e-6, 0, 0], [0, d**2 * 9e-6, -d * 9e-6], [0, -d * 9e-6, 9e-6]]
    np.testing.assert_allclose(pose.covariance, expected, rtol=0, atol=1e-18)


def test_a_match_without_covariance_gives_poses_without():
    assert [pose.covariance for pose in poses_of(landmark_covariance=np.eye(3))] == [None, None]


@pytest.mark.parametrize("right", [0, 1, 2, 3])
@pytest.mark.parametrize("prior_covariance", [None, np.diag([0.04, 0.04, 0.01])])
def test_a_prior_puts_the_pose_near_it_first(right, prior_covariance):
    match = match_of(symmetry=4, covariance=np.diag([4e-6, 9e-6]))
    in_order = poses_of(match=match)
    assert all(math.isnan(pose.mahalanobis) for pose in in_order)
    prior = xyh(in_order[right]) + np.array([0.2, -0.15, 0.2])
    sorted_ = poses_of(match=match, prior=prior, prior_covariance=prior_covariance)
    np.testing.assert_array_equal(xyh(sorted_[0]), xyh(in_order[right]))
    distances = [pose.mahalanobis for pose in sorted_]
    assert distances == sorted(distances)
    assert len(sorted_) == 4


def test_a_match_that_tells_a_direction_by_no_width_at_all_has_a_distance_to_the_prior():
    # 1e20 m² along one direction alone: in a sum the prior's own widths are rounded away
    covariance = 1e20 * np.outer([0.8, 0.6], [0.8, 0.6])
    pose = poses_of(match=match_of(covariance=covariance), prior=(0.0, 0.0, 0.0), prior_covariance=np.eye(3))[0]
    assert 0 < pose.mahalanobis <= math.hypot(*xyh(pose))


def test_the_distance_to_the_prior_is_in_standard_deviations_of_prior_and_pose_together():
    pose = poses_of(match=match_of(covariance=np.diag([4e-6, 9e-6])))[0]
    prior_covariance = np.array([[0.04, 0.01, 0], [0.01, 0.09, 0.001], [0, 0.001, 0.01]])
    error = np.array([0.3, -0.2, 0.15])
    placed = poses_of(
        match=match_of(covariance=np.diag([4e-6, 9e-6])), prior=xyh(pose) - error, prior_covariance=prior_covariance
    )[0]
    expected = math.sqrt(error @ np.linalg.inv(prior_covariance + pose.covariance) @ error)
    assert placed.mahalanobis == pytest.approx(expected, rel=1e-9)  # wrapping a heading costs a few roundings
    # Without covariances a metre or a radian is one standard deviation.
    plain = poses_of(prior=xyh(pose) - error)[0]
    assert plain.mahalanobis == pytest.approx(np.linalg.norm(error), rel=1e-9)


def test_a_prior_just_across_the_wrap_is_near():
    match = match_of(delta_rad=math.pi - 0.01, bearing_rad=0.0)
    poses = robot_poses(match, (0.0, 0.0))
    prior = (poses[0].x_m, poses[0].y_m, -math.pi + 0.01)
    assert robot_poses(match, (0.0, 0.0), prior=prior)[0].mahalanobis == pytest.approx(0.02, abs=EXACT)


def test_headings_are_in_the_half_open_turn_that_contains_pi():
    def headings(delta, pan=0.0):
        match = match_of(delta_rad=delta, bearing_rad=0.0, symmetry=1)
        pose = robot_poses(match, (0.0, 0.0), pan_rad=pan)[0]
        return pose.heading_rad, pose.camera_heading_rad

    assert headings(math.pi) == (math.pi, math.pi)
    assert headings(-math.pi) == (math.pi, math.pi)
    assert headings(0.0, pan=math.pi) == (math.pi, 0.0)
    assert headings(math.nextafter(math.pi, 4)) == pytest.approx((-math.pi,) * 2)
    for turns in (-3, -1, 2):
        assert headings(0.5 + turns * math.tau) == pytest.approx((0.5, 0.5), abs=1e-14)
    rng = np.random.default_rng(3)
    for delta in rng.uniform(-30, 30, 200):
        assert all(-math.pi < heading <= math.pi for heading in headings(delta))


@pytest.mark.parametrize("match", [Match(None, False), Match(None, False, 1.0, 0.2), Match("cone", False)])
def test_no_landmark_gives_no_pose(match):
    assert robot_poses(match, (2.0, 1.0), prior=(0, 0, 0)) == []


@pytest.mark.parametrize(
    ("match", "arguments", "message"),
    [
        ({}, {"landmark_xy_m": (1.0, math.nan)}, r"'landmark_xy_m' must be 2 finite numbers"),
        ({}, {"landmark_xy_m": (1.0, 2.0, 3.0)}, r"'landmark_xy_m' must be 2 finite numbers"),
        ({}, {"landmark_xy_m": "ab"}, r"'landmark_xy_m' must be 2 finite numbers"),
        ({}, {"landmark_yaw_rad": math.inf}, "'landmark_yaw_rad' must be a finite number"),
        ({}, {"pan_rad": math.nan}, "'pan_rad' must be a finite number"),
        ({}, {"pan_offset_xy_m": (0.1,)}, "'pan_offset_xy_m' must be 2 finite numbers"),
        ({}, {"lens_offset_xy_m": (0.1, None)}, "'lens_offset_xy_m' must be 2 finite numbers"),
        ({}, {"pan_std_rad": -0.1}, "'pan_std_rad' must be finite and at least 0"),
        ({}, {"symmetry": 0}, "'symmetry' must be a whole number of at least 1, got 0"),
        ({}, {"symmetry": 2.5}, "'symmetry' must be a whole number of at least 1, got 2.5"),
        ({}, {"symmetry": math.inf}, "'symmetry' must be a whole number of at least 1, got inf"),
        ({}, {"prior": (0.0, 0.0)}, "'prior' must be 3 finite numbers"),
        ({}, {"prior_covariance": np.eye(3)}, "'prior_covariance' needs 'prior'"),
        ({}, {"prior": (0, 0, 0), "prior_covariance": np.eye(2)}, "'prior_covariance' must be 3×3 finite numbers"),
        ({}, {"prior": (0, 0, 0), "prior_covariance": np.diag([1, 1, 0])}, "'prior_covariance' leaves a direction"),
        ({}, {"landmark_covariance": np.diag([1, 1, -1])}, "'landmark_covariance' must be symmetric and positive"),
        ({}, {"landmark_covariance": [[1, 2, 0], [2, 1, 0], [0, 0, 1]]}, "'landmark_covariance' must be symmetric"),
        ({}, {"landmark_covariance": [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]}, "'landmark_covariance' must be symmetric"),
        ({}, {"mounting_covariance": np.eye(3)}, "'mounting_covariance' must be 4×4 finite numbers"),
        ({"distance_m": -1.0}, {}, "'match.distance_m' must be positive, got -1.0"),
        ({"bearing_rad": math.nan}, {}, "'match.bearing_rad' must be a finite number"),
        ({"covariance": np.eye(3)}, {}, "'match.covariance' must be 2×2 finite numbers"),
        ({"covariance": np.eye(2), "free": ("delta_rad", "delta_rad")}, {}, "'match.free' must name each of"),
        ({"covariance": np.eye(2), "free": ("delta_rad", "depth_m")}, {}, "'match.free' must name each of"),
    ],
)
def test_arguments_that_make_no_sense_are_refused_in_one_line(match, arguments, message):
    with pytest.raises(UsageError, match=message) as caught:
        robot_poses(match_of(**match), **{"landmark_xy_m": (2.0, 1.0), **arguments})
    assert "\n" not in str(caught.value)
