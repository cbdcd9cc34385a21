"""The errors of the chain from light to frames, each against a closed form or a stated interval."""

import itertools
import math

import numpy as np
import pytest
from builders import images_of, one_pixel, pure_image, wrapped
from oracles.noise_law import FALSE_ALARM, noise_law_m
from scipy import special, stats

from phasemark import UsageError
from phasemark.render import Flag, Renderer, Sensor, camera_unit, capture, preset
from phasemark.render.exposure import capture as chain
from phasemark.render.exposure import photoelectrons as read_out
from phasemark.render.exposure.random_streams import fill_normal, fill_uniform, philox, uniform_pair
from phasemark.render.exposure.stray_light import spread_light
from phasemark.render.sensor import pulse_harmonics, square_harmonics
from phasemark.render.sensor.correlation import correlation_curve, correlation_peak
from phasemark.render.sensor.sensor_checks import PATTERN_BOUND

PMD = preset("pmd-16x16")


def take(image, sensor, seed=1, n_frames=1, **options):
    return capture(image, sensor, rng=np.random.default_rng(seed), n_frames=n_frames, **options)


# Random streams


@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [  # known answers published with Random123
        ([0] * 4, [0] * 2, [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
        ([0xFFFFFFFF] * 4, [0xFFFFFFFF] * 2, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
        (
            [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
            [0xA4093822, 0x299F31D0],
            [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
        ),
    ],
)
def test_philox_gives_the_published_known_answers(counter, key, words):
    state = np.tile(np.array(counter, np.uint64)[:, None], (1, 5))
    philox(state, np.array(key, np.uint64))
    assert (state == np.array(words, np.uint64)[:, None]).all()


def test_a_uniform_pair_alone_is_that_of_the_row():
    key, words, row = np.array([5, 6], np.uint64), np.empty((4, 9), np.uint64), np.empty((2, 9))
    fill_uniform(100 + np.arange(row.shape[1]), 3, 4, 1, key, words, row)
    assert uniform_pair(107, 3, 4, 1, 0, key) == tuple(row[:, 7])
    assert uniform_pair(107, 3, 4, 1, 1, key) != tuple(row[:, 7])


def test_normal_deviates_are_the_quantiles_of_the_normal_distribution():
    p = np.concatenate([np.geomspace(1e-16, 0.5, 1000), 1 - np.geomspace(1e-16, 0.5, 1000)])
    z = np.empty_like(p)
    fill_normal(p, np.empty(len(p), np.int32), z)
    np.testing.assert_allclose(z, special.ndtri(p), rtol=0, atol=1e-14)  # AS 241 is good to 1e-15 of |z| < 9


# Shot noise


def counts(mean, n, seed=3):
    """Electrons of one tap of n dark frames."""
    sensor = one_pixel(ambient_e=2 * mean)
    frames = take(images_of([[[0j]]], [[[0.0]]], sensor), sensor, seed, n, keep_taps=True)
    return frames.taps_e.reshape(n, 8)[:, 3]


@pytest.mark.parametrize("mean", [0.05, 1.0, 9.9, 10.0, 40.0, 499.0])
def test_counts_below_the_switch_are_poisson(mean):
    n = 50_000
    drawn = counts(mean, n)
    edges = np.unique(stats.poisson.ppf(np.linspace(0.0, 1, 41)[1:-1], mean))
    expected = n * np.diff(np.concatenate([[0], stats.poisson.cdf(edges, mean), [1]]))
    found = np.diff(np.concatenate([[0], [(drawn <= edge).sum() for edge in edges], [n]]))
    keep = expected > 5  # χ² needs a few counts in a bin
    chi2 = ((found - expected)[keep] ** 2 / expected[keep]).sum()
    assert np.all(drawn == np.round(drawn))
    assert chi2 < stats.chi2.ppf(1 - FALSE_ALARM / 6, max(keep.sum() - 1, 1))


def test_just_above_the_switch_a_normal_cannot_be_told_from_poisson():
    mean, n = read_out.EXACT_POISSON_BELOW, 50_000
    drawn = counts(mean, n)
    z = stats.norm.ppf(1 - FALSE_ALARM / 6)
    assert drawn.mean() == pytest.approx(mean, abs=z * math.sqrt(mean / n))
    assert drawn.var(ddof=1) == pytest.approx(mean, rel=z * math.sqrt(2 / n))
    # Kolmogorov's distance from Poisson, between counts, against its 99.97 % point 2.08 / √n = 0.0093
    edges = np.arange(stats.poisson.ppf(1e-6, mean), stats.poisson.ppf(1 - 1e-6, mean)) + 0.5
    distance = np.abs(np.searchsorted(np.sort(drawn), edges) / n - stats.poisson.cdf(edges, mean)).max()
    assert distance < stats.kstwobign.ppf(1 - FALSE_ALARM / 3) / math.sqrt(n)


@pytest.mark.soak
@pytest.mark.parametrize("mean", [300.0, 499.0, 501.0, 700.0, 2000.0])
def test_the_switch_from_poisson_to_normal_cannot_be_seen_in_the_range(mean):
    # against NumPy's Poisson generator alone, Kolmogorov and Smirnov's test of two samples
    n, sensor = 200_000, one_pixel(ambient_e=2 * mean, contrast=1.0, signal_e=2 * mean)
    drawn = take(pure_image(3.0, sensor, 0.3), sensor, n_frames=n).range_m.ravel()
    reference = np.random.default_rng(3)
    taps = 0.5 * sensor.signal_e * 0.3 + 0.5 * sensor.ambient_e
    swing = 0.5 * sensor.signal_e * 0.3 * np.cos(3.0 / sensor.metres_per_radian + np.arange(4) * np.pi / 2)
    d = reference.poisson(taps + swing, (n, 4)) - reference.poisson(taps - swing, (n, 4))
    exact = np.arctan2(d[:, 3] - d[:, 1], d[:, 0] - d[:, 2]) % (2 * np.pi) * sensor.metres_per_radian
    assert stats.ks_2samp(drawn, exact).pvalue > FALSE_ALARM / 5
    assert read_out.EXACT_POISSON_BELOW == 500.0  # the means above stand on both sides of it


# The noise law


@pytest.mark.parametrize(("n", "within"), [(100_000, 0.01), pytest.param(2_000_000, 0.003, marks=pytest.mark.soak)])
def test_photon_transfer_is_the_gain(n, within):
    # variance in code² against mean in code: the slope is the gain, the rest read noise and 1/12 code²
    gain, read_noise_e = 0.05, 30.0
    mean_e = np.array([300.0, 1000, 4000, 16_000, 40_000, 70_000])
    codes = []
    for mean in mean_e:
        sensor = one_pixel(ambient_e=2 * mean, read_noise_e=read_noise_e, adc_bits=12, gain=gain, black_level=50.0)
        taps = take(images_of([[[0j]]], [[[0.0]]], sensor), sensor, 5, n // 8, keep_taps=True).taps_e
        codes.append(taps.ravel() * gain)
    variance = np.array([c.var(ddof=1) for c in codes])
    weight = n / (2 * variance**2)  # of a sample variance
    slope, offset = np.polyfit(gain * mean_e, variance, 1, w=np.sqrt(weight))
    assert slope == pytest.approx(gain, rel=within)
    z = stats.norm.ppf(1 - FALSE_ALARM / 2)
    assert [c.mean() for c in codes] == pytest.approx(gain * mean_e, abs=z * math.sqrt(variance.max() / n))
    assert offset == pytest.approx((gain * read_noise_e) ** 2 + 1 / 12, abs=z * variance[0] * math.sqrt(2 / n) * 2)


def test_quantisation_adds_a_twelfth_of_a_squared_code_once():
    # with read noise of σ codes rounding adds 1/12 but for (4σ² + 1/π²) e^{−2π²σ²} at most: 0.008 at ½ code, then 0
    for noise_codes in (0.5, 1.0, 4.0):
        n, code_e = 400_000, 20.0
        sensor = one_pixel(
            shot_noise=False, read_noise_e=noise_codes * code_e, adc_bits=12, gain=1 / code_e, black_level=100.0,
            ambient_e=6543.2,
        )  # fmt: skip
        taps = take(images_of([[[0j]]], [[[0.0]]], sensor), sensor, 6, n // 8, keep_taps=True).taps_e / code_e
        variance = taps.var(ddof=1)
        z = stats.norm.ppf(1 - FALSE_ALARM / 6)
        expected = noise_codes**2 + 1 / 12
        bump = (4 * noise_codes**2 + 1 / math.pi**2) * math.exp(-2 * math.pi**2 * noise_codes**2)
        assert variance == pytest.approx(expected, abs=z * expected * math.sqrt(2 / n) + bump)


# Saturation and validity


@pytest.mark.parametrize(
    ("fields", "highest_e"),
    [({"full_well_e": 20_000}, 20_000), ({"adc_bits": 10, "gain": 0.05, "black_level": 23.0}, (1023 - 23) / 0.05)],
)
def test_a_tap_clips_at_its_full_well_or_the_highest_code_and_is_flagged(fields, highest_e):
    sensor = one_pixel(shot_noise=False, **fields)
    image = pure_image([1.0, 1.0], sensor, 1.2)
    image.phasor[1] *= 0.4
    image.intensity[1] *= 0.4
    frames = take(image, sensor, keep_taps=True)
    assert frames.flags.ravel().tolist() == [int(Flag.SATURATED | Flag.MISSING), 0]
    assert frames.taps_e[0].max() == highest_e
    assert np.isnan(frames.range_m[0]).all()


def test_the_amplitude_threshold_and_the_wrap_guard_say_why():
    sensor = one_pixel(shot_noise=False, min_amplitude_e=5000.0, wrap_guard_m=0.2)
    period = sensor.unambiguous_range_m
    for range_m, amplitude, flag in (
        (1.0, 0.29, 0),
        (1.0, 0.28, Flag.NO_RETURN),  # 5000 e- are K N₀ |S| at |S| = 0.2811
        (0.19, 0.5, Flag.NEAR_WRAP | Flag.MISSING),
        (period - 0.19, 0.5, Flag.NEAR_WRAP | Flag.MISSING),
        (period - 0.21, 0.5, 0),
    ):
        assert take(pure_image(range_m, sensor, amplitude), sensor).flags.item() == int(flag)


def test_dead_and_hot_pixels_are_flagged_and_nothing_else():
    sensor = PMD.with_(dead_pixels=((0, 1),), hot_pixels=((2, 3),), hot_e=1000.0)
    frames = take(pure_image(1.0, sensor), sensor, n_frames=100, keep_taps=True)
    flags = np.zeros((16, 16), int)
    flags[0, 1], flags[2, 3] = Flag.DEAD | Flag.MISSING, Flag.HOT | Flag.MISSING
    assert (frames.flags == flags).all()
    assert (frames.taps_e[..., 0, 1] == 0).all()
    extra = frames.intensity_e[..., 2, 3].mean() - frames.intensity_e[..., 5, 5].mean()
    assert extra == pytest.approx(1000, abs=5 * math.sqrt(2 * 36_000 / 4 / 100))  # 5 σ of a mean of 100 frames


def test_defects_come_in_the_share_asked_for():
    sensor = Sensor(rows=200, cols=200, half_angle_h_deg=20, half_angle_v_deg=20, dead_share=0.01, hot_share=0.02)
    unit = camera_unit(sensor)
    z = stats.norm.ppf(1 - FALSE_ALARM / 4)
    assert unit.dead.sum() == pytest.approx(400, abs=z * 20)
    assert unit.hot.sum() == pytest.approx(800, abs=z * 28)


# Patterns


def test_patterns_have_their_size_end_at_three_sigma_and_keep_their_shape():
    sensor = Sensor(rows=128, cols=128, half_angle_h_deg=20, half_angle_v_deg=20, dark_e=100, prnu=0.01, dsnu_e=10.0,
                    phase_offset_std_rad=0.02)  # fmt: skip
    unit = camera_unit(sensor)
    z = stats.norm.ppf(1 - FALSE_ALARM / 8)
    for values, mean, std in (
        (unit.response, 1, 0.01),
        (unit.dark_e, 50, 10),
        (unit.delay_rad[0], 0, 0.02),
    ):
        n = values.size
        assert values.mean() == pytest.approx(mean, abs=z * std / math.sqrt(n))
        assert values.std() == pytest.approx(std, rel=z / math.sqrt(2 * n))
        assert np.abs(values - mean).max() <= PATTERN_BOUND * std * (1 + 1e-9)
    twice = camera_unit(sensor.with_(prnu=0.02, dsnu_e=0))
    np.testing.assert_allclose(twice.response - 1, 2 * (unit.response - 1), rtol=0, atol=1e-14)
    other = camera_unit(sensor.with_(unit_seed=1)).response
    assert abs(np.corrcoef(other.ravel(), unit.response.ravel())[0, 1]) < z / math.sqrt(other.size)


def test_response_and_dark_patterns_cancel_in_the_range_and_phase_offsets_shift_it():
    ideal = preset("ideal")
    image = pure_image(3.0, ideal, 0.5)
    uneven = ideal.with_(prnu=0.05, dark_e=600, dsnu_e=100.0)
    np.testing.assert_allclose(take(image, uneven).range_m, 3.0, rtol=0, atol=1e-11)  # rounding
    shifted = ideal.with_(phase_offset_std_rad=0.02, range_offset_m=0.3, unit_seed=4)
    expected = 3.0 + camera_unit(shifted).delay_rad[0] * shifted.metres_per_radian
    np.testing.assert_allclose(take(image, shifted).range_m[0, 0], expected, rtol=0, atol=1e-11)
    split = ideal.with_(tap_phase_offset_std_rad=0.02)
    delay = camera_unit(split).delay_rad
    expected = 3.0 + delay.mean(axis=0) * split.metres_per_radian  # the sum of two equal phasors lies half-way
    np.testing.assert_allclose(take(image, split).range_m[0, 0], expected, rtol=0, atol=1e-11)


# Wiggling


def phase_error(sensor, n=4000):
    phase = 2 * np.pi * np.arange(n) / n
    frames = take(pure_image(phase * sensor.metres_per_radian, sensor, 0.5), sensor)
    return wrapped(frames.range_m.ravel() - phase * sensor.metres_per_radian, sensor) / sensor.metres_per_radian


@pytest.mark.parametrize(("max_order", "largest"), [(49, 0.0711), (7, 0.0772)])
def test_square_against_square_wiggles_as_computed(max_order, largest):
    error = phase_error(one_pixel(shot_noise=False, modulation="square", max_harmonic=max_order))
    assert np.abs(error).max() == pytest.approx(largest, rel=0.002)
    spectrum = np.abs(np.fft.rfft(error))
    assert spectrum.argmax() == 4  # four periods over 2π
    assert np.delete(spectrum, np.arange(0, len(spectrum), 4)).max() < 1e-9 * spectrum.max()


def test_an_offset_delays_every_order():
    # a camera that sees everything 0.7 m too far sees at 2.3 m what another sees at 3 m, wiggling included
    sensor = one_pixel(shot_noise=False, modulation="square")
    late = sensor.with_(range_offset_m=0.7)
    ranges = np.array([2.3, 4.1, 9.0])
    seen, expected = take(pure_image(ranges, late), late), take(pure_image(ranges + 0.7, sensor), sensor)
    np.testing.assert_allclose(seen.range_m, expected.range_m, rtol=0, atol=1e-11)  # rounding
    assert np.abs(expected.range_m.ravel() - ranges - 0.7).max() > 0.05


def test_even_orders_cancel_in_the_range_but_not_in_the_taps():
    sensor = one_pixel(shot_noise=False, modulation="harmonics", harmonics=((2, 0.2, 0.4), (4, 0.1, 1.0)))
    for still in (sensor, one_pixel(shot_noise=False)):  # nor does a sine wiggle
        assert np.abs(phase_error(still)).max() < 1e-12
    image = pure_image(1.0, sensor, 0.5)
    taps = take(image, sensor, keep_taps=True).taps_e[0, 0, :, :, 0, 0]
    phase, tau = 1.0 / sensor.metres_per_radian, np.arange(4) * np.pi / 2
    cosine = correlation_curve(phase + tau, sensor.correlation_harmonics)
    expected = 0.25 * sensor.signal_e * (1 + np.outer(cosine, [1, -1]) * sensor.contrast)
    np.testing.assert_allclose(taps, expected, rtol=1e-12)


def test_wiggling_of_a_mixed_pixel_is_that_of_its_harmonics():
    # two surfaces: S_3 of the mixture, not the wiggling of the mixed range
    sensor = one_pixel(shot_noise=False, modulation="harmonics", harmonics=((3, 0.1, 0.3), (5, 0.05, -0.2)))
    phases, weights = np.array([3.0, 6.0]) / sensor.metres_per_radian, np.array([0.5 / 9, 0.5 / 36])
    s = {k: (weights * np.exp(1j * k * phases)).sum() for k in (1, 3, 5)}
    image = images_of([[[s[1]]]], [[[weights.sum()]]], sensor, {k: np.full((1, 1, 1), s[k]) for k in (3, 5)})
    total = s[1] + np.conj(0.1 * s[3] * np.exp(0.3j)) + 0.05 * s[5] * np.exp(-0.2j)
    assert take(image, sensor).range_m.item() == pytest.approx(np.angle(total) * sensor.metres_per_radian, abs=1e-12)


def test_square_pulses_have_the_harmonics_of_a_square_wave():
    n = 4096
    pulse = np.arange(n) < n // 2
    found = {h.order: h for h in pulse_harmonics(pulse, pulse, 15)}
    assert set(found) == set(range(3, 16, 2))
    for order, amplitude, _ in square_harmonics(15):
        assert found[order].amplitude == pytest.approx(amplitude, rel=1e-4)  # samples: sin(x) for x, x = πk/n
        assert found[order].phase_rad == pytest.approx(0.0, abs=1e-9)


def test_the_delay_of_a_pulse_is_of_no_account_but_its_shape_is():
    t = np.arange(256)
    decay, gate = np.exp(-t / 40.0), (t < 128).astype(float)
    reference = pulse_harmonics(decay, gate, 9)
    for (k, a, theta), (j, b, psi) in zip(reference, pulse_harmonics(np.roll(decay, 37), gate, 9), strict=True):
        assert (k, a) == (j, pytest.approx(b))
        assert math.remainder(theta - psi, 2 * math.pi) == pytest.approx(0, abs=1e-9)
    # the correlation itself, by the sum that defines it
    curve = np.array([(np.roll(decay, shift) * gate).mean() for shift in t])
    spectrum = np.fft.rfft(curve - curve.mean())
    axis = 2 * np.pi * t / 256 + np.angle(spectrum[1])
    keep = np.fft.irfft(np.where(np.arange(129) <= 9, spectrum, 0), 256) * 128 / abs(spectrum[1])
    np.testing.assert_allclose(correlation_curve(axis, reference), keep, rtol=0, atol=1e-9)


def test_the_peak_of_a_correlation_is_that_of_a_fine_search():
    for harmonics in (square_harmonics(49), pulse_harmonics(np.arange(32), np.arange(32) < 9, 15)):
        fine = np.abs(correlation_curve(np.linspace(0, 2 * np.pi, 400_001), harmonics)).max()
        assert correlation_peak(harmonics) == pytest.approx(fine, rel=1e-5)


def test_an_image_without_the_harmonics_is_refused():
    sensor = one_pixel(modulation="square")
    with pytest.raises(UsageError, match=r"lacks harmonic 3, .*render it with a Renderer for this sensor"):
        take(images_of([[[0.5]]], [[[0.5]]], sensor), sensor)


def test_a_renderer_renders_the_harmonics_that_its_sensor_needs():
    sensor = PMD.with_(modulation="square", max_harmonic=7)
    assert set(Renderer(None, sensor).render(1.0).harmonics) == {3, 5, 7}
    assert set(Renderer(None, sensor, harmonics=()).render(1.0).harmonics) == set()


# Stray light


def test_stray_light_keeps_the_total_phasor():
    rng = np.random.default_rng(0)
    light = rng.random((3, 9, 16)) * np.exp(1j * rng.uniform(0, 6.28, (3, 9, 16)))
    for blur_px, veil_px in ((0.5, 3.0), (1.0, 8.0), (2.0, 500.0)):
        sensor = Sensor(rows=9, cols=16, half_angle_h_deg=9, half_angle_v_deg=9, blur_share=0.2, blur_px=blur_px,
                        veil_share=0.1, veil_px=veil_px)  # fmt: skip
        out = spread_light(light, sensor)
        total = light.sum(axis=(1, 2))
        assert np.abs(out.sum(axis=(1, 2)) - total).max() < 1e-12 * np.abs(light).sum(axis=(1, 2)).max()
        assert not np.allclose(out, light)


def test_stray_light_of_one_pixel_is_its_kernel():
    sensor = PMD.with_(blur_share=0.2, blur_px=1.5, veil_share=0.05, veil_px=6.0)
    light = np.zeros((1, 16, 16))
    light[0, 1, 4] = 1.0  # near a corner: what would fall outside is shared inside
    row, col = np.mgrid[:16, :16]
    expected = 0.75 * light[0]
    for share, sigma in ((0.2, 1.5), (0.05, 6.0)):
        weight = np.exp(-((row - 1) ** 2 + (col - 4) ** 2) / (2 * sigma**2))
        expected = expected + share * weight / weight.sum()
    np.testing.assert_allclose(spread_light(light, sensor)[0], expected, rtol=0, atol=1e-15)


def test_stray_light_of_a_bright_wall_pulls_a_dark_pixel_to_it():
    sensor = preset("ideal").with_(veil_share=0.1, veil_px=1e6)
    phase = np.full((1, 16, 16), 2.0)
    phase[0, 5, 5] = 4.0
    weight = np.full((1, 16, 16), 1.0)
    weight[0, 5, 5] = 0.05
    s = weight * np.exp(1j * phase)
    frames = take(images_of(s, weight, sensor), sensor)
    total = 0.9 * s[0, 5, 5] + 0.1 * s.sum() / 256  # an endless veil is the mean over the image
    assert frames.range_m[0, 0, 5, 5] == pytest.approx(np.angle(total) % 6.283185307 * sensor.metres_per_radian)


# Bytes


def everything():
    return preset("pmd-16x16-wiggle").with_(rows=8, cols=8, max_harmonic=7)


def mixed_scene(sensor, n):
    rng = np.random.default_rng(2)
    shape = (n, sensor.rows, sensor.cols)
    near, far = rng.uniform(0.5, 2, shape), rng.uniform(2, 9, shape)
    phases = np.stack([near, far]) / sensor.metres_per_radian
    weights = np.stack([0.3 / near**2, 0.7 / far**2])
    harmonics = {k: (weights * np.exp(1j * k * phases)).sum(axis=0) for k in (1, *sensor.harmonic_orders)}
    return images_of(harmonics.pop(1), weights.sum(axis=0), sensor, harmonics)


def arrays_of(frames):
    return frames.range_m, frames.amplitude_e, frames.intensity_e, frames.flags, frames.taps_e


def test_frames_have_the_same_bytes_however_they_are_cut_and_by_any_number_of_workers(monkeypatch):
    sensor = everything()
    image, n_views, n_frames = mixed_scene(sensor, 5), 5, 6
    whole = arrays_of(take(image, sensor, 3, n_frames, keep_taps=True))
    rng = np.random.default_rng(3)  # a second capture from the same generator has new noise
    first, second = (capture(image, sensor, rng=rng).range_m for _ in range(2))
    assert first.tobytes() != second.tobytes()
    for block, blocks, workers in ((1, 1, 3), (5000, 3, 2), (2**30, 1, 1)):
        monkeypatch.setattr(chain, "_TAPS_PER_BLOCK", block)
        monkeypatch.setattr(chain, "_BLOCKS_PER_RUN", blocks)
        again = arrays_of(take(image, sensor, 3, n_frames, keep_taps=True, workers=workers))
        assert all(a.tobytes() == b.tobytes() for a, b in zip(whole, again, strict=True))
    for view, frame in itertools.product((0, 3, n_views - 1), (0, 4)):
        part = images_of(
            image.phasor[view : view + 1], image.intensity[view : view + 1], sensor,
            {k: s[view : view + 1] for k, s in image.harmonics.items()},
        )  # fmt: skip
        alone = arrays_of(take(part, sensor, 3, 1, keep_taps=True, first_view=view, first_frame=frame))
        assert all(a[view, frame].tobytes() == b[0, 0].tobytes() for a, b in zip(whole, alone, strict=True))


def test_taps_kept_demodulate_to_the_frame():
    sensor = everything()
    frames = take(mixed_scene(sensor, 2), sensor, 3, 2, keep_taps=True)
    d = frames.taps_e[:, :, :, 0] - frames.taps_e[:, :, :, 1]
    phase = np.arctan2(d[:, :, 3] - d[:, :, 1], d[:, :, 0] - d[:, :, 2]) % (2 * np.pi)
    np.testing.assert_allclose(
        frames.range_m[frames.valid], (phase * sensor.metres_per_radian)[frames.valid], rtol=0, atol=1e-11
    )
    assert frames[1:].taps_e.shape == (1, 2, 4, 2, 8, 8)
    assert take(mixed_scene(sensor, 2), sensor).taps_e is None


def test_a_bad_day_has_patterns_that_stay_and_noise_that_does_not():
    sensor = preset("pmd-16x16-wiggle")
    frames = take(pure_image(1.0, sensor, 0.8), sensor, 1, 200)
    unit = camera_unit(sensor)
    assert (frames.valid.all(axis=(0, 1)) == ~(unit.dead | unit.hot)).all()
    spread = np.nanstd(frames.range_m.mean(axis=1))
    assert spread > 0.8 * 0.02 * sensor.metres_per_radian  # phase offsets of 0.02 rad, 255 pixels
    law = pytest.approx(noise_law_m(sensor, 0.8, 0.8), rel=0.05)  # wiggling changes the slope a little
    assert np.nanmedian(frames.range_m.std(axis=1)) == law
