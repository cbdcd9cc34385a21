"""Frames that somebody else's camera measured, from CSV, NPY, NPZ, HDF5 and PNG files and ROS bags."""

from __future__ import annotations

import io
import math
import os
import warnings
import zipfile
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Literal

import h5py
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from phasemark import InputFileError, PhasemarkError, UsageError
from phasemark.data.files.atomic_write import write_atomically
from phasemark.data.files.guard import FREE_BYTES
from phasemark.data.files.hdf5_reading import open_hdf5
from phasemark.data.measured.bags import read_rosbag
from phasemark.data.measured.boards import HEAD_BYTES, MOST_LOG_BYTES, find_board, read_board_log
from phasemark.data.measured.csv_frames import parse_csv
from phasemark.data.measured.recording import (
    METRES_PER_UNIT,
    SECONDS,
    SECONDS_PER_TIME_UNIT,
    TILTS,
    Orientation,
    Recording,
    impossible_ranges,
    in_seconds,
    note_disorder,
    npz_bytes,
    one_time,
    opened_npz,
)
from phasemark.inputs import opened
from phasemark.inputs.numbers import in_words
from phasemark.render import Frames, Sensor
from phasemark.render.frames import refuse_other_meaning
from phasemark.render.sensor.sensor import refuse_no_sensor
from phasemark.render.unwrapped_frames import unwrap_frames

Unit = Literal["m", "cm", "mm"]
RangeOrZ = Literal["range", "z"]
InvalidMeans = Literal["missing", "no-return"]

QUANTITIES = ("range", "z")

_NUMBERS = ("range", "amplitude", "intensity")
_OF_FREQUENCY = tuple(f"frequency_{name}" for name in _NUMBERS)
_COLUMNS = (*_NUMBERS, "status", "valid", *_OF_FREQUENCY, "frequency", "taps", *SECONDS_PER_TIME_UNIT, *TILTS)
"""Arrays of NPZ and HDF5 files that are read."""
_BESIDE = ("flags", "simulated")
_MOST_PIXELS = 1 << 24
_ELECTRONS = ("e", "e-", "electron", "electrons")
_MOST_BYTES = 1 << 26
"""What is read of a text file or a pipe: most of an hour of 16 × 16 readings, 15 a second."""
_FREE_VALUES = 1 << 24
"""How many values frames may have whatever their file's size: 36 minutes of 16 × 16 pixels at 30 frames a second."""


