"""A figure of a match: measured, best model, residual, side by side (the paper's figure 11)."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from phasemark.data import Bank
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.match import Match
from phasemark.matcher.pixel_agreement import counts
from phasemark.render import Background, Renderer, background_image, phasor_to_range_m, predicted_range_std
from phasemark.render.charts import panels
from phasemark.render.direct.chip_renderer import ChipRenderer
from phasemark.render.figures import draw_range, draw_sigma, landmark_limits_m
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.view import delta_period_rad, wrap_delta_difference_rad


def model_image(
    bank: Bank, match: Match, background: Background | None, *, reported: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return ranges of the model image a match names, and the share of each pixel on the landmark; (rows, cols) each.

    A range is NaN where it returns too little to measure.

    Parameters
    ----------
    bank : Bank
    match : Match
        Where it has no covariance, its view is one of the bank's grid.
    background : Background, optional
        What the model is composed with, as in the matcher.
    reported : bool
        Whether the ranges are those the chip reports.
    """
    name = match.class_name or match.alternatives[0].class_name
    if match.covariance is not None:
        mesh = bank.mesh(name)
        made_by = ChipRenderer if reported else Renderer
        rendered = made_by(mesh, bank.sensor, albedo=float(mesh.metadata["albedo"])).render(
            *(getattr(match, name) for name in VIEW), background=match.background or background
        )
        counted = counts(rendered.phasor[0], rendered.intensity[0], bank.sensor)
        return np.where(counted, rendered.range_m[0], np.nan), rendered.coverage[0]
    i = int(np.abs(bank.distance_m - match.distance_m).argmin())
    turned = wrap_delta_difference_rad(bank.delta_rad - match.delta_rad, delta_period_rad(match.symmetry))
    j = int(np.abs(turned).argmin())
    image = bank.image(name, i, j)
    phasor, intensity = image.phasor[0], image.intensity[0]
    if background is not None:
        behind = background_image(background, bank.sensor)
        free = 1 - image.coverage[0]
        phasor, intensity = phasor + free * behind.phasor[0], intensity + free * behind.intensity[0]
    noise = predicted_range_std(np.abs(phasor), intensity, bank.sensor) / bank.sensor.metres_per_radian
    limit = bank.sensor.max_phase_std_rad or np.inf
    return np.where(noise <= limit, phasor_to_range_m(phasor, bank.sensor), np.nan), image.coverage[0]


def match_figure(
    frames: FilteredFrames,
    match: Match,
    bank: Bank,
    background: Background | None = None,
    index: int = 0,
    *,
    title: bool = True,
    reported: bool = False,
) -> Figure:
    """Draw a filtered frame beside the best model image, and their difference in standard deviations of the filter.

    The colours of the ranges span the landmark of the model: what lies farther away, a wall for one, is grey.

    Parameters
    ----------
    frames : FilteredFrames
    match : Match
        The match of ``frames[index]``.
    bank : Bank
    background : Background, optional
    index : int
    title : bool
        Whether to write above what was found.
    reported : bool
        Whether ranges were matched as a chip reports them: zones that report another surface are left out.

    Returns
    -------
    matplotlib.figure.Figure
    """
    frames = frames.without_offset()
    if reported:
        frames = frames.with_pooled_noise().with_chip_error()
    measured = frames.range_m[index]
    model, coverage = np.full_like(measured, np.nan), np.zeros_like(measured)
    if math.isfinite(match.distance_m):
        model, coverage = model_image(bank, match, background, reported=reported)
    near, far = landmark_limits_m(model, coverage)
    figure, ((left, middle, right),) = panels(3, width=4.4, height=4.2)
    left.set_title("measured, filtered")
    draw_range(left, measured, near_m=near, far_m=far)
    middle.set_title("best model image")
    draw_range(middle, model, near_m=near, far_m=far)
    right.set_title("(measured − model) / σ")
    draw_sigma(right, wrap_difference_m(measured - model, frames.sensor) / frames.std_m[index])
    if title:
        figure.suptitle(describe(match))
    return figure


def describe(match: Match) -> str:
    """Describe a match in one line."""
    if match.class_name is None:
        return "no landmark"
    verdict = "accepted" if match.accepted else "doubtful"
    return (
        f"{match.class_name} at D = {match.distance_m:.3f} m, δ = {math.degrees(match.delta_rad):.2f}°"
        f" ({verdict}: χ² = {match.chi2:.0f}, {match.dof} degrees of freedom, p = {match.p_value:.2g})"
    )
