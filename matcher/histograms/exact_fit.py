"""The last steps of a fit: scenes rendered where the answer lies, linear in between (PHYSICS sections 7 and 11)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.estimate.solver import descend
from phasemark.matcher.histograms.poisson_fit import FrameSums, ambient_step, sums_of_frame
from phasemark.matcher.histograms.scene_prediction import shifted
from phasemark.matcher.histograms.table_search import BRIGHTEST, DIMMEST
from phasemark.render.view import VIEW_FIELDS

_INNER_SHARES = (1.0, 0.3, 0.09, 0.027)
_SETTLED = 0.05
"""A nuisance that moves by less than this share of its longest step needs no other scene."""
_SHRINK, _LEAST_SHRINK = 0.3, 0.05
_SCENES_OF_HOPE = 2  # by these no fit is given up
_SAME = np.array([0.005, *[math.radians(1.0)] * 2, 0.005, *[math.radians(1.0)] * 2])
"""A fit this near to another one, on its way, ends where that one did."""
LONGEST = {"m": 0.04, "rad": math.radians(4.0)}
"""Longest step of a view between two scenes, by unit."""
_LONGEST_LOG_BRIGHT = 0.5


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

    @property
    def view(self) -> NDArray[np.float64]:
        """The six numbers of the view."""
        return self.state[: len(VIEW_FIELDS)]


class Model(Protocol):
    """Expected signal counts of one frame, from exact scenes or from a table."""

    nuisances: NDArray[np.float64]

    def scene(self, state: NDArray[np.float64], free: Sequence[str]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the counts at a state, (zones, bins), and their slopes by free parameters and nuisances."""