def read_frames(
    path: str | os.PathLike[str],
    *,
    sensor: Sensor,
    unit: Unit | None = None,
    quantity: RangeOrZ | None = None,
    invalid_means: InvalidMeans = "missing",
    valid_status: Collection[int] | None = None,
    flip_h: bool = False,
    flip_v: bool = False,
    rotate: int = 0,
    untrusted: bool = False,
    topic: str | None = None,
    board: str | None = None,
) -> Frames:
    """Read measured frames; what kind of file it is follows from its content.

    *CSV*: one frame a line, row by row from the top left pixel. Values are separated by semicolons (then decimal
    commas are understood too), tabs, commas or blanks, the first of these that occurs. A first line without a
    number is a header; empty lines and those that start with ``#`` are skipped, but a first line with ``#`` may
    state ``unit=…`` and ``quantity=…``; an empty cell and ``nan`` are invalid pixels. A header may name the
    columns, which then stand in any order: pixels ``mm_0`` … (this states the unit), ``range_0`` … or ``z_0`` …
    (this states the quantity); optionally ``status_0`` …, ``amplitude_0`` …, ``intensity_0`` …; and the time stamp,
    ``t_ms`` or ``t_s``. Other columns are ignored, and a warning names them unless they are ``truth_*``. *NPY*: the
    ranges. *NPZ*: ``range`` and optionally ``amplitude``, ``intensity`` (electrons per phase image), ``status``,
    ``valid`` (0: invalid), ``t_ms`` or ``t_s`` (the shape of ``range`` without rows and columns), ``unit`` and
    ``quantity``. *HDF5*: the same arrays as datasets, with the attributes ``units`` and ``quantity`` on ``range``.
    *PNG*, one or a folder of them in the order of their names: 16 bits, grey, 0 is invalid; codes are in the stated
    unit, or scaled by the text chunk ``metres_per_unit``. *ROS 2 bag* (its folder): images of 32FC1, metres, or
    16UC1, millimetres; 0 is invalid. Arrays are (frames, rows, cols), (n, frames, rows, cols), or (rows, cols) for
    a single frame. *Text that a board's example program prints* (docs/formats.md has the programs): its unit, quantity,
    valid status and order of zones are known, and a frame that is incomplete or garbled is left out with a warning.

    *Several modulation frequencies*: NPZ and HDF5 have ``frequency_range`` and optionally ``frequency_amplitude`` and
    ``frequency_intensity`` with an axis of the sensor's m frequencies before the rows, (frames, m, rows, cols) or (n,
    frames, m, rows, cols), and optionally ``frequency`` (hertz) and ``taps`` (electrons, (…, 4 m, 2, rows, cols)); a
    line of CSV has m times as many values, all of one frequency before those of the next. These ranges are wrapped, and
    are unwrapped here (`unwrap_frames`). What a file has as ``range`` is unwrapped already, and
    is used where the others are missing.

    A range that is not finite is invalid, and so is a 0, by which most sensors mean that they have no reading. So is
    one that the camera cannot measure, and a warning tells how many there are; if it is most of the others, unit or
    sensor are wrong, which is an error. A camera measures no negative range, none beyond c / 2f, and, if it is a direct
    sensor with `max_range_m`, none beyond 1.25 times that.

    Parameters
    ----------
    path : path-like
        The file.
    sensor : Sensor
        The camera that took the frames.
    unit : {"m", "cm", "mm"}
        Unit of the ranges; may be left out if the file states it.
    quantity : {"range", "z"}
        Whether the file has ranges along the ray or distances z along the optical axis; may be left out if the file
        states it. z is converted to range with the ray of the pixel's centre.
    invalid_means : {"missing", "no-return"}
        What an invalid pixel stands for (PHYSICS section 7).
    valid_status : collection of int, optional
        Which values of ``status`` mark a valid pixel; needed if the file has it, since cameras differ. It is 5 for the
        VL53L5CX and VL53L8CX. A status that is empty or NaN is not valid.
    flip_h, flip_v : bool
        Whether to mirror left and right, or top and bottom; the print of a board is brought upright before.
    rotate : {0, 90, 180, 270}
        Degrees to turn the image clockwise, after mirroring.
    untrusted : bool
        Whether a child process with limits reads an HDF5 file first, unless ``FILE.sha256`` vouches for it.
    topic : str, optional
        Which images of a ROS bag, if it has several that are not ours.
    board : str, optional
        Program of a board that printed the text, if several print the same; otherwise it is recognised.

    Returns
    -------
    Frames
        (n, frames, rows, cols), ranges along the ray, metres; with `time_s` if the file has time stamps, and `tilt_rad`
        if it has ``pitch_deg`` or ``roll_deg``.

    Raises
    ------
    InputFileError
        The file cannot be read, is empty or damaged, or its frames do not have the sensor's pixels; names file, line
        and column where there are any.
    UsageError
        `unit` or `quantity` is missing though the file says neither, contradicts the file, or is not one of the above.

    Warns
    -----
    UserWarning
        Some ranges cannot be right, time stamps repeat or run backwards, or columns are ignored.
    """
    path = Path(path)
    if rotate not in (0, 90, 180, 270):
        raise UsageError(f"'rotate' must be 0, 90, 180 or 270, got {rotate!r}")
    refuse_other_meaning(invalid_means)
    refuse_no_sensor(sensor)
    raw = _read(path, shape_before(sensor, rotate), untrusted, topic, sensor, board)
    if board is not None and raw.valid_status is None:
        raise UsageError(f"{path}: board=… goes with text that a board printed: leave it out")
    return frames_of(
        raw, path, sensor=sensor, unit=unit, quantity=quantity, invalid_means=invalid_means,
        valid_status=valid_status, flip_h=flip_h, flip_v=flip_v, rotate=rotate,
    )  # fmt: skip


