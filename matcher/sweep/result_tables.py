"""Tables of a sweep: one row a trial and method, and one row a cell with an interval on every number."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.data.files.csv_cell import csv_text
from phasemark.data.files.json_text import finite_or_none
from phasemark.matcher.information import weak_direction
from phasemark.matcher.likelihood.images import LEVEL_VIEW, VIEW
from phasemark.matcher.statistics import (
    Interval,
    binomial_interval,
    error_statistics,
    position_error_m,
    rms_interval,
    wrapped_errors,
)
from phasemark.matcher.sweep.plan import Condition
from phasemark.render.view import delta_period_rad

LEVELS = (0.5, 0.9, 0.95, 0.99)
"""Probabilities of the ellipsoids whose coverage is counted."""


@dataclass(frozen=True, eq=False)
class SweepTrials:
    """Every trial of a sweep, ordered by condition and number; arrays have n trials × m methods.

    Parameters
    ----------
    conditions : tuple of Condition
        Conditions of the design.
    methods : tuple of str
        Names of the methods.
    free : tuple of tuple of str
        What each method estimates.
    classes : tuple of str
        Names of the classes, in the order of their numbers.
    symmetry : tuple of int
        Of each class.
    outlier : (metres, degrees)
        Limits beyond which an error counts as an outlier.
    condition, trial : (n,) int64
        Numbers of the condition and of the trial.
    truth : (n, p) float64
        distance_m, delta_rad, bearing_rad, height_m, and with a tilt pitch_rad, roll_rad.
    confusion : (n,) float64
        Bound on the probability of a wrong class; NaN where it was not computed.
    estimate : (n, m, p) float64
        NaN where there is none.
    bound, covariance : (n, m, p, p) float64
        NaN where a parameter is not estimated, and where a method has no covariance.
    chi2 : (n, m) float64
        χ² of the best fit.
    p_value : (n, m) float64
        Its p-value.
    p_none : (n, m) float64
        Probability that there is no landmark.
    seconds : (n, m) float64
        Time of a match.
    dof : (n, m) int64
        Degrees of freedom of χ².
    found : (n, m) int64
        Number of the class, −1 for none.
    modes : (n, m) int64
        Explanations kept, the best included.
    accepted : (n, m) bool
        Whether the method accepted its match.
    """

    conditions: tuple[Condition, ...]
    methods: tuple[str, ...]
    free: tuple[tuple[str, ...], ...]
    classes: tuple[str, ...]
    symmetry: tuple[int, ...]
    outlier: tuple[float, float]
    condition: NDArray[np.int64]
    trial: NDArray[np.int64]
    truth: NDArray[np.float64]
    confusion: NDArray[np.float64]
    estimate: NDArray[np.float64]
    bound: NDArray[np.float64]
    covariance: NDArray[np.float64]
    chi2: NDArray[np.float64]
    p_value: NDArray[np.float64]
    p_none: NDArray[np.float64]
    seconds: NDArray[np.float64]
    dof: NDArray[np.int64]
    found: NDArray[np.int64]
    modes: NDArray[np.int64]
    accepted: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.truth)

    def __repr__(self) -> str:
        """Describe in one line how many trials there are, and of which methods."""
        return f"SweepTrials({len(self)} trials of {len(self.conditions)} conditions, {', '.join(self.methods)})"

    @property
    def numbers(self) -> tuple[str, ...]:
        """What views are made of: four names, six where the plan has a tilt."""
        return VIEW[: self.truth.shape[1]]

    @property
    def true_class(self) -> NDArray[np.int64]:
        """Number of each trial's class, −1 for a stranger, which has none; (n,)."""
        number = {name: k for k, name in enumerate(self.classes)}
        of_condition = np.array([number.get(condition.class_name, -1) for condition in self.conditions])
        return np.asarray(of_condition[self.condition])

    @property
    def refused(self) -> NDArray[np.bool_]:
        """Whether each method saw no landmark, or its fit failed its test; (n, m)."""
        return (self.found < 0) | ~self.accepted

    @property
    def error(self) -> NDArray[np.float64]:
        """Estimate less truth, δ wrapped by the true landmark's symmetry; (n, m, p), NaN for strangers."""
        return self.error_of(slice(None))

    def error_of(self, rows: slice) -> NDArray[np.float64]:
        """Return :attr:`error` of some trials."""
        true_class = self.true_class[rows]
        error = self.estimate[rows] - self.truth[rows, None]
        error[true_class < 0] = np.nan
        period = np.array([delta_period_rad(n) for n in self.symmetry])[true_class][:, None]
        return wrapped_errors(error, self.numbers, period)

    def position_error_of(self, rows: slice) -> NDArray[np.float64]:
        """Return the distance of the lens from its true place, the landmark's symmetry allowed for; (n, m), metres."""
        return position_error_m(self.estimate[rows, :, 0], self.truth[rows, None, 0], self.error_of(rows)[:, :, 1])

    def rows_of(self, condition: int) -> slice:
        """Return where the trials of a condition lie."""
        return slice(*np.searchsorted(self.condition, [condition, condition + 1]))

    def trial_table(self, rows: slice) -> dict[str, list[Any]]:
        """Return the columns of trials.csv for some trials, trial by trial and method by method."""
        names, number, error = self.numbers, self.condition[rows], self.error_of(rows)
        table: dict[str, NDArray[Any]] = {
            "condition": number[:, None],
            "trial": self.trial[rows, None],
            "method": np.array(self.methods, object),
            "class": np.array([self.conditions[k].class_name for k in number], object)[:, None],
            **{f"true_{name}": self.truth[rows, None, i] for i, name in enumerate(names)},
            **{name: self.estimate[rows, :, i] for i, name in enumerate(names)},
            **{f"error_{name}": error[:, :, i] for i, name in enumerate(names)},
            "error_position_m": self.position_error_of(rows),
            **{f"bound_{name}": np.sqrt(self.bound[rows, :, i, i]) for i, name in enumerate(names)},
            **{
                f"cov_{_SHORT[i]}_{_SHORT[j]}": self.covariance[rows, :, i, j]
                for i in range(len(names))
                for j in range(i, len(names))
            },
            **{name: getattr(self, name)[rows] for name in ("chi2", "dof", "p_value", "p_none")},
            "found": np.array([*self.classes, "none"], object)[self.found[rows]],
            "modes": self.modes[rows],
            "accepted": self.accepted[rows].astype(np.int64),
            "seconds": self.seconds[rows],
        }
        shape = (len(number), len(self.methods))
        return {name: np.broadcast_to(values, shape).ravel().tolist() for name, values in table.items()}

    def cells(self) -> tuple[Cell, ...]:
        """Judge every method under every condition."""
        error = self.error
        return tuple(
            self._cell(number, m, error)
            for number in range(len(self.conditions))
            for m in range(len(self.methods))
            if self.rows_of(number).stop > self.rows_of(number).start
        )

    def _cell(self, number: int, m: int, all_errors: NDArray[np.float64]) -> Cell:
        rows, condition = self.rows_of(number), self.conditions[number]
        at = np.array([VIEW.index(name) for name in self.free[m]])
        error = all_errors[rows, m][:, at]
        bound = self.bound[rows, m][:, at[:, None], at]
        covariance = self.covariance[rows, m][:, at[:, None], at]
        n = len(error)
        found = self.found[rows, m]
        accepted = self.accepted[rows, m]
        stranger = condition.class_name not in self.classes
        right = ~accepted if stranger else found == self.classes.index(condition.class_name)
        confusion = self.confusion[rows]
        confusion = confusion[np.isfinite(confusion)]
        answered = np.isfinite(error).all(axis=1) & (found >= 0)
        limit = np.array([self.outlier[0] if name.endswith("_m") else math.radians(self.outlier[1]) for name in VIEW])
        std = np.sqrt(np.einsum("npp->np", bound))
        with np.errstate(invalid="ignore"):
            # an error within this many standard deviations of the bound is no outlier, however large it is
            honest_sigma = 5.0
            gross = answered & (np.abs(error) > np.fmax(limit[at], honest_sigma * std)).any(axis=1)
        inner = answered & ~gross
        bounded = np.isfinite(std).all(axis=1)
        kept = error_statistics(
            error[inner], self.free[m], bound_std=std[inner], covariance=covariance[inner], levels=LEVELS
        )
        typical = np.median(bound[bounded], axis=0) if bounded.any() else np.full(bound.shape[1:], np.nan)
        condition_number, weak = weak_direction(self.free[m], covariance=typical)
        return Cell(
            number=number,
            condition=condition,
            method=self.methods[m],
            free=self.free[m],
            n=n,
            answered=binomial_interval(int(answered.sum()), n, law="student"),
            accepted=binomial_interval(int(accepted.sum()), n, law="student"),
            outliers=binomial_interval(int(gross.sum()), int(answered.sum()), law="student"),
            stranger=stranger,
            class_right=binomial_interval(int(right.sum()), n, law="student"),
            confusion_bound=float(confusion.mean()) if len(confusion) else math.nan,
            found={name: int((found == k).sum()) for k, name in [*enumerate(self.classes), (-1, "none")]},
            bias=dict(kept.bias),
            rmse=dict(kept.rmse),
            position=rms_interval(self.position_error_of(rows)[inner, m]),
            rmse_with_outliers=dict(error_statistics(error[answered], self.free[m]).rmse),
            bound={name: rms_interval(std[bounded, k]).value for k, name in enumerate(self.free[m])},
            ratio=dict(kept.ratio),
            nees=kept.nees,
            coverage=dict(kept.coverage),
            condition_number=condition_number,
            weak_direction=weak,
            seconds=float(np.median(self.seconds[rows, m])) if n else math.nan,
            numbers=self.numbers,
        )  # fmt: skip


