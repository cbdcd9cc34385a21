"""Estimate of the floor's albedo, where light that bounces off it counts and nobody knows it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.estimate.fits import Fits, best_of_frame, distinct_of_frames, least_of_frame, with_refined
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.refine import refine
from phasemark.matcher.likelihood.rendered_images import RenderedModel
from phasemark.matcher.likelihood.residuals import STRANGE_SIGMA, Evidence, range_residuals, range_slopes
from phasemark.matcher.likelihood.scenes import Scene
from phasemark.matcher.likelihood.setup import Setup
from phasemark.render import Background

__all__ = ["Floors", "estimate_floors", "fit_before_floors"]

_STEPS = 3
_STEP = 0.05
"""Width of a difference in the albedo."""
_LEAST, _MOST = 0.02, 0.98


@dataclass(frozen=True, eq=False)
class Floors:
    """Floors of n frames.

    Parameters
    ----------
    backgrounds : list of Background
        With the albedo that the frame is explained best with.
    part : (n, p, p) float64
        What the uncertainty of the albedo adds to the covariance of the view.
    """

    backgrounds: list[Background]
    part: NDArray[np.float64]


def estimate_floors(
    setup: Setup, rendered: RenderedModel, evidence: Evidence, fits: Fits, stated: Background
) -> Floors:
    """Estimate view and floor's albedo together, from each frame's best view so far.

    Parameters
    ----------
    setup : Setup
    rendered : RenderedModel
    evidence : Evidence
        Of n frames.
    fits : Fits
    stated : Background
        With the mean of the albedo and its standard deviation before a frame is seen.
    """
    n, p = len(evidence.weight), len(setup.free)
    backgrounds, part = [stated] * n, np.zeros((n, p, p))
    fits = fits[np.isfinite(fits.cost)]
    best = fits[best_of_frame(fits)]
    if not len(best):
        return Floors(backgrounds, part)
    frame, class_index, view = best.frame, best.class_index, best.view
    albedo = np.full(len(frame), stated.floor_albedo)
    columns = [VIEW.index(name) for name in setup.free]
    for step in range(_STEPS + 1):
        here, low, high = (
            rendered.with_background(*(replace(stated, floor_albedo=float(own)) for own in albedo + shift))
            for shift in (0.0, -_STEP, _STEP)
        )
        own = np.arange(len(frame))
        image = here.of_frames(own).images(class_index, view, setup.free)
        ends = [model.of_frames(own).images(class_index, view, ()).phasor for model in (low, high)]
        slope = np.concatenate([image.slope, ((ends[1] - ends[0]) / (2 * _STEP))[:, None]], axis=1)
        rows = range_slopes(image.phasor, slope, evidence.sensor)
        residual = range_residuals(image.phasor, evidence, frame)
        weight = np.where(setup.used & (image.phasor != 0), evidence.weight[frame], 0.0)
        weight = np.where(weight * residual**2 > STRANGE_SIGMA**2, 0.0, weight)
        information = np.einsum("mpi,mi,mqi->mpq", rows, weight, rows)
        gradient = np.einsum("mpi,mi->mp", rows, weight * residual)
        prior = np.zeros(p + 1)
        if setup.prior_std:
            prior[:p] = np.array(setup.prior_std) ** -2.0
            gradient[:, :p] -= prior[:p] * view[:, columns]
        prior[p] = stated.floor_albedo_std**-2.0
        gradient[:, p] -= prior[p] * (albedo - stated.floor_albedo)
        information += np.diag(prior)
        if step == _STEPS:
            break
        move = np.einsum("mpq,mq->mp", np.linalg.pinv(information, hermitian=True), gradient)
        view[:, columns] += move[:, :p]
        albedo = np.clip(albedo + move[:, p], _LEAST + _STEP, _MOST - _STEP)
    covariance = np.linalg.pinv(information, hermitian=True)
    alone = np.linalg.pinv(information[:, :p, :p], hermitian=True)
    for k, one in enumerate(frame):
        backgrounds[one] = replace(
            stated, floor_albedo=float(albedo[k]), floor_albedo_std=float(np.sqrt(covariance[k, p, p]))
        )
        part[one] = covariance[k, :p, :p] - alone[k]
    return Floors(backgrounds, part)


def fit_before_floors(scene: Scene, evidence: Evidence, fits: Fits) -> Fits:
    """Refine the likely views again, each frame before its own floor; others keep their distance from the best."""
    setup, least = scene.setup, least_of_frame(fits, len(evidence.weight))
    close = np.isfinite(fits.cost) & (fits.cost < least[fits.frame] + setup.policy.margin_cost)
    modes = distinct_of_frames(fits, np.flatnonzero(close), setup.rules.symmetry)
    return with_refined(fits, modes, refine(scene.final, evidence, fits[modes], scene.settings()), len(least))
