"""Plans, as TOML files or in code: frozen, validated, resolved to the last default. What every plan has, and banks."""

from __future__ import annotations

import difflib
import math
import os
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeVar

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PlainSerializer,
    SerializerFunctionWrapHandler,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WithJsonSchema,
    WrapValidator,
    model_serializer,
    model_validator,
)

from phasemark import PhasemarkError, UsageError
from phasemark.data.plans.grid_axis import drop_repeated_stop, format_grid, parse_grid
from phasemark.data.plans.landmark_region import landmark_region, whole_region
from phasemark.inputs.field_table import FieldTable
from phasemark.inputs.toml_file import read_toml
from phasemark.landmarks import LandmarkSpec, build_mesh, catalog, mesh_symmetry, read_mesh
from phasemark.landmarks.catalog import class_of_catalog
from phasemark.landmarks.mesh_files import MeshWarning
from phasemark.landmarks.symmetry import MAX_SYMMETRY
from phasemark.render import Sensor, preset
from phasemark.render.sensor.region import MOST_BINNING, Region
from phasemark.render.view import FARTHEST_M

MOST_LANDMARKS = 256
"""Of a plan: each takes one or two scenes of the intersector, which can hold some hundreds."""

_YOUNGER_FIELDS = {
    "lens", "histogram", "lamp_half_angle_deg", "lamp_profile", "bearing_offset_deg", "height_offset_m", "delay_s",
    "range_shot_std_m", "range_ambient_std_m", "zone_offset_m", "calibration_fields", "calibration_covariance",
    "systematic_distance_m", "systematic_delta_deg", "systematic_bearing_deg", "systematic_height_m",
    "systematic_time_s", "overdispersion", "recording_range_m", "recording_pitch_deg", "recording_roll_deg",
    "recording_bearing_deg",
}  # fmt: skip
"""Of a sensor: what resolved plans in older files lack, and mean 0 or none by."""

_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=100)]
_Albedo = Annotated[float, Field(gt=0, le=1)]
_Edge = Annotated[int, Field(ge=0, le=4096)]


def _to_grid(value: Any, info: ValidationInfo) -> tuple[float, ...]:
    return tuple(parse_grid(value, str(info.field_name)).tolist())


def _positive(values: tuple[float, ...], info: ValidationInfo) -> tuple[float, ...]:
    if values[0] <= 0:
        raise UsageError(f"'{info.field_name}' must be positive throughout, got {values[0]!r}")
    if values[-1] > FARTHEST_M:
        raise UsageError(f"'{info.field_name}' must be at most {FARTHEST_M:g} m throughout, got {values[-1]!r}")
    return values


def _named_or_edges(value: Any, checked: ValidatorFunctionWrapHandler) -> Any:
    try:
        return checked(value)
    except ValidationError:
        raise UsageError(
            "'region' must be whole, landmark or [first row, stop row, first column, stop column], got " + repr(value)
        ) from None


_GRID_SCHEMA = {
    "description": "a grid: START:STOP:STEP, V1,V2,…, one number, or a list of numbers",
    "anyOf": [{"type": "string"}, {"type": "number"}, {"type": "array", "items": {"type": "number"}}],
}
_Grid = Annotated[
    tuple[float, ...],
    BeforeValidator(_to_grid),
    PlainSerializer(format_grid, return_type=str),
    WithJsonSchema(_GRID_SCHEMA),
]


def without_nul(path: str, info: ValidationInfo) -> str:
    """Refuse a name of a file that cannot be one."""
    if "\0" in path:
        raise UsageError(f"'{info.field_name}' must be the name of a file, which holds no NUL, got {path!r}")
    return path


