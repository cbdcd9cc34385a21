"""Covariances along the valleys of the likelihood, where those of slopes about a solution do not hold.

Where an edge reaches a border of pixels, slopes jump. Those about a solution may claim an angle that the cost some
standard deviations away does not confirm: the valley is flat to one side, or bends.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.matcher.estimate.acceptance import is_acceptable
from phasemark.matcher.estimate.fits import BETTER_COST, Fits, best_of_frame
from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.problem import ALBEDO_COLUMN, Problem, State
from phasemark.matcher.likelihood.refine import refine
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.scenes import Scene
from phasemark.matcher.likelihood.search import near_settings
from phasemark.matcher.likelihood.uncertainty import step_of_others
from phasemark.matcher.nearest.bank_minima import Starts
from phasemark.matcher.nearest.cells import WIDE_PIXEL_RAD

__all__ = ["rise_at", "with_valleys"]

_ASKED_SIGMA, _DOUBTFUL_SHARE = 4.0, 0.5
"""How many standard deviations away the likelihood is asked whether a covariance holds, and below which share of the
rise that is expected there it does not."""


def with_valleys(scene: Scene, evidence: Evidence, fits: Fits) -> Fits:
    """Return fits with covariances as wide as the likelihood is; only the best of each frame, if it would be accepted.

    A fit is moved by four standard deviations to both sides along each principal axis of its covariance and each
    parameter, alone and, where pixels are wide or height, pitch or roll is free, with the others. Where the cost rises
    by less than half of what is expected, the covariance holds the second moment of the profile likelihood along that
    direction, its valley, too. Where it falls, the fit descends from there, once. Nothing is done with a robust loss,
    which is flat far away by design.
    """
    setup = scene.setup
    if setup.huber is not None:
        return fits
    best = best_of_frame(fits)
    best = best[[is_acceptable(setup.rules, fits, int(k)) for k in best]]
    if not best.size:
        return fits
    own, lower = _followed(scene, evidence, fits[best])
    falls = np.flatnonzero(np.isfinite(lower).all(axis=1))
    if falls.size and not setup.unknown:  # which refines on some pixels only
        starts = Starts(own.frame[falls], own.class_index[falls], lower[falls])
        again = refine(scene.final, evidence, starts, near_settings(scene, evidence))
        better = np.flatnonzero(again.cost < own.cost[falls] - BETTER_COST)
        if better.size:
            found = _followed(scene, evidence, again[better])[0]
            own = own.with_rows(falls[better], _with_left(scene, found, own[falls[better]]))
    return fits.with_rows(best, own)


def _with_left(scene: Scene, found: Fits, left: Fits) -> Fits:
    """Return fits whose covariances hold the minima beside them that were left, by how likely these are."""
    away = (left.view - found.view)[:, [VIEW.index(name) for name in scene.setup.free]]
    share = special.expit(0.5 * (found.cost - left.cost))
    wide = found.covariance + share[:, None, None] * away[:, :, None] * away[:, None, :]
    growth = np.einsum("mpp->mp", wide) / np.einsum("mpp->mp", found.covariance)
    return replace(found, covariance=wide, std_without_one=found.std_without_one * np.sqrt(growth))


def _followed(scene: Scene, evidence: Evidence, fits: Fits) -> tuple[Fits, NDArray[np.float64]]:
    """Return fits with these covariances, and a view beside each that costs less, (m, 6); NaN if there is none."""
    problem = Problem(scene.final, evidence, fits.frame, fits.class_index, scene.settings())
    theta = np.column_stack([fits.view, fits.albedo])
    state = problem.at(theta, with_slopes=problem.with_albedo)
    setup, information = scene.setup, fits.information
    together = setup.bank.sensor.pixel_rad > WIDE_PIXEL_RAD or not setup.height_and_tilt_are_known
    wide, lower = _along_valleys(problem, state, fits.covariance, together)
    growth = np.einsum("mpp->mp", wide) / np.einsum("mpp->mp", fits.covariance)
    if together:  # elsewhere classes are weighed by their slopes: only the best of them is followed
        information = covariance_of(wide, 1 / problem.scale[: wide.shape[1]])  # the inverse of a covariance
    std = fits.std_without_one * np.sqrt(growth)
    return replace(fits, covariance=wide, std_without_one=std, information=information), lower


class _Axes(NamedTuple):
    """Directions in which the likelihood about some solutions is followed, (k, a, P) each.

    The product of `held` and a step is how far it goes along the axis, in standard deviations. `along` goes one of them
    with all parameters as the covariance has it, `alone` with as few as can be.
    """

    held: NDArray[np.float64]
    along: NDArray[np.float64]
    alone: NDArray[np.float64]


def _axes_of(
    problem: Problem, state: State, known: NDArray[np.integer], covariance: NDArray[np.float64]
) -> tuple[_Axes, NDArray[np.float64]]:
    """Return the parameters and the principal axes of covariances (k, p, p), and their information."""
    p = covariance.shape[1]
    scale = problem.scale[:p]
    information = covariance_of(covariance, 1 / scale)
    std = np.sqrt(np.einsum("kpp->kp", covariance))[:, :, None]
    variance, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    principal = (vectors * np.sqrt(np.maximum(variance, 0.0))[:, None]).transpose(0, 2, 1) * scale
    each = np.eye(p)
    axes = _Axes(
        np.concatenate([each / std, principal @ information], axis=1),
        np.concatenate([covariance / std, principal], axis=1),
        np.concatenate([each * std, principal], axis=1),
    )
    if problem.with_albedo:  # which follows
        sums = state.sums.information[known]
        follows = -sums[:, p, :p] / sums[:, p, p, None]
        held, *ways = axes
        ways = [np.concatenate([way, np.einsum("kap,kp->ka", way, follows)[..., None]], axis=-1) for way in ways]
        axes = _Axes(np.concatenate([held, np.zeros_like(held[..., :1])], axis=-1), *ways)
    return axes, information


def _along_valleys(
    problem: Problem, state: State, covariance: NDArray[np.float64], together: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return covariances of solutions that hold along the valleys of their likelihoods, too, (m, p, p).

    And the views (m, 6) that were found to cost less, NaN elsewhere.
    """
    p, wide, lower = covariance.shape[1], covariance.copy(), np.full((len(covariance), ALBEDO_COLUMN), np.nan)
    known = np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2)))
    if not known.size:
        return wide, lower
    axes, information = _axes_of(problem, state, known, covariance[known])
    asked = [axes.alone, -axes.alone, axes.along, -axes.along] if together else [axes.alone, -axes.alone]
    ways = _ASKED_SIGMA * np.concatenate(asked, axis=1)
    expected = np.einsum("kwp,kpq,kwq->kw", ways[..., :p], information, ways[..., :p])
    n = ways.shape[1]
    rise, there = rise_at(problem, state, np.repeat(known, n), ways.reshape(-1, ways.shape[2]))
    rise = rise.reshape(expected.shape)
    least = rise.argmin(axis=1)
    falls = rise.min(axis=1) < -BETTER_COST
    lower[known[falls]] = there.theta.reshape(len(known), n, -1)[falls, least[falls], :ALBEDO_COLUMN]
    doubtful = (rise < _DOUBTFUL_SHARE * expected).reshape(len(known), len(asked), -1).any(axis=1)
    row, a = np.nonzero(doubtful)
    if not row.size:
        return wide, lower
    followed = _Axes(*(one[row, a] for one in axes))
    moments = _valley(problem, state, known[row], followed)[:, :p, :p]
    for solution, held, moment in zip(known[row], followed.held[:, :p], moments, strict=True):
        wide[solution] = _at_least(wide[solution], held, moment, problem.scale[:p])
    return wide, lower


