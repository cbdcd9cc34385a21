"""The lens of a camera as OpenCV and ROS state it (PHYSICS section 9)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from phasemark import UsageError
from phasemark.inputs.field_table import FieldTable
from phasemark.render.sensor.lens_map import LensMap, distort, lens_map

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

_Focal = Annotated[float, Field(ge=1e-3, le=1e6, allow_inf_nan=False)]
_Centre = Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False)]
_Coefficient = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]

_COUNTS = {"opencv": (0, 4, 5, 8), "fisheye": (0, 4)}
_ORDERS = {"opencv": "k1 k2 p1 p2, then k3, then k4 k5 k6", "fisheye": "k1 k2 k3 k4"}

_NAMES = {"opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), "fisheye": ("k1", "k2", "k3", "k4")}
_INTRINSICS = ("fx", "fy", "cx", "cy")

TERMS = (*_INTRINSICS, *_NAMES["opencv"])
"""Names of all numbers that a lens may have; a lens has those of its model, as many as it states."""

LENS_FIELD = "lens."
"""What stands before a term where it is named among the fields of a sensor, as in `calibration_fields`."""

_MOST_PIXELS = 4096  # along a side of an image
_OFF_CENTRE = 0.4  # of the image's size, how far from its centre the principal point of a whole image may lie
_FARTHEST = 1.0  # the same of a camera that may read a part of an image
_MOST_STEPS = 30
_POINTS = 9  # along each side of the image at which its motion is asked
_STEP = 1e-30  # of a complex derivative
_SAME = 1e-5  # relative difference up to which a stated field agrees with the lens

DERIVED = ("half_angle_h_deg", "half_angle_v_deg", "principal_point_px")
"""Fields of a sensor that follow from its lens."""


class Lens(FieldTable):
    """A lens with distortion, as OpenCV and ROS state it: the table ``[lens]`` of a sensor file.

    OpenCV counts pixels from the *centre* of the first one, this program from the corner of the image: OpenCV's point
    (0, 0) is u = v = ½ here. Stated as OpenCV has it, nothing needs to be added.

    Parameters
    ----------
    model : {"opencv", "fisheye"}
        Polynomial or rational distortion with tangential terms, or OpenCV's fisheye model (Kannala and Brandt).
    fx, fy : float
        Focal lengths, pixels.
    cx, cy : float
        Principal point, pixels from the centre of the first pixel.
    distortion : tuple of float
        Coefficients in OpenCV's order. "opencv": k1 k2 p1 p2, 5 of them with k3, 8 with k4 k5 k6. "fisheye": k1 k2 k3
        k4. Empty: none.

    Raises
    ------
    UsageError
        A value is out of range, or the number of coefficients does not belong to the model.
    """

    model: Literal["opencv", "fisheye"] = "opencv"
    fx: _Focal
    fy: _Focal
    cx: _Centre
    cy: _Centre
    distortion: tuple[_Coefficient, ...] = ()

    @classmethod
    def _refusal(cls, first: ErrorDetails) -> UsageError:
        if first["type"] == "extra_forbidden":
            return UsageError(f"'{first['loc'][0]}' is no key of [lens]: it has {', '.join(cls.model_fields)}")
        return super()._refusal({**first, "loc": ("lens", *first["loc"])})

    @model_validator(mode="after")
    def _coefficients_belong_to_the_model(self) -> Self:
        if len(self.distortion) not in _COUNTS[self.model]:
            wanted = " or ".join(str(n) for n in _COUNTS[self.model] if n)
            raise ValueError(
                f"'lens.distortion' must have {wanted} coefficients for the model '{self.model}'"
                f" ({_ORDERS[self.model]}), got {len(self.distortion)}"
            )
        return self

    @property
    def terms(self) -> dict[str, float]:
        """The numbers of the lens by their names: fx, fy, cx, cy, and the coefficients that it states."""
        distortion = zip(_NAMES[self.model], self.distortion, strict=False)
        return {**{name: getattr(self, name) for name in _INTRINSICS}, **dict(distortion)}

    def with_terms(self, **changes: float) -> Lens:
        """Return a lens with some of its :attr:`terms` changed, validated again.

        Raises
        ------
        UsageError
            The lens has no such term, or a value is out of range.
        """
        terms = self.terms
        for name in changes:
            if name not in terms:
                raise UsageError(
                    f"a lens of the model '{self.model}' with {len(self.distortion)} coefficients has the"
                    f" terms {', '.join(terms)}, got {name!r}"
                )
        terms |= changes
        distortion = tuple(terms[name] for name in _NAMES[self.model][: len(self.distortion)])
        return Lens(model=self.model, **{name: terms[name] for name in _INTRINSICS}, distortion=distortion)

    @property
    def is_ideal(self) -> bool:
        """Whether the lens bends no ray: a pinhole."""
        return self.model == "opencv" and not any(self.distortion)

    @property
    def bends_middle_row(self) -> bool:
        """Whether the row of the principal point is bent: y_d = p1 · x² there, for rays that are level."""
        return self.model == "opencv" and len(self.distortion) > 2 and self.distortion[2] != 0

    def before(self, rows: int, cols: int) -> LensMap:
        """Return the lens before an image of rows × cols pixels.

        Raises
        ------
        ValueError
            The lens folds inside the image; with one line.
        """
        return lens_map(self.model, (self.fx, self.fy, self.cx, self.cy), self.distortion, rows, cols)


def with_geometry_of_lens(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a sensor with those that follow from its lens, if it has one.

    Parameters
    ----------
    data : mapping of str to object
        Fields as stated.

    Raises
    ------
    UsageError
        A stated field contradicts the lens, or the lens does not belong to an image of this size.
    """
    fields = dict(data)
    lens = fields.get("lens")
    if isinstance(lens, Mapping):
        fields["lens"] = lens = Lens(**lens)
    rows, cols = (_pixels(fields.get(name)) for name in ("rows", "cols"))
    if not isinstance(lens, Lens) or rows is None or cols is None:
        return fields  # what is wrong about them is found where fields are checked
    centre = (lens.cx + 0.5, lens.cy + 0.5)
    whole = fields.get("whole_image_px")
    check_image_size(lens, rows, cols, whole if _is_pair(whole) else None, farthest=_FARTHEST)
    try:
        tan_h, tan_v = lens.before(rows, cols).tan_half_angles
    except ValueError as error:
        raise UsageError(str(error)) from None
    derived = {
        "half_angle_h_deg": math.degrees(math.atan(tan_h)),
        "half_angle_v_deg": math.degrees(math.atan(tan_v)),
        "principal_point_px": None if centre == (cols / 2, rows / 2) else centre,
    }
    for name in DERIVED:
        stated = fields.get(name)
        if stated is not None and not _agrees(stated, centre if name == "principal_point_px" else derived[name]):
            shown = f"({centre[0]:.7g}, {centre[1]:.7g})" if name == "principal_point_px" else f"{derived[name]:.7g}"
            raise UsageError(f"'{name}' must be left out beside 'lens', from which it follows as {shown}, got {stated}")
    return {**fields, **derived}


