"""Rotations and rigid transforms of a camera that is tilted (PHYSICS section 9)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError


def product(left: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return matrix products (…, i, j) of stacks of (…, i, 3) and (…, 3, j) matrices, each summed in the same order.

    A BLAS library sums in an order that depends on the processor and on how many matrices there are. One bit of a pose
    moves an image by up to 1e-10 of its light, because pieces of a pixel narrower than that are not sampled.

    Parameters
    ----------
    left, right : (…, i, 3) and (…, 3, j) float64
        The leading axes broadcast.
    """
    first, second, third = (left[..., k, None] * right[..., k, None, :] for k in range(3))
    return np.asarray((first + second) + third)


def composed(outer: NDArray[np.float64], inner: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rigid transforms, (…, 4, 4), that apply `inner` and then `outer`; the leading axes broadcast."""
    out = np.zeros(np.broadcast_shapes(outer.shape, inner.shape))
    out[..., :3, :] = product(outer[..., :3, :3], inner[..., :3, :])
    out[..., :3, 3] += outer[..., :3, 3]
    out[..., 3, 3] = 1.0
    return out


def tilt2level(pitch_rad: NDArray[np.float64], roll_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotations Ry(pitch) · Rx(roll) from a tilted to the level frame, (n, 3, 3).

    Parameters
    ----------
    pitch_rad, roll_rad : (n,) float64
        A positive pitch looks down.
    """
    sin_p, cos_p = np.sin(pitch_rad), np.cos(pitch_rad)
    sin_r, cos_r = np.sin(roll_rad), np.cos(roll_rad)
    out = np.zeros((len(pitch_rad), 3, 3))
    out[:, 0, 0], out[:, 0, 1], out[:, 0, 2] = cos_p, sin_p * sin_r, sin_p * cos_r
    out[:, 1, 1], out[:, 1, 2] = cos_r, -sin_r
    out[:, 2, 0], out[:, 2, 1], out[:, 2, 2] = -sin_p, cos_p * sin_r, cos_p * cos_r
    return out


def rigid_transforms(transforms: ArrayLike, name: str = "landmark2cam") -> NDArray[np.float64]:
    """Return (n, 4, 4) float64 transforms that are rigid.

    Parameters
    ----------
    transforms : (n, 4, 4) or (4, 4) array_like
    name : str
        What messages call them.

    Raises
    ------
    UsageError
        A matrix is not finite, or not a rotation with a translation.
    """
    what = f"'{name}'" if name.isidentifier() else name
    try:
        array = np.asarray(transforms, dtype=np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"{what} must have shape (n, 4, 4), got what is no array of numbers") from None
    given = array.shape
    if array.ndim == 2:
        array = array[None]
    if array.shape[1:] != (4, 4):
        raise UsageError(f"{what} must have shape (n, 4, 4), got {given}")
    if not np.isfinite(array).all():
        raise UsageError(f"{what} must be finite, matrix {int(np.argmin(np.isfinite(array).all(axis=(1, 2))))} is not")
    square = np.einsum("nij,nkj->nik", array[:, :3, :3], array[:, :3, :3])
    off = np.abs(square - np.eye(3)).max(axis=(1, 2))
    bottom = np.abs(array[:, 3] - [0, 0, 0, 1]).max(axis=1)
    wrong = (off > 1e-4) | (bottom > 1e-9) | (np.linalg.det(array[:, :3, :3]) < 0)
    if wrong.any():
        raise UsageError(f"{what} must be a rotation and a translation, matrix {int(wrong.argmax())} is not")
    return array
