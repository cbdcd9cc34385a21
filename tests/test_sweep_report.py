"""What is made of a finished sweep: report, figures, single trials taken again, comparison, and the command line."""

import csv
import dataclasses
import html
import io
import json
import math
import re
import shutil
from typing import Any

import numpy as np
import pytest
from browser import CHROMIUM, look
from own_matchers import nearest_to_mean
from scipy import stats
from test_sweep_tables import linear_sweep

from phasemark import UsageError
from phasemark.cli import main
from phasemark.data import build_bank, read_frames
from phasemark.landmarks import LandmarkSpec, build_mesh, catalog
from phasemark.landmarks.spec import Box, Cylinder
from phasemark.matcher.filters.kalman_filters import kalman_filter
from phasemark.matcher.sweep.compare import compare_cells
from phasemark.matcher.sweep.figures.errors import against_axis, maps
from phasemark.matcher.sweep.figures.sheet import sweep_figures
from phasemark.matcher.sweep.figures.trust import confusion
from phasemark.matcher.sweep.job import Round, SweepJob
from phasemark.matcher.sweep.plan import Condition, Method, SweepPlan
from phasemark.matcher.sweep.report import answer, answer_cells, summary, write_report
from phasemark.matcher.sweep.result_tables import SweepTrials
from phasemark.matcher.sweep.run import read_sweep, run_sweep, sweep_frames
from phasemark.render import Renderer, preset

BOX = {"length_m": 0.24, "width_m": 0.16, "height_m": 0.15}
STEP = (0.02, 5.0)
PLAN = """
name = "small"
trials = 12
stranger_trials = 5
classes = ["cone", "cylinder"]
bank_distance_m = [0.9, 1.1]
axes = { distance_m = [0.95, 1.05], delta_deg = [20.0, 70.0], n_frames = [3] }
strangers = [{ name = "bare-box", box = { length_m = 0.24, width_m = 0.16, height_m = 0.15 } }]

[[methods]]
name = "nearest"
method = "nearest"
bank_step = [0.02, 5.0]

[[methods]]
name = "planar"
method = "nearest"
bank_model = "planar"
bank_step = [0.02, 5.0]

[[methods]]
name = "mean range"
method = "own_matchers:nearest_to_mean"
"""


@pytest.fixture(scope="module", autouse=True)
def one_example_of_each_method():
    """Pictures take half a second each, and every report of these tests would draw nine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("phasemark.matcher.sweep.report._MOST_EXAMPLES", 3)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A sweep and its report, made on the command line."""
    place = tmp_path_factory.mktemp("report")
    (place / "plan.toml").write_text(PLAN, encoding="utf-8")
    command = ["sweep", "run", str(place / "plan.toml"), "-o", str(place / "out"), "--workers", "2", "--trust-plan"]
    assert main(command) == 0
    return place / "out"


def test_the_report_is_one_page_that_loads_nothing(folder):
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert len(page.encode()) < 3_000_000
    assert re.findall(r'src="(?!data:)', page) == []
    for link in re.findall(r'href="([^"]*)"', page):
        assert f'id="{link[1:]}"' in page if link.startswith("#") else (folder / link).is_file()
    assert "<script" not in page
    tags = re.findall(r"<(/?)([a-z][a-z0-9]*)", page)
    paired = [("/" if end else "", name) for end, name in tags if name not in ("img", "meta", "br", "link")]
    opened: list[str] = []
    for end, name in paired:
        assert not end or opened.pop() == name
        opened += [] if end else [name]
    assert opened == []
    assert "numpy" in page.split("How it was made")[-1]
    figures = sorted(path.stem for path in (folder / "figures").glob("*.png"))
    assert figures == sorted(path.stem for path in (folder / "figures").glob("*.svg"))
    assert figures == sorted(
        ["rmse-distance-m", "rmse-delta-deg", "map-ratio", "map-rmse", "bias-arrows",
         "observability", "position-in-cell", "models", "confusion", "confusion-bound", "risk", "roc"]
    )  # fmt: skip
    # one image a figure, two of each object, and of each method a typical trial and a bad one
    assert page.count("<img") == len(figures) + 2 * 3 + 2 * 3
    assert page.count("phasemark sweep frames") == 2 * 3
    for name in ("cone", "cylinder", "bare-box"):
        assert f"<h3>{name}</h3>" in page


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here")
@pytest.mark.parametrize("width_px", [390, 1280])
def test_a_browser_shows_the_whole_report_on_a_phone_and_on_a_desktop(folder, tmp_path, width_px):
    seen = look(folder / "report.html", width_px, tmp_path)
    assert seen["width"] <= width_px
    assert seen["cut"] == []
    assert seen["console"] == []
    assert len(seen["images"]) > 10
    assert all(seen["images"])


