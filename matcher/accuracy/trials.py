"""Monte Carlo of a matcher against the bound: views, frames, matches, and what follows from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark import UsageError
from phasemark.matcher.accuracy.cramer_rao import cramer_rao
from phasemark.matcher.accuracy.pose_errors import PoseReport, pose_report, views_as_poses
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.filters.kalman_filters import kalman_filter
from phasemark.matcher.filters.mean_phasor import phasor_mean
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.residuals import ResidualKind
from phasemark.matcher.match import Matches
from phasemark.matcher.statistics import (
    Interval,
    binomial_interval,
    error_statistics,
    nees,
    position_error_m,
    view_errors,
)
from phasemark.render import Background, Renderer, Sensor, Views, capture
from phasemark.render.view import delta_period_rad

_VIEWS_AT_ONCE = 250
OUTLIER_SIGMA = 5.0
"""Number of standard deviations, in any parameter, beyond which an error is an outlier and counted apart."""

MatchFrames = Callable[[FilteredFrames], Matches]


@dataclass(frozen=True)
class TrialSetup:
    """Conditions of a Monte-Carlo trial.

    Parameters
    ----------
    distance_m : (low, high)
        True distances, uniform.
    bearing_rad : float
        True bearings, uniform within ± this.
    n_frames : int
        Frames that are filtered.
    background : Background, optional
        Wall and floor; nothing stands behind the landmark without it.
    on : {"ranges", "phasors"}
        On phasors frames are taken without a validity threshold and averaged coherently: a threshold would let only
        the brighter ones of a weak pixel count.
    free : tuple of str
        What the matcher estimates, for the bound.
    height_m, pitch_rad, roll_rad : float
        True heights and tilts, uniform within ± these.
    nuisances : tuple of str, optional
        See :func:`~phasemark.matcher.accuracy.cramer_rao.cramer_rao`.
    """

    distance_m: tuple[float, float] = (0.8, 1.6)
    bearing_rad: float = 0.0
    n_frames: int = 50
    background: Background | None = None
    on: ResidualKind = "ranges"
    free: tuple[str, ...] = VIEW[:2]
    nuisances: tuple[str, ...] | None = None
    height_m: float = 0.0
    pitch_rad: float = 0.0
    roll_rad: float = 0.0

    def views(self, n: int, rng: np.random.Generator, delta_period_rad: float) -> Views:
        """Draw true views, uniform, off the grid."""
        return Views.broadcast(
            rng.uniform(*self.distance_m, n),
            rng.uniform(0, delta_period_rad, n),
            rng.uniform(-1, 1, n) * self.bearing_rad,
            # a level camera's draws are not followed by others
            *(
                rng.uniform(-1, 1, n) * width if width else 0.0
                for width in (self.height_m, self.pitch_rad, self.roll_rad)
            ),
        )


@dataclass(frozen=True, eq=False)
class Trials:
    """Errors, bounds and covariances of n matched frames.

    Parameters
    ----------
    class_name : (n,) object
        The true classes.
    views : Views
        The truth.
    free : tuple of str
        Names of the parameters that are estimated.
    error : (n, p) float64
        Estimate less truth, δ wrapped by the symmetry; NaN where no landmark was found.
    bound : (n, p, p) float64
        Cramér–Rao bound at the truth.
    covariance : (n, p, p) float64
        As the matcher has it; NaN where it has none.
    found : (n,) object
        Class names found.
    accepted : (n,) bool
        Whether the test of the fit accepts the match.
    p_value : (n,) float64
        p-value of the fit.
    """

    class_name: NDArray[np.object_]
    views: Views
    free: tuple[str, ...]
    error: NDArray[np.float64]
    bound: NDArray[np.float64]
    covariance: NDArray[np.float64]
    found: NDArray[np.object_]
    accepted: NDArray[np.bool_]
    p_value: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.error)

    @property
    def bound_std(self) -> NDArray[np.float64]:
        """Bound on the standard deviations, (n, p)."""
        return np.asarray(np.sqrt(np.einsum("npp->np", self.bound)))

    @property
    def scaled(self) -> NDArray[np.float64]:
        """Errors in units of the bound, (n, p)."""
        return np.asarray(self.error / self.bound_std)

    @property
    def class_right(self) -> NDArray[np.bool_]:
        """Whether the class is the true one, (n,)."""
        return np.asarray(self.found == self.class_name, np.bool_)

    @property
    def position_error_m(self) -> NDArray[np.float64]:
        """Distance of the lens from its true place, (n,), of trials whose first parameters are D and δ."""
        true_m = self.views.distance_m
        return position_error_m(true_m + self.error[:, 0], true_m, self.error[:, 1])

    @property
    def position_bound_m(self) -> NDArray[np.float64]:
        """Root of the trace of the bound on the lens's position in the plane, (n,)."""
        return np.asarray(np.sqrt(self.bound[:, 0, 0] + self.views.distance_m**2 * self.bound[:, 1, 1]))

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Which trials found a view, and have a bound; (n,)."""
        return np.asarray(np.isfinite(self.scaled).all(axis=1))

    @property
    def outlier(self) -> NDArray[np.bool_]:
        """Errors beyond 5 σ of the bound, or of the matcher's own covariance in any direction, or no view, (n,)."""
        with np.errstate(invalid="ignore"):
            own = np.abs(self.error) > OUTLIER_SIGMA * np.sqrt(np.einsum("npp->np", self.covariance))
            limit = special.chdtri(len(self.free), 2 * special.ndtr(-OUTLIER_SIGMA))
            improbable = nees(self.error, self.covariance) > limit
        return np.asarray(self.astray | own.any(axis=1) | improbable)

    @property
    def astray(self) -> NDArray[np.bool_]:
        """Errors beyond 5 σ of the bound, or no view at all, (n,)."""
        with np.errstate(invalid="ignore"):
            far = np.abs(self.scaled) > OUTLIER_SIGMA
        return np.asarray(far.any(axis=1) | ~self.usable)

    @classmethod
    def joined(cls, parts: Sequence[Trials]) -> Trials:
        """Put runs behind one another."""
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("class_name", "error", "bound", "covariance", "found", "accepted", "p_value")
        }
        arrays["views"] = Views(*(np.concatenate([getattr(part.views, name) for part in parts]) for name in VIEW))
        return replace(parts[0], **arrays)

    def summary(self) -> TrialSummary:
        """Return the figures a matcher is judged by."""
        inner, std = ~self.outlier, self.bound_std
        found = error_statistics(
            self.error[inner], self.free, bound_std=std[inner], covariance=self.covariance[inner], law="normal"
        )
        with_outliers = error_statistics(self.error[self.usable], self.free, bound_std=std[self.usable], law="normal")
        return TrialSummary(
            n=len(self),
            ratio=dict(found.ratio),
            ratio_with_outliers=dict(with_outliers.ratio),
            bias=dict(found.bias_over_bound),
            nees=found.nees,
            coverage=found.coverage[0.95],
            outliers=binomial_interval(int((~inner).sum()), len(self)),
            astray=binomial_interval(int(self.astray.sum()), len(self)),
            class_errors=binomial_interval(int((~self.class_right).sum()), len(self)),
            accepted=binomial_interval(int(self.accepted.sum()), len(self)),
        )

    def pose_report(self, symmetry: int = 1) -> PoseReport:
        """Return the errors of the poses in the terms of ASTM E2919; what is not free counts as known.

        Parameters
        ----------
        symmetry : int
            Of the landmark.
        """
        estimates = {name: np.array(getattr(self.views, name)) for name in VIEW}
        for k, name in enumerate(self.free):
            estimates[name] += self.error[:, k]
        measured = np.full((len(self), 4, 4), np.nan)
        found = np.flatnonzero(np.isfinite(self.error).all(axis=1) & self.accepted)
        if found.size:
            measured[found] = views_as_poses(Views(**{name: values[found] for name, values in estimates.items()}))
        return pose_report(measured, self.views, symmetry=symmetry)


