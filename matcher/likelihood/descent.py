"""Levenberg–Marquardt for many candidates at once, and lower minima that no slope leads to.

Where an edge of the landmark crosses a pixel's border, slopes jump, and whether the pixel returns changes in a step.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.estimate.fits import BETTER_COST
from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.contradictions import whole_cost
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.problem import ALBEDO_COLUMN, LONGEST_STEP, Problem, State, picked
from phasemark.matcher.likelihood.residuals import Sums
from phasemark.matcher.likelihood.uncertainty import capped_axes, step_of_others, view_covariance

SETTLED_COST, ROUGH_COST = 1e-3, 0.1
"""A step that promises to lower the cost by less is not taken, and one that promised less than a hundred times as much
was the last; the second for first comparisons of minima."""

_FIRST_DAMPING = 1e-3
_HOPELESS_DAMPING = 1e5
CLOSE_BY_RAD = tuple(math.radians(angle) for angle in (-0.7, -0.28, -0.12, 0.12, 0.28, 0.7))
"""Offsets of δ at which a solution before a background or on phasors is compared with a parabola."""
_SETTLING_SIGMA = -5.0, -2.5, -1.5, -1.0, -0.5, -0.25, 0.25, 0.5, 1.0, 1.5, 2.5, 5.0
"""Where those are looked for, in standard deviations along the axes of the covariance."""


def descend(problem: Problem, state: State, settled: float) -> State:
    """Run Levenberg–Marquardt, each candidate with its own damping.

    Where a step promises little, slopes that were rendered before serve again; when a step with them fails, they are
    rendered again.
    """
    damping = np.full(len(state.theta), _FIRST_DAMPING)
    slopes_are_old = np.zeros(len(state.theta), np.bool_)
    reach = np.full(len(state.theta), problem.settings.longest_step)
    active = np.arange(len(state.theta))
    # where a step promises less than this, slopes rendered before serve again, until a step with them fails
    kept_slopes_cost = 30.0
    optimism = 3.0  # A descent gives up where even this many times the promised decrease would not save it.
    # A descent ends after a successful step that promised a decrease below this many times `settled`: convergence is
    # quadratic.
    last_promise = 100.0
    for _ in range(problem.policy.max_iterations):
        sums = state.sums
        step, limited = _steps(problem, sums.information[active], sums.gradient[active], damping[active], reach[active])
        # the predicted decrease: stop where it is negligible, or where several times it stays above the limit
        promise = np.einsum("mp,mp->m", sums.gradient[active], step)
        worth = (promise > settled) & (sums.cost[active] - optimism * promise < problem.limit[active])
        active, step, promise, limited = active[worth], step[worth], promise[worth], limited[worth]
        if not active.size:
            break
        theta = state.theta[active]
        theta[:, problem.columns] += step
        theta[:, :ALBEDO_COLUMN] = problem.clipped(theta[:, :ALBEDO_COLUMN], active)
        theta[:, ALBEDO_COLUMN] = np.maximum(theta[:, ALBEDO_COLUMN], 1e-3)
        promises_little = promise < kept_slopes_cost
        goes_on = np.ones(len(active), np.bool_)
        for which, with_slopes in ((np.flatnonzero(~promises_little), True), (np.flatnonzero(promises_little), False)):
            if not which.size:
                continue
            tried = active[which]
            slope = None if with_slopes else state.images.slope[tried]
            there = problem.some(tried).state(theta[which], state.use[tried], slope)
            better = there.sums.cost <= state.sums.cost[tried]
            goes_on[which] = (promise[which] > last_promise * settled) | ~better
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


def look_beside(problem: Problem, state: State) -> State:
    """Try δ a little to either side, and descend from where that is promising.

    The other parameters follow by one Gauss–Newton step.
    """
    sides = np.array(problem.settings.look_beside_rad)
    near = np.flatnonzero(state.sums.cost <= problem.limit)
    if not near.size:
        return state
    source = np.repeat(near, len(sides))
    theta = state.theta[source]
    turn = VIEW.index("delta_rad")
    theta[:, turn] += np.tile(sides, len(near))
    there = problem.some(source).turned(state, source, theta)
    d = int(np.flatnonzero(problem.columns == turn)[0])
    step, gain = step_of_others(problem, there.sums, np.tile(np.eye(len(problem.scale))[d], (len(source), 1)))
    rise = (there.sums.cost - gain).reshape(len(near), -1)
    rise -= state.sums.cost[near, None]
    # expected rise beside a single minimum: offset² / var(δ); a rise far below that shows another minimum
    expected_rise = sides**2 / np.einsum("mpp->mp", view_covariance(problem, state))[near, d][:, None]
    parabola_share = 0.5  # A cost there below this share of the parabola's shows another minimum.
    best = np.argmin(rise - parabola_share * expected_rise, axis=1)
    parabola = np.take_along_axis(expected_rise, best[:, None], axis=1)[:, 0]
    promising_cost = 20.0  # what a view beside a solution may cost more and still lead to a better one
    most = np.minimum(promising_cost, parabola_share * parabola)
    chosen = np.flatnonzero(np.take_along_axis(rise, best[:, None], axis=1)[:, 0] < most)
    if not chosen.size:
        return state
    which, at = near[chosen], chosen * len(sides) + best[chosen]
    theta = theta[at]
    theta[:, problem.columns] += step[at]
    theta[:, :ALBEDO_COLUMN] = problem.clipped(theta[:, :ALBEDO_COLUMN], which)
    some = problem.some(which)
    found = descend(some, some.state(theta, state.use[which]), SETTLED_COST)
    better = np.flatnonzero(found.sums.cost < state.sums.cost[which])
    state.update(which[better], picked(found, better))
    return state


def settle(problem: Problem, state: State, held: NDArray[np.integer]) -> State:
    """Move to better views nearby from those that contradict some pixels, and those that cost little more than a rival.

    Those in `held` are moved too: their slopes lead to where a pixel is contradicted.

    Whether a pixel returns changes in a step where an edge enters it, which no slope shows. So views up to five
    standard deviations away along the axes of the covariance are tried, with the whole cost of PHYSICS section 7.
    """
    cost, contradicted = whole_cost(problem, state)
    near = problem.near_best(state, problem.policy.close_cost)
    settling_rounds = 3  # how often a view that contradicts some pixels is left for a better one nearby
    for _ in range(settling_rounds):
        near = near[np.flatnonzero(contradicted[near] | (cost[near] > problem.rival[near]) | np.isin(near, held))]
        if not near.size:
            break
        moves = _moves(problem, state.sums, near)
        source = np.repeat(near, moves.shape[1])
        theta = state.theta[source]
        theta[:, problem.columns] += moves.reshape(len(source), -1)
        theta[:, :ALBEDO_COLUMN] = problem.clipped(theta[:, :ALBEDO_COLUMN], source)
        around = problem.around(source)
        total = whole_cost(around, around.at(theta))[0].reshape(len(near), -1)
        if problem.settings.around is not None:  # its images cost more by their own error
            here = problem.around(near)
            total += (cost[near] - whole_cost(here, here.at(state.theta[near]))[0])[:, None]
        best = total.argmin(axis=1)
        chosen = np.flatnonzero(total[np.arange(len(near)), best] < cost[near] - BETTER_COST)
        if not chosen.size:
            break
        at = chosen * moves.shape[1] + best[chosen]
        near = near[chosen]
        there = problem.some(near)
        found = descend(there, there.at(theta[at], with_slopes=True), SETTLED_COST)
        news, still = whole_cost(there, found)
        lost = np.flatnonzero(news > total[chosen, best[chosen]])
        if lost.size:  # slopes lead back to where a pixel is contradicted
            back = problem.some(near[lost])
            found.update(lost, back.at(theta[at[lost]], with_slopes=True))
            news[lost], still[lost] = whole_cost(back, picked(found, lost))
        wins = np.flatnonzero(news < cost[near])
        state.update(near[wins], picked(found, wins))
        cost[near[wins]], contradicted[near[wins]] = news[wins], still[wins]
        near = near[wins]
    return state


def _moves(problem: Problem, sums: Sums, which: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return steps along the axes of the covariance, (k, moves, p); where there is none, natural units."""
    axes = capped_axes(problem, covariance_of(sums.information[which], problem.scale))
    moves = np.einsum("kpa,s->kasp", axes, np.array(_SETTLING_SIGMA)).reshape(len(which), -1, len(problem.columns))
    longest = np.abs(moves / problem.scale).max(axis=2, keepdims=True)
    return np.asarray(moves * np.minimum(1.0, 2.0 / np.maximum(longest, 1e-30)))
