"""The likelihood at the tolerance, which tells how far an answer may be off where its covariance does not.

Beside a kink one side of a valley is steep and the other flat, and no parabola about its lowest point describes both.
So distance or angle is held at its tolerance, the other parameters follow, and the cost there tells how wide the valley
is: a profile likelihood.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.estimate.acceptance import is_acceptable
from phasemark.matcher.estimate.fits import Fits, best_of_frame
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.refine import refine
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.scenes import Scene
from phasemark.matcher.match import TOLERATED_SIGMA
from phasemark.matcher.nearest.grid import is_in_range
from phasemark.render.view import delta_period_rad

__all__ = ["with_profiles"]

_RISE = 3.5**2
"""By how much the cost must rise at the tolerance. With nine, three standard deviations, one true view in four hundred
lies beyond it where an answer is only just determined; along a flat valley many answers are."""


def with_profiles(scene: Scene, evidence: Evidence, fits: Fits) -> Fits:
    """Return fits with deviations of distance and angle as wide as the likelihood at their tolerances has them.

    Only the best fit of each frame is looked at, if it would be accepted. Where its cost rises by r < 12.25 at the
    tolerance t, its deviation is that with which it is refused, or t / √r if that is larger.
    """
    best = best_of_frame(fits)
    best = best[[is_acceptable(scene.setup.rules, fits, int(k)) for k in best]]
    std = fits.std_without_one.copy()
    for name in VIEW[:2]:
        column, tolerance = scene.setup.free.index(name), scene.setup.rules.tolerance[name]
        symmetry = np.array([scene.setup.rules.symmetry[c] for c in fits.class_index[best]])
        which = best if name == "distance_m" else best[math.pi > tolerance * symmetry]
        for side in (-tolerance, tolerance):
            rise = np.maximum(_rise(scene, evidence, fits[which], column, side), 1e-12)
            refused = 1.001 * tolerance / TOLERATED_SIGMA
            wide = np.where(rise < _RISE, np.maximum(refused, tolerance / np.sqrt(rise)), 0.0)
            std[which, column] = np.maximum(std[which, column], wide)
    return replace(fits, std_without_one=std)


def _rise(scene: Scene, evidence: Evidence, fits: Fits, column: int, offset: float) -> NDArray[np.float64]:
    """Return how much more fits cost with one parameter held at an offset, (m,); no more exactly than is needed.

    It is infinite beyond the range of the bank, and where the model shows no such view.
    """
    setup = scene.setup
    others = [k for k in range(len(setup.free)) if k != column]
    settings = scene.settings()
    known = tuple(settings.prior_std[k] for k in others) if settings.prior_std else ()
    settings = replace(settings, free=tuple(setup.free[k] for k in others), prior_std=known)
    moves = offset * fits.covariance[:, column] / fits.covariance[:, column, column, None]
    view = fits.view.copy()
    view[:, [VIEW.index(name) for name in setup.free]] += moves
    enough = fits.cost + _RISE
    moved = replace(fits, view=view)
    held = refine(scene.final, evidence, moved, settings, give_up_above=enough, roughly=True)
    grid, own = (setup.bank.distance_m, setup.bank.delta_rad), VIEW.index(setup.free[column])
    periods = [delta_period_rad(setup.rules.symmetry[c]) for c in fits.class_index]
    inside = np.array([is_in_range(*grid, one, period) for one, period in zip(view, periods, strict=True)], np.bool_)
    return np.where(inside & (held.view[:, own] == view[:, own]), held.cost - fits.cost, np.inf)
