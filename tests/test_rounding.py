"""Values beside their errors and intervals: rounded alike, the error to two significant digits."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from phasemark.data.commands.sensor import value_and_error_of
from phasemark.data.pages.characterisation import _quantity_row
from phasemark.matcher import Match
from phasemark.matcher.statistics import Interval
from phasemark.matcher.sweep.report import _with_interval
from phasemark.render.bench.data_sheet.results import SheetQuantity
from phasemark.render.bench.fit.fitted_sensor import FittedField
from phasemark.render.integral.rounding import error_text, value_and_error, with_error, with_interval


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (1.234, 0.0002, "1.23400 ± 0.00020"),
        (2.0, 0.0996, "2.00 ± 0.10"),  # rounding the error up moves its first digit
        (35571.3, 1234.0, "35600 ± 1200"),
        (-0.0004, 0.1, "0.00 ± 0.10"),
        (12.5, 3.0, "12.5 ± 3.0"),
        (12.5, 0.0, "12.5"),
        (12.5, None, "12.5"),
        (12.5, math.inf, "12.5"),
        (math.nan, 0.1, "nan"),
    ],
)
def test_the_error_has_two_digits_and_the_value_ends_where_its_error_ends(value, std, text):
    assert with_error(value, std) == text


@pytest.mark.parametrize(
    ("value", "low", "high", "text"),
    [
        (3.0, 2.88, 3.12, "3.00 [2.88, 3.12]"),
        (2.9, 2.87, 2.94, "2.900 [2.870, 2.940]"),
        (0.0, 0.0, 0.0037, "0.0000 [0.0000, 0.0037]"),
        (1.0, math.nan, math.nan, "1"),
        (1.0, 1.0, 1.0, "1 [1, 1]"),
    ],
)
def test_an_interval_is_rounded_like_its_value(value, low, high, text):
    assert with_interval(value, low, high) == text


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6))
def test_value_and_error_have_the_same_places_and_lose_less_than_a_twentieth_of_the_error(value, std):
    if std <= 1e-12 * abs(value):
        return
    text, error = value_and_error(value, std)
    places = [len(one.partition(".")[2]) for one in (text, error)]
    assert places[0] == places[1]
    assert abs(float(text) - value) <= 0.0501 * std
    assert float(error) == pytest.approx(std, rel=0.0501)
    assert error == error_text(std)


def test_tables_and_reports_round_alike():
    match = Match("cone", True, 1.234, 0.5, covariance=np.diag([0.0002**2, math.radians(0.3) ** 2]))
    assert "1.23400 ± 0.00020" in match._repr_html_()
    assert "28.65 ± 0.30" in match._repr_html_()
    assert _with_interval(Interval(0.003, 0.00288, 0.00312).scaled(1e3)) == "3.00 [2.88, 3.12]"
    assert value_and_error_of(35571.23, FittedField(35571.23, 89.0, "")) == ("35571", "89")
    assert value_and_error_of(0.5, FittedField(0.5, 0.0002, "")) == ("0.50000", "0.00020")
    assert value_and_error_of(0.5, FittedField(0.5, None, "")) == ("0.5", "assumed")
    assert FittedField(1.0, 0.0002, "noise").comment == "measured, ± 0.00020 (standard error): noise"
    row = _quantity_row(SheetQuantity("x", "x", 2.0, 2.01, 0.0102, 50))
    assert (row["predicted"], row["simulated"], row["half"]) == ("2.000", "2.010", "0.020")
