"""Views that look like the best one, to which no slope leads: other sides, the back, and other bearings."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.likelihood.fits import Fits, best_of_frame
from phasemark.matcher.likelihood.images import ImageModel
from phasemark.matcher.likelihood.refine import refine
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.setup import Scene, Setup

__all__ = ["fit_look_alikes"]


def fit_look_alikes(setup: Setup, scene: Scene, evidence: Evidence, fits: Fits) -> Fits:
    """Let views that look like the best one explain each frame.

    A mesh with a symmetry that its bank does not have looks the same from several sides. A thin landmark looks
    nearly the same from the front and from the back, its middle seen at the same place. A flat one looks nearly the
    same under every bearing, its heading kept.
    """
    best = best_of_frame(fits)
    best = best[np.isfinite(fits.cost[best])]
    candidates = [*_other_sides(setup, fits, best), *_from_behind(setup, scene, fits, best)]
    if setup.bearing_is_free:
        candidates.extend(_other_bearings(setup, scene, fits, best))
    source = np.concatenate([which for which, _ in candidates])
    frame, class_index = fits.frame[source], fits.class_index[source]
    view = np.concatenate([views for _, views in candidates])
    return refine(
        scene.final,
        evidence,
        frame,
        class_index,
        _at_measured_distance(setup, scene.final, evidence, frame, class_index, view),
        scene.settings(setup),
        fits.cost[source] + setup.policy.likely_cost,
        # zones of a direct sensor do not mix light: the cost of a view says little of that of its neighbours
        at_first_sight=len(setup.free) == 2 or bool(setup.prior_std) or evidence.sensor.kind == "phase",
    )


_Candidates = list[tuple[NDArray[np.int64], NDArray[np.float64]]]
"""Indices of fits, and as many views to try instead of theirs."""


def _other_sides(setup: Setup, fits: Fits, best: NDArray[np.int64]) -> _Candidates:
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


def _from_behind(setup: Setup, scene: Scene, fits: Fits, best: NDArray[np.int64]) -> _Candidates:
    """Return views from the other side, the landmark's middle at the same place, under several bearings."""
    odd = best[np.array([setup.shapes.symmetry[c] % 2 for c in fits.class_index[best]], np.bool_)]
    view = fits.view[odd].copy()
    view[:, 1] += math.pi
    middle = setup.shapes.middle_m[fits.class_index[odd]]
    here, there = (_rotated(middle, delta) for delta in (fits.view[odd, 1], view[:, 1]))
    view[:, 0] += here[:, 0] - there[:, 0]
    if not setup.bearing_is_free:
        return [(odd, view + np.zeros(4))]
    view[:, 2] += np.arctan2(here[:, 1], fits.view[odd, 0] + here[:, 0])
    view[:, 2] -= np.arctan2(there[:, 1], view[:, 0] + there[:, 0])
    return [(odd, view + _slide(scene, side)) for side in (0.0, *_slides(setup))]


def _other_bearings(setup: Setup, scene: Scene, fits: Fits, best: NDArray[np.int64]) -> _Candidates:
    """Return other bearings of landmarks that tell the heading δ − b, and little of its two parts."""
    std = fits.std_without_one[best, setup.free.index("bearing_rad")]
    flat = best[std > setup.policy.sure_bearing * scene.search.column_rad / 2]
    return [(flat, fits.view[flat] + _slide(scene, side)) for side in _slides(setup)]


def _slides(setup: Setup) -> tuple[float, ...]:
    return setup.policy.slides_with_prior if setup.prior_std else setup.policy.slides


def _slide(scene: Scene, side: float) -> NDArray[np.float64]:
    """Return the change of a view whose bearing moves by some half columns, the heading kept."""
    half = scene.search.column_rad / 2
    return np.array([0.0, side * half, side * half, 0.0])


def _at_measured_distance(
    setup: Setup,
    model: ImageModel,
    evidence: Evidence,
    frame: NDArray[np.int64],
    class_index: NDArray[np.int64],
    view: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return views moved along their distance by the median residual of the ranges they explain, (m, 4)."""
    view = view.copy()
    for _ in range(setup.policy.registrations):
        view[:, 0] = np.clip(view[:, 0], *model.limits())
        phasor = model.images(class_index, np.ascontiguousarray(view), ()).phasor
        residual = evidence.sensor.metres_per_radian * np.angle(evidence.value[frame] * phasor.conj())
        compared = (phasor != 0) & (evidence.weight[frame] > 0)
        residual[~compared] = np.nan
        some = compared.any(axis=1)
        view[some, 0] += np.nanmedian(residual[some], axis=1)
    return view


def _rotated(point_m: NDArray[np.float64], delta_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return R(δ) p' of PHYSICS section 1, horizontally; (m, 2)."""
    cos, sin = np.cos(delta_rad), np.sin(delta_rad)
    x, y = point_m[:, 0], point_m[:, 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)
