"""The last step: from the fits of each frame to an answer, accepted or refused for a stated reason.

One rule for every kind of evidence: ranges, phasors, ranges as a chip reports them, histograms and targets.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phasemark.data import Bank
from phasemark.matcher.estimate.fits import Fits, distinct
from phasemark.matcher.information import weak_direction
from phasemark.matcher.match import TOLERATED_SIGMA, Candidate, Match, Reason
from phasemark.matcher.nearest.grid import is_in_range
from phasemark.matcher.pixel_agreement import DISAGREEMENT
from phasemark.render import Background
from phasemark.render.view import VIEW_FIELDS, delta_period_rad, wrap_delta_difference_rad, wrap_delta_rad

__all__ = [
    "Rules",
    "answer_of",
    "is_acceptable",
    "is_in_bank",
    "no_answer",
    "rank",
    "with_part",
    "with_parts",
]


@dataclass(frozen=True, eq=False)
class Rules:
    """Rules by which an answer is accepted.

    Parameters
    ----------
    names : tuple of str
        Classes of the bank, in its order.
    symmetry : tuple of int
        Of each class: rotations within a turn that the bank takes for one.
    distance_m, delta_rad : float64
        Grid of the bank, beyond which no rival is looked for.
    free : tuple of str
        Parameters of the view.
    false_alarm : float
    tolerance : mapping of str to float
        How far off an accepted answer may be, by parameter of the view.
    among_unknown : bool
        Whether other things might stand in view.
    rival_cost : float
        How much more than an answer a view far from it must cost: a single pixel must not decide between them.
    fewest_explained : int
        Returns that an answer must explain, where a fit may leave some out.
    widest_rad : float
        Bearing beyond which no rival is looked for.
    """

    names: tuple[str, ...]
    symmetry: tuple[int, ...]
    distance_m: NDArray[np.float64]
    delta_rad: NDArray[np.float64]
    free: tuple[str, ...]
    false_alarm: float
    tolerance: Mapping[str, float]
    among_unknown: bool = False
    rival_cost: float = DISAGREEMENT
    fewest_explained: int = 0
    widest_rad: float = math.inf

    @classmethod
    def of_bank(
        cls, bank: Bank, free: tuple[str, ...], false_alarm: float, tolerance_m: float, tolerance_rad: float
    ) -> Rules:
        """Return the usual rules for answers of a bank."""
        tolerance = {name: tolerance_m if name.endswith("_m") else tolerance_rad for name in VIEW_FIELDS}
        symmetry = tuple(int(bank.mesh(name).metadata["symmetry"]) for name in bank.classes)
        return cls(tuple(bank.classes), symmetry, bank.distance_m, bank.delta_rad, free, false_alarm, tolerance)


def rank(
    rules: Rules,
    fits: Fits,
    doubt: NDArray[np.float64],
    bare: NDArray[np.float64],
    backgrounds: Sequence[Background | None],
) -> list[Match]:
    """Return the answer for each frame: the best fit, the others as alternatives, and whether it is accepted.

    Parameters
    ----------
    rules : Rules
    fits : Fits
        Of n frames.
    doubt : (m,) float64
        Cost from which the test of each fit would refuse it.
    bare : (n,) float64
        Cost of a scene without a landmark.
    backgrounds : sequence of Background or None
        What the fits assume behind the landmark of each frame.
    """
    order = np.lexsort((fits.cost, fits.frame))
    first = np.searchsorted(fits.frame[order], np.arange(len(bare) + 1))
    answers = []
    for k, background in enumerate(backgrounds):
        own = order[first[k] : first[k + 1]]
        own = own[np.isfinite(fits.cost[own])]
        answers.append(answer_of(rules, fits, own, doubt, float(bare[k]), background))
    return answers


def _is_determined(rules: Rules, std: NDArray[np.float64], symmetry: int) -> bool:
    """Return whether every free parameter is known to within its tolerance, three standard deviations.

    The error of δ is at most half a period of the landmark, which no tolerance is below for a body of revolution.
    """
    tolerance = np.array([rules.tolerance[name] for name in rules.free])
    error = TOLERATED_SIGMA * std
    turn = rules.free.index("delta_rad")
    error[turn] = min(error[turn], math.pi / symmetry)
    return bool((error <= tolerance).all())


def is_acceptable(rules: Rules, fits: Fits, k: int) -> bool:
    """Return whether a fit would be accepted if nothing else explained its frame."""
    if not fits.stands_out[k] or not fits.p_value[k] >= rules.false_alarm or not is_in_bank(rules, fits, k):
        return False
    if _explains_too_few(rules, fits, k):
        return False
    return _is_determined(rules, fits.std_without_one[k], rules.symmetry[fits.class_index[k]])


def _explains_too_few(rules: Rules, fits: Fits, k: int) -> bool:
    """Return whether a fit that may leave out returns takes too few of them to place a landmark."""
    return bool(fits.explained[k] < rules.fewest_explained)


def is_in_bank(rules: Rules, fits: Fits, k: int) -> bool:
    """Return whether the view of a fit is where rivals are looked for: in the range of the bank and of bearings."""
    if abs(fits.view[k, VIEW_FIELDS.index("bearing_rad")]) > rules.widest_rad:
        return False
    period = delta_period_rad(rules.symmetry[fits.class_index[k]])
    return is_in_range(rules.distance_m, rules.delta_rad, fits.view[k], period)


def no_answer(rules: Rules) -> Match:
    """Return the answer for a frame that nothing explains."""
    return Match(
        class_name=None,
        accepted=False,
        free=rules.free,
        class_probability={**dict.fromkeys(rules.names, 0.0), "none": 1.0},
        among_unknown=rules.among_unknown,
        reason="no landmark",
    )


def answer_of(
    rules: Rules,
    fits: Fits,
    own: NDArray[np.int64],
    doubt: NDArray[np.float64],
    bare: float,
    background: Background | None,
) -> Match:
    """Turn the fits of one frame into an answer.

    Parameters
    ----------
    rules : Rules
    fits : Fits
    own : (k,) int64
        Those of the frame, best first.
    doubt : (m,) float64
        Cost from which the test of each fit would refuse it: "none" is never less probable than a fit so bad.
    bare : float
        Cost of a scene without a landmark.
    background : Background, optional
        What the fits assume behind the landmark.
    """
    if not len(own):
        return no_answer(rules)
    kept = distinct(fits, own, rules.symmetry)
    best = kept[0]
    costs = np.append(fits.cost[kept], min(bare, float(doubt[best])))
    log_share = _log_shares(rules, fits, kept)
    weight = _weights(costs - 2 * np.append(log_share, log_share[0]))
    reason = _reason(rules, fits, kept, (weight[:-1], _weights(costs[:-1])), bare)
    candidates = _candidates(rules, fits, kept, weight)
    covariance = fits.covariance[best]
    observed = np.where(np.isfinite(covariance), fits.information[best], np.nan)
    condition, weak = weak_direction(rules.free, information=observed)
    is_landmark = reason != "no landmark"
    return Match(
        class_name=candidates[0].class_name if is_landmark else None,
        accepted=not reason,
        **{name: getattr(candidates[0], name) for name in VIEW_FIELDS},
        free=rules.free,
        covariance=covariance.copy() if np.isfinite(covariance).all() else None,
        chi2=float(fits.tested[best]),
        dof=int(fits.dof[best]),
        p_value=float(fits.p_value[best]),
        class_probability=_class_probability(rules.names, candidates, float(weight[-1])),
        alternatives=candidates[1:] if is_landmark else candidates,
        symmetry=rules.symmetry[fits.class_index[best]],
        condition_number=condition,
        weak_direction=weak,
        background=background,
        among_unknown=rules.among_unknown,
        reason=reason,
    )


def _weights(costs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the shares of explanations, by exp(−cost / 2)."""
    weight = np.exp(-0.5 * np.minimum(costs - costs.min(), 1400.0))
    return np.asarray(weight / weight.sum())


