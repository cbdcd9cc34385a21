"""Pixels that a solution contradicts, and pixels that see something else than the landmark."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.likelihood.problem import ALBEDO_COLUMN, Problem, State
from phasemark.matcher.likelihood.residuals import range_residuals
from phasemark.matcher.likelihood.uncertainty import capped_std
from phasemark.matcher.pixel_agreement import DISAGREEMENT, MAY_RETURN_COVERAGE, MUST_RETURN_COVERAGE, disagrees


def contradicted_pixels(
    problem: Problem, state: State, near: NDArray[np.intp], covariance: NDArray[np.float64], among: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return which of some pixels return, or do not, as no view within three standard deviations explains."""
    seen, settings = problem.evidence.seen, problem.settings
    returned, absent = seen.returned[problem.frame], seen.not_returned[problem.frame]
    # a kink nearby excuses a pixel where it keeps it from being compared
    among = among & problem.model.trusted(problem.class_index, state.theta[:, :ALBEDO_COLUMN])

    def disagree(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.bool_]:
        may, must = high >= MAY_RETURN_COVERAGE, low > MUST_RETURN_COVERAGE
        if settings.returns_behind is not None:
            may, must = may | problem.for_candidates(settings.returns_behind), state.use
        return disagrees(returned, absent, may, must) & among

    low, high = state.images.coverage.copy(), state.images.coverage.copy()
    wrong = disagree(low, high)
    near = near[wrong[near].any(axis=1)]
    if near.size:
        view = np.ascontiguousarray(state.theta[near, :ALBEDO_COLUMN])
        some = problem.around(near)
        around = some.model.reach(some.class_index, view, settings.free, capped_std(problem, covariance[near]))
        low[near], high[near] = np.minimum(low[near], around[0]), np.maximum(high[near], around[1])
        wrong = disagree(low, high)
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
