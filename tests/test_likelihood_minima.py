"""Likelihoods with several minima: what is found, excused, refused and weighed on banks of parts made for each."""

import math
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from random_parts import KINDS, random_part
from scipy.stats import binom, chi2

from phasemark.data import BankPlan, build_bank
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import export_mesh
from phasemark.matcher import Matcher, kalman_filter
from phasemark.matcher.estimate.fits import Fits
from phasemark.matcher.likelihood.refine import costs_at, refine
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.valleys import _with_left
from phasemark.matcher.nearest.bank_minima import Starts
from phasemark.matcher.pixel_agreement import DISAGREEMENT, MAY_RETURN_COVERAGE, MUST_RETURN_COVERAGE
from phasemark.render import Background, Renderer, Views, capture, preset

FIXED, BEARING = ("distance_m", "delta_rad"), ("distance_m", "delta_rad", "bearing_rad")


def parts_of(seed, count):
    """Return parts with their kinds, as the table of random parts draws them."""
    rng, parts = np.random.default_rng(seed), []
    for _ in range(count):
        kind = str(rng.choice(list(KINDS)))
        parts.append((kind, random_part(kind, rng)))
    return parts


def bank_of(folder, meshes, distance_m, delta_deg):
    """Build a bank of meshes by name."""
    for name, mesh in meshes.items():
        (folder / f"{name}.ply").write_bytes(export_mesh(mesh, "ply"))
    plans = tuple(MeshPlan(name=name, path=str(folder / f"{name}.ply"), unit="m") for name in meshes)
    grid = {"distance_m": distance_m, "delta_deg": delta_deg, "layout": "full"}
    return build_bank(BankPlan(meshes=plans, sensor="pmd-16x16", **grid))


def frames_of(bank, name, views, exposures, seed, background=None):
    """Return filtered frames of some views."""
    renderer = Renderer(bank.mesh(name), bank.sensor, albedo=bank.mesh(name).metadata["albedo"])
    image = renderer.render_views(views, background=background)
    return kalman_filter(capture(image, bank.sensor, rng=np.random.default_rng(seed), n_frames=exposures))


def scene_and_evidence(matcher, frames):
    """Return what a matcher compares frames with, and the frames as it sees them."""
    evidence = Evidence.from_frames(matcher.read_out(frames).without_offset().with_pooled_noise(), "ranges")
    return matcher._method.scenes.stated, evidence


def starts_of(class_index, view, frame=None):
    """Return views (m, 6) of a class, for a frame each or one for all."""
    m = len(view)
    return Starts(np.arange(m) if frame is None else np.full(m, frame), np.full(m, class_index), view)


# -- a fit is found, or something as likely

N = 12
VIEWS: dict[str, tuple[tuple[int, int], int, str, int, tuple[float, float, float], dict[str, Any]]] = {
    # an arch on its edge: without the pixels that have a kink its images are alike over ten degrees
    "edge": ((212, 4), 0, "0.64:0.76:0.02", 4, (0.6857, 116.96, 0.0), {"free": FIXED}),
    "edge before a wall": (
        (411, 9), 1, "1.08:1.2:0.02", 50, (1.1464, 209.46, 0.0), {"free": FIXED, "background": Background(wall_m=2.5)}
    ),
    # a step of the bearing by a column leads from one side minimum to the next
    "columns": ((401, 5), 3, "0.64:0.76:0.02", 50, (0.7244, 133.69, 1.04), {"free": BEARING}),
}  # fmt: skip


@pytest.mark.parametrize("name", VIEWS)
def test_nothing_is_likelier_than_the_answer(name, tmp_path):
    seed, number, distance_m, exposures, (distance, delta_deg, bearing_deg), options = VIEWS[name]
    truth = np.tile([distance, math.radians(delta_deg), math.radians(bearing_deg), 0.0, 0.0, 0.0], (N, 1))
    with bank_of(tmp_path, {"part": parts_of(seed, number + 1)[number][1]}, distance_m, "0:358:2") as bank:
        frames = frames_of(bank, "part", Views(*truth.T.copy()), exposures, 5, options.get("background"))
        matcher = Matcher(bank, "refine", **options)
        scene, evidence = scene_and_evidence(matcher, frames)
        true = refine(scene.final, evidence, starts_of(0, truth), scene.settings())
        for k, match in enumerate(matcher.match(frames)):
            places = [(match.distance_m, match.delta_rad), *((o.distance_m, o.delta_rad) for o in match.alternatives)]
            near = [
                abs(d - distance) < 0.03 and abs(math.remainder(a - truth[k, 1], 2 * math.pi)) < math.radians(6)
                for d, a in places
            ]
            # either the true view is among the explanations, or it costs so much more that it is none
            assert any(near) or true.cost[k] > match.chi2 + 25
            assert not match.accepted or near[0]


