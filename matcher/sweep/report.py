"""The report of a sweep: one self-contained HTML page, and each figure as PNG and SVG."""

from __future__ import annotations

import io
import math
import os
import shlex
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from phasemark.data.files.atomic_write import storage_errors, write_atomically
from phasemark.data.files.folder_marker import adding_to_folder
from phasemark.data.files.provenance import versions
from phasemark.data.pages.page import embedded_png, figure_png, page_template, short_number
from phasemark.landmarks import mesh_figure, mesh_symmetry
from phasemark.matcher.accuracy.expected_accuracy import AccuracyCard, accuracy_card, sides_of
from phasemark.matcher.figures import match_figure
from phasemark.matcher.match import Match
from phasemark.matcher.statistics import Interval
from phasemark.matcher.sweep.figures.sheet import SweepFigure, sweep_figures
from phasemark.matcher.sweep.figures.style import AXIS_LABEL
from phasemark.matcher.sweep.job import Round, SweepJob
from phasemark.matcher.sweep.plan import Condition, SweepPlan
from phasemark.matcher.sweep.result_tables import Cell, SweepTrials, condition_axes, outlier_share, outliers_in_words
from phasemark.matcher.sweep.run import read_plan_of, read_sweep, write_cells
from phasemark.render import Renderer
from phasemark.render.figures import RANGE_COLOURS, draw_range, landmark_limits_m
from phasemark.render.integral.rounding import with_interval
from phasemark.render.view import delta_period_rad

_MOST_EXAMPLES = 8
_SEEN, _EXAMPLES, _AGAIN = "What the camera sees", "Typical and worst trials", "Make this page again"
VIEW_HEADER = ("D (m)", "δ (°)", "class right", "|ΔD| mm", "worst", "|Δδ| °", "worst", "position mm", "worst")
"""Columns of :func:`view_rows`."""
_ALWAYS_SAID = ("class_name", "distance_m", "delta_deg", "noise_factor", "n_frames")
_PARAMETERS = (("distance_m", "distance", " mm", 1e3), ("delta_rad", "angle", "°", 180 / math.pi))
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


def write_report(folder: str | os.PathLike[str]) -> Path:
    """Write ``report.html``, ``figures/`` and the table of cells into a sweep's folder, over those that are there.

    Parameters
    ----------
    folder : path-like
        As :func:`phasemark.matcher.run_sweep` left it.

    Returns
    -------
    Path
        The report.

    Raises
    ------
    InputFileError
        The folder holds no sweep, or a damaged one.
    OutputExistsError
        A sweep is still writing the folder, or a file of somebody else has the name of one of ours.
    """
    folder = Path(folder)
    read_plan_of(folder)
    with adding_to_folder(folder, "sweep run") as ours:
        plan, trials = read_sweep(folder)
        ours.claim("cells.csv", "sweep.json", "report.html")
        cells = write_cells(plan, trials, folder)
        with storage_errors(folder):
            (folder / "figures").mkdir(exist_ok=True)
        figures = list(sweep_figures(plan, trials, cells))
        ours.claim(*(f"figures/{figure.name}.{kind}" for figure in figures for kind in ("png", "svg")))
        shown = [_written(figure, folder / "figures") for figure in figures]
        page = _page(plan, trials, cells, folder, shown)
        return write_atomically(folder / "report.html", page.encode(), force=True)


def _page(
    plan: SweepPlan, trials: SweepTrials, cells: Sequence[Cell], folder: Path, shown: Sequence[dict[str, Any]]
) -> str:
    landmarks = [cell for cell in cells if not cell.stranger]
    job = SweepJob(plan, Round.first_of(plan))
    card = card_of(job, landmarks)
    axes = condition_axes([cell.condition for cell in cells])
    most_rows = 80
    return page_template("phasemark.matcher.sweep", "page.html.j2").render(
        plan=plan,
        answer=answer(landmarks),
        card=None if card is None else f"{answer_cells(landmarks)[0].condition.class_name} {card.line()}",
        summary=summary(trials, cells),
        contents=[_SEEN, *(one["title"] for one in shown), "Cells", _EXAMPLES, "How it was made", _AGAIN],
        gallery=_gallery(job),
        range_colours=RANGE_COLOURS,
        figures=shown,
        examples=_example_trials(job, trials, max(1, _MOST_EXAMPLES // len(trials.methods)), folder),
        header=(
            *(AXIS_LABEL[name] for name in axes), "method", "trials", "share of outliers", "RMSE of D (mm)",
            "bound on D (mm)", "RMSE / bound, D", "RMSE of δ (°)", "bound on δ (°)", "RMSE / bound, δ",
            "share of classes right", "NEES per parameter", "coverage of the 95 % ellipsoid",
        ),
        rows=[_row(cell, axes) for cell in sorted(landmarks, key=_rank, reverse=True)[:most_rows]],
        n_cells=len(landmarks),
        facts=_facts(plan, trials),
        commands=_commands(plan, folder),
    )  # fmt: skip


def _written(shown: SweepFigure, folder: Path) -> dict[str, Any]:
    """Write a figure as PNG and SVG, and return its entry on the page."""
    png, svg = figure_png(shown.figure), io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "phasemark"}):  # or the names inside would differ each time
        shown.figure.savefig(svg, format="svg", metadata={"Date": None})
    for kind, content in (("png", png), ("svg", svg.getvalue())):
        write_atomically(folder / f"{shown.name}.{kind}", content, force=True)
    readable_in = 6.5  # wider figures keep their size on a phone, to be moved about
    wide = shown.figure.get_figwidth() > readable_in
    return {"title": shown.title, "text": shown.text, "image": embedded_png(png, shown.title), "wide": wide}


