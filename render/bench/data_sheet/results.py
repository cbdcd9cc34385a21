"""A data sheet: series and numbers, simulated beside predicted, and whether the two agree."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.render.sensor.sensor import Sensor

Z95 = 1.959963984540054
AGREEMENT = 0.999
"""Simulation agrees with prediction while all χ² pass at this level, corrected for their number."""
Floats = NDArray[np.float64]


FIGURES = (
    "photon_transfer", "range_noise", "linearity", "fixed_pattern", "saturation", "threshold", "histogram", "merging",
    "ambient",
)  # fmt: skip
"""The figures that a data sheet may have, in its order."""


def _plain(value: float) -> float | None:
    """Return None for a number that JSON does not have."""
    return value if math.isfinite(value) else None


def _tail(chi2: float, degrees_of_freedom: int) -> float:
    """Return the probability of a larger χ²; 1 if nothing is compared."""
    return float(special.chdtrc(degrees_of_freedom, chi2)) if degrees_of_freedom else 1.0


def _agreement(one: Comparison | Characterisation) -> dict[str, float | None]:
    """Return the test of simulated points, for JSON."""
    return {name: _plain(getattr(one, name)) for name in ("chi2", "degrees_of_freedom", "p_value")}


@dataclass(frozen=True, eq=False)
class Comparison:
    """Simulated points beside predicted ones.

    Parameters
    ----------
    figure : str
        Which figure the points belong to.
    label : str
        Which of its series they are.
    x_name : str
        Quantity along x, unit at the end.
    y_name : str
        Quantity along y, unit at the end.
    x : (n,) float64
        Where the points lie.
    predicted : (n,) float64
        What the law says there.
    simulated : (n,) float64
        What the simulated readings give.
    std_error : (n,) float64
        Standard error of a simulated point about the prediction.
    samples : (n,) int64
        Readings that a point is made of.
    compared : (n,) bool
        Where the prediction claims to hold: nothing clips there, and there is noise.
    curve_x, curve_y : (m,) float64
        The prediction drawn as a line.
    law_y : (m,) float64, or None
        The nominal law, without patterns and without its corrections, where it differs from the prediction.
    """

    figure: str
    label: str
    x_name: str
    y_name: str
    x: Floats
    predicted: Floats
    simulated: Floats
    std_error: Floats
    samples: NDArray[np.int64]
    compared: NDArray[np.bool_]
    curve_x: Floats
    curve_y: Floats
    law_y: Floats | None = None

    @property
    def half95(self) -> Floats:
        """Half width of the 95 % interval of each point."""
        return Z95 * self.std_error

    @property
    def degrees_of_freedom(self) -> int:
        """Number of points compared."""
        return int(self.compared.sum())

    @property
    def chi2(self) -> float:
        """Σ ((simulated − predicted) / standard error)² over the points compared."""
        used = self.compared
        return float((((self.simulated - self.predicted)[used] / self.std_error[used]) ** 2).sum())

    @property
    def p_value(self) -> float:
        """Probability of a larger χ² if the prediction is right; 1 if nothing is compared."""
        return _tail(self.chi2, self.degrees_of_freedom)

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, for JSON."""
        columns: dict[str, NDArray[Any]] = {name: getattr(self, name) for name in ("x", "predicted", "simulated")}
        columns |= {"low95": self.simulated - self.half95, "high95": self.simulated + self.half95}
        columns |= {"samples": self.samples, "compared": self.compared}
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        return {
            **{name: getattr(self, name) for name in ("figure", "label", "x_name", "y_name")},
            **_agreement(self),
            "points": [dict(zip(columns, map(_plain, row), strict=True)) for row in rows],
        }


@dataclass(frozen=True)
class SheetQuantity:
    """One number of a data sheet.

    Parameters
    ----------
    name : str
        With the unit at its end.
    title : str
        What it is, in words, with its unit.
    predicted, simulated : float
        Value that follows from the sensor model, and value in simulated frames.
    std_error : float
        Of `simulated`.
    samples : int
        Readings it is made of.
    """

    name: str
    title: str
    predicted: float
    simulated: float
    std_error: float
    samples: int

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers, for JSON."""
        half = Z95 * self.std_error
        return {
            "title": self.title,
            "predicted": _plain(self.predicted),
            "simulated": _plain(self.simulated),
            "low95": _plain(self.simulated - half),
            "high95": _plain(self.simulated + half),
            "samples": self.samples,
        }


@dataclass(frozen=True, eq=False)
class Characterisation:
    """The data sheet of a sensor.

    Parameters
    ----------
    sensor : Sensor
        The camera.
    n_frames : int
        Frames at each point.
    reference_range_m : float
        Range of the flat fields whose range is of no account.
    comparisons : tuple of Comparison
        Predicted and simulated values, with their tests.
    quantities : tuple of SheetQuantity
        Rows of the data sheet.
    maps : mapping of str to (rows, cols) float64
        Simulated patterns by name with unit; NaN where a pixel is dead or hot.
    defects : mapping of str to (rows, cols) bool
        ``dead`` and ``hot``.
    notes : tuple of str
        Sentences about what this sensor does not have.
    """

    sensor: Sensor
    n_frames: int
    reference_range_m: float
    comparisons: tuple[Comparison, ...]
    quantities: tuple[SheetQuantity, ...]
    maps: dict[str, Floats] = field(default_factory=dict)
    defects: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Describe in one line how many series agree with what the sensor's numbers predict."""
        n = len(self.comparisons)
        return f"Characterisation({self.sensor!r}: {n - len(self.disagreements)} of {n} series as predicted)"

    def of_figure(self, figure: str) -> tuple[Comparison, ...]:
        """Return the series of a figure; none if the sensor does not have it."""
        return tuple(one for one in self.comparisons if one.figure == figure)

    def quantity(self, name: str) -> SheetQuantity | None:
        """Return a number of the data sheet, or None if the sensor does not have it."""
        return next((one for one in self.quantities if one.name == name), None)

    @property
    def disagreements(self) -> tuple[Comparison, ...]:
        """Series whose χ² does not pass at `AGREEMENT`, corrected for the number of series."""
        limit = (1 - AGREEMENT) / max(len(self.comparisons), 1)
        return tuple(one for one in self.comparisons if not one.p_value >= limit)  # NaN is no agreement

    @property
    def chi2(self) -> float:
        """χ² over all points."""
        return sum(one.chi2 for one in self.comparisons)

    @property
    def degrees_of_freedom(self) -> int:
        """Number of all points compared."""
        return sum(one.degrees_of_freedom for one in self.comparisons)

    @property
    def p_value(self) -> float:
        """Probability of a larger χ² over all points if every prediction is right."""
        return _tail(self.chi2, self.degrees_of_freedom)

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, lists and strings, for JSON; None where there is no number."""
        return {
            "format": "phasemark-characterisation",
            "schema_version": 1,
            "sensor": self.sensor.model_dump(mode="json"),
            "frames_per_point": self.n_frames,
            "reference_range_m": self.reference_range_m,
            "agreement": {
                "agrees": not self.disagreements,
                "level": AGREEMENT,
                **_agreement(self),
                "disagreeing": [f"{one.figure}: {one.label}" for one in self.disagreements],
            },
            "quantities": {one.name: one.as_dict() for one in self.quantities},
            "comparisons": [one.as_dict() for one in self.comparisons],
            "maps": {
                name: [[_plain(float(value)) for value in row] for row in values] for name, values in self.maps.items()
            },
            "defects": {name: np.argwhere(mask).tolist() for name, mask in self.defects.items()},
            "notes": list(self.notes),
        }
