"""Calibration of a lens from frames at known poses: truth recovered, slopes against OpenCV, and what is refused."""

import io
import json
import math
import re
from contextlib import redirect_stdout
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from scipy import stats
from test_calibrate import DEGREE, MESH, PMD, filtered, nees, save, some_mounting, take

from phasemark import UsageError
from phasemark.cli import main
from phasemark.data import BankPlan, build_bank
from phasemark.matcher import Matcher, calibrate, kalman_filter
from phasemark.matcher.calibration import KnownPoses, Mounting
from phasemark.matcher.calibration.mounting import ALL_NAMES, PARAMETERS
from phasemark.matcher.calibration.mounting_model import CalibrationModel, stretch_of
from phasemark.matcher.filters.filtered_frames import noise_free
from phasemark.matcher.likelihood.systematic import calibrated_slopes
from phasemark.render import Frames, Renderer, Sensor, Views, capture
from phasemark.render.sensor import Lens
from phasemark.render.sensor.lens_fields import lens_rates
from phasemark.render.sensor.region import Region
from phasemark.render.sensor.sensor_file import sensor_toml

BARREL = Lens(fx=16.0, fy=16.0, cx=7.5, cy=7.5, distortion=(-0.2, 0.04, 0.0, 0.0, 0.0))
WIDE = PMD.with_(lens=BARREL)
FREE = ("pitch", "bearing", "range_offset", "fx", "fy", "cx", "cy", "k1", "k2")
FISHEYE = Lens(model="fisheye", fx=16.0, fy=15.0, cx=7.2, cy=7.8, distortion=(-0.05, 0.01, 0.002, -0.001))
RATIONAL = BARREL.model_copy(update={"distortion": (0.3, 0.1, 1e-3, -2e-3, 0.02, 0.5, 0.2, 0.03)})


def covering(rng, n):
    """Return poses that show the landmark all over an image of ± 28°."""
    return KnownPoses.polar(
        rng.uniform(0.6, 1.3, n), rng.uniform(0, 2 * math.pi, n), rng.uniform(-22, 22, n) * DEGREE,
        height_m=rng.uniform(-0.3, 0.3, n),
    )  # fmt: skip


def some_camera(rng):
    """Return a mounting that differs from the assumed one in FREE alone: k1 by a quarter, a focal length by 2 %."""
    lens = BARREL.with_terms(
        fx=16 + rng.uniform(-0.4, 0.4), fy=16 + rng.uniform(-0.4, 0.4), cx=7.5 + rng.uniform(-0.3, 0.3),
        cy=7.5 + rng.uniform(-0.3, 0.3), k1=-0.2 + rng.uniform(-0.05, 0.05), k2=0.04 + rng.uniform(-0.02, 0.02),
    )  # fmt: skip
    return replace(some_mounting(rng, 0.8), roll_rad=0.0, height_m=0.0, lens=lens)


def trial(seed, n_poses=6, *, free=FREE, on="phasors"):
    """Calibrate one simulated recording; return its NEES, what was found, and the truth."""
    rng = np.random.default_rng([7, seed])
    truth, poses = some_camera(rng), covering(rng, n_poses)
    found = calibrate(MESH, filtered(take(truth, poses, rng, sensor=WIDE), on), poses, free=free, on=on)
    return nees(found, truth), found, truth


@pytest.mark.soak
def test_95_percent_ellipsoids_of_lenses_hold_the_truth_in_93_to_97_percent_of_100_runs():
    values = [trial(1000 + seed, 10)[0] for seed in range(100)]
    inside = sum(value <= stats.chi2.ppf(0.95, len(FREE)) for value in values)
    print(f"lens: {inside} of 100 true lenses within their 95 % ellipsoid")
    # the 99 % binomial interval about 95 % of 100 runs
    assert 89 <= inside <= 100


# --- a moving camera ---

MOVING_FREE = (*FREE, "delay")


def sway(time_s, phase):
    """Return where a camera is that sways so that the landmark crosses the image to all sides, up to 60° a second."""
    return KnownPoses.polar(
        0.9 + 0.3 * np.sin(1.3 * time_s + phase),
        0.8 * time_s + phase,
        22 * DEGREE * np.sin(2.7 * time_s + 2 * phase),
        height_m=0.28 * np.sin(1.9 * time_s + 3 * phase),
    )


