"""Command ``phasemark sensor fit-direct``: a direct sensor from histograms of a plane and of known objects."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from phasemark import UsageError
from phasemark.data.commands.command import Shown
from phasemark.data.commands.console import LongWork, echo, echo_json, echo_table, readable, tell
from phasemark.data.commands.inputs import read_sensor
from phasemark.data.commands.options import Force, Json, Metres, Out, SensorName
from phasemark.data.commands.outputs import refuse_existing, refuse_other_files, write_file

if TYPE_CHECKING:
    from phasemark.render import Sensor
    from phasemark.render.direct import DirectFit, ObjectRecording


def sensor_fit_direct(
    plane: Annotated[Path, Shown(metavar="LOG")],
    *,
    out: Out,
    known: Annotated[list[str] | None, Shown("--object", metavar="LOG,MESH")] = None,
    nearest: Metres = 0.06,
    sensor: SensorName = "tmf8820-3x3",
    as_json: Json = False,
    force: Force = False,
) -> None:
    """Fit a direct sensor to histograms of a plane at known distances and of known objects at known poses.

    The plane determines bin widths, delays, response, pile-up and the crosstalk of a cover glass; objects determine
    where each zone looks, the order in which zones are logged, their size and the share of stray light. Each log holds
    `histogram`, a plane's `distance_m`, an object's `sensor2world`; an object's mesh holds the table that it stands on.

    Parameters
    ----------
    plane
        Histograms of a plane with its distances: NPZ or JSON lines.
    out
        The sensor file to write, .toml.
    known
        Histograms of a known object with poses, and its mesh in metres.
    nearest
        Distances of the plane below this are left out.
    """
    from phasemark.data.files.same_file import refuse_inputs
    from phasemark.data.measured.histogram_logs import read_plane
    from phasemark.render.direct import fit_direct_sensor
    from phasemark.render.sensor.sensor_file import sensor_toml

    refuse_other_files(out, ".toml", "the sensor")
    refuse_inputs([out], [Path(part) for text in known or [] for part in text.split(",")])
    refuse_existing([out], force)
    base = read_sensor(sensor)
    if base.histogram is None:
        raise UsageError(f"the sensor '{sensor}' has no [histogram] table: its histograms are not described")
    recording = read_plane(plane, sensor=base, nearest_m=nearest)
    base = recording.frames.sensor
    objects = [_object(text, base) for text in known or []]
    scores = _zone_orders(known, base)
    with LongWork("fitting"):
        fit = fit_direct_sensor(recording, objects, base=base)
    header = [f"Fitted by phasemark to {plane.name}" + "".join(f", {one.name}" for one in objects)]
    text = sensor_toml(fit.sensor, {}, header=header, otherwise="measured or as the sensor it was fitted from")
    write_file(out, text, force)
    squared = (fit.plane_range_m(recording) - recording.distance_m[:, None]) ** 2
    spread_mm = (1e3 * squared.mean(axis=0) ** 0.5).tolist()
    if as_json:
        return echo_json({"file": str(out), **fit.as_dict(), "range_rms_mm": spread_mm, "zone_orders": scores})
    _echo_fit(fit, spread_mm)
    if scores:
        best, second = sorted(scores, key=lambda name: scores[name])[:2]
        echo(
            f"Zones are logged by {best}: the centroid's error is {1e3 * scores[best]:.1f} mm, that of the next order"
            f" {1e3 * scores[second]:.1f} mm."
        )
    else:
        tell(f"without --object the directions of zones are those of {readable(sensor)}: a plane does not tell them")
    echo(out)


def _echo_fit(fit: DirectFit, spread_mm: list[float]) -> None:
    """Print the fitted parameters, and how well each zone measures the plane."""
    values = fit.parameters.items()
    rows = [(name, f"{value:.5g}", f"{fit.std[name]:.2g}" if name in fit.std else "fixed") for name, value in values]
    glass = fit.crosstalk
    rows.append(("crosstalk", f"{glass.counts:.5g}", f"{glass.counts_std:.2g}"))
    if glass.counts:
        rows.append(("crosstalk_range_m", f"{glass.range_m:.5g}", f"{glass.range_std_m:.2g}"))
    echo_table(("parameter", "value", "std"), rows)
    echo_table(
        ("zone", "range r.m.s. (mm)", "chi2/nu"),
        ((str(k), f"{s:.2f}", f"{c:.3g}") for k, (s, c) in enumerate(zip(spread_mm, fit.reduced_chi2, strict=True))),
    )


def _zone_orders(known: list[str] | None, base: Sensor) -> dict[str, float]:
    """Return the score of each order of the zones from the first object; nothing without one."""
    from phasemark.render.direct import score_zone_orders

    if not known or base.histogram is None:
        return {}
    plain = base.with_(histogram={**base.histogram.model_dump(), "zone_order": ()})
    return score_zone_orders(_object(known[0], plain), plain)


def _object(text: str, sensor: Sensor) -> ObjectRecording:
    """Return the recording of an object that an option names as LOG,MESH."""
    from phasemark.data.measured.histogram_logs import read_histograms
    from phasemark.landmarks import read_mesh
    from phasemark.render.direct.recordings import ObjectRecording, label_object, support_height

    log_path, _, mesh_path = text.partition(",")
    if not mesh_path:
        raise UsageError(f"--object must be LOG,MESH, got '{text}'")
    log = read_histograms(log_path, sensor=sensor)
    if log.sensor2world is None:
        raise UsageError(f"{log_path} must state 'sensor2world', the pose of the sensor in each frame")
    mesh = read_mesh(mesh_path, unit="m")
    name = Path(mesh_path).stem.replace("-", "_")
    return ObjectRecording(name, log.frames, label_object(mesh, support_height(mesh)), log.sensor2world)
