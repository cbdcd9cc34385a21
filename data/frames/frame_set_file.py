"""Frame sets, as they are read: frames by index or slice, each read when it is asked for."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark import InputFileError, UsageError
from phasemark.data.files.hdf5_reading import dataset_of, frozen, group_of, json_attribute, reading, whole_numbers
from phasemark.data.pages.notebook import facts_html
from phasemark.data.plans.arrays import (
    FIELDS,
    FRAME_FIELDS,
    FREQUENCY_FIELDS,
    HISTOGRAM_FIELDS,
    POSE_FIELDS,
    SEQUENCE,
    TARGET_FIELDS,
    TRUTH,
    Array,
    dimension_sizes,
    frame_set_fields,
    sizes_of_scenes,
)
from phasemark.data.plans.frame_plan import FramePlan
from phasemark.data.plans.scene_frames_plan import SceneFramesPlan
from phasemark.data.stored_scene import StoredScene, open_scene
from phasemark.inputs.numbers import in_words
from phasemark.inputs.reading import first_bytes
from phasemark.render import Frames
from phasemark.render.direct import HistogramFrames, Targets

_SUFFIXES = {"m": "_m", "e-": "_e", "degree": "_rad", "1": ""}
"""Of the keys of a sample, by the units in the file."""
_MOST = 1e12
"""More electrons than any pixel holds."""

_TILT = ("pitch", "roll")
"""Absent from files of a level camera."""

Sample = dict[str, Any]


class FrameSet(StoredScene):
    """Noisy frames with their truth; made by :func:`open_frames`.

    A sequence of frames: ``frames[17]`` is a dictionary of that frame's arrays and truth, ``frames[10:20]`` the same
    with one more axis in front. Nothing is read before it is asked for. It can be pickled and used after a fork, so a
    PyTorch ``DataLoader`` takes it as it is; a context manager. ``mesh(class_name)`` returns the mesh of a class, and
    ``close()`` closes the file.

    Parameters
    ----------
    file : h5py.File
        The file, open for reading; the frame set closes it.
    path : Path
        Its name, for messages.

    Attributes
    ----------
    path : Path
        The file.
    plan : FramePlan
        The resolved plan.
    sensor : Sensor
        The camera.
    classes : tuple of str
        Names of the classes, in the order of their numbers.
    splits : tuple of str
        Names of the splits, in the order of their numbers.
    versions : dict of str to str
        Versions of the program and its libraries that wrote the file.
    truth : dict of str to (views,) array
        ``class_index``, ``distance_m``, ``delta_rad``, ``bearing_rad``, ``height_m``, ``pitch_rad``,
        ``roll_rad``, ``albedo``, ``wall_m``, ``floor_m``, ``split_index``.
    view_index : (frames,) int64
        Which view each frame shows.
    """

    WHAT = "frame set"
    FORMAT = "phasemark-frames"
    plan: FramePlan | SceneFramesPlan

    def __init__(self, file: h5py.File, path: Path) -> None:
        super().__init__(file, path)
        self._read_plan(json_attribute(file, path, "plan"))
        self.splits = tuple(self.plan.splits)
        sizes = {dim: len(dataset_of(file, dim, path)) for dim in ("frame", "view", "row", "col")}
        sizes = {**dimension_sizes(self.sensor), **sizes}
        if (sizes["row"], sizes["col"]) != (self.sensor.rows, self.sensor.cols):
            raise InputFileError(f"{path}: has {sizes['row']} × {sizes['col']} pixels, but its sensor has others")
        if sizes["view"] != self.plan.views or sizes["frame"] != self.plan.views * self.plan.frames_per_view:
            raise InputFileError(
                f"{path}: has {sizes['frame']} frames of {sizes['view']} views, its plan says otherwise"
            )
        if len(self.sensor.frequencies_hz) > 1:
            self._check_frequencies(file)
        self._arrays = self._wanted(file)
        sizes |= sizes_of_scenes(self.plan) if isinstance(self.plan, SceneFramesPlan) else {}
        self._fields = {name: self._field(file, name, array, sizes) for name, array in self._arrays.items()}
        self.view_index = frozen(self._numbers(file, "view_index", "view_index", sizes["frame"], sizes["view"]))
        self.truth = self._read_truth(file, sizes["view"])

    @classmethod
    def of_file(cls, file: h5py.File, path: Path) -> FrameSet:
        """Return the frame set of an open file: of landmarks, or of scenes."""
        if cls is FrameSet and "scenes" in json_attribute(file, path, "plan"):
            return SceneFrameSet(file, path)
        return cls(file, path)

    @property
    def arrays(self) -> tuple[str, ...]:
        """Keys of the arrays of a sample, without its truth of single numbers."""
        return tuple(_key(name) for name in self._fields)

    @property
    def holds_histograms(self) -> bool:
        """Whether histograms of a direct sensor are stored."""
        return "histogram" in self._fields

    @property
    def holds_targets(self) -> bool:
        """Whether targets of a direct sensor are stored."""
        return "target_distance" in self._fields

    def _read_plan(self, plan: dict[str, Any]) -> None:
        """Take the plan, and the names of the classes."""
        # a file's plan that does not mention histograms was written before there were any
        self.plan = FramePlan(**(plan if self.sensor.histogram is None else {"histograms": False, **plan}))
        self.classes = tuple(self.plan.landmark_names())

    def _wanted(self, file: h5py.File) -> dict[str, Array]:
        """Return the large datasets that the file must have."""
        assert isinstance(self.plan, FramePlan)
        wanted = ["range", "flags", "coverage"] + [name for name in ("amplitude", "intensity", "taps") if name in file]
        wanted += [f"range_{name}" for name in self.plan.variants]
        if len(self.sensor.frequencies_hz) > 1:
            wanted += FREQUENCY_FIELDS
        if self.plan.histograms:
            wanted += HISTOGRAM_FIELDS
        return {name: FIELDS[name] for name in wanted}

    def _check_frequencies(self, file: h5py.File) -> None:
        """Refuse frames of other frequencies than those of the sensor."""
        own = self.sensor.frequencies_hz
        found = self._column(file, "frequency", len(own))
        if not np.array_equal(found, own):
            raise InputFileError(
                f"{self.path}: 'frequency' must be {in_words(own)} Hz as its sensor has them, got {in_words(found)}"
            )

    def _field(
        self, file: h5py.File, name: str, array: Array, sizes: dict[str, int]
    ) -> tuple[tuple[int, ...], np.dtype[Any], int]:
        """Return shape, type and offset of a dataset; the offset is −1 if its values are not in one piece."""
        dims, kind, _, _ = array
        dataset = dataset_of(file, name, self.path)
        shape = tuple(sizes[dim] for dim in dims)
        if dataset.shape != shape or dataset.dtype.kind != np.dtype(kind).kind:
            raise InputFileError(
                f"{self.path}: '{name}' must be {np.dtype(kind)} of shape {shape}, got {dataset.dtype} of shape"
                f" {dataset.shape}"
            )
        offset = dataset.id.get_offset()
        if offset is not None and offset + math.prod(shape) * dataset.dtype.itemsize > file.id.get_filesize():
            raise InputFileError(f"{self.path}: cut off in '{name}'")
        return shape, dataset.dtype, -1 if offset is None else int(offset)

    def _column(self, file: h5py.File, name: str, n: int) -> NDArray[Any]:
        dataset = dataset_of(file, name, self.path)
        if dataset.shape != (n,) or dataset.dtype.kind not in "fiu":
            raise InputFileError(f"{self.path}: '{name}' must be {n} numbers, got {dataset.dtype} of {dataset.shape}")
        return np.asarray(dataset[...])

    def _numbers(self, file: h5py.File, name: str, key: str, n: int, count: int) -> NDArray[np.int64]:
        """Return n whole numbers from 0 to `count` − 1."""
        self._column(file, name, n)
        found = whole_numbers(file[name], self.path)
        if found.min() < 0 or found.max() >= count:
            raise InputFileError(f"{self.path}: '{key}' has numbers outside 0 … {count - 1}")
        return found

    def _read_truth(self, file: h5py.File, n: int) -> dict[str, NDArray[Any]]:
        truth: dict[str, NDArray[Any]] = {
            "class_index": self._numbers(file, "landmark_class", "class_index", n, len(self.classes)),
            "split_index": self._numbers(file, "split", "split_index", n, len(self.splits)),
        }
        for name in self.classes:
            group_of(file, f"meshes/{name}", self.path)
        for name, array in TRUTH.items():
            if name in _TILT and name not in file:
                truth[_key(name)] = np.zeros(n)
                continue
            values = self._column(file, name, n).astype(np.float64)
            if name not in ("wall", "floor") and not np.isfinite(values).all():
                raise InputFileError(f"{self.path}: '{name}' must be finite")
            if name == "distance" and not (values > 0).all():
                raise InputFileError(f"{self.path}: 'distance' must be positive, got {values.min():g}")
            truth[_key(name)] = np.deg2rad(values) if array.units == "degree" else values
        return {name: frozen(values) for name, values in truth.items()}

    def __len__(self) -> int:
        return len(self.view_index)

    def __getitem__(self, index: int | np.integer | slice | Sequence[int] | NDArray[np.integer]) -> Sample:
        """Return the arrays and the truth of a frame, or of several with one more axis in front.

        Keys are ``range_m``, ``amplitude_e``, ``intensity_e``, ``flags``, ``taps_e``, ``range_shot_m``, ``coverage``,
        ``range_hard_m``, ``range_mixed_m`` (those that the file has), ``view``, ``class_name`` and the truth; of
        several modulation frequencies also ``frequency_range_m``, ``frequency_amplitude_e``, ``frequency_intensity_e``
        and ``frequency_flags``, with an axis of frequencies before the rows; of histograms ``histogram``, with an axis
        of bins behind the columns, and ``target_distance_m``, ``target_sigma_m``, ``target_signal`` and
        ``target_status``, with an axis of targets.
        """
        if isinstance(index, int | np.integer):
            n = len(self)
            if not -n <= index < n:
                raise IndexError(f"frame {index} of {n}")
            numbers = np.array([int(index) % n])
        else:
            numbers = self._places(index)
        views = self.view_index[numbers]
        sample: Sample = {}
        for name in self._fields:
            sample[_key(name)] = self._checked(name, self._take(name, numbers if name in FRAME_FIELDS else views))
        sample["view"] = views
        sample |= self._truth_of(views)
        if not isinstance(index, int | np.integer):
            return sample
        return {key: values[0] if values.ndim > 1 else values[:1].tolist()[0] for key, values in sample.items()}

    def _truth_of(self, views: NDArray[np.int64]) -> Sample:
        """Return the truth of some views."""
        names = np.array(self.classes, dtype=object)[self.truth["class_index"][views]]
        return {"class_name": names, **{name: values[views] for name, values in self.truth.items()}}

    def _checked(self, name: str, values: NDArray[Any]) -> NDArray[Any]:
        """Refuse values that no run writes, as soon as they are read: other programs would take them for measured."""
        if name == "histogram":
            self._check_histograms(values)
        if values.dtype.kind != "f" or name in (*TARGET_FIELDS, *POSE_FIELDS) or name.startswith("label_"):
            return values
        if name == "frequency_range":
            periods = np.array([camera.unambiguous_range_m for camera in self.sensor.by_frequency])[:, None, None]
            wrong, limits = (values < 0) | (values > periods * (1 + 1e-6)), "NaN or from 0 to c / 2f"
        elif name.startswith("range"):
            wrong = (values < 0) | (values > self.sensor.unambiguous_range_m * (1 + 1e-6))  # float32 may round up
            limits = f"NaN or in 0 … {self.sensor.unambiguous_range_m:.4g} m"
        else:
            wrong, limits = ~(np.abs(values) < _MOST), "finite"
        if wrong.any():
            raise InputFileError(f"{self.path}: '{name}' must be {limits}, got {values[wrong][0]:g}")
        return values

    def _check_histograms(self, counts: NDArray[Any]) -> None:
        """Refuse counts that saturate: no run writes them."""
        histogram = self.sensor.histogram
        if histogram is None or not histogram.pile_up:
            return
        most = int(counts.sum(axis=-1, dtype=np.int64).max(initial=0))
        if most >= histogram.cycles:
            raise InputFileError(
                f"{self.path}: 'histogram' must have fewer than {histogram.cycles:.4g} counts in a zone, got {most}"
            )

    def _take(self, name: str, numbers: NDArray[np.integer], file: h5py.File | None = None) -> NDArray[Any]:
        """Read some rows of a dataset, in the order asked for."""
        shape, dtype, offset = self._fields[name]
        file = file or self._open()
        if offset < 0:
            wanted, back = np.unique(numbers, return_inverse=True)
            with reading(self.path):
                return np.asarray(file[name][wanted])[back] if len(wanted) else np.empty((0, *shape[1:]), dtype)
        stride = math.prod(shape[1:]) * dtype.itemsize
        out = np.empty((len(numbers), *shape[1:]), dtype)
        flat = out.reshape(len(numbers), math.prod(shape[1:]))
        descriptor = int(file.id.get_vfd_handle())
        at = 0
        while at < len(numbers):  # runs of neighbours are read at once
            stop = at + 1
            while stop < len(numbers) and numbers[stop] == numbers[stop - 1] + 1:
                stop += 1
            raw = os.pread(descriptor, (stop - at) * stride, offset + int(numbers[at]) * stride)
            if len(raw) != (stop - at) * stride:
                raise InputFileError(f"{self.path}: cut off in '{name}'")
            flat[at:stop] = np.frombuffer(raw, dtype).reshape(stop - at, flat.shape[1])
            at = stop
        return out

    def frames(self, index: slice | Sequence[int] | NDArray[np.integer] = slice(None)) -> Frames:
        """Return frames as the matcher takes them, one position each, (n, 1, rows, cols)."""
        sample = self[index]
        measured = {name: sample[name][:, None] for name in ("amplitude_e", "intensity_e") if name in sample}
        parts = []
        if len(self.sensor.frequencies_hz) > 1:
            for j, camera in enumerate(self.sensor.by_frequency):
                range_m, amplitude_e, intensity_e, flags = (sample[_key(name)][:, None, j] for name in FREQUENCY_FIELDS)
                parts.append(Frames(range_m, amplitude_e, intensity_e, flags=flags, sensor=camera))
        range_m, flags = sample["range_m"][:, None], sample["flags"][:, None]
        return Frames(range_m, **measured, flags=flags, sensor=self.sensor, by_frequency=parts)

    def histograms(self, index: slice | Sequence[int] | NDArray[np.integer] = slice(None)) -> HistogramFrames:
        """Return histograms of frames, one position each, (n, 1, rows, cols, bins).

        Raises
        ------
        UsageError
            The frame set holds no histograms.
        """
        self._refuse_without("histograms", self.holds_histograms)
        return HistogramFrames(self._numbered("histogram", index)[:, None], sensor=self.sensor)

    def targets(self, index: slice | Sequence[int] | NDArray[np.integer] = slice(None)) -> Targets:
        """Return the stored targets of frames, one position each, (n, 1, rows, cols, targets).

        Raises
        ------
        UsageError
            The frame set holds no histograms.
        """
        self._refuse_without("targets", self.holds_targets)
        distance_m, sigma_m, signal, status = (self._numbered(name, index)[:, None] for name in TARGET_FIELDS)
        return Targets(distance_m.astype(float), sigma_m.astype(float), signal.astype(float), status)

    def _places(self, index: slice | Sequence[int] | NDArray[np.integer]) -> NDArray[np.intp]:
        """Return the numbers of some frames, from 0."""
        return np.arange(len(self))[index if isinstance(index, slice) else np.asarray(index)]

    def _numbered(self, name: str, index: slice | Sequence[int] | NDArray[np.integer]) -> NDArray[Any]:
        """Return one dataset of some frames."""
        return self._checked(name, self._take(name, self._places(index)))

    def reported_quantity(self) -> Literal["range", "z"]:
        """Return the quantity that the chip reports as the distance of targets.

        Raises
        ------
        UsageError
            The frame set holds no histograms.
        """
        self._refuse_without("histograms", self.holds_histograms or self.holds_targets)
        assert self.sensor.histogram is not None
        return self.sensor.histogram.reports

    def _refuse_without(self, what: str, there: bool) -> None:
        if there:
            return
        of_scenes = isinstance(self.plan, SceneFramesPlan)
        why = f"build it with '{what}' in 'keep'" if of_scenes else "build it without 'histograms = false'"
        if self.sensor.histogram is None:
            why = "its sensor has no [histogram] table"
        raise UsageError(f"{self.path} holds no {what}: {why}")

    def view(self, number: int) -> Frames:
        """Return all frames of one view, (1, frames_per_view, rows, cols).

        Raises
        ------
        UsageError
            There is no such view.
        """
        if not 0 <= number < self.plan.views:
            raise UsageError(f"view {number} is not there: {self.path} has {self.plan.views}")
        return self.frames(np.flatnonzero(self.view_index == number)).as_one_position()

    def split(self, name: str) -> NDArray[np.int64]:
        """Return the numbers of the frames of a split, ``train`` for instance.

        Raises
        ------
        UsageError
            There is no such split.
        """
        if name not in self.splits:
            raise UsageError(f"unknown split {name!r}: {self.path} has {', '.join(self.splits)}")
        of_split = self.truth["split_index"] == self.splits.index(name)
        return np.flatnonzero(of_split[self.view_index])

    def subset(
        self,
        frames: str | Sequence[int] | NDArray[np.integer | np.bool_],
        transform: Callable[[Sample], Any] | None = None,
    ) -> FrameSubset:
        """Return some frames by number or mask, or a split by its name, as a map-style data set.

        Raises
        ------
        UsageError
            There is no such split or frame, or a mask is not of all frames.
        """
        numbers = self.split(frames) if isinstance(frames, str) else np.asarray(frames)
        if numbers.dtype == np.bool_ and numbers.shape == (len(self),):
            numbers = np.flatnonzero(numbers)
        if numbers.size and (numbers.dtype.kind not in "iu" or numbers.ndim != 1):
            raise UsageError(f"'frames' must be whole numbers or a mask of {len(self)} frames, got {frames!r}")
        beyond = numbers[(numbers < -len(self)) | (numbers >= len(self))]
        if beyond.size:
            raise UsageError(f"{self.path} has {len(self)} frames, from 0: there is no frame {beyond[0]}")
        return FrameSubset(self, numbers, transform)

    def __repr__(self) -> str:
        """Return one line with the content of the frame set, open or closed."""
        distance_m = self.truth["distance_m"]
        return (
            f"FrameSet({self.path.name}: {len(self)} frames of {self.plan.views} views; {', '.join(self.classes)};"
            f" D {distance_m.min():.3g} … {distance_m.max():.3g} m, {self.plan.sensor})"
        )

    def _repr_html_(self) -> str:
        """Show in a notebook what the frame set holds, open or closed."""
        distance_m = self.truth["distance_m"]
        return facts_html(
            f"Frame set {self.path.name}",
            {
                "frames": f"{len(self)}: {self.plan.frames_per_view} of each of {self.plan.views} views",
                "classes": ", ".join(self.classes),
                "splits": ", ".join(self.splits),
                "D": f"{distance_m.min():.3g} … {distance_m.max():.3g} m",
                "arrays": ", ".join(self._fields),
                "sensor": f"{self.plan.sensor}, {self.sensor.rows} × {self.sensor.cols} pixels",
            },
        )

    def info(self) -> dict[str, Any]:
        """Return the content of the frame set in plain numbers and text."""
        file = self._open()
        histogram = self.sensor.histogram if self.holds_histograms or self.holds_targets else None
        return {
            "path": str(self.path),
            "size_bytes": int(file.id.get_filesize()),
            "schema_version": int(file.attrs["schema_version"]),
            "frames": len(self),
            "views": self.plan.views,
            "frames_per_view": self.plan.frames_per_view,
            **self._truth_info(),
            "fields": list(self._fields),
            "seed": self.plan.seed,
            "sensor": self.plan.sensor,
            "rows": self.sensor.rows,
            "cols": self.sensor.cols,
            **({"bins": histogram.bins, "max_targets": histogram.max_targets} if histogram is not None else {}),
            **({"mesh_sha256": meshes} if (meshes := self.identity()["mesh_sha256"]) else {}),
            "versions": self.versions,
        }

    def _truth_info(self) -> dict[str, Any]:
        """Return a summary of the views in plain numbers and text."""
        of_class = np.bincount(self.truth["class_index"], minlength=len(self.classes))
        distance_m = self.truth["distance_m"]
        return {
            "views_of_class": dict(zip(self.classes, of_class.tolist(), strict=True)),
            "views_of_split": self._views_of_split(),
            "distance_m": [float(distance_m.min()), float(distance_m.max())],
        }

    def _views_of_split(self) -> dict[str, int]:
        of_split = np.bincount(self.truth["split_index"], minlength=len(self.splits))
        return dict(zip(self.splits, of_split.tolist(), strict=True))


class SceneFrameSet(FrameSet):
    """Noisy frames of scenes with their truth; made by :func:`open_frames`.

    A frame set whose views are the steps of scenes. Samples have ``sequence``, ``step``, ``split_index``, a key
    ``label_NAME`` for each label and what else is kept: ``shares`` (rows, cols, classes), ``camera2world`` (4, 4),
    ``bodies2world`` (bodies, 4, 4) and ``class_of_body`` (bodies,), NaN and −1 where there is no body.

    Attributes
    ----------
    plan : SceneFramesPlan
        The resolved plan.
    classes : tuple of str
        Classes of bodies, in the order of ``shares``.
    truth : dict of str to (views,) array
        ``sequence``, ``step``, ``split_index``, and ``label_NAME`` for each label.
    """

    plan: SceneFramesPlan

    def _read_plan(self, plan: dict[str, Any]) -> None:
        self.plan = SceneFramesPlan(**plan)
        self.classes = tuple(self.plan.scenes.classes)

    def _wanted(self, file: h5py.File) -> dict[str, Array]:
        return frame_set_fields(self.plan, self.sensor)

    def _read_truth(self, file: h5py.File, n: int) -> dict[str, NDArray[Any]]:
        counts = {"sequence": self.plan.n_scenes, "step": self.plan.scenes.steps}
        truth: dict[str, NDArray[Any]] = {name: self._numbers(file, name, name, n, counts[name]) for name in SEQUENCE}
        truth["split_index"] = self._numbers(file, "split", "split_index", n, len(self.splits))
        for name in [name for name in self._fields if name.startswith("label_")]:
            values = self._take(name, np.arange(n), file)
            del self._fields[name]
            try:
                truth[name] = np.char.decode(values, "utf-8") if values.dtype.kind == "S" else values
            except UnicodeDecodeError:
                raise InputFileError(f"{self.path}: '{name}' is not UTF-8") from None
        return {name: frozen(values) for name, values in truth.items()}

    def _truth_of(self, views: NDArray[np.int64]) -> Sample:
        return {name: values[views] for name, values in self.truth.items()}

    def _truth_info(self) -> dict[str, Any]:
        return {
            "scenes": self.plan.n_scenes,
            "steps": self.plan.scenes.steps,
            "generator": self.plan.scenes.generator or f"{len(self.plan.scenes.list)} files",
            "classes": list(self.classes),
            "labels": [name.removeprefix("label_") for name in self.truth if name.startswith("label_")],
            "views_of_split": self._views_of_split(),
        }

    def identity(self) -> dict[str, Any]:
        """Return everything that the file's bytes depend on: resolved plan and versions."""
        return {"plan": json_attribute(self._open(), self.path, "plan"), "versions": self.versions, "mesh_sha256": {}}

    def mesh(self, class_name: str) -> trimesh.Trimesh:
        """Refuse: a set of scenes holds no meshes."""
        raise UsageError(f"{self.path}: is of scenes, and holds no mesh of '{class_name}'")

    def __repr__(self) -> str:
        """Return one line with the content of the frame set, open or closed."""
        return (
            f"FrameSet({self.path.name}: {len(self)} frames of {self.plan.n_scenes} scenes of {self.plan.scenes.steps}"
            f" steps; {', '.join(name for name in self.truth if name.startswith('label_'))}, {self.plan.sensor})"
        )

    def _repr_html_(self) -> str:
        return facts_html(f"Frame set {self.path.name}", {**self._truth_info(), "arrays": ", ".join(self._fields)})


