"""From candidates to the nearest maxima of the likelihood, with their uncertainty.

Levenberg–Marquardt with the pixels that count at the start; where the solution would decide otherwise which pixels
count, it is decided again there, once, and the view moves again. Before that, lower minima behind kinks in δ are looked
for; after it, views that contradict pixels are left for better ones nearby.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.chi_squared import p_values_of, worse_of_two
from phasemark.matcher.estimate.fits import Fits
from phasemark.matcher.information import covariance_of, eliminated
from phasemark.matcher.likelihood.contradictions import contradicted_pixels, outlying_pixels, stands_out, whole_cost
from phasemark.matcher.likelihood.descent import ROUGH_COST, SETTLED_COST, descend, look_beside, settle
from phasemark.matcher.likelihood.images import VIEW, ImageModel
from phasemark.matcher.likelihood.problem import ALBEDO_COLUMN, DescentSettings, Problem, State, picked
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.uncertainty import (
    capped_std,
    slopes_along_axes,
    slopes_around,
    std_without_one_pixel,
    view_covariance,
)
from phasemark.matcher.nearest.bank_minima import Starts
from phasemark.matcher.pixel_agreement import DISAGREEMENT, FILLED_COVERAGE, beside

_PIXELS_AT_ONCE = 1 << 20
"""Of all candidates that are refined roughly together: their images with slopes take some hundred bytes a pixel."""
_VIEWS_AT_ONCE = 512
"""Views whose costs are told together: their images stay in the processor's cache."""
Candidates = Fits | Starts
"""Views of m candidates, (m, 6), with the frame that each explains and its class, (m,) int64."""