def shape_before(sensor: Sensor, rotate: int) -> tuple[int, int]:
    """Return rows and columns of a frame before it is turned clockwise by some degrees."""
    return (sensor.cols, sensor.rows) if rotate in (90, 270) else (sensor.rows, sensor.cols)


def frames_of(
    raw: Recording,
    path: Path,
    *,
    sensor: Sensor,
    unit: Unit | None = None,
    quantity: RangeOrZ | None = None,
    invalid_means: InvalidMeans = "missing",
    valid_status: Collection[int] | None = None,
    flip_h: bool = False,
    flip_v: bool = False,
    rotate: int = 0,
) -> Frames:
    """Return the frames of columns that were read; `path` names their origin in messages.

    Parameters
    ----------
    raw : Recording
    path : Path
    sensor, unit, quantity, invalid_means, valid_status, flip_h, flip_v, rotate
        As for :func:`read_frames`.

    Raises
    ------
    InputFileError, UsageError
        As :func:`read_frames`.
    """
    shape = shape_before(sensor, rotate)
    if unit is None and quantity is None and not raw.stated:
        raise UsageError(
            f"{path}: does not say its unit and quantity: give unit={'|'.join(METRES_PER_UNIT)} and"
            " quantity=range (along the ray)|z (along the optical axis)"
        )
    settled_unit = _settled("unit", unit, raw, tuple(METRES_PER_UNIT), path)
    settled_quantity = _settled("quantity", quantity, raw, QUANTITIES, path)

    arrays = _shaped(raw, sensor, shape, path)
    valid = np.ones(arrays["range"].shape, dtype=bool)
    if "valid" in arrays:
        valid &= np.nan_to_num(arrays["valid"]) != 0
    if "status" in arrays:
        valid_status = raw.valid_status if valid_status is None else valid_status
        if valid_status is None:
            raise UsageError(
                f"{path}: has 'status': say with valid_status=… which of its values mark a valid pixel (5 for VL53L5CX"
                " and VL53L8CX)"
            )
        valid &= np.isin(arrays["status"], list(valid_status))
    n_frames = valid.shape[:2]
    time_s = None if raw.time_s is None else _of_each_frame(raw.time_s, "the time stamps", n_frames, path)
    tilts = {name: _of_each_frame(values, f"'{name}'", n_frames, path) for name, values in raw.tilt_deg.items()}
    tilt_rad = np.radians(np.stack([tilts.get(name, np.zeros(n_frames)) for name in TILTS], axis=-1)) if tilts else None
    upright = Orientation(flip_h, rotate)
    arrays = {name: upright.apply(values[..., ::-1, :] if flip_v else values) for name, values in arrays.items()}
    valid = upright.apply(valid[..., ::-1, :] if flip_v else valid)
    taps_e = arrays["taps"].astype(np.float64) if "taps" in arrays else None

    def frames_of(own: Mapping[str, NDArray[Any]], camera: Sensor, taps: NDArray[np.float64] | None) -> Frames:
        with np.errstate(invalid="ignore", over="ignore"):  # what becomes NaN or infinite is invalid
            numbers = {name: own[name].astype(np.float64) for name in _NUMBERS if name in own}
            range_m = numbers["range"] * METRES_PER_UNIT[settled_unit]
        if settled_quantity == "z":
            range_m = range_m / sensor.axis_cosine()
        usable = valid & np.isfinite(range_m)
        usable &= ~impossible_ranges(range_m, usable, camera, settled_unit, path, is_stated="unit" in raw.stated)
        _note_repeated(np.where(usable, range_m, np.nan), path)
        amplitude, intensity = numbers.get("amplitude"), numbers.get("intensity")
        return Frames(
            range_m, amplitude, intensity, usable, sensor=camera, taps_e=taps, invalid_means=invalid_means,
            time_s=time_s, tilt_rad=tilt_rad,
        )  # fmt: skip

    try:
        if "frequency_range" not in arrays:
            return frames_of(arrays, sensor, taps_e)
        held = [name for name in _NUMBERS if f"frequency_{name}" in arrays]
        parts = [
            frames_of({name: arrays[f"frequency_{name}"][:, :, j] for name in held}, camera, None)
            for j, camera in enumerate(sensor.by_frequency)
        ]
        return unwrap_frames(parts, sensor, taps_e=taps_e)
    except UsageError as error:  # an amplitude or intensity that cannot be
        raise InputFileError(f"{path}: {error}") from None


