"""Headline of a sweep's page: accuracy of the best method in the middle of the design, and its bound."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import fields

import numpy as np

from phasemark.landmarks import mesh_symmetry
from phasemark.matcher.accuracy.expected_accuracy import AccuracyCard, accuracy_card, sides_of
from phasemark.matcher.sweep.job import SweepJob
from phasemark.matcher.sweep.plan import Condition
from phasemark.matcher.sweep.result_tables import Cell, condition_axes, outlier_share, outliers_in_words
from phasemark.render import Renderer
from phasemark.render.view import delta_period_rad

SAID = {
    "class_name": "{}", "distance_m": "D = {:g} m", "delta_deg": "δ = {:g}°", "noise_factor": "{:g} times the noise",
    "n_frames": "{:g} frames", "bearing_deg": "a bearing of {:g}°", "height_m": "a height of {:g} m",
    "pitch_deg": "a pitch of {:g}°", "albedo": "an albedo of {:g}", "wall_m": "a wall at {:g} m",
    "roll_deg": "a roll of {:g}°", "wiggling": "wiggling of {:g}", "unit": "unit {:g}",
    "dimension_error": "dimensions off by {:g}", "floor_m": "a floor at {:g} m", "bounces": "{:g} bounces",
}  # fmt: skip
"""A condition in words, by the name of its axis."""
ACCURATE = ("distance_m", "delta_rad")
"""Parameters whose errors are told."""
_POOLED = ("class_name", "distance_m", "delta_deg")
_SAID_FIRST = (*_POOLED, "wall_m")


def answer_cells(cells: Sequence[Cell]) -> list[Cell]:
    """Return the cells that a page answers with: one method's, of all classes and angles, at one distance.

    The distance is the middle one of the design, the other axes are at their first values, and the method is the one
    with the fewest outliers there, and of several the one whose other errors are nearest to the bound. The error itself
    would favour a method that answers with grid points, which may be nearer to the truth than what the frames tell.

    Parameters
    ----------
    cells : sequence of Cell
        Of landmarks, no strangers.

    Returns
    -------
    list of Cell
        Empty if no method found distance and angle in a cell of this kind.
    """
    if not cells:
        return []
    first = cells[0].condition
    others = [field.name for field in fields(first) if field.name not in _POOLED]
    plain = [one for one in cells if all(getattr(one.condition, name) == getattr(first, name) for name in others)]
    distances = sorted({one.condition.distance_m for one in plain})
    middle = distances[len(distances) // 2]
    by_method: dict[str, list[Cell]] = {}
    for one in plain:
        if one.condition.distance_m == middle:
            by_method.setdefault(one.method, []).append(one)
    found = [own for own in by_method.values() if any(map(_found, own))]
    return min(found, key=lambda own: (outlier_share(own), _badness(own)), default=[])


def answer(cells: Sequence[Cell]) -> str:
    """State in one sentence the accuracy of the best method in the middle of the design.

    Parameters
    ----------
    cells : sequence of Cell
        Of landmarks, no strangers.
    """
    own = answer_cells(cells)
    if not own:
        return "No method found distance and angle in the middle of the design."
    condition = own[0].condition
    where = said(condition, [name for name in condition_axes([c.condition for c in cells]) if name not in _SAID_FIRST])
    wall = f", before a wall at {condition.wall_m:g} m," if condition.wall_m else ""
    trials = sum(one.n for one in own)
    right = sum(round(one.class_right.value * one.n) for one in own)
    left_out = f", {outliers_in_words(own)} left out," if outlier_share(own) else ""
    distance_m, delta_rad = (_rms([one.rmse[name].value for one in own if _found(one)]) for name in ACCURATE)
    return (
        f"At {condition.distance_m:g} m{f' ({where})' if where else ''}{wall} you get {1e3 * distance_m:.2g} mm"
        f" and {math.degrees(delta_rad):.2g}° (1 σ){left_out} with {own[0].method}; class"
        f" right {100 * right / trials:.4g} % of {trials} trials."
    )


def said(condition: Condition, axes: Iterable[str]) -> str:
    """Return some fields of a condition in words."""
    return ", ".join(SAID[name].format(getattr(condition, name)) for name in axes)


def card_of(job: SweepJob, cells: Sequence[Cell]) -> AccuracyCard | None:
    """Return the bound at the condition of :func:`answer`, from all sides, for the first class of it; None without one.

    Parameters
    ----------
    job : SweepJob
        What renders the conditions.
    cells : sequence of Cell
        Of landmarks, no strangers.
    """
    own = answer_cells(cells)
    if not own:
        return None
    number, condition = own[0].number, own[0].condition
    sensor = job.believed_sensor(number)
    period = delta_period_rad(mesh_symmetry(job.objects[condition.class_name].mesh))
    others = {
        name: Renderer(job.objects[name].mesh, sensor, albedo=job.albedo_before(number, name))
        for name in job.class_names
        if name != condition.class_name
    }
    return accuracy_card(
        job.renderer(number, sensor),
        sides_of(condition.distance_m, period),
        others=others,
        n_frames=condition.n_frames,
        background=job.background(number),
    )


def _found(cell: Cell) -> bool:
    """Return whether a method has an error of distance and of angle."""
    return all(name in cell.rmse and math.isfinite(cell.rmse[name].value) for name in ACCURATE)


def _badness(cells: Sequence[Cell]) -> float:
    """Return the larger of the ratios of distance and angle to the bound, pooled; infinite where there is no bound."""
    ratios = [_rms([one.ratio[name].value for one in cells if _found(one)]) for name in ACCURATE]
    return max(ratios) if all(map(math.isfinite, ratios)) else math.inf


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
