"""The numbers that steer the search for the most likely view: how wide, how long, and when it is enough.

Most decide which minima of the likelihood are found, and at what cost. ``slope_width``, ``axis_rounds`` and
``strange_sigma`` enter the covariance, and the numbers of the last group decide what is accepted.
``python benchmarks/run.py policy`` halves and doubles each of them and tells how answers and rendered views change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from phasemark import UsageError
from phasemark.matcher.pixel_agreement import MIN_RETURNS

__all__ = ["DEFAULT_POLICY", "SearchPolicy"]


def _degrees(*angles: float) -> tuple[float, ...]:
    return tuple(math.radians(angle) for angle in angles)


_MAY_BE_ZERO = ("cache_bytes", "settling_rounds", "background_rounds")
_PROBABILITIES = ("doubtful_p", "refused_p", "ambiguity")


@dataclass(frozen=True)
class SearchPolicy:
    """Tuning numbers of the maximum-likelihood search.

    Costs are whitened squared residuals, χ² of one pixel being 1 on average. Lengths are in metres, angles in radians.
    A natural unit is 1 cm or 1°.

    Parameters
    ----------
    min_returns : int
        Returns that a frame needs to be searched at all.
    frames_at_once : int
        Frames that are matched together at most; memory grows with it. Of images of more than 4096 pixels there are
        fewer.
    cache_bytes : int
        Room for rendered images that other frames may start from too; frames taken at one place do. 0 keeps none.
    fine_grid, coarse_grid : (float, float)
        Widest steps of a bank, metres and radians, on which interpolated images are at the bound, and on which they
        lead to the solution.

    prior_sigma : float
        Widest bearing that is searched, in standard deviations of its prior.

    max_iterations : int
        Steps of one descent.
    longest_step, step_after_scout, step_after_scout_aside : float
        Longest step in natural units: of a descent, of one before a background or on phasors that starts where a scout
        ended, and of others after a scout. Near a solution it is short: where an edge crosses a pixel's border, slopes
        jump.
    settled_cost, rough_cost : float
        A step that promises to lower the cost by less is not taken, and one that promised less than a hundred times as
        much was the last; the second for first comparisons of minima.
    kept_slopes_cost : float
        Where a step promises less than this, slopes rendered before serve again, until a step with them fails.
    optimism : float
        A descent gives up where even this many times the promised decrease would not save it.

    close_by_rad : tuple of float
        Offsets of δ at which a solution before a background or on phasors is compared with a parabola.
    parabola_share : float
        A cost there below this share of the parabola's shows another minimum.
    promising_cost : float
        What a view beside a solution may cost more and still lead to a better one.
    slope_width : float
        Least half width, in natural units, over which final slopes are differenced, so that a kink narrower than this
        does not make the covariance.
    axis_rounds : int
        Where height, pitch or roll is free, slopes are differenced along the axes of the covariance, which they make
        in turn: how often.
    close_cost : float
        A fit whose cost is above its frame's best by more will not become the best: its surroundings are not looked at.
    recount_cost : float
        Cost by which a view may grow, contradicted pixels included, after deciding again which pixels count.
    settling_rounds : int
        How often a view that contradicts some pixels is left for a better one nearby.
    settling_sigma : tuple of float
        Where those are looked for, in standard deviations along the axes of the covariance.

    margin_cost : float
        A rough fit whose cost is larger by this does not become the best one: a column of pixels on the wrong side of
        an edge costs half as much.
    likely_cost : float
        An explanation whose cost is larger by this has no probability worth telling.
    most_refined : int
        Explanations of a frame that are looked around where none fits, and that move with an estimated background.
    same_m, same_rad : float
        Fits of one class nearer to each other than this are one.

    doubtful_p : float
        p-value at which a fit before an estimated background is doubted, and wall, floor and view move together.
    refused_p : float
        p-value at which views around the best fits are tried too.

    strange_sigma : float
        Among unknown things, a return farther from the model than this sees something else.
    explained_per_parameter : int
        Returns that each free parameter takes among unknown things.
    pixels_against_far_view : int
        Unexplained pixels that must stand against a far view of the same landmark among unknown things.

    walls_beyond_m : tuple of float
        Distances behind the landmark at which a wall is tried where no pixel sees the background alone.
    background_rounds : int
        How often background and views are fitted in turn.
    other_angles : int
        Angles that a frame before an estimated background is tried from where nothing else fits.

    tolerated_sigma : float
        Standard deviations that must lie within the tolerance of an accepted answer.
    ambiguity : float
        Largest probability that an accepted answer leaves to other classes.

    Raises
    ------
    UsageError
        A field is out of its range; the message names it.
    """

    min_returns: int = MIN_RETURNS
    frames_at_once: int = 256
    cache_bytes: int = 1 << 26
    fine_grid: tuple[float, float] = (0.011, math.radians(1.1))
    coarse_grid: tuple[float, float] = (0.022, math.radians(2.2))

    prior_sigma: float = 3.0

    max_iterations: int = 30
    longest_step: float = 3.0
    step_after_scout: float = 0.1
    step_after_scout_aside: float = 1.0
    settled_cost: float = 1e-3
    rough_cost: float = 0.1
    kept_slopes_cost: float = 30.0
    optimism: float = 3.0

    close_by_rad: tuple[float, ...] = _degrees(-0.7, -0.28, -0.12, 0.12, 0.28, 0.7)
    parabola_share: float = 0.5
    promising_cost: float = 20.0
    slope_width: float = 0.05
    axis_rounds: int = 3
    close_cost: float = 50.0
    recount_cost: float = 25.0
    settling_rounds: int = 3
    settling_sigma: tuple[float, ...] = (-5.0, -2.5, -1.5, -1.0, -0.5, -0.25, 0.25, 0.5, 1.0, 1.5, 2.5, 5.0)

    margin_cost: float = 500.0
    likely_cost: float = 100.0
    most_refined: int = 12
    same_m: float = 2e-3
    same_rad: float = math.radians(0.2)

    doubtful_p: float = 0.05
    refused_p: float = 0.01

    strange_sigma: float = 5.0
    explained_per_parameter: int = 6
    pixels_against_far_view: int = 4

    walls_beyond_m: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    background_rounds: int = 4
    other_angles: int = 12

    tolerated_sigma: float = 3.0
    ambiguity: float = 1e-3

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(field.default, tuple):
                self._check_tuple(field.name, value, field.default)
                continue
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

    def _check_tuple(self, name: str, value: object, default: tuple[float, ...]) -> None:
        """Check a tuple of numbers: grids have two positive ones, the others any number of finite ones."""
        grid = name.endswith("_grid")
        good = isinstance(value, tuple) and (not grid or len(value) == len(default))
        for one in value if isinstance(value, tuple) else ():
            good = good and isinstance(one, (int, float)) and not isinstance(one, bool) and math.isfinite(one)
            good = good and (not grid or one > 0)
        if not good:
            wanted = "two positive numbers, metres and radians" if grid else "a tuple of finite numbers"
            raise UsageError(f"'policy': {name!r} must be {wanted}, got {value!r}")


DEFAULT_POLICY = SearchPolicy()
