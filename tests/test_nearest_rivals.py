"""The nearest image is accepted where no other view of the bank explains a frame about as well."""

import math

import numpy as np
import pytest
import trimesh

from phasemark.data import BankPlan, build_bank
from phasemark.data.plans import MeshPlan
from phasemark.matcher import Matcher, kalman_filter
from phasemark.matcher.nearest.cell_fits import best_moves, fit_cells, follow_distance, moved_costs
from phasemark.matcher.nearest.nearest_matcher import _is_minimum
from phasemark.matcher.nearest.templates import Observation, Templates
from phasemark.render import Background, Renderer, capture, preset

PRESET = "vl53l5cx-8x8"
SENSOR = preset(PRESET)
N = 200


def gear(teeth: int) -> trimesh.Trimesh:
    """Return a flat gear about the z axis."""
    turn = 2 * np.pi * (np.arange(4 * teeth) / 4) / teeth
    radius = np.tile([0.12, 0.15, 0.15, 0.12], teeth)
    rim = np.column_stack([radius * np.cos(turn), radius * np.sin(turn)])
    n = len(rim)
    points = np.vstack(
        [np.column_stack([rim, np.full(n, z)]) for z in (-0.03, 0.03)] + [np.array([[0, 0, -0.03], [0, 0, 0.03]])]
    )
    k, after = np.arange(n), np.roll(np.arange(n), -1)
    sides = np.vstack([np.column_stack([k, after, after + n]), np.column_stack([k, after + n, k + n])])
    ends = [np.column_stack([after, k, np.full(n, 2 * n)]), np.column_stack([k + n, after + n, np.full(n, 2 * n + 1)])]
    return trimesh.Trimesh(points, np.vstack([sides, *ends]))


def notched() -> trimesh.Trimesh:
    """Return a box that a corner is missing of."""
    corner = trimesh.creation.box((0.06, 0.06, 0.06))
    corner.apply_translation((0.1, 0.1, 0.125))
    part: trimesh.Trimesh = trimesh.boolean.difference([trimesh.creation.box((0.2, 0.2, 0.25)), corner])
    return part


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    folder = tmp_path_factory.mktemp("parts")
    parts = {"gear": gear(9), "box": trimesh.creation.box((0.20, 0.212, 0.25)), "notched": notched()}
    plans = []
    for name, mesh in parts.items():
        mesh.export(folder / f"{name}.stl")
        plans.append(MeshPlan(name=name, path=str(folder / f"{name}.stl"), unit="m"))
    plan = BankPlan(meshes=tuple(plans), sensor=PRESET, distance_m="0.5:1.1:0.02", delta_deg="0:360:2", layout="full")
    with build_bank(plan, folder / "parts.h5") as built:
        yield built


@pytest.mark.parametrize("background", [None, Background(wall_m=2.5)], ids=["nothing", "wall"])
@pytest.mark.parametrize(("name", "period_deg", "least"), [("gear", 40, 20), ("box", 180, 40), ("notched", 360, 20)])
def test_an_accepted_image_is_of_the_class_and_near_the_view(bank, name, period_deg, least, background):
    # a valley along the angle, a side that looks like its neighbour, and another class that looks the same
    rng = np.random.default_rng(5)
    distance_m, delta_rad = rng.uniform(0.62, 1.0, N), rng.uniform(0, 2 * np.pi, N)
    image = Renderer(bank.mesh(name), SENSOR).render(distance_m, delta_rad, background=background)
    matches = Matcher(bank, "nearest", background=background).match(
        kalman_filter(capture(image, SENSOR, rng=rng, n_frames=10))
    )
    period = math.radians(period_deg)
    off = np.abs((matches.delta_rad - delta_rad + period / 2) % period - period / 2)
    right = (off <= math.radians(6)) & (np.abs(matches.distance_m - distance_m) <= 0.03)
    right &= np.array(matches.class_name) == name
    assert not (matches.accepted & ~right).any()
    assert (matches.accepted & right).sum() >= least
    assert "ambiguous" in set(matches.reason)


def test_a_fit_in_a_cell_is_the_weighted_least_squares_of_its_pixels():
    # ranges that are linear in distance and angle, as they are seen: numpy's least squares tells χ² and the position
    rng = np.random.default_rng(2)
    slope = rng.normal(0, 0.01, (2, 30))
    grid = np.array([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]])
    ranges = 1.0 + grid @ slope
    every, none = np.ones((5, 30), bool), np.zeros((5, 30), bool)
    images = Templates(ranges.astype(np.float32), every, none, np.zeros(30), SENSOR)
    std = rng.uniform(0.001, 0.003, 30)
    seen_m = 1.0 + np.array([0.2, -0.3]) @ slope + rng.normal(0, std)
    seen = Observation(seen_m[None], 1 / std[None] ** 2, every[:1], none[:1])
    own = np.zeros(1, np.int64)
    fits = fit_cells([(images, seen, np.array([[0, 1, 2, 3, 4]]))], own)
    _, left, *_ = np.linalg.lstsq((slope / std).T, (seen_m - 1.0) / std)
    assert fits.chi2[0] == pytest.approx(left[0], rel=1e-3)  # images are float32
    assert fits.dof.tolist() == [28]
    # at the end of the grid a change goes on as on its other side
    ends = fit_cells([(images, seen, np.array([[0, 0, 2, 3, 0]]))], own)
    assert ends.chi2[0] == pytest.approx(left[0], rel=1e-3)


