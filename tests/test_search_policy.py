"""The tuning numbers of the likelihood search: their ranges, and that they reach the search."""

from dataclasses import fields, replace

import pytest

from phasemark import UsageError
from phasemark.matcher import SearchPolicy


@pytest.mark.parametrize("field", [field.name for field in fields(SearchPolicy)])
def test_a_value_out_of_range_names_its_field(field):
    for bad in (-1, float("nan"), "2", None, True, (float("inf"),)):
        with pytest.raises(UsageError, match=f"'policy': '{field}' must be "):
            replace(SearchPolicy(), **{field: bad})  # type: ignore[arg-type]


def test_a_probability_of_one_is_refused():
    with pytest.raises(UsageError, match=r"'policy': 'doubtful_p' must be in \(0, 1\), got 1.0"):
        replace(SearchPolicy(), doubtful_p=1.0)


def test_a_policy_is_frozen():
    with pytest.raises(AttributeError):
        SearchPolicy().max_iterations = 3
