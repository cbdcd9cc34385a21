"""The fields of a sensor: ranges, contradictions, presets."""

import json
import math
import re
import tomllib
from importlib import resources

import numpy as np
import pytest
from builders import pure_image
from oracles.noise_law import FALSE_ALARM
from scipy import stats

from phasemark import UsageError
from phasemark.cli import main
from phasemark.inputs.toml_file import toml_value
from phasemark.matcher import kalman_filter
from phasemark.matcher.filters.filtered_frames import assumed_std_m
from phasemark.matcher.pixel_agreement import counts
from phasemark.render import (
    Background,
    Flag,
    Renderer,
    Sensor,
    capture,
    measured_range_std,
    predicted_range_std,
    preset,
    preset_names,
)
from phasemark.render.exposure import ablate
from phasemark.render.sensor.sensor_file import read_sources, sensor_toml
from phasemark.render.sensor.shipped_sensors import preset_sources
from phasemark.render.sensor.sources import kind_of_source

PMD = preset("pmd-16x16")
DIRECT = preset("vl53l5cx-8x8")


HARMONICS, PULSE = {"modulation": "harmonics"}, {"modulation": "pulse", "emitted_pulse": (1,) * 8}
TILTS = {"calibration_fields": ("pitch_deg", "roll_deg")}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"prnu": 0.5}, "'prnu' must be less than or equal to 0.3, got 0.5"),
        ({"adc_bits": 0}, "'adc_bits' must be greater than or equal to 1, got 0"),
        ({"full_well_e": -1}, "'full_well_e' must be greater than 0, got -1"),
        ({"unit_seed": -1}, "'unit_seed' must be greater than or equal to 0, got -1"),
        ({"range_offset_m": math.nan}, "'range_offset_m' must be a finite number, got nan"),
        ({"modulation": "triangle"}, "'modulation' must be 'sine', 'square', 'harmonics' or 'pulse', got 'triangle'"),
        ({"blur_share": 1.0}, "'blur_share' must be less than 1, got 1.0"),
        ({"black_levle": 3}, "unknown key 'black_levle'"),
        ({"modulation": "square", "contrast": 0.82}, "'contrast' must be at most 0.8106 with 'modulation' = 'square'"),
        ({**HARMONICS, "harmonics": ((3, 1.0, 0.0),), "contrast": 0.51}, "'contrast' must be at most 0.5 with"),
        ({"harmonics": ((3, 0.1, 0.0),)}, "'harmonics' must be left out unless 'modulation' = 'harmonics'"),
        (HARMONICS, "'harmonics' must be given for 'modulation' = 'harmonics'"),
        ({**HARMONICS, "harmonics": ((3, 0.1, 0), (3, 0.1, 0))}, "must name each order once"),
        ({**PULSE, "reference_pulse": (1,) * 9}, "the same number of samples, at least 8, got 8 and 9"),
        ({**PULSE, "reference_pulse": (1, 0) * 4}, "must have a first harmonic in both"),
        ({"full_well_e": 3e4, "min_amplitude_e": 2e4}, "'min_amplitude_e' must be below 20000, .* saturates at 30000"),
        ({"full_well_e": 100.0}, "'max_phase_std_rad' must be above 0.1225, .* not saturate at 100 e-"),
        ({"full_well_e": 10_000, "ambient_e": 20_000}, "'full_well_e' leaves no room for light: .* 10000 e-"),
        ({"adc_bits": 8, "gain": 0.1, "ambient_e": 20_000}, "'gain' leaves no room for light"),
        ({"gain": 0.2}, "'gain' must be left out without a converter \\('adc_bits'\\), got 0.2"),
        ({"black_level": 9.0}, "'black_level' must be left out without a converter"),
        ({"adc_bits": 8, "black_level": 255.0}, "must be below the converter's highest code, 255, got 255"),
        ({"dark_e": 12, "dsnu_e": 2.1}, "'dsnu_e' must be at most dark_e / 6 = 2: .*, got 2.1"),
        ({"phase_interval_s": 0.1}, "must be at most 1 / \\(4 · frame_rate_hz\\) = 0.0833333, got 0.1"),
        ({"blur_share": 0.6, "veil_share": 0.4}, "'blur_share' \\+ 'veil_share' must be below 1, got 0.6 \\+ 0.4"),
        ({"dead_share": 0.6, "hot_share": 0.4}, "'dead_share' \\+ 'hot_share' must be below 1"),
        ({"dead_pixels": ((16, 0),)}, "'dead_pixels' must lie in the image of 16 × 16 pixels, got \\(16, 0\\)"),
        ({"dead_pixels": ((1, 2),), "hot_pixels": ((1, 2),)}, "must not share a pixel, got \\(1, 2\\) in both"),
        ({"wrap_guard_m": 7.5}, "'wrap_guard_m' must be below c / 4f = 7.495, got 7.5"),
        ({"whole_image_px": (15, 16)}, "'whole_image_px' must hold this image of 16 columns and 16 rows"),
        ({"whole_image_px": (64, 48), "principal_point_px": (105, 3)}, "one and a half of the whole image's width"),
        ({"principal_point_px": (90, 3)}, "'principal_point_px' must lie within .*, got \\(90.0, 3.0\\)"),
        ({"max_range_m": 4.0}, "'max_range_m' must be left out for 'kind' = 'phase', got 4.0"),
        ({"zone_offset_m": ((0.0,) * 16,) * 16}, "'zone_offset_m' must be left out .* belongs to 'kind' = 'direct'"),
        ({"range_shot_std_m": 0.1}, "'range_shot_std_m' must be left out .* belongs to 'kind' = 'direct'"),
        ({"range_ambient_std_m": 0.1}, "'range_ambient_std_m' must be left out .* belongs to 'kind' = 'direct'"),
    ],
)
def test_a_field_that_cannot_be_is_refused_in_one_line(changes, message):
    with pytest.raises(UsageError, match=message) as caught:
        PMD.with_(**changes)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"modulation": "square"}, "'modulation' must be left out .*: a direct sensor has no taps, harmonics"),
        ({"prnu": 0.01}, "'prnu' must be left out .*: a direct sensor has no taps, harmonics"),
        ({"veil_share": 0.1}, "'veil_share' must be left out .*: a direct sensor has no taps, harmonics"),
        ({"contrast": 0.4}, "'contrast' must be left out .*: a direct sensor has no taps, harmonics"),
        ({"modulation_hz": 1e7}, "'modulation_hz' must be at most 10000 for 'kind' = 'direct'"),
        ({"zone_offset_m": ((0.0,) * 8,) * 7}, "'zone_offset_m' must have 8 rows of 8 numbers"),
        ({"calibration_fields": ("pitch",)}, "must name fields of the sensor that are numbers, got 'pitch'"),
        ({"calibration_fields": ("rows",)}, "must name fields of the sensor that are numbers, got 'rows'"),
        ({"calibration_fields": ("pitch_deg",)}, "'calibration_covariance' must have 1 rows of 1 numbers"),
        ({**TILTS, "calibration_covariance": ((1.0, 2.0), (2.0, 1.0))}, "must be positive semidefinite"),
        ({**TILTS, "calibration_covariance": ((1.0, 0.5), (0.2, 1.0))}, "must be symmetric"),
        ({"calibration_fields": ("pitch_deg",), "calibration_covariance": ((-1.0,),)}, "no negative variance"),
        ({"systematic_distance_m": -0.1}, "'systematic_distance_m'"),
        ({"delay_s": 75.0}, "'delay_s'"),
    ],
)
def test_a_field_that_no_direct_sensor_can_have_is_refused(changes, message):
    with pytest.raises(UsageError, match=message):
        DIRECT.with_(**changes)


