"""The camera: geometry, modulation, electrons and the switches of its errors, as one frozen value object."""

from __future__ import annotations

import math
import tomllib
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from phasemark import UsageError
from phasemark.inputs import refuse_truth_values
from phasemark.inputs.toml_file import read_toml
from phasemark.render.sensor.correlation import (
    SQUARE_PEAK,
    Harmonic,
    correlation_peak,
    pulse_harmonics,
    square_harmonics,
)

SPEED_OF_LIGHT_M_S = 299_792_458.0

_LARGEST = 1e12
"""Of any number of a sensor: the square of none overflows, and the reciprocal of none is infinite."""


def _not_vanishing(value: float) -> float:
    if value < 1 / _LARGEST:
        raise ValueError(f"must be at least {1 / _LARGEST:g}")
    return value


_Positive = Annotated[float, Field(gt=0, le=_LARGEST, allow_inf_nan=False), AfterValidator(_not_vanishing)]
_NonNegative = Annotated[float, Field(ge=0, le=_LARGEST, allow_inf_nan=False)]
_Fraction = Annotated[float, Field(gt=0, le=1)]
_HalfAngleDeg = Annotated[float, Field(gt=0, lt=85)]
_TiltDeg = Annotated[float, Field(ge=-45, le=45)]
_TurnDeg = Annotated[float, Field(ge=-180, le=180)]
_MountHeight = Annotated[float, Field(ge=-10, le=10)]
_PixelCount = Annotated[int, Field(ge=1, le=4096)]
_Share = Annotated[float, Field(ge=0, lt=1)]
_Finite = Annotated[float, Field(ge=-_LARGEST, le=_LARGEST, allow_inf_nan=False)]
_Order = Annotated[int, Field(ge=2, le=199)]
_Pixel = tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]
_Row = tuple[_Finite, ...]
_PulseShape = tuple[_NonNegative, ...]

PATTERN_BOUND = 3.0
"""Fixed patterns are normal and end at this many standard deviations: no pixel of a camera that works lies beyond."""

_LEAST_PULSE_SAMPLES = 8

# What an image's rays and phases depend on: cameras that agree in these see the same noise-free image.
_OPTICS = (
    "rows",
    "cols",
    "half_angle_h_deg",
    "half_angle_v_deg",
    "centre_px",
    "pitch_deg",
    "roll_deg",
    "bearing_offset_deg",
    "height_offset_m",
    "fill_factor",
    "vignetting",
    "modulation_hz",
)

# What is no error of a camera with taps, beside its optics.
_WITHOUT_ERRORS = ("frame_rate_hz", "phase_interval_s", "contrast", "signal_e")

DIRECT_MODULATION_HZ = 1e4
"""Highest `modulation_hz` of a direct sensor: at 10 m a phase of 4e-3 rad, whose mixing moves a mean range by 1e-6."""

# What only a camera with taps has, and what only a direct one has.
_PHASE_ONLY = (
    "phase_interval_s",
    "contrast",
    "modulation",
    "max_harmonic",
    "harmonics",
    "emitted_pulse",
    "reference_pulse",
    "signal_e",
    "ambient_e",
    "dark_e",
    "shot_noise",
    "read_noise_e",
    "prnu",
    "dsnu_e",
    "full_well_e",
    "adc_bits",
    "gain",
    "black_level",
    "phase_offset_std_rad",
    "tap_phase_offset_std_rad",
    "blur_share",
    "blur_px",
    "veil_share",
    "veil_px",
    "hot_share",
    "hot_pixels",
    "hot_e",
    "max_phase_std_rad",
    "min_amplitude_e",
    "wrap_guard_m",
)
_DIRECT_ONLY = (
    "max_range_m",
    "min_intensity",
    "range_std_m",
    "range_shot_std_m",
    "range_ambient_std_m",
    "zone_offset_m",
)

# What a calibration leaves: it moves no image and adds no noise to a frame.
_CALIBRATION = (
    "calibration_fields",
    "calibration_covariance",
    "systematic_distance_m",
    "systematic_delta_deg",
    "systematic_bearing_deg",
    "systematic_height_m",
    "systematic_time_s",
)

