"""Errors that all frames of a camera share, added to the covariances of answers."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.estimate.acceptance import with_part, with_parts
from phasemark.matcher.filters.stamps import spread_stamps
from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.residuals import STRANGE_SIGMA, Evidence, range_residuals, range_slopes
from phasemark.matcher.likelihood.scenes import Scenes
from phasemark.matcher.likelihood.setup import Setup
from phasemark.matcher.likelihood.systematic import (
    Carried,
    Systematic,
    calibrated_slopes,
    carried_covariances,
    carried_errors,
    declared_covariance,
    fields_of,
    rates_of_views,
)
from phasemark.matcher.match import Match, views_of
from phasemark.matcher.pixel_agreement import counts
from phasemark.render import Renderer
from phasemark.render.view import delta_period_rad

__all__ = ["with_motion", "with_shared_errors"]


def with_shared_errors(
    setup: Setup, scenes: Scenes, systematic: Collection[Systematic], evidence: Evidence, answers: list[Match]
) -> list[Match]:
    """Add what the calibration of a sensor leaves, what differs in another recording, and what the sensor declares.

    Parameters
    ----------
    setup : Setup
    scenes : Scenes
        They have what renders the landmarks, where a calibration has to be carried into a view.
    systematic : collection of {"calibration", "recording", "declared", "multipath", "motion"}
    evidence : Evidence
    answers : list of Match
        One for each frame; refused as "undetermined" where they no longer are within the tolerance.
    """
    parts: list[dict[str, NDArray[np.float64]]] = [{} for _ in answers]
    known = [k for k, match in enumerate(answers) if match.covariance is not None and match.class_name is not None]
    declared = declared_covariance(evidence.sensor, setup.free)
    if "declared" in systematic and declared.any():
        for k in known:
            parts[k]["declared"] = declared
    known_behind = answers[known[0]].background if known else None
    if terms := carried_errors(evidence.sensor, systematic, known_behind):
        for c, name in enumerate(setup.rules.names):
            own = [k for k in known if answers[k].class_name == name]
            for accepted in (True, False):  # how light bounces takes long to find out
                which = [k for k in own if answers[k].accepted == accepted]
                some = {term: one for term, one in terms.items() if accepted or term != "multipath"}
                if which and some:
                    renderer, matches = scenes.rendered.renderer(c), [answers[k] for k in which]
                    carried = _carried(setup, renderer, evidence[np.array(which)], matches, some)
                    for term, of_frames in carried.items():
                        for k, part in zip(which, of_frames, strict=True):
                            parts[k][term] = part
    return [with_parts(setup.rules, match, part) if part else match for match, part in zip(answers, parts, strict=True)]


def with_motion(
    free: tuple[str, ...], jitter_s: float, time_s: NDArray[np.float64] | None, answers: list[Match]
) -> list[Match]:
    """Add what the jitter of the stamps makes of the motion of the camera.

    What a frame shows is as certain as before, so that no further answer is refused.

    Parameters
    ----------
    free : tuple of str
        Parameters of the view.
    jitter_s : float
        Standard deviation of the stamps.
    time_s : (n,) float64, optional
        Stamps.
    answers : list of Match
        One for each of n frames.
    """
    if jitter_s == 0 or time_s is None:
        return answers
    view, std = (np.full((len(answers), len(free)), np.nan) for _ in range(2))
    for k, match in enumerate(answers):
        if match.covariance is not None and match.class_name is not None:
            view[k] = [getattr(match, name) for name in free]
            std[k] = np.sqrt(np.diag(match.covariance))
    period = np.array([delta_period_rad(match.symmetry) for match in answers])
    rate = rates_of_views(spread_stamps(time_s), view, std, period, free.index("delta_rad"))
    return [
        with_part(match, "motion", part) if one.any() else match
        for match, one, part in zip(answers, rate, jitter_s**2 * rate[:, :, None] * rate[:, None], strict=True)
    ]


def _carried(
    setup: Setup, renderer: Renderer, evidence: Evidence, matches: list[Match], terms: Mapping[Systematic, Carried]
) -> dict[Systematic, NDArray[np.float64]]:
    """Return what errors of the sensor's fields make of the views of some frames of one class, (k, p, p) each."""
    background, sensor, n = matches[0].background, evidence.sensor, len(matches)
    views = views_of(matches)
    image = renderer.render_views(views, background=background)
    parameters = (getattr(views, name) for name in VIEW)
    slope = renderer.jacobian(*parameters, background=background, parameters=setup.free)
    fits_albedo = setup.on == "phasors" or (setup.albedo_std > 0 and background is not None)
    if fits_albedo:  # which takes up part of an error
        alone = image if background is None else renderer.render_views(views)
        slope = np.concatenate([slope, alone.phasor[:, None]], axis=1)
    by_fields = calibrated_slopes(renderer, sensor, views, image, background, fields_of(terms))
    use = counts(image.phasor, image.intensity, sensor).reshape(n, -1) & setup.used
    weight = np.where(use, evidence.weight, 0.0)
    phasor = image.phasor.reshape(n, -1)
    if setup.unknown:
        residual = range_residuals(phasor, evidence, np.arange(n))
        weight = np.where(weight * residual**2 > STRANGE_SIGMA**2, 0.0, weight)

    def whitened(slopes: NDArray[np.complex128]) -> NDArray[np.float64]:
        flat, root = slopes.reshape(*slopes.shape[:2], -1), np.sqrt(weight)[:, None]
        if setup.on == "phasors":
            return np.concatenate([flat.real * root, flat.imag * root], axis=2)
        return np.asarray(range_slopes(phasor, flat, sensor) * root)

    rows = whitened(slope)
    information = rows @ rows.transpose(0, 2, 1)
    p = len(setup.free)
    if setup.prior_std:
        information[:, :p, :p] += np.diag(np.array(setup.prior_std) ** -2.0)
    if fits_albedo and setup.on == "ranges":
        information[:, p, p] += setup.albedo_std**-2.0
    inverse = covariance_of(information, weak="none")
    carried = carried_covariances(inverse, rows, whitened(by_fields), terms)
    return {term: part[:, :p, :p] for term, part in carried.items()}
