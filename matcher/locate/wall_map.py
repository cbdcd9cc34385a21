"""Maps of walls, boxes, meshes and landmarks in TOML, and their outline at the height of the sensors."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator
from trimesh.intersections import mesh_plane

from phasemark import InputFileError, UsageError
from phasemark.data.plans.bank_plan import PlanModel, plan_of_table
from phasemark.inputs.toml_file import read_toml, toml_text
from phasemark.landmarks import build_mesh, catalog, read_mesh
from phasemark.matcher.locate.kernel_arguments import Outline
from phasemark.matcher.locate.plane import turn_of
from phasemark.render import Body, Scene

_Float = NDArray[np.float64]
_Number = Annotated[float, Field(allow_inf_nan=False)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Size = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_TOUCH_M = 1e-3
"""Walls that meet within this touch and do not cross."""
_TALLEST_M = 20.0
"""Of a wall in a scene, above and below the sensors: far beyond their reach, and near enough for single precision."""
_FLOOR_M = 40.0
"""By how much a floor extends beyond the walls."""


class Wall(PlanModel):
    """A straight vertical wall.

    Parameters
    ----------
    from_m, to_m : (x, y)
        Ends of its centre line, metres. The keys of a file are ``from`` and ``to``.
    thickness_m, height_m, base_m : float
        It stands on `base_m`. A wall without thickness has no ends.
    std_m : float
        Standard deviation of its displacement along its normal, for a calibration.
    albedo : float, optional
        Documents the wall; ranges do not depend on it.
    name : str
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_by_name=True, validate_by_alias=True)

    from_m: Annotated[tuple[_Number, _Number], Field(alias="from")]
    to_m: Annotated[tuple[_Number, _Number], Field(alias="to")]
    thickness_m: _Size = 0.0
    height_m: _Positive = 1e3
    base_m: _Number = 0.0
    std_m: _Size = 0.0
    albedo: Annotated[float, Field(gt=0, le=1)] | None = None
    name: str = ""

    @property
    def ends_m(self) -> _Float:
        """Ends x, y, x, y, (4,)."""
        return np.array([*self.from_m, *self.to_m])

    @property
    def normal(self) -> _Float:
        """Direction to the left of its way from end to end, (2,)."""
        x, y = self.ends_m[2:] - self.ends_m[:2]
        return np.array([-y, x]) / math.hypot(x, y)

    def outline(self) -> _Float:
        """Return its faces, (1 or 4, 4); a thick wall extends by half its thickness, so that corners are closed."""
        ends, half = self.ends_m, self.thickness_m / 2
        if not half:
            return ends[None]
        across = half * self.normal
        along = np.array([across[1], -across[0]])
        return _polygon([ends[:2] - along - across, ends[2:] + along - across,
                         ends[2:] + along + across, ends[:2] - along + across])  # fmt: skip

    def body(self, height_m: float) -> Body:
        """Return it as a body of a scene whose sensors are at a height, open at its top if it is thin."""
        low = max(self.base_m, height_m - _TALLEST_M)
        high = max(min(self.base_m + self.height_m, height_m + _TALLEST_M), low + _TOUCH_M)
        (ax, ay), (bx, by) = self.from_m, self.to_m
        pose = _level_pose((ax + bx) / 2, (ay + by) / 2, (low + high) / 2, math.atan2(by - ay, bx - ax))
        length = math.dist(self.from_m, self.to_m)
        if self.thickness_m:
            return Body.box((length + self.thickness_m, self.thickness_m, high - low), pose=pose)
        upright = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
        return Body.plane((length, high - low), pose=pose @ upright)


def _level_pose(x_m: float, y_m: float, z_m: float, yaw_rad: float) -> _Float:
    """Return the rigid transform of a body at a place, with a heading, (4, 4)."""
    pose = np.eye(4)
    pose[:2, :2] = turn_of(yaw_rad)[:2, :2]
    pose[:3, 3] = x_m, y_m, z_m
    return pose


class _Placed(PlanModel):
    """A body at a place of the map: x, y of its origin, the height of its base, and the heading of its x axis."""

    x_m: _Number
    y_m: _Number
    z_m: _Number = 0.0
    yaw_deg: _Number = 0.0

    def _pose(self, above_m: float = 0.0) -> _Float:
        """Return the transform of a point of its own axis, above its base, (4, 4)."""
        return _level_pose(self.x_m, self.y_m, self.z_m + above_m, math.radians(self.yaw_deg))

    def _placed(self, segments: _Float) -> _Float:
        """Return segments (m, 4) of the body's frame in that of the map."""
        pose = self._pose()
        return np.asarray((segments.reshape(-1, 2, 2) @ pose[:2, :2].T + pose[:2, 3]).reshape(-1, 4))


