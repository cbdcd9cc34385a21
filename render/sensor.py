"""The camera: geometry, modulation, electrons and the switches of its errors, as one frozen value object."""

from __future__ import annotations

import math
import tomllib
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from phasemark import InputFileError, UsageError

SPEED_OF_LIGHT_M_S = 299_792_458.0

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_Fraction = Annotated[float, Field(gt=0, le=1)]
_HalfAngleDeg = Annotated[float, Field(gt=0, lt=85)]
_TiltDeg = Annotated[float, Field(ge=-45, le=45)]
_PixelCount = Annotated[int, Field(ge=1, le=4096)]

# What an image's rays and phases depend on: cameras that agree in these see the same noise-free image.
_OPTICS = (
    "rows",
    "cols",
    "half_angle_h_deg",
    "half_angle_v_deg",
    "centre_px",
    "pitch_deg",
    "roll_deg",
    "fill_factor",
    "vignetting",
    "modulation_hz",
)


class Sensor(BaseModel):
    """A time-of-flight camera (PHYSICS sections 2 and 4).

    Frozen, and valid once built; :meth:`with_` derives a changed copy. Every error term is neutral by default, so
    ``Sensor(rows=16, cols=16, half_angle_h_deg=11, half_angle_v_deg=11)`` is a camera with shot noise alone.

    Parameters
    ----------
    rows, cols : int
        Size of the image, pixels.
    half_angle_h_deg, half_angle_v_deg : float
        Half angle from the optical axis to the left/right and top/bottom *edge* of the image, degrees.
    principal_point_px : (u0, v0), optional
        Where the optical axis meets the image, pixels from the top left corner. None: the centre.
    pitch_deg, roll_deg : float
        How the camera is mounted; pitch is positive looking down.
    fill_factor : (width, height)
        Light-sensitive share of the pixel's pitch, a centred rectangle.
    vignetting : bool
        Whether brightness falls as cos⁴ of the angle off the axis.
    modulation_hz : float
        Modulation frequency f; the range wraps at c / 2f.
    frame_rate_hz : float
        Frames a second, four phase images each.
    contrast : float
        Demodulation contrast K, in (0, 1].
    signal_e : float
        Electrons per phase image, both taps, that intensity 1 produces.
    ambient_e, dark_e : float
        Unmodulated electrons per phase image, both taps: ambient light and dark current.
    read_noise_e : float
        Read noise, e- r.m.s. per tap and phase image.
    shot_noise : bool
        Whether electrons arrive as a Poisson process.
    max_phase_std_rad : float or None
        A pixel is valid when its predicted one-frame phase noise is at most this; None: any amplitude above zero.

    Raises
    ------
    UsageError
        With one line that names the field, its value and its range.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)

    rows: _PixelCount
    cols: _PixelCount
    half_angle_h_deg: _HalfAngleDeg
    half_angle_v_deg: _HalfAngleDeg
    principal_point_px: tuple[float, float] | None = None
    pitch_deg: _TiltDeg = 0.0
    roll_deg: _TiltDeg = 0.0
    fill_factor: tuple[_Fraction, _Fraction] = (1.0, 1.0)
    vignetting: bool = False
    modulation_hz: _Positive = 10e6
    frame_rate_hz: _Positive = 3.0
    contrast: _Fraction = 0.5
    signal_e: _Positive = 35_571.0
    ambient_e: _NonNegative = 0.0
    dark_e: _NonNegative = 0.0
    read_noise_e: _NonNegative = 0.0
    shot_noise: bool = True
    max_phase_std_rad: _Positive | None = None

    def __init__(self, **data: Any) -> None:
        try:
            super().__init__(**data)
        except ValidationError as error:
            first = error.errors()[0]
            raise UsageError.of_field(
                first["loc"], first["type"], first["msg"], first["input"], whole="principal_point_px"
            ) from None

    @model_validator(mode="after")
    def _principal_point_near_the_image(self) -> Self:
        if self.principal_point_px is not None:
            u0, v0 = self.principal_point_px
            if not (abs(u0 - self.cols / 2) <= self.cols and abs(v0 - self.rows / 2) <= self.rows):
                raise ValueError("must lie within one image width and height of the image's centre")
        return self

    def with_(self, **changes: Any) -> Sensor:
        """Return a copy with some fields changed, validated again."""
        return Sensor(**{**self.model_dump(), **changes})

    @classmethod
    def from_intrinsics(
        cls, fx: float, fy: float, cx: float, cy: float, *, rows: int, cols: int, **fields: Any
    ) -> Sensor:
        """Build a sensor from pinhole intrinsics.

        Parameters
        ----------
        fx, fy : float
            Focal lengths, pixels.
        cx, cy : float
            Principal point, pixels from the *corner* of the image (a pixel's centre is at ½). Libraries that count
            from the centre of the first pixel need half a pixel added.
        rows, cols : int
            Size of the image, pixels.
        **fields
            Any other field of the sensor.
        """
        for name, value in (("fx", fx), ("fy", fy)):
            if not (math.isfinite(value) and value > 0):
                raise UsageError(f"'{name}' must be a positive number of pixels, got {value!r}")
        centred = (cx, cy) == (cols / 2, rows / 2)
        return cls(
            rows=rows,
            cols=cols,
            half_angle_h_deg=math.degrees(math.atan(cols / (2 * fx))),
            half_angle_v_deg=math.degrees(math.atan(rows / (2 * fy))),
            principal_point_px=None if centred else (cx, cy),
            **fields,
        )

    @classmethod
    def from_toml(cls, path: str | Path) -> Sensor:
        """Read a sensor file.

        Raises
        ------
        InputFileError
            The file cannot be read or is not TOML.
        UsageError
            A key or value is wrong.
        """
        path = Path(path)
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise InputFileError(f"{path}: cannot be read ({error.strerror})") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:  # the last: nested without end
            raise InputFileError(f"{path}: not a TOML file ({error})") from None
        try:
            return cls(**table)
        except UsageError as error:
            raise UsageError(f"{path}: {error}") from None

    def optics_difference(self, other: Sensor) -> str | None:
        """Say in what the noise-free images of two cameras differ, e.g. ``'rows' is 16 here and 8 there``.

        Returns
        -------
        str or None
            The first field of geometry or modulation that differs; None if they see the same.
        """
        for name in _OPTICS:
            here, there = getattr(self, name), getattr(other, name)
            if here != there:
                return f"'{name}' is {here} here and {there} there"
        return None

    @property
    def tan_half_angles(self) -> tuple[float, float]:
        """Tangents of the horizontal and vertical half angle."""
        return math.tan(math.radians(self.half_angle_h_deg)), math.tan(math.radians(self.half_angle_v_deg))

    @property
    def centre_px(self) -> tuple[float, float]:
        """Where the optical axis meets the image, (u0, v0) in pixels."""
        return self.principal_point_px or (self.cols / 2, self.rows / 2)

    @property
    def cam2level(self) -> NDArray[np.float64]:
        """Rotation Ry(pitch) · Rx(roll) from the tilted camera to the level one, (3, 3)."""
        pitch, roll = math.radians(self.pitch_deg), math.radians(self.roll_deg)
        ry = np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]])
        rx = np.array([[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]])
        return np.asarray(ry @ rx)

    @property
    def metres_per_radian(self) -> float:
        """Range per radian of phase, c / 4πf."""
        return SPEED_OF_LIGHT_M_S / (4 * math.pi * self.modulation_hz)

    @property
    def unambiguous_range_m(self) -> float:
        """Range at which the phase wraps, c / 2f."""
        return SPEED_OF_LIGHT_M_S / (2 * self.modulation_hz)

    def ray_directions(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return unit ray directions of image points, level camera frame (PHYSICS section 2).

        Parameters
        ----------
        u, v : ndarray
            Image coordinates, pixels; they broadcast against each other.

        Returns
        -------
        ndarray, shape (..., 3)
        """
        tan_h, tan_v = self.tan_half_angles
        u0, v0 = self.centre_px
        y = 2 * tan_h * (u0 - np.asarray(u, float)) / self.cols
        z = 2 * tan_v * (v0 - np.asarray(v, float)) / self.rows
        d = np.stack(np.broadcast_arrays(1.0, y, z), axis=-1) @ self.cam2level.T
        return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True))

    def pixel_directions(self) -> NDArray[np.float64]:
        """Return unit ray directions of all pixel centres, level camera frame, (rows, cols, 3)."""
        v, u = np.mgrid[: self.rows, : self.cols] + 0.5
        return self.ray_directions(u, v)


def preset_names() -> list[str]:
    """Return the names of the shipped presets."""
    files = resources.files("phasemark.render").iterdir()
    return sorted(entry.name.removesuffix(".toml") for entry in files if entry.name.endswith(".toml"))


def preset(name: str) -> Sensor:
    """Return a shipped sensor.

    Parameters
    ----------
    name : str
        One of :func:`preset_names`.

    Raises
    ------
    UsageError
        The name is not known.

    Examples
    --------
    >>> preset("pmd-16x16").unambiguous_range_m.__round__(4)
    14.9896
    """
    if name not in preset_names():
        raise UsageError(f"unknown sensor '{name}': the presets are {', '.join(preset_names())}")
    text = resources.files("phasemark.render").joinpath(f"{name}.toml").read_text(encoding="utf-8")
    return Sensor(**tomllib.loads(text))
