"""Sweeps as they are run: same numbers for any number of workers, resumed, refused, kept."""

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import run_program
from own_matchers import Fails
from scipy import stats

from phasemark import OutputExistsError, UsageError
from phasemark.cli import main
from phasemark.data.commands import console
from phasemark.data.files.folder_marker import adding_to_folder
from phasemark.matcher.plan_kinds import plan_schema
from phasemark.matcher.sweep.job import Round, SweepJob
from phasemark.matcher.sweep.plan import AXES, SHIPPED_SWEEPS, Method, SweepPlan, read_sweep_plan
from phasemark.matcher.sweep.report import write_report
from phasemark.matcher.sweep.run import read_sweep, run_sweep, sweep_frames
from phasemark.render import predicted_range_std

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


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep")
    return folder, run_sweep(plan(), folder, workers=1)


def test_methods_see_the_same_frames_and_another_method_changes_nothing(reference, tmp_path):
    methods = [Method(name=name, method="own_matchers:nearest_to_mean") for name in ("mine", "again")]
    both = run_sweep(plan(methods=methods), tmp_path)
    np.testing.assert_array_equal(both.estimate[:, 0], both.estimate[:, 1])
    np.testing.assert_array_equal(both.estimate[:, :1], reference[1].estimate)
    same(both, read_sweep(tmp_path)[1])


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


def test_a_sensor_with_a_chip_is_simulated_and_explained_as_its_chip_reports(tmp_path):
    chip = plan(
        sensor="vl53l5cx-8x8", trials=4, methods=[Method(name="likely")], bank_distance_m=(0.5, 0.7),
        axes={"distance_m": [0.6], "delta_deg": [40.0], "wall_m": [1.6], "n_frames": [8]},
    )  # fmt: skip
    trials = run_sweep(chip, tmp_path, workers=1)
    assert trials.accepted.all()
    assert np.abs(trials.estimate[:, 0, 0] - trials.truth[:, 0]).max() < 5e-3
    # zones at an edge see both, and no mean of them: the cone ends 0.2 m behind its axis
    job = SweepJob(chip, Round(0, (0,), 0, 4))
    z_m = job.raw_frames(0, job.image(0, job.views(0, 0, 4)), 0).z_m
    assert ((z_m < 0.8) | (z_m > 1.55) | np.isnan(z_m)).all()
    assert ((z_m < 0.8).mean() > 0.2) & ((z_m > 1.55).mean() > 0.2)


def test_what_a_chip_reports_is_not_asked_of_a_camera(tmp_path):
    with pytest.raises(UsageError, match=r"method 'chip': on=\"reported\" needs a sensor with a \[histogram\] table"):
        run_sweep(plan(methods=[Method(name="chip", on="reported")]), tmp_path)


def test_rounds_go_on_until_the_rmse_is_known(tmp_path):
    trials = run_sweep(plan(trials=20, until_percent=10.0, max_trials=2000, spread=(0.01, 6.0)), tmp_path)
    n = np.bincount(trials.condition)
    assert (n > 20).all()
    for cell in trials.cells():
        for rmse in cell.rmse.values():
            assert rmse.high <= 1.1 * rmse.value or cell.n == 2000


def test_strangers_are_tried_as_often_as_is_said_and_no_more_trials_than_the_most(tmp_path):
    box = {"name": "bare-box", "box": {"length_m": 0.24, "width_m": 0.16, "height_m": 0.15}}
    more = {"trials": 20, "until_percent": 10.0, "stranger_trials": 4, "spread": (0.01, 6.0)}
    one = plan(**more, max_trials=60, strangers=[box], axes={"distance_m": [0.95], "n_frames": [3]})
    trials = run_sweep(one, tmp_path / "a")
    n = np.bincount(trials.condition)
    assert n[0] > 20  # there was another round
    assert n[1] == 4
    with pytest.raises(UsageError, match="has trials 0 … 3 of a condition, got 4"):
        sweep_frames(tmp_path / "a", 1, 4)
    few = run_sweep(plan(**more, max_trials=7), tmp_path / "b")
    assert (np.bincount(few.condition) == 7).all()


def test_a_landmark_has_the_albedo_of_its_plan_where_it_is_no_axis():
    dark = {"name": "dark", "box": {"length_m": 0.24, "width_m": 0.16, "height_m": 0.15}, "albedo": 0.2}
    found = {one.class_name: one.albedo for one in plan(landmarks=[dark]).conditions()}
    assert found == {"cone": 0.8, "dark": 0.2}
    axes = {"distance_m": [0.95], "n_frames": [3], "albedo": [0.5]}
    assert {one.albedo for one in plan(landmarks=[dark], axes=axes).conditions()} == {0.5}