def refine(
    model: ImageModel,
    evidence: Evidence,
    starts: Candidates,
    settings: DescentSettings,
    give_up_above: NDArray[np.float64] | None = None,
    rival: NDArray[np.float64] | None = None,
    *,
    roughly: bool = False,
) -> Fits:
    """Move m candidates to the nearest maximum of the likelihood.

    Parameters
    ----------
    model : ImageModel
    evidence : Evidence
    starts : Candidates
    settings : DescentSettings
    give_up_above : (m,) float64, optional
        Stop where the cost promises to stay above this.
    rival : (m,) float64, optional
        Cost of the best known explanation of each candidate's frame; a candidate that costs more than it by 50
        (`SearchPolicy.close_cost`) is refined roughly.
    roughly : bool
        Whether to stop within a fraction of a standard deviation, with the pixels that counted at the start.

    Returns
    -------
    Fits
        In the order of the candidates.
    """
    infinite = np.full(len(starts.frame), np.inf)
    limit, rival = (infinite if given is None else given for given in (give_up_above, rival))
    at_once = max(_PIXELS_AT_ONCE // settings.used.size, 1)
    if roughly and len(infinite) > at_once and not model.slopes_are_cheap:
        parts = [
            refine(model, evidence, some, settings, limit[own], rival[own], roughly=True)
            for own, some in _parts(starts, at_once)
        ]
        return Fits.joined(parts)
    problem = Problem(model, evidence, starts.frame, starts.class_index, settings, limit, rival)
    start = problem.start(starts.view)
    state = picked(start, np.arange(len(infinite)))
    state = descend(problem, state, ROUGH_COST) if roughly else _descend_near(problem, state)
    # pixels that did not count at the start may be contradicted at the end
    worse = np.flatnonzero(whole_cost(problem, state)[0] > whole_cost(problem, start)[0])
    state.update(worse, picked(start, worse))
    if roughly:
        return conclude(problem, state, look_around=False)
    if settings.look_beside_rad:
        state = look_beside(problem, state)
    state = _recounted(problem, state)
    if not model.slopes_are_cheap:  # interpolated coverages do not show the step in which an edge enters a pixel
        state = settle(problem, state, worse)
    return conclude(problem, state)


def _parts(starts: Candidates, at_once: int) -> Iterator[tuple[slice, Starts]]:
    """Yield candidates some at a time, with their places."""
    for first in range(0, len(starts.frame), at_once):
        own = slice(first, first + at_once)
        yield own, Starts(starts.frame[own], starts.class_index[own], starts.view[own])


def costs_at(
    model: ImageModel, evidence: Evidence, starts: Candidates, settings: DescentSettings
) -> NDArray[np.float64]:
    """Return what m candidates cost where they start, disagreements included; arguments as for :func:`refine`."""
    costs = [np.empty(0)]
    for _, some in _parts(starts, _VIEWS_AT_ONCE):
        problem = Problem(model, evidence, some.frame, some.class_index, settings)
        # on phasors the brightness of each has to be found first
        on_phasors = evidence.on == "phasors"
        there = problem.start(some.view) if on_phasors else problem.at(problem.parameters(some.view))
        costs.append(whole_cost(problem, there)[0])
    return np.concatenate(costs)


def slid(
    model: ImageModel, evidence: Evidence, starts: Candidates, settings: DescentSettings, farthest_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what m candidates cost at the best distance nearby, and the views there; arguments as for :func:`refine`.

    The ranges of all pixels grow as the distance does, and nothing else changes: good to `farthest_m`.
    """
    costs, views = [np.empty(0)], [np.empty((0, len(VIEW)))]
    settings = replace(settings, free=VIEW[:1], prior_std=(), albedo_std=0.0)
    for _, some in _parts(starts, _VIEWS_AT_ONCE):
        problem = Problem(model, evidence, some.frame, some.class_index, settings)
        theta = problem.parameters(some.view)
        there = np.ascontiguousarray(theta[:, :ALBEDO_COLUMN])
        images = model.images(some.class_index, there, ())
        slope = images.phasor * (1j / evidence.sensor.metres_per_radian)
        state = problem.summed(theta, problem.pixels_at(images, theta), replace(images, slope=slope[:, None]))
        gradient, information = state.sums.gradient[:, 0], state.sums.information[:, 0, 0]
        step = np.clip(gradient / np.maximum(information, 1e-30), -farthest_m, farthest_m)
        there[:, 0] += step
        costs.append(whole_cost(problem, state)[0] - (2 * gradient - information * step) * step)
        views.append(problem.clipped(there, np.arange(len(there))))
    return np.concatenate(costs), np.concatenate(views)


def _descend_near(problem: Problem, state: State) -> State:
    """Descend to the minimum; roughly only where another explanation is better by far."""
    policy = problem.policy
    if not np.isfinite(problem.rival).any():
        return descend(problem, state, SETTLED_COST)
    state = descend(problem, state, ROUGH_COST)
    near = np.flatnonzero(state.sums.cost <= problem.rival + policy.close_cost)
    if near.size:
        state.update(near, descend(problem.some(near), picked(state, near), SETTLED_COST))
    return state


def _recounted(problem: Problem, state: State) -> State:
    """Decide again which pixels count, and descend again where they changed."""
    policy = problem.policy
    use = problem.pixels_at(state.images, state.theta)
    changed = np.flatnonzero((use != state.use).any(axis=1) & (state.sums.cost <= problem.rival + policy.margin_cost))
    if changed.size:
        again = problem.some(changed)
        before = whole_cost(again, picked(state, changed))[0]
        moved = descend(again, again.state(state.theta[changed], use[changed]), SETTLED_COST)
        # cost by which a view may grow, contradicted pixels included, after deciding again which pixels count
        recount_cost = 25.0
        # pixels that no longer count may hold a view no longer: it would slide to where they are contradicted
        better = np.flatnonzero(whole_cost(again, moved)[0] <= before + recount_cost)
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
    nowhere = np.empty(0, np.intp)
    near = _near_solutions(problem, state) if look_around or problem.model.slopes_are_cheap else nowhere
    sums, covariance = state.sums, view_covariance(problem, state)
    if not settings.used.all():  # over all pixels, also those that do not give the view
        sums = problem.with_prior(problem.sums(state.images, state.use), state.theta)
    pixels = _judged_pixels(problem, state, near, covariance)
    # 2  take the covariance of solutions that may still win from wide differences
    competitive = near[(sums.cost + _further_cost(pixels))[near] <= problem.rival[near] + DISAGREEMENT]
    competitive = competitive if look_around else nowhere
    covariance, without_one = _uncertainty(problem, state, competitive, covariance)
    # 3  count contradicted pixels again, by that covariance: it may excuse more of them, or fewer
    if competitive.size:
        pixels = _judged_pixels(problem, state, near, covariance)
    further = _further_cost(pixels)
    dof = np.maximum(_residuals(problem, pixels) - int((problem.prior_weight == 0).sum()), 0)
    cost, prior = sums.cost + further, problem.prior_cost(state.theta)
    unexplained = pixels.unexplained.sum(axis=1)
    tested = cost - prior - DISAGREEMENT * unexplained
    p = len(settings.free)
    information = covariance_of(covariance, 1 / problem.scale[:p])  # the inverse of a covariance is information
    return Fits(
        frame=problem.frame,
        class_index=problem.class_index,
        view=state.theta[:, :ALBEDO_COLUMN],
        albedo=state.theta[:, ALBEDO_COLUMN],
        cost=cost,
        capped=sums.capped + further,
        dof=dof,
        p_value=_p_values(problem, state, pixels, tested, dof),
        unexplained=unexplained,
        explained=pixels.explained.sum(axis=1),
        stands_out=pixels.stands_out,
        prior=prior,
        covariance=covariance,
        information=np.where(np.isfinite(information), information, eliminated(state.sums.information, p)),
        std_without_one=np.where(pixels.plain[:, None], np.inf, without_one),  # what a plane shows has no class
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
    problem: Problem, state: State, near: NDArray[np.intp], covariance: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return covariances, (m, p, p), and the largest deviations without any one pixel, (m, p).

    Covariances by the descent's own slopes are given, and changed in place: for the solutions in `near`, slopes are
    differenced over half a standard deviation. For the others the deviations are infinite.
    """
    without_one = np.full((len(state.theta), len(problem.settings.free)), np.inf)
    if near.size:
        there = problem.some(near)
        # how often slopes are differenced along the axes of the covariance, which they make in turn, where height,
        # pitch or roll is free
        axis_rounds = 3
        for _ in range(axis_rounds if problem.height_or_tilt_is_free else 1):
            if problem.height_or_tilt_is_free:
                wide: NDArray[np.complex128] | None = slopes_along_axes(there, state, near, covariance[near])
            else:
                wide = slopes_around(there, state, near, capped_std(problem, covariance[near]))
            slope = state.images.slope[near] if wide is None else wide
            images = replace(state.images[near], slope=slope)
            smooth = there.summed(state.theta[near], state.use[near], images)
            covariance[near] = view_covariance(there, smooth)
        without_one[near] = std_without_one_pixel(there, smooth, covariance[near])
    return covariance, without_one


class _Pixels(NamedTuple):
    """Pixels of each solution by what they say, (m, pixels) bool; whether each stands out and is but a plane, (m,)."""

    compared: NDArray[np.bool_]
    wrong: NDArray[np.bool_]
    undecided: NDArray[np.bool_]
    unexplained: NDArray[np.bool_]
    explained: NDArray[np.bool_]
    stands_out: NDArray[np.bool_]
    plain: NDArray[np.bool_]

    def among(self, some: NDArray[np.bool_]) -> _Pixels:
        """Return those among some pixels."""
        return self._replace(**{name: getattr(self, name) & some for name in self._fields[:-2]})


def _further_cost(pixels: _Pixels) -> NDArray[np.float64]:
    """Return what pixels cost that leave no residual, (m,).

    A return that is neither compared nor wrong costs what a pixel costs on average: a model that counts fewer pixels is
    not better for it.
    """
    return np.asarray(DISAGREEMENT * pixels.wrong.sum(axis=1) + pixels.undecided.sum(axis=1), np.float64)


def _residuals(problem: Problem, pixels: _Pixels) -> NDArray[np.int64]:
    """Return how many residuals are tested, (m,)."""
    n = problem.evidence.per_pixel * pixels.compared.sum(axis=1) - pixels.unexplained.sum(axis=1)
    return np.asarray(n + pixels.wrong.sum(axis=1) + pixels.undecided.sum(axis=1), np.int64)


def _p_values(
    problem: Problem, state: State, pixels: _Pixels, tested: NDArray[np.float64], dof: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the p-values of the fits, (m,): the worse of two χ² tests, of edges and of what lies inside.

    Other shapes differ at their edges, in few pixels, which the noise of all others would hide. What a fit takes of the
    degrees of freedom of some pixels is their share of its information, tr(C · I): the sum over all is the number of
    its parameters.
    """
    edges = _at_edges(problem, state)
    sums = problem.sums(state.images, state.use & edges)
    unit = np.outer(problem.scale, problem.scale)
    inverse = np.linalg.pinv(state.sums.information * unit, hermitian=True)
    fitted = np.einsum("mpq,mqp->m", inverse, sums.information * unit)
    own = pixels.among(edges)
    cost = sums.cost + _further_cost(own) - DISAGREEMENT * own.unexplained.sum(axis=1)
    freedom = np.clip(_residuals(problem, own) - fitted, 0, dof)
    tails = problem.evidence.noise_tails[problem.frame]
    at_edges, inside = p_values_of(cost, freedom, tails), p_values_of(tested - cost, dof - freedom, tails)
    whole = p_values_of(tested, dof, tails)
    apart = (freedom >= 1) & (dof - freedom >= 1)
    return np.where(apart, worse_of_two(at_edges, inside), whole)


def _at_edges(problem: Problem, state: State) -> NDArray[np.bool_]:
    """Return which pixels the landmark does not fill, or not all of their neighbours, (m, pixels)."""
    sensor, coverage = problem.evidence.sensor, state.images.coverage
    open_ = (coverage < FILLED_COVERAGE).reshape(-1, sensor.rows, sensor.cols)
    return np.asarray((open_ | beside(open_)).reshape(coverage.shape))


def _judged_pixels(problem: Problem, state: State, near: NDArray[np.intp], covariance: NDArray[np.float64]) -> _Pixels:
    """Return the pixels of each solution that are compared, contradicted, or neither."""
    evidence = problem.evidence
    returned = evidence.seen.returned[problem.frame]
    fitted = state.use & (evidence.weight[problem.frame] > 0)
    wrong = contradicted_pixels(problem, state, near, covariance, ~fitted)
    undecided = returned & ~fitted & ~wrong
    if not problem.settings.unknown_around:
        stands = np.ones(len(state.theta), np.bool_)
        return _Pixels(fitted, wrong, undecided, np.zeros_like(fitted), fitted, stands, ~stands)
    outlying = outlying_pixels(problem, state)
    wrong, undecided = wrong | (undecided & outlying), undecided & ~outlying
    stands, plain = stands_out(problem, state, outlying)
    return _Pixels(
        compared=fitted,
        wrong=wrong,
        undecided=undecided,
        unexplained=(fitted & outlying) | (wrong & returned),
        explained=fitted & ~outlying,
        stands_out=stands,
        plain=plain,
    )