class PlanModel(FieldTable):
    """A frozen table of a plan; what is wrong with it is a UsageError of one line."""

    @classmethod
    def _refused(cls, error: ValidationError) -> UsageError:
        # a key that is misspelt is missing too: naming the misspelling helps more
        first = min(error.errors(), key=lambda found: found["type"] != "extra_forbidden")
        if first["type"] == "extra_forbidden" and len(first["loc"]) == 1:
            key, keys = str(first["loc"][0]), list(cls.model_fields)
            similar = difflib.get_close_matches(key, keys, n=1)
            hint = f"did you mean '{similar[0]}'?" if similar else f"there are {', '.join(keys)}"
            return UsageError(f"unknown key '{key}': {cls.place_of_key(key) or hint}")
        own = first.get("ctx", {}).get("error")
        if isinstance(own, UsageError):
            key = ".".join(map(str, first["loc"]))
            return own if f"'{key}'" in str(own) or not key else UsageError(f"{key}: {own}")
        return cls._refusal(first)

    @classmethod
    def place_of_key(cls, key: str) -> str | None:
        """Return where a key belongs that this table does not have, or None if nobody knows."""
        return None

    @classmethod
    def with_named_tables(cls, table: dict[str, Any], folder: Path) -> dict[str, Any]:
        """Return the content of a plan's file with the tables that it only names, read from files of its folder."""
        return table

    def in_folder(self, folder: Path) -> Self:
        """Return the plan of a file in a folder: names of files are relative to it."""
        return self


class SensorPlan(PlanModel):
    """A plan with the fields `sensor` and `sensor_overrides`, each in its own place among the others."""

    if TYPE_CHECKING:
        sensor: str
        sensor_overrides: dict[str, Any]

    def build_sensor(self) -> Sensor:
        """Return the sensor, overrides applied.

        Raises
        ------
        UsageError
            The preset is unknown, or a field or its value is wrong.
        InputFileError
            The sensor file cannot be read.
        """
        return sensor_of(self.sensor, self.sensor_overrides)


class MeshPlan(PlanModel):
    """A landmark from a mesh file.

    Parameters
    ----------
    name : str
        Name of its class: letters, digits, ``_``, ``-`` and ``.``.
    path : str
        STL, PLY, OBJ or OFF file; in a plan file relative to the plan's folder.
    unit : {"m", "cm", "mm", "inch"}
        Unit of the file's coordinates. Without it the mesh is refused when it is read, with its extents in each unit.
    up : {"z", "-z", "y", "-y", "x", "-x"}
        Axis of the file that points up.
    origin : {"file", "base", "center"}
        What becomes the origin: the file's own, the centre of the foot, or the centre of the bounding box.
    symmetry : int, optional
        How many turns about the vertical axis leave the landmark as it is. Without it, it is found from the mesh when
        the plan is resolved (:func:`phasemark.landmarks.mesh_symmetry`).
    albedo : float
        Share of light that the surface returns, in (0, 1].
    """

    name: _Name
    path: Annotated[str, AfterValidator(without_nul)]
    unit: Literal["m", "cm", "mm", "inch"] | None = None
    up: Literal["z", "-z", "y", "-y", "x", "-x"] = "z"
    origin: Literal["file", "base", "center"] = "file"
    symmetry: Annotated[int, Field(ge=1, le=MAX_SYMMETRY)] | None = None
    albedo: _Albedo = 0.8

    def read(self) -> trimesh.Trimesh:
        """Return the mesh of the file, metres, landmark frame.

        Raises
        ------
        InputFileError, UsageError
            As :func:`phasemark.landmarks.read_mesh`.
        """
        return read_mesh(self.path, unit=self.unit, up=self.up, origin=self.origin)