def moving_trial(seed, n):
    """Calibrate a lens and a delay from one simulated recording of n frames; return as :func:`trial` does."""
    rng = np.random.default_rng([8, seed])
    truth = replace(some_camera(rng), delay_s=rng.uniform(-0.1, 0.1))
    stamps, phase = 10 + np.arange(n) / 15, rng.uniform(0, 6)
    at, there = sway(stamps + truth.delay_s, phase), truth.on(WIDE).with_(delay_s=0.0)
    views = Views(at.distance_m, at.delta_rad, at.bearing_rad, at.height_m)
    seen = capture(Renderer(MESH, there, albedo=0.8).render_views(views), there, rng=rng, n_frames=1)
    frames = Frames(
        seen.range_m, seen.amplitude_e, seen.intensity_e, flags=seen.flags, sensor=WIDE, time_s=stamps[:, None]
    )
    time = np.arange(9.0, 11 + n / 15, 0.05)
    poses = replace(sway(time, phase), time_s=time)
    found = calibrate(MESH, kalman_filter(frames), poses, free=MOVING_FREE, moving=True)
    return nees(found, truth), found, truth


def test_the_lens_of_a_moving_camera_lies_within_its_ellipsoid_together_with_the_delay():
    value, found, truth = moving_trial(1, 24)
    assert stats.chi2.ppf(5e-4, 10) < value < stats.chi2.ppf(1 - 5e-4, 10)  # 99.9 % of the NEES of 10 numbers
    assert set(found.free) == set(MOVING_FREE)
    for name in FREE[3:]:
        assert found.sensor.number(f"lens.{name}") == pytest.approx(found.value(name), rel=1e-5)
    assert abs(found.value("delay") - truth.delay_s) < 4 * found.std("delay") < 0.02
    assert not found.doubts


@pytest.mark.soak
def test_95_percent_ellipsoids_of_lenses_of_moving_cameras_hold_the_truth_in_93_to_97_percent_of_60_runs():
    values = [moving_trial(1000 + seed, 60)[0] for seed in range(60)]
    inside = sum(value <= stats.chi2.ppf(0.95, len(MOVING_FREE)) for value in values)
    print(f"moving lens: {inside} of 60 true lenses and delays within their 95 % ellipsoid")
    print(f"mean NEES {np.mean(values):.2f} for {len(MOVING_FREE)} numbers")
    # the 99 % binomial interval about 95 % of 60 runs
    assert 52 <= inside <= 60


# --- slopes and natural units ---


@pytest.mark.parametrize("lens", [BARREL, FISHEYE, RATIONAL], ids=["barrel", "fisheye", "rational"])
def test_a_term_moves_the_image_as_opencv_says(lens):
    # OpenCV's own derivatives of projected points, at the points that lens_rates looks at
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
    u, v = np.meshgrid(np.linspace(0, 16, 9), np.linspace(0, 16, 9))
    y, z = lens.before(16, 16).rays(u.ravel(), v.ravel())
    points = np.column_stack([-y, -z, np.ones(y.size)])[:, None]
    distortion = np.array(lens.distortion)
    if lens.model == "fisheye":
        _, jacobian = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
        columns = dict(zip(("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"), jacobian.T[:8], strict=True))
    else:
        _, jacobian = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        columns = dict(zip(names, jacobian.T[6:], strict=False))
    rates = lens_rates(lens, 16, 16)
    assert tuple(rates) == tuple(lens.terms)
    for name, rate in rates.items():
        moved = columns[name].reshape(-1, 2) / [lens.fx, lens.fy]
        assert rate == pytest.approx(np.hypot(*moved.T).max(), rel=1e-9)


@pytest.mark.parametrize("name", ["fx", "cx", "cy", "k1", "p1"])
def test_slopes_of_ranges_by_a_term_are_those_of_a_wall_seen_through_opencv(name):
    """A wall square to the axis at D has the range D / cos θ; OpenCV says where each part of a pixel looks."""
    distance = 1.0
    wall = trimesh.creation.box((0.01, 20.0, 20.0))
    model = CalibrationModel(wall, WIDE, KnownPoses.polar([distance], [0.0]), albedo=0.8)
    theta = Mounting.of_sensor(WIDE, 0.8).vector
    slope = model.slopes(theta, (name,), "ranges")
    found = WIDE.metres_per_radian * slope[0, 0].imag.reshape(16, 16)
    parts = (np.arange(16 * 8) + 0.5) / 8 - 0.5  # in OpenCV's pixels
    points = np.stack(np.meshgrid(parts, parts), axis=-1).reshape(-1, 1, 2)

    def ranges(lens):
        matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
        to_rounding = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
        x = cv2.undistortPoints(points, matrix, np.array(lens.distortion), criteria=to_rounding)[:, 0]
        range_m = (distance - 0.005) * np.sqrt(1 + (x**2).sum(axis=1))
        light = range_m**-3.0  # cos θ / r²
        sums = [part.reshape(16, 8, 16, 8).sum(axis=(1, 3)) for part in (range_m * light, light)]
        return sums[0] / sums[1]

    step = 1e-4
    ends = [ranges(BARREL.with_terms(**{name: BARREL.terms[name] + side * step})) for side in (1, -1)]
    expected = (ends[0] - ends[1]) / (2 * step)
    # 8 × 8 parts a pixel, and a phase for a mean range: a thousandth of the largest
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())


