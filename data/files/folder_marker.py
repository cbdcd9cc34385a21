"""The marker of a folder that phasemark wrote: it lists what is ours, and nothing else is ever removed.

The marker is a file of the folder, ``.phasemark-folder``. Its names are compared with what the folder holds and are
never followed, so that a marker from a stranger cannot name files elsewhere.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import takewhile
from pathlib import Path

from phasemark import OutputExistsError, StorageError, UsageError
from phasemark.data.files.atomic_write import storage_errors, sync, write_atomically
from phasemark.data.files.lock_file import exclusive

MARKER = ".phasemark-folder"
LOCK = ".phasemark-lock"

_FORMAT = "phasemark-folder"
_SCHEMA_VERSION = 1


def write_marker(folder: Path, content: str, entries: Iterable[str] | None) -> None:
    """Write the marker of a folder.

    Parameters
    ----------
    folder : Path
    content : str
        Description of the folder, for readers of the marker.
    entries : iterable of str or None
        Files as paths relative to the folder, folders with a slash at the end. None while the folder is being made.
    """
    table = {
        "format": _FORMAT, "schema_version": _SCHEMA_VERSION, "content": content,
        "entries": None if entries is None else sorted(entries),
    }  # fmt: skip
    text = json.dumps(table, indent=0, ensure_ascii=False) + "\n"
    write_atomically(folder / MARKER, text.encode(errors="surrogateescape"), force=True)


def read_marker(folder: Path) -> tuple[bool, set[str] | None]:
    """Return whether a folder carries a marker, and what it lists; None for a folder that was never finished.

    Raises
    ------
    OSError
        The marker cannot be read.
    """
    path = folder / MARKER
    try:
        if not stat.S_ISREG(path.lstat().st_mode):
            return False, None
        table = json.loads(path.read_bytes().decode(errors="surrogateescape"))
        if table["format"] != _FORMAT or table["schema_version"] != _SCHEMA_VERSION:
            return False, None
        return True, None if table["entries"] is None else {str(entry) for entry in table["entries"]}
    except (FileNotFoundError, NotADirectoryError, ValueError, LookupError, TypeError):
        return False, None


def is_marker_part(name: str) -> bool:
    """Return whether a name is that of a marker that was not finished."""
    return name.startswith(f".{MARKER}.") and name.endswith(".partial")


def entries_of(folder: Path) -> Iterator[str]:
    """Yield all that a folder holds but its marker: files first, folders (with a slash at the end) after their content.

    Links are entries, and are not followed.
    """
    for where, folders, files in os.walk(folder, topdown=False, onerror=_fail):
        base = Path(where).relative_to(folder)
        for name in (*files, *folders):
            entry = str(base / name)
            if (Path(where) / name).is_dir() and not (Path(where) / name).is_symlink():
                entry += "/"
            if entry != MARKER:
                yield entry


def remove_listed(folder: Path, listed: set[str]) -> None:
    """Remove what a marker lists from a folder; what it does not list stays, and so do folders that hold it.

    Raises
    ------
    OSError
        Something cannot be removed.
    """
    for entry in [entry for entry in entries_of(folder) if entry in listed]:
        if not entry.endswith("/"):
            (folder / entry).unlink(missing_ok=True)
        else:
            try:
                (folder / entry).rmdir()
            except OSError as error:
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):  # it holds a file of somebody else
                    raise


class OwnedFiles:
    """The files of a folder that are ours, in a folder that may hold others too.

    Parameters
    ----------
    folder : Path
    content : str
        What the folder holds, for the marker.
    """

    def __init__(self, folder: Path, content: str) -> None:
        marked, listed = read_marker(folder)
        self.folder, self._content = folder, content
        self.names = (listed if marked else None) or set()

    def claim(self, *names: str) -> None:
        """Note that files are ours before they are written.

        Raises
        ------
        OutputExistsError
            One of them exists and is not ours; with or without `force` it stays.
        """
        for name in names:
            if name not in self.names and os.path.lexists(self.folder / name):
                raise OutputExistsError(
                    f"{self.folder / name}: exists and was not written by 'phasemark {self._content}', so force=True"
                    " does not replace it: move it away, or give another folder"
                )
        if set(names) <= self.names and (self.folder / MARKER).exists():
            return
        self.names |= set(names)
        write_marker(self.folder, self._content, self.names)

    def clear(self) -> None:
        """Remove our files, and no others."""
        with storage_errors(self.folder):
            remove_listed(self.folder, self.names)
            sync(self.folder)


@contextmanager
def adding_to_folder(folder: Path, content: str) -> Iterator[OwnedFiles]:
    """Lock a folder against other runs while the block adds files to it.

    A block that fails before it has added one leaves nothing: no marker, and no folder that was made for it.

    Parameters
    ----------
    folder : Path
        It is made if it is not there.
    content : str
        The command that writes it, for marker and messages.

    Raises
    ------
    UsageError
        The folder is none, or lies in a file.
    OutputExistsError
        Another run is writing it.
    StorageError
        It cannot be written.
    """
    with made_folder(folder), storage_errors(folder), exclusive(folder / LOCK, folder):
        for name in filter(is_marker_part, os.listdir(folder)):  # of a run that was killed
            (folder / name).unlink(missing_ok=True)
        marked = os.path.lexists(folder / MARKER)
        ours = OwnedFiles(folder, content)
        try:
            yield ours
        except BaseException:
            if not marked and not any(os.path.lexists(folder / name) for name in ours.names):
                (folder / MARKER).unlink(missing_ok=True)
            raise


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Make a folder, and those above it, for a block that writes into it; an error removes those that stay empty.

    Parameters
    ----------
    folder : Path
        One that is there already will do.

    Raises
    ------
    UsageError
        The folder is none, or lies in a file.
    StorageError
        It cannot be made.
    """
    made = list(takewhile(lambda path: not os.path.lexists(path), (folder, *folder.parents)))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise UsageError(f"{folder}: is not a folder, or lies in a file") from None
    except OSError as error:
        raise StorageError(f"{folder}: cannot be made ({error.strerror or error})") from error
    try:
        yield
    except BaseException:
        with suppress(OSError):  # one that holds something stays, and so do those it lies in
            for path in made:
                path.rmdir()
        raise


def _fail(error: OSError) -> None:
    raise error
