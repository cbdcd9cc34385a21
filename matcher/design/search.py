"""The search: boxes by their bound, sets of classes by their distance, then both refined on the workshop's lattice.

A view's distance and side come from the lower pixels, that is from the box alone; the class comes from the upper ones.
So boxes are scored once, parts above them are compared once, and only then put together: each box with the set of parts
that are easiest to distinguish on it.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data.progress import Progress, counter
from phasemark.landmarks import LandmarkSpec, catalog
from phasemark.landmarks.spec import Box, Upper
from phasemark.matcher.accuracy.appearance import Appearance
from phasemark.matcher.design.measures import (
    ClassDistances,
    RangeBound,
    box_alone,
    choose_far_apart,
    range_bound,
    turn_distance,
    upper_appearance,
)
from phasemark.matcher.design.plan import DesignPlan
from phasemark.matcher.design.rules import AllowedDimensions, Check, upper_size
from phasemark.matcher.design.shapes import Lattice, box_of, neighbours, sample_boxes, sample_uppers
from phasemark.render import Sensor

_BOX_MOVES = (8, 4, 2, 1)
_UPPER_MOVES = (16, 8, 4, 2, 1)
_ROUNDS = 3
_FINER = 4


@dataclass(frozen=True, eq=False)
class Candidate:
    """A box with the set of upper parts that differ most on it.

    Parameters
    ----------
    box : Box
        Lower part of the landmarks.
    bound : RangeBound
        Of the box, lower pixels.
    uppers : tuple of int
        Which of the parts that were tried.
    class_distance : float
        Least d between two of them; infinite for one class, 0 if the box does not carry that many.
    turn_distance : float
        Noncentrality between the box and itself a quarter-turn on.
    checks : tuple of Check
        The rules, those that need images included.
    refined : bool
        Whether it comes from the refinement, not the first search.
    """

    box: Box
    bound: RangeBound
    uppers: tuple[int, ...]
    class_distance: float
    turn_distance: float
    checks: tuple[Check, ...]
    refined: bool = False

    @property
    def feasible(self) -> bool:
        """Whether all rules are kept."""
        return all(check.passes for check in self.checks)

    @property
    def symmetry(self) -> int:
        """From how many sides the box looks the same."""
        return 4 if self.box.length_m == self.box.width_m else 2


@dataclass(frozen=True, eq=False)
class Scored:
    """A set of landmarks on one box and its figures.

    Parameters
    ----------
    specs : tuple of LandmarkSpec
        Landmarks of the set.
    bound : RangeBound
        Of the box.
    class_distances : (n, n) float64
        d of each pair at the worst distance, infinite on the diagonal.
    turn_distance : float
        Noncentrality between the box and itself a quarter-turn on.
    checks : dict of str to tuple of Check
        The rules by landmark.
    """

    specs: tuple[LandmarkSpec, ...]
    bound: RangeBound
    class_distances: NDArray[np.float64]
    turn_distance: float
    checks: dict[str, tuple[Check, ...]]

    @property
    def class_distance(self) -> float:
        """Least d between two classes; infinite for one."""
        return float(self.class_distances.min())

    @property
    def symmetry(self) -> int:
        """From how many sides the box looks the same."""
        return self.specs[0].symmetry


class Search:
    """One search: what has been rendered is kept.

    Parameters
    ----------
    plan : DesignPlan
    workers : int
        Threads that render.

    Raises
    ------
    UsageError
        The sensor does not suit, or no landmark can serve the range.
    """

    def __init__(self, plan: DesignPlan, workers: int = 1) -> None:
        self.plan = plan
        self.sensor: Sensor = plan.build_sensor()
        self.allowed = AllowedDimensions(plan, self.sensor)
        self.allowed.check_possible()
        self.lattice = Lattice(plan.search.step_mm)
        self.workers = workers
        self.bound = cache(lambda box: range_bound(box_alone(box, plan), self.sensor, plan, workers=workers))
        """Return the bound of a box."""
        self.turn = cache(lambda box: turn_distance(box, self.sensor, plan))
        """Return how far a box is from itself a quarter-turn on."""
        self.uppers: list[Upper] = []
        self._seen: list[Appearance] = []
        self._distances: ClassDistances | None = None

    def look_at_uppers(self, progress: Callable[[], None]) -> None:
        """Render the parts that may stand on a box, and compare them; those too dim or too small are dropped."""
        least = self.plan.limits.least_upper_px
        for upper in sample_uppers(self.plan, self.allowed, self.lattice):
            seen = upper_appearance(upper, self.sensor, self.plan)
            progress()
            if upper_pixels(seen) >= least:
                self.uppers.append(upper)
                self._seen.append(seen)
        self._distances = ClassDistances.between(self._seen)

    def candidate(self, box: Box, *, refined: bool = False) -> Candidate:
        """Score a box, with the best set of the parts it carries."""
        assert self._distances is not None
        bound = self.bound(box)
        carried = np.array([k for k, upper in enumerate(self.uppers) if self._carries(box, upper)], np.int64)
        n = self.plan.n_classes
        chosen: tuple[int, ...] = ()
        distance = 0.0
        if len(carried) >= n:
            least = self._distances.least(bound.distance_information)[np.ix_(carried, carried)]
            picked = choose_far_apart(least, n)
            chosen = tuple(int(k) for k in carried[picked])
            distance = float(least[np.ix_(picked, picked)].min()) if n > 1 else math.inf
        turn = self.turn(box)
        checks = (*self.allowed.checks(box_alone(box, self.plan)), *self._seen_checks(bound, distance, turn))
        return Candidate(box, bound, chosen, distance, turn, checks, refined)

    def _carries(self, box: Box, upper: Upper) -> bool:
        return all(check.passes for check in self.allowed.upper_checks(box, upper))

    def _seen_checks(self, bound: RangeBound, class_distance: float, turn: float) -> Iterator[Check]:
        limits = self.plan.limits
        pixels = float(bound.pixels[-1].min())
        yield Check("pixels on the box, far end", pixels, limits.least_lower_px, "px", False)
        yield Check("classes told apart, d", class_distance, limits.least_class_distance, "σ", False)
        yield Check("sides told apart, d", turn, limits.least_turn_distance, "σ", False)

    def refine_box(self, start: Candidate, progress: Callable[[], None]) -> Candidate:
        """Move a candidate's box along the lattice, smaller and smaller steps, as long as its worst bound falls."""
        best = start
        square = start.symmetry == 4
        moves = (
            ((1, 1, 0), (0, 0, 1), (1, 1, -1), (1, 1, -2)) if square else tuple(itertools.product((-1, 0, 1), repeat=3))
        )
        for step in _BOX_MOVES:
            for _ in range(_ROUNDS):
                moved = False
                for move, sign in itertools.product(moves, (1, -1) if square else (1,)):
                    box = self._moved(best.box, tuple(sign * step * m for m in move))
                    progress()
                    if box is None or (box.length_m == box.width_m) != square:
                        continue
                    if self.bound(box).worst_m >= best.bound.worst_m:
                        continue
                    candidate = self.candidate(box, refined=True)
                    if candidate.feasible:
                        best, moved = candidate, True
                if not moved:
                    break
        return best

    def _moved(self, box: Box, move: Sequence[int]) -> Box | None:
        sides = (box.length_m, box.width_m, box.height_m)
        steps = [round(side * 1000 / self.lattice.step_mm) + change for side, change in zip(sides, move, strict=True)]
        if min(steps) < 1 or steps[0] < steps[1]:
            return None
        moved = box_of(self.lattice, (steps[0], steps[1], steps[2]))
        kept = all(check.passes for check in self.allowed.checks(box_alone(moved, self.plan)))
        return moved if kept else None

    def refine_uppers(self, candidate: Candidate, progress: Callable[[], None]) -> tuple[Upper, ...]:
        """Change the parts of a set along the lattice as long as the least distance between two of them grows."""
        information = candidate.bound.distance_information
        uppers = [self.uppers[k] for k in candidate.uppers]
        seen = [self._seen[k] for k in candidate.uppers]
        if len(uppers) < 2:
            return tuple(uppers)
        best = ClassDistances.between(seen).least(information)
        for step in _UPPER_MOVES:
            for _ in range(_ROUNDS):
                moved = False
                for k in range(len(uppers)):
                    for changed in neighbours(uppers[k], step, self.lattice):
                        progress()
                        if not self._carries(candidate.box, changed):
                            continue
                        look = upper_appearance(changed, self.sensor, self.plan)
                        if upper_pixels(look) < self.plan.limits.least_upper_px:
                            continue
                        trial = [*seen[:k], look, *seen[k + 1 :]]
                        distances = ClassDistances.between(trial).least(information)
                        if _ordered(distances) > _ordered(best):
                            uppers[k], seen, best, moved = changed, trial, distances, True
                if not moved:
                    break
        return tuple(uppers)

    def score(self, specs: Sequence[LandmarkSpec]) -> Scored:
        """Score landmarks that share a box, with every rule; the bound four times as finely as the search took it."""
        box = specs[0].box
        bound = range_bound(
            box_alone(box, self.plan),
            self.sensor,
            self.plan,
            distance_m=_finer(self.plan.sampled_distance_m),
            delta_rad=_finer(self.plan.sampled_delta_rad(specs[0].symmetry)),
            workers=self.workers,
        )
        information = self.bound(box).distance_information
        seen = {s.name: upper_appearance(s.upper, self.sensor, self.plan) for s in specs if s.upper is not None}
        distances = ClassDistances.between(list(seen.values())).least(information)
        turn = self.turn(box)
        checks = {}
        for k, spec in enumerate(specs):
            own = distances[k].min() if len(specs) > 1 else math.inf
            least = self.plan.limits.least_upper_px
            checks[spec.name] = (
                *self.allowed.checks(spec),
                *self._seen_checks(bound, float(own), turn),
                Check("pixels on the upper part, far end", upper_pixels(seen[spec.name]), least, "px", False),
            )
        return Scored(tuple(specs), bound, distances, turn, checks)