# --- what poses do not tell, and what is refused ---


@pytest.mark.parametrize("free", [("fx", "cx", "k1", "k2", "k3"), ("pitch", "bearing", "lens")])
def test_a_landmark_in_the_middle_of_all_images_does_not_tell_distortion(free):
    rng = np.random.default_rng(5)
    poses = KnownPoses.polar(rng.uniform(1.3, 2.0, 6), rng.uniform(0, 6, 6), 0.0)
    frames = take(Mounting.of_sensor(WIDE, 0.8), poses, rng, sensor=WIDE)
    with pytest.raises(UsageError) as refused:
        calibrate(MESH, filtered(frames), poses, free=free)
    assert "distortion k" in str(refused.value)
    assert re.search("cannot be (distinguished|determined)", str(refused.value))
    assert "near the corners of the image, with bearings to both sides and heights" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_step_to_a_fold_goes_as_far_as_there_is_none_and_slopes_are_taken_beside_it():
    model = CalibrationModel(MESH, WIDE, KnownPoses.polar([0.7], [0.0], [0.35]), albedo=0.8)
    theta = Mounting.of_sensor(WIDE, 0.8).vector
    step = np.zeros(len(theta))
    k1, pitch = ALL_NAMES.index("k1"), ALL_NAMES.index("pitch")
    step[[k1, pitch]] = -5.0, 0.01
    there = model.moved(theta, step)
    assert theta[k1] + step[k1] < there[k1] < theta[k1]
    assert there[pitch] == pytest.approx(theta[pitch] + 0.01)
    assert stretch_of(WIDE, there) > 0
    step[k1] = np.nan
    assert model.moved(theta, step)[k1] == theta[k1]
    low, high, middle = -5.0, theta[k1], theta.copy()
    for _ in range(60):  # bisect to the fold
        middle[k1] = (low + high) / 2
        low, high = (low, middle[k1]) if stretch_of(WIDE, middle) > 0.01 else (middle[k1], high)
    theta[k1] = high
    slope = model.slopes(theta, ("k1",), "phasors")
    assert np.isfinite(slope).all()
    assert np.abs(slope).max() > 0


def test_a_descent_next_to_a_fold_comes_back_to_the_true_lens():
    rng = np.random.default_rng(9)
    near = WIDE.with_(lens=BARREL.with_terms(k1=-0.34))  # it folds a hundredth farther
    poses = covering(rng, 3)
    frames = replace(filtered(take(Mounting.of_sensor(WIDE, 0.8), poses, rng, sensor=WIDE)), sensor=near)
    found = calibrate(MESH, frames, poses, free=("fx", "k1"))
    assert nees(found, Mounting.of_sensor(WIDE, 0.8)) < stats.chi2.ppf(0.999, 2)
    # beyond the fold the distorted radius rises again: the corners have rays there, and the image has two of many
    with pytest.raises(UsageError, match="'lens' folds"):
        WIDE.with_(lens=BARREL.with_terms(k1=-0.36))


