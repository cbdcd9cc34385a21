"""Derivatives of phasors by the view: ∂S/∂(D, δ, b, h, pitch, roll) by differences of the area integral.

The integral is smooth in the view except where an edge passes a corner of a pixel or lies along its border: there its
slope jumps. Differences of a point-sampled image would be noise; those of the exact integral converge.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.view import VIEW_FIELDS, Views

VIEW_PARAMETERS = ("distance_m", "delta_rad", "bearing_rad", "height_m")
"""What a level view is made of, in the order of PHYSICS section 1: the derivatives that are given unless others are
asked for."""

STEP = 1e-5
"""Half the width of a difference, metres or radians.

Measured on random views of the catalogue: from 3e-6 to 3e-5 the error does not depend on the step, since all that is
left is the integral's own; a Richardson step gains nothing there. Wider differences straddle more kinks, narrower ones
magnify what is left of the quadrature's jumps.
"""


def check_parameters(parameters: Sequence[str]) -> None:
    """Refuse names that are no parameters of a view, and repeated ones."""
    for name in parameters:
        if name not in VIEW_FIELDS:
            raise UsageError(f"'parameters' must be among {', '.join(VIEW_FIELDS)}, got {name!r}")
    if not parameters or len(set(parameters)) < len(parameters):
        raise UsageError(f"'parameters' must name one or more parameters, each once, got {tuple(parameters)!r}")


Which: TypeAlias = slice | NDArray[np.integer]
"""Some of several views."""


def differentiate(
    phasor_of: Callable[[Views, Which], NDArray[np.complex128]], views: Views, parameters: Sequence[str]
) -> NDArray[np.complex128]:
    """Return the derivatives of phasors with respect to the view.

    Central differences, (S(p + s) − S(p − s)) / 2s. Height has no two-sided derivative at h = 0, where the top of the
    lower part is seen from its edge (PHYSICS section 7): within a step of it the difference is taken to one side,
    (8 S(h ± 2s) − 5 S(h ± s) − 3 S(h ± 3s)) / ±2s, upward for h ≥ 0, where the top stays hidden as it is at h = 0,
    and downward for h < 0. S(h) itself is not asked: at h = 0 the interface lies on a border between pixels.

    Parameters
    ----------
    phasor_of : callable
        From k views, moved, and which of all they are, to (k, rows, cols) phasors.
    views : Views
    parameters : sequence of str
        Among :data:`~phasemark.render.view.VIEW_FIELDS`.

    Returns
    -------
    (n, len(parameters), rows, cols) complex128
        Per metre or radian.
    """
    return np.stack([_derivative(phasor_of, views, name) for name in parameters], axis=1)


def _derivative(
    phasor_of: Callable[[Views, Which], NDArray[np.complex128]], views: Views, name: str
) -> NDArray[np.complex128]:
    value: NDArray[np.float64] = getattr(views, name)

    def at(which: Which, moved: NDArray[np.float64]) -> NDArray[np.complex128]:
        return phasor_of(replace(views[which], **{name: moved}), which)

    everywhere = slice(None)
    # the width is the difference of the rounded floats, not twice the requested step
    high, low = value + STEP, value - STEP
    up, down = at(everywhere, high), at(everywhere, low)
    each = (slice(None), *(None,) * (up.ndim - 1))
    slope = (up - down) / (high - low)[each]
    kinked = np.flatnonzero(np.abs(value) < STEP) if name == "height_m" else np.empty(0, np.int64)
    if kinked.size:
        side = np.where(value[kinked] >= 0, STEP, -STEP)
        near = np.where((side > 0)[each], up[kinked], down[kinked])
        middle, far = (at(kinked, value[kinked] + k * side) for k in (2, 3))
        slope[kinked] = (8 * middle - 5 * near - 3 * far) / (2 * side)[each]
    return slope
