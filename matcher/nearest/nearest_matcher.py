"""The paper's minimum-distance classifier (its section 4.2): the answer is the nearest model image of the bank.

The lower pixels give distance and angle, then the upper pixels give the class, and the answer lies on the bank's grid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.data import Bank
from phasemark.data.bank.bank_file import BankGroup
from phasemark.matcher.chi_squared import noise_tails, p_values_of
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.frequencies import background_of, phases_wrap
from phasemark.matcher.match import TOLERANCE_M, TOLERANCE_RAD, TOLERATED_SIGMA, Candidate, Match, Reason
from phasemark.matcher.nearest.cell_fits import CellFits, best_moves, fit_cells, follow_distance, moved_costs
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
_FACTOR = 8.0
"""What a rival costs at most about its grid point, over what the answer does: the fit in its cell tells more."""
_Index = NDArray[np.int64]
_Seen = Sequence[Observation]
"""What each part of the bank is compared with."""


class _Part(NamedTuple):
    """Templates of the pixels that give distance and angle, or of the upper ones, which tell the class."""

    templates: Templates
    follows: NDArray[np.bool_]
    rows: tuple[int, int]


@dataclass(frozen=True, eq=False)
class _Found:
    """The nearest template of every class: (n, classes) arrays, and which class fits best, (n,).

    `i` and `j` index distance and angle, `chi2`, `dof` and `cost` are of the fit in the template's cell: a grid that is
    coarse against the noise has no image near a frame. `offset`, (n, classes, 2), is where that fit leads to.
    """

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    chi2: NDArray[np.float64]
    dof: NDArray[np.int64]
    cost: NDArray[np.float64]
    offset: NDArray[np.float64]
    best: NDArray[np.int64]

    def __getitem__(self, index: _Index | int) -> _Found:
        return _Found(*(getattr(self, one.name)[index] for one in fields(self)))

    def of_best(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the values, (n, classes), of the class that fits best."""
        return values[np.arange(len(self.best)), self.best]


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
        radii = [np.linalg.norm(bank.mesh(name).vertices[:, :2], axis=1).max() for name in bank.classes]
        self._size_m = 2 * float(max(radii))
        self._turned_m = float(max(radii)) * float(np.diff(bank.delta_rad).max(initial=0.0)) / 2
        self._closes = closing_period(bank.delta_rad) is not None
        self._behind = None if background is None else background_of(bank, background)
        self._symmetry = {name: int(bank.mesh(name).metadata["symmetry"]) for name in bank.classes}
        whole, sensor = bank.full or bank.lower, bank.sensor
        assert whole is not None
        rows = (0, sensor.rows) if bank.full is not None else sensor.lower_rows
        self._parts = [self._part(whole, rows, len(bank.delta_rad))]
        if bank.upper is not None:
            self._parts.append(self._part(bank.upper, sensor.upper_rows, 1))
        self._is_factored, self.pose = len(self._parts) > 1, self._parts[0].templates
        self.search = nearest_search(
            self.pose, bank.distance_m, bank.delta_rad, before_background=background is not None
        )
        shape = 1, sensor.rows, sensor.cols
        nothing = np.zeros(shape, np.complex64), np.zeros(shape, np.float32)
        self._none = Templates.of_parts([nothing], sensor, self._behind, (0, sensor.rows))

    def match(self, frames: FilteredFrames) -> list[Match]:
        """Match filtered frames."""
        matches: list[Match] = []
        for start in range(0, len(frames), _FRAMES_AT_ONCE):
            matches.extend(self._match_some(frames[start : start + _FRAMES_AT_ONCE]))
        return matches

    def _part(self, group: BankGroup, rows: tuple[int, int], angles: int) -> _Part:
        parts, bank = ((some.phasor, some.coverage) for _, some in group.parts()), self._bank
        templates = Templates.of_parts(parts, bank.sensor, self._behind, rows, wraps=phases_wrap(bank))
        return _Part(templates, follow_distance(templates, bank.distance_m, angles), rows)

    def _match_some(self, frames: FilteredFrames) -> list[Match]:
        seen = [Observation.from_frames(frames, part.rows) for part in self._parts]
        found = self._searched(seen)
        whole = Observation.from_frames(frames, (0, self._bank.sensor.rows))
        none_cost = self._none.costs_of_each(whole, np.zeros((len(frames), 1), np.int64))[:, 0]
        enough = seen[0].returned.sum(axis=1) >= MIN_RETURNS
        p_value = p_values_of(found.of_best(found.chi2), found.of_best(found.dof), noise_tails(frames))
        ambiguous = np.zeros(len(frames), np.bool_)
        good = np.flatnonzero(enough & (p_value >= self._false_alarm))
        if good.size:
            ambiguous[good] = self._have_rivals(frames[good], [own[good] for own in seen], found[good])
        none = self._probabilities(np.empty(0), 0.0)
        nothing = Match(class_name=None, accepted=False, class_probability=none, reason="no landmark")
        return [
            self._answer(found[k], float(none_cost[k]), float(p_value[k]), bool(ambiguous[k])) if enough[k] else nothing
            for k in range(len(frames))
        ]

    def _searched(self, seen: _Seen) -> _Found:
        """Find the nearest image of each class; in a factored bank the nearest lower one, and the upper ones there."""
        n_class, n_distance, n_delta = len(self._bank.classes), len(self._bank.distance_m), len(self._bank.delta_rad)
        blocks = range(1 if self._is_factored else n_class)
        nearest = [self.search.nearest(seen[0], c)[0] for c in blocks]
        best = np.stack(nearest, axis=1) - np.asarray(blocks) * n_distance * n_delta
        i, j = np.divmod(np.broadcast_to(best, (len(best), n_class)), n_delta)
        frame, c = (index.ravel() for index in np.indices(i.shape))
        fits = self._cells(seen, frame, c, i.ravel(), j.ravel())
        cost = fits.cost.reshape(i.shape)
        chi2, dof, offset = fits.chi2.reshape(i.shape), fits.dof.reshape(i.shape), fits.offset.reshape(*i.shape, 2)
        return _Found(i, j, chi2, dof, cost, offset, np.argmin(cost, axis=1))

    def _have_rivals(self, frames: FilteredFrames, seen: _Seen, found: _Found) -> NDArray[np.bool_]:
        """Return which frames a view beyond the tolerance, or of another class, explains about as well.

        At every angle the distance that fits best is asked: a flat valley along δ has no minimum of its own.
        """
        n, best, best_cost = len(frames), found.best, found.of_best(found.cost)
        # the cost about a grid point tells roughly what a frame costs in its cell
        limit = _FACTOR * (self._costs_of_best(seen, found) + DISAGREEMENT)
        rivalled = np.zeros(n, np.bool_)
        for c in range(len(self._bank.classes)):
            if c == 0 or not self._is_factored:
                columns = self._columns(c)
                frame, j = np.repeat(np.arange(n), len(columns)), np.tile(columns, n)
                best_i, best_j = (found.of_best(values)[frame] for values in (found.i, found.j))
                i, cost = self._best_distances(seen[0], frame, c, found.i[:, c], j)
            is_other = (best[frame] != c) | self._far(c, i, j, best_i, best_j)
            asked = np.flatnonzero(is_other & (cost < limit[frame]))
            if self._is_factored:
                cost_of_class = self._costs_about(1, seen[1], c * len(self._bank.distance_m) + i[asked], frame[asked])
                asked = asked[cost[asked] + cost_of_class < limit[frame[asked]]]
            if not asked.size:
                continue
            own = frame[asked]
            theirs = self._cells(seen, own, np.full(len(own), c), i[asked], j[asked])
            along_delta = np.where(is_other, np.inf, -np.inf)
            along_delta[asked] = theirs.cost
            is_minimum = _is_minimum(along_delta.reshape(n, len(columns)), closes=self._closes).ravel()[asked]
            as_good = theirs.cost < best_cost[own] + np.where(is_minimum, DISAGREEMENT, TOLERATED_SIGMA**2)
            # a minimum that would be accepted itself, too
            as_good |= is_minimum & (
                p_values_of(theirs.chi2, theirs.dof, noise_tails(frames[own])) >= self._false_alarm
            )
            rivalled[own[as_good]] = True
        return rivalled

    def _best_distances(
        self, seen: Observation, frame: _Index, block: int, start: _Index, j: _Index
    ) -> tuple[_Index, NDArray[np.float64]]:
        """Return which distances fit frames best at angles, and what they cost about there; (m,) each.

        Pixels that are farther off than the landmark is wide say nothing, and half of that in each step that follows.
        """
        distance_m, n_delta = self._bank.distance_m, len(self._bank.delta_rad)
        between = (distance_m[1:] + distance_m[:-1]) / 2
        i, first = start[frame], block * len(distance_m)
        for step in range(_STEPS):
            group = self.pose, seen, (first + i) * n_delta + j
            moved_m = best_moves(group, self._parts[0].follows, frame, self._size_m / 2**step)
            i = np.searchsorted(between, distance_m[i] + moved_m)
        return i, self._costs_about(0, seen, (first + i) * n_delta + j, frame)

    def _costs_about(self, part: int, seen: Observation, at: _Index, frame: _Index) -> NDArray[np.float64]:
        """Return what pixels of frames cost about points of the grid, at the best distance there; (m,)."""
        templates, follows, _ = self._parts[part]
        moved_m = best_moves((templates, seen, at), follows, frame, self._size_m).clip(-self._step_m, self._step_m)
        return moved_costs((templates, seen, at), follows, frame, moved_m, self._turned_m)

    def _costs_of_best(self, seen: _Seen, found: _Found) -> NDArray[np.float64]:
        """Return what frames cost about their best grid points, (n,)."""
        n, i = np.arange(len(found.best)), found.of_best(found.i)
        of_class = found.best * len(self._bank.distance_m) + i
        at = (i if self._is_factored else of_class) * len(self._bank.delta_rad) + found.of_best(found.j)
        cost = self._costs_about(0, seen[0], at, n)
        return cost + self._costs_about(1, seen[1], of_class, n) if self._is_factored else cost

    def _columns(self, class_index: int) -> _Index:
        """Return which angles of the grid are asked for rivals: over a period of the class, or of the lower part."""
        delta_rad = self._bank.delta_rad
        symmetry = 1 if self._is_factored else self._symmetry[self._bank.classes[class_index]]
        n = np.searchsorted(delta_rad, delta_rad[0] + delta_period_rad(symmetry) - 1e-9)
        step = np.diff(delta_rad).min(initial=_APART_RAD)
        return np.arange(0, max(n, 1), max(int(_APART_RAD / step + 1e-9), 1))

    def _far(self, class_index: int, i: _Index, j: _Index, of_i: _Index, of_j: _Index) -> NDArray[np.bool_]:
        """Return which views of the grid are beyond the tolerance, and more than a cell, from others."""
        bank = self._bank
        period = delta_period_rad(self._symmetry[bank.classes[class_index]])
        along = np.abs(bank.distance_m[i] - bank.distance_m[of_i])
        around = np.abs(wrap_delta_difference_rad(bank.delta_rad[j] - bank.delta_rad[of_j], period))
        far_along = (along > self._tolerance_m) & (np.abs(i - of_i) > 1)
        return np.asarray(far_along | ((around > self._tolerance_rad) & (np.abs(j - of_j) > 1)))

    def _answer(self, found: _Found, none_cost: float, p_value: float, ambiguous: bool) -> Match:
        """Turn what was found for one frame into an answer."""
        order = np.argsort(found.cost, kind="stable")
        candidates = tuple(
            Candidate(
                self._bank.classes[c],
                float(self._bank.distance_m[found.i[c]]),
                float(self._bank.delta_rad[found.j[c]]),
                float(found.cost[c]),
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
        elif self._is_outside(found):
            reason = "outside the bank"
        return Match(
            class_name=best.class_name if is_landmark else None,
            accepted=not reason,
            distance_m=best.distance_m,
            delta_rad=best.delta_rad,
            chi2=float(found.chi2[found.best]),
            dof=int(found.dof[found.best]),
            p_value=p_value,
            class_probability=self._probabilities(found.cost, none_cost),
            alternatives=candidates[1:] if is_landmark else candidates,
            symmetry=self._symmetry[best.class_name],
            reason=reason,
        )

    def _is_outside(self, found: _Found) -> bool:
        """Return whether the best fit of one frame leads more than half a step beyond an end of the grid."""
        beyond = 0.5
        ends = [(found.i, len(self._bank.distance_m), False), (found.j, len(self._bank.delta_rad), self._closes)]
        for (index, n, closes), steps in zip(ends, found.offset[found.best], strict=True):
            at = index[found.best]
            if not closes and ((at == 0 and steps < -beyond) or (at == n - 1 and steps > beyond)):
                return True
        return False

    def _probabilities(self, cost: NDArray[np.float64], none_cost: float) -> dict[str, float]:
        """Weigh classes and "none" by exp(−cost / 2), as Gaussian residuals and equal priors have it.

        Without costs "none" is certain.
        """
        names = [*self._bank.classes, "none"]
        values = np.full(len(names), np.inf)
        values[: len(cost)], values[-1] = cost, none_cost
        weight = np.exp(-0.5 * (values - values.min()))
        return dict(zip(names, (weight / weight.sum()).tolist(), strict=True))

    def _cells(self, seen: _Seen, frame: _Index, c: _Index, i: _Index, j: _Index) -> CellFits:
        """Fit frames in the cells around grid points, (m,) each."""
        n_distance, n_delta = len(self._bank.distance_m), len(self._bank.delta_rad)
        rows = np.stack([i, np.maximum(i - 1, 0), np.minimum(i + 1, n_distance - 1), i, i], axis=-1)
        columns = np.stack([j, j, j, j - 1, j + 1], axis=-1)
        columns = columns % n_delta if self._closes else np.clip(columns, 0, n_delta - 1)
        of_class = c[:, None] * n_distance + rows
        groups = [(self.pose, seen[0], (rows if self._is_factored else of_class) * n_delta + columns)]
        if self._is_factored:
            groups.append((self._parts[1].templates, seen[1], of_class))
        return fit_cells(groups, frame)


def _is_minimum(values: NDArray[np.float64], *, closes: bool) -> NDArray[np.bool_]:
    """Return which values are no higher than those beside them, along the last axis, whose ends may be joined."""
    before, behind = np.roll(values, 1, axis=-1), np.roll(values, -1, axis=-1)
    if not closes:
        before[..., 0] = behind[..., -1] = np.inf
    return np.asarray((values <= before) & (values <= behind))
