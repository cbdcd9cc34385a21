"""A sensor fitted to frames of a board: truth recovered from simulated cameras, and what is said when it cannot be."""

import json
import math
import tomllib
from functools import lru_cache

import numpy as np
import pytest
from scipy import stats

from phasemark import UsageError
from phasemark.cli import main
from phasemark.render import Flag, Frames, Sensor, camera_unit, capture, preset
from phasemark.render.bench import fit_sensor
from phasemark.render.bench.fit.boards import FEWEST_FRAMES
from phasemark.render.bench.flat_field import board_image
from phasemark.render.exposure.stray_light import spread_light
from phasemark.render.sensor.correlation import correlation_curve

PMD, BAD_DAY = preset("pmd-16x16"), preset("pmd-16x16-wiggle")
FAR = (0.8, 1.2, 2.0, 3.0, 4.0, 5.0)
NEAR = tuple(np.linspace(0.7, 3.2, 8))
Z = stats.norm.ppf(1 - 1e-3 / 2 / 40)  # 99.9 % over the about 40 numbers that this file compares: 4.2 σ


@lru_cache(maxsize=64)
def image_of(sensor, distance_m, albedo):
    return board_image(sensor, distance_m, albedo)


def take(sensor, distance_m, n=50, *, seed=0, albedo=0.8, amplitude=True, intensity=True, gain=1.0):
    """Frames of a board; `gain` turns electrons into units of somebody's own."""
    rng = np.random.default_rng([seed, round(1000 * distance_m)])
    frames = capture(image_of(sensor, distance_m, albedo), sensor, rng=rng, n_frames=n)
    return Frames(
        frames.range_m,
        gain * frames.amplitude_e if amplitude else None,
        gain * frames.intensity_e if intensity else None,
        sensor=sensor,
    )


def fitted(sensor, distances, n=50, *, base=PMD, amplitude_unit="electrons", **options):
    boards = [take(sensor, d, n, **options) for d in distances]
    return fit_sensor(boards, distances, base=base, albedo=[0.8], amplitude_unit=amplitude_unit, distance_std_m=0)


def meets(fit, name, truth):
    one = fit.estimates[name]
    return one.value == pytest.approx(truth, abs=Z * one.std_error)


# Truth recovered: 50 frames of 256 pixels a board; intervals of 99.9 % over all numbers, from the fit's own errors


def test_the_published_camera_is_recovered_from_ranges_at_several_distances():
    camera = PMD.with_(ambient_e=4000.0, range_offset_m=0.07, phase_offset_std_rad=0.01)
    fit = fitted(camera, FAR, amplitude=False, intensity=False)
    assert meets(fit, "signal_e", camera.signal_e)  # K = 0.5 is the assumed one, and is right
    assert meets(fit, "ambient_e", 4000.0)
    delay = camera_unit(camera).delay_rad[0]
    assert meets(fit, "range_offset_m", delay.mean() * camera.metres_per_radian)
    assert meets(fit, "phase_offset_std_rad", delay.std(ddof=1))
    assert fit.estimates["signal_e"].std_error < 0.05 * camera.signal_e
    assert fit.estimates["contrast"].std_error is None
    assert fit.sensor.modulation == "sine"
    assert any("No wiggling is seen" in note for note in fit.notes)


def test_amplitude_and_intensity_tell_contrast_light_and_read_noise_apart():
    camera = PMD.with_(contrast=0.4, signal_e=20_000.0, ambient_e=5000.0, read_noise_e=60.0)
    fit = fitted(camera, FAR[:5])
    for name in ("contrast", "signal_e", "ambient_e", "read_noise_e"):
        assert meets(fit, name, getattr(camera, name))
        assert fit.estimates[name].std_error < 0.05 * getattr(camera, name)
    without_intensity = fitted(camera, FAR[:5], intensity=False)
    assert meets(without_intensity, "contrast", 0.4)
    assert meets(without_intensity, "ambient_e", 5000.0 + 2 * 60.0**2)  # which read noise looks like
    assert without_intensity.estimates["read_noise_e"].std_error is None


