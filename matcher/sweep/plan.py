"""Plan of a sweep: axes of the world, a design over them, and the methods that are judged on the same frames."""

from __future__ import annotations

import itertools
import json
import math
import os
from collections.abc import Collection
from dataclasses import dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, WithJsonSchema, model_validator

from phasemark import InputFileError, UsageError
from phasemark.data import BankPlan
from phasemark.data.plans.bank_plan import MeshPlan, PlanModel, ScenePlan, common_symmetry, factored_refusal, read_plan
from phasemark.data.plans.grid_axis import parse_grid
from phasemark.data.seeds import stream
from phasemark.inputs import MOST_TOML_BYTES, read_text
from phasemark.landmarks import LandmarkSpec
from phasemark.matcher.likelihood.images import LEVEL_VIEW, VIEW
from phasemark.render import Background

_MOST_CELLS = 100_000
SHIPPED_SWEEPS = ("paper", "distance-angle-noise", "robustness", "multipath", "demo")
"""Names of the plans that come with the program."""


@dataclass(frozen=True)
class Condition:
    """One point of the design: the world as it is, whatever a method takes it to be.

    Parameters
    ----------
    class_name : str
        Class of the landmark, or name of the stranger.
    distance_m : float
        Distance D of the middle of the true views, metres.
    delta_deg : float
        Viewing angle δ of the middle of the true views, degrees.
    noise_factor : float
        Standard deviation of a range, relative to the sensor's: all electrons are divided by its square, read noise by
        itself.
    n_frames : int
        Number of frames that are averaged.
    bearing_deg : float
        True bearing of the landmark, degrees.
    height_m : float
        True height of the landmark's origin above the lens, metres.
    pitch_deg, roll_deg : float
        True tilt of the camera's mount, degrees.
    albedo : float
        The landmark's true albedo; that of its plan where it is no axis.
    wall_m : float
        Distance of a wall behind the landmark, metres; 0: no wall.
    wiggling : float
        Size of the correlation's harmonics: 0 none, 1 those of a square wave against a square wave up to the seventh.
    unit : int
        Number of the camera unit, which has a phase offset in each pixel of its own; 0: a camera without offsets.
    dimension_error : float
        Relative excess of the true landmark's dimensions over the model's.
    floor_m : float
        How far a floor lies below the lens, metres; 0: no floor.
    bounces : int
        How often light bounces between landmark, wall and floor (PHYSICS section 12); unless 0, the sensor has to state
        `lamp_half_angle_deg`.
    """

    class_name: str
    distance_m: float = 1.0
    delta_deg: float = 30.0
    noise_factor: float = 1.0
    n_frames: int = 50
    bearing_deg: float = 0.0
    height_m: float = 0.0
    pitch_deg: float = 0.0
    albedo: float = 0.8
    wall_m: float = 0.0
    wiggling: float = 0.0
    unit: int = 0
    dimension_error: float = 0.0
    roll_deg: float = 0.0
    floor_m: float = 0.0
    bounces: int = 0

    def background(self, *, bounces: bool = True) -> Background | None:
        """Return wall and floor behind the landmark, with light that bounces or without; None: there is neither."""
        if not (self.wall_m or self.floor_m):
            return None
        return Background(self.wall_m or None, self.floor_m or None, bounces=self.bounces if bounces else 0)


AXES = tuple(field.name for field in fields(Condition))
"""Names of a condition's fields, each of which may be an axis."""
MODEL_ERRORS = ("bearing_deg", "height_m", "pitch_deg", "roll_deg", "wiggling", "unit", "dimension_error", "bounces")
"""Axes on which the world differs from what a method takes it to be, unless they are 0."""
_WHOLE = ("n_frames", "unit", "bounces")
_LIMITS: dict[str, tuple[float, float]] = {
    "distance_m": (1e-3, 1e3), "noise_factor": (1e-3, 1e3), "n_frames": (1, 100_000), "bearing_deg": (-45, 45),
    "height_m": (-10, 10), "pitch_deg": (-45, 45), "roll_deg": (-45, 45), "albedo": (1e-3, 1), "wall_m": (0, 1e3),
    "wiggling": (0, 1), "unit": (0, 2**62), "dimension_error": (-0.5, 0.5), "delta_deg": (-360, 360),
    "floor_m": (0, 1e3), "bounces": (0, 100),
}  # fmt: skip


