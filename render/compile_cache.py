"""A place for numba's compiled code that can be written, found before the first function is compiled.

numba keeps compiled code beside the source, or in the user's cache folder. A service or a container often has neither.
What is kept is used as long as the source files of all compiled functions are the same, not that of the function alone.
"""

from __future__ import annotations

import os
import stat
import tempfile
import warnings
from pathlib import Path
from typing import Any

from phasemark import UsageError
from phasemark.render.compiled_sources import COMPILED_SOURCES, ROOT, compiled_sources_hash

_THREADS = "NUMBA_NUM_THREADS"


def prepare_compile_cache() -> None:
    """Give numba a folder of this user in the temporary folder if it can keep compiled code nowhere else.

    If there is no such folder either, nothing is kept, and every process compiles again. A note says which it is.

    Raises
    ------
    UsageError
        ``NUMBA_NUM_THREADS`` is a number that numba cannot start with.

    Warns
    -----
    UserWarning
        Compiled code is kept in the temporary folder, or not at all.
    """
    threads = os.environ.get(_THREADS, "").strip()
    if threads.lstrip("+-").isdecimal() and (len(threads) > 9 or int(threads) < 1):
        raise UsageError(f"the environment variable {_THREADS} must be at least 1, got '{threads[:20]}'")
    import numba
    from numba.core.dispatcher import Dispatcher

    if _can_keep():
        return
    for parent in _temporary_folders():
        folder = parent / f"phasemark-numba-{os.getuid()}"
        if _make_private(folder):
            numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
            if _can_keep():
                _note(f"it is kept in {folder}")
                return
            numba.config.CACHE_DIR = ""  # type: ignore[attr-defined]
    _note("every start compiles again, which takes a minute")
    # what numba does for a function without a cache
    Dispatcher.enable_caching = lambda self: None  # type: ignore[method-assign]


def stamp_with_all_sources(root: Path = ROOT, names: tuple[str, ...] = COMPILED_SOURCES) -> None:
    """Let numba keep the code of functions below a folder only while none of some source files there changes.

    A function is copied into those of other modules, and numba compares the file of the function itself alone.

    Parameters
    ----------
    root : Path
        Functions of other folders keep numba's own stamp.
    names : tuple of str
        Files below `root`.
    """
    from numba.core import caching

    locator = getattr(caching, "_SourceFileBackedLocatorMixin", None)
    if locator is None:  # numba documents no way to say what code depends on
        return
    stamp_of_file = locator.get_source_stamp
    own = str(root) + os.sep

    def stamp(self: Any) -> Any:
        of_file = stamp_of_file(self)
        is_own = os.path.realpath(self._py_file).startswith(own)
        return (of_file, compiled_sources_hash(root, names)) if is_own else of_file

    locator.get_source_stamp = stamp


def _note(what: str) -> None:
    warnings.warn(
        f"compiled code can be kept neither beside the package nor in the user's cache folder: {what};"
        " NUMBA_CACHE_DIR names another folder",
        UserWarning,
        stacklevel=4,
    )


def _can_keep() -> bool:
    """Return whether numba finds a folder for the compiled code of this package."""
    import numba

    try:
        numba.njit(cache=True)(_probe)
    except RuntimeError:  # "cannot cache function": no folder can be written
        return False
    return True


def _probe() -> int:
    return 0


def _temporary_folders() -> list[Path]:
    """Return where a folder for compiled code may be made: never the current folder."""
    try:
        default = [Path(tempfile.gettempdir())]
    except FileNotFoundError:
        default = []
    return [folder for folder in (*default, Path("/dev/shm")) if folder.resolve() != Path.cwd().resolve()]


def _make_private(folder: Path) -> bool:
    """Make a folder that nobody else can write to, because compiled code in it is run."""
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o077


def _announce_compilation() -> None:
    """Import numba after :func:`prepare_compile_cache`, which checks what it would stop at."""
    from phasemark.render.compile_notes import announce_compilation

    announce_compilation()


prepare_compile_cache()
stamp_with_all_sources()
_announce_compilation()
