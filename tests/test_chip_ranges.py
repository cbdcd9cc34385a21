"""Ranges that a chip reports: rendered, simulated, and matched before whatever stands behind the landmark."""

import dataclasses
import math
from collections import Counter
from functools import lru_cache

import numpy as np
import pytest
import trimesh

from phasemark import UsageError
from phasemark.data import build_bank
from phasemark.data.measured.simulated import simulate_recording
from phasemark.data.plans.bank_plan import MeshPlan
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher, kalman_filter
from phasemark.matcher.chi_squared import p_values_of
from phasemark.matcher.recordings.bank_for_frames import distances_of_frames
from phasemark.render import Background, Frames, Renderer, Views, capture, preset
from phasemark.render.direct import HistogramRenderer
from phasemark.render.direct.chip_renderer import ChipRenderer
from phasemark.render.sensor.sensor_file import sensor_toml

SENSOR = preset("vl53l5cx-8x8")
ANGLES = "delta_rad", "bearing_rad", "pitch_rad", "roll_rad"
# class, D, δ, bearing, pitch, roll in degrees, wall, floor
SCENES = {
    "nothing behind": ("cone", 0.54, 100.0, 1.0, 2.0, -1.0, None, None),
    "a wall": ("post", 0.53, 219.9, -1.23, 1.21, -2.67, 2.58, None),
    "a wall near by and a floor": ("cylinder", 0.61, 152.4, 3.3, -0.5, 0.3, 1.2, 0.27),
}


@lru_cache(maxsize=4)
def mesh(name):
    return build_mesh(catalog()[name])


@lru_cache(maxsize=4)
def bank(name):
    return build_bank({"classes": (name,), "sensor": "vl53l5cx-8x8", "distance_m": "0.4:0.8:0.01"})


def chip_frames(name, view, background, n_frames=15, seed=1):
    """Return frames as the chip makes them of its own histograms, in whole millimetres."""
    images = HistogramRenderer(mesh(name), SENSOR).render_views(view, background=background)
    frames = capture(images, SENSOR, rng=np.random.default_rng(seed), n_frames=n_frames).ranges
    z_m = np.round(frames.z_m, 3)
    return Frames(z_m / SENSOR.axis_cosine(), flags=frames.flags, sensor=SENSOR)


def view_of(name, distance, delta, bearing, pitch, roll, wall, floor):
    view = Views.broadcast(distance, *np.radians([delta, bearing]), 0.0, *np.radians([pitch, roll]))
    background = None if wall is None else Background(wall_m=wall, floor_m=floor)
    return name, view, background


@pytest.fixture(scope="module")
def angled(tmp_path_factory):
    """Return the bank of an L, its mirror image and a T, of prisms."""
    folder = tmp_path_factory.mktemp("angled")
    parts = {
        "l": (((0.22, 0.05, 0.24), (0.0, 0.0)), ((0.05, 0.16, 0.24), (0.085, 0.055))),
        "l_mirrored": (((0.22, 0.05, 0.24), (0.0, 0.0)), ((0.05, 0.16, 0.24), (0.085, -0.055))),
        "t": (((0.05, 0.26, 0.24), (0.0, 0.0)), ((0.16, 0.05, 0.24), (0.09, 0.03))),
    }
    plans = []
    for name, boxes in parts.items():
        solid = trimesh.boolean.union(
            [trimesh.creation.box(size, trimesh.transformations.translation_matrix((*at, 0))) for size, at in boxes]
        )
        solid.export(folder / f"{name}.stl")
        plans.append(MeshPlan(name=name, path=str(folder / f"{name}.stl"), unit="m", origin="center"))
    grid = {"distance_m": "0.4:1.1:0.03", "delta_deg": "0:357:3", "layout": "full"}
    with build_bank({"meshes": plans, "sensor": "vl53l8cx-8x8", **grid}, folder / "bank.h5") as opened:
        yield opened


