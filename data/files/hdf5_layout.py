"""HDF5 files laid out in memory and written by plain writes, large arrays one block at a time.

HDF5 crashes the process when the disk fills under an open file. Here it never touches the disk: it lays the file out in
sparse memory, with room for the large arrays but not their content, and every byte on disk is written by
:func:`os.pwrite`, whose errors are ordinary exceptions. Memory does not grow with the file.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Iterator, Sequence
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import DTypeLike, NDArray

_PAGE_BYTES = 1 << 16


class SparseMemory(io.RawIOBase):
    """A file in memory that only holds the pages that were written; what was never written reads as zero."""

    def __init__(self) -> None:
        self._pages: dict[int, bytearray] = {}
        self._position = 0
        self._size = 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a position, beyond the end if need be."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}[whence]
        self._position = start + offset
        return self._position

    def truncate(self, size: int | None = None) -> int:
        """Set the size."""
        self._size = self._position if size is None else size
        return self._size

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Read from the position on and return how many bytes there were."""
        view = memoryview(buffer).cast("B")
        view = view[: max(0, self._size - self._position)]
        for page, of_page, of_view in self._spans(len(view)):
            held = self._pages.get(page)
            view[of_view] = bytes(of_page.stop - of_page.start) if held is None else held[of_page]
        self._position += len(view)
        return len(view)

    def write(self, data: memoryview) -> int:  # type: ignore[override]
        """Write at the position and return the number of bytes."""
        view = memoryview(data).cast("B")
        for page, of_page, of_view in self._spans(len(view)):
            self._pages.setdefault(page, bytearray(_PAGE_BYTES))[of_page] = view[of_view]
        self._position += len(view)
        self._size = max(self._size, self._position)
        return len(view)

    def _spans(self, length: int) -> Iterator[tuple[int, slice, slice]]:
        """Yield the pages of the next bytes, with their places in the page and among these bytes."""
        done = 0
        while done < length:
            page, start = divmod(self._position + done, _PAGE_BYTES)
            count = min(length - done, _PAGE_BYTES - start)
            yield page, slice(start, start + count), slice(done, done + count)
            done += count

    def __len__(self) -> int:
        return self._size

    def pages(self) -> list[tuple[int, memoryview]]:
        """Return offset and content of every page that was written."""
        starts = sorted(page * _PAGE_BYTES for page in self._pages)
        return [(at, memoryview(self._pages[at // _PAGE_BYTES])[: self._size - at]) for at in starts if at < self._size]


class Layout:
    """An HDF5 file under construction; a context manager that closes it.

    Attributes
    ----------
    file : h5py.File
        Takes groups, attributes and small datasets in the usual way.
    """

    def __init__(self) -> None:
        self._memory = SparseMemory()
        self._reserved: list[tuple[int, int]] = []
        self.file = h5py.File(self._memory, "w")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.file.close()

    def reserve(self, group: h5py.Group, name: str, shape: Sequence[int], dtype: DTypeLike) -> tuple[h5py.Dataset, int]:
        """Make a contiguous dataset whose content is placed later; return it and the offset of its first byte."""
        creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        creation.set_layout(h5py.h5d.CONTIGUOUS)
        creation.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
        creation.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        creation.set_obj_track_times(False)
        space = h5py.h5s.create_simple(tuple(shape))
        dataset = h5py.h5d.create(group.id, name.encode(), h5py.h5t.py_create(np.dtype(dtype)), space, creation)
        offset = int(dataset.get_offset())
        self._reserved.append((offset, offset + int(np.prod(shape)) * np.dtype(dtype).itemsize))
        return h5py.Dataset(dataset), offset

    @property
    def size(self) -> int:
        """Bytes of the whole file, once it is closed."""
        return len(self._memory)

    def sha256(self) -> str:
        """Return the SHA-256 of all but the reserved arrays, once the file is closed."""
        digest = hashlib.sha256()
        for offset, page in self._memory.pages():
            digest.update(offset.to_bytes(8, "little"))
            digest.update(page)
        return digest.hexdigest()

    def write_to(self, descriptor: int) -> None:
        """Claim the whole file's space on disk and write all but the reserved arrays, once the file is closed.

        What an earlier run has placed in the reserved arrays stays as it is.

        Raises
        ------
        OSError
            The disk has no room for the whole file, or fails.
        """
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(descriptor, 0, len(self._memory))
        os.ftruncate(descriptor, len(self._memory))
        for offset, page in self._memory.pages():
            for start, stop in _gaps(offset, offset + len(page), sorted(self._reserved)):
                place(descriptor, start, page[start - offset : stop - offset])


def _gaps(start: int, stop: int, taken: Sequence[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Yield what of a range is not taken; `taken` is in order and without overlap."""
    for low, high in taken:
        if high <= start or low >= stop:
            continue
        if start < low:
            yield start, low
        start = high
    if start < stop:
        yield start, stop


def place(descriptor: int, offset: int, data: NDArray[Any] | memoryview) -> None:
    """Write an array, or raw bytes, at an offset of an open file; any thread may do so at any time.

    Raises
    ------
    OSError
        The disk is full or fails.
    """
    view = np.ascontiguousarray(data).reshape(-1).view(np.uint8).data
    while view:
        written = os.pwrite(descriptor, view, offset)
        view, offset = view[written:], offset + written
