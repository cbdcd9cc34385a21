"""What the spacing of a bank's grid costs: random views against their nearest images, as banks of waveforms are tested.

The whitened squared distance of a view from an image of the bank is χ² = Σ |S − S_bank|² / σ², summed over pixels, with
σ the noise of one component of S (PHYSICS section 4); pixels with less than 1 % of the brightest one's light are left
out, for without ambient light they have no noise at all. The mismatch is 1 − Re⟨S, S_bank⟩ / (|S| |S_bank|), the share
of the signal that the nearest image does not explain. The Fisher information Re⟨∂S/∂a, ∂S/∂b⟩ / σ² of distance and δ
says how fine a grid would have to be for its spacing to cost no more than the noise does; it is that of whole phasors,
the albedo known, five times finer in D than ranges alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data.bank import Bank
from phasemark.data.build import BankJob
from phasemark.data.seeds import stream
from phasemark.render import PhasorImages, Sensor, Views
from phasemark.render.noise import phase_image_variance

FRAMES = 50
"""Frames that are averaged before matching (PHYSICS section 6)."""

_REACH = 4
"""How many grid steps around a view its nearest image is looked for: distance and δ are coupled, but not further."""
_STEP = 1e-4
"""Metres and radians over which derivatives are taken."""
_BATCH = 512
_DARK = 0.01


def grid_loss(bank: Bank, n: int, *, seed: int = 0) -> dict[str, float | int]:
    """Match random views against a bank and say what its spacing costs.

    Parameters
    ----------
    bank : Bank
        A bank with at least two distances and two angles.
    n : int
        How many views, uniform over the bank's distances, angles and classes.
    seed : int
        Which.

    Returns
    -------
    dict
        ``mismatch_median``, ``mismatch_99`` (median and 99th percentile of the mismatch), ``chi2_median`` (of the mean
        of 50 frames), ``distance_rms_m`` and ``delta_rms_deg`` (how far the nearest image is off), and
        ``suggested_distance_m`` and ``suggested_delta_deg``: steps at which the worst view between grid points is, in
        the median over views, as far from its nearest image as one standard deviation of 50 frames' noise.

    Raises
    ------
    UsageError
        The bank's grid has no spacing, or its sensor has no phasors.
    """
    if n < 1:
        raise UsageError(f"--population must be at least 1, got {n}")
    if len(bank.distance_m) < 2 or len(bank.delta_rad) < 2:
        raise UsageError(f"{bank.path}: has one distance or one angle only: there is no spacing to test")
    if bank.sensor.kind == "direct":
        raise UsageError(f"{bank.path}: its sensor is direct: there are no phasors to compare")
    group = bank.full or bank.lower
    assert group is not None
    rng = stream(seed, "population", 0)
    job = BankJob(bank.plan, bank.mesh)
    slabs = job.angled_images()
    stored = group.phasor.reshape(len(slabs), len(bank.distance_m), len(bank.delta_rad), *group.phasor.shape[-2:])
    share = math.ceil(n / len(slabs))
    found: list[_Found] = []
    for of_class, images_of in zip(stored, slabs, strict=True):
        distance_m = rng.uniform(bank.distance_m[0], bank.distance_m[-1], share)
        delta_rad = rng.uniform(bank.delta_rad[0], bank.delta_rad[-1], share)
        for start in range(0, share, _BATCH):
            part = slice(start, start + _BATCH)
            found.append(_compare(bank, of_class, images_of, distance_m[part], delta_rad[part]))
    table = np.concatenate([np.stack(one, axis=1) for one in found])[:n]
    mismatch, chi2, distance_error, delta_error, fisher_distance, fisher_delta = table.T
    # half a step in each direction costs χ² of a half: together one, the square of one standard deviation
    steps = [2 * np.sqrt(0.5 / (FRAMES * np.median(fisher))) for fisher in (fisher_distance, fisher_delta)]
    return {
        "population": len(table),
        "mismatch_median": float(np.median(mismatch)),
        "mismatch_99": float(np.percentile(mismatch, 99)),
        "chi2_median": float(np.median(chi2) * FRAMES),
        "distance_rms_m": float(np.sqrt(np.mean(distance_error**2))),
        "delta_rms_deg": float(np.rad2deg(np.sqrt(np.mean(delta_error**2)))),
        "suggested_distance_m": float(steps[0]),
        "suggested_delta_deg": float(np.rad2deg(steps[1])),
    }


_Found = tuple[NDArray[np.float64], ...]


def _compare(
    bank: Bank,
    stored: NDArray[np.complex64],
    images_of: Callable[[Views], PhasorImages],
    distance_m: NDArray[np.float64],
    delta_rad: NDArray[np.float64],
) -> _Found:
    """Return mismatch, χ² of one frame, errors in D and δ, and the Fisher information of each, of some views."""
    seen = images_of(Views.broadcast(distance_m, delta_rad))
    weight = _weight(seen.intensity, bank.sensor)
    slopes = [
        (images_of(Views.broadcast(distance_m + d, delta_rad + a)).phasor - seen.phasor) / _STEP
        for d, a in ((_STEP, 0.0), (0.0, _STEP))
    ]
    fisher = [np.sum(np.abs(slope) ** 2 * weight, axis=(1, 2)) for slope in slopes]
    out = np.empty((len(distance_m), 4))
    for k, (d, a) in enumerate(zip(distance_m, delta_rad, strict=True)):
        rows, cols = _near(bank.distance_m, d), _near(bank.delta_rad, a)
        nearby = stored[rows, cols].astype(np.complex128)
        chi2 = np.sum(np.abs(nearby - seen.phasor[k]) ** 2 * weight[k], axis=(2, 3))
        i, j = np.unravel_index(int(np.argmin(chi2)), chi2.shape)
        image = nearby[i, j]
        overlap = np.sum((image * seen.phasor[k].conj()).real * weight[k])
        norms = np.sum(np.abs(image) ** 2 * weight[k]) * np.sum(np.abs(seen.phasor[k]) ** 2 * weight[k])
        out[k] = (
            1 - overlap / math.sqrt(norms),
            chi2[i, j],
            bank.distance_m[rows][i] - d,
            bank.delta_rad[cols][j] - a,
        )
    return (*out.T, *fisher)


def _near(grid: NDArray[np.float64], value: float) -> slice:
    middle = int(np.searchsorted(grid, value))
    return slice(max(0, middle - _REACH), middle + _REACH)


def _weight(intensity: NDArray[np.float64], sensor: Sensor) -> NDArray[np.float64]:
    """Return 1/σ² of one component of S in one frame."""
    lit = intensity > _DARK * intensity.max(axis=(1, 2), keepdims=True)
    arrived_e = sensor.signal_e * intensity + sensor.ambient_e + sensor.dark_e
    variance = np.maximum(0.5 * phase_image_variance(arrived_e, sensor), 1.0)  # no less than one electron's
    return np.where(lit, (sensor.contrast * sensor.signal_e) ** 2 / variance, 0.0)
