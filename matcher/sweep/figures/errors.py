"""Figures of a sweep's errors: against each axis, over distance and angle, within a cell of the bank, by model."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from phasemark.matcher.statistics import Interval, mean_interval, rms_interval
from phasemark.matcher.sweep.figures.style import AXIS_LABEL, NOMINAL, SHOWN, methods_of, value_ticks
from phasemark.matcher.sweep.plan import MODEL_ERRORS, Method
from phasemark.matcher.sweep.result_tables import Cell, SweepTrials, outlier_share, outliers_in_words
from phasemark.render.charts import (
    as_written,
    explain,
    legend_above,
    logarithmic,
    marked,
    median,
    panels,
    panels_of,
    style,
    with_intervals,
    written_table,
)

RATIO_SPAN = (0.25, 4.0)
"""Ends of the colours of a map of ratios, about 1 in the middle; what lies beyond has the colour of the end."""
RATIO_TICKS = (0.25, 0.5, 1.0, 2.0, 4.0)
RATIO_DARK = 2.4
"""From this factor on the colours are dark, and numbers on them white."""
_BINS = 10
_APART, _BESIDE = 0.08, 0.3
"""How far apart methods stand where an axis has nothing between its values, and how far the bound is drawn there."""


def against_axis(cells: Sequence[Cell], axis: str, axes: Sequence[str]) -> Figure:
    """Draw RMSE with its bound, and bias, against one axis; what else varies is pooled, or at its first value."""
    figure, (above, below) = panels(2, 2, height=3.4)
    groups = {method: _along(cells, method, axis, axes) for method in methods_of(cells)}
    values = list(next(iter(groups.values())))
    for upper, lower, (parameter, (label, unit, scale)) in zip(above, below, SHOWN.items(), strict=True):
        for k, (method, along) in enumerate(groups.items()):
            look = marked(k, linestyle="none") if axis in NOMINAL else marked(k)
            x = _places(axis, values, k - (len(groups) - 1) / 2)
            _draw_rmse(upper, x, method, list(along.values()), parameter, look)
            bias = [_mean([cell.bias[parameter] for cell in own], scale) for own in along.values()]
            with_intervals(lower, x, bias, **look)
        _draw_bounds(upper, axis, groups, parameter)
        lower.axhline(0, color="black", linewidth=0.8)
        logarithmic(upper.yaxis)
        for panel, what in ((upper, "RMSE"), (lower, "bias")):
            value_ticks(panel.xaxis, axis, values)
            explain(panel, AXIS_LABEL[axis], f"{what} of {label} ({unit})", grid="both")
    legend_above(figure, above[0])
    return figure


def _draw_rmse(
    panel: Axes, x: Sequence[float], method: str, along: Sequence[list[Cell]], parameter: str, look: dict[str, Any]
) -> None:
    """Draw a method's RMSE with intervals, and as a thin line the one with outliers where it is larger."""
    scale = SHOWN[parameter][2]
    rmse = [_typical([cell.rmse[parameter] for cell in own], scale) for own in along]
    whole = [median([cell.rmse_with_outliers[parameter].value * scale for cell in own]) for own in along]
    drawn = [cell for own in along for cell in own]
    lost = f", {outliers_in_words(drawn)}" if outlier_share(drawn) else ""
    with_intervals(panel, x, rmse, **look, label=as_written(method) + lost)
    # where all answers are outliers there is no error without them
    if any(math.isfinite(value) and not value <= 1.02 * one.value for value, one in zip(whole, rmse, strict=True)):
        beside = {"marker": "_"} if look["linestyle"] == "none" else {"linestyle": "-", "marker": None}
        thin = {**look, "linewidth": 0.7, "markersize": 6, "alpha": 0.6, **beside}
        panel.plot(x, whole, label=f"{as_written(method)}, with outliers", **thin)


def _draw_bounds(panel: Axes, axis: str, groups: dict[str, dict[float, list[Cell]]], parameter: str) -> None:
    """Draw the bounds of the methods, those that are the same once."""
    bounds: dict[tuple[float, ...], list[str]] = {}
    for method, along in groups.items():
        bound = tuple(median([cell.bound[parameter] * SHOWN[parameter][2] for cell in own]) for own in along.values())
        bounds.setdefault(bound, []).append(method)
    x = _places(axis, list(along), 0)
    for k, (bound, methods) in enumerate(sorted(bounds.items(), key=lambda item: -len(item[1]))):
        label = "Cramér–Rao bound" if k == 0 else f"bound, {', '.join(map(as_written, methods))}"
        look: dict[str, Any] = {"color": "black", "linewidth": 1.2, "linestyle": (0, (1 + 2 * k, 1)), "label": label}
        if axis in NOMINAL:
            panel.hlines(bound, np.subtract(x, _BESIDE), np.add(x, _BESIDE), **look)
        else:
            panel.plot(x, bound, **look)