def test_every_term_is_neutral_by_default():
    bare = type(PMD)(rows=16, cols=16, half_angle_h_deg=11, half_angle_v_deg=11, shot_noise=False)
    assert bare == preset("ideal")


@pytest.mark.parametrize(
    ("of_rows", "table", "sources"),
    [
        ("", "", {}),
        ("", '[source]\nrows = "published: data sheet"\n', {"rows": "published: data sheet"}),
        ("  # published", "", {"rows": "published"}),  # without the table comments may state sources
    ],
)
def test_sources_are_read_and_change_nothing_of_the_sensor(tmp_path, of_rows, table, sources):
    path = tmp_path / "camera.toml"
    path.write_text(
        f"rows = 4{of_rows}\ncols = 4  # four of them\nhalf_angle_h_deg = 11\nhalf_angle_v_deg = 11\n{table}"
    )
    assert Sensor.from_toml(path) == Sensor(rows=4, cols=4, half_angle_h_deg=11, half_angle_v_deg=11)
    assert read_sources(path) == sources


@pytest.mark.parametrize("name", [name for name in preset_names() if name != "ideal"])
def test_every_number_of_a_preset_says_where_it_comes_from(name):
    text = resources.files("phasemark.render.sensor").joinpath("presets", f"{name}.toml").read_text(encoding="utf-8")
    fields = tomllib.loads(text)
    sources = fields.pop("source")
    assert sources == preset_sources(name)
    of_table = {f"histogram.{key}" for key in fields.pop("histogram", {})}
    assert set(sources) == set(fields) | of_table
    assert all(kind_of_source(source) for source in sources.values())


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ('colour = "assumed"', "'source.colour' is of no field"),
        ('"rows.bins" = "assumed"', "'source.rows.bins' is of no field"),
        ('rows = "guessed"', "'source.rows' must be a text that begins with measured, published, assumed, got"),
        ("rows = 3", "'source.rows' must be a text"),
    ],
)
def test_a_source_that_says_nothing_is_refused(tmp_path, source, words):
    path = tmp_path / "camera.toml"
    path.write_text(f"rows = 4\ncols = 4\nhalf_angle_h_deg = 11\nhalf_angle_v_deg = 11\n[source]\n{source}\n")
    for read in (Sensor.from_toml, read_sources):
        with pytest.raises(UsageError, match=re.escape(f"{path}: {words}")):
            read(path)


