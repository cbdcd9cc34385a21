"""Estimate a sensor from measured flat-field frames: a board, square to the camera, at known distances.

What can be told depends on what was measured. Ranges alone at one distance show one number of noise; several
distances or albedos tell shot noise, which follows the light, from noise that does not; amplitude and intensity add the
electrons themselves. :func:`fit_sensor` says of every number whether it was measured, and from what.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from phasemark import UsageError
from phasemark.render.bench.flat_field import board_image
from phasemark.render.frames import Frames
from phasemark.render.integral.rounding import error_text, with_error
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.sensor.correlation import Harmonic, correlation_curve, correlation_peak
from phasemark.render.sensor.range_noise import exact_phase_moments
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.sensor.sensor_file import rounded, sensor_toml

AmplitudeUnit = Literal["electrons", "arbitrary"]

_PIXEL_STD_ERROR = 0.25
FEWEST_FRAMES = math.ceil(1 + 1 / (2 * _PIXEL_STD_ERROR**2))
"""Frames at each distance that a fit needs: so many tell the noise of one pixel to 25 %."""

_DEAD_SHARE = 0.5  # a pixel that is valid in fewer frames, at every distance, is called dead
_USED_SHARE = 0.9  # a pixel that drops out more often is a selection of its own noise, and left out
_BOARD_SHARE = 0.75  # a distance at which fewer of the living pixels can be used is left out
_NOISY_FACTOR = 2.0  # σ of a pixel over that of its neighbours, beside the test of χ²
_OUTLIER_SIGMAS = 6.0
_PIXEL_FALSE_ALARM = 1e-3  # of all pixels together
_NOISE_LEVELS_RATIO = 1.5  # largest light over smallest that tells two terms of the noise law apart
_CORRELATED_SIGMAS = 4.0
_WIGGLING_ORDERS = ((3, 7), (3,))  # most first; each order is two numbers
_WORST_CONDITION = 20.0  # of the wiggling's design: beyond, the distances cover too little of its period

DISTANCE_STD_M = 1e-3
"""Assumed standard deviation of a board's distance: that of a laser distance meter or a steel tape, read with care."""
_MOST_DISTANCE_STD = 0.1  # of the distance: the propagation is linear
_DISTANCE_STEP = 1e-4  # of the distance, for derivatives of the noise's numbers

_SEEN_SIGMAS = 4.0  # below, an order of the correlation is not there
_SINE: dict[str, Any] = {
    "modulation": "sine",
    "max_harmonic": 49,
    "harmonics": (),
    "emitted_pulse": (),
    "reference_pulse": (),
}
_DELAY_STEP_RAD = 1e-4

_Float = NDArray[np.float64]


@dataclass(frozen=True)
class FittedField:
    """One field of a fitted sensor.

    Parameters
    ----------
    value : float
    std_error : float or None
        None where the number was not measured.
    note : str
        From what it was measured, or that it is assumed, and why.
    """

    value: float
    std_error: float | None
    note: str

    @property
    def comment(self) -> str:
        """The note with its standard error, as it stands in a sensor file."""
        if self.std_error is None:
            return f"assumed: {self.note}"
        error = f", ± {error_text(self.std_error)} (standard error)" if self.std_error > 0 else ""
        return f"measured{error}: {self.note}"


