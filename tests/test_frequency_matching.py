"""Filters, bounds and matching of cameras with several modulation frequencies (PHYSICS section 10)."""

import numpy as np
import pytest
from builders import wrapped
from scipy import stats

from phasemark import UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import PixelKalman, kalman_filter, phasor_mean
from phasemark.matcher.filters.filtered_frames import PixelState, noise_free
from phasemark.render import Background, Frames, Renderer, capture, predicted_range_std, preset

PMD = preset("pmd-16x16")
TWO = PMD.with_(modulation_hz=[20e6, 60e6])
CYLINDER = build_mesh(catalog()["cylinder"])


def take(image, sensor, n_frames, seed=1):
    return capture(image, sensor, rng=np.random.default_rng(seed), n_frames=n_frames)


# Filters


@pytest.fixture(scope="module")
def wall():
    return Renderer(None, TWO).render(np.ones(20), background=Background(wall_m=5.8))


@pytest.mark.parametrize("filter_frames", [kalman_filter, phasor_mean])
def test_filtered_ranges_are_unwrapped_with_the_variance_of_the_filter(wall, filter_frames):
    filtered = filter_frames(take(wall, TWO.with_(max_phase_std_rad=None), 40))
    assert (filtered.state == PixelState.RETURN).mean() > 0.999
    law = sum(predicted_range_std(p.amplitude, p.intensity, p.sensor) ** -2.0 for p in wall.by_frequency) * 40
    error = (filtered.range_m - wall.range_m)[filtered.state == PixelState.RETURN]
    np.testing.assert_allclose(np.nanmedian(filtered.std_m**2 * law), 1.0, rtol=0.02)
    whitened = error * np.sqrt(law[filtered.state == PixelState.RETURN])
    low, high = stats.chi2.interval(0.999, error.size)
    # σ_φ is 0.05 rad here, and the law is 0.1 % low
    assert low <= np.sum(whitened**2) / 1.004 <= high


def test_the_recursive_filter_gives_what_the_batch_gives(wall):
    frames = take(wall, TWO, 5)
    one = PixelKalman(TWO)
    for k in range(5):
        one.update(frames.some_frames(k, k + 1))
    batch = kalman_filter(frames)
    np.testing.assert_allclose(one.result().range_m, batch.range_m, rtol=1e-12)
    np.testing.assert_array_equal(one.result().state, batch.state)


def test_mixed_pixels_are_missing_and_each_frequency_keeps_them():
    image = Renderer(CYLINDER, TWO).render(1.0, 0.3, background=Background(wall_m=3.0))
    filtered = kalman_filter(take(image, TWO, 50))
    mixed = (image.coverage[0] > 0.1) & (image.coverage[0] < 0.9)
    assert (filtered.state[0][mixed] == PixelState.MISSING).mean() > 0.9
    assert all((part.state[0][mixed] == PixelState.RETURN).mean() > 0.9 for part in filtered.by_frequency)
    assert [part.range_m.shape for part in filtered[:1].by_frequency] == [(1, 16, 16)] * 2


def test_unwrapped_ranges_alone_are_filtered_by_their_scatter(wall):
    frames = take(wall, TWO, 30)
    alone = Frames(frames.range_m, frames.amplitude_e, frames.intensity_e, flags=frames.flags, sensor=TWO)
    filtered = kalman_filter(alone)
    assert filtered.std_from_scatter
    np.testing.assert_allclose(np.nanmedian(filtered.std_m / kalman_filter(frames).std_m), 1.0, rtol=0.1)
    with pytest.raises(UsageError, match="unwrapped ranges alone"):
        phasor_mean(alone)


def test_the_offset_is_taken_off_every_frequency(wall):
    late = TWO.with_(range_offset_m=1.9)
    filtered = kalman_filter(take(wall, late, 5)).without_offset()
    for part, image in zip(filtered.by_frequency, wall.by_frequency, strict=True):
        assert np.nanmax(np.abs(wrapped(part.range_m - image.range_m, part.sensor))) < 6 * np.nanmax(part.std_m)
    assert np.nanmax(np.abs(filtered.range_m - wall.range_m)) < 6 * np.nanmax(filtered.std_m)


def test_frames_without_noise_have_the_exact_range(wall):
    filtered = noise_free(wall, 50)
    np.testing.assert_allclose(filtered.range_m, wall.range_m, atol=1e-9)
