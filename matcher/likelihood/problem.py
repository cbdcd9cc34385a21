"""Candidates with the frames they explain: what their images cost at some views, and how that changes.

The sums are those of :mod:`phasemark.matcher.likelihood.residuals`. Which pixels count is decided by the model at the
start (PHYSICS section 7) and held while a view moves, so that the sum stays comparable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.information import NATURAL_UNITS
from phasemark.matcher.likelihood.images import TILT, VIEW, ImageModel, ModelImages
from phasemark.matcher.likelihood.residuals import Evidence, Sums, gauss_newton_sums
from phasemark.matcher.likelihood.search_policy import DEFAULT_POLICY, SearchPolicy
from phasemark.matcher.pixel_agreement import (
    DISAGREEMENT,
    MAY_RETURN_COVERAGE,
    MUST_RETURN_COVERAGE,
    SURELY,
    counts,
)

LONGEST_STEP = 3.0
"""Longest step of a descent, in natural units of 1 cm and 1°."""

ALBEDO = "albedo"
"""Name of the factor on the landmark's brightness beside what stands behind it, profiled out."""
ALBEDO_COLUMN = len(VIEW)
"""Its column in arrays of parameters, behind those of the view."""
SCALE = {**NATURAL_UNITS, ALBEDO: 0.1}
"""Natural units of the parameters: 1 cm, 1°. Condition numbers and the longest step are stated in them."""

_Scalar = TypeVar("_Scalar", bound=np.generic)

_DIMMEST = 0.01
"""Least factor on a landmark's brightness whose logarithm counts."""
_STEEPEST_RAD = 1.2
"""Largest pitch and roll that a descent tries: at ± 90° of pitch, roll and bearing are one."""


@dataclass(frozen=True)
class DescentSettings:
    """Free parameters and evidence of a descent.

    Parameters
    ----------
    free : tuple of str
        Parameters of the view.
    used : (pixels,) bool
        Which pixels place the landmark; all of them tell its class.
    huber : float, optional
        Residual, in σ, from which the loss grows linearly; it stays constant where it has reached 25.
    phasor_behind : (k, pixels) complex128, optional
        What stands behind all frames (k = 1), or each of them, without the landmark; on phasors the albedo does not
        scale it.
    look_beside_rad : tuple of float
        How far to either side of a solution δ is tried once more; there may be a lower minimum behind a kink.
    prior_std : tuple of float
        Standard deviation of each free parameter before the frame was seen, about the tilt that the frame states or 0;
        infinite where nothing is known. Empty: nothing is known of any.
    returns_behind : (k, pixels) bool, optional
        Where that alone returns light that one frame measures; None without a background.
    unknown_around : bool
        Whether unknown things may stand in view: what the landmark does not explain is then left out of the test.
    boards : tuple of bool
        Among unknown things, whether each class is flat.
    longest_step : float
        No step is longer, in natural units of 1 cm and 1°. Near a solution it should be short: where an edge crosses
        a pixel's border, slopes jump, and those of one side may lead far away on the other.
    around : ImageModel, optional
        What shows the views around a solution, where the images of the model itself are slow.
    albedo_std : float
        Standard deviation of the logarithm of the factor on the landmark's brightness before the frame was seen; 0: the
        factor is 1. On phasors nothing is known of it.
    policy : SearchPolicy
    """

    free: tuple[str, ...]
    used: NDArray[np.bool_]
    huber: float | None = None
    phasor_behind: NDArray[np.complex128] | None = None
    look_beside_rad: tuple[float, ...] = ()
    prior_std: tuple[float, ...] = ()
    returns_behind: NDArray[np.bool_] | None = None
    unknown_around: bool = False
    boards: tuple[bool, ...] = ()
    longest_step: float = LONGEST_STEP
    around: ImageModel | None = None
    albedo_std: float = 0.0
    policy: SearchPolicy = DEFAULT_POLICY


@dataclass(eq=False)
class State:
    """State of m candidates: parameters (view and albedo, (m, 7)), pixels in use, images and sums there."""

    theta: NDArray[np.float64]
    use: NDArray[np.bool_]
    images: ModelImages
    sums: Sums

    def update(self, where: NDArray[np.integer], news: State) -> None:
        """Replace some candidates by others, in place."""
        self.images.update(where, news.images)
        for name, values in vars(self.sums).items():
            values[where] = getattr(news.sums, name)
        self.theta[where], self.use[where] = news.theta, news.use


