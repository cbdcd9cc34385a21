"""Map of a lens: from a ray to its image point, and back (PHYSICS section 9).

Normalised coordinates are OpenCV's: a ray (1, y, z) of the camera has x = −y to the right and −z downwards. The lens
moves them to (x_d, y_d), and the image point is u = fx · x_d + cx + ½, v = fy · y_d + cy + ½: OpenCV counts pixels from
the centre of the first one.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

OPENCV, FISHEYE = 1, 2
"""Numbers of the models, as the kernels take them; 0 is the ideal lens."""

MOST_DEG = 85.0
"""Farthest from the axis that an image may see."""

_RADII = 4096  # of the table that Newton's method starts from
_STEPS = 40  # of Newton's method at most
_ROUNDING = 1e-14  # last step of Newton's method
_CHECKED = 64  # points along each side of an image at which its lens is checked


def distort(model: int, k: Any, x: Any, y: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Return where a lens moves normalised coordinates, and the derivatives of that; of floats or of arrays.

    Parameters
    ----------
    model : int
        :data:`OPENCV` or :data:`FISHEYE`.
    k : (8,) float64
        Coefficients in OpenCV's order, zero where there are fewer.
    x, y : float or ndarray

    Returns
    -------
    x_d, y_d, xx, xy, yy
        The coordinates, ∂x_d/∂x, ∂x_d/∂y = ∂y_d/∂x, and ∂y_d/∂y.
    """
    r2 = x * x + y * y
    if model == 2:
        r2 = r2 + 1e-300
        r = np.sqrt(r2)
        angle = np.arctan(r)
        a2 = angle * angle
        scale = angle * (1.0 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3])))) / r
        rate = 1.0 + a2 * (3.0 * k[0] + a2 * (5.0 * k[1] + a2 * (7.0 * k[2] + a2 * 9.0 * k[3])))
        bend = (rate / (1.0 + r2) - scale) / r2
        return x * scale, y * scale, scale + x * x * bend, x * y * bend, scale + y * y * bend
    below = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    scale = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / below
    rate = k[0] + r2 * (2.0 * k[1] + r2 * 3.0 * k[4]) - scale * (k[5] + r2 * (2.0 * k[6] + r2 * 3.0 * k[7]))
    bend = 2.0 * rate / below
    p1, p2 = k[2], k[3]
    return (
        x * scale + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * scale + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        scale + x * x * bend + 2.0 * p1 * y + 6.0 * p2 * x,
        x * y * bend + 2.0 * p1 * x + 2.0 * p2 * y,
        scale + y * y * bend + 6.0 * p1 * y + 2.0 * p2 * x,
    )