def test_what_a_cell_cannot_show_costs_a_disagreement_in_each_pixel():
    every, none = np.ones((5, 4), bool), np.zeros((5, 4), bool)

    def cost(seen, may, must):
        images = Templates(np.ones((5, 4), np.float32), may, must, np.zeros(4), SENSOR)
        return fit_cells([(images, seen, np.arange(5)[None])], np.zeros(1, np.int64)).chi2[0]

    lost = Observation(np.ones((1, 4)), np.full((1, 4), 1e6), every[:1], none[:1])
    absent = Observation(np.zeros((1, 4)), np.zeros((1, 4)), none[:1], every[:1])
    assert cost(lost, none, none) == 100
    assert cost(absent, every, every) == 100
    some = np.vstack([every[:4], none[:1]])
    assert cost(absent, some, some) == 0


def test_returns_that_are_undecided_cost_one_each_among_fits_and_place_no_landmark_alone():
    seen = Observation(np.ones((1, 8)), np.full((1, 8), 1e6), np.ones((1, 8), bool), np.zeros((1, 8), bool))

    def fit(compared):
        may = np.ones((5, 8), bool)
        may[4, compared:] = False
        images = Templates(np.ones((5, 8), np.float32), may, np.zeros_like(may), np.zeros(8), SENSOR)
        return fit_cells([(images, seen, np.arange(5)[None])], np.zeros(1, np.int64))

    assert (fit(6).chi2[0], fit(6).dof[0], fit(6).cost[0]) == (0, 4, 2)
    assert (fit(2).chi2[0], fit(2).cost[0]) == (25 * 2, 25 * 8)


def test_pixels_that_follow_the_distance_move_and_a_wall_and_edges_stay():
    # three pixels of a landmark, one at its edge, four of a wall; the frame is 3 cm beyond the first template
    distance_m, wall_m = np.array([0.8, 0.82, 0.84]), 2.0
    ranges = np.full((3, 8), wall_m)
    ranges[:, :3] = distance_m[:, None] + [0.0, 0.01, 0.03]
    ranges[:, 3] = [1.0, 1.3, 1.6]
    may = np.ones((3, 8), bool)
    images = Templates(ranges.astype(np.float32), may, may, np.zeros(8), SENSOR)
    follows = follow_distance(images, distance_m, 1)
    assert follows.tolist() == [[True] * 3 + [False] * 5] * 3
    seen_m = np.concatenate([ranges[0, :3] + 0.03, [1.5], np.full(4, wall_m)])
    seen = Observation(seen_m[None], np.full((1, 8), 1e6), may[:1], ~may[:1])
    group, own = (images, seen, np.zeros(1, np.int64)), np.zeros(1, np.int64)
    assert best_moves(group, follows, own, 0.1) == pytest.approx(0.03, abs=1e-6)
    assert best_moves(group, follows, own, 0.02) == 0
    # the edge is off by half a metre, which costs no more than a disagreement
    assert moved_costs(group, follows, own, np.array([0.03]), 0.0) == pytest.approx(25, abs=0.01)
    assert moved_costs(group, follows, own, np.zeros(1), 0.0) == 100
    assert moved_costs(group, follows, own, np.zeros(1), 0.03) == pytest.approx(3 * 0.03**2 / (1e-6 + 0.03**2) + 25)


def test_a_landmark_whose_noise_is_far_below_a_step_of_the_grid_is_still_one(bank):
    rng = np.random.default_rng(7)
    distance_m, delta_rad = np.array([0.69, 0.71, 0.73]), np.radians([11.0, 13.0, 15.0])
    image = Renderer(bank.mesh("gear"), SENSOR).render(distance_m, delta_rad)
    matches = Matcher(bank, "nearest").match(kalman_filter(capture(image, SENSOR, rng=rng, n_frames=50)))
    assert list(matches.class_name) == ["gear"] * 3
    assert np.abs(matches.distance_m - distance_m) == pytest.approx(0.01, abs=1e-6)
    assert all(one.class_probability["gear"] > 0.99 for one in matches)


@pytest.mark.parametrize("name", ["gear", "box", "notched"])
def test_a_view_beyond_the_distances_of_a_bank_is_not_accepted(bank, name):
    rng = np.random.default_rng(8)
    beyond = rng.uniform(0.015, 0.025, 30)  # a step is 0.02 m
    distance = np.where(rng.random(30) < 0.5, 0.5 - beyond, 1.1 + beyond)
    image = Renderer(bank.mesh(name), SENSOR).render(distance, rng.uniform(0, 2 * np.pi, 30))
    found = Matcher(bank, "nearest").match(kalman_filter(capture(image, SENSOR, rng=rng, n_frames=5)))
    assert not found.accepted.any()
    assert "outside the bank" in set(found.reason)


def test_an_end_of_the_angles_may_be_a_minimum_unless_they_close():
    cost = np.array([[1.0, 2.0, 3.0, 0.0]])
    assert _is_minimum(cost, closes=False).tolist() == [[True, False, False, True]]
    assert _is_minimum(cost, closes=True).tolist() == [[False, False, False, True]]
