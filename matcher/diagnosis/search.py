"""Rough search for a landmark of any bearing, before a camera of any field of view, to find what is worth matching.

Views are rendered on a grid about what the nearest returns say of distance and bearing. The best of them are refined by
damped least squares of the ranges, with a limit on what a single pixel may cost.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.matcher.filters.filtered_frames import FilteredFrames, PixelState
from phasemark.render import Background, Renderer, Sensor, Views, predicted_range_std
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.view import delta_period_rad, wrap_delta_rad

_Float = NDArray[np.float64]
_Rows = tuple[int, int] | None

SIZES = (0.8, 0.85, 0.9, 0.95, 1.05, 1.1, 1.15, 1.2)
"""Fields of view that are tried, as ratios of the tangents of half angles."""
_SIZE_LIMITS = (0.7, 1.4)
MOST_COST = 25.0
"""Limit of a pixel's cost, and the cost of a pixel that returns here and not there."""
_LEAST_STD_M = 3e-4
"""Ranges are not trusted further than rendering and interpolation go."""
_LANDMARK_DEPTH_M = 0.4
_DELTA_STEP_RAD, _WIDE_STEP_RAD = math.radians(6.0), math.radians(10.0)
_DISTANCE_OFFSETS_M = (-0.012, 0.0, 0.012)
_MIXED_OFFSETS_M = (-0.1, -0.06, -0.03, -0.01, 0.01)
"""Before a background wide pixels mix it in: the nearest range is farther than the nearest surface."""
_BEARING_OFFSETS_COLUMNS = (-0.3, 0.0, 0.3)
_REFINED = (4, 2, 1)
"""How many views are refined with more slack, with less, and with none."""
_SLACKS_M = (0.012, 0.003)
"""Added to the noise, metres: in the search, which has to separate views, and in the refinement."""
_STEPS = (1e-4, 1e-4, 1e-4, 1e-4)
_COVERAGE_SEEN, _COVERAGE_MUST = 1e-4, 0.4
_NEAR_WALL, _FEWEST_ON_WALL = 0.05, 6


@dataclass(frozen=True)
class Fit:
    """A rough fit of one frame.

    Parameters
    ----------
    class_name : str
    distance_m, delta_rad, bearing_rad : float
    size : float
        Field of view, as a ratio of the tangents of half angles to those of the bank's camera.
    cost : float
        Sum over pixels of the squared normalised residual, at most 25 each.
    n_pixels : int
        How many pixels returned.
    """

    class_name: str
    distance_m: float
    delta_rad: float
    bearing_rad: float
    size: float
    cost: float
    n_pixels: int


