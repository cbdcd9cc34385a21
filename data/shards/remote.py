"""Shards made elsewhere: by worker processes of this machine, or on a Dask cluster.

A shard travels as raw bytes and is placed in the file here, so workers need no shared disk; only mesh files that a
plan names must lie at the same path everywhere, and are compared by their hash. A worker that dies is replaced, and its
shard made again.
"""

from __future__ import annotations

import functools
import importlib
import json
import os
import queue
import struct
import subprocess
import sys
import threading
import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from phasemark import PhasemarkError, StorageError, UsageError
from phasemark.data.plans.grid_axis import as_count
from phasemark.data.shards.build import Job, difference, make_shard
from phasemark.data.shards.executor import Maker

ATTEMPTS = 20
"""How often a shard is tried again when workers die under it."""

CONNECT_SECONDS = 10
"""How long a Dask scheduler may take to answer."""

PATIENCE_SECONDS = 10
"""How long a shard may take before a look whether the cluster has any worker."""

MOST_PROCESSES = 1024
_LENGTH = struct.Struct("<q")


def check_scheduler(scheduler: str) -> int | None:
    """Return the number of processes that ``local:N`` asks for, None for anything else that can be a scheduler.

    Raises
    ------
    UsageError
        It is neither ``threads``, ``local:N`` nor an address.
    """
    kind, _, count = scheduler.partition(":")
    if kind == "local":
        n = as_count(count)
        if n is None or not 1 <= n <= MOST_PROCESSES:
            raise UsageError(
                f"scheduler=local:N needs a number of processes, 1 to {MOST_PROCESSES}, got '{scheduler[:40]}'"
            )
        return n
    if scheduler != "threads" and "://" not in scheduler:
        raise UsageError(
            f"scheduler=… must be threads, local:N or an address such as tcp://HOST:8786, got '{scheduler}'"
        )
    return None


def open_maker(scheduler: str, job: Job) -> Maker | None:
    """Return the maker of a job's shards: None for threads of this process.

    Parameters
    ----------
    scheduler : str
        ``threads``, ``local:N``, or a Dask scheduler's address such as ``tcp://host:8786``.
    job : Job

    Raises
    ------
    UsageError
        It is none of these, Dask is not installed, or its scheduler cannot be reached.
    """
    processes = check_scheduler(scheduler)
    if scheduler == "threads":
        return None
    return DaskMaker(job, scheduler) if processes is None else ProcessMaker(job, processes)


@functools.lru_cache(maxsize=4)
def _job(spec: str, identity: str) -> Job:
    """Return the job that was sent, if this process would make the same bytes of it."""
    maker, described = json.loads(spec)
    module, _, name = maker.partition(":")  # what is sent comes from the program that asks, not from a file
    job: Job = getattr(importlib.import_module(module), name)(described)
    changes = difference(json.loads(identity), json.loads(json.dumps(job.identity())))
    if changes:
        raise UsageError(f"a worker would make other bytes ({'; '.join(changes[:4])}): install the same everywhere")
    return job


def make_bytes(spec: str, identity: str, start: int, stop: int) -> list[bytes]:
    """Make a shard in a worker and return the raw bytes of its arrays."""
    return [np.ascontiguousarray(array).tobytes() for array in make_shard(_job(spec, identity), start, stop)]


def _described(job: Job) -> tuple[str, str]:
    return json.dumps([job.maker, job.spec()]), json.dumps(job.identity())


class ProcessMaker:
    """Makes shards in worker processes, each an ordinary program that ends when this process does.

    The standard library's ProcessPoolExecutor would lose four things: its workers outlive a parent that is killed,
    take a main guard in the script that asks, fail all at once when one dies, and cannot be ended while they work.
    Dask's LocalCluster is in an extra, and takes the guard, too.

    Parameters
    ----------
    job : Job
    n : int
        How many processes.
    """

    def __init__(self, job: Job, n: int) -> None:
        self._described = _described(job)
        self._n = n
        self._idle: queue.SimpleQueue[_Process | None] = queue.SimpleQueue()
        for _ in range(n):
            self._idle.put(None)
        self._all: set[_Process] = set()
        self._guard = threading.Lock()
        self._closed = False

    def concurrency(self) -> int:
        """Return the number of processes."""
        return self._n

    def make(self, start: int, stop: int) -> Sequence[NDArray[Any]]:
        """Make a shard in a process; in another one if it dies."""
        worker = self._idle.get()
        try:
            for _ in range(ATTEMPTS):
                if worker is None:
                    worker = self._begin()
                answer = worker.ask(start, stop)
                if answer is not None:
                    return [np.frombuffer(raw, np.uint8) for raw in answer]
                self._end(worker)
                worker = None
            raise StorageError(f"{ATTEMPTS} worker processes died over items {start} … {stop - 1}")
        finally:
            self._idle.put(worker)

    def _begin(self) -> _Process:
        with self._guard:
            if self._closed:
                raise StorageError("the worker processes have been ended")
            worker = _Process(*self._described)
            self._all.add(worker)
        return worker

    def _end(self, worker: _Process) -> None:
        worker.end()
        with self._guard:
            self._all.discard(worker)

    def close(self) -> None:
        """End all processes."""
        with self._guard:
            self._closed = True
            for worker in self._all:
                worker.end()
            self._all.clear()


