"""Digests that a thread computes while the program imports what will read the file.

Computing a digest and reading a file need no Python, so on a second processor they take no time of their own.
Nothing of a file is parsed before its digest is known and compared: the reader of the file waits for the thread.
"""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

_BLOCK_BYTES = 1 << 24
"""Between two blocks the thread needs the interpreter, and may wait 5 ms for it each time."""


class _Reader(threading.Thread):
    """A file that is read to its end, or until nobody needs its digest any more."""

    def __init__(self, path: Path) -> None:
        super().__init__(daemon=True)
        self._path = path
        self._unwanted = threading.Event()
        self.status: os.stat_result | None = None
        self.digest: str | None = None

    def run(self) -> None:
        """Compute the digest; a file that cannot be read is reported when it is opened."""
        digest, buffer = hashlib.sha256(), bytearray(_BLOCK_BYTES)
        try:
            with open(self._path, "rb", buffering=0) as file:
                status = os.fstat(file.fileno())
                while size := file.readinto(buffer):
                    if self._unwanted.is_set():
                        return
                    digest.update(memoryview(buffer)[:size])
        except OSError:
            return
        self.status, self.digest = status, digest.hexdigest()

    def end(self) -> None:
        """Stop reading."""
        self._unwanted.set()
        self.join()


_reader: ContextVar[_Reader | None] = ContextVar("reader", default=None)


@contextmanager
def computed_ahead(path: Path) -> Iterator[None]:
    """Compute the digest of a file in a thread, until it is asked for or the block ends.

    Parameters
    ----------
    path : Path
        A file, not a pipe.

    Yields
    ------
    None
    """
    reader = _Reader(path)
    token = _reader.set(reader)
    reader.start()
    try:
        yield
    finally:
        reader.end()
        _reader.reset(token)


def digest_computed_ahead(status: os.stat_result) -> str | None:
    """Return the digest of the file of that status, once, after waiting for its thread; None if none computes it."""
    reader = _reader.get()
    if reader is None:
        return None
    _reader.set(None)
    reader.join()
    return reader.digest if reader.status is not None and _same(reader.status, status) else None


def _same(one: os.stat_result, other: os.stat_result) -> bool:
    """Return whether two statuses are those of one file to which nothing was written in between."""
    names = ("st_dev", "st_ino", "st_size", "st_mtime_ns", "st_ctime_ns")
    return all(getattr(one, name) == getattr(other, name) for name in names)