@pytest.mark.parametrize(
    ("sensor", "names", "part"),
    [
        (WIDE, ("fov",), "'free': 'fov' follows from the lens of this sensor: name its terms instead, fx, fy"),
        (WIDE, ("pitch", "half_angle_v"), "'half_angle_v' follows from the lens of this sensor"),
        (WIDE, ("k4",), "the lens of this sensor has no 'k4': it has fx, fy, cx, cy, k1, k2, p1, p2, k3; state"),
        (WIDE.with_(lens=FISHEYE), ("p1",), "has no 'p1': it has fx, fy, cx, cy, k1, k2, k3, k4"),
        (WIDE, ("k9",), "p2, k3, k4, k5, k6 and lens (all of them), got 'k9'"),
        (PMD, ("k1",), "'k1' belongs to a sensor with a lens, and this one has none: give it a table [lens]"),
        (PMD, ("lens",), "'lens' belongs to a sensor with a lens, and this one has none"),
    ],
)  # fmt: skip
def test_names_that_a_camera_has_not_are_refused_in_one_line(sensor, names, part):
    frames = noise_free(Renderer(MESH, sensor, albedo=0.8).render(1.0, 0.7), 10)
    for argument in ("free", "fixed"):
        with pytest.raises(UsageError) as refused:
            calibrate(MESH, frames, KnownPoses.polar([1.0], [0.7]), **{argument: names})
        assert part.replace("'free'", f"'{argument}'") in str(refused.value)
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("sensor", "lens", "part"),
    [
        (PMD, BARREL, "belongs to a sensor with a lens, and this one has none"),
        (WIDE, FISHEYE, "'start' must have a lens of the model and with the number .* 'opencv' with 5"),
        (WIDE, BARREL.with_terms(k1=-3.0), "'lens' folds"),
    ],
)  # fmt: skip
def test_an_initial_guess_with_another_kind_of_lens_is_refused(sensor, lens, part):
    frames = noise_free(Renderer(MESH, sensor, albedo=0.8).render(1.0, 0.7), 10)
    start = replace(Mounting.of_sensor(sensor, 0.8), lens=lens)
    with pytest.raises(UsageError, match=part):
        calibrate(MESH, frames, KnownPoses.polar([1.0], [0.7]), start=start, free=("pitch",))


def test_without_names_a_lens_stays_as_it_is_stated():
    rng = np.random.default_rng(11)
    poses = covering(rng, 4)
    truth = replace(Mounting.of_sensor(WIDE, 0.8), pitch_rad=0.01, range_offset_m=0.02)
    found = calibrate(
        MESH, filtered(take(truth, poses, rng, sensor=WIDE)), poses, fixed=("roll", "height", "albedo", "lens")
    )
    assert found.free == ("pitch", "bearing", "range_offset")
    assert found.sensor.lens == BARREL


# --- what the covariance of a lens does to a view ---

FIELDS = ("lens.fx", "lens.cx", "lens.cy", "lens.k1", "range_offset_m")
STD = np.array([0.03, 0.02, 0.02, 2e-3, 1e-3])


def with_covariance(sensor, covariance, fields=FIELDS):
    table = tuple(tuple(row) for row in np.asarray(covariance).tolist())
    return sensor.with_(calibration_fields=fields, calibration_covariance=table)


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    path = tmp_path_factory.mktemp("bank") / "wide.toml"
    path.write_text(sensor_toml(WIDE, {}, header=(), otherwise="stated"), encoding="utf-8")
    plan = BankPlan(
        classes=("cone",), sensor=str(path), layout="full", distance_m="0.93:1.07:0.02", delta_deg="0:90:2"
    )  # fmt: skip
    return build_bank(plan, workers=1)


@pytest.mark.parametrize("kind", ["phase", "direct"])
def test_slopes_by_terms_of_a_lens_are_those_of_frames_made_with_another_lens(kind):
    base = WIDE if kind == "phase" else Sensor(kind="direct", rows=16, cols=16, lens=BARREL, modulation_hz=1e4)
    sensor = with_covariance(base, np.diag(STD[:4] ** 2), FIELDS[:4])
    renderer = Renderer(trimesh.creation.box((0.01, 20.0, 20.0)), sensor, albedo=0.8)
    views = Views.broadcast(1.0, 0.2, 0.0, 0.0)
    image = renderer.render_views(views)
    slopes = calibrated_slopes(renderer, sensor, views, image, None, sensor.calibration_fields)
    found = sensor.metres_per_radian * (slopes[0] / image.phasor[0]).imag
    for k, name in enumerate(FIELDS[:4]):
        step = 1e-5
        other = sensor.with_numbers({name: sensor.number(name) + step})
        expected = (renderer.seen_by(other).render_views(views).range_m[0] - image.range_m[0]) / step
        if sensor.quantity == "z":  # its ranges are made of z with the lens it is thought to have
            expected -= image.range_m[0] * (sensor.axis_cosine() / other.axis_cosine() - 1) / step
        np.testing.assert_allclose(found[k], expected, atol=0.02 * np.abs(expected).max())


