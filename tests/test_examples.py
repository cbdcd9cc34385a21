"""The examples do what they say, on recordings made from closed forms."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLE = Path(__file__).resolve().parent.parent / "examples" / "real_recording.py"
NOISE_M = 0.004
TAN = np.tan(np.radians(22.5))


def zone_distances(distance, yaw):
    """Return z of 8 × 8 zones: the mean range over a zone, weighted by the light, times the cosine of its centre."""
    place = TAN * (1 - (np.arange(8 * 16) + 0.5) / 64)
    z, y = np.meshgrid(place, place, indexing="ij")
    # a ray (1, y, z) turned by the yaw advances cos − y sin towards the panel
    advance = np.cos(yaw) - y * np.sin(yaw)
    length = np.sqrt(1 + y**2 + z**2)
    range_m = distance / advance * length
    light = advance / length / range_m**2

    def zones(values):
        return values.reshape(8, 16, 8, 16).sum(axis=(1, 3))

    centre = TAN * (1 - (np.arange(8) + 0.5) / 4)
    return zones(light * range_m) / zones(light) / np.sqrt(1 + centre[:, None] ** 2 + centre**2)


def write_recording(path, distance_m, yaw_deg, rng, edge=6, mixed_m=0.0, offset_m=0.0, bearing_deg=0.0):
    """Write what zones see of a wide panel, a floor in the lowest two rows, and what is past the panel.

    The sensor may be mounted askew: it sees what it is said to head for at a bearing, and all ranges with an offset.
    """
    place = TAN * (1 - (np.arange(8) + 0.5) / 4)
    axis_cosine = 1 / np.sqrt(1 + place[:, None] ** 2 + place**2)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        zones = range(64)
        writer.writerow(["panel_x_m", "yaw_deg", *(f"mm_{i}" for i in zones), *(f"status_{i}" for i in zones)])
        for distance, yaw in zip(distance_m, np.radians(yaw_deg), strict=True):
            z = zone_distances(distance, yaw - np.radians(bearing_deg)) + offset_m * axis_cosine
            z += NOISE_M * rng.standard_normal((8, 8))
            if mixed_m:  # the last column on the panel sees past it a little
                z[:, edge - 1] += mixed_m
            status = np.full((8, 8), 5)
            z[6:] = 0.03
            z[:, edge:] = 1.9 + 0.3 * rng.random((8, 8 - edge))
            status[rng.random((8, 8)) < 0.1] = 255
            z[status == 255] = 0.5 * rng.random((status == 255).sum())
            writer.writerow([distance, np.degrees(yaw), *np.round(1e3 * z).astype(int).ravel(), *status.ravel()])


def run(*arguments):
    return subprocess.run([sys.executable, EXAMPLE, *map(str, arguments)], capture_output=True, text=True)


@pytest.mark.parametrize("edge", [6, 8])
def test_a_panel_is_followed_before_a_floor_and_a_room(tmp_path, edge):
    rng = np.random.default_rng(8)
    n = 60
    distance, yaw = rng.uniform(0.5, 1.5, n), rng.uniform(-30, 30, n)
    write_recording(tmp_path / "panel.csv", distance, yaw, rng, edge)
    done = run(tmp_path / "panel.csv", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    frame, d, d_std, delta, delta_std, chi2 = np.loadtxt(
        tmp_path / "out" / "estimates.csv", delimiter=",", skiprows=1, unpack=True
    )
    index = frame.astype(int)
    assert len(index) == n
    for error, std in ((d - distance[index], d_std), (delta - yaw[index], delta_std)):
        # its own standard deviation is honest: mean square within 99.9 % of χ² of 60, and no bias
        assert 0.55 < np.mean((error / std) ** 2) < 1.65
        assert abs(np.mean(error / std)) < 3.3 / np.sqrt(n)
    assert np.median(np.abs(d - distance[index])) < 0.003
    assert 0.8 < np.median(chi2) < 1.2
    assert (tmp_path / "out" / "estimates.png").stat().st_size > 10_000


def test_zones_that_see_past_the_side_of_the_panel_do_not_tilt_it(tmp_path):
    rng = np.random.default_rng(9)
    n = 40
    distance, yaw = rng.uniform(0.6, 0.8, n), rng.uniform(-15, 15, n)
    write_recording(tmp_path / "panel.csv", distance, yaw, rng, edge=5, mixed_m=0.012)
    done = run(tmp_path / "panel.csv", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    frame, _, _, delta, delta_std, _ = np.loadtxt(tmp_path / "out" / "estimates.csv", delimiter=",", skiprows=1).T
    error = delta - yaw[frame.astype(int)]
    # a column 12 mm too far, if it counted, would turn a plane over five columns of some 7 cm by 2 to 3°
    assert abs(np.mean(error)) < 3.3 * np.sqrt(np.mean(delta_std**2) / len(frame)) + 0.3


def test_missing_values_are_left_out(tmp_path):
    path = tmp_path / "panel.csv"
    write_recording(path, [0.7, 0.7, 0.7], [0.0, 5.0, 10.0], np.random.default_rng(1))
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    for line, column, value in ((1, "yaw_deg", "nan"), (2, "status_5", "inf"), (2, "mm_4", ""), (3, "status_9", "")):
        rows[line][rows[0].index(column)] = value
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    done = run(path, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "nan" not in done.stdout
    estimates = np.loadtxt(tmp_path / "out" / "estimates.csv", delimiter=",", skiprows=1)
    assert estimates.shape == (3, 6)
    assert np.isfinite(estimates).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "no column 'mm_0'"),
        ("", "no column 'mm_0'"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_in_one_line(tmp_path, text, message):
    path = tmp_path / "wrong.csv"
    path.write_text(text)
    done = run(path, "--out", tmp_path / "out")
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert message in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_recording_without_a_panel_is_refused(tmp_path):
    write_recording(tmp_path / "floor.csv", [0.05], [0.0], np.random.default_rng(1), edge=1)
    done = run(tmp_path / "floor.csv", "--out", tmp_path / "out")
    assert (done.returncode, done.stderr) == (3, "error: no frame shows a panel\n")


@pytest.mark.skipif("PHASEMARK_RECORDING" not in os.environ, reason="PHASEMARK_RECORDING names no recording")
def test_the_recording_at_hand_agrees_with_its_motion_capture(tmp_path):
    done = run(os.environ["PHASEMARK_RECORDING"], "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    frames, mad_mm, rms_deg = done.stdout.split()[0], done.stdout.split("MAD ")[1], done.stdout.split("r.m.s. ")[1]
    assert int(frames) >= 250
    assert float(mad_mm.split()[0]) <= 10
    assert float(rms_deg.split("°")[0]) <= 4


EXAMPLES = sorted(EXAMPLE.parent.glob("*.py"))


def run_example(name, *arguments, folder):
    program = [sys.executable, "-W", "error", EXAMPLE.with_name(name), *map(str, arguments)]
    return subprocess.run(program, capture_output=True, text=True, cwd=folder)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_every_example_explains_itself(path, tmp_path):
    done = run_example(path.name, "--help", folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "usage:" in done.stdout


def test_a_recording_calibrates_its_sensor_and_frames_held_out_fit_it_better(tmp_path):
    rng = np.random.default_rng(10)
    n, truth = 60, {"bearing": 2.0, "range_offset": -9.0, "half_angle_h": 22.5, "pitch": 0.0, "roll": 0.0}
    distance, yaw = rng.uniform(0.5, 1.2, n), rng.uniform(-25, 25, n)
    write_recording(
        tmp_path / "panel.csv", distance, yaw, rng, edge=8,
        offset_m=1e-3 * truth["range_offset"], bearing_deg=truth["bearing"],
    )  # fmt: skip
    done = run_example("calibrate_recording.py", "panel.csv", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    found = {line[0]: (float(line[1]), float(line[3])) for line in lines if line[0] in truth}
    for name, (value, std) in found.items():
        assert abs(value - truth[name]) < 4 * std  # 99.9 % of 5 numbers is 3.7
    assert set(found) == set(truth)
    before, after = (
        [float(word) for word in line if word.lstrip("-").replace(".", "", 1).isdigit()]
        for line in lines
        if line[:2] in (["as", "assumed"], ["as", "calibrated:"])
    )
    # r.m.s., mean and r.m.s. of the zones' means of frames that did not calibrate, mm: noise of 4 mm alone is left,
    # 64 zones of 30 frames leave less than 1.5 mm of it
    assert before[0] > 8
    assert after[0] == pytest.approx(4.0, rel=0.1)
    assert abs(after[1]) < 0.5
    assert after[2] < 1.5 < before[2]
    assert "bearing_offset_deg = " in (tmp_path / "out" / "calibration" / "sensor.toml").read_text()


def test_a_recording_with_too_little_of_a_panel_calibrates_nothing(tmp_path):
    write_recording(tmp_path / "panel.csv", np.full(5, 0.8), np.zeros(5), np.random.default_rng(1), edge=8)
    done = run_example("calibrate_recording.py", "panel.csv", folder=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "5 frames show the panel, a calibration takes at least 20" in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_part_from_cad_is_found_in_its_own_bank(tmp_path):
    done = run_example("bank_from_cad.py", "--delta", "0:360:20", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    true, matched = (
        [float(word.strip(",°")) for word in line.split() if word[0].isdigit()]
        for line in done.stdout.splitlines()
        if "δ" in line
    )
    # the view is simulated with a seed; the bound there is about 0.3 mm and 0.5°
    assert abs(matched[0] - true[0]) < 0.002
    assert abs(matched[1] - true[1]) < 3
    assert (tmp_path / "out" / "cad" / "part.png").read_bytes().startswith(b"\x89PNG")


def test_a_part_without_a_unit_is_refused_in_one_line(tmp_path):
    (tmp_path / "part.stl").write_text("solid part\nendsolid part\n")
    done = run_example("bank_from_cad.py", "part.stl", folder=tmp_path)
    assert done.returncode in (2, 3)
    assert (done.stderr.count("\n"), done.stderr[:7]) == (1, "error: ")


def test_labelled_frames_are_read_back(tmp_path):
    done = run_example("labelled_frames.py", "--views", 40, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "'frame': 80" in done.stdout  # two frames of each view
    assert "(32, 2, 16, 16)" in done.stdout


DATA_LOADER = '''
"""What the example asks of PyTorch, by its documentation: workers get the data set pickled, batches are stacked."""
import multiprocessing, random, sys

import numpy as np


class DataLoader:
    def __init__(self, dataset, batch_size, shuffle, num_workers, multiprocessing_context):
        self.__dict__.update(locals())

    def __iter__(self):
        order = list(range(len(self.dataset)))
        random.Random(1).shuffle(order)
        with multiprocessing.get_context(self.multiprocessing_context).Pool(self.num_workers) as workers:
            for start in range(0, len(order), self.batch_size):
                samples = workers.map(self.dataset.__getitem__, order[start : start + self.batch_size])
                yield tuple(np.stack(column) for column in zip(*samples))
'''


def test_labelled_frames_go_through_a_data_loader_with_worker_processes(tmp_path):
    (tmp_path / "torch" / "utils").mkdir(parents=True)
    for package in ("torch", "torch/utils"):
        (tmp_path / package / "__init__.py").touch()
    (tmp_path / "torch" / "utils" / "data.py").write_text(DATA_LOADER)
    program = [sys.executable, "-W", "error", EXAMPLE.with_name("labelled_frames.py"), "--views", "40"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(program, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    assert "PyTorch: a batch of (32, 2, 16, 16), 4 classes in it" in done.stdout


def test_without_xarray_the_example_says_what_to_install(tmp_path):
    for name in ("xarray", "torch"):  # as if they were not there
        (tmp_path / f"{name}.py").write_text("raise ImportError")
    program = [sys.executable, "-W", "error", EXAMPLE.with_name("labelled_frames.py"), "--views", "8"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(program, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[:2] == [
        "xarray: not installed (pip install xarray h5netcdf)",
        "PyTorch: not installed; the first samples by hand: (12, 2, 16, 16), 12 in the split",
    ]


def test_too_few_views_are_refused_in_one_line(tmp_path):
    done = run_example("labelled_frames.py", "--views", 0, folder=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


def test_an_own_matcher_is_judged_beside_the_papers(tmp_path):
    done = run_example("own_matcher.py", "--trials", 3, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert sum("median range" in line for line in lines) == sum("nearest image" in line for line in lines) == 4
    assert (tmp_path / lines[-1]).stat().st_size > 10_000
