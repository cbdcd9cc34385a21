"""Our own HDF5 files as they are opened: checked before anything is read, damage told in one line."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError, PhasemarkError, UsageError
from phasemark.data.files.guard import OWN_EXPANSION, OWN_FREE_BYTES, first_reading, refusal
from phasemark.inputs import checksum_path, is_vouched_for, verifying
from phasemark.inputs.checksum import read_errors


def open_hdf5(path: Path, what: str, *, untrusted: bool = False, foreign: bool = False) -> h5py.File:
    """Open an HDF5 file after comparing it with its checksum and refusing links that lead out of it.

    Parameters
    ----------
    path : Path
    what : str
        What the file should be, for messages: "bank".
    untrusted : bool
        Whether a child process reads the file first, unless ``FILE.sha256`` vouches for it.
    foreign : bool
        Whether another program wrote the file: it has no checksum, and may be packed.

    Raises
    ------
    InputFileError
        The file cannot be read, contradicts its checksum, is not HDF5, is damaged, or contains what is refused
        (:func:`phasemark.data.files.guard.refusal`).

    Warns
    -----
    UserWarning
        The file is untrusted and one of ours, and has no checksum.
    """
    with read_errors(path):
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise InputFileError(f"{path}: is a pipe or device: HDF5 is read out of order, so copy it to a file first")
        with path.open("rb") as plain:
            signature = plain.read(8)
    if signature != b"\x89HDF\r\n\x1a\n":
        raise InputFileError(f"{path}: not a {what} (not an HDF5 file)")
    vouched = is_vouched_for(path)
    if untrusted and not vouched:
        reason = first_reading(path)
        if reason is not None:
            raise InputFileError(f"{path}: {reason}")
        if verifying() and not foreign:
            beside = checksum_path(path).name
            warnings.warn(f"{path}: has no checksum '{beside}' beside it, so damage may go unnoticed", stacklevel=2)
    try:
        reason = refusal(path) if foreign else refusal(path, expansion=OWN_EXPANSION, free_bytes=OWN_FREE_BYTES)
        if reason is None:
            return h5py.File(path, "r")
    except Exception:  # whatever a damaged file makes h5py say
        raise InputFileError(f"{path}: damaged or cut off: HDF5 cannot open it") from None
    raise InputFileError(f"{path}: refused: {reason}")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn whatever a damaged file makes h5py, json or pydantic say into one line.

    Numbers that do not survive a change of type become infinite or NaN without a warning: the caller checks them.
    """
    try:
        with np.errstate(invalid="ignore", over="ignore"):
            yield
    except UsageError as error:
        raise InputFileError(f"{path}: damaged ({error})") from None
    except PhasemarkError:
        raise
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, AttributeError, LookupError) as error:
        reason = " ".join(str(error).split())
        raise InputFileError(f"{path}: damaged ({reason})") from None


def check_format(file: h5py.File, path: Path, what: str, expected: str, newest: int) -> None:
    """Refuse a file of another format, or of a version that is not this one's.

    Raises
    ------
    InputFileError
        With what would help: updating phasemark, or building the file again.
    """
    found = file.attrs.get("format")
    if found != expected:
        raise InputFileError(f"{path}: not a {what} (its format is {found!r}, must be '{expected}')")
    version = int(file.attrs["schema_version"])
    if version != newest:
        advice = "update phasemark" if version > newest else "build it again"
        raise InputFileError(f"{path}: has schema version {version}, this phasemark reads {newest}: {advice}")


def json_attribute(file: h5py.File, path: Path, name: str) -> dict[str, Any]:
    """Return an attribute that holds a JSON object."""
    with reading(path):
        value = json.loads(file.attrs[name])
    if not isinstance(value, dict):
        raise InputFileError(f"{path}: the attribute '{name}' must be a JSON object, got {value!r}")
    return value


def group_of(file: h5py.File, name: str, path: Path) -> h5py.Group:
    """Return a group, which must be there."""
    if not isinstance(file.get(name), h5py.Group):
        raise InputFileError(f"{path}: the group '{name}' is missing")
    return file[name]


def dataset_of(group: h5py.Group, name: str, path: Path) -> h5py.Dataset:
    """Return a dataset, which must be there."""
    if not isinstance(group.get(name), h5py.Dataset):
        raise InputFileError(f"{path}: the dataset '{f'{group.name}/{name}'.strip('/')}' is missing")
    return group[name]


def whole_numbers(dataset: h5py.Dataset, path: Path) -> NDArray[np.int64]:
    """Return the values of a dataset that must hold whole numbers.

    Raises
    ------
    InputFileError
        It holds others, or some too large to count with.
    """
    if dataset.dtype.kind not in "iu":
        raise InputFileError(f"{path}: '{dataset.name.strip('/')}' must hold whole numbers, got {dataset.dtype}")
    values = np.asarray(dataset[...])
    if values.size and int(values.max()) > np.iinfo(np.int64).max:
        raise InputFileError(f"{path}: '{dataset.name.strip('/')}' has {values.max()}, which is no number of anything")
    return values.astype(np.int64)


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """Make an array read-only and return it."""
    array.flags.writeable = False
    return np.asarray(array)
