"""Initial guesses: the best views of a thinned bank, several modes of the likelihood, any bearing.

A bearing moves the image sideways, a height or a pitch up and down. The rays of a turned camera meet the landmark at
the same ranges, so a frame shifted by whole columns and rows is compared with the bank's images ahead; what is
shifted in is missing, and a return that is shifted out is one that no model explains.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark.matcher.nearest.grid import closing_period
from phasemark.matcher.nearest.templates import Observation
from phasemark.matcher.nearest.thinned_bank import ThinnedBank
from phasemark.matcher.pixel_agreement import DISAGREEMENT
from phasemark.render import PhasorImages
from phasemark.render.view import VIEW_FIELDS, wrap_delta_difference_rad

_T = TypeVar("_T", bound=np.generic)

_UNDECIDED, _SHARE = 300.0, 0.5
"""Other classes start too where their cost is larger by no more than this, and this share of the best: between the
grid's points none of them fits."""
_GRID_STD_M = 0.01
"""What half a step of the thinned grid changes in a range."""
_MOST_UP = 4
"""Number of shifts upwards, and downwards, that are compared."""
_OFF_KINK_M = 0.002
"""Heights start at this in place of 0, where the box's top appears and slopes of one side would hold them."""
_FRAMES_TIMES_SHIFTS = 1 << 12
"""Frames are searched in groups of this over the number of shifts: the costs of a group are kept."""
_MOST_OTHER_SIDES = 2
_OTHER_SIDE_RAD = math.radians(30.0)
"""Number of further sides that are tried, and the least angle between them."""
_OTHER_SIDE_COST, _OTHER_SIDE_SHARE = 100.0, 4.0
"""Largest cost of a further side on the grid: a constant, plus a multiple of the lowest cost."""


@dataclass(frozen=True, eq=False)
class Starts:
    """Candidates of n frames; (k,) arrays, those of a frame together, best first.

    Parameters
    ----------
    frame, class_index : int64
    view : (k, 6) float64
    cost : float64
        Whitened squared distance on the grid.
    """

    frame: NDArray[np.int64]
    class_index: NDArray[np.int64]
    view: NDArray[np.float64]
    cost: NDArray[np.float64]


_NO_STARTS = Starts(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, len(VIEW_FIELDS))), np.empty(0))


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
        return height_m or (_OFF_KINK_M if by_height else 0.0), (1 - share) * elevation_rad