# -- pixels that a solution contradicts are excused by one view nearby, not each by another

WEDGE = 1.3717, math.radians(14.65), math.radians(0.22)
ARCH = 1.28906, math.radians(125.574), math.radians(1.169)
"""Through the opening of the arch nothing is seen where the wedge returns; where both return the ranges agree."""


def test_fits_cost_what_one_view_nearby_contradicts(tmp_path):
    arch, _, wedge = parts_of((921, 5), 3)
    n, (wedge_view, arch_view) = 8, (np.tile([*view, 0.0, 0.0, 0.0], (8, 1)) for view in (WEDGE, ARCH))
    with bank_of(tmp_path, dict((arch, wedge)), "1.2:1.44:0.02", "0:358:2") as bank:
        assert list(bank.classes) == ["arch", "wedge"]
        frames = frames_of(bank, "wedge", Views(*wedge_view.T.copy()), 50, 3)
        scene, evidence = scene_and_evidence(Matcher(bank, "refine"), frames)
        renderer = Renderer(bank.mesh("arch"), bank.sensor, albedo=bank.mesh("arch").metadata["albedo"])
        true = refine(scene.final, evidence, starts_of(1, wedge_view), scene.settings())
        # a true view is excused: no fit costs more than the view that its frame was made at
        assert (true.cost <= costs_at(scene.final, evidence, starts_of(1, wedge_view), scene.settings()) + 9).all()
        fits = refine(scene.final, evidence, starts_of(0, arch_view), scene.settings())
    rng, seen = np.random.default_rng(4), evidence.seen
    for k in range(n):
        off = rng.standard_normal((600, 3))
        off *= 3 * rng.uniform(size=(600, 1)) ** (1 / 3) / np.linalg.norm(off, axis=1, keepdims=True)
        view = np.vstack([np.zeros(3), off @ np.linalg.cholesky(fits.covariance[k]).T]) + fits.view[k, :3]
        coverage = renderer.render_views(Views.broadcast(*view.T)).coverage.reshape(len(view), -1)
        wrong = (seen.returned[k] & (coverage < MAY_RETURN_COVERAGE)) | (
            seen.not_returned[k] & (coverage > MUST_RETURN_COVERAGE)
        )
        fewest = wrong.sum(axis=1).min()
        assert fewest >= 8
        assert fits.cost[k] >= DISAGREEMENT * fewest


# -- an accepted answer has no explanation a tolerance away, whatever its covariance tells

TRUTH = 1.2667, math.radians(183.52)
TOLERANCE_RAD = math.radians(6.0)


@pytest.fixture(scope="module")
def flat(tmp_path_factory):
    """A wedge whose front is flat: from 174° to 186° its image hardly changes."""
    with bank_of(tmp_path_factory.mktemp("part"), dict(parts_of((213, 2), 1)), "1.2:1.34:0.02", "150:214:2") as built:
        yield built


def rise_at(matcher, frames, k, match, offset_rad):
    """Return by how much the least cost over all distances grows when δ is turned by an offset."""
    scene, evidence = scene_and_evidence(matcher, frames)
    near = np.arange(-0.03, 0.0301, 0.0005)
    view = np.zeros((len(near), 6))
    view[:, 0], view[:, 1] = match.distance_m + near, match.delta_rad + offset_rad
    return costs_at(scene.final, evidence, starts_of(0, view, k), scene.settings()).min() - match.chi2


