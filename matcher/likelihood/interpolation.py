"""Answers from images that are interpolated from a bank, tried on rendered ones.

A surface that comes into view inside a cell of the bank, behind an edge or at the end of a gap, makes the range of a
pixel jump there; no interpolation follows, and its slope claims more than anything shows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.estimate.fits import Fits, best_of_frame, distinct_of_frames, least_of_frame
from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.contradictions import whole_cost
from phasemark.matcher.likelihood.images import ImageModel
from phasemark.matcher.likelihood.problem import Problem
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.scenes import Scene
from phasemark.matcher.likelihood.search import explaining_cost
from phasemark.matcher.likelihood.uncertainty import capped_axes
from phasemark.matcher.likelihood.valleys import rise_at

__all__ = ["misled_frames"]

_CHANGE = 2.0
"""By how much a cost may be another one on rendered images."""
_ASKED_SIGMA, _LACK = 2.0, 1.2
"""How many standard deviations away rendered images are asked whether their cost rises as it should, by four, and how
much may lack: a shift of 0.3 standard deviations, or 30 % of the information."""


def misled_frames(scene: Scene, rendered: ImageModel, evidence: Evidence, fits: Fits) -> NDArray[np.int64]:
    """Return the frames whose answer is another one on rendered images.

    The best fit of a frame must cost there what it costs, and the cost must rise along the axes of its covariance.
    Others that are near it only matter if they cost less than it seemed; and a frame that nothing explains, if
    something may.

    Parameters
    ----------
    scene : Scene
        Its final model interpolates.
    rendered : ImageModel
        Of the same landmarks.
    evidence : Evidence
    fits : Fits
    """
    setup, n, p = scene.setup, len(evidence.weight), len(scene.setup.free)
    near = np.flatnonzero(fits.cost <= least_of_frame(fits, n)[fits.frame] + setup.policy.close_cost)
    own = fits[distinct_of_frames(fits, near, setup.rules.symmetry)]
    best = best_of_frame(own)
    before, problem = (
        Problem(one, evidence, own.frame, own.class_index, scene.settings()) for one in (scene.final, rendered)
    )
    theta = problem.parameters(own.view)
    shown = (theta[:, : own.view.shape[1]] == own.view).all(axis=1)  # no view is, where the lens is in the landmark
    state = problem.at(theta)
    cost = whole_cost(problem, state)[0]
    change = cost - whole_cost(before, before.at(theta))[0]
    misled = change < -_CHANGE
    axes = _ASKED_SIGMA * capped_axes(problem, own.covariance[best]).transpose(0, 2, 1)
    information = covariance_of(own.covariance[best], 1 / problem.scale, weak="none")
    expected = np.einsum("map,mpq,maq->ma", axes, information, axes)
    ways = np.concatenate([axes, -axes], axis=1)
    rise = rise_at(problem, state, np.repeat(best, 2 * p), ways.reshape(-1, p))[0].reshape(len(best), 2 * p)
    lacks = (rise < np.tile(expected, 2) - _LACK).any(axis=1)
    misled[best] = lacks | (np.abs(change[best]) > _CHANGE)
    least = np.minimum(cost, own.cost)
    may_be_explained = least <= explaining_cost(setup, evidence)[own.frame] + setup.policy.likely_cost
    return np.unique(own.frame[misled & shown & may_be_explained])
