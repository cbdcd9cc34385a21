"""Shares of planes that a landmark leaves visible, on the grid of a table, and scenes in between.

A zone's light from a plane is taken as that of the plane with nothing before it, times the share that the landmark
leaves visible. That is exact where a zone sees the plane within a bin or two, and good enough for a search elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.histograms.exact_fit import SceneAt
from phasemark.matcher.histograms.histogram_table import Table, TableGrid, build_table, cubic, signal_between
from phasemark.matcher.histograms.scene_models import planes_of
from phasemark.render import Background, Views
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.view_signals import ViewSignals

_COARSE_M = 1.0
"""Shares need no ranges: cells of a floor are not cut."""


class TableBefore(NamedTuple):
    """A table of histograms before planes, for one bearing.

    Parameters
    ----------
    table : Table
        Of the landmark.
    visible : (classes, distances, angles, planes, zones) float32
        Share of each plane's light that the landmark leaves.
    bearing_rad : float
    """

    table: Table
    visible: NDArray[np.float32]
    bearing_rad: float


def build_table_before(
    signals: Sequence[ViewSignals], grid: TableGrid, background: Background, bearing_rad: float, workers: int
) -> TableBefore:
    """Render a table before planes.

    Parameters
    ----------
    signals : sequence of ViewSignals
        Of each class, by one sensor.
    grid : TableGrid
    background : Background
    bearing_rad : float
        Of all views.
    workers : int
        Threads; the result does not depend on their number.
    """
    planes = list(planes_of(background))
    n_zones = signals[0].sensor.rows * signals[0].sensor.cols
    shape = (len(signals), len(grid.distance_m), len(grid.delta_rad), len(planes), n_zones)
    visible = np.zeros(shape, np.float32)
    nothing = ViewSignals(None, signals[0].sensor)
    whole = nothing.surfaces(Views.broadcast(1.0, 0.0, bearing_rad), background, finest_m=_COARSE_M)
    light = whole[0, planes].sum(axis=-1)

    def counts_of(c: int, i: int, views: Views) -> NDArray[np.float64]:
        found = signals[c].surfaces(views, background, workers, finest_m=_COARSE_M)
        visible[c, i] = found[:, planes].sum(axis=-1) / np.maximum(light, 1e-300)
        return np.asarray(found[:, 0])

    return TableBefore(build_table(signals, grid, bearing_rad, workers, counts_of), visible, bearing_rad)


def plane_light(nothing: ViewSignals, background: Background, bearing_rad: float) -> NDArray[np.float64]:
    """Return the counts of each plane with nothing before it, (planes, zones, bins)."""
    found = nothing.surfaces(Views.broadcast(1.0, 0.0, bearing_rad), background)
    return np.ascontiguousarray(found[0, list(planes_of(background))])


def table_scene(before: TableBefore, c: int, light: NDArray[np.float64]) -> SceneAt:
    """Return the function that gives signal and slopes by distance, δ and the brightness of planes, from a table.

    Parameters
    ----------
    before : TableBefore
    c : int
        Class.
    light : (planes, zones, bins) float64
        From :func:`plane_light`.
    """
    table, visible = before.table, before.visible[c]
    n_distance, n_delta = visible.shape[:2]
    n_planes, n_zones, bins = light.shape
    nodes = np.empty((4, 4))

    def scene(state: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        scales = state[6 : 6 + n_planes]
        out = np.zeros((3, n_zones, bins))
        signal_between(table, c, float(state[0]), float(state[1]), nodes, out)
        x = (state[0] - table.grid[0]) / table.grid[1]
        i = min(max(math.floor(x), 1), n_distance - 3)
        y = (state[1] - table.grid[2]) / table.grid[3]
        j = math.floor(y) if table.cyclic else min(max(math.floor(y), 1), n_delta - 3)
        cubic(x - i, nodes[0], nodes[1])
        cubic(y - j, nodes[2], nodes[3])
        about = visible[i - 1 : i + 3][:, np.arange(j - 1, j + 3) % n_delta].astype(np.float64)
        here = np.einsum("a,b,abpz->pz", nodes[0], nodes[2], about)
        by_m = np.einsum("a,b,abpz->pz", nodes[1] / table.grid[1], nodes[2], about)
        by_rad = np.einsum("a,b,abpz->pz", nodes[0], nodes[3] / table.grid[3], about)
        shown = here[..., None] * light
        out[0] += np.tensordot(scales, shown, axes=1)
        out[1] += np.tensordot(scales, by_m[..., None] * light, axes=1)
        out[2] += np.tensordot(scales, by_rad[..., None] * light, axes=1)
        return out[0], np.concatenate([out[1:], shown])

    return scene


def table_bytes(grid: TableGrid, signals: Sequence[ViewSignals], background: Background | None) -> int:
    """Return how large a table gets in memory, with what it has of planes."""
    sensor = signals[0].sensor
    planes = 0 if background is None else len(planes_of(background))
    shares = len(signals) * len(grid.distance_m) * len(grid.delta_rad) * planes * sensor.rows * sensor.cols
    return grid.n_bytes(sensor, len(signals)) + 4 * shares


def farthest_m(signals: ViewSignals) -> float:
    """Return where the last bin of a sensor ends, metres."""
    histogram = histogram_of(signals.sensor)
    return histogram.start_m + histogram.bins * histogram.bin_width_m
