"""Recordings on the command line: simulated, matched frame by frame or as one, their estimates and pictures."""

import csv
import io
import json
import math

import h5py
import numpy as np
import pytest
from matplotlib.figure import Figure

from phasemark.cli import main
from phasemark.data import BankPlan, build_bank, open_bank, read_frames
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import FilteredFrames, Matcher, kalman_filter
from phasemark.matcher.chi_squared import noise_tails, p_values_of
from phasemark.matcher.commands.match_table import bank_ends, summary
from phasemark.matcher.recordings.estimates_table import match_in_batches
from phasemark.render import Background, Frames, Renderer, Views, capture, preset
from phasemark.render.direct import HistogramRenderer
from phasemark.render.sensor.sensor_file import sensor_toml

ZONES = preset("vl53l5cx-8x8")
WALL = ["--wall", 1.5]
SCENE = ["--class", "cylinder", "--sensor", "vl53l5cx-8x8", "--distance", 0.75, "--delta", 30, *WALL]
READ = ["--quantity", "z", "--valid-status", 5]
N = 9
"""Frames of the flight."""
N_BEGIN = 3
"""Frames of its begin."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a bank of the cylinder, a flight towards it and its begin, and a recording at rest."""
    folder = tmp_path_factory.mktemp("recordings")

    def made(*arguments):
        assert main([str(argument) for argument in arguments]) == 0

    grid = ["--distance", "0.54:0.82:0.02", "--delta", "0:180:5"]
    made("bank", "build", "--class", "cylinder", "--sensor", "vl53l5cx-8x8", *grid, "-o", folder / "bank.h5")
    made("frames", "simulate", *SCENE, "--moving", "--frames", N, "--to-distance", 0.6, "-o", folder / "flight.csv")
    made("frames", "simulate", *SCENE, "--frames", 20, "-o", folder / "still.csv")
    note_and_header = 2
    lines = (folder / "flight.csv").read_text().splitlines(keepends=True)[: note_and_header + N_BEGIN]
    (folder / "begin.csv").write_text("".join(lines))
    return folder


@pytest.fixture
def drawn(monkeypatch, capsys):
    """Draw nothing, and collect what was printed before each picture."""
    printed = []

    def picture(*arguments, **options):
        printed.append(capsys.readouterr().out)
        return Figure(figsize=(1, 1))

    monkeypatch.setattr("phasemark.matcher.figures.match_figure", picture)
    return printed


def rows_of(path):
    return list(csv.DictReader(io.StringIO(path.read_text())))


def test_every_frame_of_a_moving_camera_is_a_match_with_its_time(run, folder):
    match, options = ["match", folder / "bank.h5"], [*READ, "--moving", "--no-diagnosis"]
    code, out, err = run(*match, folder / "flight.csv", *options, "--json")
    assert code == 0
    counted, mirrored = err.splitlines()
    matches = json.loads(out)["matches"]
    accepted = [one["accepted"] for one in matches]
    assert counted.startswith(f"note: {sum(accepted)} of {N} frames accepted")
    assert sum(accepted) >= N - 3  # of single frames a few are refused
    assert "may be those of images mirrored left to right" in mirrored
    # 15 frames a second, in whole milliseconds
    assert [one["time_s"] for one in matches] == [round(k / 15, 3) for k in range(N)]
    truth = np.linspace(0.75, 0.6, N)
    # five standard deviations of 0.4 mm
    np.testing.assert_allclose(np.array([one["distance_m"] for one in matches])[accepted], truth[accepted], atol=0.002)
    n = N_BEGIN  # lines of the table take few frames
    code, out, _ = run(*match, folder / "begin.csv", *options)
    header, *rows = out.splitlines()
    titles = ["frame", "time (s)", "class", "D (m)", "δ (°)", "bearing (°)", "pitch (°)", "roll (°)", "background"]
    titles += ["accepted", "p"]
    assert [title.strip() for title in header.split("  ") if title] == titles
    assert [row.count(" ± ") for row in rows] == [5 * yes for yes in accepted[:n]]
    assert any(accepted[:n])
    assert all(" unknown " in row for row in rows)
    assert [row.split()[:3] for row in rows] == [[str(k), f"{k / 15:.3f}", "cylinder"] for k in range(n)]