def test_photon_transfer_finds_the_electrons_of_an_arbitrary_unit():
    camera = PMD.with_(contrast=0.4, ambient_e=5000.0)
    fit = fitted(camera, FAR[:5], n=200, gain=0.037, amplitude_unit="arbitrary")
    note = next(note for note in fit.notes if "electrons a unit" in note)
    scale, error = (float(word) for word in note.split("gives ")[1].split(" electrons")[0].split(" ± "))
    assert scale == pytest.approx(1 / 0.037, abs=Z * error)
    assert meets(fit, "signal_e", camera.signal_e)
    assert meets(fit, "ambient_e", 5000.0)
    assert meets(fit, "read_noise_e", 0.0)
    assert meets(fit, "contrast", 0.4)  # a ratio: no unit in it
    aside = fitted(camera, FAR[:1], gain=0.037, amplitude_unit="arbitrary")
    assert any("left aside" in note for note in aside.notes)


@pytest.fixture(scope="module")
def bad_day():
    """Square waves, patterns, stray light, converter and defects, distinguished by 8 distances of 100 frames."""
    return fitted(BAD_DAY, NEAR, 100)


def test_a_bad_day_is_recovered_within_its_intervals(bad_day):
    fit = bad_day
    unit = camera_unit(BAD_DAY)
    alive = ~(unit.dead | unit.hot)
    assert set(fit.sensor.dead_pixels) == {(int(r), int(c)) for r, c in np.argwhere(~alive)}
    assert fit.sensor.hot_pixels == ()
    # the truth of this unit, not of its make: mean sensitivity, light that stray light leaves, mean dark signal
    board = board_image(BAD_DAY, 1.0, 0.8)
    kept = (spread_light(board.intensity, BAD_DAY) / board.intensity)[0]
    response = unit.response.mean(axis=0)
    assert meets(fit, "signal_e", BAD_DAY.signal_e * (response * kept)[alive].mean())
    ambient = (BAD_DAY.ambient_e * response + unit.dark_e.sum(axis=0))[alive].mean()
    assert meets(fit, "ambient_e", ambient)  # dark current is taken for ambient light, as the base has none
    assert meets(fit, "read_noise_e", math.sqrt(BAD_DAY.read_noise_e**2 + BAD_DAY.code_e**2 / 12))
    delay = unit.delay_rad.mean(axis=0)[alive]
    assert meets(fit, "phase_offset_std_rad", delay.std(ddof=1))
    # K: the amplitude wiggles with the range, which the spread over distances allows for
    assert meets(fit, "contrast", 0.5)


def test_the_fitted_wiggling_is_the_camera_s_own(bad_day):
    fit = bad_day
    assert [k for k, _, _ in fit.sensor.harmonics] == [3, 7]
    unit = camera_unit(BAD_DAY)
    alive = ~(unit.dead | unit.hot)
    phase = np.linspace(NEAR[0], NEAR[-1], 60) / BAD_DAY.metres_per_radian

    def error_m(sensor, delay):
        d = [correlation_curve(phase + delay + i * math.pi / 2, sensor.correlation_harmonics) for i in range(4)]
        turn = np.exp(1j * (np.arctan2(d[3] - d[1], d[0] - d[2]) - phase))
        return np.angle(turn) * sensor.metres_per_radian

    true = error_m(BAD_DAY, unit.delay_rad[:, alive].mean())
    found = error_m(fit.sensor, fit.sensor.range_offset_m / fit.sensor.metres_per_radian)
    # orders 3 and 7 meet in the 12th harmonic of the error by a_3 a_7 · c/4πf = 5.4 mm, which the fit cannot follow
    assert np.abs(found - true).max() < 5.4e-3
    assert np.ptp(true) > 0.3


def test_standard_errors_are_those_of_repeated_fits():
    # 24 cameras' worth of frames: the spread of each estimate over its stated error, 99.9 % interval of χ² over 4
    camera, n = PMD.with_(ambient_e=4000.0, read_noise_e=80.0), 24
    names = ("range_offset_m", "signal_e", "contrast", "ambient_e", "read_noise_e")
    found = {name: [] for name in names}
    for seed in range(n):
        boards = [take(camera, d, 20, seed=100 + seed) for d in (0.8, 2.0, 3.0)]
        fit = fit_sensor(boards, (0.8, 2.0, 3.0), base=PMD, albedo=[0.8], distance_std_m=0)
        for name in names:
            one = fit.estimates[name]
            truth = 0.0 if name == "range_offset_m" else getattr(camera, name)
            found[name].append((one.value - truth) / one.std_error)
    high = stats.chi2.ppf(1 - 1e-3 / len(names), n)
    for name in names:
        pulls = np.array(found[name])
        assert (pulls**2).sum() < high  # errors may be stated too large, never too small


