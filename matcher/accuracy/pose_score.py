"""Score of the accepted poses of a recording beside a reference: errors, stated widths, coverage, and runs without one.

Bias is the median error, MAD the median distance from it. Intervals of coverage are Wilson's, and count frames as if
they were independent. A run of n successes shows a reliability R with confidence C by n = ln(1 − C)/ln R, as ASTM
F3499-21 counts them; so 0 false answers of n leave a share of at most 1 − R, about 3/n at 95 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark import UsageError
from phasemark.matcher.statistics import Interval, binomial_interval, within_ellipsoid

CONFIDENCE = 0.95


def shown_reliability(successes: int, confidence: float = CONFIDENCE) -> float:
    """Return the reliability R that a run of successes shows with some confidence, (1 − C)^(1/n); 0 of none.

    Parameters
    ----------
    successes : int
        n, without a failure.
    confidence : float
        C, in (0, 1).

    Examples
    --------
    >>> round(shown_reliability(59), 3)
    0.95
    """
    return float((1 - confidence) ** (1 / successes)) if successes else 0.0


def longest_run(good: NDArray[np.bool_]) -> int:
    """Return the length of the longest run of True."""
    ends = np.flatnonzero(~np.concatenate([[False], good, [False]]))
    return int(np.diff(ends).max()) - 1


@dataclass(frozen=True)
class PoseScore:
    """Agreement of accepted poses with a reference, in the units of the errors.

    Parameters
    ----------
    expected, answered : int
        Frames that should have an answer, and those of them that have one.
    bias, mad, rms : tuple of float
        Median error of each number; median and root mean square of the distances from it.
    std : tuple of float
        Median of the stated standard deviations.
    inside : Interval
        Share of the true poses within the stated 95 % ellipsoids.
    accepted, gross : int
        Frames with an answer, also those that should have none, and those of them that are off by more than a limit.
    run : int
        Longest run of accepted answers that are not.
    """

    expected: int
    answered: int
    bias: tuple[float, ...]
    mad: tuple[float, ...]
    rms: tuple[float, ...]
    std: tuple[float, ...]
    inside: Interval
    accepted: int
    gross: int
    run: int

    @classmethod
    def of(
        cls,
        error: NDArray[np.float64],
        covariance: NDArray[np.float64],
        accepted: NDArray[np.bool_],
        expected: NDArray[np.bool_],
        gross: Sequence[float],
    ) -> PoseScore:
        """Score poses in the order of time.

        Parameters
        ----------
        error : (n, p) float64
            Estimate less reference; rows with NaN do not count.
        covariance : (n, p, p) float64
            As stated.
        accepted, expected : (n,) bool
            Whether a frame has an answer, and whether it should.
        gross : (p,) sequence of float
            Errors beyond which an answer is false.

        Raises
        ------
        UsageError
            No frame that should have an answer has one.
        """
        known = np.isfinite(error).all(axis=1)
        used, answered = accepted & expected & known, accepted & known
        if not used.any():
            raise UsageError("no accepted frame has a true pose to compare with")
        off, matrix = error[used], covariance[used]
        bias = np.median(off, axis=0)
        false = np.asarray((np.abs(error[answered]) > gross).any(axis=1))
        return cls(
            expected=int(expected.sum()),
            answered=int(used.sum()),
            bias=tuple(bias.tolist()),
            mad=tuple(np.median(np.abs(off - bias), axis=0).tolist()),
            rms=tuple(np.sqrt(((off - bias) ** 2).mean(axis=0)).tolist()),
            std=tuple(np.median(np.sqrt(np.einsum("nii->ni", matrix)), axis=0).tolist()),
            inside=binomial_interval(int(within_ellipsoid(off, matrix).sum()), len(off), law="student"),
            accepted=len(false),
            gross=int(false.sum()),
            run=longest_run(~false),
        )

    @property
    def reliability(self) -> float:
        """Reliability that the longest run shows with 95 % confidence."""
        return shown_reliability(self.run)

    @property
    def gross_at_most(self) -> float:
        """Upper limit of the share of false answers at 95 % (Clopper and Pearson 1934): of none about 3/n."""
        right = self.accepted - self.gross
        return float(special.betaincinv(self.gross + 1, right, CONFIDENCE)) if right else 1.0

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, for JSON."""
        return {**asdict(self), "reliability": self.reliability, "gross_at_most": self.gross_at_most}
