"""The search for the most likely views of a batch of frames: docs/matching_method.md."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.matcher.chi_squared import largest_costs
from phasemark.matcher.estimate.acceptance import is_acceptable, is_in_bank
from phasemark.matcher.estimate.fits import (
    BETTER_COST,
    MOST_REFINED,
    SAME_M,
    SAME_RAD,
    Fits,
    best_of_frame,
    distinct_of_frames,
    least_of_frame,
)
from phasemark.matcher.likelihood.descent import CLOSE_BY_RAD
from phasemark.matcher.likelihood.images import VIEW, ImageModel
from phasemark.matcher.likelihood.problem import DescentSettings
from phasemark.matcher.likelihood.refine import Candidates, costs_at, refine, slid
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.scenes import Scene
from phasemark.matcher.likelihood.setup import Setup
from phasemark.matcher.nearest.bank_minima import CostOf, Known, Starts
from phasemark.matcher.nearest.cells import WIDE_PIXEL_RAD
from phasemark.matcher.nearest.grid import CELL_M, CELL_RAD
from phasemark.matcher.nearest.templates import Observation
from phasemark.matcher.pixel_agreement import DISAGREEMENT, MIN_RETURNS

__all__ = ["are_doubtful", "fit_views", "near_settings", "search_views"]


_SLACK = 8 * DISAGREEMENT
"""Cost by which a scout in the middle of a cell may be above a view of it, among the few zones of a chip, and by which
the bound of another cell may be below that of the right one, whose views are level."""
_STEP_AFTER_SCOUT = 0.1, 1.0
"""Longest step, in natural units, of a descent before a background or on phasors that starts where a scout ended, and
of others after a scout. Near a solution it is short: where an edge crosses a pixel's border, slopes jump."""

_APART, _APART_COLUMNS = (0.01, math.radians(2.0)), 0.25
"""Distance and angle, and columns of bearing, within which minima of that scout lead to one."""
_BEST_BESIDE = 2
"""Views around a side minimum that are refined."""
_ASIDE_RAD = tuple(math.radians(angle) for angle in (0.12, 0.3, 0.6, 1.0, 1.4, 1.8, 2.2, 2.6, 3.0))
"""How far to either side of a side minimum in δ views are tried: the valley of a part on its edge is half a degree."""
_ASIDE_COLUMNS = 0.25, 0.5, 1.0, 1.5, 2.0
"""The same in bearing, in columns: the step of an edge by a column leads from one side minimum to the next."""


def search_views(scene: Scene, evidence: Evidence, seen: Observation, bare: NDArray[np.float64]) -> Fits:
    """Return what explains each frame, the best views among them.

    Parameters
    ----------
    scene : Scene
    evidence : Evidence
        n frames.
    seen : Observation
        What the search in the bank sees of them. It is `evidence.seen`, but for an estimated background, which hides
        the pixels that see it.
    bare : (n,) float64
        Cost of a scene without a landmark.
    """
    setup = scene.setup
    which, tails = _worth_a_search(setup, evidence, bare), evidence.noise_tails
    # 1, 2  bound the cost in every cell of the bank, and start in those that may hold an explanation
    cost_of = costs_on_scout(scene, evidence, which)
    limit, search = _limit(setup, seen[which], tails[which]), scene.search.of_frames(which)
    if setup.reports_one_surface:  # where most zones see other things, no view explains a frame
        limit = np.full(len(which), np.inf)
    starts = search.starts(seen[which], limit, cost_of)
    # 3, 4  descend from there, and refine on final images
    fits = fit_starts(scene, evidence, which, starts, explaining_cost(setup, evidence[which]))
    refused_p = 0.01  # p-value at which views around the best fits are tried too
    # 5  where nothing fits, look around the best fits
    poor = np.flatnonzero(are_doubtful(setup, fits, len(evidence.weight), refused_p))
    if poor.size:
        fits = Fits.joined([fits, fit_neighbouring_views(scene, evidence, poor, fits)])
    # 6  where nothing does yet, descend in every cell that may hold an explanation
    if setup.bank.sensor.pixel_rad > WIDE_PIXEL_RAD and not (setup.unknown or setup.reports_one_surface):
        fits = _in_all_cells(scene, evidence, seen, fits)
    # 7  where the best fit would be accepted, look for rivals in all cells that are left
    fits = _with_rivals(scene, evidence, seen, fits)
    # 8  among the few zones of a chip, also along the valleys of the best fits
    return _along_valleys(scene, evidence, fits) if setup.reports_one_surface else fits


