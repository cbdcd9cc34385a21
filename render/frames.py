"""Measured or simulated frames: range, amplitude, intensity and why a pixel is not valid."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import IntFlag
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.inputs.numbers import real_array
from phasemark.render.png import figure_png
from phasemark.render.sensor.sensor import Sensor, refuse_no_sensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_TILT_DEG = 45.0
"""No frame or pose is tilted by more: a larger number is in another unit, or of another angle."""


class Flag(IntFlag):
    """Reasons why a pixel's range is not valid; 0 where it is valid."""

    NO_RETURN = 1
    """The amplitude is below the validity threshold: nothing came back. This is data."""
    MISSING = 2
    """The pixel says nothing: dead, saturated, or invalid of unknown cause."""
    SATURATED = 4
    """A tap reached its full well or the top of the converter; also MISSING."""
    DEAD = 8
    """The pixel is known to be dead; also MISSING."""
    HOT = 16
    """The pixel is known to be hot; also MISSING."""
    NEAR_WRAP = 32
    """The range may be on the wrong side of the wrap at 0 and c / 2f; also MISSING."""
    INCONSISTENT = 64
    """The modulation frequencies agree on no range: a mixed pixel, or one that returns at some alone; also MISSING."""


_MOST_FLAGS = int(sum(Flag))
_Scalar = TypeVar("_Scalar", bound=np.generic)


