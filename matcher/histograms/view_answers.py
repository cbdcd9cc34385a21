"""From the explanations of one frame of a direct sensor to an answer, accepted or refused for a stated reason."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.information import covariance_of, weak_direction
from phasemark.matcher.match import Candidate, Match, Reason
from phasemark.matcher.pixel_agreement import DISAGREEMENT
from phasemark.render import Background
from phasemark.render.view import VIEW_FIELDS, delta_period_rad, wrap_delta_difference_rad, wrap_delta_rad

_AMBIGUITY = 1e-3
_SIGMA = 3.0
_SAME_M, _SAME_RAD = 2e-3, math.radians(0.5)


class Explanation(NamedTuple):
    """A view of a class that may have made a frame.

    Parameters
    ----------
    class_index : int
    view : (6,) float64
    cost : float
        Whitened squared distance of the frame, or its deviance; what was known before included.
    information : (p, p) float64, or None
        In the free parameters; None of an explanation that was not followed to the end.
    """

    class_index: int
    view: NDArray[np.float64]
    cost: float
    information: NDArray[np.float64] | None


class FitTest(NamedTuple):
    """The test of the best explanation."""

    chi2: float
    dof: int
    p_value: float


@dataclass(frozen=True)
class Rules:
    """Rules by which an answer is accepted.

    Parameters
    ----------
    names : tuple of str
        Classes.
    symmetry : tuple of int
        Of each class.
    false_alarm : float
    tolerance : mapping of str to float
        How far off an accepted answer may be, by parameter.
    systematic : (p, p) float64
        What all frames of the sensor share, added to covariances.
    """

    names: tuple[str, ...]
    symmetry: tuple[int, ...]
    false_alarm: float
    tolerance: Mapping[str, float]
    systematic: NDArray[np.float64]


def answer_of(
    rules: Rules, free: tuple[str, ...], found: Sequence[Explanation], test: FitTest, bare: float, doubt: float,
    background: Background | None = None,
) -> Match:  # fmt: skip
    """Return the answer for one frame.

    Parameters
    ----------
    rules : Rules
    free : tuple of str
    found : sequence of Explanation
        At least one.
    test : FitTest
        Of the best of them.
    bare : float
        Cost of a scene without a landmark.
    doubt : float
        Cost from which the test refuses the best of them: "none" is never less probable than a fit so bad.
    background : Background, optional
        What the best of them has behind the landmark.
    """
    kept = _distinct(rules, sorted(found, key=lambda one: one.cost))
    best = kept[0]
    costs = np.array([*(one.cost for one in kept), min(bare, doubt)])
    weight = np.exp(-0.5 * np.minimum(costs - costs.min(), 1400.0))
    weight /= weight.sum()
    candidates = tuple(_candidate(rules, one, float(w)) for one, w in zip(kept, weight, strict=False))
    of_class = dict.fromkeys(rules.names, 0.0)
    for one in candidates:
        of_class[one.class_name] += one.weight
    assert best.information is not None
    noise = covariance_of(best.information)
    reason = _reason(rules, free, kept, weight[:-1], noise, test, bare)
    covariance = noise + rules.systematic
    condition, weak = weak_direction(free, information=best.information)
    is_landmark = reason != "no landmark"
    first = candidates[0]
    return Match(
        class_name=first.class_name if is_landmark else None,
        accepted=not reason,
        distance_m=first.distance_m,
        delta_rad=first.delta_rad,
        bearing_rad=first.bearing_rad,
        height_m=first.height_m,
        pitch_rad=first.pitch_rad,
        roll_rad=first.roll_rad,
        free=free,
        covariance=covariance if np.isfinite(covariance).all() else None,
        chi2=test.chi2,
        dof=test.dof,
        p_value=test.p_value,
        class_probability={**of_class, "none": float(weight[-1])},
        alternatives=candidates[1:] if is_landmark else candidates,
        symmetry=rules.symmetry[best.class_index],
        condition_number=condition,
        weak_direction=weak,
        background=background,
        reason=reason,
        systematic={"declared": rules.systematic} if rules.systematic.any() else {},
    )


def no_answer(rules: Rules, free: tuple[str, ...]) -> Match:
    """Return the answer for a frame that nothing explains."""
    nothing = {**dict.fromkeys(rules.names, 0.0), "none": 1.0}
    return Match(class_name=None, accepted=False, free=free, class_probability=nothing, reason="no landmark")


def _distinct(rules: Rules, found: Sequence[Explanation]) -> list[Explanation]:
    """Return explanations that differ, the better of two that are the same; `found` is best first."""
    kept: list[tuple[Explanation, list[float]]] = []
    for one in found:
        period, view = delta_period_rad(rules.symmetry[one.class_index]), one.view.tolist()
        if not any(one.class_index == other.class_index and _same(view, seen, period) for other, seen in kept):
            kept.append((one, view))
    return [one for one, _ in kept]


def _same(view: Sequence[float], other: Sequence[float], period: float) -> bool:
    """Return whether two views are the same hill; plain numbers, for a frame compares fifty pairs."""
    apart = [abs(a - b) for a, b in zip(view, other, strict=True)]
    apart[1] = abs(math.remainder(apart[1], period))
    return max(apart[0], apart[3]) < _SAME_M and max(apart[1], apart[2], apart[4], apart[5]) < _SAME_RAD


def _candidate(rules: Rules, one: Explanation, weight: float) -> Candidate:
    distance, delta, bearing, height, pitch, roll = one.view.tolist()
    delta = wrap_delta_rad(delta, delta_period_rad(rules.symmetry[one.class_index])).item()
    name = rules.names[one.class_index]
    return Candidate(name, distance, delta, one.cost, weight, bearing, height, pitch, roll)


def _reason(
    rules: Rules, free: tuple[str, ...], kept: Sequence[Explanation], weight: NDArray[np.float64],
    covariance: NDArray[np.float64], test: FitTest, bare: float,
) -> Reason:  # fmt: skip
    """Return why the best explanation is refused; empty where it is accepted."""
    best = kept[0]
    if not best.cost + DISAGREEMENT < bare:
        return "no landmark"
    if test.p_value < rules.false_alarm:
        return "poor fit"
    if not np.isfinite(covariance).all():
        return "undetermined"
    period = delta_period_rad(rules.symmetry[best.class_index])
    error = _SIGMA * np.sqrt(np.diag(covariance))
    turn = free.index("delta_rad")
    error[turn] = min(error[turn], period / 2)
    if (error > [rules.tolerance[name] for name in free]).any():
        return "undetermined"
    other = np.array([one.class_index != best.class_index for one in kept])
    if weight[other].sum() > _AMBIGUITY * weight.sum():
        return "ambiguous"
    tolerance = np.array([rules.tolerance[name] for name in VIEW_FIELDS])
    for one in kept[1:]:
        if one.class_index != best.class_index or one.cost > best.cost + DISAGREEMENT:
            continue
        apart = np.abs(one.view - best.view)
        apart[1] = abs(float(wrap_delta_difference_rad(apart[1], period)))
        if (apart > tolerance).any():
            return "ambiguous"
    return ""
