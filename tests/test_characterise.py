"""The data sheet of a sensor against closed forms, and the files it is written to."""

import csv
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from builders import measure_only, one_pixel, pure_image, wrapped
from oracles.noise_law import FALSE_ALARM, exact_over_law, noise_law_m
from scipy import stats

from phasemark import UsageError
from phasemark.cli import main
from phasemark.render import Sensor, camera_unit, capture, characterise, preset
from phasemark.render.bench.figures import characterisation_figures
from phasemark.render.bench.flat_field import board_image, expected_flat_field, flat_field
from phasemark.render.bench.least_squares import weighted_fit
from phasemark.render.sensor.range_noise import exact_phase_moments, phase_density

N = 30  # frames a point, 7 680 readings of a 16 × 16 camera


@pytest.fixture(scope="module")
def good_day():
    return characterise(preset("pmd-16x16"), rng=np.random.default_rng(11), n_frames=N)


@pytest.fixture(scope="module")
def bad_day():
    return characterise(preset("pmd-16x16-wiggle"), rng=np.random.default_rng(12), n_frames=N)


def test_a_data_sheet_is_described_in_one_line(good_day):
    n, off = len(good_day.comparisons), len(good_day.disagreements)
    assert repr(good_day) == f"Characterisation({good_day.sensor!r}: {n - off} of {n} series as predicted)"


# The prediction, by other arithmetic than the chain's


def test_expected_ranges_are_those_of_the_noise_free_chain():
    # sampled in time here, summed over phasors there; patterns, stray light, offsets and squares to order 7 on
    sensor = preset("pmd-16x16-wiggle").with_(shot_noise=False, read_noise_e=0, adc_bits=None, gain=1, black_level=0,
                                              max_phase_std_rad=None, hot_share=0.0, dead_share=0.0)  # fmt: skip
    for range_m in (0.3, 1.0, 7.7, 14.9, 16.0):
        frames = capture(flat_field(sensor, range_m, 0.5), sensor, rng=np.random.default_rng(0), keep_taps=True)
        expected = expected_flat_field(sensor, range_m, 0.5)
        np.testing.assert_allclose(frames.taps_e[0, 0], expected.tap_e, rtol=1e-11)  # rounding
        np.testing.assert_allclose(wrapped(frames.range_m[0, 0] - expected.range_m, sensor), 0, atol=1e-10)


def test_expected_noise_is_the_law_and_beyond_it_the_exact_density():
    sensor = one_pixel(ambient_e=500, read_noise_e=20, adc_bits=12, gain=0.1, black_level=100)
    for amplitude, std in ((0.5, 0.008), (0.02, 0.05)):
        expected = expected_flat_field(sensor, 2.0, amplitude)
        law = noise_law_m(sensor, amplitude, amplitude) / sensor.metres_per_radian
        assert expected.law_phase_std_rad.item() == pytest.approx(law, rel=1e-12)
        exact = law * exact_over_law(law) * sensor.metres_per_radian
        assert math.sqrt(expected.range_variance_m2.item()) == pytest.approx(exact, rel=1e-5)  # table of 2 % steps
        assert law > std


def test_the_exact_density_is_one_in_all_and_its_moments_are_its_own():
    psi = np.linspace(-math.pi, math.pi, 20_001)
    for std in (0.05, 0.3, 2.0):
        density = phase_density(psi, 1 / (2 * std**2))
        assert np.trapezoid(density, psi) == pytest.approx(1, rel=1e-9)
        variance, kurtosis = exact_phase_moments(std)
        second = np.trapezoid(psi**2 * density, psi)
        assert variance == pytest.approx(second, rel=1e-4)  # interpolated
        assert kurtosis == pytest.approx(np.trapezoid(psi**4 * density, psi) / second**2, rel=1e-3)
    assert exact_phase_moments(1e-4)[1] == pytest.approx(3, abs=1e-3)  # Gaussian
    assert exact_phase_moments(1e3)[0] == pytest.approx(math.pi**2 / 3, rel=0.02)  # every phase alike


