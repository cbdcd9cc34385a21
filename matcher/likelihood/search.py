"""The search for the most likely views of a batch of frames: steps 2 to 7 of docs/matching.md."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.matcher.likelihood.candidates import fit_modes, fit_neighbouring_views, fit_other_classes, fit_starts
from phasemark.matcher.likelihood.fits import Fits, best_of_frame
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.look_alikes import fit_look_alikes
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.setup import Scene, Setup
from phasemark.matcher.nearest.templates import Observation
from phasemark.render import phasor_to_range_m
from phasemark.render.phasor_images import wrap_difference_m

__all__ = ["are_doubtful", "search_views"]


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
    which = _worth_a_search(setup, evidence, bare)
    policy = setup.policy
    n_modes = setup.modes_of_frame(scene.backgrounds)
    sides = policy.beside_rad if scene.backgrounds else ()
    # 2  start: minima of the bank
    starts = scene.search.of_frames(which).starts(seen[which], n_modes, all_classes=_all_classes(setup, evidence))
    # 3 to 5  descend on interpolated images, let other classes explain, refine on final images
    fits = fit_starts(setup, scene, evidence, which, starts, sides)
    # 6  doubt: search more widely where nothing fits; a robust matcher also without what fits worst
    fits = _retry_unexplained(setup, scene, evidence, seen, bare, fits)
    if setup.huber is not None and not setup.unknown:
        fits = _retry_trimmed(setup, scene, evidence, seen, bare, fits)
    # 7  look-alikes of every best fit
    return Fits.joined([fits, fit_look_alikes(setup, scene, evidence, fits)])


def are_doubtful(setup: Setup, fits: Fits, n: int) -> NDArray[np.bool_]:
    """Return of which of n frames the best fit is worse than good ones are; not of those without a fit."""
    best = best_of_frame(fits)
    best = best[np.isfinite(fits.cost[best])]
    limit = special.chdtri(np.maximum(fits.dof[best], 1), setup.policy.doubtful_p)
    doubtful = np.zeros(n, np.bool_)
    doubtful[fits.frame[best]] = fits.tested[best] > limit
    return doubtful


def _worth_a_search(setup: Setup, evidence: Evidence, bare: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return which frames have enough returns to place a landmark, and are not explained without one."""
    returned = evidence.seen.returned
    enough = (returned & setup.used).sum(axis=1) >= setup.policy.min_returns
    explained = bare <= special.chdtri(np.maximum(returned.sum(axis=1), 1), setup.false_alarm)
    return np.flatnonzero(enough & ~explained)


def _unexplained(
    setup: Setup,
    scene: Scene,
    evidence: Evidence,
    bare: NDArray[np.float64],
    fits: Fits,
    *,
    even_beyond_bare: bool = False,
    p: float | None = None,
    among: NDArray[np.int64] | None = None,
) -> NDArray[np.int64]:
    """Return the frames whose best fit fails the χ² test at `p`, and that are searched again.

    Not searched again are frames that a scene without a landmark explains more cheaply, on ranges without a stated
    background. Elsewhere every fit may be a side peak, and that cost decides nothing; nor does it where
    `even_beyond_bare` is set. Without `p` the policy's is taken: `doubtful_p` where the likelihood has side peaks,
    `hopeless_p` where it is smooth. `among` restricts the frames.
    """
    best = best_of_frame(fits)
    side_peaks = evidence.on == "phasors" or bool(scene.backgrounds)
    if p is None:
        p = setup.policy.doubtful_p if side_peaks else setup.policy.hopeless_p
    limit = special.chdtri(np.maximum(fits.dof[best], 1), p)
    cost, frame = fits.tested[best], fits.frame[best]
    bare_cost_decides = not (evidence.on == "phasors" or setup.background_is_known or even_beyond_bare)
    hope = cost < bare[frame] if bare_cost_decides else True
    asked = True if among is None else np.isin(frame, among)
    return np.asarray(frame[(cost > limit) & hope & asked])


