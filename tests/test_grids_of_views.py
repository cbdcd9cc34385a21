"""Grids of distances and angles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from phasemark import UsageError
from phasemark.data.plans import format_grid, parse_grid
from phasemark.data.plans.grid_axis import MAX_POINTS, drop_repeated_stop


def test_default_distances_are_141_exactly_rounded_decimals():
    values = parse_grid("0.7:2.1:0.01")
    assert values.tolist() == [float(f"{cm / 100:.2f}") for cm in range(70, 211)]


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("0:1:0.25", [0, 0.25, 0.5, 0.75, 1]),
        ("0:1:0.3", [0, 0.3, 0.6, 0.9]),  # STOP is not on the grid
        ("1:1:1", [1]),
        ("-10:10:10", [-10, 0, 10]),
        ("0.8,1,1.2", [0.8, 1, 1.2]),
        (" 0.8 , 1 ", [0.8, 1]),
        ("1", [1]),
        (1.5, [1.5]),
        ([1, 2.5], [1, 2.5]),
        ((3,), [3]),
    ],
)
def test_every_form_of_a_grid_gives_its_values(text, values):
    assert parse_grid(text).tolist() == values


@pytest.mark.parametrize(
    ("grid", "reason"),
    [
        ("0:1:0", "positive STEP"),
        ("0:1:-0.1", "positive STEP"),
        ("1:0:0.1", "STOP that is not below START"),
        ("0:1", "START:STOP:STEP"),
        ("0:1:0.1:2", "START:STOP:STEP"),
        ("a:1:0.1", "finite numbers"),
        ("0:inf:1", "finite numbers"),
        ("nan", "finite numbers"),
        ("", "finite numbers"),
        ("1,,2", "finite numbers"),
        ("1,1", "must increase"),
        ("2,1", "must increase"),
        ("0:1:1e-9", "at most"),
        ([0.0] * (MAX_POINTS + 1), "at most"),
        ([], "at least one"),
        ([1, "x"], "finite numbers"),
        ([True], "finite numbers"),
        (True, "START:STOP:STEP"),
        (None, "START:STOP:STEP"),
        ({"start": 1}, "START:STOP:STEP"),
    ],
)
def test_a_bad_grid_is_one_line_naming_option_and_value(grid, reason):
    with pytest.raises(UsageError, match=reason) as caught:
        parse_grid(grid, "--distance")
    message = str(caught.value)
    assert message.startswith("'--distance' must")
    assert "got" in message
    assert "\n" not in message
    assert len(message) < 200


@given(st.integers(-500, 500), st.integers(1, 300), st.sampled_from([0.001, 0.01, 0.05, 0.1, 0.125, 1 / 3, 1, 2.5]))
def test_a_grid_survives_being_written_as_text(first, n, step):
    values = np.round((first + np.arange(n)) * step, 12)
    assert parse_grid(format_grid(values)).tolist() == values.tolist()


def test_regular_grids_are_written_short():
    assert format_grid(parse_grid("0.7:2.1:0.01")) == "0.7:2.1:0.01"
    assert format_grid(parse_grid("0:179:1")) == "0:179:1"
    assert format_grid([0.8, 1.0, 1.3]) == "0.8,1,1.3"


@pytest.mark.parametrize(
    ("grid", "period", "last"),
    [
        ("0:180:1", 180, 179),
        ("0:180:1", 360, 180),
        ("0:360:1", 360, 359),
        ("0:360:1", 180, 359),
        ("10:100:0.1", 90, 99.9),
        ("0:179:1", 180, 179),
        ("0", 180, 0),
    ],
)
def test_a_stop_that_repeats_start_by_symmetry_is_dropped(grid, period, last):
    assert drop_repeated_stop(parse_grid(grid), period)[-1] == last
