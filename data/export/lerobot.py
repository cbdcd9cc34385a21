"""Frames in LeRobot's layout, version 2.1: an episode a Parquet file, and what is known of all in ``meta/``.

The layout is that of https://github.com/huggingface/lerobot, ``lerobot/common/datasets`` of the version 2.1.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data.export.card import Column, write_card
from phasemark.data.export.samples import truth_columns
from phasemark.data.frames.frame_set_file import FrameSet, Sample, SceneFrameSet
from phasemark.data.measured.reading import RangeOrZ
from phasemark.inputs.extras import needed

VERSION = "v2.1"
CHUNK = 1000
"""Episodes of a folder."""
MOST_EPISODES = 200_000
"""Of an export: each is a file."""
_PATH = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
_INDICES = ("frame_index", "episode_index", "index", "task_index")
_NOT_MEASURED = ("coverage", "shares", "camera2world", "bodies2world", "class_of_body")


def write_lerobot(frames: FrameSet, folder: Path, quantity: RangeOrZ) -> None:
    """Write episodes: a scene's steps, once for each frame of a view; of landmarks the frames of a view."""
    arrow, parquet = (needed(module, "Parquet", "export") for module in ("pyarrow", "pyarrow.parquet"))
    episodes = list(_episodes(frames))
    if len(episodes) > MOST_EPISODES:
        raise UsageError(
            f"LeRobot's layout has a file for each episode, at most {MOST_EPISODES}, and {frames.path} has"
            f" {len(episodes)}: export it with to=webdataset"
        )
    meta = folder / "meta"
    meta.mkdir()
    task = f"scenes of {frames.plan.scenes.generator}" if isinstance(frames, SceneFrameSet) else "landmarks"
    features: dict[str, dict[str, Any]] = {}
    first = 0
    with (
        (meta / "episodes.jsonl").open("w", encoding="utf-8") as listed,
        (meta / "episodes_stats.jsonl").open("w", encoding="utf-8") as stats,
    ):
        for number, (_, numbers) in enumerate(episodes):
            columns = _columns(frames, frames[numbers], number, first)
            features = features or {name: _feature(values) for name, values in columns.items()}
            path = folder / _PATH.format(episode_chunk=number // CHUNK, episode_index=number)
            path.parent.mkdir(parents=True, exist_ok=True)
            parquet.write_table(arrow.table({name: _column(arrow, values) for name, values in columns.items()}), path)
            _line(listed, {"episode_index": number, "tasks": [task], "length": len(numbers)})
            own = {name: _stats(values) for name, values in columns.items() if values.dtype.kind != "U"}
            _line(stats, {"episode_index": number, "stats": own})
            first += len(numbers)
    with (meta / "tasks.jsonl").open("w", encoding="utf-8") as tasks:
        _line(tasks, {"task_index": 0, "task": task})
    rate = float(frames.sensor.frame_rate_hz)
    of_episode = [split for split, _ in episodes]
    first_of = {split: of_episode.index(split) for split in dict.fromkeys(of_episode)}
    info = {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": len(episodes),
        "total_frames": first,
        "total_tasks": 1,
        "total_videos": 0,
        "total_chunks": -(-len(episodes) // CHUNK),
        "chunks_size": CHUNK,
        "fps": int(rate) if rate.is_integer() else rate,
        "splits": {split: f"{k}:{k + of_episode.count(split)}" for split, k in first_of.items()},
        "data_path": _PATH,
        "video_path": None,
        "features": features,
    }
    (meta / "info.json").write_text(json.dumps(info, indent=4, ensure_ascii=False) + "\n", encoding="utf-8")
    files = [{"name": "data/*/*.parquet", "format": "application/x-parquet"}]
    shapes = {name: () if one["shape"] == [1] else tuple(one["shape"]) for name, one in features.items()}
    columns_of_card = [Column(name, one["dtype"], shapes[name]) for name, one in features.items()]
    load = 'LeRobotDataset("phasemark/frames", root="THIS FOLDER")  # or pandas.read_parquet of any episode'
    write_card(frames, folder, "LeRobot", columns_of_card, files, load)


def _episodes(frames: FrameSet) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """Yield split and frames of each episode; those of a split follow one another, as ranges of episodes name them."""
    steps = frames.plan.scenes.steps if isinstance(frames, SceneFrameSet) else 1
    for split in frames.splits:
        scenes = frames.split(split).reshape(-1, steps, frames.plan.frames_per_view)
        episodes = scenes.swapaxes(1, 2).reshape(-1, steps) if isinstance(frames, SceneFrameSet) else scenes[:, 0]
        for numbers in episodes:
            yield split, numbers


def _columns(frames: FrameSet, sample: Sample, episode: int, first: int) -> dict[str, NDArray[Any]]:
    """Return the columns of an episode by their names in LeRobot's layout."""
    n = len(sample["view"])
    columns: dict[str, NDArray[Any]] = {}
    for key in frames.arrays:
        truth = key in _NOT_MEASURED or key.startswith(("range_mixed", "range_hard", "range_shot"))
        columns[f"{'truth' if truth else 'observation'}.{key}"] = sample[key]
    for name, values in truth_columns(frames, sample).items():
        columns[f"label.{name.removeprefix('label_')}" if name.startswith("label_") else f"truth.{name}"] = values
    columns["timestamp"] = (np.arange(n) / frames.sensor.frame_rate_hz).astype(np.float32)
    indices = (np.arange(n), np.full(n, episode), first + np.arange(n), np.zeros(n))
    return columns | {name: values.astype(np.int64) for name, values in zip(_INDICES, indices, strict=True)}


def _feature(values: NDArray[Any]) -> dict[str, Any]:
    """Describe a column as ``meta/info.json`` does: one number or text has the shape (1,)."""
    kind = "string" if values.dtype.kind == "U" else values.dtype.name
    return {"dtype": kind, "shape": list(values.shape[1:]) or [1], "names": None}


def _column(arrow: Any, values: NDArray[Any]) -> Any:
    """Return a column of numbers, or of lists of them as deep as the array."""
    if values.dtype.kind == "U":
        return arrow.array(values.tolist(), arrow.string())
    found = arrow.array(np.ascontiguousarray(values).reshape(-1))
    for axis in range(values.ndim - 1, 0, -1):
        count = int(np.prod(values.shape[:axis]))
        offsets = arrow.array(values.shape[axis] * np.arange(count + 1, dtype=np.int32))
        found = arrow.ListArray.from_arrays(offsets, found)
    return found


def _stats(values: NDArray[Any]) -> dict[str, Any]:
    """Return the statistics of a column over its episode, without NaN; 0 where there is nothing else."""
    given = values.astype(float).reshape(len(values), *(values.shape[1:] or (1,)))
    there = np.isfinite(given)
    n = np.maximum(there.sum(axis=0), 1)
    mean = np.where(there, given, 0.0).sum(axis=0) / n
    std = np.sqrt((np.where(there, given - mean, 0.0) ** 2).sum(axis=0) / n)
    some = there.any(axis=0)
    low = np.where(some, np.where(there, given, np.inf).min(axis=0), 0.0)
    high = np.where(some, np.where(there, given, -np.inf).max(axis=0), 0.0)
    found = {"min": low, "max": high, "mean": mean, "std": std, "count": np.array([len(values)])}
    return {name: array.tolist() for name, array in found.items()}


def _line(file: Any, row: dict[str, Any]) -> None:
    file.write(json.dumps(row, ensure_ascii=False, allow_nan=False) + "\n")