@pytest.mark.parametrize(
    ("name", "distance_m", "delta_deg", "bearing_deg", "seed"),
    [
        ("l", 0.7112803898308201, 9.077455571677616, -0.40861797389927984, 1083287904592726769),
        ("t", 0.9195263037385393, 119.72259357868181, 2.2737269944066285, 674444676285766827),
        pytest.param(
            *("l", 0.91473019977849, 141.02568826484236, 2.2191994230293184, 122396010310478217), marks=pytest.mark.soak
        ),
    ],
)
def test_zones_of_which_no_target_is_sure_do_not_make_another_part_likelier(
    angled, name, distance_m, delta_deg, bearing_deg, seed
):
    """All three were accepted as the mirrored L, 30 to 98° off: at the true view two zones need not report."""
    albedo = float(angled.mesh(name).metadata["albedo"])
    view = Views.broadcast(distance_m, *np.radians([delta_deg, bearing_deg]))
    images = HistogramRenderer(angled.mesh(name), angled.sensor, albedo=albedo).render_views(view)
    frames = capture(images, angled.sensor, rng=np.random.default_rng(seed), n_frames=15).ranges
    match = Matcher(angled, "refine", on="reported").match(kalman_filter(frames))[0]
    assert match.class_name == name
    assert match.reason in ("", "ambiguous")
    assert abs(match.distance_m - distance_m) < 0.03
    assert abs(math.remainder(match.delta_rad - math.radians(delta_deg), math.tau)) < math.radians(6)


def test_a_view_whose_slopes_lead_to_where_a_zone_is_contradicted_is_left(angled):
    name, distance_m = "l_mirrored", 0.8093923152221857
    delta_rad, bearing_rad = math.radians(2.4427679333338537), math.radians(-0.8693698923468542)
    view = Views.broadcast(distance_m, delta_rad, bearing_rad)
    albedo = float(angled.mesh(name).metadata["albedo"])
    images = HistogramRenderer(angled.mesh(name), angled.sensor, albedo=albedo).render_views(view)
    frames = capture(images, angled.sensor, rng=np.random.default_rng(241982689062556403), n_frames=15).ranges
    matcher, filtered = Matcher(angled, "refine", on="reported"), kalman_filter(frames)
    expected = dataclasses.replace(
        matcher.match(filtered)[0], class_name=name, bearing_rad=bearing_rad, pitch_rad=0.00113914, roll_rad=0.00412779
    )
    costs = [
        matcher.track(
            filtered, [dataclasses.replace(expected, distance_m=distance_m + near_m, delta_rad=delta_rad + turn_rad)]
        ).chi2
        for near_m, turn_rad in ((0.0, 0.0), (-1e-3, 3e-3))
    ]
    assert costs[1] < costs[0] + 9


@pytest.mark.parametrize("name", sorted(catalog()))
def test_rendered_ranges_are_the_mean_of_what_the_chip_reports(name):
    rng = np.random.default_rng(3)
    views = Views.broadcast(rng.uniform(0.4, 1.2, 6), rng.uniform(0, 2 * np.pi, 6), rng.uniform(-0.08, 0.08, 6))
    image = ChipRenderer(mesh(name), SENSOR).render_views(views)
    counted = HistogramRenderer(mesh(name), SENSOR).render_views(views)
    reported = capture(counted, SENSOR, rng=rng, n_frames=100).ranges
    sure = (image.phasor != 0) & reported.valid.all(axis=1)
    assert sure.sum() > 60
    range_m = np.where(reported.valid.all(axis=1, keepdims=True), reported.range_m, 0.0)
    mean, std = range_m.mean(axis=1)[sure], range_m.std(axis=1)[sure]
    off = image.range_m[sure] - mean
    # the expected target is that of the mean counts: where surfaces bend in a zone another bin may be the highest
    assert np.quantile(np.abs(off) - std / 10 * 3, 0.95) < 1e-3
    assert np.abs(off).max() < 0.3 * SENSOR.histogram.bin_width_m


@pytest.mark.parametrize("background", [None, Background(wall_m=2.5)])
def test_slopes_are_differences_of_ranges(background):
    renderer, view, step = ChipRenderer(mesh("post"), SENSOR), Views.broadcast(0.6, 0.5, 0.03), 1e-3
    image, slope = renderer.render_with_slopes(view, ("distance_m", "delta_rad"), background=background)
    filled = (image.coverage[0] > 0.999) & (image.phasor[0] != 0)
    assert filled.sum() >= 6
    for k, move in enumerate([(step, 0.0), (0.0, step)]):
        ends = [
            renderer.render(0.6 + side * move[0], 0.5 + side * move[1], 0.03, background=background).range_m[0]
            for side in (1.0, -1.0)
        ]
        expected = ((ends[0] - ends[1]) / (2 * step))[filled]
        found = SENSOR.metres_per_radian * (slope[0, k] / np.where(filled, image.phasor[0], 1.0)).imag[filled]
        np.testing.assert_allclose(found, expected, rtol=0.1, atol=0.02)


