"""The numbers of a figure as CSV: what was drawn comes back."""

import csv
import io

import numpy as np
import pytest
from matplotlib.figure import Figure

from phasemark.data.pages.figure_data import HEADER, figure_csv


def rows_of(*figures):
    rows = list(csv.DictReader(io.StringIO(figure_csv(*figures).decode())))
    assert all(tuple(row) == HEADER for row in rows)
    return rows


def test_points_bars_and_colours_come_back():
    figure = Figure()
    left, right = figure.subplots(1, 2)
    left.set(title="errors", xlabel="D (m)", ylabel="RMSE (mm)")
    left.errorbar([1.0, 2.0, 3.0], [10.0, 20.0, np.nan], [[1, 2, 0], [3, 4, 0]], label="nearest")
    left.plot([1.0, 2.0], [5.0, 6.0], label="bound")
    left.axhline(0)  # a line of the axes holds no number
    shown = right.imshow(np.array([[1.0, 2.0], [3.0, np.nan]]), origin="lower")
    figure.colorbar(shown, ax=right)
    rows = rows_of(figure)
    bars = [row for row in rows if row["series"] == "nearest"]
    assert [(row["x"], row["y"], row["low"], row["high"]) for row in bars] == [
        ("1", "10", "9", "13"), ("2", "20", "18", "24"), ("3", "", "", ""),
    ]  # fmt: skip
    assert {(row["panel"], row["x_axis"], row["y_axis"]) for row in bars} == {("errors", "D (m)", "RMSE (mm)")}
    assert [(row["x"], row["y"]) for row in rows if row["series"] == "bound"] == [("1", "5"), ("2", "6")]
    colours = [row for row in rows if row["series"] == "colour"]
    assert [(row["x"], row["y"], row["value"]) for row in colours] == [
        ("0", "0", "1"), ("1", "0", "2"), ("0", "1", "3"), ("1", "1", ""),
    ]  # fmt: skip
    assert len(rows) == 3 + 2 + 4


def test_rows_of_pixels_count_from_the_top():
    figure = Figure()
    figure.subplots().imshow(np.array([[1.0, 2.0], [3.0, 4.0]]), extent=(0, 2, 2, 0))
    places = {row["value"]: (float(row["x"]), float(row["y"])) for row in rows_of(figure)}
    assert places == {"1": (0.5, 0.5), "2": (1.5, 0.5), "3": (0.5, 1.5), "4": (1.5, 1.5)}


def test_arrows_come_back_and_figures_follow_one_another():
    figure = Figure()
    figure.subplots().quiver([1.0], [2.0], [0.3], [-0.4])
    rows = rows_of(figure, figure)
    assert len(rows) == 4
    assert [float(row["value"]) for row in rows] == pytest.approx([0.3, -0.4, 0.3, -0.4])
