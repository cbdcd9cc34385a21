"""Frames that were damaged, and what a matcher owes them: an answer, never a view that is not a number."""

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from phasemark.matcher import kalman_filter
from phasemark.render import Frames

DAMAGE = {
    "damaged": hnp.arrays(bool, (16, 16)),
    "value": st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e300, -1.0, 0.0, 1e-300, 14.99, 1e18]),
    "distance_m": st.floats(0.8, 1.6),
    "share_kept": st.sampled_from([0.0, 0.01, 0.5, 1.0]),
    "meaning": st.sampled_from(["missing", "no-return"]),
    "seed": st.integers(0, 2**32 - 1),
}
"""How a frame may be damaged: which pixels, to what, and what is left of the rest."""


def check_damaged(matchers, renderer, damaged, value, distance_m, share_kept, meaning, seed):
    """Assert that a damaged frame gets an answer, and never a view that is not a number."""
    clean = renderer.render(distance_m, 0.4).range_m[0]
    rng = np.random.default_rng(seed)
    ranges = np.where(damaged, value, clean + rng.normal(0, 0.02, (5, 16, 16)))
    ranges = np.where(rng.random((16, 16)) < share_kept, ranges, np.nan)
    frames = kalman_filter(Frames(ranges, sensor=renderer.sensor, invalid_means=meaning))
    for matcher in matchers:
        match = matcher.match(frames)[0]
        figures = [match.distance_m, match.delta_rad, match.bearing_rad, match.height_m, match.chi2, match.p_value]
        assert match.class_name is None or np.isfinite(figures).all()
        assert not match.accepted or np.isfinite(match.covariance).all()
        assert sum(match.class_probability.values()) == pytest.approx(1)
