"""The report of a sweep: one self-contained HTML page, and each figure as PNG and SVG."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from phasemark.data import versions, write_atomically
from phasemark.data.page import embedded_png, figure_png, page_template
from phasemark.matcher.bounds import Estimate
from phasemark.matcher.sweep import read_sweep, write_tables
from phasemark.matcher.sweep_figures import sweep_figures
from phasemark.matcher.sweep_plan import SweepPlan
from phasemark.matcher.sweep_tables import Cell, SweepTrials, condition_axes

_MOST_ROWS = 80
_MOST_WORST = 12


def write_report(folder: str | os.PathLike[str]) -> Path:
    """Write ``report.html`` and ``figures/`` of a sweep into its folder, over those that are there.

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
    """
    folder = Path(folder)
    plan, trials = read_sweep(folder)
    cells = write_tables(plan, trials, folder)
    (folder / "figures").mkdir(exist_ok=True)
    shown = []
    for figure in sweep_figures(trials, cells):
        png, svg = figure_png(figure.figure), io.BytesIO()
        with matplotlib.rc_context({"svg.hashsalt": "phasemark"}):  # or the names inside would differ each time
            figure.figure.savefig(svg, format="svg", metadata={"Date": None})
        write_atomically(folder / "figures" / f"{figure.name}.png", png, force=True)
        write_atomically(folder / "figures" / f"{figure.name}.svg", svg.getvalue(), force=True)
        shown.append({"title": figure.title, "text": figure.text, "image": embedded_png(png, figure.title)})
    axes = condition_axes([cell.condition for cell in cells])
    page = page_template("phasemark.matcher", "sweep.html.j2").render(
        plan=plan,
        summary=summary(cells),
        figures=shown,
        header=(*axes, "method", "n", "D RMSE (mm)", "bound", "ratio", "δ RMSE (°)", "bound", "ratio", "outliers",
                "class right", "NEES/p", "95 % coverage"),
        rows=[_row(cell, axes) for cell in _worst_first(cells)[:_MOST_ROWS]],
        n_cells=len(cells),
        worst=_worst_trials(trials),
        facts=_facts(plan, trials),
    )  # fmt: skip
    return write_atomically(folder / "report.html", page.encode(), force=True)


def summary(cells: Sequence[Cell]) -> list[str]:
    """Say in a sentence for each method what was found."""
    sentences = []
    for method in dict.fromkeys(cell.method for cell in cells):
        mine = [cell for cell in cells if cell.method == method]
        n = sum(cell.n for cell in mine)
        right = sum(round(cell.class_right.value * cell.n) for cell in mine)
        parts = []
        for name, label, unit, scale in (("distance_m", "distance", " mm", 1e3), ("delta_rad", "angle", "°", 57.29578)):
            rmse = [cell.rmse[name].value * scale for cell in mine if math.isfinite(cell.rmse[name].value)]
            ratio = [cell.ratio[name].value for cell in mine if math.isfinite(cell.ratio[name].value)]
            if rmse and ratio:
                parts.append(
                    f"{np.median(rmse):.2g}{unit} in {label} (cells from {min(rmse):.2g} to {max(rmse):.2g}), "
                    f"{np.median(ratio):.2f} times the Cramér–Rao bound"
                )
        outliers = sum(cell.outliers.value * cell.answered.value * cell.n for cell in mine if cell.answered.value)
        sentences.append(
            f"{method}: in the median cell the root mean square error is {' and '.join(parts) or 'not known'}; the "
            f"class was right in {right} of {n} trials, and {round(outliers)} answers were outliers."
        )
    return sentences


def _with_interval(value: Estimate, scale: float = 1.0) -> str:
    if not math.isfinite(value.value):
        return "–"
    return f"{value.value * scale:.3g} [{value.low * scale:.3g}, {value.high * scale:.3g}]"


def _worst_first(cells: Sequence[Cell]) -> list[Cell]:
    def badness(cell: Cell) -> float:
        return -max((r.value for r in cell.ratio.values() if math.isfinite(r.value)), default=math.inf)

    return sorted(cells, key=badness)


def _row(cell: Cell, axes: Sequence[str]) -> list[str]:
    values = [getattr(cell.condition, name) for name in axes]
    out = [f"{value:g}" if isinstance(value, int | float) else str(value) for value in values]
    out += [cell.method, str(cell.n)]
    for name, scale in (("distance_m", 1e3), ("delta_rad", 180 / math.pi)):
        out += [_with_interval(cell.rmse[name], scale), f"{cell.bound[name] * scale:.3g}"]
        out.append(_with_interval(cell.ratio[name]))
    out += [_with_interval(one) for one in (cell.outliers, cell.class_right, cell.nees, cell.coverage[0.95])]
    return out


def _worst_trials(trials: SweepTrials) -> list[list[str]]:
    error = trials.error
    rows = []
    for m, method in enumerate(trials.methods):
        with np.errstate(invalid="ignore"):
            scaled = np.abs(error[:, m, :2]) / np.array([1e-3, math.radians(0.1)])
        badness = np.where(np.isfinite(scaled).all(axis=1), scaled.max(axis=1), np.inf)
        for k in np.argsort(-badness, kind="stable")[: _MOST_WORST // len(trials.methods) + 1]:
            found = trials.found[k, m]
            rows.append(
                [
                    method, str(trials.condition[k]), str(trials.trial[k]), trials.classes[trials.true_class[k]],
                    "none" if found < 0 else trials.classes[found], f"{trials.truth[k, 0]:.4f}",
                    f"{1e3 * error[k, m, 0]:.3g}", f"{math.degrees(trials.truth[k, 1]):.2f}",
                    f"{math.degrees(error[k, m, 1]):.3g}", f"{trials.p_value[k, m]:.2g}",
                ]
            )  # fmt: skip
    return rows


def _facts(plan: SweepPlan, trials: SweepTrials) -> dict[str, Any]:
    return {
        "design": f"{plan.design}, {len(trials.conditions)} conditions, {len(trials)} trials of each method",
        "truths": f"uniform within {plan.spread[0]:g} m × {plan.spread[1]:g}° about a condition, off the banks' grids",
        "outliers": f"beyond {plan.outlier[0]:g} m or {plan.outlier[1]:g}°",
        "bound": "Cramér–Rao of the true world at each trial's view, for each method's own pixels and parameters",
        "sensor": plan.sensor,
        "seed": str(plan.seed),
        "versions": ", ".join(f"{name} {version}" for name, version in versions().items()),
    }
