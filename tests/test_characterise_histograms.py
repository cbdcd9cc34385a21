"""The data sheet of histograms: counts, merging and ambient light against laws that share no arithmetic with them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from builders import measure_only
from scipy.stats import poisson

from phasemark.cli import main
from phasemark.render import Sensor, characterise, preset
from phasemark.render.bench.data_sheet.results import Characterisation
from phasemark.render.bench.histogram_law import (
    detected,
    found_probability,
    merging_distance_m,
    plane_counts,
    target_counts,
)
from phasemark.render.direct import expected_counts, footprint_grid, plane_samples, range_axis, zone_transients

ZONES = preset("vl53l5cx-4x4")


def changed(sensor: Sensor, **fields: object) -> Sensor:
    return sensor.with_(histogram={**sensor.histogram.model_dump(), **fields})


@pytest.fixture(scope="module")
def sheet() -> Characterisation:
    return characterise(ZONES, rng=np.random.default_rng(5), n_frames=300)


_X = np.arange(-12, 13) * 0.01
UNEVEN = changed(
    ZONES, irf_std_m=None, irf=(tuple(np.exp(-0.5 * (_X / 0.04) ** 2) * (1 + _X)),), irf_start_m=_X[0],
    irf_step_m=0.01, stray=0.1, zone_gain=[[1.0, 0.5, 0.8, 1.0]] * 4, zone_bin_scale=[[1.0, 1.01, 0.99, 1.0]] * 4,
    crosstalk=300.0, crosstalk_range_m=0.1, zone_blur=0.02, light_width=0.3,
).with_(range_offset_m=0.013, vignetting=True)  # fmt: skip


@pytest.mark.parametrize(
    "sensor",
    [*map(preset, ("vl53l5cx-8x8", "vl53l5cx-4x4", "tmf8820-3x3", "tmf8829-16x16")), UNEVEN],
    ids=["8x8", "4x4", "3x3", "16x16", "gain, stray light, offsets and a sampled response"],
)
def test_the_law_of_counts_and_the_simulation_agree_before_a_plane(sensor: Sensor) -> None:
    axis = range_axis(sensor)
    light = zone_transients(plane_samples(0.6, footprint_grid(sensor)), sensor, axis)
    simulated = expected_counts(light, sensor, axis, 0.8)[0]
    predicted = plane_counts(sensor, 0.6, 0.8)
    assert np.abs(simulated - predicted).max() < 1e-3 * predicted.max()  # the bar of histograms


def test_pile_up_of_even_light_falls_geometrically() -> None:
    sensor = changed(ZONES, ambient=0.01, dark=0.0)
    counts = detected(np.zeros(128), sensor)
    cycles = sensor.histogram.cycles
    np.testing.assert_allclose(counts, cycles * (1 - math.exp(-0.01)) * np.exp(-0.01 * np.arange(128)), rtol=1e-12)


def test_the_probability_of_finding_is_that_of_poisson_counts_above_the_threshold() -> None:
    sensor = changed(ZONES, ambient=1e-5, dark=0.0, pile_up=False)
    counts = np.full(128, 20.0)  # the median of Poisson(20) is 20; 20 + 5 √20 = 42.4
    counts[40] = 50.0
    near = (40 + 0.5) * sensor.histogram.bin_width_m
    assert found_probability(counts, sensor, near) == pytest.approx(1 - poisson.cdf(42, 50.0), abs=1e-3)
    assert target_counts(sensor, 0.8, 1.0).argmax() == int(0.8 / sensor.histogram.bin_width_m)


def test_counts_agree_with_the_prediction(sheet: Characterisation) -> None:
    series = sheet.of_figure("histogram")
    assert [one.label for one in series] == ["zone (2, 2)", "zone (0, 0)"]
    figures = {"range_noise", "linearity", "threshold", "histogram", "merging", "ambient"}
    assert {one.figure for one in sheet.comparisons} == figures
    assert all(one.degrees_of_freedom > 20 for one in series)
    assert not sheet.disagreements


def test_a_wrong_prediction_of_counts_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    def brighter(sensor: Sensor, distance_m: float, albedo: float) -> np.ndarray:
        return plane_counts(sensor, distance_m, 1.03 * albedo)

    measure_only(monkeypatch, "direct", "_counts")
    monkeypatch.setattr("phasemark.render.bench.data_sheet.direct.plane_counts", brighter)
    found = characterise(ZONES, rng=np.random.default_rng(5), n_frames=300)
    assert {one.figure for one in found.disagreements} == {"histogram"}


def test_targets_merge_where_the_closed_form_says(sheet: Characterisation, monkeypatch: pytest.MonkeyPatch) -> None:
    measure_only(monkeypatch, "direct", "_merging")
    found = sheet.quantity("merging_distance_m")
    assert found.predicted == merging_distance_m(ZONES) == ZONES.histogram.min_separation_m
    assert abs(found.simulated - found.predicted) < 3 * found.std_error
    free = changed(ZONES, min_separation_m=0.0, photons=0.5, estimator="parabola")
    limit = merging_distance_m(free)
    assert limit == pytest.approx(2 * math.sqrt(0.04**2 + 0.0375**2 / 12))
    bright = characterise(free, rng=np.random.default_rng(5), n_frames=20)
    # bins: a minimum between two peaks needs a bin between them
    assert abs(bright.quantity("merging_distance_m").simulated - limit) < free.histogram.bin_width_m
    alone = characterise(changed(ZONES, max_targets=1), rng=np.random.default_rng(5), n_frames=20)
    assert alone.quantity("merging_distance_m") is None
    assert any("reports one target a zone" in note for note in alone.notes)


def test_range_against_ambient_light_is_that_of_the_threshold(sheet: Characterisation) -> None:
    for one in sheet.of_figure("ambient"):
        assert len(one.x) >= 2
        assert (np.diff(one.predicted) < 0).all()
        # chips take the highest of several bins, and their median scatters: three per cent
        assert np.abs(one.simulated / one.predicted - 1).max() < 0.03 + 3 * (one.std_error / one.predicted).max()


def test_the_command_writes_the_three_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "sheet"
    assert main(["sensor", "characterise", "vl53l5cx-4x4", "--frames", "2", "-o", str(folder)]) == 0
    for name in ("histogram", "merging", "ambient"):
        assert (folder / f"{name}.png").stat().st_size > 10_000
    assert "Where two targets merge" not in capsys.readouterr().err
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "merging" in page.lower()
    assert "modulation_hz" not in page
