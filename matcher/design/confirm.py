"""Confirmation of the bound: simulated noisy frames are matched, for a design and for the catalogue.

Each set is seen at the distance of its worst bound from sides over half a period, the worst one among them; then, with
fresh frames, from the side that turned out worst (three are looked at again before it is named); and at random places
over the whole range. Frames are captured, filtered and matched by maximum likelihood against the set's own bank, so
errors are those of the whole program; the angle's error is taken modulo the box's symmetry.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark.data import BankPlan, build_bank
from phasemark.data.plans.grid_axis import parse_grid
from phasemark.data.progress import Progress, counter
from phasemark.data.seeds import stream
from phasemark.landmarks import build_mesh
from phasemark.matcher.accuracy.cramer_rao import cramer_rao
from phasemark.matcher.accuracy.trials import Trials, TrialSetup, judged, noisy_frames
from phasemark.matcher.design.plan import DesignPlan
from phasemark.matcher.design.search import Design, Scored
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.statistics import Interval, binomial_interval, rms_interval
from phasemark.render import Renderer, Sensor, Views

SIDE_STEP_DEG = 3.75
_CONTENDERS, _AGAIN, _FRESH, _ANYWHERE = 3, 4, 12, 4
"""How many of the worst sides are looked at again, and how many times `n` frames that, the worst and anywhere take."""
_BANK_STEP_M = 0.01
_FRAMES_AT_ONCE = 200


@dataclass(frozen=True, eq=False)
class Trial:
    """Filtered frames, matched; (k, n) arrays: k sides, n frames from each.

    Parameters
    ----------
    distance_m, delta_rad : (k, n) float64
        The truth.
    bound_m : (k, n) float64
        Position bound at the truth, the root of the trace of its covariance.
    error_m : float64
        Distance of the lens from where it is; NaN where no landmark was found.
    class_right : bool
        Whether the class is the true one.
    """

    distance_m: NDArray[np.float64]
    delta_rad: NDArray[np.float64]
    bound_m: NDArray[np.float64]
    error_m: NDArray[np.float64]
    class_right: NDArray[np.bool_]

    @classmethod
    def of(cls, classes: Sequence[Trials], k: int) -> Trial:
        """Put the trials of several classes side by side, the frames of each of k sides into one row."""
        columns = zip(
            *(
                (one.views.distance_m, one.views.delta_rad, one.position_bound_m, one.position_error_m, one.class_right)
                for one in classes
            ),
            strict=True,
        )
        return cls(*(np.concatenate([part.reshape(k, -1) for part in column], axis=1) for column in columns))

    @property
    def class_errors(self) -> Interval:
        """Share of frames whose class was not found."""
        return binomial_interval(int((~self.class_right).sum()), self.class_right.size)

    @property
    def missed(self) -> Interval:
        """Share of frames in which no landmark was found; they have no position error."""
        return binomial_interval(int(np.isnan(self.error_m).sum()), self.error_m.size)

    @property
    def efficiency(self) -> Interval:
        """√mean(error² / bound²), 1 at the bound."""
        return _rms(self.error_m / self.bound_m)

    def rmse(self, k: int) -> Interval:
        """Return the root mean square error at one place, metres."""
        return _rms(self.error_m[k])


def _rms(errors: NDArray[np.float64]) -> Interval:
    """Return the root mean square of errors; those without a landmark do not count."""
    return rms_interval(errors[np.isfinite(errors)], law="normal")


@dataclass(frozen=True, eq=False)
class Confirmation:
    """Results of a set of landmarks.

    Parameters
    ----------
    sides : Trial
        At the distance of the worst bound; the last of the k sides is that of the worst bound.
    worst : Trial
        Fresh frames from the one of these sides where the root mean square error is largest; k = 1.
    anywhere : Trial
        Random distances over the range, random sides; k = 1.
    """

    sides: Trial
    worst: Trial
    anywhere: Trial


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
        The set of landmarks.
    sensor : Sensor
        The camera.
    plan : DesignPlan
        Its seed, range and number of frames count.
    n : int
        Filtered frames at every side, twelve times as many at the worst one and four times as many anywhere; spread
        evenly over the classes.
    purpose : str
        Keeps the random streams of two sets apart.
    workers : int
        Threads.
    progress : callable
        Called after each class of each part.

    Returns
    -------
    Confirmation
    """
    near, far = plan.distance_m
    bank_steps = 150
    step = max(_BANK_STEP_M, (far - near) / bank_steps)
    bank_plan = BankPlan(
        landmarks=scored.specs,
        sensor=plan.sensor,
        sensor_overrides=plan.sensor_overrides,
        distance_m=tuple(parse_grid(f"{0.9 * near:.4f}:{1.1 * far:.4f}:{step:.4f}", "distance_m").tolist()),
    )
    matcher = Matcher(build_bank(bank_plan, workers=workers), method="refine", free=VIEW[:2], workers=workers)
    period = scored.specs[0].delta_period_rad
    distance, side = scored.bound.worst_view
    steps = round(math.degrees(period / 2) / SIDE_STEP_DEG)
    sides = np.append(np.linspace(0.0, period / 2, steps + 1), side)
    each = max(1, math.ceil(n / len(scored.specs)))
    renderers = {s.name: Renderer(build_mesh(s), sensor, albedo=s.albedo) for s in scored.specs}

    def tried(part: str, k: int, drawn: Callable[[np.random.Generator], Views]) -> Trial:
        setup, found = TrialSetup(n_frames=plan.n_frames), []
        for index, (name, renderer) in enumerate(renderers.items()):
            places, rng = (stream(plan.seed, f"{purpose} {part} {what}", index) for what in ("places", "frames"))
            views, parts = drawn(places), []
            for start in range(0, len(views), _FRAMES_AT_ONCE):
                some = views[start : start + _FRAMES_AT_ONCE]
                bound = cramer_rao(renderer, some, n_frames=plan.n_frames, pixels="lower", workers=workers).covariance
                matches = matcher.match(noisy_frames(renderer, sensor, some, setup, rng, workers=workers))
                parts.append(judged(matches, name, some, bound, VIEW[:2], scored.symmetry))
            found.append(Trials.joined(parts))
            progress()
        return Trial.of(found, k)

    first = tried("sides", len(sides), lambda _: Views.broadcast(distance, np.repeat(sides, each)))
    contenders = np.argsort(-_mean_square(first.error_m), kind="stable")[:_CONTENDERS]
    again = tried(
        "again", _CONTENDERS, lambda _: Views.broadcast(distance, np.repeat(sides[contenders], _AGAIN * each))
    )
    pooled = np.concatenate([first.error_m[contenders], again.error_m], axis=1)
    found = float(sides[contenders[int(_mean_square(pooled).argmax())]])
    worst = tried("worst", 1, lambda _: Views.broadcast(distance, np.full(_FRESH * each, found)))
    anywhere = tried(
        "anywhere",
        1,
        lambda rng: Views.broadcast(
            rng.uniform(near, far, _ANYWHERE * each), rng.uniform(0.0, period, _ANYWHERE * each)
        ),
    )
    return Confirmation(first, worst, anywhere)


def _mean_square(error: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean square of the finite errors of each side; 0 where nothing was found."""
    seen = np.isfinite(error)
    squares = np.where(seen, error, 0.0) ** 2
    return np.asarray(squares.sum(axis=1) / np.maximum(seen.sum(axis=1), 1))


def confirm_design(
    design: Design, n: int, *, workers: int | None = None, progress: Progress | None = None
) -> tuple[Confirmation, Confirmation]:
    """Match simulated frames of a design and of the catalogue.

    Parameters
    ----------
    design : Design
        The design.
    n : int
        Filtered frames at every side.
    workers : int, optional
        Threads; None: one for each processor.
    progress : callable (done, total), optional
        Called with the work done and the work in all.

    Returns
    -------
    (Confirmation, Confirmation)
    """
    sets = (("result", design.result), ("catalogue", design.catalogue))
    step = counter(progress, 4 * sum(len(scored.specs) for _, scored in sets))
    new, known = (
        confirm(
            scored,
            design.search.sensor,
            design.plan,
            n,
            purpose=f"design {name}",
            workers=workers or os.cpu_count() or 1,
            progress=step,
        )
        for name, scored in sets
    )
    return new, known
