"""Which landmark to build: searched for a camera and a working range, drawn, and confirmed by simulated frames."""

from typing import TYPE_CHECKING

from phasemark.matcher.design.confirm import Confirmation, Trial, confirm, confirm_design
from phasemark.matcher.design.drawing import drawing_svg
from phasemark.matcher.design.output import (
    landmarks_toml,
    mesh_stl,
    output_names,
    pareto_csv,
    pareto_rows,
    summary,
    write_design,
)
from phasemark.matcher.design.plan import (
    DesignPlan,
    LimitsPlan,
    SamplingPlan,
    SearchPlan,
    default_design,
    example_design,
    load_design_plan,
)
from phasemark.matcher.design.position_bound import RangeBound, range_bound
from phasemark.matcher.design.rules import Check, Room
from phasemark.matcher.design.run import run_design
from phasemark.matcher.design.search import Candidate, Design, Scored
from phasemark.matcher.design.separation import ClassDistances, most_apart, turn_distance

if TYPE_CHECKING:
    from phasemark.matcher.design.figures import bound_picture, pareto_picture

__all__ = [
    "Candidate",
    "Check",
    "ClassDistances",
    "Confirmation",
    "Design",
    "DesignPlan",
    "LimitsPlan",
    "RangeBound",
    "Room",
    "SamplingPlan",
    "Scored",
    "SearchPlan",
    "Trial",
    "bound_picture",
    "confirm",
    "confirm_design",
    "default_design",
    "drawing_svg",
    "example_design",
    "landmarks_toml",
    "load_design_plan",
    "mesh_stl",
    "most_apart",
    "output_names",
    "pareto_csv",
    "pareto_picture",
    "pareto_rows",
    "range_bound",
    "run_design",
    "summary",
    "turn_distance",
    "write_design",
]


def __getattr__(name: str) -> object:
    """Import pictures when they are asked for: matplotlib takes half a second to load."""
    if name in ("bound_picture", "pareto_picture"):
        from phasemark.matcher.design import figures as picture

        return getattr(picture, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
