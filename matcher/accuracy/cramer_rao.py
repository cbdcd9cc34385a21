"""Best possible accuracy: Fisher information, Cramér–Rao bounds and class confusion.

All bounds are those of PHYSICS section 7, for Gaussian residuals with the variance of the noise law: say of every
number which pixels count, whether ranges or phasors are measured, what is free, and what stands behind the landmark.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.matcher.information import covariance_of, eliminated
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.systematic import (
    calibrated_slopes,
    carried_covariances,
    carried_errors,
    check_systematic,
    declared_covariance,
    fields_of,
)
from phasemark.matcher.one_frequency import OneFrequency, OneFrequencyRenderer
from phasemark.matcher.pixel_agreement import counts, pixel_mask
from phasemark.render import Background, PhasorImages, Renderer, Sensor, Views, predicted_range_std
from phasemark.render.sensor.range_noise import phase_image_variance

if TYPE_CHECKING:
    from phasemark.matcher.likelihood.residuals import ResidualKind
    from phasemark.render.direct.histogram_images import HistogramRenderer

_WEAK_SHARE = 1e-13  # of information in metres and radians
NUISANCES = ("albedo", "wall_m", "wall_albedo")
"""What may be unknown beside the view: the landmark's albedo, the wall's distance and albedo."""


@dataclass(frozen=True, eq=False)
class Bound:
    """Information and bounds of filtered frames at n views.

    Parameters
    ----------
    free : tuple of str
        Parameters of the view, in the order of the matrices.
    information : (n, p, p) float64
        Fisher information in them, what the nuisances cost taken off.
    pixels : (n, rows, cols) bool
        Which pixels count.
    systematic : (n, p, p) float64, optional
        What the calibration of the sensor leaves, and what the sensor declares of a pose.
    """

    free: tuple[str, ...]
    information: NDArray[np.float64]
    pixels: NDArray[np.bool_]
    systematic: NDArray[np.float64] | None = None

    def __repr__(self) -> str:
        """Describe in one line the median standard deviation of each parameter."""
        words = []
        for name in self.free:
            label, unit = name.rsplit("_", 1)
            std = float(np.median(self.std(name)))
            words.append(f"{label} {math.degrees(std):.2g}°" if unit == "rad" else f"{label} {std:.2g} {unit}")
        return f"Bound({len(self.information)} views: standard deviation of {', '.join(words)})"

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Cramér–Rao bound and what is systematic, (n, p, p); NaN where a direction is not observed."""
        noise = covariance_of(self.information, weak_share=_WEAK_SHARE)
        return noise if self.systematic is None else noise + self.systematic

    def std(self, name: str) -> NDArray[np.float64]:
        """Return the bound on the standard deviation of one parameter, metres or radians, (n,)."""
        k = self.free.index(name)
        return np.sqrt(self.covariance[:, k, k])


