"""Commands of ``phasemark sensor``: presets, sensor files, and sensors fitted to frames or histograms."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from phasemark import UsageError
from phasemark.data.commands.command import Shown, Without
from phasemark.data.commands.console import LongWork, echo, echo_json, echo_table, readable, tell
from phasemark.data.commands.inputs import note_too_far, read_sensor, read_sensor_sources
from phasemark.data.commands.options import Force, FrameReading, Json, Metres, Out, SensorName
from phasemark.data.commands.outputs import refuse_existing, refuse_other_files, write_figure, write_file
from phasemark.inputs.numbers import in_words
from phasemark.inputs.toml_file import toml_value

if TYPE_CHECKING:
    from pydantic import BaseModel

    from phasemark.render import Sensor
    from phasemark.render.bench.fit.fitted_sensor import FittedField
    from phasemark.render.direct import DirectFit, ObjectRecording
    from phasemark.render.sensor.camera_info import CameraInfo


def sensor_list(*, as_json: Json = False) -> None:
    """List the shipped presets."""
    from phasemark.render import preset, preset_names

    sensors = {name: preset(name) for name in preset_names()}
    if as_json:
        return echo_json([{"name": name, **sensor.as_dict()} for name, sensor in sensors.items()])
    rows = []
    for name, sensor in sensors.items():
        angles = f"{2 * sensor.half_angle_v_deg:g}° × {2 * sensor.half_angle_h_deg:g}°"
        modulation, unambiguous = "direct", ""
        if sensor.kind == "phase":
            modulation = " + ".join(f"{hz / 1e6:g}" for hz in sensor.frequencies_hz) + " MHz"
            unambiguous = f"{sensor.unambiguous_range_m:.3f} m"
        rows.append((name, f"{sensor.rows} × {sensor.cols}", angles, modulation, unambiguous))
    echo_table(("preset", "pixels", "field of view", "modulation", "unambiguous range"), rows)


Frequency = Annotated[
    float | None, Shown(metavar="HZ", help="Which of the sensor's modulation frequencies, if it has several.")
]


def which_frequency(sensor: Sensor, hz: float | None) -> int:
    """Return the number of the frequency that an option names; one that has no other needs no name."""
    known = sensor.frequencies_hz
    if hz is None and len(known) == 1:
        return 0
    if hz not in known:
        got = "nothing" if hz is None else f"{hz:.12g}"
        raise UsageError(f"--frequency must be one of the sensor's {in_words(known)} Hz, got {got}")
    return known.index(hz)


def sensor_show(
    name_or_file: SensorName, *, picture: Path | None = None, as_json: Json = False, force: Force = False
) -> None:
    """Print a sensor in groups, and of each number whether it is measured, published or assumed.

    The text is a sensor file again. Fields at their defaults stand in a line of comment; --json prints every field.

    Parameters
    ----------
    picture
        Also write a picture of the pixel grid on the view, .png.
    """
    from phasemark.render.sensor.sensor_file import source_lines

    sensor, sources = read_sensor(name_or_file), read_sensor_sources(name_or_file)
    if picture is not None:
        _write_picture(sensor, picture, force)
    if as_json:
        return echo_json({"name": name_or_file, **sensor.as_dict(), "sources": sources})
    if sensor.kind == "direct":
        axis = "z, along the optical axis" if sensor.quantity == "z" else "the range along the ray"
        echo(f"# direct time of flight: no taps, no modulation; its own quantity is {axis}")
        echo("# modulation_hz: of the model alone, so slow that ranges in a zone are averaged by their light")
    else:
        scales = ", ".join(f"{camera.metres_per_radian:.6f}" for camera in sensor.by_frequency)
        echo(f"# unambiguous range {sensor.unambiguous_range_m:.4f} m, {scales} m per radian")
        if len(sensor.frequencies_hz) > 1:
            echo("# multipath is not told: that takes one modulation frequency")
        elif sensor.lamp_half_angle_deg is None:
            echo("# multipath is not told: set lamp_half_angle_deg, how far off the axis the lamp shines")
        else:
            echo("# multipath that is not modelled is told by match and accuracy, and is in the covariance of answers")
    echo(f"# {_sources_counted(sources)}")
    from phasemark.render.sensor.sensor_fields import DIRECT_ONLY, PHASE_ONLY, TABLES

    fields = sensor.model_dump(mode="json")
    tables = {name: fields.pop(name) for name in TABLES if name in fields}  # they stand behind all fields
    foreign = DIRECT_ONLY if sensor.kind == "phase" else PHASE_ONLY
    for name in foreign:  # a camera of this kind has none of them
        if fields.get(name) in (None, _default(type(sensor), name)) and name not in sources:
            fields.pop(name, None)
    for title, names in sensor.field_groups().items():
        if not any(name in fields for name in names):
            continue
        _echo_group(f"# {title}", {name: fields[name] for name in names if name in fields}, type(sensor), sources)
    for title, table in tables.items():
        own = {name.removeprefix(f"{title}."): text for name, text in sources.items() if name.startswith(f"{title}.")}
        _echo_group(f"[{title}]", table, TABLES[title], own)
    echo(*source_lines(sources))


def _sources_counted(sources: Mapping[str, str]) -> str:
    """Count the numbers that are measured, published and assumed."""
    from phasemark.render.sensor.sources import SOURCE_KINDS, kind_of_source

    if not sources:
        return "where its numbers come from is not stated: a table [source] would say it"
    kinds = [kind_of_source(text) for text in sources.values()]
    return ", ".join(f"{kinds.count(kind)} {kind}" for kind in SOURCE_KINDS)


def _default(model: type[BaseModel], name: str) -> object:
    """Return the default of a field as JSON has it."""
    default = model.model_fields[name].default
    return list(default) if isinstance(default, tuple) else default


def _echo_group(title: str, fields: Mapping[str, object], model: type[BaseModel], sources: Mapping[str, str]) -> None:
    """Print fields as lines of a sensor file, each with its source; those at their defaults in one comment."""
    shown, rest = [], []
    for name, value in fields.items():
        required = model.model_fields[name].is_required()
        if value is None or (name not in sources and not required and value == _default(model, name)):
            rest.append(f"{name} {'not set' if value is None else json.dumps(value)}")
        else:
            shown.append(f"{name} = {toml_value(value)}" + (f"  # {sources[name]}" if name in sources else ""))
    named = "at their defaults" if shown or title.startswith("[") else f"{title.removeprefix('# ')}, at their defaults"
    listed = f"{named}: {', '.join(rest)}" if rest else ""
    echo("" if named != "at their defaults" else f"\n{title}", *shown)
    echo(*(f"# {line}" for line in textwrap.wrap(listed, 118)))


def _write_picture(sensor: Sensor, picture: Path, force: bool) -> None:
    """Write the picture of a sensor's pixel grid."""
    from phasemark.render.figures import pixel_grid_figure

    if picture.suffix != ".png":
        raise UsageError(f"--picture must end in .png, got '{picture}'")
    refuse_existing([picture], force)
    write_figure(picture, pixel_grid_figure(sensor), force)


