"""The drive: odometry, path, filter and camera apart, and whole tours against the bar that they have to meet."""

import csv
import io
import json
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from phasemark import UsageError
from phasemark.cli import main
from phasemark.matcher import Match, RobotPose, robot_poses
from phasemark.matcher.drive import (
    OUTPUTS,
    DrivePlan,
    RobotEquipment,
    default_drive,
    example_drive,
    path_csv,
    pose_error,
    read_drive_plan,
    run_drive,
    stops_csv,
)
from phasemark.matcher.drive.follow import Path, World, pan_towards
from phasemark.matcher.filters.kalman_filters import kalman_filter
from phasemark.matcher.likelihood.background_estimate import estimate_surroundings
from phasemark.matcher.position import Placement
from phasemark.matcher.sequence import OdometryPlan, PoseFilter, Reading
from phasemark.matcher.sequence.odometry import motion_jacobian, motion_noise, moved
from phasemark.matcher.sequence.planar import lens_pose, view_of
from phasemark.matcher.statistics import nees
from phasemark.render import Background, capture

OFFSETS = ((0.1, -0.03), (0.04, 0.02))
MODEL = OdometryPlan()
EXACT = OdometryPlan(**dict.fromkeys(OdometryPlan.model_fields, 0.0))


@pytest.fixture(scope="module")
def equipment():
    return RobotEquipment.of(default_drive())


@pytest.fixture(
    scope="module", params=["half 1", *(pytest.param(f"whole {k}", marks=pytest.mark.soak) for k in (1, 2))]
)
def drive(equipment, request):
    """Return a drive along the first two sides of the tour, or along all of it."""
    part, seed = request.param.split()
    plan = default_drive()
    return run_drive(driven(plan.path.waypoints_m[:3]) if part == "half" else plan, seed=int(seed), equipment=equipment)


def driven(waypoints_m, **changes):
    """Return the plan of the tour on another path, with changes of when the robot stops."""
    plan = default_drive()
    path, stop = plan.path.model_copy(update={"waypoints_m": waypoints_m}), plan.stop.model_copy(update=changes)
    return plan.model_copy(update={"path": path, "stop": stop})


def sides_of(drive):
    """Return the names of the landmarks that a drive passes."""
    return ("south", "east", "north", "west")[: len(drive.plan.path.waypoints_m) - 1]


# odometry


def test_steps_of_an_arc_come_back_to_where_they_started():
    state, n, radius = np.zeros(5), 400, 0.7
    for _ in range(n):
        # chord of one step of the circle: 2 r sin(half the turn)
        state = moved(state, Reading(2 * radius * math.sin(math.pi / n), math.tau / n, 0.1))
    np.testing.assert_allclose(state[:2], 0, atol=1e-12)
    assert math.remainder(state[2], math.tau) == pytest.approx(0, abs=1e-12)


def test_slip_takes_its_share_of_the_way_and_bias_its_turn():
    after = moved(np.array([1.0, 2.0, 0.0, 0.1, 0.02]), Reading(2.0, 0.02 * 3.0, 3.0))
    np.testing.assert_allclose(after, [1.0 + 0.9 * 2.0, 2.0, 0.0, 0.1, 0.02], atol=1e-15)


def test_the_motion_s_jacobian_is_that_of_finite_differences():
    state, reading = np.array([0.3, -0.7, 0.9, 0.05, 0.03]), Reading(0.8, 0.4, 1.5)
    step = 1e-6
    numeric = [
        (moved(state + step * axis, reading) - moved(state - step * axis, reading)) / (2 * step) for axis in np.eye(5)
    ]
    # central differences: the truncation of order step² and rounding of order 1e-16 / step
    np.testing.assert_allclose(motion_jacobian(state, reading), np.transpose(numeric), atol=1e-9)


def test_the_world_without_noise_moves_as_the_odometry_reads():
    world = World(np.array([1.0, 2.0, 0.5]), np.zeros((3, 3)), EXACT, np.random.default_rng(0))
    state = world.state.copy()
    for turn in (0.1, -0.2, 0.05):
        state = moved(state, world.step(0.3, turn, 0.1))
    np.testing.assert_allclose(world.state, state, atol=1e-15)


