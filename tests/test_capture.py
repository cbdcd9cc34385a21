import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, special, stats

from phasemark import UsageError
from phasemark.render import (
    Flag,
    Frames,
    PhasorImages,
    Sensor,
    Views,
    capture,
    measured_range_std,
    phasor_to_range_m,
    predicted_range_std,
    preset,
)
from phasemark.render.exposure import capture as chain
from phasemark.render.exposure.taps import demodulate, tap_means
from phasemark.render.sensor.camera_unit import camera_unit

FALSE_ALARM = 1e-3  # of a whole test, whatever the number of cells


def one_pixel(**fields):
    return Sensor(rows=1, cols=1, half_angle_h_deg=1, half_angle_v_deg=1, **fields)


def images_of(phasor, intensity, sensor):
    """PhasorImages of given pixels, (n, rows, cols)."""
    phasor = np.asarray(phasor, complex)
    views = Views.broadcast(np.ones(len(phasor)))
    return PhasorImages(phasor, np.asarray(intensity, float), np.ones(phasor.shape), sensor, views)


def one_pixel_image(amplitude, range_m, intensity, sensor):
    phase = range_m / sensor.metres_per_radian
    return images_of([[[amplitude * np.exp(1j * phase)]]], [[[intensity]]], sensor)


def wrapped(difference_m, sensor):
    period = sensor.unambiguous_range_m
    return (difference_m + period / 2) % period - period / 2


def variance_interval(n, n_cells):
    """Bounds of the sample variance of n normal values over its true value."""
    tail = FALSE_ALARM / n_cells / 2
    return stats.chi2.ppf([tail, 1 - tail], n - 1) / (n - 1)


def two_surfaces(near_m, far_m, share, sensor):
    """The closed form of PHYSICS section 3: phasor and intensity of two surfaces of equal albedo in one pixel."""
    weights = np.array([share / near_m**2, (1 - share) / far_m**2])
    phases = np.array([near_m, far_m]) / sensor.metres_per_radian
    return (weights * np.exp(1j * phases)).sum(), weights.sum()


def test_tap_means_follow_the_cosine_at_four_delays():
    sensor = one_pixel(contrast=0.4, signal_e=1000, ambient_e=300, dark_e=50)
    phasor, intensity = 0.6 * np.exp(2.1j), 0.7
    means = tap_means({1: np.array([[[phasor]]])}, np.array([[[intensity]]]), sensor)
    assert means.shape == (1, 4, 2, 1, 1)
    for i in range(4):
        for tap, sign in enumerate((1, -1)):
            tau = i * math.pi / 2
            light = 0.5 * (1000 * 0.7 + 300) + sign * 0.5 * 0.4 * 1000 * 0.6 * math.cos(2.1 + tau)
            assert means[0, i, tap, 0, 0] == pytest.approx(light, rel=1e-12)  # rounding alone


def test_a_quarter_turn_of_phase_is_an_eighth_of_the_modulation_wavelength():
    sensor = preset("ideal").with_(rows=1, cols=1)
    frames = capture(images_of([[[1j]]], [[[1.0]]], sensor), sensor, rng=np.random.default_rng(0))
    assert frames.range_m[0, 0, 0, 0] == pytest.approx(299_792_458 / 10e6 / 8, rel=1e-12)


def test_mean_amplitude_and_intensity_are_those_of_the_light():
    sensor = one_pixel(contrast=0.4, signal_e=50_000, ambient_e=3000, dark_e=500, read_noise_e=20)
    n = 50_000
    frames = capture(one_pixel_image(0.7, 4.0, 0.8, sensor), sensor, rng=np.random.default_rng(1), n_frames=n)
    variance = 50_000 * 0.8 + 3500 + 2 * 20**2
    amplitude = 0.4 * 50_000 * 0.7
    z = stats.norm.ppf(1 - FALSE_ALARM / 4)
    # Rice's mean: the noise across the phasor lengthens it, here by 0.8 e-.
    expected = amplitude + variance / (4 * amplitude)
    assert frames.amplitude_e.mean() == pytest.approx(expected, abs=z * math.sqrt(variance / 2 / n))
    assert frames.intensity_e.mean() == pytest.approx(43_500, abs=z * math.sqrt(variance / 4 / n))


