"""The base of matchers of histograms and of targets: landmarks of a bank, the region that is searched, and threads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.matcher.estimate.acceptance import Rules
from phasemark.matcher.histograms.histogram_table import TableGrid, plan_table
from phasemark.matcher.histograms.scene_models import planes_of
from phasemark.render import Background, Sensor
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.view_signals import ViewSignals
from phasemark.render.view import VIEW_FIELDS

_STEEPEST_RAD = math.radians(20.0)


class DirectMatcher:
    """Landmarks of a bank before a direct sensor.

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
        What stands behind the landmark. "auto": a wall whose distance is estimated.
    workers : int
        Threads; the answers do not depend on their number.
    """

    _bearing_step_rad = math.radians(4.0)  # between tables of a free bearing, at most

    def __init__(
        self, bank: Bank, *, prior_std: Sequence[float], rules: Rules,
        background: Background | Literal["auto"] | None = None, workers: int = 1,
    ) -> None:  # fmt: skip
        self.sensor = bank.camera
        check_histogram_sensor(bank)
        self.free, self.workers = rules.free, workers
        self.prior_std = np.array(prior_std, dtype=np.float64)
        farthest_aside_rad = max(self._bearings_rad) + self._bearing_step_rad / 2  # beyond, rivals are in no table
        self.rules = replace(rules, widest_rad=farthest_aside_rad)
        self.prior_weight, self.columns = 1 / self.prior_std**2, [VIEW_FIELDS.index(name) for name in self.free]
        meshes = [bank.mesh(name) for name in bank.classes]
        self.signals = [ViewSignals(mesh, self.sensor, float(mesh.metadata["albedo"])) for mesh in meshes]
        self.nothing = ViewSignals(None, self.sensor)
        self.grid = plan_table(self.signals, bank.distance_m, bank.delta_rad, math.gcd(*rules.symmetry))
        histogram = histogram_of(self.sensor)
        far_m = histogram.start_m + histogram.bins * histogram.bin_width_m
        nearest_wall_m = 0.1
        self.free_wall = (nearest_wall_m, far_m) if background == "auto" else None
        reach_m = max(float(np.hypot(*one.vertices[:, :2].T).max()) for one in self.signals)
        behind_all = Background(wall_m=min(float(self.grid.distance_m[-1]) + reach_m, far_m))
        behind = behind_all if isinstance(background, str) else background
        self.background = behind if planes_of(behind) else None
        self.limits = _view_limits(self.grid, None if self.free_wall else self.background)

    @property
    def _bearings_rad(self) -> tuple[float, ...]:
        """Bearings at which a table is made, 0 first."""
        if "bearing_rad" not in self.free:
            return (0.0,)
        bearing_sigma = 2.0  # how far aside the tables of a free bearing reach
        quarter_image_rad = math.atan(self.sensor.tan_half_angles[0]) / 2
        side = min(bearing_sigma * float(self.prior_std[self.free.index("bearing_rad")]), quarter_image_rad)
        n_aside = math.ceil(side / self._bearing_step_rad - 1e-9)
        aside = side / n_aside * np.arange(1, n_aside + 1)
        return (0.0, *(float(sign * bearing) for bearing in aside for sign in (-1, 1)))

    def _prior_of(self, bearing_rad: float) -> float:
        """Return what a bearing costs before the frame is seen."""
        return (bearing_rad / float(self.prior_std[self.free.index("bearing_rad")])) ** 2 if bearing_rad else 0.0


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


def _view_limits(grid: TableGrid, background: Background | None) -> NDArray[np.float64]:
    """Return least and greatest values of a view, (2, 6); the landmark's axis is no farther away than a wall."""
    low, high = np.full(len(VIEW_FIELDS), -math.inf), np.full(len(VIEW_FIELDS), math.inf)
    low[0], high[0] = grid.distance_m[0], grid.distance_m[-1]
    if background is not None and background.wall_m is not None:
        high[0] = max(min(high[0], background.wall_m), low[0])
    if not grid.cyclic:
        low[1], high[1] = grid.delta_rad[0], grid.delta_rad[-1]
    low[4:], high[4:] = -_STEEPEST_RAD, _STEEPEST_RAD
    return np.stack([low, high])
