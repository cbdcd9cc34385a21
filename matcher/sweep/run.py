"""Accuracy sweeps: run a plan round by round, keep what is done, and write its tables."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError, OutputExistsError, UsageError
from phasemark.data.files.atomic_write import write_atomically
from phasemark.data.files.folder_marker import OwnedFiles, adding_to_folder
from phasemark.data.files.hdf5_reading import check_format, open_hdf5, reading
from phasemark.data.files.json_text import json_text
from phasemark.data.files.provenance import versions
from phasemark.data.files.same_file import named_files, refuse_inputs
from phasemark.data.progress import Progress
from phasemark.data.shards.build import difference
from phasemark.data.shards.remote import check_scheduler
from phasemark.data.shards.run import outputs_of, produce
from phasemark.inputs.own_program import imported_program
from phasemark.matcher.sweep.job import FORMAT, SCHEMA_VERSION, STORED, Round, SweepJob
from phasemark.matcher.sweep.plan import SweepPlan, stored_plan
from phasemark.matcher.sweep.result_tables import Cell, SweepTrials, csv_bytes, trials_csv
from phasemark.render import Frames

TRIALS_AT_ONCE = 50
"""Trials of a shard: of one batch of a method, whatever the number of workers, so that no rounding depends on it."""
_PLAN = "plan.json"
_TABLES = ("trials.csv", "cells.csv", "sweep.json", "report.html")


def run_sweep(
    plan: SweepPlan,
    folder: str | os.PathLike[str],
    *,
    workers: int | None = None,
    scheduler: str = "threads",
    resume: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> SweepTrials:
    """Run a sweep and write its tables; the numbers depend on the plan alone, but for the times.

    Parameters
    ----------
    plan : SweepPlan
        Plan of the sweep.
    folder : path-like
        Gets ``plan.json``, ``trials-000.h5`` (a file for each round), ``trials.csv``, ``cells.csv``, ``sweep.json``.
    workers : int, optional
        Threads; None: one for each processor.
    scheduler : str
        ``threads``, or the address of a Dask scheduler.
    resume : bool
        Whether to go on with what the folder holds, if it is of the same plan.
    force : bool
        Whether to throw away what the folder holds of another sweep: the files that its marker lists, and no others.
    progress : callable (done, total), optional
        Trials of the current round.

    Returns
    -------
    SweepTrials

    Raises
    ------
    UsageError
        The plan cannot be run, or a method failed: with the condition and the trials. What was finished is kept.
    OutputExistsError
        The folder holds a sweep already, or of another plan; another run is writing it; or it holds a file of somebody
        else where one of the sweep's would be, which stays with `force` too.
    StorageError
        The disk is full or fails.
    """
    if not isinstance(plan, SweepPlan):
        raise UsageError(f"'plan' must be a SweepPlan, got {type(plan).__name__}")
    plan = plan.resolve()
    for method in plan.methods:
        if method.is_program:
            imported_program(method.method, "the matcher")
    check_scheduler(scheduler)
    SweepJob(plan, Round.first_of(plan)).check_views()
    folder = Path(folder)
    refuse_inputs(sweep_outputs(folder), named_files(plan.model_dump()))
    with adding_to_folder(folder, "sweep run") as ours:
        _begin(plan, ours, resume=resume, force=force)
        rounds: list[Round] = []
        following: Round | None = Round.first_of(plan)
        while following is not None:
            path = _round_path(folder, following.number)
            ours.claim(*(output.name for output in outputs_of(path)))
            produce(
                SweepJob(plan, following), path, finished=_identity, resume=True, workers=workers,
                shard_items=TRIALS_AT_ONCE, scheduler=scheduler, progress=progress,
            )  # fmt: skip
            rounds.append(following)
            trials = _read(plan, folder, len(rounds))
            following = _next_round(plan, trials, rounds)
        write_atomically(folder / "trials.csv", trials_csv(trials), force=True)
        write_cells(plan, trials, folder)
    return trials


def sweep_outputs(folder: Path) -> tuple[Path, ...]:
    """Return the files that a sweep writes into its folder, without later rounds and figures."""
    return (*map(folder.joinpath, (_PLAN, *_TABLES)), *outputs_of(_round_path(folder, 0)))


def read_plan_of(folder: str | os.PathLike[str]) -> SweepPlan:
    """Read the plan of a sweep.

    Raises
    ------
    InputFileError
        There is no sweep.
    """
    path = Path(folder) / _PLAN
    if not os.path.lexists(path):
        raise InputFileError(f"{folder}: holds no sweep: 'phasemark sweep run' makes one")
    return stored_plan(path)


def read_sweep(folder: str | os.PathLike[str]) -> tuple[SweepPlan, SweepTrials]:
    """Read the trials of a finished sweep, or as many rounds of it as are finished.

    Parameters
    ----------
    folder : path-like
        Folder of a sweep.

    Returns
    -------
    plan : SweepPlan
    trials : SweepTrials

    Raises
    ------
    InputFileError
        There is no sweep, or a file of it is damaged.
    """
    folder = Path(folder)
    plan = read_plan_of(folder)
    n = 0
    while _round_path(folder, n).is_file():
        n += 1
    if n == 0:
        raise InputFileError(f"{folder}: its sweep is not finished: run_sweep(resume=True) goes on")
    return plan, _read(plan, folder, n)


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
    first = Round.first_of(plan)
    if SweepJob(plan, first).is_stranger(condition):
        most = min(plan.stranger_trials, first.trials)
    if not 0 <= trial < most:
        raise UsageError(f"{folder}: has trials 0 … {most - 1} of a condition, got {trial}")
    job = SweepJob(plan, first)
    return job.raw_frames(condition, job.image(condition, job.views(condition, trial, trial + 1)), trial)


def write_cells(plan: SweepPlan, trials: SweepTrials, folder: Path) -> tuple[Cell, ...]:
    """Write cells.csv and sweep.json, and return the cells."""
    cells = trials.cells()
    rows = [cell.row() for cell in cells]
    write_atomically(
        folder / "cells.csv", csv_bytes({name: [row[name] for row in rows] for name in rows[0]}), force=True
    )
    table = {"plan": plan.model_dump(mode="json"), "versions": versions(), "cells": [cell.as_dict() for cell in cells]}
    text = json_text(table, indent=1, allow_nan=False)
    write_atomically(folder / "sweep.json", text.encode(), force=True)
    return cells


def _round_path(folder: Path, number: int) -> Path:
    return folder / f"trials-{number:03d}.h5"


def _begin(plan: SweepPlan, ours: OwnedFiles, *, resume: bool, force: bool) -> None:
    """Make the folder a sweep's, or see that it is this one's."""
    folder = ours.folder
    if force:
        ours.clear()
    begun = _PLAN in ours.names and os.path.lexists(folder / _PLAN)
    if begun:
        old = read_plan_of(folder)
        if not resume:
            raise OutputExistsError(f"{folder}: holds a sweep: resume=True goes on with it, force=True starts over")
        changes = difference(old.model_dump(mode="json"), plan.model_dump(mode="json"))
        if changes:
            raise OutputExistsError(
                f"{folder}: was begun with another plan ({'; '.join(changes[:4])}): force=True starts over"
            )
    ours.claim(*(path.name for path in sweep_outputs(folder)))
    if not begun:
        write_atomically(folder / _PLAN, json_text(plan, indent=1).encode(), force=True)


def _identity(path: Path) -> dict[str, Any]:
    with open_hdf5(path, "sweep", untrusted=True) as file, reading(path):
        check_format(file, path, "sweep", FORMAT, SCHEMA_VERSION)
        found: dict[str, Any] = json.loads(file.attrs["identity"])
        return found


def _next_round(plan: SweepPlan, trials: SweepTrials, rounds: list[Round]) -> Round | None:
    """Return another round for the conditions in which a method's RMSE is not known well enough."""
    done = sum(one.trials for one in rounds)
    most = plan.max_trials or plan.trials
    if plan.until_percent is None or done >= most:
        return None
    allowed = math.log1p(plan.until_percent / 100)
    open_ = {
        cell.number
        for cell in trials.cells()
        if not cell.stranger
        for rmse in cell.rmse.values()
        if not (rmse.value == 0 or (rmse.low > 0 and math.log(rmse.high / rmse.value) <= allowed))
    }
    wanted = tuple(number for number in rounds[-1].conditions if number in open_)
    return Round(len(rounds), wanted, done, min(plan.trials, most - done)) if wanted else None


