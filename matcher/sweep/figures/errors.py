"""Figures of a sweep's errors: against each axis, over distance and angle, within a cell of the bank, by model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from phasemark.matcher.statistics import Interval, mean_interval, rms_interval
from phasemark.matcher.sweep.figures.style import (
    AXIS_LABEL,
    NOMINAL,
    SHOWN,
    as_written,
    is_as_told,
    logarithmic,
    median,
    methods_of,
    panels,
    style,
    value_ticks,
)
from phasemark.matcher.sweep.plan import Method
from phasemark.matcher.sweep.result_tables import Cell, SweepTrials, outlier_share, outliers_in_words

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
    figure, rows = panels(2, 2, height=3.4)
    groups = {method: _along(cells, method, axis, axes) for method in methods_of(cells)}
    for column, (parameter, (label, unit, scale)) in enumerate(SHOWN.items()):
        bounds: dict[tuple[float, ...], list[str]] = {}
        for k, (method, along) in enumerate(groups.items()):
            colour, mark, stroke = style(k)
            stroke = "none" if axis in NOMINAL else stroke
            values = list(along)
            x = _places(axis, values, k - (len(groups) - 1) / 2)
            rmse = [_typical([cell.rmse[parameter] for cell in along[value]], scale) for value in values]
            whole = [
                median([cell.rmse_with_outliers[parameter].value * scale for cell in along[value]]) for value in values
            ]
            bias = [_mean([cell.bias[parameter] for cell in along[value]], scale) for value in values]
            look = {"color": colour, "marker": mark, "linestyle": stroke, "markersize": 4, "capsize": 2, "linewidth": 1}
            drawn_cells = [cell for value in values for cell in along[value]]
            lost = f", {outliers_in_words(drawn_cells)}" if outlier_share(drawn_cells) else ""
            _with_bars(rows[0][column], x, rmse, {**look, "label": as_written(method) + lost})
            # where all answers are outliers there is no error without them
            if any(
                math.isfinite(value) and not value <= 1.02 * one.value for value, one in zip(whole, rmse, strict=True)
            ):
                rows[0][column].plot(
                    x, whole, color=colour, linewidth=0.7, alpha=0.6, marker="_" if axis in NOMINAL else None,
                    linestyle=stroke if axis in NOMINAL else "-", label=f"{as_written(method)}, with outliers",
                )  # fmt: skip
            _with_bars(rows[1][column], x, bias, look)
            bound = tuple(median([cell.bound[parameter] * scale for cell in along[value]]) for value in values)
            bounds.setdefault(bound, []).append(method)
        by_size = sorted(bounds.items(), key=lambda item: -len(item[1]))
        for k, (bound, methods) in enumerate(by_size):
            label_of = "Cramér–Rao bound" if k == 0 else f"bound, {', '.join(map(as_written, methods))}"
            drawn: dict[str, Any] = {"color": "black", "linewidth": 1.2, "linestyle": (0, (1 + 2 * k, 1))}
            x = _places(axis, values, 0)
            if axis in NOMINAL:
                rows[0][column].hlines(bound, np.subtract(x, _BESIDE), np.add(x, _BESIDE), label=label_of, **drawn)
            else:
                rows[0][column].plot(x, bound, label=label_of, **drawn)
        logarithmic(rows[0][column].yaxis)
        rows[0][column].set_ylabel(f"RMSE of {label} ({unit})")
        rows[1][column].set_ylabel(f"bias of {label} ({unit})")
        rows[1][column].axhline(0, color="black", linewidth=0.8)
        for row in rows:
            value_ticks(row[column].xaxis, axis, values)
            row[column].set_xlabel(AXIS_LABEL[axis])
            row[column].grid(which="both", linewidth=0.3)
    # above the panels: with many methods it would cover what it explains
    figure.legend(*rows[0][0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=7)
    return figure


def maps(cells: Sequence[Cell], quantity: str) -> Figure:
    """Draw RMSE or its ratio to the bound over distance and angle, the median over the other axes."""
    methods = methods_of(cells)
    figure, rows = panels(2, len(methods), height=3.2)
    x, y, groups = _over_plane(cells)
    for row, method in zip(rows, methods, strict=True):
        for panel, (parameter, (label, unit, scale)) in zip(row, SHOWN.items(), strict=True):
            factor = 1.0 if quantity == "ratio" else scale
            table = np.array(
                [
                    [median([getattr(c, quantity)[parameter].value * factor for c in groups[method, d, a]]) for a in x]
                    for d in y
                ]
            )
            if quantity == "ratio":  # a scale of its own would spend all its contrast on 0.97 … 1.02
                low, high = RATIO_SPAN
                shown = panel.imshow(table, aspect="auto", origin="lower", cmap="RdBu_r", norm=LogNorm(low, high))
            else:
                shown = panel.imshow(table, aspect="auto", origin="lower", cmap="cividis")
            middle = np.nanmean([np.nanmin(table), np.nanmax(table)]) if np.isfinite(table).any() else 0.0
            for i, j in np.ndindex(table.shape):
                own = groups[method, y[i], x[j]]
                lost = outliers_in_words(own).removesuffix("liers") if outlier_share(own) else ""
                if not math.isfinite(table[i, j]):
                    panel.text(j, i, lost, ha="center", va="center", color="black", fontsize=7)
                else:
                    if quantity == "ratio":
                        ratio = max(float(table[i, j]), 1e-9)
                        colour = "white" if max(ratio, 1 / ratio) > RATIO_DARK else "black"
                    else:
                        colour = "white" if table[i, j] < middle else "black"
                    text = f"{table[i, j]:.3g}" + (f"\n{lost}" if lost else "")
                    panel.text(j, i, text, ha="center", va="center", color=colour, fontsize=7)
            panel.set_xticks(range(len(x)), [f"{a:g}" for a in x])
            panel.set_yticks(range(len(y)), [f"{d:g}" for d in y])
            panel.set_xlabel(AXIS_LABEL["delta_deg"])
            panel.set_ylabel(AXIS_LABEL["distance_m"])
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
    figure, rows = panels(min(2, len(methods)), -(-len(methods) // 2), height=3.6)
    x, y, groups = _over_plane(cells)
    places = [(d, a) for d in y for a in x]
    for panel, method in zip([panel for row in rows for panel in row], methods, strict=False):
        mean = {
            name: [_mean([c.bias[name] for c in groups[method, d, a]], SHOWN[name][2]) for d, a in places]
            for name in SHOWN
        }
        arrows = np.array([[one.value for one in mean[name]] for name in ("delta_rad", "distance_m")])
        sure = np.array([[one.low > 0 or one.high < 0 for one in mean[name]] for name in SHOWN]).any(axis=0)
        _arrows(panel, places, arrows, sure)
        panel.set_title(as_written(method), fontsize=9, loc="left", pad=10)
    for panel in [panel for row in rows for panel in row][len(methods) :]:
        panel.set_axis_off()
    return figure


def observability(cells: Sequence[Cell]) -> Figure:
    """Draw the bound's condition number, and the direction known worst, over distance and angle."""
    figure, ((left, right),) = panels(2)
    method = methods_of(cells)[0]
    x, y, groups = _over_plane(cells)
    for k, d in enumerate(y):
        colour, mark, stroke = style(k)
        values = [median([cell.condition_number for cell in groups[method, d, a]]) for a in x]
        left.plot(x, values, color=colour, marker=mark, linestyle=stroke, markersize=4, label=f"D = {d:g} m")
    logarithmic(left.yaxis)
    value_ticks(left.xaxis, "delta_deg", x)
    left.set_xlabel(AXIS_LABEL["delta_deg"])
    left.set_ylabel("condition number of the bound (cm, °)")
    left.grid(which="both", linewidth=0.3)
    left.legend(fontsize=7)
    places = [(d, a) for d in y for a in x]
    weak = np.array(
        [
            [
                median([cell.weak_direction.get(name, math.nan) for cell in groups[method, d, a]]) * SHOWN[name][2]
                for d, a in places
            ]
            for name in ("delta_rad", "distance_m")
        ]
    )
    _arrows(right, places, weak, True, both_ways=True)
    right.set_title("weakest direction", fontsize=9, loc="left", pad=10)
    return figure


