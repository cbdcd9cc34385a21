"""Frames of a direct time-of-flight camera: geometry, footprint and dropout, and nothing else (PHYSICS section 4)."""

from __future__ import annotations

import numpy as np

from phasemark.render.exposure.random_streams import Term, draw_key, fill_normal, fill_uniform
from phasemark.render.frames import Flag, Frames
from phasemark.render.phasor_images import PhasorImages
from phasemark.render.sensor.camera_unit import camera_unit
from phasemark.render.sensor.range_noise import direct_range_std
from phasemark.render.sensor.sensor import Sensor


def capture_direct(
    image: PhasorImages,
    sensor: Sensor,
    rng: np.random.Generator,
    n_frames: int,
    first_view: int,
    first_frame: int,
) -> Frames:
    """Take frames with a camera that makes z on the chip; see :func:`~phasemark.render.capture`.

    The range of a pixel is the light-weighted mean over its footprint: the phasor's modulation is so slow that its
    argument is that mean. A pixel drops out (:attr:`Flag.NO_RETURN`) where nothing returns, where less than
    `min_intensity` does, or beyond `max_range_m`. The noise is that of
    :func:`~phasemark.render.sensor.range_noise.direct_range_std`; `range_offset_m` and `zone_offset_m` are added.
    There is no amplitude.
    """
    shape = (len(image), n_frames, sensor.rows, sensor.cols)
    range_m = np.repeat(image.range_m[:, None] + sensor.range_offset_m, n_frames, axis=1)
    if sensor.zone_offset_m:
        range_m += sensor.zone_offsets
    key = draw_key(rng)
    if sensor.range_std_m > 0 or sensor.range_shot_std_m > 0 or sensor.range_ambient_std_m > 0:
        law = direct_range_std(image.intensity, sensor)
        std_m = np.where(np.isfinite(law), law, 0.0)  # what has no light returns nothing
        n = sensor.rows * sensor.cols
        words, chosen = np.empty((4, n), np.uint64), np.empty(n, np.int32)
        uniform, normal, samples = np.empty((2, n)), np.empty(n), np.arange(n)
        for view in range(shape[0]):
            for frame in range(n_frames):
                fill_uniform(samples, first_frame + frame, first_view + view, int(Term.RANGE), key, words, uniform)
                fill_normal(uniform[0], chosen, normal)
                range_m[view, frame] += std_m[view] * normal.reshape(shape[2:])
    furthest_m = np.inf if sensor.max_range_m is None else sensor.max_range_m
    seen = (image.intensity > 0) & (image.intensity >= sensor.min_intensity) & (image.range_m <= furthest_m)
    flags = np.where(seen, 0, int(Flag.NO_RETURN)).astype(np.uint8)
    flags[:, camera_unit(sensor).dead] = int(Flag.DEAD | Flag.MISSING)
    return Frames(range_m, flags=np.broadcast_to(flags[:, None], shape), sensor=sensor)
