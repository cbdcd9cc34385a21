"""Matches and robot poses as rows of a table and as plain numbers."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from phasemark.render import Background


def pose_text(pose: Mapping[str, Any]) -> str:
    """Return a pose as text, each number ± its standard deviation where there is one."""
    name = f"{pose['landmark']}: " if "landmark" in pose else ""
    std = pose["std"]
    if std is None:
        return f"{name}({pose['x_m']:.3f}, {pose['y_m']:.3f}) m heading {pose['heading_deg']:.2f}°"
    return (
        f"{name}({pose['x_m']:.4f} ± {std['x_m']:.4f}, {pose['y_m']:.4f} ± {std['y_m']:.4f}) m"
        f" heading {pose['heading_deg']:.2f} ± {std['heading_deg']:.2f}°"
    )


_COLUMNS = {
    "distance_m": ("D (m)", ".3f"),
    "delta_deg": ("δ (°)", ".2f"),
    "bearing_deg": ("bearing (°)", ".2f"),
    "height_m": ("height (m)", ".3f"),
    "pitch_deg": ("pitch (°)", ".2f"),
    "roll_deg": ("roll (°)", ".2f"),
}
"""Parameters of a view: title of their column, and the form of a value without a standard deviation."""


@dataclass(frozen=True)
class Columns:
    """Columns of the table of a match: what was asked for, and what distinguishes its rows.

    Parameters
    ----------
    counted : str or None
        What a row is, "frame" or "position"; None where there is one row alone.
    free : sequence of str
        Parameters that were estimated, as :class:`~phasemark.matcher.Match` names them.
    background : Background or str or None
        What was stated; "auto", "any": what each match found; "unknown"; None: no such column.
    robot : bool
        Whether the robot was placed.
    """

    counted: str | None
    free: Sequence[str]
    background: Background | str | None
    robot: bool


def _estimated(answer: dict[str, Any], name: str, form: str) -> str:
    """Return one parameter of a match as text: with its standard deviation if the match is accepted and has one."""
    from phasemark.render.integral.rounding import with_error

    value: float = answer[name]
    if not answer["accepted"] or answer["covariance"] is None:
        return f"{value:{form}}"
    k = answer["free"].index(name)
    return with_error(value, math.sqrt(answer["covariance"][k][k]))


def _refusal(answer: dict[str, Any]) -> str:
    """Return the word for a refused match, and why it is refused."""
    return "refused" + (f": {answer['reason']}" if answer["reason"] and answer["class"] is not None else "")


def _background(answer: dict[str, Any], background: Background | str) -> str:
    """Return the planes that a match assumed or found behind the landmark, in words."""
    if answer["among_unknown"]:
        return "unknown"
    planes: dict[str, float | None] = {}
    for name in ("wall", "floor"):
        planes[name] = answer[f"{name}_m"] if isinstance(background, str) else getattr(background, f"{name}_m")
    return ", ".join(f"{name} {metres:.4g} m" for name, metres in planes.items() if metres is not None) or "none"


def match_rows(answers: Sequence[dict[str, Any]], start: int, columns: Columns) -> list[dict[str, str]]:
    """Return one row of the table a match, by column."""
    from phasemark.matcher.match import named_in_degrees

    rows = []
    for k, answer in enumerate(answers, start):
        found = answer["class"] is not None
        row = {}
        if columns.counted is not None:
            row[columns.counted] = str(k)
            if "time_s" in answer:
                row["time (s)"] = f"{answer['time_s']:.3f}"
        row["class"] = answer["class"] or "no landmark"
        for parameter in columns.free:
            name = named_in_degrees(parameter)
            title, form = _COLUMNS[name]
            row[title] = _estimated(answer, name, form) if found else ""
        if columns.background is not None:
            row["background"] = _background(answer, columns.background)
        row["accepted"] = "yes" if answer["accepted"] else _refusal(answer)
        row["p"] = "" if answer["p_value"] is None else f"{answer['p_value']:.2g}"
        if columns.robot:
            row["robot"] = "  or  ".join(pose_text(pose) for pose in answer.get("poses", ()))
        rows.append(row)
    return rows


def summary(reasons: Sequence[str], counted: str) -> str:
    """Return how many answers were accepted, and why the others were not, the most frequent reason first.

    Parameters
    ----------
    reasons : sequence of str
        Of each answer, empty where it was accepted.
    counted : str
        What has an answer: "frame" or "position".
    """
    count = Counter(reasons)
    accepted = count.pop("", 0)
    refused = ", ".join(f"{n} {reason}" for reason, n in count.most_common())
    return f"{accepted} of {len(reasons)} {counted}s accepted" + (f"; refused: {refused}" if refused else "")


def bank_ends(found_m: Sequence[float], grid_m: Sequence[float], counted: str) -> list[str]:
    """Return a sentence for each end of a bank's distances where answers pile up.

    Parameters
    ----------
    found_m : sequence of float
        Distance of each answer, or of the best fit that was refused; NaN where there is none.
    grid_m : sequence of float
        Distances of the bank, ascending.
    counted : str
        What has an answer: "frame" or "position".
    """
    known = [distance_m for distance_m in found_m if not math.isnan(distance_m)]
    first, last = grid_m[0], grid_m[-1]
    ends = (
        (sum(distance_m <= first + 1e-9 for distance_m in known), f"begins at {first:g} m", "nearer"),
        (sum(distance_m >= last - 1e-9 for distance_m in known), f"ends at {last:g} m", "farther"),
    )
    many = 0.1  # share of answers at an end of a bank from which it is worth a note
    piled_up = 3.0  # ratio to the share that each distance of the bank would have if all were equally frequent
    least = max(many, piled_up / len(grid_m)) * len(known)
    return [
        f"the bank {where}, where {n} of {len(known)} {counted}s have their best fit: if the landmark may be {further},"
        " build it with a wider --distance"
        for n, where, further in ends
        if n and n >= least
    ]
