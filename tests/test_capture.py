import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from builders import images_of, one_pixel, pure_image, wrapped
from oracles.noise_law import FALSE_ALARM, exact_over_law, noise_law_m, noise_table, phase_density
from scipy import integrate, stats

from phasemark import UsageError
from phasemark.render import (
    Flag,
    Frames,
    capture,
    measured_range_std,
    phasor_to_range_m,
    predicted_range_std,
    preset,
)
from phasemark.render.exposure.taps import tap_means


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


def test_mean_amplitude_and_intensity_are_those_of_the_light():
    sensor = one_pixel(contrast=0.4, signal_e=50_000, ambient_e=3000, dark_e=500, read_noise_e=20)
    n = 50_000
    frames = capture(pure_image(4.0, sensor, 0.7, 0.8), sensor, rng=np.random.default_rng(1), n_frames=n)
    variance = 50_000 * 0.8 + 3500 + 2 * 20**2
    amplitude = 0.4 * 50_000 * 0.7
    z = stats.norm.ppf(1 - FALSE_ALARM / 4)
    # Rice's mean: the noise across the phasor lengthens it, here by 0.8 e-.
    expected = amplitude + variance / (4 * amplitude)
    assert frames.amplitude_e.mean() == pytest.approx(expected, abs=z * math.sqrt(variance / 2 / n))
    assert frames.intensity_e.mean() == pytest.approx(43_500, abs=z * math.sqrt(variance / 4 / n))


TABLE = noise_table()  # 30 cells and more
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
    {"ambient_e": 20_000, "adc_bits": 12, "gain": 0.05, "black_level": 100.0},
]


@pytest.mark.parametrize("cell", NOISE_CELLS, ids=lambda cell: " ".join(f"{k}={v:g}" for k, v in cell.items()))
def test_range_noise_meets_the_law(cell):
    fields = dict(cell)
    amplitude, range_m = fields.pop("amplitude", 0.8), fields.pop("range_m", 1.0)
    intensity = max(0.8, amplitude)
    sensor = one_pixel(**fields)
    n = 100_000
    image = pure_image(range_m, sensor, amplitude, intensity)
    frames = capture(image, sensor, rng=np.random.default_rng(20), n_frames=n)
    law = noise_law_m(sensor, amplitude, intensity)
    assert law / sensor.metres_per_radian < 0.03  # rad: here the law is at most 0.05 % low
    assert predicted_range_std(amplitude, intensity, sensor) == pytest.approx(law, rel=1e-12)
    error = wrapped(frames.range_m.ravel() - range_m, sensor)
    low, high = variance_interval(n, len(NOISE_CELLS))  # ± 1.5 % of the variance
    assert low < error.var(ddof=1) / law**2 < high
    z = stats.norm.ppf(1 - FALSE_ALARM / len(NOISE_CELLS) / 2)
    assert abs(error.mean()) < z * law / math.sqrt(n)


@pytest.mark.soak
@pytest.mark.parametrize("cell", range(len(TABLE)))
def test_range_noise_meets_the_law_within_one_percent(cell):
    # N = 200 000 a cell: σ is known to 1/√2N = 0.16 %. The exact density must lie in the 99.9 % interval over all
    # cells; the law is its limit of high signal, 0.8 % low at 0.3 m
    (sensor, range_m, amplitude, law), n = TABLE[cell], 200_000
    frames = capture(pure_image(range_m, sensor, amplitude), sensor, rng=np.random.default_rng([41, cell]), n_frames=n)
    std = wrapped(frames.range_m - range_m, sensor).std(ddof=1)
    low, high = np.sqrt(variance_interval(n, len(TABLE)))
    assert low < std / (law * exact_over_law(law / sensor.metres_per_radian)) < high
    assert std / law == pytest.approx(1, abs=0.01)


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


def test_frames_views_pixels_and_seeds_have_independent_noise():
    sensor = preset("pmd-16x16").with_(rows=1, cols=2, read_noise_e=50)
    image = images_of(np.full((2, 1, 2), 0.5), np.full((2, 1, 2), 0.5), sensor)
    n = 20_000
    taken = [capture(image, sensor, rng=np.random.default_rng(seed), n_frames=2 * n).range_m for seed in (6, 7)]
    series = np.hstack([wrapped(one, sensor).reshape(2, n, 4).transpose(1, 0, 2).reshape(n, 8) for one in taken])
    correlation = np.corrcoef(series.T)[np.triu_indices(16, 1)]
    assert (np.abs(correlation) < stats.norm.ppf(1 - FALSE_ALARM / 120 / 2) / math.sqrt(n)).all()


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
    frames = capture(pure_image(period + 0.3, sensor, 0.1, 0.1), sensor, rng=np.random.default_rng(0))
    assert frames.range_m.item() == pytest.approx(0.3, abs=1e-9)  # rounding of a phase of 2π
    noisy = one_pixel(signal_e=35_571)
    ranges = capture(pure_image(0.0, noisy, 0.8, 0.8), noisy, rng=np.random.default_rng(3), n_frames=1000).range_m
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