@dataclass(frozen=True, eq=False)
class SensorFit:
    """What measured flat fields say about a camera.

    Parameters
    ----------
    sensor : Sensor
        The fitted camera.
    estimates : dict of str to FittedField
        By the name of the sensor's field, in the order of its fields.
    notes : tuple of str
        Sentences on what could not be told apart, and on what is odd.
    pixel_offset_m : (rows, cols) float64
        Range offset of each pixel beside the global one; NaN for pixels left out.
    pixel_offset_std_error_m : (rows, cols) float64
        Its standard error, from noise in time and from the boards' distances.
    range_std_m : (distances, rows, cols) float64
        Measured σ of one frame.
    frame_correlation, frame_correlation_std_error : float
        Correlation of a pixel's noise from one frame to the next.
    n_frames : tuple of int
        Frames at each distance.
    distance_std_m : tuple of float
        Standard deviation that each distance was taken to have; it is in all standard errors.
    """

    sensor: Sensor
    estimates: dict[str, FittedField]
    notes: tuple[str, ...]
    pixel_offset_m: _Float
    pixel_offset_std_error_m: _Float
    range_std_m: _Float
    frame_correlation: float
    frame_correlation_std_error: float
    n_frames: tuple[int, ...]
    distance_std_m: tuple[float, ...]

    def to_toml(self, *, base_name: str) -> str:
        """Return the sensor as a file, each number with what it was measured from, or that it is assumed.

        Parameters
        ----------
        base_name : str
            What the camera is called that gave all that was not measured.
        """
        comments = {name: estimate.comment for name, estimate in self.estimates.items()}
        if "harmonics" in comments:
            comments["modulation"] = "the harmonics were measured"
        header = ("Fitted to measured flat-field frames by phasemark sensor fit.", *self.notes)
        return sensor_toml(self.sensor, comments, header=header, otherwise=f"assumed: as in {base_name}")

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, lists and strings, for JSON; None where there is no number."""
        return {
            "sensor": self.sensor.model_dump(mode="json"),
            "estimates": {
                name: {"value": one.value, "std_error": one.std_error, "note": one.note}
                for name, one in self.estimates.items()
            },
            "notes": list(self.notes),
            "n_frames": list(self.n_frames),
            "distance_std_m": list(self.distance_std_m),
            "frame_correlation": self.frame_correlation,
            "frame_correlation_std_error": self.frame_correlation_std_error,
            "pixel_offset_m": [
                [float(value) if math.isfinite(value) else None for value in row] for row in self.pixel_offset_m
            ],
        }


def fit_sensor(
    frames: Sequence[Frames],
    distance_m: Sequence[float] | NDArray[np.floating],
    *,
    base: Sensor,
    albedo: Sequence[float] | None = None,
    amplitude_unit: AmplitudeUnit = "electrons",
    distance_std_m: float | Sequence[float] | None = None,
) -> SensorFit:
    """Estimate a camera from frames of a flat board that fills the image, square to the optical axis.

    With the range error e = offset + wiggling(phase) + pattern and the noise law σ_φ² = (I + V) / 2A² (PHYSICS section
    4), the board's light follows from distance and albedo, S = ρ cos θ / r² averaged over each pixel:

    - the offset is the mean error; with distances enough, wiggling is fitted beside it;
    - the pattern is what is left of each pixel, its spread less the spread that noise leaves;
    - from ranges alone, σ_φ² = a/S + b/S² with a = 1 / 2K²N₀ and b = (all noise that does not follow the light) /
      2K²N₀²; K is assumed;
    - from amplitude in electrons, K N₀ = A/S and 2σ_φ²A² = N₀S + (N_amb + N_dark + V); from intensity as well,
      I = N₀S + N_amb + N_dark and V = 2σ_φ²A² − I;
    - from amplitude and intensity in arbitrary units, g = slope of 2σ_φ²A² over I turns both into electrons.

    The errors of the distances are propagated to first order: they move ranges directly and the light by −2σ_r / r.

    Parameters
    ----------
    frames : sequence of Frames
        One position each, at least `FEWEST_FRAMES` frames.
    distance_m : sequence of float
        Distance of the board along the optical axis for each.
    base : Sensor
        The camera as far as it is known: geometry, modulation frequency and all that is not measured.
    albedo : sequence of float, optional
        Albedo of each board, or one for all; without it 0.8 is assumed.
    amplitude_unit : {"electrons", "arbitrary"}
        Unit of the frames' amplitude and intensity.
    distance_std_m : float or sequence of float, optional
        Standard deviation of the distances, one for all or one for each, independent from board to board; without it
        `DISTANCE_STD_M`, 1 mm, is assumed. 0: exact.

    Returns
    -------
    SensorFit

    Raises
    ------
    UsageError
        Numbers of frames, distances, albedos and standard deviations do not fit; there are too few frames; no pixel is
        valid often enough; a standard deviation is negative or more than a tenth of its distance.
    """
    if len(frames) != len(distance_m) or not frames:
        raise UsageError(
            f"each set of frames needs its distance: got {len(frames)} of frames and {len(distance_m)} of distances"
        )
    if amplitude_unit not in ("electrons", "arbitrary"):
        raise UsageError(f"'amplitude_unit' must be 'electrons' or 'arbitrary', got {amplitude_unit!r}")
    assumed_albedo = albedo is None
    albedos = [0.8] if albedo is None else list(albedo)
    if len(albedos) == 1:
        albedos *= len(frames)
    if len(albedos) != len(frames):
        raise UsageError(f"give one albedo, or one for each of the {len(frames)} distances, got {len(albedos)}")
    for one, distance in zip(frames, distance_m, strict=True):
        if len(one) != 1:
            raise UsageError(f"the frames at {distance:g} m must be of one position, got {len(one)}")
        if one.n_frames < FEWEST_FRAMES:
            raise UsageError(
                f"too few frames at {distance:g} m: {one.n_frames}, but at least {FEWEST_FRAMES} are needed to know a "
                f"pixel's noise to {100 * _PIXEL_STD_ERROR:.0f} %"
            )
    notes: list[str] = []
    estimates: dict[str, FittedField] = {}
    distance_std = _distance_std(distance_m, distance_std_m)
    data = _Data.of(frames, distance_m, distance_std, albedos, base).of_usable_boards(distance_m, notes)
    if assumed_albedo and base.kind == "phase":
        notes.append("The board's albedo was assumed to be 0.8: signal_e times albedo is what was measured.")
    if not (data.variance_m2[:, data.good] > 0).any():
        raise UsageError("the frames have no noise: every range is the same in all of them; is one frame repeated?")
    notes.append(_said_of_distances(distance_std, assumed=distance_std_m is None))
    correlation, correlation_error = data.frame_correlation()
    if abs(correlation) > _CORRELATED_SIGMAS * correlation_error:
        notes.append(
            "Frames are not independent: the noise of a pixel correlates by "
            f"{with_error(correlation, correlation_error)} from one frame to the next, as behind a filter in time; "
            "standard errors allow for it, σ may be too small."
        )
    widening = math.sqrt(max((1 + correlation) / (1 - correlation), 1.0)) if abs(correlation) < 1 else 1.0
    changes = _fit_offsets(data, base, estimates, notes, widening)
    offset, offset_error = data.pattern(changes)
    # the pixels that a flat field shows to be odd leave before anything else is measured
    odd = data.odd_pixels(offset)
    if odd.any():
        data = data.without(odd)
        changes = _fit_offsets(data, base, estimates, [], widening)
        offset, offset_error = data.pattern(changes)
    offset_error, moved = offset_error * widening, data.pattern_moved(changes)
    changes |= _pattern_fields(data, base, offset, offset_error, moved, odd, estimates)
    changes |= _fit_noise(data, base, amplitude_unit, estimates, notes)
    fields = {**base.model_dump(), **{name: rounded(value) for name, value in changes.items()}}
    if base.kind == "phase":
        fields["contrast"] = _possible_contrast(fields, estimates, notes)
    sensor = Sensor(**fields)
    order = {name: position for position, name in enumerate(Sensor.model_fields)}
    return SensorFit(
        sensor,
        {name: estimates[name] for name in sorted(estimates, key=order.__getitem__)},
        tuple(notes),
        offset,
        np.sqrt(offset_error**2 + (moved**2).sum(axis=0)),
        np.sqrt(data.variance_m2),
        correlation,
        correlation_error,
        tuple(one.n_frames for one in frames),
        tuple(distance_std),
    )


def _distance_std(
    distance_m: Sequence[float] | NDArray[np.floating], stated: float | Sequence[float] | None
) -> list[float]:
    """Return the standard deviation of each distance."""
    std = np.atleast_1d(np.asarray(DISTANCE_STD_M if stated is None else stated, np.float64)).ravel().tolist()
    if len(std) == 1:
        std *= len(distance_m)
    if len(std) != len(distance_m):
        raise UsageError(
            f"give one 'distance_std_m', or one for each of the {len(distance_m)} distances, got {len(std)}"
        )
    if stated is None:  # of a board a few millimetres away it would be no small error
        return [min(one, _MOST_DISTANCE_STD * d) for one, d in zip(std, distance_m, strict=True)]
    for one, distance in zip(std, distance_m, strict=True):
        if distance > 0 and not 0 <= one <= _MOST_DISTANCE_STD * distance:
            raise UsageError(
                f"'distance_std_m' must be a number of metres from 0 to a tenth of the distance, "
                f"{_MOST_DISTANCE_STD * distance:g} at {distance:g} m, got {one:g}"
            )
    return std


def _said_of_distances(std_m: Sequence[float], *, assumed: bool) -> str:
    """Say how well the distances were taken to be known."""
    if not any(std_m):
        return "The distances were taken to be exact; standard errors hold only as far as they are."
    shown = dict.fromkeys(f"{1e3 * one:.3g}" for one in std_m)
    source = "assumed" if assumed else "stated"
    return (
        f"The distances were {source} to have a standard deviation of {', '.join(shown)} mm, "
        "independent of one another; the standard errors allow for it."
    )


@dataclass(frozen=True, eq=False)
class _Data:
    """Measured frames reduced to moments, beside what the board sends; (boards, rows, cols), NaN where unused."""

    sensor: Sensor
    distance_m: _Float  # (boards,)
    distance_std_m: _Float  # (boards,)
    n: _Float  # valid frames
    error_m: _Float  # mean range less true range
    variance_m2: _Float  # of one frame
    light: _Float  # |S| of the board
    truth_m: _Float
    amplitude: _Float | None
    intensity: _Float | None
    noise_m: tuple[_Float, ...]  # (frames, rows, cols) of each board: range less its own mean
    share: _Float  # of valid frames, at all distances, those left out included
    good: NDArray[np.bool_]  # (rows, cols), pixels that every number is made of

    @classmethod
    def of(
        cls,
        frames: Sequence[Frames],
        distance_m: Sequence[float] | NDArray[np.floating],
        distance_std_m: Sequence[float],
        albedo: Sequence[float],
        base: Sensor,
    ) -> _Data:
        """Reduce the frames; no pixel is called good yet."""
        images = [board_image(base, d, rho) for d, rho in zip(distance_m, albedo, strict=True)]
        truth = np.concatenate([image.range_m for image in images])
        error, variance, count, noise = [], [], [], []
        for one, image in zip(frames, images, strict=True):
            # a true range beyond c / 2f comes back inside it, as the measured one does
            difference = wrap_difference_m(one.range_m[0] - image.range_m[0], base)
            valid = one.valid[0]
            n = valid.sum(axis=0).astype(np.float64)
            # about each pixel's own circular mean, so that no cut lies among its values
            turn = np.where(valid, np.exp(1j * np.nan_to_num(difference) / base.metres_per_radian), 0).sum(axis=0)
            centre = np.angle(turn) * base.metres_per_radian
            about = np.where(valid, wrap_difference_m(difference - centre, base), 0.0)
            mean = about.sum(axis=0) / np.maximum(n, 1)
            residual = np.where(valid, about - mean, np.nan)
            enough = n >= max(FEWEST_FRAMES / 2, 2)
            error.append(np.where(enough, wrap_difference_m(centre + mean, base), np.nan))
            spread = np.where(valid, (about - mean) ** 2, 0.0).sum(axis=0)
            variance.append(np.where(enough, spread / np.maximum(n - 1, 1), np.nan))
            count.append(n)
            noise.append(residual)
        share = np.array([n / one.n_frames for n, one in zip(count, frames, strict=True)])
        return cls(
            base,
            np.array(distance_m, np.float64),
            np.array(distance_std_m, np.float64),
            np.array(count),
            np.array(error),
            np.array(variance),
            np.concatenate([image.amplitude for image in images]),
            truth,
            _means([one.amplitude_e for one in frames], [one.valid[0] for one in frames], root_mean_square=True),
            _means([one.intensity_e for one in frames], [one.valid[0] for one in frames]),
            tuple(noise),
            share,
            np.zeros(share.shape[1:], np.bool_),
        )

    def of_usable_boards(self, distance_m: Sequence[float] | NDArray[np.floating], notes: list[str]) -> _Data:
        """Leave out the distances at which too few pixels answer, and then the pixels that do not answer at the rest.

        Raises
        ------
        UsageError
            No pixel is left.
        """
        usable = self.share >= _USED_SHARE
        alive = usable.any(axis=0)
        if not alive.any():
            raise UsageError(
                f"no pixel is valid in {100 * _USED_SHARE:.0f} % of the frames at any distance: there is nothing to fit"
            )
        kept = usable[:, alive].mean(axis=1) >= _BOARD_SHARE
        kept[usable[:, alive].sum(axis=1).argmax()] = True
        for index in np.flatnonzero(~kept):
            notes.append(
                f"The frames at {distance_m[int(index)]:g} m were left out: "
                f"{100 * usable[index, alive].mean():.0f} % of the pixels answer there."
            )
        good = usable[kept].all(axis=0)
        lost = int((self.share < _DEAD_SHARE).all(axis=0).sum())
        if lost > 0.1 * good.size:
            notes.append(
                f"{lost} of {good.size} pixels never answer and are called dead: does the board fill the image, and is "
                "it bright enough?"
            )

        def boards(values: _Float | None) -> _Float | None:
            return None if values is None else values[kept]

        return replace(
            self,
            distance_m=self.distance_m[kept],
            distance_std_m=self.distance_std_m[kept],
            n=self.n[kept],
            error_m=self.error_m[kept],
            variance_m2=self.variance_m2[kept],
            light=self.light[kept],
            truth_m=self.truth_m[kept],
            amplitude=boards(self.amplitude),
            intensity=boards(self.intensity),
            noise_m=tuple(noise for noise, used in zip(self.noise_m, kept, strict=True) if used),
            good=good,
        )

    @property
    def dead(self) -> NDArray[np.bool_]:
        """Pixels that answer at no distance, (rows, cols)."""
        return np.asarray((self.share < _DEAD_SHARE).all(axis=0))

    def without(self, odd: NDArray[np.bool_]) -> _Data:
        """Leave out some pixels."""
        return replace(self, good=self.good & ~odd)

    def shifted(self, board: int, change_m: float) -> _Data:
        """Take a board to have stood further away; the measured ranges stay."""
        factor = 1 + change_m / self.distance_m[board]
        truth, error, light = self.truth_m.copy(), self.error_m.copy(), self.light.copy()
        truth[board] *= factor
        error[board] = wrap_difference_m(error[board] - (truth[board] - self.truth_m[board]), self.sensor)
        light[board] /= factor**2
        return replace(
            self,
            distance_m=self.distance_m + change_m * (np.arange(len(self.distance_m)) == board),
            truth_m=truth,
            error_m=error,
            light=light,
        )

    @property
    def phase_rad(self) -> _Float:
        """True phases, (boards, pixels used)."""
        return self.truth_m[:, self.good] / self.sensor.metres_per_radian

    def frame_correlation(self) -> tuple[float, float]:
        """Return the correlation of a pixel's noise with that of the frame before, all pixels together.

        Subtracting a mean of n values leaves a correlation of −1 / n, which is added again.
        """
        product, square, pairs, shift = 0.0, 0.0, 0, 0.0
        for noise in self.noise_m:
            values = noise[:, self.good]
            both = np.isfinite(values[1:]) & np.isfinite(values[:-1])
            product += float(np.where(both, values[1:] * values[:-1], 0.0).sum())
            square += float(np.where(both, 0.5 * (values[1:] ** 2 + values[:-1] ** 2), 0.0).sum())
            pairs += int(both.sum())
            shift += both.sum() / len(values)
        if square == 0:
            return 0.0, math.inf
        return product / square + shift / pairs, 1 / math.sqrt(pairs)

    def pattern(self, changes: dict[str, Any]) -> tuple[_Float, _Float]:
        """Return the delay of each pixel beside offset and wiggling, as range, and its standard error; (rows, cols).

        A delay moves the range by more or less than itself where the range wiggles: by the slope of the model.
        """
        harmonics = _harmonics_of(self.sensor, changes)
        delay = changes["range_offset_m"] / self.sensor.metres_per_radian
        phase = self.truth_m / self.sensor.metres_per_radian
        model = _range_error_m(phase, delay, harmonics, self.sensor)
        later = _range_error_m(phase, delay + _DELAY_STEP_RAD, harmonics, self.sensor)
        slope = wrap_difference_m(later - model, self.sensor) / (_DELAY_STEP_RAD * self.sensor.metres_per_radian)
        residual = wrap_difference_m(self.error_m - model, self.sensor)[:, self.good]
        slope, noise = slope[:, self.good], (self.variance_m2 / np.maximum(self.n, 1))[:, self.good]
        # without any noise every distance counts alike
        weight = 1 / np.maximum(noise, 1e-18)
        information = (weight * slope**2).sum(axis=0)
        offset, error = np.full(self.good.shape, np.nan), np.full(self.good.shape, np.nan)
        offset[self.good] = (weight * slope * residual).sum(axis=0) / information
        error[self.good] = np.sqrt((weight**2 * slope**2 * noise).sum(axis=0)) / information
        return offset, error

    def pattern_moved(self, changes: dict[str, Any]) -> _Float:
        """Return how the pattern moves with one standard deviation of each board's distance, (boards, rows, cols).

        Ranges grow from the middle to the corners, so an error of the distance does too; its mean is in the offset.
        """
        before, _ = self.pattern(changes)
        moved = np.array(
            [self.shifted(k, std).pattern(changes)[0] - before for k, std in enumerate(self.distance_std_m)]
        )
        if self.good.any():
            moved -= moved[:, self.good].mean(axis=1)[:, None, None]
        return moved

    def odd_pixels(self, offset_m: _Float) -> NDArray[np.bool_]:
        """Return pixels that are stuck, far noisier than the rest at their light, or far off; (rows, cols)."""
        good = self.good
        if good.sum() < 3:
            return np.zeros_like(good)
        scaled = np.where(good, self.variance_m2 * self.light, np.nan)  # shot noise: σ² follows 1 / light
        middle = np.nanmedian(scaled, axis=(1, 2), keepdims=True)
        stuck = good & (middle > 0).all() & (self.variance_m2 == 0).any(axis=0)
        limit = special.chdtri(self.n - 1, _PIXEL_FALSE_ALARM / scaled.size) / np.maximum(self.n - 1, 1)
        loud = np.nan_to_num(scaled) > np.maximum(limit, _NOISY_FACTOR**2) * middle
        centre = np.nanmedian(offset_m)
        spread = 1.4826 * np.nanmedian(np.abs(offset_m - centre))
        far = np.abs(np.nan_to_num(offset_m - centre)) > max(_OUTLIER_SIGMAS * spread, 1e-12)
        return np.asarray(good & (stuck | loud.any(axis=0) | far))


def _means(
    values: Sequence[_Float | None], valid: Sequence[NDArray[np.bool_]], *, root_mean_square: bool = False
) -> _Float | None:
    """Return mean, or root mean square, of every pixel's valid values; None unless all boards have them."""
    means = []
    for one, usable in zip(values, valid, strict=True):
        if one is None:
            return None
        power = 2 if root_mean_square else 1
        total = np.where(usable, np.nan_to_num(one[0]) ** power, 0.0).sum(axis=0) / np.maximum(usable.sum(axis=0), 1)
        means.append(total ** (1 / power))
    return np.array(means)


