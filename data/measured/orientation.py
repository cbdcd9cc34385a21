"""The eight orientations of a grid of pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Orientation:
    """Orientation of images: the mirroring and the turn that bring them upright.

    Parameters
    ----------
    flip_h : bool
        Whether left and right are mirrored first.
    rotate : {0, 90, 180, 270}
        Degrees to turn clockwise.
    """

    flip_h: bool = False
    rotate: int = 0

    def apply(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return images, (..., rows, cols), brought upright."""
        values = values[..., ::-1] if self.flip_h else values
        return np.rot90(values, -self.rotate // 90, axes=(-2, -1))


ORIENTATIONS = tuple(Orientation(flip_h, rotate) for flip_h in (False, True) for rotate in (0, 90, 180, 270))
"""All of a square grid; one that is not square has those of 0° and 180°."""
