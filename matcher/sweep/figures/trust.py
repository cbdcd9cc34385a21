"""Figures of what a method says of itself: honesty of covariances, classes, and when it refuses to answer."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.statistics import binomial_interval, nees
from phasemark.matcher.sweep.figures.style import methods_of
from phasemark.matcher.sweep.result_tables import LEVELS, Cell, SweepTrials
from phasemark.render.charts import (
    as_written,
    explain,
    legend_above,
    logarithmic,
    panels,
    panels_of,
    style,
    written_table,
)

_MOST_POINTS = 2000
_ASIDE = 1.25
"""By which factor the marks of one method are moved from those of the next."""


def nees_quantiles(trials: SweepTrials) -> Figure:
    """Draw the quantiles of eᵀP⁻¹e against those of χ²."""
    figure, ((panel,),) = panels(1)
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
        colour, mark, _ = style(m)
        panel.plot(expected, squared[keep], mark, color=colour, markersize=2.5, label=as_written(method))
        top = max(top, float(expected[-1]))
    panel.plot([0, top], [0, top], color="black", linewidth=0.8, label="honest")
    panel.set_ylim(0, 1.5 * top)
    explain(panel, "quantile of χ² (–)", "quantile of eᵀP⁻¹e (–)", legend="best")
    return figure


def coverage(cells: Sequence[Cell]) -> Figure:
    """Draw the share of errors within the ellipsoid of each probability, cell by cell."""
    figure, (row,) = panels(len(LEVELS), width=2.7)
    clear_bars = 60  # bars side by side that do not hide the marks; more are drawn the fainter
    for panel, level in zip(row, LEVELS, strict=True):
        for k, method in enumerate(methods_of(cells)):
            colour, mark, _ = style(k)
            mine = [cell for cell in cells if cell.method == method and math.isfinite(cell.coverage[level].value)]
            x = np.arange(len(mine)) + 0.2 * k
            low, shares, high = (
                [100 * getattr(cell.coverage[level], end) for cell in mine] for end in ("low", "value", "high")
            )
            panel.vlines(x, low, high, color=colour, linewidth=0.5, alpha=min(1.0, clear_bars / max(1, len(mine))))
            if mine:
                panel.plot(x, shares, mark, color=colour, markersize=2, label=as_written(method))
        panel.axhline(100 * level, color="black", linewidth=0.8)
        explain(panel, "cell", "", f"{100 * level:g} %")
    row[0].set_ylabel("share of errors within the ellipsoid (%)")
    legend_above(figure, row[0])
    return figure


def confusion(trials: SweepTrials) -> Figure:
    """Draw what was found, by true class, and strangers below; a match that was not accepted counts as refused."""
    figure, shown = panels_of(len(trials.methods), height=3.4)
    names = (*trials.classes, "refused")
    shown_class = np.array([condition.class_name for condition in trials.conditions])[trials.condition]
    present = list(dict.fromkeys(condition.class_name for condition in trials.conditions))
    for m, panel in enumerate(shown):
        found = np.where(trials.refused[:, m], len(trials.classes), trials.found[:, m])
        table = np.array([[np.mean(found[shown_class == name] == j) for j in range(len(names))] for name in present])
        texts = np.array([[f"{100 * share:.3g} %" if share else "0" for share in row] for row in table], object)
        written_table(
            panel, table, ("found", names), ("shown", present), texts, table <= 0.5, cmap="cividis", vmin=0, vmax=1
        )
        panel.tick_params(labelsize=8)
        panel.set_title(as_written(trials.methods[m]), fontsize=9)
    return figure


def confusion_bound(cells: Sequence[Cell]) -> Figure:
    """Draw how often each cell's class was wrong beside the bound on it."""
    figure, ((panel,),) = panels(1, width=7.4)
    least = 1.0
    methods = methods_of(cells)
    least_bound = 1e-7
    for k, method in enumerate(methods):
        colour, mark, _ = style(k)
        mine = [cell for cell in cells if cell.method == method and math.isfinite(cell.confusion_bound)]
        aside = _ASIDE ** (k - (len(methods) - 1) / 2)  # or methods that are right alike hide one another
        x = aside * np.array([max(cell.confusion_bound, least_bound) for cell in mine])
        n_wrong = [cell.n - round(cell.class_right.value * cell.n) for cell in mine]
        wrong = [binomial_interval(k, cell.n, law="student") for k, cell in zip(n_wrong, mine, strict=True)]
        high = np.array([one.high for one in wrong])
        # a cell without a wrong class has a mark at its interval's upper end, pointing down
        never = np.array([one.value == 0 for one in wrong], np.bool_)
        share = np.array([one.value for one in wrong])
        panel.vlines(x[~never], [one.low for one in wrong if one.value], high[~never], color=colour, linewidth=0.7)
        panel.plot(
            x[~never], share[~never], mark, color=colour, markersize=4, label=as_written(method), linestyle="none"
        )
        panel.plot(x[never], high[never], marker=7, color=colour, markersize=4, linestyle="none", alpha=0.6)
        least = min(least, *high, *share[~never])
    ends = np.array([least_bound, 1.0])
    panel.plot(ends, ends, color="black", linewidth=0.8, label="bound")
    panel.set(xscale="log", yscale="log", ylim=(0.3 * least, 1.5))
    x_label = f"bound on the probability of a wrong class (–), {least_bound:g} where it is less"
    explain(panel, x_label, "share of wrong classes (–)")
    legend_above(figure, panel)
    return figure


