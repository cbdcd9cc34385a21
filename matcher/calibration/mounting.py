"""Parameters of a calibration, and the mounting that they make up.

The mounting is ten numbers, :class:`Mounting`. Four of them turn or widen the camera itself (pitch, roll and both
half angles), two move the landmark in its image (height and bearing), one delays the light (range offset), one the time
stamps (delay, for a moving camera), and two are not the camera's: the brightness of the landmark (albedo) and of a
floor off which light bounces (floor_albedo). Where the camera has a lens, its terms follow these ten, and both half
angles follow from it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render import Sensor
from phasemark.render.sensor.lens_fields import LENS_FIELD, TERMS, Lens


@dataclass(frozen=True)
class Parameter:
    """One number of a mounting.

    Parameters
    ----------
    name : str
        As options have it, e.g. ``pitch``.
    title : str
        As sentences have it.
    attribute : str, optional
        Of :class:`Mounting`, with its unit inside the program; None: a term of its lens.
    scale : float
        Its natural unit: 1°, 1 cm, a tenth of albedo; what steps and conditions are told in. That of a term of a lens
        depends on the image, see :attr:`~phasemark.matcher.calibration.mounting_model.CalibrationModel.scale`.
    shown : float
        Multiplies it for people: degrees, millimetres.
    unit : str
        Of what is shown.
    field : str, optional
        Of :class:`~phasemark.render.Sensor`; None: the sensor file has no place for it.
    limits : (least, most)
    prior : float
        How far it is from what is assumed, as a standard deviation; see :func:`prior_std`.
    """

    name: str
    title: str
    attribute: str | None
    scale: float
    shown: float
    unit: str
    field: str | None
    limits: tuple[float, float] = (-math.inf, math.inf)
    prior: float = math.nan

    @property
    def in_file(self) -> float:
        """Multiplies it for the field of the sensor: degrees, metres, seconds, pixels."""
        return self.shown if self.unit == "°" else 1.0

    def text(self, value: float) -> str:
        """Return a value of it in words: three digits and the unit."""
        return f"{self.shown * value:.3g}{'' if self.unit in ('', '°') else ' '}{self.unit}"


_DEGREE = math.radians(1.0)
_ANGLE, _LENGTH, _PIXELS = (_DEGREE, 1 / _DEGREE, "°"), (0.01, 1e3, "mm"), (1.0, 1.0, "px")
_TILT, _WIDTH = ((-0.75, 0.75), 2 * _DEGREE), ((0.01, 1.4), 0.05)
PARAMETERS = {
    parameter.name: parameter
    for parameter in (
        Parameter("pitch", "pitch", "pitch_rad", *_ANGLE, "pitch_deg", *_TILT),
        Parameter("roll", "roll", "roll_rad", *_ANGLE, "roll_deg", *_TILT),
        Parameter("height", "height", "height_m", *_LENGTH, "height_offset_m", (-2.0, 2.0), 0.05),
        Parameter("bearing", "bearing", "bearing_rad", *_ANGLE, "bearing_offset_deg", (-1.2, 1.2), math.radians(3.0)),
        Parameter("half_angle_h", "horizontal field of view", "half_angle_h_rad", *_ANGLE, "half_angle_h_deg", *_WIDTH),
        Parameter("half_angle_v", "vertical field of view", "half_angle_v_rad", *_ANGLE, "half_angle_v_deg", *_WIDTH),
        Parameter("range_offset", "range offset", "range_offset_m", *_LENGTH, "range_offset_m", prior=0.05),
        Parameter("albedo", "albedo", "albedo", 0.1, 1.0, "", None, (1e-3, math.inf)),
        Parameter("delay", "delay", "delay_s", 0.01, 1e3, "ms", "delay_s", (-10.0, 10.0), 0.2),
        Parameter("floor_albedo", "albedo of the floor", "floor_albedo", 0.1, 1.0, "", None, (0.02, 0.98), 0.16),
        *(Parameter(f, f"focal length {f}", None, *_PIXELS, LENS_FIELD + f, prior=0.05) for f in TERMS[:2]),
        *(Parameter(c, f"principal point {c}", None, *_PIXELS, LENS_FIELD + c, prior=2.0) for c in TERMS[2:4]),
        *(Parameter(k, f"distortion {k}", None, 1.0, 1.0, "", LENS_FIELD + k, prior=3.0) for k in TERMS[4:]),
    )
}
"""What a calibration can estimate, by name."""
ALL_NAMES = tuple(PARAMETERS)
"""The order of the parameter vector."""
MOUNTING_NAMES = tuple(name for name in ALL_NAMES if name not in TERMS)
"""All but the terms of a lens, which follow in the vector."""
HALF_ANGLES = ("half_angle_h", "half_angle_v")
NAMES = tuple(name for name in MOUNTING_NAMES if name not in ("delay", "floor_albedo"))
"""What frames from still poses can tell where no light bounces; the delay takes a moving camera."""
_RELATIVE = (*HALF_ANGLES, "fx", "fy")
"""What has a prior relative to its assumed value."""


def columns_of(names: Sequence[str]) -> NDArray[np.int64]:
    """Return where parameters stand in the vector."""
    return np.array([ALL_NAMES.index(name) for name in names], np.int64)


def clipped(theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Clip a mounting to the limits of its parameters."""
    return np.asarray(np.clip(theta, *np.transpose([parameter.limits for parameter in PARAMETERS.values()])))


