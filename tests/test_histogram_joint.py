"""Class and view of a landmark from histograms of several poses together."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from direct_landmarks import FREE, bank_of, matcher_of, random_views, renderer_of, right_answers
from scipy.stats import binom, norm

from phasemark import UsageError
from phasemark.matcher import Matches, cramer_rao
from phasemark.matcher.histograms.scene_models import relative_poses, views_from
from phasemark.matcher.statistics import nees, view_errors
from phasemark.render import Background, Views
from phasemark.render.direct import HistogramFrames, capture_histograms
from phasemark.render.direct.view_signals import STEPS

MOVED = ("distance_m", "delta_rad", "bearing_rad")


def pose(x: float, y: float, yaw_deg: float) -> np.ndarray:
    out = np.eye(4)
    cos, sin = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    out[:2, :2] = [[cos, -sin], [sin, cos]]
    out[:2, 3] = x, y
    return out


POSES = np.array([pose(0, 0, 0), pose(0.05, 0.25, -13), pose(0.05, -0.25, 13)])


FAR = "2.1:2.4:0.1"


def frames_of_poses(names: tuple[str, ...], view: Views, rng: np.random.Generator) -> HistogramFrames:
    """Return one frame of each pose; the class may differ."""
    seen = relative_poses(len(names), POSES[: len(names)])
    means = [renderer_of(name).expected(views_from(seen[k], view)) for k, name in enumerate(names)]
    return capture_histograms(np.concatenate(means), bank_of().camera, rng=rng)


def near_views(n: int, rng: np.random.Generator) -> Views:
    return random_views(n, rng, 1.05)


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


@pytest.mark.soak
@pytest.mark.parametrize(("n", "n_poses", "seed"), [(40, 2, 1), (1000, 3, 2)])
def test_the_information_of_frames_adds(n: int, n_poses: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    views = near_views(n, rng)
    answers = [
        matcher_of().match_jointly(frames_of_poses(("cone",) * n_poses, views[k : k + 1], rng), POSES[:n_poses])
        for k in range(n)
    ]
    found = Matches(answers)
    assert right_answers(found, "cone", views).all()
    error = view_errors(found, views, FREE, np.pi)
    stated = np.einsum("npp->np", found.covariance)
    around = bounds_around(found, n_poses)
    assert (stated > 0.9 * around.min(axis=0)).all()
    assert (stated < 1.1 * around.max(axis=0)).all()
    ratio = np.sqrt((error**2 / variances("cone", views, n_poses)).mean(axis=0))
    sides = norm.isf(0.0005 / 4)
    assert (np.abs(ratio - 1) < sides / math.sqrt(2 * n) + 0.03).all()
    assert abs(nees(error, found.covariance).mean() / 2 - 1) < sides / math.sqrt(n) + 0.04
    assert found.accepted.sum() >= binom.ppf(1e-4, n, 0.99)


def test_one_frame_alone_gives_the_answer_of_match() -> None:
    rng = np.random.default_rng(3)
    frames = frames_of_poses(("cylinder",), near_views(1, rng), rng)
    one, joint = matcher_of().match(frames)[0], matcher_of().match_jointly(frames, POSES[:1])
    assert joint.class_name == one.class_name
    std = math.sqrt(one.covariance[1, 1])
    assert abs(joint.distance_m - one.distance_m) < 0.2 * math.sqrt(one.covariance[0, 0])
    assert abs(joint.delta_rad - one.delta_rad) < 0.2 * std


@pytest.mark.parametrize(("n", "seed"), [(3, 4), pytest.param(30, 8, marks=pytest.mark.soak)])
def test_classes_that_one_view_from_afar_confuses_are_told_by_several(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    views = random_views(n, rng, 2.2, 2.3)
    alone = joint = 0
    for k in range(n):
        frames = frames_of_poses(("cone",) * 3, views[k : k + 1], rng)
        one, together = matcher_of(span=FAR).match(frames[:1])[0], matcher_of(span=FAR).match_jointly(frames, POSES)
        assert not (together.accepted and together.class_name != "cone")
        alone += one.class_probability["cone"] > 0.99
        joint += together.class_probability["cone"] > 0.99
    assert joint > alone
    assert joint >= binom.ppf(1e-4, n, 0.9)


def test_a_frame_that_contradicts_the_others_is_refused() -> None:
    rng = np.random.default_rng(5)
    view = near_views(1, rng)
    other = matcher_of().match_jointly(frames_of_poses(("cone", "cone", "cylinder"), view, rng), POSES)
    assert other.reason == "poor fit"
    moved = POSES.copy()
    moved[2, 0, 3] += 0.05  # the pose of the last frame is 5 cm off
    wrong_pose = matcher_of().match_jointly(frames_of_poses(("cone",) * 3, view, rng), moved)
    assert wrong_pose.reason == "poor fit"


def test_the_bearing_is_estimated_and_walls_are_where_asked() -> None:
    rng = np.random.default_rng(6)
    view = Views.broadcast(1.1, 0.7, 0.02)
    found = matcher_of(free=(*FREE, "bearing_rad"), classes=("cone",)).match_jointly(
        frames_of_poses(("cone",) * 2, view, rng), POSES[:2]
    )
    assert found.accepted
    assert abs(found.bearing_rad - 0.02) < 5 * math.sqrt(found.covariance[2, 2])
    seen = views_from(relative_poses(2, POSES[:2])[1], Views.broadcast(1.1, 0.7))
    means = [
        renderer_of("cone").expected(at, background=Background(wall_m=wall))
        for at, wall in ((Views.broadcast(1.1, 0.7), 1.8), (seen, 1.9))
    ]
    frames = capture_histograms(np.concatenate(means), bank_of().camera, rng=rng)
    both = matcher_of("auto", classes=("cone",)).match_jointly(frames, POSES[:2])
    assert both.accepted
    assert abs(both.distance_m - 1.1) < 5 * math.sqrt(both.covariance[0, 0])


def test_what_does_not_go_together_is_refused_in_one_line() -> None:
    rng = np.random.default_rng(7)
    frames, matcher = frames_of_poses(("cone",) * 2, near_views(1, rng), rng), matcher_of()
    for poses, message in (
        (POSES, "must have a pose for each of 2 frames, got 3$"),
        (np.array([np.eye(4), 2 * np.eye(4)]), "must be a rotation and a translation, matrix 1 is not$"),
        (np.full((2, 4, 4), np.nan), "must be finite, matrix 0 is not$"),
        (np.ones((2, 3)), r"must have shape \(n, 4, 4\), got \(2, 3\)"),
    ):
        with pytest.raises(UsageError, match=f"^'camera2world' {message}"):
            matcher.match_jointly(frames, poses)
    with pytest.raises(UsageError, match=r"^match_jointly takes on=\"histograms\", got on=\"targets\"$"):
        matcher_of(on="targets").match_jointly(frames, POSES[:2])
    with pytest.raises(UsageError, match=r"^'background' must have no wall in match_jointly"):
        matcher_of(Background(wall_m=1.6)).match_jointly(frames, POSES[:2])
