"""Exports for learning: WebDataset's shards and LeRobot's layout hold what the frame set holds, with a valid card."""

from __future__ import annotations

import io
import json
import sys
import tarfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

from phasemark import UsageError
from phasemark.data import FramePlan, build_frames
from phasemark.data.export import export_frames
from phasemark.data.frames import FrameSet
from phasemark.data.plans import SceneFramesPlan

PLAN = SceneFramesPlan(
    scenes={"generator": "own_generators:drive", "n": 6, "steps": 3, "bodies": 2, "classes": ["ball", "wall"]},
    frames_per_view=2,
    seed=5,
    splits={"train": 0.5, "test": 0.5},
)


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FrameSet]:
    with build_frames(PLAN, tmp_path_factory.mktemp("drive") / "drive.h5", workers=1) as opened:
        yield opened


@pytest.fixture(scope="module")
def lerobot(frames: FrameSet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_frames(frames, tmp_path_factory.mktemp("lerobot") / "set", "lerobot")


def lines_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def test_a_shard_has_arrays_and_truth_of_its_split(frames: FrameSet, tmp_path: Path) -> None:
    folder = export_frames(frames, tmp_path / "set", "webdataset")
    seen = []
    for split in frames.splits:
        with tarfile.open(folder / f"{split}-000000.tar") as tar:
            members = tar.getmembers()
            assert {(member.mtime, member.uid, member.uname) for member in members} == {(0, 0, "")}
            for arrays, truth in zip(members[::2], members[1::2], strict=True):
                number = int(arrays.name.removesuffix(".npz"))
                seen.append(number)
                sample = frames[number]
                found = np.load(io.BytesIO(tar.extractfile(arrays).read()))
                assert set(found) == set(frames.arrays)
                for name, values in found.items():
                    np.testing.assert_array_equal(values, sample[name])
                told = json.loads(tar.extractfile(truth).read())
                assert told["label_way_m"] == sample["label_way_m"]
                assert (told["label_towards"], told["split"], told["frame"]) == ("wall", split, number)
    assert sorted(seen) == list(range(len(frames)))


def test_webdataset_reads_a_shard(frames: FrameSet, tmp_path: Path) -> None:
    folder = export_frames(frames, tmp_path / "set", "webdataset")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of other people's packages
        import webdataset

        found = list(webdataset.WebDataset(str(folder / "train-000000.tar"), shardshuffle=False).decode())
    assert [int(one["__key__"]) for one in found] == frames.split("train").tolist()
    np.testing.assert_array_equal(found[0]["npz"]["range_m"], frames[int(found[0]["__key__"])]["range_m"])


def test_an_episode_is_a_sequence_and_each_of_its_frames_a_step(frames: FrameSet, lerobot: Path) -> None:
    info = json.loads((lerobot / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v2.1"
    assert (info["total_episodes"], info["total_frames"], info["fps"]) == (12, 36, frames.sensor.frame_rate_hz)
    n_train = int((frames.truth["split_index"] == 0).sum()) // 3 * 2
    assert info["splits"] == {"train": f"0:{n_train}", "test": f"{n_train}:12"}
    index = 0
    for episode in range(12):
        path = lerobot / info["data_path"].format(episode_chunk=0, episode_index=episode)
        rows = parquet.read_table(path).to_pylist()
        assert set(rows[0]) == set(info["features"])
        assert [row["truth.step"] for row in rows] == [0, 1, 2]
        assert [row["index"] for row in rows] == [index, index + 1, index + 2]
        index += 3
        np.testing.assert_allclose([row["timestamp"] * info["fps"] for row in rows], [0, 1, 2], atol=1e-6)  # float32
        assert [row["label.way_m"] for row in rows] == [0.0, 0.1, 0.2]
        assert {row["label.towards"] for row in rows} == {"wall"}
        assert {row["truth.split"] for row in rows} == {"train" if episode < n_train else "test"}
        views = [3 * row["truth.sequence"] + row["truth.step"] for row in rows]
        stored = np.array([row["observation.range_m"] for row in rows], "f4")
        twins = frames[[2 * view + episode % 2 for view in views]]
        np.testing.assert_array_equal(stored, twins["range_m"])
        np.testing.assert_array_equal([row["truth.bodies2world"] for row in rows], twins["bodies2world"])
        np.testing.assert_array_equal(np.array([row["truth.shares"] for row in rows], "f4"), twins["shares"])
    for name, feature in info["features"].items():
        assert (feature["dtype"] == "string") == isinstance(rows[0][name], str)
        assert list(np.shape(rows[0][name]) or (1,)) == feature["shape"]


def test_statistics_of_an_episode_are_those_of_its_columns(lerobot: Path) -> None:
    episodes = lines_of(lerobot / "meta" / "episodes.jsonl")
    stats = lines_of(lerobot / "meta" / "episodes_stats.jsonl")
    assert [row["length"] for row in episodes] == [3] * 12
    assert lines_of(lerobot / "meta" / "tasks.jsonl")[0]["task"] == episodes[0]["tasks"][0]
    own = stats[4]["stats"]
    np.testing.assert_allclose([own["label.way_m"][name] for name in ("min", "max", "mean")], [[0.0], [0.2], [0.1]])
    np.testing.assert_allclose(own["label.way_m"]["std"], [np.sqrt(2 / 3) * 0.1])
    assert own["label.way_m"]["count"] == [3]
    assert np.shape(own["observation.range_m"]["mean"]) == (16, 16)
    assert "label.towards" not in own  # text has none


def test_the_card_is_valid_croissant_and_its_records_are_the_frames(
    frames: FrameSet, lerobot: Path, tmp_path: Path
) -> None:
    shards = export_frames(frames, tmp_path / "set", "webdataset")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of other people's packages
        import mlcroissant

        for folder in (lerobot, shards):
            assert mlcroissant.Dataset(folder / "croissant.json").metadata.issues.errors == set()
        records = list(mlcroissant.Dataset(lerobot / "croissant.json").records("frames"))
    assert len(records) == len(frames)
    assert np.shape(records[0]["frames/observation.range_m"]) == (16, 16)
    card = (lerobot / "README.md").read_text(encoding="utf-8")
    assert "| `label.way_m` | float64 | 1 |" in card
    assert '"seed": 5' in card


def test_landmarks_are_exported_too(tmp_path: Path) -> None:
    plan = FramePlan(classes=["cone"], views=2, frames_per_view=3, distance_m=1.0, variants=["mixed"])
    with build_frames(plan, tmp_path / "cone.h5", workers=1) as found:
        folder = export_frames(found, tmp_path / "set", "lerobot")
        rows = parquet.read_table(folder / "data" / "chunk-000" / "episode_000001.parquet").to_pylist()
        assert [row["truth.class"] for row in rows] == ["cone"] * 3
        assert [row["truth.distance_m"] for row in rows] == [1.0] * 3
        with tarfile.open(export_frames(found, tmp_path / "shards", "webdataset") / "train-000000.tar") as tar:
            assert len(tar.getnames()) == 2 * len(found.split("train"))


def test_no_content_can_be_asked_of_formats_that_hold_all(frames: FrameSet, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="content=range must go to npz or csv or png16"):
        export_frames(frames, tmp_path / "set", "lerobot", content="range")
    with pytest.raises(UsageError, match="quantity=… must be range for webdataset, got 'z'"):
        export_frames(frames, tmp_path / "set", "webdataset", quantity="z")


def test_parquet_without_its_package_says_how_to_install_it(
    frames: FrameSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match=r"pip install -e '.\[export\]'"):
        export_frames(frames, tmp_path / "set", "lerobot")
    assert not (tmp_path / "set").exists()


def test_more_episodes_than_files_are_refused(
    frames: FrameSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("phasemark.data.export.lerobot.MOST_EPISODES", 11)
    with pytest.raises(UsageError, match=r"at most 11, and .* has 12: export it with to=webdataset"):
        export_frames(frames, tmp_path / "set", "lerobot")
