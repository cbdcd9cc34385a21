"""Cells of a bank: their bounds are bounds, and no answer is accepted beside a rival on parts with many faces."""

import math

import numpy as np
import pytest
import trimesh
from thin_landmarks import GROSS_M, GROSS_RAD

from phasemark.data import BankPlan, build_bank
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import export_mesh
from phasemark.matcher import Matcher, kalman_filter
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.scenes import Scenes
from phasemark.matcher.likelihood.setup import setup_of
from phasemark.matcher.nearest.cells import CellBounds
from phasemark.render import Background, Renderer, Views, capture, preset
from phasemark.render.phasor_images import wrap_difference_m

GRIDS = {
    5: {"distance_m": "0.8:1.2:0.02", "delta_deg": "0:358:2", "layout": "full"},
    6: {"distance_m": "0.6:1.5:0.02", "delta_deg": "0:358:2", "layout": "full"},
}
"""Grids of the banks of prisms, by number of sides."""
WALL = Background(wall_m=2.5)


def prism(sides, radius=0.1, height=0.25):
    """Return a prism with a small rib in the middle of one face."""
    mesh = trimesh.creation.cylinder(radius, height, sections=sides)
    rib = trimesh.creation.box((0.03, 0.02, 0.9 * height))
    rib.apply_translation((radius * math.cos(math.pi / sides) + 0.005, 0.01, 0))
    rib.apply_transform(trimesh.transformations.rotation_matrix(math.pi / sides, (0, 0, 1)))
    return trimesh.boolean.union([mesh, rib], engine="manifold")


@pytest.fixture(scope="module")
def prisms(tmp_path_factory):
    banks, folder = {}, tmp_path_factory.mktemp("prisms")
    for sides, grid in GRIDS.items():
        path = folder / f"{sides}.ply"
        path.write_bytes(export_mesh(prism(sides), "ply"))
        mesh = MeshPlan(name="prism", path=str(path), unit="m", symmetry=1)
        banks[sides] = build_bank(BankPlan(meshes=(mesh,), **grid))
    yield banks
    for bank in banks.values():
        bank.close()


def drawn(n, seed, nearest_m=0.65, farthest_m=1.45):
    rng = np.random.default_rng(seed)
    return rng.uniform(nearest_m, farthest_m, n), rng.uniform(0, 2 * math.pi, n), rng


@pytest.mark.parametrize("background", [None, WALL], ids=["alone", "wall"])
@pytest.mark.parametrize("turned", [False, True], ids=["ahead", "half a column aside"])
def test_no_view_of_a_cell_costs_less_than_its_bound(prisms, background, turned):
    bank, n = prisms[6], 100
    distance, delta, rng = drawn(n, 11)
    bearing = rng.uniform(-0.5, 0.5, n) * math.radians(22 / 16) if turned else np.zeros(n)
    behind = Renderer(None, bank.sensor).render(1.0, background=background) if background else None
    cells = CellBounds(bank, (1, 1), behind, aside=turned)
    renderer = Renderer(bank.mesh("prism"), bank.sensor, albedo=0.8)
    image = renderer.render(distance, delta, bearing, background=background)
    seen = Evidence.from_frames(kalman_filter(capture(image, bank.sensor, rng=rng, n_frames=50)), "ranges").seen
    i = np.abs(distance[:, None] - cells.distance_m).argmin(axis=1)
    j = np.abs(wrap_turn(delta[:, None] - cells.delta_rad)).argmin(axis=1)
    # the true view costs one a return, on average; its bound is far below that but for a few mixed pixels
    limit = seen.returned.sum(axis=1) + 25.0
    assert all(np.isfinite(costs(cells, seen, k, limit[k])[0, i[k], j[k]]) for k in range(n))