def summary(trials: SweepTrials, cells: Sequence[Cell]) -> list[str]:
    """Summarise a sweep in three sentences: accuracy of each method, where it fails, and the classes it finds."""
    landmarks = [cell for cell in cells if not cell.stranger]
    of_method = {name: [cell for cell in landmarks if cell.method == name] for name in trials.methods}
    # those with the fewest outliers first
    methods = sorted(trials.methods, key=lambda name: (outlier_share(of_method[name]), _typical_ratio(of_method[name])))
    accurate = "; ".join(f"{method} {_accuracy(of_method[method])}" for method in methods)
    sentences = [
        "Outliers, and without them root mean square errors in the median cell and their ratios to the Cramér–Rao"
        f" bound: {accurate}."
    ]
    worst = []
    for method in methods:
        mine = [cell for cell in of_method[method] if _rank(cell) > (0.0, -math.inf)]
        if mine:
            cell = max(mine, key=_rank)
            what = [outliers_in_words([cell])] if outlier_share([cell]) else []
            what += [f"{_badness(cell):.3g} times the bound"] if math.isfinite(_badness(cell)) else []
            worst.append(f"for {method}, {' and '.join(what)} at {_where(cell, landmarks)}")
    if worst:
        sentences.append(f"The worst cells are, {'; '.join(worst)}.")
    classes = "; ".join(_classes(trials, m) for m in range(len(trials.methods)))
    return [*sentences, f"{classes[:1].upper()}{classes[1:]}."]


def view_rows(trials: SweepTrials, m: int) -> list[tuple[str, ...]]:
    """Return classes right, medians and worst errors of method m over all classes, one row for each D and δ."""
    error, position = trials.error[:, m], trials.position_error_of(slice(None))[:, m]
    errors = np.abs([1e3 * error[:, 0], np.degrees(error[:, 1]), 1e3 * position])
    right = trials.found[:, m] == trials.true_class
    view = np.array([(one.distance_m, one.delta_deg) for one in trials.conditions])[trials.condition]
    rows = []
    for distance, delta in dict.fromkeys(map(tuple, view.tolist())):
        own = (view == (distance, delta)).all(axis=1) & (trials.true_class >= 0)
        numbers = np.stack([np.nanmedian(errors[:, own], axis=1), np.nanmax(errors[:, own], axis=1)], axis=1)
        share = f"{right[own].sum()}/{own.sum()}"
        rows.append((f"{distance:g}", f"{delta:g}", share, *map(short_number, numbers.ravel().tolist())))
    return rows


def _accuracy(cells: Sequence[Cell]) -> str:
    parts = []
    for name, label, unit, scale in _PARAMETERS:
        rmse = [cell.rmse[name].value * scale for cell in cells if math.isfinite(cell.rmse[name].value)]
        ratio = [cell.ratio[name].value for cell in cells if math.isfinite(cell.ratio[name].value)]
        if rmse and ratio:
            parts.append(f"{np.median(rmse):.2g}{unit} in {label} ({np.median(ratio):.3g} times)")
    if not parts and not outlier_share(cells):
        return "no answer"
    return ", ".join([outliers_in_words(cells), *([" and ".join(parts)] if parts else [])])


def _typical_ratio(cells: Sequence[Cell]) -> float:
    ratios = [_badness(cell) for cell in cells if math.isfinite(_badness(cell))]
    return float(np.median(ratios)) if ratios else math.inf


def _classes(trials: SweepTrials, m: int) -> str:
    """State from the confusion matrix of method m the share of right answers, and the share refused."""
    refused, strange = trials.refused[:, m], trials.true_class < 0
    answers = ~refused & ~strange
    right = int((trials.found[answers, m] == trials.true_class[answers]).sum())
    n, silent = int((~strange).sum()), int((refused & ~strange).sum())
    text = f"{trials.methods[m]} named the right class in {right} of {int(answers.sum())} answers and refused"
    text += f" {silent} of {n} trials ({100 * silent / max(n, 1):.2g} %)"
    if strange.any():
        text += f" and {int((refused & strange).sum())} of {int(strange.sum())} strangers"
    return text


def _where(cell: Cell, cells: Sequence[Cell]) -> str:
    axes, first = condition_axes([one.condition for one in cells]), cells[0].condition
    # of what may be wrong with the model, only what is wrong here
    shown = [n for n in axes if n in _ALWAYS_SAID or getattr(cell.condition, n) != getattr(first, n)]
    return said(cell.condition, shown)