class Problem:
    """m candidates with their frames.

    Five methods return a :class:`State`:

    ========== ======================= ==================== ===========================
    method     pixels that count       images               slopes
    ========== ======================= ==================== ===========================
    `start`    decided by the images   new, or kept ones    new
    `state`    those that are given    new                  new, or those that are given
    `at`       decided by the images   new                  new on request
    `turned`   as in the source        the rows δ changes   those of the source
    `summed`   those that are given    those that are given those that are given
    ========== ======================= ==================== ===========================

    Parameters
    ----------
    model : ImageModel
    evidence : Evidence
    frame, class_index : (m,) int64
        Which frame each candidate explains, and by which class.
    settings : DescentSettings
    limit : (m,) float64, optional
        Cost above which a candidate is given up.
    rival : (m,) float64, optional
        Cost of the best explanation of each candidate's frame that is known besides.
    """

    def __init__(
        self,
        model: ImageModel,
        evidence: Evidence,
        frame: NDArray[np.int64],
        class_index: NDArray[np.int64],
        settings: DescentSettings,
        limit: NDArray[np.float64] | None = None,
        rival: NDArray[np.float64] | None = None,
    ) -> None:
        self.limit = np.full(len(frame), np.inf) if limit is None else limit
        self.rival = np.full(len(frame), np.inf) if rival is None else rival
        self.model, self.evidence, self.settings = model.of_frames(frame), evidence, settings
        self.policy = settings.policy
        self.frame, self.class_index = frame, class_index
        self.with_albedo = evidence.on == "phasors" or settings.albedo_std > 0
        names = (*settings.free, ALBEDO) if self.with_albedo else settings.free
        self.columns = np.array([(*VIEW, ALBEDO).index(name) for name in names])
        self.scale = np.array([SCALE[name] for name in names])
        self.height_or_tilt_is_free = bool(set(names) & set(VIEW[3:]))
        self.tilts = bool(set(names) & set(VIEW[TILT]))
        known = np.array(settings.prior_std) if settings.prior_std else np.full(len(settings.free), np.inf)
        of_albedo = settings.albedo_std**-2.0 if evidence.on == "ranges" and self.with_albedo else 0.0
        self.prior_weight = np.concatenate([known**-2.0, np.full(len(names) - len(known), of_albedo)])

    def some(self, which: NDArray[np.integer], model: ImageModel | None = None) -> Problem:
        """Return the problem of some of the candidates, on the same or another model."""
        frame, class_index = self.frame[which], self.class_index[which]
        model = model or self.model
        return Problem(model, self.evidence, frame, class_index, self.settings, self.limit[which], self.rival[which])

    def around(self, which: NDArray[np.integer]) -> Problem:
        """Return the problem of some of the candidates, on what shows the views around solutions."""
        return self.some(which, self.settings.around)

    def parameters(self, view: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the parameters of views that the model can show, with landmarks as bright as the bank has them."""
        return np.column_stack([self.clipped(view.copy(), np.arange(len(view))), np.ones(len(view))])

    def start(self, view: NDArray[np.float64]) -> State:
        """Evaluate the first views: the pixels that count, and the brightness of the landmark."""
        theta = self.parameters(view)
        view, free = np.ascontiguousarray(theta[:, :ALBEDO_COLUMN]), self.settings.free
        images = self.model.first_images(self.class_index, view, free)
        if self.evidence.on == "phasors":
            theta[:, ALBEDO_COLUMN] = self._brightness(images)
        return self.summed(theta, self.pixels_at(images, theta), self.scaled(images, theta))

    def state(
        self, theta: NDArray[np.float64], use: NDArray[np.bool_], slope: NDArray[np.complex128] | None = None
    ) -> State:
        """Render and compare; with known slopes, only the images are new."""
        free = self.settings.free if slope is None else ()
        images = self.model.images(self.class_index, np.ascontiguousarray(theta[:, :ALBEDO_COLUMN]), free)
        images = self.scaled(images, theta)
        return self.summed(theta, use, images if slope is None else replace(images, slope=slope))

    def at(self, theta: NDArray[np.float64], *, with_slopes: bool = False) -> State:
        """Return states at some parameters, each with the pixels that count there."""
        view, free = np.ascontiguousarray(theta[:, :ALBEDO_COLUMN]), self.settings.free
        images = self.model.images(self.class_index, view, free if with_slopes else ())
        if self.with_albedo and not with_slopes:
            images = replace(images, slope=np.zeros((len(view), len(free), images.phasor.shape[1]), np.complex128))
        scaled = self.scaled(images, theta)
        return self.summed(theta, self.pixels_at(scaled, theta), scaled)

    def turned(self, states: State, source: NDArray[np.integer], theta: NDArray[np.float64]) -> State:
        """Return states that differ from `source` in δ alone, with the slopes from there."""
        like = states.images[source]
        if self.with_albedo:  # a model returns images of the bank's albedo
            like = replace(like, phasor=like.phasor - (theta[:, ALBEDO_COLUMN:] - 1) * like.slope[:, -1])
        images = self.model.turned(self.class_index, np.ascontiguousarray(theta[:, :ALBEDO_COLUMN]), like)
        if self.with_albedo:
            images = replace(self.scaled(replace(images, slope=images.slope[:, :-1]), theta), slope=like.slope)
        return self.summed(theta, states.use[source], images)

    def summed(self, theta: NDArray[np.float64], use: NDArray[np.bool_], images: ModelImages) -> State:
        """Return the state of images that were rendered: compare them with the frames."""
        return State(theta, use, images, self.with_prior(self.sums(images, use & self.settings.used), theta))

    def sums(self, images: ModelImages, use: NDArray[np.bool_]) -> Sums:
        """Return the sums of images over some pixels, (m, pixels), without what was known before."""
        return gauss_newton_sums(images.phasor, images.slope, self.evidence, self.frame, use, self.settings.huber)

    def prior_cost(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the whitened squared distance of parameters from what was known before, (m,)."""
        return np.asarray((self.prior_weight * self._from_prior(theta) ** 2).sum(axis=1))

    def _from_prior(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far free parameters are from what was expected, (m, p); of the albedo, its logarithm."""
        off = theta.copy()
        off[:, TILT] -= self.evidence.tilt_rad[self.frame]
        off[:, ALBEDO_COLUMN] = np.log(np.maximum(theta[:, ALBEDO_COLUMN], _DIMMEST))
        return np.asarray(off[:, self.columns])

    def with_prior(self, sums: Sums, theta: NDArray[np.float64]) -> Sums:
        """Add what was known of the parameters before the frame was seen."""
        if not self.prior_weight.any():
            return sums
        cost, p = self.prior_cost(theta), len(self.columns)
        sums = replace(sums, cost=sums.cost + cost, capped=sums.capped + cost)
        if sums.gradient.shape[1] < p:  # images without slopes
            return sums
        rate = np.ones((len(theta), p))  # of what is known, by the parameters
        if self.with_albedo:
            rate[:, -1] /= np.maximum(theta[:, ALBEDO_COLUMN], _DIMMEST)
        gradient = sums.gradient - self.prior_weight * self._from_prior(theta) * rate
        square = (self.prior_weight * rate**2)[:, :, None] * np.eye(p)
        return replace(sums, gradient=gradient, information=sums.information + square)

    def sure_pixels_at(self, state: State) -> NDArray[np.bool_]:
        """Return where neither noise nor a threshold hides the light of some states, (m, pixels)."""
        images = state.images
        return counts(images.phasor, images.intensity, self.evidence.sensor, SURELY) & self._is_sure_target(images)

    def _is_sure_target(self, images: ModelImages) -> NDArray[np.bool_] | np.bool_:
        """Return where a chip must report its target: one that need not be reported jumps, and only contradicts."""
        return images.coverage > MAY_RETURN_COVERAGE if self.model.is_of_chip else np.True_

    def pixels_at(self, images: ModelImages, theta: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which pixels count at some views, (m, pixels)."""
        trusted = self.model.trusted(self.class_index, theta[:, :ALBEDO_COLUMN]) & self._is_sure_target(images)
        phasor, sensor = images.phasor, self.evidence.sensor
        if self.with_albedo and images.slope.shape[1] == len(self.columns):
            # a landmark made dim must not make its pixels disappear: the bank's albedo decides
            factor, own = theta[:, ALBEDO_COLUMN:], images.slope[:, -1]
            phasor = phasor - (factor - 1) * own
            if self.evidence.on == "ranges":  # its light and the background's may cancel: that has no range
                cancels = counts(factor * own, images.intensity, sensor) & ~counts(
                    images.phasor, images.intensity, sensor
                )
                trusted = trusted & ~cancels
        return counts(phasor, images.intensity, sensor) & trusted

    def best_of_frames(self, state: State) -> NDArray[np.intp]:
        """Return the best candidate of each frame, in the order of the candidates, if its cost is within its limit."""
        cost = state.sums.cost
        first = self._first_of_frames(cost)
        return np.sort(first[cost[first] <= self.limit[first]])

    def near_best(self, state: State, margin: float) -> NDArray[np.intp]:
        """Return the candidates that cost at most `margin` more than their frame's best, and may beat their rival."""
        cost = state.sums.cost
        first = self._first_of_frames(cost)
        least = np.full(len(self.evidence.weight), np.inf)
        least[self.frame[first]] = cost[first]
        near = np.minimum(least[self.frame] + margin, self.rival + DISAGREEMENT)
        return np.flatnonzero((cost <= self.limit) & (cost <= near))

    def _first_of_frames(self, cost: NDArray[np.float64]) -> NDArray[np.intp]:
        """Return the candidate of lowest cost of each frame."""
        order = np.lexsort((cost, self.frame))
        return order[np.flatnonzero(np.diff(self.frame[order], prepend=-1))]

    def scaled(self, images: ModelImages, theta: NDArray[np.float64]) -> ModelImages:
        """Make the landmark as bright as the parameters have it, and append the slope by that."""
        if not self.with_albedo:
            return images
        own = self._landmark_alone(images)
        factor = theta[:, ALBEDO_COLUMN:]
        slope = images.slope * factor[:, :, None]
        if images.behind_slope is not None and images.behind_slope.shape == slope.shape:
            slope -= (factor[:, :, None] - 1) * images.behind_slope
        slope = np.concatenate([slope, own[:, None]], axis=1)
        return replace(images, phasor=images.phasor + (factor - 1) * own, slope=slope, behind_slope=None)

    def at_brightness(
        self, factor: NDArray[np.float64], change: Callable[[ImageModel], NDArray[np.complex128] | None]
    ) -> NDArray[np.complex128] | None:
        """Return a change of images (m, k, pixels) with landmarks as bright as some factors (m,) have them.

        Parameters
        ----------
        factor : (m,) float64
        change : callable
            Returns the change of a model's images, whose landmarks are as bright as the bank has them; None of a model
            that is smooth, which is then returned.
        """
        if not self.with_albedo:
            return change(self.model)
        if (lit := self.model.lit(factor)) is not None:
            return change(lit)
        whole = change(self.model)
        return None if whole is None else whole * factor[:, None, None]

    def _landmark_alone(self, images: ModelImages) -> NDArray[np.complex128]:
        if images.behind is not None:
            return images.phasor - images.behind
        if self.settings.phasor_behind is None:
            return images.phasor
        return images.phasor - (1 - images.coverage) * self.for_candidates(self.settings.phasor_behind)

    def for_candidates(self, behind: NDArray[_Scalar]) -> NDArray[_Scalar]:
        """Return the values of the frames of the candidates, (m, pixels), or (1, pixels) of one for all."""
        return behind if len(behind) == 1 else behind[self.frame]

    def _brightness(self, images: ModelImages) -> NDArray[np.float64]:
        """Return the factor by which frames are brighter than their models, (m,)."""
        own = self._landmark_alone(images)
        value, weight = self.evidence.value[self.frame], self.evidence.weight[self.frame]
        weight = weight * (images.coverage > MUST_RETURN_COVERAGE)
        power = np.sum(weight * np.abs(own) ** 2, axis=1)
        along = np.sum(weight * (own.conj() * (value - (images.phasor - own))).real, axis=1)
        factor = np.divide(along, power, out=np.ones_like(power), where=power > 0)
        return np.asarray(np.clip(factor, 0.01, 100.0))

    def clipped(self, view: NDArray[np.float64], which: NDArray[np.integer]) -> NDArray[np.float64]:
        """Move views of some candidates, in place, to distances and tilts that the model can show; return them."""
        self.model.clip(view, which)
        if self.tilts:
            np.clip(view[:, TILT], -_STEEPEST_RAD, _STEEPEST_RAD, out=view[:, TILT])
        return view


def picked(state: State, which: NDArray[np.integer]) -> State:
    """Return the state of some of the candidates."""
    sums = Sums(**{name: values[which] for name, values in vars(state.sums).items()})
    return State(state.theta[which], state.use[which], state.images[which], sums)
