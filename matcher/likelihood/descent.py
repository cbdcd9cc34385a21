"""From candidates to the best view: maximum likelihood over continuous parameters, many frames at once.

Levenberg–Marquardt on the sums of :mod:`phasemark.matcher.likelihood.residuals`. Which pixels count is decided by the
model at the start (PHYSICS section 7) and held while the view moves, so that the sum stays comparable; where the
solution would decide otherwise it is decided again there, once, and the view moves again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.agreement import DISAGREEMENT, MAY_RETURN_COVERAGE, MUST_RETURN_COVERAGE, counts, disagrees
from phasemark.matcher.information import NATURAL_UNITS, covariance_of
from phasemark.matcher.likelihood.images import VIEW, ImageModel, ModelImages
from phasemark.matcher.likelihood.residuals import Evidence, Sums, gauss_newton_sums, robust_weight

ALBEDO = "albedo"
"""Name of the factor on the landmark's brightness, profiled out on phasors."""
SCALE = {**NATURAL_UNITS, ALBEDO: 0.1}
"""Natural units of the parameters: 1 cm, 1°; what a condition number and the longest step are told in."""
_MAX_ITERATIONS = 30
_SETTLED = 1e-4
"""A step that promises to lower the whitened squared residual by less than this is not taken."""
_ROUGH = 0.1
_CLOSE = 30.0
"""Where a step promises less than this, slopes have settled: five σ, over which they hardly change."""
_PROMISING = 20.0
"""What a view beside a solution may cost more, and still lead to a better one."""
_HOPELESS = 1000.0
"""A first view whose cost is above the limit by more is not worth its slopes."""
_KINK = 0.05
"""Slopes at one point may be those of a kink narrower than this, in natural units, which says nothing of the rest."""
_LESS = 0.5
"""And at most this share of what a parabola costs there."""
_CLOSE_CALL = 50.0
"""A fit whose cost is above its frame's best by more will not become the best."""
_SETTLING_ROUNDS = 3
"""How often a view that contradicts some pixels is left for a better one nearby."""
_OPTIMISM = 3.0
"""A fit gives up where even so many times the promised decrease would not save it."""


@dataclass(frozen=True)
class Settings:
    """What is estimated, and from what.

    Parameters
    ----------
    free : tuple of str
        Parameters of the view.
    pixels : (pixels,) bool
        Which pixels place the landmark; all of them tell its class.
    huber : float, optional
        Residual, in σ, from which the loss grows linearly, and soon no more.
    background : PhasorImages' phasor (pixels,) complex128, optional
        What stands behind, without the landmark; on phasors the albedo does not scale it.
    look_beside_rad : tuple of float
        How far to either side of a solution δ is tried once more; there may be a lower minimum behind a kink.
    prior_std : tuple of float
        Standard deviation of each free parameter about 0 before the frame was seen; infinite where nothing is known.
        Empty: nothing is known of any.
    returns_behind : (pixels,) bool, optional
        Where the background alone returns light that one frame measures; None without a background.
    unknown_around : bool
        Whether unknown things may stand in view: what the landmark does not explain is then left out of the test.
    longest_step : float
        No step is longer, in natural units of 1 cm and 1°. Near a solution it should be short: where an edge crosses
        a pixel's border, slopes jump, and those of one side may lead far away on the other.
    """

    free: tuple[str, ...]
    pixels: NDArray[np.bool_]
    huber: float | None = None
    background: NDArray[np.complex128] | None = None
    look_beside_rad: tuple[float, ...] = ()
    prior_std: tuple[float, ...] = ()
    returns_behind: NDArray[np.bool_] | None = None
    unknown_around: bool = False
    longest_step: float = 3.0


