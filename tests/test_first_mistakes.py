"""What a first script gets wrong is answered in words, and what it prints is one line."""

import copy
import math
import pickle
import pydoc
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import pytest
from test_sweep_tables import linear_sweep

import phasemark
from phasemark import UsageError
from phasemark.data import BankPlan, build_bank, build_frames, read_frames
from phasemark.data.export import export_frames
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher, SearchPolicy, cramer_rao, kalman_filter
from phasemark.matcher.diagnosis.diagnose import Diagnosis
from phasemark.matcher.sweep import run_sweep
from phasemark.render import Frames, Renderer, Views, capture, preset
from phasemark.render.direct import HistogramRenderer

SENSOR = preset("pmd-16x16")
NAME: Any = "pmd-16x16"


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    plan = BankPlan(classes=("cone",), distance_m="0.9:1.1:0.02", delta_deg="0:180:2")
    with build_bank(plan, tmp_path_factory.mktemp("bank") / "bank.h5") as built:
        yield built


@pytest.fixture(scope="module")
def renderer():
    return Renderer(build_mesh(catalog()["cone"]), SENSOR)


@pytest.fixture(scope="module")
def frames(renderer):
    return capture(renderer.render(1.0, 0.5), SENSOR, rng=np.random.default_rng(0), n_frames=50)


def test_a_landmark_that_is_not_in_the_catalogue_is_answered_with_those_that_are():
    with pytest.raises(UsageError, match="no landmark 'cyl': cylinder, cone, sphere, post"):
        catalog()["cyl"]
    assert catalog().get("cyl") is None
    assert "cyl" not in catalog()


def test_a_specification_is_no_mesh():
    cone: Any = catalog()["cone"]
    with pytest.raises(UsageError, match="'mesh' must be a mesh, got LandmarkSpec: build_mesh makes one"):
        Renderer(cone, SENSOR)


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (Renderer, (None, "pmd-16x16"), "'sensor' must be a Sensor, got str: preset gives one by its name"),
        (Matcher, ("bank.h5",), "'bank' must be a bank, got str: open_bank opens a file"),
        (Views, ([1, 2], [0.1], [0], [0]), r"views need one array of n values each, got .* \(2,\), .* \(1,\)"),
        (Views, (1.0, 0.1, 0.0, 0.0), r"views need one array of n values each, got distance_m \(\)"),
        (HistogramRenderer, (None, "vl53l5cx-8x8"), "'sensor' must be a Sensor, got str"),
        (partial(Frames, sensor=NAME), (np.ones((16, 16)),), "'sensor' must be a Sensor, got str"),
        (partial(read_frames, sensor=NAME), ("frames.npz",), "'sensor' must be a Sensor, got str"),
        (build_mesh, ("cone",), r"'spec' must be a LandmarkSpec, got str: catalog\(\)\['cone'\] is one"),
    ],
)
def test_a_name_or_a_list_in_place_of_what_it_stands_for_is_answered_in_words(function: Any, arguments, message):
    with pytest.raises(UsageError, match=message):
        function(*arguments)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: cramer_rao(Renderer(None, SENSOR), NAME),
            "'views' must be Views, got str: Views.broadcast makes them",
        ),
        (lambda: build_frames(NAME, "frames.h5"), "'plan' must be a FramePlan or a SceneFramesPlan, got 'pmd-16x16'"),
        (lambda: export_frames(NAME, "frames.csv", "csv"), "'frames' must be a frame set, got str: open_frames opens"),
        (lambda: run_sweep(NAME, "folder"), "'plan' must be a SweepPlan, got str"),
    ],
)
def test_a_name_in_place_of_a_plan_or_a_set_is_answered_in_words(call, message):
    with pytest.raises(UsageError, match=message):
        call()