def maps(cells: Sequence[Cell], quantity: str) -> Figure:
    """Draw RMSE or its ratio to the bound over distance and angle, the median over the other axes."""
    methods = methods_of(cells)
    figure, rows = panels(2, len(methods), height=3.2)
    for row, method in zip(rows, methods, strict=True):
        lost = _over_plane(cells, method, lambda own: outliers_in_words(own).removesuffix("liers"))
        lost[_over_plane(cells, method, outlier_share) == 0] = ""
        for panel, (parameter, (label, unit, scale)) in zip(row, SHOWN.items(), strict=True):
            factor = 1.0 if quantity == "ratio" else scale
            table = factor * _numbers(cells, method, partial(_value, quantity, parameter))
            known = np.isfinite(table)
            texts = np.where(known, [[f"{value:.3g}" for value in line] for line in table], "").astype(object)
            texts += np.where(known & (lost != ""), "\n", "").astype(object) + lost
            how: dict[str, Any] = {"cmap": "cividis"}
            if quantity == "ratio":  # a scale of its own would spend all its contrast on 0.97 … 1.02
                how = {"cmap": "RdBu_r", "norm": LogNorm(*RATIO_SPAN)}
                dark = np.abs(np.log(np.maximum(table, 1e-9))) > math.log(RATIO_DARK)
            else:
                dark = table < (np.mean([table[known].min(), table[known].max()]) if known.any() else 0.0)
            columns, lines = ((AXIS_LABEL[axis], [f"{value:g}" for value in _values(cells, axis)]) for axis in _PLANE)
            shown = written_table(panel, table, columns, lines, texts, dark, origin="lower", **how)
            panel.set_title(f"{as_written(method)}: {label}", fontsize=9)
            if quantity == "ratio":
                bar = figure.colorbar(shown, ax=panel, label="RMSE / bound", extend="both")
                logarithmic(bar.ax.yaxis, RATIO_TICKS)
            else:
                figure.colorbar(shown, ax=panel, label=f"RMSE ({unit})")
    return figure


def bias_arrows(cells: Sequence[Cell]) -> Figure:
    """Draw the mean error as an arrow over distance and angle: to the right in δ, upwards in D."""
    methods = methods_of(cells)
    figure, shown = panels_of(len(methods), height=3.6)
    for panel, method in zip(shown, methods, strict=True):
        mean = {name: _over_plane(cells, method, partial(_mean_bias, name)) for name in SHOWN}
        arrows = np.array([[one.value for one in mean[name].flat] for name in ("delta_rad", "distance_m")])
        sure = np.array([[one.low > 0 or one.high < 0 for one in mean[name].flat] for name in SHOWN]).any(axis=0)
        _arrows(panel, cells, arrows, sure, as_written(method))
    return figure


def observability(cells: Sequence[Cell]) -> Figure:
    """Draw the bound's condition number, and the direction known worst, over distance and angle."""
    figure, ((left, right),) = panels(2)
    method = methods_of(cells)[0]
    angles, distances = (_values(cells, axis) for axis in _PLANE)
    condition = _numbers(cells, method, lambda one: one.condition_number)
    for k, (d, values) in enumerate(zip(distances, condition, strict=True)):
        left.plot(angles, values, label=f"D = {d:g} m", **marked(k, linewidth=1.5))
    logarithmic(left.yaxis)
    value_ticks(left.xaxis, "delta_deg", angles)
    explain(left, AXIS_LABEL["delta_deg"], "condition number of the bound (cm, °)", grid="both", legend="best")
    weak = [
        SHOWN[name][2] * _numbers(cells, method, partial(_weakness, name)).ravel()
        for name in ("delta_rad", "distance_m")
    ]
    _arrows(right, cells, np.array(weak), np.True_, "weakest direction", both_ways=True)
    return figure


