"""Banks of model images, as they are built: a job of shards, each rendered and placed in the file on its own.

Banks that are built as they are needed are kept in the user's cache folder under what they are made of.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError, OutputExistsError, StorageError, UsageError
from phasemark.data.bank.bank_file import Bank, open_bank
from phasemark.data.files.hdf5_layout import Layout
from phasemark.data.files.same_file import named_files
from phasemark.data.plans.arrays import (
    IMAGE_ARRAYS,
    LAYOUT_GROUPS,
    PHASOR_DIMS,
    VIEW_DIMS,
    GroupName,
    bank_frequencies_hz,
    group_rows,
    refuse_too_many,
)
from phasemark.data.plans.bank_plan import BankPlan, factored_refusal
from phasemark.data.progress import Progress
from phasemark.data.scene_job import Landmark, SceneJob, StoredMesh, make_scale, read_landmarks, reserve_array
from phasemark.data.shards.build import Place
from phasemark.data.shards.run import produce, refuse_unwritable_output
from phasemark.landmarks import build_mesh
from phasemark.landmarks.spec import Revolution
from phasemark.render import PhasorImages, Renderer, Sensor, Views
from phasemark.render.integral.area_integral import Variant
from phasemark.render.planar import PlanarLandmark, planar_images

ImagesOf = Callable[[Views], PhasorImages]
_MOST_BYTES = 1 << 30
"""Banks that were not used for longest are thrown away where all together are larger."""


def build_bank(
    plan: BankPlan | Mapping[str, Any],
    path: str | os.PathLike[str] | None = None,
    *,
    force: bool = False,
    resume: bool = False,
    workers: int | None = None,
    shard_items: int | None = None,
    scheduler: str = "threads",
    progress: Progress | None = None,
) -> Bank:
    """Render a bank of noise-free model images and write it with its checksum.

    The same plan gives the same bytes, whatever the number of workers. Memory does not grow with the bank. A run that
    was ended early leaves ``FILE.partial`` and ``FILE.manifest`` beside the file if anything was finished. Its size has
    no limit here: :func:`phasemark.data.plans.planned_size` says beforehand how large it gets.

    Parameters
    ----------
    plan : BankPlan or mapping
        Plan of the bank, or its fields by name.
    path : path-like, optional
        The file to write; ``FILE.sha256`` goes beside it. None: a temporary file, gone once the bank is closed.
    force : bool
        Whether an existing file may be replaced, and an unfinished run of it thrown away.
    resume : bool
        Whether to continue an unfinished run; a finished bank of the same plan is opened as it is.
    workers : int, optional
        Threads that render. None: one for each processor this process may use.
    shard_items : int, optional
        Images rendered at a time; the result does not depend on it.
    scheduler : str
        ``threads``, or the address of a Dask scheduler.
    progress : callable (done, total), optional
        Called from this thread with the number of images rendered so far and in all.

    Returns
    -------
    Bank
        The bank, open for reading.

    Raises
    ------
    UsageError
        The plan cannot be built, with the reason.
    InputFileError
        A mesh or sensor file cannot be read.
    OutputExistsError
        The bank exists, another run is writing it, or an unfinished run had another plan.
    StorageError
        The disk is full or fails.
    """
    if isinstance(plan, Mapping):
        plan = BankPlan(**plan)
    if not isinstance(plan, BankPlan):
        raise UsageError(f"'plan' must be a BankPlan or its fields by name, got {plan!r}")
    if path is None:
        with TemporaryDirectory(prefix="phasemark-") as folder:
            # The open file outlives its name.
            return build_bank(plan, Path(folder) / "bank.h5", workers=workers, progress=progress)
    refuse_unwritable_output(Path(path), force=force, resume=resume, inputs=named_files(plan.model_dump()))
    job = BankJob(plan)
    produce(
        job, path, finished=job.finished_identity, force=force, resume=resume, workers=workers,
        shard_items=shard_items, scheduler=scheduler, progress=progress,
    )  # fmt: skip
    return open_bank(path)


def cached_bank(plan: BankPlan, *, keep: bool = True, progress: Progress | None = None) -> Bank:
    """Return a bank of a plan: the one that was kept, or a new one.

    A bank is found again by what its bytes depend on: the contents of its meshes, the sensor, the grid and the versions
    of the program and its libraries. One that is damaged is built again. Where nothing can be kept, because the folder
    is full, read-only, or used by another run, the bank is a temporary one.

    Parameters
    ----------
    plan : BankPlan
    keep : bool
        Whether to look for a kept bank, and to keep a new one.
    progress : callable (done, total), optional
        As for :func:`~phasemark.data.build_bank`.

    Raises
    ------
    UsageError, InputFileError
        As :func:`~phasemark.data.build_bank`.
    """
    folder = _cache_folder()
    if not keep or folder is None:
        return build_bank(plan, progress=progress)
    path = folder / "banks" / f"{_key(plan)}.h5"
    with suppress(InputFileError):
        bank = open_bank(path)
        with suppress(OSError):
            os.utime(path)
        return bank
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        bank = build_bank(plan, path, force=True, progress=progress)
    except (OSError, OutputExistsError, StorageError):
        return build_bank(plan, progress=progress)
    _prune(path)
    return bank


def _cache_folder() -> Path | None:
    """Return the folder of this program in the user's cache folder; None if there is no cache folder."""
    folder = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(folder) / "phasemark" if os.path.isabs(folder) else None


