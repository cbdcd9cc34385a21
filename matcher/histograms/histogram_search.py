"""The search for hills of the likelihood of one frame, in tables of histograms for each bearing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.histograms.direct_matcher import DirectMatcher
from phasemark.matcher.histograms.exact_fit import Counted, Fit, Search, Start, fit_view
from phasemark.matcher.histograms.histogram_table import (
    Table,
    build_table,
    plane_light,
    response_width_m,
    signal_between,
)
from phasemark.matcher.histograms.poisson_fit import bare_deviance
from phasemark.matcher.histograms.scene_models import FAINTEST, STRONGEST, LandmarkModel, planes_of
from phasemark.matcher.histograms.table_search import DESCENT_MARGIN, ambient_light, find_hills, find_hills_before
from phasemark.matcher.nearest.grid import cubic_weights
from phasemark.render import Background
from phasemark.render.direct.fit_model import undo_pile_up
from phasemark.render.view import VIEW_FIELDS

SURE_COST = 40.0
"""A fit this much worse than the best one can neither be the answer nor make it ambiguous."""
SCENES, _TABLE_SCENES = 8, 5
"""Scenes that a fit renders at most, or takes from a table."""
_TURNS = ("bearing_rad", "pitch_rad", "roll_rad")
"""What of a view moves planes in the image."""


class TableModel:
    """A landmark at one bearing before planes, from a table.

    Parameters
    ----------
    table : Table
    class_index : int
    light : (planes, zones, bins) float64
        Counts of the planes with nothing before them.
    """

    def __init__(self, table: Table, class_index: int, light: NDArray[np.float64]) -> None:
        self._table, self._class_index, self._light = table, class_index, light
        self.nuisances = np.tile([[FAINTEST], [STRONGEST], [1.0]], len(light))

    def scene(self, state: NDArray[np.float64], free: Sequence[str]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the counts at a state, and their slopes by distance, δ and the brightness of each plane."""
        table, visible = self._table, self._table.visible[self._class_index]
        n_distance, n_delta = visible.shape[:2]
        out, nodes = np.zeros((3, *self._light.shape[1:])), np.empty((4, 4))
        signal_between(table, self._class_index, float(state[0]), float(state[1]), nodes, out)
        x, y = (state[:2] - table.grid[::2]) / table.grid[1::2]
        i = min(max(math.floor(x), 1), n_distance - 3)
        j = math.floor(y) if table.cyclic else min(max(math.floor(y), 1), n_delta - 3)
        cubic_weights(x - i, nodes[0], nodes[1])
        cubic_weights(y - j, nodes[2], nodes[3])
        about = visible[i - 1 : i + 3][:, np.arange(j - 1, j + 3) % n_delta].astype(np.float64)
        weights = (nodes[0], nodes[2]), (nodes[1] / table.grid[1], nodes[2]), (nodes[0], nodes[3] / table.grid[3])
        shown, *slopes = (np.einsum("a,b,abpz->pz", *pair, about)[..., None] * self._light for pair in weights)
        for k, light in enumerate((shown, *slopes)):
            out[k] += np.tensordot(state[len(VIEW_FIELDS) :], light, axes=1)
        return out[0], np.concatenate([out[1:], shown])


