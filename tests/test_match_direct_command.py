"""``phasemark match`` on logs of direct sensors: histograms, targets, and what does not go with them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from phasemark.data import BankPlan, FramePlan, build_bank, build_frames
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Views, preset
from phasemark.render.direct import HistogramRenderer, capture_histograms

VIEWS = Views.broadcast([1.0, 1.1], [0.4, 1.2])
FIXED = ("--method", "refine", "--fix", "bearing")
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a bank, and a log of histograms and one of targets of the cone."""
    place = tmp_path_factory.mktemp("direct")
    grid = {"classes": ("cone", "sphere"), "distance_m": "0.95:1.15:0.1", "delta_deg": "0:170:10"}
    build_bank(BankPlan(sensor="vl53l5cx-8x8", **grid), place / "bank.h5").close()
    build_bank(BankPlan(classes=("cone",), distance_m="1.0", delta_deg="0"), place / "phase.h5").close()
    sensor = preset("vl53l5cx-8x8")
    renderer = HistogramRenderer(build_mesh(catalog()["cone"]), sensor)
    frames = capture_histograms(renderer.expected(VIEWS), sensor, rng=np.random.default_rng(1))
    counts = frames.zone_counts.astype(int)
    np.savez(place / "log.npz", histogram=counts, t_s=np.array([0.0, 0.1]))
    mm = 1000 * frames.targets.distance_m[:, 0, :, :, 0].reshape(2, 64)
    sigma = 1000 * frames.targets.sigma_m[:, 0, :, :, 0].reshape(2, 64)
    header = [f"mm_{z}_0" for z in range(64)] + [f"sigma_mm_{z}_0" for z in range(64)]
    rows = [["" if np.isnan(v) else f"{v:.2f}" for v in row] for row in np.hstack([mm, sigma])]
    (place / "targets.csv").write_text("\n".join(",".join(row) for row in [header, *rows]) + "\n", encoding="utf-8")
    return place


LOGS = [("log.npz", "histograms"), ("log.npz", "targets"), ("targets.csv", "targets")]


@pytest.mark.parametrize(("name", "on"), LOGS)
def test_a_log_is_matched_frame_by_frame(folder: Path, run: Run, name: str, on: str) -> None:
    code, out, _ = run(
        "match", folder / "bank.h5", folder / name, *FIXED, "--on", on, "--moving", "--json",
        "--estimates", folder / f"{name}-{on}.csv",
    )  # fmt: skip
    assert code == 0
    found = json.loads(out)["matches"]
    assert [one["class"] for one in found] == ["cone", "cone"]
    assert [one["distance_m"] for one in found] == pytest.approx(VIEWS.distance_m.tolist(), abs=0.01)
    if name == "log.npz":
        assert [one["time_s"] for one in found] == [0.0, 0.1]
    assert len((folder / f"{name}-{on}.csv").read_text().splitlines()) == 3


def test_frames_of_a_sensor_at_rest_are_added_up(folder: Path, run: Run) -> None:
    one = np.load(folder / "log.npz")["histogram"][:1]
    np.savez(folder / "rest.npz", histogram=np.repeat(one, 3, axis=0))
    code, out, _ = run("match", folder / "bank.h5", folder / "rest.npz", *FIXED, "--on", "histograms")
    assert code == 0
    assert out.count("cone") == 1


ON_COUNTS, ON_TARGETS = (*FIXED, "--on", "histograms"), (*FIXED, "--on", "targets")


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("bank.h5", "log.npz", "--method", "nearest", "--on", "targets"), "--on goes with --method refine"),
        (("phase.h5", "log.npz", *ON_COUNTS), "take a bank of a direct sensor"),
        (("bank.h5", "targets.csv", *ON_COUNTS), "match it on targets"),
        (("bank.h5", "log.npz", *ON_COUNTS, "--unknown-background"), "--unknown-background goes with images of ranges"),
        (("bank.h5", "log.npz", *ON_TARGETS, "--auto-background"), "--auto-background takes histograms"),
        (("bank.h5", "log.npz", *ON_COUNTS, "--unit", "mm"), "--unit goes with images of ranges"),
        (("bank.h5", "log.npz", *ON_TARGETS, "--robust"), "--robust goes with images of ranges"),
        (("bank.h5", "log.npz", *ON_COUNTS, "--plot", "a.png"), "--plot draws ranges"),
        (("bank.h5", "log.npz", *ON_TARGETS, "--valid-status", "5"), "a valid status goes with targets from CSV"),
        (("bank.h5", "log.npz", *FIXED), "match it on histograms"),
    ],
)
def test_what_does_not_go_together_is_refused_in_one_line(
    folder: Path, run: Run, words: tuple[str, ...], problem: str
) -> None:
    bank, log, *rest = words
    code, _, err = run("match", folder / bank, folder / log, *rest)
    assert code in (2, 3)
    assert problem in err
    assert len(err.strip().splitlines()) == 1


def test_a_frame_set_is_matched_view_by_view_or_frame_by_frame(folder: Path, run: Run) -> None:
    plan = {"classes": ("cone",), "views": 2, "distance_m": 1.0, "bearing_deg": 0.0, "frames_per_view": 2}
    for sensor in ("vl53l5cx-8x8", "vl53l5cx-4x4"):
        build_frames(FramePlan(sensor=sensor, histograms=True, **plan), folder / f"{sensor}.h5").close()
    matched = ("match", folder / "bank.h5", folder / "vl53l5cx-8x8.h5", *FIXED, "--json")
    for on, moving, n in (("histograms", (), 2), ("targets", ("--moving",), 4)):
        code, out, _ = run(*matched, "--on", on, *moving)
        assert code == 0
        found = json.loads(out)["matches"]
        assert len(found) == n
        assert {one["class"] for one in found} == {"cone"}
        assert all(abs(one["distance_m"] - 1.0) < 0.01 for one in found)
    code, _, err = run("match", folder / "bank.h5", folder / "vl53l5cx-4x4.h5", *FIXED, "--on", "histograms")
    assert code == 2
    assert "has 4 × 4 zones of 128 bins, and the bank's sensor 8 × 8 of 128" in " ".join(err.split())


def test_a_log_before_a_wall_is_matched_with_the_wall_stated_or_estimated(folder: Path, run: Run) -> None:
    sensor, wall = preset("vl53l5cx-8x8"), Background(wall_m=1.6)
    mean = HistogramRenderer(build_mesh(catalog()["cone"]), sensor).expected(VIEWS, background=wall)
    frames = capture_histograms(mean, sensor, rng=np.random.default_rng(2))
    np.savez(folder / "wall.npz", histogram=frames.zone_counts.astype(int))
    told = ("match", folder / "bank.h5", folder / "wall.npz", *FIXED, "--moving", "--json", "--on", "histograms")
    for words, accepted in ((("--wall", 1.6), True), (("--auto-background",), True), ((), False)):
        code, out, _ = run(*told, *words)
        assert code == 0
        found = json.loads(out)["matches"]
        assert [one["accepted"] for one in found] == [accepted] * 2
        if accepted:
            assert [one["distance_m"] for one in found] == pytest.approx(VIEWS.distance_m.tolist(), abs=0.005)
            assert [one["wall_m"] for one in found] == pytest.approx([1.6, 1.6], abs=0.005)
