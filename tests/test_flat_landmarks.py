"""Landmarks that may be seen from within the circle around them: a wall or a wide panel, and views tilted before it."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy import stats

from phasemark import UsageError
from phasemark.data import BankPlan, build_bank
from phasemark.data.plans.bank_plan import MeshPlan
from phasemark.matcher import Matcher, kalman_filter
from phasemark.matcher.likelihood.rendered_images import RenderedModel
from phasemark.render import Background, Frames, Renderer, Views, capture, preset
from phasemark.render.view import Footprint

TOF = preset("vl53l5cx-8x8")
THICK_M, WIDE_M = 0.01, 4.0
DEGREE = math.radians(1.0)


def slab():
    return trimesh.creation.box((THICK_M, WIDE_M, WIDE_M))


def plan_of(folder, **more):
    slab().export(folder / "wide.stl")
    mesh = MeshPlan(name="wide", path=str(folder / "wide.stl"), unit="m", origin="center", symmetry=2)
    return BankPlan(meshes=(mesh,), sensor="vl53l5cx-8x8", layout="full", **more)


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flat")
    with build_bank(plan_of(folder, distance_m="0.45:0.85:0.05", delta_deg="-40:40:5"), folder / "wide.h5") as built:
        yield built


def swaying(rng, n):
    """Return views of a panel 0.5 to 0.7 m away, pitched and rolled by up to 8°, and a frame of ranges of each."""
    delta, tilt = rng.uniform(-30, 30, n) * DEGREE, rng.uniform(-8, 8, (2, n)) * DEGREE
    views = Views.broadcast(rng.uniform(0.5, 0.7, n) / np.cos(delta), delta, 0.0, 0.0, *tilt)
    frames = capture(Renderer(slab(), TOF).render_views(views), TOF, rng=rng, n_frames=1)
    return views, kalman_filter(Frames(frames.range_m, flags=frames.flags, sensor=TOF)), tilt.T


def scaled_errors(matches, views):
    error = np.column_stack([getattr(matches, name) - getattr(views, name) for name in matches.free])
    error[:, 1] -= math.pi * np.round(error[:, 1] / math.pi)
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(matches.covariance), error)


@pytest.mark.parametrize("mounted", [(0.0, 0.0), (3.0, -2.0)])
def test_ranges_of_a_plane_within_its_circle_are_those_of_the_closed_form(mounted):
    """The ray d from (−D cos δ, −D sin δ) meets x' = −t/2 after (D cos δ − t/2) / (cos δ d_x − sin δ d_y)."""
    sensor = preset("pmd-16x16").with_(pitch_deg=mounted[0], roll_deg=mounted[1])
    distance, delta, pitch, roll = np.array([[0.4, -0.9, 0.1, -0.12], [0.7, 0.5, -0.14, 0.1], [1.5, 0.0, 0.0, 0.14]]).T
    views = Views.broadcast(distance, delta, 0.0, 0.0, pitch, roll)
    image = Renderer(slab(), sensor).render_views(views)
    v, u = np.mgrid[:16, :16] + 0.5
    ray = np.einsum("nij,rcj->nrci", views.tilt2level(), sensor.ray_directions(u, v))
    c, s, away = (part[:, None, None] for part in (np.cos(delta), np.sin(delta), distance * np.cos(delta)))
    expected = (away - THICK_M / 2) / (c * ray[..., 0] - s * ray[..., 1])
    # a pixel of 1.4° shows its mean phasor: at a slant of 60° half a millimetre from the range of its centre
    np.testing.assert_allclose(image.range_m, expected, rtol=1e-3)


def test_the_lens_keeps_clear_of_the_box_or_of_the_circle_whichever_is_nearer():
    flat = Footprint.of_vertices(slab().vertices)
    delta = np.array([0.0, 60.0, 180.0, 90.0]) * DEGREE
    half, gap = THICK_M / 2, 1e-3
    np.testing.assert_allclose(
        flat.nearest_m(delta, gap), [half + gap, 2 * (half + gap), half + gap, WIDE_M / 2 + gap], rtol=1e-9
    )
    np.testing.assert_allclose(flat.reach_m(delta[[0, 3]]), [half, WIDE_M / 2], rtol=1e-9)
    post = Footprint.of_vertices(trimesh.creation.cylinder(0.1, 1.0, sections=256).vertices)
    np.testing.assert_allclose(post.nearest_m(np.array([0.0, 45.0]) * DEGREE, 0.0), 0.1, rtol=1e-3)
    aside = Footprint(np.array([0.3, -0.1]), np.array([0.5, 0.1]), math.hypot(0.5, 0.1), 0.0, np.zeros((0, 3)))
    np.testing.assert_allclose(aside.nearest_m(np.array([0.0, 180.0]) * DEGREE, gap), [gap, 0.5 + gap], rtol=1e-9)