class LensMap:
    """One lens before an image of rows × cols pixels.

    Parameters
    ----------
    model : {"opencv", "fisheye"}
    intrinsics : (fx, fy, cx, cy)
        As OpenCV has them, pixels.
    distortion : tuple of float
        In OpenCV's order, at most 8.
    rows, cols : int

    Raises
    ------
    ValueError
        The lens folds inside the image, or the image sees farther from the axis than :data:`MOST_DEG`; with one line.
    """

    def __init__(
        self, model: str, intrinsics: tuple[float, ...], distortion: tuple[float, ...], rows: int, cols: int
    ) -> None:
        self.model = FISHEYE if model == "fisheye" else OPENCV
        self.k = np.zeros(8)
        self.k[: len(distortion)] = distortion
        self.focal_px, self.centre_px = np.array(intrinsics[:2]), np.array(intrinsics[2:]) + 0.5
        self.rows, self.cols = rows, cols
        self._radius, self._distorted = self._radial_table()
        self.largest_tangent = float(self._radius[-1])
        """Radius, as a tangent, within which the lens is one to one along every direction."""
        self._check_image()

    def project(
        self, y: NDArray[np.float64], z: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the image points u, v of rays (1, y, z)."""
        with np.errstate(all="ignore"):
            x_d, y_d = distort(self.model, self.k, -y, -z)[:2]
        return self.focal_px[0] * x_d + self.centre_px[0], self.focal_px[1] * y_d + self.centre_px[1]

    def rays(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return y and z of the rays (1, y, z) of image points; NaN where there is none."""
        x, y, found = self._normalised(np.asarray(u, np.float64), np.asarray(v, np.float64))
        return np.where(found, -x, np.nan), np.where(found, -y, np.nan)

    @property
    def tan_half_angles(self) -> tuple[float, float]:
        """Half the width and height of the image, as tangents, along the row and column of the principal point."""
        if self.model == OPENCV and not self.k.any():
            return self.cols / (2 * float(self.focal_px[0])), self.rows / (2 * float(self.focal_px[1]))
        u0, v0 = np.clip(self.centre_px, 0.0, [self.cols, self.rows])
        across = self.rays(np.array([0.0, self.cols]), np.full(2, v0))[0]
        along = self.rays(np.full(2, u0), np.array([0.0, self.rows]))[1]
        return float(across[0] - across[1]) / 2, float(along[0] - along[1]) / 2

    def _radial_table(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return radii as tangents, and where the lens moves them, as far out as both rise together."""
        k = self.k.copy()
        if self.model == OPENCV:
            k[2:4] = 0.0

        def moved(r: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            with np.errstate(all="ignore"):
                r_d, _, rate, _, _ = distort(self.model, k, r, np.zeros_like(r))
            return r_d, rate

        radius = np.tan(np.linspace(0.0, math.radians(MOST_DEG), _RADII))
        r_d, rate = moved(radius)
        rises = (rate > 0) & (np.diff(r_d, prepend=-1.0) > 0)
        last = len(radius) if rises.all() else int(np.argmin(rises))
        return radius[:last], r_d[:last]

    def _normalised(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Return the normalised coordinates of image points by Newton's method, and whether there are any."""
        x_d, y_d = np.broadcast_arrays(
            (u - self.centre_px[0]) / self.focal_px[0], (v - self.centre_px[1]) / self.focal_px[1]
        )
        r_d = np.hypot(x_d, y_d)
        start = np.interp(r_d, self._distorted, self._radius)
        scale = np.where(r_d > 0, start / np.where(r_d > 0, r_d, 1.0), 1.0)
        x, y = x_d * scale, y_d * scale
        with np.errstate(all="ignore"):
            for _ in range(_STEPS):
                a, b, xx, xy, yy = distort(self.model, self.k, x, y)
                determinant = xx * yy - xy * xy
                dx = (yy * (x_d - a) - xy * (y_d - b)) / determinant
                dy = (xx * (y_d - b) - xy * (x_d - a)) / determinant
                x, y = x + dx, y + dy
                step = np.hypot(dx, dy)
                if not (step > _ROUNDING * (1.0 + np.hypot(x, y))).any():
                    break
            a, b, xx, xy, yy = distort(self.model, self.k, x, y)
            missed = np.hypot(a - x_d, b - y_d)
            found = (missed < 1e-11) & (xx * yy - xy * xy > 0) & (np.hypot(x, y) <= math.tan(math.radians(MOST_DEG)))
        return x, y, found

    def _check_image(self) -> None:
        """Refuse a lens that folds inside the image."""
        u = np.linspace(0.0, self.cols, min(self.cols, _CHECKED) + 1)
        v = np.linspace(0.0, self.rows, min(self.rows, _CHECKED) + 1)
        x, y, seen = self._normalised(*np.meshgrid(u, v))
        if seen.all() and not self._folds_before(x, y):
            return
        corners = np.array([[a, b] for a in (0, self.cols) for b in (0, self.rows)], float) - self.centre_px
        reach = f"its farthest corner is {np.hypot(*corners.T).max():.4g} pixels from the principal point"
        fold = self._fold()
        if fold is not None:
            raise ValueError(
                f"'lens' folds {fold[0]:.4g} pixels from the principal point, at the tangent {fold[1]:.4g}, inside the"
                f" image ({reach}): its coefficients must map the whole image one to one"
            )
        raise ValueError(
            f"'lens' must see no farther than {MOST_DEG:g}° from the optical axis inside the image, and {reach}"
        )

    def _folds_before(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> bool:
        """Return True if the lens folds between its axis and the border: Newton's method may have crossed the fold."""
        border = np.ones(x.shape, bool)
        border[1:-1, 1:-1] = False
        share = np.linspace(0.0, 1.0, _CHECKED)[:, None]
        _, _, xx, xy, yy = distort(self.model, self.k, share * x[border], share * y[border])
        return not bool((xx * yy - xy * xy > 0).all())

    def _fold(self) -> tuple[float, float] | None:
        """Return where the lens folds nearest to the principal point: pixels from there, and the tangent."""
        directions = 64  # in which a fold is looked for
        direction = np.linspace(0.0, 2 * math.pi, directions, endpoint=False)[:, None]
        radius = np.tan(np.linspace(0.0, math.radians(MOST_DEG), _RADII))
        x, y = radius * np.cos(direction), radius * np.sin(direction)
        with np.errstate(all="ignore"):
            a, b, xx, xy, yy = distort(self.model, self.k, x, y)
            folded = ~((xx * yy - xy * xy > 0) & (xx + yy > 0))
        first = np.argmax(folded, axis=1)
        has = folded[np.arange(directions), first]
        if not has.any():
            return None
        at = np.maximum(first - 1, 0)
        line = np.arange(directions)
        away = np.hypot(self.focal_px[0] * a[line, at], self.focal_px[1] * b[line, at])
        nearest = int(np.argmin(np.where(has, away, np.inf)))
        return float(away[nearest]), float(radius[at[nearest]])


lens_map = lru_cache(maxsize=64)(LensMap)
"""Return a :class:`LensMap`, made once for each lens and image size."""
