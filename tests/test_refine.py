"""Maximum likelihood: at the bound, over the seam, honest about itself, and quiet where there is no landmark."""

import functools
import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh
from builders import block, strangers
from damaged_frames import DAMAGE, check_damaged
from hypothesis import HealthCheck, given, settings
from scipy import stats

from phasemark import UsageError
from phasemark.data import BankPlan, build_bank
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import FilteredFrames, Matcher, kalman_filter
from phasemark.matcher.accuracy.trials import Trials, TrialSetup, noisy_frames, run_trials
from phasemark.matcher.filters import noise_free
from phasemark.matcher.filters.filtered_frames import PixelState
from phasemark.matcher.frequencies import background_of
from phasemark.matcher.likelihood.bank_images import BankModel
from phasemark.matcher.likelihood.contradictions import whole_cost
from phasemark.matcher.likelihood.descent import descend
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.likelihood_matcher import LikelihoodMatcher
from phasemark.matcher.likelihood.problem import DescentSettings, Problem
from phasemark.matcher.likelihood.rendered_images import RenderedModel
from phasemark.matcher.likelihood.residuals import Evidence, gauss_newton_sums
from phasemark.matcher.likelihood.scenes import Scenes
from phasemark.matcher.likelihood.setup import setup_of
from phasemark.matcher.likelihood.uncertainty import std_without_one_pixel, view_covariance
from phasemark.matcher.pixel_agreement import DISAGREEMENT, MAY_RETURN_COVERAGE, MUST_RETURN_COVERAGE
from phasemark.render import Background, Frames, Renderer, Views, capture, predicted_range_std, preset

SENSOR = preset("pmd-16x16")
WALL = Background(wall_m=4.0)
NAMES = ("cylinder", "cone", "sphere", "post")
STRANGERS = ("cube", "slab", "table", "pyramid")


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    plan = BankPlan(distance_m="0.75:1.65:0.01", delta_deg="0:180:1")
    with build_bank(plan, tmp_path_factory.mktemp("bank") / "bank.h5") as opened:
        yield opened


@pytest.fixture(scope="module")
def matcher_of(bank):
    """Return a function from options to their matcher of the bank, which is made once."""
    return functools.cache(lambda **options: Matcher(bank, "refine", **options))


@pytest.fixture(scope="module")
def bank_of_two():
    """Two classes alone: a frame without sense takes seconds a class."""
    with build_bank(BankPlan(classes=("cone", "post"), distance_m="0.75:1.65:0.01", delta_deg="0:180:1")) as bank:
        yield bank


@pytest.fixture(scope="module")
def two_matchers(bank_of_two):
    """Without a background, and with one that is found."""
    return tuple(Matcher(bank_of_two, "refine", free=VIEW[:2], background=background) for background in (None, "auto"))


@pytest.fixture(scope="module")
def renderers():
    return {name: Renderer(build_mesh(spec), SENSOR, albedo=0.8) for name, spec in catalog().items()}


def test_interpolated_images_are_rendered_ones_within_a_fraction_of_the_noise(bank, renderers):
    rng = np.random.default_rng(4)
    view = np.column_stack([rng.uniform(0.8, 1.6, 60), rng.uniform(0, np.pi, 60), np.zeros((60, 4))])
    c = bank.classes.index("cone")
    made = BankModel(bank).images(np.full(60, c), view, VIEW[:2])
    image = renderers["cone"].render_views(Views(*np.ascontiguousarray(view.T)))
    std = predicted_range_std(image.amplitude, image.intensity, SENSOR).reshape(60, -1)
    counted = std <= 0.1 * SENSOR.metres_per_radian
    error = SENSOR.metres_per_radian * np.angle(made.phasor * image.phasor.reshape(60, -1).conj())
    whitened = np.where(counted, error / (std / math.sqrt(50)), 0.0)
    # measured: 0.006 in the root mean square over pixels in the median view; the linear pixels reach some tenths
    assert np.median(np.sqrt((whitened**2).sum(axis=1) / counted.sum(axis=1))) < 0.02
    assert np.abs(whitened).max() < 3


def test_a_fixed_pattern_that_the_sensor_states_is_noise_that_no_mean_lessens(bank, matcher_of):
    rng, squares, n = np.random.default_rng(8), [], 24
    for k in range(n):
        sensor = bank.sensor.with_(phase_offset_std_rad=0.0025, tap_phase_offset_std_rad=0.0025, unit_seed=k + 1)
        view = rng.uniform(0.8, 1.4), rng.uniform(0, math.pi)
        image = Renderer(bank.mesh("post"), sensor, albedo=0.8).render(*view)
        (match,) = matcher_of(free=VIEW[:2]).match(kalman_filter(capture(image, sensor, rng=rng, n_frames=50)))
        error = np.array(
            [match.distance_m - view[0], math.remainder(match.delta_rad - view[1], math.tau / match.symmetry)]
        )
        if match.accepted:
            squares.append(error @ np.linalg.solve(match.covariance, error))
    assert len(squares) >= n - 2  # none without it
    pattern = bank.sensor.with_(phase_offset_std_rad=0.01, unit_seed=1)  # 24 mm: of 200 frames no more than of one
    image = Renderer(bank.mesh("post"), pattern, albedo=0.8).render(1.0, 0.3)
    ranges = Frames(capture(image, pattern, rng=rng, n_frames=200).range_m, sensor=pattern)
    assert matcher_of(free=VIEW[:2]).match(kalman_filter(ranges))[0].class_name is not None
    low, high = stats.chi2.ppf([0.001, 0.999], 2 * len(squares))
    assert low < sum(squares) < high


