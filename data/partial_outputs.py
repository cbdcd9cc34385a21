"""Jobs from plain data, and parts of jobs: what several machines that share nothing build, and one merges."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError, OutputExistsError, UsageError
from phasemark.data.bank.build_bank import BankJob
from phasemark.data.files.hdf5_layout import Layout
from phasemark.data.files.hdf5_reading import check_format, open_hdf5, reading
from phasemark.data.files.json_text import json_text
from phasemark.data.files.same_file import named_files
from phasemark.data.frames.build_frames import FrameJob, frames_job
from phasemark.data.frames.scene_frames_job import SceneFramesJob
from phasemark.data.plans.arrays import AnyPlan, planned_size
from phasemark.data.plans.bank_plan import BankPlan
from phasemark.data.plans.frame_plan import FramePlan
from phasemark.data.plans.grid_axis import as_count
from phasemark.data.plans.scene_frames_plan import SceneFramesPlan
from phasemark.data.progress import Progress
from phasemark.data.shards.build import Job, Place, difference, make_shard, pieces
from phasemark.data.shards.run import produce, refuse_unwritable_output
from phasemark.inputs import verify_checksum

FORMAT = "phasemark-part"
SCHEMA_VERSION = 1

_GOLDEN = (5**0.5 - 1) / 2


def job_for(plan: AnyPlan) -> BankJob | FrameJob | SceneFramesJob:
    """Return the job that builds what a plan describes, its views checked."""
    if isinstance(plan, BankPlan):
        return BankJob(plan)
    job = frames_job(plan)
    job.check_views()
    return job


def job_of(spec: dict[str, Any]) -> Job:
    """Return the job that :meth:`phasemark.data.shards.build.Job.spec` describes."""
    if spec["kind"] == "part":
        return PartJob(job_of(spec["of"]), spec["part"], spec["parts"])
    if spec["kind"] == "bank":
        return BankJob(BankPlan(**spec["plan"]))
    return frames_job((SceneFramesPlan if spec["kind"] == "scenes" else FramePlan)(**spec["plan"]))


MOST_PARTS = 1_000_000
"""Of a job that is built in parts."""


def parse_part(text: str) -> tuple[int, int]:
    """Read ``i/n``, part i of n, counted from 1.

    Parameters
    ----------
    text : str
        The part, as ``i/n``.

    Returns
    -------
    i : int
        Which part.
    n : int
        How many parts there are.

    Raises
    ------
    UsageError
        It is something else.
    """
    first, _, last = text.partition("/")
    part, parts = as_count(first), as_count(last)
    if part is None or parts is None or not 1 <= part <= parts <= MOST_PARTS:
        raise UsageError(f"part=… must be I/N with 1 ≤ I ≤ N ≤ {MOST_PARTS}, 2/8 for instance, got '{text[:40]}'")
    return part, parts


class PartJob:
    """Part i of n of a job, in a file of its own (:class:`phasemark.data.shards.build.Job`).

    Parameters
    ----------
    job : Job
    part, parts : int
        Which of how many, counted from 1.
    """

    maker = "phasemark.data.partial_outputs:job_of"

    def __init__(self, job: Job, part: int, parts: int) -> None:
        if not 1 <= part <= parts:
            raise UsageError(f"'part' must be (i, n) with 1 ≤ i ≤ n, got {(part, parts)}")
        self._job, self._part, self._parts = job, part, parts
        self._total = sum(job.items)
        self.start, self.stop = _shared(self._total, part, parts)
        if self.start == self.stop:
            raise UsageError(f"part={part}/{parts} would be empty: there are only {self._total} items to share")
        self._pieces = list(pieces(job.items, self.start, self.stop))

    def spec(self) -> dict[str, Any]:
        """Return a description from which another process makes the same job."""
        return {"kind": "part", "of": self._job.spec(), "part": self._part, "parts": self._parts}

    @property
    def items(self) -> list[int]:
        """How many items each piece of a slab has."""
        return [stop - start for _, start, stop in self._pieces]

    def identity(self) -> dict[str, Any]:
        """Return all that the part's bytes depend on."""
        return {**self._job.identity(), "shard": f"{self._part}/{self._parts}"}

    def lay_out(self) -> tuple[Layout, list[list[Place]]]:
        """Return all but the values, and where these go: one dataset of raw bytes for each piece and field."""
        whole, whole_places = self._job.lay_out()
        places = []
        with Layout() as layout:
            layout.file.attrs.update(
                {
                    "format": FORMAT,
                    "schema_version": SCHEMA_VERSION,
                    "spec": json_text(self._job.spec()),
                    "identity": json_text(self._job.identity(), sort_keys=True),
                    "header_sha256": whole.sha256(),
                    "items": np.array([self.start, self.stop, self._total], dtype="<i8"),
                }
            )
            for k, (slab, start, stop) in enumerate(self._pieces):
                fields = []
                for field, where in enumerate(whole_places[slab]):
                    _, offset = layout.reserve(layout.file, _name(k, field), (stop - start, where.stride), "|u1")
                    fields.append(Place(offset, where.stride))
                places.append(fields)
        return layout, places

    def make(self, slab: int, start: int, stop: int) -> list[NDArray[Any]]:
        """Make some items of a piece."""
        of, first, _ = self._pieces[slab]
        return self._job.make(of, first + start, first + stop)


