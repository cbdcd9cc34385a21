"""Robots of URDF files as bodies of a scene: what their links show, with all joints at 0."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from phasemark import InputFileError, UsageError
from phasemark.render.rigid import composed
from phasemark.render.scene.body import Body
from phasemark.render.scene.mesh_files import LUMINANCE, bodies_of_trimesh, loaded_meshes

_ALBEDO = 0.8


def links_of_urdf(path: Path, albedo: float | None) -> list[Body]:
    """Return each link that has visual geometry as a body, named as the link and in its frame.

    Collision geometry takes its place where no link has any.

    Parameters
    ----------
    path : Path
    albedo : float or None
        Of all links; None: the luminance (Rec. 709) of the colour of each visual, or of its mesh.

    Raises
    ------
    InputFileError
        The file is no URDF, a mesh cannot be read, a geometry is unknown, or joints do not form a tree.
    """
    try:
        robot = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise InputFileError(f"{path}: is not XML: {error}") from None
    if robot.tag != "robot":
        raise InputFileError(f"{path}: the outermost element must be <robot>, got <{robot.tag}>")
    if any("xacro" in str(element.tag) for element in robot.iter()):
        raise InputFileError(f"{path}: has xacro elements: expand them first, with xacro {path.name} > robot.urdf")
    colours = {each.get("name", ""): each.find("color") for each in robot.iter("material") if len(each)}
    poses = _link_poses(robot, path)
    kind = "visual" if robot.find("link/visual") is not None else "collision"
    bodies: list[Body] = []
    for link in robot.findall("link"):
        name, visuals = link.get("name", ""), []
        where = f"{path}: link '{name}'"
        for visual in link.findall(kind):
            own, material = albedo, visual.find("material")
            if own is None and material is not None:
                colour = material.find("color") if len(material) else colours.get(material.get("name", ""))
                if colour is not None:
                    rgba = _numbers(colour, "rgba", 4, where)
                    own = float(np.clip(rgba[:3] @ LUMINANCE, 0, 1))
                    if rgba[3] == 0:  # it is not to be seen
                        continue
            try:
                shape = _shape(visual.find("geometry"), own, path, where)
            except UsageError as error:  # a size that cannot be
                raise InputFileError(f"{where}: {error}") from None
            visuals.append(replace(shape, pose=_origin(visual, where)))
        if name in (body.name for body in bodies):
            raise InputFileError(f"{where}: there is another link of this name")
        if visuals:
            bodies.append(replace(Body.joined(visuals, name), pose=poses[name]))
    if not bodies:
        raise InputFileError(f"{path}: no link has a <visual> or <collision>")
    return bodies


def _link_poses(robot: ElementTree.Element, path: Path) -> dict[str, NDArray[np.float64]]:
    """Return where each link stands with all joints at 0."""
    above: dict[str, tuple[str, NDArray[np.float64]]] = {}
    names = [link.get("name", "") for link in robot.findall("link")]
    for joint in robot.findall("joint"):
        where = f"{path}: joint '{joint.get('name')}'"
        parent, child = (_link_of(joint.find(kind)) for kind in ("parent", "child"))
        for end in (parent, child):
            if end not in names:
                raise InputFileError(f"{where}: joins '{end}', which is no link of the robot")
        if child in above:
            raise InputFileError(f"{where}: link '{child}' hangs on another joint already")
        above[child] = parent, _origin(joint, where)
    poses = {}
    for name in names:
        pose, link = np.eye(4), name
        for _ in names:
            if link in above:
                link, step = above[link]
                pose = composed(step, pose)
        if link in above:
            raise InputFileError(f"{path}: the joints above link '{name}' form a ring")
        poses[name] = pose
    return poses


def _link_of(end: ElementTree.Element | None) -> str:
    """Return the link that a joint's <parent> or <child> names."""
    return "" if end is None else end.get("link", "")


def _shape(geometry: ElementTree.Element | None, albedo: float | None, path: Path, where: str) -> Body:
    """Return the geometry of a visual in its own frame."""
    if geometry is None or not len(geometry):
        raise InputFileError(f"{where}: a visual has no <geometry>")
    shape, known = geometry[0], _ALBEDO if albedo is None else albedo
    if shape.tag == "box":
        return Body.box(_numbers(shape, "size", 3, where), albedo=known)
    if shape.tag == "sphere":
        return Body.sphere(_numbers(shape, "radius", 1, where)[0], albedo=known)
    if shape.tag in ("cylinder", "capsule"):
        make = Body.cylinder if shape.tag == "cylinder" else Body.capsule
        return make(*(_numbers(shape, of, 1, where)[0] for of in ("radius", "length")), albedo=known)
    if shape.tag != "mesh":
        raise InputFileError(
            f"{where}: geometry <{shape.tag}> is unknown: there are box, sphere, cylinder, capsule and mesh"
        )
    file = _mesh_file(shape.get("filename", ""), path, where)
    whole = Body.joined(bodies_of_trimesh(loaded_meshes(file), albedo))
    scale, faces = _numbers(shape, "scale", 3, where, "1 1 1"), np.asarray(whole.mesh.faces)
    if not scale.all():
        raise InputFileError(f"{where}: scale of <mesh> must not be 0, got {scale}")
    faces = faces if scale.prod() > 0 else faces[:, ::-1]
    return replace(whole, mesh=trimesh.Trimesh(np.asarray(whole.mesh.vertices) * scale, faces, process=False))


def _mesh_file(name: str, path: Path, where: str) -> Path:
    """Return where a mesh is: that of package://NAME/… lies in a folder above, which may be NAME itself."""
    scheme, found, rest = name.rpartition("://")
    files = [path.parent / rest]
    if found and scheme != "file":
        inside = Path(*Path(rest).parts[1:])
        files = [folder / part for folder in path.resolve().parents for part in (rest, inside)]
    for file in files:
        if rest and file.is_file():
            return file
    raise InputFileError(f"{where}: there is no mesh '{name}'" + (" in a folder above the file" if found else ""))


def _origin(element: ElementTree.Element, where: str) -> NDArray[np.float64]:
    """Return the pose that an element's <origin> states, (4, 4)."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", _numbers(origin, "rpy", 3, where, "0 0 0")).as_matrix()
    pose[:3, 3] = _numbers(origin, "xyz", 3, where, "0 0 0")
    return pose


def _numbers(element: ElementTree.Element, key: str, n: int, where: str, default: str = "") -> NDArray[np.float64]:
    """Return the n numbers of an attribute."""
    text = element.get(key, default)
    try:
        numbers = np.array(text.split(), np.float64)
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != n or not np.isfinite(numbers).all():
        raise InputFileError(f"{where}: {key} of <{element.tag}> must be {n} number{'s' * (n > 1)}, got '{text}'")
    return numbers
