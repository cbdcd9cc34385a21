"""Views that look like the best one, to which no slope leads: other sides, the back, and other bearings."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.likelihood.fits import BETTER_COST, Fits, best_of_frame, least_of_frame
from phasemark.matcher.likelihood.images import VIEW, ImageModel
from phasemark.matcher.likelihood.refine import refine
from phasemark.matcher.likelihood.residuals import Evidence, range_residuals
from phasemark.matcher.likelihood.setup import Scene, Setup
from phasemark.matcher.pixel_agreement import DISAGREEMENT

__all__ = ["fit_look_alikes"]

_Views = tuple[NDArray[np.int64], NDArray[np.float64]]
"""Indices of fits, and as many views to try instead of theirs."""
_OfClasses = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]
"""The same, with the class of each view between them."""


def fit_look_alikes(setup: Setup, scene: Scene, evidence: Evidence, fits: Fits) -> Fits:
    """Fit views that look like the best one to each frame.

    A mesh with a symmetry that its bank does not have looks the same from several sides. A thin landmark looks
    nearly the same from the front and from the back, its middle seen at the same place, and something like a box from
    its next face. A flat one looks nearly the same under every bearing, its heading kept. Where one of them explains a
    frame better than its best view did, the search had stopped at a side minimum: then what looks like that one is
    tried too.
    """
    best = best_of_frame(fits)
    found = _rounds(setup, scene, evidence, fits, best[np.isfinite(fits.cost[best])])
    if not setup.bearing_is_free:
        return found
    together = Fits.joined([fits, found])
    best = best_of_frame(together)
    best = best[np.isfinite(together.cost[best])]
    kinds = [_next_face(setup, scene, together, best, turn) for turn in (0.5 * math.pi, -0.5 * math.pi)]
    faces = _refined(setup, scene, evidence, together, kinds)
    ahead = best_of_frame(faces)
    ahead = ahead[faces.cost[ahead] < least_of_frame(together, len(evidence.weight))[faces.frame[ahead]] - BETTER_COST]
    return Fits.joined([found, faces, _rounds(setup, scene, evidence, faces, ahead)])


def _rounds(setup: Setup, scene: Scene, evidence: Evidence, fits: Fits, best: NDArray[np.int64]) -> Fits:
    """Fit what looks like some fits, and what looks like that where it is better."""
    parts = [fits[:0]]
    for _ in range(setup.policy.look_alike_rounds):
        if not best.size:
            break
        found = _fit_once(setup, scene, evidence, fits, best)
        least = least_of_frame(fits, len(evidence.weight))
        parts.append(found)
        best = best_of_frame(found)
        best = best[found.cost[best] < least[found.frame[best]] - BETTER_COST]
        fits = found
    return Fits.joined(parts)


def _fit_once(setup: Setup, scene: Scene, evidence: Evidence, fits: Fits, best: NDArray[np.int64]) -> Fits:
    """Fit what looks like some fits: of each kind of look-alike the few views that a first image speaks for."""
    kinds = [*_other_sides(setup, fits, best), _from_behind(setup, scene, fits, best)]
    if setup.bearing_is_free:
        kinds.append(_other_bearings(setup, scene, fits, best))
    of_class = [(which, fits.class_index[which], views) for which, views in kinds]
    return _refined(setup, scene, evidence, fits, of_class)


def _refined(setup: Setup, scene: Scene, evidence: Evidence, fits: Fits, kinds: list[_OfClasses]) -> Fits:
    """Refine the most promising views of each kind; `fits` are what they look like."""
    only_distance_and_delta = len(setup.free) == 2  # with more free, a start that costs much may still be near
    chosen = [_most_promising(setup, scene.final, evidence, fits, *kind) for kind in kinds]
    source, class_index, view = (np.concatenate(part) for part in zip(*chosen, strict=True))
    if not source.size:
        return fits[:0]
    return refine(
        scene.final,
        evidence,
        fits.frame[source],
        class_index,
        view,
        scene.settings(setup),
        fits.cost[source] + setup.policy.likely_cost,
        fits.cost[source],
        at_first_sight=only_distance_and_delta,
        look_like=fits[source],
    )


def _most_promising(
    setup: Setup,
    model: ImageModel,
    evidence: Evidence,
    fits: Fits,
    source: NDArray[np.int64],
    class_index: NDArray[np.int64],
    view: NDArray[np.float64],
) -> _OfClasses:
    """Return the views of one kind that explain their frames best, moved to the distances that their frames show.

    A view moves by the median residual of the ranges on its landmark. Of more views than `slides_refined`, those that
    cost most then are left out.

    Parameters
    ----------
    source : (k,) int64
        The fits that they look like.
    class_index : (k,) int64
    view : (k, 6) float64
    """
    if not source.size:
        return source, class_index, view
    view, frame = view.copy(), fits.frame[source]
    model = model.of_frames(frame)
    view[:, 0] = np.clip(view[:, 0], *model.limits())
    images = model.images(class_index, np.ascontiguousarray(view), ())
    residual = range_residuals(images.phasor, evidence, frame)
    weight = evidence.seen.weight[frame] * (evidence.weight[frame] > 0)
    residual[(images.phasor == 0) | (weight == 0)] = np.nan
    on_landmark = np.isfinite(residual) & (images.coverage > 0)
    some = on_landmark.any(axis=1)
    nearer = np.zeros(len(view))
    nearer[some] = np.nanmedian(np.where(on_landmark, residual, np.nan)[some], axis=1)
    view[:, 0] = np.clip(view[:, 0] + nearer, *model.limits())
    residual -= np.where(on_landmark, nearer[:, None], 0.0)
    squared = np.where(np.isnan(residual), DISAGREEMENT, weight * residual**2)
    cost = np.where(weight > 0, np.minimum(squared, DISAGREEMENT), 0.0).sum(axis=1)
    order = np.lexsort((cost, source))
    place = np.arange(len(order)) - np.searchsorted(source[order], source[order])
    kept = np.sort(order[place < setup.policy.slides_refined])
    return source[kept], class_index[kept], view[kept]


def _other_sides(setup: Setup, fits: Fits, best: NDArray[np.int64]) -> list[_Views]:
    """Return the sides that a landmark's own symmetry makes equal, where its bank does not have it."""
    shapes = setup.shapes
    candidates = []
    for k in range(1, min(setup.policy.most_equals, max(shapes.own_symmetry))):
        n = np.array([shapes.own_symmetry[c] // shapes.symmetry[c] for c in fits.class_index[best]])
        equal = best[k < n]
        views = fits.view[equal].copy()
        views[:, 1] += 2 * math.pi * k / n[k < n]
        candidates.append((equal, views))
    return candidates


def _from_behind(setup: Setup, scene: Scene, fits: Fits, best: NDArray[np.int64]) -> _Views:
    """Return views from the other side, the landmark's middle at the same place, under several bearings."""
    odd = best[np.array([setup.shapes.symmetry[c] % 2 for c in fits.class_index[best]], np.bool_)]
    view = fits.view[odd].copy()
    view[:, 1] += math.pi
    middle = setup.shapes.middle_m[fits.class_index[odd]]
    here, there = (_rotated(middle, delta) for delta in (fits.view[odd, 1], view[:, 1]))
    view[:, 0] += here[:, 0] - there[:, 0]
    if not setup.bearing_is_free:
        return odd, view
    view[:, 2] += np.arctan2(here[:, 1], fits.view[odd, 0] + here[:, 0])
    view[:, 2] -= np.arctan2(there[:, 1], view[:, 0] + there[:, 0])
    return _slid(setup, scene, odd, view, (0.0, *_slides(setup)))


def _next_face(setup: Setup, scene: Scene, fits: Fits, best: NDArray[np.int64], turn_rad: float) -> _OfClasses:
    """Return views of every class a quarter turn away, under several bearings: the next face of something like a box.

    With the bearing fixed the search in the bank compares these sides itself. Where half a turn changes nothing, the
    turns to either side are one.
    """
    symmetry = np.array(setup.shapes.symmetry)
    differs = symmetry % 4 != 0 if turn_rad > 0 else symmetry % 2 != 0
    classes = np.flatnonzero(differs)
    which, class_index = np.repeat(best, len(classes)), np.tile(classes, len(best))
    view = fits.view[which].copy()
    view[:, 1] += turn_rad
    slides = (0.0, *setup.policy.slides_with_prior)
    source, views = _slid(setup, scene, which, view, slides)
    return source, np.tile(class_index, len(slides)), views


def _other_bearings(setup: Setup, scene: Scene, fits: Fits, best: NDArray[np.int64]) -> _Views:
    """Return other bearings of landmarks that tell the heading δ − b, and little of its two parts."""
    std = fits.std_without_one[best, setup.free.index("bearing_rad")]
    flat = best[std > setup.policy.sure_bearing * scene.search.column_rad / 2]
    return _slid(setup, scene, flat, fits.view[flat], _slides(setup))


def _slides(setup: Setup) -> tuple[float, ...]:
    return setup.policy.slides_with_prior if setup.bearing_has_prior else setup.policy.slides


def _slid(
    setup: Setup, scene: Scene, which: NDArray[np.int64], view: NDArray[np.float64], sides: tuple[float, ...]
) -> _Views:
    """Return views whose bearings move by some half columns, the heading kept."""
    moves = np.zeros((len(sides), 1, len(VIEW)))
    moves[:, 0, 1] = moves[:, 0, 2] = np.array(sides) * scene.search.column_rad / 2
    return np.tile(which, len(sides)), (view + moves).reshape(-1, len(VIEW))


def _rotated(point_m: NDArray[np.float64], delta_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return R(δ) p' of PHYSICS section 1, horizontally; (m, 2)."""
    cos, sin = np.cos(delta_rad), np.sin(delta_rad)
    x, y = point_m[:, 0], point_m[:, 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)