def test_the_noise_factor_multiplies_the_noise_of_any_camera():
    overrides = {"ambient_e": 2e5, "dark_e": 300.0, "read_noise_e": 50.0}
    axes = {"distance_m": [0.95], "n_frames": [3], "noise_factor": [1.0, 3.0]}
    one = plan(sensor_overrides=overrides, axes=axes)
    job = SweepJob(one, Round.first_of(one))
    std = [predicted_range_std(0.5, 0.6, job.believed_sensor(number)) for number in range(2)]
    assert std[1] / std[0] == pytest.approx(3.0, rel=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"axes": {"distance_m": [0.8]}}, "'distance_m' must leave its spread"),
        ({"wall_m": 4.0}, "unknown key 'wall_m': it is an axis and belongs under [axes], as axes.wall_m"),
        ({"knows": "wall"}, "unknown key 'knows': it belongs to a method, under [[methods]]"),
        ({"methods": [{"name": "a", "wall_m": 4}]}, "methods.0: unknown key 'wall_m': it is an axis and belongs under"),
        ({"methods": [{"name": "a", "trials": 4}]}, "'trials': it belongs to the plan itself, above [[methods]]"),
        ({"methods": []}, "'methods' must have at least 1 item, got []"),
        (
            {"methods": [{"name": "a", "method": "own"}]},
            "'method' must be nearest, refine, or MODULE:NAME of a callable of your own, got 'own'",
        ),
        ({"trials": 0}, "'trials' must be greater than or equal to 2, got 0"),
        ({"axes": {"colour": [1.0]}}, "unknown axis 'colour'"),
        ({"axes": {"n_frames": [2.5]}}, "'n_frames' must be a whole number"),
        ({"axes": {"bounces": [1], "floor_m": [0]}}, "'bounces' needs a 'wall_m' or a 'floor_m' that the light"),
        ({"methods": [Method(name="a"), Method(name="a")]}, "each needs a name of its own"),
    ],
)
def test_a_wrong_plan_is_refused_in_one_line(changes, message):
    with pytest.raises(UsageError) as refused:
        plan(**changes)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_bad_matcher_is_told_in_one_line(tmp_path):
    for matcher, message in (
        ("no_such_module:match", "cannot be imported"), ("own_matchers:NOT_CALLABLE", "must be callable"),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=message):
            run_sweep(plan(matcher), tmp_path, workers=1)


FIRST = ", but the Match for frame 0 has"


@pytest.mark.parametrize(
    ("matcher", "got"),
    [
        ("returns_integers", ", got an object of type int for frame 0"),
        ("returns_one_too_few", ", got 4"),
        ("returns_none", ", got None"),
        ("returns_a_number", ", got an object of type int"),
        ("returns_text_for_a_distance", f"{FIRST} 'distance_m' of type str: it must be a number"),
        (
            "returns_a_small_covariance",
            f"{FIRST} 'covariance' of shape (1, 1): it must be (2, 2), as 'free' has 2 names",
        ),
    ],
)
def test_what_a_matcher_must_return_is_told_in_one_line(matcher, got, tmp_path):
    with pytest.raises(UsageError) as refused:
        run_sweep(plan(f"own_matchers:{matcher}", trials=5), tmp_path, workers=1)
    where = "method 'mine', condition 0, trials 0 … 4"
    due = f"the matcher 'own_matchers:{matcher}' must return a Match for each of the 5 frames"
    assert str(refused.value) == f"{where}: {due}{got}"


