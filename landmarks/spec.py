"""The description of a landmark: a box below, a solid of revolution above (PHYSICS section 5)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from phasemark.inputs.field_table import FieldTable

_Length = Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)]
_Coordinate = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]


class Box(FieldTable):
    """The lower part: x' along the length, y' along the width, its top in the plane z' = 0.

    Parameters
    ----------
    length_m, width_m, height_m : float
        Sides, metres, in (0, 10].

    Raises
    ------
    UsageError
        With one line that names the field, its value and its range.
    """

    length_m: _Length
    width_m: _Length
    height_m: _Length


class Cylinder(FieldTable):
    """An upright circular cylinder.

    Parameters
    ----------
    kind : {"cylinder"}
        Name of the shape in plans.
    radius_m, height_m : float
        Metres, in (0, 10].
    """

    kind: Literal["cylinder"] = "cylinder"
    radius_m: _Length
    height_m: _Length

    def radius_at_m(self, z_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the radius at heights above the box, metres; 0 where there is none."""
        return np.where((z_m >= 0) & (z_m <= self.height_m), self.radius_m, 0.0)


class Cone(FieldTable):
    """An upright circular cone, its tip up.

    Parameters
    ----------
    kind : {"cone"}
        Name of the shape in plans.
    radius_m : float
        Radius of the base, metres, in (0, 10].
    height_m : float
        Metres, in (0, 10].
    """

    kind: Literal["cone"] = "cone"
    radius_m: _Length
    height_m: _Length

    def radius_at_m(self, z_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the radius at heights above the box, metres; 0 where there is none."""
        return np.where(z_m >= 0, self.radius_m * np.maximum(1 - z_m / self.height_m, 0.0), 0.0)


class Sphere(FieldTable):
    """A sphere that touches the box's top in one point.

    Parameters
    ----------
    kind : {"sphere"}
        Name of the shape in plans.
    radius_m : float
        Metres, in (0, 10].
    """

    kind: Literal["sphere"] = "sphere"
    radius_m: _Length

    def radius_at_m(self, z_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the radius at heights above the box, metres; 0 where there is none."""
        return np.sqrt(np.maximum(self.radius_m**2 - (z_m - self.radius_m) ** 2, 0.0))


class Revolution(FieldTable):
    """A solid of revolution about z' under a profile curve.

    Parameters
    ----------
    kind : {"revolution"}
        Name of the shape in plans.
    profile_m : sequence of (r, z)
        Radius and height along the outline, metres, from its foot at z = 0 to its top; straight between the points.
        An end that is not on the axis is closed by a disc. The curve may not touch itself, and only its ends may lie
        on the axis. Where it turns by more than 30° there is a crease; elsewhere shading is smooth.
    """

    kind: Literal["revolution"] = "revolution"
    profile_m: tuple[tuple[_Coordinate, _Coordinate], ...]

    @field_validator("profile_m")
    @classmethod
    def _is_an_outline(cls, profile: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        if len(profile) < 2:
            raise ValueError("must have at least two points (r, z)")
        if profile[0][1] != 0:
            raise ValueError("must start at z = 0, where the upper part stands on the box")
        if any(r == 0 for r, _ in profile[1:-1]):
            raise ValueError("must have r > 0 between its ends")
        outline = [*profile]
        if profile[0][0] > 0:
            outline.insert(0, (0.0, profile[0][1]))
        if profile[-1][0] > 0:
            outline.append((0.0, profile[-1][1]))
        points = np.array(outline)
        if not np.all(np.any(np.diff(points, axis=0) != 0, axis=1)):
            raise ValueError("must not repeat a point")
        r, z = points.T
        if np.sum(r * np.roll(z, -1) - np.roll(r, -1) * z) <= 0:
            raise ValueError("must run upwards along the outside, and enclose a volume")
        if _touches_itself(points):
            raise ValueError("must not touch or cross itself or the axis between its ends")
        return profile


def _touches_itself(points: NDArray[np.float64]) -> bool:
    """Return True if two segments of a polyline that are not neighbours share a point, or neighbours fold back."""
    start, step = points[:-1], np.diff(points, axis=0)
    before, after = step[:-1], step[1:]
    parallel = before[:, 0] * after[:, 1] == before[:, 1] * after[:, 0]
    if (parallel & ((before * after).sum(axis=1) < 0)).any():
        return True

    def side(i: NDArray[np.intp], p: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.sign(step[i, 0] * (p[:, 1] - start[i, 1]) - step[i, 1] * (p[:, 0] - start[i, 0])))

    i, j = np.triu_indices(len(step), k=2)
    end = points[1:]
    crossing = (side(i, start[j]) * side(i, end[j]) <= 0) & (side(j, start[i]) * side(j, end[i]) <= 0)
    apart = np.any(
        (np.maximum(start[i], end[i]) < np.minimum(start[j], end[j]))
        | (np.maximum(start[j], end[j]) < np.minimum(start[i], end[i])),
        axis=1,
    )
    return bool(np.any(crossing & ~apart))


Upper = Annotated[Cylinder | Cone | Sphere | Revolution, Field(discriminator="kind")]


class LandmarkSpec(FieldTable):
    """A landmark: a box, and on its centre a solid of revolution (PHYSICS sections 1 and 5).

    Parameters
    ----------
    name : str
        Name of the class: letters, digits, ``_``, ``-`` and ``.``, since it becomes a key in files.
    box : Box
        Lower part, z' < 0.
    upper : Cylinder, Cone, Sphere, Revolution or None
        Upper part, z' > 0. In plain data the key ``kind`` says which.
    albedo : float
        Share of light that the surface returns, in (0, 1].

    Raises
    ------
    UsageError
        With one line that names the field, its value and its range.

    Examples
    --------
    >>> box = Box(length_m=0.24, width_m=0.16, height_m=0.15)
    >>> LandmarkSpec(name="mast", box=box, upper=Cylinder(radius_m=0.02, height_m=0.4)).symmetry
    2
    """

    figure: ClassVar[Callable[..., bytes]]
    """Function that draws it; the package sets it, because drawing imports matplotlib, which takes half a second."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=100)]
    box: Box
    upper: Upper | None = None
    albedo: Annotated[float, Field(gt=0, le=1)] = 0.8

    @field_validator("name")
    @classmethod
    def _is_not_reserved(cls, name: str) -> str:
        if name == "none":
            raise ValueError("must not be 'none', which stands for no landmark")
        return name

    @property
    def symmetry(self) -> int:
        """How many turns about the axis leave the landmark as it is: 2, or 4 on a square box."""
        return 4 if self.box.length_m == self.box.width_m else 2

    @property
    def delta_period_rad(self) -> float:
        """The angle modulo which δ can be known, 2π / symmetry."""
        return 2 * math.pi / self.symmetry

    def _repr_png_(self) -> bytes:
        """Show the landmark in a notebook."""
        return type(self).figure(self)
