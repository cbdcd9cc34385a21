"""A job whose items cost nothing to make: two slabs, with values that say where they belong."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from phasemark.data.files.hdf5_layout import Layout
from phasemark.data.shards.build import Place

WIDTH = 25_000  # an item's 100 kB are more than a page of the layout


class ToyJob:
    """The file of this job is known in full: item i of slab s is 1000 · s + i + 0.5 throughout."""

    maker = "programs.toy_job:from_spec"

    def __init__(self, items: Sequence[int] = (5, 3), mark: int = 0, seconds: float = 0.0) -> None:
        self.items, self.mark, self.seconds = list(items), mark, seconds

    def spec(self) -> dict[str, Any]:
        return {"items": self.items, "mark": self.mark, "seconds": self.seconds}

    def identity(self) -> dict[str, Any]:
        return {"plan": {"items": self.items, "mark": self.mark}, "versions": {}, "mesh_sha256": {}}

    def lay_out(self) -> tuple[Layout, list[list[Place]]]:
        places = []
        with Layout() as layout:
            layout.file.attrs["mark"] = self.mark
            for slab, n in enumerate(self.items):
                _, offset = layout.reserve(layout.file, f"slab{slab}", (n, WIDTH), "<f4")
                places.append([Place(offset, WIDTH * 4)])
        return layout, places

    def make(self, slab: int, start: int, stop: int) -> list[NDArray[Any]]:
        time.sleep(self.seconds * (stop - start))
        return [np.repeat(1000.0 * slab + np.arange(start, stop) + 0.5, WIDTH).astype("<f4").reshape(-1, WIDTH)]


def from_spec(spec: dict[str, Any]) -> ToyJob:
    return ToyJob(**spec)


def check_toy_file(path: Path, items: Sequence[int] = (5, 3)) -> None:
    """Assert that a file is the whole toy file."""
    with h5py.File(path) as file:
        for slab, n in enumerate(items):
            expected = 1000.0 * slab + np.arange(n) + 0.5
            assert np.array_equal(file[f"slab{slab}"][...], np.repeat(expected, WIDTH).reshape(n, WIDTH))
