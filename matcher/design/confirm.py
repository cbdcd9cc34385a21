"""Whether the bound keeps its word: simulated noisy frames, matched, for a design and for the catalogue.

Each set is seen at the distance of its worst bound, from sides over half a period with the worst one among them, and
at random places over the whole range. Every frame set is captured, filtered and matched by maximum likelihood against
the set's own bank, so errors are those of the whole program; the angle's error is taken modulo the box's symmetry.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark.data import BankPlan, build_bank
from phasemark.data.seeds import stream
from phasemark.landmarks import build_mesh
from phasemark.matcher.bounds import Estimate, cramer_rao, efficiency, share
from phasemark.matcher.design.plan import DesignPlan
from phasemark.matcher.design.search import Scored
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.trials import Conditions, noisy_frames
from phasemark.render import Renderer, Sensor, Views

SIDES = 13
_BANK_STEPS = 150
_BANK_STEP_M = 0.01
_FRAMES_AT_ONCE = 200


@dataclass(frozen=True, eq=False)
class Trial:
    """Frames of some views, matched; (k, n) arrays: k places or sides, n frames of each.

    Parameters
    ----------
    distance_m, delta_rad : (k,) or (k, n) float64
        The truth.
    bound_m : (k, n) float64
        Position bound at the truth, the root of the trace of its covariance.
    error_m : float64
        Distance of the lens from where it is; NaN where no landmark was found.
    class_right : bool
    """

    distance_m: NDArray[np.float64]
    delta_rad: NDArray[np.float64]
    bound_m: NDArray[np.float64]
    error_m: NDArray[np.float64]
    class_right: NDArray[np.bool_]

    @property
    def class_errors(self) -> Estimate:
        """Share of frames whose class was not found."""
        return share(int((~self.class_right).sum()), self.class_right.size)

    @property
    def missed(self) -> Estimate:
        """Share of frames in which no landmark was found; they have no position error."""
        return share(int(np.isnan(self.error_m).sum()), self.error_m.size)

    @property
    def efficiency(self) -> Estimate:
        """√mean(error² / bound²), 1 at the bound."""
        found = np.isfinite(self.error_m)
        return efficiency(self.error_m[found], self.bound_m[found])

    def rmse(self, k: int) -> Estimate:
        """Return the root mean square error at one place, metres."""
        return root_mean_square(self.error_m[k])

    def largest(self) -> tuple[int, Estimate]:
        """Return where the root mean square error is largest, judged by every other frame, and measured on the rest."""
        judged = np.nanmean(self.error_m[:, ::2] ** 2, axis=1)
        k = int(judged.argmax())
        return k, root_mean_square(self.error_m[k, 1::2])


@dataclass(frozen=True, eq=False)
class Confirmation:
    """What a set of landmarks gave.

    Parameters
    ----------
    sides : Trial
        At the distance of the worst bound; the last of the k sides is that of the worst bound.
    anywhere : Trial
        Random distances over the range, random sides; k = 1.
    """

    sides: Trial
    anywhere: Trial

    @property
    def at_worst(self) -> Estimate:
        """Root mean square position error at the worst view of the bound, metres."""
        return self.sides.rmse(-1)


def root_mean_square(error: NDArray[np.float64]) -> Estimate:
    """Return √mean(e²) of the finite errors with its 95 % interval."""
    found = error[np.isfinite(error)]
    return efficiency(found, np.ones(len(found))) if len(found) > 1 else Estimate(math.nan, 0.0, math.inf)


def ratio(above: Estimate, below: Estimate) -> Estimate:
    """Return a quotient of independent positive numbers with its 95 % interval, from their relative errors."""

    def relative(one: Estimate) -> float:
        return (one.high - one.low) / (2 * one.value)

    value, spread = above.value / below.value, math.hypot(relative(above), relative(below))
    return Estimate(value, value * math.exp(-spread), value * math.exp(spread))


def confirm(
    scored: Scored,
    sensor: Sensor,
    plan: DesignPlan,
    n: int,
    *,
    purpose: str,
    workers: int = 1,
    progress: Callable[[], None] = lambda: None,
) -> Confirmation:
    """Match simulated frames of a set of landmarks.

    Parameters
    ----------
    scored : Scored
    sensor : Sensor
    plan : DesignPlan
        Its seed, range and number of frames count.
    n : int
        Filtered frames at every side, and ten times as many anywhere; spread evenly over the classes.
    purpose : str
        Keeps the random streams of two sets apart.
    workers : int
        Threads.
    progress : callable
        Called after each class of each part.
    """
    near, far = plan.distance_m
    step = max(_BANK_STEP_M, (far - near) / _BANK_STEPS)
    bank_plan = BankPlan(
        landmarks=scored.specs,
        sensor=plan.sensor,
        sensor_overrides=plan.sensor_overrides,
        distance_m=f"{0.9 * near:.4f}:{1.1 * far:.4f}:{step:.4f}",
    )
    matcher = Matcher(build_bank(bank_plan, workers=workers), method="refine", workers=workers)
    period = scored.specs[0].delta_period_rad
    distance, worst = scored.bound.worst_view
    sides = np.append(np.linspace(0.0, period / 2, SIDES), worst)
    each = max(1, math.ceil(n / len(scored.specs)))
    rng = stream(plan.seed, f"{purpose} places", 0)
    parts: list[tuple[Trial, Trial]] = []
    for k, spec in enumerate(scored.specs):
        renderer = Renderer(build_mesh(spec), sensor, albedo=spec.albedo)
        views = (
            Views.broadcast(distance, np.repeat(sides, each)),
            Views.broadcast(rng.uniform(near, far, 10 * each), rng.uniform(0.0, period, 10 * each)),
        )
        trials = []
        for index, some in enumerate(views):
            frames = stream(plan.seed, f"{purpose} frames", 2 * k + index)
            trials.append(_matched(matcher, renderer, spec.name, some, plan, period, frames, workers))
            progress()
        parts.append((_shaped(trials[0], len(sides)), _shaped(trials[1], 1)))
    return Confirmation(*(_joined([part[index] for part in parts]) for index in range(2)))


def _matched(
    matcher: Matcher,
    renderer: Renderer,
    name: str,
    views: Views,
    plan: DesignPlan,
    period: float,
    rng: np.random.Generator,
    workers: int,
) -> Trial:
    conditions = Conditions(n_frames=plan.n_frames)
    error, right = np.empty(len(views)), np.empty(len(views), np.bool_)
    for start in range(0, len(views), _FRAMES_AT_ONCE):
        part = slice(start, min(start + _FRAMES_AT_ONCE, len(views)))
        some = views[part]
        matches = matcher.match(noisy_frames(renderer, renderer.sensor, some, conditions, rng, workers=workers))
        turn = matches.delta_rad - some.delta_rad
        turn = turn - period * np.round(turn / period)
        # the lens from where it is: D and D' at an angle of the error in δ
        across = 2 * np.sqrt(matches.distance_m * some.distance_m) * np.sin(turn / 2)
        error[part] = np.hypot(matches.distance_m - some.distance_m, across)
        right[part] = matches.class_name == name
    covariance = cramer_rao(renderer, views, n_frames=plan.n_frames, pixels="lower", workers=workers).covariance
    bound = np.sqrt(covariance[:, 0, 0] + views.distance_m**2 * covariance[:, 1, 1])
    return Trial(views.distance_m, views.delta_rad, bound, error, right)


def _shaped(trial: Trial, k: int) -> Trial:
    """Put the frames of a place into one row."""
    return Trial(
        trial.distance_m.reshape(k, -1),
        trial.delta_rad.reshape(k, -1),
        trial.bound_m.reshape(k, -1),
        trial.error_m.reshape(k, -1),
        trial.class_right.reshape(k, -1),
    )


def _joined(trials: list[Trial]) -> Trial:
    """Put the classes side by side."""
    names = ("distance_m", "delta_rad", "bound_m", "error_m", "class_right")
    return Trial(*(np.concatenate([getattr(trial, name) for trial in trials], axis=1) for name in names))
