"""Meshes of trimesh scenes, and of files that trimesh reads, as bodies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark import InputFileError, UsageError
from phasemark.render.scene.body import Body

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of red, green and blue."""


def bodies_of_trimesh(scene: trimesh.Scene, albedo: float | None) -> list[Body]:
    """Return the meshes of a trimesh scene as bodies; see :meth:`phasemark.render.Scene.of_trimesh`.

    Raises
    ------
    UsageError
        The scene has no mesh.
    """
    bodies = []
    for node in scene.graph.nodes_geometry:
        pose, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            continue
        rotation, scale = _without_scale(np.asarray(pose, np.float64))
        faces = mesh.faces if np.linalg.det(scale) > 0 else mesh.faces[:, ::-1]
        scaled = trimesh.Trimesh(np.asarray(mesh.vertices) @ scale.T, faces, process=False)
        own = _albedo_of(mesh) if albedo is None else albedo
        bodies.append(Body(scaled, own, str(node), rotation))
    if not bodies:
        raise UsageError("the scene holds no mesh")
    return bodies


def loaded_meshes(path: Path) -> trimesh.Scene:
    """Return the meshes that trimesh reads of a file.

    Raises
    ------
    InputFileError
        It cannot be read, or holds no mesh.
    """
    try:
        loaded = trimesh.load_scene(path)
    except Exception as error:  # whatever one of a dozen readers raises
        raise InputFileError(f"{path}: cannot be read as a scene ({type(error).__name__}: {error})") from None
    if not any(isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) for mesh in loaded.geometry.values()):
        raise InputFileError(f"{path}: holds no mesh with faces")
    return loaded


def _without_scale(pose: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Split a node's transform into a rigid one and what comes before it: scale and shear, (3, 3)."""
    left, _, right = np.linalg.svd(pose[:3, :3])
    rotation = left @ right
    if np.linalg.det(rotation) < 0:
        rotation = left @ np.diag([1.0, 1.0, -1.0]) @ right
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = rotation, pose[:3, 3]
    return rigid, rotation.T @ pose[:3, :3]


def _albedo_of(mesh: trimesh.Trimesh) -> float | NDArray[np.float64]:
    """Return the luminance of a mesh's material and of its texture on the mean, or of each face's colour."""
    visual: Any = mesh.visual
    if visual.kind in ("face", "vertex"):
        return np.asarray(np.asarray(visual.face_colors, np.float64)[:, :3] @ LUMINANCE / 255)
    material = getattr(visual, "material", None)
    texture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    colour: Any = getattr(material, "baseColorFactor" if hasattr(material, "baseColorFactor") else "main_color", None)
    placeholder = [102, 102, 102, 255]  # trimesh's diffuse colour of a material that states none
    if texture is not None and np.array_equal(np.ravel(colour), placeholder):
        colour = None
    if colour is None and texture is None:
        return 0.8
    own = 1.0 if colour is None else np.asarray(colour, np.float64)[:3] / 255
    drawn = 1.0 if texture is None else np.asarray(texture.convert("RGB"), np.float64).mean(axis=(0, 1)) / 255
    return float(np.broadcast_to(own * drawn, 3) @ LUMINANCE)
