"""From candidates to the nearest maxima of the likelihood, with their uncertainty.

Levenberg–Marquardt with the pixels that count at the start; where the solution would decide otherwise which pixels
count, it is decided again there, once, and the view moves again. Before that, lower minima behind kinks in δ are looked
for; after it, views that contradict pixels are left for better ones nearby.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.contradictions import contradicted_pixels, outlying_pixels, whole_cost
from phasemark.matcher.likelihood.descent import descend
from phasemark.matcher.likelihood.fits import BETTER_COST, Fits
from phasemark.matcher.likelihood.images import VIEW, ImageModel
from phasemark.matcher.likelihood.kinks import look_beside, settle
from phasemark.matcher.likelihood.problem import ALBEDO_COLUMN, DescentSettings, Problem, State, picked
from phasemark.matcher.likelihood.residuals import Evidence, Sums, gauss_newton_sums
from phasemark.matcher.likelihood.uncertainty import (
    capped_std,
    slopes_along_axes,
    slopes_around,
    std_without_one_pixel,
    view_covariance,
)
from phasemark.matcher.pixel_agreement import DISAGREEMENT

_NEAR_SIGMA = 0.3
"""Within this many standard deviations two fits of one class are one. Other minima may be one deviation away: a fit
there tells how far the explanations of a frame extend, and keeps its answer from being accepted for too sure."""


def refine(
    model: ImageModel,
    evidence: Evidence,
    frame: NDArray[np.int64],
    class_index: NDArray[np.int64],
    view: NDArray[np.float64],
    settings: DescentSettings,
    give_up_above: NDArray[np.float64] | None = None,
    rival: NDArray[np.float64] | None = None,
    *,
    roughly: bool = False,
    at_first_sight: bool = False,
    look_like: Fits | None = None,
) -> Fits:
    """Move m candidates to the nearest maximum of the likelihood.

    Parameters
    ----------
    model : ImageModel
    evidence : Evidence
    frame, class_index : (m,) int64
        Which frame each candidate explains, and by which class.
    view : (m, 6) float64
        Where it starts, columns :data:`~phasemark.matcher.likelihood.images.VIEW`.
    settings : DescentSettings
    give_up_above : (m,) float64, optional
        Stop where the cost promises to stay above this.
    rival : (m,) float64, optional
        Cost of the best known explanation of each candidate's frame; a candidate that costs more than it by 50
        (`SearchPolicy.close_cost`) is refined roughly.
    roughly : bool
        Whether to stop within a fraction of a standard deviation, with the pixels that counted at the start.
    at_first_sight : bool
        Whether to give up at the start already, where its cost is far above the limit. Use it only where starts are
        close to a solution.
    look_like : Fits, optional
        The fits that the candidates look like, one each. A candidate that comes back to its fit is left out, unless it
        costs less.

    Returns
    -------
    Fits
        In the order of the candidates.
    """
    limit = np.full(len(frame), np.inf) if give_up_above is None else give_up_above
    problem = Problem(model, evidence, frame, class_index, settings, limit, rival)
    state = problem.start(view, at_first_sight)
    if roughly:
        state = descend(problem, state, settings.policy.rough_cost)
        return conclude(problem, state, look_around=False)
    if look_like is not None:
        state = descend(problem, state, settings.policy.rough_cost)
        problem, state, look_like = _others(problem, state, look_like)
    state = _descend_near(problem, state)
    if settings.look_beside_rad:
        state = look_beside(problem, state)
    state = _recounted(problem, state)
    if look_like is not None:
        problem, state, _ = _others(problem, state, look_like)
    if not model.slopes_are_cheap:  # interpolated coverages do not show the step in which an edge enters a pixel
        state = settle(problem, state)
    return conclude(problem, state)


def costs_at(
    model: ImageModel,
    evidence: Evidence,
    frame: NDArray[np.int64],
    class_index: NDArray[np.int64],
    view: NDArray[np.float64],
    settings: DescentSettings,
) -> NDArray[np.float64]:
    """Return what m candidates cost where they start, disagreements included; arguments as for :func:`refine`."""
    problem = Problem(model, evidence, frame, class_index, settings, np.full(len(frame), np.inf))
    if problem.with_albedo:  # the brightness of each has to be found first
        return whole_cost(problem, problem.start(view, False))[0]
    theta = np.column_stack([problem.clipped(view.copy(), np.arange(len(view))), np.ones(len(view))])
    return whole_cost(problem, problem.at(theta))[0]


def _others(problem: Problem, state: State, look_like: Fits) -> tuple[Problem, State, Fits]:
    """Leave out the candidates that came back to the fits that they look like, and cost no less."""
    columns = [VIEW.index(name) for name in problem.settings.free]
    away = (state.theta[:, :ALBEDO_COLUMN] - look_like.view)[:, columns]
    squared = np.einsum("mp,mpq,mq->m", away, look_like.information, away)
    came_back = (problem.class_index == look_like.class_index) & (squared < _NEAR_SIGMA**2)
    came_back &= whole_cost(problem, state)[0] >= look_like.cost - BETTER_COST
    others = np.flatnonzero(~came_back)
    return problem.some(others), picked(state, others), look_like[others]


def _descend_near(problem: Problem, state: State) -> State:
    """Descend to the minimum; roughly only where another explanation is better by far."""
    policy = problem.policy
    if not np.isfinite(problem.rival).any():
        return descend(problem, state, policy.settled_cost)
    state = descend(problem, state, policy.rough_cost)
    near = np.flatnonzero(state.sums.cost <= problem.rival + policy.close_cost)
    if near.size:
        state.update(near, descend(problem.some(near), picked(state, near), policy.settled_cost))
    return state


def _recounted(problem: Problem, state: State) -> State:
    """Decide again which pixels count, and descend again where they changed."""
    policy = problem.policy
    use = problem.pixels_at(state.images, state.theta)
    changed = np.flatnonzero((use != state.use).any(axis=1) & (state.sums.cost <= problem.rival + policy.margin_cost))
    if changed.size:
        again = problem.some(changed)
        before = whole_cost(again, picked(state, changed))[0]
        moved = descend(again, again.state(state.theta[changed], use[changed]), policy.settled_cost)
        # pixels that no longer count may hold a view no longer: it would slide to where they are contradicted
        better = np.flatnonzero(whole_cost(again, moved)[0] <= before + policy.recount_cost)
        state.update(changed[better], picked(moved, better))
    return state


def conclude(problem: Problem, state: State, *, look_around: bool = True) -> Fits:
    """Return the solutions with their costs and their uncertainties.

    Parameters
    ----------
    problem : Problem
    state : State
    look_around : bool
        Whether to look at what is near solutions that may be the best of their frame.
    """
    settings = problem.settings
    # 1  count contradicted pixels within three standard deviations, by the covariance of the descent's own slopes
    near = _near_solutions(problem, state) if look_around else np.empty(0, np.intp)
    sums, covariance = _sums_of_all_pixels(problem, state), view_covariance(problem, state.sums)
    pixels = _judged_pixels(problem, state, near, covariance)
    # 2  take the covariance of solutions that may still win from wide differences
    competitive = near[(sums.cost + _further_cost(pixels))[near] <= problem.rival[near] + DISAGREEMENT]
    covariance, without_one = _uncertainty(problem, state, competitive)
    # 3  count contradicted pixels again, by that covariance: it may excuse more of them, or fewer
    if competitive.size:
        pixels = _judged_pixels(problem, state, near, covariance)
    further = _further_cost(pixels)
    n_residuals = pixels.compared * problem.evidence.per_pixel + pixels.wrong + pixels.undecided
    n_fitted = int((problem.prior_weight == 0).sum())
    scale = problem.scale[: len(settings.free)]
    return Fits(
        frame=problem.frame,
        class_index=problem.class_index,
        view=state.theta[:, :ALBEDO_COLUMN],
        albedo=state.theta[:, ALBEDO_COLUMN],
        cost=sums.cost + further,
        capped=sums.capped + further,
        dof=np.maximum(n_residuals - pixels.unexplained - n_fitted, 0),
        unexplained=pixels.unexplained,
        explained=pixels.explained,
        agreeing=pixels.agreeing,
        elsewhere=pixels.elsewhere,
        prior=problem.prior_cost(state.theta),
        covariance=covariance,
        # the inverse of a covariance is information
        information=covariance_of(covariance / np.outer(scale, scale)) * np.outer(1 / scale, 1 / scale),
        std_without_one=without_one,
    )


def _near_solutions(problem: Problem, state: State) -> NDArray[np.intp]:
    """Return the solutions whose surroundings are looked at.

    Before a background the cost is final already, so they are the best of each frame. Otherwise contradicted pixels may
    still change the order of solutions whose costs are close.
    """
    if problem.settings.phasor_behind is not None:
        return problem.best_of_frames(state)
    return problem.near_best(state, problem.policy.close_cost)


def _uncertainty(
    problem: Problem, state: State, near: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return covariances, (m, p, p), and the largest deviations without any one pixel, (m, p).

    For the solutions in `near`, slopes are differenced over half a standard deviation; for the others the deviations
    are infinite.
    """
    covariance = view_covariance(problem, state.sums)
    without_one = np.full((len(state.theta), len(problem.settings.free)), np.inf)
    if near.size:
        there = problem.some(near)
        for _ in range(problem.policy.axis_rounds if problem.height_or_tilt_is_free else 1):
            if problem.height_or_tilt_is_free:
                wide: NDArray[np.complex128] | None = slopes_along_axes(there, state, near, covariance[near])
            else:
                wide = slopes_around(there, state, near, capped_std(problem, covariance[near]))
            slope = state.images.slope[near] if wide is None else wide
            images = replace(state.images[near], slope=slope)
            sums = there.summed(state.theta[near], state.use[near], images).sums
            if wide is not None:
                covariance[near] = view_covariance(problem, sums)
        without_one[near] = std_without_one_pixel(there, state, near, slope, sums.information, covariance[near])
    return covariance, without_one


