"""Errors of measured poses in the terms of ASTM E2919: closed forms, intervals that hold, files and commands."""

import json
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from phasemark import InputFileError, UsageError
from phasemark.matcher.accuracy.pose_errors import ErrorSummary, percentile_interval, pose_report, views_as_poses
from phasemark.matcher.recordings.pose_table import read_pose_table
from phasemark.render import Views

TRUE = Views.broadcast(
    [1.0, 1.2, 1.5, 0.9], [0.3, 1.0, 2.0, 3.0], [0.05, -0.1, 0.0, 0.2], 0.02, [0, 0.1, -0.1, 0], 0.03
)


def test_a_common_shift_is_an_absolute_error_alone():
    measured = views_as_poses(TRUE)
    measured[:, :3, 3] += [0.003, -0.004, 0.0]
    report = pose_report(measured, TRUE)
    assert report.n_poses == report.n_measured == 4
    np.testing.assert_allclose([report.position_m.mean.value, report.position_m.maximum], 0.005)
    np.testing.assert_allclose([one.value for one in report.position_bias_m], [0.003, -0.004, 0.0], atol=1e-15)
    assert report.orientation_rad.maximum < 1e-12
    # the motion between poses is seen from a camera that has turned: its frame is that of the landmark
    assert report.relative_orientation_rad.maximum < 1e-12


def test_a_turn_about_any_axis_is_its_angle():
    rng = np.random.default_rng(5)
    axes = rng.normal(size=(4, 3))
    angles = np.array([0.01, 0.2, 1.0, math.pi])
    turns = Rotation.from_rotvec(axes / np.linalg.norm(axes, axis=1, keepdims=True) * angles[:, None]).as_matrix()
    measured = views_as_poses(TRUE)
    measured[:, :3, :3] = turns @ measured[:, :3, :3]
    report = pose_report(measured, TRUE)
    assert report.position_m.maximum < 1e-12
    np.testing.assert_allclose(report.orientation_rad.mean.value, angles.mean(), rtol=1e-9)
    assert report.orientation_rad.maximum == pytest.approx(math.pi)


def test_relative_errors_are_those_of_the_motion():
    """Compared with scipy's rotations, in a formulation of its own."""
    rng = np.random.default_rng(6)
    measured = views_as_poses(TRUE)
    noise = Rotation.from_rotvec(rng.normal(0, 0.02, (4, 3)))
    measured[:, :3, :3] = noise.as_matrix() @ measured[:, :3, :3]
    measured[:, :3, 3] += rng.normal(0, 0.003, (4, 3))
    truth = views_as_poses(TRUE)
    angles, shifts = [], []
    for k in range(3):
        own, true = (np.linalg.inv(poses[k]) @ poses[k + 1] for poses in (measured, truth))
        angles.append((Rotation.from_matrix(own[:3, :3]) * Rotation.from_matrix(true[:3, :3]).inv()).magnitude())
        shifts.append(np.linalg.norm(own[:3, 3] - true[:3, 3]))
    report = pose_report(measured, TRUE)
    assert report.relative_orientation_rad.mean.value == pytest.approx(np.mean(angles))
    assert report.relative_position_m.maximum == pytest.approx(max(shifts))


def test_a_symmetric_landmark_counts_by_its_nearest_turn():
    turned = Views.broadcast(TRUE.distance_m, TRUE.delta_rad + math.pi / 2 + 0.01, TRUE.bearing_rad, TRUE.height_m)
    level = Views.broadcast(TRUE.distance_m, TRUE.delta_rad, TRUE.bearing_rad, TRUE.height_m)
    assert pose_report(turned, level, symmetry=4).orientation_rad.maximum == pytest.approx(0.01)
    assert pose_report(turned, level).orientation_rad.maximum == pytest.approx(math.pi / 2 + 0.01)


def test_poses_that_were_not_measured_count_in_their_number_alone():
    measured = views_as_poses(TRUE)
    measured[1] = np.nan
    report = pose_report(measured, TRUE)
    assert (report.n_poses, report.n_measured) == (4, 3)
    assert report.relative_position_m.n == 1  # from the third to the fourth


@pytest.mark.parametrize("share", [0.5, 0.95])
def test_intervals_of_percentiles_hold_for_any_distribution(share):
    """Of 2 000 samples of an exponential law, the interval misses the true percentile in at most 5 %."""
    rng = np.random.default_rng(7)
    true = -math.log(1 - share)
    missed = 0
    for _ in range(2000):
        one = percentile_interval(rng.exponential(size=80), share)
        missed += not one.low <= true <= one.high
    # at most 5 %, and 4 standard deviations of a count of 2 000
    assert missed / 2000 < 0.05 + 4 * math.sqrt(0.05 * 0.95 / 2000)
    assert missed / 2000 > 0.005


def test_few_poses_bound_no_high_percentile():
    one = ErrorSummary.of([1.0, 2.0, 3.0]).percentiles[0.997]
    assert one.high == math.inf
    assert ErrorSummary.of([1.0, 2.0, 3.0]).as_dict(1.0)["percentiles"]["99.7"]["high"] is None


