"""Connected components of a graph, numbered in the order of their first nodes."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


def component_labels(n: int, pairs: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the number of each node's connected component, (n,), from 0 in the order of the first nodes.

    Parameters
    ----------
    n : int
        Number of nodes.
    pairs : (m, 2) int64
        Nodes that are joined.
    """
    return np.asarray(_label(n, np.ascontiguousarray(pairs, np.int64)))


@njit(cache=True)
def _label(n, pairs):  # type: ignore[no-untyped-def]
    above = np.arange(n)  # of each node one of its component with a smaller number, or itself
    for k in range(len(pairs)):
        a, b = pairs[k, 0], pairs[k, 1]
        while above[a] != a:
            above[a] = above[above[a]]
            a = above[a]
        while above[b] != b:
            above[b] = above[above[b]]
            b = above[b]
        if a < b:
            above[b] = a
        else:
            above[a] = b
    label = np.empty(n, np.int32)
    found = 0
    for node in range(n):
        if above[node] == node:
            label[node] = found
            found += 1
        else:
            label[node] = label[above[node]]
    return label