class Search:
    """A first look at a thinned bank.

    Parameters
    ----------
    bank : ThinnedBank
    behind : PhasorImages, optional
        What stands behind the landmark.
    widest_rad : float
        How far the landmark may be off to a side; at most a quarter of the image.
    upward : Upward
        How far it may be off upwards or downwards; at most a quarter of the image too.
    capped : bool
        Whether no pixel costs more than a disagreement: other things may stand in view.
    """

    def __init__(
        self,
        bank: ThinnedBank,
        behind: PhasorImages | None,
        widest_rad: float,
        upward: Upward = Upward(),  # noqa: B008 - a constant
        *,
        capped: bool = False,
    ) -> None:
        self._layers, self._n_class = bank.layers, bank.n_class
        self._sensor = bank.sensor if bank.layers is None else bank.layers.camera
        self._capped = capped
        self._distance, self._delta, self._closes = bank.distance_m, bank.delta_rad, bank.closes
        self._parts = bank.templates(behind)
        self._upward = upward
        self._look(widest_rad)

    def _look(self, widest_rad: float) -> None:
        """Set the shifts to each side by which the landmark may be off."""
        sensor, upward = self._sensor, self._upward
        self.column_rad = 2 * math.atan(sensor.tan_half_angles[0]) / sensor.cols
        most = min(sensor.cols // 4, math.ceil(min(widest_rad / self.column_rad, sensor.cols)))
        self._row_rad = 2 * math.atan(sensor.tan_half_angles[1]) / sensor.rows
        widest_up = upward.widest_rad(float(self._distance[0]))
        highest = min(sensor.rows // 4, math.ceil(min(widest_up / self._row_rad, sensor.rows)))
        stride_up = max(math.ceil(highest / _MOST_UP), 1)
        highest -= highest % stride_up
        self._n_side = 2 * most + 1
        self._shifts = [(up, side) for up in range(-highest, highest + 1, stride_up) for side in range(-most, most + 1)]

    def over(self, widest_rad: float) -> Search:
        """Return the same search, with its templates, over other bearings."""
        other = copy.copy(self)
        other._look(widest_rad)
        return other

    def capped(self) -> Search:
        """Return the same search, in which no pixel costs more than a disagreement."""
        other = copy.copy(self)
        other._capped = True
        return other

    def of_frames(self, frame: NDArray[np.int64]) -> Search:
        """Return the search for some frames: it is the same for all."""
        return self

    def starts(self, seen: Observation, n_modes: int, *, all_classes: bool = False) -> Starts:
        """Return the best modes of every frame.

        Parameters
        ----------
        seen : Observation
            Whole frames.
        n_modes : int
            How many of each frame, at most.
        all_classes : bool
            Whether classes that are hardly worse than the best one of a mode start there too.
        """
        n, n_bearing = len(seen.range_m), len(self._shifts)
        if not n:
            return _NO_STARTS
        at_once = max(_FRAMES_TIMES_SHIFTS // n_bearing, 1)
        if n > at_once:
            groups = [slice(start, start + at_once) for start in range(0, n, at_once)]
            found_in = [self.starts(seen[group], n_modes, all_classes=all_classes) for group in groups]
            return _joined(found_in, (group.start for group in groups))
        shape = (len(self._distance), len(self._delta))
        best = np.empty((n, n_bearing, *shape), np.float32)
        by_class = []
        for k, shift in enumerate(self._shifts):
            best[:, k], above = self._costs(self._shifted(seen, shift), seen)
            by_class.append(above)
        frame, class_index, views, cost = [], [], [], []
        for f in range(n):
            found = modes(best[f], n_modes, self._closes, self._n_side)
            for b, i, j in np.concatenate([found[found[:, 0] >= 0], self._other_sides(best[f], found)]):
                least = float(best[f, b, i, j])
                above = by_class[b][f, :, i, min(j, by_class[b].shape[-1] - 1)]
                for c in np.argsort(above, kind="stable")[: None if all_classes else 1]:
                    if above[c] > _UNDECIDED + _SHARE * least:
                        break
                    frame.append(f)
                    class_index.append(c)
                    height, pitch = self._upward.split(self._elevation(b), float(self._distance[i]))
                    views.append((self._distance[i], self._delta[j], self._bearing(b), height, pitch, 0.0))
                    cost.append(least + float(above[c]))
        return Starts(
            np.array(frame, np.int64),
            np.array(class_index, np.int64),
            np.array(views, np.float64).reshape(-1, len(VIEW_FIELDS)),
            np.array(cost, np.float64),
        )

    def _other_sides(self, cost: NDArray[np.float32], found: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the best views from sides far from those found already, where they cost little more; (k, 3).

        A thin landmark looks nearly the same from the front and from the back. Without these views the neighbours of
        one side alone would be compared, and the answer would not know that it is ambiguous.
        """
        profile = cost.min(axis=(0, 1))
        least = float(profile.min())
        taken = found[found[:, 0] >= 0, 2]
        period = closing_period(self._delta) or 4 * math.pi
        others = []
        for _ in range(_MOST_OTHER_SIDES):
            away = np.abs(wrap_delta_difference_rad(self._delta[:, None] - self._delta[None, taken], period)).min(
                axis=1
            )
            open_ = np.where(away > _OTHER_SIDE_RAD, profile, np.inf)
            j = int(open_.argmin())
            if not open_[j] <= _OTHER_SIDE_COST + _OTHER_SIDE_SHARE * least:
                break
            b, i = np.unravel_index(int(cost[:, :, j].argmin()), cost.shape[:2])
            others.append((b, i, j))
            taken = np.append(taken, j)
        return np.array(others, np.int64).reshape(-1, 3)

    def _bearing(self, index: int) -> float:
        """Return the bearing whose image is shifted by whole columns: left is positive, and a smaller column."""
        return -self._shifts[index][1] * self.column_rad

    def _elevation(self, index: int) -> float:
        """Return the elevation whose image is shifted by whole rows."""
        return self._shifts[index][0] * self._row_rad

    def _shifted(self, seen: Observation, shift: tuple[int, int]) -> Observation:
        """Move frames by a shift (rows up, columns right), so that the shifted point comes to the middle."""
        up, side = shift
        if up == 0 and side == 0:
            return seen
        rows, cols, layers = self._sensor.rows, self._sensor.cols, self._layers

        def move(values: NDArray[_T]) -> NDArray[_T]:
            grid = values.reshape(len(values), -1, cols)
            if layers is not None:
                grid = layers.layers(grid)
            out = np.zeros_like(grid)
            to_rows, from_rows = slice(max(up, 0), rows + min(up, 0)), slice(max(-up, 0), rows + min(-up, 0))
            to_cols, from_cols = slice(max(-side, 0), cols + min(-side, 0)), slice(max(side, 0), cols + min(side, 0))
            out[..., to_rows, to_cols] = grid[..., from_rows, from_cols]
            return (out if layers is None else layers.stack(out)).reshape(values.shape)

        return Observation(move(seen.range_m), move(seen.weight), move(seen.returned), move(seen.not_returned))

    def _costs(self, moved: Observation, seen: Observation) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the cost of the best class at every view of the grid, (n, D, δ), and how far above it each class is.

        The latter is (n, class, D, δ), or (n, class, D, 1) where it does not depend on δ.
        """
        n, cols = len(moved.range_m), self._sensor.cols
        n_class, shape = self._n_class, (len(self._distance), len(self._delta))
        out = DISAGREEMENT * (seen.returned.sum(axis=1) - moved.returned.sum(axis=1)).astype(np.float32)
        pose: NDArray[np.float32] | None = None
        upper: NDArray[np.float32] | None = None
        for templates, (first, stop), is_upper in self._parts:
            picked = slice(first * cols, stop * cols)
            part = Observation(
                moved.range_m[:, picked], moved.weight[:, picked],
                moved.returned[:, picked], moved.not_returned[:, picked],
            )  # fmt: skip
            costs = templates.capped_costs(part, _GRID_STD_M) if self._capped else templates.costs(part)
            if is_upper:
                upper = costs.reshape(n, n_class, shape[0])
            else:
                pose = costs.reshape(n, -1, *shape)
        assert pose is not None
        if upper is None:
            least = pose.min(axis=1)
            return least + out[:, None, None], pose - least[:, None]
        least = upper.min(axis=1)
        return pose[:, 0] + least[:, :, None] + out[:, None, None], (upper - least[:, None])[..., None]


class SearchOfFrames:
    """A first look at a bank before what stands behind each of n frames.

    Parameters
    ----------
    searches : sequence of Search
        One for each frame.
    column_rad : float
        Width of a column of the image.
    """

    def __init__(self, searches: Sequence[Search], column_rad: float) -> None:
        self._searches, self.column_rad = searches, column_rad

    def capped(self) -> SearchOfFrames:
        """Return the same search, in which no pixel costs more than a disagreement."""
        return SearchOfFrames([search.capped() for search in self._searches], self.column_rad)

    def of_frames(self, frame: NDArray[np.int64]) -> SearchOfFrames:
        """Return the search for some of the frames."""
        return SearchOfFrames([self._searches[k] for k in frame], self.column_rad)

    def starts(self, seen: Observation, n_modes: int, *, all_classes: bool = False) -> Starts:
        """Return the best modes of every frame; see :meth:`Search.starts`."""
        found = [
            search.starts(seen[k : k + 1], n_modes, all_classes=all_classes) for k, search in enumerate(self._searches)
        ]
        return _joined(found, range(len(found))) if found else _NO_STARTS


def _joined(parts: Sequence[Starts], first: Iterable[int]) -> Starts:
    """Return the starts of groups of frames, of which each begins with some frame of all."""
    return Starts(
        np.concatenate([own.frame + k for own, k in zip(parts, first, strict=True)]),
        *(np.concatenate([getattr(own, name) for own in parts]) for name in ("class_index", "view", "cost")),
    )


@njit(cache=True, nogil=True)
def modes(cost, n_modes, closes, n_side):  # type: ignore[no-untyped-def]
    """Return the lowest local minima of cost (shift, D, δ), best first; −1 behind the last.

    Of the shifts, `n_side` sideways follow one another for each upwards.
    """
    n_b, n_d, n_a = cost.shape
    n_up = n_b // n_side
    found = np.full((n_modes, 3), -1, np.int64)
    lowest = np.full(n_modes, np.inf, cost.dtype)
    for b in range(n_b):
        for i in range(n_d):
            for j in range(n_a):
                own = cost[b, i, j]
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
                                if 0 <= jj < n_a and cost[uu * n_side + ss, ii, jj] < own:
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