@dataclass(frozen=True, eq=False)
class Fits:
    """Candidates, each at its best view; arrays of one length m.

    Parameters
    ----------
    frame, class_index : int64
    view : (m, 4) float64
    albedo : float64
        Factor on the landmark's brightness; 1 on ranges.
    cost : float64
        Whitened squared residual of all pixels that count, and
        :data:`~phasemark.matcher.nearest.templates.DISAGREEMENT` for each pixel whose return or lack of it no view
        nearby explains.
    capped : float64
        The same with no residual adding more than that: what to compare with a scene that explains nothing.
    dof : int64
        Residuals in it, less the parameters fitted.
    unexplained : int64
        Returns that are left to unknown things in view; in `cost` each is a disagreement, in `dof` it is none.
    explained : int64
        Returns that are compared and not left to unknown things.
    agreeing, elsewhere : int64
        Returns where the landmark stands in the model: those that agree with it, compared or not, and those that see
        something else.
    prior : float64
        What the prior adds to the cost; no test of the fit counts it.
    covariance : (m, p, p) float64
        Of the free parameters of the view, nuisances taken into account; NaN where some direction is not observed.
    information : (m, p, p) float64
        Its inverse.
    std_without_one : (m, p) float64
        Largest standard deviations that any single pixel's absence leaves: what a fit is sure of although one pixel at
        an edge may claim to know more than it does. Infinite where that is not looked at.
    """

    frame: NDArray[np.int64]
    class_index: NDArray[np.int64]
    view: NDArray[np.float64]
    albedo: NDArray[np.float64]
    cost: NDArray[np.float64]
    capped: NDArray[np.float64]
    dof: NDArray[np.int64]
    unexplained: NDArray[np.int64]
    explained: NDArray[np.int64]
    agreeing: NDArray[np.int64]
    elsewhere: NDArray[np.int64]
    prior: NDArray[np.float64]
    covariance: NDArray[np.float64]
    information: NDArray[np.float64]
    std_without_one: NDArray[np.float64]

    @property
    def tested(self) -> NDArray[np.float64]:
        """The part of the cost that a χ² test judges: neither prior nor what is left to unknown things; (m,)."""
        return np.asarray(self.cost - self.prior - DISAGREEMENT * self.unexplained)

    def __len__(self) -> int:
        return len(self.frame)

    def __getitem__(self, index: NDArray[Any] | slice) -> Fits:
        return Fits(**{name: values[index] for name, values in vars(self).items()})

    def with_scale(self, scale: NDArray[np.float64]) -> Fits:
        """Return the fits with covariances scaled, each by a number (m,)."""
        return replace(
            self,
            covariance=self.covariance * scale[:, None, None],
            information=self.information / scale[:, None, None],
            std_without_one=self.std_without_one * np.sqrt(scale)[:, None],
        )

    def with_free(self, p: int) -> Fits:
        """Return the fits as those of more free parameters, which were not moved and of which nothing is known."""
        more = p - self.covariance.shape[1]
        square = ((0, 0), (0, more), (0, more))
        return replace(
            self,
            covariance=np.pad(self.covariance, square, constant_values=np.nan),
            information=np.pad(self.information, square, constant_values=np.nan),
            std_without_one=np.pad(self.std_without_one, ((0, 0), (0, more)), constant_values=np.inf),
        )

    @classmethod
    def joined(cls, parts: list[Fits]) -> Fits:
        """Put batches behind one another."""
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])})


def refine(
    model: ImageModel,
    evidence: Evidence,
    frame: NDArray[np.int64],
    class_index: NDArray[np.int64],
    view: NDArray[np.float64],
    settings: Settings,
    give_up_above: NDArray[np.float64] | None = None,
    *,
    roughly: bool = False,
    at_first_sight: bool = False,
) -> Fits:
    """Move m candidates to the nearest maximum of the likelihood.

    Parameters
    ----------
    model : ImageModel
    evidence : Evidence
    frame, class_index : (m,) int64
        Which frame each candidate explains, and by which class.
    view : (m, 4) float64
        Where it starts, columns :data:`~phasemark.matcher.likelihood.images.VIEW`.
    settings : Settings
    give_up_above : (m,) float64, optional
        Stop where the cost promises to stay above this.
    roughly : bool
        Whether to stop within a fraction of a standard deviation, with the pixels that counted at the start.
    at_first_sight : bool
        Whether to give up at the start already, where its cost is far above the limit: for starts that are good.

    Returns
    -------
    Fits
        In the order of the candidates.
    """
    limit = np.full(len(frame), np.inf) if give_up_above is None else give_up_above
    problem = _Problem(model, evidence, frame, class_index, settings, limit)
    state = problem.start(view, at_first_sight)
    state = problem.descend(state, _ROUGH if roughly else _SETTLED)
    if roughly:
        return problem.conclude(state, look_around=False)
    if settings.look_beside_rad:
        state = problem.look_beside(state)
    use = problem.pixels_at(state.images, state.theta)
    changed = np.flatnonzero((use != state.use).any(axis=1))
    if changed.size:
        again = problem.some(changed)
        moved = again.descend(again.state(state.theta[changed], use[changed]), _SETTLED)
        state = state.updated(changed, moved)
    if not model.slopes_are_free:
        state = problem.settle(state)
    return problem.conclude(state)


