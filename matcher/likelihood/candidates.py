"""Steps 3 to 5 of the search: descend from minima of the bank, let other classes explain, refine on final images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.likelihood.fits import Fits, best_of_frame, distinct, distinct_of_frames, least_of_frame
from phasemark.matcher.likelihood.images import VIEW, ImageModel
from phasemark.matcher.likelihood.problem import DescentSettings
from phasemark.matcher.likelihood.refine import costs_at, refine
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.setup import Scene, Setup
from phasemark.matcher.nearest.bank_minima import Starts

__all__ = ["fit_modes", "fit_neighbouring_views", "fit_other_classes", "fit_starts"]


def fit_starts(
    setup: Setup,
    scene: Scene,
    evidence: Evidence,
    which: NDArray[np.int64],
    starts: Starts,
    sides_rad: tuple[float, ...],
    *,
    patient: bool = False,
) -> Fits:
    """Refine the minima of some frames, then let the other classes explain each frame from its best view.

    Parameters
    ----------
    setup : Setup
    scene : Scene
        Its scout, if there is one, refines first; what is likely then is refined again on the final images.
    evidence : Evidence
    which : (k,) int64
        The frames that `starts` counts.
    starts : Starts
        Minima of the bank.
    sides_rad : tuple of float
        Offsets of δ at which the best minimum of each frame is tried too.
    patient : bool
        Whether to refine minima however bad they look at first.
    """
    policy, settings = setup.policy, scene.settings(setup)
    frame, class_index, view = _with_sides(which[starts.frame], starts, sides_rad)
    leading = settings
    if scene.scout is not None and setup.bearing_has_prior:  # a scout knows no bearing
        leading = replace(settings, free=VIEW[:2], prior_std=())
    lead = scene.scout or scene.final
    margin = np.inf if patient else policy.margin_cost
    fits = fit_modes(setup, lead, evidence, frame, class_index, view, leading, margin)
    fits = Fits.joined([fits, fit_other_classes(setup, lead, evidence, fits, leading)])
    if scene.scout is None:
        return fits
    return _polished(setup, scene, evidence, fits)


def fit_modes(
    setup: Setup,
    model: ImageModel,
    evidence: Evidence,
    frame: NDArray[np.int64],
    class_index: NDArray[np.int64],
    view: NDArray[np.float64],
    settings: DescentSettings,
    start_margin: float,
) -> Fits:
    """Refine the first candidate of every frame, the others while they can still win, and at last what is likely.

    A candidate can win while its cost promises to fall to `start_margin` above that of the first one. Of likely fits
    that end at one place the best is kept; unlikely ones keep their rough fit.
    """
    n = len(evidence.weight)
    first = np.isin(np.arange(len(frame)), np.unique(frame, return_index=True)[1])
    fits = refine(model, evidence, frame[first], class_index[first], view[first], settings, roughly=True)
    limit = least_of_frame(fits, n)[frame[~first]] + start_margin
    more = refine(model, evidence, frame[~first], class_index[~first], view[~first], settings, limit, roughly=True)
    fits = Fits.joined([fits, more])
    policy = setup.policy
    may_win = fits.cost < least_of_frame(fits, n)[fits.frame] + policy.margin_cost
    better = distinct_of_frames(fits, np.flatnonzero(may_win), setup.shapes.symmetry, policy.same_m, policy.same_rad)
    again = fits[better]
    return Fits.joined([refine(model, evidence, again.frame, again.class_index, again.view, settings), fits[~may_win]])


def fit_other_classes(
    setup: Setup, model: ImageModel, evidence: Evidence, fits: Fits, settings: DescentSettings
) -> Fits:
    """Fit every other class to each frame, from the view of the best class."""
    best = best_of_frame(fits)
    n_class = len(setup.shapes.names)
    others = np.array([(k, c) for k in best for c in range(n_class) if c != fits.class_index[k]], np.int64)
    others = others.reshape(-1, 2)
    source = others[:, 0]
    rival = fits.cost[source]
    limit = rival + setup.policy.likely_cost
    frame, view = fits.frame[source], fits.view[source]
    return refine(model, evidence, frame, others[:, 1], view, settings, limit, rival, at_first_sight=True)


def _with_sides(
    frame: NDArray[np.int64], starts: Starts, sides_rad: tuple[float, ...]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return frames, classes and views of starts, and of the best one of each frame with δ moved to some sides."""
    class_index, view = starts.class_index, starts.view
    if not sides_rad:
        return frame, class_index, view
    first = np.flatnonzero(np.diff(starts.frame, prepend=-1))
    beside = [view[first] + side * np.eye(len(VIEW))[1] for side in sides_rad]
    return (
        np.concatenate([frame, np.tile(frame[first], len(sides_rad))]),
        np.concatenate([class_index, np.tile(class_index[first], len(sides_rad))]),
        np.concatenate([view, *beside]),
    )


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


def _polished(setup: Setup, scene: Scene, evidence: Evidence, fits: Fits) -> Fits:
    """Refine on the final images what is likely after the scout.

    The other fits keep the scout's cost, shifted by the change of the best one of their frame. Likely fits beyond
    `most_refined` are dropped.
    """
    policy, n = setup.policy, len(evidence.weight)
    order = np.lexsort((fits.cost, fits.frame))
    least = least_of_frame(fits, n)
    likely = [k for k in order if fits.cost[k] < least[fits.frame[k]] + policy.likely_cost]
    again = fits[_most_likely(setup, fits, likely)]
    close = _close_settings(setup, scene, evidence)
    final = refine(scene.final, evidence, again.frame, again.class_index, again.view, close)
    others = fits[np.setdiff1d(order, likely)]
    gap = others.cost - least[others.frame]
    others.cost[:] = least_of_frame(final, n)[others.frame] + gap
    return Fits.joined([final, others.with_free(len(setup.free))])


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