def test_a_pattern_from_nine_frames_is_not_made_larger_by_their_noise():
    camera, n, pulls = PMD.with_(signal_e=3000.0, ambient_e=300.0, phase_offset_std_rad=0.01), 8, []
    for seed in range(n):
        one = fitted(camera, (1.0, 1.5, 2.0), 9, seed=seed, amplitude=False, intensity=False)
        estimate = one.estimates["phase_offset_std_rad"]
        pulls.append((estimate.value - camera_unit(camera).delay_rad[0].std(ddof=1)) / estimate.std_error)
    assert abs(np.mean(pulls)) < stats.norm.ppf(1 - 1e-3 / 2) / math.sqrt(n)


@pytest.mark.parametrize("n", [40, pytest.param(100, marks=pytest.mark.soak)])
@pytest.mark.parametrize(
    ("given", "distances"),
    [("ranges", (1.0,)), ("ranges", (0.8, 2.0, 3.0)), ("amplitude", (1.0, 1.1)), ("intensity", (0.8, 2.0, 3.0))],
)
def test_errors_of_the_distances_are_in_the_standard_errors(given, distances, n):
    # N = 40 or 100 sets of distances, each 5 mm (1 σ) off the truth, which the fit is told; 99.9 % over the 4 cases
    std_m, camera, rng = 0.005, PMD.with_(ambient_e=4000.0), np.random.default_rng(len(given + str(distances)))
    if len(distances) == 1 or given == "amplitude":
        camera = PMD  # the assumed ambient light has to be right
    seen = {"amplitude": given != "ranges", "intensity": given == "intensity"}
    boards = [[take(camera, d, 20, seed=seed, **seen) for d in distances] for seed in range(n)]
    names = ["range_offset_m", "signal_e", *(["ambient_e", "contrast"] if seen["intensity"] else [])]
    pulls, blind = {name: [] for name in names}, []
    for k in range(n):
        stated = np.asarray(distances) + rng.normal(0, std_m, len(distances))
        fit = fit_sensor(boards[k], stated, base=PMD, albedo=[0.8], distance_std_m=std_m)
        exact = fit_sensor(boards[k], stated, base=PMD, albedo=[0.8], distance_std_m=0) if k < 20 else None
        for name in names:
            truth = 0.0 if name == "range_offset_m" else getattr(camera, name)
            pulls[name].append((fit.estimates[name].value - truth) / fit.estimates[name].std_error)
            if exact is not None and name == "range_offset_m":
                blind.append((exact.estimates[name].value - truth) / exact.estimates[name].std_error)
    level = 1 - 1e-3 / 4
    for name in names:
        inside = int((np.abs(pulls[name]) < stats.norm.ppf(0.975)).sum())
        assert inside >= stats.binom.ppf(1 - level, n, 0.95)
        # nor are they wider than need be: noise of 20 frames beside 5 mm, and scatter between three boards
        assert np.mean(np.square(pulls[name])) > 0.4
    if len(distances) == 1:
        assert np.mean(np.square(blind)) > 100  # what a fit that takes the distance as exact states


def test_the_distances_standard_deviation_is_stated_assumed_or_none():
    boards = [take(PMD, d) for d in (1.0, 2.0)]
    fits = {
        std: fit_sensor(boards, (1.0, 2.0), base=PMD, albedo=[0.8], distance_std_m=std)
        for std in (None, 0.0, 0.001, (0.001, 0.004))
    }
    assert fits[None].as_dict()["distance_std_m"] == [0.001, 0.001]
    assert any("assumed to have a standard deviation of 1 mm" in note for note in fits[None].notes)
    assert any("taken to be exact" in note for note in fits[0.0].notes)
    assert any("stated to have a standard deviation of 1, 4 mm" in note for note in fits[0.001, 0.004].notes)
    assert fits[None].estimates["signal_e"].std_error == fits[0.001].estimates["signal_e"].std_error
    errors = [fits[std].estimates["range_offset_m"].std_error for std in (0.0, 0.001, (0.001, 0.004))]
    # ranges grow from the middle to the corners, 5 % on the mean, and so does what an error of the distance does
    longer = float(board_image(PMD, 1.0, 0.8).range_m.mean())
    assert errors[1] == pytest.approx(longer * 1e-3 / math.sqrt(2), rel=0.05)  # noise of 50 frames adds to it
    assert errors[0] < 0.2e-3 < errors[1]
    for wrong, message in ((-0.001, "got -0.001"), (5.0, "0.1 at 1 m, got 5"), ((0.001,) * 3, "one for each of the 2")):
        with pytest.raises(UsageError, match=message):
            fit_sensor(boards, (1.0, 2.0), base=PMD, distance_std_m=wrong)


