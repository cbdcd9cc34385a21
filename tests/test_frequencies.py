"""Cameras of several modulation frequencies: what they are, what they see, and one range from many (section 10)."""

import json
import math

import numpy as np
import pytest
from builders import wrapped
from oracles.images import integrate_pixels, plane_light
from oracles.integer_search import best_counts
from scipy import stats

from phasemark import UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import (
    Background,
    Renderer,
    Sensor,
    preset,
    unwrap_ranges,
    unwrapping_error_probability,
)

PMD = preset("pmd-16x16")
TWO = PMD.with_(modulation_hz=[20e6, 60e6])
FOUR = PMD.with_(modulation_hz=[10e6, 20e6, 60e6, 100e6])
C = 299_792_458.0
CYLINDER = build_mesh(catalog()["cylinder"])


# The camera


def test_a_list_of_one_frequency_is_that_number_and_keeps_its_bytes():
    listed, single = PMD.with_(modulation_hz=[20e6]), PMD.with_(modulation_hz=20e6)
    assert listed == single
    assert listed.model_dump_json() == single.model_dump_json()
    assert type(listed.modulation_hz) is float
    assert single.by_frequency == (single,)


def test_several_frequencies_are_kept_in_their_order_and_read_back():
    sensor = PMD.with_(modulation_hz=[60e6, 20e6])
    assert sensor.frequencies_hz == (60e6, 20e6)
    assert Sensor(**json.loads(sensor.model_dump_json())) == sensor
    assert sensor != TWO
    assert [camera.modulation_hz for camera in sensor.by_frequency] == [60e6, 20e6]


def test_ranges_of_several_frequencies_repeat_at_the_common_divisor_and_radians_count_at_the_first():
    assert pytest.approx(C / 40e6, rel=1e-15) == TWO.unambiguous_range_m
    assert PMD.with_(modulation_hz=[80.32e6, 60.24e6]).unambiguous_range_m == pytest.approx(C / 2 / 20.08e6, rel=1e-15)
    assert pytest.approx(C / (4 * math.pi * 20e6), rel=1e-15) == TWO.metres_per_radian
    assert TWO.n_phase_images == 8
    assert pytest.approx(1 / 24) == TWO.phase_image_interval_s


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([], "at least 1 item"),
        ([20e6, 20e6], "must name each frequency once, got 20000000 and 20000000"),
        ([20e6, -1], "'modulation_hz.1' must be greater than 0, got -1"),
        ([20e6, 60e6 + 0.5], "must be whole hertz where there are several, got 60000000.5"),
        ([20e6, 60e6 + 1], "greatest common divisor is 1 Hz: 20000000 and 60000000 would do"),
        ([10e6, 23.333e6], "whose greatest common divisor is 1000 Hz: 10000000 and 23000000 would do"),
        ([20e6, True], "must be a number, got true"),
    ],
)
def test_frequencies_that_tell_no_range_are_refused_in_one_line(value, message):
    with pytest.raises(UsageError) as error:
        PMD.with_(modulation_hz=value)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_frequencies_off_by_the_rounding_of_a_file_have_the_divisor_of_whole_hertz():
    assert PMD.with_(modulation_hz=[20e6 + 1e-4, 60e6]).unambiguous_range_m == pytest.approx(C / 40e6)


def test_a_direct_sensor_has_one_frequency():
    with pytest.raises(UsageError, match="'modulation_hz' must be one number for 'kind' = 'direct'"):
        preset("vl53l5cx-8x8").with_(modulation_hz=[1e3, 2e3])


def test_phase_images_of_all_frequencies_fit_the_frame():
    with pytest.raises(UsageError, match=r"must be at most 1 / \(8 · frame_rate_hz\)"):
        TWO.with_(phase_interval_s=1 / 12)


# Images


@pytest.mark.parametrize("sensor", [TWO, FOUR, preset("pmd-16x16-wiggle").with_(modulation_hz=[20e6, 50e6])])
def test_each_frequency_of_an_image_is_that_of_a_camera_of_this_frequency_alone(sensor):
    view = {"distance_m": [0.9, 1.7], "delta_rad": [0.3, 1.4], "bearing_rad": 0.03, "height_m": 0.02}
    background = Background(wall_m=3.0, floor_m=0.5)
    together = Renderer(CYLINDER, sensor).render(**view, background=background)
    np.testing.assert_array_equal(together.phasor, together.at_frequency(sensor.frequencies_hz[0]))
    for hz, part in zip(sensor.frequencies_hz, together.by_frequency, strict=True):
        alone = Renderer(CYLINDER, sensor.with_(modulation_hz=hz)).render(**view, background=background)
        # the same samples; phases are rounded once more on their way
        np.testing.assert_allclose(part.phasor, alone.phasor, rtol=0, atol=1e-13)
        np.testing.assert_array_equal(part.intensity, alone.intensity)
        assert part.harmonics.keys() >= alone.harmonics.keys()
        for k, values in alone.harmonics.items():
            np.testing.assert_allclose(part.harmonic(k), values, rtol=0, atol=1e-12)