@pytest.mark.parametrize(
    "fields",
    [
        {"full_well_e": 20_000},
        {"adc_bits": 12, "gain": 0.2, "black_level": 50.0, "read_noise_e": 30.0},
        {"full_well_e": 20_000, "adc_bits": 12, "gain": 0.2, "black_level": 50.0, "read_noise_e": 30.0},
        {"full_well_e": 120, "signal_e": 200},
    ],
)
def test_a_pixel_saturates_as_often_as_predicted(fields):
    # N = 50 000 at three signals about the middle, 99.9 % interval of all
    sensor, n = one_pixel(**fields), 50_000
    amplitudes = np.linspace(0.5, 1.4, 400) * sensor.saturation_e / (0.73 * sensor.signal_e)
    shares = np.array([expected_flat_field(sensor, 1.0, a).saturation_probability.item() for a in amplitudes])
    z = stats.norm.ppf(1 - FALSE_ALARM / 6)
    for share in (0.1, 0.5, 0.9):
        amplitude = amplitudes[np.searchsorted(shares, share)]
        p = expected_flat_field(sensor, 1.0, amplitude).saturation_probability.item()
        frames = capture(pure_image(1.0, sensor, amplitude), sensor, rng=np.random.default_rng(3), n_frames=n)
        assert (frames.flags > 0).mean() == pytest.approx(p, abs=z * math.sqrt(p * (1 - p) / n))


@pytest.mark.parametrize(
    "fields", [{"full_well_e": 20_000, "read_noise_e": 30.0}, {"full_well_e": 120, "signal_e": 200}]
)
def test_a_large_image_looks_its_saturation_up_and_finds_the_same(fields):
    sensor = Sensor(rows=30, cols=30, half_angle_h_deg=5, half_angle_v_deg=5, prnu=0.02, **fields)
    expected = expected_flat_field(sensor, 1.0, 1.4 * sensor.saturation_e / sensor.signal_e)
    looked_up, exact = expected._clear_probability(), expected._clear_probability_of(expected.tap_e)
    assert ((exact > 0.1) & (exact < 0.9)).any()
    np.testing.assert_allclose(looked_up, exact, rtol=0, atol=1e-4)  # linear between nodes


def test_a_converter_coarser_than_all_noise_still_gets_its_figures():
    sensor = one_pixel(shot_noise=False, adc_bits=8, gain=0.001)
    found = characterise(sensor, rng=np.random.default_rng(0), n_frames=2)
    assert found.degrees_of_freedom == 0
    assert "photon_transfer" in characterisation_figures(found)


def test_a_board_has_cosine_law_light_and_slanted_ranges():
    sensor = preset("pmd-16x16")
    image = board_image(sensor.with_(pitch_deg=10), 2.0, 0.5)  # the board is square to the camera's own axis
    cosine = sensor.axis_cosine()
    np.testing.assert_allclose(image.range_m[0], 2.0 / cosine, rtol=2e-4)  # a pixel's mean, not its centre's
    np.testing.assert_allclose(image.intensity[0], 0.5 * cosine**3 / 4, rtol=2e-4)


# What is found


@pytest.mark.parametrize("which", ["good_day", "bad_day"])
def test_simulated_points_lie_on_the_predicted_curves(which, request):
    found = request.getfixturevalue(which)
    print(f"{which}: χ² = {found.chi2:.0f} over {found.degrees_of_freedom} points, p = {found.p_value:.2g}")
    assert not found.disagreements  # 99.9 %, corrected for the number of series
    assert found.p_value > FALSE_ALARM
    assert found.degrees_of_freedom > 330
    figures = {one.figure for one in found.comparisons}
    assert figures >= {"photon_transfer", "range_noise", "linearity", "fixed_pattern", "threshold"}


