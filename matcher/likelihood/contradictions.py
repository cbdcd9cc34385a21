"""Pixels that a solution contradicts, and whether a landmark among unknown things ends where it should."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.likelihood.problem import ALBEDO_COLUMN, Problem, State
from phasemark.matcher.likelihood.residuals import range_residuals
from phasemark.matcher.likelihood.uncertainty import capped_axes
from phasemark.matcher.pixel_agreement import (
    DISAGREEMENT,
    FILLED_COVERAGE,
    MAY_RETURN_COVERAGE,
    MUST_RETURN_COVERAGE,
    disagrees,
)

_SIZES = -3.0, -2.0, -1.0, -0.5, 0.5, 1.0, 2.0, 3.0
"""Where views are tried that may excuse pixels, in standard deviations along the axes of the covariance."""
_SEEN_THROUGH, _BESIDE_A_SLAB = 0.1, 0.5
"""Pixels that may see something behind the landmark, over those that agree with it; the second where no outline is in
view: a landmark may be modelled wider than it is, as a slab that fills the view, to leave its edges open."""


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
    # what is near the limit may return by its noise, or not, and contradicts nothing
    sure = problem.sure_pixels_at(state)
    wrong = _disagreeing(problem, state.images.coverage, sure) & trusted
    near, of = near[(wrong & among)[near].any(axis=1)], np.flatnonzero((wrong & among)[near].any(axis=1))
    if near.size:
        wrong[near] = _fewest_wrong(problem, state, near, covariance[of], trusted[near], wrong[near], sure)
    return wrong & among


def _disagreeing(problem: Problem, coverage: NDArray[np.float64], sure: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which pixels return, or do not, against the coverages of candidates, (m, pixels)."""
    seen, behind = problem.evidence.seen, problem.settings.returns_behind
    may, must = coverage >= MAY_RETURN_COVERAGE, sure
    if behind is None:
        must = must & (coverage > MUST_RETURN_COVERAGE)
    else:
        may = may | problem.for_candidates(behind)
    return disagrees(seen.returned[problem.frame], seen.not_returned[problem.frame], may, must)


