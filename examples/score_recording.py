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
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.accuracy.pose_errors import PoseScore

THICKNESS_M, FACING_DEG, GROSS = 0.01, 45.0, (30.0, 6.0)
Floats = NDArray[np.float64]


def columns(path: Path) -> dict[str, list[str]]:
    """Return the cells of a table by column."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] for row in rows] for name in (rows[0] if rows else ())}


def numbers(table: dict[str, list[str]], name: str) -> Floats:
    """Return a column as numbers, NaN where a cell is empty."""
    return np.array([float(cell or "nan") for cell in table[name]])


@dataclass(frozen=True)
class Compared:
    """Estimates of a recording beside motion capture, a line each frame: millimetres and degrees."""

    error: Floats
    covariance: Floats
    accepted: NDArray[np.bool_]
    faces: NDArray[np.bool_]
    true_mm: Floats

    @property
    def score(self) -> PoseScore:
        """The score of the frames that face the panel."""
        return PoseScore.of(self.error, self.covariance, self.accepted, self.faces, GROSS)

    def answered(self, most_mm: float) -> tuple[int, int]:
        """Return how many frames that face the panel from nearer than that are answered, and how many there are."""
        near = self.faces & (np.abs(self.true_mm) <= most_mm)
        return int((near & self.accepted).sum()), int(near.sum())


def compared(estimates: dict[str, list[str]], poses: dict[str, list[str]]) -> Compared:
    """Compare distances from the panel's front and headings with those of motion capture."""
    time, t_ms = numbers(estimates, "pose_time_s"), numbers(poses, "t_ms")
    stamps, first = np.unique(t_ms / 1e3, return_index=True)
    x = np.interp(time, stamps, -numbers(poses, "x_m")[first], left=np.nan, right=np.nan)
    heading = np.interp(time, stamps, np.unwrap(numbers(poses, "heading_deg")[first], period=360))
    distance, delta = numbers(estimates, "distance_m"), numbers(estimates, "delta_deg")
    delta = (delta + 90) % 180 - 90  # the panel looks the same every 180°
    slope = -distance * np.sin(np.radians(delta)) * np.radians(1)
    jacobian = np.stack([np.cos(np.radians(delta)), slope, 0 * delta, 1 + 0 * delta], axis=1).reshape(-1, 2, 2)
    jacobian[:, 0] *= 1e3
    std = np.stack([numbers(estimates, f"{name}_std_{unit}") for name, unit in (("distance", "m"), ("delta", "deg"))])
    covariance = np.einsum("in,jn->nij", std, std)
    covariance[:, [0, 1], [1, 0]] *= numbers(estimates, "corr_distance_delta")[:, None]
    error = np.stack([1e3 * (distance * np.cos(np.radians(delta)) - THICKNESS_M / 2 - x), delta - heading], axis=1)
    error[:, 1] = (error[:, 1] + 180) % 360 - 180
    heading = (heading + 180) % 360 - 180
    return Compared(
        error=error,
        covariance=jacobian @ covariance @ jacobian.transpose(0, 2, 1),
        accepted=np.array([cell == "true" for cell in estimates["accepted"]]),
        faces=np.isfinite(x) & (np.abs(heading) < FACING_DEG),
        true_mm=1e3 * x,
    )


def report(score: PoseScore) -> str:
    """Describe how estimates agree with the poses."""
    return "\n".join([
        f"answered: {score.answered} of {score.expected} frames that face the panel"
        f" ({100 * score.answered / score.expected:.0f} %)",
        *(
            f"{name}: bias {score.bias[k]:.2f}, MAD {score.mad[k]:.2f}, r.m.s. about the bias {score.rms[k]:.2f},"
            f" median standard deviation {score.std[k]:.2f}"
            for k, name in enumerate(("distance (mm)", "heading (°)"))
        ),
        f"truth inside the 95 % ellipse: {100 * score.inside.value:.0f} %",
        f"accepted beyond 30 mm or 6°: {score.gross} of {score.accepted}, so at most"
        f" {100 * score.gross_at_most:.2g} % at 95 %",
        f"longest run without one: {score.run}, which shows a reliability of {100 * score.reliability:.1f} % with a"
        " confidence of 95 %",
    ])  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("estimates", type=Path, help="table of phasemark match --estimates")
    parser.add_argument("poses", type=Path, help="poses of motion capture")
    arguments = parser.parse_args(argv)
    try:
        print(report(compared(columns(arguments.estimates), columns(arguments.poses)).score))
    except KeyError as error:
        print(f"error: no column {error} in {arguments.estimates} or {arguments.poses}", file=sys.stderr)
        return 3
    except UsageError as error:
        print(error)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main())