@dataclass(frozen=True)
class TrialSummary:
    """Figures of a run, each with its 95 % interval.

    Parameters
    ----------
    n : int
        Number of trials.
    ratio : dict of str to Interval
        √mean(e²/CRLB²) without outliers, by parameter.
    ratio_with_outliers : dict of str to Interval
        RMSE over the bound of each parameter, outliers included.
    bias : dict of str to Interval
        Mean error in units of the bound.
    nees : Interval
        Mean eᵀP⁻¹e over the number of parameters.
    coverage : Interval
        Share of errors inside the 95 % ellipsoid.
    outliers : Interval
        Share of errors beyond 5 σ of the bound or of the match's own covariance.
    astray : Interval
        Share of errors beyond 5 σ of the bound.
    class_errors : Interval
        Share of frames whose class was wrong.
    accepted : Interval
        Share of frames whose answer was accepted.
    """

    n: int
    ratio: dict[str, Interval]
    ratio_with_outliers: dict[str, Interval]
    bias: dict[str, Interval]
    nees: Interval
    coverage: Interval
    outliers: Interval
    astray: Interval
    class_errors: Interval
    accepted: Interval

    def rows(self) -> list[tuple[str, str]]:
        """Return label and figure, for a table."""
        return [
            ("trials", str(self.n)),
            *((f"ratio {name}", str(value)) for name, value in self.ratio.items()),
            *((f"ratio {name}, outliers in", str(value)) for name, value in self.ratio_with_outliers.items()),
            *((f"bias {name}", str(value)) for name, value in self.bias.items()),
            ("NEES / p", str(self.nees)),
            ("95 % coverage", str(self.coverage)),
            ("outliers", str(self.outliers)),
            ("beyond 5 σ of the bound", str(self.astray)),
            ("class errors", str(self.class_errors)),
            ("accepted", str(self.accepted)),
        ]


