"""Steps 3 and 4 of the search: descend from the starts, and refine what is likely on the final images."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.estimate.fits import (
    MOST_REFINED,
    SAME_M,
    SAME_RAD,
    Fits,
    distinct,
    distinct_of_frames,
    least_of_frame,
)
from phasemark.matcher.likelihood.images import VIEW, ImageModel
from phasemark.matcher.likelihood.kinks import CLOSE_BY_RAD
from phasemark.matcher.likelihood.problem import DescentSettings
from phasemark.matcher.likelihood.refine import costs_at, refine, slid
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.setup import Scene, Setup
from phasemark.matcher.nearest.bank_minima import CostOf, Starts
from phasemark.matcher.nearest.grid import CELL_M, CELL_RAD
from phasemark.matcher.pixel_agreement import DISAGREEMENT

__all__ = ["costs_on_scout", "fit_neighbouring_views", "fit_starts", "fit_views"]

_STEP_AFTER_SCOUT = 0.1, 1.0
"""Longest step, in natural units, of a descent before a background or on phasors that starts where a scout ended, and
of others after a scout. Near a solution it is short: where an edge crosses a pixel's border, slopes jump."""

_SOFT_M = 0.01
"""Standard deviation of ranges that is added for the first steps of a robust descent: half a cell."""
_SCOUT_PIXELS = 0.05
"""Standard deviation of ranges that is added for a scout made of strips, in widths of a pixel at 1 m: its own error."""
_APART, _APART_COLUMNS = (0.01, math.radians(2.0)), 0.25
"""Distance and angle, and columns of bearing, within which minima of that scout lead to one."""
_BEST_BESIDE = 2
"""Views around a side minimum that are refined."""
_Starts = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]
"""Frame, class and view of each."""
_ASIDE_RAD = tuple(math.radians(angle) for angle in (0.12, 0.3, 0.6, 1.0, 1.4, 1.8, 2.2, 2.6, 3.0))
"""How far to either side of a side minimum in δ views are tried: the valley of a part on its edge is half a degree."""
_ASIDE_COLUMNS = 0.25, 0.5, 1.0, 1.5, 2.0
"""The same in bearing, in columns: the step of an edge by a column leads from one side minimum to the next."""