def test_a_bank_with_views_from_within_the_body_is_refused_in_one_line(tmp_path):
    with pytest.raises(UsageError, match=r"inside the landmark's .*'distance_m' must be above 2 at this 'delta_rad'$"):
        build_bank(plan_of(tmp_path, distance_m="0.4:0.6:0.1", delta_deg="0:90:45"), tmp_path / "wide.h5")


def test_a_coarse_bank_of_a_calibrated_sensor_has_a_scout(tmp_path):
    offsets = tuple(tuple(1e-3 * (row - col) for col in range(8)) for row in range(8))
    own = {"zone_offset_m": offsets}
    plan = plan_of(tmp_path, distance_m="0.5:0.7:0.1", delta_deg="-20:20:10", sensor_overrides=own)
    with build_bank(plan, tmp_path / "wide.h5") as built:
        level = capture(Renderer(slab(), TOF).render(0.6, 0.1), TOF, rng=np.random.default_rng(7), n_frames=1)
        shifted = Frames(level.range_m + np.array(offsets), sensor=built.sensor)
        match = Matcher(built, "refine", background="unknown").match(kalman_filter(shifted))[0]
    assert match.accepted
    assert abs(match.distance_m - 0.6) < 0.005


def test_views_edge_on_leave_room_for_the_lens_and_move_a_wall_back(bank):
    model = RenderedModel(bank, Background(wall_m=2.0))
    view = np.array([[0.6, 0.3, 0, 0, 0, 0], [5.0, math.pi / 2, 0, 0, 0, 0]])
    model.clip(view, np.arange(2))
    np.testing.assert_allclose(view[:, 0], [0.6, WIDE_M / 2 + 5e-3])
    images = model.images(np.zeros(2, np.int64), view, ())
    assert np.isfinite(images.phasor).all()
    # turned where it stands, its far end reaches the wall: a search tries that
    before = np.array([[0.0, 0.3, 0, 0, 0, 0]])
    before[:, 0] = model.limits(before[:, 1])[1]
    image = model.images(np.zeros(1, np.int64), before, ())
    turned = model.turned(np.zeros(1, np.int64), before + np.array([0, 0.05, 0, 0, 0, 0]), image)
    assert np.isfinite(turned.phasor).all()


def test_tilts_before_a_wide_panel_are_known_or_free_with_a_coarse_bank(bank):
    n = 12
    views, frames, tilt = swaying(np.random.default_rng(3), n)
    options: dict[str, Any] = {"free": ("distance_m", "delta_rad"), "background": "unknown"}
    exact = Matcher(bank, "refine", **options).match(replace(frames, tilt_rad=tilt))
    assert exact.accepted.all()
    assert scaled_errors(exact, views).sum() < stats.chi2.ppf(1 - 1e-3, 2 * n)
    ignored = Matcher(bank, "refine", **options).match(frames)
    assert ignored.accepted.mean() < 0.25  # those that are hardly tilted
    wrong = replace(frames, tilt_rad=np.full((n, 2), -0.3))
    assert not Matcher(bank, "refine", **options).match(wrong).accepted.any()
    std = 0.5 * DEGREE
    off = tilt + std * np.random.default_rng(4).standard_normal((n, 2))
    options |= {"free": ("distance_m", "delta_rad", "pitch_rad", "roll_rad"), "pitch_std_rad": std, "roll_std_rad": std}
    free = Matcher(bank, "refine", **options).match(replace(frames, tilt_rad=off))
    assert free.accepted.all()
    assert scaled_errors(free, views).sum() < stats.chi2.ppf(1 - 1e-3, 4 * n)


def test_95_percent_ellipses_before_a_wide_panel_hold_the_truth_in_92_to_98_percent_of_200_tilted_frames(bank):
    views, frames, tilt = swaying(np.random.default_rng(5), 200)
    matches = Matcher(bank, "refine", free=("distance_m", "delta_rad"), background="unknown").match(
        replace(frames, tilt_rad=tilt)
    )
    accepted = matches.accepted
    inside = (scaled_errors(matches, views) < stats.chi2.ppf(0.95, 2))[accepted]
    print(f"wide panel, tilts known: {accepted.sum()} of 200 accepted, {inside.sum()} within 95 %")
    assert accepted.sum() >= 190
    assert 0.92 <= inside.mean() <= 0.98 + 0.01
