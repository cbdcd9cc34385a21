"""Class and view of a landmark from the targets that a direct sensor's chip reports (PHYSICS sections 7 and 11).

The expected report is computed from the expected counts as the chip does it: merged peaks and estimates drawn to one
side follow by themselves. A target is compared with the nearest one expected in its zone, with the sigma that came with
it. A target that must be seen and is missing, and one that nothing explains, cost a disagreement. Chips
report peaks of the noise too: how many of these are expected follows from the ambient light and the threshold.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.matcher.estimate.acceptance import Rules, no_answer
from phasemark.matcher.histograms.background_table import build_table_before, plane_light
from phasemark.matcher.histograms.cost_shape import lessened, points_about
from phasemark.matcher.histograms.histogram_matcher import check_histogram_sensor, view_limits
from phasemark.matcher.histograms.histogram_table import build_table, plan_table
from phasemark.matcher.histograms.scene_models import planes_of
from phasemark.matcher.histograms.search_plan import before_the_wall
from phasemark.matcher.histograms.table_search import grid_minima
from phasemark.matcher.histograms.view_answers import Explanation, FitTest, answer_from
from phasemark.matcher.match import Match
from phasemark.matcher.pixel_agreement import DISAGREEMENT
from phasemark.render import Background, Views
from phasemark.render.direct.bin_counts import detected_counts
from phasemark.render.direct.expected_targets import ExpectedTargets, expected_targets, most_peaks
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.targets import Status, Targets
from phasemark.render.direct.view_signals import STEPS, ViewSignals, views_about
from phasemark.render.kernel import kernel
from phasemark.render.view import VIEW_FIELDS

_GRID_STD_M = 0.01
"""How far a target may be off between nodes of the table: added to sigmas in the search alone."""
_MOST_STARTS, _MINIMA = 9, 3
_ASIDE_RAD = math.radians(6.0)
_WORTH_ANOTHER_TRY = 2 * DISAGREEMENT
_STEPS = 6
_DONE = 0.1
_LEAST_STD_M = 1e-5
_BETTER_FITS, _BETTER = 2, 0.1
"""Where a view a few standard deviations aside of the best fit explains the targets better, a fit begins there."""
_NO_STEPS = np.empty(0)
_WIDER = 6.0
"""Slopes of targets span this multiple of the steps of counts: estimates jump where the highest bin changes."""
_LONGEST = {"m": 0.04, "rad": math.radians(4.0)}


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


class _Comparison(NamedTuple):
    cost: float
    chi2: float
    n_compared: int
    n_wrong: int
    information: NDArray[np.float64]
    gradient: NDArray[np.float64]


class TargetMatcher:
    """Estimates class and view from targets.

    Parameters
    ----------
    bank, prior_std, rules, workers
        As for :class:`~phasemark.matcher.histograms.histogram_matcher.HistogramMatcher`.
    background : Background, optional
        What stands behind the landmark; albedos are as stated, for targets do not tell them.
    """

    def __init__(
        self, bank: Bank, *, prior_std: Sequence[float], rules: Rules,
        background: Background | None = None, workers: int = 1,
    ) -> None:  # fmt: skip
        self.sensor = bank.camera
        check_histogram_sensor(bank)
        self._free, self.rules, self._workers = rules.free, rules, workers
        self._weight = 1 / np.array(prior_std, dtype=np.float64) ** 2
        self._columns = [VIEW_FIELDS.index(name) for name in rules.free]
        meshes = [bank.mesh(name) for name in bank.classes]
        self.signals = [ViewSignals(mesh, self.sensor, float(mesh.metadata["albedo"])) for mesh in meshes]
        self.grid = plan_table(self.signals, bank.distance_m, bank.delta_rad, math.gcd(*rules.symmetry))
        self._background = None if background is None or not planes_of(background) else background
        self._nothing = ViewSignals(None, self.sensor)
        self._limits = view_limits(self.grid)
        if self._background is not None:
            self._limits = before_the_wall(self._limits, self._background)

    @property
    def table_bytes(self) -> int:
        """How large the histograms are that the table of targets is made of; they are not kept."""
        return self.grid.n_bytes(self.sensor, len(self.signals))

    @cached_property
    def table(self) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Targets that are expected on the grid, (classes, distances, angles, zones, targets), and which are sure."""
        behind = self._background
        if behind is None:
            counts = build_table(self.signals, self.grid, 0.0, self._workers)
        else:
            counts, visible, _ = build_table_before(self.signals, self.grid, behind, 0.0, self._workers)
            light = plane_light(self._nothing, behind, 0.0)
        shape = (*counts.signal.shape[:4], most_peaks(self.sensor))
        distance, sure = np.empty(shape, np.float32), np.empty(shape, np.bool_)
        bins = histogram_of(self.sensor).bins
        for c in range(shape[0]):
            for i, first in enumerate(counts.first_bin):
                low, high = max(int(first), 0), min(int(first) + self.grid.window, bins)
                signal = np.zeros((shape[2], shape[3], bins))
                signal[:, :, low:high] = counts.signal[c, i, :, :, low - first : high - first]
                if behind is not None:
                    signal += np.einsum("jpz,pzb->jzb", visible[c, i].astype(np.float64), light)
                found = self._expected(signal)
                distance[c, i], sure[c, i] = found.distance_m, found.sure
        return distance, sure

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
        reported = [self._reported(targets, k) for k in range(len(targets.distance_m))]
        _ = self.table  # rendered before threads ask for it
        _ = self._still
        if self._workers == 1 or len(reported) < 2:
            return [self._match(one) for one in reported]
        with ThreadPoolExecutor(self._workers) as pool:
            return list(pool.map(self._match, reported))

    def _reported(self, targets: Targets, k: int) -> Reported:
        """Return the targets of one position, in a list."""
        n_frames = targets.distance_m.shape[1]
        distance = targets.distance_m[k].reshape(n_frames, -1, targets.distance_m.shape[-1])
        valid = (targets.status[k] == Status.VALID).reshape(distance.shape) & np.isfinite(distance)
        _, zone, _ = np.nonzero(valid)
        std = targets.sigma_m[k].reshape(distance.shape)[valid]
        std = np.where(np.isfinite(std) & (std > 0), std, self._usual_std())
        return Reported(zone, distance[valid], np.maximum(std, _LEAST_STD_M), n_frames)

    def _usual_std(self) -> float:
        """Return the standard deviation of a target that was reported without one."""
        std = self.sensor.range_std_m
        return std if std else histogram_of(self.sensor).bin_width_m / math.sqrt(12)

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
        fits = [self._fit(frame, c, view) for c, view in self._starts(frame)]
        fits += self._beside(frame, fits)
        best_index = int(np.argmin([comparison.cost for _, _, comparison in fits]))
        fits[best_index] = self._lessened(frame, *fits[best_index])
        found = [Explanation(c, view, comparison.cost, comparison.information) for c, view, comparison in fits]
        best = fits[best_index][2]
        n = frame.n_frames
        expected = n * self._false_targets
        bare = self._bare_cost(frame)
        dof = best.n_compared - len(self._free)
        p_fit = float(special.chdtrc(dof, best.chi2)) if dof > 0 else 0.0
        p_count = float(special.pdtrc(best.n_wrong - 1, max(expected, 0.05))) if best.n_wrong else 1.0
        test = FitTest(best.chi2, max(dof, 0), min(1.0, 2 * min(p_fit, p_count)))
        doubt = best.cost - best.chi2 + float(special.chdtri(max(dof, 1), self.rules.false_alarm))
        return answer_from(self.rules, found, test, bare, doubt, self._background)

    def _bare_cost(self, frame: Reported) -> float:
        """Return what a scene without a landmark costs."""
        if self._background is None:
            return _unexplained_cost(len(frame.zone), frame.n_frames * self._false_targets)
        return self._cost(frame, self._planes_alone, np.empty(0)).cost

    @cached_property
    def _planes_alone(self) -> ExpectedTargets:
        """Targets that are expected of the planes alone."""
        assert self._background is not None
        return self._expected(plane_light(self._nothing, self._background, 0.0).sum(axis=0)[None])

    @cached_property
    def _still(self) -> NDArray[np.float64]:
        """Targets that do not move with the landmark, (zones, targets)."""
        if self._background is None:
            return np.full((self.sensor.rows * self.sensor.cols, 1), np.nan)
        return np.asarray(self._planes_alone.distance_m[0])

    def _counts(self, c: int, views: Views) -> NDArray[np.float64]:
        """Return the signal counts of a class at some views, with what stands behind it; (n, zones, bins)."""
        if self._background is None:
            return self.signals[c].counts(views)
        return np.asarray(self.signals[c].surfaces(views, self._background).sum(axis=1))

    def _starts(self, frame: Reported) -> list[tuple[int, NDArray[np.float64]]]:
        """Return the views that explain the targets best, each class with its two best hills, best first."""
        distance, sure = self.table
        cost, shift = np.empty(distance.shape[:3]), np.empty(distance.shape[:3])
        step = float(self.grid.distance_m[1] - self.grid.distance_m[0])
        variance = frame.std_m**2 + _GRID_STD_M**2
        _node_costs(distance, sure, frame.zone, frame.distance_m, 1 / variance, frame.n_frames, step,
                    self._still, np.empty(len(frame.zone)), np.empty(len(frame.zone)), np.empty(distance.shape[3:]),
                    cost, shift)  # fmt: skip
        starts = []
        for c in range(len(cost)):
            for i, j in grid_minima(cost[c], self.grid.cyclic, _MINIMA):
                view = np.zeros(len(VIEW_FIELDS))
                view[0] = self.grid.distance_m[i] + shift[c, i, j]
                view[1] = self.grid.delta_rad[j]
                starts.append((c, view, float(cost[c, i, j])))
        starts.sort(key=lambda start: start[2])
        return [(c, np.clip(view, *self._limits)) for c, view, _ in starts[:_MOST_STARTS]]

    def _beside(
        self, frame: Reported, fits: Sequence[tuple[int, NDArray[np.float64], _Comparison]]
    ) -> list[tuple[int, NDArray[np.float64], _Comparison]]:
        """Return fits that begin a little aside of the best one of every class: a step may end before a small hill."""
        more = []
        best = min(comparison.cost for _, _, comparison in fits)
        for c in range(len(self.signals)):
            of_class = [(view, comparison) for class_index, view, comparison in fits if class_index == c]
            if not of_class:
                continue
            view, comparison = min(of_class, key=lambda pair: pair[1].cost)
            if comparison.cost > best + _WORTH_ANOTHER_TRY:
                continue
            for aside in (-_ASIDE_RAD, _ASIDE_RAD):
                start = view.copy()
                start[1] += aside
                more.append(self._fit(frame, c, np.clip(start, *self._limits)))
        return more

    def _fit(self, frame: Reported, c: int, view: NDArray[np.float64]) -> tuple[int, NDArray[np.float64], _Comparison]:
        """Refine a view by Gauss-Newton steps; a step that explains the targets worse is halved."""
        longest = np.array([_LONGEST[name.rpartition("_")[2]] for name in self._free])
        here = self._compared(frame, c, view)
        for _ in range(_STEPS):
            scale = np.sqrt(np.maximum(np.diag(here.information), 1e-300))
            normal = here.information / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
            step = np.linalg.solve(normal, here.gradient / scale) / scale
            gain = float(step @ here.gradient)
            if gain < _DONE**2:
                break
            step = step / max(1.0, float((np.abs(step) / longest).max()))
            trial = view.copy()
            trial[self._columns] += step
            trial = np.clip(trial, *self._limits)
            there = self._compared(frame, c, trial)
            if there.cost > here.cost:
                trial = view.copy()
                trial[self._columns] += 0.3 * step
                there = self._compared(frame, c, np.clip(trial, *self._limits))
                if there.cost > here.cost:
                    break
            view, here = np.clip(trial, *self._limits), there
        return c, view, here

    def _lessened(
        self, frame: Reported, c: int, view: NDArray[np.float64], here: _Comparison
    ) -> tuple[int, NDArray[np.float64], _Comparison]:
        """Return the best fit, or a better one beside it, with the information that the cost about it shows."""
        for left in range(_BETTER_FITS, -1, -1):
            points, axes = points_about(view, self._columns, here.information)
            inside = (points == np.clip(points, *self._limits)).all(axis=-1)
            costs = np.full(inside.shape, np.nan)
            costs[inside] = self._costs(frame, c, points[inside])
            best = int(np.nanargmin([*costs.ravel(), here.cost]))
            if left == 0 or best == costs.size:
                break
            _, trial, there = self._fit(frame, c, points.reshape(-1, len(VIEW_FIELDS))[best])
            if there.cost >= here.cost - _BETTER:
                break
            view, here = trial, there
        return c, view, here._replace(information=lessened(here.information, axes, costs - here.cost))

    def _costs(self, frame: Reported, c: int, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what the targets cost at some views, (n,)."""
        if not len(states):
            return np.empty(0)
        expected = self._expected(self._counts(c, Views(*states.T.copy())))
        costs = (self._weight * states[:, self._columns] ** 2).sum(axis=1)
        for k in range(len(states)):
            own = ExpectedTargets(
                expected.distance_m[k : k + 1], expected.spread_m[k : k + 1], expected.sure[k : k + 1]
            )
            costs[k] += self._cost(frame, own, _NO_STEPS).cost
        return np.asarray(costs)

    def _compared(self, frame: Reported, c: int, view: NDArray[np.float64]) -> _Comparison:
        """Compare the targets with those of a view, and of views to either side."""
        steps = _WIDER * np.array([STEPS[name] for name in self._free])
        expected = self._expected(self._counts(c, views_about(view, self._free, _WIDER)))
        found = self._cost(frame, expected, steps)
        theta = view[self._columns]
        return found._replace(
            cost=found.cost + float(self._weight @ theta**2),
            information=found.information + np.diag(self._weight),
            gradient=found.gradient - self._weight * theta,
        )

    def _cost(self, frame: Reported, expected: ExpectedTargets, steps: NDArray[np.float64]) -> _Comparison:
        """Compare the targets with those that are expected at a view, and at views by some steps to either side."""
        residual, slope = np.full(len(frame.zone), np.nan), np.zeros((len(frame.zone), len(steps)))
        spread, hits = np.zeros(len(frame.zone)), np.zeros(expected.sure.shape[1:])
        _nearest(expected.distance_m, expected.spread_m, frame.zone, frame.distance_m, frame.std_m, steps, residual,
                 spread, slope, hits)  # fmt: skip
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


@kernel
def _nearest(distance, scatter, zone, reported, std, steps, residual, spread, slope, hits):  # type: ignore[no-untyped-def]
    """Fill how far each target is from the nearest one expected in its zone, and how that moves with the view.

    `hits` counts how often each expected target is the nearest one.
    """
    for k in range(len(zone)):
        here, which = math.nan, -1
        for t in range(distance.shape[2]):
            d = distance[0, zone[k], t]
            if not math.isnan(d) and not abs(reported[k] - d) >= abs(reported[k] - here):
                here, which = d, t
        if which < 0:
            continue
        residual[k], spread[k] = reported[k] - here, scatter[0, zone[k], which]
        hits[zone[k], which] += 1
        for a in range(len(steps)):
            above, below = math.nan, math.nan
            for t in range(distance.shape[2]):
                d = distance[1 + 2 * a, zone[k], t]
                if not math.isnan(d) and not abs(d - here) >= abs(above - here):
                    above = d
                d = distance[2 + 2 * a, zone[k], t]
                if not math.isnan(d) and not abs(d - here) >= abs(below - here):
                    below = d
            if not math.isnan(above) and not math.isnan(below):
                rise, fall = above - here, here - below
                if abs(rise - fall) < std[k]:
                    slope[k, a] = (rise + fall) / (2 * steps[a])
                elif rise * fall > 0:  # the estimate jumps: no more is known than what moves to either side
                    slope[k, a] = (rise if abs(rise) < abs(fall) else fall) / steps[a]


@kernel
def _node_costs(  # type: ignore[no-untyped-def]
    distance, sure, zone, reported, weight, n_frames, step, still, nearest, moves, hits, cost, shift,
):  # fmt: skip
    """Fill what the targets of every node cost once they are moved along the distance by at most half a step."""
    n_classes, n_distance, n_delta, n_zones, most = distance.shape
    for c in range(n_classes):
        for i in range(n_distance):
            for j in range(n_delta):
                total, mean = 1e-30, 0.0
                for z in range(n_zones):
                    for t in range(most):
                        hits[z, t] = 0.0
                for k in range(len(zone)):
                    nearest[k], which = math.nan, -1
                    for t in range(most):
                        d = reported[k] - distance[c, i, j, zone[k], t]
                        if not math.isnan(d) and not abs(d) >= abs(nearest[k]):
                            nearest[k], which = d, t
                    moves[k] = 1.0
                    if which >= 0:
                        hits[zone[k], which] += 1
                        for t in range(still.shape[1]):
                            if abs(distance[c, i, j, zone[k], which] - still[zone[k], t]) < 0.5 * step:
                                moves[k] = 0.0
                    if moves[k] > 0.0 and abs(nearest[k]) < 2 * step:
                        total += weight[k]
                        mean += weight[k] * nearest[k]
                mean = min(max(mean / total, -step), step)
                shift[c, i, j] = mean
                sum_of = 0.0
                for k in range(len(zone)):
                    d = nearest[k] - moves[k] * mean
                    squared = d * d * weight[k]
                    sum_of += squared if squared < 25.0 else 25.0
                for z in range(n_zones):
                    for t in range(most):
                        if sure[c, i, j, z, t]:
                            sum_of += 25.0 * max(n_frames - hits[z, t], 0.0)
                cost[c, i, j] = sum_of