@pytest.mark.parametrize("on", ["range", "reported", None])
def test_a_bound_is_of_ranges_or_phasors(renderer, on: Any):
    with pytest.raises(UsageError, match="'on' must be 'ranges' or 'phasors', got"):
        cramer_rao(renderer, Views.broadcast(1.0), on=on)


@pytest.mark.parametrize("pixels", [5, np.ones((4, 4), np.bool_), np.ones((16, 16))])
def test_pixels_are_named_or_a_mask_of_the_sensor(renderer, pixels: Any):
    with pytest.raises(UsageError, match="'pixels' must be all, lower or booleans of 16 × 16 pixels, got"):
        cramer_rao(renderer, Views.broadcast(1.0), pixels=pixels)


@pytest.mark.parametrize(("distance_m", "message"), [(-1.0, "must be positive, got -1"), (math.nan, "must be finite")])
def test_views_that_no_camera_has_are_not_rendered(renderer, distance_m, message):
    views = Views(np.array([1.0, distance_m]), *np.zeros((3, 2)))
    for render in (renderer.render_views, HistogramRenderer(None, preset("vl53l5cx-8x8")).render_views):
        with pytest.raises(UsageError, match=f"'distance_m' {message}"):
            render(views)


@pytest.mark.parametrize("albedo", [80, -1, math.nan])
def test_an_albedo_is_a_share(renderer, albedo):
    for one in (renderer, HistogramRenderer(None, preset("vl53l5cx-8x8"))):
        with pytest.raises(UsageError, match=r"'albedo' must be in \(0, 1\], got"):
            one.with_albedo(albedo)


@pytest.mark.parametrize(("options", "message"), [({"robust": "no"}, "True or False"), ({"workers": 0}, "at least 1")])
def test_switches_and_threads_of_a_matcher_are_what_they_say(bank, options, message):
    with pytest.raises(UsageError, match=f"must be {message}"):
        Matcher(bank, **options)


def test_a_seed_is_no_generator(renderer):
    seed: Any = 1
    with pytest.raises(UsageError, match=r"'rng' must be a numpy.random.Generator, as .* got 1$"):
        capture(renderer.render(1.0), SENSOR, rng=seed)


@pytest.mark.parametrize("n_frames", [0, -3, np.array([[[np.nan]]])])
def test_a_bound_is_of_frames(renderer, n_frames):
    with pytest.raises(UsageError, match="'n_frames' must be at least 1, got"):
        cramer_rao(renderer, Views.broadcast(1.0), n_frames=n_frames)


def test_views_of_lists_are_those_of_arrays(renderer):
    lists: Any = [1, 1.2], [0.1, 0], [0, 0], [0, 0]
    expected = renderer.render([1.0, 1.2], [0.1, 0.0])
    assert np.array_equal(renderer.render_views(Views(*lists)).phasor, expected.phasor)


def test_a_bank_is_built_from_the_fields_of_its_plan_by_name(bank):
    plan = {"classes": ["cone"], "distance_m": "0.9:1.1:0.02", "delta_deg": "0:180:2"}
    with phasemark.build_bank(plan) as built:
        assert built.identity() == bank.identity()
    with pytest.raises(UsageError, match="unknown key 'distance'"):
        build_bank({"distance": 1.0})
    path: Any = "bank.h5"
    with pytest.raises(UsageError, match=r"'plan' must be a BankPlan or its fields by name, got 'bank.h5'"):
        build_bank(path)


@pytest.mark.parametrize("background", [4.0, [4.0], {"wall_m": 4.0}])
def test_a_background_is_a_background(renderer, background):
    with pytest.raises(UsageError, match=r"'background' must be a Background, as Background\(wall_m=4.0\)"):
        renderer.render(1.0, background=background)


def test_frames_are_filtered_before_they_are_matched(bank, frames):
    with pytest.raises(UsageError, match=r"kalman_filter\(frames\)"):
        Matcher(bank, "refine").match(frames)