def _shared(total: int, part: int, parts: int) -> tuple[int, int]:
    """Return first and stop of the items of a part."""
    return total * (part - 1) // parts, total * part // parts


def _name(piece: int, field: int) -> str:
    return f"piece{piece}_field{field}"


def build_part(
    plan: AnyPlan,
    part: tuple[int, int],
    path: str | os.PathLike[str],
    *,
    force: bool = False,
    resume: bool = False,
    workers: int | None = None,
    shard_items: int | None = None,
    scheduler: str = "threads",
    progress: Progress | None = None,
) -> Path:
    """Build part i of n of a bank or frame set, for :func:`merge_parts` to put together.

    Parameters
    ----------
    plan : BankPlan, FramePlan or SceneFramesPlan
        Plan of the bank or frame set.
    part : (i, n)
        Counted from 1.
    path : path-like
        The part's own file.
    force, resume, workers, shard_items, scheduler, progress
        As for :func:`phasemark.data.build_bank`, which says what is raised.

    Returns
    -------
    Path
        `path`.
    """
    refuse_unwritable_output(Path(path), force=force, resume=resume, inputs=named_files(plan.model_dump()))
    job = job_for(plan)
    return produce(
        PartJob(job, *part), path, finished=_finished_identity, force=force, resume=resume, workers=workers,
        shard_items=shard_items or job.shard_items, scheduler=scheduler, progress=progress,
    )  # fmt: skip


def _finished_identity(path: Path) -> dict[str, Any]:
    with ExitStack() as stack:
        found = _opened(path, stack)
    parts = round(found.total / (found.stop - found.start))
    named = ((part, n) for n in range(max(1, parts - 1), parts + 2) for part in range(1, n + 1))
    which = next((name for name in named if _shared(found.total, *name) == (found.start, found.stop)), None)
    return {**found.identity, "shard": which and "{}/{}".format(*which)}


