"""Answers of a matcher: one :class:`Match` a position, and :class:`Matches`, a sequence of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from phasemark.data.pages.notebook import table_html
from phasemark.render import Background, Views
from phasemark.render.integral.rounding import with_error
from phasemark.render.view import VIEW_FIELDS

_T = TypeVar("_T", bound=np.generic)
Reason = Literal["", "no landmark", "poor fit", "undetermined", "outside the bank", "ambiguous"]
"""Why an answer is refused; empty if it is accepted."""
TOLERANCE_M, TOLERANCE_RAD = 0.03, math.radians(6.0)
"""How far off an accepted answer may be, unless the matcher is told."""
TOLERATED_SIGMA = 3.0
"""Standard deviations that must lie within the tolerance of an accepted answer."""


@dataclass(frozen=True)
class Candidate:
    """Another explanation of the same frame.

    Parameters
    ----------
    class_name : str
        Name of the class.
    distance_m, delta_rad : float
        Distance and viewing angle, metres and radians.
    cost : float
        Whitened squared distance of the frame from the candidate's image.
    weight : float
        Its probability, among all explanations with the match itself and "none"; 0 within three standard deviations of
        a better one of its class, which counts it in.
    bearing_rad, height_m, pitch_rad, roll_rad : float
        Other parameters of the view, metres and radians.
    """

    class_name: str
    distance_m: float
    delta_rad: float
    cost: float
    weight: float = 0.0
    bearing_rad: float = 0.0
    height_m: float = 0.0
    pitch_rad: float = 0.0
    roll_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class Match:
    """Answer for one filtered frame: class, view, uncertainty and acceptance.

    Parameters
    ----------
    class_name : str or None
        The landmark's class; None: no landmark.
    accepted : bool
        Whether the answer passed all tests, and so is right to within the matcher's tolerances but for the exceptions
        that docs/limits.md counts; if not, `reason` says why.
    distance_m, delta_rad, bearing_rad, height_m, pitch_rad, roll_rad : float
        The view, PHYSICS sections 1 and 9. Without any fit, as where too few pixels returned, D and δ are NaN and the
        others 0.
    free : tuple of str
        Which of these were estimated; the others are assumptions.
    covariance : ndarray or None
        In the order of `free`; None where the method gives none.
    chi2 : float
        Whitened squared residual.
    dof : int
        Its degrees of freedom.
    p_value : float
        Probability of a larger χ² if the model is right.
    class_probability : mapping of str to float
        Of each class, over all of its views, and of "none". Method "nearest" weighs the nearest image of each class
        alone: among look-alikes it is too sure.
    alternatives : tuple of Candidate
        The best of each other class, and further modes of the likelihood, best first.
    symmetry : int
        How many turns about its axis leave the class as it is: δ is known modulo 2π / symmetry.
    condition_number : float
        Of the information in the free parameters, lengths in units of 1 cm and angles of 1°: how much better the best
        observed direction is known than the worst, squared. NaN without a covariance, infinite where a direction is
        not observed at all.
    weak_direction : mapping of str to float
        The direction known worst, as the standard deviation along it, by parameter: metres and radians. Empty without
        a covariance.
    background : Background or None
        What the match took to stand behind the landmark; estimated where the matcher was told to.
    among_unknown : bool
        Whether other things might stand before, beside and behind the landmark.
    systematic : mapping of str to ndarray
        What of `covariance` all frames of the camera share, by its cause: "calibration", "recording", "declared",
        "multipath", "floor_albedo", "motion". The rest is noise.
    may_be_mirrored : bool or None
        Of an accepted answer of the method `refine`, whether the frame mirrored left to right may be a frame of the
        bank too: then nothing in it shows whether the image is mirrored, as reading it the wrong way leaves it, and δ
        and bearing may have the wrong sign. A landmark with a plane of symmetry through its axis, as all of the
        catalogue, never shows it. None where it was not tested.
    reason : {"", "no landmark", "poor fit", "undetermined", "outside the bank", "ambiguous"}
        Why the answer is refused; empty if it is accepted. "poor fit": χ² fails its test. "undetermined": the frame
        leaves some free parameter open by more than the matcher tolerates. "outside the bank": the view is beyond
        the distances and angles of the bank, where no other explanation was looked for. "ambiguous": another class or
        a view far away explains the frame too.
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
    condition_number: float = math.nan
    weak_direction: Mapping[str, float] = field(default_factory=dict)
    background: Background | None = None
    among_unknown: bool = False
    may_be_mirrored: bool | None = None
    reason: Reason = ""
    systematic: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    pitch_rad: float = 0.0
    roll_rad: float = 0.0

    def __repr__(self) -> str:
        """Describe in one line what was found, with one standard deviation of what was free."""
        verdict = "accepted" if self.accepted else f"refused: {self.reason}"
        if self.class_name is None:
            return f"Match({verdict})"
        std = dict.fromkeys(self.free, math.nan)
        if self.covariance is not None:
            std = dict(zip(self.free, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))
        words = []
        for name in self.free or ("distance_m", "delta_rad"):
            value, own = getattr(self, name), std.get(name, math.nan)
            label, unit = name.rsplit("_", 1)
            if unit == "rad":
                value, own, unit = math.degrees(value), math.degrees(own), "°"
            words.append(f"{label} {value:.5g}{'' if math.isnan(own) else f' ± {own:.2g}'} {unit}".replace(" °", "°"))
        return f"Match({self.class_name}, {verdict}: {', '.join(words)}, p = {self.p_value:.2g})"

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and text, valid JSON: all angles in degrees, covariances too; NaN as None."""

        def plain(value: float) -> float | None:
            return float(value) if math.isfinite(value) else None

        shown = np.array([scale_of_degrees(name) for name in self.free])
        unit = np.outer(shown, shown)
        return {
            "class": self.class_name,
            "accepted": self.accepted,
            "reason": self.reason,
            "distance_m": plain(self.distance_m),
            "delta_deg": plain(math.degrees(self.delta_rad)),
            "bearing_deg": plain(math.degrees(self.bearing_rad)),
            "height_m": plain(self.height_m),
            **{
                named_in_degrees(name): plain(math.degrees(getattr(self, name)))
                for name in ("pitch_rad", "roll_rad")
                if name in self.free or getattr(self, name)
            },
            "free": [named_in_degrees(name) for name in self.free],
            "covariance": None if self.covariance is None else (unit * self.covariance).tolist(),
            "systematic": {name: (unit * part).tolist() for name, part in self.systematic.items()},
            "chi2": plain(self.chi2),
            "dof": self.dof,
            "p_value": plain(self.p_value),
            "class_probability": dict(self.class_probability),
            "alternatives": [
                {
                    "class": other.class_name,
                    "distance_m": other.distance_m,
                    "delta_deg": math.degrees(other.delta_rad),
                    "cost": plain(other.cost),
                    "weight": other.weight,
                }
                for other in self.alternatives
            ],
            "condition_number": plain(self.condition_number),
            "weak_direction": {
                named_in_degrees(name): plain(scale_of_degrees(name) * std) for name, std in self.weak_direction.items()
            },
            "may_be_mirrored": self.may_be_mirrored,
            "wall_m": None if self.background is None else self.background.wall_m,
            "floor_m": None if self.background is None else self.background.floor_m,
            "among_unknown": self.among_unknown,
        }

    def _repr_html_(self) -> str:
        """Show the match in a notebook."""
        return table_html(_COLUMNS, [_cells(self)])


def views_of(matches: Sequence[Match]) -> Views:
    """Return the views of answers that have a class."""
    return Views(*(np.array([getattr(match, name) for match in matches]) for name in VIEW_FIELDS))


def named_in_degrees(name: str) -> str:
    """Return the name of a parameter in degrees, where it is an angle: ``delta_deg`` for ``delta_rad``."""
    return name.removesuffix("_rad") + "_deg" if name.endswith("_rad") else name


def scale_of_degrees(name: str) -> float:
    """Return by what a parameter is multiplied to get the unit of :func:`named_in_degrees`."""
    return math.degrees(1.0) if name.endswith("_rad") else 1.0


_COLUMNS = ("class", "D (m)", "δ (°)", "accepted", "p")


def _cells(match: Match) -> tuple[str, ...]:
    """Return a match as the cells of a table, values ± their standard deviations where there are any."""
    if match.class_name is None:
        return ("no landmark", "", "", "refused", _number(match.p_value, ".3g"))
    cells = []
    for name, form in (("distance_m", ".4f"), ("delta_rad", ".2f")):
        value, scale, std = getattr(match, name), scale_of_degrees(name), 0.0
        if match.accepted and match.covariance is not None and name in match.free:
            k = match.free.index(name)
            std = scale * math.sqrt(max(float(match.covariance[k, k]), 0.0))
        cells.append(with_error(scale * value, std) if 0 < std < math.inf else _number(scale * value, form))
    verdict = "yes" if match.accepted else f"refused: {match.reason}" if match.reason else "refused"
    return (match.class_name, *cells, verdict, _number(match.p_value, ".3g"))


def _number(value: float, form: str) -> str:
    return f"{value:{form}}" if math.isfinite(value) else ""


class _Column(Generic[_T]):
    """A field of all matches of a batch, as an array (n,)."""

    def __init__(self, kind: type[_T]) -> None:
        self._kind = kind

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, matches: Matches | None, owner: type) -> NDArray[_T]:
        if matches is None:
            return self  # type: ignore[return-value]
        return np.array([getattr(match, self._name) for match in matches], dtype=self._kind)


class Matches(Sequence[Match]):
    """The matches of a batch; the fields of :class:`Match` are there as arrays too.

    Parameters
    ----------
    matches : iterable of Match
        One match for each position.

    Attributes
    ----------
    class_name : (n,) object
        Names, None where there is no landmark.
    reason : (n,) object
        Why a match is refused; empty if it is accepted.
    accepted : (n,) bool
        Whether the test of the fit accepts the match.
    distance_m, delta_rad, bearing_rad, height_m, pitch_rad, roll_rad : (n,) float64
        Estimated views, metres and radians.
    chi2, p_value, condition_number : (n,) float64
        χ² of the fit, its p-value, and the condition number of the information.
    dof : (n,) int64
        Degrees of freedom of χ².
    covariance : (n, p, p) float64, or None
        Covariance of the estimated parameters, metres and radians.
    class_probability : dict of str to (n,) float64
        Probability of each class.
    """

    class_name = _Column(np.object_)
    accepted = _Column(np.bool_)
    reason = _Column(np.object_)
    dof = _Column(np.int64)
    distance_m = _Column(np.float64)
    delta_rad = _Column(np.float64)
    bearing_rad = _Column(np.float64)
    height_m = _Column(np.float64)
    pitch_rad = _Column(np.float64)
    roll_rad = _Column(np.float64)
    chi2 = _Column(np.float64)
    p_value = _Column(np.float64)
    condition_number = _Column(np.float64)

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

    def __repr__(self) -> str:
        """Describe in one line how many answers there are, and how many were accepted."""
        return f"Matches({len(self)} answers, {int(self.accepted.sum())} accepted)"

    def __len__(self) -> int:
        return len(self._matches)

    def __iter__(self) -> Iterator[Match]:
        return iter(self._matches)

    @property
    def covariance(self) -> NDArray[np.float64] | None:
        """Covariances in the order of ``free``, (n, p, p), NaN where there is none; None if no match has one."""
        known = [match.covariance for match in self if match.covariance is not None]
        if not known:
            return None
        missing = np.full(known[0].shape, np.nan)
        return np.stack([missing if match.covariance is None else match.covariance for match in self])

    @property
    def free(self) -> tuple[str, ...]:
        """Which parameters of the view were estimated."""
        return self[0].free if len(self) else ()

    @property
    def class_probability(self) -> dict[str, NDArray[np.float64]]:
        """Probability of each class and of "none", by name; (n,) each."""
        names = dict.fromkeys(name for match in self for name in match.class_probability)
        return {name: np.array([match.class_probability.get(name, 0.0) for match in self]) for name in names}

    def _repr_html_(self) -> str:
        """Show the matches in a notebook, the first hundred of them."""
        most_shown = 100
        caption = f"{len(self)} matches" + (f", the first {most_shown}" if len(self) > most_shown else "")
        rows = [(k, *_cells(match)) for k, match in enumerate(self[:most_shown])]
        return table_html(("position", *_COLUMNS), rows, caption=caption)