@pytest.mark.parametrize(("brightness", "fewest"), [(1.0, 36), (0.5, 25)])
def test_ranges_alone_of_four_frames_have_an_honest_covariance(matcher_of, renderers, brightness, fewest):
    """The scatter of four frames is a poor weight: NEES / 2 was 13.7, and the law knows no slopes and edges."""
    rng, n = np.random.default_rng(6), 40
    truth = Views.broadcast(rng.uniform(0.8, 1.1, n), rng.uniform(0, math.pi, n))
    dim = SENSOR.with_(signal_e=brightness * SENSOR.signal_e)  # and matched as one that is stated to be brighter
    lit = capture(renderers["cone"].render_views(truth), dim, rng=rng, n_frames=4)
    matches = matcher_of(free=VIEW[:2]).match(kalman_filter(Frames(lit.range_m, sensor=SENSOR)))
    off = np.column_stack(
        [matches.distance_m - truth.distance_m, np.angle(np.exp(2j * (matches.delta_rad - truth.delta_rad))) / 2]
    )
    squares = [
        own @ np.linalg.solve(match.covariance, own) for own, match in zip(off, matches, strict=True) if match.accepted
    ]
    assert len(squares) >= fewest
    assert sum(squares) < stats.chi2.ppf(0.999, 2 * len(squares))


def test_interpolated_slopes_are_those_of_the_interpolated_images(bank):
    model = BankModel(bank)
    view = np.array([[1.0137, 0.6512, 0, 0], [1.2651, 3.1379, 0, 0]])  # the second beyond the last angle of the grid
    c = np.array([0, 2])
    here = model.images(c, view, VIEW[:2])
    for k, step in enumerate((1e-4, 1e-4)):
        moved = [view + side * step * np.eye(4)[k] for side in (1, -1)]
        high, low = (model.images(c, v, VIEW[:2]).phasor for v in moved)
        # a central difference over 2e-4 of float32 numbers of order 1: rounding 6e-8 of each
        np.testing.assert_allclose(here.slope[:, k], (high - low) / (2 * step), atol=1e-3)


def test_rendered_images_are_the_renderers_own_with_its_jacobian(bank, renderers):
    model = RenderedModel(bank, WALL)
    view = np.array([[1.0137, 0.6512, 0.01, 0.0]])
    made = model.images(np.array([bank.classes.index("post")]), view, VIEW[:3])
    image = renderers["post"].render(*view[0], background=WALL)
    slope = renderers["post"].jacobian(*view[0], background=WALL, parameters=VIEW[:3])
    np.testing.assert_allclose(made.phasor, image.phasor.reshape(1, -1), atol=1e-6)  # the bank's mesh is float32
    # beside a limb, the tangents of interpolated normals: see tests/test_slopes.py
    np.testing.assert_allclose(made.slope, slope.reshape(1, 3, -1), atol=0.03 * np.abs(slope).max())


@pytest.mark.parametrize("delta_deg", [0.003, 179.997, 0.0, 90.0, 45.3])
def test_a_noise_free_view_is_found_exactly_over_the_seam_and_at_the_quarter_turns(matcher_of, renderers, delta_deg):
    image = renderers["sphere"].render(1.0234, math.radians(delta_deg))
    match = matcher_of().match(noise_free(image, 50))[0]
    assert match.class_name == "sphere"
    assert match.distance_m == pytest.approx(1.0234, abs=1e-4)  # a third of the bound of 50 frames
    error = math.remainder(match.delta_rad - math.radians(delta_deg), math.pi)
    assert abs(error) < math.radians(0.1)  # a third of the bound of 50 frames
    assert 0 <= match.delta_rad < math.pi
    assert match.chi2 < 2  # what interpolation leaves; noise would leave a hundred


@pytest.mark.parametrize("distance_m", [0.7501, 1.6499])
def test_views_in_the_last_cells_of_the_grid_are_found(matcher_of, renderers, distance_m):
    image = renderers["cylinder"].render(distance_m, 0.7)
    match = matcher_of().match(noise_free(image, 50))[0]
    assert match.distance_m == pytest.approx(distance_m, abs=2e-4)
    assert match.accepted


def test_the_error_of_distance_and_angle_is_the_bound_and_the_covariance_says_so(matcher_of, renderers):
    # N = 240 over the four classes; 99.9 % intervals over 7 figures
    rng = np.random.default_rng(20)
    match = matcher_of(free=VIEW[:2]).match
    errors = [run_trials(match, renderers[name], name, TrialSetup(), 60, rng) for name in NAMES]
    for trials in errors:
        assert (trials.found == trials.class_name).all()
    assert Trials.joined(errors).summary().class_errors.value == 0
    scaled = np.concatenate([t.scaled[~t.outlier] for t in errors])
    summaries = [t.summary() for t in errors]
    n = len(scaled)
    assert n >= 236  # outliers are 0.3 % of all: more than 4 of 240 have a probability of 1e-3
    z = 3.7  # 99.9 % over 7 figures
    for k in range(2):
        ratio = math.sqrt((scaled[:, k] ** 2).mean())
        assert ratio < 1.05 + z / math.sqrt(2 * n)
        assert ratio > 0.98 - z / math.sqrt(2 * n)
        assert abs(scaled[:, k].mean()) < 0.1 + z / math.sqrt(n)
    nees = np.mean([s.nees.value for s in summaries])
    assert abs(nees - 1.02) < 0.08 + z / math.sqrt(n)
    inside = np.mean([s.coverage.value for s in summaries])
    assert abs(inside - 0.95) < 0.015 + z * math.sqrt(0.95 * 0.05 / n)
    accepted = np.mean([s.accepted.value for s in summaries])
    assert accepted > 0.985 - z * math.sqrt(0.01 / n)