class Frames:
    """Frames of a camera at rest: n positions, several frames each.

    Parameters
    ----------
    range_m : array_like, (n, frames, rows, cols), (frames, rows, cols) or (rows, cols)
        Range along the ray, metres; NaN where the camera gave none. Of several modulation frequencies it is unwrapped.
    amplitude_e, intensity_e : array_like, optional
        Measured amplitude and intensity, electrons per phase image, in the shape of `range_m`; of several frequencies
        those at the first.
    valid : array_like of bool, optional
        False where the range must not be used; what is NaN, negative or masked (`numpy.ma`) is invalid in any case.
    flags : array_like of int, optional
        :class:`Flag` of every pixel. Without it an invalid pixel gets the flag that `invalid_means` names.
    sensor : Sensor
        The camera that took the frames.
    taps_e : array_like, optional
        What each tap reported in each phase image, electrons; in the shape of `range_m` with (4, 2) before the rows,
        (4 m, 2) for m modulation frequencies.
    invalid_means : {"missing", "no-return"}
        What an invalid pixel without flags stands for. Unknown cause is "missing".
    time_s : array_like, optional
        Time stamp of each frame in the recorder's clock, seconds; `range_m` without its rows and columns gives the
        shape. Real stamps may repeat or run backwards.
    tilt_rad : array_like, optional
        Pitch and roll of what the camera is mounted on (PHYSICS section 9), as an IMU tells them: the shape of `time_s`
        with an axis of 2 behind it.
    by_frequency : sequence of Frames, optional
        What each of several modulation frequencies measured alone: frames of ``sensor.by_frequency``, with the range
        wrapped at c / 2f of each. :func:`~phasemark.render.unwrapped_frames.unwrap_frames` makes frames from these.

    Raises
    ------
    UsageError
        The shapes do not agree with each other or with the sensor, numbers are complex, a valid pixel's amplitude or
        intensity cannot be, a flag is no :class:`Flag`, a time stamp is not finite, or a tilt is beyond ± 45°.
    """

    figure: ClassVar[Callable[..., Figure]]
    """Function that draws it; the package sets it, because drawing imports matplotlib, which takes half a second."""

    def __repr__(self) -> str:
        """Describe in one line how many frames there are, and the camera."""
        return f"Frames({len(self)} positions × {self.n_frames} frames, {self.sensor!r})"

    def __init__(
        self,
        range_m: ArrayLike,
        amplitude_e: ArrayLike | None = None,
        intensity_e: ArrayLike | None = None,
        valid: ArrayLike | None = None,
        *,
        sensor: Sensor,
        flags: ArrayLike | None = None,
        taps_e: ArrayLike | None = None,
        invalid_means: Literal["missing", "no-return"] = "missing",
        time_s: ArrayLike | None = None,
        tilt_rad: ArrayLike | None = None,
        by_frequency: Sequence[Frames] = (),
    ) -> None:
        refuse_no_sensor(sensor)
        refuse_other_meaning(invalid_means)
        ranges = real_array("range_m", np.ma.getdata(range_m))
        if ranges.ndim not in (2, 3, 4):
            raise UsageError(f"'range_m' must have shape (n, frames, rows, cols), got {ranges.shape}")
        of_frames, shape = ranges.shape[:-2], (1,) * (4 - ranges.ndim) + ranges.shape
        if shape[2:] != (sensor.rows, sensor.cols):
            raise UsageError(
                f"the frames have {shape[2]} × {shape[3]} pixels, but the sensor has {sensor.rows} × {sensor.cols}"
            )

        def like_range(name: str, array: NDArray[_Scalar]) -> NDArray[_Scalar]:
            if array.shape != ranges.shape:
                raise UsageError(f"'{name}' has shape {array.shape}, but 'range_m' has {ranges.shape}")
            return array.reshape(shape)

        amplitude, intensity = (
            None if value is None else like_range(name, real_array(name, np.ma.getdata(value)))
            for name, value in (("amplitude_e", amplitude_e), ("intensity_e", intensity_e))
        )
        usable = (np.isfinite(ranges) & (ranges >= 0)).reshape(shape)
        if valid is not None:
            usable &= like_range("valid", np.array(np.ma.getdata(valid), dtype=np.bool_))
        for masked in (range_m, amplitude_e, intensity_e, valid):
            if np.ma.is_masked(masked):
                usable &= ~np.ma.getmaskarray(np.ma.asarray(masked)).reshape(shape)
        if flags is None:
            kind = Flag.NO_RETURN if invalid_means == "no-return" else Flag.MISSING
            codes = np.where(usable, 0, int(kind)).astype(np.uint8)
        else:
            codes = like_range("flags", _checked_flags(flags))
            codes[~usable & (codes == 0)] |= int(Flag.MISSING)
            usable &= codes == 0
        for name, measured, least in (("amplitude_e", amplitude, 0.0), ("intensity_e", intensity, -np.inf)):
            if measured is None:
                continue
            wrong = usable & ~(np.isfinite(measured) & (measured >= least))
            if wrong.any():
                position, frame, row, col = np.argwhere(wrong)[0]
                raise UsageError(
                    f"'{name}' must be finite{' and not negative' if least == 0 else ''} where the range is valid, got "
                    f"{measured[position, frame, row, col]} at position {position}, frame {frame}, row {row}, col {col}"
                )
        if amplitude is not None:  # without amplitude there is no phase (PHYSICS section 4)
            codes[usable & (amplitude == 0)] |= int(Flag.NO_RETURN)
            usable &= codes == 0
        ranges = ranges.reshape(shape)
        ranges[~usable] = np.nan
        self.range_m: NDArray[np.float64] = ranges
        self.amplitude_e = amplitude
        self.intensity_e = intensity
        self.flags: NDArray[np.uint8] = codes
        self.taps_e: NDArray[np.float64] | None = None
        if taps_e is not None:
            taps_per_phase_image = 2
            of_pixel = (sensor.n_phase_images, taps_per_phase_image)
            taps = _shaped("taps_e", taps_e, (*of_frames, *of_pixel, *shape[2:]))
            self.taps_e = taps.reshape(*shape[:2], *of_pixel, *shape[2:])
        self.time_s: NDArray[np.float64] | None = None
        """Time stamps, (n, frames) seconds, or None."""
        if time_s is not None:
            times = _shaped("time_s", time_s, of_frames)
            if not np.isfinite(times).all():
                k = int(np.flatnonzero(~np.isfinite(times.ravel()))[0])
                raise UsageError(f"'time_s' must be finite, got {times.ravel()[k]} at frame {k}")
            self.time_s = times.reshape(shape[:2])
        self.tilt_rad: NDArray[np.float64] | None = None
        """Pitch and roll, (n, frames, 2) radians, or None."""
        if tilt_rad is not None:
            tilts = _shaped("tilt_rad", tilt_rad, (*of_frames, 2))
            wrong = ~(np.abs(tilts) <= math.radians(MOST_TILT_DEG))
            if wrong.any():
                k = int(np.flatnonzero(wrong.reshape(-1, 2).any(axis=1))[0])
                pitch, roll = tilts.reshape(-1, 2)[k]
                raise UsageError(
                    f"'tilt_rad' must be within ± {math.radians(MOST_TILT_DEG):.3g} (± {MOST_TILT_DEG:g}°), got pitch"
                    f" {pitch:g} and roll {roll:g} at frame {k}"
                )
            self.tilt_rad = tilts.reshape(*shape[:2], 2)
        self.sensor = sensor
        self._by_frequency = _checked_parts(by_frequency, shape, sensor)

    @classmethod
    def as_measured(
        cls,
        range_m: NDArray[np.float64],
        amplitude_e: NDArray[np.float64],
        intensity_e: NDArray[np.float64],
        flags: NDArray[np.uint8],
        sensor: Sensor,
        *,
        taps_e: NDArray[np.float64] | None = None,
    ) -> Self:
        """Return frames that hold the arrays of a camera model themselves: nothing is copied, and nothing checked.

        The parameters are those of the constructor, (n, frames, rows, cols), finite, with a flag wherever amplitude_e
        is zero. Only `range_m` is changed: a flagged pixel has none.
        """
        frames = cls.__new__(cls)
        range_m[flags != 0] = np.nan
        frames.range_m, frames.amplitude_e, frames.intensity_e, frames.flags = range_m, amplitude_e, intensity_e, flags
        frames.taps_e, frames.time_s, frames.tilt_rad, frames.sensor = taps_e, None, None, sensor
        frames._by_frequency = ()
        return frames

    @property
    def by_frequency(self) -> tuple[Frames, ...]:
        """What each modulation frequency measured alone, its range wrapped at c / 2f; of one frequency the frames.

        Empty where several frequencies were unwrapped elsewhere, and their own ranges are not known.
        """
        return (self,) if len(self.sensor.frequencies_hz) == 1 else self._by_frequency

    def __len__(self) -> int:
        return len(self.range_m)

    def __getitem__(self, index: slice | NDArray[np.integer]) -> Self:
        """Return some of the positions."""
        return self._rearranged(lambda values: values[index])

    def each_a_position(self) -> Self:
        """Return the frames of a moving camera: every frame a position of its own, (n · frames, 1, rows, cols)."""
        return self._rearranged(lambda values: values.reshape(-1, 1, *values.shape[2:]))

    def as_one_position(self) -> Self:
        """Return positions of one frame each as the frames of one position, (1, n, rows, cols)."""
        return self._rearranged(lambda values: values.reshape(1, -1, *values.shape[2:]))

    def some_frames(self, start: int, stop: int) -> Self:
        """Return frames `start` to `stop` of every position, without taps and stamps."""
        return self._rearranged(lambda values: values[:, start:stop], ranges_alone=True)

    def taken_by(self, sensor: Sensor) -> Self:
        """Return the same ranges, amplitudes and flags as frames of another camera, without taps and stamps.

        Parameters
        ----------
        sensor : Sensor
            With as many pixels and the same modulation frequencies.
        """
        return self._rearranged(lambda values: values, sensor, ranges_alone=True)

    def _rearranged(
        self,
        change: Callable[[NDArray[Any]], NDArray[Any]],
        sensor: Sensor | None = None,
        *,
        ranges_alone: bool = False,
    ) -> Self:
        """Return frames with `change` made to each array, (n, frames, ...); without taps and stamps if asked for."""
        names = ("amplitude_e", "intensity_e", "flags", "tilt_rad", *(() if ranges_alone else ("taps_e", "time_s")))
        held = {name: getattr(self, name) for name in names}
        arrays: dict[str, Any] = {name: change(values) for name, values in held.items() if values is not None}
        cameras = [part.sensor for part in self._by_frequency] if sensor is None else sensor.by_frequency
        by_frequency = [
            part._rearranged(change, camera, ranges_alone=ranges_alone)
            for part, camera in zip(self._by_frequency, cameras, strict=False)
        ]
        return type(self)(change(self.range_m), sensor=sensor or self.sensor, by_frequency=by_frequency, **arrays)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True where the range may be used, (n, frames, rows, cols)."""
        return np.equal(self.flags, 0)

    @property
    def z_m(self) -> NDArray[np.float64]:
        """Distance along the optical axis, range · cosine of the ray of the pixel's centre; (n, frames, rows, cols)."""
        return self.range_m * self.sensor.axis_cosine()

    @property
    def n_frames(self) -> int:
        """Frames at each position."""
        return int(self.range_m.shape[1])

    def plot(self, index: int = 0, frame: int = 0, *, coverage: NDArray[np.float64] | None = None) -> Figure:
        """Draw range, amplitude and flags of one frame for a first look.

        The colours of the range span the landmark: the pixels that `coverage` (rows, cols) has at least half on it, or
        without it the nearest surface and what lies up to 0.4 m behind.
        """
        return type(self).figure(self, index, frame, coverage)

    def _repr_png_(self) -> bytes | None:
        """Show the first frame in a notebook; nothing where there is none."""
        return figure_png(self.plot()) if self.range_m.size else None