def position_in_cell(trials: SweepTrials, methods: Sequence[Method], first_m: float) -> Figure:
    """Draw the mean error against the position of the truth in a cell of the grid, which begins at `first_m`."""
    figure, (row,) = panels(2)
    as_told, error = _as_told(trials)[trials.condition], trials.error
    for k, method in enumerate(methods):
        if method.is_program:
            continue
        steps = (method.bank_step[0], math.radians(method.bank_step[1]))
        inner = as_told & _within_limits(trials, error[:, k])
        for column, (panel, (label, unit, scale)) in enumerate(zip(row, SHOWN.values(), strict=True)):
            # a grid point lies in the middle of its cell
            place = ((trials.truth[inner, column] - (first_m, 0.0)[column]) / steps[column] + 0.5) % 1
            bins = np.minimum((place * _BINS).astype(int), _BINS - 1)
            used = [b for b in range(_BINS) if (bins == b).sum() > 1]
            means = [mean_interval(scale * error[inner, k, column][bins == b]) for b in used]
            x = [(b + 0.5) / _BINS - 0.5 for b in used]
            with_intervals(panel, x, means, **marked(k), label=as_written(method.name))
            panel.axhline(0, color="black", linewidth=0.8)
            explain(panel, f"position along {label} from the grid point, in steps", f"mean error of {label} ({unit})")
    row[0].legend(fontsize=7)
    return figure


def model_comparison(trials: SweepTrials, methods: Sequence[Method]) -> Figure:
    """Draw the nearest image's RMSE by the bank's model, without a wall and before one."""
    figure, (row,) = panels(2, height=3.0)
    chosen = [k for k, method in enumerate(methods) if method.method == "nearest"]
    as_told, walled = _as_told(trials), np.array([condition.wall_m > 0 for condition in trials.conditions])
    walls, error = np.unique(walled[as_told]), trials.error
    for g, wall in enumerate(walls):
        rows = (as_told & (walled == wall))[trials.condition] & (trials.true_class >= 0)
        colour, mark, _ = style(g)
        for place, k in enumerate(chosen):
            inner = rows & _within_limits(trials, error[:, k])
            answered = rows & np.isfinite(error[:, k, :2]).all(axis=1)
            lost = 1 - inner.sum() / max(1, answered.sum())
            y = place + 0.18 * (g - (len(walls) - 1) / 2)
            label = ("before a wall" if wall else "nothing behind") if place == 0 else None
            for column, (panel, (_, _, scale)) in enumerate(zip(row, SHOWN.values(), strict=True)):
                rms = rms_interval(scale * error[inner, k, column])
                panel.plot(rms.value, y, mark, color=colour, markersize=5, label=label)
                panel.hlines(y, rms.low, rms.high, color=colour, linewidth=1.2)
                if lost >= 5e-4:
                    panel.annotate(
                        f"{100 * lost:.2g} % outliers", (rms.high, y), (0, 5), textcoords="offset points",
                        ha="right", fontsize=7,
                    )  # fmt: skip
    for panel, (label, unit, _) in zip(row, SHOWN.values(), strict=True):
        panel.set_ylim(len(chosen) - 0.4, -0.6)
        panel.set_yticks(range(len(chosen)), [as_written(methods[j].name) for j in chosen], fontsize=8)
        panel.margins(x=0.25)
        explain(panel, f"RMSE of {label} ({unit})", "", grid="both")
        logarithmic(panel.xaxis)
    row[0].legend(fontsize=7)
    return figure


def _as_told(trials: SweepTrials) -> NDArray[np.bool_]:
    """Return which conditions are as a method takes them to be."""
    return np.array([all(getattr(one, name) == 0 for name in MODEL_ERRORS) for one in trials.conditions], np.bool_)