def _finer(grid: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linspace(grid[0], grid[-1], _FINER * (len(grid) - 1) + 1)


def upper_pixels(seen: Appearance) -> int:
    """Return how many pixels count at the last distance."""
    return int((seen.weight[-1] > 0).sum())


def _ordered(distances: NDArray[np.float64]) -> tuple[float, ...]:
    """Return the distances of all pairs, ascending, rounded so that ties are ties: the least counts first."""
    pairs = distances[np.triu_indices(len(distances), 1)]
    return tuple(np.sort(pairs).round(6).tolist())


@dataclass(frozen=True, eq=False)
class Design:
    """Result of a search.

    Parameters
    ----------
    plan : DesignPlan
        Plan of the design.
    candidates : tuple of Candidate
        Every box with its set, refined ones last.
    chosen : Candidate
        The set that was chosen.
    result, catalogue : Scored
        The set that was found, and the catalogue by the same measure.
    search : Search
        All candidates that were tried.
    """

    plan: DesignPlan
    candidates: tuple[Candidate, ...]
    chosen: Candidate
    result: Scored
    catalogue: Scored
    search: Search = field(repr=False)

    @property
    def factor(self) -> float:
        """By how much the worst position bound is lower than the catalogue's."""
        return self.catalogue.bound.worst_m / self.result.bound.worst_m

    def front(self) -> list[Candidate]:
        """Return the feasible candidates no other beats in both worst position bound and class distance."""
        rows = sorted((c for c in self.candidates if c.feasible), key=_rank)
        front: list[Candidate] = []
        for candidate in rows:
            if not front or candidate.class_distance > front[-1].class_distance:
                front.append(candidate)
        return front


def run_design(plan: DesignPlan, *, workers: int | None = None, progress: Progress | None = None) -> Design:
    """Search a set of landmarks for a camera and a working range; the same plan gives the same set.

    Parameters
    ----------
    plan : DesignPlan
        Plan of the design.
    workers : int, optional
        Threads that render; None: one for each processor.
    progress : callable (done, total), optional
        Called with the work done and the work in all.

    Returns
    -------
    Design

    Raises
    ------
    UsageError
        The sensor does not suit, or no landmark can serve the range: the rule that fails, with its number.
    InputFileError
        The sensor file cannot be read.
    """
    search = Search(plan, workers or os.cpu_count() or 1)
    usual_refinement = 600  # steps of the refinement that a progress bar reckons with
    step = counter(progress, plan.search.boxes + plan.search.uppers + usual_refinement)
    search.look_at_uppers(step)
    found: list[Candidate] = []
    for steps in sample_boxes(plan, search.allowed, search.lattice):
        found.append(search.candidate(box_of(search.lattice, steps)))
        step()
    feasible = [candidate for candidate in found if candidate.feasible]
    if not feasible:
        raise UsageError(_what_fails(plan, found))
    for symmetry in sorted({candidate.symmetry for candidate in feasible}):
        best = min((c for c in feasible if c.symmetry == symmetry), key=_rank)
        refined = search.refine_box(best, step)
        if refined is not best:
            found.append(refined)
    chosen = min((candidate for candidate in found if candidate.feasible), key=_rank)
    uppers = sorted(search.refine_uppers(chosen, step), key=upper_size, reverse=True)
    specs = [
        LandmarkSpec(name=f"mark-{k}", box=chosen.box, upper=upper, albedo=plan.albedo)
        for k, upper in enumerate(uppers, 1)
    ]
    known = [LandmarkSpec(**{**spec.model_dump(), "albedo": plan.albedo}) for spec in catalog().values()]
    return Design(plan, tuple(found), chosen, search.score(specs), search.score(known), search)


def _rank(candidate: Candidate) -> tuple[float, float]:
    return candidate.bound.worst_m, -candidate.class_distance


def _what_fails(plan: DesignPlan, found: list[Candidate]) -> str:
    """Name the rule that no candidate keeps, or the rules that the best one breaks."""
    near, far = plan.distance_m
    start = f"no landmark can serve {near:g} … {far:g} m"
    if not found:
        return f"{start}: 'search.boxes' gave none to try"
    for checks in zip(*(candidate.checks for candidate in found), strict=True):
        if not any(check.passes for check in checks):
            best = min(checks, key=lambda check: check.value if check.at_most else -check.value)
            return f"{start}: rule {best}, of {len(found)} boxes tried"
    nearest = min(found, key=lambda candidate: sum(not check.passes for check in candidate.checks))
    broken = "; ".join(str(check) for check in nearest.checks if not check.passes)
    return f"{start}: no box of {len(found)} keeps every rule at once; one breaks only {broken}"