def farthest_principal_point(
    image_px: tuple[float, float], whole_image_px: tuple[float, float] | None
) -> tuple[float, float]:
    """Return how far from the centre of an image its principal point may lie at most, along columns and rows, pixels.

    Parameters
    ----------
    image_px : (width, height)
    whole_image_px : (width, height) or None
        The image that this one is a part of.
    """
    farthest_of_part = 1.5  # of the whole image's size, from the centre of a part of it
    size, share = (image_px, _FARTHEST) if whole_image_px is None else (whole_image_px, farthest_of_part)
    return share * size[0], share * size[1]


def check_image_size(
    lens: Lens,
    rows: int,
    cols: int,
    whole_image_px: tuple[float, float] | None = None,
    *,
    farthest: float = _OFF_CENTRE,
) -> None:
    """Refuse a lens whose principal point lies farther from the centre of an image than `farthest` image sizes.

    Parameters
    ----------
    lens : Lens
    rows, cols : int
        Of the image.
    whole_image_px : (width, height), optional
        The image that this one is a part of; how far the point may lie then follows from it.
    farthest : float
        Of a whole image, in its sizes.

    Raises
    ------
    UsageError
    """
    if whole_image_px is None:
        limits = farthest * cols, farthest * rows
    else:
        limits = farthest_principal_point((cols, rows), whole_image_px)
    sides = (("cx", lens.cx, cols, "columns"), ("cy", lens.cy, rows, "rows"))
    for (name, at, size, side), limit in zip(sides, limits, strict=True):
        if abs(at + 0.5 - size / 2) > limit:
            raise UsageError(
                f"'lens.{name}' must lie near the middle of an image of {size} {side}, got {at:g}: do the intrinsics"
                " belong to another image size?"
            )


