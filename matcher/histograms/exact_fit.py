"""The last steps of a fit: scenes rendered where the answer lies, linear in between (PHYSICS sections 7 and 11)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.histograms.poisson_fit import ambient_step, frame_sums
from phasemark.matcher.histograms.scene_prediction import shifted
from phasemark.matcher.histograms.table_search import BRIGHTEST, DIMMEST
from phasemark.render.view import VIEW_FIELDS

SceneAt = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Returns signal and slopes of one frame at a state."""
_INNER_STEPS = 12
_INNER_HALVINGS = 4
_INNER_DONE = 1e-2  # squared standard deviations
_NEAR_ENOUGH = 0.7
"""A step shorter than this share of a standard deviation needs no other scene: slopes are straight over it."""
_SETTLED = 0.05
"""A nuisance that moves by less than this share of its longest step needs no other scene."""
_SHRINK, _LEAST_SHRINK = 0.3, 0.05
_WORSE = 0.5
"""A scene may be so much worse than the linear one that led to it: less than what a test can see."""
_SAME = np.array([0.005, *[math.radians(1.0)] * 2, 0.005, *[math.radians(1.0)] * 2])
"""A fit this near to another one, on its way, ends where that one did."""
_NO_INFORMATION = 1e-300
_LONGEST = {"m": 0.04, "rad": math.radians(4.0)}


class Counted(NamedTuple):
    """One frame, or several that are added up; or several positions, their zones one after the other.

    Parameters
    ----------
    counts : (zones, bins) float64
    n_frames : float
    cycles : float
        First photons that there can be; infinite without pile-up.
    extra : (bins,) float64
        Counts of the cover glass.
    drift_bins : (positions,) float64
        How far the histograms of each position are shifted.
    """

    counts: NDArray[np.float64]
    n_frames: float
    cycles: float
    extra: NDArray[np.float64]
    drift_bins: NDArray[np.float64]


class Search(NamedTuple):
    """Parameters that a fit varies, and how far.

    A state is the six numbers of a view, and after them what the frame leaves open besides: nuisances, the slopes of
    which come after those of the view.

    Parameters
    ----------
    free : tuple of str
        Parameters of the view.
    columns : (q,) int64
        Which numbers of a state are varied: those of `free`, then the nuisances.
    weight : (q,) float64
        Information before the frame is seen, of Gaussian priors of mean 0.
    limits : (2, states) float64
        Least and greatest values of a state.
    longest : (q,) float64
        Longest step between two scenes.
    most : int
        Scenes with slopes that are rendered at most.
    """

    free: tuple[str, ...]
    columns: NDArray[np.int64]
    weight: NDArray[np.float64]
    limits: NDArray[np.float64]
    longest: NDArray[np.float64]
    most: int


def search_of(
    free: Sequence[str], prior_std: NDArray[np.float64], limits: NDArray[np.float64], most: int,
    nuisances: NDArray[np.float64] | None = None,
) -> Search:  # fmt: skip
    """Return what a fit varies.

    Parameters
    ----------
    free : sequence of str
        Parameters of the view.
    prior_std : (p,) float64
        Of each; infinite where nothing is known.
    limits : (2, 6) float64
    most : int
    nuisances : (3, k) float64, optional
        Least and greatest value and longest step of each nuisance.
    """
    more = np.empty((3, 0)) if nuisances is None else nuisances
    names = tuple(free)
    longest = [_LONGEST[name.rpartition("_")[2]] for name in names]
    columns = [*map(VIEW_FIELDS.index, names), *(len(VIEW_FIELDS) + k for k in range(more.shape[1]))]
    return Search(
        names,
        np.array(columns, dtype=np.int64),
        np.concatenate([1 / prior_std**2, np.zeros(more.shape[1])]),
        np.concatenate([limits, more[:2]], axis=1),
        np.concatenate([longest, more[2]]),
        most,
    )


class Fit(NamedTuple):
    """A view that explains a frame.

    Parameters
    ----------
    state : (6 + k,) float64
        The view, and the nuisances.
    bright : float
    ambient : (zones,) float64
    deviance, cost : float
        The cost has what was known before.
    level : (zones, bins) float64
        Expected counts, pile-up included.
    information : (p, p) float64
        Brightness, ambient light and nuisances eliminated, what was known before included.
    """

    state: NDArray[np.float64]
    bright: float
    ambient: NDArray[np.float64]
    deviance: float
    cost: float
    level: NDArray[np.float64]
    information: NDArray[np.float64]

    @property
    def view(self) -> NDArray[np.float64]:
        """The six numbers of the view."""
        return self.state[: len(VIEW_FIELDS)]


