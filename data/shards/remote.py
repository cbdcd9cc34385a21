"""Shards made elsewhere, on a Dask cluster.

A shard travels as raw bytes and is placed in the file here, so workers need no shared disk; only mesh files that a
plan names must lie at the same path everywhere, and are compared by their hash. The shard of a
worker that dies is made again.
"""

from __future__ import annotations

import functools
import importlib
import json
import sys
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import PhasemarkError, StorageError, UsageError
from phasemark.data.shards.build import Job, Maker, difference, make_shard

ATTEMPTS = 20
"""How often a shard is tried again when workers die under it."""

CONNECT_SECONDS = 10
"""How long a Dask scheduler may take to answer."""

PATIENCE_SECONDS = 10
"""How long a shard may take before a look whether the cluster has any worker."""


def check_scheduler(scheduler: str) -> None:
    """Refuse what is neither ``threads`` nor an address.

    Raises
    ------
    UsageError
        It is neither.
    """
    if scheduler != "threads" and "://" not in scheduler:
        raise UsageError(f"scheduler=… must be threads or an address such as tcp://HOST:8786, got '{scheduler[:40]}'")


def open_maker(scheduler: str, job: Job) -> Maker | None:
    """Return the maker of a job's shards: None for threads of this process.

    Parameters
    ----------
    scheduler : str
        ``threads``, or a Dask scheduler's address such as ``tcp://host:8786``.
    job : Job

    Raises
    ------
    UsageError
        It is neither, Dask is not installed, or its scheduler cannot be reached.
    """
    check_scheduler(scheduler)
    return None if scheduler == "threads" else DaskMaker(job, scheduler)


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
        self._described = json.dumps([job.maker, job.spec()]), json.dumps(job.identity())
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
