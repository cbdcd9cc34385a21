"""Levenberg–Marquardt for many candidates at once, each with a damping of its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.likelihood.problem import Problem, State, picked


def descend(problem: Problem, state: State, settled: float) -> State:
    """Run Levenberg–Marquardt, each candidate with its own damping.

    Close to the solution, slopes are those of the step before, until a step with them fails.
    """
    damping = np.full(len(state.theta), 1e-3)
    old = np.zeros(len(state.theta), np.bool_)
    active = np.arange(len(state.theta))
    for _ in range(problem.policy.max_iterations):
        sums = state.sums
        step = _steps(problem, sums.information[active], sums.gradient[active], damping[active])
        promise = np.einsum("mp,mp->m", sums.gradient[active], step)
        worth = (promise > settled) & (sums.cost[active] - problem.policy.optimism * promise < problem.limit[active])
        active, step, promise = active[worth], step[worth], promise[worth]
        if not active.size:
            break
        theta = state.theta[active].copy()
        theta[:, problem.columns] += step
        theta[:, :4] = problem.clipped(theta[:, :4])
        theta[:, 4] = np.maximum(theta[:, 4], 1e-3)
        close = promise < problem.policy.kept_slopes_cost
        stays = np.ones(len(active), np.bool_)
        for which, with_slopes in ((np.flatnonzero(~close), True), (np.flatnonzero(close), False)):
            if not which.size:
                continue
            k = active[which]
            slope = None if with_slopes else state.images.slope[k]
            there = problem.some(k).state(theta[which], state.use[k], slope)
            better = there.sums.cost <= state.sums.cost[k]
            wins = np.flatnonzero(better)
            # a step that was taken and promised little was the last: the next would promise its square
            stays[which] = (promise[which] > 100 * settled) | ~better
            lost = k[~better & old[k]]
            damping[k] = np.where(better, np.maximum(damping[k] * 0.1, 1e-9), damping[k] * 8)
            state.update(k[wins], picked(there, wins))
            old[k[wins]] = not with_slopes
            if lost.size:
                again = problem.some(lost).state(state.theta[lost], state.use[lost])
                state.update(lost, again)
                old[lost], damping[lost] = False, 1e-3
        active = active[stays & (damping[active] < 1e5)]
    return state


def _steps(
    problem: Problem, information: NDArray[np.float64], gradient: NDArray[np.float64], damping: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return damped steps, (m, p), none too long in any parameter."""
    scaled = information * np.outer(problem.scale, problem.scale)
    diagonal = np.einsum("mpp->mp", scaled)
    floor = 1e-12 * diagonal.max(axis=1, initial=0.0) + 1e-300
    held = scaled + np.einsum("mp,pq->mpq", damping[:, None] * diagonal + floor[:, None], np.eye(len(problem.scale)))
    step = np.linalg.solve(held, (gradient * problem.scale)[:, :, None])[:, :, 0]
    longest = np.abs(step).max(axis=1, keepdims=True)
    return np.asarray(
        step * np.minimum(1.0, problem.settings.longest_step / np.maximum(longest, 1e-30)) * problem.scale
    )