def test_without_moving_one_note_says_that_something_moved(run, folder):
    options = ["--method", "nearest", "--no-diagnosis"]
    code, out, err = run("match", folder / "bank.h5", folder / "flight.csv", *READ, *options)
    assert code == 0
    header, _ = out.splitlines()  # one position needs no number
    assert header.split() == ["class", "D", "(m)", "δ", "(°)", "accepted", "p"]
    assert len(err.splitlines()) == 1
    assert err.startswith(f"note: {folder / 'flight.csv'}: the camera or the scene moved during the file")
    assert "--moving matches every frame by itself" in err
    code, _, err = run("match", folder / "bank.h5", folder / "still.csv", *READ, *WALL)
    assert (code, "moved" in err) == (0, False)
    assert err.startswith("note: of ranges as a chip reports them what stands behind the landmark is unknown")


def test_the_note_names_the_first_position_that_moved(run, folder, tmp_path):
    rng = np.random.default_rng(1)
    ranges = 0.7 + rng.normal(0, 0.004, (3, 12, 8, 8))
    ranges[2] += np.linspace(0, 0.1, 12)[:, None, None]
    np.savez(tmp_path / "a.npz", range=ranges)
    options = ["--unit", "m", "--quantity", "range", "--method", "nearest", "--no-diagnosis"]
    _, _, err = run("match", folder / "bank.h5", tmp_path / "a.npz", *options)
    assert "moved during 1 of 3 positions, the first being 2," in err


def test_of_frames_that_show_several_places_the_covariance_holds_them_or_the_answer_is_refused(folder):
    wall, delta_rad = Background(wall_m=1.5), math.radians(30)
    renderer = Renderer(build_mesh(catalog()["cylinder"]), ZONES)

    def answers_of(*distances_m):
        images = renderer.render_views(Views.broadcast(np.array(distances_m), delta_rad), background=wall)
        frames = capture(images, ZONES, rng=np.random.default_rng(2), n_frames=1).as_one_position()
        found = [next(iter(match_in_batches(one, frames, kalman_filter))).matches[0] for one in (refined, nearest)]
        return *found, math.sqrt(found[0].covariance[0, 0])

    with open_bank(folder / "bank.h5") as bank:
        refined, nearest = Matcher(bank, "refine", background=wall), Matcher(bank, background=wall)
        still, _, std_m = answers_of(*[0.65] * 10)
        assert still.accepted
        assert std_m < 5e-4
        found, _, std_m = answers_of(*[0.65] * 9, 0.68)
        assert found.distance_m - 0.65 > 2e-3
        assert found.distance_m - 0.65 < 2 * std_m
        found, _, std_m = answers_of(*np.linspace(0.65, 0.66, 10))
        assert found.accepted
        assert 2.5e-3 < std_m < 5e-3  # that of an even distribution over a centimetre is 2.9 mm
        for found in answers_of(*[0.62] * 5, *[0.66] * 5)[:2]:
            assert not found.accepted
            assert found.reason in ("undetermined", "poor fit")


def test_a_landmark_of_few_pixels_that_moved_is_as_uncertain_as_it_moved():
    sensor, rng, n = preset("pmd-16x16"), np.random.default_rng(3), 20
    renderer = Renderer(build_mesh(catalog()["cone"]), sensor)
    plan = BankPlan(classes=("cone",), distance_m="0.8:1.2:0.02", delta_deg="0:360:30")
    with build_bank(plan) as bank:
        matcher = Matcher(bank, "refine")

        def std_m(moved_m):
            distance_m = rng.uniform(0.9, 1.1) + np.linspace(-moved_m / 2, moved_m / 2, n)
            frames = capture(renderer.render(distance_m, 0.3), sensor, rng=rng, n_frames=1).as_one_position()
            (match,) = next(iter(match_in_batches(matcher, frames, kalman_filter))).matches
            return math.sqrt(match.covariance[0, 0])

        assert max(std_m(0) for _ in range(5)) < 0.7e-3  # of the noise: 0.5 mm
        # an even distribution over 15 mm has 4.3 mm; a tenth of the steps of the view is noise
        assert all(3e-3 < std_m(0.015) < 7e-3 for _ in range(5))