def _along_valleys(scene: Scene, evidence: Evidence, fits: Fits) -> Fits:
    """Return fits with those along the two weakest axes of the best rivals of answers that would be accepted.

    A column of zones on the wrong side of an edge costs more than most rivals, and no descent leads it across.
    """
    setup, n = scene.setup, len(evidence.weight)
    best = best_of_frame(fits)
    best = best[[is_acceptable(setup.rules, fits, int(k)) for k in best]] if best.size else best
    of_frame = np.full(n, -1)
    of_frame[fits.frame[best]] = best
    own = of_frame[fits.frame]
    most_rivals, a_column = 4, (setup.bank.sensor.rows + 1) * DISAGREEMENT
    apart_m = np.abs(fits.view[:, 0] - fits.view[own, 0]) > setup.rules.tolerance["distance_m"]
    turn_rad = np.abs(np.angle(np.exp(1j * (fits.view[:, 1] - fits.view[own, 1]))))
    other = (fits.class_index != fits.class_index[own]) | apart_m | (turn_rad > setup.rules.tolerance["delta_rad"])
    known = np.isfinite(fits.covariance).all(axis=(1, 2)) & (own >= 0) & other
    near = np.flatnonzero(known & (fits.cost < least_of_frame(fits, n)[fits.frame] + a_column))
    near = distinct_of_frames(fits, near, setup.rules.symmetry, *_apart(scene))
    near = near[np.argsort(fits.cost[near], kind="stable")]
    further = np.ones(len(near), np.bool_)  # all but the best of each class
    further[np.unique(fits.frame[near] * len(setup.rules.names) + fits.class_index[near], return_index=True)[1]] = False
    near = near[np.lexsort((fits.cost[near], further, fits.frame[near]))]
    frame = fits.frame[near]
    rivals = fits[near[np.arange(len(near)) - np.searchsorted(frame, frame) < most_rivals]]
    p = fits.covariance.shape[1]
    columns = [VIEW.index(name) for name in setup.free[:p]]
    values, vectors = np.linalg.eigh(rivals.covariance)
    axes = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
    parts = []
    for k, size in itertools.product(range(max(p - 2, 0), p), (-1.0, -0.5, 0.5, 1.0)):
        view = rivals.view.copy()
        view[:, columns] += size * axes[:, :, k]
        parts.append(replace(rivals, view=view))
    around = Fits.joined(parts)
    rival = least_of_frame(fits, n)[around.frame]
    return Fits.joined([fits, refine(scene.final, evidence, around, _close_settings(scene, evidence), rival=rival)])


def _in_all_cells(scene: Scene, evidence: Evidence, seen: Observation, fits: Fits) -> Fits:
    """Return fits with those of all cells of frames that nothing explains yet.

    In wide pixels the middle of the right cell may cost more than those beside it: it is no local minimum.
    """
    setup, n = scene.setup, len(evidence.weight)
    which = np.flatnonzero(are_doubtful(setup, fits, n, setup.rules.false_alarm))
    limit, most = _limit(setup, seen[which], evidence.noise_tails[which]), explaining_cost(setup, evidence[which])
    nothing = np.empty(0, np.int64), np.empty((0, len(VIEW)))
    starts = scene.search.of_frames(which).uncovered(seen[which], limit, [nothing] * len(which))
    for some in _in_parts(starts, len(which)):
        found = fit_starts(scene, evidence, which[some], starts.of_frames(some), most[some])
        # so near that no pixel is compared, or beyond the bank, anything fits
        inside = [is_in_bank(setup.rules, found, k) for k in range(len(found))]
        fits = Fits.joined([fits, found[np.array(inside, np.bool_)]])
    return fits


