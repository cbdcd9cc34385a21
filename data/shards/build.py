"""Large files built in shards: placed by offset into FILE.partial, noted in a manifest, resumed, and published whole.

A :class:`Job` says how the file is laid out and makes any range of its items. :func:`build` renders ranges of items
("shards") in any order, by any number of workers, and places each in ``FILE.partial``. ``FILE.manifest`` notes the
SHA-256 of every shard once its bytes are safe on disk, so that a run that was killed is continued from there. When all
are there the file is hashed and gets its name. The bytes depend neither on the workers nor on the size of a shard.

One run writes an output at a time: the run holds a lock on ``FILE.partial``, which ends with the process.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn, Protocol

import numpy as np
from numpy.typing import NDArray

from phasemark import OutputExistsError, UsageError
from phasemark.data.files.atomic_write import finish_publishing, followed, publish, refuse_unwritable, storage_errors
from phasemark.data.files.hdf5_layout import Layout, place
from phasemark.data.files.json_text import json_text
from phasemark.data.files.lock_file import lock_file
from phasemark.data.progress import Progress
from phasemark.inputs import checksum_path, sha256_of

SHARD_BYTES = 1 << 22
"""About how much of the file a shard holds; what a killed run loses is a few of these."""

_FORMAT = "phasemark-manifest"
_SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Place:
    """Place of a dataset in the file: where its items begin, and the bytes that each takes."""

    offset: int
    stride: int

    def moved(self, items: int) -> Place:
        """Return the place some items further on."""
        return Place(self.offset + items * self.stride, self.stride)


class Job(Protocol):
    """Layout of a file: slabs of items, each item with the same fields.

    `maker` is ``module:callable``, the function that makes the same job from its `spec` in another process.
    """

    @property
    def maker(self) -> str:
        """Where another process finds the function that takes the spec."""

    def spec(self) -> dict[str, Any]:
        """Return plain data that the maker makes the same job from."""

    @property
    def items(self) -> Sequence[int]:
        """How many items each slab has."""

    def identity(self) -> dict[str, Any]:
        """Return all that the file's bytes depend on, in plain data: resolved plan, versions, mesh hashes."""

    def lay_out(self) -> tuple[Layout, list[list[Place]]]:
        """Return the closed layout of the file, and for each slab where its fields go."""

    def make(self, slab: int, start: int, stop: int) -> list[NDArray[Any]]:
        """Return the fields of some items of a slab, items first."""


class Maker(Protocol):
    """Makes shards somewhere else; any thread may ask at any time."""

    def make(self, start: int, stop: int) -> Sequence[NDArray[Any]]:
        """Return the arrays of a range of items."""

    def concurrency(self) -> int:
        """Return how many shards are worth asking for at once."""

    def close(self) -> None:
        """Close the executor; calls of :meth:`make` that wait for an answer fail."""


def processors() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_tasks(
    task: Callable[[int], Any], todo: Iterable[int], n_threads: int, *, stop: Callable[[], None] | None = None
) -> Iterator[tuple[int, Any]]:
    """Run a task on every item in threads, and yield (item, result) as they are done, in any order.

    An exception of a task, or one that interrupts the caller, ends the run: items in work are finished, no other is
    begun, and `stop` is called to cut short what waits for others.

    Parameters
    ----------
    task : callable
    todo : iterable
    n_threads : int
    stop : callable, optional
    """
    with ThreadPoolExecutor(max(n_threads, 1)) as pool:
        items = {pool.submit(task, item): item for item in todo}
        finished = False
        try:
            for future in as_completed(items):
                yield items[future], future.result()
            finished = True
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            if not finished and stop is not None:
                stop()


