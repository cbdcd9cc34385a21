"""Phasors change smoothly with the view: windows of tiny steps, and difference quotients."""

import math

import numpy as np
import pytest
import trimesh
from oracles.smoothness import (
    PARAMETERS,
    Outline,
    difference_quotients,
    measure_windows,
    random_views,
)

from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Renderer, Views, preset

PMD = preset("pmd-16x16")
TAN = math.tan(math.radians(11))
BAR = 1e-6
"""Largest deviation from a quadratic over 1e-5 m or rad, as a share of the brightest pixel."""
ROUGH_SHARE = 0.1
"""Share of the windows that may miss the bar: where the limb of a sphere gains a facet, a rule changes its nodes."""
ROUGHEST = 2e-5
"""Largest deviation in any window, for that reason."""


@pytest.fixture(scope="module")
def scenes():
    meshes = {name: build_mesh(spec) for name, spec in catalog().items()}
    return {name: (Renderer(mesh, PMD), Outline(mesh, PMD)) for name, mesh in meshes.items()}


def one_view(distance, delta=0.0, bearing=0.0, height=0.0):
    return Views(*(np.array([value]) for value in (distance, delta, bearing, height)))


def box_with_corner_at(u, v):
    """Return a box whose face x' = 0, 1 m before the lens, has its upper left corner at (u, v)."""
    left, top = TAN * (1 - u / 8), TAN * (1 - v / 8)
    return trimesh.creation.box((0.01, 0.2, 0.2)).apply_translation((0.005, left - 0.1, top - 0.1))


def kink(u, v, parameter):
    mesh = box_with_corner_at(u, v)
    outline, renderer, view = Outline(mesh, PMD), Renderer(mesh, PMD), one_view(1.0)
    return outline.events(view, parameter, 5e-6), measure_windows(renderer, outline, view, parameter)


def test_a_vertex_that_passes_a_border_is_an_event_and_a_kink():
    assert 8 * 5e-6 / TAN == pytest.approx(2.1e-4, abs=1e-5)  # how far the face moves in half a window
    (corners, borders), window = kink(5.0, 4.3, "bearing_rad")
    assert borders > 0
    assert corners > 0  # the box's upright edge passes all corners of the column's border
    assert window.residual[0] > 1e-5  # the slope jumps by all of the edge's light: 2e-4 · ¼ of a pixel
    assert window.crossed[0]


def test_what_stays_inside_its_pixel_is_no_event_and_smooth():
    for u in (4.999, 5.3, 5.001):
        events, window = kink(u, 4.3, "bearing_rad")
        assert events == (0, 0)
        assert window.residual[0] < BAR
        assert not window.crossed[0]


def test_a_vertex_that_slides_along_a_border_does_pass_it_only_if_it_moves_across():
    (corners, borders), _ = kink(5.0, 4.3, "height_m")
    assert corners > 0  # the upright edge lies on the border all the while, which the tolerance counts
    assert borders > 0


def test_only_corners_of_the_solid_are_vertices_not_joints_of_its_tessellation(scenes):
    _, outline = scenes["cylinder"]
    corners = outline.vertices[outline.is_corner]
    expected = {(x, y, z) for x in (-0.12, 0.12) for y in (-0.08, 0.08) for z in (-0.15, 0.0)}
    assert {tuple(corner) for corner in corners.round(9)} == expected


def test_projected_outlines_lie_on_the_border_of_what_is_covered(scenes):
    renderer, outline = scenes["cone"]
    view = one_view(1.1, 0.4, 0.01, 0.02)
    covered = renderer.render_views(view).coverage[0]
    index, _ = outline.shown(view)
    ends = outline.project(view, outline.vertices)[outline.edges[index]]
    share = np.linspace(0, 1, 400)[:, None, None]
    u, v = np.moveaxis(ends[:, 0] + share * (ends[:, 1] - ends[:, 0]), -1, 0)
    crossed = set(zip(np.floor(v).astype(int).flat, np.floor(u).astype(int).flat, strict=True))
    mixed = np.argwhere((covered > 1e-3) & (covered < 1 - 1e-3))
    assert len(mixed) > 20
    assert {(row, col) for row, col in mixed.tolist()} <= crossed


def assert_smooth(scene, views, **background):
    """Check every parameter around some views."""
    renderer, outline = scene
    for parameter in PARAMETERS:
        windows = measure_windows(renderer, outline, views, parameter, **background)
        residual = windows.residual[~windows.crossed]
        assert len(residual) > len(views) / 2
        assert np.mean(residual > BAR) <= ROUGH_SHARE, parameter
        assert np.median(residual) < BAR / 10, parameter
        assert residual.max() < ROUGHEST, parameter


@pytest.mark.parametrize(
    ("seed", "n", "background"),
    [
        (11, 12, None),
        *(pytest.param(77, 200, one, marks=pytest.mark.soak) for one in (None, Background(wall_m=4.0, floor_m=0.21))),
    ],
)
@pytest.mark.parametrize("name", list(catalog()))
def test_phasors_stay_on_a_quadratic_where_no_edge_or_vertex_passes_a_border(scenes, name, seed, n, background):
    assert_smooth(scenes[name], random_views(np.random.default_rng(seed), n), background=background)


# of 95 % that have to agree, 16 or more of 20 do with a probability of 99.7 %; of 400, less two standard deviations
@pytest.mark.parametrize(("seed", "n", "share"), [(12, 20, 0.8), pytest.param(78, 400, 0.93, marks=pytest.mark.soak)])
@pytest.mark.parametrize("name", list(catalog()))
def test_difference_quotients_of_two_steps_agree(scenes, name, seed, n, share):
    views = random_views(np.random.default_rng(seed), n)
    for parameter in PARAMETERS:
        difference = difference_quotients(scenes[name][0], views, parameter)
        assert np.mean(difference <= 0.01) >= share, parameter
