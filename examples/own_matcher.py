"""A matcher of your own, and how far it is from the bound: the median range, as a first idea.

``python examples/own_matcher.py --out out/own``; or, in the folder of this file,
``phasemark sweep run own_matcher.toml --matcher own_matcher:match --out out/own``, which does the same.

A matcher is any callable from :class:`phasemark.matcher.FilteredFrames`, n positions, to a sequence of n
:class:`phasemark.matcher.Match`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from phasemark import PhasemarkError, UsageError
from phasemark.matcher import FilteredFrames, Match, run_sweep
from phasemark.matcher.sweep import Method, SweepPlan, read_sweep, read_sweep_plan
from phasemark.matcher.sweep.report import write_report

AXIS_BEHIND_FACE_M = 0.10
"""How far the landmark's axis lies behind what is seen of it, roughly: the box is 24 × 16 cm."""


def match(frames: FilteredFrames) -> list[Match]:
    """Take the median range as the distance; say nothing of the side, and always the same class."""
    found = []
    for range_m in frames.range_m:
        if not np.isfinite(range_m).any():
            found.append(Match(class_name=None, accepted=False))
            continue
        distance_m = float(np.nanmedian(range_m)) + AXIS_BEHIND_FACE_M
        found.append(Match(class_name="cylinder", accepted=True, distance_m=distance_m, delta_rad=np.pi / 4))
    return found


def main() -> int:
    """Judge this matcher beside the paper's, on the same noisy frames."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=10, help="trials of each condition (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/own"), help="folder of the report (%(default)s)")
    arguments = parser.parse_args()
    sys.path.append(str(Path(__file__).parent))  # where the sweep finds the matcher by its name
    try:
        plan = read_sweep_plan(Path(__file__).with_suffix(".toml"))
        own = Method(name="median range", method="own_matcher:match", bank_step=plan.methods[0].bank_step)
        changes = {"trials": arguments.trials, "methods": (*plan.methods, own)}
        plan = SweepPlan(**{**plan.model_dump(), **changes})
        run_sweep(plan, arguments.out, force=True)
        report = write_report(arguments.out)
        cells = read_sweep(arguments.out)[1].cells()
    except (PhasemarkError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code if isinstance(error, PhasemarkError) else UsageError.exit_code
    for cell in cells:
        row = cell.row()
        print(
            f"{row['method']:>14}  {row['class_name']:<8}  D {row['distance_m']:.1f} m:"
            "  r.m.s. error"
            f" {1e3 * row['rmse_with_outliers_distance_m']:6.2f} mm, bound {1e3 * row['bound_distance_m']:.2f} mm,"
            f" class right {100 * row['class_right']:.0f} %"
        )
    print(report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
