"""The paper's experiment at a small size: the same whatever the workers, and a report that stands alone."""

import csv
import html
import io
import math
import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from browser import CHROMIUM, look

from phasemark import OutputExistsError, UsageError
from phasemark.data.seeds import stream
from phasemark.matcher.demo.report import answer, summary_rows, write_demo
from phasemark.matcher.demo.run import LANDMARK_XY_M, LIKELIHOOD, NEAREST, cells_csv, run_demo, trials_csv

SMALL: dict[str, Any] = {
    "classes": ("cone", "post"),
    "distances_m": (1.0,),
    "deltas_deg": (0.0, 45.0),
    "repetitions": 3,
    "n_frames": 20,
    "bank_distance_m": "0.96:1.04:0.01",
    "bank_delta_deg": "0:180:1",
}


@pytest.fixture(scope="module")
def result():
    return run_demo(workers=1, **SMALL)


@pytest.fixture(scope="module")
def written(result, tmp_path_factory):
    return write_demo(result, tmp_path_factory.mktemp("demo"))


def test_cells_on_the_grid_are_found_exactly(result):
    for cell in result.select(shifted=False):
        assert cell.class_right.all()
        assert np.abs(cell.distance_error_m).max() < 1e-9
        assert np.abs(cell.delta_error_rad).max() < 1e-9


def test_shifted_cells_lie_between_grid_points_and_are_missed_by_at_least_their_shift(result):
    shifted = result.select(shifted=True)
    assert len(shifted) == len(result.select(shifted=False)) == 4
    for cell in shifted:
        assert cell.class_right.all()
        assert np.abs(cell.distance_error_m).min() >= 0.0037 - 1e-9


def test_the_result_does_not_depend_on_the_number_of_workers(result):
    other = run_demo(workers=3, **SMALL)
    assert trials_csv(other.cells) == trials_csv(result.cells)
    assert cells_csv(other.cells) == cells_csv(result.cells)


def test_another_seed_gives_other_frames(result):
    other = run_demo(workers=2, seed=1, **SMALL)
    assert trials_csv(other.cells) != trials_csv(result.cells)


def test_the_table_of_cells_follows_from_the_table_of_trials(result):
    trials = list(csv.DictReader(io.StringIO(trials_csv(result.cells))))
    for row in csv.DictReader(io.StringIO(cells_csv(result.cells))):
        same = ("class", "shifted", "method", "distance_m", "delta_deg")
        own = [t for t in trials if all(t[key] == row[key] for key in same)]
        assert len(own) == int(row["trials"]) == 3
        errors = [1e3 * abs(float(t["found_distance_m"]) - float(t["distance_m"])) for t in own]
        # both tables are rounded, to 1e-6 m and 1e-4 mm
        assert float(row["median_abs_distance_error_mm"]) == pytest.approx(sorted(errors)[1], abs=2e-3)
        assert int(row["class_right"]) == sum(t["found_class"] == t["class"] for t in own)


def test_the_position_error_is_the_distance_of_the_nearest_symmetric_pose(result):
    for cell in result.cells:
        d, delta = cell.cell.distance_m, cell.cell.delta_rad
        truth = np.array(LANDMARK_XY_M) - d * np.array([math.cos(delta), math.sin(delta)])
        for match, error in zip(cell.matches, cell.position_error_m, strict=True):
            found = [
                np.array(LANDMARK_XY_M)
                - match.distance_m * np.array([math.cos(match.delta_rad + turn), math.sin(match.delta_rad + turn)])
                for turn in (0, math.pi)
            ]
            assert error == pytest.approx(min(np.hypot(*(place - truth)) for place in found), abs=1e-9)


