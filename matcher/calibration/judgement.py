"""Trust in a calibration: held-out residuals, ranges in which the model holds, and the likely cause of a misfit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.calibration.mounting_model import ALL_NAMES, PARAMETERS, SCALE, clipped
from phasemark.matcher.calibration.notes import TITLES
from phasemark.matcher.calibration.recording_fit import prior_std

TRUSTED = 3.0
"""Prior standard deviations beyond which a result is not trusted."""
_GREW = 1.02
"""Factor by which held-out residuals may grow: what counting other pixels may do."""
_MOST_LEFT_OUT = 0.5
"""Share of the pixels on the landmark that may disagree with the model."""
_BETTER = 0.5
"""Mean square of the residuals of an alternative, over that of what was assumed, from which it is the likely cause."""


def doubts_about(
    theta: NDArray[np.float64],
    assumed: NDArray[np.float64],
    free: Iterable[str],
    held_out_m: tuple[float, float],
    left_out: float = 0.0,
    *,
    scale: NDArray[np.float64] = SCALE,
) -> list[str]:
    """List the reasons why a calibration cannot be trusted.

    Parameters
    ----------
    theta, assumed : (21,) float64
        What was found, and what was assumed.
    free : iterable of str
    held_out_m : (before, after)
        Root mean square of held-out residuals, metres; NaN where it is not known.
    left_out : float
        Share of the pixels on the landmark that disagreed.
    scale : (21,) float64
        Natural units.

    Returns
    -------
    list of str
        Clauses; empty for a calibration that can be trusted.
    """
    doubts = []
    for name in free:
        if name == "albedo":
            continue
        k, parameter = ALL_NAMES.index(name), PARAMETERS[name]
        std = prior_std(name, assumed, scale)
        moved = theta[k] - assumed[k]
        at_bound = clipped(theta + 1e-9 * np.sign(moved))[k] != theta[k] + 1e-9 * np.sign(moved)
        if abs(moved) > TRUSTED * std or at_bound:
            space = "" if parameter.unit in ("", "°") else " "
            doubts.append(
                f"the {TITLES[name]} ran to {parameter.shown * theta[k]:.3g}{space}{parameter.unit}, more than"
                f" {parameter.shown * TRUSTED * std:.3g}{space}{parameter.unit} from the assumed"
                f" {parameter.shown * assumed[k]:.3g}{space}{parameter.unit}"
            )
    before, after = held_out_m
    if math.isfinite(before) and math.isfinite(after) and after > _GREW * before:
        doubts.append(f"the residuals of held-out frames grew from {1e3 * before:.3g} to {1e3 * after:.3g} mm (r.m.s.)")
    if left_out > _MOST_LEFT_OUT:
        doubts.append(f"{100 * left_out:.0f} % of the pixels that should see the landmark disagree with it")
    return doubts


def likely_cause(baseline: float, alternatives: Iterable[tuple[str, Callable[[], tuple[float, str]]]]) -> str:
    """Return the likely cause of a failure: the alternative that fits best, if it fits much better.

    Parameters
    ----------
    baseline : float
        Mean square residual with everything as stated, m².
    alternatives : iterable of (name, fit)
        Each fit returns its mean square residual and a sentence that says what would be right.
    """
    best, sentence = _BETTER * baseline, ""
    for _, fit in alternatives:
        found, said = fit()
        if found < best:
            best, sentence = found, said
    return sentence or (
        "no change of delay, quantity or order explains it: are the landmark and its size right, and do the poses refer"
        " to the lens and the landmark's axis?"
    )
