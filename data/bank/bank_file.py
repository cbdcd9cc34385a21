"""Banks of model images, as they are read: schema, checks, and whole arrays for a matcher."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError, UsageError
from phasemark.data.files.hdf5_reading import dataset_of, frozen, group_of, json_attribute, reading
from phasemark.data.pages.notebook import facts_html
from phasemark.data.plans.arrays import IMAGE_ARRAYS, LAYOUT_GROUPS, PHASOR_DIMS, VIEW_DIMS, GroupName, group_rows
from phasemark.data.plans.bank_plan import BankPlan
from phasemark.data.plans.grid_axis import format_grid
from phasemark.data.stored_scene import StoredScene, open_scene
from phasemark.inputs.numbers import in_words
from phasemark.render import PhasorImages, Sensor, Views

_IMAGES = ("_phasors", "intensity", "coverage")
_PART_BYTES = 1 << 24


class BankGroup:
    """The images of one group; read-only arrays, each read from the file when it is first asked for.

    ``views`` below stands for (distance, delta) in `lower`, (class, distance) in `upper` and (class, distance, delta)
    in `full`.

    Parameters
    ----------
    name : {"lower", "upper", "full"}
        Name of the group.
    group : h5py.Group
        Group of the file.
    path : Path
        Name of the file, for messages.
    sensor : Sensor
        The camera.

    Attributes
    ----------
    distance_m, delta_rad : (n,) float64
        The grids; `delta_rad` is empty in `upper`, which does not depend on it.
    row, col : (rows,), (cols,) int64
        Which pixels of the sensor the images hold.
    frequency_hz : (k,) float64
        At which frequencies phasors are held, rising.
    order : (k,) int64
        Harmonic orders, 1 first: these frequencies as multiples of the sensor's first one. 0 where one is none.
    classes : tuple of str
        Class names; empty in `lower`, which all classes share.
    """

    def __init__(self, name: GroupName, group: h5py.Group, path: Path, sensor: Sensor) -> None:
        self._group, self._path = group, path
        self._which: tuple[slice, ...] = ()
        self.name: GroupName = name
        view_dims = VIEW_DIMS[name]
        coordinates = {dim: self._coordinate(dim) for dim in (*view_dims, *PHASOR_DIMS)}
        sizes = {dim: len(values) for dim, values in coordinates.items()}
        for field, array in IMAGE_ARRAYS.items():
            dataset = dataset_of(group, field, self._path)
            expected = tuple(sizes[dim] for dim in (*view_dims, *array.dims))
            if dataset.shape != expected or dataset.dtype.kind != "f":
                raise InputFileError(
                    f"{path}: '{name}/{field}' must be floats of shape {expected},"
                    f" got {dataset.dtype} of shape {dataset.shape}"
                )
        self.distance_m: NDArray[np.float64] = frozen(coordinates["distance"])
        self.delta_rad: NDArray[np.float64] = frozen(np.deg2rad(coordinates.get("delta", np.empty(0))))
        self.row: NDArray[np.int64] = frozen(coordinates["row"].astype(np.int64))
        self.col: NDArray[np.int64] = frozen(coordinates["col"].astype(np.int64))
        self.frequency_hz: NDArray[np.float64] = frozen(coordinates["frequency"])
        multiple = self.frequency_hz / sensor.frequencies_hz[0]
        order = np.rint(multiple).astype(int)
        if len(sensor.frequencies_hz) > 1:
            order = np.where(np.isclose(multiple, order, rtol=1e-9), order, 0)
        self.order: NDArray[np.int64] = frozen(order)
        self.classes: tuple[str, ...] = tuple(coordinates.get("landmark_class", np.empty(0)).tolist())
        self._check_coordinates(sensor)

    @property
    def n_views(self) -> tuple[int, ...]:
        """How many classes, distances and angles the views have, in the order of the arrays."""
        sizes = {"distance": len(self.distance_m), "delta": len(self.delta_rad), "landmark_class": len(self.classes)}
        return tuple(sizes[dim] for dim in VIEW_DIMS[self.name])

    def part(self, *which: slice) -> BankGroup:
        """Return the group with some of its views alone, whose images it reads when they are asked for.

        Parameters
        ----------
        *which : slice
            Along the first axes of the views. The grids and classes stay those of the whole group.
        """
        some: BankGroup = object.__new__(type(self))
        held = {name: value[which] if name in _IMAGES else value for name, value in vars(self).items()}
        some.__dict__.update(held, _which=which)
        return some

    def parts(self) -> Iterator[tuple[tuple[slice, ...], BankGroup]]:
        """Yield all views in order, some at a time with their places, so that only those are held in memory."""
        *outer, rows, last = self.n_views
        images = (len(self.frequency_hz) * 2 + 2) * len(self.row) * len(self.col)
        at_once = max(_PART_BYTES // (4 * last * images), 1)
        for index in np.ndindex(*outer):
            for first in range(0, rows, at_once):
                which = (*(slice(k, k + 1) for k in index), slice(first, min(first + at_once, rows)))
                yield which, self.part(*which)

    @property
    def phasor(self) -> NDArray[np.complex64]:
        """S_1 (PHYSICS section 3) at the sensor's first modulation frequency, (views, row, col)."""
        return self.harmonic(1)

    def harmonic(self, order: int) -> NDArray[np.complex64]:
        """Return S_k of one harmonic order, (views, row, col).

        Raises
        ------
        UsageError
            The bank does not hold the order.
        """
        index = np.flatnonzero(self.order == order)
        if not index.size:
            known = ", ".join(str(k) for k in self.order if k)
            raise UsageError(f"{self._path}: has no harmonic {order}, only {known}")
        return self._phasors[..., index[0], :, :]

    def at_frequency(self, hz: float) -> NDArray[np.complex64]:
        """Return S at one frequency, (views, row, col).

        Raises
        ------
        UsageError
            The bank does not hold the frequency.
        """
        index = np.flatnonzero(np.isclose(self.frequency_hz, hz, rtol=1e-9, atol=0))
        if not index.size:
            raise UsageError(f"{self._path}: has no phasors at {hz:.12g} Hz, only at {in_words(self.frequency_hz)} Hz")
        return self._phasors[..., index[0], :, :]

    @cached_property
    def intensity(self) -> NDArray[np.float32]:
        """Mean amplitude, (views, row, col)."""
        return frozen(self._read("intensity"))

    @cached_property
    def coverage(self) -> NDArray[np.float32]:
        """Share of the pixel that sees the landmark, 0 … 1, (views, row, col)."""
        coverage = self._read("coverage")
        # how far a coverage may lie outside 0 … 1: more than any error of the integral, less than damage
        coverage_slack = 0.01
        outside = coverage[(coverage < -coverage_slack) | (coverage > 1 + coverage_slack)]
        if outside.size:
            raise InputFileError(f"{self._path}: '{self.name}/coverage' must be in 0 … 1, got {outside.flat[0]:g}")
        return frozen(coverage)

    @cached_property
    def _phasors(self) -> NDArray[np.complex64]:
        return frozen(self._read("phasor").view(np.complex64)[..., 0])

    def _read(self, name: str) -> NDArray[np.float32]:
        with reading(self._path):
            values = np.ascontiguousarray(self._group[name][self._which], dtype=np.float32)
        if not np.isfinite(values).all():
            raise InputFileError(f"{self._path}: '{self.name}/{name}' must be finite, got NaN or infinity")
        return values

    def _coordinate(self, name: str) -> NDArray[Any]:
        dataset = dataset_of(self._group, name, self._path)
        is_text = name in ("landmark_class", "iq")
        if dataset.ndim != 1 or not dataset.size or (dataset.dtype.kind == "O") != is_text:
            raise InputFileError(
                f"{self._path}: '{self.name}/{name}' must be one row of {'text' if is_text else 'numbers'}"
            )
        return np.asarray(dataset.asstr()[...] if is_text else dataset[...].astype(np.float64))

    def _check_coordinates(self, sensor: Sensor) -> None:
        wrong = {
            "distance": self.distance_m[0] <= 0 or not _increases(self.distance_m),
            "delta": not _increases(self.delta_rad),
            "row": not np.array_equal(self.row, np.arange(*group_rows(self.name, sensor))),
            "col": not np.array_equal(self.col, np.arange(sensor.cols)),
            "frequency": self._lacks_frequencies(sensor),
            "iq": self._group["iq"].shape != (2,),
            "landmark_class": len(set(self.classes)) < len(self.classes),
        }
        for name, is_wrong in wrong.items():
            if is_wrong:
                raise InputFileError(f"{self._path}: the values of '{self.name}/{name}' do not belong in a bank")

    def _lacks_frequencies(self, sensor: Sensor) -> bool:
        """Return whether the phasors are not those of the sensor's modulation frequencies and of some harmonics."""
        if len(sensor.frequencies_hz) == 1:
            return bool(self.order[0] != 1 or not _increases(self.order))
        held = self.frequency_hz
        missing = [hz for hz in sensor.frequencies_hz if not np.isclose(held, hz, rtol=1e-9, atol=0).any()]
        return bool(missing) or not _increases(held)


