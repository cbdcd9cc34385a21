"""One way to build everything: where a job runs, what is continued, and what is finished already."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

from phasemark import OutputExistsError, UsageError
from phasemark.data.files.atomic_write import followed, refuse_unwritable
from phasemark.data.files.same_file import refuse_inputs
from phasemark.data.progress import Progress
from phasemark.data.shards.build import Job, build, manifest_path, partial_path, refuse_difference, refuse_unfinished
from phasemark.data.shards.remote import open_maker
from phasemark.inputs import checksum_path


def refuse_unwritable_output(path: Path, *, force: bool, resume: bool, inputs: Iterable[Path] = ()) -> None:
    """Refuse an output before any work is done for it: it is an input, it exists, or an unfinished run of it does.

    Parameters
    ----------
    path : Path
    force, resume : bool
        As for :func:`phasemark.data.shards.build.build`.
    inputs : iterable of Path
        The files that it is made from.

    Raises
    ------
    OutputExistsError, UsageError
        As :func:`phasemark.data.shards.build.build`.
    """
    real = followed(path)
    refuse_inputs(outputs_of(path), inputs)
    for target in (path, checksum_path(real)):
        refuse_unwritable(target, force=force or resume)
    if manifest_path(real).exists() and not (force or resume):
        refuse_unfinished(path)


def outputs_of(path: Path) -> tuple[Path, ...]:
    """Return all that building a file writes: the file, its checksum, and what lies there until it is finished.

    Raises
    ------
    UsageError
        The path has no name.
    """
    if not path.name:
        raise UsageError(f"'{path}' is not a file name")
    return (path, *(name(followed(path)) for name in (checksum_path, partial_path, manifest_path)))


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
        Returns the identity of a finished file, see :meth:`phasemark.data.shards.build.Job.identity`.
    scheduler : str
        ``threads``, or the address of a Dask scheduler.
    force, resume, workers, shard_items, progress
        As for :func:`phasemark.data.shards.build.build`, which says what is raised.
    """
    path = Path(path)
    begun = manifest_path(followed(path)).exists()
    if resume and not begun and path.is_file():
        try:
            refuse_difference(path, finished(path), job.identity())
        except OutputExistsError:
            if not force:
                raise
        else:
            return path
    maker = open_maker(scheduler, job)
    with nullcontext() if maker is None else closing(maker):
        return build(
            job, path, force=force, resume=resume, workers=workers, shard_items=shard_items, maker=maker,
            progress=progress,
        )  # fmt: skip