def read_rows(path):
    return list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))


def test_the_page_answers_first_and_ends_with_its_command(folder):
    page = (folder / "report.html").read_text(encoding="utf-8")
    text = html.unescape(re.sub("<[^>]*>", "", page[page.index("<main>") :]))
    assert re.match(r"\s*small\s+At 1\.05 m you get [\d.]+ mm and [\d.]+° \(1 σ\) with [\w ]+; class right", text)
    assert "The bound: cone at 1.05 m, δ 0 … " in text
    assert text.index("you get") < text.index("Errors against distance D (m)")
    last = text.split("Make this page again")[-1].split("\n")
    commands = [line.strip() for line in last if line.strip()]
    assert commands == [
        f"phasemark sweep run {folder}/plan.json --out {folder}-again --trust-plan", f"phasemark sweep report {folder}"
    ]  # fmt: skip
    assert "distance_m" not in text
    assert "class_name" not in text


def test_the_answer_is_of_the_method_nearest_to_the_bound(folder):
    cells = [cell for cell in read_sweep(folder)[1].cells() if not cell.stranger]
    own = answer_cells(cells)
    assert {cell.condition.distance_m for cell in own} == {1.05}
    assert len(own) == 4  # two classes, two angles
    assert len({cell.method for cell in own}) == 1
    far = [cell for cell in cells if cell.condition.distance_m == 1.05]
    pooled = {
        method: max(
            math.sqrt(np.mean([cell.ratio[name].value ** 2 for cell in far if cell.method == method]))
            for name in ("distance_m", "delta_rad")
        )
        for method in ("nearest", "planar")
    }
    assert own[0].method not in pooled or pooled[own[0].method] == min(pooled.values())
    assert answer([]) == "No method found distance and angle in the middle of the design."