def test_rows_are_printed_as_batches_finish(folder, capsys, monkeypatch):
    monkeypatch.setattr("phasemark.matcher.commands.match.NEAREST_AT_ONCE", 4)
    printed, match = [], Matcher.match

    def watched(self, frames):
        printed.append(capsys.readouterr().out)
        return match(self, frames)

    monkeypatch.setattr(Matcher, "match", watched)
    command = ["match", str(folder / "bank.h5"), str(folder / "flight.csv"), *map(str, READ), "--moving"]
    command += ["--method", "nearest", "--no-diagnosis"]  # a diagnosis matches too
    assert main(command) == 0
    printed.append(capsys.readouterr().out)
    # before each batch the rows of the one before, the header with the first
    assert [[line.split()[0] for line in text.splitlines()] for text in printed] == [
        [], ["frame", "0", "1", "2", "3"], ["4", "5", "6", "7"], ["8"],
    ]  # fmt: skip
    assert main([*command, "--jsonl"]) == 0
    lines = [json.loads(line) for text in (*printed[4:], capsys.readouterr().out) for line in text.splitlines()]
    assert [line["index"] for line in lines] == list(range(N))
    assert lines[2]["time_s"] == 0.133


def test_answers_do_not_depend_on_the_size_of_a_batch_and_single_frames_have_the_noise_that_the_sensor_states(folder):
    with open_bank(folder / "bank.h5") as bank:
        frames = read_frames(folder / "begin.csv", sensor=bank.sensor, quantity="z", valid_status=[5])
        matcher = Matcher(bank, "refine", background=Background(wall_m=1.5))
        batches = [
            list(match_in_batches(matcher, frames.each_a_position(), kalman_filter, at_once=at_once))
            for at_once in (2, 256)
        ]
    found = [[match.as_dict() for batch in one for match in batch.matches] for one in batches]
    assert len(found[0]) == N_BEGIN
    assert found[0] == found[1]
    filtered = batches[1][0].filtered
    assert isinstance(filtered, FilteredFrames)
    returned = np.isfinite(filtered.range_m)
    assert returned.any()
    pooled = filtered.with_pooled_noise()
    assert (pooled.std_m[returned] == ZONES.range_std_m).all()
    assert not pooled.std_from_scatter


@pytest.mark.parametrize(("n_frames", "alone"), [(2, 0.13), (3, 0.065)])
def test_few_frames_are_refused_hardly_more_often_than_stated_though_their_scatter_tells_the_noise(n_frames, alone):
    """χ² over a variance that the median of 64 zones tells: as if it were known, 13 and 6.5 % of all are below 1 %."""
    rng, n = np.random.default_rng(3), 2000
    ranges = 0.8 + 3 * ZONES.range_std_m * rng.standard_normal((n, n_frames, 8, 8))  # three times as noisy as stated
    pooled = kalman_filter(Frames(ranges, sensor=ZONES)).with_pooled_noise()
    cost = (((pooled.range_m - 0.8) / pooled.std_m) ** 2).reshape(n, -1).sum(axis=1)
    tails, dof = noise_tails(pooled), np.full(n, 64)
    assert np.mean(p_values_of(cost, dof, tails) < 0.01) < 0.045
    assert np.mean(p_values_of(cost, dof, np.tile([np.inf, 0.0], (n, 1))) < 0.01) == pytest.approx(alone, abs=0.025)


@pytest.mark.soak
def test_the_fit_of_frames_at_rest_passes_its_test_as_often_as_stated(run, folder, tmp_path):
    assert run("frames", "simulate", *SCENE, "--frames", 100, "--seed", 5, "-o", tmp_path / "long.csv")[0] == 0
    match = ["match", folder / "bank.h5", tmp_path / "long.csv", *READ, "--moving", "--no-diagnosis"]
    assert run(*match, "--estimates", tmp_path / "e.csv")[0] == 0
    rows = rows_of(tmp_path / "e.csv")
    assert {row["class"] for row in rows} == {"cylinder"}
    # 1 % of 100 may fail: more than 6 do so once in 10⁴ runs
    assert sum(row["reason"] == "poor fit" for row in rows) <= 6
    accepted = [row for row in rows if row["accepted"] == "true"]
    assert len(accepted) >= 75  # a single frame of some zones leaves much open
    pulls = [(float(row["distance_m"]) - 0.75) / float(row["distance_std_m"]) for row in accepted]
    assert abs(np.mean(pulls)) < 0.5  # four standard deviations of a mean of 75
    assert 0.7 < np.std(pulls) < 1.4  # four


