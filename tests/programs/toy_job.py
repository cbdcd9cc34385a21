"""A job whose items cost nothing to make: two slabs, with values that say where they belong."""

import time

import h5py
import numpy as np

from phasemark.data.files.hdf5_layout import Layout
from phasemark.data.shards.build import Place

WIDTH = 25_000  # an item's 100 kB are more than a page of the layout


class ToyJob:
    """The file of this job is known in full: item i of slab s is 1000 · s + i + 0.5 throughout."""

    def __init__(self, items=(5, 3), mark=0, seconds=0.0):
        self.items, self.mark, self.seconds = list(items), mark, seconds

    def spec(self):
        return {"kind": "toy"}

    def identity(self):
        return {"plan": {"items": self.items, "mark": self.mark}, "versions": {}, "mesh_sha256": {}}

    def lay_out(self):
        places = []
        with Layout() as layout:
            layout.file.attrs["mark"] = self.mark
            for slab, n in enumerate(self.items):
                _, offset = layout.reserve(layout.file, f"slab{slab}", (n, WIDTH), "<f4")
                places.append([Place(offset, WIDTH * 4)])
        return layout, places

    def make(self, slab, start, stop):
        time.sleep(self.seconds * (stop - start))
        return [np.repeat(1000.0 * slab + np.arange(start, stop) + 0.5, WIDTH).astype("<f4").reshape(-1, WIDTH)]


def check_toy_file(path, items=(5, 3)):
    """Assert that a file is the whole toy file."""
    with h5py.File(path) as file:
        for slab, n in enumerate(items):
            expected = 1000.0 * slab + np.arange(n) + 0.5
            assert np.array_equal(file[f"slab{slab}"][...], np.repeat(expected, WIDTH).reshape(n, WIDTH))
