"""The search for a landmark before a wall or a floor, whose brightness is unknown; the wall's distance may be too."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.histograms.background_search import grid_starts
from phasemark.matcher.histograms.background_table import (
    TableBefore,
    build_table_before,
    farthest_m,
    plane_light,
    table_bytes,
    table_scene,
)
from phasemark.matcher.histograms.exact_fit import Counted, Fit, fit_view, search_of
from phasemark.matcher.histograms.histogram_table import response_width_m
from phasemark.matcher.histograms.scene_models import FAINTEST, STRONGEST, BeforePlanes, scene_at
from phasemark.matcher.histograms.search_plan import SearchPlan, Start, before_the_wall
from phasemark.matcher.histograms.table_search import DESCENT_MARGIN
from phasemark.render import Background
from phasemark.render.direct.view_signals import ViewSignals
from phasemark.render.view import VIEW_FIELDS

_TABLE_SCENES = 5
_BARE_SCENES = 8
_WALLS = 4
_WALL_STEP_OF_RESPONSE = 0.75
_NEAREST_WALL_M = 0.1
_TURNS = ("bearing_rad", "pitch_rad", "roll_rad")
"""What of a view moves planes in the image."""


class PlaneSearch:
    """Finds where the likelihood of a landmark before planes has its hills.

    Parameters
    ----------
    plan : SearchPlan
    background : Background or "auto"
        "auto": a wall somewhere.
    """

    def __init__(self, plan: SearchPlan, background: Background | Literal["auto"]) -> None:
        self._nothing = ViewSignals(None, plan.signals[0].sensor)
        self._far_m = farthest_m(self._nothing)
        self._free_wall = (_NEAREST_WALL_M, self._far_m) if background == "auto" else None
        self._background = Background(wall_m=self._far_m) if isinstance(background, str) else background
        self._plan = plan
        if self._free_wall is None:
            self._plan = plan._replace(limits=before_the_wall(plan.limits, self._background))
        self._models = [BeforePlanes(signals, self._background, self._free_wall) for signals in plan.signals]
        self._bare = BeforePlanes(self._nothing, self._background, self._free_wall)

    @property
    def table_bytes(self) -> int:
        """How large the tables are in memory."""
        plan = self._plan
        return len(plan.bearings_rad) * table_bytes(plan.grid, plan.signals, self._background)

    @cached_property
    def tables(self) -> list[TableBefore]:
        """Histograms on a grid, one table for each bearing; rendered when they are first needed."""
        plan = self._plan
        return [
            build_table_before(plan.signals, plan.grid, self._background, b, plan.workers) for b in plan.bearings_rad
        ]

    @cached_property
    def _walls_m(self) -> NDArray[np.float64]:
        """Distances at which a wall is looked for."""
        if self._free_wall is None:
            return np.array([self._background.wall_m or math.nan])
        step = _WALL_STEP_OF_RESPONSE * response_width_m(self._plan.signals[0].sensor)
        return np.arange(float(self._plan.limits[0, 0]), self._far_m, step)

    @cached_property
    def _lights(self) -> NDArray[np.float64]:
        """Counts of the planes alone for each bearing and distance of the wall, (bearings, walls, planes, …)."""
        return np.array(
            [[plane_light(self._nothing, self._behind(w), b) for w in self._walls_m] for b in self._plan.bearings_rad]
        )

    def prepare(self) -> None:
        """Render the tables, before threads ask for them."""
        _ = self.tables, self._lights

    def starts(self, frame: Counted, counts: NDArray[np.float64], ambient: NDArray[np.float64]) -> list[Start]:
        """Return the hills of the likelihood of one frame, best first; counts without pile-up and drift."""
        plan, starts, hopeless = self._plan, [], math.inf
        scales = self._models[0].nuisances[:, : len(self._bare.planes)]
        search = search_of(VIEW_FIELDS[:2], np.full(2, math.inf), plan.limits, _TABLE_SCENES, scales)
        for before, lights in zip(self.tables, self._lights, strict=True):
            prior = plan.prior_of(before.bearing_rad)
            for w in self._likely_walls(frame, counts, ambient, lights):
                light = lights[w]
                found = grid_starts(before, counts, ambient, frame.extra, frame.n_frames, light)
                for c, distance, delta, bright, ratio, _ in found:
                    state = np.zeros(len(VIEW_FIELDS) + len(ratio))
                    state[:3] = distance, delta, before.bearing_rad
                    state[len(VIEW_FIELDS) :] = np.clip(ratio, FAINTEST, STRONGEST)
                    fit = fit_view(table_scene(before, c, light), frame, state, bright, ambient, search, hopeless)
                    if fit is None:
                        continue
                    hopeless = min(hopeless, fit.cost + DESCENT_MARGIN)
                    state = fit.state if self._free_wall is None else np.append(fit.state, self._walls_m[w])
                    starts.append(Start(c, state, fit.cost + prior, fit.bright, fit.ambient))
        return sorted(starts, key=lambda start: start.cost)

    def model(self, class_index: int) -> BeforePlanes:
        """Return the exact scenes of a class."""
        return self._models[class_index]

    def bare_cost(self, frame: Counted, ambient: NDArray[np.float64]) -> float:
        """Return what the planes alone cost, their brightness at its best; a wall that is free, at its best place."""
        plan = self._plan
        turns = tuple(name for name in plan.free if name in _TURNS)
        prior = plan.prior_std[[plan.free.index(name) for name in turns]]
        search = search_of(turns, prior, plan.limits, _BARE_SCENES, self._bare.nuisances)
        scene, costs = scene_at(self._bare, turns), []
        walls = [0] if self._free_wall is None else self._likely_walls(frame, frame.counts, ambient, self._lights[0])
        for w in walls:
            extra = np.ones(self._bare.nuisances.shape[1])
            if self._free_wall is not None:
                extra[-1] = self._walls_m[w]
            state = np.concatenate([np.zeros(len(VIEW_FIELDS)), extra])
            state[0] = 1.0
            fit = fit_view(scene, frame, state, 1.0, ambient, search, math.inf)
            assert fit is not None
            costs.append(fit.cost)
        return min(costs)

    def background_of(self, fit: Fit) -> Background:
        """Return what stands behind the landmark in a fit."""
        return self._background if self._free_wall is None else self._behind(float(fit.state[-1]))

    def _behind(self, wall_m: float) -> Background:
        return self._background if self._free_wall is None else replace(self._background, wall_m=wall_m)

    def _likely_walls(
        self, frame: Counted, counts: NDArray[np.float64], ambient: NDArray[np.float64], lights: NDArray[np.float64]
    ) -> list[int]:
        """Return at which distances a wall explains most of a frame, each zone by itself; one if it is known."""
        if self._free_wall is None:
            return [0]
        net = counts - ambient[:, None] - frame.extra
        weight = 1 / np.maximum(np.maximum(ambient[:, None] + frame.extra, counts), 1.0)
        light = lights[:, 0]
        along = np.maximum(np.einsum("wzj,zj->wz", light, net * weight), 0.0)
        gain = (along**2 / np.maximum(np.einsum("wzj,zj->wz", light**2, weight), 1e-300)).sum(axis=1)
        padded = np.pad(gain, 1, constant_values=-1.0)
        peak = np.flatnonzero((gain >= padded[:-2]) & (gain > padded[2:]))
        return [int(w) for w in peak[np.argsort(-gain[peak])][:_WALLS]]