def _at_least(
    one: NDArray[np.float64], held: NDArray[np.float64], moment: NDArray[np.float64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a covariance that holds another one, and along a direction a valley's second moment, (p, p)."""
    own = one @ held
    if held @ moment @ held <= held @ own:
        return one
    value, vectors = np.linalg.eigh(one / np.outer(scale, scale))
    root = scale[:, None] * vectors * np.sqrt(np.maximum(value, 1e-12 * value.max()))
    # what is left of the others where this direction is known, and the valley: more than before in some directions
    more = np.linalg.solve(root, np.linalg.solve(root, moment - np.outer(own, own) / (held @ own)).T)
    value, vectors = np.linalg.eigh(more)
    axes = root @ vectors
    return np.asarray(one + (axes * np.maximum(value, 0.0)) @ axes.T)


def rise_at(
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
    return np.where(shown, there.sums.cost - state.sums.cost[which], np.inf), there


def _valley(problem: Problem, state: State, which: NDArray[np.integer], axes: _Axes) -> NDArray[np.float64]:
    """Return second moments of the profile likelihood along an axis (k, P) each of some solutions, (k, P, P)."""
    least, rounds, farthest_root = 2.0, 5, 5.0  # standard deviations as stated, and as the cost has them
    fine = np.linspace(0.0, 1.0, 9)[1:]
    both, axes = np.repeat(which, 2), _Axes(*(np.repeat(one, 2, axis=0) for one in axes))
    moment, mass = np.zeros((*axes.along.shape, axes.along.shape[1])), np.zeros(len(both))
    move, root = np.zeros_like(axes.along), np.zeros(len(both))
    step = least * axes.along * np.tile([[-1.0], [1.0]], (len(which), 1))
    on = np.arange(len(both))
    for _ in range(rounds):
        rise, farther = _rise_beside(problem, state, both[on], _Axes(*(one[on] for one in axes)), step[on])
        there = np.sqrt(np.clip(rise, 0.0, 1e6))
        length = np.abs(np.einsum("kp,kp->k", farther - move[on], axes.held[on]))
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
    problem: Problem, state: State, which: NDArray[np.integer], axes: _Axes, move: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how much more some solutions cost after a move, (k,), and the move (k, P) with which that is least.

    All else follows by one Gauss–Newton step there, or hardly, as across a kink.
    """
    alone = np.einsum("kp,kp->k", axes.held, move)[:, None] * axes.alone
    rise = rise_at(problem, state, np.tile(which, 2), np.concatenate([move, alone]))[0].reshape(2, -1)
    move = np.where((rise[0] <= rise[1])[:, None], move, alone)
    rise, there = rise_at(problem, state, which, move, with_slopes=True)
    stepped = move + step_of_others(problem, there.sums, axes.held)[0]
    least = rise_at(problem, state, which, stepped)[0]
    return np.minimum(rise, least), np.where((rise <= least)[:, None], move, stepped)