NOISE_CELLS = [
    {"signal_e": 35_571},
    {"signal_e": 35_571, "contrast": 1.0},
    {"signal_e": 35_571, "contrast": 0.25, "amplitude": 1.0},
    {"signal_e": 35_571, "ambient_e": 50_000},
    {"signal_e": 35_571, "dark_e": 20_000},
    {"signal_e": 35_571, "read_noise_e": 150},
    {"signal_e": 35_571, "read_noise_e": 150, "shot_noise": False},
    {"signal_e": 200_000, "amplitude": 0.3, "range_m": 14.98},  # at the wrap, light half mixed away
    {"signal_e": 500_000, "contrast": 0.3, "ambient_e": 1e5, "dark_e": 1e4, "read_noise_e": 200, "range_m": 9.0},
]


@pytest.mark.parametrize("cell", NOISE_CELLS, ids=lambda cell: " ".join(f"{k}={v:g}" for k, v in cell.items()))
def test_range_noise_meets_the_law(cell):
    fields = dict(cell)
    amplitude, range_m = fields.pop("amplitude", 0.8), fields.pop("range_m", 1.0)
    intensity = max(0.8, amplitude)
    sensor = one_pixel(**fields)
    n = 100_000
    image = one_pixel_image(amplitude, range_m, intensity, sensor)
    frames = capture(image, sensor, rng=np.random.default_rng(20), n_frames=n)
    variance = (
        sensor.shot_noise * (sensor.signal_e * intensity + sensor.ambient_e + sensor.dark_e)
        + 2 * sensor.read_noise_e**2
    )
    law = (
        sensor.metres_per_radian * math.sqrt(variance) / (math.sqrt(2) * sensor.contrast * sensor.signal_e * amplitude)
    )
    assert law / sensor.metres_per_radian < 0.03  # rad: here the law is at most 0.05 % low
    assert predicted_range_std(amplitude, intensity, sensor) == pytest.approx(law, rel=1e-12)
    error = wrapped(frames.range_m.ravel() - range_m, sensor)
    low, high = variance_interval(n, len(NOISE_CELLS))  # ± 1.5 % of the variance
    assert low < error.var(ddof=1) / law**2 < high
    z = stats.norm.ppf(1 - FALSE_ALARM / len(NOISE_CELLS) / 2)
    assert abs(error.mean()) < z * law / math.sqrt(n)


def test_two_centimetres_need_28457_electrons_at_half_contrast():
    sensor = one_pixel(contrast=0.5, signal_e=28_457)
    # PHYSICS section 4 rounds the electrons to whole ones: half of one in 28 457, under a root
    assert predicted_range_std(1.0, 1.0, sensor) == pytest.approx(0.02, rel=1e-5)
    assert predicted_range_std(0.8, 0.8, preset("pmd-16x16")) == pytest.approx(0.02, rel=1e-5)


def test_noise_law_of_measured_electrons_is_the_same_law():
    sensor = one_pixel(contrast=0.3, signal_e=9000, ambient_e=700, dark_e=60, read_noise_e=11)
    amplitude, intensity = np.array([0.2, 0.9, 0.0]), np.array([0.5, 0.9, 0.4])
    measured = measured_range_std(0.3 * 9000 * amplitude, 9000 * intensity + 760, sensor)
    np.testing.assert_allclose(measured, predicted_range_std(amplitude, intensity, sensor), rtol=1e-12)
    assert measured[2] == math.inf


