"""The rules of the paper's section 4.1 as numbers: in view, large enough, resolvable, bright enough.

What the rules leave of each dimension is :class:`AllowedDimensions`; if they leave nothing, it says which two
contradict.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.landmarks import LandmarkSpec
from phasemark.landmarks.revolve import outline
from phasemark.landmarks.spec import Box, Sphere, Upper
from phasemark.matcher.design.plan import DesignPlan
from phasemark.render import Sensor, predicted_range_std


@dataclass(frozen=True)
class Check:
    """Result of one rule for one landmark.

    Parameters
    ----------
    rule : str
        Name of the rule.
    value, limit : float
        Value of the landmark, and the rule's limit.
    unit : str
        Unit of value and limit.
    at_most : bool
        Whether the limit is the largest value allowed, or the least.
    """

    rule: str
    value: float
    limit: float
    unit: str
    at_most: bool

    @property
    def passes(self) -> bool:
        """Whether the rule is kept."""
        rounding_m = 1e-9  # dimensions are decimal; sums of them may miss a limit by the last bit
        if self.at_most:
            return bool(self.value <= self.limit + rounding_m)
        return bool(self.value >= self.limit - rounding_m)

    def __str__(self) -> str:
        sign = "at most" if self.at_most else "at least"
        return f"{self.rule}: {self.value:.4g} {self.unit}, must be {sign} {self.limit:.4g} {self.unit}"


def upper_outline(upper: Upper) -> NDArray[np.float64]:
    """Return the profile (r, z) of an upper part, (k, 2), a sphere's in steps of 2°."""
    if isinstance(upper, Sphere):
        turn = np.linspace(-math.pi / 2, math.pi / 2, 91)
        return np.asarray(upper.radius_m * np.c_[np.cos(turn), 1 + np.sin(turn)])
    return np.array(outline(upper))


def upper_size(upper: Upper) -> tuple[float, float]:
    """Return the largest radius and the height of an upper part, metres."""
    profile = upper_outline(upper)
    return float(profile[:, 0].max()), float(profile[:, 1].max())


