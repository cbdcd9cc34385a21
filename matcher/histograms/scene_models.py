"""Models of what a direct sensor sees: a landmark alone, a landmark before planes, planes alone.

A model is asked for some views at the same time, for slopes are differences. What it leaves open besides the view are
its nuisances; they follow the six numbers of the view in a state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.histograms.exact_fit import SceneAt
from phasemark.render import Background, Views
from phasemark.render.direct.view_signals import ViewSignals, slopes_about, views_about
from phasemark.render.view import VIEW_FIELDS

WALL, FLOOR = 1, 2
"""Where planes stand among the surfaces of a scene; the landmark is 0."""
FAINTEST, STRONGEST = 1e-2, 1e2
"""Brightness of a plane over that of the landmark, both over what their albedos say, between which it is looked for."""
_LONGEST_SCALE = 1.0
_WALL_STEP_M = 2e-3
_LONGEST_WALL_STEP_M = 0.04


class Look(NamedTuple):
    """Signals of a model at some views.

    Parameters
    ----------
    counts : (n, zones, bins) float64
        Expected signal counts of one frame.
    by_nuisance : (k, zones, bins) float64
        Their slopes by the nuisances at the first view.
    """

    counts: NDArray[np.float64]
    by_nuisance: NDArray[np.float64]


class SceneModel(Protocol):
    """Model of what can be seen from a view."""

    @property
    def nuisances(self) -> NDArray[np.float64]:
        """Least and greatest value and longest step of each nuisance, (3, k)."""

    def look(self, views: Views, extra: NDArray[np.float64]) -> Look:
        """Return the signals at some views, nuisances given."""


def scene_at(model: SceneModel, free: Sequence[str]) -> SceneAt:
    """Return the function that renders a model and its slopes at a state."""

    def scene(state: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        found = model.look(views_about(state[: len(VIEW_FIELDS)], free), state[len(VIEW_FIELDS) :])
        return found.counts[0], np.concatenate([slopes_about(found.counts, free), found.by_nuisance])

    return scene


class LandmarkAlone:
    """A landmark with nothing behind it.

    Parameters
    ----------
    signals : ViewSignals
    """

    nuisances = np.empty((3, 0))

    def __init__(self, signals: ViewSignals) -> None:
        self._signals = signals

    def look(self, views: Views, extra: NDArray[np.float64]) -> Look:
        """Return the signals at some views."""
        counts = self._signals.counts(views)
        return Look(counts, np.empty((0, *counts.shape[1:])))


class BeforePlanes:
    """A landmark before a wall, a floor or both, the brightness of each unknown.

    Its nuisances are the brightness of each plane over the landmark's, 1 where all albedos are as stated, and last the
    distance of the wall where that is free.

    Parameters
    ----------
    signals : ViewSignals
        Of the landmark; those of nothing leave the planes alone.
    background : Background
    free_wall : (float, float), optional
        Least and greatest distance of a wall that is not known.
    """

    def __init__(
        self, signals: ViewSignals, background: Background, free_wall: tuple[float, float] | None = None
    ) -> None:
        self._signals, self._background, self._free_wall = signals, background, free_wall
        self.planes = planes_of(background)
        self._alone = not len(signals.vertices)

    @property
    def nuisances(self) -> NDArray[np.float64]:
        """Least and greatest value and longest step of each nuisance, (3, k)."""
        scales = len(self.planes) - self._alone  # planes alone: the first one's brightness is that of the scene
        columns = [(FAINTEST, STRONGEST, _LONGEST_SCALE)] * scales
        if self._free_wall is not None:
            columns.append((*self._free_wall, _LONGEST_WALL_STEP_M))
        return np.array(columns).reshape(-1, 3).T

    def look(self, views: Views, extra: NDArray[np.float64]) -> Look:
        """Return the signals at some views, nuisances given."""
        scales = extra[: len(extra) - (self._free_wall is not None)]
        behind = self._background
        if self._free_wall is not None:
            behind = replace(behind, wall_m=float(extra[-1]))
        found = self._signals.surfaces(views, behind)
        counts = self._added(found, scales)
        slopes = [found[0, plane] for plane in self.planes[self._alone :]]
        if self._free_wall is not None:
            sides = []
            for step in (_WALL_STEP_M, -_WALL_STEP_M):
                moved = replace(behind, wall_m=float(extra[-1]) + step)
                sides.append(self._added(self._signals.surfaces(views[:1], moved), scales)[0])
            slopes.append((sides[0] - sides[1]) / (2 * _WALL_STEP_M))
        return Look(counts, np.array(slopes).reshape(-1, *counts.shape[1:]))

    def _added(self, found: NDArray[np.float64], scales: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the light of all surfaces together, (n, zones, bins)."""
        first = self.planes[0] if self._alone else 0
        counts = found[:, first].copy()
        for plane, scale in zip(self.planes[self._alone :], scales, strict=True):
            counts += scale * found[:, plane]
        return counts


def planes_of(background: Background) -> tuple[int, ...]:
    """Return which planes of a background return light."""
    wall = background.wall_m is not None and background.wall_albedo > 0
    floor = background.floor_m is not None and background.floor_albedo > 0
    return (WALL,) * wall + (FLOOR,) * floor