_SHORT = tuple(name.split("_")[0] for name in VIEW)


@dataclass(frozen=True)
class Cell:
    """One method under one condition; lengths in metres, angles in radians, intervals of 95 %.

    Parameters
    ----------
    number : int
        Of the condition in the design.
    condition : Condition
        The condition.
    method : str
        Name of the method.
    free : tuple of str
        Names of the parameters that are estimated.
    n : int
        Trials.
    stranger : bool
        Whether the condition shows an object that stands in no bank; it has no errors and no bound.
    answered, accepted : Interval
        Shares of all trials.
    class_right : Interval
        Share of all trials whose class was found; of a stranger's, those that were refused.
    confusion_bound : float
        Mean bound on the probability of a wrong class, for a matcher that knows the world.
    outliers : Interval
        Share of the answered trials whose error is beyond the plan's limits, and beyond 5 σ of the bound.
    found : dict of str to int
        How often each class was found, "none" included.
    bias, rmse : dict of str to Interval
        Of the answered trials that are no outliers.
    rmse_with_outliers : dict of str to Interval
        RMSE of each parameter, outliers included.
    position : Interval
        Root mean square distance of the lens from its true place, of the same trials.
    bound : dict of str to float
        Cramér–Rao bound on the standard deviation, root mean square over the true views.
    ratio : dict of str to Interval
        √mean(e² / bound²), outliers left out.
    nees : Interval
        Mean of eᵀP⁻¹e over the number of parameters.
    coverage : dict of float to Interval
        Share of errors within the ellipsoids of :data:`LEVELS`.
    condition_number : float
        Of the bound, lengths in centimetres and angles in degrees.
    weak_direction : dict of str to float
        The direction known worst, as the standard deviation along it.
    seconds : float
        Median time of a match; the one number that differs from run to run.
    numbers : tuple of str
        What the views of the sweep are made of: without pitch and roll, the table has no columns of them.
    """

    number: int
    condition: Condition
    method: str
    free: tuple[str, ...]
    n: int
    stranger: bool
    answered: Interval
    accepted: Interval
    outliers: Interval
    class_right: Interval
    confusion_bound: float
    found: dict[str, int]
    bias: dict[str, Interval]
    rmse: dict[str, Interval]
    rmse_with_outliers: dict[str, Interval]
    position: Interval
    bound: dict[str, float]
    ratio: dict[str, Interval]
    nees: Interval
    coverage: dict[float, Interval]
    condition_number: float
    weak_direction: dict[str, float]
    seconds: float
    numbers: tuple[str, ...] = LEVEL_VIEW

    def row(self) -> dict[str, Any]:
        """Return the cell as one flat row of cells.csv; what a method does not estimate is NaN."""
        condition = asdict(self.condition)
        if self.numbers == LEVEL_VIEW:
            del condition["roll_deg"]
        out: dict[str, Any] = {"cell": self.number, **condition, "method": self.method, "n": self.n}
        out |= {"stranger": int(self.stranger), "confusion_bound": self.confusion_bound}
        for name in ("answered", "accepted", "outliers", "class_right", "nees"):
            out |= _flat(name, getattr(self, name))
        for name in self.numbers:
            for kind in ("bias", "rmse", "rmse_with_outliers", "ratio"):
                out |= _flat(f"{kind}_{name}", getattr(self, kind).get(name, _UNKNOWN))
            out[f"bound_{name}"] = self.bound.get(name, math.nan)
            out[f"weak_{name}"] = self.weak_direction.get(name, math.nan)
        out |= _flat("rmse_position_m", self.position)
        for level, share in self.coverage.items():
            out |= _flat(f"coverage_{round(100 * level)}", share)
        out |= {f"found_{name}": count for name, count in self.found.items()}
        return {**out, "condition_number": self.condition_number, "seconds": self.seconds}

    def as_dict(self) -> dict[str, Any]:
        """Return :meth:`row` for JSON: None for what is not finite."""
        return finite_or_none(self.row())


