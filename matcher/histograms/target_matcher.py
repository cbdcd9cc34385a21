"""Class and view of a landmark from the targets that a direct sensor's chip reports (PHYSICS sections 7 and 11).

The expected report is computed from the expected counts as the chip does it: merged peaks and estimates drawn to one
side follow by themselves. A target is compared with the nearest one expected in its zone, with the sigma that came with
it. A target that must be seen and is missing, and one that nothing explains, cost a disagreement. Chips
report peaks of the noise too: how many of these are expected follows from the ambient light and the threshold.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark import UsageError
from phasemark.matcher.estimate.acceptance import no_answer
from phasemark.matcher.estimate.solver import descend
from phasemark.matcher.histograms.cost_shape import lessened, points_along, principal_axes
from phasemark.matcher.histograms.direct_matcher import DirectMatcher
from phasemark.matcher.histograms.exact_fit import LONGEST
from phasemark.matcher.histograms.histogram_table import TableGrid, build_table, plane_light
from phasemark.matcher.histograms.scene_models import planes_of
from phasemark.matcher.histograms.target_costs import nearest_targets, node_costs
from phasemark.matcher.histograms.view_answers import Explanation, FitTest, answer_from
from phasemark.matcher.match import Match
from phasemark.matcher.pixel_agreement import DISAGREEMENT
from phasemark.render import Views
from phasemark.render.direct.bin_counts import detected_counts
from phasemark.render.direct.expected_targets import ExpectedTargets, expected_targets, most_peaks
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.targets import Status, Targets
from phasemark.render.direct.view_signals import STEPS, views_about
from phasemark.render.threads import mapped
from phasemark.render.view import VIEW_FIELDS

_STARTS, _FIRST_STEPS, _SHARPENED, _FOLLOWED, _STEPS, _SHARES = 24, 2, 12, 6, 6, (1.0, 0.3)
"""Of 60 frames of five random parts a start led to the right hill on 58: one of the first 12."""
_EVERY = 2  # targets are looked up at every second distance of the grid: a start may lie between them
_APART_RAD = math.radians(5.0)
"""Between starts of a class."""
_DONE = 0.01  # squared standard deviations
_BLUR_M = (5e-3, 1e-3)
"""Fits begin with targets that are known no better than this: sigmas may be a tenth of a millimetre, and a target that
is off by more than five of them has no slope. The best starts are fitted as they are, too: what is blurred hides narrow
hills, and may lead away from one."""
_LEAST_STD_M = 1e-5
_BETTER_FITS, _BETTER = 2, 0.1
"""Where a view a few standard deviations aside of the best fit explains the targets better, a fit begins there."""
_LOOKED_ABOUT, _WORTH_A_LOOK = 4, 4 * DISAGREEMENT
"""How many hills are looked about, and by how much they may cost more than the best one."""
_NEAR_M, _NEAR_RAD = 0.005, math.radians(1.0)
"""Fits that are nearer to one another stand on one hill."""
_NO_STEPS = np.empty(0)
_WIDER = 6.0
"""Slopes of targets span this multiple of the steps of counts: estimates jump where the highest bin changes."""


class Reported(NamedTuple):
    """Targets that the chip reported at one position; k of all frames.

    Parameters
    ----------
    zone : (k,) int64
    distance_m, std_m : (k,) float64
        As range or z, as the chip reports it.
    n_frames : int
    """

    zone: NDArray[np.int64]
    distance_m: NDArray[np.float64]
    std_m: NDArray[np.float64]
    n_frames: int


class _Table(NamedTuple):
    """Targets that are expected at one bearing.

    Parameters
    ----------
    bearing_rad : float
    distance_m : (classes, distances, angles, zones, targets) float32
        At the nodes of a grid.
    sure : (classes, distances, angles, zones, targets) bool
        Which of them every frame reports.
    alone : ExpectedTargets
        Of the planes without a landmark.
    """

    bearing_rad: float
    distance_m: NDArray[np.float32]
    sure: NDArray[np.bool_]
    alone: ExpectedTargets


class _Comparison(NamedTuple):
    """Comparison of reported targets with those that are expected at a view."""

    cost: float
    chi2: float
    n_compared: int
    n_wrong: int
    information: NDArray[np.float64]
    gradient: NDArray[np.float64]


class _Fit:
    """The targets of a frame compared with those that are expected at a view of a class: a point of a descent."""

    def __init__(self, matcher: TargetMatcher, frame: Reported, class_index: int, view: NDArray[np.float64]) -> None:
        self._matcher, self._frame, self.class_index, self.view = matcher, frame, class_index, view
        self.compared = matcher.compared_at(frame, class_index, view)
        self.cost = self.compared.cost + float(matcher.prior_cost(view))

    @cached_property
    def _with_slopes(self) -> _Comparison:
        """The comparison with its slopes, which most points of a descent are never asked for."""
        return self._matcher.compared_at(self._frame, self.class_index, self.view, with_slopes=True)

    @cached_property
    def information(self) -> NDArray[np.float64]:
        """Half the second derivative of the cost, (p, p)."""
        return np.asarray(self._with_slopes.information + np.diag(self._matcher.prior_weight))

    @property
    def gradient(self) -> NDArray[np.float64]:
        """Minus half the slope of the cost, (p,)."""
        return np.asarray(self._with_slopes.gradient - self._matcher.prior_weight * self.view[self._matcher.columns])

    def of(self, frame: Reported) -> _Fit:
        """Return the comparison of other targets at the same view."""
        return _Fit(self._matcher, frame, self.class_index, self.view)

    def is_near(self, other: _Fit) -> bool:
        """Return whether another view of the class is so near that both are one hill."""
        turn = math.remainder(float(self.view[1] - other.view[1]), 2 * math.pi)
        near = abs(float(self.view[0] - other.view[0])) < _NEAR_M and abs(turn) < _NEAR_RAD
        return self.class_index == other.class_index and near

    def moved(self, step: NDArray[np.float64]) -> _Fit:
        """Return the comparison at a view a step away, within the limits."""
        view = self.view.copy()
        view[self._matcher.columns] += step
        return _Fit(self._matcher, self._frame, self.class_index, np.clip(view, *self._matcher.limits))


class TargetMatcher(DirectMatcher):
    """Estimates class and view from targets; see :class:`~.direct_matcher.DirectMatcher`.

    Albedos of a background are as stated, for targets do not tell them.
    """

    _bearing_step_rad = math.radians(2.0)  # edges of zones are sharp

    @property
    def table_bytes(self) -> int:
        """How large the tables of targets are in memory, with the histograms that one of them is made of."""
        counts = self._nodes.n_bytes(self.sensor, len(self.signals), len(planes_of(self.background)))
        n_nodes = len(self._bearings_rad) * len(self.signals) * self._nodes.distance_m.size * self._nodes.delta_rad.size
        of_target = np.dtype(np.float32).itemsize + np.dtype(np.bool_).itemsize
        return counts + of_target * n_nodes * self.sensor.rows * self.sensor.cols * most_peaks(self.sensor)

    @cached_property
    def _nodes(self) -> TableGrid:
        """Where targets are looked up."""
        return self.grid._replace(distance_m=self.grid.distance_m[::_EVERY], first_bin=self.grid.first_bin[::_EVERY])

    @cached_property
    def tables(self) -> list[_Table]:
        """Targets that are expected on the grid, one table for each bearing."""
        return [self._built_table(bearing) for bearing in self._bearings_rad]

    def _built_table(self, bearing_rad: float) -> _Table:
        """Render histograms and keep the targets that are expected of them."""
        counts = build_table(self.signals, self._nodes, self.background, bearing_rad, self.workers)
        shape = (*counts.signal.shape[:4], most_peaks(self.sensor))
        distance, sure = np.empty(shape, np.float32), np.empty(shape, np.bool_)
        bins = histogram_of(self.sensor).bins
        light = np.zeros((0, shape[3], bins))
        if self.background is not None:
            light = plane_light(self.nothing, self.background, bearing_rad)
        for c in range(shape[0]):
            for i, first in enumerate(counts.first_bin.tolist()):
                low, high = max(first, 0), min(first + self._nodes.window, bins)
                signal = np.zeros((shape[2], shape[3], bins))
                signal[:, :, low:high] = counts.signal[c, i, :, :, low - first : high - first]
                signal += np.einsum("jpz,pzb->jzb", counts.visible[c, i].astype(np.float64), light)
                found = self._expected(signal)
                distance[c, i], sure[c, i] = found.distance_m, found.sure
        return _Table(bearing_rad, distance, sure, self._expected(light.sum(axis=0)[None]))

    def match(self, targets: Targets) -> list[Match]:
        """Return an answer for every position.

        Raises
        ------
        UsageError
            The targets are of another number of zones than the bank's sensor has.
        """
        if targets.distance_m.shape[2:4] != (self.sensor.rows, self.sensor.cols):
            rows, cols = targets.distance_m.shape[2:4]
            raise UsageError(
                f"the targets are of {rows} × {cols} zones, but the bank's sensor has {self.sensor.rows} ×"
                f" {self.sensor.cols}"
            )
        _ = self.tables  # rendered before threads ask for them
        return mapped(self._match, [self._reported(targets, k) for k in range(len(targets.distance_m))], self.workers)

    def _reported(self, targets: Targets, k: int) -> Reported:
        """Return the targets of one position, in a list."""
        n_frames = targets.distance_m.shape[1]
        distance = targets.distance_m[k].reshape(n_frames, -1, targets.distance_m.shape[-1])
        valid = (targets.status[k] == Status.VALID).reshape(distance.shape) & np.isfinite(distance)
        _, zone, _ = np.nonzero(valid)
        std = targets.sigma_m[k].reshape(distance.shape)[valid]
        usual = self.sensor.range_std_m or histogram_of(self.sensor).bin_width_m / math.sqrt(12)
        std = np.where(np.isfinite(std) & (std > 0), std, usual)
        return Reported(zone, distance[valid], np.maximum(std, _LEAST_STD_M), n_frames)

    def _expected(self, signal: NDArray[np.float64]) -> ExpectedTargets:
        """Return the targets that may be reported of signal counts, (n, zones, bins)."""
        return expected_targets(detected_counts(signal, self.sensor), self.sensor)

    @cached_property
    def _false_targets(self) -> float:
        """Peaks of the noise that one frame is expected to report."""
        histogram = histogram_of(self.sensor)
        level = histogram.cycles * (histogram.ambient + histogram.dark)
        least = level + histogram.threshold * math.sqrt(max(level, 1.0))
        share = float(special.pdtrc(math.floor(least), level)) if level > 0 else 0.0
        return min(share * histogram.bins, 1.0) * self.sensor.rows * self.sensor.cols

    def _match(self, frame: Reported) -> Match:
        if not len(frame.zone):
            return no_answer(self.rules)
        coarse, fine = (frame._replace(std_m=np.hypot(frame.std_m, blur_m)) for blur_m in _BLUR_M)
        starts = self._starts(frame)
        begun = [self._fit(_Fit(self, coarse, *start), _FIRST_STEPS) for start in starts]
        begun.sort(key=lambda fit: fit.cost)
        sharper = [self._fit(fit.of(fine), _FIRST_STEPS) for fit in begun[:_SHARPENED]]
        sharper.sort(key=lambda fit: fit.cost)
        fits = [self._fit(fit.of(frame)) for fit in sharper[:_FOLLOWED]]
        fits += [self._fit(_Fit(self, frame, *start)) for start in starts[:_FOLLOWED]]
        fits.sort(key=lambda fit: fit.cost)
        apart = [fit for k, fit in enumerate(fits) if not any(fit.is_near(other) for other in fits[:k])]
        likely = [fit for fit in apart[:_LOOKED_ABOUT] if fit.cost < fits[0].cost + _WORTH_A_LOOK]
        fits = [self._lessened(frame, fit) for fit in likely] + [fit for fit in apart if fit not in likely]
        found = [Explanation(fit.class_index, fit.view, fit.cost, fit.information) for fit in fits]
        left = (*sharper[_FOLLOWED:], *begun[_SHARPENED:])
        found += [Explanation(fit.class_index, fit.view, fit.of(frame).cost, None) for fit in left]
        best = min(fits, key=lambda fit: fit.cost)
        compared = best.compared
        expected = max(frame.n_frames * self._false_targets, 0.05)
        dof = compared.n_compared - len(self.free)
        p_fit = float(special.chdtrc(dof, compared.chi2)) if dof > 0 else 0.0
        p_count = float(special.pdtrc(compared.n_wrong - 1, expected)) if compared.n_wrong else 1.0
        test = FitTest(compared.chi2, max(dof, 0), min(1.0, 2 * min(p_fit, p_count)))
        doubt = best.cost - compared.chi2 + float(special.chdtri(max(dof, 1), self.rules.false_alarm))
        return answer_from(self.rules, found, test, self._bare_cost(frame), doubt, self.background)

    def _bare_cost(self, frame: Reported) -> float:
        """Return what a scene without a landmark costs."""
        return min(
            self._prior_of(table.bearing_rad) + self._compared(frame, table.alone, _NO_STEPS).cost
            for table in self.tables
        )

    def _counts(self, c: int, views: Views) -> NDArray[np.float64]:
        """Return the signal counts of a class at some views, with what stands behind it; (n, zones, bins)."""
        if self.background is None:
            return self.signals[c].counts(views)
        return np.asarray(self.signals[c].surfaces(views, self.background).sum(axis=1))

    def _starts(self, frame: Reported) -> list[tuple[int, NDArray[np.float64]]]:
        """Return the views that explain the targets best, each at an angle of its own of its class, best first."""
        distance_m, delta_rad = self._nodes.distance_m, self._nodes.delta_rad
        step = float(distance_m[1] - distance_m[0])
        # how far a target may be off between nodes of the table: added to sigmas in the search alone
        grid_std_m = 0.01
        weight = 1 / (frame.std_m**2 + grid_std_m**2)
        shape = (len(self.tables), len(self.signals), len(distance_m), len(delta_rad))
        cost, shift = np.empty(shape), np.empty(shape)
        for b, table in enumerate(self.tables):
            node_costs(table.distance_m, table.sure, frame.zone, frame.distance_m, weight, frame.n_frames, step,
                       table.alone.distance_m[0], np.empty(len(frame.zone)), np.empty(len(frame.zone)),
                       np.empty(table.sure.shape[3:]), cost[b], shift[b])  # fmt: skip
            cost[b] += self._prior_of(table.bearing_rad)
        starts: list[tuple[int, NDArray[np.float64]]] = []
        lowest = cost.min(axis=(0, 2))
        for c, j in np.column_stack(np.unravel_index(np.argsort(lowest, axis=None), lowest.shape)).tolist():
            turn = [math.remainder(delta_rad[j] - other[1], 2 * math.pi) for d, other in starts if d == c]
            if any(abs(angle) <= _APART_RAD for angle in turn):
                continue
            best, i = np.unravel_index(cost[:, c, :, j].argmin(), shape[::2])
            bearing_rad = self.tables[int(best)].bearing_rad
            view = np.array([distance_m[i] + shift[best, c, i, j], delta_rad[j], bearing_rad, 0.0, 0.0, 0.0])
            starts.append((c, np.clip(view, *self.limits)))
            if len(starts) == _STARTS:
                break
        return starts

    def _fit(self, begin: _Fit, most: int = _STEPS) -> _Fit:
        """Refine a view."""
        longest = np.array([LONGEST[name.rpartition("_")[2]] for name in self.free])
        return descend(begin, longest, most=most, done=_DONE, shares=_SHARES)[0]

    def _lessened(self, frame: Reported, fit: _Fit) -> _Fit:
        """Return the best fit, or a better one beside it, with the information that the cost about it shows."""
        for left in range(_BETTER_FITS, -1, -1):
            axes = principal_axes(fit.information)
            points = points_along(fit.view, self.columns, axes)
            inside = (points == np.clip(points, *self.limits)).all(axis=-1)
            costs = np.full(inside.shape, np.nan)
            costs[inside] = self._costs(frame, fit.class_index, points[inside])
            best = int(np.nanargmin([*costs.ravel(), fit.cost]))
            if left == 0 or best == costs.size:
                break
            other = self._fit(_Fit(self, frame, fit.class_index, points.reshape(-1, len(VIEW_FIELDS))[best]))
            if other.cost >= fit.cost - _BETTER:
                break
            fit = other
        fit.information = lessened(fit.information, axes, costs - fit.cost)
        return fit

    def _costs(self, frame: Reported, c: int, views: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what the targets cost at some views, (n,)."""
        if not len(views):
            return np.empty(0)
        expected = self._expected(self._counts(c, Views(*views.T.copy())))
        apart = (ExpectedTargets(*(values[None] for values in one)) for one in zip(*expected, strict=True))
        return self.prior_cost(views) + [self._compared(frame, one, _NO_STEPS).cost for one in apart]

    def prior_cost(self, views: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the cost of views before a frame is seen, (…, 6) to (…)."""
        return np.asarray(views[..., self.columns] ** 2 @ self.prior_weight)

    def compared_at(
        self, frame: Reported, c: int, view: NDArray[np.float64], *, with_slopes: bool = False
    ) -> _Comparison:
        """Compare the targets with those of a view, and of views to either side, which give the slopes."""
        free = self.free if with_slopes else ()
        steps = _WIDER * np.array([STEPS[name] for name in free])
        return self._compared(frame, self._expected(self._counts(c, views_about(view, free, _WIDER))), steps)

    def _compared(self, frame: Reported, expected: ExpectedTargets, steps: NDArray[np.float64]) -> _Comparison:
        """Compare the targets with those that are expected at a view, and at views by some steps to either side."""
        residual, slope = np.full(len(frame.zone), np.nan), np.zeros((len(frame.zone), len(steps)))
        spread, hits = np.zeros(len(frame.zone)), np.zeros(expected.sure.shape[1:])
        nearest_targets(expected.distance_m, expected.spread_m, frame.zone, frame.distance_m, frame.std_m, steps,
                        residual, spread, slope, hits)  # fmt: skip
        std = np.hypot(frame.std_m, spread)
        squared = (residual / std) ** 2
        right = squared < DISAGREEMENT  # False where nothing is expected
        missing = float(np.maximum(frame.n_frames - hits, 0.0)[expected.sure[0]].sum())
        weighted = slope[right] / std[right, None]
        n_wrong = int((~right).sum() + round(missing))
        chi2 = float(squared[right].sum())
        of_noise = frame.n_frames * self._false_targets
        normal = float((2 * np.log(std[right] / frame.std_m[right])).sum())
        return _Comparison(
            chi2 + normal + _unexplained_cost(int((~right).sum()), of_noise) + DISAGREEMENT * missing,
            chi2,
            int(right.sum()),
            n_wrong,
            weighted.T @ weighted,
            weighted.T @ (residual[right] / std[right]),
        )


def _unexplained_cost(n: int, expected: float) -> float:
    """Return what targets cost that nothing explains: little while the noise is expected to make as many."""
    tolerated = expected + 3 * math.sqrt(expected)
    return 2 * min(n, tolerated) + DISAGREEMENT * max(n - tolerated, 0.0)
