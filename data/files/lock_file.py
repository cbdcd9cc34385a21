"""A lock that lies beside what it protects: one run at a time writes it."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from phasemark import OutputExistsError


def lock_file(path: Path, protects: Path) -> tuple[int, bool]:
    """Open and lock a file, and make it if it is not there.

    Parameters
    ----------
    path : Path
        The file that is locked; no link is followed.
    protects : Path
        What only one run at a time may write, for the message.

    Returns
    -------
    descriptor : int
        Closing it ends the lock.
    fresh : bool
        Whether the file was made by this call.

    Raises
    ------
    OutputExistsError
        Another run holds the lock.
    OSError
        The file cannot be opened.
    """
    while True:
        # who replaces a private file must not show its new content to others in the meantime
        mode = 0o600 if protects.is_file() else 0o666
        try:
            descriptor, fresh = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, mode), True
        except FileExistsError:
            try:
                descriptor, fresh = os.open(path, os.O_RDWR | os.O_NOFOLLOW), False
            except FileNotFoundError:
                continue  # its run has just ended
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise OutputExistsError(f"{protects}: another run is writing it: wait for that one, or end it") from None
        except BaseException:
            os.close(descriptor)
            raise
        try:
            if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                return descriptor, fresh
        except FileNotFoundError:
            pass
        os.close(descriptor)  # its run ended in between: what we hold has the name no longer


@contextmanager
def exclusive(path: Path, protects: Path) -> Iterator[None]:
    """Hold a lock while the block runs, and remove its file at the end.

    Parameters and errors are those of :func:`lock_file`.
    """
    descriptor, _ = lock_file(path, protects)
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()
        os.close(descriptor)