class _Sources(HTMLParser):
    def __init__(self):
        super().__init__()
        self.sources, self.open = [], []

    def handle_starttag(self, tag, attributes):
        self.sources += [value for name, value in attributes if name in ("src", "href")]
        if tag not in ("img", "meta", "br", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_report_loads_nothing_and_its_tags_are_balanced(written):
    page = _Sources()
    page.feed(written.read_text(encoding="utf-8"))
    assert page.open == []
    pictures = [source for source in page.sources if source.startswith("data:image/png;base64,")]
    assert len(pictures) == 10  # two a class, four matches, classes and errors
    text = written.read_text(encoding="utf-8")
    for link in set(page.sources) - set(pictures):
        assert f'id="{link[1:]}"' in text if link.startswith("#") else (written.parent / link).is_file()


def test_the_report_states_the_seed_the_versions_and_each_class(written, result):
    text = written.read_text(encoding="utf-8")
    assert f"phasemark demo --seed {result.seed}" in text
    assert "numpy" in text
    for name in result.bank.classes:
        assert f"<h3>{name}</h3>" in text


def test_maximum_likelihood_is_as_accurate_as_its_covariance_between_grid_points(result):
    """24 errors of two parameters over their standard deviations: mean square 1, ± 3.3 √(2 / 24)."""
    own = result.select(shifted=True, method=LIKELIHOOD)
    assert all(cell.class_right.all() for cell in own)
    squares = [
        (error**2 / [match.covariance[k, k] for match in cell.matches]).mean()
        for cell in own
        for k, error in enumerate((cell.distance_error_m, cell.delta_error_rad))
    ]
    assert abs(np.mean(squares) - 1) < 3.3 * math.sqrt(2 / 24)


def test_the_page_leads_with_maximum_likelihood_between_grid_points(written, result):
    text = html.unescape(re.sub("<[^>]*>", "", written.read_text(encoding="utf-8").split("<main>")[1]))
    assert answer(result) in text
    assert text.index(answer(result)) < text.index("Errors between grid points")
    headings = [text.index(title) for title in ("Maximum likelihood, between grid", "Nearest image, between grid")]
    assert headings == sorted(headings)
    assert "it found the true grid point in 12 of 12 trials" in text
    assert text.count("0.00") < 10  # no rows of errors that cannot be anything else
    for name in ("distance_m", "delta_deg", "median_abs"):
        assert name not in text
    assert text.rstrip().split("Make this page again")[-1].split()[:2] == ["phasemark", "demo"]


def test_the_answer_is_the_root_mean_square_error_of_its_cells(result):
    own = result.select(shifted=True, method=LIKELIHOOD)
    error = np.concatenate([cell.distance_error_m for cell in own])
    assert f"you get {1e3 * math.sqrt(np.mean(error**2)):.2g} mm" in answer(result)


def test_no_panel_of_the_report_is_empty(written):
    """Every panel of the errors has a point for each angle and distance, and errors that are not 0."""
    rows = list(csv.DictReader(io.StringIO((written.parent / "errors.csv").read_text(encoding="utf-8"))))
    assert {row["panel"] for row in rows} == {LIKELIHOOD, NEAREST}
    assert len(rows) == 2 * 3 * 2
    assert all(float(row["high"]) > 0 for row in rows)
    classes = list(csv.DictReader(io.StringIO((written.parent / "classes.csv").read_text(encoding="utf-8"))))
    assert sum(float(row["value"]) for row in classes) == 2 * 2 * 2 * 3


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here")
@pytest.mark.parametrize("width_px", [390, 1280])
def test_a_browser_shows_the_whole_report_on_a_phone_and_on_a_desktop(written, tmp_path, width_px):
    seen = look(written, width_px, tmp_path)
    assert seen["width"] <= width_px
    assert seen["cut"] == []
    assert seen["console"] == []
    assert all(seen["images"])


def test_reports_are_not_overwritten_unasked(written, result):
    with pytest.raises(OutputExistsError):
        write_demo(result, written.parent)
    assert write_demo(result, written.parent, force=True) == written


def test_the_printed_summary_has_a_row_for_each_view(result):
    assert [row[:3] for row in summary_rows(result.select(shifted=False))] == [
        ("100.00", "0.00", "6/6"),
        ("100.00", "45.00", "6/6"),
    ]


@pytest.mark.parametrize("wrong", [{"repetitions": 0}, {"n_frames": 0}, {"classes": ("pyramid",)}])
def test_wrong_arguments_are_refused(wrong):
    with pytest.raises(UsageError):
        run_demo(**{**SMALL, **wrong})


def test_a_stream_depends_on_seed_purpose_and_index_alone():
    draw = stream(7, "frames", 17).random(8)
    np.testing.assert_array_equal(stream(7, "frames", 17).random(8), draw)
    for other in (stream(8, "frames", 17), stream(7, "poses", 17), stream(7, "frames", 18)):
        assert not np.isin(other.random(8), draw).any()


@pytest.mark.parametrize(("seed", "index"), [(-1, 0), (0, -1), (2**64, 0)])
def test_a_stream_out_of_range_is_refused(seed, index):
    with pytest.raises(UsageError, match="must be in 0"):
        stream(seed, "frames", index)
