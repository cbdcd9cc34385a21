"""Class and view of a landmark from the targets that a direct sensor's chip reports (PHYSICS sections 7 and 11).

The expected report is computed from the expected counts by the chip's own estimator: merged peaks and estimates drawn
to one side follow by themselves. A target is compared with the nearest one expected in its zone, with the sigma that
came with it. A target that must be seen and is missing, and one that nothing explains, cost a disagreement. Chips
report peaks of the noise too: how many of these are expected follows from the ambient light and the threshold.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.matcher.histograms.histogram_matcher import check_histogram_sensor, view_limits
from phasemark.matcher.histograms.histogram_table import build_table, plan_table
from phasemark.matcher.histograms.table_search import grid_minima
from phasemark.matcher.histograms.view_answers import Explanation, FitTest, Rules, answer_of, no_answer
from phasemark.matcher.histograms.view_signals import STEPS, ViewSignals
from phasemark.matcher.match import Match
from phasemark.matcher.pixel_agreement import DISAGREEMENT
from phasemark.render import Sensor, Views
from phasemark.render.direct.bin_counts import detected_counts
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.targets import Status, Targets, find_targets
from phasemark.render.kernel import kernel
from phasemark.render.view import VIEW_FIELDS

_FAINT, _SURE = 0.5, 2.0
"""A peak above this share of the threshold may be reported, one above that multiple must be."""
_GRID_STD_M = 0.01
"""How far a target may be off between nodes of the table: added to sigmas in the search alone."""
_MOST_STARTS, _MINIMA = 6, 2
_STEPS = 6
_DONE = 0.1
_LEAST_STD_M = 1e-5
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
    seen : (zones,) float64
        In what share of the frames a zone has a target.
    n_frames : int
    """

    zone: NDArray[np.int64]
    distance_m: NDArray[np.float64]
    std_m: NDArray[np.float64]
    seen: NDArray[np.float64]
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
    bank, free, prior_std, rules, workers
        As for :class:`~phasemark.matcher.histograms.histogram_matcher.HistogramMatcher`.
    """

    def __init__(
        self, bank: Bank, *, free: tuple[str, ...], prior_std: Sequence[float], rules: Rules, workers: int = 1
    ) -> None:
        self.sensor = bank.camera
        check_histogram_sensor(bank)
        self._free, self._rules, self._workers = free, rules, workers
        self._weight = 1 / np.array(prior_std, dtype=np.float64) ** 2
        self._columns = [VIEW_FIELDS.index(name) for name in free]
        meshes = [bank.mesh(name) for name in bank.classes]
        self.signals = [ViewSignals(mesh, self.sensor, float(mesh.metadata["albedo"])) for mesh in meshes]
        self.grid = plan_table(self.signals, bank.distance_m, bank.delta_rad, math.gcd(*rules.symmetry))
        self._limits = view_limits(self.grid)
        self._faint, self._sure = (_with_threshold(self.sensor, share) for share in (_FAINT, _SURE))

    @property
    def table_bytes(self) -> int:
        """How large the histograms are that the table of targets is made of; they are not kept."""
        return self.grid.n_bytes(self.sensor, len(self.signals))

    @cached_property
    def table(self) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Targets that are expected on the grid, (classes, distances, angles, zones, targets), and which are sure."""
        counts = build_table(self.signals, self.grid, 0.0, self._workers)
        shape = counts.signal.shape[:4]
        bins, most = histogram_of(self.sensor).bins, histogram_of(self.sensor).max_targets
        distance, sure = np.empty((*shape, most), np.float32), np.empty(shape, np.bool_)
        for c in range(shape[0]):
            for i, first in enumerate(counts.first_bin):
                low, high = max(int(first), 0), min(int(first) + self.grid.window, bins)
                signal = np.zeros((shape[2], shape[3], bins))
                signal[:, :, low:high] = counts.signal[c, i, :, :, low - first : high - first]
                distance[c, i], sure[c, i] = self._expected(signal)
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
        return Reported(zone, distance[valid], np.maximum(std, _LEAST_STD_M), valid.any(axis=2).mean(axis=0), n_frames)

    def _usual_std(self) -> float:
        """Return the standard deviation of a target that was reported without one."""
        std = self.sensor.range_std_m
        return std if std else histogram_of(self.sensor).bin_width_m / math.sqrt(12)

    def _expected(self, signal: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the targets that may be reported of signal counts, (n, zones, targets), and where one must be."""
        counts = detected_counts(signal, self.sensor).reshape(
            len(signal), 1, self.sensor.rows, self.sensor.cols, signal.shape[-1]
        )
        n_zones = signal.shape[1]
        faint = find_targets(SimpleNamespace(counts=counts, sensor=self._faint))
        sure = find_targets(SimpleNamespace(counts=counts, sensor=self._sure))
        distance = faint.distance_m.reshape(len(signal), n_zones, -1)
        return distance, np.isfinite(sure.distance_m).any(axis=-1).reshape(len(signal), n_zones)

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
            return no_answer(self._rules, self._free)
        fits = [self._fit(frame, c, view) for c, view in self._starts(frame)]
        best_index = int(np.argmin([comparison.cost for _, _, comparison in fits]))
        found = [Explanation(c, view, comparison.cost, comparison.information) for c, view, comparison in fits]
        best = fits[best_index][2]
        n = frame.n_frames
        expected = n * self._false_targets
        bare = _unexplained_cost(len(frame.zone), expected)
        dof = best.n_compared - len(self._free)
        p_fit = float(special.chdtrc(dof, best.chi2)) if dof > 0 else 0.0
        p_count = float(special.pdtrc(best.n_wrong - 1, max(expected, 0.05))) if best.n_wrong else 1.0
        test = FitTest(best.chi2, max(dof, 0), min(1.0, 2 * min(p_fit, p_count)))
        doubt = best.cost - best.chi2 + float(special.chdtri(max(dof, 1), self._rules.false_alarm))
        return answer_of(self._rules, self._free, found, test, bare, doubt)

    def _starts(self, frame: Reported) -> list[tuple[int, NDArray[np.float64]]]:
        """Return the views that explain the targets best, each class with its two best hills, best first."""
        distance, sure = self.table
        cost, shift = np.empty(distance.shape[:3]), np.empty(distance.shape[:3])
        step = float(self.grid.distance_m[1] - self.grid.distance_m[0])
        variance = frame.std_m**2 + _GRID_STD_M**2
        _node_costs(distance, sure, frame.zone, frame.distance_m, 1 / variance, frame.seen, frame.n_frames, step,
                    np.empty(len(frame.zone)), cost, shift)  # fmt: skip
        starts = []
        for c in range(len(cost)):
            for i, j in grid_minima(cost[c], self.grid.cyclic, _MINIMA):
                view = np.zeros(len(VIEW_FIELDS))
                view[0] = self.grid.distance_m[i] + shift[c, i, j]
                view[1] = self.grid.delta_rad[j]
                starts.append((c, view, float(cost[c, i, j])))
        starts.sort(key=lambda start: start[2])
        return [(c, np.clip(view, *self._limits)) for c, view, _ in starts[:_MOST_STARTS]]

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

    def _compared(self, frame: Reported, c: int, view: NDArray[np.float64]) -> _Comparison:
        """Compare the targets with those of a view, and of views to either side."""
        p = len(self._free)
        moved = np.repeat(view[None], 2 * p + 1, axis=0)
        for k, name in enumerate(self._free):
            moved[1 + 2 * k, self._columns[k]] += _WIDER * STEPS[name]
            moved[2 + 2 * k, self._columns[k]] -= _WIDER * STEPS[name]
        distance, sure = self._expected(self.signals[c].counts(Views(*moved.T.copy())))
        residual, slope = np.full(len(frame.zone), np.nan), np.zeros((len(frame.zone), p))
        steps = _WIDER * np.array([STEPS[name] for name in self._free])
        _nearest(distance, frame.zone, frame.distance_m, steps, residual, slope)
        squared = (residual / frame.std_m) ** 2
        right = squared < DISAGREEMENT  # False where nothing is expected
        missing = float(((1 - frame.seen) * frame.n_frames)[sure[0]].sum())
        weighted = slope[right] / frame.std_m[right, None]
        theta = view[self._columns]
        n_wrong = int((~right).sum() + round(missing))
        chi2 = float(squared[right].sum())
        expected = frame.n_frames * self._false_targets
        cost = chi2 + _unexplained_cost(int((~right).sum()), expected) + DISAGREEMENT * missing
        return _Comparison(
            cost + float(self._weight @ theta**2),
            chi2,
            int(right.sum()),
            n_wrong,
            weighted.T @ weighted + np.diag(self._weight),
            weighted.T @ (residual[right] / frame.std_m[right]) - self._weight * theta,
        )


def _unexplained_cost(n: int, expected: float) -> float:
    """Return what targets cost that nothing explains: little while the noise is expected to make as many."""
    tolerated = expected + 3 * math.sqrt(expected)
    return 2 * min(n, tolerated) + DISAGREEMENT * max(n - tolerated, 0.0)


def _with_threshold(sensor: Sensor, share: float) -> Sensor:
    """Return a sensor whose chip reports peaks above a share of the threshold."""
    histogram = histogram_of(sensor)
    return sensor.with_(histogram={**histogram.model_dump(), "threshold": share * histogram.threshold})


@kernel
def _nearest(distance, zone, reported, steps, residual, slope):  # type: ignore[no-untyped-def]
    """Fill how far each target is from the nearest one expected in its zone, and how that moves with the view."""
    for k in range(len(zone)):
        here = math.nan
        for t in range(distance.shape[2]):
            d = distance[0, zone[k], t]
            if not math.isnan(d) and not abs(reported[k] - d) >= abs(reported[k] - here):
                here = d
        if math.isnan(here):
            continue
        residual[k] = reported[k] - here
        for a in range(len(steps)):
            above, below = math.nan, math.nan
            for t in range(distance.shape[2]):
                d = distance[1 + 2 * a, zone[k], t]
                if not math.isnan(d) and not abs(d - here) >= abs(above - here):
                    above = d
                d = distance[2 + 2 * a, zone[k], t]
                if not math.isnan(d) and not abs(d - here) >= abs(below - here):
                    below = d
            change = (above - below) / (2 * steps[a])
            if not math.isnan(change):
                slope[k, a] = change


@kernel
def _node_costs(  # type: ignore[no-untyped-def]
    distance, sure, zone, reported, weight, seen, n_frames, step, nearest, cost, shift,
):  # fmt: skip
    """Fill what the targets of every node cost once they are moved along the distance by at most half a step."""
    n_classes, n_distance, n_delta, n_zones, most = distance.shape
    for c in range(n_classes):
        for i in range(n_distance):
            for j in range(n_delta):
                total, mean = 1e-30, 0.0
                for k in range(len(zone)):
                    nearest[k] = math.nan
                    for t in range(most):
                        d = reported[k] - distance[c, i, j, zone[k], t]
                        if not math.isnan(d) and not abs(d) >= abs(nearest[k]):
                            nearest[k] = d
                    if abs(nearest[k]) < 2 * step:
                        total += weight[k]
                        mean += weight[k] * nearest[k]
                mean = min(max(mean / total, -step), step)
                shift[c, i, j] = mean
                sum_of = 0.0
                for k in range(len(zone)):
                    d = nearest[k] - mean
                    squared = d * d * weight[k]
                    sum_of += squared if squared < 25.0 else 25.0
                for z in range(n_zones):
                    if sure[c, i, j, z]:
                        sum_of += 25.0 * (1.0 - seen[z]) * n_frames
                cost[c, i, j] = sum_of