def test_estimates_are_a_table_of_what_was_free(run, folder, tmp_path):
    file = tmp_path / "estimates.csv"
    match = ["match", folder / "bank.h5", folder / "begin.csv", *READ, *WALL, "--moving", "--method", "refine"]
    code, answers, _ = run(*match, "--free", "bearing", "--estimates", file, "--json")
    assert code == 0
    rows = rows_of(file)
    assert list(rows[0]) == [
        "index", "time_s", "pose_time_s", "class", "accepted", "distance_m", "distance_std_m", "delta_deg",
        "delta_std_deg", "bearing_deg", "bearing_std_deg", "corr_distance_delta", "corr_distance_bearing",
        "corr_delta_bearing", "chi2", "dof", "p_value", "reason",
    ]  # fmt: skip
    for k, (row, answer) in enumerate(zip(rows, json.loads(answers)["matches"], strict=True)):
        covariance = np.array(answer["covariance"])
        std = np.sqrt(np.diag(covariance))
        expected = {
            "index": k,
            "time_s": answer["time_s"],
            "pose_time_s": answer["pose_time_s"],
            "distance_m": answer["distance_m"],
            "distance_std_m": std[0],
            "delta_deg": answer["delta_deg"],
            "delta_std_deg": std[1],
            "bearing_deg": answer["bearing_deg"],
            "bearing_std_deg": std[2],
            "corr_distance_bearing": covariance[0, 2] / (std[0] * std[2]),
            "corr_delta_bearing": covariance[1, 2] / (std[1] * std[2]),
            "chi2": answer["chi2"],
            "dof": answer["dof"],
            "p_value": answer["p_value"],
        }
        for name, value in expected.items():
            assert float(row[name]) == pytest.approx(value, rel=1e-8)  # nine digits are written
        assert (row["class"], row["accepted"]) == (answer["class"], str(answer["accepted"]).lower())
    code, out, err = run(*match, "--estimates", file)
    assert (code, out) == (4, "")
    assert "--force" in err
    code, out, _ = run(*match, "--fix", "bearing", "--estimates", file, "--force")
    assert (code, out.splitlines()[-1]) == (0, str(file))
    assert "bearing_deg" not in rows_of(file)[0]


def test_where_nothing_is_found_the_estimates_are_empty(run, folder, tmp_path):
    np.savez(tmp_path / "a.npz", range=np.full((1, 2, 8, 8), np.nan))
    match = ["match", folder / "bank.h5", tmp_path / "a.npz", "--unit", "m", "--quantity", "range"]
    assert run(*match, "--estimates", tmp_path / "e.csv")[0] == 0
    (row,) = rows_of(tmp_path / "e.csv")
    assert (row["index"], row["class"], row["accepted"], row["distance_m"]) == ("0", "", "false", "")


def test_pictures_come_after_the_table_of_chosen_positions_or_of_the_first(run, folder, tmp_path, drawn):
    match = ["match", folder / "bank.h5", folder / "flight.csv", *READ, "--moving", "--method", "nearest"]
    match += ["--no-diagnosis", "--plot", tmp_path / "m.png"]
    code, out, err = run(*match, "--plot-index", "1,3:4")
    assert code == 0
    assert "note: drew" not in err
    assert {path.name for path in tmp_path.iterdir()} == {"m-1.png", "m-3.png", "m-4.png"}
    assert len(drawn[0].splitlines()) == 1 + N
    assert out.split() == [str(tmp_path / f"m-{k}.png") for k in (1, 3, 4)]
    _, _, err = run(*match)
    assert (tmp_path / "m-0.png").exists()
    assert f"note: drew the first of {N} positions; --plot-index 0,4:8 draws others" in err


