"""Meshes from files: read from bytes, checked, brought to metres and into the landmark frame; and back to bytes."""

from __future__ import annotations

import io
import logging
import os
import re
import struct
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark import InputFileError, PhasemarkError, UsageError
from phasemark.inputs import read_whole
from phasemark.landmarks.mesh import MAX_FACES
from phasemark.landmarks.symmetry import mesh_symmetry

# Without a handler of its own, what trimesh logs about a damaged file, tracebacks included, would go to stderr.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

_MOST_BYTES = 1 << 27
"""What MAX_FACES take in binary, with a margin; in text it is half as many faces, which no landmark needs either."""
FORMATS = ("stl", "ply", "obj", "off")
METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
ORIGINS = ("file", "base", "center")
_UP: dict[str, list[list[float]]] = {
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    "-x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
}
"""Rotations that turn each axis of a file upwards."""


class MeshWarning(UserWarning):
    """A mesh that can be rendered, but may not be what its maker meant."""


@dataclass(frozen=True)
class MeshReport:
    """Size, extent and defects of a mesh.

    Parameters
    ----------
    faces : int
        Triangles.
    vertices : int
        Distinct points.
    bodies : int
        Pieces that hang together.
    watertight : bool
        Whether every edge joins exactly two faces.
    outward : bool
        Whether the surface is wound outward throughout (only asked of a watertight mesh).
    extents_m : tuple of float
        Size of the bounding box.
    area_m2 : float
        Area of all triangles.
    volume_m3 : float or None
        Volume of a watertight mesh, negative if it is inside out; None of an open one.
    symmetry : int
        How many turns about z' leave the mesh as it is (:func:`phasemark.landmarks.mesh_symmetry`); 360 for a body of
        revolution.
    warnings : tuple of str
        What may be wrong, one line each.
    """

    faces: int
    vertices: int
    bodies: int
    watertight: bool
    outward: bool
    extents_m: tuple[float, float, float]
    area_m2: float
    volume_m3: float | None
    symmetry: int
    warnings: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the report as plain numbers and text, for JSON; the volume of an open mesh is None."""
        return asdict(self)


def read_mesh(
    source: str | os.PathLike[str] | bytes,
    *,
    unit: str | None,
    file_type: str | None = None,
    up: str = "z",
    origin: str = "file",
) -> trimesh.Trimesh:
    """Read a mesh file and bring it into the landmark frame, in metres.

    Files that a mesh file names, such as materials, are never opened.

    Parameters
    ----------
    source : path-like or bytes
        An STL, PLY, OBJ or OFF file, or its content.
    unit : {"m", "cm", "mm", "inch"}
        Unit of the coordinates; mesh files do not say.
    file_type : str, optional
        The format; taken from the name's ending if not given.
    up : {"z", "-z", "y", "-y", "x", "-x"}
        Axis of the file that points up.
    origin : {"file", "base", "center"}
        What becomes the origin: the file's own, the centre of the foot, or the centre of the bounding box.

    Returns
    -------
    trimesh.Trimesh
        Vertices at one point are merged, faces without area dropped. ``metadata`` has ``name``, ``symmetry`` (1:
        :func:`phasemark.landmarks.mesh_symmetry` finds it) and ``albedo`` (0.8).

    Raises
    ------
    InputFileError
        The file cannot be read, or has no faces, vertices that are not finite, indices out of range, no extent, over
        two million faces, over 4096 at one vertex, or an unknown format.
    UsageError
        An option is wrong or the unit is missing; then the message gives the extents in each unit.

    Warns
    -----
    MeshWarning
        The mesh is open or inside out; it is rendered two-sided.
    """
    for option, value, known in (("up", up, _UP), ("origin", origin, ORIGINS), ("unit", unit, METRES_PER_UNIT)):
        if value not in known and (option != "unit" or value is not None):
            raise UsageError(f"'{option}' must be one of {', '.join(known)}, got {value!r}")
    if isinstance(source, bytes):
        name, content = "mesh", source
    else:
        path = Path(source)
        name, file_type = str(path), file_type or path.suffix.removeprefix(".")
        content = read_whole(path, most_bytes=_MOST_BYTES)
    kind = (file_type or "").lower()
    if kind not in FORMATS:
        raise InputFileError(f"{name}: unknown mesh format '{kind}': the formats are {', '.join(FORMATS)}")
    vertices, faces = _parse(content, kind, name)
    extents = np.ptp(vertices, axis=0)
    if unit is None:
        in_units = {
            key: " × ".join(f"{value * scale:.4g}" for value in extents) for key, scale in METRES_PER_UNIT.items()
        }
        sizes = "; ".join(f"{key}: {shown} m" for key, shown in in_units.items())
        raise UsageError(f"{name}: say in which unit it is (unit=…); its extents would be {sizes}")
    vertices = vertices * METRES_PER_UNIT[unit] @ np.array(_UP[up]).T
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if origin != "file":
        centre = (low + high) / 2
        vertices = vertices - np.array([centre[0], centre[1], low[2] if origin == "base" else centre[2]])
    metadata = {"name": Path(name).stem, "symmetry": 1, "albedo": 0.8}
    mesh = trimesh.Trimesh(vertices, faces, process=False, metadata=metadata)
    for warning in _doubts(mesh):
        warnings.warn(f"{name}: {warning}", MeshWarning, stacklevel=2)
    return mesh


def check_mesh(mesh: trimesh.Trimesh) -> MeshReport:
    """Report size, extent and defects of a mesh.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Metres.

    Returns
    -------
    MeshReport
    """
    watertight = bool(mesh.is_watertight)
    return MeshReport(
        faces=len(mesh.faces),
        vertices=len(mesh.vertices),
        bodies=int(mesh.body_count),
        watertight=watertight,
        outward=_is_outward(mesh),
        extents_m=(float(mesh.extents[0]), float(mesh.extents[1]), float(mesh.extents[2])),
        area_m2=float(mesh.area),
        volume_m3=float(mesh.volume) if watertight else None,
        symmetry=mesh_symmetry(mesh),
        warnings=tuple(_doubts(mesh)),
    )


def _is_outward(mesh: trimesh.Trimesh) -> bool:
    return bool(mesh.is_watertight) and bool(mesh.is_winding_consistent) and float(mesh.volume) > 0


def _doubts(mesh: trimesh.Trimesh) -> list[str]:
    """Return the possible faults of a mesh, one sentence each."""
    found = []
    if not mesh.is_watertight:
        found.append("the surface is open; it is rendered two-sided")
    elif not _is_outward(mesh):
        found.append("the surface is inside out or wound inconsistently; it is rendered two-sided")
    largest = float(max(mesh.extents))
    if largest > 5 or largest < 0.01:
        found.append(f"it is {largest:.3g} m large: is the unit right?")
    return found


def export_mesh(mesh: trimesh.Trimesh, file_type: str) -> bytes:
    """Return a mesh as the content of a file, in metres; the same mesh gives the same bytes.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        The mesh, metres.
    file_type : {"stl", "ply", "obj", "off"}
        Format of the file.

    Raises
    ------
    UsageError
        The format is unknown.
    """
    kind = file_type.lower()
    if kind not in FORMATS:
        raise UsageError(f"unknown mesh format '{file_type}': the formats are {', '.join(FORMATS)}")
    content = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type=kind)
    return content.encode() if isinstance(content, str) else bytes(content)


def _parse(content: bytes, kind: str, name: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return distinct vertices and the faces that have an area, in the file's unit.

    The loader drops or repairs in silence what is damaged, so the file is checked before and what comes out after.
    """
    if kind == "off":  # without comments and blanks around them
        lines = (line.partition(b"#")[0].strip() for line in content.splitlines())
        content = b"\n".join(line for line in lines if line)
    if kind == "obj":
        _check_count(len(re.findall(rb"^\s*f\s", content, re.MULTILINE)), name)
        content = _with_absolute_indices(content, name)
    else:
        {"stl": _check_stl, "ply": _check_ply, "off": _check_off}[kind](content, name)
    try:
        with np.errstate(all="ignore"):
            loaded: Any = trimesh.load(
                io.BytesIO(content), file_type=kind, process=False, force="mesh", skip_materials=True,
                maintain_order=True,
            )  # fmt: skip
        vertices = np.asarray(loaded.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.asarray(loaded.faces, dtype=np.int64).reshape(-1, 3)
    except PhasemarkError:
        raise
    except Exception as error:  # whatever a damaged file makes the loader say
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputFileError(f"{name}: damaged, or not {kind.upper()} ({reason})") from None
    _check_count(len(faces), name)
    if not np.isfinite(vertices).all():
        index = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise InputFileError(f"{name}: vertex {index} is not finite")
    wrong = faces[(faces < 0) | (faces >= len(vertices))]
    if wrong.size:
        raise InputFileError(f"{name}: a face names vertex {wrong[0]}, but there are {len(vertices)}")
    vertices, merged = np.unique(vertices + 0.0, axis=0, return_inverse=True)
    faces = merged.reshape(-1)[faces]
    if np.abs(vertices).max() > 1e9:
        raise InputFileError(f"{name}: a coordinate is {np.abs(vertices).max():.3g}, which no landmark reaches")
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    faces = faces[area > 1e-14 * float(np.ptp(vertices, axis=0).max()) ** 2]
    if not len(faces):
        raise InputFileError(f"{name}: has no extent: no face has an area")
    meeting = int(np.bincount(faces.ravel()).max())
    # faces that may meet at one vertex: where polygons of more corners are cut into triangles, all of them lie in the
    # way of each other, and finding what is near a point takes the square of their number
    most_at_vertex = 4096
    if meeting > most_at_vertex:
        raise InputFileError(
            f"{name}: {meeting} faces meet at one vertex, at most {most_at_vertex} can be used: give a polygon fewer"
            " corners"
        )
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _check_count(count: int, name: str) -> None:
    """Refuse a file of no faces, or of more than can be used."""
    if count <= 0:
        raise InputFileError(f"{name}: has no faces")
    if count > MAX_FACES:
        raise InputFileError(f"{name}: has {count} faces, at most {MAX_FACES} can be used")


def _check_stl(content: bytes, name: str) -> None:
    declared = struct.unpack_from("<I", content, 80)[0] if len(content) >= 84 else 0
    if len(content) >= 84 and len(content) == 84 + 50 * declared:
        _check_count(declared, name)
        return
    if content.lstrip()[:5].lower() == b"solid":
        text = content.lower()
        facets, loops = text.count(b"facet normal"), text.count(b"endfacet")
        corners = len(re.findall(rb"\bvertex\s", text))
        _check_count(facets, name)
        if loops != facets or corners != 3 * facets or b"endsolid" not in text:
            raise InputFileError(
                f"{name}: cut off, or not STL ({facets} facets begin, {loops} end, {corners} vertices)"
            )
        return
    if len(content) < 84:
        raise InputFileError(f"{name}: cut off, or not STL ({len(content)} bytes, a header alone has 84)")
    _check_count(max(declared, 1), name)  # one that announces none is of a wrong length all the same
    raise InputFileError(
        f"{name}: cut off, or not STL ({declared} faces need {84 + 50 * declared} bytes, it has {len(content)})"
    )


def _check_ply(content: bytes, name: str) -> None:
    end = content.find(b"end_header")
    if not content.startswith(b"ply") or end < 0:
        raise InputFileError(f"{name}: cut off, or not PLY (no header from 'ply' to 'end_header')")
    header = content[:end].decode("ascii", "replace")
    counts = {kind: int(n) for kind, n in re.findall(r"^element\s+(\w+)\s+(\d{1,12})\s*$", header, re.MULTILINE)}
    n_faces, n_vertices = counts.get("face", 0), counts.get("vertex", 0)
    _check_count(max(n_faces, n_vertices // 3) if n_faces and n_vertices else 0, name)
    if re.search(r"^format\s+ascii", header, re.MULTILINE):
        lines = sum(1 for line in content[end:].splitlines()[1:] if line.strip())
        if lines < sum(counts.values()):
            raise InputFileError(f"{name}: cut off ({sum(counts.values())} lines of data announced, {lines} there)")


def _check_off(content: bytes, name: str) -> None:
    text = content.split()
    if not text or not text[0].upper().endswith(b"OFF"):
        raise InputFileError(f"{name}: not OFF (the first word must be OFF)")
    try:
        n_vertices, n_faces = int(text[1]), int(text[2])
    except (IndexError, ValueError):
        raise InputFileError(f"{name}: cut off, or not OFF (no counts of vertices and faces)") from None
    _check_count(n_faces if n_vertices > 0 else 0, name)
    first, *others = content.splitlines()
    counts = first.split()[1:] or others[0].split()  # some leave out the third, of edges
    if len(text) < 1 + min(len(counts), 3) + 3 * n_vertices + 4 * n_faces:
        raise InputFileError(f"{name}: cut off ({n_vertices} vertices and {n_faces} faces announced, fewer there)")


def _with_absolute_indices(content: bytes, name: str) -> bytes:
    """Return an OBJ file whose faces count vertices from the first one.

    A negative index counts back from the face itself. The loader would count from the end of the file.
    """
    if not re.search(rb"^\s*f\s[^\n]*-", content, re.MULTILINE):
        return content
    seen = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = content.replace(b"\\\n", b" ").splitlines()
    for k, line in enumerate(lines):
        word, *rest = line.partition(b"#")[0].split() or [b""]
        if word in seen:
            seen[word] += 1
        elif word == b"f" and b"-" in line:
            corners = [_absolute(corner, list(seen.values()), f"{name}: line {k + 1}") for corner in rest]
            lines[k] = b" ".join([b"f", *corners])
    return b"\n".join(lines) + b"\n"


def _absolute(corner: bytes, counts: list[int], where: str) -> bytes:
    """Return a corner of a face, vertex/texture/normal, with each index counted from the first."""
    found = []
    for index, count in zip(corner.split(b"/"), counts, strict=False):
        if index.startswith(b"-") and index[1:].isdigit() and len(index) < 12:
            back = int(index)
            if count + back < 0 or back == 0:
                raise InputFileError(f"{where}: names vertex {back}, but only {count} come before it")
            index = b"%d" % (count + back + 1)
        found.append(index)
    return b"/".join(found)
