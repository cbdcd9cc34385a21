"""The last step: from the fits of each frame to an answer, accepted or refused for a stated reason."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.information import weak_direction
from phasemark.matcher.likelihood.fits import Fits, distinct
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.setup import Setup
from phasemark.matcher.match import Candidate, Match, Reason
from phasemark.matcher.nearest.grid import is_in_range
from phasemark.matcher.pixel_agreement import DISAGREEMENT
from phasemark.render import Background
from phasemark.render.view import delta_period_rad, wrap_delta_difference_rad, wrap_delta_rad

__all__ = ["is_acceptable", "is_determined", "rank"]

_SAME_SIGMA = 3.0
"""Fits of one class nearer to each other than this many standard deviations are of one posterior."""


def rank(
    setup: Setup,
    frames: FilteredFrames,
    fits: Fits,
    bare: NDArray[np.float64],
    backgrounds: Sequence[Background | None],
) -> list[Match]:
    """Return the answer for each frame: the best fit, the others as alternatives, and whether it is accepted.

    Parameters
    ----------
    setup : Setup
    frames : FilteredFrames
        n frames.
    fits : Fits
    bare : (n,) float64
        Cost of a scene without a landmark.
    backgrounds : sequence of Background or None
        What the fits assume behind the landmark of each frame.
    """
    order = np.lexsort((fits.cost, fits.frame))
    first = np.searchsorted(fits.frame[order], np.arange(len(frames) + 1))
    chi2_at_edge = np.asarray(special.chdtri(np.maximum(fits.dof, 1), setup.false_alarm), np.float64)
    answers = []
    for k in range(len(frames)):
        own = order[first[k] : first[k + 1]]
        own = own[np.isfinite(fits.cost[own])]
        answers.append(_answer(setup, fits, own, chi2_at_edge, float(bare[k]), backgrounds[k]))
    return answers


def is_determined(setup: Setup, std: NDArray[np.float64], symmetry: int) -> bool:
    """Return whether every free parameter is known to within its tolerance, three standard deviations.

    The error of δ is at most half a period of the landmark, which no tolerance is below for a body of revolution.
    """
    tolerance = np.array([setup.tolerance[name] for name in setup.free])
    error = setup.policy.tolerated_sigma * std
    turn = setup.free.index("delta_rad")
    error[turn] = min(error[turn], math.pi / symmetry)
    return bool((error <= tolerance).all())


def is_acceptable(setup: Setup, fits: Fits, k: int) -> bool:
    """Return whether a fit would be accepted if nothing else explained its frame."""
    if not fits.stands_out[k] or not fits.p_value[k] >= setup.false_alarm or not _is_in_bank(setup, fits, k):
        return False
    if _explains_too_few(setup, fits, k):
        return False
    return is_determined(setup, fits.std_without_one[k], setup.shapes.symmetry[fits.class_index[k]])


def _explains_too_few(setup: Setup, fits: Fits, k: int) -> bool:
    """Return whether a fit that may leave out returns takes too few of them to place a landmark."""
    return bool((setup.unknown or setup.huber is not None) and fits.explained[k] < setup.fewest_explained)


def _is_in_bank(setup: Setup, fits: Fits, k: int) -> bool:
    """Return whether the view of a fit is in the range of the bank: beyond it no rival is looked for."""
    period = delta_period_rad(setup.shapes.symmetry[fits.class_index[k]])
    return is_in_range(setup.bank.distance_m, setup.bank.delta_rad, fits.view[k], period)


def _answer(
    setup: Setup,
    fits: Fits,
    own: NDArray[np.int64],
    chi2_at_edge: NDArray[np.float64],
    bare: float,
    background: Background | None,
) -> Match:
    """Turn the fits of one frame, best first, into an answer."""
    names = setup.shapes.names
    if not len(own):
        nothing = {**dict.fromkeys(names, 0.0), "none": 1.0}
        return Match(
            class_name=None, accepted=False, free=setup.free, class_probability=nothing, among_unknown=setup.unknown,
            reason="no landmark",
        )  # fmt: skip
    kept = distinct(fits, own, setup.shapes.symmetry)
    best = kept[0]
    # "none" weighs as a fit that just fails a χ² test with the noise as stated, or as a scene without a landmark
    cost_of_unknown = DISAGREEMENT * float(fits.unexplained[best])
    costs = np.append(fits.cost[kept], min(bare, float(chi2_at_edge[best]) + cost_of_unknown))
    log_share = _log_shares(setup, fits, kept)
    weight = _weights(costs - 2 * np.append(log_share, log_share[0]))
    reason = _reason(setup, fits, kept, (weight[:-1], _weights(costs[:-1])), bare)
    candidates = _candidates(setup, fits, kept, weight)
    covariance = fits.covariance[best]
    observed = np.where(np.isfinite(covariance), fits.information[best], np.nan)
    condition, weak = weak_direction(setup.free, information=observed)
    is_landmark = reason != "no landmark"
    return Match(
        class_name=candidates[0].class_name if is_landmark else None,
        accepted=not reason,
        distance_m=candidates[0].distance_m,
        delta_rad=candidates[0].delta_rad,
        bearing_rad=candidates[0].bearing_rad,
        height_m=candidates[0].height_m,
        pitch_rad=candidates[0].pitch_rad,
        roll_rad=candidates[0].roll_rad,
        free=setup.free,
        covariance=covariance.copy() if np.isfinite(covariance).all() else None,
        chi2=float(fits.tested[best]),
        dof=int(fits.dof[best]),
        p_value=float(fits.p_value[best]),
        class_probability=_class_probability(names, candidates, float(weight[-1])),
        alternatives=candidates[1:] if is_landmark else candidates,
        symmetry=setup.shapes.symmetry[fits.class_index[best]],
        condition_number=condition,
        weak_direction=weak,
        background=background,
        among_unknown=setup.unknown,
        reason=reason,
    )


def _weights(costs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the shares of explanations, by exp(−cost / 2)."""
    weight = np.exp(-0.5 * np.minimum(costs - costs.min(), 1400.0))
    return np.asarray(weight / weight.sum())


