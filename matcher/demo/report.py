"""The demo's report: one self-contained HTML page."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from numpy.typing import NDArray

from phasemark.data.files.atomic_write import write_atomically
from phasemark.data.files.provenance import versions
from phasemark.data.pages.page import embedded_png, figure_png, page_template, short_number
from phasemark.landmarks import mesh_figure
from phasemark.matcher.demo.run import (
    LANDMARK_XY_M,
    SHIFT_STEPS,
    WALL_M,
    CellResult,
    DemoResult,
    cell_rows,
    cells_csv,
    trials_csv,
)
from phasemark.matcher.figures import describe, match_figure
from phasemark.render.figures import RANGE_COLOURS, draw_range

_ANGLE_STYLES = (("#0072B2", "o", "-"), ("#D55E00", "s", "--"), ("#009E73", "^", ":"), ("#CC79A7", "D", "-."))
"""Colours that differ for the colour-blind, with marks and strokes that differ without colour."""


def write_demo(result: DemoResult, folder: Path, *, force: bool = False) -> Path:
    """Write ``report.html``, ``cells.csv`` and ``trials.csv`` into a folder; returns the report's path.

    Raises
    ------
    OutputExistsError, StorageError
        As in :func:`phasemark.data.files.write_atomically`.
    """
    write_atomically(folder / "cells.csv", cells_csv(result.cells).encode(), force=force)
    write_atomically(folder / "trials.csv", trials_csv(result.cells).encode(), force=force)
    return write_atomically(folder / "report.html", demo_report(result).encode(), force=force)


def demo_report(result: DemoResult) -> str:
    """Return the report of a demo as HTML that loads nothing.

    Parameters
    ----------
    result : DemoResult

    Returns
    -------
    str
    """
    on_grid, shifted = result.select(shifted=False), result.select(shifted=True)
    halves = [
        {"name": "On the bank's grid: the paper's cells", "results": on_grid},
        {"name": f"Between grid points: {SHIFT_STEPS:g} of a step further in D and δ", "results": shifted},
    ]
    for half in halves:
        half["rows"] = cell_rows(half["results"])  # type: ignore[arg-type]
    return page_template("phasemark.matcher.demo", "page.html.j2").render(
        summary=_summary(result),
        gallery=_gallery(result),
        range_colours=RANGE_COLOURS,
        matches=_matches(result),
        confusion=_image(_confusion_figure(result), "Confusion matrix of the classes"),
        errors=_image(_error_figure(result), "Errors of distance, angle and position in every cell"),
        halves=halves,
        seconds=_run_time(result),
        facts={
            "sensor": result.bank.plan.sensor,
            "bank": f"{len(result.bank.distance_m)} distances × {len(result.bank.delta_rad)} angles, factored",
            "frames": f"{result.n_frames} a repetition, {result.repetitions} repetitions a cell",
            "wall": f"{WALL_M:g} m, known to the matcher",
            "landmark": f"at ({LANDMARK_XY_M[0]:g}, {LANDMARK_XY_M[1]:g}) m",
            "seed": str(result.seed),
            "versions": ", ".join(f"{name} {version}" for name, version in versions().items()),
        },
        command=f"phasemark demo --seed {result.seed}",
    )


def _summary(result: DemoResult) -> list[str]:
    """Say in three sentences what was found."""
    sentences = []
    for name, results in (
        ("On the bank's grid", result.select(shifted=False)),
        ("Between its grid points", result.select(shifted=True)),
    ):
        right = sum(int(r.class_right.sum()) for r in results)
        total = sum(len(r.matches) for r in results)
        distance_mm = np.concatenate([np.abs(r.distance_error_m) for r in results]) * 1e3
        delta_deg = np.degrees(np.concatenate([np.abs(r.delta_error_rad) for r in results]))
        position_mm = np.concatenate([r.position_error_m for r in results]) * 1e3
        (distance, distance_worst), (delta, delta_worst), (position, position_worst) = (
            (short_number(float(np.nanmedian(errors))), short_number(float(np.nanmax(errors))))
            for errors in (distance_mm, delta_deg, position_mm)
        )
        sentences.append(
            f"{name} the class was right in {right} of {total} trials; the median error was {distance} mm in distance"
            f" (worst {distance_worst}), {delta}° in angle (worst {delta_worst}) and {position} mm in the robot's"
            f" position (worst {position_worst})."
        )
    worst = _worst_cell(result)
    refused = sum(int((~r.matches.accepted).sum()) for r in result.cells)
    sentences.append(
        f"The largest position error came from the {_cell_name(worst)}, and {refused} of"
        f" {sum(len(r.matches) for r in result.cells)} matches did not pass the test of their fit."
    )
    return sentences


def _worst_cell(result: DemoResult) -> CellResult:
    return max(result.cells, key=lambda r: float(np.nan_to_num(r.position_error_m, nan=np.inf).max()))


def _cell_name(result: CellResult) -> str:
    cell = result.cell
    return f"{cell.class_name} at D = {100 * cell.distance_m:g} cm, δ = {math.degrees(cell.delta_rad):g}°"


def _gallery(result: DemoResult) -> list[dict[str, Any]]:
    """Show one filtered frame of each class beside its mesh."""
    shown = []
    results = result.select(shifted=False)
    for name in result.bank.classes:
        own = [r for r in results if r.cell.class_name == name]
        picked = own[len(own) // 2]
        figure = Figure(figsize=(3.9, 3.3), layout="constrained")
        draw_range(figure.add_subplot(), picked.filtered.range_m[0])
        shown.append(
            {
                "name": name,
                "view": f"D = {100 * picked.cell.distance_m:g} cm, δ = {math.degrees(picked.cell.delta_rad):g}°",
                "frame": _image(figure, f"Filtered range image of the {name}"),
                "mesh": embedded_png(mesh_figure(result.bank.mesh(name)), f"The {name}"),
            }
        )
    return shown


def _matches(result: DemoResult) -> list[dict[str, Any]]:
    """Show filtered image, best model image and residual of three cells on the grid and of the worst trial."""
    on_grid = result.select(shifted=False)
    picked = [on_grid[k * (len(on_grid) - 1) // 2] for k in range(3)]
    worst = _worst_cell(result)
    return [
        {
            "title": title,
            "found": f"Repetition {k}: {describe(r.matches[k])}",
            "picture": _image(
                match_figure(r.filtered, r.matches[k], result.bank, result.background, k, title=False),
                f"Measured, model and residual: {title}",
            ),
        }
        for title, r, k in [
            *((_cell_name(r), r, 0) for r in picked),
            (f"The worst trial: {_cell_name(worst)}", worst, int(worst.position_error_m.argmax())),
        ]
    ]


def _confusion_figure(result: DemoResult) -> Figure:
    """Draw true against found class, for both halves."""
    names = [*result.bank.classes, "none"]
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    for axes, shifted, title in zip(
        figure.subplots(1, 2), (False, True), ("on the grid", "between grid points"), strict=True
    ):
        counts = np.zeros((len(names) - 1, len(names)), int)
        for r in result.select(shifted=shifted):
            for found in r.matches.class_name:
                counts[names.index(r.cell.class_name), names.index(found or "none")] += 1
        axes.imshow(counts, cmap="Blues", vmin=0, vmax=max(int(counts.max()), 1))
        for (row, col), count in np.ndenumerate(counts):
            dark = count > 0.6 * counts.max()
            axes.text(col, row, str(count), ha="center", va="center", color="white" if dark else "black")
        axes.set_xticks(range(len(names)), names, rotation=30)
        axes.set_yticks(range(len(names) - 1), names[:-1])
        axes.set(title=title, xlabel="found", ylabel="true class")
    return figure


def _error_figure(result: DemoResult) -> Figure:
    """Draw errors against distance, a curve for each angle: median over classes and trials, bars from 5 to 95 %."""
    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True, sharey="col")
    quantities: tuple[tuple[str, Callable[[CellResult], NDArray[np.float64]]], ...] = (
        ("|ΔD| (mm)", lambda r: 1e3 * np.abs(r.distance_error_m)),
        ("|Δδ| (°)", lambda r: np.degrees(np.abs(r.delta_error_rad))),
        ("position error (mm)", lambda r: 1e3 * r.position_error_m),
    )
    for row, (shifted, half) in zip(panels, ((False, "on the grid"), (True, "between grid points")), strict=True):
        results = result.select(shifted=shifted)
        angles = sorted({r.cell.delta_rad for r in results})
        for axes, (label, error) in zip(row, quantities, strict=True):
            for k, angle in enumerate(angles):
                colour, marker, stroke = _ANGLE_STYLES[k % len(_ANGLE_STYLES)]
                distances = sorted({r.cell.distance_m for r in results})
                values = [
                    np.concatenate([error(r) for r in results if (r.cell.distance_m, r.cell.delta_rad) == (d, angle)])
                    for d in distances
                ]
                low, middle, high = np.nanpercentile(np.stack(values), (5, 50, 95), axis=1)
                axes.errorbar(
                    100 * np.array(distances) + 0.6 * (k - (len(angles) - 1) / 2), middle,
                    yerr=(middle - low, high - middle), color=colour, marker=marker, linestyle=stroke,
                    capsize=3, label=f"δ = {math.degrees(angle):.4g}°",
                )  # fmt: skip
            axes.set_title(half)
            axes.set_ylabel(label)
            axes.grid(alpha=0.3)
        row[0].legend(frameon=False)
    for axes in panels[-1]:  # the axes of a column share their limits, which are set once all is drawn
        axes.set_xlabel("distance D (cm)")
        axes.set_ylim(bottom=0)
    return figure


def _run_time(result: DemoResult) -> list[tuple[str, float]]:
    names = {
        "bank": "building the bank",
        "render": "rendering",
        "capture": "capturing noisy frames",
        "filter": "filtering",
        "match": "matching",
        "total": "all of it, by the clock",
    }
    return [(names[key], result.seconds[key]) for key in names]


def _image(figure: Figure, alternative: str) -> Markup:
    return embedded_png(figure_png(figure), alternative)


def summary_rows(results: Sequence[CellResult]) -> list[tuple[str, ...]]:
    """Return one row for each view, over all classes, as text: what the command line prints."""
    rows = []
    for distance, delta in dict.fromkeys((r.cell.distance_m, r.cell.delta_rad) for r in results):
        own = [r for r in results if (r.cell.distance_m, r.cell.delta_rad) == (distance, delta)]
        errors = [
            np.concatenate([np.abs(r.distance_error_m) for r in own]) * 1e3,
            np.degrees(np.concatenate([np.abs(r.delta_error_rad) for r in own])),
            np.concatenate([r.position_error_m for r in own]) * 1e3,
        ]
        rows.append(
            (
                f"{100 * distance:.2f}",
                f"{math.degrees(delta):.2f}",
                f"{sum(int(r.class_right.sum()) for r in own)}/{sum(len(r.matches) for r in own)}",
                *(short_number(float(statistic(error))) for error in errors for statistic in (np.nanmedian, np.nanmax)),
            )
        )
    return rows
