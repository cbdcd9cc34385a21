"""Test of a landmark that a fit finds among unknown things: nothing is seen through it, and it ends where it should."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.likelihood.problem import Problem, State
from phasemark.matcher.likelihood.residuals import range_residuals
from phasemark.matcher.pixel_agreement import FILLED_COVERAGE, MAY_RETURN_COVERAGE, MUST_RETURN_COVERAGE

__all__ = ["stands_out"]

_SHOWN_OUTLINE = 0.25
"""Share of the outline in view that a frame must show."""
_SEEN_THROUGH, _BESIDE_A_SLAB = 0.1, 0.5
"""Pixels that may see something behind the landmark, over those that agree with it; the second where no outline is in
view: a landmark may be modelled wider than it is, as a slab that fills the view, to leave its edges open."""
_SURFACE_M = 0.01
"""What continues a surface lies this near its tangent plane, noise apart; three times as far from a single pixel."""


def stands_out(problem: Problem, state: State, outlying: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return whether solutions among unknown things show a landmark that stands where the model has it, (m,).

    Things before a landmark hide it, but none is seen through it, and what continues beyond its outline is none.

    Parameters
    ----------
    problem : Problem
    state : State
    outlying : (m, pixels) bool
        Where the frame shows something else than the model.
    """
    seen, frame, coverage = problem.evidence.seen, problem.frame, state.images.coverage
    here = state.use & seen.returned[frame]
    agreeing, other = here & ~outlying, here & outlying
    farther = other & (range_residuals(state.images.phasor, problem.evidence, frame) > 0)
    through = (coverage >= FILLED_COVERAGE) & (farther | seen.not_returned[frame])
    has_outline = (coverage < MAY_RETURN_COVERAGE).any(axis=1)
    n_agreeing = agreeing.sum(axis=1)
    opaque = through.sum(axis=1) <= np.where(has_outline, _SEEN_THROUGH, _BESIDE_A_SLAB) * n_agreeing
    return np.asarray(opaque & (n_agreeing >= other.sum(axis=1)) & _ends_at_outline(problem, state, agreeing))


def _ends_at_outline(problem: Problem, state: State, agreeing: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return whether what agrees ends at the outline of the landmark, (m,).

    A pixel that agrees is compared with the first one beyond the outline, along rows and columns, within two pixels: an
    edge may cross the one between. Beyond, nothing returns or something farther away (the surface ends), something from
    the same depth (it continues), or something nearer (its edge is hidden). The surface is extended by its tangent
    plane: along a row or column of an image 1/z of a plane is linear, z the depth along the optical axis.
    """
    sensor, seen, frame = problem.evidence.sensor, problem.evidence.seen, problem.frame
    shape, cosine = (-1, sensor.rows, sensor.cols), sensor.axis_cosine()
    coverage = state.images.coverage.reshape(shape)
    returned, absent = seen.returned[frame].reshape(shape), seen.not_returned[frame].reshape(shape)
    z = np.where(returned, seen.range_m[frame].reshape(shape) * cosine, 1.0)
    variance = cosine**2 / np.where(returned, seen.weight[frame].reshape(shape), 1.0)
    inside, outside = agreeing.reshape(shape) & (coverage > MUST_RETURN_COVERAGE), coverage < MAY_RETURN_COVERAGE
    filled = inside & (coverage >= FILLED_COVERAGE)
    counted = np.zeros((3, len(coverage)), np.int64)
    for axis, step in ((1, 1), (1, -1), (2, 1), (2, -1)):

        def at(values: NDArray[Any], k: int, axis: int = axis, step: int = step) -> NDArray[Any]:
            """Return what is k pixels farther out, where that is in view; elsewhere what is at the border."""
            n = values.shape[axis]
            return np.take(values, np.clip(np.arange(n) + k * step, 0, n - 1), axis=axis)

        has_slope = filled & at(filled, -1)
        rise = np.where(has_slope, 1 / z - 1 / at(z, -1), 0.0)
        for k, first in ((1, at(outside, 1)), (2, at(outside, 2) & ~at(outside, 1))):
            extended = 1 / np.maximum(1 / z + k * rise, 1e-3)
            lever = np.where(has_slope, (k + 1) ** 2 + k**2, 1)
            near = np.where(has_slope, 1, 3) * _SURFACE_M + 5 * np.sqrt(at(variance, k) + lever * variance)
            pair, back, off = inside & first, at(returned, k), at(z, k) - extended
            ends, continues = pair & (at(absent, k) | (back & (off > near))), pair & back & (np.abs(off) <= near)
            counted += np.array([one.sum(axis=(1, 2)) for one in (pair, ends, continues)])
    pairs, ends_at, continues_at = counted
    return np.asarray((ends_at >= continues_at) & (ends_at >= _SHOWN_OUTLINE * pairs))
