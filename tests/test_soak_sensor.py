"""The long tables of the sensor, run by ``make soak``."""

import itertools
import math

import numpy as np
import pytest
from builders import images_of, one_pixel, pure_image, wrapped
from oracles.noise_law import FALSE_ALARM, exact_over_law, noise_table, phase_density
from scipy import integrate, stats

from phasemark.render import capture
from phasemark.render.exposure import photoelectrons as read_out

pytestmark = pytest.mark.soak

CELLS = noise_table()
N = 200_000


def test_the_noise_table_has_thirty_cells_and_more():
    assert len(CELLS) >= 30


@pytest.mark.parametrize("cell", range(len(CELLS)))
def test_range_noise_meets_the_law_within_one_percent(cell):
    # N = 200 000 a cell: σ is known to 1/√2N = 0.16 %. The exact density must lie in the 99.9 % interval over all
    # cells; the law is its limit of high signal, 0.8 % low at 0.3 m
    sensor, range_m, amplitude, law = CELLS[cell]
    rng = np.random.default_rng([41, cell])
    image = pure_image(range_m, sensor, amplitude)
    std = wrapped(capture(image, sensor, rng=rng, n_frames=N).range_m - range_m, sensor).std(ddof=1)
    tail = FALSE_ALARM / len(CELLS) / 2
    low, high = np.sqrt(stats.chi2.ppf([tail, 1 - tail], N - 1) / (N - 1))
    assert low < std / (law * exact_over_law(law / sensor.metres_per_radian)) < high
    assert std / law == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("s", [0.5, 2.0, 8.0, 30.0])
def test_low_signal_has_the_exact_phase_density(s):
    # N = 500 000, 41 bins; taps of about 450 electrons, drawn from the Poisson distribution itself
    n, variance = 500_000, 900.0
    sensor = one_pixel(signal_e=1000, ambient_e=variance - 500, contrast=1.0)
    amplitude = math.sqrt(s * variance) / 1000
    image = pure_image(5.0, sensor, amplitude, intensity=0.5)
    frames = capture(image, sensor, rng=np.random.default_rng(8), n_frames=n)
    psi = wrapped(frames.range_m.ravel() - 5.0, sensor) / sensor.metres_per_radian
    edges = np.linspace(-np.pi, np.pi, 42)
    expected = n * np.array(
        [integrate.quad(lambda psi: float(phase_density(psi, s)), a, b)[0] for a, b in itertools.pairwise(edges)]
    )
    counts, _ = np.histogram(psi[np.isfinite(psi)], edges)
    keep = expected > 5
    chi2 = ((counts - expected)[keep] ** 2 / expected[keep]).sum()
    assert chi2 < stats.chi2.ppf(1 - FALSE_ALARM / 4, keep.sum() - 1)


@pytest.mark.parametrize("mean", [300.0, 499.0, 501.0, 700.0, 2000.0])
def test_the_switch_from_poisson_to_normal_cannot_be_seen_in_the_range(mean):
    # against NumPy's Poisson generator alone, N = 200 000 each, Kolmogorov and Smirnov's test of two samples
    sensor = one_pixel(ambient_e=2 * mean, contrast=1.0, signal_e=2 * mean)
    image = pure_image(3.0, sensor, 0.3, intensity=0.3)
    drawn = capture(image, sensor, rng=np.random.default_rng(1), n_frames=N).range_m.ravel()
    reference = np.random.default_rng(3)
    taps = 0.5 * sensor.signal_e * 0.3 + 0.5 * sensor.ambient_e
    phase = 3.0 / sensor.metres_per_radian + np.arange(4) * np.pi / 2
    swing = 0.5 * sensor.signal_e * 0.3 * np.cos(phase)
    d = reference.poisson(taps + swing, (N, 4)) - reference.poisson(taps - swing, (N, 4))
    exact = np.arctan2(d[:, 3] - d[:, 1], d[:, 0] - d[:, 2]) % (2 * np.pi) * sensor.metres_per_radian
    assert stats.ks_2samp(drawn, exact).pvalue > FALSE_ALARM / 5
    assert read_out.EXACT_POISSON_BELOW == 500.0  # the means above stand on both sides of it


def test_photon_transfer_has_the_slope_of_the_gain_within_one_percent():
    gain, n = 0.05, 2_000_000
    mean_e = np.array([300.0, 1000, 4000, 16_000, 40_000, 70_000])
    variance = []
    for k, mean in enumerate(mean_e):
        sensor = one_pixel(ambient_e=2 * mean, read_noise_e=30.0, adc_bits=12, gain=gain, black_level=50.0)
        image = images_of([[[0j]]], [[[0.0]]], sensor)
        rng = np.random.default_rng([5, k])
        variance.append((capture(image, sensor, rng=rng, n_frames=n // 8, keep_taps=True).taps_e * gain).var())
    slope, offset = np.polyfit(gain * mean_e, variance, 1, w=1 / np.array(variance))
    assert slope == pytest.approx(gain, rel=0.003)  # 1/√N of the brightest
    assert offset == pytest.approx((gain * 30) ** 2 + 1 / 12, rel=0.02)
