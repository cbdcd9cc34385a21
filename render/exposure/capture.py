"""From light to frames: two taps, four phase images, and the errors of each (PHYSICS section 4).

The chain is a row of functions in the order in which the camera does things::

    spread_light          stray light, on intensity and every S_k           stray_light.py
    tap_means             offsets, harmonics, contrast, ambient light       taps.py, camera_unit.py
    collect               PRNU, dark current, DSNU, dead and hot pixels     taps.py, camera_unit.py
    draw_arrived          Poisson                                           photoelectrons.py
    fill_well             clip at full well, flagged                        photoelectrons.py
    add_read_noise        Gaussian                                          photoelectrons.py
    convert, decode       gain, black level, round, clip; nominal inverse   photoelectrons.py
    demodulate            phasor and intensity of the four phase images     taps.py
    validity_flags        why a pixel is not valid                          here

This is repeated at every modulation frequency of the camera; unwrapped_frames.py then makes one range of several.
:func:`capture` runs it over as many frames as are wanted. Arrays of taps are (..., 4, 2, rows, cols): phase images
τ = 0, π/2, π, 3π/2, then taps a and b.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.background import Background
from phasemark.render.exposure.direct_sensor import capture_direct
from phasemark.render.exposure.motion import Motion, render_moving
from phasemark.render.exposure.photoelectrons import ReadOut, read_taps
from phasemark.render.exposure.random_streams import draw_key
from phasemark.render.exposure.stray_light import spread_light
from phasemark.render.exposure.taps import N_PHASES, N_TAPS, collect, demodulate, tap_means
from phasemark.render.frames import Flag, Frames
from phasemark.render.phasor_images import PhasorImages, phasor_to_range_m
from phasemark.render.renderer import Renderer
from phasemark.render.sensor.camera_unit import CameraUnit, camera_unit
from phasemark.render.sensor.range_noise import phase_image_variance
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.threads import mapped
from phasemark.render.unwrapped_frames import unwrap_frames
from phasemark.render.view import Views

# float32 files may round |S_1| just above the intensity; anything more is not an image.
_ROUNDING = 1e-6

# Above this a float64 can no longer count electrons one by one.
_MOST_ELECTRONS = 2.0**53

# The words of the random streams' counters.
_MOST_FRAMES = 2**32

# Taps held at once: small enough for the caches, large enough to hide the cost of a NumPy call.
_TAPS_PER_BLOCK = 2**17

# Blocks that a thread takes one after the other: what they share is computed and allocated once.
_BLOCKS_PER_RUN = 8


def capture(
    image: PhasorImages | Sequence[PhasorImages],
    sensor: Sensor,
    *,
    rng: np.random.Generator,
    n_frames: int = 1,
    first_view: int = 0,
    first_frame: int = 0,
    keep_taps: bool = False,
    workers: int = 1,
) -> Frames:
    """Take noisy frames of noise-free images.

    Parameters
    ----------
    image : PhasorImages, or four of them
        n views; or what a moving camera sees during each phase image (4 m of m modulation frequencies), from
        :func:`~phasemark.render.exposure.render_moving`.
    sensor : Sensor
        The camera; it may differ from the one the image was rendered for in electrons, noise and validity, not in
        geometry or modulation.
    rng : numpy.random.Generator
        Source of all noise. It is advanced by the same amount whatever is captured, and each noise term draws from
        its own stream, so that switching one term off leaves the others' noise as it was.
    n_frames : int
        Frames of each view, with independent noise.
    first_view, first_frame : int
        Numbers of the first view and frame in a longer run. A sample's noise depends on `rng`'s state and on the
        numbers of view, frame and pixel alone, so a run captured piece by piece, each from a generator in the same
        state, has the same bytes as a run captured at once.
    keep_taps : bool
        Whether to keep what each tap reported, as ``frames.taps_e``.
    workers : int
        Threads; the result does not depend on their number.

    Returns
    -------
    Frames
        (n, n_frames, rows, cols). An invalid pixel has range NaN, and its flags say why. Several modulation frequencies
        are captured one after the other, each with its own noise, and unwrapped
        (`unwrap_frames`); ``frames.by_frequency`` has each alone. A direct sensor gives neither
        amplitude nor intensity; its own quantity is ``frames.z_m``.

    Raises
    ------
    UsageError
        A number is out of range; the image was rendered for other optics or lacks a harmonic the sensor needs; it is
        not finite, or its phasor is larger than its intensity allows; taps or motion are asked of a direct sensor.
    """
    images = (image,) if isinstance(image, PhasorImages) else tuple(image)
    _check_numbers(n_frames, first_view, first_frame, workers, images, sensor)
    for one in images:
        if difference := sensor.optics_difference(one.sensor):
            raise UsageError(f"the image was rendered for another camera: {difference}")
    if sensor.kind == "direct":
        if keep_taps or len(images) > 1:
            what = "'keep_taps'" if keep_taps else "motion during phase images"
            raise UsageError(f"{what} must be left out for a direct sensor: it has neither taps nor phase images")
        _check_image(images[0], sensor)
        return capture_direct(images[0], sensor, rng, n_frames, first_view, first_frame)

    key = draw_key(rng)
    parts = []
    for j, camera in enumerate(sensor.by_frequency):
        own = images if len(images) == 1 else images[N_PHASES * j : N_PHASES * (j + 1)]
        seen = tuple(one.by_frequency[j] for one in own)
        for one in seen:
            _check_image(one, camera)
        counters = _Counters(key, first_view, first_frame, N_PHASES * j)
        parts.append(_capture_frequency(seen, camera, camera_unit(sensor, j), counters, n_frames, keep_taps, workers))
    if len(parts) == 1:
        return parts[0]
    taps_e = None
    if keep_taps:
        taps_e = np.concatenate([part.taps_e for part in parts if part.taps_e is not None], axis=2)
        for part in parts:
            part.taps_e = None
    return unwrap_frames(parts, sensor, taps_e=taps_e)


class _Counters(NamedTuple):
    """Place of frames in the random streams: key, and numbers of first view, frame and phase image."""

    key: NDArray[np.uint64]
    first_view: int
    first_frame: int
    first_phase: int


def _capture_frequency(
    images: Sequence[PhasorImages],
    sensor: Sensor,
    unit: CameraUnit,
    counters: _Counters,
    n_frames: int,
    keep_taps: bool,
    workers: int,
) -> Frames:
    """Take the frames of one modulation frequency; see :func:`capture`."""
    n_views = len(images[0])
    shape = (n_views * n_frames, sensor.rows, sensor.cols)
    range_m, amplitude_e, intensity_e = np.empty(shape), np.empty(shape), np.empty(shape)
    flags = np.empty(shape, dtype=np.uint8)
    kept = np.empty((shape[0], N_PHASES, N_TAPS, *shape[1:])) if keep_taps else None
    read_out = ReadOut.of(sensor)
    per_block = max(1, _TAPS_PER_BLOCK // (N_PHASES * N_TAPS * sensor.rows * sensor.cols))

    def take(run: slice) -> None:
        first = run.start // n_frames
        means, lit = _expected_taps(images, slice(first, (run.stop - 1) // n_frames + 1), sensor, unit)
        room = np.empty((min(per_block, run.stop - run.start), N_PHASES, N_TAPS, *shape[1:]))
        full = np.empty((len(room), *shape[1:]), np.bool_)
        for block in _cuts(run, per_block):
            n = block.stop - block.start
            taps, saturated = room[:n] if kept is None else kept[block], full[:n]
            read_taps(
                means.reshape(*means.shape[:3], -1)[block.start // n_frames - first :], block.start, block.stop,
                n_frames, counters.first_view, counters.first_frame, counters.first_phase, counters.key, read_out,
                taps.reshape(*taps.shape[:3], -1),
                saturated.reshape(n, -1),
            )  # fmt: skip
            phasor_e, intensity_e[block] = demodulate(taps)
            range_m[block] = phasor_to_range_m(phasor_e, sensor)
            np.abs(phasor_e, out=amplitude_e[block])
            of_frame = np.arange(block.start, block.stop) // n_frames - first
            flags[block] = validity_flags(
                range_m[block], amplitude_e[block], intensity_e[block], lit[of_frame], saturated, unit, sensor
            )

    runs = list(_cuts(slice(0, shape[0]), _BLOCKS_PER_RUN * per_block))
    mapped(take, runs, workers)
    full = (n_views, n_frames, sensor.rows, sensor.cols)
    return Frames.as_measured(
        range_m.reshape(full),
        amplitude_e.reshape(full),
        intensity_e.reshape(full),
        flags.reshape(full),
        sensor,
        taps_e=None if kept is None else kept.reshape(*full[:2], N_PHASES, N_TAPS, *full[2:]),
    )


def capture_moving(
    renderer: Renderer,
    views: Views,
    sensor: Sensor,
    motion: Motion,
    *,
    rng: np.random.Generator,
    n_frames: int = 1,
    background: Background | None = None,
    keep_taps: bool = False,
    workers: int = 1,
) -> Frames:
    """Take noisy frames while the camera moves: every phase image sees a view of its own, about mid-frame.

    Parameters
    ----------
    renderer : Renderer
        Landmark and camera.
    views : Views
        The views at mid-frame: the truth of every frame.
    sensor : Sensor
        The camera, with the renderer's optics and timing.
    motion : Motion
        Movement of the camera during a frame.
    rng, n_frames, keep_taps, workers
        As in :func:`capture`; each of the frames starts from the same views.
    background : Background, optional
        As seen at mid-frame; see :func:`~phasemark.render.exposure.render_moving`.

    Returns
    -------
    Frames
        (n, n_frames, rows, cols).

    Raises
    ------
    UsageError
        As :func:`capture` and :func:`~phasemark.render.exposure.render_moving`; or sensor and renderer time phase
        images differently.
    """
    if renderer.sensor.phase_image_interval_s != sensor.phase_image_interval_s:
        raise UsageError(
            f"the sensor takes a phase image every {sensor.phase_image_interval_s:g} s, but the renderer's every "
            f"{renderer.sensor.phase_image_interval_s:g} s"
        )
    images = render_moving(renderer, views, motion, background=background, workers=workers)
    return capture(images, sensor, rng=rng, n_frames=n_frames, keep_taps=keep_taps, workers=workers)


def _expected_taps(
    images: Sequence[PhasorImages], views: slice, sensor: Sensor, unit: CameraUnit
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the mean electrons of all taps of some views, and where modulated light arrives at all."""
    per_image, lit = [], []
    for image in images:
        phasors: Mapping[int, NDArray[np.complex128]] = {
            k: spread_light(image.harmonic(k)[views], sensor) for k in (1, *sensor.harmonic_orders)
        }
        per_image.append(tap_means(phasors, spread_light(image.intensity[views], sensor), sensor, unit.delay_rad))
        lit.append(np.not_equal(phasors[1], 0))
    if len(images) == 1:
        means = per_image[0]
    else:  # phase image i of what is seen at its time
        means = np.stack([image_means[:, i] for i, image_means in enumerate(per_image)], axis=1)
    return collect(_not_negative(means, views.start), unit), np.logical_and.reduce(lit)