def position_in_cell(trials: SweepTrials, methods: Sequence[Method], first_m: float) -> Figure:
    """Draw the mean error against the position of the truth in a cell of the grid, which begins at `first_m`."""
    figure, (row,) = panels(2)
    nominal = np.array([is_as_told(condition) for condition in trials.conditions])[trials.condition]
    error = trials.error
    limits = (trials.outlier[0], math.radians(trials.outlier[1]))
    for k, method in enumerate(methods):
        if method.is_program:
            continue
        steps = (method.bank_step[0], math.radians(method.bank_step[1]))
        with np.errstate(invalid="ignore"):
            inner = nominal & (np.abs(error[:, k, :2]) <= limits).all(axis=1)
        colour, mark, stroke = style(k)
        for column, (panel, (label, unit, scale)) in enumerate(zip(row, SHOWN.values(), strict=True)):
            # a grid point lies in the middle of its cell
            place = ((trials.truth[inner, column] - (first_m, 0.0)[column]) / steps[column] + 0.5) % 1
            bins = np.minimum((place * _BINS).astype(int), _BINS - 1)
            used = [b for b in range(_BINS) if (bins == b).sum() > 1]
            means = [mean_interval(scale * error[inner, k, column][bins == b]) for b in used]
            look = {"color": colour, "marker": mark, "linestyle": stroke, "markersize": 4, "capsize": 2, "linewidth": 1}
            _with_bars(
                panel, [(b + 0.5) / _BINS - 0.5 for b in used], means, {**look, "label": as_written(method.name)}
            )
            panel.axhline(0, color="black", linewidth=0.8)
            panel.set_xlabel(f"position along {label} from the grid point, in steps")
            panel.set_ylabel(f"mean error of {label} ({unit})")
            panel.grid(linewidth=0.3)
    row[0].legend(fontsize=7)
    return figure


