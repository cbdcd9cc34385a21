"""Base of the jobs that build frame sets: what is captured of images, and how a file of frames is laid out."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from phasemark.data.files.hdf5_layout import Layout
from phasemark.data.files.narrow import narrowed
from phasemark.data.plans.arrays import FRAME_FIELDS, TARGET_FIELDS, frame_set_fields
from phasemark.data.plans.frame_plan import FramePlan
from phasemark.data.plans.scene_frames_plan import SceneFramesPlan
from phasemark.data.scene_job import Landmark, SceneJob, attach_scales, make_scale, reserve_array
from phasemark.data.seeds import stream
from phasemark.data.shards.build import Place
from phasemark.render import Flag, Frames, PhasorImages, Sensor, capture
from phasemark.render.direct import HistogramImages
from phasemark.render.direct.targets import Status

P = TypeVar("P", bound=FramePlan | SceneFramesPlan)
Column = tuple[str, NDArray[Any], tuple[str, ...], dict[str, Any]]
_FLAGS = tuple(Flag)
_MEASURED = {"range": "range_m", "amplitude": "amplitude_e", "intensity": "intensity_e", "flags": "flags"}
"""Datasets of what is measured, also at each frequency, and the attributes of frames that hold it."""


class FramesJob(SceneJob[P]):
    """A frame set to be built: one slab, its items are views, or several views each.

    Parameters
    ----------
    plan : FramePlan or SceneFramesPlan
        The resolved plan.
    sensor : Sensor
        The camera.
    landmarks : list of Landmark
        Whose meshes the file holds.
    """

    views_per_item = 1

    def __init__(self, plan: P, sensor: Sensor, landmarks: list[Landmark]) -> None:
        super().__init__(plan, sensor, landmarks)
        self._arrays = frame_set_fields(plan, sensor)
        self.fields = list(self._arrays)
        self._shot_sensor = sensor.without_errors(shot_noise=True) if "shot" in plan.variants else None

    @property
    def items(self) -> list[int]:
        """The number of views, or of groups of them."""
        return [self.plan.views // self.views_per_item]

    @abstractmethod
    def truth_columns(self) -> Iterator[Column]:
        """Yield the datasets of views that are written with the header, splits last."""

    @abstractmethod
    def images(self, start: int, stop: int) -> tuple[dict[str, Any], PhasorImages | HistogramImages]:
        """Return the noise-free arrays of some items by name, and the images that are captured."""

    def lay_out_arrays(self, layout: Layout) -> list[list[Place]]:
        """Write coordinates and truth, and return where the large datasets go."""
        file = layout.file
        scales = {name: make_scale(file, name, *about) for name, *about in self.coordinates()}
        for name, values, dims, attributes in self.columns():
            dataset = file.create_dataset(name, data=values)
            attach_scales(dataset, scales, dims)
            dataset.attrs.update(attributes)
        places = []
        for name, array in self._arrays.items():
            dataset, of_row = reserve_array(layout, file, scales, name, array)
            dataset.attrs.update(self._meaning(name))
            places.append(Place(of_row.offset, of_row.stride * self._rows(name)))
        return [places]

    def _rows(self, name: str) -> int:
        """Return how many rows of a dataset an item has."""
        return self.views_per_item * (self.plan.frames_per_view if name in FRAME_FIELDS else 1)

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

    def split_column(self, split: NDArray[np.uint8]) -> Column:
        """Return the dataset of the splits of views."""
        attributes = {
            "long_name": "number of the split", "flag_values": np.arange(len(self.plan.splits), dtype="|u1"),
            "flag_meanings": " ".join(self.plan.splits),
        }  # fmt: skip
        return "split", split, ("view",), attributes

    def columns(self) -> Iterator[Column]:
        """Yield the datasets that are written with the header: which view each frame shows, and what is true of it."""
        per = self.plan.frames_per_view
        frames = np.arange(self.plan.views * per, dtype="<i8")
        yield "view_index", (frames // per).astype("<i8"), ("frame",), {"long_name": "view that the frame shows"}
        yield "seed_index", frames, ("frame",), {"long_name": "number of the frame in the run that drew its noise"}
        yield from self.truth_columns()

    def make(self, slab: int, start: int, stop: int) -> list[NDArray[Any]]:
        """Render and capture some items."""
        stored, image = self.images(start, stop)
        first = start * self.views_per_item
        frames = self._captured(image, first, stored)
        stored["taps"] = frames.taps_e
        for name, attribute in _MEASURED.items():
            stored[name] = getattr(frames, attribute)
            if len(self.sensor.frequencies_hz) > 1:
                of_each = [getattr(part, attribute) for part in frames.by_frequency]
                stored[f"frequency_{name}"] = np.stack(of_each, axis=2)
        if self._shot_sensor is not None:
            assert isinstance(image, PhasorImages)
            stored["range_shot"] = capture(image, self._shot_sensor, **self._draws(first)).range_m
        return [stored[name].astype(array.kind, copy=False) for name, array in self._arrays.items()]

    def read(self, file: h5py.File, slab: int, item: int) -> dict[str, NDArray[Any]]:
        """Return one item of a file in the form of :meth:`make`."""
        return {name: file[name][item * (n := self._rows(name)) : (item + 1) * n] for name in self.fields}

    def _draws(self, first_view: int) -> dict[str, Any]:
        """Return the arguments of `capture` for the noise of some views."""
        rng = stream(self.plan.seed, "frames.noise", 0)
        return {"rng": rng, "n_frames": self.plan.frames_per_view, "first_view": first_view}

    def _captured(self, image: PhasorImages | HistogramImages, first_view: int, stored: dict[str, Any]) -> Frames:
        """Return noisy frames of views; those of histograms leave these and their targets in `stored`."""
        if isinstance(image, PhasorImages):
            return capture(image, self.sensor, keep_taps=self.plan.keep_taps, **self._draws(first_view))
        frames = capture(image, self.sensor, **self._draws(first_view))
        stored["histogram"] = narrowed(frames.counts, "<u4", "counts")
        targets = frames.targets
        columns = targets.distance_m, targets.sigma_m, targets.signal, targets.status
        stored |= zip(TARGET_FIELDS, columns, strict=True)
        return frames.ranges

    def coordinates(self) -> Iterator[tuple[str, Any, str, str]]:
        """Yield name, values, unit and long name of each dimension."""
        plan, sensor = self.plan, self.sensor
        dims = {dim for array in self._arrays.values() for dim in array.dims}
        yield "frame", np.arange(plan.views * plan.frames_per_view, dtype="<i8"), "1", "frame"
        yield "view", np.arange(plan.views, dtype="<i8"), "1", "view, shown by one frame or more"
        if len(sensor.frequencies_hz) > 1:
            hz = np.array(sensor.frequencies_hz, "<f8")
            yield "frequency", hz, "Hz", "modulation frequency, in the order of the frame"
        if "tap" in dims:
            tau_deg = np.tile(np.arange(4, dtype="<i4") * 90, len(sensor.frequencies_hz))
            yield "phase", tau_deg, "degree", "phase image τ"
            yield "tap", ["a", "b"], "", "tap of the pixel"
        histogram = sensor.histogram
        if "bin" in dims and histogram is not None:
            middle_m = histogram.start_m + histogram.bin_width_m * (np.arange(histogram.bins, dtype="<f8") + 0.5)
            yield "bin", middle_m, "m", "delay of the middle of the bin, as range"
        if "target" in dims and histogram is not None:
            yield "target", np.arange(histogram.max_targets, dtype="<i4"), "1", "target of a zone, nearest first"
        yield "row", np.arange(sensor.rows, dtype="<i4"), "1", "pixel row, 0 at the top"
        yield "col", np.arange(sensor.cols, dtype="<i4"), "1", "pixel column, 0 on the left"


def joined_images(
    parts: Sequence[PhasorImages], order: NDArray[np.intp] | slice, sensor: Sensor, **about: Any
) -> PhasorImages:
    """Return images of several renderings as one batch, in an order.

    Parameters
    ----------
    parts : sequence of PhasorImages
    order : (n,) int array or slice
        Which image of the concatenated parts stands where.
    sensor : Sensor
    **about
        Further fields of the images.
    """

    def joined(values: Iterable[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate(list(values))[order]

    return PhasorImages(
        joined(part.phasor for part in parts),
        joined(part.intensity for part in parts),
        joined(part.coverage for part in parts),
        sensor,
        harmonics={k: joined(part.harmonics[k] for part in parts) for k in parts[0].harmonics},
        by_hz={hz: joined(part.by_hz[hz] for part in parts) for hz in parts[0].by_hz},
        **about,
    )