@pytest.mark.parametrize("hz", FOUR.frequencies_hz)
def test_a_wall_has_the_phasor_of_the_closed_form_at_every_frequency(hz):
    wall_m, albedo = 2.3, 0.5
    image = Renderer(None, FOUR).render(1.0, background=Background(wall_m=wall_m, wall_albedo=albedo))
    single = PMD.with_(modulation_hz=hz)
    exact, _ = integrate_pixels(single, plane_light([1.0, 0.0, 0.0], wall_m, albedo))
    error = np.abs(image.at_frequency(hz)[0] - exact[1]).max() / np.abs(exact[1]).max()
    assert error < 1e-4  # what PHYSICS section 3 asks of the integral


def test_a_frequency_that_was_not_rendered_is_refused_with_those_that_were():
    image = Renderer(None, TWO).render(1.0, background=Background(wall_m=2.0))
    with pytest.raises(UsageError, match="no phasor at 30000000 Hz, only at 20000000 and 60000000 Hz"):
        image.at_frequency(30e6)


def test_slopes_at_every_frequency_are_those_of_single_cameras():
    views = Renderer(CYLINDER, PMD).render([0.9, 1.3], 0.4, 0.02, 0.03).views
    background = Background(wall_m=3.0)
    _, together = Renderer(CYLINDER, FOUR).render_with_slopes(views, background=background)
    differences = Renderer(CYLINDER, FOUR).jacobian(0.9, 0.4, 0.02, 0.03, background=background)
    for j, hz in enumerate(FOUR.frequencies_hz):
        single = Renderer(CYLINDER, PMD.with_(modulation_hz=hz))
        _, alone = single.render_with_slopes(views, background=background)
        np.testing.assert_allclose(together[:, :, j], alone, rtol=0, atol=1e-6 * np.abs(alone).max())
        by_difference = single.jacobian(0.9, 0.4, 0.02, 0.03, background=background)
        np.testing.assert_allclose(differences[:, :, j], by_difference, rtol=0, atol=1e-6 * np.abs(alone).max())


def test_the_range_of_an_image_is_unwrapped_beyond_the_highest_frequency():
    image = Renderer(None, TWO).render(1.0, background=Background(wall_m=6.0))
    np.testing.assert_allclose(image.range_m[0, 8, 8], 6.0, atol=0.01)


def test_a_background_is_composed_at_every_frequency():
    background = Background(wall_m=3.0)
    alone = Renderer(CYLINDER, TWO).render(1.0, 0.2)
    behind = Renderer(None, TWO).render(1.0, background=background)
    exact = Renderer(CYLINDER, TWO).render(1.0, 0.2, background=background)
    composed = alone.composed_with(behind)
    # PHYSICS section 3: a wall is good to 4e-4 of the brightest pixel at 10 MHz, and phases turn 6 times as fast
    assert np.abs(composed.at_frequency(60e6) - exact.at_frequency(60e6)).max() < 6 * 4e-4 * np.abs(exact.phasor).max()


# One range from many


def std_of(sensor, phase_std_rad):
    return phase_std_rad * np.array([camera.metres_per_radian for camera in sensor.by_frequency])


def measured(sensor, range_m, std_m, rng):
    noisy = range_m + std_m[:, None] * rng.standard_normal((len(std_m), len(range_m)))
    return noisy % np.array([camera.unambiguous_range_m for camera in sensor.by_frequency])[:, None]


@pytest.mark.parametrize(
    "frequencies", [(20e6, 60e6), (60e6, 20e6), (80.32e6, 60.24e6), (10e6, 20e6, 60e6, 100e6), (16e6, 80e6, 120e6)]
)
def test_unwrapping_agrees_with_trying_every_count(frequencies):
    sensor, rng = PMD.with_(modulation_hz=frequencies), np.random.default_rng(1)
    truth = rng.uniform(0, sensor.unambiguous_range_m, 300)
    std = std_of(sensor, 0.7)  # so much that some are wrong
    ranges = measured(sensor, truth, std, rng)
    found = unwrap_ranges(ranges, np.broadcast_to(std[:, None], ranges.shape), sensor)
    best, lowest, second = best_counts(ranges, std[:, None], frequencies, sensor.unambiguous_range_m)
    np.testing.assert_allclose(wrapped(found.range_m - best, sensor), 0, atol=1e-9)
    np.testing.assert_allclose(found.chi2, lowest, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.second_probability, 1 / (1 + np.exp((second - lowest) / 2)), atol=1e-9)


