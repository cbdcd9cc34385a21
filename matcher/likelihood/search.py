"""The search for the most likely views of a batch of frames: docs/matching_method.md."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.matcher.chi_squared import largest_costs
from phasemark.matcher.estimate.acceptance import is_acceptable
from phasemark.matcher.estimate.fits import BETTER_COST, Fits, best_of_frame, least_of_frame
from phasemark.matcher.likelihood.candidates import costs_on_scout, fit_neighbouring_views, fit_starts
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.setup import Scene, Setup
from phasemark.matcher.nearest.bank_minima import Known, Search, Starts
from phasemark.matcher.nearest.templates import Observation
from phasemark.matcher.pixel_agreement import DISAGREEMENT, MIN_RETURNS

__all__ = ["are_doubtful", "search_views"]

_REFUSED_P = 0.01
"""p-value at which views around the best fits are tried too."""


_MANY_STARTS = 30
"""Starts of a frame that take longer than cells before its own background."""
_SLACK = 8 * DISAGREEMENT
"""Cost by which a scout in the middle of a cell may be above a view of it, among the few zones of a chip, and by which
the bound of another cell may be below that of the right one, whose views are level."""
_STARTS_AT_ONCE = 4096
"""Starts that are refined together, but for those of one frame: each has an image of it."""


def search_views(setup: Setup, scene: Scene, evidence: Evidence, seen: Observation, bare: NDArray[np.float64]) -> Fits:
    """Return what explains each frame, the best views among them.

    Parameters
    ----------
    setup : Setup
    scene : Scene
    evidence : Evidence
        n frames.
    seen : Observation
        What the search in the bank sees of them. It is `evidence.seen`, but for an estimated background, which hides
        the pixels that see it.
    bare : (n,) float64
        Cost of a scene without a landmark.
    """
    which, nu = _worth_a_search(setup, evidence, bare), evidence.scatter_freedom
    # 1, 2  bound the cost in every cell of the bank, and start in those that may hold an explanation
    cost_of = costs_on_scout(setup, scene, evidence, which)
    limit, search = _limit(setup, seen[which], nu[which]), scene.search.of_frames(which)
    if setup.unknown and setup.reports_one_surface:  # where most zones see other things, no view explains a frame
        limit = np.full(len(which), np.inf)
    starts = search.starts(seen[which], limit, cost_of)
    # 3, 4  descend from there, and refine on final images
    fits = fit_starts(setup, scene, evidence, which, starts, _most(setup, evidence[which]))
    # 5  where nothing fits, look around the best fits
    poor = np.flatnonzero(are_doubtful(setup, fits, len(evidence.weight), _REFUSED_P))
    if poor.size:
        fits = Fits.joined([fits, fit_neighbouring_views(setup, scene, evidence, poor, fits)])
    # 6  where the best fit would be accepted, look for rivals in all cells that are left
    return _with_rivals(setup, scene, evidence, seen, fits)


def _with_rivals(setup: Setup, scene: Scene, evidence: Evidence, seen: Observation, fits: Fits) -> Fits:
    """Return fits with those of all cells that may hold a rival of an answer that would be accepted.

    Every cell of the bank whose bound allows a rival is descended from, or lies within two cells of one that is; of an
    answer that was found better on the way, too. A descent may still stop above the lowest point of its cell.
    """
    which = np.arange(len(evidence.weight))
    while True:
        best = best_of_frame(fits)
        best = best[np.isin(fits.frame[best], which)]
        if setup.unknown and setup.reports_one_surface:  # few zones lead few descents to the best view
            best = best[fits.p_value[best] >= setup.rules.false_alarm]
        else:
            best = best[[is_acceptable(setup.rules, fits, int(k)) for k in best]]
        if not best.size:
            return fits
        which = fits.frame[best]
        limit, most = _limit(setup, seen[which], evidence.scatter_freedom[which]), _most(setup, evidence[which])
        closed_limit = _limit(setup, evidence.seen[which], evidence.scatter_freedom[which])
        if setup.huber is None:
            most = np.minimum(most, fits.cost[best] + setup.rules.rival_cost)
        if evidence.on == "ranges" and setup.huber is None:
            closed_limit = np.minimum(closed_limit, most)
        if seen is evidence.seen:
            limit = closed_limit
        if setup.unknown and setup.reports_one_surface:  # every unexplained return costs, and few are explained
            limit, most = fits.capped[best] + setup.rules.rival_cost, fits.cost[best] + setup.rules.rival_cost
        near = fits.cost <= least_of_frame(fits, len(evidence.weight))[fits.frame] + setup.rules.rival_cost
        known = fits[near & np.isin(fits.frame, which)]
        places = [(known.class_index[own], known.view[own]) for own in (known.frame == k for k in which)]
        slack = _SLACK if setup.reports_one_surface and setup.unknown else math.inf
        cost_of = costs_on_scout(setup, scene, evidence, which)
        starts = scene.search.of_frames(which).uncovered(seen[which], limit, places, cost_of, slack)
        if scene.closed_search is not None:
            starts = _closed(scene.closed_search, evidence.seen, which, closed_limit, places, starts)
        parts = [fits]
        for some in _in_parts(starts, len(which)):
            own = known[np.isin(known.frame, which[some])]
            parts.append(fit_starts(setup, scene, evidence, which[some], starts.of_frames(some), most[some], own))
        before, fits = least_of_frame(fits, len(evidence.weight)), Fits.joined(parts)
        which = np.flatnonzero(least_of_frame(fits, len(evidence.weight)) < before - BETTER_COST)


def _closed(
    search_of: Callable[[int], Search],
    seen: Observation,
    which: NDArray[np.int64],
    limit: NDArray[np.float64],
    places: Sequence[Known],
    starts: Starts,
) -> Starts:
    """Return starts, those of frames with many of them from cells before their own backgrounds, all pixels compared."""
    parts = [starts.of_frames(np.array([k])) for k in range(len(which))]
    for k in np.flatnonzero(np.bincount(starts.frame, minlength=len(which)) > _MANY_STARTS):
        own = which[k : k + 1]
        parts[k] = search_of(int(own[0])).uncovered(seen[own], limit[[k]], [places[int(k)]])
    return Starts.joined(parts)


def _in_parts(starts: Starts, n: int) -> Iterator[NDArray[np.int64]]:
    """Yield those of n frames that have starts, a few at a time."""
    count = np.bincount(starts.frame, minlength=n)
    part = np.cumsum(count) // _STARTS_AT_ONCE
    for number in np.unique(part[count > 0]):
        yield np.flatnonzero((part == number) & (count > 0))


def _limit(setup: Setup, seen: Observation, nu: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the bound up to which a cell may hold an explanation: a rival of the worst fit that is accepted."""
    return largest_costs(setup.rules.false_alarm, seen.returned.sum(axis=1), nu) + setup.rules.rival_cost


def _most(setup: Setup, evidence: Evidence) -> NDArray[np.float64]:
    """Return the cost up to which a view explains a frame."""
    residuals = evidence.per_pixel * np.count_nonzero(evidence.weight, axis=1)
    return largest_costs(setup.rules.false_alarm, residuals, evidence.scatter_freedom) + setup.rules.rival_cost


def are_doubtful(setup: Setup, fits: Fits, n: int, p: float | None = None) -> NDArray[np.bool_]:
    """Return of which of n frames the best fit fails its test at `p`; not of those without a fit."""
    best = best_of_frame(fits)
    best = best[np.isfinite(fits.cost[best])]
    doubtful = np.zeros(n, np.bool_)
    doubtful[fits.frame[best]] = fits.p_value[best] < (setup.policy.doubtful_p if p is None else p)
    return doubtful


def _worth_a_search(setup: Setup, evidence: Evidence, bare: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return which frames have enough returns to place a landmark, and are not explained without one."""
    returned = evidence.seen.returned
    enough = (returned & setup.used).sum(axis=1) >= MIN_RETURNS
    explained = bare <= special.chdtri(np.maximum(returned.sum(axis=1), 1), setup.rules.false_alarm)
    return np.flatnonzero(enough & ~explained)
