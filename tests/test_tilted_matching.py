"""Matching with height, pitch and roll free: at the bound, from any start, and refused where they cannot be told."""

import csv
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from phasemark import UsageError
from phasemark.cli import main
from phasemark.data import BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher, cramer_rao, kalman_filter, phasor_mean
from phasemark.matcher.accuracy import TrialSetup, run_trials
from phasemark.matcher.filters.stamps import with_tilts_when_taken
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.nearest.bank_minima import Upward
from phasemark.render import Background, Frames, Renderer, Views, capture, preset

PMD = preset("pmd-16x16")
PLAN = BankPlan(classes=["cylinder", "cone"], distance_m="0.85:1.25:0.02", delta_deg="0:180:2")
UNKNOWN: dict[str, Any] = {"pitch_std_rad": math.inf, "roll_std_rad": math.inf}
ANYWHERE = TrialSetup(
    free=VIEW, distance_m=(0.95, 1.15), bearing_rad=0.04, height_m=0.04, pitch_rad=0.05, roll_rad=0.1, n_frames=2000
)
"""Averages of many frames, so that the problem is linear: at 50 frames pitch and roll are known to some 0.3°."""


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    with build_bank(PLAN, tmp_path_factory.mktemp("bank") / "bank.h5") as opened:
        yield opened


@pytest.fixture(scope="module")
def renderers():
    return {name: Renderer(build_mesh(catalog()[name]), PMD) for name in ("cylinder", "cone")}


def frames_of(renderer, views, *, n_frames=50, seed=1, background=None):
    image = renderer.render_views(views, background=background)
    return kalman_filter(capture(image, renderer.sensor, rng=np.random.default_rng(seed), n_frames=n_frames))


def errors(matches, views, free):
    error = np.column_stack([getattr(matches, name) - getattr(views, name) for name in free])
    turn = free.index("delta_rad")
    error[:, turn] -= math.pi * np.round(error[:, turn] / math.pi)
    return error


@pytest.mark.parametrize("name", ["cone", pytest.param("cylinder", marks=pytest.mark.soak)])
def test_all_six_numbers_are_at_the_bound_and_their_covariance_is_honest(bank, renderers, name):
    matcher = Matcher(bank, "refine", free=VIEW, **UNKNOWN)
    n = 12
    trials = run_trials(matcher.match, renderers[name], name, ANYWHERE, n, np.random.default_rng(4))
    assert (trials.found == name).all()
    assert trials.accepted.mean() >= 0.9
    assert not trials.outlier.any()
    # χ² of n and of 6 n degrees of freedom, 99.9 % intervals over seven figures
    for k in range(6):
        total = np.sum(trials.scaled[:, k] ** 2)
        assert stats.chi2.ppf(1e-4, n) < total < stats.chi2.ppf(1 - 1e-4, n)
    own = np.einsum("ni,nij,nj->", trials.error, np.linalg.inv(trials.covariance), trials.error)
    assert stats.chi2.ppf(1e-4, 6 * n) < own < stats.chi2.ppf(1 - 1e-4, 6 * n)


@pytest.mark.parametrize(
    "added",
    [
        ("pitch_rad",),
        ("bearing_rad", "pitch_rad"),
        ("height_m", "roll_rad"),
        *(pytest.param(one, marks=pytest.mark.soak) for one in (("height_m",), ("roll_rad",))),
    ],
    ids=" ".join,
)
def test_any_of_them_may_be_free(bank, renderers, added):
    free = tuple(name for name in VIEW if name in (*VIEW[:2], *added))
    rng = np.random.default_rng(8)
    spread = {"bearing_rad": 0.05, "height_m": 0.05, "pitch_rad": 0.06, "roll_rad": 0.15}
    n = 5
    moved = {name: rng.uniform(-1, 1, n) * spread[name] for name in added}
    views = Views.broadcast(rng.uniform(0.95, 1.15, n), rng.uniform(0, math.pi, n), **moved)
    matches = Matcher(bank, "refine", free=free, **UNKNOWN).match(frames_of(renderers["cone"], views))
    assert matches.free == free
    assert set(matches.class_name) == {"cone"}
    error = errors(matches, views, free)
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(matches.covariance), error)
    assert squares.sum() < stats.chi2.ppf(1 - 1e-4, len(free) * n)
    for name in set(VIEW) - set(free):
        np.testing.assert_array_equal(getattr(matches, name), 0.0)