@pytest.mark.parametrize(
    ("s", "signal_e", "variance", "n", "bins"),
    [
        *((s, 1e4, 1e5, 50_000, 24) for s in (0.5, 2.0, 8.0)),
        # taps of about 450 electrons, drawn from the Poisson distribution itself
        *(pytest.param(s, 1e3, 900.0, 500_000, 41, marks=pytest.mark.soak) for s in (0.5, 2.0, 8.0, 30.0)),
    ],
)
def test_low_signal_has_the_exact_phase_density_and_no_other_bias(s, signal_e, variance, n, bins):
    sensor = one_pixel(signal_e=signal_e, ambient_e=variance - 0.5 * signal_e, contrast=1.0)
    image = pure_image(5.0, sensor, math.sqrt(s * variance) / signal_e, 0.5)
    frames = capture(image, sensor, rng=np.random.default_rng(8), n_frames=n)
    psi = wrapped(frames.range_m.ravel() - 5.0, sensor) / sensor.metres_per_radian
    edges = np.linspace(-np.pi, np.pi, bins + 1)
    pieces = itertools.pairwise(edges)
    expected = np.array([integrate.quad(lambda x: float(phase_density(x, s)), a, b)[0] for a, b in pieces])
    psi = psi[np.isfinite(psi)]  # a phasor of 0 has no range
    counts, _ = np.histogram(psi, edges)
    keep = expected * n > 5  # χ² needs a few counts in a bin
    chi2 = ((counts - n * expected)[keep] ** 2 / (n * expected)[keep]).sum()
    assert chi2 < stats.chi2.ppf(1 - FALSE_ALARM / 4, keep.sum() - 1)
    assert abs(np.sin(psi).mean()) < stats.norm.ppf(1 - FALSE_ALARM / 8) * np.sin(psi).std() / math.sqrt(n)


def test_no_return_is_flagged_and_has_no_range():
    for sensor in (preset("ideal"), preset("pmd-16x16"), preset("ideal").with_(shot_noise=True, ambient_e=5000)):
        small = sensor.with_(rows=1, cols=2)
        image = images_of([[[0.0, 0.5]]], [[[0.0, 0.5]]], small)
        frames = capture(image, small, rng=np.random.default_rng(0), n_frames=3)
        np.testing.assert_array_equal(frames.flags[..., 0], int(Flag.NO_RETURN))
        assert np.isnan(frames.range_m[..., 0]).all()
        assert frames.valid[..., 1].all()


def test_share_of_valid_frames_near_the_threshold_is_that_of_a_rice_distribution():
    variance, threshold = 1e5, math.sqrt(1e5) / (math.sqrt(2) * 0.1)
    light_e = variance - 2 * 100**2  # the rest is read noise
    sensor = one_pixel(
        signal_e=1e4, ambient_e=light_e - 1e4 * 0.5, read_noise_e=100, contrast=1.0, max_phase_std_rad=0.1
    )
    n, factors = 20_000, (0.9, 1.0, 1.1)
    z = stats.norm.ppf(1 - FALSE_ALARM / len(factors) / 2)
    for factor in factors:
        image = pure_image(5.0, sensor, factor * threshold / 1e4, 0.5)
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


def test_switching_read_noise_on_leaves_the_shot_noise_as_it_was():
    quiet = preset("pmd-16x16")
    faint = quiet.with_(read_noise_e=1e-6)
    image = scene(1, quiet)
    first = capture(image, quiet, rng=np.random.default_rng(1), n_frames=2)
    second = capture(image, faint, rng=np.random.default_rng(1), n_frames=2)
    # 1e-6 e- of read noise moves amplitudes by millionths, where other Poisson draws would move them by a hundred
    np.testing.assert_allclose(first.amplitude_e, second.amplitude_e, rtol=0, atol=1e-4)


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