@pytest.mark.parametrize("name", preset_names())
def test_what_is_shown_of_a_sensor_is_its_file_again_with_its_sources(name, tmp_path, capsys):
    assert main(["sensor", "show", name]) == 0
    path = tmp_path / "again.toml"
    path.write_text(capsys.readouterr().out, encoding="utf-8")
    assert Sensor.from_toml(path) == preset(name)
    assert read_sources(path) == preset_sources(name)


def test_what_is_shown_counts_sources_and_leaves_out_the_other_kind(capsys):
    assert main(["sensor", "show", "pmd-16x16"]) == 0
    text = capsys.readouterr().out
    assert "# 0 measured, 6 published, 7 assumed" in text
    assert "frame_rate_hz = 3.0  # published\n" in text
    assert "# read-out, at their defaults: full_well_e not set" in text
    assert "zone_offset_m" not in text
    assert main(["sensor", "show", "ideal"]) == 0
    assert "where its numbers come from is not stated" in capsys.readouterr().out
    assert main(["sensor", "show", "pmd-16x16", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sources"]["rows"] == "published"


def test_a_written_sensor_file_keeps_its_sources(tmp_path):
    path = tmp_path / "camera.toml"
    comments = {"signal_e": "measured, ± 3 (standard error): four boards", "contrast": "calibrated"}
    path.write_text(sensor_toml(PMD, comments, header=[], otherwise="assumed: as in pmd-16x16"))
    sources = read_sources(path)
    assert sources["signal_e"] == comments["signal_e"]
    assert sources["contrast"] == "measured: calibrated"
    assert sources["rows"] == "assumed: as in pmd-16x16"
    assert Sensor.from_toml(path) == PMD


def test_the_noise_law_counts_quantisation_once():
    sensor = PMD.with_(adc_bits=12, gain=0.05, black_level=10.0)
    bare = predicted_range_std(0.5, 0.5, PMD) ** 2
    ratio = predicted_range_std(0.5, 0.5, sensor) ** 2 / bare
    assert ratio == pytest.approx(1 + 20**2 / 6 / (35_571 * 0.5), rel=1e-12)
    both = measured_range_std(0.25 * 35_571, 0.5 * 35_571, sensor)
    assert both == pytest.approx(predicted_range_std(0.5, 0.5, sensor), rel=1e-12)


# Direct time of flight


def test_a_direct_sensor_reports_z_and_a_wall_has_one():
    exact = DIRECT.with_(range_std_m=0.0)
    image = Renderer(None, exact).render(1.0, background=Background(wall_m=2.0))
    frames = capture(image, exact, rng=np.random.default_rng(0))
    assert exact.quantity == "z"
    # the footprint's mean range over the range of its centre: half the variance of its angles, 4e-4 of 2 m at most
    np.testing.assert_allclose(frames.z_m, 2.0, rtol=0, atol=2e-3)
    assert np.ptp(frames.range_m) > 0.2
    assert frames.amplitude_e is None
    assert frames.taps_e is None


def test_a_direct_sensor_does_not_mix_phasors():
    phase = np.array([3.0, 6.0]) / DIRECT.metres_per_radian
    weight = np.array([0.5 / 9, 0.5 / 36])
    image = pure_image(1.0, DIRECT)
    image.phasor[:] = (weight * np.exp(1j * phase)).sum()
    image.intensity[:] = weight.sum()
    exact = DIRECT.with_(range_std_m=0.0, max_range_m=None)
    frames = capture(image, exact, rng=np.random.default_rng(0))
    mean = (weight * [3.0, 6.0]).sum() / weight.sum()
    np.testing.assert_allclose(frames.range_m, mean, rtol=1e-7)  # φ² / 6 of it, and rounding of small angles


def test_a_direct_sensor_drops_out_beyond_its_range_and_below_its_light():
    sensor = DIRECT.with_(min_intensity=0.1, dead_pixels=((0, 0),))
    image = pure_image([3.9, 4.1, 3.9], sensor, 0.2)
    image.intensity[2] = 0.05
    frames = capture(image, sensor, rng=np.random.default_rng(0), n_frames=2)
    assert (frames.flags[:, :, 0, 0] == Flag.DEAD | Flag.MISSING).all()
    assert [set(frames.flags[i, :, 1:].ravel().tolist()) for i in range(3)] == [{0}, {1}, {1}]


def test_the_noise_of_a_direct_sensor_grows_with_range_as_its_three_terms_say():
    """With I = 0.8 / r² the terms are constant, proportional to r² / 0.8 and to r⁴ / 0.64 in the variance."""
    sensor = DIRECT.with_(range_std_m=0.003, range_shot_std_m=0.002, range_ambient_std_m=0.004)
    r = np.array([0.5, 1.0, 2.0])
    variance = 0.003**2 + 0.002**2 * r**2 / 0.8 + 0.004**2 * r**4 / 0.64
    intensity = 0.8 / r**2
    np.testing.assert_allclose(predicted_range_std(intensity, intensity, sensor), np.sqrt(variance), rtol=1e-12)
    np.testing.assert_allclose(assumed_std_m(r, sensor), np.sqrt(variance), rtol=1e-12)
    n = 2000
    image = pure_image(r, sensor, 1.0)
    image.intensity[:] = intensity[:, None, None]
    frames = capture(image, sensor, rng=np.random.default_rng(0), n_frames=n)
    z = stats.norm.ppf(1 - FALSE_ALARM / 6)
    spread = frames.range_m.std(axis=(1, 2, 3))
    np.testing.assert_allclose(spread, np.sqrt(variance), rtol=z / math.sqrt(2 * 64 * n))


def test_what_returns_no_light_is_not_measured():
    for sensor in (PMD, DIRECT):
        assert np.isinf(predicted_range_std(0.0, 0.0, sensor))
    assert not counts(np.zeros((1, 2, 2), complex), np.zeros((1, 2, 2)), DIRECT).any()


def test_the_noise_of_a_direct_sensor_draws_the_same_random_numbers_whatever_its_terms():
    image = pure_image(1.0, DIRECT, 1.0)
    one, other = (
        capture(image, sensor, rng=np.random.default_rng(5), n_frames=3).range_m - image.range_m
        for sensor in (DIRECT, DIRECT.with_(range_std_m=0.0, range_ambient_std_m=0.02))
    )
    np.testing.assert_allclose(other / 0.02, one / 0.004, rtol=1e-9)


def test_offsets_of_zones_are_added_by_the_sensor_and_taken_off_measured_frames():
    table = np.random.default_rng(4).normal(0, 0.01, (8, 8))
    sensor = DIRECT.with_(range_std_m=0.0, range_offset_m=0.02, zone_offset_m=tuple(map(tuple, table.tolist())))
    frames = capture(pure_image(1.0, sensor, 0.5), sensor, rng=np.random.default_rng(0), n_frames=2)
    np.testing.assert_allclose(frames.range_m[0, 1], 1.02 + table, rtol=0, atol=1e-12)
    plain = kalman_filter(frames).without_offset()
    np.testing.assert_allclose(plain.range_m[0], 1.0, rtol=0, atol=1e-12)
    assert (plain.sensor.range_offset_m, plain.sensor.zone_offset_m) == (0.0, ())


def test_what_a_calibration_leaves_is_written_and_read_and_changes_no_image(tmp_path):
    mounted = DIRECT.with_(
        delay_s=-0.075, calibration_fields=("pitch_deg", "delay_s"),
        calibration_covariance=((0.04, 1e-4), (1e-4, 4e-6)), systematic_distance_m=0.003, systematic_delta_deg=0.6,
        systematic_bearing_deg=0.5, systematic_height_m=0.01, zone_offset_m=((0.001,) * 8,) * 8,
    )  # fmt: skip
    path = tmp_path / "mounted.toml"
    path.write_text(sensor_toml(mounted, {}, header=[], otherwise="assumed"))
    assert Sensor.from_toml(path) == mounted
    assert mounted.optics_difference(DIRECT) is None
    np.testing.assert_allclose(mounted.calibration_matrix, [[0.04, 1e-4], [1e-4, 4e-6]])
    assert PMD.with_(delay_s=-0.1, systematic_distance_m=0.001).kind == "phase"


def test_a_direct_sensor_has_no_taps_to_keep():
    image = pure_image(2.0, DIRECT, 0.5)
    with pytest.raises(UsageError, match="'keep_taps' must be left out for a direct sensor"):
        capture(image, DIRECT, rng=np.random.default_rng(0), keep_taps=True)
    with pytest.raises(UsageError, match="motion during phase images must be left out"):
        capture([image] * 4, DIRECT, rng=np.random.default_rng(0))


# Ablation


def test_the_variants_of_a_frame_add_one_error_after_another():
    sensor = preset("pmd-16x16-wiggle")
    hard, exact = pure_image(1.0, sensor, 0.8), pure_image(1.1, sensor, 0.8)
    variants = ablate(hard, exact, sensor, rng=np.random.default_rng(3), n_frames=50)
    np.testing.assert_allclose(variants.hard.range_m, 1.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(variants.exact.range_m, 1.1, rtol=0, atol=1e-12)
    z = stats.norm.ppf(1 - FALSE_ALARM / 2)
    law = predicted_range_std(0.8, 0.8, PMD)
    assert np.std(variants.shot.range_m) == pytest.approx(law, rel=z / math.sqrt(2 * 256 * 50))
    # fixed patterns stay when noise is averaged: 0.02 rad are 5 cm
    seen = variants.full.valid.all(axis=1)
    assert np.std(variants.full.range_m.mean(axis=1)[seen]) > 0.03


def test_a_sensor_file_holds_any_character():
    # beyond the basic plane of Unicode, where JSON has surrogates that TOML refuses, and what must be escaped
    odd = '😀 é \x7f " \\'
    assert tomllib.loads("a = " + toml_value(odd))["a"] == odd