def sensor_import(
    camera_info: Path,
    *,
    out: Out,
    like: SensorName | None = None,
    modulation: Annotated[float | None, Shown(metavar="HZ")] = None,
    as_json: Json = False,
    force: Force = False,
) -> None:
    """Make a sensor file from the intrinsics that ROS or OpenCV calibrated.

    Parameters
    ----------
    camera_info
        A camera_info of ROS 1 or ROS 2, .yaml.
    out
        The sensor file to write, .toml.
    like
        The preset or sensor file of all other fields; without it those of pmd-16x16 are assumed.
    modulation
        Modulation frequency; by default that of --like.
    """
    from phasemark.render.sensor.camera_info import read_camera_info
    from phasemark.render.sensor.lens_fields import DERIVED
    from phasemark.render.sensor.sensor_file import sensor_toml

    if out.suffix != ".toml":
        raise UsageError(f"--out must end in .toml, got '{out}'")
    refuse_existing([out], force)
    found = read_camera_info(camera_info)
    chosen = like or "pmd-16x16"
    base, origin = read_sensor(chosen), readable(chosen)
    if base.histogram is not None:
        raise UsageError(
            f"--like must be a camera without [histogram], got '{chosen}': zones have no lens of this kind"
        )
    sensor = _with_lens_of(found, base, modulation)
    measured, assumed = f"measured: {camera_info.name}", f"assumed (from {origin})"
    own = {"rows", "cols", *DERIVED, *(name for name, value in sensor if value != getattr(base, name))}
    # a number that is published of a camera which nobody named is no more than assumed of this one
    stated = {k: f"{v} ({origin})" if like else assumed for k, v in read_sensor_sources(chosen).items()}
    comments = {k: v for k, v in stated.items() if k in type(base).model_fields and k not in own}
    if like is None:
        tell(
            f"note: {camera_info.name} states the lens alone; assumed from {origin}: {', '.join(comments)}; "
            "--like NAME|FILE takes them from another camera"
        )
    comments |= {"rows": measured, "cols": measured}
    comments |= {f"lens.{name}": measured for name in type(found.lens).model_fields}
    if modulation is not None:
        comments["modulation_hz"] = "stated when this file was made"
    header = [
        f"Made by phasemark from {camera_info.name} ({found.distortion_model}); all else is as in {origin}.",
        "Half angles and principal point follow from [lens]. OpenCV counts pixels from the centre of the first one.",
    ]
    write_file(out, sensor_toml(sensor, comments, header=header, otherwise=assumed), force)
    echo_json({"file": str(out), **sensor.as_dict()}) if as_json else echo(out)