def test_before_a_wall_mixed_pixels_inform_and_the_error_is_that_bound(matcher_of, renderers):
    # N = 40: a matcher that stops at a side peak, or at ranges of the landmark alone, is off by tens of bounds
    setup = TrialSetup(background=WALL)
    matcher = matcher_of(free=VIEW[:2], background=WALL)
    trials = run_trials(matcher.match, renderers["cone"], "cone", setup, 40, np.random.default_rng(2))
    inner = trials.scaled[~trials.outlier]
    assert len(inner) >= 38
    assert np.sqrt((inner**2).mean()) < 1.05 + 3.3 / math.sqrt(4 * len(inner))
    median_deg = math.degrees(np.median(np.sqrt(trials.bound[:, 1, 1])))
    assert median_deg < 0.06  # PHYSICS section 7: 0.03° at 1 m, and these go to 1.6 m


@pytest.mark.parametrize("albedo", [0.56, 0.8])
def test_before_a_wall_of_unknown_albedo_the_error_is_the_bound_with_it(matcher_of, albedo):
    # N = 40: pixels that see both have ranges of a mixture that nobody stated
    behind, dark = replace(WALL, albedo_ratio_std=0.5), Renderer(build_mesh(catalog()["cone"]), SENSOR, albedo=albedo)
    setup = TrialSetup(background=behind)
    matcher = matcher_of(free=VIEW[:2], background=behind)
    trials = run_trials(matcher.match, dark, "cone", setup, 40, np.random.default_rng(2))
    inner = trials.scaled[~trials.outlier]
    assert len(inner) >= 38
    assert np.sqrt((inner**2).mean()) < 1.05 + 3.3 / math.sqrt(4 * len(inner))
    assert abs(trials.summary().nees.value - 1) < 3.3 / math.sqrt(len(inner))
    assert trials.accepted.mean() > 0.85
    if albedo != 0.8:  # as stated, they are refused
        stated = matcher_of(free=VIEW[:2], background=WALL).match
        assert not run_trials(stated, dark, "cone", setup, 10, np.random.default_rng(2)).accepted.any()


def test_a_wall_much_darker_than_supposed_leaves_the_covariance_right(matcher_of, renderers):
    # N = 24, a ratio of albedos of three times that which is supposed
    supposed = Background(wall_m=2.5, albedo_ratio_std=1.0)
    setup = TrialSetup(background=Background(wall_m=2.5, wall_albedo=0.17), n_frames=5)
    matcher = matcher_of(free=VIEW[:2], background=supposed)
    trials = run_trials(matcher.match, renderers["cone"], "cone", setup, 24, np.random.default_rng(4))
    assert trials.accepted.mean() > 0.8
    assert trials.summary().nees.value < 1 + 3.3 / math.sqrt(24)


def test_on_phasors_the_albedo_does_not_matter(bank, matcher_of):
    # 30 % darker than the bank has it; N = 30
    dark = Renderer(build_mesh(catalog()["cylinder"]), SENSOR, albedo=0.56)
    setup = TrialSetup(on="phasors", distance_m=(0.8, 1.2))
    matcher = matcher_of(free=VIEW[:2], on="phasors")
    trials = run_trials(matcher.match, dark, "cylinder", setup, 30, np.random.default_rng(3))
    inner = trials.scaled[~trials.outlier]
    assert len(inner) >= 29
    assert np.sqrt((inner**2).mean()) < 1.05 + 3.3 / math.sqrt(4 * len(inner))
    assert trials.accepted.mean() > 0.85  # 99 % minus 3.3 σ of 30


def test_trials_of_a_matcher_that_estimates_something_else_are_refused(matcher_of, renderers):
    with pytest.raises(UsageError, match="estimates distance_m, delta_rad, bearing_rad, and 'free'"):
        run_trials(matcher_of().match, renderers["cone"], "cone", TrialSetup(), 1, np.random.default_rng(1))


@pytest.mark.parametrize("background", [None, Background(wall_m=2.5), Background(floor_m=0.3)])
def test_a_model_given_a_background_has_the_limits_of_one_built_with_it(bank, background):
    delta = np.radians([0.0, 30.0, 90.0, 200.0])
    built = RenderedModel(bank, background).limits(delta)
    for before in (None, Background(wall_m=3.0)):
        np.testing.assert_array_equal(RenderedModel(bank, before).with_background(background).limits(delta), built)
    if background is not None and background.wall_m is not None:
        for name in bank.classes:  # the landmark stands before the wall, whichever side it shows
            x, y = bank.mesh(name).vertices[:, :2].T
            reach = np.cos(delta)[:, None] * x + np.sin(delta)[:, None] * y
            assert (built[1] + reach.max(axis=1) < background.wall_m).all()


