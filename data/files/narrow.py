"""Whole numbers brought to the type of a file, none of them wrapped around."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError


def narrowed(values: ArrayLike, kind: str, what: str) -> NDArray[Any]:
    """Return numbers in the type that a file has for them; floats are only converted.

    Parameters
    ----------
    values : array-like
    kind : str
        Type of the file, ``<i2`` for instance.
    what : str
        What the numbers count, for the message.

    Raises
    ------
    UsageError
        A whole number does not fit into the type.
    """
    array, dtype = np.asarray(values), np.dtype(kind)
    if dtype.kind in "iu" and array.size:
        limits = np.iinfo(dtype)
        low, high = int(array.min()), int(array.max())
        if low < limits.min or high > limits.max:
            wrong = low if low < limits.min else high
            raise UsageError(f"{what}: the numbers in a file must be in {limits.min} … {limits.max}, got {wrong}")
    return array.astype(dtype)