def risk(trials: SweepTrials) -> Figure:
    """Draw the error of the trials kept, if only those with the best p-values are kept."""
    figure, ((panel,),) = panels(1)
    error_mm = 1e3 * trials.error[:, :, 0]
    landmarks = int((trials.true_class >= 0).sum())
    for m, method in enumerate(trials.methods):
        answered = np.isfinite(error_mm[:, m]) & (trials.found[:, m] >= 0)
        if not answered.any():
            continue
        order = np.argsort(-trials.p_value[answered, m], kind="stable")
        squares = error_mm[answered, m][order] ** 2
        kept = np.arange(1, len(squares) + 1)
        rms = np.sqrt(np.cumsum(squares) / kept)
        show = np.unique(np.linspace(len(rms) // 50, len(rms) - 1, min(len(rms), 500)).astype(int))
        colour, _, stroke = style(m)
        panel.plot(100 * kept[show] / landmarks, rms[show], color=colour, linestyle=stroke, label=as_written(method))
    logarithmic(panel.yaxis)
    explain(panel, "trials kept (%)", "RMSE of distance, with outliers (mm)", grid="both", legend="best")
    return figure


def roc(trials: SweepTrials) -> Figure:
    """Draw the share of landmarks accepted against that of strangers accepted, as the least p-value varies."""
    figure, ((panel,),) = panels(1)
    strange = trials.true_class < 0
    for m, method in enumerate(trials.methods):
        score = np.where(trials.found[:, m] < 0, -1.0, np.nan_to_num(trials.p_value[:, m], nan=-1.0))
        limits = np.unique([*score, -2.0, 2.0])[::-1]
        strangers, landmarks = (
            1 - np.searchsorted(np.sort(score[rows]), limits) / rows.sum() for rows in (strange, ~strange)
        )
        area = float(np.trapezoid(landmarks, strangers))
        colour, mark, stroke = style(m)
        keep = np.unique(np.linspace(0, len(limits) - 1, min(len(limits), _MOST_POINTS)).astype(int))
        panel.plot(
            100 * strangers[keep], 100 * landmarks[keep], color=colour, linestyle=stroke,
            label=f"{as_written(method)}, area {area:.3f}",
        )  # fmt: skip
        x, y = (
            binomial_interval(int(trials.accepted[rows, m].sum()), int(rows.sum()), law="student").scaled(100)
            for rows in (strange, ~strange)
        )
        across, up = ([[one.value - one.low], [one.high - one.value]] for one in (x, y))
        panel.errorbar(x.value, y.value, up, across, marker=mark, color=colour, markersize=5, capsize=2)
    panel.plot([0, 100], [0, 100], color="black", linewidth=0.6, linestyle=":", label="by lot")
    explain(panel, "strangers accepted (%)", "landmarks accepted (%)", legend="lower right")
    return figure
