"""Run shard tasks in a local thread pool, or elsewhere by :mod:`phasemark.data.shards.remote`.

Every shard of a build depends on the job and its range of items alone, so a task may be repeated, done twice or moved
to another worker, and nothing changes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any, Protocol, TypeVar

from numpy.typing import NDArray

T = TypeVar("T")
R = TypeVar("R")


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
    task: Callable[[T], R], todo: Iterable[T], n_threads: int, *, stop: Callable[[], None] | None = None
) -> Iterator[tuple[T, R]]:
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
