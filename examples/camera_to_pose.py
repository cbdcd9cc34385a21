"""Draw the covariance ellipsoid of a pose of six numbers, as matching a recording found it.

``phasemark match BANK FRAMES --free bearing --free height --free pitch --free roll --json > pose.json``

``python examples/camera_to_pose.py pose.json --out out/pose.png``

Each panel is the shadow of the ellipsoid on two of the numbers: the inner ellipse holds both with 39 %, the outer one
with 95 %.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy import stats

from phasemark import InputFileError, PhasemarkError
from phasemark.data.files import write_atomically
from phasemark.render.png import figure_png

SHOWN = {
    "distance_m": ("D", "mm", 1e-3),
    "delta_deg": ("δ", "°", 1.0),
    "bearing_deg": ("bearing", "°", 1.0),
    "height_m": ("height", "mm", 1e-3),
    "pitch_deg": ("pitch", "°", 1.0),
    "roll_deg": ("roll", "°", 1.0),
}
"""Of each free number: its name, and the unit in which it is drawn with its size in the unit of the answer."""
ONE_SIGMA, WIDE = 1.0, math.sqrt(stats.chi2.ppf(0.95, 2))
"""Radii of the ellipses, in standard deviations."""


def read_match(path: Path) -> dict[str, Any]:
    """Return the first accepted match of what ``phasemark match --json`` printed."""
    try:
        matches = json.loads(path.read_text(encoding="utf-8"))["matches"]
        accepted = [match for match in matches if match["accepted"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputFileError(f"{path}: not what phasemark match --json prints ({error})") from None
    if not accepted:
        raise InputFileError(f"{path}: no match was accepted, so there is no pose to draw")
    return dict(accepted[0])


def ellipse(covariance: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """Return points of the ellipse of a (2, 2) covariance at a radius in standard deviations, (2, 121)."""
    turn = np.linspace(0, 2 * math.pi, 121)
    values, vectors = np.linalg.eigh(covariance)
    return radius * vectors @ (np.sqrt(np.maximum(values, 0))[:, None] * np.array([np.cos(turn), np.sin(turn)]))


def figure_of(match: dict[str, Any]) -> Figure:
    """Draw densities on the diagonal and ellipses of all pairs below it; the correlation stands above."""
    free = match["free"]
    size = np.array([SHOWN[name][2] for name in free])
    covariance = np.array(match["covariance"]) / np.outer(size, size)
    std = np.sqrt(np.diag(covariance))
    n = len(free)
    figure = Figure(figsize=(1.75 * n, 1.75 * n), layout="constrained")
    panels = figure.subplots(n, n, squeeze=False)
    for i in range(n):
        for j in range(n):
            axes = panels[i, j]
            across, unit, _ = SHOWN[free[j]]
            if j > i:
                axes.axis("off")
                correlation = covariance[i, j] / (std[i] * std[j])
                axes.text(0.5, 0.5, f"{correlation:+.2f}", ha="center", va="center", color="0.2", fontsize=11)
                continue
            reach = 3.2 * std[j]
            axes.set_xlim(-reach, reach)
            if i == j:
                x = np.linspace(-reach, reach, 121)
                axes.fill_between(x, stats.norm.pdf(x, scale=std[j]), color="#9ecae1")
                axes.set_yticks([])
                axes.set_ylim(0, None)
                axes.set_title(f"{across}: σ = {std[j]:.2g}{'' if unit == '°' else ' '}{unit}", fontsize=9)
            else:
                axes.set_ylim(-3.2 * std[i], 3.2 * std[i])
                for radius, color in ((WIDE, "#9ecae1"), (ONE_SIGMA, "#3182bd")):
                    axes.fill(*ellipse(covariance[np.ix_([j, i], [j, i])], radius), color=color)
            axes.xaxis.set_major_locator(MaxNLocator(3))
            axes.tick_params(labelsize=7, labelbottom=i == n - 1, labelleft=j == 0 and i > 0)
            if i == n - 1:
                axes.set_xlabel(f"{across} ({unit})", fontsize=9)
            if j == 0 and i > 0:
                axes.set_ylabel(f"{SHOWN[free[i]][0]} ({SHOWN[free[i]][1]})", fontsize=9)
    figure.suptitle("Errors of the pose: ellipses that hold two numbers with 39 % and 95 %; correlations above")
    return figure


def main() -> int:
    """Print the numbers with their standard deviations, and draw the ellipsoid."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("match", type=Path, help="what phasemark match --json printed, with a covariance")
    parser.add_argument("--out", type=Path, default=Path("out/pose.png"), help="the picture (%(default)s)")
    arguments = parser.parse_args()
    try:
        match = read_match(arguments.match)
        if match.get("covariance") is None:
            raise InputFileError(f"{arguments.match}: the match has no covariance: give --method refine")
        std = np.sqrt(np.diag(match["covariance"]))
        for name, error in zip(match["free"], std.tolist(), strict=True):
            title, unit, size = SHOWN[name]
            print(f"{title:8s} {match[name] / size:10.3f} ± {error / size:.2g} {unit}")
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(arguments.out, figure_png(figure_of(match), dpi=110), force=True)
    except (PhasemarkError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code if isinstance(error, PhasemarkError) else InputFileError.exit_code
    print(arguments.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
