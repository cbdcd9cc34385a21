"""Counts drawn from their expectation, and the chip's targets: centroid, parabola and merging against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import chi2

from phasemark import UsageError
from phasemark.cli import main
from phasemark.data import BankPlan
from phasemark.render import Sensor, preset
from phasemark.render.direct.histogram_frames import HistogramFrames, capture_histograms
from phasemark.render.direct.targets import Status, find_targets
from phasemark.render.sensor.sensor_file import sensor_toml

SIGMA_BINS = 1.5
WIDTH_M = 0.0137
FIRST = "position 0, frame 0, row 0, column 0"


def one_zone(**changes: object) -> Sensor:
    histogram = {
        "bins": 128, "bin_width_m": WIDTH_M, "cycles": 1e9, "photons": 0.01, "irf_std_m": SIGMA_BINS * WIDTH_M,
        "pile_up": False, **changes,
    }  # fmt: skip
    return Sensor(
        kind="direct", rows=1, cols=1, half_angle_h_deg=1, half_angle_v_deg=1, modulation_hz=1e3, histogram=histogram
    )


def gaussian_counts(places_bins: list[float], counts: float, ambient: float) -> np.ndarray:
    edges = np.arange(129)
    each = [np.diff(ndtr((edges - x) / SIGMA_BINS)) for x in places_bins]
    return np.asarray(ambient + counts * np.sum(each, axis=0))


def test_counts_have_the_mean_and_the_variance_of_poisson() -> None:
    means = np.array([0.0, 0.3, 4.0, 9.9, 10.0, 60.0, 499.0, 501.0, 2e4])
    row = np.zeros(128)
    row[: len(means)] = means
    n = 20_000
    frames = capture_histograms(row[None, None], one_zone(), rng=np.random.default_rng(3), n_frames=n)
    got = frames.counts.reshape(n, 128)[:, : len(means)]
    sigma = np.sqrt(means / n)
    assert (np.abs(got.mean(axis=0) - means) <= 4 * sigma).all()  # 9 cells at 99.9 % need 3.9
    low, high = chi2.ppf([5e-5, 1 - 5e-5], n - 1) / (n - 1)
    lit = means > 3  # the variance of fewer counts is not that of a normal
    ratio = got.var(axis=0, ddof=1)[lit] / means[lit]
    assert ((ratio > low) & (ratio < high)).all()
    assert (got == np.rint(got)).all()


def centroid(mean: np.ndarray, top: int) -> float:
    window, middle = slice(top - 4, top + 5), np.arange(128) + 0.5
    return float(mean[window] @ middle[window] / mean[window].sum())


def parabola(mean: np.ndarray, top: int) -> float:
    a, b, c = mean[top - 1 : top + 2]
    return float(top + 0.5 + 0.5 * (a - c) / (a - 2 * b + c))


@pytest.mark.parametrize(
    ("estimator", "closed_form", "where", "counts"),
    [("centroid", centroid, where, 4e4) for where in (40.0, 40.27, 40.5)]
    # the law of a parabola is of first order: bright enough for it
    + [("parabola", parabola, where, 4e6) for where in (40.3, 40.5, 40.7)],
)
def test_estimate_of_a_peak_is_its_closed_form_and_its_spread_is_its_sigma(
    estimator: str, closed_form: Callable[[np.ndarray, int], float], where: float, counts: float
) -> None:
    n, signal = 3000, gaussian_counts([where], counts, 0.0)
    sensor = one_zone(estimator=estimator, estimator_bins=4)
    frames = capture_histograms(signal[None, None] + 25.0, sensor, rng=np.random.default_rng(11), n_frames=n)
    targets = find_targets(frames)
    place = targets.distance_m.ravel() / WIDTH_M
    tops = frames.counts.reshape(n, 128).argmax(axis=1)
    sigma_bins = targets.sigma_m.mean() / WIDTH_M
    assert abs(place.mean() - np.mean([closed_form(signal, top) for top in tops])) < 3 * sigma_bins / np.sqrt(n)
    low, high = chi2.ppf([5e-4, 1 - 5e-4], n - 1) / (n - 1)
    if len(set(tops)) == 1:  # otherwise the window itself moves
        assert low < place.var(ddof=1) / sigma_bins**2 < high


def test_two_equal_targets_merge_below_two_sigma_of_the_response() -> None:
    # the sum of two Gaussians s apart has one maximum if s ≤ 2 σ; bins add 1/12 to the variance
    sensor = one_zone(max_targets=2, estimator="parabola")
    limit = 2 * np.sqrt(SIGMA_BINS**2 + 1 / 12)
    n = 200

    def targets_at(distance_bins: float) -> np.ndarray:
        mean = gaussian_counts([60.5 - distance_bins / 2, 60.5 + distance_bins / 2], 1e9, 10.0)
        frames = capture_histograms(mean[None, None], sensor, rng=np.random.default_rng(2), n_frames=n)
        return np.asarray((find_targets(frames).status == Status.VALID).sum(axis=-1).ravel())

    assert (targets_at(0.9 * limit) == 1).all()
    assert (targets_at(limit + 2.0) == 2).all()  # a minimum between two bins needs a bin between them


def test_targets_come_nearest_first_and_at_least_the_separation_apart() -> None:
    mean = gaussian_counts([70.2, 30.4, 52.1], 5e3, 10.0)
    mean += gaussian_counts([52.1], 3e3, 0.0)  # the highest is in the middle
    frames = HistogramFrames(mean.round()[None, None], sensor=one_zone(max_targets=4))
    found = find_targets(frames)
    valid = found.status[0, 0, 0, 0] == Status.VALID
    assert valid.sum() == 3
    assert (
        np.abs(found.distance_m[0, 0, 0, 0, :3] / WIDTH_M - [30.4, 52.1, 70.2]).max() < 0.2
    )  # the window cuts the peak
    near = find_targets(
        HistogramFrames(mean.round()[None, None], sensor=one_zone(max_targets=4, min_separation_m=0.26))
    )
    assert np.abs(near.distance_m[0, 0, 0, 0, :2] / WIDTH_M - [30.4, 52.1]).max() < 0.2
    assert (near.status[0, 0, 0, 0] == Status.VALID).sum() == 2


def test_nothing_above_the_threshold_is_no_target() -> None:
    dark = np.full((1, 1, 128), 20.0)
    found = find_targets(capture_histograms(dark, one_zone(threshold=8.0), rng=np.random.default_rng(1), n_frames=50))
    assert (found.status == Status.NO_TARGET).all()
    assert np.isnan(found.distance_m).all()


@pytest.mark.parametrize("more", [-4.0, 0.0, 4.0])
def test_a_bin_whose_neighbours_are_too_dark_to_place_it_is_no_target(more: float) -> None:
    """The counts above ambient add up to −4, 0 and 4: their centroid is at bin 41, at infinity and at bin 26."""
    counts = np.full(128, 10.0)
    counts[30:34] = 30.0, 0.0, 0.0, 10.0 + more
    counts[100] = 60.0
    sensor = one_zone(max_targets=4, estimator="centroid", estimator_bins=3, threshold=5.0)
    found = find_targets(HistogramFrames(counts[None, None, None, None], sensor=sensor))
    valid = found.status.ravel() == Status.VALID
    np.testing.assert_allclose(found.distance_m.ravel()[valid], 100.5 * WIDTH_M)
    assert np.isnan(found.sigma_m.ravel()[~valid]).all()
    assert (found.signal.ravel()[~valid] == 0).all()


def test_z_is_the_range_times_the_cosine_of_the_zone() -> None:
    wide = {"half_angle_h_deg": 30, "half_angle_v_deg": 30, "cols": 2}
    mean = np.repeat(gaussian_counts([50.0], 1e4, 5.0)[None], 2, axis=0)[None]
    ranges, zs = (
        find_targets(HistogramFrames(mean, sensor=one_zone(reports=kind).with_(**wide))).distance_m
        for kind in ("range", "z")
    )
    np.testing.assert_allclose(zs / ranges, 1 / np.sqrt(1 + (np.tan(np.pi / 6) / 2) ** 2), rtol=1e-12)


@pytest.mark.parametrize(
    ("counts", "sensor", "message"),
    [
        (np.zeros((1, 1, 64)), {}, "the histograms have 64 bins, but the sensor has 128"),
        (np.zeros((2, 1, 128)), {}, "the histograms have 2 × 1 zones, but the sensor has 1 × 1"),
        (np.full((1, 1, 128), -3.0), {}, f"counts must not be negative, {FIRST}, bin 0 has -3"),
        (np.full((1, 1, 128), np.nan), {}, f"counts must not be negative, {FIRST}, bin 0 has"),
        (np.full((1, 1, 128), 10.0), {"pile_up": True, "cycles": 1000}, f"a histogram is saturated: {FIRST} has 1280"),
        (np.zeros((1, 1, 128)), None, r"the sensor has no \[histogram\] table"),
    ],
)
def test_histograms_that_cannot_be_are_refused_in_one_line(
    counts: np.ndarray, sensor: dict[str, object] | None, message: str
) -> None:
    with pytest.raises(UsageError, match="^" + message):
        HistogramFrames(counts, sensor=one_zone().with_(histogram=None) if sensor is None else one_zone(**sensor))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"irf_std_m": 1.0}, "'irf_std_m' must describe a response narrower than the histogram"),
        ({"irf_std_m": None}, "'irf_std_m' or 'irf' must be given, one of the two, got neither"),
        ({"irf_step_m": 0.1}, "'irf_step_m' must be left out for a Gaussian response"),
        ({"bins": 4}, "'bins' must be"),
        ({"zone_gain": [[1.0, 1.0]]}, "'histogram.zone_gain' must have 1 rows of 1 numbers, got 1 rows of 2"),
        ({"zone_order": [1]}, "'histogram.zone_order' must hold each number from 0 to 0 once"),
        ({"width": 1}, "'width' is no key of"),
    ],
)
def test_a_histogram_table_that_contradicts_itself_is_refused_in_one_line(
    changes: dict[str, object], message: str
) -> None:
    with pytest.raises(UsageError, match=message) as error:
        one_zone(**changes)
    assert "\n" not in str(error.value)


def test_options_of_one_kind_of_sensor_are_refused_on_the_other() -> None:
    with pytest.raises(UsageError, match="'contrast' must be left out for 'kind' = 'direct'"):
        one_zone().with_(contrast=0.4)
    with pytest.raises(UsageError, match="'histogram' must be left out for 'kind' = 'phase', got a table"):
        Sensor(rows=4, cols=4, half_angle_h_deg=11, half_angle_v_deg=11, histogram=one_zone().histogram)


def test_a_sensor_without_histograms_is_written_as_it_was_before_there_were_any() -> None:
    assert "histogram" not in one_zone().with_(histogram=None).model_dump(mode="json")


@pytest.mark.parametrize(
    "name", ["vl53l5cx-8x8", "vl53l5cx-4x4", "vl53l8cx-8x8", "tmf8820-3x3", "tmf8828-8x8", "tmf8829-16x16"]
)
def test_what_sensor_show_prints_of_a_direct_sensor_is_its_file_again(
    name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    main(["sensor", "show", name])
    path = tmp_path / "shown.toml"
    path.write_text(capsys.readouterr().out, encoding="utf-8")
    assert Sensor.from_toml(path) == preset(name)
    path.write_text(sensor_toml(preset(name), {}, header=(), otherwise="stated"), encoding="utf-8")
    assert Sensor.from_toml(path) == preset(name)


def test_a_resolved_plan_without_histograms_needs_no_sensor_file() -> None:
    stated = preset("pmd-16x16").model_dump(mode="json")
    assert BankPlan(sensor="gone.toml", sensor_overrides=stated).build_sensor() == preset("pmd-16x16")
    old = preset("vl53l5cx-8x8").with_(histogram=None)  # as banks of it were before it had a table
    assert BankPlan(sensor="vl53l5cx-8x8", sensor_overrides=old.model_dump(mode="json")).build_sensor() == old