def test_the_command_at_the_end_makes_the_same_trials(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("phasemark.matcher.sweep.report.write_report", lambda folder: folder / "report.html")
    again = tmp_path / "again"
    assert main(["sweep", "run", str(folder / "plan.json"), "--out", str(again), "--trust-plan", "--trials", "2"]) == 0
    first = [row for row in read_rows(folder / "trials.csv") if row["trial"] in "01"]
    for one, other in zip(first, read_rows(again / "trials.csv"), strict=True):
        assert {**one, "seconds": ""} == {**other, "seconds": ""}


def test_the_numbers_of_a_map_are_those_of_its_cells_and_maps_of_ratios_share_one_scale_about_1(folder):
    cells = [cell for cell in read_sweep(folder)[1].cells() if not cell.stranger]
    drawn = {axes.get_title(): axes.images[0] for axes in maps(cells, "ratio").axes if axes.images}
    assert {image.get_clim() for image in drawn.values()} == {(0.25, 4.0)}
    table = drawn["nearest: distance"].get_array()
    assert table.shape == (2, 2)  # two distances and two angles
    for (row, column), value in np.ndenumerate(table):
        where = "nearest", (0.95, 1.05)[row], (20.0, 70.0)[column]
        both = [c for c in cells if (c.method, c.condition.distance_m, c.condition.delta_deg) == where]
        assert value == pytest.approx(np.median([c.ratio["distance_m"].value for c in both]))


def test_a_report_regenerates_bit_for_bit(folder, tmp_path, monkeypatch):
    again = shutil.copytree(folder, tmp_path / "again")
    # figures and examples take a second each: every sixth figure, one example, and the page without the others
    monkeypatch.setattr("phasemark.matcher.sweep.report.sweep_figures", lambda *of: list(sweep_figures(*of))[::6])
    monkeypatch.setattr("phasemark.matcher.sweep.report._MOST_EXAMPLES", 1)
    write_report(again)
    for file in sorted((folder / "figures").iterdir()):
        assert (again / "figures" / file.name).read_bytes() == file.read_bytes(), file.name
    before, after = (
        (place / "report.html").read_text(encoding="utf-8").replace(str(again), str(folder)).splitlines()
        for place in (folder, again)
    )
    new = [line for line in after if line not in set(before)]
    assert len(new) <= 1, new  # the list of contents


def test_three_sentences_say_what_was_found(folder):
    _, trials = read_sweep(folder)
    sentences = summary(trials, trials.cells())
    assert len(sentences) == 3
    n = int((trials.true_class >= 0).sum())
    assert int((trials.true_class < 0).sum()) == 5 * 4  # stranger_trials, not trials
    accepted = trials.accepted.copy()
    accepted[np.flatnonzero(trials.true_class >= 0)[:7], 0] = False
    trials = dataclasses.replace(trials, accepted=accepted)
    sentences = summary(trials, trials.cells())
    # the numbers of the picture beside it, whose cells are shares: classes, then "refused"
    panel = confusion(trials).axes[0]
    table = np.asarray(panel.images[0].get_array())
    shown = [label.get_text() for label in panel.get_yticklabels()]
    found = [label.get_text() for label in panel.get_xticklabels()]
    of_class = {name: sum(trials.conditions[c].class_name == name for c in trials.condition) for name in shown}
    right = sum(round(table[shown.index(name), found.index(name)] * of_class[name]) for name in trials.classes)
    refused = {name: round(table[shown.index(name), -1] * of_class[name]) for name in shown}
    strangers = refused.pop("bare-box")
    missed = sum(refused.values())
    assert missed >= 7
    expected = f"Nearest named the right class in {right} of {n - missed} answers and refused {missed} of {n} trials "
    assert sentences[2].startswith(f"{expected}({100 * missed / n:.2g} %) and {strangers} of 20 strangers")


def test_the_frames_of_a_trial_are_those_that_were_judged(folder, tmp_path):
    _, trials = read_sweep(folder)
    for k in (0, 100, len(trials) - 1):
        condition, trial = int(trials.condition[k]), int(trials.trial[k])
        again = nearest_to_mean(kalman_filter(sweep_frames(folder, condition, trial)))[0]
        assert again.distance_m == trials.estimate[k, 2, 0]
    assert main(["sweep", "frames", str(folder), "3", "7", "-o", str(tmp_path / "one.npz")]) == 0
    read = read_frames(tmp_path / "one.npz", sensor=preset("pmd-16x16"))
    np.testing.assert_array_equal(read.range_m, sweep_frames(folder, 3, 7).range_m)


def test_strangers_have_no_error_and_are_right_if_refused(folder):
    _, trials = read_sweep(folder)
    for cell in trials.cells():
        assert cell.stranger == (cell.condition.class_name == "bare-box")
        if cell.stranger:
            assert np.isnan(cell.rmse["distance_m"].value)
            assert cell.class_right.value == pytest.approx(1 - cell.accepted.value)


def test_the_bound_on_class_confusion_is_that_of_a_distance_that_grows_with_the_root_of_the_frames():
    alike = [
        LandmarkSpec(name=name, box=Box(**BOX), upper=Cylinder(radius_m=radius_m, height_m=0.15))
        for name, radius_m in (("thin", 0.06), ("thick", 0.062))
    ]
    plan = SweepPlan(
        name="confusion", trials=2, landmarks=alike, bank_distance_m=(0.95, 1.05), spread=(0.0, 0.0),
        axes={"distance_m": [1.003], "n_frames": [10, 40, 90]},
    ).resolve()  # fmt: skip
    job = SweepJob(plan, Round(0, (0, 1, 2), 0, 2))
    bounds = [job.confusion(number, job.views(number, 0, 2), 0) for number in range(3)]
    # Σ Q(d/2) over one other class, d² proportional to the frames
    half_distance = np.asarray(stats.norm.isf([bound[0] for bound in bounds]))
    # ranges change by the 2 mm that the radii differ, some 2/3 of them over 28 pixels, each known to 20 mm / √10
    assert half_distance[0] == pytest.approx(0.5 * math.sqrt(28 * 10) * 2 / 20, rel=0.5)
    # the other class's nearest view hardly moves, and where it lies its distance is at its minimum
    np.testing.assert_allclose(half_distance[1:] / half_distance[0], [2, 3], rtol=5e-3)
    assert np.isnan(job.confusion(0, job.views(0, 4, 6), 4)).all()


def test_a_hard_bank_holds_what_centre_rays_see():
    method = Method(name="m", method="nearest", bank_model="hard", bank_step=(0.05, 5.0))
    plan = SweepPlan(name="bank", classes=["cone"], bank_distance_m=(0.9, 1.1), methods=[method])
    with build_bank(plan.bank_plan(method)) as bank:
        mesh = build_mesh(catalog()["cone"])
        seen = Renderer(mesh, bank.sensor, albedo=0.8).render(bank.distance_m[1], np.deg2rad(20), variant="hard")
        image = bank.image("cone", 1, 4)
        assert set(np.unique(image.coverage)) == {0.0, 1.0}
        np.testing.assert_array_equal(image.coverage, seen.coverage)
        # a bank's upper images are those at δ = 0: a cone of flat facets, turned, differs by 1e-3 in a normal
        np.testing.assert_allclose(image.phasor, seen.phasor, rtol=0, atol=1e-3)


def test_a_sweep_does_not_differ_from_itself_and_is_not_compared_with_other_conditions(folder, capsys):
    assert main(["sweep", "compare", str(folder), str(folder), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found
    assert not any(one["significant"] for one in found)
    cells = linear_sweep(10, np.random.default_rng(1)).cells()
    with pytest.raises(UsageError, match="share no condition"):
        compare_cells(cells, read_sweep(folder)[1].cells())


def test_a_matcher_that_is_3_mm_off_is_marked_and_its_angles_are_not(tmp_path):
    cells = []
    for name in ("nearest_to_mean", "off_by_3_mm"):
        plan = SweepPlan(
            name="off", trials=200, classes=["cone"], bank_distance_m=(0.9, 1.1), outlier=(1.0, 90.0),
            axes={"distance_m": [1.0], "n_frames": [3]}, methods=[Method(name="mine", method=f"own_matchers:{name}")],
        )  # fmt: skip
        cells.append(run_sweep(plan, tmp_path / name).cells())
    found = {one.quantity: one for one in compare_cells(*cells)}
    assert found["rmse distance_m"].significant
    assert not found["rmse delta_rad"].significant
    assert not found["class_right"].significant


def test_any_false_mark_at_all_has_the_probability_that_is_stated():
    rng = np.random.default_rng(77)
    runs = 150
    any_marked = sum(
        any(one.significant for one in compare_cells(linear_sweep(150, rng).cells(), linear_sweep(150, rng).cells()))
        for _ in range(runs)
    )
    # 5 quantities of which two can differ at all: Holm makes it about 2 %; 99.9 % limit for 5 %
    assert any_marked <= stats.binom.ppf(0.999, runs, 0.05)


def test_the_commands_tell_what_is_wrong_in_one_line(folder, tmp_path, capsys):
    plan, stored = tmp_path / "bad.toml", tmp_path / "bad.json"
    plan.write_text(PLAN.replace("[0.95, 1.05]", "[0.95, 1.2]"), encoding="utf-8")
    stored.write_text("[1]")
    for arguments, code, message in (
        (["sweep", "run", "papper", "-o", str(tmp_path / "x")], 2, "unknown sweep 'papper': give paper, "),
        (["sweep", "run", str(plan), "-o", str(tmp_path / "x")], 2, r"bad.toml: axes: 'distance_m' must leave"),
        (["sweep", "run", "paper", "--trials", "0", "-o", str(tmp_path / "x")], 2, "'trials' must be greater"),
        (["sweep", "run", "paper", "-o", str(folder)], 4, "holds a sweep"),
        (["sweep", "run", "paper", "-o", str(folder), "--resume"], 4, "was begun with another plan"),
        (["sweep", "run", str(stored), "-o", str(tmp_path / "x")], 3, "cannot be read as the plan of a sweep"),
        (["sweep", "report", str(tmp_path)], 3, "holds no sweep"),
        (["sweep", "frames", str(folder), "99", "0", "-o", str(tmp_path / "x")], 2, "has conditions 0 … 11, got 99"),
        (["sweep", "frames", str(folder), "0", "12", "-o", str(tmp_path / "x")], 2, "has trials 0 … 11 of a condition"),
    ):
        assert main(arguments) == code, arguments
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1, error
    assert not (tmp_path / "x").exists()


def test_a_matcher_of_ones_own_joins_the_methods(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("phasemark.matcher.sweep.report.write_report", lambda folder: folder / "report.html")
    plan = folder.parent / "plan.toml"
    options = ["--trials", "2", "--matcher", "own_matchers:off_by_3_mm", "--trust-plan", "-o", str(tmp_path / "own")]
    assert main(["sweep", "run", str(plan), *options]) == 0
    capsys.readouterr()
    assert main(["sweep", "report", str(tmp_path / "own"), "--json"]) == 0
    cells = json.loads(capsys.readouterr().out)["cells"]
    assert {cell["method"] for cell in cells} == {"nearest", "planar", "mean range", "own_matchers:off_by_3_mm"}


def test_bank_models_without_mixed_pixels_go_with_the_nearest_image_only():
    assert Method(name="a", method="nearest", bank_model="hard").bank_model == "hard"
    with pytest.raises(UsageError, match="'a' refines, which needs 'bank_model' ray, got hard"):
        Method(name="a", method="refine", bank_model="hard")


def always_the_same(n: int = 60) -> SweepTrials:
    """Two sides of a box, 28° and 70°; one method errs by twice the bound, the other always answers 1 m and 28.6°."""
    rng = np.random.default_rng(3)
    trials = linear_sweep(n, rng)
    truth = trials.truth.copy()
    condition = np.arange(n) // (n // 2)  # trials of a condition follow one another
    truth[:, 1] = np.radians(np.where(condition == 0, 28.0, 70.0) + rng.uniform(-1, 1, n))
    honest = truth[:, None].copy()
    honest[:, 0, :2] += 2 * (trials.estimate - trials.truth[:, None])[:, 0, :2]
    same = truth[:, None].copy()
    same[:, 0, :2] = truth[:, :1].mean(), np.radians(28.6)
    names = "bound", "covariance", "chi2", "p_value", "p_none", "seconds", "dof", "found", "modes", "accepted"
    both: dict[str, Any] = {name: np.concatenate([getattr(trials, name)] * 2, axis=1) for name in names}
    return dataclasses.replace(
        trials, conditions=(Condition("box", delta_deg=28.0), Condition("box", delta_deg=70.0)),
        methods=("same", "honest"), free=trials.free * 2, outlier=(0.2, 5.0), condition=condition, truth=truth,
        estimate=np.concatenate([same, honest], axis=1), **both,
    )  # fmt: skip


def test_a_method_that_always_says_the_same_ranks_behind_one_with_larger_errors_and_no_outliers():
    trials = always_the_same()
    cells = trials.cells()
    same = [cell for cell in cells if cell.method == "same"]
    assert [cell.outliers.value for cell in same] == [0.0, 1.0]
    assert math.isfinite(same[0].rmse["delta_rad"].value)
    assert not math.isfinite(same[1].rmse["delta_rad"].value)
    assert answer_cells(cells)[0].method == "honest"
    first, second, _ = summary(trials, cells)
    assert "bound: honest no outliers, " in first  # the best method first
    assert "; same 50 % outliers, " in first
    assert "for same, 100 % outliers at δ = 70°" in second
    (alone,) = {cell.method for cell in answer_cells(same)}
    assert alone == "same"
    assert "(1 σ), 50 % outliers left out, with same; class right" in answer(same)
    legend = against_axis(cells, "delta_deg", ["delta_deg"]).legends[0]
    written = [text.get_text() for text in legend.get_texts()]
    assert "same, 50 % outliers" in written
    assert "same, with outliers" in written
    panel = maps(same, "rmse").axes[0]
    assert [text.get_text() for text in panel.texts][1] == "100 % out"
