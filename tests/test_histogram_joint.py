"""Class and view of a landmark from histograms of several poses together."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.stats import binom, norm

from phasemark import UsageError
from phasemark.data import Bank, BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher, Matches, cramer_rao
from phasemark.matcher.histograms.joint_models import relative_poses, views_from
from phasemark.matcher.statistics import nees, view_errors
from phasemark.render import Background, Views
from phasemark.render.direct import HistogramFrames, HistogramRenderer, capture_histograms
from phasemark.render.direct.view_signals import STEPS

CLASSES = ("cylinder", "cone", "sphere")
FREE = ("distance_m", "delta_rad")
MOVED = ("distance_m", "delta_rad", "bearing_rad")


def pose(x: float, y: float, yaw_deg: float) -> np.ndarray:
    out = np.eye(4)
    cos, sin = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    out[:2, :2] = [[cos, -sin], [sin, cos]]
    out[:2, 3] = x, y
    return out


POSES = np.array([pose(0, 0, 0), pose(0.05, 0.25, -13), pose(0.05, -0.25, 13)])


@lru_cache(maxsize=2)
def bank_of(span: str = "0.95:1.25:0.1") -> Bank:
    plan = BankPlan(
        sensor="vl53l5cx-8x8", classes=CLASSES, distance_m=span, delta_deg="0:170:10", layout="full"
    )  # fmt: skip
    return build_bank(plan, workers=1)


@lru_cache(maxsize=4)
def matcher_of(span: str = "0.95:1.25:0.1", free: tuple[str, ...] = FREE) -> Matcher:
    return Matcher(bank_of(span), "refine", free=free, on="histograms", workers=2)


@lru_cache(maxsize=4)
def renderer_of(name: str) -> HistogramRenderer:
    return HistogramRenderer(build_mesh(catalog()[name]), bank_of().camera)


def frames_of(names: tuple[str, ...], view: Views, rng: np.random.Generator) -> HistogramFrames:
    """Return one frame of each pose; the class may differ."""
    seen = relative_poses(len(names), POSES[: len(names)])
    means = [renderer_of(name).expected(views_from(seen[k], view)) for k, name in enumerate(names)]
    return capture_histograms(np.concatenate(means), bank_of().camera, rng=rng)


def random_views(n: int, rng: np.random.Generator, low: float = 1.05, high: float = 1.2) -> Views:
    return Views.broadcast(rng.uniform(low, high, n), rng.uniform(0, np.pi, n))


def summed_information(name: str, views: Views, n_poses: int) -> np.ndarray:
    """Return the sum of the frames' information in the view of the first one, (n, 2, 2)."""
    total = np.zeros((len(views), len(FREE), len(FREE)))
    step = 1e-5
    for k in range(n_poses):
        there = relative_poses(n_poses, POSES[:n_poses])[k]
        slope = np.empty((len(views), len(MOVED), len(FREE)))
        for q, free in enumerate(FREE):
            sides = [views_from(there, replace(views, **{free: getattr(views, free) + h})) for h in (step, -step)]
            for p, moved in enumerate(MOVED):
                slope[:, p, q] = (getattr(sides[0], moved) - getattr(sides[1], moved)) / (2 * step)
        own = cramer_rao(renderer_of(name), views_from(there, views), free=MOVED, n_frames=1).information
        total += np.einsum("nip,nij,njq->npq", slope, own, slope)
    return total


def variances(name: str, views: Views, n_poses: int) -> np.ndarray:
    """Return the variances of the bound, (n, 2)."""
    return np.asarray(np.einsum("npp->np", np.linalg.inv(summed_information(name, views, n_poses))))


def bounds_around(found: Matches, n_poses: int) -> np.ndarray:
    """Return the bounds at answers and at angles near them, (5, n, 2): as far as slopes reach that a fit ends with.

    They are differences at a view less than a standard deviation away. Where a surface comes into view the bound
    changes by a third over one.
    """
    reach = STEPS["delta_rad"] + 0.7 * np.sqrt(found.covariance[:, 1, 1])
    at = (Views.broadcast(found.distance_m, found.delta_rad + by * reach) for by in np.linspace(-1, 1, 5))
    return np.array([variances("cone", views, n_poses) for views in at])