def _fewest_wrong(
    problem: Problem,
    state: State,
    near: NDArray[np.intp],
    covariance: NDArray[np.float64],
    trusted: NDArray[np.bool_],
    wrong: NDArray[np.bool_],
    sure: NDArray[np.bool_],
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
    excuse_rounds = 2
    for _ in range(excuse_rounds):
        tried = (offset[:, None] + moves).reshape(-1, p)
        view = state.theta[source, :ALBEDO_COLUMN]
        view[:, problem.columns[:p]] += np.einsum("npa,na->np", axes[own], tried)
        view = np.ascontiguousarray(problem.clipped(view, source))
        coverage = around.model.images(around.class_index, view, ()).coverage
        there = _disagreeing(around, coverage, sure[source]) & trusted[own]
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


def stands_out(
    problem: Problem, state: State, outlying: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return whether solutions among unknown things show a landmark that stands where the model has it, and no other.

    Both are (m,); the second is True where something else than the landmark may be seen.

    Things before a landmark hide it, but none is seen through it, and what continues beyond its outline is none: on
    each of its four sides it must end as often as it continues, unless it continues across little of that side. A plane
    face may be that of any board, wall or post, unless it ends on three sides where the landmark does, or the landmark
    is a board itself.

    Parameters
    ----------
    problem : Problem
    state : State
    outlying : (m, pixels) bool
        Where the frame shows something else than the model.
    """
    seen, frame, coverage = problem.evidence.seen, problem.frame, state.images.coverage
    here = state.use & seen.returned[frame]
    agreeing, other = here & ~outlying, here & outlying
    farther = other & (range_residuals(state.images.phasor, problem.evidence, frame) > 0)
    through = (coverage >= FILLED_COVERAGE) & (farther | seen.not_returned[frame])
    has_outline = (coverage < MAY_RETURN_COVERAGE).any(axis=1)
    n_agreeing = agreeing.sum(axis=1)
    opaque = through.sum(axis=1) <= np.where(has_outline, _SEEN_THROUGH, _BESIDE_A_SLAB) * n_agreeing
    pairs, ends, continues = _outline(problem, state, agreeing)
    shown_outline = 0.25  # share of the outline in view that a frame must show
    shown = (ends > 0) & (ends >= shown_outline * pairs)
    good = opaque & (n_agreeing >= other.sum(axis=1)) & (ends.sum(axis=0) >= shown_outline * pairs.sum(axis=0))
    good &= ((ends >= continues) | (continues < shown_outline * pairs)).all(axis=0)
    good &= ends.sum(axis=0) >= continues.sum(axis=0)
    enough_sides = 3
    board = np.array(problem.settings.boards)[problem.class_index]
    doubtful, plain = np.flatnonzero(good & (shown.sum(axis=0) < enough_sides) & ~board), np.zeros(len(good), np.bool_)
    plain[doubtful] = _is_plain(problem.some(doubtful), state.images.phasor[doubtful], agreeing[doubtful])
    return np.asarray(good, np.bool_), plain


def _is_plain(problem: Problem, phasor: NDArray[np.complex128], agreeing: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return whether a plane explains the pixels that agree with model images as well as these do, (m,).

    In the image 1/z of a plane is linear, z the depth along the optical axis.
    """
    evidence, frame, sensor = problem.evidence, problem.frame, problem.evidence.sensor
    weight = evidence.seen.weight[frame] * agreeing
    own = np.sum(weight * range_residuals(phasor, evidence, frame) ** 2, axis=1)
    z = np.where(agreeing, evidence.seen.range_m[frame], 1.0) * sensor.axis_cosine().ravel()
    v, u = np.mgrid[: sensor.rows, : sensor.cols] + 0.5
    columns = np.stack([np.ones(u.size), *(one.ravel() for one in sensor.tangents(u, v))])
    weight = weight * (z**2 / sensor.axis_cosine().ravel()) ** 2
    information = np.einsum("mk,ak,bk->mab", weight, columns, columns)
    plane = np.linalg.pinv(information, hermitian=True) @ np.einsum("mk,ak->ma", weight / z, columns)[..., None]
    cost = np.sum(weight * (1 / z - plane[..., 0] @ columns) ** 2, axis=1)
    return np.asarray(cost <= own + DISAGREEMENT)


def _outline(problem: Problem, state: State, agreeing: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return how often what agrees could end at the outline of the landmark, ends and continues, (3, sides, m).

    A pixel that agrees is compared with the first one beyond the outline, along rows and columns, within two pixels: an
    edge may cross the one between. Beyond, nothing returns or something farther away (the surface ends), something from
    the same depth (it continues), or something nearer (its edge is hidden). The landmark's surface is extended by its
    tangent plane: along a row or column of an image 1/z of a plane is linear, z the depth along the optical axis.
    """
    sensor, seen, frame = problem.evidence.sensor, problem.evidence.seen, problem.frame
    shape, cosine = (-1, sensor.rows, sensor.cols), sensor.axis_cosine()
    coverage = state.images.coverage.reshape(shape)
    returned, absent = seen.returned[frame].reshape(shape), seen.not_returned[frame].reshape(shape)
    range_m = seen.range_m[frame].reshape(shape)
    z = np.where(returned, range_m * cosine, 1.0)
    modelled_m = range_m - range_residuals(state.images.phasor, problem.evidence, frame).reshape(shape)
    surface_z = np.where(returned, modelled_m * cosine, 1.0)
    std_m = cosine / np.sqrt(np.where(returned, seen.weight[frame].reshape(shape), 1.0))
    inside, outside = agreeing.reshape(shape) & (coverage > MUST_RETURN_COVERAGE), coverage < MAY_RETURN_COVERAGE
    filled = inside & (coverage >= FILLED_COVERAGE)
    sides = (1, 1), (1, -1), (2, 1), (2, -1)
    counted = np.zeros((3, len(sides), len(coverage)), np.int64)
    # what continues a surface lies this near its tangent plane, noise apart; three times as far from a single pixel
    surface_m = 0.01
    for side, (axis, step) in enumerate(sides):

        def at(values: NDArray[Any], k: int, axis: int = axis, step: int = step) -> NDArray[Any]:
            """Return what is k pixels farther out, where that is in view; elsewhere what is at the border."""
            n = values.shape[axis]
            return np.take(values, np.clip(np.arange(n) + k * step, 0, n - 1), axis=axis)

        has_slope = filled & at(filled, -1)
        rise = np.where(has_slope, 1 / surface_z - 1 / at(surface_z, -1), 0.0)
        for k, first in ((1, at(outside, 1)), (2, at(outside, 2) & ~at(outside, 1))):
            extended = 1 / np.maximum(1 / surface_z + k * rise, 1e-3)
            near = np.where(has_slope, 1, 3) * surface_m + 5 * at(std_m, k)
            pair, back, off = inside & first, at(returned, k), at(z, k) - extended
            ends, continues = pair & (at(absent, k) | (back & (off > near))), pair & back & (np.abs(off) <= near)
            counted[:, side] += np.array([one.sum(axis=(1, 2)) for one in (pair, ends, continues)])
    return counted