def test_taps_and_phase_images_have_independent_noise_of_the_right_size():
    sensor = one_pixel(contrast=0.6, signal_e=2000, ambient_e=100, dark_e=40, read_noise_e=15)
    n = 50_000
    image = images_of([[[0.8j]]], [[[0.9]]], sensor)
    taps = capture(image, sensor, rng=np.random.default_rng(5), n_frames=n, keep_taps=True).taps_e.reshape(n, 8)
    tau = np.arange(4) * np.pi / 2
    cosine = 0.3 * 2000 * 0.8 * np.cos(np.pi / 2 + tau)
    mean = np.stack([970 + cosine, 970 - cosine], axis=1).ravel()  # ½ (2000 · 0.9 + 100 + 40) ± ½ K N₀ Re[S e^{iτ}]
    variance = mean + 15**2
    n_cells = 8 + 8 + 28
    z = stats.norm.ppf(1 - FALSE_ALARM / n_cells / 2)
    assert (np.abs(taps.mean(axis=0) - mean) < z * np.sqrt(variance / n)).all()
    low, high = variance_interval(n, n_cells)
    ratio = taps.var(axis=0, ddof=1) / variance
    assert ((low < ratio) & (ratio < high)).all()
    correlation = np.asarray(np.corrcoef(taps.T))[np.triu_indices(8, 1)]
    assert (np.abs(correlation) < z / math.sqrt(n)).all()


def test_frames_views_and_pixels_have_independent_noise():
    sensor = preset("pmd-16x16").with_(rows=1, cols=2, read_noise_e=50)
    image = images_of(np.full((2, 1, 2), 0.5), np.full((2, 1, 2), 0.5), sensor)
    n = 20_000
    frames = capture(image, sensor, rng=np.random.default_rng(6), n_frames=2 * n)
    series = wrapped(frames.range_m, sensor).reshape(2, n, 2, 2).transpose(1, 0, 2, 3).reshape(n, 8)
    correlation = np.corrcoef(series.T)[np.triu_indices(8, 1)]
    assert (np.abs(correlation) < stats.norm.ppf(1 - FALSE_ALARM / 28 / 2) / math.sqrt(n)).all()


@pytest.mark.parametrize(
    ("near_m", "far_m", "share", "range_m", "ratio"),
    [
        (3, 6, 0.50, 3.518, 0.882),
        (3, 6, 0.25, 4.253, 0.813),
        (2, 10, 0.25, 1.932, 0.788),
        (5, 12.4, 0.25, 5.090, 0.345),
        (1, 14, 0.25, 0.973, 0.995),
    ],
)
def test_mixed_pixels_keep_their_mixed_range_through_the_taps(near_m, far_m, share, range_m, ratio):
    sensor = one_pixel(signal_e=1e12)
    phasor, intensity = two_surfaces(near_m, far_m, share, sensor)
    frames = capture(images_of([[[phasor]]], [[[intensity]]], sensor), sensor, rng=np.random.default_rng(2))
    assert frames.range_m.item() == pytest.approx(range_m, abs=6e-4)  # the table's last digit, and 5 σ of noise
    measured = frames.amplitude_e.item() / (sensor.contrast * frames.intensity_e.item())
    assert measured == pytest.approx(ratio, abs=6e-4)


def test_range_wraps_at_half_the_modulation_wavelength():
    sensor = preset("ideal").with_(rows=1, cols=1)
    period = 299_792_458 / 2 / 10e6
    frames = capture(one_pixel_image(0.1, period + 0.3, 0.1, sensor), sensor, rng=np.random.default_rng(0))
    assert frames.range_m.item() == pytest.approx(0.3, abs=1e-9)  # rounding of a phase of 2π
    noisy = one_pixel(signal_e=35_571)
    ranges = capture(one_pixel_image(0.8, 0.0, 0.8, noisy), noisy, rng=np.random.default_rng(3), n_frames=1000).range_m
    assert ((ranges >= 0) & (ranges < period)).all()
    assert (ranges < 0.2).any()
    assert (ranges > period - 0.2).any()


@pytest.mark.parametrize("kind", [np.complex128, np.complex64])
def test_ranges_of_a_view_into_an_array_are_those_of_a_copy(kind):
    sensor, rng = preset("pmd-16x16"), np.random.default_rng(2)
    phasor = (rng.normal(size=(6, 16, 16)) + 1j * rng.normal(size=(6, 16, 16))).astype(kind)
    phasor[0, 0, 0] = 0
    for part in (phasor[:, ::2], phasor[1:2, 3], phasor[..., 5]):
        found = phasor_to_range_m(part, sensor)
        np.testing.assert_array_equal(found, phasor_to_range_m(part.copy(), sensor))
        # 2 ulp of a phase: the reference has another arctangent
        exact = np.where(part == 0, np.nan, np.arctan2(part.imag.astype(float), part.real.astype(float)))
        tolerance = 4 * np.finfo(kind).eps * math.pi * sensor.metres_per_radian
        expected = exact * sensor.metres_per_radian % sensor.unambiguous_range_m
        np.testing.assert_allclose(wrapped(found - expected, sensor), np.where(part == 0, np.nan, 0), atol=tolerance)


