"""Banks that no user means to build: what they match is refused or right, and what is wrong with them is said."""

import math
import warnings

import numpy as np
import pytest
import trimesh

from phasemark.data import BankPlan, build_bank
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import export_mesh
from phasemark.landmarks.mesh_files import MeshWarning
from phasemark.matcher import Matcher, kalman_filter
from phasemark.matcher.nearest.grid import is_in_range
from phasemark.render import Renderer, Views, capture

GRID = {"distance_m": "0.66:1.34:0.02", "delta_deg": "0:360:2"}
FREE = [pytest.param(None, marks=pytest.mark.soak), ("distance_m", "delta_rad")]
HEXAGON = trimesh.creation.cylinder(0.2, 0.5, sections=6)
TRIANGLE = trimesh.creation.cylinder(0.25, 0.5, sections=3)
BOX = trimesh.creation.box((0.3, 0.2, 0.5))


def bank_of(folder, meshes, symmetry=None, **grid):
    parts = []
    for name, mesh in meshes.items():
        path = folder / f"{name}.ply"
        path.write_bytes(export_mesh(mesh, "ply"))
        parts.append(MeshPlan(name=name, path=str(path), unit="m", symmetry=symmetry))
    return build_bank(BankPlan(meshes=tuple(parts), sensor="pmd-16x16", layout="full", **{**GRID, **grid}))


def seen(bank, n=6, turn_rad=2 * math.pi):
    rng = np.random.default_rng(1)
    views = Views.broadcast(rng.uniform(0.7, 1.3, n), rng.uniform(0, turn_rad, n))
    image = Renderer(bank.mesh(bank.classes[0]), bank.sensor, albedo=0.8).render_views(views)
    return views, kalman_filter(capture(image, bank.sensor, rng=rng, n_frames=10))


def right(matches, views, symmetry):
    turn = [math.remainder(off, 2 * math.pi / symmetry) for off in matches.delta_rad - views.delta_rad]
    return (np.abs(matches.distance_m - views.distance_m) < 0.03) & (np.abs(turn) < math.radians(6))


@pytest.mark.parametrize("free", FREE, ids=["default", "fixed"])
def test_of_two_classes_of_one_shape_none_is_accepted(tmp_path, free):
    with pytest.warns(MeshWarning, match="'one' and 'two' look alike from everywhere, .* leave one out"):
        bank = bank_of(tmp_path, {"one": BOX, "two": BOX})
    with bank:
        matches = Matcher(bank, "refine", free=free).match(seen(bank)[1])
    assert set(matches.reason) == {"ambiguous"}


def test_classes_of_other_shapes_are_not_doubted(tmp_path):
    turned = BOX.copy().apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, (0, 0, 1)))
    with warnings.catch_warnings():
        warnings.simplefilter("error", MeshWarning)
        bank_of(
            tmp_path, {"hexagon": HEXAGON, "box": BOX, "turned": turned}, distance_m="1", delta_deg="0:360:90"
        ).close()


@pytest.mark.parametrize("free", FREE, ids=["default", "fixed"])
def test_a_symmetry_that_was_not_stated_makes_every_view_ambiguous(tmp_path, free):
    with pytest.warns(MeshWarning, match="turned by 60° it is the same"):
        bank = bank_of(tmp_path, {"hexagon": HEXAGON}, symmetry=1)
    with bank:
        matches = Matcher(bank, "refine", free=free).match(seen(bank)[1])
    assert set(matches.reason) == {"ambiguous"}


@pytest.mark.parametrize("free", FREE, ids=["default", "fixed"])
@pytest.mark.parametrize(
    ("mesh", "grid", "turn_rad", "least"),
    [
        (BOX, {"distance_m": "1.0", "delta_deg": "30"}, 2 * math.pi, 0),
        (BOX, {"distance_m": "1.0"}, 2 * math.pi, 0),
        (BOX, {"distance_m": "0.6:4.6:2"}, 2 * math.pi, 4),
        (BOX, {"delta_deg": "0:360:20"}, 2 * math.pi, 4),
        (TRIANGLE, {"distance_m": "0.6:1.6:0.2", "delta_deg": "0:360:20"}, 2 * math.pi, 4),
        (TRIANGLE, {"delta_deg": "0:180:2"}, math.pi, 4),
    ],
    ids=["one view", "one distance", "steps of 2 m", "steps of 20°", "steps of 20 cm and 20°", "half a circle"],
)
def test_what_a_coarse_or_narrow_bank_accepts_is_right(tmp_path, mesh, grid, turn_rad, least, free):
    with bank_of(tmp_path, {"part": mesh}, **grid) as bank:
        views, frames = seen(bank, turn_rad=turn_rad)
        matches = Matcher(bank, "refine", free=free).match(frames)
        symmetry = bank.mesh("part").metadata["symmetry"]
    assert right(matches, views, symmetry)[matches.accepted].all()
    assert matches.accepted.sum() >= least


def test_the_range_of_a_bank_ends_half_a_cell_beyond_its_grid_and_angles_repeat_with_the_landmark():
    near, half = np.array([0.6, 1.5]), np.radians(np.arange(-60.0, 61.0))

    def inside(distance_m, delta_deg, delta_rad=half, period_deg=360.0):
        return is_in_range(near, delta_rad, np.array([distance_m, math.radians(delta_deg)]), math.radians(period_deg))

    assert [inside(distance, 0.0) for distance in (0.589, 0.591, 1.509, 1.511)] == [False, True, True, False]
    assert [inside(1.0, delta) for delta in (-61.1, -60.9, 60.9, 61.1, 299.1, 298.9)] == [
        False,
        True,
        True,
        False,
        True,
        False,
    ]
    assert [inside(1.0, delta, period_deg=180.0) for delta in (121.0, 115.0, 240.9)] == [True, False, True]
    assert inside(1.0, 200.0, np.radians(np.arange(0.0, 360.0, 2.0)))  # a whole turn has no end
    assert inside(1.0, 75.0, np.radians([75.5]), 1.0)
