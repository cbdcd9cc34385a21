"""Renames that the standard library does not have: one that replaces nothing, and one that exchanges two names."""

from __future__ import annotations

import ctypes
import errno
import os
from pathlib import Path

_NO_REPLACE, _EXCHANGE = 1, 2  # linux/fs.h
_UNKNOWN = {errno.EINVAL, errno.ENOSYS, errno.EXDEV}
"""What kernels and file systems answer that do not know a flag."""


def rename_new(source: Path, target: Path) -> None:
    """Rename a file or folder unless something has the new name, in one step where the file system can.

    Parameters
    ----------
    source, target : Path
        On one file system.

    Raises
    ------
    FileExistsError
        Something has the new name.
    OSError
        The rename fails.
    """
    if _renameat2(source, target, _NO_REPLACE):
        return
    if os.path.lexists(target):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(target))
    os.rename(source, target)


def exchange(first: Path, second: Path) -> bool:
    """Exchange two names in one step; return False if the file system cannot.

    Parameters
    ----------
    first, second : Path
        Both exist, on one file system.

    Raises
    ------
    OSError
        The exchange fails.
    """
    return _renameat2(first, second, _EXCHANGE)


def _renameat2(source: Path, target: Path, flags: int) -> bool:
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is None:
        return False
    at_fdcwd = -100
    if call(at_fdcwd, os.fsencode(source), at_fdcwd, os.fsencode(target), ctypes.c_uint(flags)) == 0:
        return True
    code = ctypes.get_errno()
    if code in _UNKNOWN:
        return False
    raise OSError(code, os.strerror(code), str(source), None, str(target))