def _with_rivals(scene: Scene, evidence: Evidence, seen: Observation, fits: Fits) -> Fits:
    """Return fits with those of all cells that may hold a rival of an answer that would be accepted.

    Every cell of the bank whose bound allows a rival is descended from, or lies within two cells of one that is; of an
    answer that was found better on the way, too. A descent may still stop above the lowest point of its cell.
    """
    setup = scene.setup
    which = np.arange(len(evidence.weight))
    while True:
        best = best_of_frame(fits)
        best = best[np.isin(fits.frame[best], which)]
        if setup.reports_one_surface:  # few zones lead few descents to the best view
            best = best[fits.p_value[best] >= setup.rules.false_alarm]
        else:
            best = best[[is_acceptable(setup.rules, fits, int(k)) for k in best]]
        if not best.size:
            return fits
        which = fits.frame[best]
        limit, most = _limit(setup, seen[which], evidence.noise_tails[which]), explaining_cost(setup, evidence[which])
        closed_limit = _limit(setup, evidence.seen[which], evidence.noise_tails[which])
        if setup.huber is None:
            most = np.minimum(most, fits.cost[best] + setup.rules.rival_cost)
        if evidence.on == "ranges" and setup.huber is None:
            closed_limit = np.minimum(closed_limit, most)
        if seen is evidence.seen:
            limit = closed_limit
        if setup.reports_one_surface:  # every unexplained return costs, and few are explained
            limit, most = fits.capped[best] + setup.rules.rival_cost, fits.cost[best] + setup.rules.rival_cost
        near = fits.cost <= least_of_frame(fits, len(evidence.weight))[fits.frame] + setup.rules.rival_cost
        known = fits[near & np.isin(fits.frame, which)]
        places = [(known.class_index[own], known.view[own]) for own in (known.frame == k for k in which)]
        slack = _SLACK if setup.reports_one_surface else math.inf
        cost_of = costs_on_scout(scene, evidence, which)
        starts = scene.search.of_frames(which).uncovered(seen[which], limit, places, cost_of, slack)
        if scene.closed_search is not None:
            starts = _closed(scene, evidence.seen, which, closed_limit, places, starts)
        parts = [fits]
        for some in _in_parts(starts, len(which)):
            own = known[np.isin(known.frame, which[some])]
            parts.append(fit_starts(scene, evidence, which[some], starts.of_frames(some), most[some], own))
        before, fits = least_of_frame(fits, len(evidence.weight)), Fits.joined(parts)
        which = np.flatnonzero(least_of_frame(fits, len(evidence.weight)) < before - BETTER_COST)


def _closed(
    scene: Scene,
    seen: Observation,
    which: NDArray[np.int64],
    limit: NDArray[np.float64],
    places: Sequence[Known],
    starts: Starts,
) -> Starts:
    """Return starts, those of frames with many of them from cells before their own backgrounds, all pixels compared."""
    assert scene.closed_search is not None
    parts = [starts.of_frames(np.array([k])) for k in range(len(which))]
    many_starts = 30  # starts of a frame that take longer than cells before its own background
    for k in np.flatnonzero(np.bincount(starts.frame, minlength=len(which)) > many_starts):
        own = which[k : k + 1]
        search = scene.closed_search(int(own[0]), scene.search.rows_of(parts[k]))
        parts[k] = search.uncovered(seen[own], limit[[k]], [places[int(k)]])
    return Starts.joined(parts)