def outlier_share(cells: Sequence[Cell]) -> float:
    """Return the share of outliers among the answers of some cells; 0 where nothing was answered."""
    answered = [cell.answered.value * cell.n if cell.answered.value > 0 else 0.0 for cell in cells]
    lost = sum(cell.outliers.value * n for cell, n in zip(cells, answered, strict=True) if n)
    return lost / sum(answered) if any(answered) else 0.0


def outliers_in_words(cells: Sequence[Cell]) -> str:
    """Return the share of outliers among the answers of some cells as text, such as "4.2 % outliers"."""
    share = 100 * outlier_share(cells)
    return f"{share:.0f} % outliers" if share >= 99.5 else f"{share:.2g} % outliers" if share else "no outliers"


_UNKNOWN = Interval(math.nan, math.nan, math.nan)


def csv_bytes(table: Mapping[str, Sequence[Any]], *, header: bool = True) -> bytes:
    """Return columns as CSV; numbers as short as they can be read back exactly, nothing for NaN."""
    rows = zip(*(["" if v != v else v for v in column] for column in table.values()), strict=True)
    return csv_text(itertools.chain([list(table)] * header, rows)).encode()


def trials_csv(trials: SweepTrials) -> Iterator[bytes]:
    """Yield trials.csv piece by piece."""
    rows_at_once = 5000
    for start in range(0, len(trials), rows_at_once):
        yield csv_bytes(trials.trial_table(slice(start, start + rows_at_once)), header=start == 0)


def condition_axes(conditions: Sequence[Condition]) -> tuple[str, ...]:
    """Return the fields that differ between conditions."""
    return tuple(field.name for field in fields(Condition) if len({getattr(one, field.name) for one in conditions}) > 1)


def _flat(name: str, value: Interval) -> dict[str, float]:
    return {name: value.value, f"{name}_low": value.low, f"{name}_high": value.high}
