"""The paper's experiment: four landmarks, three distances, three angles, before a wall; on the grid and off it."""

from __future__ import annotations

import csv
import io
import math
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data import Bank, BankPlan, build_bank
from phasemark.data.files.json_text import finite_or_none
from phasemark.data.progress import Progress
from phasemark.data.seeds import stream
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.filters.kalman_filters import kalman_filter
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.match import Match, Matches
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.position.robot_pose import robot_poses
from phasemark.matcher.statistics import view_errors
from phasemark.render import Background, PhasorImages, Renderer, Views, capture
from phasemark.render.view import VIEW_FIELDS, delta_period_rad

SENSOR = "pmd-16x16"
WALL_M = 3.0
LANDMARK_XY_M = (2.0, 1.0)
LIKELIHOOD, NEAREST = "maximum likelihood", "nearest image"
"""The methods: between the bank's grid points both, on them the nearest image alone."""
SHIFT_STEPS = 0.37
"""How far, in steps of the bank, the second half of the cells lies off the grid."""


@dataclass(frozen=True)
class Cell:
    """One landmark seen from one place.

    Parameters
    ----------
    class_name : str
    distance_m, delta_rad : float
        The true view.
    shifted : bool
        Whether it lies between the bank's grid points.
    """

    class_name: str
    distance_m: float
    delta_rad: float
    shifted: bool


@dataclass(frozen=True, eq=False)
class CellResult:
    """Results of the repetitions of a cell; arrays have one entry a repetition.

    Parameters
    ----------
    cell : Cell
    method : str
        :data:`LIKELIHOOD` or :data:`NEAREST`.
    matches : Matches
    class_right : bool
    distance_error_m, delta_error_rad : float64
        Estimate less truth; the angle wrapped by the landmark's symmetry. NaN where no landmark was found.
    position_error_m : float64
        How far the robot is from where it was placed, of the symmetric solutions the one nearest to the truth.
    filtered : FilteredFrames
        The filtered frame of each repetition.
    """

    cell: Cell
    method: str
    matches: Matches
    class_right: NDArray[np.bool_]
    distance_error_m: NDArray[np.float64]
    delta_error_rad: NDArray[np.float64]
    position_error_m: NDArray[np.float64]
    filtered: FilteredFrames


@dataclass(frozen=True, eq=False)
class DemoResult:
    """The whole experiment.

    Parameters
    ----------
    cells : tuple of CellResult
        Between grid points with maximum likelihood, then with the nearest image; the nearest image on grid points last.
    bank : Bank
        Open for reading.
    background : Background
    seed, n_frames, repetitions : int
    seconds : dict of str to float
        Time spent in each stage, added up over the threads; "total" is the elapsed time.
    """

    cells: tuple[CellResult, ...]
    bank: Bank
    background: Background
    seed: int
    n_frames: int
    repetitions: int
    seconds: dict[str, float] = field(default_factory=dict)

    def select(self, *, shifted: bool, method: str = NEAREST) -> tuple[CellResult, ...]:
        """Return a method's cells on the bank's grid, or those between."""
        return tuple(r for r in self.cells if r.cell.shifted == shifted and r.method == method)

    def as_dict(self) -> dict[str, Any]:
        """Return the times and the cells as plain numbers, for JSON; None where nothing was found."""
        return {"seconds": self.seconds, "cells": [finite_or_none(row) for row in cell_rows(self.cells)]}