@pytest.mark.parametrize("huber", [None, 2.0])
@pytest.mark.parametrize("on", ["ranges", "phasors"])
def test_the_deviation_without_one_pixel_is_that_of_sums_without_it(bank, renderers, on, huber):
    # the oracle sums again without each pixel; a robust covariance is that of the steps from there (the jackknife), and
    # grows by the ratio of the inverse informations
    free = VIEW[:2]
    image = renderers["cone"].render(1.02, 0.5)
    evidence = Evidence.from_frames(
        kalman_filter(capture(image, bank.sensor, rng=np.random.default_rng(2), n_frames=10)), on
    )
    used = np.ones(evidence.value.shape[1], bool)
    problem = Problem(
        RenderedModel(bank), evidence, np.zeros(1, np.int64), np.array([bank.classes.index("cone")]),
        DescentSettings(free, used, huber), np.full(1, np.inf),
    )  # fmt: skip
    state = problem.start(np.array([[1.02, 0.5, 0.0, 0.0, 0.0, 0.0]]))
    p = len(problem.columns)
    state = descend(problem, state, 1e-9)
    covariance = view_covariance(problem, state)
    found = std_without_one_pixel(problem, state, covariance)

    def sums_of(use):
        sums = gauss_newton_sums(
            state.images.phasor, state.images.slope, evidence, np.zeros(1, np.int64), use[None], huber
        )
        return np.linalg.inv(sums.information[0]), sums.gradient[0]

    def variance(use):
        return np.diag(sums_of(use)[0])[:2]

    assert state.sums.information.shape == (1, p, p)
    whole = variance(state.use[0])
    without, moved = [], np.zeros((p, p))
    for pixel in np.flatnonzero(state.use[0]):
        use = state.use[0].copy()
        use[pixel] = False
        without.append(variance(use))
        inverse, gradient = sums_of(use)
        moved += np.outer(inverse @ gradient, inverse @ gradient)
    if huber is not None:
        np.testing.assert_allclose(covariance[0], moved[:2, :2], rtol=1e-2)
    growth = np.sqrt(np.max(without, axis=0) / whole)
    if huber is not None:  # two standard deviations without a pixel, three of the jackknife
        growth = np.maximum(2 / 3 * growth, 1)
    expected = np.sqrt(np.diag(covariance[0])) * growth
    np.testing.assert_allclose(found[0], expected, rtol=1e-6)


def test_the_whole_cost_counts_each_contradicted_and_each_undecided_pixel_once(bank, renderers):
    """A pixel without a return that must have one leaves all returns that are not compared as they are."""
    image = renderers["cone"].render(1.02, 0.5)
    frames = kalman_filter(capture(image, bank.sensor, rng=np.random.default_rng(2), n_frames=10))
    middle = np.unravel_index(np.argmax(image.coverage[0] * (image.amplitude[0] > 0)), image.coverage[0].shape)
    state = frames.state.copy()
    state[0][middle] = PixelState.NO_RETURN
    evidence = Evidence.from_frames(replace(frames, state=state), "ranges")
    class_index = np.array([bank.classes.index("cone")])
    settings = DescentSettings(VIEW[:2], np.ones(256, bool))
    problem = Problem(RenderedModel(bank), evidence, np.zeros(1, np.int64), class_index, settings, np.full(1, np.inf))
    at = problem.start(np.array([[1.02, 0.5, 0.0, 0.0, 0.0, 0.0]]))
    use = at.use.copy()
    use[0, np.flatnonzero(at.use[0] & evidence.seen.returned[0] & (at.images.coverage[0] < 0.9))[:5]] = False
    compared = use & (evidence.weight > 0)
    coverage, returned = at.images.coverage, evidence.seen.returned
    dark = returned & ~compared & (coverage < MAY_RETURN_COVERAGE)
    absent = evidence.seen.not_returned & ~compared & (coverage > MUST_RETURN_COVERAGE)
    undecided = returned & ~compared & ~dark
    assert absent.sum() >= 1
    assert undecided.sum() >= 5
    state_there = problem.summed(at.theta, use, at.images)
    expected = state_there.sums.cost + DISAGREEMENT * (dark.sum() + absent.sum()) + undecided.sum()
    cost, contradicted = whole_cost(problem, state_there)
    assert cost == pytest.approx(expected, rel=1e-12)
    assert contradicted.all()


def test_an_automatic_background_finds_the_wall_and_the_view_before_it(matcher_of, renderers):
    view = Views.broadcast([1.2], [2.0])
    wall = Background(wall_m=3.3, wall_albedo=0.4)
    frames = noisy_frames(renderers["sphere"], SENSOR, view, TrialSetup(background=wall), np.random.default_rng(6))
    for match, distance, delta in zip(
        matcher_of(background="auto").match(frames), view.distance_m, view.delta_rad, strict=True
    ):
        assert match.class_name == "sphere"
        assert match.accepted
        assert match.background.wall_m == pytest.approx(3.3, abs=5e-3)  # 1.5 cm a pixel, a hundred pixels
        assert match.background.wall_albedo == pytest.approx(0.4, rel=0.02)
        assert match.distance_m == pytest.approx(distance, abs=2e-3)
        assert match.delta_rad == pytest.approx(delta, abs=math.radians(0.3))