def _of_each_frame(values: NDArray[np.float64], what: str, shape: tuple[int, ...], path: Path) -> NDArray[np.float64]:
    """Return numbers of frames as (n, frames)."""
    if values.size != math.prod(shape) or values.shape not in (shape, shape[1:], ()):
        raise InputFileError(f"{path}: {what} must have one number for each frame, shape {shape}, got {values.shape}")
    return values.reshape(shape)


def _settled(name: str, given: str | None, raw: Recording, known: tuple[str, ...], path: Path) -> str:
    """Return unit or quantity, from the caller or the file, which must agree."""
    if given is not None and given not in known:
        raise UsageError(f"{name}=… must be one of {', '.join(known)}, got {given!r}")
    stated = raw.stated.get(name)
    if stated is not None and stated not in known:
        raise InputFileError(f"{path}: its {name} must be one of {', '.join(known)}, got {stated!r}")
    if given is not None and stated is not None and given != stated:
        raise UsageError(f"{name}=… is {given}, but {path} says {stated}")
    value = given or stated
    if value is None:
        # a file that says one of the two was written by a program that says both: damaged, or somebody else's;
        # but names of columns say one of the two at most
        asked = InputFileError if raw.stated and not raw.named else UsageError
        raise asked(f"{path}: does not say its {name}: give {name}={'|'.join(known)}")
    return value