def test_accepted_answers_rise_by_three_and_a_half_sigma_at_the_tolerance_whatever_their_covariance(flat):
    frames = frames_of(flat, "wedge", Views.broadcast(np.full(40, TRUTH[0]), TRUTH[1]), 1, 7)
    matcher, narrow = Matcher(flat, "refine", free=FIXED), 0
    for k, match in enumerate(matcher.match(frames)):
        rise = min(rise_at(matcher, frames, k, match, side * TOLERANCE_RAD) for side in (-1, 1))
        if match.accepted:
            assert rise > 3.5**2 - 0.5  # the grid of distances is not the minimum
        elif match.covariance is not None and 3 * math.sqrt(match.covariance[1, 1]) < TOLERANCE_RAD and rise < 3.5**2:
            assert match.reason in ("undetermined", "poor fit")
            narrow += 1
    assert narrow > 2  # parabolas alone would have passed these


def test_answers_that_many_exposures_determine_are_accepted(flat):
    frames = frames_of(flat, "wedge", Views.broadcast(np.full(40, TRUTH[0]), TRUTH[1]), 200, 7)
    accepted = [match for match in Matcher(flat, "refine", free=FIXED).match(frames) if match.accepted]
    assert len(accepted) > 30
    assert all(abs(math.degrees(match.delta_rad - TRUTH[1])) < 6 for match in accepted)


# -- the probability of a class is the posterior's, integrated over all of its views

SIDES = {"post": 72, "prism": 6}


def posterior(scene, evidence, frame, class_index, distance_m, delta_rad):
    """Return the logarithm of the likelihood's mean over a grid of views."""
    view = np.zeros((len(distance_m) * len(delta_rad), 6))
    view[:, 0], view[:, 1] = np.repeat(distance_m, len(delta_rad)), np.tile(delta_rad, len(distance_m))
    cost = costs_at(scene.final, evidence, starts_of(class_index, view, frame), scene.settings())
    least = cost.min()
    return math.log(np.exp((least - cost) / 2).mean()) - least / 2


def test_odds_of_two_classes_are_those_of_their_likelihoods_integrated_over_all_views(tmp_path):
    """Single exposures hardly tell a post from a prism with six sides."""
    meshes = {name: trimesh.creation.cylinder(0.09, 0.3, sections=sides) for name, sides in SIDES.items()}
    rng, off, n = np.random.default_rng(5), [], 20
    distance = np.linspace(0.9, 1.1, 101)
    turns = [np.zeros(1), np.radians(np.arange(0, 60, 1.0))]  # a post has one view, and a prism those of its period
    with bank_of(tmp_path, meshes, "0.9:1.1:0.01", "0:359:1") as bank:
        matcher = Matcher(bank, "refine", free=FIXED)
        for name in SIDES:
            views = Views.broadcast(rng.uniform(0.94, 1.06, n), rng.uniform(0, 2 * np.pi, n))
            frames = frames_of(bank, name, views, 1, rng)
            scene, evidence = scene_and_evidence(matcher, frames)
            for k, match in enumerate(matcher.match(frames)):
                stated = math.log(match.class_probability["post"] / match.class_probability["prism"])
                post, prism = (posterior(scene, evidence, k, c, distance, turns[c]) for c in range(2))
                off.append(stated - (post - prism))
    # an error of one is a factor of e; a pixel that a view nearby excuses costs 25 or nothing
    assert abs(np.median(off)) < 0.3
    assert np.mean(np.abs(off) < 1.0) >= 0.85
    assert np.abs(off).max() < 6.0  # no class is given up whose likelihood is not