def _harmonics_of(base: Sensor, changes: dict[str, Any]) -> tuple[Harmonic, ...]:
    """Return the fitted orders of the correlation, or the assumed ones."""
    if "harmonics" in changes:
        return tuple(Harmonic(*entry) for entry in changes["harmonics"])
    return base.correlation_harmonics


def _range_error_m(phase: _Float, delay: float, harmonics: tuple[Harmonic, ...], sensor: Sensor) -> _Float:
    """Return the error of the noise-free range, offset and wiggling, from four samples of the correlation curve."""
    samples = [correlation_curve(phase + delay + i * math.pi / 2, harmonics) for i in range(4)]
    measured = np.arctan2(samples[3] - samples[1], samples[0] - samples[2])
    return np.asarray(wrap_difference_m((measured - phase) * sensor.metres_per_radian, sensor))


def _fit_offsets(
    data: _Data, base: Sensor, estimates: dict[str, FittedField], notes: list[str], widening: float
) -> dict[str, Any]:
    """Fit the global offset, and wiggling if the distances allow it, to the mean error of each board."""
    good = data.good
    mean = data.error_m[:, good].mean(axis=1)
    # the same pixels see every board, so their own offsets move all means alike
    temporal = np.sqrt((data.variance_m2 / np.maximum(data.n, 1))[:, good].mean(axis=1) / good.sum()) * widening
    # an error of the distance is one of the mean; its lever on the wiggling's phase is small beside that
    obliquity = (data.truth_m[:, good] / data.distance_m[:, None]).mean(axis=1)
    std = np.maximum(np.hypot(temporal, data.distance_std_m * obliquity), 1e-9)
    m, known, none_seen = len(mean), base.correlation_harmonics, False
    wiggles = [orders for orders in _WIGGLING_ORDERS if m >= 2 + 2 * len(orders)] if base.kind == "phase" else []
    for orders in wiggles:
        design = np.column_stack(
            [np.ones(m)]
            + [part((k + 1) * data.phase_rad).mean(axis=1) for k in orders for part in (np.cos, np.sin)]
        )  # fmt: skip
        if np.linalg.cond(design / np.linalg.norm(design, axis=0)) <= _WORST_CONDITION:
            changes = _fit_wiggling(data, orders, mean, std, estimates, notes)
            if changes is not None:
                return changes
            none_seen, known = True, ()
            break

    def residual(parameters: _Float) -> _Float:
        if base.kind == "direct":
            model = np.full(m, parameters[0])
        else:
            delay = float(parameters[0]) / base.metres_per_radian
            model = _range_error_m(data.phase_rad, delay, known, base).mean(axis=1)
        return np.asarray(wrap_difference_m(mean - model, base) / std)

    centre = _circular_mean(mean, base)
    found = optimize.least_squares(residual, [centre], x_scale=max(float(std.min()), 1e-6))
    error = 1 / float(np.linalg.norm(_jacobian(found)))
    if m > 1:
        error *= math.sqrt(max(2 * found.cost / (m - 1), 1.0))
    where = "one distance" if m == 1 else f"{m} distances"
    text = f"mean error of {int(good.sum())} pixels at {where}"
    if base.kind == "phase" and m == 1:
        text += "; wiggling at that distance is in it"
    estimates["range_offset_m"] = FittedField(float(found.x[0]), error, text)
    changes = {"range_offset_m": float(found.x[0])}
    if none_seen:
        return {**changes, **_SINE}
    if base.kind == "phase":
        needed = 2 + 2 * len(_WIGGLING_ORDERS[-1])
        period = base.unambiguous_range_m / 4
        notes.append(
            f"Offset and wiggling cannot be told apart from {where}: that takes at least {needed}, spread over "
            f"{period:.3g} m, one period of the wiggling. The modulation is the assumed one."
        )
    return changes