def prior_std(name: str, assumed: NDArray[np.float64], scale: NDArray[np.float64]) -> float:
    """Return the prior standard deviation of a parameter in its unit: radians, metres, seconds, pixels.

    That of half angles and focal lengths is relative, that of principal point and distortion is in natural units. It is
    also the range in which the model is trusted: a result more than three of these from the assumed value is rejected.

    Parameters
    ----------
    name : str
    assumed, scale : (22,) float64
        What is assumed, and natural units.
    """
    column, std = ALL_NAMES.index(name), PARAMETERS[name].prior
    if name in _RELATIVE:
        return std * float(assumed[column])
    return std * (float(scale[column]) if name in TERMS else 1.0)


def named(names: Sequence[str]) -> str:
    """Put names of parameters into a list in words."""
    titles = [PARAMETERS[name].title for name in names]
    return titles[0] if len(titles) == 1 else f"{', '.join(titles[:-1])} and {titles[-1]}"


def check_names(names: Sequence[str], what: str, lens: Lens | None = None) -> tuple[str, ...]:
    """Return names of parameters in their order; ``fov`` stands for both half angles, ``lens`` for all of a lens.

    Parameters
    ----------
    names : sequence of str
    what : str
        Name of the argument, for messages.
    lens : Lens, optional
        That of the camera.

    Raises
    ------
    UsageError
        A name is unknown, or means what this camera has not.
    """
    terms = () if lens is None else tuple(lens.terms)
    groups = {"fov": HALF_ANGLES, "lens": terms}
    for name in names:
        if name not in groups and name not in ALL_NAMES:
            raise UsageError(
                f"{what} must be among {', '.join(MOUNTING_NAMES)} and fov (both half angles), or the terms of a lens"
                f" {', '.join(TERMS)} and lens (all of them), got {name!r}"
            )
        if lens is None and name in ("lens", *TERMS):
            raise UsageError(
                f"{what}: {name!r} belongs to a sensor with a lens, and this one has none: give it a table [lens] in"
                " its sensor file ('phasemark sensor import CAMERA_INFO' writes one)"
            )
        if lens is not None and name in ("fov", *HALF_ANGLES):
            raise UsageError(
                f"{what}: {name!r} follows from the lens of this sensor: name its terms instead, {', '.join(terms)} or"
                " lens (all of them)"
            )
        if name in TERMS and name not in terms:
            raise UsageError(
                f"{what}: the lens of this sensor has no {name!r}: it has {', '.join(terms)}; state the coefficient in"
                " 'lens.distortion', 0 if it is not known"
            )
    spelled = {own for name in names for own in groups.get(name, (name,))}
    return tuple(name for name in ALL_NAMES if name in spelled)


