"""Random streams keyed by what they are for, so that any frame can be drawn again alone."""

from __future__ import annotations

import hashlib

import numpy as np

from phasemark import UsageError


def stream(seed: int, purpose: str, index: int) -> np.random.Generator:
    """Return the random stream of one item of a run.

    A Philox generator with seed and purpose in its key and the index in its counter: the stream depends on these three
    alone, not on what was drawn before, in which order, or by how many workers.

    Parameters
    ----------
    seed : int
        Root seed of the run, 0 … 2⁶⁴ − 1.
    purpose : str
        What the numbers are for; different purposes have unrelated streams.
    index : int
        Number of the item, 0 … 2⁶⁴ − 1.

    Raises
    ------
    UsageError
        Seed or index is out of range.

    Examples
    --------
    >>> first, again = stream(7, "frames", 17), stream(7, "frames", 17)
    >>> bool(first.random() == again.random())
    True
    """
    for name, value in (("seed", seed), ("index", index)):
        if not 0 <= value < 2**64:
            raise UsageError(f"'{name}' must be in 0 … 2^64 − 1, got {value!r}")
    label = int.from_bytes(hashlib.sha256(purpose.encode()).digest()[:8], "little")
    # the lower half of the counter counts the numbers drawn, 2^128 of them before the next index begins
    key, counter = np.array([seed, label], np.uint64), np.array([0, 0, index, 0], np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=counter))