def fit_view(
    scene_at: SceneAt, frame: Counted, state: NDArray[np.float64], bright: float, ambient: NDArray[np.float64],
    search: Search, hopeless: float, known: Sequence[NDArray[np.float64]] = (),
) -> Fit | None:  # fmt: skip
    """Refine a view until a scene rendered there explains the frame best.

    Parameters
    ----------
    scene_at : callable
        Returns the expected signal counts of one frame at a state, (zones, bins), and their slopes, (q, zones, bins).
    frame : Counted
    state : (6 + k,) float64
        Where to start.
    bright : float
    ambient : (zones,) float64
    search : Search
    hopeless : float
        A fit that will cost more than this is given up.
    known : sequence of (6,) float64
        Views that are fitted already: a fit that comes to one of them is given up.

    Returns
    -------
    Fit or None
        None of a fit that was given up.
    """
    columns, n_view = search.columns, len(VIEW_FIELDS)
    best: Fit | None = None
    step, shrink = np.zeros(len(columns)), 1.0
    state = np.clip(state, *search.limits)
    for _ in range(search.most):
        scene = _scene(scene_at(state), frame, search, state[columns])
        here = scene.at_view(bright, ambient)
        if best is not None and here.cost > best.cost + _WORSE:
            shrink *= _SHRINK
            if shrink < _LEAST_SHRINK:
                break
            state = best.state.copy()
            state[columns] += shrink * step
            state = np.clip(state, *search.limits)
            continue
        offset, there = scene.descend(here, search.longest)
        best = Fit(state.copy(), here.bright, here.ambient, here.deviance, here.cost, here.level, there.information)
        bright, ambient, shrink, step = there.bright, there.ambient, 1.0, offset
        state = state.copy()
        state[columns] += offset
        state = np.clip(state, *search.limits)
        turn, others = np.split(offset, [len(search.free)])
        settled = (np.abs(others) <= _SETTLED * search.longest[len(search.free) :]).all()
        if settled and float(turn @ there.information @ turn) < _NEAR_ENOUGH**2:
            return Fit(state, bright, ambient, there.deviance, there.cost, there.level, there.information)
        if there.cost > hopeless or any((np.abs(state[:n_view] - other) < _SAME).all() for other in known):
            return None
    return best


def _scene(
    found: tuple[NDArray[np.float64], NDArray[np.float64]], frame: Counted, search: Search, theta: NDArray[np.float64]
) -> Scene:
    """Return the scene of a frame from the signal of one frame and its slopes."""
    whole = np.concatenate([found[0][None], found[1]])
    n_zones, bins = whole.shape[1:]
    n_positions = len(frame.drift_bins)
    apart = whole.reshape(-1, n_zones // n_positions, bins)
    whole = frame.n_frames * shifted(apart, np.tile(frame.drift_bins, len(whole))).reshape(whole.shape)
    return Scene(frame, whole[0], whole[1:], search.weight, theta, len(search.free))


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
    n_view : int
        How many of them are of the view; the others are nuisances.
    """

    def __init__(
        self, frame: Counted, signal: NDArray[np.float64], slope: NDArray[np.float64], weight: NDArray[np.float64],
        theta: NDArray[np.float64], n_view: int,
    ) -> None:  # fmt: skip
        self._frame, self._signal, self._weight, self._theta = frame, signal, weight, theta
        self._slope, self._n_view = np.ascontiguousarray(slope), n_view

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
            farthest = float((np.abs(offset + step[:p]) / longest).max(initial=0.0))
            step = step / max(1.0, farthest, 2 * abs(float(step[p])))
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
        """Return the information in the view alone, brightness and nuisances eliminated."""
        whole = point.information
        while len(whole) > self._n_view:
            own = max(float(whole[-1, -1]), _NO_INFORMATION)
            whole = whole[:-1, :-1] - np.outer(whole[:-1, -1], whole[-1, :-1]) / own
        return np.asarray(whole)

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