@pytest.mark.parametrize(
    "elevation", [-0.09, 0.09, *(pytest.param(one, marks=pytest.mark.soak) for one in (-0.05, 0.06))]
)
@pytest.mark.parametrize("by", ["height_m", "pitch_rad"])
def test_a_landmark_is_found_rows_above_and_below_the_middle(bank, renderers, by, elevation):
    away = {"height_m": 1.05 * math.tan(elevation)} if by == "height_m" else {"pitch_rad": elevation}
    views = Views.broadcast(1.05, [0.4, 2.0], **away)
    matcher = Matcher(bank, "refine", free=(*VIEW[:2], by), pitch_std_rad=math.inf)
    for match, delta in zip(matcher.match(frames_of(renderers["cylinder"], views)), (0.4, 2.0), strict=True):
        assert match.class_name == "cylinder"
        assert abs(getattr(match, by) - next(iter(away.values()))) < 0.004
        assert abs(match.delta_rad - delta) < 0.05


def test_before_a_wall_heights_and_pitches_that_cancel_are_not_said_to_be_known(bank, renderers):
    wall = Background(wall_m=3.0)
    matcher = Matcher(bank, "refine", free=VIEW, background=wall, **UNKNOWN)
    rng, n = np.random.default_rng(5), 4
    views = Views.broadcast(
        rng.uniform(0.95, 1.15, n), rng.uniform(0, math.pi, n), *(rng.normal(0, w, n) for w in (0.03, 0.03, 0.05, 0.08))
    )
    matches = matcher.match(frames_of(renderers["cylinder"], views, background=wall))
    good = matches.accepted
    assert good.sum() >= 3
    error = errors(matches, views, list(VIEW))[good]
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(matches.covariance[good]), error)
    # edges before a wall are sharp, and covariances local (PHYSICS section 7): no error may be far beyond them
    assert squares.max() < 60


@pytest.mark.parametrize("albedo", [0.56, pytest.param(0.8, marks=pytest.mark.soak)])
def test_phasors_before_a_wall_are_at_the_bound_with_a_free_tilt_and_albedo(bank, albedo):
    """What the wall returns moves through the image with bearing, pitch and roll, and has a brightness of its own."""
    wall, n = Background(wall_m=3.0), 5
    free = (*VIEW[:3], "pitch_rad", "roll_rad")
    rng = np.random.default_rng(5)
    tilts = [rng.normal(0, width, n) for width in (0.03, 0.04, 0.06)]
    views = Views.broadcast(rng.uniform(0.95, 1.2, n), rng.uniform(0, math.pi, n), tilts[0], 0.0, *tilts[1:])
    renderer = Renderer(build_mesh(catalog()["cone"]), PMD.with_(max_phase_std_rad=None), albedo=albedo)
    image = renderer.render_views(views, background=wall)
    frames = phasor_mean(capture(image, renderer.sensor, rng=rng, n_frames=50))
    matches = Matcher(bank, "refine", free=free, on="phasors", background=wall, **UNKNOWN).match(frames)
    assert set(matches.class_name) == {"cone"}
    assert matches.accepted.sum() >= n - 1
    error = errors(matches, views, list(free))
    bound = cramer_rao(renderer, views, free=free, on="phasors", background=wall).covariance
    at_bound = np.einsum("ni,nij,nj->n", error, np.linalg.inv(bound), error)
    own = np.einsum("ni,nij,nj->n", error, np.linalg.inv(matches.covariance), error)
    # medians: bounds and covariances are local beside the edges of a landmark before a wall (PHYSICS section 7); the
    # median of n values of a χ² of 5 lies below 2.6 of its own in 99.9 % of samples of 5
    for squares in (at_bound, own):
        assert np.median(squares) < 2.6 * stats.chi2.median(len(free))
    assert own.max() < 60


