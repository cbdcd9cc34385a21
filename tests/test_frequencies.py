"""Cameras of several modulation frequencies: what they are, what they see, and one range from many (section 10)."""

import json
import math
from typing import Any

import numpy as np
import pytest
from builders import cut_alike, wrapped
from oracles.images import integrate_pixels, plane_light
from oracles.integer_search import best_counts
from scipy import stats

from phasemark import UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import (
    Background,
    Flag,
    Frames,
    PhasorImages,
    Renderer,
    Sensor,
    Views,
    camera_unit,
    capture,
    predicted_range_std,
    preset,
    unwrap_ranges,
    unwrapping_error_probability,
)
from phasemark.render.exposure import Motion, capture_moving, render_moving
from phasemark.render.exposure.motion import phase_image_times_s
from phasemark.render.unwrapped_frames import unwrap_frames

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
def test_each_frequency_of_an_image_is_that_of_a_camera_of_this_frequency_alone(sensor, monkeypatch):
    cut_alike(monkeypatch, sensor)
    view: dict[str, Any] = {"distance_m": [0.9, 1.7], "delta_rad": [0.3, 1.4], "bearing_rad": 0.03, "height_m": 0.02}
    background = Background(wall_m=3.0)
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


@pytest.mark.parametrize("hz", FOUR.frequencies_hz)
def test_a_floor_has_the_phasor_of_dense_quadrature_at_every_frequency(hz):
    floor_m, albedo = 0.3, 0.5
    image = Renderer(None, FOUR.with_(cols=2)).render(1.0, background=Background(floor_m=floor_m, floor_albedo=albedo))
    single = PMD.with_(modulation_hz=hz, cols=2)

    def light(d):
        down = np.maximum(-d[..., 2], 1e-12)
        range_m = floor_m / down
        return np.where(d[..., 2] < 0, albedo * down / range_m**2, 0.0), range_m

    exact, _ = integrate_pixels(single, light, n=300)
    error = np.abs(image.at_frequency(hz)[0] - exact[1]).max(axis=1) / np.abs(exact[1]).max()
    assert np.delete(error, 8).max() < 1e-6  # with as many points a pixel as 10 MHz takes, 8e-4 at 100 MHz
    assert error[8] < 1e-3  # the horizon, where phases turn without end


def test_a_floor_is_the_same_whether_the_view_or_the_mounting_tilts():
    background = Background(floor_m=0.3)
    of_view = Renderer(None, TWO).render(1.0, pitch_rad=0.1, background=background)
    of_mount = Renderer(None, TWO.with_(pitch_deg=math.degrees(0.1))).render(1.0, background=background)
    np.testing.assert_allclose(of_view.phasors, of_mount.phasors, rtol=0, atol=1e-12)  # the product of two rotations


def test_a_frequency_that_was_not_rendered_is_refused_with_those_that_were():
    image = Renderer(None, TWO).render(1.0, background=Background(wall_m=2.0))
    with pytest.raises(UsageError, match="no phasor at 30000000 Hz, only at 20000000 and 60000000 Hz"):
        image.at_frequency(30e6)


def test_slopes_at_every_frequency_are_those_of_single_cameras(monkeypatch):
    cut_alike(monkeypatch, FOUR)
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


# Frames


def plain(range_m, sensor, amplitude=0.5):
    """Images (1, rows, cols) of unmixed pixels at given ranges, at every frequency."""
    distance = np.broadcast_to(np.asarray(range_m, float), (1, sensor.rows, sensor.cols))
    first_hz, *others = sensor.frequencies_hz
    s = {hz: amplitude * np.exp(4j * math.pi * hz / C * distance) for hz in sensor.frequencies_hz}
    light, coverage, others_by_hz = (
        np.full(distance.shape, amplitude),
        np.ones(distance.shape),
        {hz: s[hz] for hz in others},
    )
    return PhasorImages(s[first_hz], light, coverage, sensor, Views.broadcast(1.0), by_hz=others_by_hz)


