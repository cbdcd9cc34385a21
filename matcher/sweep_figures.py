"""Figures of a sweep: errors beside their bound, maps, honesty of covariances, classes.

Colours differ for the colour-blind, and marks and strokes differ without colour; every axis has its unit, every share,
mean and root mean square its 95 % interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from phasemark.matcher.bounds import Estimate, nees
from phasemark.matcher.models import VIEW
from phasemark.matcher.sweep_tables import LEVELS, Cell, SweepTrials, condition_axes

STYLES = (
    ("#0072B2", "o", "-"), ("#D55E00", "s", "--"), ("#009E73", "^", ":"), ("#CC79A7", "D", "-."),
    ("#56B4E9", "v", "-"), ("#E69F00", "P", "--"),
)  # fmt: skip
_SHOWN = {"distance_m": ("distance", "mm", 1e3), "delta_rad": ("angle δ", "°", 180 / math.pi)}
_AXIS_LABEL = {
    "distance_m": "distance D (m)", "delta_deg": "angle δ (°)", "noise_factor": "noise, relative to the sensor's",
    "n_frames": "frames averaged", "bearing_deg": "bearing (°)", "height_m": "height (m)", "pitch_deg": "pitch (°)",
    "albedo": "albedo", "wall_m": "wall (m)", "wiggling": "wiggling", "unit": "unit",
    "dimension_error": "error of the dimensions",
}  # fmt: skip
_LOGARITHMIC = ("distance_m", "noise_factor", "n_frames", "albedo")
_MOST_POINTS = 5000


@dataclass(frozen=True)
class SweepFigure:
    """A figure with what it shows in words.

    Parameters
    ----------
    name : str
        Of its files.
    title, text : str
    figure : Figure
    """

    name: str
    title: str
    text: str
    figure: Figure


def sweep_figures(trials: SweepTrials, cells: Sequence[Cell]) -> list[SweepFigure]:
    """Return the figures that the sweep's axes and methods allow."""
    figures = []
    axes = [name for name in condition_axes([cell.condition for cell in cells]) if name != "class_name"]
    for axis in axes:
        figures.append(
            SweepFigure(
                f"rmse-{axis.replace('_', '-')}",
                f"RMSE and bound against {_AXIS_LABEL[axis]}",
                "Marks: root mean square error with its 95 % interval, outliers left out, pooled over what else varies "
                "(the median cell). Thin line: the Cramér–Rao bound of the same cells.",
                _against(cells, axis, axes),
            )
        )
    if {"distance_m", "delta_deg"} <= set(axes):
        for quantity, text in (("ratio", "Error over bound: 1 is the best possible."), ("rmse", "Absolute error.")):
            figures.append(
                SweepFigure(
                    f"map-{quantity}", f"Map of the {quantity} over distance and angle",
                    f"{text} The median over what else varies.", _map(cells, quantity),
                )
            )  # fmt: skip
    if any(cell.coverage[0.95].value == cell.coverage[0.95].value for cell in cells):
        figures.append(
            SweepFigure(
                "nees", "Quantiles of the NEES against χ²",
                "On the diagonal the method's covariance is honest; above it, too small.", _nees_quantiles(trials),
            )
        )  # fmt: skip
        figures.append(
            SweepFigure(
                "coverage", "Coverage of the methods' ellipsoids",
                "Share of errors within the ellipsoid of a probability, cell by cell, and its target.",
                _coverage(cells),
            )
        )  # fmt: skip
    figures.append(
        SweepFigure(
            "confusion", "Classes found", "Share of a class's trials in which each class was found, by method.",
            _confusion(trials),
        )
    )  # fmt: skip
    figures.append(
        SweepFigure(
            "risk", "Risk against coverage",
            "Root mean square error in distance of the trials kept, if only those with the best p-values are kept.",
            _risk(trials),
        )
    )  # fmt: skip
    return figures


def _style(k: int) -> tuple[str, str, str]:
    return STYLES[k % len(STYLES)]


def _methods(cells: Sequence[Cell]) -> list[str]:
    return list(dict.fromkeys(cell.method for cell in cells))


def _figure(n: int, width: float = 5.4, height: float = 4.0) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width * n, height), layout="constrained")
    return figure, list(np.atleast_1d(figure.subplots(1, n)))


