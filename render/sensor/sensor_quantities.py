"""Quantities derived from the fields of a sensor: rays, timing, harmonics, saturation and the scale of ranges."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from phasemark.render.rigid import tilt2level
from phasemark.render.sensor.correlation import Harmonic, pulse_harmonics, square_harmonics
from phasemark.render.sensor.frequencies import common_divisor_hz
from phasemark.render.sensor.sensor_fields import SensorFields

SPEED_OF_LIGHT_M_S = 299_792_458.0


class SensorQuantities(SensorFields):
    """Derive geometry and electrical quantities from the fields."""

    @property
    def tan_half_angles(self) -> tuple[float, float]:
        """Tangents of the horizontal and vertical half angle; with a lens, half the width and height as tangents."""
        return math.tan(math.radians(self.half_angle_h_deg)), math.tan(math.radians(self.half_angle_v_deg))

    @property
    def columns_per_tangent(self) -> float:
        """Columns in a unit of the tangent of a horizontal angle."""
        return self.cols / (2 * self.tan_half_angles[0])

    @property
    def pixel_rad(self) -> float:
        """Horizontal angle that a pixel in the middle of the image sees."""
        return math.atan(1 / self.columns_per_tangent)

    @property
    def bends_rays(self) -> bool:
        """Whether there is a lens with distortion."""
        return self.lens is not None and not self.lens.is_ideal

    @property
    def farthest_corner_deg(self) -> float:
        """Largest angle of the image's corners off the optical axis."""
        y, z = self.tangents(np.array([0.0, self.cols] * 2), np.array([0.0, 0.0, self.rows, self.rows]))
        return math.degrees(math.atan(np.hypot(y, z).max()))

    @property
    def lamp_shapes_light(self) -> bool:
        """Whether the lamp's intensity changes over the image."""
        return self.lamp_profile != 0.0

    def lamp_intensity(self, cosine: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the lamp's relative intensity in directions by the cosine of their angle off the optical axis.

        Beyond the lamp's half angle, where nothing is said, too.
        """
        if isinstance(self.lamp_profile, tuple):
            angle_deg, intensity = np.array(self.lamp_profile).T
            off_axis_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
            return np.asarray(np.interp(off_axis_deg, angle_deg, intensity))
        return np.asarray(np.clip(cosine, 0.0, 1.0) ** self.lamp_profile)

    @property
    def centre_px(self) -> tuple[float, float]:
        """Where the optical axis meets the image, (u0, v0) in pixels."""
        return self.principal_point_px or (self.cols / 2, self.rows / 2)

    @property
    def upper_rows(self) -> tuple[int, int]:
        """First and stop of the image rows above the middle line, which see the upper part of a landmark."""
        return 0, self.rows // 2

    @property
    def lower_rows(self) -> tuple[int, int]:
        """First and stop of the image rows below the middle line; of an odd number the middle row is among them."""
        return self.rows // 2, self.rows

    @property
    def cam2level(self) -> NDArray[np.float64]:
        """Rotation Ry(pitch) · Rx(roll) from the tilted camera to the level one, (3, 3)."""
        return _cam2level(self.pitch_deg, self.roll_deg).copy()

    @property
    def zone_offsets(self) -> NDArray[np.float64]:
        """Offsets of the pixels beside `range_offset_m`, (rows, cols) metres; zero where none are stated."""
        table = self.zone_offset_m or ((0.0,) * self.cols,) * self.rows
        return np.array(table, dtype=np.float64)

    def zone_values(self, name: Literal["zone_gain", "zone_bin_scale"]) -> NDArray[np.float64]:
        """Return a table of [histogram] that has a number for each zone, (rows, cols); ones where none is stated."""
        table = getattr(self.histogram, name) or ((1.0,) * self.cols,) * self.rows
        return np.array(table, dtype=np.float64)

    @property
    def calibration_matrix(self) -> NDArray[np.float64]:
        """Covariance of `calibration_fields` in their units, (p, p); (0, 0) without a calibration."""
        p = len(self.calibration_fields)
        return np.array(self.calibration_covariance, dtype=np.float64).reshape(p, p)

    @property
    def quantity(self) -> Literal["range", "z"]:
        """What the camera itself reports: range along the ray, or the distance z along the optical axis."""
        if self.histogram is not None:
            return self.histogram.reports
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
        """Time from one phase image to the next: `phase_interval_s`, or 1 / (4 m · frame rate) with m frequencies."""
        return self.phase_interval_s or 1 / (self.n_phase_images * self.frame_rate_hz)

    @property
    def frequencies_hz(self) -> tuple[float, ...]:
        """The modulation frequencies in the order of the frame's phase images; one or more."""
        return self.modulation_hz if isinstance(self.modulation_hz, tuple) else (self.modulation_hz,)

    @property
    def n_phase_images(self) -> int:
        """Phase images of a frame, four for each modulation frequency."""
        return 4 * len(self.frequencies_hz)

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
    def metres_per_radian(self) -> float:
        """Range per radian of phase, c / 4πf, at the first frequency."""
        return SPEED_OF_LIGHT_M_S / (4 * math.pi * self.frequencies_hz[0])

    @property
    def range_per_phase_noise_m(self) -> float:
        """Standard deviation of a range per radian of phase noise: c / 4πf, of several frequencies c / 4π√Σf²."""
        if not isinstance(self.modulation_hz, tuple):
            return self.metres_per_radian
        return SPEED_OF_LIGHT_M_S / (4 * math.pi * math.hypot(*self.modulation_hz))

    @property
    def period_m(self) -> float:
        """Range at which the phase of the first frequency wraps, c / 2f."""
        return SPEED_OF_LIGHT_M_S / (2 * self.frequencies_hz[0])

    @property
    def unambiguous_range_m(self) -> float:
        """Range at which all phases repeat: c / 2f, of several frequencies c / (2 · gcd) (PHYSICS section 10)."""
        return SPEED_OF_LIGHT_M_S / (2 * common_divisor_hz(self.frequencies_hz))

    def describe_beyond_range(self, name: str, distance_m: float, *, in_histograms: bool = False) -> str | None:
        """Return a sentence on what the sensor shows of something too far away, or None if it is near enough.

        Parameters
        ----------
        name : str
            What has this distance, for the sentence.
        distance_m : float
        in_histograms : bool
            Whether a direct sensor's histograms are kept, and the targets in them.

        Returns
        -------
        str or None
            Ranges wrap at c / 2f; a direct sensor reports no range beyond `max_range_m`, and counts nothing beyond the
            last bin of its histograms.

        Examples
        --------
        >>> from phasemark.render import preset
        >>> preset("pmd-16x16").describe_beyond_range("the wall", 20.0)
        'the wall at 20 m is beyond c / 2f = 14.99 m, where ranges wrap: it shows at about 5.01 m'
        """
        if not math.isfinite(distance_m):
            return None
        if in_histograms and self.histogram is not None:
            end_m = self.histogram.start_m + self.histogram.bins * self.histogram.bin_width_m
            if distance_m <= end_m:
                return None
            return f"{name} at {distance_m:g} m is beyond the histograms, which end at {end_m:.4g} m"
        if self.kind == "direct" and self.max_range_m is not None:
            if distance_m <= self.max_range_m:
                return None
            limit = f"the sensor's 'max_range_m' = {self.max_range_m:.4g} m"
            return f"{name} at {distance_m:g} m is beyond {limit}: the sensor reports no range from there"
        period_m = self.unambiguous_range_m
        if distance_m < period_m:
            return None
        shown = f"it shows at about {distance_m % period_m:.3g} m"
        limit = "c / 2f" if len(self.frequencies_hz) == 1 else "c / (2 gcd f)"
        return f"{name} at {distance_m:g} m is beyond {limit} = {period_m:.4g} m, where ranges wrap: {shown}"

    def tangents(
        self, u: NDArray[np.float64] | float, v: NDArray[np.float64] | float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return y and z of the rays (1, y, z) of image points, frame of the tilted camera.

        Parameters
        ----------
        u, v : float or ndarray
            Image coordinates, pixels; they broadcast against each other. With a lens they lie in the image.
        """
        if self.lens is not None and self.bends_rays:
            return self.lens.before(self.rows, self.cols).rays(np.asarray(u, float), np.asarray(v, float))
        tan_h, tan_v = self.tan_half_angles
        u0, v0 = self.centre_px
        y = 2 * tan_h * (u0 - np.asarray(u, float)) / self.cols
        z = 2 * tan_v * (v0 - np.asarray(v, float)) / self.rows
        return y, z

    def image_points(
        self, y: NDArray[np.float64] | float, z: NDArray[np.float64] | float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return where rays (1, y, z), frame of the tilted camera, meet the image: u and v, pixels.

        Parameters
        ----------
        y, z : float or ndarray
            Tangents to the left and upwards. With a lens they belong to image points; farther out it may fold.
        """
        if self.lens is not None and self.bends_rays:
            return self.lens.before(self.rows, self.cols).project(np.asarray(y, float), np.asarray(z, float))
        tan_h, tan_v = self.tan_half_angles
        u0, v0 = self.centre_px
        return u0 - np.asarray(y, float) * self.cols / (2 * tan_h), v0 - np.asarray(z, float) * self.rows / (2 * tan_v)

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
        y, z = self.tangents(u, v)
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
        return _axis_cosine(self).copy()


@lru_cache(maxsize=64)
def _cam2level(pitch_deg: float, roll_deg: float) -> NDArray[np.float64]:
    return np.asarray(tilt2level(*np.radians([[pitch_deg], [roll_deg]]))[0])


@lru_cache(maxsize=16)
def _axis_cosine(sensor: SensorQuantities) -> NDArray[np.float64]:
    return np.asarray(sensor.pixel_directions() @ sensor.cam2level[:, 0])
