"""Verification of a bank or a frame set: checksum, schema, values, and some images rendered again."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError, UsageError
from phasemark.data.bank.bank_file import Bank
from phasemark.data.bank.build_bank import BankJob
from phasemark.data.files.hdf5_reading import reading
from phasemark.data.files.provenance import mesh_sha256
from phasemark.data.frames.build_frames import frames_job
from phasemark.data.frames.frame_set_file import FrameSet, SceneFrameSet
from phasemark.data.frames.frames_job import FramesJob
from phasemark.data.frames.scene_frames_job import SceneFramesJob
from phasemark.data.plans.arrays import HISTOGRAM_FIELDS
from phasemark.data.scene_job import SceneJob, StoredMesh
from phasemark.data.seeds import stream
from phasemark.data.stored_scene import StoredScene, open_scene
from phasemark.inputs import verify_checksum
from phasemark.render.phasor_images import wrap_difference_m

TOLERANCE_M = 1e-5
"""Embree and the C library differ by instruction set; ranges made elsewhere agree to this."""
TOLERANCE = 1e-5
"""The same for phasors, intensities and coverages, of the brightest pixel."""
_BLOCK_BYTES = 1 << 24
_MAY_BE_NAN = ("wall", "floor", "target_distance", "target_sigma", "bodies2world")
_NOISY = ("range", "amplitude", "intensity", "taps", "range_shot", *HISTOGRAM_FIELDS)


def verify_bank(path: str | os.PathLike[str], *, sample: int = 16, seed: int = 0) -> dict[str, Any]:
    """Check a bank: its checksum before it is opened, then schema, shapes and values, then images rendered again.

    Parameters
    ----------
    path : path-like
        The bank, with ``FILE.sha256`` beside it.
    sample : int
        How many random images to render again.
    seed : int
        Which of them: the same seed takes the same ones.

    Returns
    -------
    dict
        What was checked, in plain numbers and text.

    Raises
    ------
    InputFileError
        Naming the first thing that is wrong.
    """
    return _verify(Path(path), Bank, BankJob, sample, seed)


def verify_frames(
    path: str | os.PathLike[str], *, sample: int = 16, seed: int = 0, generator: str | None = None
) -> dict[str, Any]:
    """Check a frame set as :func:`verify_bank` checks a bank, with views rendered and captured again.

    A set of scenes names the program that made them. It is run if you name it too; otherwise nothing is made again.

    Parameters
    ----------
    path : path-like
        The frame set, with ``FILE.sha256`` beside it.
    sample : int
        How many random views, or scenes, to make again, with all frames of each.
    seed : int
        Which of them: the same seed takes the same ones.
    generator : str, optional
        ``module:function`` of the generator of scenes that made the set.

    Returns
    -------
    dict
        What was checked, in plain numbers and text.

    Raises
    ------
    InputFileError
        Naming the first thing that is wrong.
    UsageError
        The generator is not that of the set, or its module is not as it was.
    """
    with open_scene(FrameSet, path, untrusted=True) as opened:
        own = opened.plan.scenes.generator if isinstance(opened, SceneFrameSet) else None
    if generator not in (None, own):
        raise UsageError(f"{path}: its generator is {own or 'none'}, not '{generator}'")
    return _verify(Path(path), FrameSet, frames_job, sample if own == generator else 0, seed)


def _verify(
    path: Path, kind: type[StoredScene], job_of: Callable[[Any, StoredMesh], SceneJob[Any]], sample: int, seed: int
) -> dict[str, Any]:
    digest = verify_checksum(path)
    with open_scene(kind, path, untrusted=True) as opened:
        job = job_of(opened.plan, opened.mesh)
    # what a user's generator raises is no damage
    making = nullcontext() if isinstance(job, SceneFramesJob) else reading(path)
    with h5py.File(path, "r") as file:
        with reading(path):
            values = _check_values(file, path)
            if isinstance(job, FramesJob):
                _check_columns(file, path, job)
            for landmark in job.landmarks:
                if mesh_sha256(landmark.mesh) != file[f"meshes/{landmark.name}"].attrs["sha256"]:
                    raise InputFileError(f"{path}: the mesh of '{landmark.name}' is not what its sha256 says")
        slab_of = np.repeat(np.arange(len(job.items)), job.items)
        first = np.cumsum([0, *job.items])
        chosen = stream(seed, "verify", 0).choice(len(slab_of), size=min(sample, len(slab_of)), replace=False)
        with making:
            for item in np.sort(chosen):
                slab = int(slab_of[item])
                within = int(item - first[slab])
                made = dict(zip(job.fields, job.make(slab, within, within + 1), strict=True))
                _compare(path, int(item), job, job.read(file, slab, within), made)
    return {
        "path": str(path),
        "sha256": digest,
        "values": values,
        "rendered_again": len(chosen),
        "same_versions": opened.versions == job.identity()["versions"],
    }


def _check_values(file: h5py.File, path: Path) -> int:
    """Refuse infinities, and NaN but where a range is invalid; return how many values there are."""
    count = 0

    def check(name: str, item: Any) -> None:
        nonlocal count
        if not isinstance(item, h5py.Dataset) or item.dtype.kind != "f":
            return
        may_be_nan = name.startswith(("range", "frequency_range", "label_")) or name in _MAY_BE_NAN
        per_row = max(1, item.nbytes // max(1, len(item)))
        step = max(1, _BLOCK_BYTES // per_row)
        for start in range(0, len(item), step):
            block = item[start : start + step]
            count += block.size
            wrong = np.isinf(block) if may_be_nan else ~np.isfinite(block)
            flags = {"range": "flags", "frequency_range": "frequency_flags"}.get(name, "")
            if flags in file:
                wrong |= np.isnan(block) != (file[flags][start : start + step] != 0)
            if wrong.any():
                place = np.argwhere(wrong)[0]
                where = ", ".join(str(int(k)) for k in (place[0] + start, *place[1:]))
                raise InputFileError(f"{path}: '{name}' has {block[tuple(place)]} at ({where}), which cannot be")

    file.visititems(check)
    return count


def _check_columns(file: h5py.File, path: Path, job: FramesJob[Any]) -> None:
    """Refuse columns, truth and splits among them, that are not what the plan draws."""
    for name, expected, *_ in job.columns():
        stored = np.asarray(file[name][...])
        same = expected == stored
        if expected.dtype.kind not in "iu":
            same = np.isclose(expected, stored, rtol=TOLERANCE, atol=TOLERANCE, equal_nan=True)
        if stored.shape != expected.shape or not same.all():
            k = int(np.argmin(same)) if stored.shape == expected.shape else 0
            raise InputFileError(
                f"{path}: '{name}' is not what its plan draws: number {k} is {stored[k]}, must be {expected[k]}"
            )


def _compare(
    path: Path, item: int, job: SceneJob[Any], stored: dict[str, NDArray[Any]], made: dict[str, NDArray[Any]]
) -> None:
    # share of a view's noisy pixels that may differ: where rounding decides about a photon or a threshold
    noisy_share = 0.01
    for name, old in stored.items():
        new = made[name].reshape(old.shape)
        if name == "flags":
            share = float(np.mean(old != new))
            if share > noisy_share:
                raise InputFileError(
                    f"{path}: 'flags' of view {item} differ in {share:.1%} of the pixels when made again"
                )
            continue
        if old.dtype.kind == "S":
            if (old != new).any():
                raise InputFileError(f"{path}: '{name}' of item {item} is {old[0]}, and {new[0]} when made again")
            continue
        nan_differs = np.isnan(old) != np.isnan(new)
        gap = np.nan_to_num(new.astype(float) - old.astype(float))
        if name.startswith("range"):
            gap = wrap_difference_m(gap, job.sensor)
            limit = TOLERANCE_M
        else:
            limit = TOLERANCE * float(np.nanmax(np.abs(old), initial=1e-30))
        wrong = nan_differs | (np.abs(gap) > limit)
        if float(np.mean(wrong)) > (noisy_share if name in _NOISY else 0.0):
            place = np.unravel_index(int(np.argmax(np.abs(gap) + nan_differs)), gap.shape)
            raise InputFileError(
                f"{path}: '{name}' of item {item} is not what rendering it again gives: {old[place]} at"
                f" {tuple(int(k) for k in place)}, now {new[place]}"
            )
