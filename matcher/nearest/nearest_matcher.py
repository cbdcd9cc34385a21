"""The paper's minimum-distance classifier (its section 4.2): the answer is the nearest model image of the bank.

The lower pixels give distance and angle, then the upper pixels give the class, and the answer lies on the bank's grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark.data import Bank
from phasemark.data.bank.bank_file import BankGroup
from phasemark.matcher.chi_squared import noise_tails, p_values_of
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.frequencies import background_of, phases_wrap
from phasemark.matcher.match import TOLERANCE_M, TOLERANCE_RAD, TOLERATED_SIGMA, Candidate, Match, Reason
from phasemark.matcher.nearest.cell_fits import CellFits, fit_cells, moved_costs
from phasemark.matcher.nearest.grid import closing_period
from phasemark.matcher.nearest.search import nearest_search
from phasemark.matcher.nearest.templates import Observation, Templates
from phasemark.matcher.pixel_agreement import DISAGREEMENT, MIN_RETURNS
from phasemark.render import Background
from phasemark.render.view import delta_period_rad, wrap_delta_difference_rad

__all__ = ["NearestMatcher"]

_FRAMES_AT_ONCE = 128
_STEPS = 4
"""How often the distance that fits best at an angle is corrected: ranges change with it about as it does itself."""
_APART_RAD = math.radians(2.0)
"""Spacing of the angles at which rivals of the nearest image are looked for."""
_Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Found:
    """The nearest template of every class: (n, classes) arrays.

    `i` and `j` index distance and angle, `cost` is the distance from the frame.
    """

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    cost: NDArray[np.float64]

    def __getitem__(self, index: _Index) -> _Found:
        return _Found(self.i[index], self.j[index], self.cost[index])


class NearestMatcher:
    """Finds the nearest image of a bank; see :class:`~phasemark.matcher.Matcher` for the parameters.

    Attributes
    ----------
    pose : Templates
        The images that give distance and angle.
    search : PrunedSearch or ExactSearch
        Finds the nearest of them.
    """

    def __init__(
        self,
        bank: Bank,
        *,
        background: Background | None = None,
        false_alarm: float = 0.01,
        tolerance_m: float = TOLERANCE_M,
        tolerance_rad: float = TOLERANCE_RAD,
    ) -> None:
        self._bank = bank
        self._tolerance_m, self._tolerance_rad = tolerance_m, tolerance_rad
        self._false_alarm = false_alarm
        self._step_m = float(np.diff(bank.distance_m).max(initial=0.0))
        self._closes = closing_period(bank.delta_rad) is not None
        self._behind = None if background is None else background_of(bank, background)
        self._symmetry = {name: int(bank.mesh(name).metadata["symmetry"]) for name in bank.classes}
        whole = bank.full or bank.lower
        assert whole is not None
        self._pose_rows = (0, bank.sensor.rows) if bank.full is not None else bank.sensor.lower_rows
        self.pose = self._templates(whole, self._pose_rows)
        self._class = None if bank.upper is None else self._templates(bank.upper, bank.sensor.upper_rows)
        self.search = nearest_search(
            self.pose, bank.distance_m, bank.delta_rad, before_background=background is not None
        )
        self._none = self._nothing()

    def match(self, frames: FilteredFrames) -> list[Match]:
        """Match filtered frames."""
        matches: list[Match] = []
        for start in range(0, len(frames), _FRAMES_AT_ONCE):
            matches.extend(self._match_some(frames[start : start + _FRAMES_AT_ONCE]))
        return matches

    def _templates(self, group: BankGroup, rows: tuple[int, int]) -> Templates:
        parts = ((some.phasor, some.coverage) for _, some in group.parts())
        return Templates.of_parts(parts, self._bank.sensor, self._behind, rows, wraps=phases_wrap(self._bank))

    def _match_some(self, frames: FilteredFrames) -> list[Match]:
        pose_seen = Observation.from_frames(frames, self._pose_rows)
        class_seen = None if self._class is None else Observation.from_frames(frames, self._bank.sensor.upper_rows)
        found = self._searched(pose_seen, class_seen)
        seen = Observation.from_frames(frames, (0, self._bank.sensor.rows))
        none_cost = self._none.costs_of_each(seen, np.zeros((len(frames), 1), np.int64))[:, 0]
        enough = pose_seen.returned.sum(axis=1) >= MIN_RETURNS
        chi2, dof = self._goodness(pose_seen, class_seen, found)
        p_value = p_values_of(chi2, dof, noise_tails(frames))
        ambiguous = np.zeros(len(frames), np.bool_)
        good = np.flatnonzero(enough & (p_value >= self._false_alarm))
        if good.size:
            its_class = None if class_seen is None else class_seen[good]
            ambiguous[good] = self._have_rivals(frames[good], pose_seen[good], its_class, found[good], chi2[good])
        nothing = Match(
            class_name=None,
            accepted=False,
            class_probability=self._probabilities(np.empty(0), 0.0),
            reason="no landmark",
        )
        return [
            self._answer(
                found, k, float(none_cost[k]), float(chi2[k]), int(dof[k]), float(p_value[k]), bool(ambiguous[k])
            )
            if enough[k]
            else nothing
            for k in range(len(frames))
        ]

    def _searched(self, pose_seen: Observation, class_seen: Observation | None) -> _Found:
        """Find the nearest image of each class; in a factored bank the nearest lower one, and the upper ones there."""
        n_class, n_distance, n_delta = len(self._bank.classes), len(self._bank.distance_m), len(self._bank.delta_rad)
        blocks = range(n_class if class_seen is None else 1)
        nearest = [self.search.nearest(pose_seen, c) for c in blocks]
        best = np.stack([found for found, _ in nearest], axis=1) - np.asarray(blocks) * n_distance * n_delta
        (i, j), cost = np.divmod(best, n_delta), np.stack([cost for _, cost in nearest], axis=1)
        if class_seen is not None:
            assert self._class is not None
            cost = cost + self._class.costs_of_each(class_seen, np.arange(n_class) * n_distance + i)
            i, j = np.repeat(i, n_class, axis=1), np.repeat(j, n_class, axis=1)
        return _Found(i, j, cost)

    def _nothing(self) -> Templates:
        """Return the one template of a scene without a landmark."""
        sensor = self._bank.sensor
        shape = 1, sensor.rows, sensor.cols
        nothing = np.zeros(shape, np.complex64), np.zeros(shape, np.float32)
        return Templates.of_parts([nothing], sensor, self._behind, (0, sensor.rows))

    def _have_rivals(
        self,
        frames: FilteredFrames,
        pose_seen: Observation,
        class_seen: Observation | None,
        found: _Found,
        chi2: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        """Return which frames a view beyond the tolerance, or of another class, explains about as well.

        At every angle the distance that fits best is asked: a flat valley along δ has no minimum of its own.
        """
        n, columns = len(frames), self._columns()
        frame, j = np.repeat(np.arange(n), len(columns)), np.tile(columns, n)
        best = np.argmin(found.cost, axis=1)
        best_i, best_j, best_cost = (values[np.arange(n), best][frame] for values in (found.i, found.j, found.cost))
        # the cost of a grid point tells roughly what a frame costs in its cell
        limit = 8.0 * (best_cost + DISAGREEMENT)
        rivalled = np.zeros(n, np.bool_)
        for c in range(len(self._bank.classes)):
            if c == 0 or class_seen is None:
                i, cost = self._best_distances(pose_seen, frame, c, found.i[:, c], j)
            is_other = (best[frame] != c) | self._far(c, i, j, best_i, best_j)
            asked = np.flatnonzero(is_other & (cost < limit))
            if class_seen is not None:
                assert self._class is not None
                of_class = self._class, class_seen, c * len(self._bank.distance_m) + i[asked]
                cost_of_class, _ = moved_costs(of_class, frame[asked], self._step_m)
                asked = asked[cost[asked] + cost_of_class < limit[asked]]
            if not asked.size:
                continue
            own = frame[asked]
            theirs, dof = self._cells(pose_seen, class_seen, own, np.full(len(own), c), i[asked], j[asked])
            along_delta = np.where(is_other, np.inf, -np.inf)
            along_delta[asked] = theirs
            is_minimum = _is_minimum(along_delta.reshape(n, len(columns)), closes=self._closes).ravel()[asked]
            as_good = theirs < chi2[own] + np.where(is_minimum, DISAGREEMENT, TOLERATED_SIGMA**2)
            # a minimum that would be accepted itself, too
            as_good |= is_minimum & (p_values_of(theirs, dof, noise_tails(frames[own])) >= self._false_alarm)
            rivalled[own[as_good]] = True
        return rivalled

    def _best_distances(
        self, seen: Observation, frame: _Index, block: int, start: _Index, j: _Index
    ) -> tuple[_Index, NDArray[np.float64]]:
        """Return which distances fit frames best at angles, and what they cost about there; (m,) each."""
        distance_m, n_delta = self._bank.distance_m, len(self._bank.delta_rad)
        between = (distance_m[1:] + distance_m[:-1]) / 2
        i = start[frame]
        for _ in range(_STEPS):
            at = (block * len(distance_m) + i) * n_delta + j
            _, moved_m = moved_costs((self.pose, seen, at), frame, math.inf)
            i = np.searchsorted(between, distance_m[i] + moved_m)
        at = (block * len(distance_m) + i) * n_delta + j
        cost, _ = moved_costs((self.pose, seen, at), frame, self._step_m)
        return i, cost

    def _columns(self) -> _Index:
        """Return which angles of the grid are asked for rivals."""
        delta_rad = self._bank.delta_rad
        step = np.diff(delta_rad).min(initial=_APART_RAD)
        return np.arange(0, len(delta_rad), max(int(_APART_RAD / step + 1e-9), 1))

    def _far(self, class_index: int, i: _Index, j: _Index, of_i: _Index, of_j: _Index) -> NDArray[np.bool_]:
        """Return which views of the grid are beyond the tolerance, and more than a cell, from others."""
        bank = self._bank
        period = delta_period_rad(self._symmetry[bank.classes[class_index]])
        along = np.abs(bank.distance_m[i] - bank.distance_m[of_i])
        around = np.abs(wrap_delta_difference_rad(bank.delta_rad[j] - bank.delta_rad[of_j], period))
        far_along = (along > self._tolerance_m) & (np.abs(i - of_i) > 1)
        return np.asarray(far_along | ((around > self._tolerance_rad) & (np.abs(j - of_j) > 1)))

    def _answer(
        self, found: _Found, k: int, none_cost: float, chi2: float, dof: int, p_value: float, ambiguous: bool
    ) -> Match:
        """Turn what was found for one frame into an answer."""
        order = np.argsort(found.cost[k], kind="stable")
        candidates = tuple(
            Candidate(
                self._bank.classes[c],
                float(self._bank.distance_m[found.i[k, c]]),
                float(self._bank.delta_rad[found.j[k, c]]),
                float(found.cost[k, c]),
            )
            for c in order
        )
        best = candidates[0]
        is_landmark = best.cost < none_cost
        reason: Reason = "ambiguous" if ambiguous else ""
        if not is_landmark:
            reason = "no landmark"
        elif p_value < self._false_alarm:
            reason = "poor fit"
        return Match(
            class_name=best.class_name if is_landmark else None,
            accepted=not reason,
            distance_m=best.distance_m,
            delta_rad=best.delta_rad,
            chi2=chi2,
            dof=dof,
            p_value=p_value,
            class_probability=self._probabilities(found.cost[k], none_cost),
            alternatives=candidates[1:] if is_landmark else candidates,
            symmetry=self._symmetry[best.class_name],
            reason=reason,
        )

    def _probabilities(self, cost: NDArray[np.float64], none_cost: float) -> dict[str, float]:
        """Weigh classes and "none" by exp(−cost / 2), as Gaussian residuals and equal priors have it.

        Without costs "none" is certain.
        """
        names = [*self._bank.classes, "none"]
        values = np.full(len(names), np.inf)
        values[: len(cost)], values[-1] = cost, none_cost
        weight = np.exp(-0.5 * (values - values.min()))
        return dict(zip(names, (weight / weight.sum()).tolist(), strict=True))

    def _goodness(self, pose_seen: Observation, class_seen: Observation | None, found: _Found) -> CellFits:
        """Return χ² and degrees of freedom of the best images, the linear change in a cell taken out; (n,) each."""
        frame, c = np.arange(len(found.cost)), np.argmin(found.cost, axis=1)
        return self._cells(pose_seen, class_seen, frame, c, found.i[frame, c], found.j[frame, c])

    def _cells(
        self,
        pose_seen: Observation,
        class_seen: Observation | None,
        frame: _Index,
        c: _Index,
        i: _Index,
        j: _Index,
    ) -> CellFits:
        """Fit frames in the cells around grid points, (m,) each."""
        n_distance, n_delta = len(self._bank.distance_m), len(self._bank.delta_rad)
        rows = np.stack([i, np.maximum(i - 1, 0), np.minimum(i + 1, n_distance - 1), i, i], axis=-1)
        columns = np.stack([j, j, j, j - 1, j + 1], axis=-1)
        columns = columns % n_delta if self._closes else np.clip(columns, 0, n_delta - 1)
        of_class = c[:, None] * n_distance + rows
        groups = [(self.pose, pose_seen, (of_class if class_seen is None else rows) * n_delta + columns)]
        if class_seen is not None:
            assert self._class is not None
            groups.append((self._class, class_seen, of_class))
        return fit_cells(groups, frame)


def _is_minimum(values: NDArray[np.float64], *, closes: bool) -> NDArray[np.bool_]:
    """Return which values are no higher than those beside them, along the last axis, whose ends may be joined."""
    before, behind = np.roll(values, 1, axis=-1), np.roll(values, -1, axis=-1)
    if not closes:
        before[..., 0] = behind[..., -1] = np.inf
    return np.asarray((values <= before) & (values <= behind))