def model_comparison(trials: SweepTrials, methods: Sequence[Method]) -> Figure:
    """Draw the nearest image's RMSE by the bank's model, without a wall and before one."""
    figure, (row,) = panels(2, height=3.0)
    chosen = [k for k, method in enumerate(methods) if method.method == "nearest"]
    nominal = np.array([is_as_told(condition) for condition in trials.conditions])
    walls = sorted({one.wall_m > 0 for one, as_told in zip(trials.conditions, nominal, strict=True) if as_told})
    error = trials.error
    limits = (trials.outlier[0], math.radians(trials.outlier[1]))
    for g, wall in enumerate(walls):
        of_condition = nominal & np.array([(condition.wall_m > 0) == wall for condition in trials.conditions])
        rows = of_condition[trials.condition] & (trials.true_class >= 0)
        colour, mark, _ = style(g)
        for place, k in enumerate(chosen):
            with np.errstate(invalid="ignore"):
                inner = rows & (np.abs(error[:, k, :2]) <= limits).all(axis=1)
            answered = rows & np.isfinite(error[:, k, :2]).all(axis=1)
            lost = 1 - inner.sum() / max(1, answered.sum())
            for column, (panel, (label, unit, scale)) in enumerate(zip(row, SHOWN.values(), strict=True)):
                rms = rms_interval(scale * error[inner, k, column])
                y = place + 0.18 * (g - (len(walls) - 1) / 2)
                panel.plot(
                    rms.value, y, mark, color=colour, markersize=5,
                    label=("before a wall" if wall else "nothing behind") if place == 0 else None,
                )  # fmt: skip
                panel.hlines(y, rms.low, rms.high, color=colour, linewidth=1.2)
                if lost >= 5e-4:
                    panel.annotate(
                        f"{100 * lost:.2g} % outliers", (rms.high, y), (0, 5), textcoords="offset points",
                        ha="right", fontsize=7,
                    )  # fmt: skip
                panel.set_xlabel(f"RMSE of {label} ({unit})")
                panel.set_ylim(len(chosen) - 0.4, -0.6)
                panel.set_yticks(range(len(chosen)), [as_written(methods[j].name) for j in chosen], fontsize=8)
                panel.grid(which="both", linewidth=0.3)
                panel.margins(x=0.25)
    for panel in row:
        logarithmic(panel.xaxis)
    row[0].legend(fontsize=7)
    return figure


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
    full = len(combined) == math.prod(len({getattr(cell.condition, name) for cell in cells}) for name in axes)
    groups: dict[float, list[Cell]] = {}
    for cell in cells:
        others = all(getattr(cell.condition, name) == first[name] for name in axes if name != axis)
        if cell.method == method and (full or others):
            groups.setdefault(getattr(cell.condition, axis), []).append(cell)
    return dict(sorted(groups.items()))