def _not_negative(means: NDArray[np.float64], first_view: int) -> NDArray[np.float64]:
    """Refuse taps that count less than nothing; full contrast leaves a tap empty, which rounding makes −1e-12."""
    negative = (means < -_ROUNDING * np.abs(means).max(axis=(1, 2), keepdims=True)).any(axis=(1, 2))
    if negative.any():
        view, row, col = np.argwhere(negative)[0]
        raise UsageError(
            f"view {first_view + view}, row {row}, column {col}: a tap's mean is negative, for its phasor is larger "
            "than its intensity allows at this contrast"
        )
    return np.maximum(means, 0.0)


def validity_flags(
    range_m: NDArray[np.float64],
    amplitude_e: NDArray[np.float64],
    intensity_e: NDArray[np.float64],
    lit: NDArray[np.bool_],
    saturated: NDArray[np.bool_],
    unit: CameraUnit,
    sensor: Sensor,
) -> NDArray[np.uint8]:
    """Flag the pixels whose range one frame cannot tell, and say why.

    A pixel returns light when amplitude_e > 0, amplitude_e ≥ `min_amplitude_e` and, if the sensor sets
    `max_phase_std_rad`, the noise law at the measured amplitude and intensity predicts no more:
    amplitude_e ≥ √(variance under its root) / (√2 · max_phase_std_rad). A pixel that is dead, hot or saturated says
    nothing, neither range nor *no return*.

    Parameters
    ----------
    range_m, amplitude_e, intensity_e : (..., rows, cols)
        As measured.
    lit : (..., rows, cols) bool
        False where no modulated light returns (S = 0): there is no range to measure, whatever the noise says.
    saturated : (..., rows, cols) bool
        Whether a tap reached its full well or the highest code.
    unit : CameraUnit
        Which pixels are dead or hot.
    sensor : Sensor

    Returns
    -------
    ndarray of uint8
        :class:`Flag` of each pixel, 0 where it is valid.
    """
    shape = np.shape(range_m)
    flags = np.empty(shape, np.uint8)
    noise_e2 = phase_image_variance(intensity_e, sensor)
    broken = unit.dead * int(Flag.DEAD) + unit.hot * int(Flag.HOT)
    _flag(
        range_m.reshape(-1, broken.size), amplitude_e.reshape(-1, broken.size), noise_e2.reshape(-1, broken.size),
        lit.reshape(-1, broken.size), saturated.reshape(-1, broken.size), broken.ravel().astype(np.uint8),
        (sensor.min_amplitude_e, np.inf if sensor.max_phase_std_rad is None else sensor.max_phase_std_rad),
        (sensor.wrap_guard_m, sensor.unambiguous_range_m), flags.reshape(-1, broken.size),
    )  # fmt: skip
    return flags