def test_covariances_hold_where_an_edge_reaches_a_border_of_wide_pixels():
    # near these views the cost is flat over a degree to one side, or the valley bends, and slopes about the solution
    # claim less than a tenth of a degree; the likelihood itself says what is known
    sensor, wall = preset("vl53l5cx-8x8").with_(histogram=None), Background(wall_m=1.6)
    bank = build_bank(
        {"classes": ("cone",), "sensor": "vl53l5cx-8x8", "distance_m": "0.46:0.66:0.02", "delta_deg": "-20:20:2"}
    )
    truth = np.array([[0.522672, -0.514275, 5.65921], [0.597952, -6.836282, 3.76438], [0.63, -8.94, -1.04]])
    truth[:, 1:] = np.radians(truth[:, 1:])
    draws, p = 40, 3
    truth = np.repeat(truth, draws, axis=0)
    image = Renderer(bank.mesh("cone"), sensor, albedo=0.8).render(*truth.T, background=wall)
    frames = capture(image, sensor, rng=np.random.default_rng(1), n_frames=1)
    with bank:
        found = Matcher(bank, "refine", background=wall).match(kalman_filter(frames))
    error = np.column_stack([found.distance_m, found.delta_rad, found.bearing_rad]) - truth
    error[:, 1] = np.remainder(error[:, 1] + math.pi / 2, math.pi) - math.pi / 2
    some = found.accepted
    assert some.mean() > 0.9
    squared = np.array(
        [e @ np.linalg.solve(one.covariance, e) for e, one in zip(error, found, strict=True) if one.accepted]
    )
    inside = int((squared < chi2.ppf(0.95, p)).sum())
    assert inside >= binom.ppf(0.002, len(squared), 0.95)
    assert squared.max() < chi2.isf(1e-3 / len(squared), p)
    assert np.median(squared) > chi2.ppf(0.3, p)  # they claim no less than is known either


def test_the_right_view_is_found_where_its_cell_is_no_local_minimum():
    sensor, wall = preset("vl53l5cx-4x4").with_(histogram=None), Background(wall_m=1.6)
    bank = build_bank(
        {"classes": ("cone",), "sensor": "vl53l5cx-4x4", "distance_m": "0.35:1:0.02", "delta_deg": "-44:44:2"}
    )
    truth = np.array([[0.6602, 37.0, -4.372], [0.6643, 30.61, -4.384], [0.5239, -35.49, 5.346], [0.5884, 35.36, -4.57]])
    truth[:, 1:] = np.radians(truth[:, 1:])
    image = Renderer(bank.mesh("cone"), sensor, albedo=0.8).render(*truth.T, background=wall)
    frames = capture(image, sensor, rng=np.random.default_rng(5), n_frames=1)
    with bank:
        found = Matcher(bank, "refine", background=wall).match(kalman_filter(frames))
    assert "poor fit" not in found.reason
    np.testing.assert_allclose(found.distance_m, truth[:, 0], atol=0.005)
    assert np.abs(np.sin(found.delta_rad - truth[:, 1])).max() < math.radians(2)


def test_a_fit_beside_which_something_costs_less_descends_from_there(tmp_path):
    """A part of boxes before a wall at 8 m: the answer was a third of a degree off, and cost 26 more than the truth."""
    at = trimesh.transformations.translation_matrix
    boxes = [
        trimesh.creation.box((0.30, 0.10, 0.30)),
        trimesh.creation.box((0.10, 0.22, 0.14), transform=at((0.08, 0.10, -0.06))),
        trimesh.creation.box((0.06, 0.06, 0.2), transform=at((-0.10, -0.06, 0.08))),
    ]
    n, rng, wall = 100, np.random.default_rng(2), Background(wall_m=8.0)
    views = Views.broadcast(rng.uniform(0.8, 1.6, n), rng.uniform(0, 2 * np.pi, n), rng.normal(0, 0.01, n))
    with bank_of(
        tmp_path, {"part": trimesh.boolean.union(boxes, engine="manifold")}, "0.7:2.1:0.02", "0:359:4"
    ) as bank:
        frame = frames_of(bank, "part", views, 50, rng, wall)[80:81]
        matcher = Matcher(bank, "refine", free=("distance_m", "delta_rad", "bearing_rad"), background=wall)
        (found,) = matcher.match(frame)
        scene, evidence = scene_and_evidence(matcher, frame)
        truth = [views.distance_m[80], views.delta_rad[80], views.bearing_rad[80], 0, 0, 0]
        seen = [found.distance_m, found.delta_rad, found.bearing_rad, 0, 0, 0]
        starts = starts_of(0, np.array([truth, seen]), 0)
        of_truth, of_answer = costs_at(scene.final, evidence, starts, scene.settings())
    assert found.accepted
    assert of_answer < of_truth + 1


