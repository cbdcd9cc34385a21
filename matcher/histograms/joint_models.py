"""One landmark seen from several poses of the camera that are known relative to each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.matcher.histograms.scene_models import Look, SceneModel
from phasemark.render import Views
from phasemark.render.rigid import rigid_transforms

_FAINTEST, _STRONGEST, _LONGEST = 0.1, 10.0, 1.0
"""Brightness in a frame over that in the first one: limits, and longest step."""


class JointModel:
    """The model of each frame at its pose; zones of all frames one after the other.

    Its nuisances are, frame by frame, the brightness over that of the first frame (not of the first one itself), and
    the nuisances of the frame's own model.

    Parameters
    ----------
    models : sequence of SceneModel
        Of each frame, all of one class.
    first2camera : (n, 4, 4) float64
        From :func:`relative_poses`.
    """

    def __init__(self, models: Sequence[SceneModel], first2camera: NDArray[np.float64]) -> None:
        self._models, self._first2camera = models, first2camera

    @property
    def nuisances(self) -> NDArray[np.float64]:
        """Least and greatest value and longest step of each nuisance, (3, k)."""
        ratio = np.array([[_FAINTEST], [_STRONGEST], [_LONGEST]])
        parts = [part for model in self._models for part in (ratio, model.nuisances)]
        return np.concatenate(parts[1:], axis=1)

    def split(self, extra: NDArray[np.float64]) -> list[tuple[float, NDArray[np.float64]]]:
        """Return the brightness of each frame over that of the first one, and the nuisances of its model."""
        out, at = [], 0
        for k, model in enumerate(self._models):
            ratio, at = (float(extra[at]), at + 1) if k else (1.0, at)
            own = model.nuisances.shape[1]
            out.append((ratio, extra[at : at + own]))
            at += own
        return out

    def look(self, views: Views, extra: NDArray[np.float64]) -> Look:
        """Return the signals at some views of the first frame, nuisances given."""
        counts, slopes = [], []
        for k, (ratio, own) in enumerate(self.split(extra)):
            found = self._models[k].look(views_from(self._first2camera[k], views), own)
            counts.append(ratio * found.counts)
            slopes.append(np.concatenate([found.counts[:1], ratio * found.by_nuisance])[0 if k else 1 :])
        n_zones, bins = counts[0].shape[1:]
        by_nuisance = np.zeros((len(extra), n_zones * len(counts), bins))
        at = 0
        for k, rows in enumerate(slopes):
            by_nuisance[at : at + len(rows), k * n_zones : (k + 1) * n_zones] = rows
            at += len(rows)
        return Look(np.concatenate(counts, axis=1), by_nuisance)


def relative_poses(n: int, camera2world: ArrayLike) -> NDArray[np.float64]:
    """Return the transforms from the frame of the first camera to that of each, (n, 4, 4).

    Parameters
    ----------
    n : int
        Number of frames.
    camera2world : (n, 4, 4) array_like
        Pose of the camera in each frame; x along the axis, y left, z up.

    Raises
    ------
    UsageError
        There are more or fewer poses than frames, or one is not rigid.
    """
    poses = rigid_transforms(camera2world, "camera2world")
    if len(poses) != n:
        raise UsageError(f"'camera2world' must have a pose for each of {n} frames, got {len(poses)}")
    return np.asarray(np.linalg.inv(poses) @ poses[0])


def views_from(first2camera: NDArray[np.float64], views: Views) -> Views:
    """Return views of the first camera as another camera has them."""
    if np.array_equal(first2camera, np.eye(4)):
        return views
    rotation, translation = views.landmark2cam()
    pose = np.tile(np.eye(4), (len(views), 1, 1))
    pose[:, :3, :3], pose[:, :3, 3] = rotation, translation
    return Views.from_landmark2cam(first2camera @ pose)


def view_in_first(
    first2camera: NDArray[np.float64], view: NDArray[np.float64], fixed: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return a view of another camera as the first one has it, 0 where that is known to be 0; (6,)."""
    found = views_from(np.asarray(np.linalg.inv(first2camera), dtype=np.float64), Views(*view[:, None]))
    out = np.concatenate([found.distance_m, found.delta_rad, found.bearing_rad, found.height_m, found.pitch_rad,
                          found.roll_rad])  # fmt: skip
    return np.where(fixed, 0.0, out)
