"""One descent for every kind of evidence: Gauss–Newton steps of limited length, each of which must lower the cost.

A point of a descent states its cost, the information there (half the second derivative of the cost) and the gradient
of the likelihood (minus half the slope of the cost). Steps are zero along directions that are not observed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

_UNSEEN = 1e-5
"""A parameter does not move if its standard deviation, in longest steps, is above the least one over this."""
_RIDGE = 1e-9
"""Added to the information where its diagonal is 1: combinations that are not observed do not move either."""


class Point(Protocol):
    """A place of a descent; information and gradient are asked for only where a step begins."""

    @property
    def cost(self) -> float:
        """Squared residuals, or twice a negative log-likelihood."""

    @property
    def information(self) -> NDArray[np.float64]:
        """Half the second derivative of the cost, (p, p)."""

    @property
    def gradient(self) -> NDArray[np.float64]:
        """Minus half the slope of the cost, (p,)."""

    def moved(self, step: NDArray[np.float64]) -> Self:
        """Return the point a step away, or the nearest one within bounds."""


P = TypeVar("P", bound=Point)


def descend(
    here: P, longest: NDArray[np.float64], *, most: int, done: float = 0.0, shares: Sequence[float] = (1.0,),
    excess: Callable[[P, NDArray[np.float64]], float] | None = None,
) -> tuple[P, NDArray[np.float64], int]:  # fmt: skip
    """Lower a cost by Gauss–Newton steps.

    Parameters
    ----------
    here : Point
        Where to start.
    longest : (p,) float64
        Longest step of each parameter.
    most : int
        Largest number of steps.
    done : float
        A step that promises to lower the cost by less than this is not taken, and ends the descent.
    shares : sequence of float
        Parts of a step that are tried, until one does not raise the cost.
    excess : callable, optional
        Returns by which factor a step from a point is too long; None: the largest ratio to the longest step.

    Returns
    -------
    point : Point
    left : (p,) float64
        The step that was not taken because it promised too little; 0 where the descent ended otherwise.
    steps : int
        Number of steps that were computed.
    """
    for n in range(1, most + 1):
        step = newton_step(here.information, here.gradient, longest)
        if float(step @ here.gradient) < done:
            return here, step, n
        step /= max(1.0, float((np.abs(step) / longest).max(initial=0.0)) if excess is None else excess(here, step))
        tried = (here.moved(share * step) for share in shares)
        lower = next((there for there in tried if there.cost <= here.cost), None)
        if lower is None:
            return here, np.zeros(len(step)), n
        here = lower
    return here, np.zeros(len(longest)), most


def newton_step(
    information: NDArray[np.float64], gradient: NDArray[np.float64], unit: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the step to the vertex of a parabola, zero along directions that are not observed.

    Parameters
    ----------
    information : (p, p) float64
    gradient : (p,) float64
    unit : (p,) float64
        Units of the parameters in which standard deviations are compared.
    """
    root = np.sqrt(np.diag(information))
    seen = root * unit > _UNSEEN * (root * unit).max(initial=0.0)
    root, step = root[seen], np.zeros(len(unit))
    normal = information[np.ix_(seen, seen)] / np.outer(root, root) + _RIDGE * np.eye(len(root))
    step[seen] = np.linalg.solve(normal, gradient[seen] / root) / root
    return step
