"""Sweeps over pitch and roll, with methods that estimate them; the tables of others have no columns of tilt."""

import csv

import numpy as np
import pytest

from phasemark import UsageError
from phasemark.matcher.sweep.job import job_of
from phasemark.matcher.sweep.plan import Method, SweepPlan
from phasemark.matcher.sweep.run import read_sweep, run_sweep

SIX = ("bearing", "height", "pitch", "roll")


def plan(methods, **axes):
    return SweepPlan(
        name="tilted", trials=8, classes=["cone"], axes={"distance_m": [1.0], "n_frames": [200], **axes},
        bank_distance_m=(0.9, 1.1), methods=methods,
    )  # fmt: skip


def test_a_method_that_estimates_the_tilt_is_judged_by_it(tmp_path):
    methods = [Method(name="six", free=SIX, bank_step=(0.02, 2.0))]
    trials = run_sweep(plan(methods, pitch_deg=[3.0], roll_deg=[-4.0]), tmp_path, workers=1)
    np.testing.assert_allclose(np.degrees(trials.truth[:, 4:]), [[3.0, -4.0]] * len(trials))
    assert trials.estimate.shape[2] == 6
    error = trials.error[:, 0]
    std = np.sqrt(np.einsum("npp->np", trials.bound[:, 0]))
    assert np.abs(error / std).max() < 5
    with (tmp_path / "trials.csv").open() as file:
        row = next(csv.DictReader(file))
    assert {"true_pitch_rad", "error_roll_rad", "cov_height_pitch"} <= set(row)
    with (tmp_path / "cells.csv").open() as file:
        cell = next(csv.DictReader(file))
    assert float(cell["roll_deg"]) == -4.0
    assert float(cell["rmse_pitch_rad"]) < 0.02
    np.testing.assert_array_equal(read_sweep(tmp_path)[1].estimate, trials.estimate)


def test_a_pitch_that_no_method_estimates_is_an_error_of_the_mounting(tmp_path):
    level = plan([Method(name="nearest", method="nearest", bank_step=(0.02, 2.0))], pitch_deg=[2.0])
    assert not level.is_tilted
    trials = run_sweep(level, tmp_path, workers=1)
    assert trials.truth.shape[1] == 4
    for name in ("trials.csv", "cells.csv"):
        header = (tmp_path / name).read_text().splitlines()[0].split(",")
        assert not [column for column in header if "roll" in column or column.endswith("pitch_rad")]


def test_a_pitch_of_a_view_shows_what_one_of_the_mounting_does():
    pitched = {"pitch_deg": [2.0], "roll_deg": [1.0]}
    spec = {"round": [0, [0], 0, 2]}
    jobs = [
        job_of({**spec, "plan": one.model_dump(mode="json")})
        for one in (
            plan([Method(name="six", free=SIX)], pitch_deg=[2.0]),
            plan([Method(name="nearest", method="nearest")], pitch_deg=[2.0]),
        )
    ]
    images = [job.image(0, job.views(0, 0, 2)) for job in jobs]
    np.testing.assert_allclose(images[0].phasor, images[1].phasor, rtol=0, atol=1e-12)
    assert plan([Method(name="nearest", method="nearest")], **pitched).is_tilted


def test_a_roll_out_of_range_is_refused():
    with pytest.raises(UsageError, match=r"axes: 'roll_deg' must be .* in \[-45, 45\], got 50"):
        plan([Method(name="nearest", method="nearest")], roll_deg=[50.0])