def _circular_mean(values_m: _Float, sensor: Sensor) -> float:
    turn = np.exp(1j * values_m / sensor.metres_per_radian).sum()
    return float(np.angle(turn) * sensor.metres_per_radian)


def _jacobian(found: optimize.OptimizeResult) -> _Float:
    """Return the Jacobian of a least-squares solution, (residuals, parameters)."""
    return np.asarray(found["jac"], dtype=np.float64)


def _fit_wiggling(
    data: _Data,
    orders: tuple[int, ...],
    mean: _Float,
    std: _Float,
    estimates: dict[str, FittedField],
    notes: list[str],
) -> dict[str, Any] | None:
    """Fit offset and orders of the correlation to the mean errors.

    Ranges cannot tell order k ≡ 3 mod 4 from k + 2: to first order both add sines of (k + 1)φ. All of it is put down to
    the lower one, which moves ranges alike. None where no order is seen.
    """
    sensor, m = data.sensor, len(mean)

    def harmonics(parameters: _Float) -> tuple[Harmonic, ...]:
        pairs = parameters[1:].reshape(-1, 2)
        return tuple(Harmonic(k, math.hypot(c, s), math.atan2(s, c)) for k, (c, s) in zip(orders, pairs, strict=True))

    def residual(parameters: _Float) -> _Float:
        model = _range_error_m(data.phase_rad, float(parameters[0]), harmonics(parameters), sensor).mean(axis=1)
        return np.asarray(wrap_difference_m(mean - model, sensor) / std)

    start = np.zeros(1 + 2 * len(orders))
    start[0] = _circular_mean(mean, sensor) / sensor.metres_per_radian
    start[1:] = 1e-3
    found = optimize.least_squares(residual, start, x_scale=0.01)
    scatter = max(2 * found.cost / max(m - len(start), 1), 1.0)
    jacobian = _jacobian(found)
    covariance = np.linalg.inv(jacobian.T @ jacobian) * scatter
    offset_m = float(found.x[0]) * sensor.metres_per_radian
    found_harmonics = harmonics(found.x)
    parts = []
    for j, one in enumerate(found_harmonics):
        gradient = found.x[1 + 2 * j : 3 + 2 * j] / max(one.amplitude, 1e-12)
        own = covariance[1 + 2 * j : 3 + 2 * j, 1 + 2 * j : 3 + 2 * j]
        parts.append(math.sqrt(float(gradient @ own @ gradient)))
    described = ", ".join(
        f"a_{h.order} = {with_error(h.amplitude, e)}" for h, e in zip(found_harmonics, parts, strict=True)
    )
    if all(h.amplitude < _SEEN_SIGMAS * e for h, e in zip(found_harmonics, parts, strict=True)):
        notes.append(f"No wiggling is seen at {m} distances: {described}.")
        return None
    estimates["range_offset_m"] = FittedField(
        offset_m, math.sqrt(covariance[0, 0]) * sensor.metres_per_radian, f"mean error at {m} distances, less wiggling"
    )
    estimates["harmonics"] = FittedField(
        found_harmonics[0].amplitude,
        parts[0],
        f"wiggling at {m} distances ({described}); orders 3 and 5, 7 and 9 move ranges alike: all put down to 3, 7",
    )
    kept = [(h.order, min(h.amplitude, 1.0), h.phase_rad) for h in found_harmonics if h.amplitude > 0]
    return {
        **_SINE,
        "range_offset_m": offset_m,
        "modulation": "harmonics",
        "harmonics": tuple(kept),
    }


