"""Errors that all frames of a camera share, carried into the covariance of a view.

A calibration leaves the fields κ of a sensor uncertain, with covariance C, and from one recording to the next some of
them differ, by `recording_range_m` and its neighbours. With the Jacobian J of the residuals by the view, their weights
W and the covariance P = (Jᵀ W J)⁻¹, an error δκ moves the estimate by −P Jᵀ W (∂f/∂κ) δκ to first order. So the
covariance of the view grows by G C Gᵀ with G = P Jᵀ W ∂f/∂κ. Averaging frames does not reduce it. What a sensor
declares beside that (`systematic_distance_m` and its neighbours) is added to the variances.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render import Background, PhasorImages, Renderer, Sensor, Views
from phasemark.render.sensor.lens_fields import LENS_FIELD, lens_rates

Systematic = Literal["calibration", "recording", "declared", "multipath", "motion"]
"""What a calibration leaves of the sensor's fields, what differs in another recording, what the sensor declares of a
pose, light that bounces off a floor where it is not modelled, and the jitter of stamps."""
SYSTEMATICS: tuple[Systematic, ...] = get_args(Systematic)

_STEPS = {
    "pitch_deg": 0.02,
    "roll_deg": 0.02,
    "half_angle_h_deg": 0.02,
    "half_angle_v_deg": 0.02,
    "bearing_offset_deg": 0.02,
    "height_offset_m": 2e-4,
}
"""Fields that move an image, and the width of a difference in them."""
RECORDING_FIELDS = {
    "range_offset_m": "recording_range_m",
    "pitch_deg": "recording_pitch_deg",
    "roll_deg": "recording_roll_deg",
    "bearing_offset_deg": "recording_bearing_deg",
}
"""Fields that differ from one recording to the next, and those that say how much."""
_LENS_STEP_RAD = math.radians(0.02)
"""How far the width of a difference in a term of the lens moves the point of an image that it moves most."""
_OFFSET = "range_offset_m"
FLOOR_ALBEDO = "floor_albedo"
SUPPOSED_ALBEDO = 0.5
"""Albedo of a floor below the landmark whose multipath is not modelled."""
_LARGEST_ALBEDO = 0.6
_LOWEST_M = 0.01
_FLOOR_STEP_M, _WALL_STEP_M = 0.1, 0.1
_ASKEW = 0.1
"""How far a view that multipath moves ends beside where it should, as a share of the way, both in standard deviations
of noise."""


def check_systematic(names: Collection[str]) -> tuple[Systematic, ...]:
    """Return names of systematic terms in their order.

    Raises
    ------
    UsageError
        A name is unknown.
    """
    for name in names:
        if name not in SYSTEMATICS:
            raise UsageError(f"'systematic' must be among {', '.join(SYSTEMATICS)}, got {name!r}")
    return tuple(name for name in SYSTEMATICS if name in names)


def declared_covariance(sensor: Sensor, free: Sequence[str]) -> NDArray[np.float64]:
    """Return what a sensor declares of a pose, (p, p), metres and radians; zero where it declares nothing."""
    std = {
        "distance_m": sensor.systematic_distance_m,
        "delta_rad": math.radians(sensor.systematic_delta_deg),
        "bearing_rad": math.radians(sensor.systematic_bearing_deg),
        "height_m": sensor.systematic_height_m,
    }
    return np.diag([std.get(name, 0.0) ** 2 for name in free])


def rates_of_views(
    time_s: NDArray[np.float64],
    view: NDArray[np.float64],
    std: NDArray[np.float64],
    period_rad: NDArray[np.float64],
    turn: int,
) -> NDArray[np.float64]:
    """Return how fast estimated views change, by a weighted line through the estimates nearby in time.

    Parameters
    ----------
    time_s : (n,) float64
    view, std : (n, p) float64
        Free parameters and their standard deviations; NaN where a frame has no answer.
    period_rad : (n,) float64
        After which δ repeats.
    turn : int
        Column of δ.

    Returns
    -------
    (n, p) float64
        Per second; 0 where too few estimates are near.
    """
    known = np.isfinite(view).all(axis=1) & np.isfinite(std).all(axis=1)
    rate = np.zeros_like(view)
    reach_s = 0.25  # estimates farther away in time do not tell how fast a view changes
    rate_needs = 3  # estimates that a rate takes, the view's own among them
    for k in np.flatnonzero(known):
        near = np.flatnonzero(known & (np.abs(time_s - time_s[k]) <= reach_s))
        since = time_s[near] - time_s[k]
        if len(near) < rate_needs or np.ptp(since) == 0:
            continue
        away = view[near] - view[k]
        away[:, turn] = (away[:, turn] + period_rad[k] / 2) % period_rad[k] - period_rad[k] / 2
        weight = 1 / np.maximum(std[near], np.median(std[near], axis=0)) ** 2
        total = weight.sum(axis=0)
        middle = (weight * since[:, None]).sum(axis=0) / total
        spread = since[:, None] - middle
        rate[k] = (weight * spread * away).sum(axis=0) / (weight * spread**2).sum(axis=0)
    return rate


class Carried(NamedTuple):
    """Fields of a sensor whose errors are carried into views, with the covariance (c, c) in their units."""

    fields: tuple[str, ...]
    covariance: NDArray[np.float64]


def carried_errors(
    sensor: Sensor, terms: Collection[str], background: Background | None = None
) -> dict[Systematic, Carried]:
    """Return what the fields of a sensor, and a floor, leave uncertain of what a frame shows; no empty terms.

    Parameters
    ----------
    sensor : Sensor
    terms : collection of {"calibration", "recording", "declared", "multipath", "motion"}
        "declared" and "motion" are not carried by fields.
    background : Background, optional
        What is known to stand behind the landmark. Light that bounces off a floor counts where it is not modelled and
        the sensor says how wide its lamp shines.
    """
    found: dict[Systematic, Carried] = {}
    if "calibration" in terms:
        which = [
            k
            for k, name in enumerate(sensor.calibration_fields)
            if name in _STEPS or name == _OFFSET or name.startswith(LENS_FIELD)
        ]
        names = tuple(sensor.calibration_fields[k] for k in which)
        found["calibration"] = Carried(names, np.asarray(sensor.calibration_matrix[np.ix_(which, which)]))
    if "recording" in terms:
        std = {name: float(getattr(sensor, own)) for name, own in RECORDING_FIELDS.items() if getattr(sensor, own)}
        found["recording"] = Carried(tuple(std), np.diag(np.square(list(std.values()))))
    modelled = background is not None and background.bounces
    if "multipath" in terms and not modelled and sensor.lamp_half_angle_deg is not None and sensor.histogram is None:
        found["multipath"] = Carried((FLOOR_ALBEDO,), np.array([[_LARGEST_ALBEDO**2]]))
    return {name: one for name, one in found.items() if one.fields}


def supposed_floors(renderer: Renderer, views: Views, background: Background | None) -> list[Background | None]:
    """Return floors off which light may bounce unnoticed: as stated, or where the landmark stands; None above the lens.

    Parameters
    ----------
    renderer : Renderer
    views : Views
    background : Background, optional
        What is known to stand there.
    """
    known = background or Background()
    foot_m = -(views.height_m + float(renderer.topology.low[2]))
    # in steps, for many frames to share what is computed
    step = _FLOOR_STEP_M
    below_m = [0.0 if known.floor_m is None else step * round((known.floor_m - own) / step) for own in foot_m]
    floors_m = [float(own + below) for own, below in zip(foot_m, below_m, strict=True)]
    if known.wall_m is not None:
        known = replace(known, wall_m=_WALL_STEP_M * math.ceil(known.wall_m / _WALL_STEP_M))
    return [
        replace(known, floor_m=own, floor_albedo=SUPPOSED_ALBEDO, bounces="all") if own > _LOWEST_M else None
        for own in floors_m
    ]


def calibrated_slopes(
    renderer: Renderer,
    sensor: Sensor,
    views: Views,
    image: PhasorImages,
    background: Background | None,
    names: Sequence[str],
    workers: int = 1,
) -> NDArray[np.complex128]:
    """Return ∂S/∂κ of some fields, (n, c, rows, cols), in units of |S| over the unit of the field.

    The range offset is taken off measured frames, and a sensor that reports z has its ranges made with its half angles:
    what that changes in the measured phase counts with the other sign.

    Parameters
    ----------
    renderer : Renderer
        The landmark.
    sensor : Sensor
        The camera with its calibration; its optics are those of the renderer.
    views : Views
    image : PhasorImages
        What is seen at the views.
    background : Background, optional
    names : sequence of str
        The fields.
    workers : int
        Threads.
    """
    phasor = image.phasor
    out = np.empty((len(phasor), len(names), *phasor.shape[1:]), np.complex128)
    by_range = 1j * phasor / sensor.metres_per_radian
    for k, name in enumerate(names):
        if name == _OFFSET:
            out[:, k] = by_range
            continue
        if name == FLOOR_ALBEDO:
            floors = supposed_floors(renderer, views, background)
            direct = [None if own is None else replace(own, bounces=0) for own in floors]
            found, bare = (renderer.render_views(views, background=own, workers=workers) for own in (floors, direct))
            out[:, k] = (found.phasor - bare.phasor) / SUPPOSED_ALBEDO
            continue
        moved, step = _beside(renderer.sensor, name)
        there = renderer.seen_by(moved).render_views(views, background=background, workers=workers)
        out[:, k] = (there.phasor - phasor) / step
        if sensor.quantity == "z" and name.startswith(("half_angle", LENS_FIELD)):
            stretch = sensor.axis_cosine() / moved.axis_cosine() - 1
            out[:, k] -= by_range * np.nan_to_num(image.range_m) * stretch / step
    return out


def _beside(sensor: Sensor, name: str) -> tuple[Sensor, float]:
    """Return a sensor with one field a little different, and by how much: to the side where its lens does not fold."""
    if sensor.lens is not None and name.startswith(LENS_FIELD):
        step = _LENS_STEP_RAD / lens_rates(sensor.lens, sensor.rows, sensor.cols)[name.removeprefix(LENS_FIELD)]
    else:
        step = _STEPS[name]
    value = sensor.number(name)
    try:
        return sensor.with_numbers({name: value + step}), step
    except UsageError:
        return sensor.with_numbers({name: value - step}), -step


def fields_of(terms: Mapping[Systematic, Carried]) -> tuple[str, ...]:
    """Return the fields of all terms, each once."""
    return tuple(dict.fromkeys(name for one in terms.values() for name in one.fields))


def carried_covariances(
    covariance: NDArray[np.float64],
    rows: NDArray[np.float64],
    rows_of_fields: NDArray[np.float64],
    terms: Mapping[Systematic, Carried],
) -> dict[Systematic, NDArray[np.float64]]:
    """Return G C Gᵀ with G = P Jᵀ W K of each term, (n, p, p).

    Parameters
    ----------
    covariance : (n, p, p) float64
        P, of noise alone.
    rows : (n, p, residuals) float64
        Whitened Jacobian √W J by the view, transposed.
    rows_of_fields : (n, c, residuals) float64
        Whitened Jacobian √W K by :func:`fields_of` the terms, transposed.
    terms : mapping of str to Carried
    """
    pull = rows @ rows_of_fields.transpose(0, 2, 1)
    gain = covariance @ pull
    names = fields_of(terms)
    found: dict[Systematic, NDArray[np.float64]] = {}
    for term, one in terms.items():
        columns = [names.index(name) for name in one.fields]
        own = gain[:, :, columns]
        found[term] = np.asarray(own @ one.covariance @ own.transpose(0, 2, 1))
        if term == "multipath":
            way = np.einsum(
                "npc,cd,npd->n", own, one.covariance, pull[:, :, columns]
            )  # squared, in standard deviations
            found[term] = found[term] + _ASKEW**2 * way[:, None, None] * covariance
    return found
