"""Class and view of a landmark from histograms: a table's hills, exact scenes on them, and an answer with its test."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.matcher.estimate.acceptance import Rules, no_answer
from phasemark.matcher.histograms.alone_search import AloneSearch
from phasemark.matcher.histograms.exact_fit import Counted, Fit, fit_view, search_of
from phasemark.matcher.histograms.histogram_table import TableGrid, plan_table
from phasemark.matcher.histograms.joint_match import match_together
from phasemark.matcher.histograms.plane_search import PlaneSearch
from phasemark.matcher.histograms.poisson_fit import deviance_test, doubtful_deviance, moments_of
from phasemark.matcher.histograms.scene_models import planes_of, scene_at
from phasemark.matcher.histograms.search_plan import LandmarkSearch, SearchPlan, Start
from phasemark.matcher.histograms.table_search import ambient_light
from phasemark.matcher.histograms.view_answers import Explanation, FitTest, answer_from
from phasemark.matcher.match import Match
from phasemark.render import Background, Sensor
from phasemark.render.direct.bin_counts import response_share
from phasemark.render.direct.fit_model import undo_pile_up
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.histogram_frames import HistogramFrames
from phasemark.render.direct.view_signals import ViewSignals
from phasemark.render.view import VIEW_FIELDS

_SURE_COST = 40.0
"""A hill of the table this much worse than the best one cannot be the answer, nor make it ambiguous …"""
_TABLE_ERROR = 4.0
"""… beside this multiple of how far the deviance of the table was off for the best one."""
_MOST_FITS = 8
_SCENES = 8
_WIDEST_BEARING_RAD = math.radians(4.0)
_BEARING_SIGMA = 2.0
"""A free bearing has two further tables, as far aside as these say."""
_STEEPEST_RAD = math.radians(20.0)


class HistogramMatcher:
    """Estimates class and view from histograms of a direct sensor.

    Parameters
    ----------
    bank : Bank
        Its meshes and the span of its grid are used. Its images are not: histograms are rendered when the first frames
        come, which takes some seconds and :attr:`table_bytes` of memory.
    prior_std : sequence of float
        Standard deviation of each free parameter before a frame is seen, about 0; infinite where nothing is known.
    rules : Rules
        When an answer is accepted.
    background : Background, "auto" or None
        What stands behind the landmark; the brightness of its planes is estimated. "auto": a wall whose distance is
        estimated too.
    workers : int
        Threads; the answers do not depend on their number.
    """

    def __init__(
        self, bank: Bank, *, prior_std: Sequence[float], rules: Rules,
        background: Background | Literal["auto"] | None = None, workers: int = 1,
    ) -> None:  # fmt: skip
        self.sensor = bank.camera
        check_histogram_sensor(bank)
        self.rules, self._workers, free = rules, workers, rules.free
        prior = np.array(prior_std, dtype=np.float64)
        meshes = [bank.mesh(name) for name in bank.classes]
        self.signals = [ViewSignals(mesh, self.sensor, float(mesh.metadata["albedo"])) for mesh in meshes]
        self.grid = plan_table(self.signals, bank.distance_m, bank.delta_rad, math.gcd(*rules.symmetry))
        bearings: tuple[float, ...] = (0.0,)
        if "bearing_rad" in free:
            side = min(_BEARING_SIGMA * float(prior[free.index("bearing_rad")]), _WIDEST_BEARING_RAD)
            bearings = (0.0, -side, side)
        plan = SearchPlan(self.signals, self.grid, free, prior, view_limits(self.grid), bearings, workers)
        self._plan = plan
        self.search: LandmarkSearch = AloneSearch(plan)
        if isinstance(background, str) or (background is not None and planes_of(background)):
            self.search = PlaneSearch(plan, background)

    @property
    def table_bytes(self) -> int:
        """How large the tables of histograms are in memory."""
        return self.search.table_bytes

    def match(self, frames: HistogramFrames) -> list[Match]:
        """Return an answer for every position of the bank's sensor, whose frames are added up."""
        counted = counted_frames(frames)
        self.search.prepare()
        if self._workers == 1 or len(counted) < 2:
            return [self._match(one) for one in counted]
        with ThreadPoolExecutor(self._workers) as pool:
            return list(pool.map(self._match, counted))

    def match_jointly(self, frames: HistogramFrames, first2camera: NDArray[np.float64]) -> Match:
        """Return one answer for a landmark that several positions see, the view as the first one has it.

        Parameters
        ----------
        frames : HistogramFrames
        first2camera : (n, 4, 4) float64
            From the frame of the first position's camera to that of each.
        """
        counted = counted_frames(frames)
        self.search.prepare()
        with ThreadPoolExecutor(self._workers) as pool:
            looked = list(pool.map(self._looked, counted))
        starts, bare = zip(*looked, strict=True)
        return match_together(self.search, self._plan, self.rules, counted, starts, sum(bare), first2camera)

    def _looked(self, frame: Counted) -> tuple[list[Start], float]:
        """Return where fits of a frame begin, and what it costs without a landmark."""
        counts = shifted_back(
            undo_pile_up(frame.counts, frame.cycles) if math.isfinite(frame.cycles) else frame.counts,
            float(frame.drift_bins[0]),
        )
        ambient = ambient_light(counts, frame.extra)
        starts = self.search.starts(frame, counts, ambient)
        return starts, self.search.bare_cost(frame, ambient) if starts else 0.0

    def _match(self, frame: Counted) -> Match:
        starts, bare = self._looked(frame)
        if not starts:
            return no_answer(self.rules)
        least = starts[0].cost
        fits: list[tuple[int, Fit]] = []
        offset, margin, n_tried = 0.0, _SURE_COST, 0
        for start in starts[:_MOST_FITS]:
            if fits and start.cost > least + margin:
                break
            n_tried += 1
            hopeless = min((fit.cost for _, fit in fits), default=math.inf) + _SURE_COST
            known = [fit.view for other, fit in fits if other == start.class_index]
            model, plan = self.search.model(start.class_index), self._plan
            search = search_of(plan.free, plan.prior_std, plan.limits, _SCENES, model.nuisances)
            fit = fit_view(
                scene_at(model, plan.free), frame, start.state, start.bright, start.ambient, search, hopeless, known
            )
            if fit is None:
                continue
            if not fits:
                offset = fit.cost - least  # of the exact deviance over that of the table
                margin += _TABLE_ERROR * abs(offset)
            fits.append((start.class_index, fit))
        found = [Explanation(c, fit.view, fit.cost, fit.information) for c, fit in fits]
        found += [
            Explanation(s.class_index, s.state[: len(VIEW_FIELDS)], s.cost + offset, None) for s in starts[n_tried:]
        ]
        best_class, best = min(fits, key=lambda pair: pair[1].cost)
        mean, variance = moments_of(best.level)
        free = len(self.rules.free) + self.search.model(best_class).nuisances.shape[1] + 1 + len(best.ambient)
        test = FitTest(*deviance_test(best.deviance, mean, variance, free))
        doubt = best.cost - best.deviance + doubtful_deviance(mean, variance, free, self.rules.false_alarm)
        behind = self.search.background_of(best)
        return answer_from(self.rules, found, test, bare, doubt, behind)


