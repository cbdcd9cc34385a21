"""Sweeps as they are run: same numbers for any number of workers, resumed, refused, kept."""

import numpy as np
import pytest
from own_matchers import Fails

from phasemark import OutputExistsError, UsageError
from phasemark.matcher.sweep import read_sweep, run_sweep
from phasemark.matcher.sweep_plan import SHIPPED_SWEEPS, Method, SweepPlan, load_sweep

EXACT = ("condition", "trial", "truth", "estimate", "bound", "covariance", "chi2", "p_value", "found", "accepted")


def plan(matcher="own_matchers:nearest_to_mean", **changes):
    given = {
        "name": "small", "trials": 100, "classes": ["cone"], "axes": {"distance_m": [0.95, 1.05], "n_frames": [3]},
        "bank_distance_m": (0.9, 1.1), "methods": [Method(name="mine", method=matcher)],
    }  # fmt: skip
    return SweepPlan(**{**given, **changes})


def same(a, b):
    for name in EXACT:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def table_without_times(path):
    return [line.rsplit(",", 1)[0] for line in path.read_text().splitlines()]


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep")
    return folder, run_sweep(plan(), folder, workers=1)


def test_two_workers_give_the_same_tables(reference, tmp_path):
    folder, trials = reference
    same(trials, run_sweep(plan(), tmp_path, workers=2))
    for name in ("trials.csv", "cells.csv"):
        assert table_without_times(folder / name) == table_without_times(tmp_path / name)


def test_a_sweep_reads_back(reference):
    folder, trials = reference
    same(trials, read_sweep(folder)[1])


def test_methods_see_the_same_frames_and_another_method_changes_nothing(reference, tmp_path):
    methods = [Method(name=name, method="own_matchers:nearest_to_mean") for name in ("mine", "again")]
    both = run_sweep(plan(methods=methods), tmp_path)
    np.testing.assert_array_equal(both.estimate[:, 0], both.estimate[:, 1])
    np.testing.assert_array_equal(both.estimate[:, :1], reference[1].estimate)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ("fails", r"method 'mine', condition 1, trials 50 … 99: .* ZeroDivisionError: no luck"),
        ("turns_nan", r"method 'mine', condition 1, trials 50 … 99: trial 50 names 'cone' with a view .* not finite"),
    ],
)
def test_a_failed_sweep_keeps_what_is_done_and_goes_on(reference, tmp_path, bad, message):
    failing = plan(f"own_matchers:{bad}")
    Fails.left = 3
    with pytest.raises(UsageError, match=message):
        run_sweep(failing, tmp_path, workers=1)
    Fails.left = 1  # the three batches that are done are not done again
    resumed = run_sweep(failing, tmp_path, workers=1, resume=True)
    np.testing.assert_array_equal(resumed.estimate, reference[1].estimate)


def test_truths_lie_off_the_grid_within_their_spread(reference):
    truth = reference[1].truth
    nominal = np.repeat([0.95, 1.05], 100)
    assert np.abs(truth[:, 0] - nominal).max() <= 0.005
    assert len(np.unique(truth[:, 0])) == 200


def test_rounds_go_on_until_the_rmse_is_known(tmp_path):
    trials = run_sweep(plan(trials=20, until_percent=10.0, max_trials=2000, spread=(0.01, 6.0)), tmp_path)
    n = np.bincount(trials.condition)
    assert (n > 20).all()
    for cell in trials.cells():
        for rmse in cell.rmse.values():
            assert rmse.high <= 1.1 * rmse.value or cell.n == 2000


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"axes": {"distance_m": [0.8]}}, "'distance_m' must leave its spread"),
        ({"trials": 0}, "'trials' must be greater than or equal to 2, got 0"),
        ({"axes": {"colour": [1.0]}}, "unknown axis 'colour'"),
        ({"axes": {"n_frames": [2.5]}}, "'n_frames' must be a whole number"),
        ({"methods": [Method(name="a"), Method(name="a")]}, "each needs a name of its own"),
    ],
)
def test_a_wrong_plan_is_refused_in_one_line(changes, message):
    with pytest.raises(UsageError) as refused:
        plan(**changes)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("matcher", "message"),
    [
        ("own_matchers:nan_view", "view that is not finite"),
        ("no_such_module:match", "cannot be imported"),
        ("own_matchers:NOT_CALLABLE", "must be callable"),
    ],
)
def test_a_bad_matcher_is_told_in_one_line(matcher, message, tmp_path):
    with pytest.raises(UsageError, match=message):
        run_sweep(plan(matcher), tmp_path, workers=1)


def test_a_folder_with_a_sweep_is_not_overwritten_unasked(reference):
    with pytest.raises(OutputExistsError, match="--resume"):
        run_sweep(plan(), reference[0])
    with pytest.raises(OutputExistsError, match="another plan"):
        run_sweep(plan(seed=1), reference[0], resume=True)


def test_star_varies_each_axis_alone_and_sobol_stays_inside():
    axes = {"distance_m": [1.0, 0.95, 1.05], "albedo": [0.8, 0.4]}
    star = plan(design="star", axes=axes).conditions()
    assert [(one.distance_m, one.albedo) for one in star] == [(1.0, 0.8), (0.95, 0.8), (1.05, 0.8), (1.0, 0.4)]
    sobol = plan(design="sobol", points=16, axes={**axes, "n_frames": [1, 9]}).conditions()
    assert len(sobol) == 16
    assert all(0.95 <= one.distance_m <= 1.05 and 0.4 <= one.albedo <= 0.8 for one in sobol)
    assert {type(one.n_frames) for one in sobol} == {int}


def test_shipped_plans_are_plans():
    for name in SHIPPED_SWEEPS:
        assert load_sweep(name).name == name
    # 4 classes and 2 strangers, at 3 distances and 3 angles
    assert len(load_sweep("paper").conditions()) == 36 + 18