def changed_lens(lens: Lens, rows: int, cols: int, changes: Mapping[str, Any]) -> Lens:
    """Return a lens with the focal lengths and the principal point that fields which follow from it ask for.

    Parameters
    ----------
    lens : Lens
    rows, cols : int
        Of the image.
    changes : mapping of str to object
        Half angles and principal point that the lens is to have, among :data:`DERIVED`; others are left alone.
    """
    point = changes.get("principal_point_px")
    if point is not None:
        lens = lens.with_terms(cx=point[0] - 0.5, cy=point[1] - 0.5)
    solved = 1e-13  # relative difference of tangents up to which focal lengths are solved for
    for name, focal, axis in (("half_angle_h_deg", "fx", 0), ("half_angle_v_deg", "fy", 1)):
        if name not in changes:
            continue
        wanted = math.tan(math.radians(changes[name]))
        for _ in range(_MOST_STEPS):  # the tangents go nearly with the reciprocal of the focal length
            ratio = lens.before(rows, cols).tan_half_angles[axis] / wanted
            if abs(ratio - 1) < solved:
                break
            lens = lens.with_terms(**{focal: getattr(lens, focal) * ratio})
    return lens


def lens_rates(lens: Lens, rows: int, cols: int) -> dict[str, float]:
    """Return by how much a unit of each term moves the image point that it moves most, as a tangent.

    The derivative of the distorted coordinates, by complex steps; that of a focal length is x_d / fx, that of the
    principal point 1 / fx.

    Parameters
    ----------
    lens : Lens
    rows, cols : int
        Of the image.

    Examples
    --------
    >>> lens_rates(Lens(fx=10, fy=20, cx=7.5, cy=7.5), 16, 16)
    {'fx': 0.08, 'fy': 0.02, 'cx': 0.1, 'cy': 0.05}
    """
    before = lens.before(rows, cols)
    u, v = np.meshgrid(np.linspace(0, cols, _POINTS), np.linspace(0, rows, _POINTS))
    y, z = before.rays(u, v)
    x_d, y_d = distort(before.model, before.k, -y, -z)[:2]
    rates = {
        "fx": float(np.abs(x_d).max()) / lens.fx,
        "fy": float(np.abs(y_d).max()) / lens.fy,
        "cx": 1 / lens.fx,
        "cy": 1 / lens.fy,
    }
    for k, name in enumerate(list(lens.terms)[len(rates) :]):
        coefficients = before.k.astype(complex)
        coefficients[k] += 1j * _STEP
        a, b = distort(before.model, coefficients, -y, -z)[:2]
        rates[name] = float(np.hypot(a.imag, b.imag).max()) / _STEP
    return rates


def _pixels(value: Any) -> int | None:
    """Return a side of an image as a whole number, None where it is none."""
    if not isinstance(value, int | float | np.integer) or not 1 <= value <= _MOST_PIXELS or value != int(value):
        return None
    return int(value)


def _is_pair(value: Any) -> bool:
    """Return True if a value is two numbers; other faults are found where fields are checked."""
    try:
        return np.asarray(value, float).shape == (2,)
    except (TypeError, ValueError):
        return False


def _agrees(stated: Any, derived: Any) -> bool:
    try:
        return bool(np.allclose(np.asarray(stated, float), derived, rtol=_SAME, atol=1e-9))
    except (TypeError, ValueError):
        return False
