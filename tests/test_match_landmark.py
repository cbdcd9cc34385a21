"""``phasemark match`` with a mesh or a class in place of a bank, whose bank is built, kept and found again."""

import json
import os

import numpy as np
import pytest
import trimesh
from builders import error_lines

from phasemark.data import BankPlan
from phasemark.data.bank.build_bank import cached_bank
from phasemark.landmarks import export_mesh
from phasemark.render import Background, Views, capture, preset
from phasemark.render.direct import HistogramRenderer

SENSOR = preset("vl53l5cx-8x8")
PLAN = BankPlan(classes=("post",), sensor="vl53l5cx-8x8", distance_m="0.5,0.6", delta_deg="0:90:45")


def bracket():
    """A foot with an upright and a rib, in metres."""
    boxes = [((0.16, 0.24, 0.03), (0, 0, 0.015)), ((0.03, 0.24, 0.25), (-0.065, 0, 0.125)),
             ((0.13, 0.03, 0.12), (0.015, 0.06, 0.09))]  # fmt: skip
    parts = [trimesh.creation.box(size).apply_translation(place) for size, place in boxes]
    part = trimesh.boolean.union(parts)
    return part.apply_translation((0, 0, -0.125))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A CAD file in millimetres, and a log of it as SparkFun's example prints it."""
    place, part = tmp_path_factory.mktemp("dock"), bracket()
    view = Views.broadcast(0.6, 0.7, 0.05, 0.0, 0.04, 0.02)
    images = HistogramRenderer(part, SENSOR).render_views(view, background=Background(wall_m=1.6, floor_m=0.3))
    frames = capture(images, SENSOR, rng=np.random.default_rng(3), n_frames=10).ranges
    lines = ["SparkFun VL53L5CX Imager Example"]
    for image in np.nan_to_num(1000 * frames.z_m[0]).round().astype(int):
        lines += ["\t" + "\t".join(map(str, row[::-1])) for row in image] + [""]
    (place / "recording.txt").write_text("\r\n".join(lines) + "\r\n", encoding="ascii")
    part.vertices = part.vertices * 1000
    (place / "dock.stl").write_bytes(export_mesh(part, "stl"))
    return place


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "phasemark" / "banks"


def test_a_mesh_and_a_log_of_a_board_are_all_that_a_match_takes(folder, cache, run):
    words = "match", folder / "dock.stl", folder / "recording.txt", "--unit", "mm", "--json"
    code, out, _ = run(*words)
    assert code == 0
    (match,) = json.loads(out)["matches"]
    assert match["accepted"]
    assert match["class"] == "dock"
    assert match["among_unknown"]
    assert match["distance_m"] == pytest.approx(0.6, abs=2e-3)
    assert match["delta_deg"] == pytest.approx(np.degrees(0.7), abs=1.0)
    assert match["pitch_deg"] == pytest.approx(np.degrees(0.04), abs=0.5)
    (kept,) = cache.glob("*.h5")
    before = kept.stat().st_ino
    assert run(*words, "--method", "nearest", "--no-diagnosis")[0] == 0
    assert [path.stat().st_ino for path in cache.glob("*.h5")] == [before]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("dock.stl", "recording.txt"), "say in which unit it is"),
        (("dock.stl", "recording.txt", "--part-unit", "m"), "cannot be in these frames"),
        (("dock.stl", "plain.csv", "--unit", "mm"), "does not say which sensor took it: give --sensor"),
        (("post", "recording.txt", "--part-unit", "mm"), "belong to a mesh"),
        (("bank.h5", "recording.txt", "--no-cache"), "--no-cache goes with a mesh or a class"),
        (("bank.h5", "recording.txt", "--sensor", "vl53l5cx-8x8"), "--sensor goes with a mesh or a class"),
    ],
)
def test_options_that_do_not_go_together_are_refused_in_one_line(folder, cache, run, monkeypatch, words, message):
    monkeypatch.chdir(folder)
    (folder / "plain.csv").write_text(",".join(["700"] * 64) + "\n", encoding="ascii")
    code, _, err = run("match", *words)
    (line,) = error_lines(err)
    assert code in (2, 3)
    assert message in line


def test_a_kept_bank_is_found_by_its_contents_and_a_damaged_one_is_built_again(cache):
    with cached_bank(PLAN) as first:
        image = first.image("post", 0, 0)
    (kept,) = cache.glob("*.h5")
    built = kept.read_bytes()
    kept.write_bytes(built[: len(built) // 2])
    with cached_bank(PLAN) as again:
        assert (again.image("post", 0, 0).phasor == image.phasor).all()
    assert kept.read_bytes() == built
    with cached_bank(PLAN.model_copy(update={"distance_m": (0.5,)})):
        assert len(list(cache.glob("*.h5"))) == 2


def test_nothing_is_kept_where_nothing_shall_or_can_be(cache):
    cached_bank(PLAN, keep=False).close()
    assert not cache.exists()
    cache.parent.mkdir(parents=True)
    cache.write_text("a file in the way", encoding="ascii")
    with cached_bank(PLAN) as bank:
        assert bank.classes == ("post",) or list(bank.classes) == ["post"]


def test_banks_that_were_not_used_for_longest_are_thrown_away(cache, monkeypatch):
    cached_bank(PLAN).close()
    (old,) = cache.glob("*.h5")
    os.utime(old, (1.0, 1.0))
    monkeypatch.setattr("phasemark.data.bank.build_bank._MOST_BYTES", old.stat().st_size + 1)
    cached_bank(PLAN.model_copy(update={"distance_m": (0.5,)})).close()
    left = list(cache.glob("*.h5"))
    assert len(left) == 1
    assert left[0] != old
    assert not old.with_name(old.name + ".sha256").exists()