def test_one_noisy_step_scatters_as_its_covariance_says():
    n, way, time_s = 20_000, 0.5, 2.0
    rng = np.random.default_rng(4)
    differences = np.empty((n, 5))
    for k in range(n):
        world = World(np.array([0.0, 0.0, 0.7]), np.zeros((3, 3)), MODEL, rng)
        believed = world.state.copy()
        reading = world.step(way, 0.0, time_s)
        differences[k] = world.state - moved(believed, reading)
    noise = motion_noise(np.array([0.0, 0.0, 0.7, 0.0, 0.0]), Reading(way, 0.0, time_s), MODEL)
    measured = differences.T @ differences / n
    # a heading that is read wrong turns half the step's chord too: second order in the step, 3 % of its width here
    std = np.sqrt(np.diag(noise))
    scaled = (measured - noise) / np.outer(std, std)
    assert np.abs(np.diag(scaled)).max() < 0.15
    assert np.abs(scaled[0, 1]) < stats.norm.isf(0.0005) / math.sqrt(n) + 0.1


# path and camera


def test_pure_pursuit_keeps_a_robot_on_a_path_with_corners():
    path = Path([(0, 0), (3, 0), (3, 2), (0, 2)])
    world = World(np.array([0.0, 0.0, path.start_heading_rad]), np.zeros((3, 3)), EXACT, np.random.default_rng(0))
    way, worst = 0.0, 0.0
    while not path.is_done and way < 20:
        world.step(0.02, path.turn_rate(world.state, 0.4, 0.4) * 0.05, 0.05)
        path.advance(world.state[:2], 0.4)
        way += 0.02
        worst = max(worst, float(np.linalg.norm(world.state[:2] - path.point(path.progress_m))))
    assert path.length_m == 8
    assert way < 8.5
    # a corner is cut by less than the lookahead's arc: L (1 − 1/√2)
    assert worst < 0.4 * (1 - 1 / math.sqrt(2)) + 0.02


def test_the_pan_unit_points_the_optical_axis_at_the_landmark():
    rng = np.random.default_rng(1)
    for _ in range(50):
        pose, target = rng.uniform(-2, 2, 3), rng.uniform(3, 6, 2)
        lens = lens_pose(pose, pan_towards(pose, target, *OFFSETS), *OFFSETS)
        assert view_of(lens, target, 0.0)[2] == pytest.approx(0, abs=1e-5)  # each round leaves a hundredth


def test_a_pose_is_found_again_from_the_view_that_it_has():
    pose, pan, xy, yaw = np.array([1.0, -0.5, 0.8]), -0.6, (2.0, 0.3), 0.4
    distance, delta, bearing = view_of(lens_pose(pose, pan, *OFFSETS), xy, yaw)
    match = Match("cone", True, distance, delta, bearing, symmetry=1)
    (found,) = robot_poses(match, xy, yaw, pan, pan_offset_xy_m=OFFSETS[0], lens_offset_xy_m=OFFSETS[1])
    np.testing.assert_allclose([found.x_m, found.y_m, found.heading_rad], pose, atol=1e-12)


@pytest.mark.parametrize("bearing_deg", [-6.0, 3.0, 6.0])
def test_the_wall_is_found_across_the_line_of_sight_to_a_landmark_off_the_axis(equipment, bearing_deg):
    wall_m = 2.4
    image = equipment.renderers["cylinder"].render(
        1.2, 0.5, math.radians(bearing_deg), background=Background(wall_m=wall_m)
    )
    frames = kalman_filter(capture(image, equipment.sensor, rng=np.random.default_rng(3), n_frames=50))
    found = estimate_surroundings(frames, bearing_known=False).background
    # noise leaves 1 mm; the azimuth of what is near is off by up to 1°, which costs 5 mm
    assert found.wall_m == pytest.approx(wall_m, abs=8e-3)


def test_the_wall_is_found_by_a_camera_that_hangs_askew(equipment):
    """Pitch, and a mount that points 4° beside the optical axis; PHYSICS section 3 has the wall level."""
    sensor = equipment.sensor.with_(pitch_deg=-3.0, bearing_offset_deg=4.0)
    image = equipment.renderers["cylinder"].seen_by(sensor).render(1.2, 0.5, background=Background(wall_m=2.4))
    frames = kalman_filter(capture(image, sensor, rng=np.random.default_rng(3), n_frames=50))
    found = estimate_surroundings(frames).background
    assert found.wall_m == pytest.approx(2.4, abs=3e-3)  # noise leaves 1 mm
    assert found.wall_albedo == pytest.approx(0.5, rel=0.02)


