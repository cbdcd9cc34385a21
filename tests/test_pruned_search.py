"""The pruned search of the nearest image: the same winner as comparing every image, at the edges of the grid too."""

import math

import numpy as np
import pytest

from phasemark.data import BankPlan, build_bank
from phasemark.matcher import Matches
from phasemark.matcher.accuracy import TrialSetup
from phasemark.matcher.accuracy.trials import noisy_frames
from phasemark.matcher.nearest.nearest_matcher import NearestMatcher
from phasemark.matcher.nearest.search import ExactSearch, PrunedSearch, nearest_search
from phasemark.matcher.nearest.templates import Observation
from phasemark.render import Background, Renderer, preset

SENSOR = preset("pmd-16x16")
DISTANCE, DELTA = (0.9, 1.2), math.pi
WALL = Background(wall_m=4.0)


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    plan = BankPlan(classes=("cone", "post"), distance_m="0.9:1.2:0.01", delta_deg="0:180:1")
    with build_bank(plan, tmp_path_factory.mktemp("bank") / "bank.h5") as opened:
        yield opened


@pytest.fixture(scope="module")
def full_bank(tmp_path_factory):
    plan = BankPlan(classes=("cone", "post"), layout="full", distance_m="0.9:1.1:0.02", delta_deg="0:180:2")
    with build_bank(plan, tmp_path_factory.mktemp("bank") / "full.h5") as opened:
        yield opened


def frames(bank, n, background=None, distance_m=DISTANCE, seed=5):
    """Return n frames of each class, any δ."""
    rng = np.random.default_rng(seed)
    setup = TrialSetup(distance_m=distance_m, background=background)
    return [
        noisy_frames(Renderer(bank.mesh(name), SENSOR, albedo=0.8), SENSOR, setup.views(n, rng, DELTA), setup, rng)
        for name in bank.classes
    ]


def searches(bank, background=None):
    """Return the pruned search of a bank, and the exact one of the same templates."""
    matcher = NearestMatcher(bank, background=background)
    assert isinstance(matcher.search, PrunedSearch)
    return matcher, ExactSearch(matcher.pose, len(bank.distance_m) * len(bank.delta_rad))


@pytest.mark.parametrize("background", [None, WALL])
def test_the_pruned_search_finds_what_comparing_every_image_finds(bank, background):
    matcher, exact = searches(bank, background)
    for some in frames(bank, 100, background):
        seen = Observation.from_frames(some, (8, 16))
        found, cost = matcher.search.nearest(seen)
        expected, least = exact.nearest(seen)
        # one of 100 may end in a side valley: at the rate of 0.1 % that is asked for, two of 100 have probability 0.5 %
        assert np.sum(found != expected) <= 1
        same = found == expected
        # sums in another order: rounding of float64
        np.testing.assert_allclose(cost[same], least[same], rtol=1e-12)
        assert (cost >= least * (1 - 1e-12)).all()


def test_every_class_of_a_full_bank_is_searched(full_bank):
    matcher, exact = searches(full_bank)
    for some in frames(full_bank, 50, distance_m=(0.9, 1.1)):
        seen = Observation.from_frames(some, (0, 16))
        for block in range(2):
            found, cost = matcher.search.nearest(seen, block)
            expected, least = exact.nearest(seen, block)
            assert (found // (len(full_bank.distance_m) * len(full_bank.delta_rad)) == block).all()
            assert np.sum(found != expected) <= 1
            assert (cost >= least * (1 - 1e-12)).all()


def test_images_of_the_grid_are_found_at_its_borders_and_across_the_seam_of_delta(bank):
    matcher, _ = searches(bank)
    templates = matcher.pose
    n_d, n_a = len(bank.distance_m), len(bank.delta_rad)
    border = [(i, j) for i in (0, 1, n_d - 2, n_d - 1) for j in (0, 1, 2, 57, n_a - 3, n_a - 2, n_a - 1)]
    at = np.array([i * n_a + j for i, j in border])
    must = templates.must_return[at]
    ranges = (templates.range_m[at] + templates.mean_m) % SENSOR.unambiguous_range_m
    returned = templates.may_return[at]
    seen = Observation(np.where(returned, ranges, 0.0), np.where(returned, 1e6, 0.0), returned, ~(returned | must))
    found, cost = matcher.search.nearest(seen)
    assert found.tolist() == at.tolist()
    assert cost.max() < 1e-3  # float64 sums of float32 ranges: (1e-7 m)² · 1e6 / m² a pixel


def test_a_frame_without_returns_has_an_answer_and_is_no_landmark(bank):
    matcher, exact = searches(bank)
    nothing = np.zeros((1, 128))
    absent = np.ones((1, 128), bool)
    seen = Observation(nothing, nothing, ~absent, absent)
    # flat ground, on which a descent may rest: some template of the grid, at its own distance
    found, cost = matcher.search.nearest(seen)
    assert cost[0] == matcher.pose.exact_costs(seen, 0, found)[0] >= exact.nearest(seen)[1][0]
    missing = Observation(nothing, nothing, ~absent, ~absent)
    assert matcher.search.nearest(missing)[1] == 0


def test_irregular_and_coarse_grids_are_searched_whole(bank):
    templates = NearestMatcher(bank).pose
    regular, angles = bank.distance_m, bank.delta_rad
    bent = regular + 0.002 * np.sin(np.arange(len(regular)))
    assert isinstance(nearest_search(templates, regular, angles), PrunedSearch)
    assert isinstance(nearest_search(templates, bent, angles), ExactSearch)
    assert isinstance(nearest_search(templates, 10 * regular, 10 * angles), ExactSearch)


def test_the_answer_does_not_depend_on_the_search(bank):
    pruned, exact = NearestMatcher(bank), NearestMatcher(bank)
    exact.search = ExactSearch(exact.pose, len(bank.distance_m) * len(bank.delta_rad))
    some = frames(bank, 40, seed=6)[0]
    a, b = Matches(pruned.match(some)), Matches(exact.match(some))
    assert a.class_name.tolist() == b.class_name.tolist()
    assert np.mean((a.distance_m == b.distance_m) & (a.delta_rad == b.delta_rad)) >= 39 / 40
