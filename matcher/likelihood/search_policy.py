"""The numbers that steer the search for the most likely view: how wide, how long, and when it is enough.

They decide which minima of the likelihood are found, and at what cost, not what is accepted.
``python benchmarks/run.py policy`` halves and doubles each of them and tells how answers and rendered views change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from phasemark import UsageError

__all__ = ["DEFAULT_POLICY", "SearchPolicy"]

_MAY_BE_ZERO = ("cache_bytes",)
_PROBABILITIES = ("doubtful_p",)


@dataclass(frozen=True)
class SearchPolicy:
    """Tuning numbers of the maximum-likelihood search.

    Costs are whitened squared residuals, χ² of one pixel being 1 on average.

    Parameters
    ----------
    frames_at_once : int
        Frames that are matched together at most; memory grows with it. Of images of more than 4096 pixels there are
        fewer.
    cache_bytes : int
        Room for rendered images that other frames may start from too; frames taken at one place do. 0 keeps none.
    prior_sigma : float
        Widest bearing that is searched, in standard deviations of its prior.
    max_iterations : int
        Steps of one descent.
    margin_cost : float
        A rough fit whose cost is larger by this does not become the best one: a column of pixels on the wrong side of
        an edge costs half as much.
    likely_cost : float
        An explanation whose cost is larger by this has no probability worth telling.
    close_cost : float
        A fit whose cost is above its frame's best by more will not become the best: its surroundings are not looked at.
    doubtful_p : float
        p-value at which a fit before an estimated background is doubted, and wall, floor and view move together.

    Raises
    ------
    UsageError
        A field is out of its range; the message names it.
    """

    frames_at_once: int = 256
    cache_bytes: int = 1 << 26
    prior_sigma: float = 3.0
    max_iterations: int = 30
    margin_cost: float = 500.0
    likely_cost: float = 100.0
    close_cost: float = 50.0
    doubtful_p: float = 0.05

    def __repr__(self) -> str:
        """Name the fields that differ from their defaults."""
        own = [f"{one.name}={value!r}" for one in fields(self) if (value := getattr(self, one.name)) != one.default]
        return f"SearchPolicy({', '.join(own)})"

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            whole = isinstance(field.default, int)
            kind = int if whole else (int, float)
            least = 1 if whole and field.name not in _MAY_BE_ZERO else 0
            good = isinstance(value, kind) and not isinstance(value, bool) and math.isfinite(value)
            good = good and (value >= least if whole else value > 0)
            if field.name in _PROBABILITIES:
                good = good and value < 1
            if not good:
                limits = f"an integer of at least {least}" if whole else "positive"
                limits = "in (0, 1)" if field.name in _PROBABILITIES else limits
                raise UsageError(f"'policy': {field.name!r} must be {limits}, got {value!r}")


DEFAULT_POLICY = SearchPolicy()
"""The tuning numbers of the likelihood search."""