# the filter


def placement_at(pose, covariance):
    """A placement at a pose; its landmark and the paper's angles do not matter to the filter."""
    where = RobotPose(*pose, (0.0, 0.0), 0.0, 0.0, 0.0, covariance)
    landmark: Any = SimpleNamespace(name="any")
    return Placement(landmark, where)


def test_a_correction_weighs_belief_and_measurement_by_their_information():
    start = np.diag([0.04, 0.09, 0.01])
    robot = PoseFilter([1.0, 2.0, 0.3], start, EXACT, 0.9999)
    measured, covariance = np.array([1.1, 1.9, 0.35]), np.diag([0.01, 0.01, 0.02])
    used, squared = robot.correct([placement_at(measured, covariance)])
    information = np.linalg.inv(start) + np.linalg.inv(covariance)
    mean = np.linalg.solve(information, np.linalg.solve(start, [1.0, 2.0, 0.3]) + np.linalg.solve(covariance, measured))
    assert used is not None
    assert squared == pytest.approx(0.1**2 / 0.05 + 0.1**2 / 0.10 + 0.05**2 / 0.03)
    np.testing.assert_allclose(robot.pose, mean, atol=1e-12)
    np.testing.assert_allclose(robot.pose_covariance, np.linalg.inv(information), atol=1e-14)


def test_a_measurement_across_the_turn_s_seam_is_near_and_one_without_a_covariance_is_none():
    robot = PoseFilter([0.0, 0.0, math.pi - 0.01], np.eye(3) * 1e-2, EXACT, 0.99)
    used, squared = robot.correct([placement_at((0.0, 0.0, -math.pi + 0.01), np.eye(3) * 1e-2)])
    assert used is not None
    assert squared == pytest.approx(0.02**2 / 0.02, rel=1e-9)
    assert abs(robot.pose[2]) == pytest.approx(math.pi, abs=1e-9)
    for nothing in ([placement_at((0.0, 0.0, 0.0), None)], []):  # without a covariance there is no measurement
        assert robot.correct(nothing) == (None, math.inf)


@pytest.mark.parametrize(("distance", "passes"), [(0.99, True), (1.01, False)])
def test_the_gate_refuses_what_is_more_improbable_than_it_says(distance, passes):
    gate = 0.999
    limit = math.sqrt(stats.chi2.ppf(gate, 3) * 2e-2)
    robot = PoseFilter([0.0, 0.0, 0.0], np.eye(3) * 1e-2, EXACT, gate)
    used, _ = robot.correct([placement_at((distance * limit, 0.0, 0.0), np.eye(3) * 1e-2)])
    assert (used is not None) == passes
    assert (robot.pose[0] != 0) == passes


def test_predicted_and_corrected_poses_are_as_uncertain_as_the_filter_says():
    rng, n = np.random.default_rng(12), 300
    start, seen = np.diag([2.5e-5, 2.5e-5, 1.2e-5]), np.diag([1.6e-5, 3.6e-5, 9e-6])
    errors, covariances = np.empty((2, n, 3)), np.empty((2, n, 3, 3))
    for k in range(n):
        world = World(np.zeros(3), start, MODEL, rng)
        robot = PoseFilter([0.0, 0.0, 0.0], start, MODEL, 1 - 1e-9)
        for leg in range(2):
            for step in range(60):
                robot.predict(world.step(0.04, 0.02 * math.sin(step / 9), 0.1))
            if leg == 0:
                noisy = world.state[:3] + rng.multivariate_normal(np.zeros(3), seen)
                robot.correct([placement_at(noisy, seen)])
                errors[0, k], covariances[0, k] = pose_error(robot.pose.copy(), world.state[:3]), robot.pose_covariance
        errors[1, k], covariances[1, k] = pose_error(robot.pose.copy(), world.state[:3]), robot.pose_covariance
    # N = 300, 3 degrees of freedom each; 99.9 % over the two cells. Curvature of the motion adds far less.
    low, high = stats.chi2.ppf([0.0005 / 2, 1 - 0.0005 / 2], 3 * n)
    for leg in range(2):
        assert low < nees(errors[leg], covariances[leg]).sum() < high