class Search:
    """Searches frames for the landmarks of a bank, whatever the bank's grid.

    Parameters
    ----------
    bank : Bank
    """

    def __init__(self, bank: Bank) -> None:
        self._sensor = bank.sensor
        self._names = bank.classes
        self._renderers: list[Renderer] = []
        self._symmetry: list[int] = []
        for name in bank.classes:
            mesh = bank.mesh(name)
            self._renderers.append(Renderer(mesh, bank.sensor, albedo=float(mesh.metadata["albedo"])))
            self._symmetry.append(int(mesh.metadata["symmetry"]))
        self._shared = bank.lower is not None
        """Whether all classes stand on the same lower part."""

    def best(
        self, frame: FilteredFrames, background: Background | None, *, sizes: Sequence[float] = (1.0,), bearing: bool
    ) -> Fit | None:
        """Return the best fit to one frame; None if it has no returns or no view can be rendered.

        Parameters
        ----------
        frame : FilteredFrames
        background : Background or None
            What stands behind the landmark.
        sizes : sequence of float
            Fields of view where the search starts; one alone is held.
        bearing : bool
            Whether the bearing is free; otherwise it is 0.
        """
        seen = _Seen.of(frame)
        if not seen.returned.any():
            return None
        coarse = seen.with_slack(_SLACKS_M[0])
        free = [0, 1] + ([2] if bearing else []) + ([3] if len(sizes) > 1 else [])
        rows = self._sensor.lower_rows if self._shared else None
        kept, most_classes = 8, 6
        classes = range(1 if self._shared else min(len(self._names), most_classes))
        grids = {c: self._grid(c, frame, sizes, bearing, mixed=background is not None) for c in classes}
        starts = self._ranked(grids, coarse, background, rows)[:kept]
        of_class = {c: [view for _, k, view in starts if k == c or self._shared] for c in range(len(self._names))}
        views = {c: np.stack(own) for c, own in of_class.items() if own}
        whole = [start for start in self._ranked(views, coarse, background) if math.isfinite(start[0])]
        for slack_m, n in zip((*_SLACKS_M, 0.0), _REFINED, strict=True):
            if slack_m > seen.usual_std_m or slack_m == 0.0:
                softened = seen.with_slack(slack_m)
                refined = [(c, *self._refine(c, view, free, softened, background)) for _, c, view in whole[:n]]
                whole = sorted(((cost, c, view) for c, view, cost in refined), key=lambda start: start[0])
        if not whole:
            return None
        least, c, view = whole[0]
        distance_m, delta_rad, bearing_rad, size = (float(value) for value in view)
        delta_rad = float(wrap_delta_rad(delta_rad, delta_period_rad(self._symmetry[c])))
        return Fit(self._names[c], distance_m, delta_rad, bearing_rad, size, least, int(seen.returned.sum()))

    def _ranked(
        self, views: Mapping[int, _Float], seen: _Seen, background: Background | None, rows: _Rows = None
    ) -> list[tuple[float, int, _Float]]:
        """Return (cost, class, view) of the views of some classes, lowest cost first."""
        found: list[tuple[float, int, _Float]] = []
        for c, own in views.items():
            found += zip(self._costs(c, own, seen, background, rows).tolist(), itertools.repeat(c), own)
        return sorted(found, key=lambda start: start[0])

    def _grid(self, c: int, frame: FilteredFrames, sizes: Sequence[float], bearing: bool, *, mixed: bool) -> _Float:
        """Return views (D, δ, bearing, size) about the nearest returns, (k, 4)."""
        sensor = self._sensor
        returned = frame.state[0] == PixelState.RETURN
        forward = np.where(returned, sensor.axis_cosine() * frame.range_m[0], np.inf)
        ordered = np.sort(forward[returned])
        nearest = float(ordered[min(1, len(ordered) - 1)])
        near = forward < nearest + _LANDMARK_DEPTH_M
        tan_h = sensor.tan_half_angles[0]
        column = np.broadcast_to(np.arange(sensor.cols) + 0.5, near.shape)[near].mean()
        per_column = 2 * math.atan(tan_h) / sensor.cols
        row = min(max(sensor.centre_px[1], 0.0), float(sensor.rows))
        middle = math.atan(float(sensor.tangents(column, row)[0]))
        middle -= math.radians(sensor.bearing_offset_deg)
        bearings = [middle + aside * per_column for aside in _BEARING_OFFSETS_COLUMNS] if bearing else [0.0]
        offsets = _MIXED_OFFSETS_M if mixed else _DISTANCE_OFFSETS_M
        vertices = self._renderers[c].topology.vertices
        grid: list[tuple[float, ...]] = []
        step = _DELTA_STEP_RAD if len(sizes) == 1 else _WIDE_STEP_RAD
        for delta in np.arange(0.0, delta_period_rad(self._symmetry[c]), step):
            along = vertices[:, 0] * math.cos(delta) + vertices[:, 1] * math.sin(delta)
            first = nearest - float(along.min())
            grid += [(first + off, delta, b, size) for off, size, b in itertools.product(offsets, sizes, bearings)]
        return np.array(grid)

    def _costs(self, c: int, views: _Float, seen: _Seen, background: Background | None, rows: _Rows = None) -> _Float:
        """Return the cost of every view, infinite where it cannot be rendered."""
        residual, mismatch = self._residuals(c, views, seen, background, rows)
        return np.asarray(np.minimum(residual**2, MOST_COST).sum(axis=1) + MOST_COST * mismatch.sum(axis=1))

    def _residuals(
        self, c: int, views: _Float, seen: _Seen, background: Background | None, rows: _Rows = None
    ) -> tuple[_Float, NDArray[np.bool_]]:
        """Return normalised residuals, 0 where frame and view cannot be compared, and which pixels contradict it."""
        first, stop = rows or (0, self._sensor.rows)
        picked = slice(first * self._sensor.cols, stop * self._sensor.cols)
        pixels = picked.stop - picked.start
        residual = np.full((len(views), pixels), np.inf)
        mismatch = np.ones((len(views), pixels), np.bool_)
        for size in np.unique(views[:, 3]):
            of = np.flatnonzero(views[:, 3] == size)
            if not _SIZE_LIMITS[0] <= size <= _SIZE_LIMITS[1]:
                continue
            sensor = wider(self._sensor, float(size))
            renderer = self._renderers[c].seen_by(sensor)
            arguments = Views.broadcast(views[of, 0], views[of, 1], views[of, 2], 0.0)
            behind = None if background is None else background.giving_way(renderer.topology.vertices, arguments)
            try:
                image = renderer.render_views(arguments, background=behind, rows=rows, workers=2)
            except UsageError:  # the lens inside the landmark
                continue
            amplitude = np.abs(image.phasor).reshape(len(of), pixels)
            coverage = image.coverage.reshape(len(of), pixels)
            intensity = image.intensity.reshape(len(of), pixels)
            limit = math.inf if sensor.max_phase_std_rad is None else sensor.max_phase_std_rad
            noise = predicted_range_std(amplitude, intensity, sensor) / sensor.metres_per_radian
            lit = amplitude > 0
            may = lit & (noise <= 2 * limit) & ((coverage > _COVERAGE_SEEN) | (background is not None))
            must = lit & (noise <= 0.5 * limit) & (coverage > _COVERAGE_MUST)
            returned, absent = seen.returned[picked], seen.absent[picked]
            difference = wrap_difference_m(seen.range_m[picked] - image.range_m.reshape(len(of), pixels), sensor)
            compared = returned & may
            residual[of] = np.where(compared, np.where(compared, difference, 0.0) * seen.root_weight[picked], 0.0)
            mismatch[of] = (returned & ~may) | (absent & must)
        return residual, mismatch

    def _refine(
        self, c: int, view: _Float, free: list[int], seen: _Seen, background: Background | None
    ) -> tuple[_Float, float]:
        """Lower the cost by damped least squares (Levenberg–Marquardt)."""
        damping = 1e-2
        cost = math.inf
        iterations = 6
        for _ in range(iterations):
            tried = np.stack([view, *(view + step * np.eye(4)[k] for k, step in enumerate(_STEPS) if k in free)])
            residual, mismatch = self._residuals(c, tried, seen, background)
            if not np.isfinite(residual).all():
                break
            cost = float(np.minimum(residual[0] ** 2, MOST_COST).sum() + MOST_COST * mismatch[0].sum())
            slope = (residual[1:] - residual[0]) / np.array([_STEPS[k] for k in free])[:, None]
            slope[mismatch[1:] | mismatch[0]] = 0.0
            for scale in (1.0, 100.0):  # far from the minimum all pixels count, near it those that fit
                counted = np.where(residual[0] ** 2 < MOST_COST * scale, 1.0, 0.0)
                if counted.sum() > 2 * len(free):
                    break
            information = (slope * counted) @ slope.T
            gradient = (slope * counted) @ residual[0]
            dampings = damping * np.array([1e-2, 1.0, 1e2, 1e4])
            steps = []
            for value in dampings:
                matrix = information + np.diag(value * np.diag(information) + 1e-9)
                step = np.zeros(4)
                step[free] = -np.linalg.solve(matrix, gradient)
                steps.append(np.clip(step, *_LONGEST))
            candidates = view + np.stack(steps)
            costs = self._costs(c, candidates, seen, background)
            best = int(np.argmin(costs))
            if not costs[best] < cost * (1 - 1e-4):
                break
            view, cost, damping = candidates[best], float(costs[best]), float(np.clip(dampings[best], 1e-6, 1e4))
        return view, cost