def _pattern_fields(
    data: _Data,
    base: Sensor,
    offset_m: _Float,
    offset_error_m: _Float,
    moved_m: _Float,
    odd: NDArray[np.bool_],
    estimates: dict[str, FittedField],
) -> dict[str, Any]:
    """Return the fields about single pixels."""
    good = data.good
    dead = data.dead
    changes: dict[str, Any] = {
        "dead_pixels": tuple((int(row), int(col)) for row, col in np.argwhere(dead)),
        "dead_share": 0.0,
    }
    estimates["dead_pixels"] = FittedField(
        float(dead.sum()), 0.0, f"valid in less than {100 * _DEAD_SHARE:.0f} % of the frames at every distance"
    )
    if base.kind == "direct":
        changes["dead_pixels"] = tuple((int(row), int(col)) for row, col in np.argwhere(dead | odd))
        return changes
    changes["hot_pixels"] = tuple((int(row), int(col)) for row, col in np.argwhere(odd))
    changes["hot_share"] = 0.0
    estimates["hot_pixels"] = FittedField(
        float(odd.sum()), 0.0, f"stuck, noisier than {_NOISY_FACTOR:g} times the median or {_OUTLIER_SIGMAS:g} σ off"
    )
    count = int(good.sum())
    if count < 3:
        return changes
    noise = float((offset_error_m[good] ** 2).mean())
    own, moved = offset_m[good] - offset_m[good].mean(), moved_m[:, good]
    by_distance = moved.var(axis=1, ddof=1)  # of each board
    variance = max(float(offset_m[good].var(ddof=1)) - noise - float(by_distance.sum()), 0.0)
    # of a normal pattern's variance, its own and the noise's spread alike; a distance's error δ adds 2δ·cov + δ²·var
    levers = 2 * (moved * own).sum(axis=1) / (count - 1)
    of_distances = float((levers**2).sum() + 2 * (by_distance**2).sum())
    of_variance = math.hypot(math.sqrt(2 / (count - 1)) * (variance + noise), math.sqrt(of_distances))
    std_m = math.sqrt(variance)
    error_m = of_variance / (2 * std_m) if variance > of_variance else math.sqrt(of_variance)
    scale = base.metres_per_radian
    estimates["phase_offset_std_rad"] = FittedField(
        std_m / scale, error_m / scale,
        f"spread of {count} pixels' offsets less noise, {1e3 * std_m:.3g} mm; a tilt of the board is in it",
    )  # fmt: skip
    changes["phase_offset_std_rad"] = min(std_m / scale, 1.0)
    changes["tap_phase_offset_std_rad"] = 0.0
    return changes


