"""Acceptance of parts that are in no bank: the bank's own landmarks at another size, or with a piece cut off.

A test of the fit refuses a part where it differs from every view of the bank by more than the noise. How much that is
depends on the sensor, the distance and on what else is free, so frames of these parts are matched and counted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import manifold3d
import numpy as np
import trimesh

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.data.seeds import stream
from phasemark.matcher.filters.kalman_filters import kalman_filter
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.statistics import Interval, binomial_interval
from phasemark.render import Views
from phasemark.render.direct.capture import capture_ranges

SCALES = (0.8, 0.9, 0.95, 1.05, 1.1, 1.25)
"""Sizes of copies, as shares of the landmark's."""
CUTS = (0.1, 0.25)
"""What is cut off the top, or off the side in x', as shares of the extent."""
_PIXELS = 10_000_000
"""Most pixels of the frames of a part, all exposures together: some hundred bytes of memory each."""


@dataclass(frozen=True)
class StrangerRate:
    """Share of the frames of one part that are accepted, though the part is in no bank.

    Parameters
    ----------
    class_name : str
        Landmark of the bank that the part was made from.
    change : str
        How: "size 0.9", "top cut by 0.1", "side cut by 0.25".
    frames, accepted : int
    share : Interval
        Of accepted frames, with its exact 95 % interval.
    """

    class_name: str
    change: str
    frames: int
    accepted: int
    share: Interval

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers by name."""
        return {
            "class": self.class_name,
            "change": self.change,
            "frames": self.frames,
            "accepted": self.accepted,
            "share": self.share.value,
            "share_low": self.share.low,
            "share_high": self.share.high,
        }


def stranger_rates(matcher: Matcher, n: int, *, n_frames: int = 50, seed: int = 0) -> list[StrangerRate]:
    """Match frames of changed landmarks of a bank, and count which are accepted.

    Parameters
    ----------
    matcher : Matcher
        Of the method `refine`, on ranges of a camera, or on those that a chip reports.
    n : int
        Frames of each part, at random distances and angles of the bank, with nothing behind.
    n_frames : int
        Exposures that are averaged in each.
    seed : int
        Of views and noise: the views of all parts of a class are the same.

    Returns
    -------
    list of StrangerRate
        By class, then by size and by cut. Cuts are left out of meshes that enclose no volume.

    Raises
    ------
    UsageError
        `n` is not positive, or the frames of a part do not fit into memory.
    """
    if n < 1:
        raise UsageError(f"n=… must be at least 1, got {n}")
    bank, found = matcher.bank, []
    most = _PIXELS // (bank.sensor.rows * bank.sensor.cols)
    if n * n_frames > most:
        raise UsageError(f"a part has {n} × {n_frames} frames, which are made in memory: at most {most} together")
    for k, name in enumerate(bank.classes):
        mesh = bank.mesh(name)
        for number, (change, part) in enumerate(changed_parts(mesh)):
            views = _views(bank, n, max(SCALES) * _radius_m(mesh), seed, k)
            rng = stream(seed, f"strangers of class {k}", number)
            albedo = float(mesh.metadata["albedo"])
            frames = capture_ranges(part, bank.sensor, views, albedo=albedo, rng=rng, n_frames=n_frames)
            matches = matcher.match(kalman_filter(frames))
            accepted = int(matches.accepted.sum())
            found.append(StrangerRate(name, change, n, accepted, binomial_interval(accepted, n)))
    return found


def changed_parts(mesh: trimesh.Trimesh) -> Iterator[tuple[str, trimesh.Trimesh]]:
    """Yield copies of a landmark at other sizes, and with a piece cut off, each with the name of its change.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Metres, landmark frame.
    """
    for scale in SCALES:
        yield f"size {scale:g}", trimesh.Trimesh(scale * np.asarray(mesh.vertices), mesh.faces, process=False)
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(
            vert_properties=np.ascontiguousarray(mesh.vertices, np.float64),
            tri_verts=np.ascontiguousarray(mesh.faces, np.uint64),
        )
    )
    if solid.status() != manifold3d.Error.NoError:
        return
    low, high = np.asarray(mesh.bounds)
    for where, axis in (("top", 2), ("side", 0)):
        for share in CUTS:
            plane = high[axis] - share * (high[axis] - low[axis])
            normal: Sequence[float] = -np.eye(3)[axis]
            left = solid.trim_by_plane(normal, -plane).to_mesh64()
            faces = np.asarray(left.tri_verts, np.int64)
            yield f"{where} cut by {share:g}", trimesh.Trimesh(left.vert_properties[:, :3], faces, process=False)


def _radius_m(mesh: trimesh.Trimesh) -> float:
    """Return how far a landmark reaches from its axis."""
    return float(np.hypot(*np.asarray(mesh.vertices)[:, :2].T).max())


def _views(bank: Bank, n: int, radius_m: float, seed: int, class_index: int) -> Views:
    """Return random views in the range of a bank, with the lens outside what reaches so far from its axis."""
    rng = stream(seed, "views of strangers", class_index)
    nearest = min(max(float(bank.distance_m[0]), 1.05 * radius_m), float(bank.distance_m[-1]))
    distance = rng.uniform(nearest, bank.distance_m[-1], n)
    return Views.broadcast(distance, rng.uniform(bank.delta_rad[0], bank.delta_rad[-1], n))
