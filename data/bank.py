"""Banks of model images, as they are read: schema, checks, and whole arrays for a matcher."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import h5py
import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark import InputFileError, PhasemarkError, UsageError
from phasemark.data.grid import format_grid
from phasemark.data.plan import BankPlan
from phasemark.render import PhasorImages, Sensor, Views

FORMAT = "phasemark-bank"
SCHEMA_VERSION = 1

GroupName = Literal["lower", "upper", "full"]
VIEW_DIMS: dict[GroupName, tuple[str, ...]] = {
    "lower": ("distance", "delta"),
    "upper": ("landmark_class", "distance"),
    "full": ("landmark_class", "distance", "delta"),
}
PHASOR_DIMS = ("frequency", "row", "col", "iq")
IMAGE_DIMS = ("row", "col")
_COVERAGE_SLACK = 0.01
"""How far a coverage may lie outside 0 … 1: more than any error of the integral, less than damage."""
LAYOUT_GROUPS: dict[str, tuple[GroupName, ...]] = {"factored": ("lower", "upper"), "full": ("full",)}


def group_rows(group: GroupName, sensor: Sensor) -> tuple[int, int]:
    """Return first and stop of the image rows that a group holds."""
    half = sensor.rows // 2
    return {"lower": (half, sensor.rows), "upper": (0, half), "full": (0, sensor.rows)}[group]


class BankGroup:
    """The images of one group; read-only arrays, each read from the file when it is first asked for.

    ``views`` below stands for (distance, delta) in `lower`, (class, distance) in `upper` and (class, distance, delta)
    in `full`.

    Parameters
    ----------
    name : {"lower", "upper", "full"}
    group : h5py.Group
    path : Path
        Name of the file, for messages.
    sensor : Sensor

    Attributes
    ----------
    distance_m, delta_rad : (n,) float64
        The grids; `delta_rad` is empty in `upper`, which does not depend on it.
    row, col : (rows,), (cols,) int64
        Which pixels of the sensor the images hold.
    order : (k,) int64
        Harmonic orders, 1 first.
    classes : tuple of str
        Class names; empty in `lower`, which all classes share.
    """

    def __init__(self, name: GroupName, group: h5py.Group, path: Path, sensor: Sensor) -> None:
        self._group, self._path = group, path
        self.name: GroupName = name
        view_dims = VIEW_DIMS[name]
        coordinates = {dim: self._coordinate(dim) for dim in (*view_dims, *PHASOR_DIMS)}
        sizes = {dim: len(values) for dim, values in coordinates.items()}
        for field, dims in (("phasor", PHASOR_DIMS), ("intensity", IMAGE_DIMS), ("coverage", IMAGE_DIMS)):
            dataset = _dataset(group, field, self._path)
            expected = tuple(sizes[dim] for dim in (*view_dims, *dims))
            if dataset.shape != expected or dataset.dtype.kind != "f":
                raise InputFileError(
                    f"{path}: '{name}/{field}' must be floats of shape {expected},"
                    f" got {dataset.dtype} of shape {dataset.shape}"
                )
        self.distance_m: NDArray[np.float64] = _frozen(coordinates["distance"])
        self.delta_rad: NDArray[np.float64] = _frozen(np.deg2rad(coordinates.get("delta", np.empty(0))))
        self.row: NDArray[np.int64] = _frozen(coordinates["row"].astype(np.int64))
        self.col: NDArray[np.int64] = _frozen(coordinates["col"].astype(np.int64))
        self.order: NDArray[np.int64] = _frozen(np.rint(coordinates["frequency"] / sensor.modulation_hz).astype(int))
        self.classes: tuple[str, ...] = tuple(coordinates.get("landmark_class", np.empty(0)).tolist())
        self._check_coordinates(sensor)

    @property
    def phasor(self) -> NDArray[np.complex64]:
        """S_1 (PHYSICS section 3), (views, row, col)."""
        return self.harmonic(1)

    def harmonic(self, order: int) -> NDArray[np.complex64]:
        """Return S_k of one harmonic order, (views, row, col).

        Raises
        ------
        UsageError
            The bank does not hold the order.
        """
        index = np.flatnonzero(self.order == order)
        if not index.size:
            raise UsageError(f"{self._path}: has no harmonic {order}, only {', '.join(map(str, self.order))}")
        return self._phasors[..., index[0], :, :]

    @cached_property
    def intensity(self) -> NDArray[np.float32]:
        """Mean amplitude, (views, row, col)."""
        return _frozen(self._read("intensity"))

    @cached_property
    def coverage(self) -> NDArray[np.float32]:
        """Share of the pixel that sees the landmark, 0 … 1, (views, row, col)."""
        coverage = self._read("coverage")
        outside = coverage[(coverage < -_COVERAGE_SLACK) | (coverage > 1 + _COVERAGE_SLACK)]
        if outside.size:
            raise InputFileError(f"{self._path}: '{self.name}/coverage' must be in 0 … 1, got {outside.flat[0]:g}")
        return _frozen(coverage)

    @cached_property
    def _phasors(self) -> NDArray[np.complex64]:
        return _frozen(self._read("phasor").view(np.complex64)[..., 0])

    def _read(self, name: str) -> NDArray[np.float32]:
        with _reading(self._path):
            values = np.ascontiguousarray(self._group[name][...], dtype=np.float32)
        if not np.isfinite(values).all():
            raise InputFileError(f"{self._path}: '{self.name}/{name}' must be finite, got NaN or infinity")
        return values

    def _coordinate(self, name: str) -> NDArray[Any]:
        dataset = _dataset(self._group, name, self._path)
        is_text = name in ("landmark_class", "iq")
        if dataset.ndim != 1 or not dataset.size or (dataset.dtype.kind == "O") != is_text:
            raise InputFileError(
                f"{self._path}: '{self.name}/{name}' must be one row of {'text' if is_text else 'numbers'}"
            )
        return np.asarray(dataset.asstr()[...] if is_text else dataset[...].astype(np.float64))

    def _check_coordinates(self, sensor: Sensor) -> None:
        rows = group_rows(self.name, sensor)
        wrong = {
            "distance": self.distance_m[0] <= 0 or not _increases(self.distance_m),
            "delta": not _increases(self.delta_rad),
            "row": not np.array_equal(self.row, np.arange(*rows)),
            "col": not np.array_equal(self.col, np.arange(sensor.cols)),
            "frequency": self.order[0] != 1 or not _increases(self.order),
            "iq": self._group["iq"].shape != (2,),
            "landmark_class": len(set(self.classes)) < len(self.classes),
        }
        for name, is_wrong in wrong.items():
            if is_wrong:
                raise InputFileError(f"{self._path}: the values of '{self.name}/{name}' do not belong in a bank")


class Bank:
    """Model images over distance, angle and class; made by :func:`open_bank`, and a context manager.

    Parameters
    ----------
    file : h5py.File
        Open for reading; the bank closes it.
    path : Path
        Its name, for messages.

    Attributes
    ----------
    sensor : Sensor
    plan : BankPlan
        The resolved plan the bank was made from.
    layout : {"factored", "full"}
    classes : tuple of str
    distance_m : (n_distance,) float64
    delta_rad : (n_delta,) float64
    lower, upper : BankGroup or None
        The groups of a factored bank.
    full : BankGroup or None
        The group of a full bank.
    versions : dict of str to str
        What the bank was made with.
    """

    def __init__(self, file: h5py.File, path: Path) -> None:
        self._file = file
        self.path = path
        _check_format(file, path)
        self.sensor = Sensor(**self._json("sensor"))
        self.plan = BankPlan(**self._json("plan"))
        self.versions: dict[str, str] = self._json("versions")
        self.layout = self.plan.layout
        groups: dict[str, BankGroup] = {
            name: BankGroup(name, _group(file, name, path), path, self.sensor) for name in LAYOUT_GROUPS[self.layout]
        }
        self.lower, self.upper, self.full = groups.get("lower"), groups.get("upper"), groups.get("full")
        classed = self.full or self.upper
        angled = self.full or self.lower
        assert classed is not None
        assert angled is not None
        self.classes = classed.classes
        self.distance_m, self.delta_rad = angled.distance_m, angled.delta_rad
        if not np.array_equal(classed.distance_m, angled.distance_m):
            raise InputFileError(f"{path}: 'lower/distance' and 'upper/distance' must agree")
        for name in self.classes:
            _group(file, f"meshes/{name}", path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; arrays read before stay usable."""
        self._file.close()

    def phasor(self, class_name: str, i: int, j: int) -> NDArray[np.complex64]:
        """Return S_1 of one model image, (rows, cols), at ``distance_m[i]`` and ``delta_rad[j]``."""
        return self._image("phasor", class_name, i, j)

    def image(self, class_name: str, i: int, j: int) -> PhasorImages:
        """Return one model image with intensity and coverage, at ``distance_m[i]`` and ``delta_rad[j]``.

        Raises
        ------
        UsageError
            The bank does not have the class.
        """
        return PhasorImages(
            phasor=self._image("phasor", class_name, i, j)[None].astype(np.complex128),
            intensity=self._image("intensity", class_name, i, j)[None].astype(np.float64),
            coverage=self._image("coverage", class_name, i, j)[None].astype(np.float64),
            sensor=self.sensor,
            views=Views.broadcast(self.distance_m[i], self.delta_rad[j]),
        )

    def mesh(self, class_name: str) -> trimesh.Trimesh:
        """Return the mesh of a class, metres, landmark frame; ``metadata`` has `symmetry` and `albedo`.

        Raises
        ------
        UsageError
            The bank does not have the class.
        InputFileError
            The mesh in the file is damaged.
        """
        self._class_index(class_name)
        group = _group(self._file, f"meshes/{class_name}", self.path)
        with _reading(self.path):
            vertices = group["vertices"][...].astype(np.float64)
            faces = group["faces"][...].astype(np.int64)
            part = group["part"][...].astype(np.uint8) if "part" in group else None
            period_deg, albedo = float(group.attrs["delta_period_deg"]), float(group.attrs["albedo"])
        if not 1 <= period_deg <= 360:  # as the plan has it: a symmetry of 1 … 360
            raise InputFileError(
                f"{self.path}: 'delta_period_deg' of '{class_name}' must be in [1, 360], got {period_deg:g}"
            )
        if not (vertices.ndim == faces.ndim == 2 and vertices.shape[1:] == faces.shape[1:] == (3,) and faces.size):
            raise InputFileError(f"{self.path}: 'meshes/{class_name}' must hold rows of three, of vertices and faces")
        if not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
            raise InputFileError(f"{self.path}: 'meshes/{class_name}' has vertices that are not finite or not there")
        if part is not None and part.shape != faces.shape[:1]:
            raise InputFileError(f"{self.path}: 'meshes/{class_name}/part' must have one value for each face")
        return trimesh.Trimesh(
            vertices,
            faces,
            process=False,
            face_attributes=None if part is None else {"part": part},
            metadata={"name": class_name, "symmetry": round(360 / period_deg), "albedo": albedo},
        )

    def identity(self) -> dict[str, Any]:
        """Return what the bank's bytes depend on: resolved plan, versions, mesh hashes."""
        with _reading(self.path):
            hashes = {name: str(self._file[f"meshes/{name}"].attrs["sha256"]) for name in self.classes}
        return {"plan": self._json("plan"), "versions": self.versions, "mesh_sha256": hashes}

    def info(self) -> dict[str, Any]:
        """Return what the bank holds, in plain numbers and text."""
        groups = [group for group in (self.lower, self.upper, self.full) if group is not None]
        views = {group.name: int(np.prod(self._file[group.name]["phasor"].shape[:-4])) for group in groups}
        with _reading(self.path):
            hashes = {name: str(self._file[f"meshes/{name}"].attrs["sha256"]) for name in self.classes}
        return {
            "path": str(self.path),
            "size_bytes": int(self._file.id.get_filesize()),
            "schema_version": int(self._file.attrs["schema_version"]),
            "layout": self.layout,
            "model": self.plan.model,
            "classes": list(self.classes),
            "distance_m": format_grid(self.distance_m),
            "n_distance": len(self.distance_m),
            "delta_deg": format_grid(self.plan.delta_deg or ()),
            "n_delta": len(self.delta_rad),
            "images": views,
            "harmonics": groups[0].order.tolist(),
            "sensor": self.plan.sensor,
            "rows": self.sensor.rows,
            "cols": self.sensor.cols,
            "modulation_hz": self.sensor.modulation_hz,
            "mesh_sha256": hashes,
            "versions": self.versions,
        }

    def _image(self, field: str, class_name: str, i: int, j: int) -> NDArray[Any]:
        k = self._class_index(class_name)
        if self.full is not None:
            return np.asarray(getattr(self.full, field)[k, i, j])
        return np.concatenate([getattr(self.upper, field)[k, i], getattr(self.lower, field)[i, j]])

    def _class_index(self, class_name: str) -> int:
        if class_name not in self.classes:
            raise UsageError(f"unknown class {class_name!r}: {self.path} has {', '.join(self.classes)}")
        return self.classes.index(class_name)

    def _json(self, name: str) -> dict[str, Any]:
        with _reading(self.path):
            value = json.loads(self._file.attrs[name])
        if not isinstance(value, dict):
            raise InputFileError(f"{self.path}: the attribute '{name}' must be a JSON object, got {value!r}")
        return value