@pytest.mark.parametrize("names", [("cone",), pytest.param(("cylinder", "sphere", "post"), marks=pytest.mark.soak)])
@pytest.mark.parametrize("wall_m", [None, 2.2])
def test_what_stands_behind_is_found_and_then_costs_few_views_more(matcher_of, renderers, wall_m, names):
    behind, rng = None if wall_m is None else Background(wall_m=wall_m), np.random.default_rng(8)
    matcher, plain = matcher_of(background="auto"), matcher_of()
    for name in names:
        view = Views.broadcast(rng.uniform(0.8, 1.4), rng.uniform(0, 3))
        frames = noisy_frames(renderers[name], SENSOR, view, TrialSetup(background=behind, n_frames=5), rng)
        found = matcher.match(frames)[0]
        assert len(found.alternatives) < 100  # with edges that may show anything, up to thousands
        if behind is None:
            assert [own.cost for own in found.alternatives] == [own.cost for own in plain.match(frames)[0].alternatives]


@pytest.mark.parametrize("free", [VIEW[:2], pytest.param(VIEW[:3], marks=pytest.mark.soak)])
def test_frames_before_several_backgrounds_are_matched_together_as_one_by_one(bank, renderers, free):
    behind = [Background(wall_m=2.6), None, Background(wall_m=3.4, floor_m=0.45)]
    rng = np.random.default_rng(7)
    frames: list[FilteredFrames] = []
    for k, own in enumerate(behind):
        view = Views.broadcast(rng.uniform(0.8, 1.5), rng.uniform(0, 6))
        setup = TrialSetup() if own is None else TrialSetup(background=own)
        frames.append(noisy_frames(renderers[NAMES[k % len(NAMES)]], SENSOR, view, setup, rng))
    matcher = Matcher(bank, "refine", free=free, background="auto", workers=1)
    names = ("range_m", "std_m", "amplitude_e", "intensity_e", "state", "n_effective")
    arrays: list[Any] = [np.concatenate([getattr(one, name) for one in frames]) for name in names]
    together = matcher.match(FilteredFrames(*arrays, SENSOR))
    alone = [matcher.match(one)[0] for one in frames]
    assert [match.accepted for match in together] == [match.accepted for match in alone]
    assert [match.class_name for match in together] == [match.class_name for match in alone]
    for match, expected in zip(together, alone, strict=True):  # sums over a batch round otherwise
        assert match.distance_m == pytest.approx(expected.distance_m, abs=1e-6)
        assert match.delta_rad == pytest.approx(expected.delta_rad, abs=1e-5)
        assert match.chi2 == pytest.approx(expected.chi2, rel=1e-6)
        assert (match.background is None) == (expected.background is None)
    assert sum(match.accepted for match in together) >= 2


def test_each_candidate_has_the_wall_the_limits_and_the_search_of_its_frame(bank, renderers):
    walls = [Background(wall_m=2.0), Background(wall_m=1.4)]
    image = renderers["cone"].render([0.9, 0.9], background=walls)
    evidence = Evidence.from_frames(kalman_filter(capture(image, SENSOR, rng=np.random.default_rng(2))), "ranges")
    behind = Renderer(None, SENSOR).render([1.0, 1.0], background=walls).phasor.reshape(2, -1)
    frame, class_index = np.array([1, 0, 1]), np.full(3, bank.classes.index("cone"))
    settings = DescentSettings(VIEW[:2], np.ones(256, bool), phasor_behind=behind)
    model = RenderedModel(bank).with_background(*walls)
    problem = Problem(model, evidence, frame, class_index, settings, np.full(3, np.inf))
    np.testing.assert_array_equal(problem.for_candidates(behind), behind[frame])
    farthest = np.array([RenderedModel(bank, wall).limits(np.zeros(1))[1][0] for wall in walls])
    far = np.array([[5.0, 0, 0, 0, 0, 0]])
    np.testing.assert_array_equal(problem.clipped(np.repeat(far, 3, axis=0), np.arange(3))[:, 0], farthest[frame])
    assert problem.some(np.array([1])).clipped(far.copy(), np.arange(1))[0, 0] == farthest[0]

    scenes = Scenes(setup_of(bank, free=VIEW[:2]), workers=1)
    cells = [scenes.cells(background_of(bank, wall)) for wall in walls]
    search = scenes.search.before(*cells).of_frames(frame)
    assert [search.cells_of(k) for k in range(3)] == [cells[k] for k in frame]
    found = search.starts(evidence.seen[frame], np.full(3, 300.0))
    for k, own in enumerate(frame):
        alone = scenes.search.before(cells[own]).starts(evidence.seen[np.array([own])], np.full(1, 300.0))
        np.testing.assert_array_equal(found.view[found.frame == k], alone.view)