def _with_lens_of(found: CameraInfo, base: Sensor, modulation_hz: float | None) -> Sensor:
    """Return a camera with another lens and number of pixels, without what belongs to the pixels or the old lens."""
    from phasemark.render.sensor.lens_fields import DERIVED, LENS_FIELD
    from phasemark.render.sensor.sensor_fields import TABLES

    fields = {name: value for name, value in base.model_dump().items() if name not in (*DERIVED, *TABLES)}
    fields |= base.calibration_without(lambda name: name.startswith(LENS_FIELD) or name in DERIVED)
    fields |= {name: () for name in ("dead_pixels", "hot_pixels", "zone_offset_m") if fields[name]}
    fields |= {} if modulation_hz is None else {"modulation_hz": modulation_hz}
    return type(base)(**{**fields, "rows": found.rows, "cols": found.cols, "lens": found.lens})


def sensor_fit(
    frames: list[Path],
    *,
    distance: list[Metres],
    out: Out,
    albedo: list[float] | None = None,
    distance_std: list[Metres] | None = None,
    sensor: SensorName = "pmd-16x16",
    amplitude_unit: Literal["electrons", "arbitrary"] = "electrons",
    reading: Annotated[FrameReading, Without("invalid_means")],
    frequency: Frequency = None,
    as_json: Json = False,
    force: Force = False,
) -> None:
    """Fit a sensor to measured frames of a flat board that fills the image, square to the camera.

    Give the board's distance for each file, in order: FRAMES FRAMES --distance 1.0 --distance 2.0. Geometry and
    whatever the frames do not tell come from --sensor; the file says of each number whether it is measured or assumed.

    Parameters
    ----------
    frames
        Frames of a flat board: CSV, NPY, NPZ or HDF5.
    distance
        Distance of the board; once for each FRAMES, in order.
    out
        The sensor file to write, .toml.
    albedo
        Albedo of the board, one for all or one for each; 0.8 is assumed.
    distance_std
        Standard deviation of the distances, one for all or one for each; 0.001 is assumed.
    amplitude_unit
        Unit of amplitude and intensity.
    """
    from phasemark.render.bench.fit.fit_sensor import fit_sensor

    refuse_other_files(out, ".toml", "the sensor")
    refuse_existing([out], force)
    base = read_sensor(sensor)
    which = which_frequency(base, frequency)
    measured = [reading.read(path, base) for path in frames]
    note_too_far(base, {"--distance": max(distance)})
    for path, one in zip(frames, measured, strict=True):
        if not one.by_frequency:
            raise UsageError(f"{path}: holds unwrapped ranges alone, and a fit takes what each frequency measured")
    measured, base = [one.by_frequency[which] for one in measured], base.by_frequency[which]
    positions = [one[k : k + 1] for one in measured for k in range(len(one))]  # each position of a file has a distance
    fit = fit_sensor(
        positions, distance, base=base, albedo=albedo or None, amplitude_unit=amplitude_unit,
        distance_std_m=distance_std or None,
    )  # fmt: skip
    write_file(out, fit.to_toml(base_name=readable(sensor)), force)
    if as_json:
        return echo_json({"file": str(out), **fit.as_dict()})
    fields = fit.sensor.model_dump(mode="json")
    echo_table(
        ("field", "value", "std error", "from"),
        ((name, *value_and_error_of(fields[name], one), one.note) for name, one in fit.estimates.items()),
    )
    echo(*fit.notes, out)


def value_and_error_of(value: object, estimate: FittedField) -> tuple[str, str]:
    """Write a fitted field and its standard error, rounded alike; pixels are counted and have no error."""
    from phasemark.render.integral.rounding import value_and_error

    if estimate.std_error is None:
        return _short(value), "assumed"
    text, error = value_and_error(value if isinstance(value, float) else estimate.value, estimate.std_error)
    return (text if isinstance(value, float) and error else _short(value)), error


def _short(value: object) -> str:
    """Write a field's value for a table; a list of pixels as their number."""
    if isinstance(value, float):
        return f"{value:.5g}"
    return f"{len(value)} in all" if isinstance(value, list) else str(value)


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
    from phasemark.render.direct import fit_direct_sensor, score_zone_orders
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
    scores: dict[str, float] = {}
    if known and base.histogram is not None:
        plain = base.with_(histogram={**base.histogram.model_dump(), "zone_order": ()})
        scores = score_zone_orders(_object(known[0], plain), plain)
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
