"""Pictures of a design: which boxes there are to choose from, and what the chosen one gains over distance and side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from phasemark.matcher.design.confirm import Confirmation
from phasemark.matcher.design.search import Candidate, Design, Scored
from phasemark.render.charts import explain, logarithmic, panels, with_intervals

_NEW, _OLD, _GREY, _FRONT = "#2a6fbb", "#c8553d", "#b9bec4", "#1a1a1a"


def pareto_figure(design: Design) -> Figure:
    """Draw every box that was tried: its worst position bound, and how far apart classes and sides are.

    Parameters
    ----------
    design : Design
        The design.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure, ((left, right),) = panels(2, width=6, height=5)
    limits = design.plan.limits
    front = design.front()
    known, classes = design.catalogue, design.plan.n_classes > 1
    if classes:
        _scatter(left, design.candidates, [c.class_distance for c in design.candidates])
        x = [1000 * c.bound.worst_m for c in front]
        left.plot(x, [c.class_distance for c in front], color=_FRONT, lw=1, marker=".", label="Pareto front")
        _mark(left, known, known.class_distance, "catalogue", _OLD)
        _mark(left, design.result, design.result.class_distance, "chosen, its upper parts refined", _NEW)
        left.axhline(limits.least_class_distance, color=_GREY, lw=0.8, ls="--")
    else:
        left.text(0.5, 0.5, "one class: nothing to distinguish", ha="center", transform=left.transAxes)
    finite = [c.turn_distance for c in design.candidates if np.isfinite(c.turn_distance)]
    # where a square's distance from itself turned is drawn, in units of the largest other: it has none
    infinite = 1.15
    top = infinite * max([*finite, known.turn_distance, limits.least_turn_distance])
    _scatter(right, design.candidates, [min(c.turn_distance, top) for c in design.candidates])
    _mark(right, known, known.turn_distance, "catalogue", _OLD)
    _mark(right, design.result, min(design.result.turn_distance, top), "chosen", _NEW)
    right.axhline(limits.least_turn_distance, color=_GREY, lw=0.8, ls="--")
    if any(c.symmetry == 4 for c in design.candidates):
        right.annotate("square: δ modulo 90°", (1, top), (-4, 5), xycoords=("axes fraction", "data"),
                       textcoords="offset points", ha="right", fontsize=8)  # fmt: skip
    worst = [1000 * c.bound.worst_m for c in design.candidates if np.isfinite(c.bound.worst_m)]
    ends = 1000 * min(design.result.bound.worst_m, *worst), 1000 * known.bound.worst_m
    near, far = design.plan.distance_m
    conditions = f"{design.plan.n_classes} classes, {near:g} … {far:g} m, lower pixels, {design.plan.n_frames} frames"
    for axes, y, title in (
        (left, "least d between two classes", conditions),
        (right, "d from itself a quarter-turn on", "dashed: least d that the plan allows"),
    ):
        axes.set_xlim(0.93 * ends[0], max(1.15 * ends[1], float(np.quantile(worst, 0.8))))
        axes.set_ylim(bottom=0)
        explain(axes, "worst position bound over the range (mm)", y, title, grid=None, legend="lower right")
    return figure


def _scatter(axes: Axes, candidates: Sequence[Candidate], y: Sequence[float]) -> None:
    for kept, colour, words in ((False, _GREY, "breaks a rule"), (True, "#5b8c5a", "keeps every rule")):
        for square, marker in ((True, "s"), (False, "o")):
            some = [k for k, c in enumerate(candidates) if c.feasible == kept and (c.symmetry == 4) == square]
            if some:
                shape = "square" if square else "oblong"
                x = [1000 * candidates[k].bound.worst_m for k in some]
                axes.scatter(x, [y[k] for k in some], s=18, c=colour, marker=marker, label=f"{shape}, {words}", lw=0)


def _mark(axes: Axes, scored: Scored, y: float, words: str, colour: str) -> None:
    axes.scatter([1000 * scored.bound.worst_m], [y], s=130, c=colour, marker="*", label=words, zorder=3)


def bound_figure(design: Design, confirmed: tuple[Confirmation, Confirmation] | None) -> Figure:
    """Draw the position bound over distance, and over sides at its worst distance, with the frames that were matched.

    Parameters
    ----------
    design : Design
        The design.
    confirmed : (Confirmation, Confirmation), optional
        Of the result and of the catalogue.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure, ((left, right),) = panels(2, width=6, height=4.6)
    for k, (scored, words, colour) in enumerate(
        ((design.result, "new set", _NEW), (design.catalogue, "catalogue", _OLD))
    ):
        bound = scored.bound
        position = 1000 * bound.position_std_m
        left.plot(bound.distance_m, position.max(axis=1), color=colour, label=f"{words}, worst side")
        left.plot(bound.distance_m, np.median(position, axis=1), color=colour, ls="--", label=f"{words}, median side")
        at = int(np.argmin(np.abs(bound.distance_m - bound.worst_view[0])))
        sides = np.degrees(bound.delta_rad)
        right.plot(sides, position[at], color=colour, label=f"{words}, bound")
        if confirmed is None:
            continue
        trial = confirmed[k].sides
        rmse = [trial.rmse(i).scaled(1000) for i in range(len(trial.error_m))]
        label = f"{words}, r.m.s. error of {trial.error_m.shape[1]} frame sets, 95 %"
        look = {"color": colour, "marker": "o", "markersize": 4, "linestyle": "none", "linewidth": 1}
        with_intervals(right, np.degrees(trial.delta_rad[:, 0]), rmse, label=label, **look)
    logarithmic(left.yaxis)
    right.set_ylim(bottom=0)
    title = "Cramér–Rao bound of the lens's position, lower pixels"
    explain(left, "distance D (m)", "position bound (mm)", title, legend="best")
    worst_m = design.result.bound.worst_view[0]
    explain(right, "side δ (°)", f"position at D = {worst_m:.3g} m (mm)", legend="best")
    return figure