def test_fewer_frames_are_matched_together_where_images_are_large(bank, renderers, monkeypatch):
    frames = noisy_frames(
        renderers["cone"],
        SENSOR,
        Views.broadcast([0.9, 1.0, 1.1, 1.2, 1.3], 0.5),
        TrialSetup(),
        np.random.default_rng(3),
    )
    matcher = LikelihoodMatcher(setup_of(bank, free=VIEW[:2]), workers=1)
    expected, sizes, match = matcher.match(frames), [], matcher._match_stated
    monkeypatch.setattr(matcher, "_match_stated", lambda part: sizes.append(len(part)) or match(part))
    monkeypatch.setattr("phasemark.matcher.likelihood.likelihood_matcher._PIXELS_AT_ONCE", 2 * 256 * 2**2 + 1)
    found = matcher.match(frames)
    assert sizes == [2, 2, 1]
    assert [match.distance_m for match in found] == pytest.approx([match.distance_m for match in expected], abs=1e-9)


def test_a_wall_that_leaves_no_room_for_a_landmark_is_not_taken(bank, renderers, monkeypatch):
    """Frames with damaged pixels led the fit there: the view then lay inside the landmark."""

    def too_near(model, evidence, class_index, view, free, background):
        return replace(background, wall_m=0.2), view

    monkeypatch.setattr("phasemark.matcher.likelihood.auto_background.fit_background", too_near)
    view, setup = Views.broadcast(0.9, 0.5), TrialSetup(background=Background(wall_m=3.0, floor_m=0.25))
    frames = noisy_frames(renderers["cone"], SENSOR, view, setup, np.random.default_rng(6))
    match = Matcher(bank, "refine", free=VIEW[:2], background="auto").match(frames)[0]
    assert match.background.wall_m == pytest.approx(3.0, abs=0.1)


@pytest.mark.parametrize(
    ("name", "n"), [("cone", 5), *(pytest.param(name, 300, marks=pytest.mark.soak) for name in NAMES[:3])]
)
def test_an_automatic_background_knows_how_well_it_knows_a_view_above_a_floor(matcher_of, renderers, name, n):
    """A floor that cuts the landmark moves its lower edge; wall, floor and view share what the frame tells."""
    setup = TrialSetup(background=Background(wall_m=3.0, floor_m=0.25), nuisances=("wall_m",))
    matcher = matcher_of(free=VIEW[:2], background="auto")
    trials = run_trials(matcher.match, renderers[name], name, setup, n, np.random.default_rng(11))
    wrong = trials.accepted & ((trials.found != name) | (np.abs(trials.error[:, 0]) > 0.03))
    assert not wrong.any()
    assert trials.accepted.mean() > 0.5
    summary = trials.summary()
    z = 3.3 / 1.96  # intervals of 95 % widened to 99.9 %
    for ratio in summary.ratio.values():  # of the bound of a known floor
        assert ratio.value - z * (ratio.high - ratio.value) <= 1.3
    assert summary.nees.value - z * (summary.nees.high - summary.nees.value) <= 1.3
    assert summary.coverage.high >= 0.92


def test_a_height_whose_cost_is_flat_to_one_side_is_not_claimed(tmp_path):
    """Above a floor a bracket's height may be 1.5 mm more at the same cost, and not 0.2 mm less."""
    plates = block((-0.075, -0.045), (-0.13, 0.13), (-0.15, 0.15)), block((-0.06, 0.12), (-0.13, -0.1), (-0.15, 0.15))
    foot = block((-0.06, 0.06), (-0.1, 0.1), (-0.15, -0.12))
    trimesh.boolean.union([*plates, foot], engine="manifold").export(tmp_path / "bracket.stl")
    mesh = MeshPlan(name="bracket", path=str(tmp_path / "bracket.stl"), unit="m")
    plan = BankPlan(meshes=(mesh,), distance_m="1.0:1.3:0.05", delta_deg="240:300:6", layout="full")
    truth, floor, rng = np.array([1.1621, 4.68995, 0.0112, 0.00016]), Background(floor_m=0.25), np.random.default_rng(0)
    with build_bank(plan, workers=1) as bank:
        matcher = Matcher(bank, "refine", free=VIEW[:4], background=floor, height_std_m=0.02, workers=1)
        image = Renderer(bank.mesh("bracket"), bank.sensor, albedo=0.8).render(*truth, background=floor)
        matches = [matcher.match(kalman_filter(capture(image, SENSOR, rng=rng, n_frames=20)))[0] for _ in range(8)]
    for match in matches:
        assert match.accepted
        error = np.array([getattr(match, name) for name in VIEW[:4]]) - truth
        assert error @ np.linalg.solve(match.covariance, error) < stats.chi2.isf(1e-3, 4)


def test_an_estimated_floor_leaves_height_and_pitch_less_certain(bank_of_two, renderers):
    """Joint information of view, wall and floor, by differences of images."""
    free, prior = ("distance_m", "delta_rad", "height_m", "pitch_rad"), (math.inf, math.inf, 0.02, 0.03)
    truth, cone = Background(wall_m=2.6, floor_m=0.2), renderers["cone"]
    image = cone.render(1.0, 0.5, 0.0, 0.01, pitch_rad=0.01, background=truth)
    frames = kalman_filter(capture(image, SENSOR, rng=np.random.default_rng(3), n_frames=20))
    matcher = Matcher(
        bank_of_two, "refine", free=free, background="auto", height_std_m=prior[2], pitch_std_rad=prior[3]
    )
    (match,) = matcher.match(frames)
    assert match.accepted
    at = np.array([*(getattr(match, name) for name in free), match.background.wall_m, match.background.floor_m])

    def ranges(at):
        behind = replace(match.background, wall_m=at[4], floor_m=at[5])
        image = cone.render(at[0], at[1], 0.0, at[2], pitch_rad=at[3], background=behind)
        return SENSOR.metres_per_radian * np.angle(image.phasor[0]).ravel()

    step = 3e-4
    rows = np.array([(ranges(at + own) - ranges(at - own)) / (2 * step) for own in step * np.eye(6)])
    weight = np.where(frames.state[0] == PixelState.RETURN, frames.std_m[0] ** -2.0, 0.0).ravel()
    information = (rows * weight) @ rows.T
    information[range(4), range(4)] += np.array(prior) ** -2.0
    joint, alone = (
        np.sqrt(np.diag(np.linalg.inv(information)))[:4],
        np.sqrt(np.diag(np.linalg.inv(information[:4, :4]))),
    )
    assert joint[2] > 1.5 * alone[2]
    std = np.sqrt(np.diag(match.covariance))
    np.testing.assert_allclose(std[2:], joint[2:], rtol=0.25)