class _Process:
    """One worker process."""

    def __init__(self, spec: str, identity: str) -> None:
        # -P: the working folder is no place for modules unless it is one here
        modules = os.pathsep.join(entry for entry in sys.path if entry)
        self._child = subprocess.Popen(
            [sys.executable, "-P", "-c", "from phasemark.data.shards.remote import serve; serve()"],
            env={**os.environ, "PYTHONPATH": modules},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for the program that asks, which then ends its workers
        )
        with suppress(OSError):
            self._send({"spec": spec, "identity": identity})

    def _send(self, request: dict[str, Any]) -> None:
        assert self._child.stdin is not None
        self._child.stdin.write(json.dumps(request).encode() + b"\n")
        self._child.stdin.flush()

    def ask(self, start: int, stop: int) -> list[bytes] | None:
        """Return a shard's bytes; None if the process is no more."""
        assert self._child.stdout is not None
        try:
            self._send({"start": start, "stop": stop})
            count = _LENGTH.unpack(_exactly(self._child.stdout, 8))[0]
            if count < 0:  # an error's message
                kind, message, notes = json.loads(_exactly(self._child.stdout, -count))
                failed = _ERRORS.get(kind, PhasemarkError)(message)
                for note in notes:
                    failed.add_note(note)
                raise failed
            return [
                _exactly(self._child.stdout, _LENGTH.unpack(_exactly(self._child.stdout, 8))[0]) for _ in range(count)
            ]
        except PhasemarkError:
            raise
        except (OSError, EOFError, ValueError):
            return None

    def end(self) -> None:
        """Kill the process."""
        self._child.kill()
        self._child.wait()
        for pipe in (self._child.stdin, self._child.stdout):
            with suppress(OSError, ValueError):
                assert pipe is not None
                pipe.close()


_ERRORS: dict[str, type[PhasemarkError]] = {kind.__name__: kind for kind in PhasemarkError.__subclasses__()}


def _exactly(pipe: IO[bytes], size: int) -> bytes:
    data = pipe.read(size)
    if len(data) < size:
        raise EOFError
    return data


class DaskMaker:
    """Makes shards on a Dask cluster.

    Parameters
    ----------
    job : Job
    address : str
        Of the scheduler.
    """

    def __init__(self, job: Job, address: str) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise UsageError(
                "scheduler=… with an address needs Dask: pip install -e '.[dask]' in the clone of phasemark"
            ) from None
        try:
            connect: Any = Client
            self._client: Any = connect(address, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError) as error:
            raise UsageError(f"no Dask scheduler answers at {address} ({' '.join(str(error).split())})") from None
        self._address = address
        self._told = False
        self._described = _described(job)
        self._serial = iter(range(sys.maxsize))
        self._closed = False

    def concurrency(self) -> int:
        """Return twice the number of the cluster's threads, so that none waits."""
        return max(2, 2 * int(sum(self._client.nthreads().values())))

    def make(self, start: int, stop: int) -> Sequence[NDArray[Any]]:
        """Have the cluster make a shard; again, if its worker dies. Without workers, say so once and wait for one."""
        from distributed import KilledWorker

        for _ in range(ATTEMPTS):
            if self._closed:
                break
            key = f"phasemark-{id(self)}-{start}-{stop}-{next(self._serial)}"  # a new key: nothing is remembered of it
            future = self._client.submit(make_bytes, *self._described, start, stop, key=key, pure=False, retries=5)
            try:
                return [np.frombuffer(raw, np.uint8) for raw in self._answer(future)]
            except KilledWorker:
                continue
            except PhasemarkError:
                raise
            except (OSError, EOFError):
                continue
            finally:
                future.release()
        raise StorageError(f"the cluster lost items {start} … {stop - 1} {ATTEMPTS} times")

    def _answer(self, future: Any) -> Sequence[bytes]:
        while True:
            try:
                answer: Sequence[bytes] = future.result(timeout=PATIENCE_SECONDS)
            except TimeoutError:
                if future.done():
                    raise
                if not self._told and not self._client.nthreads():
                    self._told = True
                    warnings.warn(f"no worker is connected to {self._address}: waiting for one", stacklevel=2)
            else:
                return answer

    def close(self) -> None:
        """Leave the cluster."""
        if not self._closed:
            self._closed = True
            self._client.close(timeout=2)


def serve() -> None:
    """Answer requests from standard input until there are no more: the program of a worker process."""
    requests, answers = sys.stdin.buffer, sys.stdout.buffer
    sys.stdout = sys.stderr  # nothing a library prints may get between the answers
    with suppress(BrokenPipeError, KeyboardInterrupt):
        described = json.loads(requests.readline())
        while line := requests.readline():
            request = json.loads(line)
            try:
                arrays = make_bytes(described["spec"], described["identity"], request["start"], request["stop"])
            except PhasemarkError as error:
                notes = getattr(error, "__notes__", [])
                raw = json.dumps([type(error).__name__, str(error), notes]).encode()
                answers.write(_LENGTH.pack(-len(raw)) + raw)
            else:
                answers.write(_LENGTH.pack(len(arrays)))
                for array in arrays:
                    answers.write(_LENGTH.pack(len(array)))
                    answers.write(array)
            answers.flush()
