"""Matching frames against a bank: the paper's nearest image, or maximum likelihood in between.

The paper's minimum-distance classifier (its section 4.2) lives here: the lower pixels give distance and angle, then the
upper pixels give the class, and the answer lies on the bank's grid. Maximum likelihood lives in
:mod:`phasemark.matcher.estimator`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.data.bank import BankGroup
from phasemark.matcher.coarse import DISAGREEMENT, Observation, Templates
from phasemark.matcher.estimator import MaximumLikelihood, Pixels, p_values_of
from phasemark.matcher.filters import FilteredFrames
from phasemark.matcher.likelihood import Quantity
from phasemark.matcher.match import Candidate, Match, Matches
from phasemark.matcher.models import VIEW
from phasemark.render import Background, PhasorImages, Renderer, Sensor, wrap_difference_m

METHODS = ("nearest", "refine")
MIN_RETURNS = 3
"""Fewer returns among the pixels that give distance and angle decide nothing: two numbers are sought."""
_FRAMES_AT_ONCE = 128


@dataclass(frozen=True)
class _Found:
    """A template on the grid: class (where the layout knows it), distance and angle indices, and its distance."""

    class_index: int
    i: int
    j: int
    cost: float


class Matcher:
    """Matches filtered frames against a bank.

    Parameters
    ----------
    bank : Bank
    method : {"nearest", "refine"}
        "nearest" is the paper's minimum-distance classifier: the answer is the nearest model image. In a factored
        bank the lower pixels choose distance and angle, and the upper pixels the class at that distance; in a full
        bank all pixels choose all three. "refine" is maximum likelihood over a continuous view, with its covariance.
    free : sequence of str
        What "refine" estimates: distance_m and delta_rad, and on request bearing_rad and height_m; what is not free
        is 0.
    background : Background, "auto" or None
        What stands behind the landmark. None: nothing is expected to return beside it. "auto", with "refine": wall and
        floor are estimated from each frame's own far pixels.
    false_alarm : float
        Share of good frames that the test of the fit may refuse.
    on : {"ranges", "phasors"}
        What "refine" explains: ranges, or amplitude · exp(iφ) with the landmark's albedo estimated too. Phasors need
        frames with amplitudes, best from :func:`~phasemark.matcher.phasor_mean`.
    pixels : {"all", "lower"}
        Which pixels give "refine" the view. All of them tell the class.
    robust : bool
        Whether "refine" counts residuals beyond 3 σ linearly (Huber); the covariance is then the sandwich.
    workers : int, optional
        Threads that render (None: one for each processor), where "refine" renders; the answer does not depend on it.

    Raises
    ------
    UsageError
        The method or an option is unknown, an option does not go with the method, or the false-alarm rate is not in
        (0, 1).

    Notes
    -----
    `chi2` of "nearest" tests how well the nearest image explains the frame, after the linear change of the ranges
    within its grid cell is taken out: the frame lies between grid points, and what the interpolation cannot follow (at
    edges) is added to the variance. Its p-value is therefore approximate. With "refine" it is that of the fit.
    """

    def __init__(
        self,
        bank: Bank,
        method: str = "nearest",
        *,
        free: Sequence[str] = VIEW[:2],
        background: Background | Literal["auto"] | None = None,
        false_alarm: float = 0.01,
        on: Quantity = "ranges",
        pixels: Pixels = "all",
        robust: bool = False,
        workers: int | None = None,
    ) -> None:
        if method not in METHODS:
            raise UsageError(f"unknown method {method!r}: the methods are {', '.join(METHODS)}")
        if isinstance(background, str) and background != "auto":
            raise UsageError(f"'background' must be a Background, \"auto\" or None, got {background!r}")
        if not 0 < false_alarm < 1:
            raise UsageError(f"'false_alarm' must be in (0, 1), got {false_alarm!r}")
        self.bank = bank
        self.false_alarm = false_alarm
        self._likelihood: MaximumLikelihood | None = None
        if method == "refine":
            self._likelihood = MaximumLikelihood(
                bank,
                free=free,
                background=background,
                false_alarm=false_alarm,
                on=on,
                pixels=pixels,
                robust=robust,
                workers=workers,
            )
            return
        if tuple(free) != VIEW[:2] or on != "ranges" or pixels != "all" or robust or isinstance(background, str):
            raise UsageError(
                "'free', 'on', 'pixels', 'robust' and an automatic background belong to method 'refine', not 'nearest'"
            )
        self._behind = None if background is None else background_image(background, bank.sensor)
        self._symmetry = {name: int(bank.mesh(name).metadata["symmetry"]) for name in bank.classes}
        half = bank.sensor.rows // 2
        if bank.full is not None:
            self._pose_rows, self._class_rows = (0, bank.sensor.rows), None
            self._pose = self._templates(bank.full, self._pose_rows)
            self._class = None
        else:
            assert bank.lower is not None
            assert bank.upper is not None
            self._pose_rows, self._class_rows = (half, bank.sensor.rows), (0, half)
            self._pose = self._templates(bank.lower, self._pose_rows)
            self._class = self._templates(bank.upper, self._class_rows)

    def match(self, frames: FilteredFrames) -> Matches:
        """Match a batch of filtered frames.

        Parameters
        ----------
        frames : FilteredFrames
            n positions. The range offset that their sensor states is taken off: a bank has none.

        Returns
        -------
        Matches
            n answers; one with class None where there is no landmark.

        Raises
        ------
        UsageError
            The frames come from another camera than the bank.
        """
        difference = frames.sensor.optics_difference(self.bank.sensor)
        if difference is not None:
            raise UsageError(f"the frames were taken with another sensor than the bank's: {difference}")
        frames = frames.without_offset()
        if self._likelihood is not None:
            return Matches(self._likelihood.match(frames))
        matches: list[Match] = []
        for start in range(0, len(frames), _FRAMES_AT_ONCE):
            matches.extend(self._match_some(frames[start : start + _FRAMES_AT_ONCE]))
        return Matches(matches)

    def _templates(self, group: BankGroup, rows: tuple[int, int]) -> Templates:
        return Templates.build(group.phasor, group.intensity, group.coverage, self.bank.sensor, self._behind, rows)

    def _match_some(self, frames: FilteredFrames) -> list[Match]:
        pose_seen = Observation.from_frames(frames, self._pose_rows)
        found: list[list[_Found]]
        if self._class is None:
            class_seen = None
            found = self._search_full(pose_seen)
        else:
            assert self._class_rows is not None
            class_seen = Observation.from_frames(frames, self._class_rows)
            found = self._search_factored(pose_seen, class_seen)
        none_cost = self._none_cost(frames)
        return [
            self._answer(pose_seen, class_seen, frames, k, sorted(found[k], key=lambda f: f.cost), float(none_cost[k]))
            for k in range(len(frames))
        ]

    def _search_factored(self, lower: Observation, upper: Observation) -> list[list[_Found]]:
        """Find the nearest lower image, then the distance of each class's upper image at that distance."""
        assert self._class is not None
        n_distance, n_delta = len(self.bank.distance_m), len(self.bank.delta_rad)
        found = []
        costs = self._pose.costs(lower)
        for k in range(len(costs)):
            best, cost = self._pose.best(lower, k, costs[k])
            i, j = divmod(best, n_delta)
            at_distance = np.arange(len(self.bank.classes)) * n_distance + i
            class_cost = self._class.exact_costs(upper, k, at_distance)
            found.append([_Found(c, i, j, cost + float(class_cost[c])) for c in range(len(at_distance))])
        return found

    def _search_full(self, seen: Observation) -> list[list[_Found]]:
        """Find the nearest image of each class."""
        n_delta = len(self.bank.delta_rad)
        per_class = len(self.bank.distance_m) * n_delta
        found: list[list[_Found]] = [[] for _ in range(len(seen.range_m))]
        for c in range(len(self.bank.classes)):
            block = slice(c * per_class, (c + 1) * per_class)
            costs = self._pose.costs(seen, block)
            for k in range(len(costs)):
                best, cost = self._pose.best(seen, k, costs[k], offset=block.start)
                i, j = divmod(best - block.start, n_delta)
                found[k].append(_Found(c, i, j, cost))
        return found

    def _none_cost(self, frames: FilteredFrames) -> NDArray[np.float64]:
        """Return the distance of each frame from a scene without a landmark, (n,)."""
        seen = Observation.from_frames(frames, (0, self.bank.sensor.rows))
        shape = (1, self.bank.sensor.rows, self.bank.sensor.cols)
        empty = Templates.build(
            np.zeros(shape, np.complex64),
            np.zeros(shape, np.float32),
            np.zeros(shape, np.float32),
            self.bank.sensor,
            self._behind,
            (0, self.bank.sensor.rows),
        )
        return np.array([empty.exact_costs(seen, k, np.array([0]))[0] for k in range(len(frames))])

    def _answer(
        self,
        pose_seen: Observation,
        class_seen: Observation | None,
        frames: FilteredFrames,
        k: int,
        found: list[_Found],
        none_cost: float,
    ) -> Match:
        """Turn the candidates of one frame, best first, into an answer."""
        if pose_seen.returned[k].sum() < MIN_RETURNS:
            return Match(class_name=None, accepted=False, class_probability=self._probabilities([], 0.0))
        best = found[0]
        chi2, dof = self._goodness(pose_seen, class_seen, k, best)
        p_value = float(p_values_of(np.array([chi2]), np.array([dof]), frames, np.array([k]))[0])
        is_landmark = best.cost < none_cost
        name = self.bank.classes[best.class_index]
        candidates = tuple(
            Candidate(
                self.bank.classes[f.class_index],
                float(self.bank.distance_m[f.i]),
                float(self.bank.delta_rad[f.j]),
                f.cost,
            )
            for f in found
        )
        return Match(
            class_name=name if is_landmark else None,
            accepted=bool(is_landmark and p_value >= self.false_alarm),
            distance_m=candidates[0].distance_m,
            delta_rad=candidates[0].delta_rad,
            chi2=chi2,
            dof=dof,
            p_value=p_value,
            class_probability=self._probabilities(found, none_cost),
            alternatives=candidates[1:] if is_landmark else candidates,
            symmetry=self._symmetry[name],
        )

    def _probabilities(self, found: list[_Found], none_cost: float) -> dict[str, float]:
        """Weigh classes and "none" by exp(−cost / 2), as Gaussian residuals and equal priors have it."""
        cost = {self.bank.classes[f.class_index]: f.cost for f in found}
        names = [*self.bank.classes, "none"]
        values = np.array([cost.get(name, math.inf) for name in self.bank.classes] + [none_cost])
        weight = np.exp(-0.5 * (values - values.min()))
        return dict(zip(names, (weight / weight.sum()).tolist(), strict=True))

    def _goodness(
        self, pose_seen: Observation, class_seen: Observation | None, k: int, best: _Found
    ) -> tuple[float, int]:
        """Return χ² and degrees of freedom of the best image, its cell's linear change taken out."""
        n_distance, n_delta = len(self.bank.distance_m), len(self.bank.delta_rad)
        first = best.class_index * n_distance * n_delta if class_seen is None else 0
        low, high = max(best.i - 1, 0), min(best.i + 1, n_distance - 1)
        left, right = (best.j - 1) % n_delta, (best.j + 1) % n_delta
        at = first + np.array([best.i, low, high, best.i, best.i]) * n_delta
        parts = [_Cell.of(self._pose, pose_seen, k, at + np.array([best.j, best.j, best.j, left, right]))]
        if class_seen is not None:
            assert self._class is not None
            at = best.class_index * n_distance + np.array([best.i, low, high, best.i, best.i])
            parts.append(_Cell.of(self._class, class_seen, k, at))
        cell = _Cell(*(np.concatenate(arrays) for arrays in zip(*(part.arrays() for part in parts), strict=True)))
        chi2, n_fitted = cell.chi2()
        return chi2, max(n_fitted - 2, 0)


