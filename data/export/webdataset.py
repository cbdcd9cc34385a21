"""Frames as shards of a WebDataset: tar files in which neighbours of one name are a sample."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.data.export.card import Column, write_card
from phasemark.data.export.samples import BLOCK, truth_rows
from phasemark.data.frames.frame_set_file import FrameSet, Sample
from phasemark.data.measured.reading import RangeOrZ
from phasemark.data.measured.recording import npz_bytes
from phasemark.inputs import sha256_of

SAMPLES = 4096
"""Most samples of a shard."""


def write_webdataset(frames: FrameSet, folder: Path, quantity: RangeOrZ) -> None:
    """Write ``SPLIT-NNNNNN.tar``: of each frame its arrays as ``NNNNNNNN.npz``, and its truth as ``NNNNNNNN.json``.

    Nothing of a tar file depends on when or by whom it was written.
    """
    files = []
    for split in frames.splits:
        numbers = frames.split(split)
        for shard, start in enumerate(range(0, len(numbers), SAMPLES)):
            path = folder / f"{split}-{shard:06d}.tar"
            with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
                for number, arrays, truth in _samples(frames, numbers[start : start + SAMPLES]):
                    _add(tar, f"{number:08d}.npz", npz_bytes(arrays))
                    _add(tar, f"{number:08d}.json", (json.dumps(truth, ensure_ascii=False) + "\n").encode())
            files.append({"name": path.name, "format": "application/x-tar", "sha256": sha256_of(path)})
    sample = frames[:1]
    columns = [Column(key, sample[key].dtype.name, sample[key].shape[1:]) for key in frames.arrays]
    load = 'webdataset.WebDataset("train-000000.tar").decode()  # {"__key__", "npz": arrays, "json": truth}'
    write_card(frames, folder, "WebDataset", columns, files, load)


def _samples(frames: FrameSet, numbers: NDArray[np.int64]) -> Iterator[tuple[int, Sample, dict[str, Any]]]:
    """Yield number, arrays and truth of frames."""
    for start in range(0, len(numbers), BLOCK):
        chosen = numbers[start : start + BLOCK]
        sample = frames[chosen]
        for k, truth in enumerate(truth_rows(frames, sample)):
            yield int(chosen[k]), {key: sample[key][k] for key in frames.arrays}, {"frame": int(chosen[k]), **truth}


def _add(tar: tarfile.TarFile, name: str, content: bytes) -> None:
    member = tarfile.TarInfo(name)
    member.size = len(content)
    tar.addfile(member, io.BytesIO(content))
