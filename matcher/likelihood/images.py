"""Interface of image models: images of views anywhere, and their derivatives by the view."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.render.view import VIEW_FIELDS

VIEW = VIEW_FIELDS
"""What a view is made of; the columns of arrays of views: D, δ, bearing, height, pitch, roll."""
LEVEL_VIEW = VIEW[:4]
"""What the view of a level camera is made of."""
TILT = slice(4, 6)
"""Columns of pitch and roll."""
BEFORE_LENS_M = 5e-3
"""Smallest gap between a landmark and the lens."""


@dataclass(frozen=True, eq=False)
class ModelImages:
    """Images of m views and how they change; (m, pixels) arrays.

    Parameters
    ----------
    phasor : complex128
    slope : (m, p, pixels) complex128
        ∂S by each of the parameters asked for.
    intensity, coverage : float64
    behind : complex128, optional
        The share of the phasor that comes from the background of each view; None where it is not known apart.
    behind_slope : (m, p, pixels) complex128, optional
        Of that share.
    """

    phasor: NDArray[np.complex128]
    slope: NDArray[np.complex128]
    intensity: NDArray[np.float64]
    coverage: NDArray[np.float64]
    behind: NDArray[np.complex128] | None = None
    behind_slope: NDArray[np.complex128] | None = None

    def __getitem__(self, which: NDArray[np.integer]) -> ModelImages:
        """Return the images of some of the views."""
        some: list[Any] = [None if values is None else values[which] for values in self.arrays()]
        return ModelImages(*some)

    def arrays(self) -> tuple[NDArray[np.complex128] | NDArray[np.float64] | None, ...]:
        """Return the fields in their order."""
        return tuple(getattr(self, field.name) for field in fields(self))

    def update(self, where: NDArray[np.integer], news: ModelImages) -> None:
        """Replace some views by others, in place."""
        for own, new in zip(self.arrays(), news.arrays(), strict=True):
            if own is not None and new is not None:
                own[where] = new


class ImageModel(ABC):
    """Interface that the refinement needs of an image model, with the answers of one that is smooth.

    Attributes
    ----------
    slopes_are_cheap : bool
        Whether slopes cost no more than images, as those of interpolated images do.
    is_of_chip : bool
        Whether pixels of a coverage of 0.005 need not report a target: they may contradict a frame, and are not fitted.
    """

    slopes_are_cheap, is_of_chip = True, False

    def lit(self, factor: NDArray[np.float64]) -> ImageModel | None:
        """Return the model whose landmarks are brighter by factors (m,), one for each view.

        None where what stands behind returns nothing, or where its light is not separate from theirs.
        """
        return None

    def of_frames(self, frame: NDArray[np.int64]) -> ImageModel:
        """Return the model whose views are those of some frames (m,), each before what stands behind it there.

        A model with one background for all frames returns itself, and takes any number of views. A model with one
        background per frame must be bound to the frames by this call before it makes images.
        """
        return self

    @abstractmethod
    def images(self, class_index: NDArray[np.int64], view: NDArray[np.float64], free: Sequence[str]) -> ModelImages:
        """Return the images of views (m, 6), columns :data:`VIEW`, of a class each."""

    def first_images(
        self, class_index: NDArray[np.int64], view: NDArray[np.float64], free: Sequence[str]
    ) -> ModelImages:
        """Return the same where a search starts, at views that other frames may start from too."""
        return self.images(class_index, view, free)

    def turned(self, class_index: NDArray[np.int64], view: NDArray[np.float64], like: ModelImages) -> ModelImages:
        """Return images of views that differ from those of `like` in δ alone, with the slopes of `like`."""
        return replace(self.images(class_index, view, ()), slope=like.slope)

    def wide_slopes(
        self, class_index: NDArray[np.int64], view: NDArray[np.float64], free: Sequence[str], step: NDArray[np.float64]
    ) -> NDArray[np.complex128] | None:
        """Return slopes from differences over `step` (m, p) to either side; None if they differ little from others."""
        return None

    def differences(
        self, class_index: NDArray[np.int64], view: NDArray[np.float64], moves: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """Return half the differences of images at both ends of moves (m, k, 6) of views; (m, k, pixels)."""
        one, other = (
            np.stack([self.images(class_index, view + side * move, ()).phasor for move in moves.swapaxes(0, 1)], axis=1)
            for side in (1.0, -1.0)
        )
        return np.asarray((one - other) / 2)

    def trusted(self, class_index: NDArray[np.int64], view: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which pixels of its images may be relied on, (m, pixels), or (m, 1) where all are alike."""
        return np.ones((len(view), 1), np.bool_)

    def clip(self, view: NDArray[np.float64], which: NDArray[np.integer]) -> None:
        """Move views, in place, to distances that the model can show; `which` of all they are."""
        nearest, farthest = self.limits(view[:, 1], which)  # edge on, a wide landmark may leave no room between them
        view[:, 0] = np.maximum(np.minimum(view[:, 0], farthest), nearest)

    @abstractmethod
    def limits(
        self, delta_rad: NDArray[np.float64], which: NDArray[np.integer] | None = None
    ) -> tuple[float | NDArray[np.float64], float | NDArray[np.float64]]:
        """Return the nearest and the farthest distance it can show from m angles, for all of them or for each.

        `which` of all views they belong to; None: all of the model's.
        """