@pytest.mark.parametrize(
    ("matcher", "raised"),
    [
        ("no_luck", "ZeroDivisionError: no luck"),
        ("fails_late", "ZeroDivisionError: no luck"),
        ("exits", "SystemExit: no licence"),
        ("raises_usage_error", "UsageError: of its own"),
    ],
)
def test_what_a_matcher_raises_is_shown_with_its_own_traceback(matcher, raised, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(Path(__file__).parent)
    (tmp_path / "plan.toml").write_text(
        'name = "small"\ntrials = 2\nclasses = ["cone"]\nbank_distance_m = [0.9, 1.1]\n'
        f'methods = [{{ name = "mine", method = "own_matchers:{matcher}" }}]\n',
        encoding="utf-8",
    )
    monkeypatch.setattr(console, "PROGRESS_SECONDS", 1e6)  # no line of progress among those of the error
    options = ["--trust-plan", "-o", str(tmp_path / "out")]
    assert main(["sweep", "run", str(tmp_path / "plan.toml"), *options]) == 2
    *traceback, error = capsys.readouterr().err.splitlines()
    assert error.startswith("error: method 'mine', condition 0, trials 0 … 1: ")
    assert error.endswith(f"the matcher 'own_matchers:{matcher}' raised {raised}")
    assert traceback[0] == "Traceback (most recent call last):"
    assert traceback[-1].endswith(raised)
    files = {line.split('"')[1] for line in traceback if line.startswith("  File ")}
    assert {Path(file).name for file in files} == {"own_matchers.py"}


def test_a_module_that_fails_when_imported_is_shown_with_its_own_traceback(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "broken_matcher.py").write_text("import sys\nsys.exit(3)\n", encoding="utf-8")
    assert main(["sweep", "run", "paper", "--matcher", "broken_matcher:match", "-o", "out"]) == 2
    *traceback, error = capsys.readouterr().err.splitlines()
    assert error == "error: the matcher 'broken_matcher:match' cannot be imported (SystemExit: 3)"
    assert [line.split('"')[1] for line in traceback if line.startswith("  File ")] == [
        str(tmp_path / "broken_matcher.py")
    ]


@pytest.mark.parametrize("options", [(), ("--matcher", "own_matchers:refined")])
def test_a_plan_that_names_a_program_does_not_run_it_unasked(options, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "program.py").write_text("open('ran', 'w').close()\n", encoding="utf-8")
    (tmp_path / "plan.toml").write_text(
        'name = "theirs"\ntrials = 2\nmethods = [{ name = "mine", method = "program:match" }]\n', encoding="utf-8"
    )
    assert main(["sweep", "run", "plan.toml", "-o", "out", *options]) == 2
    assert "--trust-plan" in capsys.readouterr().err
    assert not (tmp_path / "ran").exists()
    assert str(tmp_path) not in sys.path
    assert main(["plan", "check", "plan.toml"]) == 0
    assert not (tmp_path / "ran").exists()
    for trusting in (("--trust-plan",), ("--matcher", "program:match")):
        sys.modules.pop("program", None)
        assert main(["sweep", "run", "plan.toml", "-o", "out", *trusting]) == 2  # it has no 'match'
        assert (tmp_path / "ran").exists()
        (tmp_path / "ran").unlink()


def test_a_folder_with_a_sweep_is_not_overwritten_unasked(reference):
    with pytest.raises(OutputExistsError, match="resume=True"):
        run_sweep(plan(), reference[0])
    with pytest.raises(OutputExistsError, match="another plan"):
        run_sweep(plan(seed=1), reference[0], resume=True)


def test_conditions_that_cannot_be_seen_are_named_before_a_folder_is_made(tmp_path):
    folder = tmp_path / "none"
    for axes, message in (
        ({"floor_m": [0.15], "bounces": [0, 1]}, "condition 1: light that bounces needs the sensor's 'lamp_half_angle"),
        ({"wall_m": [0, 1.0]}, "condition 1: the wall at 1 m"),
    ):
        with pytest.raises(UsageError, match=message):
            run_sweep(plan(axes=axes), folder, workers=1)
    assert not folder.exists()


def test_light_that_bounces_is_in_the_world_and_in_a_method_that_knows_it(tmp_path):
    box = {"name": "box", "box": {"length_m": 0.24, "width_m": 0.16, "height_m": 0.15}}  # few patches exchange light
    known = {"name": "small", "landmarks": [box], "trials": 10, "bank_distance_m": (0.95, 1.05), "spread": (0.01, 1)}
    behind = {"wall_m": [2.0], "floor_m": [0.15], "bounces": [0, 2]}
    methods = [Method(name="direct"), Method(name="bounces", knows="bounces"), Method(name="none", knows="nothing")]
    trials = run_sweep(
        SweepPlan(**known, axes=behind, methods=methods, sensor_overrides={"lamp_half_angle_deg": 30.0}), tmp_path
    )
    direct, knowing, ignorant = (
        [cell for cell in trials.cells() if cell.method == name] for name in ("direct", "bounces", "none")
    )
    assert [cell.accepted.value for cell in direct] == [1, 0]
    assert [cell.accepted.value for cell in knowing] == [1, 1]
    assert [cell.accepted.value for cell in ignorant] == [0, 0]  # a wall and a floor are neither there to it
    # it is the bounces that move D, by more than ten standard deviations; 10 trials of two parameters each
    moved = direct[1].bias["distance_m"].value / direct[1].bound["distance_m"]
    assert moved > 10
    assert stats.chi2.ppf(0.001, 20) < 20 * knowing[1].nees.value < stats.chi2.ppf(0.999, 20)


def test_star_varies_each_axis_alone_and_sobol_stays_inside():
    axes = {"distance_m": [1.0, 0.95, 1.05], "albedo": [0.8, 0.4]}
    star = plan(design="star", axes=axes).conditions()
    assert [(one.distance_m, one.albedo) for one in star] == [(1.0, 0.8), (0.95, 0.8), (1.05, 0.8), (1.0, 0.4)]
    sobol = plan(design="sobol", points=16, axes={**axes, "n_frames": [1, 9]}).conditions()
    assert len(sobol) == 16
    assert all(0.95 <= one.distance_m <= 1.05 and 0.4 <= one.albedo <= 0.8 for one in sobol)
    assert {type(one.n_frames) for one in sobol} == {int}


def test_the_schema_names_every_axis():
    axes = plan_schema("sweep")["properties"]["axes"]
    assert set(axes["properties"]) == set(AXES) - {"class_name"}
    assert axes["additionalProperties"] is False
    for name, schema in axes["properties"].items():
        value = schema["anyOf"][1]
        with pytest.raises(UsageError):
            plan(axes={name: [value["maximum"] * 1.001 + 1]})
        with pytest.raises(UsageError):
            plan(axes={name: [value["minimum"] - 1]})


def test_shipped_plans_are_plans():
    for name in SHIPPED_SWEEPS:
        assert read_sweep_plan(name).name == name
    # 4 classes and 2 strangers, at 3 distances and 3 angles
    assert len(read_sweep_plan("paper").conditions()) == 36 + 18


FOREIGN = "cells.csv trials.csv report.html sweep.json plan.json trials-000.h5 trials-000.h5.partial"


@pytest.mark.parametrize("name", FOREIGN.split())
def test_a_file_of_somebody_else_in_a_folder_without_a_sweep_stays(tmp_path, name):
    (tmp_path / name).write_text("mine")
    for force in (False, True):
        with pytest.raises(OutputExistsError, match=f"{name}: exists and was not written by 'phasemark sweep run'"):
            run_sweep(plan(), tmp_path, force=force)
    assert [(entry.name, entry.read_text()) for entry in tmp_path.iterdir()] == [(name, "mine")]


def test_a_sweep_in_progress_is_left_alone_and_force_removes_its_files_and_no_others(tmp_path, capsys):
    run_sweep(plan(trials=4), tmp_path, workers=1)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with adding_to_folder(tmp_path, "sweep run"):
        ways: tuple[dict[str, Any], ...] = ({"force": True}, {"resume": True}, {})
        for options in ways:
            with pytest.raises(OutputExistsError, match="another run is writing it"):
                run_sweep(plan(trials=4), tmp_path, **options)
        with pytest.raises(OutputExistsError, match="another run is writing it"):
            write_report(tmp_path)
    frames = ["sweep", "frames", str(tmp_path), "0", "0", "--force", "-o"]
    assert main([*frames, str(tmp_path / "trials-000.h5")]) == 2
    assert "is an input too" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert main([*frames, str(tmp_path / "frames.npz")]) == 0
    mine = ("trials-001.h5.my-backup", "trials-007.h5", "notes.txt")
    for name in mine:
        (tmp_path / name).write_text("mine")
    run_sweep(plan(trials=4, seed=8), tmp_path, workers=1, force=True)
    assert [(tmp_path / name).read_text() for name in mine] == ["mine"] * 3
    assert read_sweep(tmp_path)[0].seed == 8


@pytest.mark.parametrize(
    ("action", "step"),
    [("kill", 23), *(pytest.param(action, 1, marks=pytest.mark.soak) for action in ("kill", "ENOSPC", "EIO"))],
)
def test_a_sweep_ended_at_any_call_to_the_system_goes_on_or_starts_over(action, step):
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=memory) as folder:
        assert int(run_program("sweep_crash_points", folder, action, step)) > min(10, 110 // step)


def test_a_scheduler_that_cannot_be_is_refused_before_a_folder_is_made(tmp_path):
    assert main(["sweep", "run", "paper", "--trials", "1", "--scheduler", "somewhere", "-o", str(tmp_path / "x")]) == 2
    assert not (tmp_path / "x").exists()
