"""Whether anything moved during the frames of a file: false alarms in closed form, and motion that is found."""

import itertools

import numpy as np
import pytest
from scipy import stats

from phasemark.matcher.recordings import motion_test
from phasemark.matcher.recordings.stillness import _correlations
from phasemark.render import Background, Frames, Renderer, capture, preset

ZONES = preset("vl53l5cx-8x8")
PMD = preset("pmd-16x16")
N = 2000
"""Still recordings of each kind."""


def noise(rng, n_frames, kind):
    """Return still recordings of 8 × 8 zones whose noise is independent."""
    shape = (N, n_frames, 8, 8)
    if kind == "whole millimetres":
        return np.round(0.7 + rng.normal(0, 0.0006, shape), 3)  # many ties
    ranges = 0.7 + rng.normal(0, ZONES.range_std_m, shape)
    return np.where(rng.random(shape) < 0.5, np.nan, ranges) if kind == "half invalid" else ranges


@pytest.mark.parametrize("kind", ["normal", "whole millimetres", "half invalid"])
@pytest.mark.parametrize("n_frames", [4, 12])
def test_still_recordings_are_doubted_no_more_often_than_stated(kind, n_frames):
    rng = np.random.default_rng(20)
    test = motion_test(Frames(noise(rng, n_frames, kind), sensor=ZONES))
    for false_alarm in (0.001, 0.01, 0.1):
        count = int((test.p_value < false_alarm).sum())
        # 99.9 % corrected for 18 cells; the p-value is that of three tests, one of them silent here
        assert count <= stats.binom.isf(1e-3 / 18, N, false_alarm)
    assert (test.p_value < 0.1).mean() > 0.01 or n_frames == 4  # it is a test, not silence


@pytest.mark.parametrize("values", [[0, 1, 2], [1, 2, 2, 7], [3.0, 1.0, 4.0, 1.5, 9.0], [0, 0, 0, 1, 1]])
def test_mean_and_variance_of_the_correlation_are_those_of_all_orders(values, monkeypatch):
    monkeypatch.setattr("phasemark.matcher.recordings.stillness.FEWEST_FOR_ORDER", 3)
    series = np.array(list(itertools.permutations(values)), dtype=float).T
    correlation, variance = _correlations(series)
    np.testing.assert_allclose(variance, correlation.var(), rtol=1e-12)
    assert correlation.mean() == pytest.approx(0.0, abs=1e-12)


def test_the_correlation_is_von_neumanns_ratio_of_the_ranks():
    values = np.random.default_rng(3).normal(size=(9, 5))
    values[2, 1] = np.nan
    for k, found in enumerate(_correlations(values)[0]):
        ranks = stats.rankdata(values[np.isfinite(values[:, k]), k])
        expected = 1 - np.sum(np.diff(ranks) ** 2) / (2 * np.sum((ranks - ranks.mean()) ** 2))
        assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("n_frames", [6, 20, 100])
def test_a_drive_of_a_few_standard_deviations_is_found_in_every_recording(n_frames):
    rng = np.random.default_rng(21)
    # 3 σ from the first frame to the last, less than the noise of two neighbours
    drive = np.linspace(0, 3 * ZONES.range_std_m, n_frames)[:, None, None]
    test = motion_test(Frames(noise(rng, n_frames, "normal")[:200] + drive, sensor=ZONES))
    assert (test.p_value < 0.001).all()


def test_one_frame_of_another_place_is_found_though_its_pixels_scatter_little():
    ranges = noise(np.random.default_rng(24), 20, "normal")[:200]
    ranges[:, 7] += 1.5 * ZONES.range_std_m
    assert (motion_test(Frames(ranges, sensor=ZONES)).p_value < 0.001).all()


def test_pixels_that_show_one_value_have_not_moved():
    ranges = noise(np.random.default_rng(25), 12, "normal")[:500]
    ranges[:, :, :4] = 0.83
    assert (motion_test(Frames(ranges, sensor=ZONES)).p_value < 0.001).sum() <= 5  # 0.5 expected


def test_positions_in_no_order_are_found_by_their_scatter():
    rng = np.random.default_rng(22)
    ranges = noise(rng, 3, "normal")[:200] + rng.normal(0, 0.1, (200, 3, 1, 1))
    test = motion_test(Frames(ranges, sensor=ZONES))
    # three distances have a variance below 4 σ² = (8 mm)² with probability 1 − exp(−(8/100)²) = 0.6 %: 1.3 of 200
    assert (test.p_value >= 0.001).sum() <= 6


def test_frames_of_a_modulated_camera_are_judged_by_the_noise_of_each_pixel():
    image = Renderer(None, PMD).render(1.0, background=Background(wall_m=2.0))
    wrapping = Renderer(None, PMD).render(1.0, background=Background(wall_m=PMD.unambiguous_range_m / 1.02))
    for still in (image, wrapping):
        test = motion_test(capture(still, PMD, rng=np.random.default_rng(5), n_frames=30))
        assert test.p_value > 0.001
    assert motion_test(capture(image, PMD, rng=np.random.default_rng(5), n_frames=30)).excess_scatter == pytest.approx(
        1.0, abs=0.05
    )  # median of 256 pixels of 29 degrees of freedom: ± 0.01
    walls = [Renderer(None, PMD).render(1.0, background=Background(wall_m=2.0 + 0.01 * k)) for k in range(30)]
    moving = [capture(wall, PMD, rng=np.random.default_rng(k)) for k, wall in enumerate(walls)]
    frames = Frames(
        *(np.concatenate([getattr(one, name) for one in moving], axis=1) for name in ("range_m", "amplitude_e")),
        intensity_e=np.concatenate([one.intensity_e for one in moving], axis=1),
        sensor=PMD,
    )
    assert motion_test(frames).p_value < 1e-6


def test_too_few_frames_say_nothing_and_the_false_alarm_is_that_of_all_positions_of_a_file():
    test = motion_test(Frames(np.full((2, 1, 8, 8), 0.7), sensor=ZONES))
    assert test.p_value.tolist() == [1.0, 1.0]
    assert np.isnan(test.correlation).all()
    assert not test.moved().any()
    empty = motion_test(Frames(np.full((1, 9, 8, 8), np.nan), sensor=ZONES))
    assert empty.p_value.tolist() == [1.0]
    rng = np.random.default_rng(23)
    test = motion_test(Frames(noise(rng, 8, "normal")[:1000], sensor=ZONES))
    assert test.moved(0.5).sum() <= 5  # 0.5 expected at most; more than 5 in one of 10⁵ files
