"""The same function of several items, one after the other or in threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np

from phasemark import UsageError

Item = TypeVar("Item")
Result = TypeVar("Result")


def check_workers(workers: Any) -> None:
    """Refuse a number of threads that is none.

    Raises
    ------
    UsageError
    """
    if not (isinstance(workers, int | np.integer) and workers >= 1):
        raise UsageError(f"'workers' must be at least 1, a whole number, got {workers!r}")


def mapped(function: Callable[[Item], Result], items: Sequence[Item], workers: int) -> list[Result]:
    """Return a function of every item, in the order of the items.

    Parameters
    ----------
    function : callable
    items : sequence
    workers : int
        Threads; none is started for one of them or for one item.
    """
    if workers == 1 or len(items) < 2:
        return [function(one) for one in items]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(function, items))
