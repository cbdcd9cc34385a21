"""What a matcher answers: one :class:`Match` a position, and :class:`Matches`, a sequence of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Candidate:
    """Another explanation of the same frame.

    Parameters
    ----------
    class_name : str
    distance_m, delta_rad : float
    cost : float
        Whitened squared distance of the frame from the candidate's image.
    """

    class_name: str
    distance_m: float
    delta_rad: float
    cost: float


@dataclass(frozen=True, eq=False)
class Match:
    """What one filtered frame shows.

    Parameters
    ----------
    class_name : str or None
        The landmark's class; None: no landmark.
    accepted : bool
        Whether there is a landmark and the fit passes its test at the matcher's false-alarm rate.
    distance_m, delta_rad, bearing_rad, height_m : float
        The view, PHYSICS section 1; NaN if too few pixels returned to tell.
    free : tuple of str
        Which of these were estimated; the others are assumptions.
    covariance : ndarray or None
        In the order of `free`; None where the method gives none.
    chi2, dof, p_value : float, int, float
        Test of the fit: whitened squared residual, its degrees of freedom, and the probability of a larger one.
    class_probability : mapping of str to float
        Of each class and of "none".
    alternatives : tuple of Candidate
        The best of each other class, best first.
    symmetry : int
        How many turns about its axis leave the class as it is: δ is known modulo 2π / symmetry.
    """

    class_name: str | None
    accepted: bool
    distance_m: float = math.nan
    delta_rad: float = math.nan
    bearing_rad: float = 0.0
    height_m: float = 0.0
    free: tuple[str, ...] = ("distance_m", "delta_rad")
    covariance: NDArray[np.float64] | None = None
    chi2: float = math.nan
    dof: int = 0
    p_value: float = math.nan
    class_probability: Mapping[str, float] = field(default_factory=lambda: {"none": 1.0})
    alternatives: tuple[Candidate, ...] = ()
    symmetry: int = 1

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and text, angles in degrees too; NaN as None, so that it is valid JSON."""

        def plain(value: float) -> float | None:
            return float(value) if math.isfinite(value) else None

        return {
            "class": self.class_name,
            "accepted": self.accepted,
            "distance_m": plain(self.distance_m),
            "delta_deg": plain(math.degrees(self.delta_rad)),
            "bearing_deg": plain(math.degrees(self.bearing_rad)),
            "height_m": plain(self.height_m),
            "free": list(self.free),
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "chi2": plain(self.chi2),
            "dof": self.dof,
            "p_value": plain(self.p_value),
            "class_probability": dict(self.class_probability),
            "alternatives": [
                {
                    "class": other.class_name,
                    "distance_m": other.distance_m,
                    "delta_deg": math.degrees(other.delta_rad),
                    "cost": other.cost,
                }
                for other in self.alternatives
            ],
        }


class Matches(Sequence[Match]):
    """The matches of a batch; the fields of :class:`Match` are there as arrays too.

    Attributes
    ----------
    class_name : (n,) object
        Names, None where there is no landmark.
    accepted : (n,) bool
    distance_m, delta_rad, bearing_rad, height_m, chi2, p_value : (n,) float64
    dof : (n,) int64
    """

    def __init__(self, matches: Iterable[Match]) -> None:
        self._matches = tuple(matches)

    @overload
    def __getitem__(self, index: int) -> Match: ...
    @overload
    def __getitem__(self, index: slice) -> Matches: ...
    def __getitem__(self, index: int | slice) -> Match | Matches:
        if isinstance(index, slice):
            return Matches(self._matches[index])
        return self._matches[index]

    def __len__(self) -> int:
        return len(self._matches)

    def __iter__(self) -> Iterator[Match]:
        return iter(self._matches)

    @property
    def class_name(self) -> NDArray[np.object_]:
        """Names, None where there is no landmark; (n,)."""
        return np.array([match.class_name for match in self], dtype=object)

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """Whether each match passed its test; (n,)."""
        return np.array([match.accepted for match in self], dtype=np.bool_)

    @property
    def dof(self) -> NDArray[np.int64]:
        """Degrees of freedom; (n,)."""
        return np.array([match.dof for match in self], dtype=np.int64)

    @property
    def distance_m(self) -> NDArray[np.float64]:
        """Distances; (n,)."""
        return self._floats("distance_m")

    @property
    def delta_rad(self) -> NDArray[np.float64]:
        """Angles δ; (n,)."""
        return self._floats("delta_rad")

    @property
    def bearing_rad(self) -> NDArray[np.float64]:
        """Bearings; (n,)."""
        return self._floats("bearing_rad")

    @property
    def height_m(self) -> NDArray[np.float64]:
        """Heights; (n,)."""
        return self._floats("height_m")

    @property
    def chi2(self) -> NDArray[np.float64]:
        """Whitened squared residuals; (n,)."""
        return self._floats("chi2")

    @property
    def p_value(self) -> NDArray[np.float64]:
        """Probabilities of a larger χ²; (n,)."""
        return self._floats("p_value")

    def _floats(self, name: str) -> NDArray[np.float64]:
        return np.array([getattr(match, name) for match in self], dtype=np.float64)
