"""The fit of a direct sensor to simulated histograms finds the sensor that made them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.simple_scenes import block_on_table, poses_around
from scipy.stats import norm

from phasemark.cli import main
from phasemark.render import Sensor, preset
from phasemark.render.direct.bin_counts import expected_counts
from phasemark.render.direct.fit_crosstalk import fit_crosstalk, peak_shapes
from phasemark.render.direct.fit_sensor import zone_orders
from phasemark.render.direct.footprints import footprint_grid
from phasemark.render.direct.histogram_frames import capture_histograms
from phasemark.render.direct.recordings import support_height, world2cam
from phasemark.render.direct.transients import range_axis, zone_transients
from phasemark.render.integral.scene_samples import SceneMesh, plane_samples

BASE = preset("tmf8820-3x3")
SCALES = ((0.99, 1.015, 1.0), (0.99, 1.0, 1.0), (1.015, 1.0, 1.01))  # by converter, as the preset pairs zones


def true_sensor() -> Sensor:
    """Return a sensor that differs from the preset in all that the fit finds."""
    converters = [0, 1, 1, 2, 2, 3, 3, 4, 4]
    scale = dict(enumerate((1.01, 1.004, 1.0, 1.012, 0.992)))
    scales = np.empty(9)
    scales[list(BASE.histogram.zone_order)] = [scale[k] for k in converters]
    offsets = np.linspace(-0.006, 0.006, 9).reshape(3, 3)
    return BASE.with_(
        half_angle_h_deg=20.0, half_angle_v_deg=18.5, principal_point_px=(1.43, 1.36), roll_deg=1.0,
        zone_offset_m=offsets.tolist(),
        histogram={
            **BASE.histogram.model_dump(), "cycles": 2.6e6, "stray": 0.1,
            "crosstalk": 400.0, "crosstalk_range_m": 0.008,
            "zone_bin_scale": scales.reshape(3, 3).tolist(), "zone_scale": (1.05, 1.1), "zone_blur": 0.025,
        },
    )  # fmt: skip


def write_log(path: Path, counts: np.ndarray, sensor: Sensor, **arrays: Any) -> Path:
    """Write histograms in the order of the chip's log."""
    flat = counts.reshape(len(counts), 9, -1)
    np.savez(path, histogram=flat[:, list(sensor.histogram.zone_order)].astype(np.uint32), **arrays)
    return path


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    sensor, rng = true_sensor(), np.random.default_rng(17)
    axis = range_axis(sensor, longest_m=1.0)
    distances = np.linspace(0.07, 0.4, 41)  # 8.25 mm apart: many places within a bin
    seen = zone_transients(plane_samples(distances, footprint_grid(sensor)), sensor, axis)
    drawn = capture_histograms(expected_counts(seen, sensor, axis, 0.8), sensor, rng=rng)
    write_log(folder / "plane.npz", drawn.counts, sensor, distance_m=distances)
    poses = poses_around(6, seed=3)
    samples = SceneMesh(block_on_table()).samples(world2cam(poses), footprint_grid(sensor))
    seen = zone_transients(samples, sensor, axis)
    drawn = capture_histograms(expected_counts(seen, sensor, axis, (0.5, 0.8)), sensor, rng=rng)
    write_log(folder / "block.npz", drawn.counts, sensor, sensor2world=poses)
    block_on_table().export(folder / "block.stl")
    return folder


