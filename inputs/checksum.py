"""SHA-256 checksums beside files, in the format of ``sha256sum``, compared whenever a file is read."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import BinaryIO

from phasemark import InputFileError, PhasemarkError

_BLOCK_BYTES = 1 << 20
_MOST_BYTES = 1 << 14
"""A checksum file is one line: a digest and the name of a file."""
_CHECKSUM_LINE = re.compile(r"\\?(?P<digest>[0-9a-fA-F]{64}) [ *](?P<name>[^\n]+)\n?")

_verifying: ContextVar[bool] = ContextVar("verifying", default=True)


def checksum_path(path: str | os.PathLike[str]) -> Path:
    """Return where the checksum of a file lies: ``FILE.sha256`` beside it.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    Path
    """
    path = Path(path)
    return path.with_name(path.name + ".sha256")


@contextmanager
def read_errors(path: Path) -> Iterator[None]:
    """Turn an error of opening or reading a file in the block into one line."""
    try:
        yield
    except PhasemarkError:
        raise
    except (OSError, ValueError) as error:  # the second: a NUL in the name
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputFileError(f"{path}: cannot be read ({reason})") from None


def sha256_of(source: str | os.PathLike[str] | BinaryIO) -> str:
    """Return the SHA-256 of a file's content, or of what is left of an open file, in hexadecimal.

    Parameters
    ----------
    source : path-like or binary file
        What is hashed.

    Returns
    -------
    str
    """
    if isinstance(source, str | os.PathLike):
        with open(source, "rb") as file:
            return sha256_of(file)
    digest = hashlib.sha256()
    while block := source.read(_BLOCK_BYTES):
        digest.update(block)
    return digest.hexdigest()


def read_checksum(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 that ``FILE.sha256`` states for a file.

    Parameters
    ----------
    path : path-like
        The file, not its checksum.

    Returns
    -------
    str
        Lower-case hexadecimal.

    Raises
    ------
    InputFileError
        There is no checksum file, it is not in the format of ``sha256sum``, or it is about another file.
    """
    path = _with_checksum(Path(path))
    beside = checksum_path(path)
    with read_errors(beside), beside.open("rb") as file:
        text = os.fsdecode(file.read(_MOST_BYTES))
    match = _CHECKSUM_LINE.fullmatch(text)
    if match is None:
        raise InputFileError(f"{beside}: must be one line '<SHA-256>  {path.name}', as sha256sum writes it")
    if match["name"] != _escaped(path.name):
        raise InputFileError(f"{beside}: must name '{path.name}', but names '{match['name']}'")
    return match["digest"].lower()


def verify_checksum(path: str | os.PathLike[str]) -> str:
    """Compare a file with its ``FILE.sha256``.

    Parameters
    ----------
    path : path-like
        The file, not its checksum.

    Returns
    -------
    str
        The SHA-256 both agree on.

    Raises
    ------
    InputFileError
        The file or its checksum cannot be read, or they do not agree.
    """
    stated = read_checksum(path)
    actual = _digest(Path(path), None)
    if stated != actual:
        raise InputFileError(_contradiction(Path(path), stated, actual))
    return actual


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
    path = _with_checksum(path)
    if not verifying() or not os.path.lexists(checksum_path(path)):
        return False
    attempts = 3  # how often file and checksum are compared while somebody replaces both
    for attempt in range(attempts):
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
    raise InputFileError(f"{_contradiction(path, stated, actual)} (unverified() reads it all the same)")


def checksum_line(digest: str, name: str) -> bytes:
    """Return the content of the checksum file of a file with that digest and name.

    Parameters
    ----------
    digest : str
        Hexadecimal.
    name : str
        Without a folder.
    """
    # sha256sum starts the line with a backslash when the name needed escaping.
    escaped = _escaped(name)
    return os.fsencode(f"{'' if escaped == name else chr(92)}{digest}  {escaped}\n")


def _with_checksum(path: Path) -> Path:
    """Return the name of a file that its checksum has: that of a link if a checksum lies beside it, or the file's."""
    if not path.is_symlink():
        return path
    real, beside = Path(os.path.realpath(path)), checksum_path(path)
    return real if not beside.exists() or os.path.realpath(beside) == str(checksum_path(real)) else path


def _digest(path: Path, content: bytes | BinaryIO | None) -> str:
    if isinstance(content, bytes):
        return hashlib.sha256(content).hexdigest()
    with read_errors(path):
        if content is None:
            return sha256_of(path)
        content.seek(0)
        digest = sha256_of(content)
        content.seek(0)
    return digest


def _contradiction(path: Path, stated: str, actual: str) -> str:
    """Return the message on a file that is not what its checksum says."""
    return f"{path}: damaged: its SHA-256 is {actual}, but {checksum_path(path).name} says {stated}"


def _escaped(name: str) -> str:
    return name.replace("\\", "\\\\").replace("\n", "\\n").replace("\r", "\\r")