@pytest.mark.parametrize(
    ("arguments", "contains"),
    [
        (["--plot", "m.png", "--plot-index", "0,9"], "--plot-index must be below 9, the number of positions, got 9"),
        (["--plot", "m.png", "--plot-index", "4:2"], "numbers and ranges such as 0,17,200:210, got '4:2'"),
        (["--plot", "m.png", "--plot-index", "first"], "numbers and ranges"),
        (["--plot-index", "1"], "--plot-index needs --plot"),
        (["--estimates", "e.txt"], "must be a .csv file, got 'e.txt'"),
        (["--estimates", "no/such/e.csv"], "the folder 'no/such' does not exist"),
        (["--json", "--jsonl"], "give one of them"),
    ],
)
def test_a_wrong_option_is_one_line_before_any_work(run, folder, tmp_path, monkeypatch, arguments, contains):
    monkeypatch.chdir(tmp_path)
    code, out, err = run("match", folder / "bank.h5", folder / "flight.csv", *READ, "--moving", *arguments)
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert contains in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("sensor", ["vl53l5cx-8x8", "pmd-16x16"])
def test_a_simulated_recording_says_so_and_is_the_same_in_each_form(run, tmp_path, sensor):
    scene = ["--class", "cone", "--sensor", sensor, "--distance", 0.9, "--moving", "--frames", 5]  # nothing behind
    for suffix in ("csv", "npz", "h5"):
        code, out, _ = run("frames", "simulate", *scene, "--seed", 3, "-o", tmp_path / f"a.{suffix}")
        assert (code, out) == (0, f"{tmp_path / f'a.{suffix}'}\n")
    camera = preset(sensor)
    files = [read_frames(tmp_path / f"a.{suffix}", sensor=camera, valid_status=[5]) for suffix in ("csv", "npz", "h5")]
    for one in files[1:]:
        assert np.array_equal(one.valid, files[0].valid)
        np.testing.assert_allclose(one.range_m, files[0].range_m, atol=6e-6)  # metres are written with 5 decimals
        np.testing.assert_allclose(one.time_s, files[0].time_s, rtol=1e-12)
    assert files[0].valid.any()
    assert not files[0].valid.all()
    assert (files[0].amplitude_e is None) == (sensor == "vl53l5cx-8x8")
    np.testing.assert_allclose(np.diff(files[0].time_s), 1 / camera.frame_rate_hz, atol=1.1e-3)
    first = (tmp_path / "a.csv").read_text().splitlines()[0]
    assert first.startswith("# simulated by phasemark")
    with np.load(tmp_path / "a.npz") as archive, h5py.File(tmp_path / "a.h5") as file:
        assert str(archive["simulated"]).startswith("simulated by phasemark")
        assert file.attrs["simulated"] == str(archive["simulated"])
        np.testing.assert_allclose(archive["truth_distance_m"], np.linspace(0.9, 0.72, 5))
        assert np.array_equal(file["truth_delta_deg"][...], archive["truth_delta_deg"])
    rows = list(csv.DictReader((tmp_path / "a.csv").read_text().splitlines()[1:]))
    assert [row["truth_class"] for row in rows] == ["cone"] * 5
    np.testing.assert_allclose([float(row["truth_delta_deg"]) for row in rows], np.linspace(0, 40, 5))


def test_a_simulated_recording_has_millimetres_status_codes_and_the_noise_of_the_sensor(run, tmp_path):
    n, sensor = 400, ZONES.with_(histogram=None)  # the chip of one with a table is in test_chip_ranges.py
    (tmp_path / "mean.toml").write_text(sensor_toml(sensor, {}, header=[], otherwise="assumed"), encoding="utf-8")
    scene = ["--class", "cylinder", "--sensor", tmp_path / "mean.toml", "--distance", 0.7, "--delta", 30]
    assert run("frames", "simulate", *scene, "--frames", n, "-o", tmp_path / "a.csv")[0] == 0
    rows = list(csv.DictReader((tmp_path / "a.csv").read_text().splitlines()[1:]))
    z_mm = np.array([[int(row[f"mm_{k}"]) for k in range(64)] for row in rows])
    status = np.array([[int(row[f"status_{k}"]) for k in range(64)] for row in rows])
    assert np.array_equal(status == 5, z_mm > 0)
    assert set(np.unique(status)) == {5, 255}  # nothing stands behind the landmark
    image = Renderer(build_mesh(catalog()["cylinder"]), sensor).render(0.7, math.radians(30))
    returned = image.intensity[0].ravel() > 0
    assert np.array_equal(status[0] == 5, returned)
    exact = (1e3 * image.range_m[0] * sensor.axis_cosine()).ravel()[returned]
    std = 1e3 * (sensor.range_std_m * sensor.axis_cosine()).ravel()[returned]
    pulls = (z_mm[:, returned].mean(axis=0) - exact) / (std / math.sqrt(n))
    assert np.abs(pulls).max() < 4.5  # of at most 64: once in 2000 runs
    np.testing.assert_allclose(z_mm[:, returned].std(axis=0), np.sqrt(std**2 + 1 / 12), rtol=0.16)  # 4.5 of 1/√800