def test_a_tiny_negative_phase_stays_inside_the_unambiguous_range():
    sensor = preset("ideal")
    assert phasor_to_range_m(np.array([1 - 1e-18j]), sensor)[0] < sensor.unambiguous_range_m


def phase_density(psi, s):
    """Exact density of the phase error of a phasor in Gaussian noise, PHYSICS section 4."""
    root = math.sqrt(s) * np.cos(psi)
    return np.exp(-s) / (2 * np.pi) * (1 + math.sqrt(math.pi) * root * np.exp(root**2) * (1 + special.erf(root)))


@pytest.mark.parametrize("s", [0.5, 2.0, 8.0])
def test_low_signal_has_the_exact_phase_density_and_no_other_bias(s):
    variance = 1e5
    sensor = one_pixel(signal_e=1e4, ambient_e=variance - 1e4 * 0.5, contrast=1.0)
    amplitude = math.sqrt(s * variance) / 1e4
    n = 50_000
    image = one_pixel_image(amplitude, 5.0, 0.5, sensor)
    frames = capture(image, sensor, rng=np.random.default_rng(8), n_frames=n)
    psi = wrapped(frames.range_m.ravel() - 5.0, sensor) / sensor.metres_per_radian
    edges = np.linspace(-np.pi, np.pi, 25)
    expected = np.array([integrate.quad(phase_density, a, b, args=(s,))[0] for a, b in itertools.pairwise(edges)])
    counts, _ = np.histogram(psi, edges)
    keep = expected * n > 5  # χ² needs a few counts in a bin
    chi2 = ((counts - n * expected)[keep] ** 2 / (n * expected)[keep]).sum()
    assert chi2 < stats.chi2.ppf(1 - FALSE_ALARM / 3, keep.sum() - 1)
    assert abs(np.sin(psi).mean()) < stats.norm.ppf(1 - FALSE_ALARM / 6) * np.sin(psi).std() / math.sqrt(n)


def test_no_return_is_flagged_and_has_no_range():
    for sensor in (preset("ideal"), preset("pmd-16x16"), preset("ideal").with_(shot_noise=True, ambient_e=5000)):
        small = sensor.with_(rows=1, cols=2)
        image = images_of([[[0.0, 0.5]]], [[[0.0, 0.5]]], small)
        frames = capture(image, small, rng=np.random.default_rng(0), n_frames=3)
        np.testing.assert_array_equal(frames.flags[..., 0], int(Flag.NO_RETURN))
        assert np.isnan(frames.range_m[..., 0]).all()
        assert frames.valid[..., 1].all()


def test_validity_begins_at_the_stated_phase_noise():
    sensor = one_pixel(shot_noise=False, read_noise_e=1e-9, max_phase_std_rad=0.1, signal_e=1000, ambient_e=0)

    # the variance under the root is 2 σ_r²; at 0.1 rad the amplitude is √2 σ_r / (√2 · 0.1)
    def flags_of(amplitude_e, camera):
        yes, unit = np.array([[True]]), camera_unit(camera)
        values = [np.array([[value]]) for value in amplitude_e]
        return [
            chain.validity_flags(np.ones((1, 1)), value, np.full((1, 1), 500.0), yes, ~yes, unit, camera).item()
            for value in values
        ]

    flags = flags_of([0.999e-8, 1.001e-8], sensor)
    np.testing.assert_array_equal(flags, [int(Flag.NO_RETURN), 0])
    with_shot = sensor.with_(shot_noise=True, read_noise_e=30)
    threshold = math.sqrt(500 + 2 * 30**2) / (math.sqrt(2) * 0.1)
    flags = flags_of([0.999 * threshold, 1.001 * threshold], with_shot)
    np.testing.assert_array_equal(flags, [int(Flag.NO_RETURN), 0])


