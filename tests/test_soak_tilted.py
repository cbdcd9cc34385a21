"""All six numbers of a view against the bound, long: run by ``make soak`` before a release."""

import math

import numpy as np
import pytest

from phasemark.data import BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher
from phasemark.matcher.accuracy import Trials, TrialSetup, run_trials
from phasemark.matcher.likelihood.images import VIEW
from phasemark.render import Renderer

pytestmark = pytest.mark.soak

CLASSES = ("cylinder", "cone")
CAMERAS = {"16 x 16": ({}, 5000, 1000), "64 x 64": ({"rows": 64, "cols": 64}, 5000, 400)}
"""Fields of the camera, N, and frames averaged: enough of them that pitch and roll are known to 0.1° and less."""


@pytest.mark.parametrize("camera", CAMERAS)
def test_all_six_numbers_are_at_the_bound_and_the_covariance_is_honest(tmp_path, camera):
    fields, n, n_frames = CAMERAS[camera]
    plan = BankPlan(classes=CLASSES, distance_m="0.88:1.24:0.02", delta_deg="0:180:2", sensor_overrides=fields)
    setup = TrialSetup(
        free=VIEW, distance_m=(0.9, 1.2), bearing_rad=0.04, height_m=0.04, pitch_rad=0.05, roll_rad=0.1,
        n_frames=n_frames,
    )  # fmt: skip
    rng = np.random.default_rng(2026)
    with build_bank(plan, tmp_path / "bank.h5") as bank:
        matcher = Matcher(bank, "refine", free=VIEW, pitch_std_rad=math.inf, roll_std_rad=math.inf)
        parts = [
            run_trials(matcher.match, Renderer(build_mesh(catalog()[name]), bank.sensor), name, setup, n // 2, rng)
            for name in CLASSES
        ]
    summary = Trials.joined(parts).summary()
    z = 3.3 / 1.96  # intervals of 95 % widened to 99.9 %
    for ratio in (*summary.ratio.values(), summary.nees):
        half = z * (ratio.high - ratio.value)
        assert ratio.value - half <= 1.05
        assert ratio.value + half >= 0.97
    assert summary.coverage.high >= 0.94
    assert summary.coverage.low <= 0.96
    assert summary.astray.low <= 0.003
    assert summary.outliers.low <= 0.006
    # an accepted answer is right
    for part in parts:
        wrong = part.accepted & ((part.found != part.class_name) | (np.abs(part.error[:, 0]) > 0.03))
        assert not wrong.any()
    assert sum(int((part.found != part.class_name).sum()) for part in parts) <= n / 500