def test_the_command_finds_the_sensor_that_made_the_logs(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = logs / "mine.toml"
    block = f"{logs / 'block.npz'},{logs / 'block.stl'}"
    assert main(["sensor", "fit-direct", str(logs / "plane.npz"), "--object", block, "-o", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    fitted, truth = Sensor.from_toml(out), true_sensor()
    # the model of the fit has coarser cells than the one that made the logs, and 5 % of tolerance: not the noise limit
    assert fitted.half_angle_h_deg == pytest.approx(truth.half_angle_h_deg, abs=1.2)
    assert fitted.half_angle_v_deg == pytest.approx(truth.half_angle_v_deg, abs=1.2)
    assert np.abs(np.subtract(fitted.principal_point_px, truth.principal_point_px)).max() < 0.04
    assert fitted.roll_deg == pytest.approx(truth.roll_deg, abs=1.0)
    assert fitted.histogram.cycles == pytest.approx(truth.histogram.cycles, rel=0.05)
    assert fitted.histogram.stray == pytest.approx(truth.histogram.stray, abs=0.02)
    glass = found["crosstalk"]
    assert glass["counts"] == fitted.histogram.crosstalk
    assert glass["counts"] == pytest.approx(400, abs=5 * glass["counts_std"])
    assert glass["counts_std"] < 40
    assert glass["range_m"] == pytest.approx(0.008, abs=3e-3 + 5 * glass["range_std_m"])  # zones' own delays apart
    scale = np.array(fitted.histogram.zone_bin_scale)
    np.testing.assert_allclose(scale, truth.histogram.zone_bin_scale, atol=0.004)
    assert max(found["range_rms_mm"]) < 0.5  # sub-bin wiggles of the spline that stands for the response
    scores = found["zone_orders"]
    assert min(scores, key=scores.get) == "columns, up, right to left"
    assert sorted(scores.values())[1] > 3 * min(scores.values())


def test_a_plane_alone_says_that_it_tells_no_directions(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["sensor", "fit-direct", str(logs / "plane.npz"), "--nearest", "0.2", "-o", str(logs / "plane.toml")]
    assert main(command) == 0
    said = capsys.readouterr()
    assert "a plane does not tell them" in said.err
    assert "range r.m.s. (mm)" in said.out
    assert Sensor.from_toml(logs / "plane.toml").half_angle_h_deg == pytest.approx(BASE.half_angle_h_deg)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["block.npz", "-o", "a.toml"], 2, "must state 'distance_m'"),
        (["plane.npz", "--object", "block.npz", "-o", "a.toml"], 2, "--object must be LOG,MESH"),
        (["plane.npz", "--object", "plane.npz,block.stl", "-o", "a.toml"], 2, "must state 'sensor2world'"),
        (["plane.npz", "-o", "a.json"], 2, "must be a .toml file"),
        (["plane.npz", "--sensor", "pmd-16x16", "-o", "a.toml"], 2, "has no [histogram] table"),
        (["plane.npz", "--nearest", "0.38", "-o", "a.toml"], 2, "a fit needs a plane at 8 distances or more, got 3"),
        (["block.stl", "-o", "a.toml"], 3, "is no JSON object"),
        (["plane.npz", "--sensor", "vl53l5cx-8x8", "-o", "a.toml"], 3, "'histogram' must have shape (n, 64, bins)"),
    ],
)
def test_what_cannot_be_fitted_is_refused_in_one_line(
    logs: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, arguments: list[str], code: int,
    message: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(logs)
    assert main(["sensor", "fit-direct", *arguments]) == code
    said = capsys.readouterr().err.strip()
    assert message in " ".join(said.split())
    assert not Path("a.toml").exists()


def plane_with_crosstalk(counts: float, rng: np.random.Generator) -> tuple[np.ndarray, dict[str, Any]]:
    """Return Poisson counts of a moving peak of a Gaussian response, and of a peak that stays at 5 cm."""
    x = np.arange(-16, 17) / 8
    response: dict[str, Any] = {"cumulative": np.tile(norm.cdf(x / 0.6), (4, 1)), "first": -1.0, "step": 1 / 8}
    widths = np.full(4, 0.02)
    planes = [peak_shapes(**response, range_bins=np.full(4, at), bins=64) for at in np.linspace(12, 40, 60)]
    level = 30 + 20_000 * np.stack(planes) + counts * peak_shapes(**response, range_bins=0.05 / widths, bins=64)
    return rng.poisson(level).astype(float), {**response, "bin_widths_m": widths}


def test_crosstalk_is_found_with_its_standard_deviation() -> None:
    rng = np.random.default_rng(12)
    runs = [fit_crosstalk(*plane_with_crosstalk(60, rng)[:1], **plane_with_crosstalk(0, rng)[1]) for _ in range(60)]
    height = np.array([(one.counts - 60) / one.counts_std for one in runs])
    place = np.array([(one.range_m - 0.05) / one.range_std_m for one in runs])
    for z in (height, place):  # χ² of 60 within 99.9 %
        assert 0.49 * 60 < (z**2).sum() < 1.66 * 60


def test_no_crosstalk_is_told_where_there_is_none_or_none_can_be_seen() -> None:
    rng = np.random.default_rng(13)
    for _ in range(40):
        counts, response = plane_with_crosstalk(0, rng)
        found = fit_crosstalk(counts, **response)
        assert found.counts == 0
        assert found.range_std_m == math.inf
        assert 0 < found.counts_std < 5
    counts, response = plane_with_crosstalk(60, rng)
    assert fit_crosstalk(counts[:, :, 30:], **response).counts == 0  # every histogram begins with the plane


def test_the_support_is_the_largest_level_surface() -> None:
    assert support_height(block_on_table()) == pytest.approx(0.0, abs=1e-9)


def test_a_square_chip_may_log_in_eight_orders_and_others_in_four() -> None:
    orders = zone_orders(3, 3)
    assert len({tuple(order) for order in orders.values()}) == 8
    assert len(zone_orders(2, 3)) == 4
    assert all(sorted(order) == list(range(9)) for order in orders.values())
    assert math.prod(orders["rows"].shape) == 9