def test_share_of_valid_frames_near_the_threshold_is_that_of_a_rice_distribution():
    variance, threshold = 1e5, math.sqrt(1e5) / (math.sqrt(2) * 0.1)
    sensor = one_pixel(signal_e=1e4, ambient_e=variance - 1e4 * 0.5, contrast=1.0, max_phase_std_rad=0.1)
    n, factors = 20_000, (0.9, 1.0, 1.1)
    z = stats.norm.ppf(1 - FALSE_ALARM / len(factors) / 2)
    for factor in factors:
        image = one_pixel_image(factor * threshold / 1e4, 5.0, 0.5, sensor)
        frames = capture(image, sensor, rng=np.random.default_rng(9), n_frames=n)
        share = stats.rice.sf(threshold, factor * threshold / math.sqrt(variance / 2), scale=math.sqrt(variance / 2))
        # 0.002: the threshold itself wavers with the measured intensity, 0.08 % of it, 1 % of the amplitude's noise
        assert frames.valid.mean() == pytest.approx(share, abs=z * math.sqrt(share * (1 - share) / n) + 0.002)


def test_without_noise_the_frame_is_the_image():
    sensor = preset("ideal")
    rng = np.random.default_rng(3)
    intensity = rng.uniform(0.1, 1, (2, 16, 16))
    phasor = intensity * np.exp(1j * rng.uniform(0, 6.28, intensity.shape))
    image = images_of(phasor, intensity, sensor)
    frames = capture(image, sensor, rng=rng, n_frames=2)
    np.testing.assert_allclose(frames.range_m, np.stack([image.range_m] * 2, axis=1), rtol=0, atol=1e-12)
    np.testing.assert_allclose(frames.amplitude_e[:, 1], 0.5 * 35_571 * intensity, rtol=1e-12)


def scene(n_views, sensor, seed=11):
    rng = np.random.default_rng(seed)
    intensity = rng.uniform(0.0, 1.0, (n_views, sensor.rows, sensor.cols))
    phasor = 0.9 * intensity * np.exp(1j * rng.uniform(0, 6.28, intensity.shape))
    return images_of(phasor, intensity, sensor)


def frame_bytes(frames):
    return [a.tobytes() for a in (frames.range_m, frames.amplitude_e, frames.intensity_e, frames.flags)]


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others():
    sensor = preset("pmd-16x16").with_(read_noise_e=20, ambient_e=100)
    image = scene(3, sensor)

    def take(seed):
        return frame_bytes(capture(image, sensor, rng=np.random.default_rng(seed), n_frames=5))

    assert take(1) == take(1)
    assert take(1)[0] != take(2)[0]


@pytest.mark.parametrize("block", [1, 8 * 256 * 3, 2**30])
@pytest.mark.parametrize("run", [1, 3])
def test_frames_do_not_depend_on_how_the_work_is_cut(block, run, monkeypatch):
    sensor = preset("pmd-16x16").with_(read_noise_e=20)
    image = scene(4, sensor)
    usual = frame_bytes(capture(image, sensor, rng=np.random.default_rng(1), n_frames=7))
    monkeypatch.setattr(chain, "_TAPS_PER_BLOCK", block)
    monkeypatch.setattr(chain, "_BLOCKS_PER_RUN", run)
    assert frame_bytes(capture(image, sensor, rng=np.random.default_rng(1), n_frames=7)) == usual


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"wrap_guard_m": 1.0},
        {"min_amplitude_e": 3000.0},
        {"full_well_e": 9000.0},
        {"dead_pixels": ((2, 3),), "hot_pixels": ((4, 5),)},
        {"max_phase_std_rad": None, "shot_noise": False},
    ],
)
def test_captured_frames_are_what_the_checks_of_frames_make_of_them(changes):
    sensor = preset("pmd-16x16").with_(**changes)
    taken = capture(scene(3, sensor), sensor, rng=np.random.default_rng(1), n_frames=5, keep_taps=True)
    checked = Frames(
        taken.range_m, taken.amplitude_e, taken.intensity_e, sensor=sensor, flags=taken.flags, taps_e=taken.taps_e
    )
    for name in ("range_m", "amplitude_e", "intensity_e", "flags", "taps_e"):
        np.testing.assert_array_equal(getattr(checked, name), getattr(taken, name), strict=True)
    assert taken.time_s is None
    assert (np.isnan(taken.range_m) == (taken.flags != 0)).all()