def _key(plan: BankPlan) -> str:
    """Return a name for all that a bank's bytes depend on, wherever its mesh files lie."""
    identity = BankJob(plan).identity()
    for mesh in identity["plan"]["meshes"]:
        del mesh["path"]
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:32]


def _prune(newest: Path) -> None:
    """Throw away the banks that were not used for longest, until the others are small enough."""
    with suppress(OSError):
        total = 0
        for path in sorted(newest.parent.glob("*.h5"), key=lambda path: path.stat().st_mtime, reverse=True):
            total += path.stat().st_size
            if total > _MOST_BYTES and path != newest:
                path.unlink()
                path.with_name(path.name + ".sha256").unlink(missing_ok=True)


def rebuild_bank(
    bank: Bank,
    *,
    distance_m: Sequence[float],
    delta_deg: Sequence[float],
    classes: Sequence[str] | None = None,
    sensor: Sensor | None = None,
) -> Bank:
    """Build a bank of the same landmarks on another grid, or for another camera, in a temporary file.

    Parameters
    ----------
    bank : Bank
        Its meshes are used; mesh files that its plan names are not read again.
    distance_m, delta_deg : sequence of float
        The new grid.
    classes : sequence of str, optional
        Which of its landmarks; None: all.
    sensor : Sensor, optional
        The new camera; None: the bank's own.

    Returns
    -------
    Bank
        Open for reading; its file is gone once it is closed. Its layout is "full".

    Raises
    ------
    UsageError
        The grid or the camera cannot be rendered, with the reason.
    """
    old = bank.plan.model_dump(mode="json")
    if sensor is not None:  # it sees the images themselves
        old |= {"region": "whole", "binning": 1}
    kept = set(bank.classes if classes is None else classes)
    plan = BankPlan(
        **{
            **old,
            **{key: [part for part in old[key] if part["name"] in kept] for key in ("landmarks", "meshes")},
            "distance_m": tuple(distance_m),
            "delta_deg": tuple(delta_deg),
            "sensor_overrides": (sensor or bank.camera).model_dump(mode="json"),
            "layout": "full",
        }
    )
    with TemporaryDirectory(prefix="phasemark-") as folder:
        path = Path(folder) / "bank.h5"
        job = BankJob(plan, bank.mesh)
        produce(job, path, finished=job.finished_identity)
        return open_bank(path)