@pytest.mark.parametrize("rank", [5, 1, 0])
def test_the_covariance_of_a_lens_is_carried_into_that_of_a_view(bank, rank):
    root = np.diag(STD) @ np.linalg.qr(np.random.default_rng(1).standard_normal((5, 5)))[0][:, :rank]
    sensor = with_covariance(WIDE, root @ root.T)
    frames = noise_free(Renderer(bank.mesh("cone"), sensor, albedo=0.8).render(1.01, 0.7), 50)
    free = ("distance_m", "delta_rad", "bearing_rad")
    (match,) = Matcher(bank, "refine", free=free).match(frames)
    part = match.systematic["calibration"]
    values = np.linalg.eigvalsh(part / np.outer(STD[:3], STD[:3]))
    assert np.isfinite(part).all()
    assert (values > -1e-9 * max(values.max(), 1e-30)).all()
    assert (part.any()) == (rank > 0)
    if rank == 5:  # a principal point is a bearing: its error is in that of the bearing, most of it
        assert 0.3 < math.sqrt(part[2, 2]) / (STD[1] / BARREL.fx) < 3


@pytest.mark.parametrize(
    ("sensor", "fields", "part"),
    [
        (PMD, ("lens.fx",), "'calibration_fields' must name terms of the lens, which is not stated, got 'lens.fx'"),
        (WIDE, ("lens.k4",), "which has fx, fy, cx, cy, k1, k2, p1, p2, k3, got 'lens.k4'"),
        (WIDE, ("lens.",), "must name terms of the lens"),
        (WIDE, ("lens",), "must name fields of the sensor that are numbers, got 'lens'"),
        (WIDE, ("lens.fx", "lens.fx"), "must name each field once, got 'lens.fx' twice"),
    ],
)
def test_names_of_no_term_are_refused_among_calibrated_fields(sensor, fields, part):
    with pytest.raises(UsageError, match=part):
        with_covariance(sensor, np.eye(len(fields)), fields)


@pytest.mark.parametrize(
    "field", ["lens.fx", "lens.cy", "lens.k1", "half_angle_h_deg", "half_angle_v_deg", "pitch_deg"]
)
def test_the_covariance_of_a_binned_region_is_that_of_its_own_fields(field):
    # the oracle changes the field of the whole camera, and looks what becomes of that of the region
    base = WIDE if field.startswith("lens") else PMD
    region, step = Region(4, 12, 0, 16, 4), 1e-5
    ends = [region.camera(base.with_numbers({field: base.number(field) + side * step})) for side in (1, -1)]
    rate = (ends[0].number(field) - ends[1].number(field)) / (2 * step)
    camera = region.camera(with_covariance(base, [[4.0]], (field,)))
    assert math.sqrt(camera.calibration_matrix[0, 0]) == pytest.approx(2 * abs(rate), rel=1e-6)


# --- the command ---


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lens")
    rng = np.random.default_rng([7, 0])
    truth, poses = some_camera(rng), covering(rng, 6)
    save(folder / "frames.npz", take(truth, poses, rng, sensor=WIDE))
    rows = np.column_stack(
        [poses.distance_m, np.degrees(poses.delta_rad), np.degrees(poses.bearing_rad), poses.height_m]
    )
    np.savetxt(
        folder / "poses.csv", rows, fmt="%.9f", delimiter=",", header="distance_m,delta_deg,bearing_deg,height_m",
        comments="",
    )  # fmt: skip
    (folder / "wide.toml").write_text(sensor_toml(WIDE, {}, header=(), otherwise="stated"), encoding="utf-8")
    return folder, truth


def command(folder, out, *more, sensor="wide.toml"):
    known = folder / sensor
    return main(
        ["calibrate", "cylinder", str(folder / "frames.npz"), "--poses", str(folder / "poses.csv"), "-o", str(out),
         "--sensor", str(known) if known.exists() else sensor, *more]
    )  # fmt: skip


@pytest.fixture(scope="module")
def written(folder, tmp_path_factory):
    """Return the sensor file of a calibration by the command, its answer, and the truth."""
    out, printed = tmp_path_factory.mktemp("written") / "camera.toml", io.StringIO()
    with redirect_stdout(printed):
        assert command(folder[0], out, "--free", ",".join(FREE), "--json") == 0
    return out, json.loads(printed.getvalue()), folder[1]