def open_bank(path: str | os.PathLike[str]) -> Bank:
    """Open a bank.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    Bank
        A context manager; close it or leave the block when done.

    Raises
    ------
    InputFileError
        The file cannot be read, is not a bank, was made by a newer version, or is damaged.
    """
    path = Path(path)
    try:
        with path.open("rb") as plain:
            signature = plain.read(8)
    except OSError as error:
        raise InputFileError(f"{path}: cannot be read ({error.strerror})") from None
    if signature != b"\x89HDF\r\n\x1a\n":
        raise InputFileError(f"{path}: not a bank (not an HDF5 file)")
    try:
        file = h5py.File(path, "r")
    except OSError:
        raise InputFileError(f"{path}: damaged or cut off: HDF5 cannot open it") from None
    try:
        with _reading(path):
            return Bank(file, path)
    except BaseException:
        file.close()
        raise


def _check_format(file: h5py.File, path: Path) -> None:
    found = file.attrs.get("format")
    if found != FORMAT:
        raise InputFileError(f"{path}: not a bank (its format is {found!r}, must be '{FORMAT}')")
    version = int(file.attrs["schema_version"])
    if version != SCHEMA_VERSION:
        advice = "update phasemark" if version > SCHEMA_VERSION else "build it again"
        raise InputFileError(f"{path}: has schema version {version}, this phasemark reads {SCHEMA_VERSION}: {advice}")


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn whatever a damaged file makes h5py, json or pydantic say into one line."""
    try:
        yield
    except UsageError as error:
        raise InputFileError(f"{path}: damaged ({error})") from None
    except PhasemarkError:
        raise
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise InputFileError(f"{path}: damaged ({reason})") from None


def _group(file: h5py.File, name: str, path: Path) -> h5py.Group:
    if not isinstance(file.get(name), h5py.Group):
        raise InputFileError(f"{path}: the group '{name}' is missing")
    return file[name]


def _dataset(group: h5py.Group, name: str, path: Path) -> h5py.Dataset:
    if not isinstance(group.get(name), h5py.Dataset):
        raise InputFileError(f"{path}: the dataset '{group.name.strip('/')}/{name}' is missing")
    return group[name]


def _increases(values: NDArray[Any]) -> bool:
    return bool(np.isfinite(values).all() and np.all(np.diff(values) > 0))


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array
