"""Compare the estimates of a recording before a panel with the poses of motion capture.

``python examples/score_recording.py est.csv second_poses.csv``

The first file is that of ``phasemark match --moving --fix bearing --estimates``, the second that of
``examples/split_recording.py``. Printed are, of the frames that face the panel within 45° of its normal, the share
answered, bias (median error), MAD and r.m.s. about the bias of distance and heading, median standard deviations, how
many truths lie inside the stated 95 % ellipse, and how many accepted answers are off by more than 30 mm or 6°. None
of n leaves at most 3/n at 95 %. The longest run of n answers within 30 mm and 6° shows a reliability R with confidence
C by n = ln(1 − C)/ln R, as ASTM F3499-21 counts them.
"""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

THICKNESS_M, FACING_DEG, GROSS_M, GROSS_DEG = 0.01, 45.0, 0.03, 6.0
CONFIDENCE, INSIDE_95 = 0.95, 5.991
Floats = NDArray[np.float64]


def columns(path: Path) -> dict[str, list[str]]:
    """Return the cells of a table by column."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] for row in rows] for name in (rows[0] if rows else ())}


def numbers(table: dict[str, list[str]], name: str) -> Floats:
    """Return a column as numbers, NaN where a cell is empty."""
    return np.array([float(cell or "nan") for cell in table[name]])


def errors(estimates: dict[str, list[str]], poses: dict[str, list[str]]) -> tuple[Floats, Floats, Floats]:
    """Return errors in distance from the panel's front (m) and heading (°), (n, 2), covariances, and true headings."""
    time, t_ms = numbers(estimates, "pose_time_s"), numbers(poses, "t_ms")
    stamps, first = np.unique(t_ms / 1e3, return_index=True)
    x = np.interp(time, stamps, -numbers(poses, "x_m")[first], left=np.nan, right=np.nan)
    heading = np.interp(time, stamps, np.unwrap(numbers(poses, "heading_deg")[first], period=360))
    distance, delta = numbers(estimates, "distance_m"), numbers(estimates, "delta_deg")
    delta = (delta + 90) % 180 - 90  # the panel looks the same every 180°
    slope = -distance * np.sin(np.radians(delta)) * np.radians(1)
    jacobian = np.stack([np.cos(np.radians(delta)), slope, 0 * delta, 1 + 0 * delta], axis=1).reshape(-1, 2, 2)
    std = np.stack([numbers(estimates, f"{name}_std_{unit}") for name, unit in (("distance", "m"), ("delta", "deg"))])
    covariance = np.einsum("in,jn->nij", std, std)
    covariance[:, [0, 1], [1, 0]] *= numbers(estimates, "corr_distance_delta")[:, None]
    error = np.stack([distance * np.cos(np.radians(delta)) - THICKNESS_M / 2 - x, delta - heading], axis=1)
    error[:, 1] = (error[:, 1] + 180) % 360 - 180
    return error, jacobian @ covariance @ jacobian.transpose(0, 2, 1), (heading + 180) % 360 - 180


def longest_run(good: NDArray[np.bool_]) -> int:
    """Return the length of the longest run of True."""
    ends = np.flatnonzero(~np.concatenate([[False], good, [False]]))
    return int(np.diff(ends).max()) - 1


def report(estimates: dict[str, list[str]], poses: dict[str, list[str]]) -> str:
    """Say how estimates agree with the poses."""
    error, covariance, heading = errors(estimates, poses)
    known = np.isfinite(error).all(axis=1)
    accepted = np.array([cell == "true" for cell in estimates["accepted"]])
    truth = np.isfinite(heading) & (np.abs(heading) < FACING_DEG)
    used = accepted & truth & known
    gross = accepted & known & ((np.abs(error) > [GROSS_M, GROSS_DEG]).any(axis=1))
    n = int((accepted & known).sum())
    if not used.any():
        return "no accepted frame faces the panel and has a truth to compare with"
    bias = np.median(error[used], axis=0)
    mad = np.median(np.abs(error[used] - bias), axis=0)
    rms = np.sqrt(((error[used] - bias) ** 2).mean(axis=0))
    std = np.median(np.sqrt(np.einsum("nii->ni", covariance[used])), axis=0)
    squared = np.einsum("ni,nij,nj->n", error[used], np.linalg.inv(covariance[used]), error[used])
    run = longest_run(~gross[accepted & known])
    lines = [
        f"answered: {used.sum()} of {truth.sum()} frames that face the panel ({100 * used.sum() / truth.sum():.0f} %)",
        *(
            f"{name}: bias {scale * bias[k]:.2f}, MAD {scale * mad[k]:.2f}, r.m.s. about the bias"
            f" {scale * rms[k]:.2f}, median standard deviation {scale * std[k]:.2f}"
            for k, (name, scale) in enumerate((("distance (mm)", 1e3), ("heading (°)", 1.0)))
        ),
        f"truth inside the 95 % ellipse: {100 * (squared < INSIDE_95).mean():.0f} %",
        f"accepted beyond 30 mm or 6°: {gross.sum()} of {n}"
        + (f", so at most {300 / n:.2g} % at 95 %" if not gross.any() else ""),
        f"longest run without one: {run}, which shows a reliability of {100 * (1 - CONFIDENCE) ** (1 / run):.1f} % with"
        f" a confidence of {100 * CONFIDENCE:.0f} %",
    ]
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("estimates", type=Path, help="table of phasemark match --estimates")
    parser.add_argument("poses", type=Path, help="poses of motion capture")
    arguments = parser.parse_args(argv)
    try:
        print(report(columns(arguments.estimates), columns(arguments.poses)))
    except KeyError as error:
        print(f"error: no column {error} in {arguments.estimates} or {arguments.poses}", file=sys.stderr)
        return 3
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main())
