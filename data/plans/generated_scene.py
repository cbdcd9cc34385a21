"""Scenes of a data set: what a generator returns, the call of a generator, and its answers checked."""

from __future__ import annotations

import functools
import hashlib
import inspect
import math
import numbers
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import PhasemarkError, UsageError
from phasemark.inputs.checksum import read_errors
from phasemark.inputs.own_program import called_program, imported_program
from phasemark.render import Background, Scene
from phasemark.render.rigid import product, rigid_transforms, tilt2level

LABEL_BYTES = 64
"""Of a label that is text, as UTF-8."""
OTHER = "other"
"""The class of bodies whose name is of no other class, where a plan has it."""
Label = float | str


@dataclass(frozen=True, eq=False)
class GeneratedScene:
    """A scene of a data set, where the camera stands, and what is to be learnt about it.

    Parameters
    ----------
    scene : Scene or None
        Bodies are labelled by their names: ``person 2`` is of the class ``person``. None: there is no body, and
        nothing returns, or the background alone. Build meshes once, outside of the generator, and move them by
        `bodies2world`: a mesh that was seen before is not analysed again.
    camera2world : (4, 4) or (steps, 4, 4) array_like
        Pose of the camera's mount: x forward, y left, z up; one for each step of a sequence.
    labels : mapping of str to number or str, optional
        Of the scene, or a sequence of them with one for each step. The same names in every scene; NaN: not there.
    bodies2world : (b, 4, 4) or (steps, b, 4, 4) array_like, or a mapping from names, optional
        As for :meth:`phasemark.render.SceneRenderer.render`; None: where the scene has them.
    background : Background, optional
        Wall and floor behind all bodies.

    Examples
    --------
    >>> import numpy as np
    >>> GeneratedScene(None, np.eye(4), {"count": 0}).labels
    {'count': 0}
    """

    scene: Scene | None
    camera2world: ArrayLike
    labels: Mapping[str, Any] = field(default_factory=dict)
    bodies2world: ArrayLike | dict[str, ArrayLike] | None = None
    background: Background | None = None


Generator = Callable[..., GeneratedScene]


@dataclass(frozen=True, eq=False)
class PlacedScene:
    """A generated scene, checked: arrays have an axis of steps."""

    scene: Scene | None
    camera2world: NDArray[np.float64]
    bodies2world: NDArray[np.float64]
    labels: dict[str, NDArray[Any]]
    background: Background | None

    def same_as(self, other: PlacedScene) -> bool:
        """Return True if bodies, poses and labels are equal."""

        def bodies(placed: PlacedScene) -> list[tuple[Any, ...]]:
            return [
                (
                    (one.name, one.smooth, one.retroreflecting, one.specular, one.shininess),
                    *(np.asarray(array).tobytes() for array in (one.albedo, one.mesh.vertices, one.mesh.faces)),
                )
                for one in placed.scene or ()
            ]

        return (
            bodies(self) == bodies(other)
            and np.array_equal(self.camera2world, other.camera2world)
            and np.array_equal(self.bodies2world, other.bodies2world)
            and list(self.labels) == list(other.labels)
            and all(values.tobytes() == other.labels[name].tobytes() for name, values in self.labels.items())
            and self.background == other.background
        )


def class_of_body(name: str, classes: Sequence[str]) -> int | None:
    """Return the number of a body's class: its name without a number at its end; None if there is no such class.

    Examples
    --------
    >>> class_of_body("person 12", ["floor", "person"])
    1
    """
    stem = re.sub(r"[ _.-]*\d+$", "", name)
    for known in (name, stem, OTHER):
        if known in classes:
            return list(classes).index(known)
    return None


def imported_generator(text: str) -> tuple[Generator, str]:
    """Return the generator that ``module:function`` names, and a SHA-256 of what it is made of.

    That is the source of the module it is named in, and of the one that defines it where that is another: of a
    :class:`functools.partial` the module of its function.

    Raises
    ------
    UsageError
        It cannot be imported.
    """
    found: Generator = imported_program(text, "the generator")
    defined: Any = found
    while isinstance(defined, functools.partial):
        defined = defined.func
    modules = dict.fromkeys((text.partition(":")[0], getattr(defined, "__module__", None)))
    sources = [_source_of(sys.modules.get(name)) for name in modules if name]
    if len(sources) == 1:
        return found, hashlib.sha256(sources[0]).hexdigest()
    return found, hashlib.sha256(b"".join(hashlib.sha256(source).digest() for source in sources)).hexdigest()


def _source_of(module: ModuleType | None) -> bytes:
    """Return the source of a module; nothing of one that is compiled, or was typed at a prompt."""
    try:
        return Path(inspect.getsourcefile(module) or "").read_bytes() if module is not None else b""
    except (OSError, TypeError):
        return b""


def generated(
    generator: Generator, name: str, index: int, rng: np.random.Generator, options: Mapping[str, Any]
) -> GeneratedScene:
    """Call a user's generator, and refuse what is no scene.

    Raises
    ------
    UsageError
        It raised something, which is named, or returned something else.
    """
    where = f"scene {index}"
    try:
        found: Any = generator(index, rng, **options)
    except (Exception, SystemExit) as error:
        raise called_program(f"the generator '{name}'", error, f"{where} (plan.generate({index}) repeats it)") from None
    if not isinstance(found, GeneratedScene):
        what = "None" if found is None else f"an object of type {type(found).__name__}"
        raise UsageError(f"{where}: the generator '{name}' must return a GeneratedScene, got {what}")
    return found


