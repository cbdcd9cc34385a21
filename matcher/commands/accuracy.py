"""Commands that state accuracy: of a landmark before a camera, of the camera itself, and of measured poses."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from phasemark import PhasemarkError, UsageError
from phasemark.data.commands.command import Shown
from phasemark.data.commands.console import LongWork, Table, echo, echo_json, readable
from phasemark.data.commands.inputs import ClassOrMesh, background_of, class_renderers, note_too_far, read_sensor
from phasemark.data.commands.options import (
    BouncesOfLight,
    Count,
    Degrees,
    Floor,
    Force,
    Json,
    Metres,
    Out,
    Seed,
    SensorName,
    Wall,
)
from phasemark.data.commands.outputs import output_folder
from phasemark.data.commands.sensor import Frequency, which_frequency

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from phasemark.matcher.recordings.pose_table import PoseTable
    from phasemark.render import Sensor, Views


def accuracy_line(
    *,
    distance: Metres,
    delta: Degrees | None = None,
    landmark: ClassOrMesh,
    sensor: SensorName = "pmd-16x16",
    wall: Wall = None,
    floor: Floor = None,
    bounces: BouncesOfLight = "0",
    n_frames: Annotated[Count, Shown("--frames")] = 50,
    as_json: Json = False,
) -> None:
    """Print in one line how accurate a measurement can be, from the Cramér–Rao bound.

    1 σ of distance, angle and position with the bearing free, what limits it, and how often another class of the
    catalogue explains a frame better.

    Parameters
    ----------
    distance
        Distance D to the landmark's axis.
    delta
        Side δ from which the landmark is seen; all sides unless stated.
    n_frames
        Frames averaged for one measurement.
    """
    from phasemark.landmarks import catalog
    from phasemark.matcher.accuracy.expected_accuracy import accuracy_card, sides_of
    from phasemark.render import Renderer, Views
    from phasemark.render.view import delta_period_rad

    landmark.check("judge")
    name, mesh = landmark.read()
    camera = read_sensor(sensor)
    note_too_far(camera, {"--distance": distance, "--wall": wall})
    renderer = Renderer(mesh, camera, albedo=mesh.metadata.get("albedo", 0.8))
    views = Views.broadcast(distance, math.radians(delta or 0.0))
    renderer.check_in_view(views)
    if delta is None:  # a mesh is seen from all around
        symmetry = 1 if landmark.class_name is None else catalog()[landmark.class_name].symmetry
        views = sides_of(distance, delta_period_rad(symmetry))
    others = {other: one for other, one in class_renderers(camera).items() if other != landmark.class_name}
    background = background_of(wall, floor, bounces)
    card = accuracy_card(renderer, views, others=others, n_frames=n_frames, background=background)
    if as_json:
        return echo_json({"landmark": name, "sensor": sensor, "wall_m": wall, "floor_m": floor, **card.as_dict()})
    echo(f"{name} {card.line()}")


def sensor_characterise(
    name_or_file: SensorName,
    *,
    out: Out,
    n_frames: Annotated[int | None, Shown("--frames", min=2)] = None,
    seed: Seed = 2005,
    frequency: Frequency = None,
    as_json: Json = False,
    force: Force = False,
) -> None:
    """Measure a sensor before flat fields, as EMVA 1288 would, and compare it with what its numbers predict.

    Parameters
    ----------
    out
        Folder for the report, its pictures and numbers.
    n_frames
        Frames at each point; by default 51200 readings a point.
    """
    from phasemark.data.pages.characterisation import NAMES, summary_sentences, write_characterisation
    from phasemark.data.seeds import stream
    from phasemark.render import characterise

    sensor = read_sensor(name_or_file)
    sensor = sensor.by_frequency[which_frequency(sensor, frequency)]
    with output_folder(out, "sensor characterise", NAMES, force), LongWork("measuring"):
        found = characterise(sensor, rng=stream(seed, "characterise", 0), n_frames=n_frames)
        bound = _bound(sensor, found.reference_range_m)
        report = write_characterisation(found, readable(name_or_file), out, seed=seed, bound=bound, force=force)[0]
    if as_json:
        facts = found.as_dict()
        return echo_json({"report": str(report), "agreement": facts["agreement"], "quantities": facts["quantities"]})
    echo(*summary_sentences(found, name_or_file), *found.notes, report)


def _bound(sensor: Sensor, distance_m: float) -> str | None:
    """Return in one line the best accuracy of a match with a sensor, for the first class of the catalogue.

    None for a sensor without noise, or one that cannot see the landmark there.
    """
    from phasemark.landmarks import catalog
    from phasemark.matcher.accuracy.expected_accuracy import accuracy_card, sides_of
    from phasemark.render.view import delta_period_rad

    name, spec = next(iter(catalog().items()))
    try:
        others = class_renderers(sensor)
        renderer = others.pop(name)
        views = sides_of(distance_m, delta_period_rad(spec.symmetry))
        renderer.check_in_view(views)
        card = accuracy_card(renderer, views, others=others)
    except PhasemarkError:
        return None
    return f"{name} {card.line()}"


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
    table = Table(list(lines[0]))
    table.echo([list(line.values()) for line in lines])
    echo(f"{report.n_measured} of {report.n_poses} poses measured")


def _truth_of(
    found: PoseTable, true: PoseTable, estimates: Path, truth: Path, delay_s: float
) -> tuple[NDArray[np.int64], Views]:
    """Return which estimates have a truth, and the true views of these."""
    import numpy as np

    from phasemark.render import Views

    if not true.known.all():
        raise UsageError(f"{truth}: pose {int(np.argmin(true.known))} has an empty cell: every true pose must be whole")
    by_position = true.time_s is None or found.time_s is None or len(true) == len(found)
    if by_position:
        index = np.arange(len(found)) if found.index is None else found.index
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