def test_a_second_capture_from_the_same_generator_has_new_noise():
    sensor = preset("pmd-16x16")
    image, rng = scene(1, sensor), np.random.default_rng(1)
    assert frame_bytes(capture(image, sensor, rng=rng))[0] != frame_bytes(capture(image, sensor, rng=rng))[0]


def test_switching_read_noise_on_leaves_the_shot_noise_as_it_was():
    quiet = preset("pmd-16x16")
    faint = quiet.with_(read_noise_e=1e-6)
    image = scene(1, quiet)
    first = capture(image, quiet, rng=np.random.default_rng(1), n_frames=2)
    second = capture(image, faint, rng=np.random.default_rng(1), n_frames=2)
    # 1e-6 e- of read noise moves amplitudes by millionths, where other Poisson draws would move them by a hundred
    np.testing.assert_allclose(first.amplitude_e, second.amplitude_e, rtol=0, atol=1e-4)


def test_demodulation_of_equal_taps_is_zero():
    phasor_e, intensity_e = demodulate(np.full((3, 4, 2, 1, 1), 10.0))
    assert (phasor_e == 0).all()
    np.testing.assert_array_equal(intensity_e, 20.0)


def test_full_contrast_on_a_pure_phasor_is_accepted():
    sensor = one_pixel(contrast=1.0)
    image = one_pixel_image(0.7, 0.0, 0.7, sensor)
    assert capture(image, sensor, rng=np.random.default_rng(0), n_frames=10).valid.all()


def test_no_views_give_no_frames():
    sensor = preset("pmd-16x16")
    frames = capture(scene(0, sensor), sensor, rng=np.random.default_rng(0), n_frames=5)
    assert frames.range_m.shape == (0, 5, 16, 16)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rows": 8}, "'rows' is 8 here and 16 there"),
        ({"half_angle_h_deg": 12}, "'half_angle_h_deg' is 12.0 here and 11.0 there"),
        ({"modulation_hz": 2e7}, "'modulation_hz' is 20000000.0 here and 10000000.0 there"),
    ],
)
def test_a_sensor_that_cannot_have_seen_the_image_is_refused(changes, message):
    sensor = preset("pmd-16x16")
    with pytest.raises(UsageError, match=message):
        capture(scene(1, sensor), sensor.with_(**changes), rng=np.random.default_rng(0))


def test_more_electrons_than_a_float_can_count_are_refused():
    sensor = preset("pmd-16x16").with_(signal_e=1e12)
    image = scene(1, sensor)
    with pytest.raises(UsageError, match="more than 2\\^53"):
        capture(replace(image, intensity=1e6 * image.intensity), sensor, rng=np.random.default_rng(0))


@pytest.mark.parametrize("n_frames", [0, -1, 2.5])
def test_the_number_of_frames_must_be_a_positive_whole_number(n_frames):
    sensor = preset("pmd-16x16")
    with pytest.raises(UsageError, match="'n_frames' must be a whole number of at least 1"):
        capture(scene(1, sensor), sensor, rng=np.random.default_rng(0), n_frames=n_frames)


def test_images_that_no_light_can_make_are_refused_by_pixel():
    sensor = preset("pmd-16x16")
    image = scene(2, sensor)
    image.phasor[1, 2, 3] = 5.0
    with pytest.raises(UsageError, match="view 1, row 2, column 3: a tap's mean is negative"):
        capture(image, sensor, rng=np.random.default_rng(0))
    image.phasor[1, 2, 3] = np.nan
    with pytest.raises(UsageError, match="view 1, row 2, column 3: phasor and intensity must be finite"):
        capture(image, sensor, rng=np.random.default_rng(0))
