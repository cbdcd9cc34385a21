"""Covariances along the valleys of the likelihood, where those of slopes about a solution do not hold.

Where an edge reaches a border of pixels, slopes jump. Those about a solution may claim an angle that the cost some
standard deviations away does not confirm: the valley is flat to one side, or bends.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.estimate.acceptance import is_acceptable
from phasemark.matcher.estimate.fits import Fits, best_of_frame
from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.problem import ALBEDO_COLUMN, Problem, State
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.scenes import Scene
from phasemark.matcher.likelihood.uncertainty import step_of_others
from phasemark.matcher.nearest.cells import WIDE_PIXEL_RAD

__all__ = ["with_valleys"]

_ASKED_SIGMA, _DOUBTFUL_SHARE = 4.0, 0.5
"""How many standard deviations away the likelihood is asked whether a covariance holds, and below which share of the
rise that is expected there it does not."""


def with_valleys(scene: Scene, evidence: Evidence, fits: Fits) -> Fits:
    """Return fits with covariances as wide as the likelihood is; only the best of each frame, if it would be accepted.

    Each parameter is moved by four standard deviations to both sides, alone and, where pixels are wide or height, pitch
    or roll is free, with the others. Where the cost rises by less than half of what is expected, the part of that
    parameter is the second moment of its profile likelihood, along the valley. Nothing is done with a robust loss,
    which is flat far away by design.
    """
    setup = scene.setup
    if setup.huber is not None:
        return fits
    best = best_of_frame(fits)
    best = best[[is_acceptable(setup.rules, fits, int(k)) for k in best]]
    if not best.size:
        return fits
    own = fits[best]
    problem = Problem(scene.final, evidence, own.frame, own.class_index, scene.settings())
    theta = np.column_stack([own.view, own.albedo])
    together = setup.bank.sensor.pixel_rad > WIDE_PIXEL_RAD or not setup.height_and_tilt_are_known
    wide = _along_valleys(problem, problem.at(theta, with_slopes=problem.with_albedo), own.covariance, together)
    covariance, std, information = fits.covariance.copy(), fits.std_without_one.copy(), fits.information.copy()
    covariance[best] = wide
    std[best] *= np.sqrt(np.einsum("mpp->mp", wide) / np.einsum("mpp->mp", own.covariance))
    if together:  # elsewhere classes are weighed by their slopes: only the best of them is followed
        information[best] = covariance_of(wide, 1 / problem.scale[: wide.shape[1]])  # the inverse of a covariance
    return replace(fits, covariance=covariance, std_without_one=std, information=information)


def _along_valleys(
    problem: Problem, state: State, covariance: NDArray[np.float64], together: bool
) -> NDArray[np.float64]:
    """Return covariances of solutions that hold along the valleys of their likelihoods, too, (m, p, p)."""
    p, wide = covariance.shape[1], covariance.copy()
    known = np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2)))
    if not known.size:
        return wide
    each = np.arange(p)
    information, spread = covariance_of(covariance[known], 1 / problem.scale[:p]), covariance[known]
    along = spread / np.sqrt(spread[:, each, each])[..., None]
    alone = along * np.eye(p)
    asked = [along, alone, -along, -alone] if together else [alone, -alone]
    ways = _ASKED_SIGMA * np.stack(asked, axis=1)  # (k, ways, parameters moved, p)
    expected = np.einsum("kwap,kpq,kwaq->kwa", ways, information, ways)
    if problem.with_albedo:  # which follows
        sums = state.sums.information[known]
        follows = -sums[:, p, :p] / sums[:, p, p, None]
        ways, along = (
            np.concatenate([moves, np.einsum("k...p,kp->k...", moves, follows)[..., None]], axis=-1)
            for moves in (ways, along)
        )
    n = ways.shape[1] * ways.shape[2]
    rise = _rise_at(problem, state, np.repeat(known, n), ways.reshape(-1, ways.shape[3]))[0].reshape(expected.shape)
    doubtful = (rise < _DOUBTFUL_SHARE * expected).any(axis=1)
    row, k = np.nonzero(doubtful)
    if not row.size:
        return wide
    moments = _valley(problem, state, known[row], k, along[row, k])[:, :p, :p]
    for solution, d, moment in zip(known[row], k, moments, strict=True):
        one = wide[solution]
        if moment[d, d] > one[d, d]:  # what is left of the others where this parameter is known, and the valley
            wide[solution] = one - np.outer(one[:, d], one[:, d]) / one[d, d] + moment
    return wide


def _rise_at(
    problem: Problem,
    state: State,
    which: NDArray[np.integer],
    move: NDArray[np.float64],
    *,
    with_slopes: bool = False,
) -> tuple[NDArray[np.float64], State]:
    """Return how much more some solutions cost after a move (k, P), and the state there; infinite without a view.

    Its slopes are new on request, else those of the solutions.
    """
    some, theta = problem.some(which), state.theta[which]
    theta[:, problem.columns] += move
    wanted = theta[:, :ALBEDO_COLUMN].copy()
    theta[:, :ALBEDO_COLUMN] = some.clipped(theta[:, :ALBEDO_COLUMN], np.arange(len(theta)))
    there = some.state(theta, state.use[which], None if with_slopes else state.images.slope[which])
    shown = (theta[:, :ALBEDO_COLUMN] == wanted).all(axis=1)
    return np.where(shown, np.maximum(there.sums.cost - state.sums.cost[which], 0.0), np.inf), there


def _valley(
    problem: Problem, state: State, which: NDArray[np.integer], d: NDArray[np.integer], std: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return second moments of the profile likelihood of a parameter each, `d`, about some solutions, (k, P, P)."""
    least, rounds, farthest_root = 2.0, 5, 5.0  # standard deviations as stated, and as the cost has them
    fine = np.linspace(0.0, 1.0, 9)[1:]
    both, d, std = np.repeat(which, 2), np.repeat(d, 2), np.repeat(std, 2, axis=0)
    moment, mass = np.zeros((*std.shape, std.shape[1])), np.zeros(len(both))
    move, root, step = np.zeros_like(std), np.zeros(len(both)), least * std * np.tile([[-1.0], [1.0]], (len(which), 1))
    on = np.arange(len(both))
    for _ in range(rounds):
        rise, farther = _rise_beside(problem, state, both[on], d[on], step[on])
        there = np.sqrt(np.minimum(rise, 1e6))
        length = np.abs(farther - move[on])[np.arange(len(on)), d[on]]
        # the root of the cost and the others change in proportion between two offsets
        for share in fine:
            weight = np.exp(-((root[on] + share * (there - root[on])) ** 2) / 2) * length
            at = move[on] + share * (farther - move[on])
            moment[on] += weight[:, None, None] * at[:, :, None] * at[:, None, :]
            mass[on] += weight
        move[on], root[on], step[on] = farther, there, 3 * farther
        on = on[there < farthest_root]
        if not on.size:
            break
    total = mass.reshape(-1, 2).sum(axis=1)[:, None, None]
    return np.asarray(moment.reshape(len(which), 2, *moment.shape[1:]).sum(axis=1) / total)


def _rise_beside(
    problem: Problem, state: State, which: NDArray[np.integer], d: NDArray[np.integer], move: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how much more some solutions cost after a move, (k,), and the move (k, P) with which that is least.

    All parameters but `d` follow by one Gauss–Newton step there, or hardly, as across a kink.
    """
    ways = np.concatenate([move, np.where(np.arange(move.shape[1]) == d[:, None], move, 0.0)])
    twice = np.tile(which, 2)
    rise, there = _rise_at(problem, state, twice, ways, with_slopes=True)
    stepped = ways + step_of_others(problem, there.sums, np.tile(d, 2))[0]
    rises = np.concatenate([rise, _rise_at(problem, state, twice, stepped)[0]]).reshape(4, -1)
    moves = np.concatenate([ways, stepped]).reshape(4, *move.shape)
    return rises.min(axis=0), moves[rises.argmin(axis=0), np.arange(len(which))]