def test_a_covariance_holds_the_minimum_beside_it_that_was_left():
    """Of two narrow minima each is as likely as exp(−cost / 2): the second moment about one is that of the mixture."""
    zero: Any = np.zeros(1)
    left = Fits(**{field.name: zero for field in fields(Fits)})
    left = replace(left, view=np.array([[1.0, 0.1, 0, 0, 0, 0]]), covariance=np.diag([1e-6, 4e-6])[None],
                   std_without_one=np.array([[1e-3, 2e-3]]), cost=np.array([12.0]))  # fmt: skip
    found = replace(left, view=np.array([[1.003, 0.12, 0, 0, 0, 0]]), cost=np.array([10.0]))
    scene: Any = SimpleNamespace(setup=SimpleNamespace(free=("distance_m", "delta_rad")))
    both = _with_left(scene, found, left)
    share = math.exp(-6) / (math.exp(-6) + math.exp(-5))
    expected = np.diag([1e-6, 4e-6]) + share * np.outer([-0.003, -0.02], [-0.003, -0.02])
    np.testing.assert_allclose(both.covariance[0], expected)
    np.testing.assert_allclose(both.std_without_one[0], np.sqrt(np.diag(expected)))


def test_images_that_no_interpolation_follows_make_no_answer(tmp_path):
    # an upright board with a shelf at the top and one at the bottom: in a pixel that sees along them a degree decides
    # whether a shelf or the board far behind is seen, and interpolated ranges turn by 20 m/rad; rendered ones by 0.04
    boards = [((0.012, 0.24, 0.26), (-0.1, 0, 0)), *(((0.2, 0.24, 0.012), (0, 0, z)) for z in (-0.12, 0.12))]
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in boards]
    n, errors, claimed = 60, [], []
    with bank_of(tmp_path, {"shelf": trimesh.boolean.union(boxes)}, "0.6:1.1:0.01", "0:360:1") as bank:
        matcher = Matcher(bank, "refine", free=FIXED)
        for exposures in (50, 400):
            views = Views.broadcast(np.full(n, 0.8486), math.radians(307.67))
            frames = frames_of(bank, "shelf", views, exposures, 1)
            matches = matcher.match(frames)
            tracked = matcher.track(frames[:1], matches[:1])
            off_rad = tracked.delta_rad - matches[0].delta_rad
            assert abs(off_rad) < 0.1 * math.sqrt(tracked.covariance[1, 1])
            assert tracked.covariance[1, 1] == pytest.approx(matches[0].covariance[1, 1], rel=0.2)
            for match in matches:
                if match.accepted:
                    errors.append([match.distance_m - 0.8486, match.delta_rad - math.radians(307.67)])
                    claimed.append(match.covariance)
    assert len(errors) > 0.95 * 2 * n
    squares = np.einsum("kp,kpq,kq->k", errors, np.linalg.inv(claimed), errors)
    low, high = chi2.ppf([0.001, 0.999], 2 * len(squares)) / len(squares)
    assert low < squares.mean() < 1.15 * high  # of 2 in expectation; off by 286 times without the test


@pytest.mark.soak
@pytest.mark.parametrize("exposures", [50, 400])
def test_random_parts_on_the_default_grid_have_the_covariance_that_is_stated(exposures, tmp_path):
    n, squares, rng = 40, [], np.random.default_rng(31)
    for k, (kind, mesh) in enumerate(parts_of(30, 14)):
        with bank_of(tmp_path, {f"{kind}{k}": mesh}, "0.6:1.1:0.01", "0:360:1") as bank:
            views = Views.broadcast(rng.uniform(0.7, 1.0, n), rng.uniform(0, math.tau, n))
            matches = Matcher(bank, "refine", free=FIXED).match(frames_of(bank, f"{kind}{k}", views, exposures, k))
            for match, distance_m, delta_rad in zip(matches, views.distance_m, views.delta_rad, strict=True):
                if match.accepted:
                    turned = math.remainder(match.delta_rad - delta_rad, math.tau / match.symmetry)
                    error = np.array([match.distance_m - distance_m, turned])
                    squares.append(float(error @ np.linalg.pinv(match.covariance) @ error))
    assert len(squares) > 200
    assert np.mean(squares) < 1.15 * chi2.ppf(0.999, 2 * len(squares)) / len(squares)  # of 2
    assert max(squares) < chi2.isf(1e-3 / len(squares), 2)
