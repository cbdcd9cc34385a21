"""Geoms of a MuJoCo model as bodies of a scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark import InputFileError, UsageError
from phasemark.render.rigid import product
from phasemark.render.scene import NEEDS_MUJOCO
from phasemark.render.scene.body import Body
from phasemark.render.scene.mesh_files import LUMINANCE

try:
    import mujoco
except ImportError:
    raise UsageError(NEEDS_MUJOCO) from None

_GEOM = mujoco.mjtGeom
_REACH_M = 1000.0
"""Half a side of the square that stands for an infinite plane."""
_STEP_M = 500.0
"""Steps in which that square follows the camera."""
_ROUNDED = 2.0**20
"""Poses are rounded to one part of this, a micrometre: a body at rest, which solvers move by less, stays as it is."""


@dataclass(frozen=True)
class SeenModel:
    """Bodies of a model, and where they stand.

    Parameters
    ----------
    bodies : tuple of Body
        Each geom is one.
    owner : (b,) int64
        Numbers of the MuJoCo bodies.
    local : (b, 4, 4) float64
        Poses of the scene's bodies in the MuJoCo bodies.
    endless : (b, 2) bool
        Whether a plane is infinite along its x and y.
    """

    bodies: tuple[Body, ...]
    owner: NDArray[np.int64]
    local: NDArray[np.float64]
    endless: NDArray[np.bool_]

    def poses(self, data: Any, lens_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the bodies of the scene stand, (b, 4, 4).

        Parameters
        ----------
        data : mujoco.MjData
        lens_m : (3,) float64
            Infinite planes are rendered about it.
        """
        rotation, offset = data.xmat.reshape(-1, 3, 3)[self.owner], data.xpos[self.owner]
        poses = self.local.copy()
        poses[:, :3, :3] = product(rotation, self.local[:, :3, :3])
        poses[:, :3, 3] = product(rotation, self.local[:, :3, 3:])[..., 0] + offset
        poses = np.round(poses * _ROUNDED) / _ROUNDED
        for b in np.flatnonzero(self.endless.any(axis=1)):
            along = product((lens_m - poses[b, :3, 3])[None], poses[b, :3, :3])[0]
            step = np.where(self.endless[b], np.round(along[:2] / _STEP_M) * _STEP_M, 0.0)
            poses[b, :3, 3] += poses[b, :3, 0] * step[0] + poses[b, :3, 1] * step[1]
        return poses


def seen_model(
    model: Any, albedo: str | float | Mapping[str, float], exclude: int, groups: Sequence[int], smooth: bool
) -> SeenModel:
    """Make a scene of the geoms that a sensor sees.

    Parameters
    ----------
    model : mujoco.MjModel
    albedo : "rgba", float, or mapping from names to float
        As for :class:`~phasemark.render.simulators.mujoco.TofSensor`.
    exclude : int
        Number of a body whose geoms are left out, −1 for none.
    groups : sequence of int
        Groups of geoms that are seen.
    smooth : bool
        As for :class:`~phasemark.render.simulators.mujoco.TofSensor`.

    Raises
    ------
    UsageError
        Nothing is left to be seen, an albedo is out of range or of a name that is not there, or there is a geom, flex
        or skin of a kind that cannot be rendered.
    """
    _refuse_flexible(model, groups)
    own = _albedos(model, albedo)
    visible = _rgba(model)[:, 3] > 0
    seen = np.flatnonzero(visible & np.isin(model.geom_group, groups) & (model.geom_bodyid != exclude))
    if not seen.size:
        raise UsageError(
            f"the model has no geom for the sensor to see: {model.ngeom} geoms, groups {tuple(groups)} are visible"
        )
    bodies: list[Body] = []
    for g in seen.tolist():
        name = body_name(model, int(model.geom_bodyid[g]))
        if any(other.name == name for other in bodies):
            name = f"{name}, {geom_name(model, g)}"
        bodies.append(replace(_shape(model, g, smooth), albedo=own[g], name=name))
    endless = (model.geom_type[seen] == _GEOM.mjGEOM_PLANE)[:, None] & (model.geom_size[seen, :2] <= 0)
    local = np.array([_local(model, g) for g in seen.tolist()])
    found = SeenModel(tuple(bodies), model.geom_bodyid[seen].astype(np.int64), local, endless)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)  # what never moves stands where it is from the start
    poses = found.poses(data, np.zeros(3))
    return replace(found, bodies=tuple(replace(body, pose=pose) for body, pose in zip(bodies, poses, strict=True)))


def bodies_of_mjcf(path: Path, albedo: float | None) -> tuple[Body, ...]:
    """Return the geoms that MuJoCo's viewer shows of a model in a file, at the first positions of its joints.

    Raises
    ------
    InputFileError
        MuJoCo cannot read the file.
    UsageError
        As :func:`seen_model` does.
    """
    compiled = path.suffix.lower() == ".mjb"
    try:
        model = (mujoco.MjModel.from_binary_path if compiled else mujoco.MjModel.from_xml_path)(str(path))
    except ValueError as error:
        version = f"; a compiled model must be of its version, {mujoco.__version__}" if compiled else ""
        raise InputFileError(f"{path}: MuJoCo cannot read it: {' '.join(str(error).split())}{version}") from None
    return seen_model(model, "rgba" if albedo is None else albedo, -1, (0, 1, 2), True).bodies