def test_numbers_of_the_data_sheet_meet_the_sensor_s_own(bad_day):
    sensor, unit = bad_day.sensor, camera_unit(bad_day.sensor)
    alive = ~(unit.dead | unit.hot)
    # the closed form of each, from the sensor's fields
    truth = {
        "photon_transfer_slope_code": sensor.gain,
        "dark_noise_e": math.sqrt(sensor.read_noise_e**2 + 1 / (12 * sensor.gain**2)),
        "dsnu_e": unit.dark_e[:, alive].std(ddof=1),
    }
    z = stats.norm.ppf(1 - FALSE_ALARM / (2 * len(bad_day.quantities)))
    for name, value in truth.items():
        assert bad_day.quantity(name).predicted == pytest.approx(value, rel=1e-9)
    for one in bad_day.quantities:
        print(f"{one.name}: predicted {one.predicted:.6g}, simulated {one.simulated:.6g} ± {one.std_error:.2g}")
        # the threshold's half-way point is predicted to 1e-3, see _return_probability
        slack = 1e-3 * one.predicted if one.name.startswith("threshold") else 0.0
        assert one.simulated == pytest.approx(one.predicted, abs=z * one.std_error + slack)
    slope = bad_day.quantity("photon_transfer_slope_code")
    assert slope.simulated == pytest.approx(sensor.gain, rel=0.01)


def test_the_linearity_curve_has_the_wiggling_of_its_harmonics(monkeypatch):
    measure_only(monkeypatch, "phase", "_linearity")
    # square to order 7: 0.0772 rad largest; the sampled points reach most of the 0.368 m from peak to peak
    sensor = preset("pmd-16x16").with_(modulation="square", max_harmonic=7)
    found = characterise(sensor, rng=np.random.default_rng(1), n_frames=8)
    (line,) = found.of_figure("linearity")
    assert np.abs(line.curve_y).max() == pytest.approx(0.0772 * sensor.metres_per_radian, rel=0.002)
    assert line.x.max() > 1.4 * sensor.unambiguous_range_m  # beyond the wrap
    assert not found.disagreements


@pytest.mark.parametrize(
    ("lie", "measure", "figure"),
    [
        ({"signal_e": 1.03 * preset("pmd-16x16-wiggle").signal_e}, "_range_noise", "range_noise"),
        ({"modulation": "sine"}, "_linearity", "linearity"),
        ({"unit_seed": 2}, "_patterns", "fixed_pattern"),  # another camera of the same make
    ],
)
def test_a_wrong_prediction_is_noticed(monkeypatch, lie, measure, figure):
    told = preset("pmd-16x16-wiggle")

    def take(image, sensor, **options):
        changed = {"ambient_e": sensor.ambient_e, "max_phase_std_rad": sensor.max_phase_std_rad}
        lying = told.with_(**lie, **changed, min_amplitude_e=sensor.min_amplitude_e)
        return capture(replace(image, sensor=lying), lying, **options)

    measure_only(monkeypatch, "phase", measure)
    monkeypatch.setattr("phasemark.render.bench.data_sheet.bench.capture", take)
    found = characterise(told, rng=np.random.default_rng(5), n_frames=10)
    assert figure in {one.figure for one in found.disagreements}


def test_a_camera_without_noise_has_a_data_sheet_without_chi2():
    found = characterise(preset("ideal"), rng=np.random.default_rng(0), n_frames=2)
    assert found.degrees_of_freedom == 0
    (line,) = found.of_figure("linearity")
    np.testing.assert_allclose(line.simulated, 0, atol=1e-12)
    assert any("no signal saturates" in note for note in found.notes)


def test_a_direct_sensor_says_what_it_does_not_have():
    sensor = preset("vl53l5cx-8x8").with_(range_offset_m=0.01, histogram=None)
    found = characterise(sensor, rng=np.random.default_rng(3), n_frames=200)
    assert {one.figure for one in found.comparisons} == {"range_noise", "linearity", "threshold"}
    assert any("direct time-of-flight" in note for note in found.notes)
    assert found.quantity("threshold_distance_albedo_0.8_m").simulated == pytest.approx(4.0, rel=0.002)
    assert not found.disagreements


