"""Histograms of simple scenes by dense quadrature, independent of the program: midpoints, closed-form rays, sums.

The camera looks along x; a zone is a rectangle of tangents (y, z) seen evenly. Amplitude is ρ cos θ / r².
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

Hit = Callable[[NDArray[np.float64], NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""From the tangents y, z of rays (1, y, z) to their range (inf: none) and cos θ."""


def plane(distance_m: float, tilt: tuple[float, float] = (0.0, 0.0)) -> Hit:
    """Return the plane x + tilt·(y, z) = distance."""
    normal = np.array([1.0, *tilt]) / np.sqrt(1 + tilt[0] ** 2 + tilt[1] ** 2)

    def hit(y: NDArray[np.float64], z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        d = np.stack([np.ones_like(y), y, z], axis=-1)
        length = np.linalg.norm(d, axis=-1)
        facing = d @ normal
        return distance_m * normal[0] / facing * length, facing / length

    return hit


def half_plane_before(near_m: float, far_m: float, edge_tangent: float) -> Hit:
    """Return a plane at `far_m` that one at `near_m` hides where y < `edge_tangent`."""

    def hit(y: NDArray[np.float64], z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        length = np.sqrt(1 + y * y + z * z)
        return np.where(y < edge_tangent, near_m, far_m) * length, 1 / length

    return hit


def sphere(centre_m: tuple[float, float, float], radius_m: float) -> Hit:
    """Return a sphere before nothing."""

    def hit(y: NDArray[np.float64], z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        d = np.stack([np.ones_like(y), y, z], axis=-1)
        d = d / np.linalg.norm(d, axis=-1, keepdims=True)
        c = np.array(centre_m)
        along = d @ c
        root = along**2 - c @ c + radius_m**2
        met = root > 0
        r = np.where(met, along - np.sqrt(np.where(met, root, 0.0)), np.inf)
        normal = (np.where(met, r, 0.0)[..., None] * d - c) / radius_m
        return r, np.where(met, -(normal * d).sum(axis=-1), 0.0)

    return hit


def histogram(
    scene: Hit,
    zone: tuple[float, float, float, float],
    edges_m: NDArray[np.float64],
    irf_std_m: float,
    points: int = 2400,
) -> NDArray[np.float64]:
    """Return the shares of light, mean amplitude over the zone, that fall into bins.

    Parameters
    ----------
    scene : Hit
    zone : (y_low, y_high, z_low, z_high)
    edges_m : (bins + 1,) float64
    irf_std_m : float
        Of a Gaussian response.
    points : int
        Midpoints a side.
    """
    y_low, y_high, z_low, z_high = zone
    mid = (np.arange(points) + 0.5) / points
    y, z = np.meshgrid(y_low + (y_high - y_low) * mid, z_low + (z_high - z_low) * mid)
    r, cosine = scene(y, z)
    seen = np.isfinite(r)
    amplitude = cosine[seen] / r[seen] ** 2
    # rays whose ranges differ by less than a thousandth of the response are gathered at their mean
    first = r[seen].min() if seen.any() else 0.0
    cell = ((r[seen] - first) / (1e-3 * irf_std_m)).astype(np.int64)
    weight = np.bincount(cell, amplitude, minlength=1)
    moment = np.bincount(cell, amplitude * r[seen], minlength=1)
    lit = weight > 0
    centre = moment[lit] / weight[lit]
    share = 0.5 * (1 + erf((edges_m[:, None] - centre) / (np.sqrt(2) * irf_std_m)))
    return np.asarray(np.diff(share, axis=0) @ weight[lit] / points**2)