@pytest.mark.parametrize(
    "options", [{"bearing_std_rad": 1.5}, {"pitch_std_rad": 3.0}, {"roll_std_rad": 3}, {"tolerance_rad": 6}]
)
def test_degrees_where_radians_are_meant_are_refused(bank, options):
    (name,) = options
    with pytest.raises(UsageError, match=rf"'{name}' is an angle in radians, .* use math.radians of degrees"):
        Matcher(bank, "refine", **options)
    in_radians: dict[str, Any] = {name: math.radians(options[name])}
    Matcher(bank, "refine", **in_radians)


def test_what_is_printed_is_one_line_of_what_it_is(bank, renderer, frames):
    filtered = kalman_filter(frames)
    matches = Matcher(bank, "refine").match(filtered)
    assert repr(frames) == f"Frames(1 positions × 50 frames, {SENSOR!r})"
    assert repr(filtered) == f"FilteredFrames(1 positions, {SENSOR!r})"
    assert repr(renderer.render([1.0, 1.1])) == f"PhasorImages(2 views, {SENSOR!r})"
    assert repr(matches) == "Matches(1 answers, 1 accepted)"
    match = matches[0]
    std = np.sqrt(np.diag(match.covariance))
    assert repr(match) == (
        f"Match(cone, accepted: distance {match.distance_m:.5g} ± {std[0]:.2g} m,"
        f" delta {math.degrees(match.delta_rad):.5g} ± {math.degrees(std[1]):.2g}°,"
        f" bearing {math.degrees(match.bearing_rad):.5g} ± {math.degrees(std[2]):.2g}°, p = {match.p_value:.2g})"
    )
    empty = Matcher(bank, "refine").match(
        kalman_filter(capture(Renderer(None, SENSOR).render(1.0), SENSOR, rng=np.random.default_rng(1)))
    )
    assert repr(empty[0]) == "Match(refused: no landmark)"
    views = Views.broadcast([1.0, 1.0, 1.0], 0.5)
    bound = cramer_rao(renderer, views)
    std_m, std_deg = bound.std("distance_m")[0], math.degrees(bound.std("delta_rad")[0])
    assert repr(bound) == f"Bound(3 views: standard deviation of distance {std_m:.2g} m, delta {std_deg:.2g}°)"
    diagnosis = Diagnosis(4, empty[0], n_returned=2)
    assert repr(diagnosis) == f"Diagnosis({diagnosis})"
    trials = linear_sweep(10, np.random.default_rng(1))
    assert repr(trials) == "SweepTrials(10 trials of 1 conditions, least squares)"


@pytest.mark.parametrize("again", [lambda one: pickle.loads(pickle.dumps(one)), copy.deepcopy])
def test_renderers_banks_and_matchers_are_copied_and_pickled(bank, renderer, frames, again):
    np.testing.assert_array_equal(again(renderer).render(1.0, 0.5).phasor, renderer.render(1.0, 0.5).phasor)
    with again(bank) as opened:
        np.testing.assert_array_equal(opened.image("cone", 3, 7).phasor, bank.image("cone", 3, 7).phasor)
    matcher, filtered = (
        Matcher(bank, "refine", free=("distance_m", "delta_rad"), tolerance_m=0.02),
        kalman_filter(frames),
    )
    assert again(matcher).options == matcher.options
    assert again(matcher).match(filtered)[0].as_dict() == matcher.match(filtered)[0].as_dict()


def test_help_on_the_matcher_begins_with_its_use_and_names_no_tuning_number():
    text = pydoc.plain(pydoc.render_doc(Matcher))
    use = 'Matcher(bank, "refine", background="auto").match(kalman_filter(frames))'
    assert text.index(use) < text.index("Parameters")
    assert "policy: 'SearchPolicy | None' = None" in text
    assert [one.name for one in fields(SearchPolicy) if one.name in text] == []
    assert repr(SearchPolicy(max_iterations=40)) == "SearchPolicy(max_iterations=40)"