def test_a_direct_sensor_has_an_offset_and_one_figure_of_noise():
    camera = preset("vl53l5cx-8x8").with_(range_offset_m=0.02, dead_pixels=((1, 2),))
    fit = fitted(camera, (1.0, 2.0), base=preset("vl53l5cx-8x8"), amplitude=False, intensity=False)
    assert meets(fit, "range_offset_m", 0.02)
    assert meets(fit, "range_std_m", 0.004)
    assert fit.sensor.dead_pixels == ((1, 2),)
    assert fit.sensor.kind == "direct"


@pytest.mark.parametrize(
    ("name", "stated", "board"),
    [("vl53l5cx-8x8", (0.5, 1.3, 1.5), "1.3 m"), ("pmd-16x16", (1.0, 1.5, 0.5), "0.5 m")],
)
def test_a_board_whose_distance_is_wrong_or_in_another_order_is_named(name, stated, board):
    camera = preset(name)
    boards = [take(camera, distance, amplitude=False, intensity=False) for distance in (0.5, 1.0, 1.5)]
    with pytest.raises(UsageError, match=rf"the board at {board} measures .* off what the others do: is its distance"):
        fit_sensor(boards, stated, base=camera, albedo=[0.8])


@pytest.mark.parametrize(("power", "told", "right"), [(1, "range", "z"), (-1, "z", "range")])
def test_z_and_range_that_are_exchanged_are_refused(power, told, right):
    boards = [take(PMD, distance, amplitude=False, intensity=False) for distance in NEAR]
    other = [Frames(one.range_m * PMD.axis_cosine() ** power, sensor=PMD) for one in boards]
    with pytest.raises(UsageError, match=f"by what z and range differ: taken for {told}, they must be {right}"):
        fit_sensor(other, NEAR, base=PMD, albedo=[0.8])


# What one distance tells, and what is odd


def test_one_distance_says_that_offset_and_wiggling_cannot_be_told_apart():
    fit = fitted(PMD, (1.0,), amplitude=False, intensity=False)
    assert any("cannot be distinguished from one distance" in note for note in fit.notes)
    assert any("one number of noise" in note for note in fit.notes)
    assert meets(fit, "signal_e", PMD.signal_e)  # the assumed K and no ambient light happen to be right
    assert meets(fit, "range_offset_m", 0.0)


def test_noisy_stuck_and_far_pixels_are_found():
    frames = take(PMD, 1.0)
    range_m, rng = frames.range_m.copy(), np.random.default_rng(0)
    range_m[..., 2, 3] += rng.normal(0, 0.15, 50)
    range_m[..., 4, 5] = 1.05
    range_m[..., 6, 7] += 0.5
    range_m[..., 8, 9] = np.nan
    fit = fit_sensor([Frames(range_m, sensor=PMD)], [1.0], base=PMD, albedo=[0.8])
    assert fit.sensor.hot_pixels == ((2, 3), (4, 5), (6, 7))
    assert fit.sensor.dead_pixels == ((8, 9),)
    assert meets(fit, "range_offset_m", 0.0)  # they are not in the other numbers
    assert meets(fit, "phase_offset_std_rad", 0.0)


def test_frames_behind_a_filter_in_time_are_noticed():
    rng = np.random.default_rng(2)
    white = rng.normal(0, 0.02, (201, 16, 16))
    board = board_image(PMD, 1.0, 0.8).range_m[0]
    smooth = fit_sensor([Frames(board + (white[1:] + white[:-1]) / 2, sensor=PMD)], [1.0], base=PMD, distance_std_m=0)
    assert smooth.frame_correlation == pytest.approx(0.5, abs=4 * smooth.frame_correlation_std_error)
    assert any("not independent" in note for note in smooth.notes)
    plain = fit_sensor([Frames(board + white, sensor=PMD)], [1.0], base=PMD, distance_std_m=0)
    assert abs(plain.frame_correlation) < 4 * plain.frame_correlation_std_error
    assert not any("not independent" in note for note in plain.notes)
    errors = [fit.estimates["range_offset_m"].std_error / fit.range_std_m.mean() for fit in (smooth, plain)]
    assert errors[0] / errors[1] == pytest.approx(math.sqrt(3), rel=0.05)  # (1 + r) / (1 − r) at r = ½


