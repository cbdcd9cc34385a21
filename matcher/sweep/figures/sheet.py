"""The figures of a sweep that its axes and methods allow, each with words on how to read it.

Every axis has its unit; every share, mean and root mean square has its 95 % interval.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from matplotlib.figure import Figure

from phasemark.matcher.sweep.figures import errors, trust
from phasemark.matcher.sweep.figures.style import AXIS_LABEL
from phasemark.matcher.sweep.plan import SweepPlan
from phasemark.matcher.sweep.result_tables import Cell, SweepTrials, condition_axes

_AGAINST_AXIS = (
    "Above, marks: root mean square error with its 95 % interval, outliers left out; dotted: the Cramér–Rao bound. "
    "Below: mean error. The other axes are pooled, by the median cell above and the mean below; a design that varies "
    "each axis alone keeps them at their first value."
)
_THRESHOLD = (
    " Where errors leave the bound, the noise is past the threshold: more of it moves matches to side peaks or takes "
    "pixels away."
)
_WORDS = {
    "map-ratio": (
        "Error over bound, by distance and angle",
        "1 is the best an unbiased method can do. The colours are the same in every report, from a quarter to four "
        "times. Each cell is the median over the other axes.",
    ),
    "map-rmse": (
        "Error by distance and angle",
        "Root mean square error without outliers; below it, their share, where there are any. Each cell is the median "
        "over the other axes.",
    ),
    "bias-arrows": (
        "Bias by distance and angle",
        "Arrows: mean error, to the right in δ and upwards in D, 1° as long as 1 mm; grey where its 95 % interval "
        "contains 0.",
    ),
    "observability": (
        "Weak direction of the bound",
        "Left: condition number of the bound, lengths in centimetres and angles in degrees; 1: D and δ are known "
        "equally well. Right: the weak direction and the standard deviation along it.",
    ),
    "position-in-cell": (
        "Error against the position in a cell of the bank",
        "Mean error with its 95 % interval where nothing but the view is unknown. A nearest image answers with its "
        "grid point: the error falls as the truth moves on, and jumps where the next point is nearer. Interpolation "
        "shows as a curve that is not 0.",
    ),
    "models": (
        "The nearest image by the bank's model",
        "Exact images with mixed pixels, the same without them (each pixel as its centre ray sees it), and the "
        "paper's planar generator; outliers are left out and counted.",
    ),
    "nees": (
        "Test of the stated covariance",
        "Quantiles of the squared error by the method's own covariance, against χ². On the diagonal the covariance "
        "is right; above it, too small. The axis is cut at one and a half times its neighbour.",
    ),
    "coverage": (
        "Coverage of the ellipsoids",
        "Share of errors within the ellipsoid of 50, 90, 95 and 99 % that a method states, cell by cell with 95 % "
        "intervals. Lines: the stated shares.",
    ),
    "confusion": (
        "Classes",
        "Share of an object's trials by the class found. Refused: no landmark, or a fit that failed its test.",
    ),
    "confusion-bound": (
        "Wrong classes beside their bound",
        "Each mark is a cell. On the line a method errs as often as the union bound allows with a perfect model; a "
        "mark that points down is the interval's upper end of a cell in which no class was wrong.",
    ),
    "risk": (
        "Risk against coverage",
        "Root mean square error in distance of the trials kept, if only those with the best p-values are kept. A curve "
        "that falls to the left shows that bad matches have small p-values.",
    ),
    "roc": (
        "Landmark or none",
        "Landmarks accepted against strangers accepted, as the least p-value varies. The mark with its 95 % "
        "intervals is the matcher's threshold, which by design refuses a share of good landmarks.",
    ),
}
"""Title and text of each figure but those against an axis, by the name of its files."""


class SweepFigure(NamedTuple):
    """A figure with what it shows in words.

    Parameters
    ----------
    name : str
        Of its files.
    title, text : str
    figure : Figure
    """

    name: str
    title: str
    text: str
    figure: Figure


def sweep_figures(plan: SweepPlan, trials: SweepTrials, cells: Sequence[Cell]) -> Iterator[SweepFigure]:
    """Yield the figures of a sweep."""
    cells = [cell for cell in cells if not cell.stranger]
    axes = [name for name in condition_axes([cell.condition for cell in cells]) if name != "class_name"]
    for axis in axes if plan.design != "sobol" else ():
        text = _AGAINST_AXIS + _THRESHOLD * (axis in ("noise_factor", "n_frames"))
        text += " While they follow it, four times the frames halve them." * (axis == "n_frames")
        name, title = f"rmse-{axis.replace('_', '-')}", f"Errors against {AXIS_LABEL[axis]}"
        yield SweepFigure(name, title, text, errors.against_axis(cells, axis, axes))
    for name, figure in _drawn(plan, trials, cells, axes):
        yield SweepFigure(name, *_WORDS[name], figure)


def _drawn(
    plan: SweepPlan, trials: SweepTrials, cells: Sequence[Cell], axes: Sequence[str]
) -> Iterator[tuple[str, Figure]]:
    """Yield the figures that need no axis of their own."""
    if {"distance_m", "delta_deg"} <= set(axes) and plan.design == "grid":
        yield "map-ratio", errors.maps(cells, "ratio")
        yield "map-rmse", errors.maps(cells, "rmse")
        yield "bias-arrows", errors.bias_arrows(cells)
        yield "observability", errors.observability(cells)
    yield "position-in-cell", errors.position_in_cell(trials, plan.methods, plan.bank_distance_m[0])
    if len({method.bank_model for method in plan.methods if method.method == "nearest"}) > 1:
        yield "models", errors.model_comparison(trials, plan.methods)
    if any(math.isfinite(cell.coverage[0.95].value) for cell in cells):
        yield "nees", trust.nees_quantiles(trials)
        yield "coverage", trust.coverage(cells)
    yield "confusion", trust.confusion(trials)
    if any(math.isfinite(cell.confusion_bound) for cell in cells) and len(trials.classes) > 1:
        yield "confusion-bound", trust.confusion_bound(cells)
    yield "risk", trust.risk(trials)
    strange = trials.true_class < 0
    if strange.any() and not strange.all():
        yield "roc", trust.roc(trials)
