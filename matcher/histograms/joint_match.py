"""Class and view of one landmark from histograms of several poses together, by the likelihood of all frames."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.matcher.estimate.acceptance import Rules, no_answer
from phasemark.matcher.histograms.exact_fit import Counted, Fit, fit_view, search_of
from phasemark.matcher.histograms.joint_models import JointModel, view_in_first, views_from
from phasemark.matcher.histograms.poisson_fit import deviance_of, deviance_test, doubtful_deviance, moments_of
from phasemark.matcher.histograms.scene_models import scene_at
from phasemark.matcher.histograms.search_plan import LandmarkSearch, SearchPlan, Start
from phasemark.matcher.histograms.view_answers import Explanation, FitTest, answer_from
from phasemark.matcher.match import Match
from phasemark.render import Views
from phasemark.render.view import VIEW_FIELDS

_SCENES = 8
_SURE_COST = 40.0
_OF_CLASS = 4
"""Starts of each class that are followed to the end."""
_SAME_M, _SAME_RAD = 0.02, math.radians(5.0)
_OWN = VIEW_FIELDS[:3]
_NEAR = np.array([0.05, *[math.radians(15.0)] * 2, 0.0, 0.0, 0.0])
"""What a frame by itself may have otherwise than all frames together, and how far."""
_TESTS = 3


def match_together(
    search: LandmarkSearch, plan: SearchPlan, rules: Rules, frames: Sequence[Counted],
    starts: Sequence[Sequence[Start]], bare: float, first2camera: NDArray[np.float64],
) -> Match:  # fmt: skip
    """Return the answer that all frames give together, its view as the first camera has it.

    Parameters
    ----------
    search : LandmarkSearch
        The models of its classes.
    plan : SearchPlan
    rules : Rules
    frames : sequence of Counted
    starts : sequence of sequence of Start
        Hills of the likelihood of each frame by itself.
    bare : float
        Cost of all frames without a landmark.
    first2camera : (n, 4, 4) float64
    """
    begin = _begin(plan, starts, first2camera, len(rules.names))
    if not begin:
        return no_answer(rules)
    joint = joined(frames)
    models = [JointModel([search.model(c)] * len(frames), first2camera) for c in range(len(rules.names))]
    tried = search_of(plan.free, plan.prior_std, plan.limits, 1, models[0].nuisances)
    whole = tried._replace(most=_SCENES)
    first: list[tuple[float, Start]] = []
    for start in begin:
        scene = scene_at(models[start.class_index], plan.free)
        fit = fit_view(scene, joint, start.state, start.bright, start.ambient, tried, math.inf)
        if fit is not None:
            moved = start._replace(state=fit.state, bright=fit.bright, ambient=fit.ambient)
            first.append((fit.cost, moved))
    first.sort(key=lambda pair: pair[0])
    fits: list[tuple[int, Fit]] = []
    for c in range(len(rules.names)):
        of_class = [start for _, start in first if start.class_index == c]
        for start in of_class[:_OF_CLASS]:
            hopeless = min((fit.cost for _, fit in fits), default=math.inf) + _SURE_COST
            known = [fit.view for other, fit in fits if other == c]
            scene = scene_at(models[c], plan.free)
            fit = fit_view(scene, joint, start.state, start.bright, start.ambient, whole, hopeless, known)
            if fit is not None:
                fits.append((c, fit))
    found = [Explanation(c, fit.view, fit.cost, fit.information) for c, fit in fits]
    best_class, best = min(fits, key=lambda pair: pair[1].cost)
    free = len(plan.free) + models[best_class].nuisances.shape[1] + 1 + len(joint.counts)
    apart = _best_apart(search, frames, models[best_class], first2camera, best, range(len(rules.names)))
    test = _test(best, joint, free, apart, len(_OWN) * len(frames) - len(plan.free))
    doubt = best.cost - best.deviance + doubtful_deviance(*moments_of(best.level), free, rules.false_alarm)
    return answer_from(rules, found, test, bare, doubt)


def joined(frames: Sequence[Counted]) -> Counted:
    """Return several frames of one sensor as one, their zones one after the other."""
    return frames[0]._replace(
        counts=np.concatenate([frame.counts for frame in frames]),
        drift_bins=np.concatenate([frame.drift_bins for frame in frames]),
    )


def _begin(
    plan: SearchPlan, starts: Sequence[Sequence[Start]], first2camera: NDArray[np.float64], n_classes: int
) -> list[Start]:
    """Return where joint fits begin: the hills of every frame, those that are the same taken once.

    Brightness, ambient light and nuisances of every frame are those of its own best hill of the class, or of any.
    """
    fixed = np.array([name not in plan.free for name in VIEW_FIELDS])
    seen = [k for k, of_frame in enumerate(starts) if of_frame]
    if len(seen) < len(starts):
        return []
    out: list[Start] = []
    for c in range(n_classes):
        own = [min(of_frame, key=lambda start: (start.class_index != c, start.cost)) for of_frame in starts]
        extra: list[NDArray[np.float64]] = []
        for k, best in enumerate(own):
            ratio = [best.bright / own[0].bright] if k else []
            extra.append(np.array([*ratio, *best.state[len(VIEW_FIELDS) :]]))
        ambient = np.concatenate([best.ambient for best in own])
        views: list[NDArray[np.float64]] = []
        for k, of_frame in enumerate(starts):
            for start in of_frame:
                if start.class_index != c:
                    continue
                view = view_in_first(first2camera[k], start.state[: len(VIEW_FIELDS)], fixed)
                view = np.clip(view, *plan.limits)
                if any(_same(view, other) for other in views):
                    continue
                views.append(view)
                out.append(Start(c, np.concatenate([view, *extra]), start.cost, own[0].bright, ambient))
    return out


def _same(view: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    apart = np.abs(view - other)
    turn = abs(math.remainder(float(view[1] - other[1]), 2 * math.pi))
    return bool(max(apart[0], apart[3]) < _SAME_M and max(turn, *apart[[2, 4, 5]]) < _SAME_RAD)


def _best_apart(
    search: LandmarkSearch, frames: Sequence[Counted], model: JointModel, first2camera: NDArray[np.float64], best: Fit,
    classes: Sequence[int],
) -> NDArray[np.float64]:  # fmt: skip
    """Return the deviance of each frame where it has a view and a class of its own, (n,)."""
    n_view, n_zones = len(VIEW_FIELDS), len(frames[0].counts)
    views = Views(*best.view[:, None])
    out = []
    for k, (ratio, own) in enumerate(model.split(best.state[n_view:])):
        seen = views_from(first2camera[k], views)
        view = np.array([getattr(seen, name)[0] for name in VIEW_FIELDS])
        near = np.stack([view - _NEAR, view + _NEAR])
        ambient = best.ambient[k * n_zones : (k + 1) * n_zones]
        costs = []
        for c in classes:
            of_class = search.model(c)
            alone = search_of(_OWN, np.full(len(_OWN), math.inf), near, _SCENES, of_class.nuisances)
            state = np.concatenate([view, own])
            fit = fit_view(scene_at(of_class, _OWN), frames[k], state, best.bright * ratio, ambient, alone, math.inf)
            if fit is not None:
                costs.append(fit.deviance)
        out.append(min(costs, default=math.inf))
    return np.array(out)


def _test(best: Fit, joint: Counted, free: int, apart: NDArray[np.float64], more: int) -> FitTest:
    """Return the test of a joint fit.

    It is the least favourable of three: of all frames together, of each frame, and of what the frames gain by a view
    and a class of their own, χ² with `more` degrees of freedom. The last one finds frames that contradict each other
    where a landmark between them explains all frames nearly as well.
    """
    n = len(joint.drift_bins)
    chi2, dof, whole = deviance_test(best.deviance, *moments_of(best.level), free)
    each, gain = 1.0, 0.0
    for counts, level, least in zip(np.split(joint.counts, n), np.split(best.level, n), apart, strict=True):
        deviance = deviance_of(counts, level)
        each = min(each, deviance_test(deviance, *moments_of(level), round(free / n))[2])
        gain += max(deviance - least, 0.0)
    agree = float(special.chdtrc(more, gain)) if more > 0 else 1.0
    return FitTest(chi2, dof, min(1.0, _TESTS * min(whole, n * each, agree)))