class ScenePlan(SensorPlan, ABC):
    """Landmarks and camera of a plan.

    Parameters
    ----------
    classes : sequence of str
        Names from the catalogue. Without classes, landmarks and meshes: the whole catalogue.
    landmarks : sequence of LandmarkSpec
        Further boxes with a solid of revolution, spelled out.
    meshes : sequence of MeshPlan
        Landmarks from mesh files.
    sensor : str
        A preset's name, or a sensor file (with a ``/`` or ending in ``.toml``).
    sensor_overrides : mapping
        Fields of the sensor that replace those of `sensor`.
    """

    classes: tuple[str, ...] = ()
    landmarks: tuple[LandmarkSpec, ...] = ()
    meshes: tuple[MeshPlan, ...] = ()
    sensor: str = "pmd-16x16"
    sensor_overrides: dict[str, Any] = Field(default_factory=dict)

    def in_folder(self, folder: Path) -> Self:
        """Return the plan of a file in a folder: names of mesh files and of a sensor file are relative to it."""
        meshes = tuple(mesh.model_copy(update={"path": str(folder / mesh.path)}) for mesh in self.meshes)
        return self.model_copy(update={"meshes": meshes, "sensor": sensor_in_folder(self.sensor, folder)})

    @abstractmethod
    def resolve(self) -> Self:
        """Return the plan with every default made explicit."""

    @abstractmethod
    def greatest_distances_m(self) -> dict[str, float]:
        """Return the greatest distance that each key of the plan asks for, metres."""

    def resolve_landmarks(self) -> tuple[list[LandmarkSpec], list[MeshPlan]]:
        """Return the landmarks, those of the catalogue spelled out, and those from mesh files.

        Raises
        ------
        UsageError
            A class is unknown, two landmarks have one name, or there are more than 256.
        """
        named = self.classes or (() if self.landmarks or self.meshes else tuple(catalog()))
        count = len(named) + len(self.landmarks) + len(self.meshes)
        if count > MOST_LANDMARKS:
            raise UsageError(f"a plan can have at most {MOST_LANDMARKS} landmarks, got {count}: make several of it")
        specs: list[LandmarkSpec] = [*map(class_of_catalog, named), *self.landmarks]
        names = [*(spec.name for spec in specs), *(mesh.name for mesh in self.meshes)]
        for name in names:
            if names.count(name) > 1 or name == "none":
                problem = "stands for no landmark" if name == "none" else "names two landmarks"
                raise UsageError(f"the class name {name!r} {problem}: give each landmark a name of its own")
        return specs, list(self.meshes)

    def _resolved(self, specs: Iterable[LandmarkSpec], meshes: Iterable[MeshPlan], sensor: Sensor, **own: Any) -> Self:
        """Return the plan with landmarks and sensor spelled out, and some of its own fields replaced."""
        shown = {"classes": (), "landmarks": tuple(specs), "meshes": tuple(meshes)}
        return self.model_copy(update={**shown, "sensor_overrides": sensor.model_dump(mode="json"), **own})


def find_symmetries(meshes: Sequence[MeshPlan]) -> list[MeshPlan]:
    """Return landmarks from mesh files, each with its symmetry: that stated, or else that of the mesh.

    A file that cannot be read stays without one: reading it for its images says what is wrong.
    """
    found = []
    for part in meshes:
        if part.symmetry is None:
            with suppress(PhasemarkError), warnings.catch_warnings():
                warnings.simplefilter("ignore", MeshWarning)  # reading it for its images warns once
                part = part.model_copy(update={"symmetry": mesh_symmetry(part.read())})
        found.append(part)
    return found


def common_symmetry(parts: Sequence[LandmarkSpec | MeshPlan]) -> int:
    """Return the largest symmetry that all landmarks have."""
    return math.gcd(*(part.symmetry or 1 for part in parts))