def _fit_noise(
    data: _Data, base: Sensor, amplitude_unit: AmplitudeUnit, estimates: dict[str, FittedField], notes: list[str]
) -> dict[str, Any]:
    """Return the fields that the noise of single frames tells, the errors of the distances in their standard errors."""
    good = data.good
    if base.kind == "direct":
        variance = data.variance_m2[:, good]
        degrees = float((data.n[:, good] - 1).sum())
        std = math.sqrt(float(variance.mean()))
        estimates["range_std_m"] = FittedField(std, std / math.sqrt(2 * degrees), "noise of single frames")
        return {"range_std_m": std}
    found: dict[str, FittedField] = {}
    changes = _fit_light(data, base, amplitude_unit, found, notes)
    variance_of = dict.fromkeys(found, 0.0)
    for board, (distance, std) in enumerate(zip(data.distance_m, data.distance_std_m, strict=True)):
        step = _DISTANCE_STEP * float(distance)
        sides = [_refitted(data.shifted(board, side), base, amplitude_unit) for side in (step, -step)] if std else []
        for name, one in found.items():
            # a side on which other numbers can be told apart says nothing of the slope
            slopes = [
                (side[name].value - one.value) / (sign * step)
                for sign, side in zip((1, -1), sides, strict=False)
                if side.keys() == found.keys()
            ]
            variance_of[name] += (float(np.mean(slopes)) * float(std)) ** 2 if slopes else 0.0
    for name, one in found.items():
        if one.std_error is not None:
            one = replace(one, std_error=math.hypot(one.std_error, math.sqrt(variance_of[name])))
        # less light than none is chance
        estimates[name] = replace(one, value=max(one.value, 0.0)) if name == "ambient_e" else one
    if "ambient_e" in changes:
        changes["ambient_e"] = max(changes["ambient_e"], 0.0)
    return changes


def _refitted(data: _Data, base: Sensor, amplitude_unit: AmplitudeUnit) -> dict[str, FittedField]:
    """Return the estimates of other data; none if these do not show the signal."""
    found: dict[str, FittedField] = {}
    try:
        _fit_light(data, base, amplitude_unit, found, [])
    except UsageError:
        return {}
    return found


def _fit_light(
    data: _Data, base: Sensor, amplitude_unit: AmplitudeUnit, estimates: dict[str, FittedField], notes: list[str]
) -> dict[str, Any]:
    """Fit signal, contrast, ambient light and read noise to given distances; ambient light may come out negative."""
    good = data.good
    law, scale_error = _NoiseData.of(data), 0.0
    amplitude = None if data.amplitude is None else data.amplitude[:, good]
    intensity = None if data.intensity is None else data.intensity[:, good]
    if amplitude is not None:  # the mean square of a noisy amplitude is A² + 2σ²
        amplitude = amplitude / np.sqrt(1 + 2 * law.phase_variance.mean(axis=1, keepdims=True))
    if amplitude is not None and amplitude_unit == "arbitrary":
        electrons = None if intensity is None else law.electrons_per_unit(amplitude, intensity)
        if electrons is None:
            notes.append(
                "Amplitudes of arbitrary unit tell no electrons: that takes intensities too, at distances or albedos "
                f"whose light differs by {_NOISE_LEVELS_RATIO:g} times and more. They were left aside."
            )
            amplitude = intensity = None
        else:
            scale, error = electrons
            notes.append(
                f"Photon transfer gives {with_error(scale, error)} electrons a unit of amplitude and intensity."
            )
            amplitude, scale_error = amplitude * scale, error / scale
            intensity = None if intensity is None else intensity * scale
    if amplitude is None:
        return _noise_of_ranges(law, base, estimates, notes)
    return _noise_of_electrons(law, base, amplitude, intensity, scale_error, estimates, notes)


