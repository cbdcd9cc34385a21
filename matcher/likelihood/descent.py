"""Levenberg–Marquardt for many candidates at once, each with a damping of its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.likelihood.problem import ALBEDO_COLUMN, LONGEST_STEP, Problem, State, picked

SETTLED_COST, ROUGH_COST = 1e-3, 0.1
"""A step that promises to lower the cost by less is not taken, and one that promised less than a hundred times as much
was the last; the second for first comparisons of minima."""
_KEPT_SLOPES_COST = 30.0
"""Where a step promises less than this, slopes rendered before serve again, until a step with them fails."""
_OPTIMISM = 3.0
"""A descent gives up where even this many times the promised decrease would not save it."""

_FIRST_DAMPING = 1e-3
_HOPELESS_DAMPING = 1e5
_LAST_PROMISE = 100.0
"""A descent ends after a successful step that promised a decrease below this many times `settled`: convergence is
quadratic."""


def descend(problem: Problem, state: State, settled: float) -> State:
    """Run Levenberg–Marquardt, each candidate with its own damping.

    Where a step promises little, slopes that were rendered before serve again; when a step with them fails, they are
    rendered again.
    """
    damping = np.full(len(state.theta), _FIRST_DAMPING)
    slopes_are_old = np.zeros(len(state.theta), np.bool_)
    reach = np.full(len(state.theta), problem.settings.longest_step)
    active = np.arange(len(state.theta))
    for _ in range(problem.policy.max_iterations):
        sums = state.sums
        step, limited = _steps(problem, sums.information[active], sums.gradient[active], damping[active], reach[active])
        # the predicted decrease: stop where it is negligible, or where several times it stays above the limit
        promise = np.einsum("mp,mp->m", sums.gradient[active], step)
        worth = (promise > settled) & (sums.cost[active] - _OPTIMISM * promise < problem.limit[active])
        active, step, promise, limited = active[worth], step[worth], promise[worth], limited[worth]
        if not active.size:
            break
        theta = state.theta[active].copy()
        theta[:, problem.columns] += step
        theta[:, :ALBEDO_COLUMN] = problem.clipped(theta[:, :ALBEDO_COLUMN], active)
        theta[:, ALBEDO_COLUMN] = np.maximum(theta[:, ALBEDO_COLUMN], 1e-3)
        promises_little = promise < _KEPT_SLOPES_COST
        goes_on = np.ones(len(active), np.bool_)
        for which, with_slopes in ((np.flatnonzero(~promises_little), True), (np.flatnonzero(promises_little), False)):
            if not which.size:
                continue
            tried = active[which]
            slope = None if with_slopes else state.images.slope[tried]
            there = problem.some(tried).state(theta[which], state.use[tried], slope)
            better = there.sums.cost <= state.sums.cost[tried]
            goes_on[which] = (promise[which] > _LAST_PROMISE * settled) | ~better
            damping[tried] = np.where(better, np.maximum(damping[tried] * 0.1, 1e-9), damping[tried] * 8)
            # who still has far to go after a step that was cut short may step further, until one fails
            farther = np.minimum(2 * reach[tried], LONGEST_STEP)
            reach[tried] = np.where(better & limited[which], np.maximum(farther, reach[tried]), reach[tried])
            reach[tried[~better]] = problem.settings.longest_step
            failed_on_old = tried[~better & slopes_are_old[tried]]
            wins = np.flatnonzero(better)
            state.update(tried[wins], picked(there, wins))
            slopes_are_old[tried[wins]] = not with_slopes
            if failed_on_old.size:
                state.update(
                    failed_on_old,
                    problem.some(failed_on_old).state(state.theta[failed_on_old], state.use[failed_on_old]),
                )
                slopes_are_old[failed_on_old], damping[failed_on_old] = False, _FIRST_DAMPING
        active = active[goes_on & (damping[active] < _HOPELESS_DAMPING)]
    return state


def _steps(
    problem: Problem,
    information: NDArray[np.float64],
    gradient: NDArray[np.float64],
    damping: NDArray[np.float64],
    reach: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return damped steps, (m, p), none longer than its reach along any axis of the information, and which were cut.

    A direction that a frame hardly tells, as the angle of a body that is nearly round, does not hold up the others.
    """
    scaled = information * np.outer(problem.scale, problem.scale)
    diagonal = np.einsum("mpp->mp", scaled)
    floor = 1e-12 * diagonal.max(axis=1, initial=0.0) + 1e-300
    held = scaled + np.einsum("mp,pq->mpq", damping[:, None] * diagonal + floor[:, None], np.eye(len(problem.scale)))
    values, axes = np.linalg.eigh(held)
    wanted = np.einsum("mpa,mp->ma", axes, gradient * problem.scale) / np.maximum(values, floor[:, None])
    step = np.clip(wanted, -reach[:, None], reach[:, None])
    return np.einsum("mpa,ma->mp", axes, step) * problem.scale, (step != wanted).any(axis=1)
