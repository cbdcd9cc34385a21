"""Images of views that many frames start from, kept within a stated number of bytes.

A search starts at views of the bank's grid, so frames taken at one place start at the same few views.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable

import numpy as np
from numpy.typing import NDArray

Arrays = tuple[NDArray[np.generic], ...]


class ViewCache:
    """The images used last, by a key that says all they depend on; threads may share it.

    Parameters
    ----------
    max_bytes : int
        Room for the arrays; what was used longest ago is dropped first. 0 keeps nothing.

    Examples
    --------
    >>> cache = ViewCache(100)
    >>> cache.put("a", (np.zeros(8),)), cache.put("b", (np.zeros(8),))
    (None, None)
    >>> cache.get("a") is None, cache.n_bytes
    (True, 64)
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self.n_bytes = 0
        """Bytes that the arrays take now."""
        self._kept: OrderedDict[Hashable, Arrays] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable) -> Arrays | None:
        """Return the arrays of a key, or None."""
        with self._lock:
            found = self._kept.get(key)
            if found is not None:
                self._kept.move_to_end(key)
            return found

    def put(self, key: Hashable, arrays: Arrays) -> None:
        """Keep arrays, and drop others until all fit; arrays that are larger than the room are not kept."""
        size = _size(arrays)
        with self._lock:
            self.n_bytes -= _size(self._kept.pop(key, ()))
            if size > self.max_bytes:
                return
            self._kept[key] = arrays
            self.n_bytes += size
            while self.n_bytes > self.max_bytes:
                self.n_bytes -= _size(self._kept.popitem(last=False)[1])


def _size(arrays: Arrays) -> int:
    return sum(values.nbytes for values in arrays)
