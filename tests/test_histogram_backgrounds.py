"""Histograms and targets before a wall or a floor: bound, honest covariance, and what must be refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from direct_landmarks import (
    FREE,
    Stated,
    bank_of,
    check_bound,
    frames_of,
    matcher_of,
    random_views,
    renderer_of,
    right_answers,
    trials,
)
from scipy.stats import binom, chi2

from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import cramer_rao
from phasemark.matcher.histograms.histogram_matcher import HistogramMatcher
from phasemark.matcher.statistics import nees, view_errors
from phasemark.render import Background, Views
from phasemark.render.direct.footprints import footprint_grid
from phasemark.render.direct.sample_counts import signal_of_surfaces
from phasemark.render.integral.scene_samples import SceneMesh

WALL, FAINT = Background(wall_m=1.6), Background(wall_m=1.73, wall_albedo=0.3)
CROWDED = (
    ("cycles", 4000.0), ("photons", 0.5), ("ambient", 1.5e-3), ("dark", 5e-5), ("zone_scale", (1.3, 1.3)),
    ("zone_blur", 0.01), ("stray", 0.05),
)  # fmt: skip
"""Up to half of the cycles end with a photon, and zones overlap their neighbours."""
CROWD = bank_of(CROWDED, classes=("cone",)).camera


@pytest.mark.parametrize(
    ("n", "seed", "behind", "stated"),
    [
        (12, 1, WALL, WALL),
        (3, 3, FAINT, "auto"),
        pytest.param(1500, 2, WALL, WALL, marks=pytest.mark.soak),
        pytest.param(1000, 4, FAINT, "auto", marks=pytest.mark.soak),
    ],
)
def test_before_a_wall_known_or_estimated_error_is_at_the_bound_and_the_covariance_is_honest(
    n: int, seed: int, behind: Background, stated: Stated
) -> None:
    check_bound(trials(n, seed, behind, stated))


def test_before_a_wall_on_a_floor_both_albedos_may_be_others_than_stated() -> None:
    true = Background(wall_m=1.6, floor_m=0.3, wall_albedo=0.35, floor_albedo=0.7)
    check_bound(trials(8, 5, true, Background(wall_m=1.6, floor_m=0.3), classes=("cone",), known=("cone", "sphere")))


def test_pile_up_and_zones_that_overlap_leave_the_bound_as_it_is() -> None:
    first = renderer_of("cone", CROWD).expected(Views.broadcast(1.1), background=WALL).sum(axis=-1).max()
    assert first > 0.4 * CROWD.histogram.cycles  # many cycles end with their first photon
    check_bound(trials(12, 6, WALL, WALL, CROWDED, ("cone",), ("cone", "sphere")))


def test_a_wall_that_is_not_stated_or_stands_elsewhere_is_refused() -> None:
    rng = np.random.default_rng(7)
    for off in (0.02, -0.02, 0.1):
        moved = Background(wall_m=1.6 + off)
        views = random_views(2, rng)
        found = matcher_of(WALL).match(frames_of("cone", views, rng, behind=moved))
        assert set(found.reason) == {"poor fit"}, off
    found = matcher_of(None).match(frames_of("cone", random_views(2, rng), rng, behind=WALL))
    assert not found.accepted.any()


@pytest.mark.parametrize("stated", [WALL, "auto"])
def test_a_bare_wall_is_no_landmark(stated: Stated) -> None:
    rng = np.random.default_rng(8)
    found = matcher_of(stated).match(frames_of(None, random_views(1, rng), rng, behind=WALL))
    assert all(name is None for name in found.class_name)
    assert (found.class_probability["none"] > 0.9).all()


def test_a_landmark_that_stands_alone_is_found_by_who_expects_a_wall() -> None:
    rng = np.random.default_rng(9)
    views = random_views(4, rng)
    found = matcher_of("auto").match(frames_of("cone", views, rng))
    right = np.abs(view_errors(found, views, FREE, np.pi)) < [0.01, math.radians(6)]
    assert right[found.accepted].all()
    assert found.accepted.sum() >= 3


def test_how_much_a_landmark_hides_of_a_wall_does_not_depend_on_the_walls_distance() -> None:
    shares = []
    for stated in (WALL, Background(wall_m=2.4), "auto"):
        direct = matcher_of(stated)._direct
        assert isinstance(direct, HistogramMatcher)
        shares.append(direct.tables[0].visible)
    near, far, free = shares
    assert near.min() < 0.01
    np.testing.assert_allclose(far, near, rtol=0, atol=1e-6)
    np.testing.assert_allclose(free, near, rtol=0, atol=1e-6)


@pytest.mark.parametrize("each", [1, pytest.param(20, marks=pytest.mark.soak)])
def test_before_a_wall_targets_accept_nothing_wrong_and_refuse_another_wall(each: int) -> None:
    rng, squares, n_right = np.random.default_rng(10), [], 0
    matcher = matcher_of(WALL, "targets")
    for name in ("cone", "cylinder"):
        views = random_views(each, rng)
        found = matcher.match(frames_of(name, views, rng, behind=WALL))
        n_right += int(right_answers(found, name, views).sum())
        squares.append(nees(view_errors(found, views, FREE, np.pi)[found.accepted], found.covariance[found.accepted]))
    assert n_right >= binom.ppf(1e-4, 2 * each, 0.8)  # 254 of 300 were
    assert (np.concatenate(squares) < chi2.isf(1e-3, len(FREE))).all()
    few = random_views(max(each // 3, 1), rng)
    assert not matcher.match(frames_of("cone", few, rng, behind=Background(wall_m=1.65))).accepted.any()
    bare = matcher.match(frames_of(None, few, rng, behind=WALL))
    assert all(name is None for name in bare.class_name)


def test_the_surfaces_of_a_scene_add_up_to_what_is_rendered() -> None:
    sensor, behind = CROWD, Background(wall_m=1.6, floor_m=0.3)
    views = Views.broadcast([1.0, 1.2], [0.3, 2.0])
    samples = SceneMesh(build_mesh(catalog()["cone"])).samples_of_views(
        views, footprint_grid(sensor), background=behind, finest_m=0.5 * sensor.histogram.bin_width_m, farthest_m=4.8
    )
    got = signal_of_surfaces(samples, sensor, 0.8)
    want = renderer_of("cone", CROWD).signal(views, background=behind)
    np.testing.assert_allclose(got[:, 0], 0.8 * want[:, 0], atol=1e-4 * want.max())
    np.testing.assert_allclose(got[:, 1:].sum(axis=1), want[:, 1], atol=1e-4 * want.max())
    assert (got.sum(axis=(2, 3)) > 0).all()


def test_an_unknown_wall_costs_information_and_an_unknown_view_is_never_better_known() -> None:
    views = Views.broadcast([1.05, 1.15], [0.4, 1.9])
    known = cramer_rao(renderer_of("cone"), views, n_frames=1, background=WALL)
    free = cramer_rao(renderer_of("cone"), views, n_frames=1, background=WALL, nuisances=("wall_m",))
    for lost in known.information - free.information:
        assert np.linalg.eigvalsh(lost).min() > -1e-6 * np.abs(known.information).max()
    assert (free.std("delta_rad") >= known.std("delta_rad")).all()
