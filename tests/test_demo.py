"""The paper's experiment at a small size: the command, its page, and how accurate both methods are."""

import contextlib
import html
import io
import math
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from phasemark import UsageError
from phasemark.cli import main
from phasemark.data.seeds import stream
from phasemark.matcher import Match, robot_poses
from phasemark.matcher.sweep.plan import SweepPlan, read_sweep_plan
from phasemark.matcher.sweep.report import answer, view_rows
from phasemark.matcher.sweep.run import read_sweep, run_sweep

DEMO = read_sweep_plan("demo")
LIKELIHOOD, NEAREST = 0, 1


def small(**changes: Any) -> SweepPlan:
    axes = {"distance_m": (1.0,), "delta_deg": (0.0, 45.0), "wall_m": DEMO.axes["wall_m"], "n_frames": (20,)}
    given = {"classes": ("cone", "post"), "axes": axes, "trials": 3, "bank_distance_m": (0.96, 1.04)}
    return SweepPlan(**{**DEMO.model_dump(), **given, **changes})


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """What the command printed, and its folder."""
    folder, printed = tmp_path_factory.mktemp("demo") / "out", io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr("phasemark.matcher.sweep.read_sweep_plan", lambda name: small(name=name))
        patch.setattr("phasemark.matcher.sweep.report._MOST_EXAMPLES", 2)  # a picture takes half a second
        assert main(["demo", "--out", str(folder), "--seed", "7", "--workers", "1"]) == 0
    return SimpleNamespace(folder=folder, printed=printed.getvalue(), trials=read_sweep(folder)[1])


def test_the_demo_is_the_paper_s_experiment_before_a_wall():
    assert DEMO.class_names == ("cylinder", "cone", "sphere", "post")
    assert DEMO.axes == {"distance_m": (0.8, 1.0, 1.2), "delta_deg": (0.0, 45.0, 90.0), "wall_m": (3.0,)}
    assert {(one.n_frames, one.wall_m) for one in DEMO.conditions()} == {(50, 3.0)}
    assert [(method.method, method.knows, method.free) for method in DEMO.methods] == [
        ("refine", "wall", ()), ("nearest", "wall", ()),
    ]  # fmt: skip


def test_views_on_the_grid_are_found_exactly_by_the_nearest_image(tmp_path):
    trials = run_sweep(small(spread=(0.0, 0.0), methods=DEMO.methods[NEAREST:]), tmp_path)
    assert len(trials) == 12
    assert (trials.found[:, 0] == trials.true_class).all()
    assert np.abs(trials.error[:, 0]).max() < 1e-9
    assert trials.position_error_of(slice(None)).max() < 1e-9


def test_between_grid_points_the_nearest_image_answers_with_a_grid_point(made):
    assert (made.trials.found == made.trials.true_class[:, None]).all()
    steps = made.trials.estimate[:, NEAREST, :2] / (0.01, math.radians(1))
    np.testing.assert_allclose(steps, np.round(steps), rtol=0, atol=1e-9)
    assert np.abs(made.trials.error[:, NEAREST, 0]).max() > 1e-3


def test_maximum_likelihood_is_as_accurate_as_its_covariance_between_grid_points(made):
    """24 errors of two parameters over their standard deviations: mean square 1, ± 3.3 √(2 / 24)."""
    variance = np.einsum("npp->np", made.trials.covariance[:, LIKELIHOOD])[:, :2]
    assert abs((made.trials.error[:, LIKELIHOOD, :2] ** 2 / variance).mean() - 1) < 3.3 * math.sqrt(2 / 24)


def test_the_position_error_is_the_distance_of_the_nearest_symmetric_pose(made):
    landmark = (2.0, 1.0)
    for k, errors in enumerate(made.trials.position_error_of(slice(None))):
        true, *found = (
            robot_poses(Match("cone", True, distance_m=view[0], delta_rad=view[1], symmetry=2), landmark)
            for view in (made.trials.truth[k], *made.trials.estimate[k])
        )
        for poses, error in zip(found, errors, strict=True):
            assert error == pytest.approx(
                min(math.hypot(pose.x_m - true[0].x_m, pose.y_m - true[0].y_m) for pose in poses), abs=1e-9
            )
    cell = made.trials.cells()[LIKELIHOOD]
    assert cell.position.value == pytest.approx(
        math.sqrt((made.trials.position_error_of(made.trials.rows_of(0))[:, LIKELIHOOD] ** 2).mean())
    )


def test_the_page_leads_with_maximum_likelihood_and_the_command_with_the_same_sentence(made):
    page = (made.folder / "report.html").read_text(encoding="utf-8")
    assert "<dt>seed</dt><dd>7</dd>" in page
    text = html.unescape(re.sub("<[^>]*>", "", page.split("<main>")[1]))
    error = made.trials.error[:, LIKELIHOOD]
    first = (
        f"At 1 m, before a wall at 3 m, you get {1e3 * math.sqrt(np.mean(error[:, 0] ** 2)):.2g} mm and"
        f" {math.degrees(math.sqrt(np.mean(error[:, 1] ** 2))):.2g}° (1 σ) with maximum likelihood; class right 100 %"
        " of 12 trials."
    )
    assert answer(made.trials.cells()) == first
    assert made.printed.startswith(first)
    assert text.index(first) < text.index("What the camera sees")
    assert f"phasemark sweep run {made.folder}/plan.json" in text.split("Make this page again")[-1]
    assert made.printed.rstrip().endswith(str(made.folder / "report.html"))


def test_the_printed_table_has_a_row_for_each_view(made):
    for m in (LIKELIHOOD, NEAREST):
        rows = view_rows(made.trials, m)
        assert [row[:3] for row in rows] == [("1", "0", "6/6"), ("1", "45", "6/6")]
        assert all(row[3] in made.printed for row in rows)
        worst = 1e3 * np.abs(made.trials.error[:, m, 0]).max()
        assert max(float(row[4]) for row in rows) == pytest.approx(worst, abs=0.05)


def test_a_demo_is_not_overwritten_unasked(made, capsys):
    assert main(["demo", "--out", str(made.folder)]) == 4
    assert "plan.json: exists already; --force replaces it" in capsys.readouterr().err


def test_a_stream_depends_on_seed_purpose_and_index_alone():
    draw = stream(7, "frames", 17).random(8)
    np.testing.assert_array_equal(stream(7, "frames", 17).random(8), draw)
    for other in (stream(8, "frames", 17), stream(7, "poses", 17), stream(7, "frames", 18)):
        assert not np.isin(other.random(8), draw).any()


@pytest.mark.parametrize(("seed", "index"), [(-1, 0), (0, -1), (2**64, 0)])
def test_a_stream_out_of_range_is_refused(seed, index):
    with pytest.raises(UsageError, match="must be in 0"):
        stream(seed, "frames", index)