@dataclass(frozen=True, eq=False)
class _State:
    """Where m candidates are: parameters (view and albedo, (m, 5)), pixels in use, images and sums there."""

    theta: NDArray[np.float64]
    use: NDArray[np.bool_]
    images: ModelImages
    sums: Sums

    def updated(self, where: NDArray[np.integer], news: _State) -> _State:
        def put(old: NDArray[Any], new: NDArray[Any]) -> NDArray[Any]:
            old[where] = new
            return old

        for part in ("images", "sums"):
            for name in vars(getattr(self, part)):
                put(getattr(getattr(self, part), name), getattr(getattr(news, part), name))
        return replace(self, theta=put(self.theta, news.theta), use=put(self.use, news.use))


class _Problem:
    """m candidates with their frames."""

    def __init__(
        self,
        model: ImageModel,
        evidence: Evidence,
        frame: NDArray[np.int64],
        class_index: NDArray[np.int64],
        settings: Settings,
        limit: NDArray[np.float64],
    ) -> None:
        self.limit = limit
        self.model, self.evidence, self.settings = model, evidence, settings
        self.frame, self.class_index = frame, class_index
        self.with_albedo = evidence.on == "phasors"
        names = (*settings.free, ALBEDO) if self.with_albedo else settings.free
        self.columns = np.array([(*VIEW, ALBEDO).index(name) for name in names])
        self.scale = np.array([SCALE[name] for name in names])
        known = np.array(settings.prior_std) if settings.prior_std else np.full(len(settings.free), np.inf)
        self.prior_weight = np.concatenate([known**-2.0, np.zeros(len(names) - len(known))])

    def some(self, which: NDArray[np.integer]) -> _Problem:
        return _Problem(
            self.model, self.evidence, self.frame[which], self.class_index[which], self.settings, self.limit[which]
        )

    def start(self, view: NDArray[np.float64], at_first_sight: bool) -> _State:
        """Look at the first views: which pixels count, and how bright the landmark is."""
        theta = np.column_stack([self._clipped(view.copy()), np.ones(len(view))])
        view, free = np.ascontiguousarray(theta[:, :4]), self.settings.free
        if at_first_sight and not self.with_albedo and not self.model.slopes_are_free:
            images = self._images_at_first_sight(theta)
        else:
            images = self.model.images(self.class_index, view, free)
        if self.with_albedo:
            theta[:, 4] = self._brightness(images)
        return self._summed(theta, self.pixels_at(images, theta), self._scaled(images, theta))

    def _images_at_first_sight(self, theta: NDArray[np.float64]) -> ModelImages:
        """Return first images; slopes are 0 where no step is likely to lead below the limit."""
        view, free = np.ascontiguousarray(theta[:, :4]), self.settings.free
        images = self.model.images(self.class_index, view, ())
        images = replace(images, slope=np.zeros((len(view), len(free), images.phasor.shape[1]), np.complex128))
        cost = self._summed(theta, self.pixels_at(images, theta), images).sums.cost
        hopeful = np.flatnonzero(cost < self.limit + _HOPELESS)
        if hopeful.size:
            with_slopes = self.model.images(self.class_index[hopeful], np.ascontiguousarray(view[hopeful]), free)
            images.slope[hopeful] = with_slopes.slope
        return images

    def state(
        self, theta: NDArray[np.float64], use: NDArray[np.bool_], slope: NDArray[np.complex128] | None = None
    ) -> _State:
        """Render and compare; with known slopes, only the images are new."""
        free = self.settings.free if slope is None else ()
        images = self.model.images(self.class_index, np.ascontiguousarray(theta[:, :4]), free)
        images = self._scaled(images, theta)
        return self._summed(theta, use, images if slope is None else replace(images, slope=slope))

    def _summed(self, theta: NDArray[np.float64], use: NDArray[np.bool_], images: ModelImages) -> _State:
        sums = gauss_newton_sums(
            images.phasor, images.slope, self.evidence, self.frame, use & self.settings.pixels, self.settings.huber
        )
        return _State(theta, use, images, self._with_prior(sums, theta))

    def prior_cost(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the whitened squared distance of parameters from what was known before, (m,)."""
        return np.asarray((self.prior_weight * theta[:, self.columns] ** 2).sum(axis=1))

    def _with_prior(self, sums: Sums, theta: NDArray[np.float64]) -> Sums:
        """Add what was known of the parameters before the frame was seen."""
        if not self.prior_weight.any():
            return sums
        cost, square = self.prior_cost(theta), np.diag(self.prior_weight)
        if sums.gradient.shape[1] < len(square):  # images without slopes
            return replace(sums, cost=sums.cost + cost, capped=sums.capped + cost)
        return Sums(
            sums.cost + cost,
            sums.capped + cost,
            sums.gradient - self.prior_weight * theta[:, self.columns],
            sums.information + square,
            sums.scatter + square,
        )

    def pixels_at(self, images: ModelImages, theta: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which pixels count at some views, (m, pixels)."""
        trusted = self.model.trusted(self.class_index, theta[:, :4])
        phasor = images.phasor
        if self.with_albedo and images.slope.shape[1] == len(self.columns):
            # a landmark made dim must not make its pixels disappear: the bank's albedo decides
            phasor = phasor - (theta[:, 4:] - 1) * images.slope[:, -1]
        return counts(phasor, images.intensity, self.evidence.sensor) & trusted

    def descend(self, state: _State, settled: float) -> _State:
        """Run Levenberg–Marquardt, each candidate with its own damping.

        Close to the solution, slopes are those of the step before, until a step with them fails.
        """
        damping = np.full(len(state.theta), 1e-3)
        old = np.zeros(len(state.theta), np.bool_)
        active = np.arange(len(state.theta))
        for _ in range(_MAX_ITERATIONS):
            sums = state.sums
            step = self._steps(sums.information[active], sums.gradient[active], damping[active])
            promise = np.einsum("mp,mp->m", sums.gradient[active], step)
            worth = (promise > settled) & (sums.cost[active] - _OPTIMISM * promise < self.limit[active])
            active, step, promise = active[worth], step[worth], promise[worth]
            if not active.size:
                break
            theta = state.theta[active].copy()
            theta[:, self.columns] += step
            theta[:, :4] = self._clipped(theta[:, :4])
            theta[:, 4] = np.maximum(theta[:, 4], 1e-3)
            close = promise < _CLOSE
            stays = np.ones(len(active), np.bool_)
            for which, with_slopes in ((np.flatnonzero(~close), True), (np.flatnonzero(close), False)):
                if not which.size:
                    continue
                k = active[which]
                slope = None if with_slopes else state.images.slope[k]
                there = self.some(k).state(theta[which], state.use[k], slope)
                better = there.sums.cost <= state.sums.cost[k]
                wins = np.flatnonzero(better)
                # a step that was taken and promised little was the last: the next would promise its square
                stays[which] = (promise[which] > 100 * settled) | ~better
                lost = k[~better & old[k]]
                damping[k] = np.where(better, np.maximum(damping[k] * 0.1, 1e-9), damping[k] * 8)
                state = state.updated(k[wins], _picked(there, wins))
                old[k[wins]] = not with_slopes
                if lost.size:
                    again = self.some(lost).state(state.theta[lost], state.use[lost])
                    state = state.updated(lost, again)
                    old[lost], damping[lost] = False, 1e-3
            active = active[stays & (damping[active] < 1e5)]
        return state

    def look_beside(self, state: _State) -> _State:
        """Try δ a little to either side, the other parameters following, and descend from where that is promising."""
        sides = np.array(self.settings.look_beside_rad)
        near = self._near_best(state, 0.0)
        if not near.size:
            return state
        source = np.repeat(near, len(sides))
        theta = state.theta[source]
        turn = VIEW.index("delta_rad")
        theta[:, turn] += np.tile(sides, len(near))
        there = self.some(source).turned(state, source, theta)
        d = int(np.flatnonzero(self.columns == turn)[0])
        others = np.flatnonzero(self.columns != turn)
        unit = self.scale[others]
        information = there.sums.information[:, others[:, None], others] * np.outer(unit, unit)
        gradient = there.sums.gradient[:, others] * unit
        step = np.einsum("mpq,mq->mp", np.linalg.pinv(information, hermitian=True), gradient)
        more = (there.sums.cost - np.einsum("mp,mp->m", gradient, step)).reshape(len(near), -1)
        more -= state.sums.cost[near, None]
        # one minimum alone would cost so much more at the sides; what is far below that has another one near it
        alone = sides**2 / np.einsum("mpp->mp", self._covariance(state.sums))[near, d][:, None]
        best = np.argmin(more - _LESS * alone, axis=1)
        most = np.minimum(_PROMISING, _LESS * np.take_along_axis(alone, best[:, None], axis=1)[:, 0])
        chosen = np.flatnonzero(np.take_along_axis(more, best[:, None], axis=1)[:, 0] < most)
        if not chosen.size:
            return state
        which, at = near[chosen], chosen * len(sides) + best[chosen]
        theta = theta[at]
        theta[:, self.columns[others]] += step[at] * unit
        theta[:, :4] = self._clipped(theta[:, :4])
        some = self.some(which)
        found = some.descend(some.state(theta, state.use[which]), _SETTLED)
        better = np.flatnonzero(found.sums.cost < state.sums.cost[which])
        return state.updated(which[better], _picked(found, better))

    def settle(self, state: _State) -> _State:
        """Leave views that contradict some pixels for better ones nearby.

        Whether a pixel returns changes in a step where an edge enters it, which no slope shows. So views up to five
        standard deviations away along the axes of the covariance are tried, with the whole cost of PHYSICS section 7.
        """
        cost, contradicted = self._whole_cost(state)
        near = self._near_best(state, _CLOSE_CALL)
        for _ in range(_SETTLING_ROUNDS):
            near = near[np.flatnonzero(contradicted[near])]
            if not near.size:
                break
            moves = self._moves(state.sums, near)
            source = np.repeat(near, moves.shape[1])
            theta = state.theta[source]
            theta[:, self.columns] += moves.reshape(len(source), -1)
            theta[:, :4] = self._clipped(theta[:, :4])
            tried = self.some(source).at(theta)
            total = self.some(source)._whole_cost(tried)[0].reshape(len(near), -1)
            best = total.argmin(axis=1)
            chosen = np.flatnonzero(total[np.arange(len(near)), best] < cost[near] - 1)
            if not chosen.size:
                break
            at = chosen * moves.shape[1] + best[chosen]
            near = near[chosen]
            there = self.some(near)
            found = there.descend(there.at(theta[at], with_slopes=True), _SETTLED)
            news, still = there._whole_cost(found)
            wins = np.flatnonzero(news < cost[near])
            state = state.updated(near[wins], _picked(found, wins))
            cost[near[wins]], contradicted[near[wins]] = news[wins], still[wins]
            near = near[wins]
        return state

    def at(self, theta: NDArray[np.float64], *, with_slopes: bool = False) -> _State:
        """Return states at some parameters, each with the pixels that count there."""
        view, free = np.ascontiguousarray(theta[:, :4]), self.settings.free
        images = self.model.images(self.class_index, view, free if with_slopes else ())
        if not with_slopes:
            images = replace(images, slope=np.zeros((len(view), len(free), images.phasor.shape[1]), np.complex128))
        scaled = self._scaled(images, theta)
        return self._summed(theta, self.pixels_at(scaled, theta), scaled)

    def _whole_cost(self, state: _State) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the cost of states with all their disagreements, and whether there are any; (m,) each."""
        compared = state.use & (self.evidence.weight[self.frame] > 0)
        wrong = self._wrong(state, np.empty(0, np.intp), np.empty((0, 0, 0)), ~compared).sum(axis=1)
        n_open = (self.evidence.seen.returned[self.frame] & ~compared).sum(axis=1) - wrong
        total = state.sums.cost + DISAGREEMENT * wrong + np.maximum(n_open, 0)
        dark = (compared & (state.images.phasor == 0)).any(axis=1)
        return np.asarray(total), np.asarray((wrong > 0) | dark, np.bool_)

    def _moves(self, sums: Sums, which: NDArray[np.integer]) -> NDArray[np.float64]:
        """Return steps along the axes of the covariance, (k, moves, p); where there is none, natural units."""
        p = len(self.columns)
        matrix = covariance_of(sums.information[which] * np.outer(self.scale, self.scale))
        known = np.asarray(np.isfinite(matrix).all(axis=(1, 2)))
        values, vectors = np.linalg.eigh(np.where(known[:, None, None], matrix, np.eye(p)))
        axes = vectors * np.minimum(np.sqrt(np.maximum(values, 0.0)), 1.0)[:, None, :]
        sizes = np.array([-5.0, -2.5, -1.0, 1.0, 2.5, 5.0])
        moves = np.einsum("kpa,s->kasp", axes, sizes).reshape(len(which), -1, p)
        longest = np.abs(moves).max(axis=2, keepdims=True)
        return np.asarray(moves * np.minimum(1.0, 2.0 / np.maximum(longest, 1e-30)) * self.scale)

    def turned(self, states: _State, source: NDArray[np.integer], theta: NDArray[np.float64]) -> _State:
        """Return states that differ from `source` in δ alone, with the slopes from there."""
        before = ModelImages(**{name: values[source] for name, values in vars(states.images).items()})
        if self.with_albedo:  # what the model makes is as bright as the bank has it
            before = replace(before, phasor=before.phasor - (theta[:, 4:] - 1) * before.slope[:, -1])
        images = self.model.turned(self.class_index, np.ascontiguousarray(theta[:, :4]), before)
        if self.with_albedo:
            images = replace(self._scaled(replace(images, slope=images.slope[:, :-1]), theta), slope=before.slope)
        return self._summed(theta, states.use[source], images)

    def _near_best(self, state: _State, margin: float) -> NDArray[np.intp]:
        """Return the candidates that may be their frame's best, up to some cost above it; with none the best alone."""
        cost = state.sums.cost
        order = np.lexsort((cost, self.frame))
        first = order[np.flatnonzero(np.diff(self.frame[order], prepend=-1))]
        if margin == 0:
            return np.sort(first[cost[first] <= self.limit[first]])
        least = np.full(len(self.evidence.weight), np.inf)
        least[self.frame[first]] = cost[first]
        return np.flatnonzero((cost <= self.limit) & (cost <= least[self.frame] + margin))

    def conclude(self, state: _State, *, look_around: bool = True) -> Fits:
        """Take stock of the solutions."""
        settings, evidence = self.settings, self.evidence
        p = len(settings.free)
        covariance = self._covariance(state.sums)
        # where it does not matter any more, what is nearby is not looked at
        # before a background the cost is final here; otherwise pixels that nothing explains may still change it
        margin = _CLOSE_CALL if settings.background is None else 0.0
        near = self._near_best(state, margin) if look_around else np.empty(0, np.intp)
        without_one = np.full((len(state.theta), p), np.inf)
        if near.size:
            there = self.some(near)
            slope = there.slopes_around(state, near, self._std(covariance[near]))
            sums = there._summed(
                state.theta[near],
                state.use[near],
                ModelImages(
                    **{name: values[near] for name, values in vars(state.images).items() if name != "slope"},
                    slope=state.images.slope[near] if slope is None else slope,
                ),
            ).sums
            if slope is not None:
                covariance[near] = self._covariance(sums)
            rows = state.images.slope[near] if slope is None else slope
            without_one[near] = there._std_without_one(state, near, rows, sums.information, covariance[near])
        natural = covariance_of(covariance / np.outer(self.scale[:p], self.scale[:p]))  # of a covariance: information
        information = natural * np.outer(1 / self.scale[:p], 1 / self.scale[:p])
        all_pixels = np.ones_like(settings.pixels)
        sums = state.sums
        if not settings.pixels.all():
            sums = gauss_newton_sums(
                state.images.phasor, state.images.slope, evidence, self.frame, state.use & all_pixels, settings.huber
            )
            sums = self._with_prior(sums, state.theta)
        fitted = state.use & (evidence.weight[self.frame] > 0)
        wrong = self._wrong(state, near, covariance, ~fitted)
        returned = evidence.seen.returned[self.frame]
        # a return that is neither compared nor wrong costs what a pixel costs on average: a model that counts fewer
        # pixels is not better for it
        open_ = returned & ~fitted & ~wrong
        unexplained, agreeing, elsewhere = (np.zeros(len(state.theta), np.int64) for _ in range(3))
        if settings.unknown_around:
            outlying, here = self._outlying(state), state.use & returned
            wrong, open_ = wrong | (open_ & outlying), open_ & ~outlying
            agreeing, elsewhere = (here & ~outlying).sum(axis=1), (here & outlying).sum(axis=1)
            unexplained = (fitted & outlying).sum(axis=1) + (wrong & returned).sum(axis=1)
        n_wrong, n_open = wrong.sum(axis=1), open_.sum(axis=1)
        n_residuals = fitted.sum(axis=1) * evidence.per_pixel + n_wrong + n_open
        if settings.unknown_around:
            fitted = fitted & ~outlying
        return Fits(
            frame=self.frame,
            class_index=self.class_index,
            view=state.theta[:, :4],
            albedo=state.theta[:, 4],
            cost=sums.cost + DISAGREEMENT * n_wrong + n_open,
            capped=sums.capped + DISAGREEMENT * n_wrong + n_open,
            dof=np.maximum(n_residuals - unexplained - int((self.prior_weight == 0).sum()), 0),
            unexplained=unexplained,
            explained=fitted.sum(axis=1),
            agreeing=agreeing,
            elsewhere=elsewhere,
            prior=self.prior_cost(state.theta),
            covariance=covariance,
            information=information,
            std_without_one=without_one,
        )

    def _outlying(self, state: _State) -> NDArray[np.bool_]:
        """Return where the robust loss of a range has reached what a disagreement costs, (m, pixels)."""
        sensor, huber = self.evidence.sensor, self.settings.huber or math.inf
        phasor = state.images.phasor
        residual = sensor.metres_per_radian * np.angle(self.evidence.value[self.frame] * phasor.conj())
        size = np.abs(residual) * np.sqrt(self.evidence.seen.weight[self.frame])
        return np.asarray((phasor == 0) | (huber * (2 * size - huber) >= DISAGREEMENT))

    def _std_without_one(
        self,
        state: _State,
        which: NDArray[np.integer],
        slope: NDArray[np.complex128],
        information: NDArray[np.float64],
        covariance: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return the largest standard deviations without any one pixel, (k, p), by the Woodbury formula.

        The formula holds for the inverse information. A sandwich covariance grows by the same ratio.
        """
        p = covariance.shape[1]
        phasor, weight = state.images.phasor[which], self.evidence.weight[self.frame]
        use = state.use[which] & self.settings.pixels & (weight > 0) & (phasor != 0)
        turn = np.divide(1.0, phasor, out=np.zeros_like(phasor), where=use)
        value = self.evidence.value[self.frame]
        if self.evidence.on == "ranges":
            rows = self.evidence.sensor.metres_per_radian * (slope * turn[:, None]).imag[..., None]
            residual = self.evidence.sensor.metres_per_radian * np.angle(value * phasor.conj())[..., None]
        else:
            rows = np.stack([slope.real, slope.imag], axis=-1)
            residual = np.stack([(value - phasor).real, (value - phasor).imag], axis=-1)
        root = np.sqrt(robust_weight(residual, (weight * use)[..., None], self.settings.huber))
        rows = rows * root[:, None]  # (k, p, pixels, 1 or 2)
        inverse = covariance_of(information, self.scale)
        moved = np.einsum("kab,kbqr->kaqr", inverse, rows)
        kept = (1 + 1e-12) * np.eye(rows.shape[3]) - np.einsum("kaqr,kaqs->kqrs", rows, moved)
        moved = moved[:, :p]
        more = np.einsum("kaqr,kqrs,kaqs->kaq", moved, np.linalg.inv(kept), moved).max(axis=2)
        own = np.einsum("kaa->ka", inverse)[:, :p]
        return np.asarray(np.sqrt(np.einsum("kaa->ka", covariance) * (own + more) / own))

    def _wrong(
        self, state: _State, near: NDArray[np.intp], covariance: NDArray[np.float64], among: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Return which of some pixels return, or do not, as no view within three standard deviations explains."""
        seen, settings = self.evidence.seen, self.settings
        returned, absent = seen.returned[self.frame], seen.not_returned[self.frame]
        # a kink nearby excuses a pixel where it keeps it from being compared
        among = among & self.model.trusted(self.class_index, state.theta[:, :4])

        def disagree(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.bool_]:
            may, must = high >= MAY_RETURN_COVERAGE, low > MUST_RETURN_COVERAGE
            if settings.returns_behind is not None:
                may, must = may | settings.returns_behind, state.use
            return disagrees(returned, absent, may, must) & among

        low, high = state.images.coverage.copy(), state.images.coverage.copy()
        wrong = disagree(low, high)
        near = near[wrong[near].any(axis=1)]
        if near.size:
            view = np.ascontiguousarray(state.theta[near, :4])
            around = self.model.reach(self.class_index[near], view, self.settings.free, self._std(covariance[near]))
            low[near], high[near] = np.minimum(low[near], around[0]), np.maximum(high[near], around[1])
            wrong = disagree(low, high)
        return wrong

    def _covariance(self, sums: Sums) -> NDArray[np.float64]:
        """Return the covariance of the view, (m, p, p): inverse information, or the sandwich."""
        p = len(self.settings.free)
        covariance = covariance_of(sums.information, self.scale)
        if self.settings.huber is not None:
            covariance = covariance @ sums.scatter @ covariance
        return np.ascontiguousarray(covariance[:, :p, :p])

    def _std(self, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return standard deviations, (m, p), one natural unit where they are larger or unknown."""
        p = covariance.shape[1]
        variance = np.einsum("mpp->mp", covariance)
        std = np.sqrt(np.where(np.isfinite(variance), variance, np.inf))
        return np.asarray(np.minimum(std, self.scale[:p]))

    def slopes_around(
        self, state: _State, which: NDArray[np.integer], std: NDArray[np.float64]
    ) -> NDArray[np.complex128] | None:
        """Return slopes over half a standard deviation to either side, (m, p, pixels): what a kink nearby averages to.

        None where the model is smooth.
        """
        view = np.ascontiguousarray(state.theta[which, :4])
        step = np.maximum(0.5 * std, _KINK * self.scale[: std.shape[1]])
        slope = self.model.wide_slopes(self.class_index, view, self.settings.free, step)
        if slope is None:
            return None
        if not self.with_albedo:
            # light that comes and goes within the step has no phase whose slope could tell anything
            phasor = np.abs(state.images.phasor[which])[:, None]
            return np.where(np.abs(slope) * step[:, :, None] > phasor, 0.0, slope)
        return np.concatenate([slope * state.theta[which, 4:, None], state.images.slope[which, -1:]], axis=1)

    def _scaled(self, images: ModelImages, theta: NDArray[np.float64]) -> ModelImages:
        """Make the landmark as bright as the parameters have it, and append the slope by that."""
        if not self.with_albedo:
            return images
        own = self._landmark_alone(images)
        factor = theta[:, 4:]
        slope = np.concatenate([images.slope * factor[:, :, None], own[:, None]], axis=1)
        return replace(images, phasor=images.phasor + (factor - 1) * own, slope=slope)

    def _landmark_alone(self, images: ModelImages) -> NDArray[np.complex128]:
        behind = self.settings.background
        return images.phasor if behind is None else images.phasor - (1 - images.coverage) * behind

    def _brightness(self, images: ModelImages) -> NDArray[np.float64]:
        """Return the factor by which frames are brighter than their models, (m,)."""
        own = self._landmark_alone(images)
        value, weight = self.evidence.value[self.frame], self.evidence.weight[self.frame]
        weight = weight * (images.coverage > MUST_RETURN_COVERAGE)
        power = np.sum(weight * np.abs(own) ** 2, axis=1)
        along = np.sum(weight * (own.conj() * (value - (images.phasor - own))).real, axis=1)
        factor = np.divide(along, power, out=np.ones_like(power), where=power > 0)
        return np.asarray(np.clip(factor, 0.01, 100.0))

    def _clipped(self, view: NDArray[np.float64]) -> NDArray[np.float64]:
        view[:, 0] = np.clip(view[:, 0], *self.model.limits())
        return view

    def _steps(
        self, information: NDArray[np.float64], gradient: NDArray[np.float64], damping: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return damped steps, (m, p), none too long in any parameter."""
        scaled = information * np.outer(self.scale, self.scale)
        diagonal = np.einsum("mpp->mp", scaled)
        floor = 1e-12 * diagonal.max(axis=1, initial=0.0) + 1e-300
        held = scaled + np.einsum("mp,pq->mpq", damping[:, None] * diagonal + floor[:, None], np.eye(len(self.scale)))
        step = np.linalg.solve(held, (gradient * self.scale)[:, :, None])[:, :, 0]
        longest = np.abs(step).max(axis=1, keepdims=True)
        return np.asarray(step * np.minimum(1.0, self.settings.longest_step / np.maximum(longest, 1e-30)) * self.scale)


def _picked(state: _State, which: NDArray[np.integer]) -> _State:
    images = ModelImages(**{name: values[which] for name, values in vars(state.images).items()})
    sums = Sums(**{name: values[which] for name, values in vars(state.sums).items()})
    return _State(state.theta[which], state.use[which], images, sums)