def _shaped(name: str, value: ArrayLike, expected: tuple[int, ...]) -> NDArray[np.float64]:
    """Return numbers that must have a shape, as an array of their own."""
    array = real_array(name, value)
    if array.shape != expected:
        raise UsageError(f"'{name}' has shape {array.shape}, but must have {expected}")
    return array


def refuse_other_meaning(invalid_means: str) -> None:
    """Refuse what an invalid pixel cannot stand for.

    Raises
    ------
    UsageError
        It is neither "missing" nor "no-return".
    """
    if invalid_means not in ("missing", "no-return"):
        raise UsageError(f"'invalid_means' must be 'missing' or 'no-return', got {invalid_means!r}")


def _checked_flags(flags: ArrayLike) -> NDArray[np.uint8]:
    """Return flags as an array of their own; refuse what no sum of :class:`Flag` is."""
    given = np.asarray(flags)
    codes = given.astype(np.uint8)
    wrong = given[(codes != given) | (codes > _MOST_FLAGS)]
    if wrong.size:
        raise UsageError(f"'flags' must be sums of Flag, whole numbers from 0 to {_MOST_FLAGS}, got {wrong.flat[0]}")
    return codes


def _checked_parts(parts: Sequence[Frames], shape: tuple[int, ...], sensor: Sensor) -> tuple[Frames, ...]:
    """Refuse frames of single frequencies that are not those of a camera of several."""
    if not parts:
        return ()
    m = len(sensor.frequencies_hz)
    if m == 1 or len(parts) != m:
        raise UsageError(f"'by_frequency' must have frames of each of several frequencies, got {len(parts)} for {m}")
    for camera, part in zip(sensor.by_frequency, parts, strict=True):
        if part.sensor.modulation_hz != camera.modulation_hz:
            raise UsageError(
                f"'by_frequency' must follow the order of 'modulation_hz', got frames of {part.sensor.modulation_hz}"
                f" Hz for {camera.modulation_hz} Hz"
            )
        if part.range_m.shape != shape:
            raise UsageError(f"'by_frequency' has frames of shape {part.range_m.shape}, but 'range_m' has {shape}")
    return tuple(parts)
