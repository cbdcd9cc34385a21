"""Class and view of a landmark from histograms: a table's hills, exact scenes on them, and an answer with its test."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.matcher.estimate.acceptance import no_answer
from phasemark.matcher.histograms.cost_shape import axes_of_parameters, lessened, points_along, principal_axes
from phasemark.matcher.histograms.exact_fit import Counted, Fit, Search, Start, fit_view
from phasemark.matcher.histograms.histogram_search import SCENES, SURE_COST, HistogramSearch
from phasemark.matcher.histograms.poisson_fit import deviance_of, deviance_test, doubtful_deviance, moments_of
from phasemark.matcher.histograms.scene_models import JointModel, view_from
from phasemark.matcher.histograms.view_answers import Explanation, FitTest, answer_from
from phasemark.matcher.match import Match
from phasemark.render import Background
from phasemark.render.direct.bin_counts import glass_counts
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.histogram_frames import HistogramFrames
from phasemark.render.threads import mapped
from phasemark.render.view import VIEW_FIELDS

_SAME_M, _SAME_RAD = 0.02, math.radians(5.0)
_FEWEST, _MORE = 4, 4.0
"""Hills that are followed at least; how far a table may be wrong about others, over how far it was off for these."""
_HOPELESS = 500.0
"""A fit that costs so much more than the best one after its third scene is given up."""
_OWN = VIEW_FIELDS[:3]
_NEAR = np.array([0.05, *[math.radians(15.0)] * 2, 0.0, 0.0, 0.0])
"""What a frame by itself may have otherwise than all frames together, and how far."""

Found = list[tuple[int, Fit]]
"""Classes and fits."""


class HistogramMatcher(HistogramSearch):
    """Estimates class and view from histograms; see :class:`~.direct_matcher.DirectMatcher`.

    The brightness of the landmark and of each plane behind it is estimated too.
    """

    def match(self, frames: HistogramFrames) -> list[Match]:
        """Return an answer for every position of the bank's sensor, whose frames are added up."""
        self.prepare()
        return mapped(self._match, _counted(frames), self.workers)

    def _match(self, frame: Counted) -> Match:
        starts, bare = self.looked(frame)
        if not starts:
            return no_answer(self.rules)
        fits: Found = []
        error, left, alarm = 0.0, list(starts), self.rules.false_alarm
        while left:
            likely = left[0].cost < starts[0].cost + SURE_COST + _MORE * error
            # a hill that the table undervalues may explain a frame that no fit does
            if len(starts) - len(left) >= _FEWEST and not likely and not self._tested(fits)[0].p_value < alarm:
                break
            start = left.pop(0)
            if _follow(fits, self.searches[start.class_index], frame, start):
                error = max(error, abs(fits[-1][1].cost - start.cost))
        fits = self._with_slow_rise(fits, self.searches, frame)
        others = [Explanation(one.class_index, one.view, one.cost - error, None) for one in left]
        test, estimated = self._tested(fits)
        return self._answer(fits, others, test, bare, estimated, self.background_of(_best(fits)[1].state))

    def _tested(self, fits: Found) -> tuple[FitTest, int]:
        """Return the test of the best fit of a frame, and how many numbers it estimates."""
        best_class, best = _best(fits)
        estimated = _estimated(self.searches[best_class], best)
        return FitTest(*deviance_test(best.deviance, *moments_of(best.level), estimated)), estimated

    def match_jointly(self, frames: HistogramFrames, first2camera: NDArray[np.float64]) -> Match:
        """Return one answer for a landmark that several positions see, the view as the first one has it.

        Parameters
        ----------
        frames : HistogramFrames
        first2camera : (n, 4, 4) float64
            From the frame of the first position's camera to that of each.
        """
        counted = _counted(frames)
        self.prepare()
        found, bare = zip(*mapped(self.looked, counted, self.workers), strict=True)
        begin = self._joint_starts(found, first2camera)
        if not begin:
            return no_answer(self.rules)
        joint = counted[0]._replace(
            counts=np.concatenate([frame.counts for frame in counted]),
            drift_bins=np.concatenate([frame.drift_bins for frame in counted]),
        )
        models = [JointModel(model, first2camera) for model in self.models]
        searches = [Search(model, self.free, self.prior_std, self.limits) for model in models]
        first = []
        for start in begin:
            fit = fit_view(searches[start.class_index], joint, start, 1)
            if fit is not None:
                first.append(start._replace(state=fit.state, bright=fit.bright, ambient=fit.ambient, cost=fit.cost))
        first.sort(key=lambda start: start.cost)
        fits: Found = []
        of_class = 4  # starts of each class that a joint fit follows to the end
        for c, search in enumerate(searches):
            for start in [start for start in first if start.class_index == c][:of_class]:
                _follow(fits, search, joint, start)
        fits = self._with_slow_rise(fits, searches, joint)
        best_class, best = _best(fits)
        estimated = _estimated(searches[best_class], best)
        apart = self._best_apart(counted, models[best_class], first2camera, best)
        test = _joint_test(best, joint, estimated, apart, len(_OWN) * len(counted) - len(self.free))
        return self._answer(fits, (), test, sum(bare), estimated, None)

    def _with_slow_rise(self, fits: Found, searches: Sequence[Search], frame: Counted) -> Found:
        """Return fits, the best one with the information that the cost about it shows.

        It is looked for where counts vanish there, and where height, pitch or roll is free: the top of a landmark comes
        into view to one side alone.
        """
        best_class, best = _best(fits)
        if best.straight and not set(self.free) & set(VIEW_FIELDS[3:]):
            return fits
        search, information = searches[best_class], best.information
        columns = [VIEW_FIELDS.index(name) for name in self.free]
        fixed = Search(search.model, (), np.empty(0), search.limits[:, : len(VIEW_FIELDS)])
        weight = search.weight[: len(columns)]
        rounds = 3  # each lessens the information along an axis to a fiftieth at most
        for _ in range(rounds):
            axes = np.concatenate([axes_of_parameters(information), principal_axes(information)])
            points = points_along(best.view, columns, axes)
            inside = (points == np.clip(points, *self.limits)).all(axis=-1)
            rise = np.full(inside.shape, np.nan)
            for k in zip(*np.nonzero(inside), strict=True):
                state = np.concatenate([points[k], best.state[len(VIEW_FIELDS) :]])
                there = fit_view(fixed, frame, Start(best_class, state, best.cost, best.bright, best.ambient), SCENES)
                rise[k] = there.cost + weight @ points[k][columns] ** 2 - best.cost if there is not None else np.nan
            before, information = information, lessened(information, axes, rise)
            if np.allclose(information, before, rtol=0.5):
                break
        return [(c, fit._replace(information=information) if fit is best else fit) for c, fit in fits]

    def _answer(
        self, fits: Found, others: Sequence[Explanation], test: FitTest, bare: float, estimated: int,
        background: Background | None,
    ) -> Match:  # fmt: skip
        """Return the answer that fits give; `others` were not followed to the end."""
        found = [Explanation(c, fit.view, fit.cost, fit.information) for c, fit in fits]
        _, best = _best(fits)
        refused = doubtful_deviance(*moments_of(best.level), estimated, self.rules.false_alarm)
        return answer_from(self.rules, [*found, *others], test, bare, best.cost - best.deviance + refused, background)

    def _joint_starts(self, starts: Sequence[Sequence[Start]], first2camera: NDArray[np.float64]) -> list[Start]:
        """Return where joint fits begin: the hills of every frame, those that are the same taken once.

        Brightness, ambient light and nuisances of every frame are those of its own best hill of the class, or of any.
        """
        if not all(starts):
            return []
        fixed = np.array([name not in self.free for name in VIEW_FIELDS])
        out: list[Start] = []
        for c in range(len(self.searches)):
            own = [min(of_frame, key=lambda start: (start.class_index != c, start.cost)) for of_frame in starts]
            extra = [np.array([best.bright / own[0].bright, *best.state[len(VIEW_FIELDS) :]]) for best in own]
            ambient = np.concatenate([best.ambient for best in own])
            views: list[NDArray[np.float64]] = []
            for there, of_frame in zip(first2camera, starts, strict=True):
                for start in of_frame:
                    if start.class_index != c:
                        continue
                    view = np.where(fixed, 0.0, view_from(np.linalg.inv(there), start.view))
                    view = np.clip(view, *self.limits)
                    if any(_is_same(view, other) for other in views):
                        continue
                    views.append(view)
                    state = np.concatenate([view, *extra])
                    out.append(Start(c, np.delete(state, len(VIEW_FIELDS)), start.cost, own[0].bright, ambient))
        return out

    def _best_apart(
        self, frames: Sequence[Counted], model: JointModel, first2camera: NDArray[np.float64], best: Fit
    ) -> list[float]:
        """Return the deviance of each frame where it has a view and a class of its own."""
        out = []
        ambient = np.split(best.ambient, len(frames))
        rows = model.split(best.state[len(VIEW_FIELDS) :])
        for frame, there, light, (ratio, *own) in zip(frames, first2camera, ambient, rows, strict=True):
            view = view_from(there, best.view)
            limits = np.stack([view - _NEAR, view + _NEAR])
            start = Start(0, np.array([*view, *own]), 0.0, best.bright * ratio, light)
            searches = [Search(one, _OWN, np.full(len(_OWN), math.inf), limits) for one in self.models]
            fits = [fit_view(search, frame, start, SCENES) for search in searches]
            out.append(min((fit.deviance for fit in fits if fit is not None), default=math.inf))
        return out