@dataclass(frozen=True, eq=False)
class _NoiseData:
    """Phase variances (boards, pixels) beside the light, |S|, with their degrees of freedom."""

    light: _Float
    light_std: _Float  # (boards,), relative, of the boards' distances
    phase_variance: _Float
    degrees: _Float

    @classmethod
    def of(cls, data: _Data) -> _NoiseData:
        """Take the pixels used."""
        good = data.good
        variance = data.variance_m2[:, good] / data.sensor.metres_per_radian**2
        mean = variance.mean(axis=1, keepdims=True)
        # the law is a little low where noise is high: by what the exact density says
        above_law = np.ones_like(mean)
        np.divide(exact_phase_moments(np.sqrt(mean))[0], mean, out=above_law, where=mean > 0)
        light_std = 2 * data.distance_std_m / data.distance_m
        return cls(data.light[:, good], light_std, variance / above_law, data.n[:, good] - 1)

    @property
    def levels_differ(self) -> bool:
        """Whether the light of the boards tells what follows it from what does not."""
        mean = self.light.mean(axis=1)
        return bool(mean.max() >= _NOISE_LEVELS_RATIO * mean.min())

    def two_terms(self, y: _Float, first: _Float, second: _Float) -> tuple[_Float, _Float]:
        """Fit y = p·first + q·second, where y has the relative variance 2 / degrees; return (p, q) and covariance.

        The weights come from the fit itself, in three rounds: weights from y would favour what chance made small.
        """
        design = np.column_stack([first.ravel(), second.ravel()])
        target, degrees = y.ravel(), self.degrees.ravel()
        expected = np.repeat(y.mean(axis=1), y.shape[1])
        for _ in range(4):
            root = np.sqrt(degrees / 2) / np.maximum(np.abs(expected), 1e-300)
            solution, covariance = _solve(design * root[:, None], target * root)
            expected = design @ solution
            expected = np.where(expected > 0, expected, np.repeat(y.mean(axis=1), y.shape[1]))
        return solution, covariance

    def one_term(self, y: _Float) -> tuple[float, float]:
        """Return the mean of a y that should be the same everywhere, and its standard error."""
        weight = self.degrees / self.degrees.sum()
        mean = float((weight * y).sum())
        return mean, abs(mean) * math.sqrt(2 / float(self.degrees.sum()))

    def electrons_per_unit(self, amplitude: _Float, intensity: _Float) -> tuple[float, float] | None:
        """Return electrons a unit from 2σ_φ²A² = g·I + g²V, or None if the light does not vary enough."""
        mean = intensity.mean(axis=1)
        if not mean.max() >= _NOISE_LEVELS_RATIO * max(mean.min(), 0) or mean.min() <= 0:
            return None
        (gain, _), covariance = self.two_terms(
            2 * self.phase_variance * amplitude**2, intensity, np.ones_like(intensity)
        )
        error = math.sqrt(covariance[0, 0])
        return None if gain <= 2 * error else (1 / gain, error / gain**2)


def _solve(design: _Float, target: _Float) -> tuple[_Float, _Float]:
    """Solve least squares of unit weight, columns scaled; return solution and covariance."""
    scale = np.linalg.norm(design, axis=0)
    covariance = np.linalg.inv((design / scale).T @ (design / scale))
    return covariance @ ((design / scale).T @ target) / scale, covariance / np.outer(scale, scale)


def _noise_of_ranges(
    law: _NoiseData, base: Sensor, estimates: dict[str, FittedField], notes: list[str]
) -> dict[str, Any]:
    """Turn σ_φ² = a/S + b/S² into signal and constant noise, the contrast assumed."""
    contrast = base.contrast
    estimates["contrast"] = FittedField(contrast, None, "ranges alone do not tell it from signal_e")
    constant_e2 = base.ambient_e + base.dark_e + base.read_variance_e2
    if law.levels_differ:
        (a, b), covariance = law.two_terms(law.phase_variance, 1 / law.light, 1 / law.light**2)
        if a > 2 * math.sqrt(covariance[0, 0]):
            signal = 1 / (2 * contrast**2 * a)
            signal_error = signal * math.sqrt(covariance[0, 0]) / a
            to_electrons = 2 * contrast**2 * signal**2
            noise = to_electrons * b
            gradient = np.array([-2 * noise / a, to_electrons])
            noise_error = math.sqrt(float(gradient @ covariance @ gradient))
            ambient = noise - base.dark_e - base.read_variance_e2
            notes.append(
                "Ranges alone tell signal_e · contrast² and the noise that does not follow the light; the latter is "
                "put down to ambient light, beside the assumed dark current and read noise."
            )
            estimates["signal_e"] = FittedField(signal, signal_error, "noise against light, for the assumed contrast")
            estimates["ambient_e"] = FittedField(
                ambient, noise_error, "noise that does not follow the light: read noise may be in it"
            )
            return {"signal_e": signal, "ambient_e": ambient}
    # one number: σ_φ² = (N₀S + B) / 2K²N₀²S² with B as assumed, solved for N₀
    y, y_error = law.one_term(2 * contrast**2 * law.phase_variance * law.light**2)
    s = float(law.light.mean())
    signal = (s + math.sqrt(s**2 + 4 * y * constant_e2)) / (2 * y)
    slope = s / signal**2 + 2 * constant_e2 / signal**3  # −dy/dN₀
    notes.append(
        "The ranges show one number of noise: which part of it follows the light takes distances or albedos whose "
        f"light differs by {_NOISE_LEVELS_RATIO:g} times and more, or amplitudes. signal_e is that for the assumed "
        "contrast, ambient light and read noise."
    )
    estimates["signal_e"] = FittedField(
        signal, y_error / slope, "range noise, for the assumed contrast and ambient light"
    )
    return {"signal_e": signal}