_DIRECT_NOISE = ("range_std_m", "range_shot_std_m", "range_ambient_std_m", "zone_offset_m")

_SEMIDEFINITE = 1e-5
"""Negative eigenvalue of a correlation matrix that rounding to the digits of a file may cause."""

_ROUNDING = 1e-9  # of a limit that files state in decimals


class Sensor(BaseModel):
    """A time-of-flight camera (PHYSICS sections 2 and 4).

    Frozen, and valid once built; :meth:`with_` derives a changed copy. Every error term is neutral by default, so
    ``Sensor(rows=16, cols=16, half_angle_h_deg=11, half_angle_v_deg=11)`` is a camera with shot noise alone. What is
    given as a standard deviation of a *pattern* differs from pixel to pixel and stays as it is in time: `unit_seed`
    draws it, and one seed is one physical camera. Formulas and their sources stand in ``docs/sensor.md``.

    Parameters
    ----------
    kind : {"phase", "direct"}
        "phase": amplitude-modulated light, two taps, four phase images. "direct": direct time of flight with z made on
        the chip; only geometry, footprint and dropout are modelled, and every field about taps, harmonics or phasors
        is refused. Its `modulation_hz` must be at most 10 kHz: so low that phasors do not mix, and the range of a
        pixel is the light-weighted mean over its footprint.
    rows, cols : int
        Size of the image, pixels.
    half_angle_h_deg, half_angle_v_deg : float
        Half angle from the optical axis to the left/right and top/bottom *edge* of the image, degrees.
    principal_point_px : (u0, v0), optional
        Where the optical axis meets the image, pixels from the top left corner. None: the centre.
    pitch_deg, roll_deg : float
        How the camera is mounted; pitch is positive looking down.
    bearing_offset_deg : float
        Added to every bearing: the azimuth at which the camera sees what its mount points at.
    height_offset_m : float
        Added to every height: how far a landmark's origin lies above the lens where a view says 0.
    fill_factor : (width, height)
        Light-sensitive share of the pixel's pitch, a centred rectangle.
    vignetting : bool
        Whether brightness falls as cos⁴ of the angle off the axis.
    modulation_hz : float
        Modulation frequency f; the range wraps at c / 2f.
    frame_rate_hz : float
        Frames a second, four phase images each.
    phase_interval_s : float, optional
        Time T from one phase image to the next; None: 1 / (4 · frame rate), the most there can be.
    contrast : float
        Demodulation contrast K, in (0, 1].
    modulation : {"sine", "square", "harmonics", "pulse"}
        What light and reference correlate to: a sine alone; square with square, a_k = 1/k² for odd k; the orders
        stated in `harmonics`; or those of `emitted_pulse` and `reference_pulse`.
    max_harmonic : int
        Highest order of "square" and "pulse".
    harmonics : tuple of (k, a_k, θ_k)
        Orders k > 1 of the correlation for "harmonics": amplitude relative to the first, phase in radians.
    emitted_pulse, reference_pulse : tuple of float
        One period of light and reference for "pulse", evenly sampled, of one length, at least 8 samples, any unit.
    signal_e : float
        Electrons N₀ per phase image, both taps, that intensity 1 produces.
    ambient_e, dark_e : float
        Unmodulated electrons per phase image, both taps: ambient light and dark current.
    shot_noise : bool
        Whether electrons arrive as a Poisson process.
    read_noise_e : float
        Read noise, e- r.m.s. per tap and phase image.
    prnu : float
        Photo-response non-uniformity: standard deviation of the taps' relative sensitivity, a pattern.
    dsnu_e : float
        Dark-signal non-uniformity: standard deviation of a tap's dark electrons per phase image, a pattern; at most
        dark_e / 6, for a dark signal is never negative.
    full_well_e : float, optional
        Electrons at which a tap saturates; None: never.
    adc_bits : int, optional
        Bits of the converter; None: electrons are read as they are.
    gain : float
        Codes per electron; needs `adc_bits`.
    black_level : float
        Code of no electrons; needs `adc_bits`.
    phase_offset_std_rad : float
        Phase offset of each pixel, a pattern.
    tap_phase_offset_std_rad : float
        Phase offset of each tap beside its pixel's, a pattern.
    range_offset_m : float
        Added to every range: the delay between light and reference.
    unit_seed : int
        Which physical camera: draws all patterns and defective pixels.
    blur_share, blur_px : float
        Stray light near its pixel: share of the light that goes there, and the standard deviation of a Gaussian.
    veil_share, veil_px : float
        Stray light far from its pixel, likewise.
    dead_share, hot_share : float
        Expected share of dead and hot pixels, drawn by `unit_seed`.
    dead_pixels, hot_pixels : tuple of (row, col)
        Pixels that are dead or hot for certain. Dead: no electrons. Both are flagged and invalid.
    hot_e : float
        Additional dark electrons of a hot pixel per phase image, both taps.
    max_phase_std_rad : float or None
        A pixel is valid when its predicted one-frame phase noise is at most this; None: any amplitude above zero.
    min_amplitude_e : float
        A pixel is valid when its measured amplitude is at least this, electrons.
    wrap_guard_m : float
        A range nearer to 0 or to c / 2f than this may be on the wrong side of the wrap, and is invalid.
    max_range_m : float, optional
        "direct" only: nothing returns from beyond.
    min_intensity : float
        "direct" only: nothing returns from a pixel that gets less light than this; 1 is albedo 1 facing at 1 m.
    range_std_m, range_shot_std_m, range_ambient_std_m : float
        "direct" only: noise of a range, σ² = range_std_m² + range_shot_std_m² / I + range_ambient_std_m² / I², where
        I is the relative intensity, 1 for albedo 1 facing the camera at 1 m. The three terms are constant, grow
        as under shot noise of the signal, and grow as under shot noise of ambient light.
    zone_offset_m : tuple of rows of float
        "direct" only: measured offset of each pixel, rows × cols, added to its range beside `range_offset_m`. Empty:
        no offsets.
    delay_s : float
        Added to the time stamp of a frame to get the time at which the camera was where the frame shows it; -0.075
        for frames that show the pose 75 ms before their stamp.
    calibration_fields : tuple of str
        Names of the fields that a calibration estimated, e.g. "pitch_deg".
    calibration_covariance : tuple of rows of float
        Covariance of these fields in their own units, symmetric and positive semidefinite. Its errors are common to
        all frames of the camera.
    systematic_distance_m, systematic_delta_deg, systematic_bearing_deg, systematic_height_m : float
        Standard deviation of what noise and calibration do not explain of a pose: an error that averaging frames does
        not reduce.
    systematic_time_s : float
        Standard deviation of the jitter of the stamps, seconds. While the camera moves, a stamp that is off by that
        much moves the pose by that time's motion.

    Raises
    ------
    UsageError
        With one line that names the field, its value and its range, or the two fields that contradict each other.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)

    kind: Literal["phase", "direct"] = "phase"
    # geometry
    rows: _PixelCount
    cols: _PixelCount
    half_angle_h_deg: _HalfAngleDeg
    half_angle_v_deg: _HalfAngleDeg
    principal_point_px: tuple[float, float] | None = None
    pitch_deg: _TiltDeg = 0.0
    roll_deg: _TiltDeg = 0.0
    bearing_offset_deg: _TurnDeg = 0.0
    height_offset_m: _MountHeight = 0.0
    fill_factor: tuple[_Fraction, _Fraction] = (1.0, 1.0)
    vignetting: bool = False
    # modulation and timing
    modulation_hz: _Positive = 10e6
    frame_rate_hz: _Positive = 3.0
    phase_interval_s: _Positive | None = None
    delay_s: Annotated[float, Field(ge=-10, le=10)] = 0.0
    contrast: _Fraction = 0.5
    modulation: Literal["sine", "square", "harmonics", "pulse"] = "sine"
    max_harmonic: _Order = 49
    harmonics: tuple[tuple[_Order, _Fraction, _Finite], ...] = ()
    emitted_pulse: _PulseShape = ()
    reference_pulse: _PulseShape = ()
    # electrons
    signal_e: _Positive = 35_571.0
    ambient_e: _NonNegative = 0.0
    dark_e: _NonNegative = 0.0
    shot_noise: bool = True
    read_noise_e: _NonNegative = 0.0
    prnu: Annotated[float, Field(ge=0, le=0.3)] = 0.0
    dsnu_e: _NonNegative = 0.0
    # read-out
    full_well_e: _Positive | None = None
    adc_bits: Annotated[int, Field(ge=1, le=32)] | None = None
    gain: _Positive = 1.0
    black_level: _NonNegative = 0.0
    # offsets
    phase_offset_std_rad: Annotated[float, Field(ge=0, le=1)] = 0.0
    tap_phase_offset_std_rad: Annotated[float, Field(ge=0, le=1)] = 0.0
    range_offset_m: _Finite = 0.0
    unit_seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    # stray light
    blur_share: _Share = 0.0
    blur_px: _Positive = 1.0
    veil_share: _Share = 0.0
    veil_px: _Positive = 8.0
    # defects
    dead_share: _Share = 0.0
    hot_share: _Share = 0.0
    dead_pixels: tuple[_Pixel, ...] = ()
    hot_pixels: tuple[_Pixel, ...] = ()
    hot_e: _NonNegative = 10_000.0
    # validity
    max_phase_std_rad: _Positive | None = None
    min_amplitude_e: _NonNegative = 0.0
    wrap_guard_m: _NonNegative = 0.0
    # direct time of flight
    max_range_m: _Positive | None = None
    min_intensity: _NonNegative = 0.0
    range_std_m: _NonNegative = 0.0
    range_shot_std_m: _NonNegative = 0.0
    range_ambient_std_m: _NonNegative = 0.0
    zone_offset_m: tuple[_Row, ...] = ()
    # what a calibration leaves
    calibration_fields: tuple[str, ...] = ()
    calibration_covariance: tuple[_Row, ...] = ()
    systematic_distance_m: _NonNegative = 0.0
    systematic_delta_deg: _NonNegative = 0.0
    systematic_bearing_deg: _NonNegative = 0.0
    systematic_height_m: _NonNegative = 0.0
    systematic_time_s: _NonNegative = 0.0

    def __init__(self, **data: Any) -> None:
        refuse_truth_values(data, type(self).model_fields)
        try:
            super().__init__(**data)
        except ValidationError as error:
            first = error.errors()[0]
            if not first["loc"]:  # a finding about several fields names them itself
                raise UsageError(first["msg"].removeprefix("Value error, ")) from None
            raise UsageError.of_field(first["loc"], first["type"], first["msg"], first["input"]) from None

    @model_validator(mode="after")
    def _principal_point_near_the_image(self) -> Self:
        if self.principal_point_px is not None:
            u0, v0 = self.principal_point_px
            if not (abs(u0 - self.cols / 2) <= self.cols and abs(v0 - self.rows / 2) <= self.rows):
                raise ValueError(
                    "'principal_point_px' must lie within one image width and height of the image's centre, got "
                    f"{self.principal_point_px}"
                )
        return self

    @model_validator(mode="after")
    def _fields_suit_the_kind(self) -> Self:
        foreign = _PHASE_ONLY if self.kind == "direct" else _DIRECT_ONLY
        for name in foreign:
            value = getattr(self, name)
            if value != type(self).model_fields[name].default:
                why = (
                    "a direct sensor has no taps, harmonics or phasors"
                    if self.kind == "direct"
                    else "it belongs to 'kind' = 'direct'"
                )
                raise ValueError(f"'{name}' must be left out for 'kind' = '{self.kind}', got {value}: {why}")
        if self.kind == "direct" and self.modulation_hz > DIRECT_MODULATION_HZ:
            raise ValueError(
                f"'modulation_hz' must be at most {DIRECT_MODULATION_HZ:g} for 'kind' = 'direct', which mixes no "
                f"phasors, got {self.modulation_hz:g}"
            )
        return self

    @model_validator(mode="after")
    def _correlation_can_be(self) -> Self:
        for names, owner in ((("harmonics",), "harmonics"), (("emitted_pulse", "reference_pulse"), "pulse")):
            for name in names:
                if bool(getattr(self, name)) != (self.modulation == owner):
                    verb = "must be given for" if self.modulation == owner else "must be left out unless"
                    raise ValueError(
                        f"'{name}' {verb} 'modulation' = '{owner}', got 'modulation' = '{self.modulation}'"
                    )
        orders = [k for k, _, _ in self.harmonics]
        if len(set(orders)) < len(orders):
            raise ValueError(f"'harmonics' must name each order once, got the orders {orders}")
        if self.modulation == "pulse":
            n, m = len(self.emitted_pulse), len(self.reference_pulse)
            if n != m or n < _LEAST_PULSE_SAMPLES:
                raise ValueError(
                    f"'emitted_pulse' and 'reference_pulse' must have the same number of samples, at least "
                    f"{_LEAST_PULSE_SAMPLES}, got {n} and {m}"
                )
            try:
                pulse_harmonics(self.emitted_pulse, self.reference_pulse, self.max_harmonic)
            except ValueError as error:
                raise ValueError(f"'emitted_pulse' and 'reference_pulse' {error}") from None
        # The whole square wave, not its first orders, must fit: K ≤ 8/π².
        peak = SQUARE_PEAK if self.modulation == "square" else correlation_peak(self.correlation_harmonics)
        if self.contrast * peak > 1 + _ROUNDING:
            raise ValueError(
                f"'contrast' must be at most {1 / peak:.4g} with 'modulation' = '{self.modulation}', or a tap would "
                f"count less than nothing, got {self.contrast:g}"
            )
        return self

    @model_validator(mode="after")
    def _times_and_shares_fit(self) -> Self:
        longest = 1 / (4 * self.frame_rate_hz)
        if self.phase_interval_s is not None and self.phase_interval_s > longest * (1 + _ROUNDING):
            raise ValueError(
                f"'phase_interval_s' must be at most 1 / (4 · frame_rate_hz) = {longest:.6g}, got "
                f"{self.phase_interval_s:g}"
            )
        if self.blur_share + self.veil_share >= 1:
            raise ValueError(
                f"'blur_share' + 'veil_share' must be below 1, got {self.blur_share:g} + {self.veil_share:g}"
            )
        if self.dead_share + self.hot_share >= 1:
            raise ValueError(
                f"'dead_share' + 'hot_share' must be below 1, got {self.dead_share:g} + {self.hot_share:g}"
            )
        for name in ("dead_pixels", "hot_pixels"):
            for row, col in getattr(self, name):
                if row >= self.rows or col >= self.cols:
                    raise ValueError(
                        f"'{name}' must lie in the image of {self.rows} × {self.cols} pixels, got ({row}, {col})"
                    )
        if both := sorted(set(self.dead_pixels) & set(self.hot_pixels)):
            raise ValueError(f"'dead_pixels' and 'hot_pixels' must not share a pixel, got {both[0]} in both")
        if not self.wrap_guard_m < self.unambiguous_range_m / 2:
            raise ValueError(
                f"'wrap_guard_m' must be below c / 4f = {self.unambiguous_range_m / 2:.4g}, got {self.wrap_guard_m:g}"
            )
        return self

    @model_validator(mode="after")
    def _read_out_can_be(self) -> Self:
        if self.adc_bits is None:
            for name in ("gain", "black_level"):
                value = getattr(self, name)
                if value != type(self).model_fields[name].default:
                    raise ValueError(f"'{name}' must be left out without a converter ('adc_bits'), got {value:g}")
        elif self.black_level >= 2**self.adc_bits - 1:
            raise ValueError(
                f"'black_level' must be below the converter's highest code, {2**self.adc_bits - 1}, got "
                f"{self.black_level:g}"
            )
        if self.dsnu_e > self.dark_e / 6 * (1 + _ROUNDING):
            raise ValueError(
                f"'dsnu_e' must be at most dark_e / 6 = {self.dark_e / 6:g}: a tap's dark signal, dark_e / 2, varies "
                f"by up to {PATTERN_BOUND:g} standard deviations and cannot be negative, got {self.dsnu_e:g}"
            )
        offset_e = (self.ambient_e + self.dark_e) / 2
        if self.saturation_e <= offset_e:
            limit = "full_well_e" if self.full_well_e == self.saturation_e else "gain"
            raise ValueError(
                f"'{limit}' leaves no room for light: a tap saturates at {self.saturation_e:.6g} e-, and ambient light "
                f"and dark current alone bring {offset_e:.6g} e-"
            )
        return self

    @model_validator(mode="after")
    def _threshold_can_be_met(self) -> Self:
        if not math.isfinite(self.saturation_e):
            return self
        # The brightest pixel that does not saturate: ½ (A/K + N_amb + N_dark + A · peak) = saturation.
        peak = correlation_peak(self.correlation_harmonics)
        offset_e = self.ambient_e + self.dark_e
        amplitude_e = (2 * self.saturation_e - offset_e) / (1 / self.contrast + peak)
        if self.min_amplitude_e >= amplitude_e:
            raise ValueError(
                f"'min_amplitude_e' must be below {amplitude_e:.6g}, the amplitude at which a tap saturates at "
                f"{self.saturation_e:.6g} e- (full well or converter), got {self.min_amplitude_e:g}"
            )
        if self.max_phase_std_rad is not None:
            shot = amplitude_e / self.contrast + offset_e if self.shot_noise else 0.0
            least = math.sqrt((shot + self.read_variance_e2) / 2) / amplitude_e
            if self.max_phase_std_rad <= least:
                raise ValueError(
                    f"'max_phase_std_rad' must be above {least:.4g}, the noise of the brightest pixel that does not "
                    f"saturate at {self.saturation_e:.6g} e- (full well or converter), got {self.max_phase_std_rad:g}"
                )
        return self

    @model_validator(mode="after")
    def _tables_have_their_size(self) -> Self:
        if self.zone_offset_m:
            _check_table("zone_offset_m", self.zone_offset_m, self.rows, self.cols, "rows x cols of the sensor")
        names = self.calibration_fields
        for name in names:
            number = name in type(self).model_fields and isinstance(getattr(self, name), float)
            if not number or name in _CALIBRATION:
                raise ValueError(f"'calibration_fields' must name fields of the sensor that are numbers, got '{name}'")
            if names.count(name) > 1:
                raise ValueError(f"'calibration_fields' must name each field once, got '{name}' twice")
        covariance = self.calibration_covariance
        _check_table("calibration_covariance", covariance, len(names), len(names), "one for each of calibration_fields")
        matrix = np.array(covariance, dtype=np.float64).reshape(len(names), len(names))
        variance = np.diag(matrix)
        if (variance < 0).any():
            k = int((variance < 0).argmax())
            raise ValueError(f"'calibration_covariance' must have no negative variance, got {variance[k]:g}")
        root = np.sqrt(np.where(variance > 0, variance, 1.0))
        correlation = matrix / np.outer(root, root)
        if not np.allclose(correlation, correlation.T, rtol=0, atol=_SEMIDEFINITE):
            raise ValueError("'calibration_covariance' must be symmetric")
        lowest = float(np.linalg.eigvalsh(correlation).min()) if names else 0.0
        if lowest < -_SEMIDEFINITE:
            raise ValueError(
                f"'calibration_covariance' must be positive semidefinite, but its correlation matrix has the eigenvalue"
                f" {lowest:.3g}"
            )
        return self

    def with_(self, **changes: Any) -> Sensor:
        """Return a copy with some fields changed, validated again."""
        return Sensor(**{**self.model_dump(), **changes})

    def without_errors(self, *, shot_noise: bool = False) -> Sensor:
        """Return the camera without its errors: optics, modulation frequency, contrast and signal alone.

        Parameters
        ----------
        shot_noise : bool
            Whether the light still arrives as a Poisson process; then the validity threshold stays as well.
        """
        if self.kind == "direct":
            neutral = ("range_offset_m", "dead_share", "dead_pixels", "delay_s", *_DIRECT_NOISE, *_CALIBRATION)
            return self.with_(**{name: type(self).model_fields[name].default for name in neutral})
        kept = {name: getattr(self, name) for name in (*_OPTICS, *_WITHOUT_ERRORS) if name != "centre_px"}
        threshold = self.max_phase_std_rad if shot_noise else None
        return Sensor(
            **kept,
            principal_point_px=self.principal_point_px,
            shot_noise=shot_noise,
            max_phase_std_rad=threshold,
        )

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

    def as_dict(self) -> dict[str, Any]:
        """Return every field, and the unambiguous range, as plain numbers and text, for JSON."""
        return {**self.model_dump(mode="json"), "unambiguous_range_m": self.unambiguous_range_m}

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
        table = read_toml(path)
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

    @classmethod
    def field_groups(cls) -> dict[str, tuple[str, ...]]:
        """Return the fields in groups, in the order of light's way through the camera: title → names."""
        titles = {
            "kind": "kind",
            "rows": "geometry",
            "modulation_hz": "modulation and timing",
            "signal_e": "electrons per phase image",
            "full_well_e": "read-out",
            "phase_offset_std_rad": "offsets of one physical camera",
            "blur_share": "stray light",
            "dead_share": "defects",
            "max_phase_std_rad": "validity",
            "max_range_m": "direct time of flight only",
            "calibration_fields": "what a calibration leaves",
        }
        groups: dict[str, tuple[str, ...]] = {}
        title = ""
        for name in cls.model_fields:
            title = titles.get(name, title)
            groups[title] = (*groups.get(title, ()), name)
        return groups

    @property
    def zone_offsets(self) -> NDArray[np.float64]:
        """Offsets of the pixels beside `range_offset_m`, (rows, cols) metres; zero where none are stated."""
        table = self.zone_offset_m or ((0.0,) * self.cols,) * self.rows
        return np.array(table, dtype=np.float64)

    @property
    def calibration_matrix(self) -> NDArray[np.float64]:
        """Covariance of `calibration_fields` in their units, (p, p); (0, 0) without a calibration."""
        p = len(self.calibration_fields)
        return np.array(self.calibration_covariance, dtype=np.float64).reshape(p, p)

    @property
    def quantity(self) -> Literal["range", "z"]:
        """What the camera itself reports: range along the ray, or the distance z along the optical axis."""
        return "z" if self.kind == "direct" else "range"

    @property
    def correlation_harmonics(self) -> tuple[Harmonic, ...]:
        """The orders k > 1 of the correlation with their a_k and θ_k, in rising order; empty for a sine."""
        if self.modulation == "square":
            return square_harmonics(self.max_harmonic)
        if self.modulation == "pulse":
            return pulse_harmonics(self.emitted_pulse, self.reference_pulse, self.max_harmonic)
        return tuple(Harmonic(*entry) for entry in sorted(self.harmonics))

    @property
    def harmonic_orders(self) -> tuple[int, ...]:
        """Which S_k, k > 1, the taps need beside S_1; a Renderer for this sensor renders them unless told otherwise."""
        return tuple(k for k, _, _ in self.correlation_harmonics)

    @property
    def phase_image_interval_s(self) -> float:
        """Time from one phase image to the next: `phase_interval_s`, or 1 / (4 · frame rate)."""
        return self.phase_interval_s or 1 / (4 * self.frame_rate_hz)

    @property
    def code_e(self) -> float:
        """Electrons per code q, 0 without a converter."""
        return 0.0 if self.adc_bits is None else 1 / self.gain

    @property
    def saturation_e(self) -> float:
        """Electrons at which a tap saturates: full well or the converter's highest code, whichever comes first."""
        well = math.inf if self.full_well_e is None else self.full_well_e
        top = math.inf if self.adc_bits is None else (2**self.adc_bits - 1 - self.black_level) / self.gain
        return min(well, top)

    @property
    def read_variance_e2(self) -> float:
        """Variance that reading adds to one phase image's N_a − N_b, 2σ_r² + q²/6 (PHYSICS section 4), e-²."""
        return 2 * self.read_noise_e**2 + self.code_e**2 / 6

    @property
    def upper_rows(self) -> tuple[int, int]:
        """First and stop of the image rows above the middle line, which see the upper part of a landmark."""
        return 0, self.rows // 2

    @property
    def lower_rows(self) -> tuple[int, int]:
        """First and stop of the image rows below the middle line; of an odd number the middle row is among them."""
        return self.rows // 2, self.rows

    @property
    def metres_per_radian(self) -> float:
        """Range per radian of phase, c / 4πf."""
        return SPEED_OF_LIGHT_M_S / (4 * math.pi * self.modulation_hz)

    @property
    def unambiguous_range_m(self) -> float:
        """Range at which the phase wraps, c / 2f."""
        return SPEED_OF_LIGHT_M_S / (2 * self.modulation_hz)

    def describe_beyond_range(self, name: str, distance_m: float) -> str | None:
        """Return a sentence on what the sensor shows of something too far away, or None if it is near enough.

        Parameters
        ----------
        name : str
            What has this distance, for the sentence.
        distance_m : float

        Returns
        -------
        str or None
            Ranges wrap at c / 2f; a direct sensor reports nothing from beyond `max_range_m`.

        Examples
        --------
        >>> preset("pmd-16x16").describe_beyond_range("the wall", 20.0)
        'the wall at 20 m is beyond c / 2f = 14.99 m, where ranges wrap: it shows at about 5.01 m'
        """
        if not math.isfinite(distance_m):
            return None
        if self.kind == "direct" and self.max_range_m is not None:
            if distance_m <= self.max_range_m:
                return None
            limit = f"the sensor's 'max_range_m' = {self.max_range_m:.4g} m"
            return f"{name} at {distance_m:g} m is beyond {limit}: the sensor reports nothing from there"
        period_m = self.unambiguous_range_m
        if distance_m < period_m:
            return None
        shown = f"it shows at about {distance_m % period_m:.3g} m"
        return f"{name} at {distance_m:g} m is beyond c / 2f = {period_m:.4g} m, where ranges wrap: {shown}"

    def ray_directions(self, u: NDArray[np.float64] | float, v: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """Return unit ray directions of image points, level camera frame (PHYSICS section 2).

        Parameters
        ----------
        u, v : float or ndarray
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

    def axis_cosine(self) -> NDArray[np.float64]:
        """Return the cosine between each pixel's ray and the camera's own optical axis, (rows, cols).

        z = range · cosine. Tilting the camera turns both, so mounting does not enter.
        """
        return np.asarray(self.pixel_directions() @ self.cam2level[:, 0])


def _check_table(name: str, table: tuple[_Row, ...], rows: int, cols: int, what: str) -> None:
    """Raise ValueError if a table does not have the stated numbers of rows and columns."""
    lengths = {len(row) for row in table}
    if len(table) != rows or lengths - {cols}:
        got = f"{len(table)} rows of {' or '.join(map(str, sorted(lengths))) or 'no'} numbers"
        raise ValueError(f"'{name}' must have {rows} rows of {cols} numbers, {what}, got {got}")


def preset_names() -> list[str]:
    """Return the names of the shipped presets."""
    files = resources.files("phasemark.render.sensor").joinpath("presets").iterdir()
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
    text = resources.files("phasemark.render.sensor").joinpath("presets", f"{name}.toml").read_text(encoding="utf-8")
    return Sensor(**tomllib.loads(text))