@pytest.mark.parametrize(
    ("measured", "message"),
    [
        (views_as_poses(TRUE)[:2], "as many measured poses as true ones, got 2 and 4"),
        (np.full((4, 4, 4), np.nan), "no pose was measured"),
        (2 * views_as_poses(TRUE), "must be a rotation and a translation"),
        (np.zeros((4, 3)), r"poses must have shape \(n, 4, 4\)"),
    ],
)
def test_poses_that_cannot_be_compared_are_refused(measured, message):
    with pytest.raises(UsageError, match=message):
        pose_report(measured, TRUE)


@pytest.fixture
def files(tmp_path):
    """Return estimates 2 mm too far, the second refused, and the truth by position and by time."""
    estimates, truth, track = (tmp_path / f"{name}.csv" for name in ("estimates", "truth", "track"))
    time = 0.1 * np.arange(30)
    distance = 1.0 + 0.05 * time
    rows = [
        f"{k},{t},cone,{'false' if k == 1 else 'true'},{d + 0.002:.6f},10.0"
        for k, (t, d) in enumerate(zip(time, distance, strict=True))
    ]
    estimates.write_text("\n".join(["index,time_s,class,accepted,distance_m,delta_deg", *rows, ""]))
    rows = [f"{d:.6f},10.0" for d in distance]
    truth.write_text("\n".join(["# made up", "truth_distance_m,truth_delta_deg", *rows, ""]))
    late = 0.05 * np.arange(70) - 0.2
    track.write_text("\n".join(["t_s,distance_m,delta_deg", *(f"{t},{1 + 0.05 * t:.6f},10.0" for t in late), ""]))
    return estimates, truth, track


@pytest.mark.parametrize("which", [1, 2])
def test_a_report_from_files(run, files, which):
    code, out, _ = run("pose", "report", files[0], files[which], "--json")
    report = json.loads(out)
    assert code == 0
    assert (report["poses"], report["measured"]) == (30, 29)
    assert report["position_error_mm"]["mean"]["value"] == pytest.approx(2.0, abs=1e-3)
    assert report["orientation_error_deg"]["maximum"] == pytest.approx(0.0, abs=1e-6)
    out = run("pose", "report", files[0], files[which], "--refused").out
    assert "30 of 30 poses measured" in out
    assert out.splitlines()[1].startswith("position (mm)")


def test_stamps_in_both_files_are_compared_by_time_whatever_the_number_of_poses(run, files, tmp_path):
    track = tmp_path / "of_30.csv"
    rows = [f"{t},{1 + 0.05 * t:.6f},10.0" for t in np.linspace(-0.4, 3.1, 30)]
    track.write_text("\n".join(["t_s,distance_m,delta_deg", *rows, ""]))
    report = json.loads(run("pose", "report", files[0], track, "--json").out)
    assert report["position_error_mm"]["mean"]["value"] == pytest.approx(2.0, abs=1e-3)
    late = json.loads(run("pose", "report", files[0], track, "--delay", -0.1, "--json").out)
    assert late["position_error_mm"]["mean"]["value"] == pytest.approx(7.0, abs=1e-3)
    code, _, err = run("pose", "report", files[0], files[1], "--delay", 0.1)
    assert (code, "--delay takes stamps (t_s) in both files" in err) == (2, True)


def test_files_that_do_not_belong_together(run, files, tmp_path):
    short = tmp_path / "short.csv"
    short.write_text("distance_m,delta_deg\n1.0,10\n")
    code, _, err = run("pose", "report", files[0], short)
    assert (code, "has 1 poses, and" in err) == (2, True)
    track = tmp_path / "elsewhere.csv"
    track.write_text("\n".join(["t_s,distance_m,delta_deg", *(f"{100 + 0.1 * k},1.0,10.0" for k in range(40)), ""]))
    code, _, err = run("pose", "report", files[0], track)
    assert (code, "do the clocks agree?" in err) == (2, True)
    twice = tmp_path / "twice.csv"
    twice.write_text(files[0].read_text() + files[0].read_text().splitlines()[4] + "\n")
    code, _, err = run("pose", "report", twice, files[1])
    assert (code, "position 3 has more than one estimate: give each once" in err) == (2, True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must have a header and at least one pose"),
        ("distance_m,bearing_deg\n1,2\n", "no column 'delta_deg'"),
        ("distance_m,delta_deg\n1,2\n1\n", "line 3: 1 values, must have 2"),
        ("distance_m,delta_deg\n1,east\n", "line 2: 'delta_deg' must be a number, got 'east'"),
        ("distance_m,delta_deg\n1,1_0\n", "line 2: 'delta_deg' must be a number, got '1_0'"),
        ("distance_m,delta_deg\n1,inf\n", "line 2: 'delta_deg' must be a finite number"),
    ],
)
def test_tables_that_are_none_are_refused(tmp_path, text, message):
    path = tmp_path / "poses.csv"
    path.write_text(text)
    with pytest.raises(InputFileError, match=message):
        read_pose_table(path)