def test_a_range_beyond_the_wrap_has_an_error_about_zero():
    bright = PMD.with_(signal_e=5e6, range_offset_m=0.03)
    fit = fitted(bright, (14.95, 16.0), amplitude=False, intensity=False)
    assert fit.sensor.range_offset_m == pytest.approx(0.03, abs=0.005)


def test_a_distance_at_which_few_pixels_answer_is_left_out():
    frames = take(PMD, 2.0)
    flags = np.zeros(frames.range_m.shape, int)
    flags[..., :12, :] = Flag.NO_RETURN
    weak = Frames(frames.range_m, flags=flags, sensor=PMD)
    fit = fit_sensor([take(PMD, 1.0, amplitude=False, intensity=False), weak], [1.0, 2.0], base=PMD, albedo=[0.8])
    assert any("at 2 m were left out: 25 %" in note for note in fit.notes)
    assert fit.sensor.dead_pixels == ()


@pytest.mark.parametrize(
    ("frames", "distances", "albedo", "message"),
    [
        ([10], [1.0, 2.0], None, "each set of frames needs its distance: got 1 of frames and 2"),
        ([10], [0.0], None, "'distance' must be a positive number of metres, got 0"),
        ([10], [math.nan], None, "'distance' must be a positive number of metres, got nan"),
        ([10], [1000.0], None, "the board at 1000 m is farther than 20 m: distances are in metres"),
        ([10], [1.0], [1.5], r"'albedo' must be in \(0, 1\], got 1.5"),
        ([10], [1.0], [0.5, 0.6], "one albedo, or one for each of the 1 distances, got 2"),
        ([1], [1.0], None, f"too few frames at 1 m: 1, but at least {FEWEST_FRAMES} are needed"),
        ([FEWEST_FRAMES - 1], [1.0], None, f"but at least {FEWEST_FRAMES} are needed to know a pixel's noise to 25 %"),
    ],
)
def test_what_cannot_be_fitted_is_refused_in_one_line(frames, distances, albedo, message):
    boards = [Frames(np.full((n, 16, 16), 1.0), sensor=PMD) for n in frames]
    with pytest.raises(UsageError, match=message) as caught:
        fit_sensor(boards, distances, base=PMD, albedo=albedo)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("across", "up"), [(25.0, 0.0), (-1.0, 0.0), (0.0, 1.5), (3.0, -4.0), (0.0, 0.0)])
def test_a_tilted_board_is_named_with_its_angle(across, up):
    """Ranges of a plane whose normal is turned, by the closed form; beyond 3° it is no flat field."""
    rays = PMD.pixel_directions()
    normal = np.array([1.0, math.tan(math.radians(across)), math.tan(math.radians(up))])
    true = 1.0 / (rays @ normal)
    rng = np.random.default_rng(3)
    frames = Frames(true + 2e-3 * rng.standard_normal((50, 16, 16)), sensor=PMD)
    angle = math.degrees(math.acos(1 / np.linalg.norm(normal)))
    if angle > 3:
        with pytest.raises(UsageError, match="the board at 1 m is tilted by about") as caught:
            fit_sensor([frames], [1.0], base=PMD)
        said = float(str(caught.value).split("about ")[1].split("°")[0])
        assert said == pytest.approx(angle, rel=0.1)
        return
    notes = [note for note in fit_sensor([frames], [1.0], base=PMD).notes if "tilted" in note]
    assert bool(notes) == (angle > 0)
    if notes:
        assert float(notes[0].split("about ")[1].split("°")[0]) == pytest.approx(angle, abs=0.06)


@pytest.mark.parametrize(("value", "message"), [(math.nan, "no pixel is valid"), (1.0, "no noise")])
def test_frames_without_a_valid_pixel_and_one_frame_repeated_are_refused(value, message):
    with pytest.raises(UsageError, match=message):
        fit_sensor([Frames(np.full((20, 16, 16), value), sensor=PMD)], [1.0], base=PMD)


