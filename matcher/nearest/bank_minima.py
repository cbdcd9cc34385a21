"""Initial guesses: views in the cells of a bank that may explain a frame, under any bearing.

A bearing moves the image sideways, a height or a pitch up and down. The rays of a turned camera meet the landmark at
the same ranges, so a frame shifted by whole columns and rows is compared with the bank's images ahead; what is
shifted in is missing. A return that is shifted out costs 1, the mean of a compared pixel: the bank does not show it.
A frame whose tilt is known is turned level before: each pixel takes what the frame shows along its ray.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark.matcher.nearest.cells import CellBounds
from phasemark.matcher.nearest.grid import closing_period, first_step
from phasemark.matcher.nearest.templates import Observation
from phasemark.matcher.one_frequency import OneFrequency
from phasemark.render import Sensor
from phasemark.render.rigid import tilt2level
from phasemark.render.view import VIEW_FIELDS

_T = TypeVar("_T", bound=np.generic)
Known = tuple[NDArray[np.int64], NDArray[np.float64]]
"""Classes and views that explain a frame."""
CostOf = Callable[[int, NDArray[np.int64], NDArray[np.float64]], NDArray[np.float64]]
"""Returns the costs of a frame, which is counted from 0, at classes and views."""

_N_MODES = 12
"""Local minima of the cells of one class that are refined, at most."""
_CLOSE = 2, 2, 1
"""Cells, columns in the last place, within which a descent from one place stands for all: D, δ, bearing."""


@dataclass(frozen=True, eq=False)
class Starts:
    """Candidates of n frames; (k,) arrays.

    Parameters
    ----------
    frame, class_index : int64
    view : (k, 6) float64
    """

    frame: NDArray[np.int64]
    class_index: NDArray[np.int64]
    view: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.frame)

    def __getitem__(self, index: NDArray[Any] | slice) -> Starts:
        return Starts(self.frame[index], self.class_index[index], self.view[index])

    def of_frames(self, frame: NDArray[np.int64]) -> Starts:
        """Return the starts of some frames, which are numbered in their order; `frame` rises."""
        own = self[np.isin(self.frame, frame)]
        return replace(own, frame=np.searchsorted(frame, own.frame))

    @staticmethod
    def joined(parts: Sequence[Starts]) -> Starts:
        """Return the starts of single frames as those of all."""
        none = Starts(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, len(VIEW_FIELDS))))
        frame = np.repeat(np.arange(len(parts)), [len(own) for own in parts])
        class_index, view = (
            np.concatenate([getattr(own, name) for own in (none, *parts)]) for name in ("class_index", "view")
        )
        return Starts(frame, class_index, view)


class Upward(NamedTuple):
    """Prior knowledge of the parameters that move the landmark up and down in the image.

    Parameters
    ----------
    height_std_m, pitch_std_rad : float
        Standard deviations, 0 of what is known and infinite where nothing is.
    sigma : float
        Up to how many of them starts are looked for.
    """

    height_std_m: float = 0.0
    pitch_std_rad: float = 0.0
    sigma: float = 3.0

    def widest_rad(self, distance_m: float) -> float:
        """Return the largest elevation of the landmark that is looked for."""
        return self.sigma * math.hypot(self.height_std_m / distance_m, self.pitch_std_rad)

    def split(self, elevation_rad: float, distance_m: float) -> tuple[float, float]:
        """Return the likeliest height and pitch of a landmark that is seen at an elevation."""
        by_height, by_pitch = (self.height_std_m / distance_m) ** 2, self.pitch_std_rad**2
        if math.isinf(by_height) and math.isinf(by_pitch):
            by_height = by_pitch = 1.0
        whole = by_height + by_pitch
        if whole == 0:
            return 0.0, 0.0
        share = 1.0 if math.isinf(by_height) else by_height / whole
        height_m = distance_m * math.tan(share * elevation_rad)
        # heights start at this in place of 0, where the box's top appears and slopes of one side would hold them
        off_kink_m = 0.002
        return height_m or (off_kink_m if by_height else 0.0), (1 - share) * elevation_rad


class Search:
    """A first look at the cells of a bank, over the bearings and elevations that are looked for.

    Parameters
    ----------
    cells : CellBounds
    sensor : Sensor
        The camera, or that of one frequency of several.
    layers : OneFrequency or None
        How the images of several frequencies lie above one another; None where there is one image.
    widest_rad : float
        How far the landmark may be off to a side; at most a quarter of the image.
    upward : Upward
        How far it may be off upwards or downwards; at most a quarter of the image too.
    bearing_std_rad : float
        Standard deviation of the bearing before a frame is seen.
    """

    def __init__(
        self,
        cells: CellBounds,
        sensor: Sensor,
        layers: OneFrequency | None,
        widest_rad: float,
        upward: Upward = Upward(),  # noqa: B008 - a constant
        bearing_std_rad: float = math.inf,
    ) -> None:
        self.cells, self._sensor, self._layers = cells, sensor, layers
        self._of_each: Sequence[CellBounds] = ()
        self._tilt_rad: NDArray[np.float64] | None = None
        self._upward, self._bearing_std_rad = upward, bearing_std_rad
        self.column_rad = sensor.pixel_rad
        most = min(sensor.cols // 4, math.ceil(min(widest_rad / self.column_rad, sensor.cols)))
        self.widest_columns = most
        self._row_rad = 2 * math.atan(sensor.tan_half_angles[1]) / sensor.rows
        widest_up = upward.widest_rad(float(cells.distance_m[0]))
        highest = min(sensor.rows // 4, math.ceil(min(widest_up / self._row_rad, sensor.rows)))
        most_up = 4  # number of shifts upwards, and downwards, that are compared
        stride_up = max(math.ceil(highest / most_up), 1)
        highest -= highest % stride_up
        self._classes = range(cells.shape[0])
        self._neighbours = cells.closes, 2 * most + 1
        self.shifts = [(up, side) for up in range(-highest, highest + 1, stride_up) for side in range(-most, most + 1)]
        # of the image that is shifted by whole columns: left is positive, and a smaller column
        self._bearing_rad = -np.arctan(np.array(self.shifts)[:, 1] / sensor.columns_per_tangent)

    def before(self, *cells: CellBounds) -> Search:
        """Return the search before what stands behind all frames, or before that of each, by the cells of the bank."""
        other = copy.copy(self)
        other.cells, other._of_each = cells[0], cells[1:] and cells
        return other

    def tilted(self, tilt_rad: NDArray[np.float64]) -> Search:
        """Return the search in frames of known pitch and roll, (n, 2); its cells span half a pixel to all sides."""
        other = copy.copy(self)
        other._tilt_rad = tilt_rad
        return other

    def of_frames(self, frame: NDArray[np.int64]) -> Search:
        """Return the search for some of the frames."""
        some = self.before(*(self._of_each[k] for k in frame)) if self._of_each and len(frame) else self
        return some if self._tilt_rad is None else some.tilted(self._tilt_rad[frame])

    def cells_of(self, frame: int) -> CellBounds:
        """Return the cells of the bank before what stands behind a frame."""
        return self._of_each[frame] if self._of_each else self.cells

    def starts(self, seen: Observation, limit: NDArray[np.float64], cost_of: CostOf | None = None) -> Starts:
        """Return the local minima among the cells of every frame that may hold an explanation, of each class its own.

        Parameters
        ----------
        seen : Observation
            Whole frames.
        limit : (n,) float64
            Cost up to which a view explains a frame. Where no cell is below, the limit of the frame is raised.
        cost_of : callable, optional
            Returns the costs of views of some classes of a frame, whatever their elevation, more exactly than the
            cells tell them.
        """
        frames, found = _Moved(self, seen), []
        raised = 3.0  # factor by which the limit of a frame is raised that no view explains
        for f in range(len(limit)):
            own = limit[f]
            while not np.isfinite(cost := frames.costs(f, own)).any():
                own *= raised
            if cost_of is not None:
                cost[[up != 0 for up, _ in self.shifts]] = np.inf
                self._tell(_least(cost), f, cost_of)
            found.append(self._views(cost, [modes(cost, c, _N_MODES, *self._neighbours) for c in self._classes], f))
        return Starts.joined(found)

    def uncovered(
        self,
        seen: Observation,
        limit: NDArray[np.float64],
        known: Sequence[Known],
        cost_of: CostOf | None = None,
        slack: float = math.inf,
    ) -> Starts:
        """Return views in all cells of every frame that may hold an explanation but are not close to a known one.

        Parameters
        ----------
        seen : Observation
        limit : (n,) float64
        known : sequence of (classes, views)
            What explains each frame, (k,) int64 and (k, 6) float64.
        cost_of : callable, optional
            As for :meth:`starts`.
        slack : float
            Cells are left out whose middles cost more than the limit by this.
        """
        frames, found = _Moved(self, seen), []
        for f in range(len(limit)):
            cost = frames.costs(f, limit[f])
            for c, view in zip(*known[f], strict=True):
                cost[self._close_to(int(c), view)] = np.inf
            self._tell(cost, f, cost_of)
            cost[cost > limit[f] + slack] = np.inf
            places = [cover(cost, c, *self._neighbours, *_CLOSE) for c in self._classes]
            found.append(self._views(cost, places, f))
        return Starts.joined(found)

    def may_explain(self, seen: Observation, limit: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether any cell may hold an explanation of each frame, (n,); arguments as for :meth:`starts`."""
        frames = _Moved(self, seen)
        return np.array([frames.has_cell(f, own) for f, own in enumerate(limit)], np.bool_)

    def _tell(self, cost: NDArray[np.float32], f: int, cost_of: CostOf | None) -> None:
        """Replace the costs of cells that may explain a frame by those of their middles, if these can be told."""
        if cost_of is not None:
            at = b, c, i, j = np.nonzero(np.isfinite(cost))
            cost[at] = cost_of(f, c, self._middles(b, i, j, f))

    def _middles(self, b: NDArray[np.int64], i: NDArray[np.int64], j: NDArray[np.int64], f: int) -> NDArray[np.float64]:
        """Return the views in the middles of cells at the tilt of a frame, (k, 6)."""
        view = np.zeros((len(b), len(VIEW_FIELDS)))
        view[:, 0], view[:, 1], view[:, 2] = self.cells.distance_m[i], self.cells.delta_rad[j], self._bearing_rad[b]
        for k, shift in enumerate(b):
            view[k, 3:5] = self._upward.split(self.shifts[shift][0] * self._row_rad, view[k, 0])
        if self._tilt_rad is not None:
            view[:, 4:] += self._tilt_rad[f]
        return view

    def _views(self, cost: NDArray[np.float32], places: Sequence[NDArray[np.int64]], f: int) -> Starts:
        """Return the views in some cells of one frame, (k, 3) of each class; best first."""
        places = [own[own[:, 0] >= 0] for own in places]
        c = np.repeat(np.arange(len(places)), [len(own) for own in places])
        b, i, j = np.concatenate(places).T
        costs = cost[b, c, i, j].astype(np.float64)
        order = np.argsort(costs, kind="stable")
        return Starts(np.zeros(len(order), np.int64), c, self._middles(b, i, j, f))[order]

    def rows_of(self, starts: Starts) -> NDArray[np.bool_]:
        """Return in which rows of cells, (class, D), those are that starts of :meth:`uncovered` stand for."""
        reach_m = (_CLOSE[0] + 0.5) * first_step(self.cells.distance_m)
        rows = np.zeros(self.cells.shape[:2], np.bool_)
        np.logical_or.at(rows, starts.class_index, np.abs(self.cells.distance_m - starts.view[:, :1]) <= reach_m)
        return rows

    def _close_to(self, c: int, view: NDArray[np.float64]) -> tuple[Any, ...]:
        """Return which cells of a class are close to a view, as an index of costs; whatever the elevation."""
        cells = self.cells
        along = np.flatnonzero(np.abs(cells.distance_m - view[0]) <= _CLOSE[0] * first_step(cells.distance_m))
        period = closing_period(cells.delta_rad) or 2 * math.pi
        off = (cells.delta_rad - view[1] + period / 2) % period - period / 2
        around = np.flatnonzero(np.abs(off) <= _CLOSE[1] * first_step(cells.delta_rad))
        beside = np.flatnonzero(np.abs(self._bearing_rad - view[2]) <= _CLOSE[2] * self.column_rad)
        return np.ix_(beside, np.array([c]), along, around)

    def prior(self, index: int) -> float:
        """Return what the prior adds to the cost of the most likely bearing within half a column."""
        off = max(abs(float(self._bearing_rad[index])) - self.column_rad / 2, 0.0)
        return (off / self._bearing_std_rad) ** 2

    def shifted(self, seen: Observation, shift: tuple[int, int]) -> Observation:
        """Move frames by a shift (rows up, columns right), so that the shifted point comes to the middle."""
        up, side = shift
        if up == 0 and side == 0:
            return seen
        rows, cols = self._sensor.rows, self._sensor.cols
        to_rows, from_rows = slice(max(up, 0), rows + min(up, 0)), slice(max(-up, 0), rows + min(-up, 0))
        to_cols, from_cols = slice(max(-side, 0), cols + min(-side, 0)), slice(max(side, 0), cols + min(side, 0))
        return self._moved(seen, (to_rows, to_cols), (from_rows, from_cols))

    def levelled(self, seen: Observation) -> Observation:
        """Return frames as a level camera would see them: each pixel what a frame shows along its ray."""
        if self._tilt_rad is None or not len(seen.returned):
            return seen
        sensor, parts = self._sensor, []
        v, u = np.mgrid[: sensor.rows, : sensor.cols]
        level = sensor.ray_directions(u + 0.5, v + 0.5)
        for k, turn in enumerate(tilt2level(*self._tilt_rad.T) @ sensor.cam2level):
            x, y, z = np.moveaxis(level @ turn, -1, 0)
            ahead = np.maximum(x, 1e-6)
            at_u, at_v = (np.floor(place).astype(np.int64) for place in sensor.image_points(y / ahead, z / ahead))
            inside = (x > 0) & (at_u >= 0) & (at_u < sensor.cols) & (at_v >= 0) & (at_v < sensor.rows)
            there, here = (v[inside], u[inside]), (at_v[inside], at_u[inside])
            parts.append(self._moved(seen[k : k + 1], there, here))
        return Observation(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(seen)))

    def _moved(self, seen: Observation, to: tuple[Any, Any], of: tuple[Any, Any]) -> Observation:
        """Return frames whose pixels `to` are what was seen in pixels `of`; the others are missing."""
        cols, layers = self._sensor.cols, self._layers

        def move(values: NDArray[_T]) -> NDArray[_T]:
            grid = values.reshape(len(values), values.shape[1] // cols, cols)
            if layers is not None:
                grid = layers.layers(grid)
            out = np.zeros_like(grid)
            out[..., to[0], to[1]] = grid[..., of[0], of[1]]
            return (out if layers is None else layers.stack(out)).reshape(values.shape)

        return Observation(move(seen.range_m), move(seen.weight), move(seen.returned), move(seen.not_returned))


class _Moved:
    """Frames under all shifts of a search, and what they cost in its cells."""

    def __init__(self, search: Search, seen: Observation) -> None:
        self._search = search
        level = search.levelled(seen)
        moved = [search.shifted(level, shift) for shift in search.shifts]
        count = seen.returned.sum(axis=1)  # turned level, a return may stand in two pixels
        self._lost = [np.maximum(count - own.returned.sum(axis=1), 0).astype(np.float32) for own in moved]
        each = range(len(seen.returned))
        self._prepared = [[search.cells_of(f).prepared(own[f : f + 1]) for f in each] for own in moved]

    def costs(self, f: int, limit: float) -> NDArray[np.float32]:
        """Return what a frame costs about the middle of each cell, (shift, class, D, δ), infinite above the limit."""
        cost = np.empty((len(self._prepared), *self._search.cells.shape), np.float32)
        for b in range(len(cost)):
            self._fill(cost[b], f, b, limit)
        return cost

    def has_cell(self, f: int, limit: float) -> bool:
        """Return whether any cell may hold an explanation of a frame; the likeliest shifts are tried first."""
        cost = np.empty(self._search.cells.shape, np.float32)
        for b in np.argsort(np.abs(np.arange(len(self._prepared)) - len(self._prepared) // 2), kind="stable"):
            self._fill(cost, f, int(b), limit)
            if np.isfinite(cost).any():
                return True
        return False

    def _fill(self, cost: NDArray[np.float32], f: int, b: int, limit: float) -> None:
        search = self._search
        search.cells_of(f).fill_costs(cost, self._prepared[b][f], search.prior(b), limit)
        cost += self._lost[b][f]


def _least(cost: NDArray[np.float32]) -> NDArray[np.float32]:
    """Set all costs (shift, class, D, δ) infinite but the least of each class under each shift; return them."""
    most_told = 512  # cells of a class under a shift whose costs are told more exactly where a descent starts
    for own in cost.reshape(*cost.shape[:2], -1).reshape(-1, math.prod(cost.shape[2:])):
        if len(own) > most_told:
            own[own > np.partition(own, most_told)[most_told]] = np.inf
    return cost


@njit(cache=True, nogil=True)
def cover(cost, c, closes, n_side, reach_d, reach_a, reach_side):  # type: ignore[no-untyped-def]
    """Return places of finite cost, lowest first, such that each is within reach of one of them.

    `cost` is (shift, class, D, δ), of which class `c` counts.
    """
    n_b, n_d, n_a = cost.shape[0], cost.shape[2], cost.shape[3]
    n = 0
    for b in range(n_b):
        for i in range(n_d):
            for j in range(n_a):
                n += cost[b, c, i, j] < np.inf
    place, value = np.empty((n, 3), np.int64), np.empty(n, cost.dtype)
    n = 0
    for b in range(n_b):
        for i in range(n_d):
            for j in range(n_a):
                if cost[b, c, i, j] < np.inf:
                    place[n, 0], place[n, 1], place[n, 2] = b, i, j
                    value[n] = cost[b, c, i, j]
                    n += 1
    found, k = np.empty((n, 3), np.int64), 0
    for at in np.argsort(value, kind="mergesort"):
        b, i, j = place[at]
        covered = False
        for m in range(k):
            around = abs(found[m, 2] - j)
            if closes:
                around = min(around, n_a - around)
            sideways, upwards = abs(found[m, 0] % n_side - b % n_side), abs(found[m, 0] // n_side - b // n_side)
            if upwards <= 1 and sideways <= reach_side and abs(found[m, 1] - i) <= reach_d and around <= reach_a:
                covered = True
                break
        if not covered:
            found[k] = place[at]
            k += 1
    return found[:k]


@njit(cache=True, nogil=True)
def modes(cost, c, n_modes, closes, n_side):  # type: ignore[no-untyped-def]
    """Return the lowest local minima of class `c` of cost (shift, class, D, δ), best first; −1 behind the last.

    Of the shifts, `n_side` sideways follow one another for each upwards.
    """
    n_b, n_d, n_a = cost.shape[0], cost.shape[2], cost.shape[3]
    n_up = n_b // n_side
    found = np.full((n_modes, 3), -1, np.int64)
    lowest = np.full(n_modes, np.inf, cost.dtype)
    for b in range(n_b):
        for i in range(n_d):
            for j in range(n_a):
                own = cost[b, c, i, j]
                if not own < lowest[-1]:
                    continue
                least = True
                up, side = b // n_side, b % n_side
                for uu in range(max(up - 1, 0), min(up + 2, n_up)):
                    for ss in range(max(side - 1, 0), min(side + 2, n_side)):
                        for ii in range(max(i - 1, 0), min(i + 2, n_d)):
                            for jj in range(j - 1, j + 2):
                                if closes:
                                    jj %= n_a
                                if 0 <= jj < n_a and cost[uu * n_side + ss, c, ii, jj] < own:
                                    least = False
                if not least:
                    continue
                k = n_modes - 1
                while k > 0 and lowest[k - 1] > own:
                    lowest[k] = lowest[k - 1]
                    found[k] = found[k - 1]
                    k -= 1
                lowest[k] = own
                found[k, 0], found[k, 1], found[k, 2] = b, i, j
    return found
