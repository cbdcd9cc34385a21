"""Plan of a frame set of scenes: a generator or a list of files, a camera, and what is kept."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from phasemark import UsageError
from phasemark.data.files.narrow import narrowed
from phasemark.data.plans.bank_plan import PlanModel, SensorPlan, plan_of_table, sensor_in_folder, without_nul
from phasemark.data.plans.frame_plan import (
    FramePlan,
    FramesPerView,
    Seed,
    Splits,
    check_splits,
    default_splits,
    split_of_views,
)
from phasemark.data.plans.generated_scene import (
    GeneratedScene,
    Generator,
    PlacedScene,
    class_of_body,
    generated,
    imported_generator,
    kind_of_label,
    placed,
    scene_of_file,
    sha256_of_files,
)
from phasemark.data.seeds import stream
from phasemark.inputs.toml_file import read_toml

_Finite = Annotated[float, Field(allow_inf_nan=False)]
_ClassName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_. -]*$", max_length=100)]
MOST_BODIES = 4096
Kept = Literal["histograms", "targets", "shares", "poses", "taps"]
_KEPT: tuple[Kept, ...] = ("histograms", "targets", "shares", "poses", "taps")


class CameraPlace(PlanModel):
    """Pose of the camera in a scene from a file.

    Parameters
    ----------
    position_m : (x, y, z)
        Of the lens in the scene, metres, z up.
    yaw_deg, pitch_deg, roll_deg : float
        The camera looks along x, turned to the left by yaw, down by pitch, then by roll.
    """

    position_m: tuple[_Finite, _Finite, _Finite]
    yaw_deg: _Finite = 0.0
    pitch_deg: _Finite = 0.0
    roll_deg: _Finite = 0.0


class SceneFile(PlanModel):
    """A scene from a file.

    Parameters
    ----------
    path : str
        glTF, GLB, OBJ with materials, PLY and others, in metres; relative to the plan's folder.
    up : {"z", "y"}
        Axis of the file that points up; it is turned to z. glTF prescribes y.
    cameras : sequence of CameraPlace
        Where the camera stands, one for each step.
    labels : mapping of str to number or str
        The same names in every file.
    """

    path: Annotated[str, AfterValidator(without_nul)]
    up: Literal["z", "y"] = "z"
    cameras: Annotated[tuple[CameraPlace, ...], Field(min_length=1)]
    labels: dict[str, _Finite | str] = Field(default_factory=dict)


class ScenesTable(PlanModel):
    """Source of the scenes of a frame set: a generator, or a list of files.

    Parameters
    ----------
    generator : str, optional
        ``module:function`` of your own: called with the number of a scene, a random generator of that scene's own, and
        `options` as keywords, it returns a :class:`phasemark.data.plans.GeneratedScene`.
    n : int, optional
        Number of scenes; of a list as many as it has.
    steps : int
        Frames of a sequence: for how many steps each scene has poses.
    options : mapping
        Keywords for the generator.
    list : sequence of SceneFile
        Scenes from files, in place of a generator.
    classes : sequence of str
        Classes of bodies whose shares are kept: a body named ``person 2`` is of the class ``person``; ``other`` takes
        the names of no other class. Without classes no shares are kept.
    bodies : int
        Most bodies of a scene: each view has this number of poses, NaN where there is no body.
    labels : mapping of str to {"number", "text"}, optional
        Names and kinds of the labels; left out, those of scene 0.
    source_sha256 : str, optional
        Of the generator's module or the listed files; a resolved plan has it, and refuses another.
    """

    generator: Annotated[str, Field(pattern=r"^[^:\s]+:[^:\s]+$")] | None = None
    n: Annotated[int, Field(ge=1, le=2**32 - 1)] | None = None
    steps: Annotated[int, Field(ge=1, le=2**20)] = 1
    options: dict[str, Any] = Field(default_factory=dict)
    list: tuple[SceneFile, ...] = ()
    classes: Annotated[tuple[_ClassName, ...], Field(max_length=1000)] = ()
    bodies: Annotated[int, Field(ge=1, le=MOST_BODIES)] = 16
    labels: dict[str, Literal["number", "text"]] | None = None
    source_sha256: str | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.generator is None) == (not self.list):
            got = "neither" if self.generator is None else "both"
            raise UsageError(f"give 'generator' = \"module:function\" or 'list' = [files], got {got}")
        if self.generator is not None and self.n is None:
            raise UsageError("'n' is missing: the number of scenes that the generator makes")
        if self.list and self.n not in (None, len(self.list)):
            raise UsageError(f"'n' must be left out: 'list' has {len(self.list)} scenes, got {self.n}")
        if self.list and self.options:
            raise UsageError("'options' must be left out: they are for a generator, and there is none")
        for k, scene in enumerate(self.list):
            if len(scene.cameras) not in (1, self.steps):
                raise UsageError(f"list.{k}: 'cameras' has {len(scene.cameras)} poses for 'steps' = {self.steps}")
        if len(set(self.classes)) < len(self.classes):
            raise UsageError(f"'classes' must not repeat, got {[*self.classes]}")
        return self


class SceneFramesPlan(SensorPlan):
    """A frame set of scenes: noisy frames with poses, labels, shares of bodies and the range without noise.

    Each step of a scene is a view.

    Parameters
    ----------
    scenes : ScenesTable
        Where the scenes come from.
    sensor : str
        A preset's name, or a sensor file (with a ``/`` or ending in ``.toml``).
    sensor_overrides : mapping
        Fields of the sensor that replace those of `sensor`.
    frames_per_view : int
        Number of noisy frames of each view.
    seed : int
        Root of all random numbers.
    variants : sequence of {"mixed", "shot"}
        What is stored beside the full frames. ``mixed``: the range of the exact integral without noise. ``shot``:
        frames with shot noise alone.
    keep : sequence of {"histograms", "targets", "shares", "poses", "taps"}
        What is stored of what there is: histograms and targets of a direct sensor with a [histogram] table, shares of
        the classes, poses of bodies and camera, counts of each tap.
    splits : mapping of str to float
        Names of splits with their shares of the scenes, which add up to 1. All frames of a scene are in one split.

    Raises
    ------
    UsageError
        With one line that names the key, its value and what would be right.

    Examples
    --------
    >>> SceneFramesPlan(scenes={"generator": "people:people", "n": 1000, "steps": 20}).views
    20000
    """

    scenes: ScenesTable
    sensor: str = "pmd-16x16"
    sensor_overrides: dict[str, Any] = Field(default_factory=dict)
    frames_per_view: FramesPerView = 1
    seed: Seed = 0
    variants: tuple[Literal["mixed", "shot"], ...] = ("mixed",)
    keep: tuple[Kept, ...] = ("histograms", "targets", "shares", "poses")
    splits: Splits = default_splits()

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        check_splits(self.splits)
        for name in ("variants", "keep"):
            given = getattr(self, name)
            if len(set(given)) < len(given):
                raise UsageError(f"'{name}' must not repeat, got {[*given]}")
        return self

    @property
    def views(self) -> int:
        """Number of steps of all scenes."""
        return self.n_scenes * self.scenes.steps

    @property
    def n_scenes(self) -> int:
        """Number of scenes."""
        return self.scenes.n or len(self.scenes.list)

    def with_scenes(self, n: int) -> Self:
        """Return the plan of another number of scenes of its generator.

        Raises
        ------
        UsageError
            The scenes come from a list.
        """
        return self.model_copy(update={"scenes": ScenesTable(**{**self.scenes.model_dump(), "n": n})})

    @property
    def keep_taps(self) -> bool:
        """Whether the counts of each tap are stored, too."""
        return "taps" in self.keep

    def greatest_distances_m(self) -> dict[str, float]:
        """Return nothing: a plan of scenes does not say how far bodies are."""
        return {}

    def in_folder(self, folder: Path) -> Self:
        """Return the plan of a file in a folder: names of scene files and of a sensor file are relative to it."""
        files = tuple(each.model_copy(update={"path": str(folder / each.path)}) for each in self.scenes.list)
        scenes = self.scenes.model_copy(update={"list": files})
        return self.model_copy(update={"scenes": scenes, "sensor": sensor_in_folder(self.sensor, folder)})

    def resolve(self) -> Self:
        """Return the plan with every default made explicit; resolving again changes nothing.

        The generator is imported, and called for scene 0, unless the plan is resolved.

        Raises
        ------
        UsageError
            The sensor is unknown or has no taps, the generator cannot be imported, or scene 0 is wrong.
        InputFileError
            A file cannot be read.
        """
        sensor = self.build_sensor()
        if sensor.kind == "direct" and (self.keep_taps or "shot" in self.variants):
            raise UsageError("'taps' and the variant 'shot' must be left out: a direct sensor has neither")
        scenes = self.scenes
        if scenes.labels is None or scenes.source_sha256 is None:
            source = self.source()
            labels = {name: kind_of_label(values) for name, values in source.placed(0).labels.items()}
            scenes = scenes.model_copy(update={"n": self.n_scenes, "labels": labels, "source_sha256": source.sha256})
        no_table = sensor.histogram is None
        absent = {"histograms": no_table, "targets": no_table, "shares": not scenes.classes}
        return self.model_copy(
            update={
                "scenes": scenes,
                "sensor_overrides": sensor.model_dump(mode="json"),
                "variants": tuple(name for name in ("mixed", "shot") if name in self.variants),
                "keep": tuple(name for name in _KEPT if name in self.keep and not absent.get(name)),
            }
        )

    def source(self) -> SceneSource:
        """Return the source of the scenes; the generator's module is imported.

        Raises
        ------
        UsageError
            The generator cannot be imported, or is not what the plan was resolved with.
        InputFileError
            A listed file cannot be read.
        """
        return SceneSource(self)

    def generate(self, index: int) -> GeneratedScene:
        """Return a scene as its generator makes it; it depends on seed and number alone.

        Parameters
        ----------
        index : int
            Its number, from 0.

        Raises
        ------
        UsageError
            The generator cannot be imported, raised something, or returned no scene.
        """
        return self.source().generate(index)

    def draw_split(self) -> NDArray[np.uint8]:
        """Return the number of the split of each scene."""
        return narrowed(split_of_views(self.seed, self.splits, 0, self.n_scenes), "|u1", "splits")


class SceneSource:
    """Maker of the scenes of a plan: its generator, which is imported, or its listed files, which are hashed.

    Parameters
    ----------
    plan : SceneFramesPlan

    Attributes
    ----------
    sha256 : str
        Of the generator's module, or of the files.
    """

    def __init__(self, plan: SceneFramesPlan) -> None:
        self.plan, scenes, name = plan, plan.scenes, plan.scenes.generator
        self._program: Generator | None = None
        if name is None:
            self.sha256 = sha256_of_files([each.path for each in scenes.list])
        else:
            self._program, self.sha256 = imported_generator(name)
        if scenes.source_sha256 not in (None, self.sha256):
            what = "listed files are" if name is None else f"module of the generator '{name}' is"
            raise UsageError(
                f"the {what} not as it was when the plan was resolved: give the old one, or build the set again"
            )

    def generate(self, index: int) -> GeneratedScene:
        """Return a scene; see :meth:`SceneFramesPlan.generate`."""
        if not 0 <= index < self.plan.n_scenes:
            raise UsageError(f"scene {index} is not there: the plan has {self.plan.n_scenes}")
        scenes = self.plan.scenes
        if self._program is None:
            each = scenes.list[index]
            return scene_of_file(each.path, each.up, [one.model_dump() for one in each.cameras], each.labels)
        rng = stream(self.plan.seed, "scenes", index)
        return generated(self._program, str(scenes.generator), index, rng, scenes.options)

    def placed(self, index: int) -> PlacedScene:
        """Return a scene, checked.

        Raises
        ------
        UsageError
            As :meth:`generate`; a pose is not rigid, labels are not those of scene 0, or there are too many bodies.
        """
        scenes = self.plan.scenes
        found = placed(self.generate(index), index, scenes.steps, scenes.labels)
        n = found.bodies2world.shape[1]
        if "poses" in self.plan.keep and n > scenes.bodies:
            raise UsageError(f"scene {index}: has {n} bodies, more than 'bodies' = {scenes.bodies}: raise it")
        for name in found.scene.names if found.scene is not None and scenes.classes else ():
            if class_of_body(name, scenes.classes) is None:
                raise UsageError(
                    f"scene {index}: the body '{name}' is of none of the classes {', '.join(scenes.classes)}: name it"
                    f" so, or add the class 'other'"
                )
        return found


def refuse_generator(plan: SceneFramesPlan, trusted: Collection[str], where: str) -> None:
    """Refuse a plan that names a generator which the user has not named himself.

    Raises
    ------
    UsageError
        Naming the generator and what would let it run.
    """
    generator = plan.scenes.generator
    if generator is not None and generator not in trusted:
        raise UsageError(
            f"{where}: would run the program '{generator}': name it with generator={generator}, or leave"
            " refuse_generator() out if you trust the author of the plan"
        )


def read_frames_plan(path: str | os.PathLike[str]) -> FramePlan | SceneFramesPlan:
    """Read the plan of a frame set from a TOML file: of scenes if it has a table [scenes], otherwise of landmarks.

    Raises
    ------
    InputFileError
        The file cannot be read or is not TOML.
    UsageError
        With one line that names the file, the key, the value and what would be right.
    """
    table = read_toml(Path(path))
    if "scenes" in table:
        return plan_of_table(table, Path(path), SceneFramesPlan)
    return plan_of_table(table, Path(path), FramePlan)
