"""Images at any bearing from strips of columns: near those that are rendered there, with slopes that are their own."""

import math

import numpy as np
import pytest
import trimesh
from random_parts import random_part

from phasemark.data import BankPlan, build_bank
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import export_mesh
from phasemark.matcher.frequencies import OneFrequencyBank
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.strip_images import StripModel
from phasemark.matcher.pixel_agreement import counts
from phasemark.render import Renderer, Views, predicted_range_std, preset

FREE = VIEW[:3]
PMD = preset("pmd-16x16")
CAMERAS = {
    "pmd-16x16": ("pmd-16x16", {}),
    "tilted, part of its pixels active": ("pmd-16x16", {"pitch_deg": 3.0, "roll_deg": 2.0, "fill_factor": (0.7, 0.8)}),
    "axis beside the middle": ("pmd-16x16", {"principal_point_px": (7.2, 8.6), "bearing_offset_deg": 1.0}),
    "wide pixels": ("vl53l5cx-8x8", {}),
}


@pytest.fixture(scope="module")
def part_files(tmp_path_factory):
    rng, files = np.random.default_rng(3), []
    for kind in ("bracket", "prism_rib"):
        files.append(tmp_path_factory.mktemp("parts") / f"{kind}.ply")
        files[-1].write_bytes(export_mesh(random_part(kind, rng), "ply"))
    return files


def bank_of(files, sensor="pmd-16x16", overrides=(), **grid):
    meshes = tuple(MeshPlan(name=file.stem, path=str(file), unit="m") for file in files)
    grid = {"distance_m": "0.9:1.1:0.04", "delta_deg": "0:352:8", "layout": "full", **grid}
    return build_bank(BankPlan(meshes=meshes, sensor=sensor, sensor_overrides=dict(overrides), **grid))


def drawn(n, seed, widest_columns, sensor):
    rng = np.random.default_rng(seed)
    view = np.zeros((n, len(VIEW)))
    view[:, 0], view[:, 1] = rng.uniform(0.9, 1.1, n), rng.uniform(0, 2 * np.pi, n)
    view[:, 2] = rng.uniform(-widest_columns, widest_columns, n) * sensor.pixel_rad
    return view, rng.integers(0, 2, n)


@pytest.mark.parametrize("camera", CAMERAS)
def test_images_at_any_bearing_are_rendered_ones_within_the_noise_of_50_exposures(part_files, camera):
    n = 60
    with bank_of(part_files, *CAMERAS[camera]) as bank:
        sensor = bank.sensor
        view, c = drawn(n, 1, 2.0, sensor)
        made = StripModel(bank, 2).images(c, view, ())
        rendered, shade = np.empty_like(made.phasor), np.empty((2, *made.phasor.shape))
        for k, name in enumerate(bank.classes):
            renderer = Renderer(bank.mesh(name), sensor, albedo=bank.mesh(name).metadata["albedo"])
            image = renderer.render_views(Views(*np.ascontiguousarray(view[c == k].T)))
            rendered[c == k] = image.phasor.reshape((c == k).sum(), -1)
            shade[:, c == k] = [own.reshape((c == k).sum(), -1) for own in (image.intensity, image.coverage)]
    seen = counts(rendered, shade[0], sensor)
    std = predicted_range_std(np.abs(rendered), shade[0], sensor) / math.sqrt(50)
    off = sensor.metres_per_radian * np.angle(rendered * made.phasor.conj())
    cost = np.where(seen & (made.phasor != 0), off / std, 0.0) ** 2
    # direct sensors have half a millimetre of noise: there single pixels with edges of several surfaces cost hundreds
    assert np.median(cost.sum(axis=1)) < (60.0 if sensor.kind == "direct" else 8.0)
    assert np.median(np.abs(made.coverage - shade[1])[shade[1] > 0]) < 2e-3
    assert (seen & ~counts(made.phasor, made.intensity, sensor)).mean() < 2e-3


def test_slopes_are_differences(part_files):
    with bank_of(part_files) as bank:
        model, (view, c) = StripModel(bank, 3), drawn(40, 2, 3.0, PMD)
        slope = model.images(c, view, FREE).slope
        half_strip = 0.5 * PMD.pixel_rad / 4  # what comes in at a border is averaged over a strip
        for k, step in enumerate((1e-4, 1e-4, half_strip)):
            ends = [model.images(c, view + side * step * np.eye(len(VIEW))[k], ()).phasor for side in (1, -1)]
            difference = (ends[0] - ends[1]) / (2 * step)
            assert np.abs(difference - slope[:, k]).mean() < 0.02 * np.abs(difference).mean()


def test_images_do_not_depend_on_what_was_asked_before(part_files):
    with bank_of(part_files) as bank:
        view, c = drawn(12, 4, 1.0, PMD)
        at_once = StripModel(bank, 1).images(c, view, FREE)
        model = StripModel(bank, 1)
        for k in reversed(range(12)):
            one = model.images(c[k : k + 1], view[k : k + 1], FREE)
            np.testing.assert_array_equal(one.phasor[0], at_once.phasor[k])
            np.testing.assert_array_equal(one.slope[0], at_once.slope[k])


def test_a_bank_may_begin_where_an_edge_of_a_panel_reaches_the_lens_between_its_angles(tmp_path):
    panel = trimesh.creation.box((0.01, 0.6, 0.5))
    panel.export(tmp_path / "panel.ply")
    view = np.zeros((4, len(VIEW)))
    view[:, 0], view[:, 1] = (0.3, 0.305, 0.31, 0.33), np.radians((89.4, 90.5, 269.6, 60.3))
    with bank_of([tmp_path / "panel.ply"], "vl53l8cx-8x8", distance_m="0.3:0.5:0.02", delta_deg="0:356:4") as bank:
        made = StripModel(bank, 2).images(np.zeros(4, np.int64), view, ())
        apart = Renderer(panel, bank.sensor, albedo=0.8).render_views(Views.broadcast(view[3:, 0], view[3:, 1]))
    assert np.isfinite(made.phasor).all()
    np.testing.assert_allclose(made.phasor[3:], apart.phasor.reshape(1, -1), atol=0.03 * abs(apart.phasor).max())


def test_a_factored_bank_gives_the_images_of_a_full_one():
    view, c = drawn(10, 5, 2.0, PMD)
    made = []
    for layout in ("factored", "full"):
        plan = BankPlan(classes=("cone", "post"), distance_m="0.9:1.1:0.04", delta_deg="0:180:8", layout=layout)
        with build_bank(plan) as bank:
            made.append(StripModel(bank, 2).images(c, view, FREE))
    np.testing.assert_allclose(made[0].phasor, made[1].phasor, atol=2e-5)  # turned tessellation of the body on top


@pytest.mark.parametrize(
    ("changes", "suits"),
    [
        ({}, True),
        ({"distance_m": "1"}, False),
        ({"delta_deg": "10"}, False),
        ({"distance_m": "0.9:3.9:1", "overrides": {"rows": 256, "cols": 256}}, False),
        ({"overrides": {"modulation_hz": (10e6, 15e6)}}, False),
    ],
    ids=["usual", "one distance", "one angle", "too large", "unwrapped ranges"],
)
def test_strips_are_made_where_there_is_a_grid_and_room(part_files, changes, suits):
    with bank_of(part_files[:1], **changes) as bank:
        several = len(bank.sensor.frequencies_hz) > 1
        assert StripModel.suits(OneFrequencyBank(bank, "combined") if several else bank, 3) is suits
