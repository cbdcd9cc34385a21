"""Errors of located objects: their sizes are found from calibrating poses, and ellipsoids hold the truths."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from oracles.simple_scenes import block_on_table, poses_around
from scipy.stats import binom, chi2

from phasemark import UsageError
from phasemark.matcher.histograms import pose_calibration
from phasemark.matcher.histograms.object_pose import match_jointly, pose_covariance
from phasemark.matcher.histograms.pose_calibration import KnownObject, PoseCalibration
from phasemark.matcher.histograms.pose_errors import Contrast, PoseErrors, gradient_covariance
from phasemark.matcher.histograms.pose_evidence import FITTED, Evidence, evidence_of, solve_jointly
from phasemark.matcher.histograms.scene_prediction import POSE_PARAMETERS, ObjectScene
from phasemark.render import preset
from phasemark.render.direct.histogram_frames import HistogramFrames

SENSOR = preset("tmf8820-3x3")
SCENE = ObjectScene(block_on_table(), SENSOR)
TRUE = PoseErrors(2.0, 0.5e-3, 0.0, 0.0, 0.8e-3, 0.012, 0.6, 1e-3, 0.005, 1e-3, 0.008)
N, KNOWN = 44, 24


@cache
def noise_free() -> Evidence:
    """Return evidence without noise of poses in random order around a block."""
    poses = poses_around(N, seed=5)[np.random.default_rng(6).permutation(N)]
    h = SCENE.histogram
    counts = SCENE.signal(poses, np.zeros(6), 0.6) * 0.5 + h.cycles * (h.ambient + h.dark)
    frames = HistogramFrames(counts.reshape(N, 1, 3, 3, -1), sensor=SENSOR)
    linear = SCENE.linearise(frames, poses, np.zeros(6), 0.6, (*POSE_PARAMETERS, "support"))
    return evidence_of(linear, frames.zone_counts, FITTED)


def drawn(rng: np.random.Generator) -> Evidence:
    """Return evidence whose gradients have the errors of `TRUE`, all in the first zone."""
    evidence = noise_free()
    seen = Contrast.estimate(evidence)
    covariance = gradient_covariance(seen, TRUE)
    size = np.sqrt(np.diag(covariance))
    root = np.linalg.cholesky(covariance / np.outer(size, size) + 1e-9 * np.eye(len(size)))
    gradient = np.zeros_like(evidence.gradient)
    hand = np.repeat([TRUE.hand_m, TRUE.hand_rad], 3) * rng.standard_normal(6)
    gradient[:, 0] = (size * (root @ rng.standard_normal(len(size)))).reshape(N, -1)
    gradient[:, 0] += seen.information @ seen.lever @ hand
    fields = {name: getattr(evidence, name) for name in ("chi2", "dof", "free", "direction", "lever")}
    return Evidence(evidence.information, gradient, **fields)


def inside(trials: int, seed: int, k: int) -> int:
    """Return how many of the places of a known block lie inside the ellipsoid of k other poses."""
    rng = np.random.default_rng(seed)
    found = 0
    hand = TRUE.covariance_of("hand")
    for _ in range(trials):
        evidence = drawn(rng)
        known = evidence.of_poses(np.arange(KNOWN))
        place = solve_jointly(known)[0][:6]
        calibration = PoseCalibration(SENSOR, TRUE, hand, (KnownObject("block", place, known),), 1.0)
        part = evidence.of_poses(np.arange(KNOWN, KNOWN + k))
        away = solve_jointly(part)[0][:6] - place
        covariance = pose_covariance(part, calibration=calibration, name="block")[0][:6, :6]
        found += bool(away @ np.linalg.solve(covariance, away) <= chi2.ppf(0.95, 6))
    return found


@pytest.mark.parametrize("k", [4, 16])
def test_the_ellipsoid_of_a_known_object_holds_95_percent_of_the_truths(k: int) -> None:
    low, high = binom.interval(0.9995, 200, 0.95)  # 99.9 % for two cases
    assert low <= inside(200, 70 + k, k) <= high


def test_sizes_of_errors_are_found_from_calibrating_poses() -> None:
    rng = np.random.default_rng(9)
    found = pose_calibration._likeliest([drawn(rng).of_poses(np.arange(KNOWN)) for _ in range(2)])
    # 48 poses of some eight sides: sizes to a third, and the scale of 432 histograms to a tenth
    assert found.scale == pytest.approx(TRUE.scale, rel=0.25)
    assert TRUE.side_m / 2 < found.side_m < 2 * TRUE.side_m
    assert found.pose_m < 0.5e-3


def test_a_mesh_counts_beside_the_three_that_are_stated() -> None:
    places = np.zeros((2, 6))
    assert pose_calibration._object_errors(places[:1]) == pytest.approx((1e-3, np.radians(0.5)))
    places[1, :3] = 4e-3  # variance 8 mm² of three components beside 1 mm² of nine
    assert pose_calibration._object_errors(places)[0] == pytest.approx(np.sqrt((9 + 24) / 12) * 1e-3)


def test_a_sensor_states_its_errors_and_another_object_is_less_sure() -> None:
    sensor = SENSOR.with_(histogram={**SENSOR.histogram.model_dump(), **TRUE.as_fields()})
    np.testing.assert_allclose(PoseErrors.of(sensor.histogram), TRUE, rtol=1e-3)
    assert PoseErrors.of(SENSOR.histogram) is None
    evidence = noise_free()
    known, rest = evidence.of_poses(np.arange(KNOWN)), evidence.of_poses(np.arange(KNOWN, N))
    objects = (KnownObject("block", np.zeros(6), known),)
    calibration = PoseCalibration(sensor, TRUE, TRUE.covariance_of("hand"), objects, 1.0)
    own, terms = pose_covariance(rest, calibration=calibration, name="block")
    other = pose_covariance(rest, calibration=calibration)[0]
    assert set(terms) == {"model", "pose", "side", "hand", "object"}
    assert (np.diag(other)[:6] > np.diag(own)[:6]).all()
    frames = HistogramFrames(np.ones((2, 1, 3, 3, 128)), sensor=SENSOR)
    with pytest.raises(UsageError, match=r"^'name' must be one of block, got 'cone'$"):
        match_jointly(frames, poses_around(2), SCENE, calibration=calibration, name="cone")
    with pytest.raises(UsageError, match=r"^'name' must be left out without a calibration, got 'block'$"):
        match_jointly(frames, poses_around(2), SCENE, name="block")
