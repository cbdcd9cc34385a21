"""Accuracy at a glance: what a landmark before a camera gives, from the Cramér–Rao bound, and what limits it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data.files.json_text import finite_or_none
from phasemark.matcher.accuracy.appearance import class_distances_squared
from phasemark.matcher.accuracy.cramer_rao import confusion_probability, cramer_rao, image_and_slopes, whitened_slopes
from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.systematic import (
    FLOOR_ALBEDO,
    SUPPOSED_ALBEDO,
    calibrated_slopes,
    carried_errors,
    supposed_floors,
)
from phasemark.matcher.match import named_in_degrees, scale_of_degrees
from phasemark.matcher.pixel_agreement import counts
from phasemark.render import Background, Renderer, Views, predicted_range_std

EDGES, FACES = "noise of edge pixels", "noise of face pixels"
CALIBRATION, RECORDING = "calibration of the sensor", "what differs from one recording to the next"
DECLARED = "systematic errors declared by the sensor"
SOURCES = (EDGES, FACES, CALIBRATION, RECORDING, DECLARED)
"""What the variance of a pose comes from. An edge pixel is covered by the landmark in part."""
_SYMBOLS = dict(zip(VIEW, ("D", "δ", "bearing", "height", "pitch", "roll"), strict=True))
_WEAK_SHARE = 1e-13
_WHOLE = 1e-6  # of a pixel: coverage is exact but for rounding
_SIDES, _SIDES_WITH_BOUNCES = 12, 4


@dataclass(frozen=True, eq=False)
class MultipathShift:
    """The shift of an estimate by light that bounces off a floor, where the model has it not.

    Parameters
    ----------
    floor_albedo : float
    floor_m : float
        Height of the lens above the floor.
    free : tuple of str
        Parameters of the view that are estimated.
    shift : (p,) float64
        Metres and radians; what is estimated less what is true.
    """

    floor_albedo: float
    floor_m: float
    free: tuple[str, ...]
    shift: NDArray[np.float64]

    def __str__(self) -> str:
        """Say it in one line; angles and shifts that round to nothing are left out."""
        words = []
        for name, value in zip(self.free, self.shift.tolist(), strict=True):
            in_metres = name.endswith("_m")
            text = f"{1e3 * value:+.1f} mm" if in_metres else f"{math.degrees(value):+.2f}°"
            if name == "distance_m" or any(digit in text for digit in "123456789"):
                words.append(f"{_SYMBOLS[name]} by {text}")
        return (
            f"multipath is off: a floor of albedo {self.floor_albedo:g}, {self.floor_m:.2f} m below the lens, moves"
            f" {', '.join(words)}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain numbers for JSON, angles in degrees."""
        unit = [scale_of_degrees(name) for name in self.free]
        shift = dict(zip(map(named_in_degrees, self.free), (self.shift * unit).tolist(), strict=True))
        return {"floor_albedo": self.floor_albedo, "floor_m": self.floor_m, "shift": shift}


def multipath_shift(
    renderer: Renderer, views: Views, *, free: Sequence[str] = VIEW[:3], background: Background | None = None
) -> MultipathShift | None:
    """Return how far off an estimate is where light bounces off a floor and the model has it not, to first order.

    With ΔS what bounces add to the light, that is P Jᵀ W ΔS on ranges. A floor that is not stated is supposed to be
    where the landmark stands.

    Parameters
    ----------
    renderer : Renderer
        The landmark and the camera.
    views : Views
        n views; that at which distance moves most is told.
    free : sequence of str
        Parameters that are estimated, distance_m first.
    background : Background, optional
        Wall and floor that are modelled.

    Returns
    -------
    MultipathShift or None
        None where bounces are modelled, where the sensor does not say how wide its lamp shines, and where no floor is
        below the lens or no view is observed.
    """
    sensor = renderer.sensor
    if len(sensor.frequencies_hz) > 1 or "multipath" not in carried_errors(sensor, ("multipath",), background):
        return None
    floors = supposed_floors(renderer, views, background)
    image, slope = image_and_slopes(renderer, views, free, background, 1)
    albedo = SUPPOSED_ALBEDO
    if background is not None and background.floor_m is not None:
        albedo = background.floor_albedo
    bounced = albedo * calibrated_slopes(renderer, sensor, views, image, background, (FLOOR_ALBEDO,))
    use = (image.phasor != 0) & counts(image.phasor, image.intensity, sensor)
    rows, extra = (
        whitened_slopes(image.phasor, image.intensity, change, use, np.ones(use.shape), "ranges", sensor)
        for change in (slope, bounced)
    )
    inverse = covariance_of(rows @ rows.transpose(0, 2, 1))
    shift = (inverse @ (rows @ extra.transpose(0, 2, 1)))[:, :, 0]
    told = [
        MultipathShift(albedo, floor.floor_m, tuple(free), own)
        for floor, own in zip(floors, shift, strict=True)
        if floor is not None and floor.floor_m is not None and np.isfinite(own).all()
    ]
    return max(told, key=lambda one: abs(float(one.shift[0])), default=None)


