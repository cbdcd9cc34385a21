"""Inputs and results of every search for a landmark in histograms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.histograms.exact_fit import Counted, Fit
from phasemark.matcher.histograms.histogram_table import TableGrid
from phasemark.matcher.histograms.scene_models import SceneModel
from phasemark.render import Background
from phasemark.render.direct.view_signals import ViewSignals


class SearchPlan(NamedTuple):
    """Region in which landmarks are looked for.

    Parameters
    ----------
    signals : sequence of ViewSignals
        Of each class.
    grid : TableGrid
    free : tuple of str
        Parameters of the view, in its order.
    prior_std : (p,) float64
        Of each, about 0.
    limits : (2, 6) float64
        Least and greatest values of a view.
    bearings_rad : tuple of float
        Bearings at which a table is made.
    workers : int
    """

    signals: Sequence[ViewSignals]
    grid: TableGrid
    free: tuple[str, ...]
    prior_std: NDArray[np.float64]
    limits: NDArray[np.float64]
    bearings_rad: tuple[float, ...]
    workers: int

    def prior_of(self, bearing_rad: float) -> float:
        """Return what a bearing costs before the frame is seen."""
        if bearing_rad == 0:
            return 0.0
        return (bearing_rad / float(self.prior_std[self.free.index("bearing_rad")])) ** 2


class Start(NamedTuple):
    """Initial guess of a fit.

    Parameters
    ----------
    class_index : int
    state : (6 + k,) float64
    cost : float
        Deviance by the table.
    bright : float
    ambient : (zones,) float64
    """

    class_index: int
    state: NDArray[np.float64]
    cost: float
    bright: float
    ambient: NDArray[np.float64]


class LandmarkSearch(Protocol):
    """A search for where a likelihood has its hills."""

    @property
    def table_bytes(self) -> int:
        """How large the tables are in memory."""

    def prepare(self) -> None:
        """Render the tables, before threads ask for them."""

    def starts(self, frame: Counted, counts: NDArray[np.float64], ambient: NDArray[np.float64]) -> list[Start]:
        """Return the hills of the likelihood of one frame, best first; counts without pile-up and drift."""

    def model(self, class_index: int) -> SceneModel:
        """Return the exact scenes of a class."""

    def bare_cost(self, frame: Counted, ambient: NDArray[np.float64]) -> float:
        """Return what a scene without a landmark costs."""

    def background_of(self, fit: Fit) -> Background | None:
        """Return what stands behind the landmark in a fit."""


def before_the_wall(limits: NDArray[np.float64], background: Background) -> NDArray[np.float64]:
    """Return limits of a view, (2, 6), with the landmark's axis no farther away than a wall."""
    out = limits.copy()
    if background.wall_m is not None:
        out[1, 0] = max(min(out[1, 0], background.wall_m), out[0, 0])
    return out