def test_a_recording_of_a_chip_has_the_ranges_that_a_frame_set_of_its_histograms_has(run, tmp_path):
    assert run("frames", "simulate", *SCENE, "--frames", 5, "-o", tmp_path / "a.npz")[0] == 0
    image = HistogramRenderer(build_mesh(catalog()["cylinder"]), ZONES, albedo=0.8).render(
        0.75, math.radians(30), background=Background(wall_m=1.5)
    )
    ranges = capture(image, ZONES, rng=np.random.default_rng(3), n_frames=200).ranges.range_m[0]
    with np.load(tmp_path / "a.npz") as made:
        z_m = np.where(made["status"] == 5, made["range"] * 1e-3, np.nan).reshape(5, 8, 8)
        seen = z_m / ZONES.axis_cosine()
    usual, std = np.nanmedian(ranges, axis=0), np.nanstd(ranges, axis=0)
    clear = np.isfinite(seen).all(axis=0) & np.isfinite(ranges).all(axis=0)
    clear &= np.ptp(ranges, axis=0) < 0.05  # the zones that report one surface each time
    assert clear.sum() > 40
    off = (np.abs(seen - usual) / (6 * std + 1e-3))[:, clear]
    assert off.max() < 1


def test_a_frame_of_a_recording_is_drawn(run, folder, tmp_path):
    show = ["frames", "show", folder / "still.csv", "--sensor", "vl53l5cx-8x8", "--index", 3, "-o", tmp_path / "a.png"]
    code, _, err = run(*show)
    assert code == 2
    assert "--valid-status" in err
    assert run(*show, "--valid-status", 5)[0] == 0
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_another_seed_is_other_noise_and_the_same_seed_the_same(run, tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert run("frames", "simulate", *SCENE, "--seed", seed, "-o", tmp_path / f"{name}.npz")[0] == 0
    a, b, c = (np.load(tmp_path / f"{name}.npz")["range"] for name in "abc")
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)
    assert not np.array_equal(a[0], a[1])


@pytest.mark.parametrize(
    ("code", "arguments", "contains"),
    [
        (2, ["-o", "a.csv"], "either --class NAME or --mesh NAME=FILE"),
        (2, ["--class", "pyramid", "-o", "a.csv"], "pyramid"),
        (2, ["--class", "cone", "-o", "a.xlsx"], "must be a .csv, .npz or .h5 file, got 'a.xlsx'"),
        (2, ["--class", "cone", "--to-delta", 3, "-o", "a.csv"], "--to-delta goes with --moving"),
        (2, ["--class", "cone", "--frames", 0, "-o", "a.csv"], "--frames"),
        (2, ["--class", "cone", "--frames", 100_001, "-o", "a.csv"], "--frames must be at most 19531"),
        (2, ["--class", "cone", "--distance", -1, "-o", "a.csv"], "'distance_m' must be positive"),
        (2, ["--class", "cone", "--wall", 0.5, "-o", "a.csv"], "wall_m"),
        (4, ["--class", "cone", "-o", "taken.csv"], "--force"),
    ],
)
def test_a_recording_that_cannot_be_simulated_is_one_line(run, tmp_path, monkeypatch, code, arguments, contains):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken.csv").write_text("mine")
    found, out, err = run("frames", "simulate", *arguments)
    assert (found, out) == (code, "")
    assert len(err.splitlines()) == 1
    assert contains in err
    assert [path.name for path in tmp_path.iterdir()] == ["taken.csv"]


