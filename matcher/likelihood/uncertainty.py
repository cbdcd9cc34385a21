"""Uncertainty of a solution: its covariance, the slopes behind it, and the contributions of single pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.problem import ALBEDO_COLUMN, Problem, State
from phasemark.matcher.likelihood.residuals import Sums, range_residuals, range_slopes, robust_weight

_SLOPE_WIDTH = 0.05
"""Least half width, in natural units, over which final slopes are differenced, so that a kink narrower than this does
not make the covariance."""
_LEAST_LEFT, _NOTHING_LEFT = 1e-2, 1e-12
"""Least shares of a residual that a fit leaves: below the first it shows no error of its pixel, and below the other the
pixel alone tells a direction."""
_SHARE_WITHOUT_ONE = 2 / 3


def view_covariance(problem: Problem, state: State) -> NDArray[np.float64]:
    """Return the covariances of views, (m, p, p): inverse information, with a robust loss the jackknife's.

    The jackknife (HC3 of MacKinnon & White, J. Econometrics 29, 1985) adds up by how much the view moves without each
    of the pixels. It asks nothing of the noise, and the residuals of a few pixels, which a fit makes small, do not
    make it small.
    """
    p = len(problem.settings.free)
    covariance = covariance_of(state.sums.information, problem.scale)
    if problem.settings.huber is not None:
        pixels = _influences(problem, state, covariance)
        shift = np.einsum("kaqr,kqrs,kqs->kaq", pixels.moved, pixels.inverse_left(_LEAST_LEFT), pixels.residual)
        of_prior = covariance * problem.prior_weight
        covariance = shift @ shift.transpose(0, 2, 1) + of_prior @ covariance
    return np.ascontiguousarray(covariance[:, :p, :p])


class _Influences(NamedTuple):
    """Influence of single pixels on solutions.

    Parameters
    ----------
    moved : (m, p, pixels, 1 or 2) float64
        By how much a residual of one standard deviation moves the parameters.
    left : (m, pixels, 1 or 2, 1 or 2) float64
        Share of a residual that a fit leaves: the unit matrix less the leverage.
    residual : (m, pixels, 1 or 2) float64
        In standard deviations, with the weight of the robust loss.
    """

    moved: NDArray[np.float64]
    left: NDArray[np.float64]
    residual: NDArray[np.float64]

    def inverse_left(self, least: float) -> NDArray[np.float64]:
        """Return the inverse of what is left, of pixels that leave less than a share `least` in any direction of it."""
        left = self.left
        if left.shape[-1] == 1:
            return 1 / np.maximum(left, least)
        values, vectors = np.linalg.eigh(left)
        return np.asarray((vectors / np.maximum(values, least)[..., None, :]) @ vectors.swapaxes(-1, -2))


def _influences(problem: Problem, state: State, inverse: NDArray[np.float64]) -> _Influences:
    """Return the influence of single pixels on solutions of a known inverse information, (m, p, p)."""
    phasor, weight = state.images.phasor, problem.evidence.weight[problem.frame]
    use = state.use & problem.settings.used & (weight > 0) & (phasor != 0)
    slope = state.images.slope
    if problem.evidence.on == "ranges":
        rows = range_slopes(phasor, slope, problem.evidence.sensor)[..., None]
        residual = range_residuals(phasor, problem.evidence, problem.frame)[..., None]
    else:
        difference = problem.evidence.value[problem.frame] - phasor
        rows = np.stack([slope.real, slope.imag], axis=-1)
        residual = np.stack([difference.real, difference.imag], axis=-1)
    root = np.sqrt(robust_weight(residual, (weight * use)[..., None], problem.settings.huber))
    rows = rows * root[:, None]
    moved = np.einsum("kab,kbqr->kaqr", inverse, rows)
    return _Influences(moved, np.eye(rows.shape[3]) - np.einsum("kaqr,kaqs->kqrs", rows, moved), residual * root)


def capped_std(problem: Problem, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return standard deviations, (m, p), one natural unit where they are larger or unknown."""
    p = covariance.shape[1]
    variance = np.einsum("mpp->mp", covariance)
    std = np.sqrt(np.where(np.isfinite(variance) & (variance >= 0), variance, np.inf))
    return np.asarray(np.minimum(std, problem.scale[:p]))


