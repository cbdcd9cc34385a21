"""The camera: geometry, modulation, electrons and the switches of its errors, as one frozen value object."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import model_validator

from phasemark import UsageError
from phasemark.inputs.numbers import in_words
from phasemark.inputs.toml_file import read_toml
from phasemark.render.sensor.lens_fields import DERIVED, LENS_FIELD, Lens, changed_lens, check_image_size
from phasemark.render.sensor.sensor_checks import check_fields
from phasemark.render.sensor.sensor_fields import CALIBRATION, FIELD_GROUPS, OPTICS
from phasemark.render.sensor.sensor_quantities import SensorQuantities
from phasemark.render.sensor.sources import without_sources

# What is no error of a camera with taps, beside its optics.
_WITHOUT_ERRORS = ("frame_rate_hz", "phase_interval_s", "contrast", "signal_e")

_DIRECT_NOISE = ("range_std_m", "range_shot_std_m", "range_ambient_std_m", "zone_offset_m")


class Sensor(SensorQuantities):
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
    lens : Lens, optional
        Intrinsics and distortion as OpenCV or ROS state them, a table `[lens]` in a file; see
        :class:`~phasemark.render.sensor.Lens`. Half angles and principal point follow from it and are left out. None:
        an ideal lens.
    half_angle_h_deg, half_angle_v_deg : float
        Half angle from the optical axis to the left/right and top/bottom *edge* of the image, degrees. With a lens:
        the angle whose tangent is half the image's width or height in tangents, along the row or column of the
        principal point.
    principal_point_px : (u0, v0), optional
        Where the optical axis meets the image, pixels from the top left corner. None: the centre.
    whole_image_px : (width, height), optional
        Size of the image of which this camera reads a part, in its own pixels: its principal point may lie as far
        outside the part as it lies in that image. None: this is the whole image.
    pitch_deg : float
        How far the mounted camera looks down.
    roll_deg : float
        How far it is turned about its optical axis, clockwise as it looks.
    bearing_offset_deg : float
        Added to every bearing: the azimuth at which the camera sees what its mount points at.
    height_offset_m : float
        Added to every height: how far a landmark's origin lies above the lens where a view says 0.
    fill_factor : (width, height)
        Light-sensitive share of the pixel's pitch, a centred rectangle.
    vignetting : bool
        Whether brightness falls as cos⁴ of the angle off the axis.
    lamp_half_angle_deg : float, optional
        The lamp, which is at the lens, sheds no light farther from the optical axis than this; it covers the whole
        image. Light that bounces needs it. None: unknown.
    lamp_profile : float or tuple of (angle_deg, intensity)
        Intensity of the lamp over the angle off the axis: n for cosⁿ, 0 for even light, or samples by rising angle,
        relative to the intensity to which `signal_e` refers. Between samples it is linear, before the first and beyond
        the last it is theirs.
    modulation_hz : float or tuple of float
        Modulation frequency f; the range wraps at c / 2f. Several of them, in whole hertz and in the order in which a
        frame has their phase images: the range wraps at c / (2 · gcd) (PHYSICS section 10). A list of one is that
        number.
    frame_rate_hz : float
        Frames a second, four phase images at each of the m modulation frequencies. All phase images take the same time.
    phase_interval_s : float, optional
        Time T from one phase image to the next; None: 1 / (4 m · frame rate), the most there can be.
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
        Electrons N₀ per phase image, both taps, that intensity 1 produces, at every frequency.
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
        Phase offset of each pixel, a pattern; every frequency has its own.
    tap_phase_offset_std_rad : float
        Phase offset of each tap beside its pixel's, a pattern.
    range_offset_m : float
        Added to every range: the delay between light and reference.
    unit_seed : int
        Which physical camera: draws all patterns and defective pixels.
    blur_share, blur_px : float
        Stray light near its pixel: share of the light that goes there, and the standard deviation of a Gaussian.
    veil_share, veil_px : float
        Stray light far from its pixel: the same two numbers.
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
    histogram : Histogram, optional
        "direct" only: what the sensor counts in each zone and makes of it on the chip, a table `[histogram]` in a file;
        see :class:`~phasemark.render.sensor.Histogram`. None: the sensor is known by its ranges alone.
    delay_s : float
        Added to the time stamp of a frame to get the time at which the camera was where the frame shows it; -0.075
        for frames that show the pose 75 ms before their stamp.
    calibration_fields : tuple of str
        Names of the fields that a calibration estimated, e.g. "pitch_deg", or "lens.k1" for a term of the lens.
    calibration_covariance : tuple of rows of float
        Covariance of these fields in their own units, symmetric and positive semidefinite. Its errors are common to
        all frames of the camera.
    systematic_distance_m, systematic_delta_deg, systematic_bearing_deg, systematic_height_m : float
        Standard deviation of what noise and calibration do not explain of a pose: an error that averaging frames does
        not reduce.
    systematic_time_s : float
        Standard deviation of the jitter of the stamps, seconds. While the camera moves, a stamp that is off by that
        much moves the pose by that time's motion.
    overdispersion : float
        By how much χ² of single frames scatters more than noise of the law alone makes it: the variance of χ² with ν
        degrees of freedom is 2 ν (1 + overdispersion).
    recording_range_m, recording_pitch_deg, recording_roll_deg, recording_bearing_deg : float
        Standard deviation by which range offset, tilt and bearing of another recording differ from those of this file:
        what putting the camera on again, temperature and the reference of the poses change.

    Raises
    ------
    UsageError
        With one line that names the field, its value and its range, or the two fields that contradict each other.
    """

    @model_validator(mode="after")
    def _fields_agree(self) -> Self:
        check_fields(self)
        return self

    def with_(self, **changes: Any) -> Sensor:
        """Return a copy with some fields changed, validated again.

        Half angles and principal point of a camera with a lens follow from it. Changing one of them alone changes the
        focal length or the principal point of the lens.
        """
        fields = {**self.model_dump(), **changes}
        if fields.get("lens") is not None:
            asked = {name: changes[name] for name in DERIVED if name in changes}
            fields = {name: value for name, value in fields.items() if name not in DERIVED or name in asked}
            differ = {name: value for name, value in asked.items() if value != getattr(self, name)}
            if self.lens is not None and "lens" not in changes and differ:
                # numbers that are none are refused by their names
                Sensor(**{**self.model_dump(), **changes, "lens": None})
                fields = {name: value for name, value in fields.items() if name not in asked}
                try:
                    fields["lens"] = changed_lens(self.lens, fields["rows"], fields["cols"], differ)
                except ValueError as error:
                    raise UsageError(str(error)) from None
        return Sensor(**fields)

    def number(self, field: str) -> float:
        """Return one number of the sensor by the name of its field, ``lens.k1`` for a term of its lens.

        Raises
        ------
        UsageError
            The sensor has no such number.
        """
        term = field.removeprefix(LENS_FIELD)
        if term != field and self.lens is not None and term in self.lens.terms:
            return self.lens.terms[term]
        value = getattr(self, field) if field in type(self).model_fields else None
        if not isinstance(value, float):
            raise UsageError(f"the sensor has no number '{field}'")
        return value

    def with_numbers(self, values: Mapping[str, float]) -> Sensor:
        """Return a copy with some numbers changed, named as in :meth:`number`, validated again.

        Raises
        ------
        UsageError
            A number belongs to a lens that the sensor has not, or is out of range.

        Examples
        --------
        >>> lens = Lens(fx=16, fy=16, cx=7.5, cy=7.5, distortion=(-0.2, 0, 0, 0))
        >>> Sensor(rows=16, cols=16, lens=lens).with_numbers({"lens.k1": -0.1, "pitch_deg": 1.0}).lens.distortion
        (-0.1, 0.0, 0.0, 0.0)
        """
        terms = {name.removeprefix(LENS_FIELD): value for name, value in values.items() if name.startswith(LENS_FIELD)}
        changes: dict[str, Any] = {name: value for name, value in values.items() if not name.startswith(LENS_FIELD)}
        if terms:
            if self.lens is None:
                raise UsageError(
                    f"'{LENS_FIELD}{next(iter(terms))}' belongs to a sensor with a lens: this one has none"
                )
            changes["lens"] = self.lens.with_terms(**terms)
        return self.with_(**changes)

    def calibration_without(self, left_out: Callable[[str], bool]) -> dict[str, Any]:
        """Return the two fields of the covariance that a calibration leaves, without some of the fields it estimated.

        Parameters
        ----------
        left_out : callable
            Whether the field of a name is left out.
        """
        kept = [k for k, name in enumerate(self.calibration_fields) if not left_out(name)]
        matrix = self.calibration_matrix[np.ix_(kept, kept)]
        return {
            "calibration_fields": tuple(self.calibration_fields[k] for k in kept),
            "calibration_covariance": tuple(tuple(row) for row in matrix.tolist()),
        }

    @property
    def by_frequency(self) -> tuple[Sensor, ...]:
        """The camera during the phase images of each frequency: cameras of one frequency, in the order of the frame.

        They differ in `modulation_hz` alone, and take their phase images as fast as this camera; a `wrap_guard_m`
        belongs to the unwrapped range and not to them. A camera of one frequency is its own only one.
        """
        return (self,) if len(self.frequencies_hz) == 1 else _cameras_of_one_frequency(self)

    def refuse_several_frequencies(self, what: str) -> None:
        """Refuse several modulation frequencies where only one is understood.

        Parameters
        ----------
        what : str
            What takes only one, for the message.

        Raises
        ------
        UsageError
        """
        if len(self.frequencies_hz) > 1:
            raise UsageError(
                f"{what} takes a sensor of one modulation frequency, got 'modulation_hz' ="
                f" {in_words(self.frequencies_hz)}: give sensor and frames of one of them"
            )

    def without_errors(self, *, shot_noise: bool = False) -> Sensor:
        """Return the camera without its errors: optics, modulation frequency, contrast and signal alone.

        Parameters
        ----------
        shot_noise : bool
            Whether the light still arrives as a Poisson process; then the validity threshold stays as well.
        """
        if self.kind == "direct":
            neutral = ("range_offset_m", "dead_share", "dead_pixels", "delay_s", *_DIRECT_NOISE, *CALIBRATION)
            return self.with_(**{name: type(self).model_fields[name].default for name in neutral})
        kept = {name: getattr(self, name) for name in (*OPTICS, *_WITHOUT_ERRORS) if name != "centre_px"}
        threshold = self.max_phase_std_rad if shot_noise else None
        return Sensor(
            **kept,
            principal_point_px=self.principal_point_px,
            shot_noise=shot_noise,
            max_phase_std_rad=threshold,
        )

    def as_dict(self) -> dict[str, Any]:
        """Return every field, and the unambiguous range (a direct sensor has none), as plain numbers, for JSON."""
        own = self.unambiguous_range_m if self.kind == "phase" else None
        return {**self.model_dump(mode="json"), "unambiguous_range_m": own}

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
    def from_opencv(
        cls,
        camera_matrix: ArrayLike,
        distortion: ArrayLike = (),
        *,
        size: tuple[int, int],
        model: Literal["opencv", "fisheye"] = "opencv",
        **fields: Any,
    ) -> Sensor:
        """Build a sensor from what OpenCV's calibration returns.

        Parameters
        ----------
        camera_matrix : (3, 3) array_like
            [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, counted from the centre of the first pixel, as OpenCV does.
        distortion : array_like
            Coefficients in OpenCV's order, any shape: 4, 5 or 8 for "opencv", 4 for "fisheye", none for no distortion.
        size : (cols, rows)
            Of the image, in OpenCV's order.
        model : {"opencv", "fisheye"}
            Lens model of OpenCV.
        **fields
            Any other field of the sensor.

        Raises
        ------
        UsageError
            The matrix is no camera matrix, or the lens does not belong to an image of this size.

        Examples
        --------
        >>> sensor = Sensor.from_opencv([[200, 0, 111.5], [0, 200, 85], [0, 0, 1]], [-0.2, 0.05, 0, 0], size=(224, 171))
        >>> sensor.centre_px
        (112.0, 85.5)
        """
        matrix = _numbers("camera_matrix", camera_matrix)
        pattern = np.array([[True, False, True], [False, True, True], [False, False, True]])
        if matrix.shape != (3, 3) or matrix[~pattern].any() or matrix[2, 2] != 1:
            shown = " ".join(str(camera_matrix).split())
            raise UsageError(f"'camera_matrix' must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {shown}")
        cols, rows = size
        lens = Lens(
            model=model,
            fx=float(matrix[0, 0]),
            fy=float(matrix[1, 1]),
            cx=float(matrix[0, 2]),
            cy=float(matrix[1, 2]),
            distortion=tuple(float(one) for one in _numbers("distortion", distortion).ravel()),
        )
        check_image_size(lens, rows, cols)
        return cls(rows=rows, cols=cols, lens=lens, **fields)

    @classmethod
    def from_camera_info(cls, path: str | Path, **fields: Any) -> Sensor:
        """Build a sensor from a camera_info file of ROS 1 or ROS 2.

        Parameters
        ----------
        path : path-like
            YAML as ROS's calibration writes it, or as ``rostopic echo`` or ``ros2 topic echo`` prints it, with the
            distortion model plumb_bob, rational_polynomial, equidistant or fisheye.
        **fields
            Any other field of the sensor.

        Raises
        ------
        InputFileError
            The file is not YAML, or describes a camera that cannot be used; with one line.
        UsageError
            A field is wrong.
        """
        from phasemark.render.sensor.camera_info import read_camera_info

        found = read_camera_info(path)
        return cls(rows=found.rows, cols=found.cols, lens=found.lens, **fields)

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
            sensor = cls(**without_sources(table)[0])
            if sensor.lens is not None:
                check_image_size(sensor.lens, sensor.rows, sensor.cols, sensor.whole_image_px)
            return sensor
        except UsageError as error:
            raise UsageError(f"{path}: {error}") from None

    def __repr__(self) -> str:
        """Describe the camera in one line: pixels, field of view and modulation."""
        view = f"{2 * self.half_angle_v_deg:.4g}° × {2 * self.half_angle_h_deg:.4g}°"
        parts = [f"{self.rows} × {self.cols} pixels", view]
        if self.kind == "direct":
            parts.append("direct" if self.max_range_m is None else f"direct, up to {self.max_range_m:g} m")
        else:
            parts.append(f"{' + '.join(f'{hz / 1e6:g}' for hz in self.frequencies_hz)} MHz")
        if self.lens is not None:
            parts.append(f"lens {self.lens.model}")
        return f"Sensor({', '.join(parts)})"

    def __str__(self) -> str:
        """Return :meth:`__repr__`."""
        return repr(self)

    def optics_difference(self, other: Sensor) -> str | None:
        """Describe why the noise-free images of two cameras differ, e.g. ``'rows' is 16 here and 8 there``.

        Returns
        -------
        str or None
            The first field of geometry or modulation that differs; None if they see the same.
        """
        for name in OPTICS:
            here, there = getattr(self, name), getattr(other, name)
            if here != there:
                return f"'{name}' is {here} here and {there} there"
        return None

    @classmethod
    def field_groups(cls) -> dict[str, tuple[str, ...]]:
        """Return the fields in groups, in the order of light's way through the camera: title → names."""
        return FIELD_GROUPS


@lru_cache(maxsize=32)
def refuse_no_sensor(sensor: object) -> None:
    """Refuse what stands in the place of a sensor, most often the name of a preset.

    Raises
    ------
    UsageError
        It has no fields of a sensor.
    """
    if not hasattr(sensor, "harmonic_orders"):
        raise UsageError(f"'sensor' must be a Sensor, got {type(sensor).__name__}: preset gives one by its name")


def _cameras_of_one_frequency(sensor: Sensor) -> tuple[Sensor, ...]:
    # the guard is about the wrap of the unwrapped range, which no frequency has alone
    same = {"phase_interval_s": sensor.phase_image_interval_s, "wrap_guard_m": 0.0}
    return tuple(sensor.with_(modulation_hz=hz, **same) for hz in sensor.frequencies_hz)


def _numbers(name: str, value: ArrayLike) -> NDArray[np.float64]:
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"'{name}' must be numbers, got {value!r}") from None
    if not np.isfinite(numbers).all():
        raise UsageError(f"'{name}' must be finite, got {' '.join(str(value).split())}")
    return numbers