@dataclass(frozen=True)
class _Slab:
    """Images that lie one behind the other in a group: those of one class, or of all."""

    group: GroupName
    first: int
    views: Views
    images_of: ImagesOf
    renderer: Renderer | None


class BankJob(SceneJob[BankPlan]):
    """A bank to be built: one slab of images for each class or part.

    Parameters
    ----------
    plan : BankPlan
    stored_mesh : callable, optional
        Returns the mesh of a class, in place of the mesh file that the plan names.
    """

    KIND, STORED, fields = "bank", Bank, tuple(IMAGE_ARRAYS)

    def __init__(self, plan: BankPlan, stored_mesh: StoredMesh | None = None) -> None:
        plan = plan.resolve()
        _refuse_impossible(plan)
        super().__init__(plan, plan.image_sensor(), read_landmarks(plan.landmarks, plan.meshes, stored_mesh))
        self._slabs = list(_slabs(self.plan, self.sensor, self.landmarks))

    @property
    def items(self) -> list[int]:
        """Images of each slab."""
        return [len(slab.views) for slab in self._slabs]

    def whole_images(self) -> list[ImagesOf]:
        """Return a renderer of whole images for each class, whatever parts the bank holds."""
        rows = (0, self.sensor.rows)
        return [_images_of(self.plan, self.sensor, landmark, "both", rows)[0] for landmark in self.landmarks]

    def check_views(self) -> None:
        """Refuse a plan with views that cannot be rendered, before any is.

        Raises
        ------
        UsageError
            Naming the view.
        """
        for slab in self._slabs:
            if slab.renderer is not None:
                slab.renderer.check_can_be_seen(slab.views.in_camera(self.sensor), None)

    def attributes(self) -> dict[str, str]:
        """Return layout and model."""
        return {"layout": self.plan.layout, "model": self.plan.model}

    def lay_out_arrays(self, layout: Layout) -> list[list[Place]]:
        """Write coordinates, and return for each slab where phasor, intensity and coverage go."""
        places: dict[tuple[GroupName, str], Place] = {}
        for name in LAYOUT_GROUPS[self.plan.layout]:
            group = layout.file.create_group(name)
            known = self._coordinates(name)
            scales = {dim: make_scale(group, dim, *known[dim]) for dim in (*VIEW_DIMS[name], *PHASOR_DIMS)}
            for field, array in IMAGE_ARRAYS.items():
                of_views = array._replace(dims=(*VIEW_DIMS[name], *array.dims))
                _, places[name, field] = reserve_array(layout, group, scales, field, of_views, len(VIEW_DIMS[name]))
        return [[places[slab.group, field].moved(slab.first) for field in self.fields] for slab in self._slabs]

    def _coordinates(self, name: GroupName) -> dict[str, tuple[Any, str, str]]:
        """Return values, units and long name of every dimension a group can have."""
        plan, sensor = self.plan, self.sensor
        frequencies_hz = np.array(bank_frequencies_hz(sensor, plan.harmonics))
        row, col = np.arange(*group_rows(name, sensor), dtype=np.int32), np.arange(sensor.cols, dtype=np.int32)
        return {
            "landmark_class": ([landmark.name for landmark in self.landmarks], "", "landmark class"),
            "distance": (np.array(plan.distance_m), "m", "horizontal distance from the lens to the landmark's axis"),
            "delta": (np.array(plan.delta_deg), "degree", "angle from which the landmark is seen"),
            "frequency": (frequencies_hz, "Hz", "harmonic order times modulation frequency"),
            "row": (row, "1", "pixel row, 0 at the top"),
            "col": (col, "1", "pixel column, 0 on the left"),
            "iq": (["i", "q"], "", "real and imaginary part"),
        }

    def make(self, slab: int, start: int, stop: int) -> list[NDArray[Any]]:
        """Render some images of a slab."""
        job = self._slabs[slab]
        stored = _stored(job.images_of(job.views[start:stop]))
        return [stored[field] for field in self.fields]

    def read(self, file: h5py.File, slab: int, item: int) -> dict[str, NDArray[Any]]:
        """Return one image of a file in the form of :meth:`make`."""
        at = self._slabs[slab]
        group = file[at.group]
        n_dims = len(VIEW_DIMS[at.group])
        place = np.unravel_index(at.first + item, group["phasor"].shape[:n_dims])
        return {field: group[field][tuple(int(k) for k in place)] for field in self.fields}