def test_corrections_teach_the_filter_slip_and_bias():
    world = World(np.zeros(3), np.zeros((3, 3)), MODEL, np.random.default_rng(5))
    robot = PoseFilter([0.0, 0.0, 0.0], np.zeros((3, 3)), MODEL, 1 - 1e-9)
    before = np.sqrt(np.diag(robot.covariance))[3:]
    for _ in range(4):
        for _ in range(100):
            robot.predict(world.step(0.02, 0.0, 0.05))
        robot.correct([placement_at(world.state[:3], np.eye(3) * 1e-8)])
    after = np.sqrt(np.diag(robot.covariance))[3:]
    assert (after < 0.4 * before).all()
    assert (np.abs(robot.state - world.state)[3:] < 4 * after).all()


# plans


def test_the_shipped_plan_is_a_tour_of_20_m_past_four_landmarks_of_four_classes():
    plan = default_drive()
    assert Path(plan.path.waypoints_m).length_m == pytest.approx(20, abs=1e-9)
    assert len({landmark.class_name for landmark in plan.map.landmark}) == 4


def test_a_plan_may_name_a_map_file_beside_it(tmp_path):
    (tmp_path / "map.toml").write_text('[[landmark]]\nname = "a"\nclass = "cone"\nx_m = 1\ny_m = 2\n')
    (tmp_path / "plan.toml").write_text('map = "map.toml"\n[path]\nwaypoints_m = [[0, 0], [1, 0]]\n')
    assert read_drive_plan(tmp_path / "plan.toml").map.landmark[0].xy_m == (1.0, 2.0)
    (tmp_path / "map.toml").write_text("landmark = 3\n")
    with pytest.raises(UsageError, match=r"map\.toml: 'landmark' must be a list, got 3"):
        read_drive_plan(tmp_path / "plan.toml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("speed_m_s = 0.4", "speed_m_s = 0", r"path: 'speed_m_s' must be greater than 0, got 0"),
        ("gate = 0.9999", "gate = 1.5", r"stop: 'gate' must be less than 1, got 1.5"),
        ("distance_m = [0.8, 1.8]", "distance_m = [2, 1]", r"stop: 'distance_m' must be \(low, high\)"),
        ("[2.2, 2.2], [7.8", "[2.2, 2.2], [12.0", r"'path\.waypoints_m\.1' must be inside 'map\.room_m'"),
        ("[2.2, 2.2], [7.8, 2.2]", "[2.2, 2.2], [2.2, 2.2]", r"path: 'waypoints_m\.1' must differ"),
        ("y_m = 1.0", "y_m = 0.3", r"'map\.landmark\.0' must stand at least 0.6 m from every wall, got 0.3 m"),
        ("slip_std = 0.03", "slip = 0.03", r"odometry: unknown key 'slip'"),
    ],
)
def test_a_wrong_plan_is_refused_with_file_key_value_and_what_would_be_right(tmp_path, old, new, message):
    text = example_drive()
    assert old in text
    path = tmp_path / "plan.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(UsageError, match=message) as caught:
        read_drive_plan(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_class_that_the_catalogue_lacks_is_refused():
    table = default_drive().model_dump(by_alias=True)
    table["map"]["landmark"][0]["class"] = "obelisk"
    with pytest.raises(UsageError, match=r"'map\.landmark\.class' must be one of cylinder.*got 'obelisk'"):
        RobotEquipment.of(DrivePlan(**table))


# whole drives


def test_dead_reckoning_drifts_by_decimetres_and_degrees_and_the_corrected_path_does_not(drive):
    dead, kept = (pose_error(path, drive.true) for path in (drive.dead_reckoned, drive.corrected))
    assert np.hypot(*dead[:, :2].T).max() > 0.2
    assert np.degrees(np.abs(dead[:, 2])).max() > 3
    assert np.hypot(*kept[-1, :2]) < 0.05
    assert {stop.landmark.name for stop in drive.corrections} == set(sides_of(drive))


def test_the_robot_stops_where_the_bound_promises_enough_and_is_corrected_to_2_cm_and_0_6_degrees(drive):
    for stop in drive.stops:
        assert stop.predicted_across_std_m <= drive.plan.stop.across_std_m
        assert not stop.used or stop.match.class_name == stop.landmark.class_name
    error = np.array([pose_error(stop.after, stop.true) for stop in drive.corrections])
    assert len(error) >= len(sides_of(drive))
    assert math.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1))) <= 0.02
    assert math.degrees(math.sqrt(np.mean(error[:, 2] ** 2))) <= 0.6