def check_sum(n: int, n_poses: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    views = random_views(n, rng)
    answers = [
        matcher_of().match_jointly(frames_of(("cone",) * n_poses, views[k : k + 1], rng), POSES[:n_poses])
        for k in range(n)
    ]
    found = Matches(answers)
    error = view_errors(found, views, FREE, np.pi)
    right = (found.class_name == "cone") & (np.abs(error) < [0.03, math.radians(6)]).all(axis=1)
    assert right.all()
    stated = np.einsum("npp->np", found.covariance)
    around = bounds_around(found, n_poses)
    assert (stated > 0.9 * around.min(axis=0)).all()
    assert (stated < 1.1 * around.max(axis=0)).all()
    ratio = np.sqrt((error**2 / variances("cone", views, n_poses)).mean(axis=0))
    sides = norm.isf(0.0005 / 4)
    assert (np.abs(ratio - 1) < sides / math.sqrt(2 * n) + 0.03).all()
    assert abs(nees(error, found.covariance).mean() / 2 - 1) < sides / math.sqrt(n) + 0.04
    assert found.accepted.sum() >= binom.ppf(1e-4, n, 0.99)


@pytest.mark.soak
def test_the_information_of_two_frames_adds() -> None:
    check_sum(40, 2, 1)


@pytest.mark.soak
def test_the_information_of_three_frames_adds_in_1000_trials() -> None:
    check_sum(1000, 3, 2)


def test_one_frame_alone_gives_the_answer_of_match() -> None:
    rng = np.random.default_rng(3)
    frames = frames_of(("cylinder",), random_views(1, rng), rng)
    one, joint = matcher_of().match(frames)[0], matcher_of().match_jointly(frames, POSES[:1])
    assert joint.class_name == one.class_name
    std = math.sqrt(one.covariance[1, 1])
    assert abs(joint.distance_m - one.distance_m) < 0.2 * math.sqrt(one.covariance[0, 0])
    assert abs(joint.delta_rad - one.delta_rad) < 0.2 * std


def check_far(n: int, seed: int) -> None:
    """Compare how often one frame and three are sure of a cone 2.2 m away."""
    rng = np.random.default_rng(seed)
    far = matcher_of("2.1:2.4:0.1")
    views = random_views(n, rng, 2.2, 2.3)
    alone = joint = 0
    for k in range(n):
        frames = frames_of(("cone",) * 3, views[k : k + 1], rng)
        one, all_of_them = far.match(frames[:1])[0], far.match_jointly(frames, POSES)
        assert not (all_of_them.accepted and all_of_them.class_name != "cone")
        alone += one.class_probability["cone"] > 0.99
        joint += all_of_them.class_probability["cone"] > 0.99
    assert joint > alone
    assert joint >= binom.ppf(1e-4, n, 0.9)


def test_classes_that_one_view_from_afar_confuses_are_told_by_several() -> None:
    check_far(3, 4)


@pytest.mark.soak
def test_classes_that_one_view_from_afar_confuses_are_told_by_several_in_30_trials() -> None:
    check_far(30, 8)


def test_a_frame_that_contradicts_the_others_is_refused() -> None:
    rng = np.random.default_rng(5)
    for view in (random_views(1, rng), random_views(1, rng)):
        other = matcher_of().match_jointly(frames_of(("cone", "cone", "cylinder"), view, rng), POSES)
        assert other.reason == "poor fit"
        moved = POSES.copy()
        moved[2, 0, 3] += 0.05  # the pose of the last frame is 5 cm off
        wrong_pose = matcher_of().match_jointly(frames_of(("cone",) * 3, view, rng), moved)
        assert wrong_pose.reason == "poor fit"


def test_the_bearing_is_estimated_and_walls_are_where_asked() -> None:
    rng = np.random.default_rng(6)
    view = Views.broadcast(1.1, 0.7, 0.02)
    found = matcher_of(free=(*FREE, "bearing_rad")).match_jointly(frames_of(("cone",) * 2, view, rng), POSES[:2])
    assert found.accepted
    assert abs(found.bearing_rad - 0.02) < 5 * math.sqrt(found.covariance[2, 2])
    walls = Matcher(bank_of(), "refine", free=FREE, on="histograms", background="auto", workers=2)
    seen = views_from(relative_poses(2, POSES[:2])[1], Views.broadcast(1.1, 0.7))
    means = [
        renderer_of("cone").expected(at, background=Background(wall_m=wall))
        for at, wall in ((Views.broadcast(1.1, 0.7), 1.8), (seen, 1.9))
    ]
    both = walls.match_jointly(capture_histograms(np.concatenate(means), bank_of().camera, rng=rng), POSES[:2])
    assert both.accepted
    assert abs(both.distance_m - 1.1) < 5 * math.sqrt(both.covariance[0, 0])


def test_what_does_not_go_together_is_refused_in_one_line() -> None:
    rng = np.random.default_rng(7)
    frames, matcher = frames_of(("cone",) * 2, random_views(1, rng), rng), matcher_of()
    with pytest.raises(UsageError, match=r"^'camera2world' must have a pose for each of 2 frames, got 3$"):
        matcher.match_jointly(frames, POSES)
    with pytest.raises(UsageError, match=r"^'camera2world' must be a rotation and a translation, matrix 1 is not$"):
        matcher.match_jointly(frames, np.array([np.eye(4), 2 * np.eye(4)]))
    with pytest.raises(UsageError, match=r"^'camera2world' must be finite$"):
        matcher.match_jointly(frames, np.full((2, 4, 4), np.nan))
    with pytest.raises(UsageError, match=r"^'camera2world' must have shape \(n, 4, 4\), got \(2, 3\)"):
        matcher.match_jointly(frames, np.ones((2, 3)))
    with pytest.raises(UsageError, match=r"^match_jointly takes on=\"histograms\", got on=\"targets\"$"):
        Matcher(bank_of(), "refine", on="targets").match_jointly(frames, POSES[:2])
    walled = Matcher(bank_of(), "refine", on="histograms", background=Background(wall_m=2.0))
    with pytest.raises(UsageError, match=r"^'background' must have no wall in match_jointly"):
        walled.match_jointly(frames, POSES[:2])