def _within_limits(trials: SweepTrials, error: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which errors (n, p) lie within the limits of the plan in distance and angle."""
    limits = (trials.outlier[0], math.radians(trials.outlier[1]))
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(error[:, :2]) <= limits).all(axis=1))


def _places(axis: str, values: Sequence[float], side: float) -> list[float]:
    """Return where values lie on an axis; where there is nothing between them, methods stand side by side."""
    if axis not in NOMINAL:
        return list(values)
    return [place + side * _APART for place in range(len(values))]


def _along(cells: Sequence[Cell], method: str, axis: str, axes: Sequence[str]) -> dict[float, list[Cell]]:
    """Return a method's cells by their value on an axis, in order.

    Where the design has every combination, all of them; where not, those whose other axes are at their first value.
    """
    first = {name: getattr(cells[0].condition, name) for name in axes}
    combined = {tuple(getattr(cell.condition, name) for name in axes) for cell in cells}
    full = len(combined) == math.prod(len(_values(cells, name)) for name in axes)
    groups: dict[float, list[Cell]] = {}
    for cell in cells:
        others = all(getattr(cell.condition, name) == first[name] for name in axes if name != axis)
        if cell.method == method and (full or others):
            groups.setdefault(getattr(cell.condition, axis), []).append(cell)
    return dict(sorted(groups.items()))


def _values(cells: Sequence[Cell], axis: str) -> list[float]:
    """Return the values of an axis, ascending."""
    return sorted({getattr(cell.condition, axis) for cell in cells})


def _typical(estimates: Sequence[Interval], scale: float) -> Interval:
    ends = ([getattr(one.scaled(scale), end) for one in estimates] for end in ("value", "low", "high"))
    return Interval(*map(median, ends))


def _mean(estimates: Sequence[Interval], scale: float) -> Interval:
    """Return the mean of independent estimates with its interval."""
    known = [one for one in estimates if math.isfinite(one.high)]
    if not known:
        return Interval(math.nan, math.nan, math.nan)
    middle = scale * float(np.mean([one.value for one in known]))
    half = scale * math.sqrt(sum((one.high - one.value) ** 2 for one in known)) / len(known)
    return Interval(middle, middle - half, middle + half)


def _mean_bias(parameter: str, cells: Sequence[Cell]) -> Interval:
    return _mean([cell.bias[parameter] for cell in cells], SHOWN[parameter][2])


def _value(quantity: str, parameter: str, cell: Cell) -> float:
    return float(getattr(cell, quantity)[parameter].value)


def _weakness(parameter: str, cell: Cell) -> float:
    return cell.weak_direction.get(parameter, math.nan)


_PLANE = ("delta_deg", "distance_m")


def _over_plane(cells: Sequence[Cell], method: str, of: Callable[[list[Cell]], Any]) -> NDArray[Any]:
    """Return a function's results for a method's cells at each distance (rows) and angle (columns)."""
    angles, distances = (_values(cells, axis) for axis in _PLANE)
    groups: dict[tuple[float, float], list[Cell]] = {(d, a): [] for d in distances for a in angles}
    for cell in cells:
        if cell.method == method:
            groups[cell.condition.distance_m, cell.condition.delta_deg].append(cell)
    return np.array([of(own) for own in groups.values()], object).reshape(len(distances), len(angles))


def _numbers(cells: Sequence[Cell], method: str, of: Callable[[Cell], float]) -> NDArray[np.float64]:
    """Return the median of a number of a method's cells at each distance and angle."""
    return _over_plane(cells, method, lambda own: median([of(one) for one in own])).astype(np.float64)


def _arrows(
    panel: Axes,
    cells: Sequence[Cell],
    arrows: NDArray[np.float64],
    sure: NDArray[np.bool_] | np.bool_,
    title: str,
    *,
    both_ways: bool = False,
) -> None:
    """Draw arrows (2, n) over the plane, 1° to the right as long as 1 mm upwards."""
    angles, distances = (_values(cells, axis) for axis in _PLANE)
    a, d = np.tile(angles, len(distances)), np.repeat(distances, len(angles))
    panel.plot(a, d, ".", color="#808080", markersize=3)
    longest = float(np.nanmax(np.hypot(*arrows))) if np.isfinite(arrows).any() else 0.0
    if longest > 0:
        look: dict[str, Any] = (
            {"headwidth": 1, "headlength": 0, "headaxislength": 0, "pivot": "mid"} if both_ways else {}
        )
        drawn = panel.quiver(
            a, d, *arrows, angles="uv", scale_units="width", scale=1.7 * longest * max(len(angles), 4), width=0.006,
            color=np.broadcast_to(np.where(sure, style(0)[0], "#b0b0b0"), len(a)).tolist(), **look,
        )  # fmt: skip
        length = float(f"{longest:.1g}")
        panel.quiverkey(
            drawn, 0.72, 1.05, length, f"{length:g}° or {length:g} mm", labelpos="E", fontproperties={"size": 8}
        )
    panel.margins(0.25)
    panel.set_xticks(angles)
    panel.set_yticks(distances)
    explain(panel, AXIS_LABEL["delta_deg"], AXIS_LABEL["distance_m"])
    panel.set_title(title, fontsize=9, loc="left", pad=10)
