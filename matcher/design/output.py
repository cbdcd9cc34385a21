"""Files of a design: landmarks for other commands, tables, pictures and meshes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import trimesh

from phasemark.data.files.atomic_write import write_files
from phasemark.data.files.csv_cell import csv_text, nine_digits
from phasemark.data.files.json_text import finite_or_none, json_text
from phasemark.data.pages.page import figure_png
from phasemark.inputs.toml_file import toml_value
from phasemark.landmarks import LandmarkSpec, build_mesh, export_mesh
from phasemark.landmarks.spec import Box
from phasemark.matcher.accuracy.cramer_rao import confusion_probability
from phasemark.matcher.design.confirm import Confirmation
from phasemark.matcher.design.measures import RangeBound
from phasemark.matcher.design.plan import DesignPlan
from phasemark.matcher.design.rules import Check
from phasemark.matcher.design.search import Candidate, Design, Scored
from phasemark.matcher.statistics import ratio_interval

Confirmed = tuple[Confirmation, Confirmation]
"""Of the result and of the catalogue."""


def output_names(plan: DesignPlan) -> list[str]:
    """Return the files that :func:`write_design` writes."""
    marks = [f"mark-{k + 1}.stl" for k in range(plan.n_classes)]
    return ["landmarks.toml", "pareto.csv", "design.json", "pareto.png", "bound.png", *marks]


def landmarks_toml(design: Design) -> str:
    """Return the set as the plan of a bank: ``phasemark bank build landmarks.toml`` takes it."""
    lines = ["# Landmarks found by `phasemark landmark design`; the plan of a bank of them.", ""]
    plan = design.plan
    lines.append(f"sensor = {toml_value(_sensor_reference(plan))}")
    lines += [f"distance_m = {toml_value(f'{0.9 * plan.distance_m[0]:.3g}:{1.1 * plan.distance_m[1]:.3g}:0.01')}", ""]
    overrides = _sensor_overrides(design)
    if overrides:
        lines += ["[sensor_overrides]", *(f"{key} = {toml_value(value)}" for key, value in overrides.items()), ""]
    for spec in design.result.specs:
        table = spec.model_dump(mode="json", exclude_none=True)
        lines += ["[[landmarks]]", f"name = {toml_value(spec.name)}", f"albedo = {spec.albedo!r}"]
        for part in ("box", "upper"):
            lines += [f"[landmarks.{part}]", *(f"{key} = {toml_value(value)}" for key, value in table[part].items())]
        lines.append("")
    return "\n".join(lines)


def _sensor_reference(plan: DesignPlan) -> str:
    return "pmd-16x16" if plan.sensor.endswith(".toml") or "/" in plan.sensor else plan.sensor


def _sensor_overrides(design: Design) -> Mapping[str, Any]:
    """Return the fields that the sensor's name does not fix: all of them, if it is a file that may move."""
    plan = design.plan
    if _sensor_reference(plan) == plan.sensor:
        return plan.sensor_overrides
    return design.search.sensor.model_dump(mode="json", exclude_none=True)


def pareto_rows(design: Design) -> list[dict[str, Any]]:
    """Return one row a box: dimensions, bounds, distances, the rules it breaks; best first, the catalogue last."""
    front = set(map(id, design.front()))
    rows = []
    for candidate in sorted(design.candidates, key=lambda c: (not c.feasible, c.bound.worst_m)):
        kind = "chosen" if candidate is design.chosen else "refined" if candidate.refined else "tried"
        rows.append(_row(kind, candidate.box, candidate, candidate.bound, id(candidate) in front, candidate.checks))
    known = design.catalogue
    box, checks = known.specs[0].box, itertools.chain(*known.checks.values())
    return [*rows, _row("catalogue", box, known, design.search.bound(box), False, checks)]


def _row(
    kind: str, box: Box, of: Candidate | Scored, bound: RangeBound, on_front: bool, checks: Iterable[Check]
) -> dict[str, Any]:
    broken = dict.fromkeys(check.rule for check in checks if not check.passes)
    return {
        "box": kind,
        **box.model_dump(),
        "symmetry": of.symmetry,
        **_bound_facts(bound),
        "class_distance": of.class_distance,
        "turn_distance": of.turn_distance,
        "on_front": on_front,
        "broken_rules": "; ".join(broken),
    }


def _bound_facts(bound: RangeBound) -> dict[str, float]:
    return {
        "worst_position_bound_m": bound.worst_m,
        "median_position_bound_m": bound.median_m,
        "worst_distance_bound_m": float(bound.distance_std_m.max()),
        "worst_delta_bound_deg": math.degrees(float(bound.delta_std_rad.max())),
        "at_distance_m": bound.worst_view[0],
        "at_delta_deg": math.degrees(bound.worst_view[1]),
    }


def pareto_csv(design: Design) -> str:
    """Return :func:`pareto_rows` as a table; what is infinite is left empty."""
    rows = pareto_rows(design)
    return csv_text([list(rows[0]), *(list(map(nine_digits, row.values())) for row in rows)])