class HistogramSearch(DirectMatcher):
    """Finds initial guesses for fits of a frame of histograms; see :class:`DirectMatcher`."""

    @property
    def table_bytes(self) -> int:
        """How large the tables of histograms are in memory."""
        n_planes = len(planes_of(self.background))
        return len(self._bearings_rad) * self.grid.n_bytes(self.sensor, len(self.signals), n_planes)

    @cached_property
    def tables(self) -> list[Table]:
        """Histograms on a grid, one table for each bearing; rendered when they are first needed."""
        return [
            build_table(self.signals, self.grid, self.background, bearing, self.workers)
            for bearing in self._bearings_rad
        ]

    @cached_property
    def models(self) -> list[LandmarkModel]:
        """Exact scenes of each class."""
        return [LandmarkModel(signals, self.background, self.free_wall) for signals in self.signals]

    @cached_property
    def searches(self) -> list[Search]:
        """What a fit of each class varies, in exact scenes."""
        return [Search(model, self.free, self.prior_std, self.limits) for model in self.models]

    @cached_property
    def _bare(self) -> Search:
        """What a fit of the planes alone varies."""
        turns = tuple(name for name in self.free if name in _TURNS)
        prior_std = self.prior_std[[self.free.index(name) for name in turns]]
        return Search(LandmarkModel(self.nothing, self.background, self.free_wall), turns, prior_std, self.limits)

    @cached_property
    def _walls(self) -> list[Background | None]:
        """Backgrounds before which a landmark is looked for: a wall that is free stands at many distances."""
        if self.background is None or self.free_wall is None:
            return [self.background]
        wall_step_of_response = 0.75
        step = wall_step_of_response * response_width_m(self.sensor)
        distances_m = np.arange(float(self.limits[0, 0]), self.free_wall[1], step)
        return [replace(self.background, wall_m=float(wall_m)) for wall_m in distances_m]

    @cached_property
    def _lights(self) -> NDArray[np.float64]:
        """Counts of the planes alone for each bearing and distance of the wall, (bearings, walls, planes, …)."""
        return np.array(
            [[plane_light(self.nothing, w, b) for w in self._walls if w is not None] for b in self._bearings_rad]
        )

    def prepare(self) -> None:
        """Render the tables, before threads ask for them."""
        _ = self.tables, self.searches, self._bare, self._lights

    def background_of(self, state: NDArray[np.float64]) -> Background | None:
        """Return what stands behind the landmark in a fit."""
        if self.background is None or self.free_wall is None:
            return self.background
        return replace(self.background, wall_m=float(state[-1]))

    def looked(self, frame: Counted) -> tuple[list[Start], float]:
        """Return the hills of the likelihood of one frame, best first, and what it costs without a landmark."""
        counts = undo_pile_up(frame.counts, frame.cycles) if math.isfinite(frame.cycles) else frame.counts
        counts = _shifted_back(counts, float(frame.drift_bins[0]))
        ambient = ambient_light(counts, frame.extra)
        hills = self._hills if self.background is None else self._hills_before_planes
        starts = sorted(hills(frame, counts, ambient), key=lambda start: start.cost)
        return starts, self._bare_cost(frame, ambient) if starts else 0.0

    def _hills(self, frame: Counted, counts: NDArray[np.float64], ambient: NDArray[np.float64]) -> Iterator[Start]:
        """Yield hills of the likelihood of a landmark alone; counts without pile-up and drift."""
        limit = math.inf
        for bearing, table in zip(self._bearings_rad, self.tables, strict=True):
            for hill in find_hills(table, counts, ambient, frame.extra, frame.n_frames, limit):
                state = np.array([*hill.place, bearing, 0.0, 0.0, 0.0])
                yield Start(hill.class_index, state, hill.cost + self._prior_of(bearing), hill.bright, ambient)
                limit = min(limit, hill.cost + DESCENT_MARGIN)

    def _hills_before_planes(
        self, frame: Counted, counts: NDArray[np.float64], ambient: NDArray[np.float64]
    ) -> Iterator[Start]:
        """Yield hills of the likelihood of a landmark before planes; counts without pile-up and drift."""
        nothing_known = np.full(2, math.inf)
        for bearing, table, lights in zip(self._bearings_rad, self.tables, self._lights, strict=True):
            for w in self._likely_walls(frame, counts, ambient, lights):
                for hill in find_hills_before(table, counts, ambient, frame.extra, frame.n_frames, lights[w]):
                    ratios = np.clip(hill.ratios, FAINTEST, STRONGEST)
                    start = Start(hill.class_index, np.array([*hill.place, bearing, 0.0, 0.0, 0.0, *ratios]), 0.0,
                                  hill.bright, ambient)  # fmt: skip
                    model = TableModel(table, hill.class_index, lights[w])
                    search = Search(model, VIEW_FIELDS[:2], nothing_known, self.limits)
                    fit = fit_view(search, frame, start, _TABLE_SCENES)
                    if fit is None:
                        continue
                    state = self._with_wall(fit.state, w)
                    yield Start(hill.class_index, state, fit.cost + self._prior_of(bearing), fit.bright, fit.ambient)

    def _with_wall(self, state: NDArray[np.float64], w: int) -> NDArray[np.float64]:
        """Return a state with the distance of a wall, where that is free."""
        wall = self._walls[w]
        if self.free_wall is None or wall is None or wall.wall_m is None:
            return state
        return np.append(state, wall.wall_m)

    def _bare_cost(self, frame: Counted, ambient: NDArray[np.float64]) -> float:
        """Return what a scene without a landmark costs, its planes at their best."""
        if self.background is None:
            return bare_deviance(frame.counts, frame.extra, frame.cycles)
        fits: list[Fit | None] = []
        view = np.eye(len(VIEW_FIELDS))[0]
        scales = np.ones(len(planes_of(self.background)) - 1)
        for w in self._likely_walls(frame, frame.counts, ambient, self._lights[0]):
            state = self._with_wall(np.concatenate([view, scales]), w)
            fits.append(fit_view(self._bare, frame, Start(0, state, 0.0, 1.0, ambient), SCENES))
        return min(fit.cost for fit in fits if fit is not None)

    def _likely_walls(
        self, frame: Counted, counts: NDArray[np.float64], ambient: NDArray[np.float64], lights: NDArray[np.float64]
    ) -> list[int]:
        """Return at which distances a wall explains most of a frame, each zone by itself; one if it is known."""
        if self.free_wall is None:
            return [0]
        net = counts - ambient[:, None] - frame.extra
        weight = 1 / np.maximum(np.maximum(ambient[:, None] + frame.extra, counts), 1.0)
        light = lights[:, 0]
        along = np.maximum(np.einsum("wzj,zj->wz", light, net * weight), 0.0)
        gain = (along**2 / np.maximum(np.einsum("wzj,zj->wz", light**2, weight), 1e-300)).sum(axis=1)
        padded = np.pad(gain, 1, constant_values=-1.0)
        peak = np.flatnonzero((gain >= padded[:-2]) & (gain > padded[2:]))
        walls = 4
        return [int(w) for w in peak[np.argsort(-gain[peak])][:walls]]


def _shifted_back(counts: NDArray[np.float64], bins: float) -> NDArray[np.float64]:
    """Return histograms shifted to earlier bins, linear between bins; (zones, bins)."""
    if bins == 0:
        return counts
    at = np.arange(counts.shape[1]) + bins
    return np.stack([np.interp(at, np.arange(counts.shape[1]), row) for row in counts])