def cramer_rao(
    renderer: Renderer | HistogramRenderer,
    views: Views,
    *,
    free: Sequence[str] = VIEW[:2],
    n_frames: ArrayLike = 50,
    on: ResidualKind = "ranges",
    pixels: str | NDArray[np.bool_] = "all",
    background: Background | None = None,
    nuisances: Sequence[str] | None = None,
    systematic: Collection[str] = (),
    workers: int = 1,
) -> Bound:
    """Return the Cramér–Rao bound at some views (PHYSICS section 7).

    Pixels count where one frame measures the range to 0.1 rad or better (0.24 m at 10 MHz). Of several modulation
    frequencies the information is the sum of that of each. A :class:`~phasemark.render.direct.HistogramRenderer` has
    the bound of histograms: the Poisson information, with the brightness of landmark, wall and floor and the ambient
    light of every zone unknown.

    Parameters
    ----------
    renderer : Renderer or HistogramRenderer
        The landmark and the camera.
    views : Views
        Views of the landmark.
    free : sequence of str
        Parameters of the view to be estimated; the others are known.
    n_frames : array_like
        Frames that were averaged; broadcasts against (n, rows, cols).
    on : {"ranges", "phasors"}
        What is compared: ranges, or phasors with the albedo unknown.
    pixels : {"all", "lower"} or (rows, cols) or (n, rows, cols) bool
        Which pixels may count: "lower" the lower half of the rows; an array is taken as it is.
    background : Background, optional
        Wall and floor; nothing stands behind the landmark without it.
    nuisances : sequence of str, optional
        Which of :data:`NUISANCES` are unknown too; None: the albedo on phasors, and on ranges where `background` has
        an `albedo_ratio_std`, which is then known before. Of histograms "wall_m" alone can be named, for brightness is
        unknown anyway.
    systematic : collection of {"calibration", "recording", "declared"}
        Which errors of the sensor that all frames share are added: what its calibration leaves, what differs in another
        recording, and what it declares.
    workers : int
        Threads.

    Returns
    -------
    Bound

    Raises
    ------
    UsageError
        A name is unknown, a wall is a nuisance where there is none, or a number of frames is not positive.

    Examples
    --------
    >>> from phasemark.landmarks import build_mesh, catalog
    >>> from phasemark.render import Renderer, Views, preset
    >>> renderer = Renderer(build_mesh(catalog()["cylinder"]), preset("pmd-16x16"))
    >>> bound = cramer_rao(renderer, Views.broadcast(1.0, 0.5), pixels="lower")
    >>> [round(float(bound.std(name)[0]), 5) for name in bound.free]
    [0.00036, 0.00531]
    """
    if not isinstance(views, Views):
        raise UsageError(f"'views' must be Views, got {type(views).__name__}: Views.broadcast makes them of numbers")
    counted = np.asarray(n_frames, np.float64)
    if not np.all(counted > 0 if counted.ndim == 0 else counted >= 0):
        raise UsageError(f"'n_frames' must be at least 1, got {counted.min():g}")
    if not isinstance(renderer, Renderer):
        if on != "ranges" or pixels != "all" or not set(nuisances or ()) <= {"wall_m"}:
            raise UsageError(
                "of histograms all zones count, and brightness and ambient light are unknown: leave 'on' and 'pixels'"
                " out, and name nothing but wall_m in 'nuisances'"
            )
        _check_free(free)
        _check_wall(nuisances or (), background)
        from phasemark.matcher.accuracy.histogram_bound import histogram_information  # direct sensors alone need it

        information = histogram_information(
            renderer, views, free, n_frames, workers, background=background, free_wall=bool(nuisances)
        )
        everywhere = np.ones((len(views), renderer.sensor.rows, renderer.sensor.cols), np.bool_)
        declared = None
        if "declared" in check_systematic(systematic):
            declared = np.broadcast_to(declared_covariance(renderer.sensor, free), information.shape)
        return Bound(tuple(free), information, everywhere, declared)
    if on not in ("ranges", "phasors"):
        raise UsageError(
            f"'on' must be 'ranges' or 'phasors', got {on!r}: a HistogramRenderer has the bound of histograms"
        )
    known_std = background.albedo_ratio_std if on == "ranges" and background is not None else 0.0
    nuisances = (("albedo",) if on == "phasors" or known_std else ()) if nuisances is None else tuple(nuisances)
    for name in nuisances:
        if name not in NUISANCES:
            raise UsageError(f"'nuisances' must be among {', '.join(NUISANCES)}, got {name!r}")
    _check_free(free)
    _check_wall(nuisances, background)
    one = None
    if len(renderer.sensor.frequencies_hz) > 1:
        one = OneFrequency(renderer.sensor, "stacked")
        renderer = OneFrequencyRenderer(renderer, one)
        if terms := carried_errors(one.camera, systematic):
            raise UsageError(f'systematic="{next(iter(terms))}" takes a sensor of one modulation frequency')
    sensor = renderer.sensor
    image, slope = image_and_slopes(renderer, views, free, background, workers)
    columns = [slope]
    if nuisances:
        alone = renderer.render_views(views, workers=workers).phasor if background else image.phasor
        wall_step_m = 1e-4
        for name in nuisances:
            if name == "albedo":
                columns.append(alone[:, None])
            elif name == "wall_albedo":
                assert background is not None
                columns.append(((image.phasor - alone) / background.wall_albedo)[:, None])
            else:
                assert background is not None
                walls = background.moved_walls(wall_step_m)
                sides = [renderer.render_views(views, background=own, workers=workers).phasor for own in walls]
                columns.append(((sides[0] - sides[1]) / (2 * wall_step_m))[:, None])
    mask = pixel_mask(pixels, sensor if one is None else one.camera)
    if one is not None:
        mask = one.same_for_all(mask)
        if np.ndim(n_frames) > 1:
            n_frames = one.same_for_all(np.asarray(n_frames, np.float64))
    use = np.broadcast_to(mask, image.phasor.shape) & (image.phasor != 0)
    if isinstance(pixels, str):
        use = use & counts(image.phasor, image.intensity, sensor)
    frames = np.broadcast_to(np.asarray(n_frames, np.float64), image.phasor.shape)
    rows = whitened_slopes(image.phasor, image.intensity, np.concatenate(columns, axis=1), use, frames, on, sensor)
    everything = rows @ rows.transpose(0, 2, 1)
    if known_std and "albedo" in nuisances:
        place = len(free) + nuisances.index("albedo")
        everything[:, place, place] += known_std**-2.0
    information = eliminated(everything, len(free))
    common = None
    if chosen := check_systematic(systematic):
        common = np.zeros(information.shape)
        if "declared" in chosen:
            common += declared_covariance(sensor, free)
        if terms := carried_errors(sensor, chosen):
            by_fields = calibrated_slopes(renderer, sensor, views, image, background, fields_of(terms), workers)
            whitened = whitened_slopes(image.phasor, image.intensity, by_fields, use, frames, on, sensor)
            # nuisances included: they take up part of an error
            known = np.nan_to_num(covariance_of(everything, weak_share=_WEAK_SHARE))
            p = len(free)
            common += sum(part[:, :p, :p] for part in carried_covariances(known, rows, whitened, terms).values())
    if one is not None:
        use = one.layers(use).any(axis=-3)
    return Bound(tuple(free), information, use, common)