def _read(plan: SweepPlan, folder: Path, n_rounds: int) -> SweepTrials:
    parts: dict[str, list[Any]] = {}
    for number in range(n_rounds):
        path = _round_path(folder, number)
        with open_hdf5(path, "sweep", untrusted=True) as file, reading(path):
            check_format(file, path, "sweep", FORMAT, SCHEMA_VERSION)
            for name in STORED:
                parts.setdefault(name, []).append(file[name][...])
    # one round is most of the memory, and is not copied
    arrays: dict[str, NDArray[Any]] = {
        name: np.concatenate(parts.pop(name)) if n_rounds > 1 else parts.pop(name)[0] for name in STORED
    }
    if n_rounds > 1:  # alone it is in order
        order = np.lexsort((arrays["trial"], arrays["condition"]))
        arrays = {name: values[order] for name, values in arrays.items()}
    for name, values in arrays.items():
        if values.dtype.kind in "iu":
            arrays[name] = values.astype(np.bool_ if name == "accepted" else np.int64)
    return SweepTrials(
        conditions=plan.conditions(),
        methods=tuple(method.name for method in plan.methods),
        free=tuple(method.parameters for method in plan.methods),
        classes=plan.class_names,
        symmetry=tuple(part.symmetry or 1 for part in plan.parts()),
        outlier=plan.outlier,
        **arrays,
    )
