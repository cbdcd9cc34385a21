"""Base of banks and frame sets as they are read: plan, camera and meshes of landmarks in one HDF5 file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import h5py
import numpy as np
import trimesh

from phasemark import InputFileError, UsageError
from phasemark.data.files.hdf5_reading import (
    check_format,
    group_of,
    json_attribute,
    open_hdf5,
    reading,
    whole_numbers,
)
from phasemark.data.plans.bank_plan import PlanModel
from phasemark.render import Sensor


class StoredScene:
    """A bank or a frame set that is open for reading; a context manager.

    Parameters
    ----------
    file : h5py.File
        The file, open for reading; this object closes it.
    path : Path
        Its name, for messages.
    """

    WHAT: ClassVar[str]
    FORMAT: ClassVar[str]
    SCHEMA_VERSION: ClassVar[int] = 1
    plan: PlanModel
    classes: tuple[str, ...]

    def __init__(self, file: h5py.File, path: Path) -> None:
        self._file, self.path = file, path
        self._process = os.getpid()
        self._closed = False
        check_format(file, path, self.WHAT, self.FORMAT, self.SCHEMA_VERSION)
        self.sensor = Sensor(**json_attribute(file, path, "sensor"))
        self.versions: dict[str, str] = json_attribute(file, path, "versions")

    @classmethod
    def of_file(cls, file: h5py.File, path: Path) -> Self:
        """Return the content of an open file, of this class or of one below it."""
        return cls(file, path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle the file that this is: it is opened again, and closed if this one is."""
        return _opened_again, (type(self), self.path.absolute(), self._closed)

    @property
    def is_open(self) -> bool:
        """Whether the file can be read."""
        return not self._closed

    def close(self) -> None:
        """Close the file; arrays read before stay usable."""
        if self._process == os.getpid():
            self._file.close()
        self._closed = True

    def _open(self) -> h5py.File:
        if self._closed:
            raise UsageError(f"{self.path}: the {self.WHAT} is closed")
        # after a fork HDF5's handles are not ours to use; a temporary file has no other
        if self._process != os.getpid() and self.path.exists():
            self._file, self._process = h5py.File(self.path, "r"), os.getpid()
        return self._file

    def _class_index(self, class_name: str) -> int:
        if class_name not in self.classes:
            raise UsageError(f"unknown class {class_name!r}: {self.path} has {', '.join(self.classes)}")
        return self.classes.index(class_name)

    def identity(self) -> dict[str, Any]:
        """Return everything that the file's bytes depend on: resolved plan, versions, mesh hashes."""
        file = self._open()
        with reading(self.path):
            hashes = {name: str(file[f"meshes/{name}"].attrs["sha256"]) for name in self.classes}
        return {"plan": json_attribute(file, self.path, "plan"), "versions": self.versions, "mesh_sha256": hashes}

    def mesh(self, class_name: str) -> trimesh.Trimesh:
        """Return the mesh of a class, metres, landmark frame; ``metadata`` has `symmetry` and `albedo`.

        Raises
        ------
        UsageError
            The file does not have the class.
        InputFileError
            The mesh in the file is damaged.
        """
        self._class_index(class_name)
        path, where = self.path, f"meshes/{class_name}"
        group = group_of(self._open(), where, path)
        with reading(path):
            vertices = group["vertices"][...].astype(np.float64)
            faces = whole_numbers(group["faces"], path)
            part = whole_numbers(group["part"], path) if "part" in group else None
            period_deg, albedo = float(group.attrs["delta_period_deg"]), float(group.attrs["albedo"])
        if not 1 <= period_deg <= 360:  # as the plan has it: a symmetry of 1 … 360
            raise InputFileError(
                f"{path}: 'delta_period_deg' of '{class_name}' must be in [1, 360], got {period_deg:g}"
            )
        if not (vertices.ndim == faces.ndim == 2 and vertices.shape[1:] == faces.shape[1:] == (3,) and faces.size):
            raise InputFileError(f"{path}: '{where}' must hold rows of three, of vertices and faces")
        farthest_vertex_m = 1e3  # no landmark is so large; damage that leaves a number often is
        if not (np.abs(vertices) <= farthest_vertex_m).all() or faces.min() < 0 or faces.max() >= len(vertices):
            raise InputFileError(f"{path}: '{where}' has vertices that are not within 1 km, or not there")
        if part is not None and (part.shape != faces.shape[:1] or part.min() < 0 or part.max() > 1):
            raise InputFileError(f"{path}: '{where}/part' must have one value for each face, 0 or 1")
        parts: dict[str, Any] | None = None if part is None else {"part": part.astype(np.uint8)}
        metadata = {"name": class_name, "symmetry": round(360 / period_deg), "albedo": albedo}
        return trimesh.Trimesh(vertices, faces, process=False, face_attributes=parts, metadata=metadata)


S = TypeVar("S", bound=StoredScene)


def open_scene(kind: type[S], path: str | os.PathLike[str], *, untrusted: bool = False) -> S:
    """Open a bank or a frame set.

    Parameters
    ----------
    kind : type
        Class of what the file must be.
    path : path-like
    untrusted : bool
        Whether a child process with limits reads the file first, unless ``FILE.sha256`` vouches for it.

    Raises
    ------
    InputFileError
        The file cannot be read, is not of that kind, was made by a newer version, or is damaged.
    """
    path = Path(path)
    file = open_hdf5(path, kind.WHAT, untrusted=untrusted)
    try:
        with reading(path):
            return kind.of_file(file, path)
    except BaseException:
        file.close()
        raise


def _opened_again(kind: type[S], path: Path, closed: bool) -> S:
    found = open_scene(kind, path)
    if closed:
        found.close()
    return found
