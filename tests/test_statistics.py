"""Errors of a view, their statistics, and the inverse of information: small cases that are known in closed form."""

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from phasemark import UsageError
from phasemark.matcher.information import covariance_of, weak_direction
from phasemark.matcher.pixel_agreement import pixel_mask
from phasemark.matcher.statistics import (
    binomial_interval,
    error_statistics,
    mean_interval,
    rms_interval,
    view_errors,
    within_ellipsoid,
)
from phasemark.render import Views, preset
from phasemark.render.view import delta_period_rad, wrap_delta_difference_rad, wrap_delta_rad


@pytest.mark.parametrize("symmetry", [1, 2, 4])
def test_a_wrapped_delta_is_the_same_side_within_one_period(symmetry):
    period = delta_period_rad(symmetry)
    delta = np.random.default_rng(1).uniform(-20, 20, 1000)
    wrapped, shift = wrap_delta_rad(delta, period), wrap_delta_difference_rad(delta, period)
    assert ((wrapped >= 0) & (wrapped < period)).all()
    assert (np.abs(shift) <= period / 2 * (1 + 1e-12)).all()
    for turns in ((delta - wrapped) / period, (delta - shift) / period):
        np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)


def test_a_tiny_negative_delta_is_zero_and_not_the_period():
    assert wrap_delta_rad(-1e-20, math.pi) == 0.0


def test_a_difference_within_half_a_period_keeps_every_bit():
    difference = np.random.default_rng(2).uniform(-1.5, 1.5, 1000)
    np.testing.assert_array_equal(wrap_delta_difference_rad(difference, math.pi), difference)


def test_errors_of_a_view_take_the_shorter_way_round():
    truth, found = Views.broadcast(1.0, [0.01, 3.0]), Views.broadcast([1.1, 0.9], [3.13, 0.02])
    period = np.array([math.pi, 2 * math.pi])
    expected = [[0.1, 3.12 - math.pi], [-0.1, 0.02 - 3.0]]
    np.testing.assert_allclose(view_errors(found, truth, ("distance_m", "delta_rad"), period), expected, atol=1e-15)
    np.testing.assert_allclose(view_errors(found, truth, ("distance_m",), period), [[0.1], [-0.1]], atol=1e-15)


def test_statistics_of_errors_are_those_of_their_columns():
    rng = np.random.default_rng(3)
    covariance = np.array([[4.0, 1.0], [1.0, 2.0]])
    error = rng.multivariate_normal([0.5, 0.0], covariance, 300)
    std = np.broadcast_to(np.sqrt(np.diag(covariance)), error.shape)
    error[7] = np.nan
    kept = np.delete(error, 7, axis=0)
    found = error_statistics(
        error, ("a", "b"), bound_std=std, covariance=np.broadcast_to(covariance, (300, 2, 2)), levels=(0.5, 0.95)
    )
    assert found.n == 299
    for k, name in enumerate("ab"):
        assert found.rmse[name] == rms_interval(kept[:, k])
        assert found.bias[name] == mean_interval(kept[:, k])
        assert found.ratio[name] == rms_interval(kept[:, k] / std[0, k])
        assert found.bias_over_bound[name] == mean_interval(kept[:, k] / std[0, k])
    squared = np.einsum("ni,ij,nj->n", kept, np.linalg.inv(covariance), kept)
    assert found.nees.value == pytest.approx(squared.mean() / 2, rel=1e-12)
    for level, share in found.coverage.items():
        assert share == binomial_interval(int((squared <= stats.chi2.ppf(level, 2)).sum()), 299, law="student")


def test_what_nothing_is_known_of_has_no_bounds():
    found = error_statistics(np.zeros((0, 2)), ("a", "b"))
    for one in (found.rmse["a"], found.ratio["b"], found.nees):
        assert math.isnan(one.value)
        assert one.high == math.inf
    without = error_statistics([[1.0, 2.0], [2.0, 1.0]], ("a", "b"))
    assert math.isnan(without.ratio["a"].value)
    assert math.isnan(without.coverage[0.95].value)


def test_every_rule_for_weak_directions_inverts_what_is_observed():
    rng = np.random.default_rng(4)
    rows = rng.normal(size=(20, 3)) / [0.01, 0.02, 0.01]
    information, scale = rows.T @ rows, np.array([0.01, 0.02, 0.01])
    for weak in ("nan", "wide", "none"):
        np.testing.assert_allclose(covariance_of(information, scale, weak=weak) @ information, np.eye(3), atol=1e-9)


def test_a_direction_that_is_not_observed_follows_its_rule():
    information = np.diag([4.0, 0.0])
    assert np.isnan(covariance_of(information)).all()
    assert np.isnan(covariance_of(np.stack([information, np.eye(2)]))[0]).all()
    np.testing.assert_array_equal(covariance_of(np.stack([information, np.eye(2)]))[1], np.eye(2))
    np.testing.assert_allclose(covariance_of(information, weak="none"), np.diag([0.25, 0.0]), atol=1e-15)
    wide = covariance_of(information, weak="wide")
    assert wide[0, 0] == pytest.approx(0.25)
    assert wide[1, 1] > 1e15


def test_information_and_its_inverse_name_the_same_weak_direction():
    names = ("distance_m", "delta_rad")
    unit = np.array([0.01, math.radians(1)])
    information = np.array([[4.0, 1.5], [1.5, 1.0]]) / np.outer(unit, unit)
    condition, direction = weak_direction(names, information=information)
    inverse = np.asarray(np.linalg.inv(information), np.float64)
    other, same = weak_direction(names, covariance=inverse)
    assert condition == pytest.approx(other)
    assert direction == pytest.approx(same)
    assert weak_direction(names, information=np.zeros((2, 2))) == (math.inf, {})


@pytest.mark.parametrize("rows", [8, 9])
def test_the_lower_half_begins_at_the_middle_line(rows):
    sensor = preset("pmd-16x16").with_(rows=rows)
    assert (sensor.upper_rows, sensor.lower_rows) == ((0, 4), (4, rows))
    mask = pixel_mask("lower", sensor)
    assert not mask[:4].any()
    assert mask[4:].all()
    with pytest.raises(UsageError, match="'pixels' must be all, lower or an array"):
        pixel_mask("upper", sensor)


def test_shares_and_levels_are_not_percent_and_not_swapped():
    wilson: Any = "wilson"
    for call, message in (
        (lambda: binomial_interval(10, 3), "'successes' must be between 0 and 'n' = 3, got 10"),
        (lambda: binomial_interval(-1, 3), "'successes' must be between 0 and 'n' = 3, got -1"),
        (lambda: binomial_interval(1, 3, law=wilson), "'law' must be one of student, normal, got 'wilson'"),
        (lambda: mean_interval([1.0, 2.0], law=wilson), "'law' must be one of student, normal"),
        (lambda: within_ellipsoid(np.zeros((1, 2)), np.eye(2)[None], 95), r"'level' must be in \(0, 1\), got 95"),
        (lambda: error_statistics([[0.1]], ["distance_m"], levels=(95,)), r"'level' must be in \(0, 1\), got 95"),
    ):
        with pytest.raises(UsageError, match=message):
            call()
