"""The grid of a bank: over which period its angles close."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def closing_period(delta_rad: NDArray[np.float64]) -> float | None:
    """Return the period over which a regular grid of angles closes: 2π / n, one step beyond its end; None if none."""
    if len(delta_rad) < 2:
        return None
    step = float(delta_rad[1] - delta_rad[0])
    turns = 2 * np.pi / (delta_rad[-1] - delta_rad[0] + step)
    return float(2 * np.pi / round(turns)) if round(turns) >= 1 and abs(turns - round(turns)) < 1e-6 else None