def _check_free(free: Sequence[str]) -> None:
    """Refuse parameters that are unknown or repeated."""
    if not free or any(name not in VIEW for name in free) or len(set(free)) < len(free):
        raise UsageError(f"'free' must name some of {', '.join(VIEW)} once each, got {tuple(free)!r}")


def _check_wall(nuisances: Sequence[str], background: Background | None) -> None:
    """Refuse a wall among the nuisances where there is none."""
    if (background is None or background.wall_m is None) and set(nuisances) & {"wall_m", "wall_albedo"}:
        raise UsageError("a wall can be a nuisance only where there is one: give 'background' a wall")


def image_and_slopes(
    renderer: Renderer, views: Views, free: Sequence[str], background: Background | None, workers: int
) -> tuple[PhasorImages, NDArray[np.complex128]]:
    """Return the images of views and their slopes; height, with its kink at 0, is differenced."""
    smooth = [name for name in free if name != "height_m"]
    if not smooth:
        image, slope = renderer.render_views(views, background=background, workers=workers), None
    else:
        image, slope = renderer.render_with_slopes(views, smooth, background=background, workers=workers)
    if slope is not None and len(smooth) == len(free):
        return image, slope
    by_height = renderer.jacobian(
        *(getattr(views, name) for name in VIEW), background=background, parameters=("height_m",), workers=workers
    )
    parts = {"height_m": by_height[:, 0]}
    if slope is not None:
        parts |= {name: slope[:, k] for k, name in enumerate(smooth)}
    return image, np.stack([parts[name] for name in free], axis=1)


def whitened_slopes(
    phasor: NDArray[np.complex128],
    intensity: NDArray[np.float64],
    slope: NDArray[np.complex128],
    use: NDArray[np.bool_],
    n_frames: NDArray[np.float64],
    on: ResidualKind,
    sensor: Sensor,
) -> NDArray[np.float64]:
    """Return the whitened Jacobian, (n, q, residuals)."""
    n, q = slope.shape[:2]
    s = np.where(use, phasor, 1.0)
    if on == "ranges":
        std = np.where(use, predicted_range_std(np.abs(s), intensity, sensor), 1.0) / np.sqrt(n_frames)
        change = sensor.metres_per_radian * (s.conj()[:, None] * slope).imag / (np.abs(s) ** 2)[:, None]
        return np.asarray(np.where(use[:, None], change / std[:, None], 0.0).reshape(n, q, -1))
    unit = sensor.contrast * sensor.signal_e
    intensity_e = sensor.signal_e * intensity + sensor.ambient_e + sensor.dark_e
    std = np.sqrt(phase_image_variance(intensity_e, sensor) / (2 * n_frames)) / unit
    change = np.where(use[:, None], slope / np.where(use, std, 1.0)[:, None], 0.0)
    return np.concatenate([change.real.reshape(n, q, -1), change.imag.reshape(n, q, -1)], axis=2)


def confusion_probability(distance_squared: ArrayLike) -> NDArray[np.float64]:
    """Return Σ Q(d/2) over the last axis: a bound on how often another class explains a frame better.

    Parameters
    ----------
    distance_squared : (..., k) array_like
        d², the whitened squared distance of the noise-free frame from the nearest image of each other class, over all
        its views: what a matcher reports as cost on frames without noise.
    """
    from scipy import special  # takes a fifth of a second

    d = np.sqrt(np.asarray(distance_squared, np.float64))
    return np.asarray(special.ndtr(-d / 2).sum(axis=-1))
