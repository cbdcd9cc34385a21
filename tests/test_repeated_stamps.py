"""Repeated time stamps get times of their own where the gap beside them has room."""

import math

import numpy as np
import pytest

from phasemark.matcher.filters.stamps import spread_stamps, stamp_jitter


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        ([0, 1, 2, 3], [0, 1, 2, 3]),
        ([0, 2, 2, 4, 4, 5, 6], [0, 1, 2, 3, 4, 5, 6]),  # stamped late, together with the next frame
        ([0, 1, 1, 3, 4, 5], [0, 1, 2, 3, 4, 5]),  # stamped early, together with the frame before
        ([0, 3, 3, 3, 4, 5, 6], [0, 1, 2, 3, 4, 5, 6]),
        ([0, 1, 2, 2, 3, 4], [0, 1, 2, 2, 3, 4]),  # no room: which of the two is right is not known
        ([0, 1, 2, 9, 9, 10, 11], [0, 1, 2, 9, 9, 10, 11]),  # a pause is no room
        ([5, 5, 5], [5, 5, 5]),
        ([7], [7]),
    ],
)
def test_repeated_stamps_are_spread_over_a_gap_of_their_length(stamps, expected):
    before = np.array(stamps, float)
    np.testing.assert_allclose(spread_stamps(before), expected)
    assert before.tolist() == stamps  # what was read stays


def test_stamps_that_repeat_are_known_to_one_period():
    assert stamp_jitter(np.arange(5.0)) == 0
    assert stamp_jitter(np.array([0.0, 0.2, 0.2, 0.3, 0.4])) == pytest.approx(0.1 / math.sqrt(12))
