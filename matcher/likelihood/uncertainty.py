"""Uncertainty of a solution: its covariance, the slopes behind it, and the contributions of single pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.problem import ALBEDO_COLUMN, Problem, State
from phasemark.matcher.likelihood.residuals import Sums, range_residuals, robust_weight

_SLOPE_WIDTH = 0.05
"""Least half width, in natural units, over which final slopes are differenced, so that a kink narrower than this does
not make the covariance."""


def view_covariance(problem: Problem, sums: Sums) -> NDArray[np.float64]:
    """Return the covariance of the view, (m, p, p): inverse information, or the sandwich."""
    p = len(problem.settings.free)
    covariance = covariance_of(sums.information, problem.scale)
    if problem.settings.huber is not None:
        covariance = covariance @ sums.scatter @ covariance
    return np.ascontiguousarray(covariance[:, :p, :p])


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
    p = covariance.shape[1]
    scaled = covariance / np.outer(problem.scale, problem.scale)[:p, :p]
    known = np.asarray(np.isfinite(scaled).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(known[:, None, None], scaled, np.eye(p)))
    length = np.minimum(np.sqrt(np.maximum(values, 0.0)), 1.0)
    return np.asarray(vectors * length[:, None, :] * problem.scale[:p, None])


def slopes_around(
    problem: Problem, state: State, which: NDArray[np.integer], std: NDArray[np.float64]
) -> NDArray[np.complex128] | None:
    """Return slopes over half a standard deviation to either side, (m, p, pixels): what a kink nearby averages to.

    None where the model is smooth.
    """
    view = np.ascontiguousarray(state.theta[which, :ALBEDO_COLUMN])
    step = np.maximum(0.5 * std, _SLOPE_WIDTH * problem.scale[: std.shape[1]])
    if not problem.with_albedo:
        slope = problem.model.wide_slopes(problem.class_index, view, problem.settings.free, step)
        if slope is None:
            return None
        # light that comes and goes within the step has no phase whose slope could tell anything
        phasor = np.abs(state.images.phasor[which])[:, None]
        return np.where(np.abs(slope) * step[:, :, None] > phasor, 0.0, slope)
    by_view = problem.at_brightness(
        state.theta[which, ALBEDO_COLUMN],
        lambda model: model.wide_slopes(problem.class_index, view, problem.settings.free, step),
    )
    return None if by_view is None else np.concatenate([by_view, state.images.slope[which, -1:]], axis=1)


def slopes_along_axes(
    problem: Problem, state: State, which: NDArray[np.integer], covariance: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Return slopes over half a standard deviation to either side along the axes of covariances, (m, p, pixels).

    A height and a pitch nearly cancel. Differences along each of them alone would average over different kinks, and
    leave of their sum more than there is: information about what hardly changes the image.
    """
    p = covariance.shape[1]
    scale = problem.scale[:p]
    scaled = covariance / np.outer(scale, scale)
    known = np.asarray(np.isfinite(scaled).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(known[:, None, None], scaled, np.eye(p)))
    length = np.clip(0.5 * np.sqrt(np.maximum(values, 0.0)), _SLOPE_WIDTH, 1.0)
    moves = np.zeros((len(which), p, len(VIEW)))
    moves[:, :, problem.columns[:p]] = (vectors * length[:, None]).transpose(0, 2, 1) * scale
    view = np.ascontiguousarray(state.theta[which, :ALBEDO_COLUMN])
    factor = state.theta[which, ALBEDO_COLUMN]
    change = problem.at_brightness(factor, lambda model: model.differences(problem.class_index, view, moves))
    assert change is not None
    if not problem.with_albedo:
        change = np.where(np.abs(change) > np.abs(state.images.phasor[which])[:, None], 0.0, change)
    # along the axes: slope · axis = change
    slope = np.asarray(np.einsum("mik,mkq->miq", vectors / length[:, None], change) / scale[:, None])
    if not problem.with_albedo:
        return slope
    return np.concatenate([slope, state.images.slope[which, -1:]], axis=1)


def std_without_one_pixel(
    problem: Problem,
    state: State,
    which: NDArray[np.integer],
    slope: NDArray[np.complex128],
    information: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the largest standard deviations without any one pixel, (k, p), by the Woodbury formula.

    The formula holds for the inverse information. A sandwich covariance grows by the same ratio.
    """
    p = covariance.shape[1]
    phasor, weight = state.images.phasor[which], problem.evidence.weight[problem.frame]
    use = state.use[which] & problem.settings.used & (weight > 0) & (phasor != 0)
    turn = np.divide(1.0, phasor, out=np.zeros_like(phasor), where=use)
    value = problem.evidence.value[problem.frame]
    if problem.evidence.on == "ranges":
        rows = problem.evidence.sensor.metres_per_radian * (slope * turn[:, None]).imag[..., None]
        residual = range_residuals(phasor, problem.evidence, problem.frame)[..., None]
    else:
        rows = np.stack([slope.real, slope.imag], axis=-1)
        residual = np.stack([(value - phasor).real, (value - phasor).imag], axis=-1)
    root = np.sqrt(robust_weight(residual, (weight * use)[..., None], problem.settings.huber))
    rows = rows * root[:, None]  # (k, p, pixels, 1 or 2)
    inverse = covariance_of(information, problem.scale)
    moved = np.einsum("kab,kbqr->kaqr", inverse, rows)
    kept = (1 + 1e-12) * np.eye(rows.shape[3]) - np.einsum("kaqr,kaqs->kqrs", rows, moved)
    # a pixel that alone tells a direction leaves nothing known of it
    determinant = kept[..., 0, 0]
    if kept.shape[-1] == 2:
        determinant = determinant * kept[..., 1, 1] - kept[..., 0, 1] * kept[..., 1, 0]
    kept[~(determinant > 1e-14)] = 1e-12 * np.eye(rows.shape[3])
    moved = moved[:, :p]
    more = np.einsum("kaqr,kqrs,kaqs->kaq", moved, np.linalg.inv(kept), moved).max(axis=2)
    own = np.einsum("kaa->ka", inverse)[:, :p]
    return np.asarray(np.sqrt(np.einsum("kaa->ka", covariance) * (own + more) / own))