def check_histogram_sensor(bank: Bank) -> None:
    """Refuse a bank whose sensor counts no histograms.

    Raises
    ------
    UsageError
    """
    if bank.camera.kind != "direct" or bank.camera.histogram is None:
        lacks = "without a [histogram] table" if bank.camera.kind == "direct" else "a phase camera"
        raise UsageError(
            f"histograms and targets take a bank of a direct sensor with a [histogram] table: '{bank.plan.sensor}' is"
            f" {'one ' if bank.camera.kind == 'direct' else ''}{lacks}"
        )


def refuse_other_sensor(own: Sensor, other: Sensor) -> None:
    """Refuse frames that were taken with another sensor.

    Raises
    ------
    UsageError
    """
    difference = other.optics_difference(own)
    if difference is None and other.histogram != own.histogram:
        ours, theirs = histogram_of(own).model_dump(), histogram_of(other).model_dump()
        name = next(name for name in ours if ours[name] != theirs[name])
        difference = f"'histogram.{name}' is {theirs[name]} here and {ours[name]} there"
    if difference is not None:
        raise UsageError(f"the frames were taken with another sensor than the bank's: {difference}")


def view_limits(grid: TableGrid) -> NDArray[np.float64]:
    """Return least and greatest values of a view that is looked for, (2, 6)."""
    low, high = np.full(len(VIEW_FIELDS), -math.inf), np.full(len(VIEW_FIELDS), math.inf)
    low[0], high[0] = grid.distance_m[0], grid.distance_m[-1]
    if not grid.cyclic:
        low[1], high[1] = grid.delta_rad[0], grid.delta_rad[-1]
    low[4:], high[4:] = -_STEEPEST_RAD, _STEEPEST_RAD
    return np.stack([low, high])


def counted_frames(frames: HistogramFrames) -> list[Counted]:
    """Return what was counted at each position, its frames added up."""
    histogram = histogram_of(frames.sensor)
    n_frames = float(frames.counts.shape[1])
    cycles = histogram.cycles * n_frames if histogram.pile_up else math.inf
    extra = n_frames * glass_counts(frames.sensor)
    return [
        Counted(np.ascontiguousarray(counts), n_frames, cycles, extra, np.array([drift]))
        for counts, drift in zip(frames.zone_counts, frames.drift_bins, strict=True)
    ]


def glass_counts(sensor: Sensor) -> NDArray[np.float64]:
    """Return the expected counts of the cover glass in one frame, (bins,)."""
    histogram = histogram_of(sensor)
    edges = histogram.start_m + histogram.bin_width_m * np.arange(histogram.bins + 1)
    return np.asarray(histogram.crosstalk * np.diff(response_share(edges - histogram.crosstalk_range_m, histogram)))


def shifted_back(counts: NDArray[np.float64], bins: float) -> NDArray[np.float64]:
    """Return histograms shifted to earlier bins, linear between bins; (zones, bins)."""
    if bins == 0:
        return counts
    at = np.arange(counts.shape[1]) + bins
    return np.stack([np.interp(at, np.arange(counts.shape[1]), row) for row in counts])