def _log_shares(rules: Rules, fits: Fits, kept: list[int]) -> NDArray[np.float64]:
    """Return the logarithms of the shares of all views that the posterior around some fits of one frame fills, (k,).

    By Laplace's approximation it is (2π)^(p/2) / √det(2π + R I R), with the information I and the ranges R that the
    parameters have before a frame is seen: the bank's distances, the class's period of δ, one metre, one radian. A fit
    within three standard deviations of a better one of its class is part of that: its share is 0.
    """
    classes, turn = fits.class_index[kept], rules.free.index("delta_rad")
    periods = np.array([delta_period_rad(rules.symmetry[c]) for c in classes])
    ranges = np.ones((len(kept), len(rules.free)))
    ranges[:, rules.free.index("distance_m")] = np.ptp(rules.distance_m) or 1.0
    ranges[:, turn] = periods
    information = np.nan_to_num(fits.information[kept], posinf=0.0, neginf=0.0)
    in_ranges = information * ranges[:, :, None] * ranges[:, None] / (2 * np.pi)
    shares = -0.5 * np.log1p(np.maximum(np.linalg.eigvalsh(in_ranges), 0.0)).sum(axis=1)
    views = fits.view[kept][:, [VIEW_FIELDS.index(name) for name in rules.free]]
    same_sigma = 3.0  # fits of one class nearer to each other than this many standard deviations are of one posterior
    for k in range(1, len(kept)):
        better = np.flatnonzero((classes[:k] == classes[k]) & np.isfinite(shares[:k]))
        off = views[k] - views[better]
        off[:, turn] = wrap_delta_difference_rad(off[:, turn], periods[k])
        if (np.einsum("jp,jpq,jq->j", off, information[better], off) < same_sigma**2).any():
            shares[k] = -np.inf
    return np.asarray(shares)