class BankPlan(ScenePlan):
    """A bank of model images (PHYSICS sections 5 and 7).

    Parameters
    ----------
    classes : sequence of str
        Names from the catalogue. Without classes, landmarks and meshes: the whole catalogue.
    landmarks : sequence of LandmarkSpec
        Further boxes with a solid of revolution, spelled out.
    meshes : sequence of MeshPlan
        Landmarks from mesh files.
    sensor : str
        A preset's name, or a sensor file (with a ``/`` or ending in ``.toml``).
    sensor_overrides : mapping
        Fields of the sensor that replace those of `sensor`.
    distance_m : str, number or sequence of numbers
        Grid of distances D, metres: ``START:STOP:STEP``, ``V1,V2,…``, one number or a list of numbers
        (:func:`phasemark.data.plans.parse_grid`).
    delta_deg : str, number or sequence of numbers, optional
        Grid of viewing angles δ, degrees, in the same form. A last δ that repeats the first by the landmarks' common
        symmetry is dropped. Without it: one period in steps of 1°.
    model : {"ray", "hard", "planar"}
        ``ray``: the exact integral. ``hard``: the centre ray of each pixel alone, so that no ranges mix. ``planar``:
        the paper's own generator in two dimensions.
    layout : {"factored", "full"}
        ``factored``: images of lower and upper parts are stored separately and combined, which saves memory as in the
        paper. ``full``: one image for each class, distance and angle.
    albedo : float, optional
        Share of light that the landmarks return, in place of their own.
    harmonics : sequence of int
        Orders k > 1 of harmonics that are stored beside the fundamental.
    region : "whole", "landmark" or (first row, stop row, first column, stop column)
        Which pixels of the camera the images hold. ``landmark``: those that a landmark of the bank can reach, and a
        margin. Four numbers: first row, stop row, first column, stop column. Frames of the whole camera are cut down
        to the same pixels when they are matched.
    binning : int
        n: blocks of n × n pixels become one pixel, whose phasor is their sum. The region holds whole blocks.
    margin_deg : float
        With ``region = "landmark"``: how far the landmark may be off its place in the image to every side, degrees.

    Raises
    ------
    UsageError
        With one line that names the key, its value and what would be right.

    Examples
    --------
    >>> BankPlan(classes=["cone"], distance_m="0.8:1.2:0.2").distance_m
    (0.8, 1.0, 1.2)
    """

    distance_m: Annotated[_Grid, AfterValidator(_positive)] = Field(default="0.7:2.1:0.01", validate_default=True)
    delta_deg: _Grid | None = None
    model: Literal["ray", "hard", "planar"] = "ray"
    layout: Literal["factored", "full"] = "factored"
    albedo: _Albedo | None = None
    harmonics: tuple[Annotated[int, Field(ge=2, le=99)], ...] = ()
    region: Annotated[
        Literal["whole", "landmark"] | tuple[_Edge, _Edge, _Edge, _Edge], WrapValidator(_named_or_edges)
    ] = "whole"
    binning: Annotated[int, Field(ge=1, le=MOST_BINNING)] = 1
    margin_deg: Annotated[float, Field(ge=0, le=45)] = 5.0

    @model_serializer(mode="wrap")
    def _without_whole_region(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit a region that is the whole image, so that these plans read as before plans had regions."""
        fields: dict[str, Any] = dump(self)
        if self.region == "whole" and self.binning == 1:
            for name in ("region", "binning", "margin_deg"):
                fields.pop(name, None)
        return fields

    @model_validator(mode="after")
    def _orders_increase(self) -> Self:
        if list(self.harmonics) != sorted(set(self.harmonics)):
            raise UsageError(f"'harmonics' must increase from order to order, got {list(self.harmonics)}")
        return self

    def resolve(self) -> Self:
        """Return the plan with every default made explicit: landmarks, the sensor's fields, both grids, albedo.

        Resolving again changes nothing, and the result no longer depends on the catalogue or the presets.

        Raises
        ------
        UsageError
            A class or sensor is unknown, or two landmarks have one name.
        InputFileError
            The sensor file cannot be read.
        """
        specs, meshes = self.resolve_landmarks()
        if self.albedo is not None:
            specs = [spec.model_copy(update={"albedo": self.albedo}) for spec in specs]
            meshes = [mesh.model_copy(update={"albedo": self.albedo}) for mesh in meshes]
        meshes = find_symmetries(meshes)
        period_deg = 360 / common_symmetry([*specs, *meshes])
        delta_deg = parse_grid(self.delta_deg or f"0:{period_deg!r}:1", "delta_deg")
        return self._resolved(
            specs, meshes, self.build_sensor(), albedo=None, region=self._resolved_region(specs, meshes),
            delta_deg=tuple(drop_repeated_stop(delta_deg, period_deg).tolist()),
        )  # fmt: skip

    def _resolved_region(
        self, specs: Sequence[LandmarkSpec], meshes: Sequence[MeshPlan]
    ) -> Literal["whole"] | tuple[int, int, int, int]:
        """Return the region as four numbers, or "whole" where every pixel is its own."""
        if self.region == "whole" and self.binning == 1:
            return "whole"
        sensor = self.build_sensor()
        if self.region == "whole":
            region = whole_region(sensor, self.binning)
        elif self.region == "landmark":
            shapes = [*map(build_mesh, specs), *(part.read() for part in meshes)]
            region = landmark_region(sensor, shapes, self.distance_m, self.binning, math.radians(self.margin_deg))
        else:
            region = Region(*self.region, self.binning)
        region.check(sensor)
        return region[:4]

    def pixel_region(self) -> Region | None:
        """Return which pixels of the camera the images of a resolved plan hold; None: every one."""
        return None if isinstance(self.region, str) else Region(*self.region, self.binning)

    def image_sensor(self) -> Sensor:
        """Return the camera that sees the images of a resolved plan: the sensor, read in its region."""
        sensor, region = self.build_sensor(), self.pixel_region()
        return sensor if region is None else region.camera(sensor)

    def greatest_distances_m(self) -> dict[str, float]:
        """Return the end of the grid of distances, metres."""
        return {"distance_m": self.distance_m[-1]}

    @property
    def delta_rad(self) -> NDArray[np.float64]:
        """The grid of angles of a resolved plan, radians."""
        if self.delta_deg is None:
            raise UsageError("'delta_deg' follows from the landmarks' symmetry: resolve the plan first")
        return np.deg2rad(self.delta_deg)


P = TypeVar("P", bound=PlanModel)


def read_bank_plan(path: str | os.PathLike[str]) -> BankPlan:
    """Read a bank's plan from a TOML file; files it names are relative to its folder.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    BankPlan

    Raises
    ------
    InputFileError
        The file cannot be read or is not TOML.
    UsageError
        With one line that names the file, the key, the value and what would be right.
    """
    return read_plan(path, BankPlan)


def read_plan(path: str | os.PathLike[str], model: type[P]) -> P:
    """Read a plan of any kind from a TOML file; files it names are relative to its folder.

    Parameters
    ----------
    path : path-like
        The file.
    model : type
        :class:`BankPlan`, :class:`phasemark.data.FramePlan` or the class of another plan.

    Returns
    -------
    PlanModel
        Of the type `model`.

    Raises
    ------
    InputFileError
        The file cannot be read or is not TOML.
    UsageError
        With one line that names the file, the key, the value and what would be right.
    """
    path = Path(path)
    return plan_of_table(read_toml(path), path, model)


def plan_of_table(table: dict[str, Any], path: Path, model: type[P]) -> P:
    """Return the plan of a TOML file whose content was read; see :func:`read_plan`."""
    table = model.with_named_tables(table, path.parent)
    try:
        return model(**table).in_folder(path.parent)
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None


def sensor_of(name_or_file: str, overrides: dict[str, Any]) -> Sensor:
    """Return the sensor of a plan, overrides applied; a resolved plan states all fields, and needs no preset or file.

    Raises
    ------
    UsageError
        The preset is unknown, or a field or its value is wrong.
    InputFileError
        The sensor file cannot be read.
    """
    if set(overrides) | _YOUNGER_FIELDS >= set(Sensor.model_fields):
        return Sensor(**overrides)
    base = Sensor.from_toml(name_or_file) if _is_file(name_or_file) else preset(name_or_file)
    try:
        return base.with_(**overrides)
    except UsageError as error:
        raise UsageError(f"'sensor_overrides': {error}") from None


def sensor_in_folder(sensor: str, folder: Path) -> str:
    """Return the sensor of a plan: a preset's name, or a file, whose name is relative to the plan's folder."""
    return str(folder / sensor) if _is_file(sensor) else sensor


def _is_file(sensor: str) -> bool:
    return sensor.endswith(".toml") or "/" in sensor


def factored_refusal(plan: BankPlan) -> str | None:
    """Return why a resolved plan cannot have a factored bank, or None.

    Lower and upper images come apart if every landmark is a solid of revolution on one and the same box, and the plane
    between them falls on the image's middle line at every distance: a level camera at the interface's height.
    """
    sensor = plan.image_sensor()
    if plan.meshes:
        return f"'{plan.meshes[0].name}' comes from a mesh file"
    bare = next((spec.name for spec in plan.landmarks if spec.upper is None), None)
    if bare is not None:
        return f"'{bare}' has no upper part"
    boxes = {(spec.box, spec.albedo): spec.name for spec in plan.landmarks}
    if len(boxes) > 1:
        return f"'{plan.landmarks[0].name}' and '{list(boxes.values())[1]}' stand on different boxes"
    if sensor.pitch_deg or sensor.roll_deg:
        return f"the sensor is tilted (pitch {sensor.pitch_deg:g}°, roll {sensor.roll_deg:g}°)"
    if sensor.height_offset_m:
        return f"the sensor is not mounted at the interface's height (height offset {sensor.height_offset_m:g} m)"
    if sensor.rows % 2:
        return f"the sensor has an odd number of rows ({sensor.rows})"
    if sensor.centre_px[1] != sensor.rows / 2:
        return f"the optical axis meets the image at row {sensor.centre_px[1]:g}, not in the middle"
    if sensor.lens is not None and sensor.lens.bends_middle_row:
        return "the lens bends the image's middle line (its coefficient p1 is not 0)"
    return None
