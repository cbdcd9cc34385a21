"""Models of the light that a direct sensor sees: a landmark, planes behind it, and both from several poses.

A state is the six numbers of a view, and after them the nuisances of its model: what a frame leaves open besides.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.render import Background, Views
from phasemark.render.direct.view_signals import ViewSignals, slopes_about, views_about
from phasemark.render.rigid import rigid_transforms
from phasemark.render.view import VIEW_FIELDS

WALL, FLOOR = 1, 2
"""Where planes stand among the surfaces of a scene; the landmark is 0."""
FAINTEST, STRONGEST = 1e-2, 1e2
"""Brightness of a plane over that of the landmark, both over what their albedos say, between which it is looked for."""
WALL_STEP_M = 2e-3
"""Half the distance of the two walls whose difference is a slope."""
_RATIO = np.array([[0.1], [10.0], [1.0]])
"""Brightness in a frame over that in the first one: limits, and longest step."""


class SceneModel(ABC):
    """Expected signal counts of one frame, and their slopes.

    Attributes
    ----------
    nuisances : (3, k) float64
        Least and greatest value and longest step of each nuisance.
    """

    nuisances: NDArray[np.float64]

    @abstractmethod
    def look(self, views: Views, extra: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the counts at some views, (n, zones, bins), and their slopes by the nuisances at the first of them."""

    def scene(self, state: NDArray[np.float64], free: Sequence[str]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the counts at a state, (zones, bins), and their slopes by free parameters and nuisances."""
        counts, by_nuisance = self.look(views_about(state[: len(VIEW_FIELDS)], free), state[len(VIEW_FIELDS) :])
        return counts[0], np.concatenate([slopes_about(counts, free), by_nuisance])


class LandmarkModel(SceneModel):
    """A landmark alone, or before a wall, a floor or both, the brightness of each unknown.

    Its nuisances are the brightness of each plane over the landmark's, 1 where all albedos are as stated, and last the
    distance of the wall where that is free.

    Parameters
    ----------
    signals : ViewSignals
        Of the landmark; those of nothing leave the planes alone.
    background : Background, optional
    free_wall : (float, float), optional
        Least and greatest distance of a wall that is not known.
    """

    def __init__(
        self, signals: ViewSignals, background: Background | None = None, free_wall: tuple[float, float] | None = None
    ) -> None:
        self._signals, self._background, self._free_wall = signals, background, free_wall
        self.planes = planes_of(background)
        # planes alone: the first one's brightness is that of the scene
        self._brightest, *self._scaled = (0, *self.planes) if len(signals.vertices) or not self.planes else self.planes
        longest_scale = 1.0
        limits = [(FAINTEST, STRONGEST, longest_scale)] * len(self._scaled)
        if free_wall is not None:
            longest_wall_step_m = 0.04
            limits.append((*free_wall, longest_wall_step_m))
        self.nuisances = np.array(limits).reshape(-1, 3).T

    def look(self, views: Views, extra: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the counts at some views, and their slopes by the nuisances at the first of them."""
        if self._background is None:
            counts = self._signals.counts(views)
            return counts, np.empty((0, *counts.shape[1:]))
        scales = extra[: len(self._scaled)]

        def added(found: NDArray[np.float64]) -> NDArray[np.float64]:
            counts = found[:, self._brightest].copy()
            for plane, scale in zip(self._scaled, scales, strict=True):
                counts += scale * found[:, plane]
            return counts

        def before(wall_m: float) -> Background:
            assert self._background is not None
            return replace(self._background, wall_m=wall_m)

        behind = self._background if self._free_wall is None else before(float(extra[-1]))
        found = self._signals.surfaces(views, behind)
        slopes = list(found[0, self._scaled])
        if self._free_wall is not None:
            walls = [before(float(extra[-1]) + step) for step in (WALL_STEP_M, -WALL_STEP_M)]
            far, near = (added(self._signals.surfaces(views[:1], wall))[0] for wall in walls)
            slopes.append((far - near) / (2 * WALL_STEP_M))
        return added(found), np.array(slopes).reshape(-1, *found.shape[2:])


class JointModel(SceneModel):
    """The models of several frames at their poses, the zones of all frames one after the other.

    Its nuisances are, frame by frame, the brightness over that of the first frame (not of the first one itself), and
    the nuisances of the frame's own model.

    Parameters
    ----------
    model : SceneModel
        Of each frame.
    first2camera : (n, 4, 4) float64
        From :func:`relative_poses`.
    """

    def __init__(self, model: SceneModel, first2camera: NDArray[np.float64]) -> None:
        self._model, self._first2camera = model, first2camera
        of_frame = np.concatenate([_RATIO, model.nuisances], axis=1)
        self.nuisances = np.tile(of_frame, (1, len(first2camera)))[:, 1:]

    def split(self, extra: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return brightness over that of the first frame, and nuisances of the model, a row a frame."""
        return np.append(1.0, extra).reshape(len(self._first2camera), -1)

    def look(self, views: Views, extra: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the counts at some views of the first frame, and their slopes by the nuisances."""
        counts, slopes = [], []
        for there, (ratio, *own) in zip(self._first2camera, self.split(extra), strict=True):
            found, by_own = self._model.look(views_from(there, views), np.array(own))
            counts.append(ratio * found)
            slopes.append(np.concatenate([found[:1], ratio * by_own]))
        n, q, n_zones, bins = np.shape(slopes)
        by_nuisance = np.zeros((n, q, n, n_zones, bins))
        by_nuisance[np.arange(n), :, np.arange(n)] = slopes
        return np.concatenate(counts, axis=1), by_nuisance.reshape(n * q, n * n_zones, bins)[1:]


def planes_of(background: Background | None) -> tuple[int, ...]:
    """Return which planes of a background return light."""
    if background is None:
        return ()
    wall = background.wall_m is not None and background.wall_albedo > 0
    floor = background.floor_m is not None and background.floor_albedo > 0
    return (WALL,) * wall + (FLOOR,) * floor


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


def view_from(first2camera: NDArray[np.float64], view: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a view of the first camera as another camera has it, (6,)."""
    found = views_from(first2camera, Views(*view[:, None]))
    return np.concatenate([getattr(found, name) for name in VIEW_FIELDS])
