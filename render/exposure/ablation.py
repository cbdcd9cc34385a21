"""One frame with its errors added one after another: what mixing, shot noise and the rest each do to it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from phasemark.render.exposure.capture import capture
from phasemark.render.frames import Frames
from phasemark.render.phasor_images import PhasorImages
from phasemark.render.sensor.sensor import Sensor


class Ablation(NamedTuple):
    """Four variants of the same frames, each with more of the physics than the one before.

    Parameters
    ----------
    hard : Frames
        The ray through each pixel's centre alone, no noise.
    exact : Frames
        The integral over each pixel, no noise: mixed edge pixels.
    shot : Frames
        Shot noise beside.
    full : Frames
        Everything the sensor has; its shot noise follows the same random numbers.
    """

    hard: Frames
    exact: Frames
    shot: Frames
    full: Frames


def ablate(
    hard: PhasorImages, image: PhasorImages, sensor: Sensor, *, rng: np.random.Generator, n_frames: int = 1
) -> Ablation:
    """Capture four variants of the same views.

    Parameters
    ----------
    hard : PhasorImages
        The views by centre rays.
    image : PhasorImages
        The same views, integrated, with the harmonics that the sensor needs.
    sensor : Sensor
        The camera.
    rng : numpy.random.Generator
        Advanced once; all variants draw from the same streams.
    n_frames : int
        Frames of each view; those without noise are all alike.

    Returns
    -------
    Ablation

    Raises
    ------
    UsageError
        As :func:`~phasemark.render.capture`.

    Examples
    --------
    >>> from phasemark.render import Background, Renderer, preset
    >>> sensor = preset("pmd-16x16-wiggle")
    >>> image = Renderer(None, sensor).render(1.0, background=Background(wall_m=2.0))
    >>> variants = ablate(image, image, sensor, rng=np.random.default_rng(7))
    >>> [round(float(frames.range_m[0, 0, 8, 8]), 2) for frames in variants]
    [2.0, 2.0, 1.9, 1.84]
    """
    seed = rng.integers(0, 2**63, dtype=np.int64)

    def take(images: PhasorImages, camera: Sensor) -> Frames:
        return capture(images, camera, rng=np.random.default_rng(seed), n_frames=n_frames)

    faultless = sensor.without_errors()
    return Ablation(
        hard=take(hard, faultless),
        exact=take(image, faultless),
        shot=take(image, sensor.without_errors(shot_noise=True)),
        full=take(image, sensor),
    )