def summary(design: Design, confirmed: Confirmed | None) -> dict[str, Any]:
    """Return the figures of a design as plain numbers, for JSON; None where there is nothing to tell."""
    facts: dict[str, Any] = {
        "bound": "Cramér–Rao, lower pixels, ranges, (D, δ) free, no background; the root of the trace of the position's"
        " covariance",
        "bound_factor": design.factor,
        "result": _scored_facts(design.result),
        "catalogue": _scored_facts(design.catalogue),
        "confirmation": None,
        "plan": design.plan.model_dump(mode="json"),
    }
    if confirmed is not None:
        new, known = confirmed
        facts["confirmation"] = {
            "frames_averaged": design.plan.n_frames,
            "result": _confirmation_facts(new),
            "catalogue": _confirmation_facts(known),
            "worst_rmse_factor": asdict(ratio_interval(known.worst.rmse(0), new.worst.rmse(0))),
            "rmse_factor_at_the_worst_bounds": asdict(ratio_interval(known.sides.rmse(-1), new.sides.rmse(-1))),
        }
    return finite_or_none(facts)


def _scored_facts(scored: Scored) -> dict[str, Any]:
    rows = scored.class_distances
    names = [spec.name for spec in scored.specs]
    return {
        "landmarks": [spec.model_dump(mode="json") for spec in scored.specs],
        "symmetry": scored.symmetry,
        **_bound_facts(scored.bound),
        "least_class_distance": scored.class_distance,
        "class_distances": {a: {b: float(rows[i, j]) for j, b in enumerate(names)} for i, a in enumerate(names)},
        "confusion_bound": {
            a: float(confusion_probability([rows[i, j] ** 2 for j in range(len(names)) if j != i]))
            for i, a in enumerate(names)
        },
        "turn_distance": scored.turn_distance,
        "rules": {
            name: [
                {
                    "rule": check.rule,
                    "value": float(check.value),
                    "at_most" if check.at_most else "at_least": check.limit,
                    "unit": check.unit,
                    "kept": check.passes,
                }
                for check in checks
            ]
            for name, checks in scored.checks.items()
        },
    }


def _confirmation_facts(confirmation: Confirmation) -> dict[str, Any]:
    sides, worst, anywhere = confirmation.sides, confirmation.worst, confirmation.anywhere
    return {
        "distance_m": float(sides.distance_m[0, 0]),
        "sides": [
            {
                "delta_deg": math.degrees(float(sides.delta_rad[k, 0])),
                "bound_m": float(sides.bound_m[k, 0]),
                "rmse_m": asdict(sides.rmse(k)),
            }
            for k in range(len(sides.error_m))
        ],
        "n_per_side": sides.error_m.shape[1],
        "worst": {
            "delta_deg": math.degrees(float(worst.delta_rad[0, 0])),
            "n": worst.error_m.size,
            "bound_m": float(worst.bound_m[0, 0]),
            "rmse_m": asdict(worst.rmse(0)),
        },
        "anywhere": {
            "n": anywhere.error_m.size,
            "rmse_m": asdict(anywhere.rmse(0)),
            "rmse_over_bound": asdict(anywhere.efficiency),
            "class_errors": asdict(anywhere.class_errors),
        },
        "rmse_over_bound": asdict(sides.efficiency),
        "class_errors": asdict(sides.class_errors),
        "missed": asdict(sides.missed),
    }


def mesh_stl(spec: LandmarkSpec) -> bytes:
    """Return a landmark as STL in millimetres, as workshops and printers expect it."""
    mesh_tolerance_m = 1e-5
    mesh = build_mesh(spec, tolerance_m=mesh_tolerance_m)
    return export_mesh(trimesh.Trimesh(mesh.vertices * 1000, mesh.faces, process=False), "stl")


def write_design(design: Design, confirmed: Confirmed | None, folder: Path, *, force: bool = False) -> list[Path]:
    """Write :func:`output_names` into a folder that exists.

    Parameters
    ----------
    design : Design
        The design.
    confirmed : (Confirmation, Confirmation), optional
        Of the result and of the catalogue.
    folder : Path
        Folder that the files go to.
    force : bool
        Whether existing files may be replaced.

    Returns
    -------
    list of Path

    Raises
    ------
    OutputExistsError, StorageError
        A file cannot be written.
    """
    from phasemark.matcher.design.figures import bound_figure, pareto_figure  # matplotlib is slow to import

    facts = {**summary(design, confirmed), "pareto": [finite_or_none(row) for row in pareto_rows(design)]}
    contents = [
        landmarks_toml(design).encode(),
        pareto_csv(design).encode(),
        (json_text(facts, indent=2, allow_nan=False) + "\n").encode(),
        figure_png(pareto_figure(design)),
        figure_png(bound_figure(design, confirmed)),
        *map(mesh_stl, design.result.specs),
    ]
    return write_files(folder, dict(zip(output_names(design.plan), contents, strict=True)), force=force)