def _median(values: Sequence[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return float(np.median(finite)) if finite else math.nan


def _against(cells: Sequence[Cell], axis: str, axes: Sequence[str]) -> Figure:
    figure, panels = _figure(2)
    base = {name: getattr(cells[0].condition, name) for name in axes}
    alone = len({tuple(getattr(c.condition, a) for a in axes) for c in cells}) < math.prod(
        len({getattr(c.condition, a) for c in cells}) for a in axes
    )
    for panel, (parameter, (label, unit, scale)) in zip(panels, _SHOWN.items(), strict=True):
        for k, method in enumerate(_methods(cells)):
            colour, mark, stroke = _style(k)
            groups: dict[float, list[Cell]] = {}
            for cell in cells:
                others = (getattr(cell.condition, a) == base[a] for a in axes if a != axis)
                if cell.method == method and (not alone or all(others)):
                    groups.setdefault(getattr(cell.condition, axis), []).append(cell)
            x = sorted(groups)
            middle, low, high, bound = (
                [_median([get(cell) for cell in groups[value]]) * scale for value in x]
                for get in _rmse_getters(parameter)
            )
            panel.errorbar(
                x, middle, [np.subtract(middle, low), np.subtract(high, middle)], color=colour, marker=mark,
                linestyle=stroke, markersize=4, capsize=2, linewidth=1, label=method,
            )  # fmt: skip
            panel.plot(x, bound, color=colour, linewidth=0.8, linestyle=(0, (1, 1)), label=f"bound, {method}")
        if axis in _LOGARITHMIC:
            panel.set_xscale("log")
            panel.set_xticks(x, [f"{value:g}" for value in x])
            panel.minorticks_off()
        panel.set_yscale("log")
        panel.set_xlabel(_AXIS_LABEL[axis])
        panel.set_ylabel(f"RMSE of {label} ({unit})")
        panel.grid(which="both", linewidth=0.3)
    panels[0].legend(fontsize=7)
    return figure


def _rmse_getters(parameter: str) -> tuple[Callable[[Cell], float], ...]:
    return (
        lambda cell: cell.rmse[parameter].value,
        lambda cell: cell.rmse[parameter].low,
        lambda cell: cell.rmse[parameter].high,
        lambda cell: cell.bound[parameter],
    )


def _map(cells: Sequence[Cell], quantity: str) -> Figure:
    methods = _methods(cells)
    figure = Figure(figsize=(5.2 * 2, 3.6 * len(methods)), layout="constrained")
    panels = figure.subplots(len(methods), 2, squeeze=False)
    x = sorted({cell.condition.delta_deg for cell in cells})
    y = sorted({cell.condition.distance_m for cell in cells})
    for row, method in zip(panels, methods, strict=True):
        for panel, (parameter, (label, unit, scale)) in zip(row, _SHOWN.items(), strict=True):
            factor = 1.0 if quantity == "ratio" else scale
            table = np.array([[_map_value(cells, method, quantity, parameter, d, a) * factor for a in x] for d in y])
            shown = panel.imshow(table, aspect="auto", origin="lower", cmap="cividis")
            middle = np.nanmean([np.nanmin(table), np.nanmax(table)]) if np.isfinite(table).any() else 0.0
            for i, j in np.ndindex(table.shape):
                if math.isfinite(table[i, j]):
                    colour = "white" if table[i, j] < middle else "black"
                    panel.text(j, i, f"{table[i, j]:.2g}", ha="center", va="center", color=colour, fontsize=7)
            panel.set_xticks(range(len(x)), [f"{a:g}" for a in x])
            panel.set_yticks(range(len(y)), [f"{d:g}" for d in y])
            panel.set_xlabel(_AXIS_LABEL["delta_deg"])
            panel.set_ylabel(_AXIS_LABEL["distance_m"])
            panel.set_title(f"{method}: {label}", fontsize=9)
            figure.colorbar(shown, ax=panel, label="RMSE / bound" if quantity == "ratio" else f"RMSE ({unit})")
    return figure


def _map_value(
    cells: Sequence[Cell], method: str, quantity: str, parameter: str, distance_m: float, delta_deg: float
) -> float:
    found: list[Estimate] = [
        getattr(cell, quantity)[parameter]
        for cell in cells
        if cell.method == method and (cell.condition.distance_m, cell.condition.delta_deg) == (distance_m, delta_deg)
    ]
    return _median([estimate.value for estimate in found])


def _nees_quantiles(trials: SweepTrials) -> Figure:
    figure, (panel,) = _figure(1)
    error = trials.error
    top = 1.0
    for m, method in enumerate(trials.methods):
        at = np.array([VIEW.index(name) for name in trials.free[m]])
        e, covariance = error[:, m][:, at], trials.covariance[:, m][:, at[:, None], at]
        known = np.isfinite(e).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)) & (trials.found[:, m] >= 0)
        if not known.any():
            continue
        squared = np.sort(nees(e[known], covariance[known]))
        n = len(squared)
        keep = np.unique(np.linspace(0, n - 1, min(n, _MOST_POINTS)).astype(int))
        expected = stats.chi2.ppf((keep + 0.5) / n, len(at))
        colour, mark, _ = _style(m)
        panel.plot(expected, squared[keep], mark, color=colour, markersize=2.5, label=method)
        top = max(top, float(expected[-1]))
    panel.plot([0, top], [0, top], color="black", linewidth=0.8, label="honest")
    panel.set_ylim(0, 2 * top)
    panel.set_xlabel("quantile of χ² (–)")
    panel.set_ylabel("quantile of eᵀP⁻¹e (–), cut at twice the axis")
    panel.grid(linewidth=0.3)
    panel.legend(fontsize=7)
    return figure


