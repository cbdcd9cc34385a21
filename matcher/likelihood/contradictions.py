"""Pixels that a solution contradicts, and pixels that see something else than the landmark."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.likelihood.problem import ALBEDO_COLUMN, Problem, State
from phasemark.matcher.likelihood.residuals import range_residuals
from phasemark.matcher.likelihood.uncertainty import capped_axes
from phasemark.matcher.pixel_agreement import DISAGREEMENT, MAY_RETURN_COVERAGE, MUST_RETURN_COVERAGE, disagrees

_SIZES = -3.0, -2.0, -1.0, -0.5, 0.5, 1.0, 2.0, 3.0
"""Where views are tried that may excuse pixels, in standard deviations along the axes of the covariance."""
_EXCUSE_ROUNDS = 2


def contradicted_pixels(
    problem: Problem, state: State, near: NDArray[np.intp], covariance: NDArray[np.float64], among: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return which of some pixels return, or do not, as neither a solution nor one view nearby explains.

    Around the solutions in `near`, (k,) with covariances (k, p, p), views within three standard deviations are tried:
    what is excused is excused by the one that contradicts fewest pixels, of all that are trusted.
    """
    view = np.ascontiguousarray(state.theta[:, :ALBEDO_COLUMN])
    # a kink nearby excuses a pixel where it keeps it from being compared
    trusted = problem.model.trusted(problem.class_index, view)
    wrong = _disagreeing(problem, state.images.coverage, state.use) & trusted
    near, of = near[(wrong & among)[near].any(axis=1)], np.flatnonzero((wrong & among)[near].any(axis=1))
    if near.size:
        wrong[near] = _fewest_wrong(problem, state, near, covariance[of], trusted[near], wrong[near])
    return wrong & among


def _disagreeing(problem: Problem, coverage: NDArray[np.float64], use: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which pixels return, or do not, against the coverages of candidates, (m, pixels)."""
    seen, behind = problem.evidence.seen, problem.settings.returns_behind
    may, must = coverage >= MAY_RETURN_COVERAGE, coverage > MUST_RETURN_COVERAGE
    if behind is not None:
        may, must = may | problem.for_candidates(behind), use
    return disagrees(seen.returned[problem.frame], seen.not_returned[problem.frame], may, must)


def _fewest_wrong(
    problem: Problem,
    state: State,
    near: NDArray[np.intp],
    covariance: NDArray[np.float64],
    trusted: NDArray[np.bool_],
    wrong: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Return which pixels the views around solutions contradict that contradict fewest, (k, pixels).

    The views lie along the axes of the covariances, and then along these from the best of them. A view costs what its
    pixels do, and the square of how far it is, in standard deviations; where one is above a natural unit, in units.
    """
    k, p = covariance.shape[:2]
    axes = capped_axes(problem, covariance)
    moves = (np.array(_SIZES)[:, None, None] * np.eye(p)).reshape(-1, p)
    offset, cost = np.zeros((k, p)), DISAGREEMENT * wrong.sum(axis=1)
    source, own = np.repeat(near, len(moves)), np.repeat(np.arange(k), len(moves))
    around = problem.around(source)
    for _ in range(_EXCUSE_ROUNDS):
        tried = (offset[:, None] + moves).reshape(-1, p)
        view = state.theta[source, :ALBEDO_COLUMN]
        view[:, problem.columns[:p]] += np.einsum("npa,na->np", axes[own], tried)
        view = np.ascontiguousarray(problem.clipped(view, source))
        coverage = around.model.images(around.class_index, view, ()).coverage
        there = _disagreeing(around, coverage, state.use[source]) & trusted[own]
        distance2 = np.square(tried).sum(axis=1)
        total = np.where(distance2 <= 9.0, DISAGREEMENT * there.sum(axis=1) + distance2, np.inf).reshape(k, -1)
        best = total.argmin(axis=1)
        least = total[np.arange(k), best]
        better = np.flatnonzero(least < cost)
        if not better.size:
            break
        at = better * len(moves) + best[better]
        offset[better], cost[better], wrong[better] = tried[at], least[better], there[at]
    return wrong


def outlying_pixels(problem: Problem, state: State) -> NDArray[np.bool_]:
    """Return where the robust loss of a range has reached what a disagreement costs, (m, pixels)."""
    huber = problem.settings.huber or math.inf
    phasor = state.images.phasor
    residual = range_residuals(phasor, problem.evidence, problem.frame)
    size = np.abs(residual) * np.sqrt(problem.evidence.seen.weight[problem.frame])
    return np.asarray((phasor == 0) | (huber * (2 * size - huber) >= DISAGREEMENT))


def whole_cost(problem: Problem, state: State) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the cost of states with all their disagreements, and whether there are any; (m,) each."""
    compared = state.use & (problem.evidence.weight[problem.frame] > 0)
    wrong = contradicted_pixels(problem, state, np.empty(0, np.intp), np.empty((0, 0, 0)), ~compared)
    undecided = problem.evidence.seen.returned[problem.frame] & ~compared & ~wrong
    total = state.sums.cost + DISAGREEMENT * wrong.sum(axis=1) + undecided.sum(axis=1)
    dark = (compared & (state.images.phasor == 0)).any(axis=1)
    return np.asarray(total), np.asarray(wrong.any(axis=1) | dark, np.bool_)