def fit_starts(
    setup: Setup,
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
    setup : Setup
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
    start = which[starts.frame], starts.class_index, starts.view
    seen = _on_scout(setup, scene, evidence)
    if scene.strips is not None:
        start = _best_of(setup, scene, seen, *start[:2], _spread(setup, scene, start[2]), 1)
    fits = _descended(setup, scene, seen, start, known)
    if scene.strips is not None:
        scouted = replace(scene, final=scene.strips)
        stuck = _are_stuck(setup, fits, explains, most)
        fits = Fits.joined([fits, _beside(setup, scouted, seen, fits, stuck, None)])
    if scene.scout is not None:
        fits = _finished(setup, scene, evidence, fits, most, start, explains)
        if scene.strips is not None:
            return fits
    stuck = _are_stuck(setup, fits, explains, most)
    beside = _beside(setup, scene, evidence, fits, stuck, most, roughly=scene.scout is None)
    fits = Fits.joined([fits, beside])
    return fits if scene.scout is not None else _finished(setup, scene, evidence, fits, most)


def costs_on_scout(setup: Setup, scene: Scene, evidence: Evidence, which: NDArray[np.int64]) -> CostOf | None:
    """Return what tells the costs of views of some frames on a scout made of strips; None without one."""
    strips = scene.strips
    if strips is None:
        return None
    settings, seen = scene.settings(setup), _on_scout(setup, scene, evidence)

    def cost_of(f: int, class_index: NDArray[np.int64], view: NDArray[np.float64]) -> NDArray[np.float64]:
        return slid(strips, seen, np.full(len(view), which[f]), class_index, view, settings, CELL_M)[0]

    return cost_of


def _on_scout(setup: Setup, scene: Scene, evidence: Evidence) -> Evidence:
    """Return frames with the errors of a scout made of strips, if there is one."""
    if scene.strips is None:
        return evidence
    return evidence.with_further_noise(_SCOUT_PIXELS * setup.bank.sensor.pixel_rad)


def _spread(setup: Setup, scene: Scene, view: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return views around some, (m, 9, 6): turned, and nearer and farther, or at other bearings."""
    steps = np.zeros((9, len(VIEW)))
    shares = np.linspace(-1.0, 1.0, 3)
    if setup.bearing_is_free:  # of the same heading and of others
        aside = np.repeat(shares, 3) * scene.search.column_rad / 2
        steps[:, 1], steps[:, 2] = aside + np.tile(shares, 3) * CELL_RAD / 2, aside
    elif scene.strips is not None:
        steps[:, 1] = np.linspace(-CELL_RAD, CELL_RAD, 9)
    else:
        steps[:, 0], steps[:, 1] = np.repeat(shares, 3) * CELL_M / 2, np.tile(shares, 3) * CELL_RAD / 2
    return np.asarray(view[:, None] + steps)


def _best_of(
    setup: Setup,
    scene: Scene,
    evidence: Evidence,
    frame: NDArray[np.int64],
    class_index: NDArray[np.int64],
    views: NDArray[np.float64],
    n: int,
    model: ImageModel | None = None,
) -> _Starts:
    """Return the best n of k views each, (m, k, 6), on some model; unless it is stated on strips if there are any.

    With strips views are compared, and returned, at their best distances: how the angles fit must not be lost in that.
    """
    m, k = views.shape[:2]
    of_each, settings = np.repeat(np.arange(m), k), scene.settings(setup)
    views = views.reshape(-1, len(VIEW))
    arguments = evidence, frame[of_each], class_index[of_each], views, settings
    if scene.strips is not None:
        cost, views = slid(model or scene.strips, *arguments, CELL_M)
    else:
        cost = costs_at(model or scene.final, *arguments)
    best = (np.argsort(cost.reshape(m, k), axis=1)[:, :n] + k * np.arange(m)[:, None]).ravel()
    return frame[of_each[best]], class_index[of_each[best]], views[best]


def _descended(
    setup: Setup,
    scene: Scene,
    evidence: Evidence,
    start: _Starts,
    known: Fits | None,
) -> Fits:
    """Refine starts (frame, class, view) roughly, on the scout if there is one; leave out those at known places."""
    settings, model = scene.settings(setup), scene.scout or scene.final
    frame, class_index, view = start
    if setup.huber is not None:
        # a loss that stays constant for outliers has no slope a cell away: the first steps have more noise
        soft = evidence.with_further_noise(_SOFT_M)
        view = refine(model, soft, frame, class_index, view, settings, roughly=True).view
    fits = refine(model, evidence, frame, class_index, view, settings, roughly=True)
    if known is None:
        return fits
    if scene.scout is not None:  # it has its own minimum there
        known = refine(model, evidence, known.frame, known.class_index, known.view, settings, roughly=True)
    return _elsewhere(setup, fits, known, _apart(setup, scene))


def _apart(setup: Setup, scene: Scene) -> tuple[float, ...]:
    """Return how far apart minima are of their own: distance, angle, and bearing on a scout at any."""
    if scene.strips is None:
        return SAME_M, SAME_RAD
    return *_APART, _APART_COLUMNS * scene.search.column_rad


def _near(fits: Fits, explains: NDArray[np.float64], most: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return the cost near which fits of each frame are followed: the least, or that of a rival of what is known."""
    return least_of_frame(fits, len(explains)) if most is None else most


def _are_stuck(
    setup: Setup, fits: Fits, explains: NDArray[np.float64], most: NDArray[np.float64] | None
) -> NDArray[np.bool_]:
    """Return which fits ended not far above what explains their frame: their cells may still hold an explanation."""
    near = _near(fits, explains, most)
    stuck = (fits.cost > explains[fits.frame]) & (fits.cost < near[fits.frame] + setup.policy.margin_cost)
    return np.asarray(stuck & (near >= explains)[fits.frame])


def _beside(
    setup: Setup,
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
    settings = scene.settings(setup) if roughly else _close_settings(setup, scene, evidence)
    which = distinct_of_frames(fits, np.flatnonzero(stuck), setup.rules.symmetry)
    if not which.size:
        return fits[:0]
    views = _around(setup, scene, fits.view[which])
    own = fits.frame[which], fits.class_index[which]
    frame, class_index, view = _best_of(setup, scene, evidence, *own, views, _BEST_BESIDE)
    rival = None if most is None else most[frame]
    return refine(scene.final, evidence, frame, class_index, view, settings, rival=rival, roughly=roughly)


def _elsewhere(setup: Setup, fits: Fits, known: Fits, apart: tuple[float, ...]) -> Fits:
    """Return those of some fits that came to other places than known ones."""
    whole = Fits.joined([replace(known, cost=np.full(len(known), -np.inf)).with_free(fits.covariance.shape[1]), fits])
    own = _of_own_places(setup, whole, np.arange(len(whole)), apart)
    return own[own.cost > -np.inf]


def _of_own_places(setup: Setup, fits: Fits, which: NDArray[np.int64], apart: tuple[float, ...]) -> Fits:
    """Return those of some fits that came to places apart from each other, the best at each."""
    return fits[distinct_of_frames(fits, which, setup.rules.symmetry, *apart)]


def fit_views(setup: Setup, scene: Scene, evidence: Evidence, fits: Fits) -> Fits:
    """Refine the views of some fits: each roughly, and what is likely then to the end."""
    rough = _rough(setup, scene, evidence, fits)
    return _finished(setup, scene.without_scout(), evidence, rough)


def _rough(setup: Setup, scene: Scene, evidence: Evidence, fits: Fits) -> Fits:
    """Refine the views of some fits roughly on the final images."""
    settings = scene.settings(setup)
    return refine(scene.final, evidence, fits.frame, fits.class_index, fits.view, settings, roughly=True)


def _finished(
    setup: Setup,
    scene: Scene,
    evidence: Evidence,
    fits: Fits,
    most: NDArray[np.float64] | None = None,
    start: _Starts | None = None,
    explains: NDArray[np.float64] | None = None,
) -> Fits:
    """Refine on the final images those rough fits that are likely; of fits that came to one place, the best.

    A fit is likely that is near the best of its frame, or near a cost `most` of each frame. The others keep their cost.
    That of a scout is shifted by the change of the best fit of the frame. Where `start` tells where a scout began, fits
    that it explains and the final images do not, by the cost `explains` of each frame, are looked for again.
    """
    policy, n = setup.policy, len(evidence.weight)
    near = least_of_frame(fits, n) if most is None else most
    blurred = most is not None and setup.reports_one_surface  # a scout among the few zones of a chip has many rivals
    likely = np.flatnonzero(fits.cost < near[fits.frame] + (0.0 if blurred else policy.likely_cost))
    again = _of_own_places(setup, fits, likely, _apart(setup, scene))
    settings = scene.settings(setup) if scene.scout is None else _close_settings(setup, scene, evidence)
    rival = None if most is None else most[again.frame]
    final = refine(scene.final, evidence, again.frame, again.class_index, again.view, settings, rival=rival)
    if start is not None and explains is not None and scene.scout is not None and not setup.reports_one_surface:
        promised = np.minimum(again.cost + DISAGREEMENT, explains[again.frame])
        lost = (again.cost <= explains[again.frame] + policy.close_cost) & (final.cost > promised)
        if lost.any():
            final = Fits.joined([final, _recovered(setup, scene, evidence, start, again[lost])])
    if blurred:
        return final
    others = fits[np.setdiff1d(np.arange(len(fits)), likely)]
    if scene.scout is not None and most is None:
        others = _shifted(others, final, fits, n)
    return Fits.joined([final, others.with_free(len(setup.free))])


def _recovered(setup: Setup, scene: Scene, evidence: Evidence, start: _Starts, lost: Fits) -> Fits:
    """Refine on final images from elsewhere: from around lost fits of a scout, or from where it began.

    Strips blur the step in which an edge enters a pixel: beyond it, at their minimum, may lie a column of pixels. A
    scout without the pixels that have a kink may have its minimum degrees away.
    """
    if scene.strips is not None:
        own, class_index = lost.frame, lost.class_index
        views = _surrounded(setup, lost).view.reshape(-1, len(lost), len(VIEW)).transpose(1, 0, 2)
    else:
        n = len(setup.rules.names)
        also = np.isin(start[0] * n + start[1], lost.frame * n + lost.class_index)
        own, class_index, views = start[0][also], start[1][also], _spread(setup, scene, start[2][also])
    best = _best_of(setup, scene, evidence, own, class_index, views, _BEST_BESIDE, model=scene.final)
    return refine(scene.final, evidence, *best, _close_settings(setup, scene, evidence))


def _shifted(others: Fits, final: Fits, scouted: Fits, n: int) -> Fits:
    """Return fits of a scout with the change of the best fit of their frame, of n, added to their costs."""
    change = least_of_frame(final, n)[others.frame] - least_of_frame(scouted, n)[others.frame]
    return replace(others, cost=others.cost + change)


def _around(setup: Setup, scene: Scene, view: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return views around some, (m, k, 6): turned, and at other bearings, with and without the heading kept."""
    moves = [(side * angle, 0.0) for angle in _ASIDE_RAD for side in (-1.0, 1.0)]
    if setup.bearing_is_free:
        turns = [side * angle for angle in _ASIDE_RAD[1::3] for side in (-1.0, 1.0)]
        bearings = [side * share * scene.search.column_rad for share in _ASIDE_COLUMNS for side in (-1.0, 1.0)]
        moves += [(turn, b) for b in bearings for turn in (0.0, *(b + off for off in (0.0, *turns)))]
    steps = np.zeros((len(moves), len(VIEW)))
    steps[:, 1:3] = moves
    return np.asarray(view[:, None] + steps)


def fit_neighbouring_views(
    setup: Setup, scene: Scene, evidence: Evidence, which: NDArray[np.int64], fits: Fits
) -> Fits:
    """Refine from around the best fits of some frames: no gradient leads back across an edge that has left a pixel.

    Parameters
    ----------
    setup : Setup
    scene : Scene
    evidence : Evidence
    which : (k,) int64
        Frames.
    fits : Fits
        Of these frames and others, on the final images.
    """
    order = np.lexsort((fits.cost, fits.frame))
    observed = [k for k in order if fits.frame[k] in which and np.isfinite(fits.covariance[k]).all()]
    around = _surrounded(setup, fits[_most_likely(setup, fits, observed)])
    close = _close_settings(setup, scene, evidence)
    cost = costs_at(scene.final, evidence, around.frame, around.class_index, around.view, close)
    order = np.lexsort((cost, around.frame))
    place = np.arange(len(order)) - np.searchsorted(around.frame[order], around.frame[order])
    again = around[order[place < MOST_REFINED]]
    rival = least_of_frame(fits, len(evidence.weight))[again.frame]
    limit = np.full(len(again), np.inf)
    return refine(scene.final, evidence, again.frame, again.class_index, again.view, close, limit, rival)


def _close_settings(setup: Setup, scene: Scene, evidence: Evidence) -> DescentSettings:
    """Return how a descent runs that starts near a minimum."""
    side_peaks = evidence.on == "phasors" or scene.behind is not None
    return replace(
        scene.settings(setup),
        longest_step=_STEP_AFTER_SCOUT[0 if side_peaks and not setup.bearing_has_prior else 1],
        look_beside_rad=CLOSE_BY_RAD if side_peaks else (),
    )


def _most_likely(setup: Setup, fits: Fits, ordered: list[int]) -> NDArray[np.int64]:
    """Return the few fits of each frame that are refined again: of places of their own, best first."""
    chosen: list[int] = []
    for k in ordered:
        same = [j for j in chosen if fits.frame[j] == fits.frame[k]]
        if len(same) < MOST_REFINED:
            own = distinct(fits, np.array([*same, k]), setup.rules.symmetry)
            if len(own) > len(same):
                chosen.append(int(k))
    return np.array(chosen, np.int64)


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