def capped_axes(problem: Problem, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the axes of covariances as columns, (m, p, p), one standard deviation long.

    None is longer than a natural unit; where a covariance is unknown, they are the units themselves.
    """
    std, vectors = _axes(problem, covariance)
    return np.asarray(vectors * np.minimum(std, 1.0)[:, None, :] * problem.scale[: covariance.shape[1], None])


def _axes(problem: Problem, covariance: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return standard deviations along the axes of covariances, and these, in natural units; units where unknown."""
    p = covariance.shape[1]
    scaled = covariance / np.outer(problem.scale, problem.scale)[:p, :p]
    known = np.asarray(np.isfinite(scaled).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(known[:, None, None], scaled, np.eye(p)))
    return np.sqrt(np.maximum(values, 0.0)), vectors


def slopes_around(
    problem: Problem, state: State, which: NDArray[np.integer], std: NDArray[np.float64]
) -> NDArray[np.complex128] | None:
    """Return slopes over half a standard deviation to either side, (m, p, pixels): what a kink nearby averages to.

    None where the model is smooth.
    """
    view = np.ascontiguousarray(state.theta[which, :ALBEDO_COLUMN])
    step = np.maximum(0.5 * std, _SLOPE_WIDTH * problem.scale[: std.shape[1]])
    slope = problem.at_brightness(
        state.theta[which, ALBEDO_COLUMN],
        lambda model: model.wide_slopes(problem.class_index, view, problem.settings.free, step),
    )
    if slope is None:
        return None
    if problem.evidence.on == "ranges":
        # ignore pixels that are lit at one end of the step only: their phase slope is meaningless
        phasor = np.abs(state.images.phasor[which])[:, None]
        slope = np.where(np.abs(slope) * step[:, :, None] > phasor, 0.0, slope)
    return np.concatenate([slope, state.images.slope[which, slope.shape[1] :]], axis=1)


def slopes_along_axes(
    problem: Problem, state: State, which: NDArray[np.integer], covariance: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Return slopes over half a standard deviation to either side along the axes of covariances, (m, p, pixels).

    A height and a pitch nearly cancel. Separate differences average over different kinks and overstate the
    information in the combination.
    """
    p = covariance.shape[1]
    scale, (std, vectors) = problem.scale[:p], _axes(problem, covariance)
    length = np.clip(0.5 * std, _SLOPE_WIDTH, 1.0)
    moves = np.zeros((len(which), p, len(VIEW)))
    moves[:, :, problem.columns[:p]] = (vectors * length[:, None]).transpose(0, 2, 1) * scale
    view = np.ascontiguousarray(state.theta[which, :ALBEDO_COLUMN])
    factor = state.theta[which, ALBEDO_COLUMN]
    change = problem.at_brightness(factor, lambda model: model.differences(problem.class_index, view, moves))
    assert change is not None
    if problem.evidence.on == "ranges":
        change = np.where(np.abs(change) > np.abs(state.images.phasor[which])[:, None], 0.0, change)
    # along the axes: slope · axis = change
    slope = np.asarray(np.einsum("mik,mkq->miq", vectors / length[:, None], change) / scale[:, None])
    return np.concatenate([slope, state.images.slope[which, p:]], axis=1)


def step_of_others(
    problem: Problem, sums: Sums, held: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return Gauss–Newton's steps that are nothing along a vector each, `held` (m, p), and the promised falls, (m,)."""
    unit = problem.scale
    normal = held * unit / np.linalg.norm(held * unit, axis=1)[:, None]
    others = np.eye(normal.shape[1]) - normal[:, :, None] * normal[:, None, :]
    information = others @ (sums.information * np.outer(unit, unit)) @ others
    gradient = np.einsum("mpq,mq->mp", others, sums.gradient * unit)
    step = np.einsum("mpq,mq->mp", np.linalg.pinv(information, hermitian=True), gradient)
    return step * unit, np.einsum("mp,mp->m", gradient, step)


def std_without_one_pixel(problem: Problem, state: State, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest standard deviations without any one pixel, (m, p), by the Woodbury formula.

    The formula holds for the inverse information. A jackknife grows by the same ratio; but it has counted already what
    each pixel does, and two standard deviations without one are compared with three of it.
    """
    p = covariance.shape[1]
    inverse = covariance_of(state.sums.information, problem.scale)
    pixels = _influences(problem, state, inverse)
    moved = pixels.moved[:, :p]
    # a pixel that alone tells a direction leaves nothing known of it
    more = np.einsum("kaqr,kqrs,kaqs->kaq", moved, pixels.inverse_left(_NOTHING_LEFT), moved).max(axis=2)
    own = np.einsum("kaa->ka", inverse)[:, :p]
    growth = np.sqrt((own + more) / own)
    if problem.settings.huber is not None:
        growth = np.maximum(growth * _SHARE_WITHOUT_ONE, 1.0)
    return np.asarray(np.sqrt(np.einsum("kaa->ka", covariance)) * growth)
