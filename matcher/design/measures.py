"""Measures of a set of landmarks: the bound of the position over a working range, and distances between frames.

The bound is that of Cramér and Rao by lower pixels. The noncentrality d is the whitened distance between two noise-free
frames, over everything that could make one imitate the other (PHYSICS section 7): two classes are confused with
probability Q(d/2), see :func:`~phasemark.matcher.accuracy.cramer_rao.confusion_probability`. Pixels where one returns
and the other cannot, or must and does not, count with the matcher's own penalty.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark.landmarks import LandmarkSpec, build_mesh
from phasemark.landmarks.spec import Box, Upper
from phasemark.matcher.accuracy.appearance import Appearance, least_cost
from phasemark.matcher.accuracy.cramer_rao import cramer_rao
from phasemark.matcher.design.plan import DesignPlan
from phasemark.matcher.one_frequency import phases_of
from phasemark.render import Renderer, Sensor, Views

SEARCH_TOLERANCE_M = 1e-4
"""Of a surface while many are compared: a hundredth of a pixel."""
_TURN_BIAS_RAD = np.radians(np.arange(-30.0, 31.0, 6.0))
_TURN_SHIFT_M = np.arange(-0.06, 0.061, 0.015)


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


def upper_appearance(upper: Upper, sensor: Sensor, plan: DesignPlan) -> Appearance:
    """Return the image of a part in the upper rows at the sampled distances; its slope is by D."""
    side = 2 * max(plan.limits.extents_m)
    stand = Box(length_m=side, width_m=side, height_m=side)  # below the upper rows: not built, not seen
    spec = LandmarkSpec(name="upper", box=stand, upper=upper, albedo=plan.albedo)
    mesh = build_mesh(spec, part="upper", tolerance_m=SEARCH_TOLERANCE_M)
    renderer = phases_of(Renderer(mesh, sensor, albedo=plan.albedo))
    views = Views.broadcast(plan.sampled_distance_m)
    return Appearance.of(renderer, views, ("distance_m",), renderer.sensor.upper_rows, plan.n_frames)


@dataclass(frozen=True, eq=False)
class ClassDistances:
    """Squared noncentralities between upper parts, before it is known what the box says of D; (m, m, n) arrays.

    With the information I about D from the lower pixels, the view that imitates best is shifted by ε = g / (I + h), and
    d² = c − g² / (I + h).

    Parameters
    ----------
    cost, gradient, information : (m, m, n) float64
        c, g and h of frames of the first as the second, at n distances.
    """

    cost: NDArray[np.float64]
    gradient: NDArray[np.float64]
    information: NDArray[np.float64]

    @classmethod
    def between(cls, seen: Sequence[Appearance]) -> ClassDistances:
        """Compare all parts with one another."""
        if not seen:
            return cls(*(np.zeros((0, 0, 0)) for _ in range(3)))
        rows = [cls.row(one, seen) for one in seen]
        return cls(*(np.stack(parts) for parts in zip(*rows, strict=True)))

    @staticmethod
    def row(one: Appearance, others: Sequence[Appearance]) -> tuple[NDArray[np.float64], ...]:
        """Compare frames of one part with images of others, (m, n) each."""
        names = ("range_m", "weight", "slope", "may", "must")
        stacked = {name: np.stack([getattr(other, name) for other in others]) for name in names}
        cost, gradient, information = one.imitated_by(Appearance(**stacked, sensor=one.sensor))
        return cost, gradient[..., 0], information[..., 0, 0]

    def least(self, distance_information: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return d at the worst distance and in the worse direction, (m, m), infinite on the diagonal.

        Parameters
        ----------
        distance_information : (n,) float64
            I, m⁻².
        """
        squared = (self.cost - self.gradient**2 / (distance_information + self.information)).min(axis=-1)
        squared = np.minimum(squared, squared.T)
        np.fill_diagonal(squared, np.inf)
        return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


def choose_far_apart(distance: NDArray[np.float64], n: int) -> NDArray[np.int64]:
    """Choose n items whose least mutual distance is large: the best pair, the farthest next, then exchanges.

    Parameters
    ----------
    distance : (m, m) float64
        Symmetric, infinite on the diagonal.
    n : int
        Number of landmarks.

    Returns
    -------
    (n,) int64
        Ascending; fewer if there are fewer.
    """
    m = len(distance)
    if m <= n:
        return np.arange(m)
    finite = np.where(np.isfinite(distance), distance, -np.inf)
    chosen = sorted(int(k) for k in np.unravel_index(int(finite.argmax()), finite.shape))[:n]
    while len(chosen) < n:
        nearest = distance[:, chosen].min(axis=1)
        nearest[chosen] = -np.inf
        chosen.append(int(nearest.argmax()))
    best = _least_mutual(distance, chosen)
    improved = True
    while improved:
        improved = False
        for k in range(n):
            others = chosen[:k] + chosen[k + 1 :]
            nearest = distance[:, others].min(axis=1) if others else np.full(m, np.inf)
            nearest[others] = -np.inf
            value = min(float(nearest.max()), _least_mutual(distance, others))
            if value > best * (1 + 1e-12):
                chosen[k], best, improved = int(nearest.argmax()), value, True
    return np.array(sorted(chosen), np.int64)


def _least_mutual(distance: NDArray[np.float64], chosen: Sequence[int]) -> float:
    return float(distance[np.ix_(chosen, chosen)].min()) if len(chosen) > 1 else math.inf


def turn_distance(box: Box, sensor: Sensor, plan: DesignPlan) -> float:
    """Return d between a box at the far end and itself about a quarter-turn on, at the worst of some sides.

    The imitation is sought over distance and side: on a grid, then by Gauss–Newton. Ranges alone cannot tell a narrow
    face from a wide one that is a little farther on, as long as both reach into the same pixels. Infinite for a square
    box, which has no other side to be taken for.
    """
    if box.length_m == box.width_m:
        return math.inf
    renderer = phases_of(Renderer(build_mesh(box_alone(box, plan)), sensor, albedo=plan.albedo))
    rows = renderer.sensor.lower_rows
    far = plan.distance_m[1]
    turn_sides = 7
    sides = np.linspace(0.0, math.pi / 2, turn_sides)
    truth = Appearance.of(renderer, Views.broadcast(far, sides), (), rows, plan.n_frames)
    shift, turn = (grid.ravel() for grid in np.meshgrid(_TURN_SHIFT_M, _TURN_BIAS_RAD, indexing="ij"))
    place = np.empty((turn_sides, 2))
    for k, side in enumerate(sides):
        views = Views.broadcast(far + shift, side + math.pi / 2 + turn)
        others = Appearance.of(renderer, views, (), rows, plan.n_frames)
        best = int(truth[k : k + 1].imitated_by(others)[0].argmin())
        place[k] = views.distance_m[best], views.delta_rad[best]
    turned = sides + math.pi / 2
    bounds = [np.c_[np.full(turn_sides, far + _TURN_SHIFT_M[end]), turned + _TURN_BIAS_RAD[end]] for end in (0, -1)]

    def seen_at(at: NDArray[np.float64], parameters: Sequence[str]) -> Appearance:
        return Appearance.of(renderer, Views.broadcast(at[:, 0], at[:, 1]), parameters, rows, plan.n_frames)

    def limited(at: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.clip(at + step, *bounds))  # a step too long would end at the truth itself

    return float(np.sqrt(least_cost(truth, place, seen_at, limited).min()))