def _axis_schema(name: str) -> dict[str, Any]:
    """Return the JSON Schema of an axis: its values, whole numbers or not, within its limits."""
    low, high = _LIMITS[name]
    value = {"type": "integer" if name in _WHOLE else "number", "minimum": low, "maximum": high}
    return {"anyOf": [{"type": "string"}, value, {"type": "array", "items": value, "minItems": 1}]}


def _axis(value: Any) -> Any:
    return tuple(parse_grid(value, "axis").tolist()) if isinstance(value, str | int | float) else value


_Axis = Annotated[tuple[float, ...], BeforeValidator(_axis), Field(min_length=1)]
AXES_SCHEMA = {
    "type": "object",
    "description": "Axis to its values: START:STOP:STEP, V1,V2,…, a number or a list",
    "additionalProperties": False,
    "properties": {name: _axis_schema(name) for name in AXES[1:]},
}


def _place_of_axis(key: str) -> str | None:
    return f"it is an axis and belongs under [axes], as axes.{key}" if key in AXES[1:] else None


class Method(PlanModel):
    """Method that turns frames into views.

    Parameters
    ----------
    name : str
        Name in tables and figures.
    method : str
        ``nearest``: the nearest image of the bank. ``refine``: maximum likelihood. ``module:name``: a Python function
        from filtered frames to a sequence of matches.
    filter : {"kalman", "phasor-mean"}
        How the frames of one measurement become one image: a Kalman filter of each pixel's range, or the mean phasor.
    on : {"ranges", "phasors", "reported"}, optional
        Quantity that ``refine`` explains. Phasors take frames without a validity threshold. Unless stated: ranges, or
        of a sensor with a [histogram] table the ranges that its chip reports, among unknown things whatever `knows`
        says.
    pixels : {"all", "lower"}
        Which pixels ``refine`` compares: all, or the lower half of the rows.
    free : sequence of {"bearing", "height", "pitch", "roll"}
        What is estimated beside distance and angle.
    knows : {"wall", "bounces", "auto", "nothing"}
        Background that the method assumes: the true wall and floor in direct light alone, the same with the light that
        bounces between them and the landmark, one estimated from the frames, or none.
    bank_model : {"ray", "hard", "planar"}
        `model` of the method's bank; ``hard`` and ``planar`` have no mixed pixels and go with ``nearest`` only.
    bank_step : (metres, degrees)
        Spacing of the bank's grid in distance and angle.
    false_alarm : float
        Probability with which a frame that the model explains is refused.
    """

    name: Annotated[str, Field(min_length=1, max_length=60)]
    method: Annotated[str, Field(pattern=r"^(nearest|refine|[A-Za-z_][\w.]*:[A-Za-z_]\w*)$")] = "refine"
    filter: Literal["kalman", "phasor-mean"] = "kalman"
    on: Literal["ranges", "phasors", "reported"] | None = None
    pixels: Literal["all", "lower"] = "all"
    free: tuple[Literal["bearing", "height", "pitch", "roll"], ...] = ()
    knows: Literal["wall", "bounces", "auto", "nothing"] = "wall"
    bank_model: Literal["ray", "hard", "planar"] = "ray"
    bank_step: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]] = (0.01, 1.0)
    false_alarm: Annotated[float, Field(gt=0, lt=1)] = 0.01

    @classmethod
    def place_of_key(cls, key: str) -> str | None:
        """Return where a key belongs that is not one of a method."""
        return (
            "it belongs to the plan itself, above [[methods]]" if key in SweepPlan.model_fields else _place_of_axis(key)
        )

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.method == "refine" and self.bank_model != "ray":
            raise UsageError(f"methods: '{self.name}' refines, which needs 'bank_model' ray, got {self.bank_model}")
        if self.method == "nearest" and (self.free or self.on not in (None, "ranges") or self.pixels != "all"):
            raise UsageError(
                f"methods: 'free', 'on' and 'pixels' belong to method refine, but '{self.name}' is nearest"
            )
        if self.method == "nearest" and self.knows == "auto":
            raise UsageError(f"methods: '{self.name}' is nearest, and cannot estimate a background")
        return self

    @property
    def is_program(self) -> bool:
        """Whether the method is a callable of the user's, ``module:name``: running it runs a program."""
        return ":" in self.method

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of what is estimated, as :class:`phasemark.matcher.Matcher` has them."""
        names = {name.split("_")[0]: name for name in VIEW}
        return (*VIEW[:2], *(names[k] for k in self.free))


class SweepPlan(ScenePlan):
    """A sweep.

    Parameters
    ----------
    name : str
        Name of the sweep, in its report and its files.
    question : str
        Question that the sweep answers: the heading of its report.
    seed : int
        Root of all random numbers.
    trials : int
        Number of trials of each condition; with `until_percent` of each round.
    until_percent : float, optional
        Repeat rounds of trials of a condition until every method's RMSE is known to ± this percentage, or `max_trials`
        is reached.
    max_trials : int, optional
        Largest number of trials of a condition; 20 · `trials` if left out.
    design : {"grid", "star", "sobol"}
        Conditions that are run. ``grid``: every combination of the axes' values. ``star``: each axis alone, the others
        at their first value. ``sobol``: `points` points of a scrambled Sobol sequence, uniform between an axis's least
        and largest value.
    points : int
        Number of conditions of the design ``sobol``.
    axes : mapping
        Values of each axis: a list, a number, or ``START:STOP:STEP``. The names are those of :class:`Condition`.
    spread : (metres, degrees)
        Size of a box about a condition's distance and angle, in which the true views are uniform, off any grid.
    methods : sequence of Method
        Methods that are compared on the same frames.
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
    strangers : sequence of LandmarkSpec
        Objects that stand in no bank, seen under the same conditions: the right answer is that there is no landmark.
    stranger_trials : int
        Largest number of trials of each stranger under each condition.
    bank_distance_m : (low, high)
        Distances that the banks cover, metres.
    fixed_pattern_rad : float
        Standard deviation of a camera unit's phase offsets, radians.
    outlier : (metres, degrees)
        Limits of an error: beyond either, and beyond 5 σ of the bound, it is an outlier, which is counted by itself
        and left out of bias and RMSE.

    Raises
    ------
    UsageError
        With one line that names the key, its value and what would be right.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=60)]
    question: str = ""
    seed: Annotated[int, Field(ge=0, lt=2**64)] = 2005
    trials: Annotated[int, Field(ge=2, le=1_000_000)] = 100
    until_percent: Annotated[float, Field(gt=0, lt=100)] | None = None
    max_trials: Annotated[int, Field(ge=2, le=10_000_000)] | None = None
    design: Literal["grid", "star", "sobol"] = "grid"
    points: Annotated[int, Field(ge=1, le=_MOST_CELLS)] = 64
    axes: Annotated[dict[str, _Axis], WithJsonSchema(AXES_SCHEMA)] = Field(default_factory=dict)
    spread: tuple[Annotated[float, Field(ge=0, le=1)], Annotated[float, Field(ge=0, le=360)]] = (0.01, 1.0)
    methods: Annotated[tuple[Method, ...], Field(min_length=1)] = (Method(name="refine"),)
    strangers: tuple[LandmarkSpec, ...] = ()
    stranger_trials: Annotated[int, Field(ge=2, le=1_000_000)] = 50
    bank_distance_m: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]] = (0.7, 2.1)
    fixed_pattern_rad: Annotated[float, Field(ge=0, le=1)] = 0.002
    outlier: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]] = (0.05, 5.0)

    @classmethod
    def place_of_key(cls, key: str) -> str | None:
        """Return where a key belongs that is not one of the plan itself."""
        return "it belongs to a method, under [[methods]]" if key in Method.model_fields else _place_of_axis(key)

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        for name, values in self.axes.items():
            if name not in AXES or name == "class_name":
                raise UsageError(f"axes: unknown axis '{name}': the axes are {', '.join(AXES[1:])}")
            low, high = _LIMITS[name]
            for value in values:
                if not (math.isfinite(value) and low <= value <= high) or (name in _WHOLE and value != int(value)):
                    kind = "a whole number" if name in _WHOLE else "a number"
                    raise UsageError(f"axes: '{name}' must be {kind} in [{low:g}, {high:g}], got {value:g}")
        nothing_behind = not any(any(self.axes.get(name, ())) for name in ("wall_m", "floor_m"))
        if any(self.axes.get("bounces", ())) and nothing_behind:
            raise UsageError("axes: 'bounces' needs a 'wall_m' or a 'floor_m' that the light bounces off")
        low, high = self.bank_distance_m
        half = self.spread[0] / 2
        for value in self.axes.get("distance_m", (1.0,)):
            if not low + half <= value <= high - half:
                raise UsageError(
                    f"axes: 'distance_m' must leave its spread of ± {half:g} m within the bank's "
                    f"{low:g} … {high:g} m, got {value:g}: change the axis or 'bank_distance_m'"
                )
        names = [method.name for method in self.methods]
        if len(set(names)) < len(names):
            raise UsageError(f"methods: each needs a name of its own, got {', '.join(names)}")
        known = self.class_names
        for k, stranger in enumerate(self.strangers):
            if stranger.name in (*known, *(other.name for other in self.strangers[:k]), "none"):
                raise UsageError(f"strangers: '{stranger.name}' must have a name of its own, unlike any class")
        return self

    def resolve(self) -> Self:
        """Return the plan with landmarks and sensor spelled out, so that it depends on no catalogue and no preset."""
        bank = self.bank_plan(self.methods[0])
        spelled_out = {
            "classes": (),
            "landmarks": bank.landmarks,
            "meshes": bank.meshes,
            "sensor_overrides": bank.sensor_overrides,
            "max_trials": self.max_trials or 20 * self.trials,
        }
        return type(self)(**{**self.model_dump(), **spelled_out})

    def conditions(self) -> tuple[Condition, ...]:
        """Return the points of the design, classes slowest and strangers last.

        Raises
        ------
        UsageError
            There are more than 100 000.
        """
        axes = {name: self.axes[name] for name in AXES if name in self.axes}
        own = {part.name: part.albedo for part in (*self.parts(), *self.strangers)}
        names = tuple(own)
        if self.design == "sobol":
            points = self._sobol(axes)
        elif self.design == "star":
            base = {name: values[0] for name, values in axes.items()}
            points = [base, *({**base, n: value} for n, values in axes.items() for value in values[1:])]
        else:
            if math.prod(map(len, axes.values())) * len(names) > _MOST_CELLS:
                raise UsageError(f"axes: the grid has more than {_MOST_CELLS} cells: thin an axis, or use 'sobol'")
            points = [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]
        return tuple(
            Condition(name, **{k: int(v) if k in _WHOLE else v for k, v in point.items()})  # type: ignore[arg-type]
            for name in names
            for point in ({"albedo": own[name], **point} for point in points)
        )

    def _sobol(self, axes: dict[str, tuple[float, ...]]) -> list[dict[str, float]]:
        from scipy.stats import qmc  # slow to import

        if not axes:
            return [{}]
        # the scrambling spawns streams of its own, which a Philox keyed by hand cannot
        rng = np.random.default_rng(int(stream(self.seed, "sweep.design", 0).integers(2**63)))
        exponent = math.ceil(math.log2(self.points))
        unit = qmc.Sobol(len(axes), rng=rng).random_base2(exponent)[: self.points]
        low = np.array([min(values) for values in axes.values()])
        high = np.array([max(values) for values in axes.values()])
        table = low + unit * (high - low)
        table = np.where([name in _WHOLE for name in axes], table.round(), table)
        return [dict(zip(axes, row, strict=True)) for row in table.tolist()]

    def greatest_distances_m(self) -> dict[str, float]:
        """Return the far end of the axes of distances, and of the banks, metres."""
        names = [name for name in ("distance_m", "wall_m", "floor_m") if name in self.axes]
        axes = {f"axes.{name}": max(self.axes[name]) for name in names}
        return {**axes, "bank_distance_m": self.bank_distance_m[1]}

    @property
    def is_tilted(self) -> bool:
        """Whether a method estimates pitch or roll, or the camera rolls: the true views then have six numbers.

        Otherwise a pitch is an error of the mounting, and tables have no columns of pitch and roll.
        """
        return any({"pitch", "roll"} & set(method.free) for method in self.methods) or any(
            self.axes.get("roll_deg", ())
        )

    @property
    def n_numbers(self) -> int:
        """How many numbers of a view are told, the first of those that it has."""
        return len(VIEW) if self.is_tilted else len(LEVEL_VIEW)

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of all landmarks, those of the catalogue first."""
        return tuple(part.name for part in self.parts())

    def parts(self) -> list[LandmarkSpec | MeshPlan]:
        """Return all landmarks, those of the catalogue first."""
        specs, meshes = self.resolve_landmarks()
        return [*specs, *meshes]

    def bank_plan(self, method: Method) -> BankPlan:
        """Return the resolved plan of the bank a method matches against."""
        low, high = self.bank_distance_m
        plan = BankPlan(
            classes=self.classes,
            landmarks=self.landmarks,
            meshes=self.meshes,
            sensor=self.sensor,
            sensor_overrides=self.sensor_overrides,
            distance_m=f"{low!r}:{high!r}:{method.bank_step[0]!r}",  # type: ignore[arg-type]  # a grid's text
            model=method.bank_model,
        ).resolve()
        symmetry = common_symmetry([*plan.landmarks, *plan.meshes])
        fields = {**plan.model_dump(), "delta_deg": f"0:{360 / symmetry!r}:{method.bank_step[1]!r}"}
        if factored_refusal(plan) is not None:
            fields["layout"] = "full"
        return BankPlan(**fields).resolve()


def refuse_programs(plan: SweepPlan, trusted: Collection[str], where: str) -> None:
    """Refuse a plan that names a program which the user has not named himself.

    Parameters
    ----------
    plan : SweepPlan
    trusted : collection of str
        Each ``module:name`` that may run.
    where : str
        The plan's file, for the message.

    Raises
    ------
    UsageError
        Naming the method and what would let it run.
    """
    for method in plan.methods:
        if method.is_program and method.method not in trusted:
            raise UsageError(
                f"{where}: the method '{method.name}' would run the program '{method.method}': name it with"
                f" trusted={method.method}, or leave refuse_programs() out if you trust the author of the plan"
            )


def read_sweep_plan(name_or_file: str | os.PathLike[str]) -> SweepPlan:
    """Return a shipped plan, or read one from a TOML file or from the ``plan.json`` of a sweep.

    Parameters
    ----------
    name_or_file : str or path-like
        Name of a shipped sweep, or a plan file.

    Returns
    -------
    SweepPlan

    Raises
    ------
    InputFileError
        The file cannot be read, or is neither TOML nor the plan of a sweep.
    UsageError
        There is no such plan; or with one line that names the file, the key, the value and what would be right.
    """
    name = os.fspath(name_or_file)
    if name in SHIPPED_SWEEPS:
        with resources.as_file(resources.files("phasemark.matcher.sweep").joinpath("plans", f"{name}.toml")) as path:
            return read_plan(path, SweepPlan)
    if not (name.endswith(".toml") or Path(name).exists()):
        raise UsageError(f"unknown sweep '{name}': give {', '.join(SHIPPED_SWEEPS)}, or a .toml file")
    return stored_plan(Path(name)) if name.endswith(".json") else read_plan(Path(name), SweepPlan)


def stored_plan(path: Path) -> SweepPlan:
    """Read the plan that a sweep has written into its folder.

    Raises
    ------
    InputFileError
        The file cannot be read, or is no plan.
    """
    text = read_text(path, most_bytes=MOST_TOML_BYTES)
    try:
        return SweepPlan(**json.loads(text))
    except (ValueError, TypeError, RecursionError) as error:
        raise InputFileError(f"{path}: cannot be read as the plan of a sweep ({error})") from None
