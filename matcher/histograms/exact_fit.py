"""The last steps of a fit: scenes rendered where the answer lies, linear in between (PHYSICS sections 7 and 11)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.histograms.poisson_fit import ambient_step, frame_sums
from phasemark.matcher.histograms.scene_prediction import shifted
from phasemark.matcher.histograms.table_search import BRIGHTEST, DIMMEST
from phasemark.matcher.histograms.view_signals import ViewSignals
from phasemark.render import Views
from phasemark.render.view import VIEW_FIELDS

_INNER_STEPS = 12
_INNER_HALVINGS = 4
_INNER_DONE = 1e-2  # squared standard deviations
_NEAR_ENOUGH = 0.7
"""A step shorter than this share of a standard deviation needs no other scene: slopes are straight over it."""
_SHRINK, _LEAST_SHRINK = 0.3, 0.05
_WORSE = 0.5
"""A scene may be so much worse than the linear one that led to it: less than what a test can see."""
_SAME = np.array([0.005, *[math.radians(1.0)] * 2, 0.005, *[math.radians(1.0)] * 2])
"""A fit this near to another one, on its way, ends where that one did."""
_LONGEST = {"m": 0.04, "rad": math.radians(4.0)}


class Counted(NamedTuple):
    """One frame, or several that are added up.

    Parameters
    ----------
    counts : (zones, bins) float64
    n_frames : float
    cycles : float
        First photons that there can be; infinite without pile-up.
    extra : (bins,) float64
        Counts of the cover glass.
    drift_bins : float
        How far the histogram is shifted.
    """

    counts: NDArray[np.float64]
    n_frames: float
    cycles: float
    extra: NDArray[np.float64]
    drift_bins: float


class Fit(NamedTuple):
    """A view that explains a frame.

    Parameters
    ----------
    view : (6,) float64
    bright : float
    ambient : (zones,) float64
    deviance : float
    cost : float
        The deviance with what was known of the view before.
    level : (zones, bins) float64
        Expected counts.
    information : (p, p) float64
        Brightness and ambient light eliminated, what was known before included.
    """

    view: NDArray[np.float64]
    bright: float
    ambient: NDArray[np.float64]
    deviance: float
    cost: float
    level: NDArray[np.float64]
    information: NDArray[np.float64]


def fit_view(
    signals: ViewSignals, frame: Counted, view: NDArray[np.float64], bright: float, ambient: NDArray[np.float64],
    free: Sequence[str], prior_std: NDArray[np.float64], limits: NDArray[np.float64], most: int, hopeless: float,
    known: Sequence[NDArray[np.float64]] = (),
) -> Fit | None:  # fmt: skip
    """Refine a view until a scene rendered there explains the frame best.

    Parameters
    ----------
    signals : ViewSignals
        Of the class.
    frame : Counted
    view : (6,) float64
        Where to start.
    bright : float
    ambient : (zones,) float64
    free : sequence of str
    prior_std : (p,) float64
        Of Gaussian priors of mean 0; infinite where nothing is known.
    limits : (2, 6) float64
        Least and greatest values of the view.
    most : int
        Scenes with slopes that are rendered at most.
    hopeless : float
        A fit that will cost more than this is given up.
    known : sequence of (6,) float64
        Views that are fitted already: a fit that comes to one of them is given up.

    Returns
    -------
    Fit or None
        None of a fit that was given up.
    """
    columns = [VIEW_FIELDS.index(name) for name in free]
    longest = np.array([_LONGEST[name.rpartition("_")[2]] for name in free])
    weight = 1 / prior_std**2
    best: Fit | None = None
    step, shrink = np.zeros(len(free)), 1.0
    view = np.clip(view, *limits)
    for _ in range(most):
        scene = _scene_at(signals, frame, view, free, weight, view[columns])
        here = scene.at_view(bright, ambient)
        if best is not None and here.cost > best.cost + _WORSE:
            shrink *= _SHRINK
            if shrink < _LEAST_SHRINK:
                break
            view = best.view.copy()
            view[columns] += shrink * step
            view = np.clip(view, *limits)
            continue
        offset, there = scene.descend(here, longest)
        best = Fit(view.copy(), here.bright, here.ambient, here.deviance, here.cost, here.level, there.information)
        bright, ambient, shrink, step = there.bright, there.ambient, 1.0, offset
        view = view.copy()
        view[columns] += offset
        view = np.clip(view, *limits)
        if float(offset @ there.information @ offset) < _NEAR_ENOUGH**2:
            return Fit(view, bright, ambient, there.deviance, there.cost, there.level, there.information)
        if there.cost > hopeless or any((np.abs(view - other) < _SAME).all() for other in known):
            return None
    return best


def _scene_at(
    signals: ViewSignals, frame: Counted, view: NDArray[np.float64], free: Sequence[str],
    weight: NDArray[np.float64], theta: NDArray[np.float64],
) -> Scene:  # fmt: skip
    """Return the scene rendered at a view, with its slopes."""
    signal, slope = signals.counts_and_slopes(Views(*view[:, None]), free)
    whole = np.concatenate([signal, slope[0]])
    whole = frame.n_frames * shifted(whole, np.full(len(whole), frame.drift_bins))
    return Scene(frame, whole[0], whole[1:], weight, theta)


class Point(NamedTuple):
    """The linear scene somewhere."""

    bright: float
    ambient: NDArray[np.float64]
    deviance: float
    cost: float
    level: NDArray[np.float64]
    information: NDArray[np.float64]
    gradient: NDArray[np.float64]
    own: NDArray[np.float64]


class Scene:
    """A scene about a view, its signal linear in the free parameters.

    Parameters
    ----------
    frame : Counted
    signal : (zones, bins) float64
    slope : (p, zones, bins) float64
    weight : (p,) float64
        Information in the free parameters before the frame is seen.
    theta : (p,) float64
        Free parameters about which the scene is linear.
    """

    def __init__(
        self, frame: Counted, signal: NDArray[np.float64], slope: NDArray[np.float64], weight: NDArray[np.float64],
        theta: NDArray[np.float64],
    ) -> None:  # fmt: skip
        self._frame, self._signal, self._weight, self._theta = frame, signal, weight, theta
        self._slope = np.ascontiguousarray(slope)

    def at_view(self, bright: float, ambient: NDArray[np.float64]) -> Point:
        """Return what is known at the view itself."""
        offset = np.zeros(len(self._theta))
        return self._with_prior(self._at(offset, bright, ambient), offset)

    def descend(self, point: Point, longest: NDArray[np.float64]) -> tuple[NDArray[np.float64], Point]:
        """Return how far away the linear scene explains the frame best, within the longest steps, and what is there."""
        p = len(self._theta)
        offset = np.zeros(p)
        for _ in range(_INNER_STEPS):
            scale = np.sqrt(np.maximum(np.diag(point.information), 1e-300))
            normal = point.information / np.outer(scale, scale) + 1e-9 * np.eye(p + 1)
            step = np.linalg.solve(normal, point.gradient / scale) / scale
            gain = float(step @ point.gradient)
            if gain < _INNER_DONE:  # what is left changes neither the counts nor their slopes
                offset = offset + step[:p]
                break
            step = step / max(1.0, float((np.abs(offset + step[:p]) / longest).max()), 2 * abs(float(step[p])))
            better = None
            for _ in range(_INNER_HALVINGS):
                trial = self._moved(point, step, offset + step[:p])
                if trial.cost <= point.cost:
                    better = trial
                    break
                step = step * _SHRINK
            if better is None:
                break
            offset, point = offset + step[:p], better
        return offset, point._replace(information=self._view_information(point))

    def _view_information(self, point: Point) -> NDArray[np.float64]:
        """Return the information in the view alone, the brightness eliminated."""
        whole = point.information
        return np.asarray(whole[:-1, :-1] - np.outer(whole[:-1, -1], whole[-1, :-1]) / whole[-1, -1])

    def _at(self, offset: NDArray[np.float64], bright: float, ambient: NDArray[np.float64]) -> Point:
        signal = self._signal
        if offset.any():
            signal = np.maximum(signal + np.tensordot(offset, self._slope, axes=1), 0.0)
        p, shape = len(offset), signal.shape
        level, information, gradient = np.empty(shape), np.empty((p + 1, p + 1)), np.empty(p + 1)
        own, scratch = np.empty((shape[0], p + 3)), np.empty((2, p + 2))
        bright = min(max(bright, DIMMEST), BRIGHTEST)
        deviance = frame_sums(
            self._frame.counts, signal, self._slope, bright, ambient, self._frame.extra, self._frame.cycles, level,
            information, gradient, own, scratch,
        )  # fmt: skip
        return Point(bright, ambient, deviance, deviance, level, information, gradient, own)

    def _moved(self, point: Point, step: NDArray[np.float64], offset: NDArray[np.float64]) -> Point:
        ambient = point.ambient.copy()
        ambient_step(point.own, step, ambient)
        return self._with_prior(self._at(offset, point.bright * math.exp(float(step[-1])), ambient), offset)

    def _with_prior(self, point: Point, offset: NDArray[np.float64]) -> Point:
        if not self._weight.any():
            return point
        theta = self._theta + offset
        cost = point.deviance + float(self._weight @ theta**2)
        gradient, information = point.gradient.copy(), point.information.copy()
        gradient[:-1] -= self._weight * theta
        information[np.arange(len(theta)), np.arange(len(theta))] += self._weight
        return point._replace(cost=cost, gradient=gradient, information=information)
