"""One way to build everything: where a job runs, what is continued, and what is finished already."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from phasemark import UsageError
from phasemark.data.progress import Progress
from phasemark.data.remote import open_maker
from phasemark.data.shards import Job, build, manifest_path, refuse_difference, refuse_unfinished
from phasemark.data.store import refuse_unwritable
from phasemark.files import checksum_path


def refuse_unwritable_output(path: Path, *, force: bool, resume: bool) -> None:
    """Refuse an output before any work is done for it: it exists, or an unfinished run of it does.

    Raises
    ------
    OutputExistsError, UsageError
        As :func:`phasemark.data.shards.build`.
    """
    if not path.name:
        raise UsageError(f"'{path}' is not a file name")
    for target in (path, checksum_path(path)):
        refuse_unwritable(target, force=force or resume)
    if manifest_path(path).exists() and not (force or resume):
        refuse_unfinished(path)


def produce(
    job: Job,
    path: str | os.PathLike[str],
    *,
    finished: Callable[[Path], dict[str, Any]],
    force: bool = False,
    resume: bool = False,
    workers: int | None = None,
    shard_items: int | None = None,
    scheduler: str = "threads",
    progress: Progress | None = None,
) -> Path:
    """Build a file with the scheduler that was asked for; with `resume` a finished one of the same plan will do.

    Parameters
    ----------
    job : Job
    path : path-like
    finished : callable
        Returns the identity of a finished file, see :meth:`phasemark.data.shards.Job.identity`.
    scheduler : str
        ``threads``, ``local:N`` for N worker processes, or the address of a Dask scheduler.
    force, resume, workers, shard_items, progress
        As for :func:`phasemark.data.shards.build`, which says what is raised.
    """
    path = Path(path)
    begun = manifest_path(path).exists()
    if resume and not begun and path.is_file():
        refuse_difference(path, finished(path), job.identity())
        return path
    with ExitStack() as stack:
        maker = open_maker(scheduler, job)
        if maker is not None:
            stack.callback(maker.close)
        return build(
            job, path, force=force, resume=resume, workers=workers, shard_items=shard_items, maker=maker,
            progress=progress,
        )  # fmt: skip