def lens_of(template: Lens, theta: NDArray[np.float64]) -> Lens:
    """Return the lens that a parameter vector means, with the model and as many coefficients as another one.

    Raises
    ------
    UsageError
        A number is out of range.
    """
    return template.with_terms(**{name: float(theta[ALL_NAMES.index(name)]) for name in template.terms})


@dataclass(frozen=True)
class Mounting:
    """Parameters of a mounting, and the few of the camera itself that frames from known positions determine.

    Parameters
    ----------
    pitch_rad, roll_rad : float
        Tilt, PHYSICS section 2.
    height_m : float
        Of the landmark's origin above the lens, where a pose's own height is zero.
    bearing_rad : float
        Azimuth of the landmark's axis in the camera frame, where a pose's own bearing is zero.
    half_angle_h_rad, half_angle_v_rad : float
        Half of the field of view, horizontally and vertically, radians.
    range_offset_m : float
        Constant error of all ranges, metres.
    albedo : float
        Of the landmark.
    delay_s : float
        Added to the stamp of a frame to get the time at which the camera was where the frame shows it.
    floor_albedo : float
        Of a floor behind the landmark, where light bounces.
    lens : Lens, optional
        Of the camera; then both half angles follow from it. None: the ideal lens.
    """

    pitch_rad: float
    roll_rad: float
    height_m: float
    bearing_rad: float
    half_angle_h_rad: float
    half_angle_v_rad: float
    range_offset_m: float
    albedo: float
    delay_s: float = 0.0
    floor_albedo: float = 0.5
    lens: Lens | None = None

    @classmethod
    def of_sensor(cls, sensor: Sensor, albedo: float) -> Mounting:
        """Read the mounting that a sensor states."""
        stated = {
            one.attribute: math.radians(sensor.number(one.field)) if one.unit == "°" else sensor.number(one.field)
            for one in PARAMETERS.values()
            if one.attribute is not None and one.field is not None
        }
        return cls(**stated, albedo=albedo, lens=sensor.lens)

    @classmethod
    def of_vector(cls, theta: NDArray[np.float64], sensor: Sensor) -> Mounting:
        """Take numbers in the order of :data:`ALL_NAMES`.

        Parameters
        ----------
        theta : (22,) float64
            The numbers in the order of the fields, metres and radians.
        sensor : Sensor
            Whose kind of lens the terms belong to, if it has one.

        Raises
        ------
        UsageError
            The terms make no lens.
        ValueError
            The lens folds inside the image.
        """
        mounting = cls(*theta[: len(MOUNTING_NAMES)].tolist())
        if sensor.lens is None:
            return mounting
        lens = lens_of(sensor.lens, theta)
        across, along = lens.before(sensor.rows, sensor.cols).tan_half_angles
        return replace(mounting, half_angle_h_rad=math.atan(across), half_angle_v_rad=math.atan(along), lens=lens)

    @property
    def vector(self) -> NDArray[np.float64]:
        """The numbers in the order of :data:`ALL_NAMES`, (22,); 0 for terms that no lens has."""
        terms = {} if self.lens is None else self.lens.terms
        return np.array(
            [getattr(self, one.attribute) if one.attribute else terms.get(one.name, 0.0) for one in PARAMETERS.values()]
        )

    def number(self, name: str) -> float:
        """Return one of the numbers by its name."""
        return float(self.vector[ALL_NAMES.index(name)])

    def on(self, sensor: Sensor) -> Sensor:
        """Return a sensor mounted like this; one with a lens gets that of the mounting, if it has one.

        Raises
        ------
        UsageError
            The lens folds inside the image, or the sensor has none.
        """
        if self.lens is not None and sensor.lens is None:
            raise UsageError("a mounting with a lens belongs to a sensor with a lens, and this one has none")
        changes: dict[str, object] = {}
        for name in MOUNTING_NAMES:
            one = PARAMETERS[name]
            if one.field is not None and one.attribute is not None and (sensor.lens is None or name not in HALF_ANGLES):
                value = getattr(self, one.attribute)
                changes[one.field] = math.degrees(value) if one.unit == "°" else value
        if self.lens is not None:
            changes["lens"] = self.lens
        return sensor.with_(**changes)
