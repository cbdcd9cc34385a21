"""Filtered frames of a whole camera, cut down to the region of pixels that a bank holds."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.filters.filtered_frames import FilteredFrames, PixelState, unwrap_filtered
from phasemark.render.phasor_images import wrap_range_m
from phasemark.render.sensor.range_noise import measured_range_std
from phasemark.render.sensor.region import Region


def read_region(frames: FilteredFrames, region: Region) -> FilteredFrames:
    """Return what a camera would have measured that reads a region of the pixels, block by block.

    The phasor of a block is the sum of amplitude · exp(iφ) over its pixels that return. Its noise across the phasor is
    that of these pixels: σ_φ² = Σ (amplitude · σ_φ)² / |S|². A pixel without a return has no phase to add: what it
    misses is below the camera's threshold. A block is missing where a pixel of it is, or where its pixels without a
    return have so much light together that the block would have returned.

    Parameters
    ----------
    frames : FilteredFrames
        n positions of the whole camera.
    region : Region

    Returns
    -------
    FilteredFrames
        Of the camera ``region.camera(frames.sensor)``.

    Raises
    ------
    UsageError
        The region does not fit the camera, or pixels are to be added up whose amplitudes are unknown.
    """
    sensor = region.camera(frames.sensor)
    if frames.by_frequency:
        return unwrap_filtered([read_region(part, region) for part in frames.by_frequency], sensor)
    if region.binning == 1:
        return frames.with_arrays(lambda values: region.blocks(values)[..., 0], sensor=sensor)
    if frames.amplitude_e is None or frames.intensity_e is None:
        raise UsageError(
            f"'binning' of the bank is {region.binning}, and adding up pixels takes amplitudes, which the frames do not"
            " have: match them against a bank without binning"
        )
    scale = frames.sensor.metres_per_radian
    state = region.blocks(frames.state)
    returned = state == PixelState.RETURN
    amplitude = np.where(returned, region.blocks(frames.amplitude_e), 0.0)
    phase = np.where(returned, region.blocks(frames.range_m), 0.0) / scale
    noise = np.where(returned, region.blocks(frames.std_m), 0.0) / scale
    phasor = (amplitude * np.exp(1j * phase)).sum(axis=-1)
    size = np.abs(phasor)
    std = np.sqrt(((amplitude * noise) ** 2).sum(axis=-1))
    std_rad = np.divide(std, size, out=np.full(size.shape, np.inf), where=size > 0)
    worth = np.where(returned, region.blocks(frames.n_effective), 0.0)
    power = (amplitude**2).sum(axis=-1)
    n_effective = np.divide((amplitude**2 * worth).sum(axis=-1), power, out=np.zeros(power.shape), where=power > 0)
    limit = np.inf if sensor.max_phase_std_rad is None else sensor.max_phase_std_rad
    one_frame = np.sqrt(n_effective, out=np.zeros(power.shape), where=power > 0)
    seen = (size > 0) & (size >= sensor.min_amplitude_e)
    seen[seen] = std_rad[seen] * one_frame[seen] <= limit
    missing = (state == PixelState.MISSING).any(axis=-1)
    possible = size + _light_without_returns(frames, region, returned)
    missing |= ~seen & (possible > _least_light(frames, region, limit))
    seen &= ~missing
    new = np.where(seen, PixelState.RETURN, np.where(missing, PixelState.MISSING, PixelState.NO_RETURN))
    intensity = np.where(missing, np.nan, np.nan_to_num(region.blocks(frames.intensity_e)).sum(axis=-1))
    return FilteredFrames(
        range_m=np.where(seen, wrap_range_m(np.angle(phasor) * scale, sensor), np.nan),
        std_m=np.where(seen, std_rad * scale, np.nan),
        amplitude_e=np.where(missing, np.nan, size),
        intensity_e=intensity,
        state=new.astype(np.uint8),
        n_effective=np.where(seen, n_effective, 0.0),
        sensor=sensor,
        std_from_scatter=frames.std_from_scatter,
        overdispersion=frames.overdispersion,
        time_s=frames.time_s,
        tilt_rad=frames.tilt_rad,
    )


def _light_without_returns(frames: FilteredFrames, region: Region, returned: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the most amplitude that the pixels of each block without a return can add up to, electrons.

    The mean amplitude of noise alone is √(π/2) of its standard deviation; what is beyond it is light.
    """
    assert frames.amplitude_e is not None
    dark = ~returned & (region.blocks(frames.state) == PixelState.NO_RETURN)
    measured = np.where(dark, np.nan_to_num(region.blocks(frames.amplitude_e)), 0.0)
    noise = np.where(dark, region.blocks(_amplitude_std_e(frames)), 0.0)
    power = (measured**2 - 0.5 * math.pi * noise**2).sum(axis=-1)
    return np.asarray(np.sqrt(np.maximum(power, 0.0) * dark.sum(axis=-1)))


def _least_light(frames: FilteredFrames, region: Region, limit_rad: float) -> NDArray[np.float64]:
    """Return the amplitude at which the blocks of one frame return, electrons."""
    variance = (np.nan_to_num(region.blocks(_amplitude_std_e(frames))) ** 2).sum(axis=-1)
    return np.asarray(np.sqrt(variance) / limit_rad)


def _amplitude_std_e(frames: FilteredFrames) -> NDArray[np.float64]:
    """Return the noise of the amplitudes of one frame, electrons."""
    assert frames.intensity_e is not None
    intensity = np.nan_to_num(frames.intensity_e)
    std_m = measured_range_std(np.ones(intensity.shape), intensity, frames.sensor)
    return np.asarray(std_m / frames.sensor.metres_per_radian)
