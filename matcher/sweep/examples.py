"""Single trials of a sweep, taken again from its plan: their frames, and pictures of some."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from phasemark import UsageError
from phasemark.matcher.match import Match
from phasemark.matcher.sweep.job import Round, SweepJob
from phasemark.matcher.sweep.plan import SweepPlan
from phasemark.matcher.sweep.result_tables import SweepTrials
from phasemark.matcher.sweep.run import read_plan_of
from phasemark.render import Background, Frames

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SIGMA = 1e-9
"""Errors in units of a bound that is unknown come before all others."""


@dataclass(frozen=True, eq=False)
class Example:
    """One trial of one method.

    Parameters
    ----------
    method, rank : str
        Name of the method, and "typical" or "among the worst".
    condition, trial : int
    text : str
        What was shown, what was found, and how far it is from the truth.
    figure : Figure
        Measured, best model image, difference.
    """

    method: str
    rank: str
    condition: int
    trial: int
    text: str
    figure: Figure


def sweep_frames(folder: str | os.PathLike[str], condition: int, trial: int) -> Frames:
    """Take the frames of one trial of a sweep again, bit for bit.

    Parameters
    ----------
    folder : path-like
        As :func:`phasemark.matcher.run_sweep` left it.
    condition, trial : int
        As in its trials.csv.

    Returns
    -------
    Frames
        (1, n_frames, rows, cols).

    Raises
    ------
    InputFileError
        The folder holds no sweep.
    UsageError
        The sweep has no such trial.
    """
    plan = read_plan_of(folder)
    n = len(plan.conditions())
    if not 0 <= condition < n:
        raise UsageError(f"{folder}: has conditions 0 … {n - 1}, got {condition}")
    most = plan.max_trials if plan.until_percent is not None else plan.trials
    if not 0 <= trial < (most or plan.trials):
        raise UsageError(f"{folder}: has trials 0 … {(most or plan.trials) - 1} of a condition, got {trial}")
    job = job_of_plan(plan)
    return job.raw_frames(condition, job.image(condition, job.views(condition, trial, trial + 1)), trial)


def example_trials(job: SweepJob, trials: SweepTrials, n: int) -> Iterator[Example]:
    """Yield pictures of trials of each method: of median error over its bound, and the n worst, one of a condition."""
    error = trials.error
    for m in range(len(trials.methods)):
        with np.errstate(invalid="ignore"):
            std = np.sqrt(np.einsum("npp->np", trials.bound[:, m]))[:, :2]
            scaled = np.abs(error[:, m, :2]) / np.where(std > _SIGMA, std, _SIGMA)
        badness = np.where(np.isfinite(scaled).all(axis=1), scaled.max(axis=1), np.inf)
        ranked = [int(k) for k in np.argsort(-badness, kind="stable") if trials.true_class[k] >= 0]
        if ranked:
            yield _example(job, trials, m, ranked[len(ranked) // 2], "typical")
        worst: dict[int, int] = {}
        for k in ranked:
            worst.setdefault(int(trials.condition[k]), k)
        for k in list(worst.values())[:n]:
            yield _example(job, trials, m, k, "among the worst")


def job_of_plan(plan: SweepPlan) -> SweepJob:
    """Return the first round of a sweep, which renders what its conditions show."""
    return SweepJob(plan, Round(0, tuple(range(len(plan.conditions()))), 0, plan.trials))


def _example(job: SweepJob, trials: SweepTrials, m: int, k: int, rank: str) -> Example:
    from phasemark.matcher.figures import match_figure  # matplotlib is slow to import

    number, trial, method = int(trials.condition[k]), int(trials.trial[k]), trials.methods[m]
    condition = trials.conditions[number]
    image = job.image(number, job.views(number, trial, trial + 1))
    frames = job.frames(number, job.plan.methods[m], image, trial)
    found = int(trials.found[k, m])
    covariance = trials.covariance[k, m]
    name = None if found < 0 else trials.classes[found]
    match = Match(
        class_name=name,
        accepted=bool(trials.accepted[k, m]),
        **dict(zip(trials.numbers, trials.estimate[k, m].tolist(), strict=True)) if name else {},
        covariance=covariance if np.isfinite(covariance[:2, :2]).all() else None,
        symmetry=trials.symmetry[found] if found >= 0 else 1,
    )
    background = Background(wall_m=condition.wall_m) if condition.wall_m else None
    truth, error = trials.truth[k], trials.error[k, m]
    text = f"{condition.class_name} at D = {truth[0]:.4f} m, δ = {math.degrees(truth[1]):.2f}°; {method} found "
    if name is None:
        text += "no landmark"
    else:
        errors = f"{1e3 * error[0]:+.2f} mm and {math.degrees(error[1]):+.2f}°".replace("-", "−")
        text += f"{name}, error {errors}"
        text += f", p = {trials.p_value[k, m]:.2g}" if math.isfinite(trials.p_value[k, m]) else ""
    figure = match_figure(frames, match, job.bank(m), background, title=False)
    return Example(method, rank, number, trial, text, figure)