def take(image, sensor, seed=1, n_frames=1, **options):
    return capture(image, sensor, rng=np.random.default_rng(seed), n_frames=n_frames, **options)


def test_each_frequency_has_the_noise_of_the_law_and_none_of_the_others():
    sensor = FOUR.with_(read_noise_e=20, ambient_e=3000)
    frames = take(plain(3.2, sensor), sensor, n_frames=200)
    phases = []
    for hz, part in zip(sensor.frequencies_hz, frames.by_frequency, strict=True):
        std_rad = math.sqrt(sensor.signal_e * 0.5 + 3000 + 2 * 400) / (math.sqrt(2) * 0.5 * sensor.signal_e * 0.5)
        law = C / (4 * math.pi * hz) * std_rad
        error = wrapped(part.range_m.ravel() - 3.2 % part.sensor.unambiguous_range_m, part.sensor)
        low, high = stats.chi2.interval(1 - 0.001 / 4, error.size)  # 99.9 %, four cells
        assert low <= np.sum(error**2) / law**2 <= high
        phases.append(error)
    correlation = np.corrcoef(phases)[np.triu_indices(4, 1)]
    assert np.abs(correlation).max() < 4.5 / math.sqrt(phases[0].size)  # six normal deviates: 99.99 %


def test_the_range_of_a_frame_has_the_combined_variance():
    frames = take(plain(6.3, TWO), TWO, n_frames=400)
    law = sum(predicted_range_std(0.5, 0.5, camera) ** -2.0 for camera in TWO.by_frequency)
    error = frames.range_m[frames.valid] - 6.3
    low, high = stats.chi2.interval(0.999, error.size)
    assert low <= np.sum(error**2) * law <= high
    flagged = frames.flags[~frames.valid]
    assert (flagged == Flag.INCONSISTENT | Flag.MISSING).all()
    low, high = stats.binom.interval(0.999, frames.flags.size, 1e-4)
    assert low <= flagged.size <= high


def test_one_frequency_keeps_the_noise_it_has_alone_and_a_run_its_bytes_piece_by_piece():
    alone = PMD.with_(modulation_hz=20e6)
    frames, single = (take(plain(3.0, sensor), sensor, n_frames=4) for sensor in (TWO, alone))
    np.testing.assert_array_equal(frames.by_frequency[0].range_m, single.range_m)
    np.testing.assert_array_equal(frames.amplitude_e, single.amplitude_e)
    part = take(plain(3.0, TWO), TWO, n_frames=2, first_frame=2)
    np.testing.assert_array_equal(frames.range_m[:, 2:], part.range_m)


def test_taps_are_kept_in_the_order_of_the_phase_images():
    frames = take(plain(3.0, TWO), TWO, keep_taps=True)
    assert frames.taps_e.shape == (1, 1, 8, 2, 16, 16)
    for j, part in enumerate(frames.by_frequency):
        d = frames.taps_e[:, :, 4 * j : 4 * j + 4, 0] - frames.taps_e[:, :, 4 * j : 4 * j + 4, 1]
        phase = np.arctan2(d[:, :, 3] - d[:, :, 1], d[:, :, 0] - d[:, :, 2])
        np.testing.assert_allclose(
            wrapped(phase * part.sensor.metres_per_radian - part.range_m, part.sensor), 0, atol=1e-9
        )


def test_every_frequency_has_a_pattern_of_phase_offsets_and_the_range_offset_is_one_delay():
    sensor = TWO.with_(phase_offset_std_rad=0.02, range_offset_m=0.3, shot_noise=False)
    frames = take(plain(3.0, sensor), sensor)
    patterns = []
    for j, part in enumerate(frames.by_frequency):
        error = wrapped(part.range_m[0, 0] - 3.3, part.sensor)
        expected = camera_unit(sensor, j).delay_rad[0] * part.sensor.metres_per_radian - 0.3
        np.testing.assert_allclose(error, expected, atol=1e-9)
        patterns.append(expected / part.sensor.metres_per_radian)
        assert np.std(patterns[-1]) == pytest.approx(0.02, rel=0.15)  # 256 pixels: 3 σ
    assert abs(np.corrcoef(patterns[0].ravel(), patterns[1].ravel())[0, 1]) < 0.25
    # the patterns are known to the camera: what they make of the ranges is no sign of mixing
    assert frames.valid.all()