class FrameSubset:
    """Some frames of a frame set, as a map-style data set: ``len()`` and ``[i]``; it can be pickled.

    Parameters
    ----------
    frames : FrameSet
        The frame set.
    numbers : (n,) int array
        Which frames, in which order.
    transform : callable, optional
        What to make of each sample; a function of a module, if it is to be pickled.
    """

    def __init__(
        self, frames: FrameSet, numbers: NDArray[np.integer], transform: Callable[[Sample], Any] | None = None
    ) -> None:
        self.frames, self.numbers, self.transform = frames, numbers, transform

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int) -> Any:
        sample = self.frames[int(self.numbers[index])]
        return sample if self.transform is None else self.transform(sample)


def _key(name: str) -> str:
    """Return the key of a sample that holds a dataset of the file."""
    return f"{name}{_SUFFIXES[{**FIELDS, **TRUTH}[name].units]}"


def open_frames(path: str | os.PathLike[str], *, untrusted: bool = False) -> FrameSet:
    """Open a frame set.

    Parameters
    ----------
    path : path-like
        The file.
    untrusted : bool
        Whether a child process with limits reads the file first, unless ``FILE.sha256`` vouches for it.

    Returns
    -------
    FrameSet
        A context manager; close it or leave the block when done.

    Raises
    ------
    InputFileError
        The file cannot be read, is not a frame set, was made by a newer version, or is damaged.
    """
    return open_scene(FrameSet, path, untrusted=untrusted)


def is_frame_set(path: str | os.PathLike[str]) -> bool:
    """Return whether a file says that it is a frame set; what it says of itself is all that is looked at.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    bool
        False also if the file cannot be read.
    """
    start = first_bytes(path, 1 << 16)
    return start.startswith(b"\x89HDF\r\n\x1a\n") and FrameSet.FORMAT.encode() in start
