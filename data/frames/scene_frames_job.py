"""Frame sets of scenes, as they are built: generated, rendered, captured and placed in the file scene by scene."""

from __future__ import annotations

import copy
import threading
from collections import OrderedDict
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from trimesh.caching import TrackedArray

from phasemark import UsageError
from phasemark.data.frames.frame_set_file import SceneFrameSet
from phasemark.data.frames.frames_job import Column, FramesJob, joined_images
from phasemark.data.plans.arrays import POSE_FIELDS, SEQUENCE, refuse_too_many
from phasemark.data.plans.generated_scene import PlacedScene, class_of_body
from phasemark.data.plans.scene_frames_plan import SceneFramesPlan, SceneSource
from phasemark.render import Body, PhasorImages, Scene, SceneRenderer, Sensor
from phasemark.render.direct import HistogramImages
from phasemark.render.integral.surface_mesh import SurfaceMesh

_SHARD_VIEWS = 64
"""Of a shard: they take up to a second, so that workers have enough of them and a killed run loses little."""
_RENDERERS = 32
"""Most scenes of other bodies whose meshes are kept analysed."""
_SPECK_M = 1e-4
_NOTHING = Scene([Body.box((_SPECK_M,) * 3, albedo=0.0, name="nothing")])
"""Of an empty scene: a black speck behind the lens."""


