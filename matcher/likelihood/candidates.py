"""Steps 3 and 4 of the search: descend from the starts, and refine what is likely on the final images."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.likelihood.fits import Fits, distinct, distinct_of_frames, least_of_frame
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.problem import DescentSettings
from phasemark.matcher.likelihood.refine import costs_at, refine
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.setup import Scene, Setup
from phasemark.matcher.nearest.bank_minima import Starts

__all__ = ["fit_neighbouring_views", "fit_starts", "fit_views"]

_SOFT_M = 0.01
"""Standard deviation of ranges that is added for the first steps of a robust descent: half a cell."""
_SCOUT_M, _SCOUT_PIXELS = 0.015, 0.3
"""Standard deviation of the ranges of a scout whose images are moved aside, and in widths of a pixel at 1 m."""
_SCOUT_COST = 300.0
"""What a true view may cost more on that scout than what explains a frame."""
_APART, _APART_COLUMNS = (0.01, math.radians(2.0)), 0.25
"""Distance and angle, and columns of bearing, within which minima of a scout lead to one: its images are not smooth."""
_BEST_BESIDE = 2
"""Views around a side minimum that are refined."""
_ASIDE_RAD = tuple(math.radians(angle) for angle in (0.12, 0.3, 0.7, 1.5, 3.0))
"""How far to either side of a side minimum in δ views are tried."""


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
    aside = scene.scout is not None and setup.bearing_is_free
    seen = evidence
    if aside:
        seen = evidence.with_further_noise(max(_SCOUT_M, _SCOUT_PIXELS * setup.bank.sensor.pixel_rad))
    fits = _descended(setup, scene, seen, (which[starts.frame], starts.class_index, starts.view), known)
    if aside:
        return _fits_aside(setup, scene, evidence, fits, explains, most)
    if scene.scout is not None:
        fits = _finished(setup, scene, evidence, fits, most)
    stuck = _are_stuck(setup, fits, explains, most)
    beside = _beside(setup, scene, evidence, fits, stuck, most, roughly=scene.scout is None)
    fits = Fits.joined([fits, beside])
    return fits if scene.scout is not None else _finished(setup, scene, evidence, fits, most)


def _descended(
    setup: Setup,
    scene: Scene,
    evidence: Evidence,
    start: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]],
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
    if scene.scout is None:
        return _elsewhere(setup, fits, known, (setup.policy.same_m, setup.policy.same_rad))
    # the scout has its own minimum there
    known = refine(model, evidence, known.frame, known.class_index, known.view, settings, roughly=True)
    return _elsewhere(setup, fits, known, _apart(scene))


def _fits_aside(
    setup: Setup,
    scene: Scene,
    evidence: Evidence,
    fits: Fits,
    explains: NDArray[np.float64],
    most: NDArray[np.float64] | None,
) -> Fits:
    """Refine what is likely on a scout whose images are moved aside."""
    margin = setup.policy.likely_cost if most is None else _SCOUT_COST
    likely = fits.cost < (_near(fits, explains, most) + margin)[fits.frame]
    own = _of_own_places(setup, fits, likely, _apart(scene))
    rough = _rough(setup, scene, evidence, own)
    # where the scout explains a frame, an edge has left a pixel on the way
    stuck = (own.cost <= explains[own.frame]) & (rough.cost > explains[own.frame])
    stuck &= (_near(rough, explains, most) >= explains)[own.frame]
    scene = scene.without_scout()
    rough = Fits.joined([rough, _beside(setup, scene, evidence, own, stuck, most)])
    left = own[stuck]
    rival = None if most is None else most[left.frame]
    settings = scene.settings(setup)
    again = refine(scene.final, evidence, left.frame, left.class_index, left.view, settings, rival=rival)
    found = Fits.joined([_finished(setup, scene, evidence, rough, most), again])
    return found if most is not None else Fits.joined([found, _shifted(fits[~likely], found, fits, len(explains))])


def _apart(scene: Scene) -> tuple[float, float, float]:
    """Return how far apart minima of a scout are of their own: distance, angle, bearing."""
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
    which = distinct_of_frames(
        fits, np.flatnonzero(stuck), setup.shapes.symmetry, setup.policy.same_m, setup.policy.same_rad
    )
    if not which.size:
        return fits[:0]
    views = _around(setup, scene, fits.view[which])
    k = views.shape[1]
    frame, class_index = np.repeat(fits.frame[which], k), np.repeat(fits.class_index[which], k)
    views = views.reshape(-1, len(VIEW))
    cost = costs_at(scene.final, evidence, frame, class_index, views, settings).reshape(-1, k)
    best = np.argsort(cost, axis=1)[:, :_BEST_BESIDE]
    best = (best + k * np.arange(len(cost))[:, None]).ravel()
    rival = None if most is None else most[frame[best]]
    frame, class_index, views = frame[best], class_index[best], views[best]
    return refine(scene.final, evidence, frame, class_index, views, settings, rival=rival, roughly=roughly)


def _elsewhere(setup: Setup, fits: Fits, known: Fits, apart: tuple[float, ...]) -> Fits:
    """Return those of some fits that came to other places than known ones."""
    whole = Fits.joined([replace(known, cost=np.full(len(known), -np.inf)).with_free(fits.covariance.shape[1]), fits])
    own = _of_own_places(setup, whole, np.ones(len(whole), np.bool_), apart)
    return own[own.cost > -np.inf]


def _of_own_places(setup: Setup, fits: Fits, which: NDArray[np.bool_], apart: tuple[float, ...]) -> Fits:
    """Return those of some fits that came to places apart from each other, the best at each."""
    return fits[distinct_of_frames(fits, np.flatnonzero(which), setup.shapes.symmetry, *apart)]


def fit_views(setup: Setup, scene: Scene, evidence: Evidence, fits: Fits) -> Fits:
    """Refine the views of some fits: each roughly, and what is likely then to the end."""
    rough = _rough(setup, scene, evidence, fits)
    return _finished(setup, scene.without_scout(), evidence, rough)


def _rough(setup: Setup, scene: Scene, evidence: Evidence, fits: Fits) -> Fits:
    """Refine the views of some fits roughly on the final images."""
    settings = scene.settings(setup)
    return refine(scene.final, evidence, fits.frame, fits.class_index, fits.view, settings, roughly=True)


def _finished(
    setup: Setup, scene: Scene, evidence: Evidence, fits: Fits, most: NDArray[np.float64] | None = None
) -> Fits:
    """Refine on the final images those rough fits that are likely; of fits that came to one place, the best.

    A fit is likely that is near the best of its frame, or near a cost `most` of each frame. The others keep their cost.
    That of a scout is shifted by the change of the best fit of the frame.
    """
    policy, n = setup.policy, len(evidence.weight)
    near = least_of_frame(fits, n) if most is None else most
    likely = np.flatnonzero(fits.cost < near[fits.frame] + policy.likely_cost)
    again = fits[distinct_of_frames(fits, likely, setup.shapes.symmetry, policy.same_m, policy.same_rad)]
    settings = scene.settings(setup) if scene.scout is None else _close_settings(setup, scene, evidence)
    rival = None if most is None else most[again.frame]
    final = refine(scene.final, evidence, again.frame, again.class_index, again.view, settings, rival=rival)
    others = fits[np.setdiff1d(np.arange(len(fits)), likely)]
    if scene.scout is not None and most is None:
        others = _shifted(others, final, fits, n)
    return Fits.joined([final, others.with_free(len(setup.free))])


def _shifted(others: Fits, final: Fits, scouted: Fits, n: int) -> Fits:
    """Return fits of a scout with the change of the best fit of their frame, of n, added to their costs."""
    change = least_of_frame(final, n)[others.frame] - least_of_frame(scouted, n)[others.frame]
    return replace(others, cost=others.cost + change)


def _around(setup: Setup, scene: Scene, view: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return views around some, (m, k, 6): turned, and at other bearings, with and without the heading kept."""
    turns = (*(-angle for angle in _ASIDE_RAD), *_ASIDE_RAD)
    moves = [(turn, 0.0) for turn in turns]
    if setup.bearing_is_free:
        half = scene.search.column_rad / 2
        bearings = (-half, -half / 2, half / 2, half)
        moves += [(turn, b) for b in bearings for turn in (0.0, *(b + off for off in (0.0, *turns[1::2])))]
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
    again = around[order[place < setup.policy.most_refined]]
    rival = least_of_frame(fits, len(evidence.weight))[again.frame]
    limit = np.full(len(again), np.inf)
    return refine(scene.final, evidence, again.frame, again.class_index, again.view, close, limit, rival)


def _close_settings(setup: Setup, scene: Scene, evidence: Evidence) -> DescentSettings:
    """Return how a descent runs that starts near a minimum."""
    policy = setup.policy
    side_peaks = evidence.on == "phasors" or scene.behind is not None
    return replace(
        scene.settings(setup),
        longest_step=policy.step_after_scout
        if side_peaks and not setup.bearing_has_prior
        else policy.step_after_scout_aside,
        look_beside_rad=policy.close_by_rad if side_peaks else (),
    )


def _most_likely(setup: Setup, fits: Fits, ordered: list[int]) -> NDArray[np.int64]:
    """Return the few fits of each frame that are refined again: of places of their own, best first."""
    policy = setup.policy
    chosen: list[int] = []
    for k in ordered:
        same = [j for j in chosen if fits.frame[j] == fits.frame[k]]
        if len(same) < policy.most_refined:
            own = distinct(fits, np.array([*same, k]), setup.shapes.symmetry, policy.same_m, policy.same_rad)
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
        for size in (-4.0, -2.0, 2.0, 4.0):
            view = fits.view.copy()
            view[:, columns] += size * axes[:, :, k]
            parts.append(replace(fits, view=view))
    return Fits.joined(parts)
