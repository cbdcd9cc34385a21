"""Histograms of known scenes: planes at known distances, and known objects at known poses."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.render.direct.histogram_frames import HistogramFrames
from phasemark.render.integral.scene_samples import SceneMesh
from phasemark.render.rigid import rigid_transforms

_LEVEL = 0.999  # least upward part of the normal of a level face

OPTICAL2CAM = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From the optical frame (x right, y down, z forward) to the camera frame (x forward, y left, z up)."""


@dataclass(frozen=True, eq=False)
class PlaneRecording:
    """Histograms of a plane that fills the field of view, about square to the axis.

    Parameters
    ----------
    frames : HistogramFrames
        n positions.
    distance_m : (n,) array_like
        Distance of the plane along the optical axis.
    """

    frames: HistogramFrames
    distance_m: NDArray[np.float64]

    def __post_init__(self) -> None:
        distances = np.asarray(self.distance_m, dtype=np.float64)
        if distances.shape != (len(self.frames),):
            raise UsageError(f"'distance_m' must name {len(self.frames)} distances, got {distances.shape}")
        if not (np.isfinite(distances) & (distances > 0)).all():
            raise UsageError("'distance_m' must be positive")
        object.__setattr__(self, "distance_m", distances)

    def __getitem__(self, positions: NDArray[np.integer]) -> PlaneRecording:
        """Return some positions."""
        return PlaneRecording(self.frames[positions], self.distance_m[positions])


@dataclass(frozen=True, eq=False)
class ObjectRecording:
    """Histograms of a known object on its support, from known poses of the sensor.

    Parameters
    ----------
    name : str
        Name of the object.
    frames : HistogramFrames
        n positions.
    mesh : trimesh.Trimesh
        Object and support, world frame, metres; the face attribute "part" is 1 on the object, 0 on the support.
    sensor2world : (n, 4, 4) array_like
        Pose of the sensor's optical frame: x right, y down, z forward.
    """

    name: str
    frames: HistogramFrames
    mesh: trimesh.Trimesh
    sensor2world: NDArray[np.float64]
    scene: SceneMesh = field(init=False, repr=False)

    def __post_init__(self) -> None:
        poses = rigid_transforms(self.sensor2world)
        if len(poses) != len(self.frames):
            raise UsageError(f"'sensor2world' must name {len(self.frames)} poses, got {len(poses)}")
        object.__setattr__(self, "sensor2world", poses)
        object.__setattr__(self, "scene", SceneMesh(self.mesh))

    @property
    def centre_m(self) -> NDArray[np.float64]:
        """Middle of the box around the object, world frame, (3,)."""
        return object_centre(self.mesh)

    def __getitem__(self, positions: NDArray[np.integer]) -> ObjectRecording:
        """Return some positions."""
        return replace(self, frames=self.frames[positions], sensor2world=self.sensor2world[positions])


def world2cam(
    sensor2world: ArrayLike, sensor_offset_m: ArrayLike = (0.0, 0.0, 0.0), placement_m: ArrayLike = (0.0, 0.0, 0.0)
) -> NDArray[np.float64]:
    """Return the transforms from a mesh's world frame to the camera frame.

    Parameters
    ----------
    sensor2world : (n, 4, 4) array_like
        Poses of the optical frame.
    sensor_offset_m : (3,) array_like
        Where the zones' common origin lies in that frame (x right, y down, z forward).
    placement_m : (3,) array_like
        How far the mesh stands from where its file says, world frame.

    Returns
    -------
    (n, 4, 4) float64
    """
    poses = np.array(sensor2world, dtype=np.float64)
    poses[:, :3, 3] += poses[:, :3, :3] @ np.asarray(sensor_offset_m, dtype=np.float64)
    poses[:, :3, 3] -= np.asarray(placement_m, dtype=np.float64)
    return np.asarray(OPTICAL2CAM @ np.linalg.inv(poses))


def object_centre(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Return the middle of the box around the faces of part 1, (3,); of all faces where none is labelled so."""
    part = np.asarray(mesh.face_attributes.get("part", np.ones(len(mesh.faces))), dtype=bool)
    chosen = part if part.any() else ~part
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)[chosen]].reshape(-1, 3)
    return np.asarray(0.5 * (corners.min(axis=0) + corners.max(axis=0)), dtype=np.float64)


def turn_about(centre_m: ArrayLike, yaw_rad: float) -> NDArray[np.float64]:
    """Return the transform that turns a mesh about a vertical axis through a point, (4, 4)."""
    centre = np.asarray(centre_m, dtype=np.float64)
    turn = np.eye(4)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn[:2, :2] = [[c, -s], [s, c]]
    turn[:3, 3] = centre - turn[:3, :3] @ centre
    return turn


def label_object(mesh: trimesh.Trimesh, support_z_m: float, tolerance_m: float = 1e-3) -> trimesh.Trimesh:
    """Return a mesh whose faces are labelled: 1 for what stands above the support, 0 for the support itself.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        The mesh, metres.
    support_z_m : float
        Height of the support's surface.
    tolerance_m : float
        Faces whose highest vertex lies no more than this above the support belong to it.
    """
    labelled = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    top = np.asarray(mesh.vertices)[np.asarray(mesh.faces)][:, :, 2].max(axis=1)
    labelled.face_attributes["part"] = (top > support_z_m + tolerance_m).astype(np.int8)
    return labelled


def support_height(mesh: trimesh.Trimesh) -> float:
    """Return the height of the largest level surface that faces up: what an object stands on.

    Raises
    ------
    UsageError
        No face is level.
    """
    level = np.asarray(mesh.face_normals)[:, 2] > _LEVEL
    if not level.any():
        raise UsageError("the mesh has no level face: an object's mesh must hold the table that it stands on")
    height = np.asarray(mesh.triangles_center)[level, 2]
    same_height_m = 1e-3
    steps, group = np.unique(np.round(height / same_height_m), return_inverse=True)
    area = np.bincount(group, np.asarray(mesh.area_faces)[level], minlength=len(steps))
    return float(np.median(height[group == area.argmax()]))
