"""Build a small set of labelled noisy frames, and open it in xarray and in PyTorch.

``python examples/labelled_frames.py --views 200 --out out/labelled``

Each frame comes with its truth: class, distance D, side δ. xarray and PyTorch are used where they are installed
(``pip install xarray h5netcdf torch``); the data set is the same without them.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

from phasemark import PhasemarkError, UsageError
from phasemark.data import FramePlan, build_frames

CLASSES = ("cylinder", "cone", "sphere", "post")


def to_sample(frame: dict[str, Any]) -> tuple[np.ndarray, int, np.ndarray]:
    """Return what a network learns from: range and validity as channels, the class, and (D, cos 2δ, sin 2δ).

    The box looks the same after half a turn, so δ enters as 2δ. A function of a module, so that workers can have it.
    """
    range_m = np.asarray(frame["range_m"], dtype=np.float32)
    seen = np.isfinite(range_m)
    channels = np.stack([np.where(seen, range_m, 0), seen]).astype(np.float32)
    turned = 2 * frame["delta_rad"]
    view = np.array([frame["distance_m"], np.cos(turned), np.sin(turned)], dtype=np.float32)
    return channels, CLASSES.index(frame["class_name"]), view


def main() -> int:
    """Build the set and read a batch of it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=200, help="places the camera looks from (%(default)s)")
    parser.add_argument("--seed", type=int, default=7, help="root of all random numbers (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/labelled"), help="folder of the set (%(default)s)")
    arguments = parser.parse_args()
    path = arguments.out / "frames.h5"
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
        plan = FramePlan(
            classes=CLASSES,
            views=arguments.views,
            frames_per_view=2,
            seed=arguments.seed,
            distance_m={"sobol": [0.7, 2.1]},
            delta_deg={"sobol": [0, 180]},
            splits={"train": 0.8, "test": 0.2},
        )
        build_frames(plan, path, force=True).close()
    except (PhasemarkError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code if isinstance(error, PhasemarkError) else UsageError.exit_code

    read_labelled(path)
    read_batch(path)
    print(path)
    return 0


def read_labelled(path: Path) -> None:
    """Open the set in xarray, if it is there, and ask for something by its labels."""
    try:
        import h5netcdf  # noqa: F401  # what xarray opens it with
        import xarray
    except ImportError:
        print("xarray: not installed (pip install xarray h5netcdf)")
        return
    with xarray.open_dataset(path, engine="h5netcdf") as labelled:
        near = labelled.range.where(labelled.distance[labelled.view_index] < 1.0).mean().item()
        print(f"xarray: {dict(labelled.sizes)}, mean range of what is seen from less than 1 m: {near:.3f} m")


def read_batch(path: Path) -> None:
    """Read a shuffled batch of the training split in two worker processes, by PyTorch if it is there."""
    from phasemark.data import open_frames

    with open_frames(path) as frames:
        train = frames.subset("train", transform=to_sample)
        try:
            from torch.utils.data import DataLoader
        except ImportError:
            samples = [train[k] for k in range(min(32, len(train)))]
            images = np.stack([image for image, _, _ in samples])
            print(f"PyTorch: not installed; the first samples by hand: {images.shape}, {len(train)} in the split")
            return
        loader = DataLoader(train, batch_size=32, shuffle=True, num_workers=2, multiprocessing_context="spawn")
        images, classes, _ = next(iter(loader))
        print(f"PyTorch: a batch of {tuple(images.shape)}, {len(set(classes.tolist()))} classes in it")


if __name__ == "__main__":
    sys.exit(main())