# The command and its file


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fit")
    for d in (1.0, 2.0):
        frames = take(PMD, d)
        np.savez(folder / f"{d:g}.npz", range=1e3 * frames.range_m, amplitude=frames.amplitude_e,
                 intensity=frames.intensity_e, unit="mm", quantity="range")  # fmt: skip
    np.savetxt(folder / "short.csv", np.ones((3, 256)), delimiter=",")
    np.savetxt(folder / "narrow.csv", np.ones((10, 12)), delimiter=",")
    np.savetxt(folder / "empty.csv", np.full((10, 256), np.nan), delimiter=",")
    return folder


def run(*arguments):
    return main(["sensor", "fit", *map(str, arguments)])


def test_the_command_writes_a_sensor_file_that_says_what_was_measured(folder, tmp_path, capsys):
    out = tmp_path / "mycam.toml"
    boards = (folder / "1.npz", folder / "2.npz", "--distance", 1.0, "--distance", 2.0, "--albedo", 0.8)
    assert run(*boards, "-o", out, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    text = out.read_text(encoding="utf-8")
    sensor = Sensor.from_toml(out)
    table = tomllib.loads(text)
    sources = table.pop("source")
    assert sensor == Sensor(**table) == Sensor(**answer["sensor"])
    assert sources["signal_e"].startswith("measured, ± ")
    assert sources["rows"] == "assumed: as in pmd-16x16"
    assert sensor.signal_e == pytest.approx(PMD.signal_e, rel=0.01)
    for line in text.split("[source]")[0].splitlines():  # every number says where it comes from
        assert line.startswith("#") or not line or "  # measured" in line or "  # assumed: " in line
    assert main(["sensor", "show", str(out)]) == 0
    assert f"# {sources['signal_e']}" in capsys.readouterr().out
    assert run(*boards, "-o", out) == 4  # it exists
    assert "exists already" in capsys.readouterr().err
    assert run(*boards, "-o", out, "--force") == 0
    printed = capsys.readouterr().out
    assert "signal_e" in printed
    assert printed.splitlines()[-1] == str(out)


def test_positions_of_one_file_take_their_distances_in_order(folder, tmp_path):
    both = np.concatenate([take(PMD, d).range_m for d in (1.0, 2.0)])
    np.savez(tmp_path / "both.npz", range=both, unit="m", quantity="range")
    assert run(tmp_path / "both.npz", "--distance", 1.0, "--distance", 2.0, "-o", tmp_path / "a.toml") == 0
    assert abs(Sensor.from_toml(tmp_path / "a.toml").range_offset_m) < 0.002  # 20 mm / √(50 · 256), 4 times and more


@pytest.mark.parametrize(
    ("arguments", "code", "part"),
    [
        (["short.csv", "--distance", "1"], 2, f"at least {FEWEST_FRAMES} are needed"),
        (["1.npz", "--distance", "-1"], 2, "must be a positive number of metres, got -1"),
        (["1.npz", "--distance", "near"], 2, "--distance"),
        (["1.npz", "--distance", "1", "--distance-std", "5"], 2, "'distance_std_m' must be a number of metres from"),
        (["1.npz"], 2, "--distance"),
        (["1.npz", "2.npz", "--distance", "1"], 2, "each set of frames needs its distance"),
        (["narrow.csv", "--distance", "1"], 3, "12 values, must have 256"),
        (["empty.csv", "--distance", "1"], 2, "no pixel is valid"),
        (["missing.npz", "--distance", "1"], 3, "cannot be read"),
        (["1.npz", "--distance", "1", "--sensor", "nothing"], 2, "unknown sensor 'nothing'"),
        (["1.npz", "--distance", "1", "--amplitude-unit", "volts"], 2, "'volts' is not one of 'electrons', 'arbitr"),
    ],
)
def test_the_command_says_in_one_line_what_is_wrong(folder, tmp_path, capsys, monkeypatch, arguments, code, part):
    monkeypatch.chdir(folder)
    stated = [] if "npz" in arguments[0] else ["--unit", "m", "--quantity", "range"]
    assert run(*arguments, *stated, "-o", tmp_path / "a.toml") == code
    error = capsys.readouterr().err
    assert part in error
    assert error.count("\n") == 1
    assert not (tmp_path / "a.toml").exists()
