"""Rough search for a landmark of any bearing, before a camera of any field of view, to find what is worth matching.

Views are rendered on a grid about what the nearest returns say of distance and bearing. The best of them are refined as
those of a matcher are, with a robust loss and first with more noise than the frame has.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from phasemark.data import Bank
from phasemark.matcher.estimate.fits import Fits
from phasemark.matcher.filters.filtered_frames import FilteredFrames, PixelState
from phasemark.matcher.likelihood.background_estimate import fit_background
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.problem import DescentSettings
from phasemark.matcher.likelihood.refine import Candidates, costs_at, refine
from phasemark.matcher.likelihood.rendered_images import RenderedModel
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.setup import ROBUST_FROM
from phasemark.matcher.nearest.bank_minima import Starts
from phasemark.matcher.pixel_agreement import PERHAPS, counts
from phasemark.render import Background, Renderer, Sensor
from phasemark.render.view import delta_period_rad, wrap_delta_rad

_Float = NDArray[np.float64]

SIZES = (0.8, 0.85, 0.9, 0.95, 1.05, 1.1, 1.15, 1.2)
"""Fields of view that are tried, as ratios of the tangents of half angles."""
_SIZE_STEP, _SIZE_KNOWN = 0.05, 1e-3
"""How far from one of them the best one may be, and to what it is found."""
_LEAST_STD_M = 3e-4
"""Ranges are not trusted further than rendering goes."""
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
        Sum over pixels of the robust loss of the normalised residual, at most 25 each.
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
        self._sensor, self._names, self._model = bank.sensor, bank.classes, RenderedModel(bank)
        self._symmetry = [int(bank.mesh(name).metadata["symmetry"]) for name in bank.classes]
        self._shared = bank.lower is not None
        """Whether all classes stand on the same lower part."""

    def best(
        self, frame: FilteredFrames, background: Background | None, *, sizes: Sequence[float] = (1.0,), bearing: bool
    ) -> Fit | None:
        """Return the best fit to one frame; None if it has no returns.

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
        evidence = pooled_evidence(frame)
        returned = evidence.weight[0] > 0
        if not returned.any():
            return None
        free = VIEW[: 3 if bearing else 2]
        step_rad = _DELTA_STEP_RAD if len(sizes) == 1 else _WIDE_STEP_RAD
        most_classes = 6
        tried = range(1 if self._shared else min(len(self._names), most_classes))
        grids = [self._grid(c, frame, step_rad, bearing, mixed=background is not None) for c in tried]
        grid = _starts(np.repeat(tried, [len(views) for views in grids]), np.concatenate(grids))

        def refined(size: float, starts: Candidates, slack_m: float, *, roughly: bool = True) -> Fits:
            model, settings = self._before(background, size, free)
            fits = refine(model, _with_slack(evidence, slack_m), starts, settings, roughly=roughly)
            return fits[np.argsort(fits.cost, kind="stable")]

        def first(size: float) -> Fits:
            starts = self._best_of(*self._before(background, size, free), _with_slack(evidence, _SLACKS_M[0]), grid)
            return refined(size, starts[: _REFINED[0]], _SLACKS_M[0])

        size, fits = min(((size, first(size)) for size in sizes), key=lambda one: float(one[1].cost[0]))
        if len(sizes) > 1:
            best, bounds = fits[:1], (size - _SIZE_STEP, size + _SIZE_STEP)
            found = optimize.minimize_scalar(
                lambda size: float(refined(size, best, 0.0).cost[0]), bounds, bounds, method="bounded",
                options={"xatol": _SIZE_KNOWN},
            )  # fmt: skip
            size = float(found.x)
        usual_std_m = float(np.median(evidence.weight[0][returned] ** -0.5))
        for slack_m, n in zip((_SLACKS_M[1], 0.0), _REFINED[1:], strict=True):
            if slack_m > usual_std_m or slack_m == 0.0:
                fits = refined(size, fits[:n], slack_m, roughly=slack_m > 0)
        c, view = int(fits.class_index[0]), fits.view[0].tolist()
        delta_rad = float(wrap_delta_rad(view[1], delta_period_rad(self._symmetry[c])))
        n_pixels = int(returned.sum())
        return Fit(self._names[c], view[0], delta_rad, view[2], size, float(fits.cost[0]), n_pixels)

    def _before(
        self, background: Background | None, size: float, free: tuple[str, ...]
    ) -> tuple[RenderedModel, DescentSettings]:
        """Return the images of a camera with another field of view before a background, and how a descent runs."""
        sensor, returns = wider(self._sensor, size), None
        if background is not None:
            behind = Renderer(None, sensor).render(1.0, background=background)
            returns = counts(behind.phasor, behind.intensity, sensor, PERHAPS).reshape(1, -1)
        used = np.ones(sensor.rows * sensor.cols, np.bool_)
        settings = DescentSettings(free, used, ROBUST_FROM, returns_behind=returns)
        return self._model.seen_by(sensor).with_background(background), settings

    def _best_of(self, model: RenderedModel, settings: DescentSettings, evidence: Evidence, grid: Starts) -> Starts:
        """Return the best views of a grid, lowest cost first; of classes on one lower part the views of each."""
        kept = 8
        first, stop = self._sensor.lower_rows if self._shared else (0, self._sensor.rows)
        rows = np.repeat(
            (np.arange(self._sensor.rows) >= first) & (np.arange(self._sensor.rows) < stop), self._sensor.cols
        )
        best = grid[np.argsort(costs_at(model, evidence.of_pixels(rows), grid, settings), kind="stable")[:kept]]
        if not self._shared:
            return best
        n = len(self._names)
        each = _starts(np.tile(np.arange(n), len(best)), np.repeat(best.view, n, axis=0))
        return each[np.argsort(costs_at(model, evidence, each, settings), kind="stable")]

    def _grid(self, c: int, frame: FilteredFrames, step_rad: float, bearing: bool, *, mixed: bool) -> _Float:
        """Return views about the nearest returns, (k, 6)."""
        sensor = self._sensor
        returned = frame.state[0] == PixelState.RETURN
        forward = np.where(returned, sensor.axis_cosine() * frame.range_m[0], np.inf)
        ordered = np.sort(forward[returned])
        nearest = float(ordered[min(1, len(ordered) - 1)])
        near = forward < nearest + _LANDMARK_DEPTH_M
        column = np.broadcast_to(np.arange(sensor.cols) + 0.5, near.shape)[near].mean()
        row = min(max(sensor.centre_px[1], 0.0), float(sensor.rows))
        middle = math.atan(float(sensor.tangents(column, row)[0])) - math.radians(sensor.bearing_offset_deg)
        per_column = 2 * math.atan(sensor.tan_half_angles[0]) / sensor.cols
        bearings = [middle + aside * per_column for aside in _BEARING_OFFSETS_COLUMNS] if bearing else [0.0]
        vertices = self._model.renderer(c).topology.vertices
        grid: list[tuple[float, ...]] = []
        for delta in np.arange(0.0, delta_period_rad(self._symmetry[c]), step_rad):
            along = vertices[:, 0] * math.cos(delta) + vertices[:, 1] * math.sin(delta)
            distances = nearest - float(along.min()) + np.array(_MIXED_OFFSETS_M if mixed else _DISTANCE_OFFSETS_M)
            grid += [(first, delta, b, 0.0, 0.0, 0.0) for first, b in itertools.product(distances, bearings)]
        return np.array(grid)

    def with_fitted_background(self, frame: FilteredFrames, background: Background, fit: Fit) -> Background:
        """Return a background moved to where it and the landmark of a rough fit explain a frame best."""
        view = np.array([fit.distance_m, fit.delta_rad, fit.bearing_rad, 0.0, 0.0, 0.0])
        model, evidence = self._model.seen_by(self._sensor), _with_slack(pooled_evidence(frame), 0.0)
        return fit_background(model, evidence, self._names.index(fit.class_name), view, VIEW[:3], background)[0]


def _starts(class_index: NDArray[np.int64], view: _Float) -> Starts:
    """Return candidates of one frame."""
    return Starts(np.zeros(len(view), np.int64), class_index, view)


def pooled_evidence(frame: FilteredFrames) -> Evidence:
    """Return one frame with the noise of its pixels taken together."""
    return Evidence.from_frames(frame.with_pooled_noise().with_fixed_pattern(), "ranges")


def _with_slack(evidence: Evidence, slack_m: float) -> Evidence:
    """Return evidence with a standard deviation added to its noise."""
    return evidence.with_further_noise(math.hypot(slack_m, _LEAST_STD_M))


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
