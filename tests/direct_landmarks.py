"""Landmarks before a direct sensor: the banks, matchers and frames that tests share, and checks of many answers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, chi2

from phasemark.data import Bank, BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher, Matches, cramer_rao
from phasemark.matcher.matcher import Measured
from phasemark.matcher.statistics import nees, view_errors
from phasemark.render import Background, Sensor, Views, preset
from phasemark.render.direct import HistogramFrames, HistogramRenderer, capture_histograms

SENSOR = "vl53l5cx-8x8"
CLASSES = ("cylinder", "cone", "sphere")
FREE = ("distance_m", "delta_rad")
SPAN = "0.95:1.25:0.1"
Stated = Background | Literal["auto"] | None
Changes = tuple[tuple[str, object], ...]
"""Fields of the histogram table that differ from the preset's."""


@lru_cache(maxsize=8)
def bank_of(changes: Changes = (), span: str = SPAN, classes: tuple[str, ...] = CLASSES) -> Bank:
    """Return a bank of landmarks before the sensor."""
    histogram = preset(SENSOR).histogram
    assert histogram is not None
    plan = BankPlan(
        sensor=SENSOR, sensor_overrides={"histogram": {**histogram.model_dump(), **dict(changes)}}, classes=classes,
        distance_m=span, delta_deg="0:170:10", layout="full",
    )  # fmt: skip
    return build_bank(plan, workers=1)


@lru_cache(maxsize=16)
def renderer_of(name: str | None, sensor: Sensor | None = None) -> HistogramRenderer:
    """Return a renderer of a landmark, or of nothing."""
    sensor = bank_of().camera if sensor is None else sensor
    return (
        HistogramRenderer(None, sensor)
        if name is None
        else HistogramRenderer(build_mesh(catalog()[name]), sensor, albedo=catalog()[name].albedo)
    )


@lru_cache(maxsize=8)
def matcher_of(
    background: Stated = None, on: Measured = "histograms", free: tuple[str, ...] | None = FREE, changes: Changes = (),
    span: str = SPAN, classes: tuple[str, ...] = CLASSES,
) -> Matcher:  # fmt: skip
    """Return a matcher, whose tables are rendered once."""
    return Matcher(bank_of(changes, span, classes), "refine", free=free, on=on, background=background, workers=2)


def random_views(n: int, rng: np.random.Generator, low: float = 1.0, high: float = 1.2) -> Views:
    """Return views at random distances and angles."""
    return Views.broadcast(rng.uniform(low, high, n), rng.uniform(0, np.pi, n))


def frames_of(
    name: str | None, views: Views, rng: np.random.Generator, n_frames: int = 1, behind: Background | None = None,
    sensor: Sensor | None = None,
) -> HistogramFrames:  # fmt: skip
    """Return frames of a landmark, or of nothing, at some views."""
    renderer = renderer_of(name, sensor)
    return capture_histograms(renderer.expected(views, background=behind), renderer.sensor, rng=rng, n_frames=n_frames)


def right_answers(found: Matches, name: str, views: Views, farthest_deg: float = 6.0) -> NDArray[np.bool_]:
    """Return which answers are right; none that is accepted may be wrong."""
    error = view_errors(found, views, FREE, np.pi)
    right = (found.class_name == name) & (np.abs(error) < [0.03, math.radians(farthest_deg)]).all(axis=1)
    assert right[found.accepted].all(), (name, views[np.flatnonzero(found.accepted & ~right)])
    return np.asarray(right)


@dataclass(frozen=True)
class Trials:
    """Right answers among n: errors over the bound, squared errors over the covariance, p-values; how many accepted."""

    n: int
    scaled: NDArray[np.float64]
    squares: NDArray[np.float64]
    p_values: NDArray[np.float64]
    n_accepted: int

    @property
    def ratio(self) -> NDArray[np.float64]:
        """Root mean square error over bound, of distance and δ."""
        return np.asarray(np.sqrt((self.scaled**2).mean(axis=0)))


def trials(
    n: int, seed: int, behind: Background | None = None, stated: Stated = None, changes: Changes = (),
    classes: tuple[str, ...] = CLASSES, known: tuple[str, ...] = CLASSES,
) -> Trials:  # fmt: skip
    """Match n frames of some classes before a background; `known` are the classes of the bank."""
    rng, parts, n_accepted = np.random.default_rng(seed), [], 0
    sensor = bank_of(changes, SPAN, known).camera
    matcher = matcher_of(stated, changes=changes, classes=known)
    for name in classes:
        views = random_views(n // len(classes), rng)
        found = matcher.match(frames_of(name, views, rng, behind=behind, sensor=sensor))
        right = right_answers(found, name, views)
        error = view_errors(found, views, FREE, np.pi)[right]
        bound = cramer_rao(
            renderer_of(name, sensor), views, n_frames=1, background=behind,
            nuisances=("wall_m",) if stated == "auto" else None,
        )  # fmt: skip
        scaled = error / np.sqrt(np.einsum("npp->np", bound.covariance))[right]
        parts.append((scaled, nees(error, found.covariance[right]), found.p_value[right]))
        n_accepted += int(found.accepted.sum())
    scaled, squares, p_values = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Trials(n // len(classes) * len(classes), scaled, squares, p_values, n_accepted)


def check_bound(found: Trials, slack: float = 0.03) -> None:
    """Compare answers with the bound of the same scene, and with their own covariance.

    `slack` is for slopes that change over a standard deviation.
    """
    kept = len(found.squares)
    assert kept >= binom.ppf(1e-4, found.n, 0.98)
    # squares of k standard normal numbers add up to a χ² of k, outside of this interval in 1 of 2 000 cases
    tails = (0.00025, 0.99975)
    low, high = np.sqrt(chi2.ppf(tails, kept) / kept)
    assert ((found.ratio > low - slack) & (found.ratio < high + slack)).all(), found.ratio
    low, high = chi2.ppf(tails, 2 * kept) / (2 * kept)
    assert low - slack - 0.01 < found.squares.mean() / 2 < high + slack + 0.01
    assert (found.p_values < 0.01).sum() <= binom.isf(1e-4, kept, 0.01)
    # the test refuses 1 in 100, and a few of the views leave δ open
    assert found.n_accepted >= binom.ppf(1e-4, found.n, 0.97)