_NO_RETURN, _NEAR_WRAP = np.uint8(Flag.NO_RETURN), np.uint8(Flag.NEAR_WRAP | Flag.MISSING)
_MISSING, _SATURATED = np.uint8(Flag.MISSING), np.uint8(Flag.SATURATED)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _flag(range_m, amplitude_e, noise_e2, lit, saturated, broken, least, wrap, flags):  # type: ignore[no-untyped-def]
    """Fill the flags of (n, pixels); `least` is the amplitude and the phase noise allowed, `wrap` guard and period."""
    least_e, most_rad = least
    guard_m, period_m = wrap
    for i in range(len(flags)):
        for pixel in range(flags.shape[1]):
            amplitude = amplitude_e[i, pixel]
            returned = lit[i, pixel] and amplitude > 0.0 and amplitude >= least_e
            if most_rad < math.inf:
                returned = returned and amplitude * most_rad >= math.sqrt(0.5 * noise_e2[i, pixel])
            flag = np.uint8(0) if returned else _NO_RETURN
            if guard_m > 0.0 and returned and min(range_m[i, pixel], period_m - range_m[i, pixel]) < guard_m:
                flag = _NEAR_WRAP
            wrong = broken[pixel] | _SATURATED if saturated[i, pixel] else broken[pixel]
            flags[i, pixel] = wrong | _MISSING if wrong > 0 else flag