def _retry_unexplained(
    setup: Setup, scene: Scene, evidence: Evidence, seen: Observation, bare: NDArray[np.float64], fits: Fits
) -> Fits:
    """Search again, from many more places, where nothing fits."""
    poor = _unexplained(setup, scene, evidence, bare, fits)
    if not poor.size:
        return fits
    retry = _retry_with_prior if setup.bearing_has_prior else _retry_without_prior
    fits = Fits.joined([fits, *retry(setup, scene, evidence, seen, bare, fits, poor)])
    if setup.height_and_tilt_are_known:
        return fits
    poor = _unexplained(setup, scene, evidence, bare, fits, p=setup.policy.refused_p, even_beyond_bare=True)
    return Fits.joined([fits, _fit_swayed(setup, scene, evidence, poor, fits)]) if poor.size else fits


def _all_classes(setup: Setup, evidence: Evidence) -> bool:
    """Return whether classes that are hardly worse than the best of a minimum start there too.

    They do where the images of a bank are not those of the frames: of another albedo, or of a camera that may be
    tilted or raised.
    """
    return evidence.on == "phasors" or not setup.height_and_tilt_are_known


def _fit_swayed(setup: Setup, scene: Scene, evidence: Evidence, which: NDArray[np.int64], fits: Fits) -> Fits:
    """Fit some frames from around their best views, with every class: turned, rolled, and raised as they pitch."""
    policy, free = setup.policy, setup.free
    best = best_of_frame(fits)
    best = best[np.isin(fits.frame[best], which)]
    view = fits.view[best]
    moved = [view]
    for size in policy.sways_rad:
        for name in ("delta_rad", "roll_rad"):
            if name in free:
                moved.append(view + size * (np.array(VIEW) == name))
        if {"height_m", "pitch_rad"} & set(free):
            raised = view.copy()
            raised[:, 3] += view[:, 0] * math.tan(size) * ("height_m" in free)
            raised[:, 4] -= size * ("pitch_rad" in free)
            moved.append(raised)
    n_class = len(setup.shapes.names)
    views = np.concatenate(moved * n_class)
    frame = np.tile(fits.frame[best], len(moved) * n_class)
    class_index = np.repeat(np.arange(n_class), len(moved) * len(best))
    order = np.argsort(frame, kind="stable")
    settings = scene.settings(setup)
    return fit_modes(
        setup, scene.final, evidence, frame[order], class_index[order], views[order], settings, policy.margin_cost
    )


def _retry_with_prior(
    setup: Setup,
    scene: Scene,
    evidence: Evidence,
    seen: Observation,
    bare: NDArray[np.float64],
    fits: Fits,
    poor: NDArray[np.int64],
) -> list[Fits]:
    """Search poor frames again with the bearing free: turned, heading kept, then from shifted minima of the bank.

    Interpolated images have bearing 0, so these searches use rendered images from the start.
    """
    policy, direct = setup.policy, replace(scene, scout=None)
    found = [_fit_turned(setup, direct, evidence, poor, fits)]
    poor = _unexplained(setup, scene, evidence, bare, Fits.joined([fits, *found]))
    if poor.size:
        n_modes = setup.modes_of_frame(scene.backgrounds)
        starts = scene.wide_search.of_frames(poor).starts(
            seen[poor], n_modes, all_classes=_all_classes(setup, evidence)
        )
        found.append(fit_starts(setup, direct, evidence, poor, starts, policy.beside_rad))
        poor = _unexplained(
            setup,
            scene,
            evidence,
            bare,
            Fits.joined([fits, *found]),
            p=policy.refused_p,
            among=poor,
            even_beyond_bare=True,
        )
    if poor.size:
        # edges between columns: no pixel may decide alone where the search starts
        starts = scene.wide_search.of_frames(poor).capped().starts(seen[poor], policy.modes_again, all_classes=True)
        found.append(fit_starts(setup, direct, evidence, poor, starts, policy.beside_rad))
    return found


