"""The command ``phasemark pose report``: measured poses against true ones."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from phasemark import UsageError
from phasemark.data.commands.command import Shown
from phasemark.data.commands.console import echo, echo_json, echo_table
from phasemark.data.commands.options import Count, Json

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from phasemark.matcher.recordings.pose_table import PoseTable
    from phasemark.render import Views


def pose_report(
    measured: Annotated[Path, Shown(metavar="ESTIMATES")],
    truth: Path,
    *,
    symmetry: Count = 1,
    delay_s: Annotated[float, Shown("--delay")] = 0.0,
    refused: bool = False,
    as_json: Json = False,
) -> None:
    """Report the errors of measured poses in the terms of ASTM E2919.

    Absolute errors of position and orientation, and those of the motion from one pose to the next: mean, r.m.s.,
    percentiles and maximum, each with its 95 % interval.

    Parameters
    ----------
    measured
        What match --estimates wrote, CSV.
    truth
        True poses by position or by time, or a recording with truth_ columns, CSV.
    symmetry
        Number of turns about its axis that leave the landmark as it is.
    delay_s
        Seconds added to the stamps of the estimates, for poses by time.
    refused
        Count answers that were not accepted, too.
    """
    import numpy as np

    from phasemark.matcher.accuracy.pose_errors import pose_report as report_of
    from phasemark.matcher.accuracy.pose_errors import views_as_poses
    from phasemark.matcher.recordings.pose_table import read_pose_table

    found, true = read_pose_table(measured), read_pose_table(truth)
    rows, views = _truth_of(found, true, measured, truth, delay_s)
    counted = found.known[rows] & (found.accepted[rows] | refused)
    poses = np.full((len(rows), 4, 4), np.nan)
    if counted.any():
        from phasemark.render import Views

        poses[counted] = views_as_poses(Views.broadcast(*found.view[rows[counted]].T))
    report = report_of(poses, views, symmetry=symmetry)
    if as_json:
        return echo_json({"estimates": str(measured), "truth": str(truth), **report.as_dict()})
    lines = report.rows()
    echo_table(list(lines[0]), [list(line.values()) for line in lines])
    echo(f"{report.n_measured} of {report.n_poses} poses measured")


def _truth_of(
    found: PoseTable, true: PoseTable, estimates: Path, truth: Path, delay_s: float
) -> tuple[NDArray[np.int64], Views]:
    """Return which estimates have a truth, and the true views of these."""
    import numpy as np

    from phasemark.render import Views

    if not true.known.all():
        raise UsageError(f"{truth}: pose {int(np.argmin(true.known))} has an empty cell: every true pose must be whole")
    if found.index is not None:
        positions, counts = np.unique(found.index, return_counts=True)
        if len(positions) < len(found):
            twice = int(positions[counts > 1][0])
            raise UsageError(f"{estimates}: position {twice} has more than one estimate: give each once")
    index = np.arange(len(found)) if found.index is None else found.index
    if true.time_s is None or found.time_s is None or (not delay_s and _agree(found.time_s, true.time_s, index)):
        if delay_s:
            raise UsageError("--delay takes stamps (t_s) in both files")
        if index.min() < 0 or index.max() >= len(true):
            raise UsageError(
                f"{truth}: has {len(true)} poses, and {estimates} has an estimate of position {int(index.max())}:"
                " give one true pose for each position, or stamps (t_s) in both files"
            )
        return np.arange(len(found)), true.views()[index]
    from phasemark.matcher.calibration.known_poses import KnownPoses
    from phasemark.matcher.calibration.pose_track import PoseTrack

    assert found.time_s is not None
    track = PoseTrack.of(KnownPoses.of_views(true.view, time_s=true.time_s))
    at = found.time_s + delay_s
    rows = np.flatnonzero(np.isfinite(at) & track.known(at, at))
    if not rows.size:
        raise UsageError(
            f"{truth}: no estimate of {estimates} was taken between two of its poses: do the clocks agree?"
        )
    return rows, Views.broadcast(*track.at(at[rows])[0].T)


def _agree(found_s: NDArray[np.float64], true_s: NDArray[np.float64], index: NDArray[np.int64]) -> bool:
    """Return whether estimates have the stamps of the true poses at their positions."""
    import numpy as np

    inside = index.min() >= 0 and index.max() < len(true_s)
    return bool(inside and np.allclose(true_s[index], found_s, rtol=0.0, atol=1e-3))