def test_what_a_frame_cannot_tell_is_refused_unless_it_is_known_before(bank, renderers):
    # a single frame: height and pitch trade, a centimetre for half a degree
    views = Views.broadcast(1.2, 2.2, 0.0, 0.01, 0.02, -0.05)
    frames = frames_of(renderers["cylinder"], views, n_frames=1)
    alone = Matcher(bank, "refine", free=VIEW, **UNKNOWN).match(frames)
    assert not alone.accepted.any()
    known = Matcher(bank, "refine", free=VIEW, height_std_m=0.005, pitch_std_rad=0.01, roll_std_rad=0.02)
    held = known.match(frames)
    for one, other in zip(alone, held, strict=True):
        if one.covariance is None or other.covariance is None:
            continue
        height, pitch = VIEW.index("height_m"), VIEW.index("pitch_rad")
        for k, most in ((height, 0.005), (pitch, 0.01)):
            assert math.sqrt(other.covariance[k, k]) < most
        correlation = one.covariance[height, pitch] / math.sqrt(
            one.covariance[height, height] * one.covariance[pitch, pitch]
        )
        assert correlation < -0.5


def test_a_tilt_that_is_not_estimated_is_refused_rather_than_explained_by_another_view(bank, renderers):
    rng, n = np.random.default_rng(6), 2
    views = Views.broadcast(
        rng.uniform(0.9, 1.2, n), rng.uniform(0, math.pi, n), pitch_rad=0.07 * rng.choice([-1, 1], n), roll_rad=0.1
    )
    matches = Matcher(bank, "refine").match(frames_of(renderers["cone"], views))
    assert not matches.accepted.any()


def test_starts_are_split_between_height_and_pitch_by_what_is_known_of_them():
    assert Upward(0.0, 0.05).split(0.1, 1.2) == (0.0, 0.1)
    assert Upward(math.inf, 0.05).split(0.1, 1.2) == pytest.approx((1.2 * math.tan(0.1), 0.0))
    height, pitch = Upward(0.06, 0.05).split(0.1, 1.2)
    assert height == pytest.approx(1.2 * math.tan(0.05))
    assert pitch == pytest.approx(0.05)
    assert Upward().split(0.0, 1.2) == (0.0, 0.0)
    assert Upward().widest_rad(1.0) == 0.0


def test_the_bound_of_a_prior_free_fit_grows_with_every_free_number(renderers):
    views = Views.broadcast(1.0, 0.5, 0.01, 0.02, 0.03, 0.04)
    few = cramer_rao(renderers["cylinder"], views, free=VIEW[:2]).std("distance_m")
    more = cramer_rao(renderers["cylinder"], views, free=VIEW).std("distance_m")
    assert more > few


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"free": (*VIEW[:2], "yaw_rad")}, "'free' must be among distance_m, .*, roll_rad"),
        ({"free": VIEW[1:]}, "'free' must name distance_m and delta_rad"),
        ({"free": VIEW, "pitch_std_rad": 0.0}, "'pitch_std_rad' must be positive"),
        ({"free": VIEW, "height_std_m": -1.0}, "'height_std_m' must be positive"),
        ({"free": VIEW, "roll_std_rad": 1e-320}, "'roll_std_rad' must be at least 1e-09"),
    ],
)
def test_options_that_contradict_each_other_are_refused(bank, options, words):
    with pytest.raises(UsageError, match=words):
        Matcher(bank, "refine", **options)


def test_the_command_frees_pitch_and_roll_and_writes_them(bank, tmp_path, capsys):
    recording, table = tmp_path / "r.npz", tmp_path / "e.csv"
    tilt = ["--pitch", "3", "--roll", "-4"]
    simulate = ["frames", "simulate", "-o", str(recording), "--class", "cone", "--delta", "40", "--frames", "50", *tilt]
    assert main(simulate) == 0
    match = ["match", str(bank.path), str(recording), "--method", "refine", "--free", "roll", "--free", "pitch"]
    assert main([*match, "--pitch-std", "5", "--roll-std", "8", "--estimates", str(table)]) == 0
    (row,) = csv.DictReader(table.read_text().splitlines())
    assert row["accepted"] == "true"
    assert abs(float(row["pitch_deg"]) - 3) < 5 * float(row["pitch_std_deg"]) < 1.5
    assert abs(float(row["roll_deg"]) + 4) < 5 * float(row["roll_std_deg"]) < 5
    assert -1 < float(row["corr_pitch_roll"]) < 1
    capsys.readouterr()
    for wrong, words in (
        (["--free", "yaw"], "--free must be bearing, height, pitch or roll, got 'yaw'"),
        (["--free", "roll", "--pitch-std", "2"], "--pitch-std goes with --free pitch"),
    ):
        assert main([*match[:5], *wrong]) == 2
        assert words in capsys.readouterr().err