def placed(found: GeneratedScene, index: int, steps: int, labels: Mapping[str, str] | None) -> PlacedScene:
    """Check a generated scene.

    Parameters
    ----------
    found : GeneratedScene
    index : int
        Its number, for messages.
    steps : int
        Of a sequence.
    labels : mapping of str to {"number", "text"}, or None
        Names and kinds of the labels that it must have; None: any.

    Raises
    ------
    UsageError
        A pose is not rigid, there are other numbers of them than steps, or labels have other names or kinds.
    """
    try:
        if found.scene is not None and not isinstance(found.scene, Scene):
            raise UsageError(f"'scene' must be a Scene or None, got {type(found.scene).__name__}")
        if found.background is not None and not isinstance(found.background, Background):
            raise UsageError(f"'background' must be a Background or None, got {type(found.background).__name__}")
        cameras = rigid_transforms(found.camera2world, "camera2world")
        if len(cameras) not in (1, steps):
            raise UsageError(f"'camera2world' has {len(cameras)} poses for 'steps' = {steps}")
        cameras = np.repeat(cameras, steps, axis=0) if len(cameras) < steps else cameras
        bodies = np.zeros((steps, 0, 4, 4)) if found.scene is None else found.scene.posed(found.bodies2world, steps)
        if not isinstance(found.labels, Mapping):
            raise UsageError(f"'labels' must be a mapping from names, got {type(found.labels).__name__}")
        own = {name: _label(name, values, steps) for name, values in found.labels.items()}
        if labels is not None:
            _check_labels(own, labels)
    except PhasemarkError as error:
        raise UsageError(f"scene {index}: {error}") from None
    return PlacedScene(found.scene, cameras, bodies, own, found.background)


def kind_of_label(values: NDArray[Any]) -> str:
    """Return "number" or "text"."""
    return "number" if values.dtype.kind == "f" else "text"


def _label(name: str, values: Any, steps: int) -> NDArray[Any]:
    """Return a label of each step: float64, or text in UTF-8."""
    if not isinstance(name, str) or re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) is None:
        raise UsageError(f"the name of a label must be letters, digits and _, got {name!r}")
    given = list(values) if isinstance(values, Sequence | np.ndarray) and not isinstance(values, str) else [values]
    if len(given) not in (1, steps):
        raise UsageError(f"the label '{name}' has {len(given)} values for 'steps' = {steps}")
    given *= steps if len(given) == 1 else 1
    if all(isinstance(value, str) for value in given):
        encoded = [value.encode(errors="replace") for value in given]
        if any(own.decode() != value for own, value in zip(encoded, given, strict=True)):
            raise UsageError(f"the label '{name}' must be text that UTF-8 can hold, got {given[0]!r}")
        if any(len(value) > LABEL_BYTES or b"\0" in value for value in encoded):
            raise UsageError(f"the label '{name}' must have at most {LABEL_BYTES} bytes, got {max(given, key=len)!r}")
        return np.array(encoded, f"S{LABEL_BYTES}")
    if not all(isinstance(value, numbers.Real) for value in given):
        raise UsageError(f"the label '{name}' must be a number or text, got {given[0]!r}")
    try:
        array = np.array([float(value) for value in given])
    except OverflowError:  # an integer beyond all floats
        array = np.array([np.inf])
    if np.isinf(array).any():
        raise UsageError(f"the label '{name}' must be finite, or NaN where it is not there, got {array.max()}")
    return array


def _check_labels(own: Mapping[str, NDArray[Any]], due: Mapping[str, str]) -> None:
    """Refuse labels of other names or kinds than those due."""
    if set(own) != set(due):
        names = (", ".join(sorted(part)) or "none" for part in (due, own))
        raise UsageError("labels must be those of scene 0, {}, got {}".format(*names))
    for name, kind in due.items():
        if (found := kind_of_label(own[name])) != kind:
            raise UsageError(f"the label '{name}' must be a {kind} as in scene 0, got a {found}")


_Y_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Turns y up to z up; x stays."""


def scene_of_file(
    path: str, up: str, cameras: Sequence[Mapping[str, Any]], labels: Mapping[str, Label]
) -> GeneratedScene:
    """Return the scene of a file, z or y up, with camera poses given by position and angles."""
    scene = Scene.read(path)
    poses = _Y_UP @ scene.poses if up == "y" else scene.poses
    return GeneratedScene(scene, np.array([camera_pose(**camera) for camera in cameras]), labels, poses)


def camera_pose(
    position_m: Sequence[float], yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0
) -> NDArray[np.float64]:
    """Return camera2world, (4, 4), of a camera that is turned to the left by yaw, then down by pitch, then by roll.

    Parameters
    ----------
    position_m : (3,) sequence of float
        Of the lens, world frame, z up.
    yaw_deg, pitch_deg, roll_deg : float
        Rz(yaw) · Ry(pitch) · Rx(roll), PHYSICS section 9.

    Examples
    --------
    >>> camera_pose((0, 0, 2.5), pitch_deg=90)[:3, 0].round(9) + 0.0  # looks down
    array([ 0.,  0., -1.])
    """
    yaw, pitch, roll = (math.radians(angle) for angle in (yaw_deg, pitch_deg, roll_deg))
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    pose = np.eye(4)
    pose[:3, :3] = product(turn, tilt2level(np.array([pitch]), np.array([roll]))[0])
    pose[:3, 3] = position_m
    return pose


def sha256_of_files(paths: Sequence[str]) -> str:
    """Return one SHA-256 of the content of files.

    Raises
    ------
    InputFileError
        One is missing or cannot be read.
    """
    digest = hashlib.sha256()
    for path in paths:
        with read_errors(Path(path)):
            digest.update(hashlib.sha256(Path(path).read_bytes()).digest())
    return digest.hexdigest()
