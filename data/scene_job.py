"""Base of the jobs that build banks and frame sets: landmarks of a plan, and what both files hold beside arrays."""

from __future__ import annotations

import itertools
import json
import math
import warnings
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import h5py
import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark.data.files.hdf5_layout import Layout
from phasemark.data.files.json_text import json_text
from phasemark.data.files.narrow import narrowed
from phasemark.data.files.provenance import mesh_sha256, versions
from phasemark.data.plans.arrays import Array
from phasemark.data.plans.bank_plan import MeshPlan, PlanModel
from phasemark.data.shards.build import Job, Place
from phasemark.data.stored_scene import StoredScene, open_scene
from phasemark.landmarks import LandmarkSpec, build_mesh, mesh_symmetry
from phasemark.landmarks.mesh_files import MeshWarning
from phasemark.landmarks.symmetry import has_symmetry, is_same_shape, symmetry_tolerance_m
from phasemark.render import Sensor

StoredMesh = Callable[[str], trimesh.Trimesh]


@dataclass(frozen=True)
class Landmark:
    """A class of landmarks: its mesh, and its description unless it came from a file."""

    name: str
    mesh: trimesh.Trimesh
    symmetry: int
    albedo: float
    spec: LandmarkSpec | None = None


P = TypeVar("P", bound=PlanModel)


class SceneJob(Job, Generic[P]):
    """A bank or a frame set to be built (:class:`phasemark.data.shards.build.Job`).

    Parameters
    ----------
    plan : PlanModel
        The resolved plan.
    sensor : Sensor
        The camera, as the file holds it.
    landmarks : list of Landmark
        Whose meshes the file holds.
    """

    KIND: ClassVar[str]
    """Name of the kind of job, for :func:`phasemark.data.partial_outputs.job_of`."""
    STORED: ClassVar[type[StoredScene]]
    shard_items: int | None = None
    """Items made at a time where nobody says how many; None: about 4 MiB of them."""
    fields: Sequence[str]
    """Names of the arrays of an item, in the order in which :meth:`make` returns them."""
    maker = "phasemark.data.partial_outputs:job_of"

    def __init__(self, plan: P, sensor: Sensor, landmarks: list[Landmark]) -> None:
        self.plan: P = plan
        self.sensor = sensor
        self.landmarks = landmarks

    def spec(self) -> dict[str, Any]:
        """Return a description from which another process makes the same job."""
        return {"kind": self.KIND, "plan": self.plan.model_dump(mode="json")}

    def identity(self) -> dict[str, Any]:
        """Return all that the file's bytes depend on."""
        return {
            "plan": self.plan.model_dump(mode="json"),
            "versions": versions(),
            "mesh_sha256": {landmark.name: mesh_sha256(landmark.mesh) for landmark in self.landmarks},
        }

    def finished_identity(self, path: Path) -> dict[str, Any]:
        """Return the identity of a finished file of this kind."""
        with open_scene(self.STORED, path, untrusted=True) as stored:
            return stored.identity()

    def lay_out(self) -> tuple[Layout, list[list[Place]]]:
        """Return all but the values of large arrays, and where these go."""
        with Layout() as layout:
            layout.file.attrs.update(
                {
                    "format": self.STORED.FORMAT,
                    "schema_version": self.STORED.SCHEMA_VERSION,
                    **self.attributes(),
                    "plan": json_text(self.plan),
                    "sensor": json_text(self.sensor),
                    "versions": json.dumps(versions(), sort_keys=True),
                }
            )
            places = self.lay_out_arrays(layout)
            for landmark in self.landmarks:
                _write_mesh(layout.file.create_group(f"meshes/{landmark.name}"), landmark)
        return layout, places

    def attributes(self) -> dict[str, str]:
        """Return further attributes of the file."""
        return {}

    @abstractmethod
    def check_views(self) -> None:
        """Refuse a plan with views that cannot be rendered, before any is.

        Raises
        ------
        UsageError
            Naming the view.
        """

    @abstractmethod
    def lay_out_arrays(self, layout: Layout) -> list[list[Place]]:
        """Write all but meshes into a layout, and return for each slab where its large arrays go."""

    @abstractmethod
    def read(self, file: h5py.File, slab: int, item: int) -> dict[str, NDArray[Any]]:
        """Return one item of a file, by the names of its arrays."""


