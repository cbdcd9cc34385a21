"""The map of landmarks: what it refuses, its walls, and the poses that a match allows on it."""

import json
import math

import numpy as np
import pytest

from phasemark import InputFileError, UsageError
from phasemark.cli import main
from phasemark.data import BankPlan, build_bank
from phasemark.matcher import Match, robot_poses
from phasemark.matcher.commands.match_table import pose_text
from phasemark.matcher.position import LandmarkMap, read_landmark_map
from phasemark.render import Renderer, capture

DOOR = {"name": "door", "class": "cone", "x_m": 2.0, "y_m": 1.0, "yaw_deg": 30.0}
ROOM = [(0, 0), (4, 0), (4, 3), (1, 3), (1, 2), (0, 2)]  # an L


def map_file(folder, text):
    path = folder / "map.toml"
    path.write_text(text, encoding="utf-8")
    return path


def landmark_text(**changes):
    fields = {**DOOR, **changes}
    lines = [f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value}" for key, value in fields.items()]
    return "\n".join(["[[landmark]]", *lines, ""])


def test_a_map_file_says_where_each_landmark_stands_and_how_well_that_is_known(tmp_path):
    text = landmark_text(xy_std_m=0.01, yaw_std_deg=2.0)
    (landmark,) = read_landmark_map(map_file(tmp_path, text)).landmark
    assert (landmark.name, landmark.class_name, landmark.xy_m) == ("door", "cone", (2.0, 1.0))
    assert landmark.yaw_rad == pytest.approx(math.pi / 6)
    np.testing.assert_allclose(landmark.covariance, np.diag([1e-4, 1e-4, math.radians(2) ** 2]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "'landmark' is missing"),
        ("landmark = []", "'landmark' must.* at least 1 item"),
        (landmark_text(x_m="here"), r"landmark\.0: 'x_m' must be a number, got 'here'"),
        (landmark_text(x_m=math.nan), r"landmark\.0: 'x_m' must be a finite number, got nan"),
        (landmark_text(xy_std_m=-0.1), r"landmark\.0: 'xy_std_m' must be greater than or equal to 0, got -0.1"),
        (landmark_text(z_m=1.0), r"landmark\.0: unknown key 'z_m'"),
        (landmark_text() + landmark_text(), r"'landmark\.1\.name' must be a name of its own, got 'door' twice"),
        ("room_m = [[0, 0], [1, 0]]\n" + landmark_text(), "'room_m' must have at least 3 corners, got 2"),
        ("room_m = [[0, 0], [1, 0], [0, 1]]\n" + landmark_text(), r"'landmark\.0' must stand inside 'room_m'"),
    ],
)
def test_a_wrong_map_is_refused_with_file_key_value_and_what_would_be_right(tmp_path, text, message):
    path = map_file(tmp_path, text)
    with pytest.raises(UsageError, match=message) as caught:
        read_landmark_map(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_map_is_an_input_error(tmp_path):
    with pytest.raises(InputFileError, match="cannot be read"):
        read_landmark_map(tmp_path / "absent.toml")
    with pytest.raises(InputFileError, match="not a TOML file"):
        read_landmark_map(map_file(tmp_path, "[["))


def test_the_wall_behind_is_the_first_one_that_a_ray_meets():
    room = LandmarkMap(landmark=[DOOR], room_m=ROOM)
    at = (2.0, 1.5)
    for heading_deg, expected in ((0, 2.0), (90, 1.5), (180, 2.0), (-90, 1.5), (45, 1.5 * math.sqrt(2))):
        assert room.wall_distance_m(at, math.radians(heading_deg)) == pytest.approx(expected, abs=1e-12)
    # into the notch of the L: its wall x = 1 at y = 2.5
    assert room.wall_distance_m((3.0, 2.5), math.pi) == pytest.approx(2.0, abs=1e-12)
    assert LandmarkMap(landmark=[DOOR]).wall_distance_m(at, 0.0) is None


def test_inside_and_clearance_follow_the_corners():
    room = LandmarkMap(landmark=[DOOR], room_m=ROOM)
    points = {(0.5, 1.0): True, (0.5, 2.5): False, (2.0, 2.5): True, (5.0, 1.0): False, (-1.0, 1.0): False}
    assert {point: room.is_inside(point) for point in points} == points
    assert room.wall_clearance_m((0.7, 1.6)) == pytest.approx(0.4)
    assert room.wall_clearance_m((1.3, 1.8)) == pytest.approx(math.hypot(0.3, 0.2))  # to the corner that juts in
    assert LandmarkMap(landmark=[DOOR]).wall_clearance_m((0.0, 0.0)) == math.inf


def test_the_prior_chooses_among_landmarks_of_the_class_and_their_symmetric_poses():
    others = [
        {**DOOR, "name": "window", "x_m": 6.0, "yaw_deg": -40.0},
        {**DOOR, "name": "lamp", "class": "post"},
    ]
    room = LandmarkMap(landmark=[DOOR, *others])
    match = Match("cone", True, 1.2, 0.4, covariance=np.diag([1e-6, 1e-5]), symmetry=2)
    everywhere = room.poses(match)
    assert [placement.landmark.name for placement in everywhere] == ["door", "door", "window", "window"]
    for wanted in everywhere:
        pose = wanted.pose
        near = (pose.x_m + 0.1, pose.y_m - 0.1, pose.heading_rad + 0.1)
        found = room.poses(match, prior=near, prior_covariance=np.diag([0.04, 0.04, 0.04]))
        assert found[0].landmark.name == wanted.landmark.name
        assert (found[0].pose.x_m, found[0].pose.y_m) == (pose.x_m, pose.y_m)
        assert len(found) == 4
    assert room.poses(Match("sphere", True, 1.2, 0.4)) == []
    assert room.poses(Match(None, False)) == []


def test_the_survey_s_uncertainty_is_in_the_pose():
    match = Match("cone", True, 1.2, 0.4, covariance=np.diag([1e-6, 1e-5]), symmetry=1)
    (exact,) = LandmarkMap(landmark=[DOOR]).poses(match)
    surveyed = LandmarkMap(landmark=[{**DOOR, "xy_std_m": 0.01, "yaw_std_deg": 1.0}])
    (loose,) = surveyed.poses(match)
    expected = robot_poses(
        match, (2.0, 1.0), math.radians(30), landmark_covariance=np.diag([1e-4, 1e-4, math.radians(1) ** 2])
    )
    np.testing.assert_array_equal(loose.pose.covariance, expected[0].covariance)
    # the landmark's own x, y and heading add to the heading's variance that heading alone
    assert loose.pose.covariance[2, 2] - exact.pose.covariance[2, 2] == pytest.approx(math.radians(1) ** 2)


@pytest.fixture(scope="module")
def bank_and_frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("match")
    plan = BankPlan(classes=("cone",), distance_m="0.9:1.1:0.05", delta_deg="0:180:15")
    with build_bank(plan, folder / "bank.h5") as bank:
        image = Renderer(bank.mesh("cone"), bank.sensor, albedo=0.8).render(1.0, math.radians(30))
        frames = capture(image, bank.sensor, rng=np.random.default_rng(1), n_frames=20)
    np.savetxt(folder / "frames.csv", frames.range_m.reshape(20, -1), delimiter=",")
    return str(folder / "bank.h5"), str(folder / "frames.csv")


def run_match(bank_and_frames, *options):
    return main(["match", *bank_and_frames, "--unit", "m", "--quantity", "range", *options])


def test_the_command_places_the_robot_on_a_map_by_a_prior(tmp_path, capsys, bank_and_frames):
    path = map_file(tmp_path, landmark_text(yaw_deg=0.0) + landmark_text(name="far", x_m=9.0))
    near = (2.0 - math.cos(math.radians(30)), 1.0 - 0.5, 30.0)  # lens of the view at 1 m, 30°
    prior = ["--prior", *(f"{value:.3f}" for value in near), "--prior-std", "0.2", "5"]
    assert run_match(bank_and_frames, "--map", str(path), *prior, "--json") == 0
    (match,) = json.loads(capsys.readouterr().out)["matches"]
    assert len(match["poses"]) == 4
    best = match["poses"][0]
    assert best["landmark"] == "door"
    # half a step of the bank in D, and half of 15° at 1 m
    assert math.hypot(best["x_m"] - near[0], best["y_m"] - near[1]) < 0.025 + math.radians(7.5)
    assert best["mahalanobis"] < 3 < match["poses"][1]["mahalanobis"]
    assert run_match(bank_and_frames, "--map", str(path)) == 0
    assert "door: (" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["--map", "absent.toml"], 3, "absent.toml: cannot be read"),
        (["--map", "a.toml", "--landmark-xy", "1", "2"], 2, "give one of them"),
        (["--prior", "0", "0", "0"], 2, "--prior needs --landmark-xy or --map"),
        (["--landmark-xy", "1", "2", "--prior-std", "1", "1"], 2, "--prior-std needs --prior"),
        (
            ["--landmark-xy", "1", "2", "--prior", "0", "0", "0", "--prior-std", "0", "1"],
            2,
            "--prior-std must be two positive numbers, got 0 1",
        ),
    ],
)
def test_options_that_make_no_sense_are_one_line(capsys, bank_and_frames, options, code, message):
    assert run_match(bank_and_frames, *options) == code
    assert message in capsys.readouterr().err


def test_a_pose_with_covariance_is_printed_with_its_standard_deviations():
    match = Match("cone", True, 1.2, 0.4, covariance=np.diag([1e-6, 1e-4]), symmetry=1)
    (placement,) = LandmarkMap(landmark=[DOOR]).poses(match)
    pose = placement.pose.as_dict()
    assert pose["std"]["heading_deg"] == pytest.approx(math.degrees(0.01))
    assert f"heading {pose['heading_deg']:.2f} ± 0.57°" in pose_text(pose)
