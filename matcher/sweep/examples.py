"""Single trials of a sweep, taken again from its plan: their frames, and pictures of some."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from phasemark import UsageError
from phasemark.data.pages.page import embedded_png, figure_png
from phasemark.matcher.match import Match
from phasemark.matcher.sweep.job import Round, SweepJob
from phasemark.matcher.sweep.result_tables import SweepTrials
from phasemark.matcher.sweep.run import read_plan_of
from phasemark.render import Frames


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
    most = (plan.until_percent is not None and plan.max_trials) or plan.trials
    if not 0 <= trial < most:
        raise UsageError(f"{folder}: has trials 0 … {most - 1} of a condition, got {trial}")
    job = SweepJob(plan, Round.first_of(plan))
    return job.raw_frames(condition, job.image(condition, job.views(condition, trial, trial + 1)), trial)


def example_trials(job: SweepJob, trials: SweepTrials, n: int, folder: Path) -> Iterator[dict[str, Any]]:
    """Yield entries of a page for each method: a trial of median error over its bound, and its n worst conditions."""
    error = trials.error
    sigma = 1e-9  # errors in units of a bound that is unknown come before all others
    for m in range(len(trials.methods)):
        with np.errstate(invalid="ignore"):
            std = np.sqrt(np.einsum("npp->np", trials.bound[:, m]))[:, :2]
            scaled = np.abs(error[:, m, :2]) / np.where(std > sigma, std, sigma)
        badness = np.where(np.isfinite(scaled).all(axis=1), scaled.max(axis=1), np.inf)
        ranked = [int(k) for k in np.argsort(-badness, kind="stable") if trials.true_class[k] >= 0]
        if ranked:
            yield _example(job, trials, m, ranked[len(ranked) // 2], "typical", folder)
        worst: dict[int, int] = {}
        for k in ranked:
            worst.setdefault(int(trials.condition[k]), k)
        for k in list(worst.values())[:n]:
            yield _example(job, trials, m, k, "among the worst", folder)


def _example(job: SweepJob, trials: SweepTrials, m: int, k: int, rank: str, folder: Path) -> dict[str, Any]:
    from phasemark.matcher.figures import match_figure  # matplotlib is slow to import

    number, trial, method = int(trials.condition[k]), int(trials.trial[k]), trials.methods[m]
    image = job.image(number, job.views(number, trial, trial + 1))
    frames = job.frames(number, job.plan.methods[m], image, trial)
    found, covariance = int(trials.found[k, m]), trials.covariance[k, m]
    truth, error, p_value = trials.truth[k], trials.error[k, m], trials.p_value[k, m]
    shown = trials.conditions[number].class_name
    text = f"{shown} at D = {truth[0]:.4f} m, δ = {math.degrees(truth[1]):.2f}°; {method} found "
    view: dict[str, Any] = {"class_name": None}
    if found < 0:
        text += "no landmark"
    else:
        view = dict(zip(trials.numbers, trials.estimate[k, m].tolist(), strict=True))
        view |= {"class_name": trials.classes[found], "symmetry": trials.symmetry[found]}
        errors = f"{1e3 * error[0]:+.2f} mm and {math.degrees(error[1]):+.2f}°".replace("-", "−")
        text += f"{trials.classes[found]}, error {errors}"
        text += f", p = {p_value:.2g}" if math.isfinite(p_value) else ""
    match = Match(
        accepted=bool(trials.accepted[k, m]),
        covariance=covariance if np.isfinite(covariance[:2, :2]).all() else None,
        **view,
    )
    figure = match_figure(frames, match, job.bank(m), job.background(number), title=False)
    return {
        "title": f"{method}, {rank}: condition {number}, trial {trial}",
        "text": text,
        "image": embedded_png(figure_png(figure), text),
        "command": f"phasemark sweep frames {shlex.quote(str(folder))} {number} {trial} -o frames.npz",
    }
