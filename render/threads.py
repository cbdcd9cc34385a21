"""The same function of several items, one after the other or in threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


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
