"""Matches and robot poses as rows of a table and as plain numbers."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from phasemark.matcher import Match
    from phasemark.matcher.position.landmark_map import LandmarkMap


def pose_facts(
    match: Match,
    landmarks: LandmarkMap,
    any_class: bool,
    pan_rad: float,
    prior: tuple[float, float, float] | None,
    prior_std: tuple[float, float] | None,
) -> list[dict[str, Any]]:
    """Return the robot poses of a match as plain numbers, best first; none if there is no landmark."""
    from phasemark.matcher import robot_poses

    believed, covariance = None, None
    if prior is not None:
        believed = (prior[0], prior[1], math.radians(prior[2]))
    if prior_std is not None:
        xy, heading = prior_std[0] ** 2, math.radians(prior_std[1]) ** 2
        covariance = [[xy, 0.0, 0.0], [0.0, xy, 0.0], [0.0, 0.0, heading]]
    if any_class:
        only = landmarks.landmark[0]
        poses = robot_poses(match, only.xy_m, only.yaw_rad, pan_rad, prior=believed, prior_covariance=covariance)
        return [pose.as_dict() for pose in poses]
    placements = landmarks.poses(match, pan_rad, prior=believed, prior_covariance=covariance)
    return [{"landmark": placement.landmark.name, **placement.pose.as_dict()} for placement in placements]


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


def _estimated(answer: dict[str, Any], value: float, name: str, scale: float, form: str) -> str:
    """Return one parameter of a match as text: with its standard deviation if the match is accepted and has one."""
    from phasemark.render.integral.rounding import with_error

    if not answer["accepted"] or answer["covariance"] is None:
        return f"{value:{form}}"
    k = answer["free"].index(name)
    return with_error(value, scale * math.sqrt(answer["covariance"][k][k]))


def _refusal(answer: dict[str, Any]) -> str:
    """Return the word for a refused match, and why it is refused."""
    return "refused" + (f": {answer['reason']}" if answer["reason"] and answer["class"] is not None else "")


def match_rows(answers: Sequence[dict[str, Any]], start: int, moving: bool) -> list[dict[str, str]]:
    """Return one row of the table a match, by column."""
    rows = []
    for k, answer in enumerate(answers, start):
        found = answer["class"] is not None
        row = {"frame" if moving else "position": str(k)}
        if "time_s" in answer:
            row["time (s)"] = f"{answer['time_s']:.3f}"
        row |= {
            "class": answer["class"] or "no landmark",
            "D (m)": _estimated(answer, answer["distance_m"], "distance_m", 1.0, ".3f") if found else "",
            "δ (°)": _estimated(answer, answer["delta_deg"], "delta_rad", 180 / math.pi, ".2f") if found else "",
            "accepted": "yes" if answer["accepted"] else _refusal(answer),
            "p": "" if answer["p_value"] is None else f"{answer['p_value']:.3g}",
            "robot": "  or  ".join(pose_text(pose) for pose in answer.get("poses", ())),
        }
        rows.append(row)
    return rows