def make_scale(group: h5py.Group, name: str, values: Any, units: str, long_name: str) -> h5py.Dataset:
    """Write the coordinates of a dimension; without `units` they have none."""
    kind = h5py.string_dtype() if isinstance(values[0], str) else np.asarray(values).dtype.newbyteorder("<")
    scale = group.create_dataset(name, data=values, dtype=kind)
    scale.make_scale(name)
    scale.attrs["long_name"] = long_name
    if units:
        scale.attrs["units"] = units
    return scale


def reserve_array(
    layout: Layout, group: h5py.Group, scales: Mapping[str, h5py.Dataset], name: str, array: Array, n_outer: int = 1
) -> tuple[h5py.Dataset, Place]:
    """Reserve an array along some scales; its place has the bytes of one index of the first `n_outer` dimensions."""
    shape = [len(scales[dim]) for dim in array.dims]
    kind = np.dtype(array.kind)
    stored = h5py.string_dtype("utf-8", kind.itemsize) if kind.kind == "S" else kind
    dataset, offset = layout.reserve(group, name, shape, stored)
    attach_scales(dataset, scales, array.dims)
    dataset.attrs["long_name"] = array.long_name
    dataset.attrs["units"] = array.units
    return dataset, Place(offset, math.prod(shape[n_outer:]) * np.dtype(array.kind).itemsize)


def attach_scales(dataset: h5py.Dataset, scales: Mapping[str, h5py.Dataset], dims: Sequence[str]) -> None:
    """Attach to each dimension of a dataset its coordinates."""
    for axis, dim in enumerate(dims):
        dataset.dims[axis].attach_scale(scales[dim])


def read_landmarks(
    landmarks: Sequence[LandmarkSpec], meshes: Sequence[MeshPlan], stored_mesh: StoredMesh | None = None
) -> list[Landmark]:
    """Build the meshes of landmarks, and read those that come from files (or are stored in one of ours)."""
    found = [Landmark(spec.name, build_mesh(spec), spec.symmetry, spec.albedo, spec) for spec in landmarks]
    for part in meshes:
        if stored_mesh is None:
            mesh = part.read()
            _doubt_symmetry(part, mesh)
        else:
            mesh = stored_mesh(part.name)
        found.append(Landmark(part.name, mesh, part.symmetry or 1, part.albedo))
    if stored_mesh is None:
        _doubt_classes(found)
    return found


def _doubt_symmetry(part: MeshPlan, mesh: trimesh.Trimesh) -> None:
    """Warn of a stated symmetry that the mesh has not, or of one that it has more of."""
    if part.symmetry is None:
        return
    stated, found = f"{part.path}: symmetry {part.symmetry} is stated for '{part.name}'", mesh_symmetry(mesh)
    if not has_symmetry(mesh, part.symmetry):
        _warn(
            f"{stated}, but turned by {360 / part.symmetry:g}° it differs from itself by more than"
            f" {1e3 * symmetry_tolerance_m(mesh):.2g} mm; found: {found}"
        )
    elif found > part.symmetry:
        _warn(
            f"{stated}, but turned by {360 / found:g}° it is the same: views that far apart look alike, and no answer"
            f" about it can be accepted; found: {found}"
        )


def _warn(doubt: str) -> None:
    warnings.warn(doubt, MeshWarning, stacklevel=3)


def _doubt_classes(landmarks: list[Landmark]) -> None:
    """Warn of classes that are the same part."""
    for first, second in itertools.combinations(landmarks, 2):
        if is_same_shape(first.mesh, second.mesh):
            _warn(
                f"'{first.name}' and '{second.name}' look alike from everywhere, and no answer"
                " about them can be accepted; leave one out"
            )


def _write_mesh(group: h5py.Group, landmark: Landmark) -> None:
    """Write the mesh of a class into its group."""
    mesh = landmark.mesh
    vertices = group.create_dataset("vertices", data=np.asarray(mesh.vertices, dtype="<f8"))
    vertices.attrs.update({"units": "m", "long_name": "vertices x', y', z' in the landmark frame"})
    faces = group.create_dataset("faces", data=narrowed(mesh.faces, "<i4", "vertices of a face"))
    faces.attrs["long_name"] = "three vertex indices of each face"
    if "part" in mesh.face_attributes:
        part = group.create_dataset("part", data=narrowed(mesh.face_attributes["part"], "|u1", "parts"))
        part.attrs["long_name"] = "0 on faces of the lower part, 1 on those of the upper one"
    about = {"delta_period_deg": 360 / landmark.symmetry, "albedo": landmark.albedo, "sha256": mesh_sha256(mesh)}
    group.attrs.update(about)
