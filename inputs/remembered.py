"""Digests of large files, remembered from one run to the next as long as the file is the same.

A file is the same while its device, inode, size, and times of content and of status are. The status time moves with
every write and cannot be set back by a program, so nothing that is written to a file goes unnoticed; what a disk loses
by itself does, and ``phasemark bank verify`` reads every byte.
"""

from __future__ import annotations

import json
import os
import secrets
import stat
import time
from contextlib import suppress
from pathlib import Path

_SMALLEST_BYTES = 1 << 24
"""A smaller file is summed up in less time than it takes to look it up."""
_SETTLED_NS = 2_000_000_000
"""A file that was written less than this ago may be written again without its times moving."""
_MOST_FILES = 256
_MOST_BYTES = 1 << 20


def cache_folder() -> Path | None:
    """Return the folder of this program in the user's cache folder; None if there is no cache folder."""
    folder = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(folder) / "phasemark" if os.path.isabs(folder) else None


def cache_file() -> Path | None:
    """Return the file that holds the digests; None if there is no cache folder."""
    folder = cache_folder()
    return None if folder is None else folder / "digests.json"


def is_worth_remembering(status: os.stat_result) -> bool:
    """Return whether a file takes longer to be summed up than its digest to be looked up."""
    return stat.S_ISREG(status.st_mode) and status.st_size >= _SMALLEST_BYTES


def remembered_digest(status: os.stat_result) -> str | None:
    """Return the SHA-256 of a file of that status, or None if it is not known."""
    key, sign = _key(status), _sign(status)
    found = _read().get(key) if is_worth_remembering(status) else None
    return found[1] if found is not None and found[0] == sign else None


def remember_digest(before: os.stat_result, after: os.stat_result, digest: str) -> None:
    """Remember the SHA-256 of a file, if nothing was written to it while it was read; failing to is no error.

    Parameters
    ----------
    before, after : os.stat_result
        Its status before and after it was read.
    digest : str
    """
    if (
        not is_worth_remembering(before)
        or (_key(before), _sign(before)) != (_key(after), _sign(after))
        or abs(time.time_ns() - max(after.st_mtime_ns, after.st_ctime_ns)) < _SETTLED_NS
    ):
        return
    path = cache_file()
    if path is None:
        return
    known = _read()
    known.pop(_key(after), None)
    known[_key(after)] = (_sign(after), digest)
    kept = dict(list(known.items())[-_MOST_FILES:])
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.write_text(json.dumps(kept), encoding="ascii")
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


def _key(status: os.stat_result) -> str:
    return f"{status.st_dev}:{status.st_ino}"


def _sign(status: os.stat_result) -> str:
    return f"{status.st_size}:{status.st_mtime_ns}:{status.st_ctime_ns}"


def _read() -> dict[str, tuple[str, str]]:
    """Return the remembered digests; none from a file that is damaged or somebody else's."""
    path = cache_file()
    try:
        if path is None:
            return {}
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_uid != os.getuid():
                return {}
            entries = json.loads(file.read(_MOST_BYTES))
        return {str(key): (str(sign), str(digest)) for key, (sign, digest) in entries.items()}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return {}
