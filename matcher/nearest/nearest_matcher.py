"""The paper's minimum-distance classifier (its section 4.2): the answer is the nearest model image of the bank.

The lower pixels give distance and angle, then the upper pixels give the class, and the answer lies on the bank's grid.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from phasemark.data import Bank
from phasemark.data.bank.bank_file import BankGroup
from phasemark.matcher.chi_squared import noise_tails, p_values_of
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.frequencies import background_of, phases_wrap
from phasemark.matcher.match import TOLERANCE_M, TOLERANCE_RAD, Candidate, Match, Reason
from phasemark.matcher.nearest.search import lowest, nearest_search
from phasemark.matcher.nearest.templates import Observation, Templates
from phasemark.matcher.pixel_agreement import DISAGREEMENT, MIN_RETURNS
from phasemark.render import Background
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.view import delta_period_rad, wrap_delta_difference_rad

__all__ = ["NearestMatcher"]

_FRAMES_AT_ONCE = 128
_Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Found:
    """The nearest template of every class: (n, classes) arrays.

    `i` and `j` index distance and angle, `cost` is the distance from the frame. `minima` holds, by block of the bank,
    the lowest minima that the search ended at and their costs, (n, k) each.
    """

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    cost: NDArray[np.float64]
    minima: tuple[tuple[NDArray[np.int64], NDArray[np.float64]], ...] = ()


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
        good = enough & (p_value >= self._false_alarm)
        ambiguous = self._is_ambiguous(frames, pose_seen, class_seen, found, good, chi2)
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
        minima = tuple(self.search.minima(pose_seen, c) for c in range(n_class if class_seen is None else 1))
        nearest = [lowest(*some) for some in minima]
        best = np.stack([found for found, _ in nearest], axis=1) - np.arange(len(minima)) * n_distance * n_delta
        (i, j), cost = np.divmod(best, n_delta), np.stack([cost for _, cost in nearest], axis=1)
        if class_seen is not None:
            assert self._class is not None
            cost = cost + self._class.costs_of_each(class_seen, np.arange(n_class) * n_distance + i)
            i, j = np.repeat(i, n_class, axis=1), np.repeat(j, n_class, axis=1)
        return _Found(i, j, cost, minima)

    def _nothing(self) -> Templates:
        """Return the one template of a scene without a landmark."""
        sensor = self._bank.sensor
        shape = 1, sensor.rows, sensor.cols
        nothing = np.zeros(shape, np.complex64), np.zeros(shape, np.float32)
        return Templates.of_parts([nothing], sensor, self._behind, (0, sensor.rows))

    def _is_ambiguous(
        self,
        frames: FilteredFrames,
        pose_seen: Observation,
        class_seen: Observation | None,
        found: _Found,
        which: NDArray[np.bool_],
        chi2: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        """Return which frames a view of the same class beyond the tolerance explains as well, or acceptably."""
        ambiguous = np.zeros(len(frames), np.bool_)
        best = np.argmin(found.cost, axis=1)
        n_distance, n_delta = len(self._bank.distance_m), len(self._bank.delta_rad)
        # ratio of costs on the grid up to which another minimum may, between grid points, explain a frame as well
        worth_a_look = 4.0
        for c in range(len(self._bank.classes)):
            own = np.flatnonzero(which & (best == c))
            if not own.size:
                continue
            block = c if class_seen is None else 0
            at, cost = (values[own] for values in found.minima[block])
            i, j = np.divmod(at - block * n_distance * n_delta, n_delta)
            # a grid point is off its minimum: how much a frame costs between points is known from the best one
            near = cost < worth_a_look * (found.cost[own, c, None] + DISAGREEMENT)
            k, m = np.nonzero(near & self._far(c, i, j, found.i[own, c, None], found.j[own, c, None]))
            if not k.size:
                continue
            frame = own[k]
            shape = len(k), len(self._bank.classes)
            others = _Found(np.zeros(shape, np.int64), np.zeros(shape, np.int64), np.full(shape, np.inf))
            others.i[:, c], others.j[:, c], others.cost[:, c] = i[k, m], j[k, m], cost[k, m]
            theirs, dof = self._goodness(pose_seen[frame], None if class_seen is None else class_seen[frame], others)
            as_good = theirs < chi2[frame] + DISAGREEMENT
            as_good |= p_values_of(theirs, dof, noise_tails(frames[frame])) >= self._false_alarm
            ambiguous[frame[as_good]] = True
        return ambiguous

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

    def _goodness(
        self, pose_seen: Observation, class_seen: Observation | None, found: _Found
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return χ² and degrees of freedom of the best images, the linear change in a cell taken out; (n,) each."""
        c = np.argmin(found.cost, axis=1)
        i, j = (np.take_along_axis(index, c[:, None], axis=1)[:, 0] for index in (found.i, found.j))
        cells = self._cells_at(pose_seen, c if class_seen is None else np.zeros_like(c), i, j)
        if class_seen is not None:
            assert self._class is not None
            n_distance = len(self._bank.distance_m)
            cells = cells.beside(_Cells.of(self._class, class_seen, c[:, None] * n_distance + self._rows_around(i)))
        chi2, n_fitted = cells.chi2()
        return chi2, np.maximum(n_fitted - 2, 0)

    def _rows_around(self, i: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the indices of distance of grid points and of their neighbours, (n, 5)."""
        last = len(self._bank.distance_m) - 1
        return np.stack([i, np.maximum(i - 1, 0), np.minimum(i + 1, last), i, i], axis=1)

    def _cells_at(
        self, seen: Observation, block: NDArray[np.int64], i: NDArray[np.int64], j: NDArray[np.int64]
    ) -> _Cells:
        """Return the cells around a grid point for each frame, of the templates that give distance and angle."""
        n_distance, n_delta = len(self._bank.distance_m), len(self._bank.delta_rad)
        columns = np.stack([j, j, j, (j - 1) % n_delta, (j + 1) % n_delta], axis=1)
        at = (block[:, None] * n_distance + self._rows_around(i)) * n_delta + columns
        return _Cells.of(self.pose, seen, at)


@dataclass(frozen=True, eq=False)
class _Cells:
    """Residuals of n frames at a grid point each, and how their models change over the cell; (n, pixels) arrays.

    `variance` is infinite where frame and models cannot be compared. `slope` is the change of range over one step of
    distance and of angle, (n, pixels, 2); `bend` what a linear change leaves over half a step; `disagrees` counts a
    pixel whose return the model contradicts at the grid point and at all its neighbours.
    """

    residual: NDArray[np.float64]
    variance: NDArray[np.float64]
    slope: NDArray[np.float64]
    bend: NDArray[np.float64]
    disagrees: NDArray[np.bool_]

    @classmethod
    def of(cls, templates: Templates, seen: Observation, at: NDArray[np.integer]) -> _Cells:
        """Look at grid points `at`, (n, 5): the point itself, then its neighbours in distance and in angle."""
        may, must = templates.may_return[at], templates.must_return[at]
        usable = seen.returned & may.all(axis=1)
        model = templates.range_m[at].astype(np.float64)
        step = wrap_difference_m(model[:, 1:] - model[:, :1], templates.sensor)
        residual = wrap_difference_m(templates.about(seen) - model[:, 0], templates.sensor)
        slope = np.stack([step[:, 1] - step[:, 0], step[:, 3] - step[:, 2]], axis=-1) / 2
        bend = (np.abs(step[:, 1] + step[:, 0]) + np.abs(step[:, 3] + step[:, 2])) / 2
        lost = seen.returned & ~may.any(axis=1)
        absent = seen.not_returned & must.all(axis=1)
        variance = np.divide(1.0, seen.weight, out=np.full(usable.shape, np.inf), where=usable)
        return cls(residual, variance, slope, bend, lost | absent)

    def beside(self, other: _Cells) -> _Cells:
        """Add further pixels of the same frames."""
        return _Cells(*(np.concatenate([getattr(c, f.name) for c in (self, other)], axis=1) for f in fields(self)))

    def chi2(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Fit the positions in the cells and return χ² with the number of pixels in it; (n,) each."""
        weight = 1 / (self.variance + self.bend**2)
        n_compared = np.isfinite(self.variance).sum(axis=1)
        weighted = self.slope * weight[..., None]
        # what the pixels do not tell stays 0: the least solution of the normal equations
        inverse = np.linalg.pinv(self.slope.transpose(0, 2, 1) @ weighted, rcond=1e-12, hermitian=True)
        offset = np.einsum("nij,npj,np->ni", inverse, weighted, self.residual, optimize=True)
        offset = np.clip(offset, -0.6, 0.6) * (n_compared >= MIN_RETURNS)[:, None]
        left = self.residual - np.einsum("npi,ni->np", self.slope, offset)
        n_disagree = self.disagrees.sum(axis=1)
        return np.sum(weight * left**2, axis=1) + DISAGREEMENT * n_disagree, n_compared + n_disagree