@dataclass(frozen=True)
class AllowedDimensions:
    """Dimensions of a landmark that the rules allow.

    Parameters
    ----------
    plan : DesignPlan
        Plan of the design.
    sensor : Sensor
        The camera.
    """

    plan: DesignPlan
    sensor: Sensor

    @property
    def half_field(self) -> tuple[float, float]:
        """Tangents of the narrower half of the field sideways, and of half of it up and down."""
        tan_h, tan_v = self.sensor.tan_half_angles
        u0 = self.sensor.centre_px[0] / self.sensor.cols
        if self.sensor.lens is not None:
            row = min(max(self.sensor.centre_px[1], 0.0), float(self.sensor.rows))
            left, right = (float(self.sensor.tangents(u, row)[0]) for u in (0.0, self.sensor.cols))
            return min(left, -right), tan_v
        return 2 * tan_h * min(u0, 1 - u0), tan_v

    @property
    def far_pixel_m(self) -> tuple[float, float]:
        """Width and height that a pixel sees at the far end."""
        tan_h, tan_v = self.sensor.tan_half_angles
        far = self.plan.distance_m[1]
        return 2 * far * tan_h / self.sensor.cols, 2 * far * tan_v / self.sensor.rows

    @property
    def widest_m(self) -> float:
        """Largest circle about the axis that is in view at the near end: its diameter."""
        near, tangent = self.plan.distance_m[0], self.half_field[0]
        whole = self.plan.limits.fit == "whole"
        return 2 * near * (math.sin(math.atan(tangent)) if whole else tangent)

    @property
    def tallest_m(self) -> float:
        """Height above, or depth below the middle line that is in view at the near end, at the axis."""
        return self.plan.distance_m[0] * self.half_field[1]

    def reach_m(self, radius_m: float, z_m: float) -> float:
        """Return how much of :attr:`tallest_m` a point so far from the axis and the middle line takes."""
        return z_m + (radius_m * self.half_field[1] if self.plan.limits.fit == "whole" else 0.0)

    @property
    def side_m(self) -> tuple[float, float]:
        """Least and greatest side of a square box."""
        extents = self.plan.limits.extents_m
        return self.plan.limits.least_box_edge_px * self.far_pixel_m[0], min(
            extents[0], extents[1], self.widest_m / math.sqrt(2)
        )

    @property
    def box_height_m(self) -> tuple[float, float]:
        """Least and greatest height of the least box."""
        least = self.plan.limits.least_box_edge_px * self.far_pixel_m[1]
        radius = self.side_m[0] / math.sqrt(2)
        above = self.plan.limits.least_upper_edge_px * self.far_pixel_m[1]
        free = self.tallest_m - self.reach_m(radius, 0.0)
        return least, min(free, self.plan.limits.extents_m[2] - above)

    @property
    def upper_radius_m(self) -> tuple[float, float]:
        """Least and greatest radius of the part above."""
        return self.plan.limits.least_upper_edge_px * self.far_pixel_m[0] / 2, self.side_m[1] / 2

    @property
    def upper_height_m(self) -> tuple[float, float]:
        """Least and greatest height of the part above."""
        least = self.plan.limits.least_upper_edge_px * self.far_pixel_m[1]
        free = self.tallest_m - self.reach_m(self.upper_radius_m[0], 0.0)
        return least, min(free, self.plan.limits.extents_m[2] - self.box_height_m[0])

    def longest_m(self, width_m: float) -> float:
        """Return the greatest length of a box of some width."""
        return min(self.plan.limits.extents_m[0], math.sqrt(max(self.widest_m**2 - width_m**2, 0.0)))

    def deepest_m(self, length_m: float, width_m: float) -> float:
        """Return the greatest height of a box of some length and width."""
        free = self.tallest_m - self.reach_m(math.hypot(length_m, width_m) / 2, 0.0)
        return min(free, self.plan.limits.extents_m[2] - self.upper_height_m[0])

    def check_possible(self) -> None:
        """Refuse a working range that no landmark can serve.

        Raises
        ------
        UsageError
            With the rules that contradict one another, and their numbers.
        """
        near, far = self.plan.distance_m
        where = f"no landmark can serve {near:g} … {far:g} m"
        for check in (*self._light(), *self._unambiguous(0.0)):
            if not check.passes:
                raise UsageError(f"{where}: rule {check}")
        limits = self.plan.limits
        pixel_w, pixel_h = self.far_pixel_m
        for what, (least, most), count, pixel in (
            ("a box so wide", self.side_m, limits.least_box_edge_px, pixel_w),
            ("a box so high", self.box_height_m, limits.least_box_edge_px, pixel_h),
            ("an upper part of this radius", self.upper_radius_m, limits.least_upper_edge_px / 2, pixel_w),
            ("an upper part so high", self.upper_height_m, limits.least_upper_edge_px, pixel_h),
        ):
            if least > most:
                raise UsageError(
                    f"{where}: rule 'edges resolvable' asks for {what}: {least:.3f} m, {count:g} pixels of"
                    f" {pixel:.4f} m at {far:g} m; rules 'in view' at {near:g} m and 'extents' leave"
                    f" {max(most, 0):.3f} m"
                )

    def checks(self, spec: LandmarkSpec) -> list[Check]:
        """Check a landmark by the rules of geometry and light."""
        upper = () if spec.upper is None else self.upper_checks(spec.box, spec.upper)
        return [*self._box(spec.box), *upper, *self._light()]

    def _box(self, box: Box) -> Iterator[Check]:
        extents, limits = self.plan.limits.extents_m, self.plan.limits
        radius = math.hypot(box.length_m, box.width_m) / 2
        pixel_w, pixel_h = self.far_pixel_m
        yield Check("extent x'", box.length_m, extents[0], "m", True)
        yield Check("extent y'", box.width_m, extents[1], "m", True)
        yield Check("in view sideways, near end", 2 * radius, self.widest_m, "m", True)
        yield Check("in view downwards, near end", self.reach_m(radius, box.height_m), self.tallest_m, "m", True)
        edge = min(box.length_m / pixel_w, box.width_m / pixel_w, box.height_m / pixel_h)
        yield Check("edges of the box resolvable, far end", edge, limits.least_box_edge_px, "px", False)
        yield from self._unambiguous(radius)

    def upper_checks(self, box: Box, upper: Upper) -> Iterator[Check]:
        """Check an upper part on a box by its rules."""
        extents, limits = self.plan.limits.extents_m, self.plan.limits
        radius, height = upper_size(upper)
        pixel_w, pixel_h = self.far_pixel_m
        reach = max(self.reach_m(r, z) for r, z in upper_outline(upper))
        yield Check("extent z'", box.height_m + height, extents[2], "m", True)
        yield Check("in view upwards, near end", reach, self.tallest_m, "m", True)
        yield Check("stands on the box", 2 * radius, min(box.length_m, box.width_m), "m", True)
        edge = min(2 * radius / pixel_w, height / pixel_h)
        yield Check("edges of the upper part resolvable, far end", edge, limits.least_upper_edge_px, "px", False)

    def _light(self) -> Iterator[Check]:
        far = self.plan.distance_m[1]
        slant_cosine = 0.5
        amplitude = self.plan.albedo * slant_cosine / far**2
        std = max(
            float(predicted_range_std(amplitude, amplitude, camera)) / camera.metres_per_radian
            for camera in self.sensor.by_frequency
        )
        yield Check("reflecting enough, far end", std, self.plan.limits.most_phase_std_rad, "rad", True)

    def _unambiguous(self, radius_m: float) -> Iterator[Check]:
        reach = self.plan.distance_m[1] + radius_m
        yield Check("within the unambiguous range", reach, self.sensor.unambiguous_range_m, "m", True)
