"""From light to frames: two taps, four phase images, and the noise of each (PHYSICS section 4).

The chain is a row of pure functions in the order in which the camera does things::

    tap_means → add_dark → add_shot_noise → add_read_noise → demodulate → validity_flags

:func:`capture` runs it over as many frames as are wanted. Arrays of taps are (..., 4, 2, rows, cols): phase images
τ = 0, π/2, π, 3π/2, then taps a and b.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.frames import Flag, Frames
from phasemark.render.noise import phase_image_variance
from phasemark.render.phasor import PhasorImages, phasor_to_range_m
from phasemark.render.sensor import Sensor

N_PHASES = 4
N_TAPS = 2

# Re[S e^{iτ}] at τ = 0, π/2, π, 3π/2 is Re S, −Im S, −Re S, Im S, exactly.
_REAL_WEIGHT = np.array([1.0, 0.0, -1.0, 0.0])
_IMAG_WEIGHT = np.array([0.0, -1.0, 0.0, 1.0])
_TAP_SIGN = np.array([1.0, -1.0])

# float32 files may round |S_1| just above the intensity; anything more is not an image.
_ROUNDING = 1e-6

# Above this a float64 can no longer count electrons one by one, and Poisson draws stop being exact.
_MOST_ELECTRONS = 2.0**53

# Taps held at once: small enough for the caches, large enough to hide the cost of a NumPy call.
_TAPS_PER_BLOCK = 2**17


def capture(image: PhasorImages, sensor: Sensor, *, rng: np.random.Generator, n_frames: int = 1) -> Frames:
    """Take noisy frames of noise-free images.

    Parameters
    ----------
    image : PhasorImages
        n views.
    sensor : Sensor
        The camera; it may differ from the one the image was rendered for in electrons, noise and validity, not in
        geometry or modulation.
    rng : numpy.random.Generator
        Source of all noise. It is advanced by the same amount whatever is captured, and each noise term draws from
        its own stream, so that switching one term off leaves the others' noise as it was.
    n_frames : int
        Frames of each view, with independent noise.

    Returns
    -------
    Frames
        (n, n_frames, rows, cols). A pixel below the validity threshold, or where nothing returns light, has range NaN
        and :attr:`Flag.NO_RETURN`.

    Raises
    ------
    UsageError
        `n_frames` is not positive; the image was rendered for other optics; it is not finite, or its phasor is
        larger than its intensity allows.
    """
    if not isinstance(n_frames, int | np.integer) or n_frames < 1:
        raise UsageError(f"'n_frames' must be a whole number of at least 1, got {n_frames!r}")
    if difference := sensor.optics_difference(image.sensor):
        raise UsageError(f"the image was rendered for another camera: {difference}")
    _check_image(image, sensor)

    shape = (len(image) * n_frames, sensor.rows, sensor.cols)
    range_m, amplitude_e, intensity_e = np.empty(shape), np.empty(shape), np.empty(shape)
    flags = np.empty(shape, dtype=np.uint8)
    streams = NoiseStreams.from_rng(rng)
    for block in _blocks(shape):
        # The frames of a block belong to few views: compute each view's means once, then repeat them.
        view = np.arange(block.start, block.stop) // n_frames
        views = slice(view[0], view[-1] + 1)
        phasor = image.phasor[views]
        means = add_dark(tap_means(phasor, image.intensity[views], sensor), sensor)
        taps = add_shot_noise(means[view - view[0]], sensor, streams.shot)
        taps = add_read_noise(taps, sensor, streams.read)
        phasor_e, intensity_e[block] = demodulate(taps)
        range_m[block] = phasor_to_range_m(phasor_e, sensor)
        amplitude_e[block] = np.abs(phasor_e)
        lit = np.not_equal(phasor, 0)[view - view[0]]
        flags[block] = validity_flags(amplitude_e[block], intensity_e[block], lit, sensor)

    full = (len(image), n_frames, sensor.rows, sensor.cols)
    return Frames(
        range_m.reshape(full),
        amplitude_e.reshape(full),
        intensity_e.reshape(full),
        flags=flags.reshape(full),
        sensor=sensor,
    )


def tap_means(phasor: NDArray[np.complex128], intensity: NDArray[np.float64], sensor: Sensor) -> NDArray[np.float64]:
    """Return the mean electrons that light brings to each tap, ambient light included.

    ½ (N₀·intensity + N_amb) ± ½ K N₀ Re[S_1 e^{iτ}], τ = 0, π/2, π, 3π/2.

    Parameters
    ----------
    phasor, intensity : (..., rows, cols)
        S_1 and the mean amplitude.
    sensor : Sensor

    Returns
    -------
    ndarray, shape (..., 4, 2, rows, cols)
        e- per tap and phase image.
    """
    common = 0.5 * (sensor.signal_e * intensity + sensor.ambient_e)
    signal = 0.5 * sensor.contrast * sensor.signal_e * phasor[..., None, :, :]
    modulated = _REAL_WEIGHT[:, None, None] * signal.real + _IMAG_WEIGHT[:, None, None] * signal.imag
    means = common[..., None, None, :, :] + _TAP_SIGN[:, None, None] * modulated[..., :, None, :, :]
    return np.asarray(np.maximum(means, 0.0))  # full contrast leaves a tap empty: −1e-12 by rounding


def add_dark(means: NDArray[np.float64], sensor: Sensor) -> NDArray[np.float64]:
    """Add the mean dark current, half of it to each tap; e-."""
    return means + 0.5 * sensor.dark_e if sensor.dark_e else means


def add_shot_noise(means: NDArray[np.float64], sensor: Sensor, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw the electrons that arrive, independently in every tap and phase image: Poisson(means); e-."""
    return rng.poisson(means).astype(np.float64) if sensor.shot_noise else means


