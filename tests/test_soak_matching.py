"""The matcher against the bound, long: run by ``make soak`` before a release."""

import math

import numpy as np
import pytest

from phasemark.data import BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Conditions, Matcher, Trials, run_trials
from phasemark.matcher.models import VIEW
from phasemark.render import Background, Renderer, preset

pytestmark = pytest.mark.soak

SENSOR = preset("pmd-16x16")
WALL = Background(wall_m=4.0)
BEARING = VIEW[:3]
ROWS = {
    "ranges": (5000, 1.05, Conditions(), {}),
    "wall": (5000, 1.05, Conditions(background=WALL), {"background": WALL}),
    "phasors": (5000, 1.07, Conditions(on="phasors"), {"on": "phasors"}),
    "bearing": (1000, 1.10, Conditions(free=BEARING, bearing_rad=0.05), {"free": BEARING}),
    "bearing, wall": (
        1000,
        1.10,
        Conditions(free=BEARING, bearing_rad=0.05, background=WALL),
        {"free": BEARING, "background": WALL},
    ),
    "automatic wall": (
        1000,
        1.05,
        Conditions(background=WALL, nuisances=("wall_m",)),
        {"background": "auto"},
    ),
}


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    with build_bank(BankPlan(), tmp_path_factory.mktemp("bank") / "bank.h5") as opened:
        yield opened


@pytest.mark.parametrize("row", ROWS)
def test_errors_are_at_the_bound_and_the_covariance_is_honest(bank, row):
    n, limit, conditions, options = ROWS[row]
    rng = np.random.default_rng(2005)
    matcher = Matcher(bank, "refine", **options)

    def sharp(bound):
        """Views whose δ the bound knows to half a degree; what is known worse is not a linear problem."""
        return np.sqrt(bound[:, 1, 1]) < math.radians(0.5)

    parts = [
        run_trials(
            matcher.match,
            Renderer(build_mesh(spec), SENSOR, albedo=0.8),
            name,
            conditions,
            n // 4,
            rng,
            choose=sharp if row == "bearing" else None,
        )
        for name, spec in catalog().items()
    ]
    summary = Trials.joined(parts).summary()
    z = 3.3 / 1.96  # intervals of 95 % widened to 99.9 %
    for ratio in summary.ratio.values():
        assert ratio.value - z * (ratio.high - ratio.value) <= limit
    for bias in summary.bias.values():
        assert abs(bias.value) <= 0.1 + z * (bias.high - bias.value)
    assert 0.95 - z * (summary.nees.high - summary.nees.value) <= summary.nees.value
    assert summary.nees.value <= 1.10 + z * (summary.nees.high - summary.nees.value)
    assert summary.coverage.high >= 0.935
    assert summary.coverage.low <= 0.965
    assert sum(int((part.found != part.class_name).sum()) for part in parts) <= n / 1000