def test_bounds_of_wide_pixels_hold_at_any_bearing_within_half_a_column(tmp_path):
    path, n = tmp_path / "prism.ply", 60
    path.write_bytes(export_mesh(prism(5), "ply"))
    mesh = MeshPlan(name="prism", path=str(path), unit="m", symmetry=1)
    distance, delta, rng = drawn(n, 4, 0.85, 1.15)
    with build_bank(BankPlan(meshes=(mesh,), sensor="vl53l5cx-8x8", **GRIDS[5])) as bank:
        bearing = rng.uniform(-0.5, 0.5, n) * bank.sensor.pixel_rad
        cells = Scenes(setup_of(bank), workers=1).search.cells
        image = Renderer(bank.mesh("prism"), bank.sensor, albedo=0.8).render(distance, delta, bearing)
    seen = Evidence.from_frames(kalman_filter(capture(image, image.sensor, rng=rng, n_frames=50)), "ranges").seen
    i = np.abs(distance[:, None] - cells.distance_m).argmin(axis=1)
    j = np.abs(wrap_turn(delta[:, None] - cells.delta_rad)).argmin(axis=1)
    limit = seen.returned.sum(axis=1) + 25.0
    held = [np.isfinite(costs(cells, seen, k, limit[k])[0, i[k], j[k]]) for k in range(n)]
    assert np.mean(held) >= 0.9  # ranges are good to half a millimetre: edges within a cell leave some above


def costs(cells, seen, k, limit):
    found = np.empty(cells.shape, np.float32)
    cells.fill_costs(found, cells.prepared(seen[k : k + 1]), 0.0, limit)
    return found


