"""The search for a landmark that stands alone: hills of tables of histograms, one for each bearing."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.histograms.exact_fit import Counted, Fit
from phasemark.matcher.histograms.histogram_table import Table, build_table
from phasemark.matcher.histograms.poisson_fit import bare_deviance
from phasemark.matcher.histograms.scene_models import LandmarkAlone
from phasemark.matcher.histograms.search_plan import SearchPlan, Start
from phasemark.matcher.histograms.table_search import DESCENT_MARGIN, find_hills
from phasemark.render.view import VIEW_FIELDS


class AloneSearch:
    """Finds where the likelihood of a landmark without a background has its hills.

    Parameters
    ----------
    plan : SearchPlan
    """

    def __init__(self, plan: SearchPlan) -> None:
        self._plan = plan
        self._models = [LandmarkAlone(signals) for signals in plan.signals]

    @property
    def table_bytes(self) -> int:
        """How large the tables are in memory."""
        plan = self._plan
        return len(plan.bearings_rad) * plan.grid.n_bytes(plan.signals[0].sensor, len(plan.signals))

    @cached_property
    def tables(self) -> list[Table]:
        """Histograms on a grid, one table for each bearing; rendered when they are first needed."""
        plan = self._plan
        return [build_table(plan.signals, plan.grid, b, plan.workers) for b in plan.bearings_rad]

    def prepare(self) -> None:
        """Render the tables, before threads ask for them."""
        _ = self.tables

    def starts(self, frame: Counted, counts: NDArray[np.float64], ambient: NDArray[np.float64]) -> list[Start]:
        """Return the hills of the likelihood of one frame, best first; counts without pile-up and drift."""
        starts = []
        limit = math.inf
        for bearing, table in zip(self._plan.bearings_rad, self.tables, strict=True):
            hills = find_hills(table, counts, ambient, frame.extra, frame.n_frames, limit=limit)
            prior = self._plan.prior_of(bearing)
            for c, place, bright, cost in zip(*hills, strict=True):
                view = np.zeros(len(VIEW_FIELDS))
                view[:2], view[2] = place, bearing
                starts.append(Start(int(c), view, float(cost) + prior, float(bright), ambient))
                limit = min(limit, float(cost) + DESCENT_MARGIN)
        return sorted(starts, key=lambda start: start.cost)

    def model(self, class_index: int) -> LandmarkAlone:
        """Return the exact scenes of a class."""
        return self._models[class_index]

    def bare_cost(self, frame: Counted, ambient: NDArray[np.float64]) -> float:
        """Return what a scene without a landmark costs."""
        level, light = np.empty(frame.counts.shape), np.empty(len(frame.counts))
        return float(bare_deviance(frame.counts, frame.extra, frame.cycles, level, light))

    def background_of(self, fit: Fit) -> None:
        """Return None: nothing stands behind the landmark."""
        return
