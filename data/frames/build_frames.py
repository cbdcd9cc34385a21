"""Frame sets, as they are built: a job of shards of views, each rendered, captured and placed in the file alone."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data.files.hdf5_layout import Layout
from phasemark.data.files.narrow import narrowed
from phasemark.data.files.same_file import named_files
from phasemark.data.frames.frame_set_file import FrameSet, open_frames
from phasemark.data.plans.arrays import FIELDS, FRAME_FIELDS, TRUTH, frame_set_fields
from phasemark.data.plans.frame_plan import TILT, FramePlan
from phasemark.data.plans.size import refuse_too_many
from phasemark.data.progress import Progress
from phasemark.data.scene_job import SceneJob, StoredMesh, attach_scales, make_scale, reserve_array
from phasemark.data.seeds import stream
from phasemark.data.shards.build import Place
from phasemark.data.shards.run import produce, refuse_unwritable_output
from phasemark.render import Background, Flag, Frames, PhasorImages, Renderer, Sensor, Views, capture
from phasemark.render.direct import HistogramImages, HistogramRenderer
from phasemark.render.direct.targets import Status

_FLAGS = tuple(Flag)
_SUFFIXES = {"m": "_m", "degree": "_deg", "1": ""}
"""Of the keys of quantities in a plan, by their units in a file."""
_KEYS = ("class_index", "albedo", "wall_m", "floor_m")


def build_frames(
    plan: FramePlan,
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
    plan : FramePlan
        Plan of the frame set.
    path : path-like
        The file to write; ``FILE.sha256`` goes beside it.
    force, resume, workers, scheduler
        As for :func:`phasemark.data.build_bank`.
    shard_items : int, optional
        Views rendered at a time; the result does not depend on it.
    progress : callable (done, total), optional
        Called from this thread with the number of views finished so far and in all.

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
    if workers is not None and workers < 1:
        raise UsageError(f"'workers' must be at least 1, got {workers}")
    inputs = named_files(plan.model_dump())
    refuse_unwritable_output(Path(path), force=force, resume=resume, inputs=inputs)
    job = FrameJob(plan)
    job.check_views()
    produce(
        job, path, finished=job.finished_identity, force=force, resume=resume, workers=workers,
        shard_items=shard_items, scheduler=scheduler, progress=progress,
    )  # fmt: skip
    return open_frames(path)


class FrameJob(SceneJob[FramePlan]):
    """A frame set to be built: one slab, its items are views.

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
        super().__init__(plan, plan.build_sensor(), stored_mesh)
        self.fields = frame_set_fields(self.plan, self.sensor)
        self._renderers = [Renderer(landmark.mesh, self.sensor, albedo=landmark.albedo) for landmark in self.landmarks]
        with_histograms = self.landmarks if self.plan.histograms else []
        self._histograms = [HistogramRenderer(each.mesh, self.sensor, albedo=each.albedo) for each in with_histograms]
        self._shot_sensor = self.sensor.without_errors(shot_noise=True) if "shot" in self.plan.variants else None

    @property
    def items(self) -> list[int]:
        """The number of views."""
        return [self.plan.views]

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
                vertices = renderer.topology.vertices
                reach = float(np.hypot(vertices[:, 0], vertices[:, 1]).max())
                lens = views.lens_in_landmark()[of_class]
                low, high = vertices.min(axis=0) - 1e-3, vertices.max(axis=0) + 1e-3
                inside = ((lens > low) & (lens < high)).all(axis=1)
                # NaN (no wall, no floor) compares as false
                before = truth["wall_m"][of_class] < views.distance_m[of_class] + reach
                above = -truth["floor_m"][of_class] > vertices[:, 2].min() + views.height_m[of_class]
                unseen = np.zeros(len(of_class), np.bool_)
                unseen[renderer.turned_out_of_view(stated[of_class])] = True
                for view in of_class[inside | before | above | unseen]:
                    one = slice(int(view), int(view) + 1)
                    try:
                        background = _background(truth["wall_m"][view], truth["floor_m"][view], self.plan)
                        if background is not None:
                            background.check_behind(vertices, views[one])
                        renderer.check_in_view(stated[one])
                        if inside[np.searchsorted(of_class, view)]:
                            raise UsageError(
                                "the lens is inside the landmark's bounding box: 'distance_m' is too small"
                            )
                    except UsageError as error:
                        reason = str(error).replace(" in view 0", "")
                        raise UsageError(f"view {first + int(view)} of the plan cannot be rendered: {reason}") from None

    def lay_out_arrays(self, layout: Layout) -> list[list[Place]]:
        """Write coordinates and truth, and return where the large datasets go."""
        file, per = layout.file, self.plan.frames_per_view
        scales = {name: make_scale(file, name, *about) for name, *about in _coordinates(self.plan, self.sensor)}
        for name, values, dims, attributes in self._small(self.plan.views, per):
            dataset = file.create_dataset(name, data=values)
            attach_scales(dataset, scales, dims)
            dataset.attrs.update(attributes)
        places = []
        for name in self.fields:
            dataset, of_row = reserve_array(layout, file, scales, name, FIELDS[name])
            dataset.attrs.update(self._meaning(name))
            places.append(Place(of_row.offset, of_row.stride * (per if name in FRAME_FIELDS else 1)))
        return [places]

    def _meaning(self, name: str) -> dict[str, Any]:
        """Return the attributes of a large dataset that say what its numbers stand for."""
        if name in ("range", "range_shot", "range_hard", "range_mixed", "frequency_range"):
            return {"quantity": "range"}
        if name == "target_distance" and self.sensor.histogram is not None:
            return {"quantity": self.sensor.histogram.reports}
        if name == "target_status":
            names = " ".join(status.name.lower() for status in Status)
            return {"flag_values": np.array([int(status) for status in Status], np.uint8), "flag_meanings": names}
        if name in ("flags", "frequency_flags"):
            known = _FLAGS if len(self.sensor.frequencies_hz) > 1 else _FLAGS[:-1]
            names = " ".join(str(flag.name).lower() for flag in known)
            return {"flag_masks": np.array([int(flag) for flag in known], np.uint8), "flag_meanings": names}
        return {}

    def columns(self) -> Iterator[tuple[str, NDArray[Any]]]:
        """Yield name and values of every column of the file: which view each frame shows, and what is true of it."""
        for name, values, _, _ in self._small(self.plan.views, self.plan.frames_per_view):
            yield name, values

    def _small(self, n: int, per: int) -> Iterator[tuple[str, NDArray[Any], tuple[str, ...], dict[str, Any]]]:
        """Yield the datasets that are written with the header: which view each frame shows, and what is true of it."""
        frames = np.arange(n * per, dtype="<i8")
        yield "view_index", (frames // per).astype("<i8"), ("frame",), {"long_name": "view that the frame shows"}
        yield "seed_index", frames, ("frame",), {"long_name": "number of the frame in the run that drew its noise"}
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
            key = f"{name}{_SUFFIXES[array.units]}"
            if key not in TILT or getattr(self.plan, key) is not None:
                about = {"units": array.units, "long_name": array.long_name}
                yield name, truth[key].astype(array.kind), array.dims, about
        yield (
            "split", truth["split_index"], ("view",),
            {
                "long_name": "number of the split", "flag_values": np.arange(len(self.plan.splits), dtype="|u1"),
                "flag_meanings": " ".join(self.plan.splits),
            },
        )  # fmt: skip

    def make(self, slab: int, start: int, stop: int) -> list[NDArray[Any]]:
        """Render and capture some views."""
        plan = self.plan
        truth = plan.draw_truth(start, stop)
        image = self._render(truth)
        stored: dict[str, NDArray[Any]] = {
            "coverage": image.coverage.astype("<f4"),
            "range_mixed": image.range_m.astype("<f4"),
        }
        if "hard" in plan.variants:
            stored["range_hard"] = self._render(truth, variant="hard").range_m.astype("<f4")
        frames = self._captured(image, truth, start, stored)
        stored["range"] = frames.range_m.astype("<f4")
        stored["flags"] = frames.flags
        if frames.amplitude_e is not None and frames.intensity_e is not None:
            stored["amplitude"] = frames.amplitude_e.astype("<f4")
            stored["intensity"] = frames.intensity_e.astype("<f4")
        if len(self.sensor.frequencies_hz) > 1:
            stored |= _of_each_frequency(frames)
        if frames.taps_e is not None:
            stored["taps"] = frames.taps_e.astype("<f4")
        if self._shot_sensor is not None:
            shot = capture(
                image, self._shot_sensor, rng=stream(plan.seed, "frames.noise", 0), n_frames=plan.frames_per_view,
                first_view=start,
            )  # fmt: skip
            stored["range_shot"] = shot.range_m.astype("<f4")
        return [stored[name] for name in self.fields]

    def read(self, file: h5py.File, slab: int, item: int) -> dict[str, NDArray[Any]]:
        """Return one view of a file in the form of :meth:`make`."""
        per = self.plan.frames_per_view
        return {
            name: file[name][item * per : (item + 1) * per] if name in FRAME_FIELDS else file[name][item]
            for name in self.fields
        }

    def _captured(
        self, image: PhasorImages, truth: dict[str, NDArray[Any]], start: int, stored: dict[str, NDArray[Any]]
    ) -> Frames:
        """Return noisy frames of views; those of histograms leave these and their targets in `stored`."""
        plan, rng = self.plan, stream(self.plan.seed, "frames.noise", 0)
        if not plan.histograms:
            return capture(
                image, self.sensor, rng=rng, n_frames=plan.frames_per_view, first_view=start, keep_taps=plan.keep_taps
            )
        parts, order = self._renderings(self._histograms, truth)
        counts = np.concatenate([part.expected for part in parts])[order]
        expected: HistogramImages = replace(parts[0], expected=counts, views=_views(truth))
        frames = capture(expected, self.sensor, rng=rng, n_frames=plan.frames_per_view, first_view=start)
        stored["histogram"] = narrowed(frames.counts, "<u4", "counts")
        stored["target_distance"] = frames.targets.distance_m.astype("<f4")
        stored["target_sigma"] = frames.targets.sigma_m.astype("<f4")
        stored["target_signal"] = frames.targets.signal.astype("<f4")
        stored["target_status"] = frames.targets.status
        return frames.ranges

    def _render(self, truth: dict[str, NDArray[Any]], **options: Any) -> PhasorImages:
        """Return noise-free images of views."""
        parts, order = self._renderings(self._renderers, truth, **options)

        def joined(values: list[NDArray[Any]]) -> NDArray[Any]:
            return np.concatenate(values)[order]

        return PhasorImages(
            phasor=joined([part.phasor for part in parts]),
            intensity=joined([part.intensity for part in parts]),
            coverage=joined([part.coverage for part in parts]),
            sensor=self.sensor,
            views=_views(truth),
            harmonics={k: joined([part.harmonics[k] for part in parts]) for k in parts[0].harmonics},
            by_hz={hz: joined([part.by_hz[hz] for part in parts]) for hz in parts[0].by_hz},
        )

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


def _of_each_frequency(frames: Frames) -> dict[str, NDArray[Any]]:
    """Return the measurement of each frequency, (n, frames, frequency, rows, cols)."""
    parts = frames.by_frequency

    def stacked(name: str, kind: str) -> NDArray[Any]:
        return np.stack([getattr(part, name) for part in parts], axis=2).astype(kind)

    return {
        "frequency_range": stacked("range_m", "<f4"),
        "frequency_amplitude": stacked("amplitude_e", "<f4"),
        "frequency_intensity": stacked("intensity_e", "<f4"),
        "frequency_flags": stacked("flags", "|u1"),
    }


def _views(truth: dict[str, NDArray[Any]]) -> Views:
    return Views.broadcast(
        truth["distance_m"],
        np.deg2rad(truth["delta_deg"]),
        np.deg2rad(truth["bearing_deg"]),
        truth["height_m"],
        np.deg2rad(truth["pitch_deg"]),
        np.deg2rad(truth["roll_deg"]),
    )


def _background(wall_m: float, floor_m: float, plan: FramePlan) -> Background | None:
    if np.isnan(wall_m) and np.isnan(floor_m):
        return None
    return Background(
        wall_m=None if np.isnan(wall_m) else float(wall_m),
        floor_m=None if np.isnan(floor_m) else float(floor_m),
        wall_albedo=plan.wall_albedo,
        floor_albedo=plan.floor_albedo,
    )


def _coordinates(plan: FramePlan, sensor: Sensor) -> Iterator[tuple[str, Any, str, str]]:
    yield "frame", np.arange(plan.views * plan.frames_per_view, dtype="<i8"), "1", "frame"
    yield "view", np.arange(plan.views, dtype="<i8"), "1", "view, shown by one frame or more"
    if len(sensor.frequencies_hz) > 1:
        yield (
            "frequency",
            np.array(sensor.frequencies_hz, "<f8"),
            "Hz",
            "modulation frequency, in the order of the frame",
        )
    if plan.keep_taps:
        tau_deg = np.tile(np.arange(4, dtype="<i4") * 90, len(sensor.frequencies_hz))
        yield "phase", tau_deg, "degree", "phase image τ"
        yield "tap", ["a", "b"], "", "tap of the pixel"
    if plan.histograms and sensor.histogram is not None:
        histogram = sensor.histogram
        middle_m = histogram.start_m + histogram.bin_width_m * (np.arange(histogram.bins, dtype="<f8") + 0.5)
        yield "bin", middle_m, "m", "delay of the middle of the bin, as range"
        yield "target", np.arange(histogram.max_targets, dtype="<i4"), "1", "target of a zone, nearest first"
    yield "row", np.arange(sensor.rows, dtype="<i4"), "1", "pixel row, 0 at the top"
    yield "col", np.arange(sensor.cols, dtype="<i4"), "1", "pixel column, 0 on the left"