def _badness(cell: Cell) -> float:
    return max((ratio.value for ratio in cell.ratio.values() if math.isfinite(ratio.value)), default=-math.inf)


def _rank(cell: Cell) -> tuple[float, float]:
    """Return how bad a cell is: by its share of outliers, then by its errors over their bound."""
    return outlier_share([cell]), _badness(cell)


def _with_interval(one: Interval) -> str:
    return with_interval(one.value, one.low, one.high) if math.isfinite(one.value) else "–"


def _row(cell: Cell, axes: Sequence[str]) -> list[str]:
    values = [getattr(cell.condition, name) for name in axes]
    out = [f"{value:g}" if isinstance(value, int | float) else str(value) for value in values]
    out += [cell.method, str(cell.n), _with_interval(cell.outliers)]
    for name, _, _, scale in _PARAMETERS:
        out += [_with_interval(cell.rmse[name].scaled(scale)), f"{cell.bound[name] * scale:.3g}"]
        out.append(_with_interval(cell.ratio[name]))
    out += [_with_interval(one) for one in (cell.class_right, cell.nees, cell.coverage[0.95])]
    return out


def _commands(plan: SweepPlan, folder: Path) -> list[str]:
    """Return two commands: run the sweep again into a new folder, and write this page from existing trials."""
    where = shlex.quote(str(folder))
    given, again = shlex.quote(str(folder / "plan.json")), shlex.quote(f"{folder}-again")
    run = f"phasemark sweep run {given} --out {again}"
    if any(method.is_program for method in plan.methods):
        run = f"phasemark sweep run {given} --out {again} --trust-plan"
    return [run, f"phasemark sweep report {where}"]


def _gallery(job: SweepJob) -> Iterator[dict[str, Any]]:
    """Yield pictures of each object in the first of those conditions whose angle is nearest to 45°."""
    for name, shown in job.objects.items():
        own = [k for k, one in enumerate(job.all_conditions) if one.class_name == name]
        number = min(own, key=lambda k: abs(job.all_conditions[k].delta_deg - 45))
        views = job.views(number, 0, 1)
        image = job.image(number, views)
        range_m = job.frames(number, job.plan.methods[0], image, 0).range_m[0]
        near, far = landmark_limits_m(range_m, image.coverage[0])
        figure = Figure(figsize=(3.9, 3.3), layout="constrained")
        draw_range(figure.add_subplot(title=name), range_m, near_m=near, far_m=far)
        yield {
            "name": name,
            "view": f"D = {views.distance_m[0]:.3f} m, δ = {math.degrees(views.delta_rad[0]):.1f}°",
            "mesh": embedded_png(mesh_figure(shown.mesh), f"The {name}"),
            "frame": embedded_png(figure_png(figure), f"Filtered range image of the {name}"),
        }


def _facts(plan: SweepPlan, trials: SweepTrials) -> dict[str, Any]:
    seconds = trials.seconds.sum(axis=0)
    times = [f"{name} {short_number(value)} s" for name, value in zip(trials.methods, seconds.tolist(), strict=True)]
    return {
        "design": f"{plan.design}, {len(trials.conditions)} conditions, {len(trials)} trials of each method",
        "truths": f"uniform within {plan.spread[0]:g} m × {plan.spread[1]:g}° about a condition, off the banks' grids",
        "outliers": f"beyond {plan.outlier[0]:g} m or {plan.outlier[1]:g}°",
        "bound": "Cramér–Rao of the true world at each trial's view, for each method's own pixels and parameters",
        "sensor": plan.sensor,
        "time": f"{', '.join(times)}: matching, added up over the threads",
        "seed": str(plan.seed),
        "versions": ", ".join(f"{name} {version}" for name, version in versions().items()),
    }


def _example_trials(job: SweepJob, trials: SweepTrials, n: int, folder: Path) -> Iterator[dict[str, Any]]:
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
    figure = match_figure(frames, match, job.bank(job.plan.methods[m]), job.background(number), title=False)
    return {
        "title": f"{method}, {rank}: condition {number}, trial {trial}",
        "text": text,
        "image": embedded_png(figure_png(figure), text),
        "command": f"phasemark sweep frames {shlex.quote(str(folder))} {number} {trial} -o frames.npz",
    }


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
    plain = [cell for cell in cells if all(getattr(cell.condition, name) == getattr(first, name) for name in others)]
    distances = sorted({one.condition.distance_m for one in plain})
    middle = distances[len(distances) // 2]
    by_method: dict[str, list[Cell]] = {}
    for one in plain:
        if one.condition.distance_m == middle:
            by_method.setdefault(one.method, []).append(one)
    found = [own for own in by_method.values() if any(map(_found, own))]
    return min(found, key=lambda own: (outlier_share(own), _pooled_ratio(own)), default=[])


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


def _pooled_ratio(cells: Sequence[Cell]) -> float:
    """Return the larger of the ratios of distance and angle to the bound, pooled; infinite where there is no bound."""
    ratios = [_rms([one.ratio[name].value for one in cells if _found(one)]) for name in ACCURATE]
    return max(ratios) if all(map(math.isfinite, ratios)) else math.inf


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