class Bank(StoredScene):
    """Model images over distance, angle and class; made by :func:`open_bank`, and a context manager.

    ``mesh(class_name)`` returns the mesh of a class, and ``close()`` closes the file.

    Parameters
    ----------
    file : h5py.File
        Open for reading; the bank closes it.
    path : Path
        Its name, for messages.

    Attributes
    ----------
    sensor : Sensor
        The camera that sees the images; with a region, `camera` read in it.
    camera : Sensor
        The whole camera, whose frames are matched.
    region : Region or None
        Which pixels of it the images hold, and in what blocks; None: every one.
    plan : BankPlan
        The resolved plan the bank was made from.
    layout : {"factored", "full"}
        Whether images of lower and upper parts are stored separately.
    classes : tuple of str
        Names of the classes, in the order of their numbers.
    distance_m : (n_distance,) float64
        Grid of distances, metres.
    delta_rad : (n_delta,) float64
        Grid of viewing angles, radians.
    lower, upper : BankGroup or None
        The groups of a factored bank.
    full : BankGroup or None
        The group of a full bank.
    versions : dict of str to str
        What the bank was made with.
    """

    WHAT = "bank"
    FORMAT = "phasemark-bank"
    plan: BankPlan

    def __init__(self, file: h5py.File, path: Path) -> None:
        super().__init__(file, path)
        self.plan = BankPlan(**json_attribute(file, path, "plan"))
        self.region = self.plan.pixel_region()
        self.camera = self.sensor if self.region is None else self.plan.build_sensor()
        self.layout = self.plan.layout
        groups: dict[str, BankGroup] = {
            name: BankGroup(name, group_of(file, name, path), path, self.sensor) for name in LAYOUT_GROUPS[self.layout]
        }
        self.lower, self.upper, self.full = groups.get("lower"), groups.get("upper"), groups.get("full")
        classed = self.full or self.upper
        angled = self.full or self.lower
        assert classed is not None
        assert angled is not None
        self.classes = classed.classes
        self.distance_m, self.delta_rad = angled.distance_m, angled.delta_rad
        if not np.array_equal(classed.distance_m, angled.distance_m):
            raise InputFileError(f"{path}: 'lower/distance' and 'upper/distance' must agree")
        for name in self.classes:
            group_of(file, f"meshes/{name}", path)

    def __repr__(self) -> str:
        """Return one line with the content of the bank, open or closed."""
        delta_deg = np.degrees(self.delta_rad)
        return (
            f"Bank({self.path.name}: {', '.join(self.classes)}; D {self.distance_m[0]:g} … {self.distance_m[-1]:g} m"
            f" × {len(self.distance_m)}, δ {delta_deg[0]:g} … {delta_deg[-1]:g}° × {len(delta_deg)}, {self.layout},"
            f" {self.plan.sensor})"
        )

    def _repr_html_(self) -> str:
        """Show in a notebook what the bank holds, open or closed."""
        delta_deg = np.degrees(self.delta_rad)
        return facts_html(
            f"Bank {self.path.name}",
            {
                "layout": self.layout,
                "classes": ", ".join(self.classes),
                "D": f"{self.distance_m[0]:g} … {self.distance_m[-1]:g} m, {len(self.distance_m)} values",
                "δ": f"{delta_deg[0]:g} … {delta_deg[-1]:g}°, {len(delta_deg)} values",
                "sensor": f"{self.plan.sensor}, {self.sensor.rows} × {self.sensor.cols} pixels",
            },
        )

    def phasor(self, class_name: str, i: int, j: int, hz: float | None = None) -> NDArray[np.complex64]:
        """Return S of one model image, (rows, cols), at ``distance_m[i]`` and ``delta_rad[j]``.

        Parameters
        ----------
        class_name : str
            Name of the class.
        i, j : int
            Indices of the distance and of the angle.
        hz : float, optional
            Modulation frequency; None: the sensor's first.

        Raises
        ------
        UsageError
            The bank does not have the class or the frequency.
        """
        return self._image("phasor", class_name, i, j, hz)

    def image(self, class_name: str, i: int, j: int) -> PhasorImages:
        """Return one model image with intensity and coverage, at ``distance_m[i]`` and ``delta_rad[j]``.

        Raises
        ------
        UsageError
            The bank does not have the class.
        """
        return PhasorImages(
            phasor=self._image("phasor", class_name, i, j)[None].astype(np.complex128),
            intensity=self._image("intensity", class_name, i, j)[None].astype(np.float64),
            coverage=self._image("coverage", class_name, i, j)[None].astype(np.float64),
            sensor=self.sensor,
            views=Views.broadcast(self.distance_m[i], self.delta_rad[j]),
            by_hz={
                hz: self._image("phasor", class_name, i, j, hz)[None].astype(np.complex128)
                for hz in self.sensor.frequencies_hz[1:]
            },
        )

    def info(self) -> dict[str, Any]:
        """Return the content of the bank in plain numbers and text."""
        groups = [group for group in (self.lower, self.upper, self.full) if group is not None]
        file = self._open()
        return {
            "path": str(self.path),
            "size_bytes": int(file.id.get_filesize()),
            "schema_version": int(file.attrs["schema_version"]),
            "layout": self.layout,
            "model": self.plan.model,
            "classes": list(self.classes),
            "distance_m": format_grid(self.distance_m),
            "n_distance": len(self.distance_m),
            "delta_deg": format_grid(self.plan.delta_deg or ()),
            "n_delta": len(self.delta_rad),
            "images": {group.name: int(np.prod(file[group.name]["phasor"].shape[:-4])) for group in groups},
            "sensor": self.plan.sensor,
            "rows": self.sensor.rows,
            "cols": self.sensor.cols,
            **self._region_info(),
            **self._kind_info(groups[0]),
            "mesh_sha256": self.identity()["mesh_sha256"],
            "versions": self.versions,
        }

    def _kind_info(self, group: BankGroup) -> dict[str, Any]:
        """Return how the camera measures; a direct one has no modulation, and the one in its file is the model's."""
        if self.sensor.kind == "phase":
            return {"harmonics": [k for k in group.order.tolist() if k], "modulation_hz": self.sensor.modulation_hz}
        histogram = self.sensor.histogram
        names = ("bins", "bin_width_m", "max_targets", "min_separation_m") if histogram is not None else ()
        stated = {name: getattr(self.sensor, name) for name in ("kind", "quantity", "max_range_m")}
        return stated | {name: getattr(histogram, name) for name in names}

    def _region_info(self) -> dict[str, Any]:
        """Return which pixels of the camera the images hold; nothing where it is every one."""
        if self.region is None:
            return {}
        first_row, stop_row, first_col, stop_col, binning = self.region
        rows, cols = f"rows {first_row} … {stop_row}", f"columns {first_col} … {stop_col}"
        return {"region": f"{rows}, {cols} of {self.camera.rows} × {self.camera.cols}", "binning": binning}

    def _image(self, field: str, class_name: str, i: int, j: int, hz: float | None = None) -> NDArray[Any]:
        k = self._class_index(class_name)

        def images(group: BankGroup | None) -> NDArray[Any]:
            return np.asarray(getattr(group, field) if hz is None or group is None else group.at_frequency(hz))

        if self.full is not None:
            return np.asarray(images(self.full)[k, i, j])
        return np.concatenate([images(self.upper)[k, i], images(self.lower)[i, j]])


def open_bank(path: str | os.PathLike[str], *, untrusted: bool = False) -> Bank:
    """Open a bank.

    Parameters
    ----------
    path : path-like
        The file.
    untrusted : bool
        Whether a child process with limits reads the file first, unless ``FILE.sha256`` vouches for it.

    Returns
    -------
    Bank
        A context manager; close it or leave the block when done.

    Raises
    ------
    InputFileError
        The file cannot be read, is not a bank, was made by a newer version, or is damaged.
    """
    return open_scene(Bank, path, untrusted=untrusted)


def _increases(values: NDArray[Any]) -> bool:
    return bool(np.isfinite(values).all() and np.all(np.diff(values) > 0))