def _noise_of_electrons(
    law: _NoiseData,
    base: Sensor,
    amplitude_e: _Float,
    intensity_e: _Float | None,
    scale_error: float,
    estimates: dict[str, FittedField],
    notes: list[str],
) -> dict[str, Any]:
    """Turn amplitudes, and intensities if there are any, in electrons into signal, contrast and noise.

    `scale_error` is the relative error of the electron itself; the contrast, a ratio, does not know it.
    """
    boards = len(amplitude_e)
    # wiggling and stray light scale A/S from board to board, patterns from pixel to pixel
    modulated, modulated_error = _mean_of_boards(amplitude_e / law.light, law.light_std)
    variance_e2 = 2 * law.phase_variance * amplitude_e**2  # N₀S + N_amb + N_dark + V
    light = intensity_e if intensity_e is not None else variance_e2
    what = "intensity" if intensity_e is not None else "noise · amplitude²"
    constant = base.ambient_e + base.dark_e + (0.0 if intensity_e is not None else base.read_variance_e2)
    changes: dict[str, Any] = {}
    if law.levels_differ:
        if intensity_e is not None:
            (signal, offset), covariance = _line_over_boards(law, intensity_e)
        else:
            (signal, offset), covariance = law.two_terms(variance_e2, law.light, np.ones_like(law.light))
        signal_error, offset_error = np.sqrt(np.diag(covariance))
        ambient = offset - (constant - base.ambient_e)
        note = f"{what} without light, less the assumed dark current"
        estimates["ambient_e"] = FittedField(
            float(ambient),
            math.hypot(offset_error, scale_error * offset),
            note if intensity_e is not None else f"{note} and read noise",
        )
        changes["ambient_e"] = float(ambient)
    else:
        mean, mean_error = _mean_of_boards(light / law.light, law.light_std) if intensity_e is not None else (
            (float(((variance_e2 - constant) / law.light).mean()), law.one_term(variance_e2 / law.light)[1])
        )  # fmt: skip
        signal = mean - (constant / float(law.light.mean()) if intensity_e is not None else 0.0)
        signal_error = mean_error
        notes.append(
            "Signal and ambient light cannot be told apart from one level of light: ambient light is the assumed one. "
            f"That takes distances or albedos whose light differs by {_NOISE_LEVELS_RATIO:g} times and more."
        )
    if signal <= 2 * signal_error:
        raise UsageError(
            f"the frames do not show the signal: {what} rises by {with_error(signal, signal_error)} electrons a "
            "unit of light; are amplitude and intensity in electrons (amplitude_unit=…)?"
        )
    contrast = modulated / signal
    contrast_error = contrast * math.hypot(modulated_error / modulated, signal_error / signal)
    estimates["signal_e"] = FittedField(
        float(signal),
        math.hypot(signal_error, scale_error * signal),
        f"{what} against light at {boards} distance{'s' if boards > 1 else ''}",
    )
    estimates["contrast"] = FittedField(
        float(contrast), float(contrast_error), f"amplitude, {modulated:.5g} electrons at |S| = 1, over signal_e"
    )
    changes |= {"signal_e": float(signal), "contrast": float(contrast)}
    if intensity_e is not None:
        extra, extra_error = _excess(variance_e2, intensity_e, law, scale_error)
        per_tap = (extra - base.code_e**2 / 6) / 2
        read_noise = math.sqrt(max(per_tap, 0.0))
        error = min(extra_error / (4 * read_noise) if read_noise > 0 else math.inf, math.sqrt(extra_error / 2))
        estimates["read_noise_e"] = FittedField(
            read_noise, error, "noise over that of the electrons counted" + ("" if per_tap > 0 else "; none was seen")
        )
        changes["read_noise_e"] = read_noise
    else:
        estimates["read_noise_e"] = FittedField(
            base.read_noise_e, None, "without intensities it looks like ambient light"
        )
    return changes


def _mean_of_boards(values: _Float, light_std: _Float) -> tuple[float, float]:
    """Return the mean over boards and pixels, and its standard error from their spread, boards as a whole included.

    What the distances let boards spread, `light_std` of the mean, is left out: it is added to every number later.
    """
    own = values.std(ddof=1) / math.sqrt(values.size) if values.size > 1 else 0.0
    boards = values.mean(axis=1)
    between = 0.0
    if len(boards) > 1:
        excess = float(boards.var(ddof=1)) - float(((light_std * boards.mean()) ** 2).mean())
        between = math.sqrt(max(excess, 0.0) / len(boards))
    return float(values.mean()), float(max(own, between))


def _line_over_boards(law: _NoiseData, intensity_e: _Float) -> tuple[_Float, _Float]:
    """Fit I = N₀S + B to every pixel by least squares of relative errors; return the means and their covariance.

    It follows from the scatter of the pixels, whose sensitivities and dark signals differ, and of whole boards, less
    what the distances let boards scatter: that is added to every number later.
    """
    light = law.light
    y = intensity_e.mean(axis=1)
    lines = []
    for x, values in zip(light.T, intensity_e.T, strict=True):
        design = np.column_stack([x, np.ones_like(x)]) / y[:, None]
        solution, covariance = _solve(design, values / y)
        lines.append(solution)
    solutions = np.array(lines)
    mean = solutions.mean(axis=0)
    own = np.atleast_2d(np.cov(solutions.T)) / len(solutions) if len(solutions) > 1 else np.zeros((2, 2))
    if len(y) > 2:
        residual = (light.mean(axis=1) * mean[0] + mean[1]) / y - 1
        expected = law.light_std * light.mean(axis=1) * mean[0] / y
        excess = float((residual**2).sum()) / (len(y) - 2) - float((expected**2).mean())
        own = own + covariance * max(excess, 0.0)
    return mean, own


def _excess(variance_e2: _Float, intensity_e: _Float, law: _NoiseData, scale_error: float) -> tuple[float, float]:
    """Return the mean of 2σ_φ²A² − I, each value weighted by what chance leaves of it, and its standard error."""
    weight = law.degrees / (2 * np.maximum(intensity_e, 1.0) ** 2)
    total = float(weight.sum())
    mean = float((weight * (variance_e2 - intensity_e)).sum()) / total
    # the noise itself has more variance than its electrons alone
    expected = np.maximum(intensity_e + max(mean, 0.0), 1.0)
    chance = math.sqrt(float((weight**2 * 2 * expected**2 / law.degrees).sum())) / total
    # a wrong electron scales the noise by its square and the intensity by itself
    lever = float((weight * (2 * variance_e2 - intensity_e)).sum()) / total
    return mean, math.hypot(chance, scale_error * lever)


def _possible_contrast(fields: dict[str, Any], estimates: dict[str, FittedField], notes: list[str]) -> float:
    """Return the contrast, at most what lets no tap count less than nothing."""
    harmonics = tuple(Harmonic(*entry) for entry in fields["harmonics"])
    peak = correlation_peak(harmonics) if fields["modulation"] == "harmonics" else 1.0
    limit = min(1.0, 1 / peak)
    contrast = float(fields["contrast"])
    if contrast > limit:
        notes.append(
            f"The contrast came out as {contrast:.4g}, more than taps can have: {limit:.4g} was taken. Are albedo and "
            "the unit of the amplitudes right?"
        )
        estimate = estimates["contrast"]
        estimates["contrast"] = FittedField(
            limit, estimate.std_error, f"{estimate.note}; lowered to the most there can be"
        )
        return limit
    return contrast