def _shaped(raw: Recording, sensor: Sensor, shape: tuple[int, int], path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a recording as (n, frames, rows, cols) of the file's own orientation.

    Those of each frequency are (n, frames, m, rows, cols), and taps (n, frames, 4 m, 2, rows, cols).

    Raises
    ------
    InputFileError
        Pixels, frequencies or phase images are not as many as the sensor's, or other ones, or arrays do not fit each
        other.
    """
    m, n_images = len(sensor.frequencies_hz), sensor.n_phase_images
    of_frequency = f"frequencies, but the sensor has {m}: {in_words(sensor.frequencies_hz)} Hz"
    of_taps = f"phase images a frame, but the sensor takes {n_images}: 4 at each of {m} modulation frequencies"
    layers: dict[str, tuple[tuple[int, ...], str, str]] = {
        **dict.fromkeys(_OF_FREQUENCY, ((m,), "m, ", of_frequency)),
        "taps": ((n_images, 2), "phase images, 2, ", of_taps),
    }
    given = dict(raw.arrays)
    _check_frequencies(given.pop("frequency", None), sensor, path)
    arrays = {}
    for name, values in given.items():
        own, axes, what = layers.get(name, ((), "", ""))
        if values.dtype.kind not in ("fiu" if own or name in _NUMBERS else "fiub"):
            raise InputFileError(f"{path}: '{name}' must hold real numbers, got {values.dtype}")
        if not values.size:
            raise InputFileError(f"{path}: '{name}' holds no frames")
        if raw.flat:
            arrays[name] = values.reshape(1, -1, *own, *shape)
            continue
        n_axes = len(own) + 2
        if not n_axes <= values.ndim <= n_axes + 2:
            right = f"(frames, {axes}rows, cols)" + ("" if own else " or (n, frames, rows, cols)")
            raise InputFileError(f"{path}: '{name}' must have shape {right}, got {values.shape}")
        if values.shape[-2:] != shape:
            raise InputFileError(
                f"{path}: the frames in '{name}' have {values.shape[-2]} × {values.shape[-1]} pixels, but the sensor's"
                f" have {shape[0]} × {shape[1]}"
            )
        if values.shape[-n_axes:-2] != own:
            raise InputFileError(f"{path}: '{name}' has {values.shape[-n_axes]} {what}")
        arrays[name] = values.reshape((1,) * (n_axes + 2 - values.ndim) + values.shape)
    layered = [name for name in arrays if name in layers]
    main = "frequency_range" if "frequency_range" in arrays else "range"
    if m > 1 and main == "range" and set(layered) - {"taps"}:
        raise InputFileError(f"{path}: has {' and '.join(layered)} without 'frequency_range'")
    if main == "frequency_range":
        arrays["range"] = arrays[main][:, :, 0]
    frames = arrays["range"].shape
    for name, values in arrays.items():
        if name in layers and values.shape[:2] != frames[:2]:
            raise InputFileError(
                f"{path}: '{name}' must have the frames of '{main}', {frames[:2]}, got {values.shape[:2]}"
            )
        if name not in layers and values.shape != frames:
            raise InputFileError(f"{path}: '{name}' must have the shape of 'range', {frames}, got {values.shape}")
    return arrays


def _check_frequencies(stated: NDArray[Any] | None, sensor: Sensor, path: Path) -> None:
    """Refuse a file that says it has other frequencies than the sensor."""
    if stated is None:
        return
    own = sensor.frequencies_hz
    if stated.dtype.kind not in "fiu" or stated.ndim > 1:
        raise InputFileError(f"{path}: 'frequency' must be the modulation frequencies in hertz, got {stated.dtype}")
    told = np.atleast_1d(stated).astype(np.float64)
    if len(told) != len(own) or not np.allclose(told, own, rtol=1e-9, atol=0):
        raise InputFileError(
            f"{path}: has frames at {in_words(told) if len(told) else 'no'} Hz, but the sensor modulates at"
            f" {in_words(own)} Hz, in this order"
        )


def write_measured(frames: Frames, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write measured frames as an NPZ file: range along the ray in metres, which :func:`read_frames` reads untold.

    Time stamps go into it as ``t_s``, tilts as ``pitch_deg`` and ``roll_deg``.

    Parameters
    ----------
    frames : Frames
        The frames.
    path : path-like
        The file.
    force : bool
        Whether an existing file may be replaced.

    Returns
    -------
    Path
        `path`.

    Raises
    ------
    OutputExistsError, StorageError
        As :func:`phasemark.data.files.write_atomically`.
    """
    arrays: dict[str, Any] = {"range": frames.range_m, "valid": frames.valid, "flags": frames.flags}
    if len(frames.by_frequency) > 1:  # each frequency has NaN where it has no range
        del arrays["valid"]
    measured = {"amplitude": frames.amplitude_e, "intensity": frames.intensity_e}
    arrays |= {name: values for name, values in measured.items() if values is not None}
    if len(frames.sensor.frequencies_hz) > 1:
        arrays["frequency"] = np.array(frames.sensor.frequencies_hz)
        for key, attribute in zip(_OF_FREQUENCY, ("range_m", "amplitude_e", "intensity_e"), strict=True):
            own = [getattr(part, attribute) for part in frames.by_frequency]
            if own and all(values is not None for values in own):
                arrays[key] = np.stack(own, axis=2)
    if frames.time_s is not None:
        arrays[SECONDS] = frames.time_s
    if frames.tilt_rad is not None:
        arrays |= dict(zip(TILTS, np.moveaxis(np.degrees(frames.tilt_rad), -1, 0), strict=True))
    return write_atomically(path, npz_bytes({**arrays, "unit": "m", "quantity": "range"}), force=force)


def _read(
    path: Path, shape: tuple[int, int], untrusted: bool, topic: str | None, sensor: Sensor, board: str | None
) -> Recording:
    try:
        if path.is_dir():
            return read_rosbag(path, topic) if (path / "metadata.yaml").exists() else _read_pngs(path)
        with opened(path, most_bytes=_MOST_BYTES) as file:
            start = file.read(8)
            file.seek(0)
            if not start.startswith(b"\x89HDF"):
                return _read_open(file, start, shape, path, sensor, board)
        return _read_hdf5(path, untrusted)
    except PhasemarkError:
        raise
    except MemoryError:
        raise InputFileError(f"{path}: holds or announces more frames than fit into memory") from None
    except Exception as error:  # whatever a damaged file makes NumPy, zipfile, Pillow and h5py say
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        raise InputFileError(f"{path}: cannot be read ({reason})") from None


def _read_open(
    file: BinaryIO, start: bytes, shape: tuple[int, int], path: Path, sensor: Sensor, board: str | None
) -> Recording:
    """Read an open file of any kind but HDF5."""
    if not start:
        raise InputFileError(f"{path}: is empty")
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    if start.startswith(b"\x93NUMPY"):
        _Room(path, size).take("range", *_npy_header(file))
        file.seek(0)
        only = np.lib.format.read_array(file, allow_pickle=False)
        if more := size - file.tell():
            raise InputFileError(f"{path}: {more} bytes follow its array: give several arrays as .npz")
        return Recording({"range": only})
    if start.startswith(b"PK"):
        return _read_npz(file, size, path)
    if start == b"\x89PNG\r\n\x1a\n":
        return _of_images([_read_png(file, size, path)], path)
    printed_by = find_board(board, file.read(HEAD_BYTES), math.prod(shape), path)
    file.seek(0)
    most_bytes = _MOST_BYTES if printed_by is None else MOST_LOG_BYTES
    if size > most_bytes:
        raise InputFileError(f"{path}: has more than {most_bytes / 1e6:.3g} MB of text: give it in parts, or as NPZ")
    if printed_by is not None:
        return read_board_log(file, printed_by, sensor, shape, path)
    return parse_csv(file.read(), shape, path, len(sensor.frequencies_hz))


class _Room:
    """Number of values that a file may still hold, so that a small file cannot fill the memory."""

    def __init__(self, path: Path, size: int) -> None:
        self._path = path
        # how many a file may hold for each of its bytes; what is packed more tightly than this was made to fill the
        # memory
        values_per_byte = 2
        self._left = max(_FREE_VALUES, values_per_byte * size)

    def take(self, name: str, shape: tuple[int, ...] | None, dtype: np.dtype[Any]) -> None:
        """Refuse an array that is not of plain numbers, or holds more of them than is left."""
        if shape is None:
            raise InputFileError(f"{self._path}: '{name}' holds nothing")
        if dtype.kind not in "fiub" or dtype.shape:
            raise InputFileError(f"{self._path}: '{name}' must hold real numbers, got {dtype}")
        # a truth value is no size, though Python takes it for a number
        if not all(isinstance(n, int | np.integer) and not isinstance(n, bool) and n >= 0 for n in shape):
            raise InputFileError(f"{self._path}: '{name}' has the shape {shape}, which no array has")
        count = math.prod(map(int, shape))
        self._left -= count
        if self._left < 0:
            raise InputFileError(
                f"{self._path}: refused: '{name}' declares {count} values, far more than a file of this size holds"
            )


def _npy_header(file: BinaryIO | zipfile.ZipExtFile) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    return shape, dtype


_Image = tuple[NDArray[np.float64], str | None, str | None]
"""Codes of a 16-bit grey image, and what it says of scale and quantity."""


def _read_png(file: BinaryIO, size: int, path: Path) -> _Image:
    if size > FREE_BYTES:
        raise InputFileError(f"{path}: refused: is far too large for a frame")
    header = file.read(24)
    file.seek(0)
    width, height = (int.from_bytes(header[at : at + 4], "big") for at in (16, 20))
    if width * height > _MOST_PIXELS:  # before Pillow warns of it, or makes room for it
        raise InputFileError(f"{path}: must be an image of at most {_MOST_PIXELS} pixels, got {width} × {height}")
    with Image.open(file, formats=("PNG",)) as image:
        if image.width * image.height > _MOST_PIXELS or not image.mode.startswith("I"):
            raise InputFileError(f"{path}: must be a 16-bit grey image of at most {_MOST_PIXELS} pixels")
        codes = np.asarray(image, dtype=np.float64)
        text = getattr(image, "text", {})  # read with the image
        return codes, text.get("metres_per_unit"), text.get("quantity")


def _read_pngs(path: Path) -> Recording:
    """Read a folder of 16-bit grey images."""
    sizes = {name: name.stat().st_size for name in sorted(path.glob("*.png"))}
    if not sizes:
        raise InputFileError(f"{path}: is a folder without PNG images, and no ROS bag")
    found = []
    room = _Room(path, sum(sizes.values()))
    for name, size in sizes.items():
        with opened(name, most_bytes=FREE_BYTES) as file:
            try:
                found.append(_read_png(file, size, name))
            except (PhasemarkError, MemoryError):
                raise
            except Exception as error:  # whatever a damaged image makes Pillow say
                raise InputFileError(f"{name}: cannot be read ({' '.join(str(error).split())})") from None
        room.take("range", found[-1][0].shape, found[-1][0].dtype)
    return _of_images(found, path)


def _of_images(found: Sequence[_Image], path: Path) -> Recording:
    images, told = [image for image, *_ in found], {(scale, quantity) for _, scale, quantity in found}
    if len(told) > 1 or len({image.shape for image in images}) > 1:
        raise InputFileError(f"{path}: its images must all have one size, scale and quantity")
    scale, quantity = told.pop()
    codes = np.stack(images)
    stated = {} if quantity is None else {"quantity": quantity}
    if scale is not None:
        try:
            codes = codes * float(scale)
        except ValueError:
            raise InputFileError(f"{path}: its 'metres_per_unit' must be a number, got {scale[:80]!r}") from None
        stated["unit"] = "m"
    return Recording({"range": np.where(codes == 0, np.nan, codes)}, stated)


def _read_npz(file: BinaryIO, size: int, path: Path) -> Recording:
    with opened_npz(file, size, path) as archive:
        members = {member.filename.removesuffix(".npy"): member for member in archive.zip.infolist()}
        room, own = _Room(path, size), [name for name in _COLUMNS if name in members]
        for name in own:
            with archive.zip.open(members[name]) as inner:
                room.take(name, *_npy_header(inner))
        words = [name for name in ("unit", "quantity") if name in members]
        word_bytes = 256  # most that the words for unit and quantity take
        for name in words:
            if members[name].file_size > word_bytes + 128:
                raise InputFileError(f"{path}: '{name}' must be a word, got {members[name].file_size} bytes")
        if not {"range", "frequency_range"} & set(archive):
            if "histogram" in archive:
                raise InputFileError(f"{path}: a log of histograms, not of ranges: match it on histograms")
            raise InputFileError(f"{path}: must have an array 'range', got {', '.join(archive) or 'nothing'}")
        if "view" not in members:  # an exported frame set has more, which is documented
            _note_ignored(members.keys() - {*_COLUMNS, *words}, path)
        return _of_arrays(archive, own, {name: _word(archive[name]) for name in words}, path)


def _read_hdf5(path: Path, untrusted: bool) -> Recording:
    with open_hdf5(path, "file of frames", untrusted=untrusted, foreign=True) as file:
        datasets = {name: file[name] for name in _COLUMNS if isinstance(file.get(name), h5py.Dataset)}
        main = datasets.get("frequency_range", datasets.get("range"))
        if main is None:
            kind = file.attrs.get("format")
            raise InputFileError(
                f"{path}: must have a dataset 'range', "
                + (f"but is a {kind}" if kind else f"got {', '.join(file) or 'nothing'}")
            )
        for name, dataset in datasets.items():
            if dataset.attrs.get("scale_factor", 1) != 1 or dataset.attrs.get("add_offset", 0) != 0:
                raise InputFileError(f"{path}: '{name}' is packed (scale_factor, add_offset): write its numbers")
        for name in (*_NUMBERS[1:], *_OF_FREQUENCY[1:]):
            units = datasets[name].attrs.get("units") if name in datasets else None
            if units is not None and units not in _ELECTRONS:
                raise InputFileError(f"{path}: '{name}' must be in electrons (units 'e-'), got {units!r}")
        room = _Room(path, path.stat().st_size)
        for name, dataset in datasets.items():
            room.take(name, dataset.shape, dataset.dtype)
        attributes = {"unit": "units", "quantity": "quantity"}
        stated = {name: _word(main.attrs[key]) for name, key in attributes.items() if key in main.attrs}
        if "format" not in file.attrs:  # a frame set of ours has more, which is documented
            _note_ignored({name for name in file if isinstance(file.get(name), h5py.Dataset)} - set(_COLUMNS), path)
        return _of_arrays(datasets, datasets, stated, path)


def _word(value: Any) -> str:
    """Return a word of a file, which some programs write as bytes."""
    plain = value.item() if np.size(value) == 1 and hasattr(value, "item") else value
    return plain.decode("utf-8", errors="replace") if isinstance(plain, bytes) else str(plain)


def _note_repeated(range_m: NDArray[np.float64], path: Path) -> None:
    """Warn of frames that equal the one before in every pixel: they are no measurements."""
    known = np.isfinite(range_m)
    same = ((range_m[:, 1:] == range_m[:, :-1]) | ~(known[:, 1:] | known[:, :-1])).all(axis=(2, 3))
    repeated = same & known[:, 1:].any(axis=(2, 3))
    count, fewest = int(repeated.sum()), 9 if same.all() else 3  # fewer do no harm
    if count >= fewest:
        position, frame = np.argwhere(repeated)[0]
        where = f"frame {frame + 1}" + (f" of position {position}" if len(range_m) > 1 else "")
        warnings.warn(
            f"{path}: {count} of {known.shape[0] * known.shape[1]} frames repeat the one before to the last digit, the"
            f" first being {where}: is the sensor stuck, or was it read faster than it measures? Each counts as a"
            " measurement",
            stacklevel=2,
        )


def _note_ignored(names: Collection[str], path: Path) -> None:
    """Warn of arrays that are not read, but for those that programs of ours write beside the frames."""
    foreign = sorted(name for name in names if name not in _BESIDE and not name.startswith("truth_"))
    if foreign:
        warnings.warn(f"{path}: ignores the arrays {', '.join(foreign)}", stacklevel=2)


def _of_arrays(file: Mapping[str, Any], names: Iterable[str], stated: Mapping[str, str], path: Path) -> Recording:
    """Return the named arrays of a file, with time stamps in seconds."""
    arrays = {name: np.asarray(file[name][...]) for name in names}
    name = one_time(arrays, path)
    time_s = None if name is None else _times_s(arrays.pop(name), name, path)
    tilt_deg = {name: _real(arrays.pop(name), name, path) for name in TILTS if name in arrays}
    return Recording(arrays, stated, time_s, tilt_deg)


def _real(values: NDArray[Any], name: str, path: Path) -> NDArray[np.float64]:
    """Return an array as float64; refuse one that holds no real numbers."""
    if values.dtype.kind not in "fiu":
        raise InputFileError(f"{path}: '{name}' must hold real numbers, got {values.dtype}")
    return values.astype(np.float64)


def _times_s(values: NDArray[Any], name: str, path: Path) -> NDArray[np.float64]:
    times = _real(values, name, path)
    if not np.isfinite(times).all():
        k = int(np.flatnonzero(~np.isfinite(times.ravel()))[0])
        raise InputFileError(f"{path}: frame {k} has no time: '{name}' must be finite, got {times.ravel()[k]}")
    for position in times.reshape(-1, times.shape[-1] if times.ndim else 1):
        note_disorder(position, path, "frame {}".format)
    return in_seconds(times, name, path, "frame {}".format)
