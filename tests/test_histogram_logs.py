"""Logs of direct sensors: what is read back, and what is refused in one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from phasemark import InputFileError, UsageError
from phasemark.data.measured.histogram_logs import read_histograms, read_targets
from phasemark.render import preset
from phasemark.render.direct.targets import Status

TMF = preset("tmf8820-3x3")
RNG = np.random.default_rng(3)
COUNTS = RNG.poisson(40, (5, 9, 128)).astype(np.uint32)


def write_npz(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


def test_zones_of_a_log_come_to_their_place_in_the_image(tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[2, 3] = 0
    path = write_npz(tmp_path / "a.npz", histogram=COUNTS, sensor2world=poses, t_ms=np.arange(5) * 100.0, other=poses)
    log = read_histograms(path, sensor=TMF)
    for zone, place in enumerate(TMF.histogram.zone_order):
        assert (log.frames.counts[:, 0, place // 3, place % 3] == COUNTS[:, zone]).all()
    assert (log.sensor2world[:, 3] == [0, 0, 0, 1]).all()
    np.testing.assert_allclose(log.frames.time_s[:, 0], np.arange(5) * 0.1)


def test_lines_of_json_hold_what_npz_does(tmp_path: Path) -> None:
    reference = RNG.poisson(5, (5, 128))
    distance = np.linspace(0.1, 0.3, 5)
    lines = [
        json.dumps({"histogram": h.tolist(), "reference_histogram": r.tolist(), "distance_m": d})
        for h, r, d in zip(COUNTS, reference, distance, strict=True)
    ]
    path = tmp_path / "a.jsonl"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    got = read_histograms(path, sensor=TMF)
    want = read_histograms(
        write_npz(tmp_path / "a.npz", histogram=COUNTS, reference_histogram=reference, distance_m=distance), sensor=TMF
    )
    assert (got.frames.counts == want.frames.counts).all()
    assert (got.frames.reference == want.frames.reference).all()
    assert (got.distance_m == want.distance_m).all()


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"histogram": COUNTS[:, :, :64]}, "the histograms have 64 bins, but the sensor has 128"),
        ({"histogram": COUNTS[:, :4]}, r"'histogram' must have shape \(n, 9, bins\), got \(5, 4, 128\)"),
        ({"histogram": -COUNTS.astype(int)}, "counts must not be negative, position 0, frame 0, row"),
        ({"histogram": COUNTS.astype(np.int64) * 10**6}, "a histogram is saturated: position 0"),
        ({"counts": COUNTS}, "must have 'histogram', got nothing"),
        ({"histogram": COUNTS, "distance_m": np.ones(4)}, r"'distance_m' must have shape \(5,\), got \(4,\)"),
        ({"histogram": COUNTS.astype("U4")}, "'histogram' must hold numbers"),
    ],
)
def test_a_log_that_cannot_be_is_refused_in_one_line(tmp_path: Path, arrays: dict[str, Any], message: str) -> None:
    path = write_npz(tmp_path / "a.npz", **arrays)
    with pytest.raises(InputFileError, match=message) as error:
        read_histograms(path, sensor=TMF)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no frame"),
        ("[1, 2]", "line 1 is no JSON object"),
        ('{"histogram": [[1, 2], [3]]}', "frame 0: 'histogram' must be numbers in rows of one length"),
        ('{"histogram": [[1]]}\n{"other": 1}', "frame 1 has no 'histogram', the first one has"),
        ('{"histogram": [[1]]}\n{"histogram": [[1, 2]]}', "frame 1: 'histogram' has shape"),
        ('{"histogram": ', "line 1 is no JSON object"),
    ],
)
def test_lines_that_are_no_log_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "a.jsonl"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputFileError, match=message):
        read_histograms(path, sensor=TMF)


def test_a_damaged_archive_is_refused(tmp_path: Path) -> None:
    path = write_npz(tmp_path / "a.npz", histogram=COUNTS)
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(InputFileError, match="not an NPZ file that can be read"):
        read_histograms(path, sensor=TMF)


def test_a_sensor_without_histograms_cannot_read_any(tmp_path: Path) -> None:
    path = write_npz(tmp_path / "a.npz", histogram=np.ones((1, 256, 128)))
    with pytest.raises(UsageError, match=r"no \[histogram\] table"):
        read_histograms(path, sensor=preset("pmd-16x16"))


def test_several_targets_a_zone_are_read_with_their_status(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(
        "t_ms,mm_0_0,status_0_0,mm_0_1,status_0_1,mm_8_0,status_8_0\n0,500,5,900,4,,255\n", encoding="utf-8"
    )
    found = read_targets(path, sensor=TMF, valid_status=(5,))
    assert found.distance_m.shape == (1, 1, 3, 3, 2)
    assert found.distance_m[0, 0, 2, 2, 0] == 0.5  # zone 0 is logged first and stands bottom right
    assert (found.status[0, 0, 2, 2] == [Status.VALID, Status.NO_TARGET]).all()
    assert np.isnan(found.distance_m[0, 0, 0, 0]).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mm_0_0\n", "must have a header and at least one frame"),
        ("a,b\n1,2\n", "must have columns mm_0_0"),
        ("mm_9_0\n1\n", "column 'mm_9_0' is beyond 9 zones"),
        ("mm_0_0,mm_1_0\n1\n", "frame 0 has 1 cells, the header 2"),
        ("mm_0_0\nx\n", "frame 0, column 'mm_0_0': 'x' is no number"),
        ("mm_0_0,mm_3_0\n500,500\n", "has columns of 4 zones, but the sensor has 9"),
        ("mm_8_0,mm_8_0\n500,500\n", "names the column 'mm_8_0' twice"),
        ("mm_0_0,mm_8_0,status_8_0\n500,500,5\n", "has no 'status_0_0', but others"),
        ("# unit=mm quantity=z\nmm_8_0\n500\n", "must have quantity=range, as the sensor reports it, got z"),
        ("mm_8_0\n0.5\n", "every range is below 0.01 m; is its unit, mm, right"),
    ],
)
def test_tables_of_targets_that_cannot_be_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputFileError, match=message):
        read_targets(path, sensor=TMF)