def test_the_time_of_a_pose_has_the_delay_of_the_sensor_and_moves_repeated_stamps(run, folder, tmp_path):
    ranges = np.full((4, 8, 8), 0.7)
    stamps_ms = np.array([0.0, 100.0, 300.0, 300.0])  # the third was taken at 200 ms, and stamped with the fourth
    np.savez(tmp_path / "late.npz", range=ranges, unit="m", quantity="range", t_ms=stamps_ms)
    text = sensor_toml(ZONES.with_(delay_s=-0.05), {}, header=[], otherwise="assumed")
    (tmp_path / "late.toml").write_text(text, encoding="utf-8")
    grid = ["--distance", "0.6:0.8:0.1", "--delta", "0:180:30"]
    bank = tmp_path / "late.h5"
    assert run("bank", "build", "--class", "cylinder", "--sensor", tmp_path / "late.toml", *grid, "-o", bank)[0] == 0
    match = ["match", bank, tmp_path / "late.npz", "--method", "nearest", "--no-diagnosis"]
    assert run(*match, "--moving", "--estimates", tmp_path / "moving.csv")[0] == 0
    moving = rows_of(tmp_path / "moving.csv")
    assert [float(row["time_s"]) for row in moving] == [0.0, 0.1, 0.3, 0.3]
    np.testing.assert_allclose([float(row["pose_time_s"]) for row in moving], [-0.05, 0.05, 0.15, 0.25], atol=1e-9)
    assert run(*match, "--estimates", tmp_path / "still.csv")[0] == 0
    (still,) = rows_of(tmp_path / "still.csv")
    assert float(still["time_s"]) == pytest.approx(0.175)
    assert float(still["pose_time_s"]) == pytest.approx(0.1)  # the mean of 0, 0.1, 0.2 and 0.3, less 0.05
    assert run(*match, "--moving", "--delay-ms", 20, "--estimates", tmp_path / "own.csv")[0] == 0
    own = [float(row["pose_time_s"]) for row in rows_of(tmp_path / "own.csv")]
    np.testing.assert_allclose(own, [0.02, 0.12, 0.22, 0.32], atol=1e-9)
    np.savez(tmp_path / "bare.npz", range=ranges, unit="m", quantity="range")
    bare = ["match", bank, tmp_path / "bare.npz", "--method", "nearest", "--no-diagnosis", "--delay-ms"]
    for delay_ms, part in ((20, "is added to time stamps, and these frames have none"), ("nan", "must be from -10000")):
        code, _, err = run(*bare, delay_ms)
        assert (code, err.count("\n")) == (2, 1)
        assert part in err


def test_the_summary_counts_reasons_and_names_the_end_of_the_bank(run, folder, tmp_path):
    assert run("frames", "simulate", *SCENE, "--moving", "--frames", 12, "--to-distance", 1.0, "--to-delta", 30,
               "-o", tmp_path / "away.csv")[0] == 0  # fmt: skip
    match = ["match", folder / "bank.h5", tmp_path / "away.csv", *READ, "--moving", "--no-diagnosis"]
    match += ["--method", "nearest", *WALL]
    code, out, err = run(*match)
    assert code == 0
    counted, end = err.splitlines()
    rows = out.splitlines()[1:]
    accepted = sum(" yes " in row for row in rows)
    assert counted.startswith(f"note: {accepted} of 12 frames accepted; refused: ")
    assert sum(int(part.split()[0]) for part in counted.split("refused: ")[1].split(", ")) == 12 - accepted
    # 0.75 to 1 m in 12 steps: 8 of 12 are beyond 0.82 m
    assert end.startswith("note: the bank ends at 0.82 m, where ")
    assert " of 12 frames have their best fit" in end
    assert "--distance" in end


def test_answers_inside_a_bank_and_at_the_ends_of_a_coarse_one_are_no_pile():
    grid = [0.8, 1.0, 1.2]
    assert bank_ends([0.8, 1.0, 1.2] * 9, grid, "frame") == []
    fine = [0.5 + 0.01 * k for k in range(50)]
    assert bank_ends([0.7, 0.8, math.nan, fine[-1]] * 3, fine[:31], "frame") == [
        "the bank ends at 0.8 m, where 6 of 9 frames have their best fit: if the landmark may be farther, build it with"
        " a wider --distance"
    ]
    assert bank_ends([math.nan], fine, "position") == []
    assert summary(["", "poor fit", "", "ambiguous", "poor fit"], "frame") == (
        "2 of 5 frames accepted; refused: 2 poor fit, 1 ambiguous"
    )