_LONGEST = (np.array([-0.05, -0.15, -0.05, -0.05]), np.array([0.05, 0.15, 0.05, 0.05]))


@dataclass(frozen=True, eq=False)
class _Seen:
    """Values of one frame at its pixels; (pixels,) arrays."""

    range_m: _Float
    root_weight: _Float
    returned: NDArray[np.bool_]
    absent: NDArray[np.bool_]

    @classmethod
    def of(cls, frame: FilteredFrames) -> _Seen:
        frame = frame.with_pooled_noise()
        returned = (frame.state[0] == PixelState.RETURN).ravel()
        std = np.where(returned, frame.std_m[0].ravel(), np.inf)
        returned &= np.isfinite(std)
        return cls(
            np.where(returned, frame.range_m[0].ravel(), 0.0),
            np.where(returned, 1 / np.maximum(std, _LEAST_STD_M), 0.0),
            returned,
            (frame.state[0] == PixelState.NO_RETURN).ravel(),
        )

    @property
    def usual_std_m(self) -> float:
        """Median standard deviation of a returned range."""
        return float(np.median(1 / self.root_weight[self.returned]))

    def with_slack(self, slack_m: float) -> _Seen:
        """Return the frame with a standard deviation added to its noise."""
        root_weight = self.root_weight / np.sqrt(1 + (slack_m * self.root_weight) ** 2)
        return replace(self, root_weight=root_weight)