def _typical(estimates: Sequence[Interval], scale: float) -> Interval:
    return Interval(*(median([getattr(one, end) * scale for one in estimates]) for end in ("value", "low", "high")))


def _mean(estimates: Sequence[Interval], scale: float) -> Interval:
    """Return the mean of independent estimates with its interval."""
    known = [one for one in estimates if math.isfinite(one.high)]
    if not known:
        return Interval(math.nan, math.nan, math.nan)
    middle = scale * float(np.mean([one.value for one in known]))
    half = scale * math.sqrt(sum((one.high - one.value) ** 2 for one in known)) / len(known)
    return Interval(middle, middle - half, middle + half)


def _with_bars(panel: Axes, x: Sequence[float], estimates: Sequence[Interval], look: dict[str, object]) -> None:
    y = np.array([one.value for one in estimates])
    bars = np.abs([y - [one.low for one in estimates], [one.high for one in estimates] - y])
    panel.errorbar(x, y, np.where(np.isfinite(bars), bars, 0.0), **look)  # type: ignore[arg-type]


def _over_plane(
    cells: Sequence[Cell],
) -> tuple[list[float], list[float], dict[tuple[str, float, float], list[Cell]]]:
    """Return the angles and distances of a design, and its cells by method, distance and angle."""
    groups: dict[tuple[str, float, float], list[Cell]] = {}
    x = sorted({cell.condition.delta_deg for cell in cells})
    y = sorted({cell.condition.distance_m for cell in cells})
    for method in methods_of(cells):
        groups |= {(method, d, a): [] for d in y for a in x}
    for cell in cells:
        groups[cell.method, cell.condition.distance_m, cell.condition.delta_deg].append(cell)
    return x, y, groups


def _arrows(
    panel: Axes,
    places: Sequence[tuple[float, float]],
    arrows: NDArray[np.float64],
    sure: ArrayLike,
    *,
    both_ways: bool = False,
) -> None:
    """Draw arrows over the plane, 1° to the right as long as 1 mm upwards."""
    d, a = np.array(places).T
    panel.plot(a, d, ".", color="#808080", markersize=3)
    longest = float(np.nanmax(np.hypot(*arrows))) if np.isfinite(arrows).any() else 0.0
    if longest > 0:
        look: dict[str, Any] = (
            {"headwidth": 1, "headlength": 0, "headaxislength": 0, "pivot": "mid"} if both_ways else {}
        )
        drawn = panel.quiver(
            a, d, *arrows, angles="uv", scale_units="width", scale=1.7 * longest * max(len(set(a)), 4), width=0.006,
            color=np.broadcast_to(np.where(sure, style(0)[0], "#b0b0b0"), len(places)).tolist(), **look,
        )  # fmt: skip
        length = float(f"{longest:.1g}")
        panel.quiverkey(
            drawn, 0.72, 1.05, length, f"{length:g}° or {length:g} mm", labelpos="E", fontproperties={"size": 8}
        )
    panel.margins(0.25)
    panel.set_xticks(sorted(set(a)))
    panel.set_yticks(sorted(set(d)))
    panel.set_xlabel(AXIS_LABEL["delta_deg"])
    panel.set_ylabel(AXIS_LABEL["distance_m"])
    panel.grid(linewidth=0.3)
