"""Flat fields: what a camera sees of one even surface, and what its taps must then report, worked out on paper.

The prediction shares no arithmetic with the chain that is measured against it: it samples the correlation curve in
time, where the chain adds up phasors of its harmonics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark import UsageError
from phasemark.render.background import Background
from phasemark.render.exposure.photoelectrons import EXACT_POISSON_BELOW
from phasemark.render.exposure.stray_light import spread_light
from phasemark.render.phasor_images import PhasorImages
from phasemark.render.renderer import Renderer
from phasemark.render.sensor.camera_unit import camera_unit
from phasemark.render.sensor.correlation import correlation_curve
from phasemark.render.sensor.range_noise import exact_phase_moments
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.view import Views

_CLEAR_SIGMAS = 6.0  # a tap this far from its limits reaches them in one of 1e9 readings
_LOOK_UP_ABOVE, _LOOK_UP_NODES = 4096, 2401  # taps
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)


def flat_field(sensor: Sensor, range_m: float, amplitude: float, *, modulated: bool = True) -> PhasorImages:
    """Return the images of a surface at one range in every pixel, a sphere about the lens for instance.

    Parameters
    ----------
    sensor : Sensor
    range_m : float
        Metres; it may lie beyond c / 2f.
    amplitude : float
        ``abs(S_1)``: albedo / range² for a surface that faces the camera, anything for a delay line.
    modulated : bool
        Whether the light is modulated; steady light has an intensity and no phasor.
    """
    shape = (1, sensor.rows, sensor.cols)
    phase = range_m / sensor.metres_per_radian
    swing = amplitude if modulated else 0.0
    return PhasorImages(
        np.full(shape, swing * np.exp(1j * phase)),
        np.full(shape, amplitude, dtype=np.float64),
        np.ones(shape),
        sensor,
        Views.broadcast(range_m),
        harmonics={k: np.full(shape, swing * np.exp(1j * k * phase)) for k in sensor.harmonic_orders},
    )


def board_image(sensor: Sensor, distance_m: float, albedo: float) -> PhasorImages:
    """Return the noise-free image of a flat board, square to the optical axis, that fills the image.

    Parameters
    ----------
    sensor : Sensor
        How it is mounted is of no account: the board is square to its own axis.
    distance_m : float
        From lens to board along the axis, metres.
    albedo : float

    Raises
    ------
    UsageError
        Distance or albedo is out of range.
    """
    if not (math.isfinite(distance_m) and distance_m > 0):
        raise UsageError(f"'distance' must be a positive number of metres, got {distance_m:g}")
    if not 0 < albedo <= 1:
        raise UsageError(f"'albedo' must be in (0, 1], got {albedo:g}")
    level = sensor.with_(pitch_deg=0.0, roll_deg=0.0, bearing_offset_deg=0.0, height_offset_m=0.0)
    return Renderer(None, level).render(distance_m / 2, background=Background(wall_m=distance_m, wall_albedo=albedo))


@dataclass(frozen=True, eq=False)
class ExpectedFlatField:
    """Predicted report of a camera with taps on a flat field, by closed forms (PHYSICS section 4).

    Parameters
    ----------
    sensor : Sensor
    tap_e : (4, 2, rows, cols) float64
        Mean electrons of every tap before anything clips.
    """

    sensor: Sensor
    tap_e: NDArray[np.float64]

    @property
    def phasor_e(self) -> NDArray[np.complex128]:
        """½ [(D₀ − D₂) + i (D₃ − D₁)] of the means, (rows, cols)."""
        d = self.tap_e[:, 0] - self.tap_e[:, 1]
        return np.asarray(0.5 * ((d[0] - d[2]) + 1j * (d[3] - d[1])))

    @property
    def range_m(self) -> NDArray[np.float64]:
        """Range that the means show, 0 … c / 2f, (rows, cols)."""
        return np.asarray(np.angle(self.phasor_e) % (2 * math.pi) * self.sensor.metres_per_radian)

    @property
    def tap_variance_e2(self) -> NDArray[np.float64]:
        """Variance of every tap's reading: shot noise, read noise and 1/12 code²; (4, 2, rows, cols)."""
        shot = self.tap_e if self.sensor.shot_noise else np.zeros_like(self.tap_e)
        return shot + self.sensor.read_noise_e**2 + self.sensor.code_e**2 / 12

    @property
    def component_variance_e2(self) -> NDArray[np.float64]:
        """Variance of real and imaginary part of the measured phasor, the mean of both; (rows, cols)."""
        return np.asarray(self.tap_variance_e2.sum(axis=(0, 1)) / 8)

    @property
    def law_phase_std_rad(self) -> NDArray[np.float64]:
        """The noise law of each pixel, its own patterns included, infinite without amplitude; (rows, cols)."""
        amplitude_e = np.abs(self.phasor_e)
        std = np.full(amplitude_e.shape, np.inf)
        np.divide(np.sqrt(self.component_variance_e2), amplitude_e, out=std, where=amplitude_e > 0)
        return std

    @property
    def range_variance_m2(self) -> NDArray[np.float64]:
        """Variance of the range, exact where the law is not; (rows, cols)."""
        return exact_phase_moments(self.law_phase_std_rad)[0] * self.sensor.metres_per_radian**2

    @property
    def clear_of_limits(self) -> bool:
        """Whether no working pixel clips, and the converter's steps drown in noise: where the noise law holds."""
        sensor, unit = self.sensor, camera_unit(self.sensor)
        alive = ~(unit.dead | unit.hot)
        mean, std = self.tap_e[..., alive], np.sqrt(self.tap_variance_e2[..., alive])
        clear = (mean + _CLEAR_SIGMAS * std < sensor.saturation_e).all()
        if sensor.adc_bits is not None:
            clear &= (mean * sensor.gain + sensor.black_level > _CLEAR_SIGMAS * std * sensor.gain).all()
            before = np.sqrt(self.tap_variance_e2[..., alive] - sensor.code_e**2 / 12)
            # below, a converter's steps show and q²/12 is not their variance (PHYSICS section 4)
            least_noise_codes = 0.5
            clear &= (before >= least_noise_codes * sensor.code_e).all()
        return bool(clear)

    @property
    def saturation_probability(self) -> NDArray[np.float64]:
        """Probability that one frame flags a pixel as saturated: one of its eight taps is; (rows, cols)."""
        return np.asarray(1 - self._clear_probability().prod(axis=(0, 1)))

    def _clear_probability(self) -> NDArray[np.float64]:
        """Return the probability that each tap stays below full well and highest code.

        It depends on the tap's mean alone: many taps look it up on a grid of 1/100 standard deviation about saturation.
        """
        sensor, mean = self.sensor, self.tap_e
        if mean.size <= _LOOK_UP_ABOVE or not sensor.shot_noise or not math.isfinite(sensor.saturation_e):
            return self._clear_probability_of(mean)
        reach = 12 * math.sqrt(sensor.saturation_e + sensor.read_noise_e**2) + 12
        grid = np.linspace(max(sensor.saturation_e - reach, 0.0), sensor.saturation_e + reach, _LOOK_UP_NODES)
        return np.interp(mean, grid, self._clear_probability_of(grid))

    def _clear_probability_of(self, mean: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the probability for taps of these means: a sum or an integral over their electrons."""
        sensor = self.sensor
        well = math.inf if sensor.full_well_e is None else sensor.full_well_e
        top = math.inf
        if sensor.adc_bits is not None:  # codes are rounded: the highest begins half a code below itself
            top = (2.0**sensor.adc_bits - 1.5 - sensor.black_level) / sensor.gain

        def read_below_top(electrons: NDArray[np.float64]) -> NDArray[np.float64]:
            if sensor.read_noise_e == 0:
                return np.asarray(electrons < top, dtype=np.float64)
            return np.asarray(special.ndtr((top - electrons) / sensor.read_noise_e))

        if not sensor.shot_noise:
            return (mean < well) * read_below_top(mean)
        clear = np.empty_like(mean)
        few = mean < EXACT_POISSON_BELOW
        counts = np.arange(math.ceil(EXACT_POISSON_BELOW + 12 * math.sqrt(EXACT_POISSON_BELOW)))
        kept = np.where(counts < well, read_below_top(counts.astype(np.float64)), 0.0)
        for level in np.unique(mean[few]):
            clear[mean == level] = np.exp(special.xlogy(counts, level) - special.gammaln(counts + 1) - level) @ kept
        many = mean[~few]
        edge = min(well, top + 8 * sensor.read_noise_e)
        low, std = many - 8 * np.sqrt(many), np.sqrt(many)
        half = np.clip((np.minimum(edge, many + 8 * std) - low) / 2, 0, None)[:, None]
        electrons = low[:, None] + half * (1 + _NODES)
        density = np.exp(-0.5 * ((electrons - many[:, None]) / std[:, None]) ** 2) / (
            std[:, None] * math.sqrt(2 * math.pi)
        )
        clear[~few] = (half * _WEIGHTS * density * read_below_top(electrons)).sum(axis=1)
        return np.clip(clear, 0.0, 1.0)


def expected_flat_field(
    sensor: Sensor, range_m: float, amplitude: float, *, modulated: bool = True
) -> ExpectedFlatField:
    """Predict the taps for :func:`flat_field`; the parameters are the same.

    Tap t of a pixel whose tap sees light late by δ_t has ½ (N₀·a·w + N_amb) ± ½ K N₀ a w c(φ + δ_t + iπ/2) electrons
    times its response, and its dark ones, with the correlation curve c(x) = cos x + Σ a_k cos(kx + θ_k). Stray light
    scales an even field by a factor w that differs from pixel to pixel only for the image's border.
    """
    unit = camera_unit(sensor)
    share = spread_light(np.ones((sensor.rows, sensor.cols)), sensor)
    x = range_m / sensor.metres_per_radian + unit.delay_rad + (np.arange(4) * (math.pi / 2))[:, None, None, None]
    sign = np.array([1.0, -1.0])[:, None, None]
    common = 0.5 * (sensor.signal_e * amplitude * share + sensor.ambient_e)
    swing = 0.5 * sensor.contrast * sensor.signal_e * amplitude * share if modulated else np.zeros_like(share)
    means = common + sign * swing * correlation_curve(x, sensor.correlation_harmonics)
    return ExpectedFlatField(sensor, means * unit.response + unit.dark_e)