@pytest.mark.parametrize(
    ("name", "free", "n"),
    [
        *((name, VIEW[:2], 20) for name in STRANGERS),
        ("cube", None, 2),
        *(pytest.param(name, None, 3, marks=pytest.mark.soak) for name in STRANGERS if name != "cube"),
    ],
)
def test_a_stranger_on_the_same_box_is_refused(matcher_of, name, free, n):
    rng = np.random.default_rng(8)
    renderer = Renderer(strangers()[name], SENSOR, albedo=0.8)
    views = Views.broadcast(rng.uniform(0.8, 1.2, n), rng.uniform(0, np.pi, n))
    matcher = matcher_of(free=free)
    images = renderer.render_views(views)
    noncentrality = matcher.match(noise_free(images, 50)).chi2  # after refitting the view, of the nearest class
    far = noncentrality >= 150
    assert far.mean() > 0.95
    matches = matcher.match(kalman_filter(capture(images, SENSOR, rng=rng, n_frames=50)))
    assert not matches.accepted[far].any()
    assert (matches.class_probability["none"][far] > 0.99).all()


@pytest.mark.parametrize(
    ("scene", "background"),
    [
        *(("empty", background) for background in (None, "auto", "known")), ("wall", "auto"), ("wall", "known"),
        pytest.param("wall", None, marks=pytest.mark.soak),
    ],
)  # fmt: skip
def test_a_scene_without_a_landmark_is_none(bank_of_two, background, scene):
    behind = Background(wall_m=3.0) if scene == "wall" else None
    image = Renderer(None, SENSOR).render(1.0, background=behind)
    frames = kalman_filter(capture(image, SENSOR, rng=np.random.default_rng(9), n_frames=50))
    matcher = Matcher(bank_of_two, "refine", background=behind if background == "known" else background)
    matches = matcher.match(frames)
    assert not matches.accepted.any()
    if background is not None or scene == "empty":
        assert all(name is None for name in matches.class_name)


def test_a_hidden_column_is_refused_and_robust_residuals_place_the_rest(matcher_of, renderers):
    rng, n = np.random.default_rng(12), 25
    views = Views.broadcast(rng.uniform(0.8, 1.2, n), rng.uniform(0, np.pi, n))
    image = renderers["cone"].render_views(views)
    near = views.distance_m[:, None] - 0.4
    image.phasor[:, :, 6] = 0.8 / near**2 * np.exp(1j * near / SENSOR.metres_per_radian)
    image.intensity[:, :, 6] = 0.8 / near**2
    frames = kalman_filter(capture(image, SENSOR, rng=rng, n_frames=50))
    assert not matcher_of(free=VIEW[:2]).match(frames).accepted.any()
    matches = matcher_of(free=VIEW[:2], robust=True).match(frames)
    assert (matches.class_name == "cone").mean() >= 0.9
    assert not matches.accepted.any()
    # a fifteenth of the pixels is lost: the errors are those of the whole frame, 0.3 mm at 1 m
    assert np.median(np.abs(matches.distance_m - views.distance_m)) < 0.5e-3


def test_a_camera_with_unknown_offsets_still_gets_class_and_view_but_is_not_accepted(matcher_of, renderers):
    rng, n = np.random.default_rng(13), 25
    views = Views.broadcast(rng.uniform(0.8, 1.2, n), rng.uniform(0, np.pi, n))
    frames = kalman_filter(capture(renderers["cone"].render_views(views), SENSOR, rng=rng, n_frames=50))
    off = frames.range_m + rng.normal(0, 0.02, (16, 16))  # seven times what noise leaves in a pixel
    matches = matcher_of(free=VIEW[:2]).match(replace(frames, range_m=off))
    assert (matches.class_name == "cone").mean() >= 0.9
    assert not matches.accepted.any()
    assert np.median(np.abs(matches.distance_m - views.distance_m)) < 10e-3


@pytest.mark.parametrize("method", ["nearest", "refine"])
def test_the_range_offset_of_a_sensor_is_taken_off(bank, method):
    # 5 cm, seventeen times the noise of a pixel: a wrong sign would put the landmark 10 cm off
    late = SENSOR.with_(range_offset_m=0.05)
    image = Renderer(build_mesh(catalog()["cone"]), late, albedo=0.8).render(1.0, 0.6)
    frames = kalman_filter(capture(image, late, rng=np.random.default_rng(3), n_frames=50))
    assert np.nanmin(frames.range_m) > np.nanmin(image.range_m) + 0.04
    match = Matcher(bank, method).match(frames)[0]
    assert match.accepted
    assert abs(match.distance_m - 1.0) < 0.01 if method == "nearest" else abs(match.distance_m - 1.0) < 2e-3


