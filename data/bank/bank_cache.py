"""Banks that are built as they are needed, kept in the user's cache folder under what they are made of."""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from pathlib import Path

from phasemark import InputFileError, OutputExistsError, StorageError
from phasemark.data.bank.bank_file import Bank, open_bank
from phasemark.data.bank.build_bank import BankJob, build_bank
from phasemark.data.plans.bank_plan import BankPlan
from phasemark.data.progress import Progress

_MOST_BYTES = 1 << 30
"""Banks that were not used for longest are thrown away where all together are larger."""


def cached_bank(plan: BankPlan, *, keep: bool = True, progress: Progress | None = None) -> Bank:
    """Return a bank of a plan: the one that was kept, or a new one.

    A bank is found again by what its bytes depend on: the contents of its meshes, the sensor, the grid and the versions
    of the program and its libraries. One that is damaged is built again. Where nothing can be kept, because the folder
    is full, read-only, or used by another run, the bank is a temporary one.

    Parameters
    ----------
    plan : BankPlan
    keep : bool
        Whether to look for a kept bank, and to keep a new one.
    progress : callable (done, total), optional
        As for :func:`~phasemark.data.build_bank`.

    Raises
    ------
    UsageError, InputFileError
        As :func:`~phasemark.data.build_bank`.
    """
    folder = _cache_folder()
    if not keep or folder is None:
        return build_bank(plan, progress=progress)
    path = folder / "banks" / f"{_key(plan)}.h5"
    with suppress(InputFileError):
        bank = open_bank(path)
        with suppress(OSError):
            os.utime(path)
        return bank
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        bank = build_bank(plan, path, force=True, progress=progress)
    except (OSError, OutputExistsError, StorageError):
        return build_bank(plan, progress=progress)
    _prune(path)
    return bank


def _cache_folder() -> Path | None:
    """Return the folder of this program in the user's cache folder; None if there is no cache folder."""
    folder = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(folder) / "phasemark" if os.path.isabs(folder) else None


def _key(plan: BankPlan) -> str:
    """Return a name for all that a bank's bytes depend on, wherever its mesh files lie."""
    identity = BankJob(plan).identity()
    for mesh in identity["plan"]["meshes"]:
        del mesh["path"]
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:32]


def _prune(newest: Path) -> None:
    """Throw away the banks that were not used for longest, until the others are small enough."""
    with suppress(OSError):
        kept = sorted(newest.parent.glob("*.h5"), key=lambda path: path.stat().st_mtime, reverse=True)
        total = 0
        for path in kept:
            total += path.stat().st_size
            if total > _MOST_BYTES and path != newest:
                path.unlink()
                path.with_name(path.name + ".sha256").unlink(missing_ok=True)