class SceneFramesJob(FramesJob[SceneFramesPlan]):
    """A frame set of scenes to be built: its items are scenes, with a view for each step.

    The generator is imported when the first scene is made: parts of a resolved plan are merged without it.

    Parameters
    ----------
    plan : SceneFramesPlan
    """

    KIND, STORED = "scenes", SceneFrameSet

    def __init__(self, plan: SceneFramesPlan) -> None:
        plan = plan.resolve()
        refuse_too_many(plan)
        self.views_per_item = plan.scenes.steps
        self.shard_items = max(1, _SHARD_VIEWS // plan.scenes.steps)
        super().__init__(plan, plan.build_sensor(), [])
        self._renderers = _Renderers(self.sensor)

    @cached_property
    def _source(self) -> SceneSource:
        """What makes the scenes."""
        return self.plan.source()

    def check_views(self) -> None:
        """Refuse a generator whose scene 0 is not the same when it is made again.

        Raises
        ------
        UsageError
        """
        if not self._source.placed(0).same_as(self._source.placed(0)):
            raise UsageError(
                f"scene 0: the generator '{self.plan.scenes.generator}' made another scene when it was called again: it"
                " must draw all random numbers from the generator that it is given"
            )

    def truth_columns(self) -> Iterator[Column]:
        """Yield number and step of the scene of each view, and its split."""
        steps = self.plan.scenes.steps
        view = np.arange(self.plan.views)
        for (name, array), values in zip(SEQUENCE.items(), np.divmod(view, steps), strict=True):
            yield name, values.astype(array.kind), array.dims, {"units": array.units, "long_name": array.long_name}
        yield self.split_column(np.repeat(self.plan.draw_split(), steps))

    def coordinates(self) -> Iterator[tuple[str, Any, str, str]]:
        """Yield name, values, unit and long name of each dimension."""
        yield from super().coordinates()
        if "shares" in self.plan.keep:
            yield "body_class", [*self.plan.scenes.classes], "", "class of bodies"
        if "poses" in self.plan.keep:
            yield "body", np.arange(self.plan.scenes.bodies, dtype="<i4"), "1", "body of a scene"
            for name, what in (("pose_row", "row"), ("pose_col", "column")):
                yield name, np.arange(4, dtype="<i4"), "1", f"{what} of a pose"

    def images(self, start: int, stop: int) -> tuple[dict[str, Any], PhasorImages | HistogramImages]:
        """Generate and render some scenes."""
        scenes, shots = [], []
        for index in range(start, stop):  # a generator may change its meshes from scene to scene
            scenes.append(self._source.placed(index))
            shots.append(self._rendered(scenes[-1], index))
        phasors = [own for own, _, _ in shots if own is not None]
        counts = [own for _, own, _ in shots if own is not None]
        shares = [own for _, _, own in shots]
        stored = {"coverage": np.concatenate([np.minimum(own.sum(axis=-1), 1.0) for own in shares])}
        image: PhasorImages | HistogramImages
        if phasors:
            image = joined_images(phasors, slice(None), self.sensor)
            stored["range_mixed"] = image.range_m
        if counts:
            expected = np.concatenate([part.expected for part in counts])
            image = HistogramImages(expected, np.concatenate([part.signal for part in counts]), self.sensor)
        stored["shares"] = np.concatenate([self._of_classes(*pair) for pair in zip(scenes, shares, strict=True)])
        if "poses" in self.plan.keep:
            poses = [self._poses(scene) for scene in scenes]
            stored |= {name: np.concatenate([own[name] for own in poses]) for name in POSE_FIELDS}
        for name in self.plan.scenes.labels or {}:
            stored[f"label_{name}"] = np.concatenate([scene.labels[name] for scene in scenes])
        return stored, image

    def _rendered(
        self, placed: PlacedScene, index: int
    ) -> tuple[PhasorImages | None, HistogramImages | None, NDArray[np.float64]]:
        """Render the steps of a scene: phasors, histograms, and the share of each body."""
        scene, cameras, bodies = placed.scene, placed.camera2world, placed.bodies2world
        n, shape = len(cameras), (self.sensor.rows, self.sensor.cols)
        if scene is None:
            scene, bodies = _NOTHING, cameras[:, None] @ _BEHIND
        renderer = self._renderers.of(scene)
        with_histograms = self.sensor.histogram is not None
        try:
            counts = renderer.histograms(cameras, bodies, placed.background) if with_histograms else None
            needs_phasors = counts is None or "mixed" in self.plan.variants
            phasors = renderer.phasors(cameras, bodies, placed.background) if needs_phasors else None
        except UsageError as error:
            raise UsageError(f"scene {index} of the plan cannot be rendered: {error}") from None
        shares = counts.shares if counts is not None else phasors.shares if phasors is not None else None
        assert shares is not None
        return phasors, counts, np.zeros((n, *shape, 0)) if placed.scene is None else shares

    def _classes_of(self, placed: PlacedScene) -> list[int]:
        """Return the number of the class of each body."""
        found = [class_of_body(name, self.plan.scenes.classes) for name in placed.scene.names] if placed.scene else []
        return [-1 if number is None else number for number in found]

    def _of_classes(self, placed: PlacedScene, shares: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the shares of the classes, those of their bodies together, (n, rows, cols, classes)."""
        out = np.zeros((*shares.shape[:-1], len(self.plan.scenes.classes)))
        for body, number in enumerate(self._classes_of(placed)):
            if number >= 0:
                out[..., number] += shares[..., body]
        return np.minimum(out, 1.0)

    def _poses(self, placed: PlacedScene) -> dict[str, NDArray[Any]]:
        """Return the poses of camera and bodies of each step, and the bodies' classes, with room for more bodies."""
        n, b = placed.bodies2world.shape[:2]
        bodies = np.full((n, self.plan.scenes.bodies, 4, 4), np.nan)
        bodies[:, :b] = placed.bodies2world
        classes = np.full((n, self.plan.scenes.bodies), -1)
        classes[:, :b] = self._classes_of(placed)
        return {"camera2world": placed.camera2world, "bodies2world": bodies, "class_of_body": classes}


_BEHIND = np.eye(4) + np.array([[0, 0, 0, -10 * _SPECK_M], [0] * 4, [0] * 4, [0] * 4])


class _Renderers:
    """Renderers of scenes, kept by their bodies: a mesh that was seen before is not analysed again."""

    def __init__(self, sensor: Sensor) -> None:
        self._sensor = sensor
        self._known: OrderedDict[tuple[Any, ...], SceneRenderer] = OrderedDict()
        self._lock = threading.Lock()

    def of(self, scene: Scene) -> SceneRenderer:
        """Return a renderer of a scene's bodies, as it was made: what it renders depends on no other scene."""
        key = tuple((body.name, *_state(body.mesh), *_surface(body)) for body in scene)
        with self._lock:
            known = self._known.get(key)
        if known is None:
            known = SceneRenderer(scene, self._sensor)
        with self._lock:
            self._known[key] = known  # it holds the meshes, and their ids stay theirs
            self._known.move_to_end(key)
            while len(self._known) > _RENDERERS:
                self._known.popitem(last=False)
        own = copy.copy(known)
        own._assembly = known._assembly.copy()
        return own


def _surface(body: Body) -> tuple[Any, ...]:
    """Return how a body returns light: albedo, of each face where faces have their own, and gloss."""
    albedo = body.albedo if isinstance(body.albedo, float) else body.albedo.tobytes()
    return albedo, body.smooth, body.retroreflecting, body.specular, body.shininess


def _state(mesh: SurfaceMesh) -> tuple[int, ...]:
    """Return which mesh it is, and in which state: trimesh notes changes of its arrays."""
    return id(mesh), *(hash(array) if isinstance(array, TrackedArray) else 0 for array in (mesh.vertices, mesh.faces))