@pytest.mark.parametrize("on", ["ranges", "phasors"])
def test_rendering_only_the_rows_that_turn_gives_the_whole_image(bank, on):
    dim = Renderer(build_mesh(catalog()["cone"]), SENSOR, albedo=0.5)
    frames = noisy_frames(
        dim, SENSOR, Views.broadcast(1.0, [0.6, 1.1]), TrialSetup(on=on, background=WALL), np.random.default_rng(4)
    )
    behind = Renderer(None, SENSOR).render(1.0, background=WALL).phasor.reshape(-1)
    settings = DescentSettings(VIEW[:2], np.ones(256, bool), phasor_behind=behind[None])
    cone, evidence = np.full(2, bank.classes.index("cone")), Evidence.from_frames(frames, on)
    problem = Problem(RenderedModel(bank, WALL), evidence, np.arange(2), cone, settings, np.full(2, np.inf))
    state = problem.start(np.array([[1.0, 0.6, 0, 0, 0, 0], [1.0, 1.1, 0, 0, 0, 0]]))
    theta = state.theta.copy()
    theta[:, 1] += 0.01
    if on == "phasors":
        assert (np.abs(theta[:, 6] - 0.5 / 0.8) < 0.02).all()  # the factor on the bank's albedo was found
    turned, anew = problem.turned(state, np.arange(2), theta), problem.state(theta, state.use)
    # the facets of a solid of revolution turn too: within the renderer's budget of 1e-4
    for name in ("phasor", "intensity", "coverage"):
        new, whole = getattr(turned.images, name), getattr(anew.images, name)
        assert np.abs(new - whole).max() <= 1e-4 * np.abs(whole).max()
    np.testing.assert_allclose(turned.sums.cost, anew.sums.cost, rtol=1e-2)


def test_lower_pixels_alone_can_give_the_view(matcher_of, renderers):
    frames = noisy_frames(renderers["cone"], SENSOR, Views.broadcast(1.0, 0.8), TrialSetup(), np.random.default_rng(10))
    lower = matcher_of(pixels="lower").match(frames)[0]
    both = matcher_of().match(frames)[0]
    assert lower.class_name == "cone"
    assert lower.covariance[0, 0] > 1.1 * both.covariance[0, 0]


def test_a_match_tells_weights_condition_and_weak_direction(matcher_of, renderers):
    image = renderers["cylinder"].render(1.3, 0.5)
    match = matcher_of().match(noise_free(image, 50))[0]
    assert sum(match.class_probability.values()) == pytest.approx(1)
    assert match.class_probability["cylinder"] > 0.99
    assert {other.class_name for other in match.alternatives} >= {"cone", "sphere", "post"}
    assert all(other.cost >= match.chi2 for other in match.alternatives)
    assert match.condition_number > 1
    weak = np.array([match.weak_direction[name] for name in match.free])
    # along the worst axis a standard deviation is as long as the covariance has it
    assert weak @ np.linalg.solve(match.covariance, weak) == pytest.approx(1, rel=1e-6)
    json.dumps(match.as_dict(), allow_nan=False)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"free": ("distance_m", "yaw")}, "'free' must be among"),
        ({"free": ("distance_m",)}, "must name distance_m and delta_rad"),
        ({"on": "volts"}, "'on' must be 'ranges' or 'phasors' or .*, got 'volts'$"),
        ({"on": np.ones((16, 16))}, "'on' must be 'ranges' or 'phasors' or .*, got ndarray$"),
        ({"pixels": "upper"}, "'pixels' must be 'all' or 'lower', got 'upper'$"),
        ({"pixels": np.ones((16, 16), bool)}, "'pixels' must be 'all' or 'lower', got ndarray$"),
        ({"background": "wall"}, "'background' must be a Background, None, 'auto' or 'unknown' or 'any', got 'wall'$"),
        ({"background": np.ones((16, 16))}, "'background' must be a Background, None, .* got ndarray$"),
        ({"background": 4.0}, "'background' must be a Background, None, .* got float$"),
        ({"method": np.ones(2)}, "'method' must be 'nearest' or 'refine', got ndarray$"),
    ],
)
@pytest.mark.parametrize("method", ["refine", "nearest"])
def test_wrong_options_are_refused_in_one_line(bank, options, message, method):
    if method == "nearest" and "free" in options:
        message = "belong to method 'refine'"
    with pytest.raises(UsageError, match=message) as error:
        Matcher(bank, **{"method": method, **options})
    assert "\n" not in str(error.value)


def test_phasors_of_frames_without_amplitude_are_refused(matcher_of):
    with pytest.raises(UsageError, match="needs frames with amplitude"):
        matcher_of(on="phasors").match(kalman_filter(Frames(np.ones((2, 16, 16)), sensor=SENSOR)))


@given(**DAMAGE)
@settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_frames_get_an_answer_and_never_a_view_that_is_not_a_number(two_matchers, renderers, **damage):
    check_damaged(two_matchers, renderers["post"], **damage)
