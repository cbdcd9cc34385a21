"""Comparison of a file with the checksum beside it, made whenever a file is read."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import BinaryIO

from phasemark import InputFileError
from phasemark.inputs.checksum import checksum_path, contradiction, read_checksum, sha256_of, with_checksum

_ATTEMPTS = 3
"""How often file and checksum are compared while somebody replaces both."""

_verifying: ContextVar[bool] = ContextVar("verifying", default=True)


def verifying() -> bool:
    """Return whether files that are read are compared with their checksums."""
    return _verifying.get()


@contextmanager
def unverified() -> Iterator[None]:
    """Read files in the block without comparing them with their checksums, as ``--no-verify`` does.

    Yields
    ------
    None
    """
    token = _verifying.set(False)
    try:
        yield
    finally:
        _verifying.reset(token)


def is_vouched_for(path: Path, content: bytes | BinaryIO | None = None) -> bool:
    """Return whether ``FILE.sha256`` is there and right.

    Parameters
    ----------
    path : Path
        The file.
    content : bytes or binary file, optional
        The file's content, if it has been read, or the open file, which stands at its beginning afterwards.

    Returns
    -------
    bool
        False if there is no checksum, or within :func:`unverified`.

    Raises
    ------
    InputFileError
        The checksum is there and wrong, or the file cannot be read.
    """
    path = with_checksum(path)
    if not verifying() or not os.path.lexists(checksum_path(path)):
        return False
    for attempt in range(_ATTEMPTS):
        try:
            stated = read_checksum(path)
        except InputFileError:
            if attempt and not os.path.lexists(checksum_path(path)):
                return False
            raise
        actual = _digest(path, content)
        if stated == actual:
            return True
        if isinstance(content, bytes):
            break
    raise InputFileError(f"{contradiction(path, stated, actual)} (unverified() reads it all the same)")


def _digest(path: Path, content: bytes | BinaryIO | None) -> str:
    if isinstance(content, bytes):
        return hashlib.sha256(content).hexdigest()
    try:
        if content is None:
            with path.open("rb") as file:
                return _digest(path, file)
        content.seek(0)
        digest = sha256_of(content)
        content.seek(0)
    except OSError as error:
        raise InputFileError(f"{path}: cannot be read ({error.strerror})") from None
    return digest