FIRST_SIDE = ((2.2, 2.2), (3.4, 2.2))
"""The tour up to its first landmark."""


def test_another_seed_drives_another_way(equipment):
    one, other = (run_drive(driven(FIRST_SIDE, across_std_m=1e-6), seed=k, equipment=equipment) for k in (1, 2))
    assert not one.stops  # nothing is known as well as that
    assert not np.array_equal(one.true[-1], other.true[-1])


def test_a_plan_with_an_uneven_floor_tilts_the_camera_and_estimates_the_tilt():
    plan = driven(FIRST_SIDE)
    uneven = plan.camera.model_copy(update={"pitch_std_deg": 1.5, "roll_std_deg": 2.0})
    room = plan.map.model_copy(update={"landmark": plan.map.landmark[:1]})
    drive = run_drive(plan.model_copy(update={"map": room, "camera": uneven}), seed=1)
    assert drive.stops
    squares = []
    for stop in drive.stops:
        assert stop.match.free == ("distance_m", "delta_rad", "bearing_rad", "pitch_rad", "roll_rad")
        if stop.match.accepted:
            error = np.array([getattr(stop.match, name) for name in stop.match.free[:3]]) - stop.view[:3]
            period = 2 * math.pi / stop.match.symmetry
            error[1] -= period * round(error[1] / period)
            squares.append(error @ np.linalg.solve(stop.match.covariance[:3, :3], error))
    assert squares
    # χ² of 3 degrees of freedom passes 30 once in a million; covariances before a wall are local
    assert max(squares) < 30


def test_tables_and_summary_hold_the_drive(drive):
    rows = list(csv.DictReader(io.StringIO(path_csv(drive))))
    assert len(rows) == len(drive.time_s)
    last = {key: float(value) for key, value in rows[-1].items()}
    for name, path in (("true", drive.true), ("dead", drive.dead_reckoned), ("corrected", drive.corrected)):
        found = [last[f"{name}_x_m"], last[f"{name}_y_m"], math.radians(last[f"{name}_heading_deg"])]
        np.testing.assert_allclose(found, path[-1], rtol=1e-7)  # nine digits
    assert last["covariance_hh_deg2"] == pytest.approx(math.degrees(1) ** 2 * drive.covariance[-1, 2, 2])
    stops = list(csv.DictReader(io.StringIO(stops_csv(drive))))
    assert [row["landmark"] for row in stops] == [stop.landmark.name for stop in drive.stops]
    facts = json.loads(json.dumps(drive.as_dict(), allow_nan=False))
    assert facts["corrections"] == len(drive.corrections)
    assert DrivePlan(**facts["plan"]) == drive.plan


def short_plan(folder):
    """A path of 1.2 m past the first landmark, in a room with no other one."""
    head, first, *_, last = example_drive().split("[[map.landmark]]")
    table = f"{head}[[map.landmark]]{first}[path]{last.split('[path]')[1]}".splitlines()
    table = ["waypoints_m = [[2.2, 2.2], [3.4, 2.2]]" if line.startswith("waypoints_m") else line for line in table]
    path = folder / "plan.toml"
    path.write_text("\n".join(table), encoding="utf-8")
    return str(path)


def test_the_command_writes_everything_and_replaces_nothing_unasked_and_a_seed_drives_the_same_way(tmp_path, capsys):
    plan = short_plan(tmp_path)
    arguments = ["drive", plan, "-o", str(tmp_path / "out"), "--seed", "3"]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "out").glob("[!.]*")) == sorted(OUTPUTS)
    assert all(str(tmp_path / "out" / name) in printed for name in OUTPUTS)
    assert "1 corrections at 1 stops" in printed
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["seed"] == 3
    again = run_drive(read_drive_plan(plan), seed=3)
    assert again.corrections
    assert (tmp_path / "out" / "path.csv").read_text() == path_csv(again)
    assert main(arguments) == 4
    assert "exists already; --force replaces it" in capsys.readouterr().err


def test_the_command_prints_the_plan_of_the_tour_and_refuses_a_wrong_one(tmp_path, capsys):
    assert main(["drive", "--example"]) == 0
    assert capsys.readouterr().out == example_drive()
    assert main(["drive", str(tmp_path / "absent.toml"), "-o", str(tmp_path / "out")]) == 3
    (tmp_path / "plan.toml").write_text("[path]\n")
    assert main(["drive", str(tmp_path / "plan.toml"), "-o", str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()
