"""Outputs that are inputs: the same file, whatever its name."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from phasemark import UsageError
from phasemark.inputs import checksum_path


def refuse_inputs(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """Refuse to write what is read: files are compared by device and inode, so links count too.

    Parameters
    ----------
    outputs : iterable of Path
        What is going to be written; those that do not exist yet are no input.
    inputs : iterable of Path
        What is read; names of no file are left out. The checksum beside an input belongs to it.

    Raises
    ------
    UsageError
        With the name of the output and that of the input.
    """
    read: dict[tuple[int, int], Path] = {}
    for given in inputs:
        for path in (given, checksum_path(given)) if given.name else (given,):
            if (identity := _identity(path)) is not None:
                read.setdefault(identity, path)
    for path in outputs:
        identity = _identity(path)
        if identity is not None and identity in read:
            same = read[identity]
            what = "is an input too" if same == path else f"is the same file as the input '{same}'"
            raise UsageError(f"{path}: {what}: give the output another name")


def named_files(value: object) -> Iterator[Path]:
    """Yield what may be the name of a file among arguments or the values of a plan, ``NAME=FILE`` included.

    Parameters
    ----------
    value : object
        A string, a path, or mappings and sequences of them; anything else is passed over.

    Yields
    ------
    Path
    """
    if isinstance(value, Path):
        yield value
    elif isinstance(value, str):
        yield Path(value)
        if "=" in value:
            yield Path(value.partition("=")[2])
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from named_files(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from named_files(inner)


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino
