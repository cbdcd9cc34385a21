"""The coherent mean of the phasors of each pixel of a camera at rest (PHYSICS section 6)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.filters.pixel_sums import PixelSums, filter_each, in_time, timed
from phasemark.render.frames import Frames
from phasemark.render.phasor_images import phasor_to_range_m
from phasemark.render.sensor.range_noise import measured_range_std


def phasor_mean(frames: Frames) -> FilteredFrames:
    """Average the phasors amplitude_e · exp(iφ) of every pixel coherently (PHYSICS section 6).

    Better than a mean of ranges at low signal, where a weak frame's phase is worth less, and near the wrap. Frames
    without amplitude average unit phasors. A frame below the validity threshold has no range and so no phase: only
    valid frames enter. To use every frame at low signal, capture with ``max_phase_std_rad=None``.

    The variance of the range is the noise law at the amplitude of the mean phasor and the mean intensity, over n_valid;
    or, if the frames have no amplitude or no intensity, the scatter of the phasors across their mean's direction,
    over n_valid (n_valid − 1), infinite for one frame.

    Parameters
    ----------
    frames : Frames
        (n, frames, rows, cols).

    Returns
    -------
    FilteredFrames
        Its amplitude_e is that of the mean phasor, which unlike the mean amplitude carries no bias from noise, where a
        frame is valid.

    Raises
    ------
    UsageError
        There is no frame.
    """
    if len(frames.by_frequency) > 1:
        return filter_each(frames, phasor_mean)
    if not frames.by_frequency:
        raise UsageError(
            "the frames hold unwrapped ranges alone, and a mean of phasors takes what each modulation frequency"
            " measured: filter them with kalman_filter"
        )
    sums = PixelSums(frames)
    n_valid = sums.n_valid
    mean = np.zeros(n_valid.shape, dtype=np.complex128)
    for phasor in _phasors_in_time(frames):
        mean += phasor
    mean /= np.maximum(n_valid, 1)
    amplitude = np.abs(mean)
    intensity_e = sums.mean("intensity_e")
    std_m = np.full(n_valid.shape, np.inf)
    if frames.amplitude_e is not None and intensity_e is not None:
        law = measured_range_std(amplitude, intensity_e, frames.sensor)
        np.divide(law, np.sqrt(n_valid), out=std_m, where=n_valid > 0)
    else:
        direction = np.divide(mean, amplitude, out=np.ones_like(mean), where=amplitude > 0)
        squares = np.zeros(n_valid.shape)
        for phasor in _phasors_in_time(frames):
            squares += (phasor * direction.conj()).imag ** 2
        across = np.sqrt(squares) * frames.sensor.metres_per_radian
        scale = amplitude * np.sqrt(n_valid * (n_valid - 1.0))
        np.divide(across, scale, out=std_m, where=scale > 0)
    coherent = None if frames.amplitude_e is None else amplitude
    filtered = sums.filtered(phasor_to_range_m(mean, frames.sensor), std_m, n_valid.astype(np.float64), coherent)
    return timed(filtered, frames)


def _phasors_in_time(frames: Frames) -> Iterator[NDArray[np.complex128]]:
    """Yield amplitude_e · exp(iφ) frame by frame, zero where invalid; exp(iφ) without amplitudes."""
    for k, (range_m, valid) in enumerate(in_time(frames)):
        unit = np.exp(1j / frames.sensor.metres_per_radian * np.where(valid, range_m, 0.0))
        yield np.where(valid, 1.0 if frames.amplitude_e is None else frames.amplitude_e[:, k], 0.0) * unit