def wrap_turn(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


def test_bounds_hold_for_landmarks_of_any_albedo_between_ratios(prisms):
    bank = prisms[6]
    behind = Renderer(None, bank.sensor).render(1.0, background=WALL)
    views = Views.broadcast(bank.distance_m[[10, 30]], bank.delta_rad[[20, 111]])
    image = Renderer(bank.mesh("prism"), bank.sensor, albedo=0.5).render_views(views, background=WALL)
    beyond_m = []
    for ratios in ((), (0.5, 2.0)):
        cells = CellBounds(bank, (1, 1), behind, ratios=ratios)
        part, pixels = cells._pose
        of = [i * len(cells.delta_rad) + j for i, j in ((10, 20), (30, 111))]
        ranges = image.range_m.reshape(2, -1)[:, pixels]
        off = np.abs(wrap_difference_m(ranges - part.middle_m[of].astype(float), bank.sensor)) - part.half_m[of]
        beyond_m.append(np.nanmax(np.where(part.half_m[of] < 1e3, off, np.nan)))
    assert beyond_m[1] < 1e-3 < 0.01 < beyond_m[0]


def test_some_rows_of_cells_cost_what_they_do_among_all_and_the_others_infinitely_much(prisms):
    bank = prisms[6]
    behind = Renderer(None, bank.sensor).render(1.0, background=WALL)
    whole = CellBounds(bank, (1, 1), behind)
    only = np.random.default_rng(12).random(whole.shape[:2]) < 0.3
    some = CellBounds(bank, (1, 1), behind, only=only)
    image = Renderer(bank.mesh("prism"), bank.sensor, albedo=0.8).render(1.0, 0.4, background=WALL)
    frame = kalman_filter(capture(image, bank.sensor, rng=np.random.default_rng(13), n_frames=50))
    seen = Evidence.from_frames(frame, "ranges").seen
    expected = np.where(only[:, :, None], costs(whole, seen, 0, 1e4), np.inf)
    assert np.isfinite(expected).any()
    np.testing.assert_allclose(costs(some, seen, 0, 1e4), expected, rtol=1e-5)  # float32


def test_a_limit_leaves_out_the_cells_above_it_and_no_other(prisms):
    bank = prisms[6]
    cells = CellBounds(bank, (1, 1), None)
    image = Renderer(bank.mesh("prism"), bank.sensor, albedo=0.8).render(1.03, 2.2)
    frames = kalman_filter(capture(image, bank.sensor, rng=np.random.default_rng(3), n_frames=50))
    seen = Evidence.from_frames(frames, "ranges").seen
    wide, narrow = (costs(cells, seen, 0, limit) for limit in (1e6, 200.0))
    kept = np.isfinite(narrow)
    assert 10 < kept.sum() < 0.1 * kept.size
    np.testing.assert_allclose(narrow[kept], wide[kept], rtol=1e-5)  # float32
    # the bound of each cell, by NumPy: the sum over pixels of the distance from the interval
    part, pixels = cells._pose
    y, weight = seen.range_m[0, pixels], np.where(seen.returned[0, pixels], seen.weight[0, pixels], 0.0)
    off = np.abs(wrap_difference_m(y - part.middle_m.astype(float), bank.sensor)) - part.half_m
    bound = np.minimum(weight * np.maximum(off, 0.0) ** 2, 25.0).sum(axis=1)
    bound += (25.0 * seen.not_returned[0, pixels] * part.must_return).sum(axis=1)
    clear = np.abs(bound - 200.0) > 0.01
    np.testing.assert_array_equal(kept.ravel()[clear], (bound <= 200.0)[clear])


@pytest.mark.parametrize("sides", [5, pytest.param(6, marks=pytest.mark.soak)])
@pytest.mark.parametrize("setting", [pytest.param("fixed", marks=pytest.mark.soak), "bearing", "wall"])
def test_a_prism_is_never_accepted_a_face_off(prisms, sides, setting):
    bank, n = prisms[sides], 40 if sides == 6 else 16
    distance, delta, rng = drawn(n, sides) if sides == 6 else drawn(n, sides, 0.85, 1.15)
    bearing = rng.uniform(-1, 1, n) * math.radians(1.7) if setting == "bearing" else np.zeros(n)
    free = ("distance_m", "delta_rad", "bearing_rad")[: 3 if setting == "bearing" else 2]
    background = WALL if setting == "wall" else None
    views = Views.broadcast(distance, delta, bearing)
    image = Renderer(bank.mesh("prism"), bank.sensor, albedo=0.8).render_views(views, background=background)
    frames = kalman_filter(capture(image, bank.sensor, rng=rng, n_frames=50))
    matches = Matcher(bank, free=free, method="refine", background=background).match(frames)
    off = np.abs(wrap_turn(matches.delta_rad - delta))
    right = (np.abs(matches.distance_m - distance) <= GROSS_M) & (off <= GROSS_RAD)
    assert right[matches.accepted].all()
    assert matches.accepted.sum() >= n / 4
    ambiguous = [k for k, match in enumerate(matches) if match.reason == "ambiguous"]
    # the true view is the answer or among the alternatives
    for k in ambiguous:
        told = [matches[k].delta_rad, *(one.delta_rad for one in matches[k].alternatives)]
        assert np.abs(wrap_turn(np.array(told) - delta[k])).min() <= GROSS_RAD


@pytest.fixture(scope="module")
def knob(tmp_path_factory):
    """A bank of a prism of 24 sides with a pointer, which looks alike from a third of all sides."""
    folder, pointer = tmp_path_factory.mktemp("knob"), trimesh.creation.box((0.14, 0.03, 0.16))
    pointer.apply_translation((0.07, 0, 0))
    whole = trimesh.boolean.union([trimesh.creation.cylinder(0.08, 0.2, sections=24), pointer], engine="manifold")
    whole.export(folder / "knob.stl")
    mesh = MeshPlan(name="knob", path=str(folder / "knob.stl"), unit="m")
    plan = BankPlan(
        meshes=(mesh,), sensor="vl53l8cx-8x8", distance_m="0.5:0.75:0.01", delta_deg="0:357:3", layout="full"
    )
    with build_bank(plan, folder / "bank.h5") as bank:
        yield bank


def test_a_landmark_far_beyond_the_prior_of_its_bearing_is_matched_without_that(knob):
    """Its rivals lie beyond the bearings that the prior searches, too."""
    rng, n = np.random.default_rng(5), 12
    side = np.radians(rng.uniform(8, 14, n)) * rng.choice([-1, 1], n)
    views = Views.broadcast(rng.uniform(0.55, 0.72, n), np.radians(rng.uniform(-40, 40, n)), side)
    image = Renderer(knob.mesh("knob"), knob.sensor).render_views(views)
    matches = Matcher(knob, "refine").match(kalman_filter(capture(image, knob.sensor, rng=rng, n_frames=10)))
    right = (np.abs(matches.distance_m - views.distance_m) <= GROSS_M) & (
        np.abs(wrap_turn(matches.delta_rad - views.delta_rad)) <= GROSS_RAD
    )
    assert right[matches.accepted].all()


def test_a_lens_in_a_corner_of_the_box_of_a_round_part_is_outside_it():
    can = Renderer(trimesh.creation.cylinder(0.15, 0.2), preset("pmd-16x16"))
    image = can.render(0.2, math.radians(45))  # the corner of the bounding box is at 0.212 m
    assert image.range_m[0, 7, 7] == pytest.approx(0.05, abs=1e-3)