def _log_shares(setup: Setup, fits: Fits, kept: list[int]) -> NDArray[np.float64]:
    """Return the logarithms of the shares of all views that the posterior around some fits of one frame fills, (k,).

    By Laplace's approximation it is (2π)^(p/2) / √det(2π + R I R), with the information I and the ranges R that the
    parameters have before a frame is seen: the bank's distances, the class's period of δ, one metre, one radian. A fit
    within three standard deviations of a better one of its class is part of that: its share is 0.
    """
    shapes, classes, turn = setup.shapes, fits.class_index[kept], setup.free.index("delta_rad")
    periods = np.array([delta_period_rad(shapes.symmetry[c]) for c in classes])
    ranges = np.ones((len(kept), len(setup.free)))
    ranges[:, setup.free.index("distance_m")] = np.ptp(setup.bank.distance_m) or 1.0
    ranges[:, turn] = periods
    information = np.nan_to_num(fits.information[kept], posinf=0.0, neginf=0.0)
    in_ranges = information * ranges[:, :, None] * ranges[:, None] / (2 * np.pi)
    shares = -0.5 * np.log1p(np.maximum(np.linalg.eigvalsh(in_ranges), 0.0)).sum(axis=1)
    views = fits.view[kept][:, [VIEW.index(name) for name in setup.free]]
    for k in range(1, len(kept)):
        better = np.flatnonzero((classes[:k] == classes[k]) & np.isfinite(shares[:k]))
        off = views[k] - views[better]
        off[:, turn] = wrap_delta_difference_rad(off[:, turn], periods[k])
        if (np.einsum("jp,jpq,jq->j", off, information[better], off) < _SAME_SIGMA**2).any():
            shares[k] = -np.inf
    return np.asarray(shares)


def _candidates(setup: Setup, fits: Fits, kept: list[int], weight: NDArray[np.float64]) -> tuple[Candidate, ...]:
    """Return some fits of one frame as explanations, δ within the landmark's period."""
    shapes, classes = setup.shapes, fits.class_index[kept].tolist()
    view = fits.view[kept]
    view[:, 1] = wrap_delta_rad(view[:, 1], [delta_period_rad(shapes.symmetry[c]) for c in classes])
    rows = zip(classes, view.tolist(), fits.cost[kept].tolist(), weight.tolist(), strict=False)
    return tuple(
        Candidate(shapes.names[c], distance, delta, cost, share, bearing, height, pitch, roll)
        for c, (distance, delta, bearing, height, pitch, roll), cost, share in rows
    )


def _class_probability(names: Sequence[str], candidates: Sequence[Candidate], none: float) -> dict[str, float]:
    """Return the probability of each class, in the order of the bank, and of "none"."""
    of_class = {candidate.class_name: 0.0 for candidate in candidates}
    for candidate in candidates:
        of_class[candidate.class_name] += candidate.weight
    return {**dict.fromkeys(names, 0.0), **of_class, "none": none}


def _reason(setup: Setup, fits: Fits, kept: list[int], weights: Sequence[NDArray[np.float64]], bare: float) -> Reason:
    """Return why the best fit of a frame is refused; empty where it is accepted."""
    best = kept[0]
    if not fits.capped[best] < bare:
        return "no landmark"
    if fits.p_value[best] < setup.false_alarm or not fits.stands_out[best]:
        return "poor fit"
    if _explains_too_few(setup, fits, best):
        return "undetermined"
    symmetry = setup.shapes.symmetry[fits.class_index[best]]
    if not is_determined(setup, fits.std_without_one[best], symmetry):
        return "undetermined"
    if not _is_in_bank(setup, fits, best):
        return "outside the bank"
    return "ambiguous" if _is_ambiguous(setup, fits, kept, weights) else ""


def _is_ambiguous(setup: Setup, fits: Fits, kept: list[int], weights: Sequence[NDArray[np.float64]]) -> bool:
    """Return whether other classes, or views beyond the tolerance, are too probable; `kept` is best first.

    Classes are weighed with the share of all views that look so, and without it: who looks at one view alone, and at
    no others, sees its rivals more often than one in a thousand.
    """
    policy, best = setup.policy, kept[0]
    other = fits.class_index[kept] != fits.class_index[best]
    if any(weight[other].sum() > policy.ambiguity * weight.sum() for weight in weights):
        return True
    # where a landmark looks alike from two sides, a single pixel at an edge must not decide between them
    alike = np.flatnonzero(~other & (fits.cost[kept] < fits.cost[best] + setup.rival_cost))
    if len(alike) < 2:
        return False
    near = np.array(kept)[alike]
    apart = np.abs(fits.view[near] - fits.view[best])
    period = delta_period_rad(setup.shapes.symmetry[fits.class_index[best]])
    apart[:, 1] = np.abs(wrap_delta_difference_rad(apart[:, 1], period))
    own = [VIEW.index(name) for name in setup.free]
    std = np.sqrt(np.nan_to_num(np.einsum("kpp->kp", fits.covariance[near]), posinf=0.0))
    apart[1:, own] += policy.tolerated_sigma * std[1:]  # the truth may be on the far side of the other view
    apart[:, 1] = np.minimum(apart[:, 1], period / 2)
    return bool((apart > [setup.tolerance[name] for name in VIEW]).any())