class Search:
    """Parameters that a fit varies, and how far.

    A state is the six numbers of a view, and after them the nuisances of a model.

    Parameters
    ----------
    model : Model
    free : sequence of str
        Parameters of the view.
    prior_std : (p,) float64
        Of each, about 0; infinite where nothing is known.
    limits : (2, 6) float64
        Least and greatest values of a view.
    """

    def __init__(
        self, model: Model, free: Sequence[str], prior_std: NDArray[np.float64], limits: NDArray[np.float64]
    ) -> None:
        low, high, longest = model.nuisances
        self.model, self.free = model, tuple(free)
        columns = [*map(VIEW_FIELDS.index, free), *range(len(VIEW_FIELDS), len(VIEW_FIELDS) + len(low))]
        self.columns = np.array(columns, dtype=np.int64)
        self.weight = np.concatenate([1 / prior_std**2, np.zeros(len(low))])
        self.limits = np.concatenate([limits, [low, high]], axis=1)
        self.longest = np.concatenate([[LONGEST[name.rpartition("_")[2]] for name in free], longest])

    def moved(self, state: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a state after a step of what is varied, within the limits."""
        state = state.copy()
        state[self.columns] += step
        return np.asarray(np.clip(state, *self.limits))


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
    settled : bool
        Whether another scene would change nothing: not of a fit that ran out of scenes.
    straight : bool
        Whether all counts stay above zero as far as the information leaves them open.
    """

    state: NDArray[np.float64]
    bright: float
    ambient: NDArray[np.float64]
    deviance: float
    cost: float
    level: NDArray[np.float64]
    information: NDArray[np.float64]
    settled: bool = False
    straight: bool = True

    @property
    def view(self) -> NDArray[np.float64]:
        """The six numbers of the view."""
        return self.state[: len(VIEW_FIELDS)]


def fit_view(
    search: Search, frame: Counted, start: Start, most: int, hopeless: float = math.inf,
    known: Sequence[NDArray[np.float64]] = (),
) -> Fit | None:  # fmt: skip
    """Refine a view until a scene rendered there explains the frame best.

    Parameters
    ----------
    search : Search
    frame : Counted
    start : Start
    most : int
        Scenes with slopes that are rendered at most.
    hopeless : float
        A fit that will cost more than this after its third scene is given up: the first ones tell little.
    known : sequence of (6,) float64
        Views that are fitted already: a fit that comes to one of them is given up.

    Returns
    -------
    Fit or None
        None of a fit that was given up.
    """
    best: Fit | None = None
    n_free, shrink = len(search.free), 1.0
    step = np.zeros(len(search.columns))
    state, bright, ambient = np.clip(start.state, *search.limits), start.bright, start.ambient
    inner_steps = 12
    inner_done = 1e-2  # squared standard deviations
    # A step shorter than this share of a standard deviation needs no other scene: slopes are straight over it.
    near_enough = 0.7
    worse = 0.5  # Accept a scene whose cost exceeds its linear prediction by at most this: no test can see less.
    for n in range(most):
        here = _linear_scene(search, frame, state, bright, ambient)
        if best is not None and here.cost > best.cost + worse:
            shrink *= _SHRINK
            if shrink < _LEAST_SHRINK:
                break
            state = search.moved(best.state, shrink * step)
            continue
        longest = np.append(search.longest, _LONGEST_LOG_BRIGHT)
        there, left, _ = descend(
            here, longest, most=inner_steps, done=inner_done, shares=_INNER_SHARES, excess=_LinearScene.excess
        )
        step, shrink = there.offset + left[:-1], 1.0  # what is left changes neither the counts nor their slopes
        best = here.fit(state, there.view_information)
        state, bright, ambient = search.moved(state, step), there.bright, there.ambient
        settled = (np.abs(step[n_free:]) <= _SETTLED * search.longest[n_free:]).all()
        if settled and float(step[:n_free] @ there.view_information @ step[:n_free]) < near_enough**2:
            return there.straightened(state)._replace(settled=True)
        near = (np.abs(state[: len(VIEW_FIELDS)] - other) < _SAME for other in known)
        if (n >= _SCENES_OF_HOPE and there.cost > hopeless) or any(one.all() for one in near):
            return None
    return best


def _linear_scene(
    search: Search, frame: Counted, state: NDArray[np.float64], bright: float, ambient: NDArray[np.float64]
) -> _LinearScene:
    """Return the scene of a frame at a state."""
    signal, slopes = search.model.scene(state, search.free)
    whole = np.concatenate([signal[None], slopes])
    apart = whole.reshape(-1, whole.shape[1] // len(frame.drift_bins), whole.shape[2])
    whole = frame.n_frames * shifted(apart, np.tile(frame.drift_bins, len(whole))).reshape(whole.shape)
    offset = np.zeros(len(search.columns))
    return _LinearScene(search, frame, whole, state[search.columns], offset, bright, ambient)


class _LinearScene:
    """A scene whose signal is linear in what a search varies, at an offset from the state where it was rendered.

    The last parameter is the logarithm of the brightness; ambient light is at its best after every step.
    """

    def __init__(
        self, search: Search, frame: Counted, whole: NDArray[np.float64], theta: NDArray[np.float64],
        offset: NDArray[np.float64], bright: float, ambient: NDArray[np.float64],
    ) -> None:  # fmt: skip
        self._search, self._frame, self._whole, self._theta = search, frame, whole, theta
        self.offset, self.ambient, self.bright = offset, ambient, min(max(bright, DIMMEST), BRIGHTEST)
        self._signal = whole[0]
        if offset.any():
            self._signal = np.maximum(self._signal + np.tensordot(offset, whole[1:], axes=1), 0.0)
        self._sums = self._summed()
        at, weight = theta + offset, search.weight
        self.cost = self._sums.deviance + float(weight @ at**2)
        self.information, self.gradient = self._sums.information, self._sums.gradient
        self.gradient[:-1] -= weight * at
        self.information[np.diag_indices(len(at))] += weight

    def _summed(self, **options: NDArray[np.float64]) -> FrameSums:
        """Return the likelihood of the frame here."""
        frame, slopes = self._frame, self._whole[1:]
        return sums_of_frame(
            frame.counts, self._signal, slopes, self.bright, self.ambient, frame.extra, frame.cycles, **options
        )

    def moved(self, step: NDArray[np.float64]) -> _LinearScene:
        """Return the scene a step away."""
        ambient = self.ambient.copy()
        ambient_step(self._sums.own, step, ambient)
        bright = self.bright * math.exp(float(step[-1]))
        return _LinearScene(
            self._search, self._frame, self._whole, self._theta, self.offset + step[:-1], bright, ambient
        )

    def excess(self, step: NDArray[np.float64]) -> float:
        """Return by which factor a step leads too far away from where the scene was rendered."""
        farthest = float((np.abs(self.offset + step[:-1]) / self._search.longest).max(initial=0.0))
        return max(farthest, abs(float(step[-1])) / _LONGEST_LOG_BRIGHT)

    def straightened(self, state: NDArray[np.float64]) -> Fit:
        """Return the scene as a fit, with the information of counts that are straight over what it leaves open.

        Where an edge just enters a zone a bin is expected to count next to nothing, and the information per count has
        no limit. It holds only as far as the count stays above zero: every bin is taken for what it counts a standard
        deviation away, at least.
        """
        rounds, well_above = 6, 3.0  # standard deviations that a count which is straight stays above zero
        own, information, straight = self._sums.own, self.information, True
        rates = np.empty((*self._signal.shape, len(information) + 1))
        self._summed(rates=rates)
        rates = rates[..., :-1] - rates[..., -1:] * (own[:, :-2] / own[:, -2:-1])[:, None]
        for _ in range(rounds):
            covariance = np.linalg.pinv(information, hermitian=True)
            least = np.sqrt(np.maximum(((rates @ covariance) * rates).sum(axis=-1), 0.0))
            straight &= bool((well_above * least <= self._sums.level).all())
            if (least <= self._sums.level).all():
                break
            information = self._summed(least=least).information
            information[np.diag_indices(len(self._search.weight))] += self._search.weight
        return self.fit(state, self._of_view(information))._replace(straight=straight)

    @property
    def view_information(self) -> NDArray[np.float64]:
        """Information in the view alone, brightness and nuisances eliminated."""
        return self._of_view(self.information)

    def _of_view(self, whole: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what information in all that is varied leaves for the view."""
        no_information = 1e-300
        while len(whole) > len(self._search.free):
            own = max(float(whole[-1, -1]), no_information)
            whole = whole[:-1, :-1] - np.outer(whole[:-1, -1], whole[-1, :-1]) / own
        return whole

    def fit(self, state: NDArray[np.float64], information: NDArray[np.float64]) -> Fit:
        """Return the scene as a fit."""
        return Fit(state, self.bright, self.ambient, self._sums.deviance, self.cost, self._sums.level, information)
