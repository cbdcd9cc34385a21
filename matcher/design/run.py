"""A design from plan to result: search, choose, refine, score beside the catalogue."""

from __future__ import annotations

import os

from phasemark import UsageError
from phasemark.data.progress import Progress, counter
from phasemark.landmarks import LandmarkSpec, catalog
from phasemark.landmarks.spec import Upper
from phasemark.matcher.design.plan import DesignPlan
from phasemark.matcher.design.rules import Check, upper_size
from phasemark.matcher.design.search import Candidate, Design, Search
from phasemark.matcher.design.shapes import box_of, sample_boxes


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
    specs = [specification(f"mark-{k + 1}", chosen, upper, plan) for k, upper in enumerate(uppers)]
    known = [LandmarkSpec(**{**spec.model_dump(), "albedo": plan.albedo}) for spec in catalog().values()]
    return Design(plan, tuple(found), chosen, search.score(specs), search.score(known), search)


def specification(name: str, candidate: Candidate, upper: Upper, plan: DesignPlan) -> LandmarkSpec:
    """Return a landmark of a candidate's box."""
    return LandmarkSpec(name=name, box=candidate.box, upper=upper, albedo=plan.albedo)


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
            best = min(checks, key=_missed_by)
            return f"{start}: rule {best}, of {len(found)} boxes tried"
    nearest = min(found, key=lambda candidate: sum(not check.passes for check in candidate.checks))
    broken = "; ".join(str(check) for check in nearest.checks if not check.passes)
    return f"{start}: no box of {len(found)} keeps every rule at once; one breaks only {broken}"


def _missed_by(check: Check) -> float:
    return check.value if check.at_most else -check.value