def _coverage(cells: Sequence[Cell]) -> Figure:
    figure, (panel,) = _figure(1)
    for k, method in enumerate(_methods(cells)):
        colour, mark, _ = _style(k)
        mine = [cell for cell in cells if cell.method == method and math.isfinite(cell.coverage[LEVELS[0]].value)]
        for i, cell in enumerate(mine):
            for level in LEVELS:
                share = cell.coverage[level]
                x = 100 * level + 2.4 * ((i + 0.5) / len(mine) - 0.5) + 0.4 * k
                panel.vlines(x, 100 * share.low, 100 * share.high, color=colour, linewidth=0.4)
                panel.plot(
                    x, 100 * share.value, mark, color=colour, markersize=2.5,
                    label=method if (i, level) == (0, LEVELS[0]) else None,
                )  # fmt: skip
    panel.plot([45, 100], [45, 100], color="black", linewidth=0.8, label="target")
    panel.set_xlabel("probability of the ellipsoid (%), cells side by side")
    panel.set_ylabel("share of errors within (%)")
    panel.grid(linewidth=0.3)
    panel.legend(fontsize=7)
    return figure


def _confusion(trials: SweepTrials) -> Figure:
    methods = len(trials.methods)
    figure, panels = _figure(methods, 4.2, 3.8)
    names = (*trials.classes, "none")
    true = trials.true_class
    for m, panel in enumerate(panels):
        present = [k for k in range(len(trials.classes)) if (true == k).any()]
        found = np.where(trials.found[:, m] < 0, len(trials.classes), trials.found[:, m])
        table = np.array([[np.mean(found[true == k] == j) for j in range(len(names))] for k in present])
        panel.imshow(table, cmap="cividis", vmin=0, vmax=1, aspect="auto")
        for i, j in np.ndindex(table.shape):
            text = f"{100 * table[i, j]:.3g} %" if table[i, j] else "0"
            panel.text(
                j, i, text, ha="center", va="center", color="black" if table[i, j] > 0.5 else "white", fontsize=7
            )
        panel.set_xticks(range(len(names)), names, fontsize=8)
        panel.set_yticks(range(len(present)), [trials.classes[k] for k in present], fontsize=8)
        panel.set_xlabel("found")
        panel.set_ylabel("true class")
        panel.set_title(trials.methods[m], fontsize=9)
    return figure


def _risk(trials: SweepTrials) -> Figure:
    figure, (panel,) = _figure(1)
    error_mm = 1e3 * trials.error[:, :, 0]
    for m, method in enumerate(trials.methods):
        answered = np.isfinite(error_mm[:, m]) & (trials.found[:, m] >= 0)
        if not answered.any():
            continue
        order = np.argsort(-trials.p_value[answered, m], kind="stable")
        squares = error_mm[answered, m][order] ** 2
        risk = np.sqrt(np.cumsum(squares) / np.arange(1, len(squares) + 1))
        kept = np.arange(1, len(squares) + 1) / len(trials)
        show = np.unique(np.linspace(len(risk) // 50, len(risk) - 1, min(len(risk), 500)).astype(int))
        colour, _, stroke = _style(m)
        panel.plot(100 * kept[show], risk[show], color=colour, linestyle=stroke, label=method)
    panel.set_yscale("log")
    panel.set_xlabel("trials kept (%)")
    panel.set_ylabel("RMSE of distance, outliers included (mm)")
    panel.grid(which="both", linewidth=0.3)
    panel.legend(fontsize=7)
    return figure