def test_a_zone_at_an_edge_reports_the_landmark_or_the_wall_and_nothing_between():
    """The mean over the zone, which a chip does not report, lies between the two."""
    wall_m = 1.5
    views = Views.broadcast(np.full(3, 0.7), np.radians(30.0))
    wall = Background(wall_m=wall_m)
    simulated = simulate_recording(mesh("cylinder"), "cylinder", SENSOR, views, seed=1, background=wall)
    z_m = simulated.frames.z_m[0][:, :]
    light = Renderer(mesh("cylinder"), SENSOR).render_views(views[:1], background=wall)
    mean_m = (light.range_m * SENSOR.axis_cosine())[0]
    between = (mean_m > 0.8) & (mean_m < wall_m - 0.1)
    assert between.sum() >= 4
    assert ((z_m[:, between] < 0.8) | (np.abs(z_m[:, between] - wall_m) < 0.05)).all()


@pytest.mark.parametrize(
    "scene", ["nothing behind", pytest.param("a wall", marks=pytest.mark.soak), "a wall near by and a floor"]
)
def test_frames_of_a_chip_are_matched_whatever_stands_behind(scene):
    name, view, background = view_of(*SCENES[scene])
    match = Matcher(bank(name), "refine", on="reported").match(kalman_filter(chip_frames(name, view, background)))[0]
    assert match.accepted
    assert match.class_name == name
    assert match.among_unknown
    assert match.free == ("distance_m", "delta_rad", "bearing_rad", "pitch_rad", "roll_rad")
    assert match.distance_m == pytest.approx(float(view.distance_m[0]), abs=3e-3)
    period = 2 * math.pi / match.symmetry
    for angle in ANGLES:
        off = math.remainder(getattr(match, angle) - float(getattr(view, angle)[0]), period)
        assert abs(math.degrees(off)) < 1.0, angle


def test_offsets_of_range_and_zones_are_in_what_a_chip_reports_and_taken_off_once(tmp_path):
    table = np.random.default_rng(4).normal(0.0, 5e-3, (8, 8))
    sensor = SENSOR.with_(range_offset_m=0.03, zone_offset_m=tuple(map(tuple, table.tolist())))
    (tmp_path / "mine.toml").write_text(sensor_toml(sensor, {}, header=[], otherwise="assumed"), encoding="utf-8")
    name, view, _ = view_of(*SCENES["nothing behind"])
    plain, late = (
        capture(HistogramRenderer(mesh(name), one).render_views(view), one, rng=np.random.default_rng(1), n_frames=15)
        for one in (SENSOR, sensor)
    )
    later = (late.ranges.range_m - plain.ranges.range_m).mean(axis=1)[0]
    lit = np.isfinite(later)
    assert lit.sum() > 5
    np.testing.assert_allclose(later[lit], (0.03 + table)[lit], atol=2e-3)
    grid = {"distance_m": "0.5:0.58:0.02", "delta_deg": "0:180:4"}
    with build_bank({"classes": (name,), "sensor": str(tmp_path / "mine.toml"), **grid}) as mine:
        (match,) = Matcher(mine, "refine", on="reported").match(kalman_filter(late.ranges))
    assert match.accepted
    assert match.distance_m == pytest.approx(float(view.distance_m[0]), abs=3e-3)


