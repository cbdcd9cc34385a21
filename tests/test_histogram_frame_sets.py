"""Frame sets of direct sensors with histograms: any frame from its number, what is read, and what is exported."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray

from phasemark import InputFileError, UsageError
from phasemark.cli import main
from phasemark.data import FramePlan, build_frames, open_frames, read_frames
from phasemark.data.export import export_frames
from phasemark.data.files import write_checksum
from phasemark.data.frames import FrameSet
from phasemark.data.measured.histogram_logs import is_histogram_log, read_histograms, read_targets
from phasemark.data.plans import planned_size
from phasemark.data.seeds import stream
from phasemark.data.verify import verify_frames
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Views, capture
from phasemark.render.direct import HistogramRenderer, Status, Targets, find_targets

PLAN = FramePlan(
    classes=["cylinder"], sensor="vl53l5cx-8x8", views=4, frames_per_view=2, seed=5,
    distance_m={"uniform": [0.6, 1.0]}, wall_m=1.7, variants=[], splits={"train": 0.5, "test": 0.5},
)  # fmt: skip
LOGGED = PLAN.model_copy(update={"sensor": "tmf8820-3x3", "views": 2})
"""Its zones are logged in an order of their own."""


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("histograms") / "frames.h5"
    build_frames(PLAN, path, workers=1).close()
    return path


@pytest.fixture(scope="module")
def frames(path: Path) -> Iterator[FrameSet]:
    with open_frames(path) as opened:
        yield opened


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FrameSet]:
    with build_frames(LOGGED, tmp_path_factory.mktemp("logged") / "frames.h5", workers=1) as opened:
        yield opened


def test_the_bytes_do_not_depend_on_workers_or_shards(path: Path, tmp_path: Path) -> None:
    build_frames(PLAN, tmp_path / "again.h5", workers=2, shard_items=1).close()
    assert (tmp_path / "again.h5").read_bytes() == path.read_bytes()


def test_any_frame_can_be_made_again_from_its_number_alone(frames: FrameSet) -> None:
    sensor, view = frames.sensor, 3
    truth = {name: values[view] for name, values in frames.truth.items()}
    renderer = HistogramRenderer(build_mesh(catalog()["cylinder"]), sensor, albedo=float(truth["albedo"]))
    seen = Views.broadcast(truth["distance_m"], truth["delta_rad"])
    images = renderer.render_views(seen, background=Background(wall_m=1.7))
    rng = stream(PLAN.seed, "frames.noise", 0)
    one = capture(images, sensor, rng=rng, first_view=view, first_frame=1)
    np.testing.assert_array_equal(frames[view * 2 + 1]["histogram"], one.counts[0, 0])


def test_targets_are_those_of_the_histograms_and_range_is_that_of_the_nearest(frames: FrameSet) -> None:
    sample = frames[:]
    assert sample["histogram"].dtype == np.uint32
    assert sample["histogram"].shape == (8, 8, 8, 128)
    found = find_targets(frames.histograms())
    np.testing.assert_array_equal(sample["target_status"], found.status[:, 0])
    np.testing.assert_array_equal(sample["target_distance_m"], found.distance_m[:, 0].astype(np.float32))
    for one, other in zip(frames.targets([2, 5]), found, strict=True):
        np.testing.assert_array_equal(one, np.asarray(other)[[2, 5]].astype(np.float32))
    z_m = sample["range_m"] * frames.sensor.axis_cosine()
    np.testing.assert_allclose(z_m, sample["target_distance_m"][..., 0], rtol=1e-6)
    np.testing.assert_array_equal(sample["flags"] == 0, sample["target_status"][..., 0] == Status.VALID)
    assert frames.frames([1]).range_m.shape == (1, 1, 8, 8)
    assert frames.info()["bins"] == 128


def test_datasets_say_what_they_are(path: Path) -> None:
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        histogram, distance = data["histogram"], data["target_distance"]
        assert histogram.dims == ("frame", "row", "col", "bin")
        assert distance.dims == ("frame", "row", "col", "target")
        assert (distance.attrs["units"], distance.attrs["quantity"]) == ("m", "z")
        assert data["target_status"].attrs["flag_meanings"] == "valid no_target"
        assert data["bin"].attrs["units"] == "m"
        np.testing.assert_allclose(data["bin"][:2], [0.01875, 0.05625])
        assert all(data[name].attrs["long_name"] for name in ("histogram", "target_sigma", "target_signal", "bin"))


def test_without_histograms_a_plan_makes_the_ranges_it_made_before(tmp_path: Path) -> None:
    plain = PLAN.model_copy(update={"histograms": False})
    with build_frames(plain, tmp_path / "plain.h5", workers=1) as opened:
        assert opened.info()["fields"] == ["range", "flags", "coverage"]
        with pytest.raises(UsageError, match="holds no histograms: build it without 'histograms = false'"):
            opened.histograms()
        with pytest.raises(UsageError, match="holds no histograms"):
            export_frames(opened, tmp_path / "a.jsonl", "jsonl")
    assert planned_size(plain)["bytes"] < 0.02 * planned_size(PLAN)["bytes"]


def test_a_file_from_before_histograms_is_read_and_verified_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "old.h5"
    build_frames(PLAN.model_copy(update={"histograms": False}), path, workers=1).close()
    with h5py.File(path, "r+") as file:
        plan = json.loads(file.attrs["plan"])
        assert plan.pop("histograms") is False
        file.attrs["plan"] = json.dumps(plan)
    (tmp_path / "old.h5.sha256").unlink()
    with open_frames(path) as opened:
        assert opened.holds_histograms is False
        assert len(opened.frames()) == 8


def test_a_phase_cameras_plan_is_written_as_before(tmp_path: Path) -> None:
    resolved = FramePlan(classes=["cone"], views=1).resolve()
    assert "histograms" not in resolved.model_dump(mode="json")
    assert PLAN.resolve().resolve() == PLAN.resolve()
    assert PLAN.resolve().histograms is True


def test_verify_finds_a_count_that_was_changed(path: Path, tmp_path: Path) -> None:
    assert verify_frames(path, sample=2)["rendered_again"] == 2
    copy = tmp_path / "changed.h5"
    shutil.copyfile(path, copy)
    with h5py.File(copy, "r+") as file:
        file["histogram"][:, 3, 3] = 7
    write_checksum(copy)
    with pytest.raises(InputFileError, match="'histogram' of item"):
        verify_frames(copy, sample=4)


def test_saturated_counts_in_a_file_are_refused_when_they_are_read(path: Path, tmp_path: Path) -> None:
    copy = tmp_path / "full.h5"
    shutil.copyfile(path, copy)
    with h5py.File(copy, "r+") as file:
        file["histogram"][2, 3, 3, 9] = 3_000_000
    with (
        open_frames(copy) as opened,
        pytest.raises(InputFileError, match=r"'histogram' must have fewer than 2e\+06 counts in a zone, got 300"),
    ):
        opened[2]


def same_targets(one: Targets, other: Targets) -> None:
    for name in Targets._fields:
        a, b = (getattr(each, name) for each in (one, other))
        np.testing.assert_allclose(a.reshape(b.shape), b, rtol=3e-7, err_msg=name)  # float32 in the file


@pytest.mark.parametrize("which", ["frames", "logged"])
@pytest.mark.parametrize("to", ["npz", "jsonl"])
def test_exported_histograms_come_back_bit_for_bit(
    which: str, to: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    made: FrameSet = request.getfixturevalue(which)
    path = export_frames(made, tmp_path / f"out.{to}", to, content="histogram")
    back = read_histograms(path, sensor=made.sensor)
    np.testing.assert_array_equal(back.frames.counts, made.histograms().counts)
    np.testing.assert_allclose(back.frames.time_s[:, 0], np.arange(len(made)) / made.sensor.frame_rate_hz)
    assert back.distance_m is None  # the truth's distance is that of the landmark
    assert is_histogram_log(path)


@pytest.mark.parametrize("which", ["frames", "logged"])
def test_exported_targets_come_back(which: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    made: FrameSet = request.getfixturevalue(which)
    path = export_frames(made, tmp_path / "targets.csv", "csv", content="targets")
    same_targets(read_targets(path, sensor=made.sensor), made.targets())


def test_npz_holds_ranges_targets_and_histograms_at_once(frames: FrameSet, tmp_path: Path) -> None:
    path = export_frames(frames, tmp_path / "all.npz", "npz")
    found = np.load(path)
    assert {"range", "flags", "histogram", "t_s", "target_distance", "target_status", "class"} <= set(found)
    assert str(found["target_quantity"]) == "z"
    np.testing.assert_array_equal(found["target_distance"], frames[:]["target_distance_m"])
    back = read_frames(path, sensor=frames.sensor)
    np.testing.assert_allclose(back.range_m[0], frames[:]["range_m"], rtol=1e-6)
    assert not is_histogram_log(path)


@pytest.mark.parametrize("to", ["csv", "png16", "ply", "bop"])
def test_formats_of_ranges_hold_the_range_of_the_nearest_target(frames: FrameSet, to: str, tmp_path: Path) -> None:
    path = export_frames(frames, tmp_path / "out", to)
    if to == "csv":
        np.testing.assert_allclose(read_frames(path, sensor=frames.sensor).range_m[0], frames[:]["range_m"], rtol=1e-8)
    else:
        assert any(path.iterdir())


REFUSED: list[tuple[str, dict[str, Any], str]] = [
    ("csv", {"content": "histogram"}, "content=histogram must go to npz or jsonl, which can hold it, got 'csv'"),
    ("png16", {"content": "targets"}, "content=targets must go to npz or csv, which can hold it, got 'png16'"),
    ("rosbag", {"content": "histogram"}, "content=histogram must go to npz or jsonl"),
    ("jsonl", {"content": "range"}, "content=range must go to npz or csv or png16 or ply or bop or rosbag"),
    ("csv", {"content": "targets", "quantity": "range"}, "must be left out of targets: the chip reports z"),
    ("jsonl", {"quantity": "range"}, "must be left out of histogram: counts are neither range nor z"),
]


@pytest.mark.parametrize(("to", "options", "message"), REFUSED)
def test_what_a_format_cannot_hold_is_refused_in_one_line(
    frames: FrameSet, to: str, options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        export_frames(frames, tmp_path / "out", to, **options)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_commands_show_export_and_refuse(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.jsonl"
    assert main(["frames", "show", str(path), "--index", "3", "-o", str(tmp_path / "a.png")]) == 0
    assert main(["frames", "export", str(path), "--to", "jsonl", "-o", str(out)]) == 0
    show = ["frames", "show", str(out), "--sensor", "vl53l5cx-8x8", "-o", str(tmp_path / "b.png")]
    assert main([*show, "--index", "7"]) == 0
    assert (tmp_path / "a.png").stat().st_size > 10_000
    capsys.readouterr()
    assert main([*show, "--index", "8", "--force"]) == 2
    assert "--index must be below 8" in capsys.readouterr().err
    assert (
        main(["frames", "export", str(path), "--to", "ply", "--content", "histogram", "-o", str(tmp_path / "c")]) == 2
    )
    assert "error: --content histogram must go to npz or jsonl" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bins": 64}, "the histograms have 64 bins, but the sensor has 128"),
        ({"negative": True}, "counts must not be negative, position 1, frame 0, row 0, column 2, bin 5 has -1"),
        ({"saturated": True}, "a histogram is saturated: position 2, frame 0, row 7, column 7 has"),
    ],
)
def test_a_log_that_cannot_be_of_the_sensor_is_one_line_and_exit_code_3(
    change: dict[str, Any], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    counts = np.full((3, 64, change.get("bins", 128)), 4)
    if "negative" in change:
        counts[1, 2, 5] = -1
    if "saturated" in change:
        counts[2, 63, 9] = 5_000_000
    np.savez(tmp_path / "log.npz", histogram=counts)
    show = ["frames", "show", str(tmp_path / "log.npz"), "--sensor", "vl53l5cx-8x8", "-o", str(tmp_path / "a.png")]
    assert main(show) == 3
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "a.png").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('sensor = "vl53l5cx-8x8"\nkeep_taps = true', "'keep_taps' and the variant 'shot' must be left out"),
        ('sensor = "vl53l5cx-8x8"\nvariants = ["shot"]', "'keep_taps' and the variant 'shot' must be left out"),
        ('sensor = "pmd-16x16"\nhistograms = true', r"'histograms' must be left out: the sensor has no [histogram]"),
        ('sensor = "vl53l5cx-8x8"\nhistograms = 3', "'histograms' must be"),
        (
            'sensor = "vl53l5cx-8x8"\n[sensor_overrides.histogram]\nbins = 8\nbin_width_m = 0.01\ncycles = 1e5\n'
            "photons = 0.1\nirf_std_m = 0.4",
            "'irf_std_m' must describe a response narrower than the histogram of 8 x 0.01 m",
        ),
    ],
)
def test_options_of_the_other_kind_of_sensor_are_one_line_and_exit_code_2(
    text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(f'classes = ["cone"]\nviews = 1\n{text}\n', encoding="utf-8")
    assert main(["frames", "build", str(plan), "-o", str(tmp_path / "a.h5")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "a.h5").exists()