def swaying(renderer, n, seed, level=0):
    """Return views of a drone that pitches and rolls by up to 8°, its frames, and those with the tilt of each.

    In the first `level` of them it is level.
    """
    rng = np.random.default_rng(seed)
    tilt = np.radians(rng.uniform(-8, 8, (n, 2)))
    tilt[:level] = 0.0
    views = Views.broadcast(rng.uniform(0.95, 1.15, n), rng.uniform(0, math.pi, n), 0.0, 0.0, *tilt.T)
    frames = frames_of(renderer, views, seed=seed)
    return views, frames, replace(frames, tilt_rad=tilt)


def test_frames_whose_tilt_is_known_are_matched_at_that_tilt_and_refused_without(bank, renderers):
    n, level = 6, 2
    views, ignored, known = swaying(renderers["cone"], n, 3, level)
    matcher = Matcher(bank, "refine", free=VIEW[:2], background="any")
    matches = matcher.match(known)
    assert matches.accepted.all()
    assert set(matches.class_name) == {"cone"}
    np.testing.assert_array_equal(np.column_stack([matches.pitch_rad, matches.roll_rad]), known.tilt_rad)
    error = errors(matches, views, VIEW[:2])
    squares = np.einsum("ni,nij,nj->", error, np.linalg.inv(matches.covariance), error)
    assert squares < stats.chi2.ppf(1 - 1e-3, 2 * n)
    assert not Matcher(bank, "refine", free=VIEW[:2]).match(ignored[level : level + 2]).accepted.any()
    # level frames of the same batch are answered as without the others
    np.testing.assert_array_equal(matches.distance_m[:level], matcher.match(ignored[:level]).distance_m)


def test_a_tilt_known_to_half_a_degree_is_the_mean_of_the_prior(bank, renderers):
    views, _, known = swaying(renderers["cone"], 4, 4)
    off = math.radians(0.5) * np.random.default_rng(5).standard_normal((4, 2))
    free = (*VIEW[:2], *VIEW[4:])
    prior: dict[str, Any] = {"pitch_std_rad": math.radians(0.5), "roll_std_rad": math.radians(0.5)}
    matches = Matcher(bank, "refine", free=free, **prior).match(replace(known, tilt_rad=known.tilt_rad + off))
    assert matches.accepted.all()
    error = errors(matches, views, free)
    squares = np.einsum("ni,nij,nj->", error, np.linalg.inv(matches.covariance), error)
    assert squares < stats.chi2.ppf(1 - 1e-3, 4 * 4)
    assert (np.sqrt(matches.covariance[:, 2, 2]) < math.radians(0.5)).all()


def test_what_takes_level_frames_refuses_tilted_ones(bank, renderers):
    _, _, known = swaying(renderers["cone"], 1, 6)
    for matcher in (Matcher(bank), Matcher(bank, "refine", background=Background(wall_m=3.0))):
        with pytest.raises(UsageError, match="frames with a tilt take"):
            matcher.match(known)


def test_tilts_of_a_recording_are_those_at_the_time_that_a_frame_shows():
    stamps, tilt = np.arange(5.0), np.stack([0.1 * np.arange(5), -0.1 * np.arange(5)], axis=1)
    frames = Frames(np.ones((5, 1, 16, 16)), sensor=PMD, time_s=stamps[:, None], tilt_rad=tilt[:, None])
    shown = with_tilts_when_taken(frames, -0.5).tilt_rad[:, 0]
    np.testing.assert_allclose(shown[1:], tilt[1:] - [0.05, -0.05], atol=1e-12)
    np.testing.assert_array_equal(frames.tilt_rad[:, 0], tilt)