def test_phase_images_of_a_moving_camera_are_eight_about_the_middle():
    assert np.allclose(phase_image_times_s(TWO), (np.arange(8) - 3.5) / 24)
    renderer, motion = Renderer(None, TWO), Motion(forward_m_s=0.2)
    views = Views.broadcast(1.0)
    images = render_moving(renderer, views, motion, background=Background(wall_m=3.0))
    assert len(images) == 8
    quiet = TWO.with_(shot_noise=False)
    frames = capture_moving(
        Renderer(None, quiet), views, quiet, motion, rng=np.random.default_rng(1), background=Background(wall_m=3.0)
    )
    for j, part in enumerate(frames.by_frequency):
        distance = 3.0 - 0.2 * (np.arange(8) - 3.5)[4 * j : 4 * j + 4] / 24  # of the wall, straight ahead
        s = np.exp(1j * distance / part.sensor.metres_per_radian) / distance**2
        d = (s * np.exp(0.5j * math.pi * np.arange(4))).real
        expected = math.atan2(d[3] - d[1], d[0] - d[2]) * part.sensor.metres_per_radian
        # the pixel beside the axis sees the wall 0.2 mm further out
        assert wrapped(part.range_m[0, 0, 8, 8] - expected, part.sensor) == pytest.approx(0, abs=1e-3)


def test_a_mixed_pixel_is_flagged_inconsistent():
    image = Renderer(CYLINDER, TWO).render(1.0, 0.3, background=Background(wall_m=3.0))
    frames = take(image, TWO)
    mixed = (image.coverage[0] > 0.1) & (image.coverage[0] < 0.9)
    inconsistent = (frames.flags[0, 0] & Flag.INCONSISTENT) > 0
    assert inconsistent[mixed].mean() > 0.8
    assert np.isnan(frames.range_m[0, 0][inconsistent]).all()
    assert inconsistent[image.coverage[0] == 0].sum() <= 1
    for part in frames.by_frequency:  # each frequency keeps what it measured
        assert part.valid[0, 0][mixed].mean() > 0.9


def test_flags_of_several_frequencies_say_what_all_of_them_say():
    def part(camera, flags):
        return Frames(np.ones((1, 4)), np.full((1, 4), 1e4), np.full((1, 4), 1e4), flags=flags, sensor=camera)

    cameras = TWO.with_(rows=1, cols=4)
    none, saturated = Flag.NO_RETURN, Flag.MISSING | Flag.SATURATED
    first = part(cameras.by_frequency[0], [[none, none, 0, 0]])
    second = part(cameras.by_frequency[1], [[none, 0, saturated, 0]])
    flags = unwrap_frames([first, second], cameras).flags[0, 0, 0]
    assert flags.tolist() == [none, Flag.INCONSISTENT | Flag.MISSING, saturated, 0]


def test_frames_of_other_frequencies_are_refused():
    frames = take(plain(3.0, TWO), TWO)
    with pytest.raises(UsageError, match="'by_frequency' must follow the order"):
        Frames(frames.range_m, sensor=TWO, by_frequency=frames.by_frequency[::-1])
    with pytest.raises(UsageError, match="of 2 frequencies, got 1"):
        unwrap_frames(frames.by_frequency[:1], TWO)
    with pytest.raises(UsageError, match="'modulation_hz' is"):
        take(plain(3.0, TWO), FOUR)


def test_some_frames_keep_what_each_frequency_measured():
    frames = take(plain(3.0, TWO), TWO, n_frames=3)
    for some in (frames[:1], frames.each_a_position()):
        assert [part.range_m.shape for part in some.by_frequency] == [some.range_m.shape] * 2