def merge_parts(
    parts: Sequence[str | os.PathLike[str]],
    path: str | os.PathLike[str],
    *,
    force: bool = False,
    resume: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Put the parts of a bank or frame set together; the file has the bytes that one run would have written.

    Parameters
    ----------
    parts : sequence of path-like
        All parts, in any order, each with its checksum beside it.
    path : path-like
        The file to write.
    force, resume, progress
        As for :func:`phasemark.data.build_bank`.

    Returns
    -------
    Path
        `path`.

    Raises
    ------
    InputFileError
        A part cannot be read, is damaged, or belongs to another plan; or parts are missing.
    OutputExistsError, StorageError
        As for :func:`phasemark.data.build_bank`.
    """
    refuse_unwritable_output(Path(path), force=force, resume=resume, inputs=map(Path, parts))
    if not parts:
        raise UsageError("give the shards to merge")
    with ExitStack() as stack:
        for part in parts:
            verify_checksum(part)
        job = MergeJob([_opened(Path(part), stack) for part in parts])
        return produce(job, path, finished=lambda _: job.identity(), force=force, resume=resume, progress=progress)


class _Part(NamedTuple):
    """An open part."""

    path: Path
    file: h5py.File
    spec: dict[str, Any]
    identity: dict[str, Any]
    header_sha256: str
    start: int
    stop: int
    total: int


def _opened(path: Path, stack: ExitStack) -> _Part:
    """Open a part, which the stack closes."""
    file = stack.enter_context(open_hdf5(path, "shard", untrusted=True))
    with reading(path):
        check_format(file, path, "shard", FORMAT, SCHEMA_VERSION)
        spec, identity = (json.loads(file.attrs[name]) for name in ("spec", "identity"))
        return _Part(path, file, spec, identity, str(file.attrs["header_sha256"]), *map(int, file.attrs["items"]))


class MergeJob:
    """A job whose items have been made already, in parts (:class:`phasemark.data.shards.build.Job`)."""

    def __init__(self, parts: Sequence[_Part]) -> None:
        first, *others = parts
        for other in others:
            if changes := difference(first.identity, other.identity):
                raise InputFileError(f"{other.path}: is of another run than {first.path} ({'; '.join(changes[:4])})")
        self._parts = sorted(parts, key=lambda part: part.start)
        reached = 0
        for start, stop, path in [*((part.start, part.stop, part.path) for part in self._parts), (first.total, 0, "")]:
            if start > reached:
                raise InputFileError(f"shards are missing: no items {reached} … {start - 1} of {first.total}")
            if start < reached:
                raise InputFileError(f"{path}: repeats items from {start} on, which another shard has")
            reached = stop
        with reading(first.path):
            job = job_of(first.spec)
        if changes := difference(first.identity, json.loads(json.dumps(job.identity()))):
            raise OutputExistsError(
                f"{first.path}: was built elsewhere with something else ({'; '.join(changes[:4])}): merge it there"
            )
        self._job = job
        self.maker, self.spec, self.items, self.identity = job.maker, job.spec, job.items, job.identity

    def lay_out(self) -> tuple[Layout, list[list[Place]]]:
        """Return all but the values, and where these go."""
        layout, places = self._job.lay_out()
        for part in self._parts:
            if part.header_sha256 != layout.sha256():
                raise InputFileError(f"{part.path}: its header would differ from the merged file's: merge it elsewhere")
        self._n_fields = [len(fields) for fields in places]
        return layout, places

    def make(self, slab: int, start: int, stop: int) -> list[NDArray[Any]]:
        """Read some items of a slab from the parts."""
        found: list[list[NDArray[Any]]] = [[] for _ in range(self._n_fields[slab])]
        for part in self._parts:
            for k, (of, low, high) in enumerate(pieces(self._job.items, part.start, part.stop)):
                first, last = max(low, start), min(high, stop)
                if of == slab and first < last:
                    with reading(part.path):
                        for field, values in enumerate(found):
                            values.append(part.file[_name(k, field)][first - low : last - low])
        return [np.concatenate(values) for values in found]


def estimate_build(plan: AnyPlan, *, workers: int = 1, trial_seconds: float | None = None) -> dict[str, Any]:
    """Return how large a bank or frame set would be and about how long it would take, from a small trial.

    Parameters
    ----------
    plan : BankPlan, FramePlan or SceneFramesPlan
        Plan of the bank or frame set.
    workers : int
        Processors that will work on it.
    trial_seconds : float, optional
        End the trial after about this time, with a rougher result. None: it takes 64 items.

    Returns
    -------
    dict
        ``images`` or ``views`` and ``frames``, ``bytes``, ``seconds``.
    """
    planned = planned_size(plan)
    total = planned["images" if isinstance(plan, BankPlan) else "views"]
    # most images or views of a plan whose time is estimated on the plan itself; of larger ones a sample is tried
    tried_whole = 200_000
    tried = _thinned(plan) if total > tried_whole else plan
    job = job_for(tried)
    layout, _ = job.lay_out()
    header_bytes = layout.size - planned_size(tried)["bytes"]
    scale = total / sum(job.items)
    total = sum(job.items)
    make_shard(job, 0, 1)  # compiled code is loaded
    trial_items = 64
    count = min(trial_items, total)
    step = max(1, total // count)
    begun = time.perf_counter()
    run = 8 if trial_seconds is None else 1
    starts = np.arange(0, total, step * run)
    if trial_seconds is not None:  # in an order of which every beginning is spread over all of them
        starts = starts[np.argsort(np.arange(len(starts)) * _GOLDEN % 1)]
    made = 0
    for first in starts.tolist():
        made += min(run, total - first)
        make_shard(job, first, min(first + run, total))
        if trial_seconds is not None and time.perf_counter() - begun > trial_seconds:
            break
    seconds = (time.perf_counter() - begun) / made * total * scale / workers
    return {**planned, "bytes": planned["bytes"] + header_bytes, "seconds": seconds}


def _thinned(plan: AnyPlan) -> AnyPlan:
    """Return a plan whose images or views are a sample of those of a large plan, and take as long each."""
    tried_views = 4096
    if isinstance(plan, FramePlan):
        return plan.model_copy(update={"views": tried_views})
    if isinstance(plan, SceneFramesPlan):
        tried_scenes = max(1, tried_views // plan.scenes.steps)
        return plan if plan.scenes.list else plan.with_scenes(tried_scenes)
    plan = plan.resolve()
    assert plan.delta_deg is not None
    tried_values = 64
    grids = {"distance_m": plan.distance_m, "delta_deg": plan.delta_deg}
    return plan.model_copy(update={key: grid[:: math.ceil(len(grid) / tried_values)] for key, grid in grids.items()})
