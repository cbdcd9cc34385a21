"""Numbers and intervals of a sweep's tables, on a linear problem where everything is known in closed form."""

import math

import numpy as np
import pytest
from scipy import stats

from phasemark.matcher.statistics import binomial_interval, mean_interval, rms_interval
from phasemark.matcher.sweep.plan import Condition
from phasemark.matcher.sweep.result_tables import LEVELS, SweepTrials

# y = A θ + e, e ~ N(0, Σ): least squares has exactly the covariance P = (Aᵀ Σ⁻¹ A)⁻¹, which is the Cramér–Rao bound
A = np.array([[1.0, 0.2], [0.5, 1.0], [-0.3, 0.7]])
STD = np.array([1e-3, 2e-3, 1.5e-3])
P = np.linalg.inv(A.T @ np.diag(STD**-2) @ A)
ESTIMATOR = P @ A.T @ np.diag(STD**-2)


def linear_sweep(n: int, rng: np.random.Generator, bias=(0.0, 0.0), told: float = 1.0) -> SweepTrials:
    """One condition, one method; the method claims `told` times its true covariance."""
    truth = np.zeros((n, 4))
    truth[:, 0], truth[:, 1] = rng.uniform(0.9, 1.1, n), rng.uniform(-0.1, 0.1, n)
    estimate = truth[:, None].copy()
    estimate[:, 0, :2] += rng.normal(size=(n, 3)) * STD @ ESTIMATOR.T + bias
    covariance = np.full((n, 1, 4, 4), np.nan)
    covariance[:, :, :2, :2] = P
    flat = np.ones((n, 1))
    return SweepTrials(
        conditions=(Condition("box"),), methods=("least squares",), free=(("distance_m", "delta_rad"),),
        classes=("box",), symmetry=(2,), outlier=(0.05, 5.0), condition=np.zeros(n, np.int64), trial=np.arange(n),
        truth=truth, estimate=estimate, bound=covariance, covariance=told * covariance, chi2=flat, p_value=flat,
        p_none=0 * flat, confusion=np.full(n, np.nan), seconds=flat, dof=np.ones((n, 1), np.int64),
        found=np.zeros((n, 1), np.int64), modes=np.ones((n, 1), np.int64), accepted=np.ones((n, 1), np.bool_),
    )  # fmt: skip


def test_every_interval_covers_what_is_known_in_95_percent_of_1000_sweeps():
    rng = np.random.default_rng(20051)
    std = np.sqrt(np.diag(P))
    hits = {}
    for _ in range(1000):
        cell = linear_sweep(200, rng).cells()[0]
        known = {
            "bias": [(cell.bias[name], 0.0) for name in cell.free],
            "rmse": [(cell.rmse[name], std[k]) for k, name in enumerate(cell.free)],
            "ratio": [(cell.ratio[name], 1.0) for name in cell.free],
            "nees": [(cell.nees, 1.0)],
            "coverage": [(cell.coverage[level], level) for level in (0.5, 0.9, 0.95)],
        }
        for name, pairs in known.items():
            for k, (estimate, truth) in enumerate(pairs):
                hits.setdefault((name, k), []).append(estimate.low <= truth <= estimate.high)
    # 99.9 % binomial interval about 0.95, corrected for the 10 intervals; asymptotic intervals may miss by 1 %
    low, high = (stats.binom.ppf(q, 1000, p) / 1000 for q, p in ((0.5e-4, 0.94), (1 - 0.5e-4, 0.96)))
    for key, found in hits.items():
        assert low <= np.mean(found) <= high, key


def test_a_bias_is_found_and_told_apart_from_scatter():
    cell = linear_sweep(4000, np.random.default_rng(1), bias=(0.002, 0.0)).cells()[0]
    assert cell.bias["distance_m"].low < 0.002 < cell.bias["distance_m"].high
    assert cell.bias["delta_rad"].low < 0 < cell.bias["delta_rad"].high
    expected = math.hypot(math.sqrt(P[0, 0]), 0.002)
    assert cell.rmse["distance_m"].low < expected < cell.rmse["distance_m"].high


def test_a_covariance_that_is_four_times_too_large_has_a_nees_of_a_quarter_and_covers_too_much():
    cell = linear_sweep(4000, np.random.default_rng(2), told=4.0).cells()[0]
    assert cell.nees.low < 0.25 < cell.nees.high
    for level in LEVELS:
        truth = stats.chi2.cdf(4 * stats.chi2.ppf(level, 2), 2)
        assert cell.coverage[level].low <= truth <= cell.coverage[level].high


def test_delta_is_wrapped_by_the_symmetry():
    trials = linear_sweep(10, np.random.default_rng(3))
    trials.estimate[:, 0, 1] += math.pi
    assert np.abs(trials.error[:, 0, 1]).max() < 0.05  # STD is some 2e-3 rad


def test_outliers_are_counted_apart():
    trials = linear_sweep(100, np.random.default_rng(4))
    trials.estimate[:7, 0, 0] += 0.3
    cell = trials.cells()[0]
    assert cell.outliers.value == pytest.approx(0.07)
    assert cell.rmse["distance_m"].value < 0.005 < cell.rmse_with_outliers["distance_m"].value


def test_an_error_that_the_bound_explains_is_no_outlier():
    trials = linear_sweep(100, np.random.default_rng(6))
    trials.estimate[:7, 0, 0] += 0.3
    trials.bound[:, :, 0, 0] = 0.1**2
    assert trials.cells()[0].outliers.value == 0


def test_wilson_solves_its_quadratic():
    z = stats.norm.ppf(0.975)
    for k, n in ((3, 17), (50, 60)):
        share = binomial_interval(k, n, law="student")
        for edge in (share.low, share.high):  # the ends are where |p − edge| is z standard errors of a share `edge`
            assert abs(k / n - edge) == pytest.approx(z * math.sqrt(edge * (1 - edge) / n), rel=1e-12)
    assert (binomial_interval(0, 5, law="student").low, binomial_interval(5, 5, law="student").high) == (0.0, 1.0)


def test_too_few_trials_have_an_open_interval():
    assert mean_interval([1.0]).high == math.inf
    assert rms_interval([]).low == 0.0
    assert math.isnan(binomial_interval(0, 0).value)