def pieces(items: Sequence[int], start: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Cut a range over all slabs' items into (slab, start, stop) within each slab."""
    first = 0
    for slab, n in enumerate(items):
        low, high = max(start - first, 0), min(stop - first, n)
        if low < high:
            yield slab, low, high
        first += n


def make_shard(job: Job, start: int, stop: int) -> list[NDArray[Any]]:
    """Return the arrays of a range of items, slab by slab and field by field."""
    return [array for piece in pieces(job.items, start, stop) for array in job.make(*piece)]


def difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return the differences between two identities, one ``key: old → new`` each."""
    before, after = dict(_flat(old)), dict(_flat(new))
    return [
        f"{key}: {_shown(before.get(key))} → {_shown(after.get(key))}"
        for key in dict.fromkeys([*before, *after])
        if before.get(key) != after.get(key)
    ]


def refuse_difference(path: Path, old: Mapping[str, Any], new: Mapping[str, Any]) -> None:
    """Refuse to continue what another plan began.

    Raises
    ------
    OutputExistsError
        With what differs.
    """
    changes = difference(old, new)
    if changes:
        shown = "; ".join(changes[:8]) + (f"; and {len(changes) - 8} more" if len(changes) > 8 else "")
        raise OutputExistsError(
            f"{path}: was begun with another plan ({shown}): give the old plan, or force=True to start over"
        )


def refuse_unfinished(path: Path) -> NoReturn:
    """Refuse to throw an unfinished run away unasked."""
    raise OutputExistsError(f"{path}: an unfinished run of it exists: resume=True continues it, force=True starts over")


def manifest_path(path: Path) -> Path:
    """Return where the manifest of a file in the making lies."""
    return path.with_name(path.name + ".manifest")


def partial_path(path: Path) -> Path:
    """Return the name of a file in the making."""
    return path.with_name(path.name + ".partial")


def build(
    job: Job,
    path: str | os.PathLike[str],
    *,
    force: bool = False,
    resume: bool = False,
    workers: int | None = None,
    shard_items: int | None = None,
    maker: Maker | None = None,
    progress: Progress | None = None,
) -> Path:
    """Build a file in shards, or finish one that was begun.

    Parameters
    ----------
    job : Job
    path : path-like
        The file; its checksum, and until it is finished ``FILE.partial`` and ``FILE.manifest``, lie beside it. A link
        is followed: all of them lie beside the file that it leads to.
    force : bool
        Whether a finished file may be replaced, and an unfinished one thrown away.
    resume : bool
        Whether to continue an unfinished run of the same plan. Shards that the manifest notes are read again and
        kept if their SHA-256 is right.
    workers : int, optional
        Threads. None: one for each processor this process may use, or as many as `maker` keeps busy.
    shard_items : int, optional
        Items of a shard; None: about 4 MiB. A resumed run keeps the size it was begun with.
    maker : Maker, optional
        Makes the shards elsewhere, on a cluster.
    progress : callable (done, total), optional
        Called from this thread with the number of items finished so far and in all.

    Returns
    -------
    Path
        `path`.

    Raises
    ------
    OutputExistsError
        The file or an unfinished run exists, another run is writing it, or the plan is not the one it was begun with.
    StorageError
        The disk is full or fails. What has been finished is kept for `resume`.
    UsageError
        A number is out of range.
    """
    for name, value in (("workers", workers), ("shard_items", shard_items)):
        if value is not None and value < 1:
            raise UsageError(f"'{name}' must be at least 1, got {value}")
    given = Path(path)
    path = followed(given)
    if resume and _publish_again(job, path):
        return given
    if resume and not force and path.exists() and partial_path(path).exists():
        raise OutputExistsError(f"{path}: stands beside the unfinished run that replaces it: give force=True, too")
    for target in (given, checksum_path(path)):
        refuse_unwritable(target, force=force)
    with storage_errors(path), _Run.locked(path, force=force) as run:
        run.begin(job, resume=resume, force=force, shard_items=shard_items)
        run.render(job, workers, maker, progress)
        run.publish(force=force)
    return given


def _publish_again(job: Job, path: Path) -> bool:
    """Finish a run that was killed between giving the file its name and writing its checksum."""
    if not path.is_file() or partial_path(path).exists() or not manifest_path(path).exists():
        return False
    manifest = _Manifest.read(manifest_path(path))
    if manifest is None or manifest.file_sha256 is None or sha256_of(path) != manifest.file_sha256:
        return False
    refuse_difference(path, manifest.identity, job.identity())
    finish_publishing(path)
    manifest_path(path).unlink(missing_ok=True)
    return True


@dataclass
class _Manifest:
    """Content of the manifest file: one JSON object a line, the first about the run, then one for each shard."""

    identity: dict[str, Any]
    shard_items: int
    size: int
    header_sha256: str
    shards: dict[int, str] = field(default_factory=dict)
    file_sha256: str | None = None

    @classmethod
    def read(cls, path: Path) -> _Manifest | None:
        """Read a manifest; what a crash left of its last line is ignored. None if nothing can be used."""
        try:
            lines = path.read_bytes().split(b"\n")[:-1]
            head = json.loads(lines[0])
            if head["format"] != _FORMAT or head["schema_version"] != _SCHEMA_VERSION:
                return None
            found = cls(head["identity"], int(head["shard_items"]), int(head["size"]), head["header_sha256"])
            for line in lines[1:]:
                entry = json.loads(line)
                if "shard" in entry:
                    found.shards[int(entry["shard"])] = str(entry["sha256"])
                else:
                    found.file_sha256 = str(entry["file_sha256"])
        except (OSError, ValueError, LookupError, TypeError):
            return None
        return found if found.shard_items > 0 else None

    def head(self) -> bytes:
        return _line(
            format=_FORMAT, schema_version=_SCHEMA_VERSION, shard_items=self.shard_items, size=self.size,
            header_sha256=self.header_sha256, identity=self.identity,
        )  # fmt: skip


def _line(**entry: Any) -> bytes:
    return json_text(entry, sort_keys=True).encode() + b"\n"


class _Run:
    """A run that holds the lock on ``FILE.partial``."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path, self.partial, self.manifest = path, partial_path(path), manifest_path(path)
        self._file = descriptor
        self._log = -1
        self._worth_keeping = False

    @classmethod
    @contextmanager
    def locked(cls, path: Path, *, force: bool) -> Iterator[_Run]:
        """Hold the lock while the block runs; an unfinished run stays if something of it can be used again."""
        descriptor, fresh = lock_file(partial_path(path), path)
        run = cls(path, descriptor)
        run._worth_keeping = not fresh
        ours = [run.partial]
        try:
            run._refuse_foreign(fresh)
            ours.append(run.manifest)
            for target in (path, checksum_path(path)):  # another run may have finished before the lock was ours
                refuse_unwritable(target, force=force)
            yield run
        finally:
            if run._log >= 0:
                os.close(run._log)
            if not run._worth_keeping:
                for leftover in ours:  # a partial file without a manifest is empty
                    with suppress(OSError):
                        leftover.unlink(missing_ok=True)
            os.close(descriptor)  # and with it the lock

    def _refuse_foreign(self, fresh: bool) -> None:
        """Refuse files of somebody else that have the names of an unfinished run."""
        known = _Manifest.read(self.manifest) is not None
        for theirs, exists in (
            (self.manifest, os.path.lexists(self.manifest) and not known),
            (self.partial, not fresh and not known and os.fstat(self._file).st_size > 0),
        ):
            if exists:
                raise OutputExistsError(
                    f"{theirs}: exists and is not of an unfinished run that this version can continue: move it away, or"
                    f" give '{self.path.name}' another name"
                )

    def begin(self, job: Job, *, resume: bool, force: bool, shard_items: int | None) -> None:
        """Create the file with its datasets, or find the shards of an earlier run."""
        layout, places = job.lay_out()
        identity = json.loads(json.dumps(job.identity()))
        header_sha256 = layout.sha256()
        self._job_items, self._places = job.items, places
        self._total = sum(job.items)
        per_item = max(1, layout.size // max(1, self._total))
        items = shard_items or max(1, SHARD_BYTES // per_item)
        fresh = _Manifest(identity, items, layout.size, header_sha256)
        old = _Manifest.read(self.manifest) if self._worth_keeping else None
        if old is not None and not (resume or force):
            refuse_unfinished(self.path)
        same = old is not None and (old.identity, old.header_sha256) == (identity, header_sha256)
        if old is not None and resume and not same and not force:
            refuse_difference(self.path, old.identity, identity)
            raise OutputExistsError(f"{self.path}: was begun with other mesh files: force=True starts over")
        if old is not None and resume and same:
            self.state = old
        else:
            old, self.state, self._worth_keeping = None, fresh, False
            os.ftruncate(self._file, 0)
            self.manifest.unlink(missing_ok=True)
            self._start_manifest()  # before the first byte: what has no manifest is not ours
        layout.write_to(self._file)
        self.state.shards = dict(filter(self._is_intact, self.state.shards.items()))
        self._worth_keeping = bool(self.state.shards)
        os.fsync(self._file)
        if old is not None:
            self._start_manifest()

    def _start_manifest(self) -> None:
        temporary = self.manifest.with_name(f".{self.manifest.name}.new")
        self._log = os.open(temporary, os.O_CREAT | os.O_TRUNC | os.O_WRONLY | os.O_APPEND, 0o666)
        try:
            self._note(self.state.head() + b"".join(_line(shard=k, sha256=v) for k, v in self.state.shards.items()))
            os.replace(temporary, self.manifest)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise

    def _note(self, lines: bytes) -> None:
        view = memoryview(lines)
        while view:
            view = view[os.write(self._log, view) :]
        os.fsync(self._log)

    def _extents(self, shard: int) -> Iterator[tuple[int, int]]:
        """Yield offset and number of bytes of every array of a shard."""
        start, stop = self._range(shard)
        for slab, low, high in pieces(self._job_items, start, stop):
            for where in self._places[slab]:
                yield where.offset + low * where.stride, (high - low) * where.stride

    def _range(self, shard: int) -> tuple[int, int]:
        items = self.state.shard_items
        return shard * items, min((shard + 1) * items, self._total)

    def _is_intact(self, entry: tuple[int, str]) -> bool:
        shard, stated = entry
        if not 0 <= shard * self.state.shard_items < self._total:
            return False
        digest = hashlib.sha256()
        for offset, size in self._extents(shard):
            digest.update(os.pread(self._file, size, offset))
        return digest.hexdigest() == stated

    def render(self, job: Job, workers: int | None, maker: Maker | None, progress: Progress | None) -> None:
        """Make and place the shards that are missing."""
        n_shards = -(-self._total // self.state.shard_items)
        todo = [shard for shard in range(n_shards) if shard not in self.state.shards]
        done = sum(stop - start for start, stop in map(self._range, self.state.shards))

        def task(shard: int) -> str:
            start, stop = self._range(shard)
            arrays = make_shard(job, start, stop) if maker is None else maker.make(start, stop)
            digest = hashlib.sha256()
            for (offset, size), array in zip(self._extents(shard), arrays, strict=True):
                raw = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
                if raw.nbytes != size:
                    raise AssertionError(f"shard {shard}: an array has {raw.nbytes} bytes, must have {size}")
                digest.update(raw.data)
                place(self._file, offset, raw)
            return digest.hexdigest()

        unsafe: dict[int, str] = {}
        last = time.monotonic()
        n_threads = workers or (processors() if maker is None else maker.concurrency())
        commit_seconds = 1.0
        try:
            for shard, digest in run_tasks(task, todo, n_threads, stop=None if maker is None else maker.close):
                unsafe[shard] = digest
                done += self._range(shard)[1] - self._range(shard)[0]
                if time.monotonic() - last > commit_seconds:
                    self._commit(unsafe)
                    last = time.monotonic()
                if progress is not None:
                    progress(done, self._total)
        finally:
            self._commit(unsafe)

    def _commit(self, unsafe: dict[int, str]) -> None:
        """Note shards in the manifest, once their bytes are safe."""
        if unsafe:
            os.fsync(self._file)
            self._note(b"".join(_line(shard=k, sha256=v) for k, v in unsafe.items()))
            self.state.shards.update(unsafe)
            unsafe.clear()
            self._worth_keeping = True

    def publish(self, *, force: bool) -> None:
        """Rename the finished file to its final name."""
        digest = sha256_of(self.partial)
        self._note(_line(file_sha256=digest))
        publish(self.partial, self.path, digest, force=force)
        self.manifest.unlink(missing_ok=True)
        self._worth_keeping = True


def _flat(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _flat(inner, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list | tuple) and any(isinstance(inner, Mapping) for inner in value):
        for index, inner in enumerate(value):
            yield from _flat(inner, f"{key}[{index}]")
    else:
        yield key, list(value) if isinstance(value, tuple) else value


def _shown(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}…"
