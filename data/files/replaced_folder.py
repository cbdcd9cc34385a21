"""Folders that are whole or not there: made beside their place, synced file by file, exchanged in one step."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from phasemark import OutputExistsError, UsageError
from phasemark.data.files import renames
from phasemark.data.files.atomic_write import followed, move, storage_errors, sync, take_over
from phasemark.data.files.folder_marker import (
    MARKER,
    entries_of,
    is_marker_part,
    read_marker,
    remove_listed,
    write_marker,
)
from phasemark.data.files.lock_file import exclusive


@contextmanager
def replacing_folder(path: Path, content: str, *, force: bool = False) -> Iterator[Path]:
    """Make an empty folder beside `path`, and rename it to `path` when the block ends without an error.

    Whatever ends the block early removes the temporary folder and leaves `path` as it was. A link is followed, and a
    folder that is replaced keeps its permissions. What a killed run left is tidied up by the next one.

    Parameters
    ----------
    path : Path
        The folder to write.
    content : str
        What it holds, for its marker.
    force : bool
        Whether a folder that carries our marker, and holds nothing else than it lists, may be replaced. A folder
        without a marker never is.

    Yields
    ------
    Path
        The temporary folder.

    Raises
    ------
    OutputExistsError
        The folder exists and must not be replaced, or another run is writing it.
    UsageError
        The folder in which it should lie does not exist, or the name is that of a file.
    StorageError
        The disk is full or fails.
    """
    refuse_folder(path, force=force)
    real = _followed(path)
    staging, aside = (real.with_name(f".{real.name}.{kind}") for kind in ("partial", "old"))
    with storage_errors(path), exclusive(real.with_name(f".{real.name}.lock"), path):
        # what a killed run left: the old folder gets its name back unless the new one has it
        if aside.is_dir() and not real.exists() and read_marker(aside)[0]:
            os.replace(aside, real)
        for leftover in (staging, aside):
            _discard(leftover)
        refuse_folder(path, force=force)  # another run may have finished before the lock was ours
        staging.mkdir(mode=0o700 if real.exists() else 0o777)
        try:
            write_marker(staging, content, None)
            yield staging
            entries = list(entries_of(staging))
            for entry in entries:
                sync(staging / entry)
            write_marker(staging, content, entries)
            refuse_folder(path, force=force)
            take_over(staging, real)
            # the old folder gets the temporary name, in one step where the file system can
            if not (real.exists() and renames.exchange(staging, real)):
                _give_name(staging, real, aside)
            sync(real.parent)
        finally:
            _discard(staging)


def refuse_folder(path: Path, *, force: bool) -> None:
    """Refuse a folder that must not be written or replaced, before any work is done for it.

    Raises
    ------
    OutputExistsError, UsageError, StorageError
        As :func:`replacing_folder`.
    """
    real = _followed(path)
    if not real.parent.is_dir():
        raise UsageError(f"{path}: the folder '{real.parent}' does not exist: make it first")
    if not real.exists():
        return
    if not path.is_dir():
        raise UsageError(f"{path}: is a file, give the name of a folder")
    with storage_errors(path):
        marked, listed = read_marker(path)
        held = entries_of(path) if marked else ()
        stranger = next((entry for entry in held if entry not in (listed or ())), None)
    if not marked:
        raise OutputExistsError(
            f"{path}: exists and was not written by phasemark, so it is not replaced, even with force=True: give"
            " another folder"
        )
    if not force:
        raise OutputExistsError(f"{path}: exists; use force=True to replace it")
    if stranger is not None:
        raise OutputExistsError(
            f"{path}: holds '{stranger}', which phasemark did not write, so it is not replaced, even with force=True:"
            " move that away, or give another folder"
        )


def _followed(path: Path) -> Path:
    # '.' and 'a/..' are folders without a name of their own; a link is followed to the folder that it leads to
    return Path(os.path.realpath(path)) if path.name in ("", "..") else followed(path)


def _give_name(staging: Path, real: Path, aside: Path) -> None:
    """Rename the new folder to its name; an old one steps aside first, and returns if the new one cannot go."""
    if real.exists():
        os.replace(real, aside)
    try:
        move(staging, real, force=False)
    except BaseException:
        if aside.exists():
            os.replace(aside, real)
        raise
    _discard(aside)


def _discard(folder: Path) -> None:
    """Remove a folder of ours that has a temporary name.

    Raises
    ------
    OutputExistsError
        It holds what is not ours.
    """
    if not os.path.lexists(folder):
        return
    if folder.is_dir() and not folder.is_symlink():
        marked, listed = read_marker(folder)
        if marked and listed is None:  # nobody but the run that was killed knows the name
            shutil.rmtree(folder)
            return
        remove_listed(folder, listed or set())
        if all(name == MARKER or is_marker_part(name) for name in os.listdir(folder)):
            shutil.rmtree(folder)
            return
    raise OutputExistsError(f"{folder}: is not phasemark's, or holds what phasemark did not write: move it away")
