"""Files opened once: whole ones with a limit on their size, and what a pipe delivers."""

from __future__ import annotations

import io
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import BinaryIO

from phasemark import InputFileError
from phasemark.inputs.checksum import is_vouched_for, read_errors

MOST_TOML_BYTES = 1 << 22
"""Largest size of a plan, a map or a sensor file, bytes."""
_BLOCK_BYTES = 1 << 20

_delivered: ContextVar[dict[tuple[int, int, int], bytes] | None] = ContextVar("delivered", default=None)


@contextmanager
def pipes_read_once() -> Iterator[None]:
    """Read each pipe once within the block, and return the same bytes whenever it is read again.

    A plan and its sensor are read when they are checked and again when they are used.

    Yields
    ------
    None
    """
    token = _delivered.set({})
    try:
        yield
    finally:
        _delivered.reset(token)


@contextmanager
def opened(path: Path, *, most_bytes: int) -> Iterator[BinaryIO]:
    """Open a file to be read, once, and compare it with its checksum.

    Parameters
    ----------
    path : Path
        A file, or a pipe or device, which is read to its end first.
    most_bytes : int
        How much a pipe or device may deliver.

    Yields
    ------
    BinaryIO
        At its beginning, and seekable.

    Raises
    ------
    InputFileError
        The file cannot be opened, is not what its checksum says, or delivers too much.
    """
    with read_errors(path):
        if not stat.S_ISREG(path.stat().st_mode):
            plain: BinaryIO = io.BytesIO(_content(path, most_bytes))
        else:
            plain = path.open("rb")
    with plain:
        if not isinstance(plain, io.BytesIO):
            is_vouched_for(path, plain)
        yield plain


def read_whole(path: str | os.PathLike[str], *, most_bytes: int) -> bytes:
    """Return the content of a file: opened once, limited in size, and compared with its checksum.

    Parameters
    ----------
    path : path-like
        A file, pipe or device.
    most_bytes : int
        How large it may be; not more than that is read.

    Raises
    ------
    InputFileError
        The file cannot be read, is larger, or is not what its checksum says.
    """
    path = Path(path)
    with read_errors(path):
        content = _content(path, most_bytes)
    is_vouched_for(path, content)
    return content


def first_bytes(path: str | os.PathLike[str], size: int) -> bytes:
    """Return the beginning of a file, and nothing of a pipe or of a file that cannot be read.

    Parameters
    ----------
    path : path-like
    size : int
        Number of bytes; a shorter file is returned whole.
    """
    try:
        if stat.S_ISREG(os.stat(path).st_mode):  # bytes read from a pipe are gone for the next reader
            with open(path, "rb") as file:
                return file.read(size)
    except (OSError, ValueError):
        pass
    return b""


def read_text(path: str | os.PathLike[str], *, most_bytes: int) -> str:
    """Return a text file's content, UTF-8 with or without a byte order mark, read as :func:`read_whole` does.

    Parameters
    ----------
    path : path-like
        A file, pipe or device.
    most_bytes : int
        How large it may be.

    Returns
    -------
    str

    Raises
    ------
    InputFileError
        As :func:`read_whole`, or it is not text.
    """
    content = read_whole(path, most_bytes=most_bytes)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputFileError(f"{path}: is no text file (byte {error.start} is not UTF-8)") from None


def _content(path: Path, most_bytes: int) -> bytes:
    status = path.stat()
    if stat.S_ISREG(status.st_mode):
        if status.st_size > most_bytes:
            raise InputFileError(_too_large(path, most_bytes))
        with path.open("rb") as file:
            return _read(file, path, most_bytes)
    known, key = _delivered.get(), (status.st_dev, status.st_ino, status.st_rdev)
    if known is None or key not in known:
        with path.open("rb") as file:
            content = _read(file, path, most_bytes)
        if known is None:
            return content
        known[key] = content
    return known[key]


def _read(file: BinaryIO, path: Path, most_bytes: int) -> bytes:
    blocks, left = [], most_bytes + 1
    while left and (block := file.read(min(left, _BLOCK_BYTES))):
        blocks.append(block)
        left -= len(block)
    if not left:
        raise InputFileError(_too_large(path, most_bytes))
    return b"".join(blocks)


def _too_large(path: Path, most_bytes: int) -> str:
    return f"{path}: has more than {most_bytes / 1e6:.3g} MB, which is far too large for a file of this kind"