def _in_parts(starts: Starts, n: int) -> Iterator[NDArray[np.int64]]:
    """Yield those of n frames that have starts, a few at a time."""
    count = np.bincount(starts.frame, minlength=n)
    starts_at_once = 4096  # starts that are refined together, but for those of one frame: each has an image of it
    part = np.cumsum(count) // starts_at_once
    for number in np.unique(part[count > 0]):
        yield np.flatnonzero((part == number) & (count > 0))


def _limit(setup: Setup, seen: Observation, tails: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the bound up to which a cell may hold an explanation: a rival of the worst fit that is accepted."""
    return largest_costs(setup.rules.false_alarm, seen.returned.sum(axis=1), tails) + setup.rules.rival_cost


def explaining_cost(setup: Setup, evidence: Evidence) -> NDArray[np.float64]:
    """Return the cost up to which a view explains a frame."""
    residuals = evidence.per_pixel * np.count_nonzero(evidence.weight, axis=1)
    return largest_costs(setup.rules.false_alarm, residuals, evidence.noise_tails) + setup.rules.rival_cost


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


def fit_starts(
    scene: Scene,
    evidence: Evidence,
    which: NDArray[np.int64],
    starts: Starts,
    limit: NDArray[np.float64],
    known: Fits | None = None,
) -> Fits:
    """Refine the starts of some frames.

    Parameters
    ----------
    scene : Scene
        Its scout, if there is one, refines first.
    evidence : Evidence
    which : (k,) int64
        The frames that `starts` counts.
    starts : Starts
        Views in the cells that may hold an explanation.
    limit : (k,) float64
        Cost up to which a view explains a frame.
    known : Fits, optional
        What is known to explain these frames: only what is not there is refined and returned, and all side minima are
        looked around. Otherwise they are only while nothing explains their frame.
    """
    explains = np.full(len(evidence.weight), np.inf)
    explains[which] = limit
    most = None if known is None else explains
    starts = replace(starts, frame=which[starts.frame])
    seen = _on_scout(scene, evidence)
    if scene.strips is not None:
        starts = _best_of(scene, seen, starts, _spread(scene, starts.view), 1)
    fits = _descended(scene, seen, starts, known)
    if scene.strips is not None:
        scouted = replace(scene, final=scene.strips)
        stuck = _are_stuck(scene.setup, fits, explains, most)
        fits = Fits.joined([fits, _beside(scouted, seen, fits, stuck, None)])
    if scene.scout is not None:
        fits = _finished(scene, evidence, fits, most, starts, explains)
        if scene.strips is not None:
            return fits
    stuck = _are_stuck(scene.setup, fits, explains, most)
    beside = _beside(scene, evidence, fits, stuck, most, roughly=scene.scout is None)
    fits = Fits.joined([fits, beside])
    return fits if scene.scout is not None else _finished(scene, evidence, fits, most)


def costs_on_scout(scene: Scene, evidence: Evidence, which: NDArray[np.int64]) -> CostOf | None:
    """Return what tells the costs of views of some frames on a scout made of strips; None without one."""
    strips = scene.strips
    if strips is None:
        return None
    settings, seen = scene.settings(), _on_scout(scene, evidence)

    def cost_of(f: int, class_index: NDArray[np.int64], view: NDArray[np.float64]) -> NDArray[np.float64]:
        starts = Starts(np.full(len(view), which[f]), class_index, view)
        return slid(strips, seen, starts, settings, CELL_M)[0]

    return cost_of


def _on_scout(scene: Scene, evidence: Evidence) -> Evidence:
    """Return frames with the errors of a scout made of strips, if there is one."""
    if scene.strips is None:
        return evidence
    # standard deviation of ranges that is added for a scout made of strips, in widths of a pixel at 1 m: its own error
    scout_pixels = 0.05
    return evidence.with_further_noise(scout_pixels * scene.setup.bank.sensor.pixel_rad)


def _spread(scene: Scene, view: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return views around some, (m, 9, 6): turned, and nearer and farther, or at other bearings."""
    steps = np.zeros((9, len(VIEW)))
    shares = np.linspace(-1.0, 1.0, 3)
    if scene.setup.bearing_is_free:  # of the same heading and of others
        aside = np.repeat(shares, 3) * scene.search.column_rad / 2
        steps[:, 1], steps[:, 2] = aside + np.tile(shares, 3) * CELL_RAD / 2, aside
    elif scene.strips is not None:
        steps[:, 1] = np.linspace(-CELL_RAD, CELL_RAD, 9)
    else:
        steps[:, 0], steps[:, 1] = np.repeat(shares, 3) * CELL_M / 2, np.tile(shares, 3) * CELL_RAD / 2
    return np.asarray(view[:, None] + steps)


def _best_of(
    scene: Scene,
    evidence: Evidence,
    own: Candidates,
    views: NDArray[np.float64],
    n: int,
    model: ImageModel | None = None,
) -> Starts:
    """Return the best n of k views, (m, k, 6), for the frame and the class of each of m candidates, on some model.

    Unless it is stated, the model is made of strips if there are any. With strips views are compared, and returned, at
    their best distances: how the angles fit must not be lost in that.
    """
    m, k = views.shape[:2]
    of_each, settings = np.repeat(np.arange(m), k), scene.settings()
    tried = Starts(own.frame[of_each], own.class_index[of_each], views.reshape(-1, len(VIEW)))
    if scene.strips is not None:
        cost, slid_views = slid(model or scene.strips, evidence, tried, settings, CELL_M)
        tried = replace(tried, view=slid_views)
    else:
        cost = costs_at(model or scene.final, evidence, tried, settings)
    return tried[(np.argsort(cost.reshape(m, k), axis=1)[:, :n] + k * np.arange(m)[:, None]).ravel()]


def _descended(scene: Scene, evidence: Evidence, starts: Starts, known: Fits | None) -> Fits:
    """Refine starts roughly, on the scout if there is one; leave out those at known places."""
    settings, model = scene.settings(), scene.scout or scene.final
    if scene.setup.huber is not None:
        # standard deviation of ranges that is added for the first steps of a robust descent: half a cell
        soft_m = 0.01
        # a loss that stays constant for outliers has no slope a cell away: the first steps have more noise
        soft = evidence.with_further_noise(soft_m)
        starts = replace(starts, view=refine(model, soft, starts, settings, roughly=True).view)
    fits = refine(model, evidence, starts, settings, roughly=True)
    if known is None:
        return fits
    if scene.scout is not None:  # it has its own minimum there
        known = refine(model, evidence, known, settings, roughly=True)
    return _elsewhere(scene.setup, fits, known, _apart(scene))


def _apart(scene: Scene) -> tuple[float, ...]:
    """Return how far apart minima are of their own: distance, angle, and bearing on a scout at any."""
    if scene.strips is None:
        return SAME_M, SAME_RAD
    return *_APART, _APART_COLUMNS * scene.search.column_rad


def _are_stuck(
    setup: Setup, fits: Fits, explains: NDArray[np.float64], most: NDArray[np.float64] | None
) -> NDArray[np.bool_]:
    """Return which fits ended not far above what explains their frame: their cells may still hold an explanation."""
    near = least_of_frame(fits, len(explains)) if most is None else most
    stuck = (fits.cost > explains[fits.frame]) & (fits.cost < near[fits.frame] + setup.policy.margin_cost)
    return np.asarray(stuck & (near >= explains)[fits.frame])


def _beside(
    scene: Scene,
    evidence: Evidence,
    fits: Fits,
    stuck: NDArray[np.bool_],
    most: NDArray[np.float64] | None,
    *,
    roughly: bool = True,
) -> Fits:
    """Refine from around those fits that are stuck.

    A descent stops at side minima, where an edge of the landmark has left a pixel.
    """
    settings = scene.settings() if roughly else _close_settings(scene, evidence)
    which = distinct_of_frames(fits, np.flatnonzero(stuck), scene.setup.rules.symmetry)
    if not which.size:
        return fits[:0]
    views = _around(scene, fits.view[which])
    best = _best_of(scene, evidence, fits[which], views, _BEST_BESIDE)
    rival = None if most is None else most[best.frame]
    return refine(scene.final, evidence, best, settings, rival=rival, roughly=roughly)


def _elsewhere(setup: Setup, fits: Fits, known: Fits, apart: tuple[float, ...]) -> Fits:
    """Return those of some fits that came to other places than known ones."""
    whole = Fits.joined([replace(known, cost=np.full(len(known), -np.inf)).with_free(fits.covariance.shape[1]), fits])
    own = whole[distinct_of_frames(whole, np.arange(len(whole)), setup.rules.symmetry, *apart)]
    return own[own.cost > -np.inf]


def fit_views(scene: Scene, evidence: Evidence, fits: Fits) -> Fits:
    """Refine the views of some fits on the final images: each roughly, and what is likely then to the end."""
    rough = refine(scene.final, evidence, fits, scene.settings(), roughly=True)
    return _finished(replace(scene, scout=None), evidence, rough)


def _finished(
    scene: Scene,
    evidence: Evidence,
    fits: Fits,
    most: NDArray[np.float64] | None = None,
    starts: Starts | None = None,
    explains: NDArray[np.float64] | None = None,
) -> Fits:
    """Refine on the final images those rough fits that are likely; of fits that came to one place, the best.

    A fit is likely that is near the best of its frame, or near a cost `most` of each frame. The others keep their cost.
    That of a scout is shifted by the change of the best fit of the frame. Where `starts` tells where a scout began,
    fits that it explains and the final images do not, by the cost `explains` of each frame, are looked for again.
    """
    setup = scene.setup
    policy, n = setup.policy, len(evidence.weight)
    near = least_of_frame(fits, n) if most is None else most
    blurred = most is not None and setup.reports_one_surface  # a scout among the few zones of a chip has many rivals
    likely = np.flatnonzero(fits.cost < near[fits.frame] + (0.0 if blurred else policy.likely_cost))
    again = fits[distinct_of_frames(fits, likely, setup.rules.symmetry, *_apart(scene))]
    settings = scene.settings() if scene.scout is None else _close_settings(scene, evidence)
    rival = None if most is None else most[again.frame]
    final = refine(scene.final, evidence, again, settings, rival=rival)
    if starts is not None and explains is not None and scene.scout is not None:
        promised = np.minimum(again.cost + DISAGREEMENT, explains[again.frame])
        lost = (again.cost <= explains[again.frame] + policy.close_cost) & (final.cost > promised)
        if lost.any():
            final = Fits.joined([final, _recovered(scene, evidence, starts, again[lost])])
    if blurred:
        return final
    others = fits[np.setdiff1d(np.arange(len(fits)), likely)]
    if scene.scout is not None and most is None:
        # a scout has costs of its own: with the change of the best fit of their frame
        change = least_of_frame(final, n)[others.frame] - least_of_frame(fits, n)[others.frame]
        others = replace(others, cost=others.cost + change)
    return Fits.joined([final, others.with_free(len(setup.free))])


def _recovered(scene: Scene, evidence: Evidence, starts: Starts, lost: Fits) -> Fits:
    """Refine on final images from elsewhere: from around lost fits of a scout, or from where it began.

    Strips blur the step in which an edge enters a pixel: beyond it, at their minimum, may lie a column of pixels. A
    scout without the pixels that have a kink may have its minimum degrees away.
    """
    own: Candidates = lost
    if scene.strips is not None:
        views = _surrounded(scene.setup, lost).view.reshape(-1, len(lost), len(VIEW)).transpose(1, 0, 2)
    else:
        n = len(scene.setup.rules.names)
        own = starts[np.isin(starts.frame * n + starts.class_index, lost.frame * n + lost.class_index)]
        views = _spread(scene, own.view)
    best = _best_of(scene, evidence, own, views, _BEST_BESIDE, model=scene.final)
    return refine(scene.final, evidence, best, _close_settings(scene, evidence))


def _around(scene: Scene, view: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return views around some, (m, k, 6): turned, and at other bearings, with and without the heading kept."""
    moves = [(side * angle, 0.0) for angle in _ASIDE_RAD for side in (-1.0, 1.0)]
    if scene.setup.bearing_is_free:
        turns = [side * angle for angle in _ASIDE_RAD[1::3] for side in (-1.0, 1.0)]
        bearings = [side * share * scene.search.column_rad for share in _ASIDE_COLUMNS for side in (-1.0, 1.0)]
        moves += [(turn, b) for b in bearings for turn in (0.0, *(b + off for off in (0.0, *turns)))]
    steps = np.zeros((len(moves), len(VIEW)))
    steps[:, 1:3] = moves
    return np.asarray(view[:, None] + steps)


def fit_neighbouring_views(scene: Scene, evidence: Evidence, which: NDArray[np.int64], fits: Fits) -> Fits:
    """Refine from around the best fits of some frames: no gradient leads back across an edge that has left a pixel.

    Parameters
    ----------
    scene : Scene
    evidence : Evidence
    which : (k,) int64
        Frames.
    fits : Fits
        Of these frames and others, on the final images.
    """
    observed = np.isin(fits.frame, which) & np.isfinite(fits.covariance).all(axis=(1, 2))
    likely = distinct_of_frames(fits, np.flatnonzero(observed), scene.setup.rules.symmetry)
    around = _surrounded(scene.setup, fits[likely[_are_first(fits.frame[likely])]])
    close = _close_settings(scene, evidence)
    cost = costs_at(scene.final, evidence, around, close)
    order = np.lexsort((cost, around.frame))
    again = around[order[_are_first(around.frame[order])]]
    rival = least_of_frame(fits, len(evidence.weight))[again.frame]
    return refine(scene.final, evidence, again, close, rival=rival)


def near_settings(scene: Scene, evidence: Evidence) -> DescentSettings:
    """Return how a descent runs from a view that is expected, as in the frame before: it looks nowhere else."""
    return replace(_close_settings(scene, evidence), look_beside_rad=())


def _close_settings(scene: Scene, evidence: Evidence) -> DescentSettings:
    """Return how a descent runs that starts near a minimum."""
    side_peaks = evidence.on == "phasors" or scene.behind is not None
    return replace(
        scene.settings(),
        longest_step=_STEP_AFTER_SCOUT[0 if side_peaks and not scene.setup.bearing_has_prior else 1],
        look_beside_rad=CLOSE_BY_RAD if side_peaks else (),
    )


def _are_first(frame: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which places of rising frames are among the few first ones of their frame, which are refined again."""
    return np.asarray(np.arange(len(frame)) - np.searchsorted(frame, frame) < MOST_REFINED)


def _surrounded(setup: Setup, fits: Fits) -> Fits:
    """Return fits two and four standard deviations away along the axes of the covariances of some."""
    p = fits.covariance.shape[1]
    columns = np.array([VIEW.index(name) for name in setup.free[:p]])
    values, vectors = np.linalg.eigh(np.where(np.isfinite(fits.covariance), fits.covariance, 0.0))
    axes = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    parts = []
    for k in range(p):
        for size in (-4.0, -2.0, -1.0, 1.0, 2.0, 4.0):
            view = fits.view.copy()
            view[:, columns] += size * axes[:, :, k]
            parts.append(replace(fits, view=view))
    return Fits.joined(parts)
