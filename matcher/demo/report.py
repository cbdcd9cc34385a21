"""The demo's report: one self-contained HTML page."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from numpy.typing import NDArray

from phasemark.data.files.atomic_write import write_atomically
from phasemark.data.files.provenance import versions
from phasemark.data.pages.figure_data import figure_csv
from phasemark.data.pages.page import embedded_png, figure_png, page_template, short_number
from phasemark.landmarks import build_mesh, catalog, mesh_figure
from phasemark.matcher.accuracy.expected_accuracy import accuracy_card, sides_of
from phasemark.matcher.demo.run import (
    LANDMARK_XY_M,
    LIKELIHOOD,
    NEAREST,
    SHIFT_STEPS,
    WALL_M,
    CellResult,
    DemoResult,
    cell_rows,
    cells_csv,
    trials_csv,
)
from phasemark.matcher.figures import describe, match_figure, model_image
from phasemark.render import Renderer
from phasemark.render.figures import RANGE_COLOURS, draw_range, landmark_limits_m
from phasemark.render.view import delta_period_rad

_ANGLE_STYLES = (("#0072B2", "o", "-"), ("#D55E00", "s", "--"), ("#009E73", "^", ":"), ("#CC79A7", "D", "-."))
"""Colours that differ for the colour-blind, with marks and strokes that differ without colour."""


HALVES = (
    (True, LIKELIHOOD, "maximum likelihood, between grid points"),
    (True, NEAREST, "nearest image, between grid points"),
    (False, NEAREST, "nearest image, on the bank's grid"),
)
"""What was tried: whether between grid points, by which method, and how a page calls it; the most telling first."""
_FIGURE_DATA = {"matches": "matches.csv", "errors": "errors.csv", "classes": "classes.csv", "frames": "frames.csv"}
DEMO_FILES = ("report.html", "cells.csv", "trials.csv", *_FIGURE_DATA.values())
"""What :func:`write_demo` writes."""
_SAME_PLACE_M = 1e-6
_SECTIONS = (
    "Errors between grid points", "Matching", "Classes", "What the camera sees", "Every cell", "How it was made",
    "Make this page again",
)  # fmt: skip


def write_demo(result: DemoResult, folder: Path, *, force: bool = False) -> Path:
    """Write the files :data:`DEMO_FILES` into a folder; returns the report's path.

    Raises
    ------
    OutputExistsError, StorageError
        As in :func:`phasemark.data.files.write_atomically`.
    """
    figures = _figures(result)
    write_atomically(folder / "cells.csv", cells_csv(result.cells).encode(), force=force)
    write_atomically(folder / "trials.csv", trials_csv(result.cells).encode(), force=force)
    for name, file in _FIGURE_DATA.items():
        write_atomically(folder / file, figure_csv(*figures[name]), force=force)
    return write_atomically(folder / "report.html", _page(result, figures).encode(), force=force)


def demo_report(result: DemoResult) -> str:
    """Return the report of a demo as HTML that loads nothing.

    Parameters
    ----------
    result : DemoResult

    Returns
    -------
    str
    """
    return _page(result, _figures(result))


def _figures(result: DemoResult) -> dict[str, list[Figure]]:
    """Draw every figure, by the part of the page that shows it."""
    shown = _shown_matches(result)
    return {
        "matches": [
            match_figure(r.filtered, r.matches[k], result.bank, result.background, k, title=False) for _, r, k in shown
        ],
        "errors": [_error_figure(result)],
        "classes": [_confusion_figure(result)],
        "frames": [_frame_figure(result, r) for r in _shown_frames(result)],
    }


def _page(result: DemoResult, figures: dict[str, list[Figure]]) -> str:
    halves = [
        {"name": f"{title[:1].upper()}{title[1:]}", "rows": cell_rows(result.select(shifted=shifted, method=method))}
        for shifted, method, title in HALVES
        if shifted  # on grid points all errors are 0, which the summary says in a sentence
    ]
    frames = zip(_shown_frames(result), figures["frames"], strict=True)
    matches = zip(_shown_matches(result), figures["matches"], strict=True)
    return page_template("phasemark.matcher.demo", "page.html.j2").render(
        answer=answer(result),
        card=_card(result),
        summary=_summary(result),
        contents=_SECTIONS,
        data=_FIGURE_DATA,
        gallery=[
            {
                "name": r.cell.class_name,
                "view": f"D = {100 * r.cell.distance_m:g} cm, δ = {math.degrees(r.cell.delta_rad):g}°",
                "frame": _image(figure, f"Filtered range image of the {r.cell.class_name}"),
                "mesh": embedded_png(mesh_figure(result.bank.mesh(r.cell.class_name)), f"The {r.cell.class_name}"),
            }
            for r, figure in frames
        ],
        range_colours=RANGE_COLOURS,
        matches=[
            {
                "title": title,
                "found": f"Repetition {k}, {r.method}: {describe(r.matches[k])}",
                "picture": _image(figure, f"Measured, model and residual: {title}"),
            }
            for (title, r, k), figure in matches
        ],
        confusion=_image(figures["classes"][0], "Confusion matrix of the classes"),
        errors=_image(figures["errors"][0], "Errors of distance, angle and position between grid points"),
        halves=halves,
        shift=f"{SHIFT_STEPS:g}",
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
        commands=[f"phasemark demo --seed {result.seed} --out DIR"],
    )


def on_grid(result: DemoResult) -> str:
    """State in one sentence how often the nearest image was that of the true grid point.

    Parameters
    ----------
    result : DemoResult

    Returns
    -------
    str
    """
    results = result.select(shifted=False)
    total = sum(len(r.matches) for r in results)
    exact = sum(int((r.class_right & (r.position_error_m < _SAME_PLACE_M)).sum()) for r in results)
    return (
        f"it found the true grid point in {exact} of {total} trials. That error of 0 says nothing about its accuracy,"
        " because its answers are grid points."
    )


def _middle(result: DemoResult) -> list[CellResult]:
    """Return the cells of maximum likelihood at the middle distance."""
    found = result.select(shifted=True, method=LIKELIHOOD)
    distances = sorted({r.cell.distance_m for r in found})
    return [r for r in found if r.cell.distance_m == distances[len(distances) // 2]]


def answer(result: DemoResult) -> str:
    """State in one sentence the accuracy of maximum likelihood at the middle distance, between grid points.

    Parameters
    ----------
    result : DemoResult

    Returns
    -------
    str
    """
    own = _middle(result)
    right = sum(int(r.class_right.sum()) for r in own)
    total = sum(len(r.matches) for r in own)
    distance, delta = (
        float(np.sqrt(np.nanmean(np.concatenate(errors) ** 2)))
        for errors in ([r.distance_error_m for r in own], [r.delta_error_rad for r in own])
    )
    return (
        f"At {own[0].cell.distance_m:.4g} m, before a wall at {WALL_M:g} m, you get {1e3 * distance:.2g} mm and"
        f" {math.degrees(delta):.2g}° (1 σ) with {LIKELIHOOD}; class right"
        f" {100 * right / total:.4g} % of {total} trials."
    )


def _card(result: DemoResult) -> str:
    """State in one line the bound at the middle distance, for the first class."""
    specs, sensor = catalog(), result.bank.sensor
    first, *others = (
        (name, Renderer(build_mesh(specs[name]), sensor, albedo=specs[name].albedo)) for name in result.bank.classes
    )
    card = accuracy_card(
        first[1],
        sides_of(_middle(result)[0].cell.distance_m, delta_period_rad(specs[first[0]].symmetry)),
        others=dict(others),
        n_frames=result.n_frames,
        background=result.background,
    )
    return f"{first[0]} {card.line()}"


def _summary(result: DemoResult) -> list[str]:
    """Summarise the results in a few sentences."""
    sentences = []
    for shifted, method, title in HALVES:
        if not shifted:
            sentences.append(f"{title[:1].upper()}{title[1:]}: {on_grid(result)}")
            continue
        results = result.select(shifted=shifted, method=method)
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
            f"{title[:1].upper()}{title[1:]}: the class was right in {right} of {total} trials; the median error was"
            f" {distance} mm in distance (worst {distance_worst}), {delta}° in angle (worst {delta_worst}) and"
            f" {position} mm in the robot's position (worst {position_worst})."
        )
    worst = _worst_cell(result)
    refused = sum(int((~r.matches.accepted).sum()) for r in result.cells)
    sentences.append(
        f"The largest position error came from the {_cell_name(worst)} with the method {worst.method}, and {refused} of"
        f" {sum(len(r.matches) for r in result.cells)} matches did not pass the test of their fit."
    )
    return sentences


def _worst_cell(result: DemoResult) -> CellResult:
    return max(result.cells, key=lambda r: float(np.nan_to_num(r.position_error_m, nan=np.inf).max()))


def _cell_name(result: CellResult) -> str:
    cell = result.cell
    return f"{cell.class_name} at D = {100 * cell.distance_m:g} cm, δ = {math.degrees(cell.delta_rad):g}°"


def _shown_frames(result: DemoResult) -> list[CellResult]:
    """Return a cell of each class, whose filtered frame is shown."""
    results = result.select(shifted=True, method=LIKELIHOOD)
    own = ([r for r in results if r.cell.class_name == name] for name in result.bank.classes)
    return [each[len(each) // 2] for each in own]


def _frame_figure(result: DemoResult, shown: CellResult) -> Figure:
    """Draw a filtered frame, its colours spanning the landmark."""
    figure = Figure(figsize=(3.9, 3.3), layout="constrained")
    axes = figure.add_subplot(title=shown.cell.class_name)
    near, far = None, None
    if math.isfinite(shown.matches[0].distance_m):
        near, far = landmark_limits_m(*model_image(result.bank, shown.matches[0], result.background))
    draw_range(axes, shown.filtered.range_m[0], near_m=near, far_m=far)
    return figure


def _shown_matches(result: DemoResult) -> list[tuple[str, CellResult, int]]:
    """Return title, cell and repetition of the matches that are shown: three of maximum likelihood, and the worst."""
    found = result.select(shifted=True, method=LIKELIHOOD)
    picked = [found[k * (len(found) - 1) // 2] for k in range(3)]
    worst = _worst_cell(result)
    return [
        *((_cell_name(r), r, 0) for r in picked),
        (f"The worst trial: {_cell_name(worst)}", worst, int(worst.position_error_m.argmax())),
    ]


def _confusion_figure(result: DemoResult) -> Figure:
    """Draw true against found class between grid points, for both methods."""
    names = [*result.bank.classes, "none"]
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    for axes, method in zip(figure.subplots(1, 2), (LIKELIHOOD, NEAREST), strict=True):
        counts = np.zeros((len(names) - 1, len(names)), int)
        for r in result.select(shifted=True, method=method):
            for found in r.matches.class_name:
                counts[names.index(r.cell.class_name), names.index(found or "none")] += 1
        axes.imshow(counts, cmap="Blues", vmin=0, vmax=max(int(counts.max()), 1))
        for (row, col), count in np.ndenumerate(counts):
            dark = count > 0.6 * counts.max()
            axes.text(col, row, str(count), ha="center", va="center", color="white" if dark else "black")
        axes.set_xticks(range(len(names)), names, rotation=30)
        axes.set_yticks(range(len(names) - 1), names[:-1])
        axes.set(title=method, xlabel="found", ylabel="true class")
    return figure


def _error_figure(result: DemoResult) -> Figure:
    """Draw errors between grid points, a row a method: median over classes and trials, bars from 5 to 95 %."""
    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True)
    quantities: tuple[tuple[str, Callable[[CellResult], NDArray[np.float64]]], ...] = (
        ("|ΔD| (mm)", lambda r: 1e3 * np.abs(r.distance_error_m)),
        ("|Δδ| (°)", lambda r: np.degrees(np.abs(r.delta_error_rad))),
        ("position error (mm)", lambda r: 1e3 * r.position_error_m),
    )
    for row, method in zip(panels, (LIKELIHOOD, NEAREST), strict=True):
        results = result.select(shifted=True, method=method)
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
            axes.set_title(method)
            axes.set_ylabel(label)
            axes.grid(alpha=0.3)
        row[0].legend(frameon=False)
        for axes in row:  # each row has a scale of its own: the methods differ by a factor of ten
            axes.set_ylim(bottom=0)
    for axes in panels[-1]:
        axes.set_xlabel("distance D (cm)")
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
