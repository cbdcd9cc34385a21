"""From the explanations of one frame of a direct sensor to an answer, by the rules of all evidence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.estimate.acceptance import Rules, answer_of
from phasemark.matcher.estimate.fits import Fits
from phasemark.matcher.information import covariance_of
from phasemark.matcher.match import Match
from phasemark.matcher.pixel_agreement import DISAGREEMENT
from phasemark.render import Background


class Explanation(NamedTuple):
    """A view of a class that may have made a frame.

    Parameters
    ----------
    class_index : int
    view : (6,) float64
    cost : float
        Whitened squared distance of the frame, or its deviance; what was known before included.
    information : (p, p) float64, or None
        In the free parameters; None of an explanation that was not followed to the end.
    """

    class_index: int
    view: NDArray[np.float64]
    cost: float
    information: NDArray[np.float64] | None


class FitTest(NamedTuple):
    """The test of the best explanation."""

    chi2: float
    dof: int
    p_value: float


def answer_from(
    rules: Rules,
    found: Sequence[Explanation],
    test: FitTest,
    bare: float,
    doubt: float,
    background: Background | None = None,
) -> Match:
    """Return the answer for one frame.

    The posterior around an explanation that was not followed to the end is taken to be as wide as that of the best one.

    Parameters
    ----------
    rules : Rules
    found : sequence of Explanation
        One at least was followed to the end.
    test : FitTest
        Of the best of those.
    bare : float
        Cost of a scene without a landmark.
    doubt : float
        Cost from which the test refuses the best of them.
    background : Background, optional
        What the best of them has behind the landmark.
    """
    found = sorted(found, key=lambda one: (one.information is None, one.cost))
    n, best = len(found), found[0].information
    assert best is not None
    information = np.stack([best if one.information is None else one.information for one in found])
    cost, covariance = np.array([one.cost for one in found]), covariance_of(information)
    fits = Fits(
        frame=np.zeros(n, np.int64),
        class_index=np.array([one.class_index for one in found]),
        view=np.stack([one.view for one in found]),
        albedo=np.ones(n),
        cost=cost,
        capped=cost + DISAGREEMENT,
        dof=np.full(n, test.dof),
        p_value=np.full(n, test.p_value),
        unexplained=np.zeros(n, np.int64),
        explained=np.zeros(n, np.int64),
        stands_out=np.ones(n, np.bool_),
        prior=cost - test.chi2,
        covariance=covariance,
        information=information,
        std_without_one=np.sqrt(np.einsum("kpp->kp", covariance)),
    )
    return answer_of(rules, fits, np.arange(n), np.full(n, doubt), bare, background)
