"""A small simulated recording in the form that real ones have, to try the program without a sensor."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError, __version__
from phasemark.data.files.atomic_write import write_atomically
from phasemark.data.files.csv_cell import csv_text
from phasemark.data.measured.recording import npz_bytes
from phasemark.data.seeds import stream
from phasemark.render import Background, Flag, Frames, Renderer, Sensor, Views, capture
from phasemark.render.direct import HistogramRenderer
from phasemark.render.integral.surface_mesh import SurfaceMesh
from phasemark.render.view import VIEW_FIELDS

STATUS_VALID = 5
STATUS_NO_TARGET = 255
STATUS_NO_UPDATE = 0
"""Status codes as the VL53L5CX has them: valid; nothing came back; the zone gave nothing."""

MOST_FRAMES = 100_000
_FORMATS = (".csv", ".npz", ".h5")


@dataclass(frozen=True, eq=False)
class SimulatedRecording:
    """Frames of a simulated camera with the view at which each was taken.

    Parameters
    ----------
    frames : Frames
        One position, n frames, with time stamps.
    views : Views
        n views: the truth.
    class_name : str
        Name of the landmark.
    """

    frames: Frames
    views: Views
    class_name: str


def simulate_recording(
    mesh: SurfaceMesh,
    class_name: str,
    sensor: Sensor,
    views: Views,
    *,
    seed: int,
    albedo: float = 0.8,
    background: Background | None = None,
) -> SimulatedRecording:
    """Simulate a recording of a landmark at the frame rate of the sensor.

    Ranges are those that the chip of a direct sensor with a [histogram] table reports, of the nearest target of every
    zone; of another sensor, the mean over a pixel. Each frame is taken as if the camera stood still meanwhile. A wall
    keeps its distance behind the landmark of the first view, and stands square to the line of sight of each.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        The landmark.
    class_name : str
        Name of the class.
    sensor : Sensor
        The camera.
    views : Views
        One view a frame; a camera at rest has the same each time.
    seed : int
        Root of the noise.
    albedo : float
        Share of light that the landmark returns.
    background : Background, optional
        As seen from the first view.

    Returns
    -------
    SimulatedRecording
        Time stamps in steps of 1 / `frame_rate_hz`, rounded to milliseconds.

    Raises
    ------
    UsageError
        There is no view or too many, or a view cannot be rendered.
    """
    if not 1 <= len(views) <= MOST_FRAMES:
        raise UsageError(f"a simulated recording must have 1 … {MOST_FRAMES} frames, got {len(views)}")
    reports = sensor.histogram is not None
    renderer = (HistogramRenderer if reports else Renderer)(mesh, sensor, albedo=albedo)
    renderer.check_in_view(views)
    taken: list[Frames] = []
    image: Any = None
    rendered = None
    for k in range(len(views)):
        view = views[k : k + 1]
        at = tuple(float(getattr(view, name)[0]) for name in VIEW_FIELDS)
        if image is None or at != rendered:
            behind = background
            if background is not None and background.wall_m is not None:
                behind = replace(background, wall_m=background.wall_m + at[0] - float(views.distance_m[0]))
            image, rendered = renderer.render_views(view, background=behind), at
        shot: Any = capture(image, sensor, rng=stream(seed, "simulated recording", 0), first_frame=k)
        taken.append(shot.ranges if reports else shot)

    stamps = np.round(np.arange(len(views)) / sensor.frame_rate_hz, 3)[None]
    return SimulatedRecording(_one_after_the_other(taken, stamps), views, class_name)


def _one_after_the_other(taken: Sequence[Frames], time_s: NDArray[np.float64] | None = None) -> Frames:
    """Return frames of one position from single ones."""

    def joined(name: str) -> NDArray[Any] | None:
        parts = [getattr(frame, name) for frame in taken]
        return None if parts[0] is None else np.concatenate(parts, axis=1)

    range_m = joined("range_m")
    assert range_m is not None
    own = [frame.by_frequency for frame in taken] if len(taken[0].sensor.frequencies_hz) > 1 else []
    return Frames(
        range_m,
        joined("amplitude_e"),
        joined("intensity_e"),
        flags=joined("flags"),
        sensor=taken[0].sensor,
        time_s=time_s,
        by_frequency=[_one_after_the_other(parts) for parts in zip(*own, strict=True)],
    )


def write_recording(
    recording: SimulatedRecording, path: str | os.PathLike[str], *, description: str = "", force: bool = False
) -> Path:
    """Write a simulated recording in a form that :func:`~phasemark.data.read_frames` reads.

    The recording of a direct sensor has z in whole millimetres, 0 where there is no reading, and status codes (5:
    valid). That of another sensor has ranges in metres, amplitudes and intensities; a pixel without a valid range is
    empty in CSV and has ``valid`` 0 in arrays. All have time stamps and the truth of each frame as ``truth_*``. All say
    that they are simulated: the first line of CSV, the array ``simulated`` of NPZ, the attribute ``simulated`` of HDF5.

    Parameters
    ----------
    recording : SimulatedRecording
        Frames with their views.
    path : path-like
        Its suffix gives the form: .csv, .npz or .h5.
    description : str
        What is said of the recording beside that it is simulated; one line.
    force : bool
        Whether an existing file may be replaced.

    Returns
    -------
    Path
        `path`.

    Raises
    ------
    UsageError
        The suffix is none of these.
    OutputExistsError, StorageError
        As :func:`~phasemark.data.files.write_atomically`.
    """
    path = Path(path)
    suffix = recording_format(path)
    told = " ".join(f"simulated by phasemark {__version__} {description}".split())
    if suffix == ".csv":
        return write_atomically(path, _csv(recording, told).encode(), force=force)
    arrays, unit, quantity = _arrays(recording)
    if suffix == ".npz":
        content = npz_bytes({**arrays, "unit": unit, "quantity": quantity, "simulated": told})
        return write_atomically(path, content, force=force)
    buffer = io.BytesIO()  # HDF5 can end the program where a disk is full
    with h5py.File(buffer, "w") as file:
        file.attrs["simulated"] = told
        for name, values in arrays.items():
            file[name] = str(values) if values.dtype.kind == "U" else values
        file["range"].attrs.update({"units": unit, "quantity": quantity})
    return write_atomically(path, buffer.getvalue(), force=force)


def recording_format(path: Path) -> str:
    """Return the suffix of a recording.

    Raises
    ------
    UsageError
        It is not one that recordings are written with.
    """
    suffix = path.suffix.lower()
    if suffix not in _FORMATS:
        raise UsageError(f"the recording must be a {', '.join(_FORMATS[:-1])} or {_FORMATS[-1]} file, got '{path}'")
    return suffix


def _truth(views: Views) -> dict[str, NDArray[np.float64]]:
    """Return the columns of a recording that state the view of each frame."""
    fields = {name: getattr(views, name) for name in (VIEW_FIELDS if views.are_tilted else VIEW_FIELDS[:4])}
    return {
        f"truth_{name.replace('_rad', '_deg')}": np.degrees(values) if name.endswith("_rad") else values
        for name, values in fields.items()
    }


def _arrays(recording: SimulatedRecording) -> tuple[dict[str, NDArray[Any]], str, str]:
    """Return the arrays of NPZ and HDF5 files, with unit and quantity."""
    frames = recording.frames
    assert frames.time_s is not None
    arrays: dict[str, NDArray[Any]] = {"t_s": frames.time_s[0]}
    direct = frames.sensor.kind == "direct"
    if direct:
        arrays["range"] = np.round(1e3 * np.nan_to_num(frames.z_m[0])).astype(np.int64)  # 0 where there is no reading
        without = np.where((frames.flags[0] & int(Flag.MISSING)) > 0, STATUS_NO_UPDATE, STATUS_NO_TARGET)
        arrays["status"] = np.where(frames.valid[0], STATUS_VALID, without)
    else:
        arrays["range"], arrays["valid"] = frames.range_m[0], frames.valid[0]
        measured = {"amplitude": frames.amplitude_e, "intensity": frames.intensity_e}
        arrays |= {name: values[0] for name, values in measured.items() if values is not None}
    arrays |= {**_truth(recording.views), "truth_class": np.array(recording.class_name)}
    return arrays, "mm" if direct else "m", "z" if direct else "range"


def _csv(recording: SimulatedRecording, told: str) -> str:
    arrays, unit, quantity = _arrays(recording)
    n = len(recording.views)
    columns: dict[str, list[str]] = {"t_ms": [f"{1e3 * time:.0f}" for time in arrays["t_s"]]}
    if quantity == "z":
        groups = {"mm": (arrays["range"], "d"), "status": (arrays["status"], "d")}
    else:
        groups = {"range": (np.where(arrays["valid"], arrays["range"], np.nan), ".5f")}
        groups |= {name: (arrays[name], ".2f") for name in ("amplitude", "intensity") if name in arrays}
    for prefix, (values, form) in groups.items():
        for k, pixel in enumerate(values.reshape(n, -1).T):
            columns[f"{prefix}_{k}"] = ["" if value != value else format(value, form) for value in pixel]
    for name, values in _truth(recording.views).items():
        columns[name] = [f"{value:.9g}" for value in values]
    columns["truth_class"] = [recording.class_name] * n
    table = csv_text([tuple(columns), *zip(*columns.values(), strict=True)])
    return f"# {told} unit={unit} quantity={quantity}\n{table}"