@pytest.mark.parametrize("phase_std_rad", [0.4, 0.5, 0.7])
def test_two_frequencies_are_unwrapped_wrong_as_often_as_the_closed_form_says(phase_std_rad):
    n, rng = 200_000, np.random.default_rng(2)
    truth = rng.uniform(0, TWO.unambiguous_range_m, n)
    std = std_of(TWO, phase_std_rad)
    found = unwrap_ranges(measured(TWO, truth, std, rng), std[:, None], TWO)
    # a wrong count is off by 0.9 · 2.498 m, the weight of 60 MHz times its period; noise alone by at most 0.26 m r.m.s.
    wrong = int((np.abs(wrapped(found.range_m - truth, TWO)) > 1.124).sum())
    expected = float(unwrapping_error_probability(std, TWO))
    low, high = stats.binom.interval(1 - 0.001 / 3, n, expected)  # 99.9 %, three cells
    assert low <= wrong <= high
    assert found.second_probability.mean() == pytest.approx(expected, rel=0.05)  # the first wrong count, of several


def test_20_and_60_mhz_are_unwrapped_right_to_7_metres_at_a_tenth_of_a_radian():
    n, rng = 1_000_000, np.random.default_rng(3)
    truth = rng.uniform(0, TWO.unambiguous_range_m, n)
    std = std_of(TWO, 0.1)
    found = unwrap_ranges(measured(TWO, truth, std, rng), std[:, None], TWO)
    error = wrapped(found.range_m - truth, TWO)
    assert (np.abs(error) < 1.124).mean() >= 0.9999
    assert unwrapping_error_probability(std, TWO) < 1e-20
    # variance 1 / Σ σ⁻²: within 1 %, and within the 99.9 % interval of χ²
    ratio = np.sum(error**2) / found.std_m[0] ** 2
    low, high = stats.chi2.interval(0.999, n)
    assert low <= ratio <= high
    assert error.std() == pytest.approx(found.std_m[0], rel=0.01)
    low, high = stats.binom.interval(0.999, n, 1e-4)
    assert low <= (~found.consistent).sum() <= high
    assert found.chi2.mean() == pytest.approx(1.0, abs=4 * math.sqrt(2 / n))  # χ² of one degree of freedom, 4 σ


def test_four_frequencies_are_wrong_no_more_often_than_their_bound():
    n, rng = 200_000, np.random.default_rng(4)
    truth = rng.uniform(0, FOUR.unambiguous_range_m, n)
    std = std_of(FOUR, 0.5)
    found = unwrap_ranges(measured(FOUR, truth, std, rng), std[:, None], FOUR)
    wrong = (np.abs(wrapped(found.range_m - truth, FOUR)) > 6 * found.std_m).mean()
    bound = float(unwrapping_error_probability(std, FOUR))
    assert 0.5 * bound < wrong < bound


def test_a_mixed_pixel_unwraps_inconsistently():
    near, far, share = 2.0, 4.1, 0.4
    ranges = []
    for camera in TWO.by_frequency:
        s = sum(w / r**2 * np.exp(1j * r / camera.metres_per_radian) for r, w in ((near, share), (far, 1 - share)))
        ranges.append([np.angle(s) * camera.metres_per_radian % camera.unambiguous_range_m])
    found = unwrap_ranges(ranges, std_of(TWO, 0.01)[:, None], TWO)
    assert not found.consistent[0]
    assert found.chi2[0] > 100


def test_a_range_that_one_frequency_lacks_is_not_unwrapped():
    found = unwrap_ranges([[1.0, np.nan], [1.0, 1.0]], 0.1, TWO)
    assert np.isnan(found.range_m).tolist() == [False, True]
    assert found.consistent.tolist() == [True, False]


def test_unwrapping_refuses_ranges_of_other_frequencies():
    with pytest.raises(UsageError, match="one row for each of 2 modulation frequencies"):
        unwrap_ranges(np.ones((3, 4)), 0.1, TWO)
    with pytest.raises(UsageError, match="'std_m' must not be negative, got -1"):
        unwrap_ranges(np.ones((2, 4)), -1.0, TWO)