def noisy_frames(
    renderer: Renderer, sensor: Sensor, views: Views, setup: TrialSetup, rng: np.random.Generator, *, workers: int = 1
) -> FilteredFrames:
    """Render views, take frames and filter them."""
    image = renderer.render_views(views, background=setup.background, workers=workers)
    if setup.on == "phasors":
        free = sensor.with_(max_phase_std_rad=None)
        return phasor_mean(capture(image, free, rng=rng, n_frames=setup.n_frames, workers=workers))
    return kalman_filter(capture(image, sensor, rng=rng, n_frames=setup.n_frames, workers=workers))


def run_trials(
    match: MatchFrames,
    renderer: Renderer,
    class_name: str,
    setup: TrialSetup,
    n: int,
    rng: np.random.Generator,
    *,
    symmetry: int = 2,
    choose: Callable[[NDArray[np.float64]], NDArray[np.bool_]] | None = None,
    workers: int = 1,
) -> Trials:
    """Try a matcher on n random views of a landmark.

    Parameters
    ----------
    match : callable
        From filtered frames to matches, ``Matcher(...).match`` for one.
    renderer : Renderer
        What the frames are made with: the truth.
    class_name : str
        What the matcher calls it.
    setup : TrialSetup
        What the trials have in common.
    n : int
        Number of trials.
    rng : numpy.random.Generator
        Source of the random numbers.
    symmetry : int
        Of the landmark.
    choose : callable, optional
        Which views count, from their bounds (k, p, p) to (k,) bool: a condition on what can be known.
    workers : int
        Threads.

    Returns
    -------
    Trials

    Raises
    ------
    UsageError
        The matcher estimates other parameters than the setup says.
    """
    parts: list[Trials] = []
    done = 0
    while done < n:
        views = setup.views(min(_VIEWS_AT_ONCE, n - done), rng, delta_period_rad(symmetry))
        bound = cramer_rao(
            renderer, views, free=setup.free, n_frames=setup.n_frames, on=setup.on, background=setup.background,
            nuisances=setup.nuisances, workers=workers,
        ).covariance  # fmt: skip
        if choose is not None:
            keep = np.flatnonzero(choose(bound))
            views, bound = views[keep], bound[keep]
        if not len(views):
            continue
        matches = match(noisy_frames(renderer, renderer.sensor, views, setup, rng, workers=workers))
        parts.append(judged(matches, class_name, views, bound, setup.free, symmetry))
        done += len(views)
    return Trials.joined(parts)


def judged(
    matches: Matches, class_name: str, views: Views, bound: NDArray[np.float64], free: tuple[str, ...], symmetry: int
) -> Trials:
    """Compare matches of a landmark with the views that its frames were taken from.

    Raises
    ------
    UsageError
        The matcher estimates other parameters than `free`.
    """
    covariance = matches.covariance
    if covariance is not None and matches.free != free:
        raise UsageError(f"the matcher estimates {', '.join(matches.free)}, and 'free' of the setup is {free!r}")
    return Trials(
        class_name=np.full(len(views), class_name, object),
        views=views,
        free=free,
        error=view_errors(matches, views, free, delta_period_rad(symmetry)),
        bound=bound,
        covariance=np.full(bound.shape, np.nan) if covariance is None else covariance,
        found=matches.class_name,
        accepted=matches.accepted,
        p_value=matches.p_value,
    )
