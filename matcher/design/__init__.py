"""Design of landmarks for a camera and a working range: searched, drawn, and confirmed by simulated frames."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.design.confirm import Confirmation, Trial, confirm, confirm_design
    from phasemark.matcher.design.figures import bound_figure, pareto_figure
    from phasemark.matcher.design.measures import (
        ClassDistances,
        RangeBound,
        choose_far_apart,
        range_bound,
        turn_distance,
    )
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
        read_design_plan,
    )
    from phasemark.matcher.design.rules import AllowedDimensions, Check
    from phasemark.matcher.design.search import Candidate, Design, Scored, run_design
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "AllowedDimensions",
    "Candidate",
    "Check",
    "ClassDistances",
    "Confirmation",
    "Design",
    "DesignPlan",
    "LimitsPlan",
    "RangeBound",
    "SamplingPlan",
    "Scored",
    "SearchPlan",
    "Trial",
    "bound_figure",
    "choose_far_apart",
    "confirm",
    "confirm_design",
    "default_design",
    "example_design",
    "landmarks_toml",
    "mesh_stl",
    "output_names",
    "pareto_csv",
    "pareto_figure",
    "pareto_rows",
    "range_bound",
    "read_design_plan",
    "run_design",
    "summary",
    "turn_distance",
    "write_design",
]