def _slabs(plan: BankPlan, sensor: Sensor, landmarks: list[Landmark]) -> Iterator[_Slab]:
    distance_m, delta_rad = np.array(plan.distance_m), plan.delta_rad
    by_angle = Views.broadcast(distance_m[:, None], delta_rad)
    facing = Views.broadcast(distance_m)  # a solid of revolution looks the same from every side
    jobs: list[tuple[GroupName, Literal["both", "lower", "upper"], Views, list[Landmark]]] = [
        ("full", "both", by_angle, landmarks),
        ("lower", "lower", by_angle, landmarks[:1]),
        ("upper", "upper", facing, landmarks),
    ]
    for group, part, views, shown in jobs:
        if group in LAYOUT_GROUPS[plan.layout]:
            for k, landmark in enumerate(shown):
                images_of, renderer = _images_of(plan, sensor, landmark, part, group_rows(group, sensor))
                yield _Slab(group, k * len(views), views, images_of, renderer)


def _refuse_impossible(plan: BankPlan) -> None:
    refuse_too_many(plan)
    reason = factored_refusal(plan) if plan.layout == "factored" else None
    if reason is not None:
        raise UsageError(f"no factored bank: {reason}; build a full one (layout='full')")
    if plan.model == "planar" and plan.meshes:
        raise UsageError(
            f"'model' must be 'ray' or 'hard' for '{plan.meshes[0].name}', which comes from a mesh file, got 'planar'"
        )


def _images_of(
    plan: BankPlan,
    sensor: Sensor,
    landmark: Landmark,
    part: Literal["both", "lower", "upper"],
    rows: tuple[int, int],
) -> tuple[ImagesOf, Renderer | None]:
    """Return the function that makes the model images of a landmark or one of its parts on some rows, and its renderer.

    The planar model has none.
    """
    if plan.model == "planar":
        assert landmark.spec is not None  # _refuse_impossible has seen to it
        box, upper = landmark.spec.box, landmark.spec.upper
        profile = upper.profile_m if isinstance(upper, Revolution) else () if upper is None else upper.radius_at_m
        outline = PlanarLandmark(box.length_m, box.width_m, profile)  # as the paper's generator describes it
        return lambda views: planar_images(
            outline, sensor, views, albedo=landmark.albedo, harmonics=plan.harmonics, rows=rows
        ), None
    mesh = landmark.mesh if landmark.spec is None else build_mesh(landmark.spec, part=part)
    renderer = Renderer(mesh, sensor, albedo=landmark.albedo, harmonics=plan.harmonics)
    variant: Variant = "hard" if plan.model == "hard" else "exact"
    return lambda views: renderer.render_views(views, rows=rows, variant=variant), renderer


def _stored(images: PhasorImages) -> dict[str, NDArray[np.float32]]:
    """Return images as the bank's datasets hold them, views first."""
    frequencies = bank_frequencies_hz(images.sensor, sorted(images.harmonics))
    phasor = np.stack([images.at_frequency(hz) for hz in frequencies], axis=1).astype("<c8")
    stored = {
        "phasor": phasor.view("<f4").reshape(*phasor.shape, 2),
        "intensity": images.intensity.astype("<f4"),
        "coverage": images.coverage.astype("<f4"),
    }
    for name, values in stored.items():
        if not np.isfinite(values).all():
            raise FloatingPointError(f"the renderer returned a {name} that is not finite")
    return stored
