"""Candidates for the answer, each at its best view, with its cost and its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.pixel_agreement import DISAGREEMENT
from phasemark.render.view import delta_period_rad, wrap_delta_difference_rad

SAME_M, SAME_RAD = 2e-3, math.radians(0.2)
"""Fits of one class nearer to each other than this are one."""
MOST_REFINED = 12
"""Explanations of a frame that are looked around where none fits, and that move with an estimated background."""

BETTER_COST = 1.0
"""By how much the cost of a look-alike must be lower: below that both views remain, and the answer is ambiguous."""


@dataclass(frozen=True, eq=False)
class Fits:
    """Candidates, each at its best view; arrays of one length m.

    Parameters
    ----------
    frame, class_index : int64
    view : (m, 6) float64
    albedo : float64
        Factor on the landmark's brightness; 1 on ranges.
    cost : float64
        Whitened squared residual of all pixels that count, and
        :data:`~phasemark.matcher.pixel_agreement.DISAGREEMENT` for each pixel whose return or lack of it no view
        nearby explains. Of a fit that was not refined on the final images it is an estimate: the best final cost of its
        frame, and the difference that interpolated images gave between the two.
    capped : float64
        The same with no residual adding more than that: what to compare with a scene that explains nothing.
    dof : int64
        Residuals in it, less the parameters fitted.
    p_value : float64
        Of two χ² tests, of the pixels at edges of the landmark and of those inside, the worse one.
    unexplained : int64
        Returns that are left to unknown things in view; in `cost` each is a disagreement, in `dof` it is none.
    explained : int64
        Returns that are compared and not left to unknown things.
    stands_out : bool
        Among unknown things, whether the landmark stands where the model has it
        (:func:`~phasemark.matcher.likelihood.contradictions.stands_out`); True elsewhere.
    prior : float64
        What the prior adds to the cost; no test of the fit counts it.
    covariance : (m, p, p) float64
        Of the free parameters of the view, nuisances taken into account; NaN where some direction is not observed.
    information : (m, p, p) float64
        Its inverse, and where some direction is not observed, what the descent's own slopes tell.
    std_without_one : (m, p) float64
        Largest standard deviations after any one pixel is left out. One pixel at an edge may claim more than it knows,
        so an answer is judged by these. Infinite where they were not computed.
    """

    frame: NDArray[np.int64]
    class_index: NDArray[np.int64]
    view: NDArray[np.float64]
    albedo: NDArray[np.float64]
    cost: NDArray[np.float64]
    capped: NDArray[np.float64]
    dof: NDArray[np.int64]
    p_value: NDArray[np.float64]
    unexplained: NDArray[np.int64]
    explained: NDArray[np.int64]
    stands_out: NDArray[np.bool_]
    prior: NDArray[np.float64]
    covariance: NDArray[np.float64]
    information: NDArray[np.float64]
    std_without_one: NDArray[np.float64]

    @property
    def tested(self) -> NDArray[np.float64]:
        """The part of the cost that a χ² test judges: neither prior nor what is left to unknown things; (m,)."""
        return np.asarray(self.cost - self.prior - DISAGREEMENT * self.unexplained)

    def __len__(self) -> int:
        return len(self.frame)

    def __getitem__(self, index: NDArray[Any] | slice) -> Fits:
        return Fits(**{name: values[index] for name, values in vars(self).items()})

    def with_scale(self, scale: NDArray[np.float64]) -> Fits:
        """Return the fits with covariances scaled, each by a number (m,)."""
        return replace(
            self,
            covariance=self.covariance * scale[:, None, None],
            information=self.information / scale[:, None, None],
            std_without_one=self.std_without_one * np.sqrt(scale)[:, None],
        )

    def with_free(self, p: int) -> Fits:
        """Return the fits as those of more free parameters, which were not moved and of which nothing is known."""
        more = p - self.covariance.shape[1]
        square = ((0, 0), (0, more), (0, more))
        return replace(
            self,
            covariance=np.pad(self.covariance, square, constant_values=np.nan),
            information=np.pad(self.information, square, constant_values=np.nan),
            std_without_one=np.pad(self.std_without_one, ((0, 0), (0, more)), constant_values=np.inf),
        )

    def with_rows(self, index: NDArray[np.integer], rows: Fits) -> Fits:
        """Return the fits with others at some places."""
        changed = {name: values.copy() for name, values in vars(self).items()}
        for name, values in changed.items():
            values[index] = getattr(rows, name)
        return Fits(**changed)

    @classmethod
    def joined(cls, parts: list[Fits]) -> Fits:
        """Put batches behind one another."""
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])})


def least_of_frame(fits: Fits, n: int) -> NDArray[np.float64]:
    """Return the lowest cost of every frame, (n,); infinite without a fit."""
    least = np.full(n, np.inf)
    np.minimum.at(least, fits.frame, fits.cost)
    return least


def best_of_frame(fits: Fits) -> NDArray[np.int64]:
    """Return the index of the best fit of every frame that has one."""
    order = np.lexsort((fits.cost, fits.frame))
    first = np.r_[True, np.diff(fits.frame[order]) > 0] if len(order) else np.empty(0, np.bool_)
    return order[first]


def with_refined(fits: Fits, which: NDArray[np.int64], again: Fits, n: int) -> Fits:
    """Return fits of n frames, some of them refined again; others keep their distance from the best of the frame."""
    change, refitted = np.zeros(n), np.unique(again.frame)
    change[refitted] = least_of_frame(again, n)[refitted] - least_of_frame(fits, n)[refitted]
    others = fits[np.setdiff1d(np.arange(len(fits)), which)]
    change = np.where(np.isfinite(change), change, 0.0)
    return Fits.joined([again, replace(others, cost=others.cost + change[others.frame])])


def distinct(
    fits: Fits,
    own: NDArray[np.int64],
    symmetry: Sequence[int],
    same_m: float = SAME_M,
    same_rad: float = SAME_RAD,
    same_bearing_rad: float = math.inf,
) -> list[int]:
    """Return some fits of one frame, best first, without those that came to the same place.

    Parameters
    ----------
    fits : Fits
    own : (k,) int64
        Which of them, best first.
    symmetry : sequence of int
        Of each class.
    same_m, same_rad : float
        Fits nearer to each other are one.
    same_bearing_rad : float
        And of nearer bearings; by default any: a flat landmark has one heading under many bearings.
    """
    same = np.array([same_m, same_rad, same_bearing_rad, same_m, same_rad, same_rad])
    views, classes = fits.view[own], fits.class_index[own]
    kept, n, places, kinds = [], 0, np.empty_like(views), np.empty_like(classes)
    for k, view, c in zip(own.tolist(), views, classes.tolist(), strict=True):
        off = np.abs(places[:n] - view)
        off[:, 1] = np.abs(wrap_delta_difference_rad(off[:, 1], delta_period_rad(symmetry[c])))
        if not ((kinds[:n] == c) & (off < same).all(axis=1)).any():
            kept.append(k)
            places[n], kinds[n], n = view, c, n + 1
    return kept


def distinct_of_frames(
    fits: Fits,
    which: NDArray[np.int64],
    symmetry: Sequence[int],
    same_m: float = SAME_M,
    same_rad: float = SAME_RAD,
    same_bearing_rad: float = math.inf,
) -> NDArray[np.int64]:
    """Return those of some fits that came to places of their own, the best at each; see :func:`distinct`."""
    which = which[np.lexsort((fits.cost[which], fits.frame[which]))]
    borders = np.flatnonzero(np.diff(fits.frame[which])) + 1
    groups = np.split(which, borders)
    return np.array(
        [k for own in groups for k in distinct(fits, own, symmetry, same_m, same_rad, same_bearing_rad)], np.int64
    )