def test_a_true_lens_lies_within_its_ellipsoid_and_half_angles_follow_it(written):
    path, answer, truth = written
    numbers = answer["parameters"]
    assert tuple(answer["free"]) == FREE
    error = np.array([numbers[name]["value"] - PARAMETERS[name].shown * truth.number(name) for name in FREE])
    value = error @ np.linalg.solve(answer["covariance"], error)
    assert stats.chi2.ppf(5e-4, 9) < value < stats.chi2.ppf(1 - 5e-4, 9)  # the NEES of 9 numbers is χ²(9), 99.9 %
    assert answer["p_value"] > 1e-3
    assert not answer["doubts"]
    sensor = Sensor.from_toml(path)
    assert sensor.half_angle_h_deg == pytest.approx(truth.on(WIDE).half_angle_h_deg, abs=0.05)
    mounting = Mounting.of_sensor(sensor, 0.8)
    assert math.degrees(mounting.half_angle_h_rad) == pytest.approx(sensor.half_angle_h_deg, abs=1e-4)
    assert mounting.on(WIDE).lens == mounting.lens == sensor.lens


def test_the_sensor_file_holds_the_lens_and_its_covariance_and_reads_back(written, capsys):
    path, answer, _ = written
    sensor, numbers = Sensor.from_toml(path), answer["parameters"]
    assert sensor == Sensor(**answer["sensor"])
    names = ("pitch_deg", "bearing_offset_deg", "range_offset_m", *(f"lens.{name}" for name in FREE[3:]))
    assert sensor.calibration_fields == names
    for name in FREE[3:]:
        assert sensor.number(f"lens.{name}") == pytest.approx(numbers[name]["value"], rel=1e-6)
        k = names.index(f"lens.{name}")
        assert math.sqrt(sensor.calibration_matrix[k, k]) == pytest.approx(numbers[name]["std"], rel=1e-5)
    assert sensor.lens.distortion[2:] == (0.0, 0.0, 0.0)  # what was not free
    text = path.read_text(encoding="utf-8")
    assert "# calibrated, k1 ± " in text
    assert "half_angle" not in text
    assert {key: numbers["fx"][key] for key in ("unit", "assumed", "sensor_field")} == {
        "unit": "px", "assumed": 16.0, "sensor_field": "lens.fx",
    }  # fmt: skip
    assert numbers["k3"]["std"] is None
    assert "half_angle_h" not in numbers
    assert main(["sensor", "show", str(path)]) == 0
    assert "lens.k1" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("more", "sensor", "part"),
    [
        (["--free", "fov"], "wide.toml", "'fov' follows from the lens of this sensor"),
        (["--fix", "half_angle_h"], "wide.toml", "'half_angle_h' follows from the lens of this sensor"),
        (["--free", "k1"], "pmd-16x16", "give it a table [lens] in its sensor file ('phasemark sensor import"),
    ],
)
def test_the_command_refuses_what_the_camera_has_not(folder, tmp_path, capsys, more, sensor, part):
    assert command(folder[0], tmp_path / "camera.toml", *more, sensor=sensor) == 2
    error = capsys.readouterr().err
    assert part in error
    assert len(error.strip().splitlines()) == 1
    assert not (tmp_path / "camera.toml").exists()


def test_a_camera_that_gets_a_new_lens_forgets_the_covariance_of_its_old_one(tmp_path, capsys):
    old = with_covariance(WIDE, np.diag([1e-4, 4e-6, 9e-4]), ("lens.k3", "range_offset_m", "pitch_deg"))
    (tmp_path / "old.toml").write_text(sensor_toml(old, {}, header=(), otherwise="stated"), encoding="utf-8")
    (tmp_path / "info.yaml").write_text(
        "image_width: 16\nimage_height: 16\ndistortion_model: plumb_bob\n"
        "camera_matrix: {rows: 3, cols: 3, data: [17, 0, 7.5, 0, 17, 7.5, 0, 0, 1]}\n"
        "distortion_coefficients: {rows: 1, cols: 4, data: [-0.1, 0, 0, 0]}\n"
    )
    out = tmp_path / "new.toml"
    assert (
        main(["sensor", "import", str(tmp_path / "info.yaml"), "--like", str(tmp_path / "old.toml"), "-o", str(out)])
        == 0
    )
    new = Sensor.from_toml(out)
    assert new.calibration_fields == ("range_offset_m", "pitch_deg")
    np.testing.assert_allclose(new.calibration_matrix, np.diag([4e-6, 9e-4]))
