"""Accuracy lost to the spacing of a bank's grid: random views without noise, matched as banks of waveforms are tested.

A view between the grid's points is rendered, weighed with the noise of 50 frames but given none of it, and matched:
what the answer is off is due to the grid alone. Over the Cramér–Rao bound of those frames (PHYSICS section 7) it says
how much of a robot's error comes from the grid; the two add in squares.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.data.bank.build_bank import BankJob
from phasemark.data.seeds import stream
from phasemark.matcher.accuracy.cramer_rao import cramer_rao
from phasemark.matcher.accuracy.trials import Trials, judged
from phasemark.matcher.filters.filtered_frames import noise_free
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.match import Matches
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.nearest.grid import closing_period
from phasemark.matcher.pixel_agreement import counts
from phasemark.matcher.statistics import error_statistics
from phasemark.render import PhasorImages, Renderer, Views
from phasemark.render.sensor.range_noise import phase_image_variance

N_FRAMES = 50
"""Frames that are averaged before matching (PHYSICS section 6)."""


@dataclass(frozen=True)
class SpacingLoss:
    """Error that the grid adds to one method of matching.

    Parameters
    ----------
    class_errors : int
        Views that were taken for another class, or for none; they do not count below.
    distance_rms_m, delta_rms_deg : float
        Root mean square of the errors; NaN, as the next two, where every class was wrong.
    distance_over_bound, delta_over_bound : float
        Root mean square of the errors over the Cramér–Rao bound at each view: 1 where the grid costs as much as the
        noise.
    """

    class_errors: int
    distance_rms_m: float
    delta_rms_deg: float
    distance_over_bound: float
    delta_over_bound: float


@dataclass(frozen=True)
class GridLoss:
    """Error that the spacing of a bank's grid adds, and the spacing at which it would equal the noise.

    Parameters
    ----------
    views : int
        Number of views that were matched.
    frames : int
        Number of frames whose averaged noise weighs the views.
    nearest : SpacingLoss
        Error added to the nearest image.
    refined : SpacingLoss or None
        Error added to maximum likelihood; None for a bank of the planar generator, which cannot be refined.
    mismatch_median : float
        Median of 1 − ⟨S, S_bank⟩ / (|S| |S_bank|), the share of the view's signal that the nearest image leaves
        unexplained, in phasors whitened by the noise.
    mismatch_99 : float
        99th percentile of the same share.
    suggested_distance_m : float or None
        Step in distance, metres: √2 over the root of the Fisher information of the ranges that the nearest image is
        chosen by, in the median over the views. With both suggested steps, a view amid four images of the grid is one
        standard deviation of the noise from them, half of its square due to each step. None where nothing depends on
        the distance.
    suggested_delta_deg : float or None
        Step in δ, degrees, by the same rule.
    """

    views: int
    frames: int
    nearest: SpacingLoss
    refined: SpacingLoss | None
    mismatch_median: float
    mismatch_99: float
    suggested_distance_m: float | None
    suggested_delta_deg: float | None

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers by name, ``nearest_…`` and ``refined_…`` for the methods; nothing unknown."""
        out: dict[str, Any] = {}
        for key, value in asdict(self).items():
            out |= (
                {f"{key}_{name}": inner for name, inner in value.items()} if isinstance(value, dict) else {key: value}
            )
        return {key: value for key, value in out.items() if value is not None and math.isfinite(value)}