class Box(_Placed):
    """A box: `size_m` is its length, width and height, its origin the middle of its base."""

    size_m: tuple[_Positive, _Positive, _Positive]

    def outline(self, height_m: float) -> _Float:
        """Return its outline at a height, (m, 4)."""
        if not self.z_m <= height_m <= self.z_m + self.size_m[2]:
            return np.empty((0, 4))
        x, y = self.size_m[0] / 2, self.size_m[1] / 2
        return self._placed(_polygon([[-x, -y], [x, -y], [x, y], [-x, y]]))

    def body(self) -> Body:
        """Return it as a body of a scene."""
        return Body.box(self.size_m, pose=self._pose(self.size_m[2] / 2))


class MeshBody(_Placed):
    """A mesh from a file."""

    file: str
    unit: Literal["m", "cm", "mm"] = "m"

    def outline(self, height_m: float) -> _Float:
        """Return its section at a height, (m, 4)."""
        return self._placed(_section(read_mesh(self.file, unit=self.unit), height_m - self.z_m))

    def body(self) -> Body:
        """Return it as a body of a scene."""
        return Body(read_mesh(self.file, unit=self.unit), pose=self._pose())


class LandmarkBody(_Placed):
    """A landmark of the catalogue; the key of a file is ``class``."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_by_name=True, validate_by_alias=True)

    class_name: Annotated[str, Field(alias="class")]

    def outline(self, height_m: float) -> _Float:
        """Return its section at a height above its base, (m, 4)."""
        mesh = self._mesh()
        return self._placed(_section(mesh, height_m - self.z_m + float(mesh.bounds[0, 2])))

    def body(self) -> Body:
        """Return it as a body of a scene."""
        mesh = self._mesh()
        return Body(mesh, pose=self._pose(-float(mesh.bounds[0, 2])))

    def _mesh(self) -> Any:
        if self.class_name not in catalog():
            raise UsageError(f"'class' must be one of {', '.join(catalog())}, got {self.class_name!r}")
        return build_mesh(catalog()[self.class_name])


class WallMap(PlanModel):
    """Map that a robot stands in.

    Parameters
    ----------
    wall : sequence of Wall
    walls_m : sequence of (x, y, x, y)
        Further walls, all of `thickness_m`.
    box, mesh, landmark : sequences of Box, MeshBody, LandmarkBody
        Bodies, taken for prisms of their outline at the height of the sensors.
    height_m : float
        Height of the robot's frame, and of its sensors, above the map's zero.
    floor_m : float
        Height of the floor, which zones may see where height, pitch and roll are estimated.
    thickness_m, std_m : float
        Of `walls_m`.
    position_std_m, yaw_std_deg : float
        Part of every pose's error that the map has, one standard deviation of x, y and yaw.
    frame : str
        Name of the frame of coordinates.

    Examples
    --------
    >>> WallMap(walls_m=[[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0]]).outline().bounds_m
    (0.0, 0.0, 4.0, 3.0)
    """

    wall: tuple[Wall, ...] = ()
    walls_m: tuple[tuple[_Number, _Number, _Number, _Number], ...] = ()
    box: tuple[Box, ...] = ()
    mesh: tuple[MeshBody, ...] = ()
    landmark: tuple[LandmarkBody, ...] = ()
    height_m: _Number = 0.5
    floor_m: _Number = 0.0
    thickness_m: _Size = 0.0
    std_m: _Size = 0.0
    position_std_m: _Size = 0.0
    yaw_std_deg: _Size = 0.0
    frame: str = ""

    @model_validator(mode="after")
    def _is_a_map(self) -> Self:
        if not len(self.wall) + len(self.walls_m) + len(self.box) + len(self.mesh) + len(self.landmark):
            raise UsageError("'wall' must name at least one wall, or 'box', 'mesh' or 'landmark' a body")
        walls = self.walls
        ends = np.array([one.ends_m for one in walls]).reshape(-1, 4)
        for k, one in enumerate(walls):
            if math.dist(one.from_m, one.to_m) < _TOUCH_M:
                raise UsageError(
                    f"'{self._key(k)}' must be longer than {1e3 * _TOUCH_M:g} mm, got {one.ends_m.tolist()}"
                )
            if len(crossed := _crossed(ends[k], ends[:k])):
                j = int(crossed[0])
                raise UsageError(
                    f"'{self._key(k)}' must not cross '{self._key(j)}': cut walls where they meet,"
                    f" got {ends[k].tolist()} and {ends[j].tolist()}"
                )
        return self

    def _key(self, k: int) -> str:
        """Return the key of a wall by its place in :attr:`walls`."""
        return f"wall.{k}" if k < len(self.wall) else f"walls_m.{k - len(self.wall)}"

    @property
    def walls(self) -> tuple[Wall, ...]:
        """All walls, in the order `wall`, `walls_m`."""
        short = (
            Wall(from_m=ends[:2], to_m=ends[2:], thickness_m=self.thickness_m, std_m=self.std_m)
            for ends in self.walls_m
        )
        return (*self.wall, *short)

    @property
    def _bodies(self) -> tuple[Box | MeshBody | LandmarkBody, ...]:
        return (*self.box, *self.mesh, *self.landmark)

    @property
    def part(self) -> _Float:
        """Covariance of the part of the error that the map has, (3, 3): m², rad²."""
        return np.diag(np.square([self.position_std_m, self.position_std_m, math.radians(self.yaw_std_deg)]))

    def in_folder(self, folder: Path) -> Self:
        """Return the map of a file in a folder: names of meshes are relative to it."""
        meshes = tuple(one.model_copy(update={"file": str(folder / one.file)}) for one in self.mesh)
        return self.model_copy(update={"mesh": meshes})

    def outline(self, above_m: float = 0.0) -> Outline:
        """Return the faces that sensors see.

        Parameters
        ----------
        above_m : float
            Of the sensors above the robot's height.

        Raises
        ------
        UsageError
            Nothing of the map is as high as the sensors.
        """
        walls, bodies, height = self.walls, self._bodies, self.height_m + above_m
        seen = [wall.base_m <= height <= wall.base_m + wall.height_m for wall in walls]
        groups = [wall.outline() if high else np.empty((0, 4)) for wall, high in zip(walls, seen, strict=True)]
        groups += [body.outline(height) for body in bodies]
        normals = [*(wall.normal for wall in walls), *(np.zeros(2) for _ in bodies)]
        stds = [*(wall.std_m for wall in walls), *(0.0 for _ in bodies)]
        pieces = np.concatenate(groups)
        if not len(pieces):
            raise UsageError(f"'height_m' must be a height at which the map has walls or bodies, got {height:g}")
        owner = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
        pieces, of = cut_at_crossings(pieces)
        return Outline(pieces, owner[of], np.array(normals), np.array(stds))

    def scene(self) -> Scene:
        """Return walls, bodies and the floor as a scene."""
        bodies = [*(wall.body(self.height_m) for wall in self.walls), *(one.body() for one in self._bodies)]
        low_x, low_y, high_x, high_y = self.outline().bounds_m
        middle = _level_pose((low_x + high_x) / 2, (low_y + high_y) / 2, self.floor_m, 0.0)
        return Scene([*bodies, Body.plane((high_x - low_x + _FLOOR_M, high_y - low_y + _FLOOR_M), pose=middle)])

    def with_walls_moved(self, displacement_m: _Float) -> Self:
        """Return the map with each wall displaced along its normal, (walls,) m."""
        moved = []
        for wall, by in zip(self.walls, displacement_m, strict=True):
            ends = wall.ends_m + by * np.tile(wall.normal, 2)
            moved.append(wall.model_copy(update={"from_m": tuple(ends[:2].tolist()), "to_m": tuple(ends[2:].tolist())}))
        return self.model_copy(update={"wall": tuple(moved), "walls_m": ()})

    def to_toml(self) -> str:
        """Return the map as the text of a file."""
        return toml_text(self.model_dump(mode="json", by_alias=True, exclude_none=True, exclude_defaults=True))


def map_of_run(
    path: str | os.PathLike[str], recorded: str | None, run: str | None, asked: str | None = None
) -> str | None:
    """Return the name of a map in a file: the one asked for, the recording's, or that of ``runs.RUN``; None without.

    Raises
    ------
    UsageError
        A name is asked for, and the file holds one map alone.
    """
    table = read_toml(Path(path))
    if asked is not None and "maps" not in table:
        raise UsageError(f"{path}: holds one map alone, without a name, and none of [maps.{asked}]")
    name, runs = asked or recorded, table.get("runs")
    return runs.get(run) if name is None and isinstance(runs, dict) else name


def read_wall_map(path: str | os.PathLike[str], name: str | None = None) -> WallMap:
    """Read a map from a TOML file.

    Parameters
    ----------
    path : path-like
        A map, or several as tables ``[maps.NAME]``.
    name : str, optional
        Which of several: its name, or that of a run for which ``runs.RUN`` names the map. May be left out if there is
        one.

    Returns
    -------
    WallMap

    Raises
    ------
    InputFileError
        The file cannot be read, is not TOML, or has no map of that name.
    UsageError
        With one line that names the file, the key, the value and what would be right.
    """
    path = Path(path)
    table = read_toml(path)
    if "maps" not in table:
        return plan_of_table(table, path, WallMap)
    maps: Any = table["maps"]
    unknown = [key for key in table if key not in ("maps", "runs")]
    if unknown or not isinstance(maps, dict) or not isinstance(table.get("runs", {}), dict):
        raise UsageError(f"{path}: must hold tables [maps.NAME] and runs.RUN = NAME alone, got {', '.join(table)}")
    chosen = table.get("runs", {}).get(name, name)
    if chosen is None and len(maps) == 1:
        chosen = next(iter(maps))
    if chosen not in maps:
        wanted = "a name is needed" if chosen is None else f"no map '{chosen}'"
        raise InputFileError(f"{path}: {wanted}, must be one of {', '.join(maps)}")
    try:
        return plan_of_table(maps[chosen], path, WallMap)
    except UsageError as error:
        raise UsageError(f"{path}: maps.{chosen}: {str(error).removeprefix(f'{path}: ')}") from None


def _polygon(corners: Any) -> _Float:
    """Return the sides of a closed polygon, (m, 4)."""
    points = np.asarray(corners, dtype=np.float64)
    return np.hstack([points, np.roll(points, -1, axis=0)])


def _section(mesh: Any, height_m: float) -> _Float:
    """Return the section of a mesh with a horizontal plane, (m, 4)."""
    lines: Any = mesh_plane(  # type: ignore[no-untyped-call]
        mesh, plane_normal=[0.0, 0.0, 1.0], plane_origin=[0.0, 0.0, height_m]
    )
    return np.asarray(lines, np.float64).reshape(-1, 2, 3)[:, :, :2].reshape(-1, 4)


def _crossings(piece: _Float, others: _Float) -> tuple[_Float, _Float]:
    """Return where a segment meets the lines of others, as shares of its own length and of theirs, (m,) each."""
    along, to = piece[2:] - piece[:2], others[:, 2:] - others[:, :2]
    across = along[0] * to[:, 1] - along[1] * to[:, 0]
    start = others[:, :2] - piece[:2]
    with np.errstate(divide="ignore", invalid="ignore"):
        own = (start[:, 0] * to[:, 1] - start[:, 1] * to[:, 0]) / across
        theirs = (start[:, 0] * along[1] - start[:, 1] * along[0]) / across
    parallel = np.abs(across) < 1e-9 * np.hypot(*along) * np.hypot(*to.T)
    return np.where(parallel, np.nan, own), np.where(parallel, np.nan, theirs)


def _crossed(one: _Float, others: _Float) -> NDArray[np.int64]:
    """Return which segments another crosses at a point that is no end of either."""
    own, theirs = _crossings(one, others)
    a, b = (_TOUCH_M / np.hypot(*(ends[..., 2:] - ends[..., :2]).T) for ends in (one, others))
    return np.flatnonzero((a < own) & (own < 1 - a) & (b < theirs) & (theirs < 1 - b))


def cut_at_crossings(pieces: _Float) -> tuple[_Float, NDArray[np.int64]]:
    """Cut segments where they meet others.

    Parameters
    ----------
    pieces : (k, 4) float64
        Ends x, y, x, y.

    Returns
    -------
    parts : (m, 4) float64
    of : (m,) int64
        Which segment each part is of.
    """
    parts, of = [], []
    for k, piece in enumerate(pieces):
        own, theirs = _crossings(piece, pieces)
        met = own[(own > 1e-9) & (own < 1 - 1e-9) & (theirs > -1e-9) & (theirs < 1 + 1e-9)]
        shares = np.unique(np.round(np.concatenate([[0.0], met, [1.0]]), 9))
        points = piece[:2] + shares[:, None] * (piece[2:] - piece[:2])
        parts.append(np.hstack([points[:-1], points[1:]]))
        of += [k] * (len(shares) - 1)
    return np.concatenate(parts), np.array(of)