def _follow(fits: Found, search: Search, frame: Counted, start: Start) -> bool:
    """Fit a view from a start and add it to the others; returns False where it was given up."""
    hopeless = min((fit.cost for _, fit in fits), default=math.inf) + _HOPELESS
    known = [fit.view for other, fit in fits if other == start.class_index]
    fit = fit_view(search, frame, start, SCENES, hopeless, known)
    if fit is not None and not fit.settled:
        again = start._replace(state=fit.state, bright=fit.bright, ambient=fit.ambient)
        fit = min(fit, fit_view(search, frame, again, SCENES) or fit, key=lambda one: one.cost)
    if fit is not None:
        fits.append((start.class_index, fit))
    return fit is not None


def _best(fits: Found) -> tuple[int, Fit]:
    """Return the fit of the least cost, and its class."""
    return min(fits, key=lambda pair: pair[1].cost)


def _estimated(search: Search, fit: Fit) -> int:
    """Return how many numbers a fit estimates: with those of the search, brightness and the ambient light of zones."""
    return len(search.columns) + 1 + len(fit.ambient)


def _is_same(view: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    apart = np.abs(view - other)
    turn = abs(math.remainder(float(view[1] - other[1]), 2 * math.pi))
    return bool(max(apart[0], apart[3]) < _SAME_M and max(turn, *apart[[2, 4, 5]]) < _SAME_RAD)


def _joint_test(best: Fit, joint: Counted, estimated: int, apart: Sequence[float], more: int) -> FitTest:
    """Return the test of a joint fit.

    It is the least favourable of three: of all frames together, of each frame, and of what the frames gain by a view
    and a class of their own, χ² with `more` degrees of freedom. The last one finds frames that contradict each other
    where a landmark between them explains all frames nearly as well.
    """
    n = len(apart)
    chi2, dof, whole = deviance_test(best.deviance, *moments_of(best.level), estimated)
    each, gain = 1.0, 0.0
    for counts, level, least in zip(np.split(joint.counts, n), np.split(best.level, n), apart, strict=True):
        deviance = deviance_of(counts, level)
        each = min(each, deviance_test(deviance, *moments_of(level), round(estimated / n))[2])
        gain += max(deviance - least, 0.0)
    agree = float(special.chdtrc(more, gain)) if more > 0 else 1.0
    tests = 3
    return FitTest(chi2, dof, min(1.0, tests * min(whole, n * each, agree)))


def _counted(frames: HistogramFrames) -> list[Counted]:
    """Return what was counted at each position, its frames added up."""
    histogram = histogram_of(frames.sensor)
    n_frames = float(frames.counts.shape[1])
    cycles = histogram.cycles * n_frames if histogram.pile_up else math.inf
    extra = n_frames * glass_counts(frames.sensor)
    return [
        Counted(np.ascontiguousarray(counts), n_frames, cycles, extra, np.array([drift]))
        for counts, drift in zip(frames.zone_counts, frames.drift_bins, strict=True)
    ]
