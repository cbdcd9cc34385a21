"""From candidates to the nearest maxima of the likelihood, with their uncertainty.

Levenberg–Marquardt with the pixels that count at the start; where the solution would decide otherwise which pixels
count, it is decided again there, once, and the view moves again. Then lower minima behind kinks are looked for.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.agreement import DISAGREEMENT
from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.contradictions import contradicted_pixels, outlying_pixels
from phasemark.matcher.likelihood.descent import descend
from phasemark.matcher.likelihood.fits import Fits
from phasemark.matcher.likelihood.images import ImageModel, ModelImages
from phasemark.matcher.likelihood.kinks import look_beside, settle
from phasemark.matcher.likelihood.problem import Problem, Settings, State
from phasemark.matcher.likelihood.residuals import Evidence, gauss_newton_sums
from phasemark.matcher.likelihood.uncertainty import (
    capped_std,
    slopes_around,
    std_without_one_pixel,
    view_covariance,
)


def refine(
    model: ImageModel,
    evidence: Evidence,
    frame: NDArray[np.int64],
    class_index: NDArray[np.int64],
    view: NDArray[np.float64],
    settings: Settings,
    give_up_above: NDArray[np.float64] | None = None,
    *,
    roughly: bool = False,
    at_first_sight: bool = False,
) -> Fits:
    """Move m candidates to the nearest maximum of the likelihood.

    Parameters
    ----------
    model : ImageModel
    evidence : Evidence
    frame, class_index : (m,) int64
        Which frame each candidate explains, and by which class.
    view : (m, 4) float64
        Where it starts, columns :data:`~phasemark.matcher.likelihood.images.VIEW`.
    settings : Settings
    give_up_above : (m,) float64, optional
        Stop where the cost promises to stay above this.
    roughly : bool
        Whether to stop within a fraction of a standard deviation, with the pixels that counted at the start.
    at_first_sight : bool
        Whether to give up at the start already, where its cost is far above the limit: for starts that are good.

    Returns
    -------
    Fits
        In the order of the candidates.
    """
    limit = np.full(len(frame), np.inf) if give_up_above is None else give_up_above
    problem = Problem(model, evidence, frame, class_index, settings, limit)
    state = problem.start(view, at_first_sight)
    state = descend(problem, state, settings.policy.rough_cost if roughly else settings.policy.settled_cost)
    if roughly:
        return conclude(problem, state, look_around=False)
    if settings.look_beside_rad:
        state = look_beside(problem, state)
    use = problem.pixels_at(state.images, state.theta)
    changed = np.flatnonzero((use != state.use).any(axis=1))
    if changed.size:
        again = problem.some(changed)
        moved = descend(again, again.state(state.theta[changed], use[changed]), settings.policy.settled_cost)
        state.update(changed, moved)
    if not model.slopes_are_free:
        state = settle(problem, state)
    return conclude(problem, state)


def conclude(problem: Problem, state: State, *, look_around: bool = True) -> Fits:
    """Take stock of the solutions."""
    settings, evidence = problem.settings, problem.evidence
    p = len(settings.free)
    covariance = view_covariance(problem, state.sums)
    # where it does not matter any more, what is nearby is not looked at
    # before a background the cost is final here; otherwise pixels that nothing explains may still change it
    margin = problem.policy.close_cost if settings.background is None else 0.0
    near = problem.near_best(state, margin) if look_around else np.empty(0, np.intp)
    without_one = np.full((len(state.theta), p), np.inf)
    if near.size:
        there = problem.some(near)
        slope = slopes_around(there, state, near, capped_std(problem, covariance[near]))
        sums = there.summed(
            state.theta[near],
            state.use[near],
            ModelImages(
                **{name: values[near] for name, values in vars(state.images).items() if name != "slope"},
                slope=state.images.slope[near] if slope is None else slope,
            ),
        ).sums
        if slope is not None:
            covariance[near] = view_covariance(problem, sums)
        rows = state.images.slope[near] if slope is None else slope
        without_one[near] = std_without_one_pixel(there, state, near, rows, sums.information, covariance[near])
    scale = problem.scale[:p]
    # the inverse of a covariance is information
    information = covariance_of(covariance / np.outer(scale, scale)) * np.outer(1 / scale, 1 / scale)
    all_pixels = np.ones_like(settings.pixels)
    sums = state.sums
    if not settings.pixels.all():
        sums = gauss_newton_sums(
            state.images.phasor, state.images.slope, evidence, problem.frame, state.use & all_pixels, settings.huber
        )
        sums = problem.with_prior(sums, state.theta)
    fitted = state.use & (evidence.weight[problem.frame] > 0)
    wrong = contradicted_pixels(problem, state, near, covariance, ~fitted)
    returned = evidence.seen.returned[problem.frame]
    # a return that is neither compared nor wrong costs what a pixel costs on average: a model that counts fewer
    # pixels is not better for it
    open_ = returned & ~fitted & ~wrong
    unexplained, agreeing, elsewhere = (np.zeros(len(state.theta), np.int64) for _ in range(3))
    if settings.unknown_around:
        outlying, here = outlying_pixels(problem, state), state.use & returned
        wrong, open_ = wrong | (open_ & outlying), open_ & ~outlying
        agreeing, elsewhere = (here & ~outlying).sum(axis=1), (here & outlying).sum(axis=1)
        unexplained = (fitted & outlying).sum(axis=1) + (wrong & returned).sum(axis=1)
    n_wrong, n_open = wrong.sum(axis=1), open_.sum(axis=1)
    n_residuals = fitted.sum(axis=1) * evidence.per_pixel + n_wrong + n_open
    if settings.unknown_around:
        fitted = fitted & ~outlying
    return Fits(
        frame=problem.frame,
        class_index=problem.class_index,
        view=state.theta[:, :4],
        albedo=state.theta[:, 4],
        cost=sums.cost + DISAGREEMENT * n_wrong + n_open,
        capped=sums.capped + DISAGREEMENT * n_wrong + n_open,
        dof=np.maximum(n_residuals - unexplained - int((problem.prior_weight == 0).sum()), 0),
        unexplained=unexplained,
        explained=fitted.sum(axis=1),
        agreeing=agreeing,
        elsewhere=elsewhere,
        prior=problem.prior_cost(state.theta),
        covariance=covariance,
        information=information,
        std_without_one=without_one,
    )
