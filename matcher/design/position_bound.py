"""Position bound of a landmark over a working range: the Cramér–Rao bound of its lower pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark.landmarks import LandmarkSpec, build_mesh
from phasemark.landmarks.spec import Box
from phasemark.matcher.accuracy.cramer_rao import cramer_rao
from phasemark.matcher.design.plan import DesignPlan
from phasemark.render import Renderer, Sensor, Views

SEARCH_TOLERANCE_M = 1e-4
"""Of a surface while many are compared: a hundredth of a pixel."""


@dataclass(frozen=True, eq=False)
class RangeBound:
    """Cramér–Rao bound over distance and side (PHYSICS section 7).

    Lower pixels, ranges, the sensor's noise, (D, δ) free, no background; infinite where a view is not observed.

    Parameters
    ----------
    distance_m : (n,) float64
        Distances, metres.
    delta_rad : (k,) float64
        Viewing angles, radians.
    distance_std_m, delta_std_rad : (n, k) float64
        Cramér–Rao bounds of distance and angle, metres and radians.
    pixels : (n, k) int64
        How many lower pixels count.
    """

    distance_m: NDArray[np.float64]
    delta_rad: NDArray[np.float64]
    distance_std_m: NDArray[np.float64]
    delta_std_rad: NDArray[np.float64]
    pixels: NDArray[np.int64]

    @property
    def position_std_m(self) -> NDArray[np.float64]:
        """Of the lens in the plane, √(σ_D² + D² σ_δ²), the root of the trace of its covariance, (n, k)."""
        return np.hypot(self.distance_std_m, self.distance_m[:, None] * self.delta_std_rad)

    @property
    def worst_m(self) -> float:
        """Largest position bound of all views."""
        return float(self.position_std_m.max())

    @property
    def median_m(self) -> float:
        """Median position bound of all views."""
        return float(np.median(self.position_std_m))

    @property
    def worst_view(self) -> tuple[float, float]:
        """Distance and side of the largest position bound."""
        i, j = np.unravel_index(int(self.position_std_m.argmax()), self.position_std_m.shape)
        return float(self.distance_m[i]), float(self.delta_rad[j])

    @property
    def distance_information(self) -> NDArray[np.float64]:
        """Information about D with δ unknown, at the worst side, m⁻², (n,)."""
        return np.asarray(1 / self.distance_std_m.max(axis=1) ** 2)


def range_bound(
    spec: LandmarkSpec,
    sensor: Sensor,
    plan: DesignPlan,
    *,
    distance_m: NDArray[np.float64] | None = None,
    delta_rad: NDArray[np.float64] | None = None,
    tolerance_m: float = SEARCH_TOLERANCE_M,
    workers: int = 1,
) -> RangeBound:
    """Return the bound of a landmark where a plan samples it, or where it is told.

    Parameters
    ----------
    spec : LandmarkSpec
        The landmark.
    sensor : Sensor
        The camera.
    plan : DesignPlan
        Plan of the design.
    distance_m : (n,) float64, optional
        Distances; those of the plan's sampling if left out.
    delta_rad : (k,) float64, optional
        Angles; those of the plan's sampling if left out.
    tolerance_m : float
        Of the tessellation.
    workers : int
        Threads.
    """
    distance = plan.sampled_distance_m if distance_m is None else distance_m
    delta = plan.sampled_delta_rad(spec.symmetry) if delta_rad is None else delta_rad
    shape = (len(distance), len(delta))
    renderer = Renderer(build_mesh(spec, tolerance_m=tolerance_m), sensor, albedo=spec.albedo)
    d, a = np.meshgrid(distance, delta, indexing="ij")
    bound = cramer_rao(renderer, Views.broadcast(d, a), n_frames=plan.n_frames, pixels="lower", workers=workers)
    std = np.sqrt(np.einsum("npp->np", bound.covariance))
    std[~np.isfinite(std).all(axis=1)] = math.inf
    return RangeBound(
        distance,
        delta,
        std[:, 0].reshape(shape),
        std[:, 1].reshape(shape),
        bound.pixels.sum(axis=(1, 2)).reshape(shape),
    )


def box_alone(box: Box, plan: DesignPlan) -> LandmarkSpec:
    """Return a landmark with nothing on its box, which is all that lower pixels see."""
    return LandmarkSpec(name="box", box=box, albedo=plan.albedo)