def _check_numbers(
    n_frames: int, first_view: int, first_frame: int, workers: int, images: Sequence[PhasorImages], sensor: Sensor
) -> None:
    for name, value, least in (
        ("n_frames", n_frames, 1),
        ("first_view", first_view, 0),
        ("first_frame", first_frame, 0),
        ("workers", workers, 1),
    ):
        if not isinstance(value, int | np.integer) or value < least:
            raise UsageError(f"'{name}' must be a whole number of at least {least}, got {value!r}")
    if len(images) not in (1, sensor.n_phase_images) or len({len(one) for one in images}) > 1:
        raise UsageError(
            f"'image' must be one set of images, or {sensor.n_phase_images} of equal length, one for each phase image, "
            f"got {[len(one) for one in images]} views"
        )
    if max(first_frame + n_frames, first_view + len(images[0])) > _MOST_FRAMES:
        raise UsageError("a run has at most 2^32 views, and 2^32 frames of each")


def _cuts(frames: slice, most: int) -> Iterator[slice]:
    """Cut a range of frames; a frame's noise depends on its number alone, so the cuts leave no trace."""
    for start in range(frames.start, frames.stop, most):
        yield slice(start, min(start + most, frames.stop))


def _check_image(image: PhasorImages, sensor: Sensor) -> None:
    """Refuse an image that no light can make, naming the first pixel that shows it."""
    finite = np.isfinite(image.intensity)
    for order in (1, *sensor.harmonic_orders):
        if order > 1 and order not in image.harmonics:
            raise UsageError(
                f"the image lacks harmonic {order}, which the sensor's correlation needs: render it with a Renderer "
                "for this sensor, or with harmonics=sensor.harmonic_orders"
            )
        finite &= np.isfinite(image.harmonic(order))
    if not finite.all():
        raise UsageError(f"{_where(~finite)}: phasor and intensity must be finite")
    brightest = sensor.signal_e * image.intensity.max(initial=0.0) + sensor.ambient_e + sensor.dark_e
    if brightest > _MOST_ELECTRONS:
        raise UsageError(
            f"a phase image would count {brightest:.3g} electrons, which is more than 2^53: lower 'signal_e'"
        )


def _where(mask: NDArray[np.bool_]) -> str:
    view, row, col = np.argwhere(mask)[0]
    return f"view {view}, row {row}, column {col}"