def fitted_wall(frame: FilteredFrames, background: Background, bearing_rad: float) -> Background:
    """Return a background with its wall moved to where wide pixels, each an average over the wall, see it.

    Parameters
    ----------
    frame : FilteredFrames
        One frame.
    background : Background
        With a wall, as far as the centres of the pixels tell.
    bearing_rad : float
        Of the landmark: the wall is perpendicular to the line of sight.
    """
    frame = frame.with_pooled_noise()
    empty = Renderer(None, frame.sensor)
    returned = frame.state[0] == PixelState.RETURN
    for _ in range(3):
        assert background.wall_m is not None
        model_m = empty.render(1.0, 0.0, bearing_rad, background=background).range_m[0]
        ratio = frame.range_m[0] / model_m
        usable = returned & np.isfinite(ratio)
        near_wall = usable & (np.abs(np.where(usable, ratio, 0.0) - 1) < _NEAR_WALL)
        if near_wall.sum() < _FEWEST_ON_WALL:
            break
        weight = np.where(near_wall, model_m / np.where(near_wall, frame.std_m[0], 1.0), 0.0) ** 2
        if not np.isfinite(weight).all():
            break
        middle = float(np.median(ratio[near_wall]))
        spread = 1.4826 * float(np.median(np.abs(ratio[near_wall] - middle)))
        inner = near_wall & (np.abs(np.where(near_wall, ratio, np.inf) - middle) <= 4 * spread + 1e-6)
        background = replace(
            background, wall_m=background.wall_m * float(np.average(ratio[inner], weights=weight[inner]))
        )
    return background


def wider(sensor: Sensor, size: float) -> Sensor:
    """Return a camera whose half angles have tangents `size` times as large."""
    if size == 1.0:
        return sensor
    tan_h, tan_v = sensor.tan_half_angles
    lamp_deg = sensor.lamp_half_angle_deg
    return sensor.with_(
        half_angle_h_deg=math.degrees(math.atan(size * tan_h)),
        half_angle_v_deg=math.degrees(math.atan(size * tan_v)),
        lamp_half_angle_deg=None if lamp_deg is None else min(lamp_deg * max(size, 1.0), 180.0),
    )