def _retry_without_prior(
    setup: Setup,
    scene: Scene,
    evidence: Evidence,
    seen: Observation,
    bare: NDArray[np.float64],
    fits: Fits,
    poor: NDArray[np.int64],
) -> list[Fits]:
    """Search poor frames from more minima and angles; what fails `refused_p` still, around its best fits and afresh."""
    policy, all_classes = setup.policy, _all_classes(setup, evidence)

    def refused(found: list[Fits]) -> NDArray[np.int64]:
        return _unexplained(setup, scene, evidence, bare, Fits.joined([fits, *found]), p=policy.refused_p, among=poor)

    starts = scene.wide_search.of_frames(poor).starts(seen[poor], policy.modes_again, all_classes=all_classes)
    found = [fit_starts(setup, scene, evidence, poor, starts, policy.beside_again_rad, patient=True)]
    again = refused(found)
    if again.size and (scene.scout is not None or scene.backgrounds):
        found.append(fit_neighbouring_views(setup, scene, evidence, again, Fits.joined([fits, *found])))
        again = refused(found)
    if not again.size:
        return found
    if scene.scout is not None:
        # too little may be smooth for the scout to see the way
        n_modes = setup.modes_of_frame(scene.backgrounds)
        starts = scene.wide_search.of_frames(again).starts(seen[again], n_modes, all_classes=all_classes)
    elif scene.backgrounds:
        # edges between columns before a bright wall: no pixel may decide alone where the search starts
        starts = scene.wide_search.of_frames(again).capped().starts(seen[again], policy.modes_again, all_classes=True)
    else:
        return found
    found.append(fit_starts(setup, replace(scene, scout=None), evidence, again, starts, policy.beside_rad))
    return found


def _fit_turned(setup: Setup, scene: Scene, evidence: Evidence, which: NDArray[np.int64], fits: Fits) -> Fits:
    """Fit some frames from their best views turned to four other bearings, to half the widest bearing or half a column.

    A frame tells the heading δ − b before it tells δ and b: a view fitted without a bearing has the right heading.
    """
    best = best_of_frame(fits)
    best = best[np.isin(fits.frame[best], which)]
    turns = np.array([-2.0, -1.0, 1.0, 2.0]) * min(setup.widest_rad / 2, scene.search.column_rad / 2)
    view = np.tile(fits.view[best], (len(turns), 1))
    view[:, 1] += np.repeat(turns, len(best))
    view[:, 2] += np.repeat(turns, len(best))
    order = np.argsort(np.tile(fits.frame[best], len(turns)), kind="stable")
    frame, class_index = np.tile(fits.frame[best], len(turns)), np.tile(fits.class_index[best], len(turns))
    settings, margin = scene.settings(setup), setup.policy.margin_cost
    model = scene.final
    found = fit_modes(setup, model, evidence, frame[order], class_index[order], view[order], settings, margin)
    return Fits.joined([found, fit_other_classes(setup, model, evidence, found, settings)])


def _retry_trimmed(
    setup: Setup, scene: Scene, evidence: Evidence, seen: Observation, bare: NDArray[np.float64], fits: Fits
) -> Fits:
    """Search again without the returns that fit worst, as a robust matcher does where nothing fits."""
    policy = setup.policy
    n_modes = setup.modes_of_frame(scene.backgrounds)
    sides = policy.beside_rad if scene.backgrounds else ()
    for _ in range(policy.trimmings):
        poor = _unexplained(setup, scene, evidence, bare, fits, even_beyond_bare=True)
        if not poor.size:
            break
        kept = _trimmed(setup, scene, evidence, fits, poor, seen)
        starts = scene.search.of_frames(poor).starts(kept, n_modes, all_classes=_all_classes(setup, evidence))
        fits = Fits.joined([fits, fit_starts(setup, scene, evidence, poor, starts, sides)])
    return fits


def _trimmed(
    setup: Setup, scene: Scene, evidence: Evidence, fits: Fits, which: NDArray[np.int64], seen: Observation
) -> Observation:
    """Return some frames without the returns that are farthest from their best fits, and from the bulk of them."""
    best = best_of_frame(fits)
    best = best[np.searchsorted(fits.frame[best], which)]
    model = scene.final.of_frames(fits.frame[best])
    phasor = model.images(fits.class_index[best], np.ascontiguousarray(fits.view[best]), ()).phasor
    few = seen[which]
    size = np.sqrt(few.weight) * np.abs(
        wrap_difference_m(few.range_m - phasor_to_range_m(phasor, evidence.sensor), evidence.sensor)
    )
    compared = few.returned & np.isfinite(size)
    middle = np.nanmedian(np.where(compared, size, np.nan), axis=1, keepdims=True)
    odd = compared & (size > np.maximum(setup.policy.odd_ratio * middle, setup.policy.odd_sigma))
    return Observation(few.range_m, np.where(odd, 0.0, few.weight), few.returned & ~odd, few.not_returned & ~odd)