def body_name(model: Any, body: int) -> str:
    """Return the name of a body, or its number in words."""
    return model.body(body).name or f"body {body}"


def geom_name(model: Any, geom: int) -> str:
    """Return the name of a geom, or its number in words."""
    return model.geom(geom).name or f"geom {geom}"


def _refuse_flexible(model: Any, groups: Sequence[int]) -> None:
    """Refuse flexes and skins."""
    for kind, groups_of in (("flex", model.flex_group), ("skin", model.skin_group)):
        for k in np.flatnonzero(np.isin(groups_of, groups)).tolist():
            raise UsageError(
                f"{kind} {k} of the model cannot be rendered, for it bends: put it into a group that is not in"
                f" groups={tuple(groups)}"
            )


def _rgba(model: Any) -> NDArray[np.float64]:
    """Return the colour of each geom, (n, 4): its own, or its material's where its own is MuJoCo's default grey."""
    rgba: NDArray[np.float64] = model.geom_rgba.astype(np.float64)
    of_material = (model.geom_matid >= 0) & (rgba == [0.5, 0.5, 0.5, 1.0]).all(axis=1)
    rgba[of_material] = model.mat_rgba[model.geom_matid[of_material]]
    return rgba


def _albedos(model: Any, albedo: str | float | Mapping[str, float]) -> list[float]:
    """Return the albedo of each geom."""
    own = np.clip(_rgba(model)[:, :3] @ LUMINANCE, 0.0, 1.0)
    if isinstance(albedo, Mapping):
        names = [model.geom(g).name for g in range(model.ngeom)]
        for name, value in albedo.items():
            if not name or name not in names:
                known = ", ".join([name for name in names if name][:8]) or "none has a name"
                raise UsageError(f"'albedo' names geom {name!r}, which the model does not have: {known}")
            own[names.index(name)] = _albedo(value, f"'albedo' of geom '{name}'")
    elif not isinstance(albedo, str) or albedo != "rgba":
        own[:] = _albedo(albedo, "'albedo'")
    return [round(float(value), 6) for value in own]


def _albedo(value: object, what: str) -> float:
    """Return an albedo that was given."""
    if isinstance(value, str) or not isinstance(value, (int, float, np.number)) or not 0 <= value <= 1:
        raise UsageError(f"{what} must be a number in [0, 1], or 'rgba' for all geoms, got {value!r}")
    return float(value)


def _local(model: Any, geom: int) -> NDArray[np.float64]:
    """Return the pose of a geom in its body, (4, 4)."""
    pose, rotation = np.eye(4), np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), model.geom_pos[geom]
    return pose


def _shape(model: Any, geom: int, smooth: bool) -> Body:
    """Return a geom in its own frame."""
    size, kind, of_data = model.geom_size[geom].tolist(), model.geom_type[geom], int(model.geom_dataid[geom])
    if kind == _GEOM.mjGEOM_PLANE:
        return Body.plane([2 * half if half > 0 else 2 * _REACH_M for half in size[:2]])
    if kind == _GEOM.mjGEOM_HFIELD:
        x, y, top, base = model.hfield_size[of_data].tolist()
        rows, cols, first = (int(a[of_data]) for a in (model.hfield_nrow, model.hfield_ncol, model.hfield_adr))
        heights = model.hfield_data[first : first + rows * cols].reshape(rows, cols).astype(np.float64)
        return replace(Body.height_field(top * heights, (2 * x, 2 * y), base_m=base), smooth=smooth)
    if kind == _GEOM.mjGEOM_SPHERE:
        return Body.sphere(size[0])
    if kind == _GEOM.mjGEOM_CAPSULE:
        return Body.capsule(size[0], 2 * size[1])
    if kind == _GEOM.mjGEOM_ELLIPSOID:
        return Body.ellipsoid(size)
    if kind == _GEOM.mjGEOM_CYLINDER:
        return Body.cylinder(size[0], 2 * size[1])
    if kind == _GEOM.mjGEOM_BOX:
        return Body.box([2 * half for half in size])
    if kind == _GEOM.mjGEOM_MESH:
        vertex, face = int(model.mesh_vertadr[of_data]), int(model.mesh_faceadr[of_data])
        vertices = model.mesh_vert[vertex : vertex + int(model.mesh_vertnum[of_data])].astype(np.float64)
        faces = model.mesh_face[face : face + int(model.mesh_facenum[of_data])]
        return Body(trimesh.Trimesh(vertices, faces), smooth=smooth)
    try:
        known = _GEOM(int(kind)).name
    except ValueError:
        known = "unknown"
    raise UsageError(
        f"{geom_name(model, geom)} of body '{body_name(model, int(model.geom_bodyid[geom]))}' is of type {int(kind)}"
        f" ({known}), which cannot be rendered: give it a shape, or put it into a group that is not seen"
    )
