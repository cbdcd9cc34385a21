"""Frame sets, as they are built: a job of shards of views, each rendered, captured and placed in the file alone."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data.files.same_file import named_files
from phasemark.data.frames.frame_set_file import FrameSet, open_frames
from phasemark.data.frames.frames_job import Column, FramesJob, joined_images
from phasemark.data.frames.scene_frames_job import SceneFramesJob
from phasemark.data.plans.arrays import TRUTH, TRUTH_KEYS, refuse_too_many
from phasemark.data.plans.frame_plan import TILT, FramePlan
from phasemark.data.plans.scene_frames_plan import SceneFramesPlan
from phasemark.data.progress import Progress
from phasemark.data.scene_job import StoredMesh, read_landmarks
from phasemark.data.shards.run import produce, refuse_unwritable_output
from phasemark.render import Background, PhasorImages, Renderer, Views
from phasemark.render.direct import HistogramImages, HistogramRenderer
from phasemark.render.view import VIEW_FIELDS

_KEYS = ("class_index", "albedo", "wall_m", "floor_m")


def frames_job(plan: FramePlan | SceneFramesPlan, stored_mesh: StoredMesh | None = None) -> FrameJob | SceneFramesJob:
    """Return the job that builds the frame set of a plan.

    Parameters
    ----------
    plan : FramePlan or SceneFramesPlan
    stored_mesh : callable, optional
        Returns the mesh of a class, in place of the mesh file that the plan names.
    """
    return SceneFramesJob(plan) if isinstance(plan, SceneFramesPlan) else FrameJob(plan, stored_mesh)


def build_frames(
    plan: FramePlan | SceneFramesPlan | Mapping[str, Any],
    path: str | os.PathLike[str],
    *,
    force: bool = False,
    resume: bool = False,
    workers: int | None = None,
    shard_items: int | None = None,
    scheduler: str = "threads",
    progress: Progress | None = None,
) -> FrameSet:
    """Render and capture a frame set and write it with its checksum.

    Its size has no limit here: :func:`phasemark.data.plans.planned_size` says beforehand how large it gets.

    The same plan gives the same bytes, whatever the number of workers or the size of shards. Memory does not grow with
    the frames. A run that was ended early leaves ``FILE.partial`` and ``FILE.manifest`` if anything was finished.

    Parameters
    ----------
    plan : FramePlan, SceneFramesPlan or mapping
        Plan of the frame set, or the fields of a FramePlan by name; the generator of scenes that it names is run.
    path : path-like
        The file to write; ``FILE.sha256`` goes beside it.
    force, resume, workers, scheduler
        As for :func:`phasemark.data.build_bank`.
    shard_items : int, optional
        Views, or scenes, rendered at a time; the result does not depend on it.
    progress : callable (done, total), optional
        Called from this thread with the number of views or scenes finished so far and in all.

    Returns
    -------
    FrameSet
        The frame set, open for reading.

    Raises
    ------
    UsageError
        The plan cannot be built, with the reason; a view that cannot be seen is named.
    InputFileError
        A mesh or sensor file cannot be read.
    OutputExistsError
        The file exists, another run is writing it, or an unfinished run had another plan.
    StorageError
        The disk is full or fails.
    """
    if isinstance(plan, Mapping):
        plan = FramePlan(**plan)
    if not isinstance(plan, FramePlan | SceneFramesPlan):
        raise UsageError(f"'plan' must be a FramePlan or a SceneFramesPlan, got {plan!r}")
    refuse_unwritable_output(Path(path), force=force, resume=resume, inputs=named_files(plan.model_dump()))
    job = frames_job(plan)
    job.check_views()
    produce(
        job, path, finished=job.finished_identity, force=force, resume=resume, workers=workers,
        shard_items=shard_items or job.shard_items, scheduler=scheduler, progress=progress,
    )  # fmt: skip
    return open_frames(path)


class FrameJob(FramesJob[FramePlan]):
    """A frame set of landmarks to be built: its items are views.

    Parameters
    ----------
    plan : FramePlan
    stored_mesh : callable, optional
        Returns the mesh of a class, in place of the mesh file that the plan names.
    """

    KIND, STORED = "frames", FrameSet

    def __init__(self, plan: FramePlan, stored_mesh: StoredMesh | None = None) -> None:
        plan = plan.resolve()
        refuse_too_many(plan)
        super().__init__(plan, plan.build_sensor(), read_landmarks(plan.landmarks, plan.meshes, stored_mesh))
        self._renderers = [Renderer(landmark.mesh, self.sensor, albedo=landmark.albedo) for landmark in self.landmarks]
        with_histograms = self.landmarks if self.plan.histograms else []
        self._histograms = [HistogramRenderer(each.mesh, self.sensor, albedo=each.albedo) for each in with_histograms]

    def check_views(self) -> None:
        """Refuse a plan with views that cannot be rendered, before any is.

        Raises
        ------
        UsageError
            Naming the view.
        """
        step = 1 << 16
        for first in range(0, self.plan.views, step):
            truth = self.plan.draw_truth(first, min(first + step, self.plan.views))
            stated = _views(truth)
            views = stated.in_camera(self.sensor)
            for k, renderer in enumerate(self._renderers):
                of_class = np.flatnonzero(truth["class_index"] == k)
                landmark, vertices = renderer.footprint, renderer.topology.vertices
                lens = views.lens_in_landmark()[of_class]
                low, high = vertices.min(axis=0) - 1e-3, vertices.max(axis=0) + 1e-3
                inside = ((lens > low) & (lens < high)).all(axis=1)
                # NaN (no wall, no floor) compares as false
                before = truth["wall_m"][of_class] < views.distance_m[of_class] + landmark.radius_m
                above = -truth["floor_m"][of_class] > landmark.lowest_m + views.height_m[of_class]
                unseen = np.zeros(len(of_class), np.bool_)
                unseen[renderer.turned_out_of_view(stated[of_class])] = True
                for view in of_class[inside | before | above | unseen]:
                    one = slice(int(view), int(view) + 1)
                    try:
                        background = _background(truth["wall_m"][view], truth["floor_m"][view], self.plan)
                        if background is not None:
                            background.check_behind(landmark, views[one])
                        renderer.check_in_view(stated[one])
                        if inside[np.searchsorted(of_class, view)]:
                            raise UsageError(
                                "the lens is inside the landmark's bounding box: 'distance_m' is too small"
                            )
                    except UsageError as error:
                        reason = str(error).replace(" in view 0", "")
                        raise UsageError(f"view {first + int(view)} of the plan cannot be rendered: {reason}") from None

    def truth_columns(self) -> Iterator[Column]:
        """Yield the truth of the views."""
        truth = self.plan.draw_truth()
        names = self.plan.landmark_names()
        yield (
            "landmark_class", truth["class_index"].astype("<i2"), ("view",),
            {
                "long_name": "number of the landmark's class", "flag_values": np.arange(len(names), dtype="<i2"),
                "flag_meanings": " ".join(names),
            },
        )  # fmt: skip
        for name, array in TRUTH.items():
            key = TRUTH_KEYS[name]
            if key not in TILT or getattr(self.plan, key) is not None:
                about = {"units": array.units, "long_name": array.long_name}
                yield name, truth[key].astype(array.kind), array.dims, about
        yield self.split_column(truth["split_index"])

    def images(self, start: int, stop: int) -> tuple[dict[str, Any], PhasorImages | HistogramImages]:
        """Render some views."""
        truth = self.plan.draw_truth(start, stop)
        image = self._render(truth)
        stored = {"coverage": image.coverage, "range_mixed": image.range_m}
        if "hard" in self.plan.variants:
            stored["range_hard"] = self._render(truth, variant="hard").range_m
        if not self.plan.histograms:
            return stored, image
        parts, order = self._renderings(self._histograms, truth)
        counts = np.concatenate([part.expected for part in parts])[order]
        return stored, replace(parts[0], expected=counts, views=_views(truth))

    def _render(self, truth: dict[str, NDArray[Any]], **options: Any) -> PhasorImages:
        """Return noise-free images of views."""
        parts, order = self._renderings(self._renderers, truth, **options)
        return joined_images(parts, order, self.sensor, views=_views(truth))

    def _renderings(
        self, renderers: Sequence[Any], truth: dict[str, NDArray[Any]], **options: Any
    ) -> tuple[list[Any], NDArray[np.intp]]:
        """Return images of views, those that share all else together, and the order in which they are the views."""
        views, parts, shown = _views(truth), [], []
        for members in _alike(truth):
            class_index, albedo, wall_m, floor_m = (truth[key][members[0]] for key in _KEYS)
            renderer = renderers[class_index].with_albedo(albedo)
            background = _background(wall_m, floor_m, self.plan)
            parts.append(renderer.render_views(views[members], background=background, **options))
            shown.append(members)
        return parts, np.argsort(np.concatenate(shown))


def _alike(truth: dict[str, NDArray[Any]]) -> Iterator[NDArray[np.intp]]:
    """Yield which views agree in landmark, albedo and background."""
    table = np.stack([np.nan_to_num(truth[key].astype(float), nan=-1.0) for key in _KEYS], axis=1)
    kinds, group_of = np.unique(table, axis=0, return_inverse=True)
    for k in range(len(kinds)):
        yield np.flatnonzero(group_of.reshape(-1) == k)


def _views(truth: dict[str, NDArray[Any]]) -> Views:
    angles = {f"{name}_rad": np.deg2rad(truth[f"{name}_deg"]) for name in ("delta", "bearing", "pitch", "roll")}
    return Views.broadcast(*((truth | angles)[name] for name in VIEW_FIELDS))


def _background(wall_m: float, floor_m: float, plan: FramePlan) -> Background | None:
    wall, floor = (None if np.isnan(metres) else float(metres) for metres in (wall_m, floor_m))
    if wall is None and floor is None:
        return None
    return Background(wall_m=wall, floor_m=floor, wall_albedo=plan.wall_albedo, floor_albedo=plan.floor_albedo)