@dataclass(frozen=True, eq=False)
class AccuracyCard:
    """Best possible accuracy of one measurement at n views.

    Parameters
    ----------
    views : Views
        Views of the landmark.
    free : tuple of str
        Parameters of the view that are estimated, in the order of the matrices.
    n_frames : int
        Frames averaged for one measurement.
    parts : dict of str to (n, p, p) float64
        Covariance from each of :data:`SOURCES`, metres and radians; NaN where a view is not observed.
    class_error : (n,) float64
        Union bound on the probability of a wrong class; NaN if there is no other class.
    others : tuple of str
        The classes that it is a bound for.
    multipath : MultipathShift, optional
        What light that bounces off a floor does where it is not modelled; None where that is not known.
    """

    views: Views
    free: tuple[str, ...]
    n_frames: int
    parts: dict[str, NDArray[np.float64]]
    class_error: NDArray[np.float64]
    others: tuple[str, ...] = field(default=())
    multipath: MultipathShift | None = None

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Sum of the parts, (n, p, p)."""
        return np.asarray(sum(self.parts.values()))

    def std(self, name: str) -> NDArray[np.float64]:
        """Return the standard deviation of one free parameter, metres or radians, (n,)."""
        k = self.free.index(name)
        return np.sqrt(self.covariance[:, k, k])

    @property
    def position_std_m(self) -> NDArray[np.float64]:
        """Of the lens in the plane, √(σ_D² + D² σ_δ²), (n,)."""
        return np.sqrt(self._position_variance(self.covariance))

    def shares(self) -> dict[str, float]:
        """Return the share of each source in the variance of the position: the mean over the observed views."""
        total = self._position_variance(self.covariance)
        known = np.isfinite(total)
        if not known.any():
            return {}
        variances = {name: self._position_variance(part)[known] for name, part in self.parts.items()}
        return {name: float(np.mean(variance / total[known])) for name, variance in variances.items()}

    @property
    def dominant(self) -> str | None:
        """The source with the largest share; None if no view is observed."""
        shares = self.shares()
        return max(shares, key=lambda name: shares[name]) if shares else None

    def _position_variance(self, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
        along, across = (self.free.index(name) for name in VIEW[:2])
        return np.asarray(covariance[:, along, along] + self.views.distance_m**2 * covariance[:, across, across])

    def line(self) -> str:
        """Summarise it in one line: medians over the views, the worst position, class error, dominant source."""
        shares, n = self.shares(), len(self.views)
        if not shares:
            return f"{self._where()}: the view is not observed: too few pixels are measured to 0.1 rad"
        numbers = (
            f"D {_written(1e3 * _median(self.std('distance_m')))} mm,"
            f" δ {_written(math.degrees(_median(self.std('delta_rad'))))}°,"
            f" position {_written(1e3 * _median(self.position_std_m))} mm"
        )
        over = "1 σ"
        if n > 1:
            worst = float(np.nanmax(self.position_std_m))
            over += f", median of {n} views; worst position {_written(1e3 * worst)} mm"
        blind = int(np.isnan(self.position_std_m).sum())
        unseen = f", {blind} of {n} views not observed" if blind else ""
        error = _median(self.class_error)
        percent = "below 0.01 %" if error < 1e-4 else f"{_written(100 * error)} %"
        classes = "" if math.isnan(error) else f"; class error {percent}"
        return (
            f"{self._where()}: {numbers} ({over}{unseen}){classes};"
            f" {self.dominant} dominates ({100 * shares[self.dominant or '']:.0f} % of the position's variance)"
            f"{'' if self.multipath is None else f'; {self.multipath}'}"
        )

    def _where(self) -> str:
        distances, sides = np.unique(self.views.distance_m), np.degrees(np.unique(self.views.delta_rad))
        distance = " … ".join(f"{one:g}" for one in dict.fromkeys((distances[0], distances[-1])))
        side = " … ".join(f"{one:g}" for one in dict.fromkeys((round(sides[0], 3), round(sides[-1], 3))))
        return f"at {distance} m, δ {side}°, {self.n_frames} frame{'s' * (self.n_frames > 1)}"

    def as_dict(self) -> dict[str, Any]:
        """Return medians over the views, the worst position, and the shares as plain numbers for JSON."""
        names = {"distance_m": "distance_std_m", "delta_rad": "delta_std_deg", "bearing_rad": "bearing_std_deg"}
        std = {
            named: _median(np.degrees(self.std(name)) if name.endswith("rad") else self.std(name))
            for name, named in names.items()
            if name in self.free
        }
        position, distance_m, delta_deg = self.position_std_m, self.views.distance_m, np.degrees(self.views.delta_rad)
        facts = {
            "distance_m": [float(distance_m.min()), float(distance_m.max())],
            "delta_deg": [float(delta_deg.min()), float(delta_deg.max())],
            "views": len(self.views),
            "views_observed": int(np.isfinite(position).sum()),
            "n_frames": self.n_frames,
            "free": [named_in_degrees(name) for name in self.free],
            **std,
            "position_std_m": _median(position),
            "worst_position_std_m": float(np.fmax.reduce(position)),
            "class_error": _median(self.class_error),
            "other_classes": list(self.others),
            "dominant": self.dominant,
            "shares": self.shares(),
            "multipath": None if self.multipath is None else self.multipath.as_dict(),
        }
        return finite_or_none(facts)


def sides_of(distance_m: float, period_rad: float, n: int = _SIDES) -> Views:
    """Return views of one distance from n sides, evenly over one period of δ.

    Parameters
    ----------
    distance_m : float
        Distance D, metres.
    period_rad : float
        After which the landmark looks the same.
    n : int
        Number of sides.

    Returns
    -------
    Views
    """
    return Views.broadcast(distance_m, np.arange(n) * (period_rad / n))


def accuracy_card(
    renderer: Renderer,
    views: Views,
    *,
    others: Mapping[str, Renderer] | None = None,
    n_frames: int = 50,
    free: Sequence[str] = VIEW[:3],
    background: Background | None = None,
) -> AccuracyCard:
    """Return what a measurement can tell at best at some views, and what limits it.

    Standard deviations are the Cramér–Rao bound on ranges (PHYSICS section 7), what the calibration of the sensor
    leaves, and what the sensor declares. With P the covariance of the noise and I_e the information of the edge pixels,
    P I_e P is the contribution of the noise of edge pixels. Where the sensor says how wide its lamp shines, the
    shift by light that bounces off a floor and is not modelled is told, for up to four of the views.

    Parameters
    ----------
    renderer : Renderer
        The landmark and the camera.
    views : Views
        Views of the landmark.
    others : mapping of str to Renderer, optional
        Other classes before the same camera, for the class error.
    n_frames : int
        Frames averaged for one measurement.
    free : sequence of str
        Parameters that are estimated, distance_m and delta_rad among them.
    background : Background, optional
        Wall and floor; nothing stands behind the landmark without it.

    Returns
    -------
    AccuracyCard

    Raises
    ------
    UsageError
        `n_frames` is below 1, `free` lacks distance_m or delta_rad, or the sensor has no noise.

    Examples
    --------
    >>> from phasemark.landmarks import build_mesh, catalog
    >>> from phasemark.render import Renderer, Views, preset
    >>> renderer = Renderer(build_mesh(catalog()["cylinder"]), preset("pmd-16x16"))
    >>> accuracy_card(renderer, Views.broadcast(1.5, 0.5)).dominant
    'noise of face pixels'
    """
    if n_frames < 1:
        raise UsageError(f"'n_frames' must be at least 1, got {n_frames}")
    if not set(VIEW[:2]) <= set(free):
        raise UsageError(f"'free' must have {' and '.join(VIEW[:2])} among its names, got {tuple(free)!r}")
    if not predicted_range_std(1.0, 1.0, renderer.sensor) > 0:
        raise UsageError("the sensor has no noise, so that there is no bound: set its 'shot_noise'")
    others = dict(others or {})

    bound = partial(cramer_rao, renderer, views, free=free, n_frames=n_frames, background=background)
    shared = [bound(systematic=(term,)) for term in ("calibration", "recording", "declared")]
    declared = shared[-1]
    noise = covariance_of(declared.information, weak_share=_WEAK_SHARE)
    coverage = renderer.render_views(views, background=background).coverage
    edge = (coverage > _WHOLE) & (coverage < 1 - _WHOLE)
    of_edges = noise @ bound(pixels=declared.pixels & edge).information @ noise
    common = [np.zeros_like(noise) if one.systematic is None else one.systematic for one in shared]
    parts = dict(zip(SOURCES, (of_edges, noise - of_edges, *common), strict=True))
    error = np.full(len(views), np.nan)
    if others:
        squares = class_distances_squared(renderer, views, others, n_frames=n_frames, background=background)
        error = np.minimum(confusion_probability(squares), 1.0)
    few = views[:: math.ceil(len(views) / _SIDES_WITH_BOUNCES)]  # light that bounces takes half a second a view
    multipath = multipath_shift(renderer, few, free=free, background=background)
    return AccuracyCard(views, tuple(free), n_frames, parts, error, tuple(others), multipath)


def _median(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan


def _written(value: float) -> str:
    """Write a number with two digits that count."""
    return f"{float(f'{value:.2g}'):g}"
