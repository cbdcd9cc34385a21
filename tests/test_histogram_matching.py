"""Matching histograms and targets of direct sensors: bound, honest covariance, classes, and what must be refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from direct_landmarks import (
    CLASSES,
    FREE,
    SENSOR,
    bank_of,
    check_bound,
    frames_of,
    matcher_of,
    random_views,
    renderer_of,
    right_answers,
    trials,
)
from oracles.simple_scenes import block_on_table, poses_around
from scipy.stats import binom, chi2, kstest, poisson

from phasemark import UsageError
from phasemark.data import BankPlan, build_bank
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher, Matches, SearchPolicy, cramer_rao, kalman_filter
from phasemark.matcher.estimate.acceptance import Rules
from phasemark.matcher.histograms.cost_shape import axes_of_parameters, lessened, points_along, principal_axes
from phasemark.matcher.histograms.histogram_matcher import HistogramMatcher
from phasemark.matcher.histograms.poisson_fit import deviance_moments, deviance_test, frame_sums, moments_of
from phasemark.matcher.histograms.target_matcher import TargetMatcher, _Fit
from phasemark.matcher.histograms.view_answers import Explanation, FitTest, answer_from
from phasemark.matcher.matcher import Measured
from phasemark.matcher.statistics import nees, view_errors
from phasemark.render import Background, Frames, Views, capture, preset
from phasemark.render.direct import HistogramFrames, HistogramRenderer, Targets, capture_histograms
from phasemark.render.direct.bin_counts import detected_counts, piled_up, signal_counts
from phasemark.render.direct.expected_targets import expected_targets
from phasemark.render.direct.footprints import footprint_grid
from phasemark.render.direct.recordings import world2cam
from phasemark.render.direct.sample_counts import signal_of_samples
from phasemark.render.direct.transients import range_axis, zone_transients
from phasemark.render.integral.scene_samples import SceneMesh
from phasemark.render.view import VIEW_FIELDS


def test_counts_of_samples_are_those_of_their_transients() -> None:
    tmf = preset("tmf8820-3x3")
    x = np.arange(-20, 41) * 0.002  # each zone has a response, a bin width and a gain of its own
    rows = [tuple(np.exp(-0.5 * (x / (0.012 + 0.001 * k)) ** 2).tolist()) for k in range(9)]
    own = {
        "irf_std_m": None, "irf": rows, "irf_start_m": float(x[0]), "irf_step_m": 0.002,
        "zone_bin_scale": ((1.0, 1.02, 0.98),) * 3, "zone_gain": ((1.0, 0.9, 1.1),) * 3,
    }  # fmt: skip
    views, poses = Views.broadcast([0.7, 1.0], [0.3, 1.0]), world2cam(poses_around(2))
    for sensor, mesh, albedo in (
        (preset(SENSOR), build_mesh(catalog()["cone"]), 0.5),
        (tmf.with_(histogram={**tmf.histogram.model_dump(), **own}), block_on_table(), (0.3, 0.5)),  # table and block
    ):
        axis, scene, grid = range_axis(sensor), SceneMesh(mesh), footprint_grid(sensor)
        samples = scene.samples_of_views(views, grid) if isinstance(albedo, float) else scene.samples(poses, grid)
        want = signal_counts(zone_transients(samples, sensor, axis), sensor, axis, albedo)
        got = signal_of_samples(samples, sensor, albedo)
        assert np.abs(got - want).max() < 5e-5 * want.max()  # linear steps of the response, 1/64 of its width


def test_deviance_of_a_poisson_count_has_its_closed_forms() -> None:
    means = 10.0 ** np.linspace(-3, 4, deviance_moments().shape[1])
    table = deviance_moments()
    faint = means[0]  # none or one: 2λ, or 2 (λ − 1 − ln λ)
    none, one = 2 * faint, 2 * (faint - 1 - math.log(faint))
    assert table[0, 0] == pytest.approx(math.exp(-faint) * (none + faint * one), rel=1e-3)
    # to first order in 1/λ the mean is 1 + 1/6λ, and the variance 2 + 1/λ · 2/3
    assert table[0, -1] == pytest.approx(1 + 1 / (6 * means[-1]), abs=1e-6)
    assert table[1, -1] == pytest.approx(2, rel=1e-3)


def test_chi2_of_a_deviance_is_uniform_where_bins_are_nearly_empty() -> None:
    rng = np.random.default_rng(5)
    level = np.full((8, 64), 0.4)
    mean, variance = moments_of(level)
    p = []
    for _ in range(2000):
        n = rng.poisson(level)
        deviance = float((2 * (level - n + np.where(n > 0, n * np.log(np.maximum(n, 1) / level), 0.0))).sum())
        p.append(deviance_test(deviance, mean, variance, 0)[2])
    assert kstest(p, "uniform").pvalue > 1e-3  # false alarm of this test


def test_gradient_and_information_are_those_of_the_piled_up_likelihood() -> None:
    rng = np.random.default_rng(2)
    zones, bins, cycles = 2, 12, 300.0
    signal, slope = rng.uniform(0, 20, (zones, bins)), rng.normal(size=(1, zones, bins))
    ambient, extra = np.array([2.0, 3.0]), rng.uniform(0, 1, bins)
    counts = rng.poisson(10, (zones, bins)).astype(float)

    def level_at(theta: float, log_bright: float, light: np.ndarray) -> np.ndarray:
        return piled_up(math.exp(log_bright) * (signal + theta * slope[0]) + light[:, None] + extra, cycles)

    def log_likelihood(x: np.ndarray) -> float:
        level = level_at(x[0], x[1], ambient + x[2:])
        return float((counts * np.log(level) - level).sum())

    level, whole, gradient = np.empty((zones, bins)), np.empty((2, 2)), np.empty(2)
    own, rates, scratch = np.empty((zones, 4)), np.empty((zones, bins, 3)), np.empty((2, 3))
    seen = counts, signal, slope, 1.0, ambient, extra, cycles
    frame_sums(*seen, np.empty((0, 0)), level, whole, gradient, own, rates, scratch)
    np.testing.assert_allclose(level, level_at(0, 0, ambient), rtol=1e-9)
    h = 1e-5 * np.eye(4)
    want = np.array([(log_likelihood(h[k]) - log_likelihood(-h[k])) / 2e-5 for k in range(4)])
    by = [
        (level_at(h[k, 0], h[k, 1], ambient + h[k, 2:]) - level_at(-h[k, 0], -h[k, 1], ambient - h[k, 2:])) / 2e-5
        for k in range(4)
    ]

    def information_of(count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        full = np.array([[(a * b / count).sum() for a in by] for b in by])
        tied = full[:2, 2:] @ np.linalg.inv(full[2:, 2:])
        return full[:2, :2] - tied @ full[2:, :2], tied

    information, tied = information_of(level)
    np.testing.assert_allclose(whole, information, rtol=1e-6)
    np.testing.assert_allclose(gradient, want[:2] - tied @ want[2:], rtol=1e-5)
    np.testing.assert_allclose(rates[..., 0], by[0], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(rates[..., 2], by[2] + by[3], rtol=1e-6, atol=1e-6)  # light of one zone changes its own
    least = np.full((zones, bins), float(np.median(level)))
    frame_sums(*seen, least, level, whole, gradient, own, np.empty((0, 0, 0)), scratch)
    np.testing.assert_allclose(whole, information_of(np.maximum(level, least))[0], rtol=1e-6)


@pytest.mark.parametrize(
    ("seed", "pile_up", "free", "n_frames", "n"),
    [(0, True, FREE, 1, 40), (5, False, FREE, 1, 40), (0, True, (*FREE, "height_m"), 20, 8)],
)
def test_covariances_hold_where_an_edge_just_enters_a_zone_that_counts_next_to_nothing(
    seed: int, pile_up: bool, free: tuple[str, ...], n_frames: int, n: int
) -> None:
    """A bin that expects a thousandth of a count once told δ to a hundredth of its error, a height to a seventieth."""
    table = {**preset(SENSOR).histogram.model_dump(), "photons": 4.0, "cycles": 2000.0, "pile_up": pile_up}
    plan = BankPlan(
        sensor=SENSOR, sensor_overrides={"histogram": table}, classes=("cone", "sphere"), distance_m="0.9:1.2:0.1",
        delta_deg="0:170:10", layout="full",
    )  # fmt: skip
    rng, squares = np.random.default_rng(seed), []
    with build_bank(plan) as bank:
        matcher = Matcher(bank, "refine", on="histograms", free=free, workers=1)
        renderer = HistogramRenderer(build_mesh(catalog()["cone"]), bank.camera)
        for _ in range(n):
            views = Views.broadcast(rng.uniform(0.95, 1.15), rng.uniform(0, np.pi))
            frame = capture(renderer.render_views(views), bank.camera, rng=rng, n_frames=n_frames)
            found = matcher.match(frame)
            if found[0].accepted:
                squares.append(nees(view_errors(found, views, free, np.pi), found.covariance)[0])
    assert len(squares) >= 0.75 * n
    assert max(squares) < chi2.ppf(1 - 1e-5, len(free))  # the largest of forty: a false alarm once in 2 500
    assert np.sum(squares) < chi2.ppf(1 - 1e-4, len(free) * len(squares))


def test_error_is_at_the_poisson_bound_and_the_covariance_is_honest() -> None:
    check_bound(trials(60, seed=3), slack=0.02)


@pytest.mark.soak
def test_error_over_bound_and_nees_hold_their_bars_in_5000_trials_of_histograms() -> None:
    found = trials(5000, seed=4)
    assert ((found.ratio > 0.97) & (found.ratio < 1.05)).all(), found.ratio
    assert 0.97 < found.squares.mean() / 2 < 1.05
    assert (found.p_values < 0.01).mean() < 0.015
    assert len(found.squares) > 0.97 * found.n


def test_brightness_and_ambient_light_that_the_sensor_file_does_not_know_cost_nothing() -> None:
    rng = np.random.default_rng(6)
    views = random_views(12, rng)
    sensor = bank_of().camera
    h = sensor.histogram.model_dump()
    other = sensor.with_(histogram={**h, "photons": 0.4 * h["photons"], "ambient": 4 * h["ambient"]})
    drawn = capture_histograms(renderer_of("cone", other).expected(views), other, rng=rng, n_frames=3)
    frames = HistogramFrames(drawn.counts, sensor=sensor)
    found = matcher_of().match(frames)
    error = view_errors(found, views, FREE, np.pi)
    assert (found.class_name == "cone").sum() >= 11
    assert (np.abs(error) < 5 * np.sqrt(np.einsum("npp->np", found.covariance))).all()


def test_the_bearing_is_estimated_unless_the_matcher_is_told_and_lies_within_its_errors() -> None:
    rng = np.random.default_rng(7)
    views = Views.broadcast(1.1, rng.uniform(0, np.pi, 5), np.radians(rng.normal(0, 1.5, 5)))
    found = matcher_of(free=None).match(frames_of("cylinder", views, rng))
    assert found.free == ("distance_m", "delta_rad", "bearing_rad")
    error = view_errors(found, views, found.free, np.pi)
    assert (found.class_name == "cylinder").sum() >= 4
    assert (np.abs(error) < 5 * np.sqrt(np.einsum("npp->np", found.covariance))).all()
    assert found.accepted.sum() >= 3


@pytest.fixture(scope="module")
def roof_bank(tmp_path_factory):
    """A box with a crooked roof, which looks much the same after half a turn."""
    corners = [[x, y, z] for x in (-0.0871, 0.0871) for y in (-0.076, 0.076) for z in (-0.1409, 0.0512)]
    roof = trimesh.convex.convex_hull(np.array([*corners, [0.0014, -0.0426, 0.1409], [0.0068, 0.0514, 0.1409]]))
    folder = tmp_path_factory.mktemp("roof")
    roof.export(folder / "roof.stl")
    plan = {
        "meshes": [{"name": "roof", "path": str(folder / "roof.stl"), "unit": "m"}], "sensor": SENSOR,
        "distance_m": "0.6:0.86:0.02", "delta_deg": "0:360:3", "layout": "full",
    }  # fmt: skip
    with build_bank(plan, folder / "bank.h5") as bank:
        yield bank


@pytest.mark.parametrize("on", ["histograms", "targets"])
def test_a_part_is_told_from_its_other_side_though_a_table_takes_that_for_nearer(roof_bank, on: Measured) -> None:
    views = Views.broadcast([0.7324, 0.67, 0.6627], np.radians([213.47, 8.58, 23.49]), np.radians([4.3, 1.63, 1.77]))
    counted = HistogramRenderer(roof_bank.mesh("roof"), roof_bank.sensor).render_views(views)
    frames = capture(counted, roof_bank.sensor, rng=np.random.default_rng(6), n_frames=4)
    found = Matcher(roof_bank, "refine", on=on).match(frames)
    assert np.abs(found.distance_m - views.distance_m).max() < 0.005
    assert np.abs(np.remainder(found.delta_rad - views.delta_rad + np.pi, 2 * np.pi) - np.pi).max() < math.radians(3)
    assert found.accepted.sum() >= (3 if on == "histograms" else 2)


def test_height_and_pitch_are_estimated_on_request_and_a_wrong_hill_is_refused() -> None:
    rng, n = np.random.default_rng(8), 6
    height, pitch = rng.normal(0, 0.015, n), np.radians(rng.normal(0, 1.5, n))
    views = Views.broadcast(1.1, rng.uniform(0, np.pi, n), 0.0, height, pitch)
    free = (*FREE, "height_m", "pitch_rad")
    matcher = Matcher(bank_of(), "refine", free=free, on="histograms", height_std_m=0.03, workers=1)
    found = matcher.match(frames_of("cone", views, rng, n_frames=20))
    error = view_errors(found, views, free, np.pi)
    inside = (np.abs(error) < 5 * np.sqrt(np.einsum("npp->np", found.covariance))).all(axis=1)
    assert inside[found.accepted].all()
    assert found.accepted.sum() >= n - 1


def test_nothing_a_wall_and_another_thing_are_not_accepted() -> None:
    rng = np.random.default_rng(9)
    sensor = bank_of().camera
    empty = np.tile(detected_counts(np.zeros((1, 64, sensor.histogram.bins)), sensor), (6, 1, 1))
    nothing = matcher_of().match(capture_histograms(empty, sensor, rng=rng))
    assert all(name is None for name in nothing.class_name)
    assert not nothing.accepted.any()
    assert (nothing.class_probability["none"] > 0.9).all()
    views = Views.broadcast([1.0, 1.1, 1.2])
    plain = HistogramRenderer(None, sensor).expected(views, background=Background(wall_m=1.3))
    ball = HistogramRenderer(trimesh.creation.icosphere(3, 0.12), sensor).expected(views)
    for mean in (plain, ball):
        assert not matcher_of().match(capture_histograms(mean, sensor, rng=rng)).accepted.any()


def test_a_drift_that_the_reference_histogram_shows_is_taken_off() -> None:
    rng, sensor = np.random.default_rng(10), bank_of().camera
    changes = (("reference_peak", 10.0), ("reference_gain", 1.0))
    matcher = matcher_of(changes=changes, span="1.0:1.2:0.1", classes=("cone",))
    signal = 0.8 * renderer_of("cone", sensor).signal(Views.broadcast(1.1, 0.7))[:, 0]
    late = detected_counts(np.fft.irfft(np.fft.rfft(signal) * np.exp(-2j * np.pi * np.arange(65) / 128 * 0.6)), sensor)
    counts = rng.poisson(np.maximum(late, 1e-3)).reshape(1, 1, 8, 8, 128)
    reference = np.exp(-0.5 * ((np.arange(32) - 10.6) / 1.5) ** 2).reshape(1, 1, 32) * 1e4
    found = matcher.match(HistogramFrames(counts, sensor=matcher.bank.camera, reference=reference))
    assert abs(found.distance_m[0] - 1.1) < 5 * math.sqrt(found.covariance[0, 0, 0])


def test_the_answers_do_not_depend_on_threads_or_on_what_else_is_matched() -> None:
    rng = np.random.default_rng(11)
    frames = frames_of("sphere", random_views(6, rng), rng)
    alone = Matches(matcher_of().match(frames[k : k + 1])[0] for k in range(6))
    together = Matcher(bank_of(), "refine", free=FREE, on="histograms", workers=2).match(frames)
    np.testing.assert_array_equal(alone.distance_m, together.distance_m)
    np.testing.assert_array_equal(alone.covariance, together.covariance)


def declaring(frames: HistogramFrames, time_s: np.ndarray | None = None, **declared: float) -> HistogramFrames:
    return HistogramFrames(frames.counts, sensor=frames.sensor.with_(**declared), time_s=time_s)


@pytest.mark.parametrize("on", ["histograms", pytest.param("targets", marks=pytest.mark.soak)])
def test_what_a_sensor_declares_is_in_the_covariance_that_acceptance_reads(on: Measured) -> None:
    frames = frames_of("cone", Views.broadcast(1.12, 0.9), np.random.default_rng(15), n_frames=4)
    plain, matcher = matcher_of(on=on).match(frames), matcher_of(on=on)
    assert plain.accepted.all()
    little = matcher.match(declaring(frames, systematic_distance_m=0.004))
    assert little.accepted.all()
    np.testing.assert_allclose(little.covariance - plain.covariance, [np.diag([0.004**2, 0.0])], atol=1e-12)
    much = matcher.match(declaring(frames, systematic_distance_m=0.02))  # 3 σ is 6 cm, twice the tolerance
    assert [match.reason for match in much] == ["undetermined"]
    unasked = Matcher(bank_of(), "refine", free=FREE, on=on, systematic=("motion",), workers=1)
    assert unasked.match(declaring(frames, systematic_distance_m=0.02)).accepted.all()


def test_jitter_of_stamps_counts_as_motion_of_a_sensor_that_moves() -> None:
    distance_m, jitter_s = np.linspace(1.06, 1.12, 4), 0.01
    frames = frames_of("cone", Views.broadcast(distance_m, 0.4), np.random.default_rng(15), n_frames=4)
    time_s = 0.04 * np.arange(4)[:, None] + 0.01 * np.arange(4)  # half a metre a second
    found = matcher_of().match(declaring(frames, time_s, systematic_time_s=jitter_s))
    part = np.array([match.systematic["motion"][0, 0] for match in found])
    np.testing.assert_allclose(part, (0.5 * jitter_s) ** 2, rtol=0.2)  # a speed from four distances


def test_a_landmark_beyond_the_bank_is_not_accepted() -> None:
    views = Views.broadcast([1.27, 1.28, 1.30], [0.4, 0.9, 1.4])  # the bank ends at 1.25 m
    found = matcher_of().match(frames_of("cone", views, np.random.default_rng(16), n_frames=4))
    assert (found.p_value > 0.01).all()  # they fit: it is the range alone that refuses them
    assert [match.reason for match in found] == ["outside the bank"] * 3


def test_a_class_weighs_as_the_volume_of_its_posterior() -> None:
    rules = Rules(
        names=("narrow", "wide"), symmetry=(1, 1), distance_m=np.array([0.5, 1.5]), free=FREE, false_alarm=0.01,
        delta_rad=np.linspace(0, 2 * np.pi, 36, endpoint=False), tolerance=dict.fromkeys(VIEW_FIELDS, 0.1),
    )  # fmt: skip
    narrow, wide = np.array([[4e6, 2e3], [2e3, 9e2]]), np.array([[1e5, 0.0], [0.0, 4e2]])
    view = np.array([1.0, 0.3, 0.0, 0.0, 0.0, 0.0])
    found = [Explanation(0, view, 20.0, narrow), Explanation(1, view, 21.0, wide)]
    share = answer_from(rules, found, FitTest(20.0, 20, 0.5), 1e4, 1e4).class_probability

    def evidence(cost: float, information: np.ndarray) -> float:
        # the integral of the likelihood over both parameters, by sums over ten standard deviations
        root = np.linalg.cholesky(np.linalg.inv(information))
        x = np.linspace(-10, 10, 401)
        cells = (x[1] - x[0]) ** 2 * np.exp(-0.5 * (x[:, None] ** 2 + x**2)).sum()
        return float(math.exp(-cost / 2) * cells * abs(np.linalg.det(root)))

    want = evidence(20.0, narrow) / evidence(21.0, wide)
    assert share["narrow"] / share["wide"] == pytest.approx(want, rel=2e-3)  # narrower by 2π / |R I R| than the ranges


def test_information_is_that_of_the_slowest_rise_of_the_cost() -> None:
    information, columns = np.array([[4e6, 1e4], [1e4, 900.0]]), [0, 1]
    view = np.array([1.1, 0.4, 0.0, 0.0, 0.0, 0.0])
    axes = principal_axes(information)
    points = points_along(view, columns, axes)
    off = (points - view)[..., columns]
    rise = np.einsum("pki,ij,pkj->pk", off, information, off)
    np.testing.assert_allclose(lessened(information, axes, rise), information, rtol=1e-9)  # a parabola
    rise[1, 5] /= 4  # one side of one axis rises by a quarter of it, and this axis is as far as twice its length
    got = np.linalg.inv(lessened(information, axes, rise))
    np.testing.assert_allclose(got, np.linalg.inv(information) + 3 * np.outer(axes[1], axes[1]), rtol=1e-9)
    twice = np.concatenate([axes, axes[1:]]), np.concatenate([rise, rise[1:]])
    np.testing.assert_allclose(np.linalg.inv(lessened(information, *twice)), got, rtol=1e-9)  # an axis counts once
    rise[1, 5], rise[0] = np.nan, 4 * rise[0]  # outside of the limits; and no axis becomes better known
    np.testing.assert_allclose(lessened(information, axes, rise), information, rtol=1e-9)
    covariance = np.linalg.inv(information)
    along = axes_of_parameters(information)
    np.testing.assert_allclose(along, covariance / np.sqrt(np.diag(covariance))[:, None], rtol=1e-9)
    np.testing.assert_allclose(np.einsum("ai,ij,aj->a", along, information, along), 1.0, rtol=1e-9)


def targets_over_covariance(n: int, seed: int) -> np.ndarray:
    """Return the NEES of the right answers from targets; none that is accepted is wrong."""
    rng, squares = np.random.default_rng(seed), []
    for name in CLASSES:
        views = random_views(n // len(CLASSES), rng)
        found = matcher_of(on="targets").match(frames_of(name, views, rng).targets)
        right = right_answers(found, name, views, farthest_deg=10)
        squares.append(nees(view_errors(found, views, FREE, np.pi)[right], found.covariance[right]))
    return np.concatenate(squares)


def test_targets_give_class_and_view_within_their_errors() -> None:
    squares = targets_over_covariance(6, seed=12)
    assert len(squares) >= binom.ppf(1e-4, 6, 0.95)
    # sums of squares of standard normal numbers are χ²; 0.2: sigmas are estimates, and costs no parabolas
    low, high = chi2.ppf([0.00025, 0.99975], 2 * len(squares)) / (2 * len(squares))
    assert low - 0.2 < squares.mean() / 2 < high + 0.2


@pytest.mark.soak
def test_nees_of_targets_holds_its_bar_in_1000_trials() -> None:
    squares = targets_over_covariance(999, seed=13)
    assert len(squares) > 0.9 * 999
    assert 0.85 < squares.mean() / 2 < 1.2


@pytest.mark.parametrize(("distance_m", "delta_rad"), [(1.07, 0.4), (1.18, 2.2)])
def test_expected_targets_are_the_mean_of_what_the_chip_reports(distance_m: float, delta_rad: float) -> None:
    sensor, n = bank_of().camera, 600
    mean = renderer_of("cone", sensor).expected(Views.broadcast(distance_m, delta_rad))
    drawn = capture_histograms(mean, sensor, rng=np.random.default_rng(3), n_frames=n).targets
    expected = expected_targets(mean, sensor)
    # the nearest to the expected one is compared, as the matcher does it: the chip reports peaks of the noise too
    reported, sigma = (a[0].reshape(n, 64, -1) for a in (drawn.distance_m, drawn.sigma_m))
    off = np.abs(reported - expected.distance_m[0, :, :1])
    zones = np.flatnonzero(expected.sure[0, :, 0] & np.isfinite(reported[..., 0]).all(axis=0))
    assert len(zones) >= 7
    reported, sigma = (
        np.take_along_axis(a, np.nanargmin(off[:, zones], axis=-1)[..., None], axis=-1)[..., 0]
        for a in (reported[:, zones], sigma[:, zones])
    )
    spread = expected.spread_m[0, zones, 0]
    assert (spread > 0.3 * sigma.mean(axis=0)).any()  # a zone that sees a deep surface
    scaled = (reported - expected.distance_m[0, zones, 0]) / np.hypot(sigma, spread)
    # a bias of 0.3 of a standard deviation, and one that is off by a fifth, are what bins that vary alone leave
    assert (np.abs(scaled.mean(axis=0)) < 0.3).all()
    assert (np.abs(scaled.std(axis=0) - 1) < 0.2).all()
    # what else these zones report is noise above the threshold, seldom more often than a Poisson count of that mean
    h = sensor.histogram
    level = h.cycles * (h.ambient + h.dark)
    share = poisson.sf(math.floor(level + h.threshold * math.sqrt(level)), level)
    n_noise = int(np.isfinite(drawn.distance_m[0].reshape(n, 64, -1)[:, zones, 1:]).sum())
    assert n_noise <= poisson.isf(1e-4, 2 * n * len(zones) * h.bins * share)  # 2: the median of few counts varies


def test_targets_that_are_z_alone_are_matched_as_z_and_missing_ones_count() -> None:
    rng = np.random.default_rng(13)
    views = Views.broadcast([1.05, 1.15], [0.5, 1.2])
    found = frames_of("cylinder", views, rng, n_frames=10).targets
    first = found.distance_m[..., :1]
    bare = Targets(first, np.full(first.shape, np.nan), np.zeros(first.shape), found.status[..., :1])
    panel = matcher_of(on="targets").match(bare)
    assert (panel.class_name == "cylinder").all()
    assert np.abs(view_errors(panel, views, FREE, np.pi)[:, 0]).max() < 0.01
    status = bare.status.copy()
    status[:, :, 2:6, 3:5] = 1  # what stands in the middle of the image is gone
    left = Targets(np.where(status == 0, first, np.nan), bare.sigma_m, bare.signal, status)
    blind = matcher_of(on="targets").match(left)
    assert not blind.accepted.any()


def test_no_target_at_all_is_no_landmark() -> None:
    none = np.full((1, 1, 8, 8, 1), np.nan)
    found = matcher_of(on="targets").match(Targets(none, none, np.zeros(none.shape), np.ones(none.shape, np.uint8)))
    assert found[0].reason == "no landmark"
    assert found[0].class_name is None


@pytest.mark.parametrize(
    ("on", "options", "message"),
    [
        ("histograms", {"method": "nearest"}, "'method' must be refine"),
        ("targets", {"background": "auto"}, "'background' must be a Background or None"),
        ("histograms", {"background": "unknown"}, "'background' must be a Background, 'auto' or None"),
        ("histograms", {"robust": True}, "'robust' must be False"),
        ("histograms", {"policy": SearchPolicy()}, "'policy' must be None"),
        ("targets", {"policy": SearchPolicy()}, "'policy' must be None"),
        ("histograms", {"systematic": ("declared", "calibration")}, "'systematic' must be without 'calibration'"),
        ("targets", {"systematic": ("declared", "calibration")}, "'systematic' must be without 'calibration'"),
    ],
)
def test_an_option_without_effect_is_refused(on: Measured, options: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=rf'^on="{on}": {message}'):
        Matcher(bank_of(), **{"method": "refine", "on": on, **options})  # type: ignore[arg-type]
    if options.keys() & {"policy", "systematic"}:
        with pytest.raises(UsageError, match="'systematic' and 'policy' belong to method 'refine', not 'nearest'"):
            Matcher(bank_of(), **options)  # type: ignore[arg-type]


def test_what_does_not_go_with_histograms_is_refused_in_one_line() -> None:
    bank, ones, none = bank_of(), np.ones((1, 1, 8, 8)), np.full((1, 1, 4, 4, 1), np.nan)
    phase = build_bank(BankPlan(classes=("cone",), distance_m="1.0", delta_deg="0"))
    filtered = kalman_filter(Frames(ones, sensor=bank.camera))
    other = bank.camera.with_(histogram={**bank.camera.histogram.model_dump(), "photons": 0.5})
    frames = [HistogramFrames(np.ones((1, 1, 8, 8, 128)), sensor=sensor) for sensor in (bank.camera, other)]
    cone, view = renderer_of("cone", bank.camera), Views.broadcast(1.0)
    for call, message in (
        (lambda: Matcher(phase, "refine", on="histograms"), "^histograms and targets take a bank of a direct.* phase"),
        (lambda: Matcher(bank, "refine", free=FREE).match(frames[0]), '^on="ranges" takes filtered frames'),
        (lambda: matcher_of().match(filtered), '^on="histograms" takes HistogramFrames, got FilteredFrames'),
        (lambda: matcher_of().match(frames[1]), "another sensor than the bank's: 'histogram.photons' is 0.5 here"),
        (lambda: matcher_of(on="targets").match(Targets(none, none, none, none)), "^the targets are of 4 × 4 zones"),
        (lambda: cramer_rao(cone, view, pixels="lower"), "of histograms all zones count"),
        (lambda: cramer_rao(cone, view, nuisances=("wall_m",)), "a wall can be a nuisance only where there is one"),
    ):
        with pytest.raises(UsageError, match=message):
            call()


def test_targets_are_looked_up_at_the_bearing_of_the_landmark() -> None:
    matcher = matcher_of(on="targets", free=None, classes=("cone",))._direct
    assert isinstance(matcher, TargetMatcher)
    bearings_rad = np.radians([-3.0, -1.5, 0.0, 1.5, 3.0])
    assert sorted(table.bearing_rad for table in matcher.tables) == pytest.approx(bearings_rad)
    views = Views.broadcast(1.1, 0.5, bearings_rad)
    targets = frames_of("cone", views, np.random.default_rng(31), n_frames=4).targets
    starts = [matcher._starts(matcher._reported(targets, k))[0] for k in range(len(views))]
    np.testing.assert_allclose([view[2] for _, view in starts], bearings_rad, atol=1e-9)
    np.testing.assert_allclose([view[0] for _, view in starts], 1.1, atol=0.02)


def test_the_table_states_its_size_before_it_is_made() -> None:
    for background in (None, Background(wall_m=1.6)):
        direct = matcher_of(background, classes=("cone",))._direct
        assert isinstance(direct, HistogramMatcher)
        assert direct.table_bytes == sum(table.n_bytes for table in direct.tables)


def star() -> trimesh.Trimesh:
    """Return a prism whose base is a star with arms of different lengths."""
    arms = np.array([0.15, 0.11, 0.13, 0.09, 0.12])
    radius = np.column_stack([arms, np.full(5, 0.05)]).ravel()
    turn = 2 * np.pi * np.arange(10) / 10
    rim = np.column_stack([radius * np.cos(turn), radius * np.sin(turn)])
    points = np.vstack([np.column_stack([rim, np.full(10, z)]) for z in (-0.1, 0.1)] + [[[0, 0, -0.1], [0, 0, 0.1]]])
    k, after, one = np.arange(10), (np.arange(10) + 1) % 10, np.ones(10, np.int64)
    faces = [(k, after, after + 10), (k, after + 10, k + 10), (after, k, 20 * one), (k + 10, after + 10, 21 * one)]
    return trimesh.Trimesh(points, np.vstack([np.column_stack(each) for each in faces]))


def test_the_search_in_targets_of_a_tenth_of_a_millimetre_finds_a_view_as_good_as_the_true_one(tmp_path: Path) -> None:
    star().export(tmp_path / "star.stl")
    mesh = MeshPlan(name="star", path=str(tmp_path / "star.stl"), unit="m")
    grid = {"distance_m": "0.5:0.9:0.02", "delta_deg": "0:360:3"}
    plan = BankPlan(meshes=(mesh,), sensor="tmf8820-3x3", layout="full", **grid)
    rng, n = np.random.default_rng(41), 10
    views = Views.broadcast(
        rng.uniform(0.55, 0.85, n), rng.uniform(0, 2 * np.pi, n), rng.normal(0, math.radians(1.2), n)
    )
    with build_bank(plan, tmp_path / "bank.h5") as bank:
        image = HistogramRenderer(bank.mesh("star"), bank.camera, albedo=0.8).render_views(views)
        targets = capture(image, bank.camera, rng=rng, n_frames=4).targets
        matcher: Any = Matcher(bank, "refine", on="targets")._direct
        for k in range(n):
            frame = matcher._reported(targets, k)
            truth, found = np.array([getattr(views, name)[k] for name in VIEW_FIELDS]), matcher._match(frame)
            view = np.array([getattr(found, name) for name in VIEW_FIELDS])
            right = matcher._fit(_Fit(matcher, frame, 0, truth)).view
            cost, least = (matcher._costs(frame, 0, one[None])[0] for one in (view, right))
            assert cost < least + 2.0