def test_a_line_is_fitted_as_weighted_least_squares_does():
    x, y, e = np.array([0.0, 1, 2, 5]), np.array([1.0, 3.1, 4.9, 11.2]), np.array([0.1, 0.2, 0.1, 0.4])
    line, covariance = np.polyfit(x, y, 1, w=1 / e, cov="unscaled")
    found, found_covariance = weighted_fit(np.column_stack([x, np.ones(4)]), y, e)
    assert found == pytest.approx(line, rel=1e-9)
    assert np.ravel(found_covariance) == pytest.approx(np.ravel(covariance), rel=1e-9)


def test_too_few_frames_and_dead_cameras_are_refused():
    with pytest.raises(UsageError, match="'n_frames' must be at least 2"):
        characterise(preset("pmd-16x16"), rng=np.random.default_rng(0), n_frames=1)
    dead = one_pixel(dead_pixels=((0, 0),))
    with pytest.raises(UsageError, match="every pixel is dead or hot"):
        characterise(dead, rng=np.random.default_rng(0), n_frames=2)


# The files


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sheet") / "made"
    assert main(["sensor", "characterise", "pmd-16x16-wiggle", "-o", str(folder), "--frames", "8", "--seed", "4"]) == 0
    return folder


def test_the_report_is_one_small_page_that_loads_nothing(folder):
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert len(page.encode()) < 3_000_000
    assert not re.search(r"""src=["'](?!data:)|https?://|@import|url\(""", page)
    assert len(re.findall('src="data:image/png;base64', page)) == 6
    for link in re.findall(r'href="([^"]*)"', page):
        assert f'id="{link[1:]}"' in page if link.startswith("#") else (folder / link).is_file()
    opening = " ".join(re.search(r'</h1>\s*<p class="answer">(.*?)</p>\s*<p>(.*?)</p>', page, re.DOTALL).groups())
    assert opening.count(". ") + opening.rstrip().endswith(".") >= 3
    assert "agrees with the prediction: χ² = " in opening
    names = {"photon_transfer", "range_noise", "linearity", "fixed_pattern", "saturation", "threshold"}
    assert {path.stem for path in folder.glob("*.png")} == names  # every figure is a picture too
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in folder.glob("*.png"))


def test_json_and_csv_hold_the_numbers_and_the_sensor(folder):
    facts = json.loads((folder / "characterisation.json").read_text(encoding="utf-8"))
    assert Sensor(**facts["sensor"]) == preset("pmd-16x16-wiggle")
    assert facts["seed"] == 4
    from phasemark.data.seeds import stream

    again = characterise(Sensor(**facts["sensor"]), rng=stream(4, "characterise", 0), n_frames=8).as_dict()
    assert {key: facts[key] for key in again} == again  # every float, bit for bit
    with (folder / "points.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    points = [point for one in facts["comparisons"] for point in one["points"]]
    assert [float(row["simulated"]) for row in rows] == [point["simulated"] for point in points]
    assert all(float(row["low95"]) <= float(row["simulated"]) <= float(row["high95"]) for row in rows)


def test_the_command_refuses_what_it_cannot_do(folder, tmp_path, capsys):
    for arguments, code, part in (
        (["nothing", "-o", tmp_path / "a"], 2, "unknown sensor 'nothing'"),
        ([tmp_path / "missing.toml", "-o", tmp_path / "a"], 3, "cannot be read"),
        (["pmd-16x16", "-o", folder], 4, "exists already"),
        (["pmd-16x16", "-o", tmp_path / "a", "--frames", 1], 2, "--frames"),
    ):
        assert main(["sensor", "characterise", *map(str, arguments)]) == code
        error = capsys.readouterr().err
        assert part in error.replace("\n", " ")
        assert error.count("\n") == 1
    assert not (tmp_path / "a").exists()