def _sums_of_all_pixels(problem: Problem, state: State) -> Sums:
    """Return the sums of solutions over all pixels, also those that do not give the view."""
    settings = problem.settings
    if settings.used.all():
        return state.sums
    sums = gauss_newton_sums(
        state.images.phasor, state.images.slope, problem.evidence, problem.frame, state.use, settings.huber
    )
    return problem.with_prior(sums, state.theta)


def _further_cost(pixels: _PixelCounts) -> NDArray[np.float64]:
    """Return what pixels cost that leave no residual, (m,).

    A return that is neither compared nor wrong costs what a pixel costs on average: a model that counts fewer pixels is
    not better for it.
    """
    return np.asarray(DISAGREEMENT * pixels.wrong + pixels.undecided, np.float64)


class _PixelCounts(NamedTuple):
    """Pixels of each solution by what they say, (m,) int64; see :class:`Fits` for the last four."""

    compared: NDArray[np.int64]
    wrong: NDArray[np.int64]
    undecided: NDArray[np.int64]
    unexplained: NDArray[np.int64]
    explained: NDArray[np.int64]
    agreeing: NDArray[np.int64]
    elsewhere: NDArray[np.int64]


def _judged_pixels(
    problem: Problem, state: State, near: NDArray[np.intp], covariance: NDArray[np.float64]
) -> _PixelCounts:
    """Count the pixels of each solution that are compared, contradicted, or neither."""
    evidence = problem.evidence
    returned = evidence.seen.returned[problem.frame]
    fitted = state.use & (evidence.weight[problem.frame] > 0)
    wrong = contradicted_pixels(problem, state, near, covariance, ~fitted)
    undecided = returned & ~fitted & ~wrong
    n_fitted = fitted.sum(axis=1)
    if not problem.settings.unknown_around:
        none = np.zeros(len(state.theta), np.int64)
        return _PixelCounts(n_fitted, wrong.sum(axis=1), undecided.sum(axis=1), none, n_fitted, none, none)
    outlying, here = outlying_pixels(problem, state), state.use & returned
    wrong, undecided = wrong | (undecided & outlying), undecided & ~outlying
    return _PixelCounts(
        compared=n_fitted,
        wrong=wrong.sum(axis=1),
        undecided=undecided.sum(axis=1),
        unexplained=(fitted & outlying).sum(axis=1) + (wrong & returned).sum(axis=1),
        explained=(fitted & ~outlying).sum(axis=1),
        agreeing=(here & ~outlying).sum(axis=1),
        elsewhere=(here & outlying).sum(axis=1),
    )
