"""Two sweeps side by side: which differences are more than chance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy import special

from phasemark import UsageError
from phasemark.data.files.json_text import finite_or_none
from phasemark.matcher.sweep.plan import Condition
from phasemark.matcher.sweep.result_tables import Cell

FAMILY_LEVEL = 0.05
"""Probability of marking any difference at all where there is none (Holm's correction)."""


@dataclass(frozen=True)
class Difference:
    """One number of one cell in two sweeps.

    Parameters
    ----------
    condition : Condition
        The condition.
    method : str
        Name of the method.
    quantity : str
        ``rmse distance_m`` or ``class_right``, for instance.
    first, second : float
        RMSE in the first and in the second sweep.
    p_value : float
        Two-sided, not corrected.
    significant : bool
        After Holm's correction for all differences compared.
    """

    condition: Condition
    method: str
    quantity: str
    first: float
    second: float
    p_value: float
    significant: bool

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain numbers and text, for JSON; None where there is no number."""
        return finite_or_none(asdict(self))


def compare_cells(first: Sequence[Cell], second: Sequence[Cell]) -> tuple[Difference, ...]:
    """Compare the cells that two sweeps share, same condition and same method.

    Root mean squares are compared by the logarithm with standard errors from their intervals, shares by the pooled
    two-sample z-test; both take the sweeps for independent, which is on the safe side where they share their seed.

    Parameters
    ----------
    first, second : sequence of Cell
        Cells of the two sweeps.

    Returns
    -------
    tuple of Difference

    Raises
    ------
    UsageError
        They share none.
    """
    others = {(cell.condition, cell.method): cell for cell in second}
    found: list[Difference] = []
    for cell in first:
        other = others.get((cell.condition, cell.method))
        if other is None:
            continue
        for name in cell.free:
            if name in other.rmse:
                a, b = cell.rmse[name], other.rmse[name]
                errors = [math.log(x.high / x.value) if x.value > 0 and x.high < math.inf else math.nan for x in (a, b)]
                scale = math.hypot(*errors) / float(special.ndtri(0.975))
                z = (math.log(a.value / b.value) / scale) if scale > 0 else 0.0 if a.value == b.value else math.nan
                found.append(_difference(cell, f"rmse {name}", a.value, b.value, z))
        for name in ("class_right", "outliers", "accepted"):
            share, of = getattr(cell, name).value, getattr(other, name).value
            n, m = (x.n * (x.answered.value if name == "outliers" else 1.0) for x in (cell, other))
            if n == 0 or m == 0:
                continue
            pooled = (share * n + of * m) / (n + m)
            scale = math.sqrt(pooled * (1 - pooled) * (1 / n + 1 / m))
            found.append(_difference(cell, name, share, of, (share - of) / scale if scale else 0.0))
    if not found:
        raise UsageError("the two sweeps share no condition and method: there is nothing to compare")
    return _marked(found)


def _difference(cell: Cell, quantity: str, first: float, second: float, z: float) -> Difference:
    p_value = 1.0 if math.isnan(z) else float(2 * special.ndtr(-abs(z)))
    return Difference(cell.condition, cell.method, quantity, first, second, p_value, False)


def _marked(found: list[Difference]) -> tuple[Difference, ...]:
    """Mark what stays significant by Holm's step-down procedure."""
    p_values = np.array([one.p_value for one in found])
    order = np.argsort(p_values, kind="stable")
    significant = np.zeros(len(found), bool)
    significant[order] = np.logical_and.accumulate(p_values[order] <= FAMILY_LEVEL / np.arange(len(found), 0, -1))
    return tuple(replace(one, significant=bool(mark)) for one, mark in zip(found, significant, strict=True))