@dataclass(frozen=True, eq=False)
class _Cell:
    """Residuals of one frame at a grid point, and how its model changes over the cell; (pixels,) arrays.

    `slope` is the change of range over one step of distance and of angle, (pixels, 2); `bend` what a linear change
    leaves over half a step; `disagrees` counts a pixel whose return the model contradicts at the grid point and at all
    its neighbours.
    """

    residual: NDArray[np.float64]
    weight: NDArray[np.float64]
    slope: NDArray[np.float64]
    bend: NDArray[np.float64]
    disagrees: NDArray[np.bool_]

    @classmethod
    def of(cls, templates: Templates, seen: Observation, k: int, at: NDArray[np.integer]) -> _Cell:
        """Look at grid points `at`: the point itself, then its neighbours in distance and in angle."""
        may, must = templates.may_return[at], templates.must_return[at]
        usable = seen.returned[k] & may.all(axis=0)
        model = templates.range_m[at].astype(np.float64)
        step = wrap_difference_m(model[1:] - model[0], templates.sensor)
        residual = wrap_difference_m(seen.range_m[k] - templates.mean_m - model[0], templates.sensor)
        slope = np.stack([step[1] - step[0], step[3] - step[2]], axis=1) / 2
        bend = np.abs(np.stack([step[1] + step[0], step[3] + step[2]])).sum(axis=0) / 2
        lost = seen.returned[k] & ~may.any(axis=0)
        absent = seen.not_returned[k] & must.all(axis=0)
        return cls(residual[usable], seen.weight[k, usable], slope[usable], bend[usable], (lost | absent))

    def arrays(self) -> tuple[NDArray[np.generic], ...]:
        return self.residual, self.weight, self.slope, self.bend, self.disagrees

    def chi2(self) -> tuple[float, int]:
        """Fit the position in the cell and return χ² with the number of pixels in it."""
        weight = 1 / (1 / self.weight + self.bend**2)
        root = np.sqrt(weight)
        offset: NDArray[np.floating] = np.zeros(2)
        if len(weight) >= MIN_RETURNS:
            offset = np.linalg.lstsq(self.slope * root[:, None], self.residual * root, rcond=1e-9)[0]
            offset = np.clip(offset, -0.6, 0.6)
        left = self.residual - self.slope @ offset
        n_disagree = int(self.disagrees.sum())
        return float(np.sum(weight * left**2) + DISAGREEMENT * n_disagree), len(weight) + n_disagree


def background_image(background: Background, sensor: Sensor) -> PhasorImages:
    """Return what a background alone returns, straight ahead.

    Parameters
    ----------
    background : Background
    sensor : Sensor

    Returns
    -------
    PhasorImages
        One image.
    """
    return Renderer(None, sensor).render(distance_m=1.0, background=background)