def grid_loss(bank: Bank, n: int, *, seed: int = 0, workers: int | None = None) -> GridLoss:
    """Match random views against a bank and say what its spacing costs.

    Parameters
    ----------
    bank : Bank
        A bank with at least two distances and two angles.
    n : int
        How many views: classes in turn, distance and angle uniform over the bank's, bearing and height 0.
    seed : int
        Which views: the same seed takes the same ones.
    workers : int, optional
        Threads that render (None: one for each processor); the answer does not depend on it.

    Returns
    -------
    GridLoss

    Raises
    ------
    UsageError
        `n` is not positive, or the bank's grid has no spacing.
    """
    if n < 1:
        raise UsageError(f"n=… must be at least 1, got {n}")
    if len(bank.distance_m) < 2 or len(bank.delta_rad) < 2:
        raise UsageError(f"{bank.path}: has one distance or one angle only: there is no spacing to test")
    methods = {"nearest": Matcher(bank, "nearest")}
    if bank.plan.model == "ray":
        methods["refined"] = Matcher(bank, "refine", free=VIEW[:2], workers=workers)
    job = BankJob(bank.plan, bank.mesh)
    rng = stream(seed, "population", 0)
    first, last = float(bank.delta_rad[0]), float(bank.delta_rad[-1])
    period = closing_period(bank.delta_rad)
    # in a factored bank the nearest image is the lower pixels' choice; the maximum of the likelihood is that of all
    pixels = {"nearest": "lower" if bank.lower is not None else "all", "refined": "all"}
    parts: dict[str, list[Trials]] = {method: [] for method in methods}
    mismatches, information = [], []
    batch = 256
    for k, (name, images_of) in enumerate(zip(bank.classes, job.whole_images(), strict=True)):
        mesh = bank.mesh(name)
        renderer = Renderer(mesh, bank.sensor, albedo=float(mesh.metadata["albedo"]))
        left = (n - k + len(bank.classes) - 1) // len(bank.classes)
        while left > 0:
            some = min(left, batch)
            left -= some
            views = Views.broadcast(
                rng.uniform(bank.distance_m[0], bank.distance_m[-1], some),
                rng.uniform(first, last if period is None else first + period, some),
            )
            images = images_of(views)
            frames = noise_free(images, N_FRAMES)
            for method, matcher in methods.items():
                matches = matcher.match(frames)
                limit = cramer_rao(renderer, views, n_frames=N_FRAMES, pixels=pixels[method])
                symmetry = int(mesh.metadata["symmetry"])
                parts[method].append(judged(matches, name, views, limit.covariance, limit.free, symmetry))
                if method == "nearest":
                    mismatches.append(_mismatches(bank, matches, images))
                    information.append(limit.information)
    losses = {method: _loss(Trials.joined(own)) for method, own in parts.items()}
    mismatch = np.concatenate(mismatches)
    matched = mismatch[np.isfinite(mismatch)]
    typical = np.diag(np.median(np.concatenate(information), axis=0))
    steps = [math.sqrt(2 / one) if one > 0 else None for one in typical]
    return GridLoss(
        views=len(mismatch),
        frames=N_FRAMES,
        nearest=losses["nearest"],
        refined=losses.get("refined"),
        mismatch_median=float(np.median(matched)) if len(matched) else math.nan,
        mismatch_99=float(np.percentile(matched, 99)) if len(matched) else math.nan,
        suggested_distance_m=steps[0],
        suggested_delta_deg=None if steps[1] is None else math.degrees(steps[1]),
    )


def _loss(trials: Trials) -> SpacingLoss:
    """Judge the errors of a method; views that were taken for another class do not count."""
    right = trials.class_right
    found = error_statistics(trials.error[right], trials.free, bound_std=trials.bound_std[right])
    return SpacingLoss(
        class_errors=int((~right).sum()),
        distance_rms_m=found.rmse["distance_m"].value,
        delta_rms_deg=math.degrees(found.rmse["delta_rad"].value),
        distance_over_bound=found.ratio["distance_m"].value,
        delta_over_bound=found.ratio["delta_rad"].value,
    )


def _mismatches(bank: Bank, matches: Matches, images: PhasorImages) -> NDArray[np.float64]:
    """Return the mismatch of each view with the image on the grid that it was matched to; NaN where there is none.

    Pixels weigh by 1/σ² of a component of S, and count where one frame tells their phase at all; of several modulation
    frequencies the pixels of each count.
    """
    by_hz = dict(zip(bank.sensor.frequencies_hz, images.by_frequency, strict=True))
    weights = {hz: _weights(seen) for hz, seen in by_hz.items()}
    out = np.full(len(matches), np.nan)
    for k, match in enumerate(matches):
        if match.class_name is not None:
            i = int(np.argmin(np.abs(bank.distance_m - match.distance_m)))
            j = int(np.argmin(np.abs(bank.delta_rad - match.delta_rad)))
            along = power = model_power = 0.0
            for hz, seen in by_hz.items():
                model, own, weight = bank.phasor(match.class_name, i, j, hz), seen.phasor[k], weights[hz][k]
                model = model.astype(np.complex128)
                model_power += np.sum(weight * np.abs(model) ** 2)
                power += np.sum(weight * np.abs(own) ** 2)
                along += np.sum(weight * (model * own.conj()).real)
            out[k] = 1 - along / math.sqrt(model_power * power)
    return out


def _weights(images: PhasorImages) -> NDArray[np.float64]:
    """Return 1/σ² of a component of S at one frequency, 0 where a pixel does not count."""
    sensor = images.sensor
    used = counts(images.phasor, images.intensity, sensor)
    arrived_e = sensor.signal_e * images.intensity + sensor.ambient_e + sensor.dark_e
    return np.asarray(used / np.maximum(phase_image_variance(arrived_e, sensor), 1e-30))