@pytest.mark.soak
def test_accepted_answers_for_frames_of_a_chip_are_right():
    """Four classes, 0.4 to 0.8 m, wall or none, floor or none, tilts and bearings: none of 120 is grossly wrong."""
    rng, count = np.random.default_rng(12), Counter()
    for name in sorted(catalog()):
        matcher = Matcher(bank(name), "refine", on="reported")
        low = -float(mesh(name).vertices[:, 2].min())
        for seed in range(30):
            distance, wall = rng.uniform(0.45, 0.75), rng.uniform(0.4, 2.0)
            floor = low + 0.05 + rng.uniform(0.05, 0.2) if seed % 2 else None
            scene = (
                name, distance, rng.uniform(0, 360), *rng.uniform(-5, 5, 1), *rng.uniform(-3, 3, 2),
                distance + wall if seed % 5 else None, floor,
            )  # fmt: skip
            _, view, background = view_of(*scene)
            match = matcher.match(kalman_filter(chip_frames(name, view, background, seed=seed)))[0]
            off = math.remainder(match.delta_rad - float(view.delta_rad[0]), 2 * math.pi / match.symmetry)
            right = abs(match.distance_m - distance) < 0.03 and abs(off) < math.radians(6)
            count[match.accepted, right] += 1
    assert count[True, False] == 0, count
    assert count[True, True] >= 0.6 * (count[True, True] + count[False, True]), count


def test_a_part_of_two_boxes_is_found_by_a_tilted_camera_over_a_floor(tmp_path):
    """Most zones see wall and floor: the bound of the right cell was 50 above that of others, and it was not tried."""
    plate = trimesh.creation.box((0.2, 0.16, 0.02), trimesh.transformations.translation_matrix((0, 0, -0.07)))
    arm = trimesh.creation.box((0.06, 0.12, 0.16), trimesh.transformations.translation_matrix((-0.05, 0.01, 0.01)))
    trimesh.boolean.union([plate, arm]).export(tmp_path / "dock.stl")
    part = MeshPlan(name="dock", path=str(tmp_path / "dock.stl"), unit="m")
    grid = {"distance_m": "0.5:0.8:0.02", "delta_deg": "0:360:4", "layout": "full"}
    with build_bank({"sensor": "vl53l5cx-8x8", "meshes": (part,), **grid}) as opened:
        view = Views.broadcast(0.62, *np.radians([25.0, 2.0]), 0.0, *np.radians([1.5, -1.0]))
        behind = Background(wall_m=1.3, floor_m=0.3)
        recorded = simulate_recording(
            opened.mesh("dock"), "dock", SENSOR, view[np.zeros(20, np.int64)], seed=0, background=behind
        )
        (match,) = Matcher(opened, "refine", on="reported").match(kalman_filter(recorded.frames))
    assert match.accepted
    assert match.distance_m == pytest.approx(0.62, abs=2e-3)
    assert match.delta_rad == pytest.approx(math.radians(25.0), abs=math.radians(1.5))


def test_what_a_chip_reports_is_asked_of_a_sensor_with_a_chip_alone():
    with pytest.raises(UsageError, match="goes with method"):
        Matcher(bank("cone"), "nearest", on="reported")
    for behind in ("auto", Background(wall_m=2.0)):
        with pytest.raises(UsageError, match="takes what stands behind the landmark for unknown"):
            Matcher(bank("cone"), "refine", on="reported", background=behind)
    with build_bank({"classes": ("cone",), "distance_m": "1.0", "delta_deg": "0"}) as phase:
        with pytest.raises(UsageError, match=r"\[histogram\] table"):
            Matcher(phase, "refine", on="reported")


def test_a_cost_of_nothing_has_a_p_value():
    """Sums of squares are differences of sums: one of 0 came out as −1e-13, and as no number."""
    p = p_values_of(np.array([-1e-13, 0.0]), np.array([3.0, 3.0]), np.tile([np.inf, 0.0], (2, 1)))
    assert p == pytest.approx([1.0, 1.0])


@pytest.mark.parametrize(("scale", "reason"), [(1000.0, "cannot be in these frames"), (1.0, "")])
def test_a_landmark_that_cannot_be_in_the_frames_is_refused(scale, reason):
    name, view, background = view_of(*SCENES["a wall"])
    frames = chip_frames(name, view, background, n_frames=1)
    part = mesh(name).copy()
    part.vertices = part.vertices * scale
    if reason:
        with pytest.raises(UsageError, match=reason):
            distances_of_frames(frames, part)
    else:
        distances = distances_of_frames(frames, part)
        assert distances[0] < 0.53 - 0.1
        assert distances[-1] > 0.53 + 0.2


def test_frames_without_a_range_ask_for_no_bank():
    nothing = Frames(np.full((1, 1, 8, 8), np.nan), sensor=SENSOR)
    with pytest.raises(UsageError, match="no pixel of the frames has a valid range"):
        distances_of_frames(nothing, mesh("cone"))