def run_demo(
    bank_path: str | os.PathLike[str] | None = None,
    *,
    classes: Sequence[str] = (),
    distances_m: Sequence[float] = (0.8, 1.0, 1.2),
    deltas_deg: Sequence[float] = (0.0, 45.0, 90.0),
    n_frames: int = 50,
    repetitions: int = 25,
    seed: int = 2005,
    bank_distance_m: str | None = None,
    bank_delta_deg: str | None = None,
    workers: int | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> DemoResult:
    """Run the paper's experiment on simulated frames.

    Each landmark is put before a wall at 3 m, at each distance and angle and again 0.37 of a bank step further in
    both; the camera faces it, as the paper's did. `repetitions` times `n_frames` noisy frames are captured, filtered
    and matched, and the robot is placed. The nearest image matches all of them, maximum likelihood those between grid
    points, with D and δ free. Every cell has its own random stream, so the result does not depend on the number of
    workers.

    Parameters
    ----------
    bank_path : path-like, optional
        Where to keep the bank; None: a temporary file.
    classes : sequence of str
        Names from the catalogue; empty: all.
    distances_m, deltas_deg : sequence of float
        The paper's grid.
    n_frames, repetitions : int
        Frames averaged by the filter, and how often.
    seed : int
    bank_distance_m, bank_delta_deg : str, optional
        The bank's grids, START:STOP:STEP; by default 0.7:2.1:0.01 m and 0:180:1°.
    workers : int, optional
        Threads; None: one for each processor.
    force : bool
        Whether an existing bank may be replaced.
    progress : callable (done, total), optional
        Called after each cell.

    Returns
    -------
    DemoResult

    Raises
    ------
    UsageError
        A class is unknown, or a number is out of range.
    OutputExistsError, StorageError
        The bank cannot be written.
    """
    for name, value in (("n_frames", n_frames), ("repetitions", repetitions)):
        if value < 1:
            raise UsageError(f"'{name}' must be at least 1, got {value}")
    stream(seed, "demo frames", 0)  # a wrong seed is refused before the bank is built
    started = time.perf_counter()
    fields: dict[str, Any] = {"classes": tuple(classes), "sensor": SENSOR, "delta_deg": bank_delta_deg}
    if bank_distance_m is not None:
        fields["distance_m"] = bank_distance_m
    plan = BankPlan(**fields)
    bank = build_bank(plan, bank_path, force=force, workers=workers)
    background = Background(wall_m=WALL_M)
    nearest = Matcher(bank, background=background)
    likelihood = Matcher(bank, "refine", free=VIEW_FIELDS[:2], background=background, workers=1)
    seconds = {"bank": time.perf_counter() - started, "render": 0.0, "capture": 0.0, "filter": 0.0, "match": 0.0}
    specs = catalog()
    renderers = {
        name: Renderer(build_mesh(specs[name]), bank.sensor, albedo=specs[name].albedo) for name in bank.classes
    }
    cells = _cells(bank, distances_m, np.deg2rad(deltas_deg))

    def run(index: int) -> list[CellResult]:
        cell = cells[index]
        clock = _Clock(seconds)
        image = renderers[cell.class_name].render(cell.distance_m, cell.delta_rad, background=background)
        clock.lap("render")
        frames = capture(
            _repeated(image, repetitions), bank.sensor, rng=stream(seed, "demo frames", index), n_frames=n_frames
        )
        clock.lap("capture")
        filtered = kalman_filter(frames)
        clock.lap("filter")
        methods = {LIKELIHOOD: likelihood, NEAREST: nearest} if cell.shifted else {NEAREST: nearest}
        found = [_judge(cell, name, matcher.match(filtered), filtered) for name, matcher in methods.items()]
        clock.lap("match")
        return found

    results: list[CellResult] = []
    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        for done, found in enumerate(pool.map(run, range(len(cells))), start=1):
            results += found
            if progress is not None:
                progress(done, len(cells))
    results.sort(key=lambda result: (not result.cell.shifted, result.method != LIKELIHOOD))  # stable: cells keep order
    seconds["total"] = time.perf_counter() - started
    return DemoResult(tuple(results), bank, background, seed, n_frames, repetitions, seconds)


class _Clock:
    """Adds the time since its last lap to a stage; several clocks may share the sums."""

    _lock = Lock()

    def __init__(self, seconds: dict[str, float]) -> None:
        self._seconds, self._last = seconds, time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        with self._lock:
            self._seconds[stage] += now - self._last
        self._last = now


def _cells(bank: Bank, distances_m: Sequence[float], deltas_rad: NDArray[np.float64]) -> list[Cell]:
    steps = (
        np.diff(bank.distance_m).mean() if len(bank.distance_m) > 1 else 0.0,
        np.diff(bank.delta_rad).mean() if len(bank.delta_rad) > 1 else 0.0,
    )
    return [
        Cell(name, float(d + shift * steps[0]), float(delta + shift * steps[1]), shift > 0)
        for shift in (0.0, SHIFT_STEPS)
        for name in bank.classes
        for d in distances_m
        for delta in deltas_rad
    ]


def _repeated(image: PhasorImages, n: int) -> PhasorImages:
    """Return a batch of n copies of a single image."""
    view = image.views
    return PhasorImages(
        np.repeat(image.phasor, n, axis=0),
        np.repeat(image.intensity, n, axis=0),
        np.repeat(image.coverage, n, axis=0),
        image.sensor,
        Views(*(np.repeat(getattr(view, name), n) for name in VIEW_FIELDS)),
    )


def _judge(cell: Cell, method: str, matches: Matches, filtered: FilteredFrames) -> CellResult:
    found = np.array([name is not None for name in matches.class_name])
    period = np.array([delta_period_rad(match.symmetry) for match in matches])
    error = np.where(found[:, None], view_errors(matches, cell, VIEW[:2], period), np.nan)
    return CellResult(
        cell=cell,
        method=method,
        matches=matches,
        class_right=np.array([name == cell.class_name for name in matches.class_name]),
        distance_error_m=error[:, 0],
        delta_error_rad=error[:, 1],
        position_error_m=np.array([_position_error_m(cell, match) for match in matches]),
        filtered=filtered,
    )


def _position_error_m(cell: Cell, match: Match) -> float:
    if match.class_name is None:
        return math.nan
    x = LANDMARK_XY_M[0] + cell.distance_m * math.cos(math.pi + cell.delta_rad)
    y = LANDMARK_XY_M[1] + cell.distance_m * math.sin(math.pi + cell.delta_rad)
    return min(math.hypot(pose.x_m - x, pose.y_m - y) for pose in robot_poses(match, LANDMARK_XY_M))


CELL_COLUMNS = (
    "class", "shifted", "method", "distance_m", "delta_deg", "trials", "class_right", "accepted",
    "median_abs_distance_error_mm", "worst_abs_distance_error_mm",
    "median_abs_delta_error_deg", "worst_abs_delta_error_deg",
    "median_position_error_mm", "worst_position_error_mm",
)  # fmt: skip


def cell_rows(results: Sequence[CellResult]) -> list[dict[str, str | int | float]]:
    """Return one row a cell, keyed by :data:`CELL_COLUMNS`; NaN where nothing was found."""
    rows = []
    for result in results:
        numbers = [
            statistic(np.abs(errors) * scale)
            for errors, scale in (
                (result.distance_error_m, 1e3),
                (np.degrees(result.delta_error_rad), 1.0),
                (result.position_error_m, 1e3),
            )
            for statistic in (_median, _worst)
        ]
        values: tuple[str | int | float, ...] = (
            result.cell.class_name,
            int(result.cell.shifted),
            result.method,
            round(result.cell.distance_m, 6),
            round(math.degrees(result.cell.delta_rad), 6),
            len(result.matches),
            int(result.class_right.sum()),
            int(result.matches.accepted.sum()),
            *(round(number, 4) for number in numbers),
        )
        rows.append(dict(zip(CELL_COLUMNS, values, strict=True)))
    return rows


def _median(values: NDArray[np.float64]) -> float:
    return float(np.median(values[np.isfinite(values)])) if np.isfinite(values).any() else math.nan


def _worst(values: NDArray[np.float64]) -> float:
    return float(np.max(values[np.isfinite(values)])) if np.isfinite(values).any() else math.nan


def cells_csv(results: Sequence[CellResult]) -> str:
    """Return the table of cells as CSV."""
    return _csv(CELL_COLUMNS, [list(row.values()) for row in cell_rows(results)])


def trials_csv(results: Sequence[CellResult]) -> str:
    """Return the table of trials as CSV: truth, estimate and the test of the fit."""
    header = (
        "class", "shifted", "method", "distance_m", "delta_deg", "repetition",
        "found_class", "found_distance_m", "found_delta_deg", "accepted", "chi2", "dof", "p_value", "position_error_mm",
    )  # fmt: skip
    rows = [
        [
            result.cell.class_name,
            int(result.cell.shifted),
            result.method,
            round(result.cell.distance_m, 6),
            round(math.degrees(result.cell.delta_rad), 6),
            k,
            match.class_name or "none",
            round(match.distance_m, 6),
            round(math.degrees(match.delta_rad), 6),
            int(match.accepted),
            round(match.chi2, 4),
            match.dof,
            f"{match.p_value:.4g}",
            round(1e3 * float(result.position_error_m[k]), 4),
        ]
        for result in results
        for k, match in enumerate(result.matches)
    ]
    return _csv(header, rows)


def _csv(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return buffer.getvalue()