def add_read_noise(electrons: NDArray[np.float64], sensor: Sensor, rng: np.random.Generator) -> NDArray[np.float64]:
    """Add Gaussian noise of `read_noise_e` r.m.s., independently in every tap and phase image; e-."""
    if sensor.read_noise_e == 0:
        return electrons
    return electrons + sensor.read_noise_e * rng.standard_normal(electrons.shape)


def demodulate(taps: NDArray[np.float64]) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Turn four phase images into a phasor and an intensity.

    With D_i = N_a − N_b: phasor_e = ½ [(D₀ − D₂) + i (D₃ − D₁)], so that its argument is the measured phase, its
    modulus is amplitude_e with mean K·N₀·|S_1|; and intensity_e = ¼ Σ (N_a + N_b).

    Parameters
    ----------
    taps : (..., 4, 2, rows, cols)
        e- per tap and phase image.

    Returns
    -------
    phasor_e : (..., rows, cols) complex128
    intensity_e : (..., rows, cols) float64
    """
    tap_a, tap_b = taps[..., 0, :, :], taps[..., 1, :, :]
    d = tap_a - tap_b
    phasor_e = np.empty((*d.shape[:-3], *d.shape[-2:]), dtype=np.complex128)
    phasor_e.real = 0.5 * (d[..., 0, :, :] - d[..., 2, :, :])
    phasor_e.imag = 0.5 * (d[..., 3, :, :] - d[..., 1, :, :])
    return phasor_e, (tap_a + tap_b).sum(axis=-3) / N_PHASES


def validity_flags(
    amplitude_e: NDArray[np.float64],
    intensity_e: NDArray[np.float64],
    lit: NDArray[np.bool_],
    sensor: Sensor,
) -> NDArray[np.uint8]:
    """Flag the pixels whose range one frame cannot tell.

    A pixel is valid when amplitude_e > 0 and, if the sensor sets `max_phase_std_rad`, when the noise law at the
    measured amplitude and intensity predicts no more:
    amplitude_e ≥ √(variance under its root) / (√2 · max_phase_std_rad).

    Parameters
    ----------
    amplitude_e, intensity_e : ndarray
        As measured.
    lit : ndarray of bool
        False where no modulated light returns (S = 0): there is no range to measure, whatever the noise says.
    sensor : Sensor

    Returns
    -------
    ndarray of uint8
        0, or :attr:`Flag.NO_RETURN`.
    """
    valid = lit & (amplitude_e > 0)
    if sensor.max_phase_std_rad is not None:
        noise = np.sqrt(0.5 * phase_image_variance(intensity_e, sensor))
        valid &= amplitude_e * sensor.max_phase_std_rad >= noise
    return np.where(valid, 0, int(Flag.NO_RETURN)).astype(np.uint8)


class _Term(IntEnum):
    """The noise terms by number; a number keeps its stream for good."""

    SHOT = 0
    READ = 1


class NoiseStreams(NamedTuple):
    """One random stream for each noise term."""

    shot: np.random.Generator
    read: np.random.Generator

    @classmethod
    def from_rng(cls, rng: np.random.Generator) -> NoiseStreams:
        """Key the streams with 256 bits drawn from `rng`.

        Drawing the key, rather than spawning children, works for every bit generator and makes the next call with the
        same `rng` independent of this one.
        """
        key = rng.integers(0, 2**32, size=8, dtype=np.uint32).tolist()

        def stream(term: _Term) -> np.random.Generator:
            return np.random.Generator(np.random.PCG64DXSM(np.random.SeedSequence(key, spawn_key=(int(term),))))

        return cls(shot=stream(_Term.SHOT), read=stream(_Term.READ))


def _blocks(shape: tuple[int, int, int]) -> Iterator[slice]:
    """Cut the frames into blocks. Streams are read in the order of the frames, so the cuts leave no trace."""
    n, rows, cols = shape
    step = max(1, _TAPS_PER_BLOCK // (N_PHASES * N_TAPS * rows * cols))
    for start in range(0, n, step):
        yield slice(start, min(start + step, n))


def _check_image(image: PhasorImages, sensor: Sensor) -> None:
    """Refuse an image that no light can make, naming the first pixel that shows it."""
    finite = np.isfinite(image.phasor) & np.isfinite(image.intensity)
    if not finite.all():
        raise UsageError(f"{_where(~finite)}: phasor and intensity must be finite")
    offset = sensor.ambient_e / sensor.signal_e
    negative = sensor.contrast * image.amplitude > (image.intensity + offset) * (1 + _ROUNDING)
    if negative.any():
        pixel = tuple(np.argwhere(negative)[0])
        raise UsageError(
            f"{_where(negative)}: a tap's mean is negative, for the amplitude {image.amplitude[pixel]:.4g} at contrast "
            f"{sensor.contrast:g} must not exceed the intensity, got {image.intensity[pixel]:.4g}"
        )
    brightest = sensor.signal_e * image.intensity.max(initial=0.0) + sensor.ambient_e + sensor.dark_e
    if brightest > _MOST_ELECTRONS:
        raise UsageError(
            f"a phase image would count {brightest:.3g} electrons, which is more than 2^53: lower 'signal_e'"
        )


def _where(mask: NDArray[np.bool_]) -> str:
    view, row, col = np.argwhere(mask)[0]
    return f"view {view}, row {row}, column {col}"