def _candidates(rules: Rules, fits: Fits, kept: list[int], weight: NDArray[np.float64]) -> tuple[Candidate, ...]:
    """Return some fits of one frame as explanations, δ within the landmark's period."""
    classes = fits.class_index[kept].tolist()
    view = fits.view[kept]
    view[:, 1] = wrap_delta_rad(view[:, 1], [delta_period_rad(rules.symmetry[c]) for c in classes])
    rows = zip(classes, view.tolist(), fits.cost[kept].tolist(), weight.tolist(), strict=False)
    return tuple(
        Candidate(rules.names[c], distance, delta, cost, share, bearing, height, pitch, roll)
        for c, (distance, delta, bearing, height, pitch, roll), cost, share in rows
    )


def _class_probability(names: Sequence[str], candidates: Sequence[Candidate], none: float) -> dict[str, float]:
    """Return the probability of each class, in the order of the bank, and of "none"."""
    of_class = {candidate.class_name: 0.0 for candidate in candidates}
    for candidate in candidates:
        of_class[candidate.class_name] += candidate.weight
    return {**dict.fromkeys(names, 0.0), **of_class, "none": none}


def _reason(rules: Rules, fits: Fits, kept: list[int], weights: Sequence[NDArray[np.float64]], bare: float) -> Reason:
    """Return why the best fit of a frame is refused; empty where it is accepted."""
    best = kept[0]
    if not fits.capped[best] < bare:
        return "no landmark"
    if fits.p_value[best] < rules.false_alarm or not fits.stands_out[best]:
        return "poor fit"
    if _explains_too_few(rules, fits, best):
        return "undetermined"
    symmetry = rules.symmetry[fits.class_index[best]]
    if not _is_determined(rules, fits.std_without_one[best], symmetry):
        return "undetermined"
    if not is_in_bank(rules, fits, best):
        return "outside the bank"
    return "ambiguous" if _is_ambiguous(rules, fits, kept, weights) else ""


def _is_ambiguous(rules: Rules, fits: Fits, kept: list[int], weights: Sequence[NDArray[np.float64]]) -> bool:
    """Return whether other classes, or views beyond the tolerance, are too probable; `kept` is best first.

    Classes are weighed with the share of all views that look so, and without it: who looks at one view alone, and at
    no others, sees its rivals more often than one in a thousand.
    """
    best = kept[0]
    other = fits.class_index[kept] != fits.class_index[best]
    ambiguity = 1e-3  # largest probability that an accepted answer leaves to other classes
    if any(weight[other].sum() > ambiguity * weight.sum() for weight in weights):
        return True
    # where a landmark looks alike from two sides, a single pixel at an edge must not decide between them
    alike = np.flatnonzero(~other & (fits.cost[kept] < fits.cost[best] + rules.rival_cost))
    if len(alike) < 2:
        return False
    near = np.array(kept)[alike]
    apart = np.abs(fits.view[near] - fits.view[best])
    period = delta_period_rad(rules.symmetry[fits.class_index[best]])
    apart[:, 1] = np.abs(wrap_delta_difference_rad(apart[:, 1], period))
    own = [VIEW_FIELDS.index(name) for name in rules.free]
    std = np.sqrt(np.nan_to_num(np.einsum("kpp->kp", fits.covariance[near]), posinf=0.0))
    apart[1:, own] += TOLERATED_SIGMA * std[1:]  # the truth may be on the far side of the other view
    apart[:, 1] = np.minimum(apart[:, 1], period / 2)
    return bool((apart > [rules.tolerance[name] for name in VIEW_FIELDS]).any())


def with_parts(rules: Rules, match: Match, parts: Mapping[str, NDArray[np.float64]]) -> Match:
    """Return a match whose covariance holds further parts; refused if they leave it undetermined."""
    for name, part in parts.items():
        match = with_part(match, name, part)
    if match.covariance is None:
        return match
    reason = match.reason
    if not reason and not _is_determined(rules, np.sqrt(np.diag(match.covariance)), match.symmetry):
        reason = "undetermined"
    return replace(match, reason=reason, accepted=not reason)


def with_part(match: Match, name: str, part: NDArray[np.float64]) -> Match:
    """Return a match whose covariance, if it has one, holds a further part."""
    if match.covariance is None:
        return match
    return replace(match, covariance=match.covariance + part, systematic={**match.systematic, name: part})
